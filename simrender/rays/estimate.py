"""How far off a traced subset is: independent replicas of the same image, and confidence intervals from them.

A trace is a sample of the published frame: of its pixels, and of the random numbers of its paths. Another seed draws
another sample, independent of the first. The mean over replicas estimates the published count, and the spread between
them its standard error; with few replicas the interval is Student's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simrender.errors import UsageError

F64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Estimate:
    """Mean and confidence interval of some quantities, from independent replicas.

    Attributes
    ----------
    mean : float64 array (...)
    standard_error : float64 array (...)
        Of the mean.
    half_width : float64 array (...)
        Of the interval about the mean that holds the truth with the confidence.
    replicas : int
    confidence : float

    """

    mean: F64
    standard_error: F64
    half_width: F64
    replicas: int
    confidence: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, for JSON; of a single quantity."""
        return {
            "mean": float(self.mean),
            "standard_error": float(self.standard_error),
            "half_width": float(self.half_width),
            "confidence": self.confidence,
            "replicas": self.replicas,
        }


def estimate(replicas: Sequence[Any], confidence: float = 0.95) -> Estimate:
    """Return the mean of some replicas, arrays of one shape or numbers, with a confidence interval.

    Raises
    ------
    UsageError
        If there are fewer than two.

    """
    if len(replicas) < 2:
        raise UsageError(f"an error is estimated from 2 replicas or more, got {len(replicas)}")
    from scipy.special import stdtrit

    values = np.asarray(replicas, np.float64)
    count = len(values)
    error = values.std(axis=0, ddof=1) / math.sqrt(count)
    quantile = float(stdtrit(count - 1, 0.5 + 0.5 * confidence))
    return Estimate(values.mean(axis=0), error, quantile * error, count, confidence)


def seeds(seed: int, replicas: int) -> list[int]:
    """Return the seeds of so many replicas, the first of which is the given one; they wrap at 2^64."""
    return [(seed + k) % 2**64 for k in range(replicas)]


def over_replicas(seed: int, replicas: int, measure: Callable[[int], Any], confidence: float = 0.95) -> Estimate:
    """Measure something in each replica, given its seed, and estimate it."""
    return estimate([measure(s) for s in seeds(seed, replicas)], confidence)
