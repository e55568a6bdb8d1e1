"""Communicators: ranks that meet in collectives, and send each other messages.

Each rank acts for itself, as in an MPI program, and gets an event that succeeds when it is done::

    comm = Communicator(env, transport)
    me = comm.rank(3)
    yield me.allreduce(4096)
    yield me.isend(0, 1e6, tag=7)

A rank may begin a collective before it is done with another; they then run side by side, as nonblocking ones do.
"""

from __future__ import annotations

import bisect
import functools
import math
import operator
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, cast

import numpy as np
import simpy
from numpy.typing import ArrayLike, NDArray

from simrender.clock import to_seconds, to_ticks
from simrender.errors import ScheduleError
from simrender.hardware.executor import Execution
from simrender.hardware.mpi import Transport, choose
from simrender.hardware.schedules import Schedule, schedule

Color = TypeVar("Color", bound=Hashable)

_schedules = functools.lru_cache(maxsize=16)(schedule)  # a frame repeats few collectives, and large ones are large


@dataclass(frozen=True, slots=True)
class Message:
    """What a receive got.

    Attributes
    ----------
    source : int
        The rank that sent it, in the communicator.
    tag : int
    nbytes : float
    tick : int
        When the receiver had it.
    messages : int
        More than one if it is a train.

    """

    source: int
    tag: int
    nbytes: float
    tick: int
    messages: int = 1


def run_until(event: simpy.Event, *communicators: Communicator) -> Any:
    """Run a simulation until an event has succeeded; return its value.

    Raises
    ------
    ScheduleError
        If nothing is left to happen before, with what the communicators still wait for (`Communicator.unmatched`).

    """
    try:
        while not event.processed:
            event.env.step()
    except simpy.core.EmptySchedule:
        waits = "\n".join(filter(None, (communicator.unmatched() for communicator in communicators)))
        seconds = to_seconds(int(event.env.now))
        raise ScheduleError(f"the ranks came to a standstill at {seconds:.9g} s: {waits or 'nobody acts'}") from None
    return event.value


