"""The ray table: every ray of a frame, traced once and replayed for every what-if.

Rays live in columns, a generation (bounce) after the other. Generation 0 holds the camera rays, sample by sample and
row by row; the children of generation g, in the order of their parents, are generation g + 1. A ray's id is its row
through all generations, so it depends on the scene, the camera and the seed alone, never on a scheduler. A generation
comes into being when somebody first asks for its rays, and is then kept in memory and on disk.

============ ======== =============================================================================
column       dtype    meaning
============ ======== =============================================================================
origin       3 x f4
direction    3 x f4   unit vector
reach        f4       how far the ray goes: to the light for a shadow ray, else infinite
throughput   3 x f4   for a shadow ray, the light it brings unless something is in the way
pixel        i4       row-major from the top left
sample       u2       which path of the pixel
kind         u1       camera, diffuse, mirror, shadow or scatter: see `kinds.KINDS`
diffuse      u1       diffuse bounces and scatterings so far; with ``mirror`` it gives the depth
mirror       u1       mirror-like bounces so far
parent       i4       row within the previous generation
t            f4       distance of the nearest hit over the whole scene; infinite for a miss
primitive    i4       global id of the triangle hit; -1 for none
radiance     3 x f4   what the ray adds to its pixel when it is retired
children     u2       how many rays it spawns
============ ======== =============================================================================

Rays through volumes also have their ``work``, u4: samples, look-ups or elements, see `worlds`.
"""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneWarning
from simrender.rays import embree
from simrender.rays.integrators import Integrator, in_units, most_children
from simrender.rays.kinds import CAMERA, KINDS
from simrender.rays.memory import check_memory
from simrender.rays.precision import out_of_range
from simrender.rays.scene import Scene
from simrender.rays.store import NoStore, Store, code_version

if TYPE_CHECKING:
    from simrender.rays.worlds import World

Ids = NDArray[np.int64]
Columns = dict[str, Any]

GEOMETRY = ("origin", "direction", "reach", "throughput", "pixel", "sample", "kind", "diffuse", "mirror", "parent")
OUTCOME = ("t", "primitive", "radiance", "children", "kind", "pixel")
"""What a replay needs, stored apart from the geometry so that it reads no more than this."""

_TRIANGLE_BYTES, _RAY_BYTES = 130.0, 140.0
"""What tracing takes for each triangle (world space, Embree's hierarchy) and for each ray (the table, and one copy)."""

_HANDY = (1.0, 1e6)
"""Sizes of a scene that are traced as they are."""

Progress = Callable[[int, int, int], None]
"""Called with (generation, rays traced, rays in it) while a generation is traced, from 0 rays on."""


