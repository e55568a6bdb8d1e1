"""Plot what it costs to rate a component of flows anew against its size: ``python benchmarks/plot_rerate.py out.png``.

Flows run between random hosts of a star whose links differ. One more joins, and the whole component is rated from the
start; the first one leaves, and rating goes on from where it has an effect.
"""

import math
import sys
import time

import matplotlib as mpl
import numpy as np
import simpy

from simrender.hardware import fluid
from simrender.hardware.network import Link, Network

SIZES = [10, 30, 100, 300, 1_000, 3_000, 10_000, 30_000, 100_000]
JOIN, LEAVE = 15, 60


def crowd(n, rng):
    """Return a network in which n flows share the links of a star, and the seconds that each re-rating took."""
    hosts = max(4, math.isqrt(n))
    speed = 10.0 ** rng.uniform(9, 11, (2, hosts))
    links = {(way, i): Link(speed[way, i]) for way in (0, 1) for i in range(hosts)}
    net = Network(simpy.Environment(), links, lambda i, j: ((0, i), (1, j)))
    pairs = rng.integers(0, hosts, (2, n)).tolist()
    net.post(*pairs, rng.uniform(1e12, 1e13, n), np.zeros(n, np.int64), lambda *_: None, np.zeros(n, np.int64))
    return net, hosts


def timed_settlings(net):
    """Let the network note how long each of its re-ratings takes, and how many flows it touches."""
    settle, noted = fluid.settle, []

    def timed(tables, *rest):
        before, begin = net.reratings, time.process_time_ns()
        first = settle(tables, *rest)
        noted.append((net.reratings - before, (time.process_time_ns() - begin) / 1e9))
        return first

    fluid.settle = timed
    return noted, lambda: setattr(fluid, "settle", settle)


def measure(n, rng):
    """Return flows rated and seconds: the middle of several flows that join, and of each flow that leaves."""
    net, hosts = crowd(n, rng)
    env = net._env
    env.run(until=1)
    noted, stop = timed_settlings(net)
    for _ in range(JOIN):
        net.transfer(*rng.integers(0, hosts, 2).tolist(), 1e13)
        env.run(until=env.now + 1)
    joined = noted[:]
    noted.clear()
    while len(noted) < min(LEAVE, n):
        env.step()
    stop()
    return np.median(joined, axis=0), np.array(noted)


def main(path):
    """Measure and plot."""
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    rng = np.random.default_rng(1)
    measure(100, rng)  # compiles
    joins, leaves = zip(*(measure(n, rng) for n in SIZES), strict=True)
    for (all_flows, join), left in zip(joins, leaves, strict=True):
        flows, leave = np.median(left, axis=0)
        print(f"one joins: {all_flows:6.0f} flows rated in {1e6 * join:7.0f} us; ", end="")
        print(f"one leaves: {flows:5.0f} in {1e6 * leave:5.0f} us")
    joins, leaves = np.array(joins), np.concatenate(leaves)
    figure, axes = plt.subplots(figsize=(6.4, 4.4), layout="constrained")
    anchor = SIZES.index(3_000)
    ends = np.array([joins[anchor - 3, 0], joins[-1, 0]])
    axes.loglog(ends, joins[anchor, 1] * ends / joins[anchor, 0], color="0.5", linewidth=1, label="slope 1")
    axes.loglog(*leaves.T, ".", color="#D55E00", alpha=0.4, label="one leaves: rating goes on from the last", mew=0)
    axes.loglog(*joins.T, "o-", color="#0072B2", label="a flow joins: all are rated from the start")
    axes.set_xlabel("flows rated")
    axes.set_ylabel("CPU time of one re-rating (s)")
    axes.grid(visible=True, which="major", color="0.9")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "rerate.png")
