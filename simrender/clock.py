"""Simulated time: an integer number of picoseconds.

SimPy compares times with ``==`` and ``<``; floating-point seconds would make two events that belong to one instant
happen in an order that depends on rounding. With integer ticks, as in gem5, ties are exact and a simulation is the
same on every machine. Seconds appear only where numbers enter and leave.
"""

from __future__ import annotations

import math

from simrender.errors import ScheduleError

TICKS_PER_SECOND = 10**12
"""One tick is a picosecond."""

TICK_NOISE = 4.0 * 2.0**-53
"""Relative: half a unit in the last place each of a duration and of its product, with as much to spare."""


def to_ticks(seconds: float) -> int:
    """Return a duration in ticks, rounded up, so that nothing ever ends before it could have.

    Parameters
    ----------
    seconds : float
        A duration in seconds; finite and not negative.

    Raises
    ------
    ScheduleError
        If the duration is negative, infinite or not a number.

    """
    if not 0.0 <= seconds < math.inf:
        raise ScheduleError(f"a duration must be finite and not negative, got {seconds!r} s")
    ticks = seconds * TICKS_PER_SECOND
    whole = round(ticks)
    # 0.1 us is 100000 ticks: what two roundings of a float add is no time, and would break ties.
    return whole if math.isclose(ticks, whole, rel_tol=TICK_NOISE, abs_tol=0.0) else math.ceil(ticks)


def to_seconds(ticks: int) -> float:
    """Return a time or duration in ticks as seconds."""
    return ticks / TICKS_PER_SECOND
