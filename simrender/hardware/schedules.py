"""Collectives as schedules: which rank sends how many bytes to which, step by step.

Pure functions of the algorithm, the number of ranks and the sizes; they know neither time nor network. A rank enters a
step when it is done with those before; `simrender.hardware.collectives` executes that. The algorithms are those of
MPICH and Open MPI, as described by Thakur, Rabenseifner and Gropp, "Optimization of collective communication operations
in MPICH" (IJHPCA 19(1), 2005); Bruck et al., "Efficient algorithms for all-to-all communications in multiport
message-passing systems" (IEEE TPDS 8(11), 1997); Rabenseifner, "Optimization of collective reduction operations" (ICCS
2004); and Chen et al., "Performance evaluation of allgather algorithms on terascale Linux cluster with Fast Ethernet"
(HPC Asia 2005) for the neighbour exchange.

What a size means, here and in `simrender.hardware.collectives`:

=====================  =========================================================================================
bcast, reduce,         the whole vector. A vector of sizes gives the blocks into which an algorithm may cut it, instead
allreduce              of equal ones: as many as ranks, or as the largest power of two in it for Rabenseifner's
reduce_scatter         the whole vector, cut into equal blocks; or a vector, (ranks,), of what each rank ends up with
allgather, gather      what each rank contributes
allgatherv, gatherv    a vector, (ranks,), of what each rank contributes
alltoall               what each rank has for each other one
alltoallv              a matrix, (ranks, ranks): row i is what rank i has for the others; the diagonal does not move
barrier                nothing
=====================  =========================================================================================

Equal blocks are not rounded to whole bytes. What a rank has for itself is never a message.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.errors import ScheduleError, did_you_mean

THROTTLE: Final = 32
"""Messages that the scattered all-to-all has under way at once (MPICH's ``MPIR_CVAR_ALLTOALL_THROTTLE``)."""


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """The messages of one collective, sorted by step, then by source.

    Attributes
    ----------
    ranks : int
        How many take part, numbered from 0.
    step, source, target : int32 arrays, (messages,)
        Messages that one rank sends in one step leave in the order in which they stand here.
    nbytes : float64 array, (messages,)
    reduce_bytes : float64 array, (messages,)
        What the target combines with its own once it has received it: `nbytes`, or nothing.

    """

    ranks: int
    step: NDArray[np.int32]
    source: NDArray[np.int32]
    target: NDArray[np.int32]
    nbytes: NDArray[np.float64]
    reduce_bytes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.step)


Spans = Callable[[Any, Any], NDArray[np.float64]]
Sizes = ArrayLike
_Row = tuple[Any, Any, Any, Any, bool]
_Rows = list[_Row]


def schedule(collective: str, algorithm: str, ranks: int, nbytes: Sizes = 0.0, root: int = 0) -> Schedule:
    """Return the messages of a collective.

    Parameters
    ----------
    collective, algorithm : str
        One of `ALGORITHMS`.
    ranks : int
        At least 1.
    nbytes : float or array of float
        As the table of this module says.
    root : int
        Of bcast, reduce, gather and gatherv.

    Raises
    ------
    ScheduleError
        If there is no such algorithm, it cannot be used by that many ranks, or a size or the root is out of range.

    """
    build = _builder(collective, algorithm)
    if ranks < 1:
        raise ScheduleError(f"{collective} needs at least one rank, got {ranks}")
    if not 0 <= root < ranks:
        raise ScheduleError(f"{collective} has no root {root}: its ranks are 0 to {ranks - 1}")
    _check_ranks(collective, algorithm, ranks)
    sizes = np.asarray(nbytes, np.float64)
    if not (np.isfinite(sizes).all() and (sizes >= 0.0).all()):
        raise ScheduleError(f"the sizes of {collective} must be finite and not negative, got {nbytes!r}")
    shape = {"allgatherv": (ranks,), "gatherv": (ranks,), "alltoallv": (ranks, ranks)}.get(collective, ())
    whole_vector = collective in {"bcast", "reduce", "allreduce", "reduce_scatter"}
    if sizes.shape != shape and not (whole_vector and sizes.ndim == 1):
        expected = f"an array of shape {shape}" if shape else "one number"
        raise ScheduleError(f"the size of {collective} for {ranks} ranks is {expected}, got the shape {sizes.shape}")
    rows = build(ranks, np.roll(sizes, -root) if collective == "gatherv" else sizes) if ranks > 1 else []
    table = _table(ranks, rows, root)
    if collective in {"alltoallv", "gatherv"} and algorithm in DIRECT:
        table = _without_empty(table)  # as MPICH and Open MPI do, but not in their pairwise exchange
    return table


