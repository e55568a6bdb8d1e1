"""Ways through volumes against closed forms, over all orders of magnitude that a scene may ask for."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simrender.accuracy.media import blending, chords, marching, tracking


@pytest.mark.parametrize("tau", [1e-6, 0.1, 1.0, 5.0, 700.0])
def test_numerics_free_flights_are_the_same_however_loose_the_majorant(tau):
    for row in tracking([tau], [1.0, 10.0, 1e3, 1e6], budget=2e5):
        assert row.rays >= 25
        assert abs(row.depth - row.expected_depth) <= 4.0 * row.standard_error
        spread = math.sqrt(row.expected_passed * (1.0 - row.expected_passed) / row.rays)
        assert abs(row.passed - row.expected_passed) <= 4.0 * spread
        # Each stretch of optical depth costs as many look-ups as the majorant is loose: a Poisson number.
        expected = row.expected_depth * row.looseness
        spread = math.sqrt((expected + row.looseness**2 * row.rays * row.standard_error**2) / row.rays)
        assert abs(row.look_ups - expected) <= 5.0 * spread


def test_numerics_the_standard_error_of_the_covered_depth_is_that_of_the_flights():
    # Of 100,000 exponential lengths, cut off at tau, drawn another way.
    lengths = np.random.Generator(np.random.Philox(key=2)).exponential(size=100_000)
    for row in tracking([0.1, 1.0, 5.0], [1.0], budget=1e3):
        cut = np.minimum(lengths, row.tau)
        assert row.expected_depth == pytest.approx(cut.mean(), rel=0.02)
        assert row.standard_error * math.sqrt(row.rays) == pytest.approx(cut.std(), rel=0.02)


def test_numerics_marching_converges_at_first_order():
    rows = marching([2.0, 1.0, 0.5, 0.25, 0.125])
    for errors in ([row.opacity_error for row in rows], [row.color_error for row in rows]):
        slope = np.polyfit(np.log([row.step for row in rows]), np.log(errors), 1)[0]
        assert slope == pytest.approx(1.0, abs=0.1)
        assert errors[-1] < 1e-3


def test_watertight_parts_cover_every_chord_exactly_once():
    rows = chords(cells=4, parts=5, rays=600)
    assert len({(row.element, row.aim) for row in rows}) == 16
    for row in rows:
        assert row.lost == 0
        assert row.chord_error < 1e-6
        assert row.opacity_error < 1e-6
        assert row.fragments > 600


def test_numerics_fragments_make_one_colour_in_whatever_tree_they_are_blended():
    for row in blending([1, 2, 3, 17, 64, 500]):
        unit = 2.0**-24
        assert row.library <= unit
        # Each blend rounds a few times; a tree is as deep as the logarithm of its leaves.
        assert row.front_to_back <= 3.0 * row.fragments * unit
        assert row.binary_tree <= 3.0 * (1.0 + math.log2(row.fragments)) * unit
        assert row.random_tree <= 3.0 * row.fragments * unit
