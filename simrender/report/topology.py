"""What connects a machine's devices: as a graph, and as a picture with one node in detail.

All nodes are equal, so the others are one box for each leaf switch. The picture is laid out in rows, from the GPUs at
the bottom up to the core switches, in inches; nothing in it is left to chance.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import networkx as nx
import numpy as np

from simrender.hardware.machine import MachineCard
from simrender.hardware.topology import Topology

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS: Final = {
    "gpu": "#8fd3c1",
    "cpu": "#8fd3c1",
    "nvswitch": "#a9d3ee",
    "switch": "#d5e9f6",
    "socket": "#a9d3ee",
    "host": "#f6ec9b",
    "adapter": "#f3cd85",
    "disk": "#e6c3d8",
    "storage": "#e6c3d8",
    "nodes": "#e4e4e4",
    "leaf": "#7fb5d9",
    "core": "#7fb5d9",
    "display": "#efb48c",
}
"""From the palette of Okabe and Ito, which colour-blind people can tell apart, but lighter; boxes have labels too."""

Graph = nx.DiGraph


_LEAVES: Final = 6
"""Leaf switches that are shown; where there are more, the last one stands for the others."""


def topology_graph(card: MachineCard) -> Graph[str]:
    """Return what connects the devices of a machine: node 0 in detail, the others by leaf switch, and the rest.

    Parameters
    ----------
    card : MachineCard

    Returns
    -------
    networkx.DiGraph
        Nodes have a ``kind`` (a key of `COLORS`) and a ``label``. Edges have a ``bandwidth`` in B/s and the ``link`` of
        the machine that it belongs to, both None where nothing limits what passes, and a ``count``: how many such links
        there are. Of several, the edge names the first.

    """
    graph: Graph[str] = nx.DiGraph()
    topology = Topology(card, card.nodes)
    _add_processors(graph, topology)
    _node(graph, "host", "host", f"host memory\n{card.cpu.memory.text}" if card.cpu else "host memory")
    _add_ways_to_host(graph, topology)
    if card.storage and card.storage.local:
        _node(graph, "disk", "disk", f"disk\n{card.storage.local.capacity.text}")
        _edge(graph, topology, "disk", "host", "node0.disk")
    if topology.has_network:
        _add_network(graph, topology)
    if card.storage and card.storage.shared:
        top = next((name for name in ("core", "leaf0") if name in graph), "host")
        limit = f"{card.storage.shared.client_bandwidth / 1e9:.3g} GB/s to a node"
        _node(graph, "storage", "storage", f"parallel file system\n{limit}")
        _edge(graph, topology, "storage", top, "storage")
    return graph


def _node(graph: Graph[str], name: str, kind: str, label: str) -> None:
    graph.add_node(name, kind=kind, label=label)


def _edge(graph: Graph[str], topology: Topology, u: str, v: str, link: str | None, count: int = 1) -> None:
    bandwidth = None if link is None else float(topology.links[link].bandwidth)
    graph.add_edge(u, v, link=link, bandwidth=bandwidth, count=count)


def _both(graph: Graph[str], topology: Topology, u: str, v: str, out: str | None, back: str | None, n: int = 1) -> None:
    _edge(graph, topology, u, v, out, n)
    _edge(graph, topology, v, u, back, n)


def _member(groups: Sequence[Sequence[int]] | None, gpu: int) -> int | None:
    return next((g for g, group in enumerate(groups or ()) if gpu in group), None)


def _add_processors(graph: Graph[str], topology: Topology) -> None:
    """Add the GPUs of node 0 and what connects them, or its processors."""
    card, p = topology.card, topology.prefix(0)
    if not card.gpus:
        _node(graph, "cpu", "cpu", f"{card.cpu.model}\n{card.cpu.cores} cores")
        return
    for gpu in range(card.gpus):
        _node(graph, f"gpu{gpu}", "gpu", f"GPU {gpu}")
    nvlink, pcie = card.nvlink, card.pcie
    if nvlink and nvlink.pairs is None:
        _node(graph, "nvswitch", "nvswitch", "NVSwitch" if card.gpus > 2 else "NVLink")
        for gpu in range(card.gpus):
            _both(graph, topology, f"gpu{gpu}", "nvswitch", f"{p}gpu{gpu}.out", f"{p}gpu{gpu}.in")
    for a, b in (nvlink.pairs or ()) if nvlink else ():
        _both(graph, topology, f"gpu{a}", f"gpu{b}", f"{p}gpu{a}-gpu{b}", f"{p}gpu{b}-gpu{a}")
    if pcie is None:
        return
    sockets = [f"socket{s}" for s in range(len(pcie.sockets or ()))]
    for s, name in enumerate(sockets or ["socket"]):
        _node(graph, name, "socket", f"socket {s}\nroot complex" if sockets else "root complex")
    for i, a in enumerate(sockets):
        for b in sockets[i + 1 :]:
            _both(graph, topology, a, b, f"{p}{a}-{b}", f"{p}{b}-{a}")
    for gpu in range(card.gpus):
        switch, socket = _member(pcie.switches, gpu), _member(pcie.sockets, gpu)
        above = "socket" if socket is None else f"socket{socket}"
        if switch is not None:
            name = f"switch{switch}"
            if name not in graph:
                _node(graph, name, "switch", f"PCIe switch {switch}")
                _both(graph, topology, name, above, f"{p}{name}.up", f"{p}{name}.down")
            above = name
        _both(graph, topology, f"gpu{gpu}", above, f"{p}gpu{gpu}.slot.up", f"{p}gpu{gpu}.slot.down")


def _add_ways_to_host(graph: Graph[str], topology: Topology) -> None:
    """Connect the memory of node 0 with its sockets, or with its GPUs where the card has no sockets."""
    card, p = topology.card, topology.prefix(0)
    if not card.gpus:
        bandwidth = float(card.cpu.memory_bandwidth)
        graph.add_edge("cpu", "host", link=None, bandwidth=bandwidth, count=1)
        graph.add_edge("host", "cpu", link=None, bandwidth=bandwidth, count=1)
        return
    groups: dict[str, list[int]] = {}
    for gpu in range(card.gpus):
        socket = _member(card.pcie.sockets, gpu) if card.pcie else None
        place = f"gpu{gpu}" if card.pcie is None else "socket" if socket is None else f"socket{socket}"
        groups.setdefault(place, []).append(gpu)
    for place, members in groups.items():
        ways = [f"{p}gpu{members[0]}.{way}" for way in ("d2h", "h2d")]
        out, back = (way if way in topology.links else None for way in ways)
        _both(graph, topology, place, "host", out, back, len(members))


def _add_network(graph: Graph[str], topology: Topology) -> None:
    """Add the adapter of node 0, the switches, the other nodes and the display."""
    card, network = topology.card, topology.card.network
    _node(graph, "adapter", "adapter", f"adapter\n{network.technology}")
    direct = network.gpu_direct and card.pcie is not None
    near = "host"
    if direct:
        near = f"socket{network.socket}" if card.pcie.sockets else "socket"
    _both(graph, topology, near, "adapter", None, None)
    size = network.leaf.nodes if network.leaf else card.nodes
    leaves = -(-card.nodes // size)
    if leaves > 1:
        _node(graph, "core", "core", "core switches")
    shown = leaves if leaves <= _LEAVES else _LEAVES - 1
    for leaf in range(min(leaves, _LEAVES)):
        many = leaf == shown  # this one stands for all the others
        n = leaves - leaf if many else 1
        label = f"leaf switches {leaf} to {leaves - 1}" if many else f"leaf switch {leaf}" if leaves > 1 else "switch"
        name, first, last = f"leaf{leaf}", max(1, leaf * size), min(card.nodes, (leaf + n) * size) - 1
        _node(graph, name, "leaf", label)
        if leaf == 0:
            _both(graph, topology, "adapter", name, "node0.nic.out", "node0.nic.in")
        if first <= last:
            others, same = f"nodes{leaf}", last - first + 1
            text = f"node {first}" if same == 1 else f"nodes {first} to {last}\n{same} like node 0"
            _node(graph, others, "nodes", text)
            _both(graph, topology, others, name, f"node{first}.nic.out", f"node{first}.nic.in", same)
        if leaves > 1:
            _both(graph, topology, name, "core", f"leaf{leaf}.up", f"leaf{leaf}.down", n)
    if card.display:
        _node(graph, "display", "display", "display" if card.display.nodes == 1 else f"{card.display.nodes} displays")
        graph.add_edge(
            "leaf0", "display", link=None, bandwidth=float(card.display.bandwidth), count=card.display.nodes
        )  # fmt: skip


# -- the picture ------------------------------------------------------------------------------------------------------

_STEP, _BOX, _GAP, _HIGH, _ROW = 1.0, 0.86, 0.6, 0.5, 1.15
"""Inches: between GPUs, a GPU's box, more between those of two sockets, the height of a box, between rows."""


