"""What the tables of rays and crossings weigh, and how their time grows with rays and with domains.

The scene is a grid of cells with a bumpy patch of triangles in each, cut along the cells: rays walk the grid and pass
by most patches. ``python -m benchmarks.bench_tables RAYS NX NY NZ`` makes both tables for so many camera rays, asks for
hits front to back as far as these decide each ray, and prints counts, seconds and the peak of memory as JSON.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from simrender.rays.crossings import Crossings
from simrender.rays.domains import rectilinear, uniform_grid
from simrender.rays.integrators import PathTracing
from simrender.rays.scene import IDENTITY, Mesh, PointLight, Scene, SceneObject
from simrender.rays.store import NoStore
from simrender.rays.trace import Trace

PATCH = 8
"""Squares along a patch's side."""

GRIDS = ((4, 4, 4), (6, 6, 5), (12, 6, 5), (12, 12, 5), (12, 12, 10))

BLOCK = 1 << 21
"""Rays that are taken through their domains at once."""


def patches(shape, grid=None):
    """Return a scene of one bumpy patch a unit cell, and its domains: the cells, or those of a coarser grid."""
    x = np.linspace(0.2, 0.8, PATCH + 1)
    u, v = np.meshgrid(x, x, indexing="ij")
    patch = np.stack([u, v, 0.5 + 0.2 * np.sin(9.0 * u) * np.cos(7.0 * v)], -1).reshape(-1, 3)
    cells = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1).reshape(-1, 3)
    # Patches face x, y and z in turn, so that there is something in the way from everywhere.
    turned = np.stack([np.roll(patch, k, axis=1) for k in range(3)])
    vertices = (cells[:, None] + turned[cells.sum(axis=1) % 3]).reshape(-1, 3).astype(np.float32)
    i = np.arange(len(patch)).reshape(PATCH + 1, PATCH + 1)
    a, b, c, d = (corner.ravel() for corner in (i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])
    faces = (faces + len(patch) * np.arange(len(cells))[:, None, None]).reshape(-1, 3)
    sun = PointLight((30.0, -20.0, 40.0), (3000.0,) * 3)
    thing = SceneObject("patches", (Mesh(vertices, faces),))
    scene = Scene((thing,), np.zeros(1, np.int32), IDENTITY[None], points=(sun,))
    domains = rectilinear(scene.triangles, uniform_grid((0, 0, 0), shape, grid or shape), 1e9, 1e9)
    assert domains.planes is not None
    return scene, domains


def camera(shape):
    """Return a camera outside a corner of the grid that sees all of it."""
    size = np.array(shape, float)
    position = size * (-0.6, -0.45, 1.4)
    forward = 0.5 * size - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return np.stack([position, forward, 0.3 * right, 0.3 * np.cross(right, forward)])


def camera_trace(scene, shape, size, samples):
    """Return a trace of camera rays alone, which stays in memory."""
    trace = Trace(scene, camera(shape), size, samples, PathTracing(diffuse=0, mirror=0))
    trace.store = NoStore()
    return trace


def front_to_back(crossings):
    """Ask for camera rays' hits until one is nearer than the next domain; return the nearest, and the rows needed."""
    table, trace = crossings.table(0), crossings.trace
    first, entry = table["first"], table["entry"]
    nearest, needed = np.full(trace.first[1], np.inf, np.float32), 0
    for begin in range(0, len(nearest), BLOCK):
        end = min(begin + BLOCK, len(nearest))
        ray = np.flatnonzero(np.diff(first[begin : end + 1])) + begin
        row = first[ray]
        while len(ray):
            needed += len(ray)
            nearest[ray] = np.minimum(nearest[ray], crossings.hits(0, row))
            row += 1
            on = row < first[ray + 1]
            on[on] = entry[row[on]] <= nearest[ray[on]]
            ray, row = ray[on], row[on]
    return nearest, needed


