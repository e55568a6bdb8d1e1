"""Isosurfaces of synthesized fields, cut into domains by a rectilinear grid of planes.

Scenes of SpRay's kind (section 5 of its paper): every domain holds the isosurface of its own cells, and a domain
without triangles is none. Each domain becomes one object of one mesh with one instance, in the order of the grid, x
fastest, so that the partition is given with the scene. Neighbours share the vertices between them to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays.isosurface import isosurface
from simrender.rays.scene import F32, I32, IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from workloads.terrain import I64

Planes = tuple[I64, I64, I64]
"""Where a grid cuts along x, y and z, in cells: from 0 to the number of cells, ascending."""

Palette = Sequence[tuple[float, float, float]]


def surface_scene(
    voxels: F32,
    spacing: tuple[float, float, float],
    value: float,
    planes: Planes,
    *,
    palette: Palette,
    environment: Environment,
    sun: PointLight | None = None,
) -> Scene:
    """Return the isosurface of a field as a scene of one object for each domain that holds any of it.

    Parameters
    ----------
    voxels : float32 array (nz, ny, nx)
    spacing : (x, y, z)
        The first point lies at the origin.
    value : float
        The surface lies between voxels above it and voxels at most as large.
    planes : three int64 arrays
    palette : sequence of (r, g, b)
        Colours of the surface from the lowest to the highest z.
    environment : Environment
    sun : PointLight, optional
        By default light comes from everywhere above a surface, which is SpRay's light of many shadow rays.

    Raises
    ------
    SceneError
        If no domain holds any of the surface.

    """
    things = []
    top = spacing[2] * (len(voxels) - 1)
    held = holding(voxels, value, planes)
    for (iz, iy, ix), cells in zip(np.ndindex(held.shape), bricks(planes), strict=True):
        if held[iz, iy, ix]:
            surface = isosurface(voxels, (0.0, 0.0, 0.0), spacing, value, cells)
            if len(surface.faces):
                colors = _shades(surface.vertices[:, 2] / top, palette)
                mesh = Mesh(surface.vertices, surface.faces, colors=colors, smooth=True)
                things.append(SceneObject(f"domain {ix} {iy} {iz}", (mesh,)))
    if not things:
        raise SceneError(f"no voxel lies above the isovalue {value}, or none below: there is no isosurface")
    return Scene(
        tuple(things),
        np.arange(len(things), dtype=np.int32),
        np.tile(IDENTITY, (len(things), 1, 1)),
        (Material((0.8, 0.8, 0.8)),),
        (sun,) if sun else (),
        environment,
        hemispheres=() if sun else ((0.45, 0.45, 0.45),),
    )


def bricks(planes: Planes) -> I32:
    """Return the cells (x0, x1, y0, y1, z0, z1) of each domain of a grid, x fastest, int32 (domains, 6)."""
    x, y, z = planes
    counts = len(z) - 1, len(y) - 1, len(x) - 1
    k, j, i = (index.ravel() for index in np.indices(counts))
    return np.stack([x[i], x[i + 1], y[j], y[j + 1], z[k], z[k + 1]], axis=1).astype(np.int32)


def even_planes(dims: tuple[int, int, int], counts: tuple[int, int, int]) -> Planes:
    """Return planes that cut the cells between ``dims`` points into ``counts`` equal parts, as far as they divide.

    Raises
    ------
    SceneError
        If there are fewer cells than parts.

    """
    if any(n - 1 < count for n, count in zip(dims, counts, strict=True)):
        raise SceneError(f"{dims} points are too few for {counts} domains: each needs a cell along each axis")
    x, y, z = (np.linspace(0, n - 1, count + 1).round().astype(np.int64) for n, count in zip(dims, counts, strict=True))
    return x, y, z


def balanced_planes(weight: NDArray[np.bool_], counts: tuple[int, int, int]) -> Planes:
    """Return planes between which lie equal shares of the marked cells, along each axis by itself.

    Parameters
    ----------
    weight : bool array (nz, ny, nx) of cells
    counts : (int, int, int)
        Parts along x, y and z.

    """
    planes = []
    for axis, count in zip((2, 1, 0), counts, strict=True):
        line = np.cumsum(weight.sum(axis=tuple(a for a in range(3) if a != axis)))
        cut = np.searchsorted(line, line[-1] * np.arange(1, count) / count) + 1
        # A part has a cell at least, wherever the weights lie.
        cut = np.maximum.accumulate(cut - np.arange(count - 1)) + np.arange(count - 1)
        cut = np.minimum(cut, len(line) - np.arange(count - 1, 0, -1))
        planes.append(np.concatenate([[0], cut, [len(line)]]).astype(np.int64))
    return planes[0], planes[1], planes[2]


def crossed(voxels: F32, value: float) -> NDArray[np.bool_]:
    """Tell which cells hold a piece of the isosurface, bool (nz - 1, ny - 1, nx - 1)."""
    some = every = voxels > np.float64(value)
    for axis in range(3):
        low = [slice(None)] * 3
        high = [slice(None)] * 3
        low[axis], high[axis] = slice(None, -1), slice(1, None)
        some = some[tuple(low)] | some[tuple(high)]
        every = every[tuple(low)] & every[tuple(high)]
    return np.asarray(some & ~every)


def holding(voxels: F32, value: float, planes: Planes) -> NDArray[np.bool_]:
    """Tell which domains hold a piece of the isosurface, bool (along z, y, x)."""
    low, high = value_ranges(voxels, planes)
    return np.asarray((low <= np.float64(value)) & (high > np.float64(value)))


def value_ranges(voxels: F32, planes: Planes) -> tuple[F32, F32]:
    """Return the smallest and the largest value in each domain, float32 (along z, y, x)."""
    low, high = voxels, voxels
    for axis, cuts in zip((2, 1, 0), planes, strict=True):
        low = np.minimum(np.minimum.reduceat(low, cuts[:-1], axis), np.take(low, cuts[1:], axis))
        high = np.maximum(np.maximum.reduceat(high, cuts[:-1], axis), np.take(high, cuts[1:], axis))
    return low, high


def level_leaving_empty(voxels: F32, planes: Planes, empty: int) -> float:
    """Return the highest isovalue that so many domains lie wholly above, halfway to the next.

    Raises
    ------
    SceneError
        If some domain lies wholly below it.

    """
    low, high = value_ranges(voxels, planes)
    lowest = np.sort(low.ravel())[::-1].astype(np.float64)
    # At the smallest value of a domain itself, that domain is not empty.
    value = float(0.5 * (lowest[empty - 1] + lowest[empty])) if empty else float(0.5 * (lowest[0] + high.min()))
    held = int(((low <= value) & (high > value)).sum())
    if held != low.size - empty:
        raise SceneError(f"no isovalue leaves exactly {empty} of {low.size} domains empty; take another seed or size")
    return value


def _shades(height: F32, palette: Palette) -> F32:
    stops = np.linspace(0.0, 1.0, len(palette))
    columns = [np.interp(height, stops, [color[c] for color in palette]) for c in range(3)]
    return np.stack(columns, axis=1).astype(np.float32)