@dataclass
class _Layout:
    """Where each box is, in inches: left, right and the middle of its height."""

    boxes: dict[str, tuple[float, float, float]] = field(default_factory=dict)

    def place(self, name: str, left: float, right: float, y: float) -> None:
        self.boxes[name] = left, right, y

    def centre(self, name: str) -> float:
        left, right, _ = self.boxes[name]
        return 0.5 * (left + right)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        left, right, y = np.array(list(self.boxes.values())).T
        return float(left.min()), float(right.max()), float(y.min()) - 0.5 * _HIGH, float(y.max()) + 0.5 * _HIGH


def _lay_out(graph: Graph[str]) -> tuple[_Layout, tuple[float, float, float, float]]:
    """Return where the boxes are, and the frame around node 0."""
    of_kind = {kind: [n for n in graph if graph.nodes[n]["kind"] == kind] for kind in COLORS}
    layout = _Layout()
    roots = of_kind["socket"]
    switches = sorted(of_kind["switch"], key=lambda s: [roots.index(n) for n in graph.successors(s) if n in roots])
    groups = [[n for n in graph.predecessors(s) if n.startswith("gpu")] for s in switches or roots] or [of_kind["gpu"]]
    gaps = _GAP * (len(groups) - 1)
    wide, y = max(2.4, len(of_kind["gpu"]) * _STEP + gaps), 0.0
    if of_kind["nvswitch"]:
        layout.place("nvswitch", 0.0, wide, y)
        y += _ROW
    x = 0.5 * (wide - len(of_kind["gpu"]) * _STEP - gaps)
    for group in groups:
        for gpu in group:
            layout.place(gpu, x + 0.5 * (_STEP - _BOX), x + 0.5 * (_STEP + _BOX), y)
            x += _STEP
        x += _GAP
    if of_kind["cpu"]:
        layout.place("cpu", 0.0, wide, y)
    for kind in ("switch", "socket"):
        if of_kind[kind]:
            y += _ROW
        for name in of_kind[kind]:  # over what is below it
            below = [layout.boxes[n] for n in graph.predecessors(name) if n in layout.boxes and layout.boxes[n][2] < y]
            left, right = min(box[0] for box in below), max(box[1] for box in below)
            middle, half = 0.5 * (left + right), max(0.5 * (right - left), 0.5)
            layout.place(name, middle - half, middle + half, y)
    y += _ROW
    layout.place("host", 0.0, wide, y)
    on_right = _on_right(graph, layout)
    left, right = 0.0, wide
    for name in ("adapter", "disk"):
        if name in graph:
            if (name == "adapter") == on_right:
                layout.place(name, right + 0.8, right + 2.6, y)
                right += 2.6
            else:
                layout.place(name, left - 2.6, left - 0.8, y)
                left -= 2.6
    lowest = max(_depths(graph).values(), default=0.0)
    frame = left - 0.25, right + 0.25, -0.5 * _HIGH - lowest - 0.45, y + 0.5 * _HIGH + 0.25
    _lay_out_network(graph, of_kind, layout, frame, y)
    return layout, frame


