"""The network: messages as fluid flows that share links max-min fairly.

A message pays the latency of its route once and then flows at a rate that changes only when another flow starts or
ends somewhere it matters. This is the fluid model that SimGrid validated against packet-level simulation (Velho,
Schnorr, Casanova and Legrand, "On the validity of flow-level TCP network models for grid and cloud simulations", ACM
TOMACS 23(4), 2013), without its corrections for TCP.
"""

from __future__ import annotations

import itertools
import math
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import simpy
from numpy.typing import ArrayLike, NDArray
from simpy.events import NORMAL, EventPriority

from simrender.clock import to_seconds, to_ticks
from simrender.errors import LinkFailedError, ScheduleError, UsageError
from simrender.hardware import fluid
from simrender.hardware.checks import check_transfer, column, whole
from simrender.hardware.horizon import HORIZON, far_ticks, rebase
from simrender.hardware.routing import FewestHops, Link, Route, Routes, RouteTable, near
from simrender.hardware.tables import FAR, FLOW, LOGGED, NONE, RATED, STORY, WEIGHT_UNIT, Tables
from simrender.hardware.usage import LinkUse, by_link, changes, link_use

if TYPE_CHECKING:
    import networkx

__all__ = ["Link", "LinkUse", "Listener", "Network"]

Listener = Callable[[NDArray[np.int64], int], None]

_FIRST = EventPriority(NORMAL - 1)
_LAST = EventPriority(NORMAL + 1)  # after everything that SimPy itself schedules at the same tick
_FEW = 8  # messages sent together, at which it is as fast to send them one by one
WEIGHTS = (1.0 / 1024.0, 1024.0)
"""The least and the greatest weight of a transfer."""


class _Alarm(simpy.Event):
    """A SimPy timeout with a priority."""

    def __init__(
        self, env: simpy.Environment, tick: int, priority: EventPriority, ring: Callable[[simpy.Event], None]
    ) -> None:
        self.env = env
        self.callbacks = [ring]
        self._ok = True
        self._value = None
        env.schedule(self, priority, tick - env.now)


