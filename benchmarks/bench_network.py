"""How fast the network is: flows that meet nobody, rings and stars in which everybody meets, the solver by itself.

Each asserts how many events it took or how many flows it rated, so that it tells a slower machine from more work.
"""

import math

import numpy as np
import simpy

from simrender.hardware.machine import Machine, load_machine
from simrender.hardware.maxmin import max_min_rates
from simrender.hardware.network import Link, Network

GPUS = 16
STAGES = 100


def run(env):
    events = 0
    while env.peek() != math.inf:
        env.step()
        events += 1
    return events


def ring(stagger, stages=STAGES):
    """Pass messages of different sizes around a ring, over links that differ; return events and rated flows."""
    env = simpy.Environment()
    links = {("out", i): Link(25e9, 1e-6) for i in range(GPUS)} | {("in", i): Link(25e9, 1e-6) for i in range(GPUS)}
    links |= {("duplex", i): Link(40e9 * (1 + i / GPUS)) for i in range(GPUS)}
    right = {i: (i + 1) % GPUS for i in range(GPUS)}
    routes = {(i, j): [("out", i), ("duplex", i), ("duplex", j), ("in", j)] for i, j in right.items()}
    net = Network(env, links, routes)

    def program():
        for stage in range(stages):
            sizes = [1e6 * (1 + 0.05 * ((7 * i + stage) % GPUS)) for i in range(GPUS)]
            yield env.all_of([net.transfer(i, right[i], sizes[i], start=env.now + i * stagger) for i in range(GPUS)])

    env.process(program())
    events = run(env)
    assert net.flows_finished == GPUS * stages
    return events, net.reratings


def test_a_ring_whose_flows_start_together(benchmark):
    assert benchmark(ring, 0) == (4339, 7088)


def test_a_ring_whose_flows_start_one_after_another(benchmark):
    assert benchmark(ring, 1_000_000) == (6349, 19431)


def test_transfers_that_meet_nobody(benchmark):
    def sequence():
        env = simpy.Environment()
        net = Network(env, {"wire": Link(1e9, 1e-6)}, {("a", "b"): ["wire"]})

        def program():
            for _ in range(2000):
                yield net.transfer("a", "b", 1e6)

        env.process(program())
        return run(env), net.reratings

    assert benchmark(sequence) == (2 + 3 * 2000, 2000)


def test_ten_thousand_flows_that_end_together(benchmark):
    def burst():
        env = simpy.Environment()
        net = Network(env, {"wire": Link(1e9)}, {("a", "b"): ["wire"]})
        for _ in range(10_000):
            net.transfer("a", "b", 1e6)
        return run(env), net.reratings

    assert benchmark(burst) == (10_002, 10_000)


def star(ranks):
    """Return a network of ranks around a switch."""
    links = {(way, i): Link(12.5e9, 1e-6) for way in ("up", "down") for i in range(ranks)}
    return Network(simpy.Environment(), links, lambda i, j: (("up", i), ("down", j)))


def test_an_all_to_all_of_88_ranks_in_which_every_size_differs(benchmark):
    # 7,656 flows at once, in one component; they end at 7,656 ticks.
    ranks = 88
    sources, targets = np.nonzero(~np.eye(ranks, dtype=bool))
    sizes = np.random.default_rng(1).uniform(1e4, 1e6, len(sources))

    def exchange():
        net, calls = star(ranks), []
        zeros = np.zeros(len(sizes), np.int64)
        net.post(sources.tolist(), targets.tolist(), sizes, zeros, lambda keys, _: calls.append(len(keys)), zeros)
        run(net._env)
        return net.flows_finished, len(calls), net.reratings

    assert benchmark(exchange) == (7656, 7656, 14_429_259)


def pairwise(ranks, stages, size):
    """Have each rank send to the one so many further on, one stage after the other, each when it has received."""
    net, at = star(ranks), np.ones(ranks, np.int64)

    def arrived(receivers, tick):
        at[receivers] += 1
        send(receivers[at[receivers] <= stages], tick)

    def send(senders, tick):
        targets = (senders + at[senders]) % ranks
        starts = np.full(len(senders), tick)
        net.post(senders.tolist(), targets.tolist(), size(senders, targets), starts, arrived, targets)

    send(np.arange(ranks), 0)
    run(net._env)
    return net.flows_finished, net.reratings


def test_a_pairwise_all_to_all_of_1024_ranks_in_step(benchmark):
    # A million messages, each pair once.
    result = benchmark.pedantic(pairwise, (1024, 1023, lambda s, _: np.full(len(s), 1e4)), rounds=1)
    assert result == (1024 * 1023, 1024 * 1023)


def test_a_pairwise_all_to_all_of_256_ranks_out_of_step(benchmark):
    # Sizes differ, so each message comes and goes at a tick of its own.
    result = benchmark.pedantic(pairwise, (256, 255, lambda s, t: 1e4 + (7919 * t + 104729 * s) % 4999), rounds=1)
    assert result == (256 * 255, 254_857)


def test_a_pairwise_all_to_all_of_1024_nodes_of_a_fat_tree(benchmark):
    """As MPI does it, on Stampede2: messages that cross between leaf switches share their up-links."""

    def exchange():
        env = simpy.Environment()
        machine = Machine(env, load_machine("stampede2-skx", ["nodes=1024"]), 1024)
        comm = machine.communicator()
        env.run(env.all_of([comm.rank(i).alltoall(1e4, algorithm="pairwise") for i in range(1024)]))
        return machine.network.flows_finished

    assert benchmark.pedantic(exchange, rounds=1) == 1024 * 1023


def test_the_solver_on_a_fat_tree(benchmark):
    # 64 hosts in 8 racks, everyone to everyone: rack uplinks are the bottlenecks, in eight rounds.
    up, down = list(range(64)), list(range(64, 128))
    rack_up, rack_down = list(range(128, 136)), list(range(136, 144))
    capacities = [10e9] * 128 + [20e9 + 1e9 * i for i in range(8)] + [50e9] * 8
    pairs = [(i, j) for i in range(64) for j in range(64) if i // 8 != j // 8]
    flow_links = [(up[i], rack_up[i // 8], rack_down[j // 8], down[j]) for i, j in pairs]
    rates = benchmark(max_min_rates, capacities, flow_links)
    assert len(rates) == 64 * 56
    assert math.isclose(math.fsum(rates), sum(capacities[link] for link in rack_up))
