"""Links, and the routes over them from node to node."""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from simrender.clock import to_ticks
from simrender.errors import ScheduleError, UnreachableError, UsageError, did_you_mean

Routes = Mapping[tuple[Hashable, Hashable], Sequence[Hashable]] | Callable[[Any, Any], Sequence[Hashable] | None]

_MOST_ROUTES = 2**17


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


class Route:
    """The links from one node to another, by index; their latency in ticks; the bandwidth of a flow alone on them."""

    __slots__ = ("bandwidth", "latency", "links")

    def __init__(self, links: tuple[int, ...], latency: int, bandwidth: float) -> None:
        self.links, self.latency, self.bandwidth = links, latency, bandwidth


class RouteTable:
    """The routes of a network, each made when first asked for.

    Parameters
    ----------
    links : mapping of name to Link
    routes : mapping of (source, target) to a sequence of link names, or a function of source and target
    nodes : iterable
        What a function connects.

    Attributes
    ----------
    links : dict of name to Link
    index : dict of name to int
        The place of each link.

    Raises
    ------
    UsageError
        If a route names an unknown link, or one link twice.

    """

    def __init__(self, links: Mapping[Hashable, Link], routes: Routes, nodes: Iterable[Hashable]) -> None:
        self.links = dict(links)
        self.index = {name: i for i, name in enumerate(self.links)}
        self._nodes = list(nodes)
        if isinstance(routes, Mapping):
            for (source, target), names in routes.items():
                self._check(source, target, names)
            given = {pair: tuple(names) for pair, names in routes.items()}
            self._nodes = list(dict.fromkeys([*self._nodes, *(node for pair in given for node in pair)]))
            self._find: Callable[[Any, Any], Sequence[Hashable] | None] = lambda s, t: given.get((s, t))
        else:
            self._find = routes
        self.made: dict[tuple[Hashable, Hashable], Route] = {}

    def make(self, source: Hashable, target: Hashable) -> Route:
        """Return the route between two nodes, and keep it in ``made``.

        Raises
        ------
        UnreachableError
            If there is none, with what is near.

        """
        names = self._find(source, target)
        if names is None:
            raise UnreachableError(f"no route {source!r} -> {target!r}{self._alternatives(source, target)}")
        try:
            links = tuple([self.index[name] for name in names])
        except KeyError:
            self._check(source, target, names)
            raise
        if len(set(links)) < len(links):
            self._check(source, target, names)
        used = [self.links[name] for name in names]
        latency = to_ticks(math.fsum([link.latency for link in used]))
        if len(self.made) >= _MOST_ROUTES:  # each pair of a thousand ranks, once each
            self.made.clear()
        route = Route(links, latency, min([link.bandwidth for link in used], default=math.inf))
        self.made[source, target] = route
        return route

    def _check(self, source: Hashable, target: Hashable, names: Sequence[Hashable]) -> None:
        for i, name in enumerate(names):
            if name not in self.index:
                hint = near(name, self.index)
                raise UsageError(f"the route {source!r} -> {target!r} names an unknown link {name!r}{hint}")
            if name in names[:i]:
                raise UsageError(f"the route {source!r} -> {target!r} uses the link {name!r} twice")

    def _alternatives(self, source: Hashable, target: Hashable) -> str:
        for node in (source, target):
            if self._nodes and node not in self._nodes:
                return f": there is no node {node!r}{near(node, self._nodes)}"
        others = sorted(repr(node) for node in self._nodes if node != source and self._find(source, node) is not None)
        if not self._nodes:
            return ""
        if not others:
            return f"; {source!r} reaches no other node"
        return f"; {source!r} reaches {', '.join(others[:8])}{', ...' if len(others) > 8 else ''}"


def near(name: Hashable, known: Iterable[Hashable]) -> str:
    """Return what name was probably meant, where names are words."""
    return did_you_mean(name, [other for other in known if isinstance(other, str)]) if isinstance(name, str) else ""


class FewestHops:
    """Routes of the fewest hops over named edges, one breadth-first tree a source, made when first asked for."""

    def __init__(self, nodes: Iterable[Hashable], links: Mapping[Any, int]) -> None:
        self._next: dict[Hashable, list[tuple[Hashable, int]]] = {node: [] for node in nodes}
        for (u, v), latency in links.items():
            self._next[u].append((v, latency))
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
