"""How exact the ways through volumes are: against closed forms, over many orders of magnitude.

Woodcock tracking must have the same distribution however loose its majorants are; marching must converge at first
order; the parts of an unstructured mesh must cover each ray's chord without gap or overlap; and fragments must blend to
one colour in whatever tree they are blended.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simrender.accuracy.partitions import bundle, generator
from simrender.rays.compositing import composite, over
from simrender.rays.element_marching import march_parts
from simrender.rays.elements import Elements
from simrender.rays.marching import march
from simrender.rays.tracking import NOTHING, track
from simrender.rays.volume import TransferFunction, Volume

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

SIDE = 32
"""Cells along each axis of the cube that is tracked and marched through."""


def haze(extinction: Sequence[float], values: Sequence[float] = (0.0,), color: float = 1.0) -> TransferFunction:
    """Return a transfer function of one colour and some extinctions per world length, at some values."""
    sigma = np.asarray(extinction, np.float64)
    unit = 1.0 / max(1.0, float(sigma.max()))  # so short that no slab of it is opaque to rounding
    return TransferFunction(np.asarray(values), np.full((len(sigma), 3), color), -np.expm1(-sigma * unit), unit)


def _cube(transfer: TransferFunction) -> Volume:
    """Return a cube whose values rise from 0 to 1 along x."""
    n = SIDE + 1
    return Volume(np.broadcast_to(np.linspace(0.0, 1.0, n), (n, n, n)), (1.0,) * 3, (0.0,) * 3, transfer)


# -- tracking ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tracking:
    """Free flights through a homogeneous medium.

    Attributes
    ----------
    tau : float
        Optical depth of the medium.
    looseness : float
        The majorant, in extinctions.
    rays : int
    passed, expected_passed : float
        Share of rays that meet nothing; exp(-tau).
    depth, expected_depth : float
        Mean optical depth that a ray covers before it collides or leaves; 1 - exp(-tau).
    standard_error : float
        Of ``depth``.
    look_ups : float
        Mean number of tentative collisions a ray.

    """

    tau: float
    looseness: float
    rays: int
    passed: float
    expected_passed: float
    depth: float
    expected_depth: float
    standard_error: float
    look_ups: float


def tracking(taus: Sequence[float], looseness: Sequence[float], budget: float = 1e6) -> list[Tracking]:
    """Track rays through media of some optical depths, with majorants that are some times too large.

    Parameters
    ----------
    taus, looseness : floats
    budget : float
        Look-ups that a case may take, about; it has 25 to 20,000 rays.

    """
    rows = []
    for tau in taus:
        volume = _cube(haze([tau / SIDE]))
        # Variance of min(X, tau) with X exponential.
        mean = -math.expm1(-tau)
        variance = 2.0 * (mean - tau * math.exp(-tau)) - mean * mean if tau > 1e-3 else tau**3 / 3.0
        for loose in looseness:
            n = int(min(max(budget / max(loose * min(tau, 1.0), 1e-9), 25.0), 20_000.0))
            rng = generator(5)
            origin = np.column_stack([np.full(n, -1.0), rng.random((n, 2)) * SIDE])
            rays = bundle(origin, np.tile([1.0, 0.0, 0.0], (n, 1)))
            keys = rng.integers(0, 2**64, n, dtype=np.uint64)
            found = track(volume, rays, keys, np.arange(n), _whole(volume, n), majorant_scale=loose)
            covered = np.minimum(found.t.astype(np.float64) - 1.0, SIDE) * (tau / SIDE)
            rows.append(
                Tracking(
                    tau,
                    loose,
                    n,
                    float((found.event == NOTHING).mean()),
                    math.exp(-tau),
                    float(covered.mean()),
                    mean,
                    math.sqrt(variance / n),
                    float(found.samples.mean()),
                )
            )
    return rows


def _whole(volume: Volume, rows: int) -> NDArray[np.int32]:
    x, y, z = volume.cells
    return np.tile(np.array([[0, x, 0, y, 0, z]], np.int32), (rows, 1))


# -- marching ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Marching:
    """Mean errors of opacity and colour against closed forms, at one step."""

    step: float
    opacity_error: float
    color_error: float


def marching(steps: Sequence[float], rays: int = 400) -> list[Marching]:
    """March rays at some steps along a ramp of extinction, whose colour is a ramp, too.

    With extinction and colour x / L each, a way of length L has the opacity 1 - exp(-s L / 2); its colour is the
    integral of s (x / L)^2 exp(-s x^2 / 2 L).
    """
    transfer = TransferFunction(np.array([0.0, 1.0]), np.array([[0.0] * 3, [1.0] * 3]), np.array([0.0, 0.05]))
    volume, sigma = _cube(transfer), float(transfer.extinction[1])
    k = math.sqrt(0.5 * sigma / SIDE)
    opacity = -math.expm1(-0.5 * sigma * SIDE)
    color = math.sqrt(math.pi) / (2.0 * k * SIDE) * math.erf(k * SIDE) - math.exp(-0.5 * sigma * SIDE)
    rng = generator(6)
    origin = np.column_stack([-1.0 - rng.random(rays), 4.0 + 24.0 * rng.random((rays, 2))])
    bunch = bundle(origin, np.tile([1.0, 0.0, 0.0], (rays, 1)))
    rows = []
    for step in steps:
        rgba = march(
            volume, step, bunch, np.arange(rays), _whole(volume, rays), shading=False, opacity_limit=1.0
        ).rgba.astype(np.float64)
        rows.append(
            Marching(step, float(np.abs(rgba[:, 3] - opacity).mean()), float(np.abs(rgba[:, 0] - color).mean()))
        )
    return rows


# -- elements ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Chords:
    """Chords through a box of one kind of element.

    Attributes
    ----------
    element, aim : str
        Kind of element; where rays are aimed.
    rays, fragments : int
    lost : int
        Rays whose chord the fragments do not cover, within 1e-5 of the box.
    chord_error : float
        Largest difference of the sum of a ray's fragments from its chord, relative to the box.
    opacity_error : float
        Largest difference of the blended opacity from 1 - exp(-extinction * chord).

    """

    element: str
    aim: str
    rays: int
    fragments: int
    lost: int
    chord_error: float
    opacity_error: float


# Corners of the cells' elements: 0 .. 7 as a hexahedron in VTK's order, 8 the cell's centre.
_CELLS: dict[str, list[tuple[int, ...]]] = {
    "hexahedra": [(0, 1, 2, 3, 4, 5, 6, 7)],
    "wedges": [(0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7)],
    "pyramids": [
        (0, 1, 2, 3, 8), (4, 7, 6, 5, 8), (0, 4, 5, 1, 8), (1, 5, 6, 2, 8), (2, 6, 7, 3, 8), (3, 7, 4, 0, 8),
    ],
    "tetrahedra": [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)],
}  # fmt: skip


def chords(cells: int = 6, parts: int = 5, rays: int = 2000) -> list[Chords]:
    """Compare the fragments of rays through a box in parts with their chords, for every kind of element.

    Parameters
    ----------
    cells : int
        Along each axis of the box, each of them cut into elements.
    parts : int
        To which elements are dealt at random, so that rays enter each part over and over.
    rays : int
        Of each aim: anywhere, at vertices, at the middles of edges, and within planes between elements.

    """
    extinction = 0.3
    rows = []
    for name in _CELLS:
        mesh = _box(name, cells, parts, extinction)
        rng = generator(8)
        at = rng.integers(0, cells + 1, (rays, 3)).astype(np.float64)
        start = cells * (rng.random((rays, 3)) * 4.0 - 1.5)
        within = start.copy()
        within[:, 0] = at[:, 0]
        aims = {
            "anywhere": (start, cells * rng.random((rays, 3))),
            "vertices": (start, at),
            "edges": (start, np.clip(at + 0.5 * np.eye(3)[rng.integers(0, 3, rays)], 0.0, cells)),
            "planes": (within, np.column_stack([at[:, :1], cells * rng.random((rays, 2))])),
        }
        for aim, (origin, target) in aims.items():
            rows.append(_chords(mesh, name, aim, origin, target, cells, extinction))
    return rows


def _chords(mesh: Elements, name: str, aim: str, origin: F64, target: F64, cells: int, extinction: float) -> Chords:
    bunch = bundle(origin, target - origin.astype(np.float32))
    o, d = bunch["origin"].astype(np.float64), bunch["direction"].astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.stack([-o / d, (cells - o) / d])
    still = np.where((o >= 0.0) & (o <= cells), -np.inf, np.inf)
    near = np.where(d == 0.0, still, t.min(axis=0)).max(axis=1)
    far = np.where(d == 0.0, -still, t.max(axis=0)).min(axis=1)
    chord = np.maximum(far - np.maximum(near, 0.0), 0.0)
    # A ray within a face of the box runs along it or past it.
    loose = ((d == 0.0) & ((o == 0.0) | (o == cells))).any(axis=1)
    n, parts = len(chord), int(mesh.part.max()) + 1
    ray, part = np.repeat(np.arange(n), parts), np.tile(np.arange(parts, dtype=np.int32), n)
    found = march_parts(mesh, bunch, ray, part)
    owner = ray[found.row]
    covered = np.bincount(owner, found.exit.astype(np.float64) - found.entry, minlength=n)
    rgba = composite(found.rgba, found.entry, owner, part[found.row], n)
    error = np.where(loose, 0.0, np.abs(covered - chord)) / cells
    opacity = np.where(loose, 0.0, np.abs(rgba[:, 3] + np.expm1(-extinction * chord)))
    return Chords(name, aim, n, len(found.row), int((error > 1e-5).sum()), float(error.max()), float(opacity.max()))


def _box(name: str, n: int, parts: int, extinction: float) -> Elements:
    """Return a box of n cells a side, each cut into elements, in random parts."""
    z, y, x = (axis.ravel() for axis in np.meshgrid(*[np.arange(n + 1.0)] * 3, indexing="ij"))
    k, j, i = (axis.ravel() for axis in np.meshgrid(*[np.arange(n)] * 3, indexing="ij"))
    base = i + (n + 1) * (j + (n + 1) * k)
    square = np.array([0, 1, n + 2, n + 1])
    around = base[:, None] + np.concatenate([square, square + (n + 1) ** 2])
    centre = len(x) + np.arange(n**3)
    middles = np.stack([i, j, k], axis=1) + 0.5
    table = np.concatenate([around, centre[:, None]], axis=1)
    corners = table[:, np.array(_CELLS[name])].reshape(-1, len(_CELLS[name][0]))
    points = np.concatenate([np.stack([x, y, z], axis=1), middles]).astype(np.float32)
    count, wide = corners.shape
    return Elements(
        points,
        np.zeros(len(points), np.float32),
        np.arange(count + 1, dtype=np.int64) * wide,
        corners.ravel().astype(np.int32),
        np.full(count, wide, np.uint8),
        generator(9).integers(0, parts, count).astype(np.int32),
        haze([extinction]),
    )


# -- compositing ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Blending:
    """Largest differences in a channel from a fold in float64, front to back."""

    fragments: int
    library: float
    front_to_back: float
    binary_tree: float
    random_tree: float


def blending(counts: Sequence[int], pixels: int = 200) -> list[Blending]:
    """Blend some numbers of fragments in float32, in trees of all shapes, and compare.

    ``library`` is `compositing.composite`, which folds float32 fragments in float64.
    """
    rows = []
    for count in counts:
        rng = generator(count)
        # Together they are about half transparent, so that none is hidden and none is alone.
        alpha = -np.expm1(-rng.random((pixels, count, 1)) * 1.4 / count)
        fragments = np.concatenate([rng.random((pixels, count, 3)) * alpha, alpha], axis=2).astype(np.float32)
        truth = _in_turn(fragments.astype(np.float64))
        ray, depth = np.divmod(np.arange(pixels * count), count)
        library = composite(fragments.reshape(-1, 4), depth.astype(np.float64), ray, np.zeros_like(ray), pixels)
        ways = library, _in_turn(fragments), _in_pairs(fragments), _at_random(fragments, rng)
        rows.append(Blending(count, *(float(np.abs(way - truth).max()) for way in ways)))
    return rows


def _in_turn(fragments: NDArray[np.floating]) -> NDArray[np.floating]:
    image = fragments[:, 0]
    for k in range(1, fragments.shape[1]):
        image = over(image, fragments[:, k])
    return image


def _in_pairs(fragments: NDArray[np.floating]) -> NDArray[np.floating]:
    while fragments.shape[1] > 1:
        even = fragments.shape[1] // 2 * 2
        pairs = over(fragments[:, 0:even:2], fragments[:, 1:even:2])
        fragments = np.concatenate([pairs, fragments[:, even:]], axis=1)
    return fragments[:, 0]


def _at_random(fragments: NDArray[np.floating], rng: np.random.Generator) -> NDArray[np.floating]:
    rest = [fragments[:, k] for k in range(fragments.shape[1])]
    while len(rest) > 1:
        k = int(rng.integers(len(rest) - 1))
        rest[k : k + 2] = [over(rest[k], rest[k + 1])]
    return rest[0]