def peak_bytes():
    """Return the most memory that this process ever had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def measure(rays, shape):
    """Make both tables and ask front to back; return what it took."""
    seconds, peak = {}, {}

    def step(name, work):
        begin = time.perf_counter()
        result = work()
        seconds[name], peak[name] = time.perf_counter() - begin, peak_bytes()
        return result

    scene, domains = patches(shape)
    trace = camera_trace(scene, shape, (100, 100), rays // 10_000)
    crossings = Crossings(trace, domains)
    step("hierarchy", lambda: trace.world.geometry)
    step("rays", trace.complete)
    table = step("crossings", lambda: crossings.table(0))
    nearest, needed = step("hits", lambda: front_to_back(crossings))
    assert np.array_equal(nearest, trace.column("t"))
    counts = {"rays": trace.rays, "domains": domains.count, "crossings": len(table["domain"]), "needed": needed}
    counts |= {"asked": crossings.asked_rows, "hit": int(np.isfinite(nearest).sum())}
    return counts | {"seconds": seconds, "peak_bytes": peak}


def owned_bytes(columns):
    """Return what the memory of some arrays comes to, each byte counted once."""
    owners = [column if column.base is None else column.base for column in columns]
    return sum(owner.nbytes for owner in {id(owner): owner for owner in owners}.values())


def test_bytes():
    """Bytes a ray beyond what embreex takes and gives, and bytes a crossing, from the arrays themselves."""
    scene, domains = patches((4, 4, 4))
    trace = Trace(scene, camera((4, 4, 4)), (100, 100), 1, PathTracing())
    trace.store = NoStore()
    trace.complete()
    assert trace.rays == 25348
    crossings = Crossings(trace, domains)
    tables = [crossings.table(generation) for generation in range(trace.generations)]
    rows = sum(len(table["domain"]) for table in tables)
    assert rows == 106772
    assert len(trace.reference) == 100  # by now everything that is ever joined is
    held = [trace.geometry(g) for g in range(trace.generations)] + [*trace._outcomes, trace._joined]
    whole = owned_bytes([column for columns in held for column in columns.values()]) / trace.rays
    names = "origin", "direction", "reach", "t", "primitive"
    embrees = owned_bytes([columns[name] for columns in held for name in names if name in columns]) / trace.rays
    first = owned_bytes([table["first"] for table in tables]) / trace.rays
    row = owned_bytes([table[name] for table in tables for name in table if name != "first"]) / rows
    print(f"\n{whole:.2f} B a ray, {embrees:.2f} of them embreex's own; {first:.2f} more for where its crossings start")
    print(f"{whole - embrees + first:.2f} B a ray more than embreex, {row:.2f} B a crossing")
    assert whole - embrees + first < 60
    assert row < 12


def test_memory(benchmark):
    """10^7 rays and 1,000 domains within 4 GB, in a process of its own."""
    rays = 10_000_000 if benchmark.enabled else 100_000
    command = [sys.executable, "-m", "benchmarks.bench_tables", str(rays), "10", "10", "10"]
    root = Path(__file__).parents[1]
    run = lambda: subprocess.run(command, capture_output=True, check=True, text=True, cwd=root)  # noqa: E731
    found = json.loads(benchmark.pedantic(run, rounds=1).stdout)
    print(f"\n{found}")
    assert (found["rays"], found["domains"]) == (rays, 1000)
    assert found["crossings"] == pytest.approx(14.941 * rays, rel=1e-3)
    assert found["asked"] <= found["needed"] <= found["crossings"]
    assert found["peak_bytes"]["hits"] < 4e9


def best(make, work, rounds):
    """Return the least wall and processor time of some work on what is made anew for each round, and what it gave."""
    wall, cpu, result = [], [], None
    for _ in range(rounds):
        made, result = make(), None
        begin = time.perf_counter(), time.process_time()
        result = work(made)
        wall.append(time.perf_counter() - begin[0])
        cpu.append(time.process_time() - begin[1])
    return min(wall), min(cpu), result


def slope(x, y):
    """Return the exponent of the power law that fits best."""
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def traced(trace):
    trace.complete()
    return trace


def test_time_grows_with_rays(benchmark):
    """The same image with more and more samples, so that rays are as coherent however many there are.

    The exponents are those of processor time: other programs on the machine disturb the long runs more than the short.
    """
    shape = (10, 10, 10)
    scene, domains = patches(shape)
    shared = camera_trace(scene, shape, (100, 100), 1)
    rows = []
    for samples in (1, 10, 100, 1000) if benchmark.enabled else (1, 2):

        def fresh(samples=samples):
            trace = camera_trace(scene, shape, (100, 100), samples)
            trace.world = shared.world
            return trace

        rounds = max(2, min(20, 1000 // samples))
        *tracing, trace = best(fresh, traced, rounds)
        *entering, table = best(lambda t=trace: Crossings(t, domains), lambda crossings: crossings.table(0), rounds)
        assert trace.rays == 10_000 * samples
        assert len(table["domain"]) == pytest.approx(14.941 * trace.rays, rel=5e-3)
        rows.append((trace.rays, *tracing, *entering))
        print(f"\n{trace.rays} rays: traced in {tracing[0]:.4f} s ({tracing[1]:.4f} s of processors)", end="")
        print(f"; {len(table['domain'])} crossings in {entering[0]:.4f} s ({entering[1]:.4f})", end="")
    rays, *times = zip(*rows, strict=True)
    exponents = [slope(rays, seconds) for seconds in times]
    print("\ntime grows with rays to the {:.3f} ({:.3f}), of crossings to the {:.3f} ({:.3f})".format(*exponents))
    benchmark.pedantic(lambda: traced(fresh(1)), rounds=3)
    if benchmark.enabled:
        assert exponents[1::2] == pytest.approx([1.0, 1.0], abs=0.1)


@pytest.mark.parametrize("way", ["grid", "boxes"])
def test_time_grows_with_domains(benchmark, way):
    """The same scene and rays, cut into 64 to 1,440 domains: by walking the grid, or through a hierarchy of boxes."""
    rows, shape, trace, crossings = [], (12, 12, 20), None, None
    for grid in GRIDS:
        scene, domains = patches(shape, grid)
        domains = domains if way == "grid" else replace(domains, planes=None)
        trace = trace or traced(camera_trace(scene, shape, (100, 100), 100 if benchmark.enabled else 1))
        crossings = lambda t=trace, d=domains: Crossings(t, d)  # noqa: E731
        seconds, _, table = best(crossings, lambda made: made.table(0), 3)
        rows.append((domains.count, seconds, len(table["domain"]) / trace.rays))
        print(f"\n{domains.count} domains: {seconds:.3f} s, {rows[-1][2]:.2f} domains a ray", end="")
    domains, seconds, entered = zip(*rows, strict=True)
    exponents = slope(domains, seconds), slope(domains, entered)
    print(f"\n{way}: time grows with domains to the {exponents[0]:.2f}, domains a ray to the {exponents[1]:.2f}")
    assert domains == (64, 180, 360, 720, 1440)
    assert entered == pytest.approx((5.41, 7.79, 10.92, 13.62, 15.69), rel=0.02)
    benchmark.pedantic(lambda: crossings().table(0), rounds=3)
    if benchmark.enabled:
        assert exponents[0] < 0.75


if __name__ == "__main__":
    print(json.dumps(measure(int(sys.argv[1]), tuple(map(int, sys.argv[2:5])))))
