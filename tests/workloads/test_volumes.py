"""The synthesized volumes: their spectra, that they scale, and that they are as empty as the real ones."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from simrender.catalog import cards
from simrender.rays.workload import load_workload
from workloads.chameleon import AIR, BONE, BONE_SURFACE, FLESH, SKIN, chameleon
from workloads.dns import channel, speed
from workloads.turbulence import carried, gaussian, spectrum, velocity

ROOT = Path(__file__).parents[2]


@cache
def flow(n=64, seed=1):
    return velocity(seed, "flow", (n, n, n), largest=1.0, smallest=1.0)


def plane_spectrum(plane, low, high):
    """Return the slope of a plane's spectrum between two wave numbers in cycles a cell."""
    power = np.abs(np.fft.rfft2(plane - plane.mean())) ** 2
    power[:, 1:-1] *= 2.0
    k = np.hypot(np.fft.rfftfreq(plane.shape[1]), np.fft.fftfreq(plane.shape[0])[:, None])
    edges = np.geomspace(low, high, 6)
    energy = np.histogram(k, edges, weights=power)[0] / np.diff(edges)
    return np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(energy), 1)[0]


@pytest.mark.parametrize("seed", [1, 2])
def test_kinetic_energy_follows_kolmogorov(seed):
    energies = [spectrum(component) for component in flow(64, seed)]
    k, energy = energies[0][0], sum(e for _, e in energies)
    inertial = (k > 2.0 * np.pi * 3.5 / 64) & (k < 2.0)
    slope = np.polyfit(np.log(k[inertial]), np.log(energy[inertial]), 1)[0]
    assert slope == pytest.approx(-5.0 / 3.0, abs=0.1)


def test_the_spectrum_holds_the_variance():
    field = gaussian(3, "any", (48, 40, 32), largest=0.4, smallest=4.0)
    k, energy = spectrum(field)
    assert np.sum(energy) * (k[1] - k[0]) == pytest.approx(field.var(), rel=0.1)


def test_a_velocity_is_free_of_divergence_and_has_variance_1():
    field = flow().astype(np.float64)
    nz, ny, nx = field.shape[1:]
    kx, ky, kz = np.fft.rfftfreq(nx), np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nz)[:, None, None]
    modes = np.fft.rfftn(field, axes=(1, 2, 3))
    divergence = np.abs(kx * modes[0] + ky * modes[1] + kz * modes[2])
    length = np.sqrt(kx**2 + ky**2 + kz**2) * np.sqrt((np.abs(modes) ** 2).sum(axis=0))
    assert divergence.max() < 1e-5 * length.max()
    assert (field**2).mean(axis=(1, 2, 3)) == pytest.approx([1.0, 1.0, 1.0], abs=0.35)
    assert (field**2).mean() == pytest.approx(1.0, abs=0.15)


def test_a_finer_grid_shows_the_same_eddies():
    coarse, fine = gaussian(1, "eddies", (40, 30, 20)), gaussian(1, "eddies", (80, 60, 40))
    assert np.corrcoef(coarse.ravel(), fine[::2, ::2, ::2].ravel())[0, 1] > 0.9
    other_seed, other_name = gaussian(2, "eddies", (40, 30, 20)), gaussian(1, "other", (40, 30, 20))
    for other in (other_seed, other_name):
        assert abs(np.corrcoef(coarse.ravel(), other.ravel())[0, 1]) < 0.2


@pytest.mark.parametrize("dims", [(32, 32, 32), (31, 20, 9), (64, 12, 6)])
def test_fields_have_mean_0_and_about_variance_1(dims):
    field = gaussian(1, "field", dims, largest=0.4)
    assert field.shape == dims[::-1]
    assert field.mean() == pytest.approx(0.0, abs=1e-5)
    assert field.var() == pytest.approx(1.0, abs=0.25)


