"""The table of `simrender compare`."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.accuracy.spray import Compared


def describe_comparison(rows: Sequence[Compared]) -> RenderableType:
    """Return a row a quantity and run, those out of their tolerance marked, and how many are within it."""
    table = Table(box=None, pad_edge=False)
    for heading, justify in (
        ("run", "right"), ("quantity", "left"), ("ours", "right"), ("program", "right"), ("error", "right"),
        ("allowed", "left"), ("", "left"),
    ):  # fmt: skip
        table.add_column(heading, justify=justify)  # type: ignore[arg-type]
    last = None
    for row in rows:
        if last not in {None, row.run}:
            table.add_section()
        last = row.run
        word = Text("" if row.within_tolerance else "out of tolerance", style="red")
        counts = f"{row.ours:,.0f}", f"{row.program:,.0f}", f"{row.relative_error:+.3%}"
        table.add_row(row.run, row.quantity, *counts, row.tolerance, word)
    within = sum(row.within_tolerance for row in rows)
    return Group(table, Text(), f"{within} of {len(rows)} within their tolerances")
