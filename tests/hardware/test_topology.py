"""What connects the devices of the machines of the house: links, routes, and what they carry at once."""

import functools
import itertools

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import catalog
from simrender.clock import to_seconds, to_ticks
from simrender.errors import UnreachableError
from simrender.hardware.machine import Machine, load_machine
from simrender.hardware.topology import Topology

NBYTES = 1e12  # so much that latency does not show
MOST_NODES = 3

check = settings(deadline=None, derandomize=True, max_examples=50)

NAMES = sorted(
    name
    for card in catalog.cards("machine").values()
    for name in (card.name, *(f"{card.name}:{variant}" for variant in card.document().variants))
)


@functools.cache
def load(name, *overrides):
    return load_machine(name, overrides)


def seconds(card, *transfers, nodes=MOST_NODES, nbytes=NBYTES):
    """How long some transfers take that start together."""
    env = simpy.Environment()
    network = Machine(env, card, nodes * card.node_processors).network
    env.run(env.all_of([network.transfer(source, target, nbytes) for source, target in transfers]))
    return to_seconds(env.now)


def bandwidth(card, *transfers, nodes=MOST_NODES):
    """What each of some transfers gets that start and end together."""
    return NBYTES / seconds(card, *transfers, nodes=nodes)


def latency_us(card, source, target, nodes=MOST_NODES):
    return 1e6 * seconds(card, (source, target), nodes=nodes, nbytes=0.0)


def close(value):
    return pytest.approx(value, rel=1e-5)


# Every machine


@pytest.mark.parametrize("name", NAMES)
def test_every_route_is_made_of_links_and_takes_none_twice(name):
    card = load(name)
    topology = Topology(card, min(card.nodes, MOST_NODES))
    assert list(topology.devices)
    assert len(set(topology.devices)) == len(list(topology.devices))
    for source, target in itertools.product(topology.devices, repeat=2):
        route = topology.route(source, target)
        if route is not None:
            assert len(set(route)) == len(route), (source, target)
            assert set(route) <= set(topology.links), (source, target)


def place(card, device):
    """What a device is, and on which node; cores that render are the host."""
    if isinstance(device, int):
        return "gpu" if card.gpus else "host", device // card.node_processors
    return (device, None) if isinstance(device, str) else device


@pytest.mark.parametrize("name", NAMES)
def test_everything_that_has_to_reach_another_does(name):
    """Files are only read, into the memory of a host, and displays only take in."""
    card = load(name)
    topology = Topology(card, min(card.nodes, MOST_NODES))
    for source, target in itertools.permutations(topology.devices, 2):
        (kind, node), (other_kind, other_node) = place(card, source), place(card, target)
        if kind == "disk":
            expected = other_kind == "host" and node == other_node
        elif kind == "storage":
            expected = other_kind == "host"
        else:
            expected = kind != "display" and other_kind in {"gpu", "host", "display"}
        assert (topology.route(source, target) is not None) == expected, (source, target)


@pytest.mark.parametrize("name", NAMES)
def test_there_is_no_link_that_nothing_goes_over(name):
    card = load(name)
    nodes = min(card.nodes, 2)
    topology = Topology(card, nodes)
    routes = [topology.route(s, t) or () for s, t in itertools.permutations(topology.devices, 2)]
    leaves = {link for link in topology.links if str(link).startswith("leaf")}
    assert set(topology.links) - leaves == {link for route in routes for link in route} - leaves


@pytest.mark.parametrize("name", NAMES)
def test_every_link_hangs_on_values_of_the_card(name):
    card = load(name)
    paths = {path for path, _ in card.quantities()}
    topology = Topology(card, min(card.nodes, MOST_NODES))
    for link in topology.links:
        assert set(topology.sources(link)) <= paths, link


@pytest.mark.parametrize("name", NAMES)
def test_there_and_back_take_as_long(name):
    card = load(name)
    topology = Topology(card, min(card.nodes, MOST_NODES))
    for one, other in itertools.combinations(range(topology.nodes * card.node_processors), 2):
        there, back = (topology.route(*pair) for pair in ((one, other), (other, one)))
        of = topology.links
        assert sum(of[link].latency for link in there) == pytest.approx(sum(of[link].latency for link in back))
        assert min(of[link].bandwidth for link in there) == min(of[link].bandwidth for link in back)


