"""What connects a machine's devices, as a graph and as a picture."""

import itertools

import networkx as nx
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from simrender import catalog
from simrender.hardware.machine import load_machine
from simrender.hardware.topology import Topology
from simrender.report.topology import COLORS, plot_topology, topology_graph

NAMES = (*sorted(catalog.cards("machine")), "frontera-rtx:staged", "laptop:rtx")
LEAVES = "network.leaf={nodes: 2, oversubscription: 2, latency: 1 us}"
SWITCHES = (
    "pcie.switches=[[0, 1, 2, 3], [4, 5, 6, 7]]",
    "pcie.uplink=18 GB/s",
    "pcie.sockets=null",
    "pcie.socket_link=null",
)
WIDE = (
    "pcie.sockets=[[0], [1], [2], [3]]",
    "nvlink.pairs=[[0, 2], [1, 3]]",
    "nodes=500",
    "network.leaf.nodes=22",
    "network.socket=3",
)


# The graph


@pytest.mark.parametrize("name", NAMES)
def test_edges_have_the_bandwidth_of_the_links_that_they_name(name):
    card = load_machine(name)
    links = Topology(card, card.nodes).links
    graph = topology_graph(card)
    assert nx.is_weakly_connected(graph)
    for _, _, edge in graph.edges(data=True):
        if edge["link"] is not None:
            assert edge["bandwidth"] == links[edge["link"]].bandwidth
    assert {kind for _, kind in graph.nodes(data="kind")} <= set(COLORS)


def test_gpus_around_a_switch():
    graph = topology_graph(load_machine("dgx2"))
    assert graph.edges["gpu3", "nvswitch"]["link"] == "gpu3.out"
    assert graph.edges["nvswitch", "gpu3"]["link"] == "gpu3.in"
    assert graph.in_degree("nvswitch") == graph.out_degree("nvswitch") == 16


def test_two_gpus_need_no_switch_of_that_name():
    assert topology_graph(load_machine("desktop-rtx8000")).nodes["nvswitch"]["label"] == "NVLink"


def test_a_tree_of_switches():
    graph = topology_graph(load_machine("rtx-server-a40", SWITCHES))
    assert list(graph.successors("gpu5")) == ["switch1"]
    assert graph.edges["switch1", "socket"]["link"] == "switch1.up"
    assert graph.edges["socket", "switch1"]["link"] == "switch1.down"


def test_a_node_in_detail_and_the_others_by_leaf_switch():
    graph = topology_graph(load_machine("frontera-rtx", [LEAVES, "nodes=6"]))
    assert graph.edges["gpu0", "gpu1"]["link"] == "node0.gpu0-gpu1"
    assert graph.edges["socket1", "socket0"]["link"] == "node0.socket1-socket0"
    assert graph.edges["adapter", "leaf0"]["link"] == "node0.nic.out"
    assert graph.edges["leaf2", "core"]["link"] == "leaf2.up"
    assert graph.edges["storage", "core"]["link"] == "storage"
    boxes = {name: label for name, label in graph.nodes(data="label") if name.startswith("nodes")}
    assert boxes == {
        "nodes0": "node 1",
        "nodes1": "nodes 2 to 3\n2 like node 0",
        "nodes2": "nodes 4 to 5\n2 like node 0",
    }


def test_no_core_above_a_single_switch():
    graph = topology_graph(load_machine("manta-cluster"))
    assert "core" not in graph
    assert graph.edges["nodes0", "leaf0"]["count"] == 63
    assert list(graph.predecessors("display")) == ["leaf0"]


def test_many_leaf_switches_become_one():
    graph = topology_graph(load_machine("frontera-rtx", [LEAVES, "nodes=40"]))
    leaves = {name: label for name, label in graph.nodes(data="label") if name.startswith("leaf")}
    assert leaves["leaf5"] == "leaf switches 5 to 19"
    assert len(leaves) == 6
    assert graph.nodes["nodes5"]["label"] == "nodes 10 to 39\n30 like node 0"
    assert graph.edges["leaf5", "core"]["count"] == 15


