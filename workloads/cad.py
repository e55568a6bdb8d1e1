"""Parts as engineers and masons draw them: swept sections, turned profiles, sheets with holes, boxes and cushions.

A *solid* is the vertices and faces of one part. A *series* is many parts of the same make, the vertices of all of them
over one set of faces, so that a thousand stringers cost one call. Everything is computed in float64 and stored in
float32. Transforms are those of `simrender.rays.scene.Scene`: affine, (n, 3, 4).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.rays.scene import F32, Mesh, SceneObject
from workloads.terrain import F64, I64, grid_faces, unit

Solid = tuple[F64, I64]  # vertices (v, 3) and faces (f, 3)
Series = tuple[F64, I64]  # vertices (n, v, 3) of n parts and the faces (f, 3) of each

X, Y, Z = np.eye(3)


def points(x: ArrayLike, y: ArrayLike, z: ArrayLike) -> F64:
    """Return points (..., 3) from coordinates that broadcast together."""
    return np.stack(np.broadcast_arrays(np.asarray(x, np.float64), y, z), axis=-1).astype(np.float64)


def finer(lines: Sequence[float] | F64, pieces: int) -> F64:
    """Return increasing coordinates with every interval cut into so many pieces; the given ones stay to the bit."""
    given = np.asarray(lines, np.float64)
    at = np.arange((len(given) - 1) * pieces + 1) / pieces
    return np.interp(at, np.arange(len(given), dtype=np.float64), given)


def sweeps(paths: F64, section: Sequence[Sequence[float]] | F64, up: F64, scale: F64 | float = 1.0) -> Series:
    """Sweep a closed section along paths: beams, pipes, mouldings and hoops.

    Parameters
    ----------
    paths : float64 array (n, k, 3)
    section : (m, 2)
        Outline, sideways and upwards; the last point is joined to the first.
    up : float64 array that broadcasts to (n, k, 3)
        What the upper side faces; nowhere along the path.
    scale : float64 array (n, k) or float
        Size of the section along the path.

    Returns
    -------
    Series
        2 m (k - 1) triangles each, without caps.

    """
    outline = np.asarray(section, np.float64)
    n, k = paths.shape[:2]
    along = unit(np.gradient(paths, axis=1))
    side = unit(np.cross(along, np.broadcast_to(up, paths.shape)))
    above = np.cross(side, along)
    reach = np.broadcast_to(scale, (n, k))[:, :, None, None]
    ring = outline[:, :1] * side[:, :, None] + outline[:, 1:] * above[:, :, None]
    vertices = paths[:, :, None] + reach * ring
    m = len(outline)
    return vertices.reshape(n, k * m, 3), _wrapped(k, m)


def ring(radius: float, sides: int) -> F64:
    """Return the outline of a round section, (sides, 2)."""
    angle = 2.0 * np.pi * np.arange(sides) / sides
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def bar(width: float, height: float) -> F64:
    """Return the outline of a rectangular section around the path, (4, 2)."""
    w, h = 0.5 * width, 0.5 * height
    return np.array([[-w, -h], [w, -h], [w, h], [-w, h]])


def lathe(profile: Sequence[Sequence[float]] | F64, sides: int, flutes: F64 | None = None) -> Solid:
    """Turn a profile about the z axis.

    Parameters
    ----------
    profile : (k, 2)
        Radius and height. A point that stands twice makes a sharp edge; radius 0 closes the shape.
    sides : int
    flutes : float64 array (k, sides), optional
        Factors on the radius.

    """
    outline = np.asarray(profile, np.float64)
    angle = 2.0 * np.pi * np.arange(sides) / sides
    radius = outline[:, :1] * (np.ones((len(outline), sides)) if flutes is None else flutes)
    height = np.broadcast_to(outline[:, 1:], radius.shape)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2).reshape(-1, 3)
    return clean((vertices, _wrapped(len(outline), sides)))


def curve(points: Sequence[Sequence[float]], pieces: int) -> F64:
    """Return a smooth curve through points, a Catmull-Rom spline with so many pieces between two of them."""
    given = np.asarray(points, np.float64)
    ends = np.concatenate([2.0 * given[:1] - given[1:2], given, 2.0 * given[-1:] - given[-2:-1]])
    t = (np.arange(pieces) / pieces)[None, :, None]
    a, b, c, d = (ends[i : i + len(given) - 1, None] for i in range(4))
    inner = 0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
    return np.concatenate([inner.reshape(-1, given.shape[1]), given[-1:]])


def sheet(points: F64) -> Solid:
    """Return a grid of points (rows, columns, 3) as a surface without thickness."""
    rows, columns = points.shape[:2]
    return points.reshape(-1, 3), grid_faces(rows - 1, columns - 1)


def slab(outer: F64, inner: F64, holes: NDArray[np.bool_] | None = None) -> Solid:
    """Return the solid between two grids of points, with rectangular holes.

    Parameters
    ----------
    outer, inner : float64 arrays (rows, columns, 3)
    holes : bool array (rows - 1, columns - 1), optional
        Cells that are cut out.

    """
    rows, columns = outer.shape[0] - 1, outer.shape[1] - 1
    kept = np.ones((rows, columns), np.bool_) if holes is None else ~holes
    faces = grid_faces(rows, columns)[np.repeat(kept.ravel(), 2)]
    other = outer.shape[0] * outer.shape[1]
    padded = np.pad(kept, 1)
    index = np.arange(other).reshape(rows + 1, columns + 1)
    rims = []
    for here, across, a, b in (
        (padded[1:, 1:-1], padded[:-1, 1:-1], index[:, :-1], index[:, 1:]),
        (padded[1:-1, :-1], padded[1:-1, 1:], index[:-1], index[1:]),
    ):
        for edge, p, q in ((here & ~across, a, b), (across & ~here, b, a)):
            i, j = p[edge], q[edge]
            rims.append(np.stack([i, i + other, j, j, i + other, j + other], axis=1).reshape(-1, 3))
    vertices = np.concatenate([outer.reshape(-1, 3), inner.reshape(-1, 3)])
    return vertices, np.concatenate([faces, faces[:, ::-1] + other, *rims])


def boxes(low: Sequence[Sequence[float]] | F64, high: Sequence[Sequence[float]] | F64) -> Series:
    """Return boxes between corners (n, 3), 12 triangles each."""
    ends = np.stack([np.asarray(low, np.float64), np.asarray(high, np.float64)], axis=1)
    corner = np.array([[i & 1, i >> 1 & 1, i >> 2] for i in range(8)])
    quads = np.array([[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return ends[:, corner, np.arange(3)], faces


def panes(low: Sequence[Sequence[float]] | F64, high: Sequence[Sequence[float]] | F64) -> Series:
    """Return level rectangles between corners (n, 3) of equal height, 2 triangles each: lights without a back."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    corners = [a, np.stack([b[:, 0], a[:, 1], a[:, 2]], axis=1), b, np.stack([a[:, 0], b[:, 1], a[:, 2]], axis=1)]
    return np.stack(corners, axis=1), np.array([[0, 2, 1], [0, 3, 2]])


