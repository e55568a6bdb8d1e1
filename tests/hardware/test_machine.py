"""What a simulation makes of a machine: devices when they are used, parts of it, nodes and links off their rates."""

import functools
import math
import statistics

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import catalog
from simrender.clock import to_seconds, to_ticks
from simrender.errors import LinkFailedError, UsageError
from simrender.hardware.machine import Machine, VariabilityCard, check_processors, load_machine

CLUSTERS = ("frontera-rtx", "manta-cluster", "stampede2-skx")

check = settings(deadline=None, derandomize=True, max_examples=50)


@functools.cache
def load(name, *overrides):
    return load_machine(name, overrides)


# Devices come into being when they are used


def paths(machine, section):
    return [path for path, _ in machine.quantities() if path.startswith(f"machine.{section}")]


def test_a_machine_has_what_was_used_of_it():
    machine = Machine(simpy.Environment(), load("dgx2"), 16)
    assert machine.processors == []
    assert not machine.has_network
    machine.processor(3), machine.processor(1), machine.processor(3)
    assert [p.name for p in machine.processors] == ["gpu1", "gpu3"]
    assert paths(machine, "nvlink") == []
    machine.network.transfer(0, 1, 1.0)
    assert machine.has_network
    assert paths(machine, "nvlink") == [f"machine.nvlink.{field}" for field in ("bandwidth", "duplex", "latency")]
    assert paths(machine, "storage") == []
    reading = Machine(simpy.Environment(), load("dgx2"), 16, kernels_read=True)
    reading.read(0, 1, 1.0)
    assert "machine.nvlink.kernel_share" in paths(reading, "nvlink")


def test_the_way_to_the_host_is_named_once_something_has_gone_over_it():
    env = simpy.Environment()
    machine = Machine(env, load("dgx2"), 16)
    machine.host(0).issue_launch()
    env.run(machine.copy(0, 1, 1e6))
    issues = [f"machine.host.{field}" for field in ("launch_issue", "copy_issue", "readback")]
    assert paths(machine, "host") == issues
    env.run(machine.network.transfer(("host", 0), 1, 1e6))
    ways = [f"machine.host.{field}" for field in ("to_device", "from_device", "copy_latency")]
    assert paths(machine, "host") == issues + ways


def test_cores_are_named_when_they_work_beside_gpus():
    machine = Machine(simpy.Environment(), load("frontera-rtx"), 8)
    assert paths(machine, "cpu") == []
    machine.cpu(1)
    assert "machine.cpu.core_build_rate" in paths(machine, "cpu")


@pytest.mark.parametrize("name", CLUSTERS)
def test_one_node_of_a_cluster_has_its_adapter_and_no_use_for_it(name):
    card = load(name)
    machine = Machine(simpy.Environment(), card, card.node_processors)
    assert machine.network
    assert paths(machine, "network") == paths(machine, "mpi") == []
    if card.storage:
        assert machine.topology.route("storage", ("host", 0)) == ("storage", "node0.client", "node0.nic.in")
    if card.display:
        assert machine.topology.route(0, ("display", 0)) == ("node0.nic.out",)


def test_a_machine_without_a_section_says_so():
    machine = Machine(simpy.Environment(), load("manta-cluster"), 2)
    with pytest.raises(UsageError, match=r"has no storage on its card; add a section storage"):
        _ = machine.storage
    with pytest.raises(UsageError, match=r"has no MPI on its card; add a section mpi"):
        Machine(simpy.Environment(), load("dgx2"), 2).communicator()


def test_a_domain_is_loaded_over_the_machine_of_the_card():
    """Stampede2, by hand: 0.45 GB at 0.45 GB/s from one target; 48 cores parse at 5.76 GB/s and build 24 Mtri/s.

    The first byte comes through the adapter, which has half of the network's 1.7 us.
    """
    env = simpy.Environment()
    machine = Machine(env, load("stampede2-skx"), 2)
    times = env.run(env.process(machine.load(1, 0.45e9, 6e6)))
    phases = (times.open_ticks, times.read_ticks, times.parse_ticks, times.build_ticks)
    expected = (1e-3, 1.0 + 0.85e-6, 0.45 / 5.76, 6 / 24)
    assert [to_seconds(ticks) for ticks in phases] == pytest.approx(expected, abs=1e-9)


