"""What a trace asks of a scene: where rays meet something, what comes of it, and what a domain makes of a ray.

A *world* is a scene made ready for one integrator. `follow` takes rays of the ray table through everything; `cross`
takes (ray, domain) rows through one domain each, which is all that a rank which holds that domain could find out.

===================== ==================================================================== ==========================
integrator            a crossing's outcome                                                 its work
===================== ==================================================================== ==========================
paths on surfaces     ``hit``: nearest hit in the domain                                   one query in its hierarchy
marching              ``hit``: where the ray grew opaque; a fragment: ``rgba``, ``exit``   ``work``: samples
volume path tracing   ``hit``: nearest collision, isosurface or triangle                   ``work``: look-ups
elements              ``hit``: where it enters the first part; fragments, see `fragments`  ``work``: elements
===================== ==================================================================== ==========================
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.integrators import (
    AmbientOcclusion,
    ElementMarching,
    Integrator,
    PathTracing,
    RayCasting,
    SprayPathTracing,
    VolumeMarching,
    VolumePathTracing,
)
from simrender.rays.scene import Scene

if TYPE_CHECKING:
    from simrender.rays.domains import Domains
    from simrender.rays.shading import Surfaces

SurfaceIntegrator = RayCasting | PathTracing | AmbientOcclusion | SprayPathTracing
Columns = dict[str, Any]
Ids = NDArray[np.int64]
Report = Callable[[int], None]

SPAWNED = ("origin", "direction", "reach", "throughput", "pixel", "sample", "kind", "diffuse", "mirror", "parent")
"""Columns of the rays that others spawn."""

_BLOCK = 1 << 18
"""Rays whose way through a volume is followed at once."""


class World(Protocol):
    """A scene made ready for one integrator."""

    outcome: tuple[str, ...]
    """Columns that `follow` gives a ray beside t, primitive, radiance and children."""

    def follow(self, rays: Columns, seed: int, done: Report | None = None) -> Columns:
        """Take rays through the whole scene, on all cores.

        Parameters
        ----------
        rays : dict of arrays
            Columns of the ray table.
        seed : int
            Of the random numbers.
        done : callable, optional
            Told how many rays are through.

        Returns
        -------
        dict of arrays
            For each ray ``t``, ``primitive``, ``radiance``, ``children`` and the columns of `outcome`; for the rays
            that they spawn, in the order of their parents, the columns `SPAWNED`.

        """

    def cross(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16], seed: int) -> Columns:
        """Take each ray of some rows through the domain of its row, on all cores.

        Returns
        -------
        dict of arrays
            ``hit``, float32 (n,), infinite for none; and where it costs more than one query, ``work``, uint32 (n,).

        """


def world(scene: Scene, integrator: Integrator) -> World:
    """Return a scene made ready for an integrator.

    Raises
    ------
    SceneError
        If the scene holds nothing that the integrator could follow rays through.

    """
    if isinstance(integrator, ElementMarching):
        return ElementWorld(scene, integrator)
    if isinstance(integrator, VolumeMarching):
        return MarchingWorld(scene, integrator)
    if isinstance(integrator, VolumePathTracing):
        return TrackingWorld(scene, integrator)
    return SurfaceWorld(scene, integrator)


class SurfaceWorld:
    """Triangles in Embree's hierarchies: one over everything, and one a domain, built when first asked for."""

    outcome: tuple[str, ...] = ()

    def __init__(self, scene: Scene, integrator: SurfaceIntegrator) -> None:
        if len(scene.instance_object) == 0:
            raise SceneError("the scene has no triangles; its volume needs volume_marching or volume_path_tracing")
        self.scene, self.integrator = scene, integrator
        self._domains: dict[tuple[str, int], embree.Geometry] = {}
        self._triangles: dict[str, tuple[Ids, Ids]] = {}

    @cached_property
    def surfaces(self) -> Surfaces:
        """The scene as the shading kernels take it."""
        from simrender.rays.shading import Surfaces

        return Surfaces(self.scene)

    @cached_property
    def geometry(self) -> embree.Geometry:
        """The whole scene in one hierarchy."""
        return embree.Geometry(self.scene.triangles.vertices, self.scene.triangles.faces)

    def shade(self, rays: Columns, hits: embree.Hits, seed: int) -> Columns:
        """Return what some rays contribute and spawn if these are their hits; runs on the calling thread."""
        if isinstance(self.integrator, RayCasting):
            from simrender.rays.shading import headlight

            return childless(headlight(rays["direction"], self.scene.environment, hits, self.surfaces))
        if isinstance(self.integrator, PathTracing):
            from simrender.rays.shading import shade

            return shade(rays, hits, self.surfaces, self.integrator, seed)
        from simrender.rays import lighting

        return lighting.shade(rays, hits, self.surfaces, self.integrator, seed)

    def follow(self, rays: Columns, seed: int, done: Report | None = None) -> Columns:
        """See `World`."""
        geometry, n = self.geometry, len(rays["kind"])
        own = {"t": np.empty(n, np.float32), "primitive": np.empty(n, np.int32)}
        own |= {"radiance": np.empty((n, 3), np.float32), "children": np.empty(n, np.uint16)}

        def work(rows: slice) -> Columns:
            chunk = {name: column[rows] for name, column in rays.items()}
            hits = geometry.nearest(chunk["origin"], chunk["direction"], chunk["reach"])
            shaded = self.shade(chunk, hits, seed)
            made = shaded | {"t": hits.t, "primitive": hits.primitive}
            for name, column in own.items():
                column[rows] = made[name]
            made["parent"] = made["parent"] + np.int32(rows.start)
            # Views of arrays with room for every child that there might have been would keep these alive.
            return {name: made[name] if made[name].base is None else made[name].copy() for name in SPAWNED}

        parts = [work(slice(0, 0))]  # loads the kernels, or compiles them the first time
        if done:
            done(0)  # what there is to be timed begins here
        parts += embree.in_chunks(work, n, done)
        return own | joined(parts)

    def cross(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16], seed: int) -> Columns:  # noqa: ARG002
        """See `World`."""
        hit = np.full(len(ray), np.inf, np.float32)
        for _, rows, hits in self._queries(rays, ray, domains, domain):
            hit[rows] = hits.t
        return {"hit": hit}

    def domain_hits(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16]) -> embree.Hits:
        """Return the hits of `cross` in full, with global triangle ids."""
        n = len(ray)
        found = embree.Hits(
            np.full(n, np.inf, np.float32), np.full(n, -1, np.int32), np.zeros(n, np.float32), np.zeros(n, np.float32)
        )
        for d, rows, hits in self._queries(rays, ray, domains, domain):
            found.t[rows], found.u[rows], found.v[rows] = hits.t, hits.u, hits.v
            # A domain's triangles are those of the scene that lie in it, in their order.
            triangles = self._triangles_of(domains, d)
            found.primitive[rows] = np.where(hits.primitive >= 0, triangles[hits.primitive], -1)
        return found

    def _queries(
        self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16]
    ) -> Iterator[tuple[int, Ids, embree.Hits]]:
        """Yield domains, rows, and what these hit there; domains without triangles are left out."""
        jobs = []
        for d, rows in by_domain(domain):
            geometry = self.domain_geometry(domains, d)
            if geometry is not None:
                jobs += [(d, geometry, rows[part]) for part in embree.chunks(len(rows))]

        def work(job: tuple[int, embree.Geometry, Ids]) -> embree.Hits:
            _, geometry, rows = job
            r = ray[rows]
            return geometry.nearest(rays["origin"][r], rays["direction"][r], rays["reach"][r])

        for (d, _, rows), hits in zip(jobs, embree.on_all_cores(work, jobs), strict=True):
            yield d, rows, hits

    def _triangles_of(self, domains: Domains, domain: int) -> Ids:
        """Return the ids of a domain's triangles, ascending."""
        if domains.key not in self._triangles:
            assert domains.domain_of_triangle is not None  # noqa: S101 - the caller looked
            order = np.argsort(domains.domain_of_triangle, kind="stable")
            bounds = np.searchsorted(domains.domain_of_triangle[order], np.arange(domains.count + 1))
            self._triangles[domains.key] = order, bounds
        order, bounds = self._triangles[domains.key]
        return order[bounds[domain] : bounds[domain + 1]]

    def domain_geometry(self, domains: Domains, domain: int) -> embree.Geometry | None:
        """Return a domain's triangles in their own hierarchy, or None if it has none."""
        key = domains.key, domain
        if key not in self._domains:
            if domains.domain_of_triangle is None:
                raise SceneError("these domains do not say which triangles lie in them")
            faces = self.scene.triangles.faces[self._triangles_of(domains, domain)]
            if len(faces) == 0:
                return None
            used, corners = np.unique(faces, return_inverse=True)
            vertices = self.scene.triangles.vertices[used]
            self._domains[key] = embree.Geometry(vertices, corners.reshape(-1, 3).astype(np.int32))
        return self._domains[key]


