"""Which boxes a ray enters, and where: any boxes through a hierarchy, the cells of a rectilinear grid by walking it.

Both give the same rows in the same order, to the bit, because both end in one test of one ray against one box,
`enters`. The hierarchy and the walk only choose what to test, and they choose with at least the slack of that test.

**Slack.** Embree works in float32 and so may report a hit with a triangle that the ray passes by at a distance of a few
roundings; such a hit must not be lost because the ray passes by the triangle's box as well. Robust traversal first
subtracts the ray's origin from the vertices and then tests the ray against the edges (with Pluecker coordinates), so
its error is relative to the distance from the ray's origin to the triangle, not to that from the world's origin. A box
is therefore tested grown on all sides by `SLACK` times the distance from the ray's origin to its farthest side. The
test is done in float64, whose own roundings are lost in that. Who has another way not to lose such hits, and wants the
boxes as they are, grows them by 0.

An entry is thus a lower bound of where anything inside can be hit, but for one case: of a triangle that a ray meets
edge on (a cosine below 1e-5 or so) Embree may report any distance at all, even 0. Who relies on the bound takes the
lesser of entry and hit. Two boxes that a ray follows along their common face, closer than the slack, can come in either
order.

Numba keeps a compiled kernel until the kernel's own file changes: whoever edits this file must touch the files whose
kernels call `enters`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

SLACK = 2.0**-20
"""Growth of a box, in distances to its farthest side: 16 times the unit roundoff of float32. Of ten million hits on
corners, edges and slivers, in scenes stretched by up to eight orders of magnitude, 6,199 were outside a box that was
not grown at all and none outside one grown by a single roundoff."""

MOST = np.iinfo(np.int16).max
"""The largest number of domains that the ``domain`` column can tell apart."""

_LEAF = 4
_NEVER = 1e300  # stands for 1/0: finite, so that 0 * _NEVER is 0 and a ray in a face is inside


@dataclass(frozen=True, eq=False)
class Entered:
    """The boxes that rays enter, ray after ray, front to back.

    Attributes
    ----------
    first : int64 array (n + 1,)
        Rows ``first[i]:first[i + 1]`` belong to ray i.
    domain : int16 array (rows,)
        The box; rows of equal entry come in ascending order of it.
    entry : float32 array (rows,)
        Distance at which the ray enters; 0 when it starts inside.

    """

    first: NDArray[np.int64]
    domain: NDArray[np.int16]
    entry: F32


def enter_boxes(origin: F32, direction: F32, reach: F32, low: F32, high: F32, *, growth: float = SLACK) -> Entered:
    """Find the boxes that rays enter, front to back.

    Boxes are closed and may overlap, be flat, or be empty (inside out: never entered). A ray enters a box that it
    leaves at a distance of at least 0 and reaches at a distance of at most ``reach``.

    Parameters
    ----------
    origin, direction : float32 array (n, 3)
        Directions need not be unit vectors; distances are in their lengths.
    reach : float32 array (n,)
        May be infinite.
    low, high : float32 array (d, 3)
    growth : float
        Of a box on all sides, in distances to its farthest side.

    Raises
    ------
    SceneError
        If there are more boxes than an int16 can number.

    """
    _check_count(len(low))
    hierarchy = _hierarchy(low, high)
    return _enter(origin, direction, reach, len(low), growth, _through_boxes, hierarchy)


def walk_grid(
    origin: F32, direction: F32, reach: F32, planes: tuple[F64, F64, F64], *, growth: float = SLACK
) -> Entered:
    """Find the cells of a rectilinear grid that rays enter, front to back, by walking from cell to cell.

    A three-dimensional digital differential analyser (Amanatides and Woo, "A fast voxel traversal algorithm for ray
    tracing", Eurographics 1987) that steps over *intervals* of distance, one a slab, in place of single crossings. So a
    ray in a face, an edge or a corner visits all cells that touch it, as closed boxes demand: the result is that of
    `enter_boxes` with the cells' boxes.

    Parameters
    ----------
    origin, direction, reach, growth
        As for `enter_boxes`.
    planes : three float64 arrays, ascending
        Bounds of the cells along x, y and z, used as rounded to float32. Cell (ix, iy, iz) is domain
        ix + nx * (iy + ny * iz).

    Raises
    ------
    SceneError
        If there are more cells than an int16 can number, or planes that do not ascend.

    """
    axes = tuple(np.asarray(p, np.float32).astype(np.float64) for p in planes)
    for axis, p in zip("xyz", axes, strict=True):
        if len(p) < 2 or not (np.diff(p) >= 0).all():
            raise SceneError(f"the grid's {axis} planes must be two or more in ascending order, got {p.tolist()}")
    count = int(np.prod([len(p) - 1 for p in axes]))
    _check_count(count)
    return _enter(origin, direction, reach, count, growth, _through_grid, axes)


def _check_count(count: int) -> None:
    if count > MOST:
        raise SceneError(f"{count} domains are too many: at most {MOST} can be told apart; use a coarser partition")


def _enter(
    origin: F32, direction: F32, reach: F32, count: int, growth: float, kernel: Any, of: tuple[Any, ...]
) -> Entered:
    """Run a kernel twice over all rays, on all cores: to count the rows, then to fill them in where they belong."""
    n = len(reach)
    first = np.zeros(n + 1, np.int64)
    none = np.zeros(0, np.int16), np.zeros(0, np.int32)

    def work(rays: slice, domain: NDArray[np.int16], bits: NDArray[np.int32]) -> None:
        rows = first[rays.start : rays.stop + 1]
        kernel(origin[rays], direction[rays], reach[rays], count, float(growth), *of, rows, domain, bits)

    embree.in_chunks(lambda rays: work(rays, *none), n)
    np.cumsum(first, out=first)
    domain, entry = np.empty(first[n], np.int16), np.empty(first[n], np.float32)
    embree.in_chunks(lambda rays: work(rays, domain, entry.view(np.int32)), n if len(domain) else 0)
    return Entered(first, domain, entry)


def _hierarchy(low: F32, high: F32) -> tuple[F64, F64, NDArray[np.int64], F64, F64, NDArray[np.int64]]:
    """Build a balanced binary hierarchy over boxes, split at the median of the widest spread of their centres.

    Node 1 is the root, node i has the children 2i and 2i + 1, and the last half of the nodes are leaves.

    Returns
    -------
    node_low, node_high : float64 array (2 leaves, 3)
    first : int64 array (leaves + 1,)
        Leaf i holds the boxes ``first[i]:first[i + 1]`` of those that follow.
    box_low, box_high : float64 array (d, 3)
        The boxes that are not empty, leaf after leaf.
    domain : int64 array (d,)
        Their rows in ``low`` and ``high``.

    """
    order = np.flatnonzero((low <= high).all(axis=1))
    count = len(order)
    levels = max(0, int(np.ceil(np.log2(max(count, 1) / _LEAF))))
    for level in range(levels):
        first = np.arange(2**level + 1) * count >> level
        centre = low[order].astype(np.float64) + high[order]
        spread = np.maximum.reduceat(centre, first[:-1]) - np.minimum.reduceat(centre, first[:-1])
        node = np.repeat(np.arange(2**level), np.diff(first))
        key = centre[np.arange(count), spread.argmax(axis=1)[node]]
        order = order[np.lexsort((order, key, node))]
    leaves = 2**levels
    first = np.arange(leaves + 1) * count >> levels
    box_low, box_high = low[order].astype(np.float64), high[order].astype(np.float64)
    node_low, node_high = np.full((2 * leaves, 3), np.inf), np.full((2 * leaves, 3), -np.inf)
    if count:
        node_low[leaves:] = np.minimum.reduceat(box_low, first[:-1])
        node_high[leaves:] = np.maximum.reduceat(box_high, first[:-1])
    for level in range(levels - 1, -1, -1):
        nodes = np.arange(2**level, 2 ** (level + 1))
        node_low[nodes] = np.minimum(node_low[2 * nodes], node_low[2 * nodes + 1])
        node_high[nodes] = np.maximum(node_high[2 * nodes], node_high[2 * nodes + 1])
    return node_low, node_high, first, box_low, box_high, order


@njit(cache=True, nogil=True, error_model="numpy")
def inverse(d):  # type: ignore[no-untyped-def]
    """Return 1/d as `enters` wants it, for a component of a ray's direction that may be zero."""
    return 1.0 / d if d != 0.0 else _NEVER


@njit(cache=True, nogil=True, error_model="numpy")
def enters(ox, oy, oz, ix, iy, iz, growth, reach, lx, ly, lz, hx, hy, hz):  # type: ignore[no-untyped-def]
    """Return the distance (float64) at which a ray enters a closed box, 0 if it starts inside, -1 if it does not.

    It must not be inside out. Of boxes of which one holds the
    other, the outer is entered by every ray that enters the inner, and no later.

    Parameters
    ----------
    ox, oy, oz : float64
        Origin.
    ix, iy, iz : float64
        `inverse` of each component of the direction.
    growth : float64
        Of the box on all sides, in distances to its farthest side; `SLACK` if nothing that Embree hits may be missed.
    reach : float64
    lx, ly, lz, hx, hy, hz : float64
        Lowest and highest corner.

    """
    slack = growth * max(abs(lx - ox), abs(hx - ox), abs(ly - oy), abs(hy - oy), abs(lz - oz), abs(hz - oz))
    x0, x1 = (lx - (ox + slack)) * ix, (hx - (ox - slack)) * ix
    y0, y1 = (ly - (oy + slack)) * iy, (hy - (oy - slack)) * iy
    z0, z1 = (lz - (oz + slack)) * iz, (hz - (oz - slack)) * iz
    near = max(min(x0, x1), min(y0, y1), min(z0, z1), 0.0)
    far = min(max(x0, x1), max(y0, y1), max(z0, z1), reach)
    return near if near <= far else -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _sort(keys, n):  # type: ignore[no-untyped-def]
    """Sort the first n of int64 keys in place: Shell's sort, which is fast where little is out of order."""
    gap = 1
    while 3 * gap + 1 < n:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, n):
            key, j = keys[i], i
            while j >= gap and keys[j - gap] > key:
                keys[j] = keys[j - gap]
                j -= gap
            keys[j] = key
        gap //= 3


