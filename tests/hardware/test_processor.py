"""Processors and what drives them: kernels, streams, memory, copy engines and the host that issues the work."""

import functools
import itertools
import math

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import catalog
from simrender.clock import to_seconds, to_ticks
from simrender.errors import LinkFailedError, ScheduleError
from simrender.hardware.machine import Machine, load_machine
from simrender.hardware.processor import CopyEngine, Host, Processor

GIB = 2**30

check = settings(deadline=None, derandomize=True, max_examples=50)


@functools.cache
def load(name, *overrides):
    return load_machine(name, overrides)


# How long a trace kernel runs


@pytest.fixture(params=[*catalog.cards("machine"), "laptop:rtx"])
def gpu(request):
    """What renders on each machine: a GPU, or all cores of a node."""
    return Processor("gpu0", load(request.param).processor)


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
    gpu = Processor("gpu0", load("dgx2").gpu)
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


def test_and_not_a_byte_more():
    gpu = Processor("gpu5", load("dgx2").gpu)
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
    gpu = Processor("gpu0", load("dgx2").gpu)
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
def host():
    env = simpy.Environment()
    return env, Host(env, load("dgx2").host)


def test_the_host_issues_one_launch_or_copy_after_the_other(host):
    _, thread = host
    launch, copy = (to_ticks(t) for t in (load("dgx2").host.launch_issue, load("dgx2").host.copy_issue))
    assert [thread.issue_launch() for _ in range(16)] == [launch * (i + 1) for i in range(16)]
    assert thread.issue_copy() == 16 * launch + copy
    assert thread.issue_launch() == 17 * launch + copy


def test_the_host_issues_nothing_before_it_is_asked(host):
    env, thread = host
    thread.issue_launch()
    env.run(until=10**9)
    assert thread.issue_launch() == 10**9 + to_ticks(load("dgx2").host.launch_issue)


def test_reading_counters_takes_the_host_as_long_as_there_are_gpus(host):
    _, thread = host
    assert thread.read_counters(16) == 16 * to_ticks(load("dgx2").host.readback)
    assert thread.read_counters(0) == 16 * to_ticks(load("dgx2").host.readback)


# Streams


def test_a_kernel_waits_for_the_one_before_in_its_stream_and_for_whatever_else_runs():
    gpu = Processor("gpu0", load("dgx2").gpu)
    assert gpu.run(2e-6, 0, stream=1) == (0, 2_000_000)
    gpu.hold(9_000_000, stream=1)  # its next input is on its way
    assert gpu.run(3e-6, 0, stream=2) == (2_000_000, 5_000_000)
    assert gpu.run(1e-6, 0, stream=1) == (9_000_000, 10_000_000)
    assert gpu.run(1e-6, 0, stream=2) == (10_000_000, 11_000_000)
    assert gpu.busy_ticks == 7_000_000


def test_a_hold_of_all_streams_holds_each():
    gpu = Processor("gpu0", load("dgx2").gpu)
    gpu.hold(1_000_000)
    assert gpu.run(1e-6, 0, stream=7) == (1_000_000, 2_000_000)


@check
@given(st.lists(st.tuples(st.integers(0, 3), st.floats(0, 1e-3), st.integers(0, 10**9), st.booleans()), max_size=20))
def test_whatever_the_streams_kernels_never_overlap(kernels):
    gpu = Processor("gpu0", load("dgx2").gpu)
    spans, held = [], dict.fromkeys(range(4), 0)
    for stream, seconds, tick, waits in kernels:
        if waits:
            gpu.hold(tick, stream)
            held[stream] = max(held[stream], tick)
        spans.append(gpu.run(seconds, 0, stream))
        assert spans[-1][0] >= held[stream]
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(spans))


# Copy engines


def copies(card, *pairs, nbytes=1e9, nodes=1):
    """Seconds after which each of some copies has arrived that are submitted together."""
    env = simpy.Environment()
    machine = Machine(env, card, nodes * card.node_processors)
    events = [machine.copy(source, target, nbytes) for source, target in pairs]
    env.run(env.all_of(events))
    return [to_seconds(event.value) for event in events]


def test_two_copies_run_at_once_and_a_third_waits():
    """V100 have two engines: the first two share the way out, and the third has it to itself after them."""
    card = load("dgx2")
    alone, latency = 1e9 / 145.57e9, 2.5e-6
    two = 2 * alone + latency
    expected = [two, two, two + alone + latency]
    assert copies(card, (0, 1), (0, 2), (0, 3)) == pytest.approx(expected, abs=1e-11)


def test_a_copy_waits_for_the_engine_with_the_fewest_to_do():
    card = load("dgx2")
    alone, latency = 1e9 / 145.57e9, 2.5e-6
    two = 2 * alone + latency
    assert copies(card, *[(0, i) for i in (1, 2, 3, 4)]) == pytest.approx([two, two, 2 * two, 2 * two], abs=1e-11)


def test_one_engine_copies_one_after_the_other():
    card = load("dgx2", "gpu.copy_engines=1")
    one = 1e9 / 145.57e9 + 2.5e-6
    assert copies(card, (0, 1), (0, 2), (0, 3)) == pytest.approx([one, 2 * one, 3 * one], abs=1e-11)


