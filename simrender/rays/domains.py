"""Spatial partitions: where each domain lies, what it holds, and which rank it goes to.

There are two steps. First a scene is cut into *domains*: bricks of a volume (`kd_bricks`), parts of a surface
(`sah_parts`), cells of a rectilinear grid (`uniform_grid`, `balanced_grid`), or the parts and objects that it comes in.
Then domains are dealt to *ranks*: along a space-filling curve (`morton_ranks`), in blocks (`block_ranks`) or in turn
(`round_robin`). A `Domains` says what each one weighs at published scale: a stand-in stands for the real scene in
proportion to its primitives.
"""

from __future__ import annotations

import hashlib
import heapq
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from simrender.errors import SceneError, SceneWarning
from simrender.rays.partition import Footprint, Partition, Published
from simrender.rays.scene import Scene, Triangles
from simrender.rays.volume import MACRO, Volume

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Planes = tuple[F64, F64, F64]


@dataclass(frozen=True, eq=False)
class Domains:
    """A partition of a scene into domains, each with a box around what it holds.

    Attributes
    ----------
    low, high : float32 array (d, 3)
        Each domain's box; inside out (infinite, minus infinite) when the domain is empty.
    bytes, primitives : float64 array (d,)
        What each domain takes in memory and how much it holds, at published scale.
    domain_of_triangle : int32 array (t,) or None
        The domain of each global triangle id.
    cells : int32 array (d, 6) or None
        The box of volume cells of each domain, (x0, x1, y0, y1, z0, z1) with x0 <= x < x1.
    planes : three float64 arrays or None
        The planes that bound the cells along x, y and z, when the boxes are those of a rectilinear grid. Cell
        (ix, iy, iz) is domain ix + nx * (iy + ny * iz).

    """

    low: F32
    high: F32
    bytes: F64
    primitives: F64
    domain_of_triangle: I32 | None = None
    cells: I32 | None = None
    planes: Planes | None = None

    @property
    def count(self) -> int:
        """Number of domains."""
        return len(self.low)

    @cached_property
    def key(self) -> str:
        """Content hash: with equal keys, equal rays cross and hit the same domains, whatever these weigh."""
        digest = hashlib.blake2b(digest_size=8)
        for array in (self.low, self.high, self.domain_of_triangle, self.cells, *(self.planes or ())):
            digest.update(b"none" if array is None else f"{array.shape}".encode())
            if array is not None:
                digest.update(np.ascontiguousarray(array).data)
        return f"{digest.hexdigest()}-{self.count}"


def from_primitives(
    low: F32, high: F32, domain: I32, count: int, total_bytes: float, total_primitives: float
) -> Domains:
    """Describe domains of any primitives, elements of a pre-partitioned mesh for instance, that weigh all the same.

    Parameters
    ----------
    low, high : float32 array (t, 3)
        The box of each primitive.
    domain : int32 array (t,)
        The domain of each primitive, below ``count``.
    count : int
    total_bytes, total_primitives : float
        Of the whole scene as published; shared out in proportion to the primitives.

    """
    share: F64 = np.bincount(domain, minlength=count) / np.float64(max(len(domain), 1))
    return Domains(*_boxes_around(low, high, domain, count), share * total_bytes, share * total_primitives)


def from_triangles(
    triangles: Triangles, domain: I32, count: int, total_bytes: float, total_primitives: float
) -> Domains:
    """Describe domains of triangles; parameters as for `from_primitives`."""
    domain = np.ascontiguousarray(domain, np.int32)
    found = from_primitives(*triangle_boxes(triangles), domain, count, total_bytes, total_primitives)
    return replace(found, domain_of_triangle=domain)