class _Backdrop:
    """What camera rays see behind a volume: triangles in plain light, or the sky."""

    def __init__(self, scene: Scene) -> None:
        self.surfaces = SurfaceWorld(scene, PathTracing()) if len(scene.instance_object) else None
        self.sky = scene.environment

    def hits(self, rays: Columns) -> embree.Hits | None:
        """Return where rays meet triangles, on all cores; None if there are none."""
        if self.surfaces is None:
            return None
        geometry = self.surfaces.geometry

        def work(rows: slice) -> embree.Hits:
            return geometry.nearest(rays["origin"][rows], rays["direction"][rows], rays["reach"][rows])

        parts = [work(slice(0, 0)), *embree.in_chunks(work, len(rays["reach"]))]
        return embree.Hits(*map(np.concatenate, zip(*(part.columns for part in parts), strict=True)))

    def in_front(self, rays: Columns) -> Columns:
        """Return rays that end at the triangles behind the medium, as far as all ranks know them."""
        hits = self.hits(rays)
        return rays if hits is None else rays | {"reach": np.minimum(rays["reach"], hits.t)}

    def colors(self, rays: Columns, hits: embree.Hits | None) -> NDArray[np.float32]:
        """Return what each ray sees where nothing is in front, float32 (n, 3)."""
        from simrender.rays.shading import headlight

        return headlight(rays["direction"], self.sky, hits, self.surfaces.surfaces if self.surfaces else None)


