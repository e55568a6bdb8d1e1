"""Unstructured volumes: tetrahedra, pyramids, wedges and hexahedra with a scalar at every point.

Four points need not lie in a plane, so the quadrilateral faces of an element have no shape of their own. Here each is
two triangles, parted along the diagonal through its point of the lowest id. Both elements at a face follow that rule,
so all elements are polyhedra of triangles that fill space without gaps or overlaps, however warped they are. A pyramid
is two tetrahedra at its apex, a wedge or hexahedron those between its triangles and the mean of its corners. The scalar
is linear in each of them: continuous everywhere, and exact for a linear field.

A mesh comes *pre-partitioned*, as simulations write it (islands paper, section 7.2): every element belongs to a part.
The boundary of a part is what only one of its elements has, also where another part goes on.

Corners and faces are numbered as by VTK 9: ``vtkTetra``, ``vtkPyramid``, ``vtkWedge``, ``vtkHexahedron``.
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError, SceneWarning
from simrender.rays.volume import TransferFunction
from simrender.rays.vtk import read_vtk

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
Bools = NDArray[np.bool_]

NAMES = {4: "tetrahedron", 5: "pyramid", 6: "wedge", 8: "hexahedron"}
"""The kinds of elements, by their number of corners."""

FACES: dict[int, tuple[tuple[int, ...], ...]] = {
    4: ((0, 1, 3), (1, 2, 3), (2, 0, 3), (0, 2, 1)),
    5: ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
    6: ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    8: ((0, 4, 7, 3), (1, 2, 6, 5), (0, 1, 5, 4), (3, 7, 6, 2), (0, 3, 2, 1), (4, 5, 6, 7)),
}
"""Corners of the faces of each kind, counter-clockwise as seen from outside."""

_MIRRORED = {4: (0, 2, 1, 3), 5: (0, 3, 2, 1, 4), 6: (3, 4, 5, 0, 1, 2), 8: (4, 5, 6, 7, 0, 1, 2, 3)}
"""The order of corners that turns an element of each kind outside in."""

SIDES = 12
"""The most triangles an element has: 2 k - 4 for one of k corners."""

_FLAT = 1e-12
"""Volume below which an element counts as having none, relative to the cube around it."""

_MOST = 1 << 27
"""Elements a mesh may have: an element and one of its 16 possible triangles fit in an int32."""


@dataclass(frozen=True, eq=False)
class Elements:
    """An unstructured, pre-partitioned volume.

    Elements that are inside out are turned by reordering their corners; those without volume are kept, for rays pass
    through them. Both are reported by a `SceneWarning`.

    Attributes
    ----------
    points : float32 array (p, 3)
    scalars : float32 array (p,)
        The field at the points.
    first : int64 array (e + 1,)
        Where the corners of each element start, then the number of all corners.
    corners : int32 array (first[-1],)
        Points of each element in VTK's order.
    kind : uint8 array (e,)
        Number of corners: 4 tetrahedron, 5 pyramid, 6 wedge, 8 hexahedron.
    part : int32 array (e,)
        The part each element belongs to, from 0 on.
    transfer : TransferFunction
    shape : uint8 array (e,)
        Kind and diagonals of each element: the row of `TRIANGLES` that holds its triangles. Computed.

    Raises
    ------
    SceneError
        If shapes disagree, there are no elements, a kind is unknown, a corner or part is out of range, or a point or
        scalar is not finite.

    """

    points: F32
    scalars: F32
    first: I64
    corners: I32
    kind: U8
    part: I32
    transfer: TransferFunction
    shape: U8 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        points = np.ascontiguousarray(self.points, dtype=np.float32)
        scalars = np.ascontiguousarray(self.scalars, dtype=np.float32)
        first, corners = np.asarray(self.first), np.asarray(self.corners)
        kind, part = np.asarray(self.kind), np.asarray(self.part)
        _check_shapes(points, scalars, first, corners, kind, part)
        _check_numbers(points, "points")
        _check_numbers(scalars, "scalars")
        if corners.min() < 0 or corners.max() >= len(points):
            outside = np.flatnonzero((corners < 0) | (corners >= len(points)))
            element = int(np.searchsorted(first, outside[0], side="right")) - 1
            count = "1 corner of an element is" if len(outside) == 1 else f"{len(outside)} corners of elements are"
            where = f"{corners[outside[0]]} of element {element}, a {NAMES[int(kind[element])]}"
            raise SceneError(f"{count} outside the {len(points)} points; the first is {where}")
        if part.min() < 0:
            raise SceneError(f"parts are numbered from 0 on, got part {part.min()} of element {part.argmin()}")
        first, part = np.ascontiguousarray(first, dtype=np.int64), np.ascontiguousarray(part, dtype=np.int32)
        corners, kind = np.ascontiguousarray(corners, dtype=np.int32), np.ascontiguousarray(kind, dtype=np.uint8)
        shape, volume = _inspect(points, first, corners)
        wrong = volume < 0.0
        if wrong.any():
            corners = corners.copy()
            for k, order in _MIRRORED.items():
                rows = first[:-1][wrong & (kind == k)][:, None]
                corners[rows + np.arange(k)] = corners[rows + np.array(order)]
            shape, volume = _inspect(points, first, corners)
            _warn(wrong, kind, "inside out, by VTK's order of corners: they were turned")
        if (volume == 0.0).any():
            _warn(volume == 0.0, kind, "without volume: they were kept, and rays pass through them")
        entries = {
            "points": points, "scalars": scalars, "first": first, "corners": corners, "kind": kind, "part": part,
            "shape": shape,
        }  # fmt: skip
        for name, entry in entries.items():
            object.__setattr__(self, name, entry)

    @property
    def count(self) -> int:
        """Number of elements."""
        return len(self.kind)

    @cached_property
    def parts(self) -> int:
        """Number of parts."""
        return int(self.part.max()) + 1

    @cached_property
    def elements_of(self) -> I64:
        """Number of elements of each part, int64 (parts,)."""
        return np.bincount(self.part, minlength=self.parts)

    @cached_property
    def bounds(self) -> tuple[F64, F64]:
        """Lowest and highest corner of a box around all elements, float64 (3,) each."""
        low, high = self.part_bounds
        return low.min(axis=0).astype(np.float64), high.max(axis=0).astype(np.float64)

    @cached_property
    def part_bounds(self) -> tuple[F32, F32]:
        """Lowest and highest corner of each part's box, float32 (parts, 3); inside out for a part without elements."""
        low = np.full((self.parts, 3), np.inf, np.float32)
        high = np.full((self.parts, 3), -np.inf, np.float32)
        part_of_corner = np.repeat(self.part, np.diff(self.first))
        order = np.argsort(part_of_corner, kind="stable")
        held = np.unique(part_of_corner)
        starts = np.searchsorted(part_of_corner[order], held)
        corners = self.points[self.corners[order]]
        low[held] = np.minimum.reduceat(corners, starts, axis=0)
        high[held] = np.maximum.reduceat(corners, starts, axis=0)
        return low, high

    @cached_property
    def across(self) -> I32:
        """What lies behind each triangle within the same part, int32 (triangles,).

        The triangles of element e, in the order of `TRIANGLES`, start at row ``2 * first[e] - 4 * e``. The entry is
        ``16 * element + triangle`` of the neighbour, or -1 if the triangle is on the part's boundary.
        """
        across: I32 = _pair(self.first, self.corners, self.shape, self.part)
        return across

    def scaled(self, factor: float) -> Elements:
        """Return the mesh in other units of length: every length times a factor, every slab as opaque as it was."""
        transfer = replace(self.transfer, unit=self.transfer.unit * factor)
        return replace(self, points=self.points * np.float32(factor), transfer=transfer)

    @cached_property
    def key(self) -> str:
        """Content hash: two meshes with the same key give the same samples."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(f"elements {len(self.points)} {self.count}".encode())
        transfer = self.transfer
        for entries in (self.points, self.scalars, self.corners, self.kind, self.part):
            digest.update(entries.data)
        for table in (transfer.values, transfer.colors, transfer.opacities):
            digest.update(table.data)
        digest.update(repr(transfer.unit).encode())
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class Boundary:
    """The triangles through which rays enter and leave the parts of a mesh.

    Attributes
    ----------
    faces : int32 array (n, 3)
        Points of each triangle, counter-clockwise as seen from outside its element.
    element : int32 array (n,)
        The element behind each triangle, ascending.
    side : uint8 array (n,)
        Which of that element's triangles it is.
    part : int32 array (n,)
        The element's part.

    """

    faces: I32
    element: I32
    side: U8
    part: I32


def boundary(elements: Elements) -> Boundary:
    """Return the triangles that only one element of a part has; neighbouring parts have theirs at the same points."""
    row = np.flatnonzero(elements.across < 0)
    start = 2 * elements.first[:-1] - 4 * np.arange(elements.count)
    element = np.searchsorted(start, row, side="right") - 1
    side = row - start[element]
    faces = elements.corners[elements.first[element][:, None] + TRIANGLES[elements.shape[element], side]]
    # A triangle whose corners coincide, of a collapsed element, has no neighbour and needs none.
    real = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    element, side, faces = element[real], side[real], faces[real]
    return Boundary(faces, element.astype(np.int32), side.astype(np.uint8), elements.part[element])


def ramp(low: float, high: float, unit: float) -> TransferFunction:
    """Return a plain transfer function: blue over white to red, half opaque a ``unit`` at the high end."""
    blue, white, red = (0.23, 0.30, 0.75), (0.87, 0.87, 0.87), (0.71, 0.02, 0.15)
    if not low < high:
        return TransferFunction(np.array([low]), np.array([white]), np.array([0.25]), unit)
    values = np.array([low, 0.5 * (low + high), high])
    return TransferFunction(values, np.array([blue, white, red]), np.array([0.0, 0.1, 0.5]), unit)


# -- checks ---------------------------------------------------------------------------------------------------------


def _check_shapes(points: F32, scalars: F32, first: I64, corners: I32, kind: U8, part: I32) -> None:
    if points.ndim != 2 or points.shape[1:] != (3,) or scalars.shape != (len(points),):
        raise SceneError(f"points are an array (p, 3) and scalars (p,), got {points.shape} and {scalars.shape}")
    if kind.ndim != 1 or len(kind) == 0:
        raise SceneError("the mesh is empty: it has no elements")
    if len(kind) >= _MOST:
        raise SceneError(f"the mesh has {len(kind)} elements, of which at most {_MOST - 1} can be traced")
    if part.shape != kind.shape or first.shape != (len(kind) + 1,) or corners.ndim != 1:
        shapes = f"{part.shape}, {first.shape} and {corners.shape}"
        raise SceneError(f"{len(kind)} elements have part ({len(kind)},), first ({len(kind) + 1},), got {shapes}")
    unknown = ~np.isin(kind, list(NAMES))
    if unknown.any():
        known = ", ".join(f"{k} {name}" for k, name in NAMES.items())
        raise SceneError(f"element {unknown.argmax()} has {kind[unknown.argmax()]} corners (known: {known})")
    if first[0] != 0 or (np.diff(first) != kind).any() or first[-1] != len(corners):
        raise SceneError("the corners of elements do not follow each other as their kinds say: check `first`")


def _check_numbers(array: F32, what: str) -> None:
    # The extremes of an array are finite only if all of it is: NaN wins over every number.
    if np.isfinite(array.min()) and np.isfinite(array.max()):
        return
    bad = np.flatnonzero(~np.isfinite(array.reshape(len(array), -1)).all(axis=1))
    raise SceneError(f"{len(bad)} of {len(array)} {what} are not finite; the first is {bad[0]}: {array[bad[0]]}")


def _warn(which: Bools, kind: U8, what: str) -> None:
    rows = np.flatnonzero(which)
    count = "1 element is" if len(rows) == 1 else f"{len(rows)} of {len(kind)} elements are"
    message = f"{count} {what}; the first is element {rows[0]}, a {NAMES[int(kind[rows[0]])]}"
    warnings.warn(message, SceneWarning, stacklevel=4)


# -- how the faces of elements meet -----------------------------------------------------------------------------------


def _tables() -> tuple[NDArray[np.int8], NDArray[np.int8], NDArray[np.int8]]:
    """Return the triangles of every kind with every choice of diagonals, and how they hang together.

    Returns
    -------
    triangles : int8 array (75, 12, 3)
        Corners of the triangles of each shape, counter-clockwise from outside; -1 where there are fewer.
    turn : int8 array (75, 12, 3)
        The triangle of the same shape beyond the edge between a triangle's corners j and j + 1.
    quads : int8 array (9, 6, 4)
        Corners of the quadrilaterals of each kind, by its number of corners.

    """
    triangles, turn, quads = [], [], np.full((9, 6, 4), -1, np.int8)
    for kind, faces in FACES.items():
        squares: list[tuple[int, ...]] = [face for face in faces if len(face) == 4]
        for q, square in enumerate(squares):
            quads[kind, q] = square
        for choice in range(1 << len(squares)):
            rows: list[tuple[int, ...]] = []
            for face in faces:
                if len(face) == 3:
                    rows.append(face)
                elif choice >> squares.index(face) & 1:
                    rows += [(face[0], face[1], face[3]), (face[1], face[2], face[3])]
                else:
                    rows += [(face[0], face[1], face[2]), (face[0], face[2], face[3])]
            owner = {(row[j], row[(j + 1) % 3]): n for n, row in enumerate(rows) for j in range(3)}
            beyond = [tuple(owner[row[(j + 1) % 3], row[j]] for j in range(3)) for row in rows]
            empty: list[tuple[int, ...]] = [(-1, -1, -1)] * (SIDES - len(rows))
            triangles.append(rows + empty)
            turn.append(beyond + empty)
    return np.array(triangles, np.int8), np.array(turn, np.int8), quads


TRIANGLES, TURN, _QUADS = _tables()


@njit(cache=True, nogil=True, error_model="numpy")
def _inspect(points, first, corners):  # type: ignore[no-untyped-def]
    """Return the shape of each element and its signed volume, 0 if that is within rounding.

    A shape counts through the kinds and, within a kind, its diagonals as bits: bit i is set if quadrilateral i is split
    between its corners 1 and 3, because one of these has the lowest id.
    """
    n = len(first) - 1
    shape, volume = np.zeros(n, np.uint8), np.zeros(n)
    base = np.array([0, 0, 0, 0, 0, 1, 3, 0, 11])
    p = np.zeros((8, 3))
    for e in range(n):
        start, k = first[e], first[e + 1] - first[e]
        for i in range(k):
            for axis in range(3):
                p[i, axis] = np.float64(points[corners[start + i], axis]) - np.float64(points[corners[start], axis])
        extent = 0.0
        for i in range(1, k):
            extent = max(extent, abs(p[i, 0]), abs(p[i, 1]), abs(p[i, 2]))
        chosen = 0
        for q in range(6):
            if _QUADS[k, q, 0] < 0:
                break
            lowest = 0
            for j in range(1, 4):
                if corners[start + _QUADS[k, q, j]] < corners[start + _QUADS[k, q, lowest]]:
                    lowest = j
            chosen |= (lowest & 1) << q
        shape[e] = base[k] + chosen
        six = 0.0
        for t in range(2 * k - 4):
            a, b, c = TRIANGLES[shape[e], t, 0], TRIANGLES[shape[e], t, 1], TRIANGLES[shape[e], t, 2]
            six += (
                p[a, 0] * (p[b, 1] * p[c, 2] - p[b, 2] * p[c, 1])
                + p[a, 1] * (p[b, 2] * p[c, 0] - p[b, 0] * p[c, 2])
                + p[a, 2] * (p[b, 0] * p[c, 1] - p[b, 1] * p[c, 0])
            )
        volume[e] = six / 6.0 if abs(six) > 6.0 * _FLAT * extent**3 else 0.0
    return shape, volume


@njit(cache=True, nogil=True, error_model="numpy")
def _pair(first, corners, shape, part):  # type: ignore[no-untyped-def]
    """Return what lies behind each triangle: see `Elements.across`.

    Triangles meet in a hash table with open addressing. Two are one face if they have the same points, turn opposite
    ways and belong to the same part; of more than two, the first ones pair up and the others stay on the boundary.
    """
    n = len(first) - 1
    count = 2 * first[n] - 4 * n
    across = np.full(count, -1, np.int32)
    code = np.zeros(count, np.int32)
    slots = 16
    while slots < 2 * count:
        slots *= 2
    table = np.full(slots, -1, np.int32)
    key = np.zeros((count, 3), np.int32)
    parity = np.zeros(count, np.bool_)
    row = 0
    for e in range(n):
        for t in range(2 * (first[e + 1] - first[e]) - 4):
            a = corners[first[e] + TRIANGLES[shape[e], t, 0]]
            b = corners[first[e] + TRIANGLES[shape[e], t, 1]]
            c = corners[first[e] + TRIANGLES[shape[e], t, 2]]
            odd = False
            if a > b:
                a, b, odd = b, a, not odd
            if b > c:
                b, c, odd = c, b, not odd
            if a > b:
                a, b, odd = b, a, not odd
            code[row] = 16 * e + t
            if b not in (a, c):
                key[row, 0], key[row, 1], key[row, 2], parity[row] = a, b, c, odd
                mixed = np.uint64(a) * np.uint64(0x9E3779B97F4A7C15) + np.uint64(b)
                mixed = (mixed ^ (mixed >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9) + np.uint64(c)
                mixed = (mixed ^ (mixed >> np.uint64(32))) * np.uint64(0x94D049BB133111EB)
                slot = np.int64(mixed >> np.uint64(24)) & (slots - 1)
                while table[slot] >= 0:
                    other = table[slot]
                    if (
                        key[other, 0] == a
                        and key[other, 1] == b
                        and key[other, 2] == c
                        and across[other] < 0
                        and parity[other] != odd
                        and part[code[other] >> 4] == part[e]
                    ):
                        break
                    slot = (slot + 1) & (slots - 1)
                if table[slot] >= 0:
                    other = table[slot]
                    across[row], across[other] = code[other], code[row]
                else:
                    table[slot] = row
            row += 1
    return across


# -- files ------------------------------------------------------------------------------------------------------------

_KINDS = {10: 4, 14: 5, 13: 6, 12: 8, 11: 8}
"""Corners of the VTK cell types that are read."""

_VOXEL, _VOXEL_ORDER = 11, (0, 1, 3, 2, 4, 5, 7, 6)

_THIN = (*range(10), 21, 22, 23, 28, 30, 34, 35, 36, 68, 69, 70, 75, 76, 77)
"""VTK cell types of points, lines and surfaces."""

_PART_ARRAYS = ("part", "partition")


def read_elements(path: Path) -> Elements:
    """Read an unstructured mesh from a VTK file (.vtu, or legacy .vtk), through pyvista.

    The scalar is the first array with one number a point, else the first with one a cell, averaged to the points, else
    the height above the lowest point. The part is the cell array ``part`` or ``partition``, else 0. Points, lines and
    surfaces between the elements are skipped. The transfer function is a plain `ramp` over the scalar's range.

    Parameters
    ----------
    path : Path

    Raises
    ------
    SceneError
        If pyvista is not installed, or the file is missing, unreadable, no unstructured mesh, or has other elements
        than tetrahedra, pyramids, wedges, hexahedra and voxels; the message names the file.

    """
    if path.suffix.lower() not in {".vtu", ".vtk"}:
        raise SceneError(f"{path}: unknown format {path.suffix!r} of unstructured meshes (known: .vtu, .vtk)")
    if not path.is_file():
        raise SceneError(f"{path}: {'this is a folder, expected a file' if path.is_dir() else 'there is no such file'}")
    try:
        grid = read_vtk(path)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    import pyvista

    if not isinstance(grid, pyvista.UnstructuredGrid):
        raise SceneError(f"{path}: expected an unstructured grid, this is a {type(grid).__name__}")
    try:
        return _from_grid(grid, path)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


def _from_grid(grid: Any, path: Path) -> Elements:
    import pyvista

    types = np.asarray(grid.celltypes)
    refused = types[~np.isin(types, [*_KINDS, *_THIN])]
    if len(refused):
        name = pyvista.CellType(int(refused[0])).name.lower().replace("_", " ")
        raise SceneError(
            f"{len(refused)} of {len(types)} cells are of a kind that is not traced, the first a {name} "
            f"(known: {', '.join(NAMES.values())}): subdivide or triangulate them first"
        )
    chosen = np.flatnonzero(np.isin(types, list(_KINDS)))
    if len(chosen) == 0:
        raise SceneError(f"no elements: none of the {len(types)} cells is three-dimensional")
    types = types[chosen]
    kind = np.array([_KINDS.get(t, 0) for t in range(128)], np.uint8)[types]
    first = np.concatenate([[0], np.cumsum(kind, dtype=np.int64)])
    offsets = np.asarray(pyvista.convert_array(grid.GetCells().GetOffsetsArray()))
    rows = np.repeat(offsets[:-1][chosen] - first[:-1], kind) + np.arange(first[-1])
    corners = np.asarray(grid.cell_connectivity)[rows].astype(np.int32)
    start = first[:-1][types == _VOXEL][:, None]
    corners[start + np.arange(8)] = corners[start + np.array(_VOXEL_ORDER)]
    points = np.asarray(grid.points, np.float32)
    if corners.min() < 0 or corners.max() >= len(points):
        raise SceneError(f"a cell points to point {corners.max()} of {len(points)}: the file is damaged")
    part = np.zeros(len(chosen), np.int32)
    for name, values in _arrays(grid.cell_data):
        if name.lower() in _PART_ARRAYS:
            part = np.unique(values[chosen], return_inverse=True)[1].astype(np.int32)
            break
    scalars = _scalars(grid, points, chosen, corners, kind, path)
    finite = scalars[np.isfinite(scalars)]
    low, high = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 1.0)
    size = float(np.linalg.norm(np.ptp(points[corners].astype(np.float64), axis=0)))
    unit = 0.1 * size if np.isfinite(size) and size > 0.0 else 1.0
    return Elements(points, scalars, first, corners, kind, part, ramp(low, high, unit))


def _arrays(data: Any) -> list[tuple[str, NDArray[Any]]]:
    """Return the arrays with one number an entry that are no book-keeping of VTK's own, in the order of the file."""
    named = [(name, np.asarray(data[name])) for name in data.keys()]  # noqa: SIM118 - iterating gives arrays
    return [(n, a) for n, a in named if a.ndim == 1 and a.dtype.kind in "fiu" and not n.lower().startswith("vtk")]


def _scalars(grid: Any, points: F32, chosen: I64, corners: I32, kind: U8, path: Path) -> F32:
    for _, values in _arrays(grid.point_data):
        return values.astype(np.float32)
    for name, values in _arrays(grid.cell_data):
        if name.lower() not in _PART_ARRAYS:
            total = np.bincount(corners, np.repeat(values[chosen].astype(np.float64), kind), len(points))
            return (total / np.maximum(np.bincount(corners, minlength=len(points)), 1)).astype(np.float32)
    message = f"{path}: no array with one number a point or cell; the height above the lowest point takes its place"
    warnings.warn(message, SceneWarning, stacklevel=4)
    height: F32 = points[:, 2] - np.nanmin(points[:, 2])
    return height
