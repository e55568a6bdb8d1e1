"""Caches: which domains or blocks of a data set are in memory, and what a stream of references misses.

Plain data structures, without time: `DomainCache` is the least-recently-used cache of out-of-core rendering (SpRay,
section 5.1), `DirectMappedCache` the cache of remote blocks of distributed cache ray tracing (Ize et al., Real-time ray
tracer for visualization on a cluster, section 5.3). What a miss costs is for `simrender.hardware.storage` to say.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.errors import ScheduleError, did_you_mean
from simrender.units import format_bytes

NODE_BLOCK_BYTES: Final = 254 * 32
"""A block of 254 BVH nodes of 32 B (Ize et al., section 5.3): almost 8 KiB, with room for the message's header."""
TRIANGLE_BLOCK_BYTES: Final = 226 * 36
"""A block of 226 triangles of 36 B (Ize et al., section 5.3)."""

RESIDENT: Final = 0
"""Outcome of a reference: the rank has the block for good, because it owns it or because it is the root block."""
HIT: Final = 1
"""Outcome of a reference: the block is in its cache line."""
MISS: Final = 2
"""Outcome of a reference: the block has to be fetched from its owner."""

NOTHING: Final = -1
"""The tag of an empty cache line, and the line of a block that needs none."""

BlockMapping = Literal["ize", "demarle"]
_MAPPINGS: Final = ("ize", "demarle")
_Blocks = TypeVar("_Blocks", int, NDArray[np.int64])


class DomainCache:
    """Domains in memory, of which the least recently used one makes room for the next.

    `touch` a domain to use it; where that returns False, pay for its load and `load` it::

        if not cache.touch(domain):
            evicted = cache.load(domain)

    SpRay, section 5.1; its figure 2 is the cache with a capacity of one domain.

    Parameters
    ----------
    nbytes : sequence of float
        Size of each domain in bytes, acceleration structure included; domains are numbered from 0.
    capacity : number or "all"
        How much fits, in `unit`.
    unit : "domains" or "bytes"

    Attributes
    ----------
    hits, misses, evictions : int
        Domains found, loaded and dropped.
    loaded_bytes, used_bytes : float
        Of all loads so far; of the domains in memory.

    Raises
    ------
    ScheduleError
        If the capacity holds nothing, or is no whole number of domains.

    """

    def __init__(
        self,
        nbytes: Sequence[float],
        capacity: float | Literal["all"] = "all",
        *,
        unit: Literal["domains", "bytes"] = "domains",
    ) -> None:
        if unit not in ("domains", "bytes"):
            raise ScheduleError(f"a domain cache's capacity is in 'domains' or 'bytes', got {unit!r}")
        if isinstance(capacity, str):
            if capacity != "all":
                raise ScheduleError(f"a domain cache's capacity is a number of {unit} or 'all', got {capacity!r}")
            capacity = math.inf
        elif unit == "domains" and not (capacity >= 1 and float(capacity).is_integer()):
            raise ScheduleError(f"a domain cache holds a whole number of domains, at least 1, got {capacity!r}")
        elif not 0.0 < capacity < math.inf:
            raise ScheduleError(f"a domain cache's capacity must be finite and above 0 B, got {capacity!r} B")
        self.nbytes = [float(size) for size in nbytes]
        self.capacity, self.unit = capacity, unit
        self.hits = self.misses = self.evictions = 0
        self.loaded_bytes = self.used_bytes = 0.0
        self._resident: dict[int, None] = {}  # in order of use, the least recent first

    def __contains__(self, domain: int) -> bool:
        return domain in self._resident

    @property
    def resident(self) -> list[int]:
        """The domains in memory, the least recently used first."""
        return list(self._resident)

    def touch(self, domain: int) -> bool:
        """Use a domain if it is in memory; return whether it is."""
        if domain not in self._resident:
            return False
        del self._resident[domain]
        self._resident[domain] = None
        self.hits += 1
        return True

    def load(self, domain: int) -> list[int]:
        """Bring a domain into memory as the most recently used one.

        Parameters
        ----------
        domain : int

        Returns
        -------
        list of int
            The domains that had to go, the least recently used first.

        Raises
        ------
        ScheduleError
            If the domain does not exist, is in memory already, or is larger than the whole cache.

        """
        if not 0 <= domain < len(self.nbytes):
            raise ScheduleError(f"there is no domain {domain}: the domains are 0 to {len(self.nbytes) - 1}")
        if domain in self._resident:
            raise ScheduleError(f"domain {domain} is in the domain cache already: touch it instead of loading it")
        size = self.nbytes[domain]
        if self.unit == "bytes" and size > self.capacity:
            raise ScheduleError(
                f"domain {domain} has {format_bytes(size)}, more than the whole domain cache of "
                f"{format_bytes(self.capacity)}: give the cache more memory, or cut the data into more domains"
            )
        evicted = []
        while not self._has_room(size):
            oldest = next(iter(self._resident))
            del self._resident[oldest]
            evicted.append(oldest)
            self._count_used()
        self._resident[domain] = None
        self._count_used()
        self.evictions += len(evicted)
        self.misses += 1
        self.loaded_bytes += size
        return evicted

    def replay(self, domains: Iterable[int]) -> NDArray[np.bool_]:
        """Use domains one after the other, loading those that are not in memory.

        Parameters
        ----------
        domains : iterable of int (accesses,)

        Returns
        -------
        bool array (accesses,)
            Which accesses had to load; their sum is the number of loads.

        """
        missed = []
        for domain in np.asarray(domains, np.int64).tolist():
            missed.append(not self.touch(domain))
            if missed[-1]:
                self.load(domain)
        return np.array(missed, np.bool_)

    def _has_room(self, size: float) -> bool:
        if self.unit == "domains":
            return len(self._resident) < self.capacity
        return self.used_bytes + size <= self.capacity

    def _count_used(self) -> None:
        # Summed anew, because what is added and taken away again leaves rounding behind.
        self.used_bytes = math.fsum(self.nbytes[domain] for domain in self._resident)


