"""What the links of a network have done."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simrender.clock import TICKS_PER_SECOND, to_seconds
from simrender.hardware.routing import Link
from simrender.hardware.tables import FAR, LOGGED, Tables


@dataclass(frozen=True, slots=True)
class LinkUse:
    """What a link has done so far.

    Attributes
    ----------
    carried_bytes : float
        Of the transfers that have arrived.
    busy_s : float
        How long at least one flow was on it.
    mean_utilization, peak_utilization : float
        Share of its bandwidth in use, over all time so far and at the highest moment.

    """

    carried_bytes: float
    busy_s: float
    mean_utilization: float
    peak_utilization: float


def link_use(
    t: Tables, links: Mapping[Hashable, Link], carried: Mapping[Hashable, float], epoch: int, now: int
) -> dict[Hashable, LinkUse]:
    """Return what each link has done by a tick.

    Parameters
    ----------
    t : Tables
    links : mapping of name to Link
    carried : mapping of name to float
        Bytes.
    epoch, now : int
        Ticks: that from which those of the tables count, and that it is now.

    """
    table: dict[Hashable, LinkUse] = {}
    for (name, link), row in zip(links.items(), t.links, strict=True):
        busy = float(row["busy"]) + (now - epoch - int(row["busy_since"]) if row["users"] else 0)
        mean = carried[name] / (link.bandwidth * to_seconds(now)) if now else 0.0
        table[name] = LinkUse(carried[name], busy / TICKS_PER_SECOND, mean, float(row["peak"]))
    return table


def changes(
    t: Tables, epochs: Sequence[tuple[int, int]]
) -> tuple[NDArray[Any], NDArray[np.int32], NDArray[np.float64]]:
    """Return the log of loads in three columns: ticks, links by index, B/s.

    Parameters
    ----------
    t : Tables
    epochs : sequence of (row, tick)
        The rows of the log before which an epoch ended, and the ticks at which the next began.

    """
    log = t.log[: int(t.counters[LOGGED])]
    rows, ticks = zip((0, 0), *epochs, strict=True)
    begins = np.array(ticks, np.int64 if ticks[-1] < FAR else object)  # which then do not fit 64 bits
    return log["tick"] + begins[np.searchsorted(rows, np.arange(len(log)), "right") - 1], log["link"], log["load"]


def by_link(
    log: tuple[NDArray[Any], NDArray[np.int32], NDArray[np.float64]], names: Sequence[Hashable]
) -> dict[Hashable, tuple[NDArray[Any], NDArray[np.float64]]]:
    """Return the log of loads of each link that ever had one: ticks, and B/s from then on."""
    ticks, links, loads = log
    order = np.argsort(links, kind="stable")
    used, first = np.unique(links[order], return_index=True)
    parts = zip(used.tolist(), np.split(ticks[order], first[1:]), np.split(loads[order], first[1:]), strict=False)
    return {names[link]: (when, load) for link, when, load in parts}