def test_engines_of_different_gpus_do_not_wait_for_each_other():
    card = load("dgx2", "gpu.copy_engines=1")
    one = 1e9 / 145.57e9 + 2.5e-6
    assert copies(card, (0, 1), (2, 3), (4, 5)) == pytest.approx([one] * 3, abs=1e-11)


def test_copies_overlap_with_kernels():
    env = simpy.Environment()
    machine = Machine(env, load("dgx2"), 16)
    copy = machine.copy(0, 1, 1e9)
    assert machine.processor(0).run(5e-3, 0) == (0, to_ticks(5e-3))
    env.run(copy)
    assert env.now == to_ticks(2.5e-6) + to_ticks(1e9 / 145.57e9)


def test_a_copy_that_was_begun_later_starts_later():
    env = simpy.Environment()
    machine = Machine(env, load("dgx2"), 16)
    assert env.run(machine.copy(0, 1, 0.0, start=7_000_000)) == 7_000_000 + to_ticks(2.5e-6)


def test_an_engine_counts_what_it_has_to_do():
    env = simpy.Environment()
    engine = CopyEngine(env)
    one, two = (engine.submit(lambda tick: env.timeout(5, tick), 0) for _ in range(2))
    assert engine.waiting == 2
    env.run(one)
    assert engine.waiting == 1
    env.run(two)
    assert (engine.waiting, env.now) == (0, 10)


def test_copies_over_a_link_that_fails_fail():
    card = load("dgx2", "disturbances=[{link: gpu0.out, share: 0, start: 1 ms}]")
    env, failed = simpy.Environment(), []
    machine = Machine(env, card, 16)

    def submit(target):
        try:
            yield machine.copy(0, target, 1e9)
        except LinkFailedError as error:
            failed.append((target, "gpu0.out" in str(error)))

    env.run(env.all_of([env.process(submit(target)) for target in (1, 2, 3)]))
    assert sorted(failed) == [(1, True), (2, True), (3, True)]


# Kernels that read a neighbour's memory


def test_a_kernel_reads_with_its_share_of_the_bandwidth():
    card = load("dgx2")
    env = simpy.Environment()
    env.run(Machine(env, card, 16).read(0, 1, 1e9))
    assert to_seconds(env.now) == pytest.approx(2.5e-6 + 1e9 / (0.79 * 145.57e9), abs=1e-11)


def test_reading_over_a_bridge_takes_the_share_of_the_bridge():
    """On Frontera, kernels read 0.79 of NVLink and 0.28 of PCIe."""
    card = load("frontera-rtx")
    for neighbour, expected in ((1, 0.79 * 10e9), (2, 0.28 * 6e9)):
        env = simpy.Environment()
        env.run(Machine(env, card, 4).read(0, neighbour, 1e12))
        assert 1e12 / to_seconds(env.now) == pytest.approx(expected, rel=1e-5)


# Cores as processors


def test_the_cores_of_a_node_trace_together():
    one, all_ = (Processor("cpu", load("stampede2-skx", f"cpu.cores={n}").cpu) for n in (1, 48))
    assert all_.card.coherent_rate == 48 * one.card.coherent_rate == 48 * 1.3e6
    assert all_.card.incoherent_rate == 48 * 0.9e6
    assert all_.card.parse_bandwidth == 48 * 120e6
    assert all_.card.build_rate == 48 * 0.5e6
    times = [beyond_launch(cpu, 1e9, 1e9, 8e5) for cpu in (one, all_)]
    assert times[0] == pytest.approx(48 * times[1], rel=1e-12)


def test_manta_traces_the_boeing_as_fast_as_published():
    """Ize et al.: 1.46 frames/s with 36 ambient occlusion rays; all 37 rays of a pixel are taken to cost the same."""
    card = load("manta-cluster").cpu
    pixels = 1920 * 1080 / 59
    frame_s = Processor("cpu", card).trace_seconds(0, 37 * pixels, 259e6)
    assert 1 / frame_s == pytest.approx(1.46, rel=0.01)


def test_a_machine_without_gpus_has_its_nodes_as_processors():
    machine = Machine(simpy.Environment(), load("stampede2-skx"), 3)
    assert [machine.processor(i).name for i in range(3)] == ["node0.cpu", "node1.cpu", "node2.cpu"]
    assert machine.cpu(1) is machine.processor(1)
    assert Machine(simpy.Environment(), load("laptop"), 1).processor(0).name == "cpu"


def test_a_machine_with_gpus_has_its_cores_beside_them():
    machine = Machine(simpy.Environment(), load("frontera-rtx"), 8)
    assert machine.processor(5).name == "node1.gpu1"
    assert machine.cpu(1).name == "node1.cpu"
    assert machine.cpu(1).card.cores == 16
    assert machine.processors == [machine.processor(5)]


def test_cores_need_no_host_to_drive_them():
    machine = Machine(simpy.Environment(), load("stampede2-skx"), 3)
    assert machine.host(2).issue_launch() == machine.host(2).issue_copy() == machine.host(2).read_counters(1) == 0
