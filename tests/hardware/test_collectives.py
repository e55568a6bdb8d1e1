"""Collectives: against closed forms, against a slow oracle, and what a communicator refuses."""

import itertools

import numpy as np
import pytest
import simpy
from hypothesis import given
from hypothesis import strategies as st

from simrender.clock import TICKS_PER_SECOND
from simrender.errors import ScheduleError, UnreachableError
from simrender.hardware.collectives import Communicator, run_until
from simrender.hardware.executor import Execution
from simrender.hardware.mpi import MpiCard, Transport
from simrender.hardware.network import Link, Network
from simrender.hardware.schedules import ALGORITHMS, DIRECT, Schedule, closed_form, schedule, usable
from tests.crossbar import ALL_EAGER, BANDWIDTH, LATENCY, NONE_EAGER, REDUCE, US, check, crossbar, star


def finish(env, comm, name, *arguments, starts=None, **options):
    """Let all ranks call a collective, at once or at given ticks; return the ticks at which they are done."""
    ticks = {}

    def rank(index):
        if starts:
            yield env.timeout(starts[index])
        ticks[index] = yield getattr(comm.rank(index), name)(*arguments, **options)
        assert ticks[index] == env.now

    for index in range(comm.size):
        env.process(rank(index))
    env.run()
    assert comm.unmatched() == ""
    return [ticks[index] for index in range(comm.size)]


def arguments_of(name, size, nbytes):
    """What a rank passes if all have as much."""
    return {"barrier": (), "allgatherv": ([nbytes] * size,), "gatherv": ([nbytes] * size,)}.get(
        name, ([nbytes] * size,) if name == "alltoallv" else (nbytes,)
    )


# Without contention: closed forms

ONE_AT_A_TIME = [
    (name, algorithm) for name, algorithms in ALGORITHMS.items() for algorithm in algorithms if algorithm not in DIRECT
]
ALIKE = {"dissemination", "ring", "bruck", "pairwise", "neighbor_exchange"}


@pytest.mark.parametrize("overhead_us", [0, 1])
@pytest.mark.parametrize("machine", [crossbar, star])
@pytest.mark.parametrize(("name", "algorithm"), ONE_AT_A_TIME)
def test_on_an_idle_crossbar_or_star_a_collective_takes_its_closed_form(name, algorithm, machine, overhead_us):
    nbytes = 16000.0
    for size in (1, 2, 3, 4, 5, 7, 8, 13, 16):
        if not usable(name, algorithm, size):
            continue
        seconds = closed_form(name, algorithm, size, nbytes, (2 + overhead_us) * 1e-6, 1 / BANDWIDTH, 1 / REDUCE)
        steps = len(np.unique(schedule("barrier", "dissemination", size).step)) + 2 * size
        for eager in (ALL_EAGER, NONE_EAGER):
            env, comm = machine(size, eager=eager, overhead=f"{overhead_us} us")
            took = max(finish(env, comm, name, *arguments_of(name, size, nbytes), algorithm=algorithm))
            runs_ahead = eager == ALL_EAGER and size & (size - 1) and algorithm not in ALIKE
            if not runs_ahead:  # each message may be rounded up by a tick
                assert 0 <= took - seconds * TICKS_PER_SECOND + 1e-3 <= steps


@pytest.mark.parametrize(
    ("name", "algorithm", "size", "microseconds"),
    [
        # A rank's distance from the root is the number of bits of its number: of five ranks, two; 7 us a message, and
        # the root's second child waits longer than its first for an overhead and the 4 us of the bytes.
        ("bcast", "binomial", 5, 2 * 7 + 1 + 4),
        # 3 -> 2 -> 0, and both combine; what rank 4 sent has been there for long, and is combined last.
        ("reduce", "binomial", 5, 2 * (7 + 2) + 2),
        ("gather", "binomial", 5, 2 + 1 + 4 + 2 + 1 + 8),
    ],
)
def test_eager_trees_end_earlier_where_ranks_are_no_power_of_two(name, algorithm, size, microseconds):
    took = max(finish(*crossbar(size), name, 4000.0, algorithm=algorithm))
    assert took == microseconds * US
    assert took < closed_form(name, algorithm, size, 4000.0, 3e-6, 1 / BANDWIDTH, 1 / REDUCE) * TICKS_PER_SECOND


