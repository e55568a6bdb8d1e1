"""Messages between ranks, against MPI's rules of matching."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simrender.errors import ScheduleError
from simrender.hardware.collectives import Communicator, Message
from tests.crossbar import ALL_EAGER, LATENCY, NONE_EAGER, US, check, crossbar


def test_an_eager_message_and_a_rendezvous():
    env, comm = crossbar(2, eager="4000 B")
    sends = [comm.rank(0).isend(1, 4000.0, tag=3), comm.rank(0).isend(1, 8000.0)]
    got = []

    def receiver():
        yield env.timeout(50 * US)
        one, other = comm.rank(1).irecv(0, 3), comm.rank(1).irecv(0, 0)
        got.extend([(yield one), (yield other)])

    env.process(receiver())
    env.run()
    # The eager one has been there for long; the other leaves an overhead after its receiver is ready.
    assert got == [Message(0, 3, 4000.0, 50 * US), Message(0, 0, 8000.0, 50 * US + US + LATENCY + 8 * US)]
    assert [send.value for send in sends] == [US, 61 * US]
    assert comm.unmatched() == ""


def test_eager_messages_of_one_rank_leave_an_overhead_and_their_bytes_apart():
    env, comm = crossbar(4)
    sends = [comm.rank(0).isend(target, 4000.0) for target in (1, 2, 3)]
    receives = [comm.rank(target).irecv() for target in (1, 2, 3)]
    env.run()
    assert [send.value for send in sends] == [US, 6 * US, 11 * US]
    assert [receive.value.tick for receive in receives] == [7 * US, 12 * US, 17 * US]


def test_an_eager_train_takes_what_its_messages_take_one_after_the_other():
    env, comm = crossbar(4)
    sends = [comm.rank(0).isend(1, 3 * 4000.0, messages=3), comm.rank(0).isend(2, 4000.0)]
    receives = [comm.rank(1).irecv(), comm.rank(2).irecv()]
    env.run()
    assert [send.value for send in sends] == [11 * US, 16 * US]
    assert receives[0].value == Message(0, 0, 12000.0, 17 * US, 3)
    assert receives[1].value.tick == 22 * US


def test_a_rendezvous_train_shares_links_as_its_messages_would():
    def arrivals(train):
        env, comm = crossbar(3, eager=NONE_EAGER, overhead="0 us", ranges=HALF)
        parts = [3] if train else [1, 1, 1]
        sends = [comm.rank(0).isend(2, part * 4000.0, messages=part) for part in parts]
        sends.append(comm.rank(0).isend(2, 4000.0))
        receives = [comm.rank(2).irecv() for _ in sends]
        env.run()
        return sorted({send.value for send in sends}), sum(receive.value.messages for receive in receives)

    # Each gets a quarter of the link, and none the half that is the most for any.
    assert arrivals(train=True) == arrivals(train=False) == ([LATENCY + 16 * US], 4)


def test_a_train_may_be_longer_than_a_weight_is_great():
    for nbytes in (0.0, 2000 * 4000.0):
        env, comm = crossbar(2, eager=NONE_EAGER)
        comm.rank(0).isend(1, nbytes, messages=2000)
        receive = comm.rank(1).irecv()
        env.run()
        assert receive.value == Message(0, 0, nbytes, US + LATENCY + round(nbytes / 1e9 * 1e6) * US, 2000)


HALF = [{"above": "1 B", "bandwidth": 0.5, "latency": 1}]


def test_messages_to_a_rank_that_are_treated_alike_are_one_train():
    env, comm = crossbar(3, eager="4000 B", ranges=LARGE_LATER)
    targets = np.array([1, 2, 1, 1, 1, 2])
    sends = comm.rank(0).isend_trains(targets, np.array([500.0, 900.0, 3000.0, 700.0, 9000.0, 300.0]))
    receives = [comm.rank(target).irecv() for target in (1, 1, 1, 2)]
    env.run()
    got = {(receive.value.nbytes, receive.value.messages) for receive in receives}
    assert got == {(1200.0, 2), (3000.0, 1), (9000.0, 1), (1200.0, 2)}
    assert len(sends) == 4
    assert sends == sorted(sends, key=lambda event: event.value)
    assert comm.rank(0).isend_trains(np.zeros(0, np.int64), np.zeros(0)) == []


def test_a_train_that_nobody_receives_is_named():
    env, comm = crossbar(2)
    comm.rank(0).isend(1, 300.0, 7, messages=3)
    env.run()
    assert comm.unmatched() == "3 messages of together 300 B, tag 7, from rank 0 to rank 1 were never received"
    with pytest.raises(ScheduleError, match="at least 1 message is sent, got 0"):
        comm.rank(0).isend(1, 1.0, messages=0)


def test_a_message_waits_for_the_adapter_until_a_collective_is_through():
    env, comm = crossbar(3)
    comm.rank(0).bcast(4000.0, algorithm="binomial")
    comm.rank(0).isend(1, 4000.0)
    receive = Communicator(env, comm.transport, [1, 0]).rank(1).isend(0, 0.0)
    env.run()
    # The root sends to rank 2 at 1 us, to rank 1 at 6 us, then this; then on behalf of another communicator.
    assert receive.value == 16 * US


def test_to_receivers_that_come_late_messages_leave_an_overhead_apart():
    env, comm = crossbar(4, eager=NONE_EAGER)
    for target in (1, 2, 3):
        comm.rank(0).isend(target, 4000.0)
    env.run(until=50 * US)
    receives = [comm.rank(target).irecv() for target in (3, 1, 2)]
    env.run()
    assert [receive.value.tick for receive in receives] == [57 * US, 58 * US, 59 * US]


def test_a_message_may_leave_before_one_that_was_sent_earlier_and_has_an_overhead_to_wait():
    env, comm = crossbar(5, eager=NONE_EAGER, overhead="10 us")
    for target in (1, 2, 3, 4):
        comm.rank(0).isend(target, 4000.0)
    last = comm.rank(4).irecv()  # could be offered at 30 us, and leaves at 40 us
    env.run(until=20 * US)
    receives = [comm.rank(target).irecv() for target in (1, 2)]
    env.run()
    assert [receive.value.tick for receive in (last, *receives)] == [46 * US, 36 * US, 56 * US]


def test_a_message_to_oneself():
    env, comm = crossbar(2, eager="10 B")
    me = comm.rank(1)
    events = [me.isend(1, 10.0), me.isend(1, 11.0), me.irecv(), me.irecv()]
    env.run()
    assert [event.value for event in events[2:]] == [Message(1, 0, 10.0, US), Message(1, 0, 11.0, 2 * US)]


LARGE_LATER = [{"above": "1 kB", "bandwidth": 1, "latency": 100}]
"""Messages from 1 kB on have a latency of 200 us, so that smaller ones behind them arrive before them."""


def test_a_small_message_does_not_overtake_a_large_one_of_the_same_sender():
    for tag in (None, 5):
        env, comm = crossbar(2, ranges=LARGE_LATER)
        receives = [comm.rank(1).irecv(0, tag) for _ in range(2)]
        comm.rank(0).isend(1, 1000.0, tag=5)
        comm.rank(0).isend(1, 1.0, tag=5)
        env.run()
        assert [receive.value.nbytes for receive in receives] == [1000.0, 1.0]
        assert receives[0].value.tick == receives[1].value.tick == 202 * US


def test_a_rendezvous_waits_for_an_eager_message_before_it():
    env, comm = crossbar(2, eager="4000 B")
    receives = [comm.rank(1).irecv(), comm.rank(1).irecv()]
    comm.rank(0).isend(1, 4000.0)
    comm.rank(0).isend(1, 8000.0)
    env.run()
    assert [receive.value.tick for receive in receives] == [7 * US, 7 * US + US + LATENCY + 8 * US]


def test_one_with_another_tag_may_be_received_first():
    env, comm = crossbar(2, ranges=LARGE_LATER)
    large, small = comm.rank(1).irecv(0, tag=1), comm.rank(1).irecv(0, tag=2)
    comm.rank(0).isend(1, 1000.0, tag=1)
    comm.rank(0).isend(1, 1.0, tag=2)
    env.run()
    assert large.value.tick > 200 * US > small.value.tick


def test_a_receive_from_anybody_takes_what_comes_first():
    env, comm = crossbar(3)
    receives = [comm.rank(2).irecv() for _ in range(2)]
    comm.rank(0).isend(2, 1e6)
    comm.rank(1).isend(2, 4000.0)
    env.run()
    assert [receive.value.source for receive in receives] == [1, 0]


def test_a_receive_from_anybody_that_comes_late_takes_what_was_there_first():
    env, comm = crossbar(3)
    comm.rank(0).isend(2, 9000.0)
    comm.rank(1).isend(2, 4000.0)
    env.run()
    receives = [comm.rank(2).irecv() for _ in range(2)]
    env.run()
    assert [receive.value.source for receive in receives] == [1, 0]


def test_receives_are_served_in_the_order_of_posting():
    env, comm = crossbar(2)
    anything, sevens = comm.rank(1).irecv(), comm.rank(1).irecv(tag=7)
    comm.rank(0).isend(1, 1.0, tag=7)
    env.run()
    assert anything.processed
    assert not sevens.triggered
    assert comm.unmatched() == "a receive of rank 1 from any rank, tag 7 never got a message"


def test_what_was_never_received():
    env, comm = crossbar(3)
    comm.rank(0).isend(1, 4000.0, tag=2)
    comm.rank(2).irecv(1)
    env.run()
    assert comm.unmatched() == (
        "a message of 4000 B, tag 2, from rank 0 to rank 1 was never received\n"
        "a receive of rank 2 from rank 1, any tag never got a message"
    )


def test_communicators_do_not_see_each_others_messages():
    env, comm = crossbar(2)
    twin = Communicator(env, comm.transport)
    comm.rank(0).isend(1, 1.0)
    receive = twin.rank(1).irecv()
    env.run()
    assert not receive.triggered


@st.composite
def conversations(draw):
    """Sends of (source, target, bytes, tag, start), and for each a receive of (target, source, tag, start)."""
    size = draw(st.integers(1, 4))
    rank, start = st.integers(0, size - 1), st.integers(0, 40)
    sends = draw(
        st.lists(
            st.tuples(rank, rank, st.sampled_from([0.0, 1.0, 4000.0, 50000.0]), st.integers(0, 1), start), max_size=14
        )
    )
    order = draw(st.permutations(range(len(sends))))
    receives = [(sends[i][1], sends[i][0], sends[i][3], draw(start)) for i in order]
    return size, sends, receives, draw(st.sampled_from([ALL_EAGER, NONE_EAGER, "4000 B"]))


def converse(case, wildcards):
    size, sends, receives, eager = case
    env, comm = crossbar(size, eager=eager)
    order, got = [], []

    def sender(number, source, target, nbytes, tag, start):
        yield env.timeout(start * US)
        order.append(number)
        yield comm.rank(source).isend(target, nbytes, tag)

    def receiver(target, source, tag, start):
        yield env.timeout(start * US)
        posted = (env.now, len(got))
        got.append(None)
        message = yield comm.rank(target).irecv(None if wildcards else source, None if wildcards else tag)
        assert message.tick == env.now >= posted[0]
        got[posted[1]] = (target, message)

    for number, send in enumerate(sends):
        env.process(sender(number, *send))
    for receive in receives:
        env.process(receiver(*receive))
    env.run()
    return comm, [sends[number] for number in order], got


@check
@given(conversations())
def test_receives_that_name_their_sender_and_tag_get_its_messages_in_order(case):
    comm, sent, got = converse(case, wildcards=False)
    assert comm.unmatched() == ""
    for target, source, tag in itertools.product(range(4), range(4), range(2)):
        sizes = [n for s, t, n, g, _ in sent if (s, t, g) == (source, target, tag)]
        assert sizes == [m.nbytes for t, m in got if (t, m.source, m.tag) == (target, source, tag)]


@check
@given(conversations())
def test_receives_of_anything_get_every_message_once_and_none_of_a_sender_overtakes(case):
    comm, sent, got = converse(case, wildcards=True)
    assert comm.unmatched() == ""
    for target, source in itertools.product(range(4), range(4)):
        messages = [(n, g) for s, t, n, g, _ in sent if (s, t) == (source, target)]
        assert messages == [(m.nbytes, m.tag) for t, m in got if (t, m.source) == (target, source)]