class MarchingWorld:
    """A structured volume, marched in equal steps in front of triangles and sky."""

    outcome: tuple[str, ...] = ("work",)

    def __init__(self, scene: Scene, integrator: VolumeMarching) -> None:
        if scene.volume is None:
            raise SceneError("the scene has no volume to march through")
        self.scene, self.volume, self.integrator = scene, scene.volume, integrator
        self.backdrop = _Backdrop(scene)

    def _march(self, rays: Columns, ray: Ids, cells: NDArray[np.int32]) -> Any:
        from simrender.rays.marching import march

        step = self.integrator.step * min(self.volume.spacing)
        shading, limit = self.integrator.shading, self.integrator.opacity_limit
        return march(self.volume, step, rays, ray, cells, shading=shading, opacity_limit=limit)

    def follow(self, rays: Columns, seed: int, done: Report | None = None) -> Columns:  # noqa: ARG002
        """See `World`."""

        def block(part: Columns) -> Columns:
            n = len(part["kind"])
            hits = self.backdrop.hits(part)
            reach = part["reach"] if hits is None else np.minimum(part["reach"], hits.t)
            marched = self._march(part | {"reach": reach}, np.arange(n), everything(self.volume, n))
            behind = self.backdrop.colors(part, hits)
            seen = marched.rgba[:, :3] + (1.0 - marched.rgba[:, 3:]) * behind
            ends = marched.done | (marched.rgba[:, 3] > 0.0)
            return {
                "t": np.where(ends, marched.entry, reach if hits is None else hits.t).astype(np.float32),
                "primitive": np.full(n, -1, np.int32) if hits is None else np.where(ends, -1, hits.primitive),
                "radiance": (part["throughput"] * seen).astype(np.float32),
                "work": marched.samples.astype(np.uint32),
            }

        outcome = in_blocks(block, rays, done)
        return outcome | childless(outcome["radiance"])

    def cross(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16], seed: int) -> Columns:  # noqa: ARG002
        """See `World`; a row is a fragment, which has ``rgba`` (float32 (n, 4), premultiplied), entry and exit."""
        marched = self._march(self.backdrop.in_front(rays), ray, bricks(domains, domain))
        return {
            "hit": np.where(marched.done, marched.exit, np.float32(np.inf)),
            "work": marched.samples.astype(np.uint32),
            "rgba": marched.rgba,
            "exit": marched.exit,
        }