@pytest.mark.parametrize(("direct", "near"), [("true", "socket0"), ("false", "host")])
def test_the_adapter_is_where_messages_of_gpus_leave(direct, near):
    graph = topology_graph(load_machine("frontera-rtx", [f"network.gpu_direct={direct}"]))
    assert list(graph.predecessors("adapter")) == [near, "leaf0"]


# The picture


@pytest.mark.parametrize(
    ("name", "overrides"), [*((name, ()) for name in NAMES), ("frontera-rtx", (LEAVES,)), ("frontera-rtx", WIDE)]
)
def test_nothing_covers_a_label(name, overrides):
    figure = plot_topology(load_machine(name, overrides))
    figure.set_dpi(150)
    renderer = FigureCanvasAgg(figure).get_renderer()
    (axes,) = figure.axes
    labels = [(text.get_text(), text.get_window_extent(renderer)) for text in axes.texts if text.get_text()]
    for (one, box), (other, other_box) in itertools.combinations(labels, 2):
        assert not box.overlaps(other_box), (one, other)
    boxes = [patch.get_window_extent(renderer) for patch in axes.patches[1:]]
    for box, other in itertools.combinations(boxes, 2):
        assert not box.overlaps(other)
    for text, box in labels:
        crossed = [patch for patch in boxes if patch.overlaps(box)]
        assert all(p.x0 <= box.x0 and box.x1 <= p.x1 and p.y0 <= box.y0 and box.y1 <= p.y1 for p in crossed), text
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1


def test_what_is_drawn_says_bandwidths_with_their_unit():
    texts = [text.get_text() for text in plot_topology(load_machine("frontera-rtx")).axes[0].texts]
    assert texts[0] == "Frontera RTX (22 nodes of 4 Quadro RTX 5000 16 GB, HDR100)"
    for label in ("21 x 11\nGB/s", "13.2 up,\n11.7 down\nGB/s\neach GPU", "10 GB/s", "6\nGB/s", "60\nGB/s"):
        assert label in texts


def test_thicker_lines_carry_more():
    lines = plot_topology(load_machine("dgx2")).axes[0].lines
    assert len({line.get_linewidth() for line in lines}) == 3  # NVLink, the way to the host, the disk


@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_machine_gives_the_same_file(run_cli, tmp_path, ending):
    first, second = tmp_path / f"a.{ending}", tmp_path / f"b.{ending}"
    for target in (first, second):
        ran = run_cli("show", "rtx-server-a40", "--plot", target)
        assert (ran.code, ran.out, ran.err) == (0, "", f"wrote {target}\n")
    assert first.read_bytes() == second.read_bytes()
    assert first.read_bytes()[:4] in {b"\x89PNG", b"<?xm", b"%PDF"}


def test_the_picture_is_large_enough_to_read(run_cli, tmp_path):
    run_cli("show", "manta-cluster", "--plot", tmp_path / "x.png")
    with Image.open(tmp_path / "x.png") as picture:
        assert 900 <= picture.width <= 5000
        assert picture.height >= 400


@pytest.mark.parametrize(
    ("name", "target", "message"),
    [
        ("dgx2", "x.jpg", "--plot x.jpg: expected a file that ends in .png or .svg or .pdf"),
        ("dgx2", "nowhere/x.png", "--plot nowhere/x.png: there is no folder nowhere"),
        ("island", "x.png", "--plot x.png: island is a workload; only machines are drawn"),
        ("ray_queue_cycling", "x.png", "--plot x.png: ray_queue_cycling is a policy; only machines are drawn"),
        ("dgx3", "x.png", "unknown machine 'dgx3'; did you mean 'dgx2'? (known: "),
    ],
)
def test_mistakes(run_cli, monkeypatch, tmp_path, name, target, message):
    monkeypatch.chdir(tmp_path)
    ran = run_cli("show", name, "--plot", target)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.startswith(f"simrender: {message}")
    assert not list(tmp_path.iterdir())
