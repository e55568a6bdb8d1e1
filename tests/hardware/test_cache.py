"""Caches: sequences by hand, the mappings of blocks to lines, and the misses of long streams counted in other ways."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.errors import ScheduleError
from simrender.hardware.cache import (
    HIT,
    MISS,
    NODE_BLOCK_BYTES,
    NOTHING,
    RESIDENT,
    TRIANGLE_BLOCK_BYTES,
    BlockMap,
    DirectMappedCache,
    DomainCache,
)

check = settings(deadline=None, derandomize=True, max_examples=50)

A, B, C, D = range(4)
FIGURE_2 = [A, C, A, B, D, C, A]  # what SpRay's example loads and processes, step by step

accesses = st.lists(st.integers(0, 7), max_size=60)


# Domains


def test_the_least_recently_used_domain_makes_room():
    cache = DomainCache([1.0] * 4, 2)
    assert cache.load(A) == []
    assert cache.load(B) == []
    assert cache.touch(A)  # now B is the one that was not used for longest
    assert cache.load(C) == [B]
    assert not cache.touch(B)
    assert cache.resident == [A, C]
    assert cache.load(B) == [A]
    assert (cache.hits, cache.misses, cache.evictions, cache.loaded_bytes) == (1, 4, 2, 4.0)


def test_loading_uses_a_domain_too():
    cache = DomainCache([1.0] * 3, 2)
    assert cache.replay([A, B, A, C]).tolist() == [True, True, False, True]
    assert cache.resident == [A, C]


def test_to_ask_whether_a_domain_is_there_does_not_use_it():
    cache = DomainCache([1.0] * 3, 2)
    cache.replay([A, B])
    assert A in cache
    assert C not in cache
    assert cache.load(C) == [A]
    assert cache.hits == 0


@pytest.mark.parametrize(("capacity", "loads"), [(1, 7), (2, 6), (3, 6), (4, 4), (9, 4), ("all", 4)])
def test_the_worked_example_of_spray(capacity, loads):
    """SpRay, figure 2: with room for one domain 7 loads, three more than the 4 that are required."""
    cache = DomainCache([1e9] * 4, capacity)
    assert cache.replay(FIGURE_2).sum() == cache.misses == loads
    assert cache.loaded_bytes == loads * 1e9
    assert cache.hits == len(FIGURE_2) - loads


def test_a_large_domain_drives_out_as_many_small_ones_as_it_must():
    cache = DomainCache([2.0, 3.0, 4.0, 8.0], 10.0, unit="bytes")
    cache.replay([A, B, C])
    assert cache.used_bytes == 9.0
    assert cache.load(D) == [A, B, C]
    assert cache.used_bytes == 8.0
    assert cache.load(A) == []
    assert cache.load(B) == [D]
    assert (cache.evictions, cache.loaded_bytes) == (4, 22.0)


def test_domains_that_fill_the_cache_to_the_last_byte_fit():
    cache = DomainCache([0.1] * 3, 0.1 + 0.1 + 0.1, unit="bytes")
    cache.replay([A, B, C])
    assert cache.resident == [A, B, C]


def test_rounding_does_not_pile_up():
    cache = DomainCache([0.1, 0.2, 0.3, 0.7], 1.0, unit="bytes")
    cache.replay([A, B, C, D] * 1000)
    assert cache.used_bytes == math.fsum([0.3, 0.7])


def test_a_domain_larger_than_the_cache_is_refused_and_drives_nothing_out():
    cache = DomainCache([1e9, 5e9], 2e9, unit="bytes")
    cache.load(A)
    with pytest.raises(ScheduleError, match=r"^domain 1 has 5 GB, more than the whole domain cache of 2 GB: give the "):
        cache.load(B)
    assert cache.resident == [A]
    assert (cache.misses, cache.evictions) == (1, 0)


@check
@given(accesses, st.integers(1, 8))
def test_a_domain_is_missed_if_the_cache_was_filled_by_others_since_it_was_used(domains, capacity):
    """The stack distance: least recently used keeps the domains that were used last."""
    expected = []
    for i, domain in enumerate(domains):
        before = domains[:i]
        last = i - before[::-1].index(domain) if domain in before else None
        expected.append(last is None or len(set(domains[last:i])) >= capacity)
    assert DomainCache([1.0] * 8, capacity).replay(domains).tolist() == expected


@check
@given(accesses, st.integers(1, 7))
def test_room_for_one_domain_more_never_costs_a_load(domains, capacity):
    small = DomainCache([1.0] * 8, capacity).replay(domains)
    large = DomainCache([1.0] * 8, capacity + 1).replay(domains)
    assert (large <= small).all()


@check
@given(accesses, st.lists(st.integers(1, 9), min_size=8, max_size=8), st.integers(9, 40))
def test_a_cache_of_bytes_is_never_too_full_and_its_counters_add_up(domains, nbytes, capacity):
    cache = DomainCache(nbytes, capacity, unit="bytes")
    for domain in domains:
        missed = cache.replay([domain])[0]
        assert cache.resident[-1] == domain
        assert cache.used_bytes == sum(nbytes[d] for d in cache.resident) <= capacity
        assert missed or cache.hits
    assert cache.hits + cache.misses == len(domains)
    assert len(cache.resident) == cache.misses - cache.evictions


@check
@given(accesses, st.integers(1, 8))
def test_bytes_and_domains_agree_where_all_domains_are_one_size(domains, capacity):
    by_count = DomainCache([3.0] * 8, capacity)
    by_bytes = DomainCache([3.0] * 8, 3.0 * capacity, unit="bytes")
    assert by_count.replay(domains).tolist() == by_bytes.replay(domains).tolist()
    assert by_count.resident == by_bytes.resident


@pytest.mark.parametrize(
    ("capacity", "unit", "words"),
    [
        (0, "domains", "at least 1, got 0"),
        (2.5, "domains", r"a whole number of domains, at least 1, got 2\.5"),
        (math.nan, "domains", "got nan"),
        (0.0, "bytes", r"above 0 B, got 0\.0 B"),
        (math.inf, "bytes", "finite"),
        ("most", "domains", "a number of domains or 'all', got 'most'"),
        (1, "pages", "in 'domains' or 'bytes', got 'pages'"),
    ],
)
def test_capacities_that_make_no_sense(capacity, unit, words):
    with pytest.raises(ScheduleError, match=words):
        DomainCache([1.0], capacity, unit=unit)


def test_domains_that_cannot_be_loaded():
    cache = DomainCache([1.0] * 3)
    cache.load(A)
    with pytest.raises(ScheduleError, match=r"^there is no domain 3: the domains are 0 to 2$"):
        cache.load(3)
    with pytest.raises(ScheduleError, match="there is no domain -1"):
        cache.replay([-1])
    with pytest.raises(ScheduleError, match="domain 0 is in the domain cache already: touch it"):
        cache.load(A)


# Blocks: who owns them, and where they go

ranks_and_rank = st.integers(1, 40).flatmap(lambda n: st.tuples(st.just(n), st.integers(0, n - 1)))


def test_a_block_almost_fills_8_kib():
    assert (NODE_BLOCK_BYTES, TRIANGLE_BLOCK_BYTES) == (8128, 8136)


def test_blocks_are_dealt_out_in_turn():
    blocks = BlockMap(3, 4)
    assert blocks.owner(np.arange(7)).tolist() == [0, 1, 2, 0, 1, 2, 0]
    assert blocks.slot(np.arange(7)).tolist() == [0, 0, 0, 1, 1, 1, 2]
    assert [blocks.owned_count(7, rank) for rank in range(3)] == [3, 2, 2]
    assert (blocks.owner(7), blocks.slot(7)) == (1, 2)


def test_of_two_nodes_with_two_lines_the_first_uses_only_one_with_the_mapping_of_demarle():
    """Ize et al., section 5.3."""
    others = np.array([1, 3, 5, 7])  # node 0 owns the even blocks
    assert BlockMap(2, 2, "demarle").line(others, 0).tolist() == [1, 1, 1, 1]
    assert BlockMap(2, 2, "ize").line(others, 0).tolist() == [0, 1, 0, 1]


def test_the_mapping_of_ize_by_hand():
    # Rank 1 of 3 owns 1, 4, 7: the others are numbered 0 2 3 5 6 8 from 0 to 5.
    lines = BlockMap(3, 4, root=None).line(np.arange(9), 1)
    assert lines.tolist() == [0, NOTHING, 1, 2, NOTHING, 3, 0, NOTHING, 1]


@check
@given(ranks_and_rank, st.integers(0, 500))
def test_the_mapping_of_ize_numbers_the_blocks_of_others_without_a_gap(case, count):
    ranks, rank = case
    blocks = BlockMap(ranks, max(count, 1), root=None)
    lines = blocks.line(np.arange(count), rank)
    others = lines[np.arange(count) % ranks != rank]
    assert others.tolist() == list(range(len(others)))
    assert (lines == NOTHING).sum() == blocks.owned_count(count, rank) == count - len(others)


def test_it_does_so_for_every_rank_of_every_small_machine():
    for ranks in range(1, 65):
        blocks = BlockMap(ranks, 1000, root=None)
        for rank in range(ranks):
            lines = blocks.line(np.arange(3 * ranks + 5), rank)
            assert np.array_equal(lines[lines != NOTHING], np.arange((lines != NOTHING).sum())), (ranks, rank)


@check
@given(ranks_and_rank, st.integers(1, 50), st.sampled_from(["ize", "demarle"]), st.integers(0, 60))
def test_lines_exist_and_only_blocks_that_a_rank_has_anyway_need_none(case, lines, mapping, root):
    ranks, rank = case
    blocks = BlockMap(ranks, lines, mapping, root)
    numbers = np.arange(200)
    line = blocks.line(numbers, rank)
    resident = (numbers % ranks == rank) | (numbers == root)
    assert (line[resident] == NOTHING).all()
    assert ((line[~resident] >= 0) & (line[~resident] < lines)).all()
    assert np.array_equal(blocks.resident(numbers, rank), resident)


@check
@given(st.integers(1, 40), st.integers(1, 500))
def test_every_block_has_one_place_in_one_memory(ranks, count):
    blocks = BlockMap(ranks, 1)
    numbers = np.arange(count)
    places = list(zip(blocks.owner(numbers).tolist(), blocks.slot(numbers).tolist(), strict=True))
    expected = [(rank, slot) for rank in range(ranks) for slot in range(blocks.owned_count(count, rank))]
    assert sorted(places) == expected


def test_large_numbers_of_blocks_do_not_overflow():
    blocks = BlockMap(60, 1000, root=None)
    assert blocks.line([2**62], 7).tolist() == [(2**62 - (2**62 + 53) // 60) % 1000]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((0, 4), "at least 1 rank, got 0"),
        ((2, 0), "2 ranks need at least 1 cache lines, got 0"),
        ((1, -1), "1 ranks need at least 0 cache lines, got -1"),
        ((2, 2, "izze"), "'ize' or 'demarle', got 'izze'; did you mean 'ize'?"),
    ],
)
def test_maps_that_make_no_sense(arguments, words):
    with pytest.raises(ScheduleError) as error:
        BlockMap(*arguments)
    assert words in str(error.value)


def test_ranks_and_blocks_that_do_not_exist():
    blocks = BlockMap(2, 2)
    with pytest.raises(ScheduleError, match=r"^there is no rank 2: the ranks are 0 to 1$"):
        blocks.line([0], 2)
    with pytest.raises(ScheduleError, match="there is no rank -1"):
        DirectMappedCache(blocks, -1)
    with pytest.raises(ScheduleError, match=r"^blocks are numbered from 0, got block -3$"):
        DirectMappedCache(blocks, 0).replay([1, -3])


# Blocks: streams


def test_a_stream_by_hand():
    # Rank 0 of 2 with 2 lines: it owns the even blocks; 1, 5 go to line 0 and 3, 7 to line 1.
    cache = DirectMappedCache(BlockMap(2, 2), 0)
    outcomes = cache.replay([0, 1, 3, 1, 4, 5, 1, 3])
    assert outcomes.dtype == np.int8
    assert outcomes.tolist() == [RESIDENT, MISS, MISS, HIT, RESIDENT, MISS, MISS, HIT]
    assert (cache.residents, cache.hits, cache.misses) == (2, 2, 4)
    assert cache.miss_rate == 4 / 6
    assert cache.tags.tolist() == [1, 3]


def test_with_the_mapping_of_demarle_the_same_stream_has_one_line():
    cache = DirectMappedCache(BlockMap(2, 2, "demarle"), 0)
    assert cache.replay([0, 1, 3, 1, 4, 5, 1, 3]).tolist() == [RESIDENT, MISS, MISS, MISS, RESIDENT, MISS, MISS, MISS]
    assert cache.tags.tolist() == [NOTHING, 3]


@pytest.mark.parametrize("root", [0, 5])
def test_the_root_block_is_on_every_rank(root):
    for rank in range(4):
        stream = [root, 8, 9, 10, 11, root]  # with one line only, which three of the four others take in turn
        outcomes = DirectMappedCache(BlockMap(4, 1, root=root), rank).replay(stream).tolist()
        assert outcomes[0] == outcomes[-1] == RESIDENT
        assert outcomes.count(MISS) == 3
    without = DirectMappedCache(BlockMap(4, 1, root=None), 3)
    assert without.replay([root, root]).tolist() == [MISS, HIT]


def test_own_blocks_are_always_there_and_disturb_nothing():
    cache = DirectMappedCache(BlockMap(3, 1), 2)
    assert cache.replay([1, 2, 5, 8, 1, 302, 1]).tolist() == [MISS, RESIDENT, RESIDENT, RESIDENT, HIT, RESIDENT, HIT]


def test_a_single_rank_owns_everything_and_needs_no_cache():
    cache = DirectMappedCache(BlockMap(1, 0), 0)
    assert (cache.replay(np.arange(100)) == RESIDENT).all()
    assert (cache.residents, cache.miss_rate) == (100, 0.0)


def test_the_cache_is_warm_for_the_next_frame():
    cache = DirectMappedCache(BlockMap(4, 64), 1)
    frame = np.arange(60)
    assert (cache.replay(frame) == MISS).sum() == cache.misses == 44  # but for its own 15, and the root
    assert (cache.replay(frame) == MISS).sum() == 0
    assert (cache.replay(frame + 20) == MISS).sum() == 15
    assert (cache.residents, cache.hits + cache.misses) == (16 + 16 + 15, 44 + 44 + 45)


def test_a_cache_that_holds_all_blocks_of_others_has_cold_misses_only():
    others = np.delete(np.arange(1000), np.arange(7, 1000, 10))
    cache = DirectMappedCache(BlockMap(10, len(others)), 7)
    outcomes = cache.replay(np.random.default_rng(1).permutation(np.tile(np.arange(1000), 5)))
    assert (outcomes == MISS).sum() == len(others) - 1
    assert np.array_equal(cache.tags[1:], others[1:])


def test_no_references():
    cache = DirectMappedCache(BlockMap(2, 2), 0)
    assert cache.replay([]).shape == (0,)
    assert cache.miss_rate == 0.0


def sorted_out(stream, lines):
    """Tell the outcomes from each reference's predecessor in its line, without replaying."""
    outcomes = np.full(len(stream), RESIDENT)
    cached = np.flatnonzero(lines != NOTHING)
    order = cached[np.argsort(lines[cached], kind="stable")]
    again = (lines[order][1:] == lines[order][:-1]) & (stream[order][1:] == stream[order][:-1])
    outcomes[order] = MISS
    outcomes[order[1:][again]] = HIT
    return outcomes


