"""The display: the figures of Ize et al., sections 5.2 and 5.5, by hand; and message for message against SimPy."""

import itertools
import math
from fractions import Fraction

import pytest
import simpy
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.cards import Document
from simrender.clock import to_seconds, to_ticks
from simrender.errors import CardError, ScheduleError, UsageError
from simrender.hardware.display import (
    Display,
    DisplayCard,
    frame_layout,
    message_layout,
    payload_bound_s,
    simulate_display,
    wire_bound_s,
)
from simrender.hardware.network import Link, Network

HD, WQXGA = (1920, 1080), (2560, 1600)
HD_PIXELS = 1920 * 1080
MIB, GIB = 2**20, 2**30

check = settings(deadline=None, derandomize=True, max_examples=50)

# The copy bandwidth is calibrated to the paper's 55 frames/s with one copy thread: 55/s x 1920 x 1080 x 7 B.
CLUSTER = """\
bandwidth: {value: 1868 MiB/s, source: "section 5.5, ib_read_bw", status: published}
packet: {value: 2 KiB, source: "section 5.2", status: published}
pixel_bytes: {value: 7 B, source: "section 5.5", status: published}
tile_pixel_bytes: {value: 3 B, source: "section 5.5", status: published}
tile_header: {value: 8 B, source: "four coordinates of two bytes", status: assumed}
ray_packet: 64
packets_per_message: 13
copy_bandwidth: {value: 798.336 MB/s, source: "55 frames/s with one copy thread, section 5.5", status: calibrated}
copy_threads: 3
frames_in_flight: 2
nodes: 1
latency: {value: 2 us, source: "MPI over DDR InfiniBand", status: assumed}
"""


def cluster(**changes):
    document = Document(CLUSTER, "card.yaml")
    for name, value in changes.items():
        document.override(DisplayCard, f"{name}={value}", "display")
    return document.validate(DisplayCard)


def small(**changes):
    """A display whose adapter takes a byte a tick, in packets of 4; a pixel is a byte, a full message two packets."""
    sizes = {"packet": "4 B", "pixel_bytes": "1 B", "tile_pixel_bytes": "1 B", "tile_header": "1 B"}
    counts = {"ray_packet": 8, "packets_per_message": 1, "copy_threads": 1, "frames_in_flight": 1, "nodes": 1}
    rates = {"bandwidth": "1 TB/s", "copy_bandwidth": "1 TB/s", "latency": "0 s"}
    return DisplayCard.model_validate({**sizes, **counts, **rates, **changes})


# The paper's figures


def test_a_message_of_13_ray_packets_nearly_fills_three_network_packets():
    message = message_layout(cluster(), 13 * 64)
    assert (message.pixels, message.payload_bytes) == (832, 832 * 7) == (832, 5824)
    assert (message.packets, message.wire_bytes) == (3, 3 * 2048)
    assert message.efficiency == 5824 / 6144
    assert round(100 * message.efficiency) == 95
    assert message_layout(cluster(), 14 * 64).packets == 4  # a fourteenth would begin another


def test_the_payload_of_a_full_hd_image_takes_7_41_ms_which_allows_135_frames_a_second():
    card = cluster()
    frame = frame_layout(card, HD_PIXELS)
    assert frame.payload_bytes == 1920 * 1080 * 7 == 14_515_200
    bound = payload_bound_s(card, frame)
    assert bound == 14_515_200 / (1868 * MIB)
    assert round(1e3 * bound, 2) == 7.41
    assert round(1 / bound) == 135


def test_whole_packets_allow_127_frames_a_second():
    card = cluster()
    frame = frame_layout(card, HD_PIXELS)
    # 2,492 full messages, and 256 pixels in one packet.
    assert (frame.full_messages, frame.last.pixels, frame.last.packets) == (2492, 2_073_600 - 2492 * 832, 1)
    assert frame.messages == 2493
    assert frame.wire_bytes == 2492 * 6144 + 2048 == 15_312_896
    assert math.floor(1 / wire_bound_s(card, frame)) == 127
    assert math.floor((1 / payload_bound_s(card, frame)) * 5824 / 6144) == 127