class Communicator:
    """Ranks that communicate with each other and nobody else.

    Parameters
    ----------
    env : simpy.Environment
        Its time is an integer number of ticks.
    transport : Transport
    ranks : sequence of int, optional
        The transport's ranks that belong to it, each once; all, unless given. They are numbered from 0 in this order.

    Attributes
    ----------
    ranks : tuple of int

    Raises
    ------
    ScheduleError
        If the transport has no such rank, or one stands twice.

    """

    def __init__(self, env: simpy.Environment, transport: Transport, ranks: Sequence[int] | None = None) -> None:
        self.env, self.transport = env, transport
        self.ranks = tuple(range(transport.size) if ranks is None else map(operator.index, ranks))
        if not self.ranks or len(set(self.ranks)) < len(self.ranks):
            raise ScheduleError(f"a communicator needs at least one rank, and each once, got {list(self.ranks)}")
        for rank in self.ranks:
            if not 0 <= rank < transport.size:
                raise ScheduleError(f"there is no rank {rank} to communicate: there are 0 to {transport.size - 1}")
        self._numbers = np.array(self.ranks, np.int64)
        self._members: dict[int, Rank] = {}
        self._calls = [0] * self.size  # collectives that each rank has called
        self._collectives: dict[int, _Collective] = {}
        self._mailboxes: dict[int, _Mailbox] = {}
        self._sends: dict[int, _Sent] = {}  # under way
        self._sent = self._shown = 0

    @property
    def size(self) -> int:
        """How many ranks it has."""
        return len(self.ranks)

    def rank(self, index: int) -> Rank:
        """Return one of its ranks, through which that acts.

        Raises
        ------
        ScheduleError
            If it has no such rank.

        """
        self._check_rank(index)
        if index not in self._members:
            self._members[index] = Rank(self, index)
        return self._members[index]

    def split(self, colors: Sequence[Color | None], keys: Sequence[Any] | None = None) -> dict[Color, Communicator]:
        """Return a communicator for each color, as MPI_Comm_split; it takes no time.

        Parameters
        ----------
        colors : sequence of hashable or None, (size,)
            Ranks of one color belong together; None belongs nowhere.
        keys : sequence, (size,), optional
            Ranks of a communicator are numbered by their keys, and where those are equal as they were.

        Returns
        -------
        dict
            By color, in the order in which the colors first occur.

        Raises
        ------
        ScheduleError
            If there is not one color, or not one key, for each rank.

        """
        for name, values in (("color", colors), ("key", keys)):
            if values is not None and len(values) != self.size:
                raise ScheduleError(f"split needs a {name} for each of {self.size} ranks, got {len(values)}")
        members: dict[Color, list[int]] = {}
        for index, color in enumerate(colors):
            if color is not None:
                members.setdefault(color, []).append(index)
        if keys is not None:
            for group in members.values():
                group.sort(key=keys.__getitem__)
        return {
            color: Communicator(self.env, self.transport, [self.ranks[index] for index in group])
            for color, group in members.items()
        }

    def unmatched(self) -> str:
        """Return what still waits for somebody else, a line each: messages, receives and collectives; or nothing.

        At the end of a simulation that is what was forgotten, or why it came to a standstill.
        """
        lines = []
        for target in range(self.size):
            if target in self._mailboxes:
                box = self._mailboxes[target]
                left = [message for queue in box.messages.values() for message in queue]
                lines += [f"{m} {'was' if m.messages == 1 else 'were'} never received" for m in left]
                lines += [f"{receive} never got a message" for receive in box.receives]
        for number, collective in self._collectives.items():
            absent = [str(rank) for rank, calls in enumerate(self._calls) if calls <= number]
            if absent:
                lines.append(f"{collective.call} was never called by rank {', '.join(absent)}")
        return "\n".join(lines)

    @property
    def _now(self) -> int:
        return cast("int", self.env.now)

    def _check_rank(self, index: int) -> None:
        if not 0 <= operator.index(index) < self.size:
            raise ScheduleError(f"there is no rank {index}: the communicator has 0 to {self.size - 1}")

    def _post(
        self, sources: Any, targets: Any, nbytes: Any, starts: Any, listener: Any, keys: NDArray[np.int64]
    ) -> None:
        self.transport.post(self._numbers[sources], self._numbers[targets], nbytes, starts, listener, keys)

    # -- collectives ------------------------------------------------------------------------------------------------

    def _call(self, rank: int, call: _Call, row: NDArray[np.float64] | None) -> simpy.Event:
        number = self._calls[rank]
        collective = self._collectives.get(number)
        if collective is None:
            collective = self._collectives[number] = _Collective(self, rank, call)
        elif collective.call != call:
            raise ScheduleError(
                f"rank {rank} called {call} where rank {collective.caller} called {collective.call}: the ranks of a "
                f"communicator call the same collectives in the same order, with the same arguments"
            )
        self._calls[rank] += 1
        collective.missing -= 1
        if not collective.missing:
            del self._collectives[number]  # the network's listener keeps it until it is over
        return collective.begin(rank, row)

    # -- messages ---------------------------------------------------------------------------------------------------

    def _isend(self, source: Rank, target: int, nbytes: float, tag: int, messages: int) -> simpy.Event:
        self._check_rank(target)
        if not 0.0 <= nbytes < math.inf:
            raise ScheduleError(f"a message's size must be finite and not negative, got {nbytes!r} B")
        if operator.index(messages) < 1:
            raise ScheduleError(f"at least 1 message is sent, got {messages}")
        is_eager = nbytes / messages <= self.transport.card.eager
        ready = max(self._now, source.free_at)
        if is_eager:
            place, busy_until = self.ranks[source.index], self.transport.busy_until
            ready = max(ready, int(busy_until[place]))
        source.free_at = ready + messages * self.transport.overhead_ticks
        sent = _Sent(self._sent, source.index, target, tag, float(nbytes), ready, simpy.Event(self.env), messages)
        self._sent += 1
        self._mailbox(target).messages.setdefault(sent.source, []).append(sent)
        if is_eager:
            tick = self._leave(sent, ready)
            _, s_per_byte = self.transport.alpha_beta(place, self.ranks[target], sent.each)
            gap = to_ticks(sent.each * s_per_byte)
            last = tick + (messages - 1) * (gap + self.transport.overhead_ticks)
            busy_until[place] = last + gap
            source.free_at = last
            _succeed_at(sent.done, last, last)
        else:
            self._show(sent)
        return sent.done

    def _irecv(self, target: int, source: int | None, tag: int | None) -> simpy.Event:
        if source is not None:
            self._check_rank(source)
        receive = _Receive(target, source, tag, simpy.Event(self.env))
        self._mailbox(target).receives.append(receive)
        self._serve([receive])
        return receive.done

    def _mailbox(self, target: int) -> _Mailbox:
        if target not in self._mailboxes:
            self._mailboxes[target] = _Mailbox()
        return self._mailboxes[target]

    def _leave(self, sent: _Sent, ready: int) -> int:
        """Send a message as soon as its sender has an overhead to spare for it; return when."""
        overhead, source = self.transport.overhead_ticks, self._members[sent.source]
        tick, leaving = ready + overhead, source.leaving
        del leaving[: bisect.bisect_right(leaving, self._now)]
        for other in leaving[bisect.bisect_right(leaving, tick - overhead) :]:
            if other - tick >= overhead:
                break
            tick = other + overhead
        bisect.insort(leaving, tick)
        count = None
        if sent.messages > 1:
            bisect.insort(leaving, tick + (sent.messages - 1) * overhead)
            count = np.array([sent.messages])
        self._sends[sent.number] = sent
        self.transport.post(
            self._numbers[[sent.source]], self._numbers[[sent.target]], np.array([sent.nbytes]), np.array([tick]),
            self._arrive, np.array([sent.number]), count,
        )  # fmt: skip
        return tick

    def _arrive(self, keys: NDArray[np.int64], tick: int) -> None:
        for number in keys.tolist():
            sent = self._sends.pop(number)
            if sent.receive is None:  # eager
                self._show(sent)
            else:
                _succeed_at(sent.done, tick, tick)
                _succeed_at(sent.receive.done, tick, sent.as_message(tick))

    def _show(self, sent: _Sent) -> None:
        """Let receives have a message, or another one that those who wait for this one were kept from."""
        self._shown += 1
        sent.shown = self._shown
        self._serve([receive for receive in self._mailbox(sent.target).receives if receive.fits(sent)])

    def _serve(self, receives: list[_Receive]) -> None:
        """Give receives their messages, if those are there."""
        for receive in receives:
            box = self._mailbox(receive.target)
            sent = box.first_for(receive)
            if sent is None:
                continue
            box.receives.remove(receive)
            box.messages[sent.source].remove(sent)
            if not box.messages[sent.source]:
                del box.messages[sent.source]
            if sent.each <= self.transport.card.eager:
                _succeed_at(receive.done, self._now, sent.as_message(self._now))
            else:
                sent.receive = receive
                self._leave(sent, max(sent.ready, self._now))  # later than both if an earlier message kept it back


