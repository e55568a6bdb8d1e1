"""The display: render nodes send pixels in messages; one thread receives them, others copy them into the image.

The model is the display process of Ize et al., "Real-time ray tracer for visualization on a cluster", sections 5.2 and
5.5. Messages come through the display node's adapter one after the other, each in whole packets, into a buffer of the
receive thread, which keeps pace with the adapter: the two are one stage here, and are busy together. The copy threads
take the messages out of the buffer in the order in which they came. A frame is complete when its last message is
copied, and a few frames may be in flight at once. What grows with the number of render nodes inside MPI, for instance
its shared receive queues, is not modelled.

Messages that stand at the adapter together and are equal but for a short last one pass both stages in closed form,
exact to the tick, so a frame costs the same to simulate whether it comes in one message or in a million.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, cast

import simpy
from pydantic import Field, model_validator

from simrender.cards import Bandwidth, Card, Duration, Size
from simrender.clock import to_seconds, to_ticks
from simrender.errors import ScheduleError, UsageError

Bottleneck = Literal["adapter", "copy threads", "frames in flight"]
"""What holds a display back."""


class DisplayCard(Card):
    """The display of a machine: one node, or each of the equal nodes of a display wall.

    Attributes
    ----------
    bandwidth : quantity
        Of a display node's adapter, for messages of whole packets.
    packet : quantity
        What the network sends at least; a message takes a whole number of packets. Whole bytes.
    pixel_bytes : quantity
        A pixel that may lie anywhere: its color and its location. Whole bytes.
    tile_pixel_bytes, tile_header : quantity
        A pixel's color where each ray packet is a rectangular tile, and what says where such a tile lies. Whole bytes.
    ray_packet : int
        Pixels that are traced, and sent, together.
    packets_per_message : int
        Ray packets sent in one message.
    copy_bandwidth : quantity
        Of one copy thread, in received payload.
    copy_threads : int
        Threads of a display node that copy received pixels into the image.
    frames_in_flight : int
        So many frames after one that is not complete, no pixel is sent.
    nodes : int
        Display nodes, each with its own adapter and threads, which share the image equally.
    latency : quantity
        From a render node to the display, and as long the other way.

    """

    bandwidth: Bandwidth
    packet: Size
    pixel_bytes: Size
    tile_pixel_bytes: Size
    tile_header: Size
    ray_packet: int = Field(ge=1, strict=True)
    packets_per_message: int = Field(ge=1, strict=True)
    copy_bandwidth: Bandwidth
    copy_threads: int = Field(ge=1, strict=True)
    frames_in_flight: int = Field(ge=1, strict=True)
    nodes: int = Field(ge=1, strict=True)
    latency: Duration

    @model_validator(mode="after")
    def _whole_bytes(self) -> DisplayCard:
        for name, least in (("packet", 1), ("pixel_bytes", 1), ("tile_pixel_bytes", 1), ("tile_header", 0)):
            size = getattr(self, name)
            if size < least or size != int(size):
                raise ValueError(f"{name} must be a whole number of bytes, at least {least}, got {size.text}")
        return self

    @property
    def message_pixels(self) -> int:
        """Pixels of a full message."""
        return self.ray_packet * self.packets_per_message


@dataclass(frozen=True, slots=True)
class MessageLayout:
    """What one message holds and what it takes on the wire.

    Attributes
    ----------
    pixels : int
    payload_bytes : int
        The pixels with their locations, or the tiles with their headers.
    packets : int
        Network packets; the last of them is sent whole, however little of it is used.
    wire_bytes : int

    """

    pixels: int
    payload_bytes: int
    packets: int
    wire_bytes: int

    @property
    def efficiency(self) -> float:
        """The share of the bytes on the wire that is payload."""
        return self.payload_bytes / self.wire_bytes


@dataclass(frozen=True, slots=True)
class FrameLayout:
    """The messages of a frame: some full ones, and a last one that takes what is left.

    Attributes
    ----------
    full : MessageLayout
    full_messages : int
        How many messages are full, not counting the last one; may be 0.
    last : MessageLayout
        At most as large as a full one.

    """

    full: MessageLayout
    full_messages: int
    last: MessageLayout

    @property
    def pixels(self) -> int:
        """Pixels of the frame."""
        return self.full_messages * self.full.pixels + self.last.pixels

    @property
    def messages(self) -> int:
        """Messages of the frame."""
        return self.full_messages + 1

    @property
    def payload_bytes(self) -> int:
        """Payload of the frame."""
        return self.full_messages * self.full.payload_bytes + self.last.payload_bytes

    @property
    def wire_bytes(self) -> int:
        """What the frame takes on the wire: whole packets."""
        return self.full_messages * self.full.wire_bytes + self.last.wire_bytes


@dataclass(frozen=True, slots=True)
class DisplayReport:
    """How fast a display takes frames in, and what holds it back.

    Bytes, messages and utilizations are those of the display node with the largest share of the image, which the frame
    rate of a display wall hangs on.

    Attributes
    ----------
    frames_per_s, frame_time_s : float
        In the steady state.
    payload_bound_frames_per_s : float
        What the adapter could take if a frame were its payload alone.
    bound_frames_per_s : float
        What the adapter can take of whole packets.
    pixels_per_node, messages_per_frame, payload_bytes_per_frame, wire_bytes_per_frame : int
    adapter_utilization : float
        The busy share of the adapter and of the receive thread, from the first message to the last copy.
    copy_utilization : float
        The same of the copy threads, on average.
    bottleneck : str
        The busier of ``adapter`` (with its receive thread) and ``copy threads``; ``frames in flight`` where even that
        one waits longer than it works, for pixels that may not be sent yet.

    """

    frames_per_s: float
    frame_time_s: float
    payload_bound_frames_per_s: float
    bound_frames_per_s: float
    pixels_per_node: int
    messages_per_frame: int
    payload_bytes_per_frame: int
    wire_bytes_per_frame: int
    adapter_utilization: float
    copy_utilization: float
    bottleneck: Bottleneck


def message_layout(card: DisplayCard, pixels: int, *, tiles: bool = False) -> MessageLayout:
    """Return the layout of a message.

    Parameters
    ----------
    card : DisplayCard
    pixels : int
        Pixels in the message, at least 1.
    tiles : bool
        Whether each ray packet is a rectangular tile, so that its location is sent once and not for each pixel.

    Raises
    ------
    UsageError
        If the message has no pixel.

    """
    pixels = _from_one("the pixels of a message", pixels)
    if tiles:
        headers = -(-pixels // card.ray_packet)
        payload = pixels * int(card.tile_pixel_bytes) + headers * int(card.tile_header)
    else:
        payload = pixels * int(card.pixel_bytes)
    packets = -(-payload // int(card.packet))
    return MessageLayout(pixels, payload, packets, packets * int(card.packet))


def frame_layout(
    card: DisplayCard, pixels: int, *, message_pixels: int | None = None, tiles: bool = False
) -> FrameLayout:
    """Return the messages that bring a frame to one display node.

    Parameters
    ----------
    card : DisplayCard
    pixels : int
        Pixels that the node displays, at least 1.
    message_pixels : int, optional
        Pixels of a full message, at least 1; the card's, unless given. A frame may be smaller than that.
    tiles : bool
        As for `message_layout`.

    Raises
    ------
    UsageError
        If the frame or a message has no pixel.

    """
    pixels = _from_one("the pixels of a frame", pixels)
    size = _or_card(card.message_pixels, "message_pixels", message_pixels)
    full_messages = (pixels - 1) // size
    last = message_layout(card, pixels - full_messages * size, tiles=tiles)
    return FrameLayout(message_layout(card, size, tiles=tiles), full_messages, last)


def payload_bound_s(card: DisplayCard, frame: FrameLayout) -> float:
    """Return the seconds that the adapter takes at best for a frame's payload (section 5.5: 7.41 ms for full HD)."""
    return frame.payload_bytes / card.bandwidth


