"""What the tables weigh, what making them takes, and that one core makes the same tables as several."""

from __future__ import annotations

import os
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from benchmarks.bench_tables import camera_trace, front_to_back, measure, owned_bytes, patches, traced
from simrender.rays import embree
from simrender.rays.crossings import Crossings
from simrender.rays.integrators import PathTracing
from simrender.rays.store import NoStore
from simrender.rays.trace import Trace
from tests.scenes import garden

VIEW = np.array([[5.5, -5, 3], [-0.7, 0.65, -0.3], [0.5, 0, 0], [0, 0.2, 0.4]])


def in_memory(scene, size=(192, 128), samples=2):
    trace = Trace(scene, VIEW, size, samples, PathTracing())
    trace.store = NoStore()
    return trace


def columns_of(trace):
    held = [trace.geometry(g) for g in range(trace.generations)] + [*trace._outcomes, trace._joined]
    return [column for columns in held for column in columns.values()]


def peak_of(work):
    tracemalloc.start()
    try:
        result = work()
        return tracemalloc.get_traced_memory()[1], result
    finally:
        tracemalloc.stop()


def test_a_ray_weighs_83_bytes_whoever_has_asked_for_columns():
    trace = in_memory(garden())
    trace.complete()
    assert owned_bytes(columns_of(trace)) == 83 * trace.rays
    assert len(trace.reference) == 128
    for name in ("t", "primitive", "radiance", "children", "kind", "pixel", "first_child"):
        assert len(trace.column(name)) == trace.rays
    assert owned_bytes(columns_of(trace)) == 83 * trace.rays
    embrees = ("origin", "direction", "reach"), ("t", "primitive")
    theirs = [trace.geometry(g)[name] for g in range(trace.generations) for name in embrees[0]]
    assert owned_bytes(theirs + [trace.column(name) for name in embrees[1]]) == 36 * trace.rays


def test_columns_are_the_same_before_and_after_more_generations_are_known():
    whole, slowly = in_memory(garden()), in_memory(garden())
    whole.complete()
    while slowly._advance():
        for name in ("kind", "t", "pixel"):
            assert (slowly.column(name) == whole.column(name)[: slowly.rays]).all()
    for g in range(whole.generations):
        for name, column in whole.geometry(g).items():
            assert (slowly.geometry(g)[name] == column).all()


def test_a_crossing_weighs_10_bytes():
    scene, domains = patches((4, 4, 4))
    crossings = Crossings(traced(camera_trace(scene, (4, 4, 4), (100, 100), 1)), domains)
    table = crossings.table(0)
    front_to_back(crossings)
    assert owned_bytes([table[name] for name in ("domain", "entry", "hit")]) == 10 * len(table["domain"])
    assert owned_bytes([table["first"]]) == 8 * 10_001


def test_tracing_takes_little_more_memory_than_it_leaves():
    trace = in_memory(garden(), (512, 512))
    rays = trace.geometry(0)
    peak, made = peak_of(lambda: trace.world.follow(rays, trace.seed))
    assert len(made["t"]) == 2 * 512 * 512
    assert owned_bytes(made.values()) == 22 * len(made["t"]) + 53 * len(made["parent"])
    # Of what is spawned, the chunks and the columns in which they are joined.
    assert peak < 1.5 * owned_bytes(made.values())


def test_crossings_take_little_more_memory_than_they_leave():
    scene, domains = patches((10, 10, 10))
    trace = traced(camera_trace(scene, (10, 10, 10), (100, 100), 20))
    crossings = Crossings(trace, domains)
    peak, table = peak_of(lambda: crossings.table(0))
    assert len(table["domain"]) == pytest.approx(14.94 * trace.rays, rel=0.01)
    assert peak < 1.2 * owned_bytes(table.values())


def test_a_measurement_of_a_small_scene():
    found = measure(20_000, (4, 4, 4))
    assert found["rays"] == 20_000
    assert found["domains"] == 64
    assert 0 < found["asked"] <= found["needed"] <= found["crossings"]
    assert found["hit"] > 10_000


def test_every_core_takes_part():
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    meet = threading.Barrier(cores)
    # Nobody passes before all are there at the same time.
    assert sorted(embree.on_all_cores(lambda _: meet.wait(timeout=30), range(cores))) == list(range(cores))


def test_one_core_makes_the_same_tables_as_three(monkeypatch):
    scene, domains = patches((6, 6, 6))
    monkeypatch.setattr(embree, "CHUNK", 1000)
    made = []
    for cores in (1, 3):
        with ThreadPoolExecutor(cores) as pool:
            monkeypatch.setattr(embree, "_pool", lambda pool=pool: pool)
            trace = in_memory(garden())
            trace.complete()
            crossings = Crossings(traced(camera_trace(scene, (6, 6, 6), (100, 100), 1)), domains)
            front_to_back(crossings)
            made.append(columns_of(trace) + list(crossings.table(0).values()) + [trace.image()])
    assert len(made[0]) == len(made[1]) > 40
    for one, three in zip(*made, strict=True):
        assert one.dtype == three.dtype
        assert one.tobytes() == three.tobytes()
