"""What the links did in a frame: in the result, the answer, the Chrome trace and the plot."""

import json

import numpy as np
import pytest

from simrender.clock import to_ticks
from simrender.report.chrome import chrome_trace
from simrender.report.plots import plot_timeline
from simrender.simulation import simulate


@pytest.fixture
def result(tiny_card):
    """A frame in two islands of two GPUs."""
    return simulate("dgx2", str(tiny_card), gpus=4, islands=2)


@pytest.fixture
def alone(tiny_card):
    return simulate("dgx2", str(tiny_card), gpus=1)


def test_links_that_carried_something(result):
    assert set(result.links) == {f"gpu{i}.{way}" for i in range(4) for way in ("in", "out", "port")}
    frame = result.frame_time_s
    for name, link in result.links.items():
        assert set(link) == {
            "bandwidth_bytes_per_s", "carried_bytes", "busy_s", "mean_utilization", "peak_utilization",
        }  # fmt: skip
        assert link["mean_utilization"] == pytest.approx(link["carried_bytes"] / link["bandwidth_bytes_per_s"] / frame)
        assert 0.0 < link["mean_utilization"] <= link["busy_s"] / frame <= 1.0, name
        assert link["mean_utilization"] <= link["peak_utilization"] <= 1.0 + 1e-9
    sent = sum(link["carried_bytes"] for name, link in result.links.items() if name.endswith(".out"))
    assert sent == pytest.approx(result.counts["network_bytes"])
    assert result.busiest_link == max(result.links, key=lambda name: result.links[name]["mean_utilization"])


def test_loads_are_what_the_links_carried(result):
    assert list(result.loads) == list(result.links)
    end = to_ticks(result.frame_time_s)
    for name, (ticks, loads) in result.loads.items():
        assert (np.diff(ticks) > 0).all()
        assert ticks[-1] <= end + 1
        assert loads[-1] == 0.0
        carried = float((np.diff(ticks) * loads[:-1]).sum()) / 1e12
        link = result.links[name]
        tick = 1e-12 * link["bandwidth_bytes_per_s"]  # a flow ends at the tick after its last byte
        assert carried == pytest.approx(link["carried_bytes"], abs=len(ticks) * tick)
        assert loads.max() == pytest.approx(link["peak_utilization"] * link["bandwidth_bytes_per_s"])


def test_json_has_the_links_and_not_their_loads(result):
    table = json.loads(json.dumps(result.to_dict()))
    assert table["links"] == result.links
    assert "loads" not in table
    assert "spans" not in table


def test_what_sends_nothing_has_no_links(alone):
    assert (alone.links, alone.loads, alone.busiest_link) == ({}, {}, None)
    assert {event["ph"] for event in chrome_trace(alone)["traceEvents"]} == {"X", "M"}
    labels = [label.get_text() for label in plot_timeline(alone).axes[0].get_yticklabels()]
    assert labels == ["GPU 0"]


def test_the_answer_names_the_busiest_link(run_cli, tiny_card):
    out = run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 1).out
    (line,) = [line for line in out.splitlines() if line.startswith("busiest link")]
    assert "% of its bandwidth over the frame" in line
    assert line.rstrip().endswith("at its peak")
    assert "busiest link" not in run_cli("run", "dgx2", tiny_card, "--gpus", 1).out


def test_the_chrome_trace_counts_gigabytes_a_second(result):
    trace = chrome_trace(result)["traceEvents"]
    counters = [event for event in trace if event["ph"] == "C"]
    assert {event["name"] for event in counters} == set(result.links)
    assert {event["pid"] for event in counters} == {4}
    assert {event["args"]["name"] for event in trace if event["name"] == "process_name" and event["pid"] == 4} == {
        "links"
    }
    peak = max(event["args"]["GB/s"] for event in counters if event["name"] == "gpu0.out")
    assert peak == pytest.approx(result.links["gpu0.out"]["peak_utilization"] * 145.57)
    assert max(event["ts"] for event in counters) <= result.frame_time_s * 1e6 * (1.0 + 1e-12)


def test_the_plot_has_a_row_for_the_busiest_link(result):
    (axes,) = plot_timeline(result).axes
    labels = [label.get_text() for label in axes.get_yticklabels()]
    assert labels == ["GPU 0", "GPU 1", "GPU 2", "GPU 3", result.busiest_link]
    heights = axes.collections[-1].get_paths()[0].vertices[:, 1]
    assert heights.max() == pytest.approx(4.4)
    assert heights.min() == pytest.approx(4.4 - 0.8 * result.links[result.busiest_link]["peak_utilization"])


def test_counting_changes_no_event(result, tiny_card):
    again = simulate("dgx2", str(tiny_card), gpus=4, islands=2)
    assert again.event_log_sha256 == result.event_log_sha256 == result.spans.sha256()
    assert again.links == result.links