def _builder(collective: str, algorithm: str) -> Callable[[int, NDArray[np.float64]], _Rows]:
    if collective not in _BUILDERS:
        near = did_you_mean(collective, _BUILDERS)
        raise ScheduleError(f"there is no collective {collective!r}{near} (known: {', '.join(_BUILDERS)})")
    known = _BUILDERS[collective]
    if algorithm not in known:
        near = did_you_mean(algorithm, known)
        raise ScheduleError(f"{collective} has no algorithm {algorithm!r}{near} (known: {', '.join(known)})")
    return known[algorithm]


def usable(collective: str, algorithm: str, ranks: int) -> bool:
    """Return whether that many ranks can use an algorithm; if not, `INSTEAD` names one that any number can."""
    if (collective, algorithm) not in INSTEAD:
        return True
    return ranks % 2 == 0 or ranks == 1 if algorithm == "neighbor_exchange" else ranks & (ranks - 1) == 0


def _check_ranks(collective: str, algorithm: str, ranks: int) -> None:
    if not usable(collective, algorithm, ranks):
        kind = "an even number" if algorithm == "neighbor_exchange" else "a power of two"
        instead = INSTEAD[collective, algorithm]
        raise ScheduleError(f"{collective} by {algorithm} needs {kind} of ranks, got {ranks}; {instead} takes any")


def _table(ranks: int, rows: _Rows, root: int) -> Schedule:
    """Broadcast the rows against each other, number the ranks from the root on, and sort."""
    columns: list[list[NDArray[Any]]] = [[] for _ in range(5)]
    for step, source, target, nbytes, reduces in rows:
        row = np.broadcast_arrays(step, source, target, nbytes, np.where(reduces, nbytes, 0.0))
        for column, values in zip(columns, row, strict=True):
            column.append(values.ravel())
    steps, sources, targets, sizes, combined = (np.concatenate([*c, np.zeros(0)]) for c in columns)
    source, target = ((ends.astype(np.int64) + root) % ranks for ends in (sources, targets))
    key = steps.astype(np.int64) * ranks + source
    order: Any = np.argsort(key, kind="stable") if (key[1:] < key[:-1]).any() else slice(None)
    return Schedule(
        ranks,
        steps[order].astype(np.int32),
        source[order].astype(np.int32),
        target[order].astype(np.int32),
        sizes[order],
        combined[order],
    )


def _without_empty(table: Schedule) -> Schedule:
    full = table.nbytes > 0.0
    columns = (table.step, table.source, table.target, table.nbytes, table.reduce_bytes)
    return Schedule(table.ranks, *(column[full] for column in columns))  # type: ignore[arg-type]


def _spans(sizes: NDArray[np.float64]) -> Spans:
    """Return a function of (first, count) arrays: the bytes of that many blocks from the first on, cyclically."""
    if sizes.ndim == 0:
        return lambda first, count: np.broadcast_arrays(first, count)[1] * sizes
    ends = np.concatenate([[0.0], np.cumsum(np.tile(sizes, 2))])
    return lambda first, count: ends[np.asarray(first) + count] - ends[np.asarray(first)]


def _cut(nbytes: NDArray[np.float64], blocks: int) -> Spans:
    """Return the spans of a vector that is cut into blocks, equal ones unless their sizes are given."""
    if nbytes.ndim and len(nbytes) != blocks:
        raise ScheduleError(f"a vector of {blocks} blocks needs {blocks} sizes, got {len(nbytes)}")
    return _spans(nbytes if nbytes.ndim else nbytes / blocks)


def _masks(ranks: int) -> list[int]:
    """Return the powers of two below the number of ranks, ascending."""
    return [1 << k for k in range((ranks - 1).bit_length())]


# -- trees ----------------------------------------------------------------------------------------------------------