def cushion(radii: Sequence[float], triangles: int, square: float = 0.45) -> Solid:
    """Return a box with soft edges, a superellipsoid around the origin; ``square`` 1 is an ellipsoid, 0 a box."""
    rings = max(4, round(float(np.sqrt(triangles / 4.0))))
    sides = max(6, 4 * round(triangles / (8.0 * rings)))
    latitude = np.pi * (np.arange(rings + 1) / rings - 0.5)[:, None]
    longitude = 2.0 * np.pi * np.arange(sides)[None] / sides

    def power(value: F64) -> F64:
        return np.sign(value) * np.abs(value) ** square

    flat = power(np.cos(latitude))
    shape = [flat * power(np.cos(longitude)), flat * power(np.sin(longitude)), power(np.sin(latitude))]
    vertices = np.stack([np.broadcast_to(s, (rings + 1, sides)) for s in shape], axis=2) * np.asarray(radii)
    vertices[[0, -1], :, :2] = 0.0
    return clean((vertices.reshape(-1, 3), _wrapped(rings + 1, sides)))


def clean(solid: Solid) -> Solid:
    """Return the solid without faces that have no area in float32, and without vertices that no face uses."""
    vertices, faces = solid
    corners = vertices.astype(np.float32)[faces].astype(np.float64)
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    kept = faces[np.abs(area).max(axis=1) > 0.0]
    used = np.zeros(len(vertices), np.bool_)
    used[kept.ravel()] = True
    return vertices[used], (np.cumsum(used) - 1)[kept]


