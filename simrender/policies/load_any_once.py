"""LoadAnyOnce: always process the domain for which most rays wait.

Pharr et al., "Rendering complex scenes with memory-coherent ray tracing" (1997), out of core; Navratil et al.,
"Exploring the spectrum of dynamic scheduling algorithms for scalable distributed-memory ray tracing" (2014), over
ranks; both as Park, Fussell and Navratil, "SpRay: speculative ray scheduling for large data visualization" (2018),
section 3 and listing 1, have them for their baselines.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank
from simrender.policies.queues import fullest
from simrender.policies.rounds import rounds, visit_all
from simrender.policies.std_sort import descending


@dataclass(frozen=True)
class LoadAnyOnce:
    """Schedule the domain with most queued rays; load it, or send the rays to the rank that has it.

    Parameters
    ----------
    data : "out_of_core", "in_situ" or "global"
        Every rank renders its stripe of the image and loads domains into its cache (SpRay, 3 and 5). Or each domain
        stays with its owner, contiguous blocks in Morton order, and rays travel in bulk-synchronous rounds: every rank
        takes the fullest of its own domains (SpRay, 5). Or the i-th fullest domain of all goes to rank i, which loads
        it, and rays travel as well (Navratil et al.).
    cache : str
        Domains in a rank's cache: a number, a share such as 25%, a size such as 8 GB, or all. Least recently used ones
        make room.
    prefer_cached : bool
        Take the fullest domain in the cache before any other.
    ray_bytes : float
        Size of a ray in a message: 96 B in the authors' program.
    threads : int, optional
        Cores of a rank that trace; all by default. The paper's in situ renderers use one.
    owners : tuple of int, optional
        The rank of each domain in situ; blocks in Morton order by default.
    like_program : bool
        Out of core, of domains with equally many rays take the one that the C++ library sorts first, as the authors'
        program does, and not the lowest.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    data: Literal["out_of_core", "in_situ", "global"] = "out_of_core"
    cache: str | int = "all"
    prefer_cached: bool = False
    ray_bytes: Annotated[float, Field(gt=0)] = 96.0
    threads: Annotated[int, Field(ge=1)] | None = None
    owners: tuple[int, ...] | None = None
    like_program: bool = False

    @property
    def in_situ(self) -> bool:
        """Whether domains stay with their owners."""
        return self.data == "in_situ"

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        me.enqueue(me.camera_rays())
        if self.data == "out_of_core":
            yield from visit_all(me, lambda: self.choose(me))
        else:
            yield from rounds(me, lambda waiting: me.alike(lambda: self.schedule(me, waiting)), self.ray_bytes)
        yield from me.merge_frame()

    def choose(self, me: DomainRank) -> int | None:
        """Choose a domain with most rays (listing 1, line 2)."""
        cached = fullest(me.queues.counts, me.cache.resident) if self.prefer_cached else None
        if cached is None and self.like_program and me.queues.any():
            return descending(me.queues.counts)[0]
        return fullest(me.queues.counts) if cached is None else cached

    def schedule(self, me: DomainRank, waiting: NDArray[np.int64]) -> dict[int, int]:
        """Return the domain of each rank that has one this round: the same on all ranks."""
        if self.data == "in_situ":
            chosen = {rank: fullest(waiting, domains) for rank, domains in enumerate(me.owned_by_rank)}
            return {rank: domain for rank, domain in chosen.items() if domain is not None}
        order = np.argsort(-waiting, kind="stable")[: me.ranks]
        return {rank: int(domain) for rank, domain in enumerate(order) if waiting[domain] > 0}
