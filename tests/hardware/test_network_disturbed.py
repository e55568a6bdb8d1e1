"""Links that slow down, fail and recover."""

import numpy as np
import pytest
import simpy

from simrender.clock import TICKS_PER_SECOND
from simrender.errors import LinkFailedError, ScheduleError, UsageError
from simrender.hardware.network import Link, Network
from tests.flows import one_link, step_through

SECOND = TICKS_PER_SECOND


def wire(bandwidth=10.0, latency=0.0):
    return Network(simpy.Environment(), *one_link(bandwidth, latency))


def test_a_link_slows_down_for_a_while():
    # 20 B in 2 s, 10 B in the 4 s at a quarter, and the last 70 B in 7 s.
    net = wire()
    net.disturb("wire", 0.25, 2 * SECOND, 6 * SECOND)
    done = net.transfer("a", "b", 100.0)
    step_through(net._env, net)
    assert done.value == 13 * SECOND


def test_of_disturbances_that_overlap_the_worst_counts():
    # 10 B, then 5, 1 and 5 B a second by turns, then 10 again: 21 B by 4 s.
    net = wire()
    net.disturb("wire", 0.5, SECOND, 4 * SECOND)
    net.disturb("wire", 0.1, 2 * SECOND, 3 * SECOND)
    net.disturb("wire", 0.5, 2 * SECOND, 3 * SECOND)
    done = net.transfer("a", "b", 31.0)
    step_through(net._env, net)
    assert done.value == 5 * SECOND


def test_a_link_that_stays_slow():
    net = wire()
    net.disturb("wire", 0.5, 0)
    assert net._env.run(until=net.transfer("a", "b", 10.0)) == 2 * SECOND
    assert net.bandwidth("a", "b") == 10.0  # nominal


def test_a_slow_link_slows_those_who_share_it_and_frees_other_links():
    links = {"p": Link(10.0), "q": Link(10.0)}
    net = Network(simpy.Environment(), links, {("a", "b"): ["p", "q"], ("c", "b"): ["q"]})
    net.disturb("p", 0.2, SECOND)
    both, other = net.transfer("a", "b", 15.0), net.transfer("c", "b", 21.0)
    step_through(net._env, net)
    # 5 B/s each for 1 s, then 2 and 8 until 3 s, when the other has sent 5 + 16 B.
    assert (other.value, both.value) == (3 * SECOND, 6 * SECOND)
    assert net.use["p"].peak_utilization == 1.0


def test_a_failure_fails_what_is_under_way_and_what_arrives_until_the_link_is_back():
    net = wire(10.0, 1.0)
    net.disturb("wire", 0.0, 5 * SECOND, 8 * SECOND)
    sent = [(10.0, 0), (100.0, 2), (10.0, 5), (10.0, 6), (10.0, 7), (0.0, 4), (0.0, 6), (0.0, 8)]
    done = [net.transfer("a", "b", nbytes, start=start * SECOND) for nbytes, start in sent]
    failed = {}
    for i, event in enumerate(done):
        event.callbacks.append(lambda event, i=i: failed.update({i: net._env.now}) if not event.ok else None)
        event.defused = True
    step_through(net._env, net)
    # The third and fourth reach the link while it is down, the fifth when it is back; the sixth has just arrived.
    assert failed == {1: 5 * SECOND, 2: 6 * SECOND, 3: 7 * SECOND, 6: 7 * SECOND}
    assert [done[i].value for i in (0, 4, 5, 7)] == [2 * SECOND, 9 * SECOND, 5 * SECOND, 9 * SECOND]
    assert net.flows_finished == 4
    assert net.carried_bytes == {"wire": 20.0}
    message = "the link wire is down at 5 s, with 100 B from 'a' to 'b' on their way"
    assert str(done[1].value) == message


def test_what_arrives_when_the_link_fails_is_through():
    net = wire()
    done = net.transfer("a", "b", 10.0)
    heard = []
    net.post(["a"], ["b"], [10.0], [0], lambda keys, tick: heard.append((keys.tolist(), tick)), [3])
    net.disturb("wire", 0.0, 2 * SECOND)
    step_through(net._env, net)
    assert done.value == 2 * SECOND
    assert heard == [([3], 2 * SECOND)]


