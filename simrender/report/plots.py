"""Plots of results, with matplotlib."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np

from simrender.clock import TICKS_PER_SECOND
from simrender.timeline import COPIES, KERNELS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from simrender.result import Result

COLORS = {
    "generate": "#c7c7c7",
    "trace": "#8fce6a",
    "copy": "#c9e8b5",
    "shade": "#2e7d32",
    "tonemap": "#6d6d6d",
    "assemble": "#3d3d3d",
    "merge": "#9ec9e2",
}
"""Trace and cycle in light greens, shading in dark green, as in figure 7 of the ray queue cycling paper."""

LINK = "#c26a00"
"""The utilization of the busiest link."""

LABELS = {
    "generate": "generate",
    "trace": "trace",
    "copy": "copy of ray queues",
    "shade": "shade",
    "tonemap": "tone-map",
    "assemble": "assemble",
    "merge": "copy of pixels",
}


def _plot_load(axes: Axes, result: Result, name: str, bottom: float) -> None:
    """Draw a link's utilization over time into a row of its own, on which zero is at the bottom."""
    ticks, loads = result.loads[name]
    times = np.concatenate([[0], ticks, [round((result.frame_time_s or 0.0) * TICKS_PER_SECOND)]]) / TICKS_PER_SECOND
    share = np.concatenate([[0.0], loads, loads[-1:]]) / result.links[name]["bandwidth_bytes_per_s"]
    axes.fill_between(times * 1e3, bottom, bottom - 0.8 * share, step="post", color=LINK, linewidth=0)


def plot_timeline(result: Result, figure: Figure | None = None) -> Figure:
    """Draw who did what, when: a row a GPU, idle time in the background colour; below, the load of the busiest link.

    The layout of figure 7 of the ray queue cycling paper. The figure belongs to no window system and can be made in
    any thread.

    Parameters
    ----------
    result : Result
        Of a feasible run.
    figure : matplotlib Figure, optional
        To draw into; a new one by default.

    """
    from matplotlib.figure import Figure as NewFigure
    from matplotlib.patches import Patch

    log = result.spans
    if log is None:
        raise ValueError("an infeasible run has no timeline")
    figure = figure or NewFigure(figsize=(10.0, 1.5 + 0.32 * log.gpus), layout="constrained")
    axes = figure.subplots()
    axes.set_facecolor("#f4f4ef")
    device, kind = np.array(log.device), np.array(log.kind)
    start, end = (np.array(t, dtype=float) / TICKS_PER_SECOND * 1e3 for t in (log.start, log.end))
    legend: list[Any] = []
    for k, name in enumerate(KERNELS + COPIES):
        chosen = kind == k
        if not chosen.any():
            continue
        for gpu in range(log.gpus):
            rows = chosen & (device == gpu)
            spans = list(zip(start[rows], end[rows] - start[rows], strict=True))
            # Without edges and smoothing, thousands of thin spans add up to the colour of their share.
            axes.broken_barh(spans, (gpu - 0.4, 0.8), facecolors=COLORS[name], edgecolor="none", linewidth=0)
        share = float((end - start)[chosen].sum()) / (log.gpus * (result.frame_time_s or 1.0) * 1e3)
        if share >= 0.0005:
            legend.append(Patch(facecolor=COLORS[name], label=f"{LABELS[name]} ({share:.1%})"))
    idle = result.breakdown.get("wait", 0.0)
    legend.append(Patch(facecolor="#f4f4ef", edgecolor="#bbbbbb", label=f"idle ({idle:.1%})"))
    rows = [re.sub(r"^gpu(?=\d)", "GPU ", name) for name in log.names]
    if result.busiest_link:
        _plot_load(axes, result, result.busiest_link, log.gpus + 0.4)
        load = result.links[result.busiest_link]["mean_utilization"]
        legend.append(Patch(facecolor=LINK, label=f"load of the busiest link ({load:.1%})"))
        rows.append(result.busiest_link)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_ylim(len(rows) - 0.4, -0.5)
    axes.set_xlim(0.0, (result.frame_time_s or 0.0) * 1e3)
    axes.set_xlabel("time in the frame [ms]")
    axes.tick_params(axis="y", length=0)
    axes.spines[["top", "right", "left"]].set_visible(False)
    islands = f"{result.islands} island{'s' if result.islands != 1 else ''} of {result.island_size}"
    axes.set_title(f"{result.workload} on {result.machine}, {result.policy}, {islands}", fontsize=10)
    figure.legend(handles=legend, loc="outside lower center", ncols=min(5, len(legend)), frameon=False, fontsize=8)
    return figure
