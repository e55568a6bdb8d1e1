"""Distributed cache ray tracing: every pixel once, blocks that travel, warm caches, and what holds a frame back."""

import dataclasses

import numpy as np
import pytest
import simpy

from simrender.camera_path import _block_sizes, simulate_frames
from simrender.cards import Document
from simrender.catalog import find_card
from simrender.errors import UsageError
from simrender.hardware.cache import BlockMap, DirectMappedCache
from simrender.hardware.machine import Machine, load_machine
from simrender.policies.distributed_cache import Cluster, DistributedCache, RenderNode
from simrender.policies.tiles import Stream, TiledFrame, in_turns, tile_frame
from simrender.rays.blocks import block_hierarchy, references
from simrender.rays.workload import load_workload
from tests.scenes import garden_workload

MACHINE = "manta-cluster"


@pytest.fixture(scope="module")
def garden():
    return garden_workload()


def interface(*overrides):
    """The Richtmyer-Meshkov stand-in, small."""
    sizes = ["scene.arguments.points=48", "published.resolution=384x216", "traced.resolution=192x108"]
    return load_workload("rm-isosurface", [*sizes, *overrides])


@pytest.fixture(scope="module")
def layers():
    """The same with a camera that stands still."""
    return interface("camera.path=[]")


def run(workload, nodes=6, frames=1, machine=MACHINE, **parameters):
    return simulate_frames(machine, workload, DistributedCache(**parameters), frames, nodes=nodes)


def seconds(result):
    return [frame.frame_time_s for frame in result.frames]


# Every pixel once


