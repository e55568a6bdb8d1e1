"""Storage: files read over the network, domains loaded from them, and blocks fetched from other ranks' memory."""

from __future__ import annotations

import math
from collections.abc import Generator, Hashable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol, cast

import simpy
from pydantic import Field, model_validator

from simrender.cards import Bandwidth, Card, Duration, Size
from simrender.clock import to_ticks
from simrender.errors import ScheduleError, UsageError, did_you_mean
from simrender.hardware.cache import HIT, MISS, NODE_BLOCK_BYTES, RESIDENT
from simrender.hardware.network import Link, Network
from simrender.units import format_bytes

if TYPE_CHECKING:
    from simrender.hardware.cache import DirectMappedCache

Where = Literal["shared", "local"]
_PLACES: Final = {"shared": "parallel file system", "local": "local disk"}


class ParallelFileSystemCard(Card):
    """A file system that all nodes share, such as Lustre: servers with storage targets, over which files are striped.

    Attributes
    ----------
    server_bandwidth : quantity
        Of all servers together.
    targets : int
        Storage targets (Lustre's OSTs).
    target_bandwidth : quantity
        What one stream gets from one target.
    client_bandwidth : quantity
        The most that one node gets.
    open_latency : quantity
        From opening a file to its first byte.
    stripe : quantity
        Bytes that lie on one target before the next one's turn.
    stripe_count : int
        Targets that a file is spread over, unless a program says otherwise.

    """

    server_bandwidth: Bandwidth
    targets: int = Field(ge=1, strict=True)
    target_bandwidth: Bandwidth
    client_bandwidth: Bandwidth
    open_latency: Duration
    stripe: Size
    stripe_count: int = Field(ge=1, strict=True)

    @model_validator(mode="after")
    def _stripes(self) -> ParallelFileSystemCard:
        if not self.stripe:
            raise ValueError(f"a stripe must be larger than nothing, got {self.stripe.text}")
        if self.stripe_count > self.targets:
            raise ValueError(f"stripe_count ({self.stripe_count}) is more than there are targets ({self.targets})")
        return self


class DiskCard(Card):
    """A disk of its own in each node; `latency` is from opening a file to its first byte."""

    bandwidth: Bandwidth
    latency: Duration
    capacity: Size


class StorageCard(Card):
    """Where a machine keeps its files: a parallel file system, a disk in each node, or both."""

    shared: ParallelFileSystemCard | None = None
    local: DiskCard | None = None

    @model_validator(mode="after")
    def _somewhere(self) -> StorageCard:
        if self.shared is None and self.local is None:
            raise ValueError("storage has at least one of the sections shared and local")
        return self


def storage_links(card: StorageCard, nodes: int) -> dict[Hashable, Link]:
    """Return the links of a network that files are read over.

    A route from ``"storage"`` takes ``storage`` and the node's ``node3.client``; one from ``("disk", 3)`` takes
    ``node3.disk``. They have no latency: a read pays it once, when it opens the file.

    Parameters
    ----------
    card : StorageCard
    nodes : int

    """
    links: dict[Hashable, Link] = {}
    if shared := card.shared:
        links["storage"] = Link(shared.server_bandwidth)
        links |= {f"node{node}.client": Link(shared.client_bandwidth) for node in range(nodes)}
    if local := card.local:
        links |= {f"node{node}.disk": Link(local.bandwidth) for node in range(nodes)}
    return links


class Kernels(Protocol):
    """What parses files or builds acceleration structures: a `simrender.hardware.processor.Processor`."""

    def run(self, seconds: float, not_before: int) -> tuple[int, int]:
        """Queue a kernel and return the ticks at which it begins and ends."""


@dataclass(frozen=True, slots=True)
class LoadTimes:
    """When a domain was loaded: the ticks at which each phase was over.

    Attributes
    ----------
    began, opened, read : int
        When the file began to be opened, was open, and had arrived in the host's memory.
    parsing, parsed : int
        When the processor of the host had time to parse it, and had parsed it.
    copied, building, built : int
        When it was in the memory of what traces rays, which had time for it, and had built the acceleration structure.

    """

    began: int
    opened: int
    read: int
    parsing: int
    parsed: int
    copied: int
    building: int
    built: int

    @property
    def open_ticks(self) -> int:
        """Opening the file."""
        return self.opened - self.began

    @property
    def read_ticks(self) -> int:
        """Moving its bytes."""
        return self.read - self.opened

    @property
    def wait_ticks(self) -> int:
        """Waiting for processors that were busy."""
        return self.parsing - self.read + self.building - self.copied

    @property
    def parse_ticks(self) -> int:
        """Parsing."""
        return self.parsed - self.parsing

    @property
    def copy_ticks(self) -> int:
        """Copying it to the GPU."""
        return self.copied - self.parsed

    @property
    def build_ticks(self) -> int:
        """Building the acceleration structure."""
        return self.built - self.building


