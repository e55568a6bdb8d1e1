"""What `simrender network` prints: how long collectives, messages and frames on a display take, and what fills up."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from simrender.hardware.questions import GATHERING, Answer
from simrender.hardware.schedules import DIRECT
from simrender.result import owned_up
from simrender.units import format_bytes, format_seconds

if TYPE_CHECKING:
    from simrender.hardware.display import DisplayReport
    from simrender.hardware.machine import MachineCard

_IDLE: Final = (
    ("other jobs on the machine", "all links are this job's own"),
    ("packets and congestion control", "messages are fluid flows that share links max-min fairly"),
    ("ranks that come late", "all begin together"),
)
_DISPLAY: Final = (
    ("rendering, and the network up to the display", "the next frame is always ready at the render nodes"),
    ("what grows with the number of render nodes inside MPI", "one receive thread keeps pace with the adapter"),
)


def network_dict(machine: str, card: MachineCard, answers: Sequence[Answer], *, given: str | None) -> dict[str, Any]:
    """Return answers about one pattern, ready for JSON.

    Parameters
    ----------
    machine : str
        As it was asked for.
    card : MachineCard
    answers : sequence of Answer
    given : str or None
        The algorithm, if it was asked for.

    """
    return {
        "machine": machine,
        "pattern": answers[0].pattern,
        "mpi_flavour": card.mpi.flavour if card.mpi else None,
        "rows": [_row(answer, card, given) for answer in answers],
        "uncalibrated": _uncalibrated(answers),
        "scope": {
            "modelled": _modelled(card, answers),
            "left_out": [{"what": what, "why": why} for what, why in _IDLE],
        },
    }


def _row(answer: Answer, card: MachineCard, given: str | None) -> dict[str, Any]:
    busiest = answer.busiest_link
    use = answer.links[busiest] if busiest else None
    return {
        "ranks": answer.ranks,
        **({"from": answer.ends[0], "to": answer.ends[1]} if answer.ends else {}),
        "bytes": answer.nbytes,
        "algorithm": answer.algorithm,
        "algorithm_chosen_by": _chooser(answer, card, given),
        "time_s": answer.time_s,
        "closed_form_s": answer.closed_form_s,
        "contention_ratio": answer.contention_ratio,
        "algorithm_bandwidth_bytes_per_s": answer.algorithm_bandwidth_bytes_per_s,
        "messages": answer.messages,
        "sent_bytes": answer.sent_bytes,
        "busiest_link": busiest,
        "busiest_link_mean_utilization": use.mean_utilization if use else None,
        "busiest_link_peak_utilization": use.peak_utilization if use else None,
        "staged": answer.staged,
        "alpha_s": answer.alpha_s,
        "beta_s_per_byte": answer.beta_s_per_byte,
        "gamma_s_per_byte": answer.gamma_s_per_byte,
    }


def _chooser(answer: Answer, card: MachineCard, given: str | None) -> str | None:
    if answer.algorithm is None or card.mpi is None:
        return None
    return card.mpi.flavour if given is None else "--algorithm"


def describe_network(
    machine: str, card: MachineCard, answers: Sequence[Answer], *, given: str | None
) -> RenderableType:
    """Return answers about one pattern as a table; the arguments are those of `network_dict`."""
    pattern, flavour = answers[0].pattern, card.mpi.flavour if card.mpi else None
    table = _table()
    several = len({answer.ranks for answer in answers}) > 1
    columns: list[tuple[str, Callable[[Answer], str]]] = [
        ("bytes", lambda a: _size(a.nbytes)),
        ("ranks", lambda a: f"{a.ranks}"),
        ("time", lambda a: format_seconds(a.time_s)),
        ("closed\nform", lambda a: format_seconds(a.closed_form_s)),
        ("ratio", lambda a: "" if a.contention_ratio is None else f"{a.contention_ratio:.2f}"),
        ("messages,\nbytes", lambda a: f"{a.messages:,}\n{_size(a.sent_bytes)}"),
        ("bandwidth", lambda a: _rate(a.algorithm_bandwidth_bytes_per_s)),
    ]
    columns = [c for c in columns if not (c[0] == "ranks" and not several)]
    if pattern == "barrier":
        columns = [c for c in columns if c[0] not in {"bytes", "bandwidth"}]
    for heading, _ in columns:
        table.add_column(heading, justify="right", no_wrap=True)
    if pattern != "transfer":
        table.add_column("algorithm", max_width=13)  # in two lines, as many as the last column has
    table.add_column("busiest link", overflow="fold")
    for answer in answers:
        cells = [cell(answer) for _, cell in columns]
        if answer.algorithm:
            cells.append(answer.algorithm.replace("_", " "))
        table.add_row(*cells, _busiest(answer))
    ranks = "" if several else f", {answers[0].ranks} ranks"
    if answers[0].ends:
        ranks = ", {} to {}".format(*answers[0].ends)
    title = f"{pattern} on {machine}{ranks}, {f'MPI {flavour}' if flavour else 'a copy without MPI'}"
    return Group(Text(title, style="bold underline"), table, Text(), *_notes(card, answers, given))


def _notes(card: MachineCard, answers: Sequence[Answer], given: str | None) -> Iterable[Text]:
    first = answers[0]
    if first.pattern not in {"barrier", "transfer"}:
        part = "has for each other" if first.pattern.startswith("alltoall") else "contributes"
        meaning = f"what each rank {part}; bandwidth: that of all ranks over the time"
        if first.pattern not in GATHERING:
            meaning = "the whole vector; bandwidth: that over the time"
        yield Text(f"bytes: {meaning}, as in nccl-tests", style="dim")
    costs = dict.fromkeys((a.alpha_s, a.beta_s_per_byte) for a in answers)
    slowest = ""
    if len(costs) == 1:
        slowest = f" ({format_seconds(first.alpha_s)}, {_rate(1.0 / first.beta_s_per_byte)})"
    if first.pattern == "transfer":
        yield Text(f"closed form: alpha and bytes times beta, without contention{slowest}", style="dim")
    else:
        yield Text(
            f"closed form: alpha-beta-gamma, with the longest latency and lowest bandwidth used{slowest}", style="dim"
        )
        yield Text(f"ratio: time over closed form; below 1 where {_ahead(answers)}", style="dim")
    if card.mpi and first.algorithm:
        how = f"chosen by the switch points of {card.mpi.flavour}" if given is None else "as asked for"
        yield Text(f"algorithm: {how}", style="dim")
    if any(answer.staged for answer in answers):
        yield Text("staged through host memory: two host links more", style="dim")
    yield calibration(_uncalibrated(answers))


def _ahead(answers: Sequence[Answer]) -> str:
    """Return why a collective may take less than its closed form."""
    serial = [answer.algorithm in DIRECT for answer in answers]
    reasons = []
    if not all(serial):
        reasons.append("most pairs are faster than that or eager senders run ahead")
    if any(serial):
        reasons.append("the closed form sends one message after the other")
    return ", or ".join(reasons)


def calibration(uncalibrated: Sequence[dict[str, str]]) -> Text:
    """Return how many assumed and fitted values a result hangs on."""
    if not uncalibrated:
        return Text("every input is stated, published, measured or derived")
    assumed = sum(1 for value in uncalibrated if value["status"] == "assumed")
    fitted = len(uncalibrated) - assumed
    parts = [f"{count} {word}" for count, word in ((assumed, "assumed"), (fitted, "fitted")) if count]
    plural = "s" if len(uncalibrated) > 1 else ""
    return Text(f"not calibrated: hangs on {' and '.join(parts)} value{plural} (listed by --json)", style="yellow")


def _uncalibrated(answers: Sequence[Answer]) -> list[dict[str, str]]:
    return owned_up(list(dict(pair for answer in answers for pair in answer.quantities).items()))


def _modelled(card: MachineCard, answers: Sequence[Answer]) -> list[str]:
    paths = dict.fromkeys(path for answer in answers for path, _ in answer.quantities)
    links = [name for name in ("nvlink", "pcie") if f"machine.{name}.bandwidth" in paths]
    if card.network and "machine.network.bandwidth" in paths:
        links.append(card.network.technology)
    modelled = [f"{' and '.join(links)}, shared max-min fairly"]
    if any(path.startswith("machine.mpi.") for path in paths) and card.mpi:
        modelled.append(f"MPI {card.mpi.flavour}: overhead, eager and rendezvous messages, factors by message size")
    if any(answer.algorithm for answer in answers):
        modelled.append("the algorithm's messages, one by one, each when its rank is ready")
    if any(answer.staged for answer in answers):
        modelled.append("staging through host memory: two host links more")
    return modelled


def display_dict(machine: str, card: MachineCard, rows: Sequence[tuple[int, DisplayReport]]) -> dict[str, Any]:
    """Return what a display takes in for each number of copy threads, ready for JSON."""
    assert card.display is not None  # noqa: S101 - it was asked
    return {
        "machine": machine,
        "pattern": "display",
        "rows": [
            {
                "copy_threads": threads,
                "frames_per_s": report.frames_per_s,
                "frame_time_s": report.frame_time_s,
                "payload_bound_frames_per_s": report.payload_bound_frames_per_s,
                "wire_bound_frames_per_s": report.bound_frames_per_s,
                "wire_bytes_per_frame": report.wire_bytes_per_frame,
                "payload_bytes_per_frame": report.payload_bytes_per_frame,
                "messages_per_frame": report.messages_per_frame,
                "adapter_utilization": report.adapter_utilization,
                "copy_utilization": report.copy_utilization,
                "bottleneck": report.bottleneck,
            }
            for threads, report in rows
        ],
        "uncalibrated": owned_up(list(card.display.quantities("machine.display."))),
        "scope": {
            "modelled": ["the display's adapter, in whole packets", "its copy threads", "frames in flight"],
            "left_out": [{"what": what, "why": why} for what, why in _DISPLAY],
        },
    }


def describe_display(
    machine: str, card: MachineCard, resolution: tuple[int, int], rows: Sequence[tuple[int, DisplayReport]]
) -> RenderableType:
    """Return what a display takes in for each number of copy threads as a table."""
    assert card.display is not None  # noqa: S101 - it was asked
    table, first = _table(), rows[0][1]
    for heading in ("copy\nthreads", "frames/s", "frame\ntime", "adapter\nbusy", "threads\nbusy"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("bottleneck")
    for threads, report in rows:
        table.add_row(
            f"{threads}", _figure(report.frames_per_s), format_seconds(report.frame_time_s),
            _share(report.adapter_utilization), _share(report.copy_utilization), report.bottleneck,
        )  # fmt: skip
    width, height = resolution
    share = "" if first.pixels_per_node == width * height else ", a display node's share"
    return Group(
        Text(f"{width}x{height} pixels into the display of {machine}", style="bold underline"),
        table,
        Text(),
        Text(
            f"a frame{share}: {first.messages_per_frame:,} messages, {format_bytes(first.payload_bytes_per_frame)} of "
            f"payload in {format_bytes(first.wire_bytes_per_frame)} on the wire",
            style="dim",
        ),
        Text(
            f"the adapter could take {_figure(first.payload_bound_frames_per_s)} frames/s of payload, and takes "
            f"{_figure(first.bound_frames_per_s)} of whole packets",
            style="dim",
        ),
        calibration(owned_up(list(card.display.quantities("machine.display.")))),
    )


def _busiest(answer: Answer) -> str:
    if answer.busiest_link is None:
        return "none: no bytes"
    use = answer.links[answer.busiest_link]
    return f"{answer.busiest_link}\n{_share(use.mean_utilization)}, peak {_share(use.peak_utilization)}"


def _table() -> Table:
    return Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim underline")


def _size(nbytes: float) -> str:
    """Return a size in the unit in which it is a round number, if that is a binary one."""
    for prefix, factor in (("Gi", 1024.0**3), ("Mi", 1024.0**2), ("Ki", 1024.0)):
        if nbytes >= factor and nbytes % factor == 0.0 and nbytes < 1000.0 * factor:
            return f"{nbytes / factor:.0f} {prefix}B"
    return format_bytes(nbytes)


def _rate(bytes_per_s: float | None) -> str:
    return "" if bytes_per_s is None else f"{format_bytes(bytes_per_s)}/s"


def _share(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def _figure(number: float) -> str:
    return f"{number:.3g}" if number < 999.5 else f"{number:,.0f}"
