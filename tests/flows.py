"""Flows over a network, for its tests: running them, random traffic, and what must be true of the tables in between."""

from __future__ import annotations

import itertools
import math

import simpy
from hypothesis import strategies as st

from simrender.hardware.maxmin import max_min_rates
from simrender.hardware.network import Link, Network
from simrender.hardware.tables import CAPPED, FAR, HEAP_SIZE, NONE, PULLED, VACATED, WEIGHT_UNIT, WIDOWED

wide = st.floats(-6, 6).map(lambda exponent: 10.0**exponent)


@st.composite
def sharing(draw, capacity):
    """Return capacities, and for each flow the links it uses, none of them twice."""
    capacities = draw(st.lists(capacity, min_size=1, max_size=7))
    link = st.integers(0, len(capacities) - 1)
    return capacities, draw(st.lists(st.lists(link, min_size=1, max_size=4, unique=True), min_size=1, max_size=9))


def one_link(bandwidth, latency=0.0):
    """Return the links and routes of a single wire from a to b."""
    return {"wire": Link(bandwidth, latency)}, {("a", "b"): ["wire"]}


def steps(env):
    """Run to the end; return how many events SimPy processed."""
    for count in itertools.count():
        if env.peek() == math.inf:
            return count
        env.step()
    raise AssertionError


def finishes(links, routes, flows, **options):
    """Run (source, target, bytes, start tick, {weight, cap, delay}) flows, declared in this order.

    Return their ticks and the network.
    """
    env = simpy.Environment()
    net = Network(env, links, routes, **options)
    done = [
        net.transfer(source, target, nbytes, start=start, **(more[0] if more else {}))
        for source, target, nbytes, start, *more in flows
    ]
    env.run()
    return [event.value for event in done], net


def flows_of_links(net):
    """Return the slots of the flows of each link, having checked the lists they stand in."""
    t, width = net._t, net._t.hops.shape[1]
    users = []
    for link, row in enumerate(t.links):
        slots, before, entry = [], NONE, int(row["first"])
        while entry != NONE:
            slot, hop = divmod(entry, width)
            assert t.chain["before"][entry] == before
            assert hop < t.flows[slot]["hops"]
            assert t.hops[slot, hop] == link
            slots.append(slot)
            before, entry = entry, int(t.chain["after"][entry])
        assert len(set(slots)) == len(slots) == row["users"]
        assert row["weight"] == sum(int(t.flows[slot]["weight"]) for slot in slots)
        users.append(slots)
    return users


def check_tables(net):
    """Assert what must hold of a network's tables between any two events; return how many flows share links."""
    t, now = net._t, int(net._env.now) - net._epoch
    users = flows_of_links(net)
    joined = sorted({slot for slots in users for slot in slots})
    for slot in joined:
        links = t.hops[slot, : t.flows[slot]["hops"]].tolist()
        assert all(slot in users[link] for link in links)
    assert all(net._owners[slot] is None for slot in net._free)
    assert len(set(net._free)) == len(net._free)
    assert not set(joined).intersection(net._free)

    in_heap = {}
    heap = t.heap[: t.counters[HEAP_SIZE]]
    for i, (tick, leader) in enumerate(heap.tolist()):
        assert heap["tick"][(i - 1) // 2] <= tick or i == 0
        assert t.flows[leader]["place"] == i
        member, finish = leader, FAR
        while member != NONE:
            assert member not in in_heap, "a flow is in two components"
            in_heap[member] = leader
            assert t.flows[member]["leader"] == leader
            assert net._owners[member] is not None
            finish = min(finish, int(t.flows[member]["finish"]))
            member = int(t.flows[member]["next"])
        assert tick == finish >= min(now, FAR)
    settled = (
        not (t.counters[WIDOWED] or t.counters[PULLED] or t.counters[VACATED])
        and int(net._env.now) not in net._arrivals
    )
    if settled:
        assert set(joined) <= set(in_heap), "a flow is in no component"
        alone = [slot for slot in in_heap if slot not in set(joined)]
        assert all(t.flows[slot]["hops"] == 0 for slot in alone)
        capped = [slot for slot in in_heap if t.story[slot]["cap"] < math.inf]
        assert t.counters[CAPPED] == len(capped)
        check_rates(net, joined)
    return len(joined)


def check_rates(net, joined):
    """Assert that flows have, to the bit, the rates of a network that is rated all at once."""
    t = net._t
    rates = max_min_rates(
        t.links["capacity"].tolist(),
        [t.hops[slot, : t.flows[slot]["hops"]].tolist() for slot in joined],
        (t.flows["weight"][joined] * WEIGHT_UNIT).tolist(),
        t.story["cap"][joined].tolist(),
    )
    assert t.flows["rate"][joined].tolist() == rates
    for link, row in enumerate(t.links):
        through = math.fsum(
            r for slot, r in zip(joined, rates, strict=True) if link in t.hops[slot, : t.flows[slot]["hops"]]
        )
        assert row["load"] <= row["capacity"]
        assert math.isclose(row["load"], through, rel_tol=1e-9, abs_tol=1e-9 * row["capacity"])


def step_through(env, net, every=1):
    """Run to the end, checking the tables after every so manyth event; return the most flows that shared links."""
    most, count = 0, 0
    while env.peek() < math.inf:
        env.step()
        count += 1
        if count % every == 0:
            most = max(most, check_tables(net))
    check_tables(net)
    assert (net._t.counters[HEAP_SIZE], net._t.counters[CAPPED], net._arrivals) == (0, 0, {})
    return most
