"""Schedules of collectives: replayed block by block, counted, and built at scale."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.errors import ScheduleError
from simrender.hardware.schedules import ALGORITHMS, INSTEAD, THROTTLE, closed_form, schedule, usable

check = settings(deadline=None, derandomize=True, max_examples=50)
SIZES = range(1, 18)
COLUMNS = ("step", "source", "target", "nbytes", "reduce_bytes")


def every(*collectives):
    """Run a test with every algorithm of some collectives, and every number of ranks that can use it."""
    pairs = [(collective, algorithm) for collective in collectives for algorithm in ALGORITHMS[collective]]

    def decorate(test):
        @pytest.mark.parametrize(("collective", "algorithm"), pairs)
        def all_sizes(collective, algorithm):
            for ranks in SIZES:
                if usable(collective, algorithm, ranks):
                    test(collective, algorithm, ranks)

        return all_sizes

    return decorate


def by_step(table):
    """The messages of each step: (source, target, bytes, bytes combined)."""
    rows = zip(*(getattr(table, c).tolist() for c in COLUMNS), strict=True)
    return [[row[1:] for row in group] for _, group in itertools.groupby(rows, key=lambda row: row[0])]


def blocks_of(nbytes):
    """Which blocks a message carries, if block i has 2^i bytes."""
    assert nbytes == int(nbytes)
    return [i for i in range(int(nbytes).bit_length()) if int(nbytes) >> i & 1]


def bits(count):
    return [2.0**i for i in range(count)]


def replay(table, held):
    """Move blocks: `held` maps each rank's blocks to the ranks that contributed to them.

    All that a rank sends in a step it holds before. What is combined has no contribution in common with what was there;
    what is not replaces it and lacks nothing of it.
    """
    for step in by_step(table):
        before = [dict(blocks) for blocks in held]
        for source, target, nbytes, combined in step:
            assert combined in {0.0, nbytes}
            for block in blocks_of(nbytes):
                news = before[source][block]
                mine = held[target].get(block, frozenset())
                assert not (mine & news) if combined else mine <= news
                held[target][block] = mine | news
    return held


# Every schedule delivers the right data


@every("allgatherv")
def test_an_allgather_leaves_every_block_everywhere_and_sends_none_twice(collective, algorithm, ranks):
    table = schedule(collective, algorithm, ranks, bits(ranks))
    held = replay(table, [{r: frozenset({r})} for r in range(ranks)])
    assert held == [{r: frozenset({r}) for r in range(ranks)}] * ranks
    assert table.nbytes.sum() == (ranks - 1) * sum(bits(ranks))


@every("gatherv")
def test_a_gather_leaves_every_block_at_the_root(collective, algorithm, ranks):
    root = ranks // 2
    held = replay(
        schedule(collective, algorithm, ranks, bits(ranks), root), [{r: frozenset({r})} for r in range(ranks)]
    )
    assert held[root] == {r: frozenset({r}) for r in range(ranks)}


@every("bcast")
def test_a_broadcast_leaves_the_vector_everywhere(collective, algorithm, ranks):
    root = ranks // 2
    vector = {block: frozenset({root}) for block in range(ranks)}
    start = [dict(vector) if r == root else {} for r in range(ranks)]
    assert replay(schedule(collective, algorithm, ranks, bits(ranks), root), start) == [vector] * ranks


def blocks_for(algorithm, ranks):
    """Into how many blocks an algorithm cuts a vector."""
    return 1 << (ranks.bit_length() - 1) if algorithm == "rabenseifner" else ranks


def vectors(ranks, blocks):
    return [{block: frozenset({r}) for block in range(blocks)} for r in range(ranks)]


@every("allreduce")
def test_an_allreduce_combines_each_contribution_once_for_everybody(collective, algorithm, ranks):
    blocks = blocks_for(algorithm, ranks)
    held = replay(schedule(collective, algorithm, ranks, bits(blocks)), vectors(ranks, blocks))
    assert held == [dict.fromkeys(range(blocks), frozenset(range(ranks)))] * ranks


@every("reduce")
def test_a_reduce_combines_each_contribution_once_for_the_root(collective, algorithm, ranks):
    root = ranks // 2
    blocks = blocks_for(algorithm, ranks)
    held = replay(schedule(collective, algorithm, ranks, bits(blocks), root), vectors(ranks, blocks))
    assert held[root] == dict.fromkeys(range(blocks), frozenset(range(ranks)))


@every("reduce_scatter")
def test_a_reduce_scatter_combines_each_block_once_for_its_rank(collective, algorithm, ranks):
    table = schedule(collective, algorithm, ranks, bits(ranks))
    held = vectors(ranks, ranks)
    if algorithm == "pairwise":  # each block is sent as its owner contributed it
        for step in by_step(table):
            for source, target, nbytes, combined in step:
                assert blocks_of(nbytes) == [target]
                assert combined == nbytes
                assert source not in held[target][target]
                held[target][target] |= {source}
    else:
        held = replay(table, held)
    assert [held[r][r] for r in range(ranks)] == [frozenset(range(ranks))] * ranks


@every("alltoallv")
def test_a_direct_all_to_all_sends_each_pair_its_bytes_once(collective, algorithm, ranks):
    matrix = np.arange(1.0, ranks * ranks + 1.0).reshape(ranks, ranks)
    table = schedule(collective, algorithm, ranks, matrix)
    sent = {(s, t): n for step in by_step(table) for s, t, n, _ in step}
    assert len(table) == len(sent) == ranks * (ranks - 1)
    assert all(n == matrix[pair] for pair, n in sent.items())


@pytest.mark.parametrize("ranks", SIZES)
def test_brucks_all_to_all_brings_every_block_home(ranks):
    at = [[(r, t) for t in range(ranks)] for r in range(ranks)]  # the blocks at each rank: from, to
    for k, step in enumerate(by_step(schedule("alltoall", "bruck", ranks, 3.0))):
        moved = [[] for _ in range(ranks)]
        for source, target, nbytes, _ in step:
            assert (target - source) % ranks == 1 << k
            moved[source] = [b for b in at[source] if (b[1] - source) % ranks >> k & 1]
            assert nbytes == 3.0 * len(moved[source])
        for source, target, _, _ in step:
            at[source] = [b for b in at[source] if b not in moved[source]]
            at[target] = at[target] + moved[source]
    assert [sorted(blocks) for blocks in at] == [[(s, r) for s in range(ranks)] for r in range(ranks)]


@pytest.mark.parametrize("ranks", SIZES)
def test_after_a_barrier_each_rank_knows_of_all(ranks):
    knows = [{r} for r in range(ranks)]
    for step in by_step(schedule("barrier", "dissemination", ranks)):
        before = [set(k) for k in knows]
        for source, target, nbytes, _ in step:
            assert nbytes == 0.0
            knows[target] |= before[source]
    assert knows == [set(range(ranks))] * ranks


# What they share


@every(*ALGORITHMS)
def test_a_schedule_is_sorted_and_sends_nothing_to_itself(collective, algorithm, ranks):
    size = {
        "allgatherv": np.full(ranks, 7.0),
        "gatherv": np.full(ranks, 7.0),
        "alltoallv": np.full((ranks, ranks), 7.0),
    }
    table = schedule(collective, algorithm, ranks, size.get(collective, 7.0))
    assert table.ranks == ranks
    assert (table.source != table.target).all()
    for ends in (table.source, table.target):
        assert ((ends >= 0) & (ends < ranks)).all()
    key = table.step.astype(int) * ranks + table.source
    assert (np.diff(key) >= 0).all()
    assert [c.dtype for c in (table.step, table.source, table.target)] == [np.int32] * 3
    assert (ranks == 1) == (len(table) == 0)


@every("bcast", "reduce", "gather")
def test_another_root_is_another_name_for_the_same_ranks(collective, algorithm, ranks):
    first, other = (schedule(collective, algorithm, ranks, 5.0, root) for root in (0, ranks // 2))
    renamed = [
        sorted(((s + ranks // 2) % ranks, (t + ranks // 2) % ranks, n, c) for s, t, n, c in step)
        for step in by_step(first)
    ]
    assert renamed == [sorted(step) for step in by_step(other)]


@every("allgather", "gather")
def test_equal_contributions_may_be_given_as_one_number(collective, algorithm, ranks):
    one = schedule(collective, algorithm, ranks, 6.0)
    each = schedule(f"{collective}v", algorithm, ranks, [6.0] * ranks)
    assert by_step(one) == by_step(each)


@check
@given(st.data())
def test_an_allgather_of_any_sizes_gives_each_rank_what_the_others_have(data):
    ranks = data.draw(st.integers(1, 17))
    algorithm = data.draw(st.sampled_from([a for a in ALGORITHMS["allgatherv"] if usable("allgatherv", a, ranks)]))
    sizes = data.draw(st.lists(st.floats(0.0, 1e9), min_size=ranks, max_size=ranks))
    table = schedule("allgatherv", algorithm, ranks, sizes)
    got = np.bincount(table.target, table.nbytes, ranks)
    assert got == pytest.approx(sum(sizes) - np.array(sizes), rel=1e-9, abs=1e-6 * max(sizes))


# How many messages


@pytest.mark.parametrize("ranks", SIZES)
def test_message_counts(ranks):
    levels = math.ceil(math.log2(ranks))
    count = {
        ("barrier", "dissemination"): ranks * levels,
        ("bcast", "binomial"): ranks - 1,
        ("bcast", "scatter_ring_allgather"): (ranks - 1) * (ranks + 1),
        ("reduce", "binomial"): ranks - 1,
        ("allreduce", "ring"): 2 * ranks * (ranks - 1),
        ("allgather", "bruck"): ranks * levels,
        ("allgather", "ring"): ranks * (ranks - 1),
        ("alltoall", "bruck"): ranks * levels,
        ("alltoall", "pairwise"): ranks * (ranks - 1),
        ("gather", "binomial"): ranks - 1,
        ("gather", "linear"): ranks - 1,
        ("reduce_scatter", "pairwise"): ranks * (ranks - 1),
    }
    assert {pair: len(schedule(*pair, ranks, 8.0)) for pair in count} == count


def test_recursive_doubling_of_six_ranks_by_hand():
    # 0 and 2 hand in to 1 and 3; 1, 3, 4 and 5 exchange at distances 1 and 2 among themselves; 0 and 2 are told.
    assert by_step(schedule("allreduce", "recursive_doubling", 6, 10.0)) == [
        [(0, 1, 10.0, 10.0), (2, 3, 10.0, 10.0)],
        [(1, 3, 10.0, 10.0), (3, 1, 10.0, 10.0), (4, 5, 10.0, 10.0), (5, 4, 10.0, 10.0)],
        [(1, 4, 10.0, 10.0), (3, 5, 10.0, 10.0), (4, 1, 10.0, 10.0), (5, 3, 10.0, 10.0)],
        [(1, 0, 10.0, 0.0), (3, 2, 10.0, 0.0)],
    ]


def test_the_binomial_gather_of_five_ranks_by_hand():
    assert by_step(schedule("gather", "binomial", 5, 1.0)) == [
        [(1, 0, 1.0, 0.0), (3, 2, 1.0, 0.0)],
        [(2, 0, 2.0, 0.0)],
        [(4, 0, 1.0, 0.0)],
    ]


def test_the_neighbor_exchange_of_six_ranks_takes_three_steps():
    steps = by_step(schedule("allgather", "neighbor_exchange", 6, 1.0))
    assert [[n for *_, n, _ in step] for step in steps] == [[1.0] * 6, [2.0] * 6, [2.0] * 6]
    assert [step[0][:2] for step in steps] == [(0, 1), (0, 5), (0, 1)]


def test_the_scattered_all_to_all_has_so_many_messages_under_way():
    table = schedule("alltoall", "scattered", 70, 1.0)
    mine = table.step[table.source == 0]
    assert np.bincount(mine).tolist() == [THROTTLE - 1, THROTTLE, 70 - 2 * THROTTLE]
    assert table.target[table.source == 0][:3].tolist() == [69, 68, 67]


@pytest.mark.parametrize(("ranks", "first"), [(4, [1, 0, 3, 2]), (3, [1, 2, 0])])
def test_a_power_of_two_exchanges_pairwise_and_any_other_number_in_a_circle(ranks, first):
    table = schedule("alltoall", "pairwise", ranks)
    assert table.target[:ranks].tolist() == first


def test_only_the_pairwise_exchange_sends_messages_without_bytes():
    matrix = np.zeros((4, 4))
    matrix[1, 2] = 9.0
    counts = {a: len(schedule("alltoallv", a, 4, matrix)) for a in ALGORITHMS["alltoallv"]}
    assert counts == {"pairwise": 12, "scattered": 1, "linear": 1}
    assert len(schedule("gatherv", "linear", 4, [0.0, 0.0, 5.0, 0.0])) == 1


def test_a_million_messages():
    table = schedule("alltoall", "pairwise", 1024, 64.0)
    assert len(table) == 1024 * 1023
    assert (np.bincount(table.source) == 1023).all()
    assert (np.bincount(table.step) == 1024).all()


# Closed forms


def test_closed_forms_by_hand():
    # The table of costs in Thakur, Rabenseifner and Gropp, for 8 ranks and 800 B.
    a, b, c = 1e-6, 1e-9, 1e-10
    forms = {
        ("allreduce", "recursive_doubling"): 3 * (a + 800 * b + 800 * c),
        ("allreduce", "rabenseifner"): 6 * a + 1400 * b + 700 * c,
        ("allreduce", "ring"): 14 * a + 1400 * b + 700 * c,
        ("bcast", "binomial"): 3 * (a + 800 * b),
        ("bcast", "scatter_recursive_doubling_allgather"): 6 * a + 1400 * b,
        ("bcast", "scatter_ring_allgather"): 10 * a + 1400 * b,
        ("reduce", "binomial"): 3 * (a + 800 * b + 800 * c),
        ("reduce", "rabenseifner"): 6 * a + 1400 * b + 700 * c,
        ("reduce_scatter", "recursive_halving"): 3 * a + 700 * b + 700 * c,
        ("barrier", "dissemination"): 3 * a,
    }
    for pair, seconds in forms.items():
        assert closed_form(*pair, 8, 800.0, a, b, c) == pytest.approx(seconds, rel=1e-12)
    # Here the table's n is what all have together: 800 B are 100 B a rank.
    for pair, seconds in {
        ("allgather", "recursive_doubling"): 3 * a + 700 * b,
        ("allgather", "bruck"): 3 * a + 700 * b,
        ("allgather", "ring"): 7 * a + 700 * b,
        ("alltoall", "bruck"): 3 * a + 1200 * b,
        ("alltoall", "pairwise"): 7 * a + 700 * b,
        ("gather", "binomial"): 3 * a + 700 * b,
        ("gatherv", "linear"): 7 * a + 700 * b,
    }.items():
        assert closed_form(*pair, 8, 100.0, a, b, c) == pytest.approx(seconds, rel=1e-12)


def test_rabenseifner_beyond_a_power_of_two_costs_two_messages_more():
    cost = closed_form("allreduce", "rabenseifner", 11, 800.0, 1e-6, 1e-9, 1e-10)
    assert cost == pytest.approx(8e-6 + (1400 + 1600) * 1e-9 + (700 + 800) * 1e-10, rel=1e-12)


def test_recursive_halving_beyond_a_power_of_two_hands_in_first_and_gets_its_block():
    # 0 and 2 hand in to 1 and 3; 1, 3, 4, 5 halve six blocks, of which 1 and 3 are after two each.
    block = 100.0
    assert by_step(schedule("reduce_scatter", "recursive_halving", 6, 6 * block)) == [
        [(0, 1, 600.0, 600.0), (2, 3, 600.0, 600.0)],
        [(1, 4, 200.0, 200.0), (3, 5, 200.0, 200.0), (4, 1, 400.0, 400.0), (5, 3, 400.0, 400.0)],
        [(1, 3, 200.0, 200.0), (3, 1, 200.0, 200.0), (4, 5, 100.0, 100.0), (5, 4, 100.0, 100.0)],
        [(1, 0, 100.0, 0.0), (3, 2, 100.0, 0.0)],
    ]
    cost = closed_form("reduce_scatter", "recursive_halving", 6, 6 * block, 1e-6, 1e-9, 1e-10)
    assert cost == pytest.approx(4e-6 + (600 + 400 + 200 + 100) * 1e-9 + (600 + 400 + 200) * 1e-10, rel=1e-12)


@every(*ALGORITHMS)
def test_every_algorithm_has_a_closed_form_and_one_rank_takes_no_time(collective, algorithm, ranks):
    seconds = closed_form(collective, algorithm, ranks, 64.0, 1e-6, 1e-9)
    assert seconds == 0.0 if ranks == 1 else seconds >= 1e-6


# What is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("allreduc", "ring", 4, 1.0),
            "there is no collective 'allreduc'; did you mean 'allreduce'? (known: barrier, bcast, reduce, allreduce, "
            "allgather, allgatherv, alltoall, alltoallv, gather, gatherv, reduce_scatter)",
        ),
        (
            ("allreduce", "rings", 4, 1.0),
            "allreduce has no algorithm 'rings'; did you mean 'ring'? (known: recursive_doubling, rabenseifner, ring)",
        ),
        (
            ("allgather", "recursive_doubling", 6, 1.0),
            "allgather by recursive_doubling needs a power of two of ranks, got 6; bruck takes any",
        ),
        (
            ("allgather", "neighbor_exchange", 5, 1.0),
            "allgather by neighbor_exchange needs an even number of ranks, got 5; ring takes any",
        ),
        (("barrier", "dissemination", 0), "barrier needs at least one rank, got 0"),
        (("bcast", "binomial", 4, 1.0, 4), "bcast has no root 4: its ranks are 0 to 3"),
        (("bcast", "binomial", 4, -1.0), "the sizes of bcast must be finite and not negative, got -1.0"),
        (("alltoall", "linear", 4, math.nan), "the sizes of alltoall must be finite and not negative, got nan"),
        (
            ("alltoallv", "linear", 4, [1.0] * 4),
            "the size of alltoallv for 4 ranks is an array of shape (4, 4), got the shape (4,)",
        ),
        (("allgather", "ring", 2, [1.0, 2.0]), "the size of allgather for 2 ranks is one number, got the shape (2,)"),
        (("allreduce", "ring", 4, [1.0, 2.0]), "a vector of 4 blocks needs 4 sizes, got 2"),
    ],
)
def test_what_is_refused(arguments, message):
    with pytest.raises(ScheduleError) as error:
        schedule(*arguments)
    assert str(error.value) == message


def test_what_stands_in_takes_any_number_of_ranks():
    for (collective, _), instead in INSTEAD.items():
        assert all(usable(collective, instead, ranks) for ranks in SIZES)
