"""K-way replication: several ranks hold each domain, and its rays go to the one that has done least.

Samanta, Funkhouser and Li, "Parallel rendering with k-way replication" (2001), keep each object on k of n nodes, so
that work can be dealt out anew in every frame and the data need not move. They rasterize; here rays are dealt out, in
the rounds in which SpRay's in situ baseline schedules them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank
from simrender.policies.rounds import rounds

Counts = NDArray[np.int64]


@dataclass(frozen=True)
class Replication:
    """Process the domains with most rays, each on the holder that has processed fewest rays so far.

    With one copy that is LoadAnyOnce in situ: each rank processes the fullest of its own domains.

    Parameters
    ----------
    copies : int
        Ranks that hold each domain: its owner and the ones that follow; all ranks where there are fewer.
    ray_bytes : float
        Size of a ray in a message, as in SpRay's baseline.
    threads : int, optional
        Cores of a rank that trace; all by default.
    owners : tuple of int, optional
        The rank of each domain; blocks in Morton order by default.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    copies: Annotated[int, Field(ge=1)] = 2
    ray_bytes: Annotated[float, Field(gt=0)] = 96.0
    threads: Annotated[int, Field(ge=1)] | None = None
    owners: tuple[int, ...] | None = None

    in_situ: ClassVar[bool] = True
    cache: ClassVar[str] = "all"

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        holders = me.alike(lambda: self.holders(me.owned_by_rank))
        done = np.zeros(me.ranks, np.int64)

        def plan(waiting: Counts) -> dict[int, int]:
            planned = me.alike(lambda: assign(waiting, holders, done))
            for rank, domain in planned.items():
                done[rank] += waiting[domain]
            return planned

        me.enqueue(me.camera_rays())
        yield from rounds(me, plan, self.ray_bytes)
        yield from me.merge_frame()

    def holders(self, owned_by_rank: Sequence[Counts]) -> list[list[int]]:
        """Return the ranks that hold each domain, the owner first."""
        ranks = len(owned_by_rank)
        copies = min(self.copies, ranks)
        owner = {domain: rank for rank, owned in enumerate(owned_by_rank) for domain in owned.tolist()}
        return [[(owner[domain] + k) % ranks for k in range(copies)] for domain in sorted(owner)]


def assign(waiting: Counts, holders: Sequence[Sequence[int]], done: Counts) -> dict[int, int]:
    """Return the domain of each rank that gets one this round.

    Domains choose, those with most rays first and of equal ones the lowest, among their holders that are still free the
    one that has done least, of equal ones the lowest rank.

    Parameters
    ----------
    waiting : int64 array (domains,)
        The rays that wait for each domain.
    holders : sequence of sequence of int (domains,)
    done : int64 array (ranks,)
        Rays that each rank has processed in earlier rounds.

    """
    planned: dict[int, int] = {}
    for domain in np.argsort(-waiting, kind="stable").tolist():
        free = [rank for rank in holders[domain] if rank not in planned]
        if waiting[domain] > 0 and free:
            planned[min(free, key=lambda rank: (int(done[rank]), rank))] = domain
    return dict(sorted(planned.items()))
