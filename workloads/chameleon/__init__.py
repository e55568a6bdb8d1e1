"""A stand-in for the CT scan of a chameleon: thin skin and dense bones in a block of which most is air.

The original (islands paper, section 6.2) has 1024 x 1024 x 1080 voxels of 32 bits. This one is modelled from a
thousand swept spheres (segments with a radius at either end): flesh, which blends where parts meet, and bones. Air,
flesh and bone have their own densities, so the skin is where the density rises between the first two, about as thin
as the grid resolves. The transfer function has two narrow spikes, skin and bone, and nothing between or beyond; the
surface of the bones is an implicit isosurface.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from simrender.rays.scene import F32, Environment, PointLight, Scene
from simrender.rays.volume import TransferFunction, Volume
from workloads.terrain import F64, generator, smoothstep, unit
from workloads.turbulence import Dims, gaussian

PUBLISHED: Dims = (1024, 1024, 1080)
AIR, FLESH, BONE = 0.02, 0.36, 0.90
SKIN = 0.5 * (AIR + FLESH)
BONE_SURFACE = 0.60
"""Densities; the last two are where the transfer function's spikes stand."""

# The animal's own units are 1024 published voxels: z along the body with the head up, x towards its back, y across.
SPINE = np.array(
    [(0.86, 0.60), (0.80, 0.625), (0.72, 0.67), (0.64, 0.70), (0.55, 0.705), (0.46, 0.675), (0.39, 0.62), (0.33, 0.565)]
)
SLAB = 48
"""Planes that are computed at a time, to save memory."""

CURL, CURL_RADIUS, CURL_FROM, CURL_TURNS = (0.205, 0.405), 0.2, 0.29 * np.pi, 2.1


@dataclass(frozen=True, eq=False)
class Sweep:
    """A sphere swept along a segment.

    Attributes
    ----------
    a, b : (x, y, z)
    ra, rb : float
        Radius at either end.
    flat : float
        How many times narrower than high it is across the body.

    """

    a: Sequence[float] | F64
    b: Sequence[float] | F64
    ra: float
    rb: float
    flat: float = 1.0


def chameleon(*, seed: int = 1, points: int = 144) -> Scene:
    """Generate the scan.

    Parameters
    ----------
    seed : int
    points : int
        Voxels along x and y; there are 1080 / 1024 times as many along z.

    Returns
    -------
    Scene
        A volume; one unit of length is a published voxel. The head is towards positive z, the back towards positive x.

    """
    dims = (points, points, max(2, round(points * PUBLISHED[2] / PUBLISHED[0])))
    spacing = (PUBLISHED[0] / dims[0], PUBLISHED[1] / dims[1], PUBLISHED[2] / dims[2])
    transfer = TransferFunction(
        values=np.array([0.0, SKIN - 0.07, SKIN, SKIN + 0.07, 0.62, 0.72, 1.0]),
        colors=np.array([(0.3, 0.5, 0.2)] * 2 + [(0.5, 0.78, 0.3)] * 2 + [(0.9, 0.86, 0.72)] * 3),
        opacities=np.array([0.0, 0.0, 0.03, 0.0, 0.0, 0.25, 0.25]),
    )
    volume = Volume(density(seed, dims), spacing, (0.0, 0.0, 0.0), transfer, (BONE_SURFACE,), ((0.93, 0.89, 0.78),))
    lamp = PointLight((3000.0, -2600.0, 1800.0), (2.4e8, 2.3e8, 2.1e8))
    sky = Environment(zenith=(0.4, 0.48, 0.6), horizon=(0.28, 0.33, 0.4), ground=(0.12, 0.12, 0.13), up=(1.0, 0.0, 0.0))
    return Scene(
        (), np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32), points=(lamp,), environment=sky, volume=volume
    )


def density(seed: int, dims: Dims) -> F32:
    """Return the scan, float32 (nz, ny, nx): about 0 in air, 0.36 in flesh, 0.9 in bone."""
    sides = 1.0, 1.0, PUBLISHED[2] / PUBLISHED[0]
    axes: list[F64] = [np.arange(n, dtype=np.float64) * (side / n) for n, side in zip(dims, sides, strict=True)]
    edge = max(1.0 / dims[0], 3.0 / PUBLISHED[0])  # half the thickness of the skin
    rough = gaussian(seed, "skin", dims, slope=1.0, largest=0.03, smallest=4.0)
    flesh, hollow, head, hard = flesh_parts(), lungs(), head_parts(), bones(seed)
    eyes = [Sweep((0.62, y, 0.905), (0.62, y, 0.905), 0.042, 0.042) for y in (0.44, 0.56)]
    rng, values = generator(seed, "noise"), np.empty(rough.shape, np.float32)
    for first in range(0, dims[2], SLAB):
        part = slice(first, first + SLAB)
        slab = [axes[0], axes[1], axes[2][part]]
        skin = swept(slab, flesh, 0.008) + np.float32(0.0016) * rough[part]
        inside = _inside(np.maximum(skin, -swept(slab, hollow, 0.01)), edge)
        # The skull is a shell under the skin of the head, open at the eyes.
        skull = np.maximum(np.abs(swept(slab, head, 0.008) + 0.016) - 0.0065, -swept(slab, eyes, 0.01))
        bone = _inside(np.minimum(swept(slab, hard, 0.003), skull), edge)
        value = AIR + (FLESH - AIR) * inside
        value += (BONE - value) * bone + 0.008 * rng.normal(size=value.shape) + 0.012 * rough[part] * inside
        values[part] = value
    return values


