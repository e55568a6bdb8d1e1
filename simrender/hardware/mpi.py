"""MPI between ranks: what one message costs, and which algorithm a library takes for a collective.

A message pays the sender's overhead and the latency of its route, then shares the links with whatever else is under way
(`simrender.hardware.network`). That is LogGP (Alexandrov et al., "LogGP: incorporating long messages into the LogP
model", SPAA 1995) with its gap replaced by the fluid network, but for eager messages of one rank: its adapter sends
these in order, each when it could be through with the one before.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, field_validator

from simrender.cards import Card, Count, Duration, Quantity, Size
from simrender.clock import TICK_NOISE, TICKS_PER_SECOND, to_seconds, to_ticks
from simrender.errors import ScheduleError, did_you_mean
from simrender.hardware.network import WEIGHTS, Listener, Network
from simrender.hardware.schedules import INSTEAD, usable

Flavour = Literal["mpich", "openmpi", "mvapich2"]


class RangeCard(Card):
    """How messages between nodes fare that are not smaller than a size.

    Attributes
    ----------
    above : quantity
        The smallest message, in bytes.
    bandwidth : quantity
        The share of the route's bandwidth that one message gets, at most 2. What is above 1 leaves the links as the
        only limit.
    latency : quantity
        What the latency of the route is multiplied by, at least 1.

    """

    above: Size
    bandwidth: Count
    latency: Count

    @field_validator("bandwidth")
    @classmethod
    def _at_most_two(cls, share: Quantity) -> Quantity:
        if share > 2.0:
            raise ValueError(f"must be at most 2, got {share.text!r}")
        return share

    @field_validator("latency")
    @classmethod
    def _at_least_one(cls, factor: Quantity) -> Quantity:
        if factor < 1.0:
            raise ValueError(f"must be at least 1, got {factor.text!r}: the latency of the route is the least there is")
        return factor


class MpiCard(Card):
    """An MPI library on a machine.

    Attributes
    ----------
    flavour : str
        ``mpich``, ``openmpi`` or ``mvapich2``: whose switch points decide between algorithms (`choose`).
    overhead : quantity
        What each message costs its sender before it leaves (LogGP's o).
    eager : quantity
        A message up to this size leaves when its sender is ready; a larger one when both sides are (rendezvous).
    ranges : list of sections
        Piecewise factors by message size, ascending, for messages between nodes, as in SimGrid's SMPI. Below the first
        there are none.

    """

    flavour: Flavour
    overhead: Duration
    eager: Size
    ranges: list[RangeCard] = Field(default_factory=list)

    @field_validator("ranges")
    @classmethod
    def _ascend(cls, ranges: list[RangeCard]) -> list[RangeCard]:
        for before, after in itertools.pairwise(ranges):
            if after.above <= before.above:
                raise ValueError(
                    f"ranges must be given in ascending order of above, got {after.above.text} "
                    f"after {before.above.text}"
                )
        return ranges


@dataclass(frozen=True)
class Staging:
    """Messages of GPUs that go through the memory of both hosts, in pieces.

    Copying a piece overlaps with sending the one before, so a message takes as long as its slowest stage, and beside
    that the time in which the first piece comes into the host's memory and the last one leaves that of the other.

    Attributes
    ----------
    block_bytes : float
        A piece.
    from_device, to_device : float
        Bandwidth of a copy between a GPU and the host's memory, in B/s; 0 where the card does not say.

    """

    block_bytes: float
    from_device: float
    to_device: float

    def delay_ticks(self, nbytes: float) -> int:
        """Return what the two copies add to the latency of a message."""
        piece = min(nbytes, self.block_bytes) if self.block_bytes else nbytes
        return to_ticks(sum(piece / bandwidth for bandwidth in (self.from_device, self.to_device) if bandwidth))


class Transport:
    """Messages between ranks, each of which is a node of a network.

    Parameters
    ----------
    network : Network
    card : MpiCard
    endpoints : sequence of hashable
        The network's node for each rank.
    node_of : sequence of int, optional
        The machine's node that each rank is on; each on its own unless given. Only messages between different ones
        feel the card's ranges.
    reduce_bandwidth : float
        At which a rank combines what it received with its own, in B/s.
    hosts : sequence of hashable, optional
        The network's node of each rank's host, where the library runs; its own unless given. The card's latency factors
        are those of the way between hosts: what a message says in advance does not go to a GPU.
    staging : Staging, optional
        Messages between nodes are staged through host memory.

    Attributes
    ----------
    size : int
        How many ranks there are.
    overhead_ticks : int
    busy_until : int64 array, (size,)
        The tick at which each rank's adapter is through with its eager messages, as far as they are known. Whoever
        sends keeps it up to date.

    Raises
    ------
    ScheduleError
        If the arguments contradict each other.

    """

    def __init__(
        self,
        network: Network,
        card: MpiCard,
        endpoints: Sequence[Hashable],
        *,
        node_of: Sequence[int] | None = None,
        reduce_bandwidth: float = math.inf,
        hosts: Sequence[Hashable] | None = None,
        staging: Staging | None = None,
    ) -> None:
        if not endpoints:
            raise ScheduleError("a transport needs at least one endpoint")
        if node_of is not None and len(node_of) != len(endpoints):
            raise ScheduleError(f"node_of must have one entry a rank, got {len(node_of)} for {len(endpoints)} ranks")
        if not reduce_bandwidth > 0.0:
            raise ScheduleError(f"reduce_bandwidth must be above zero, got {reduce_bandwidth!r} B/s")
        self.network, self.card, self.reduce_bandwidth = network, card, reduce_bandwidth
        self.staging = staging
        self._hosts = list(endpoints if hosts is None else hosts)
        self.size = len(endpoints)
        self.overhead_ticks = to_ticks(card.overhead)
        self._endpoints = list(endpoints)
        self._node_of = list(range(self.size) if node_of is None else node_of)
        self._node_array = np.array(self._node_of)
        self.busy_until = np.zeros(self.size, np.int64)
        self._above = [float(r.above) for r in card.ranges]
        self._bandwidths: NDArray[np.float64] | None = None  # (size, size); not a number until asked for
        self._shares = np.array([1.0, *(min(1.0, float(r.bandwidth)) for r in card.ranges)])
        self._limits_of: dict[tuple[float, int], list[tuple[float, int]]] = {}

    def post(
        self,
        sources: NDArray[np.integer[Any]],
        targets: NDArray[np.integer[Any]],
        nbytes: NDArray[np.float64],
        starts: NDArray[np.int64],
        listener: Listener,
        keys: NDArray[np.int64],
        messages: NDArray[np.int64] | None = None,
    ) -> None:
        """Send messages from rank to rank.

        Parameters
        ----------
        sources, targets : int arrays, (n,)
            Ranks.
        nbytes : float64 array, (n,)
        starts : int64 array, (n,)
            The ticks at which they leave, the overhead being over.
        listener : callable
            Called with ``(keys, tick)`` when some have arrived (`Network.post`).
        keys : int64 array, (n,)
        messages : int64 array, (n,), optional
            As how many messages of one size each counts. Eager ones leave one after the other, an overhead apart;
            larger ones share the links as so many would.

        Raises
        ------
        UnreachableError, ScheduleError
            As `Network.post`.

        """
        nodes, senders, receivers = self._endpoints, sources.tolist(), targets.tolist()
        ends = [nodes[rank] for rank in senders], [nodes[rank] for rank in receivers]
        if not self._above and self.staging is None and messages is None:
            self.network.post(*ends, nbytes, starts, listener, keys)
            return
        each = nbytes if messages is None else nbytes / messages
        limits = [self.limit(*message) for message in zip(senders, receivers, each.tolist(), strict=True)]
        caps, delays = zip(*limits, strict=True) if limits else ((), ())
        if messages is None:
            self.network.post(*ends, nbytes, starts, listener, keys, caps=caps, delays=delays)
            return
        at_once = np.where(each <= float(self.card.eager), 1, np.minimum(messages, int(WEIGHTS[1])))
        most = np.array(caps) * at_once
        for i in np.flatnonzero((each <= float(self.card.eager)) & (messages > 1)).tolist():
            _, s_per_byte = self.alpha_beta(senders[i], receivers[i], float(each[i]))
            seconds = float(nbytes[i]) * s_per_byte + (int(messages[i]) - 1) * to_seconds(self.overhead_ticks)
            if nbytes[i] and seconds:
                most[i] = float(nbytes[i]) / seconds
        self.network.post(*ends, nbytes, starts, listener, keys, caps=most, delays=delays, weights=at_once)

    def size_class(self, nbytes: NDArray[np.float64]) -> NDArray[np.int64]:
        """Return a number for each message: equal for those that the card's protocols and ranges treat alike."""
        return 2 * np.searchsorted(self._above, nbytes, "right") + (nbytes > float(self.card.eager))

    def gap_ticks(
        self, sources: NDArray[np.integer[Any]], targets: NDArray[np.integer[Any]], nbytes: NDArray[np.float64]
    ) -> NDArray[np.int64]:
        """Return for how long eager messages keep their senders' adapters; 0 for larger ones.

        That is the time of their bytes with the links to themselves (LogGP's G). Ranks and sizes as for `post`.

        Raises
        ------
        UnreachableError
            If no route connects two of the ranks.

        """
        gaps = np.zeros(len(nbytes), np.int64)
        eager = np.flatnonzero((nbytes > 0.0) & (nbytes <= float(self.card.eager)))
        if not len(eager):
            return gaps
        sources, targets = sources[eager], targets[eager]
        if self._bandwidths is None:
            self._bandwidths = np.full((self.size, self.size), np.nan)
        rates = self._bandwidths[sources, targets]
        unknown = np.flatnonzero(np.isnan(rates))
        if len(unknown):
            nodes, bandwidth = self._endpoints, self.network.bandwidth
            pairs = zip(sources[unknown].tolist(), targets[unknown].tolist(), strict=True)
            rates[unknown] = [bandwidth(nodes[source], nodes[target]) for source, target in pairs]
            self._bandwidths[sources, targets] = rates
        if self._above:
            apart = self._node_array[sources] != self._node_array[targets]
            rows = np.searchsorted(self._above, nbytes[eager], "right")
            rates *= np.where(apart, self._shares[rows], 1.0)
        gaps[eager] = _whole_ticks(nbytes[eager] / rates * TICKS_PER_SECOND)
        return gaps

    def alpha_beta(self, source: int, target: int, nbytes: float) -> tuple[float, float]:
        """Return what a message costs that has the links to itself: seconds before its first byte, seconds a byte."""
        ends = self._endpoints[source], self._endpoints[target]
        cap, delay = self.limit(source, target, nbytes)
        alpha_s = to_seconds(self.overhead_ticks + self.network.latency_ticks(*ends) + delay)
        return alpha_s, 1.0 / min(self.network.bandwidth(*ends), cap)

    def reduce_seconds(self, nbytes: float) -> float:
        """Return how long a rank takes to combine received bytes with its own."""
        return nbytes / self.reduce_bandwidth

    def reduce_ticks(self, nbytes: ArrayLike) -> NDArray[np.int64]:
        """Return `reduce_seconds` of each of many, in ticks."""
        return _whole_ticks(np.asarray(nbytes, np.float64) / self.reduce_bandwidth * TICKS_PER_SECOND)

    def limit(self, source: int, target: int, nbytes: float) -> tuple[float, int]:
        """Return the most that a message gets in B/s, and its latency beside the route's in ticks."""
        if self._node_of[source] == self._node_of[target]:
            return math.inf, 0
        staged = self.staging.delay_ticks(nbytes) if self.staging else 0
        row = bisect.bisect_right(self._above, nbytes)
        if not row:
            return math.inf, staged
        ends, hosts = (self._endpoints[source], self._endpoints[target]), (self._hosts[source], self._hosts[target])
        route = self.network.bandwidth(*ends), self.network.latency_ticks(*hosts)
        limits = self._limits_of.get(route)
        if limits is None:  # routes of a machine differ in little else than their links
            bandwidth, latency = route
            limits = self._limits_of[route] = [
                (
                    bandwidth * r.bandwidth if r.bandwidth < 1.0 else math.inf,
                    int(_whole_ticks(np.array(r.latency * latency))) - latency,
                )
                for r in self.card.ranges
            ]
        cap, delay = limits[row - 1]
        return cap, delay + staged


def _whole_ticks(ticks: NDArray[np.float64]) -> NDArray[np.int64]:
    """Round up, as `simrender.clock.to_ticks` does."""
    whole = np.rint(ticks)
    return np.where(np.abs(ticks - whole) <= TICK_NOISE * ticks, whole, np.ceil(ticks)).astype(np.int64)


# -- which algorithm --------------------------------------------------------------------------------------------------

_K, _M = 1024, 1024 * 1024
_ANY: Final = math.inf
_POWER_OF_TWO: Final = "power of two"
_ALL, _SHARE, _ELEMENT = "of all ranks together", "of a rank's share", "of an element"


def _to(nbytes: float) -> float:
    """Return the switch of an algorithm that is taken up to a size, that size included."""
    return math.nextafter(nbytes, math.inf)


_Switch = tuple[float, str] | tuple[float, str, str]
_Row = tuple[float | str, tuple[_Switch, ...]]

# A row holds for fewer ranks than it says, the first that fits; a switch for fewer bytes than it says, likewise. Bytes
# are those of the call (the table of `simrender.hardware.schedules`), or else
# - of all ranks together: what an allgather collects in all;
# - of a rank's share: the vector over the number of ranks;
# - of an element: what one element would have if there were as many as the largest power of two in the number of ranks.
#   MPICH cuts no vector with fewer elements; 4 bytes each, as a pixel or a counter has, are taken for granted.
# A row without a counterpart among our algorithms has the nearest one:
# - trees and chains (linear, chain, pipeline, binary, split binary, k-nomial): binomial. Without segments, which is how
#   Open MPI's fixed rules call them, they differ in fan-out alone;
# - segmented ring: ring; its segments change what is combined while the rest is under way, not what is sent;
# - allreduce by reduce and bcast ("nonoverlapping"), up to 128 KiB: recursive_doubling;
# - reduce_scatter by a whole reduce, and by a butterfly: recursive_halving; by a ring: pairwise, which sends as much;
# - all-to-all, linear-sync: linear, for by default it has no limit on what is under way. Two-proc: pairwise;
#   scatter-dest: scattered; recursive doubling: bruck;
# - allgather, two-proc: recursive_doubling; allgatherv, two-proc: ring; its default, gather and bcast of a few
#   bytes: bruck;
# - barrier by any tree, ring, or recursive doubling: dissemination;
# - gather, linear-sync: linear.
# And what needs a power of two or an even number of ranks falls back as `schedules.INSTEAD` says, like the libraries.

_ALLGATHER_MPICH: tuple[_Row, ...] = (
    (_POWER_OF_TWO, ((512 * _K, "recursive_doubling", _ALL), (_ANY, "ring"))),
    (_ANY, ((80 * _K, "bruck", _ALL), (_ANY, "ring"))),
)
_MPICH: Final[Mapping[str, tuple[_Row, ...]]] = {
    "barrier": ((_ANY, ((_ANY, "dissemination"),)),),
    "bcast": (
        (8, ((_ANY, "binomial"),)),
        (
            _POWER_OF_TWO,
            (
                (_to(12 * _K), "binomial"),
                (_to(64 * _K), "scatter_recursive_doubling_allgather", _SHARE),
                (_ANY, "scatter_ring_allgather"),
            ),
        ),
        (_ANY, ((_to(12 * _K), "binomial", _SHARE), (_ANY, "scatter_ring_allgather"))),
    ),
    "reduce": ((_ANY, ((_to(2 * _K), "binomial"), (4, "binomial", _ELEMENT), (_ANY, "rabenseifner"))),),
    "allreduce": (
        (_ANY, ((_to(8), "recursive_doubling"), (4, "recursive_doubling", _ELEMENT), (_ANY, "rabenseifner"))),
    ),
    "allgather": _ALLGATHER_MPICH,
    "allgatherv": _ALLGATHER_MPICH,
    "alltoall": (
        (8, ((_to(32 * _K), "scattered"), (_ANY, "pairwise"))),
        (_ANY, ((_to(256), "bruck"), (_to(32 * _K), "scattered"), (_ANY, "pairwise"))),
    ),
    "alltoallv": ((_ANY, ((_ANY, "scattered"),)),),
    "gather": ((_ANY, ((_ANY, "binomial"),)),),
    "gatherv": ((_ANY, ((_ANY, "linear"),)),),
    "reduce_scatter": ((_ANY, ((512 * _K, "recursive_halving"), (_ANY, "pairwise"))),),
}

_RD, _RAB, _RING, _BRUCK, _PAIRS, _LINEAR = (
    "recursive_doubling", "rabenseifner", "ring", "bruck", "pairwise", "linear"
)  # fmt: skip
_NEAR, _TREE, _HALVING = "neighbor_exchange", "binomial", "recursive_halving"
_VAN_DE_GEIJN: Final = "scatter_recursive_doubling_allgather"

_OPENMPI: Final[Mapping[str, tuple[_Row, ...]]] = {
    "barrier": _MPICH["barrier"],
    "bcast": (
        (16, ((_ANY, _TREE),)),
        (32, ((_M, _TREE), (_ANY, _VAN_DE_GEIJN))),
        (1024, ((_ANY, _TREE),)),
        (2048, ((512 * _K, _TREE), (_ANY, _VAN_DE_GEIJN))),
        (_ANY, ((256 * _K, _TREE), (_ANY, _VAN_DE_GEIJN))),
    ),
    "reduce": ((4, ((8, _RAB), (_ANY, _TREE))), (_ANY, ((_ANY, _TREE),))),
    "allreduce": (
        (4, ((8, _RING), (4 * _K, _RD), (8 * _K, _RING), (16 * _K, _RD), (256 * _K, _RING), (_ANY, _RAB))),
        (8, ((16, _RING), (8 * _K, _RD), (_ANY, _RAB))),
        (16, ((8 * _K, _RD), (_ANY, _RAB))),
        (32, ((64, _RING), (4 * _K, _RD), (_ANY, _RAB))),
        (64, ((128, _RING), (_ANY, _RAB))),
        (256, ((256 * _K, _RD), (_ANY, _RAB))),
        (512, ((4 * _K, _RD), (_ANY, _RAB))),
        (2048, ((16 * _K, _RD), (_ANY, _RAB))),
        (4096, ((2 * _K, _RD), (4 * _K, _RING), (16 * _K, _RD), (_ANY, _RAB))),
        (_ANY, ((2 * _K, _RD), (16 * _K, _RING), (32 * _K, _RD), (_ANY, _RAB))),
    ),
    "allgather": (
        (32, ((_ANY, _RD),)),
        (64, ((_K, _RD), (64 * _K, _NEAR), (_ANY, _RING))),
        (128, ((512, _RD), (64 * _K, _NEAR), (_ANY, _RING))),
        (256, ((512, _RD), (128 * _K, _NEAR), (512 * _K, _RING), (_M, _NEAR), (_ANY, _RING))),
        (512, ((32, _RD), (128, _BRUCK), (_K, _RD), (128 * _K, _NEAR), (512 * _K, _RING), (_M, _NEAR), (_ANY, _RING))),
        (1024, ((64, _RD), (256, _BRUCK), (2 * _K, _RD), (_ANY, _NEAR))),
        (
            2048,
            ((4, _RD), (8, _BRUCK), (16, _RD), (32, _BRUCK), (256, _RD), (512, _BRUCK), (4 * _K, _RD), (_ANY, _NEAR)),
        ),
        (4096, ((32, _BRUCK), (128, _RD), (512, _BRUCK), (4 * _K, _RD), (_ANY, _NEAR))),
        (_ANY, ((2, _RD), (8, _BRUCK), (16, _RD), (512, _BRUCK), (4 * _K, _RD), (_ANY, _NEAR))),
    ),
    "allgatherv": (
        (3, ((_ANY, _RING),)),
        (8, ((256, _BRUCK), (4 * _K, _NEAR), (8 * _K, _RING), (16 * _K, _NEAR), (256 * _K, _BRUCK), (_ANY, _NEAR))),
        (16, ((_ANY, _BRUCK),)),
        (32, ((256 * _K, _BRUCK), (_ANY, _RING))),
        (64, ((8 * _K, _BRUCK), (_ANY, _RING))),
        (128, ((4 * _K, _BRUCK), (_ANY, _RING))),
        (256, ((_K, _BRUCK), (64 * _K, _NEAR), (_ANY, _RING))),
        (512, ((_K, _BRUCK), (_ANY, _RING))),
        (1024, ((4 * _K, _BRUCK), (_M, _NEAR), (_ANY, _RING))),
        (_ANY, ((4 * _K, _BRUCK), (_ANY, _NEAR))),
    ),
    "alltoall": (
        (3, ((32 * _K, _PAIRS), (256 * _K, _LINEAR), (_ANY, _PAIRS))),
        (8, ((512 * _K, _LINEAR), (_M, _PAIRS), (_ANY, _LINEAR))),
        (16, ((_ANY, _LINEAR),)),
        (32, ((4, _LINEAR), (512, _BRUCK), (_ANY, _LINEAR))),
        (64, ((512, _BRUCK), (_ANY, _LINEAR))),
        (256, ((_K, _BRUCK), (256 * _K, _LINEAR), (_ANY, _PAIRS))),
        (512, ((_K, _BRUCK), (32 * _K, _LINEAR), (_ANY, _PAIRS))),
        (1024, ((512, _BRUCK), (256 * _K, _LINEAR), (_ANY, _PAIRS))),
        (2048, ((512, _BRUCK), (_ANY, _LINEAR))),
        (4096, ((_K, _BRUCK), (_ANY, _LINEAR))),
        (_ANY, ((2 * _K, _BRUCK), (_ANY, _LINEAR))),
    ),
    "alltoallv": (
        (4, ((_ANY, _PAIRS),)),
        (64, ((_ANY, _LINEAR),)),
        (128, ((_ANY, _PAIRS),)),
        (256, ((_ANY, _LINEAR),)),
        (1024, ((_ANY, _PAIRS),)),
        (_ANY, ((_ANY, _LINEAR),)),
    ),
    "gather": (
        (4, ((4, _LINEAR), (32 * _K, _TREE), (64 * _K, _LINEAR), (128 * _K, _TREE), (_ANY, _LINEAR))),
        (8, ((_K, _TREE), (8 * _K, _LINEAR), (32 * _K, _TREE), (_ANY, _LINEAR))),
        (256, ((_ANY, _TREE),)),
        (512, ((2 * _K, _TREE), (8 * _K, _LINEAR), (_ANY, _TREE))),
        (_ANY, ((_ANY, _TREE),)),
    ),
    "gatherv": _MPICH["gatherv"],
    "reduce_scatter": (
        (4, ((64 * _K, _PAIRS), (128 * _K, _HALVING), (_ANY, _PAIRS))),
        (32, ((256 * _K, _HALVING), (_ANY, _PAIRS))),
        (64, ((512 * _K, _HALVING), (_ANY, _PAIRS))),
        (_ANY, ((_ANY, _HALVING),)),
    ),
}

_ALLGATHER_MVAPICH2: tuple[_Row, ...] = (
    (9, ((_to(_K), _RD), (_to(8 * _K), _RING), (_to(64 * _K), _RD), (_ANY, _RING))),
    (17, ((_to(32 * _K), _RD), (_ANY, _RING))),
    (33, ((_to(2 * _K), _RD), (_to(4 * _K), _RING), (_to(32 * _K), _RD), (_ANY, _RING))),
    (_ANY, ((_to(2 * _K), _RD), (_to(4 * _K), _RING), (_to(64 * _K), _RD), (_ANY, _RING))),
)
_MVAPICH2: Final[Mapping[str, tuple[_Row, ...]]] = {
    **_MPICH,
    "allreduce": ((_ANY, ((_to(2 * _K), _RD), (_ANY, _RAB))),),
    "allgather": _ALLGATHER_MVAPICH2,
    "allgatherv": _ALLGATHER_MVAPICH2,
    "alltoall": (
        (9, ((16, _BRUCK), (_ANY, "scattered"))),
        (17, ((_to(16), _BRUCK), (_ANY, "scattered"))),
        (_ANY, ((_to(256), _BRUCK), (_ANY, "scattered"))),
    ),
}
_TABLES: Final[Mapping[str, Mapping[str, tuple[_Row, ...]]]] = {
    "mpich": _MPICH,
    "openmpi": _OPENMPI,
    "mvapich2": _MVAPICH2,
}


def choose(flavour: str, collective: str, ranks: int, nbytes: float) -> str:
    """Return the algorithm that an MPI library takes for a collective.

    - ``mpich``: the generic rules of MPICH 4 for all transports.
    - ``openmpi``: the fixed rules of Open MPI 5's `tuned` component, for operations that commute. It has none for
      gatherv, which its basic component does linearly.
    - ``mvapich2``: the tables of MVAPICH2 2.3.7: for allreduce and allgather those of Frontera's RTX nodes with four
      ranks a node, for all-to-all those of its CPU nodes. A row holds up to its number of ranks, the largest beyond.
      Allgatherv takes allgather's; all other collectives are MPICH's, which MVAPICH2 derives from.

    None of them looks at which ranks share a node.

    Parameters
    ----------
    flavour : str
        ``mpich``, ``openmpi`` or ``mvapich2``.
    collective : str
        As in `simrender.hardware.schedules.ALGORITHMS`.
    ranks : int
    nbytes : float
        As the table of that module says; for allgatherv the mean of what the ranks contribute. The choice for
        alltoallv and gatherv does not depend on it.

    Raises
    ------
    ScheduleError
        If there is no such flavour or collective.

    """
    for name, known in ((flavour, list(_TABLES)), (collective, list(_MPICH))):
        if name not in known:
            kind = "flavour of MPI" if known[0] == "mpich" else "collective"
            raise ScheduleError(f"there is no {kind} {name!r}{did_you_mean(name, known)} (known: {', '.join(known)})")
    power = 1 << (ranks.bit_length() - 1)
    measures = {_ALL: nbytes * ranks, _SHARE: nbytes / ranks, _ELEMENT: nbytes / power}
    rows = _TABLES[flavour][collective]
    switches = next(row for limit, row in rows if (ranks == power if isinstance(limit, str) else ranks < limit))
    algorithm = next(
        name for below, name, *measure in switches if (measures[measure[0]] if measure else nbytes) < below
    )
    return algorithm if usable(collective, algorithm, ranks) else INSTEAD[collective, algorithm]
