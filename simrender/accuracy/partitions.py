"""Whether hits depend on how a scene is cut into domains.

`compare` traces rays through one hierarchy over everything and through each domain's own, and counts where the nearest
hits differ; `aimed_rays` makes those for which that is hard. Rays in general position must agree to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.domains import Domains
from simrender.rays.integrators import PathTracing
from simrender.rays.scene import Scene
from simrender.rays.trace import Trace
from simrender.rays.workload import Workload
from simrender.rays.workload_card import DomainsCard
from simrender.rays.worlds import SurfaceWorld

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Ids = NDArray[np.int64]
Rays = dict[str, Any]


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


def aimed_rays(
    scene: Scene, domains: Domains, count: int, seed: int = 1, welded: Welded | None = None
) -> dict[str, Rays]:
    """Return rays that go where rounding decides, at most ``count`` of each kind, by name.

    ============= ====================================================================================================
    vertices      from anywhere at vertices, as exactly as float32 directions allow
    edges         the same, at the middles of edges
    axis-parallel along an axis, exactly through a vertex
    diagonal      exactly through a vertex along the diagonals of a cube and of its faces
    faces         askew within an axis-aligned plane through a vertex: a face between the domains that share the vertex
    ============= ====================================================================================================

    Vertices are those that domains share, if there are such. Rays of the last three kinds start close to their vertex
    and end close behind it, and the surface around it is whole and not seen edge on. So each of them goes *through*
    that surface: one that hits nothing has found a hole. Who asks for several partitions of a scene welds it once.
    """
    if domains.domain_of_triangle is None:
        raise SceneError("these domains do not say which triangles lie in them")
    rng = generator(seed)
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    mesh = welded or Welded(scene)
    shared = mesh.shared(domains.domain_of_triangle)
    start = (low + (rng.random((count, 3)) * 3.0 - 1.0) * (high - low)).astype(np.float32)
    edge = mesh.faces[rng.integers(0, len(mesh.faces), count), :2]
    middle = mesh.vertices[edge].astype(np.float64).mean(axis=1).astype(np.float32)
    flat = rng.standard_normal((count, 3))
    flat[np.arange(count), rng.integers(0, 3, count)] = 0.0
    shapes = np.array([[1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 1, 1]])[rng.integers(0, 4, count)]
    signs = rng.choice([-1.0, 1.0], (count, 3))
    axes = np.eye(3)[rng.integers(0, 3, count)]
    return {
        "vertices": bundle(start, mesh.vertices[mesh.pick(mesh.used, shared, count, rng)].astype(np.float64) - start),
        "edges": bundle(start, middle.astype(np.float64) - start),
        "axis-parallel": mesh.through(axes * signs, shared, rng, exact=True),
        "diagonal": mesh.through(shapes * signs, shared, rng, exact=True),
        "faces": mesh.through(flat, shared, rng, exact=False),
    }


class Welded:
    """A scene's triangles with one vertex a place, and which vertices lie inside a surface.

    Parameters
    ----------
    scene : Scene

    """

    def __init__(self, scene: Scene) -> None:
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
        # Around a vertex the surface is whole, and its faces look the same way, if each edge is passed once in either
        # direction. Where they do not, a ray that seems to go through the surface may pass by its outline.
        begins, ends = (np.roll(self.faces, -k, axis=1).ravel().astype(np.int64) for k in (0, 1))
        there, counts = np.unique(begins * count + ends, return_counts=True)
        single = there[counts == 1]
        open_ = there[(counts != 1) | ~np.isin(there % count * count + there // count, single)]
        closed = np.ones(count, np.bool_)
        closed[np.concatenate([open_ // count, open_ % count])] = False
        self.inner = np.flatnonzero(closed & (np.diff(self.begin) > 0))

    def shared(self, domain: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return which vertices have triangles of two domains around them."""
        first, last = (np.full(len(self.vertices), n, np.int32) for n in (np.iinfo(np.int32).max, -1))
        for corner in self.faces.T:
            np.minimum.at(first, corner, domain)
            np.maximum.at(last, corner, domain)
        return np.less(first, last)

    def pick(self, among: Ids, first: NDArray[np.bool_], count: int, rng: np.random.Generator) -> Ids:
        """Return vertices at random, those that come first if there are such."""
        pool = among[first[among]] if first[among].any() else among
        return pool[rng.integers(0, len(pool), count)] if len(pool) else pool

    def through(self, direction: F64, first: NDArray[np.bool_], rng: np.random.Generator, *, exact: bool) -> Rays:
        """Return the rays of some directions, each through a vertex at random, that pass through its surface there.

        Of these keep, if wanted, those whose origins are exact.
        """
        vertex = self.pick(self.inner, first, len(direction), rng)
        direction = direction[: len(vertex)]
        faces = self.begin[vertex + 1] - self.begin[vertex]
        starts = np.concatenate([[0], np.cumsum(faces)])
        row = np.repeat(np.arange(len(vertex)), faces)
        face = self.around[self.begin[vertex][row] + np.arange(len(row)) - starts[:-1][row]]
        unit = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        cosine = (self.normals[face] * unit[row]).sum(axis=1)
        least, most = (f.reduceat(cosine, starts[:-1]) if len(row) else cosine for f in (np.minimum, np.maximum))
        keep = (least > 0.1) | (most < -0.1)
        at, direction = self.vertices[vertex[keep]].astype(np.float64), direction[keep]
        step = 2.0 ** np.floor(np.log2(0.01 * self.size)) * direction
        rays = bundle(at - step, direction) | {"reach": (2.0 * np.linalg.norm(step, axis=1)).astype(np.float32)}
        kept = (rays["origin"].astype(np.float64) == at - step).all(axis=1) | (not exact)
        return {name: column[kept] for name, column in rays.items()}


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
    strays : int
        Rays that hit something else: the distances differ by more than `SAME`, relative to the distance or to the
        scene's size, whichever is larger.
    differences : int
        Rays that hit something at another distance, strays included.
    ties : int
        Rays that hit another triangle at the same distance.

    """

    rays: int
    hits: int
    leaks: int
    strays: int
    differences: int
    ties: int


SAME = 2e-5
"""Largest relative difference of the distances at which a ray meets two triangles in the edge that they share."""


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
    one_t, one = nearest(world.geometry, rays)
    t, primitive = np.full(len(one), np.inf, np.float32), np.full(len(one), -1, np.int64)
    for d in range(domains.count):
        geometry = world.domain_geometry(domains, d)
        if geometry is None:
            continue
        ids = np.flatnonzero(domains.domain_of_triangle == d)
        here_t, here = nearest(geometry, rays)
        here = np.where(here >= 0, ids[here], -1)
        nearer = (here >= 0) & ((here_t < t) | ((here_t == t) & (here < primitive)))
        t[nearer], primitive[nearer] = here_t[nearer], here[nearer]
    leaks = (one < 0) != (primitive < 0)
    hits = (one >= 0) & (primitive >= 0)
    before, after = one_t[hits].astype(np.float64), t[hits]
    # Coordinates have the digits of the scene's size, and so have distances, however short.
    strays = np.abs(before - after) > SAME * np.maximum(before, np.linalg.norm(np.subtract(*world.scene.bounds)))
    return Compared(
        rays=len(one),
        hits=int((one >= 0).sum()),
        leaks=int(leaks.sum()),
        strays=int(strays.sum()),
        differences=int((before != after).sum()),
        ties=int((hits & (one_t == t) & (one != primitive)).sum()),
    )


CUTS = (
    DomainsCard(method="objects", count=6),
    DomainsCard(method="sah", count=13),
    DomainsCard(method="grid", shape=(3, 3, 2)),
    DomainsCard(method="balanced", shape=(4, 2, 2)),
)
"""Partitions of a surface, besides the one in which it comes."""


def partitions(workload: Workload, cuts: Sequence[DomainsCard] = CUTS, count: int = 10_000) -> list[dict[str, Any]]:
    """Return how hits in a workload depend on how its triangles are cut into domains.

    Returns
    -------
    list of dict
        A row for each partition and kind of ray: ``scene``, ``cut``, ``domains``, ``aim``, and what `Compared` holds.
        Aims are ``paths``, the rays of a small frame with four bounces, shadow rays among them; ``random``; and those
        of `aimed_rays`. The workload's own domains come first, if there are less than a hundred.

    """
    trace = workload.trace()
    frame = Trace(trace.scene, trace.camera, (48, 36), 1, PathTracing(4, 4, 0.3), trace.seed, workload.cache)
    world = SurfaceWorld(trace.scene, PathTracing())
    loose = {"paths": path_rays(frame), "random": random_rays(trace.scene, count)}
    welded = Welded(trace.scene)
    given = [] if workload.card.domains is None else [workload.card.domains]
    rows = []
    for cut in (*given, *cuts):
        domains = workload.domains(cut)
        if domains.count > 99:
            continue
        for aim, rays in (loose | aimed_rays(trace.scene, domains, count // 4, welded=welded)).items():
            label = {"scene": workload.name, "cut": cut.method, "domains": domains.count, "aim": aim}
            rows.append(label | asdict(compare(world, domains, rays)))
    return rows


def nearest(geometry: embree.Geometry, rays: Rays) -> tuple[F32, Ids]:
    """Return distance and triangle of each ray's nearest hit, on all cores."""

    def work(rows: slice) -> embree.Hits:
        return geometry.nearest(rays["origin"][rows], rays["direction"][rows], rays["reach"][rows])

    found = embree.in_chunks(work, len(rays["reach"]))
    t = np.concatenate([hits.t for hits in found])
    return t, np.concatenate([hits.primitive for hits in found]).astype(np.int64)
