"""Marching rays from element to element through the parts of an unstructured volume.

This is what a rank of the deep compositor does (islands paper, section 7; Sahistan et al., "Ray-traced shell traversal
of tetrahedral meshes for direct volume visualization", 2021): a ray enters a non-convex part through a triangle of its
boundary, walks from neighbour to neighbour, samples each element at least once, and leaves through another triangle
of the boundary. Such a *segment* becomes a *fragment*: a colour with a depth. The ray may then enter the part again.

No ray is ever lost, by construction. Points are projected along the ray onto a plane, once each and in float64; whether
the ray passes left or right of an edge is the sign of a 2 x 2 determinant of these, which is computed exactly, and an
exact tie is resolved as if the ray were moved aside by an infinitesimal amount (Edelsbrunner and Muecke, "Simulation of
simplicity", 1990). So a ray meets no edge and no vertex; of the four triangles of a tetrahedron it passes either none
or exactly two, one inwards and one outwards; hence tetrahedra that share the triangles it passes are strung to chains
without branches or loops, each from an entry to an exit on the boundary. Neighbouring parts have the same points, so
together their chains are those of the whole mesh. Embree, in float32, promises this for one surface at a time but not
for an entry and its exit, so the boundary has a hierarchy of its own here, with generous boxes and exact triangles.

Numba keeps a compiled kernel until the kernel's own file changes: whoever edits the tables in ``elements.py`` or
``find_row`` in ``volume.py`` must touch this file too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.elements import SIDES, TRIANGLES, TURN, Elements, boundary
from simrender.rays.volume import find_row

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

_LEAF = 3
"""The most triangles in a leaf of the boundary's hierarchy."""

_SLACK = 1e-9
"""How much its boxes are grown, relative to the coordinates: far above rounding in float64, far below a triangle."""


@dataclass(frozen=True, eq=False)
class Fragments:
    """What came of (ray, part) rows.

    Attributes
    ----------
    row : int64 array (f,)
        The row of each fragment, ascending; the fragments of a row are front to back.
    entry, exit : float32 array (f,)
        Where the ray enters and leaves the part, within 0 and its reach; ``entry`` is the fragment's depth.
    rgba : float32 array (f, 4)
        Colour and opacity, premultiplied; fully transparent fragments are left out.
    elements, samples, segments : int32 array (n,)
        Elements walked, samples taken and segments found in each row, those of rejected fragments included.

    """

    row: I64
    entry: F32
    exit: F32
    rgba: F32
    elements: I32
    samples: I32
    segments: I32


def march_parts(
    elements: Elements, rays: Mapping[str, Any], row_ray: I64, row_part: I32, *, step: float = math.inf
) -> Fragments:
    """Integrate colour and opacity along rays, each row a ray in one part, on all cores.

    An element gets one sample or, if its stretch of the ray is longer than ``step``, as many as keep them no further
    apart. A sample stands for an equal share of the stretch and lies in its middle. There is no early termination: a
    rank does not know what lies in front of its part (islands paper, section 7).

    Parameters
    ----------
    elements : Elements
    rays : mapping
        Columns ``origin`` and ``direction``, float32 (r, 3), directions of unit length, and ``reach``, float32 (r,).
    row_ray : int64 array (n,)
        The ray of each row.
    row_part : int32 array (n,)
        The part of each row.
    step : float
        Largest distance between samples in world units.

    Raises
    ------
    SceneError
        If the step is not a length above 0, or so small that a ray's samples could not be counted.

    """
    low, high = elements.bounds
    diagonal = float(np.linalg.norm(high - low))
    if not step > diagonal / 2**31:
        least = f"above {diagonal / 2**31:.3g}, the mesh's diagonal over 2^31"
        raise SceneError(f"the step of a ray march is a length {least}, got {step}")
    hull = _hull(elements)
    mesh = (elements.points, elements.scalars, elements.first, elements.corners, elements.shape, elements.across)
    shell = (hull.corners, hull.behind, hull.first, hull.boxes, hull.root)
    # One layout and one type each, for the kernel is compiled for every combination it meets.
    columns = tuple(np.ascontiguousarray(rays[name], np.float32) for name in ("origin", "direction", "reach"))
    row_ray, row_part = np.ascontiguousarray(row_ray, np.int64), np.ascontiguousarray(row_part, np.int32)

    def work(rows: slice) -> tuple[Any, ...]:
        made, *counts = _march(
            mesh, shell, elements.transfer.table, float(step), columns, row_ray[rows], row_part[rows]
        )
        made[:, 0] += rows.start
        return made.copy(), *counts  # a copy lets go of the room that was not needed

    # The empty slice loads the kernel, or compiles it the first time.
    pieces = [work(slice(0, 0)), *embree.in_chunks(work, len(row_ray))]
    made, walked, samples, segments = (np.concatenate([piece[i] for piece in pieces]) for i in range(4))
    single = made[:, 1:].astype(np.float32)
    return Fragments(
        made[:, 0].astype(np.int64), single[:, 0].copy(), single[:, 1].copy(), single[:, 2:].copy(),
        walked, samples, segments,
    )  # fmt: skip


