"""What the ranks of one simulation share: the frame, its ray queues, and the barrier where they meet."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.hardware.machine import Machine
from simrender.policies.islands import Layout, represented_lines
from simrender.rays.kinds import CAMERA, SHADOW
from simrender.rays.partition import Method, Partition
from simrender.rays.trace import Ids, Trace
from simrender.timeline import Timeline

if TYPE_CHECKING:
    from simrender.policies.rank import Rank

Steps = Generator[simpy.Event, Any, Any]


class Policy(Protocol):
    """A scheduler: a frozen dataclass whose fields are its parameters."""

    @property
    def ray_bytes(self) -> float:
        """Size of a ray in a queue."""

    @property
    def replicated(self) -> bool:
        """Whether every rank holds the whole model."""

    @property
    def kernels_read(self) -> bool:
        """Whether kernels read other ranks' memory, and not only copy engines."""

    @property
    def first_domain(self) -> int:
        """How many ranks to the right of its own a ray is traced first."""

    @property
    def slots(self) -> int:
        """How many rays a pixel a queue holds."""

    @property
    def partition(self) -> Method:
        """How objects are dealt to the ranks of an island."""

    @property
    def split_share(self) -> float:
        """The share of all triangles above which an object is split."""

    def buffer_bytes(self, pixels: float) -> dict[str, float]:
        """Return what a rank that renders so many pixels allocates beside the model, by name."""

    def rank(self, me: Rank) -> Steps:
        """Render the frame on one rank."""


@dataclass(frozen=True)
class Counts:
    """The queue counters of all ranks, as the host reads them after a shade step; at traced size.

    Attributes
    ----------
    paths, shadows : list of int
        Rays in each rank's queue that continue a path, and shadow rays.
    pixels : list of int
        Each rank's share of the image.

    """

    paths: list[int]
    shadows: list[int]
    pixels: list[int]

    def any(self) -> bool:
        """Whether any rank still has rays."""
        return any(self.paths) or any(self.shadows)

    def room_for_a_wave(self, slots: int) -> bool:
        """Whether every rank's queue can take a new wave of camera rays beside the rays it holds.

        The rays must fit now, and after the next shade step, in which every path ray may become two.
        """
        return all(
            path + shadow + new <= slots * new and 2 * (path + new) <= slots * new
            for path, shadow, new in zip(self.paths, self.shadows, self.pixels, strict=True)
        )


class RayQueue:
    """Rays that travel together, and how far they have come around the ring.

    Attributes
    ----------
    ids : int64 array
        Rows of the ray table.
    home : int
        The rank whose pixels they belong to.
    stage : int
        How many domains have traced them since they were generated or spawned.

    """

    __slots__ = ("_active", "coherent", "home", "ids", "incoherent", "shadows", "stage")

    def __init__(self, ids: Ids, home: int, kinds: NDArray[np.int64]) -> None:
        self.ids, self.home, self.stage = ids, home, 0
        self.coherent = int(kinds[CAMERA])
        self.incoherent = len(ids) - self.coherent
        self.shadows = int(kinds[SHADOW])
        self._active: list[int] | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def active(self, frame: Frame) -> int:
        """Return how many incoherent rays are still looking at this stage: shadow rays found occluded are not."""
        if self._active is None:
            size = frame.layout.size
            if size == 1 or self.shadows == 0:
                self._active = [self.incoherent] * size
            else:
                visits = np.bincount(frame.visits(self.ids), minlength=size + 1)
                done_before = np.cumsum(visits)[:size]  # rays that need no more than 0, 1, 2 ... domains
                self._active = (self.incoherent - done_before).tolist()
        return self._active[self.stage]