@njit(cache=True, nogil=True, error_model="numpy")
def _store(keys, n, row, domain, bits):  # type: ignore[no-untyped-def]
    """Sort a ray's keys and write them to its rows: an entry's bits above, the domain's number below."""
    _sort(keys, n)
    for j in range(n):
        domain[row + j] = keys[j] & 0xFFFF
        bits[row + j] = keys[j] >> 16


@njit(cache=True, nogil=True, error_model="numpy")
def _through_boxes(  # type: ignore[no-untyped-def]
    origin, direction, reach, count, growth, node_low, node_high, leaf, low, high, number, first, domain, bits
):
    """Count each ray's rows into ``first[1:]``, or, if there is room for rows, fill them in."""
    fill = len(domain) > 0
    keys = np.empty(count, np.int64)
    one = np.empty(1, np.float32)
    one_bits = one.view(np.int32)
    leaves = len(leaf) - 1
    for i in range(len(reach)):
        ox, oy, oz = np.float64(origin[i, 0]), np.float64(origin[i, 1]), np.float64(origin[i, 2])
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
        far = np.float64(reach[i])
        found = 0
        node = 1
        while True:
            lx, ly, lz = node_low[node, 0], node_low[node, 1], node_low[node, 2]
            hx, hy, hz = node_high[node, 0], node_high[node, 1], node_high[node, 2]
            if lx <= hx and enters(ox, oy, oz, ix, iy, iz, growth, far, lx, ly, lz, hx, hy, hz) >= 0.0:
                if node < leaves:
                    node *= 2
                    continue
                for k in range(leaf[node - leaves], leaf[node - leaves + 1]):
                    lx, ly, lz, hx, hy, hz = low[k, 0], low[k, 1], low[k, 2], high[k, 0], high[k, 1], high[k, 2]
                    near = enters(ox, oy, oz, ix, iy, iz, growth, far, lx, ly, lz, hx, hy, hz)
                    if near >= 0.0:
                        if fill:
                            one[0] = near
                            keys[found] = (np.int64(one_bits[0]) << 16) | number[k]
                        found += 1
            # On to the next subtree in order: up while this node is a right child, then to the sibling.
            node += 1
            while node & 1 == 0:
                node >>= 1
            if node == 1:
                break
        if fill:
            _store(keys, found, first[i], domain, bits)
        else:
            first[i + 1] = found


