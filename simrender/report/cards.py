"""Cards on a terminal: what is installed, and one card as a table with the source of every value."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.cards import Card, written
from simrender.errors import CardError

if TYPE_CHECKING:
    from simrender.catalog import CardFile, Kind
    from simrender.documents import Document, Path

_STYLES: Final = {
    "published": "green",
    "measured": "green",
    "derived": "cyan",
    "assumed": "yellow",
    "calibrated": "yellow",
    "stated": "dim",
}
"""Yellow is what a result has to own up to."""

_NARROW: Final = 110
"""Columns of a terminal below which a range stands under its value, so that the source keeps room to be read."""

_VALUE: Final = (40, 26)
_STATUS: Final = (30, 12)
"""Columns that a value and its status get at most; the second number is for a narrow terminal."""

_SOURCE: Final = 12
"""Columns that a source gets at least."""


def titles(card: CardFile) -> list[tuple[str, str]]:
    """Return the names by which a card and its variants can be asked for, each with its title.

    Raises
    ------
    CardError
        If the card cannot be read.

    """
    document = card.document()
    document.check()
    named = {card.name: document, **{f"{card.name}:{variant}": d for variant, d in document.variants.items()}}
    return [(name, str(d.data.get("title", ""))) for name, d in named.items()]


def describe_card(card: CardFile, width: int) -> RenderableType:
    """Return a card, checked, as a table: every value with its range, status and source.

    Parameters
    ----------
    card : CardFile
    width : int
        Columns of the terminal.

    Raises
    ------
    CardError
        With every mistake of the card and of its variants.
    UnknownNameError
        If the card has no such variant.

    """
    from simrender.catalog import kind_of

    document = card.document()
    kind = card.kind or kind_of(document.data)
    if kind is None:
        raise CardError([f"{document.where}:1:1: expected the card of a machine or a workload, got neither's fields"])
    document.validate(_model(kind))
    return Group(*_heading(card, document), _table(document, width))


def _model(kind: Kind) -> type[Card]:
    if kind == "machine":
        from simrender.hardware.machine import MachineCard

        return MachineCard
    from simrender.rays.workload_card import WorkloadCard

    return WorkloadCard


def _heading(card: CardFile, document: Document) -> Iterator[RenderableType]:
    yield Text(str(document.data["title"]), style="bold")
    yield Text(f"{card.name}, {document.where}", style="dim")
    if document.variants:
        variants = Table(box=None, show_header=False, padding=(0, 0, 0, 2), pad_edge=True)
        for name, variant in document.variants.items():
            variants.add_row(Text(f"{card.name}:{name}"), Text(str(variant.data["title"])))
        yield Text("\nvariants", style="bold")
        yield variants
    yield Text()


def _table(document: Document, width: int) -> Table:
    leaves = [(path, value) for path, value in _leaves(document.data, ()) if path != ("title",)]
    leaves.sort(key=lambda leaf: len(leaf[0]) > 1)  # what stands in no section comes first
    table = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim underline")
    narrow = width < _NARROW
    values = [_value(value, "\n{}" if narrow else " ({})") for _, value in leaves]
    statuses = [_status(value, document, path, "\n" if narrow else ", ") for path, value in leaves]
    names = [_name(path) for path, _ in leaves]
    taken = [
        max(map(len, ["field", *names])),
        min(max(len("value"), _longest(values)), _VALUE[narrow]),
        min(max(len("status"), _longest(statuses)), _STATUS[narrow]),
    ]
    table.add_column("field", no_wrap=True)
    table.add_column("value", overflow="fold", width=taken[1])
    table.add_column("status", overflow="fold", width=taken[2])
    # Rich cuts off what a minimum of another column leaves no room for, so the rest is worked out here.
    table.add_column("source", overflow="fold", style="dim", width=max(width - sum(taken) - 6, _SOURCE))
    section = None
    for (path, value), name, shown, status in zip(leaves, names, values, statuses, strict=True):
        if len(path) > 1 and path[0] != section:
            section = path[0]
            table.add_row()
            table.add_row(Text(str(section), style="bold"))
        source = str(value.get("source", "")) if isinstance(value, dict) else ""
        table.add_row(Text(name), shown, status, Text(source))
    return table


def _name(path: Path) -> str:
    """Return what to call a value below the name of its section."""
    name = ".".join(str(part) for part in path[1:] or path)
    return f"  {name}" if len(path) > 1 else name


def _longest(cells: list[Text]) -> int:
    return max((len(line) for cell in cells for line in cell.plain.splitlines()), default=0)


def _status(value: Any, document: Document, path: Path, between: str) -> Text:
    """Return the status of a value and, where another card says it, that card."""
    status = str(value.get("status", "stated")) if isinstance(value, dict) else ""
    text, origin = Text(status, style=_STYLES.get(status, "")), document.origin(path)
    card = document.name.rpartition(":")[0] or document.name
    if origin == document.name != card:
        text.append(f"{between if status else ''}variant", "not dim magenta")
    elif origin not in {document.name, card}:
        text.append(f"{between if status else ''}from {origin}", "not dim magenta")
    return text


def _leaves(value: Any, path: Path) -> list[tuple[Path, Any]]:
    """Return every single value below a section, with its path; a list of single values is one."""
    if isinstance(value, dict) and "value" not in value:
        return [leaf for name, inner in value.items() for leaf in _leaves(inner, (*path, name))]
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return [leaf for i, inner in enumerate(value) for leaf in _leaves(inner, (*path, i))]
    return [(path, value)]


def _value(value: Any, form: str) -> Text:
    """Return a value and, in the given form, its range."""
    text = Text(_plain(value["value"] if isinstance(value, dict) else value))
    bounds = value.get("range") if isinstance(value, dict) else None
    if isinstance(bounds, list) and len(bounds) == 2:
        low, high = (_plain(bound) for bound in bounds)
        number, _, unit = low.partition(" ")
        text.append(form.format(f"{number if unit == high.partition(' ')[2] else low} to {high}"), "dim")
    return text


def _plain(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_plain(item) for item in value)}]"
    return "null" if value is None else written(value)
