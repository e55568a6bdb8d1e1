"""Blocking: the image in tiles, one after the other, so that the rays of only one of them are in flight."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Ids = NDArray[np.int64]

PROGRAM_SAMPLES = 1 << 20
"""The most samples that a rank of SpRay's program takes at once."""


class Blocking(NamedTuple):
    """Which rank renders each pixel, and when.

    Attributes
    ----------
    rank : int64 array (pixels,)
        Negative where another island renders it.
    tile : int64 array (pixels,)
    tiles : int
        How many there are.

    """

    rank: Ids
    tile: Ids
    tiles: int


def equal_tiles(rank: Ids, tiles: int) -> Blocking:
    """Cut the image into tiles of which each rank has an equal share."""
    order = np.argsort(rank, kind="stable")
    ranks, which, pixels = np.unique(rank, return_inverse=True, return_counts=True)
    first = np.searchsorted(rank[order], ranks)
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    return Blocking(rank, (place - first[which]) * tiles // pixels[which], tiles)


def program_tiles(size: tuple[int, int], samples: float, ranks: int, *, in_situ: bool) -> Blocking:
    """Cut the image as SpRay's program does.

    Out of core each rank has a vertical stripe, cut into horizontal tiles. In situ all ranks render a horizontal tile
    together, of which each has a horizontal stripe. The last one takes what is left over.

    Parameters
    ----------
    size : (width, height)
    samples : float
        A pixel has, as published.
    ranks : int
    in_situ : bool

    """
    width, height = size
    x, up = np.arange(width * height) % width, height - 1 - np.arange(width * height) // width
    if not in_situ:
        widest = width - (ranks - 1) * (width // ranks)
        tiles = max(1, math.ceil(widest * height * samples / PROGRAM_SAMPLES))
        rank = np.minimum(x // max(width // ranks, 1), ranks - 1)
        return Blocking(rank, up // math.ceil(height / tiles), tiles)
    tiles = max(1, math.ceil(width * height * samples / (PROGRAM_SAMPLES * ranks)))
    lines = math.ceil(height / tiles)
    tile = up // lines
    each = np.maximum(np.minimum(lines, height - tile * lines) // ranks, 1)
    return Blocking(np.minimum((up - tile * lines) // each, ranks - 1), tile, tiles)
