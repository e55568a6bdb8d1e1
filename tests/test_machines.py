"""The machines of the house, against table 1 of the ray queue cycling paper; and what processors and hosts charge."""

import itertools
import math

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import catalog
from simrender.cards import UNCALIBRATED
from simrender.clock import to_seconds, to_ticks
from simrender.errors import ScheduleError, UsageError
from simrender.hardware.machine import Machine, check_gpus, load_machine
from simrender.hardware.processor import Host, Processor

NAMES = ("desktop-rtx8000", "dgx2", "hgx-a100", "rtx-server-a40")
GIB = 2**30
NBYTES = 1e12  # so much that latency does not show

check = settings(deadline=None, derandomize=True, max_examples=50)


@pytest.fixture(scope="module")
def cards():
    return {name: load_machine(name) for name in NAMES}


def both_ways(card, one, other):
    """Bandwidth of a pair, both directions together, when each copies to the other at once."""
    env = simpy.Environment()
    network = Machine(env, card, card.gpus).network
    copies = [network.transfer(one, other, NBYTES), network.transfer(other, one, NBYTES)]
    env.run(env.all_of(copies))
    return 2 * NBYTES / to_seconds(env.now)


def one_way(card, one, other, nbytes=NBYTES):
    env = simpy.Environment()
    env.run(Machine(env, card, card.gpus).network.transfer(one, other, nbytes))
    return to_seconds(env.now)


# The cards


def test_every_machine_of_the_house_is_tested_here():
    assert set(NAMES) <= set(catalog.cards("machine"))


@pytest.mark.parametrize("name", NAMES)
def test_the_card_loads(cards, name):
    assert cards[name].title
    assert cards[name].gpus > 1


@pytest.mark.parametrize("name", NAMES)
def test_every_quantity_says_where_it_comes_from(cards, name):
    for path, quantity in cards[name].quantities():
        if quantity.status != "stated":
            assert quantity.source, path


@pytest.mark.parametrize("name", NAMES)
def test_what_is_assumed_or_calibrated_says_why(cards, name):
    owned_up = [(path, q) for path, q in cards[name].quantities() if q.status in UNCALIBRATED]
    assert owned_up
    for path, quantity in owned_up:
        assert len(quantity.source.split()) >= 3, path
        assert quantity.text, path


@pytest.mark.parametrize("name", NAMES)
def test_a_calibrated_value_names_what_it_was_fitted_to(cards, name):
    for path, quantity in cards[name].quantities():
        if quantity.status == "calibrated":
            assert "RQC" in quantity.source, path


@pytest.mark.parametrize("name", NAMES)
def test_the_range_of_a_value_holds_it(cards, name):
    for path, quantity in cards[name].quantities():
        if quantity.range is not None:
            low, high = quantity.range
            assert low <= quantity <= high, path
            assert low < high, path


@pytest.mark.parametrize("name", NAMES)
def test_the_numbers_are_in_proportion(cards, name):
    gpu = cards[name].gpu
    assert gpu.reserved_memory < gpu.memory / 10
    assert gpu.incoherent_rate < gpu.coherent_rate
    assert cards[name].fabric.bandwidth < gpu.memory_bandwidth


def test_ray_tracing_cores_halve_the_memory_of_a_triangle(cards):
    """Ray queue cycling paper, section 4.1."""
    for card in cards.values():
        assert card.gpu.bvh_triangle_bytes == (50.0 if card.gpu.ray_tracing_cores else 100.0)
        assert card.gpu.bvh_instance_bytes == 400.0


# Table 1 of the ray queue cycling paper


@pytest.mark.parametrize(
    ("name", "gpus", "memory"),
    [
        ("dgx2", 16, 32 * GIB),
        ("hgx-a100", 8, 40 * GIB),
        ("rtx-server-a40", 8, 48 * GIB),
        ("desktop-rtx8000", 2, 48 * GIB),
    ],
)
def test_gpus_and_their_memory(cards, name, gpus, memory):
    assert (cards[name].gpus, cards[name].gpu.memory) == (gpus, memory)


