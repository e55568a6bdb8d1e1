"""What schedulers of domains share: the visit of a domain, and rounds that all ranks plan together."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank

Counts = NDArray[np.int64]
Plan = dict[int, int]
"""The domain of each rank that has one in a round."""

SHADOW, RADIANCE = 0, 1
"""Message tags."""


def visit(me: DomainRank, domain: int) -> Steps:
    """Load a domain and process the rays that wait for it.

    Listing 1 of SpRay (Park, Fussell and Navratil, 2018), lines 3 to 17. Shadow rays, and secondary rays as well, are
    tested in the domain of their birth before they leave it.
    """
    me.begin_visit()
    yield from me.load(domain)
    rays = me.queues.take(domain)
    while len(rays):
        yield from me.trace(domain, rays)
        onward, done = me.advance(rays)
        me.enqueue(onward)
        rays = me.shade(done)
    me.end_visit(domain)


def visit_all(me: DomainRank, choose: Callable[[], int | None]) -> Steps:
    """Visit the domain that is chosen, until none is."""
    while (domain := choose()) is not None:
        me.explain(me.queues.counts, (domain,))
        yield from visit(me, domain)
        me.next_step()


def rounds(me: DomainRank, plan: Callable[[Counts], Plan], ray_bytes: float) -> Steps:
    """Agree on a plan, send the rays to where it says, process them; until no ray waits anywhere.

    SpRay, section 5, as in the authors' program: only rays for the domains that are planned move.

    Parameters
    ----------
    me : DomainRank
    plan : callable
        From the rays that wait for each domain, on all ranks together, to the plan: the same on all ranks.
    ray_bytes : float
        Size of a ray in a message.

    """
    while True:
        waiting = yield from me.allreduce(me.queues.counts)
        if not waiting.any():
            return
        planned = plan(waiting)
        me.explain(waiting, tuple(planned.values()), together=True)
        me.count_step()
        yield from _exchange(me, planned, waiting, ray_bytes)
        if me.index in planned:
            yield from visit(me, planned[me.index])
        yield from me.barrier()
        me.next_step()


def _exchange(me: DomainRank, planned: Plan, waiting: Counts, ray_bytes: float) -> Steps:
    """Send the rays that wait here for the domains of other ranks, and receive those for this rank's own."""
    leaving = []
    for rank, domain in planned.items():
        if rank != me.index and me.queues.counts[domain] > 0:
            shadow, radiance = me.by_kind(me.queues.take(domain))
            for tag, rays in ((SHADOW, shadow), (RADIANCE, radiance)):
                if len(rays):
                    leaving.append(me.send(rank, rays, tag, len(rays) * ray_bytes))
    if me.index in planned:
        domain = planned[me.index]
        me.enqueue((yield from me.receive(int(waiting[domain] - me.queues.counts[domain]))))
    for event in leaving:  # noqa: UP028 - SimPy's events are no generators
        yield event


def deliver(me: DomainRank, holder: Sequence[int] | NDArray[np.int64], ray_bytes: float) -> Steps:
    """Send each ray to the rank that holds its domain, all at once; receive those that others send.

    As GraviT does: every rank tells every other how much comes, two integers, and then sends it in one message.

    Parameters
    ----------
    me : DomainRank
    holder : sequence of int (domains,)
        Of each domain, as this rank sees it; -1 where its rays stay.
    ray_bytes : float
        Size of a ray in a message.

    """
    parcels: dict[int, list[NDArray[np.int64]]] = {}
    for domain in np.flatnonzero(me.queues.counts).tolist():
        rank = int(holder[domain])
        if rank not in (-1, me.index):
            parcels.setdefault(rank, []).append(me.queues.take(domain))
    going = np.zeros(me.ranks, np.int64)
    for rank, parts in parcels.items():
        going[rank] = sum(map(len, parts))
    coming = yield from me.tell_each(going, 8.0)
    leaving = [
        me.send(rank, np.concatenate(parcels[rank]), RADIANCE, float(going[rank]) * ray_bytes)
        for rank in sorted(parcels)
    ]
    me.enqueue((yield from me.receive(int(coming.sum()), RADIANCE)))
    for event in leaving:  # noqa: UP028 - SimPy's events are no generators
        yield event
