"""LoadOnce, LoadAnother and LoadMany: ranks keep the data they have loaded as long as rays ask for it.

Navratil et al., "Exploring the spectrum of dynamic scheduling algorithms for scalable distributed-memory ray tracing"
(2014), name these schedules; they are defined here as the GraviT library, written by the same group, has them. In each
round rank 0 collects what every rank has loaded and how many rays wait there for which domain, and says which domain
each rank processes next. Rays then travel to a rank that has their domain; those of other domains stay where they are.

Where the library falls short of its rule the rule is kept. Its sort key makes domains 128 apart one and overflows at
16,777,216 rays; its ranks without rays do not tell what they have loaded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import INT_BYTES, DomainRank
from simrender.policies.queues import fullest
from simrender.policies.rounds import deliver, visit
from simrender.rays.sampling import path_key, uniform

Counts = NDArray[np.int64]

NOTHING = -1
"""What a rank processes that has nothing to do."""


@dataclass(frozen=True)
class LoadOnce:
    """Never load a domain that another rank has.

    A rank goes on with what it has loaded while rays wait for that, anywhere. Each idle rank, from rank 0 on, takes the
    domain with most rays that nobody has.

    Parameters
    ----------
    cache : str
        Domains that a rank has loaded at a time: a number, a share such as 25%, a size such as 8 GB, or all; one in the
        original. Of several a rank goes on with the one with most rays.
    ray_bytes : float
        Size of a ray in a message: 80 B in GraviT.
    threads : int, optional
        Cores of a rank that trace; all by default.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    cache: str | int = 1
    ray_bytes: Annotated[float, Field(gt=0)] = 80.0
    threads: Annotated[int, Field(ge=1)] | None = None

    in_situ: ClassVar[bool] = False
    owners: ClassVar[None] = None

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame, beginning with the domain for which most of this rank's own rays wait."""
        me.enqueue(me.camera_rays())
        domain = fullest(me.queues.counts)
        me.explain(me.queues.counts, () if domain is None else (domain,))
        while True:
            me.count_step()
            if domain is not None and me.queues.any():  # a rank with no ray at all does not load
                yield from visit(me, domain)
            me.next_step()
            planned = yield from self.agree(me)
            yield from deliver(me, self.holders(me, planned), self.ray_bytes)
            domain = None if planned[me.index] == NOTHING else planned[me.index]
            if not (yield from me.any(mine=me.queues.any())):
                break
        yield from me.merge_frame()

    def agree(self, me: DomainRank) -> Steps:
        """Let rank 0 plan a round; return the domain of each rank, `NOTHING` for none."""
        loaded, counts = me.cache.resident, me.queues.counts.copy()
        length = len(loaded) + 2 * np.count_nonzero(counts)
        reports = yield from me.gather((loaded, counts), float(INT_BYTES * length))
        planned = None
        if me.index == 0:
            waiting = np.sum([counts for _, counts in reports], axis=0)
            planned = self.plan([loaded for loaded, _ in reports], waiting, me.weight)
            if waiting.any():
                me.explain(waiting, tuple(domain for domain in planned if domain != NOTHING), together=True)
        return (yield from me.broadcast(planned, float(INT_BYTES * me.ranks)))

    def plan(self, loaded: Sequence[Sequence[int]], waiting: Counts, weight: float = 1.0) -> list[int]:
        """Return the domain that each rank processes next, `NOTHING` for none.

        Parameters
        ----------
        loaded : sequence of sequence of int (ranks,)
            The domains that each rank has.
        waiting : int64 array (domains,)
            The rays that wait for each domain, on all ranks together.
        weight : float
            Published rays for which each stands.

        """
        # Where two ranks have the same domain, it is the later one's, and the other may take something else.
        holder = {domain: rank for rank, domains in enumerate(loaded) for domain in domains}
        planned = [NOTHING] * len(loaded)
        for domain in by_rays(waiting):
            if domain in holder and planned[holder[domain]] == NOTHING:
                planned[holder[domain]] = domain
        self.fill(planned, waiting, holder, weight)
        return planned

    def fill(self, planned: list[int], waiting: Counts, holder: dict[int, int], weight: float) -> None:  # noqa: ARG002
        """Give idle ranks something to do."""
        homeless = [domain for domain in by_rays(waiting) if domain not in holder]
        for rank, domain in zip(idle(planned), homeless, strict=False):
            planned[rank] = domain

    def holders(self, me: DomainRank, planned: Sequence[int]) -> Counts:
        """Return the rank to which this one sends the rays of each domain, int64 (domains,); -1 for none.

        A rank keeps the rays of its own domain. If several other ranks have a domain it tosses a coin for each after
        the first, and the last that won gets all of them.
        """
        holder = np.full(len(me.queues.counts), -1, np.int64)
        for rank, domain in enumerate(planned):
            if domain == NOTHING:
                continue
            if holder[domain] < 0 or _coin(domain, me.index, me.step, rank):
                holder[domain] = rank
        if planned[me.index] != NOTHING:
            holder[planned[me.index]] = me.index
        return holder


@dataclass(frozen=True)
class LoadAnother(LoadOnce):
    """As LoadOnce, but an idle rank takes a domain with most rays even if another rank has it: up to one copy more."""

    def fill(self, planned: list[int], waiting: Counts, holder: dict[int, int], weight: float) -> None:  # noqa: ARG002
        """Give idle ranks something to do."""
        for rank, domain in zip(idle(planned), by_rays(waiting), strict=False):
            planned[rank] = domain


@dataclass(frozen=True)
class LoadMany(LoadOnce):
    """As LoadAnother, but a domain with very many rays goes to several idle ranks.

    Parameters
    ----------
    many : float
        Each rank that gets a domain halves the rays that are thought to wait for it; while there are more than so many
        the domain is offered again.

    """

    many: Annotated[float, Field(ge=0)] = 100_000.0

    def fill(self, planned: list[int], waiting: Counts, holder: dict[int, int], weight: float) -> None:  # noqa: ARG002
        """Give idle ranks something to do."""
        expected = (waiting * weight).tolist()
        fresh, again = deque(by_rays(waiting)), deque[int]()
        for rank in idle(planned):
            if not fresh and not again:
                return
            # Domains that are offered again stand in line and are not sorted by their rays.
            from_fresh = fresh and (not again or expected[fresh[0]] > expected[again[0]])
            domain = fresh.popleft() if from_fresh else again.popleft()
            planned[rank] = domain
            expected[domain] = expected[domain] // 2.0
            if expected[domain] > self.many:
                again.append(domain)


def _coin(domain: int, source: int, step: int, rank: int) -> bool:
    """Toss the coin of a rank that sends a domain's rays in a step: whether another rank gets them."""
    return bool(uniform(np.uint64(path_key(0, domain, source, step)), rank) < 0.5)


def by_rays(waiting: Counts) -> list[int]:
    """Return the domains that rays wait for, those with most first, and of equal ones the higher number."""
    domains = np.flatnonzero(waiting)[::-1]
    found: list[int] = domains[np.argsort(-waiting[domains], kind="stable")].tolist()
    return found


def idle(planned: Sequence[int]) -> list[int]:
    """Return the ranks that have nothing to do."""
    return [rank for rank, domain in enumerate(planned) if domain == NOTHING]
