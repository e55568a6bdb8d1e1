"""Scenes of any size and at any distance: what float32 can do, and a word where it no longer can."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simrender.accuracy.stability import SCHEMES, far_cameras, sizes_and_offsets
from simrender.rays.precision import FARTHEST, FARTHEST_VOLUME, SMALLEST, out_of_range
from simrender.rays.scene import IDENTITY, Mesh, Scene, SceneObject
from simrender.rays.volume import TransferFunction, Volume
from tests.scenes import garden

SIZES = tuple(10.0**k for k in range(-6, 7, 3))
OFFSETS = (0.0, 1.0, 10.0, 100.0, 1e3, 1e4, 1e6)
TRACED, PLAIN, FIXED, SHARE = SCHEMES


@pytest.fixture(scope="module")
def placed():
    return {(row.size, row.offset, row.scheme): row for row in sizes_and_offsets(SIZES, OFFSETS, 2000)}


def test_numerics_every_place_and_every_way_to_leave_a_surface_is_in_the_table(placed):
    assert len(placed) == len(SIZES) * len(OFFSETS) * len(SCHEMES)
    for row in placed.values():
        assert 0.0 <= row.self_hits <= row.wrong_next <= 1.0
        assert 0.0 <= row.wrong_first <= 1.0


@pytest.mark.parametrize("size", SIZES)
def test_numerics_no_traced_ray_hits_the_triangle_it_starts_on(placed, size):
    for offset in OFFSETS:
        assert placed[size, offset, TRACED].self_hits == 0.0
        assert placed[size, offset, PLAIN].self_hits == 0.0


@pytest.mark.parametrize("size", SIZES)
def test_numerics_a_scene_of_any_size_near_the_origin_is_traced_as_in_exact_arithmetic(placed, size):
    for offset in (0.0, 1.0, 10.0):
        row = placed[size, offset, TRACED]
        assert row.wrong_first == 0.0
        assert row.wrong_next <= (0.0 if offset == 0.0 else 3e-3)


def test_numerics_a_fixed_distance_fails_where_the_traced_one_does_not(placed):
    # Too short: half of all rays start behind their surface. Too long: they start on the far side of something.
    assert placed[1e6, 0.0, FIXED].self_hits > 0.4
    assert placed[1e3, 10.0, FIXED].self_hits > 0.4
    assert placed[1.0, 1e4, SHARE].self_hits > 0.4
    assert placed[1e-6, 0.0, FIXED].wrong_next > 0.99
    # The step of Waechter and Binder has a floor, meant for scenes of ordinary size; tiny ones are therefore enlarged.
    assert placed[1e-6, 0.0, PLAIN].wrong_next > 0.99
    assert placed[1e-6, 0.0, TRACED].wrong_next == 0.0


def test_numerics_what_is_lost_far_from_the_origin_depends_on_the_distance_in_sizes_alone(placed):
    lost = np.array([[placed[size, offset, TRACED].wrong_next for offset in OFFSETS] for size in SIZES])
    assert (np.diff(lost.mean(axis=0)) >= 0.0).all()
    # A share p of n rays has the standard error sqrt(p (1 - p) / n); roundings differ from size to size.
    spread = np.sqrt(np.maximum(lost.mean(axis=0), 1e-3) / 2000)
    assert (np.abs(lost - lost.mean(axis=0)) <= 6.0 * spread).all()


def test_numerics_the_safe_range_is_where_one_ray_in_a_hundred_goes_astray(placed):
    lost = [placed[size, FARTHEST, TRACED].wrong_next for size in SIZES]
    assert 0.003 < np.mean(lost) < 0.02
    assert np.mean([placed[size, 10.0 * FARTHEST, TRACED].wrong_next for size in SIZES]) > 0.1


def test_numerics_a_camera_as_far_as_that_still_sees_what_is_there():
    seen = dict(far_cameras([1.0, 10.0, FARTHEST, 1e4]))
    assert seen[1.0] <= 1e-3
    assert seen[FARTHEST] < 0.01
    assert seen[1e4] > 0.1


# -- the warning ------------------------------------------------------------------------------------------------------


def body(offset, size=1.0):
    """A tetrahedron in a box of a given diagonal, as many sizes from the origin."""
    corners = (np.array([[0, 0, 0], [1, 1, 0], [1, 0, 1], [0, 1, 1]]) - 0.5) / math.sqrt(3.0)
    vertices = size * (corners + np.array([offset, 0.0, 0.0]))
    mesh = Mesh(vertices.astype(np.float32), np.array([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]))
    return Scene((SceneObject("body", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None])


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_numerics_scenes_within_the_safe_range_are_not_warned_of(size):
    assert out_of_range(body(0.0, size)) is None
    assert out_of_range(body(0.9 * FARTHEST, size)) is None
    assert out_of_range(garden().scaled(size)) is None
    assert out_of_range(body(0.0, size), eye=(0.9 * FARTHEST * size, 0.0, 0.0)) is None


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_numerics_a_scene_far_from_the_origin_is_warned_of(size):
    message = out_of_range(body(250.0, size))
    assert message is not None
    assert message.startswith("the scene lies 250 times its size from the world's origin")
    assert f"move it within 100 times its size of {size:.3g}" in message


def test_numerics_a_camera_far_from_the_scene_is_warned_of():
    message = out_of_range(body(0.0), eye=(0.0, 0.0, 3e4))
    assert message is not None
    assert message.startswith("the camera stands 30,000 times the scene's size away from it")


def test_numerics_a_scene_too_small_for_the_exponents_of_float32_is_warned_of():
    message = out_of_range(body(0.0, 0.5 * SMALLEST))
    assert message is not None
    assert "only 5e-31 in size" in message


def test_numerics_a_volume_may_lie_farther_off_than_a_surface():
    clear = TransferFunction([0.0], [[1.0, 1.0, 1.0]], [0.0])
    for sizes, fine in ((2.0 * FARTHEST, True), (1.5 * FARTHEST_VOLUME, False)):
        cube = Volume(np.zeros((3, 3, 3)), (0.5, 0.5, 0.5), (sizes * math.sqrt(3.0), 0.0, 0.0), clear)
        scene = Scene((), np.zeros(0, np.int32), np.zeros((0, 3, 4)), volume=cube)
        message = out_of_range(scene)
        assert message is None if fine else "positions are coarse" in message


def test_a_scene_in_one_point_is_not_warned_of():
    mesh = Mesh(np.full((3, 3), 7e5, np.float32), np.array([[0, 1, 2]]))
    assert out_of_range(Scene((SceneObject("dot", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None])) is None
