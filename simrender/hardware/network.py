"""The network: messages as fluid flows that share links max-min fairly.

A message pays the latency of its route once and then flows at a rate that changes only when another flow starts or
ends somewhere it matters. This is the fluid model that SimGrid validated against packet-level simulation (Velho,
Schnorr, Casanova and Legrand, "On the validity of flow-level TCP network models for grid and cloud simulations", ACM
TOMACS 23(4), 2013), without its corrections for TCP.
"""

from __future__ import annotations

import heapq
import math
import operator
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import simpy
from simpy.events import NORMAL, EventPriority

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.errors import ScheduleError, UnreachableError, UsageError, did_you_mean

if TYPE_CHECKING:
    import networkx

_Callback = Callable[[simpy.Event], None]

_LAST = EventPriority(NORMAL + 1)  # after everything that SimPy itself schedules at the same tick


@dataclass(frozen=True, slots=True)
class Link:
    """One direction of a cable, or a whole bus: a bandwidth that all flows through it share.

    Parameters
    ----------
    bandwidth : float
        Bytes a second; finite and above zero.
    latency : float
        Seconds that the first byte takes; finite and not negative.

    Raises
    ------
    ScheduleError
        If the bandwidth or the latency is out of range.

    """

    bandwidth: float
    latency: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.bandwidth < math.inf:
            raise ScheduleError(f"a link's bandwidth must be finite and above zero, got {self.bandwidth!r} B/s")
        if not 0.0 <= self.latency < math.inf:
            raise ScheduleError(f"a link's latency must be finite and not negative, got {self.latency!r} s")


def max_min_rates(capacities: Sequence[float], flow_links: Sequence[Sequence[int]]) -> list[float]:
    """Share links between flows so that no flow could be faster without slowing one that is no faster than itself.

    Progressive filling (Bertsekas and Gallager, *Data Networks*, 2nd ed., section 6.5.2): all rates grow together
    until some links are full; the flows through those are frozen, and the others grow on. Links that fill at the same
    rate fill in the same round, and a round takes the frozen flows from a link all at once. So the rates do not depend
    on the order of flows or links, not even in their last bit.

    Parameters
    ----------
    capacities : sequence of float
        Bandwidth of each link in B/s, above zero. Links that no flow uses cost nothing.
    flow_links : sequence of sequences of int
        For each flow the indices of the links on its route, none of them twice.

    Returns
    -------
    list of float
        The rate of each flow in B/s; infinite for a flow that uses no link.

    Examples
    --------
    Three flows, two links in a row: one flow takes both, each of the others takes one. The first link is the tighter
    one and gives each of its flows 2; that leaves 8 on the second for the flow that uses it alone.

    >>> max_min_rates([4.0, 10.0], [(0, 1), (0,), (1,)])
    [2.0, 2.0, 8.0]

    """
    users: dict[int, list[int]] = {}
    for flow, links in enumerate(flow_links):
        for link in links:
            if link in users:
                users[link].append(flow)
            else:
                users[link] = [flow]
    unfrozen = {link: len(flows) for link, flows in users.items()}
    shares = {link: capacities[link] / n for link, n in unfrozen.items()}
    residual: dict[int, float] = {}
    rates = [math.inf] * len(flow_links)
    filling = sum(map(bool, flow_links))
    while filling:
        share = min(shares.values())
        frozen: list[int] = []
        for full in [link for link, s in shares.items() if s == share]:
            for flow in users[full]:
                if rates[flow] == math.inf:
                    rates[flow] = share
                    frozen.append(flow)
        filling -= len(frozen)
        if not filling:
            break
        taken: dict[int, int] = {}
        for flow in frozen:
            for link in flow_links[flow]:
                taken[link] = taken.get(link, 0) + 1
        for link, n in taken.items():
            left = unfrozen[link] - n
            if left:
                unfrozen[link] = left
                residual[link] = residual.get(link, capacities[link]) - n * share
                shares[link] = residual[link] / left
            else:
                del shares[link]
    return rates