@pytest.mark.parametrize(("name", "bandwidth"), [("dgx2", 270e9), ("hgx-a100", 475e9)])
def test_a_pair_behind_nvswitch_that_copies_both_ways_at_once(cards, name, bandwidth):
    last = cards[name].gpus - 1
    for one, other in ((0, 1), (0, last), (last // 2, last // 2 + 1)):
        assert both_ways(cards[name], one, other) == pytest.approx(bandwidth, rel=0.005)


def test_pairs_behind_pcie_that_copy_both_ways_at_once(cards):
    card = cards["rtx-server-a40"]
    by_pair = [both_ways(card, one, other) for one, other in itertools.combinations(range(card.gpus), 2)]
    assert min(by_pair) == pytest.approx(36.7e9, rel=0.005)
    assert max(by_pair) == pytest.approx(51.9e9, rel=0.005)


@pytest.mark.parametrize("name", NAMES)
def test_one_way_a_copy_has_the_bandwidth_of_the_card(cards, name):
    card = cards[name]
    assert NBYTES / one_way(card, 0, 1) == pytest.approx(float(card.fabric.bandwidth), rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_copy_takes_the_latency_of_the_card(cards, name):
    card = cards[name]
    assert one_way(card, 0, 1, 0.0) == pytest.approx(float(card.fabric.latency), abs=2e-12)


@pytest.mark.parametrize("name", NAMES)
def test_a_ring_of_copies_runs_no_slower_than_a_pair_both_ways(cards, name):
    """Every GPU sends right and receives from the left: each has one copy in each direction, as in a pair."""
    card = cards[name]
    env = simpy.Environment()
    network = Machine(env, card, card.gpus).network
    env.run(env.all_of([network.transfer(i, (i + 1) % card.gpus, NBYTES) for i in range(card.gpus)]))
    slowest = min(both_ways(card, i, (i + 1) % card.gpus) for i in range(card.gpus))
    assert 2 * NBYTES / to_seconds(env.now) == pytest.approx(slowest, rel=1e-6)


def test_two_copies_to_one_gpu_share_its_way_in(cards):
    card = cards["dgx2"]
    env = simpy.Environment()
    network = Machine(env, card, card.gpus).network
    env.run(env.all_of([network.transfer(source, 0, NBYTES) for source in (1, 2)]))
    assert 2 * NBYTES / to_seconds(env.now) == pytest.approx(float(card.fabric.bandwidth), rel=1e-6)
    assert network.sent_bytes == 2 * NBYTES


# Devices come into being when they are used


def test_a_machine_has_what_was_used_of_it(cards):
    machine = Machine(simpy.Environment(), cards["dgx2"], 16)
    assert machine.processors == []
    assert not machine.has_network
    machine.processor(3), machine.processor(1), machine.processor(3)
    assert [p.name for p in machine.processors] == ["gpu1", "gpu3"]
    assert not any(path.startswith("machine.nvlink") for path, _ in machine.quantities())
    machine.network.transfer(0, 1, 1.0)
    assert machine.has_network
    used = [path for path, _ in machine.quantities() if path.startswith("machine.nvlink")]
    assert used == [f"machine.nvlink.{field}" for field in ("bandwidth", "duplex", "latency")]
    reading = Machine(simpy.Environment(), cards["dgx2"], 16, kernels_read=True)
    reading.network.transfer(0, (1, "kernel"), 1.0)
    assert "machine.nvlink.kernel_share" in {path for path, _ in reading.quantities()}


@pytest.mark.parametrize("gpus", [1, 2, 16])
def test_a_part_of_the_gpus_can_be_used(cards, gpus):
    assert check_gpus(cards["dgx2"], gpus) == gpus
    assert check_gpus(cards["dgx2"], None) == 16


@pytest.mark.parametrize("gpus", [0, -1, 17])
def test_there_are_no_other_gpus(cards, gpus):
    with pytest.raises(UsageError) as error:
        check_gpus(cards["dgx2"], gpus)
    assert str(error.value) == f"--gpus {gpus}: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"


# How long a trace kernel runs


@pytest.fixture(params=NAMES)
def gpu(request, cards):
    return Processor("gpu0", cards[request.param].gpu)


def beyond_launch(gpu, *work):
    return gpu.trace_seconds(*work) - gpu.card.launch_latency


def test_a_kernel_without_rays_or_primitives_takes_its_launch(gpu):
    for work in ((0, 0, 1e6), (1e6, 1e6, 0), (0, 0, 0)):
        assert gpu.trace_seconds(*work) == gpu.card.launch_latency


def test_at_the_size_of_scene_that_the_card_means_a_large_kernel_runs_at_its_rates(gpu):
    rays, primitives = 1e12, float(gpu.card.rate_primitives)
    assert rays / gpu.trace_seconds(rays, 0, primitives) == pytest.approx(float(gpu.card.coherent_rate), rel=1e-4)
    assert rays / gpu.trace_seconds(0, rays, primitives) == pytest.approx(float(gpu.card.incoherent_rate), rel=1e-4)


def test_time_is_linear_in_rays(gpu):
    """Beyond the launch: (rays + half-saturation rays) x a constant."""
    times = [gpu.trace_seconds(0, rays, 1e8) for rays in (1e6, 2e6, 3e6, 4e6)]
    steps = [b - a for a, b in itertools.pairwise(times)]
    assert steps == pytest.approx([steps[0]] * 3, rel=1e-9)


def test_time_grows_with_the_logarithm_of_the_primitives(gpu):
    """Every factor of 1024 in primitives costs the same again."""
    times = [beyond_launch(gpu, 0, 1e7, 1024.0**k - 1.0) for k in (1, 2, 3)]
    assert times == pytest.approx([times[0], 2 * times[0], 3 * times[0]], rel=1e-9)


def test_coherent_rays_are_cheaper_by_the_ratio_of_the_rates(gpu):
    ratio = beyond_launch(gpu, 0, 1e7, 1e6) / beyond_launch(gpu, 1e7, 0, 1e6)
    assert ratio == pytest.approx(gpu.card.coherent_rate / gpu.card.incoherent_rate, rel=1e-9)
    assert ratio > 1


def test_at_half_saturation_a_kernel_runs_at_half_its_rate(gpu):
    half, primitives = float(gpu.card.half_saturation), float(gpu.card.rate_primitives)
    rate = half / beyond_launch(gpu, 0, half, primitives)
    assert rate == pytest.approx(gpu.card.incoherent_rate / 2, rel=1e-9)


@check
@given(st.integers(0, 10**9), st.integers(0, 10**9), st.floats(0, 1e12), st.floats(1.0, 100.0))
def test_more_work_never_takes_less_time(coherent, incoherent, primitives, factor):
    gpu = Processor("gpu0", load_dgx2().gpu)
    time = gpu.trace_seconds(coherent, incoherent, primitives)
    assert math.isfinite(time)
    more = [
        (coherent * factor, incoherent * factor, primitives),
        (coherent, incoherent * factor, primitives),
        (coherent, incoherent, primitives * factor),
    ]
    if coherent + incoherent >= 10 * gpu.card.half_saturation:  # below, coherent rays make the wait for others cheaper
        more.append((coherent * factor, incoherent, primitives))
    assert all(gpu.trace_seconds(*work) >= time * (1 - 1e-12) for work in more)


def load_dgx2(known={}):  # noqa: B006 - read once for all examples
    if not known:
        known["dgx2"] = load_machine("dgx2")
    return known["dgx2"]


def test_a_kernel_bound_by_memory_takes_its_bytes_over_the_bandwidth(gpu):
    card = gpu.card
    assert gpu.stream_seconds(0.0) == card.launch_latency
    assert gpu.stream_seconds(1e9) == pytest.approx(card.launch_latency + 1e9 / card.memory_bandwidth, rel=1e-12)


# Memory


def test_a_program_can_allocate_what_is_not_reserved(gpu):
    assert gpu.capacity_bytes == gpu.card.memory - gpu.card.reserved_memory
    gpu.allocate("the model", gpu.capacity_bytes - 1000.0)
    gpu.allocate("a queue", 1000.0)
    assert gpu.allocated_bytes == gpu.capacity_bytes


def test_and_not_a_byte_more(cards):
    gpu = Processor("gpu5", cards["dgx2"].gpu)
    gpu.allocate("the model", 31.0 * GIB)
    with pytest.raises(ScheduleError) as error:
        gpu.allocate("ray queues", 1.0)
    assert str(error.value) == f"gpu5: allocating ray queues takes {31 * GIB + 1} B of {31 * GIB} B"


# Kernels and the host


def test_kernels_of_one_gpu_run_one_after_the_other(gpu):
    spans = [gpu.run(seconds, not_before) for seconds, not_before in ((1e-6, 0), (2e-6, 0), (1e-6, 10_000_000))]
    assert spans == [(0, 1_000_000), (1_000_000, 3_000_000), (10_000_000, 11_000_000)]
    assert gpu.busy_ticks == 4_000_000
    assert gpu.free_at == 11_000_000


@check
@given(st.lists(st.tuples(st.floats(0, 1e-3), st.integers(0, 10**9)), max_size=20))
def test_kernels_never_overlap_and_never_begin_before_they_are_issued(kernels):
    gpu = Processor("gpu0", load_dgx2().gpu)
    spans = [gpu.run(seconds, issued) for seconds, issued in kernels]
    for (seconds, issued), (begin, end) in zip(kernels, spans, strict=True):
        assert begin >= issued
        assert end - begin == to_ticks(seconds)
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(spans))
    assert gpu.busy_ticks == sum(end - begin for begin, end in spans)


def test_a_kernel_that_waits_for_data_keeps_its_gpu_but_does_not_work(gpu):
    gpu.run(1e-6, 0)
    gpu.hold(1_500_000)
    gpu.hold(1_200_000)
    assert (gpu.free_at, gpu.busy_ticks) == (1_500_000, 1_000_000)


@pytest.fixture
def host(cards):
    env = simpy.Environment()
    return env, Host(env, cards["dgx2"].host)


def test_the_host_issues_one_launch_or_copy_after_the_other(host, cards):
    _, thread = host
    launch, copy = (to_ticks(t) for t in (cards["dgx2"].host.launch_issue, cards["dgx2"].host.copy_issue))
    assert [thread.issue_launch() for _ in range(16)] == [launch * (i + 1) for i in range(16)]
    assert thread.issue_copy() == 16 * launch + copy
    assert thread.issue_launch() == 17 * launch + copy


def test_the_host_issues_nothing_before_it_is_asked(host, cards):
    env, thread = host
    thread.issue_launch()
    env.run(until=10**9)
    assert thread.issue_launch() == 10**9 + to_ticks(cards["dgx2"].host.launch_issue)


def test_reading_counters_takes_the_host_as_long_as_there_are_gpus(host, cards):
    _, thread = host
    assert thread.read_counters(16) == 16 * to_ticks(cards["dgx2"].host.readback)
    assert thread.read_counters(0) == 16 * to_ticks(cards["dgx2"].host.readback)
