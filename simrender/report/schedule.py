"""The first steps of a schedule, drawn as the table in figure 2 of SpRay."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.errors import UsageError
from simrender.policies.domain_frame import EXPLAINED

if TYPE_CHECKING:
    from simrender.result import Result

_ROWS = 20


def explain_schedule(result: Result) -> RenderableType:
    """Return the queues before each of the first steps, the scheduled ones in parentheses, and what was loaded.

    Raises
    ------
    UsageError
        If the policy schedules no domains.

    """
    if not result.schedule:
        raise UsageError(f"--explain schedule: {result.policy} schedules no domains")
    visits = Counter(e.rank for e in result.events)
    busiest = min(visits, key=lambda rank: (-visits[rank], rank)) if visits else 0
    together = result.schedule[0].rank is None
    moments = [m for m in result.schedule if together or m.rank == busiest][:EXPLAINED]
    scheduled = [d for moment in moments for d in moment.scheduled]
    most = np.max([moment.waiting for moment in moments], axis=0)
    shown = sorted(dict.fromkeys(scheduled)) if len(set(scheduled)) <= _ROWS else sorted(set(scheduled[:_ROWS]))
    spare = [int(d) for d in np.argsort(-most, kind="stable") if most[d] > 0 and d not in shown]
    shown = sorted([*shown, *spare[: max(0, _ROWS - len(shown))]])
    table = Table(box=None, pad_edge=False)
    table.add_column("domain")
    for step in range(len(moments)):
        table.add_column(f"t{step}", justify="right")
    for d in shown:
        cells = []
        for moment in moments:
            count = f"{moment.waiting[d]:,}" if moment.waiting[d] else ""
            cells.append(f"({count})" if d in moment.scheduled else count)
        table.add_row(str(d), *cells)
    others = [int(moment.waiting.sum() - moment.waiting[shown].sum()) for moment in moments]
    if any(others):
        table.add_row("others", *(f"{n:,}" if n else "" for n in others))
    table.add_section()
    table.add_row("process", *(_domains(moment.scheduled) for moment in moments))
    loads = {(e.rank, e.step): e.loaded for e in result.events}
    if not together:
        table.add_row("load", *("yes" if loads.get((busiest, step)) else "cached" for step in range(len(moments))))
    whose = "all ranks" if together else f"{result.processor} {busiest}, the busiest,"
    total, missed = len(result.events), sum(e.loaded for e in result.events)
    note = f"rays in the queues of {whose} before each step, those processed next in parentheses; "
    note += f"in all {total:,} visits of domains" + (f", {missed:,} of which had to load" if missed else "")
    return Group(Text(), table, Text(note, style="dim"))


def _domains(scheduled: tuple[int, ...]) -> str:
    return " ".join(str(d) for d in scheduled[:3]) + (" …" if len(scheduled) > 3 else "")