class Network:
    """Links, the routes over them, and the flows that are under way.

    The network re-rates only the flows that share a link with one that starts or ends, or with such a flow in turn;
    all that starts and ends at one tick is rated together. A link is directed only in so far as its routes are.

    Parameters
    ----------
    env : simpy.Environment
        Its time is an integer number of ticks (`simrender.clock`).
    links : mapping of name to Link
        Every link that a route may name.
    routes : mapping of (source, target) to a sequence of link names, or a function of source and target
        The way of a message; empty for a copy that stays where it is. A function is asked when a pair is first used,
        and returns None where there is no way.
    nodes : iterable, optional
        What the function connects, for messages; a mapping names its nodes itself.
    record : bool
        Whether to log the load of every link (`loads`).

    Attributes
    ----------
    sent_bytes, sent_link_bytes : float
        Bytes of all transfers asked for so far, and what all links together will have carried for them.
    flows_finished : int
        Transfers that have arrived.

    Raises
    ------
    UsageError
        If a route names an unknown link, or one link twice.

    """

    def __init__(
        self,
        env: simpy.Environment,
        links: Mapping[Hashable, Link],
        routes: Routes,
        *,
        nodes: Iterable[Hashable] = (),
        record: bool = False,
    ) -> None:
        self.sent_bytes = self.sent_link_bytes = 0.0
        self.flows_finished = 0
        self._env = env
        self._table = RouteTable(links, routes, nodes)
        self._disturbed: dict[int, list[float]] = {}
        self._down: dict[int, Hashable] = {}

        rows = 1024 + 2 * len(self._table.links) if record else 0
        self._t = Tables.room(0, len(self._table.links), 4, rows)
        self._t.links["capacity"] = [link.bandwidth for link in self._table.links.values()]
        self._epochs: list[tuple[int, int]] = []  # rows of the log before which an epoch ended
        self._owners: list[Any] = []
        self._pairs: list[tuple[Any, Any]] = []
        self._keys = np.zeros(0, np.int64)
        self._free: list[int] = []

        self._started = 0
        self._epoch = 0
        self._arrivals: dict[int, list[int]] = {}
        self._armed: float = math.inf

    @classmethod
    def from_graph(cls, env: simpy.Environment, digraph: networkx.DiGraph[Any]) -> Network:
        """Return the network of a directed graph, where a message takes a route of the fewest hops.

        Of several such routes it takes the one with the least latency, and of those the first by the `repr` of the
        nodes along it; a node reaches itself without any link. Routes are found when first asked for; later changes
        of the graph have no effect.

        Parameters
        ----------
        env : simpy.Environment
            Its time is an integer number of ticks.
        digraph : networkx.DiGraph
            Each edge ``(u, v)`` becomes a link of that name, with the edge's `bandwidth` (B/s) and `latency` (s, 0 if
            absent).

        Raises
        ------
        UsageError
            If the graph is undirected, has parallel edges, or an edge lacks its bandwidth.
        ScheduleError
            If a bandwidth or latency is out of range.

        """
        if not digraph.is_directed() or digraph.is_multigraph():
            raise UsageError(f"a network needs a networkx.DiGraph, got a {type(digraph).__name__}")
        links: dict[Hashable, Link] = {}
        for u, v, data in digraph.edges(data=True):
            if "bandwidth" not in data:
                raise UsageError(f"the edge {u!r} -> {v!r} has no bandwidth")
            try:
                links[u, v] = Link(data["bandwidth"], data.get("latency", 0.0))
            except ScheduleError as error:
                raise ScheduleError(f"the edge {u!r} -> {v!r}: {error}") from None
        nodes = list(digraph)
        find = FewestHops(nodes, {edge: to_ticks(link.latency) for edge, link in links.items()}).route
        return cls(env, links, find, nodes=nodes)

    # -- what it has done -----------------------------------------------------------------------------------------

    @property
    def reratings(self) -> int:
        """How many times the rate of a flow was computed: what the network costs to simulate."""
        return int(self._t.counters[RATED])

    @property
    def carried_bytes(self) -> dict[Hashable, float]:
        """Bytes that each link has carried, of the transfers that have arrived."""
        carried = self._t.links["carried"] + self._t.links["carried_low"]
        return dict(zip(self._table.links, carried.tolist(), strict=True))

    @property
    def use(self) -> dict[Hashable, LinkUse]:
        """Bytes, busy time, mean and peak utilization of each link, over all time so far."""
        return link_use(self._t, self._table.links, self.carried_bytes, self._epoch, int(self._env.now))

    @property
    def loads(self) -> list[tuple[int, Hashable, float]]:
        """Every change of a link's load: the tick, the link's name, and the sum of the rates through it in B/s."""
        names = list(self._table.links)
        ticks, links, loads = (column.tolist() for column in changes(self._t, self._epochs))
        return [(tick, names[link], load) for tick, link, load in zip(ticks, links, loads, strict=True)]

    @property
    def loads_by_link(self) -> dict[Hashable, tuple[NDArray[np.int64], NDArray[np.float64]]]:
        """The same for each link that ever had a load, as arrays: ticks, and B/s from then on."""
        return by_link(changes(self._t, self._epochs), list(self._table.links))

    def latency_ticks(self, source: Hashable, target: Hashable) -> int:
        """Return the latency of the route between two nodes.

        Raises
        ------
        UnreachableError
            If there is none.

        """
        return self._route(source, target).latency

    def bandwidth(self, source: Hashable, target: Hashable) -> float:
        """Return what a flow alone between two nodes gets, in B/s, while no link is slowed down.

        Raises
        ------
        UnreachableError
            If no route connects them.

        """
        return self._route(source, target).bandwidth

    # -- sending --------------------------------------------------------------------------------------------------

    def transfer(
        self,
        source: Hashable,
        target: Hashable,
        nbytes: float,
        *,
        start: int | None = None,
        weight: float = 1.0,
        cap: float = math.inf,
        delay: int = 0,
    ) -> simpy.Event:
        """Send bytes from one node to another.

        Parameters
        ----------
        source, target : hashable
            Two nodes that a route connects.
        nbytes : float
            How much to send; finite and not negative. No bytes take the latency alone.
        start : int, optional
            The tick at which the sender begins; now, unless given.
        weight : float
            Where flows share a full link, their rates are as their weights; between 1/1024 and 1024, to a multiple of
            2^-32.
        cap : float
            The most that this flow gets, in B/s: a copy engine, a protocol.
        delay : int
            Ticks of latency beside the route's own.

        Returns
        -------
        simpy.Event
            Succeeds when the last byte has arrived; its value is that tick. Transfers that arrive at the same tick
            succeed in the order in which they started. Fails with a `LinkFailedError` if a link of the route is down.

        Raises
        ------
        UnreachableError
            If no route connects the two.
        ScheduleError
            If a number is out of range, or the start lies in the past.

        """
        pair = (source, target)
        route = self._table.made.get(pair) or self._route(source, target)
        now = cast("int", self._env.now)
        start, delay = now if start is None else operator.index(start), operator.index(delay)
        if not WEIGHTS[0] <= weight <= WEIGHTS[1]:
            raise ScheduleError(f"a transfer's weight must lie between 1/1024 and 1024, got {weight!r}")
        check_transfer(nbytes, start, cap, delay, now)
        done = simpy.Event(self._env)
        self._send(done, 0, pair, route, float(nbytes), start, float(weight), float(cap), delay)
        return done

    def _send(
        self,
        owner: simpy.Event | Listener,
        key: int,
        pair: tuple[Hashable, Hashable],
        route: Route,
        nbytes: float,
        start: int,
        weight: float,
        cap: float,
        delay: int,
    ) -> None:
        if not self._free:
            self._grow(1)
        t, slot, hops = self._t, self._free.pop(), len(route.links)
        self._owners[slot], self._pairs[slot], self._keys[slot] = owner, pair, key
        arrival = start + route.latency + delay
        relative = min(arrival - self._epoch, FAR)
        joins = hops if nbytes else 0
        t.flows[slot] = (relative, 0, nbytes, 0.0, round(weight / WEIGHT_UNIT), joins, 0, 0, 0, NONE, NONE, NONE)
        t.story[slot] = (cap, nbytes, min(start - self._epoch, FAR), self._started)
        t.hops[slot, :hops] = route.links
        self._started += 1
        self.sent_bytes += nbytes
        self.sent_link_bytes += nbytes * hops
        if (nbytes and (hops or cap < math.inf)) or relative >= HORIZON:
            self._settle_at(arrival).append(slot)
        else:
            self._arm(fluid.add_alone(t, np.array([slot], np.int32)))

    def post(
        self,
        sources: Sequence[Hashable],
        targets: Sequence[Hashable],
        nbytes: ArrayLike,
        starts: ArrayLike,
        listener: Listener,
        keys: ArrayLike,
        *,
        caps: ArrayLike | None = None,
        delays: ArrayLike | None = None,
        weights: ArrayLike | None = None,
    ) -> None:
        """Send many messages, without an event each.

        Parameters
        ----------
        sources, targets : sequences of n hashables
        nbytes : float64 array, (n,)
        starts : int64 array, (n,)
            The ticks at which the senders begin.
        listener : callable
            Called with ``(keys, tick)`` whenever some of them have arrived: their keys as an int64 array, in the order
            in which they started.
        keys : int64 array, (n,)
            What the caller calls the messages.
        caps : float64 array, (n,), optional
            The most that each gets, in B/s.
        delays : int64 array, (n,), optional
            Ticks of latency beside the routes' own.
        weights : float64 array, (n,), optional
            As for `transfer`; 1 by default.

        Raises
        ------
        UnreachableError, ScheduleError
            As for `transfer`; then none of them is sent. If a link fails under one of them, the simulation ends with a
            `LinkFailedError`.

        """
        now = cast("int", self._env.now)
        known, pairs = self._table.made, list(zip(sources, targets, strict=True))
        routes = [known.get(pair) or self._route(*pair) for pair in pairs]
        count = len(pairs)
        sizes = column(np.asarray(nbytes, np.float64), count)
        begins, names = column(whole(starts), count), column(whole(keys), count)
        limits = np.full(count, math.inf) if caps is None else column(np.asarray(caps, np.float64), count)
        waits = np.zeros(count, np.int64) if delays is None else column(whole(delays), count)
        shares = column(np.asarray(1.0 if weights is None else weights, np.float64), count)
        if ((shares < WEIGHTS[0]) | (shares > WEIGHTS[1])).any():
            raise ScheduleError(f"a transfer's weight must lie between 1/1024 and 1024, got {shares.tolist()}")
        if count <= _FEW:
            numbers = list(zip(sizes.tolist(), begins.tolist(), limits.tolist(), waits.tolist(), strict=True))
            for each in numbers:
                check_transfer(*each, now)
            messages = zip(names.tolist(), pairs, routes, shares.tolist(), numbers, strict=True)
            for key, pair, route, share, (size, begin, limit, wait) in messages:
                self._send(listener, key, pair, route, size, begin, share, limit, wait)
            return
        good = (sizes >= 0.0) & (sizes < math.inf) & (begins >= now) & (limits > 0.0) & (waits >= 0)
        if not good.all():
            bad = int(np.argmin(good))
            check_transfer(float(sizes[bad]), int(begins[bad]), float(limits[bad]), int(waits[bad]), now)
        ends = begins + waits + np.fromiter((route.latency for route in routes), np.int64, count)
        if (ends < begins).any():
            raise ScheduleError("messages sent together must arrive before tick 2^63")
        if len(self._free) < count:
            self._grow(count)
        slots = self._free[-count:][::-1]
        del self._free[-count:]
        at = np.array(slots, np.int32)
        flows, stories = np.zeros(count, FLOW), np.zeros(count, STORY)
        lengths = np.fromiter((len(route.links) for route in routes), np.int64, count)
        stories["start"] = begins - self._epoch
        stories["number"] = np.arange(self._started, self._started + count)
        stories["nbytes"] = flows["remaining"] = sizes
        flows["finish"] = ends - self._epoch
        flows["weight"] = np.rint(shares / WEIGHT_UNIT)
        stories["cap"] = limits
        flows["hops"] = np.where(sizes > 0.0, lengths, 0)
        flows["next"] = flows["leader"] = flows["place"] = NONE
        self._t.flows[at], self._t.story[at] = flows, stories
        row, hop = np.nonzero(np.arange(lengths.max()) < lengths[:, None])
        every_link = itertools.chain.from_iterable(route.links for route in routes)
        self._t.hops[at[row], hop] = np.fromiter(every_link, np.int32, len(row))
        self._keys[at] = names
        for slot, pair in zip(slots, pairs, strict=True):
            self._owners[slot] = listener
            self._pairs[slot] = pair
        self._started += count
        self.sent_bytes += float(sizes.sum())
        self.sent_link_bytes += float(sizes @ lengths)
        joins = (sizes > 0.0) & ((lengths > 0) | (limits < math.inf)) | (flows["finish"] >= HORIZON)
        if not joins.all():
            self._arm(fluid.add_alone(self._t, at[~joins]))
        if joins.any():
            ticks, which = np.unique(ends[joins], return_inverse=True)
            order = np.argsort(which, kind="stable")
            groups = np.split(at[joins][order], np.cumsum(np.bincount(which))[:-1])
            for tick, group in zip(ticks.tolist(), groups, strict=True):
                self._settle_at(tick).extend(group.tolist())

    # -- links that slow down or fail -----------------------------------------------------------------------------

    def disturb(self, link: Hashable, share: float, start: int, end: int | None = None) -> None:
        """Slow a link down to a share of its bandwidth from one tick until another; to nothing, which is a failure.

        While a link is down, the transfers over it fail, both those under way and those that reach it. Of several
        disturbances of one link the worst counts.

        Parameters
        ----------
        link : hashable
            A link's name.
        share : float
            From 0, a failure, to 1.
        start, end : int
            Ticks; without an end it stays so. What arrives at the start is through.

        Raises
        ------
        UsageError
            If there is no such link.
        ScheduleError
            If a number is out of range.

        """
        if link not in self._table.index:
            raise UsageError(f"there is no link {link!r}{near(link, self._table.index)}")
        now = cast("int", self._env.now)
        start, end = operator.index(start), None if end is None else operator.index(end)
        if not 0.0 <= share <= 1.0:
            raise ScheduleError(f"a link's share of its bandwidth must lie between 0 and 1, got {share!r}")
        if not now <= start < (math.inf if end is None else end):
            raise ScheduleError(f"a disturbance of {link!r} must begin now or later and end after it has begun")
        index = self._table.index[link]
        shares = self._disturbed.setdefault(index, [])

        def begin(_: simpy.Event) -> None:
            shares.append(share)
            self._recapacitate(index)

        def finish(_: simpy.Event) -> None:
            shares.remove(share)
            self._recapacitate(index)

        _Alarm(self._env, start, _FIRST, begin)
        if end is not None:
            _Alarm(self._env, end, _FIRST, finish)

    def _recapacitate(self, link: int) -> None:
        """Give a link the bandwidth it now has; have its flows rated anew, or fail."""
        tick = cast("int", self._env.now)
        if self._armed == tick:
            self._let_go(tick)
        name, nominal = list(self._table.links.items())[link]
        share = min(self._disturbed[link], default=1.0)
        users, entry = [], int(self._t.links[link]["first"])
        while entry != NONE:
            users.append(entry // self._t.hops.shape[1])
            entry = int(self._t.chain["after"][entry])
        slots = self._in_order(np.array(users, np.int32))
        if share > 0.0:
            self._down.pop(link, None)
            self._t.links[link]["capacity"] = share * nominal.bandwidth
            fluid.upset(self._t, slots)
        else:
            self._down[link] = name
            fluid.evict(self._t, slots, self._now())
            for slot in slots.tolist():
                self._fail(slot)
        self._settle_at(tick)

    def _fail(self, slot: int) -> None:
        source, target = self._pairs[slot]
        name = next(self._down[link] for link in self._route(source, target).links if link in self._down)
        now = cast("int", self._env.now)
        error = LinkFailedError(
            f"the link {name} is down at {to_seconds(now):.9g} s, with {self._t.story[slot]['nbytes']:.0f} B "
            f"from {source!r} to {target!r} on their way"
        )
        owner = self._owners[slot]
        self._owners[slot] = None
        self._free.append(slot)
        if not isinstance(owner, simpy.Event):
            raise error
        owner.fail(error)

    def _meets_failure(self, slot: int) -> bool:
        return any(link in self._down for link in self._route(*self._pairs[slot]).links)

    # -- the course of events -------------------------------------------------------------------------------------

    def _settle_at(self, tick: int) -> list[int]:
        """Return the flows that join at a tick, having made sure that there will be a re-rating at its very end."""
        flows = self._arrivals.get(tick)
        if flows is None:
            flows = self._arrivals[tick] = []
            _Alarm(self._env, tick, _LAST, self._settle)
        return flows

    def _settle(self, _: simpy.Event) -> None:
        """Re-rate each component of flows in which something has started or ended at this tick."""
        arrivals = self._arrivals.pop(cast("int", self._env.now))
        if self._down:
            through = []
            for slot in arrivals:
                if self._meets_failure(slot):
                    self._fail(slot)
                else:
                    through.append(slot)
            arrivals = through
        now = self._now()
        self._lengthen_log()
        self._arm(fluid.settle(self._t, np.array(arrivals, np.int32), now))

    def _arm(self, first: int) -> None:
        """Make sure that the network wakes up when the first of the flows arrives."""
        if first == NONE:
            return
        tick = self._epoch + first if first < FAR else self._first_far_tick()
        if tick < self._armed:
            self._armed = tick
            _Alarm(self._env, tick, NORMAL, self._wake)

    def _wake(self, _: simpy.Event) -> None:
        """Let go of the flows that arrive at this tick."""
        tick = cast("int", self._env.now)
        if tick == self._armed:  # else an earlier one was armed since, and has done the work of both
            self._let_go(tick)

    def _let_go(self, tick: int) -> None:
        self._armed = math.inf
        now = self._now()
        self._lengthen_log()
        count, first, unsettled = fluid.release(self._t, now)
        slots = self._in_order(self._t.notes["arrived"][:count])
        if unsettled:
            self._settle_at(tick)
        batches: dict[Listener, list[int]] = {}
        for slot in slots.tolist():
            owner = self._owners[slot]
            if self._down and self._meets_failure(slot):  # a message without bytes
                self._fail(slot)
                continue
            self._owners[slot] = None
            self.flows_finished += 1
            if isinstance(owner, simpy.Event):
                owner.succeed(tick)
            else:
                batches.setdefault(owner, []).append(slot)
            self._free.append(slot)
        # A listener may send more, into these slots.
        for listener, keys in [(listener, self._keys[theirs]) for listener, theirs in batches.items()]:
            listener(keys, tick)
        self._arm(first)

    def _in_order(self, slots: NDArray[np.int32]) -> NDArray[np.int32]:
        """Return the flows in the order in which they started."""
        if len(slots) < 2:
            return slots
        told = self._t.story[slots]
        ordered: NDArray[np.int32] = slots[np.lexsort((told["number"], told["start"]))]
        return ordered

    # -- ticks beyond the horizon of the kernels ------------------------------------------------------------------

    def _now(self) -> int:
        """Return the tick it is, relative to the epoch, which moves when that would become too large."""
        now = cast("int", self._env.now) - self._epoch
        if now < HORIZON:
            return now
        used = np.array([slot for slot, owner in enumerate(self._owners) if owner is not None], np.int64)
        rebase(self._t, used, now)
        self._epochs.append((int(self._t.counters[LOGGED]), self._epoch + now))
        self._epoch += now
        return 0

    def _first_far_tick(self) -> int:
        """Return the tick at which the first of the flows arrives, where that is beyond the horizon."""
        slots = [s for s in np.flatnonzero(self._t.flows["finish"] == FAR).tolist() if self._owners[s] is not None]
        return self._epoch + min(far_ticks(self._t, slots).values())

    # -- room -----------------------------------------------------------------------------------------------------

    def _route(self, source: Hashable, target: Hashable) -> Route:
        """Return the route between two nodes, having made sure that there is room for so many links."""
        route = self._table.made.get((source, target)) or self._table.make(source, target)
        if len(route.links) > self._t.hops.shape[1]:
            fluid.forget(self._t)
            self._t = self._t.grown(len(self._t.flows), 2 * len(route.links), len(self._t.log))
        return route

    def _grow(self, wanted: int) -> None:
        """Make room for more flows."""
        old = len(self._t.flows)
        size = max(64, 2 * old, old + wanted)
        fluid.forget(self._t)
        self._t = self._t.grown(size, self._t.hops.shape[1], len(self._t.log))
        self._keys = np.concatenate([self._keys, np.zeros(size - old, np.int64)])
        self._owners += [None] * (size - old)
        self._pairs += [(None, None)] * (size - old)
        self._free += range(size - 1, old - 1, -1)

    def _lengthen_log(self) -> None:
        """Make room for what one settling of the network may log."""
        if len(self._t.log) and self._t.counters[LOGGED] + 2 * len(self._t.links) > len(self._t.log):
            fluid.forget(self._t)
            self._t = self._t.grown(len(self._t.flows), self._t.hops.shape[1], 2 * len(self._t.log))
