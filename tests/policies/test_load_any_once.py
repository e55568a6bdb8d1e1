"""LoadAnyOnce: the real program's runs, figure 2 of SpRay, and what holds for every schedule."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import simulate
from simrender.errors import UsageError
from simrender.policies.domain_frame import domain_cache, stripes
from simrender.policies.load_any_once import LoadAnyOnce
from simrender.policies.queues import DomainQueues, fullest
from simrender.rays.crossings import Crossings
from simrender.rays.domains import from_triangles
from tests.policies.driver import WAVELETS, check_image, gardens, play, schedule, visits_of, wavelets
from tests.policies.figure2 import A, B, C, D, figure2

RANKS = [1, 2, 3, 7, 16]

# The runs of SpRay's own program: numbers as its authors' code counted them on their example scene.

PROGRAM_ORDER = [
    63, 47, 59, 62, 31, 55, 43, 61, 63, 15, 46, 51, 39, 27, 58, 60, 47, 30, 45, 59, 11, 23, 35, 54, 57, 14, 29, 44, 43,
    31, 63, 7, 19, 62, 50, 55, 56, 53, 13, 28, 3, 27, 59, 39, 47, 12, 49, 52, 23, 51, 55, 61, 46, 43, 48, 35, 39, 30,
    60, 45, 19, 31, 27, 15, 44, 29, 31, 23, 11, 27, 28, 63, 7, 23, 58, 47, 59, 54, 43, 55, 39, 57, 53, 52, 56,
]  # fmt: skip

PROGRAM_LOADS = {64: 37, 48: 37, 32: 52, 16: 78, 8: 81, 4: 85, 1: 85}

PROGRAM_TESTS = 124_862, 98_454
"""Radiance and shadow queries."""


def check_tests(counters, radiance, shadow, tolerance=0.002):
    """Rays that graze go one way here and another there: another version of Embree found them."""
    assert abs(counters.radiance_tests - radiance) <= 5
    assert counters.shadow_tests == pytest.approx(shadow, rel=tolerance)


@pytest.mark.parametrize("cache", PROGRAM_LOADS)
def test_out_of_core_loads_and_order_are_the_programs(cache):
    frame = play(LoadAnyOnce(cache=cache), wavelets())
    assert frame.counters.loads == PROGRAM_LOADS[cache]
    assert frame.counters.visits == 85
    assert schedule(frame) == PROGRAM_ORDER
    check_tests(frame.counters, *PROGRAM_TESTS)


def test_the_first_visits_test_as_many_rays_as_the_programs():
    first = play(LoadAnyOnce(cache=32), wavelets()).events[:3]
    assert [event.domain for event in first] == [63, 47, 59]
    for event, radiance, shadow in zip(first, (21_267, 10_693, 9_748), (11_945, 6_117, 5_690), strict=True):
        assert abs(event.radiance_tests - radiance) <= 5
        assert event.shadow_tests == pytest.approx(shadow, rel=0.002)


IN_SITU = {
    # ranks: visits, steps, rays sent (radiance, shadow), messages
    1: (85, 85, (0, 0), 0),
    2: (94, 61, (48_594, 0), 37),
    4: (95, 35, (88_289, 2_543), 84),
}

IN_SITU_ORDER = [
    [(1, 53), (2, 49), (3, 52), (4, 48), (5, 52), (7, 53), (8, 52), (9, 49), (10, 53), (11, 49), (14, 53), (17, 53)],
    [
        (1, 61), (2, 60), (3, 45), (4, 44), (5, 61), (6, 57), (7, 56), (8, 29), (9, 28), (10, 45), (11, 13), (12, 12),
        (13, 57), (14, 29), (15, 61), (16, 60), (17, 45), (18, 13), (19, 44), (20, 28), (21, 29), (22, 57), (23, 60),
        (24, 56),
    ],
    [
        (1, 55), (2, 51), (3, 39), (4, 55), (5, 35), (6, 54), (7, 39), (8, 23), (9, 19), (10, 50), (11, 7), (12, 23),
        (13, 3), (14, 39), (15, 55), (16, 54), (17, 51), (18, 7), (19, 35), (20, 55), (21, 19), (22, 23), (23, 39),
        (24, 55),
    ],
    [
        (1, 63), (2, 47), (3, 59), (4, 62), (5, 31), (6, 43), (7, 63), (8, 15), (9, 46), (10, 27), (11, 58), (12, 47),
        (13, 30), (14, 59), (15, 11), (16, 43), (17, 14), (18, 31), (19, 63), (20, 62), (21, 27), (22, 47), (23, 59),
        (24, 46), (25, 30), (26, 31), (27, 43), (28, 15), (29, 31), (30, 11), (31, 27), (32, 63), (33, 58), (34, 47),
        (35, 43),
    ],
]  # fmt: skip


@pytest.mark.parametrize("ranks", IN_SITU)
def test_in_situ_rounds_and_messages_are_the_programs(ranks):
    frame = play(LoadAnyOnce("in_situ"), wavelets(), ranks)
    visits, steps, sent, messages = IN_SITU[ranks]
    assert frame.counters.visits == visits
    assert max(event.step for event in frame.events) + 1 == steps
    assert frame.counters.messages == messages
    assert frame.counters.sent_rays == pytest.approx(sum(sent), rel=1e-3)
    assert frame.counters.sent_bytes == 96.0 * frame.counters.sent_rays
    check_tests(frame.counters, *PROGRAM_TESTS)


def test_four_ranks_take_their_domains_in_the_programs_order():
    frame = play(LoadAnyOnce("in_situ"), wavelets(), 4)
    taken = [[(event.step + 1, event.domain) for event in frame.events if event.rank == rank] for rank in range(4)]
    program = [list(order) for order in IN_SITU_ORDER]
    # There 127 rays waited for each of these; here one that grazes makes it 128 and 127.
    assert program[1][19:21] == [(20, 28), (21, 29)]
    program[1][19:21] = [(20, 29), (21, 28)]
    assert taken == program


@pytest.mark.parametrize(
    ("ranks", "visits", "steps", "messages", "sent"), [(2, 82, 52, 41, 45_887), (4, 92, 31, 91, 88_994)]
)
def test_in_situ_with_the_domain_map_of_the_program_as_it_was_built(ranks, visits, steps, messages, sent):
    # The version of a library that it was built with left all Morton codes 0, and its sort equal keys in this order.
    order = [48, *range(33, 48), 32, *range(49, 64), 16, *range(1, 16), 0, *range(17, 32)]
    owner = np.empty(64, np.int64)
    owner[order] = np.arange(64) * ranks // 64
    frame = play(LoadAnyOnce("in_situ"), wavelets(), ranks, owner=owner)
    assert (frame.counters.visits, frame.counters.messages) == (visits, messages)
    assert max(event.step for event in frame.events) + 1 == steps
    assert frame.counters.sent_rays == pytest.approx(sent, rel=1e-3)


OCCLUSION = "integrator={name: ambient_occlusion, samples: 8, random_numbers: spray_program}"
OCCLUSION_LOADS = {64: 52, 32: 80, 16: 148, 8: 160}


@pytest.mark.parametrize("cache", OCCLUSION_LOADS)
def test_ambient_occlusion_loads_are_the_programs_within_3_percent(cache):
    # The rays are those of the program but for roundings. Random numbers of one's own give 49 to 57, 79 to 98, 132 to
    # 156 and 148 to 165 loads with seeds 1 to 8: fifteen domains are met by less than thirty of 570,000 rays.
    frame = play(LoadAnyOnce(cache=cache), wavelets(OCCLUSION))
    assert frame.counters.loads == pytest.approx(OCCLUSION_LOADS[cache], rel=0.03)
    assert frame.counters.visits == pytest.approx(165, rel=0.03)
    check_tests(frame.counters, 124_862, 731_892)


@pytest.mark.parametrize(
    ("owner", "visits", "steps", "messages", "sent"),
    [(None, 176, 103, 75, 59_942), (np.repeat([1, 0], 32), 159, 101, 64, 56_721)],
    ids=["Morton blocks", "as the program was built"],
)
def test_ambient_occlusion_in_situ_is_the_programs_within_3_percent(owner, visits, steps, messages, sent):
    frame = play(LoadAnyOnce("in_situ"), wavelets(OCCLUSION), 2, owner=owner)
    assert frame.counters.visits == pytest.approx(visits, rel=0.03)
    assert max(event.step for event in frame.events) + 1 == pytest.approx(steps, rel=0.03)
    assert frame.counters.messages == pytest.approx(messages, rel=0.03)
    assert frame.counters.sent_rays == pytest.approx(sent, rel=1e-3)
    check_tests(frame.counters, 124_862, 731_892)


def test_the_simulation_counts_what_the_driver_of_these_tests_counts():
    result = simulate("stampede2-skx", WAVELETS, LoadAnyOnce("in_situ"), nodes=4, islands=1)
    frame = play(LoadAnyOnce("in_situ"), wavelets(), 4)
    for name in ("visits", "radiance_tests", "shadow_tests", "messages", "sent_rays", "sent_bytes"):
        assert result.counts[name] == getattr(frame.counters, name)
    assert result.frame_time_s == pytest.approx(frame.env.now / 1e12, rel=1e-9)


# Figure 2 of SpRay, from real triangles


def test_out_of_core_figure_2_loads_seven_domains_of_which_four_are_necessary():
    frame = play(LoadAnyOnce(cache=1), figure2())
    assert schedule(frame) == [A, C, A, B, D, C, A]
    assert frame.counters.loads == 7
    assert [moment.waiting.tolist() for moment in frame.moments] == [
        [3, 0, 0, 0],  # r0, r1 and r2 wait for A
        [0, 1, 2, 0],
        [1, 1, 0, 1],  # s2 for A, r0 for B, r1 for D
        [0, 1, 0, 1],
        [0, 0, 0, 2],
        [0, 0, 1, 0],  # s1 for C
        [1, 0, 0, 0],
    ]
    assert play(LoadAnyOnce(), figure2()).counters.loads == 4


def test_in_situ_figure_2_takes_five_steps_at_35_percent_utilization():
    frame = play(LoadAnyOnce("in_situ"), figure2(), 4, owner=np.arange(4))
    steps = [[event.domain for event in frame.events if event.step == step] for step in range(5)]
    assert [sorted(domains) for domains in steps] == [[A], [B, C], [A, D], [C], [A]]
    assert len(frame.events) / (4 * 5) == 0.35
    assert frame.counters.sent_rays == 3 + 3 + 1 + 1
    check_image(frame)


def test_figure_2_spawns_its_two_shadow_rays_and_lights_one_pixel():
    crossings = figure2()
    visits = visits_of(crossings)
    walks = [visits.domain[slice(*visits.first[ray : ray + 2])].tolist() for ray in range(crossings.trace.rays)]
    assert walks == [[A, B, D], [A, C, D], [A, C], [D, C, A], [C, A]]
    assert crossings.trace.reference[0].any(axis=1).tolist() == [False, False, True]


# What holds for every schedule

POLICIES = st.builds(
    LoadAnyOnce,
    st.sampled_from(["out_of_core", "in_situ", "global"]),
    cache=st.integers(1, 14),
    prefer_cached=st.booleans(),
)


@given(gardens(), POLICIES, st.sampled_from(RANKS), st.data())
@settings(max_examples=30, deadline=None)
def test_every_ray_is_retired_once_and_tested_as_often(crossings, policy, ranks, data):
    count = crossings.domains.count
    owner = np.array(data.draw(st.lists(st.integers(0, ranks - 1), min_size=count, max_size=count)))
    frame = play(policy, crossings, ranks, owner=owner)
    check_image(frame)
    assert frame.counters.radiance_tests + frame.counters.shadow_tests == visits_of(crossings).tests
    assert (frame.position == frame.visits.last).all()
    assert not frame.outbox


@given(gardens(), st.sampled_from(RANKS))
@settings(max_examples=15, deadline=None)
def test_loads_are_at_least_the_domains_touched_and_never_rise_with_a_larger_cache(crossings, ranks):
    count = crossings.domains.count
    frames = [play(LoadAnyOnce(cache=cache), crossings, ranks) for cache in (*range(1, count), "all")]
    touched = len({(event.rank, event.domain) for event in frames[0].events})
    loads = [frame.counters.loads for frame in frames]
    assert loads == sorted(loads, reverse=True)
    assert loads[-1] == touched
    assert loads[0] <= frames[0].counters.visits
    events = [[replace(event, loaded=False) for event in sorted(f.events, key=lambda e: e.rank)] for f in frames]
    assert all(other == events[0] for other in events)


@pytest.mark.parametrize("ranks", [3, 16])
def test_a_rank_out_of_core_does_what_it_would_do_alone(ranks):
    crossings = wavelets()
    frame = play(LoadAnyOnce(cache=4), crossings, ranks)
    stripe = stripes(crossings.trace.size, ranks)
    for rank in (ranks // 3, ranks // 2):
        alone = play(LoadAnyOnce(cache=4), crossings, 1, pixels=np.where(stripe == rank, 0, -1))
        assert [replace(event, rank=rank) for event in alone.events] == [e for e in frame.events if e.rank == rank]
        assert len(alone.events) > 0


def test_the_last_stripe_takes_the_lines_that_are_left():
    assert stripes((1, 7), 3).tolist() == [2, 2, 2, 1, 1, 0, 0]  # from the top; rank 0 begins at the bottom
    assert stripes((1, 2), 3).tolist() == [1, 0]


def test_a_rank_with_no_domain_idles_through_the_rounds():
    frame = play(LoadAnyOnce("in_situ"), figure2(), 3, owner=np.array([0, 0, 2, 2]))
    assert {event.rank for event in frame.events} == {0, 2}
    check_image(frame)


def test_one_owner_of_all_does_the_work_of_one_rank():
    crossings = figure2()
    frame = play(LoadAnyOnce("in_situ"), crossings, 3, owner=np.full(4, 1))
    assert schedule(frame, 1) == schedule(play(LoadAnyOnce(), crossings))


def test_domains_that_nobody_enters_are_never_visited():
    crossings = figure2()
    domains, far = crossings.domains, np.float32(50.0)
    owner = domains.domain_of_triangle + np.array([0, 1, 1, 2])[domains.domain_of_triangle]
    more = from_triangles(crossings.trace.scene.triangles, owner, 7, 7e6, 7e3)
    low, high = more.low.copy(), more.high.copy()
    low[[0, 2, 3, 5]], high[[0, 2, 3, 5]] = domains.low, domains.high
    low[1], high[1] = far, far + 1  # somewhere else, and 4 and 6 are empty
    entered = Crossings(crossings.trace, replace(more, low=low, high=high))
    for policy, ranks in ((LoadAnyOnce(cache=1), 1), (LoadAnyOnce("in_situ"), 7), (LoadAnyOnce("global"), 16)):
        frame = play(policy, entered, ranks)
        assert {event.domain for event in frame.events} == {0, 2, 3, 5}
        check_image(frame)


def test_a_cached_domain_goes_first_if_asked_to():
    usual = play(LoadAnyOnce(cache=4), wavelets())
    cached = play(LoadAnyOnce(cache=4, prefer_cached=True), wavelets())
    assert cached.counters.loads < usual.counters.loads
    assert cached.counters.shadow_tests == usual.counters.shadow_tests
    check_image(cached)


def test_global_rounds_give_the_fullest_domain_to_rank_0():
    frame = play(LoadAnyOnce("global", cache=1), figure2(), 2)
    rounds = [[(e.rank, e.domain) for e in sorted(frame.events, key=lambda e: e.rank) if e.step == s] for s in range(5)]
    assert rounds == [[(0, A)], [(0, C), (1, B)], [(0, D), (1, A)], [(0, C)], [(0, A)]]
    assert frame.counters.loads == 7


# The queues


def test_queues_keep_the_order_in_which_rays_came():
    queues = DomainQueues(3)
    queues.put(np.array([5, 1, 4]), np.array([2, 0, 2], np.int16))
    queues.put(np.array([3]), np.array([2], np.int16))
    assert queues.counts.tolist() == [1, 0, 3]
    assert queues.take(2).tolist() == [5, 4, 3]
    assert queues.counts.tolist() == [1, 0, 0]
    assert queues.take(2).tolist() == []
    assert queues.any()


def test_the_fullest_of_equal_queues_is_the_lowest():
    counts = np.array([1, 3, 0, 3])
    assert fullest(counts) == 1
    assert fullest(counts, [3, 2]) == 3
    assert fullest(counts, [3, 1]) == 1
    assert fullest(counts, [2]) is None
    assert fullest(counts, []) is None
    assert fullest(np.zeros(4, np.int64)) is None


def test_a_cache_is_so_many_domains_a_share_of_them_or_a_size():
    nbytes = [3e9, 1e9, 2e9, 2e9]
    assert [domain_cache(given, nbytes).capacity for given in (3, "3", 9, "50%", "1%", "all")] == [3, 3, 4, 2, 1, 4]
    by_size = domain_cache("5 GB", nbytes)
    assert (by_size.capacity, by_size.unit) == (5e9, "bytes")
    assert by_size.replay([0, 2, 1]).all()
    assert by_size.resident == [2, 1]
    for wrong in (0, "0", "0%", "101%", "-1 GB", "0 B", "many", "3 s"):
        with pytest.raises(ValueError, match=r"^expected a "):
            domain_cache(wrong, nbytes)
    with pytest.raises(ValueError, match=r"^the largest domain takes 3 GB with its acceleration structure$"):
        domain_cache("2.5 GB", nbytes)


def test_a_cache_of_a_size_holds_what_fits():
    crossings = wavelets()
    size = sum(crossings.domains.bytes.tolist())
    whole, every = (play(LoadAnyOnce(cache=cache), crossings) for cache in (f"{size:.0f} B", "all"))
    assert whole.counters == every.counters
    loads = [play(LoadAnyOnce(cache=f"{share * size:.0f} B"), crossings).counters.loads for share in (0.5, 0.25, 0.1)]
    assert every.counters.loads < loads[0] < loads[1] < loads[2] <= 85
    result = simulate("stampede2-skx", WAVELETS, LoadAnyOnce(cache="5 GB"), nodes=1)
    assert result.memory["model_bytes"] == 5e9
    with pytest.raises(UsageError, match=r"^policy.cache=1 B: the largest domain takes "):
        simulate("stampede2-skx", WAVELETS, LoadAnyOnce(cache="1 B"), nodes=1)


def test_the_busy_share_over_time_is_what_the_ranks_compute():
    result = simulate("stampede2-skx", WAVELETS, LoadAnyOnce("in_situ"), nodes=4, islands=1)
    assert len(result.busy_over_time) == 100
    assert np.mean(result.busy_over_time) == pytest.approx(np.mean(list(result.utilization.values())), rel=1e-6)
    assert 0.0 <= min(result.busy_over_time) < max(result.busy_over_time) <= 1.0
