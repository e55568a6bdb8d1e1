"""Marching: closed forms, convergence, and samples that belong to exactly one brick."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.compositing import composite
from simrender.rays.marching import gradients, march, opacity
from simrender.rays.volume import TransferFunction, Volume
from tests.rays.test_volume import SPIKY, bundle, hard_rays, in_bricks, kd_bricks, noise, whole
from workloads.terrain import generator

HAZE = TransferFunction([0.0, 1.0], [[0.0, 0.2, 1.0], [1.0, 0.2, 0.0]], [0.0, 0.3])


def ramp(n=17, axis=0, transfer=HAZE, spacing=(1.0, 1.0, 1.0), origin=(0.0, 0.0, 0.0)):
    """A cube of n^3 grid points whose values rise from 0 to 1 along an axis."""
    line = np.expand_dims(np.linspace(0.0, 1.0, n), [a for a in range(3) if a != 2 - axis])
    return Volume(np.broadcast_to(line, (n, n, n)), spacing, origin, transfer)


def marched(volume, step, rays, bricks=None, **options):
    rows = whole(volume, rays) if bricks is None else in_bricks(rays, bricks)
    return march(volume, step, rays, *rows, **options)


def test_a_homogeneous_slab_is_as_opaque_as_its_thickness_says():
    volume = Volume(np.full((9, 9, 17), 0.25), (0.5, 1.0, 1.0), (2.0, 0.0, 0.0), HAZE)
    sigma = float(HAZE.sigma(0.25))
    for step in (0.1, 0.5, 3.0):
        m = marched(volume, step, bundle([[-1.0, 4.2, 4.9]], [[1.0, 0.0, 0.0]]))
        assert m.samples[0] == pytest.approx(8.0 / step, abs=1)
        assert m.rgba[0, 3] == pytest.approx(-math.expm1(-sigma * m.samples[0] * step), rel=1e-6)
        assert m.rgba[0, :3] == pytest.approx(HAZE.color(0.25) * m.rgba[0, 3], rel=1e-6)


def test_numerics_marching_converges_at_first_order_to_the_closed_form_of_a_ramp():
    thin = TransferFunction(HAZE.values, HAZE.colors, [0.0, 0.05])
    volume = ramp(33, transfer=thin)
    length, sigma = 32.0, float(thin.extinction[1])
    transmittance = math.exp(-0.5 * sigma * length)
    n = 500
    rng = generator(1, "where")
    origin = np.column_stack([-1.0 - rng.random(n), 4.0 + rng.random((n, 2)) * 20.0])
    rays = bundle(origin, [[1.0, 0.0, 0.0]])
    # The red channel's emission is the value x / L itself: int sigma (x/L)^2 exp(-sigma x^2 / 2L) dx over 0 .. L.
    x = (np.arange(200_000) + 0.5) * (length / 200_000)
    red = np.sum(sigma * (x / length) ** 2 * np.exp(-0.5 * sigma * x * x / length)) * (length / 200_000)
    steps = np.array([2.0, 1.0, 0.5, 0.25, 0.125])
    errors = []
    for step in steps:
        rgba = marched(volume, step, rays, shading=False, opacity_limit=1.0).rgba
        errors.append([np.abs(rgba[:, 3] - (1.0 - transmittance)).mean(), np.abs(rgba[:, 0] - red).mean()])
    for error in np.log(np.array(errors)).T:
        assert np.polyfit(np.log(steps), error, 1)[0] == pytest.approx(1.0, abs=0.15)
    assert errors[-1] == pytest.approx([0.0, 0.0], abs=3e-3)


def test_numerics_every_sample_belongs_to_exactly_one_brick():
    volume = Volume(noise(50, 41, 27), (0.5, 1.0, 1.5), (-3.0, 2.0, 0.25), SPIKY)
    rng = generator(5, "bricks")
    rays = hard_rays(volume, rng)
    for step in (0.25, 0.37):
        one = marched(volume, step, rays, opacity_limit=1.0)
        assert (one.samples > 0).mean() > 0.6
        for count in (2, 9, 40):
            bricks = kd_bricks(volume, count, rng)
            many = marched(volume, step, rays, bricks, opacity_limit=1.0)
            assert (many.samples.reshape(-1, count).sum(axis=1) == one.samples).all()
            ray, domain = np.divmod(np.arange(len(many.samples)), count)
            image = composite(many.rgba, many.entry, ray, domain, len(one.samples))
            assert image == pytest.approx(one.rgba, abs=1e-6)
            # Stretches of bricks that follow each other abut, to the bit.
            order = np.lexsort((many.entry, ray))
            order = order[many.samples[order] > 0]
            follows = ray[order][1:] == ray[order][:-1]
            assert (many.exit[order][:-1][follows] == many.entry[order][1:][follows]).all()


def test_numerics_samples_exactly_on_faces_edges_and_corners_count_once():
    volume = Volume(noise(25, 25, 25), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), SPIKY)
    bricks = kd_bricks(volume, 27, generator(2, "bricks"))
    on = np.array([[0.0, 8.0, 16.0], [16.0, 8.0, 8.0], [24.0, 24.0, 0.0], [0.0, 0.0, 0.0]])
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        # Half a step before a grid plane: with a step of 1, every sample lies on a plane, an edge or a vertex.
        start = np.where(direction != 0.0, 12.0 - 30.5 * direction, on)
        rays = bundle(start, direction)
        assert marched(volume, 1.0, rays, opacity_limit=1.0).samples.tolist() == [25] * 4
        many = marched(volume, 1.0, rays, bricks, opacity_limit=1.0).samples.reshape(4, -1)
        assert many.sum(axis=1).tolist() == [25] * 4


def test_numerics_a_direction_that_barely_leaves_a_face_is_not_lost():
    volume = Volume(noise(25, 25, 25), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), SPIKY)
    bricks = kd_bricks(volume, 12, generator(3, "bricks"))
    tiny = np.array([1e-38, 1e-30, 1e-9, 3e-8, 0.0])
    direction = np.column_stack([tiny, np.ones(5), -tiny])
    for start in ([8.0, -3.0, 8.0], [24.0, -3.0, 24.0], [np.nextafter(np.float32(8), np.float32(0)), -3.0, 16.0]):
        rays = bundle([start], np.vstack([direction, -direction * [1, -1, 1]]))
        one = marched(volume, 0.125, rays, opacity_limit=1.0).samples
        many = marched(volume, 0.125, rays, bricks, opacity_limit=1.0).samples.reshape(10, -1)
        assert (many.sum(axis=1) == one).all()
        assert (one > 0).any()


def test_a_reach_ends_the_march_and_a_camera_inside_begins_it():
    volume = ramp(17)
    m = marched(volume, 0.5, bundle([[8.0, 8.0, 8.0]] * 3, [[1.0, 0.0, 0.0]], [100.0, 3.0, 0.0]))
    assert m.samples.tolist() == [16, 6, 0]
    assert (m.entry.tolist(), m.exit.tolist()) == ([0.0, 0.0, np.inf], [8.0, 3.0, np.inf])
    assert not m.rgba[2].any()


def test_a_row_ends_at_99_percent_opacity():
    thick = TransferFunction([0.0], [[1.0, 1.0, 1.0]], [0.5])
    volume = Volume(np.zeros((9, 9, 33)), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), thick)
    rays = bundle([[-1.0, 4.0, 4.0]], [[1.0, 0.0, 0.0]])
    stopped, full = marched(volume, 1.0, rays), marched(volume, 1.0, rays, opacity_limit=1.0)
    assert (stopped.samples[0], full.samples[0]) == (7, 32)  # 2^-7 < 1 % < 2^-6
    assert (stopped.done[0], full.done[0]) == (True, False)
    assert stopped.rgba[0] == pytest.approx([1 - 2.0**-7] * 4)
    assert stopped.exit[0] == full.exit[0] == 33.0


def test_the_headlight_dims_what_it_grazes_on_both_sides_alike():
    volume = ramp(17, axis=0, transfer=TransferFunction([0.0], [[1.0, 1.0, 1.0]], [0.1]))
    start = np.array([8.0, 8.0, 8.0])
    ways = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, 0.6, 0.8], [0.6, 0.8, 0], [-0.6, -0.8, 0]])
    rays = bundle(start - 4.0 * ways, ways, 8.0)
    lit, flat = marched(volume, 0.25, rays), marched(volume, 0.25, rays, shading=False)
    factor = 0.4 + 0.6 * np.abs(ways[:, 0])
    assert lit.rgba[:, 0] == pytest.approx(factor * flat.rgba[:, 0], rel=1e-4)
    assert (lit.rgba[:, 3] == flat.rgba[:, 3]).all()


def test_without_a_significant_gradient_nothing_is_shaded():
    voxels = np.full((17, 17, 17), 0.5) + 1e-4 * noise(17, 17, 17)
    voxels[0, 0, 0], voxels[0, 0, 1] = 0.0, 1.0
    volume = Volume(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), HAZE)
    rays = bundle([[-2.0, 9.3, 9.1]], [[1.0, 0.0, 0.0]])
    assert (marched(volume, 0.5, rays).rgba == marched(volume, 0.5, rays, shading=False).rgba).all()


def test_gradients_of_a_linear_field_are_exact_up_to_the_last_face():
    spacing, slope = np.array([0.5, 1.0, 2.0]), np.array([3.0, -1.0, 0.25])
    z, y, x = np.meshgrid(np.arange(6) * 2.0, np.arange(5) * 1.0, np.arange(9) * 0.5, indexing="ij")
    volume = Volume(slope[0] * x + slope[1] * y + slope[2] * z, tuple(spacing), (10.0, 0.0, -5.0), HAZE)
    low, high = volume.bounds
    points = np.vstack([low + generator(1, "points").random((50, 3)) * (high - low), low, high])
    assert gradients(volume, points) == pytest.approx(np.tile(slope, (52, 1)), abs=1e-5)


def test_gradients_are_those_of_the_field_one_cell_to_each_side():
    volume = Volume(noise(9, 8, 7), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), HAZE)
    v = volume.voxels
    point = np.array([[3.25, 4.0, 2.0]])
    along_x = 0.75 * (v[2, 4, 4] - v[2, 4, 2]) / 2 + 0.25 * (v[2, 4, 5] - v[2, 4, 3]) / 2
    along_z = (0.75 * (v[3, 4, 3] - v[1, 4, 3]) + 0.25 * (v[3, 4, 4] - v[1, 4, 4])) / 2
    assert gradients(volume, point)[0, [0, 2]] == pytest.approx([along_x, along_z], rel=1e-5)


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_numerics_a_scene_of_any_size_looks_the_same(factor):
    volume = Volume(noise(20, 20, 20), (1.0, 0.5, 1.0), (1.0, 2.0, 3.0), SPIKY)
    rays = hard_rays(volume, generator(1, "rays"), 50)
    large = rays | {"origin": rays["origin"] * np.float32(factor)}
    one, other = marched(volume, 0.25, rays), marched(volume.scaled(factor), 0.25 * factor, large)
    assert (one.samples == other.samples).all()
    # Not to the bit: the length that opacities refer to goes through a division.
    assert one.rgba == pytest.approx(other.rgba, abs=1e-6)


def test_numerics_a_scene_far_from_the_origin_keeps_its_samples():
    volume = Volume(noise(20, 20, 20), (1.0, 1.0, 1.0), (2.0**20,) * 3, SPIKY)
    bricks = kd_bricks(volume, 8, generator(4, "bricks"))
    rays = bundle(np.array([[-4.0, 9.5, 9.5], [8.0, 8.0, -4.0]]) + 2.0**20, [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    one = marched(volume, 0.25, rays, opacity_limit=1.0)
    assert one.samples.tolist() == [76, 76]
    assert marched(volume, 0.25, rays, bricks, opacity_limit=1.0).samples.reshape(2, 8).sum(axis=1).tolist() == [76, 76]


def test_chunks_and_threads_change_nothing():
    volume = Volume(noise(12, 12, 12), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), SPIKY)
    rays = hard_rays(volume, generator(6, "rays"), 5 * embree.CHUNK // 16)
    rows = whole(volume, rays)
    assert len(rows[0]) > 2 * embree.CHUNK
    together = march(volume, 0.5, rays, *rows)
    half = embree.CHUNK // 2 + 3
    parts = [march(volume, 0.5, rays, *(r[i : i + half] for r in rows)) for i in range(0, len(rows[0]), half)]
    assert (np.concatenate([p.rgba for p in parts]) == together.rgba).all()
    assert (np.concatenate([p.samples for p in parts]) == together.samples).all()


def test_numerics_opacity_of_thin_and_thick_slabs():
    for tau in [1e-300, 1e-12, 1e-6, 1e-3, 0.0312, 0.03125, 0.0313, 1.0, 40.0, 700.0]:
        assert opacity(tau) == pytest.approx(-math.expm1(-tau), rel=2e-14)


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan, np.inf, 1e-12])
def test_a_step_that_is_no_length_is_refused(step):
    with pytest.raises(SceneError, match="the step of a ray march is a length above"):
        marched(ramp(), step, bundle([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]]))


def test_a_brick_that_ends_within_a_macro_cell_is_refused():
    rays = bundle([[0.0, 0.0, 0.0]], [[1.0, 0.0, 0.0]])
    with pytest.raises(SceneError, match=r"the brick \[0, 9, 0, 16, 0, 16\] does not fit"):
        marched(ramp(), 0.5, rays, np.array([[0, 9, 0, 16, 0, 16]], np.int32))
