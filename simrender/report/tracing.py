"""What `simrender trace` prints: rays, hits, and the speed against raw embreex on the very same rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from rich.console import RenderableType
from rich.table import Table

from simrender.rays import embree
from simrender.rays.kinds import KINDS, SHADOW
from simrender.units import format_count

if TYPE_CHECKING:
    from simrender.rays.trace import Columns, Trace


def raw_embreex_seconds(trace: Trace, clock: Callable[[], float]) -> float:
    """Return how long embreex alone takes for the same rays, on the same number of threads, in the same chunks."""
    scene = trace.everything
    seconds = 0.0
    for generation in range(trace.generations):
        rays = trace.geometry(generation)

        def work(rows: slice, rays: Columns = rays) -> None:
            scene.nearest(rays["origin"][rows], rays["direction"][rows], rays["reach"][rows])

        begin = clock()
        embree.in_chunks(work, len(rays["reach"]))
        seconds += clock() - begin
    return seconds


def describe_trace(name: str, trace: Trace, seconds: float | None, raw_seconds: float | None) -> RenderableType:
    """Return a table of a completed trace.

    Parameters
    ----------
    name : str
    trace : Trace
    seconds, raw_seconds : float or None
        Wall time of tracing through the tables, and of raw embreex; None if everything came from the cache.

    """
    kind, hit = trace.column("kind"), np.isfinite(trace.column("t"))
    table = Table(
        box=None,
        pad_edge=False,
        title=f"{name}: {trace.size[0]}x{trace.size[1]}, {trace.samples} paths a pixel",
        title_justify="left",
    )
    table.add_column("rays")
    for heading in ("traced", "hit", "share"):
        table.add_column(heading, justify="right")
    for k, label in enumerate(KINDS):
        rays, hits = int((kind == k).sum()), int(hit[kind == k].sum())
        word = " occluded" if k == SHADOW else ""
        table.add_row(label, f"{rays:,}", f"{hits:,}", f"{hits / rays:.1%}{word}" if rays else "")
    table.add_section()
    table.add_row("all", f"{trace.rays:,}", f"{int(hit.sum()):,}", f"{hit.mean():.1%}")
    scene = trace.scene
    table.caption = (
        f"{trace.generations} bounces; {len(scene.objects)} objects, {len(scene.instance_object):,} instances, "
        f"{scene.unique_triangles:,} triangles, {scene.instanced_triangles:,} with instances\n"
    )
    if seconds is None or raw_seconds is None:
        table.caption += "everything came from the cache"
    else:
        table.caption += (
            f"{format_count(trace.rays / seconds)}ray/s through the tables, "
            f"{format_count(trace.rays / raw_seconds)}ray/s by embreex alone: ratio {raw_seconds / seconds:.2f}"
        )
    table.caption_justify = "left"
    return table
