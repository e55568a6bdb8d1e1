"""Figures 6, 7 and 8 of the SpRay paper, drawn from simulated runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from simrender.accuracy.spray_paper import Run

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PARTS = (
    ("load_s", "load", "#c9b458"),
    ("render_s", "render", "#4a90c2"),
    ("copy_s", "rays and images", "#8fbf6b"),
    ("sync_s", "counts and buffers", "#b07aa1"),
    ("wait_s", "waiting for others", "#d9d9d9"),
)


def plot_bars(runs: Sequence[Run], title: str) -> Figure:
    """Draw stacked bars, baseline beside speculation: a panel for each scene and shading (figures 6 and 7).

    Parameters
    ----------
    runs : sequence of Run
        Out of core they are told apart by nodes and cache, in situ by nodes.
    title : str

    """
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(r.scene for r in runs))
    shadings = list(dict.fromkeys(r.shading for r in runs))
    figure = Figure(figsize=(5.2 * len(shadings), 3.1 * len(scenes) + 0.5), layout="constrained")
    panels = figure.subplots(len(scenes), len(shadings), squeeze=False)
    for i, scene in enumerate(scenes):
        for j, shading in enumerate(shadings):
            _bars(panels[i][j], [r for r in runs if (r.scene, r.shading) == (scene, shading)], f"{scene}, {shading}")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(
        handles[: len(PARTS)], labels[: len(PARTS)], loc="outside lower center", ncols=len(PARTS), frameon=False
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    return figure


def _bars(axes: Axes, runs: Sequence[Run], title: str) -> None:
    keys = list(dict.fromkeys((r.nodes, r.cache) for r in runs))
    for k, key in enumerate(keys):
        for offset, scheduler in ((-0.2, "baseline"), (0.2, "speculation")):
            bottom = 0.0
            for r in runs:
                if ((r.nodes, r.cache), r.scheduler) != (key, scheduler):
                    continue
                for name, label, color in PARTS:
                    height = getattr(r, name)
                    hatch = "//" if scheduler == "speculation" else ""
                    axes.bar(
                        k + offset, height, 0.36, bottom, color=color, label=label, hatch=hatch, edgecolor="white",
                        linewidth=0.4,
                    )  # fmt: skip
                    bottom += height
                if not r.fits:
                    axes.annotate("memory", (k + offset, bottom), rotation=90, ha="center", va="bottom", fontsize=6)
    axes.set_xticks(range(len(keys)), [cache or str(nodes) for nodes, cache in keys], fontsize=7)
    if any(cache for _, cache in keys):
        for nodes in dict.fromkeys(n for n, _ in keys):
            places = [k for k, key in enumerate(keys) if key[0] == nodes]
            axes.annotate(
                f"{nodes} node{'s' if nodes > 1 else ''}", (float(np.mean(places)), -0.17), ha="center", fontsize=8,
                xycoords=("data", "axes fraction"), annotation_clip=False,
            )  # fmt: skip
    else:
        axes.set_xlabel("nodes", fontsize=8)
    # Parts without a height would let the axes end where the tallest bar does.
    axes.set_ylim(0.0, 1.05 * max(r.frame_time_s for r in runs))
    axes.set_title(title, fontsize=9, loc="left")
    axes.set_ylabel("s a frame", fontsize=8)
    axes.tick_params(labelsize=7)
    axes.spines[["top", "right"]].set_visible(False)


def plot_history(runs: Sequence[Run], title: str) -> Figure:
    """Draw frame time and load time against history depth, a line for each number of bounces (figure 8)."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys(r.scene for r in runs))
    figure = Figure(figsize=(4.6 * len(scenes), 3.4), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        for number, bounces in enumerate(dict.fromkeys(r.bounces for r in runs)):
            line = [r for r in runs if (r.scene, r.bounces) == (scene, bounces)]
            depth = [r.history_depth for r in line]
            axes.plot(
                depth,
                [r.frame_time_s for r in line],
                "o-",
                color=f"C{number}",
                label=f"{bounces} bounce{'s' if bounces > 1 else ''}",
                ms=4,
            )
            axes.plot(depth, [r.load_s for r in line], ":", color=f"C{number}")
        axes.set_title(f"{scene}: frame (solid), loading (dotted)", fontsize=9, loc="left")
        axes.set_xlabel("history depth", fontsize=8)
        axes.set_ylabel("s", fontsize=8)
        axes.set_ylim(bottom=0.0)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        axes.set_xticks(sorted({r.history_depth for r in runs}))
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7, frameon=False)
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    return figure