@dataclass(frozen=True, slots=True)
class BlockMap:
    """How the blocks of a data set are spread over ranks, and in which cache line a rank keeps a block of another.

    Block k belongs to rank k mod N, which has it at k div N of its resident array. Another rank r caches it in one of
    its C lines:

    - ``demarle``: line k mod C. The blocks that r owns take lines that they do not need: of two ranks with two lines
      each, rank 0 never uses line 0.
    - ``ize``: line (k - floor((k + N - r) / N)) mod C. The floor is how many of the blocks 0 to k are r's own, so this
      numbers the blocks that r does not own without a gap. The formula is as printed, and holds for each r from 0 to
      N - 1: for k < r the floor is 0.

    The root block, which every traversal begins with, is replicated on all ranks. Those that do not own it need no line
    for it, and leave its number unused.

    DeMarle et al. as told by Ize et al., Real-time ray tracer for visualization on a cluster, section 5.3.

    Parameters
    ----------
    ranks : int
        N, at least 1.
    lines : int
        C, of each rank: at least 1, or 0 for a single rank, which owns everything.
    mapping : "ize" or "demarle"
    root : int or None
        The block that every rank has; None for none.

    Raises
    ------
    ScheduleError
        If there are no ranks, no lines where there must be some, or no such mapping.

    """

    ranks: int
    lines: int
    mapping: BlockMapping = "ize"
    root: int | None = 0

    def __post_init__(self) -> None:
        if self.ranks < 1:
            raise ScheduleError(f"blocks are spread over at least 1 rank, got {self.ranks}")
        if self.lines < (self.ranks > 1):
            raise ScheduleError(f"{self.ranks} ranks need at least {int(self.ranks > 1)} cache lines, got {self.lines}")
        if self.mapping not in _MAPPINGS:
            near = did_you_mean(str(self.mapping), _MAPPINGS)
            raise ScheduleError(f"a mapping of blocks is 'ize' or 'demarle', got {self.mapping!r}{near}")

    def owner(self, blocks: _Blocks) -> _Blocks:
        """Return the rank that owns each block; one block or an int64 array."""
        return blocks % self.ranks

    def slot(self, blocks: _Blocks) -> _Blocks:
        """Return where in its owner's resident array each block is; one block or an int64 array."""
        return blocks // self.ranks

    def owned_count(self, blocks: int, rank: int) -> int:
        """Return how many of the first ``blocks`` blocks a rank owns."""
        return (blocks + self.ranks - 1 - rank) // self.ranks

    def line(self, blocks: ArrayLike, rank: int) -> NDArray[np.int64]:
        """Return the cache line of each block on a rank.

        Parameters
        ----------
        blocks : int array (blocks,)
            Not negative.
        rank : int
            From 0 to N - 1.

        Returns
        -------
        int64 array (blocks,)
            `NOTHING` for the blocks that the rank has anyway.

        Raises
        ------
        ScheduleError
            If a block is negative or there is no such rank.

        """
        self.check_rank(rank)
        numbers = np.asarray(blocks, np.int64)
        if numbers.size and numbers.min() < 0:
            raise ScheduleError(f"blocks are numbered from 0, got block {numbers.min()}")
        lines = self.number(numbers, rank) % max(self.lines, 1)
        return np.where(self.resident(numbers, rank), NOTHING, lines)

    def resident(self, blocks: _Blocks, rank: int) -> Any:
        """Return whether the rank has each block for good; a bool, or a bool array."""
        return (blocks % self.ranks == rank) | (blocks == (NOTHING if self.root is None else self.root))

    def number(self, blocks: _Blocks, rank: int) -> _Blocks:
        """Return the number that, modulo C, is the line of each block that the rank does not own."""
        if self.mapping == "demarle":
            return +blocks
        return blocks - (blocks + (self.ranks - rank)) // self.ranks

    def check_rank(self, rank: int) -> None:
        """Raise a ScheduleError if there is no such rank."""
        if not 0 <= rank < self.ranks:
            raise ScheduleError(f"there is no rank {rank}: the ranks are 0 to {self.ranks - 1}")


