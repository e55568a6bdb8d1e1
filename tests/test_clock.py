import math
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender import units
from simrender.clock import TICKS_PER_SECOND, to_seconds, to_ticks
from simrender.errors import ScheduleError

check = settings(deadline=None, derandomize=True)


def test_a_tick_is_a_picosecond():
    assert TICKS_PER_SECOND == 10**12
    assert to_ticks(1.0) == 10**12
    assert to_ticks(1e-12) == 1
    assert to_seconds(1) == 1e-12


@pytest.mark.parametrize(
    ("seconds", "ticks"),
    [(0.0, 0), (5e-324, 1), (1e-13, 1), (1.5e-12, 2), (0.1, 10**11), (1e-7, 10**5), (3.0, 3 * 10**12), (1e9, 10**21)],
)
def test_durations_are_rounded_up_to_whole_ticks(seconds, ticks):
    assert to_ticks(seconds) == ticks
    assert isinstance(to_ticks(seconds), int)


@pytest.mark.parametrize("seconds", [-1e-300, -1.0, math.inf, -math.inf, math.nan])
def test_a_duration_is_finite_and_not_negative(seconds):
    with pytest.raises(ScheduleError) as error:
        to_ticks(seconds)
    assert str(error.value) == f"a duration must be finite and not negative, got {seconds!r} s"


@check
@given(st.integers(0, 10**15))
def test_ticks_survive_the_way_through_seconds(ticks):
    assert to_ticks(to_seconds(ticks)) == ticks


@check
@given(st.integers(0, 10**9))
def test_what_a_card_states_to_the_picosecond_is_that_many_ticks(ticks):
    """Else two latencies of 0.05 us would not end with one of 0.1 us."""
    assert to_ticks(units.parse(f"{ticks // 10**6}.{ticks % 10**6:06} us", units.SECONDS)) == ticks
    assert to_ticks(units.parse(f"{ticks} ps", units.SECONDS)) == ticks


@check
@given(st.floats(0.0, 1e6))
def test_nothing_ends_before_it_could_have_nor_a_tick_too_late(seconds):
    exact = Fraction(seconds) * 10**12
    noise = exact * Fraction(1, 2**50)
    assert exact - noise <= to_ticks(seconds) < exact + noise + 1


@check
@given(st.floats(0.0, 1e6), st.floats(0.0, 1e6))
def test_a_longer_duration_takes_no_fewer_ticks(one, other):
    assert to_ticks(min(one, other)) <= to_ticks(max(one, other))