def wire_bound_s(card: DisplayCard, frame: FrameLayout) -> float:
    """Return the seconds that the adapter takes for a frame's packets."""
    return frame.wire_bytes / card.bandwidth


class _Pipeline:
    """The adapter and the copy threads of a display node: first come, first served, in ticks."""

    __slots__ = ("_card", "adapter_busy", "adapter_free", "copy_busy", "threads")

    def __init__(self, card: DisplayCard, copy_threads: int) -> None:
        self._card = card
        self.adapter_free = self.adapter_busy = self.copy_busy = 0
        self.threads = [0] * copy_threads  # when each is free, in order

    def take(self, frame: FrameLayout, tick: int) -> int:
        """Take in messages that stand at the adapter at a tick; return when the last of them has been copied.

        Calls come in order of tick and share one size of full messages, which no message takes longer to copy than. So
        a thread that has just begun one is never free before another that began earlier, and the threads take the full
        messages of a call in turn. One thread's messages come evenly: what delays it most is its first message, its
        last one, or the work it had before.
        """
        card, n, threads = self._card, frame.full_messages, self.threads
        wire, copy = to_ticks(frame.full.wire_bytes / card.bandwidth), self._copy_ticks(frame.full)
        last_wire, last_copy = to_ticks(frame.last.wire_bytes / card.bandwidth), self._copy_ticks(frame.last)
        begin = max(self.adapter_free, tick)
        self.adapter_free = received = begin + n * wire + last_wire
        self.adapter_busy += received - begin
        self.copy_busy += n * copy + last_copy
        done = 0
        for i in range(min(n, len(threads))):
            mine = -(-(n - i) // len(threads))
            first_in = begin + (i + 1) * wire
            last_in = first_in + (mine - 1) * len(threads) * wire
            threads[i] = max(max(threads[i], first_in) + mine * copy, last_in + copy)
            done = max(done, threads[i])
        i = n % len(threads)
        threads[i] = max(threads[i], received) + last_copy
        done = max(done, threads[i])
        threads.sort()
        return done

    def _copy_ticks(self, message: MessageLayout) -> int:
        return to_ticks(message.payload_bytes / self._card.copy_bandwidth)


def simulate_display(
    card: DisplayCard,
    resolution: tuple[int, int],
    *,
    frames: int = 100,
    copy_threads: int | None = None,
    message_pixels: int | None = None,
    nodes: int | None = None,
    tiles: bool = False,
) -> DisplayReport:
    """Return how many frames a second a display takes in, from render nodes that always have the next one ready.

    All messages of a frame are sent at once: the first frames at the start, each other one as soon as the render nodes
    know that the frame `frames_in_flight` before it is complete, which takes them the latency.

    Parameters
    ----------
    card : DisplayCard
    resolution : (int, int)
        Width and height of the whole image, in pixels.
    frames : int
        Frames to measure, after the first `frames_in_flight`, which fill the pipeline.
    copy_threads, message_pixels, nodes : int, optional
        Copy threads of a display node, pixels of a full message, and display nodes; the card's, unless given.
    tiles : bool
        As for `message_layout`.

    Raises
    ------
    UsageError
        If any of these is not a whole number from 1 on, or there are more display nodes than pixels.

    """
    width, height = (_from_one("each side of the resolution", side) for side in resolution)
    frames = _from_one("frames", frames)
    copy_threads = _or_card(card.copy_threads, "copy_threads", copy_threads)
    nodes = _or_card(card.nodes, "nodes", nodes)
    if nodes > width * height:
        raise UsageError(f"{nodes} display nodes cannot share the {width * height} pixels of {width}x{height}")
    # The frames are complete when the fullest node has its share: another one has less to do in each, and no later.
    pixels = -(-width * height // nodes)
    layout = frame_layout(card, pixels, message_pixels=message_pixels, tiles=tiles)
    window, latency = card.frames_in_flight, to_ticks(card.latency)

    pipeline = _Pipeline(card, copy_threads)
    complete: list[int] = []
    for k in range(window + frames):
        sent = complete[k - window] + latency if k >= window else 0
        complete.append(pipeline.take(layout, sent + latency))
    measured, whole = complete[-1] - complete[window - 1], complete[-1] - latency

    adapter_share, copy_share = pipeline.adapter_busy / whole, pipeline.copy_busy / (copy_threads * whole)
    bottleneck: Bottleneck = "adapter" if adapter_share >= copy_share else "copy threads"
    if max(adapter_share, copy_share) < 0.5:  # even the busier one waits longer than it works
        bottleneck = "frames in flight"
    return DisplayReport(
        frames_per_s=frames / to_seconds(measured),
        frame_time_s=to_seconds(measured) / frames,
        payload_bound_frames_per_s=1.0 / payload_bound_s(card, layout),
        bound_frames_per_s=1.0 / wire_bound_s(card, layout),
        pixels_per_node=pixels,
        messages_per_frame=layout.messages,
        payload_bytes_per_frame=layout.payload_bytes,
        wire_bytes_per_frame=layout.wire_bytes,
        adapter_utilization=adapter_share,
        copy_utilization=copy_share,
        bottleneck=bottleneck,
    )


class _Arriving:
    """A frame at the display: the pixels announced and received, and the last tick of copying known so far."""

    __slots__ = ("announced", "complete", "copied_at", "received")

    def __init__(self, env: simpy.Environment) -> None:
        self.announced = self.received = self.copied_at = 0
        self.complete = simpy.Event(env)


class Display:
    """One display node inside a simulation: the sink of the render nodes' pixels.

    The adapter is the display's own, so a network that leads to it should end before that: what arrives there stands
    at the adapter, and is then received and copied.

    Parameters
    ----------
    env : simpy.Environment
        Its time is an integer number of ticks.
    card : DisplayCard
    pixels : int
        Pixels of a frame that this node displays.
    copy_threads, message_pixels : int, optional
        As for `simulate_display`.
    tiles : bool
        As for `message_layout`.

    Raises
    ------
    UsageError
        If a number is not a whole one from 1 on.

    """

    def __init__(
        self,
        env: simpy.Environment,
        card: DisplayCard,
        pixels: int,
        *,
        copy_threads: int | None = None,
        message_pixels: int | None = None,
        tiles: bool = False,
    ) -> None:
        self.card = card
        self._env, self._message_pixels, self._tiles = env, message_pixels, tiles
        self._pixels = frame_layout(card, pixels, message_pixels=message_pixels).pixels
        self._pipeline = _Pipeline(card, _or_card(card.copy_threads, "copy_threads", copy_threads))
        self._layouts: dict[int, FrameLayout] = {}
        self._frames: dict[int, _Arriving] = {}

    @property
    def adapter_busy_ticks(self) -> int:
        """Ticks that the adapter and the receive thread take for all that has reached them."""
        return self._pipeline.adapter_busy

    @property
    def copy_busy_ticks(self) -> int:
        """The same of the copy threads, all together."""
        return self._pipeline.copy_busy

    def complete(self, frame: int) -> simpy.Event:
        """Return the event that succeeds when a frame is complete; its value is that tick.

        Raises
        ------
        ScheduleError
            If there is no such frame: they are counted from 0.

        """
        return self._frame(frame).complete

    def may_send(self, frame: int) -> simpy.Event:
        """Return the event that succeeds when the frame `frames_in_flight` before this one is complete.

        From then on the display has room for pixels of this one. For the first frames it succeeds now.

        Raises
        ------
        ScheduleError
            If there is no such frame.

        """
        self._frame(frame)
        before = frame - self.card.frames_in_flight
        return self.complete(before) if before >= 0 else simpy.Event(self._env).succeed(self._env.now)

    def deliver(self, frame: int, pixels: int, tick: int | None = None) -> simpy.Event:
        """Let pixels of a frame reach the adapter, in full messages and a last one that takes what is left.

        Parameters
        ----------
        frame : int
            Counted from 0.
        pixels : int
            At least 1, and with all others of the frame at most as many as it has.
        tick : int, optional
            When they reach the adapter; now, unless given.

        Returns
        -------
        simpy.Event
            That of `complete`: succeeds when all pixels of the frame have been copied into the image.

        Raises
        ------
        ScheduleError
            If the tick is past, there is no pixel, or the frame gets more than it has; and, when they reach the
            adapter, if the display has no room for them (`may_send`).

        """
        arriving, now = self._frame(frame), cast("int", self._env.now)
        tick = now if tick is None else operator.index(tick)
        if tick < now:
            raise ScheduleError(f"pixels cannot reach a display at tick {tick}, before now, tick {now}")
        left = self._pixels - arriving.announced
        if not 1 <= pixels <= left:
            raise ScheduleError(
                f"frame {frame} of a display has {self._pixels} pixels, of which {arriving.announced} were delivered; "
                f"cannot deliver {pixels} more" + (f", expected 1 to {left}" if left else "")
            )
        arriving.announced += pixels
        if tick == now:
            self._take(frame, pixels)
        else:
            self._call_at(tick, lambda: self._take(frame, pixels))
        return arriving.complete

    def _take(self, frame: int, pixels: int) -> None:
        arriving, now = self._frame(frame), cast("int", self._env.now)
        window = self.card.frames_in_flight
        if frame >= window:
            before = self._frame(frame - window)
            if before.received < self._pixels or before.copied_at > now:
                raise ScheduleError(
                    f"pixels of frame {frame} reached a display before frame {frame - window} was complete, and it "
                    f"takes {window} in flight; wait for may_send({frame}), or raise frames_in_flight"
                )
        layout = self._layouts.get(pixels)
        if layout is None:
            layout = frame_layout(self.card, pixels, message_pixels=self._message_pixels, tiles=self._tiles)
            self._layouts[pixels] = layout
        arriving.copied_at = max(arriving.copied_at, self._pipeline.take(layout, now))
        arriving.received += pixels
        if arriving.received == self._pixels:
            self._call_at(arriving.copied_at, lambda: arriving.complete.succeed(arriving.copied_at))

    def _frame(self, frame: int) -> _Arriving:
        arriving = self._frames.get(frame)
        if arriving is None:
            if frame < 0:
                raise ScheduleError(f"the frames of a display are counted from 0, got {frame}")
            arriving = self._frames[frame] = _Arriving(self._env)
        return arriving

    def _call_at(self, tick: int, action: Callable[[], object]) -> None:
        def ring(_: simpy.Event) -> None:
            action()

        timeout = self._env.timeout(tick - self._env.now)
        assert timeout.callbacks is not None  # noqa: S101 - it lies in the future
        timeout.callbacks.append(ring)


def _or_card(stated: int, what: str, value: int | None) -> int:
    """Return a whole number from 1 on, the card's unless another one is given."""
    return stated if value is None else _from_one(what, value)


def _from_one(what: str, value: int) -> int:
    """Return a whole number from 1 on."""
    try:
        whole = operator.index(value)
    except TypeError:
        whole = 0
    if whole < 1:
        raise UsageError(f"{what} of a display must be a whole number from 1 on, got {value!r}")
    return whole
