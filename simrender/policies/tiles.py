"""Frames cut into tiles of ray packets: what a load balancer hands out, and what each packet costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
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


@dataclass(frozen=True, eq=False)
class TiledFrame:
    """A frame's packets in the order of the tiles that they belong to.

    Attributes
    ----------
    first : int64 array (tiles + 1,)
        Where each tile's packets begin.
    pixels : int64 array (packets,)
        Published pixels for which a packet stands, at least one each; they sum to those of the image.
    seconds : float64 array (packets,)
        What one core of the processor takes for a packet's rays.
    streams : (Stream, Stream)
        References to blocks of nodes, and of triangles.
    rays : list of int64 arrays
        Ids of each packet's rays.
    weight : float
        Published packets for which a packet stands.

    """

    first: I64
    pixels: I64
    seconds: NDArray[np.float64]
    streams: tuple[Stream, Stream]
    rays: list[I64]
    weight: float

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
) -> TiledFrame:
    """Cut a frame into square tiles, row-major from the top left; those at the right and lower edges may be smaller.

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

    """
    (columns, rows), packet = packet_of_pixel(trace.size)
    across, down = (max(1, round(side * t / (p * PACKET_SIDE))) for t, p in zip(trace.size, published, strict=True))
    place = np.arange(columns * rows)
    tile = place // columns // down * -(-columns // across) + place % columns // across
    order = np.argsort(tile, kind="stable")
    first = np.concatenate([[0], np.cumsum(np.bincount(tile))])

    begins, rays, camera = packet_rays(trace)
    weight = published[0] * published[1] / trace.pixels
    incoherent = np.diff(begins) - camera
    seconds = (camera * ray_seconds[0] + incoherent * ray_seconds[1]) * (weight * repeats)
    traced = np.cumsum(np.bincount(packet, minlength=columns * rows)[order])
    pixels = np.diff(traced * (published[0] * published[1]) // trace.pixels, prepend=0)
    streams = (
        Stream(references.node_first, references.node).taken(order),
        Stream(references.triangle_first, references.triangle).taken(order),
    )
    by_packet = np.split(rays, begins[1:-1])
    return TiledFrame(first, pixels, seconds[order], streams, [by_packet[i] for i in order.tolist()], weight)
