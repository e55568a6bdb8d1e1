"""What a scheduler of rays and domains may do: the operations of a rank, the cores of a node or a GPU.

A policy is a generator a rank. It moves rays, by id; durations come from the devices: a domain that is not in the cache
is read, parsed and built into a hierarchy, rays are traced on the rank's processor, and messages cross the network.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.policies.domain_frame import EXPLAINED, DomainFrame, Event, Moment, Steps
from simrender.policies.queues import DomainQueues
from simrender.timeline import COPIES, KERNELS, PHASES

Ids = NDArray[np.int64]
T = TypeVar("T")

TRACE = KERNELS.index("trace")
MERGE = len(KERNELS) + COPIES.index("merge")
COPY = len(KERNELS) + COPIES.index("copy")
LOAD, SYNC = (len(KERNELS) + len(COPIES) + PHASES.index(name) for name in ("load", "sync"))

PIXEL_BYTES = 16
"""A pixel of the image that ranks add up: four floats, as SpRay's program sends them."""

INT_BYTES = 4
"""An integer of the MPI programs."""

GATHER_TAG = -1
"""Of messages that belong to a gather; rays have tags from 0 on."""

COUNT_BYTES = 8
"""A count of rays that ranks add up."""


class DomainRank:
    """One rank, as a policy sees it.

    Attributes
    ----------
    index : int
    ranks : int
        How many there are.
    weight : float
        Published rays for which a traced ray stands.
    queues : DomainQueues
        Its ray batch queues.
    owned : int64 array
        The domains that stay with it; all of them where domains are loaded.

    """

    def __init__(self, frame: DomainFrame, index: int) -> None:
        self._frame, self.index, self.ranks = frame, index, frame.ranks
        self.device, self.weight = frame.first_rank + index, frame.weight
        self._processor = frame.machine.processor(self.device)
        self.queues = DomainQueues(frame.domains.count)
        self.cache = frame.caches[index]
        self.owned = np.arange(frame.domains.count)
        if frame.owner is not None:
            self.owned = np.flatnonzero(frame.owner == index)
        self.comm = None if frame.comm is None else frame.comm.rank(index)
        self.owned_by_rank = [self.owned]
        if frame.owner is not None:
            self.owned_by_rank = frame.owned_by_rank
        self.step = 0
        self._collectives = self._asked = 0

    @property
    def frame(self) -> DomainFrame:
        """What all ranks share."""
        return self._frame

    # -- rays -----------------------------------------------------------------------------------------------------

    def camera_rays(self, *, all_of_them: bool = False) -> Ids:
        """Return the camera rays of this rank's pixels that enter a domain, or all; the others are done."""
        frame = self._frame
        count = frame.trace.first[1]
        mine = np.flatnonzero(frame.rank_of_pixel[frame.trace.column("pixel")[:count]] == self.index)
        if all_of_them:
            return mine
        meets = frame.visits.first[mine + 1] > frame.visits.first[mine]
        self.retire(mine[~meets])
        return mine[meets]

    def enqueue(self, rays: Ids) -> None:
        """Queue rays for the domains of their next visits."""
        self.queues.put(rays, self._frame.visits.domain[self._frame.position[rays]])
        frame = self._frame
        frame.peak_rays[self.index] = max(frame.peak_rays[self.index], int(self.queues.counts.sum()))

    def advance(self, rays: Ids) -> tuple[Ids, Ids]:
        """Take rays past the visit they just made; return those that go on to another domain, and those that end."""
        frame = self._frame
        frame.position[rays] += 1
        goes_on = frame.position[rays] < frame.visits.last[rays]
        return rays[goes_on], rays[~goes_on]

    def by_kind(self, rays: Ids) -> tuple[Ids, Ids]:
        """Return the shadow rays and the radiance rays among some rays."""
        shadow = self._frame.shadow[rays]
        return rays[shadow], rays[~shadow]

    def shade(self, rays: Ids) -> Ids:
        """Shade rays that are done, add what they bring to the image, and return those that they spawn."""
        self.retire(rays)
        return self._frame.trace.children(rays)

    def retire(self, rays: Ids) -> None:
        """Add what rays contribute to the image."""
        if len(rays):
            self._frame.retired.append(rays)

    # -- the processor and the data -------------------------------------------------------------------------------

    def load(self, domain: int) -> Steps:
        """Have a domain in memory: take it from the cache, or read, parse and build it."""
        frame = self._frame
        frame.counters.visits += 1
        self._loaded = False
        if frame.owner is not None or self.cache.touch(domain):
            return
        self.cache.load(domain)
        self._loaded = True
        begin = int(frame.env.now)
        nbytes, primitives = float(frame.domains.bytes[domain]), float(frame.domains.primitives[domain])
        yield from frame.machine.load(self.device, nbytes, primitives)
        frame.counters.loads += 1
        frame.counters.loaded_bytes += nbytes
        frame.timeline.add(self.device, LOAD, begin, int(frame.env.now), nbytes, 0.0)

    def trace(self, domain: int, rays: Ids) -> Steps:
        """Query a domain for the hits of radiance rays and the occlusion of shadow rays."""
        frame = self._frame
        position = frame.position[rays]
        # A ray that comes back to be shaded tests nothing.
        asks = ~(frame.visits.returns[rays] & (position + 1 == frame.visits.last[rays]))
        asking = rays[asks]
        shadow, coherent = int(frame.shadow[asking].sum()), int(frame.coherent[asking].sum())
        incoherent = len(asking) - coherent
        yield from self.compute(domain, coherent, incoherent)
        frame.counters.shadow_tests += shadow
        frame.counters.radiance_tests += len(asking) - shadow
        self._tests[0] += len(asking) - shadow
        self._tests[1] += shadow

    def query(self, domain: int, camera: int, radiance: int, shadow: int) -> Steps:
        """Query a domain for so many radiance rays, ``camera`` of them camera rays, and so many shadow rays."""
        yield from self.compute(domain, camera, radiance - camera + shadow)
        self._frame.counters.radiance_tests += radiance
        self._frame.counters.shadow_tests += shadow
        self._tests[0] += radiance
        self._tests[1] += shadow

    def compute(self, domain: int, coherent: float, incoherent: float) -> Steps:
        """Run a trace kernel over a domain; rays are traced ones."""
        yield from self._run(float(self._frame.domains.primitives[domain]), coherent, incoherent)

    def trace_all(self, rays: Ids) -> Steps:
        """Query all that this rank holds, as one hierarchy, for rays, whatever they enter."""
        frame = self._frame
        primitives = float(frame.domains.primitives[self.owned].sum())
        frame.peak_rays[self.index] = max(frame.peak_rays[self.index], len(rays))
        if len(rays) == 0 or primitives == 0.0:
            return
        shadow, coherent = int(frame.shadow[rays].sum()), int(frame.coherent[rays].sum())
        yield from self._run(primitives, coherent, len(rays) - coherent)
        frame.counters.shadow_tests += shadow
        frame.counters.radiance_tests += len(rays) - shadow

    def _run(self, primitives: float, coherent: float, incoherent: float) -> Steps:
        frame = self._frame
        weight = frame.weight
        seconds = self._processor.trace_seconds(coherent * weight, incoherent * weight, primitives)
        cores = getattr(self._processor.card, "cores", None)
        if frame.policy.threads and cores:
            seconds *= cores / min(frame.policy.threads, cores)
        begin, end = self._processor.run(seconds, int(frame.env.now))
        yield frame.env.timeout(end - int(frame.env.now))
        frame.timeline.add(self.device, TRACE, begin, end, 0.0, (coherent + incoherent) * weight)

    def explain(self, waiting: NDArray[np.int64], scheduled: tuple[int, ...], *, together: bool = False) -> None:
        """Keep the state of the queues before one of the first steps."""
        if self.step < EXPLAINED and (self.index == 0 or not together):
            self._frame.moments.append(Moment(None if together else self.index, waiting.copy(), scheduled))

    def begin_visit(self) -> None:
        """Begin to count a visit's tests."""
        self._tests = [0, 0]

    def end_visit(self, domain: int) -> None:
        """Log a visit."""
        self._frame.events.append(Event(self.index, self.step, domain, self._loaded, *self._tests))

    def count_step(self) -> None:
        """Count a step that all ranks take together."""
        if self.index == 0:
            self._frame.counters.steps += 1

    def next_step(self) -> None:
        """Go on to the next step."""
        self.step += 1

    # -- other ranks ----------------------------------------------------------------------------------------------

    def allreduce(self, counts: NDArray[np.int64]) -> Steps:
        """Add up counts over all ranks."""
        frame = self._frame
        if self.comm is None:
            return counts
        call, self._asked = self._collectives, 0
        self._collectives += 1
        frame.gathered.setdefault(call, []).append(counts.copy())
        begin = int(frame.env.now)
        yield self.comm.allreduce(float(COUNT_BYTES * len(counts)))
        frame.timeline.add(self.device, SYNC, begin, int(frame.env.now), 0.0, 0.0)
        return self.alike(lambda: np.sum(frame.gathered.pop(call), axis=0))

    def alike(self, compute: Callable[[], T]) -> T:
        """Return what every rank would compute alike since the last collective, computed by the first that asks."""
        shared, key = self._frame.shared, (self._collectives, self._asked)
        self._asked += 1
        if key not in shared:
            shared[key] = compute(), 0
        value, asked = shared[key]
        shared[key] = value, asked + 1
        if asked + 1 == self.ranks:
            del shared[key]
        return cast("T", value)

    def send(self, target: int, rays: Ids, tag: int, nbytes: float) -> simpy.Event:
        """Send rays to another rank; done when they have left."""
        frame = self._frame
        assert self.comm is not None  # noqa: S101 - there is another rank
        frame.outbox[self.index, target, tag] = rays
        frame.counters.messages += 1
        frame.counters.sent_rays += len(rays)
        frame.counters.sent_bytes += nbytes * frame.weight
        return self.comm.isend(target, nbytes * frame.weight, tag)

    def post(self, targets: Ids, rays: Ids, ray_bytes: float, header_bytes: float, grouped: bool) -> list[simpy.Event]:
        """Send so many rays to each of the targets, with a header; each event is done when some of them have left.

        Grouped, messages to one rank that the library treats alike travel together (`Rank.isend_trains`).
        """
        counters = self._frame.counters
        nbytes: NDArray[np.float64] = np.float64(ray_bytes * self._frame.weight) * rays + header_bytes
        if not len(rays):
            return []
        assert self.comm is not None  # noqa: S101 - there is another rank
        counters.messages += len(rays)
        counters.sent_rays += int(rays.sum())
        counters.sent_bytes += float(nbytes.sum())
        if grouped:
            return self.comm.isend_trains(targets, nbytes)
        return [self.comm.isend(*message) for message in zip(targets.tolist(), nbytes.tolist(), strict=True)]

    def collect(self, messages: int, rays: int) -> Steps:
        """Wait for so many messages with so many rays."""
        frame, begin = self._frame, int(self._frame.env.now)
        left = messages
        while left:
            assert self.comm is not None  # noqa: S101 - there is another rank
            left -= (yield self.comm.irecv()).messages
        if messages:
            frame.timeline.add(self.device, COPY, begin, int(frame.env.now), 0.0, rays * frame.weight)

    def combine(self, nbytes: float) -> Steps:
        """Combine a buffer of all ranks, element by element, once all have come."""
        frame = self._frame
        if self.comm is not None:
            yield from self.barrier()
            begin = int(frame.env.now)
            self._collectives, self._asked = self._collectives + 1, 0
            yield self.comm.allreduce(nbytes)
            frame.timeline.add(self.device, SYNC, begin, int(frame.env.now), 0.0, 0.0)

    def receive(self, rays: int, tag: int | None = None) -> Steps:
        """Wait for messages, those with a tag if one is given, until so many rays have come; return them."""
        frame, begin = self._frame, int(self._frame.env.now)
        got = [np.zeros(0, np.int64)]
        while sum(map(len, got)) < rays:
            got.append((yield from self.next_message(tag))[2])
        found = np.concatenate(got)
        frame.timeline.add(self.device, COPY, begin, int(frame.env.now), 0.0, len(found) * frame.weight)
        if len(found) != rays:
            raise InvariantError(f"rank {self.index} got {len(found)} rays and expected {rays}")
        return found

    def next_message(self, tag: int | None = None) -> Steps:
        """Wait for a message, with a tag if one is given; return (source, tag, rays)."""
        assert self.comm is not None  # noqa: S101 - there is another rank
        message = yield self.comm.irecv(tag=tag)
        return message.source, message.tag, self._frame.outbox.pop((message.source, self.index, message.tag))

    def gather(self, value: object, nbytes: float) -> Steps:
        """Give rank 0 what all ranks have to say, a list by rank: first how long it is, then that; None to the others.

        Parameters
        ----------
        value : object
        nbytes : float
            Its size.

        """
        told, begin = self._tell(value), int(self._frame.env.now)
        if self.comm is not None:
            yield self.comm.gather(float(INT_BYTES))
            if self.index > 0:
                yield self.comm.isend(0, nbytes, GATHER_TAG)
            else:
                for source in range(1, self.ranks):
                    yield self.comm.irecv(source, GATHER_TAG)
            self._frame.timeline.add(self.device, SYNC, begin, int(self._frame.env.now), 0.0, 0.0)
        return [told[rank] for rank in range(self.ranks)] if self.index == 0 else None

    def broadcast(self, value: T | None, nbytes: float) -> Steps:
        """Give all ranks what rank 0 says."""
        told, begin = self._tell(value), int(self._frame.env.now)
        if self.comm is not None:
            yield self.comm.bcast(nbytes)
            self._frame.timeline.add(self.device, SYNC, begin, int(self._frame.env.now), 0.0, 0.0)
        return told[0]

    def tell_each(self, counts: NDArray[np.int64], nbytes: float) -> Steps:
        """Tell each rank its count, in so many bytes; return what each rank told this one, int64 (ranks,)."""
        told, begin = self._tell(counts), int(self._frame.env.now)
        if self.comm is not None:
            yield self.comm.alltoall(nbytes)
            self._frame.timeline.add(self.device, SYNC, begin, int(self._frame.env.now), 0.0, 0.0)
        return np.array([told[rank][self.index] for rank in range(self.ranks)], np.int64)

    def any(self, *, mine: bool) -> Steps:
        """Ask rank 0 whether something holds on any rank: a flag from each, and the answer to each."""
        told, begin = self._tell(mine), int(self._frame.env.now)
        if self.comm is not None:
            yield self.comm.gather(float(INT_BYTES))
            yield self.comm.bcast(float(INT_BYTES))
            self._frame.timeline.add(self.device, SYNC, begin, int(self._frame.env.now), 0.0, 0.0)
        return any(told.values())

    def _tell(self, value: object) -> dict[int, Any]:
        """Say something in a collective; return what all ranks say in it, as far as they have."""
        told = self._frame.told.setdefault(self._collectives, {})
        told[self.index] = value
        if len(told) == self.ranks:  # those who take part hold on to it
            del self._frame.told[self._collectives]
        self._collectives += 1
        self._asked = 0
        return told

    def barrier(self) -> Steps:
        """Wait for all ranks; that is time lost to imbalance, and counts as waiting."""
        if self.comm is not None:
            yield self.comm.barrier()

    def merge_frame(self) -> Steps:
        """Add up the images of all ranks of an island on its first, which sends its scan lines to the very first."""
        frame = self._frame
        nbytes = float(PIXEL_BYTES * frame.published[0] * frame.published[1])
        nbytes *= float((frame.rank_of_pixel >= 0).mean())
        begin = int(frame.env.now)
        if self.comm is not None:
            yield from self.barrier()
            begin = int(frame.env.now)
            yield self.comm.reduce(nbytes)
        if self.index == 0 and frame.first_rank > 0:
            yield frame.machine.copy(self.device, 0, nbytes)
        if int(frame.env.now) > begin:
            frame.timeline.add(self.device, MERGE, begin, int(frame.env.now), nbytes, 0.0)