def contention_free(table, overhead, latency):
    """When all ranks are done if messages are eager and only a rank's own sends keep each other waiting; in seconds."""
    ready, adapter = [0.0] * table.ranks, [0.0] * table.ranks
    for step in range(int(table.step.max(initial=-1)) + 1):
        free, ends, work = list(ready), list(ready), [0.0] * table.ranks
        for m in np.flatnonzero(table.step == step).tolist():
            s, t = int(table.source[m]), int(table.target[m])
            free[s] = max(free[s], adapter[s]) + overhead
            adapter[s] = free[s] + float(table.nbytes[m]) / BANDWIDTH
            ends[s] = max(ends[s], free[s])
            ends[t] = max(ends[t], adapter[s] + latency)
            work[t] += float(table.reduce_bytes[m]) / REDUCE
        ready = [end + w for end, w in zip(ends, work, strict=True)]
    return max(ready)


@pytest.mark.parametrize("name", ALGORITHMS)
def test_eager_collectives_take_their_critical_path_on_a_crossbar_and_no_less_on_a_star(name):
    nbytes = 6000.0
    for algorithm, size in itertools.product(ALGORITHMS[name], (2, 3, 6, 8, 11, 13)):
        if not usable(name, algorithm, size):
            continue
        size_of = {"allgatherv": [nbytes] * size, "gatherv": [nbytes] * size}
        table = schedule(name.replace("alltoallv", "alltoall"), algorithm, size, size_of.get(name, nbytes))
        least = contention_free(table, 1e-6, LATENCY / TICKS_PER_SECOND) * TICKS_PER_SECOND
        call = (name, *arguments_of(name, size, nbytes))
        alone, shared = (max(finish(*machine(size), *call, algorithm=algorithm)) for machine in (crossbar, star))
        assert alone == pytest.approx(least, abs=len(table))
        assert shared >= alone - len(table)


@pytest.mark.parametrize("nbytes", [4000.0, 12000.0])
def test_the_root_of_a_tree_sends_to_its_first_child_first(nbytes):
    """Shared fairly, the root's three messages would all take three times as long."""
    message = 3 + nbytes / 1000.0
    assert max(finish(*star(8), "bcast", nbytes, algorithm="binomial")) == 3 * message * US


@pytest.mark.parametrize("size", [2, 5, 8])
@pytest.mark.parametrize(("eager", "bytes_apart"), [(ALL_EAGER, True), (NONE_EAGER, False)])
def test_messages_of_a_linear_all_to_all_leave_an_overhead_apart(size, eager, bytes_apart):
    ticks = finish(*crossbar(size, eager=eager), "alltoall", 4000.0, algorithm="linear")
    bytes_us = 4 * (size - 1) if bytes_apart else 4
    assert ticks == [(size - 1) * US + LATENCY + bytes_us * US] * size


def test_the_scattered_all_to_all_waits_for_its_first_messages_before_it_sends_more():
    ticks = finish(*crossbar(40, overhead="0 us", eager=NONE_EAGER), "alltoall", 4000.0, algorithm="scattered")
    assert ticks == [2 * (LATENCY + 4 * US)] * 40


def test_a_gather_of_all_at_once_shares_the_way_into_the_root():
    env = simpy.Environment()
    network = Network(env, {"in": Link(1e9, 2e-6)}, lambda *_: ["in"])
    mpi = MpiCard(flavour="mpich", overhead="1 us", eager=ALL_EAGER)
    ticks = finish(env, Communicator(env, Transport(network, mpi, range(5))), "gatherv", [4000.0] * 5)
    assert ticks == [1 * US + LATENCY + 16 * US] + [US] * 4


# Who waits for whom


