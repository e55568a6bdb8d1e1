"""Errors from replicas: intervals that hold the truth as often as they say, and nothing made of a single trace."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simrender.errors import UsageError
from simrender.rays.estimate import estimate, over_replicas, seeds
from tests.conftest import Ran
from tests.scenes import garden_workload
from workloads.terrain import generator

TRIALS = 20_000


@pytest.mark.parametrize("confidence", [0.5, 0.9, 0.95, 0.99])
@pytest.mark.parametrize("count", [2, 3, 8, 30])
def test_the_interval_holds_the_truth_as_often_as_it_says(count: int, confidence: float) -> None:
    found = estimate(generator(count, "coverage").normal(7.0, 3.0, (count, TRIALS)), confidence)
    held = (np.abs(found.mean - 7.0) <= found.half_width).mean()
    assert abs(held - confidence) <= 4.0 * np.sqrt(confidence * (1.0 - confidence) / TRIALS)


def test_an_interval_of_the_normal_distribution_would_not() -> None:
    found = estimate(generator(1, "coverage").normal(7.0, 3.0, (2, TRIALS)))
    assert (np.abs(found.mean - 7.0) <= 1.96 * found.standard_error).mean() < 0.75


@pytest.mark.parametrize(
    ("count", "confidence", "quantile"),
    # Student's, from the usual tables
    [(2, 0.95, 12.706), (3, 0.95, 4.303), (4, 0.95, 3.182), (5, 0.95, 2.776), (11, 0.95, 2.228), (121, 0.95, 1.980),
     (2, 0.99, 63.657), (5, 0.99, 4.604), (2, 0.5, 1.0), (3, 0.9, 2.920)],
)  # fmt: skip
def test_the_quantiles_are_those_of_student(count: int, confidence: float, quantile: float) -> None:
    found = estimate(list(range(count)), confidence)
    assert found.half_width / found.standard_error == pytest.approx(quantile, abs=6e-4)
    assert (found.replicas, found.confidence) == (count, confidence)


def test_a_worked_example() -> None:
    found = estimate([1.0, 2.0, 3.0])
    assert found.mean == 2.0
    assert found.standard_error == pytest.approx(3**-0.5, rel=1e-15)  # s = 1, of three
    assert found.half_width == pytest.approx(4.302653 * 3**-0.5, rel=1e-6)


def test_any_shape_is_estimated_entry_by_entry() -> None:
    images = generator(3, "images").random((5, 4, 6, 3), dtype=np.float32)
    found = estimate(list(images))
    assert found.mean.shape == found.standard_error.shape == found.half_width.shape == (4, 6, 3)
    assert found.mean.dtype == np.float64
    one = estimate(images[:, 2, 5, 1])
    assert found.mean[2, 5, 1] == pytest.approx(one.mean, rel=1e-15)
    assert found.half_width[2, 5, 1] == pytest.approx(one.half_width, rel=1e-12)


def test_the_order_does_not_matter_and_units_come_out() -> None:
    values = generator(4, "values").random(9)
    found, turned, scaled = estimate(values), estimate(values[::-1]), estimate(1000.0 * values - 5.0)
    assert turned.mean == pytest.approx(found.mean, rel=1e-14)
    assert turned.half_width == pytest.approx(found.half_width, rel=1e-14)
    assert scaled.mean == pytest.approx(1000.0 * found.mean - 5.0, rel=1e-12)
    assert scaled.half_width == pytest.approx(1000.0 * found.half_width, rel=1e-12)


def test_four_times_the_replicas_halve_the_error() -> None:
    draw = generator(5, "draw").normal(0.0, 1.0, (400, 500))
    few, many = estimate(draw[:100]), estimate(draw)
    assert many.standard_error.mean() / few.standard_error.mean() == pytest.approx(0.5, rel=0.01)


def test_what_does_not_vary_has_no_error() -> None:
    found = estimate([262_144] * 4)
    assert (found.mean, found.standard_error, found.half_width) == (262_144.0, 0.0, 0.0)


def test_plain_numbers_for_json() -> None:
    written = json.loads(json.dumps(estimate([1, 2, 3, 6], 0.9).to_dict()))
    assert written == {
        "mean": 3.0,
        "standard_error": pytest.approx(np.sqrt(14.0 / 12.0)),
        "half_width": pytest.approx(2.353363 * np.sqrt(14.0 / 12.0), rel=1e-6),
        "confidence": 0.9,
        "replicas": 4,
    }


@pytest.mark.parametrize("values", [[], [1.0], [np.ones((3, 2))]])
def test_fewer_than_two_replicas_say_nothing(values: list[object]) -> None:
    with pytest.raises(UsageError) as caught:
        estimate(values)
    assert str(caught.value) == f"an error is estimated from 2 replicas or more, got {len(values)}"


def test_replicas_have_seeds_of_their_own_and_the_first_is_the_given_one() -> None:
    assert seeds(7, 3) == [7, 8, 9]
    assert seeds(2**64 - 2, 4) == [2**64 - 2, 2**64 - 1, 0, 1]
    assert len(set(seeds(2**64 - 500, 1000))) == 1000


def test_a_measure_is_asked_once_a_seed_in_order() -> None:
    asked: list[int] = []
    found = over_replicas(5, 3, lambda seed: (asked.append(seed), float(seed) ** 2)[1], confidence=0.8)
    assert asked == [5, 6, 7]
    assert (found.mean, found.replicas, found.confidence) == (110.0 / 3.0, 3, 0.8)
    with pytest.raises(UsageError, match="2 replicas or more, got 1"):
        over_replicas(5, 1, float)


def test_small_traces_estimate_a_large_one() -> None:
    """Groups of 4 traces at 1/64 of the pixels: their intervals hold what 64 times as many rays find."""
    large = garden_workload("96x64", "96x64", samples=16)
    small = garden_workload("96x64", "12x8", samples=16)

    def hits(workload, seed: int) -> float:
        trace = workload.trace(seed)
        trace.kinds(np.zeros(1, np.int64))  # the camera's rays alone are traced
        return float(np.isfinite(trace.column("t")[: trace.first[1]]).sum()) * workload.weight

    truth = hits(large, 1000)
    found = [over_replicas(seed, 4, lambda s: hits(small, s)) for seed in range(0, 160, 4)]
    held = sum(abs(float(f.mean) - truth) <= float(f.half_width) for f in found)
    assert held >= 34  # of 40; 38 are expected
    assert all(0.0 < f.half_width < 0.1 * truth for f in found)
    assert np.mean([f.mean for f in found]) == pytest.approx(truth, rel=2e-3)


# simrender trace --replicas

Found = Callable[..., dict[str, Any]]
WAVELETS = Path(__file__).parent.parent / "data" / "wavelets64.spray"


@pytest.fixture
def trace(run_cli: Callable[..., Ran]) -> Found:
    """Trace a workload on the command line; return its JSON."""
    return lambda *arguments: json.loads(run_cli("trace", *arguments, "--json", "-").out)


def test_replicas_estimate_what_is_published(trace: Found, tiny_card: Path) -> None:
    found = trace(tiny_card, "--resolution", "32x18", "--replicas", 6)
    whole = trace(tiny_card)
    estimates = found["estimates"]
    assert {e["replicas"] for e in estimates.values()} == {6}
    assert {e["confidence"] for e in estimates.values()} == {0.95}
    camera = estimates["camera rays"]
    assert (camera["mean"], camera["half_width"]) == (64 * 36 * 2, 0.0)
    hits = estimates["camera hits"]
    assert abs(hits["mean"] - whole["camera_hits"]) < 3 * hits["half_width"]
    assert 0.0 < hits["half_width"] < 0.1 * hits["mean"]
    assert [name for name in estimates if "domain" in name] == [f"rays that enter domain {d}" for d in range(8)]
    assert estimates["mean radiance"]["mean"] == pytest.approx(0.58, abs=0.05)
    plain = {k: v for k, v in found.items() if k != "estimates"}
    assert plain == trace(tiny_card, "--resolution", "32x18")
    assert "estimates" not in plain


def test_more_replicas_are_surer(trace: Found, tiny_card: Path) -> None:
    few, many = (trace(tiny_card, "--resolution", "32x18", "--replicas", n)["estimates"] for n in (3, 30))
    names = [name for name in few if few[name]["half_width"] > 0.0]
    assert len(names) > 8
    assert np.median([many[name]["half_width"] / few[name]["half_width"] for name in names]) < 0.5


def test_replicas_need_not_all_have_rays_of_a_kind(run_cli: Callable[..., Ran], tiny_card: Path) -> None:
    """So few rays that some replicas hit nothing, whichever comes first."""
    for seed in range(1, 7):
        ran = run_cli("trace", tiny_card, "--resolution", "2x1", "--set", "workload.published.samples=1",
                      "--replicas", 8, "--seed", seed)  # fmt: skip
        assert ran.code == 0, ran
        assert "from 8 independent replicas" in ran.out
        assert "scatter rays" not in ran.out


def test_replicas_without_random_numbers_do_not_claim_to_be_exact(run_cli: Callable[..., Ran]) -> None:
    ran = run_cli("trace", WAVELETS, "--resolution", "32x32", "--replicas", 3)
    assert "± 0.00%" not in ran.out