class Storage:
    """The file systems of a machine.

    A read opens its file and then is a flow over the network, from ``"storage"`` or ``("disk", node)`` to ``("host",
    node)``. From the parallel file system it gets at most what a node gets, and at most what the targets give that its
    bytes lie on. That two files may lie on one target, and that many nodes open files at once, costs nothing extra.

    Parameters
    ----------
    env : simpy.Environment
    network : Network
        With the links of `storage_links`, and routes over them.
    card : StorageCard

    Attributes
    ----------
    reads : int
    read_bytes : float
        Of all reads asked for so far.

    """

    def __init__(self, env: simpy.Environment, network: Network, card: StorageCard) -> None:
        self._env, self._network, self.card = env, network, card
        self.reads = 0
        self.read_bytes = 0.0

    def read(
        self,
        node: int,
        nbytes: float,
        *,
        where: Where = "shared",
        stripe_count: int | None = None,
        start: int | None = None,
    ) -> simpy.Event:
        """Read a file into a node's memory.

        Parameters
        ----------
        node : int
        nbytes : float
            Finite and not negative.
        where : "shared" or "local"
            The parallel file system or the node's disk.
        stripe_count : int, optional
            Targets that the file is spread over; the card's, unless given. A disk has none.
        start : int, optional
            The tick at which the file is opened; now, unless given.

        Returns
        -------
        simpy.Event
            Succeeds when the last byte is in the host's memory; its value is that tick.

        Raises
        ------
        UsageError
            If the machine has no such storage.
        ScheduleError
            If a number is out of range, the start lies in the past, or the disk is too small for the file.
        UnreachableError
            If no route connects the storage with the node.

        """
        opened = self._begin(start) + self._open_ticks(where)
        if not 0.0 <= nbytes < math.inf:
            raise ScheduleError(f"a file's size must be finite and not negative, got {nbytes!r} B")
        source: Hashable
        if where == "shared":
            source, cap = "storage", self._striped_bandwidth(nbytes, stripe_count)
        else:
            assert self.card.local is not None  # noqa: S101 - _open_ticks saw to it
            if stripe_count is not None:
                raise ScheduleError(f"a file on a local disk has no stripes, got stripe_count {stripe_count}")
            if nbytes > self.card.local.capacity:
                room = format_bytes(self.card.local.capacity)
                raise ScheduleError(f"a file of {format_bytes(nbytes)} cannot lie on node {node}'s disk of {room}")
            source, cap = ("disk", node), math.inf
        done = self._network.transfer(source, ("host", node), nbytes, start=opened, cap=cap)
        self.reads += 1
        self.read_bytes += nbytes
        return done

    def load(
        self,
        node: int,
        nbytes: float,
        primitives: float,
        parser: tuple[Kernels, float],
        builder: tuple[Kernels, float],
        *,
        device: Hashable | None = None,
        where: Where = "shared",
        stripe_count: int | None = None,
        start: int | None = None,
    ) -> Generator[simpy.Event, Any, LoadTimes]:
        """Read a domain, parse it, and build its acceleration structure, which out-of-core rendering does at each miss.

        The phases follow each other once the last byte has arrived, each when its processor has nothing else to do;
        SpRay, section 5.1, builds when a domain comes into the domain cache. To be used with ``yield from``, or as a
        process that loads ahead.

        Parameters
        ----------
        node : int
        nbytes : float
            Size of the domain's file.
        primitives : float
            Triangles that go into the acceleration structure.
        parser : (Processor, float)
            What parses, at how many B/s.
        builder : (Processor, float)
            What builds the acceleration structure, at how many primitives a second.
        device : hashable, optional
            The GPU that the data are copied to before it builds; they stay with the host unless given.
        where, stripe_count, start
            As for `read`.

        Returns
        -------
        LoadTimes
            Once the acceleration structure is there.

        Raises
        ------
        UsageError, ScheduleError, UnreachableError
            As for `read`, and if the number of primitives is out of range.

        """
        if not 0.0 <= primitives < math.inf:
            raise ScheduleError(f"a domain's primitives must be finite and not negative, got {primitives!r}")
        began = self._begin(start)
        arrival = self.read(node, nbytes, where=where, stripe_count=stripe_count, start=start)
        read = cast("int", (yield arrival))
        parsing, parsed = parser[0].run(nbytes / parser[1], read)
        copied = parsed
        if device is not None:
            copied = cast("int", (yield self._network.transfer(("host", node), device, nbytes, start=parsed)))
        building, built = builder[0].run(primitives / builder[1], copied)
        yield self._env.timeout(built - int(self._env.now))
        return LoadTimes(began, began + self._open_ticks(where), read, parsing, parsed, copied, building, built)

    def _begin(self, start: int | None) -> int:
        now = cast("int", self._env.now)
        if start is not None and start < now:
            raise ScheduleError(f"a read cannot start at tick {start}, before now, tick {now}")
        return now if start is None else start

    def _open_ticks(self, where: Where) -> int:
        """Return how long it takes to open a file, having made sure that there is such storage."""
        if where not in _PLACES:
            near = did_you_mean(str(where), _PLACES)
            raise ScheduleError(f"a file lies in 'shared' or 'local' storage, got {where!r}{near}")
        if where == "shared" and self.card.shared:
            return to_ticks(self.card.shared.open_latency)
        if where == "local" and self.card.local:
            return to_ticks(self.card.local.latency)
        other: Where = "local" if where == "shared" else "shared"
        raise UsageError(
            f"cannot read from {where!r} storage: the machine has no {_PLACES[where]} (it has a {_PLACES[other]}: "
            f"{other!r}); add machine.storage.{where} to its card"
        )

    def _striped_bandwidth(self, nbytes: float, stripe_count: int | None) -> float:
        """Return the most that a read from the parallel file system gets, in B/s."""
        card = self.card.shared
        assert card is not None  # noqa: S101 - _open_ticks saw to it
        count = card.stripe_count if stripe_count is None else stripe_count
        if not 1 <= count <= card.targets:
            raise ScheduleError(f"a file is spread over 1 to {card.targets} targets, got stripe_count {count}")
        stripes = nbytes / card.stripe
        used = count if stripes > count else max(1, math.ceil(stripes))
        return min(card.client_bandwidth, used * card.target_bandwidth)