@njit(cache=True, nogil=True, error_model="numpy")
def _span(planes, step, o, inv, slack):  # type: ignore[no-untyped-def]
    """Return where a ray enters and leaves the slab that it meets after ``step`` others: both ascend with the step."""
    at = step if inv > 0.0 else len(planes) - 2 - step
    a, b = (planes[at] - (o + slack)) * inv, (planes[at + 1] - (o - slack)) * inv
    return min(a, b), max(a, b)


@njit(cache=True, nogil=True, error_model="numpy")
def _through_grid(origin, direction, reach, count, growth, xs, ys, zs, first, domain, bits):  # type: ignore[no-untyped-def]
    """Count each ray's rows into ``first[1:]``, or, if there is room for rows, fill them in."""
    fill = len(domain) > 0
    keys = np.empty(count, np.int64)
    one = np.empty(1, np.float32)
    one_bits = one.view(np.int32)
    nx, ny, nz = len(xs) - 1, len(ys) - 1, len(zs) - 1
    for i in range(len(reach)):
        ox, oy, oz = np.float64(origin[i, 0]), np.float64(origin[i, 1]), np.float64(origin[i, 2])
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
        end = np.float64(reach[i])
        # The slack of the whole grid's box is at least that of each cell's, and no less than what keeps the walk's own
        # roundings from missing a cell.
        slack = max(growth, SLACK) * max(
            abs(xs[0] - ox), abs(xs[nx] - ox), abs(ys[0] - oy), abs(ys[ny] - oy), abs(zs[0] - oz), abs(zs[nz] - oz)
        )
        found = 0
        y_start, z_start = 0, 0
        for x in range(nx):
            near_x, far_x = _span(xs, x, ox, ix, slack)
            near_x, far_x = max(near_x, 0.0), min(far_x, end)
            if near_x > far_x:
                continue
            while y_start < ny and _span(ys, y_start, oy, iy, slack)[1] < near_x:
                y_start += 1
            while z_start < nz and _span(zs, z_start, oz, iz, slack)[1] < near_x:
                z_start += 1
            z_first = z_start
            for y in range(y_start, ny):
                near_y, far_y = _span(ys, y, oy, iy, slack)
                if near_y > far_x:
                    break
                near_y, far_y = max(near_x, near_y), min(far_x, far_y)
                while z_first < nz and _span(zs, z_first, oz, iz, slack)[1] < near_y:
                    z_first += 1
                for z in range(z_first, nz):
                    if _span(zs, z, oz, iz, slack)[0] > far_y:
                        break
                    cx, cy, cz = (
                        x if ix > 0.0 else nx - 1 - x,
                        y if iy > 0.0 else ny - 1 - y,
                        z if iz > 0.0 else nz - 1 - z,
                    )
                    near = enters(
                        ox, oy, oz, ix, iy, iz, growth, end,
                        xs[cx], ys[cy], zs[cz], xs[cx + 1], ys[cy + 1], zs[cz + 1],
                    )  # fmt: skip
                    if near >= 0.0:
                        if fill:
                            one[0] = near
                            keys[found] = (np.int64(one_bits[0]) << 16) | (cx + nx * (cy + ny * cz))
                        found += 1
        if fill:
            _store(keys, found, first[i], domain, bits)
        else:
            first[i + 1] = found
