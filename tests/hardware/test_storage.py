"""Storage: reads, loads and block fetches worked by hand, and fetches whose threads get in each other's way."""

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.errors import LinkFailedError, ScheduleError, UnreachableError, UsageError
from simrender.hardware.cache import HIT, MISS, NODE_BLOCK_BYTES, RESIDENT, BlockMap, DirectMappedCache
from simrender.hardware.network import Link, Network
from simrender.hardware.storage import (
    BlockFetcher,
    DiskCard,
    ParallelFileSystemCard,
    Storage,
    StorageCard,
    storage_links,
)

SECOND = TICKS_PER_SECOND
GB = 1e9
check = settings(deadline=None, derandomize=True, max_examples=50)

SHARED = {
    "server_bandwidth": "6 GB/s",
    "targets": 8,
    "target_bandwidth": "1 GB/s",
    "client_bandwidth": "4 GB/s",
    "open_latency": "0.5 s",
    "stripe": "1 GB",
    "stripe_count": 2,
}
LOCAL = {"bandwidth": "2 GB/s", "latency": "0.25 s", "capacity": "100 GB"}


def shared(**changes):
    return StorageCard(shared=ParallelFileSystemCard(**SHARED | changes))


def both(**changes):
    return StorageCard(shared=ParallelFileSystemCard(**SHARED | changes), local=DiskCard(**LOCAL))


def make(card, nodes=4):
    """Return storage with nothing between its own links and the nodes' memory."""
    env = simpy.Environment()
    routes = {}
    for node in range(nodes):
        if card.shared:
            routes["storage", ("host", node)] = ["storage", f"node{node}.client"]
        if card.local:
            routes[("disk", node), ("host", node)] = [f"node{node}.disk"]
    routes[("host", 0), "gpu"] = ["bus"]
    return env, Storage(env, Network(env, storage_links(card, nodes) | {"bus": Link(2.0 * GB)}, routes), card)


def read_alone(card, nbytes, **options):
    """Return in seconds how long one read takes."""
    env, storage = make(card)
    return env.run(storage.read(0, nbytes, **options)) / SECOND


# The cards


def test_the_links_of_storage():
    links = storage_links(both(), 2)
    assert links == {
        "storage": Link(6 * GB),
        "node0.client": Link(4 * GB),
        "node1.client": Link(4 * GB),
        "node0.disk": Link(2 * GB),
        "node1.disk": Link(2 * GB),
    }
    assert list(storage_links(StorageCard(local=DiskCard(**LOCAL)), 1)) == ["node0.disk"]
    assert list(storage_links(shared(), 1)) == ["storage", "node0.client"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"stripe_count": 9}, "stripe_count (9) is more than there are targets (8)"),
        ({"stripe": "0 B"}, "a stripe must be larger than nothing, got 0 B"),
        ({"targets": 0}, "greater than or equal to 1"),
        ({"targets": 2.5}, "valid integer"),
        ({"server_bandwidth": "0 B/s"}, "must be more than 0"),
    ],
)
def test_file_systems_that_make_no_sense(changes, words):
    with pytest.raises(ValidationError) as error:
        shared(**changes)
    assert words in str(error.value)


def test_storage_is_somewhere():
    with pytest.raises(ValidationError, match="at least one of the sections shared and local"):
        StorageCard()


# Reads


@pytest.mark.parametrize(
    ("nbytes", "options", "seconds"),
    [
        (8 * GB, {}, 0.5 + 4.0),  # two targets
        (8 * GB, {"stripe_count": 1}, 0.5 + 8.0),
        (8 * GB, {"stripe_count": 4}, 0.5 + 2.0),
        (8 * GB, {"stripe_count": 8}, 0.5 + 2.0),  # as much as one node gets
        (3 * GB, {"stripe_count": 8}, 0.5 + 1.0),  # three stripes on as many targets
        (1 * GB, {"stripe_count": 8}, 0.5 + 1.0),
        (1 * GB + 1, {"stripe_count": 8}, 0.5 + 0.5 + 0.5e-9),  # a second stripe begins
        (0.25 * GB, {}, 0.5 + 0.25),
        (0.0, {}, 0.5),
        (8 * GB, {"start": 3 * SECOND}, 3.0 + 0.5 + 4.0),
        (8 * GB, {"where": "local"}, 0.25 + 4.0),
        (0.0, {"where": "local", "start": SECOND}, 1.0 + 0.25),
    ],
)
def test_a_read_alone(nbytes, options, seconds):
    assert read_alone(both(), nbytes, **options) == pytest.approx(seconds, abs=2e-12)