def test_one_pixel_a_message_takes_two_seconds_a_frame():
    card = cluster()
    frame = frame_layout(card, HD_PIXELS, message_pixels=1)
    assert frame.messages == HD_PIXELS
    assert frame.wire_bytes == 2048 * 1920 * 1080
    assert round(frame.wire_bytes / GIB, 2) == 3.96  # the paper's GB is 2^30, as its MB is 2^20
    report = simulate_display(card, HD, message_pixels=1, frames=5)
    assert report.frame_time_s == pytest.approx(2.1681, rel=1e-4)  # 4,246,732,800 B at 1868 MiB/s
    assert report.bottleneck == "adapter"


def test_one_copy_thread_allows_the_55_frames_a_second_it_was_calibrated_to():
    report = simulate_display(cluster(), HD, copy_threads=1)
    assert report.frames_per_s == pytest.approx(55.0, rel=1e-6)
    assert report.bottleneck == "copy threads"
    assert report.copy_utilization > 0.999
    assert report.adapter_utilization == pytest.approx(55.0 / 127.92, rel=1e-2)


def test_from_three_copy_threads_on_the_receive_thread_is_the_bottleneck_at_2_3_times_the_frame_rate():
    one, three, *more = (simulate_display(cluster(), HD, copy_threads=n) for n in (1, 3, 4, 5, 8))
    assert math.floor(three.frames_per_s) == 127
    assert three.frames_per_s == pytest.approx(three.bound_frames_per_s, rel=1e-6)
    assert three.frames_per_s <= three.bound_frames_per_s
    assert round(three.frames_per_s / one.frames_per_s, 1) == 2.3
    assert three.bottleneck == "adapter"
    assert three.adapter_utilization > 0.999
    for report in more:
        assert report.frames_per_s == pytest.approx(three.frames_per_s, rel=1e-6)
        assert report.bottleneck == "adapter"


def test_two_copy_threads_share_the_work_and_are_still_the_bottleneck():
    report = simulate_display(cluster(), HD, copy_threads=2)
    assert report.frames_per_s == pytest.approx(2 * 55.0, rel=1e-4)
    assert report.bottleneck == "copy threads"


@pytest.mark.parametrize("resolution", [WQXGA, (2048, 2048)])
def test_four_megapixels_allow_about_60_frames_a_second(resolution):
    report = simulate_display(cluster(), resolution)
    assert 60 <= report.frames_per_s < 65


@pytest.mark.parametrize("nodes", [1, 2, 15, 64])
def test_a_display_wall_keeps_its_frame_rate_when_each_node_brings_its_own_pixels(nodes):
    wall = simulate_display(cluster(), (2560 * nodes, 1600), nodes=nodes)
    assert wall == simulate_display(cluster(), WQXGA)


def test_the_fullest_node_of_a_display_wall_decides():
    wall = simulate_display(cluster(), (10, 10), nodes=3)
    assert wall.pixels_per_node == 34
    assert wall == simulate_display(cluster(nodes=3), (10, 10)) == simulate_display(cluster(), (34, 1))


def test_tiles_send_their_location_once():
    card = cluster()
    message = message_layout(card, 832, tiles=True)
    assert message.payload_bytes == 832 * 3 + 13 * 8 == 2600
    assert message.packets == 2
    assert message_layout(card, 65, tiles=True).payload_bytes == 65 * 3 + 2 * 8
    # 13 tiles leave most of the second packet empty, and 10 fit into one: 2,000 of 2,048 B.
    assert message_layout(card, 640, tiles=True).packets == 1
    loose, packed = (simulate_display(card, HD, message_pixels=n, tiles=True) for n in (832, 640))
    assert loose.bottleneck == packed.bottleneck == "adapter"
    assert simulate_display(card, HD).frames_per_s < loose.frames_per_s < packed.frames_per_s
    assert packed.frames_per_s == pytest.approx(1868 * MIB / (3240 * 2048), rel=1e-6)


@pytest.mark.parametrize("tiles", [False, True])
def test_messages_of_any_size_are_whole_packets(tiles):
    card = cluster()
    for pixels in range(1, 5001):
        message = message_layout(card, pixels, tiles=tiles)
        payload = pixels * 3 + math.ceil(pixels / 64) * 8 if tiles else pixels * 7
        assert message.payload_bytes == payload
        assert message.packets == math.ceil(Fraction(payload, 2048))
        assert message.wire_bytes == 2048 * message.packets


