"""Isosurfaces of structured volumes, a brick at a time, without cracks between the bricks.

Lorensen and Cline, "Marching cubes: a high resolution 3D surface construction algorithm", SIGGRAPH 1987, with the table
of scikit-image, by which the two neighbours of a face always agree on the contour there. Which triangles a cell gets
depends only on which of its corners lie inside, so the table is asked with inside and outside alone. (Lewiner's method
also looks at the values, rounds near ties, and adds vertices that lie on no edge.) Where a vertex lies on its edge is
computed here, from the two voxels of the edge and their place in the whole volume, so bricks that share the edge get
the same vertex to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.errors import SceneError
from simrender.rays.scene import F32, I32, Mesh

if TYPE_CHECKING:
    from simrender.rays.volume import Volume

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class Surface(NamedTuple):
    """The isosurface in one brick.

    Attributes
    ----------
    vertices : float32 array (n, 3)
        World space. Vertices on a face that two bricks share are the same to the bit in both.
    faces : int32 array (m, 3)
        Counterclockwise when seen from the side of the lower values. No triangle has two equal vertices.
    normals : float32 array (n, 3)
        Unit normals, towards the lower values: the volume's gradient by central differences.

    """

    vertices: F32
    faces: I32
    normals: F32

    def mesh(self, material: int = 0, *, smooth: bool = True) -> Mesh | None:
        """Return the surface as a mesh, or None if it has no triangles."""
        return Mesh(self.vertices, self.faces, material, smooth=smooth) if len(self.faces) else None


class Isosurfaces(NamedTuple):
    """The isosurface of a volume cut into bricks.

    Attributes
    ----------
    surfaces : tuple of Surface
        One a brick, in the order of the bricks; some may be empty.
    triangles, vertices : int64 array (bricks,)
        How many each has.
    distinct_vertices : int
        Vertices of the uncut surface: those on the faces between bricks are counted once.

    """

    surfaces: tuple[Surface, ...]
    triangles: I64
    vertices: I64
    distinct_vertices: int


def isosurface(
    voxels: F32, origin: ArrayLike, spacing: ArrayLike, value: float, cells: ArrayLike | None = None
) -> Surface:
    """Extract the surface on which a volume has a given value, of the whole volume or of one brick.

    Voxels above the value are inside. The surface ends at the volume's boundary. A voxel at exactly the value is
    outside; the vertices of all its edges fall together there, and the triangles that this makes degenerate are
    left out, which joins their neighbours.

    Parameters
    ----------
    voxels : float32 array (nz, ny, nx)
        The whole volume.
    origin, spacing : float (3,)
        Place of the first voxel and distance between voxels, in the order x, y, z.
    value : float
        The isovalue.
    cells : int (6,), optional
        The brick (x0, x1, y0, y1, z0, z1): cells x0 <= i < x1, of which cell i lies between voxels i and i + 1.

    Raises
    ------
    SceneError
        If the volume is less than two voxels thick, the value is not finite, or the brick not inside the volume.

    """
    if voxels.ndim != 3 or min(voxels.shape) < 2:
        raise SceneError(f"an isosurface needs a volume of at least 2 voxels along each axis, got {voxels.shape}")
    if not np.isfinite(value):
        raise SceneError(f"an isovalue is a finite number, got {value}")
    nz, ny, nx = voxels.shape
    whole = (0, nx - 1, 0, ny - 1, 0, nz - 1)
    x0, x1, y0, y1, z0, z1 = (int(c) for c in (whole if cells is None else np.asarray(cells)))
    if not (0 <= x0 < x1 < nx and 0 <= y0 < y1 < ny and 0 <= z0 < z1 < nz):
        raise SceneError(f"brick {(x0, x1, y0, y1, z0, z1)} is empty or reaches outside the cells {whole}")
    # As float64: a Python number would be rounded to float32, and might no longer lie between two voxels.
    inside = voxels[z0 : z1 + 1, y0 : y1 + 1, x0 : x1 + 1] > np.float64(value)
    if inside.all() or not inside.any():
        return Surface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    from skimage.measure import marching_cubes

    # Halfway between 0 and 1 every vertex lies at the middle of its edge, so twice its position has one odd coordinate,
    # along the edge, and halved downward is the edge's lower end.
    extract: Any = marching_cubes
    middle, faces, _, _ = extract(inside.astype(np.float32), 0.5, method="lorensen")
    twice = np.rint(2.0 * middle[:, ::-1]).astype(np.int64)
    axis = np.argmax(twice & 1, axis=1)
    start = twice // 2 + np.array([x0, y0, z0])
    along = np.eye(3, dtype=np.int64)[axis]
    end = start + along
    low, high = _at(voxels, start), _at(voxels, end)
    t = (value - low) / (high - low)
    vertices = _place(start + t[:, None] * along, origin, spacing)
    slopes = _gradient(voxels, start, spacing), _gradient(voxels, end, spacing)
    slope = (1.0 - t)[:, None] * slopes[0] + t[:, None] * slopes[1]
    flat = ~slope.any(axis=1)
    slope[flat] = (along * np.where(high > low, 1.0, -1.0)[:, None])[flat]
    normals = (-slope / np.linalg.norm(slope, axis=1, keepdims=True)).astype(np.float32)
    # Two vertices can meet only where edges do, at a voxel, unless float32 cannot tell the voxels apart there.
    ends = _place(start, origin, spacing), _place(end, origin, spacing)
    meeting = (vertices == ends[0]).all(axis=1) | (vertices == ends[1]).all(axis=1)
    if not _distinct(voxels.shape, origin, spacing):
        meeting[:] = True
    return _joined(Surface(vertices, faces.astype(np.int32), normals), np.flatnonzero(meeting))


def isosurfaces(volume: Volume, value: float, bricks: Sequence[ArrayLike] | I32) -> Isosurfaces:
    """Extract the isosurface of a volume brick by brick.

    Parameters
    ----------
    volume : Volume
    value : float
    bricks : int (bricks, 6)
        As ``cells`` of `isosurface`; they share faces, not cells.

    Raises
    ------
    SceneError
        As `isosurface`.

    """
    surfaces, shared = [], []
    for brick in np.asarray(bricks, dtype=np.int64).reshape(-1, 6):
        surface = isosurface(volume.voxels, volume.origin, volume.spacing, value, brick)
        surfaces.append(surface)
        corners = _place(brick.reshape(3, 2).T, volume.origin, volume.spacing)
        on_face = ((surface.vertices == corners[0]) | (surface.vertices == corners[1])).any(axis=1)
        shared.append(surface.vertices[on_face])
    count = np.array([len(s.vertices) for s in surfaces], dtype=np.int64)
    repeated = 0
    if shared:
        every = np.concatenate(shared)
        repeated = len(every) - len(np.unique(_rows(every)))
    triangles = np.array([len(s.faces) for s in surfaces], dtype=np.int64)
    return Isosurfaces(tuple(surfaces), triangles, count, int(count.sum()) - repeated)


def _at(voxels: F32, index: I64) -> F64:
    """Return the voxels at indices in the order x, y, z."""
    return voxels[index[:, 2], index[:, 1], index[:, 0]].astype(np.float64)


def _place(index: NDArray[np.float64] | I64, origin: ArrayLike, spacing: ArrayLike) -> F32:
    """Return the world position of indices, without negative zeros, which would compare equal but differ in bits."""
    return (np.asarray(origin, np.float64) + index * np.asarray(spacing, np.float64)).astype(np.float32) + np.float32(0)


def _gradient(voxels: F32, index: I64, spacing: ArrayLike) -> F64:
    """Return the gradient at voxels by central differences, one-sided at the volume's boundary, float64 (n, 3)."""
    step = np.asarray(spacing, np.float64)
    result = np.empty(index.shape)
    for axis in range(3):
        low, high = index.copy(), index.copy()
        low[:, axis] = np.maximum(index[:, axis] - 1, 0)
        high[:, axis] = np.minimum(index[:, axis] + 1, voxels.shape[2 - axis] - 1)
        span = (high[:, axis] - low[:, axis]) * step[axis]
        result[:, axis] = (_at(voxels, high) - _at(voxels, low)) / span
    return result