def test_nobody_leaves_a_barrier_before_the_last_has_come():
    starts = [0, 50 * US, 7 * US, 0, 3 * US]
    ticks = finish(*crossbar(5), "barrier", starts=starts)
    assert min(ticks) >= 50 * US
    assert max(ticks) == 50 * US + 3 * 3 * US  # from the last, in three steps, to the farthest


def test_an_eager_sender_need_not_wait_for_its_receiver_and_a_rendezvous_does():
    for eager, done in ((ALL_EAGER, [1 * US, 100 * US]), (NONE_EAGER, [107 * US, 107 * US])):
        assert finish(*crossbar(2, eager=eager), "bcast", 4000.0, starts=[0, 100 * US]) == done


def test_to_receivers_that_come_late_together_messages_leave_an_overhead_apart():
    ticks = finish(*crossbar(4, eager=NONE_EAGER), "alltoall", 4000.0, algorithm="linear", starts=[0, *[50 * US] * 3])
    assert ticks == [50 * US + 3 * US + LATENCY + 4 * US] * 4


def test_a_message_of_the_eager_size_is_eager():
    assert finish(*crossbar(2, eager="4000 B"), "bcast", 4000.0, starts=[0, 100 * US])[0] == US
    assert finish(*crossbar(2, eager="3999 B"), "bcast", 4000.0, starts=[0, 100 * US])[0] == 107 * US


def test_combining_keeps_a_rank_but_not_the_network():
    # Two ranks exchange 4 us of data after 3 us, and combine it for 2 us.
    assert finish(*crossbar(2), "allreduce", 4000.0, algorithm="recursive_doubling") == [9 * US] * 2


def test_one_rank_is_done_at_once():
    for name in ALGORITHMS:
        assert finish(*crossbar(1), name, *arguments_of(name, 1, 1e6)) == [0]


def test_without_an_algorithm_the_flavour_decides():
    def ticks(nbytes, **options):
        return finish(*crossbar(8, flavour="mvapich2"), "allreduce", nbytes, **options)

    assert ticks(2048.0) == ticks(2048.0, algorithm="recursive_doubling") != ticks(2048.0, algorithm="rabenseifner")
    assert ticks(2049.0) == ticks(2049.0, algorithm="rabenseifner") != ticks(2049.0, algorithm="recursive_doubling")


@check
@given(st.data())
def test_later_starts_and_more_bytes_never_end_a_collective_earlier_on_a_crossbar(data):
    name = data.draw(st.sampled_from(["barrier", "bcast", "reduce", "allreduce", "allgather", "alltoall", "gather"]))
    size = data.draw(st.integers(1, 9))
    algorithm = data.draw(st.sampled_from([a for a in ALGORITHMS[name] if usable(name, a, size)]))
    delays = data.draw(st.lists(st.integers(0, 50), min_size=size, max_size=size))
    runs = [
        finish(
            *crossbar(size, eager=NONE_EAGER), name, *arguments_of(name, size, n), algorithm=algorithm, starts=starts
        )
        for n, starts in ((1e4, [0] * size), (2e4, [delay * US for delay in delays]))
    ]
    assert all(early <= late for early, late in zip(*runs, strict=True))


# Against an oracle: a process a rank, an event a message


class Oracle:
    """A schedule executed naively."""

    def __init__(self, env, network, table, work, overhead, eager, gaps):
        self.env, self.network, self.table, self.overhead, self.eager = env, network, table, overhead, eager
        self.work, self.gaps = work, gaps
        count = len(table)
        self.arrived = [env.event() for _ in range(count)]
        self.offered, self.awaited = [None] * count, [None] * count

    def meet(self, m):
        if self.offered[m] is not None and self.awaited[m] is not None:
            self.leave(m, max(self.offered[m], self.awaited[m]) + self.overhead)

    def leave(self, m, start):
        t = self.table
        done = self.network.transfer(int(t.source[m]), int(t.target[m]), float(t.nbytes[m]), start=start)
        done.callbacks.append(lambda _: self.arrived[m].succeed())

    def rank(self, r):
        t, adapter = self.table, 0
        for step in range(int(t.step.max(initial=0)) + 1):
            sends = np.flatnonzero((t.step == step) & (t.source == r)).tolist()
            receives = np.flatnonzero((t.step == step) & (t.target == r)).tolist()
            now, free, waits = self.env.now, self.env.now, []
            for m in sends:
                if t.nbytes[m] <= self.eager:
                    free = max(free, adapter) + self.overhead
                    adapter = free + self.gaps[m]
                    self.leave(m, free)
                    waits.append(self.env.timeout(free - now))
                else:
                    self.offered[m] = free
                    self.meet(m)
                    waits.append(self.arrived[m])
                    free += self.overhead
            for m in receives:
                self.awaited[m] = now
                if t.nbytes[m] > self.eager:
                    self.meet(m)
                waits.append(self.arrived[m])
            yield self.env.all_of(waits)
            yield self.env.timeout(int(self.work[receives].sum()))