def shifted(solid: Solid, offset: Sequence[float]) -> Solid:
    """Return a solid moved by an offset (x, y, z)."""
    return solid[0] + np.asarray(offset, np.float64), solid[1]


def moved(solid: Solid, transform: F32 | F64) -> Solid:
    """Return copies of a solid under transforms (n, 3, 4) or (3, 4), as one solid."""
    matrix = np.asarray(transform, np.float64).reshape(-1, 3, 4)
    vertices = np.einsum("nij,vj->nvi", matrix[:, :, :3], solid[0]) + matrix[:, None, :, 3]
    return whole((vertices, solid[1]))


def whole(series: Series) -> Solid:
    """Return all parts of a series as one solid."""
    vertices, faces = series
    shift = vertices.shape[1] * np.arange(len(vertices))[:, None, None]
    return vertices.reshape(-1, 3), (faces[None] + shift).reshape(-1, 3)


def joined(solids: Iterable[Solid]) -> Solid:
    """Return several solids as one."""
    pieces = list(solids)
    shift = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
    faces = np.concatenate([f + s for (_, f), s in zip(pieces, shift[:-1], strict=True)])
    return np.concatenate([v for v, _ in pieces]), faces


def axes(origin: F64, x: F64, y: F64, z: F64) -> F32:
    """Return transforms that take the coordinate axes to the given vectors and the origin to the given points."""
    columns = np.broadcast_arrays(x, y, z, origin)
    return np.stack(columns, axis=-1).reshape(-1, 3, 4).astype(np.float32)


def upright(position: Sequence[Sequence[float]] | F64, angle: F64 | float = 0.0, size: F64 | float = 1.0) -> F32:
    """Return transforms that turn about z, scale, and move to positions (n, 3)."""
    at = np.asarray(position, np.float64).reshape(-1, 3)
    a, s = np.broadcast_to(angle, len(at))[:, None], np.broadcast_to(size, len(at))[:, None]
    return axes(at, s * (np.cos(a) * X + np.sin(a) * Y), s * (np.cos(a) * Y - np.sin(a) * X), s * Z)


def about_x(position: Sequence[float] | F64, angle: F64) -> F32:
    """Return transforms that turn about x by angles (n,), and then move to one position."""
    a = angle[:, None]
    at = np.broadcast_to(np.asarray(position, np.float64), (len(angle), 3))
    return axes(at, np.broadcast_to(X, at.shape), np.cos(a) * Y + np.sin(a) * Z, np.cos(a) * Z - np.sin(a) * Y)


def mesh(
    solid: Solid, material: int, *, smooth: bool = False, colors: F64 | None = None, uv: F64 | None = None
) -> Mesh:
    """Return a solid as a mesh."""
    dyes, places = (None if column is None else column.astype(np.float32) for column in (colors, uv))
    return Mesh(solid[0].astype(np.float32), solid[1].astype(np.int32), material, dyes, smooth, places)


def part(name: str, *solids: tuple[int, Solid], smooth: bool = False) -> SceneObject:
    """Return an object of one mesh for each (material, solid)."""
    return SceneObject(name, tuple(mesh(solid, material, smooth=smooth) for material, solid in solids))


def parts(name: str, series: Series, material: int, *, smooth: bool = False) -> list[SceneObject]:
    """Return each part of a series as an object of its own, numbered from 0."""
    vertices, faces = series[0].astype(np.float32), series[1].astype(np.int32)
    return [SceneObject(f"{name} {i}", (Mesh(v, faces, material, None, smooth),)) for i, v in enumerate(vertices)]


def _wrapped(rows: int, sides: int) -> I64:
    """Return the faces of rows of rings whose last point is joined to the first."""
    faces = grid_faces(rows - 1, sides)
    row, column = faces // (sides + 1), faces % (sides + 1)
    return np.asarray(row * sides + column % sides, np.int64)