@pytest.mark.parametrize("name", NAMES)
def test_there_is_no_such_device(name):
    card = load(name)
    topology = Topology(card, 1)
    for nothing in (
        card.node_processors,
        -1,
        ("host", 1),
        ("disk", 1),
        ("display", 1),
        "nowhere",
        ("gpu", 0),
        None,
        0.5,
    ):
        assert topology.route(0, nothing) is None
        assert topology.route(nothing, 0) is None


def test_a_part_of_the_nodes_has_the_same_links_by_the_same_names():
    card = load("stampede2-skx")
    few, many = Topology(card, 3), Topology(card, 100)
    assert few.links.items() <= many.links.items()
    assert few.route(0, 2) == many.route(0, 2)


SWITCHED = ("pcie.switches=[[0, 1, 2, 3], [4, 5, 6, 7]]", "pcie.uplink=18 GB/s")


def test_names_say_where_a_link_is():
    server = load("rtx-server-a40", *SWITCHED)
    assert {"gpu0.out", "gpu7.port", "switch1.up", "gpu0.h2d"} <= set(Topology(server, 1).links)
    links = Topology(load("frontera-rtx"), 2).links
    assert {"node0.gpu3.out", "node1.gpu0-gpu1", "node1.socket0-socket1", "node0.nic.in", "leaf0.up"} <= set(links)


# Frontera, from GPU to GPU


@pytest.mark.parametrize(
    ("name", "pair", "gb_s", "us"),
    [
        ("frontera-rtx", (0, 1), 10.0, 2.3),  # a bridge
        ("frontera-rtx", (0, 2), 6.0, 2.7),  # PCIe across the sockets
        ("frontera-rtx", (0, 4), 11.0, 2.7 + 1.5),  # PCIe at either end, and the network
        ("frontera-rtx", (4, 8), 11.0, 2.7 + 1.5),
        ("frontera-rtx", (3, 4), 6.0, 2.7 + 1.5),  # the adapter is at the other socket
        ("frontera-rtx:fdr", (0, 1), 10.0, 2.3),
        ("frontera-rtx:fdr", (0, 4), 6.38, 2.7 + 1.5),
        ("frontera-rtx:staged", (0, 1), 10.0, 2.3),
        ("frontera-rtx:staged", (0, 4), 11.0, 2 * 10.0 + 1.5),  # a copy to the host, the network, a copy to the GPU
        ("frontera-rtx:staged", (3, 4), 6.0, 2 * 10.0 + 1.5),
    ],
)
def test_one_copy_between_gpus(name, pair, gb_s, us):
    card = load(name)
    assert bandwidth(card, pair) == close(gb_s * 1e9)
    assert latency_us(card, *pair) == pytest.approx(us, abs=2e-6)


def test_gpus_of_one_socket_that_have_no_bridge_use_pcie():
    card = load("frontera-rtx", "nvlink.pairs=[[0, 2]]")
    assert bandwidth(card, (0, 1)) == close(9.6e9)
    assert latency_us(card, 0, 1) == pytest.approx(2.7, abs=2e-6)
    assert bandwidth(card, (0, 2)) == close(10e9)


def test_both_directions_of_a_bridge_and_of_pcie():
    half = load("frontera-rtx", "nvlink.duplex=0.8", "nvlink.pairs=[[0, 2]]")
    assert bandwidth(half, (0, 2), (2, 0)) == close(0.8 * 10e9)
    assert bandwidth(half, (0, 1), (1, 0)) == close(0.97 * 9.6e9)


def test_bridges_do_not_disturb_each_other_and_the_way_between_sockets_is_shared():
    card = load("frontera-rtx")
    assert bandwidth(card, (0, 1), (2, 3)) == close(10e9)
    assert bandwidth(card, (0, 2), (1, 3)) == close(3e9)
    assert bandwidth(card, (0, 2), (2, 0)) == close(6e9)


def test_gpus_of_a_node_share_its_adapter():
    card = load("frontera-rtx")
    assert bandwidth(card, (0, 4), (1, 5)) == close(5.5e9)
    assert bandwidth(card, (0, 4), (4, 0)) == close(11e9)


