"""Tracing through the tables against raw embreex on the very same rays, threads and chunks, in one run."""

from __future__ import annotations

import time

import pytest

from simrender import load_workload
from simrender.rays.store import NoStore
from simrender.report.tracing import raw_embreex_seconds

RAYS = {"landscape": "512x216", "island": "512x216"}


@pytest.mark.parametrize("name", RAYS)
def test_tables_against_raw_embreex(benchmark, tmp_path, name):
    """The ratio of raw embreex to the tables, shading and children included; the disk's share is told apart."""

    def cold(seed, disk=False):
        workload = load_workload(name, [f"traced.resolution={RAYS[name]}", "published.samples=2"], tmp_path)
        trace = workload.trace(seed)
        if not disk:
            trace.store = NoStore()
        assert trace.surfaces is not None
        assert trace.everything is not None  # the scene and its hierarchy are made before the clock starts
        return (trace,), {}

    cold(0)[0][0].complete()  # compiles the kernels
    seeds = iter(range(1, 100))
    trace = None

    def traced(fresh):
        nonlocal trace
        trace = fresh
        fresh.complete()
        return fresh.rays

    rays = benchmark.pedantic(traced, setup=lambda: cold(next(seeds)), rounds=3)
    assert rays == trace.rays == trace.traced_rays
    raw = min(raw_embreex_seconds(trace, time.perf_counter) for _ in range(3))
    ratio = raw / benchmark.stats.stats.min
    benchmark.extra_info["raw_over_tables"] = ratio
    (stored,), _ = cold(1000, disk=True)
    begin = time.perf_counter()
    stored.complete()
    disk = time.perf_counter() - begin
    print(f"\n{name}: with the disk {stored.rays / disk / 1e6:.2f} Mray/s, {raw / disk:.2f} of raw embreex", end="")
    print(f"\n{name}: {rays} rays, {rays / benchmark.stats.stats.min / 1e6:.2f} Mray/s, {ratio:.2f} of raw embreex")
    assert ratio >= 0.6
