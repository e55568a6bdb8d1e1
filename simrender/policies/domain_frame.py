"""What the ranks of a simulation share when rays are scheduled by domain: who has which data, and who has which ray."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.errors import UnitError
from simrender.hardware.cache import DomainCache
from simrender.hardware.collectives import Communicator
from simrender.hardware.machine import Machine
from simrender.rays.crossings import Crossings
from simrender.rays.kinds import CAMERA, SHADOW
from simrender.rays.visits import Visits
from simrender.timeline import Timeline
from simrender.units import BYTES, format_bytes, parse

if TYPE_CHECKING:
    from simrender.policies.domain_rank import DomainRank

Ids = NDArray[np.int64]
Steps = Generator[simpy.Event, Any, Any]


@runtime_checkable
class DomainPolicy(Protocol):
    """A scheduler that decides which rays meet which domain when: a frozen dataclass, its fields its parameters."""

    @property
    def in_situ(self) -> bool:
        """Whether domains stay with the ranks that own them, and rays travel."""

    @property
    def cache(self) -> str | int:
        """How much of the data a rank's domain cache holds; see `domain_cache`."""

    @property
    def threads(self) -> int | None:
        """How many of a processor's cores trace; all by default."""

    @property
    def owners(self) -> tuple[int, ...] | None:
        """The rank of each domain in situ; blocks in Morton order by default."""

    def rank(self, me: DomainRank) -> Steps:
        """Render the frame on one rank."""


@dataclass
class Counters:
    """How much of everything there was, over all ranks; rays are traced ones.

    Attributes
    ----------
    visits, loads : int
        Domains that were scheduled, one rank at a time; those of them that had to be loaded.
    loaded_bytes : float
        As published.
    radiance_tests, shadow_tests : int
        Queries of a ray in a domain.
    steps : int
        Rounds of a bulk-synchronous schedule, or visits of the busiest rank.
    messages, sent_rays : int
    sent_bytes : float
        As published.
    critical_tests : int
        Sum over the steps of the busiest rank's tests.
    rounds : int
        Of a schedule that speculates; of the busiest rank, where each has its own.
    radiance_queued, shadow_queued, radiance_filtered, shadow_filtered : int
        Entries of (ray, domain) in queues that speculate, and those dropped before they were tested.
    rejected_hits, spilled_rays, wrong_rays : int
        Hits behind one that was known; rays that waited for the history buffer; rays that wrong hits spawned.
    tbuf_bytes, obuf_bytes : float
        Of the distance and occlusion buffers that ranks combined, each counted once a time, as published.

    """

    visits: int = 0
    loads: int = 0
    loaded_bytes: float = 0.0
    radiance_tests: int = 0
    shadow_tests: int = 0
    steps: int = 0
    messages: int = 0
    sent_rays: int = 0
    sent_bytes: float = 0.0
    critical_tests: int = 0
    rounds: int = 0
    radiance_queued: int = 0
    shadow_queued: int = 0
    radiance_filtered: int = 0
    shadow_filtered: int = 0
    rejected_hits: int = 0
    spilled_rays: int = 0
    wrong_rays: int = 0
    tbuf_bytes: float = 0.0
    obuf_bytes: float = 0.0


EXPLAINED = 12
"""Steps of which the whole state of the queues is kept, for `--explain schedule`."""


@dataclass(frozen=True)
class Event:
    """One visit of the schedule.

    Attributes
    ----------
    rank, step, domain : int
        Steps count a rank's visits from 0 or, where ranks schedule together, their rounds.
    loaded : bool
    radiance_tests, shadow_tests : int

    """

    rank: int
    step: int
    domain: int
    loaded: bool
    radiance_tests: int
    shadow_tests: int


@dataclass(frozen=True, eq=False)
class Moment:
    """The queues before a step, as figure 2 of SpRay draws them.

    Attributes
    ----------
    rank : int or None
        Whose queues; None for those of all ranks together.
    waiting : int64 array (domains,)
        Rays in each queue.
    scheduled : tuple of int
        The domains that are processed next.

    """

    rank: int | None
    waiting: NDArray[np.int64]
    scheduled: tuple[int, ...]