class TrackingWorld:
    """A structured volume with isosurfaces and triangles in it, followed by Woodcock tracking."""

    outcome: tuple[str, ...] = ("work",)

    def __init__(self, scene: Scene, integrator: VolumePathTracing) -> None:
        if scene.volume is None:
            raise SceneError("the scene has no volume to track paths through")
        self.scene, self.volume, self.integrator = scene, scene.volume, integrator
        self.backdrop = _Backdrop(scene)

    def _track(self, rays: Columns, ray: Ids, cells: NDArray[np.int32], seed: int) -> Any:
        from simrender.rays.tracking import track
        from simrender.rays.volume_paths import tracking_keys

        return track(self.volume, rays, tracking_keys(rays, seed), ray, cells)

    def follow(self, rays: Columns, seed: int, done: Report | None = None) -> Columns:
        """See `World`."""
        from simrender.rays.volume_paths import scatter

        def block(part: Columns) -> Columns:
            n = len(part["kind"])
            hits = self.backdrop.hits(part)
            reach = part["reach"] if hits is None else np.minimum(part["reach"], hits.t)
            tracked = self._track(part | {"reach": reach}, np.arange(n), everything(self.volume, n), seed)
            surfaces = self.backdrop.surfaces.surfaces if self.backdrop.surfaces else None
            made = scatter(part, tracked, hits, surfaces, self.scene, self.integrator, seed)
            return made | {"work": tracked.samples.astype(np.uint32)}

        return in_blocks(block, rays, done)

    def cross(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16], seed: int) -> Columns:
        """See `World`."""
        tracked = self._track(rays, ray, bricks(domains, domain), seed)
        hit = tracked.t
        if self.backdrop.surfaces is not None and domains.domain_of_triangle is not None:
            hit = np.minimum(hit, self.backdrop.surfaces.cross(rays, ray, domains, domain, seed)["hit"])
        return {"hit": hit.astype(np.float32), "work": tracked.samples.astype(np.uint32)}