@pytest.mark.parametrize(
    "parameters",
    [
        {"cache": "40%"},
        {"cache": "40%", "tile": 8, "packets": 1},
        {"cache": "40%", "tile": 500, "static": 0.0},
        {"cache": "40%", "tile": 16, "static": 1.0, "packets": 13, "threads": 1},
        {"cache": "40%", "threads": 3, "warm_up": 0, "display": False},
        {"cache": "100%", "mapping": "demarle", "fetches": "single"},
        {"cache": "all", "warm_up": 2},
    ],
)
@pytest.mark.parametrize("nodes", [3, 8])
def test_the_image_is_that_of_the_reference(garden, parameters, nodes):
    if nodes == 3 and parameters["cache"] == "40%":
        parameters = parameters | {"cache": "70%"}
    result = run(garden, nodes=nodes, **parameters)
    trace = garden.frame(0, 1).trace(1)
    trace.complete()
    assert np.array_equal(result.images[0], trace.reference)
    assert result.frames[0].published_rays == trace.rays
    assert result.frames[0].tiles == -(-96 // _side(parameters)) * -(-64 // _side(parameters))


def _side(parameters):
    return max(8, round(parameters.get("tile", 64) / 8) * 8)


def test_runs_are_equal_to_the_bit(garden):
    one, two = (run(garden, frames=2, cache="40%") for _ in range(2))
    assert one.to_dict() == two.to_dict()
    assert one.event_log_sha256 == two.event_log_sha256
    assert run(garden, frames=2, cache="40%", tile=32).event_log_sha256 != one.event_log_sha256


def test_tiles_and_streams():
    stream = Stream(np.array([0, 2, 2, 5]), np.array([7, 8, 1, 2, 3], np.int32))
    turned = stream.taken(np.array([2, 1, 0]))
    assert turned.first.tolist() == [0, 3, 3, 5]
    assert turned.block.tolist() == [1, 2, 3, 7, 8]


def test_threads_refer_in_turns():
    first = np.array([0, 2, 3, 3, 7, 8])
    assert in_turns(first, 1, 1).tolist() == in_turns(first, 9, 3).tolist() == list(range(8))
    assert in_turns(first, 1, 2).tolist() == [0, 2, 1, 3, 4, 5, 6, 7]
    assert in_turns(first, 2, 2).tolist() == [0, 3, 1, 4, 2, 5, 6, 7]
    assert in_turns(first, 1, 8).tolist() == [0, 2, 3, 7, 1, 4, 5, 6]
    assert in_turns(first[:1], 2, 2).tolist() == []
    rng = np.random.default_rng(3)
    first = np.concatenate([[0], np.cumsum(rng.integers(0, 9, 100))])
    packet = np.repeat(np.arange(100), np.diff(first))
    step = np.arange(first[-1]) - first[packet // 3 * 3]
    assert np.array_equal(in_turns(first, 3, 5), np.lexsort((packet // 3, step, packet // 15)))


def test_a_frame_is_cut_into_tiles(garden):
    trace = garden.trace(1)
    written = garden.scene.triangles
    refers = references(trace, lambda: block_hierarchy(written.vertices, written.faces))
    frame = tile_frame(trace, refers, (960, 640), 320, (1.0, 10.0), 3, True)
    assert frame.tiles == 6  # 32 x 32 traced pixels each
    assert np.diff(frame.first).tolist() == [16 * 100] * 6
    assert frame.pixels.tolist() == [64] * (96 * 100)
    kind = trace.column("kind")
    assert frame.seconds.sum() == pytest.approx(300.0 * ((kind == 0).sum() + 10.0 * (kind != 0).sum()))
    assert np.array_equal(np.sort(np.concatenate(frame.rays)), np.arange(trace.rays))
    # The second tile's first packet is the fifth of the image's first row.
    assert (np.diff(frame.streams[0].first)[1600:1700] == refers.node_first[5] - refers.node_first[4]).all()


def test_each_copy_of_a_packet_has_blocks_of_its_own_but_for_the_upper_ones(garden):
    trace = garden.trace(1)
    written = garden.scene.triangles
    refers = references(trace, lambda: block_hierarchy(written.vertices, written.faces, 16, 8), 16, 8)
    scaled, full = (tile_frame(trace, refers, (192, 128), 64, (1.0, 1.0), 1, scaled) for scaled in (True, False))
    upper, lower = refers.upper.sum(), (~refers.upper).sum()
    assert 0 < upper < refers.node_blocks
    assert scaled.blocks == (upper + 4 * lower, 4 * refers.triangle_blocks)
    assert full.blocks == (refers.node_blocks, refers.triangle_blocks)
    numbers = np.concatenate([[0], np.cumsum(np.where(refers.upper, 1, 4))])
    for stream, same in zip(scaled.streams, full.streams, strict=True):
        assert np.array_equal(stream.first, same.first)
        copies = [stream.block[stream.first[k] : stream.first[k + 1]] for k in range(4)]
        whole = same.block[same.first[0] : same.first[1]]
        if stream is scaled.streams[0]:
            assert [refers.upper[b] for b in whole.tolist()] == [len(set(b)) == 1 for b in zip(*copies, strict=True)]
        for k, copy in enumerate(copies):
            start, shared = (4 * whole, False) if stream is scaled.streams[1] else (numbers[whole], refers.upper[whole])
            assert np.array_equal(copy, np.where(shared, start, start + k))


def test_the_last_uses_of_blocks_leave_a_cache_as_all_references_do():
    rng = np.random.default_rng(7)
    stream = Stream(np.sort(rng.integers(0, 4000, 101)) // 40 * 40, rng.integers(0, 300, 4000).astype(np.int32))
    stream.first[0], stream.first[-1] = 0, 4000
    runs = np.array([0, 13, 13, 60, 100])
    uses = stream.last_uses(runs, 300)
    assert len(uses.block) < 4000
    order = np.array([2, 0, 3, 1, 2])
    ends = stream.first[runs]
    whole, short = (DirectMappedCache(BlockMap(5, 16), 3) for _ in range(2))
    for run in order:
        whole.replay(stream.block[ends[run] : ends[run + 1]])
    short.replay(uses.taken(order).block)
    assert np.array_equal(whole.tags, short.tags)
    parts = [uses.block[uses.first[k] : uses.first[k + 1]] for k in range(4)]
    assert [sorted(part) for part in parts] == [
        sorted(set(stream.block[ends[k] : ends[k + 1]].tolist())) for k in range(4)
    ]


# Worked by hand


class Alone:
    """A cluster of two render nodes and one thread each, with a frame written by hand."""

    def __init__(self, node_blocks, pixels=(64, 64), lines=4, **parameters):
        count = len(pixels)
        of_packet = [np.array(blocks, np.int32) for blocks in node_blocks]
        first = np.concatenate([[0], np.cumsum([len(blocks) for blocks in of_packet])])
        empty = Stream(np.zeros(count + 1, np.int64), np.zeros(0, np.int32))
        frame = TiledFrame(
            np.arange(count + 1), np.array(pixels), np.full(count, 1e-3),
            (Stream(first, np.concatenate(of_packet)), empty), (8, 0), [np.array([k]) for k in range(count)],
        )  # fmt: skip
        self.env = simpy.Environment()
        card = load_machine(MACHINE)
        self.machine = Machine(self.env, card, 3)
        settings = {"cache": "50%", "threads": 1, "warm_up": 0, "tile": 8} | parameters
        policy = DistributedCache(**settings)
        self.cluster = Cluster(self.env, self.machine, policy, [frame], (lines, lines), None)
        nodes = [RenderNode(self.cluster, rank) for rank in range(2)]
        self.env.run(self.env.all_of([self.env.process(policy.node(node)) for node in nodes]))
        self.counts = self.cluster.counts[0]

    def spans(self, kind):
        table = self.cluster.timeline.frame()
        return [tuple(row) for row in table[table.kind == kind][["device", "start_s", "end_s", "bytes"]].to_numpy()]


@pytest.mark.parametrize("fetches", ["grouped", "single"])
def test_a_thread_pays_for_one_get_after_the_other(fetches):
    # Rank 0 owns the even blocks, rank 1 the odd ones; the root, block 0, is everywhere.
    made = Alone([[0, 1, 2, 3], [0, 1]], fetches=fetches)
    latency, block = 1.8e-6, 8128 / 1958739968.0
    assert (made.counts.residents, made.counts.hits, made.counts.misses) == (4, 0, 2)
    assert made.counts.fetched_bytes == 2 * 8128
    ((device, start, end, nbytes),) = made.spans("load")
    assert device == "node0.thread0"
    assert start == pytest.approx(1e-5 + 1e-3)  # to wake the threads, and to trace
    assert end - start == pytest.approx(2 * (2 * latency + block), rel=1e-3)
    assert nbytes == 2 * 8128


def test_threads_take_several_packets_at_a_time():
    made = Alone([[0, 1, 3], [0, 1], [0, 5], [0], [0], [0]], pixels=(64,) * 6, packets=2, static=1.0)
    assert made.counts.misses == 3
    assert [span[3] / 8128 for span in made.spans("load")] == [2, 1]  # of the first two packets, and of the third
    traced = [end - start for device, start, end, _ in made.spans("trace") if device == "node0.thread0"]
    assert traced == pytest.approx([2e-3, 1e-3])


@pytest.mark.parametrize("fetches", ["grouped", "single"])
def test_two_blocks_in_one_line_drive_each_other_out(fetches):
    # Under the mapping of Ize et al. rank 0 numbers blocks 1, 3, 5, 7 as 0, 1, 2, 3.
    assert Alone([[0, 1, 3, 1, 3], [0]], lines=2, fetches=fetches).counts.misses == 2
    assert Alone([[0, 1, 5, 1, 5], [0]], lines=2, fetches=fetches).counts.misses == 4
    # Under DeMarle's, rank 0 of two never uses an even line.
    assert Alone([[0, 1, 3, 1, 3], [0]], lines=2, mapping="demarle", fetches=fetches).counts.misses == 4


def test_tiles_are_dealt_to_who_asks():
    made = Alone([[0]] * 12, pixels=(64,) * 12, static=0.5)
    assert sorted(made.counts.packets) == list(range(12))
    assert made.counts.tiles == 12
    assert made.counts.requests == 6 + 2  # and one more each, in vain
    busy = made.counts.trace_ticks
    assert busy[0] == busy[1]
    slow = Alone([[0]] * 12, pixels=(64,) * 12, static=1.0)
    assert slow.counts.requests == 2


def test_threads_of_a_node_wait_for_one_request():
    made = Alone([[0]] * 40, pixels=(64,) * 40, static=0.0, threads=4)
    assert made.counts.tiles == 40
    assert made.counts.requests <= 38 + 2


# Caches


def test_fewer_misses_with_more_cache_and_a_warm_one(layers):
    rates, cold = [], []
    for cache in ("15%", "30%", "60%", "100%"):
        result = run(layers, nodes=9, cache=cache, static=1.0, blocks="full", settled=False)
        rates.append(result.miss_rate)
        cold.append(result.cold.miss_rate)
        assert result.miss_rate < result.cold.miss_rate
    assert rates == sorted(rates, reverse=True)
    assert cold == sorted(cold, reverse=True)
    assert rates[-1] == 0.0  # 1/1 has a line for every block
    assert rates[0] > 0.0


def test_settled_caches_have_what_many_frames_bring(layers):
    parameters = {"nodes": 9, "cache": "60%", "warm_up": 0, "static": 0.25, "tile": 8, "packets": 1, "threads": 2}
    cold = run(layers, frames=30, **parameters, blocks="full", settled=False)
    rates = [frame.miss_rate for frame in cold.frames]
    first = run(layers, **parameters, blocks="full")
    assert first.miss_rate < 0.7 * rates[0]
    assert first.miss_rate == pytest.approx(np.mean(rates[20:]), rel=0.15)
    # With all lines that there are blocks, nothing that the image shows is ever missed again.
    assert run(layers, nodes=9, cache="100%", warm_up=0).frames[0].misses == 0
    assert run(layers, nodes=9, cache="100%", warm_up=0, settled=False).frames[0].misses > 0


def test_nodes_settle_on_the_tiles_they_begin_with(layers):
    result = run(layers, nodes=9, cache="60%", static=1.0, warm_up=0)
    warm = run(layers, nodes=9, cache="60%", static=1.0, warm_up=3)
    assert result.frames[0].misses == pytest.approx(warm.frames[0].misses, rel=0.1)  # of the same tiles


def test_a_path_has_as_many_frames_as_its_card_says():
    def images(path_frames, frames, warm_up):
        result = run(interface(f"camera.path_frames={path_frames}"), frames=frames, warm_up=warm_up, cache="60%")
        return [frame.image_sha256 for frame in result.frames]

    five = images(5, 5, 0)
    assert len(set(five)) == 5
    assert images(5, 2, 0) == five[:2]
    assert images(5, 2, 2) == five[2:4]  # those that warm up come first
    assert images(9, 3, 0)[::2] == five[:2]
    assert images(3, 3, 2) == five[2:]  # there are not enough: the path is flown in as many as there have to be
    assert images("null", 3, 2) == five[::2]  # from its beginning to its end, and the first one warms up
    replicated = run(interface("camera.path_frames=5"), frames=2, warm_up=2, cache="all")
    assert [frame.image_sha256 for frame in replicated.frames] == five[1:3]  # there is nothing to warm


def test_demarles_mapping_wastes_lines(layers):
    parameters = {"cache": "100%", "static": 1.0, "blocks": "full", "nodes": 5}
    ize, demarle = (run(layers, mapping=mapping, **parameters) for mapping in ("ize", "demarle"))
    assert ize.miss_rate == 0.0 < demarle.miss_rate
    assert demarle.frames_per_s < ize.frames_per_s


def test_replicated_data_are_never_fetched(layers):
    result = run(layers, cache="all")
    assert result.cold is None
    assert result.frames[0].misses == 0
    assert result.frames[0].residents == result.frames[0].references > 0
    assert result.frames[0].fetched_bytes == 0.0
    assert result.memory["needed_bytes"] == result.memory["data_bytes"]


def test_fetched_bytes_cross_the_network(layers):
    result = run(layers, cache="30%", display=False, warm_up=0, frames=1)
    frame = result.frames[0]
    assert 8128 <= frame.fetched_bytes / frame.misses <= 8136
    carried = sum(link["carried_bytes"] for name, link in result.links.items() if name.endswith("nic.in"))
    assert carried == pytest.approx(frame.fetched_bytes + 2 * 32 * frame.requests, rel=1e-9)


def test_a_camera_that_moves_finds_new_blocks(layers):
    moving = interface("camera.path_frames=4")
    result = run(moving, nodes=9, frames=4, warm_up=0, cache="100%", blocks="full")
    assert result.frames[0].misses == 0
    assert min(frame.misses for frame in result.frames[1:]) > 0
    assert len({frame.image_sha256 for frame in result.frames}) == 4
    assert result.frames_per_s == pytest.approx(4 / sum(seconds(result)))


def test_scaled_blocks_are_as_many_as_the_weight_says():
    workload = interface("published.resolution=1920x1080")
    trace, triangles = workload.trace(1), workload.scene.instanced_triangles
    assert _block_sizes(workload, trace, DistributedCache(blocks="full")) == (254, 226)
    nodes, each = _block_sizes(workload, trace, DistributedCache())
    assert nodes % 2 == 0
    assert triangles / each == pytest.approx(316e6 / 226 / 100, rel=0.1)
    whole = garden_workload()
    assert _block_sizes(whole, whole.trace(1), DistributedCache()) == (254, 226)


@pytest.mark.parametrize(("threads", "error"), [(1, 0.01), (8, 0.15)])
def test_groups_of_gets_cost_about_what_single_ones_do(garden, threads, error):
    for cache in ("70%", "100%"):
        parameters = {"cache": cache, "threads": threads, "display": False, "warm_up": 0, "static": 1.0, "tile": 16}
        grouped, single = (run(garden, fetches=fetches, **parameters) for fetches in ("grouped", "single"))
        assert seconds(grouped)[0] == pytest.approx(seconds(single)[0], rel=error)
        if threads == 1:
            assert grouped.frames[0].misses == single.frames[0].misses


# What holds a frame back (figure 6 of the paper)


def test_replicated_data_scale_until_the_display_binds(layers):
    large = interface("published.resolution=960x540", "camera.path=[]")
    policy = DistributedCache(packets=8, tile=32)
    rates = {n: simulate_frames(MACHINE, large, policy, 3, nodes=n + 1).frames_per_s for n in (1, 4, 16)}
    assert rates[4] / rates[1] == pytest.approx(4.0, rel=0.05)
    assert rates[16] / rates[1] == pytest.approx(16.0, rel=0.1)
    machine = load_machine(MACHINE, ["cpu.core_coherent_rate=10 Mray/s"])
    bound = simulate_frames(machine, large, policy, 5, nodes=30).frames_per_s
    free = simulate_frames(machine, large, dataclasses.replace(policy, display=False), 5, nodes=30).frames_per_s
    assert 300.0 < bound < 508.0  # the pixels of 127 frames/s of four times the size fill the adapter
    assert free > 1.2 * bound


def test_a_small_cache_slows_what_sees_much_of_the_data(layers):
    parameters = {"nodes": 17, "frames": 2, "warm_up": 3, "blocks": "full", "static": 1.0}
    rates = [run(layers, cache=cache, **parameters).frames_per_s for cache in ("all", "50%", "8%")]
    assert rates[0] > rates[1] > rates[2]


def test_faster_links_and_processors():
    workload = garden_workload()
    base = run(workload, cache="40%", display=False, static=1.0)
    wide = load_machine(MACHINE, ["network.bandwidth=20 GB/s", "network.latency=0.2 us"])
    assert run(workload, cache="40%", display=False, static=1.0, machine=wide).frames_per_s > base.frames_per_s
    doubled = [
        "network.bandwidth=3736 MiB/s", "network.latency=0.9 us", "mpi.overhead=0.25 us", "cpu.launch_latency=5 us",
        "cpu.core_coherent_rate=1 Mray/s", "cpu.core_incoherent_rate=0.474 Mray/s",
    ]  # fmt: skip
    twice = run(workload, cache="40%", display=False, static=1.0, machine=load_machine(MACHINE, doubled))
    assert twice.frames_per_s == pytest.approx(2.0 * base.frames_per_s, rel=1e-5)


# Users


def test_the_policy_is_read_from_a_document():
    document = Document("{cache: 12.5%, tile: 32, mapping: demarle}", "policy.yaml")
    assert document.validate(DistributedCache) == DistributedCache("12.5%", "demarle", tile=32)


def test_what_cannot_be_is_refused(garden, layers):
    def refused(words, workload=garden, **parameters):
        with pytest.raises(UsageError, match=words):
            run(workload, **parameters)

    refused("needs a node for its master", nodes=1)
    refused("a single render node has all data", nodes=2, cache="50%")
    refused("each of 5 render nodes has 20% of the data for good, which leaves no line", cache="20%")
    refused(r"policy.cache=110%: expected a share of the data such as 12.5%", cache="110%")
    refused(r"policy.cache=much: expected a share", cache="much")
    refused("policy.threads=9: a node of Manta cluster .* has 8 cores", threads=9)
    refused("expected 1 or more", frames=0)
    refused("renders on GPUs", machine="frontera-rtx")
    refused("has no section display", machine="stampede2-skx", nodes=6, display=True)
    volume = load_workload("dns")
    refused("is a volume", volume)


def test_data_that_do_not_fit_are_not_simulated(layers):
    small = load_machine(MACHINE, ["cpu.memory=4 GiB"])
    result = run(layers, cache="all", machine=small)
    assert not result.feasible
    assert result.frames == []
    assert run(layers, cache="10%", nodes=20, machine=small).feasible


def test_a_size_is_a_share_of_the_published_data(layers):
    result = run(layers, cache="8 GB")
    assert result.memory["needed_bytes"] == pytest.approx(8e9)
    assert 17e9 < result.memory["data_bytes"] < 24e9  # 21,326 MB in the paper
    assert result.to_dict()["frames"][0]["miss_rate"] == result.frames[0].miss_rate


def test_the_card_says_what_the_result_hangs_on(layers):
    paths = [entry["path"] for entry in run(layers, cache="50%").uncalibrated]
    assert "machine.cpu.core_coherent_rate" in paths
    assert "machine.display.copy_bandwidth" in paths
    assert find_card("machine", MACHINE).name == MACHINE