def _on_right(graph: Graph[str], layout: _Layout) -> bool:
    """Tell whether the adapter belongs to a socket in the right half."""
    near = [n for n in graph.predecessors("adapter") if n in layout.boxes] if "adapter" in graph else []
    left, right, _ = layout.boxes["host"]
    return any(layout.centre(n) > 0.5 * (left + right) for n in near)


def _lay_out_network(
    graph: Graph[str],
    of_kind: dict[str, list[str]],
    layout: _Layout,
    frame: tuple[float, float, float, float],
    y: float,
) -> None:
    """Place the other nodes and the display to the right of node 0, and the switches above."""
    x, leaf_y = frame[1] + 0.5, y + 1.3 * _ROW
    for leaf in of_kind["leaf"]:
        left = layout.boxes["adapter"][0] if leaf == "leaf0" else x
        for name in [n for n in (leaf.replace("leaf", "nodes"), "display" if leaf == "leaf0" else "") if n in graph]:
            layout.place(name, x, x + 1.7, y)
            x += 2.2
        layout.place(leaf, left, max(x - 0.5, left + 1.7), leaf_y)
        x = max(x, left + 2.2)
    top = leaf_y if of_kind["leaf"] else y
    if "core" in graph:
        top = leaf_y + _ROW
        layout.place("core", layout.boxes["leaf0"][0], x - 0.5, top)
    if "storage" in graph:
        layout.place("storage", x + 0.6, x + 2.5, top)


