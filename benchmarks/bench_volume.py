"""The volume kernels against plain loops that do the same look-ups and keep no books: no bricks, reach or events.

A plain loop takes one brick over the whole volume, on the same cores in the same chunks. Each comparison asserts that
both took the same samples.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from simrender.rays import embree
from simrender.rays.compositing import composite
from simrender.rays.marching import march
from simrender.rays.sampling import path_key, uniform
from simrender.rays.tracking import track
from simrender.rays.volume import MACRO, TransferFunction, Volume
from workloads.terrain import generator

N = 128
STEP = 0.5
IMAGE = 256


def scene(opacity=1.0, isovalues=()):
    """A smooth field under a transfer function of eight control points, some of them clear; and camera rays."""
    rng = generator(1, "bench")
    x = np.linspace(-1.0, 1.0, N + 1)
    field = x[:, None, None] ** 2 + 1.3 * x[None, :, None] ** 2 + 0.4 * np.sin(5.0 * x)
    field = (field - field.min()) / (field.max() - field.min())
    opacities = opacity * np.array([0.0, 0.01, 0.02, 0.0, 0.05, 0.003, 0.02, 0.01])
    transfer = TransferFunction(np.linspace(0.0, 1.0, 8), rng.random((8, 3)), opacities)
    volume = Volume(field, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0), transfer, isovalues)
    j, i = np.divmod(np.arange(IMAGE * IMAGE), IMAGE)
    origin = np.tile([-100.0, 30.0, -150.0], (len(i), 1))
    direction = np.column_stack([(i + 0.5) * N / IMAGE, (j + 0.5) * N / IMAGE, np.full(len(i), N / 2)]) - origin
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    rays = {
        "origin": origin.astype(np.float32),
        "direction": direction.astype(np.float32),
        "reach": np.full(len(i), np.inf, np.float32),
    }
    keys = rng.integers(0, 2**64, len(i), dtype=np.uint64)
    cells = np.tile(np.array([[0, N] * 3], np.int32), (len(i), 1))
    return volume, rays, keys, np.arange(len(i)), cells


@njit(nogil=True, error_model="numpy")
def trilinear(voxels, x, y, z):
    ix, iy, iz = min(int(x), N - 1), min(int(y), N - 1), min(int(z), N - 1)
    fx, fy, fz = x - ix, y - iy, z - iz
    a = voxels[iz, iy, ix] * (1 - fx) + voxels[iz, iy, ix + 1] * fx
    b = voxels[iz, iy + 1, ix] * (1 - fx) + voxels[iz, iy + 1, ix + 1] * fx
    c = voxels[iz + 1, iy, ix] * (1 - fx) + voxels[iz + 1, iy, ix + 1] * fx
    d = voxels[iz + 1, iy + 1, ix] * (1 - fx) + voxels[iz + 1, iy + 1, ix + 1] * fx
    return (a * (1 - fy) + b * fy) * (1 - fz) + (c * (1 - fy) + d * fy) * fz


@njit(nogil=True, error_model="numpy")
def control_point(values, value):
    k = 0
    while k + 2 < len(values) and value >= values[k + 1]:
        k += 1
    return k


@njit(nogil=True, error_model="numpy")
def slab(o, d):
    near, far = 0.0, np.inf
    for a in range(3):
        t0, t1 = -o[a] / d[a], (N - o[a]) / d[a]
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    return near, far


@njit(nogil=True, error_model="numpy")
def plain_march(voxels, values, sigmas, colors, origin, direction, image):
    samples = 0
    for ray in range(len(origin)):
        o, d = origin[ray].astype(np.float64), direction[ray].astype(np.float64)
        near, far = slab(o, d)
        through = 1.0
        for i in range(math.ceil(near / STEP - 0.5), math.floor(far / STEP - 0.5) + 1):
            t = (i + 0.5) * STEP
            value = trilinear(voxels, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
            samples += 1
            k = control_point(values, value)
            f = (value - values[k]) / (values[k + 1] - values[k])
            weight = through * (1.0 - math.exp(-STEP * (sigmas[k] + f * (sigmas[k + 1] - sigmas[k]))))
            through -= weight
            for c in range(3):
                image[ray, c] += weight * (colors[k, c] + f * (colors[k + 1, c] - colors[k, c]))
            if through <= 0.01:
                break
        image[ray, 3] = 1.0 - through
    return samples


@njit(nogil=True, error_model="numpy")
def plain_track(voxels, values, sigmas, majorants, origin, direction, keys, collision):
    m = majorants.shape[0]
    samples = 0
    c, step, following, delta = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(3)
    for ray in range(len(origin)):
        o, d = origin[ray].astype(np.float64), direction[ray].astype(np.float64)
        at, far = slab(o, d)
        if at >= far:
            continue
        for a in range(3):
            c[a] = min(max(int((o[a] + at * d[a]) / MACRO), 0), m - 1)
            step[a] = 1 if d[a] > 0 else -1
            following[a] = ((c[a] + (d[a] > 0)) * MACRO - o[a]) / d[a]
            delta[a] = MACRO / abs(d[a])
        while True:
            axis = 0 if following[0] <= following[1] else 1
            axis = axis if following[axis] <= following[2] else 2
            majorant = majorants[c[2], c[1], c[0]]
            if majorant > 0.0:
                key, t, draw = path_key(keys[ray], (c[2] * m + c[1]) * m + c[0], 0, 0), at, 0
                while True:
                    t -= math.log(1.0 - uniform(key, draw)) / majorant
                    if t >= following[axis]:
                        break
                    samples += 1
                    value = trilinear(voxels, o[0] + t * d[0], o[1] + t * d[1], o[2] + t * d[2])
                    k = control_point(values, value)
                    f = (value - values[k]) / (values[k + 1] - values[k])
                    if uniform(key, draw + 1) * majorant < sigmas[k] + f * (sigmas[k + 1] - sigmas[k]):
                        collision[ray] = t
                        break
                    draw += 2
                if collision[ray] < np.inf:
                    break
            at = following[axis]
            following[axis] += delta[axis]
            c[axis] += step[axis]
            if c[axis] < 0 or c[axis] >= m:
                break
    return samples


def fastest(work, rounds=5):
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


def compare(benchmark, name, kernel, plain):
    """Time the kernel and the plain loop in turns, and print what they make of the same samples."""
    samples = plain()
    outcome = kernel()
    assert outcome.samples.sum() == samples
    slow = fastest(plain)
    benchmark.pedantic(kernel, rounds=5, warmup_rounds=1)
    fast = fastest(kernel)
    benchmark.extra_info["plain_over_kernel"] = slow / fast
    rates = f"{samples / fast / 1e6:.1f} Msamples/s, {slow / fast:.2f} of the plain loop's rate"
    print(f"\n{name}: {samples} samples, {len(outcome.samples) / fast / 1e6:.2f} Mray/s, {rates}")
    return outcome


@pytest.mark.parametrize("shading", [False, True])
def test_marching(benchmark, shading):
    volume, rays, _, row_ray, row_cells = scene()
    transfer = volume.transfer
    tables = volume.voxels, transfer.values, transfer.extinction, transfer.colors
    image = np.zeros((len(row_ray), 4))

    def plain():
        image[:] = 0.0
        work = lambda rows: plain_march(*tables, rays["origin"][rows], rays["direction"][rows], image[rows])  # noqa: E731
        return sum(embree.in_chunks(work, len(row_ray)))

    def kernel():
        return march(volume, STEP, rays, row_ray, row_cells, shading=shading)

    outcome = compare(benchmark, f"marching{' shaded (the plain loop is not)' * shading}", kernel, plain)
    assert outcome.rgba[:, 3] == pytest.approx(image[:, 3], abs=1e-5)
    assert shading or outcome.rgba == pytest.approx(image, abs=1e-5)


@pytest.mark.parametrize("scale", [1.0, 10.0, 100.0])
def test_tracking(benchmark, scale):
    volume, rays, keys, row_ray, row_cells = scene()
    tables = volume.voxels, volume.transfer.values, volume.transfer.extinction, volume.macro.majorant * scale
    collision = np.empty(len(row_ray))

    def plain():
        collision[:] = np.inf
        work = lambda rows: plain_track(  # noqa: E731
            *tables, rays["origin"][rows], rays["direction"][rows], keys[rows], collision[rows]
        )
        return sum(embree.in_chunks(work, len(row_ray)))

    def kernel():
        return track(volume, rays, keys, row_ray, row_cells, majorant_scale=scale)

    outcome = compare(benchmark, f"tracking, majorants x {scale:g}", kernel, plain)
    assert outcome.t == pytest.approx(collision, rel=1e-6)


def test_empty_space(benchmark):
    volume, rays, keys, row_ray, row_cells = scene(opacity=0.0)
    outcome = benchmark(track, volume, rays, keys, row_ray, row_cells)
    assert (outcome.samples.sum(), outcome.cells.sum()) == (0, 1569634)


def test_isosurfaces(benchmark):
    volume, rays, keys, row_ray, row_cells = scene(opacity=0.0, isovalues=(0.45,))
    outcome = benchmark(track, volume, rays, keys, row_ray, row_cells)
    assert (outcome.event > 0).sum() == 44006


def test_macro_cells(benchmark):
    volume = scene()[0]
    found = benchmark(lambda: replace(volume).macro)
    assert found.majorant.shape == (N // MACRO,) * 3


def test_compositing(benchmark):
    rng = generator(2, "fragments")
    n, rays = 1_000_000, IMAGE * IMAGE
    rgba, depth = rng.random((n, 4), np.float32), rng.random(n, np.float32)
    ray, domain = rng.integers(0, rays, n), rng.integers(0, 16, n)
    image = benchmark(composite, rgba, depth, ray, domain, rays)
    assert (image[:, 3] > 0).sum() == len(np.unique(ray))