def _succeed_at(event: simpy.Event, tick: int, value: Any) -> None:
    """Let an event succeed at a tick, now or later, as SimPy's timeouts do."""
    event._ok = True
    event._value = value
    event.env.schedule(event, delay=tick - event.env.now)


@dataclass(frozen=True, slots=True)
class _Call:
    """A collective as a rank calls it; those of all ranks must be equal."""

    name: str
    sizes: tuple[float, ...]
    is_vector: bool
    root: int
    algorithm: str | None

    def schedule(self, algorithm: str, ranks: int) -> Schedule:
        """Return its messages; of an alltoallv, those of an alltoall, because each rank brings its own sizes."""
        if self.name == "alltoallv":
            return _schedules("alltoall", algorithm, ranks)
        if self.is_vector:
            return schedule(self.name, algorithm, ranks, self.sizes, self.root)
        return _schedules(self.name, algorithm, ranks, *self.sizes, root=self.root)

    def __str__(self) -> str:
        shown = [f"{size:.17g}" for size in self.sizes]
        if self.is_vector:
            shown = [f"[{', '.join(shown if len(shown) <= 8 else [*shown[:8], '...'])}]"]
        elif self.name == "alltoallv":
            shown = ["[...]"]
        shown += [f"root={self.root}"] * (self.root > 0)
        shown += [f"algorithm={self.algorithm!r}"] * (self.algorithm is not None)
        return f"{self.name}({', '.join(shown)})"


