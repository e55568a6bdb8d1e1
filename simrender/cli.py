"""The command line: thin, and the one place that looks at the clock on the wall.

Results go to stdout; progress, notes and timings to stderr. Exit status: 0 done, 2 a mistake in the input, 3 the model
does not fit.
"""

from __future__ import annotations

import dataclasses
import re
import sys
import time  # noqa: TID251 - wall time is measured here, for a person, and never simulated
import warnings
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter, Token, UnusedCliTokensError

from simrender.errors import SimrenderError, UnitError, UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from simrender.camera_path import PathResult
    from simrender.rays.crossings import Crossings
    from simrender.rays.estimate import Estimate
    from simrender.rays.trace import Trace
    from simrender.rays.workload import Workload
    from simrender.rays.workload_card import DomainsCard
    from simrender.result import Result

app = App(
    name="simrender",
    help="How fast would a huge scene render on that machine, under which scheduler, and what holds it back?",
    version=lambda: metadata.version("simrender-cluster"),
    version_flags=["--version"],
)


def _whole(_type: Any, tokens: Sequence[Token]) -> int:
    """Read a whole number; cyclopts itself would take 2.5 for 2."""
    keyword, text = tokens[0].keyword, tokens[0].value
    if not re.fullmatch(r"[-+]?[0-9]{1,20}", text):
        raise UsageError(f"{keyword} {text}: expected a whole number{' of up to 20 digits' if text.isdigit() else ''}")
    return int(text)


MOST_REPLICAS = 1000
"""Traces from which `simrender trace` will estimate an error."""

_MOST_BYTES = 1e12
"""Of a message or vector that `simrender network` is asked for; what takes months has no place in 64-bit ticks."""

Set = Annotated[tuple[str, ...], Parameter(name="--set", negative="", show_default=False)]
Flag = Annotated[Path | None, Parameter(negative="")]
Whole = Annotated[int, Parameter(converter=_whole)]


@app.command(name="list")
def list_(kind: Literal["machines", "workloads", "policies"] | None = None, /) -> None:
    """List what is installed.

    Parameters
    ----------
    kind
        Only machines, workloads or policies.

    """
    from rich.table import Table
    from rich.text import Text

    from simrender import catalog
    from simrender.report.cards import titles

    def rows(name: str, card: catalog.CardFile | None) -> list[tuple[str, str]]:
        try:
            if card is not None:
                return titles(card)
            return [(name, (catalog.find_policy(name).__doc__ or "").partition("\n")[0])]
        except SimrenderError as error:  # one broken card or plug-in hides no other
            warnings.warn(str(error), stacklevel=2)
            return [(name, "broken")]

    for which in ("machines", "workloads", "policies") if kind is None else (kind,):
        table = Table.grid(padding=(0, 2))
        table.add_column(no_wrap=True)
        found: dict[str, catalog.CardFile | None] = (
            dict.fromkeys(catalog.policies()) if which == "policies"
            else {**catalog.cards("machine" if which == "machines" else "workload")}
        )  # fmt: skip
        for name, card in found.items():
            for row, (shown, title) in enumerate(rows(name, card)):
                table.add_row(Text(shown), Text(title), style="dim" if row else "")  # variants follow their card
        console = _console()
        console.print(f"[bold]{which}[/bold]")
        console.print(table)


@app.command
def show(name: str, /, *, plot: Flag = None) -> None:
    """Show a machine's or workload's card with the source of every value, or a policy with its parameters.

    Parameters
    ----------
    name
        Of a machine, a workload or a policy, or the path of a card; NAME:VARIANT shows a variant of a card.
    plot
        Draw what connects a machine's devices (.png, .svg or .pdf).

    """
    from simrender import catalog
    from simrender.errors import UnknownNameError
    from simrender.report.cards import describe_card

    if plot:
        _plot_machine(name, plot)
        return
    policies = catalog.policies()
    if name in policies:
        _show_policy(name)
        return
    try:
        card = catalog.find_card(None, name)
    except UnknownNameError:
        known = [*catalog.cards("machine"), *catalog.cards("workload"), *policies]
        raise UnknownNameError("machine, workload or policy", name, known) from None
    console = _console()
    console.print(describe_card(card, console.width))