def swept(axes: Sequence[F64], parts: Sequence[Sweep], blend: float) -> F64:
    """Return the signed distance to swept spheres, blended over about ``blend``: float64 (nz, ny, nx).

    It is true near the surface only; farther away than four blends it is just large.
    """
    x, y, z = axes
    total = np.zeros((len(z), len(y), len(x)))
    for part in parts:
        a, b = np.asarray(part.a, np.float64), np.asarray(part.b, np.float64)
        around = max(part.ra, part.rb) + 6.0 * blend
        low, high = np.minimum(a, b) - around, np.maximum(a, b) + around
        box = tuple(slice(*np.searchsorted(axis, (low[d], high[d]))) for d, axis in ((2, z), (1, y), (0, x)))
        if any(side.start == side.stop for side in box):
            continue
        px, py, pz = x[box[2]], y[box[1]][:, None], z[box[0]][:, None, None]
        d = np.array([1.0, part.flat, 1.0]) * (b - a)
        rx, ry, rz = px - a[0], part.flat * (py - a[1]), pz - a[2]
        t = np.clip((rx * d[0] + ry * d[1] + rz * d[2]) / max(float(d @ d), 1e-12), 0.0, 1.0)
        gap = np.sqrt((rx - t * d[0]) ** 2 + (ry - t * d[1]) ** 2 + (rz - t * d[2]) ** 2)
        gap -= part.ra + (part.rb - part.ra) * t
        total[box] += np.exp(np.minimum(-gap / blend, 80.0))
    return np.asarray(-blend * np.log(np.maximum(total, 1e-9)), np.float64)


def backbone() -> tuple[F64, F64]:
    """Return points along the spine and the tail, float64 (n, 3), from the neck on, and how far each is down the tail.

    The second array is 0 along the trunk and rises to 1 at the tip of the tail.
    """
    t = np.linspace(0.0, len(SPINE) - 1.0, 29)
    trunk = np.stack([np.interp(t, np.arange(len(SPINE)), SPINE[:, axis]) for axis in (0, 1)], axis=1)
    s = np.linspace(0.0, 1.0, 90)[1:]
    angle = CURL_FROM + 2.0 * np.pi * CURL_TURNS * s**0.85
    radius = CURL_RADIUS * (1.0 - 0.9 * s**0.8)
    tail = np.stack([CURL[0] + radius * np.cos(angle), CURL[1] + radius * np.sin(angle)], axis=1)
    both = np.concatenate([trunk, tail])
    return np.stack([both[:, 1], np.full(len(both), 0.5), both[:, 0]], axis=1), np.concatenate([np.zeros(len(t)), s])


def head_parts() -> list[Sweep]:
    """Return the head: snout, brow and casque."""
    return [
        Sweep((0.60, 0.5, 0.86), (0.545, 0.5, 0.985), 0.075, 0.03, 1.25),
        Sweep((0.57, 0.5, 0.88), (0.52, 0.5, 0.97), 0.055, 0.022, 1.3),
        Sweep((0.65, 0.5, 0.87), (0.755, 0.5, 0.80), 0.05, 0.016, 1.5),
        Sweep((0.62, 0.5, 0.93), (0.70, 0.5, 0.85), 0.03, 0.03, 1.3),
    ]


def flesh_parts() -> list[Sweep]:
    """Return head, trunk, tail, legs and the crest of the back."""
    parts = [*head_parts()]
    parts += [Sweep((0.615, 0.5 + 0.062 * s, 0.905), (0.615, 0.5 + 0.085 * s, 0.91), 0.034, 0.018) for s in (-1, 1)]
    trunk = [(0.60, 0.83, 0.06), (0.60, 0.74, 0.095), (0.585, 0.64, 0.125), (0.575, 0.54, 0.13), (0.575, 0.45, 0.10)]
    trunk += [(0.575, 0.37, 0.06)]
    for (x0, z0, r0), (x1, z1, r1) in pairwise(trunk):
        parts.append(Sweep((x0, 0.5, z0), (x1, 0.5, z1), r0, r1, 1.7))
    points, down = backbone()
    for i in range(len(points) - 1):
        thick = 0.03 if down[i + 1] == 0.0 else 0.036 * (1.0 - 0.85 * down[i])
        thin = 0.03 if down[i + 1] == 0.0 else 0.036 * (1.0 - 0.85 * down[i + 1])
        parts.append(Sweep(points[i], points[i + 1], thick, thin))
    for i in range(4, 40):
        out = _outward(points, i)
        parts.append(Sweep(points[i] + 0.028 * out, points[i] + 0.047 * out, 0.008, 0.003))
    for joints, radii in _legs():
        parts += [Sweep(a, b, 2.3 * ra, 2.3 * rb) for a, b, ra, rb in _segments(joints, radii)]
    return parts