def _down(ranks: int, size: Callable[[Any, Any], Any]) -> _Rows:
    """Send down a binomial tree: the child at distance ``mask`` gets what its ``mask`` ranks are due."""
    rows: _Rows = []
    for step, mask in enumerate(reversed(_masks(ranks))):
        child = np.arange(mask, ranks, 2 * mask)
        rows.append((step, child - mask, child, size(child, np.minimum(mask, ranks - child)), False))
    return rows


def _up(ranks: int, size: Callable[[Any, Any], Any], *, reduces: bool) -> _Rows:
    """Send up a binomial tree, to the root."""
    rows: _Rows = []
    for step, mask in enumerate(_masks(ranks)):
        child = np.arange(mask, ranks, 2 * mask)
        rows.append((step, child, child - mask, size(child, np.minimum(mask, ranks - child)), reduces))
    return rows


def _later(rows: _Rows, steps: int) -> _Rows:
    return [(step + steps, *rest) for step, *rest in rows]


def _scatter_allgather(allgather: Callable[[int, Spans], _Rows]) -> Callable[[int, NDArray[np.float64]], _Rows]:
    """Van de Geijn's broadcast: scatter the vector, then gather it everywhere."""

    def build(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
        spans = _cut(nbytes, ranks)
        return _down(ranks, spans) + _later(allgather(ranks, spans), len(_masks(ranks)))

    return build


def _to_root(ranks: int, sizes: NDArray[np.float64]) -> _Rows:
    others = np.arange(1, ranks)
    return [(0, others, 0, _spans(sizes)(others, 1), False)]


# -- allgather ------------------------------------------------------------------------------------------------------


def _doubling(ranks: int, spans: Spans) -> _Rows:
    rank = np.arange(ranks)
    return [(k, rank, rank ^ m, spans(rank & -m, m), False) for k, m in enumerate(_masks(ranks))]


def _bruck(ranks: int, spans: Spans) -> _Rows:
    rank = np.arange(ranks)
    return [(k, rank, (rank - m) % ranks, spans(rank, min(m, ranks - m)), False) for k, m in enumerate(_masks(ranks))]


def _ring(ranks: int, spans: Spans) -> _Rows:
    rank, step = np.arange(ranks), np.arange(ranks - 1)[:, None]
    return [(step, rank, (rank + 1) % ranks, spans((rank - step) % ranks, 1), False)]


def _neighbors(ranks: int, spans: Spans) -> _Rows:
    """Pairs exchange what they have; then each passes on, alternately to its left and right, the last two blocks."""
    rank = np.arange(ranks)
    even = rank % 2 == 0
    first = np.where(even, rank + 1, rank - 1)
    second = np.where(even, rank - 1, rank + 1) % ranks
    rows: _Rows = [(0, rank, first, spans(rank, 1), False)]
    latest = rank & ~1  # the first of the two blocks that each received last
    for step in range(1, ranks // 2):
        target = second if step % 2 else first
        rows.append((step, rank, target, spans(latest, 2), False))
        latest = latest[target]  # partners send to each other
    return rows


# -- reductions -----------------------------------------------------------------------------------------------------


def _fold(ranks: int, *, keep_even: bool = False) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Pair off what exceeds a power of two; return who goes on, and of each pair who does and who waits."""
    power = 1 << (ranks.bit_length() - 1)
    spare = ranks - power
    even = 2 * np.arange(spare)
    stay, wait = (even, even + 1) if keep_even else (even + 1, even)
    return np.concatenate([stay, np.arange(2 * spare, ranks)]), stay, wait


def _halving(ranks: int, spans: Spans, masks: Sequence[int]) -> tuple[_Rows, list[NDArray[np.int64]]]:
    """Reduce-scatter by recursive halving; return also the first block of what each rank held after each step."""
    rank = np.arange(ranks)
    first, held, rows = np.zeros(ranks, np.int64), [], []
    for step, mask in enumerate(masks):
        half = ranks >> (step + 1)
        upper = (rank & mask) > 0
        rows.append((step, rank, rank ^ mask, spans(np.where(upper, first, first + half), half), True))
        first = np.where(upper, first + half, first)
        held.append(first)
    return rows, held


def _renamed(rows: _Rows, names: NDArray[np.int64]) -> _Rows:
    return [(step, names[source], names[target], nbytes, reduces) for step, source, target, nbytes, reduces in rows]


def _allreduce_doubling(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    """Exchange and combine everything, at distances 1, 2, 4; ranks beyond a power of two hand in first (MPICH)."""
    size = float(nbytes.sum())
    names, stay, wait = _fold(ranks)
    rank = np.arange(len(names))
    masks = _masks(len(names))
    rows: _Rows = [(1 + k, rank, rank ^ m, size, True) for k, m in enumerate(masks)]
    return [(0, wait, stay, size, True), *_renamed(rows, names), (1 + len(masks), stay, wait, size, False)]


def _allreduce_rabenseifner(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    names, stay, wait = _fold(ranks)
    spans, size = _cut(nbytes, len(names)), float(nbytes.sum())
    rank, masks = np.arange(len(names)), _masks(len(names))
    rows, held = _halving(len(names), spans, masks)
    for step, (mask, first) in enumerate(zip(reversed(masks), reversed(held), strict=True)):
        rows.append((len(masks) + step, rank, rank ^ mask, spans(first, 1 << step), False))
    rows = _later(_renamed(rows, names), 1)
    return [(0, wait, stay, size, True), *rows, (1 + 2 * len(masks), stay, wait, size, False)]


def _reduce_rabenseifner(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    """Reduce-scatter, then a binomial gather.

    Of a pair beyond the power of two the even rank goes on, so that the root always does; MPICH keeps the odd one and
    moves the root's part afterwards.
    """
    names, stay, wait = _fold(ranks, keep_even=True)
    spans, size = _cut(nbytes, len(names)), float(nbytes.sum())
    masks = _masks(len(names))
    rows, held = _halving(len(names), spans, masks)
    for step, (mask, first) in enumerate(zip(reversed(masks), reversed(held), strict=True)):
        giver = np.arange(mask, 2 * mask)  # those that gave nothing away yet have no bit above this one
        rows.append((len(masks) + step, giver, giver - mask, spans(first[giver], 1 << step), False))
    return [(0, wait, stay, size, True), *_later(_renamed(rows, names), 1)]


def _allreduce_ring(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    spans = _cut(nbytes, ranks)
    rank, step = np.arange(ranks), np.arange(ranks - 1)[:, None]
    right = (rank + 1) % ranks
    return [
        (step, rank, right, spans((rank - step) % ranks, 1), True),
        (step + ranks - 1, rank, right, spans((rank + 1 - step) % ranks, 1), False),
    ]


def _reduce_scatter_halving(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    """Halve what is left, at distances falling to 1; ranks beyond a power of two hand in first and get theirs (MPICH).

    Of a pair that hands in, the rank that goes on is after the blocks of both.
    """
    names, stay, wait = _fold(ranks)
    spans, size = _cut(nbytes, ranks), float(nbytes.sum())
    bounds = np.concatenate([wait, names[len(wait) :], [ranks]])  # each who goes on: from its block up to the next's
    masks = _masks(len(names))
    rows, _ = _halving(
        len(names), lambda first, count: spans(bounds[first], bounds[first + count] - bounds[first]), masks[::-1]
    )
    result = (1 + len(masks), stay, wait, spans(wait, 1), False)
    return [(0, wait, stay, size, True), *_later(_renamed(rows, names), 1), result]


def _reduce_scatter_pairwise(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    rank, step = np.arange(ranks), np.arange(1, ranks)[:, None]
    target = (rank + step) % ranks
    return [(step - 1, rank, target, _cut(nbytes, ranks)(target, 1), True)]


# -- all-to-all -----------------------------------------------------------------------------------------------------


def _pairs(sizes: NDArray[np.float64], source: Any, target: Any) -> Any:
    return sizes[source, target] if sizes.ndim else sizes


def _pairwise(ranks: int, sizes: NDArray[np.float64]) -> _Rows:
    """One partner after the other: ``rank ^ step`` for a power of two; otherwise one to the right, one to the left."""
    rank, step = np.arange(ranks), np.arange(1, ranks)[:, None]
    target = rank ^ step if ranks & (ranks - 1) == 0 else (rank + step) % ranks
    return [(step - 1, rank, target, _pairs(sizes, rank, target), False)]


def _at_once(throttle: int) -> Callable[[int, NDArray[np.float64]], _Rows]:
    """All messages, or so many at a time, from the left neighbour on leftwards."""

    def build(ranks: int, sizes: NDArray[np.float64]) -> _Rows:
        rank, distance = np.arange(ranks), np.arange(1, ranks)[:, None]
        target = (rank - distance) % ranks
        return [(distance // throttle if throttle else 0, rank, target, _pairs(sizes, rank, target), False)]

    return build


def _alltoall_bruck(ranks: int, nbytes: NDArray[np.float64]) -> _Rows:
    """Blocks that have to go a distance with the k-th bit set go 2^k in step k."""
    rank, distance = np.arange(ranks), np.arange(ranks)
    return [
        (k, rank, (rank + m) % ranks, np.count_nonzero(distance & m) * nbytes, False)
        for k, m in enumerate(_masks(ranks))
    ]


# -- the registry ---------------------------------------------------------------------------------------------------


def _contributions(
    algorithm: Callable[[int, Spans], _Rows],
) -> Callable[[int, NDArray[np.float64]], _Rows]:
    return lambda ranks, sizes: algorithm(ranks, _spans(sizes))


_ALLGATHER: Final[dict[str, Callable[[int, NDArray[np.float64]], _Rows]]] = {
    "recursive_doubling": _contributions(_doubling),
    "bruck": _contributions(_bruck),
    "ring": _contributions(_ring),
    "neighbor_exchange": _contributions(_neighbors),
}
_GATHER: Final[dict[str, Callable[[int, NDArray[np.float64]], _Rows]]] = {
    "binomial": lambda ranks, sizes: _up(ranks, _spans(sizes), reduces=False),
    "linear": _to_root,
}
_EXCHANGE: Final = {"pairwise": _pairwise, "scattered": _at_once(THROTTLE), "linear": _at_once(0)}

_BUILDERS: Final[dict[str, dict[str, Callable[[int, NDArray[np.float64]], _Rows]]]] = {
    "barrier": {
        "dissemination": lambda ranks, _: [
            (k, np.arange(ranks), (np.arange(ranks) + m) % ranks, 0.0, False) for k, m in enumerate(_masks(ranks))
        ],
    },
    "bcast": {
        "binomial": lambda ranks, nbytes: _down(ranks, lambda *_: nbytes.sum()),
        "scatter_recursive_doubling_allgather": _scatter_allgather(_doubling),
        "scatter_ring_allgather": _scatter_allgather(_ring),
    },
    "reduce": {
        "binomial": lambda ranks, nbytes: _up(ranks, lambda *_: nbytes.sum(), reduces=True),
        "rabenseifner": _reduce_rabenseifner,
    },
    "allreduce": {
        "recursive_doubling": _allreduce_doubling,
        "rabenseifner": _allreduce_rabenseifner,
        "ring": _allreduce_ring,
    },
    "allgather": _ALLGATHER,
    "allgatherv": _ALLGATHER,
    "alltoall": {**_EXCHANGE, "bruck": _alltoall_bruck},
    "alltoallv": _EXCHANGE,
    "gather": _GATHER,
    "gatherv": _GATHER,
    "reduce_scatter": {"recursive_halving": _reduce_scatter_halving, "pairwise": _reduce_scatter_pairwise},
}

ALGORITHMS: Final[Mapping[str, tuple[str, ...]]] = {name: tuple(known) for name, known in _BUILDERS.items()}
"""The algorithms of each collective."""

DIRECT: Final = ("linear", "scattered")
"""Algorithms in which a rank sends, or the root gets, many messages together."""

INSTEAD: Final[Mapping[tuple[str, str], str]] = {
    ("bcast", "scatter_recursive_doubling_allgather"): "scatter_ring_allgather",
    ("allgather", "recursive_doubling"): "bruck",
    ("allgather", "neighbor_exchange"): "ring",
    ("allgatherv", "recursive_doubling"): "bruck",
    ("allgatherv", "neighbor_exchange"): "ring",
}
"""Algorithms that need a power of two (the neighbour exchange: an even number) of ranks, and what takes any number."""


def closed_form(
    collective: str,
    algorithm: str,
    ranks: int,
    nbytes: float,
    alpha_s: float,
    beta_s_per_byte: float,
    gamma_s_per_byte: float = 0.0,
) -> float:
    """Return how long a collective takes without contention, all ranks beginning together.

    A message of n bytes takes alpha + n beta, combining n bytes n gamma: the costs of Thakur, Rabenseifner and Gropp
    (2005, section 3 and table 1) and of the comments in MPICH's sources, here also for numbers of ranks that are no
    power of two. A simulated schedule takes exactly that on a full crossbar, and on a star of one link up and one down
    a rank,

    - for any number of ranks if a sender waits for its receiver (rendezvous);
    - if messages are eager, where the algorithm treats all ranks alike (dissemination, ring, Bruck, pairwise and
      neighbour exchange), and for powers of two. Elsewhere an eager sender runs ahead of this: it ends a tree earlier,
      but on a star its message shares the way in with one that the receiver waits for first, as in a reduction by ranks
      of which some hand in.

    The direct algorithms (linear, scattered) are stated for one message after the other; a simulated rank does not wait
    for one to arrive before it sends the next, so that latencies overlap.

    Parameters
    ----------
    collective, algorithm : str
        One of `ALGORITHMS`.
    ranks : int
    nbytes : float
        As the table of this module says; for the v-variants what they have if all ranks have as much.
    alpha_s, beta_s_per_byte, gamma_s_per_byte : float
        Seconds a message, a byte sent, a byte combined.

    Returns
    -------
    float
        Seconds.

    Raises
    ------
    ScheduleError
        As `schedule`.

    """
    _builder(collective, algorithm)
    _check_ranks(collective, algorithm, ranks)
    if ranks == 1:
        return 0.0
    p, n = ranks, float(nbytes)
    levels = (p - 1).bit_length()
    power = 1 << (p.bit_length() - 1)
    extra = power < p  # ranks that hand in and are told the result
    lg = power.bit_length() - 1
    part, power_part = n * (p - 1) / p, n * (power - 1) / power
    # Who handed in with another halves the blocks of two; the lower halves have most of these.
    halves = n / p * sum(mask + min(mask, p - power) for mask in _masks(power))
    popcounts = sum(distance.bit_count() for distance in range(p)) if algorithm == "bruck" else 0
    messages, sent, combined = {
        ("barrier", "dissemination"): (levels, 0.0, 0.0),
        ("bcast", "binomial"): (levels, levels * n, 0.0),
        ("bcast", "scatter_recursive_doubling_allgather"): (2 * levels, 2.0 * part, 0.0),
        ("bcast", "scatter_ring_allgather"): (levels + p - 1, 2.0 * part, 0.0),
        ("reduce", "binomial"): (levels, levels * n, levels * n),
        ("reduce", "rabenseifner"): (2 * lg + extra, 2.0 * power_part + extra * n, power_part + extra * n),
        ("allreduce", "recursive_doubling"): (lg + 2 * extra, (lg + 2 * extra) * n, (lg + extra) * n),
        ("allreduce", "rabenseifner"): (2 * lg + 2 * extra, 2.0 * power_part + 2 * extra * n, power_part + extra * n),
        ("allreduce", "ring"): (2 * (p - 1), 2.0 * part, part),
        ("reduce_scatter", "recursive_halving"): (lg + 2 * extra, halves + extra * (n + n / p), halves + extra * n),
        ("reduce_scatter", "pairwise"): (p - 1, part, part),
        ("allgather", "recursive_doubling"): (lg, (p - 1) * n, 0.0),
        ("allgather", "bruck"): (levels, (p - 1) * n, 0.0),
        ("allgather", "ring"): (p - 1, (p - 1) * n, 0.0),
        ("allgather", "neighbor_exchange"): (p // 2, (p - 1) * n, 0.0),
        ("alltoall", "pairwise"): (p - 1, (p - 1) * n, 0.0),
        ("alltoall", "scattered"): (p - 1, (p - 1) * n, 0.0),
        ("alltoall", "linear"): (p - 1, (p - 1) * n, 0.0),
        ("alltoall", "bruck"): (levels, popcounts * n, 0.0),
        ("gather", "binomial"): (levels, (p - 1) * n, 0.0),
        ("gather", "linear"): (p - 1, (p - 1) * n, 0.0),
    }[collective.removesuffix("v"), algorithm]
    return messages * alpha_s + sent * beta_s_per_byte + combined * gamma_s_per_byte