def _depths(graph: Graph[str]) -> dict[tuple[str, str], float]:
    """Return how far below the GPUs each of their bridges runs: those of neighbours on top, no two others together."""
    gpus = [name for name in graph if graph.nodes[name]["kind"] == "gpu"]
    bridges = [(u, v) for u, v in graph.edges if u in gpus and v in gpus and gpus.index(u) < gpus.index(v)]
    far = [(u, v) for u, v in bridges if gpus.index(v) > gpus.index(u) + 1]
    return {pair: 0.3 * (2 + far.index(pair) if pair in far else 1) for pair in bridges}


def plot_topology(card: MachineCard, figure: Figure | None = None) -> Figure:
    """Draw what connects the devices of a machine: boxes in rows, lines as thick as their bandwidth.

    Parameters
    ----------
    card : MachineCard
    figure : matplotlib Figure, optional
        To draw into; a new one, as large as the machine needs, by default.

    """
    from matplotlib.figure import Figure as NewFigure
    from matplotlib.patches import FancyBboxPatch, Rectangle

    graph = topology_graph(card)
    layout, frame = _lay_out(graph)
    left, right, bottom, top = layout.extent
    left, right, bottom, top = min(left, frame[0]), max(right, frame[1]), min(bottom, frame[2]), max(top, frame[3])
    sides = 0.15, 0.6  # inches of margin, and of title
    width, height = max(right - left, 6.5) + 2 * sides[0], top - bottom + sides[0] + sides[1]
    figure = figure or NewFigure(figsize=(width, height))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    middle = 0.5 * (left + right)
    axes.set_xlim(middle - 0.5 * width, middle + 0.5 * width)
    axes.set_ylim(bottom - sides[0], top + sides[1])
    axes.axis("off")
    axes.text(middle, top + 0.38, card.title, ha="center", va="center", fontsize=11, weight="bold")
    note = "bandwidths each way; dotted lines set no limit of their own"
    axes.text(middle, top + 0.16, note, ha="center", va="center", fontsize=8, color="#555555")
    corner, size = (frame[0], frame[2]), (frame[1] - frame[0], frame[3] - frame[2])
    axes.add_patch(Rectangle(corner, *size, facecolor="#fafafa", edgecolor="#999999", linestyle="--", zorder=0))
    label = _inside(card)
    axes.text(frame[0] + 0.1, frame[2] + 0.1, label, ha="left", va="bottom", fontsize=8, color="#555555")
    depths = _depths(graph)
    for u, v, label in _lines(graph):
        _draw_line(axes, layout, (u, v), label, graph.edges[u, v]["bandwidth"], depths.get((u, v)))
    for name, (low, high, y) in layout.boxes.items():
        kind = graph.nodes[name]["kind"]
        style = "round,pad=0,rounding_size=0.06"
        box = FancyBboxPatch((low, y - 0.5 * _HIGH), high - low, _HIGH, boxstyle=style, facecolor=COLORS[kind],
                             edgecolor="#333333", linewidth=0.8, zorder=3)  # fmt: skip
        axes.add_patch(box)
        axes.text(0.5 * (low + high), y, graph.nodes[name]["label"], ha="center", va="center", fontsize=8, zorder=4)
    return figure