# -- the boundary's hierarchy -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Hull:
    """The boundary of every part under a binary tree, complete and parted at medians.

    Attributes
    ----------
    corners : float32 array (3 n, 3)
        Positions of the triangles' corners, by part and in the order of the leaves.
    behind : int32 array (n,)
        ``16 * element + triangle`` of each.
    first : int64 array (parts + 1,)
        First triangle of each part.
    boxes : float32 array (nodes, 6)
        x, y and z of the lowest, then of the highest corner. The children of a part's node i are its nodes 2 i and
        2 i + 1, its root is node 1, and the second half of its nodes are leaves with equal shares of the triangles.
    root : int64 array (parts + 1,)
        First node of each part.

    """

    corners: F32
    behind: I32
    first: I64
    boxes: F32
    root: I64


_HULLS: WeakKeyDictionary[Elements, _Hull] = WeakKeyDictionary()


def _hull(elements: Elements) -> _Hull:
    """Return the hierarchies of all parts, built when first asked for."""
    if elements not in _HULLS:
        shell = boundary(elements)
        counts = np.bincount(shell.part, minlength=elements.parts)
        leaves = 1 << np.ceil(np.log2(np.maximum(counts / _LEAF, 1.0))).astype(np.int64)
        first, root = np.concatenate([[0], np.cumsum(counts)]), np.concatenate([[0], np.cumsum(2 * leaves)])
        order, boxes = np.argsort(shell.part, kind="stable"), np.empty((root[-1], 6), np.float32)
        corners = elements.points[shell.faces]
        _build(corners.min(axis=1), corners.max(axis=1), first, root, order, boxes)
        behind = (16 * shell.element + shell.side)[order]
        _HULLS[elements] = _Hull(corners[order].reshape(-1, 3), behind, first, boxes, root)
    return _HULLS[elements]