@dataclass
class DomainFrame:
    """The state that the ranks of one simulation share.

    Attributes
    ----------
    env, machine, crossings, policy, timeline
        What is simulated.
    visits : Visits
        Of all rays, without speculation.
    comm : Communicator
    owner : int64 array (domains,) or None
        The rank that holds each domain; None where every rank loads what it needs.
    rank_of_pixel : int64 array (pixels,)
        Negative where another island renders it.
    caches : list of DomainCache
        Of each rank.
    first_rank : int
        The processor of the first rank; the others follow it.
    weight : float
        Published rays for which a traced ray stands.
    published : (width, height)
    other : DomainFrame or None
        Another island, with which this one shares what there is for each ray, since each ray has one island.

    """

    env: simpy.Environment
    machine: Machine
    crossings: Crossings
    visits: Visits
    policy: DomainPolicy
    timeline: Timeline
    comm: Communicator | None
    owner: NDArray[np.int64] | None
    rank_of_pixel: NDArray[np.int64]
    caches: list[DomainCache]
    weight: float
    published: tuple[int, int]
    first_rank: int = 0
    other: DomainFrame | None = None
    counters: Counters = field(default_factory=Counters)
    events: list[Event] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    retired: list[Ids] = field(default_factory=list)
    outbox: dict[tuple[int, int, int], Ids] = field(default_factory=dict)
    gathered: dict[int, list[NDArray[np.int64]]] = field(default_factory=dict)
    told: dict[int, dict[int, Any]] = field(default_factory=dict)
    shared: dict[tuple[int, int], tuple[Any, int]] = field(default_factory=dict)
    tests_of_step: dict[int, dict[int, int]] = field(default_factory=dict)
    peak_rays: list[int] = field(default_factory=list)
    peak_bytes: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        trace = self.crossings.trace
        self.trace, self.domains = trace, self.crossings.domains
        self.ranks = len(self.caches)
        if self.other is None:
            kind = trace.column("kind")
            self.coherent, self.shadow = kind == CAMERA, kind == SHADOW
            self.position = self.visits.first[:-1].copy()
            """The next visit of each ray."""
        else:
            self.coherent, self.shadow, self.position = self.other.coherent, self.other.shadow, self.other.position
        self.peak_rays = [0] * self.ranks
        self.peak_bytes = [0.0] * self.ranks
        """What a rank's rays, queues and buffers took at most, as published, where the policy counts it."""
        if self.owner is not None:
            self.owned_by_rank = [np.flatnonzero(self.owner == rank) for rank in range(self.ranks)]


def stripes(size: tuple[int, int], ranks: int) -> NDArray[np.int64]:
    """Return the rank of each pixel when each takes a horizontal stripe, from the lowest line up.

    All stripes have as many lines, but the last one, which takes the rest (as SpRay's program cuts its image).

    Parameters
    ----------
    size : (width, height)
    ranks : int

    """
    width, height = size
    up = height - 1 - np.arange(width * height) // width
    lines = height // ranks
    return np.minimum(up // lines, ranks - 1) if lines else np.minimum(up, ranks - 1)


def domain_cache(cache: str | int, nbytes: Sequence[float]) -> DomainCache:
    """Return an empty cache of so many domains, a share of them such as ``25%``, or a size such as ``8 GB``.

    A share is rounded to the nearest whole number of domains; a cache holds one at least.

    Parameters
    ----------
    cache : str or int
    nbytes : sequence of float
        What each domain takes.

    Raises
    ------
    ValueError
        If it is nothing of these, or too small for a domain.

    """
    text, domains = str(cache).strip(), max(1, len(nbytes))
    if text == "all":
        return DomainCache(nbytes, domains)
    if text.endswith("%"):
        share = float(text[:-1])
        if not 0.0 < share <= 100.0:
            raise ValueError(f"expected a share of the domains above 0% and up to 100%, got {cache!r}")
        return DomainCache(nbytes, max(1, round(domains * share / 100.0)))
    if text.isdigit() and int(text) >= 1:
        return DomainCache(nbytes, min(int(text), domains))
    try:
        size = parse(text, BYTES)
    except UnitError:
        size = 0.0
    if size <= 0.0 or text.isdigit():
        raise ValueError(
            f"expected a number of domains from 1 on, a share such as 25%, a size such as 8 GB, or all, got {cache!r}"
        )
    if max(nbytes, default=0.0) > size:
        raise ValueError(f"the largest domain takes {format_bytes(max(nbytes))} with its acceleration structure")
    return DomainCache(nbytes, size, unit="bytes")