@given(pixels=st.integers(1, 10**6), size=st.integers(1, 10**6), tiles=st.booleans())
@check
def test_no_pixel_of_a_frame_is_lost(pixels, size, tiles):
    card = cluster()
    frame = frame_layout(card, pixels, message_pixels=size, tiles=tiles)
    assert frame.pixels == pixels
    assert frame.messages == math.ceil(Fraction(pixels, size))
    assert 1 <= frame.last.pixels <= frame.full.pixels == size
    assert frame.wire_bytes >= frame.payload_bytes >= pixels * (3 if tiles else 7)
    assert frame.wire_bytes % 2048 == 0


# By hand, and the laws


def test_frames_one_at_a_time_by_hand():
    # 20 pixels: messages of 8, 8 and 4. Received at 8, 16, 20 ticks; one thread copies them by 8 + 20 = 28. Then the
    # word to the render nodes and the pixels back take 100 ticks each.
    report = simulate_display(small(latency="100 ps"), (20, 1), frames=7)
    assert report.frame_time_s == pytest.approx(228e-12)
    assert (report.messages_per_frame, report.payload_bytes_per_frame, report.wire_bytes_per_frame) == (3, 20, 20)
    assert report.bottleneck == "frames in flight"
    # The first frame stands at the adapter at tick 100, the eighth is complete 7 x 228 + 28 ticks later.
    assert report.adapter_utilization == report.copy_utilization == 8 * 20 / (7 * 228 + 28)


def test_frames_in_flight_overlap_by_hand():
    # Two in flight keep a copy thread busy that takes two ticks a byte: 40 ticks a frame, 20 of them on the wire.
    report = simulate_display(small(copy_bandwidth="500 GB/s", frames_in_flight=2), (20, 1), frames=50)
    assert report.frame_time_s == pytest.approx(40e-12)
    assert report.bottleneck == "copy threads"
    assert report.adapter_utilization == 52 * 20 / (8 + 52 * 40)
    assert report.copy_utilization == 52 * 40 / (8 + 52 * 40)


def test_more_frames_in_flight_hide_the_latency():
    rates = [simulate_display(cluster(frames_in_flight=n, latency="50 ms"), HD).frames_per_s for n in (1, 2, 4, 8, 16)]
    assert rates == sorted(rates)
    assert rates[0] == pytest.approx(1 / 0.10782, rel=1e-3)  # 100 ms and a frame's 7.82 ms
    assert rates[2] == pytest.approx(4 * rates[0], rel=1e-2)
    assert rates[-1] == pytest.approx(127.92, rel=1e-4)
    assert simulate_display(cluster(latency="50 ms"), HD).bottleneck == "frames in flight"


def test_one_frame_at_a_time_is_held_back_by_what_is_busy_most_of_the_time():
    card = cluster(frames_in_flight=1)
    one, three = (simulate_display(card, HD, copy_threads=n) for n in (1, 3))
    assert (one.bottleneck, three.bottleneck) == ("copy threads", "adapter")
    # Each frame waits for the word, its pixels' way and a first message: 4 us and 3.1 us, before the copies begin.
    wait = 2 * 2e-6 + 6144 / (1868 * MIB)
    assert one.frame_time_s == pytest.approx(1 / 55 + wait, rel=1e-7)


def test_a_message_may_be_larger_than_the_frame():
    report = simulate_display(cluster(), (4, 4), message_pixels=10**9)
    assert (report.messages_per_frame, report.payload_bytes_per_frame, report.wire_bytes_per_frame) == (1, 112, 2048)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_display_of_twice_the_rates_is_twice_as_fast(threads):
    twice = cluster(bandwidth="3736 MiB/s", copy_bandwidth="1596.672 MB/s", latency="1 us")
    slow, fast = (simulate_display(card, HD, copy_threads=threads) for card in (cluster(), twice))
    assert fast.frames_per_s == pytest.approx(2 * slow.frames_per_s, rel=1e-6)
    assert fast.adapter_utilization == pytest.approx(slow.adapter_utilization, rel=1e-6)
    assert fast.bottleneck == slow.bottleneck


