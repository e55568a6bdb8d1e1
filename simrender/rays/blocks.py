"""A bounding volume hierarchy in blocks of memory, and the blocks that rays refer to on their way through it.

What distributed cache ray tracing moves between nodes (Ize et al., Real-time ray tracer for visualization on a cluster,
section 5.3): nodes of 32 B (a box, the place of two children that lie side by side or of a leaf's triangles, and how
many these are) in blocks of 254, and triangles of 36 B, which share no vertices, in blocks of 226. Embree does not say
which nodes it visits, so this hierarchy is our own, and each packet of rays really goes through it.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.kinds import CAMERA, SHADOW
from simrender.rays.scene import F32, I32

if TYPE_CHECKING:
    from simrender.rays.trace import Trace

I64 = NDArray[np.int64]

NODE_BLOCK: Final = 254
TRIANGLE_BLOCK: Final = 226
"""Nodes and triangles of a block (section 5.3)."""

PACKET_SIDE: Final = 8
PACKET_RAYS: Final = PACKET_SIDE**2
"""A packet has 64 rays (section 5.2): those of a square of pixels."""

_BINS, _MAX_LEAF, _DEEP = 16, 8, 64
_FULL_LEVELS = 2
_STACK = 2 * _DEEP
_CHUNK = 256
"""Packets that a thread takes at once."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """A binary hierarchy whose nodes and triangles lie in memory as section 5.3.1 and 5.3.2 order them.

    The first block begins with the root, alone in the place of a pair. A block is filled breadth first, by pairs of
    children, from the root of a subtree; each pair that it has no room for then begins a subtree of its own, depth
    first. A subtree that ends before its block is full is followed by the next one without a gap (but where larger
    blocks begin), so that a block may hold several, and a pair never lies in two blocks. Triangles lie in the order in
    which a traversal of all leaves meets them.

    Attributes
    ----------
    bounds : float32 array (nodes, 6)
        Lowest and highest corner of each node, a unit in the last place outside its triangles.
    link : int32 array (nodes,)
        The first of two children, or the first triangle of a leaf.
    count : int32 array (nodes,)
        Triangles of a leaf; of an inner node -1, -2 or -3 for children apart along x, y or z.
    block : int32 array (nodes,)
        The block of each node, ascending from 0.
    triangles : float32 array (triangles, 9)
        Three corners each.
    ids : int32 array (triangles,)
        The row of each in the faces they were built from.
    upper : bool array (node blocks,)
        Whether a block belongs to the top of the hierarchy, where blocks are never smaller than `NODE_BLOCK`.
    triangle_block : int
        Triangles of a block.

    """

    bounds: F32
    link: I32
    count: I32
    block: I32
    triangles: F32
    ids: I32
    upper: NDArray[np.bool_]
    triangle_block: int = TRIANGLE_BLOCK

    @property
    def node_blocks(self) -> int:
        """Blocks of nodes; the last one need not be full."""
        return int(self.block[-1]) + 1

    @property
    def triangle_blocks(self) -> int:
        """Blocks of triangles, which are numbered after those of nodes."""
        return -(-len(self.triangles) // self.triangle_block)


@dataclass(frozen=True, eq=False)
class Walk:
    """What packets of rays met.

    Attributes
    ----------
    first : int64 array (packets + 1,)
        Where each packet's references begin.
    block : int32 array (references,)
        Blocks of nodes, and from `Blocks.node_blocks` on blocks of triangles, in the order in which they were needed.
        A packet keeps its current block of each sort, and refers to it again only after another one.
    t : float32 array (rays,)
        Nearest hit of each ray, for a shadow ray any; infinite for none.
    primitive : int32 array (rays,)
        Row of the face that was hit; -1 for none.

    """

    first: I64
    block: I32
    t: F32
    primitive: I32


@dataclass(frozen=True, eq=False)
class References:
    """The blocks that a frame's rays refer to, by packet of pixels.

    A packet is a square of 8 x 8 pixels, smaller at the right and lower edges, row-major from the top left, with all
    rays that descend from its camera rays. These go in ray packets of at most 64: camera rays of one sample, and at
    each later generation the rays of one kind that are their parents' k-th children.

    Attributes
    ----------
    packets : (columns, rows)
    node_blocks, triangle_blocks : int
        How many there are of each.
    node_first, triangle_first : int64 array (packets + 1,)
        Where each packet's references begin.
    node, triangle : int32 array (references,)
        Blocks, numbered from 0 on for either sort.
    upper : bool array (node_blocks,)
        Blocks of the top of the hierarchy; see `Blocks`.
    nodes, triangles : int
        How many the hierarchy has.

    """

    packets: tuple[int, int]
    node_blocks: int
    triangle_blocks: int
    node_first: I64
    node: I32
    triangle_first: I64
    triangle: I32
    upper: NDArray[np.bool_]
    nodes: int
    triangles: int


def block_hierarchy(
    vertices: F32, faces: I32, node_block: int = NODE_BLOCK, triangle_block: int = TRIANGLE_BLOCK
) -> Blocks:
    """Build a hierarchy over triangles and lay it out in blocks.

    Splits minimise the surface area heuristic over 16 bins an axis (Wald, "On fast construction of SAH-based bounding
    volume hierarchies", 2007), where a box and a triangle cost the same to test.

    Parameters
    ----------
    vertices : float32 array (v, 3)
    faces : int32 array (t, 3), t > 0
    node_block : int
        Nodes of a block: even, at least 2. Smaller blocks than `NODE_BLOCK` begin with the third block on the way from
        the root: those above are few in a mesh of any size, and every ray needs some of them.
    triangle_block : int
        Triangles of a block, at least 1.

    Raises
    ------
    SceneError
        If there is no triangle, or blocks have no such size.

    """
    if node_block < 2 or node_block % 2 or triangle_block < 1:
        raise SceneError(
            f"a block has an even number of nodes from 2 on and at least 1 triangle, got {node_block} and "
            f"{triangle_block}"
        )
    if len(faces) == 0:
        raise SceneError("there is nothing to build a hierarchy over: the scene has no triangles")
    corners = vertices[faces]
    order = np.arange(len(faces), dtype=np.int32)
    bounds, link, count = _build(corners.min(axis=1), corners.max(axis=1), order)
    place, block, upper = _lay_out(link, count, node_block, max(node_block, NODE_BLOCK), _FULL_LEVELS)
    bounds = np.stack([np.nextafter(bounds[:, :3], -np.inf), np.nextafter(bounds[:, 3:], np.inf)], 1).reshape(-1, 6)
    size = len(block)
    laid = np.zeros((size, 6), np.float32), np.zeros(size, np.int32), np.zeros(size, np.int32)
    laid[0][place] = bounds
    laid[1][place] = np.where(count < 0, place[np.where(count < 0, link, 0)], link)
    laid[2][place] = count
    return Blocks(*laid, block, np.ascontiguousarray(corners[order].reshape(-1, 9)), order, upper, triangle_block)


def walk(blocks: Blocks, first: I64, origin: F32, direction: F32, reach: F32, shadow: NDArray[np.bool_]) -> Walk:
    """Take packets of rays through a hierarchy, on all cores.

    A packet goes on as long as one of its rays meets a node's box nearer than that ray's nearest hit, the child first
    that is nearer to the first such ray (Wald, Boulos and Shirley, "Ray tracing deformable scenes using dynamic
    bounding volume hierarchies", 2007). Shadow rays stop at any hit.

    Parameters
    ----------
    blocks : Blocks
    first : int64 array (packets + 1,)
        The first ray of each packet; it has at most 64, either all or none of them shadow rays.
    origin, direction : float32 array (rays, 3)
    reach : float32 array (rays,)
    shadow : bool array (rays,)

    """
    t, primitive = np.empty(len(reach), np.float32), np.empty(len(reach), np.int32)

    def go(begin: int) -> tuple[I64, I32]:
        found: tuple[I64, I32] = _walk(
            first[begin : begin + _CHUNK + 1], origin, direction, reach, shadow, blocks.bounds, blocks.link,
            blocks.count, blocks.block, blocks.triangles, blocks.ids, blocks.triangle_block, t, primitive,
        )  # fmt: skip
        return found

    parts = embree.on_all_cores(go, range(0, len(first) - 1, _CHUNK))
    lengths = np.concatenate([np.zeros(1, np.int64), *(part[0] for part in parts)])
    block = np.concatenate([np.zeros(0, np.int32), *(part[1] for part in parts)])
    return Walk(np.cumsum(lengths), block, t, primitive)


def packet_of_pixel(size: tuple[int, int]) -> tuple[tuple[int, int], I64]:
    """Return how many columns and rows of packets an image has, and the packet of each pixel, int64 (pixels,)."""
    columns, rows = (-(-side // PACKET_SIDE) for side in size)
    x, y = np.arange(size[0]) // PACKET_SIDE, np.arange(size[1]) // PACKET_SIDE
    return (columns, rows), (y[:, None] * columns + x).ravel()


def references(
    trace: Trace, hierarchy: Any, node_block: int = NODE_BLOCK, triangle_block: int = TRIANGLE_BLOCK
) -> References:
    """Return the blocks that the rays of a trace refer to; they are kept in the trace's store.

    Parameters
    ----------
    trace : Trace
        All its generations will be known afterwards.
    hierarchy : callable
        Returns the `Blocks` of the trace's scene, with blocks of this size; asked only if the store has no answer.
    node_block, triangle_block : int

    Raises
    ------
    SceneError
        If the trace's scene has a volume: its rays go through no hierarchy.

    """
    if trace.scene.volume is not None or trace.scene.elements is not None:
        raise SceneError("blocks of a hierarchy are for surfaces, and the scene has a volume")
    trace.complete()
    packets, packet = packet_of_pixel(trace.size)
    name = f"blocks-{node_block}-{triangle_block}-{_version()}"
    columns = ("sizes", "node_first", "node", "triangle_first", "triangle", "upper")
    found = trace.store.load(name, columns)
    if found is None or not _consistent(found, packets[0] * packets[1]):
        found = _refer(trace, hierarchy(), packet)
        trace.store.save(name, found)
    node_blocks, triangle_blocks, nodes, triangles = found["sizes"].tolist()
    return References(
        packets, node_blocks, triangle_blocks, found["node_first"], found["node"], found["triangle_first"],
        found["triangle"], found["upper"], nodes, triangles,
    )  # fmt: skip


def packet_rays(trace: Trace) -> tuple[I64, I64, I64]:
    """Return the rays of each packet of pixels, and how many of them are camera rays.

    Returns
    -------
    first : int64 array (packets + 1,)
    rays : int64 array (rays,)
        Ids, grouped by packet, ascending in each.
    camera : int64 array (packets,)

    """
    (columns, rows), packet = packet_of_pixel(trace.size)
    of_ray = packet[trace.column("pixel")]
    count = np.bincount(of_ray, minlength=columns * rows)
    camera = np.bincount(of_ray[trace.column("kind") == CAMERA], minlength=columns * rows)
    return np.concatenate([[0], np.cumsum(count)]), np.argsort(of_ray, kind="stable"), camera


@cache
def _version() -> str:
    return hashlib.blake2b(Path(__file__).read_bytes(), digest_size=8).hexdigest()


def _consistent(found: dict[str, Any], packets: int) -> bool:
    return (
        len(found["sizes"]) == 4
        and len(found["upper"]) == found["sizes"][0]
        and all(
            len(found[f"{sort}_first"]) == packets + 1 and found[f"{sort}_first"][-1] == len(found[sort])
            for sort in ("node", "triangle")
        )
    )


def _refer(trace: Trace, blocks: Blocks, packet: I64) -> dict[str, Any]:
    """Take a trace's rays through a hierarchy in packets; see `References`."""
    parts = [trace.geometry(generation) for generation in range(trace.generations)]
    rays = {name: np.concatenate([part[name] for part in parts]) for name in ("origin", "direction", "reach", "sample")}
    kind, pixel = trace.column("kind"), trace.column("pixel")
    place = packet[pixel]
    generation = np.repeat(np.arange(trace.generations), np.diff(trace.first))
    child = np.zeros(trace.rays, np.int64)
    for g in range(1, trace.generations):
        mine = slice(trace.first[g], trace.first[g + 1])
        parent = parts[g]["parent"] + np.int64(trace.first[g - 1])
        child[mine] = np.arange(mine.start, mine.stop) - trace.column("first_child")[parent]
    key = place
    for digit in (rays["sample"].astype(np.int64), generation, kind.astype(np.int64), child):
        key = key * (int(digit.max()) + 1) + digit
    order = np.argsort(key, kind="stable")
    first = _cut(key[order])
    found = walk(
        blocks, first, rays["origin"][order], rays["direction"][order], rays["reach"][order], kind[order] == SHADOW
    )
    owner = np.repeat(place[order][first[:-1]], np.diff(found.first))
    is_node = found.block < blocks.node_blocks
    packets = int(packet[-1]) + 1
    made: dict[str, Any] = {
        "sizes": np.array([blocks.node_blocks, blocks.triangle_blocks, len(blocks.link), len(blocks.triangles)]),
        "upper": blocks.upper,
    }
    for sort, of_sort, base in (("node", is_node, 0), ("triangle", ~is_node, blocks.node_blocks)):
        made[sort] = found.block[of_sort] - np.int32(base)
        count = np.bincount(owner[of_sort], minlength=packets)
        made[f"{sort}_first"] = np.concatenate([[0], np.cumsum(count)])
    return made


def _cut(key: I64) -> I64:
    """Return where runs of one key begin, and the end; longer runs than a packet are cut."""
    starts = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
    lengths = np.diff(starts, append=len(key))
    pieces = -(-lengths // PACKET_RAYS)
    begin = np.repeat(starts, pieces)
    number = np.arange(len(begin)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    return np.append(begin + number * PACKET_RAYS, len(key))


@njit(cache=True, nogil=True, error_model="numpy")
def _build(low, high, order):  # type: ignore[no-untyped-def]
    """Build a hierarchy top down; ``order`` is put into the order of the leaves."""
    n = len(order)
    bounds = np.empty((2 * n, 6), np.float32)
    link, count = np.empty(2 * n, np.int32), np.empty(2 * n, np.int32)
    stack = np.empty((4 * _DEEP + 64, 4), np.int64)
    stack[0] = (0, 0, n, 0)
    top, used = 1, 1
    size = np.empty(_BINS, np.int64)
    box = np.empty((_BINS, 6), np.float64)
    right = np.empty(_BINS, np.float64)
    middle = np.empty((2, 3), np.float64)
    run = np.empty(6, np.float64)
    while top:
        top -= 1
        node, begin, end, depth = stack[top]
        bounds[node, :3] = np.inf
        bounds[node, 3:] = -np.inf
        middle[0] = np.inf
        middle[1] = -np.inf
        for i in range(begin, end):
            k = order[i]
            for axis in range(3):
                lo, hi = low[k, axis], high[k, axis]
                bounds[node, axis] = min(bounds[node, axis], lo)
                bounds[node, 3 + axis] = max(bounds[node, 3 + axis], hi)
                centre = np.float64(lo) + np.float64(hi)
                middle[0, axis] = min(middle[0, axis], centre)
                middle[1, axis] = max(middle[1, axis], centre)
        total = end - begin
        best, best_axis, best_bin = np.inf, 0, -1
        if total > 1 and depth < _DEEP:
            for axis in range(3):
                width = middle[1, axis] - middle[0, axis]
                scale = _BINS / width if width > 0.0 else np.inf
                if scale == np.inf:
                    continue
                size[:] = 0
                box[:, :3] = np.inf
                box[:, 3:] = -np.inf
                for i in range(begin, end):
                    k = order[i]
                    b = min(int((np.float64(low[k, axis]) + high[k, axis] - middle[0, axis]) * scale), _BINS - 1)
                    size[b] += 1
                    for a in range(3):
                        box[b, a] = min(box[b, a], low[k, a])
                        box[b, 3 + a] = max(box[b, 3 + a], high[k, a])
                run[:3] = np.inf
                run[3:] = -np.inf
                behind = 0
                for b in range(_BINS - 1, 0, -1):
                    behind += size[b]
                    _grow(run, box[b])
                    right[b] = behind * _area(run) if behind else 0.0
                run[:3] = np.inf
                run[3:] = -np.inf
                before = 0
                for b in range(1, _BINS):
                    before += size[b - 1]
                    _grow(run, box[b - 1])
                    if before in {0, total}:
                        continue
                    cost = before * _area(run) + right[b]
                    if cost < best:
                        best, best_axis, best_bin = cost, axis, b
        whole = _area(bounds[node])
        if total == 1 or (total <= _MAX_LEAF and (best_bin < 0 or whole + best >= total * whole)):
            link[node], count[node] = begin, total
            continue
        if best_bin < 0:  # all in one place, or too deep: halves
            split = begin + total // 2
        else:
            scale = _BINS / (middle[1, best_axis] - middle[0, best_axis])
            split, last = begin, end - 1
            while split <= last:
                k = order[split]
                centre = np.float64(low[k, best_axis]) + high[k, best_axis]
                if min(int((centre - middle[0, best_axis]) * scale), _BINS - 1) < best_bin:
                    split += 1
                else:
                    order[split], order[last] = order[last], k
                    last -= 1
        link[node], count[node] = used, -1 - best_axis
        stack[top] = (used + 1, split, end, depth + 1)
        stack[top + 1] = (used, begin, split, depth + 1)
        top += 2
        used += 2
    return bounds[:used].copy(), link[:used].copy(), count[:used].copy()


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _grow(run, box):  # type: ignore[no-untyped-def]
    for a in range(3):
        run[a] = min(run[a], box[a])
        run[3 + a] = max(run[3 + a], box[3 + a])


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _area(box):  # type: ignore[no-untyped-def]
    x, y, z = np.float64(box[3]) - box[0], np.float64(box[4]) - box[1], np.float64(box[5]) - box[2]
    return x * y + y * z + z * x


@njit(cache=True, nogil=True, error_model="numpy")
def _lay_out(link, count, small, full, full_levels):  # type: ignore[no-untyped-def]
    """Return the place of each node in memory, the block of each place, and which blocks are of the top.

    The place after the root stays empty.
    """
    n = len(link)
    place, block, upper = np.empty(n, np.int64), np.empty(n + 1, np.int32), np.zeros(n + 1, np.bool_)
    waiting = np.empty((n // 2 + 2, 2), np.int64)
    queue = np.empty(full + 4, np.int64)
    place[0] = 0
    block[:2] = 0
    upper[0] = True
    used, size, room, here, top = 2, full, full - 2, 0, 0
    if count[0] < 0:
        waiting[0, 0], waiting[0, 1] = link[0], 0
        top = 1
    while top:
        top -= 1
        queue[0], level = waiting[top]
        head, tail = 0, 1
        wanted = full if level < full_levels else small
        if room == 0 or wanted > size:
            here += 1
            size = room = wanted
            upper[here] = level < full_levels
        while head < tail and room:
            pair = queue[head]
            head += 1
            for node in (pair, pair + 1):
                place[node] = used
                block[used] = here
                used += 1
                if count[node] < 0:
                    queue[tail] = link[node]
                    tail += 1
            room -= 2
        for i in range(tail - 1, head - 1, -1):
            waiting[top, 0], waiting[top, 1] = queue[i], level + 1
            top += 1
    return place, block[:used].copy(), upper[: here + 1].copy()


@njit(cache=True, nogil=True, error_model="numpy")
def _walk(first, origin, direction, reach, shadow, bounds, link, count, home, triangles, ids, tris, t, primitive):  # type: ignore[no-untyped-def]
    """Take some packets through a hierarchy; return how many references each makes, and these."""
    packets = len(first) - 1
    length = np.zeros(packets, np.int64)
    out = np.empty(4096, np.int32)
    used = 0
    base = home[-1] + 1
    stack = np.empty((_STACK + 128, 2), np.int64)
    inverse = np.empty((64, 3), np.float64)
    far = np.empty(64, np.float64)
    for p in range(packets):
        begin, n = first[p], first[p + 1] - first[p]
        began = used
        for i in range(n):
            far[i] = reach[begin + i]
            t[begin + i] = np.inf
            primitive[begin + i] = -1
            for axis in range(3):
                d = np.float64(direction[begin + i, axis])
                inverse[i, axis] = 1.0 / d if d != 0.0 else 1e300
        any_hit = shadow[begin]
        alive, node_here, tri_here = n, -1, -1
        stack[0] = (0, 0)
        top = 1
        while top and alive:
            top -= 1
            node, active = stack[top]
            if used + 8 > len(out):
                bigger = np.empty(2 * len(out), np.int32)
                bigger[:used] = out[:used]
                out = bigger
            if home[node] != node_here:
                node_here = home[node]
                out[used] = node_here
                used += 1
            while active < n and not _meets(bounds, node, origin, begin + active, inverse, far, active):
                active += 1
            if active == n:
                continue
            if count[node] < 0:
                child = link[node]
                nearer = 1 if direction[begin + active, -1 - count[node]] < 0.0 else 0
                stack[top] = (child + 1 - nearer, active)
                stack[top + 1] = (child + nearer, active)
                top += 2
                continue
            last = link[node] + count[node]
            for block in range(link[node] // tris, (last - 1) // tris + 1):
                if block != tri_here:
                    tri_here = block
                    if used == len(out):
                        bigger = np.empty(2 * len(out), np.int32)
                        bigger[:used] = out[:used]
                        out = bigger
                    out[used] = base + block
                    used += 1
            for i in range(active, n):
                ray = begin + i
                if i > active and not _meets(bounds, node, origin, ray, inverse, far, i):
                    continue
                for k in range(link[node], last):
                    hit = _hit(triangles, k, origin, direction, ray)
                    if hit > far[i] or (hit == far[i] and (primitive[ray] < 0 or ids[k] > primitive[ray])):
                        continue
                    far[i], t[ray], primitive[ray] = hit, hit, ids[k]
                    if any_hit:
                        far[i] = -1.0
                        alive -= 1
                        break
        length[p] = used - began
    return length, out[:used].copy()


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _meets(bounds, node, origin, ray, inverse, far, i):  # type: ignore[no-untyped-def]
    """Tell whether a ray meets a box before its nearest hit. Boxes are padded, so 0 times infinity cannot come up."""
    enter, leave = 0.0, far[i]
    for axis in range(3):
        o = np.float64(origin[ray, axis])
        a = (bounds[node, axis] - o) * inverse[i, axis]
        b = (bounds[node, 3 + axis] - o) * inverse[i, axis]
        enter = max(enter, min(a, b))
        leave = min(leave, max(a, b))
    return enter <= leave


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _hit(triangles, k, origin, direction, ray):  # type: ignore[no-untyped-def]
    """Return where a ray hits a triangle, infinite if it does not (Moeller and Trumbore, 1997, in double precision)."""
    ax, ay, az = np.float64(triangles[k, 0]), np.float64(triangles[k, 1]), np.float64(triangles[k, 2])
    ux, uy, uz = triangles[k, 3] - ax, triangles[k, 4] - ay, triangles[k, 5] - az
    vx, vy, vz = triangles[k, 6] - ax, triangles[k, 7] - ay, triangles[k, 8] - az
    dx, dy, dz = np.float64(direction[ray, 0]), np.float64(direction[ray, 1]), np.float64(direction[ray, 2])
    px, py, pz = dy * vz - dz * vy, dz * vx - dx * vz, dx * vy - dy * vx
    det = ux * px + uy * py + uz * pz
    if det == 0.0:
        return np.inf
    sx, sy, sz = origin[ray, 0] - ax, origin[ray, 1] - ay, origin[ray, 2] - az
    u = (sx * px + sy * py + sz * pz) / det
    qx, qy, qz = sy * uz - sz * uy, sz * ux - sx * uz, sx * uy - sy * ux
    v = (dx * qx + dy * qy + dz * qz) / det
    hit = (vx * qx + vy * qy + vz * qz) / det
    if u < 0.0 or v < 0.0 or u + v > 1.0 or hit < 0.0:
        return np.inf
    return hit