class DirectMappedCache:
    """The cache lines of one rank, each of which holds the block that was fetched into it last.

    The lines stay filled between calls, as they do between the frames of a camera path. Ize et al., section 5.3.

    Parameters
    ----------
    blocks : BlockMap
    rank : int

    Attributes
    ----------
    tags : int64 array (lines,)
        The block in each line; `NOTHING` for an empty one.
    residents, hits, misses : int
        References so far, by outcome.

    Raises
    ------
    ScheduleError
        If there is no such rank.

    """

    def __init__(self, blocks: BlockMap, rank: int) -> None:
        blocks.check_rank(rank)
        self.blocks, self.rank = blocks, rank
        self.tags = np.full(blocks.lines, NOTHING, np.int64)
        self.residents = self.hits = self.misses = 0

    @property
    def miss_rate(self) -> float:
        """Misses as a share of the references to blocks that the rank does not have anyway; 0 without any."""
        return self.misses / max(self.hits + self.misses, 1)

    def replay(self, references: ArrayLike) -> NDArray[np.int8]:
        """Pass a stream of references through the cache.

        Parameters
        ----------
        references : int array (references,)
            The block of each, in the order of the stream.

        Returns
        -------
        int8 array (references,)
            `RESIDENT`, `HIT` or `MISS`.

        Raises
        ------
        ScheduleError
            If a block is negative.

        """
        stream = np.ascontiguousarray(references, np.int64)
        outcomes: NDArray[np.int8] = np.empty(len(stream), np.int8)
        _kernel()(stream, self.blocks.line(stream, self.rank), self.tags, outcomes)
        residents, hits, misses = np.bincount(outcomes, minlength=MISS + 1).tolist()
        self.residents += residents
        self.hits += hits
        self.misses += misses
        return outcomes


@functools.cache
def _kernel() -> Callable[..., None]:
    """Return `_replay` in machine code; numba is imported here, by who replays a stream."""
    from numba import njit

    kernel: Callable[..., None] = njit(cache=True, nogil=True, error_model="numpy")(_replay)
    return kernel


def _replay(
    stream: NDArray[np.int64], lines: NDArray[np.int64], tags: NDArray[np.int64], outcomes: NDArray[np.int8]
) -> None:
    for i in range(len(stream)):
        line = lines[i]
        if line < 0:
            outcomes[i] = RESIDENT
        elif tags[line] == stream[i]:
            outcomes[i] = HIT
        else:
            tags[line] = stream[i]
            outcomes[i] = MISS