def test_stretched_structures_are_long():
    field = gaussian(1, "streaks", (96, 96, 8), largest=1.0, stretch=(6.0, 1.0, 1.0))
    change = [np.abs(np.diff(field, axis=axis)).mean() for axis in (2, 1)]
    assert change[1] > 3.0 * change[0]


def test_a_steady_wind_carries_a_field_by_whole_cells():
    field = gaussian(1, "field", (24, 20, 6))
    wind = np.zeros((3, *field.shape), np.float32)
    wind[0], wind[1] = 1.0, -1.0
    assert (carried(field, wind, reach=4.0) == np.roll(field, (4, -4), axis=(2, 1))).all()


def test_where_it_is_calm_nothing_moves_and_nothing_new_appears():
    field, wind = gaussian(1, "field", (24, 20, 12)), velocity(1, "wind", (24, 20, 12))
    calm = np.zeros(12)
    calm[6:] = 1.0
    moved = carried(field, wind, reach=6.0, calm=calm)
    assert (moved[:6] == field[:6]).all()
    assert (moved[6:] != field[6:]).mean() > 0.99
    assert moved.min() >= field.min()
    assert moved.max() <= field.max()


@cache
def channel_speed(points):
    return channel(points=points).volume.voxels


def test_the_channel_is_slow_at_its_walls_and_fast_in_its_core():
    field = channel_speed(128)
    profile = field.mean(axis=(1, 2))
    assert max(profile[0], profile[-1]) < 0.1
    assert profile[len(profile) // 2] > 0.8
    assert profile[: len(profile) // 2 + 1] == pytest.approx(profile[::-1][: len(profile) // 2 + 1], abs=0.1)


def test_the_channel_has_an_inertial_range():
    field = speed(1, (192, 144, 29))
    for plane in (2, 7, 21):
        assert plane_spectrum(field[plane], 0.06, 0.2) == pytest.approx(-5.0 / 3.0, abs=0.3)


def test_the_channel_is_intermittent():
    plane = channel_speed(128)[4]
    step = np.diff(plane, axis=0)
    assert (step**4).mean() / (step**2).mean() ** 2 > 5.0  # 3 for a Gaussian field


def test_streaks_lie_along_the_stream():
    plane = channel_speed(128)[1]
    plane = plane - plane.mean()
    alike = np.fft.irfft2(np.abs(np.fft.rfft2(plane)) ** 2, s=plane.shape)
    assert alike[0, 6] > 2.0 * alike[6, 0]


def test_statistics_of_the_channel_do_not_depend_on_the_scale():
    for measure, tolerance in ((np.mean, 0.06), (np.std, 0.05)):
        small, large = (measure(0.5 * (f[1:] + f[:-1])) for f in (channel_speed(64), channel_speed(128)))
        assert small == pytest.approx(large, abs=tolerance)
    depths = []
    for points in (64, 128):
        volume = channel(points=points).volume
        depths.append(float((volume.transfer.sigma(volume.voxels).sum(axis=0) * volume.spacing[2]).mean()))
    assert depths[0] == pytest.approx(depths[1], rel=0.15)


@pytest.mark.parametrize("points", [20, 33, 128])
def test_the_channel_has_the_published_shape(points):
    volume = channel(points=points).volume
    assert volume.dims[0] == points
    size = np.array(volume.dims) * volume.spacing
    assert size == pytest.approx([10240.0, 7680.0, 1536.0])
    assert np.ptp(volume.spacing) < 0.35 * max(volume.spacing)


@cache
def scan(points=96):
    return chameleon(points=points).volume


def test_most_of_the_chameleon_is_empty():
    for points in (48, 96):
        volume = scan(points)
        assert (volume.transfer.sigma(volume.voxels) > 0.0).mean() < 0.05
    hollow = (scan().macro.majorant == 0.0) & ~((scan().macro.low <= BONE_SURFACE) & (scan().macro.high > BONE_SURFACE))
    assert hollow.mean() > 0.6


def test_the_emptiness_of_the_chameleon_does_not_depend_on_the_scale():
    flesh = [(scan(points).voxels > SKIN).mean() for points in (64, 96)]
    assert flesh[0] == pytest.approx(flesh[1], rel=0.1)


def test_the_skin_is_closed_and_air_is_outside_and_in_the_lungs():
    from scipy.ndimage import label

    air = scan().voxels < SKIN
    regions, _ = label(air)
    outside = regions[0, 0, 0]
    border = np.concatenate([np.unique(regions[edge]) for edge in ((0,), (-1,))])
    assert set(border.tolist()) <= {0, outside}
    sizes = np.bincount(regions.ravel())[1:]
    assert (sizes > 200).sum() == 3  # outside and two lungs


def test_bones_lie_in_the_flesh():
    from scipy.ndimage import generate_binary_structure, minimum_filter

    voxels = scan().voxels
    bone = voxels > BONE_SURFACE
    assert 0.001 < bone.mean() < 0.02
    assert (minimum_filter(voxels, footprint=generate_binary_structure(3, 1))[bone] > SKIN).mean() > 0.8
    values = np.array([AIR, FLESH, BONE])
    nearest = np.abs(voxels[..., None] - values).min(axis=-1)
    assert (nearest < 0.06).mean() > 0.97  # all else is boundaries


def test_the_transfer_function_of_the_chameleon_is_spiky():
    transfer = scan().transfer
    assert (transfer.sigma([AIR, FLESH, 0.5]) == 0.0).all()
    assert (transfer.sigma([SKIN, BONE]) > 0.0).all()
    assert scan().isovalues == (BONE_SURFACE,)


def test_the_chameleon_has_the_published_shape():
    volume = scan(64)
    assert volume.dims == (64, 64, 68)
    assert np.array(volume.dims) * volume.spacing == pytest.approx([1024.0, 1024.0, 1080.0])


def test_the_same_seed_gives_the_same_voxels_in_every_process():
    script = (
        "from workloads.chameleon import chameleon; from workloads.dns import channel; "
        "print(channel(points=40).volume.key, chameleon(points=24).volume.key)"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-c", script]
    found = subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    assert found == [channel(points=40).volume.key, chameleon(points=24).volume.key]
    assert channel(points=40, seed=2).volume.key != found[0]
    assert chameleon(points=24, seed=2).volume.key != found[1]


def variants(name):
    return [name, *(f"{name}:{variant}" for variant in cards("workload")[name].document().variants)]


@pytest.mark.parametrize(
    ("name", "voxels", "size"),
    [
        ("dns", (10240, 7680, 1536), 483e9),
        ("dns-half", (5120, 3840, 768), 60.4e9),
        ("chameleon", (1024, 1024, 1080), 4.53e9),
    ],
)
def test_cards_state_the_published_size(name, voxels, size):
    for variant in variants(name):
        card = load_workload(variant).card
        assert card.published.voxels == voxels
        assert card.published.geometry_bytes == pytest.approx(size, rel=0.01)
        assert card.published.geometry_bytes == pytest.approx(4.0 * np.prod(np.array(voxels, float)), rel=0.01)
        assert card.integrator.name in {"volume_marching", "volume_path_tracing"}


def test_the_channel_is_seen_from_near_and_from_far():
    near, far = load_workload("dns").card.camera, load_workload("dns:far").card.camera
    assert np.linalg.norm(far.position) > 2.0 * np.linalg.norm(near.position)
    assert len(near.path) >= 4
    assert near.at(0.0).position == pytest.approx(near.position)
    assert not far.path
    # From far, every corner of the sheet is in view, and most of the image is not the sheet.
    frame = far.frame(1.0)
    corners = np.array([[x, y, z] for x in (0, 10240) for y in (0, 7680) for z in (0, 1536)]) - frame[0]
    depth = corners @ frame[1]
    across, up = (corners @ frame[i] / depth / (frame[i] @ frame[i]) for i in (2, 3))
    assert (np.abs(np.stack([across, up])) < 1.0).all()