@st.composite
def traffic(draw):
    """Return a schedule of messages at random, what combining costs, and when the ranks begin."""
    size = draw(st.integers(2, 6))
    message = st.tuples(st.integers(0, 3), st.integers(0, size - 1), st.integers(1, size - 1), st.integers(0, 9))
    rows = sorted(draw(st.lists(message, min_size=1, max_size=30)), key=lambda row: row[:2])
    step, source, distance, kilobytes = np.array(rows).T
    nbytes = 1000.0 * kilobytes
    table = Schedule(size, step.astype(np.int32), source.astype(np.int32), (source + distance) % size, nbytes, nbytes)
    work = np.array(draw(st.lists(st.sampled_from([0, 0, 500_000]), min_size=len(rows), max_size=len(rows))))
    return table, work, draw(st.lists(st.integers(0, 30), min_size=size, max_size=size))


def network_of(env, size, shared):
    """Each pair with its own link, or each rank with one way in and one way out."""
    names = [(i, j) for i in range(size) for j in range(size)] + [f"out{i}" for i in range(size)]
    links = {name: Link(1e9, 1e-6) for name in [*names, *(f"in{i}" for i in range(size))]}
    return Network(env, links, lambda s, t: [f"out{s}", f"in{t}"] if shared else [(s, t)])


@check
@given(traffic(), st.sampled_from([0, 300_000]), st.sampled_from([-1.0, 4000.0, 1e9]), st.booleans())
def test_any_schedule_takes_as_long_as_if_each_rank_were_a_process(case, overhead, eager, shared):
    table, work, starts = case
    # Where a rank's sends compete for overheads, who is first depends on what is known first: see the next test.
    competing = np.bincount(table.step * table.ranks + table.source).max() > 1 and table.nbytes.max() > eager
    overhead = 0 if competing else overhead
    gaps = (table.nbytes * 1000).astype(np.int64)
    done = []
    env = simpy.Environment()
    oracle = Oracle(env, network_of(env, table.ranks, shared), table, work, overhead, eager, gaps)

    def process(r):
        yield env.timeout(starts[r] * US)
        yield from oracle.rank(r)
        done.append((r, env.now))

    for r in range(table.ranks):
        env.process(process(r))
    env.run()

    fast = simpy.Environment()
    finished, _ = execute(fast, network_of(fast, table.ranks, shared), case, overhead, eager, gaps)
    assert finished == dict(done)


def execute(env, network, case, overhead, eager, gaps):
    """Run a schedule; return when each rank is done, and when each message leaves."""
    table, work, starts = case
    finished, left = {}, {}

    def post(sources, targets, nbytes, starts, keys):
        left.update(zip(keys.tolist(), starts.tolist(), strict=True))
        network.post(sources.tolist(), targets.tolist(), nbytes, starts, execution.arrive, keys)

    execution = Execution(table, work, overhead, eager, post, finished.__setitem__, gaps=gaps)
    for r, start in enumerate(starts):
        env.timeout(start * US).callbacks.append(lambda _, r=r: execution.begin(r, env.now))
    env.run()
    return finished, left


