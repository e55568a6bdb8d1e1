"""The crossing table against brute force: which domains a shadow ray visits before something is in its way."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.rays.kinds import SHADOW
from simrender.rays.partition import Footprint
from tests.scenes import garden_workload

RTX = Footprint(50.0, 400.0)


def brute_force(trace, crossings, generation, start):
    """Trace every ray in every domain of its way, one after the other."""
    domains = crossings.domains.count
    rays = trace.geometry(generation)
    kind = trace.column("kind")[trace.first[generation] : trace.first[generation + 1]]
    visits = np.full(len(kind), domains)
    for r in np.flatnonzero(kind == SHADOW):
        one = slice(r, r + 1)
        for step in range(domains):
            geometry = crossings.trace.world.domain_geometry(
                crossings.domains, int((start[rays["pixel"][r]] + step) % domains)
            )
            if np.isfinite(geometry.nearest(rays["origin"][one], rays["direction"][one], rays["reach"][one]).t[0]):
                visits[r] = step + 1
                break
    return visits


@pytest.mark.parametrize("domains", [2, 3, 5])
def test_visits_agree_with_tracing_every_ray_in_every_domain(domains, tmp_path):
    workload = garden_workload(traced="24x16", published="24x16", cache=tmp_path)
    trace = workload.trace()
    trace.complete()
    crossings = workload.crossings(1, workload.partition(domains, RTX, "heaviest_first", 0.1))
    start = np.arange(24 * 16) % domains
    for generation in range(1, min(4, trace.generations)):
        assert (crossings.domains_visited(generation, start) == brute_force(trace, crossings, generation, start)).all()


def test_partitioned_and_whole_scene_agree_on_every_hit(tmp_path):
    workload = garden_workload(cache=tmp_path)
    trace = workload.trace()
    trace.complete()
    partition = workload.partition(4, RTX, "heaviest_first", 0.1)
    crossings = workload.crossings(1, partition)
    domain_of = partition.domain_of_mesh[trace.scene.triangles.mesh]
    for generation in range(trace.generations):
        rays = trace.geometry(generation)
        parts = np.stack(
            [
                trace.world.domain_geometry(crossings.domains, d)
                .nearest(rays["origin"], rays["direction"], rays["reach"])
                .t
                for d in range(4)
            ]
        )
        whole = slice(trace.first[generation], trace.first[generation + 1])
        t, primitive = trace.column("t")[whole], trace.column("primitive")[whole]
        assert (parts.min(axis=0) == t).all()
        hit = primitive >= 0
        assert (parts[domain_of[primitive[hit]], np.flatnonzero(hit)] == t[hit]).all()


def test_a_second_table_asks_embree_nothing(tmp_path):
    start = np.zeros(96 * 64, int)
    for asked in (True, False):
        workload = garden_workload(cache=tmp_path)
        trace = workload.trace()
        trace.complete()
        crossings = workload.crossings(1, workload.partition(4, RTX, "heaviest_first", 0.1))
        for generation in range(trace.generations):
            crossings.domains_visited(generation, start)
        crossings.save()
        assert (crossings.asked_rows > 0) == asked


def test_a_ray_asks_no_more_than_the_scheduler_can_tell_apart(tmp_path):
    workload = garden_workload(cache=tmp_path)
    trace = workload.trace()
    trace.complete()
    crossings = workload.crossings(1, workload.partition(8, RTX, "heaviest_first", 0.1))
    for generation in range(trace.generations):
        crossings.domains_visited(generation, np.zeros(96 * 64, int))
    occluded = ((trace.column("kind") == SHADOW) & np.isfinite(trace.column("t"))).sum()
    assert 0 < crossings.asked_rows < 4 * occluded  # of 8 domains each