def _inside(card: MachineCard) -> str:
    what = f"node 0 of {card.nodes}" if card.nodes > 1 else "the node"
    return f"{what}: {card.gpus} x {card.gpu.model}" if card.gpus and card.gpu else what


def _lines(graph: Graph[str]) -> Iterator[tuple[str, str, str]]:
    """Yield each pair of boxes that is connected once, with what to write at the line.

    Sockets all have the same link to each other, which is drawn between neighbours.
    """
    sockets = [name for name in graph if graph.nodes[name]["kind"] == "socket"]
    drawn: set[tuple[str, str]] = set()
    for u, v, edge in graph.edges(data=True):
        if (v, u) in drawn:
            continue
        drawn.add((u, v))
        back = graph.edges[v, u] if graph.has_edge(v, u) else edge
        label = _label(edge, back, per_gpu=v == "host" and edge["count"] > 1)
        if u in sockets and v in sockets:
            if sockets.index(v) > sockets.index(u) + 1:
                continue
            label += "\neach pair" if len(sockets) > 2 else ""
        yield u, v, label


def _label(edge: dict[str, Any], back: dict[str, Any], *, per_gpu: bool) -> str:
    if edge["bandwidth"] is None:
        return ""
    rates = [f"{e['bandwidth'] / 1e9:.4g}" for e in (edge, back) if e["bandwidth"] is not None]
    text = f"{rates[0]} GB/s" if len(set(rates)) == 1 else f"{rates[0]} up,\n{rates[1]} down\nGB/s"
    if per_gpu:
        return f"{text}\neach GPU"
    return f"{edge['count']} x {text}" if edge["count"] > 1 else text


def _draw_line(
    axes: Axes, layout: _Layout, ends: tuple[str, str], label: str, bandwidth: float | None, depth: float | None
) -> None:
    """Draw a line: straight up between rows where that is possible, in a row from side to side, a bridge below."""
    look: dict[str, Any] = {"color": "#444444", "linewidth": _thickness(bandwidth), "zorder": 1}
    look |= {"linestyle": ":"} if bandwidth is None else {"solid_capstyle": "butt", "solid_joinstyle": "miter"}
    text: dict[str, Any] = {"fontsize": 7, "zorder": 5, "linespacing": 1.05}
    short = label.replace(" GB/s", "\nGB/s")
    low, high = sorted((layout.boxes[end] for end in ends), key=lambda box: (box[2], box[0]))
    y, other_y = low[2], high[2]
    if depth is not None:
        a, b = sorted(layout.centre(end) for end in ends)
        top, bottom = y - 0.5 * _HIGH, y - 0.5 * _HIGH - depth + 0.12
        axes.plot([a, a, b, b], [top, bottom, bottom, top], **look)
        axes.text(a + 0.5 * min(_STEP, b - a), bottom + 0.05, label, ha="center", va="bottom", **text)
    elif y == other_y:
        a, b = low[1], high[0]
        axes.plot([a, b], [y, y], **look)
        axes.text(0.5 * (a + b), y + 0.07, short, ha="center", va="bottom", **text)
    else:
        narrow, wide = sorted((low, high), key=lambda box: box[1] - box[0])
        a = b = min(max(0.5 * (narrow[0] + narrow[1]), wide[0]), wide[1])
        if not narrow[0] <= a <= narrow[1]:
            a, b = 0.5 * (low[0] + low[1]), 0.5 * (high[0] + high[1])
        axes.plot([a, b], [y + 0.5 * _HIGH, other_y - 0.5 * _HIGH], **look)
        axes.text(0.5 * (a + b) + 0.07, 0.5 * (y + other_y), short, ha="left", va="center", **text)


def _thickness(bandwidth: float | None) -> float:
    """Return the width of a line in points: one more for each doubling from 2 GB/s on."""
    return 1.0 if bandwidth is None else float(np.clip(np.log2(bandwidth / 1e9), 0.8, 8.0))