# A part of a machine


@pytest.mark.parametrize(
    ("name", "nodes", "gpus", "expected"),
    [
        ("dgx2", None, None, 16),
        ("dgx2", None, 2, 2),
        ("dgx2", 1, 16, 16),
        ("frontera-rtx", None, None, 88),
        ("frontera-rtx", 2, None, 8),
        ("frontera-rtx", 2, 5, 5),
        ("frontera-rtx", None, 6, 6),
        ("stampede2-skx", None, None, 128),
        ("stampede2-skx", 4, None, 4),
        ("laptop", 1, None, 1),
    ],
)
def test_a_part_of_a_machine_can_be_used(name, nodes, gpus, expected):
    assert check_processors(load(name), nodes, gpus) == expected


FRONTERA = "Frontera RTX (22 nodes of 4 Quadro RTX 5000 16 GB, HDR100)"


@pytest.mark.parametrize(
    ("name", "nodes", "gpus", "message"),
    [
        ("dgx2", None, 17, "--gpus 17: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("dgx2", None, 0, "--gpus 0: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("dgx2", None, -1, "--gpus -1: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("frontera-rtx", 23, None, f"--nodes 23: {FRONTERA} has 1 to 22 nodes to use"),
        ("frontera-rtx", 0, 4, f"--nodes 0: {FRONTERA} has 1 to 22 nodes to use"),
        ("frontera-rtx", 2, 9, f"--gpus 9: {FRONTERA} has 1 to 8 GPUs to use in 2 nodes"),
        ("laptop", None, 1, "--gpus 1: Laptop (8 cores, 32 GB) has no GPUs; --nodes says how many nodes to use"),
    ],
)
def test_there_is_no_more_of_it(name, nodes, gpus, message):
    with pytest.raises(UsageError) as error:
        check_processors(load(name), nodes, gpus)
    assert str(error.value) == message


@pytest.mark.parametrize(("gpus", "nodes"), [(1, 1), (4, 1), (5, 2), (8, 2), (88, 22)])
def test_gpus_are_taken_node_by_node(gpus, nodes):
    machine = Machine(simpy.Environment(), load("frontera-rtx"), gpus)
    assert machine.nodes == nodes
    assert machine.node_of(gpus - 1) == nodes - 1


def test_every_host_reads_the_counters_of_its_own_gpus_and_then_they_tell_each_other():
    def seconds(gpus):
        env = simpy.Environment()
        env.run(Machine(env, load("frontera-rtx"), gpus).read_counters())
        return to_seconds(env.now)

    assert seconds(4) == pytest.approx(4 * 10e-6, abs=1e-12)
    assert 4 * 10e-6 + 1.5e-6 < seconds(8) < seconds(88) < 4 * 10e-6 + 20 * 1.5e-6


# Nodes that differ


@pytest.mark.parametrize("name", catalog.cards("machine"))
def test_nodes_are_equal_unless_a_card_says_otherwise(name):
    card = load(name)
    assert card.variability is None
    assert {Machine(simpy.Environment(), card, 1).processor(0).slowness} == {1.0}


@pytest.mark.parametrize("distribution", ["normal", "lognormal"])
@pytest.mark.parametrize("spread", [0.01, 0.1, 0.3])
def test_slowness_has_the_mean_and_the_spread_of_its_card(distribution, spread):
    card = VariabilityCard(spread=spread, distribution=distribution, seed=3)
    drawn = [card.slowness(node) for node in range(4000)]
    assert statistics.fmean(drawn) == pytest.approx(1.0, abs=5 * spread / math.sqrt(4000))
    assert statistics.stdev(drawn) == pytest.approx(spread, rel=0.06)
    assert (max(drawn) <= 1 + 3 * spread) == (distribution == "normal")


@check
@given(st.floats(1e-6, 1.0), st.sampled_from(["normal", "lognormal"]), st.integers(0, 2**40), st.integers(0, 10**6))
def test_every_node_takes_some_time(spread, distribution, seed, node):
    card = VariabilityCard(spread=spread, distribution=distribution, seed=seed)
    assert 0.0 < card.slowness(node) < math.inf
    assert card.slowness(node) == VariabilityCard(spread=spread, distribution=distribution, seed=seed).slowness(node)


def test_a_wide_spread_keeps_its_mean_and_never_turns_time_back():
    drawn = [VariabilityCard(spread=1.0).slowness(node) for node in range(4000)]
    assert min(drawn) == pytest.approx(0.1)
    assert statistics.fmean(drawn) == pytest.approx(1.0, abs=0.06)


def durations(nodes, *overrides):
    """Ticks that each node takes for a kernel of 1 ms."""
    machine = Machine(simpy.Environment(), load("stampede2-skx", *overrides), nodes)
    spans = [machine.processor(node).run(1e-3, 0) for node in range(nodes)]
    return [end - begin for begin, end in spans]


def test_a_node_is_as_slow_however_many_there_are_and_the_slowest_sets_the_pace():
    spread = "variability={spread: 0.1}"
    few, many = durations(8, spread), durations(128, spread)
    assert many[:8] == few
    assert max(many) >= max(few) > to_ticks(1e-3)
    assert len(set(many)) == 128
    assert durations(8, "variability={spread: 0.1, seed: 2}") != few
    assert durations(8) == [to_ticks(1e-3)] * 8


def test_the_gpus_of_a_node_and_its_cores_are_equally_slow():
    machine = Machine(simpy.Environment(), load("frontera-rtx", "variability={spread: 0.2}"), 8)
    first, second = machine.processor(0).slowness, machine.processor(4).slowness
    assert first == machine.processor(3).slowness == machine.cpu(0).slowness != second


# Links that slow down or fail


def copy_seconds(card, nbytes=145.57e6):
    env = simpy.Environment()
    env.run(Machine(env, card, card.processors).network.transfer(0, 1, nbytes))
    return to_seconds(env.now)


def test_a_link_that_slows_down_for_a_while():
    """145.57 MB take 1 ms; from 0.2025 ms on half of them a second go through, until 0.8025 ms: 0.3 ms more."""
    disturbed = load("dgx2", "disturbances=[{link: gpu0.out, share: 0.5, start: 0.2025 ms, end: 0.8025 ms}]")
    assert copy_seconds(load("dgx2")) == pytest.approx(1e-3 + 2.5e-6, abs=1e-11)
    assert copy_seconds(disturbed) == pytest.approx(1.3e-3 + 2.5e-6, abs=1e-11)


def test_a_link_that_is_not_used_disturbs_nobody(tmp_path):
    card = tmp_path / "card.yaml"
    card.write_text("extends: dgx2\ndisturbances:\n  - {link: gpu7.in, share: 0, start: 0 s}\n")
    assert copy_seconds(load_machine(str(card))) == copy_seconds(load("dgx2"))


def test_a_link_that_fails():
    with pytest.raises(LinkFailedError, match=r"gpu1\.in"):
        copy_seconds(load("dgx2", "disturbances=[{link: gpu1.in, share: 0, start: 0.5 ms}]"))


def test_links_of_nodes_that_are_not_used_may_be_disturbed():
    card = load("stampede2-skx", "disturbances=[{link: node99.nic.in, share: 0, start: 0 s}]")
    env = simpy.Environment()
    env.run(Machine(env, card, 4).network.transfer(0, 1, 11e9))
    assert to_seconds(env.now) == pytest.approx(1.0, rel=1e-5)
