"""Speculation: the real program's runs, figure 2 of SpRay worked out by hand, and what holds for every guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.errors import InvariantError
from simrender.policies.blocking import equal_tiles, program_tiles
from simrender.policies.history import HistoryBuffer, bounces, check_lit
from simrender.policies.load_any_once import LoadAnyOnce
from simrender.policies.speculation import Speculation
from simrender.rays.domains import rectilinear, uniform_grid
from simrender.rays.integrators import AmbientOcclusion, PathTracing, RayCasting, SprayPathTracing
from simrender.rays.speculative import ray_tree
from simrender.simulation import simulate
from tests.policies.driver import check_image, gardens, play, schedule, wavelets
from tests.policies.figure2 import A, B, C, D, figure2
from tests.policies.layers import by_object, layers

RANKS = [1, 2, 3, 7, 16]

PINNED = [48, *range(33, 48), 32, *range(49, 64), 16, *range(1, 16), 0, *range(17, 32)]
"""Domains in the order in which the program dealt them to ranks when a library left all Morton codes 0."""


def path_tracing(bounces: int) -> str:
    return (
        f"integrator={{name: spray_path_tracing, shadow_samples: 1, bounces: {bounces}, random_numbers: spray_program}}"
    )


SMALL = (path_tracing(3), "traced={resolution: 128x128}", "published={resolution: 128x128, samples: 1}")

OCCLUSION = "integrator={name: ambient_occlusion, samples: 8, random_numbers: spray_program}"


# The runs of SpRay's own program


@pytest.mark.parametrize("like_program", [False, True])
@pytest.mark.parametrize(("cache", "loads"), [(64, 37), (48, 37), (32, 48), (16, 58), (8, 58), (4, 58), (1, 58)])
def test_out_of_core_loads_are_the_programs(cache, loads, like_program):
    frame = play(Speculation(cache=cache, history_depth=4, like_program=like_program), wavelets())
    counters = frame.counters
    assert (counters.loads, counters.visits, counters.rounds) == (loads, 58, 2)
    assert abs(counters.radiance_tests - 124_862) <= 5
    assert counters.shadow_tests == pytest.approx(94_701, rel=0.002)
    assert abs(counters.radiance_queued - 362_460) <= 5
    assert abs(counters.radiance_filtered - 237_598) <= 5
    assert counters.shadow_queued == pytest.approx(39_318, rel=0.002)
    assert counters.shadow_filtered == pytest.approx(15_129, rel=0.002)
    assert counters.rejected_hits == counters.wrong_rays == counters.spilled_rays == 0
    check_image(frame)


@pytest.mark.parametrize(("cache", "loads"), [(64, 55), (32, 91), (8, 91)])
def test_ambient_occlusion_loads_are_the_programs(cache, loads):
    counters = play(Speculation(cache=cache), wavelets(OCCLUSION)).counters
    assert counters.loads == pytest.approx(loads, rel=0.03)
    assert counters.visits == pytest.approx(91, rel=0.03)
    assert counters.shadow_tests == pytest.approx(732_134, rel=0.002)


@pytest.mark.parametrize(
    ("ranks", "pinned", "shadow_tests", "messages", "sent"),
    [
        (1, False, 233_584, 0, 0),
        (2, False, 233_584, 57, 224_025),
        (4, False, 235_639, 107, 363_354),
        (2, True, 235_740, 51, 158_096),
        (4, True, 241_128, 106, 282_935),
    ],
)
def test_in_situ_messages_and_tests_are_the_programs(ranks, pinned, shadow_tests, messages, sent):
    owner = np.empty(64, np.int64)
    owner[PINNED] = np.arange(64) * ranks // 64
    policy = Speculation("in_situ", like_program=True)
    frame = play(policy, wavelets(), ranks, owner=owner if pinned else None)
    counters = frame.counters
    assert (counters.steps, counters.messages) == (2, messages)
    assert counters.sent_rays == pytest.approx(sent, rel=1e-3)
    assert counters.sent_bytes == 64.0 * counters.sent_rays + 16.0 * messages
    assert abs(counters.radiance_tests - 362_460) <= 5
    assert counters.shadow_tests == pytest.approx(shadow_tests, rel=0.002)
    assert counters.wrong_rays == pytest.approx(135_130, rel=0.001)
    buffers = (1_048_576.0, 32_768.0) if ranks > 1 else (0.0, 0.0)
    assert (counters.tbuf_bytes, counters.obuf_bytes) == buffers
    check_image(frame)


@pytest.mark.parametrize(
    ("pinned", "messages", "sent", "tests"), [(False, 120, 260_751, 1_842_270), (True, 104, 194_352, 1_844_842)]
)
def test_in_situ_ambient_occlusion_is_the_programs(pinned, messages, sent, tests):
    owner = np.repeat([1, 0], 32) if pinned else None
    counters = play(Speculation("in_situ"), wavelets(OCCLUSION), 2, owner=owner).counters
    assert counters.messages == pytest.approx(messages, rel=0.03)
    assert counters.sent_rays == pytest.approx(sent, rel=1e-3)
    assert counters.shadow_tests == pytest.approx(tests, rel=0.002)
    assert counters.obuf_bytes == 262_144.0


def test_three_bounces_combine_the_buffers_three_times_each_in_four_rounds():
    counters = play(Speculation("in_situ"), wavelets(*SMALL), 2).counters
    assert counters.rounds == 4
    assert (counters.tbuf_bytes, counters.obuf_bytes) == (3 * 65_536.0, 3 * 2_048.0)


# Figure 2 of SpRay, worked out by hand


def test_out_of_core_figure_2_loads_five_domains():
    # r0 waits for A, B and D, r1 for A, C and D, r2 for A and C. Nearer domains weigh more: A 3*16, C 2*15, D 2*14,
    # B 15. In C r2 spawns s2, which waits for A; in D r1 spawns s1, which waits for C and A. In the second round A
    # (15 + 14) goes before C (15) and occludes s1, so that nothing is left to do in C.
    frame = play(Speculation(cache=1), figure2())
    assert schedule(frame) == [A, C, D, B, A]
    assert [moment.waiting.tolist() for moment in frame.moments] == [
        [3, 1, 2, 2],
        [0, 1, 2, 2],
        [1, 1, 0, 2],
        [2, 1, 1, 0],
        [2, 0, 1, 0],
    ]
    assert [(event.radiance_tests, event.shadow_tests) for event in frame.events] == [
        (3, 0), (2, 1), (2, 1), (1, 0), (0, 2),
    ]  # fmt: skip
    assert (frame.counters.loads, frame.counters.rounds, frame.counters.shadow_filtered) == (5, 2, 1)
    check_image(frame)


def test_in_situ_figure_2_takes_two_steps_at_75_percent_utilization():
    # All rays go everywhere at once; then s2 goes from C to A, and s1 from D to A and C.
    frame = play(Speculation("in_situ"), figure2(), 4, owner=np.arange(4))
    steps = [sorted(event.domain for event in frame.events if event.step == step) for step in range(2)]
    assert steps == [[A, B, C, D], [A, C]]
    assert len(frame.events) / (4 * 2) == 0.75
    assert (frame.counters.sent_rays, frame.counters.messages) == (5 + 3, 3 + 3)
    check_image(frame)


def test_figure_2_keeps_what_its_rays_queues_and_buffer_take():
    # Most is held when D has been processed: r0, r1, r2, s1, s2, and entries of r0 in B, s2 in A, s1 in A and C.
    frame = play(Speculation(), figure2())
    entries = max(sum(moment.waiting.tolist()) for moment in frame.moments[:1])
    rays, queues, buffer = 3 * (64 + 4), entries * 16, 3 * 4
    assert frame.peak_bytes[0] >= rays + queues + buffer
    assert frame.peak_bytes[0] == max(3 * 68 + 8 * 16, 4 * 68 + 6 * 16, 5 * 68 + 4 * 16) + buffer


# What holds for every guess

POLICIES = st.builds(
    Speculation,
    st.sampled_from(["out_of_core", "in_situ"]),
    cache=st.integers(1, 14),
    history_depth=st.sampled_from([None, 1, 2, 3, 4, 5]),
    tiles=st.sampled_from([1, 2, 5]),
    like_program=st.booleans(),
)


@given(gardens(), POLICIES, st.sampled_from(RANKS), st.data())
@settings(max_examples=25, deadline=None)
def test_every_true_ray_is_retired_once_and_no_wrong_one(crossings, policy, ranks, data):
    count = crossings.domains.count
    owner = np.array(data.draw(st.lists(st.integers(0, ranks - 1), min_size=count, max_size=count)))
    frame = play(policy, crossings, ranks, owner=owner)
    check_image(frame)
    counters = frame.counters
    assert counters.radiance_tests + counters.shadow_tests == sum(
        event.radiance_tests + event.shadow_tests for event in frame.events
    )
    assert counters.radiance_filtered <= counters.radiance_queued
    assert all(peak >= 0.0 for peak in frame.peak_bytes)


@given(gardens(), st.integers(1, 5), st.sampled_from([1, 3]))
@settings(max_examples=6, deadline=None)
def test_loads_never_rise_with_a_larger_cache(crossings, history_depth, ranks):
    count = crossings.domains.count
    frames = [
        play(Speculation(cache=c, history_depth=history_depth), crossings, ranks) for c in (*range(1, count), "all")
    ]
    loads = [frame.counters.loads for frame in frames]
    assert loads == sorted(loads, reverse=True)
    assert loads[-1] == len({(event.rank, event.domain) for event in frames[0].events})
    assert len({frame.counters.visits for frame in frames}) == 1


def test_three_bounces_load_as_many_domains_as_the_programs():
    # Once its history begins with no hit, as the paper means it; as it stands the program loses rays and loads 44.
    frame = play(Speculation(history_depth=4, like_program=True), wavelets(path_tracing(3)))
    assert (frame.counters.loads, frame.counters.rounds) == (63, 4)
    check_image(frame)


@pytest.mark.parametrize("history_depth", [1, 2, 3, 4])
def test_a_history_buffer_spills_the_rays_that_are_deeper(history_depth):
    frame = play(Speculation(history_depth=history_depth), wavelets(*SMALL))
    check_image(frame)
    assert (frame.counters.spilled_rays > 0) == (history_depth < 3)
    usual = play(Speculation(), wavelets(*SMALL))
    if history_depth >= 3:
        assert frame.counters.radiance_tests == usual.counters.radiance_tests
    else:
        assert frame.counters.wrong_rays < usual.counters.wrong_rays


def test_speculation_loads_less_than_load_any_once_for_shadow_rays_out_of_core():
    for cache in (32, 16, 8, 4):
        guessed, safe = (play(policy(cache=cache), wavelets()).counters for policy in (Speculation, LoadAnyOnce))
        assert guessed.loads < safe.loads


@pytest.mark.parametrize("data", ["out_of_core", "in_situ"])
def test_a_frame_replays_alike_whatever_others_spawned_before(data):
    policy = Speculation(data)
    first = play(policy, figure2())
    crossings = wavelets(*SMALL)
    before = play(policy, crossings, 3)
    play(Speculation(history_depth=1), crossings, 2)
    again = play(policy, crossings, 3)
    assert again.counters == before.counters
    assert again.events == before.events
    assert again.timeline.sha256() == before.timeline.sha256()
    assert play(policy, figure2()).events == first.events


# Hard cases


ALL = [Speculation(history_depth=1), Speculation(), Speculation(history_depth=6), Speculation("in_situ")]


@pytest.mark.parametrize("policy", ALL)
@pytest.mark.parametrize("copies", [2, 3])
def test_equal_hits_in_several_domains_resolve_to_the_traces(policy, copies):
    crossings = layers(SprayPathTracing(2, 4), [0.0, -1.0, -2.0], by_object, copies)
    for ranks in (1, 3):
        frame = play(policy, crossings, ranks)
        check_image(frame)
        assert frame.counters.wrong_rays > 0 or not policy.in_situ


@pytest.mark.parametrize("policy", ALL)
@pytest.mark.parametrize("integrator", [SprayPathTracing(2, 3), AmbientOcclusion(4)], ids=["PT", "AO"])
def test_rays_that_are_born_on_a_face_of_two_domains(policy, integrator):
    # The squares at 0 and -2 lie in the planes between cells.
    def cut(scene):
        low, high = scene.bounds
        return rectilinear(scene.triangles, uniform_grid(low, high, (1, 1, 2)), 1e6, 1e3)

    crossings = layers(integrator, [0.0, -1.0, -2.0, -3.0, -4.0], cut)
    check_image(play(policy, crossings, 2))


@pytest.mark.parametrize("policy", ALL)
def test_rays_through_more_domains_than_have_a_weight(policy):
    crossings = layers(SprayPathTracing(1, 2), np.linspace(0.0, -9.0, 24), by_object)
    assert np.diff(crossings.table(0)["first"]).max() > 16
    check_image(play(policy, crossings, 3))


def test_a_frame_in_which_nothing_is_hit_has_one_round_and_no_light():
    crossings = layers(SprayPathTracing(1, 2), [30.0, 31.0], by_object)
    frame = play(Speculation(), crossings, 2)
    assert (frame.counters.rounds, frame.counters.visits, len(frame.events)) == (0, 0, 0)
    in_situ = play(Speculation("in_situ"), crossings, 2)
    assert in_situ.counters.messages == 0
    for done in (frame, in_situ):
        check_image(done)
        assert not done.trace.reference.any()


def test_ranks_without_domains_or_lines_idle():
    frame = play(Speculation("in_situ"), figure2(), 7, owner=np.array([0, 0, 2, 2]))
    assert {event.rank for event in frame.events} == {0, 2}
    check_image(frame)
    check_image(play(Speculation(), figure2(), 7))


@pytest.mark.parametrize("data", ["out_of_core", "in_situ"])
def test_tiles_take_less_memory_and_more_work(data):
    crossings = wavelets(*SMALL)
    whole, parts = (play(Speculation(data, cache=8, tiles=count), crossings, 2) for count in (1, 4))
    check_image(parts)
    assert max(parts.peak_bytes) < 0.6 * max(whole.peak_bytes)
    assert parts.counters.visits > whole.counters.visits
    assert parts.counters.rounds > whole.counters.rounds
    # Combined in parts, the buffers are as large together.
    assert parts.counters.tbuf_bytes == whole.counters.tbuf_bytes
    assert parts.counters.sent_rays == whole.counters.sent_rays


@pytest.mark.parametrize("ranks", [3, 16])
def test_messages_that_travel_together_take_about_as_long_and_are_as_many(ranks):
    grouped, single = (play(Speculation("in_situ", messages=each), wavelets(*SMALL), ranks) for each in MESSAGES)
    assert grouped.counters == single.counters
    assert all(schedule(grouped, rank) == schedule(single, rank) for rank in range(ranks))
    assert grouped.env.now == pytest.approx(single.env.now, rel=0.02)
    check_image(grouped)
    # Where no rank has two messages for another, there is nothing to approximate.
    grouped, single = (play(Speculation("in_situ", messages=each), figure2(), 4, owner=FOUR) for each in MESSAGES)
    assert grouped.timeline.sha256() == single.timeline.sha256()


def test_a_result_says_that_messages_travelled_together():
    for each, said in zip(MESSAGES, (True, False), strict=True):
        result = simulate("stampede2-skx", "wavelets", Speculation("in_situ", messages=each), nodes=4, islands=1)
        assert ("each message to a rank by itself" in {item["what"] for item in result.scope["left_out"]}) == said


MESSAGES, FOUR = ("grouped", "single"), np.arange(4)


def test_each_rank_has_an_equal_share_of_each_tile():
    rank = np.array([1, 1, 0, 0, 0, 0, -1, 1, 1, 2])
    assert equal_tiles(rank, 2).tile.tolist() == [0, 0, 0, 0, 1, 1, 0, 1, 1, 0]
    assert equal_tiles(rank, 1).tile.tolist() == [0] * 10


def test_the_program_cuts_stripes_upright_out_of_core_and_tiles_of_a_million_samples():
    found = program_tiles((7, 4), 1.0, 3, in_situ=False)
    assert found.rank.reshape(4, 7)[0].tolist() == [0, 0, 1, 1, 2, 2, 2]
    assert (found.tiles, found.tile.any()) == (1, False)
    found = program_tiles((8, 4), 2.0**17, 2, in_situ=False)  # half a million samples a column
    assert found.tile.reshape(4, 8)[:, 0].tolist() == [1, 1, 0, 0]
    assert found.tiles == 2
    found = program_tiles((8, 8), 2.0**17, 2, in_situ=True)  # a million samples a line
    assert found.tile.reshape(8, 8)[:, 0].tolist() == [3, 3, 2, 2, 1, 1, 0, 0]
    assert found.rank.reshape(8, 8)[:, 0].tolist() == [1, 0] * 4
    assert program_tiles((512, 512), 4.0, 1, in_situ=False).tiles == 1


# The history buffer


def test_the_history_buffer_takes_nearer_hits_and_forgets_what_came_of_farther_ones():
    crossings = layers(SprayPathTracing(1, 3), [0.0, -1.0, -2.0], by_object)
    tree = ray_tree(crossings)
    # The ray of which all three squares are in the way, and its rows: square 0 is the nearest and the trace's hit.
    ray = int(np.flatnonzero(np.diff(crossings.table(0)["first"]) == 3)[0])
    near, middle, far = tree.rows_of(np.array([ray])).tolist()
    hits = tree.hits(np.array([near, middle, far]))
    assert (np.diff(hits) > 0).all()
    buffer = HistoryBuffer(tree, np.full((crossings.trace.rays, 2), np.inf, np.float32))
    assert buffer.farther_than(np.array([far])).tolist() == [True]
    assert buffer.update(np.array([far])).tolist() == [True]
    children, count = tree.children(np.array([far]))
    assert len(children) == count[0] > 0
    assert buffer.visibility(children).all()
    assert buffer.update(np.array([middle, far])).tolist() == [True, False]
    assert not buffer.visibility(children).any()
    assert buffer.farther_than(np.array([near, far])).tolist() == [True, False]
    assert buffer.update(np.array([near])).tolist() == [True]
    assert buffer.buffer[ray].tolist() == [hits[0], np.inf]
    buffer.reset(2, np.array([ray]))
    assert np.isinf(buffer.buffer[ray]).all()


def test_light_that_something_occludes_is_no_light():
    crossings = figure2()  # ray 3, s1, ends at the pentagon
    tree = ray_tree(crossings)
    check_lit(tree, np.array([4]))
    with pytest.raises(InvariantError, match="the light of shadow ray 3 was added, and something is in its way"):
        check_lit(tree, np.array([4, 3]))
    with pytest.raises(InvariantError, match="the light of shadow ray 5 was added, and a wrong hit spawned it"):
        check_lit(tree, np.array([4, 5]))


def test_paths_have_as_many_hits_as_their_integrator_allows():
    assert bounces(SprayPathTracing(bounces=6)) == 6
    assert bounces(AmbientOcclusion(bounces=2)) == 2
    assert bounces(PathTracing(diffuse=3, mirror=4)) == 8
    assert bounces(RayCasting()) == 1


def test_memory_grows_with_the_history_depth_and_shrinks_with_ranks():
    crossings = wavelets(*SMALL)
    held = [
        max(play(Speculation(history_depth=h), crossings, ranks).peak_bytes) for h, ranks in ((1, 1), (3, 1), (3, 4))
    ]
    assert held[0] < held[1]
    assert held[2] < held[1]
    published = play(replace(Speculation(), ray_bytes=1.0), crossings)
    assert max(published.peak_bytes) < held[1]
