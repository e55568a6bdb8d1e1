"""Replaying a cached trace: a second policy against the first run, sixteen GPUs in under a second, linear growth."""

from __future__ import annotations

import subprocess
import sys
import time

import pytest

from simrender import load_workload, simulate
from simrender.policies.ray_queue_cycling import RayQueueCycling


def best(work, rounds=5):
    times = []
    for _ in range(rounds):
        begin = time.perf_counter()
        work()
        times.append(time.perf_counter() - begin)
    return min(times)


@pytest.fixture(scope="module")
def workload(tmp_path_factory):
    """65,520 pixels, 8 samples."""
    return load_workload("landscape", ["traced.resolution=390x168"], tmp_path_factory.mktemp("cache"))


def test_sixteen_gpus_without_islands(benchmark, workload):
    """65,520 traced pixels x 8 samples on 16 GPUs in one island, replayed in under 1 s."""
    simulate("dgx2", workload, RayQueueCycling(), islands=1)
    result = benchmark(lambda: simulate("dgx2", workload, RayQueueCycling(), islands=1))
    assert result.counts["traced_paths"] == 65520 * 8
    assert result.counts["trace_kernels"] % 256 == 0
    assert benchmark.stats.stats.min < 1.0


def test_a_second_policy_on_a_cached_trace(benchmark, tmp_path):
    """Image parallelism after ray queue cycling: no more than 0.15 of the first run's time."""
    simulate(
        "dgx2", load_workload("landscape", ["traced.resolution=64x27"], tmp_path), islands=2
    )  # compiles the kernels
    fresh = load_workload("landscape", cache=tmp_path)
    begin = time.perf_counter()
    simulate("dgx2", fresh, "ray_queue_cycling", islands=2)
    first = time.perf_counter() - begin
    result = benchmark.pedantic(lambda: simulate("dgx2", fresh, "image_parallel"), rounds=3)
    ratio = benchmark.stats.stats.min / first
    benchmark.extra_info["second_over_first"] = ratio
    print(f"\nfirst {first:.2f} s, second policy {ratio:.3f} of it")
    assert result.counts["traced_rays"] == fresh.trace().rays
    assert ratio <= 0.15


@pytest.mark.parametrize("what", ["rays", "gpus"])
def test_growth_is_at_most_linear(what, tmp_path):
    """Seconds for twice as many rays, or GPUs in one island at fixed rays."""
    rows = []
    for n in (2, 4, 8, 16):
        size = f"{128 * n}x54" if what == "rays" else "512x216"
        workload = load_workload("landscape", [f"traced.resolution={size}"], tmp_path)
        gpus = 8 if what == "rays" else n
        run = lambda w=workload, g=gpus: simulate("dgx2", w, RayQueueCycling(), islands=1, gpus=g)  # noqa: E731
        result = run()
        rows.append((n, best(run), result.counts["traced_rays"], result.counts["kernels"]))
    for n, seconds, rays, kernels in rows:
        print(f"\n{what} x {n}: {seconds:.3f} s, {rays} rays, {kernels} kernels", end="")
    growth = rows[-1][1] / rows[0][1]
    assert growth <= 8.0, f"eight times the {what} took {growth:.1f} times as long"


def test_start_up(benchmark):
    """``simrender --help`` in under 0.4 s."""
    command = [sys.executable, "-m", "simrender.cli", "--help"]
    done = benchmark.pedantic(lambda: subprocess.run(command, capture_output=True, check=True), rounds=5)
    assert done.stdout.count(b"\n") > 10
    assert benchmark.stats.stats.min < 0.4
