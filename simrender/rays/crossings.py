"""The crossing table: which shadow rays enter which domains, and what they hit there.

Rows are (ray, domain) pairs, grouped by ray and front to back within a ray. A row's hit is unknown (NaN) until somebody
asks; then Embree traces the ray against that domain alone and the answer is kept, in memory and on disk. A scheduler
asks only as finely as it can tell apart: ray queue cycling traces every ray on every rank, so of a shadow ray that
something occludes it must know the first domain *on the ray's way around the ring* that does, and no other hit at all.

========== ===== =========================================================
column     dtype meaning
========== ===== =========================================================
ray        i8    id of each ray in the table, ascending
first      i8    first row of each ray, then the number of rows
domain     i2    of each row
entry      f4    distance at which the ray enters the domain's box
hit        f4    nearest hit in the domain; NaN unknown, infinite for none
========== ===== =========================================================
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.rays import embree
from simrender.rays.kinds import SHADOW
from simrender.rays.partition import Partition
from simrender.rays.trace import Trace

Columns = dict[str, Any]


class Crossings:
    """The crossings of a trace's occluded shadow rays with the domains of a partition.

    Parameters
    ----------
    trace : Trace
    partition : Partition

    Attributes
    ----------
    traced_rays : int
        (ray, domain) pairs that Embree was asked for in this process.

    """

    def __init__(self, trace: Trace, partition: Partition) -> None:
        self.trace, self.partition = trace, partition
        self.traced_rays = 0
        self._tables: dict[int, Columns] = {}
        self._changed: set[int] = set()
        self._geometries: dict[int, embree.Geometry] = {}

    def domains_visited(self, generation: int, start: NDArray[np.int64]) -> NDArray[np.int16]:
        """Return how many domains each ray of a generation is traced in as it goes around the ring.

        A ray visits domain ``start``, then ``start + 1`` and so on, modulo the number of domains. A shadow ray is done
        in the first domain that has something in its way; every other ray visits all domains.

        Parameters
        ----------
        generation : int
        start : int64 array (pixels,)
            The domain that the rays of each pixel visit first.

        """
        trace, count = self.trace, self.partition.domains
        rays = slice(trace.first[generation], trace.first[generation + 1])
        visits = np.full(rays.stop - rays.start, count, np.int16)
        if count == 1:
            return visits
        table = self._table(generation)
        if len(table["ray"]) == 0:
            return visits
        begin = start[trace.column("pixel")[table["ray"]]]
        while True:
            rows, position = _next_rows(table["first"], table["domain"], table["hit"], begin, count)
            if rows.min() < 0:
                lost = int(table["ray"][rows.argmin()])
                raise InvariantError(
                    f"shadow ray {lost} is occluded in the whole scene but in none of its {count} domains"
                )
            unknown = rows[np.isnan(table["hit"][rows])]
            if len(unknown) == 0:
                break
            self._ask(generation, table, unknown)
        visits[table["ray"] - rays.start] = position + 1
        return visits

    def save(self) -> None:
        """Store what became known since the tables were loaded."""
        for generation in sorted(self._changed):
            self.trace.store.save(self._name(generation), self._tables[generation])
        self._changed.clear()

    def _name(self, generation: int) -> str:
        return f"{generation:03d}-crossings-{self.partition.key}"

    def _table(self, generation: int) -> Columns:
        if generation not in self._tables:
            found = self.trace.store.load(self._name(generation), ("ray", "first", "domain", "entry", "hit"))
            if found is not None and (
                len(found["first"]) != len(found["ray"]) + 1
                or {len(found[c]) for c in ("domain", "entry", "hit")} != {int(found["first"][-1])}
            ):
                found = None
            if found is None:
                found = self._enter(generation)
                self._changed.add(generation)
            self._tables[generation] = found
        return self._tables[generation]

    def _enter(self, generation: int) -> Columns:
        """Find the domains whose boxes the generation's occluded shadow rays enter."""
        trace = self.trace
        begin, end = trace.first[generation], trace.first[generation + 1]
        kind, t = trace.column("kind")[begin:end], trace.column("t")[begin:end]
        local = np.flatnonzero((kind == SHADOW) & np.isfinite(t))
        rays = trace.geometry(generation)
        low, high = self.boxes
        first, domain, entry = _enter_boxes(
            rays["origin"][local], rays["direction"][local], rays["reach"][local], low, high
        )
        hit = np.full(len(domain), np.nan, np.float32)
        # The whole scene's nearest hit is known, and so is the domain it lies in: one row a ray comes for free.
        primitive = trace.column("primitive")[begin:end][local]
        nearest = self.partition.domain_of_mesh[trace.scene.triangles.mesh[primitive]]
        ray_of_row = np.repeat(np.arange(len(local)), np.diff(first))
        same = domain == nearest[ray_of_row]
        hit[same] = t[local][ray_of_row[same]]
        return {"ray": local + begin, "first": first, "domain": domain, "entry": entry, "hit": hit}

    def _ask(self, generation: int, table: Columns, rows: NDArray[np.int64]) -> None:
        """Let Embree trace the given rows, domain by domain."""
        rays = self.trace.geometry(generation)
        ray_of_row = np.searchsorted(table["first"], rows, side="right") - 1
        local = table["ray"][ray_of_row] - self.trace.first[generation]
        domain = table["domain"][rows]
        jobs = []
        for d in np.unique(domain):
            chosen = np.flatnonzero(domain == d)
            jobs += [(self.domain_geometry(int(d)), chosen[part]) for part in embree.chunks(len(chosen))]

        def work(job: tuple[embree.Geometry, NDArray[np.int64]]) -> NDArray[np.float32]:
            geometry, chosen = job
            r = local[chosen]
            return geometry.nearest(rays["origin"][r], rays["direction"][r], rays["reach"][r]).t

        for (_, chosen), t in zip(jobs, embree.on_all_cores(work, jobs), strict=True):
            table["hit"][rows[chosen]] = t
        self.traced_rays += len(rows)
        self._changed.add(generation)

    def domain_geometry(self, domain: int) -> embree.Geometry:
        """Return a domain's triangles in their own hierarchy, built when first asked for."""
        if domain not in self._geometries:
            triangles = self.trace.scene.triangles
            mine = self.partition.domain_of_mesh[triangles.mesh] == domain
            used, faces = np.unique(triangles.faces[mine], return_inverse=True)
            geometry = embree.Geometry(triangles.vertices[used], faces.reshape(-1, 3).astype(np.int32))
            self._geometries[domain] = geometry
        return self._geometries[domain]

    @cached_property
    def boxes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Lowest and highest corner of each domain, float32 (domains, 3); an empty domain's box is inside out."""
        triangles = self.trace.scene.triangles
        domain = self.partition.domain_of_mesh[triangles.mesh]
        low = np.full((self.partition.domains, 3), np.inf, np.float32)
        high = np.full((self.partition.domains, 3), -np.inf, np.float32)
        for d in range(self.partition.domains):
            corners = triangles.vertices[triangles.faces[domain == d].ravel()]
            if len(corners):
                low[d], high[d] = corners.min(axis=0), corners.max(axis=0)
        return low, high


