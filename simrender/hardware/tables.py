"""Flows, links and components of a fluid network as flat arrays, which the kernels share.

Numba keeps compiled kernels by the date of the file that they stand in: whoever changes this file or `maxmin.py` must
touch `fluid.py`, too.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[Any]

FAR: Final = 2**62
"""A tick beyond the horizon of the kernels."""
WEIGHT_UNIT: Final = 2.0**-32
"""Weights are whole multiples of this, so that their sums are exact."""

NONE: Final = -1
NOT_FROZEN: Final = -1.0
NO_ROUND: Final = 2**31 - 1

FLOW: Final = np.dtype(
    [  # one cache line: what every rating looks at
        ("finish", "i8"),  # the tick at which it arrives at its present rate
        ("since", "i8"),  # when that rate last changed, and
        ("remaining", "f8"),  # how many bytes were left then
        ("rate", "f8"),
        ("weight", "i8"),  # in WEIGHT_UNITs
        ("hops", "i2"),
        ("apart", "i2"),  # of a leader: whether its component may have come apart since all of it was searched
        ("mark", "i4"),  # the last search that found it
        ("position", "i4"),  # in the order in which its component was frozen
        ("next", "i4"),  # flow of its component
        ("leader", "i4"),  # the flow of its component that stands in the heap
        ("place", "i4"),  # there
    ]
)
STORY: Final = np.dtype(
    [
        ("cap", "f8"),
        ("nbytes", "f8"),
        ("start", "i8"),  # when its sender began, and
        ("number", "i8"),  # how many had been asked for before: the order in which arrivals of one tick are told
    ]
)
LINK: Final = np.dtype(
    [
        ("capacity", "f8"),  # B/s, now
        ("residual", "f8"),  # of it, while a component is filled
        ("floor", "f8"),  # the level at which flows of it were last frozen
        ("load", "f8"),  # sum of the rates through it
        ("busy", "f8"),  # ticks with a flow on it
        ("peak", "f8"),  # the highest share of its capacity ever used
        ("carried", "f8"),  # bytes of flows that arrived, and
        ("carried_low", "f8"),  # what rounding took from them
        ("weight", "i8"),  # of all its flows
        ("weighed", "i8"),  # weight when its component was last searched
        ("left", "i8"),  # weight of the flows not yet frozen
        ("taken", "i8"),  # weight frozen in this round
        ("mark", "i4"),
        ("busy_since", "i8"),
        ("first", "i4"),  # entry of the list of its flows
        ("begin", "i4"),  # of its flows in the roster of a component
        ("end", "i4"),
        ("place", "i4"),  # among the links that are not full yet
        ("users", "i4"),
        ("vacated", "i4"),
    ]
)
HEAP: Final = np.dtype([("tick", "i8"), ("leader", "i4")])  # the earliest finish in a component
HEAP_SIZE, STAMP, VACATED, RATED, LOGGED, WIDOWED, CAPPED, QUEUED = range(8)
LAST, PULLED, LISTED, TOUCHED, ROUNDS, CHANGED, RESUMED = range(8, 15)
COUNTERS: Final = 15
"""Of these LAST to RESUMED tell what the last rating left in the scratch arrays, for the next one to go on from: the
leader of the component, whether that is out of the heap, its flows and links and rounds of filling, the first round
that has changed since, and how many ratings in a row have gone on from it."""

CHAIN: Final = np.dtype([("after", "i4"), ("before", "i4")])
ROAD: Final = np.dtype([("touched", "i4"), ("vacated", "i4")])
NOTE: Final = np.dtype([("arrived", "i4"), ("widowed", "i4"), ("queue", "i4")])
FROZEN: Final = np.dtype(
    [
        ("tick", "i8"),  # the earliest finish of the flows so far,
        ("earliest", "i4"),  # whose it is,
        ("ties", "i4"),  # and how many arrive then
        ("flow", "i4"),
        ("round", "i4"),
        ("before", "i4"),  # how many flows were frozen before the round of this row's number,
        ("undo", "i4"),  # and how many links it and earlier ones had touched
    ]
)
UNDO: Final = np.dtype([("link", "i4"), ("taken", "i8"), ("residual", "f8"), ("floor", "f8")])
WORTH_RESUMING: Final = 64  # flows; searching a smaller component costs nothing
MOST_RESUMES: Final = 16  # in a row: the component may have come apart
LOG: Final = np.dtype([("tick", "i8"), ("link", "i4"), ("load", "f8")])


class Tables(NamedTuple):
    """Everything that the kernels work on: n flows in slots, m links, and routes of up to w links.

    Lists that are as long as there are flows, or links, share an array: the fewer arrays, the less there is to compile.

    Attributes
    ----------
    flows, story : arrays of FLOW and STORY, (n,)
    hops : int32 array, (n, w)
        The links of each flow.
    chain : array of CHAIN, (n x w,)
        The list of each link's flows: the entry ``slot x w + hop`` has these neighbours.
    links : array of LINK, (m,)
    roads : array of ROAD, (m,)
        Two lists of links: those of a component, and those that a flow has left at this tick.
    heap : array of HEAP, (n,)
        Components, the first to have an arrival on top.
    counters : int64 array
    log : array of LOG
        Changes of load; without room, nothing is logged.
    notes : array of NOTE, (n,)
        Three lists of flows: those that have just been let go, those that have to be rated anew since one of their
        component has left, and those of a component.
    fresh : float64 array, (n,)
        The rate that each flow is about to get.
    roster : int32 array, (n x w,)
        The flows of one link of a component after the other.
    frozen : array of FROZEN, (n + 1,)
        The flows of a component in the order in which they were frozen; and the rounds.
    undo : array of UNDO, (n x w,)
        What the links that a round touched were before.

    """

    flows: Array
    story: Array
    hops: Array
    chain: Array
    links: Array
    roads: Array
    heap: Array
    counters: Array
    log: Array
    notes: Array
    fresh: Array
    roster: Array
    frozen: Array
    undo: Array

    @classmethod
    def room(cls, flows: int, links: int, width: int, log: int = 0) -> Tables:
        """Return empty tables for so many flows, links, links of a flow, and rows of the log."""
        entries = flows * width
        counters = np.zeros(COUNTERS, np.int64)
        counters[LAST], counters[CHANGED] = NONE, NO_ROUND
        rows = np.zeros(flows, FLOW)
        rows["place"] = NONE
        roads = np.zeros(links, LINK)
        roads["first"] = NONE
        return cls(
            rows, np.zeros(flows, STORY), np.zeros((flows, width), np.int32), np.zeros(entries, CHAIN), roads,
            np.zeros(links, ROAD), np.zeros(flows, HEAP), counters, np.zeros(log, LOG), np.zeros(flows, NOTE),
            np.zeros(flows), np.zeros(entries, np.int32), np.zeros(flows + 1, FROZEN), np.zeros(entries, UNDO),
        )  # fmt: skip

    def grown(self, flows: int, width: int, log: int) -> Tables:
        """Return larger tables with the same content; what the last rating left must have been forgotten."""
        new = Tables.room(flows, len(self.links), width, log)
        old, narrow = len(self.flows), self.hops.shape[1]
        for name in ("flows", "story", "heap", "notes", "log"):
            getattr(new, name)[: len(getattr(self, name))] = getattr(self, name)
        for name in ("links", "roads", "counters"):
            getattr(new, name)[:] = getattr(self, name)
        new.hops[:old, :narrow] = self.hops
        for name in ("after", "before"):
            table = self.chain[name].reshape(old, narrow)
            new.chain[name].reshape(flows, width)[:old, :narrow] = _renumbered(table, narrow, width)
        new.links["first"] = _renumbered(self.links["first"], narrow, width)
        return new


def _renumbered(entries: Array, narrow: int, wide: int) -> Array:
    return np.where(entries == NONE, NONE, entries // narrow * wide + entries % narrow)


kernel = njit(cache=True, nogil=True, error_model="numpy")
