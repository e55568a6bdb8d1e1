"""Fractal ground cut into tiles, and the placing of instances on it.

The ground is a height field over a grid that is finest at a focus (where the camera stands) and coarser away from it,
as production tessellation is. It becomes *one* object of many meshes, because production scenes tend to have one ground
object that dwarfs all others, and splitting objects into objects with fewer meshes is how the ray queue cycling paper
(section 4.1) makes it fit. Everything is computed in float64 and stored in float32, so that a last bit in which one
processor's sine differs from another's is rounded away.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.rays.scene import F32, I32, Mesh, SceneObject

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Suitability = Callable[[F64, F64, F64, F64], F64]  # (x, y, height, slope) -> weight of growing there, 0 for never

Placed = tuple[SceneObject, F32]  # an object and the transforms (n, 3, 4) of its instances

LATTICE = 64


def generator(seed: int, name: str) -> np.random.Generator:
    """Return the random stream of that name: counter-based, so that streams neither overlap nor depend on order."""
    return np.random.Generator(np.random.Philox(key=[seed % 2**64, zlib.crc32(name.encode())]))


def smoothstep(low: float, high: float, value: ArrayLike) -> F64:
    """Rise smoothly from 0 at ``low`` to 1 at ``high``; ``low > high`` makes it fall."""
    t = np.clip((np.asarray(value, np.float64) - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), np.float64)


def unit(v: F64) -> F64:
    """Return vectors (..., 3) scaled to length 1."""
    return np.asarray(v / np.maximum(np.sqrt((v * v).sum(axis=-1, keepdims=True)), 1e-12), np.float64)


class Noise:
    """Value noise on a periodic lattice of random numbers, summed over octaves (fractional Brownian motion)."""

    def __init__(self, seed: int, name: str) -> None:
        self._lattice = generator(seed, f"noise {name}").uniform(-1.0, 1.0, (LATTICE, LATTICE))

    def __call__(self, x: F64, y: F64, size: float, octaves: int = 4, gain: float = 0.5) -> F64:
        """Evaluate the noise, most of it within -0.7 to 0.7.

        Parameters
        ----------
        x, y : float64 arrays that broadcast together
        size : float
            Spacing of the first octave's lattice, in metres; every further octave has half of it.
        octaves : int
        gain : float
            Amplitude of an octave relative to the one before it.

        """
        total = np.zeros(np.broadcast_shapes(x.shape, y.shape))
        amplitude = 1.0
        for _ in range(octaves):
            total += amplitude * self._octave(x / size, y / size)
            # Octaves are turned against each other and shifted, or the lattice's grid shows through.
            x, y = 0.8 * x - 0.6 * y + 5.3 * size, 0.6 * x + 0.8 * y + 9.1 * size
            size, amplitude = 0.5 * size, gain * amplitude
        return total

    def _octave(self, x: F64, y: F64) -> F64:
        column, row = np.floor(x), np.floor(y)
        u, v = x - column, y - row
        u, v = u * u * u * (u * (6 * u - 15) + 10), v * v * v * (v * (6 * v - 15) + 10)
        i, j = column.astype(np.int64) % LATTICE, row.astype(np.int64) % LATTICE
        right, up = (i + 1) % LATTICE, (j + 1) % LATTICE
        low = self._lattice[j, i] * (1 - u) + self._lattice[j, right] * u
        high = self._lattice[up, i] * (1 - u) + self._lattice[up, right] * u
        return np.asarray(low * (1 - v) + high * v, np.float64)


def graded_axis(low: float, high: float, focus: float, fine: float, cells: int) -> F64:
    """Return ``cells + 1`` coordinates from low to high, densest around ``focus`` over a distance of about ``fine``."""
    ends = np.arcsinh((np.array([low, high]) - focus) / fine)
    axis = focus + fine * np.sinh(np.linspace(ends[0], ends[1], cells + 1))
    return np.asarray(axis, np.float32).astype(np.float64)  # heights are interpolated on the grid that is rendered


def tiles(points: F64, material: I64, across: tuple[int, int]) -> tuple[Mesh, ...]:
    """Cut a grid of quadrilaterals into tiles: a mesh for each tile, or several where a tile has several materials.

    Neighbouring meshes repeat the vertices they share exactly, so that no ray slips through between them.

    Parameters
    ----------
    points : float64 array (rows + 1, columns + 1, 3)
    material : int64 array (rows, columns, 2)
        Material of the two triangles of each cell.
    across : (int, int)
        Number of tiles along rows and columns; fewer where there are fewer cells.

    """
    rows, columns = material.shape[:2]
    cuts = [np.linspace(0, n, min(t, n) + 1).astype(np.int64) for n, t in zip((rows, columns), across, strict=True)]
    meshes = []
    for r0, r1 in zip(cuts[0][:-1], cuts[0][1:], strict=True):
        for c0, c1 in zip(cuts[1][:-1], cuts[1][1:], strict=True):
            vertices = points[r0 : r1 + 1, c0 : c1 + 1].reshape(-1, 3)
            faces = grid_faces(r1 - r0, c1 - c0)
            kinds = material[r0:r1, c0:c1].ravel()
            for kind in np.flatnonzero(np.bincount(kinds)):
                corners = faces[kinds == kind]
                used = np.zeros(len(vertices), np.bool_)
                used[corners.ravel()] = True
                renumbered = (np.cumsum(used) - 1)[corners]
                meshes.append(Mesh(vertices[used].astype(np.float32), renumbered.astype(np.int32), int(kind)))
    return tuple(meshes)


def grid_faces(rows: int, columns: int) -> I64:
    """Return the faces of a grid of quadrilaterals, two for each cell, int64 (2 rows columns, 3)."""
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).ravel()
    right, up, far = corner + 1, corner + columns + 1, corner + columns + 2
    return np.stack([corner, right, far, corner, far, up], axis=1).reshape(-1, 3)


@dataclass(frozen=True, eq=False)
class Terrain:
    """A height field.

    Attributes
    ----------
    x : float64 array (columns + 1,)
    y : float64 array (rows + 1,)
        Increasing.
    z : float64 array (rows + 1, columns + 1)

    """

    x: F64
    y: F64
    z: F64

    def ground(self, material: I64, across: int = 8) -> SceneObject:
        """Return the object called "ground", of ``across`` x ``across`` tiles; see `tiles`."""
        columns, rows = np.meshgrid(self.x, self.y)
        return SceneObject("ground", tiles(np.stack([columns, rows, self.z], axis=2), material, (across, across)))

    def facets(self) -> tuple[F64, F64, F64, F64]:
        """Return x, y, height and slope at the centre of both triangles of each cell, float64 (rows, columns, 2)."""
        (x, y, width, depth) = (self.x[:-1], self.y[:-1], np.diff(self.x), np.diff(self.y))
        u, v = np.array([2.0, 1.0]) / 3.0, np.array([1.0, 2.0]) / 3.0
        shape = (len(y), len(x), 2)
        px = np.broadcast_to((x[:, None] + width[:, None] * u)[None], shape)
        py = np.broadcast_to((y[:, None] + depth[:, None] * v)[:, None], shape)
        return px, py, self.height(px, py), self.slope(px, py)

    def height(self, x: F64, y: F64) -> F64:
        """Return the height of the triangles at any points; beyond the border the outermost triangles go on."""
        _, _, (z, dx, dy), u, v = self._cell(x, y)
        return np.asarray(z + u * dx + v * dy, np.float64)

    def slope(self, x: F64, y: F64) -> F64:
        """Return the rise over run of the triangles at any points; 1 is 45 degrees."""
        i, j, (_, dx, dy), _, _ = self._cell(x, y)
        return np.hypot(dx / (self.x[i + 1] - self.x[i]), dy / (self.y[j + 1] - self.y[j]))

    def _cell(self, x: F64, y: F64) -> tuple[I64, I64, tuple[F64, F64, F64], F64, F64]:
        i = np.clip(np.searchsorted(self.x, x, side="right") - 1, 0, len(self.x) - 2)
        j = np.clip(np.searchsorted(self.y, y, side="right") - 1, 0, len(self.y) - 2)
        u = (x - self.x[i]) / (self.x[i + 1] - self.x[i])
        v = (y - self.y[j]) / (self.y[j + 1] - self.y[j])
        corner, right, up, far = self.z[j, i], self.z[j, i + 1], self.z[j + 1, i], self.z[j + 1, i + 1]
        below = u >= v  # which side of the diagonal that `grid_faces` draws
        rise = np.where(below, right - corner, far - up), np.where(below, far - right, up - corner)
        return i, j, (corner, *rise), u, v


@dataclass(frozen=True)
class Kind:
    """A species, and where how many of it grow.

    Attributes
    ----------
    name : str
        Names its random streams too, so that adding a kind leaves the others where they are.
    build : callable
        Called with seed, name, ``triangles`` and the shape: one of the builders of `workloads.plants`.
    triangles : int
    count : int
        Number of instances.
    suits : callable
        Weight of growing at points of the terrain, from their x, y, height and slope; 0 for never.
    within : (x low, x high, y low, y high)
        Where to look for places at all.
    shape : mapping
        The builder's other arguments.
    scale : (float, float)
        Lowest and highest scale of an instance.
    sink : float
        Depth of the object's origin in the ground, in metres before scaling; see `stand`.

    """

    name: str
    build: Callable[..., SceneObject]
    triangles: int
    count: int
    suits: Suitability
    within: tuple[float, float, float, float]
    shape: Mapping[str, object]
    scale: tuple[float, float] = (0.7, 1.3)
    sink: float = 0.05


def grow(seed: int, detail: float, terrain: Terrain, kinds: Sequence[Kind]) -> list[Placed]:
    """Build each kind and place its instances, with triangles and counts scaled by ``detail``.

    A kind for which no place suits is left out; any other has at least one instance.
    """
    placed = []
    for kind in kinds:
        rng = generator(seed, f"places of {kind.name}")
        x, y = scatter(rng, terrain, max(1, round(kind.count * detail)), kind.suits, kind.within)
        if len(x):
            thing = kind.build(seed, kind.name, triangles=max(8, round(kind.triangles * detail)), **kind.shape)
            placed.append((thing, stand(rng, terrain, x, y, scale=kind.scale, sink=kind.sink)))
    return placed


def scatter(
    rng: np.random.Generator, terrain: Terrain, count: int, suits: Suitability, within: tuple[float, ...]
) -> tuple[F64, F64]:
    """Draw places for instances by suitability, without replacement, from a jittered grid that keeps them apart.

    Parameters
    ----------
    rng : numpy.random.Generator
    terrain : Terrain
    count : int
        Wanted number; fewer come back where fewer places suit at all.
    suits : callable
        Weight of each candidate, from its x, y, height and slope.
    within : (x low, x high, y low, y high)

    Returns
    -------
    x, y : float64 arrays (n,)

    """
    x0, x1, y0, y1 = within
    spacing = float(np.sqrt((x1 - x0) * (y1 - y0) / (6 * count + 80)))
    columns, rows = np.meshgrid(np.arange(x0, x1, spacing), np.arange(y0, y1, spacing))
    x = np.minimum(columns.ravel() + spacing * rng.uniform(0.0, 0.9, columns.size), x1)
    y = np.minimum(rows.ravel() + spacing * rng.uniform(0.0, 0.9, rows.size), y1)
    weight = suits(x, y, terrain.height(x, y), terrain.slope(x, y))
    # Efraimidis and Spirakis: the largest log(u) / weight are a weighted sample without replacement.
    rank = np.full(len(x), -np.inf)
    np.divide(np.log1p(-rng.random(len(x))), weight, out=rank, where=weight > 0)
    best = np.argsort(-rank, kind="stable")[:count]
    best = np.sort(best[np.isfinite(rank[best])])
    return x[best], y[best]


def stand(
    rng: np.random.Generator,
    terrain: Terrain,
    x: F64,
    y: F64,
    *,
    scale: tuple[float, float] = (0.7, 1.3),
    sink: float = 0.0,
) -> F32:
    """Return transforms that stand an object upright on the ground, turned about z and scaled at random.

    Parameters
    ----------
    rng : numpy.random.Generator
    terrain : Terrain
    x, y : float64 arrays (n,)
    scale : (float, float)
        Lowest and highest factor.
    sink : float
        Depth of the object's origin under the ground, in metres before scaling: on a slope, half of a foot would hang
        in the air.

    Returns
    -------
    float32 array (n, 3, 4)

    """
    angle = rng.uniform(0.0, 2.0 * np.pi, len(x))
    size = rng.uniform(*scale, len(x))
    transform = np.zeros((len(x), 3, 4))
    transform[:, 0, 0] = transform[:, 1, 1] = size * np.cos(angle)
    transform[:, 1, 0] = size * np.sin(angle)
    transform[:, 0, 1] = -transform[:, 1, 0]
    transform[:, 2, 2] = size
    transform[:, :, 3] = np.stack([x, y, terrain.height(x, y) - sink * size], axis=1)
    return transform.astype(np.float32)


def instances(placed: Sequence[Placed]) -> tuple[tuple[SceneObject, ...], I32, F32]:
    """Return the objects, the object of each instance and its transform, as `Scene` takes them."""
    things = tuple(thing for thing, _ in placed)
    counts = [len(transform) for _, transform in placed]
    return things, np.repeat(np.arange(len(things), dtype=np.int32), counts), np.concatenate([t for _, t in placed])
