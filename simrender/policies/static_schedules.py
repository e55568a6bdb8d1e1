"""The two static schedules: only the data moves, or only the rays do.

The ends of the spectrum in Navratil et al., "Exploring the spectrum of dynamic scheduling algorithms for scalable
distributed-memory ray tracing" (2014), as the GraviT library, written by the same group, has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import ConfigDict, Field

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank
from simrender.policies.queues import fullest
from simrender.policies.rounds import deliver, visit_all


@dataclass(frozen=True)
class ImageSchedule:
    """Each rank renders its stripe of the image and loads what its rays ask for, the domain with most of them first.

    A domain that was loaded is kept, and of domains with equally many rays the lowest is first.

    Parameters
    ----------
    threads : int, optional
        Cores of a rank that trace; all by default.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    threads: Annotated[int, Field(ge=1)] | None = None

    in_situ: ClassVar[bool] = False
    cache: ClassVar[str] = "all"
    owners: ClassVar[None] = None

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        me.enqueue(me.camera_rays())
        yield from visit_all(me, lambda: fullest(me.queues.counts))
        yield from me.merge_frame()


@dataclass(frozen=True)
class DomainSchedule:
    """Each domain stays with a rank, which processes its domains until no ray is left for them; then all exchange rays.

    Parameters
    ----------
    ray_bytes : float
        Size of a ray in a message: 80 B in GraviT.
    threads : int, optional
        Cores of a rank that trace; all by default.
    owners : tuple of int, optional
        The rank of each domain; blocks in Morton order by default.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    ray_bytes: Annotated[float, Field(gt=0)] = 80.0
    threads: Annotated[int, Field(ge=1)] | None = None
    owners: tuple[int, ...] | None = None

    in_situ: ClassVar[bool] = True
    cache: ClassVar[str] = "all"

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        owner = me.frame.owner
        assert owner is not None  # noqa: S101 - domains stay with ranks
        me.enqueue(me.camera_rays())
        while True:
            me.count_step()
            yield from visit_all(me, lambda: fullest(me.queues.counts, me.owned))
            yield from deliver(me, owner, self.ray_bytes)
            if not (yield from me.any(mine=me.queues.any())):
                break
        yield from me.merge_frame()