class _Collective:
    """One collective of a communicator: who called it first, how many have yet to, and its execution."""

    def __init__(self, comm: Communicator, caller: int, call: _Call) -> None:
        self.comm, self.caller, self.call, self.missing = comm, caller, call, comm.size
        transport = comm.transport
        mean = math.fsum(call.sizes) / len(call.sizes) if call.name == "allgatherv" else math.fsum(call.sizes)
        algorithm = call.algorithm or choose(transport.card.flavour, call.name, comm.size, mean)
        table = call.schedule(algorithm, comm.size)
        self.events: dict[int, simpy.Event] = {}
        by_row = call.name == "alltoallv"
        places = comm._numbers
        self.execution = Execution(
            table,
            transport.reduce_ticks(table.reduce_bytes),
            transport.overhead_ticks,
            float(transport.card.eager),
            self._post,
            self._finish,
            gaps=None if by_row else transport.gap_ticks(places[table.source], places[table.target], table.nbytes),
            adapters=transport.busy_until,
            places=places,
            by_row=by_row,
            sends_empty=call.name != "alltoallv" or algorithm == "pairwise",
        )

    def begin(self, rank: int, row: NDArray[np.float64] | None) -> simpy.Event:
        """Let a rank begin; return the event of its being done."""
        done = self.events[rank] = simpy.Event(self.comm.env)
        if row is None:
            self.execution.begin(rank, self.comm._now)
        else:
            places = self.comm._numbers
            moved = np.where(np.arange(len(row)) == rank, 0.0, row)
            gaps = self.comm.transport.gap_ticks(np.full(len(row), places[rank]), places, moved)
            self.execution.begin(rank, self.comm._now, row, gaps)
        return done

    def _post(self, sources: Any, targets: Any, nbytes: Any, starts: Any, keys: NDArray[np.int64]) -> None:
        self.comm._post(sources, targets, nbytes, starts, self.execution.arrive, keys)

    def _finish(self, rank: int, tick: int) -> None:
        _succeed_at(self.events[rank], tick, tick)


@dataclass(slots=True, eq=False)
class _Sent:
    """A message that was sent and that no receive has got yet."""

    number: int
    source: int
    target: int
    tag: int
    nbytes: float
    ready: int
    done: simpy.Event
    messages: int = 1
    shown: int = 0  # after how many others receives could have it: once arrived, or at once if it waits for one
    receive: _Receive | None = None

    @property
    def each(self) -> float:
        return self.nbytes / self.messages

    def as_message(self, tick: int) -> Message:
        return Message(self.source, self.tag, self.nbytes, tick, self.messages)

    def __str__(self) -> str:
        what = "a message of" if self.messages == 1 else f"{self.messages} messages of together"
        return f"{what} {self.nbytes:.17g} B, tag {self.tag}, from rank {self.source} to rank {self.target}"


