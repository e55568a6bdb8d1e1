"""Processors: kernels and copies, a memory that cannot be exceeded, and the host that issues the work."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import Any, cast

import simpy
from pydantic import Field, model_validator

from simrender.cards import Bandwidth, Card, Count, Duration, PrimitiveRate, Quantity, RayCount, RayRate, Size
from simrender.clock import to_ticks
from simrender.errors import ScheduleError


class ProcessorCard(Card):
    """What traces rays: a GPU, or all cores of a node together.

    The rates are those of a ray query against ``rate_primitives`` triangles. `bvh_triangle_bytes` and
    `bvh_instance_bytes` are the constants of the ray queue cycling paper's weight estimate (section 4.1).
    """

    model: str
    memory: Size
    reserved_memory: Size
    memory_bandwidth: Bandwidth
    launch_latency: Duration
    rate_primitives: Count
    half_saturation: RayCount
    bvh_triangle_bytes: Size
    bvh_instance_bytes: Size

    def memory_quantities(self, prefix: str) -> list[tuple[str, Quantity]]:
        """Return the quantities that decide what fits, with their paths."""
        names = ("memory", "reserved_memory", "bvh_triangle_bytes", "bvh_instance_bytes")
        return [(f"{prefix}{name}", getattr(self, name)) for name in names]

    @model_validator(mode="after")
    def _leaves_memory(self) -> ProcessorCard:
        if self.reserved_memory >= self.memory:
            raise ValueError(
                f"reserved_memory ({self.reserved_memory.text}) leaves nothing of memory ({self.memory.text})"
            )
        return self


class GpuCard(ProcessorCard):
    """One GPU.

    Attributes
    ----------
    copy_engines : int
        Copies that can be under way at once, beside the kernels.
    build_rate : quantity, optional
        Triangles a second that go into an acceleration structure.

    """

    ray_tracing_cores: bool
    coherent_rate: RayRate
    incoherent_rate: RayRate
    copy_engines: int = Field(default=2, ge=1, strict=True)
    build_rate: PrimitiveRate | None = None


class CpuCard(ProcessorCard):
    """The processors of one node, whose cores work on everything together.

    Attributes
    ----------
    sockets, cores : int
        Of the node; the cores of all its sockets.
    core_coherent_rate, core_incoherent_rate, core_parse_bandwidth, core_build_rate : quantities
        Of one core while all of them work.

    """

    sockets: int = Field(ge=1, strict=True)
    cores: int = Field(ge=1, strict=True)
    core_coherent_rate: RayRate
    core_incoherent_rate: RayRate
    core_parse_bandwidth: Bandwidth
    core_build_rate: PrimitiveRate

    @property
    def coherent_rate(self) -> float:
        """Camera rays a second on all cores."""
        return self.cores * self.core_coherent_rate

    @property
    def incoherent_rate(self) -> float:
        """Secondary rays a second on all cores."""
        return self.cores * self.core_incoherent_rate

    @property
    def parse_bandwidth(self) -> float:
        """Bytes a second of a scene file that all cores turn into triangles."""
        return self.cores * self.core_parse_bandwidth

    @property
    def build_rate(self) -> float:
        """Triangles a second that go into an acceleration structure."""
        return self.cores * self.core_build_rate


class HostCard(Card):
    """The thread of a node that issues work to its GPUs, and the way between its memory and theirs.

    Attributes
    ----------
    launch_issue, copy_issue : quantities
        How long it takes to issue a kernel or a copy.
    readback : quantity
        To wait for a GPU and read a counter from it.
    to_device, from_device : quantities, optional
        Bandwidth of a copy between pinned host memory and a GPU.
    copy_latency : quantity
        Of such a copy, until its first byte.

    """

    launch_issue: Duration
    copy_issue: Duration
    readback: Duration
    to_device: Bandwidth | None = None
    from_device: Bandwidth | None = None
    copy_latency: Duration = Quantity(0.0, "0 s")


class CopyEngine:
    """A GPU's engine for copies, which run one after the other and beside the kernels.

    Attributes
    ----------
    waiting : int
        Copies submitted so far that are not done.

    """

    def __init__(self, env: simpy.Environment) -> None:
        self._env = env
        self._last: simpy.Event | None = None
        self.waiting = 0

    def submit(self, begin: Callable[[int], simpy.Event], not_before: int) -> simpy.Event:
        """Run a copy when the one before is done; return what happens when it has arrived.

        Parameters
        ----------
        begin : callable
            Starts the copy at a tick and returns its event.
        not_before : int
            The earliest tick.

        """
        if not self.waiting:
            self._last = begin(not_before)
        else:
            self._last = self._env.process(self._after(cast("simpy.Event", self._last), begin, not_before))
        self.waiting += 1
        assert self._last.callbacks is not None  # noqa: S101 - it lies in the future
        self._last.callbacks.append(self._finish)
        return self._last

    def _finish(self, _: simpy.Event) -> None:
        self.waiting -= 1

    def _after(
        self, previous: simpy.Event, begin: Callable[[int], simpy.Event], not_before: int
    ) -> Generator[simpy.Event, Any, Any]:
        yield previous
        return (yield begin(max(not_before, int(self._env.now))))


class Processor:
    """A GPU, or the cores of a node: kernels run one after the other, in one stream or in several.

    A kernel begins when it has been issued, its predecessor in its stream is done and no other kernel runs: a kernel
    that traces rays fills the processor, so streams let kernels overlap with copies and not with each other.

    Parameters
    ----------
    name : str
    card : GpuCard or CpuCard
    slowness : float
        By which every duration is multiplied: nodes differ.

    Attributes
    ----------
    free_at : int
        The tick at which the last kernel issued so far ends.
    busy_ticks : int
        Sum of all kernels.
    allocated_bytes : float

    """

    def __init__(self, name: str, card: GpuCard | CpuCard, slowness: float = 1.0) -> None:
        self.name, self.card, self.slowness = name, card, slowness
        self.free_at = 0
        self.busy_ticks = 0
        self.allocated_bytes = 0.0
        self._streams: dict[int, int] = {}

    @property
    def capacity_bytes(self) -> float:
        """What a program can allocate."""
        return self.card.memory - self.card.reserved_memory

    def allocate(self, what: str, nbytes: float) -> None:
        """Take memory.

        Raises
        ------
        ScheduleError
            If there is not that much left.

        """
        self.allocated_bytes += nbytes
        if self.allocated_bytes > self.capacity_bytes:
            needed = f"{self.allocated_bytes:.0f} B of {self.capacity_bytes:.0f} B"
            raise ScheduleError(f"{self.name}: allocating {what} takes {needed}")

    def trace_seconds(self, coherent: float, incoherent: float, primitives: float) -> float:
        """Return how long a trace kernel runs.

        Launch latency plus (rays + half-saturation rays) x cost of a ray. The cost grows with the logarithm of the
        primitives searched, which is the idealised renderer of the islands paper (figure 7); the half-saturation rays
        are how many it takes to run at half of the peak rate (Hockney's n-half), counted at the cost of the slowest
        kind there is.

        Parameters
        ----------
        coherent, incoherent : float
            Rays of each kind; real ones, so not necessarily whole.
        primitives : float
            Triangles, with instances written out, that the rays are traced against.

        """
        card = self.card
        if coherent + incoherent == 0 or primitives == 0:
            return float(card.launch_latency)
        depth = math.log2(1.0 + primitives) / math.log2(1.0 + card.rate_primitives)
        slowest = card.incoherent_rate if incoherent else card.coherent_rate
        work = coherent / card.coherent_rate + incoherent / card.incoherent_rate + card.half_saturation / slowest
        return card.launch_latency + depth * work

    def stream_seconds(self, nbytes: float) -> float:
        """Return how long a kernel runs that is bound by the memory it reads and writes."""
        return self.card.launch_latency + nbytes / self.card.memory_bandwidth

    def run(self, seconds: float, not_before: int, stream: int = 0) -> tuple[int, int]:
        """Queue a kernel and return the ticks at which it begins and ends."""
        begin = max(self.free_at, self._streams.get(stream, 0), not_before)
        self.free_at = self._streams[stream] = begin + to_ticks(seconds * self.slowness)
        self.busy_ticks += self.free_at - begin
        return begin, self.free_at

    def hold(self, until: int, stream: int | None = None) -> None:
        """Keep the next kernel, of one stream or of all, from starting before a tick: its data are on their way."""
        if stream is None:
            self.free_at = max(self.free_at, until)
        else:
            self._streams[stream] = max(self._streams.get(stream, 0), until)


class Host:
    """The thread that drives all GPUs: it issues one launch or copy after the other.

    Sixteen launches cost sixteen times the issue time before the last of them can start, which is what makes many small
    waves expensive (ray queue cycling paper, section 4.10).
    """

    def __init__(self, env: simpy.Environment, card: HostCard) -> None:
        self._env, self.card = env, card
        self._free_at = 0
        self._launch, self._copy = to_ticks(card.launch_issue), to_ticks(card.copy_issue)
        self._readback = to_ticks(card.readback)

    def issue_launch(self) -> int:
        """Issue a kernel; return the tick at which the GPU has it."""
        return self._work(self._launch)

    def issue_copy(self) -> int:
        """Issue a copy; return the tick at which the GPU has it."""
        return self._work(self._copy)

    def read_counters(self, count: int) -> int:
        """Read a counter from each of ``count`` GPUs; return the tick at which the last one has arrived."""
        return self._work(count * self._readback)

    def _work(self, ticks: int) -> int:
        self._free_at = max(self._free_at, int(self._env.now)) + ticks
        return self._free_at
