"""Routes of the fewest hops over a graph."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping
from typing import Any


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
