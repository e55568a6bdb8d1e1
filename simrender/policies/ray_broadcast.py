"""Ray broadcast: every rank traces every ray in its part of the scene, and the ray's owner takes the nearest hit.

The data may lie anywhere: no ray needs to know where. Each rank generates, shades and retires the rays of its stripe of
the image; state and image never leave it.

- Kato and Saito, "Kilauea: parallel global illumination renderer" (EGPGV 2002), as Park, Fussell and Navratil, "SpRay:
  speculative ray scheduling for large data visualization" (2018), section 2, describe it: an owner waits until every
  rank has answered for its rays, whatever the others do meanwhile.
- The barney renderer's all-to-all mode: all ranks go from one generation of rays to the next together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
import simpy
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank

Ids = NDArray[np.int64]

RAYS, HITS, FINISHED = 0, 1, 2
"""Message tags."""


@dataclass(frozen=True)
class RayBroadcast:
    """Send each ray to all other ranks, and get a hit back from each.

    What a rank holds is one hierarchy, so a ray makes one query on each rank that holds anything. Hits on their way
    back count as rays that were sent.

    Parameters
    ----------
    wait : "owner" or "all"
        Each owner waits for the answers to its own rays, as in Kilauea; or all ranks wait for each other, as in barney.
    ray_bytes, hit_bytes : float
        Of a ray on its way out and of its hit on the way back: 32 and 64 B in barney.
    threads : int, optional
        Cores of a rank that trace; all by default.
    owners : tuple of int, optional
        The rank of each domain; blocks in Morton order by default.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    wait: Literal["owner", "all"] = "owner"
    ray_bytes: Annotated[float, Field(gt=0)] = 32.0
    hit_bytes: Annotated[float, Field(gt=0)] = 64.0
    threads: Annotated[int, Field(ge=1)] | None = None
    owners: tuple[int, ...] | None = None

    in_situ: ClassVar[bool] = True
    cache: ClassVar[str] = "all"

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        yield from self.each_alone(me) if self.wait == "owner" else self.all_together(me)
        yield from me.merge_frame()

    def each_alone(self, me: DomainRank) -> Steps:
        """Ask for one's own rays, and answer for those of others as they come."""
        rays = me.camera_rays(all_of_them=True)
        working = me.ranks - 1
        leaving: list[simpy.Event] = []
        while len(rays) > 0:
            leaving += self.to_all(me, RAYS, rays, self.ray_bytes)
            yield from me.trace_all(rays)
            answers = 0
            while answers < me.ranks - 1:
                tag = yield from self.serve(me, leaving)
                answers += tag == HITS
                working -= tag == FINISHED
            rays = me.shade(rays)
        leaving += self.to_all(me, FINISHED, rays, 0.0)
        while working > 0:
            working -= (yield from self.serve(me, leaving)) == FINISHED
        for event in leaving:  # noqa: UP028 - SimPy's events are no generators
            yield event

    def serve(self, me: DomainRank, leaving: list[simpy.Event]) -> Steps:
        """Take the next message and, if there are rays in it, answer it; return its tag."""
        source, tag, rays = yield from me.next_message()
        if tag == RAYS:
            yield from me.trace_all(rays)
            leaving.append(me.send(source, rays, HITS, len(rays) * self.hit_bytes))
        return tag

    def all_together(self, me: DomainRank) -> Steps:
        """Go through the generations of rays in step: counts, rays, hits."""
        rays = me.camera_rays(all_of_them=True)
        while (yield from me.allreduce(np.array([len(rays)]))).any():
            me.count_step()
            counts = yield from me.tell_each(np.full(me.ranks, len(rays)), 4.0)
            leaving = self.to_all(me, RAYS, rays, self.ray_bytes) if len(rays) else []
            parcels = [(me.index, rays)]
            for _ in range(np.count_nonzero(counts) - (len(rays) > 0)):
                source, _, arrived = yield from me.next_message(RAYS)
                parcels.append((source, arrived))
            yield from me.trace_all(np.concatenate([arrived for _, arrived in parcels]))
            for source, arrived in parcels[1:]:
                leaving.append(me.send(source, arrived, HITS, len(arrived) * self.hit_bytes))
            for _ in range(me.ranks - 1 if len(rays) else 0):
                yield from me.next_message(HITS)
            for event in leaving:  # noqa: UP028 - SimPy's events are no generators
                yield event
            rays = me.shade(rays)
            me.next_step()

    def to_all(self, me: DomainRank, tag: int, rays: Ids, ray_bytes: float) -> list[simpy.Event]:
        """Send the same rays to every other rank, the next one first."""
        others = [(me.index + step) % me.ranks for step in range(1, me.ranks)]
        return [me.send(rank, rays, tag, len(rays) * ray_bytes) for rank in others]