def test_staged_messages_are_slower_and_go_over_more_links():
    direct, staged = (Topology(load(name), 2) for name in ("frontera-rtx", "frontera-rtx:staged"))
    assert not direct.staged(0, 4)
    assert staged.staged(0, 4)
    assert not staged.staged(0, 1)
    assert not staged.staged(("host", 0), ("host", 1))
    more = [link for link in staged.route(0, 4) if link not in direct.route(0, 4)]
    assert more == ["node0.gpu0.d2h", "node0.staging", "node1.staging", "node1.gpu0.h2d"]
    memory = float(load("frontera-rtx").cpu.memory_bandwidth)
    assert staged.links["node0.staging"].bandwidth == memory / 2  # written, and read again


def copied_s(card, nbytes):
    env = simpy.Environment()
    env.run(Machine(env, card, 8).copy(0, 4, nbytes))
    return to_seconds(env.now)


@pytest.mark.parametrize("nbytes", [0.0, 1e3, 2.0**18, 1e6, 1e9])
def test_a_staged_copy_waits_for_its_first_and_last_piece(nbytes):
    """Closed form: the overhead, the piece at 13.2 and at 11.7 GB/s, two copies' latency, and all bytes at 11 GB/s.

    From 16 KiB on it is announced first, which takes two latencies of the network more.
    """
    piece = min(nbytes, 2.0**18)
    announced = 0.4e-6 + (3 if nbytes >= 2**14 else 1) * 1.5e-6
    expected = piece / 13.2e9 + piece / 11.7e9 + 20e-6 + announced + nbytes / 11e9
    assert copied_s(load("frontera-rtx:staged"), nbytes) == pytest.approx(expected, abs=1e-11)
    direct = 2.7e-6 + announced + nbytes / 11e9
    assert copied_s(load("frontera-rtx"), nbytes) == pytest.approx(direct, abs=1e-11)


def test_all_traffic_of_a_gpu_shares_its_slot():
    card = load("rtx-server-a40")
    assert bandwidth(card, (0, 1), (0, ("host", 0)), nodes=1) == close(25.95e9 / 2)
    frontera = load("frontera-rtx")
    assert bandwidth(frontera, (("host", 0), 0)) == close(11.7e9)
    assert bandwidth(frontera, (("host", 0), 0), (0, ("host", 0))) == close(11.7e9)  # both ways at once
    assert bandwidth(load("dgx2"), *[(("host", 0), i) for i in range(16)], nodes=1) < 13e9  # the host's memory


# The host's memory


def test_copies_to_and_from_the_host():
    card = load("frontera-rtx")
    assert bandwidth(card, (("host", 0), 0)) == close(11.7e9)
    assert bandwidth(card, (0, ("host", 0))) == close(13.2e9)
    for way in ((("host", 0), 0), (0, ("host", 0))):
        assert latency_us(card, *way) == pytest.approx(2.7, abs=2e-6)
    assert bandwidth(card, (("host", 0), 0), (("host", 0), 1)) == close(11.7e9)  # lanes of their own


def test_gpus_behind_a_switch_share_the_way_to_the_host():
    card = load("rtx-server-a40", *SWITCHED)
    assert bandwidth(card, (("host", 0), 0), (("host", 0), 1), nodes=1) == close(9e9)
    assert bandwidth(card, (("host", 0), 0), (("host", 0), 4), nodes=1) == close(18e9)
    assert bandwidth(card, (0, 1), (2, 3), nodes=1) == close(25.95e9)
    assert bandwidth(card, (0, 4), (1, 5), nodes=1) == close(9e9)


def test_copies_to_the_host_do_not_cross_between_sockets():
    assert bandwidth(load("rtx-server-a40"), (("host", 0), 0), (("host", 0), 4), nodes=1) == close(25.5e9)


def test_hosts_reach_each_other_over_the_network_alone():
    card = load("frontera-rtx")
    assert bandwidth(card, (("host", 0), ("host", 2))) == close(11e9)
    assert latency_us(card, ("host", 0), ("host", 2)) == pytest.approx(1.5, abs=2e-6)


# Leaf switches


def test_nodes_of_one_leaf_do_not_feel_the_oversubscription():
    card = load("stampede2-skx")
    assert bandwidth(card, *[(i, (i + 1) % 28) for i in range(28)], nodes=56) == close(11e9)
    assert latency_us(card, 0, 27, nodes=56) == pytest.approx(1.7, abs=2e-6)