def test_the_servers_can_be_slower_than_a_node():
    assert read_alone(shared(server_bandwidth="1.5 GB/s"), 3 * GB, stripe_count=8) == 0.5 + 2.0


def test_two_nodes_share_the_servers():
    env, storage = make(shared())
    reads = [storage.read(node, 8 * GB, stripe_count=8) for node in (0, 1)]
    env.run()
    # 4 GB/s each would be 8 of the servers' 6: 3 each.
    assert [read.value for read in reads] == [SECOND // 2 + to_ticks(8 / 3)] * 2
    assert (storage.reads, storage.read_bytes) == (2, 16 * GB)


def test_a_node_that_reads_from_few_targets_leaves_the_servers_to_others():
    env, storage = make(shared())
    narrow = storage.read(0, 4 * GB, stripe_count=1)
    wide = storage.read(1, 8 * GB, stripe_count=8)
    late = storage.read(2, 1 * GB, stripe_count=8, start=SECOND // 2)
    env.run()
    # From 0.5 s: 1 and 4 GB/s, within the 6 of the servers. At 1.0 s: 1, 2.5 and a third read that its only stripe
    # holds to 1: 1, 4, 1.
    assert [read.value / SECOND for read in (narrow, wide, late)] == [4.5, 2.5, 2.0]


def test_two_reads_of_one_node_share_what_it_gets():
    env, storage = make(shared(server_bandwidth="100 GB/s"))
    reads = [storage.read(0, 8 * GB, stripe_count=8), storage.read(0, 4 * GB, stripe_count=8)]
    elsewhere = storage.read(1, 8 * GB, stripe_count=8)
    env.run()
    # 2 GB/s each; when the short one is done, the long one's last 4 GB go at 4 GB/s.
    assert [read.value / SECOND for read in reads] == [3.5, 2.5]
    assert elsewhere.value / SECOND == 2.5


def test_many_nodes_take_as_long_as_the_servers_need():
    env, storage = make(shared(), nodes=48)
    for node in range(48):
        storage.read(node, 3 * GB)
    env.run()
    assert env.now / SECOND == pytest.approx(0.5 + 48 * 3 / 6)


def test_disks_belong_to_their_nodes():
    env, storage = make(both())
    reads = [storage.read(node, 4 * GB, where="local") for node in (0, 0, 1)]
    env.run()
    assert [read.value / SECOND for read in reads] == [4.25, 4.25, 2.25]


@check
@given(st.floats(0.0, 64 * GB), st.integers(1, 8), st.integers(1, 8))
def test_more_targets_never_slow_a_read(nbytes, one, other):
    few, many = sorted((one, other))
    assert read_alone(shared(), nbytes, stripe_count=many) <= read_alone(shared(), nbytes, stripe_count=few)


@pytest.mark.parametrize(
    ("card", "options", "error", "words"),
    [
        (shared(), {"where": "local"}, UsageError, "the machine has no local disk (it has a parallel file system: "),
        (
            StorageCard(local=DiskCard(**LOCAL)),
            {},
            UsageError,
            "no parallel file system (it has a local disk: 'local')",
        ),
        (both(), {"where": "locl"}, ScheduleError, "'shared' or 'local' storage, got 'locl'; did you mean 'local'?"),
        (both(), {"stripe_count": 9}, ScheduleError, "spread over 1 to 8 targets, got stripe_count 9"),
        (both(), {"stripe_count": 0}, ScheduleError, "got stripe_count 0"),
        (both(), {"stripe_count": 2, "where": "local"}, ScheduleError, "no stripes, got stripe_count 2"),
        (both(), {"nbytes": 101 * GB, "where": "local"}, ScheduleError, "101 GB cannot lie on node 0's disk of 100 GB"),
        (both(), {"nbytes": -1.0}, ScheduleError, "finite and not negative, got -1.0 B"),
        (both(), {"nbytes": float("nan")}, ScheduleError, "got nan B"),
        (both(), {"node": 4}, UnreachableError, "no route 'storage' -> ('host', 4)"),
        (both(), {"start": -1}, ScheduleError, "a read cannot start at tick -1, before now, tick 0"),
    ],
)
def test_reads_that_cannot_be(card, options, error, words):
    _, storage = make(card)
    with pytest.raises(error) as raised:
        storage.read(**{"node": 0, "nbytes": 1.0} | options)
    assert words in str(raised.value)
    assert storage.reads == 0


# Loads


class Queue:
    """A processor that does one thing after the other."""

    def __init__(self):
        self.free_at = 0

    def run(self, seconds, not_before):
        begin = max(self.free_at, not_before)
        self.free_at = begin + to_ticks(seconds)
        return begin, self.free_at


def on(processor):
    """It parses 4 GB/s and builds from 10 million primitives a second."""
    return (processor, 4.0 * GB), (processor, 1e7)


def phases(times):
    return [
        ticks / SECOND
        for ticks in (times.open_ticks, times.read_ticks, times.wait_ticks, times.parse_ticks, times.build_ticks)
    ]


def test_a_load_opens_reads_parses_and_builds():
    env, storage = make(shared())
    times = env.run(env.process(storage.load(0, 8 * GB, 3e7, *on(Queue()))))
    assert phases(times) == [0.5, 4.0, 0.0, 2.0, 3.0]
    assert times.built == env.now == 19 * SECOND // 2


def test_a_gpu_builds_what_the_cores_of_the_host_have_parsed():
    env, storage = make(shared())
    cores, gpu = Queue(), Queue()
    gpu.run(20.0, 0)
    load = storage.load(0, 8 * GB, 3e7, (cores, 4.0 * GB), (gpu, 1e7), device="gpu")
    times = env.run(env.process(load))
    assert phases(times) == [0.5, 4.0, 9.5, 2.0, 3.0]
    assert times.copy_ticks == 4 * SECOND
    assert (cores.free_at, gpu.free_at) == (13 * SECOND // 2, 23 * SECOND)


def test_a_load_ahead_waits_for_a_processor_that_traces():
    env, storage = make(both())
    processor = Queue()
    processor.run(10.0, 0)
    load = env.process(storage.load(1, 8 * GB, 1e7, *on(processor), where="local", start=2 * SECOND))
    times = env.run(load)
    assert times.began == 2 * SECOND
    assert phases(times) == [0.25, 4.0, 3.75, 2.0, 1.0]
    assert env.now == 13 * SECOND


def test_two_loads_share_the_network_and_then_queue_for_the_processor():
    env, storage = make(shared())
    processor = Queue()
    loads = [env.process(storage.load(0, 4 * GB, 1e7, *on(processor), stripe_count=8)) for _ in range(2)]
    env.run()
    assert [phases(load.value) for load in loads] == [[0.5, 2.0, 0.0, 1.0, 1.0], [0.5, 2.0, 2.0, 1.0, 1.0]]


def test_a_domain_without_primitives_has_nothing_to_build():
    env, storage = make(shared())
    assert phases(env.run(env.process(storage.load(0, 0.0, 0.0, *on(Queue()))))) == [0.5, 0.0, 0.0, 0.0, 0.0]


@check
@given(st.floats(0.0, 64 * GB), st.floats(0.0, 1e9), st.integers(0, 10 * SECOND), st.floats(0.0, 20.0))
def test_the_phases_of_a_load_add_up(nbytes, primitives, start, busy):
    env, storage = make(shared())
    processor = Queue()
    processor.run(busy, 0)
    times = env.run(env.process(storage.load(0, nbytes, primitives, *on(processor), start=start)))
    ticks = (
        times.open_ticks,
        times.read_ticks,
        times.wait_ticks,
        times.parse_ticks,
        times.copy_ticks,
        times.build_ticks,
    )
    assert min(ticks) >= 0
    assert start + sum(ticks) == times.built == env.now


def test_a_load_of_fewer_primitives_than_none_is_refused():
    env, storage = make(shared())
    with pytest.raises(ScheduleError, match=r"primitives must be finite and not negative, got -1\.0"):
        env.run(env.process(storage.load(0, 1.0, -1.0, *on(Queue()))))


# Blocks

GET = 1.5  # seconds: a quarter there, a quarter back, and one for the bytes


def make_fetcher(lines, ranks=2, rank=0, mapping="ize", root=None):
    """Return a rank whose wires to each other rank carry a block a second."""
    env = simpy.Environment()
    pairs = [(i, j) for i in range(ranks) for j in range(ranks) if i != j]
    network = Network(env, {pair: Link(NODE_BLOCK_BYTES, 0.25) for pair in pairs}, {pair: [pair] for pair in pairs})
    cache = DirectMappedCache(BlockMap(ranks, lines, mapping, root), rank)
    return env, BlockFetcher(env, network, cache, range(ranks)), network


def thread(env, fetcher, name, start, script, log):
    """Hold (block, seconds) one after the other; log when each was there, and how."""
    yield env.timeout(to_ticks(start))
    for block, seconds in script:
        asked = env.now
        outcome = yield from fetcher.fetch(name, block)
        log.append((name, block, env.now / SECOND, outcome, env.now - asked))
        cache = fetcher.cache
        line = cache.blocks.line([block], cache.rank)[0]
        yield env.timeout(to_ticks(seconds))
        assert line < 0 or cache.tags[line] == block  # nobody took the line away meanwhile
    fetcher.release(name)


def run_threads(env, fetcher, scripts):
    """Run (name, start, script) threads to the end; return their log without what they waited."""
    log = []
    for name, start, script in scripts:
        env.process(thread(env, fetcher, name, start, script, log))
    env.run()
    assert sum(entry[4] for entry in log) == fetcher.fetch_ticks + fetcher.wait_ticks
    return [entry[:4] for entry in log]


def test_a_get_pays_the_latency_there_and_back():
    env, fetcher, network = make_fetcher(4)
    assert run_threads(env, fetcher, [("a", 0, [(1, 0)])]) == [("a", 1, GET, MISS)]
    assert (fetcher.fetches, fetcher.fetched_bytes, network.sent_bytes) == (1, NODE_BLOCK_BYTES, NODE_BLOCK_BYTES)
    assert network.carried_bytes[1, 0] == NODE_BLOCK_BYTES  # from the owner
    assert network.carried_bytes[0, 1] == 0.0


def test_what_is_there_takes_no_time():
    env, fetcher, network = make_fetcher(4, root=3)
    log = run_threads(env, fetcher, [("a", 0, [(1, 1), (3, 0), (2, 0), (1, 0), (1, 0)])])
    outcomes = [MISS, RESIDENT, RESIDENT, HIT, HIT]
    assert log == [("a", block, GET + (i > 0), outcomes[i]) for i, block in enumerate([1, 3, 2, 1, 1])]
    assert (fetcher.fetches, network.flows_finished) == (1, 1)


def test_threads_that_want_the_same_block_wait_for_one_fetch():
    env, fetcher, _ = make_fetcher(4)
    log = run_threads(env, fetcher, [("a", 0, [(1, 1)]), ("b", 0.5, [(1, 1)]), ("c", 1, [(1, 1)])])
    assert log == [("a", 1, GET, MISS), ("b", 1, GET, HIT), ("c", 1, GET, HIT)]
    assert (fetcher.fetches, fetcher.joins, fetcher.waits) == (1, 2, 0)
    assert fetcher.fetch_ticks == 3 * SECOND


def test_a_line_is_not_replaced_while_a_thread_reads_it():
    """One line, so blocks 1, 3 and 5 exclude each other."""
    env, fetcher, _ = make_fetcher(1)
    log = run_threads(
        env,
        fetcher,
        [
            ("a", 0, [(1, 3)]),  # there at 1.5, holds it until 4.5
            ("b", 0, [(1, 1), (3, 1)]),  # lets go of 1 at 2.5, waits for a until 4.5, has 3 from 6 to 7
            ("c", 2, [(1, 1)]),  # reads along
            ("d", 3, [(3, 2)]),  # waits behind b and reads along with it, from 6 to 8
            ("e", 3.5, [(5, 0)]),  # waits for both, until 8
        ],
    )
    assert log == [
        ("a", 1, 1.5, MISS),
        ("b", 1, 1.5, HIT),
        ("c", 1, 2.0, HIT),
        ("b", 3, 6.0, MISS),
        ("d", 3, 6.0, HIT),
        ("e", 5, 9.5, MISS),
    ]
    assert (fetcher.fetches, fetcher.joins, fetcher.waits) == (3, 2, 3)
    assert fetcher.wait_ticks == (2.0 + 1.5 + 4.5) * SECOND
    assert fetcher.fetch_ticks == 5 * GET * SECOND
    assert (fetcher.cache.hits, fetcher.cache.misses) == (3, 3)


def test_a_line_can_be_wanted_for_another_block_while_its_own_is_on_its_way():
    env, fetcher, _ = make_fetcher(1)
    log = run_threads(env, fetcher, [("a", 0, [(1, 1)]), ("b", 1, [(3, 1)]), ("c", 1, [(1, 1)])])
    assert log == [("a", 1, 1.5, MISS), ("c", 1, 1.5, HIT), ("b", 3, 4.0, MISS)]
    assert (fetcher.waits, fetcher.wait_ticks) == (1, 3 * SECOND // 2)


def test_two_threads_that_want_each_others_lines_both_go_on():
    """Because each lets go of its current block before it asks for the next (Ize et al., section 5.3.1)."""
    env, fetcher, _ = make_fetcher(2, ranks=3)  # 1 and 4 go to line 0, 2 and 5 to line 1
    log = run_threads(env, fetcher, [("a", 0, [(1, 1), (5, 1)]), ("b", 0, [(2, 1), (4, 1)])])
    assert (fetcher.waits, fetcher.wait_ticks) == (1, 0)  # b lets go at the tick at which a asks
    assert [entry[2] for entry in log] == [1.5, 1.5, 4.0, 4.0]


def test_the_mapping_of_demarle_lets_threads_collide_where_that_of_ize_does_not():
    threads = [("a", 0, [(1, 1)]), ("b", 0, [(3, 1)])]
    # One after the other, or both at once over one wire.
    for mapping, waits, last in (("demarle", 1, GET + 1 + GET), ("ize", 0, GET + 1)):
        env, fetcher, _ = make_fetcher(2, mapping=mapping)
        assert run_threads(env, fetcher, threads)[-1][2] == last
        assert fetcher.waits == waits


def test_the_next_frame_finds_a_warm_cache():
    env, fetcher, network = make_fetcher(4)
    fetcher.cache.replay([1, 3])
    again = BlockFetcher(env, network, fetcher.cache, range(2))
    assert run_threads(env, again, [("a", 0, [(1, 0), (3, 0), (5, 0)])])[-1] == ("a", 5, GET, MISS)
    assert again.fetches == 1


def test_two_ranks_share_what_leaves_the_owner():
    env = simpy.Environment()
    links = {"out": Link(NODE_BLOCK_BYTES), "in": Link(1e9)}
    routes = {(2, 0): ["out"], (2, 1): ["out"], (0, 2): ["in"], (1, 2): ["in"]}
    network = Network(env, links, routes)
    blocks, log = BlockMap(3, 4), []
    for rank in range(2):
        fetcher = BlockFetcher(env, network, DirectMappedCache(blocks, rank), range(3))
        env.process(thread(env, fetcher, rank, 0, [(2, 0)], log))
    env.run()
    assert [entry[:4] for entry in log] == [(0, 2, 2.0, MISS), (1, 2, 2.0, MISS)]


def test_if_a_link_fails_under_a_fetch_the_simulation_ends():
    env, fetcher, network = make_fetcher(4)
    network.disturb((1, 0), 0.0, SECOND)
    with pytest.raises(LinkFailedError, match="is down at 1 s"):
        run_threads(env, fetcher, [("a", 0, [(1, 0)])])


def test_fetches_that_cannot_be():
    env, fetcher, network = make_fetcher(4)
    with pytest.raises(ScheduleError, match=r"^2 ranks need as many endpoints, got 3$"):
        BlockFetcher(env, network, fetcher.cache, range(3))
    with pytest.raises(ScheduleError, match=r"^blocks are numbered from 0, got block -1$"):
        next(fetcher.fetch("a", -1))
    next(fetcher.fetch("a", 1))
    for act in (lambda: next(fetcher.fetch("a", 3)), lambda: fetcher.release("a")):
        with pytest.raises(ScheduleError, match=r"^thread 'a' waits for block 1: until it is there"):
            act()
    fetcher.release("b")  # holds nothing, and may say so


# Many threads

script = st.lists(st.tuples(st.integers(0, 20), st.integers(0, 4).map(lambda q: q / 4)), max_size=12)
scripts = st.lists(st.tuples(st.integers(0, 8).map(lambda q: q / 4), script), min_size=1, max_size=6)
mappings = st.sampled_from(["ize", "demarle"])


@check
@given(scripts, st.integers(1, 4), st.integers(2, 3), mappings)
def test_every_fetch_ends_and_no_line_holds_two_blocks(threads, lines, ranks, mapping):
    env, fetcher, network = make_fetcher(lines, ranks, 1, mapping, 0)
    under_way, most, transfer = [], [0], network.transfer

    def watched(*args, **kwargs):
        done = transfer(*args, **kwargs)
        under_way.append(done)
        most[0] = max(most[0], len(under_way))
        done.callbacks.append(under_way.remove)
        return done

    network.transfer = watched
    log = run_threads(env, fetcher, [(name, start, script) for name, (start, script) in enumerate(threads)])
    for name, (_, script) in enumerate(threads):
        assert [entry[1] for entry in log if entry[0] == name] == [block for block, _ in script]
    assert most[0] <= min(len(threads), lines)
    cache = fetcher.cache
    assert fetcher.fetches == cache.misses == network.flows_finished
    assert cache.residents + cache.hits + cache.misses == len(log)
    assert fetcher.fetched_bytes == fetcher.fetches * NODE_BLOCK_BYTES


@check
@given(script, st.integers(1, 4), mappings)
def test_a_single_thread_misses_what_a_replay_of_its_stream_misses(script, lines, mapping):
    env, fetcher, _ = make_fetcher(lines, mapping=mapping, root=0)
    log = run_threads(env, fetcher, [("a", 0, script)])
    cache = DirectMappedCache(fetcher.cache.blocks, 0)
    assert [entry[3] for entry in log] == cache.replay([block for block, _ in script]).tolist()
    assert (fetcher.waits, fetcher.joins) == (0, 0)
    assert env.now == to_ticks(sum(seconds for _, seconds in script) + GET * cache.misses)


@check
@given(scripts, st.integers(1, 4))
def test_the_same_threads_take_the_same_course_again(threads, lines):
    named = [(name, start, script) for name, (start, script) in enumerate(threads)]
    logs = []
    for _ in range(2):
        env, fetcher, _ = make_fetcher(lines)
        logs.append(run_threads(env, fetcher, named))
    assert logs[0] == logs[1]