class Trace:
    """All rays of one frame of one scene.

    Parameters
    ----------
    scene : Scene
        Very small and very large ones are traced in other units of length; `Trace.scene` is what is traced.
    camera : float64 array (4, 3)
        Position, forward, right, up, as `shading.camera_rays` takes it.
    size : (width, height)
        Traced pixels.
    samples : int
        Paths a pixel.
    integrator : Integrator
        How light is followed.
    seed : int
        Of all random numbers.
    cache : Path or None
        Folder of the trace cache; None takes the default one.
    progress : callable, optional
        Told how far tracing has come.
    jitter : bool
        Whether camera rays go through random points of their pixels, or all through the same corner.
    like : Trace, optional
        A trace of the same scene with the same integrator, whose hierarchies this one uses too.

    Attributes
    ----------
    factor : float
        Units of the scene that was given, in those that are traced.
    traced_rays : int
        Rays that were really traced in this process; 0 when everything came from the cache.

    """

    factor: float
    scene: Scene

    def __init__(
        self,
        scene: Scene,
        camera: NDArray[np.float64],
        size: tuple[int, int],
        samples: int,
        integrator: Integrator,
        seed: int = 1,
        cache: Path | None = None,
        progress: Progress | None = None,
        *,
        jitter: bool = True,
        like: Trace | None = None,
    ) -> None:
        self._like = like
        if like is None and (message := out_of_range(scene, camera[0])):
            warnings.warn(message, SceneWarning, stacklevel=2)
        factor: float = _handy(scene) if like is None else like.factor
        traced: Scene = (scene if factor == 1.0 else scene.scaled(factor)) if like is None else like.scene
        self.factor, self.scene = factor, traced
        self.camera = camera * np.array([[factor], [1.0], [1.0], [1.0]])
        self.size, self.samples = size, samples
        self.integrator, self.seed, self.progress, self.jitter = integrator, seed, progress, jitter
        self.pixels = size[0] * size[1]
        rays = f"{self.camera.tobytes().hex()} {size} {samples} {integrator} {seed} {jitter}"
        facts = f"{code_version()} {self.scene.key} {rays}"
        self.key = hashlib.blake2b(facts.encode(), digest_size=16).hexdigest()
        self.store = Store(self.key, cache)
        self.traced_rays = 0
        self.first: list[int] = [0]  # first id of each generation, then the number of rays known so far
        self._outcomes: list[Columns] = []
        self._geometry: dict[int, Columns] = {}
        self._joined: dict[str, Any] = {}

    # -- what schedulers ask --------------------------------------------------------------------------------------

    def kinds(self, rays: Ids) -> NDArray[np.int64]:
        """Return how many of the rays are of each kind, int64 (4,)."""
        if len(rays) == 0:
            return np.zeros(len(KINDS), np.int64)
        self._know(int(rays.max()))
        return np.bincount(self.column("kind")[rays], minlength=len(KINDS))

    def camera_rays(self, sample: int, pixels: Ids) -> Ids:
        """Return the ids of one sample's camera rays of the given pixels."""
        return pixels + sample * self.pixels

    def children(self, rays: Ids) -> Ids:
        """Return the ids of the rays that the given rays spawn; their order means nothing."""
        if len(rays) == 0:
            return rays
        self._know(int(rays.max()))
        spawned, first = self.column("children")[rays], self.column("first_child")[rays]
        found = [first[spawned > k] + k for k in range(int(spawned.max()))]
        return np.concatenate(found) if found else np.zeros(0, np.int64)

    def column(self, name: str) -> Any:
        """Return an outcome column over all generations known so far, one row a ray."""
        if name not in self._joined:
            parts = [g[name] for g in self._outcomes]
            self._joined[name] = whole = parts[0] if len(parts) == 1 else np.concatenate(parts)
            for g, outcome in enumerate(self._outcomes):  # views of it, so that nothing is held twice
                outcome[name] = whole[self.first[g] : self.first[g + 1]]
                if name in self._geometry.get(g, {}):
                    self._geometry[g][name] = outcome[name]
        return self._joined[name]

    @property
    def rays(self) -> int:
        """Number of rays known so far; of all rays, after `complete`."""
        return self.first[-1]

    @property
    def generations(self) -> int:
        """Number of generations known so far."""
        return len(self._outcomes)

    def complete(self) -> None:
        """Trace every generation until no ray spawns another."""
        while self._advance():
            pass

    def image(self, retired: Ids | None = None) -> NDArray[np.float32]:
        """Return the image that the retired rays make, float32 (height, width, 3): mean radiance of the samples.

        Contributions are summed in double precision in the order of ray ids, whatever the order of retirement.

        Parameters
        ----------
        retired : int64 array, optional
            Sorted ids; by default all rays.

        """
        pixel, radiance = self.column("pixel"), self.column("radiance")
        if retired is not None:
            pixel, radiance = pixel[retired], radiance[retired]
        lit = np.flatnonzero(radiance.any(axis=1))
        sums = [np.bincount(pixel[lit], radiance[lit, c], minlength=self.pixels) for c in range(3)]
        image = np.stack(sums, axis=1) / self.samples
        return image.reshape(self.size[1], self.size[0], 3).astype(np.float32)

    @cached_property
    def reference(self) -> NDArray[np.float32]:
        """What a renderer with one domain makes: it follows the rays of each sample from the camera to their ends.

        This is the truth that every policy must reproduce bit for bit.
        """
        followed = []
        for sample in range(self.samples):
            rays = self.camera_rays(sample, np.arange(self.pixels))
            while len(rays):
                followed.append(rays)
                rays = self.children(rays)
        return self.image(np.sort(np.concatenate(followed)))

    def geometry(self, generation: int) -> Columns:
        """Return the geometry columns of one generation."""
        self._know(self.first[generation])
        if generation == 0 and 0 not in self._geometry:
            self._geometry[0] = self._first_rays()  # made as fast as read, so they are not stored
        if generation not in self._geometry:
            rays = self.first[generation + 1] - self.first[generation]
            found = self.store.load(f"{generation:03d}-rays", GEOMETRY, rays)
            if found is None:
                # Damaged since it was written: the same rays come out when they are traced again.
                again = Trace(
                    self.scene, self.camera, self.size, self.samples, self.integrator, self.seed, jitter=self.jitter
                )
                again.store = NoStore()
                again._know(self.first[generation])
                found = again._geometry[generation]
                self.store.save(f"{generation:03d}-rays", found)
            self._geometry[generation] = found
        return self._geometry[generation]

    # -- how it comes about ---------------------------------------------------------------------------------------

    @cached_property
    def world(self) -> World:
        """The scene, ready for the integrator."""
        from simrender.rays.worlds import world

        return world(self.scene, in_units(self.integrator, self.factor)) if self._like is None else self._like.world

    def _know(self, ray: int) -> None:
        while self.first[-1] <= ray:
            if not self._advance():
                raise IndexError(f"ray {ray} does not exist: the trace has {self.rays} rays")

    def _advance(self) -> bool:
        """Make the next generation known; False if the last one spawned nothing."""
        generation = self.generations
        if generation and not self._outcomes[-1]["children"].any():
            return False
        outcome = self._load(generation) or self._trace(generation)
        count = len(outcome["children"])
        spawned = outcome["children"].astype(np.int64)
        outcome["first_child"] = self.first[-1] + count + np.cumsum(spawned) - spawned
        self._outcomes.append(outcome)
        self.first.append(self.first[-1] + count)
        self._joined.clear()
        return True

    @property
    def _outcome(self) -> tuple[str, ...]:
        return (*OUTCOME, *self.world.outcome)

    def _load(self, generation: int) -> Columns | None:
        expected = int(self._outcomes[-1]["children"].sum()) if generation else self.pixels * self.samples
        return self.store.load(f"{generation:03d}-hits", self._outcome, expected)

    def _trace(self, generation: int) -> Columns:
        expected = self.pixels * self.samples if generation == 0 else int(self._outcomes[-1]["children"].sum())
        self._check_memory(expected)
        rays = self._first_rays() if generation == 0 else self._spawned_rays(generation)
        count = len(rays["kind"])
        report = partial(self._report, generation, count)
        report(0)
        made = self.world.follow(rays, self.seed, report)
        self.traced_rays += count
        own = {"kind": rays["kind"], "pixel": rays["pixel"]}
        outcome = {name: own[name] if name in own else made[name] for name in self._outcome}
        spawned = {name: made[name] for name in GEOMETRY}
        self._geometry[generation], self._geometry[generation + 1] = rays, spawned
        files = ((f"{generation + 1:03d}-rays", spawned), (f"{generation:03d}-hits", outcome))
        embree.on_all_cores(lambda file: self.store.save(*file), files)
        return outcome

    def _check_memory(self, rays: int) -> None:
        """Refuse what cannot fit, before it is begun: hierarchies, and a generation with as many children as may be."""
        triangles, most = self.scene.instanced_triangles, most_children(self.integrator, self.scene)
        check_memory(
            triangles * _TRIANGLE_BYTES + (1.0 + most) * rays * _RAY_BYTES,
            f"tracing {rays:,} rays, each of which may spawn {most}, among {triangles:,} triangles",
            "; a smaller workload.traced.resolution or fewer workload.traced.samples need less",
        )

    def _report(self, generation: int, count: int, done: int) -> None:
        if self.progress:
            self.progress(generation, done, count)

    def _first_rays(self) -> Columns:
        from simrender.rays import shading

        n = self.pixels * self.samples
        origin, direction = np.empty((n, 3), np.float32), np.empty((n, 3), np.float32)

        def cast(sample: int) -> None:
            rows = slice(sample * self.pixels, (sample + 1) * self.pixels)
            origin[rows], direction[rows] = shading.camera_rays(
                self.camera, self.size, self.seed, sample, jitter=self.jitter
            )

        embree.on_all_cores(cast, range(self.samples))
        return {
            "origin": origin,
            "direction": direction,
            "reach": np.full(n, np.inf, np.float32),
            "throughput": np.ones((n, 3), np.float32),
            "pixel": np.tile(np.arange(self.pixels, dtype=np.int32), self.samples),
            "sample": np.repeat(np.arange(self.samples, dtype=np.uint16), self.pixels),
            "kind": np.full(n, CAMERA, np.uint8),
            "diffuse": np.zeros(n, np.uint8),
            "mirror": np.zeros(n, np.uint8),
            "parent": np.full(n, -1, np.int32),
        }

    def _spawned_rays(self, generation: int) -> Columns:
        if generation not in self._geometry:
            expected = int(self._outcomes[-1]["children"].sum())
            found = self.store.load(f"{generation:03d}-rays", GEOMETRY, expected)
            if found is None:
                self._trace(generation - 1)
                found = self._geometry[generation]
            self._geometry[generation] = found
        return self._geometry[generation]


def _handy(scene: Scene) -> float:
    """Return the power of two that brings a very small or very large scene to a size of about a hundred.

    Near the world's origin secondary rays start a fixed small distance off their surface (Waechter and Binder), which
    must be small against the scene. A power of two changes no digit of a coordinate.
    """
    low, high = scene.bounds
    size = float(np.linalg.norm(high.astype(np.float64) - low))
    return 1.0 if size == 0.0 or _HANDY[0] <= size <= _HANDY[1] else 2.0 ** round(math.log2(128.0 / size))
