"""Tracking: unbiased whatever the majorant, the same to the bit whatever the bricks, and no hole in an isosurface."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays.tracking import ISOSURFACE, NOTHING, SCATTER, _field, isotropic_direction, track
from simrender.rays.volume import MACRO, TransferFunction, Volume
from tests.rays.test_volume import SPIKY, bundle, hard_rays, in_bricks, kd_bricks, noise, whole
from workloads.terrain import generator

CLEAR = TransferFunction([0.0], [[1.0, 1.0, 1.0]], [0.0])


def medium(sigma, values=(0.0,)):
    """A transfer function of given extinctions at given values."""
    sigma = np.atleast_1d(np.asarray(sigma, float))
    unit = 1.0 / max(1.0, sigma.max())  # so short that no slab is opaque to rounding
    return TransferFunction(values, np.ones((len(values), 3)), -np.expm1(-sigma * unit), unit)


def ramp(transfer, n=33, isovalues=()):
    """A cube of n - 1 cells a side whose values rise from 0 to 1 along x."""
    voxels = np.broadcast_to(np.linspace(0.0, 1.0, n), (n, n, n))
    return Volume(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), transfer, isovalues)


def keys_of(rays, seed=1):
    return generator(seed, "keys").integers(0, 2**64, len(rays["reach"]), dtype=np.uint64)


def tracked(volume, rays, bricks=None, scale=1.0, seed=1):
    rows = whole(volume, rays) if bricks is None else in_bricks(rays, bricks)
    return track(volume, rays, keys_of(rays, seed), *rows, majorant_scale=scale)


def along_x(n, reach=np.inf):
    return bundle(
        np.column_stack([np.full(n, -1.0), generator(2, "start").random((n, 2)) * 32.0]), [[1.0, 0, 0]], reach
    )


def assert_transmits(outcome, tau):
    """The share of rays that pass is exp(-tau), within 4 standard errors."""
    n, passed = len(outcome.event), (outcome.event == NOTHING).mean()
    expected = math.exp(-tau)
    assert abs(passed - expected) <= 4.0 * math.sqrt(expected * (1.0 - expected) / n)


@pytest.mark.parametrize("tau", [0.05, 1.0, 5.0])
@pytest.mark.parametrize("scale", [1.0, 1.5, 30.0])
def test_transmittance_of_a_homogeneous_medium(tau, scale):
    assert_transmits(tracked(ramp(medium(tau / 32.0)), along_x(20_000), scale=scale), tau)


@pytest.mark.parametrize("scale", [1.0, 20.0])
def test_transmittance_of_a_ramp_along_across_and_askew(scale):
    volume = ramp(medium([0.0, 0.1], (0.0, 1.0)))
    assert_transmits(tracked(volume, along_x(20_000), scale=scale), 0.5 * 0.1 * 32.0)
    across = bundle(np.tile([8.0, 4.3, 40.0], (20_000, 1)), [[0.0, 0.0, -1.0]])
    assert_transmits(tracked(volume, across, scale=scale), 0.25 * 0.1 * 32.0)
    askew = bundle(np.tile([32.0, 0.0, 4.0], (20_000, 1)), [[-0.8, 0.6, 0.0]], 25.0)
    # From x = 32 to 12 on a way of 25: the mean of the ramp there is 22 / 32.
    assert_transmits(tracked(volume, askew, scale=scale), 22.0 / 32.0 * 0.1 * 25.0)


def test_majorants_a_million_times_too_large_change_no_distribution():
    tau = 0.1
    outcome = tracked(ramp(medium(tau / 32.0)), along_x(200), scale=1e6)
    assert_transmits(outcome, tau)
    passed = outcome.event == NOTHING
    assert outcome.samples[passed].mean() == pytest.approx(tau * 1e6, rel=4 / math.sqrt(passed.sum() * tau * 1e6))


def test_a_spike_far_above_everything_else_in_its_macro_cells():
    peak, half_width = 2000.0, 1e-5
    spike = medium([0.002, 0.002, peak, 0.002, 0.002], (0.0, 0.4 - half_width, 0.4, 0.4 + half_width, 1.0))
    volume = ramp(spike)
    assert volume.macro.majorant.max() / volume.macro.majorant.min() == pytest.approx(1e6)
    tau = 0.002 * 32.0 + (peak - 0.002) * half_width * 32.0
    assert_transmits(tracked(volume, along_x(2_000)), tau)


def test_a_medium_so_thin_that_hardly_anything_collides():
    n, tau = 200_000, 1e-6
    thin = ramp(medium(tau / 32.0))
    assert_transmits(tracked(thin, along_x(n)), tau)
    inflated = tracked(thin, along_x(n), scale=1e6)
    assert inflated.samples.mean() == pytest.approx(1.0, abs=4 / math.sqrt(n))
    assert_transmits(inflated, tau)


def test_a_medium_so_thick_that_nothing_passes():
    n, tau = 20_000, 700.0
    outcome = tracked(ramp(medium(tau / 32.0)), along_x(n))
    assert (outcome.event == SCATTER).all()
    path = outcome.t - 1.0
    assert path.mean() == pytest.approx(32.0 / tau, rel=4 / math.sqrt(n))
    assert (path > 0).all()


def test_free_paths_are_exponential_across_macro_cells():
    sigma = 0.15
    path = np.sort(tracked(ramp(medium(sigma)), along_x(20_000)).t - 1.0)
    path = path[np.isfinite(path)]
    expected = -np.expm1(-sigma * path)
    # Kolmogorov and Smirnov's distance; 1.63 / sqrt(n) is exceeded once in a hundred.
    assert np.abs(expected - np.arange(len(path)) / 20_000).max() < 1.63 / math.sqrt(20_000)


def test_what_collides_says_what_it_met():
    outcome = tracked(ramp(medium([0.0, 0.1], (0.0, 1.0))), along_x(500))
    met = outcome.event == SCATTER
    assert outcome.value[met] == pytest.approx((outcome.t[met] - 1.0) / 32.0, abs=1e-5)
    assert np.isnan(outcome.value[~met]).all()
    assert np.isinf(outcome.t[~met]).all()


# -- the way over the grid --------------------------------------------------------------------------------------------


def intervals(volume, rays):
    """Where each ray is in each macro cell, by brute force: (enters, leaves), float64 (rays, macro cells)."""
    low = np.stack(np.meshgrid(*(np.arange(0, n, MACRO) for n in volume.cells), indexing="ij"), axis=-1).reshape(-1, 3)
    high = np.minimum(low + MACRO, volume.cells)
    g = (rays["origin"].astype(float) - volume.origin) / volume.spacing
    d = rays["direction"].astype(float) / volume.spacing
    with np.errstate(divide="ignore", invalid="ignore"):
        t0, t1 = (low[None] - g[:, None]) / d[:, None], (high[None] - g[:, None]) / d[:, None]
    still = np.broadcast_to(d[:, None] == 0.0, t0.shape)
    within = (low[None] <= g[:, None]) & ((g[:, None] < high[None]) | (high == volume.cells) & (g[:, None] == high))
    near = np.where(still, np.where(within, -np.inf, np.inf), np.minimum(t0, t1))
    far = np.where(still, np.where(within, np.inf, -np.inf), np.maximum(t0, t1))
    bricks = np.stack([low, high], axis=-1).reshape(-1, 6).astype(np.int32)
    return np.maximum(near.max(axis=-1), 0.0), far.min(axis=-1), bricks


def test_the_traversal_visits_exactly_the_macro_cells_that_a_brute_force_search_finds():
    volume = Volume(noise(42, 33, 20), (0.5, 1.0, 1.5), (-3.0, 2.0, 0.25), CLEAR)
    rays = hard_rays(volume, generator(1, "rays"), 150)
    enters, leaves, bricks = intervals(volume, rays)
    visited = tracked(volume, rays, bricks).cells.reshape(enters.shape)
    assert set(np.unique(visited)) == {0, 1}
    slack = 1e-9 * (1.0 + np.abs(leaves))
    assert (visited[leaves - enters > slack] == 1).all()
    assert (visited[enters - leaves > slack] == 0).all()
    # Rays in general position touch nothing in passing, so for them there is no doubt at all.
    generic = slice(0, 300)
    assert (np.abs(leaves - enters)[generic] > slack[generic]).all()
    assert (visited[generic] == (leaves > enters)[generic]).all()
    assert (tracked(volume, rays).cells == visited.sum(axis=1)).all()


def test_a_ray_through_vertices_steps_from_face_to_face():
    volume = Volume(np.zeros((33, 33, 33)), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), CLEAR)
    one = 1.0 / math.sqrt(3.0)
    rays = bundle(
        [[-8.0, -8.0, -8.0], [40.0, 40.0, 40.0], [0.0, 0.0, 0.0]], np.array([[one] * 3, [-one] * 3, [one] * 3])
    )
    _, _, bricks = intervals(volume, rays)
    visited = tracked(volume, rays, bricks).cells.reshape(3, -1)
    for row in visited:
        macro = bricks[row == 1][:, ::2] // MACRO
        steps = np.abs(np.diff(macro[np.argsort(macro.sum(axis=1))], axis=0))
        assert macro.sum(axis=1).min() == 0
        assert macro.sum(axis=1).max() == 9
        assert (steps.sum(axis=1) == 1).all()


def test_empty_space_costs_no_samples():
    volume = Volume(noise(33, 33, 33), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), CLEAR, (7.0,))
    outcome = tracked(volume, hard_rays(volume, generator(1, "rays"), 50))
    assert outcome.samples.sum() == 0
    assert outcome.cells.sum() > 500
    assert (outcome.event == NOTHING).all()


# -- partitions -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("isovalues", [(), (0.7,), (0.93, 0.95)])
def test_bricks_change_no_bit(isovalues):
    volume = Volume(noise(50, 41, 27), (0.5, 1.0, 1.5), (-3.0, 2.0, 0.25), replace(SPIKY, unit=30.0), isovalues)
    rng = generator(7, "bricks")
    rays = hard_rays(volume, rng)
    n = len(rays["reach"])
    one = tracked(volume, rays)
    assert len(np.unique(one.event)) == 2 + bool(isovalues)
    for count in (2, 9, 40):
        many = tracked(volume, rays, kd_bricks(volume, count, rng))
        t = many.t.reshape(n, count)
        first = np.arange(n) * count + t.argmin(axis=1)
        assert (many.t[first] == one.t).all()
        assert (many.event[first] == one.event).all()
        assert np.array_equal(many.value[first], one.value, equal_nan=True)
        through = one.event == NOTHING
        assert (many.samples.reshape(n, count).sum(axis=1) == one.samples)[through].all()
        assert (many.cells.reshape(n, count).sum(axis=1) == one.cells)[through].all()


def test_a_brick_that_ends_within_a_macro_cell_is_refused():
    with pytest.raises(
        SceneError, match=r"the brick \[0, 32, 0, 9, 0, 32\] does not fit a volume of 32 x 32 x 32 cells"
    ):
        tracked(ramp(CLEAR), along_x(3), np.array([[0, 32, 0, 9, 0, 32]], np.int32))


def test_a_ray_followed_from_brick_to_brick_takes_the_samples_of_one_brick():
    volume = Volume(noise(50, 41, 27), (0.5, 1.0, 1.5), (-3.0, 2.0, 0.25), SPIKY, (0.97,))
    rng = generator(8, "bricks")
    rays = {name: column[:800] for name, column in hard_rays(volume, rng).items()}  # those in general position
    bricks = kd_bricks(volume, 12, rng)
    g, d = (rays["origin"].astype(float) - volume.origin) / volume.spacing, rays["direction"] / np.array(volume.spacing)
    t = (bricks.reshape(12, 3, 2)[None] - g[:, None, :, None]) / d[:, None, :, None]
    order = np.argsort(t.min(axis=-1).max(axis=-1), axis=1)
    one, many = tracked(volume, rays), tracked(volume, rays, bricks)
    event = np.take_along_axis(many.event.reshape(800, 12), order, axis=1) != NOTHING
    samples = np.take_along_axis(many.samples.reshape(800, 12), order, axis=1)
    up_to = np.cumsum(event, axis=1) - event == 0
    assert ((samples * up_to).sum(axis=1) == one.samples).all()


# -- isosurfaces ------------------------------------------------------------------------------------------------------


def test_an_isosurface_of_a_ramp_lies_where_it_must():
    volume = ramp(CLEAR, isovalues=(0.3, 0.8))
    rays = bundle([[-1.0, 3.3, 4.4], [40.0, 3.3, 4.4], [16.0, 9.0, 9.0]], [[1.0, 0, 0], [-1.0, 0, 0], [-0.6, 0.8, 0.0]])
    outcome = tracked(volume, rays)
    assert (outcome.event == ISOSURFACE).all()
    assert outcome.t == pytest.approx([1.0 + 9.6, 8.0 + 6.4, (16.0 - 9.6) / 0.6], rel=1e-6)
    assert outcome.value == pytest.approx([0.3, 0.8, 0.3])


def trilinear(volume, points):
    """The field at points in grid coordinates, float64, by the plain definition."""
    cell = np.clip(np.floor(points).astype(int), 0, np.array(volume.cells) - 1)
    f = points - cell
    total = np.zeros(points.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, f, 1.0 - f), axis=-1)
        x, y, z = np.moveaxis(cell + corner, -1, 0)
        total += weight * volume.voxels[z, y, x]
    return total


def test_isosurfaces_of_noise_are_where_dense_sampling_finds_the_first_change():
    volume = Volume(noise(17, 17, 17), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), CLEAR, (0.75,))
    n, step = 400, 2e-3
    rng = generator(9, "rays")
    origin = 1.0 + rng.random((n, 3)) * 14.0
    direction = rng.standard_normal((n, 3))
    rays = bundle(origin, direction / np.linalg.norm(direction, axis=1, keepdims=True), 6.0)
    outcome = tracked(volume, rays)
    t = np.arange(0.0, 6.0, step)
    points = rays["origin"][:, None].astype(float) + t[:, None] * rays["direction"][:, None].astype(float)
    within = ((points >= 0.0) & (points <= 16.0)).all(axis=-1)
    above = trilinear(volume, points) >= 0.75
    change = (above[:, 1:] != above[:, :-1]) & within[:, 1:]
    found = np.where(change.any(axis=1), t[change.argmax(axis=1)], np.inf)
    hit = np.isfinite(outcome.t)
    same = np.isclose(outcome.t, found, rtol=0.0, atol=step)
    # Two crossings closer than a step are missed by sampling, never by solving.
    assert (outcome.t[~same] < found[~same]).all()
    assert same.mean() > 0.99
    assert 0.3 < hit.mean() < 0.7
    at = rays["origin"][hit].astype(float) + outcome.t[hit, None].astype(float) * rays["direction"][hit].astype(float)
    assert trilinear(volume, np.clip(at, 0.0, 16.0)) == pytest.approx(0.75, abs=1e-5)


@pytest.mark.parametrize("levels", [0, 1, 3])
def test_no_ray_leaves_a_closed_isosurface(levels):
    """From inside there is no way out, through faces, edges and vertices too, and over plateaus at the isovalue."""
    voxels = noise(26, 26, 26)
    iso = np.float32(0.3)
    if levels:
        voxels = np.ceil(voxels * levels) * iso
    for face in (0, -1):
        voxels[face], voxels[:, face], voxels[:, :, face] = 0.0, 0.0, 0.0
    volume = Volume(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), CLEAR, (iso,))
    rng = generator(10, "inside")
    z, y, x = np.nonzero(voxels >= iso)
    start = np.column_stack([x, y, z])[rng.integers(0, len(x), 30_000)].astype(float)
    target = rng.integers(0, 51, (30_000, 3)) / 2.0  # vertices, and middles of edges, faces and cells
    target[::2] = rng.random((15_000, 3)) * 25.0
    target[::7] = start[::7] + rng.choice([-4.0, 0.0, 4.0], (len(target[::7]), 3))
    direction = target - start
    direction[~direction.any(axis=1)] = [0.0, 0.0, -1.0]
    rays = bundle(start, direction / np.linalg.norm(direction, axis=1, keepdims=True))
    assert (tracked(volume, rays).event == ISOSURFACE).all()


def test_the_field_meets_its_corners_exactly_and_never_leaves_their_range():
    rng = generator(11, "corners")
    for place in np.vstack([rng.random((300, 3)), rng.random((300, 3)) * 1e-15, 1.0 - rng.random((300, 3)) * 1e-15]):
        corners = np.nextafter(rng.random(), [0.0, 1.0])[rng.integers(0, 2, 8)]
        assert corners.min() <= _field(corners, *place) <= corners.max()
    corners = rng.random(8)
    assert [_field(corners, *map(float, (i & 1, i >> 1 & 1, i >> 2))) for i in range(8)] == corners.tolist()


def test_a_surface_that_a_ray_only_dips_into_is_found():
    # Along the diagonal of its only cell's face the field is 4 s (1 - s) / 2: at most 0.5, in the middle.
    voxels = np.zeros((2, 2, 2))
    voxels[:, 0, 1] = voxels[:, 1, 0] = 1.0
    way = np.array([1.0, 1.0, 0.0]) / math.sqrt(2.0)
    rays = bundle(np.array([0.0, 0.0, 0.5]) - way, [way])
    for iso, expected in ((0.4999, 0.5 - math.sqrt(0.25 - 0.4999 / 2.0)), (0.5001, np.inf)):
        outcome = tracked(Volume(voxels, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), CLEAR, (iso,)), rays)
        assert outcome.t[0] == pytest.approx(1.0 + expected * math.sqrt(2.0), rel=1e-5)


def test_the_nearer_of_collision_and_isosurface_wins():
    fog = medium(0.1)
    foggy, clear = (tracked(ramp(t, isovalues=(0.5,)), along_x(5_000)) for t in (fog, CLEAR))
    alone = tracked(ramp(fog), along_x(5_000))
    assert clear.t == pytest.approx(17.0)
    assert (foggy.t == np.minimum(alone.t, clear.t)).all()
    assert (foggy.event == np.where(alone.t < 17.0, SCATTER, ISOSURFACE)).all()


def test_a_reach_ends_before_what_lies_beyond():
    outcome = tracked(ramp(medium(1e3), isovalues=(0.5,)), bundle([[-1.0, 4.0, 4.0]] * 2, [[1.0, 0, 0]], 0.999))
    assert (outcome.event == NOTHING).all()
    assert tracked(ramp(CLEAR, isovalues=(0.5,)), along_x(2, reach=16.9)).event.tolist() == [NOTHING] * 2
    assert tracked(ramp(CLEAR, isovalues=(0.5,)), along_x(2, reach=17.1)).event.tolist() == [ISOSURFACE] * 2


@pytest.mark.parametrize("factor", [2.0**-20, 2.0**20])
def test_a_scene_of_any_size_has_the_same_events(factor):
    volume = Volume(noise(20, 20, 20), (1.0, 0.5, 1.0), (1.0, 2.0, 3.0), SPIKY, (0.9,))
    rays = hard_rays(volume, generator(1, "rays"), 100)
    large = rays | {"origin": rays["origin"] * np.float32(factor)}
    one, other = tracked(volume, rays), tracked(volume.scaled(factor), large)
    assert (one.event == other.event).all()
    assert one.t * factor == pytest.approx(other.t, rel=1e-6)
    assert (one.cells == other.cells).all()


def test_isotropic_directions_are_unit_and_even():
    u = generator(1, "u").random((20_000, 2))
    d = np.array([isotropic_direction(a, b) for a, b in u])
    assert np.linalg.norm(d, axis=1) == pytest.approx(1.0)
    assert d.mean(axis=0) == pytest.approx(0.0, abs=4 / math.sqrt(3 * 20_000))
    assert (d**2).mean(axis=0) == pytest.approx(1 / 3, abs=4 * math.sqrt(4 / 45 / 20_000))
    assert isotropic_direction(0.0, 0.0)[2] == 1.0
