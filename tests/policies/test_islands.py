"""Islands: rings, scan lines, and how many fit."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.policies.islands import Layout, fit, represented_lines


def test_the_ring_stays_inside_its_island():
    layout = Layout(islands=2, size=3)
    assert [layout.right(r) for r in range(6)] == [1, 2, 0, 4, 5, 3]
    assert [layout.left(r) for r in range(6)] == [2, 0, 1, 5, 3, 4]
    assert [layout.domain(r) for r in range(6)] == [0, 1, 2, 0, 1, 2]


def test_islands_interleave_scan_lines_and_ranks_interleave_the_islands():
    lines = np.arange(12)
    assert Layout(1, 3).rank_of_line(lines).tolist() == [0, 1, 2] * 4  # every N'th row (section 4.4)
    assert Layout(3, 1).rank_of_line(lines).tolist() == [0, 1, 2] * 4
    # Island 0 takes lines 0, 2, 4 ..., and of those its ranks 0, 1 and 2 take every third.
    assert Layout(2, 3).rank_of_line(lines).tolist() == [0, 3, 1, 4, 2, 5] * 2


def test_a_pixel_traced_at_published_size_is_its_own_line():
    assert represented_lines((4, 3), 3).tolist() == [0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]


@pytest.mark.parametrize("ranks", [2, 3, 7, 16])
def test_traced_pixels_are_shared_like_published_lines(ranks):
    height = 1080
    owner = Layout(1, ranks).rank_of_line(represented_lines((256, 108), height))
    shares = np.bincount(owner, minlength=ranks) / len(owner)
    published = np.bincount(np.arange(height) % ranks) / height
    assert np.abs(shares - published).max() < 0.002


def even(total: float, queues: float = 0.0):
    """A model that splits evenly, and queues shared by all ranks."""
    return lambda islands, size: np.full(islands * size, total / size + queues / (islands * size))


def test_auto_takes_the_fewest_gpus_that_hold_the_model():
    chosen = fit(16, None, even(100.0), capacity_bytes=40.0)
    assert (chosen.layout.islands, chosen.layout.size) == (5, 3)
    assert chosen.feasible
    assert chosen.gpus_needed == 3


def test_gpus_are_shared_out_before_they_stay_unused():
    # Six hold it, so there are two islands, of eight and not of six.
    assert fit(16, None, even(100.0), 18.0).layout == Layout(2, 8)


def test_queues_count_towards_the_memory_of_every_rank():
    assert fit(8, None, even(40.0), 40.0).layout == Layout(8, 1)
    assert fit(8, None, even(40.0, queues=8.0), 40.0).layout == Layout(4, 2)


def test_too_little_memory_says_how_many_would_do():
    chosen = fit(4, None, even(100.0), 15.0)
    assert not chosen.feasible
    assert chosen.layout == Layout(1, 4)
    assert chosen.needed_bytes.tolist() == [25.0] * 4
    assert chosen.gpus_needed == 7


def test_too_many_islands_say_what_so_many_would_take():
    chosen = fit(8, 8, even(100.0), 30.0)
    assert not chosen.feasible
    assert chosen.gpus_needed == 8 * 4


def test_a_part_that_cannot_be_split_fits_nowhere():
    chosen = fit(4, None, lambda islands, size: np.full(islands * size, 50.0), 15.0)
    assert chosen.gpus_needed is None


def test_replicated_models_have_one_rank_an_island():
    assert fit(6, None, even(10.0), 15.0, replicated=True).layout == Layout(6, 1)
    assert fit(6, None, even(20.0), 15.0, replicated=True).gpus_needed is None