@dataclass(slots=True, eq=False)
class _Receive:
    """A receive that has got no message yet."""

    target: int
    source: int | None
    tag: int | None
    done: simpy.Event

    def fits(self, sent: _Sent) -> bool:
        return self.source in {None, sent.source} and self.tag in {None, sent.tag}

    def __str__(self) -> str:
        source = "any rank" if self.source is None else f"rank {self.source}"
        return f"a receive of rank {self.target} from {source}, {'any tag' if self.tag is None else f'tag {self.tag}'}"


class _Mailbox:
    """What was sent to a rank, by source in the order of sending, and its receives in the order of posting."""

    def __init__(self) -> None:
        self.messages: dict[int, list[_Sent]] = {}
        self.receives: list[_Receive] = []

    def first_for(self, receive: _Receive) -> _Sent | None:
        """Return the message that a receive gets, if it is there.

        Messages of one sender do not overtake each other: the first that fits is taken, or waited for. Of several
        senders' messages the one that was there first is taken.
        """
        if receive.source is None and receive.tag is None:
            there = [queue[0] for queue in self.messages.values() if queue[0].shown]
            return min(there, key=lambda sent: sent.shown, default=None)
        sources = self.messages if receive.source is None else [receive.source]
        firsts = [next(filter(receive.fits, self.messages.get(source, ())), None) for source in sources]
        there = [sent for sent in firsts if sent is not None and sent.shown]
        return min(there, key=lambda sent: sent.shown, default=None)