class ElementWorld:
    """An unstructured mesh in parts, marched element by element."""

    outcome: tuple[str, ...] = ("work", "samples")

    def __init__(self, scene: Scene, integrator: ElementMarching) -> None:
        if scene.elements is None:
            raise SceneError("the scene has no elements to march through")
        self.scene, self.elements, self.integrator = scene, scene.elements, integrator
        self.backdrop = _Backdrop(scene)
        self.parts = int(self.elements.part.max()) + 1

    def fragments(self, rays: Columns, ray: Ids, part: NDArray[Any]) -> Any:
        """Return the fragments of (ray, part) rows; see `element_marching.march_parts`."""
        from simrender.rays.element_marching import march_parts

        return march_parts(self.elements, rays, ray, part.astype(np.int32), step=self.integrator.step)

    def follow(self, rays: Columns, seed: int, done: Report | None = None) -> Columns:  # noqa: ARG002
        """See `World`."""
        from simrender.rays.boxes import enter_boxes
        from simrender.rays.compositing import composite

        low, high = self.elements.part_bounds

        def block(some: Columns) -> Columns:
            n = len(some["kind"])
            hits = self.backdrop.hits(some)
            if hits is not None:
                some = some | {"reach": np.minimum(some["reach"], hits.t)}
            entered = enter_boxes(some["origin"], some["direction"], some["reach"], low, high)
            ray = np.repeat(np.arange(n), np.diff(entered.first))
            found = self.fragments(some, ray, entered.domain)
            owner = ray[found.row]
            rgba = composite(found.rgba, found.entry, owner, entered.domain[found.row], n)
            t = np.full(n, np.inf, np.float32) if hits is None else hits.t.copy()
            np.minimum.at(t, owner, found.entry)
            ends = rgba[:, 3] > 0.0
            seen = rgba[:, :3] + (1.0 - rgba[:, 3:]) * self.backdrop.colors(some, hits)
            return {
                "t": t,
                "primitive": np.full(n, -1, np.int32) if hits is None else np.where(ends, -1, hits.primitive),
                "radiance": (some["throughput"] * seen).astype(np.float32),
                "work": np.bincount(ray, found.elements, minlength=n).astype(np.uint32),
                "samples": np.bincount(ray, found.samples, minlength=n).astype(np.uint32),
            }

        outcome = in_blocks(block, rays, done)
        return outcome | childless(outcome["radiance"])

    def cross(self, rays: Columns, ray: Ids, domains: Domains, domain: NDArray[np.int16], seed: int) -> Columns:  # noqa: ARG002
        """See `World`; domain d holds part d."""
        found = self.fragments(self.backdrop.in_front(rays), ray, domain)
        hit = np.full(len(ray), np.inf, np.float32)
        np.minimum.at(hit, found.row, found.entry)
        return {"hit": hit, "work": found.elements.astype(np.uint32), "samples": found.samples.astype(np.uint32)}


def everything(volume: Any, rows: int) -> NDArray[np.int32]:
    """Return the brick of all cells, once a row."""
    x, y, z = volume.cells
    return np.tile(np.array([0, x, 0, y, 0, z], np.int32), (rows, 1))


def bricks(domains: Domains, domain: NDArray[np.int16]) -> NDArray[np.int32]:
    """Return the cells of each row's domain."""
    if domains.cells is None:
        raise SceneError("these domains do not say which cells of a volume lie in them")
    return domains.cells[domain]


def by_domain(domain: NDArray[np.int16]) -> Iterator[tuple[int, Ids]]:
    """Yield each domain that occurs, ascending, with its rows."""
    if len(domain) == 0:
        return
    order = np.argsort(domain, kind="stable")
    sorted_ = domain[order]
    starts = np.flatnonzero(np.diff(sorted_, prepend=-1))
    yield from zip(sorted_[starts].tolist(), np.split(order, starts[1:]), strict=True)


def joined(parts: list[Columns]) -> Columns:
    """Join columns, each on a core of its own; the parts are emptied, so that little is held twice."""
    names = list(parts[0])
    columns = embree.on_all_cores(lambda name: np.concatenate([part.pop(name) for part in parts]), names)
    return dict(zip(names, columns, strict=True))


def in_blocks(block: Callable[[Columns], Columns], rays: Columns, done: Report | None) -> Columns:
    """Apply a function that uses all cores itself to consecutive blocks of rays, and join what it returns."""
    n = len(rays["kind"])
    parts = []
    for start in range(0, max(n, 1), _BLOCK):
        rows = slice(start, min(start + _BLOCK, n))
        part = block({name: column[rows] for name, column in rays.items()})
        if "parent" in part:
            part["parent"] = part["parent"] + np.int32(start)
        parts.append(part)
        if done:
            done(rows.stop)
    return joined(parts)


def childless(radiance: NDArray[np.float32]) -> Columns:
    """Return the radiance of rays that spawn none, with no children."""
    none = {"pixel": np.int32, "sample": np.uint16, "parent": np.int32, "reach": np.float32}
    spawned = {name: np.zeros(0, none.get(name, np.uint8)) for name in SPAWNED}
    spawned |= {name: np.zeros((0, 3), np.float32) for name in ("origin", "direction", "throughput")}
    return {"radiance": radiance, "children": np.zeros(len(radiance), np.uint16)} | spawned
