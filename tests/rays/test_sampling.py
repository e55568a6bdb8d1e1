"""Random numbers that depend on nothing but where they are drawn."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.rays.sampling import cosine_direction, offset_origin, path_key, uniform


def draws(**changed: int) -> list[float]:
    place = {"seed": 1, "pixel": 2, "sample": 3, "depth": 4} | changed
    key = np.uint64(path_key(place["seed"], place["pixel"], place["sample"], place["depth"]))
    return [uniform(key, d) for d in range(4)]


def test_every_coordinate_changes_the_numbers():
    base = draws()
    assert draws() == base
    for name in ("seed", "pixel", "sample", "depth"):
        assert not set(draws(**{name: 9})) & set(base)


def test_swapped_coordinates_are_other_places():
    assert draws(pixel=3, sample=2) != draws()


def test_numbers_are_uniform_and_uncorrelated():
    values = np.array(
        [[uniform(np.uint64(path_key(7, p, s, 0)), d) for d in range(3)] for p in range(120) for s in range(20)]
    )
    assert values.min() >= 0.0
    assert values.max() < 1.0
    assert values.mean(axis=0) == pytest.approx(np.full(3, 0.5), abs=4 * 0.2887 / np.sqrt(2400))
    correlation = np.corrcoef(values.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / np.sqrt(2400)


def test_cosine_directions_are_unit_vectors_with_the_right_mean():
    rng = np.random.Generator(np.random.Philox(key=5))
    normal = np.array([0.36, 0.48, -0.8])
    directions = np.array([cosine_direction(*normal, *u) for u in rng.random((4000, 2))])
    assert np.linalg.norm(directions, axis=1) == pytest.approx(np.ones(4000))
    cosines = directions @ normal
    assert cosines.min() >= -1e-12
    assert cosines.mean() == pytest.approx(2 / 3, abs=0.02)  # of a cosine-weighted hemisphere
    assert directions.mean(axis=0) == pytest.approx(normal * 2 / 3, abs=0.03)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_origins_move_off_a_surface_by_a_few_units_in_the_last_place(scale):
    points = (np.array([[1.0, -2.0, 0.5], [3.0, 3.0, -3.0]]) * scale).astype(np.float32)
    moved = points.copy()
    for i in range(len(points)):
        offset_origin(moved, moved.view(np.int32), i, 0.0, 0.6, -0.8)
    step = moved.astype(np.float64) - points
    assert (step[:, 0] == 0).all()
    assert (step[:, 1] > 0).all()
    assert (step[:, 2] < 0).all()
    assert np.abs(step).max() <= max(2e-5, 4e-5 * 3 * scale)