class _Route:
    """The links from one node to another, by index; their latency in ticks; the bandwidth of a flow alone on them."""

    __slots__ = ("bandwidth", "carried", "latency", "links")

    def __init__(self, links: tuple[int, ...], latency: int, bandwidth: float) -> None:
        self.links = links
        self.latency = latency
        self.bandwidth = bandwidth
        self.carried = 0.0


class _Flow:
    """Bytes on their way: what was left of them when their rate last changed, and when they will have arrived."""

    __slots__ = ("done", "finish", "links", "mark", "nbytes", "number", "rate", "remaining", "route", "since", "start")

    def __init__(self, done: simpy.Event, route: _Route, nbytes: float, start: int, number: int) -> None:
        self.done = done
        self.route = route
        self.links = route.links
        self.nbytes = self.remaining = nbytes
        self.start = start
        self.number = number
        self.rate = 0.0
        self.since = self.finish = self.mark = -1


class _Alarm(simpy.Event):
    """A SimPy timeout with a priority."""

    def __init__(self, env: simpy.Environment, tick: int, priority: EventPriority, ring: _Callback) -> None:
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
    routes : mapping of (source, target) to a sequence of link names
        The way of a message; empty for a copy that stays where it is.

    Attributes
    ----------
    sent_bytes : float
        Bytes of all transfers asked for so far.
    flows_finished : int
        Transfers that have arrived.
    reratings : int
        How many times the rate of a flow was computed: what the network costs to simulate.

    Raises
    ------
    UsageError
        If a route names an unknown link, or one link twice.

    """

    def __init__(
        self,
        env: simpy.Environment,
        links: Mapping[Hashable, Link],
        routes: Mapping[tuple[Hashable, Hashable], Sequence[Hashable]],
    ) -> None:
        self.sent_bytes = 0.0
        self.flows_finished = 0
        self.reratings = 0
        self._env = env
        self._links = dict(links)
        self._index = {name: i for i, name in enumerate(self._links)}
        self._capacities = [float(link.bandwidth) for link in self._links.values()]
        for (source, target), names in routes.items():
            self._check_route(source, target, names)
        given = {pair: tuple(names) for pair, names in routes.items()}
        self._nodes = list(dict.fromkeys(node for pair in given for node in pair))
        self._find: Callable[[Hashable, Hashable], Sequence[Hashable] | None] = lambda s, t: given.get((s, t))
        self._routes: dict[tuple[Hashable, Hashable], _Route] = {}
        self._started = 0
        self._users: list[dict[int, _Flow]] = [{} for _ in self._links]
        self._vacated: list[dict[int, _Flow]] = []
        self._arrivals: dict[int, list[_Flow]] = {}
        self._finishes: list[tuple[int, int, int, _Flow]] = []
        self._armed: float = math.inf
        self._stamp = 0
        self._link_marks = [0] * len(self._links)

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
        network = cls(env, links, {})
        network._nodes = list(digraph)
        network._find = _FewestHops(network._nodes, links).route
        return network

    @property
    def carried_bytes(self) -> dict[Hashable, float]:
        """Bytes that each link has carried, of the transfers that have arrived."""
        shares: list[list[float]] = [[] for _ in self._links]
        for route in self._routes.values():
            for link in route.links:
                shares[link].append(route.carried)
        return {name: math.fsum(share) for name, share in zip(self._links, shares, strict=True)}

    def transfer(self, source: Hashable, target: Hashable, nbytes: float, *, start: int | None = None) -> simpy.Event:
        """Send bytes from one node to another.

        Parameters
        ----------
        source, target : hashable
            Two nodes that a route connects.
        nbytes : float
            How much to send; finite and not negative. No bytes take the latency alone.
        start : int, optional
            The tick at which the sender begins; now, unless given.

        Returns
        -------
        simpy.Event
            Succeeds when the last byte has arrived; its value is that tick. Transfers that arrive at the same tick
            succeed in the order in which they started.

        Raises
        ------
        UnreachableError
            If no route connects the two.
        ScheduleError
            If the size is negative, infinite or not a number, or the start lies in the past.

        """
        route = self._routes.get((source, target)) or self._add_route(source, target)
        now = cast("int", self._env.now)
        if not 0.0 <= nbytes < math.inf:
            raise ScheduleError(f"a transfer's size must be finite and not negative, got {nbytes!r} B")
        start = now if start is None else operator.index(start)
        if start < now:
            raise ScheduleError(f"a transfer cannot start at tick {start}, before now, tick {now}")
        flow = _Flow(simpy.Event(self._env), route, float(nbytes), start, self._started)
        self._started += 1
        self.sent_bytes += flow.nbytes
        if flow.nbytes and route.links:
            self._settle_at(start + route.latency).append(flow)
        else:
            flow.links = ()
            self._finish_at(flow, start + route.latency)
            self._arm()
        return flow.done

    def _settle_at(self, tick: int) -> list[_Flow]:
        """Return the flows that join at a tick, having made sure that there will be a re-rating at its very end."""
        flows = self._arrivals.get(tick)
        if flows is None:
            flows = self._arrivals[tick] = []
            _Alarm(self._env, tick, _LAST, self._settle)
        return flows

    def _settle(self, _: simpy.Event) -> None:
        """Re-rate each component of flows in which something has started or ended at this tick."""
        now = cast("int", self._env.now)
        arrivals = self._arrivals.pop(now)
        for flow in arrivals:
            for link in flow.links:
                self._users[link][flow.number] = flow
        # A link that was left has one component of flows still on it, which any of them leads to.
        touched = arrivals + [next(iter(users.values())) for users in self._vacated if users]
        self._vacated.clear()
        self._stamp += 1
        for flow in touched:
            if flow.mark != self._stamp:
                self._rate(self._component(flow), now)
        self._arm()

    def _component(self, flow: _Flow) -> list[_Flow]:
        """Mark and return the flows that share a link with this one, or with one that does, and so on."""
        stamp, marks = self._stamp, self._link_marks
        flow.mark = stamp
        component = [flow]
        for member in component:  # grows as it goes
            for link in member.links:
                if marks[link] != stamp:
                    marks[link] = stamp
                    users = self._users[link]
                    if len(users) > 1:
                        for other in users.values():
                            if other.mark != stamp:
                                other.mark = stamp
                                component.append(other)
        return component

    def _rate(self, component: list[_Flow], now: int) -> None:
        """Give the flows of a component their fair rates, and those whose rate changes a new tick to finish at."""
        self.reratings += len(component)
        if len(component) == 1:
            rates = [component[0].route.bandwidth]
        else:
            rates = max_min_rates(self._capacities, [flow.links for flow in component])
        for flow, rate in zip(component, rates, strict=True):
            if rate != flow.rate:
                flow.remaining = max(0.0, flow.remaining - flow.rate * ((now - flow.since) / TICKS_PER_SECOND))
                flow.since = now
                flow.rate = rate
                self._finish_at(flow, now + to_ticks(flow.remaining / rate))

    def _finish_at(self, flow: _Flow, tick: int) -> None:
        """Queue a flow to arrive at a tick; whatever it was queued for before is void."""
        flow.finish = tick
        heapq.heappush(self._finishes, (tick, flow.start, flow.number, flow))

    def _arm(self) -> None:
        """Make sure that the network wakes up when the next flow arrives."""
        queue = self._finishes
        if len(queue) > 64 + 4 * (self._started - self.flows_finished):
            # A long flow leaves a void entry in the far future whenever a neighbour comes and goes.
            queue[:] = [entry for entry in queue if entry[3].finish == entry[0]]
            heapq.heapify(queue)
        while queue and queue[0][3].finish != queue[0][0]:
            heapq.heappop(queue)
        if queue and queue[0][0] < self._armed:
            self._armed = queue[0][0]
            _Alarm(self._env, queue[0][0], NORMAL, self._wake)

    def _wake(self, _: simpy.Event) -> None:
        """Let go of the flows that arrive at this tick."""
        now = cast("int", self._env.now)
        if now != self._armed:
            return  # an earlier one was armed since, and has done the work of both
        self._armed = math.inf
        queue = self._finishes
        while queue and queue[0][0] <= now:
            entry = heapq.heappop(queue)
            if entry[3].finish == entry[0]:
                self._release(entry[3], now)
        if any(self._vacated):
            self._settle_at(now)
        else:
            self._vacated.clear()
        self._arm()

    def _release(self, flow: _Flow, now: int) -> None:
        flow.finish = -1
        flow.route.carried += flow.nbytes
        self.flows_finished += 1
        for link in flow.links:
            users = self._users[link]
            del users[flow.number]
            if users:
                self._vacated.append(users)
        flow.done.succeed(now)

    def _check_route(self, source: Hashable, target: Hashable, names: Sequence[Hashable]) -> None:
        for i, name in enumerate(names):
            if name not in self._index:
                near = _near(name, self._index)
                raise UsageError(f"the route {source!r} -> {target!r} names an unknown link {name!r}{near}")
            if name in names[:i]:
                raise UsageError(f"the route {source!r} -> {target!r} uses the link {name!r} twice")

    def _add_route(self, source: Hashable, target: Hashable) -> _Route:
        names = self._find(source, target)
        if names is None:
            raise UnreachableError(f"no route {source!r} -> {target!r}{self._alternatives(source, target)}")
        links = tuple(self._index[name] for name in names)
        latency = to_ticks(math.fsum(self._links[name].latency for name in names))
        bandwidth = min((self._capacities[link] for link in links), default=math.inf)
        route = self._routes[source, target] = _Route(links, latency, bandwidth)
        return route

    def _alternatives(self, source: Hashable, target: Hashable) -> str:
        for node in (source, target):
            if node not in self._nodes:
                return f": there is no node {node!r}{_near(node, self._nodes)}"
        others = sorted(repr(node) for node in self._nodes if node != source and self._find(source, node) is not None)
        if not others:
            return f"; {source!r} reaches no other node"
        return f"; {source!r} reaches {', '.join(others[:8])}{', ...' if len(others) > 8 else ''}"


class _FewestHops:
    """Routes of the fewest hops over named edges, one breadth-first tree a source, made when first asked for."""

    def __init__(self, nodes: Iterable[Hashable], links: Mapping[Any, Link]) -> None:
        self._next: dict[Hashable, list[tuple[Hashable, int]]] = {node: [] for node in nodes}
        for (u, v), link in links.items():
            self._next[u].append((v, to_ticks(link.latency)))
        self._trees: dict[Hashable, dict[Hashable, Hashable]] = {}

    def route(self, source: Hashable, target: Hashable) -> tuple[Hashable, ...] | None:
        """Return the edges from source to target, or None where there is no way."""
        if source not in self._next:
            return None
        if source not in self._trees:
            self._trees[source] = self._tree(source)
        tree = self._trees[source]
        if target not in tree:
            return None
        edges: list[Hashable] = []
        while target != source:
            edges.append((tree[target], target))
            target = tree[target]
        return tuple(reversed(edges))

    def _tree(self, source: Hashable) -> dict[Hashable, Hashable]:
        """Return each reachable node's predecessor on its route from the source."""
        before = {source: source}
        # Latencies add up in ticks, where sums are exact, so that equally long routes do tie.
        level: dict[Hashable, tuple[int, tuple[str, ...]]] = {source: (0, (repr(source),))}
        while level:
            reached: dict[Hashable, tuple[int, tuple[str, ...]]] = {}
            for node, (latency, names) in level.items():
                for other, hop in self._next[node]:
                    if other not in before or other in reached:
                        cost = (latency + hop, (*names, repr(other)))
                        if other not in reached or cost < reached[other]:
                            reached[other] = cost
                            before[other] = node
            level = reached
        return before


def _near(name: Hashable, known: Iterable[Hashable]) -> str:
    return did_you_mean(name, [other for other in known if isinstance(other, str)]) if isinstance(name, str) else ""