@app.command
def trace(
    workload: str,
    /,
    *,
    resolution: str | None = None,
    frame: str | None = None,
    domains: str | None = None,
    partition: Literal["given", "kd_bricks", "sah", "grid", "balanced", "objects"] | None = None,
    replicas: Whole | None = None,
    set_: Set = (),
    seed: Whole = 1,
    image: Flag = None,
    show: Literal["domains", "work", "error"] | None = None,
    ranks: Whole | None = None,
    json: Annotated[str | None, Parameter(negative="")] = None,
    cache: Flag = None,
) -> None:
    """Trace a workload's rays for real, keep them in the cache, and compare with raw embreex on the same rays.

    Parameters
    ----------
    workload
        Name or path of a card, or path of a file that holds a mesh, a SpRay scene or a volume.
    resolution
        Trace so many pixels, WIDTHxHEIGHT; by default the card's traced.resolution.
    frame
        Of an animation along the camera's path, such as 0/8 to 7/8.
    domains
        How many domains, or the shape of a grid, such as 12x10x6; by default as the card says, else 8.
    partition
        How the scene is cut into domains; see `simrender show` of a workload for its own.
    replicas
        Estimate the error of tracing a part of the rays from so many independent traces.
    set_
        Change a value of the card: PATH=VALUE, where PATH starts with workload.
    seed
        Of all random numbers.
    image
        Write the picture (.png).
    show
        Write another picture: false colour by domain, the work of each pixel, or the error of each pixel.
    ranks
        With --show domains: paint by the ranks that would own the domains, blocks in Morton order.
    json
        Write the answer as JSON to a file, or to stdout (-).
    cache
        Folder of the trace cache.

    """
    from simrender.cards import split_assignments
    from simrender.catalog import CARD_ENDINGS
    from simrender.rays.workload import load_workload
    from simrender.report import tracing as report
    from simrender.report.files import check_target, write_image, write_json

    if image:
        check_target("--image", image, (".png",))
    if json is not None and json != "-":
        check_target("--json", Path(json), (".json",))
    if show and not image:
        raise UsageError(f"--show {show} says what --image shows; give --image FILE.png too")
    if ranks is not None and ranks < 1:
        raise UsageError(f"--ranks {ranks}: expected a number of ranks from 1 on")
    if ranks is not None and show != "domains":
        raise UsageError(f"--ranks {ranks} goes with --show domains")
    if replicas is not None and not 2 <= replicas <= MOST_REPLICAS:
        raise UsageError(f"--replicas {replicas}: expected 2 to {MOST_REPLICAS}")
    overrides = []
    if resolution is not None:
        width, height = _resolution(resolution)
        overrides.append(f"traced.resolution={width}x{height}")
        if Path(workload).suffix.lower() not in CARD_ENDINGS and Path(workload).is_file():
            overrides.append(f"published.resolution={width}x{height}")  # a bare file publishes nothing
    overrides += split_assignments(set_, ("workload",))["workload"]
    begin = time.perf_counter()
    loaded = load_workload(workload, overrides, cache)
    if frame is not None:
        match = re.fullmatch("([0-9]{1,9})/([1-9][0-9]{0,8})", frame)
        if match is None:
            raise UsageError(f"--frame {frame}: expected NUMBER/COUNT such as 0/8, the first of eight")
        loaded = loaded.frame(int(match[1]), int(match[2]))
    cut = _domains_card(loaded.card.domains, partition, domains)
    pieces, rays = loaded.domains(cut), loaded.trace(seed)
    with _Progress() as progress:
        rays.progress = progress
        rays.complete()
    crossings = loaded.domain_crossings(seed, pieces)
    crossings.table(0)
    crossings.save()
    estimates, picture = _replicate(loaded, crossings, seed, replicas or (4 if show == "error" else 0))
    if json == "-":
        _print_json(report.trace_dict(loaded, rays, crossings) | _estimates_dict(estimates))
    else:
        console = _console()
        console.print(report.describe_rays(loaded.name, rays))
        console.print(report.describe_domains(rays, crossings))
        if estimates:
            console.print(report.describe_estimates(estimates))
        console.print(report.describe_speed(rays, progress.seconds, time.perf_counter))
        if json:
            write_json(Path(json), report.trace_dict(loaded, rays, crossings) | _estimates_dict(estimates))
            _note(f"wrote {json}")
    if image:
        if show is None:
            write_image(image, rays.image())
        else:
            _write_picture(image, show, loaded.name, rays, crossings, ranks, picture)
        _note(f"wrote {image}" + (f" ({rays.size[0]}x{rays.size[1]})" if show in {None, "domains"} else ""))
    _note(f"done in {time.perf_counter() - begin:.2f} s")


