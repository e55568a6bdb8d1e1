"""Weights, caps and delays, batches, and the counters of links: worked by hand, and where they are hard."""

import itertools
import math

import numpy as np
import pytest
import simpy

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.errors import ScheduleError, UnreachableError, UsageError
from simrender.hardware.network import Link, LinkUse, Network
from tests.flows import finishes, one_link, step_through, steps

SECOND = TICKS_PER_SECOND
YEAR = 31_536_000


def posted(net):
    """Return a list that a listener fills with keys and ticks, and that listener."""
    heard = []
    return heard, lambda keys, tick: heard.extend((key, tick) for key in keys.tolist())


# Weights, caps, delays


def test_flows_share_a_full_link_by_their_weights():
    # At 9 and 3 B/s the heavy flow is done in 2 s; the other has sent 6 of its 18 B, and goes on at 12.
    flows = [("a", "b", 18.0, 0, {"weight": 3.0}), ("a", "b", 18.0, 0)]
    assert finishes(*one_link(12.0), flows)[0] == [2 * SECOND, 3 * SECOND]


def test_a_flow_gets_no_more_than_its_cap_and_the_others_the_rest():
    flows = [("a", "b", 6.0, 0, {"cap": 2.0}), ("a", "b", 30.0, 0), ("a", "b", 12.0, 3 * SECOND)]
    # 2 and 10 B/s until both are done after 3 s, which leaves the third alone.
    assert finishes(*one_link(12.0), flows)[0] == [3 * SECOND, 3 * SECOND, 4 * SECOND]


def test_a_cap_above_the_share_of_a_flow_holds_nobody_back():
    flows = [("a", "b", 6.0, 0, {"cap": 6.0}), ("a", "b", 12.0, 0, {"cap": 7.0})]
    # 6 B/s each for 1 s; then the second is alone, at its cap.
    assert finishes(*one_link(12.0), flows)[0] == [SECOND, SECOND + to_ticks(6 / 7)]


