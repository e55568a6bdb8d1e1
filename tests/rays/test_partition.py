"""Object partitions: the paper's weight estimate, the greedy deal, and big-object splitting."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.rays.partition import Footprint, Pieces, Published, partition, pieces
from simrender.rays.scene import Scene, SceneObject
from tests.scenes import MATERIALS, floor, placed, sphere

RTX = Footprint(50.0, 400.0)


def made_of(weights: list[float]) -> Pieces:
    n = len(weights)
    return Pieces(np.arange(n + 1), np.ones(n), np.ones(n), np.array(weights, dtype=float))


def test_the_weight_is_geometry_textures_and_the_two_constants():
    ball = SceneObject("ball", (sphere(),))
    scene = Scene((ball,), np.zeros(10, np.int32), placed(np.zeros((10, 3)), np.ones(10)), MATERIALS)
    triangles = scene.unique_triangles
    published = Published(triangles * 1000.0, 10 * 50.0, triangles * 1e5, geometry_bytes=3e6, texture_bytes=2e6)
    whole = pieces(scene, published, RTX, split_share=1.0)
    assert whole.weight_bytes.tolist() == pytest.approx([3e6 + 2e6 + 50 * triangles * 1000 + 400 * 500])
    assert whole.instanced_triangles.tolist() == pytest.approx([triangles * 1e5])


def test_heaviest_first_gives_each_piece_to_the_least_loaded_domain():
    dealt = partition(made_of([1, 7, 3, 5, 4]), 2)
    # 7 -> 0, 5 -> 1, 4 -> 1, 3 -> 0, 1 -> 1 (9 against 10)
    assert dealt.domain_of_mesh.tolist() == [1, 0, 0, 1, 1]
    assert dealt.weight_bytes.tolist() == [10, 10]


def test_equal_weights_go_round_in_order():
    assert partition(made_of([2] * 5), 3).domain_of_mesh.tolist() == [0, 1, 2, 0, 1]


def test_round_robin_ignores_weights():
    dealt = partition(made_of([100, 1, 100, 1]), 2, "round_robin")
    assert dealt.domain_of_mesh.tolist() == [0, 1, 0, 1]
    assert dealt.weight_bytes.tolist() == [200, 2]


def test_a_domain_may_stay_empty():
    dealt = partition(made_of([1.0]), 3)
    assert dealt.weight_bytes.tolist() == [1, 0, 0]
    assert dealt.primitives.tolist() == [1, 0, 0]


@given(st.lists(st.floats(0.1, 1e9), min_size=1, max_size=60), st.integers(1, 20))
@settings(max_examples=60, deadline=None)
def test_greedy_is_within_the_heaviest_piece_of_even(weights, domains):
    dealt = partition(made_of(weights), domains)
    assert dealt.weight_bytes.sum() == pytest.approx(sum(weights))
    assert dealt.weight_bytes.max() <= sum(weights) / domains + max(weights) * (1 + 1e-9)


def test_big_objects_are_split_between_their_meshes_and_keep_their_instances():
    ball = SceneObject("ball", (sphere(rings=4),))
    scene = Scene((floor(), ball), np.array([0, 1, 1]), placed(np.zeros((3, 3)), np.ones(3)), MATERIALS)
    own = Published(scene.unique_triangles, 3, scene.instanced_triangles, 0.0, 0.0)
    together = pieces(scene, own, RTX, split_share=1.0)
    apart = pieces(scene, own, RTX, split_share=0.3)
    assert together.first_mesh.tolist() == [0, 4, 5]
    assert apart.first_mesh.tolist() == [0, 1, 2, 3, 4, 5]
    assert apart.triangles.sum() == together.triangles.sum()
    # Each part of the floor is an object of its own now, so its one instance counts once a part.
    assert apart.weight_bytes.sum() - together.weight_bytes.sum() == pytest.approx(3 * 400.0)


def test_the_published_size_is_shared_out_in_proportion():
    ball = SceneObject("ball", (sphere(rings=4),))
    scene = Scene((floor(), ball), np.array([0, 1, 1]), placed(np.zeros((3, 3)), np.ones(3)), MATERIALS)
    published = Published(1e9, 3e6, 1e12, 1e10, 0.0)
    whole = pieces(scene, published, RTX, 1.0)
    assert whole.triangles.sum() == pytest.approx(1e9)
    assert whole.instanced_triangles.sum() == pytest.approx(1e12)
    assert whole.weight_bytes.sum() == pytest.approx(1e10 + 50e9 + 400 * 3e6)
