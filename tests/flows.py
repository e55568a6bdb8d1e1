"""Flows over a network, for its tests."""

import simpy

from simrender.hardware.network import Network


def finishes(links, routes, flows):
    """Run (source, target, bytes, start tick) flows, declared in this order; return their ticks and the network."""
    env = simpy.Environment()
    net = Network(env, links, routes)
    done = [net.transfer(source, target, nbytes, start=start) for source, target, nbytes, start in flows]
    env.run()
    return [event.value for event in done], net
