"""Comparison with runs of the SpRay program: what it counted, and what the schedulers here count on the scene.

Park, Fussell and Navratil's program is public (TACC/SpRay). A table of its runs has a row a run: which program, how
many ranks, which shading, cache and partition, and its counters. Its random numbers are drawn here too
(`integrators.SprayPathTracing.program_image`), so counts agree up to rays that graze. A few of those can turn the order
of two domains with nearly as many rays, and with it every count that follows: where directions are random, that makes
loads differ by a percent or two.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from simrender.catalog import find_policy
from simrender.errors import UsageError
from simrender.policies.std_sort import std_sort
from simrender.rays.workload import Workload, load_workload
from simrender.simulation import simulate

MACHINE = "stampede2-skx"
"""Counts do not depend on the machine."""

PROGRAMS = {
    "baseline_ooc": ("load_any_once", "out_of_core"),
    "baseline_insitu": ("load_any_once", "in_situ"),
    "spray_ooc": ("speculation", "out_of_core"),
    "spray_insitu_singlethread": ("speculation", "in_situ"),
}

QUANTITIES = {
    "out_of_core": {
        "domain_loads": "loads",
        "domain_visits": "visits",
        "radiance_tests": "radiance_tests",
        "shadow_tests": "shadow_tests",
    },
    "in_situ": {
        "sched_steps": "steps",
        "messages": "messages",
        "rays_sent": "sent_rays",
        "radiance_tests": "radiance_tests",
        "shadow_tests": "shadow_tests",
    },
}
"""Columns of the table, and the counters here that mean the same."""

COLUMNS = (
    "run", "program", "variant", "scene", "ranks", "history", "partition", "cache", "shading", "resolution", "spp",
    "shadow_samples", "bounces",
)  # fmt: skip


@dataclass(frozen=True)
class Compared:
    """One quantity of one run.

    Attributes
    ----------
    run : str
    quantity : str
    ours, program : float
    relative_error : float
        Of ours.
    tolerance : str
        What was allowed, in words.
    within_tolerance : bool

    """

    run: str
    quantity: str
    ours: float
    program: float
    relative_error: float
    tolerance: str
    within_tolerance: bool


def read_runs(path: Path) -> list[dict[str, str]]:
    """Read a table of runs.

    Raises
    ------
    UsageError
        If it cannot be read, or lacks a column.

    """
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot read this table: {getattr(error, 'strerror', None) or error}") from None
    if not rows:
        raise UsageError(f"{path}: this table has no rows")
    missing = [name for name in COLUMNS if name not in rows[0]]
    if missing:
        raise UsageError(f"{path}: this table of runs has no column {', '.join(missing)}")
    return rows


def compare(
    runs: Path, scene: Path, *, cache: Path | None = None, done: Callable[[int, int], None] | None = None
) -> Iterator[Compared]:
    """Simulate each run of a table, and compare.

    Parameters
    ----------
    runs : Path
        A table of runs.
    scene : Path
        The scene file of SpRay that they rendered.
    cache : Path, optional
        Folder of the trace cache.
    done : callable, optional
        Told how many of the runs are done.

    """
    rows = read_runs(runs)
    workloads: dict[tuple[str, ...], Workload] = {}
    for number, row in enumerate(rows):
        where = f"{runs}, run {row['run']}"
        if row["program"] not in PROGRAMS:
            raise UsageError(f"{where}: unknown program {row['program']!r} (known: {', '.join(PROGRAMS)})")
        if row["shading"] == "AO" and row["program"].startswith("baseline"):
            row["bounces"] = "1"  # whatever it was told: its ambient occlusion goes no further
        key = tuple(row[name] for name in ("scene", "shading", "resolution", "spp", "shadow_samples", "bounces"))
        if key not in workloads:
            workloads[key] = _workload(row, scene, cache, where)
        yield from _compare(row, workloads[key], where)
        if done:
            done(number + 1, len(rows))


def _workload(row: dict[str, str], scene: Path, cache: Path | None, where: str) -> Workload:
    """Return the scene as a run rendered it."""
    bounces, samples, random = int(row["bounces"]), int(row["shadow_samples"]), "random_numbers: spray_program"
    if row["shading"] == "AO":
        integrator = f"{{name: ambient_occlusion, samples: {samples}, bounces: {bounces}, {random}}}"
    elif row["shading"] == "PT":
        integrator = f"{{name: spray_path_tracing, shadow_samples: {samples}, bounces: {bounces}, {random}}}"
    else:
        raise UsageError(f"{where}: unknown shading {row['shading']!r} (known: AO, PT)")
    sampling = "corner" if row["spp"] == "1" else "jittered"
    size, spp = row["resolution"], row["spp"]
    workload = load_workload(
        str(scene),
        [
            f"published={{resolution: {size}, samples: {spp}}}", f"traced={{resolution: {size}}}",
            f"integrator={integrator}", f"camera.sampling={sampling}",
        ],
        cache,
    )  # fmt: skip
    if "diffuse" in row["scene"]:
        workload = replace(workload, given=replace(workload.scene, points=(), hemispheres=((1.0, 1.0, 1.0),)))
    return workload


def _compare(row: dict[str, str], workload: Workload, where: str) -> Iterator[Compared]:
    name, data = PROGRAMS[row["program"]]
    ranks, domains = int(row["ranks"]), workload.domains().count
    policy: dict[str, Any] = {"data": data, "like_program": True}
    if data == "in_situ":
        policy["owners"] = _owners(row, workload, ranks)
    elif int(row["cache"]) > 0:
        policy["cache"] = min(int(row["cache"]), domains)
    if name == "speculation" and row["history"]:
        policy["history_depth"] = int(float(row["history"]))
    try:
        scheduler = find_policy(name)(**policy)
        result = simulate(MACHINE, workload, scheduler, nodes=ranks, islands=1 if data == "in_situ" else "auto")
    except UsageError as error:
        raise UsageError(f"{where}: {error}") from None
    exact = row["shading"] == "PT" and row["bounces"] == "1" and row["spp"] == "1" and "diffuse" not in row["scene"]
    for column, counter in QUANTITIES[data].items():
        if row.get(column, "") == "" or (column == "domain_loads" and int(row["cache"]) < 0):
            continue  # an infinite cache was filled before the frame
        if name == "speculation" and counter == "steps":
            counter = "rounds"  # noqa: PLW2901 - the program counts its rounds as steps
        ours, theirs = float(result.counts[counter]), float(row[column])
        allowed, words = _tolerance(column, theirs, exact=exact)
        off = (ours - theirs) / theirs if theirs else (0.0 if ours == theirs else math.inf)
        yield Compared(row["run"], column, ours, theirs, off, words, abs(ours - theirs) <= allowed)


def _tolerance(quantity: str, value: float, *, exact: bool) -> tuple[float, str]:
    """Return how far off a count may be."""
    if not exact:
        share = 0.01 if quantity.endswith("_tests") else 0.03
        return share * value, f"{share:.0%}"
    if quantity in {"domain_loads", "domain_visits"}:
        return 0.0, "exact"
    if quantity == "radiance_tests":
        return 5.0, "5 rays"
    share = 0.002 if quantity == "shadow_tests" else 0.001
    return max(share * value, 0.5), f"{share:.1%}"


def _owners(row: dict[str, str], workload: Workload, ranks: int) -> tuple[int, ...] | None:
    """Return the partition of a run: by Morton codes, or by what the program made of equal codes."""
    if not row["partition"].startswith("as pinned"):
        return None
    domains = workload.domains().count
    order = std_sort(domains, lambda _a, _b: False)
    owner = [0] * domains
    for place, domain in enumerate(order):
        owner[domain] = place // max(1, domains // ranks) % ranks
    return tuple(owner)
