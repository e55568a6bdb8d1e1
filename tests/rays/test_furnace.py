"""Energy is neither made nor lost: furnaces, and direct light with a closed form."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from simrender.accuracy.furnace import (
    ASIDE,
    FOREVER,
    FURNACES,
    WHITE,
    Furnace,
    ball,
    camera,
    cloud,
    furnaces,
    image,
    of,
    plane,
)
from simrender.rays.integrators import AmbientOcclusion, PathTracing, SprayPathTracing, VolumePathTracing
from simrender.rays.scene import Material, Scene
from tests.scenes import garden

EXACT = {
    "white spheres under a white sky",
    "the same, half of them mirrors",
    "ambient occlusion of a floor",
    "white cloud under a white sky",
    "the same with an isosurface",
    "the same with a sphere in it",
}
PRECISE = {"floor under a point light", "SpRay: floor under a point light", "SpRay: floor under a diffuse light"}
NOISY = {"grey enclosure, E / (1 - rho)", "floor under a square lamp", "fog in the sun, scattered once"}
LOSSY = {"the same, smooth"}
MARCHED = {"white cloud, marched"}


@pytest.fixture(scope="module")
def table() -> dict[str, Furnace]:
    return {row.what: row for row in furnaces(32, 4)}


def test_every_furnace_is_in_the_table(table):
    assert set(table) == set(FURNACES) == EXACT | PRECISE | NOISY | LOSSY | MARCHED


@pytest.mark.parametrize("what", sorted(EXACT))
def test_a_white_furnace_cannot_be_told_from_its_background(table, what):
    assert table[what].largest == 0.0
    assert table[what].mean == 1.0


@pytest.mark.parametrize("what", sorted(PRECISE))
def test_light_without_noise_is_that_of_the_closed_form(table, what):
    row = table[what]
    assert row.largest <= 3e-5 * row.expected


@pytest.mark.parametrize("what", sorted(NOISY))
def test_noisy_light_has_the_mean_of_the_closed_form(table, what):
    row = table[what]
    assert 0.0 < row.standard_error < 0.02 * row.expected
    assert abs(row.mean - row.expected) <= 3.5 * row.standard_error


def test_a_white_cloud_that_is_marched_is_as_bright_as_what_it_hides(table):
    assert table["white cloud, marched"].largest < 1e-6


def test_smooth_normals_lose_little(table):
    """Mixed normals send some rays to the inner side of a closed surface, where a few stay."""
    assert 0.995 < table["the same, smooth"].mean <= 1.0


def white_garden(mirror=0.5):
    material = Material((1.0, 1.0, 1.0), mirror)
    return dataclasses.replace(garden(), materials=(material,) * 3, points=(), environment=WHITE)


GARDEN = camera((5.5, -5.0, 3.0), (-5.5, 5.0, -2.6), 0.5)


@pytest.mark.parametrize("mirror", [0.0, 0.5, 1.0])
def test_white_furnace_with_a_whole_garden_in_it(mirror):
    seen = image(white_garden(mirror), GARDEN, PathTracing(FOREVER, FOREVER, 0.0), 40, 2)
    assert np.abs(seen - 1.0).max() < 1e-6


@pytest.mark.parametrize("roulette", [0.4, 1.0])
def test_white_furnace_whatever_the_roulette(roulette):
    # Throughput stays at 1, so even a roulette that asks for all of it ends no path.
    seen = image(white_garden(), GARDEN, PathTracing(FOREVER, FOREVER, roulette), 24, 2)
    assert np.abs(seen - 1.0).max() < 1e-6


@pytest.mark.parametrize("roulette", [0.0, 0.3, 0.9])
def test_grey_furnace_whatever_the_roulette(roulette):
    # Every path from inside a closed sphere of albedo 1/2 that emits 1 brings 1 + 1/2 + 1/4 ... = 2.
    enclosure = of(ball(8), materials=(Material((0.5,) * 3, 0.0, (1.0,) * 3),))
    seen = image(enclosure, camera((0.1, -0.2, 0.0), (0.2, 1.0, 0.1), 1.0), PathTracing(60, 60, roulette), 24, 32)
    error = float(seen.mean(axis=2).std()) / 24
    assert seen.mean() == pytest.approx(2.0, abs=4.0 * error)


def test_fewer_bounces_see_the_first_terms_of_the_series():
    # Mirrors see the emission at every bounce, without noise.
    enclosure = of(ball(8), materials=(Material((0.5,) * 3, 1.0, (1.0,) * 3),))
    inside = camera((0.1, -0.2, 0.0), (0.2, 1.0, 0.1), 1.0)
    for bounces in range(5):
        seen = image(enclosure, inside, PathTracing(0, bounces, 0.0), 8, 1)
        assert seen == pytest.approx(2.0 - 0.5**bounces, rel=1e-6)


@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.99])
@pytest.mark.parametrize("roulette", [0.0, 1.0])
def test_white_furnace_with_a_cloud_from_thin_to_thick(opacity, roulette):
    scene = Scene((), np.zeros(0, np.int32), np.zeros((0, 3, 4)), environment=WHITE, volume=cloud(1.0, opacity))
    seen = image(scene, ASIDE, VolumePathTracing(FOREVER, roulette=roulette), 24, 2)
    # Of the thickest cloud a path may not be out after all its collisions.
    assert seen.max() == 1.0
    assert (seen == 1.0).mean() == 1.0 if opacity < 0.9 else (seen == 1.0).mean() > 0.99


def test_furnace_of_a_grey_cloud_is_between_black_and_white_and_keeps_its_mean_under_roulette():
    means = {}
    for roulette in (0.0, 0.8):
        scene = Scene((), np.zeros(0, np.int32), np.zeros((0, 3, 4)), environment=WHITE, volume=cloud(0.7))
        seen = image(scene, ASIDE, VolumePathTracing(FOREVER, roulette=roulette), 32, 16).mean(axis=2)
        means[roulette] = seen.mean(), seen.std() / 32
        assert 0.3 < seen.mean() < 1.0
    (one, e1), (other, e2) = means.values()
    assert abs(one - other) <= 4.0 * np.hypot(e1, e2)


def test_ambient_occlusion_in_a_closed_box_is_0_and_under_a_ceiling_the_sky_that_is_left():
    inside = camera((0.1, 0.2, 0.0), (0.3, 1.0, -0.4), 0.5)
    assert not image(of(ball(8)), inside, AmbientOcclusion(16), 16, 1).any()
    # A square ceiling of half side a at height h hides its form factor: 0.5541 for a = h (Howell's catalogue, B-3).
    room = of(plane(), plane(1.0, 1.0))
    down = camera((0.0, 0.0, 0.5), (0.0, 0.0, -1.0), 0.01)
    seen = image(room, down, AmbientOcclusion(64), 24, 4)
    assert seen.mean() == pytest.approx(1.0 - 0.5541, abs=4 * np.sqrt(0.25 / (24 * 24 * 256)))
    near = image(room, down, AmbientOcclusion(16, distance=0.99), 8, 1)
    assert (near == 1.0).all()


def test_furnace_of_sprays_path_tracing_adds_a_bounce_at_a_time():
    # Convention: a hit takes pi times albedo from the diffuse light that reaches it, and passes on albedo to the next.
    # In the middle of a wide white valley, light of radiance 1 from above: only an open floor has a closed form.
    for bounces in (1, 3):
        scene = of(plane(), materials=(Material((0.5,) * 3),), hemispheres=((1.0, 1.0, 1.0),))
        model = SprayPathTracing(shadow_samples=4, bounces=bounces, specular=0.0)
        seen = image(scene, camera((0, 0, 1.0), (0, 0, -1), 1.0), model, 8, 2)
        assert seen == pytest.approx(0.5 * np.pi, rel=1e-6)
