"""Distributed cache ray tracing: rays stay with the node that has their pixels, and blocks of data travel.

Ize et al., "Real-time ray tracer for visualization on a cluster", section 5: the image is divided among nodes by a load
balancer on two levels (5.1), finished pixels go to a display process (5.2), and what a node does not have of the scene
it fetches in blocks of almost 8 KB into a direct-mapped cache (5.3), which stays warm from frame to frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import simpy
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.clock import to_ticks
from simrender.hardware.cache import MISS, NODE_BLOCK_BYTES, TRIANGLE_BLOCK_BYTES, BlockMap, DirectMappedCache
from simrender.hardware.display import Display, message_layout
from simrender.hardware.machine import Machine, MachineCard
from simrender.hardware.storage import BlockFetcher
from simrender.policies.tiles import Stream, TiledFrame, in_turns
from simrender.timeline import KERNELS, KINDS, Timeline

Steps = Generator[simpy.Event, Any, Any]

TRACE, LOAD = KINDS.index(KERNELS[1]), KINDS.index("load")

TILE_MESSAGE_BYTES = 32.0
"""A request for a tile, and the tile: a few integers."""


@dataclass(frozen=True)
class DistributedCache:
    """Tiles of the image dealt to nodes, whose threads fetch the blocks of the scene that their rays need.

    Parameters
    ----------
    cache : str
        What a node keeps of the data, its own blocks and the cache together, as in the paper's 1/N: a share such as
        ``12.5%``, or a size such as ``2 GiB`` of the published data. Or ``all``: data that are replicated before the
        first frame, and nothing to fetch.
    mapping : "ize" or "demarle"
        Which line of the cache a block has; see `simrender.hardware.cache.BlockMap`.
    threads : int, optional
        Render threads of a node; one a core by default.
    tile : int
        Side, in published pixels, of the tiles that the master hands out; to the nearest whole number of packets.
    static : float
        Share of the tiles that nodes begin with, the same ones in each frame; at least one each if there are enough.
        The more, the more a node finds of the last frame in its cache, and the less there is left to balance. The paper
        gives neither this share nor the size of a tile.
    packets : int
        Packets of 64 pixels that a thread takes from its node's queue at once.
    blocks : "scaled" or "full"
        The traced mesh stands for a larger one, and a traced ray for many. In blocks that are smaller by as much as
        there are fewer rays for each triangle, a packet of rays meets as many blocks as it would in the published
        scene; each of the packets and each of the blocks then stands for as many. Full blocks have 254 nodes or 226
        triangles and stand for themselves.
    fetches : "grouped" or "single"
        Whether the gets of a thread's packets are one flow from one owner, as fast as one get after the other would be,
        or each is simulated, with the locks of the cache's lines, which takes long.
    display : bool, optional
        Whether pixels go to the machine's display; by default if it has one.
    settled : bool
        Whether caches begin as a long look at the first frame leaves them: every node has rendered each of the tiles
        that are dealt at some time, in an order of its own, and between them the ones it always begins with. Where
        they begin empty they take hundreds of frames to get there, for dealt tiles come to another node each time.
    warm_up : int
        How many frames are rendered before those that count; the first that does begins when these are complete.
        After a long look, a camera that moves takes about ten frames to come to the misses that it goes on with. No
        more than one is where all data are replicated.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    cache: str = "all"
    mapping: Literal["ize", "demarle"] = "ize"
    threads: Annotated[int, Field(ge=1)] | None = None
    tile: Annotated[int, Field(ge=1)] = 64
    static: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5
    packets: Annotated[int, Field(ge=1)] = 4
    blocks: Literal["scaled", "full"] = "scaled"
    fetches: Literal["grouped", "single"] = "grouped"
    display: bool | None = None
    settled: bool = True
    warm_up: Annotated[int, Field(ge=0)] = 8

    @property
    def replicated(self) -> bool:
        """Whether every node has all data."""
        return self.cache == "all"

    @property
    def uncounted(self) -> int:
        """How many frames are rendered before those that count; one at most where there are no caches to warm."""
        return min(self.warm_up, 1) if self.replicated else self.warm_up

    def render_threads(self, card: MachineCard) -> int:
        """Return how many threads of a node render."""
        return int(getattr(card.processor, "cores", 1)) if self.threads is None else self.threads

    def node(self, me: RenderNode) -> Steps:
        """Render all frames on one node."""
        for frame in range(me.frames):
            yield from me.begin(frame)
            yield me.together([self.thread(me, thread) for thread in range(me.threads)])
            me.end()

    def thread(self, me: RenderNode, thread: int) -> Steps:
        """Render packets until the master has no more tiles."""
        while True:
            work = me.take()
            if work is not None:
                yield from me.render(thread, work)
            elif not (yield from me.ask()):
                break
        me.flush(thread)