@dataclass(slots=True)
class _Waiter:
    """A thread that waits for a block: its event, and the tick since when."""

    block: int
    there: simpy.Event
    since: int


class _Line:
    """What the threads of a rank do with one cache line: read its block, wait for it, or wait for the line."""

    __slots__ = ("arriving", "readers", "waiting")

    def __init__(self) -> None:
        self.readers = 0
        self.arriving: list[_Waiter] | None = None  # for the block on its way, if one is
        self.waiting: list[_Waiter] = []  # for other blocks


class BlockFetcher:
    """The threads of one rank, which share a direct-mapped cache of the blocks that other ranks own.

    A block that is not there is fetched with an RDMA get, which costs its owner's processor nothing: the request goes
    to the owner, the bytes come back, and the thread waits for them, so it has one fetch under way at most. Threads
    that want the same block wait for the same fetch. Each cache line has a lock: threads that read its block share it,
    and a thread that needs the line for another block waits until the last of them is done. A thread holds one block
    at a time, its current one, and lets go of it before it asks for the next; otherwise two threads could each hold
    the line that the other needs. For the same reason a thread that uses two caches lets go in one before it fetches in
    the other.

    Ize et al., Real-time ray tracer for visualization on a cluster, section 5.3.

    Parameters
    ----------
    env : simpy.Environment
    network : Network
    cache : DirectMappedCache
        Of this rank; its lines and counters are used and stay, so that the next frame finds a warm cache.
    endpoints : sequence of hashables (ranks,)
        The network's node that each rank's blocks are in, for instance ``("host", 3)``.
    block_bytes : float

    Attributes
    ----------
    fetches : int
    fetched_bytes : float
    joins : int
        How often a thread waited for a fetch that another one had begun.
    waits : int
        How often a thread found a line taken for another block.
    fetch_ticks : int
        What threads waited for blocks on their way.
    wait_ticks : int
        What threads waited for lines until they were let go.

    Raises
    ------
    ScheduleError
        If there is not one endpoint a rank.

    """

    def __init__(
        self,
        env: simpy.Environment,
        network: Network,
        cache: DirectMappedCache,
        endpoints: Sequence[Hashable],
        block_bytes: float = NODE_BLOCK_BYTES,
    ) -> None:
        if len(endpoints) != cache.blocks.ranks:
            raise ScheduleError(f"{cache.blocks.ranks} ranks need as many endpoints, got {len(endpoints)}")
        self._env, self._network, self.cache, self._endpoints = env, network, cache, list(endpoints)
        self.block_bytes = float(block_bytes)
        self.fetches = self.joins = self.waits = self.fetch_ticks = self.wait_ticks = 0
        self.fetched_bytes = 0.0
        self._lines: dict[int, _Line] = {}
        self._current: dict[Hashable, int] = {}
        self._stalled: dict[Hashable, int] = {}

    def fetch(self, thread: Hashable, block: int) -> Generator[simpy.Event, Any, int]:
        """Make a block a thread's current one; return once it is there.

        Takes no time if the rank has the block, if it is in its cache line, or if it is the current one already. To be
        used with ``yield from``. If a link fails under a fetch, the simulation ends with a `LinkFailedError`.

        Parameters
        ----------
        thread : hashable
            What the caller calls the thread.
        block : int

        Returns
        -------
        int
            `RESIDENT`, `HIT`, or `MISS` for the thread that began a fetch.

        Raises
        ------
        ScheduleError
            If the block is negative, or the thread waits for one already.

        """
        if block < 0:
            raise ScheduleError(f"blocks are numbered from 0, got block {block}")
        cache = self.cache
        if self._current.get(thread) != block:
            self.release(thread)
            if not cache.blocks.resident(block, cache.rank):
                number = self._line_number(block)
                line = self._lines.setdefault(number, _Line())
                if cache.tags[number] == block and line.arriving is None:
                    line.readers += 1
                else:
                    self._stalled[thread] = block
                    began = yield self._queue(number, line, block)
                    del self._stalled[thread]
                    if began:
                        self._current[thread] = block
                        cache.misses += 1
                        return MISS
            self._current[thread] = block
        if cache.blocks.resident(block, cache.rank):
            cache.residents += 1
            return RESIDENT
        cache.hits += 1
        return HIT

    def release(self, thread: Hashable) -> None:
        """Let go of a thread's current block, if it has one; who waits longest for the line gets it.

        Raises
        ------
        ScheduleError
            If the thread waits for a block.

        """
        if thread in self._stalled:
            block = self._stalled[thread]
            raise ScheduleError(f"thread {thread!r} waits for block {block}: until it is there it can do nothing else")
        held = self._current.pop(thread, None)
        if held is None or self.cache.blocks.resident(held, self.cache.rank):
            return
        number = self._line_number(held)
        line = self._lines[number]
        line.readers -= 1
        if line.readers == 0 and line.waiting:
            # Whoever wants the same block as the first in the queue will read it together with that one.
            now = cast("int", self._env.now)
            wanted = line.waiting[0].block
            granted = [waiter for waiter in line.waiting if waiter.block == wanted]
            line.waiting = [waiter for waiter in line.waiting if waiter.block != wanted]
            for waiter in granted:
                self.wait_ticks += now - waiter.since
                waiter.since = now
            self._get(number, line, granted)

    def _line_number(self, block: int) -> int:
        blocks = self.cache.blocks
        return blocks.number(block, self.cache.rank) % blocks.lines

    def _queue(self, number: int, line: _Line, block: int) -> simpy.Event:
        """Return an event for when a block is there; its value is whether it is this one's fetch."""
        waiter = _Waiter(block, self._env.event(), cast("int", self._env.now))
        if line.arriving is not None and self.cache.tags[number] == block:
            line.arriving.append(waiter)
        elif line.readers or line.arriving is not None:
            self.waits += 1
            line.waiting.append(waiter)
        else:
            self._get(number, line, [waiter])
        return waiter.there

    def _get(self, number: int, line: _Line, waiters: list[_Waiter]) -> None:
        """Begin to fetch a block into a line that nobody reads; the first of those who want it is the one who does."""
        block = waiters[0].block
        here = self._endpoints[self.cache.rank]
        owner = self._endpoints[self.cache.blocks.owner(block)]
        self.cache.tags[number] = block
        line.arriving = waiters
        self.fetches += 1
        self.fetched_bytes += self.block_bytes
        request = self._network.latency_ticks(here, owner)
        get = self._network.transfer(owner, here, self.block_bytes, delay=request)
        get.callbacks.append(partial(self._arrive, line))

    def _arrive(self, line: _Line, get: simpy.Event) -> None:
        """Let all who wait for a block read it."""
        if not get.ok:
            return  # SimPy raises it
        now = cast("int", self._env.now)
        waiters, line.arriving = line.arriving or [], None
        line.readers = len(waiters)
        self.joins += len(waiters) - 1
        for i, waiter in enumerate(waiters):
            self.fetch_ticks += now - waiter.since
            waiter.there.succeed(i == 0)
