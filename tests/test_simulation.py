"""One simulation end to end: images, hashes, scaling, memory, and what the result owns up to."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from simrender import load_machine, simulate
from simrender.errors import UsageError
from simrender.policies.image_parallel import ImageParallel
from simrender.policies.ray_queue_cycling import RayQueueCycling
from tests.scenes import garden_workload

LARGE = {"published": "1920x1280", "traced": "96x64"}


@pytest.fixture(scope="module")
def garden(tmp_path_factory):
    return garden_workload(cache=tmp_path_factory.mktemp("cache"))


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    return garden_workload(**LARGE, cache=tmp_path_factory.mktemp("cache"))


@pytest.mark.parametrize("islands", [1, 2, 4, 8, 16])
@pytest.mark.parametrize("copy", ["explicit", "implicit"])
@pytest.mark.parametrize("merging", [True, False])
def test_every_schedule_renders_the_reference_image(garden, islands, copy, merging):
    result = simulate("dgx2", garden, RayQueueCycling(copy=copy, merging=merging), islands=islands)
    assert result.image_sha256 == simulate("dgx2", garden, ImageParallel()).image_sha256
    assert (result.image == garden.trace().reference).all()


def test_the_same_run_gives_the_same_log_and_another_seed_another(garden):
    first, again = (simulate("hgx-a100", garden, islands=2) for _ in range(2))
    assert first.to_dict() == again.to_dict()
    other = simulate("hgx-a100", garden, islands=2, seed=2)
    assert other.image_sha256 != first.image_sha256
    assert other.event_log_sha256 != first.event_log_sha256


def test_hashes_do_not_depend_on_the_process(tmp_path):
    script = """