def _domains_card(card: DomainsCard | None, partition: str | None, domains: str | None) -> DomainsCard | None:
    """Return how the scene is to be cut, from the options; None leaves it to the card."""
    from pydantic import ValidationError

    from simrender.rays.workload_card import DomainsCard

    if partition is None and domains is None:
        return None
    fields: dict[str, Any] = {}
    if domains is not None:
        parts = domains.split("x")
        if len(parts) not in {1, 3} or not all(re.fullmatch("[1-9][0-9]{0,4}", part) for part in parts):
            raise UsageError(f"--domains {domains}: expected how many, or the shape of a grid such as 12x10x6")
        fields = {"count": int(parts[0])} if len(parts) == 1 else {"shape": tuple(int(part) for part in parts)}
    if partition is not None:
        fields["method"] = partition
    elif "shape" in fields:
        fields["method"] = "grid"
    elif card is not None and card.method in {"kd_bricks", "sah", "objects"}:
        fields["method"] = card.method
    else:
        fields["method"] = "auto"
    try:
        return DomainsCard(**fields)
    except ValidationError as error:
        words = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        given = " ".join(
            f"--{name} {value}" for name, value in (("partition", partition), ("domains", domains)) if value
        )
        raise UsageError(f"{given}: {words} (count and shape are given by --domains)") from None


def _replicate(
    workload: Workload, crossings: Crossings, seed: int, replicas: int
) -> tuple[dict[str, Estimate], Estimate | None]:
    """Trace independent replicas, and estimate the error of what is counted and of the image."""
    if not replicas:
        return {}, None
    from simrender.rays.estimate import estimate, seeds
    from simrender.report.tracing import replica_counts

    counted, images = [], []
    for s in seeds(seed, replicas):
        rays = workload.trace(s)
        with _Progress() as progress:
            rays.progress = progress
            rays.complete()
        counted.append(replica_counts(workload, rays, workload.domain_crossings(s, crossings.domains)))
        images.append(rays.image())
        if s != seed:
            workload.forget(s)
    names = list(counted[0])
    if replicas > 1 and all((other == images[0]).all() for other in images[1:]):
        warnings.warn("nothing in this image is random, so replicas tell nothing of its error", stacklevel=2)
        return {}, estimate(images)
    return {name: estimate([counts[name] for counts in counted]) for name in names}, estimate(images)


def _estimates_dict(estimates: dict[str, Estimate]) -> dict[str, Any]:
    return {"estimates": {name: found.to_dict() for name, found in estimates.items()}} if estimates else {}


def _write_picture(
    path: Path, show: str, name: str, rays: Trace, crossings: Crossings, ranks: int | None, picture: Estimate | None
) -> None:
    from simrender.report import pictures
    from simrender.report.files import write_figure, write_image

    if show == "domains":
        group = None
        if ranks is not None:
            from simrender.rays.domains import morton_ranks

            group = morton_ranks(crossings.domains.low, crossings.domains.high, ranks)
        write_image(path, pictures.domain_picture(rays, crossings, group))
    elif show == "work":
        write_figure(path, pictures.plot_work(name, rays, crossings))
    elif picture is not None:
        write_figure(path, pictures.plot_error(name, picture))


def _print_json(value: Any) -> None:
    import json as encoder

    print(encoder.dumps(value, indent=1))  # noqa: T201 - the answer itself


