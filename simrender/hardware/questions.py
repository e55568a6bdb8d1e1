"""Questions to a machine's network alone: how long a collective, a message, or a frame on its way to the display takes.

Pure functions of a card. All ranks begin together on an idle machine, and nothing else is sent meanwhile. Beside the
simulated time of a collective or a message stands the closed form without contention
(`simrender.hardware.schedules.closed_form`).
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final

import simpy

from simrender.cards import Quantity
from simrender.clock import to_seconds
from simrender.errors import UnknownNameError, UsageError, did_you_mean
from simrender.hardware.collectives import Communicator, run_until
from simrender.hardware.display import DisplayReport, simulate_display
from simrender.hardware.machine import Machine, MachineCard, check_processors
from simrender.hardware.mpi import choose
from simrender.hardware.network import LinkUse
from simrender.hardware.schedules import ALGORITHMS, Schedule, closed_form, schedule, usable

PATTERNS: Final = (*ALGORITHMS, "transfer", "display")
"""What `simrender network` can be asked for."""

GATHERING: Final = ("allgather", "allgatherv", "alltoall", "alltoallv", "gather", "gatherv")
"""Collectives whose size is that of one rank's part; the others' is that of the whole vector."""

_VECTORS: Final = ("allgatherv", "alltoallv", "gatherv")
_REDUCING: Final = ("reduce", "allreduce", "reduce_scatter")


@dataclass(frozen=True, slots=True)
class Answer:
    """What a collective or a message came to.

    Attributes
    ----------
    pattern : str
        One of `simrender.hardware.schedules.ALGORITHMS`, or ``transfer``.
    ranks : int
    ends : (int, int) or None
        Of a transfer, the ranks that send and receive it.
    nbytes : float
        As the table of `simrender.hardware.schedules` says; of a transfer, the message.
    algorithm : str or None
        None for a transfer.
    time_s : float
        From the common beginning until the last rank is done.
    closed_form_s : float
        Without contention, with the following for every message.
    alpha_s, beta_s_per_byte : float
        The longest latency and the lowest bandwidth of all pairs that talk: before the first byte, and for each byte.
    gamma_s_per_byte : float
        For each byte that a rank combines with its own; 0 where nothing is combined.
    messages : int
    sent_bytes : float
    staged : bool
        Whether messages went through host memory on their way between GPUs.
    links : dict of name to LinkUse
        The links that carried something.
    quantities : tuple of (path, Quantity)
        What the answer hangs on, with its place on the card.

    """

    pattern: str
    ranks: int
    ends: tuple[int, int] | None
    nbytes: float
    algorithm: str | None
    time_s: float
    closed_form_s: float
    alpha_s: float
    beta_s_per_byte: float
    gamma_s_per_byte: float
    messages: int
    sent_bytes: float
    staged: bool
    links: dict[str, LinkUse]
    quantities: tuple[tuple[str, Quantity], ...]

    @property
    def contention_ratio(self) -> float | None:
        """Time over closed form; None where that is no time."""
        return self.time_s / self.closed_form_s if self.closed_form_s else None

    @property
    def algorithm_bandwidth_bytes_per_s(self) -> float | None:
        """The size over the time, as nccl-tests state it: of all ranks together where each has a part of its own."""
        if self.pattern == "barrier" or not self.time_s:
            return None
        return self.nbytes * (self.ranks if self.pattern in GATHERING else 1) / self.time_s

    @property
    def busiest_link(self) -> str | None:
        """The link in use for the largest share of the time and of its bandwidth; the first of equal ones."""
        return busiest(self.links)


def find_pattern(name: str) -> str:
    """Return a pattern of `PATTERNS`; hyphens do for underscores.

    Raises
    ------
    UnknownNameError

    """
    pattern = name.replace("-", "_")
    if pattern not in PATTERNS:
        raise UnknownNameError("pattern", name, PATTERNS)
    return pattern


def busiest(links: dict[str, LinkUse]) -> str | None:
    """Return the name of the link with the highest mean utilization, the first of equal ones."""
    return max(links, key=lambda name: links[name].mean_utilization, default=None)


def carrying(use: dict[Hashable, LinkUse]) -> dict[str, LinkUse]:
    """Return the links that carried something, in the order of the machine's links."""
    return {str(name): link for name, link in use.items() if link.carried_bytes > 0.0}


