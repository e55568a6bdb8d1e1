"""The network: worked by hand, against exact arithmetic, and where it is hard."""

import math
import os
import subprocess
import sys
from fractions import Fraction

import numpy as np
import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.errors import ScheduleError, UnreachableError, UsageError
from simrender.hardware.maxmin import max_min_rates
from simrender.hardware.network import Link, Network
from tests.flows import finishes, one_link, sharing, steps, wide

SECOND = TICKS_PER_SECOND
check = settings(deadline=None, derandomize=True, max_examples=100)


# Worked by hand


def test_a_lone_transfer_takes_the_latencies_of_its_route_and_then_the_bandwidth_of_its_slowest_link():
    links = {"up": Link(10.0, 0.5), "core": Link(2.0, 0.25), "down": Link(4.0)}
    ticks, _ = finishes(links, {("a", "b"): ["up", "core", "down"]}, [("a", "b", 8.0, 0)])
    assert ticks == [SECOND * 3 // 4 + 4 * SECOND]


def test_two_flows_share_one_link():
    ticks, _ = finishes(*one_link(10.0), [("a", "b", 10.0, 0), ("a", "b", 10.0, 0)])
    assert ticks == [2 * SECOND, 2 * SECOND]


def test_when_a_flow_leaves_the_other_speeds_up():
    ticks, _ = finishes(*one_link(10.0), [("a", "b", 10.0, 0), ("a", "b", 30.0, 0)])
    assert ticks == [2 * SECOND, 4 * SECOND]


def test_when_a_flow_joins_the_other_slows_down():
    # Alone for one second (10 of 20 B), then both at 5 B/s: the first needs 2 s more, and leaves 20 of 30 B to send.
    ticks, _ = finishes(*one_link(10.0), [("a", "b", 20.0, 0), ("a", "b", 30.0, SECOND)])
    assert ticks == [3 * SECOND, 5 * SECOND]


def test_a_transfer_uses_no_bandwidth_before_its_latency_is_over():
    links = {"long": Link(100.0, 1.0), "wire": Link(10.0)}
    routes = {("a", "b"): ["wire"], ("c", "b"): ["long", "wire"]}
    ticks, _ = finishes(links, routes, [("a", "b", 10.0, 0), ("c", "b", 10.0, 0)])
    assert ticks == [SECOND, 2 * SECOND]


def test_a_parking_lot():
    # One flow drives past three entries; at each a local flow joins. The second entry is the narrow one.
    links = {"x": Link(6.0), "y": Link(2.0), "z": Link(10.0)}
    routes = {("in", "out"): ["x", "y", "z"], **{(name, "-"): [name] for name in links}}
    assert max_min_rates([6.0, 2.0, 10.0], [(0, 1, 2), (0,), (1,), (2,)]) == [1.0, 5.0, 1.0, 9.0]
    ticks, _ = finishes(
        links, routes, [("in", "out", 3.0, 0), ("x", "-", 5.0, 0), ("y", "-", 1.0, 0), ("z", "-", 18.0, 0)]
    )
    # After 1 s the long flow has x and y to itself, takes 2 B/s and leaves 8 to z, so it sends its last 2 B by 2 s.
    # By then z has sent 9 + 8 of its 18 B, and the last one goes at 10 B/s.
    assert ticks == [2 * SECOND, SECOND, SECOND, 2 * SECOND + SECOND // 10]


def test_a_transfer_may_start_later_and_its_value_is_the_tick_it_arrives():
    links, routes = one_link(10.0, 1.0)
    env = simpy.Environment(initial_time=SECOND)
    net = Network(env, links, routes)
    done = net.transfer("a", "b", 10.0, start=5 * SECOND)
    assert env.run(until=done) == env.now == done.value == 7 * SECOND
    assert (net.sent_bytes, net.flows_finished) == (10.0, 1)


# The whole network, against exact arithmetic


def exact_rates(capacities, flow_links):
    """Fill progressively in fractions: raise all rates together, freeze the flows of whatever is full, go on."""
    rates = [Fraction(0)] * len(flow_links)
    growing = set(range(len(flow_links)))
    while growing:
        room = {}
        for link, capacity in enumerate(capacities):
            users = [flow for flow, links in enumerate(flow_links) if link in links]
            if growing.intersection(users):
                room[link] = (capacity - sum(rates[f] for f in users)) / len(growing.intersection(users))
        rise = min(room.values())
        for flow in growing:
            rates[flow] += rise
        growing -= {f for f in growing if any(room[link] == rise for link in flow_links[f])}
    return rates


def exact_finishes(capacities, flow_links, sizes, starts):
    """Return when each flow ends, in seconds, in a fluid network without ticks."""
    now = Fraction(0)
    left = [Fraction(size) for size in sizes]
    ends = [None] * len(sizes)
    while None in ends:
        live = [f for f in range(len(sizes)) if ends[f] is None and starts[f] <= now]
        rates = dict(zip(live, exact_rates(capacities, [flow_links[f] for f in live]), strict=True))
        later = [start for start in starts if start > now]
        step = min([left[f] / rates[f] for f in live] + [start - now for start in later])
        now += step
        for f in live:
            left[f] -= step * rates[f]
            if not left[f]:
                ends[f] = now
    return ends


def as_network(capacities, flow_links, latency=0.0):
    links = {f"link{i}": Link(float(c), latency) for i, c in enumerate(capacities)}
    return links, {(i, -i - 1): [f"link{link}" for link in path] for i, path in enumerate(flow_links)}


@st.composite
def traffic(draw):
    """Return capacities in B/s, the links of each flow, their sizes in B and their starts in quarters of a second."""
    capacities, flow_links = draw(sharing(st.integers(1, 8)))
    n = len(flow_links)
    sizes = draw(st.lists(st.integers(1, 40), min_size=n, max_size=n))
    return capacities, flow_links, sizes, draw(st.lists(st.integers(0, 20), min_size=n, max_size=n))


def run_traffic(case, speed=1):
    capacities, flow_links, sizes, starts = case
    flows = [(i, -i - 1, b, t * SECOND // 4) for i, (b, t) in enumerate(zip(sizes, starts, strict=True))]
    return finishes(*as_network([speed * c for c in capacities], flow_links), flows)


@check
@given(traffic())
def test_flows_end_when_exact_arithmetic_says(case):
    capacities, flow_links, sizes, starts = case
    ticks, _ = run_traffic(case)
    exact = exact_finishes(capacities, flow_links, sizes, [Fraction(t, 4) for t in starts])
    # Seconds long, they may be late by the few ticks that their neighbours were rounded up.
    assert all(abs(tick - end * SECOND) < 100 for tick, end in zip(ticks, exact, strict=True))


@check
@given(traffic())
def test_bytes_are_conserved(case):
    capacities, flow_links, sizes, _ = case
    sizes = [size / 3 for size in sizes]
    _, net = run_traffic((capacities, flow_links, sizes, case[3]))
    assert net.flows_finished == len(sizes)
    assert net.sent_bytes == pytest.approx(math.fsum(sizes), rel=1e-12)
    for i, carried in enumerate(net.carried_bytes.values()):
        sent = math.fsum(size for size, links in zip(sizes, flow_links, strict=True) if i in links)
        assert carried == pytest.approx(sent, rel=1e-12)


@check
@given(traffic())
def test_twice_the_bandwidth_takes_half_the_time(case):
    capacities, flow_links, sizes, _ = case
    case = (capacities, flow_links, sizes, [0] * len(sizes))
    slow, net = run_traffic(case)
    fast, _ = run_traffic(case, speed=2)
    assert all(abs(s - 2 * f) <= 2 * net.reratings for s, f in zip(slow, fast, strict=True))


@check
@given(traffic(), st.randoms(use_true_random=False))
def test_renaming_and_reordering_changes_no_tick(case, rng):
    capacities, flow_links, sizes, starts = case
    ticks, net = run_traffic(case)
    order = rng.sample(range(len(sizes)), len(sizes))
    link_order = rng.sample(range(len(capacities)), len(capacities))
    links = {("renamed", i): Link(float(capacities[i])) for i in link_order}
    routes = {(str(f), "to"): rng.sample([("renamed", i) for i in flow_links[f]], len(flow_links[f])) for f in order}
    again, other = finishes(links, routes, [(str(f), "to", sizes[f], starts[f] * SECOND // 4) for f in order])
    assert again == [ticks[f] for f in order]
    assert other.reratings == net.reratings


@check
@given(st.lists(wide, min_size=1, max_size=4), wide, st.floats(1.0, 1e6), st.integers(0, 3), st.floats(0.0, 1e9))
def test_a_faster_link_never_slows_a_single_transfer(capacities, latency, gain, which, nbytes):
    flow_links = [range(len(capacities))]
    before, _ = finishes(*as_network(capacities, flow_links, latency), [(0, -1, nbytes, 0)])
    capacities[which % len(capacities)] *= gain
    after, _ = finishes(*as_network(capacities, flow_links, latency), [(0, -1, nbytes, 0)])
    assert after <= before


# Who is re-rated, and when


def test_only_flows_that_share_a_link_directly_or_through_others_are_rerated():
    links = {name: Link(1.0) for name in "pqrs"}
    routes = {(0, 1): ["p", "q"], (2, 3): ["q", "r"], (4, 5): ["s"], (6, 7): ["s"]}
    flows = [(0, 1, 4.0, 0), (4, 5, 4.0, 0), (2, 3, 0.5, SECOND)]
    alone, _ = finishes(links, routes, flows)
    ticks, net = finishes(links, routes, [*flows, (6, 7, 0.5, 3 * SECOND)])
    assert ticks == [alone[0], SECOND * 9 // 2, alone[2], 4 * SECOND]
    # Either component: one flow starts; two are rated when the other joins; one when that has left.
    assert net.reratings == 2 * (1 + 2 + 1)


def test_a_flow_whose_rate_stays_the_same_keeps_its_tick_to_the_last():
    # At a third of a byte a second, where scheduling it anew each time would make it a tick late.
    links = {"slow": Link(1 / 3), "wide": Link(100.0)}
    routes = {("a", "b"): ["slow", "wide"], ("c", "b"): ["wide"]}
    ticks, net = finishes(links, routes, [("a", "b", 0.5, 0)] + [("c", "b", 0.05, t * 10**9 + 1) for t in range(100)])
    assert ticks[0] == to_ticks(0.5 / (1 / 3))
    assert net.reratings == 1 + 100 * (2 + 1)


def test_flows_that_start_at_one_tick_are_rated_together():
    env = simpy.Environment()
    net = Network(env, *one_link(8.0))
    done = []

    def sender():
        done.append(net.transfer("a", "b", 1.0))
        yield env.timeout(0)
        done.append(net.transfer("a", "b", 1.0))

    for _ in range(4):
        env.process(sender())
    env.run()
    assert [event.value for event in done] == [SECOND] * 8
    assert net.reratings == 8


def test_a_flow_that_follows_another_at_once_is_rated_together_with_what_that_left():
    env = simpy.Environment()
    net = Network(env, *one_link(2.0))
    bystander = net.transfer("a", "b", 3.0)

    def chain():
        for _ in range(3):
            yield net.transfer("a", "b", 1.0)

    env.process(chain())
    env.run()
    assert bystander.value == env.now == 3 * SECOND
    assert net.reratings == 3 * 2


def test_transfers_that_arrive_at_one_tick_succeed_in_the_order_they_started():
    env = simpy.Environment()
    links = {name: Link(1.0) for name in "abcd"}
    net = Network(env, links, {(name, "-"): [name] for name in links} | {("here", "here"): []})
    order = []
    jobs = [("a", 1.0, 3), ("b", 4.0, 0), ("c", 2.0, 2), ("d", 2.0, 2), ("a", 0.0, 4), ("here", 9.0, 4)]
    for i, (source, nbytes, start) in enumerate(jobs):
        done = net.transfer(source, "here" if source == "here" else "-", nbytes, start=start * SECOND)
        done.callbacks.append(lambda _, i=i: order.append((env.now, i)))
    env.run()
    assert order == [(4 * SECOND, i) for i in (1, 2, 3, 0, 4, 5)]


@pytest.mark.parametrize("latency", [0.0, 1.0])
def test_an_uncontended_transfer_costs_three_events(latency):
    env = simpy.Environment()
    net = Network(env, *one_link(1.0, latency))
    for i in range(10):
        net.transfer("a", "b", 1.0, start=10 * i * SECOND)
    assert steps(env) == 30
    assert net.reratings == 10


def test_a_long_flow_does_not_remember_all_who_passed():
    env = simpy.Environment()
    net = Network(env, *one_link(1.0))
    net.transfer("a", "b", 1e6)

    def passers_by():
        for _ in range(1000):
            yield env.timeout(SECOND)
            yield net.transfer("a", "b", 0.5)

    env.process(passers_by())
    env.run(until=3000 * SECOND)
    assert net.flows_finished == 1000
    assert len(net._t.flows) == 64


PROGRAM = """
import simpy
from simrender.hardware.network import Link, Network
env = simpy.Environment()
names = ["alpha", "beta", "gamma", "delta", "epsilon"]
links = {n: Link(1e9 + i, 1e-6) for i, n in enumerate(names)}
net = Network(env, links, {(a, b): [a, b] for a in names for b in names if a != b})
for i, a in enumerate(names):
    for j, b in enumerate(names):
        if a != b:
            net.transfer(a, b, 1000 * (i + 1) + 77 * j).callbacks.append(lambda e, a=a, b=b: print(env.now, a, b))
env.run()
import sys
assert "networkx" not in sys.modules, "networkx is slow to import, and not needed here"
"""


def test_the_log_depends_on_no_hash():
    logs = []
    for seed in "12":
        command = [sys.executable, "-W", "error", "-c", PROGRAM]
        env = {**os.environ, "PYTHONHASHSEED": seed}
        logs.append(subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout)
    assert logs[0] == logs[1]
    assert len(logs[0].splitlines()) == 20


# Hard cases


def test_no_bytes_take_the_latency_alone_and_no_bandwidth():
    ticks, net = finishes(*one_link(1.0, 1.0), [("a", "b", 1.0, 0), ("a", "b", 0, SECOND)])
    assert ticks == [2 * SECOND, 2 * SECOND]
    assert (net.reratings, net.flows_finished) == (1, 2)


def test_an_empty_route_takes_no_time():
    ticks, net = finishes({}, {("a", "a"): ()}, [("a", "a", 1e15, 7)])
    assert ticks == [7]
    assert (net.sent_bytes, net.reratings, net.carried_bytes) == (1e15, 0, {})


def test_a_neighbour_joins_one_tick_before_the_end():
    # After four days the tick is finer than a double's last bit, and rate times time rounds to more than was left.
    rate, nbytes = 20318.118684046676, 8010888358.139662
    end = to_ticks(nbytes / rate)
    ticks, _ = finishes(*one_link(rate), [("a", "b", nbytes, 0), ("a", "b", 1.0, end - 1)])
    assert ticks == [end - 1, end - 1 + to_ticks(1.0 / rate)]


def test_bandwidths_twelve_orders_apart():
    links = {"slow": Link(1.0), "fast": Link(1e12)}
    routes = {("a", "b"): ["slow", "fast"], ("c", "b"): ["fast"]}
    ticks, _ = finishes(links, routes, [("a", "b", 10.0, 0), ("c", "b", 1e12 - 1, 0)])
    assert ticks == [10 * SECOND, SECOND]


def test_a_petabyte_at_a_byte_a_second():
    ticks, net = finishes(*one_link(1.0), [("a", "b", 1e15, 0)])
    assert ticks == [pytest.approx(10**27, rel=1e-15)]
    assert net.carried_bytes == {"wire": 1e15}


def test_a_byte_behind_a_terabyte():
    ticks, net = finishes(*one_link(1e9), [("a", "b", 1e12, 0), ("a", "b", 1, SECOND)])
    # Two nanoseconds at half the bandwidth, one of which is lost to the terabyte; each is rounded up by a tick at most.
    assert ticks == [pytest.approx(1000 * SECOND + 1001, abs=1), pytest.approx(SECOND + 2001, abs=1)]
    assert net.carried_bytes == {"wire": 1e12 + 1}


@pytest.mark.parametrize("n_links", [1, 10_000])
def test_ten_thousand_flows_end_in_one_tick(n_links):
    env = simpy.Environment()
    net = Network(env, {i: Link(1e4 / n_links) for i in range(n_links)}, {(i, "-"): [i] for i in range(n_links)})
    order = []
    for i in range(10_000):
        net.transfer(i % n_links, "-", 1.0).callbacks.append(lambda _, i=i: order.append(i))
    assert steps(env) == 10_000 + 2  # one end each, one rating, one wake-up
    assert env.now == SECOND
    assert order == list(range(10_000))
    assert net.reratings == net.flows_finished == 10_000


def test_thousands_of_staggered_flows_lose_no_byte_and_fit_the_links():
    rng = np.random.default_rng(1)
    links = {i: Link(10.0 ** rng.uniform(0, 12), 10.0 ** rng.uniform(-9, -3)) for i in range(40)}
    routes = {(i, "-"): rng.permutation(40)[: 1 + i % 3].tolist() for i in range(200)}
    sizes = (10.0 ** rng.uniform(0, 9, 1000)).tolist()
    ticks, net = finishes(links, routes, [(i % 200, "-", b, i * 10**7) for i, b in enumerate(sizes)])
    assert net.flows_finished == 1000
    assert net.sent_bytes == pytest.approx(math.fsum(sizes), rel=1e-12)
    for link, carried in net.carried_bytes.items():
        users = [i for i in range(1000) if link in routes[i % 200, "-"]]
        assert carried == pytest.approx(math.fsum(sizes[i] for i in users), rel=1e-12)
        # A link that was over its capacity for long would be done too early.
        assert carried <= links[link].bandwidth * (max(ticks[i] for i in users) - users[0] * 10**7) / SECOND


# What is refused


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, math.inf, math.nan])
def test_a_link_needs_a_bandwidth(bandwidth):
    with pytest.raises(ScheduleError, match=f"bandwidth.*{bandwidth}"):
        Link(bandwidth)


@pytest.mark.parametrize("latency", [-1e-9, math.inf, math.nan])
def test_a_link_needs_a_latency_that_can_be(latency):
    with pytest.raises(ScheduleError, match=f"latency.*{latency}"):
        Link(1.0, latency)


def test_a_route_over_an_unknown_link_is_refused():
    with pytest.raises(UsageError, match=r"'a' -> 'b'.*'wirre'; did you mean 'wire'\?"):
        Network(simpy.Environment(), {"wire": Link(1.0)}, {("a", "b"): ["wirre"]})
    with pytest.raises(UsageError, match=r"0 -> 1.*unknown link 7$"):
        Network(simpy.Environment(), {"wire": Link(1.0)}, {(0, 1): [7]})


def test_a_route_through_one_link_twice_is_refused():
    with pytest.raises(UsageError, match=r"'a' -> 'b'.*'p' twice"):
        Network(simpy.Environment(), {"p": Link(1.0), "q": Link(1.0)}, {("a", "b"): ["p", "q", "p"]})


@pytest.mark.parametrize("nbytes", [-1, math.inf, math.nan])
def test_a_size_that_cannot_be_is_refused(nbytes):
    net = Network(simpy.Environment(), *one_link(1.0))
    with pytest.raises(ScheduleError, match=f"size.*{nbytes}"):
        net.transfer("a", "b", nbytes)
    assert net.sent_bytes == 0.0


def test_a_start_in_the_past_is_refused():
    net = Network(simpy.Environment(initial_time=10), *one_link(1.0))
    with pytest.raises(ScheduleError, match=r"tick 9, before now, tick 10"):
        net.transfer("a", "b", 1.0, start=9)


def test_an_unreachable_pair_is_refused_with_what_is_near():
    routes = {("gpu0", "gpu1"): ["wire"], ("gpu0", "gpu2"): ["wire"], ("gpu1", "gpu0"): ["wire"]}
    net = Network(simpy.Environment(), {"wire": Link(1.0)}, routes)
    with pytest.raises(UnreachableError, match=r"'gpu1' -> 'gpu2'; 'gpu1' reaches 'gpu0'$"):
        net.transfer("gpu1", "gpu2", 1.0)
    with pytest.raises(UnreachableError, match=r"'gpu2' -> 'gpu0'; 'gpu2' reaches no other node"):
        net.transfer("gpu2", "gpu0", 1.0)
    with pytest.raises(UnreachableError, match=r"'gpu0' -> 'GPU1'.*no node 'GPU1'; did you mean 'gpu1'\?"):
        net.transfer("gpu0", "GPU1", 1.0)
