"""The experiments of SpRay's section 5: what the baseline and speculation spend their time on.

Park, Fussell and Navratil, "SpRay: speculative ray scheduling for large data visualization" (2018), figures 6, 7 and 8,
on `stampede2-skx` with the stand-ins of their scenes. Nothing is fitted: where the figures here differ from the
paper's, the stand-ins, the machine's assumed rates and the program's errors are all candidates.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from simrender.catalog import find_policy
from simrender.policies.domain_frame import DomainPolicy
from simrender.rays.workload import Workload, load_workload
from simrender.simulation import simulate

MACHINE = "stampede2-skx"

Scheduler = Literal["baseline", "speculation"]
SCHEDULERS: tuple[Scheduler, ...] = ("baseline", "speculation")
_POLICIES = {"baseline": "load_any_once", "speculation": "speculation"}


@dataclass(frozen=True)
class Run:
    """One bar of a figure.

    Attributes
    ----------
    scene, shading : str
        Name of the workload; ``AO`` or ``PT``.
    scheduler : str
    nodes : int
    cache : str
        Share of the domains that a node's cache holds; empty in situ.
    history_depth, bounces : int
    frame_time_s, load_s, render_s, copy_s, sync_s, wait_s : float
        Of an average node; they add up to the frame.
    loads, tests, sent_rays : int
    fits : bool
        Whether data and rays fit into a node's memory.

    """

    scene: str
    shading: str
    scheduler: str
    nodes: int
    cache: str
    history_depth: int
    bounces: int
    frame_time_s: float
    load_s: float
    render_s: float
    copy_s: float
    sync_s: float
    wait_s: float
    loads: int
    tests: int
    sent_rays: int
    fits: bool


def workload(
    scene: str, shading: str, *, resolution: str = "96x96", samples: int = 2, bounces: int | None = None
) -> Workload:
    """Return a scene of the paper at a size that is quickly traced, with one of its two kinds of shading."""
    name = f"{scene}:ao" if shading == "AO" else scene
    overrides = [f"traced.resolution={resolution}", f"traced.samples={samples}"]
    if bounces is not None:
        overrides.append(f"integrator.bounces={bounces}")
    return load_workload(name, overrides)


def run(
    scene: Workload,
    shading: str,
    scheduler: Scheduler,
    *,
    nodes: int = 1,
    cache: str = "",
    history_depth: int | None = None,
) -> Run:
    """Render a frame out of core, with a cache of some share of the domains, or in situ, without one.

    In situ a rank traces with one thread, as in the paper.
    """
    bounces = int(getattr(scene.integrator, "bounces", 1))
    options: dict[str, Any] = {"data": "out_of_core", "cache": cache} if cache else {"data": "in_situ", "threads": 1}
    if scheduler == "speculation" and cache:
        options["history_depth"] = history_depth or bounces
    policy: DomainPolicy = find_policy(_POLICIES[scheduler])(**options)
    result = simulate(MACHINE, scene, policy, nodes=nodes, islands="auto" if cache else 1)
    time, share, counts = result.frame_time_s or 0.0, result.breakdown, result.counts
    return Run(
        scene.name.partition(":")[0], shading, scheduler, nodes, cache, history_depth or bounces, bounces, time,
        share["load"] * time, share["trace"] * time, share["copy"] * time, share["sync"] * time, share["wait"] * time,
        int(counts["loads"]), int(counts["radiance_tests"] + counts["shadow_tests"]), int(counts["sent_rays"]),
        result.feasible,
    )  # fmt: skip


def out_of_core(
    scenes: Iterable[str] = ("enzo", "rm"),
    shadings: Sequence[str] = ("AO", "PT"),
    nodes: Sequence[int] = (1, 2, 4),
    caches: Sequence[str] = ("25%", "50%", "75%", "100%"),
    **size: Any,
) -> list[Run]:
    """Return the runs of figure 6."""
    found = []
    for scene in scenes:
        for shading in shadings:
            made = workload(scene, shading, **size)
            found += [
                run(made, shading, scheduler, nodes=n, cache=cache)
                for n in nodes
                for cache in caches
                for scheduler in SCHEDULERS
            ]
    return found


def in_situ(
    scenes: Iterable[str] = ("dns1-side", "dns1-back", "dns2"),
    shadings: Sequence[str] = ("AO", "PT"),
    nodes: Sequence[int] = (16, 32, 64, 128),
    **size: Any,
) -> list[Run]:
    """Return the runs of figure 7."""
    found = []
    for scene in scenes:
        for shading in shadings:
            made = workload(scene, shading, **size)
            found += [run(made, shading, scheduler, nodes=n) for n in nodes for scheduler in SCHEDULERS]
    return found


def history(
    scenes: Iterable[str] = ("enzo", "rm"),
    bounces: Sequence[int] = (1, 2, 3, 4),
    depths: Sequence[int] = (1, 2, 3, 4),
    cache: str = "50%",
    **size: Any,
) -> list[Run]:
    """Return the runs of figure 8: every history depth for every number of bounces, on one node."""
    found = []
    for scene in scenes:
        for b in bounces:
            made = workload(scene, "PT", bounces=b, **size)
            found += [run(made, "PT", "speculation", cache=cache, history_depth=h) for h in depths]
    return found


def speedups(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Return by how much speculation is faster than the baseline, in all, in loading and in rendering, pair by pair."""
    pairs: dict[tuple[Any, ...], dict[str, Run]] = {}
    for r in runs:
        pairs.setdefault((r.scene, r.shading, r.nodes, r.cache), {})[r.scheduler] = r
    rows = []
    for (scene, shading, nodes, cache), pair in pairs.items():
        a, b = pair["baseline"], pair["speculation"]
        rows.append(
            {
                "scene": scene,
                "shading": shading,
                "nodes": nodes,
                "cache": cache,
                "frame": a.frame_time_s / b.frame_time_s,
                "load": a.load_s / b.load_s if b.load_s else None,
                "render": a.render_s / b.render_s if b.render_s else None,
                "loads": a.loads / b.loads if b.loads else None,
                "sent_rays": b.sent_rays / a.sent_rays if a.sent_rays else None,
            }
        )
    return rows