@check
@given(traffic(), st.sampled_from([-1.0, 4000.0, 1e9]), st.booleans())
def test_a_ranks_messages_of_a_step_leave_an_overhead_apart_and_eager_ones_their_bytes(case, eager, shared):
    table, overhead = case[0], 300_000
    gaps = (table.nbytes * 1000).astype(np.int64)
    env = simpy.Environment()
    _, left = execute(env, network_of(env, table.ranks, shared), case, overhead, eager, gaps)
    for one, other in itertools.combinations(sorted(left), 2):  # in the order of steps
        if table.source[one] == table.source[other]:
            if table.step[one] == table.step[other]:
                assert abs(left[one] - left[other]) >= overhead
            if max(table.nbytes[[one, other]]) <= eager:
                assert left[other] >= left[one] + gaps[one] + overhead


# alltoallv: each rank brings its own sizes


def call_alltoallv(env, comm, rows, starts=None, **options):
    ticks = {}

    def rank(index):
        yield env.timeout(starts[index] if starts else 0)
        ticks[index] = yield comm.rank(index).alltoallv(rows[index], **options)

    for index in range(comm.size):
        env.process(rank(index))
    env.run()
    return [ticks.get(index) for index in range(comm.size)]


@pytest.mark.parametrize("algorithm", ALGORITHMS["alltoallv"])
@pytest.mark.parametrize("eager", [ALL_EAGER, NONE_EAGER])
def test_an_alltoallv_of_equal_rows_is_an_alltoall(algorithm, eager):
    for size in (1, 2, 5, 8):
        each = call_alltoallv(*crossbar(size, eager=eager), [[4000.0] * size] * size, algorithm=algorithm)
        assert each == finish(*crossbar(size, eager=eager), "alltoall", 4000.0, algorithm=algorithm)


@check
@given(st.integers(1, 6), st.sampled_from(ALGORITHMS["alltoallv"]), st.booleans(), st.data())
def test_an_alltoallv_moves_what_the_rows_say(size, algorithm, eager, data):
    row = st.lists(st.sampled_from([0.0, 0.0, 10.0, 4000.0, 1e6]), min_size=size, max_size=size)
    rows = data.draw(st.lists(row, min_size=size, max_size=size))
    starts = data.draw(st.lists(st.integers(0, 99), min_size=size, max_size=size))
    env, comm = crossbar(size, eager=ALL_EAGER if eager else NONE_EAGER)
    ticks = call_alltoallv(env, comm, rows, [start * US for start in starts], algorithm=algorithm)
    assert None not in ticks
    carried = comm.transport.network.carried_bytes
    assert {pair: n for pair, n in carried.items() if n} == {
        (i, j): rows[i][j] for i, j in itertools.permutations(range(size), 2) if rows[i][j]
    }
    assert all(tick >= start * US for tick, start in zip(ticks, starts, strict=True))


def test_what_a_rank_has_for_itself_needs_no_route():
    env = simpy.Environment()
    network = Network(env, {"link": Link(1e9, 2e-6)}, {(0, 1): ["link"], (1, 0): ["link"]})
    mpi = MpiCard(flavour="mpich", overhead="1 us", eager=ALL_EAGER)
    comm = Communicator(env, Transport(network, mpi, range(2)))
    ticks = call_alltoallv(env, comm, [[9.0, 4000.0], [0.0, 9.0]], algorithm="linear")
    assert ticks == [US, 7 * US]


def test_where_nothing_is_sent_a_receiver_knows_when_the_sender_calls():
    rows = [[0.0, 0.0, 0.0], [0.0, 0.0, 4000.0], [0.0, 0.0, 0.0]]
    ticks = call_alltoallv(*crossbar(3), rows, [0, 10 * US, 0], algorithm="linear")
    assert ticks == [10 * US, 11 * US, 17 * US]
    ticks = call_alltoallv(*crossbar(3), rows, [0, 10 * US, 0], algorithm="pairwise")  # sends empty messages
    # 1 -> 2 takes from 10 to 17 us; then 2 -> 1 leaves at 18. Meanwhile 1 -> 0 left after the bytes of 1 -> 2, at 16.
    assert ticks == [18 * US, 20 * US, 18 * US]


