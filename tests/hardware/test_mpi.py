"""MPI: its card, what a message costs, and which algorithm a library takes."""

import math

import numpy as np
import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.cards import Document
from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.errors import CardError, ScheduleError
from simrender.hardware.mpi import MpiCard, Transport, choose
from simrender.hardware.network import Link, Network
from simrender.hardware.schedules import ALGORITHMS, usable

KIB, MIB = 1024, 1024**2
MICROSECOND = TICKS_PER_SECOND // 10**6
check = settings(deadline=None, derandomize=True, max_examples=50)

CARD = """\
flavour: mpich
overhead: 1 us
eager: 8 KiB
ranges:
  - {above: 100 B, bandwidth: 50%, latency: 1.5}
  - {above: 1000 B, bandwidth: 1.0874, latency: 13.01}
"""


def card(text=CARD):
    return Document(text, "card.yaml").validate(MpiCard)


def transport(mpi=None, **options):
    """Three ranks, each a link of 1 GB/s and 2 us away from each other."""
    env = simpy.Environment()
    links = {(i, j): Link(1e9, 2e-6) for i in range(3) for j in range(3) if i != j}
    network = Network(env, links, {pair: [pair] for pair in links})
    return env, Transport(network, mpi or card(), range(3), **options)


def send(env, layer, messages):
    """Post (source, target, bytes, start) messages; return the tick of each one's arrival."""
    sources, targets, nbytes, starts = (np.array(column) for column in zip(*messages, strict=True))
    arrivals = {}
    keys = np.arange(len(messages))
    layer.post(sources, targets, nbytes.astype(float), starts, lambda k, t: arrivals.update(dict.fromkeys(k, t)), keys)
    env.run()
    return [arrivals[key] for key in keys.tolist()]


# The card


def test_a_card():
    mpi = card()
    assert (mpi.flavour, float(mpi.overhead), float(mpi.eager)) == ("mpich", 1e-6, 8192.0)
    assert [(float(r.above), float(r.bandwidth), float(r.latency)) for r in mpi.ranges] == [
        (100.0, 0.5, 1.5),
        (1000.0, 1.0874, 13.01),
    ]
    assert [path for path, _ in mpi.quantities("mpi.")][:3] == ["mpi.overhead", "mpi.eager", "mpi.ranges.0.above"]
    assert card("{flavour: openmpi, overhead: 0 s, eager: 0 B}").ranges == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("latency: 1.5", "latency: 0.5"), "card.yaml:5:45: ranges.0.latency: must be at least 1, got '0.5': "),
        (("50%", "2.5"), "card.yaml:5:31: ranges.0.bandwidth: must be at most 2, got '2.5'"),
        (("50%", "0"), "card.yaml:5:31: ranges.0.bandwidth: must be more than 0, got 0"),
        (("100 B", "2000 B"), "ranges must be given in ascending order of above, got 1000 B after 2000 B"),
        (("mpich", "lam"), "flavour"),
    ],
)
def test_mistakes_on_a_card(change, message):
    with pytest.raises(CardError) as error:
        card(CARD.replace(*change))
    assert message in str(error.value)


# A message


def test_without_ranges_a_message_pays_the_latency_and_the_bandwidth_of_its_route():
    env, layer = transport(card("{flavour: mpich, overhead: 1 us, eager: 8 KiB}"))
    ticks = send(env, layer, [(0, 1, 1000, 0), (1, 2, 0, 5 * MICROSECOND)])
    assert ticks == [3 * MICROSECOND, 7 * MICROSECOND]


def test_ranges_are_told_apart_by_size():
    env, layer = transport()
    pairs = [(0, 1, 99.0), (1, 2, 100.0), (2, 0, 999.0), (0, 2, 1000.0)]
    # Below the first range nothing changes; then half the bandwidth and 3 us; then the link alone and 26.02 us.
    microseconds = [2 + 0.099, 3 + 0.2, 3 + 1.998, 26.02 + 1.0]
    assert send(env, layer, [(*p, 0) for p in pairs]) == [to_ticks(us * 1e-6) for us in microseconds]
    for (source, target, nbytes), us in zip(pairs, microseconds, strict=True):
        alpha_s, beta_s = layer.alpha_beta(source, target, nbytes)
        assert alpha_s + nbytes * beta_s == pytest.approx((1 + us) * 1e-6, rel=1e-12)


