"""The machines of the house: their cards, and table 1 of the ray queue cycling paper; and cards that make no sense."""

import functools
import itertools

import pytest
import simpy

from simrender import catalog
from simrender.cards import UNCALIBRATED
from simrender.clock import to_seconds
from simrender.errors import CardError
from simrender.hardware.machine import Machine, load_machine
from simrender.hardware.topology import Topology

SINGLE = ("desktop-rtx8000", "dgx2", "hgx-a100", "rtx-server-a40")
CLUSTERS = ("frontera-rtx", "manta-cluster", "stampede2-skx")
VARIANTS = ("frontera-rtx:fdr", "frontera-rtx:staged", "laptop:rtx")
NAMES = (*SINGLE, *CLUSTERS, "laptop", *VARIANTS)
GIB = 2**30
NBYTES = 1e12  # so much that latency does not show


@functools.cache
def load(name, *overrides):
    return load_machine(name, overrides)


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
    found = catalog.cards("machine")
    names = [*found, *(f"{card.name}:{v}" for card in found.values() for v in card.document().variants)]
    assert set(names) == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_the_card_loads(name):
    assert load(name).title
    assert (load(name).nodes > 1) == (name.partition(":")[0] in CLUSTERS)


@pytest.mark.parametrize("name", NAMES)
def test_every_quantity_says_where_it_comes_from(name):
    quantities = list(load(name).quantities())
    assert len(quantities) > 10
    for path, quantity in quantities:
        assert quantity.status != "stated", path
        assert quantity.source, path


@pytest.mark.parametrize("name", NAMES)
def test_what_is_assumed_or_calibrated_says_why(name):
    owned_up = [(path, q) for path, q in load(name).quantities() if q.status in UNCALIBRATED]
    assert owned_up
    for path, quantity in owned_up:
        assert len(quantity.source.split()) >= 2, path
        assert quantity.text, path


@pytest.mark.parametrize("name", NAMES)
def test_a_calibrated_value_names_what_it_was_fitted_to(name):
    for path, quantity in load(name).quantities():
        if quantity.status == "calibrated":
            assert "RQC" in quantity.source or "IZE" in quantity.source, path


@pytest.mark.parametrize("name", NAMES)
def test_the_range_of_a_value_holds_it(name):
    for path, quantity in load(name).quantities():
        if quantity.range is not None:
            low, high = quantity.range
            assert low <= quantity <= high, path
            assert low < high, path


@pytest.mark.parametrize("name", NAMES)
def test_the_numbers_are_in_proportion(name):
    card = load(name)
    for processor in filter(None, (card.gpu, card.cpu)):
        assert processor.reserved_memory < processor.memory / 4
        assert processor.incoherent_rate < processor.coherent_rate
    for fabric in filter(None, (card.nvlink, card.pcie)):
        assert fabric.bandwidth < card.gpu.memory_bandwidth
    if card.network:
        assert card.network.bandwidth < card.processor.memory_bandwidth
        assert card.mpi.overhead < card.network.latency


def test_ray_tracing_cores_halve_the_memory_of_a_triangle():
    """Ray queue cycling paper, section 4.1."""
    for gpu in (card.gpu for card in map(load, NAMES) if card.gpus):
        assert gpu.bvh_triangle_bytes == (50.0 if gpu.ray_tracing_cores else 100.0)
        assert gpu.bvh_instance_bytes == 400.0


def test_frontera_is_what_the_islands_paper_rendered_on():
    """Zellmann et al., section 8.1."""
    card = load("frontera-rtx")
    assert (card.nodes, card.gpus, card.processors) == (22, 4, 88)
    assert card.processors * card.gpu.memory == 88 * 16 * GIB
    assert card.network.gpu_direct
    assert card.mpi.flavour == "mvapich2"


def test_the_variants_of_frontera_differ_in_the_network_alone():
    names = [name for name in NAMES if "frontera" in name]
    plain, fdr, staged = (load(name).model_dump(exclude={"title", "network", "host"}) for name in names)
    assert plain == fdr == staged
    assert load("frontera-rtx:fdr").network.bandwidth < 56e9 / 8 < load("frontera-rtx").network.bandwidth < 100e9 / 8
    assert not load("frontera-rtx:staged").network.gpu_direct