@njit(cache=True, nogil=True, error_model="numpy")
def _build(low, high, first, root, order, boxes):  # type: ignore[no-untyped-def]
    """Order the triangles of every part for its tree, whose nodes part them at the median, and fill the nodes' boxes.

    Parameters
    ----------
    low, high : float32 arrays (n, 3)
        Boxes of the triangles.
    first, root : int64 arrays (parts + 1,)
        As in `_Hull`.
    order : int64 array (n,)
        The triangles, part by part; reordered.
    boxes : float32 array (nodes, 6)
        To be filled.

    """
    for part in range(len(root) - 1):
        leaves, count = (root[part + 1] - root[part]) // 2, first[part + 1] - first[part]
        width = leaves
        while width > 0:
            for i in range(leaves // width):
                begin = first[part] + i * width * count // leaves
                end = first[part] + (i + 1) * width * count // leaves
                axis, extent = 0, np.float32(-1.0)
                node = root[part] + leaves // width + i
                for x in range(3):
                    least, most = np.float32(np.inf), np.float32(-np.inf)
                    for j in range(begin, end):
                        least, most = min(least, low[order[j], x]), max(most, high[order[j], x])
                    boxes[node, x], boxes[node, 3 + x] = least, most
                    if most - least > extent:
                        axis, extent = x, most - least
                if width == 1:
                    continue
                # Quickselect along the widest axis: afterwards what comes before the split lies before it.
                split = first[part] + (2 * i + 1) * (width // 2) * count // leaves
                a, b = begin, end - 1
                while a < b:
                    pivot = low[order[(a + b) // 2], axis] + high[order[(a + b) // 2], axis]
                    left, right = a, b
                    while left <= right:
                        while low[order[left], axis] + high[order[left], axis] < pivot:
                            left += 1
                        while low[order[right], axis] + high[order[right], axis] > pivot:
                            right -= 1
                        if left <= right:
                            order[left], order[right] = order[right], order[left]
                            left, right = left + 1, right - 1
                    if split <= right:
                        b = right
                    elif split >= left:
                        a = left
                    else:
                        break
            width //= 2


# -- exact decisions --------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _rounding(a, b, product):  # type: ignore[no-untyped-def]
    """Return a * b - product exactly (Dekker, "A floating-point technique for extending the precision", 1971)."""
    c, d = 134217729.0 * a, 134217729.0 * b
    ah, bh = c - (c - a), d - (d - b)
    al, bl = a - ah, b - bh
    return ((ah * bh - product) + ah * bl + al * bh) + al * bl


@njit(cache=True, nogil=True, error_model="numpy")
def _tie(ax, ay, bx, by, product):  # type: ignore[no-untyped-def]
    """Return the sign of ax by - ay bx when both products round to the same number."""
    left, right = _rounding(ax, by, product), _rounding(ay, bx, product)
    if left != right:
        return 1 if left > right else -1
    # The ray moved by (e, e^2), e infinitesimal, adds e (ay - by) + e^2 (bx - ax) to the determinant.
    if ay != by:
        return 1 if ay > by else -1
    if ax != bx:
        return 1 if bx > ax else -1
    return 0


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _turn(ax, ay, bx, by):  # type: ignore[no-untyped-def]
    """Return 1 if the ray, at (0, 0), has the edge from a to b turn left about it, -1 if right; 0 only for a = b.

    Exact, for rounding is monotone: products that round to different numbers differ the same way.
    """
    p, q = ax * by, ay * bx
    if p > q:
        return 1
    if p < q:
        return -1
    return _tie(ax, ay, bx, by, p)


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _meet(v, i, j, k):  # type: ignore[no-untyped-def]
    """Return distance and scalar where the ray passes triangle (i, j, k) of the projected corners v (9, 4).

    The weights have one sign, or are 0, because the ray passes the triangle: both results lie between the corners'.
    """
    wi = v[j, 0] * v[k, 1] - v[j, 1] * v[k, 0]
    wj = v[k, 0] * v[i, 1] - v[k, 1] * v[i, 0]
    wk = v[i, 0] * v[j, 1] - v[i, 1] * v[j, 0]
    total = wi + wj + wk
    if total == 0.0:
        wi, wj, wk, total = 1.0, 1.0, 1.0, 3.0
    wi, wj, wk = wi / total, wj / total, wk / total
    return wi * v[i, 2] + wj * v[j, 2] + wk * v[k, 2], wi * v[i, 3] + wj * v[j, 3] + wk * v[k, 3]


# -- the walk ---------------------------------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _frame(direction):  # type: ignore[no-untyped-def]
    """Return the axes a ray is projected along: (axis x, axis y, axis z, slope x, slope y, 1 / direction z).

    z is the axis along which the ray is fastest; x and y are such that a triangle where the ray leaves turns left.
    """
    kz = 0
    for axis in range(1, 3):
        if abs(direction[axis]) > abs(direction[kz]):
            kz = axis
    kx, ky = (kz + 1) % 3, (kz + 2) % 3
    dz = np.float64(direction[kz])
    if dz < 0.0:
        kx, ky = ky, kx
    return kx, ky, kz, direction[kx] / dz, direction[ky] / dz, 1.0 / dz


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _project(v, i, points, point, origin, kx, ky, kz, sx, sy, inverse):  # type: ignore[no-untyped-def]
    """Set x, y and distance in row i of v to where the ray at the origin sees a point.

    They depend on the point and the ray alone, so all elements and all parts decide by the same numbers. (Numba's
    ``float`` would leave a float32 as it is.)
    """
    z = np.float64(points[point, kz]) - np.float64(origin[kz])
    v[i, 0] = (np.float64(points[point, kx]) - np.float64(origin[kx])) - sx * z
    v[i, 1] = (np.float64(points[point, ky]) - np.float64(origin[ky])) - sy * z
    v[i, 2] = z * inverse


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _reciprocal(x):  # type: ignore[no-untyped-def]
    """Return 1 / x, or a number too large to matter for a box of some thickness."""
    return 1.0 / (np.float64(x) if abs(x) > 1e-30 else 1e-30)


@njit(cache=True, nogil=True, error_model="numpy")
def _doubled(rows):  # type: ignore[no-untyped-def]
    """Return an array with the same rows and room for as many more."""
    larger = np.empty((2 * len(rows), rows.shape[1]))
    for i in range(len(rows)):  # a slice would take seconds to compile
        for j in range(rows.shape[1]):
            larger[i, j] = rows[i, j]
    return larger


@njit(cache=True, nogil=True, error_model="numpy")
def _entries(v, found, shell, part, origin, direction, reach, frame):  # type: ignore[no-untyped-def]
    """Find the boundary triangles of a part through which a ray's line enters it, front to back.

    Their distances and rows go to ``found``, float64 (m, 2), which comes back with their number, larger if need be.
    Triangles behind the origin count: the ray may start inside the segment that begins there.
    """
    corners, _, first, boxes, root = shell
    kx, ky, kz, sx, sy, inverse = frame
    scale = max(abs(np.float64(origin[0])), abs(np.float64(origin[1])), abs(np.float64(origin[2])))
    for i in range(6):
        scale = max(scale, abs(np.float64(boxes[root[part] + 1, i])))
    ix, iy, iz = _reciprocal(direction[0]), _reciprocal(direction[1]), _reciprocal(direction[2])
    # The sides of boxes where the ray enters and leaves, and the origin moved away from them: that grows the boxes.
    nx, ny, nz = 0 if ix > 0.0 else 3, 1 if iy > 0.0 else 4, 2 if iz > 0.0 else 5
    fx, fy, fz = 3 - nx, 5 - ny, 7 - nz
    gx, gy, gz = math.copysign(_SLACK * scale, ix), math.copysign(_SLACK * scale, iy), math.copysign(_SLACK * scale, iz)
    nox, noy, noz = origin[0] + gx, origin[1] + gy, origin[2] + gz
    fox, foy, foz = origin[0] - gx, origin[1] - gy, origin[2] - gz
    base, leaves, triangles = root[part], (root[part + 1] - root[part]) // 2, first[part + 1] - first[part]
    count, node = 0, 1
    while node > 0:
        row = base + node
        near = max((boxes[row, nx] - nox) * ix, (boxes[row, ny] - noy) * iy, (boxes[row, nz] - noz) * iz)
        far = min((boxes[row, fx] - fox) * ix, (boxes[row, fy] - foy) * iy, (boxes[row, fz] - foz) * iz)
        if near <= far and near <= reach:
            if node < leaves:
                node *= 2
                continue
            begin = first[part] + (node - leaves) * triangles // leaves
            end = first[part] + (node - leaves + 1) * triangles // leaves
            for face in range(begin, end):
                for j in range(3):
                    _project(v, j, corners, 3 * face + j, origin, kx, ky, kz, sx, sy, inverse)
                # Seen from the ray, the triangle of an entry turns right.
                if _turn(v[0, 0], v[0, 1], v[1, 0], v[1, 1]) >= 0:
                    continue
                if _turn(v[1, 0], v[1, 1], v[2, 0], v[2, 1]) >= 0 or _turn(v[2, 0], v[2, 1], v[0, 0], v[0, 1]) >= 0:
                    continue
                t = _meet(v, 0, 1, 2)[0]
                if t >= reach:
                    continue
                if count == len(found):
                    found = _doubled(found)
                i = count
                while i > 0 and (found[i - 1, 0] > t or (found[i - 1, 0] == t and found[i - 1, 1] > face)):
                    found[i, 0], found[i, 1] = found[i - 1, 0], found[i - 1, 1]
                    i -= 1
                found[i, 0], found[i, 1] = t, face
                count += 1
        # On to the next node in preorder: up while this is a right child, then to its sibling.
        while node & 1:
            node >>= 1
        node += 1 if node > 0 else 0
    return count, found


@njit(cache=True, nogil=True, error_model="numpy")
def _cross(v, corner_count, shape, side, knots):  # type: ignore[no-untyped-def]
    """Take a ray through an element, from the triangle where it enters to the one where it leaves.

    Parameters
    ----------
    v : float64 array (9, 4)
        The projected corners; row 8 is the element's centre, their mean or a pyramid's apex.
    side : int
        The triangle of the entry.
    knots : float64 array (14, 2)
        Distance and scalar at the entry, in row 0; the further triangles that the ray passes are added.

    Returns
    -------
    side, count : int
        The triangle of the exit and the number of knots, the last of which is there.

    """
    # The triangle behind the ray, turned such that all its edges turn left: (a, b, c); and the corner in front of it.
    a, b, c = TRIANGLES[shape, side, 0], TRIANGLES[shape, side, 2], TRIANGLES[shape, side, 1]
    d = 6 - a - b - c if corner_count == 4 else 8
    ta = _turn(v[d, 0], v[d, 1], v[a, 0], v[a, 1])
    tb = _turn(v[d, 0], v[d, 1], v[b, 0], v[b, 1])
    tc = _turn(v[d, 0], v[d, 1], v[c, 0], v[c, 1])
    # The way on is (a, b, d) if d lies left of b and right of a, and so around.
    if ta > 0 and tb < 0:
        edge = 2
    elif tb > 0 and tc < 0:
        a, b, edge = b, c, 1
    else:
        a, b, edge = c, a, 0
    side = TURN[shape, side, edge]
    knots[1, 0], knots[1, 1] = _meet(v, a, b, d)
    if corner_count == 4:
        return side, 2
    count = 2
    # From here on the ray is in the tetrahedron of the centre and a triangle of the surface that has the edge (a, b).
    while count < SIDES + 1:
        edge = 0
        while TRIANGLES[shape, side, edge] == a or TRIANGLES[shape, side, edge] == b:
            edge += 1
        d = TRIANGLES[shape, side, edge]
        ta = _turn(v[d, 0], v[d, 1], v[a, 0], v[a, 1])
        tb = _turn(v[d, 0], v[d, 1], v[b, 0], v[b, 1])
        tc = _turn(v[d, 0], v[d, 1], v[8, 0], v[8, 1])
        if ta > 0 and tb < 0:
            break
        # On through (b, centre, d) or (centre, a, d), into the next triangle about the centre.
        if tb > 0 and tc < 0:
            a = d
        else:
            b = d
        # The corners of the surface's triangle follow each other as a, b, d: two of its edges are d to a and b to d.
        side = TURN[shape, side, (edge + 2) % 3 if a == d else edge]
        knots[count, 0], knots[count, 1] = _meet(v, a, b, 8)
        count += 1
    knots[count, 0], knots[count, 1] = _meet(v, a, b, d)
    return side, count + 1


@njit(cache=True, nogil=True, error_model="numpy")
def _march(mesh, shell, table, step, rays, row_ray, row_part):  # type: ignore[no-untyped-def]
    """March rows.

    Returns
    -------
    made : float64 array (f, 7)
        The fragments: row, entry, exit, red, green, blue, opacity.
    walked, samples, segments : int32 arrays (n,)

    """
    points, scalars, first, corners, shape, across = mesh
    behind = shell[1]
    origins, directions, reaches = rays
    n = len(row_ray)
    walked, samples, segments = np.zeros(n, np.int32), np.zeros(n, np.int32), np.zeros(n, np.int32)
    made, count = np.empty((max(n, 1), 7)), 0
    v, knots, found = np.empty((9, 4)), np.empty((SIDES + 2, 2)), np.empty((16, 2))
    control = 0
    for i in range(n):
        origin, direction, reach = origins[row_ray[i]], directions[row_ray[i]], np.float64(reaches[row_ray[i]])
        frame = _frame(direction)
        kx, ky, kz, sx, sy, inverse = frame
        if not math.isfinite(sx + sy + inverse + origin[0] + origin[1] + origin[2]):
            continue  # what has no direction meets nothing, and must not wander about
        entries, found = _entries(v, found, shell, row_part[i], origin, direction, reach, frame)
        for s in range(entries):
            start, face = max(found[s, 0], 0.0), int(found[s, 1])
            e, side = behind[face] >> 4, behind[face] & 15
            end, fresh = start, True
            clear, red, green, blue = 1.0, 0.0, 0.0, 0.0
            while True:  # the chain ends, as it has no loops
                k = first[e + 1] - first[e]
                for j in range(k):
                    _project(v, j, points, corners[first[e] + j], origin, kx, ky, kz, sx, sy, inverse)
                    v[j, 3] = scalars[corners[first[e] + j]]
                if fresh:
                    a, b, c = TRIANGLES[shape[e], side, 0], TRIANGLES[shape[e], side, 1], TRIANGLES[shape[e], side, 2]
                    knots[0, 0], knots[0, 1] = _meet(v, a, b, c)
                    fresh = False
                if k == 5:
                    for axis in range(4):
                        v[8, axis] = v[4, axis]
                elif k > 5:
                    for axis in range(4):
                        total = 0.0
                        for j in range(k):
                            total += v[j, axis]
                        v[8, axis] = total / k
                side, last = _cross(v, k, shape[e], side, knots)
                # Neither rounding nor a badly warped element may make a ray step back, or out of the element.
                knots[last - 1, 0] = max(knots[last - 1, 0], knots[0, 0])
                for j in range(1, last - 1):
                    knots[j, 0] = min(max(knots[j, 0], knots[j - 1, 0]), knots[last - 1, 0])
                low, high = max(knots[0, 0], 0.0), min(knots[last - 1, 0], reach)
                if knots[last - 1, 0] > 0.0 and low < reach:
                    walked[i] += 1
                    end = high
                    if high > low:
                        takes = max(1, math.ceil((high - low) / step))
                        share = (high - low) / takes
                        samples[i] += takes
                        j = 1
                        for m in range(takes):
                            t = low + (m + 0.5) * share
                            while j < last - 1 and knots[j, 0] < t:
                                j += 1
                            width = knots[j, 0] - knots[j - 1, 0]
                            f = min(max((t - knots[j - 1, 0]) / width, 0.0), 1.0) if width > 0.0 else 0.0
                            value = knots[j - 1, 1] + f * (knots[j, 1] - knots[j - 1, 1])
                            control = find_row(table, value, control)
                            x = max(value - table[control, 0], 0.0)
                            sigma = table[control, 1] + x * table[control, 2]
                            if sigma > 0.0:
                                weight = -clear * math.expm1(-sigma * share)
                                clear -= weight
                                red += weight * (table[control, 3] + x * table[control, 4])
                                green += weight * (table[control, 5] + x * table[control, 6])
                                blue += weight * (table[control, 7] + x * table[control, 8])
                beyond = across[2 * first[e] - 4 * e + side]
                if beyond < 0 or knots[last - 1, 0] >= reach:
                    break
                knots[0, 0], knots[0, 1] = knots[last - 1, 0], knots[last - 1, 1]
                e, side = beyond >> 4, beyond & 15
            if end > start:
                segments[i] += 1
            if clear < 1.0:
                if count == len(made):
                    made = _doubled(made)
                made[count, 0], made[count, 1], made[count, 2] = i, start, end
                made[count, 3], made[count, 4], made[count, 5], made[count, 6] = red, green, blue, 1.0 - clear
                count += 1
    return made[:count], walked, samples, segments