@app.command
def run(
    machine: str,
    workload: str,
    /,
    *,
    policy: str | None = None,
    islands: str = "auto",
    nodes: Whole | None = None,
    gpus: Whole | None = None,
    frames: Whole | None = None,
    tile: Literal["auto"] | None = None,
    set_: Set = (),
    seed: Whole = 1,
    json: Annotated[str | None, Parameter(negative="")] = None,
    image: Flag = None,
    timeline: Flag = None,
    explain: Literal["schedule"] | None = None,
    cache: Flag = None,
) -> int:
    """Render one frame in simulated time: how fast, with what error, and where the time goes.

    Parameters
    ----------
    machine
        Name or path of a machine's card.
    workload
        Name or path of a workload's card, or path of a mesh file (.ply, .obj, .glb, .stl).
    policy
        The scheduler; by default the workload's own.
    islands
        How many islands, or auto: as many as the fewest GPUs that hold the model allow.
    nodes
        Use only so many of the machine's nodes.
    gpus
        Use only so many GPUs of those.
    frames
        How many to render along the camera's path under distributed_cache: so many in a row of the path_frames of the
        workload's card, or, if that does not say how many there are, from the path's beginning to its end.
    tile
        auto: where speculation needs more memory than a node has, cut the image into as few tiles as fit.
    set_
        Change a value of a card: PATH=VALUE, where PATH starts with machine. or workload. or policy.
    seed
        Of all random numbers.
    json
        Write the result as JSON to a file, or to stdout (-).
    image
        Write the picture (.png), at traced size.
    timeline
        Write the timeline as a Chrome trace for Perfetto (.json) or as a plot (.png).
    explain
        Print the first steps of a schedule of domains: which rays wait where, and what is processed and loaded.
    cache
        Folder of the trace cache; by default $SIMRENDER_CACHE or ~/.cache/simrender.

    """
    from simrender.cards import split_assignments
    from simrender.report.files import check_target, write_image, write_timeline
    from simrender.simulation import simulate

    if json is not None and json != "-":
        check_target("--json", Path(json), (".json",))
    if image:
        check_target("--image", image, (".png",))
    if timeline:
        check_target("--timeline", timeline, (".json", ".png"))
    targets = [path.resolve() for path in (Path(json or "-"), image, timeline) if path]
    if len(set(targets)) < len(targets):
        raise UsageError("--json, --image and --timeline: two of them name the same file")
    sections = split_assignments(
        (*set_, *([f"policy.tiles={tile}"] if tile else [])), ("machine", "workload", "policy")
    )
    path = _along_path(machine, workload, policy, sections, frames, nodes, seed, cache)
    if path is not None:
        for option, given in (("--timeline", timeline), ("--explain", explain), ("--gpus", gpus)):
            if given is not None:
                raise UsageError(f"{option} does not go with frames along a camera's path")
        return _publish_path(*path, json, image)
    count = _islands(islands)
    begin = time.perf_counter()
    with _Progress() as progress:
        result = simulate(
            machine, workload, policy, islands=count, nodes=nodes, gpus=gpus, seed=seed,
            overrides=sections, cache=cache, progress=progress,
        )  # fmt: skip
    seconds = time.perf_counter() - begin
    _publish(result, json)
    if explain and result.frame_time_s is not None:
        from simrender.report.schedule import explain_schedule

        _console(stderr=json == "-").print(explain_schedule(result))
    if result.image is not None:
        if image:
            write_image(image, result.image)
            _note(f"wrote {image} ({result.image.shape[1]}x{result.image.shape[0]})")
        if timeline:
            write_timeline(timeline, result)
            _note(f"wrote {timeline}")
    elif image or timeline:
        _note("nothing was rendered, so no picture and no timeline were written")
    _note(f"simulated in {seconds:.2f} s")
    return 0 if result.feasible else 3


def _along_path(
    machine: str,
    workload: str,
    policy: str | None,
    sections: Mapping[str, Sequence[str]],
    frames: int | None,
    nodes: int | None,
    seed: int,
    cache: Path | None,
) -> tuple[PathResult, float] | None:
    """Render frames along the camera's path if the policy is the one that does so; None if it is another."""
    from simrender.simulation import PATH_POLICY, make_policy

    if frames is None and policy not in {None, PATH_POLICY}:
        return None
    from simrender.hardware.machine import load_machine
    from simrender.rays.workload import load_workload

    card = load_machine(machine, sections["machine"])
    loaded = load_workload(workload, sections["workload"], cache)
    name, scheduler = make_policy(policy, loaded, sections["policy"])
    if name != PATH_POLICY:
        if frames is not None:
            raise UsageError(f"--frames {frames}: {name} renders single frames; {PATH_POLICY} renders several")
        return None
    from simrender.camera_path import simulate_frames
    from simrender.policies.distributed_cache import DistributedCache

    assert isinstance(scheduler, DistributedCache)  # noqa: S101 - that is its name
    begin = time.perf_counter()
    with _Progress() as progress:
        result = simulate_frames(card, loaded, scheduler, frames or 1, nodes=nodes, seed=seed, progress=progress)
    return dataclasses.replace(result, machine=machine), time.perf_counter() - begin


