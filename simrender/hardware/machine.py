"""Machines: a card becomes devices and links, each created when it is first used."""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator, Sequence
from functools import cached_property
from typing import Any, Literal

import numpy as np
import simpy
from pydantic import Field, model_validator

from simrender.cards import Card, Duration, Quantity, Spread
from simrender.catalog import find_card
from simrender.clock import to_ticks
from simrender.errors import CardError, UsageError, did_you_mean
from simrender.hardware.collectives import Communicator
from simrender.hardware.display import DisplayCard
from simrender.hardware.mpi import MpiCard, Staging, Transport
from simrender.hardware.network import Network
from simrender.hardware.processor import CopyEngine, CpuCard, GpuCard, Host, HostCard, Processor
from simrender.hardware.storage import LoadTimes, Storage, StorageCard, Where
from simrender.hardware.topology import InterconnectCard, NvlinkCard, PcieCard, Topology, check_groups


class VariabilityCard(Card):
    """How nodes that should be equal differ in speed; the slowest one sets the pace of them all.

    Attributes
    ----------
    spread : share
        Standard deviation of a node's durations, relative to their mean.
    distribution : str
        ``normal``, cut off at three standard deviations, or ``lognormal``, with its long tail of slow nodes.
    seed : int
        Each node draws from a stream of its own, so that one more node does not change the others.

    """

    spread: Spread
    distribution: Literal["normal", "lognormal"] = "normal"
    seed: int = Field(default=1, ge=0, strict=True)

    def slowness(self, node: int) -> float:
        """Return what every duration on a node is multiplied by."""
        draw = np.random.Generator(np.random.Philox(np.random.SeedSequence(self.seed, spawn_key=(node,)))).normal()
        if self.distribution == "normal":
            bound = min(
                3.0, 0.9 / max(self.spread, 0.01)
            )  # nothing takes no time; and both sides alike, so that the mean stays
            return 1.0 + self.spread * float(np.clip(draw, -bound, bound))
        width = np.sqrt(np.log1p(self.spread**2))
        return float(np.exp(width * draw - 0.5 * width**2))


class DisturbanceCard(Card):
    """A link that slows down, or fails, for a while.

    Attributes
    ----------
    link : str
        A link's name, as the result lists them.
    share : number
        Of its bandwidth that is left; 0 is a failure, and what is sent over it then fails.
    start, end : quantities
        Simulated time; without an end it stays so.

    """

    link: str
    share: float = Field(ge=0.0, le=1.0, strict=True)
    start: Duration
    end: Duration | None = None

    @model_validator(mode="after")
    def _ends_later(self) -> DisturbanceCard:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"a disturbance ends after it has begun, got {self.start.text} to {self.end.text}")
        return self


