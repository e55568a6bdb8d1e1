"""The one door to embreex.

embreex offers single rays against one level of triangle geometry, in float32, starting at distance 0; it overwrites
the distances it is given and releases the GIL. Everything here follows from that: scenes are written out without
instances, secondary origins are offset before they come here, and batches are cut into chunks that run on all cores.
Scenes are always built robust: without it, rays through shared edges leak between the triangles.

Robust as they are, they still lose rays that lie in the plane of a box. Embree takes a direction's component of 0 for
one of +1e-18, and to such a ray all boxes that *end* in its plane are closed, the triangles in that plane with them.
So what a ray along a face between two domains hits would hang on where the hierarchy has its boxes. `Geometry.nearest`
asks for such rays with both signs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
A = TypeVar("A")
B = TypeVar("B")

CHUNK = 1 << 14
"""Rays a thread takes at once: small enough to stay in its cache, large enough to hide Python."""

_FEW = 1 << 11
"""Rays that are not worth a second core."""

_NOTHING = np.float32(1e-17)
"""A component of a direction that is too small to change a hit, and just large enough for Embree to see its sign."""


@dataclass(frozen=True, eq=False)
class Hits:
    """The nearest hit of each ray.

    Attributes
    ----------
    t : float32 array (n,)
        Distance along the ray; infinite for a miss.
    primitive : int32 array (n,)
        Row of the triangle in the geometry that was traced; -1 for a miss.
    u, v : float32 array (n,)
        Barycentric coordinates of the hit; meaningless for a miss.

    """

    t: F32
    primitive: I32
    u: F32
    v: F32

    @property
    def columns(self) -> tuple[F32, I32, F32, F32]:
        """All of it, in order."""
        return self.t, self.primitive, self.u, self.v


class Geometry:
    """Triangles in a bounding volume hierarchy that Embree built.

    Parameters
    ----------
    vertices : float32 array (v, 3)
    faces : int32 array (t, 3), t > 0

    """

    def __init__(self, vertices: F32, faces: I32) -> None:
        from embreex.mesh_construction import TriangleMesh
        from embreex.rtcore_scene import EmbreeScene

        self._scene = EmbreeScene(_device(), robust=True)
        TriangleMesh(self._scene, vertices, faces)
        # The hierarchy is built by the first query, which must not happen in two threads at once.
        self._scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), query="OCCLUDED")

    def nearest(self, origins: F32, directions: F32, reach: F32) -> Hits:
        """Return the nearest hit of each ray within its reach; runs on the calling thread.

        Parameters
        ----------
        origins, directions : float32 array (n, 3)
        reach : float32 array (n,)
            How far each ray goes; not changed.

        """
        found = self._query(origins, directions, reach)
        if not directions.all():
            self._ask_again(found, origins, directions, reach)
        return found

    def _ask_again(self, found: Hits, origins: F32, directions: F32, reach: F32) -> None:
        """Let rays within axis planes meet what they meet with the other sign of 0, where that is nearer."""
        rows = np.unique(np.nonzero(directions == 0.0)[0])
        flat = directions[rows] == 0.0
        for signs in list(product((False, True), repeat=3))[1:]:
            bent = rows[(flat | ~np.array(signs)).all(axis=1)]
            if len(bent) == 0:
                continue
            direction = np.where(signs, -_NOTHING, directions[bent])
            other = self._query(origins[bent], direction, reach[bent])
            t, primitive = found.t[bent], found.primitive[bent]
            nearer = (other.t < t) | ((other.t == t) & (other.primitive < primitive))
            for mine, its in zip(found.columns, other.columns, strict=True):
                mine[bent[nearer]] = its[nearer]

    def _query(self, origins: F32, directions: F32, reach: F32) -> Hits:
        found = self.raw(origins, directions, reach)
        t, primitive = found["tfar"], found["primID"]
        t[primitive < 0] = np.inf
        return Hits(t, primitive, found["u"], found["v"])

    def raw(self, origins: F32, directions: F32, reach: F32) -> dict[str, Any]:
        """Return what embreex itself returns: the yardstick for `nearest` and all that is built on it."""
        found: dict[str, Any] = self._scene.run(origins, directions, dists=reach.copy(), query="INTERSECT", output=True)
        return found


def in_chunks(work: Callable[[slice], B], n: int, done: Callable[[int], None] | None = None) -> list[B]:
    """Apply a function to consecutive chunks of ``range(n)`` on all cores; the results come in order.

    ``done`` is told, on the calling thread, how many of the n have been worked on.
    """
    results = []
    for rows, result in zip(chunks(n), _pool().map(work, chunks(n)), strict=True):
        results.append(result)
        if done:
            done(rows.stop)
    return results


def on_all_cores(work: Callable[[A], B], items: Iterable[A]) -> list[B]:
    """Apply a function to each item on all cores; the results come in order."""
    return list(_pool().map(work, items))


def chunks(n: int) -> list[slice]:
    """Cut ``range(n)`` into slices of about the same size, `CHUNK` at most, as many for each core."""
    count = -(-n // CHUNK)
    if n > _FEW:
        count = -(-count // _cores()) * _cores()
    size = -(-n // max(1, count))
    return [slice(start, min(start + size, n)) for start in range(0, n, max(1, size))]


@cache
def _device() -> Any:
    """Return the device of all scenes: with one each, Embree crashes at a thousand."""
    from embreex.rtcore import EmbreeDevice

    return EmbreeDevice()


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(_cores(), thread_name_prefix="embree")


@cache
def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