def check_ranks(card: MachineCard, nodes: int | None, ranks: int | None, *, hosts: bool = False) -> int:
    """Return how many ranks there are to be, all by default.

    Raises
    ------
    UsageError
        If the machine does not have that many, or fewer than two.

    """
    available = check_processors(card, nodes, None)
    noun = card.processor_noun
    if hosts:
        available, noun = available // card.node_processors, "node"
    if available < 2:
        alone = (card.nodes if hosts else card.processors) == 1
        one = f"one {noun}" if alone else f"one {noun} in use"
        raise UsageError(f"{card.title} has {one}, and a message goes between two")
    if ranks is None:
        return available
    if not 2 <= ranks <= available:
        of = "" if nodes is None else f" in {nodes} node{'s' if nodes > 1 else ''}"
        room = "2" if available == 2 else f"2 to {available}"
        raise UsageError(f"--ranks {ranks}: {card.title} has room for {room} ranks, one a {noun}{of}")
    return ranks


def ask_collective(
    card: MachineCard,
    collective: str,
    ranks: int,
    nbytes: float = 0.0,
    *,
    algorithm: str | None = None,
    hosts: bool = False,
) -> Answer:
    """Return how long one collective takes, and what it does to the links.

    Parameters
    ----------
    card : MachineCard
    collective : str
        One of `simrender.hardware.schedules.ALGORITHMS`; those of vectors get equal parts.
    ranks : int
        At least 2, one a processor, node by node from the first on.
    nbytes : float
        As the table of `simrender.hardware.schedules` says.
    algorithm : str, optional
        The one that the card's MPI library takes, unless given.
    hosts : bool
        One rank a node, with its data in the host's memory.

    Raises
    ------
    UsageError
        If the card has no MPI, the machine is too small, or that many ranks cannot use the algorithm.
    LinkFailedError
        If a link that is needed fails meanwhile.

    """
    check_ranks(card, None, ranks, hosts=hosts)
    env = simpy.Environment()
    machine = Machine(env, card, ranks * (card.node_processors if hosts else 1))
    comm = machine.communicator(hosts=hosts)
    assert card.mpi is not None  # noqa: S101 - the communicator saw to it
    if algorithm is None:
        algorithm = choose(card.mpi.flavour, collective, ranks, nbytes)
    else:
        _check_algorithm(collective, algorithm, ranks)
    arguments: list[Any] = [nbytes] if collective not in _VECTORS else [[nbytes] * ranks]
    arguments = [] if collective == "barrier" else arguments
    members = [comm.rank(index) for index in range(ranks)]
    done = [getattr(member, collective)(*arguments, algorithm=algorithm) for member in members]
    run_until(env.all_of(done), comm)
    table = _schedule(collective, algorithm, ranks, nbytes)
    alpha_s, beta_s_per_byte = _slowest(comm, table)
    gamma_s_per_byte = comm.transport.reduce_seconds(1.0) if collective in _REDUCING else 0.0
    pairs = dict.fromkeys(zip(table.source.tolist(), table.target.tolist(), strict=True))
    return _answer(
        machine, _endpoints(pairs, hosts=hosts), collective, ranks, None, nbytes, algorithm,
        closed_form(collective, algorithm, ranks, nbytes, alpha_s, beta_s_per_byte, gamma_s_per_byte),
        (alpha_s, beta_s_per_byte, gamma_s_per_byte),
    )  # fmt: skip


def ask_transfer(
    card: MachineCard, nbytes: float, source: int = 0, target: int = 1, *, nodes: int | None = None, hosts: bool = False
) -> Answer:
    """Return how long one message takes; inside a node whose card has no MPI, one copy.

    Parameters
    ----------
    card : MachineCard
    nbytes : float
    source, target : int
        Two processors, numbered through all nodes, or with `hosts` two nodes.
    nodes : int, optional
        Use only so many nodes; all by default.
    hosts : bool
        From the memory of one host to that of another.

    Raises
    ------
    UsageError
        If the machine has no such processors, or needs an MPI and has none.

    """
    ranks = check_ranks(card, nodes, None, hosts=hosts)
    for option, rank in (("--from", source), ("--to", target)):
        if not 0 <= rank < ranks:
            noun = "node" if hosts else card.processor_noun
            raise UsageError(f"{option} {rank}: the {noun}s in use of {card.title} are numbered from 0 to {ranks - 1}")
    if source == target:
        raise UsageError(f"--from {source} --to {target}: a message goes from one rank to another")
    env = simpy.Environment()
    machine = Machine(env, card, ranks * (card.node_processors if hosts else 1))
    (ends,) = _endpoints([(source, target)], hosts=hosts)
    if card.mpi is None and not hosts and machine.node_of(source) == machine.node_of(target):
        env.run(machine.copy(source, target, nbytes))
        alpha_s = to_seconds(machine.network.latency_ticks(*ends))
        beta_s_per_byte = 1.0 / machine.network.bandwidth(*ends)
    else:
        comm = machine.communicator(hosts=hosts)
        comm.rank(source).isend(target, nbytes)
        run_until(comm.rank(target).irecv(source), comm)
        alpha_s, beta_s_per_byte = comm.transport.alpha_beta(source, target, nbytes)
    closed_form_s = alpha_s + nbytes * beta_s_per_byte
    costs = alpha_s, beta_s_per_byte, 0.0
    return _answer(machine, [ends], "transfer", 2, (source, target), nbytes, None, closed_form_s, costs)


