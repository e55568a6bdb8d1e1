"""The crossing table: which rays enter which domains, and what they meet there.

Rows are (ray, domain) pairs, grouped by ray and front to back within a ray: by entry, then by where the ray leaves,
then by number. A row's hit is unknown (NaN) until somebody asks; then the ray is taken through that domain alone and
the answer is kept, in memory and on disk. A scheduler asks only as finely as it can tell apart. Ray queue cycling
traces every ray on every rank, so of a shadow ray that something occludes it must know the first domain *on the ray's
way around the ring* that does, and no other hit at all: for it there is a table of the occluded shadow rays alone.

========== ===== ===================================================================
column     dtype meaning
========== ===== ===================================================================
first      i8    first row of each ray, then the number of rows
domain     i2    of each row
entry      f4    distance at which the ray enters the domain's box, 0 if it starts inside
hit        f4    nearest hit in the domain; NaN unknown, infinite for none
work       u2    through volumes: samples, look-ups or elements, at most 65,535; 0 where unknown
ray        i8    id of each ray, ascending; only in the table of occluded shadow rays
========== ===== ===================================================================
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.rays import embree
from simrender.rays.boxes import enter_boxes, walk_grid
from simrender.rays.domains import Domains
from simrender.rays.kinds import SHADOW
from simrender.rays.trace import Ids, Trace

Columns = dict[str, Any]

_BLOCK = 1 << 22
"""Rows that are looked up at once: what is made on the way weighs several times what a row does."""


class Crossings:
    """The crossings of a trace's rays with domains.

    Parameters
    ----------
    trace : Trace
    domains : Domains
        Of the scene that the trace traces, which may be scaled (`Trace.scene`).

    Attributes
    ----------
    asked_rows : int
        Rows whose outcome was really computed in this process.

    """

    def __init__(self, trace: Trace, domains: Domains) -> None:
        self.trace, self.domains = trace, domains
        self.asked_rows = 0
        self._tables: dict[str, Columns] = {}
        self._changed: set[str] = set()
        self.tree: Any = None  # of rays, once somebody asks for it: `speculative.ray_tree`

    # -- every ray ------------------------------------------------------------------------------------------------

    def table(self, generation: int) -> Columns:
        """Return the crossings of all rays of a generation; ray i of it has the rows ``first[i]:first[i + 1]``."""
        return self._table(generation, "all")

    def hits(self, generation: int, rows: Ids) -> NDArray[np.float32]:
        """Return the hits of some rows of `table`, float32 (n,), and compute those that are unknown."""
        table = self.table(generation)
        for begin in range(0, len(rows), _BLOCK):
            block = rows[begin : begin + _BLOCK]
            unknown = np.sort(block[np.isnan(table["hit"][block])])
            unknown = unknown[np.diff(unknown, prepend=-1) > 0]  # ten times as fast as np.unique, which hashes
            if len(unknown):
                self._ask(generation, "all", table, unknown)
        found: NDArray[np.float32] = table["hit"][rows]
        return found

    # -- occluded shadow rays -------------------------------------------------------------------------------------

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
        trace, count = self.trace, self.domains.count
        rays = slice(trace.first[generation], trace.first[generation + 1])
        visits = np.full(rays.stop - rays.start, count, np.int16)
        if count == 1:
            return visits
        table = self._table(generation, "occluded")
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
            self._ask(generation, "occluded", table, unknown)
        visits[table["ray"] - rays.start] = position + 1
        return visits

    # -- how they come about --------------------------------------------------------------------------------------

    def save(self) -> None:
        """Store what became known since the tables were loaded."""
        for name in sorted(self._changed):
            self.trace.store.save(name, self._tables[name])
        self._changed.clear()

    def _table(self, generation: int, which: str) -> Columns:
        name = f"{generation:03d}-{which}-{self.domains.key}"
        if name not in self._tables:
            columns = ("first", "domain", "entry", "hit", *self._work, *(("ray",) if which == "occluded" else ()))
            found = self.trace.store.load(name, columns)
            if found is None or not self._consistent(generation, found):
                found = self._enter(generation, which)
                self._changed.add(name)
            self._tables[name] = found
        return self._tables[name]

    @property
    def _work(self) -> tuple[str, ...]:
        return tuple(name for name in self.trace.world.outcome if name == "work")

    def _consistent(self, generation: int, table: Columns) -> bool:
        rays = self.trace.first[generation + 1] - self.trace.first[generation]
        rows = {len(table[name]) for name in ("domain", "entry", "hit", *self._work)}
        return len(table["first"]) == len(table.get("ray", range(rays))) + 1 and rows == {int(table["first"][-1])}

    def _enter(self, generation: int, which: str) -> Columns:
        """Find the domains that rays enter; their hits are unknown, but for what the whole scene's hits tell."""
        trace, domains = self.trace, self.domains
        begin, end = trace.first[generation], trace.first[generation + 1]
        t, primitive = trace.column("t")[begin:end], trace.column("primitive")[begin:end]
        rays = trace.geometry(generation)
        geometry = rays["origin"], rays["direction"], rays["reach"]
        local = None
        if which == "occluded":
            local = np.flatnonzero((trace.column("kind")[begin:end] == SHADOW) & np.isfinite(t))
            geometry = tuple(column[local] for column in geometry)
            t, primitive = t[local], primitive[local]
        first, domain, entry = enter_domains(domains, *geometry)
        nearest = None
        if domains.domain_of_triangle is not None:
            nearest = np.where(primitive >= 0, domains.domain_of_triangle[primitive], -1).astype(np.int16)
            first, domain, entry = _with_nearest(first, domain, entry, nearest, t)
        hit = np.full(len(domain), np.nan, np.float32)
        table = {"first": first, "domain": domain, "entry": entry, "hit": hit}
        if self._work:
            table["work"] = np.zeros(len(hit), np.uint16)
        elif nearest is not None:
            embree.in_chunks(
                lambda some: _fill_known(first[some.start : some.stop + 1], domain, nearest[some], t[some], hit), len(t)
            )
        return table if local is None else table | {"ray": local + begin}

    def _ask(self, generation: int, which: str, table: Columns, rows: Ids) -> None:
        """Compute the outcome of the given rows."""
        ray = np.searchsorted(table["first"], rows, side="right") - 1
        if which == "occluded":
            ray = table["ray"][ray] - self.trace.first[generation]
        rays = self.trace.geometry(generation)
        found = self.trace.world.cross(rays, ray, self.domains, table["domain"][rows], self.trace.seed)
        for name in ("hit", *self._work):
            table[name][rows] = found[name] if name == "hit" else np.minimum(found[name], np.iinfo(np.uint16).max)
        self.asked_rows += len(rows)
        self._changed.add(f"{generation:03d}-{which}-{self.domains.key}")