def _distinct(shape: tuple[int, ...], origin: ArrayLike, spacing: ArrayLike) -> bool:
    """Tell whether neighbouring voxels have different positions in float32."""
    index = np.zeros((max(shape), 3), np.int64)
    for axis, n in enumerate(reversed(shape)):
        index[:n, axis] = np.arange(n)
    place = _place(index, origin, spacing)
    return all((np.diff(place[:n, axis]) != 0.0).all() for axis, n in enumerate(reversed(shape)))


def _rows(vertices: F32) -> NDArray[np.void]:
    """Return each vertex as one value that compares by its bits."""
    return np.ascontiguousarray(vertices).view(np.dtype((np.void, 12))).ravel()


def _joined(surface: Surface, meeting: I64) -> Surface:
    """Give vertices at the same place one number, and leave out triangles of which two corners have become one."""
    number = np.arange(len(surface.vertices))
    if len(meeting):
        _, first, which = np.unique(_rows(surface.vertices[meeting]), return_index=True, return_inverse=True)
        number[meeting] = meeting[first][which]
    faces = number[surface.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used = np.zeros(len(number), dtype=bool)
    used[faces] = True
    renumbered = (np.cumsum(used) - 1).astype(np.int32)
    return Surface(surface.vertices[used], renumbered[faces], surface.normals[used])