def _publish_path(result: PathResult, seconds: float, json: str | None, image: Path | None) -> int:
    from simrender.report.files import write_image, write_json
    from simrender.report.path import describe_path

    if json == "-":
        _print_json(result.to_dict())
    else:
        _console().print(describe_path(result))
        if json:
            write_json(Path(json), result.to_dict())
            _note(f"wrote {json}")
    if image and result.images:
        write_image(image, result.images[-1])
        _note(f"wrote {image}, the last frame")
    _note(f"simulated in {seconds:.2f} s")
    return 0 if result.feasible else 3


@app.command
def compare(
    program: Literal["spray"],  # noqa: ARG001 - the only one so far
    runs: Path,
    scene: Path,
    /,
    *,
    json: Annotated[str | None, Parameter(negative="")] = None,
    cache: Flag = None,
) -> None:
    """Compare with what an independent program counted: simulate each of its runs, and tell the difference.

    Parameters
    ----------
    program
        spray, the program of the SpRay paper.
    runs
        A table of its runs (.csv).
    scene
        The scene that it rendered (.spray).
    json
        Write the comparison as JSON to a file, or to stdout (-).
    cache
        Folder of the trace cache.

    """
    from simrender.accuracy.spray import compare as compared
    from simrender.report.comparison import describe_comparison
    from simrender.report.files import check_target, write_json

    if json is not None and json != "-":
        check_target("--json", Path(json), (".json",))
    begin = time.perf_counter()
    rows = list(compared(runs, scene, cache=cache))
    value = [dataclasses.asdict(row) for row in rows]
    if json == "-":
        _print_json(value)
    else:
        _console().print(describe_comparison(rows))
        if json:
            write_json(Path(json), value)
            _note(f"wrote {json}")
    _note(f"compared in {time.perf_counter() - begin:.2f} s")