@dataclass(frozen=True, slots=True)
class Work:
    """What a thread takes from the queue.

    Attributes
    ----------
    packets : list of int
    pixels : int
    seconds : float
        That one core takes.
    gets : int
        Blocks to fetch.
    fetched_bytes : float
    owner : int
        The rank that has one of the blocks.

    """

    packets: list[int]
    pixels: int
    seconds: float
    gets: int
    fetched_bytes: float
    owner: int


@dataclass
class FrameCounts:
    """How much of everything there was in one frame, over all nodes.

    Attributes
    ----------
    residents, hits, misses : int
        References to blocks, by outcome.
    fetched_bytes : float
    tiles, requests : int
        Tiles handed out; questions for another one.
    messages : int
        To the display.
    trace_ticks, fetch_ticks : list of int
        What the threads of each node took for it.
    packets : list of int
        Rendered, in order.
    complete_at : int
        The tick at which the display had the last pixel, or the last thread was done without a display.

    """

    residents: int = 0
    hits: int = 0
    misses: int = 0
    fetched_bytes: float = 0.0
    tiles: int = 0
    requests: int = 0
    messages: int = 0
    trace_ticks: list[int] = field(default_factory=list)
    fetch_ticks: list[int] = field(default_factory=list)
    packets: list[int] = field(default_factory=list)
    complete_at: int = 0


