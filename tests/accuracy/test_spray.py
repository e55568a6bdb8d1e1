"""Counts of the real SpRay program, run for run, and the wording of what is wrong with a table of runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from simrender.accuracy.spray import compare
from simrender.accuracy.spray_paper import history, out_of_core, run, speedups, workload
from simrender.policies.std_sort import descending, std_sort
from simrender.report.spray_figures import plot_bars, plot_history

DATA = Path(__file__).parents[1] / "data"
RUNS, SCENE = DATA / "spray_runs.csv", DATA / "wavelets64.spray"


@pytest.fixture(scope="module")
def rows():
    return list(compare(RUNS, SCENE))


def test_every_count_of_every_run_is_within_its_tolerance(rows):
    assert len(rows) == 68
    assert [r for r in rows if not r.within_tolerance] == []


@pytest.mark.parametrize(
    ("number", "quantity", "count"),
    [
        ("0", "domain_loads", 37), ("3", "domain_loads", 78), ("6", "domain_loads", 85), ("6", "domain_visits", 85),
        ("8", "domain_loads", 37), ("11", "domain_loads", 58), ("124", "messages", 37), ("128", "sched_steps", 35),
    ],
)  # fmt: skip
def test_counts_that_are_exact(rows, number, quantity, count):
    (found,) = [r for r in rows if (r.run, r.quantity) == (number, quantity)]
    assert found.ours == found.program == count


def test_the_command_prints_what_the_library_finds(run_cli, tmp_path, rows):
    few = tmp_path / "runs.csv"
    few.write_text("".join(RUNS.read_text().splitlines(keepends=True)[:3]))
    ran = run_cli("compare", "spray", few, SCENE, "--json", "-")
    found = json.loads(ran.out)
    assert ran.code == 0
    assert set(found[0]) >= {"run", "quantity", "ours", "program", "relative_error", "within_tolerance"}
    assert [(r["run"], r["quantity"], r["ours"]) for r in found] == [(r.run, r.quantity, r.ours) for r in rows[:8]]
    ran = run_cli("compare", "spray", few, SCENE)
    assert "8 of 8 within their tolerances" in ran.out


def test_what_is_wrong_with_a_table_is_told(run_cli, tmp_path):
    bad = tmp_path / "runs.csv"
    assert run_cli("compare", "spray", bad, SCENE).err == (
        f"simrender: {bad}: cannot read this table: No such file or directory\n"
    )
    bad.write_text("run,program\n0,baseline_ooc\n")
    assert run_cli("compare", "spray", bad, SCENE).err.startswith(
        f"simrender: {bad}: this table of runs has no column variant, scene, ranks"
    )
    text = RUNS.read_text().splitlines()
    bad.write_text("\n".join([text[0], text[1].replace("baseline_ooc", "spray_gpu", 1)]))
    assert run_cli("compare", "spray", bad, SCENE).err.startswith(
        f"simrender: {bad}, run 0: unknown program 'spray_gpu' (known: baseline_ooc, "
    )


def test_equal_elements_come_as_the_cpp_library_leaves_them():
    # The order in which SpRay's program deals 64 domains with equal Morton codes.
    expected = [48, *range(33, 48), 32, *range(49, 64), 16, *range(1, 16), 0, *range(17, 32)]
    assert std_sort(64, lambda _a, _b: False) == expected
    assert std_sort(16, lambda _a, _b: False) == list(range(16))
    assert descending([3, 1, 2, 5]) == [3, 0, 2, 1]
    for n in (1, 2, 17, 100, 1427):
        keys = [(k * 7919) % 101 for k in range(n)]
        order = descending(keys)
        assert sorted(order) == list(range(n))
        assert [keys[k] for k in order] == sorted(keys, reverse=True)


SIZE = {"resolution": "24x24", "samples": 1}


def test_figure_6_has_a_bar_for_every_cache_and_scheduler():
    bars = out_of_core(("enzo",), ("AO",), (1,), ("25%", "100%"), **SIZE)
    assert len(bars) == 4
    for bar in bars:
        parts = bar.load_s + bar.render_s + bar.copy_s + bar.sync_s + bar.wait_s
        assert parts == pytest.approx(bar.frame_time_s)
    small, large = speedups(bars)
    assert small["load"] > large["load"] == pytest.approx(1.0)  # speculation loads less where the cache is small
    assert len(plot_bars(bars, "x").axes) == 1


def test_figure_8_loads_no_more_with_a_deeper_history():
    lines = history(("enzo",), bounces=(3,), depths=(1, 3), **SIZE)
    assert lines[0].loads >= lines[1].loads
    assert len(plot_history(lines, "x").axes) == 1


def test_a_deeper_history_than_a_path_changes_nothing():
    scene = workload("enzo", "AO", **SIZE)
    a, b = (run(scene, "AO", "speculation", cache="50%", history_depth=h) for h in (1, 4))
    assert (a.loads, a.tests, a.load_s) == (b.loads, b.tests, b.load_s)
