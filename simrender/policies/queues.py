"""Ray batch queues, one a domain: what ray schedulers batch rays in (Pharr et al.; SpRay, section 3)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from simrender.rays.worlds import by_domain

Ids = NDArray[np.int64]


class DomainQueues:
    """Rays that wait for domains, each in the order in which it came.

    Attributes
    ----------
    counts : int64 array (domains,)
        Rays in each queue.

    """

    def __init__(self, domains: int) -> None:
        self.counts = np.zeros(domains, np.int64)
        self._parts: list[list[Ids]] = [[] for _ in range(domains)]

    def put(self, rays: Ids, domain: NDArray[np.int16]) -> None:
        """Queue each ray for its domain."""
        if len(rays) == 0:
            return
        for d, rows in by_domain(domain):
            self._parts[d].append(rays[rows])
            self.counts[d] += len(rows)

    def take(self, domain: int) -> Ids:
        """Empty a queue and return what was in it."""
        parts, self._parts[domain] = self._parts[domain], []
        self.counts[domain] = 0
        if len(parts) == 1:
            return parts[0]
        return np.concatenate(parts) if parts else np.zeros(0, np.int64)

    def any(self) -> bool:
        """Whether a ray waits."""
        return bool(self.counts.any())


def fullest(counts: NDArray[np.int64], among: Iterable[int] | None = None) -> int | None:
    """Return the domain with most rays, of equal ones the lowest; None if no ray waits.

    Parameters
    ----------
    counts : int64 array (domains,)
    among : iterable of int, optional
        Consider only these.

    """
    if among is None:
        best = int(counts.argmax())
        return best if counts[best] > 0 else None
    chosen = np.sort(among if isinstance(among, np.ndarray) else np.fromiter(among, np.int64))
    if len(chosen) == 0:
        return None
    best = int(chosen[counts[chosen].argmax()])
    return best if counts[best] > 0 else None