# The ranks of a communicator call the same collectives


def test_collectives_that_do_not_match():
    _, comm = crossbar(4)
    comm.rank(0).barrier()
    with pytest.raises(ScheduleError) as error:
        comm.rank(3).allreduce(4096)
    assert str(error.value) == (
        "rank 3 called allreduce(4096) where rank 0 called barrier(): the ranks of a communicator call the same "
        "collectives in the same order, with the same arguments"
    )


@pytest.mark.parametrize(
    ("mine", "theirs", "words"),
    [
        (("bcast", 8), ("bcast", 8, 1), "rank 1 called bcast(8, root=1) where rank 0 called bcast(8)"),
        (("allgather", 8), ("allgather", 8.5), "allgather(8.5) where rank 0 called allgather(8)"),
        (("gatherv", [1, 2]), ("gatherv", [2, 1]), "gatherv([2, 1]) where rank 0 called gatherv([1, 2])"),
        (("alltoallv", [1, 2]), ("alltoall", 1), "alltoall(1) where rank 0 called alltoallv([...])"),
    ],
)
def test_arguments_that_do_not_match(mine, theirs, words):
    _, comm = crossbar(2)
    for index, (name, *arguments) in enumerate((mine, theirs)):
        call = getattr(comm.rank(index), name)
        if index:
            with pytest.raises(ScheduleError) as error:
                call(*arguments)
            assert words in str(error.value)
        else:
            call(*arguments)


def test_algorithms_that_do_not_match():
    _, comm = crossbar(2)
    comm.rank(0).allreduce(8, algorithm="ring")
    with pytest.raises(ScheduleError, match=r"allreduce\(8\) where rank 0 called allreduce\(8, algorithm='ring'\)"):
        comm.rank(1).allreduce(8)


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("allgatherv", ([1.0],), "allgatherv takes 3 sizes, one a rank, got an array of shape (1,)"),
        ("allreduce", ([1.0, 2.0, 3.0],), "allreduce takes one size, got an array of shape (3,)"),
        ("bcast", (-1.0,), "the sizes of bcast must be finite and not negative, got -1.0"),
        ("bcast", (1.0, 3), "there is no rank 3: the communicator has 0 to 2"),
        ("isend", (3, 1.0), "there is no rank 3: the communicator has 0 to 2"),
        ("isend", (0, float("inf")), "a message's size must be finite and not negative, got inf B"),
        ("irecv", (-1,), "there is no rank -1: the communicator has 0 to 2"),
    ],
)
def test_what_a_rank_refuses(name, arguments, message):
    _, comm = crossbar(3)
    with pytest.raises(ScheduleError) as error:
        getattr(comm.rank(1), name)(*arguments)
    assert str(error.value) == message
    assert comm.unmatched() == ""


def test_a_collective_over_ranks_that_cannot_reach_each_other():
    env = simpy.Environment()
    mpi = MpiCard(flavour="mpich", overhead="0 s", eager="0 B")
    comm = Communicator(env, Transport(Network(env, {}, {}), mpi, ["a", "b"]))
    with pytest.raises(UnreachableError):
        comm.rank(0).barrier()


def test_a_rank_may_run_ahead_of_the_others_into_the_next_collective():
    env, comm = crossbar(2)
    done = [comm.rank(0).bcast(4000.0, root=0), comm.rank(0).bcast(4000.0, root=0)]
    late = []

    def other():
        yield env.timeout(20 * US)
        late.extend([(yield comm.rank(1).bcast(4000.0)), (yield comm.rank(1).bcast(4000.0))])

    env.process(other())
    env.run()
    assert [event.value for event in done] == [US, 6 * US]  # after the bytes of the first
    assert late == [20 * US, 20 * US]


def test_a_standstill_says_who_is_missing():
    env, comm = crossbar(4)
    comm.rank(0).barrier()
    comm.rank(2).barrier()
    env.run()
    assert comm.unmatched() == "barrier() was never called by rank 1, 3"


