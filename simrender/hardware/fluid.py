"""The course of events of a fluid network: who shares which link, who is rated anew, and who arrives next.

The kernels of `simrender.hardware.network`. Flows that share a link, directly or through others, form a component; all
flows of a component are rated together (`simrender.hardware.maxmin`), and a heap holds for each component the tick at
which its next flow arrives. Results depend neither on the order of flows and links nor on which slot a flow happens to
be in.

Ticks in here are relative to an epoch that the network moves, so that they fit 64 bits; `FAR` stands for any later one.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from simrender.clock import TICK_NOISE, TICKS_PER_SECOND
from simrender.hardware.maxmin import fill
from simrender.hardware.tables import (
    CAPPED,
    CHANGED,
    FAR,
    HEAP_SIZE,
    LAST,
    LISTED,
    LOGGED,
    MOST_RESUMES,
    NO_ROUND,
    NONE,
    NOT_FROZEN,
    PULLED,
    QUEUED,
    RATED,
    RESUMED,
    ROUNDS,
    STAMP,
    TOUCHED,
    VACATED,
    WEIGHT_UNIT,
    WIDOWED,
    WORTH_RESUMING,
    Array,
    Tables,
    kernel,
)

_TICKS: Final = float(TICKS_PER_SECOND)


@kernel
def _duration(remaining: float, rate: float) -> int:
    """Return ticks, rounded up, or FAR; `simrender.clock.to_ticks` in machine code."""
    ticks = (remaining / rate) * _TICKS
    if ticks < 2.0**50:  # the usual case, without two calls of a library
        floor = int(ticks)
        return floor if ticks - floor <= TICK_NOISE * ticks else floor + 1
    if not ticks < FAR / 2:
        return FAR
    whole = np.rint(ticks)
    return int(whole if abs(ticks - whole) <= TICK_NOISE * max(ticks, whole) else np.ceil(ticks))


# -- the heap of components ----------------------------------------------------------------------------------------


@kernel
def _sift_up(t: Tables, i: int) -> None:
    tick, leader = t.heap[i].tick, t.heap[i].leader
    while i > 0:
        parent = (i - 1) // 2
        if t.heap[parent].tick <= tick:
            break
        _place(t, i, t.heap[parent].tick, t.heap[parent].leader)
        i = parent
    _place(t, i, tick, leader)


@kernel
def _sift_down(t: Tables, i: int, size: int) -> None:
    tick, leader = t.heap[i].tick, t.heap[i].leader
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size and t.heap[child + 1].tick < t.heap[child].tick:
            child += 1
        if t.heap[child].tick >= tick:
            break
        _place(t, i, t.heap[child].tick, t.heap[child].leader)
        i = child
    _place(t, i, tick, leader)


@kernel
def _place(t: Tables, i: int, tick: int, leader: int) -> None:
    t.heap[i].tick, t.heap[i].leader = tick, leader
    t.flows[leader].place = i


@kernel
def _push(t: Tables, tick: int, leader: int) -> None:
    i = t.counters[HEAP_SIZE]
    t.counters[HEAP_SIZE] += 1
    t.heap[i].tick, t.heap[i].leader = tick, leader
    _sift_up(t, i)


@kernel
def _pull(t: Tables, leader: int) -> None:
    """Take a component out of the heap, wherever it is."""
    place = int(np.int64(t.flows[leader].place))
    t.flows[leader].place = NONE
    t.counters[HEAP_SIZE] -= 1
    size = t.counters[HEAP_SIZE]
    if place < size:
        last = t.heap[size].leader
        _place(t, place, t.heap[size].tick, last)
        _sift_up(t, place)
        _sift_down(t, int(np.int64(t.flows[last].place)), size)


@kernel
def _first(t: Tables) -> int:
    return t.heap[0].tick if t.counters[HEAP_SIZE] else NONE


@kernel
def reheap(t: Tables) -> None:
    """Put the heap in order again after its ticks have changed."""
    for i in range(t.counters[HEAP_SIZE] - 1, -1, -1):
        _sift_down(t, i, t.counters[HEAP_SIZE])


# -- the list of the flows of each link ------------------------------------------------------------------------------


@kernel
def _join(t: Tables, f: int, now: int) -> None:
    t.counters[CAPPED] += t.story[f].cap < np.inf
    for h in range(t.flows[f].hops):
        link = t.hops[f, h]
        entry = f * t.hops.shape[1] + h
        first = t.links[link].first
        t.chain[entry].after, t.chain[entry].before = first, NONE
        if first != NONE:
            t.chain[first].before = entry
        t.links[link].first = entry
        if t.links[link].users == 0:
            t.links[link].busy_since = now
        t.links[link].users += 1
        t.links[link].weight += t.flows[f].weight


@kernel
def _leave(t: Tables, f: int, now: int) -> None:
    t.counters[CAPPED] -= t.story[f].cap < np.inf
    for h in range(t.flows[f].hops):
        link = t.hops[f, h]
        entry = f * t.hops.shape[1] + h
        if t.chain[entry].before == NONE:
            t.links[link].first = t.chain[entry].after
        else:
            t.chain[t.chain[entry].before].after = t.chain[entry].after
        if t.chain[entry].after != NONE:
            t.chain[t.chain[entry].after].before = t.chain[entry].before
        t.links[link].users -= 1
        t.links[link].weight -= t.flows[f].weight
        if t.links[link].users == 0:
            t.links[link].busy += now - t.links[link].busy_since
        if t.links[link].vacated == 0:
            t.links[link].vacated = 1
            t.roads[t.counters[VACATED]].vacated = link
            t.counters[VACATED] += 1


# -- arrivals --------------------------------------------------------------------------------------------------------


@kernel
def add_alone(t: Tables, slots: Array) -> int:
    """Queue flows that use no link: each is a component of its own, and its finish is known.

    Returns the first tick at which any flow arrives.
    """
    for f in slots:
        t.flows[f].leader, t.flows[f].next = f, NONE
        t.counters[CAPPED] += t.story[f].cap < np.inf
        _push(t, t.flows[f].finish, f)
    return _first(t)


@kernel
def release(t: Tables, now: int) -> tuple[int, int, bool]:
    """Take the flows that arrive now off their links.

    Returns how many, their slots being in ``arrived``; the first tick at which another arrives; and whether others have
    to be rated anew for it.
    """
    notes, count = t.notes, 0
    while t.counters[HEAP_SIZE] > 0 and t.heap[0].tick <= now:
        member = t.heap[0].leader
        _pull(t, member)
        begin = count
        if member != t.counters[LAST] or t.flows[member].hops == 0:
            while member != NONE:
                if t.flows[member].finish <= now:
                    notes[count].arrived = member
                    count += 1
                else:
                    _widow(t, member)
                member = t.flows[member].next
        else:
            t.counters[PULLED] = 1
            last = t.frozen[t.counters[LISTED] - 1]
            if last.ties == 1:
                notes[count].arrived = last.earliest
                count += 1
            else:
                for i in range(t.counters[LISTED]):
                    if t.frozen[i].flow != NONE and t.flows[t.frozen[i].flow].finish <= now:
                        notes[count].arrived = t.frozen[i].flow
                        count += 1
            for i in range(begin, count):  # strike them from what the last rating left
                position = t.flows[notes[i].arrived].position
                t.counters[CHANGED] = min(t.counters[CHANGED], t.frozen[position].round)
                t.frozen[position].flow = NONE
                t.fresh[notes[i].arrived] = 0.0
        for i in range(begin, count):
            f = notes[i].arrived
            _leave(t, f, now)
            nbytes = t.story[f].nbytes
            for h in range(t.flows[f].hops):
                link = t.hops[f, h]
                total = t.links[link].carried + nbytes  # and, by Knuth's two-sum, what this rounded away
                part = total - t.links[link].carried
                t.links[link].carried_low += (t.links[link].carried - (total - part)) + (nbytes - part)
                t.links[link].carried = total
    crowded = False
    for i in range(t.counters[VACATED]):
        crowded |= t.links[t.roads[i].vacated].users > 0
    if t.counters[PULLED] and not crowded:
        forget(t)  # either nobody is left, or the component had come apart
    unsettled = crowded or t.counters[WIDOWED] > 0
    if not unsettled:
        _empty_vacated(t, now)
    return count, _first(t), unsettled


@kernel
def _widow(t: Tables, f: int) -> None:
    """Note a flow that has to be rated anew, since its component is out of the heap."""
    t.flows[f].leader = NONE  # that one may be gone, and its slot another's
    t.notes[t.counters[WIDOWED]].widowed = f
    t.counters[WIDOWED] += 1


@kernel
def _widow_all(t: Tables, leader: int) -> None:
    member = leader
    while member != NONE:
        _widow(t, member)
        member = t.flows[member].next


@kernel
def forget(t: Tables) -> None:
    """Do not go on from the last rating, but start anew; what was pulled out of the heap has to be rated again."""
    if t.counters[PULLED]:
        for i in range(t.counters[LISTED]):
            if t.frozen[i].flow != NONE:
                _widow(t, t.frozen[i].flow)
    t.counters[PULLED], t.counters[LAST] = 0, NONE


@kernel
def upset(t: Tables, slots: Array) -> None:
    """Have the components of some flows rated anew at the end of this tick."""
    forget(t)
    for f in slots:
        leader = t.flows[f].leader
        if leader != NONE:
            _pull(t, leader)
            _widow_all(t, leader)


@kernel
def evict(t: Tables, slots: Array, now: int) -> None:
    """Take flows off their links before they have arrived; what they shared with others is rated anew."""
    upset(t, slots)
    for f in slots:
        _leave(t, f, now)
        t.flows[f].weight = 0
    for i in range(t.counters[WIDOWED]):
        if t.notes[i].widowed != NONE and t.flows[t.notes[i].widowed].weight == 0:
            t.notes[i].widowed = NONE


# -- rating ----------------------------------------------------------------------------------------------------------


@kernel
def settle(t: Tables, arrivals: Array, now: int) -> int:
    """Let flows join their links, and rate every component in which a flow has come or gone.

    Returns the first tick at which a flow arrives.
    """
    t.counters[STAMP] += 1
    for f in arrivals:
        t.flows[f].since = now
        t.flows[f].rate, t.flows[f].leader = 0.0, NONE
        _join(t, f, now)
    small = t.counters[LISTED] < WORTH_RESUMING or t.counters[RESUMED] == MOST_RESUMES
    if small or len(arrivals) or t.counters[WIDOWED]:
        forget(t)
    if t.counters[PULLED]:
        _rate_again(t, now)
    else:
        for f in arrivals:
            if t.flows[f].mark != t.counters[STAMP]:
                _rate(t, f, now)
        i = 0
        while i < t.counters[WIDOWED]:  # which may grow meanwhile
            f = t.notes[i].widowed
            i += 1
            if f != NONE and t.flows[f].mark != t.counters[STAMP]:
                _rate(t, f, now)
    t.counters[WIDOWED] = 0
    _empty_vacated(t, now)
    return _first(t)


@kernel
def _empty_vacated(t: Tables, now: int) -> None:
    for i in range(t.counters[VACATED]):
        t.links[t.roads[i].vacated].vacated = 0
        if t.links[t.roads[i].vacated].users == 0:
            _set_load(t, t.roads[i].vacated, 0.0, now)
    t.counters[VACATED] = 0


@kernel
def _rate(t: Tables, seed: int, now: int) -> None:
    """Find the component of a flow, give its flows their fair rates, and put it into the heap."""
    _component(t, seed)
    n_links = t.counters[TOUCHED]
    if t.counters[QUEUED] == 1:  # what `fill` would come to, to the bit
        weight = t.flows[seed].weight * WEIGHT_UNIT
        level = t.story[seed].cap / weight
        for i in range(n_links):
            level = min(level, t.links[t.roads[i].touched].capacity / weight)
        rate = min(weight * level, t.story[seed].cap)
        for i in range(n_links):
            link = t.roads[i].touched
            _set_load(t, link, _load(t.links[link].capacity, t.links[link].capacity - weight * level), now)
        t.flows[seed].leader, t.flows[seed].next, t.flows[seed].apart = seed, NONE, 0
        _change_rate(t, seed, rate, now)
        t.counters[LAST] = NONE
        t.counters[RATED] += 1
        _push(t, t.flows[seed].finish, seed)
        return
    for i in range(n_links):
        link = t.roads[i].touched
        t.links[link].weighed = t.links[link].left = t.links[link].weight
        t.links[link].residual, t.links[link].floor = t.links[link].capacity, 0.0
    t.counters[LISTED], t.counters[ROUNDS], t.counters[RESUMED] = 0, 0, 0
    fill(t)
    _finish_rating(t, now)


@kernel
def _rate_again(t: Tables, now: int) -> None:
    """Rate the component that was rated last, which some flows have left since then and none has joined.

    The rounds of filling before the first in which one of those was frozen would come out the same to the last bit, so
    filling goes on from there: flows slower than all that left are not touched.
    """
    changed = t.counters[CHANGED]
    first, undone = t.frozen[changed].before, t.frozen[changed].undo
    last_undo = t.frozen[t.counters[ROUNDS]].undo
    for i in range(last_undo - 1, undone - 1, -1):
        row = t.undo[i]
        t.links[row.link].left += row.taken
        t.links[row.link].residual, t.links[row.link].floor = row.residual, row.floor
    for i in range(t.counters[TOUCHED]):
        link = t.roads[i].touched
        t.links[link].left -= t.links[link].weighed - t.links[link].weight
        t.links[link].weighed = t.links[link].weight
    t.counters[QUEUED] = 0
    for i in range(first, t.counters[LISTED]):
        f = t.frozen[i].flow
        if f != NONE:
            t.fresh[f] = NOT_FROZEN
            t.notes[t.counters[QUEUED]].queue = f
            t.counters[QUEUED] += 1
    t.counters[LISTED], t.counters[ROUNDS] = first, changed
    t.counters[RESUMED] += 1
    fill(t)
    _finish_rating(t, now)


@kernel
def _finish_rating(t: Tables, now: int) -> None:
    """Apply the new rates of those flows of a component that were in the queue, and put it into the heap."""
    first = t.counters[LISTED] - t.counters[QUEUED]
    for i in range(t.counters[TOUCHED]):
        link = t.roads[i].touched
        _set_load(t, link, _load(t.links[link].capacity, t.links[link].residual), now)
    frozen, listed = t.frozen, t.counters[LISTED]
    t.counters[LAST], t.counters[PULLED], t.counters[CHANGED] = NONE, 0, NO_ROUND
    if listed == 0:
        return
    leader = frozen[0].flow
    if first:
        last = frozen[first - 1]
        t.flows[last.flow].next = frozen[first].flow if first < listed else NONE
        tick, flow, ties = last.tick, last.earliest, last.ties
    else:
        tick, flow, ties = FAR, NONE, 0
    for i in range(first, listed):
        f = frozen[i].flow
        _change_rate(t, f, t.fresh[f], now)
        if t.flows[f].finish < tick:
            tick, flow, ties = t.flows[f].finish, f, 1
        elif t.flows[f].finish == tick:
            ties += 1
        frozen[i].tick, frozen[i].earliest, frozen[i].ties = tick, flow, ties
        t.flows[f].leader, t.flows[f].position = leader, i
        t.flows[f].next = frozen[i + 1].flow if i + 1 < listed else NONE
    t.counters[RATED] += listed - first
    t.counters[LAST] = leader
    t.flows[leader].apart = t.counters[RESUMED]
    _push(t, tick, leader)


@kernel
def _change_rate(t: Tables, f: int, rate: float, now: int) -> None:
    """Give a flow its new rate and tick; one whose rate stays the same keeps its tick to the last."""
    if rate != t.flows[f].rate:
        sent = t.flows[f].rate * ((now - t.flows[f].since) / _TICKS)
        t.flows[f].remaining = max(0.0, t.flows[f].remaining - sent)
        t.flows[f].since, t.flows[f].rate = now, rate
        ticks = _duration(t.flows[f].remaining, t.flows[f].rate)
        t.flows[f].finish = now + ticks if ticks < FAR - now else FAR


@kernel
def _component(t: Tables, seed: int) -> None:
    """Queue the flows that share a link with this one, or with one that does, and so on; and list their links.

    Each link's flows are written down one after the other in the roster, from the link's ``begin`` to its ``end``. What
    of them stood in the heap is taken out.
    """
    roster = t.roster
    stamp, width = t.counters[STAMP], t.hops.shape[1]
    t.flows[seed].mark, t.fresh[seed] = stamp, NOT_FROZEN
    t.notes[0].queue = seed
    n_flows, n_links, n_entries, i = 1, 0, 0, 0
    while i < n_flows:
        f = t.notes[i].queue
        i += 1
        leader = t.flows[f].leader
        if leader != NONE and t.flows[leader].place != NONE:
            _pull(t, leader)
            if t.flows[leader].apart:  # some of its flows may not be found from here
                _widow_all(t, leader)
        for h in range(t.flows[f].hops):
            link = t.hops[f, h]
            if t.links[link].mark != stamp:
                t.links[link].mark, t.links[link].begin = stamp, n_entries
                t.roads[n_links].touched = link
                n_links += 1
                entry = t.links[link].first
                while entry != NONE:
                    other = entry // width
                    roster[n_entries] = other
                    n_entries += 1
                    if t.flows[other].mark != stamp:
                        t.flows[other].mark, t.fresh[other] = stamp, NOT_FROZEN
                        t.notes[n_flows].queue = other
                        n_flows += 1
                    entry = t.chain[entry].after
                t.links[link].end = n_entries
    t.counters[QUEUED], t.counters[TOUCHED] = n_flows, n_links


@kernel
def _load(capacity: float, residual: float) -> float:
    return capacity if residual < 1e-12 * capacity else capacity - residual


@kernel
def _set_load(t: Tables, link: int, load: float, now: int) -> None:
    t.links[link].peak = max(t.links[link].peak, load / t.links[link].capacity)
    if len(t.log) and load != t.links[link].load:
        t.log[t.counters[LOGGED]].tick = now
        t.log[t.counters[LOGGED]].link = link
        t.log[t.counters[LOGGED]].load = load
        t.counters[LOGGED] += 1
    t.links[link].load = load