def test_a_cap_holds_where_there_is_no_link():
    flows = [("a", "a", 10.0, SECOND, {"cap": 4.0}), ("a", "a", 10.0, SECOND), ("a", "a", 0.0, 0, {"cap": 4.0})]
    ticks, net = finishes({}, {("a", "a"): []}, flows)
    assert ticks == [SECOND * 7 // 2, SECOND, 0]
    assert net.reratings == 1


def test_a_delay_adds_to_the_latency_and_takes_no_bandwidth():
    flows = [("a", "b", 10.0, 0, {"delay": 2 * SECOND}), ("a", "b", 25.0, 0), ("a", "b", 0.0, 0, {"delay": 7})]
    # The second is alone from 1 s until the first begins at 3 s, with 5 B left.
    ticks, _ = finishes(*one_link(10.0, 1.0), flows)
    assert ticks == [SECOND * 9 // 2, 4 * SECOND, SECOND + 7]


@pytest.mark.parametrize(("weight", "cap"), [(1.0, math.inf), (1.0, 3e8), (1024.0, math.inf), (0.3, 7e8), (5.0, 1e12)])
def test_an_uncontended_transfer_takes_the_closed_form(weight, cap):
    sizes = [1.0, 3.0, 1e3 / 7, 4096.0, 123456789.0, 1e15]
    flows = [("a", "b", b, i * 10**20, {"weight": weight, "cap": cap, "delay": 11}) for i, b in enumerate(sizes)]
    ticks, net = finishes(*one_link(1e9, 1e-6), flows)
    begins = [i * 10**20 + net.latency_ticks("a", "b") + 11 for i in range(len(sizes))]
    assert ticks == [t + to_ticks(b / min(net.bandwidth("a", "b"), cap)) for t, b in zip(begins, sizes, strict=True)]


# Batches


def test_a_listener_hears_once_a_tick_in_the_order_of_the_starts():
    net = Network(simpy.Environment(), {i: Link(1.0) for i in range(4)}, {(i, "-"): [i] for i in range(4)})
    calls = []
    sizes, starts = [1.0, 3.0, 2.0, 5.0], [2 * SECOND, 0, SECOND, 0]
    net.post(range(4), "----", sizes, starts, lambda keys, tick: calls.append((keys.tolist(), tick)), [40, 41, 42, 43])
    assert steps(net._env) == 3 + 2  # for each tick at which some begin, and at which some arrive
    assert calls == [([41, 42, 40], 3 * SECOND), ([43], 5 * SECOND)]


@pytest.mark.parametrize("n", [3, 30])
def test_a_batch_mixes_messages_with_and_without_bytes_links_and_caps(n):
    links, routes = one_link(1.0, 1.0)
    net = Network(simpy.Environment(), links, routes | {("a", "a"): []})
    heard, listener = posted(net)
    sizes, caps = [0.0, 2.0, 0.0] * n, [math.inf, 0.5, 0.25] * n
    net.post(["a"] * 3 * n, ["b", "a", "a"] * n, sizes, np.arange(3 * n) * SECOND, listener, range(3 * n), caps=caps)
    step_through(net._env, net)
    took = [1, 4, 0] * n  # the latency; 2 B at 0.5 B/s; nothing
    expected = [((key + took[key]) * SECOND, key * SECOND, key) for key in range(3 * n)]
    assert heard == [(key, tick) for tick, _, key in sorted(expected)]


def test_an_empty_batch_is_nothing():
    net = Network(simpy.Environment(), *one_link(1.0))
    net.post([], [], [], [], posted(net)[1], [])
    assert steps(net._env) == 0


@pytest.mark.parametrize("n", [2, 20])
@pytest.mark.parametrize(
    ("wrong", "error"),
    [
        ({"nbytes": -1.0}, r"size must be finite and not negative, got -1\.0 B"),
        ({"nbytes": math.nan}, "size must be finite and not negative, got nan B"),
        ({"starts": 4}, "cannot start at tick 4, before now, tick 5"),
        ({"starts": 5.5}, r"ticks and keys must be whole numbers below 2\^63, got an array of float64"),
        ({"caps": 0.0}, r"cap must be above zero, got 0\.0 B/s"),
        ({"delays": -1}, "delay must not be negative, got -1 ticks"),
        ({"delays": 0.5}, "ticks and keys must be whole numbers"),
        ({"keys": 0.5}, "ticks and keys must be whole numbers"),
        ({"targets": "c"}, "no route 'a' -> 'c'"),
    ],
)
def test_a_batch_with_a_wrong_number_is_refused_as_a_whole(n, wrong, error):
    net = Network(simpy.Environment(initial_time=5), *one_link(1.0))
    heard, listener = posted(net)
    good = {"targets": "b", "nbytes": 1.0, "starts": 5, "keys": 1, "caps": 1.0, "delays": 0}
    columns = {name: [value] * (n - 1) + [wrong.get(name, value)] for name, value in good.items()}
    with pytest.raises((ScheduleError, UnreachableError), match=error):
        net.post(["a"] * n, listener=listener, **columns)
    assert (steps(net._env), heard, net.sent_bytes) == (0, [], 0.0)


def test_a_batch_that_would_arrive_beyond_64_bits_is_refused():
    net = Network(simpy.Environment(), *one_link(1.0))
    with pytest.raises(ScheduleError, match=r"before tick 2\^63"):
        net.post("a" * 20, "b" * 20, 1.0, 2**63 - 1, posted(net)[1], 0, delays=1)


@pytest.mark.parametrize("together", [True, False])
def test_a_hundred_thousand_flows_end_in_one_tick(together):
    n = 100_000
    if together:
        net = Network(simpy.Environment(), {0: Link(float(n))}, {(0, "-"): [0]})
    else:
        net = Network(simpy.Environment(), {i: Link(1.0) for i in range(n)}, lambda source, _: [source])
    heard, listener = posted(net)
    net.post([0] * n if together else range(n), "-" * n, np.ones(n), np.zeros(n, int), listener, np.arange(n))
    assert steps(net._env) == 2
    assert heard == [(key, SECOND) for key in range(n)]
    assert net.reratings == n


# Counters


def test_what_a_link_did():
    # 2 s alone, 3 s of nothing, then two together for 2 s, of which one crosses the wide link too.
    links = {"narrow": Link(10.0), "wide": Link(40.0), "unused": Link(1.0)}
    routes = {("a", "b"): ["narrow"], ("a", "c"): ["narrow", "wide"]}
    flows = [("a", "c", 20.0, 0), ("a", "b", 10.0, 5 * SECOND), ("a", "c", 10.0, 5 * SECOND)]
    _, net = finishes(links, routes, flows, record=True)
    assert net.use == {
        "narrow": LinkUse(40.0, 4.0, 40 / 70, 1.0),
        "wide": LinkUse(30.0, 4.0, 30 / 280, 0.25),
        "unused": LinkUse(0.0, 0.0, 0.0, 0.0),
    }
    changes = [(0, 10.0, 10.0), (2, 0.0, 0.0), (5, 10.0, 5.0), (7, 0.0, 0.0)]
    expected = [(t * SECOND, *row) for t, a, b in changes for row in (("narrow", a), ("wide", b))]
    assert sorted(net.loads) == sorted(expected)


def test_a_link_in_use_counts_the_time_so_far():
    env = simpy.Environment()
    net = Network(env, *one_link(10.0))
    assert net.use == {"wire": LinkUse(0.0, 0.0, 0.0, 0.0)}
    net.transfer("a", "b", 100.0, start=SECOND, cap=5.0)
    env.run(until=5 * SECOND)
    assert net.use == {"wire": LinkUse(0.0, 4.0, 0.0, 0.5)}  # no transfer has arrived


@pytest.mark.parametrize("seed", range(3))
def test_loads_add_up_to_the_bytes_that_were_carried(seed):
    rng = np.random.default_rng(seed)
    links = {i: Link(10.0 ** rng.uniform(0, 3)) for i in range(9)}
    routes = {(i, "-"): rng.permutation(9)[: 1 + i % 3].tolist() for i in range(40)}
    flows = [(i % 40, "-", 10.0 ** rng.uniform(0, 4), int(rng.integers(10**13)), {"cap": 50.0}) for i in range(900)]
    _, net = finishes(links, routes, flows, record=True)
    loads = net.loads
    assert len(loads) > 1024 + 2 * len(links)  # the log has grown
    assert [tick for tick, *_ in loads] == sorted(tick for tick, *_ in loads)
    for name, use in net.use.items():
        of_link = [(tick, load) for tick, link, load in loads if link == name]
        spans = [(load, (b - a) / SECOND) for (a, load), (b, _) in itertools.pairwise(of_link)]
        assert of_link[-1][1] == 0.0
        assert math.fsum(load * span for load, span in spans) == pytest.approx(use.carried_bytes, rel=1e-9)
        assert math.fsum(span for load, span in spans if load) == pytest.approx(use.busy_s, rel=1e-12)
        assert max(load for load, _ in spans) / links[name].bandwidth == use.peak_utilization <= 1.0


def test_counters_stay_plain_numbers():
    net = Network(simpy.Environment(), *one_link(1.0))
    net.transfer(
        "a", "b", np.float32(0.1), start=np.int64(3), delay=np.int32(2), weight=np.float32(1), cap=np.float64(1)
    )
    net.transfer("a", "b", np.int64(7))
    assert type(net.sent_bytes) is float
    assert net.sent_bytes == float(np.float32(0.1)) + 7.0
    assert net.latency_ticks("a", "b") == 0
    net._env.run()
    assert type(net._env.now) is int


# Hard cases


def test_after_a_million_seconds_ticks_are_still_exact():
    begin = 10**6 * SECOND + 1
    flows = [("a", "b", 1e-3, begin), ("a", "b", 1e-3, begin), ("a", "b", 1.0, 0)]
    assert finishes(*one_link(1e9), flows)[0] == [begin + 2, begin + 2, 1000]


def test_years_go_by():
    # An epoch lasts 27 days. Two flows share the wire: one sends for years, and others come and go beside it.
    env = simpy.Environment()
    net = Network(env, *one_link(1.0), record=True)
    long = net.transfer("a", "b", float(3 * YEAR))
    short = [net.transfer("a", "b", float(YEAR // 73), start=i * YEAR // 2 * SECOND) for i in range(6)]
    nothing = net.transfer("a", "b", 0.0, start=5 * YEAR * SECOND)
    step_through(env, net)
    assert [event.value for event in short] == [(i * YEAR // 2 + 2 * YEAR // 73) * SECOND for i in range(6)]
    assert long.value == (3 * YEAR + 6 * YEAR // 73) * SECOND
    assert nothing.value == env.now == 5 * YEAR * SECOND
    assert net.use["wire"].busy_s == pytest.approx(3 * YEAR + 6 * YEAR // 73, rel=1e-15)
    assert net.loads == [(0, "wire", 1.0), (long.value, "wire", 0.0)]


def test_an_epoch_ends_with_everything_under_way():
    # A crowd of hundreds, caps, weights, messages without bytes and of no link, transfers that have yet to begin.
    links = {i: Link(1.0, 0.5) for i in range(4)}
    routes = {(i, j): [i, j] if i != j else [] for i in range(4) for j in range(4)}

    def run(start):
        env = simpy.Environment(initial_time=start)
        net = Network(env, links, routes)
        rng, done = np.random.default_rng(7), []
        for _ in range(300):
            i, j = rng.integers(0, 4, 2).tolist()
            options = {"weight": rng.choice([1.0, 3.0]), "cap": rng.choice([np.inf, 0.25])}
            begin = start + int(rng.integers(0, 400)) * SECOND
            done.append(net.transfer(i, j, float(rng.integers(0, 9)), start=begin, **options))
        net.disturb(2, 0.5, start + 100 * SECOND, start + 300 * SECOND)
        step_through(env, net, every=9)
        return [event.value - start for event in done]

    expected = run(0)
    for before in (0, 1, 17, 200, 390):
        assert max(map(abs, np.subtract(run(2**61 - before * SECOND), expected).tolist())) <= 1


def test_a_route_function_is_held_to_the_same_rules():
    routes = {("a", "b"): ["p", "q", "p"], ("a", "c"): ["r"], ("a", "d"): ["p"]}
    net = Network(simpy.Environment(), {"p": Link(1.0), "q": Link(1.0)}, lambda *pair: routes.get(pair))
    with pytest.raises(UsageError, match="the route 'a' -> 'b' uses the link 'p' twice"):
        net.transfer("a", "b", 1.0)
    with pytest.raises(UsageError, match="the route 'a' -> 'c' names an unknown link 'r'"):
        net.transfer("a", "c", 1.0)
    with pytest.raises(UnreachableError, match=r"no route 'a' -> 'e'$"):
        net.transfer("a", "e", 1.0)
    named = Network(simpy.Environment(), {"p": Link(1.0)}, lambda *pair: routes.get(pair), nodes=["a", "d", "e"])
    with pytest.raises(UnreachableError, match=r"no route 'a' -> 'e'; 'a' reaches 'd'$"):
        named.transfer("a", "e", 1.0)
    with pytest.raises(UnreachableError, match=r"no route 'd' -> 'f': there is no node 'f'$"):
        named.post(["a", "d"], ["d", "f"], 1.0, 0, print, 0)


def test_longer_routes_come_later():
    links = {i: Link(1.0) for i in range(40)}
    net = Network(simpy.Environment(), links, lambda _, n: range(n))
    heard, listener = posted(net)
    net.post(["-"] * 20, range(20), np.ones(20), np.zeros(20, int), listener, range(20))
    late = net.transfer("-", 40, 1.0, start=SECOND)
    step_through(net._env, net)
    assert dict(heard)[0] == 0
    assert net.flows_finished == 21
    assert late.ok


@pytest.mark.parametrize(
    ("option", "error"),
    [
        ({"weight": 0.0}, r"weight must lie between 1/1024 and 1024, got 0\.0"),
        ({"weight": math.nan}, "weight must lie between 1/1024 and 1024, got nan"),
        ({"cap": 0.0}, r"cap must be above zero, got 0\.0 B/s"),
        ({"cap": math.nan}, "cap must be above zero, got nan B/s"),
        ({"delay": -1}, "delay must not be negative, got -1 ticks"),
    ],
)
def test_an_option_that_cannot_be_is_refused(option, error):
    net = Network(simpy.Environment(), *one_link(1.0))
    with pytest.raises(ScheduleError, match=error):
        net.transfer("a", "b", 1.0, **option)
    assert (net.sent_bytes, steps(net._env)) == (0.0, 0)


@pytest.mark.parametrize("option", [{"start": 1.5}, {"delay": 0.5}])
def test_a_fraction_of_a_tick_is_refused(option):
    with pytest.raises(TypeError, match="integer"):
        Network(simpy.Environment(), *one_link(1.0)).transfer("a", "b", 1.0, **option)
