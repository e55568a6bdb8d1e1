"""The answer for frames along a camera's path."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.units import format_bytes, format_seconds

if TYPE_CHECKING:
    from simrender.camera_path import PathResult


def describe_path(result: PathResult) -> RenderableType:
    """Return the frame rate along the path, and what each frame took."""
    title = Text(f"{result.workload} on {result.machine} under {result.policy}", style="bold underline")
    m = result.memory
    if not result.feasible:
        return Group(
            Text(f"{result.workload} does not fit on {result.machine} under {result.policy}", style="bold red"),
            Text(
                f"A node would keep {format_bytes(m['needed_bytes'])} of the data and has "
                f"{format_bytes(m['capacity_bytes'])}; a smaller policy.cache keeps less."
            ),
        )
    facts = Table.grid(padding=(0, 2))
    facts.add_column(style="bold", no_wrap=True)
    facts.add_column()
    facts.add_row("frame rate", f"{result.frames_per_s or 0.0:.3g} frames/s over {len(result.frames)} frames")
    assumed = sum(1 for v in result.uncalibrated if v["status"] == "assumed")
    fitted = len(result.uncalibrated) - assumed
    if result.uncalibrated:
        words = " and ".join(f"{n} {what}" for n, what in ((assumed, "assumed"), (fitted, "fitted")) if n)
        facts.add_row("", Text(f"not calibrated: hangs on {words} values (listed by --json)", style="yellow"))
    facts.add_row("nodes", f"{result.nodes - 1} render with {result.threads} threads each, one has master and display")
    facts.add_row("memory", f"{format_bytes(m['needed_bytes'])} of {format_bytes(m['capacity_bytes'])} on a node")
    facts.add_row("left out", Text("; ".join(item["what"] for item in result.scope["left_out"]), style="dim"))
    table = Table(box=None, pad_edge=False)
    for heading in ("frame", "time", "frames/s", "misses", "fetched", "imbalance"):
        table.add_column(heading, justify="right")
    rows = [("cold", result.cold)] if result.cold else []
    for name, frame in [*rows, *((str(k), f) for k, f in enumerate(result.frames))]:
        table.add_row(
            name, format_seconds(frame.frame_time_s), f"{frame.frames_per_s:.3g}", f"{frame.miss_rate:.1%}",
            format_bytes(frame.fetched_bytes), f"{frame.imbalance:.2f}",
        )  # fmt: skip
    return Group(title, facts, Text(), table)
