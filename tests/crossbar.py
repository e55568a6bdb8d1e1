"""Ranks on a full crossbar, or around one switch, for the tests of collectives and messages."""

import itertools

import simpy
from hypothesis import settings

from simrender.clock import TICKS_PER_SECOND
from simrender.hardware.collectives import Communicator
from simrender.hardware.mpi import MpiCard, Transport
from simrender.hardware.network import Link, Network

US = TICKS_PER_SECOND // 10**6
check = settings(deadline=None, derandomize=True, max_examples=50)

LATENCY, BANDWIDTH, REDUCE = 2 * US, 1e9, 2e9
ALL_EAGER, NONE_EAGER = "1 PB", "0 B"


def crossbar(size, *, eager=ALL_EAGER, overhead="1 us", flavour="mpich", bandwidth=BANDWIDTH, ranges=()):
    """Ranks that each have a link of their own to each other, 1 GB/s and 2 us; they combine 2 GB/s."""
    env = simpy.Environment()
    links = {(i, j): Link(bandwidth, 2e-6) for i, j in itertools.permutations(range(size), 2)}
    network = Network(env, links, lambda s, t: [(s, t)] if s != t else [])
    mpi = MpiCard(flavour=flavour, overhead=overhead, eager=eager, ranges=list(ranges))
    return env, Communicator(env, Transport(network, mpi, range(size), reduce_bandwidth=REDUCE))


def star(size, *, eager=ALL_EAGER, overhead="1 us"):
    """Ranks that each have one link to a switch and one from it, 1 GB/s and 1 us each; they combine 2 GB/s."""
    env = simpy.Environment()
    links = {(way, rank): Link(BANDWIDTH, 1e-6) for way in ("up", "down") for rank in range(size)}
    network = Network(env, links, lambda s, t: [("up", s), ("down", t)] if s != t else [])
    mpi = MpiCard(flavour="mpich", overhead=overhead, eager=eager)
    return env, Communicator(env, Transport(network, mpi, range(size), reduce_bandwidth=REDUCE))
