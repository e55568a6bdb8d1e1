"""Machines: a card becomes devices and links, each created when it is first used."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from functools import cached_property

import simpy
from pydantic import Field, model_validator

from simrender.cards import Bandwidth, Card, Duration, Quantity, Share
from simrender.catalog import find_card
from simrender.errors import UsageError
from simrender.hardware.network import Link, Network
from simrender.hardware.processor import Host, HostCard, Processor, ProcessorCard


class DistantCard(Card):
    """Pairs of GPUs that reach only a part of the bandwidth: those in different groups."""

    groups: list[list[int]]
    share: Share


class FabricCard(Card):
    """What connects the GPUs of one node: NVLink with NVSwitch, or switched PCIe.

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
    distant : section, optional

    """

    bandwidth: Bandwidth
    duplex: Share
    latency: Duration
    kernel_share: Share
    distant: DistantCard | None = None


class MachineCard(Card):
    """A node with several GPUs.

    Exactly one of ``nvlink`` and ``pcie`` says how the GPUs reach each other.
    """

    title: str
    gpus: int = Field(ge=1, strict=True)
    gpu: ProcessorCard
    nvlink: FabricCard | None = None
    pcie: FabricCard | None = None
    host: HostCard

    @model_validator(mode="after")
    def _one_fabric(self) -> MachineCard:
        if (self.nvlink is None) == (self.pcie is None):
            raise ValueError("a machine has exactly one of the sections nvlink and pcie")
        if distant := self.fabric.distant:
            grouped = sorted(gpu for group in distant.groups for gpu in group)
            if grouped != list(range(self.gpus)):
                raise ValueError(
                    f"distant.groups must name each GPU from 0 to {self.gpus - 1} once, got {distant.groups}"
                )
        return self

    @property
    def fabric(self) -> FabricCard:
        """The section that connects the GPUs."""
        fabric = self.nvlink or self.pcie
        assert fabric is not None  # noqa: S101 - the validator saw to it
        return fabric

    @property
    def fabric_name(self) -> str:
        """``nvlink`` or ``pcie``."""
        return "nvlink" if self.nvlink else "pcie"


def load_machine(name: str, overrides: Sequence[str] = ()) -> MachineCard:
    """Return a machine's card by name or path.

    Parameters
    ----------
    name : str
        ``dgx2``, or the path of a YAML file.
    overrides : sequence of str
        ``PATH=VALUE`` without the leading ``machine.``.

    Raises
    ------
    UnknownNameError, CardError

    """
    document = find_card("machine", name).document()
    for override in overrides:
        document.override(MachineCard, override, "machine")
    return document.validate(MachineCard)


class Machine:
    """The devices of a machine inside one simulation.

    Parameters
    ----------
    env : simpy.Environment
    card : MachineCard
    gpus : int
        How many of its GPUs the simulation may use, from 0 on.
    kernels_read : bool
        Whether kernels will read their neighbours' memory.

    """

    def __init__(self, env: simpy.Environment, card: MachineCard, gpus: int, *, kernels_read: bool = False) -> None:
        self.env, self.card, self.gpus, self.kernels_read = env, card, gpus, kernels_read
        self.host = Host(env, card.host)
        self._processors: dict[int, Processor] = {}

    def processor(self, index: int) -> Processor:
        """Return a GPU, created when first asked for."""
        if index not in self._processors:
            self._processors[index] = Processor(f"gpu{index}", self.card.gpu)
        return self._processors[index]

    @property
    def processors(self) -> list[Processor]:
        """The GPUs that came into being, in order."""
        return [self._processors[i] for i in sorted(self._processors)]

    @property
    def has_network(self) -> bool:
        """Whether anything was ever sent."""
        return "network" in self.__dict__

    @cached_property
    def network(self) -> Network:
        """The links between the GPUs, created when something is first sent.

        A copy takes the sender's outgoing lane, the receiver's incoming lane, and a share of each of the two GPUs'
        ports, which cannot run both lanes at full speed at once. Where kernels read their neighbours' memory, the
        routes ``i -> (j, "kernel")`` are those of the reads of GPU j.
        """
        fabric = self.card.fabric
        lane = float(fabric.bandwidth)
        links: dict[Hashable, Link] = {}
        routes: dict[tuple[Hashable, Hashable], Sequence[Hashable]] = {}
        for i in range(self.gpus):
            links[f"gpu{i}.out"] = Link(lane, 0.0)
            links[f"gpu{i}.in"] = Link(lane, 0.0)
            links[f"gpu{i}.port"] = Link(2.0 * lane * fabric.duplex, 0.5 * fabric.latency)
        group_of = {gpu: g for g, group in enumerate(fabric.distant.groups) for gpu in group} if fabric.distant else {}
        for i in range(self.gpus):
            for j in range(self.gpus):
                if i == j:
                    continue
                route = [f"gpu{i}.out", f"gpu{i}.port", f"gpu{j}.port", f"gpu{j}.in"]
                reach = lane
                if fabric.distant and group_of[i] != group_of[j]:
                    reach = lane * fabric.distant.share
                    links[f"gpu{i}-gpu{j}"] = Link(reach, 0.0)
                    route.insert(2, f"gpu{i}-gpu{j}")
                routes[i, j] = tuple(route)
                if self.kernels_read:
                    links[f"gpu{j}.reads.gpu{i}"] = Link(reach * fabric.kernel_share, 0.0)
                    routes[i, (j, "kernel")] = (*route, f"gpu{j}.reads.gpu{i}")
        return Network(self.env, links, routes)

    def quantities(self) -> Iterator[tuple[str, Quantity]]:
        """Yield the card's quantities that the simulation really used, with their paths."""
        card = self.card
        for name, quantity in card.gpu.quantities("machine.gpu."):
            yield name, quantity
        for name, quantity in card.host.quantities("machine.host."):
            yield name, quantity
        if self.has_network:
            for name, quantity in card.fabric.quantities(f"machine.{card.fabric_name}."):
                if self.kernels_read or not name.endswith(".kernel_share"):
                    yield name, quantity


def check_gpus(card: MachineCard, gpus: int | None) -> int:
    """Return how many GPUs to use, all by default.

    Raises
    ------
    UsageError
        If the machine does not have that many, or none are asked for.

    """
    if gpus is None:
        return card.gpus
    if not 1 <= gpus <= card.gpus:
        raise UsageError(f"--gpus {gpus}: {card.title} has 1 to {card.gpus} GPUs to use")
    return gpus