def test_a_leaf_that_sends_with_all_its_nodes_gets_what_its_up_links_have():
    """Stampede2: 28 links down and 20 up."""
    card = load("stampede2-skx")
    assert bandwidth(card, *[(i, i + 28) for i in range(28)], nodes=56) == close(11e9 * 20 / 28)
    assert bandwidth(card, *[(i, i + 28) for i in range(20)], nodes=56) == close(11e9)
    assert latency_us(card, 0, 28, nodes=56) == pytest.approx(1.7 + 0.4, abs=2e-6)


def test_a_job_on_frontera_has_one_leaf_and_two_jobs_side_by_side_have_two():
    assert {"leaf0.up", "leaf0.down"} == {n for n in Topology(load("frontera-rtx"), 22).links if "leaf" in n}
    card = load("frontera-rtx", "nodes=44")
    pairs = [(4 * node, 4 * (node + 22)) for node in range(22)]
    assert bandwidth(card, *pairs, nodes=44) == close(11e9 / 1.222)


# Storage and display


@pytest.mark.parametrize("clients", [1, 22, 23, 44])
def test_nodes_that_read_share_the_servers(clients):
    """Stampede2: 1.3 GB/s a node until the servers' 29 GB/s are used up."""
    card = load("stampede2-skx")
    reads = [("storage", ("host", node)) for node in range(clients)]
    assert bandwidth(card, *reads, nodes=44) == close(min(1.3e9, 29e9 / clients))


def test_two_nodes_share_a_small_server():
    card = load("frontera-rtx", "storage.shared.server_bandwidth=2 GB/s")
    assert bandwidth(card, ("storage", ("host", 0)), ("storage", ("host", 1))) == close(1e9)
    assert bandwidth(card, ("storage", ("host", 0)), (("disk", 1), ("host", 1))) == close(0.5e9)


def test_what_is_read_shares_the_adapter_with_messages():
    card = load("frontera-rtx", "storage.shared.client_bandwidth=20 GB/s")
    assert bandwidth(card, ("storage", ("host", 0)), (("host", 1), ("host", 0))) == close(5.5e9)


def test_a_disk_is_read_by_its_own_node():
    assert bandwidth(load("laptop"), (("disk", 0), ("host", 0)), nodes=1) == close(3e9)
    with pytest.raises(UnreachableError):
        seconds(load("frontera-rtx"), (("disk", 0), ("host", 1)))


def test_render_nodes_reach_the_display_each_over_its_own_adapter():
    """The display's own adapter is the display's business: `simrender.hardware.display`."""
    card = load("manta-cluster")
    mib = 2**20
    assert bandwidth(card, *[(node, ("display", 0)) for node in range(60)], nodes=60) == close(1868 * mib)
    assert Topology(card, 60).route(59, ("display", 0)) == ("node59.nic.out",)
    with pytest.raises(UnreachableError):
        seconds(load("stampede2-skx"), (0, ("display", 0)))


# Names mean nothing


@check
@given(st.permutations(range(16)), st.data())
def test_renaming_the_gpus_behind_nvswitch_changes_nothing(order, data):
    card = load("dgx2")
    pairs = data.draw(st.lists(st.tuples(st.integers(0, 15), st.integers(0, 15)), min_size=1, max_size=12))
    plain = arrivals(card, pairs)
    assert arrivals(card, [(order[s], order[t]) for s, t in pairs]) == plain


@check
@given(st.permutations(range(28)), st.data())
def test_renaming_the_nodes_of_a_leaf_changes_nothing(order, data):
    card = load("stampede2-skx")
    order = [*order, *range(28, 56)]
    pairs = data.draw(st.lists(st.tuples(st.integers(0, 55), st.integers(0, 55)), min_size=1, max_size=12))
    assert arrivals(card, [(order[s], order[t]) for s, t in pairs]) == arrivals(card, pairs)


def arrivals(card, pairs):
    """Ticks at which copies of 1 MB, 2 MB, ... arrive, all begun at once."""
    env = simpy.Environment()
    network = Machine(env, card, min(56, card.nodes) * card.node_processors).network
    copies = [network.transfer(s, t, 1e6 * (i + 1)) for i, (s, t) in enumerate(pairs) if s != t]
    env.run(env.all_of(copies))
    return [copy.value for copy in copies]


def test_an_arrival_is_a_tick():
    env = simpy.Environment()
    copy = Machine(env, load("dgx2"), 16).network.transfer(0, 1, 1e6)
    env.run(copy)
    assert copy.value == env.now == to_ticks(2.5e-6) + to_ticks(1e6 / 145.57e9)
