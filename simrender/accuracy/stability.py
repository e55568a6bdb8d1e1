"""Whether hits depend on how a scene is cut, how large it is, and how far from the origin it lies.

`compare` traces rays through one hierarchy over everything and through each domain's own, and counts where the nearest
hits differ. `sizes_and_offsets` moves one scene through twelve orders of magnitude and counts the paths that hit the
triangle they start on, or go on to another one than they should, with the origins of secondary rays moved off their
surface as Waechter and Binder do it ("A fast and robust method for avoiding self-intersection", Ray Tracing Gems,
2019) and by a fixed distance, as is often done.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.domains import Domains
from simrender.rays.integrators import PathTracing
from simrender.rays.sampling import offset_origin
from simrender.rays.scene import IDENTITY, Mesh, Scene, SceneObject
from simrender.rays.trace import Trace
from simrender.rays.worlds import SurfaceWorld

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ids = NDArray[np.int64]
Rays = dict[str, Any]

ANYWHERE = np.array([0.60, 0.64, 0.48])
"""The unit vector along which scenes are moved: no axis, no diagonal."""


def generator(seed: int) -> np.random.Generator:
    """Return random numbers that are the same on every machine."""
    return np.random.Generator(np.random.Philox(key=seed))


# -- rays -------------------------------------------------------------------------------------------------------------


def bundle(origin: Any, direction: Any) -> Rays:
    """Return rays of any reach as the ray table has them; directions become unit vectors."""
    direction = np.asarray(direction, np.float64)
    unit = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    origin = np.ascontiguousarray(np.broadcast_to(np.asarray(origin, np.float32), unit.shape))
    return {"origin": origin, "direction": unit, "reach": np.full(len(unit), np.inf, np.float32)}


def random_rays(scene: Scene, count: int, seed: int = 1) -> Rays:
    """Return rays from anywhere in and around a scene towards anywhere in it."""
    rng = generator(seed)
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    origin = low + (rng.random((count, 3)) * 2.0 - 0.5) * (high - low)
    return bundle(origin, low + rng.random((count, 3)) * (high - low) - origin.astype(np.float32))


def path_rays(trace: Trace) -> Rays:
    """Return all rays of a frame: those of the camera, and those that they spawn."""
    trace.complete()
    parts = [trace.geometry(generation) for generation in range(trace.generations)]
    return {name: np.concatenate([part[name] for part in parts]) for name in ("origin", "direction", "reach")}


def aimed_rays(scene: Scene, domains: Domains, count: int, seed: int = 1) -> dict[str, Rays]:
    """Return rays that go where rounding decides, at most ``count`` of each kind, by name.

    ============= ====================================================================================================
    vertices      from anywhere at vertices, as exactly as float32 directions allow
    edges         the same, at the middles of edges
    axis-parallel along an axis, and to the last digit through a vertex
    diagonal      through a vertex along the diagonals of a cube and of its faces
    faces         through a vertex, askew within an axis-aligned plane: the face between two domains that share the vertex
    ============= ====================================================================================================

    Vertices that domains share come first. The last three kinds start close to their vertex and end close behind it,
    and the surface around it is whole and not seen edge on. So each of these rays goes *through* that surface: one that
    hits nothing has found a hole.
    """
    if domains.domain_of_triangle is None:
        raise SceneError("these domains do not say which triangles lie in them")
    rng = generator(seed)
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    mesh = _Welded(scene, domains.domain_of_triangle)
    start = (low + (rng.random((count, 3)) * 3.0 - 1.0) * (high - low)).astype(np.float32)
    edge = mesh.faces[rng.integers(0, len(mesh.faces), count), :2]
    middle = mesh.vertices[edge].astype(np.float64).mean(axis=1).astype(np.float32)
    flat = rng.standard_normal((count, 3))
    flat[np.arange(count), rng.integers(0, 3, count)] = 0.0
    shapes = np.array([[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]])[rng.integers(0, 4, count)]
    signs = rng.choice([-1.0, 1.0], (count, 3))
    axes = np.eye(3)[rng.integers(0, 3, count)]
    return {
        "vertices": bundle(start, mesh.vertices[mesh.pick(mesh.used, count, rng)].astype(np.float64) - start),
        "edges": bundle(start, middle.astype(np.float64) - start),
        "axis-parallel": mesh.through(axes * signs, rng),
        "diagonal": mesh.through(shapes * signs, rng),
        "faces": mesh.through(flat, rng),
    }


class _Welded:
    """A scene's triangles with one vertex a place, and which vertices lie inside a surface."""

    def __init__(self, scene: Scene, domain: NDArray[np.int32]) -> None:
        triangles = scene.triangles
        self.vertices, same = np.unique(triangles.vertices, axis=0, return_inverse=True)
        self.faces = same.reshape(-1)[triangles.faces]
        count = len(self.vertices)
        a, b, c = (self.vertices[self.faces[:, k]].astype(np.float64) for k in range(3))
        self.normals: F64 = np.cross(b - a, c - a)
        length = np.linalg.norm(self.normals, axis=1, keepdims=True)
        self.normals /= np.where(length > 0.0, length, 1.0)
        self.size = float(np.linalg.norm(np.subtract(*scene.bounds)))
        # The faces around each vertex.
        flat = self.faces.ravel()
        self.around = np.argsort(flat, kind="stable") // 3
        self.begin = np.searchsorted(np.sort(flat), np.arange(count + 1))
        self.used = np.flatnonzero(np.diff(self.begin) > 0)
        ends = np.sort(np.concatenate([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]), axis=1)
        keys, times = np.unique(ends[:, 0].astype(np.int64) * count + ends[:, 1], return_counts=True)
        open_ = keys[times != 2]
        closed = np.ones(count, np.bool_)
        closed[np.concatenate([open_ // count, open_ % count])] = False
        self.inner = np.flatnonzero(closed & (np.diff(self.begin) > 0))
        self.shared = np.zeros(count, np.bool_)
        first, last = np.full(count, np.iinfo(np.int32).max, np.int32), np.full(count, -1, np.int32)
        for corner in self.faces.T:
            np.minimum.at(first, corner, domain)
            np.maximum.at(last, corner, domain)
        self.shared = first < last

    def pick(self, among: Ids, count: int, rng: np.random.Generator) -> Ids:
        """Return vertices at random, those that domains share if there are such."""
        shared = among[self.shared[among]]
        pool = shared if len(shared) else among
        return pool[rng.integers(0, len(pool), count)] if len(pool) else pool

    def through(self, direction: F64, rng: np.random.Generator) -> Rays:
        """Return the rays of some directions, each through a vertex at random, that pass through its surface there."""
        vertex = self.pick(self.inner, len(direction), rng)
        direction = direction[: len(vertex)]
        faces = self.begin[vertex + 1] - self.begin[vertex]
        starts = np.concatenate([[0], np.cumsum(faces)])
        row = np.repeat(np.arange(len(vertex)), faces)
        face = self.around[self.begin[vertex][row] + np.arange(len(row)) - starts[:-1][row]]
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        cosine = (self.normals[face] * unit[row]).sum(axis=1)
        least, most = (f.reduceat(cosine, starts[:-1]) if len(row) else cosine for f in (np.minimum, np.maximum))
        keep = (least > 0.1) | (most < -0.1)
        vertex, direction = vertex[keep], direction[keep]
        # A power of two times a direction of 0 and 1 is exact, and so are most sums with a vertex.
        step = 2.0 ** np.floor(np.log2(0.01 * self.size)) * direction
        return bundle(self.vertices[vertex] - step, direction) | {
            "reach": (2.0 * np.linalg.norm(step, axis=1)).astype(np.float32)
        }


# -- partitions -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Compared:
    """How the nearest hits over domains differ from those in one hierarchy over everything.

    Attributes
    ----------
    rays, hits : int
        Rays that were compared, and those that hit something.
    leaks : int
        Rays that hit something in one and nothing in the other.
    differences : int
        Rays that hit something at another distance; leaks are not counted again.
    ties : int
        Rays that hit another triangle at the same distance.
    largest : float
        The largest difference of distances, relative to the distance or the scene's size, whichever is larger.

    """

    rays: int
    hits: int
    leaks: int
    differences: int
    ties: int
    largest: float


def compare(world: SurfaceWorld, domains: Domains, rays: Rays) -> Compared:
    """Compare the nearest hits over all domains, ties to the lower triangle id, with those in the whole scene.

    Every ray is traced in every domain, whether it passes its box or not.

    Raises
    ------
    SceneError
        If the domains do not say which triangles lie in them.

    """
    if domains.domain_of_triangle is None:
        raise SceneError("these domains do not say which triangles lie in them")
    one_t, one = _nearest(world.geometry, rays)
    t, primitive = np.full(len(one), np.inf, np.float32), np.full(len(one), -1, np.int64)
    for d in range(domains.count):
        geometry = world.domain_geometry(domains, d)
        if geometry is None:
            continue
        ids = np.flatnonzero(domains.domain_of_triangle == d)
        here_t, here = _nearest(geometry, rays)
        here = np.where(here >= 0, ids[here], -1)
        nearer = (here >= 0) & ((here_t < t) | ((here_t == t) & (here < primitive)))
        t[nearer], primitive[nearer] = here_t[nearer], here[nearer]
    leaks = (one < 0) != (primitive < 0)
    hits = (one >= 0) & (primitive >= 0)
    error = np.zeros(len(one))
    # Coordinates have the digits of the scene's size, and so have distances, however short.
    scale = np.maximum(one_t[hits], np.linalg.norm(np.subtract(*world.scene.bounds)))
    error[hits] = np.abs(one_t[hits].astype(np.float64) - t[hits]) / scale
    ties = hits & (one_t == t) & (one != primitive)
    return Compared(
        len(one),
        int((one >= 0).sum()),
        int(leaks.sum()),
        int((hits & (one_t != t)).sum()),
        int(ties.sum()),
        float(error.max(initial=0.0)),
    )


def _nearest(geometry: embree.Geometry, rays: Rays) -> tuple[F32, Ids]:
    """Return distance and triangle of each ray's nearest hit, on all cores."""

    def work(rows: slice) -> embree.Hits:
        return geometry.nearest(rays["origin"][rows], rays["direction"][rows], rays["reach"][rows])

    found = embree.in_chunks(work, len(rays["reach"]))
    t = np.concatenate([hits.t for hits in found])
    return t, np.concatenate([hits.primitive for hits in found]).astype(np.int64)


# -- sizes and offsets ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Placed:
    """What becomes of a scene's rays where it is placed, and how secondary rays start there.

    Attributes
    ----------
    size : float
        Of the scene, the diagonal of its box.
    offset : float
        Distance of its centre from the world's origin, in sizes.
    scheme : str
        How the origins of secondary rays are moved off their surface; see `SCHEMES`.
    wrong_first : float
        Share of camera rays that meet another triangle than in exact arithmetic, or none.
    self_hits : float
        Share of secondary rays that hit the triangle they start on.
    wrong_next : float
        Share of secondary rays that meet another triangle than in exact arithmetic, or none; self-hits included.

    """

    size: float
    offset: float
    scheme: str
    wrong_first: float
    self_hits: float
    wrong_next: float


SCHEMES = ("as traced", "Waechter-Binder", "1e-4", "1e-4 of the size")
"""As `Trace` does it; by a step of float32 units alone; by a fixed distance; by a share of the scene's size."""


def sizes_and_offsets(sizes: Sequence[float], offsets: Sequence[float], rays: int = 2000) -> list[Placed]:
    """Return what becomes of rays in a furnished room of some sizes, at some distances from the world's origin.

    Parameters
    ----------
    sizes : floats
        Diagonal of the room.
    offsets : floats
        Of the room's centre from the world's origin, in sizes.
    rays : int
        Camera rays, and as many secondary rays, for each of the `SCHEMES`.

    Notes
    -----
    The truth is a search over all triangles in float64, for the room at the origin with coordinates of 53 bits.
    Furniture is between 1/60 and 1/300 of the room in size, and it stands 1/1000 of it off the floor: where a secondary
    ray starts farther off than that, it misses such gaps.

    """
    room = _Room(rays)
    return [row for size in sizes for offset in offsets for row in room.placed(size, offset)]


class _Room:
    """A closed room with spheres standing in it, rays through it, and what these meet in exact arithmetic."""

    def __init__(self, rays: int) -> None:
        rng = generator(7)
        vertices, self.faces = _furnished(rng)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.vertices: F64 = (vertices - 0.5 * (low + high)) / np.linalg.norm(high - low)
        inside = self.vertices.max(axis=0) * 0.9
        self.eye: F64 = (2.0 * rng.random((rays, 3)) - 1.0) * inside
        self.view = bundle(np.zeros((rays, 3)), (2.0 * rng.random((rays, 3)) - 1.0) * inside - self.eye)["direction"]
        a, e, f = self._edges(self.vertices)
        self.first = _exact(a, e, f, self.eye, self.view.astype(np.float64), np.full(rays, -1))
        # Secondary rays start at points spread evenly over the triangles, small ones too, on the side of the normal.
        self.start = rng.integers(0, len(self.faces), rays)
        u, v = rng.random((2, rays, 1))
        self.uv = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        self.normal: F64 = np.cross(e, f)[self.start]
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        around = rng.standard_normal((rays, 3))
        around = self.normal + around / np.linalg.norm(around, axis=1, keepdims=True)
        self.bounce = bundle(np.zeros((rays, 3)), around)["direction"]
        point = self._points(a, e, f)
        self.next = _exact(a, e, f, point, self.bounce.astype(np.float64), self.start)
        mesh = Mesh(self.vertices.astype(np.float32), self.faces)
        self.object = SceneObject("room", (mesh,))

    def placed(self, size: float, offset: float) -> list[Placed]:
        """Return what becomes of the rays where the room is placed."""
        # Placed in float64 and rounded once, as whoever writes a mesh file does.
        vertices = size * (self.vertices + offset * ANYWHERE)
        thing = SceneObject("room", (Mesh(vertices.astype(np.float32), self.faces),))
        scene = Scene((thing,), np.zeros(1, np.int32), IDENTITY[None])
        trace = Trace(scene, np.eye(4, 3), (1, 1), 1, PathTracing())
        rows = []
        for scheme in SCHEMES:
            factor = trace.factor if scheme == SCHEMES[0] else 1.0
            triangles = (trace.scene if scheme == SCHEMES[0] else scene).triangles
            geometry = embree.Geometry(triangles.vertices, triangles.faces)
            eye = (size * factor * (self.eye + offset * ANYWHERE)).astype(np.float32)
            _, first = _nearest(geometry, bundle(eye, self.view))
            corners = self._edges(triangles.vertices.astype(np.float64))
            origin = self._points(*corners).astype(np.float32)
            if scheme in SCHEMES[:2]:
                _offset(origin, origin.view(np.int32), self.normal)
            else:
                origin += ((1e-4 if scheme == SCHEMES[2] else 1e-4 * size) * self.normal).astype(np.float32)
            _, found = _nearest(geometry, bundle(origin, self.bounce))
            rows.append(
                Placed(
                    size,
                    offset,
                    scheme,
                    float((first != self.first).mean()),
                    float((found == self.start).mean()),
                    float((found != self.next).mean()),
                )
            )
        return rows

    def _edges(self, vertices: F64) -> tuple[F64, F64, F64]:
        a, b, c = (vertices[self.faces[:, k]] for k in range(3))
        return a, b - a, c - a

    def _points(self, a: F64, e: F64, f: F64) -> F64:
        points: F64 = a[self.start] + self.uv[0] * e[self.start] + self.uv[1] * f[self.start]
        return points


@njit(cache=True, nogil=True, error_model="numpy")
def _offset(origin, bits, normal):  # type: ignore[no-untyped-def]
    for i in range(len(origin)):
        offset_origin(origin, bits, i, normal[i, 0], normal[i, 1], normal[i, 2])


def _furnished(rng: np.random.Generator) -> tuple[F64, NDArray[np.int32]]:
    """Return vertices and faces of a room, normals inwards, and of spheres close above its floor, normals outwards."""
    side, tall, rings = 1.0, 0.4, 7
    walls = np.array([[x, y, z] for z in (0.0, tall) for y in (0.0, side) for x in (0.0, side)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices, faces = [walls], [np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])]
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings), 2 * np.pi * np.arange(8) / 8, indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rings - 1), np.arange(8), indexing="ij"))
    a, b, c, d = 8 * i + j, 8 * (i + 1) + j, 8 * i + (j + 1) % 8, 8 * (i + 1) + (j + 1) % 8
    skin = np.concatenate([np.stack([a, b, c], 1)[i > 0], np.stack([b, d, c], 1)[i < rings - 2]])
    for row in range(6):
        for column in range(6):
            radius = rng.uniform(0.005, 0.025)
            centre = np.array([(row + 0.5) / 6.0, (column + 0.5) / 6.0, radius + 1.4e-3])
            faces.append(skin + sum(len(v) for v in vertices))
            vertices.append(centre + radius * ball)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _exact(a: F64, e: F64, f: F64, origin: F64, direction: F64, skip: Ids) -> Ids:
    """Return the nearest triangle of each ray but the one to skip, -1 for none, by trying all of them in float64."""
    found = np.full(len(origin), -1)
    for rows in np.array_split(np.arange(len(origin)), max(len(origin) // 64, 1)):
        o, d = origin[rows, None], direction[rows, None]
        p = np.cross(d, f)
        scale = (e * p).sum(axis=2)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = ((o - a) * p).sum(axis=2) / scale
            q = np.cross(o - a, e)
            v, t = (d * q).sum(axis=2) / scale, (f * q).sum(axis=2) / scale
        t = np.where((u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 0.0), t, np.inf)
        own = skip[rows] >= 0
        t[np.flatnonzero(own), skip[rows][own]] = np.inf
        found[rows] = np.where(np.isfinite(t).any(axis=1), t.argmin(axis=1), -1)
    return found