def from_instances(scene: Scene, domain: I32, count: int, published: Published, footprint: Footprint) -> Domains:
    """Describe domains of whole instances.

    A domain holds every object that one of its instances needs, so objects are held more than once and the bytes add up
    to more than the scene's. They are weighed like those of an object partition: geometry and textures, and the two
    constants of the footprint, in proportion to triangles and instances.

    Parameters
    ----------
    scene : Scene
    domain : int32 array (instances,)
        The domain of each instance, below ``count``.
    count : int
    published : Published
    footprint : Footprint

    """
    of_object = scene.instance_object
    size = np.array([thing.triangles for thing in scene.objects])
    bytes_a_triangle = (published.geometry_bytes + published.texture_bytes) / published.triangles
    bytes_a_triangle += footprint.triangle_bytes
    held = np.unique(domain.astype(np.int64) * len(size) + of_object)
    unique = np.bincount(held // len(size), size[held % len(size)], minlength=count)
    instances = np.bincount(domain, minlength=count)
    instanced = np.bincount(domain, size[of_object], minlength=count)
    weight = unique * (published.triangles / scene.unique_triangles * bytes_a_triangle)
    weight += instances * (published.instances / len(of_object) * footprint.instance_bytes)
    domain_of_triangle = np.repeat(domain, size[of_object]).astype(np.int32)
    return Domains(
        *_boxes_around(*triangle_boxes(scene.triangles), domain_of_triangle, count),
        weight.astype(np.float64),
        instanced.astype(np.float64) * (published.instanced_triangles / scene.instanced_triangles),
        domain_of_triangle,
    )


def from_objects(scene: Scene, partition: Partition) -> Domains:
    """Describe an object partition, dealt by `simrender.rays.partition.partition`, as domains with boxes."""
    domain = partition.domain_of_mesh[scene.triangles.mesh].astype(np.int32)
    low, high = _boxes_around(*triangle_boxes(scene.triangles), domain, partition.domains)
    return Domains(low, high, partition.weight_bytes, partition.primitives, domain)


def triangle_boxes(triangles: Triangles) -> tuple[F32, F32]:
    """Return the lowest and highest corner of each triangle's box, float32 (t, 3)."""
    a, b, c = (triangles.vertices[triangles.faces[:, k]] for k in range(3))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def instance_boxes(scene: Scene) -> tuple[F32, F32]:
    """Return the lowest and highest corner of each instance's box, float32 (n, 3): tight around its triangles."""
    size = np.array([thing.triangles for thing in scene.objects])[scene.instance_object]
    instance = np.repeat(np.arange(len(size), dtype=np.int32), size)
    return _boxes_around(*triangle_boxes(scene.triangles), instance, len(size))


def _boxes_around(low: F32, high: F32, group: I32, count: int) -> tuple[F32, F32]:
    """Return the box around all boxes of each group, inside out where a group has none."""
    outer_low, outer_high = np.full((count, 3), np.inf, np.float32), np.full((count, 3), -np.inf, np.float32)
    for axis in range(3):
        np.minimum.at(outer_low[:, axis], group, low[:, axis])
        np.maximum.at(outer_high[:, axis], group, high[:, axis])
    return outer_low, outer_high


# Volumes


def kd_bricks(dims: Sequence[int], count: int, macro: int = MACRO) -> I32:
    """Cut a volume into bricks with a kd-tree that splits in the middle.

    The islands paper, section 4.1. The longest axis is split, the lower one of equals. A count that is odd is split as
    evenly as it can be, and the plane then lies at the place in proportion. Planes lie on multiples of ``macro`` cells;
    where that leaves a side with fewer macro cells than bricks, bricks move to the other side.

    Parameters
    ----------
    dims : (nx, ny, nz)
        Grid points along each axis.
    count : int
        Bricks.
    macro : int

    Returns
    -------
    int32 array (count, 6)
        Cells (x0, x1, y0, y1, z0, z1) of each brick, in the order of the tree's leaves, lower side first.

    Raises
    ------
    SceneError
        If there are fewer macro cells than bricks.

    """
    whole = [(0, points - 1) for points in dims]
    most = int(np.prod([-(-end // macro) for _, end in whole]))
    if not 1 <= count <= most:
        size = " x ".join(str(points) for points in dims)
        raise SceneError(
            f"a volume of {size} voxels cannot be cut into {count} bricks: their faces lie on multiples of {macro} "
            f"cells, which allows 1 to {most}; ask for fewer bricks or trace a larger volume"
        )
    bricks = []
    todo = [(whole, count)]
    while todo:
        brick, leaves = todo.pop()
        if leaves == 1:
            bricks.append([edge for span in brick for edge in span])
            continue
        axis = int(np.argmax([end - begin for begin, end in brick]))
        begin, end = brick[axis]
        blocks = [-(-(e - b) // macro) for b, e in brick]
        across = int(np.prod(blocks)) // blocks[axis]
        lower = (leaves + 1) // 2
        at = min(max(int((end - begin) * lower / leaves / macro + 0.5), 1), blocks[axis] - 1)
        lower = min(max(lower, leaves - (blocks[axis] - at) * across, 1), at * across, leaves - 1)
        for span, share in (((begin + at * macro, end), leaves - lower), ((begin, begin + at * macro), lower)):
            todo.append(([*brick[:axis], span, *brick[axis + 1 :]], share))
    return np.array(bricks, np.int32)


def ghost_bytes(
    cells: I32, dims: Sequence[int], published: Sequence[int] | None = None, bytes_per_voxel: float = 4.0
) -> F64:
    """Return what each brick takes in memory with its ghost layers, float64 (d,), at published scale.

    A brick keeps the voxels at the corners of its cells, and one more layer on each side where the volume goes on, for
    gradients (the islands paper, section 4.1).

    Parameters
    ----------
    cells : int32 array (d, 6)
    dims : (nx, ny, nz)
        Grid points of the traced volume.
    published : (nx, ny, nz) or None
        Grid points of the volume for which it stands; by default its own.
    bytes_per_voxel : float

    """
    voxels = np.ones(len(cells))
    for axis, (traced, real) in enumerate(zip(dims, published or dims, strict=True)):
        begin, end = cells[:, 2 * axis], cells[:, 2 * axis + 1]
        layers = (begin > 0).astype(np.float64) + (end < traced - 1)
        voxels *= (end - begin) * ((real - 1) / (traced - 1)) + 1.0 + layers
    return voxels * bytes_per_voxel


def from_bricks(
    volume: Volume, cells: I32, published: Sequence[int] | None = None, bytes_per_voxel: float = 4.0
) -> Domains:
    """Describe bricks of a volume as domains; their primitives are cells.

    Parameters
    ----------
    volume : Volume
    cells : int32 array (d, 6)
        As from `kd_bricks`.
    published : (nx, ny, nz) or None
        Grid points of the volume for which it stands; by default its own.
    bytes_per_voxel : float
        As published.

    """
    spacing, origin = np.asarray(volume.spacing, np.float64), np.asarray(volume.origin, np.float64)
    low, high = origin + cells[:, 0::2] * spacing, origin + cells[:, 1::2] * spacing
    traced, real = np.array(volume.dims) - 1.0, np.array(published or volume.dims) - 1.0
    count = (np.diff(cells.reshape(-1, 3, 2), axis=2)[:, :, 0] * (real / traced)).prod(axis=1)
    # Rounded outward, for a box must hold its brick; neighbours overlap by a rounding.
    low32, high32 = low.astype(np.float32), high.astype(np.float32)
    low32 = np.where(low32 > low, np.nextafter(low32, np.float32(-np.inf)), low32)
    high32 = np.where(high32 < high, np.nextafter(high32, np.float32(np.inf)), high32)
    return Domains(low32, high32, ghost_bytes(cells, volume.dims, published, bytes_per_voxel), count, cells=cells)


# Surfaces


def sah_parts(low: F32, high: F32, count: int, weight: F64 | None = None, bins: int = 32) -> I32:
    """Cut primitives into parts by the surface area heuristic.

    The islands paper, section 5.3. A part's cost is the area of its box times its weight: how likely a ray enters, and
    what it costs then. The part of highest cost is split in two, over and over; of all planes between ``bins`` bins
    along each axis, the one that leaves the least cost (Wald, "On fast construction of SAH-based bounding volume
    hierarchies", IEEE Symposium on Interactive Ray Tracing 2007). A primitive lies on the side of its box's centre and
    so in one part; boxes of parts may overlap.

    Parameters
    ----------
    low, high : float32 array (t, 3)
        The box of each primitive: triangles, or instances, which then stay whole.
    count : int
        Parts asked for.
    weight : float64 array (t,) or None
        Of each primitive, such as an instance's triangles; 1 by default.
    bins : int

    Returns
    -------
    int32 array (t,)
        The part of each primitive. There are fewer parts than asked for when another split would leave an empty one,
        because the primitives of each part have their centres in one point.

    Warns
    -----
    SceneWarning
        If there are fewer parts than asked for.

    """
    low, high = np.ascontiguousarray(low, np.float32), np.ascontiguousarray(high, np.float32)
    weight = np.ones(len(low)) if weight is None else np.asarray(weight, np.float64)
    centre = 0.5 * (low.astype(np.float64) + high)
    part = np.zeros(len(low), np.int32)
    rows = [np.arange(len(low))]
    costs = [(-np.inf, 0)] if len(low) else []
    while len(rows) < count and costs:
        _, index = heapq.heappop(costs)
        split = _cheapest_split(low, high, centre, weight, rows[index], bins)
        if split is None:
            continue
        left, cost_left, cost_right = split
        mine = rows[index]
        rows[index] = mine[left]
        rows.append(mine[~left])
        part[rows[-1]] = len(rows) - 1
        heapq.heappush(costs, (-cost_left, index))
        heapq.heappush(costs, (-cost_right, len(rows) - 1))
    if len(rows) < count:
        warnings.warn(
            f"the surface area heuristic makes {len(rows)} parts of {len(low)} primitives and not {count}: "
            "one more split would leave an empty part",
            SceneWarning,
            stacklevel=2,
        )
    return part


def _cheapest_split(
    low: F32, high: F32, centre: F64, weight: F64, rows: NDArray[np.int64], bins: int
) -> tuple[NDArray[np.bool_], float, float] | None:
    """Return which rows go left and the cost of both sides, or None if all centres are in one point."""
    inside = centre[rows]
    base, extent = inside.min(axis=0), np.ptp(inside, axis=0)
    with np.errstate(divide="ignore", over="ignore"):
        scale = np.where(np.isfinite(bins / extent), bins / extent, 0.0)
    if not scale.any():
        return None
    mass, boxes = _bin(low, high, centre, weight, rows, base, scale, bins)
    sides = []
    for flip in (slice(None), slice(None, None, -1)):
        outer_low = np.minimum.accumulate(boxes[:, flip, :3], axis=1)[:, flip]
        outer_high = np.maximum.accumulate(boxes[:, flip, 3:], axis=1)[:, flip]
        x, y, z = np.moveaxis(np.maximum(outer_high - outer_low, 0.0), 2, 0)
        count, weights = np.moveaxis(np.cumsum(mass[:, flip], axis=1)[:, flip], 2, 0)
        sides.append((count, weights, (x * y + y * z + z * x) * weights))
    # Plane i lies between the bins i and i + 1.
    (count_l, weight_l, cost_l), (count_r, weight_r, cost_r) = (
        [column[:, cut] for column in side] for side, cut in zip(sides, (slice(-1), slice(1, None)), strict=True)
    )
    total = np.where((count_l > 0) & (count_r > 0), cost_l + cost_r, np.inf)
    uneven = np.abs(weight_l - weight_r)
    axis, plane = divmod(int(np.lexsort((uneven.ravel(), total.ravel()))[0]), bins - 1)
    left = ((inside[:, axis] - base[axis]) * scale[axis]).astype(np.int64) <= plane
    return left, float(cost_l[axis, plane]), float(cost_r[axis, plane])


@njit(cache=True, nogil=True, error_model="numpy")
def _bin(low, high, centre, weight, rows, base, scale, bins):  # type: ignore[no-untyped-def]
    """Return count and weight (3, bins, 2) and the box (3, bins, 6) of the rows in each bin along each axis."""
    mass, boxes = np.zeros((3, bins, 2)), np.full((3, bins, 6), np.inf)
    boxes[:, :, 3:] = -np.inf
    for row in rows:
        for axis in range(3):
            if scale[axis] == 0.0:
                continue
            b = min(int((centre[row, axis] - base[axis]) * scale[axis]), bins - 1)
            mass[axis, b, 0] += 1.0
            mass[axis, b, 1] += weight[row]
            for k in range(3):
                boxes[axis, b, k] = min(boxes[axis, b, k], low[row, k])
                boxes[axis, b, k + 3] = max(boxes[axis, b, k + 3], high[row, k])
    return mass, boxes


# Rectilinear grids


def uniform_grid(low: ArrayLike, high: ArrayLike, shape: Sequence[int]) -> Planes:
    """Return the planes of a grid of equal cells (nx, ny, nz) over a box: SpRay, table 1, "uniform"."""
    bounds = zip(np.asarray(low, np.float64), np.asarray(high, np.float64), shape, strict=True)
    x, y, z = (np.linspace(a, b, n + 1) for a, b, n in bounds)
    return x, y, z


def balanced_grid(
    positions: ArrayLike,
    shape: Sequence[int],
    weight: F64 | None = None,
    bounds: tuple[ArrayLike, ArrayLike] | None = None,
) -> Planes:
    """Return the planes of a grid whose slabs along each axis weigh the same: SpRay, table 1, "non-uniform".

    Parameters
    ----------
    positions : array (n, 3), n > 0
        Of what the cells are to share, such as centres of triangles.
    shape : (nx, ny, nz)
        Cells along each axis.
    weight : float64 array (n,) or None
        Of each position; 1 by default.
    bounds : (low, high) or None
        The outer planes; by default those that just hold the positions.

    Notes
    -----
    An inner plane lies half way between the positions on its sides. Where many positions have one coordinate, planes
    fall together and the cell between them is flat.

    """
    positions = np.asarray(positions, np.float64)
    weight = np.ones(len(positions)) if weight is None else np.asarray(weight, np.float64)
    low, high = (positions.min(axis=0), positions.max(axis=0)) if bounds is None else np.asarray(bounds, np.float64)
    planes = []
    for axis, cells in enumerate(shape):
        order = np.argsort(positions[:, axis], kind="stable")
        x, sums = positions[order, axis], np.cumsum(weight[order])
        at = np.searchsorted(sums, sums[-1] * np.arange(1, cells) / cells * (1.0 - 1e-12))
        inner = 0.5 * (x[at] + x[np.minimum(at + 1, len(x) - 1)])
        planes.append(np.concatenate([[low[axis]], np.clip(inner, low[axis], high[axis]), [high[axis]]]))
    return planes[0], planes[1], planes[2]


def cell_of(planes: Planes, positions: ArrayLike) -> I32:
    """Return the grid cell of each position, int32 (n,): on a plane the upper one, outside the nearest."""
    positions = np.asarray(positions)
    ix, iy, iz = (np.searchsorted(p[1:-1], positions[:, axis], side="right") for axis, p in enumerate(planes))
    nx, ny = len(planes[0]) - 1, len(planes[1]) - 1
    return (ix + nx * (iy + ny * iz)).astype(np.int32)


def rectilinear(triangles: Triangles, planes: Planes, total_bytes: float, total_primitives: float) -> Domains:
    """Deal triangles to the cells of a rectilinear grid, each to the cell of its box's centre.

    If no triangle reaches out of its cell and no cell is empty, as with isosurfaces that were made cell by cell, the
    domains' boxes are the cells and ``planes`` is kept, so that rays can walk. Otherwise boxes are those of the
    triangles, and may overlap.

    Parameters
    ----------
    triangles : Triangles
    planes : three float64 arrays
    total_bytes, total_primitives : float
        Of the whole scene as published; shared out in proportion to the triangles.

    """
    low, high = triangle_boxes(triangles)
    nx, ny, nz = (len(p) - 1 for p in planes)
    domain = cell_of(planes, 0.5 * (low.astype(np.float64) + high))
    found = from_triangles(triangles, domain, nx * ny * nz, total_bytes, total_primitives)
    index = np.stack(np.unravel_index(np.arange(found.count), (nz, ny, nx))[::-1], axis=1)
    rounded = [p.astype(np.float32) for p in planes]
    cell_low = np.stack([p[index[:, axis]] for axis, p in enumerate(rounded)], axis=1)
    cell_high = np.stack([p[index[:, axis] + 1] for axis, p in enumerate(rounded)], axis=1)
    held = (found.low >= cell_low) & (found.high <= cell_high) & (found.low <= found.high)
    return replace(found, low=cell_low, high=cell_high, planes=planes) if held.all() else found


# Ranks


def morton_ranks(low: F32, high: F32, ranks: int) -> I32:
    """Deal domains to ranks in blocks along the z-order curve.

    As the SpRay program does: of N domains in the order of the 30-bit Morton codes of their centres, scaled to the box
    around all (x most significant), the first floor(N / n) go to rank 0, the next to rank 1 and so on. What is left
    over goes on from rank 0, in blocks of the same size. With more ranks than domains each of the first N ranks gets
    one, where that program would leave all to rank 0. Empty domains come last.

    Parameters
    ----------
    low, high : float32 array (d, 3)
    ranks : int

    Returns
    -------
    int32 array (d,)

    """
    filled = (low <= high).all(axis=1)
    code = np.full(len(low), 1 << 30, np.int64)
    if filled.any():
        base, top = low[filled].min(axis=0).astype(np.float64), high[filled].max(axis=0).astype(np.float64)
        centre = 0.5 * (low[filled].astype(np.float64) + high[filled])
        extent = np.where(top > base, top - base, 1.0)
        bits = np.minimum((centre - base) / extent * 1024.0, 1023.0).astype(np.int64)
        for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
            bits = (bits | bits << shift) & mask
        code[filled] = bits[:, 0] << 2 | bits[:, 1] << 1 | bits[:, 2]
    ranks_in_order = np.arange(len(low)) // max(len(low) // ranks, 1) % ranks
    rank = np.empty(len(low), np.int32)
    rank[np.argsort(code, kind="stable")] = ranks_in_order
    return rank


def block_ranks(domains: int, ranks: int) -> I32:
    """Deal domains to ranks in contiguous blocks whose sizes differ by one at most, the larger ones first."""
    each, more = divmod(domains, ranks)
    return np.repeat(np.arange(ranks, dtype=np.int32), np.where(np.arange(ranks) < more, each + 1, each))


def round_robin(domains: int, ranks: int) -> I32:
    """Deal domains to ranks in turn: rank r gets domains r, r + n, r + 2n, ... (the islands paper, section 7.2)."""
    return np.arange(domains, dtype=np.int32) % np.int32(ranks)