class MachineCard(Card):
    """One node with several GPUs, or a cluster of equal nodes.

    Attributes
    ----------
    nodes : int
        How many a job gets.
    gpus : int
        Of each node; none for a machine that renders on its processors.
    gpu, cpu, host : sections
        One GPU; the processors of a node; the thread that drives the GPUs.
    nvlink, pcie : sections
        What connects the GPUs of a node. Both, if NVLink connects pairs only.
    network, mpi : sections
        What connects the nodes, and how programs use it.
    storage, display : sections
    variability : section
        Off unless given.
    disturbances : list of sections

    """

    title: str
    nodes: int = Field(default=1, ge=1, strict=True)
    gpus: int = Field(default=0, ge=0, strict=True)
    gpu: GpuCard | None = None
    cpu: CpuCard | None = None
    nvlink: NvlinkCard | None = None
    pcie: PcieCard | None = None
    host: HostCard | None = None
    network: InterconnectCard | None = None
    mpi: MpiCard | None = None
    storage: StorageCard | None = None
    display: DisplayCard | None = None
    variability: VariabilityCard | None = None
    disturbances: list[DisturbanceCard] = Field(default_factory=list)

    @model_validator(mode="after")
    def _whole(self) -> MachineCard:
        if self.gpus:
            missing = [name for name in ("gpu", "host") if getattr(self, name) is None]
            if missing:
                raise ValueError(f"a machine with GPUs needs the section {' and the section '.join(missing)}")
        elif self.gpu is not None and "gpus" not in self.model_fields_set:
            raise ValueError("the section gpu goes with gpus, which says how many a node has")
        elif self.cpu is None:
            raise ValueError("a machine has GPUs (gpus and the section gpu) or renders on its processors (section cpu)")
        if self.nodes > 1 and self.network is None:
            raise ValueError(f"{self.nodes} nodes need the section network, which says what connects them")
        if self.gpus and self.network and not self.network.gpu_direct and self.host:
            for way in ("to_device", "from_device"):
                if getattr(self.host, way) is None:
                    raise ValueError(
                        f"messages of GPUs are staged (network.gpu_direct is false), which needs host.{way}"
                    )
        self._check_fabrics()
        return self

    def _check_fabrics(self) -> None:
        nvlink, pcie = self.nvlink, self.pcie
        if nvlink and nvlink.pairs is None and pcie:
            raise ValueError(
                "nvlink connects all GPUs; give its pairs, or leave one of the sections nvlink and pcie out"
            )
        if self.gpus > 1 and not pcie and not nvlink:
            raise ValueError(
                "a machine with several GPUs needs one of the sections nvlink and pcie, which connect them"
            )
        if nvlink and nvlink.pairs is not None and not pcie and self.gpus > 2:
            raise ValueError("nvlink connects pairs only; the section pcie says how the others reach each other")
        if nvlink:
            check_groups("nvlink.pairs", nvlink.pairs, self.gpus, all_named=False)
        if pcie:
            check_groups("pcie.switches", pcie.switches, self.gpus)
            check_groups("pcie.sockets", pcie.sockets, self.gpus)
            if self.network and pcie.sockets and self.network.socket >= len(pcie.sockets):
                raise ValueError(f"network.socket is {self.network.socket}, of {len(pcie.sockets)} sockets from 0 on")

    @property
    def processor(self) -> GpuCard | CpuCard:
        """What renders: a GPU if there are any, else the processors of a node."""
        card = self.gpu if self.gpus else self.cpu
        assert card is not None  # noqa: S101 - the validator saw to it
        return card

    @property
    def processor_section(self) -> str:
        """``gpu`` or ``cpu``."""
        return "gpu" if self.gpus else "cpu"

    @property
    def processor_noun(self) -> str:
        """What to call what renders: ``GPU`` or ``node``."""
        return "GPU" if self.gpus else "node"

    @property
    def node_processors(self) -> int:
        """How many processors of a node render: its GPUs, or all its cores as one."""
        return self.gpus or 1

    @property
    def processors(self) -> int:
        """How many processors of the machine render."""
        return self.nodes * self.node_processors


def load_machine(name: str, overrides: Sequence[str] = ()) -> MachineCard:
    """Return a machine's card by name or path.

    Parameters
    ----------
    name : str
        ``dgx2``, a variant such as ``frontera-rtx:fdr``, or the path of a YAML file.
    overrides : sequence of str
        ``PATH=VALUE`` without the leading ``machine.``.

    Raises
    ------
    UnknownNameError, CardError

    """
    document = find_card("machine", name).document()
    for override in overrides:
        document.override(MachineCard, override, "machine")
    card = document.validate(MachineCard)
    links = [str(link) for link in Topology(card, card.nodes).links] if card.disturbances else []
    mistakes = []
    for i, entry in enumerate(card.disturbances):
        if entry.link not in links:
            where = document.position(("disturbances", i, "link"))
            where += "" if where.endswith(".") else ": "  # that of a --set ends in the path's beginning
            near = did_you_mean(entry.link, links)
            mistakes.append(f"{where}disturbances.{i}.link: there is no link {entry.link!r}{near}")
    if mistakes:
        raise CardError(mistakes)
    return card