def test_messages_inside_a_node_feel_no_ranges():
    env, layer = transport(node_of=[0, 0, 1])
    assert send(env, layer, [(0, 1, 500, 0), (1, 2, 500, 0)]) == [to_ticks(2.5e-6), to_ticks(4e-6)]


def test_two_messages_of_half_the_bandwidth_fill_a_link():
    env, layer = transport()
    assert send(env, layer, [(0, 1, 500, 0)] * 2) == [to_ticks(4e-6)] * 2


@check
@given(st.floats(0.0, 1e9), st.floats(1.0, 100.0), st.floats(0.01, 2.0))
def test_alpha_and_beta_are_what_a_lone_message_takes(nbytes, factor, share):
    factors = f"{{above: 1 kB, bandwidth: {share}, latency: {factor}}}"
    text = f"{{flavour: mpich, overhead: 1 us, eager: 0 B, ranges: [{factors}]}}"
    env, layer = transport(card(text))
    alpha_s, beta_s = layer.alpha_beta(0, 1, nbytes)
    (tick,) = send(env, layer, [(0, 1, nbytes, layer.overhead_ticks)])
    assert tick == pytest.approx((alpha_s + nbytes * beta_s) * TICKS_PER_SECOND, rel=1e-12, abs=2)


@check
@given(st.floats(0.0, 1e5), st.floats(1.0, 100.0), st.floats(0.01, 2.0))
def test_an_eager_message_keeps_the_adapter_for_its_bytes(nbytes, factor, share):
    factors = f"{{above: 1 kB, bandwidth: {share}, latency: {factor}}}"
    text = f"{{flavour: mpich, overhead: 1 us, eager: 50 kB, ranges: [{factors}]}}"
    _, layer = transport(card(text), node_of=[0, 0, 1])  # the ranges hold for the second pair alone
    pairs = [(0, 1), (1, 2)]
    gaps = layer.gap_ticks(*np.array(pairs).T, np.full(2, nbytes))
    eager_s = [layer.alpha_beta(*pair, nbytes)[1] * nbytes if nbytes <= 5e4 else 0.0 for pair in pairs]
    assert gaps == pytest.approx(np.array(eager_s) * TICKS_PER_SECOND, rel=1e-12, abs=1)


def test_combining_takes_time_by_the_byte():
    _, layer = transport(reduce_bandwidth=4e9)
    assert layer.reduce_seconds(1e6) == 250e-6
    assert layer.reduce_ticks([0.0, 1.0, 1e6]).tolist() == [0, 250, 250 * MICROSECOND]
    assert transport()[1].reduce_seconds(1e12) == 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"node_of": [0, 1]}, "node_of must have one entry a rank, got 2 for 3 ranks"),
        ({"reduce_bandwidth": 0.0}, "reduce_bandwidth must be above zero, got 0.0 B/s"),
    ],
)
def test_what_a_transport_refuses(options, message):
    with pytest.raises(ScheduleError) as error:
        transport(**options)
    assert str(error.value) == message


# Which algorithm


