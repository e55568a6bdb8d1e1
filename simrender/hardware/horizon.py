"""Ticks that do not fit the 64 bits of the kernels: the epoch from which theirs count moves along."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simrender.clock import TICKS_PER_SECOND, to_ticks
from simrender.hardware import fluid
from simrender.hardware.tables import FAR, HEAP_SIZE, NONE, Tables

HORIZON = FAR // 2
"""Ticks since the epoch, 27 days, at which it moves."""


def far_ticks(t: Tables, slots: Sequence[int]) -> dict[int, int]:
    """Return when flows arrive whose ticks are `FAR`, by slot, in ticks since the epoch."""
    return {
        slot: int(flow["since"]) + to_ticks(float(flow["remaining"] / flow["rate"]))
        for slot, flow in zip(slots, t.flows[slots], strict=True)
        if flow["rate"] > 0.0 and flow["finish"] == FAR
    }


def rebase(t: Tables, used: NDArray[np.int64], shift: int) -> None:
    """Move the epoch.

    Parameters
    ----------
    t : Tables
    used : int64 array
        The slots of all flows.
    shift : int
        By how many ticks.

    """
    fluid.forget(t)
    far = far_ticks(t, used.tolist())
    flows, starts = t.flows[used], t.story["start"][used].tolist()
    elapsed = np.array([(shift - since) / TICKS_PER_SECOND for since in flows["since"].tolist()])
    t.flows["remaining"][used] = np.maximum(0.0, flows["remaining"] - flows["rate"] * elapsed)
    t.flows["since"][used] = 0
    t.story["start"][used] = [start if start == FAR else max(-FAR, start - shift) for start in starts]
    finish = zip(used.tolist(), flows["finish"].tolist(), strict=True)
    left = [far.get(slot, tick) - shift for slot, tick in finish]
    # Below zero is what has yet to begin, which has no finish, and what rounding put before the tick it is now.
    t.flows["finish"][used] = [max(0, tick) if tick < HORIZON else FAR for tick in left]
    for i in range(int(t.counters[HEAP_SIZE])):
        member, tick = int(t.heap[i]["leader"]), FAR
        while member != NONE:
            tick = min(tick, int(t.flows[member]["finish"]))
            member = int(t.flows[member]["next"])
        t.heap[i]["tick"] = tick
    fluid.reheap(t)
    t.links["busy"] += np.where(t.links["users"] > 0, float(shift) - t.links["busy_since"], 0.0)
    t.links["busy_since"] = 0
