"""Processors: kernels that run one after the other, a memory that cannot be exceeded, and the host that issues them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import simpy
from pydantic import model_validator

from simrender.cards import Bandwidth, Card, Count, Duration, Quantity, RayCount, RayRate, Size
from simrender.clock import to_ticks
from simrender.errors import ScheduleError


class ProcessorCard(Card):
    """One GPU, as the cards of `hardware_models` describe it.

    The rates are those of a ray query against ``rate_primitives`` triangles. `bvh_triangle_bytes` and
    `bvh_instance_bytes` are the constants of the ray queue cycling paper's weight estimate (section 4.1).
    """

    model: str
    ray_tracing_cores: bool
    memory: Size
    reserved_memory: Size
    memory_bandwidth: Bandwidth
    launch_latency: Duration
    coherent_rate: RayRate
    incoherent_rate: RayRate
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


class HostCard(Card):
    """The one thread that issues work to all GPUs of a machine."""

    launch_issue: Duration
    copy_issue: Duration
    readback: Duration


@dataclass(slots=True)
class Processor:
    """A GPU with one stream: a kernel begins when it has been issued and its predecessor is done.

    Attributes
    ----------
    name : str
    card : ProcessorCard
    free_at : int
        The tick at which the last kernel issued so far ends.
    busy_ticks : int
        Sum of all kernels.
    allocated_bytes : float

    """

    name: str
    card: ProcessorCard
    free_at: int = 0
    busy_ticks: int = 0
    allocated_bytes: float = 0.0

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

    def run(self, seconds: float, not_before: int) -> tuple[int, int]:
        """Queue a kernel and return the ticks at which it begins and ends."""
        begin = max(self.free_at, not_before)
        self.free_at = begin + to_ticks(seconds)
        self.busy_ticks += self.free_at - begin
        return begin, self.free_at

    def hold(self, until: int) -> None:
        """Keep the next kernel from starting before a tick: the last one still waits for data it reads."""
        self.free_at = max(self.free_at, until)


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
