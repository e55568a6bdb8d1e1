"""Woodcock tracking through a volume, and its isosurfaces in the same traversal.

This is what a rank of the volume path tracer does (islands paper, section 6): it walks a ray over macro cells, takes
tentative collisions as often as a macro cell's majorant asks for, and rejects those that are not real (Woodcock et al.,
"Techniques used in the GEM code for Monte Carlo neutronics calculations", 1965). In a macro cell that an isosurface may
cross it walks the cells one by one; within a cell the field along a ray is a cubic, which is cut at its extrema into
monotone pieces (Marmitt et al., "Fast and accurate ray-voxel intersection techniques for iso-surface ray tracing",
VMV 2004).

What happens in a macro cell depends on the ray and that macro cell alone, so a ray that is tracked brick after brick
meets, to the bit, what it meets in one brick over the whole volume:

- A ray's way is the merge of its crossings of the grid planes of each axis, ordered by (distance, axis). Each distance
  is computed from the plane, never by adding up, and a brick is entered in the middle of that sequence.
- A free path has no memory, so it may start afresh wherever a macro cell begins, with the macro cell's own random
  numbers: a hash of the ray's key, the macro cell's id and a counter.
- Where the ray meets a face between two cells, both compute the field from the four voxels they share, in the same
  order, with the same result. So the surface has no holes between cells, and nothing is found twice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.rays import embree
from simrender.rays.sampling import path_key, uniform
from simrender.rays.volume import MACRO, Volume, check_bricks, find_row, interpolate

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
U64 = NDArray[np.uint64]
Ids = NDArray[np.int64]

NOTHING, SCATTER, ISOSURFACE = 0, 1, 2
"""What ends a row: the ray leaves the brick or its reach, collides with the medium, or hits an isosurface."""

_HALVINGS = 32
"""Of a cell's part of the ray, to find a surface: finer than a float32 distance can tell."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """What came of each (ray, brick) row.

    Attributes
    ----------
    t : float32 array (n,)
        Distance of the event along the ray; infinite for none.
    event : uint8 array (n,)
        `NOTHING`, `SCATTER` or `ISOSURFACE`.
    value : float32 array (n,)
        The field there: at a collision what was sampled, on an isosurface its isovalue; NaN for no event.
    samples : int32 array (n,)
        Look-ups: tentative collisions, real and null, and cells searched for an isosurface.
    cells : int32 array (n,)
        Macro cells that the ray walked over.

    """

    t: F32
    event: NDArray[np.uint8]
    value: F32
    samples: I32
    cells: I32


def track(
    volume: Volume,
    rays: Mapping[str, Any],
    keys: U64,
    row_ray: Ids,
    row_cells: I32,
    *,
    majorant_scale: float = 1.0,
) -> Tracked:
    """Find the first collision or isosurface along rays, each row a ray in one brick, on all cores.

    Parameters
    ----------
    volume : Volume
    rays : mapping
        Columns ``origin`` and ``direction``, float32 (r, 3), directions of unit length, and ``reach``, float32 (r,).
    keys : uint64 array (r,)
        The source of each ray's random numbers, as `sampling.path_key` makes them.
    row_ray : int64 array (n,)
        The ray of each row.
    row_cells : int32 array (n, 6)
        The brick of each row: cells (x0, x1, y0, y1, z0, z1), whole macro cells.
    majorant_scale : float
        Factor >= 1 on all majorants: more null collisions, the same distribution of the real ones.

    Raises
    ------
    SceneError
        If a brick does not consist of whole macro cells of the volume.

    """
    check_bricks(volume, row_cells)
    n = len(row_ray)
    out = Tracked(
        np.full(n, np.inf, np.float32),
        np.zeros(n, np.uint8),
        np.full(n, np.nan, np.float32),
        np.zeros(n, np.int32),
        np.zeros(n, np.int32),
    )
    macro, spacing, origin = volume.macro, np.array(volume.spacing), np.array(volume.origin)
    majorant = macro.majorant * majorant_scale
    isovalues = np.array(volume.isovalues, np.float64)

    def work(rows: slice) -> None:
        _track(
            volume.voxels,
            spacing,
            origin,
            volume.transfer.table,
            macro.low,
            macro.high,
            majorant,
            isovalues,
            rays["origin"],
            rays["direction"],
            rays["reach"],
            keys,
            row_ray[rows],
            row_cells[rows],
            out.t[rows],
            out.event[rows],
            out.value[rows],
            out.samples[rows],
            out.cells[rows],
        )

    work(slice(0, 0))  # loads the kernel, or compiles it the first time
    embree.in_chunks(work, n)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def isotropic_direction(u1, u2):  # type: ignore[no-untyped-def]
    """Return a direction distributed evenly over the sphere, from two random numbers."""
    z = 1.0 - 2.0 * u1
    r, phi = math.sqrt(max(0.0, 1.0 - z * z)), 2.0 * math.pi * u2
    return r * math.cos(phi), r * math.sin(phi), z


# -- a ray's way over the grid ----------------------------------------------------------------------------------------
#
# Along an axis of n points, blocks of ``size`` cells count 0 .. m - 1; -1 and m are before and after the volume.


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _crossing(k, n, size, g, d):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray crosses the plane below block k. Never decreases along the ray."""
    return (min(k * size, n - 1) - g) / d


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _start(n, size, g):  # type: ignore[no-untyped-def]
    """Return the block that a ray's origin lies in: a plane belongs to the block above, the last one to that below."""
    blocks = (n - 2) // size + 1
    if g < 0.0:
        return -1
    return blocks if g > n - 1.0 else min(int(g) // size, blocks - 1)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _before(t, axis, at, at_axis):  # type: ignore[no-untyped-def]
    return t < at or (t == at and axis < at_axis)


@njit(cache=True, nogil=True, error_model="numpy")
def _block_at(at, at_axis, axis, n, size, g, d):  # type: ignore[no-untyped-def]
    """Return the block along one axis after all crossings before (distance, axis).

    The ray's position says about where that is; comparing the crossings themselves says exactly.
    """
    start = _start(n, size, g)
    if d == 0.0 or at_axis < 0:
        return start
    blocks = (n - 2) // size + 1
    guess = math.floor(min(max((g + at * d) / size, -1.0), float(blocks)))
    if d > 0.0:
        k = max(guess, start)
        while k > start and not _before(_crossing(k, n, size, g, d), axis, at, at_axis):
            k -= 1
        while k < blocks and _before(_crossing(k + 1, n, size, g, d), axis, at, at_axis):
            k += 1
    else:
        k = min(guess, start)
        while k < start and not _before(_crossing(k + 1, n, size, g, d), axis, at, at_axis):
            k += 1
        while k >= 0 and _before(_crossing(k, n, size, g, d), axis, at, at_axis):
            k -= 1
    return k


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _leaves(block, n, size, g, d):  # type: ignore[no-untyped-def]
    """Return the distance at which a ray leaves a block along one axis."""
    return np.inf if d == 0.0 else _crossing(block + (1 if d > 0.0 else 0), n, size, g, d)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _first(leaves):  # type: ignore[no-untyped-def]
    """Return the axis along which a ray leaves first."""
    axis = 0 if leaves[0] <= leaves[1] else 1
    return axis if leaves[axis] <= leaves[2] else 2


@njit(cache=True, nogil=True, error_model="numpy")
def _enter(n, g, d, low, high, block):  # type: ignore[no-untyped-def]
    """Find where a ray enters a brick of macro cells; return (distance, axis) and fill the first macro cell.

    The axis is -1 if the ray starts in the brick; the distance is infinite if it misses it.
    """
    at, at_axis = 0.0, -1
    for axis in range(3):
        start = _start(n[axis], MACRO, g[axis])
        if low[axis] <= start < high[axis]:
            continue
        if (d[axis] <= 0.0) if start < low[axis] else (d[axis] >= 0.0):
            return np.inf, -1
        t = _crossing(low[axis] if d[axis] > 0.0 else high[axis], n[axis], MACRO, g[axis], d[axis])
        if t >= at:  # of two axes at one distance the later one comes last
            at, at_axis = t, axis
    for axis in range(3):
        if axis == at_axis:
            block[axis] = low[axis] if d[axis] > 0.0 else high[axis] - 1
            continue
        block[axis] = _block_at(at, at_axis, axis, n[axis], MACRO, g[axis], d[axis])
        if not low[axis] <= block[axis] < high[axis]:
            return np.inf, -1
    return at, at_axis


# -- isosurfaces ------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _between(a, b, f):  # type: ignore[no-untyped-def]
    """Interpolate so that both ends are met exactly and nothing lies beyond them."""
    return min(max((1.0 - f) * a + f * b, min(a, b)), max(a, b))


@njit(cache=True, nogil=True, error_model="numpy")
def _field(v, x, y, z):  # type: ignore[no-untyped-def]
    """Return the field within a cell of corners v (8,), x fastest, at local coordinates 0 .. 1."""
    lower = _between(_between(v[0], v[1], x), _between(v[2], v[3], x), y)
    upper = _between(_between(v[4], v[5], x), _between(v[6], v[7], x), y)
    return _between(lower, upper, z)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _extrema(v, x, y, z, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Return where the cubic along a line through a cell turns, ascending; outside 0 .. 1 where it does not."""
    kx, ky, kz = v[1] - v[0], v[2] - v[0], v[4] - v[0]
    kxy, kyz, kxz = v[3] - v[2] - kx, v[6] - v[4] - ky, v[5] - v[4] - kx
    kxyz = v[7] - v[6] - v[5] + v[4] - v[3] + v[2] + v[1] - v[0]
    xy, yz, xz = dx * dy, dy * dz, dx * dz
    a = 3.0 * kxyz * xy * dz
    b = kxy * xy + kyz * yz + kxz * xz + kxyz * (x * yz + y * xz + z * xy)
    c = kx * dx + ky * dy + kz * dz + kxy * (x * dy + y * dx) + kyz * (y * dz + z * dy) + kxz * (x * dz + z * dx)
    c += kxyz * (x * y * dz + x * z * dy + y * z * dx)
    square = b * b - a * c
    if not square > 0.0:
        return -1.0, -1.0
    q = -(b + math.copysign(math.sqrt(square), b))
    first, second = c / q, q / a
    if second < first:
        return second, first
    return first, second


@njit(cache=True, nogil=True, error_model="numpy")
def _surface_in_cell(v, isovalues, line):  # type: ignore[no-untyped-def]
    """Return the first isosurface along a line through a cell, as (share of the line, isovalue); infinite for none.

    ``line`` (6,) holds the local coordinates at both ends. A value is above an isovalue or not; a surface lies where
    that changes, so a plateau at exactly the isovalue is bounded like any other.
    """
    x, y, z = line[0], line[1], line[2]
    dx, dy, dz = line[3] - x, line[4] - y, line[5] - z
    turns = _extrema(v, x, y, z, dx, dy, dz)
    a, value_a = 0.0, _field(v, x, y, z)
    for piece in range(3):
        if piece < 2:
            b = turns[piece]
            if not a < b < 1.0:
                continue
            value_b = _field(v, x + b * dx, y + b * dy, z + b * dz)
        else:
            b, value_b = 1.0, _field(v, line[3], line[4], line[5])
        rising, iso = value_a < value_b, np.nan
        for candidate in isovalues:
            crossed = min(value_a, value_b) < candidate <= max(value_a, value_b)
            if crossed and (math.isnan(iso) or (candidate < iso) == rising):
                iso = candidate
        if not math.isnan(iso):
            for _ in range(_HALVINGS):
                middle = 0.5 * (a + b)
                if (_field(v, x + middle * dx, y + middle * dy, z + middle * dz) >= iso) == rising:
                    b = middle
                else:
                    a = middle
            return 0.5 * (a + b), iso
        a, value_a = b, value_b
    return np.inf, np.nan


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _local(t, axis, last, c, g, d, line, at):  # type: ignore[no-untyped-def]
    """Fill the local coordinates of a ray's point in cell c; along ``axis`` it lies exactly on a face."""
    for a in range(3):
        if a == axis:
            line[at + a] = 1.0 if (d[a] > 0.0) == last else 0.0
        else:
            line[at + a] = min(max(g[a] + t * d[a] - c[a], 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy")
def _surface(flat, n, isovalues, block, at, at_axis, limit, g, d, c, leaves, v, line):  # type: ignore[no-untyped-def]
    """Walk the cells of a macro cell; return (distance, isovalue, cells searched) of the first isosurface."""
    for a in range(3):
        if a == at_axis:
            first, last = block[a] * MACRO, min((block[a] + 1) * MACRO, n[a] - 1) - 1
            c[a] = first if d[a] > 0.0 else last
        else:
            c[a] = _block_at(at, at_axis, a, n[a], 1, g[a], d[a])
        leaves[a] = _leaves(c[a], n[a], 1, g[a], d[a])
    one, row, plane = np.uint64(1), np.uint64(n[0]), np.uint64(n[0] * n[1])
    walked = 0
    while at <= limit:
        axis = _first(leaves)
        leave = leaves[axis]
        walked += 1
        base = np.uint64((c[2] * n[1] + c[1]) * n[0] + c[0])
        v[0], v[1], v[2], v[3] = flat[base], flat[base + one], flat[base + row], flat[base + row + one]
        base += plane
        v[4], v[5], v[6], v[7] = flat[base], flat[base + one], flat[base + row], flat[base + row + one]
        low = min(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
        high = max(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7])
        for candidate in isovalues:
            if low < candidate <= high:
                _local(at, at_axis, False, c, g, d, line, 0)
                _local(leave, axis, True, c, g, d, line, 3)
                share, iso = _surface_in_cell(v, isovalues, line)
                if share <= 1.0:
                    t = at + share * (leave - at)
                    return (t if t <= limit else np.inf), iso, walked
                break
        c[axis] += 1 if d[axis] > 0.0 else -1
        if c[axis] < 0 or c[axis] > n[axis] - 2 or c[axis] // MACRO != block[axis]:
            break
        at, at_axis = leave, axis
        leaves[axis] = _leaves(c[axis], n[axis], 1, g[axis], d[axis])
    return np.inf, np.nan, walked


# -- the traversal ----------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _track(  # type: ignore[no-untyped-def]
    voxels, spacing, corner, table, macro_low, macro_high, majorants, isovalues,
    origin, direction, reach, keys, row_ray, row_cells, t_out, event, value_out, samples, cells,
):  # fmt: skip
    """Fill the outcome of each row."""
    flat = voxels.reshape(-1)
    n = np.array([voxels.shape[2], voxels.shape[1], voxels.shape[0]])
    stride, plane = np.uint64(n[0]), np.uint64(n[0] * n[1])
    g, d, leaves, cell_leaves, line, v = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(6), np.empty(8)
    low, high, block, c = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for row in range(len(row_ray)):
        ray = row_ray[row]
        for a in range(3):
            g[a] = (float(origin[ray, a]) - corner[a]) / spacing[a]
            d[a] = float(direction[ray, a]) / spacing[a]
            low[a], high[a] = row_cells[row, 2 * a] // MACRO, (row_cells[row, 2 * a + 1] - 1) // MACRO + 1
        far = float(reach[ray])
        at, at_axis = _enter(n, g, d, low, high, block)
        for a in range(3):
            leaves[a] = _leaves(block[a], n[a], MACRO, g[a], d[a])
        taken, visited, k = 0, 0, 0
        while at <= far and at < np.inf:
            visited += 1
            axis = _first(leaves)
            leave = leaves[axis]
            end, found = min(leave, far), NOTHING
            majorant = majorants[block[2], block[1], block[0]]
            if majorant > 0.0 and at < end:
                number = (block[2] * majorants.shape[1] + block[1]) * majorants.shape[2] + block[0]
                key = path_key(keys[ray], number, 0, 0)
                x0, y0, z0 = block[0] * MACRO, block[1] * MACRO, block[2] * MACRO
                x1, y1, z1 = min(x0 + MACRO, n[0] - 1), min(y0 + MACRO, n[1] - 1), min(z0 + MACRO, n[2] - 1)
                # Counted from where the macro cell begins, short free paths far from the origin keep their digits.
                gx, gy, gz = g[0] + at * d[0], g[1] + at * d[1], g[2] + at * d[2]
                free, length, draw = 0.0, end - at, 0
                while True:
                    free -= math.log(1.0 - uniform(key, draw)) / majorant
                    if free >= length:
                        break
                    taken += 1
                    x = min(max(gx + free * d[0], x0), x1)
                    y = min(max(gy + free * d[1], y0), y1)
                    z = min(max(gz + free * d[2], z0), z1)
                    ix, iy, iz = min(int(x), x1 - 1), min(int(y), y1 - 1), min(int(z), z1 - 1)
                    base = np.uint64((iz * n[1] + iy) * n[0] + ix)
                    fx, fy, fz = np.float32(x - ix), np.float32(y - iy), np.float32(z - iz)
                    sampled = interpolate(flat, base, stride, plane, fx, fy, fz)
                    value = max(float(sampled), table[0, 0])
                    k = find_row(table, value, k)
                    sigma = table[k, 1] + (value - table[k, 0]) * table[k, 2]
                    if uniform(key, draw + 1) * majorant < sigma:
                        end, found = at + free, SCATTER
                        event[row], t_out[row], value_out[row] = SCATTER, end, sampled
                        break
                    draw += 2
            for candidate in isovalues:
                if macro_low[block[2], block[1], block[0]] < candidate <= macro_high[block[2], block[1], block[0]]:
                    t, iso, walked = _surface(
                        flat, n, isovalues, block, at, at_axis, end, g, d, c, cell_leaves, v, line
                    )
                    taken += walked
                    if t < np.inf:
                        found = ISOSURFACE
                        event[row], t_out[row], value_out[row] = ISOSURFACE, t, iso
                    break
            if found != NOTHING:
                break
            block[axis] += 1 if d[axis] > 0.0 else -1
            if not low[axis] <= block[axis] < high[axis]:
                break
            at, at_axis = leave, axis
            leaves[axis] = _leaves(block[axis], n[axis], MACRO, g[axis], d[axis])
        samples[row], cells[row] = taken, visited
