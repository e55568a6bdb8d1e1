"""What connects the devices of a machine: the links of its nodes and between them, and the routes over them.

The devices that messages go between are the processors, numbered through all nodes (integers), and

- ``("host", n)``, the memory of node n,
- ``("disk", n)``, its disk,
- ``"storage"``, the parallel file system,
- ``("display", d)``, a display node. Its own adapter is the display's (`simrender.hardware.display`).
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator
from typing import Any, Final

import numpy as np
from pydantic import Field, model_validator

from simrender.cards import Bandwidth, Card, Count, Duration, Share, Size
from simrender.hardware.network import Link

Groups = list[list[int]]


class FabricCard(Card):
    """What connects the GPUs of one node.

    Attributes
    ----------
    bandwidth : quantity
        Of one copy from one GPU to another while nothing else moves.
    duplex : share
        A GPU that sends and receives at once reaches this share of twice the bandwidth.
    latency : quantity
        Of a copy, from its start on the GPU to its first byte.
    kernel_share : share
        Of the bandwidth, for kernels that read a neighbour's memory instead of a copy engine.

    """

    bandwidth: Bandwidth
    duplex: Share
    latency: Duration
    kernel_share: Share


class NvlinkCard(FabricCard):
    """NVLink: through NVSwitch, a crossbar that never blocks, or straight between pairs of GPUs.

    Attributes
    ----------
    pairs : list of pairs, optional
        Which GPUs are bridged; all reach each other through NVSwitch without it.

    """

    pairs: Groups | None = None

    @model_validator(mode="after")
    def _two_by_two(self) -> NvlinkCard:
        for pair in self.pairs or []:
            if len(pair) != 2 or pair[0] == pair[1]:
                raise ValueError(f"pairs: a bridge connects two GPUs, got {pair}")
        named = [gpu for pair in self.pairs or [] for gpu in pair]
        if len(set(named)) < len(named):
            raise ValueError(f"pairs: a GPU is in one pair at most, got {self.pairs}")
        return self


class PcieCard(FabricCard):
    """PCIe: a tree of switches below the root complexes of the sockets.

    Attributes
    ----------
    switches : list of lists, optional
        The GPUs behind each switch, in which they reach each other at full speed.
    uplink : quantity, optional
        Of a switch, each way; shared by all that its GPUs send out of it.
    sockets : list of lists, optional
        The GPUs at each socket's root complex.
    socket_link : quantity, optional
        Between two sockets, each way; shared by all that crosses over.

    """

    switches: Groups | None = None
    uplink: Bandwidth | None = None
    sockets: Groups | None = None
    socket_link: Bandwidth | None = None

    @model_validator(mode="after")
    def _whole_tree(self) -> PcieCard:
        for groups, link in (("switches", "uplink"), ("sockets", "socket_link")):
            if (getattr(self, groups) is None) != (getattr(self, link) is None):
                raise ValueError(f"{groups} and {link} go together")
        for s, switch in enumerate(self.switches or []):
            if len({_group_of(self.sockets, gpu) for gpu in switch}) > 1:
                raise ValueError(f"switches: the GPUs of switch {s}, {switch}, are at different sockets")
        return self


class LeafCard(Card):
    """A fat tree of two levels: how many nodes a leaf switch serves, and by how much its up-links are oversubscribed.

    Attributes
    ----------
    nodes : int
        On each leaf switch.
    oversubscription : quantity
        Bandwidth of its nodes over that of its up-links; 1 is a full fat tree.
    latency : quantity
        Of the way up to the core and down again, on top of that through the leaf switch.

    """

    nodes: int = Field(ge=1, strict=True)
    oversubscription: Count
    latency: Duration


class InterconnectCard(Card):
    """What connects the nodes.

    Attributes
    ----------
    technology : str
    bandwidth : quantity
        Of a node's adapter, each way, as a program gets it.
    latency : quantity
        Of a small message from the memory of one node to that of another on the same switch.
    leaf : section, optional
        The leaf switches; one switch connects all nodes without it. Up-links are one fat link a leaf: traffic is spread
        over them evenly.
    socket : int
        Where in each node the adapter is.
    gpu_direct : bool
        Whether the adapter reads and writes the memory of GPUs; else messages are staged through that of the host.
    staging_block : quantity
        Staged messages are sent in such pieces, so that the copies and the sending overlap.

    """

    technology: str
    bandwidth: Bandwidth
    latency: Duration
    leaf: LeafCard | None = None
    socket: int = Field(default=0, ge=0, strict=True)
    gpu_direct: bool = False
    staging_block: Size | None = None


_SOURCES: Final = {
    "gpu-gpu": ("nvlink.bandwidth", "nvlink.duplex", "nvlink.latency"),
    "gpu+gpu": ("nvlink.bandwidth", "nvlink.duplex", "nvlink.latency"),
    "switch.up": ("pcie.uplink",),
    "switch.down": ("pcie.uplink",),
    "socket-socket": ("pcie.socket_link",),
    "gpu.d2h": ("host.from_device", "host.copy_latency"),
    "gpu.h2d": ("host.to_device", "host.copy_latency"),
    "memory": ("cpu.memory_bandwidth",),
    "staging": ("cpu.memory_bandwidth",),
    "nic.out": ("network.bandwidth", "network.latency"),
    "nic.in": ("network.bandwidth", "network.latency"),
    "leaf.up": ("network.leaf.oversubscription", "network.leaf.latency"),
    "leaf.down": ("network.leaf.oversubscription", "network.leaf.latency"),
    "storage": ("storage.shared.server_bandwidth",),
    "client": ("storage.shared.client_bandwidth",),
    "disk": ("storage.local.bandwidth",),
}
"""What links hang on, by their names without numbers."""


def _group_of(groups: Groups | None, member: int) -> int | None:
    return next((g for g, group in enumerate(groups or []) if member in group), None)


def check_groups(name: str, groups: Groups | None, gpus: int, *, all_named: bool = True) -> None:
    """Make sure that groups of GPUs name each of them once.

    Raises
    ------
    ValueError

    """
    named = sorted(gpu for group in groups or [] for gpu in group)
    if groups is not None and (named != list(range(gpus)) if all_named else any(g not in range(gpus) for g in named)):
        must = f"must name each GPU from 0 to {gpus - 1} once" if all_named else f"may name GPUs 0 to {gpus - 1}"
        raise ValueError(f"{name} {must}, got {groups}")


class Topology:
    """The links of a machine by name, and the routes over them.

    Names say where a link is: ``node2.gpu1.out``, ``node2.switch0.up``, ``node2.nic.out``, ``leaf0.up``; a machine of
    one node leaves ``node0.`` away, but for its disk and its share of the file system.

    Parameters
    ----------
    card : MachineCard
    nodes : int
        How many of its nodes there are.

    Attributes
    ----------
    links : dict of name to Link

    """

    def __init__(self, card: Any, nodes: int) -> None:
        self.card, self.nodes = card, nodes
        self._places: dict[Hashable, tuple[str, int, int | None] | None] = {}
        self.links: dict[Hashable, Link] = {}
        for node in range(nodes):
            self._add_node(node)
        if self.has_network:
            self._add_network()
        if card.storage is not None:
            from simrender.hardware.storage import storage_links

            self.links |= storage_links(card.storage, nodes)

    @property
    def devices(self) -> Iterator[Hashable]:
        """Everything that messages go between."""
        card = self.card
        yield from range(self.nodes * card.node_processors)
        for node in range(self.nodes):
            yield "host", node
            if card.storage and card.storage.local:
                yield "disk", node
        if card.storage and card.storage.shared:
            yield "storage"
        for display in range(card.display.nodes if card.display else 0):
            yield "display", display

    def prefix(self, node: int) -> str:
        """Return what the names of a node's links begin with."""
        return f"node{node}." if self.card.nodes > 1 else ""

    # -- links ----------------------------------------------------------------------------------------------------

    def _add_node(self, node: int) -> None:
        card, p = self.card, self.prefix(node)
        lanes = card.pcie or (card.nvlink if card.nvlink and card.nvlink.pairs is None else None)
        for gpu in range(card.gpus):
            if lanes is not None:
                self._add_lanes(f"{p}gpu{gpu}", lanes)
            if card.pcie:
                self._add_slot(f"{p}gpu{gpu}")
            if host := card.host:
                lane_latency = 0.5 * card.pcie.latency if card.pcie else 0.0
                latency = max(0.0, host.copy_latency - lane_latency)
                for way, bandwidth in (("h2d", host.to_device), ("d2h", host.from_device)):
                    if bandwidth is not None:
                        self.links[f"{p}gpu{gpu}.{way}"] = Link(bandwidth, latency)
        for a, b in (card.nvlink.pairs or []) if card.nvlink else []:
            nvlink, both = card.nvlink, f"{p}gpu{a}+gpu{b}"
            self.links[f"{p}gpu{a}-gpu{b}"] = self.links[f"{p}gpu{b}-gpu{a}"] = Link(float(nvlink.bandwidth))
            self.links[both] = Link(2.0 * nvlink.bandwidth * nvlink.duplex, nvlink.latency)
        if pcie := card.pcie:
            for switch in range(len(pcie.switches or [])):
                self.links[f"{p}switch{switch}.up"] = self.links[f"{p}switch{switch}.down"] = Link(pcie.uplink)
            for a in range(len(pcie.sockets or [])):
                for b in range(len(pcie.sockets or [])):
                    if a != b:
                        self.links[f"{p}socket{a}-socket{b}"] = Link(pcie.socket_link)
        if card.cpu is not None and card.gpus:
            self.links[f"{p}memory"] = Link(card.cpu.memory_bandwidth)
        if card.cpu is not None and card.gpus and card.network is not None and not card.network.gpu_direct:
            # What is staged is written to memory and read from it again.
            self.links[f"{p}staging"] = Link(0.5 * card.cpu.memory_bandwidth)

    def _add_lanes(self, name: str, fabric: FabricCard) -> None:
        """Add what a GPU can send to others and get from them, and its port, which cannot do both at full speed."""
        lane = float(fabric.bandwidth)
        self.links[f"{name}.out"] = self.links[f"{name}.in"] = Link(lane)
        latency = 0.0 if isinstance(fabric, PcieCard) else 0.5 * fabric.latency  # that of PCIe is its slot's
        self.links[f"{name}.port"] = Link(2.0 * lane * fabric.duplex, latency)

    def _add_slot(self, name: str) -> None:
        """Add the lanes of a GPU's slot, which all its traffic shares: with other GPUs, the host and the adapter."""
        pcie, host = self.card.pcie, self.card.host
        for way, of_host in (("up", host.from_device), ("down", host.to_device)):
            bandwidth = max(float(pcie.bandwidth), float(of_host or 0.0))
            self.links[f"{name}.slot.{way}"] = Link(bandwidth, 0.5 * pcie.latency)

    def _add_network(self) -> None:
        network = self.card.network
        for node in range(self.nodes):
            name = f"node{node}.nic"
            self.links[f"{name}.out"] = self.links[f"{name}.in"] = Link(network.bandwidth, 0.5 * network.latency)
        if leaf := network.leaf:
            uplink = Link(leaf.nodes * network.bandwidth / leaf.oversubscription, 0.5 * leaf.latency)
            for i in range(-(-self.nodes // leaf.nodes)):
                self.links[f"leaf{i}.up"] = self.links[f"leaf{i}.down"] = uplink

    def sources(self, link: str) -> tuple[str, ...]:
        """Return the paths of the values on the card that a link's bandwidth and latency hang on."""
        name = re.sub(r"^node\d+\.", "", link)
        name = re.sub(r"(?<=[a-z])\d+(?![a-z])", "", name)  # d2h keeps its own
        card, host = self.card, self.card.host
        if name in {"gpu.out", "gpu.in", "gpu.port"}:
            lanes = "pcie" if card.pcie else "nvlink"
            return f"{lanes}.bandwidth", f"{lanes}.duplex", f"{lanes}.latency"
        if name in {"gpu.slot.up", "gpu.slot.down"}:
            way = "from_device" if name == "gpu.slot.up" else "to_device"
            wider = getattr(host, way) is not None and getattr(host, way) > card.pcie.bandwidth
            return f"host.{way}" if wider else "pcie.bandwidth", "pcie.latency"
        return _SOURCES[name]

    # -- routes ---------------------------------------------------------------------------------------------------

    def fabric(self, source: int, target: int) -> FabricCard | None:
        """Return what two GPUs of one node reach each other over; None where the card does not say."""
        nvlink: NvlinkCard | None = self.card.nvlink
        pcie: PcieCard | None = self.card.pcie
        if nvlink and nvlink.pairs is not None:
            (node, gpu), (other, other_gpu) = (divmod(i, self.card.node_processors) for i in (source, target))
            pair = _group_of(nvlink.pairs, gpu)
            return nvlink if node == other and pair is not None and pair == _group_of(nvlink.pairs, other_gpu) else pcie
        return nvlink or pcie

    def route(self, source: Hashable, target: Hashable) -> tuple[str, ...] | None:
        """Return the links from one device to another, or None where there is no way."""
        if source == target:
            return ()
        a, b = self._known_place(source), self._known_place(target)
        if a is None or b is None:
            return None
        (kind, node, gpu), (target_kind, other, other_gpu) = a, b
        if kind in {"storage", "disk"} or target_kind == "storage":
            return self._from_file(kind, target_kind, other) if kind == "storage" or node == other else None
        if target_kind == "display":
            return (*self._to_nic(node, gpu), *self._between(node, 0)) if self.has_network else None
        if kind == "display" or target_kind == "disk":
            return None
        if node != other:
            return (*self._to_nic(node, gpu), *self._between(node, other), *self._from_nic(other, other_gpu))
        return self._inside(node, gpu, other_gpu)

    @property
    def has_network(self) -> bool:
        """Whether there is anything between nodes."""
        return self.card.network is not None and self.card.nodes > 1

    def staged(self, source: Hashable, target: Hashable) -> bool:
        """Tell whether a message between two devices is staged through host memory."""
        a, b = self._place(source), self._place(target)
        gpus = [place for place in (a, b) if place is not None and place[2] is not None]
        return bool(gpus) and a is not None and b is not None and a[1] != b[1] and not self.card.network.gpu_direct

    def _known_place(self, device: Hashable) -> tuple[str, int, int | None] | None:
        if device not in self._places:
            self._places[device] = self._place(device)
        return self._places[device]

    def _place(self, device: Any) -> tuple[str, int, int | None] | None:
        """Return what kind of device it is, on which node, and which of the node's GPUs."""
        card = self.card
        if isinstance(device, (int, np.integer)):
            if not 0 <= device < self.nodes * card.node_processors:
                return None
            node, gpu = divmod(int(device), card.node_processors)
            return ("gpu", node, gpu) if card.gpus else ("host", node, None)
        if device == "storage":
            return ("storage", 0, None) if card.storage and card.storage.shared else None
        if not (isinstance(device, tuple) and len(device) == 2 and isinstance(device[1], (int, np.integer))):
            return None
        kind, index = device
        known = {
            "host": self.nodes,
            "disk": self.nodes if card.storage and card.storage.local else 0,
            "display": card.display.nodes if card.display else 0,
        }
        return (kind, 0 if kind == "display" else int(index), None) if 0 <= index < known.get(kind, 0) else None

    def _from_file(self, kind: str, target_kind: str, node: int) -> tuple[str, ...] | None:
        if target_kind != "host":
            return None
        if kind == "disk":
            return (f"node{node}.disk",)
        return ("storage", f"node{node}.client", *((f"node{node}.nic.in",) if self.has_network else ()))

    def _between(self, node: int, other: int) -> tuple[str, ...]:
        """Return the links between the adapters of two nodes."""
        leaf = self.card.network.leaf
        if leaf is None or node // leaf.nodes == other // leaf.nodes:
            return ()
        return f"leaf{node // leaf.nodes}.up", f"leaf{other // leaf.nodes}.down"

    def _to_nic(self, node: int, gpu: int | None) -> tuple[str, ...]:
        """Return the links from a GPU, or the memory of the host, out of its node."""
        p, nic = self.prefix(node), f"{self.prefix(node)}nic.out"
        if gpu is None:
            return (nic,)
        across = self._across(node, self._socket(gpu), self.card.network.socket)
        if not self.card.network.gpu_direct:
            return (*self._copy(node, gpu, out=True), *across, *self._staging(p), nic)
        return (*(self._up(node, gpu) or self._copy(node, gpu, out=True)), *across, nic)

    def _from_nic(self, node: int, gpu: int | None) -> tuple[str, ...]:
        p, nic = self.prefix(node), f"{self.prefix(node)}nic.in"
        if gpu is None:
            return (nic,)
        across = self._across(node, self.card.network.socket, self._socket(gpu))
        if not self.card.network.gpu_direct:
            return (nic, *self._staging(p), *across, *self._copy(node, gpu, out=False))
        return (nic, *across, *(self._down(node, gpu) or self._copy(node, gpu, out=False)))

    def _staging(self, p: str) -> tuple[str, ...]:
        return (f"{p}staging",) if f"{p}staging" in self.links else ()

    def _inside(self, node: int, gpu: int | None, other: int | None) -> tuple[str, ...] | None:
        """Return the links between two GPUs of a node, or between one and the memory of the host."""
        card, p = self.card, self.prefix(node)
        if other is None:
            return () if gpu is None else (*self._copy(node, gpu, out=True), *self._memory(p))
        if gpu is None:
            return (*self._memory(p), *self._copy(node, other, out=False))
        nvlink, pcie = card.nvlink, card.pcie
        one, two = f"{p}gpu{gpu}", f"{p}gpu{other}"
        if nvlink and nvlink.pairs is None:
            return f"{one}.out", f"{one}.port", f"{two}.port", f"{two}.in"
        if nvlink and (pair := _group_of(nvlink.pairs, gpu)) is not None and pair == _group_of(nvlink.pairs, other):
            a, b = nvlink.pairs[pair]
            return f"{p}gpu{gpu}-gpu{other}", f"{p}gpu{a}+gpu{b}"
        if pcie is None:
            return None
        if _group_of(pcie.switches, gpu) == _group_of(pcie.switches, other) is not None:
            between: tuple[str, ...] = (f"{one}.slot.up", f"{two}.slot.down")
        else:
            across = self._across(node, self._socket(gpu), self._socket(other))
            between = (*self._up(node, gpu), *across, *self._down(node, other))
        return f"{one}.out", f"{one}.port", *between, f"{two}.port", f"{two}.in"

    def _memory(self, p: str) -> tuple[str, ...]:
        return (f"{p}memory",) if f"{p}memory" in self.links else ()

    def _copy(self, node: int, gpu: int, *, out: bool) -> tuple[str, ...]:
        """Return the links of a copy between a GPU and its host, as far as the host's memory."""
        own = f"{self.prefix(node)}gpu{gpu}.{'d2h' if out else 'h2d'}"
        known = (own,) if own in self.links else ()
        return (*self._up(node, gpu), *known) if out else (*known, *self._down(node, gpu))

    def _up(self, node: int, gpu: int) -> tuple[str, ...]:
        """Return the links from a GPU to the root complex of its socket."""
        pcie, p = self.card.pcie, self.prefix(node)
        if pcie is None:
            return ()
        switch = _group_of(pcie.switches, gpu)
        return f"{p}gpu{gpu}.slot.up", *(() if switch is None else (f"{p}switch{switch}.up",))

    def _down(self, node: int, gpu: int) -> tuple[str, ...]:
        pcie, p = self.card.pcie, self.prefix(node)
        if pcie is None:
            return ()
        switch = _group_of(pcie.switches, gpu)
        return *(() if switch is None else (f"{p}switch{switch}.down",)), f"{p}gpu{gpu}.slot.down"

    def _across(self, node: int, socket: int | None, other: int | None) -> tuple[str, ...]:
        if socket is None or other is None or socket == other:
            return ()
        return (f"{self.prefix(node)}socket{socket}-socket{other}",)

    def _socket(self, gpu: int) -> int | None:
        return _group_of(self.card.pcie.sockets, gpu) if self.card.pcie else None