def lungs() -> list[Sweep]:
    """Return the air inside the trunk."""
    return [Sweep((0.61, 0.5 + s, 0.74), (0.61, 0.5 + s, 0.56), 0.034, 0.044, 1.6) for s in (-0.038, 0.038)]


def bones(seed: int) -> list[Sweep]:
    """Return vertebrae, ribs, jaws, girdles and the bones of the legs."""
    points, down = backbone()
    parts = []
    rng = generator(seed, "bones")
    for i in range(len(points) - 1):
        size = 0.0125 if down[i] == 0.0 else 0.0125 * (1.0 - 0.8 * down[i])
        out, step = _outward(points, i), points[i + 1] - points[i]
        gap = 0.22 * step
        parts.append(Sweep(points[i] + gap, points[i + 1] - gap, size, size * 0.9))
        length = size * (1.9 + 0.3 * float(rng.random()))
        parts.append(Sweep(points[i] + 0.4 * step, points[i] + 0.4 * step + length * out, 0.4 * size, 0.22 * size))
        for side in (-1.0, 1.0):
            across = np.array([0.0, side * 1.7 * size, 0.0])
            parts.append(Sweep(points[i] + 0.5 * step, points[i] + 0.5 * step + across, 0.35 * size, 0.2 * size))
    for i in range(5, 24):
        depth = 0.20 * float(np.sin(np.pi * (i - 2) / 25.0)) + 0.02
        for side in (-1.0, 1.0):
            around = np.pi * np.linspace(0.0, 0.86, 8)
            x = points[i, 0] - 0.5 * depth * (1.0 - np.cos(around))
            y = 0.5 + side * 0.30 * depth * np.sin(around)
            z = points[i, 2] - 0.02 * around / np.pi
            rib = np.stack([x, y, z], axis=1)
            thick: F64 = 0.0076 * (1.0 - 0.06 * np.arange(8.0))
            parts += [Sweep(a, b, ra, rb) for a, b, ra, rb in _segments(rib, thick)]
    for side in (-1.0, 1.0):
        jaw = np.array([(0.545, 0.5 + 0.045 * side, 0.845), (0.515, 0.5 + 0.035 * side, 0.91), (0.505, 0.5, 0.985)])
        parts += [Sweep(a, b, ra, rb) for a, b, ra, rb in _segments(jaw, np.array([0.013, 0.012, 0.009]))]
    for joints, radii in _legs():
        parts += [Sweep(a, b, ra, rb) for a, b, ra, rb in _segments(joints, radii)]
        if len(joints) == 4:  # the girdle, from the spine to the first joint
            nearest = points[np.argmin(((points - joints[0]) ** 2).sum(axis=1))]
            parts.append(Sweep(nearest, joints[0], 0.008, 0.013))
    return parts


def _legs() -> Iterator[tuple[F64, F64]]:
    """Yield joints and radii of the bones of each leg, and then of the toes at its end."""
    plans = (
        ((0.575, 0.055, 0.755), (0.465, 0.115, 0.70), (0.37, 0.10, 0.765), (0.325, 0.095, 0.775)),
        ((0.57, 0.05, 0.405), (0.455, 0.125, 0.475), (0.36, 0.105, 0.41), (0.315, 0.10, 0.42)),
    )
    for plan in plans:
        for side in (-1.0, 1.0):
            joints = np.array([(x, 0.5 + side * y, z) for x, y, z in plan])
            yield joints, np.array([0.0125, 0.010, 0.009, 0.009])
            for toward, spread in ((0.07, 3), (-0.07, 2)):  # toes in two bundles, a pair of tongs
                for k in range(spread):
                    away = side * 0.014 * (k - (spread - 1) / 2.0)
                    root = joints[3]
                    middle = root + np.array([-0.018, away, 0.6 * toward])
                    tip = root + np.array([-0.05, 1.4 * away, 0.95 * toward])
                    yield np.stack([root, middle, tip]), np.array([0.0062, 0.0055, 0.0035])


def _segments(joints: F64, radii: F64) -> Iterator[tuple[F64, F64, float, float]]:
    for i in range(len(joints) - 1):
        yield joints[i], joints[i + 1], float(radii[i]), float(radii[i + 1])


def _outward(points: F64, i: int) -> F64:
    """Return the direction away from the belly at a point of the backbone, at right angles to it."""
    along = unit(points[min(i + 1, len(points) - 1)] - points[max(i - 1, 0)])
    return np.asarray(np.cross(along, np.array([0.0, 1.0, 0.0])) * np.array([1.0, 0.0, 1.0]), np.float64)


def _inside(distance: F64, edge: float) -> F64:
    """Return 1 well inside a surface, 0 well outside, and between them a smooth rise across ``2 edge``."""
    return smoothstep(edge, -edge, distance)