def enter_domains(
    domains: Domains, origin: NDArray[np.float32], direction: NDArray[np.float32], reach: NDArray[np.float32]
) -> tuple[Ids, NDArray[np.int16], NDArray[np.float32]]:
    """Return the rows of some rays: ``first``, ``domain`` and ``entry`` as in the crossing table."""
    # Boxes as they are: a hit that float32 lets lie outside its box is the nearest one, or does not matter.
    if domains.planes is not None:
        entered = walk_grid(origin, direction, reach, domains.planes, growth=0.0)
    else:
        entered = enter_boxes(origin, direction, reach, domains.low, domains.high, growth=0.0)
    _leave_first(entered.first, entered.domain, entered.entry, origin, direction, domains.low, domains.high)
    return entered.first, entered.domain, entered.entry


@njit(cache=True, nogil=True, error_model="numpy")
def _leave_first(first, domain, entry, origin, direction, low, high):  # type: ignore[no-untyped-def]
    """Put domains that a ray enters at the same distance in the order in which it leaves them.

    A ray that passes an edge between boxes touches some of them in a point: these come before the one it goes on in.
    """
    for i in range(len(first) - 1):
        row = first[i]
        while row + 1 < first[i + 1]:
            end = row + 1
            while end < first[i + 1] and entry[end] == entry[row]:
                end += 1
            for j in range(row + 1, end):
                d = domain[j]
                leaves = _exit(origin, direction, i, low, high, d)
                k = j
                while k > row and _exit(origin, direction, i, low, high, domain[k - 1]) > leaves:
                    domain[k] = domain[k - 1]
                    k -= 1
                domain[k] = d
            row = end


@njit(cache=True, nogil=True, error_model="numpy")
def _exit(origin, direction, i, low, high, d):  # type: ignore[no-untyped-def]
    far = np.inf
    for axis in range(3):
        step = np.float64(direction[i, axis])
        if step != 0.0:
            plane = np.float64(high[d, axis]) if step > 0.0 else np.float64(low[d, axis])
            far = min(far, (plane - np.float64(origin[i, axis])) / step)
    return far


def _with_nearest(
    first: Ids,
    domain: NDArray[np.int16],
    entry: NDArray[np.float32],
    nearest: NDArray[np.int16],
    t: NDArray[np.float32],
) -> tuple[Ids, NDArray[np.int16], NDArray[np.float32]]:
    """Add the row of each ray's nearest hit where the ray passes by its domain's box by a rounding."""
    missing = np.empty(len(t), np.bool_)
    embree.in_chunks(
        lambda some: _without_nearest(first[some.start : some.stop + 1], domain, nearest[some], missing[some]), len(t)
    )
    rays = np.flatnonzero(missing)
    if len(rays) == 0:
        return first, domain, entry
    at = np.empty(len(rays), np.int64)
    for k, ray in enumerate(rays.tolist()):  # a handful in a million
        rows = slice(first[ray], first[ray + 1])
        at[k] = rows.start + np.searchsorted(entry[rows], t[ray], side="right")
    return (
        first + np.concatenate([[0], np.cumsum(missing)]),
        np.insert(domain, at, nearest[rays]),
        np.insert(entry, at, t[rays]),
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _without_nearest(first, domain, nearest, missing):  # type: ignore[no-untyped-def]
    """Find the rays that hit something in a domain of which they have no row."""
    for i in range(len(nearest)):
        missing[i] = nearest[i] >= 0
        for row in range(first[i], first[i + 1]):
            if domain[row] == nearest[i]:
                missing[i] = False


@njit(cache=True, nogil=True, error_model="numpy")
def _fill_known(first, domain, nearest, t, hit):  # type: ignore[no-untyped-def]
    """Enter each ray's nearest hit, and a miss in all domains for a ray that hits nothing."""
    for i in range(len(nearest)):
        for row in range(first[i], first[i + 1]):
            if nearest[i] < 0:
                hit[row] = np.inf
            elif domain[row] == nearest[i]:
                hit[row] = t[i]


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