@given(
    resolution=st.tuples(st.integers(1, 4000), st.integers(1, 3000)),
    size=st.integers(1, 5000),
    threads=st.integers(1, 6),
    in_flight=st.integers(1, 4),
)
@check
def test_no_report_promises_too_much(resolution, size, threads, in_flight):
    card = cluster(frames_in_flight=in_flight)
    report = simulate_display(card, resolution, message_pixels=size, copy_threads=threads, frames=20)
    assert report.bound_frames_per_s <= report.payload_bound_frames_per_s
    assert 0 < report.adapter_utilization <= 1
    assert 0 < report.copy_utilization <= 1
    assert report.frame_time_s == pytest.approx(1 / report.frames_per_s)
    assert report.wire_bytes_per_frame >= report.payload_bytes_per_frame == 7 * math.prod(resolution)
    if in_flight == 1:
        assert report.frames_per_s <= report.bound_frames_per_s


# Against a simulation of each message, tick for tick


def per_message(card, frames, threads, sizes, latency=0, deliveries=None):
    """Return when each frame is complete, by one SimPy process a message.

    `sizes` are the pixels of a frame's messages; or `deliveries` lists (tick, frame, sizes), in order of tick.
    """
    env = simpy.Environment()
    adapter, copiers = simpy.Resource(env, 1), simpy.Resource(env, threads)
    complete = [simpy.Event(env) for _ in range(frames)]
    left = [0] * frames
    for _, frame, parts in deliveries or [(0, k, sizes) for k in range(frames)]:
        left[frame] += len(parts)

    def message(frame, pixels):
        payload = pixels * int(card.pixel_bytes)
        packets = math.ceil(Fraction(payload, int(card.packet)))
        with adapter.request() as turn:
            yield turn
            yield env.timeout(to_ticks(packets * int(card.packet) / card.bandwidth))
        with copiers.request() as thread:
            yield thread
            yield env.timeout(to_ticks(payload / card.copy_bandwidth))
        left[frame] -= 1
        if not left[frame]:
            complete[frame].succeed(env.now)

    def render_nodes(frame):
        if frame >= card.frames_in_flight:
            yield complete[frame - card.frames_in_flight]
            yield env.timeout(latency)
        yield env.timeout(latency)
        for pixels in sizes:
            env.process(message(frame, pixels))

    def arrivals():
        for tick, frame, parts in deliveries:
            yield env.timeout(tick - env.now)
            for pixels in parts:
                env.process(message(frame, pixels))

    if deliveries:
        env.process(arrivals())
    else:
        for frame in range(frames):
            env.process(render_nodes(frame))
    env.run()
    return [event.value for event in complete]


