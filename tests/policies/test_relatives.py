"""The relatives of LoadAnyOnce: by hand, against each other, and what holds for all of them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import load_workload, simulate
from simrender.documents import Document
from simrender.errors import CardError, UsageError
from simrender.policies.domain_frame import DomainPolicy
from simrender.policies.load_any_once import LoadAnyOnce
from simrender.policies.load_once import NOTHING, LoadAnother, LoadMany, LoadOnce, by_rays
from simrender.policies.ray_broadcast import RayBroadcast
from simrender.policies.replication import Replication, assign
from simrender.policies.static_schedules import DomainSchedule, ImageSchedule
from tests.policies.driver import WAVELETS, check_image, gardens, play, schedule, visits_of, wavelets
from tests.policies.figure2 import A, B, C, D, figure2

RANKS = [1, 2, 3, 7, 16]


def steps(frame):
    """The (rank, domain) pairs of each step."""
    count = max(event.step for event in frame.events) + 1
    return [sorted((e.rank, e.domain) for e in frame.events if e.step == step) for step in range(count)]


# What holds for all

CACHES = st.sampled_from([1, 2, 5, "50%", "all"])
POLICIES = st.one_of(
    st.builds(LoadOnce, CACHES),
    st.builds(LoadAnother, CACHES),
    st.builds(LoadMany, CACHES, many=st.sampled_from([0.0, 20.0, 1e5])),
    st.just(ImageSchedule()),
    st.just(DomainSchedule()),
    st.builds(RayBroadcast, st.sampled_from(["owner", "all"])),
    st.builds(Replication, st.integers(1, 17)),
)


@given(gardens(), POLICIES, st.sampled_from(RANKS), st.data())
@settings(max_examples=40, deadline=None)
def test_every_ray_is_retired_once_and_the_image_is_the_references(crossings, policy, ranks, data):
    count = crossings.domains.count
    owner = np.array(data.draw(st.lists(st.integers(0, ranks - 1), min_size=count, max_size=count)))
    frame = play(policy, crossings, ranks, owner=owner)
    check_image(frame)
    assert not frame.outbox
    assert not frame.told
    tests = frame.counters.radiance_tests + frame.counters.shadow_tests
    if isinstance(policy, RayBroadcast):
        holding = len(np.unique(owner[crossings.domains.primitives > 0]))
        assert tests == crossings.trace.rays * holding
    else:
        assert (frame.position == frame.visits.last).all()
        assert tests == visits_of(crossings).tests
        assert frame.counters.visits == len(frame.events)


@pytest.mark.parametrize("policy", [LoadOnce(), LoadAnother(), LoadMany(many=10.0), RayBroadcast(), Replication(2)])
def test_twice_the_same_events_and_times(policy):
    crossings = figure2()
    first, second = play(policy, crossings, 3), play(policy, crossings, 3)
    assert first.events == second.events
    assert first.timeline.sha256() == second.timeline.sha256()
    assert first.env.now == second.env.now > 0


@pytest.mark.parametrize(
    "policy", [LoadOnce, LoadAnother, LoadMany, ImageSchedule, DomainSchedule, RayBroadcast, Replication]
)
def test_all_are_schedulers_of_domains_whose_parameters_are_checked(policy):
    assert isinstance(policy(), DomainPolicy)
    assert Document("{threads: 2}", "card").validate(policy) == policy(threads=2)
    with pytest.raises(CardError, match="threads: should be greater than or equal to 1, got 0"):
        Document("{threads: 0}", "card").validate(policy)
    with pytest.raises(CardError, match="tile: unknown field"):
        Document("{tile: 8}", "card").validate(policy)


@pytest.fixture(scope="module")
def workload():
    return load_workload(WAVELETS, ["traced.resolution=64x64"])


@pytest.mark.parametrize("policy", [DomainSchedule(), RayBroadcast(), RayBroadcast("all"), Replication(2)])
def test_data_that_stays_in_place_can_be_shared_by_islands(workload, policy):
    one, two = (simulate("stampede2-skx", workload, policy, nodes=4, islands=islands) for islands in (1, 2))
    assert (one.island_size, two.island_size) == (4, 2)
    assert one.image_sha256 == two.image_sha256
    # A ray has more ranks to go to in a larger island.
    assert one.counts["sent_rays"] > two.counts["sent_rays"] > 0


@pytest.mark.parametrize("policy", [LoadOnce(), LoadAnother(), LoadMany(), ImageSchedule()])
def test_islands_are_refused_where_every_rank_loads(workload, policy):
    with pytest.raises(UsageError, match="loads what it needs, so every node is an island"):
        simulate("stampede2-skx", workload, policy, nodes=4, islands=2)


# LoadOnce, LoadAnother, LoadMany


def test_domains_with_most_rays_come_first_and_of_equal_ones_the_higher():
    assert by_rays(np.array([3, 0, 7, 3, 1])) == [2, 3, 0, 4]
    assert by_rays(np.zeros(3, np.int64)) == []
    # The library's key, rays * 128 + domain in 32 bits, would mix these up.
    many = np.zeros(300, np.int64)
    many[[2, 130, 258]] = 1 << 25
    assert by_rays(many) == [258, 130, 2]


def test_a_rank_goes_on_with_what_it_has_and_idle_ones_take_what_nobody_has():
    waiting = np.array([5, 9, 0, 8, 2, 2])
    # Rank 0 has domain 0, rank 1 domain 2, for which no ray waits, ranks 2 and 3 nothing.
    loaded = [[0], [2], [], []]
    assert LoadOnce().plan(loaded, waiting) == [0, 1, 3, 5]
    assert LoadOnce().plan([[0], [1], [3], [4], [5]], waiting) == [0, 1, 3, 4, 5]
    assert LoadOnce().plan([[0], [2], [1], [3], [4], [5], [2]], waiting) == [0, NOTHING, 1, 3, 4, 5, NOTHING]


def test_of_ranks_that_have_the_same_domain_the_last_keeps_it():
    waiting = np.array([5, 9, 4])
    assert LoadOnce().plan([[1], [1], [1]], waiting) == [0, 2, 1]
    assert LoadOnce().plan([[1], [1]], np.array([0, 9, 0])) == [NOTHING, 1]


def test_of_several_domains_a_rank_goes_on_with_the_fullest():
    assert LoadOnce().plan([[0, 1, 2], []], np.array([5, 9, 4])) == [1, NOTHING]
    assert LoadAnother().plan([[0, 1, 2], []], np.array([5, 9, 4])) == [1, 1]


def test_load_another_adds_a_copy_of_the_fullest_domains():
    waiting = np.array([5, 9, 4])
    assert LoadAnother().plan([[1], [], [], [], []], waiting) == [1, 1, 0, 2, NOTHING]


def test_load_many_adds_copies_until_few_rays_are_left_for_each():
    waiting = np.array([1_000_000, 300_000, 90_000])
    # Granted: 0 (500,000 are left, offered again), 0 (250,000), 1 (150,000), 0 (125,000), 1 (75,000, no more),
    # 0 (62,500, no more), and at last 2.
    assert LoadMany().plan([[]] * 8, waiting) == [0, 0, 1, 0, 1, 0, 2, NOTHING]
    assert LoadMany(many=1e6).plan([[]] * 4, waiting) == [0, 1, 2, NOTHING]
    # Traced rays stand for more than themselves.
    assert LoadMany().plan([[]] * 8, waiting // 1000, weight=1000.0) == [0, 0, 1, 0, 1, 0, 2, NOTHING]
    assert LoadMany().plan([[]] * 4, waiting // 1000) == [0, 1, 2, NOTHING]


@given(
    st.lists(st.integers(0, 40), min_size=1, max_size=12),
    st.lists(st.lists(st.integers(0, 11), max_size=3, unique=True), min_size=1, max_size=9),
    st.sampled_from([LoadOnce(), LoadAnother(), LoadMany(many=4.0)]),
)
def test_a_plan_gives_rays_to_all_it_can(waiting, loaded, policy):
    counts = np.array(waiting, np.int64)
    loaded = [[domain for domain in domains if domain < len(waiting)] for domains in loaded]
    planned = policy.plan(loaded, counts)
    given_out = [domain for domain in planned if domain != NOTHING]
    assert all(counts[domain] > 0 for domain in given_out)
    assert bool(given_out) == bool(counts.any())
    copies = np.bincount(given_out, minlength=1).max() if given_out else 0
    if isinstance(policy, LoadMany):
        assert NOTHING not in planned or set(np.flatnonzero(counts)) == set(given_out)
    elif isinstance(policy, LoadAnother):
        assert copies <= 2
    else:
        assert copies <= 1
        elsewhere = [
            {d for other, has in enumerate(loaded) if other != rank for d in has} for rank in range(len(loaded))
        ]
        assert not any(d in elsewhere[rank] and d not in loaded[rank] for rank, d in enumerate(planned))


def test_load_once_figure_2_on_one_rank():
    # Ties go to the higher number, so D comes before A and B.
    frame = play(LoadOnce(), figure2())
    assert schedule(frame) == [A, C, D, C, A, B, D]
    assert frame.counters.loads == 7


def test_load_once_figure_2_on_two_ranks():
    frame = play(LoadOnce(), figure2(), 2)
    assert steps(frame) == [[(0, A)], [(0, C), (1, B)], [(0, D), (1, A)], [(0, C)], [(1, A)]]
    assert frame.counters.loads == 6  # rank 1 still has A in the end
    assert frame.counters.sent_rays == 4  # r0 there and back, s2, s1
    assert frame.counters.messages == 4
    assert frame.counters.sent_bytes == 4 * 80.0


def test_load_another_figure_2_loads_a_again_where_its_ray_is():
    frame = play(LoadAnother(), figure2(), 2)
    assert steps(frame) == [[(0, A)], [(0, C), (1, B)], [(0, D), (1, A)], [(0, C)], [(0, A)]]
    assert frame.counters.loads == 7
    assert frame.counters.sent_rays == 3


def test_load_once_never_holds_a_domain_twice_after_the_first_step():
    frame = play(LoadOnce(), wavelets(), 16)
    for visited in steps(frame)[1:]:
        domains = [domain for _, domain in visited]
        assert len(set(domains)) == len(domains)
    assert len({domain for _, domain in steps(frame)[0]}) < len(steps(frame)[0])
    assert frame.counters.loads < play(LoadAnyOnce("global", cache=1), wavelets(), 16).counters.loads


def test_a_coin_decides_between_two_ranks_that_have_a_domain():
    class Me:
        index, ranks, step = 0, 4, 0
        queues = type("Queues", (), {"counts": np.zeros(3, np.int64)})

    taken = []
    for step in range(2000):
        Me.step = step
        holder = LoadOnce().holders(Me, [2, 1, 1, 2])
        assert holder[0] == -1
        assert holder[2] == 0  # its own rays stay
        taken.append(int(holder[1]))
    assert set(taken) == {1, 2}
    assert abs(taken.count(1) - 1000) < 4 * np.sqrt(2000 * 0.25)


# The static schedules


def test_the_image_schedule_is_load_any_once_with_room_for_all():
    crossings = wavelets()
    for ranks in (1, 3):
        mine, other = play(ImageSchedule(), crossings, ranks), play(LoadAnyOnce(), crossings, ranks)
        assert mine.events == other.events
        assert mine.env.now == other.env.now


def test_the_domain_schedule_empties_its_own_domains_before_it_exchanges():
    # A and B on rank 0, C and D on rank 1.
    frame = play(DomainSchedule(), figure2(), 2, owner=np.array([0, 0, 1, 1]))
    assert schedule(frame, 0) == [A, B, A]
    assert schedule(frame, 1) == [C, D, C]
    assert frame.counters.steps == 3
    assert frame.counters.messages == 2
    assert frame.counters.sent_rays == 5  # r0, r1 and r2; s1 and s2
    assert frame.counters.loads == 0


def test_the_domain_schedule_sends_what_load_any_once_in_situ_sends():
    # A ray that changes ranks does so whatever the schedule, from the rank whose stripe it comes from on.
    for ranks in (2, 4, 16):
        static, rounds = play(DomainSchedule(), wavelets(), ranks), play(LoadAnyOnce("in_situ"), wavelets(), ranks)
        assert static.counters.sent_rays == rounds.counters.sent_rays
        assert static.counters.messages < rounds.counters.messages


# Ray broadcast


@pytest.mark.parametrize("wait", ["owner", "all"])
@pytest.mark.parametrize("ranks", [1, 2, 5])
def test_broadcast_rays_and_hits_have_closed_forms(wait, ranks):
    crossings = wavelets()
    frame = play(RayBroadcast(wait), crossings, ranks)
    rays, others = crossings.trace.rays, ranks - 1
    assert frame.counters.radiance_tests == ranks * 512 * 512
    assert frame.counters.shadow_tests == ranks * (rays - 512 * 512)
    assert frame.counters.sent_rays == 2 * rays * others
    assert frame.counters.sent_bytes == rays * others * (32.0 + 64.0)
    # Each rank that has rays of a generation sends them to all others and gets as many answers; and at last says that
    # it is done.
    generation = np.searchsorted(crossings.trace.first, np.arange(rays), side="right")
    owner = frame.rank_of_pixel[crossings.trace.column("pixel")]
    busy = len(np.unique(generation * ranks + owner))
    assert frame.counters.messages == 2 * busy * others + (ranks * others if wait == "owner" else 0)
    assert frame.counters.steps == (2 if wait == "all" else 0)
    check_image(frame)


@pytest.mark.parametrize("wait", ["owner", "all"])
def test_a_rank_that_holds_nothing_answers_and_traces_nothing(wait):
    frame = play(RayBroadcast(wait), figure2(), 3, owner=np.array([0, 0, 2, 2]))
    assert frame.machine.processor(1).busy_ticks == 0
    assert frame.machine.processor(0).busy_ticks > 0
    assert frame.counters.radiance_tests == 2 * 3
    check_image(frame)


def test_an_owner_that_waits_alone_is_not_held_up_by_the_others():
    # Rank 0 has the lowest lines, which see nothing: it is done after one generation, and then only answers.
    frame = play(RayBroadcast("owner"), wavelets(), 16)
    together = play(RayBroadcast("all"), wavelets(), 16)
    assert frame.env.now < together.env.now
    assert frame.counters.sent_bytes == together.counters.sent_bytes


# Replication


def test_with_one_copy_replication_is_load_any_once_in_situ():
    crossings = wavelets()
    for ranks in (1, 4, 16):
        mine, other = play(Replication(1), crossings, ranks), play(LoadAnyOnce("in_situ"), crossings, ranks)
        assert mine.events == other.events
        assert mine.counters == other.counters
        assert mine.env.now == other.env.now


def test_copies_lie_on_the_ranks_after_the_owner():
    owned = [np.array([0, 3]), np.array([1]), np.array([2])]
    assert Replication(2).holders(owned) == [[0, 1], [1, 2], [2, 0], [0, 1]]
    assert Replication(9).holders(owned) == [[0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 1, 2]]


def test_domains_choose_the_holder_that_has_done_least():
    holders = [[0, 1], [0, 1], [1, 2], [2, 0]]
    done = np.array([10, 4, 0])
    # Domain 2 has most rays and takes rank 2; 1 takes rank 1; 0 the rank 0 that is left; 3 waits.
    assert assign(np.array([5, 6, 9, 4]), holders, done) == {0: 0, 1: 1, 2: 2}
    assert assign(np.array([5, 0, 0, 5]), holders, done) == {1: 0, 2: 3}
    assert assign(np.array([5, 5, 0, 0]), holders, np.zeros(3, np.int64)) == {0: 0, 1: 1}
    assert assign(np.zeros(4, np.int64), holders, done) == {}


@given(
    st.lists(st.integers(0, 9), min_size=1, max_size=20),
    st.integers(1, 7),
    st.integers(1, 8),
    st.lists(st.integers(0, 99), min_size=7, max_size=7),
)
def test_no_domain_waits_while_one_of_its_holders_idles(waiting, ranks, copies, done):
    counts = np.array(waiting, np.int64)
    owned = [np.arange(rank, len(waiting), ranks) for rank in range(ranks)]
    holders = Replication(copies).holders(owned)
    planned = assign(counts, holders, np.array(done[:ranks]))
    assert len(set(planned.values())) == len(planned)
    for rank, domain in planned.items():
        assert counts[domain] > 0
        assert rank in holders[domain]
    for domain in set(np.flatnonzero(counts).tolist()) - set(planned.values()):
        assert all(rank in planned for rank in holders[domain])


def test_more_copies_take_fewer_rounds():
    rounds = [play(Replication(copies), wavelets(), 4).counters.steps for copies in (1, 2, 4)]
    assert rounds[0] > rounds[1] >= rounds[2]
    everywhere = play(Replication(16), wavelets(), 16)
    check_image(everywhere)
    assert everywhere.counters.loads == 0