@dataclass
class Frame:
    """The state that the ranks of one simulation share.

    Attributes
    ----------
    env, machine, layout, trace, partition, policy, timeline
        What is simulated.
    visited : callable
        (generation, first domain of each pixel's rays) -> int16 array: how many domains each ray is traced in.
    weight : float
        Published rays of a wave for which a traced ray stands.
    repeats : int
        Published samples a pixel for which a traced one stands: each wave comes so many times.
    published : (width, height)
        Pixels of the published image.
    wave_mean, wave_excess : float
        Of all waves for which the ranks waited for each other: rays of an average queue, and by how many the fullest
        exceeded it.

    """

    env: simpy.Environment
    machine: Machine
    layout: Layout
    trace: Trace
    partition: Partition
    policy: Policy
    timeline: Timeline
    visited: Callable[[int, NDArray[np.int64]], NDArray[np.int16]]
    weight: float
    published: tuple[int, int]
    repeats: int = 1
    outbox: dict[tuple[int, int], RayQueue] = field(default_factory=dict)
    retired: list[Ids] = field(default_factory=list)
    tests: int = 0
    skipped_tests: int = 0
    wave_mean: float = 0.0
    wave_excess: float = 0.0

    def __post_init__(self) -> None:
        self.barrier = Barrier(self.env, self.layout.ranks)
        self._visits: list[NDArray[np.int16]] = []
        self._joined: NDArray[np.int16] = np.zeros(0, np.int16)

    @cached_property
    def owner(self) -> NDArray[np.int64]:
        """The rank that renders each traced pixel."""
        return self.layout.rank_of_line(represented_lines(self.trace.size, self.published[1]))

    @cached_property
    def pixels_of(self) -> list[Ids]:
        """The traced pixels of each rank."""
        order = np.argsort(self.owner, kind="stable")
        counts = np.bincount(self.owner, minlength=self.layout.ranks)
        return np.split(order, np.cumsum(counts)[:-1])

    def visits(self, rays: Ids) -> NDArray[np.int16]:
        """Return how many domains each ray is traced in."""
        while len(self._joined) <= int(rays.max()):
            start = (self.owner + self.policy.first_domain) % self.layout.size
            self._visits.append(self.visited(len(self._visits), start))
            self._joined = np.concatenate(self._visits)
        return self._joined[rays]

    def queue(self, rays: Ids, home: int) -> RayQueue:
        """Return the given rays as a queue of the rank that owns their pixels."""
        return RayQueue(rays, home, self.trace.kinds(rays))


class Barrier:
    """All ranks wait until the last has arrived; each then gets what all of them brought.

    What they brought is handed out when the last arrives, not looked up when a rank goes on: by then a faster one may
    have arrived at the next barrier already.
    """

    def __init__(self, env: simpy.Environment, ranks: int) -> None:
        self._env, self._ranks = env, ranks
        self._begin()

    def _begin(self) -> None:
        self._missing, self._event = self._ranks, self._env.event()
        self._brought: list[Any] = [None] * self._ranks

    def arrive(
        self, rank: int, after: list[simpy.Event], bring: Any = None, closing: Callable[[], simpy.Event] | None = None
    ) -> simpy.Event:
        """Announce a rank that is ready when all the given events have happened; return what it must wait for.

        Parameters
        ----------
        rank : int
        after : list of Event
        bring : object, optional
            The event's value is the list of what each rank brought.
        closing : callable, optional
            Called when the last rank is ready; they all go on when the event that it returns has happened.

        """
        event, brought = self._event, self._brought
        brought[rank] = bring
        waiting = [e for e in after if not e.processed]
        pending = len(waiting)

        def ready(_: simpy.Event | None = None) -> None:
            nonlocal pending
            pending -= 1
            if pending > 0:
                return
            self._missing -= 1
            if self._missing > 0:
                return
            self._begin()
            if closing:
                closing().callbacks.append(lambda _: _succeed(event, brought))
            else:
                event.succeed(brought)

        for each in waiting:
            each.callbacks.append(ready)
        if not waiting:
            ready()
        return event


def _succeed(event: simpy.Event, value: Any) -> None:
    event.succeed(value)
