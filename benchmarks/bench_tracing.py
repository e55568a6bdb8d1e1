"""Tracing into the tables against embreex alone: the same rays in the same order, threads and chunks, in one run.

What is compared is the time of `SurfaceWorld.follow` on one generation of rays with that of `Geometry.raw`, one call
of embreex, on the same rays. Three kinds of `follow`, from what embreex itself has to do to all that a frame needs:

- *hits*: nearest hits into the table's columns; the shade step does nothing,
- *shaded*: the shade step computes what the rays add to their pixels, but nothing is spawned,
- *spawned*: the shade step of the workload, with the columns of all rays that these rays spawn.

Shading is work that embreex is not asked for, so only the first is a measure of the tables. Both sides take turns, so
that whatever else runs on the machine slows both down; a ratio is the median over the turns. Columns are let go after
each turn, so most turns find their memory already mapped; what it costs to map it shows in the whole frame. With
benchmarks disabled everything runs once at a small size and only counts are checked.
"""

from __future__ import annotations

import time

import numpy as np
import pytest

from simrender import load_workload
from simrender.rays import embree
from simrender.rays.integrators import PathTracing
from simrender.rays.store import NoStore
from simrender.rays.trace import Trace
from simrender.rays.worlds import SurfaceWorld, childless

SCENES = {"landscape": "1000x500", "island": "1000x500"}
"""Two samples a pixel, so 10^6 camera rays."""

SMALL = {"landscape": "64x32", "island": "64x32"}

TURNS = 7


class Unshaded(SurfaceWorld):
    """A world whose surfaces neither shine nor scatter."""

    def shade(self, rays, hits, seed):  # noqa: ARG002
        return childless(np.zeros((len(rays["kind"]), 3), np.float32))


def bare(name, size, cache):
    """Return a trace that stays in memory, with the scene and its hierarchy made."""
    trace = load_workload(name, [f"traced.resolution={size}", "published.samples=2"], cache).trace()
    trace.store = NoStore()
    assert isinstance(trace.world, SurfaceWorld)
    assert trace.world.geometry is not None
    assert trace.world.surfaces is not None
    return trace


def alike(world, kind, integrator):
    """Return a world of the same scene and hierarchy that shades otherwise."""
    other = kind(world.scene, integrator)
    other.__dict__.update(geometry=world.geometry, surfaces=world.surfaces)
    return other


def raw(geometry, rays):
    """Return the triangles that embreex finds, a chunk after the other."""
    columns = rays["origin"], rays["direction"], rays["reach"]
    return embree.in_chunks(
        lambda rows: geometry.raw(*(column[rows] for column in columns))["primID"], len(rays["kind"])
    )


def hits_in(chunks):
    return sum(int((primitive >= 0).sum()) for primitive in chunks)


def in_turns(works, turns):
    """Return the wall and processor time of each work in each turn, float64 (turns, works), and what each gave."""
    results = [work() for work in works]  # compiles the kernels
    wall, cpu = np.zeros((turns, len(works))), np.zeros((turns, len(works)))
    for turn in range(turns):
        for k, work in enumerate(works):
            begin = time.perf_counter(), time.process_time()
            work()
            wall[turn, k], cpu[turn, k] = time.perf_counter() - begin[0], time.process_time() - begin[1]
    return wall, cpu, results


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("generation", [0, 1], ids=["camera", "incoherent"])
def test_tables_against_raw_embreex(benchmark, tmp_path, name, generation):
    """Camera rays, and what they spawn: diffuse and mirrored rays and shadow rays."""
    trace = bare(name, (SCENES if benchmark.enabled else SMALL)[name], tmp_path)
    trace.complete()
    world, rays = trace.world, trace.geometry(generation)
    worlds = {
        "hits": alike(world, Unshaded, trace.integrator),
        "shaded": alike(world, SurfaceWorld, PathTracing(diffuse=0, mirror=0)),
        "spawned": world,
    }
    works = [lambda: raw(world.geometry, rays)]
    works += [lambda other=other: other.follow(rays, trace.seed) for other in worlds.values()]
    wall, cpu, (chunks, *made) = in_turns(works, TURNS if benchmark.enabled else 1)
    count = len(rays["kind"])
    assert generation or count == 2 * trace.pixels
    for found in made:
        assert len(found["t"]) == count
        assert np.isfinite(found["t"]).sum() == (found["primitive"] >= 0).sum() == hits_in(chunks)
        assert len(found["parent"]) == found["children"].sum()
    assert [len(found["parent"]) > 0 for found in made] == [False, False, True]
    ratios = {}
    for k, kind in enumerate(worlds, 1):
        ratios[kind] = float(np.median(wall[:, 0] / wall[:, k])), float(np.median(cpu[:, 0] / cpu[:, k]))
    benchmark.extra_info.update(ratios)
    shown = ", ".join(f"{kind} {r:.2f} ({c:.2f})" for kind, (r, c) in ratios.items())
    print(f"\n{name}: {count} rays at {count / np.median(wall[:, 0]) / 1e6:.2f} Mray/s by embreex alone", end="")
    print(f" on {np.median(cpu[:, 0] / wall[:, 0]):.2f} cores; of raw embreex, by wall time (processor time): {shown}")
    benchmark.pedantic(works[-1], rounds=1)
    if benchmark.enabled:
        assert min(ratios["hits"][0], ratios["shaded"][0]) >= 0.75
        assert ratios["spawned"][0] >= (0.7 if generation else 0.55)


@pytest.mark.parametrize("name", SCENES)
def test_a_whole_frame(benchmark, tmp_path, name):
    """All generations from making the camera's rays on, in memory and onto the disk, against embreex on these rays."""
    size = (SCENES if benchmark.enabled else SMALL)[name]
    first = bare(name, size, tmp_path)
    first.complete()
    generations = [first.geometry(generation) for generation in range(first.generations)]

    assert first.factor == 1.0

    def frame(folder=None):
        trace = Trace(first.scene, first.camera, first.size, first.samples, first.integrator, first.seed, folder)
        trace.world = first.world
        if folder is None:
            trace.store = NoStore()
        trace.complete()
        assert trace.traced_rays == trace.rays
        return trace.rays

    folders = (tmp_path / str(turn) for turn in range(1000))
    alone = lambda: [found for rays in generations for found in raw(first.world.geometry, rays)]  # noqa: E731
    works = [alone, frame, lambda: frame(next(folders))]
    wall, _, (chunks, *rays) = in_turns(works, 3 if benchmark.enabled else 1)
    assert hits_in(chunks) == np.isfinite(first.column("t")).sum()
    assert rays == [first.rays] * 2
    memory, disk = (float(np.median(wall[:, 0] / wall[:, k])) for k in (1, 2))
    benchmark.extra_info.update(memory=memory, disk=disk)
    print(f"\n{name}: {first.rays} rays in {first.generations} generations, {memory:.2f} of raw embreex, ", end="")
    print(f"{disk:.2f} onto the disk")
    benchmark.pedantic(frame, rounds=1)
    if benchmark.enabled:
        assert memory >= 0.5
