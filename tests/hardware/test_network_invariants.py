"""The network's tables between the events of random traffic, and what no order of flows, links or names may change."""

import functools

import numpy as np
import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.clock import TICKS_PER_SECOND
from simrender.hardware import fluid
from simrender.hardware.network import Link, Network
from simrender.hardware.tables import WORTH_RESUMING
from tests.flows import step_through

SECOND = TICKS_PER_SECOND
check = settings(deadline=None, derandomize=True, max_examples=50)
seeds = st.integers(0, 2**32 - 1)
WEIGHTS = (1.0, 1.0, 1.0, 0.3, 2.5, 700.0)


def star(rng, hosts):
    """Return the links and routes of hosts around a switch, of bandwidths that differ or not."""
    speed = [1.0] * hosts if rng.random() < 0.5 else 10.0 ** rng.uniform(-1, 1, hosts)
    links = {(way, i): Link(speed[i], rng.choice([0.0, 0.1])) for way in ("up", "down") for i in range(hosts)}
    return links, {(i, j): [("up", i), ("down", j)] if i != j else [] for i in range(hosts) for j in range(hosts)}


def tree(rng, hosts):
    """Return the links and routes of racks of three hosts, whose uplinks are narrow."""
    links, routes = star(rng, hosts)
    links |= {(way, -1 - rack): Link(2.0) for way in ("up", "down") for rack in range(1 + hosts // 3)}
    for i, j in routes:
        if i // 3 != j // 3:
            routes[i, j] = [("up", i), ("up", -1 - i // 3), ("down", -1 - j // 3), ("down", j)]
    return links, routes


def line(rng, hosts):
    """Return the links and routes of hosts in a row, where components come apart easily."""
    links = {i: Link(rng.choice([1.0, 2.0, 3.0])) for i in range(hosts)}
    return links, {(i, j): list(range(min(i, j), max(i, j))) for i in range(hosts) for j in range(hosts)}


SHAPES = (star, tree, line)


def jobs(rng, pairs, n, spread):
    """Return n transfers: pair, bytes, start tick, weight, cap and delay."""
    small = rng.integers(1, 9, n).astype(float)
    return list(
        zip(
            [pairs[i] for i in rng.integers(len(pairs), size=n).tolist()],
            np.where(rng.random(n) < 0.6, small, 10.0 ** rng.uniform(-3, 2, n) * (rng.random(n) < 0.9)).tolist(),
            (rng.integers(0, 1 + spread, n) * (SECOND // 4)).tolist(),
            rng.choice([1.0, 1.0, 1.0, 0.3, 2.5, 700.0], n).tolist(),
            np.where(rng.random(n) < 0.7, np.inf, rng.choice([0.25, 0.7, 3.0], n)).tolist(),
            (rng.integers(0, 2, n) * (SECOND // 10)).tolist(),
            strict=True,
        )
    )


def put_all(net, table, listener, keys):
    """Post transfers without their weights, which batches do not have."""
    ends, sizes, starts, _, caps, delays = zip(*table, strict=True)
    begins = net._env.now + np.array(starts)
    net.post(*zip(*ends, strict=True), sizes, begins, listener, keys, caps=caps, delays=delays)


def busy_network(seed):
    """Start traffic of all kinds: single transfers and batches, some of which cause more; links that slow down or fail.

    Returns the network and its log, which lists who arrived or failed, and when.
    """
    rng, later = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    hosts, shape = int(rng.integers(2, 9)), SHAPES[rng.integers(len(SHAPES))]
    links, routes = shape(rng, hosts)
    net = Network(simpy.Environment(), links, routes, record=True)
    pairs, log = list(routes), []

    def send(job, key):
        pair, nbytes, start, weight, cap, delay = job
        done = net.transfer(*pair, nbytes, start=net._env.now + start, weight=weight, cap=cap, delay=delay)
        done.callbacks.append(functools.partial(arrived, key))

    def arrived(key, done):
        done.defused = True
        log.append((net._env.now, key, done.ok))
        if later.random() < 0.3:
            send(jobs(later, pairs, 1, 2)[0], 1000 + len(log))

    def heard(name, keys, tick):
        log.extend((tick, (name, key), True) for key in keys.tolist())
        if later.random() < 0.2:
            more = jobs(later, pairs, int(later.integers(1, 4)), 1)
            put_all(net, more, listeners[later.integers(2)], 2000 + len(log) + np.arange(len(more)))

    listeners = [functools.partial(heard, name) for name in "pq"]
    failing = rng.random() < 0.4
    for key, job in enumerate(jobs(rng, pairs, int(rng.choice([10, 100, 200])), int(rng.choice([0, 4, 40])))):
        send(job, key)
    if not failing:  # a batch that meets a failure ends the simulation
        put_all(net, jobs(rng, pairs, 40, 4), listeners[0], np.arange(40))
        put_all(net, jobs(rng, pairs, 5, 4), listeners[1], np.arange(5))
    for begin, share in zip(rng.integers(0, 20, 4).tolist(), rng.choice([0.1, 0.5, 1.0], 4).tolist(), strict=True):
        down = failing and rng.random() < 0.5
        end = (begin + int(rng.integers(1, 9))) * SECOND // 4 if down or rng.random() < 0.8 else None
        net.disturb(list(links)[rng.integers(len(links))], 0.0 if down else share, begin * SECOND // 4, end)
    return net, log


@check
@given(seeds)
def test_the_tables_are_in_order_between_any_two_events(seed):
    net, log = busy_network(seed)
    step_through(net._env, net, every=1 + net._started // 10)
    assert net.flows_finished == sum(ok for *_, ok in log)
    assert net._started == len(log)


@check
@given(seeds)
def test_going_on_from_the_last_rating_gives_the_same_bits_as_rating_anew(seed):
    settle = fluid.settle

    def settle_anew(tables, *rest):
        fluid.forget(tables)
        return settle(tables, *rest)

    def run():
        net, log = busy_network(seed)
        net._env.run()
        return log, net.use, sorted(net.loads, key=repr), net.reratings

    *on, fewer = run()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fluid, "settle", settle_anew)
        *anew, more = run()
    assert on == anew
    assert fewer <= more


@check
@given(seeds)
def test_renaming_and_reordering_changes_no_tick_and_no_counter(seed):
    rng = np.random.default_rng(seed)
    shape, hosts = SHAPES[rng.integers(len(SHAPES))], int(rng.integers(2, 9))
    links, routes = shape(rng, hosts)
    table = jobs(rng, list(routes), int(rng.choice([10, 150])), 4)
    slow = list(links)[rng.integers(len(links))]

    def run(links, routes, table, slow):
        net = Network(simpy.Environment(), links, routes)
        net.disturb(slow, 0.3, 2 * SECOND, 5 * SECOND)
        done = [net.transfer(*p, b, start=s, weight=w, cap=c, delay=d) for p, b, s, w, c, d in table]
        net._env.run()
        return [event.value for event in done], net.use

    ticks, use = run(links, routes, table, slow)
    order = rng.permutation(len(table)).tolist()
    named = {old: f"link{new}" for new, old in zip(rng.permutation(len(links)).tolist(), links, strict=True)}
    again, other = run(
        {name: links[old] for old, name in sorted(named.items(), key=lambda item: item[1])},
        {
            (f"n{a}", f"n{b}"): [named[names[i]] for i in rng.permutation(len(names)).tolist()]
            for (a, b), names in reversed(routes.items())
        },
        [((f"n{table[i][0][0]}", f"n{table[i][0][1]}"), *table[i][1:]) for i in order],
        named[slow],
    )
    assert again == [ticks[i] for i in order]
    assert other == {named[link]: row for link, row in use.items()}


@check
@given(seeds, st.integers(1, 40))
def test_a_batch_arrives_as_the_same_transfers_one_by_one(seed, n):
    rng = np.random.default_rng(seed)
    links, routes = SHAPES[rng.integers(len(SHAPES))](rng, 5)
    table = jobs(rng, list(routes), n, 4)
    one_by_one, batch = (Network(simpy.Environment(), links, routes) for _ in range(2))
    log, heard = [], []
    for key, (pair, nbytes, start, _, cap, delay) in enumerate(table):
        done = one_by_one.transfer(*pair, nbytes, start=start, cap=cap, delay=delay)
        done.callbacks.append(lambda done, key=key: log.append((done.value, key)))
    put_all(batch, table, lambda keys, tick: heard.extend((tick, key) for key in keys.tolist()), np.arange(n))
    for net in (one_by_one, batch):
        net._env.run()
    assert heard == log
    assert (batch.use, batch.reratings) == (one_by_one.use, one_by_one.reratings)
    assert (batch.flows_finished, batch.sent_bytes) == (n, pytest.approx(one_by_one.sent_bytes, rel=1e-15))


@pytest.mark.parametrize("part", "ab")
def test_a_flow_joins_one_part_of_a_component_that_has_come_apart(part):
    # The bridge between two crowds ends; what that leaves is rated by going on, so the two stay one for the heap.
    env = simpy.Environment()
    routes = {("a", "-"): ["A"], ("b", "-"): ["B"], ("bridge", "-"): ["A", "B"]}
    net = Network(env, {"A": Link(100.0), "B": Link(200.0)}, routes)
    sizes = [100.0 + i for i in range(WORTH_RESUMING)]
    done = [net.transfer(crowd, "-", nbytes) for crowd in "ab" for nbytes in sizes]
    done += [net.transfer("bridge", "-", 1.0), net.transfer(part, "-", 5.0, start=10 * SECOND)]
    assert step_through(env, net) == 2 * WORTH_RESUMING + 1
    assert all(event.ok for event in done)


def test_a_slot_that_is_used_again_at_once_belongs_to_no_one_else():
    # At one tick a flow arrives, a message without bytes takes its slot, and a link slows down.
    env = simpy.Environment()
    net = Network(env, {"A": Link(2.0), "Z": Link(1.0, 3.0)}, {("a", "-"): ["A"], ("z", "-"): ["Z"]})
    second, first = net.transfer("a", "-", 9.0), net.transfer("a", "-", 1.0)
    later = []

    def arrived(_):
        later.append(net.transfer("z", "-", 0.0))
        net.disturb("A", 0.5, env.now)

    first.callbacks.append(arrived)
    step_through(env, net)
    assert (first.value, later[0].value, second.value) == (SECOND, 4 * SECOND, 9 * SECOND)


def test_a_listener_may_send_into_the_slots_of_the_next_one():
    env = simpy.Environment()
    net = Network(env, dict.fromkeys(range(4), Link(1.0)), {(i, "-"): [i] for i in range(4)})
    heard = []

    def one(keys, tick):
        heard.append(("one", keys.tolist(), tick))
        if tick == SECOND:
            net.post([2, 3], ["-"] * 2, [1.0, 1.0], [tick, tick], one, [77, 78])

    net.post([0], ["-"], [1.0], [0], one, [10])
    net.post([1], ["-"], [1.0], [0], lambda keys, tick: heard.append(("two", keys.tolist(), tick)), [20])
    step_through(env, net)
    assert heard == [("one", [10], SECOND), ("two", [20], SECOND), ("one", [77, 78], 2 * SECOND)]
