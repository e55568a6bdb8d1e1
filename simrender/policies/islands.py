"""Islands: M groups of N ranks, each of which holds the whole model and renders its share of the scan lines.

Islands are no policy but wrap any data-parallel one (islands paper, sections 3 and 5.2): island I takes scan lines I,
I + M, I + 2M ...; within it, rank j takes every N'th of those. One rank an island is image parallelism; one island is
pure data parallelism.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

_PLASTIC = (0.7548776662466927, 0.5698402909980532)
"""The plastic number's inverse and its square: steps of Roberts' R2 sequence, evenly spread in two dimensions."""

_SEARCH_LIMIT = 4096
"""GPUs up to which a machine that would hold the model is looked for."""

Need = Callable[[int, int], NDArray[np.float64]]
"""(islands, size of an island) -> bytes each rank needs."""


@dataclass(frozen=True)
class Layout:
    """How ranks, islands, domains and pixels correspond.

    Attributes
    ----------
    islands : int
        M, the number of islands.
    size : int
        N, the ranks of an island; also the number of domains.

    """

    islands: int
    size: int

    @property
    def ranks(self) -> int:
        """How many GPUs take part."""
        return self.islands * self.size

    def rank_of_line(self, line: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rank that renders each scan line of the published image."""
        return (line % self.islands) * self.size + (line // self.islands) % self.size

    def domain(self, rank: int) -> int:
        """Return the domain that a rank holds."""
        return rank % self.size

    def right(self, rank: int) -> int:
        """Return the rank's neighbour in its island's ring, to which it passes its rays."""
        return rank - rank % self.size + (rank % self.size + 1) % self.size

    def left(self, rank: int) -> int:
        """Return the neighbour from which a rank gets its rays."""
        return rank - rank % self.size + (rank % self.size - 1) % self.size


def represented_lines(traced: tuple[int, int], published_height: int) -> NDArray[np.int64]:
    """Return, for each traced pixel, the published scan line whose fate it shares, int64 (pixels,).

    A traced pixel stands for a block of published ones, whose scan lines belong to several ranks. It goes to one of
    those lines, by a low-discrepancy sequence, so that every rank gets an even sample of the image and the share of
    pixels it has in the published one. Where the traced image is the published one, it is simply the pixel's own line.
    """
    width, height = traced
    pixel = np.arange(width * height)
    x, y = pixel % width, pixel // width
    within = (x * _PLASTIC[0] + y * _PLASTIC[1]) % 1.0 if published_height > height else 0.0
    return np.minimum(((y + within) * published_height / height).astype(np.int64), published_height - 1)


@dataclass(frozen=True)
class Fit:
    """Whether a model fits, and what it takes.

    Attributes
    ----------
    layout : Layout
        The chosen islands; where nothing fits, the best try: all GPUs in one island, or the islands asked for.
    needed_bytes : float64 array (ranks,)
        Of each rank of that layout.
    capacity_bytes : float
        Of one GPU.
    gpus_needed : int or None
        The smallest number of such GPUs that would do, for the islands asked for or else for one; None if no number
        up to 4,096 an island would.

    """

    layout: Layout
    needed_bytes: NDArray[np.float64]
    capacity_bytes: float
    gpus_needed: int | None

    @cached_property
    def feasible(self) -> bool:
        """Whether every rank has the memory it needs."""
        return bool((self.needed_bytes <= self.capacity_bytes).all())


def fit(gpus: int, islands: int | None, need: Need, capacity_bytes: float, *, replicated: bool = False) -> Fit:
    """Choose the islands of a run.

    Parameters
    ----------
    gpus : int
    islands : int or None
        How many; each gets ``gpus // islands`` ranks, and the rest stay unused. None takes as many islands as the
        fewest GPUs that hold the model allow (ray queue cycling paper, section 4.11).
    need : callable
        Bytes each rank needs, for a number of islands and their size.
    capacity_bytes : float
        What one GPU has.
    replicated : bool
        The policy replicates the model: islands have one rank, however many GPUs there are.

    """

    def holds(count: int, size: int) -> bool:
        return bool((need(count, size) <= capacity_bytes).all())

    if replicated:
        islands = gpus
    if islands is not None:
        layout = Layout(islands, gpus // islands)
    else:
        # Pixels are shared by all ranks, so the queues of a rank depend on the number of islands too.
        size = next((k for k in range(1, gpus + 1) if holds(gpus // k, k)), gpus)
        layout = Layout(gpus // size, gpus // (gpus // size))
    needed = need(layout.islands, layout.size)
    if replicated:
        enough = next((n for n in range(1, gpus + 1) if holds(n, 1)), None)
    else:
        enough = _fewest(need, islands or 1, capacity_bytes)
    return Fit(layout, needed, capacity_bytes, enough)


def _fewest(need: Need, islands: int, capacity_bytes: float) -> int | None:
    """Return the fewest GPUs that hold the model in each of so many islands; more may be needed than there are."""

    def holds(size: int) -> bool:
        return bool((need(islands, size) <= capacity_bytes).all())

    if not holds(_SEARCH_LIMIT):
        return None  # a part that cannot be split is too large for any GPU
    fewest = max(1, int(need(1, 1).sum() / capacity_bytes) // islands)
    return islands * next(size for size in range(fewest, _SEARCH_LIMIT + 1) if holds(size))