def test_waiting_for_what_never_happens_says_who_is_missing():
    env, comm = crossbar(4)
    other = Communicator(env, comm.transport, [0, 1])
    done = [comm.rank(r).barrier() for r in (0, 2)]
    other.rank(1).irecv(0)
    env.timeout(5 * US)
    with pytest.raises(ScheduleError) as error:
        run_until(env.all_of(done), comm, other)
    assert str(error.value) == (
        "the ranks came to a standstill at 5e-06 s: barrier() was never called by rank 1, 3\n"
        "a receive of rank 1 from rank 0, any tag never got a message"
    )
    with pytest.raises(ScheduleError, match=r"standstill at 5e-06 s: nobody acts$"):
        run_until(env.event())


def test_waiting_ends_with_the_event():
    env, comm = crossbar(2)
    env.timeout(100 * US)
    comm.rank(1).bcast(4000.0)
    assert run_until(comm.rank(0).bcast(4000.0), comm) == US == env.now
    assert run_until(env.timeout(0, "at once")) == "at once"


# Splitting


def test_a_split_numbers_ranks_by_key_and_then_as_they_were():
    _, comm = crossbar(6)
    parts = comm.split(["b", "a", None, "b", "b", "a"], [9, 1, 0, 5, 9, 0])
    assert list(parts) == ["b", "a"]
    assert [part.ranks for part in parts.values()] == [(3, 0, 4), (5, 1)]
    again = parts["b"].split([0, None, 0])
    assert again[0].ranks == (3, 4)


def test_islands_do_not_wait_for_each_other():
    env, comm = crossbar(4)
    islands = comm.split([0, 0, 1, 1])
    late = []

    def rank(color, index, start):
        yield env.timeout(start)
        late.append((yield islands[color].rank(index).barrier()))

    for color, index, start in ((0, 0, 0), (0, 1, 0), (1, 0, 0), (1, 1, 40 * US)):
        env.process(rank(color, index, start))
    env.run()
    assert late == [3 * US, 3 * US, 41 * US, 43 * US]


def test_what_a_split_refuses():
    _, comm = crossbar(3)
    with pytest.raises(ScheduleError, match="split needs a color for each of 3 ranks, got 2"):
        comm.split([0, 1])
    with pytest.raises(ScheduleError, match="split needs a key for each of 3 ranks, got 1"):
        comm.split([0, 1, 0], [0])


@pytest.mark.parametrize(
    ("ranks", "message"),
    [
        ([], "a communicator needs at least one rank, and each once, got []"),
        ([1, 1], "a communicator needs at least one rank, and each once, got [1, 1]"),
        ([0, 3], "there is no rank 3 to communicate: there are 0 to 2"),
    ],
)
def test_ranks_that_make_no_communicator(ranks, message):
    env, comm = crossbar(3)
    with pytest.raises(ScheduleError) as error:
        Communicator(env, comm.transport, ranks)
    assert str(error.value) == message


# At scale, and again


def test_a_collective_costs_few_events():
    env, comm = crossbar(32)
    events = itertools.count()
    step = env.step

    def counted():
        next(events)
        step()

    env.step = counted
    done = [comm.rank(r).alltoall(64.0, algorithm="pairwise") for r in range(32)]
    env.run()
    assert all(event.processed for event in done)
    assert next(events) < 32 * 31  # fewer than messages, though each is simulated


def test_the_same_again_to_the_tick():
    def run():
        env, comm = crossbar(13, eager="3 kB")
        starts = [(r * 7919) % 31 * US for r in range(13)]
        return finish(env, comm, "allreduce", 9999.0, starts=starts), finish(env, comm, "allgather", 100.0)

    assert run() == run()


def test_renaming_the_ranks_of_a_network_of_equals_changes_nothing():
    env, comm = crossbar(6)
    shuffled = Communicator(env, comm.transport, [4, 0, 5, 2, 1, 3])
    assert finish(env, shuffled, "allgather", 1e5) == finish(*crossbar(6), "allgather", 1e5)
