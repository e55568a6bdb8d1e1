"""Which domains a ray visits, in which order, when it goes front to back and stops at the first surface.

That is what a scheduler without speculation makes of a ray, whatever it loads or sends: the visits of a ray depend on
the trace and the domains alone, never on caches, ranks or the order of work.

* A camera ray visits the domains whose boxes it enters, front to back, until its nearest hit lies before the next one.
* A ray that is spawned visits the domain of its birth first, where the data is at hand, and then the others front to
  back (Park, Fussell and Navratil, "SpRay", 2018, listing 1 and figure 2).
* A shadow ray ends in the first domain that has something in its way.
* Where boxes overlap, a ray may have to look further after it has met its nearest hit; then it returns to that domain
  to be shaded, a last visit that tests nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.rays.crossings import Crossings
from simrender.rays.kinds import SHADOW

Ids = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Visits:
    """The visits of all rays of a trace, by ray id.

    Attributes
    ----------
    first : int64 array (rays + 1,)
        Ray i makes the visits ``first[i]:first[i + 1]``.
    domain : int16 array (visits,)
    returns : bool array (rays,)
        Whether a ray's last visit only shades what an earlier one hit.
    shaded_in : int16 array (rays,)
        The domain that each ray's nearest hit lies in; -1 for none.

    """

    first: Ids
    domain: NDArray[np.int16]
    returns: NDArray[np.bool_]
    shaded_in: NDArray[np.int16]

    @property
    def tests(self) -> int:
        """Queries of a ray in a domain."""
        return len(self.domain) - int(self.returns.sum())

    @cached_property
    def last(self) -> Ids:
        """The position behind each ray's last visit, int64 (rays,)."""
        return self.first[1:]


def visits(crossings: Crossings) -> Visits:
    """Return the visits of a complete trace.

    Raises
    ------
    InvariantError
        If a ray's nearest hit lies in a domain that it does not enter, or in none.

    """
    trace, domains = crossings.trace, crossings.domains
    owner = domains.domain_of_triangle
    if owner is None:
        raise InvariantError("rays visit domains of triangles, and these domains have none")
    primitive = trace.column("primitive")
    near = np.where(primitive >= 0, owner[primitive], -1).astype(np.int16)
    firsts, parts, returns = [np.zeros(1, np.int64)], [], []
    apart = _disjoint(domains.low, domains.high)
    for generation in range(trace.generations):
        rays = slice(trace.first[generation], trace.first[generation + 1])
        table = crossings.table(generation)
        birth = np.full(rays.stop - rays.start, -1, np.int16)
        if generation > 0:
            parent = trace.geometry(generation)["parent"]
            birth = near[trace.first[generation - 1] : trace.first[generation]][parent]
        shadow = trace.column("kind")[rays] == SHADOW
        t, mine = trace.column("t")[rays], near[rays]
        if not apart:
            _ask_before(crossings, generation, np.flatnonzero(shadow & (mine >= 0)), mine, birth)
        arguments = (table["first"], table["domain"], table["entry"], table["hit"], t, mine, birth, shadow)
        count = np.zeros(len(t) + 1, np.int64)
        back = np.zeros(len(t), np.bool_)
        lost = _visit(*arguments, count, np.zeros(0, np.int16), back)
        if lost >= 0:
            raise InvariantError(
                f"ray {rays.start + lost} hits something in domain {mine[lost]}, which it never enters"
            )
        np.cumsum(count, out=count)
        domain = np.empty(count[-1], np.int16)
        _visit(*arguments, count, domain, back)
        firsts.append(count[1:] + firsts[-1][-1])
        parts.append(domain)
        returns.append(back)
    return Visits(np.concatenate(firsts), np.concatenate(parts), np.concatenate(returns), near)


def _ask_before(
    crossings: Crossings, generation: int, occluded: Ids, nearest: NDArray[np.int16], birth: NDArray[np.int16]
) -> None:
    """Let occluded shadow rays find the first domain that has something in their way, where boxes overlap."""
    table = crossings.table(generation)
    rows = _rows_before(table["first"], table["domain"], occluded, nearest, birth)
    crossings.hits(generation, rows)


def _disjoint(low: NDArray[np.float32], high: NDArray[np.float32]) -> bool:
    """Tell whether no two boxes have an inside in common."""
    full = (low < high).all(axis=1)
    low, high = low[full], high[full]
    order = np.argsort(low[:, 0], kind="stable")
    low, high = low[order], high[order]
    return bool(_none_overlap(low, high))


@njit(cache=True, nogil=True, error_model="numpy")
def _none_overlap(low, high):  # type: ignore[no-untyped-def]
    """Return whether boxes, ascending along x, are disjoint but for their faces."""
    for i in range(len(low)):
        for j in range(i + 1, len(low)):
            if low[j, 0] >= high[i, 0]:
                break
            if low[j, 1] < high[i, 1] and low[i, 1] < high[j, 1] and low[j, 2] < high[i, 2] and low[i, 2] < high[j, 2]:
                return False
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _rows_before(first, domain, rays, nearest, birth):  # type: ignore[no-untyped-def]
    """Return the rows of rays that come before that of their nearest hit, and those of the domains of their birth."""
    found = np.empty(0, np.int64)
    for fill in (False, True):
        count = 0
        for ray in rays:
            before = True
            for row in range(first[ray], first[ray + 1]):
                before = before and domain[row] != nearest[ray]
                if before or domain[row] == birth[ray]:
                    if fill:
                        found[count] = row
                    count += 1
        if not fill:
            found = np.empty(count, np.int64)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _visit(first, domain, entry, hit, t, nearest, birth, shadow, count, out, returns):  # type: ignore[no-untyped-def]
    """Count each ray's visits into ``count[1:]``, or fill them in; return a ray that never meets its hit, or -1."""
    fill = len(out) > 0
    for i in range(len(t)):
        at = count[i] if fill else 0
        begin = at
        met = nearest[i] < 0
        stopped = False
        last = -1
        if birth[i] >= 0:
            if fill:
                out[at] = birth[i]
            at += 1
            last = birth[i]
            met = met or birth[i] == nearest[i]
            stopped = birth[i] == nearest[i] and shadow[i]
            if shadow[i] and nearest[i] >= 0:
                for row in range(first[i], first[i + 1]):
                    if domain[row] == birth[i] and hit[row] < np.inf:
                        met = stopped = True
        for row in range(first[i], first[i + 1]):
            if stopped or domain[row] == birth[i]:
                continue
            # The next domain begins behind the nearest hit: the ray is done.
            if met and nearest[i] >= 0 and entry[row] >= t[i]:
                break
            if fill:
                out[at] = domain[row]
            at += 1
            last = domain[row]
            met = met or domain[row] == nearest[i]
            if shadow[i] and nearest[i] >= 0 and (domain[row] == nearest[i] or hit[row] < np.inf):
                stopped = True
                met = True
        if not met:
            return i
        returns[i] = not shadow[i] and nearest[i] >= 0 and last != nearest[i]
        if returns[i]:
            if fill:
                out[at] = nearest[i]
            at += 1
        if not fill:
            count[i + 1] = at - begin
    return -1