class Cluster:
    """What the nodes of one simulation share: the frames, the master that deals tiles, and the display.

    Parameters
    ----------
    env : simpy.Environment
    machine : Machine
        One node more than render: the last one has the master and the display process.
    policy : DistributedCache
    frames : list of TiledFrame
        One after the other; those to warm up are among them.
    lines : (int, int)
        Lines of a node's cache of blocks of nodes, and of triangles; where data are replicated there are none.
    display : Display or None

    """

    def __init__(
        self,
        env: simpy.Environment,
        machine: Machine,
        policy: DistributedCache,
        frames: list[TiledFrame],
        lines: tuple[int, int],
        display: Display | None,
    ) -> None:
        self.env, self.machine, self.policy, self.frames, self.display = env, machine, policy, frames, display
        self.ranks = self.master = machine.nodes - 1
        self.threads = policy.render_threads(machine.card)
        owners = 1 if policy.replicated else self.ranks
        self.maps = (
            BlockMap(owners, lines[0], policy.mapping),
            BlockMap(owners, lines[1], policy.mapping, root=None),
        )
        names = [f"node{rank}.thread{k}" for rank in range(self.ranks) for k in range(self.threads)]
        self.timeline = Timeline(len(names), names)
        self.counts = [FrameCounts(trace_ticks=[0] * self.ranks, fetch_ticks=[0] * self.ranks) for _ in frames]
        self._complete = [env.event() for _ in frames]
        self._running = [self.ranks] * len(frames)
        self._dealt = [self.begins_with(frame, self.ranks - 1).stop for frame in frames]
        if display is not None:
            for frame in range(len(frames)):
                display.complete(frame).callbacks.append(partial(self._shown, frame))

    def begins_with(self, frame: TiledFrame, rank: int) -> range:
        """Return the tiles that a node begins a frame with; those after the last node's are dealt to who asks."""
        share = max(int(self.policy.static * frame.tiles), min(self.ranks, frame.tiles))
        return range(rank * share // self.ranks, (rank + 1) * share // self.ranks)

    def next_tile(self, frame: int) -> int | None:
        """Deal the next tile of a frame, if there is one."""
        tile = self._dealt[frame]
        if tile == self.frames[frame].tiles:
            return None
        self._dealt[frame] += 1
        return tile

    def may_begin(self, frame: int) -> simpy.Event:
        """Return what happens when a frame may begin: the display has room, or the one before is rendered."""
        if self.display is None:
            return self._complete[frame - 1] if frame else self.env.timeout(0)
        measured = 0 < frame == self.policy.uncounted
        return self.display.complete(frame - 1) if measured else self.display.may_send(frame)

    def finish(self, frame: int) -> None:
        """Learn that a node has rendered its part of a frame."""
        self._running[frame] -= 1
        if self._running[frame] == 0 and self.display is None:
            self.counts[frame].complete_at = int(self.env.now)
            self._complete[frame].succeed()

    def show(self, frame: int, rank: int, pixels: int) -> None:
        """Send a message with pixels to the display."""
        assert self.display is not None  # noqa: S101 - who calls has seen to it
        wire = message_layout(self.display.card, pixels).wire_bytes
        sent = self.machine.network.transfer(("host", rank), ("display", 0), float(wire))
        assert sent.callbacks is not None  # noqa: S101 - it lies in the future
        sent.callbacks.append(partial(self._arrive, frame, pixels))
        self.counts[frame].messages += 1

    def _arrive(self, frame: int, pixels: int, sent: simpy.Event) -> None:
        assert self.display is not None  # noqa: S101 - see above
        if sent.ok:
            self.display.deliver(frame, pixels)

    def _shown(self, frame: int, _: simpy.Event) -> None:
        self.counts[frame].complete_at = int(self.env.now)


class RenderNode:
    """One node, as the policy sees it.

    Attributes
    ----------
    rank, threads, frames : int

    """

    def __init__(self, cluster: Cluster, rank: int) -> None:
        self._cluster, self.rank = cluster, rank
        self.threads, self.frames = cluster.threads, len(cluster.frames)
        self._slowness = cluster.machine.processor(rank).slowness
        self._caches = [DirectMappedCache(blocks, rank % blocks.ranks) for blocks in cluster.maps]
        self._queue: deque[int] = deque()
        self._asking: simpy.Event | None = None
        self._unsent = [0] * self.threads
        self._number = -1
        self._seen = self._outcomes()
        self._fetchers = []
        if cluster.policy.fetches == "single" and not cluster.policy.replicated:
            hosts = [("host", r) for r in range(cluster.ranks)]
            sizes = (NODE_BLOCK_BYTES, TRIANGLE_BLOCK_BYTES)
            self._fetchers = [
                BlockFetcher(cluster.env, cluster.machine.network, cache, hosts, nbytes)
                for cache, nbytes in zip(self._caches, sizes, strict=True)
            ]

    # -- frames ---------------------------------------------------------------------------------------------------

    def begin(self, frame: int) -> Steps:
        """Wait until a frame may begin, wake the threads, and queue the tiles that are this node's in every frame."""
        cluster = self._cluster
        yield cluster.may_begin(frame)
        yield cluster.env.timeout(to_ticks(float(cluster.machine.card.processor.launch_latency)))
        self._number, self._frame, self._counts = frame, cluster.frames[frame], cluster.counts[frame]
        packets = len(self._frame.pixels)
        self._fetched = np.zeros(packets)
        self._owners: dict[int, NDArray[np.int64]] = {}
        self._over = False
        self._queue_tiles(cluster.begins_with(self._frame, self.rank))

    def settle(self, frame: TiledFrame, last_uses: Sequence[Stream], order: np.random.Generator) -> None:
        """Bring the caches to where they are after many frames that are all the same; see `DistributedCache`.

        Parameters
        ----------
        frame : TiledFrame
        last_uses : sequence of Stream
            Of its tiles; see `Stream.last_uses`.
        order : numpy.random.Generator
            Of the tiles that are dealt.

        """
        own = self._cluster.begins_with(frame, self.rank)
        dealt = np.arange(self._cluster.begins_with(frame, self._cluster.ranks - 1).stop, frame.tiles)
        rounds = np.array_split(order.permutation(dealt), self._cluster.ranks)
        tiles = np.concatenate([np.append(own, some) for some in rounds]).astype(np.int64)
        for cache, stream in zip(self._caches, last_uses, strict=True):
            cache.replay(stream.taken(tiles).block)
        self._seen = self._outcomes()

    def together(self, threads: list[Steps]) -> simpy.Event:
        """Return what happens when all threads are done."""
        env = self._cluster.env
        return env.all_of([env.process(thread) for thread in threads])

    def end(self) -> None:
        """Count what the frame took."""
        now = self._outcomes()
        delta = [a - b for a, b in zip(now, self._seen, strict=True)]
        self._seen = now
        self._counts.residents += delta[0]
        self._counts.hits += delta[1]
        self._counts.misses += delta[2]
        self._cluster.finish(self._number)

    def _outcomes(self) -> tuple[int, ...]:
        return tuple(sum(getattr(c, name) for c in self._caches) for name in ("residents", "hits", "misses"))

    # -- the two queues -------------------------------------------------------------------------------------------

    def take(self) -> Work | None:
        """Take packets from the node's queue; None if it is empty."""
        frame, queue = self._frame, self._queue
        if not queue:
            return None
        packets = [queue.popleft() for _ in range(min(self._cluster.policy.packets, len(queue)))]
        missing = [owner for packet in packets for owner in self._owners.get(packet, ())]
        return Work(
            packets,
            sum(int(frame.pixels[packet]) for packet in packets),
            sum(float(frame.seconds[packet]) for packet in packets),
            len(missing),
            sum(float(self._fetched[packet]) for packet in packets),
            int(missing[len(missing) // 2]) if missing else self.rank,
        )

    def ask(self) -> Steps:
        """Ask the master for another tile, or wait for it if another thread has asked; return whether to go on."""
        cluster = self._cluster
        if self._over:
            return False
        if self._asking is not None:
            yield self._asking
            return not self._over
        self._asking = asking = cluster.env.event()
        self._counts.requests += 1
        yield cluster.machine.copy(self.rank, cluster.master, TILE_MESSAGE_BYTES)
        tile = cluster.next_tile(self._number)
        yield cluster.machine.copy(cluster.master, self.rank, TILE_MESSAGE_BYTES)
        self._asking = None
        if tile is None:
            self._over = True
        else:
            self._queue_tiles(range(tile, tile + 1))
        asking.succeed()
        return not self._over

    def _queue_tiles(self, tiles: range) -> None:
        """Queue the packets of consecutive tiles, and find out which of their references miss."""
        frame = self._frame
        begin, end = int(frame.first[tiles.start]), int(frame.first[tiles.stop])
        self._counts.tiles += len(tiles)
        self._queue.extend(range(begin, end))
        if self._fetchers or begin == end:
            return
        owners, packet_of = [], []
        for cache, stream, nbytes in zip(
            self._caches, frame.streams, (NODE_BLOCK_BYTES, TRIANGLE_BLOCK_BYTES), strict=True
        ):
            first, last = stream.first[begin], stream.first[end]
            refers = stream.block[first:last]
            order = in_turns(stream.first[begin : end + 1] - first, self._cluster.policy.packets, self.threads)
            missed = np.sort(order[cache.replay(refers[order]) == MISS])
            of = np.searchsorted(stream.first, missed + first, side="right") - 1
            owners.append(cache.blocks.owner(refers[missed].astype(np.int64)))
            packet_of.append(of)
            self._fetched[begin:end] += np.bincount(of - begin, minlength=end - begin) * float(nbytes)
        of = np.concatenate(packet_of)
        by_packet = np.argsort(of, kind="stable")
        missing, begins = np.unique(of[by_packet], return_index=True)
        parts = np.split(np.concatenate(owners)[by_packet], begins)[1:]
        self._owners.update(zip(missing.tolist(), parts, strict=True))

    # -- what threads do ------------------------------------------------------------------------------------------

    def render(self, thread: int, work: Work) -> Steps:
        """Trace packets, fetch the blocks that they miss, and send the pixels on."""
        cluster, counts = self._cluster, self._counts
        row, begin = self.rank * self.threads + thread, int(cluster.env.now)
        ticks = to_ticks(work.seconds * self._slowness)
        yield cluster.env.timeout(ticks)
        counts.trace_ticks[self.rank] += ticks
        cluster.timeline.add(row, TRACE, begin, begin + ticks, 0.0, work.pixels)
        begin += ticks
        nbytes = work.fetched_bytes
        if self._fetchers:
            nbytes = yield from self._fetch_singly(thread, work.packets)
        elif work.gets:
            yield self._get(work)
        if nbytes:
            end = int(cluster.env.now)
            counts.fetch_ticks[self.rank] += end - begin
            cluster.timeline.add(row, LOAD, begin, end, nbytes, 0.0)
        counts.fetched_bytes += nbytes
        counts.packets += work.packets
        self._send(thread, work.pixels)

    def _get(self, work: Work) -> simpy.Event:
        """Get blocks one after the other: alone, each takes its request's latency, the answer's, and its bytes.

        They are one flow that is never faster than that. Where threads share a link, what they have of it is less, and
        the latencies of one pass while others use it.
        """
        network = self._cluster.machine.network
        source, target = ("host", work.owner), ("host", self.rank)
        latency = network.latency_ticks(source, target) / 1e12
        alone = 2.0 * latency * work.gets + work.fetched_bytes / network.bandwidth(source, target)
        return network.transfer(source, target, work.fetched_bytes, cap=work.fetched_bytes / (alone - latency))

    def _fetch_singly(self, thread: int, packets: list[int]) -> Steps:
        """Refer to each block in turn; return the bytes that were fetched for this thread."""
        nbytes = 0.0
        for packet in packets:
            for fetcher, stream in zip(self._fetchers, self._frame.streams, strict=True):
                for block in stream.block[stream.first[packet] : stream.first[packet + 1]].tolist():
                    if (yield from fetcher.fetch(thread, block)) == MISS:
                        nbytes += fetcher.block_bytes
                fetcher.release(thread)
        return nbytes

    def _send(self, thread: int, pixels: int) -> None:
        display = self._cluster.display
        if display is None:
            return
        self._unsent[thread] += pixels
        while self._unsent[thread] >= display.card.message_pixels:
            self._unsent[thread] -= display.card.message_pixels
            self._cluster.show(self._number, self.rank, display.card.message_pixels)

    def flush(self, thread: int) -> None:
        """Send the pixels that make no full message."""
        if self._unsent[thread]:
            self._cluster.show(self._number, self.rank, self._unsent[thread])
            self._unsent[thread] = 0
