"""Max-min fair sharing: the rates of flows that share links.

Rates come from minima and from sums of whole numbers, never from sums of rounded ones, so they depend neither on the
order of flows nor on that of links, not even in their last bit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from simrender.hardware.tables import (
    CAPPED,
    LISTED,
    NONE,
    NOT_FROZEN,
    QUEUED,
    ROUNDS,
    TOUCHED,
    WEIGHT_UNIT,
    Array,
    Tables,
    kernel,
)


@kernel
def fill(t: Tables) -> None:
    """Share links so that no flow could be faster without slowing one that, for its weight, is no faster than itself.

    Weighted progressive filling (Bertsekas and Gallager, *Data Networks*, 2nd ed., section 6.5.2): the level, a rate
    for each unit of weight, rises for all flows together until links are full or flows have reached their caps; those
    flows are frozen and the others go on. Links that fill at one level fill in one round, and a round takes its frozen
    flows from a link all at once.

    Freezes the flows of the queue, the others having been frozen in earlier rounds, and writes down the
    order and, for each round, what the links were before it.
    """
    n_touched, roster, frozen, fresh, undo = t.counters[TOUCHED], t.roster, t.frozen, t.fresh, t.undo
    by_cap, cap_levels = _sorted_caps(t, t.counters[QUEUED] if t.counters[CAPPED] else 0)
    shares = np.empty(n_touched, np.float64)  # of the links that are not full yet: the level at which they would be
    open_links, shrunk, full = np.empty((3, n_touched), np.int32)
    n_open, next_cap = 0, 0
    for i in range(n_touched):
        link = t.roads[i].touched
        t.links[link].place = NONE
        if t.links[link].left:
            t.links[link].place = n_open
            open_links[n_open] = link
            shares[n_open] = max(t.links[link].floor, t.links[link].residual / (t.links[link].left * WEIGHT_UNIT))
            n_open += 1
    listed, this_round = t.counters[LISTED], t.counters[ROUNDS]
    n_undo = frozen[this_round].undo if this_round else 0
    goal = listed + t.counters[QUEUED]
    while listed < goal:
        frozen[this_round].before, frozen[this_round].undo = listed, n_undo
        level, n_full = np.inf, 0
        for i in range(n_open):
            if shares[i] <= level:
                n_full = n_full if shares[i] == level else 0
                level = shares[i]
                full[n_full] = i
                n_full += 1
        while next_cap < len(by_cap) and fresh[by_cap[next_cap]] != NOT_FROZEN:
            next_cap += 1
        if next_cap < len(by_cap) and cap_levels[next_cap] < level:
            level, n_full = cap_levels[next_cap], 0
        begin = listed
        for j in range(n_full - 1, -1, -1):  # from the back, so that the places of the others stay true
            i = full[j]
            link = open_links[i]
            for k in range(t.links[link].begin, t.links[link].end):
                if fresh[roster[k]] == NOT_FROZEN:
                    fresh[roster[k]] = 0.0
                    frozen[listed].flow = roster[k]
                    listed += 1
            n_open -= 1
            t.links[link].place = NONE
            open_links[i], shares[i] = open_links[n_open], shares[n_open]
            if i < n_open:
                t.links[open_links[i]].place = i
        while next_cap < len(by_cap) and cap_levels[next_cap] <= level:
            if fresh[by_cap[next_cap]] == NOT_FROZEN:
                fresh[by_cap[next_cap]] = 0.0
                frozen[listed].flow = by_cap[next_cap]
                listed += 1
            next_cap += 1
        n_shrunk = 0
        for i in range(begin, listed):
            f = frozen[i].flow
            frozen[i].round = this_round
            fresh[f] = (t.flows[f].weight * WEIGHT_UNIT) * level
            if len(by_cap):
                fresh[f] = min(fresh[f], t.story[f].cap)
            for h in range(t.flows[f].hops):
                link = t.hops[f, h]
                if t.links[link].taken == 0:
                    shrunk[n_shrunk] = link
                    n_shrunk += 1
                t.links[link].taken += t.flows[f].weight
        for i in range(n_shrunk):
            link = shrunk[i]
            undo[n_undo].link, undo[n_undo].taken = link, t.links[link].taken
            undo[n_undo].residual, undo[n_undo].floor = t.links[link].residual, t.links[link].floor
            n_undo += 1
            t.links[link].left -= t.links[link].taken
            t.links[link].residual -= (t.links[link].taken * WEIGHT_UNIT) * level
            t.links[link].taken, t.links[link].floor = 0, level
            place = t.links[link].place
            if place != NONE:  # rounding must not let the level fall
                left = t.links[link].left * WEIGHT_UNIT
                shares[place] = max(level, t.links[link].residual / left) if left else np.inf
        this_round += 1
    frozen[this_round].before, frozen[this_round].undo = listed, n_undo
    t.counters[LISTED], t.counters[ROUNDS] = listed, this_round


@kernel
def _sorted_caps(t: Tables, members: int) -> tuple[Array, Array]:
    """Return the flows of the queue that have caps, in the order in which the level reaches them, and those levels."""
    count = 0
    for i in range(members):
        count += t.story[t.notes[i].queue].cap < np.inf
    capped, levels = np.empty(count, np.int32), np.empty(count, np.float64)
    found = 0
    for i in range(members if count else 0):
        f = t.notes[i].queue
        if t.story[f].cap < np.inf:
            capped[found], levels[found] = f, t.story[f].cap / (t.flows[f].weight * WEIGHT_UNIT)
            found += 1
    gap = count // 2  # Shell's sort, which compiles in a tenth of the time that NumPy's takes
    while gap:
        for i in range(gap, count):
            flow, level, j = capped[i], levels[i], i
            while j >= gap and levels[j - gap] > level:
                capped[j], levels[j] = capped[j - gap], levels[j - gap]
                j -= gap
            capped[j], levels[j] = flow, level
        gap //= 2
    return capped, levels


def max_min_rates(
    capacities: Sequence[float],
    flow_links: Sequence[Sequence[int]],
    weights: Sequence[float] | None = None,
    caps: Sequence[float] | None = None,
) -> list[float]:
    """Share links between flows so that no flow could be faster without slowing one that is no faster than itself.

    Weighted progressive filling (Bertsekas and Gallager, *Data Networks*, 2nd ed., section 6.5.2); `Network` uses the
    same kernel. The rates do not depend on the order of flows or links, not even in their last bit.

    Parameters
    ----------
    capacities : sequence of float
        Bandwidth of each link in B/s, above zero. Links that no flow uses cost nothing.
    flow_links : sequence of sequences of int
        For each flow the indices of the links on its route, none of them twice.
    weights : sequence of float, optional
        Where two flows share a full link, their rates are as their weights, to a multiple of 2^-32; 1 by default.
    caps : sequence of float, optional
        The highest rate that each flow can use, in B/s.

    Returns
    -------
    list of float
        The rate of each flow in B/s; for a flow that uses no link its cap, infinite by default.

    Examples
    --------
    Three flows, two links in a row: one flow takes both, each of the others takes one. The first link is the tighter
    one and gives each of its flows 2; that leaves 8 on the second for the flow that uses it alone.

    >>> max_min_rates([4.0, 10.0], [(0, 1), (0,), (1,)])
    [2.0, 2.0, 8.0]

    """
    n = len(flow_links)
    t = Tables.room(n, len(capacities), max(1, max(map(len, flow_links), default=1)))
    for f, used in enumerate(flow_links):
        t.hops[f, : len(used)] = used
    t.flows["hops"] = [len(used) for used in flow_links]
    t.flows["weight"] = np.rint(np.asarray(1.0 if weights is None else weights) / WEIGHT_UNIT)
    t.story["cap"] = math.inf if caps is None else caps
    t.fresh[:] = NOT_FROZEN
    pairs = np.array([(link, f) for f, used in enumerate(flow_links) for link in used], np.int32).reshape(-1, 2)
    t.roster[: len(pairs)] = pairs[np.argsort(pairs[:, 0], kind="stable"), 1]
    t.links["end"] = np.cumsum(np.bincount(pairs[:, 0], minlength=len(t.links)))
    t.links["begin"][1:] = t.links["end"][:-1]
    np.add.at(t.links["left"], pairs[:, 0], t.flows["weight"][pairs[:, 1]])
    t.links["residual"] = capacities
    t.roads["touched"] = np.arange(len(t.links))
    t.counters[TOUCHED], t.counters[CAPPED] = len(t.links), np.isfinite(t.story["cap"]).sum()
    members = np.flatnonzero(t.flows["hops"])
    t.notes["queue"][: len(members)] = members
    t.counters[QUEUED] = len(members)
    fill(t)
    rates: list[float] = np.where(t.flows["hops"] > 0, t.fresh, t.story["cap"]).tolist()
    return rates
