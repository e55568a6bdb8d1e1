"""What is refused of the numbers that a transfer is asked for with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from simrender.errors import ScheduleError


def check_transfer(nbytes: float, start: int, cap: float, delay: int, now: int) -> None:
    """Refuse numbers that no transfer can have."""
    if not 0.0 <= nbytes < math.inf:
        raise ScheduleError(f"a transfer's size must be finite and not negative, got {nbytes!r} B")
    if start < now:
        raise ScheduleError(f"a transfer cannot start at tick {start}, before now, tick {now}")
    if not cap > 0.0:
        raise ScheduleError(f"a transfer's cap must be above zero, got {cap!r} B/s")
    if delay < 0:
        raise ScheduleError(f"a transfer's delay must not be negative, got {delay!r} ticks")


def whole(ticks: ArrayLike) -> NDArray[np.int64]:
    """Return ticks or keys as an array; a fraction is a mistake that a cast would hide."""
    table = np.asarray(ticks)
    if table.size and table.dtype.kind not in "iu":
        raise ScheduleError(f"ticks and keys must be whole numbers below 2^63, got an array of {table.dtype}")
    return table.astype(np.int64, copy=False)


def column(values: NDArray[Any], count: int) -> NDArray[Any]:
    """Return an array as it is if it is that long; one number for each."""
    return values if values.shape == (count,) else np.broadcast_to(values, count)
