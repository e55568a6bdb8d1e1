"""What `simrender trace` prints: rays, hits, domains, errors, and the speed against raw embreex on the same rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table

from simrender.rays import embree
from simrender.rays.integrators import INTEGRATORS
from simrender.rays.kinds import KINDS
from simrender.rays.worlds import SurfaceWorld
from simrender.units import format_bytes, format_count

if TYPE_CHECKING:
    from simrender.rays.crossings import Crossings
    from simrender.rays.domains import Domains
    from simrender.rays.estimate import Estimate
    from simrender.rays.trace import Columns, Trace
    from simrender.rays.workload import Workload

SHOWN_DOMAINS = 24
"""Rows of the table of domains; the others are summed up in one."""


def raw_embreex_seconds(trace: Trace, clock: Callable[[], float]) -> float:
    """Return how long embreex alone takes for the same rays, on the same number of threads, in the same chunks."""
    assert isinstance(trace.world, SurfaceWorld)  # noqa: S101 - the caller looked
    scene = trace.world.geometry
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
    rays, hits = ray_counts(trace)
    title = f"{name}: {trace.size[0]}x{trace.size[1]}, {_several(trace.samples, 'path')} a pixel"
    table = _table("rays", "traced", "hit", "share")
    for label in KINDS:
        if rays[label] or label != "scatter":
            word = " occluded" if label == "shadow" else ""
            share = f"{hits[label] / rays[label]:.1%}{word}" if rays[label] else ""
            table.add_row(label, f"{rays[label]:,}", f"{hits[label]:,}", share)
    table.add_section()
    total = sum(hits.values())
    table.add_row("all", f"{trace.rays:,}", f"{total:,}", f"{total / trace.rays:.1%}")
    return Group(title, table, f"{_several(trace.generations, 'generation')}; {_size(trace)}\n")


def _several(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _size(trace: Trace) -> str:
    scene = trace.scene
    parts = []
    if len(scene.instance_object):
        parts.append(
            f"{_several(len(scene.objects), 'object')}, {_several(len(scene.instance_object), 'instance')}, "
            f"{_several(scene.unique_triangles, 'triangle')}, {scene.instanced_triangles:,} with instances"
        )
    if scene.volume is not None:
        parts.append(f"{' x '.join(str(n) for n in scene.volume.dims)} voxels")
    if scene.elements is not None:
        parts.append(f"{_several(scene.elements.count, 'element')} in {_several(scene.elements.parts, 'part')}")
    if trace.world.outcome:
        parts.append(f"{int(trace.column('work').sum()):,} {unit_of_work(trace)}")
    return "; ".join(parts)


def unit_of_work(trace: Trace) -> str:
    """Return what the work of a ray is counted in: ``rays`` on surfaces, where it is one query each."""
    name = next(name for name, kind in INTEGRATORS.items() if isinstance(trace.integrator, kind))
    return {"volume_marching": "samples", "volume_path_tracing": "look-ups", "element_marching": "elements"}.get(
        name, "rays"
    )


def ray_counts(trace: Trace) -> tuple[dict[str, int], dict[str, int]]:
    """Return the rays of each kind, and those of them that hit something."""
    kind, hit = trace.column("kind"), np.isfinite(trace.column("t"))
    rays, hits = np.bincount(kind, minlength=len(KINDS)), np.bincount(kind[hit], minlength=len(KINDS))
    return dict(zip(KINDS, rays.tolist(), strict=True)), dict(zip(KINDS, hits.tolist(), strict=True))


def nearest_hits(trace: Trace, domains: Domains) -> NDArray[np.int64] | None:
    """Return how many rays have their nearest hit in each domain, int64 (domains,); None where nothing is hit whole."""
    if domains.domain_of_triangle is None:
        return None
    primitive = trace.column("primitive")
    return np.bincount(domains.domain_of_triangle[primitive[primitive >= 0]], minlength=domains.count)


def describe_domains(trace: Trace, crossings: Crossings) -> RenderableType:
    """Return a table of the domains: their published size, the camera rays that enter them, and the hits in them.

    What a machine's acceleration structures add to the bytes is on the machine's card, so it is left out here.
    """
    domains = crossings.domains
    entered = np.bincount(crossings.table(0)["domain"], minlength=domains.count)
    hits = nearest_hits(trace, domains)
    columns = [
        "bytes as published",
        "primitives",
        "camera rays",
        *(["nearest hits", "share"] if hits is not None else []),
    ]
    table = _table("domain", *columns)

    def row(label: str, of: slice) -> None:
        cells = [
            format_bytes(domains.bytes[of].sum()),
            format_count(domains.primitives[of].sum()),
            f"{entered[of].sum():,}",
        ]
        if hits is not None:
            cells += [f"{hits[of].sum():,}", f"{hits[of].sum() / max(1, hits.sum()):.1%}"]
        table.add_row(label, *cells)

    shown = domains.count if domains.count <= SHOWN_DOMAINS else SHOWN_DOMAINS - 1
    for d in range(shown):
        row(str(d), slice(d, d + 1))
    if shown < domains.count:
        row(f"{shown} to {domains.count - 1}", slice(shown, None))
    table.add_section()
    row("all", slice(None))
    return Group(table, "")


def describe_estimates(estimates: dict[str, Estimate]) -> RenderableType:
    """Return a table of what replicas say of the sampling error."""
    some = next(iter(estimates.values()))
    table = _table("as published", "mean", f"{some.confidence:.0%} interval", "relative")
    of_domains = [name for name in estimates if name.startswith("rays that enter")]
    fullest = sorted(of_domains, key=lambda name: -float(estimates[name].mean))[:SHOWN_DOMAINS]
    for name, found in estimates.items():
        if name in of_domains and name not in fullest:
            continue
        kind = name.split()[0]
        if kind in KINDS[1:] and float(estimates[f"{kind} rays"].mean) == 0.0:
            continue  # there are none of this kind
        mean, half = float(found.mean), float(found.half_width)
        table.add_row(name, format_count(mean), f"± {format_count(half)}", f"± {half / mean:.2%}" if mean else "")
    return Group(table, f"from {some.replicas} independent replicas\n")


def replica_counts(workload: Workload, trace: Trace, crossings: Crossings) -> dict[str, float]:
    """Return what a replica counts, scaled to the published frame: rays, hits, and rays that enter each domain."""
    scale = workload.weight * workload.repeats
    rays, hits = ray_counts(trace)
    # Every kind, for one replica may have rays of a kind that another has not.
    counts = {f"{kind} rays": rays[kind] * scale for kind in KINDS}
    counts |= {f"{kind} hits": hits[kind] * scale for kind in KINDS}
    entered = np.zeros(crossings.domains.count)
    for generation in range(trace.generations):
        entered += np.bincount(crossings.table(generation)["domain"], minlength=len(entered))
    counts |= {f"rays that enter domain {d}": float(entered[d]) * scale for d in range(len(entered))}
    counts["mean radiance"] = float(trace.image().mean())
    return counts


def trace_dict(workload: Workload, trace: Trace, crossings: Crossings) -> dict[str, Any]:
    """Return what `simrender trace` found, for JSON."""
    rays, hits = ray_counts(trace)
    domains = crossings.domains
    table = crossings.table(0)
    entered = np.bincount(table["domain"], minlength=domains.count)
    nearest = nearest_hits(trace, domains)
    rows = [
        {
            "domain": d,
            "published_bytes": float(domains.bytes[d]),
            "published_primitives": float(domains.primitives[d]),
            "camera_crossings": int(entered[d]),
            **({} if nearest is None else {"nearest_hits": int(nearest[d])}),
        }
        for d in range(domains.count)
    ]
    found: dict[str, Any] = {
        "workload": workload.name,
        "resolution": list(trace.size),
        "samples": trace.samples,
        "seed": trace.seed,
        "ray_weight": workload.weight * workload.repeats,
        "generations": trace.generations,
        "rays": trace.rays,
        "camera_hits": hits["camera"],
        "camera_crossings": len(table["domain"]),
        "occluded_shadow_rays": hits["shadow"],
        "rays_by_kind": rays,
        "hits_by_kind": hits,
        "domains": rows,
    }
    if trace.world.outcome:
        found["work"] = int(trace.column("work").sum())
        found["work_unit"] = unit_of_work(trace)
    return found


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
    if not isinstance(trace.world, SurfaceWorld):
        if trace.traced_rays == 0:
            return "every ray came from the cache"
        work = float(trace.column("work").sum()) / seconds / 1e6
        return f"{trace.traced_rays / seconds / 1e6:.2f} Mray/s and {work:.1f} M {unit_of_work(trace)}/s onto the disk"
    alone = trace.rays / raw_embreex_seconds(trace, clock) / 1e6
    if trace.traced_rays == 0:
        return f"every ray came from the cache; {alone:.2f} Mray/s by embreex alone"
    tables = trace.traced_rays / seconds / 1e6
    return f"{tables:.2f} Mray/s through the tables and onto the disk; {alone:.2f} Mray/s by embreex alone"


def _table(first: str, *numbers: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(first)
    for heading in numbers:
        table.add_column(heading, justify="right")
    return table