def test_what_arrives_when_the_link_slows_down_is_not_late():
    # At a third of a byte a second, where the last byte is rounded up to a tick.
    ticks = []
    for share in (1.0, 0.1):
        net = wire(1 / 3)
        done = net.transfer("a", "b", 0.1)
        net.disturb("wire", share, 300_000_000_000 if not ticks else ticks[0])
        net._env.run()
        ticks.append(done.value)
    assert ticks[0] == ticks[1]


def test_a_process_can_catch_a_failure_and_try_again():
    net = wire()
    net.disturb("wire", 0.0, SECOND, 3 * SECOND)
    tries = []

    def sender():
        while True:
            try:
                yield net.transfer("a", "b", 20.0)
            except LinkFailedError:
                tries.append(net._env.now)
                yield net._env.timeout(SECOND)
            else:
                return

    net._env.process(sender())
    step_through(net._env, net)
    # What fails under way fails at once, what is sent over a dead link too; after 3 s it goes through.
    assert tries == [SECOND, 2 * SECOND]
    assert net._env.now == 5 * SECOND


def test_a_failure_that_nobody_waits_for_ends_the_run():
    net = wire()
    net.disturb("wire", 0.0, SECOND)
    net.transfer("a", "b", 20.0)
    with pytest.raises(LinkFailedError, match="the link wire is down at 1 s, with 20 B from 'a' to 'b'"):
        net._env.run()


@pytest.mark.parametrize("nbytes", [0.0, 20.0])
@pytest.mark.parametrize("begin", [0, SECOND])
def test_a_failure_under_a_batch_ends_the_run(nbytes, begin):
    net = wire(10.0, 1.5)
    net.disturb("wire", 0.0, begin)
    net.post(["a"] * 20, ["b"] * 20, [nbytes] * 20, [0] * 20, print, range(20))
    with pytest.raises(LinkFailedError, match=f"with {nbytes:.0f} B from 'a' to 'b' on their way"):
        net._env.run()


def test_those_who_shared_a_link_with_a_failed_transfer_speed_up():
    links = {"p": Link(10.0), "q": Link(10.0)}
    net = Network(simpy.Environment(), links, {("a", "b"): ["p", "q"], ("c", "b"): ["q"]})
    net.disturb("p", 0.0, SECOND)
    net.transfer("a", "b", 100.0).defused = True
    other = net.transfer("c", "b", 15.0)
    step_through(net._env, net)
    assert other.value == 2 * SECOND


def test_a_thousand_fail_at_once_in_the_order_in_which_they_started():
    net = wire(1e6)
    net.disturb("wire", 0.0, 3 * SECOND)
    order = []
    for i in np.random.default_rng(1).permutation(1000).tolist():
        done = net.transfer("a", "b", 1e9, start=i * 10**6)
        done.callbacks.append(lambda _, i=i: order.append(i))
        done.defused = True
    net._env.run()
    assert order == list(range(1000))
    assert net.use["wire"].busy_s == 3.0


def test_a_failure_in_the_middle_of_a_tick():
    # When the first arrives, its listener takes the link away from the second, and sends a third over it.
    net = wire()
    env, failed = net._env, []
    first, second = net.transfer("a", "b", 10.0), net.transfer("a", "b", 30.0)

    def arrived(_):
        net.disturb("wire", 0.0, env.now, env.now + SECOND)
        for done in (second, net.transfer("a", "b", 5.0)):
            done.callbacks.append(lambda done: failed.append((env.now, done.ok)))
            done.defused = True

    first.callbacks.append(arrived)
    step_through(env, net)
    assert failed == [(2 * SECOND, False)] * 2


@pytest.mark.parametrize(
    ("wrong", "kind", "error"),
    [
        ({"link": "wirre"}, UsageError, r"there is no link 'wirre'; did you mean 'wire'\?"),
        ({"share": -0.1}, ScheduleError, r"share of its bandwidth must lie between 0 and 1, got -0\.1"),
        ({"share": float("nan")}, ScheduleError, "share of its bandwidth must lie between 0 and 1, got nan"),
        ({"start": 4}, ScheduleError, "a disturbance of 'wire' must begin now or later"),
        ({"end": 7}, ScheduleError, "a disturbance of 'wire' must .* end after it has begun"),
        ({"start": 7.5}, TypeError, "integer"),
    ],
)
def test_a_disturbance_that_cannot_be_is_refused(wrong, kind, error):
    net = Network(simpy.Environment(initial_time=5), *one_link(1.0))
    with pytest.raises(kind, match=error):
        net.disturb(**({"link": "wire", "share": 0.5, "start": 7, "end": 9} | wrong))
