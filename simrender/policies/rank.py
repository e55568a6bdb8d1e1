"""What a scheduler may do: the operations of a rank, a GPU with one stream, driven by the machine's host thread.

A policy is a generator a rank. It moves rays, by id; durations come from the devices. The operations are
stream-ordered, as CUDA's are: a kernel or copy begins when its predecessor on the same GPU is done, and `synchronize`
is where the host, and so every rank, waits for all of them.
"""

from __future__ import annotations

import numpy as np
import simpy

from simrender.errors import InvariantError
from simrender.policies.frame import Counts, Frame, RayQueue, Steps
from simrender.rays.trace import Ids
from simrender.timeline import COPIES, KERNELS

GENERATE, TRACE, SHADE, TONEMAP, ASSEMBLE = range(len(KERNELS))
COPY, MERGE = range(len(KERNELS), len(KERNELS + COPIES))

ACCUMULATED_BYTES = 16
"""A pixel of the accumulation buffer: four floats."""
PIXEL_BYTES = 4
"""A finished pixel, RGBA8 (ray queue cycling paper, section 4.8)."""


def _arrival(transfer: simpy.Event) -> int:
    """Return the tick at which a finished transfer's last byte arrived."""
    return int(transfer.value or 0)


class Rank:
    """One GPU, as a policy sees it.

    Attributes
    ----------
    index : int
        Among the ranks of the frame.
    domain : int
        The part of the scene it holds.
    island_size : int
        Ranks of its island, which is also the number of domains.
    left, right : int
        Its neighbours in its island's ring.
    samples : int
        Paths a pixel.

    """

    def __init__(self, frame: Frame, index: int) -> None:
        self._frame, self.index = frame, index
        self._gpu = frame.machine.processor(index)
        self._host = frame.machine.host(frame.machine.node_of(index))
        layout = frame.layout
        self.domain, self.island_size = layout.domain(index), layout.size
        self.left, self.right = layout.left(index), layout.right(index)
        self.samples = frame.trace.samples * frame.repeats
        self._pixels = frame.pixels_of[index]
        self._shifts = 0

    # -- kernels --------------------------------------------------------------------------------------------------

    def no_rays(self) -> RayQueue:
        """Return an empty queue."""
        return self._frame.queue(np.zeros(0, np.int64), self.index)

    def generate(self, sample: int, behind: RayQueue) -> Steps:
        """Write a wave of camera rays, one a pixel of this rank, into the queue behind the rays already there."""
        yield from self._turn()
        frame = self._frame
        rays = frame.trace.camera_rays(sample % frame.trace.samples, self._pixels)
        self._kernel(GENERATE, len(rays) * frame.policy.ray_bytes * frame.weight, len(rays) * frame.weight)
        return self._queue(np.concatenate([behind.ids, rays]) if len(behind) else rays)

    def trace(self, rays: RayQueue) -> Steps:
        """Trace a queue against this rank's domain; shadow rays already known to be occluded are skipped."""
        yield from self._turn()
        begin, end, looking = self._trace(rays)
        self._frame.timeline.add(self.index, TRACE, begin, end, 0.0, looking)
        return rays

    def _trace(self, rays: RayQueue) -> tuple[int, int, float]:
        """Run the trace kernel; return when it begins and ends, and the published rays that really looked for a hit."""
        frame = self._frame
        active = rays.active(frame)
        skipped = rays.incoherent - active
        rays.stage += 1
        frame.tests += rays.coherent + active
        frame.skipped_tests += skipped
        weight = frame.weight
        primitives = float(frame.partition.primitives[self.domain])
        seconds = self._gpu.trace_seconds(rays.coherent * weight, active * weight, primitives)
        # A thread whose ray is done reads it and ends.
        seconds += skipped * weight * frame.policy.ray_bytes / self._gpu.card.memory_bandwidth
        begin, end = self._gpu.run(seconds, self._host.issue_launch())
        return begin, end, (rays.coherent + active) * weight

    def shade(self, rays: RayQueue) -> Steps:
        """Shade the rays, add what they contribute to this rank's pixels, and return the rays they spawn."""
        yield from self._turn()
        frame = self._frame
        if rays.stage != self.island_size and len(rays):
            raise InvariantError(f"rank {self.index} shades rays that saw {rays.stage} of {self.island_size} domains")
        if rays.home != self.index:
            raise InvariantError(f"rank {self.index} shades rays of rank {rays.home}")
        frame.retired.append(rays.ids)
        spawned = self._queue(frame.trace.children(rays.ids))
        nbytes = (len(rays) + len(spawned)) * frame.policy.ray_bytes + len(rays) * ACCUMULATED_BYTES
        self._kernel(SHADE, nbytes * frame.weight, len(rays) * frame.weight)
        return spawned

    def _queue(self, rays: Ids) -> RayQueue:
        """Return rays as a queue of this rank, which must not hold more of them than it has slots."""
        slots = self._frame.policy.slots * len(self._pixels)
        if len(rays) > slots:
            raise InvariantError(f"rank {self.index} has {len(rays)} rays for {slots} queue slots")
        return self._frame.queue(rays, self.index)

    def _turn(self) -> Steps:
        """Let every rank that is at the same point issue its work first.

        The host launches one phase on all GPUs before it goes on to the next (section 4.9).
        """
        yield self._frame.env.timeout(0)

    def _kernel(self, kind: int, nbytes: float, rays: float) -> None:
        """Run a kernel that is bound by the published bytes it moves."""
        begin, end = self._gpu.run(self._gpu.stream_seconds(nbytes), self._host.issue_launch())
        self._frame.timeline.add(self.index, kind, begin, end, nbytes, rays)

    # -- moving rays ----------------------------------------------------------------------------------------------

    def shift(self, rays: RayQueue, to: int) -> Steps:
        """Copy this rank's queue to another rank once its last kernel is done; wait for all; return what arrived here.

        The explicit copy of section 4.6: the copies of all ranks run at once, and the queues are swapped when the host
        has seen them all end.
        """
        frame = self._frame
        if self.island_size == 1:
            return rays
        yield from self._turn()
        issued = self._host.issue_copy()
        begin = max(self._gpu.free_at, issued)
        nbytes = len(rays) * frame.policy.ray_bytes * frame.weight
        copy = frame.machine.copy(self.index, to, nbytes, start=begin)
        frame.outbox[to, self._shifts] = rays
        yield from self.synchronize(copy)
        frame.timeline.add(self.index, COPY, begin, _arrival(copy), nbytes, len(rays) * frame.weight)
        return self._arrived()

    def _arrived(self) -> RayQueue:
        """Return the queue that this shift brought; a neighbour that resumed earlier may have sent the next already."""
        rays = self._frame.outbox.pop((self.index, self._shifts))
        self._shifts += 1
        return rays

    def trace_shifted(self, rays: RayQueue, to: int) -> Steps:
        """Offer a queue to another rank and trace the queue offered to this one, straight out of its owner's memory.

        The implicit copy of section 4.6: the kernel reads the neighbour's rays while it traces them, so it runs until
        both the tracing and the transfer are done. A kernel's reads use a link less well than a copy engine.
        """
        frame = self._frame
        if self.island_size == 1:
            return (yield from self.trace(rays))
        frame.outbox[to, self._shifts] = rays
        yield from self.synchronize()
        rays = self._arrived()
        nbytes = len(rays) * frame.policy.ray_bytes * frame.weight
        begin, end, looking = self._trace(rays)
        read = frame.machine.read(self.left, self.index, nbytes, start=begin)
        yield from self.synchronize(read)
        frame.timeline.add(self.index, TRACE, begin, end, nbytes, looking)
        arrived = _arrival(read)
        if arrived > end:  # the kernel has traced what it has and waits for the rest
            self._gpu.hold(arrived)
            frame.timeline.add(self.index, COPY, end, arrived, 0.0, 0.0)
        return rays

    # -- waiting --------------------------------------------------------------------------------------------------

    def synchronize(self, *events: simpy.Event) -> Steps:
        """Wait until every rank's kernels, and the given copies, are done."""
        yield self._frame.barrier.arrive(self.index, self._done(*events))

    def read_counters(self, rays: RayQueue) -> Steps:
        """Wait for all ranks, let the host read their queue counters, and return them as `Counts`."""
        frame = self._frame
        mine = (len(rays) - rays.shadows, rays.shadows, len(self._pixels))
        all_read = frame.barrier.arrive(self.index, self._done(), mine, frame.machine.read_counters)
        by_rank = yield all_read
        counts = Counts(*(list(column) for column in zip(*by_rank, strict=True)))
        if self.index == 0:
            sizes = np.add(counts.paths, counts.shadows)
            frame.wave_mean += float(sizes.mean())
            frame.wave_excess += float(sizes.max() - sizes.mean())
        return counts

    def read_own_counter(self, rays: RayQueue) -> Steps:
        """Wait for this rank alone, let the host read its queue counter, and return the number of rays."""
        yield self._until(self._gpu.free_at)
        yield self._until(self._host.read_counters(1))
        return len(rays)

    def _done(self, *events: simpy.Event) -> list[simpy.Event]:
        """Return the events that end everything this rank has in flight."""
        if self._gpu.free_at > self._frame.env.now:
            return [*events, self._until(self._gpu.free_at)]
        return list(events)

    def _until(self, tick: int) -> simpy.Event:
        env = self._frame.env
        return env.timeout(max(0, tick - int(env.now)))

    # -- the image ------------------------------------------------------------------------------------------------

    def merge_frame(self) -> Steps:
        """Tone-map this rank's pixels, copy them to rank 0, and let rank 0 put them in order (section 4.8)."""
        yield from self._turn()
        frame = self._frame
        pixels = len(self._pixels) * frame.weight
        self._kernel(TONEMAP, pixels * (ACCUMULATED_BYTES + PIXEL_BYTES), 0.0)
        if frame.layout.ranks > 1:
            yield from self._gather(pixels * PIXEL_BYTES)
        if self.index == 0:
            self._kernel(ASSEMBLE, 2.0 * PIXEL_BYTES * frame.published[0] * frame.published[1], 0.0)
        yield from self.synchronize()

    def _gather(self, nbytes: float) -> Steps:
        frame = self._frame
        if self.index == 0:
            yield from self.synchronize()
            return
        yield from self._turn()
        begin = max(self._gpu.free_at, self._host.issue_copy())
        copy = frame.machine.copy(self.index, 0, nbytes, start=begin)
        yield from self.synchronize(copy)
        frame.timeline.add(self.index, MERGE, begin, _arrival(copy), nbytes, 0.0)