@app.command
def network(
    machine: str,
    pattern: str,
    /,
    *,
    bytes_: Annotated[str | None, Parameter(name="--bytes")] = None,
    ranks: str | None = None,
    algorithm: str | None = None,
    from_: Annotated[Whole | None, Parameter(name="--from")] = None,
    to: Whole | None = None,
    nodes: Whole | None = None,
    hosts: Annotated[bool | None, Parameter(negative="")] = None,
    resolution: str | None = None,
    copy_threads: str | None = None,
    message_pixels: Whole | None = None,
    display_nodes: Whole | None = None,
    tiles: Annotated[bool | None, Parameter(negative="")] = None,
    frames: Whole | None = None,
    set_: Set = (),
    json: Annotated[str | None, Parameter(negative="")] = None,
) -> None:
    """Ask the network alone: how long a collective, a message, or a frame on its way into the display takes.

    Parameters
    ----------
    machine
        Name or path of a machine's card.
    pattern
        barrier, bcast, reduce, allreduce, allgather, alltoall, gather, reduce-scatter, or with a v (allgatherv, ...);
        transfer, one message between two ranks; display.
    bytes_
        Sizes, such as 1KiB,4MiB: the whole vector, or what each rank contributes; by default 1KiB,64KiB,4MiB.
    ranks
        How many, such as 8,88, one a GPU (or a node without GPUs), node by node from the first on; all by default.
    algorithm
        Of the collective; by default the one that the machine's MPI would take.
    from_
        The rank that sends the transfer; 0 by default.
    to
        The rank that gets it; 1 by default.
    nodes
        Use only so many of the machine's nodes.
    hosts
        One rank a node, with its data in the host's memory.
    resolution
        Of the display's image; 1920x1080 by default.
    copy_threads
        Of a display node, such as 1,2,3,4; by default the card's.
    message_pixels
        Of a full message to the display; by default the card's.
    display_nodes
        That share the image; by default the card's.
    tiles
        Send rectangular tiles with one location each, instead of one for each pixel.
    frames
        To measure on the display; 100 by default.
    set_
        Change a value of the card: PATH=VALUE, where PATH starts with machine.
    json
        Write the answer as JSON to a file, or to stdout (-).

    """
    from simrender.cards import split_assignments
    from simrender.hardware.machine import load_machine
    from simrender.hardware.questions import check_ranks, find_pattern
    from simrender.report import network as report

    pattern = find_pattern(pattern)
    _refuse_others(
        pattern,
        {
            "a collective": {"--ranks": ranks, "--algorithm": algorithm},
            "a collective or transfer": {"--bytes": bytes_, "--nodes": nodes, "--hosts": hosts},
            "transfer": {"--from": from_, "--to": to},
            "display": {
                "--resolution": resolution, "--copy-threads": copy_threads, "--message-pixels": message_pixels,
                "--display-nodes": display_nodes, "--tiles": tiles, "--frames": frames,
            },
        },
    )  # fmt: skip
    if pattern == "barrier" and bytes_ is not None:
        raise UsageError(f"--bytes {bytes_}: a barrier sends none")
    if json is not None and json != "-":
        from simrender.report.files import check_target

        check_target("--json", Path(json), (".json",))
    given = None if algorithm is None else algorithm.replace("-", "_")
    size = _resolution(resolution or "1920x1080")
    sizes = _sizes(bytes_ or "1KiB,64KiB,4MiB") if pattern != "barrier" else [0.0]
    counts: list[int] | list[None] = [None] if ranks is None else _counts("--ranks", ranks)
    threads: list[int] | list[None] = [None] if copy_threads is None else _counts("--copy-threads", copy_threads)
    card = load_machine(machine, split_assignments(set_, ("machine",))["machine"])
    begin = time.perf_counter()
    if pattern == "display":
        from simrender.hardware.questions import ask_display

        reports = [
            ask_display(
                card, size, frames=100 if frames is None else frames, copy_threads=count,
                message_pixels=message_pixels, nodes=display_nodes, tiles=bool(tiles),
            )
            for count in threads
        ]  # fmt: skip
        value: dict[str, Any] = report.display_dict(machine, card, reports)
        shown = report.describe_display(machine, card, size, reports)
    else:
        from simrender.hardware.questions import ask_collective, ask_transfer

        if pattern == "transfer":
            ends = from_ or 0, 1 if to is None else to
            answers = [ask_transfer(card, nbytes, *ends, nodes=nodes, hosts=bool(hosts)) for nbytes in sizes]
        else:
            answers = [
                ask_collective(card, pattern, count, nbytes, algorithm=given, hosts=bool(hosts))
                for count in [check_ranks(card, nodes, count, hosts=bool(hosts)) for count in counts]
                for nbytes in sizes
            ]
        value = report.network_dict(machine, card, answers, given=given)
        shown = report.describe_network(machine, card, answers, given=given)
    seconds = time.perf_counter() - begin
    if json == "-":
        _print_json(value)
    else:
        _console().print(shown)
        if json:
            from simrender.report.files import write_json

            write_json(Path(json), value)
            _note(f"wrote {json}")
    _note(f"simulated in {seconds:.2f} s")


def _publish(result: Result, json: str | None) -> None:
    if json == "-":
        _print_json(result.to_dict())
        return
    from simrender.report.answer import answer

    _console().print(answer(result))
    if json:
        from simrender.report.files import write_json

        write_json(Path(json), result.to_dict())
        _note(f"wrote {json}")


def _refuse_others(pattern: str, options: Mapping[str, Mapping[str, object]]) -> None:
    """Refuse options of other patterns; they are listed by those that they go with."""
    kind = pattern if pattern in {"transfer", "display"} else "a collective"
    for kinds, values in options.items():
        for option, value in values.items():
            if value is not None and kind not in kinds.split(" or "):
                raise UsageError(f"{option} goes with {kinds}, not with {pattern}")


def _sizes(text: str) -> list[float]:
    """Read sizes, separated by commas."""
    from simrender.units import BYTES, parse

    try:
        sizes = [parse(part, BYTES) for part in text.split(",")]
    except UnitError as error:
        raise UsageError(f"--bytes {text}: {error}") from None
    if not all(0.0 <= size <= _MOST_BYTES for size in sizes):
        raise UsageError(f"--bytes {text}: expected 0 B to 1 TB")
    return sizes


def _counts(option: str, text: str) -> list[int]:
    """Read whole numbers, separated by commas."""
    parts = [part.strip() for part in text.split(",")]
    if not all(re.fullmatch("[0-9]{1,18}", part) and int(part) for part in parts):
        raise UsageError(f"{option} {text}: expected whole numbers from 1 on, separated by commas, such as 1,2,4")
    return [int(part) for part in parts]