def ask_display(
    card: MachineCard, resolution: tuple[int, int], *, copy_threads: int | None = None, **options: Any
) -> tuple[int, DisplayReport]:
    """Return the copy threads of a display node, the card's unless given, and how fast the display then is.

    Parameters
    ----------
    card : MachineCard
    resolution : (int, int)
    copy_threads : int, optional
    **options
        Those of `simrender.hardware.display.simulate_display`.

    Raises
    ------
    UsageError
        If the card has no display, or as `simulate_display`.

    """
    if card.display is None:
        raise UsageError(f"{card.title} has no display on its card; add a section display")
    threads = card.display.copy_threads if copy_threads is None else copy_threads
    return threads, simulate_display(card.display, resolution, copy_threads=threads, **options)


def _check_algorithm(collective: str, algorithm: str, ranks: int) -> None:
    """Refuse an algorithm that is not there or cannot do that many ranks, with a list of those that can."""
    able = [name for name in ALGORITHMS[collective] if usable(collective, name, ranks)]
    if algorithm not in ALGORITHMS[collective]:
        why = f"{collective} has no such algorithm{did_you_mean(algorithm, ALGORITHMS[collective])}"
    elif algorithm not in able:
        need = "an even number" if algorithm == "neighbor_exchange" else "a power of two"
        why = f"it needs {need} of ranks, got {ranks}"
    else:
        return
    raise UsageError(f"--algorithm {algorithm}: {why} ({ranks} ranks can take: {', '.join(able)})")


def _schedule(collective: str, algorithm: str, ranks: int, nbytes: float) -> Schedule:
    if collective == "alltoallv":
        return schedule("alltoall", algorithm, ranks, nbytes)
    return schedule(collective, algorithm, ranks, [nbytes] * ranks if collective in _VECTORS else nbytes)


def _slowest(comm: Communicator, table: Schedule) -> tuple[float, float]:
    """Return the longest latency and the lowest bandwidth, as s/B, of all pairs that talk, for the largest message."""
    pairs = dict.fromkeys(zip(table.source.tolist(), table.target.tolist(), strict=True))
    costs = [comm.transport.alpha_beta(*pair, float(table.nbytes.max())) for pair in pairs]
    return max(alpha for alpha, _ in costs), max(beta for _, beta in costs)


def _endpoints(pairs: Iterable[tuple[int, int]], *, hosts: bool) -> list[tuple[Hashable, Hashable]]:
    return [(("host", a), ("host", b)) if hosts else (a, b) for a, b in pairs]


def _answer(
    machine: Machine,
    pairs: list[tuple[Hashable, Hashable]],
    pattern: str,
    ranks: int,
    ends: tuple[int, int] | None,
    nbytes: float,
    algorithm: str | None,
    closed_form_s: float,
    costs: tuple[float, float, float],
) -> Answer:
    network = machine.network
    return Answer(
        pattern, ranks, ends, nbytes, algorithm, to_seconds(int(machine.env.now)), closed_form_s, *costs,
        messages=network.flows_finished,
        sent_bytes=network.sent_bytes,
        staged=any(machine.topology.staged(*pair) for pair in pairs),
        links=carrying(network.use),
        quantities=tuple(_quantities(machine, pairs, reduces=costs[2] > 0.0)),
    )  # fmt: skip


def _quantities(
    machine: Machine, pairs: list[tuple[Hashable, Hashable]], *, reduces: bool
) -> Iterator[tuple[str, Quantity]]:
    """Yield the quantities of the card that messages between these pairs hang on, in the order of the card."""
    card, topology = machine.card, machine.topology
    links = dict.fromkeys(name for pair in pairs for name in topology.route(*pair) or ())
    used = [path for link in links for path in topology.sources(link)]
    if any(topology.staged(*pair) for pair in pairs):
        used.append("network.staging_block")
    if reduces:
        on_host = isinstance(pairs[0][0], tuple)
        used.append("cpu.memory_bandwidth" if on_host else f"{card.processor_section}.memory_bandwidth")
    for path, quantity in card.quantities():
        if path in used or path.startswith("mpi."):
            yield f"machine.{path}", quantity