@pytest.mark.parametrize(
    ("flavour", "collective", "ranks", "switches"),
    [
        # MPICH: each algorithm with the largest size it is still taken for
        ("mpich", "allreduce", 16, [("recursive_doubling", 63), ("rabenseifner", math.inf)]),
        ("mpich", "allreduce", 2, [("recursive_doubling", 8), ("rabenseifner", math.inf)]),
        ("mpich", "allgather", 8, [("recursive_doubling", 65535), ("ring", math.inf)]),
        ("mpich", "allgather", 10, [("bruck", 8191), ("ring", math.inf)]),
        ("mpich", "alltoall", 7, [("scattered", 32 * KIB), ("pairwise", math.inf)]),
        ("mpich", "alltoall", 8, [("bruck", 256), ("scattered", 32 * KIB), ("pairwise", math.inf)]),
        ("mpich", "alltoallv", 8, [("scattered", math.inf)]),
        (
            "mpich",
            "bcast",
            8,
            [
                ("binomial", 12288),
                ("scatter_recursive_doubling_allgather", 512 * KIB),
                ("scatter_ring_allgather", math.inf),
            ],
        ),
        ("mpich", "bcast", 10, [("binomial", 122880), ("scatter_ring_allgather", math.inf)]),
        ("mpich", "bcast", 7, [("binomial", math.inf)]),
        ("mpich", "reduce", 8, [("binomial", 2048), ("rabenseifner", math.inf)]),
        ("mpich", "reduce_scatter", 88, [("recursive_halving", 524287), ("pairwise", math.inf)]),
        ("mpich", "reduce_scatter", 8, [("recursive_halving", 524287), ("pairwise", math.inf)]),
        ("mpich", "gatherv", 8, [("linear", math.inf)]),
        # Open MPI
        ("openmpi", "allreduce", 6, [("ring", 15), ("recursive_doubling", 8 * KIB - 1), ("rabenseifner", math.inf)]),
        ("openmpi", "allreduce", 8, [("recursive_doubling", 8 * KIB - 1), ("rabenseifner", math.inf)]),
        ("openmpi", "allreduce", 16, [("ring", 63), ("recursive_doubling", 4 * KIB - 1), ("rabenseifner", math.inf)]),
        ("openmpi", "allreduce", 63, [("ring", 127), ("rabenseifner", math.inf)]),
        ("openmpi", "allreduce", 64, [("recursive_doubling", 256 * KIB - 1), ("rabenseifner", math.inf)]),
        ("openmpi", "alltoall", 4, [("linear", 512 * KIB - 1), ("pairwise", MIB - 1), ("linear", math.inf)]),
        ("openmpi", "alltoall", 64, [("bruck", KIB - 1), ("linear", 256 * KIB - 1), ("pairwise", math.inf)]),
        ("openmpi", "alltoallv", 3, [("pairwise", math.inf)]),
        ("openmpi", "alltoallv", 63, [("linear", math.inf)]),
        ("openmpi", "alltoallv", 64, [("pairwise", math.inf)]),
        ("openmpi", "alltoallv", 128, [("linear", math.inf)]),
        ("openmpi", "alltoallv", 1023, [("pairwise", math.inf)]),
        ("openmpi", "alltoallv", 1024, [("linear", math.inf)]),
        ("openmpi", "allgather", 16, [("recursive_doubling", math.inf)]),
        ("openmpi", "allgather", 12, [("bruck", math.inf)]),
        ("openmpi", "allgather", 32, [("recursive_doubling", 1023), ("neighbor_exchange", 65535), ("ring", math.inf)]),
        ("openmpi", "allgather", 33, [("bruck", 1023), ("ring", math.inf)]),
        # MVAPICH2
        ("mvapich2", "allreduce", 8, [("recursive_doubling", 2048), ("rabenseifner", math.inf)]),
        ("mvapich2", "allreduce", 300, [("recursive_doubling", 2048), ("rabenseifner", math.inf)]),
        (
            "mvapich2",
            "allgather",
            8,
            [("recursive_doubling", 1024), ("ring", 8192), ("recursive_doubling", 65536), ("ring", math.inf)],
        ),
        ("mvapich2", "allgather", 16, [("recursive_doubling", 32768), ("ring", math.inf)]),
        (
            "mvapich2",
            "allgather",
            64,
            [("recursive_doubling", 2048), ("ring", 4096), ("recursive_doubling", 65536), ("ring", math.inf)],
        ),
        ("mvapich2", "alltoall", 8, [("bruck", 15), ("scattered", math.inf)]),
        ("mvapich2", "alltoall", 16, [("bruck", 16), ("scattered", math.inf)]),
        ("mvapich2", "alltoall", 64, [("bruck", 256), ("scattered", math.inf)]),
    ],
)
def test_switch_points(flavour, collective, ranks, switches):
    smallest = 0.0
    for algorithm, largest in switches:
        assert choose(flavour, collective, ranks, smallest) == algorithm
        assert choose(flavour, collective, ranks, min(largest, 1e15)) == algorithm
        smallest = largest + 1.0


@check
@given(
    st.sampled_from(["mpich", "openmpi", "mvapich2"]),
    st.sampled_from(list(ALGORITHMS)),
    st.integers(1, 5000),
    st.floats(0.0, 1e15),
)
def test_what_is_chosen_can_be_used(flavour, collective, ranks, nbytes):
    algorithm = choose(flavour, collective, ranks, nbytes)
    assert algorithm in ALGORITHMS[collective]
    assert usable(collective, algorithm, ranks)


@pytest.mark.parametrize(
    ("flavour", "collective", "message"),
    [
        ("mpich2", "bcast", "there is no flavour of MPI 'mpich2'; did you mean 'mpich'? (known: mpich, openmpi, "),
        ("mpich", "broadcast", "there is no collective 'broadcast'; did you mean 'bcast'? (known: barrier, bcast, "),
    ],
)
def test_unknown_names(flavour, collective, message):
    with pytest.raises(ScheduleError) as error:
        choose(flavour, collective, 4, 1.0)
    assert str(error.value).startswith(message)
