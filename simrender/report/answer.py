"""The answer on a terminal: frame rate, its error, where the time went, and what was left out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.units import format_bytes, format_count, format_seconds

if TYPE_CHECKING:
    from simrender.result import Result

_BARS = {
    "load": ("▚", "yellow"),
    "sync": ("▞", "magenta"),
    "trace": ("█", "green"),
    "shade": ("▓", "dark_green"),
    "copy": ("▒", "blue"),
    "wait": ("░", "bright_black"),
}
"""Told apart without colours too."""

_BAR = 48
_LEVELS = " ▁▂▃▄▅▆▇█"


def answer(result: Result) -> RenderableType:
    """Return what a person wants to know first."""
    if not result.feasible:
        return Group(*_infeasible(result))
    table = Table.grid(padding=(0, 2))
    table.add_column(style="bold", no_wrap=True)
    table.add_column()
    time = result.frame_time_s or 0.0
    rate = result.frames_per_s or 0.0
    figure = f"{rate:.3g}" if rate < 999.5 else f"{rate:,.0f}"
    table.add_row("frame rate", Text(f"{figure} frames/s").append(_sampling(result, 1), style="not bold"), style="bold")
    table.add_row("frame time", format_seconds(time) + _sampling(result, -1))
    table.add_row("", _calibration(result))
    table.add_row("islands", _islands(result))
    table.add_row("memory", _memory(result))
    table.add_row("where the time went", _bar(result.breakdown))
    table.add_row("busy over time", _course(result))
    if result.busiest_link:
        table.add_row("busiest link", _busiest(result, result.busiest_link))
    if any(what.startswith("staging") for what in result.scope["modelled"]):
        table.add_row("", "messages between nodes are staged: two copies, over host links")
    table.add_row("rays", _rays(result))
    table.add_row("left out", Text("; ".join(item["what"] for item in result.scope["left_out"]), style="dim"))
    title = Text(f"{result.workload} on {result.machine} under {result.policy}", style="bold underline")
    return Group(title, table)


def _sampling(result: Result, sign: int) -> str:
    """Return the error of tracing fewer pixels: mostly the frame comes out too slow, so it has two sides."""
    error = result.sampling_error
    if not error["relative_error"]:
        return " (every pixel was traced)"
    either, slow = 100 * error["rays_relative_standard_error"], 100 * error["relative_error"]
    less, more = (either, slow) if sign > 0 else (slow, either)
    return f" (-{_one_digit(less)} % to +{_one_digit(more)} %, sampling)"


def _one_digit(value: float) -> str:
    return f"{float(f'{value:.1g}'):g}"  # 10, and not 1e+01


def _calibration(result: Result) -> Text:
    assumed = sum(1 for v in result.uncalibrated if v["status"] == "assumed")
    fitted = len(result.uncalibrated) - assumed
    if not result.uncalibrated:
        return Text("every input is published, measured or derived")
    parts = [f"{assumed} assumed"] if assumed else []
    parts += [f"{fitted} fitted"] if fitted else []
    return Text(f"not calibrated: hangs on {' and '.join(parts)} values (listed by --json)", style="yellow")


def _islands(result: Result) -> str:
    noun = result.processor
    islands = f"{result.islands} of {result.island_size} {noun}{'s' if result.island_size != 1 else ''}"
    return f"{islands}; {result.unused_gpus} of {result.gpus} {noun}s unused" if result.unused_gpus else islands


def _memory(result: Result) -> str:
    m = result.memory
    needed, capacity, model = (format_bytes(m[f"{key}_bytes"]) for key in ("needed", "capacity", "model"))
    return f"{needed} of {capacity} on the fullest {result.processor}, {model} of it the model"


def _bar(breakdown: dict[str, float]) -> Text:
    text, drawn, covered = Text(), 0, 0.0
    for name, share in breakdown.items():
        covered += share
        cells = round(covered * _BAR) - drawn
        drawn += cells
        glyph, color = _BARS[name]
        text.append(glyph * cells, style=color)
    words = ", ".join(f"{_BARS[name][0]} {name} {share:.0%}" for name, share in breakdown.items())
    return text.append(f"\n{words}", style="default")


def _course(result: Result) -> str:
    """Return the share of the processors that compute as the frame goes on, in as many steps as the bar has cells."""
    parts = np.array_split(np.array(result.busy_over_time), _BAR)
    return "".join(_LEVELS[round(float(part.mean()) * (len(_LEVELS) - 1))] for part in parts)


def _busiest(result: Result, name: str) -> str:
    link = result.links[name]
    mean, peak = (100.0 * link[f"{which}_utilization"] for which in ("mean", "peak"))
    return f"{name}, {mean:.2g} % of its bandwidth over the frame, {peak:.3g} % at its peak"


def _rays(result: Result) -> str:
    c = result.counts
    return (
        f"{format_count(c['published_rays'])} a frame; {format_count(c['traced_rays'])} really traced, "
        f"each for {c['ray_weight']:.3g}"
    )


def _infeasible(result: Result) -> list[Any]:
    m, needed = result.memory, result.memory["gpus_needed"]
    need, capacity = format_bytes(m["needed_bytes"]), format_bytes(m["capacity_bytes"])
    noun = result.processor
    islands, many = ("s" if n != 1 else "" for n in (result.islands, result.island_size))
    size = f"{result.islands} island{islands} of {result.island_size} {noun}{many}"
    why = "one part of the model cannot be split" if result.island_size > 1 else f"every {noun} would hold all of it"
    if "peak_rays_bytes" in m and m["model_bytes"] <= m["capacity_bytes"]:
        return [
            Text(f"{result.workload} does not fit on {result.machine} under {result.policy}", style="bold red"),
            Text(
                f"The data take {format_bytes(m['model_bytes'])} of {capacity} on the fullest {noun}, and the rays in "
                f"flight there another {format_bytes(m['peak_rays_bytes'])}."
            ),
        ]
    lines = [
        Text(f"{result.workload} does not fit on {result.machine} under {result.policy}", style="bold red"),
        Text(f"In {size}, the fullest {noun} would need {need} and has {capacity}."),
    ]
    if needed is None:
        lines.append(Text(f"No number of such {noun}s would do: {why}."))
    else:
        lines.append(Text(f"{needed} such {noun}s would do."))
    return lines
