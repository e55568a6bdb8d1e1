"""Replaying domain schedulers on traced rays: a quarter of a million camera rays, and a thousand domains."""

from __future__ import annotations

import time

import pytest

from simrender import load_workload, simulate
from simrender.policies.load_any_once import LoadAnyOnce
from simrender.policies.speculation import Speculation

POLICIES = [LoadAnyOnce, Speculation]


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


def replay(benchmark, workload, policy, nodes):
    """Simulate on rays that are traced, by what is compiled."""
    run = lambda: simulate("stampede2-skx", workload, policy, nodes=nodes, islands=1)  # noqa: E731
    run()
    return benchmark.pedantic(run, rounds=3)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("data", ["out_of_core", "in_situ"])
def test_a_quarter_of_a_million_camera_rays_in_64_domains(benchmark, cache, policy, data):
    """Under 1 s: one node out of core with a cache of a quarter, 16 in situ."""
    workload = load_workload("wavelets", cache=cache)
    result = replay(benchmark, workload, policy(data, cache="25%"), 16 if data == "in_situ" else 1)
    assert result.counts["traced_paths"] == 512 * 512
    assert result.counts["domains"] == 64
    assert benchmark.stats.stats.min < 1.0


@pytest.mark.parametrize("policy", POLICIES)
def test_1427_domains_on_128_ranks(benchmark, cache, policy):
    """Under 20 s in situ, in one island: three million rays, of which 147,456 are camera rays."""
    result = replay(benchmark, load_workload("dns2", cache=cache), policy("in_situ"), 128)
    assert result.counts["domains"] == 1427
    assert result.counts["traced_paths"] == 192 * 192 * 4
    assert benchmark.stats.stats.min < 20.0


@pytest.mark.parametrize("policy", POLICIES)
def test_work_is_at_most_linear_in_crossings(benchmark, cache, policy):
    """Four times the rays, and with them their crossings, take at most 4.4 times as long."""
    seconds = []
    for side in (512, 1024):
        sizes = [f"{size}.resolution={side}x{side}" for size in ("published", "traced")]
        workload = load_workload("wavelets", sizes, cache)
        run = lambda w=workload: simulate("stampede2-skx", w, policy(cache="25%"), nodes=1)  # noqa: E731
        assert run().counts["traced_paths"] == side**2
        times = []
        for _ in range(3):
            begin = time.perf_counter()
            run()
            times.append(time.perf_counter() - begin)
        seconds.append(min(times))
    benchmark.extra_info["growth"] = seconds[1] / seconds[0]
    benchmark.pedantic(run, rounds=1)
    assert seconds[1] / seconds[0] < 4.4
