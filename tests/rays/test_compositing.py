"""Blending fragments: any tree of neighbours makes the picture that front to back does, and order alone matters."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.rays.compositing import composite, over
from workloads.terrain import generator


def fragments(rays=40, most=12, seed=3):
    """Random fragments in random order: premultiplied colours, distinct depths within a ray."""
    rng = generator(seed, "fragments")
    ray = np.repeat(np.arange(rays), rng.integers(0, most + 1, rays))
    n = len(ray)
    alpha = rng.random((n, 1)) ** 2
    rgba = np.hstack([rng.random((n, 3)) * alpha, alpha]).astype(np.float32)
    depth = rng.permutation(n).astype(np.float32)
    shuffled = rng.permutation(n)
    return rgba[shuffled], depth[shuffled], ray[shuffled], rng.integers(0, 5, n)[shuffled]


def any_tree(rgba, rng):
    """Blend neighbours in random order until one is left."""
    rgba = list(rgba)
    while len(rgba) > 1:
        i = rng.integers(len(rgba) - 1)
        rgba[i : i + 2] = [over(rgba[i], rgba[i + 1])]
    return rgba[0]


def test_over_on_premultiplied_colours_worked_by_hand():
    half_red, blue = np.array([0.5, 0.0, 0.0, 0.5]), np.array([0.0, 0.0, 1.0, 1.0])
    assert over(half_red, blue).tolist() == [0.5, 0.0, 0.5, 1.0]
    assert over(blue, half_red).tolist() == blue.tolist()
    assert over(np.zeros(4), half_red).tolist() == over(half_red, np.zeros(4)).tolist() == half_red.tolist()


def test_equal_colours_of_any_opacity_make_that_colour_times_their_opacity():
    alpha = np.array([[0.1], [0.9], [0.5]])
    straight = np.array([0.2, 0.4, 0.8])
    rgba = np.hstack([alpha * straight, alpha]).astype(np.float32)
    image = composite(rgba, np.arange(3.0), np.zeros(3, int), np.zeros(3, int), 1)[0]
    assert image[3] == pytest.approx(1 - 0.9 * 0.1 * 0.5)
    assert image[:3] == pytest.approx(straight * image[3])


def test_numerics_every_tree_of_neighbours_agrees():
    rgba, depth, ray, domain = fragments()
    image = composite(rgba, depth, ray, domain, 40)
    rng = generator(1, "trees")
    for pixel in range(40):
        mine = np.flatnonzero(ray == pixel)
        front_to_back = rgba[mine[np.argsort(depth[mine])]]
        if len(mine) == 0:
            assert not image[pixel].any()
            continue
        for _ in range(5):
            assert any_tree(front_to_back, rng) == pytest.approx(image[pixel], abs=1e-6)


def test_the_order_of_arrival_changes_no_bit():
    rgba, depth, ray, domain = fragments()
    depth[:] = np.floor(depth / 40)  # many ties
    # A domain that gives one ray two fragments at one depth would leave their order open.
    _, first = np.unique(np.stack([ray, depth, domain]), axis=1, return_index=True)
    rgba, depth, ray, domain = rgba[first], depth[first], ray[first], domain[first]
    image = composite(rgba, depth, ray, domain, 40)
    for seed in range(5):
        p = generator(seed, "arrival").permutation(len(ray))
        assert (composite(rgba[p], depth[p], ray[p], domain[p], 40) == image).all()


def test_numerics_at_one_depth_the_lower_domain_is_in_front():
    red, green = [1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0]
    rgba = np.array([red, green], np.float32)
    assert composite(rgba, np.array([2.0, 2.0]), np.array([0, 0]), np.array([7, 3]), 1).tolist() == [green]
    assert composite(rgba, np.array([2.0, 2.0]), np.array([0, 0]), np.array([3, 7]), 1).tolist() == [red]


def test_rays_do_not_mix_and_a_ray_without_fragments_stays_empty():
    rgba = np.array([[1, 1, 1, 1], [0.25, 0.25, 0.25, 0.5]], np.float32)
    image = composite(rgba, np.array([1.0, 1.0]), np.array([2, 0]), np.array([0, 0]), 4)
    assert image.tolist() == [[0.25, 0.25, 0.25, 0.5], [0] * 4, [1] * 4, [0] * 4]
    assert composite(rgba[:0], np.zeros(0), np.zeros(0, int), np.zeros(0, int), 2).tolist() == [[0] * 4] * 2


def test_numerics_thousands_of_thin_fragments_keep_their_opacity():
    n, tau = 20_000, 1e-6
    rgba = np.tile(np.array([[0, 0, 0, -np.expm1(-tau)]], np.float32), (n, 1))
    image = composite(rgba, np.arange(n, dtype=np.float64), np.zeros(n, int), np.zeros(n, int), 1)
    assert image[0, 3] == pytest.approx(-np.expm1(-n * tau), rel=1e-6)


@pytest.mark.parametrize("ray", [-1, 2])
def test_a_fragment_of_a_ray_that_does_not_exist_is_refused(ray):
    with pytest.raises(IndexError, match=f"a fragment is of ray {ray}, but there are 2 rays"):
        composite(np.zeros((2, 4), np.float32), np.zeros(2), np.array([0, ray]), np.zeros(2, int), 2)
