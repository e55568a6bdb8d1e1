"""The rates of flows that share links: worked by hand, certified as fair, and indifferent to order."""

import doctest
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.hardware import maxmin
from simrender.hardware.maxmin import max_min_rates
from tests.flows import sharing, wide

check = settings(deadline=None, derandomize=True, max_examples=100)
inf = math.inf


def test_the_docstring_is_true():
    assert doctest.testmod(maxmin).failed == 0


def test_a_flow_without_links_is_held_back_by_its_cap_alone():
    assert max_min_rates([1.0], [(), (0,)]) == [inf, 1.0]
    assert max_min_rates([1.0], [(), (0,)], caps=[7.0, inf]) == [7.0, 1.0]
    assert max_min_rates([], []) == []


def test_rates_on_a_full_link_are_as_the_weights():
    assert max_min_rates([12.0], [(0,), (0,), (0,)], weights=[1.0, 2.0, 3.0]) == [2.0, 4.0, 6.0]


def test_what_a_heavy_flow_cannot_use_goes_to_the_others_by_their_weights():
    # The first link gives 1 for each unit of weight, so the heavy flow stops at 4; the second has 26 left for 1 + 12.
    assert max_min_rates([5.0, 30.0], [(0, 1), (0,), (1,), (1,)], weights=[4, 1, 1, 12]) == [4.0, 1.0, 2.0, 24.0]


def test_what_a_capped_flow_does_not_take_is_shared_by_the_others():
    # An equal share is 10: one flow stops at 2, so it is 14 for the two others, one of which stops at 12.
    assert max_min_rates([30.0], [(0,)] * 3, caps=[2.0, 12.0, inf]) == [2.0, 12.0, 16.0]
    assert max_min_rates([30.0], [(0,)] * 3, caps=[2.0, 2.0, 2.0]) == [2.0, 2.0, 2.0]
    assert max_min_rates([30.0], [(0,)] * 3, caps=[10.0, 10.0, 10.0]) == [10.0, 10.0, 10.0]


def test_a_cap_counts_against_what_the_weight_would_get():
    # For its weight the first flow would get 8 of 12, but stops at 5, although its cap is above an equal share.
    assert max_min_rates([12.0], [(0,), (0,)], weights=[2.0, 1.0], caps=[5.0, inf]) == [5.0, 7.0]


@st.composite
def demands(draw):
    """Return capacities, the links of each flow, weights and caps."""
    capacities, flow_links = draw(sharing(wide))
    n = len(flow_links)
    weights = draw(st.lists(st.sampled_from([1.0, 1.0, 0.375, 7.0, 1 / 1024, 1024.0]), min_size=n, max_size=n))
    caps = draw(st.lists(st.one_of(st.just(inf), st.just(1.0), wide), min_size=n, max_size=n))
    return capacities, flow_links, weights, caps


@check
@given(demands())
def test_each_flow_is_at_its_cap_or_has_a_bottleneck(case):
    capacities, flow_links, weights, caps = case
    rates = max_min_rates(*case)
    levels = [rate / weight for rate, weight in zip(rates, weights, strict=True)]
    users = [[f for f, links in enumerate(flow_links) if link in links] for link in range(len(capacities))]
    loads = [math.fsum(rates[f] for f in flows) for flows in users]
    assert all(load <= c * (1 + 1e-12) for load, c in zip(loads, capacities, strict=True))
    full = [math.isclose(load, c, rel_tol=1e-12) for load, c in zip(loads, capacities, strict=True)]
    for f, links in enumerate(flow_links):
        at_cap = caps[f] * (1 - 1e-12) <= rates[f] <= caps[f]
        assert at_cap or any(full[k] and levels[f] >= max(levels[g] for g in users[k]) * (1 - 1e-12) for k in links)


@check
@given(demands(), st.randoms(use_true_random=False))
def test_the_order_of_flows_and_links_changes_no_bit(case, rng):
    capacities, flow_links, weights, caps = case
    order = rng.sample(range(len(flow_links)), len(flow_links))
    new_name = rng.sample(range(len(capacities)), len(capacities))
    shuffled = [rng.sample([new_name[link] for link in flow_links[f]], len(flow_links[f])) for f in order]
    renamed = [capacities[new_name.index(i)] for i in range(len(capacities))]
    rates = max_min_rates(*case)
    again = max_min_rates(renamed, shuffled, [weights[f] for f in order], [caps[f] for f in order])
    assert again == [rates[flow] for flow in order]


@check
@given(demands(), demands())
def test_components_rated_together_or_apart_get_the_same_bits(one, two):
    moved = [[link + len(one[0]) for link in links] for links in two[1]]
    together = max_min_rates(one[0] + two[0], one[1] + moved, one[2] + two[2], one[3] + two[3])
    assert together == max_min_rates(*one) + max_min_rates(*two)


@check
@given(demands())
def test_rates_scale_with_capacities_and_caps(case):
    capacities, flow_links, weights, caps = case
    twice = max_min_rates([2 * c for c in capacities], flow_links, weights, [2 * cap for cap in caps])
    assert twice == [2 * rate for rate in max_min_rates(*case)]


@check
@given(demands())
def test_only_the_ratio_of_weights_matters(case):
    capacities, flow_links, _, caps = case
    assert max_min_rates(capacities, flow_links, [8.0] * len(flow_links), caps) == max_min_rates(
        capacities, flow_links, None, caps
    )


@check
@given(demands(), st.integers(0, 8))
def test_when_a_flow_leaves_those_slower_than_it_keep_their_bits(case, which):
    # This is what lets the network go on from its last rating.
    which %= len(case[1])
    rates = max_min_rates(*case)
    without = max_min_rates(case[0], *(column[:which] + column[which + 1 :] for column in case[1:]))
    levels = [rate / weight for rate, weight in zip(rates, case[2], strict=True)]
    others = [f for f in range(len(rates)) if f != which]
    for f, rate in zip(others, without, strict=True):
        if levels[f] < levels[which] * (1 - 1e-12):
            assert rate == rates[f]


@pytest.mark.parametrize("spread", [1e12, 1e-12])
def test_capacities_twelve_orders_apart(spread):
    assert max_min_rates([1.0, spread], [(0, 1), (0,), (1,)]) == pytest.approx(
        [min(0.5, spread / 2), max(0.5, 1 - spread / 2), max(spread - 0.5, spread / 2)], rel=1e-12
    )