def test_manta_displays_what_ize_et_al_measured():
    """Their sections 5.2 and 5.5: at best 135 frames/s, 127 of them in messages that fill 95 % of three packets."""
    from simrender.hardware.display import message_layout, simulate_display

    card = load("manta-cluster").display
    message = message_layout(card, card.message_pixels)
    assert (message.pixels, message.payload_bytes, message.packets) == (832, 5824, 3)
    assert message.efficiency == pytest.approx(0.95, abs=0.003)
    report = simulate_display(card, (1920, 1080))
    assert report.payload_bound_frames_per_s == pytest.approx(135, abs=0.5)
    assert report.bound_frames_per_s == pytest.approx(127, abs=1.5)
    assert simulate_display(card, (1920, 1080), copy_threads=1).frames_per_s == pytest.approx(55, abs=0.5)


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
def test_gpus_and_their_memory(name, gpus, memory):
    assert (load(name).gpus, load(name).gpu.memory) == (gpus, memory)


@pytest.mark.parametrize(("name", "bandwidth"), [("dgx2", 270e9), ("hgx-a100", 475e9)])
def test_a_pair_behind_nvswitch_that_copies_both_ways_at_once(name, bandwidth):
    last = load(name).gpus - 1
    for one, other in ((0, 1), (0, last), (last // 2, last // 2 + 1)):
        assert both_ways(load(name), one, other) == pytest.approx(bandwidth, rel=0.005)


def test_pairs_behind_pcie_that_copy_both_ways_at_once():
    card = load("rtx-server-a40")
    by_pair = [both_ways(card, one, other) for one, other in itertools.combinations(range(card.gpus), 2)]
    assert min(by_pair) == pytest.approx(36.7e9, rel=0.005)
    assert max(by_pair) == pytest.approx(51.9e9, rel=0.005)


def fabric(card):
    return Topology(card, 1).fabric(0, 1)


@pytest.mark.parametrize("name", SINGLE)
def test_one_way_a_copy_has_the_bandwidth_of_the_card(name):
    card = load(name)
    assert NBYTES / one_way(card, 0, 1) == pytest.approx(float(fabric(card).bandwidth), rel=1e-6)


@pytest.mark.parametrize("name", SINGLE)
def test_an_empty_copy_takes_the_latency_of_the_card(name):
    card = load(name)
    assert one_way(card, 0, 1, 0.0) == pytest.approx(float(fabric(card).latency), abs=2e-12)


@pytest.mark.parametrize("name", SINGLE)
def test_a_ring_of_copies_runs_no_slower_than_a_pair_both_ways(name):
    """Every GPU sends right and receives from the left: each has one copy in each direction, as in a pair."""
    card = load(name)
    env = simpy.Environment()
    network = Machine(env, card, card.gpus).network
    env.run(env.all_of([network.transfer(i, (i + 1) % card.gpus, NBYTES) for i in range(card.gpus)]))
    slowest = min(both_ways(card, i, (i + 1) % card.gpus) for i in range(card.gpus))
    assert 2 * NBYTES / to_seconds(env.now) == pytest.approx(slowest, rel=1e-6)


def test_two_copies_to_one_gpu_share_its_way_in():
    card = load("dgx2")
    env = simpy.Environment()
    network = Machine(env, card, card.gpus).network
    env.run(env.all_of([network.transfer(source, 0, NBYTES) for source in (1, 2)]))
    assert 2 * NBYTES / to_seconds(env.now) == pytest.approx(float(fabric(card).bandwidth), rel=1e-6)
    assert network.sent_bytes == 2 * NBYTES


# Cards that make no sense


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "extends: frontera-rtx\nnvlink: {pairs: null}",
            "1:1: nvlink connects all GPUs; give its pairs, or leave one of the sections nvlink and pcie out",
        ),
        (
            "extends: frontera-rtx\nnetwork: null",
            "1:1: 22 nodes need the section network, which says what connects them",
        ),
        ("extends: rtx-server-a40\npcie: {socket_link: null}", "2:7: pcie: sockets and socket_link go together"),
        ("extends: frontera-rtx\npcie: {sockets: null}", "2:7: pcie: sockets and socket_link go together"),
        (
            "extends: rtx-server-a40\npcie: {switches: [[0, 1, 2], [4, 5, 6, 7]], uplink: 18 GB/s}",
            "1:1: pcie.switches must name each GPU from 0 to 7 once, got [[0, 1, 2], [4, 5, 6, 7]]",
        ),
        (
            "extends: frontera-rtx\npcie: {sockets: [[0, 1, 2], [2, 3]]}",
            "1:1: pcie.sockets must name each GPU from 0 to 3 once, got [[0, 1, 2], [2, 3]]",
        ),
        (
            "extends: rtx-server-a40\npcie: {switches: [[0, 1, 2, 4], [3, 5, 6, 7]], uplink: 18 GB/s}",
            "2:7: pcie: switches: the GPUs of switch 0, [0, 1, 2, 4], are at different sockets",
        ),
        (
            "extends: frontera-rtx\nnvlink: {pairs: [[0, 1, 2]]}",
            "2:9: nvlink: pairs: a bridge connects two GPUs, got [0, 1, 2]",
        ),
        (
            "extends: frontera-rtx\nnvlink: {pairs: [[3, 3]]}",
            "2:9: nvlink: pairs: a bridge connects two GPUs, got [3, 3]",
        ),
        (
            "extends: frontera-rtx\nnvlink: {pairs: [[0, 1], [1, 2]]}",
            "2:9: nvlink: pairs: a GPU is in one pair at most, got [[0, 1], [1, 2]]",
        ),
        ("extends: frontera-rtx\nnvlink: {pairs: [[0, 4]]}", "1:1: nvlink.pairs may name GPUs 0 to 3, got [[0, 4]]"),
        (
            "extends: frontera-rtx\npcie: null",
            "1:1: nvlink connects pairs only; the section pcie says how the others reach each other",
        ),
        (
            "extends: dgx2\nnvlink: null",
            "1:1: a machine with several GPUs needs one of the sections nvlink and pcie, which connect them",
        ),
        ("extends: frontera-rtx\nnetwork: {socket: 2}", "1:1: network.socket is 2, of 2 sockets from 0 on"),
        ("extends: laptop:rtx\ngpus: null", "1:1: the section gpu goes with gpus, which says how many a node has"),
        ("extends: frontera-rtx\nhost: null", "1:1: a machine with GPUs needs the section host"),
        (
            "extends: laptop\ncpu: null",
            "1:1: a machine has GPUs (gpus and the section gpu) or renders on its processors (section cpu)",
        ),
        (
            "extends: dgx2\ndisturbances:\n  - {link: gpu0.outt, share: 0.5, start: 1 ms}",
            "3:12: disturbances.0.link: there is no link 'gpu0.outt'; did you mean 'gpu0.out'?",
        ),
        (
            "extends: dgx2\ndisturbances:\n  - {link: gpu0.out, share: 0.5, start: 2 ms, end: 1 ms}",
            "3:5: disturbances.0: a disturbance ends after it has begun, got 2 ms to 1 ms",
        ),
    ],
)
def test_a_card_that_makes_no_sense(tmp_path, monkeypatch, text, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "card.yaml").write_text(f"{text}\n")
    with pytest.raises(CardError) as error:
        load_machine("card.yaml")
    assert str(error.value) == f"card.yaml:{message}"


def test_a_disturbance_from_the_command_line_names_a_link():
    with pytest.raises(CardError) as error:
        load_machine("dgx2", ["disturbances=[{link: gpu0.ou, share: 0.5, start: 1 us}]"])
    expected = "--set machine.disturbances.0.link: there is no link 'gpu0.ou'; did you mean 'gpu0.out'?"
    assert str(error.value) == expected