def _resolution(text: str) -> tuple[int, int]:
    match = re.fullmatch("([1-9][0-9]{0,8})x([1-9][0-9]{0,8})", text)
    if match is None:
        raise UsageError(f"--resolution {text}: expected WIDTHxHEIGHT in pixels such as 2560x1080")
    return int(match[1]), int(match[2])


def _islands(text: str) -> int | Literal["auto"]:
    if text == "auto":
        return "auto"
    try:
        return int(text)
    except ValueError:
        raise UsageError(f"--islands {text}: expected a number of islands, or auto") from None


def _plot_machine(name: str, path: Path) -> None:
    from simrender import catalog
    from simrender.errors import UnknownNameError
    from simrender.hardware.machine import load_machine
    from simrender.report.files import check_target, write_figure

    check_target("--plot", path, (".png", ".svg", ".pdf"))
    try:
        card = load_machine(name)
    except UnknownNameError:
        for kind, known in (("workload", catalog.cards("workload")), ("policy", catalog.policies())):
            if name in known:
                raise UsageError(f"--plot {path}: {name} is a {kind}; only machines are drawn") from None
        raise
    from simrender.report.topology import plot_topology  # matplotlib is slow to import

    write_figure(path, plot_topology(card))
    _note(f"wrote {path}")


def _show_policy(name: str) -> None:
    import dataclasses
    import inspect

    from simrender import catalog
    from simrender.cards import written

    policy = catalog.find_policy(name)
    console = _console()
    console.print(f"[bold]{name}[/bold]\n")
    console.print(inspect.getdoc(policy) or "", markup=False)
    console.print("\nDefaults, changed by --set policy.NAME=VALUE\n--------")
    for parameter in dataclasses.fields(policy):
        console.print(f"{parameter.name} = {written(parameter.default)}", markup=False)


class _Progress:
    """A progress bar on stderr while rays are really traced; silent when stderr is no terminal."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._bar: Any = None
        self._task: Any = None
        self._begin = 0.0

    def __enter__(self) -> _Progress:
        return self

    def __call__(self, generation: int, done: int, rays: int) -> None:
        if self._bar is None:
            from rich.progress import Progress

            console = _console(stderr=True)
            self._bar = Progress(console=console, transient=True)
            if console.is_terminal:
                self._bar.start()
            self._task = self._bar.add_task("")
        if generation == done == 0:  # told once more when hierarchies and kernels are made
            self._begin = time.perf_counter()
        self.seconds = time.perf_counter() - self._begin
        self._bar.update(
            self._task, description=f"tracing bounce {generation}, {rays:,} rays", completed=done, total=rays
        )

    def __exit__(self, *_: object) -> None:
        if self._bar is not None and self._bar.live.is_started:  # else it would leave an empty line
            self._bar.stop()


def _console(*, stderr: bool = False) -> Console:
    from rich.console import Console

    return Console(stderr=stderr, highlight=False, soft_wrap=False)


def _note(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    _note(f"note: {message}")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    warnings.showwarning = _show_warning
    tokens = list(sys.argv[1:] if arguments is None else arguments)
    for i in range(len(tokens) - 1, 0, -1):
        if tokens[i - 1 : i + 1] == ["--json", "-"]:  # cyclopts takes a lone hyphen for an option
            tokens[i - 1 : i + 1] = ["--json=-"]
    try:
        status = app(tokens, exit_on_error=False, print_error=False, result_action="return_value")
    except SimrenderError as error:
        _note(f"simrender: {error}")
        sys.exit(2)
    except UnusedCliTokensError as error:
        extra = (error.unused_tokens or [""])[0]
        _note(f"simrender: unexpected argument {extra!r}{'; each --set takes one PATH=VALUE' if '=' in extra else ''}")
        sys.exit(2)
    except CycloptsError as error:
        _note(f"simrender: {' '.join(str(error).split())}")
        sys.exit(2)
    except KeyboardInterrupt:
        _note("simrender: interrupted; rays traced so far are kept")
        sys.exit(130)
    except BrokenPipeError:
        sys.stderr.close()
        sys.exit(141)
    except MemoryError as error:
        _note(f"simrender: out of memory: {error}; a smaller workload.traced.resolution needs less")
        sys.exit(2)
    except OSError as error:  # a full disk, a name that is too long
        _note(f"simrender: {error.filename or 'the operating system'}: {error.strerror or error}")
        sys.exit(2)
    sys.exit(status if isinstance(status, int) else 0)


if __name__ == "__main__":
    main()
