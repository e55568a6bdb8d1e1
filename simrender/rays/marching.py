"""Absorption and emission along rays through a volume, in equal steps.

This is what a rank of the sort-last renderer does (islands paper, section 4): it samples its brick in equidistant
steps, looks colour and extinction up in the transfer function, shades by the gradient, and stops at 99 % opacity.

Sample i of a ray lies (i + 1/2) steps from the ray's *origin*, and belongs to the brick that its grid cell belongs to.
Neither depends on the partition, so the samples that the bricks of a ray take together are those that one brick over
the whole volume takes, each exactly once, on faces, edges and corners too. As every rounding along the way is monotone
in i, a brick's samples are consecutive: a row finds its first and last one exactly and then asks no more.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.volume import Volume, check_bricks, find_row, interpolate

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
Ids = NDArray[np.int64]

OPACITY_LIMIT = 0.99
"""Opacity at which a ray has seen enough (islands paper, section 4.1)."""

_AMBIENT = 0.4
_SIGNIFICANT = 0.01
"""Share of the volume's value range per cell from which on a gradient is taken for a surface's normal."""


@dataclass(frozen=True, eq=False)
class Marched:
    """What came of each (ray, brick) row.

    Attributes
    ----------
    rgba : float32 array (n, 4)
        Colour and opacity, premultiplied; all 0 for a row without a sample.
    samples : int32 array (n,)
        Samples taken.
    entry, exit : float32 array (n,)
        The stretch of the ray that the row's samples stand for; the stretches of bricks that follow each other abut.
        Infinite for a row without a sample. The exit is where the ray would leave if it were not stopped.
    done : bool array (n,)
        Whether the opacity limit ended the march.

    """

    rgba: F32
    samples: I32
    entry: F32
    exit: F32
    done: NDArray[np.bool_]


def march(
    volume: Volume,
    step: float,
    rays: Mapping[str, Any],
    row_ray: Ids,
    row_cells: I32,
    *,
    shading: bool = True,
    opacity_limit: float = OPACITY_LIMIT,
) -> Marched:
    """Integrate colour and opacity along rays, each row a ray in one brick, on all cores.

    Parameters
    ----------
    volume : Volume
    step : float
        Distance between samples in world units.
    rays : mapping
        Columns ``origin`` and ``direction``, float32 (r, 3), directions of unit length, and ``reach``, float32 (r,).
    row_ray : int64 array (n,)
        The ray of each row.
    row_cells : int32 array (n, 6)
        The brick of each row: cells (x0, x1, y0, y1, z0, z1).
    shading : bool
        Whether samples are lit by a headlight, on both sides, where the gradient is significant.
    opacity_limit : float
        Opacity at which a row ends; 1 for never.

    Raises
    ------
    SceneError
        If the step is not a length above 0, or so small that a ray's samples could not be counted; if a brick does not
        consist of whole macro cells of the volume.

    """
    spacing, origin = np.array(volume.spacing), np.array(volume.origin)
    diagonal = float(np.linalg.norm(spacing * volume.cells))
    if not (math.isfinite(step) and step > diagonal / 2**31):
        least = f"above {diagonal / 2**31:.3g}, the volume's diagonal over 2^31"
        raise SceneError(f"the step of a ray march is a length {least}, got {step}")
    check_bricks(volume, row_cells)
    n = len(row_ray)
    low, high = volume.value_range
    out = Marched(
        np.zeros((n, 4), np.float32),
        np.zeros(n, np.int32),
        np.full(n, np.inf, np.float32),
        np.full(n, np.inf, np.float32),
        np.zeros(n, np.bool_),
    )
    significant = _SIGNIFICANT * (high - low) / float(np.cbrt(spacing.prod()))

    def work(rows: slice) -> None:
        _march(
            volume.voxels,
            spacing,
            origin,
            volume.transfer.table,
            float(step),
            # An opacity of 1 is never reached: each sample lets some light through.
            1.0 - opacity_limit if opacity_limit < 1.0 else -1.0,
            significant if shading else -1.0,
            rays["origin"],
            rays["direction"],
            rays["reach"],
            row_ray[rows],
            row_cells[rows],
            out.rgba[rows],
            out.samples[rows],
            out.entry[rows],
            out.exit[rows],
            out.done[rows],
        )

    work(slice(0, 0))  # loads the kernel, or compiles it the first time
    embree.in_chunks(work, n)
    return out


def gradients(volume: Volume, points: NDArray[np.floating[Any]]) -> F32:
    """Return the gradient of the field at some points, by the central differences that shading uses.

    Parameters
    ----------
    volume : Volume
    points : float array (n, 3)
        In world units; points outside are taken to the volume's surface.

    Returns
    -------
    float32 array (n, 3)
        Change of value per world length.

    """
    spacing = np.array(volume.spacing)
    grid = (np.asarray(points, np.float64) - np.array(volume.origin)) / spacing
    found = np.empty((len(grid), 3), np.float32)
    _gradients(volume.voxels, spacing, np.clip(grid, 0.0, np.array(volume.cells, np.float64)), found)
    return found


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def opacity(tau):  # type: ignore[no-untyped-def]
    """Return 1 - exp(-tau), by its series for thin slabs, where the difference would cancel."""
    if tau < 0.03125:
        square = tau * tau
        tail = (1.0 / 120.0 - tau * (1.0 / 720.0)) + square * (1.0 / 5040.0)
        return tau * ((1.0 - tau * 0.5) + square * ((1.0 / 6.0 - tau * (1.0 / 24.0)) + square * tail))
    return 1.0 - math.exp(-tau)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _difference(flat, at, along, before, after, w0, w1, f):  # type: ignore[no-untyped-def]
    """Interpolate between the central differences at two grid points that follow each other along an axis."""
    d0 = (flat[at + along] - flat[at - before]) * w0
    d1 = (flat[at + after] - flat[at]) * w1
    return d0 + f * (d1 - d0)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _slope(flat, base, i, n, along, f, s, fs, t, ft):  # type: ignore[no-untyped-def]
    """Interpolate the central differences along one axis; across it lie the strides s and t.

    At the volume's first and last grid point the difference is one-sided; elsewhere it takes a ghost layer.
    """
    inner0, inner1 = i > 0, i + 2 < n
    before, w0 = (along, np.float32(0.5)) if inner0 else (np.uint64(0), np.float32(1.0))
    after, w1 = (along + along, np.float32(0.5)) if inner1 else (along, np.float32(1.0))
    d00 = _difference(flat, base, along, before, after, w0, w1, f)
    d01 = _difference(flat, base + s, along, before, after, w0, w1, f)
    d10 = _difference(flat, base + t, along, before, after, w0, w1, f)
    d11 = _difference(flat, base + s + t, along, before, after, w0, w1, f)
    d0 = d00 + fs * (d01 - d00)
    d1 = d10 + fs * (d11 - d10)
    return d0 + ft * (d1 - d0)


@njit(cache=True, nogil=True, error_model="numpy")
def _gradients(voxels, spacing, grid, found):  # type: ignore[no-untyped-def]
    """Fill the gradient at points in grid coordinates that lie inside the volume."""
    nz, ny, nx = voxels.shape
    flat = voxels.reshape(-1)
    one, row, plane = np.uint64(1), np.uint64(nx), np.uint64(nx * ny)
    for p in range(len(grid)):
        gx, gy, gz = grid[p, 0], grid[p, 1], grid[p, 2]
        ix, iy, iz = min(int(gx), nx - 2), min(int(gy), ny - 2), min(int(gz), nz - 2)
        base = np.uint64((iz * ny + iy) * nx + ix)
        fx, fy, fz = np.float32(gx - ix), np.float32(gy - iy), np.float32(gz - iz)
        found[p, 0] = _slope(flat, base, ix, nx, one, fx, row, fy, plane, fz) / spacing[0]
        found[p, 1] = _slope(flat, base, iy, ny, row, fy, one, fx, plane, fz) / spacing[1]
        found[p, 2] = _slope(flat, base, iz, nz, plane, fz, one, fx, row, fy) / spacing[2]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _within(i, step, reach, g, d, low, high):  # type: ignore[no-untyped-def]
    """Whether sample i lies in the brick: the one rule that all else here must agree with."""
    t = (i + 0.5) * step
    x, y, z = g[0] + t * d[0], g[1] + t * d[1], g[2] + t * d[2]
    return t <= reach and low[0] <= x < high[0] and low[1] <= y < high[1] and low[2] <= z < high[2]


@njit(cache=True, nogil=True, error_model="numpy")
def _first_at(i, step, g, d, bound, end):  # type: ignore[no-untyped-def]
    """Return the first sample, from i up to ``end``, whose coordinate has come to ``bound``; d is not 0."""
    while i < end:
        middle = (i + end) // 2
        at = g + (middle + 0.5) * step * d
        if (at >= bound) if d > 0.0 else (at < bound):
            end = middle
        else:
            i = middle + 1
    return i


@njit(cache=True, nogil=True, error_model="numpy")
def _samples(step, reach, g, d, low, high, spacing):  # type: ignore[no-untyped-def]
    """Return a ray's first sample in a brick and the first one after it, equal if there is none.

    An estimate from distances is off where they round, so it is only taken if the samples about it confirm it. They do
    with few exceptions; the rest is bisected, axis by axis.
    """
    near, far, away = 0.0, float(reach), 0.0
    for axis in range(3):
        # No point of the brick is farther off than this, even along an axis that the ray hardly moves on.
        away += max(abs(low[axis] - g[axis]), abs(high[axis] - g[axis])) * spacing[axis]
        if d[axis] == 0.0:
            if not (low[axis] <= g[axis] and g[axis] < high[axis]):
                return 0, 0
            continue
        t0, t1 = (low[axis] - g[axis]) / d[axis], (high[axis] - g[axis]) / d[axis]
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    last = int(min(away * 1.001, float(reach)) / step) + 1
    first = int(min(max(math.ceil(near / step - 0.5), 0.0), last))
    end = int(min(max(math.floor(far / step - 0.5) + 1.0, 0.0), last))
    if (
        first < end
        and _within(first, step, reach, g, d, low, high)
        and _within(end - 1, step, reach, g, d, low, high)
        and not _within(end, step, reach, g, d, low, high)
        and (first == 0 or not _within(first - 1, step, reach, g, d, low, high))
    ):
        return first, end
    first, end = 0, last + 1
    for axis in range(3):
        if d[axis] > 0.0:
            first = max(first, _first_at(0, step, g[axis], d[axis], low[axis], last + 1))
            end = min(end, _first_at(0, step, g[axis], d[axis], high[axis], last + 1))
        elif d[axis] < 0.0:
            first = max(first, _first_at(0, step, g[axis], d[axis], high[axis], last + 1))
            end = min(end, _first_at(0, step, g[axis], d[axis], low[axis], last + 1))
    while end > first and (end - 0.5) * step > reach:
        end -= 1
    return first, max(first, end)


@njit(cache=True, nogil=True, error_model="numpy")
def _march(  # type: ignore[no-untyped-def]
    voxels, spacing, corner, table, step, dark, significant, origin, direction, reach, row_ray, row_cells,
    rgba, samples, entry, leave, done,
):  # fmt: skip
    """Fill the outcome of each row; ``dark`` is the transmittance that ends a row."""
    nz, ny, nx = voxels.shape
    flat = voxels.reshape(-1)
    one, stride, plane = np.uint64(1), np.uint64(nx), np.uint64(nx * ny)
    per_x, per_y, per_z = 1.0 / spacing[0], 1.0 / spacing[1], 1.0 / spacing[2]
    g, d, low, high = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for row in range(len(row_ray)):
        ray = row_ray[row]
        for axis in range(3):
            g[axis] = (float(origin[ray, axis]) - corner[axis]) / spacing[axis]
            d[axis] = float(direction[ray, axis]) / spacing[axis]
            low[axis], high[axis] = float(row_cells[row, 2 * axis]), float(row_cells[row, 2 * axis + 1])
            # The volume's last face belongs to its last cell, every other face to the cell above it.
            if high[axis] == voxels.shape[2 - axis] - 1.0:
                high[axis] = np.nextafter(high[axis], np.inf)
        first, end = _samples(step, reach[ray], g, d, low, high, spacing)
        if first == end:
            continue
        x0, y0, z0, dx, dy, dz = g[0], g[1], g[2], d[0], d[1], d[2]
        red, green, blue, through = 0.0, 0.0, 0.0, 1.0
        k, taken = 0, 0
        for i in range(first, end):
            t = (i + 0.5) * step
            gx, gy, gz = x0 + t * dx, y0 + t * dy, z0 + t * dz
            ix, iy, iz = min(int(gx), nx - 2), min(int(gy), ny - 2), min(int(gz), nz - 2)
            fx, fy, fz = np.float32(gx - ix), np.float32(gy - iy), np.float32(gz - iz)
            base = np.uint64((iz * ny + iy) * nx + ix)
            value = max(float(interpolate(flat, base, stride, plane, fx, fy, fz)), table[0, 0])
            taken += 1
            k = find_row(table, value, k)
            past = value - table[k, 0]
            tau = (table[k, 1] + past * table[k, 2]) * step
            if tau <= 0.0:
                continue
            weight = through * opacity(tau)
            through -= weight
            light = weight
            if significant >= 0.0:
                sx = _slope(flat, base, ix, nx, one, fx, stride, fy, plane, fz) * per_x
                sy = _slope(flat, base, iy, ny, stride, fy, one, fx, plane, fz) * per_y
                sz = _slope(flat, base, iz, nz, plane, fz, one, fx, stride, fy) * per_z
                square = sx * sx + sy * sy + sz * sz
                if square > significant * significant:
                    along = sx * direction[ray, 0] + sy * direction[ray, 1] + sz * direction[ray, 2]
                    light *= _AMBIENT + (1.0 - _AMBIENT) * abs(along) / math.sqrt(square)
            red += light * (table[k, 3] + past * table[k, 4])
            green += light * (table[k, 5] + past * table[k, 6])
            blue += light * (table[k, 7] + past * table[k, 8])
            if through <= dark:
                done[row] = True
                break
        rgba[row, 0], rgba[row, 1], rgba[row, 2], rgba[row, 3] = red, green, blue, 1.0 - through
        samples[row] = taken
        entry[row], leave[row] = first * step, end * step
