"""A stand-in for the turbulent channel flow that the papers call DNS: a sheet of 10240 x 7680 x 1536 voxels.

The original is a direct numerical simulation of the flow between two walls. This one is synthesized: the speed along x
that fluid has at its distance from the wall, with streaks along the stream close to the walls, is carried by a random
velocity with Kolmogorov's spectrum that dies away towards the walls. Slow fluid is swept from the walls into the fast
core, as the bursts of a real channel do. A finer grid shows smaller eddies, as a higher Reynolds number does.
"""

from __future__ import annotations

import numpy as np

from simrender.rays.scene import F32, Environment, PointLight, Scene
from simrender.rays.volume import TransferFunction, Volume
from workloads.fields import even_planes, level_leaving_empty, surface_scene
from workloads.terrain import F64
from workloads.turbulence import Dims, carried, gaussian, velocity

PUBLISHED: Dims = (10240, 7680, 1536)

BLUE_TO_RED = [(0.08, 0.14, 0.55), (0.10, 0.32, 0.82), (0.30, 0.66, 0.92), (0.86, 0.9, 0.9), (0.95, 0.7, 0.32)]
BLUE_TO_RED += [(0.95, 0.7, 0.32), (0.9, 0.36, 0.1), (0.72, 0.06, 0.02), (0.45, 0.0, 0.0)]
SPEEDS = [-0.2, 0.2, 0.45, 0.62, 0.74, 0.97, 1.03, 1.1, 1.2]
OPACITIES = [0.003, 0.005, 0.006, 0.001, 0.0, 0.0, 0.002, 0.01, 0.02]
"""Opacities of one published voxel: slow fluid near the walls and fast fluid in the core show, and nothing between."""

SKY = Environment(zenith=(0.62, 0.72, 0.9), horizon=(0.95, 0.95, 0.95), ground=(0.5, 0.48, 0.45))


def channel(*, seed: int = 1, points: int = 320) -> Scene:
    """Generate the channel as a volume of the speed along x.

    Parameters
    ----------
    seed : int
    points : int
        Voxels along x; along y and z there are as many as the published shape has for them.

    Returns
    -------
    Scene
        A volume. One unit of length is a published voxel, whichever version of the data is published: x along the
        stream, z from wall to wall.

    """
    dims = _dims(points)
    colors, opacities = np.array(BLUE_TO_RED), np.array(OPACITIES)
    transfer = TransferFunction(values=np.array(SPEEDS), colors=colors, opacities=opacities)
    volume = Volume(speed(seed, dims), _spacing(dims), (0.0, 0.0, 0.0), transfer)
    sun = PointLight((-4000.0, -9000.0, 16000.0), (2.2e9, 2.1e9, 1.9e9))
    nothing = np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32)
    return Scene((), *nothing, points=(sun,), environment=SKY, volume=volume)


def channel_surface(*, seed: int = 1, points: int = 240, half: bool = False) -> Scene:
    """Generate an isosurface of the speed in a uniform grid of domains, 20 x 12 x 6 of the whole channel.

    Parameters
    ----------
    seed : int
    points : int
        Grid points along x; the surface grows a little faster than their square.
    half : bool
        Only the lower half of the channel, 20 x 12 x 3 domains.

    Returns
    -------
    Scene
        1,427 domains, because the isovalue is the one that 13 of 1,440 do not reach; or 720 with ``half``, all of
        which it reaches. One unit of length is a published voxel.

    Raises
    ------
    SceneError
        If a domain would have less than a cell, or there is no such isovalue.

    """
    dims = _dims(points)
    voxels, counts, empty = speed(seed, dims), (20, 12, 6), 13
    if half:
        voxels = np.ascontiguousarray(voxels[: dims[2] // 2 + 1])
        counts, empty = (20, 12, 3), 0
    planes = even_planes((dims[0], dims[1], len(voxels)), counts)
    value = level_leaving_empty(voxels, planes, empty)
    palette = [(0.10, 0.22, 0.55), (0.25, 0.5, 0.75), (0.85, 0.82, 0.72), (0.85, 0.5, 0.2), (0.6, 0.15, 0.08)]
    return surface_scene(voxels, _spacing(dims), value, planes, palette=palette, environment=SKY)


def speed(seed: int, dims: Dims) -> F32:
    """Return the speed along x in a channel with walls at the lowest and highest z; about 1 in the core."""
    nx, ny, nz = dims
    beyond = (nx, ny, nz + nz // 4 + 2)  # synthesized fields repeat, and one wall must not repeat the other
    flow = velocity(seed, "flow", beyond, largest=0.6)[:, :nz]
    streaks = gaussian(seed, "streaks", beyond, largest=0.25, stretch=(5.0, 1.0, 1.0))[:nz]
    off_wall = 1.0 - np.abs(np.linspace(-1.0, 1.0, nz))
    calm: F64 = np.minimum(1.0, off_wall / 0.25)
    mean, near = off_wall ** (1.0 / 3.0), 0.22 * np.exp(-off_wall / 0.3)
    rest = (mean[:, None, None] + near[:, None, None] * streaks).astype(np.float32)
    swept = carried(rest, flow, reach=0.19 * nz, calm=calm)
    gusts = (0.06 * np.minimum(1.0, off_wall / 0.2))[:, None, None] * flow[0]
    return np.asarray(swept + gusts, np.float32)


def _dims(points: int) -> Dims:
    nx, ny, nz = PUBLISHED
    return points, max(2, round(points * ny / nx)), max(4, round(points * nz / nx))


def _spacing(dims: Dims) -> tuple[float, float, float]:
    return PUBLISHED[0] / dims[0], PUBLISHED[1] / dims[1], PUBLISHED[2] / dims[2]