def parts(pixels, size):
    """Full messages, and what is left."""
    return [size] * (pixels // size) + ([pixels % size] if pixels % size else [])


def delivered(card, frames, pixels, threads, size, latency):
    """Return when each frame is complete, by `Display`."""
    env = simpy.Environment()
    display = Display(env, card, pixels, copy_threads=threads, message_pixels=size)

    def render_nodes(frame):
        yield display.may_send(frame)
        yield env.timeout(latency if frame < card.frames_in_flight else 2 * latency)
        display.deliver(frame, pixels)

    for frame in range(frames):
        env.process(render_nodes(frame))
    env.run()
    return [display.complete(k).value for k in range(frames)]


@given(
    pixels=st.integers(1, 200),
    size=st.integers(1, 60),
    threads=st.integers(1, 5),
    in_flight=st.integers(1, 4),
    latency=st.integers(0, 300),
    wire=st.integers(100, 4000),
    copy=st.integers(30, 4000),
    frames=st.integers(1, 12),
)
@settings(check, max_examples=200)
def test_every_frame_is_complete_at_the_tick_of_a_simulation_message_by_message(
    pixels, size, threads, in_flight, latency, wire, copy, frames
):
    rates = {"bandwidth": f"{wire} GB/s", "copy_bandwidth": f"{copy} GB/s"}
    card = small(**rates, frames_in_flight=in_flight, latency=f"{latency} ps")
    ticks = per_message(card, in_flight + frames, threads, parts(pixels, size), latency)
    assert delivered(card, in_flight + frames, pixels, threads, size, latency) == ticks
    report = simulate_display(card, (pixels, 1), frames=frames, copy_threads=threads, message_pixels=size)
    measured = to_seconds(ticks[-1] - ticks[in_flight - 1])
    assert (report.frame_time_s, report.frames_per_s) == (measured / frames, frames / measured)


@given(pixels=st.integers(1, 200), size=st.integers(1, 60), copy=st.integers(30, 4000), in_flight=st.integers(1, 3))
@check
def test_one_more_copy_thread_never_delays_a_frame(pixels, size, copy, in_flight):
    card = small(copy_bandwidth=f"{copy} GB/s", frames_in_flight=in_flight)
    ticks = [delivered(card, 8, pixels, threads, size, 5) for threads in (1, 2, 3, 4)]
    for fewer, more in itertools.pairwise(ticks):
        assert all(b <= a for a, b in zip(fewer, more, strict=True))


@given(
    gaps=st.lists(st.tuples(st.integers(0, 60), st.integers(0, 2), st.integers(1, 90)), min_size=3, max_size=25),
    threads=st.integers(1, 4),
    size=st.integers(1, 30),
    copy=st.integers(100, 3000),
)
@check
def test_pixels_that_trickle_in_are_copied_at_the_tick_of_a_simulation_message_by_message(gaps, threads, size, copy):
    card = small(copy_bandwidth=f"{copy} GB/s", frames_in_flight=3)
    tick, deliveries, pixels = 0, [], [0, 0, 0]
    for gap, frame, n in gaps:
        tick += gap
        deliveries.append((tick, frame, n))
        pixels[frame] += n
    # All frames have as many pixels: the last deliveries bring what is missing.
    deliveries += [(tick, frame, 1 + max(pixels) - n) for frame, n in enumerate(pixels)]
    oracle = per_message(card, 3, threads, None, deliveries=[(t, k, parts(n, size)) for t, k, n in deliveries])
    env = simpy.Environment()
    display = Display(env, card, 1 + max(pixels), copy_threads=threads, message_pixels=size)
    for tick, frame, n in deliveries:
        display.deliver(frame, n, tick)
    env.run()
    assert [display.complete(k).value for k in range(3)] == oracle
    messages = [m for _, _, n in deliveries for m in parts(n, size)]
    assert display.adapter_busy_ticks == sum(4 * math.ceil(m / 4) for m in messages)
    assert display.copy_busy_ticks == sum(to_ticks(m / card.copy_bandwidth) for m in messages)


# Inside a simulation


def test_render_nodes_send_over_a_network_to_the_display():
    env = simpy.Environment()
    links = {"fast": Link(1e12, 10e-12), "slow": Link(0.5e12, 10e-12)}
    network = Network(env, links, {(name, "display"): [name] for name in links})
    display = Display(env, small(frames_in_flight=1), 16)

    def render_node(name):
        yield network.transfer(name, "display", 8)
        yield display.deliver(0, 8)

    nodes = [env.process(render_node(name)) for name in links]
    done = env.run(display.complete(0))
    # The fast node's message is at the adapter at 18, received at 26, copied at 34. The slow one's is there at 26.
    assert done == env.now == 26 + 8 + 8
    env.run(env.all_of(nodes))
    assert env.now == done


def test_pixels_of_a_frame_that_has_no_room_are_refused():
    env = simpy.Environment()
    display = Display(env, small(frames_in_flight=2), 8)
    display.deliver(0, 8)
    display.deliver(1, 8)
    with pytest.raises(ScheduleError, match=r"frame 2 reached a display before frame 0 was complete.*2 in flight"):
        display.deliver(2, 8)


def test_a_frame_has_room_from_the_tick_on_at_which_the_earlier_one_is_complete():
    for tick, refused in ((15, True), (16, False)):
        env = simpy.Environment()
        display = Display(env, small(), 8)
        display.deliver(1, 8, tick)
        display.deliver(0, 8)
        if refused:
            with pytest.raises(ScheduleError, match=r"wait for may_send\(1\), or raise frames_in_flight"):
                env.run()
        else:
            env.run()
            assert [display.complete(k).value for k in (0, 1)] == [16, 32]


def test_a_frame_costs_as_many_events_in_a_million_messages_as_in_one():
    for pixels in (8, 8 * 10**6):
        env = simpy.Environment()
        Display(env, small(), pixels).deliver(0, pixels)
        events = 0
        while env.peek() < math.inf:
            env.step()
            events += 1
        assert events == 2  # a wake-up, and the frame is complete
        assert env.now == pixels + 8


def test_a_frame_gets_no_more_pixels_than_it_has():
    display = Display(simpy.Environment(), small(), 8)
    display.deliver(0, 5)
    with pytest.raises(
        ScheduleError, match="8 pixels, of which 5 were delivered; cannot deliver 4 more, expected 1 to 3"
    ):
        display.deliver(0, 4)
    with pytest.raises(ScheduleError, match="cannot deliver 0 more"):
        display.deliver(0, 0)
    display.deliver(0, 3)
    with pytest.raises(ScheduleError, match=r"of which 8 were delivered; cannot deliver 1 more$"):
        display.deliver(0, 1)


def test_pixels_do_not_arrive_in_the_past():
    display = Display(simpy.Environment(initial_time=10), small(), 8)
    with pytest.raises(ScheduleError, match="at tick 9, before now, tick 10"):
        display.deliver(0, 8, 9)


def test_frames_are_counted_from_zero():
    display = Display(simpy.Environment(), small(), 8)
    for ask in (display.complete, display.may_send, lambda frame: display.deliver(frame, 8)):
        with pytest.raises(ScheduleError, match="counted from 0, got -1"):
            ask(-1)


# What is refused


@pytest.mark.parametrize("value", [0, -3, 1.5, "4", None])
@pytest.mark.parametrize("name", ["frames", "copy_threads", "message_pixels", "nodes"])
def test_numbers_start_at_one(name, value):
    if value is None and name != "frames":
        assert simulate_display(cluster(), HD, **{name: None}) == simulate_display(cluster(), HD)
        return
    with pytest.raises(UsageError, match=rf"^{name} of a display must be a whole number from 1 on, got {value!r}"):
        simulate_display(cluster(), HD, **{name: value})


@pytest.mark.parametrize("resolution", [(0, 1080), (1920, 0), (-1, 5), (19.2, 10)])
def test_an_image_has_pixels(resolution):
    with pytest.raises(UsageError, match="each side of the resolution of a display must be a whole number"):
        simulate_display(cluster(), resolution)


def test_a_display_or_message_without_pixels_is_refused():
    with pytest.raises(UsageError, match="the pixels of a frame of a display must be"):
        Display(simpy.Environment(), small(), 0)
    with pytest.raises(UsageError, match="copy_threads of a display must be"):
        Display(simpy.Environment(), small(), 8, copy_threads=0)
    with pytest.raises(UsageError, match="message_pixels of a display must be"):
        Display(simpy.Environment(), small(), 8, message_pixels=0)
    with pytest.raises(UsageError, match="the pixels of a message of a display must be"):
        message_layout(cluster(), 0)


def test_a_display_wall_has_a_pixel_for_each_node():
    assert simulate_display(cluster(), (2, 2), nodes=4).pixels_per_node == 1
    with pytest.raises(UsageError, match=r"5 display nodes cannot share the 4 pixels of 2x2"):
        simulate_display(cluster(), (2, 2), nodes=5)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("packet", "0 B", "packet must be a whole number of bytes, at least 1, got 0 B"),
        ("pixel_bytes", "0 B", "pixel_bytes must be a whole number of bytes, at least 1"),
        ("pixel_bytes", "12 b", "pixel_bytes must be a whole number of bytes, at least 1, got 12 b"),
        ("tile_pixel_bytes", "0.5 B", "tile_pixel_bytes must be a whole number of bytes"),
        ("tile_header", "0.5 B", "tile_header must be a whole number of bytes, at least 0"),
        ("bandwidth", "0 B/s", "must be more than 0"),
        ("copy_bandwidth", "1868 MiB", "expected a bandwidth"),
        ("copy_threads", "0", "copy_threads.*greater than or equal to 1, got 0"),
        ("frames_in_flight", "1.5", "frames_in_flight: expected a whole number"),
        ("nodes", "0", "nodes.*greater than or equal to 1"),
        ("ray_packet", "0", "ray_packet.*greater than or equal to 1"),
        ("packets_per_message", "0", "packets_per_message.*greater than or equal to 1"),
        ("latency", "-1 us", "must be at least 0"),
    ],
)
def test_a_card_that_cannot_be_is_refused(name, value, message):
    with pytest.raises(CardError, match=message):
        cluster(**{name: value})


def test_a_header_may_be_empty():
    assert message_layout(cluster(tile_header="0 B"), 832, tiles=True).payload_bytes == 832 * 3