@check
@given(
    ranks_and_rank,
    st.integers(1, 20),
    st.sampled_from(["ize", "demarle"]),
    st.lists(st.integers(0, 80), max_size=200),
    st.integers(0, 200),
)
def test_a_stream_misses_what_its_lines_saw_something_else_before(case, lines, mapping, stream, cut):
    ranks, rank = case
    blocks = BlockMap(ranks, lines, mapping)
    expected = sorted_out(np.array(stream, np.int64), blocks.line(stream, rank))
    whole, parts = DirectMappedCache(blocks, rank), DirectMappedCache(blocks, rank)
    assert whole.replay(stream).tolist() == expected.tolist()
    assert [*parts.replay(stream[:cut]), *parts.replay(stream[cut:])] == expected.tolist()
    assert np.array_equal(whole.tags, parts.tags)
    assert (parts.residents, parts.hits, parts.misses) == (whole.residents, whole.hits, whole.misses)


@pytest.mark.parametrize(
    ("part", "demarle", "ize"),
    [(32, 0.985, 0.985), (8, 0.895, 0.894), (4, 0.774, 0.774), (2, 0.559, 0.555), (1, 0.207, 0.196)],
)
def test_uniform_references_miss_about_as_often_with_either_mapping(part, demarle, ize):
    """59 ranks, 23,600 blocks, of which a rank's own 400 and its cache make up the given part; 120,000 references.

    So the mapping alone does not explain the speed-ups that Ize et al. report (section 5.3): random references miss
    as often with one as with the other, but for the cache that holds everything.
    """
    count, ranks = 23_600, 59
    stream = np.random.default_rng(5).integers(0, count, 120_000)
    rates = {}
    for mapping in ("demarle", "ize"):
        blocks = BlockMap(ranks, count // part - count // ranks, mapping)
        cache = DirectMappedCache(blocks, 17)
        cache.replay(stream)
        rates[mapping] = cache.miss_rate
    assert rates["demarle"] == pytest.approx(demarle, abs=0.01)
    assert rates["ize"] == pytest.approx(ize, abs=0.01)


def test_uniform_references_miss_as_often_as_the_lines_are_too_few():
    """In the steady state each of the M blocks of others is equally likely to be the one of C / M in its line."""
    ranks, lines = 20, 190
    cache = DirectMappedCache(BlockMap(ranks, lines, root=None), 3)
    rng = np.random.default_rng(3)
    cache.replay(rng.integers(0, 2000, 100_000))
    cache.hits = cache.misses = 0
    cache.replay(rng.integers(0, 2000, 400_000))
    assert cache.miss_rate == pytest.approx(1.0 - lines / 1900, abs=0.002)