class Machine:
    """The devices of a machine inside one simulation.

    Parameters
    ----------
    env : simpy.Environment
    card : MachineCard
    processors : int
        How many of its processors the simulation may use, node by node from the first on.
    kernels_read : bool
        Whether kernels will read their neighbours' memory.
    record : bool
        Whether to log the load of every link.

    """

    def __init__(
        self,
        env: simpy.Environment,
        card: MachineCard,
        processors: int,
        *,
        kernels_read: bool = False,
        record: bool = False,
    ) -> None:
        self.env, self.card, self.kernels_read = env, card, kernels_read
        self.nodes = -(-processors // card.node_processors)
        self._count, self._record = processors, record
        self._processors: dict[int, Processor] = {}
        self._cpus: dict[int, Processor] = {}
        self._hosts: dict[int, Host] = {}
        self._engines: dict[int, list[CopyEngine]] = {}

    # -- devices --------------------------------------------------------------------------------------------------

    def processor(self, index: int) -> Processor:
        """Return a processor, created when first asked for."""
        if index not in self._processors:
            node, place = divmod(index, self.card.node_processors)
            prefix = f"node{node}." if self.card.nodes > 1 else ""
            name = f"{prefix}gpu{place}" if self.card.gpus else f"{prefix}cpu"
            self._processors[index] = Processor(name, self.card.processor, self._slowness(node))
        return self._processors[index]

    def _slowness(self, node: int) -> float:
        return self.card.variability.slowness(node) if self.card.variability else 1.0

    @property
    def processors(self) -> list[Processor]:
        """Those that came into being, in order."""
        return [self._processors[i] for i in sorted(self._processors)]

    def node_of(self, index: int) -> int:
        """Return the node that a processor is in."""
        return index // self.card.node_processors

    def host(self, node: int) -> Host:
        """Return the thread of a node that issues work, created when first asked for."""
        if node not in self._hosts:
            self._hosts[node] = Host(self.env, self.card.host or _NO_HOST)
        return self._hosts[node]

    @cached_property
    def topology(self) -> Topology:
        """The links and routes of the nodes in use."""
        return Topology(self.card, self.nodes)

    @property
    def has_network(self) -> bool:
        """Whether anything was ever sent."""
        return "network" in self.__dict__

    @cached_property
    def network(self) -> Network:
        """The links between the devices, created when something is first sent."""
        topology = self.topology
        network = Network(self.env, topology.links, topology.route, nodes=topology.devices, record=self._record)
        now = int(self.env.now)  # the network may come into being in the middle of a disturbance
        for entry in self.card.disturbances:
            end = None if entry.end is None else to_ticks(entry.end)
            if entry.link in topology.links and (end is None or end > now):
                network.disturb(entry.link, entry.share, max(now, to_ticks(entry.start)), end)
        return network

    @cached_property
    def storage(self) -> Storage:
        """The file systems.

        Raises
        ------
        UsageError
            If the card has none.

        """
        if self.card.storage is None:
            raise UsageError(f"{self.card.title} has no storage on its card; add a section storage")
        return Storage(self.env, self.network, self.card.storage)

    def cpu(self, node: int) -> Processor:
        """Return the cores of a node, which parse files whatever else renders, created when first asked for.

        Raises
        ------
        UsageError
            If the card does not say which processors the nodes have.

        """
        if self.card.cpu is None:
            raise UsageError(f"{self.card.title} has no processors on its card; add a section cpu")
        if not self.card.gpus:
            return self.processor(node)
        if node not in self._cpus:
            prefix = f"node{node}." if self.card.nodes > 1 else ""
            self._cpus[node] = Processor(f"{prefix}cpu", self.card.cpu, self._slowness(node))
        return self._cpus[node]

    def load(
        self, index: int, nbytes: float, primitives: float, *, where: Where | None = None
    ) -> Generator[simpy.Event, Any, LoadTimes]:
        """Load a domain for a processor: open and read its file, parse it, and build its acceleration structure.

        The cores of the node parse. A GPU that can build does so once the data have been copied to it; else the cores
        build, and the data are copied all the same.

        Parameters
        ----------
        index : int
            A processor.
        nbytes : float
            Size of the domain's file.
        primitives : float
            Triangles of the domain.
        where : "shared" or "local", optional
            The parallel file system unless there is none.

        Returns
        -------
        LoadTimes
            At the end of ``yield from``.

        Raises
        ------
        UsageError
            If the card has no storage or no processors.

        """
        storage, node = self.storage, self.node_of(index)
        cores = self.cpu(node)
        cpu = self.card.cpu
        assert cpu is not None  # noqa: S101 - self.cpu saw to it
        builder, rate = cores, float(cpu.build_rate)
        if self.card.gpus and self.card.gpu and self.card.gpu.build_rate is not None:
            builder, rate = self.processor(index), float(self.card.gpu.build_rate)
        place: Where = where or ("shared" if storage.card.shared else "local")
        return storage.load(
            node, nbytes, primitives, (cores, float(cpu.parse_bandwidth)), (builder, rate),
            device=index if self.card.gpus else None, where=place,
        )  # fmt: skip

    # -- moving data ----------------------------------------------------------------------------------------------

    def copy(self, source: int, target: int, nbytes: float, *, start: int | None = None) -> simpy.Event:
        """Copy from one processor's memory to another's with the source's copy engines.

        A copy between processors of different nodes is an MPI message and pays for that. GPUs send straight to each
        other where the adapter reaches them; else the message is staged through the memory of both hosts, which costs
        the links to both, their memory, and the time of the first and last piece.

        Parameters
        ----------
        source, target : int
        nbytes : float
        start : int, optional
            The earliest tick; now, unless given.

        Returns
        -------
        simpy.Event
            Its value is the tick at which the last byte has arrived.

        """
        begin = int(self.env.now) if start is None else start
        cap, delay = math.inf, 0
        if self.node_of(source) != self.node_of(target):
            cap, delay = self._transport.limit(source, target, nbytes)
            begin += self._transport.overhead_ticks

        def transfer(tick: int) -> simpy.Event:
            return self.network.transfer(source, target, nbytes, start=tick, cap=cap, delay=delay)

        return self._engine(source).submit(transfer, begin)

    def _engine(self, index: int) -> CopyEngine:
        """Return the copy engine of a processor with the fewest copies to do."""
        engines = self._engines.get(index)
        if engines is None:
            count = self.card.gpu.copy_engines if self.card.gpus and self.card.gpu else 1
            engines = self._engines[index] = [CopyEngine(self.env) for _ in range(count)]
        return min(engines, key=lambda engine: engine.waiting)

    def read(self, source: int, reader: int, nbytes: float, *, start: int | None = None) -> simpy.Event:
        """Have a kernel read another GPU's memory, which uses a link less well than a copy engine.

        Parameters
        ----------
        source, reader : int
        nbytes : float
        start : int, optional
            The tick at which the kernel begins; now, unless given.

        """
        fabric = self.topology.fabric(source, reader)
        cap = (fabric.kernel_share if fabric else 1.0) * self.network.bandwidth(source, reader)
        return self.network.transfer(source, reader, nbytes, start=start, cap=cap)

    def read_counters(self) -> simpy.Event:
        """Have each host read a counter from each of its processors, and all hosts learn all of them."""
        per_node, now = self.card.node_processors, int(self.env.now)
        shares = [min(per_node, self._count - node * per_node) for node in range(self.nodes)]
        ticks = [self.host(node).read_counters(share) for node, share in enumerate(shares)]
        if self.nodes == 1:
            return self.env.timeout(ticks[0] - now)
        return self.env.all_of([self.env.process(self._tell(node, tick)) for node, tick in enumerate(ticks)])

    def _tell(self, node: int, tick: int) -> Generator[simpy.Event, Any, None]:
        yield self.env.timeout(tick - int(self.env.now))
        yield self._host_ranks.rank(node).allgather(_COUNTER_BYTES * self.card.node_processors)

    @cached_property
    def _host_ranks(self) -> Communicator:
        return self.communicator(hosts=True)

    @cached_property
    def _staging(self) -> Staging | None:
        """What staging adds to a message between GPUs of different nodes; None where the adapter reaches the GPUs."""
        network, host = self.card.network, self.card.host
        if not self.card.gpus or network is None or host is None or network.gpu_direct:
            return None
        return Staging(
            float(network.staging_block or 0.0), float(host.from_device or 0.0), float(host.to_device or 0.0)
        )

    def communicator(self, ranks: Sequence[int] | None = None, *, hosts: bool = False) -> Communicator:
        """Return an MPI communicator of processors, or of the hosts of the nodes.

        Parameters
        ----------
        ranks : sequence of int, optional
            Processors, or nodes; all of them by default.
        hosts : bool
            One rank a node, with its data in the host's memory.

        Raises
        ------
        UsageError
            If the card does not say which MPI there is.

        """
        everyone = ranks is None and not hosts
        return Communicator(self.env, self._transport if everyone else self._make_transport(ranks, hosts=hosts))

    @cached_property
    def _transport(self) -> Transport:
        return self._make_transport(None, hosts=False)

    def _make_transport(self, ranks: Sequence[int] | None, *, hosts: bool) -> Transport:
        if self.card.mpi is None:
            raise UsageError(f"{self.card.title} has no MPI on its card; add a section mpi")
        chosen = list(range(self.nodes if hosts else self._count) if ranks is None else ranks)
        nodes = chosen if hosts else [self.node_of(i) for i in chosen]
        endpoints = [("host", n) for n in chosen] if hosts else chosen
        combined = self.card.cpu if hosts or not self.card.gpus else self.card.gpu
        # Combining reads two operands and writes one.
        bandwidth = combined.memory_bandwidth / 3.0 if combined else np.inf
        return Transport(
            self.network, self.card.mpi, endpoints, node_of=nodes, reduce_bandwidth=bandwidth,
            hosts=[("host", n) for n in nodes] if self.card.gpus else None, staging=None if hosts else self._staging,
        )  # fmt: skip

    # -- provenance -----------------------------------------------------------------------------------------------

    def quantities(self) -> Iterator[tuple[str, Quantity]]:
        """Yield the card's quantities that the simulation really used, with their paths."""
        card = self.card
        loads = "storage" in self.__dict__
        for path, quantity in card.processor.quantities(f"machine.{card.processor_section}."):
            if loads or not path.endswith(("build_rate", "parse_bandwidth")):
                yield path, quantity
        carried = self.network.carried_bytes.items() if self.has_network else ()
        used = [str(link) for link, nbytes in carried if nbytes]

        def over(*links: str) -> bool:
            return any(part in link for link in used for part in links)

        def of(section: str, *left_out: str) -> Iterator[tuple[str, Quantity]]:
            if found := getattr(card, section):
                for path, quantity in found.quantities(f"machine.{section}."):
                    if not any(part in path for part in left_out):
                        yield path, quantity

        if self._cpus:
            yield from of("cpu")
        elif card.gpus and card.cpu and over("staging", "memory"):
            yield "machine.cpu.memory_bandwidth", card.cpu.memory_bandwidth
        if self._hosts:
            yield from of("host", *(() if over("h2d", "d2h") else ("_device", "copy_latency")))
        yield from of("variability")
        if not self.has_network:
            return
        for fabric in ("nvlink", "pcie"):
            yield from of(fabric, *(() if self.kernels_read else (".kernel_share",)))
        if self.nodes > 1 or over(".nic."):
            unused = [*(() if over("leaf") else (".leaf.",)), *(() if over("staging") else (".staging_block",))]
            yield from of("network", *unused)
        if self.nodes > 1:
            yield from of("mpi")
        if loads:
            yield from of("storage")


_COUNTER_BYTES = 4.0
_NOTHING = Quantity(0.0, "0 s")
_NO_HOST = HostCard(launch_issue=_NOTHING, copy_issue=_NOTHING, readback=_NOTHING)
"""Cores need no thread that drives them."""


def check_processors(card: MachineCard, nodes: int | None, gpus: int | None) -> int:
    """Return how many processors to use, all by default.

    Parameters
    ----------
    card : MachineCard
    nodes : int or None
        Use only so many nodes.
    gpus : int or None
        Use only so many GPUs of those, node by node from the first on.

    Raises
    ------
    UsageError
        If the machine does not have that many, or none are asked for.

    """
    if nodes is not None and not 1 <= nodes <= card.nodes:
        raise UsageError(f"--nodes {nodes}: {card.title} has {_up_to(card.nodes, 'node')} to use")
    available = (card.nodes if nodes is None else nodes) * card.node_processors
    if gpus is None:
        return available
    if not card.gpus:
        raise UsageError(f"--gpus {gpus}: {card.title} has no GPUs; --nodes says how many nodes to use")
    if not 1 <= gpus <= available:
        of = "" if nodes is None else f" in {nodes} node{'s' if nodes > 1 else ''}"
        raise UsageError(f"--gpus {gpus}: {card.title} has {_up_to(available, 'GPU')} to use{of}")
    return gpus


def _up_to(count: int, noun: str) -> str:
    return f"1 to {count} {noun}s" if count > 1 else f"1 {noun}"
