"""How ranks get through a schedule: who may send what when, advanced by the messages that arrive.

A rank enters a step when all its messages of earlier steps have ended and it has combined what it received. Messages
that it sends in one step leave an overhead apart, and an eager one not before the adapter is through with the rank's
eager messages before it (the gap a byte of LogGP). An eager message ends for its sender when it leaves, and for its
receiver when it has arrived and the receiver has entered the step; a rendezvous leaves when both have entered the step
and ends for both when it arrives. No message costs an event: kernels work on tables of messages and ranks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.hardware.schedules import Schedule

Array = NDArray[Any]

_MESSAGE: Final = np.dtype(
    [
        ("step", "i4"),
        ("source", "i4"),
        ("target", "i4"),
        ("state", "i4"),
        ("nbytes", "f8"),  # not a number until its sender has said
        ("work", "i8"),  # ticks to combine it
        ("gap", "i8"),  # ticks for which it keeps its sender's adapter, if it is eager
        ("start", "i8"),  # when it leaves, or NEVER
        ("offered", "i8"),  # when its sender would be ready for a rendezvous, and
        ("awaited", "i8"),  # since when its receiver waits; or NEVER
    ]
)
_RANK: Final = np.dtype(
    [
        ("ready", "i8"),  # the tick of entering its step
        ("last", "i8"),  # the latest end of a message of its step
        ("work", "i8"),  # ticks to combine what it receives in its step
        ("pending", "i8"),  # messages of its step that have not ended
        ("run", "i8"),  # the first and
        ("left", "i8"),  # the last of a run of messages of its step that leave just an overhead apart
        ("entered", "i8"),  # the first of its messages of its step
        ("send", "i8"),  # the next of its messages, in the order of steps
        ("send_end", "i8"),
        ("receive", "i8"),
        ("receive_end", "i8"),
    ]
)
_NEVER: Final = -1
_OPEN, _ENDED = 0, 1
_LAST_STEP: Final = 2**31 - 1
_LEAVING, _FINISHED = 0, 1  # counters

_NO_SIZES: Final = np.zeros(0)
_NO_GAPS: Final = np.zeros(0, np.int64)
_LONG_AGO: Final = -(2**62)

_kernel = njit(cache=True, nogil=True, error_model="numpy")


@_kernel
def _leave(
    messages: Array, ranks: Array, sends: Array, leaving: Array, counters: Array, overhead: int, m: int, start: int
) -> int:
    """Let a message leave, as soon as its sender has an overhead to spare for it; return when.

    Others may leave later that were let go before, because their receivers are known to enter the step later.
    """
    r = messages[m].source
    if overhead > 0 and start < ranks[r].left + overhead:
        if start > ranks[r].run - overhead:
            start = ranks[r].left + overhead
        else:  # perhaps before the run
            i = ranks[r].entered
            while i < ranks[r].send:
                other = messages[sends[i]].start
                i += 1
                if other != _NEVER and abs(other - start) < overhead:
                    start = other + overhead
                    i = ranks[r].entered
    if start > ranks[r].left + overhead:
        ranks[r].run = start
    ranks[r].left = max(ranks[r].left, start)
    messages[m].start = start
    leaving[counters[_LEAVING]] = m
    counters[_LEAVING] += 1
    return start


@_kernel
def _proceed(
    messages: Array, ranks: Array, sends: Array, receives: Array, leaving: Array, finished: Array, counters: Array,
    overhead: int, eager: float, adapters: Array, places: Array, r: int,
) -> None:  # fmt: skip
    """Let a rank enter its next steps, until one keeps it waiting."""
    while True:
        step = _LAST_STEP
        if ranks[r].send < ranks[r].send_end:
            step = messages[sends[ranks[r].send]].step
        if ranks[r].receive < ranks[r].receive_end:
            step = min(step, messages[receives[ranks[r].receive]].step)
        if step == _LAST_STEP:
            finished[counters[_FINISHED]] = r
            counters[_FINISHED] += 1
            return
        ready = ranks[r].ready
        last, work, pending, free = ready, 0, 0, ready
        ranks[r].entered, ranks[r].run, ranks[r].left = ranks[r].send, _LONG_AGO, _LONG_AGO
        while ranks[r].send < ranks[r].send_end:
            m = sends[ranks[r].send]
            if messages[m].step != step:
                break
            ranks[r].send += 1
            if messages[m].state == _ENDED:
                continue  # nothing to send
            if messages[m].nbytes <= eager:
                start = max(free, adapters[places[r]]) + overhead
                free = _leave(messages, ranks, sends, leaving, counters, overhead, m, start)
                adapters[places[r]] = free + messages[m].gap
                last = max(last, free)
            else:
                pending += 1
                messages[m].offered = free
                if messages[m].awaited != _NEVER:
                    start = max(free, messages[m].awaited) + overhead
                    _leave(messages, ranks, sends, leaving, counters, overhead, m, start)
                free += overhead
        while ranks[r].receive < ranks[r].receive_end:
            m = receives[ranks[r].receive]
            if messages[m].step != step:
                break
            ranks[r].receive += 1
            work += messages[m].work
            messages[m].awaited = ready
            if messages[m].state == _OPEN:
                pending += 1
                if messages[m].offered != _NEVER:
                    start = max(messages[m].offered, ready) + overhead
                    _leave(messages, ranks, sends, leaving, counters, overhead, m, start)
        ranks[r].last, ranks[r].work, ranks[r].pending = last, work, pending
        if pending > 0:
            return
        ranks[r].ready = last + work


@_kernel
def _end(
    messages: Array, ranks: Array, sends: Array, receives: Array, leaving: Array, finished: Array, counters: Array,
    overhead: int, eager: float, adapters: Array, places: Array, r: int, now: int,
) -> None:  # fmt: skip
    """End one of the messages that a rank waits for."""
    ranks[r].last = max(ranks[r].last, now)
    ranks[r].pending -= 1
    if ranks[r].pending == 0:
        ranks[r].ready = ranks[r].last + ranks[r].work
        _proceed(
            messages, ranks, sends, receives, leaving, finished, counters, overhead, eager, adapters, places, r
        )  # fmt: skip


@_kernel
def _begin(
    messages: Array, ranks: Array, sends: Array, receives: Array, leaving: Array, finished: Array, counters: Array,
    overhead: int, eager: float, adapters: Array, places: Array, r: int, now: int, sizes: Array, gaps: Array,
    sends_empty: bool,
) -> None:  # fmt: skip
    """Let a rank begin; with sizes, those of what it sends are known from now on."""
    counters[:] = 0
    if len(sizes):
        for i in range(ranks[r].send, ranks[r].send_end):
            m = sends[i]
            target = messages[m].target
            messages[m].nbytes, messages[m].gap = sizes[target], gaps[target]
            if sizes[target] == 0.0 and not sends_empty:
                messages[m].state = _ENDED
                if messages[m].awaited != _NEVER:
                    _end(
                        messages, ranks, sends, receives, leaving, finished, counters, overhead, eager, adapters,
                        places, target, now,
                    )  # fmt: skip
    ranks[r].ready = now
    _proceed(
        messages, ranks, sends, receives, leaving, finished, counters, overhead, eager, adapters, places, r
    )  # fmt: skip
    _sort(messages, leaving, counters[_LEAVING])


@_kernel
def _arrive(
    messages: Array, ranks: Array, sends: Array, receives: Array, leaving: Array, finished: Array, counters: Array,
    overhead: int, eager: float, adapters: Array, places: Array, now: int, keys: Array,
) -> None:  # fmt: skip
    """Let messages arrive."""
    counters[:] = 0
    for m in keys:
        messages[m].state = _ENDED
        if messages[m].awaited != _NEVER:
            _end(
                messages, ranks, sends, receives, leaving, finished, counters, overhead, eager, adapters, places,
                messages[m].target, now,
            )  # fmt: skip
        if messages[m].offered != _NEVER:
            _end(
                messages, ranks, sends, receives, leaving, finished, counters, overhead, eager, adapters, places,
                messages[m].source, now,
            )  # fmt: skip
    _sort(messages, leaving, counters[_LEAVING])


@_kernel
def _sort(messages: Array, leaving: Array, count: int) -> None:
    """Sort by source, then by place in the schedule."""
    if count > 1:
        keys = np.empty(count, np.int64)
        for i in range(count):
            keys[i] = messages[leaving[i]].source * np.int64(len(messages)) + leaving[i]
        keys.sort()
        for i in range(count):
            leaving[i] = keys[i] % len(messages)


class Execution:
    """A schedule under way.

    Parameters
    ----------
    table : Schedule
    work : int64 array, (messages,)
        The ticks that its target takes to combine each message.
    overhead : int
        Ticks between messages that a rank sends in one step, and before the first.
    eager : float
        The size in bytes up to which a message does not wait for its receiver.
    post : callable
        Called with ``(sources, targets, nbytes, starts, keys)`` for messages that leave, sorted by source; the caller
        hands the keys back to `arrive`.
    finish : callable
        Called with ``(rank, tick)`` once it is known when a rank will be done.
    gaps : int64 array, (messages,), optional
        The ticks for which each message keeps its sender's adapter, if it is eager; none unless given.
    adapters : int64 array, (k,), optional
        Until when the adapter of each rank of a transport is busy with eager messages; it is kept up to date. Its own,
        unless given.
    places : int64 array, (ranks,), optional
        Which of these belongs to each rank; as they are numbered, unless given.
    by_row : bool
        Whether each rank brings the sizes and gaps of what it sends when it begins.
    sends_empty : bool
        Whether messages without bytes are sent nevertheless. One that is not ends when its sender begins.

    """

    def __init__(
        self,
        table: Schedule,
        work: NDArray[np.int64],
        overhead: int,
        eager: float,
        post: Callable[[Array, Array, Array, Array, Array], None],
        finish: Callable[[int, int], None],
        *,
        gaps: NDArray[np.int64] | None = None,
        adapters: NDArray[np.int64] | None = None,
        places: NDArray[np.int64] | None = None,
        by_row: bool = False,
        sends_empty: bool = True,
    ) -> None:
        messages = np.zeros(len(table), _MESSAGE)
        for name in ("step", "source", "target", "nbytes"):
            messages[name] = getattr(table, name)
        if by_row:
            messages["nbytes"] = np.nan
        messages["work"] = work
        if gaps is not None:
            messages["gap"] = gaps
        messages["start"] = messages["offered"] = messages["awaited"] = _NEVER
        ranks = np.zeros(table.ranks, _RANK)
        orders: list[Array] = []
        for begin, end, ends in (("send", "send_end", table.source), ("receive", "receive_end", table.target)):
            bounds = np.cumsum(np.bincount(ends, minlength=table.ranks))
            ranks[end], ranks[begin][1:] = bounds, bounds[:-1]
            orders.append(np.argsort(ends, kind="stable"))
        self._messages, self._ranks, self._sends_empty = messages, ranks, sends_empty
        self._leaving = np.zeros(len(table), np.int64)
        self._finished = np.zeros(table.ranks, np.int64)
        self._counters = np.zeros(2, np.int64)
        self._post, self._finish = post, finish
        self._state = (
            messages, ranks, orders[0], orders[1], self._leaving, self._finished, self._counters, overhead,
            float(eager),
            np.full(table.ranks, _LONG_AGO) if adapters is None else adapters,
            np.arange(table.ranks) if places is None else places,
        )  # fmt: skip

    def begin(
        self, rank: int, now: int, sizes: NDArray[np.float64] = _NO_SIZES, gaps: NDArray[np.int64] = _NO_GAPS
    ) -> None:
        """Let a rank begin; `sizes` and `gaps`, (ranks,), are of what it sends, if it was said that it brings them."""
        _begin(*self._state, rank, now, sizes, gaps, self._sends_empty)
        self._go_on()

    def arrive(self, keys: NDArray[np.int64], tick: int) -> None:
        """Let messages arrive that were posted."""
        _arrive(*self._state, tick, keys)
        self._go_on()

    def _go_on(self) -> None:
        leaving, finished = self._counters.tolist()
        if leaving:
            keys = self._leaving[:leaving].copy()
            rows = self._messages[keys]
            self._post(rows["source"], rows["target"], rows["nbytes"], rows["start"], keys)
        for rank in self._finished[:finished].tolist():
            self._finish(rank, int(self._ranks["ready"][rank]))