@njit(cache=True, nogil=True, error_model="numpy")
def _enters(ox, oy, oz, dx, dy, dz, reach, low, high):  # type: ignore[no-untyped-def]
    """Return where a ray enters a box, or -1 if it does not; generous by a few float32 roundings.

    A ray in the plane of a face counts as inside. The slack keeps a box from missing what Embree, in float32, hits.
    """
    near, far = 0.0, float(reach)
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        slack = 1e-6 * max(abs(float(low[axis])), abs(float(high[axis])), abs(o))
        lo, hi = float(low[axis]) - slack, float(high[axis]) + slack
        if lo > hi:
            return -1.0
        if d == 0.0:
            if o < lo or o > hi:
                return -1.0
            continue
        t0, t1 = (lo - o) / d, (hi - o) / d
        near, far = max(near, min(t0, t1)), min(far, max(t0, t1))
    return near if near <= far * (1.0 + 1e-6) else -1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _enter_boxes(origin, direction, reach, low, high):  # type: ignore[no-untyped-def]
    """Return the crossings of rays with boxes: (first row of each ray, box, entry), front to back within a ray."""
    n, boxes = len(reach), len(low)
    first = np.zeros(n + 1, np.int64)
    entries = np.zeros(boxes, np.float64)
    for fill in (False, True):
        if fill:
            domain, entry = np.zeros(first[n], np.int16), np.zeros(first[n], np.float32)
        else:
            domain, entry = np.zeros(0, np.int16), np.zeros(0, np.float32)
        row = 0
        for i in range(n):
            ox, oy, oz = float(origin[i, 0]), float(origin[i, 1]), float(origin[i, 2])
            dx, dy, dz = float(direction[i, 0]), float(direction[i, 1]), float(direction[i, 2])
            begin = row
            for b in range(boxes):
                at = _enters(ox, oy, oz, dx, dy, dz, reach[i], low[b], high[b])
                if at < 0.0:
                    continue
                if fill:
                    j = row
                    while j > begin and entries[j - begin - 1] > at:
                        entries[j - begin], domain[j] = entries[j - begin - 1], domain[j - 1]
                        j -= 1
                    entries[j - begin], domain[j] = at, b
                row += 1
            if fill:
                for j in range(begin, row):
                    entry[j] = entries[j - begin]
            else:
                first[i + 1] = row
    return first, domain, entry


@njit(cache=True, nogil=True, error_model="numpy")
def _next_rows(first, domain, hit, begin, domains):  # type: ignore[no-untyped-def]
    """Return, for each ray, the first row around the ring that is not known to miss, and its position (0 = start)."""
    n = len(first) - 1
    rows, position = np.zeros(n, np.int64), np.zeros(n, np.int64)
    for i in range(n):
        best, best_row = domains, -1
        for row in range(first[i], first[i + 1]):
            step = (domain[row] - begin[i]) % domains
            if step < best and not np.isinf(hit[row]):
                best, best_row = step, row
        rows[i], position[i] = best_row, best
    return rows, position
