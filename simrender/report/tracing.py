"""What `simrender trace` prints: rays, hits, and the speed against raw embreex on the very same rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from simrender.policies.ray_queue_cycling import SPLIT_SHARE
from simrender.rays import embree
from simrender.rays.kinds import KINDS, SHADOW
from simrender.rays.partition import Footprint
from simrender.units import format_bytes, format_count

if TYPE_CHECKING:
    from simrender.rays.trace import Columns, Trace
    from simrender.rays.workload import Workload


def raw_embreex_seconds(trace: Trace, clock: Callable[[], float]) -> float:
    """Return how long embreex alone takes for the same rays, on the same number of threads, in the same chunks."""
    scene = trace.everything
    seconds = 0.0
    for generation in range(trace.generations):
        rays = trace.geometry(generation)

        def work(rows: slice, rays: Columns = rays) -> None:
            scene.raw(rays["origin"][rows], rays["direction"][rows], rays["reach"][rows])

        begin = clock()
        embree.in_chunks(work, len(rays["reach"]))
        seconds += clock() - begin
    return seconds


def describe_rays(name: str, trace: Trace) -> RenderableType:
    """Return a table of a completed trace: rays of each kind, and how many of them hit something."""
    kind, hit = trace.column("kind"), np.isfinite(trace.column("t"))
    width, height = trace.size
    table = _table(f"{name}: {width}x{height}, {trace.samples} paths a pixel", "rays", "traced", "hit", "share")
    for k, label in enumerate(KINDS):
        rays, hits = int((kind == k).sum()), int(hit[kind == k].sum())
        word = " occluded" if k == SHADOW else ""
        table.add_row(label, f"{rays:,}", f"{hits:,}", f"{hits / rays:.1%}{word}" if rays else "")
    table.add_section()
    table.add_row("all", f"{trace.rays:,}", f"{int(hit.sum()):,}", f"{hit.mean():.1%}")
    scene = trace.scene
    table.caption = (
        f"{trace.generations} generations; {len(scene.objects)} objects, {len(scene.instance_object):,} instances, "
        f"{scene.unique_triangles:,} triangles, {scene.instanced_triangles:,} with instances\n"
    )
    return table


def describe_domains(workload: Workload, trace: Trace, domains: int) -> RenderableType:
    """Return a table of what lies in each domain of an object partition, heaviest objects first, big ones split.

    Sizes are published ones. What a machine's acceleration structures add to the bytes is on the machine's card, so it
    is left out here.
    """
    parts = workload.partition(domains, Footprint(0.0, 0.0), "heaviest_first", SPLIT_SHARE)
    primitive = trace.column("primitive")
    domain = parts.domain_of_mesh[trace.scene.triangles.mesh[primitive[primitive >= 0]]]
    hits = np.bincount(domain, minlength=domains)
    table = _table("", "domain", "geometry and textures", "triangles, instanced", "nearest hits", "share")
    for d in range(domains):
        share = f"{hits[d] / max(1, hits.sum()):.1%}"
        size, triangles = format_bytes(parts.weight_bytes[d]), format_count(parts.primitives[d])
        table.add_row(str(d), size, triangles, f"{hits[d]:,}", share)
    return table


def describe_speed(trace: Trace, seconds: float, clock: Callable[[], float]) -> str:
    """Return how fast the rays were traced through the tables, and how fast embreex alone traces the same rays.

    Parameters
    ----------
    trace : Trace
    seconds : float
        Wall time of the tracing, storing on disk included.
    clock : callable
        Returns wall time in seconds.

    """
    alone = trace.rays / raw_embreex_seconds(trace, clock) / 1e6
    if trace.traced_rays == 0:
        return f"every ray came from the cache; {alone:.2f} Mray/s by embreex alone"
    tables = trace.traced_rays / seconds / 1e6
    return f"{tables:.2f} Mray/s through the tables and onto the disk; {alone:.2f} Mray/s by embreex alone"


def _table(title: str, first: str, *numbers: str) -> Table:
    table = Table(box=None, pad_edge=False, title=title, title_justify="left", caption_justify="left")
    table.add_column(first)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table