import sys; from pathlib import Path; from simrender import simulate; from tests.scenes import garden_workload
result = simulate("dgx2", garden_workload(cache=Path(sys.argv[1])), islands=2)
print(result.image_sha256, result.event_log_sha256)
"""
    seen = {
        subprocess.run(
            [sys.executable, "-c", script, str(tmp_path / seed)],
            env={**os.environ, "PYTHONHASHSEED": seed},
            cwd=Path(__file__).parent.parent,
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    }
    assert len(seen) == 1


def test_without_islands_more_gpus_do_not_help_with_islands_they_do(large):
    alone = [simulate("dgx2", large, islands=1, gpus=n).frames_per_s for n in (1, 2, 4, 8)]
    islands = [simulate("dgx2", large, islands="auto", gpus=n).frames_per_s for n in (1, 2, 4, 8)]
    assert max(alone) / alone[0] < 1.5
    assert islands[1] / islands[0] == pytest.approx(2, rel=0.15)
    assert islands[3] / islands[0] == pytest.approx(8, rel=0.25)


def test_twice_the_rates_halve_the_time(large):
    # Every quantity of the card that is a rate doubles, and every latency halves.
    card = load_machine("rtx-server-a40")

    def scaled(section: str, factor: float, unit: str, *names: str) -> list[str]:
        values = {name: float(getattr(getattr(card, section), name)) * factor for name in names}
        return [f"{section}.{name}={value:.17g} {unit}" for name, value in values.items()]

    text = scaled("gpu", 2, "ray/s", "coherent_rate", "incoherent_rate") + scaled("gpu", 2, "B/s", "memory_bandwidth")
    text += scaled("pcie", 2, "B/s", "bandwidth", "socket_link") + scaled("pcie", 0.5, "s", "latency")
    text += scaled("gpu", 0.5, "s", "launch_latency")
    text += scaled("host", 0.5, "s", "launch_issue", "copy_issue", "readback")
    slow = simulate("rtx-server-a40", large, islands=2)
    fast = simulate(load_machine("rtx-server-a40", text), large, islands=2)
    assert fast.frame_time_s == pytest.approx(slow.frame_time_s / 2, rel=1e-7)


def test_bytes_are_conserved(large):
    result = simulate("rtx-server-a40", large, islands=2)
    table = result.timeline
    moved = table.bytes[table.kind.isin(["copy", "merge"])].sum()
    assert moved == pytest.approx(result.counts["network_bytes"], rel=1e-12)
    # Each ray travels once around its island of four.
    copied = table.bytes[table.kind == "copy"].sum()
    assert copied == pytest.approx(result.counts["published_rays"] * 88 * 4, rel=1e-12)


def test_occluded_shadow_rays_are_skipped_but_still_carried(large):
    counts = simulate("dgx2", large, islands=1).counts
    assert counts["traced_ray_domain_tests"] + counts["traced_skipped_ray_domain_tests"] == counts["traced_rays"] * 16
    occluded = counts["traced_occluded_shadow_rays"]
    assert 0 < counts["traced_skipped_ray_domain_tests"] <= occluded * 15
    one = simulate("dgx2", large, ImageParallel()).counts
    assert one["traced_ray_domain_tests"] == one["traced_rays"]
    assert one["traced_skipped_ray_domain_tests"] == 0


def test_spans_of_one_gpu_never_overlap(large):
    for copy in ("explicit", "implicit"):
        table = simulate("dgx2", large, RayQueueCycling(copy=copy), islands=4).timeline
        for _, spans in table.sort_values(["device", "start_s"]).groupby("device"):
            assert (spans.start_s.to_numpy()[1:] >= spans.end_s.to_numpy()[:-1] - 1e-15).all()
        assert (table.end_s >= table.start_s).all()
        assert table.columns.tolist() == ["device", "kind", "start_s", "end_s", "bytes", "rays"]


def test_the_breakdown_adds_up_and_utilization_is_a_share(large):
    result = simulate("rtx-server-a40", large, islands=1)
    assert sum(result.breakdown.values()) == pytest.approx(1.0)
    assert all(0 < share <= 1 for share in result.utilization.values())
    assert list(result.utilization) == [f"gpu{i}" for i in range(8)]
    assert result.breakdown["copy"] > 0.1  # PCIe holds it back


def test_merging_saves_kernels(large):
    merged, plain = (simulate("dgx2", large, RayQueueCycling(merging=m), islands=1) for m in (True, False))
    assert merged.counts["trace_kernels"] < plain.counts["trace_kernels"]
    assert merged.frame_time_s < plain.frame_time_s


def test_one_gpu_has_no_network_in_its_simulation(garden):
    result = simulate("dgx2", garden, gpus=1)
    assert result.counts["copies"] == 0
    assert [item["what"] for item in result.scope["left_out"]][-1] == "nvlink"
    assert not any(v["path"].startswith("machine.nvlink") for v in result.uncalibrated)
    paths = {v["path"] for v in simulate("rtx-server-a40", garden, gpus=2, islands=1).uncalibrated}
    assert any(path.startswith("machine.pcie") for path in paths)


def test_gpus_that_are_left_over_are_reported(garden):
    result = simulate("dgx2", garden, islands=5)
    assert (result.islands, result.island_size, result.unused_gpus) == (5, 3, 1)
    assert len(result.utilization) == 15


def test_too_little_memory_is_infeasible_and_says_what_would_do(large):
    card = load_machine("dgx2", ["gpu.memory=1.08 GiB"])
    result = simulate(card, large, islands=8)
    assert not result.feasible
    assert result.frame_time_s is None
    assert result.frames_per_s is None
    assert result.image_sha256 is None
    assert result.memory["gpus_needed"] % 8 == 0  # eight islands were asked for
    assert "machine.gpu.reserved_memory" in {v["path"] for v in result.uncalibrated}
    needed = simulate(card, large, islands=1).memory["gpus_needed"]
    assert result.memory["needed_bytes"] > result.memory["capacity_bytes"]
    assert needed > 0
    assert json.dumps(result.to_dict())
    roomy = simulate(load_machine("dgx2", ["gpu.memory=1.3 GiB"]), large, islands=1, gpus=min(16, needed))
    assert roomy.feasible


def test_replication_needs_every_gpu_as_its_own_island(garden):
    with pytest.raises(UsageError, match="every GPU is an island"):
        simulate("dgx2", garden, "image_parallel", islands=2)


def test_a_result_is_ready_for_json_with_units_in_its_names(garden):
    facts = simulate("dgx2", garden, islands=4).to_dict()
    text = json.loads(json.dumps(facts))
    assert text["frames_per_s"] == pytest.approx(1 / text["frame_time_s"])
    assert {"frame_time_s", "frames_per_s", "feasible", "utilization", "counts", "scope", "uncalibrated",
            "sampling_error", "image_sha256", "event_log_sha256", "memory"} <= set(text)  # fmt: skip
    assert all(v["status"] in {"assumed", "calibrated"} for v in text["uncalibrated"])


@pytest.mark.parametrize("policy", ["ray_queue_cycling", "image_parallel"])
def test_the_sampling_error_covers_what_coarser_images_find(tmp_path, policy):
    # Frame times of coarsely traced images against a finely traced one, in units of the estimated error.
    fine = simulate("dgx2", garden_workload("1920x1280", "480x320", cache=tmp_path), policy).frame_time_s
    ratios = []
    for traced in ("96x64", "114x76", "132x88", "150x100"):
        result = simulate("dgx2", garden_workload("1920x1280", traced, cache=tmp_path), policy)
        ratios.append(abs(result.frame_time_s / fine - 1) / result.sampling_error["relative_error"])
    assert max(ratios) < 2.0
    assert np.mean(ratios) > 0.1


def test_tracing_everything_leaves_no_sampling_error(garden):
    assert simulate("dgx2", garden).sampling_error["relative_error"] == 0.0


def test_a_faster_link_never_slows_the_frame_of_an_uncontended_ring(large):
    machines = [load_machine("dgx2", [f"nvlink.bandwidth={gb} GB/s"]) for gb in (20, 50, 145, 600)]
    times = [simulate(machine, large, islands=1).frame_time_s for machine in machines]
    assert times == sorted(times, reverse=True)


def test_an_implicit_copy_sends_the_same_bytes_and_says_when_it_waits_for_them(large):
    explicit, implicit = (
        simulate("rtx-server-a40", large, RayQueueCycling(copy=c), islands=1) for c in ("explicit", "implicit")
    )
    assert implicit.counts["network_bytes"] == pytest.approx(explicit.counts["network_bytes"], rel=1e-12)
    assert implicit.breakdown["copy"] > 0.2  # PCIe holds it back, and the kernels' waiting is not called tracing
    assert max(implicit.utilization.values()) < 0.7
    assert not any(v["path"] == "machine.pcie.kernel_share" for v in explicit.uncalibrated)
    assert any(v["path"] == "machine.pcie.kernel_share" for v in implicit.uncalibrated)


def test_a_kernel_reads_at_its_share_of_the_link(large):
    # With tracing made free, an implicit step lasts as long as its transfer at the kernel's share of the link.
    free = ["gpu.coherent_rate=1e9 Mray/s", "gpu.incoherent_rate=1e9 Mray/s"]
    times = [
        simulate(
            load_machine("dgx2", [*free, f"nvlink.kernel_share={share}"]),
            large,
            RayQueueCycling(copy="implicit"),
            islands=1,
        )
        for share in (0.2, 0.1)
    ]
    waiting = [r.breakdown["copy"] * r.frame_time_s for r in times]
    assert waiting[1] / waiting[0] == pytest.approx(2, rel=0.05)


def test_overrides_that_nobody_would_read_are_refused(garden):
    for given, message in (
        ({"machines": ["gpus=1"]}, "did you mean 'machine'"),
        ({"workload": ["published.samples=1"]}, "overrides of the workload need its name"),
    ):
        with pytest.raises(UsageError, match=message):
            simulate("dgx2", garden, overrides=given)
    with pytest.raises(UsageError, match="overrides of the machine need its name"):
        simulate(load_machine("dgx2"), garden, overrides={"machine": ["gpus=1"]})
    assert simulate("dgx2", garden, RayQueueCycling()).policy == "ray_queue_cycling"


def test_the_host_issues_one_phase_on_all_gpus_before_the_next(large):
    table = simulate("dgx2", large, islands=1).timeline
    assert table.kind[:16].tolist() == ["generate"] * 16
    first_copies = table[table.kind == "copy"].head(16)
    assert sorted(first_copies.device) == sorted(f"gpu{i}" for i in range(16))


@pytest.mark.parametrize("size", ["1x1", "2x2", "5x3", "300x1"])
@pytest.mark.parametrize("policy", ["ray_queue_cycling", "image_parallel"])
def test_images_with_fewer_scan_lines_than_gpus(tmp_path, size, policy):
    result = simulate("dgx2", garden_workload(size, size, cache=tmp_path), policy)
    width, height = map(int, size.split("x"))
    assert result.counts["traced_paths"] == width * height * 2
    assert len(result.utilization) == 16


def test_a_disturbance_that_begins_before_anything_is_sent():
    """On islands of one GPU the network comes into being when finished pixels are merged."""
    slow = {
        "machine": [
            "disturbances=[{link: gpu0.in, share: 0.1, start: 0 s}, {link: gpu1.out, share: 0, start: 0 s, end: 1 us}]"
        ]
    }
    plain = simulate("rtx-server-a40", "landscape", overrides={"workload": ["traced.resolution=64x27"]})
    disturbed = simulate("rtx-server-a40", "landscape", overrides={"workload": ["traced.resolution=64x27"], **slow})
    assert disturbed.islands == plain.islands == 8
    assert disturbed.frame_time_s > plain.frame_time_s
    assert disturbed.image_sha256 == plain.image_sha256
