"""Frames cut into tiles of ray packets: what a load balancer hands out, and what each packet costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.rays.blocks import PACKET_SIDE, References, packet_of_pixel, packet_rays
from simrender.rays.trace import Trace

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Stream:
    """Block references by packet: those of packet i are ``block[first[i]:first[i + 1]]``."""

    first: I64
    block: NDArray[np.int32]

    def taken(self, order: I64) -> Stream:
        """Return the references of packets in another order."""
        length = np.diff(self.first)[order]
        first = np.concatenate([[0], np.cumsum(length)])
        rows = np.arange(first[-1]) + np.repeat(self.first[order] - first[:-1], length)
        return Stream(first, self.block[rows])

    def last_uses(self, first: I64, blocks: int) -> Stream:
        """Return, of each run of packets, the blocks it refers to in the order of their last references.

        Whatever else a cache has seen, its lines are then the same as if all references had come: each has the last
        block that belongs into it.

        Parameters
        ----------
        first : int64 array (runs + 1,)
            Where each run of packets begins.
        blocks : int
            How many there are.

        """
        ends = self.first[first]
        last = np.empty(blocks, np.int64)
        keep = np.empty(len(self.block), np.bool_)
        for run in map(slice, ends[:-1], ends[1:]):
            place = np.arange(run.start, run.stop)
            last[self.block[run]] = place  # of the places of a block, the last one stays
            keep[run] = last[self.block[run]] == place
        before = np.concatenate([[0], np.cumsum(keep)])
        return Stream(before[ends], self.block[keep])


@dataclass(frozen=True, eq=False)
class TiledFrame:
    """A frame's packets in the order of the tiles that they belong to.

    Attributes
    ----------
    first : int64 array (tiles + 1,)
        Where each tile's packets begin.
    pixels : int64 array (packets,)
        Published ones; they sum to those of the image.
    seconds : float64 array (packets,)
        What one core of the processor takes for a packet's rays.
    streams : (Stream, Stream)
        References to blocks of nodes, and of triangles.
    blocks : (int, int)
        How many there are of either.
    rays : list of int64 arrays
        Ids of the traced rays of each packet; of the copies of a packet, the first one has them.

    """

    first: I64
    pixels: I64
    seconds: NDArray[np.float64]
    streams: tuple[Stream, Stream]
    blocks: tuple[int, int]
    rays: list[I64]

    @property
    def tiles(self) -> int:
        """How many tiles there are."""
        return len(self.first) - 1


def tile_frame(
    trace: Trace,
    references: References,
    published: tuple[int, int],
    side: int,
    ray_seconds: tuple[float, float],
    repeats: int,
    scaled: bool,
) -> TiledFrame:
    """Cut a frame into square tiles, row-major from the top left; those at the right and lower edges may be smaller.

    A traced packet comes as often as there are published packets for it. Where blocks are scaled, a traced block stands
    for as many published ones, and each copy of a packet refers to one of them: nothing but lines of a cache that are
    taken by chance would tell copies that share their blocks from one packet with all their weight, and these chances
    average out in the published scene as they do among many small blocks.

    Parameters
    ----------
    trace : Trace
    references : References
        Of the trace.
    published : (width, height)
    side : int
        Of a tile, in published pixels; rounded to whole packets, at least one.
    ray_seconds : (float, float)
        What a core takes for a coherent ray, and for any other.
    repeats : int
        Published samples for which a traced one stands. Their compute counts; the blocks that they refer to are taken
        for those that the traced one has just brought in.
    scaled : bool
        Whether the blocks below the top of the hierarchy stand for many.

    """
    (columns, rows), packet = packet_of_pixel(trace.size)
    across, down = (max(1, round(side * t / (p * PACKET_SIDE))) for t, p in zip(trace.size, published, strict=True))
    place = np.arange(columns * rows)
    tile = place // columns // down * -(-columns // across) + place % columns // across
    order = np.argsort(tile, kind="stable")
    total = published[0] * published[1]
    copies = max(1, round(total / trace.pixels))
    first = np.concatenate([[0], np.cumsum(np.bincount(tile)) * copies])

    begins, rays, camera = packet_rays(trace)
    incoherent = np.diff(begins) - camera
    seconds = (camera * ray_seconds[0] + incoherent * ray_seconds[1]) * (total / trace.pixels * repeats / copies)
    traced = np.repeat(np.bincount(packet, minlength=columns * rows)[order], copies)
    pixels = np.diff(np.cumsum(traced) * total // (trace.pixels * copies), prepend=0)

    apart = copies if scaled else 1
    lower = (~references.upper, np.ones(references.triangle_blocks, np.bool_))
    numbers = [np.concatenate([[0], np.cumsum(np.where(each, apart, 1))]).astype(np.int32) for each in lower]
    streams = (
        Stream(references.node_first, references.node).taken(np.repeat(order, copies)),
        Stream(references.triangle_first, references.triangle).taken(np.repeat(order, copies)),
    )
    if apart > 1:
        for stream, each, number in zip(streams, lower, numbers, strict=True):
            copy = np.repeat(np.tile(np.arange(copies, dtype=np.int32), len(order)), np.diff(stream.first))
            copy *= each[stream.block]
            np.add(number[stream.block], copy, out=stream.block)
    none = np.zeros(0, np.int64)
    by_packet = np.split(rays, begins[1:-1])
    return TiledFrame(
        first,
        pixels,
        np.repeat(seconds[order], copies),
        streams,
        (int(numbers[0][-1]), int(numbers[1][-1])),
        [by_packet[i] if k == 0 else none for i in order.tolist() for k in range(copies)],
    )


def in_turns(first: I64, run: int, threads: int) -> I64:
    """Return the order in which references come that threads of one cache make in turn.

    Each thread makes those of a run of packets, one after the other; when all are through, they go on to the next runs.

    Parameters
    ----------
    first : int64 array (packets + 1,)
        Where the references of each packet begin.
    run : int
        Packets of a run.
    threads : int

    Returns
    -------
    int64 array (references,)

    """
    order = np.empty(first[-1], np.int64)
    _take_turns(np.append(first[:-1:run], first[-1]), threads, order)
    return order


@njit(cache=True, nogil=True, error_model="numpy")
def _take_turns(starts, threads, order):  # type: ignore[no-untyped-def]
    placed = 0
    for begin in range(0, len(starts) - 1, threads):
        end = min(begin + threads, len(starts) - 1)
        step = 0
        while placed < starts[end]:
            for k in range(begin, end):
                if starts[k] + step < starts[k + 1]:
                    order[placed] = starts[k] + step
                    placed += 1
            step += 1