class Rank:
    """One rank of a communicator: what an MPI program would do there.

    Sizes are in bytes; what they mean stands in `simrender.hardware.schedules`. The algorithm of a collective is the
    one that the card's library would take (`simrender.hardware.mpi.choose`), or the one asked for. The value of an
    event is the tick at which it succeeds, unless said otherwise.

    Attributes
    ----------
    index : int
        Its number in the communicator.
    free_at : int
        The tick at which the last of its own sends has cost its overhead.
    leaving : list of int
        The ticks at which messages leave that have yet to.

    """

    def __init__(self, comm: Communicator, index: int) -> None:
        self.comm, self.index, self.free_at = comm, index, 0
        self.leaving: list[int] = []

    def barrier(self, *, algorithm: str | None = None) -> simpy.Event:
        """Wait until all have come."""
        return self._collective("barrier", 0.0, 0, algorithm)

    def bcast(self, nbytes: float, root: int = 0, *, algorithm: str | None = None) -> simpy.Event:
        """Get the root's vector."""
        return self._collective("bcast", nbytes, root, algorithm)

    def reduce(self, nbytes: float, root: int = 0, *, algorithm: str | None = None) -> simpy.Event:
        """Have the root combine the vectors of all."""
        return self._collective("reduce", nbytes, root, algorithm)

    def allreduce(self, nbytes: float, *, algorithm: str | None = None) -> simpy.Event:
        """Combine the vectors of all, for all."""
        return self._collective("allreduce", nbytes, 0, algorithm)

    def allgather(self, nbytes: float, *, algorithm: str | None = None) -> simpy.Event:
        """Get what all contribute, as much each."""
        return self._collective("allgather", nbytes, 0, algorithm)

    def allgatherv(self, sizes: ArrayLike, *, algorithm: str | None = None) -> simpy.Event:
        """Get what all contribute; `sizes`, (size,), are the same on all ranks."""
        return self._collective("allgatherv", sizes, 0, algorithm)

    def alltoall(self, nbytes: float, *, algorithm: str | None = None) -> simpy.Event:
        """Send as much to each rank, and receive as much."""
        return self._collective("alltoall", nbytes, 0, algorithm)

    def alltoallv(self, sizes: ArrayLike, *, algorithm: str | None = None) -> simpy.Event:
        """Send to each rank; `sizes`, (size,), are what this one sends, that to itself being ignored.

        But for the pairwise exchange, nothing is sent where there is nothing to send. A receiver knows of that when the
        sender calls, so no rank is done before all have called.
        """
        return self._collective("alltoallv", sizes, 0, algorithm)

    def gather(self, nbytes: float, root: int = 0, *, algorithm: str | None = None) -> simpy.Event:
        """Give the root what all contribute, as much each."""
        return self._collective("gather", nbytes, root, algorithm)

    def gatherv(self, sizes: ArrayLike, root: int = 0, *, algorithm: str | None = None) -> simpy.Event:
        """Give the root what all contribute; `sizes`, (size,), are the same on all ranks."""
        return self._collective("gatherv", sizes, root, algorithm)

    def reduce_scatter(self, nbytes: ArrayLike, *, algorithm: str | None = None) -> simpy.Event:
        """Combine the vectors of all, for each rank its part: an equal one, or `nbytes` as a vector, (size,)."""
        return self._collective("reduce_scatter", nbytes, 0, algorithm)

    def _collective(self, name: str, nbytes: ArrayLike, root: int, algorithm: str | None) -> simpy.Event:
        sizes = np.asarray(nbytes, np.float64)
        if not (np.isfinite(sizes).all() and (sizes >= 0.0).all()):
            raise ScheduleError(f"the sizes of {name} must be finite and not negative, got {nbytes!r}")
        is_vector = name in {"allgatherv", "alltoallv", "gatherv"} or (name == "reduce_scatter" and sizes.ndim == 1)
        shape = (self.comm.size,) if is_vector else ()
        if sizes.shape != shape:
            expected = f"{self.comm.size} sizes, one a rank" if is_vector else "one size"
            raise ScheduleError(f"{name} takes {expected}, got an array of shape {sizes.shape}")
        self.comm._check_rank(root)
        if name == "alltoallv":
            return self.comm._call(self.index, _Call(name, (), False, root, algorithm), sizes)
        values = () if name == "barrier" else tuple(np.atleast_1d(sizes).tolist())
        return self.comm._call(self.index, _Call(name, values, is_vector, root, algorithm), None)

    def isend(self, target: int, nbytes: float, tag: int = 0, messages: int = 1) -> simpy.Event:
        """Send a message; done when it has left, or when it has arrived if it is too large to be eager.

        Sends of one rank leave at least an overhead apart, and an eager one not before the rank's adapter can be
        through with the eager ones before it, those of collectives among them.

        Parameters
        ----------
        target : int
        nbytes : float
        tag : int
        messages : int
            As how many messages of one size, which are received together, the bytes count: a train. Eager ones follow
            each other; larger ones share the links as so many would.

        Raises
        ------
        ScheduleError
            If there is no such rank or size.

        """
        return self.comm._isend(self, target, nbytes, tag, messages)

    def isend_trains(self, targets: NDArray[np.int64], nbytes: NDArray[np.float64]) -> list[simpy.Event]:
        """Send many messages, those to one rank that the library treats alike as one train.

        A hundred ranks with a dozen messages for each other have a hundred thousand of them on their way. That those of
        a train are equally long and leave together is an approximation; `simrender.policies.speculation` says how good.

        Parameters
        ----------
        targets : int64 array, (n,)
        nbytes : float64 array, (n,)

        Returns
        -------
        list of simpy.Event
            One a train, in the order of their first messages.

        Raises
        ------
        ScheduleError
            If there is no such rank or size.

        """
        classes = self.comm.transport.size_class(nbytes)
        alike = targets * (classes.max(initial=0) + 1) + classes
        _, first, train = np.unique(alike, return_index=True, return_inverse=True)
        total, count = np.bincount(train, nbytes), np.bincount(train)
        return [
            self.isend(int(targets[first[k]]), float(total[k]), messages=int(count[k]))
            for k in np.argsort(first).tolist()
        ]

    def irecv(self, source: int | None = None, tag: int | None = None) -> simpy.Event:
        """Receive a message from a rank, or any, with a tag, or any; the value of the event is the `Message`.

        Receives are served in the order in which they were posted. Of one sender's messages that fit the first is
        taken, even if a later one has arrived before it.

        Raises
        ------
        ScheduleError
            If there is no such rank.

        """
        return self.comm._irecv(self.index, source, tag)
