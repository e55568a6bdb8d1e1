"""Networks made from graphs: links named by edges, routes by the fewest hops."""

import itertools

import networkx as nx
import pytest
import simpy

from simrender.clock import TICKS_PER_SECOND
from simrender.errors import ScheduleError, UnreachableError, UsageError
from simrender.hardware.network import Network


def graph(*edges):
    digraph = nx.DiGraph()
    for u, v, bandwidth, *latency in edges:
        digraph.add_edge(u, v, bandwidth=bandwidth, **({"latency": latency[0]} if latency else {}))
    return digraph


def used(net):
    return {name for name, nbytes in net.carried_bytes.items() if nbytes}


def send(digraph, source, target, nbytes=1.0):
    env = simpy.Environment()
    net = Network.from_graph(env, digraph)
    return env.run(until=net.transfer(source, target, nbytes)), net


def test_a_graph_routes_by_fewest_hops_over_links_named_by_their_edges():
    digraph = graph(("a", "s", 2.0, 0.5), ("s", "b", 1.0, 0.25), ("a", "x", 9.0), ("x", "y", 9.0), ("y", "b", 9.0))
    tick, net = send(digraph, "a", "b")
    assert tick == TICKS_PER_SECOND * 7 // 4
    assert net.carried_bytes == {("a", "s"): 1, ("s", "b"): 1, ("a", "x"): 0, ("x", "y"): 0, ("y", "b"): 0}


def test_of_routes_with_equal_hops_the_lowest_latency_wins():
    edges = [("a", "p", 1.0, 0.1), ("p", "b", 1.0, 0.3), ("a", "q", 1.0, 0.3), ("q", "b", 1.0, 0.05)]
    assert used(send(graph(*edges), "a", "b")[1]) == {("a", "q"), ("q", "b")}


def test_ties_between_routes_fall_by_name_and_not_by_insertion():
    edges = [("a", name, 1.0, latency) for name, latency in [("n3", 0.125), ("n1", 0.25), ("n2", 0.375)]]
    edges += [(name, "b", 1.0, 0.5 - latency) for _, name, _, latency in edges]
    for order in itertools.permutations(edges):
        assert used(send(graph(*order), "a", "b")[1]) == {("a", "n1"), ("n1", "b")}


def test_routes_of_a_grid_are_as_short_as_networkx_finds_them():
    digraph = nx.grid_2d_graph(4, 5).to_directed()
    nx.set_edge_attributes(digraph, 1.0, "bandwidth")
    nx.set_edge_attributes(
        digraph, {(u, v): 0.001 * (1 + (7 * u[0] + 3 * v[1]) % 5) for u, v in digraph.edges}, "latency"
    )
    for source, target in itertools.permutations(digraph, 2):
        paths = list(nx.all_shortest_paths(digraph, source, target))
        latency = min(
            sum(round(1000 * digraph.edges[e]["latency"]) for e in itertools.pairwise(path)) for path in paths
        )
        tick, net = send(digraph, source, target)
        assert len(used(net)) == len(paths[0]) - 1
        assert tick == pytest.approx(TICKS_PER_SECOND + latency * TICKS_PER_SECOND // 1000, abs=2)


def test_later_changes_of_the_graph_have_no_effect():
    digraph = graph(("a", "s", 1.0), ("s", "b", 1.0))
    env = simpy.Environment()
    net = Network.from_graph(env, digraph)
    digraph.add_edge("a", "b", bandwidth=100.0)
    assert env.run(until=net.transfer("a", "b", 1.0)) == TICKS_PER_SECOND


def test_a_node_of_a_graph_reaches_itself_at_once():
    assert send(graph(("a", "b", 1.0)), "a", "a", 1e9)[0] == 0


@pytest.mark.parametrize("kind", [nx.Graph, nx.MultiDiGraph])
def test_other_graphs_are_refused(kind):
    with pytest.raises(UsageError, match=kind.__name__):
        Network.from_graph(simpy.Environment(), kind([("a", "b", {"bandwidth": 1.0})]))


def test_an_edge_needs_a_bandwidth_that_is_one():
    with pytest.raises(UsageError, match=r"'a' -> 'b' has no bandwidth"):
        Network.from_graph(simpy.Environment(), nx.DiGraph([("a", "b")]))
    with pytest.raises(ScheduleError, match=r"'a' -> 'b'.*-1"):
        Network.from_graph(simpy.Environment(), graph(("a", "b", -1)))


def test_an_unreachable_node_of_a_graph_is_refused_with_what_is_near():
    with pytest.raises(UnreachableError, match=r"'a' -> 'c'; 'a' reaches 'b'$"):
        send(graph(("a", "b", 1.0), ("c", "b", 1.0)), "a", "c")
