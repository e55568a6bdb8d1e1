from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from simrender.rays.element_marching import march_parts
from simrender.rays.elements import Elements, boundary
from simrender.rays.workload import load_workload
from workloads.lander import RADIUS, _Flow, _hilbert, lander, lander_elements


@cache
def small() -> Elements:
    return lander_elements(seed=1, parts=24, elements=12_000)


def whole(elements: Elements) -> Elements:
    return replace(elements, part=np.zeros_like(elements.part))


def along(origins, directions) -> dict[str, np.ndarray]:
    origins = np.asarray(origins, np.float32)
    directions = np.broadcast_to(np.asarray(directions, np.float32), origins.shape)
    return {"origin": origins, "direction": directions, "reach": np.full(len(origins), np.inf, np.float32)}


def test_the_same_seed_gives_the_same_mesh_to_the_bit():
    again = lander_elements(seed=1, parts=24, elements=12_000)
    assert again.key == small().key
    assert lander_elements(seed=2, parts=24, elements=12_000).key != again.key
    assert lander(seed=1, parts=24, elements=12_000).elements.key == again.key


@pytest.mark.parametrize("wanted", [2_000, 5_000, 40_000])
def test_any_number_of_elements_without_one_inside_out(wanted):
    elements = lander_elements(elements=wanted, parts=7)  # a warning would be an error here
    assert 0.85 * wanted < elements.count < 1.15 * wanted
    assert set(elements.kind) == {4, 5, 6, 8}
    assert elements.parts == 7


def test_two_elements_meet_in_whole_faces_and_the_only_surfaces_are_vehicle_and_edge():
    elements = small()
    shell = boundary(whole(elements))
    middle = elements.points[shell.faces].astype(np.float64).mean(axis=1)
    distance = np.linalg.norm(middle, axis=1)
    edge = distance > 4.0 * RADIUS
    assert (distance[~edge] < 1.2 * RADIUS).all()
    assert edge.sum() == (~edge).sum()
    triangles = Counter(int(k) for k in elements.kind[shell.element[~edge]])
    assert triangles == {6: int((~edge).sum())}  # the wall is clad in wedges
    # A closed surface of the topology of a sphere, twice.
    edges = Counter(frozenset((int(f[j]), int(f[(j + 1) % 3]))) for f in shell.faces for j in range(3))
    assert set(edges.values()) == {2}
    assert len(np.unique(shell.faces)) - len(edges) + len(shell.faces) == 4


def test_parts_have_equally_many_elements_and_exactly_shared_boundaries():
    elements = small()
    counts = elements.elements_of
    assert counts.max() - counts.min() <= 1
    outer = len(boundary(whole(elements)).faces)
    shell = boundary(elements)
    met = Counter(tuple(sorted(f)) for f in shell.faces.tolist())
    assert set(met.values()) == {1, 2}
    assert sum(1 for n in met.values() if n == 1) == outer


def test_parts_interlock_so_that_rays_enter_them_more_than_once():
    elements = small()
    rng = np.random.Generator(np.random.Philox(key=1))
    origin = rng.normal(size=(300, 3))
    origin *= 12.0 * RADIUS / np.linalg.norm(origin, axis=1, keepdims=True)
    direction = rng.normal(size=(300, 3)) * RADIUS - origin
    batch = along(origin, direction / np.linalg.norm(direction, axis=1, keepdims=True))
    rows = np.arange(300 * elements.parts)
    apart = march_parts(elements, batch, rows // elements.parts, (rows % elements.parts).astype(np.int32))
    assert 0.1 < (apart.segments > 1).sum() / (apart.segments > 0).sum() < 0.9
    one = march_parts(whole(elements), batch, np.arange(300), np.zeros(300, np.int32))
    assert apart.elements.reshape(300, -1).sum(axis=1).tolist() == one.elements.tolist()
    spans = [np.bincount(r, f.exit.astype(float) - f.entry, 300) for f, r in ((apart, apart.row // 24), (one, one.row))]
    assert (spans[0] <= spans[1] + 1e-5).all()  # less only where a part of a segment is transparent


def test_the_vehicle_is_a_hole_in_the_mesh():
    elements = whole(small())
    step = march_parts(
        elements, along([[-100.0, 0.1, 0.2], [-100.0, 20.0, 0.2]], [1, 0, 0]), np.arange(2), np.zeros(2, np.int32)
    )
    assert step.segments.tolist() == [2, 1]


def test_elements_grow_away_from_the_wall():
    elements = small()
    middle = np.array(
        [
            elements.points[elements.corners[a:b]].mean(axis=0)
            for a, b in zip(elements.first, elements.first[1:], strict=False)
        ]
    )
    size = np.array(
        [
            np.ptp(elements.points[elements.corners[a:b]], axis=0).max()
            for a, b in zip(elements.first, elements.first[1:], strict=False)
        ]
    )
    distance = np.linalg.norm(middle, axis=1)
    near, far = size[distance < 1.2 * RADIUS], size[distance > 4.0 * RADIUS]
    assert np.median(near) < 0.5 * np.median(far)


def test_plumes_shock_and_wake_stand_out_from_calm_air():
    flow = _Flow(1)
    nozzle = 0.5 * np.array([0.0, np.sqrt(0.5), np.sqrt(0.5)])
    plume, calm = RADIUS * (nozzle - [0.7, 0.0, 0.0]), np.array([0.0, 5.5 * RADIUS, 0.0])
    assert flow.vorticity(plume[None])[0] > 0.5
    assert flow.vorticity(calm[None])[0] < 0.05
    ahead = np.stack([np.linspace(-5.0, -3.0, 200) * RADIUS, np.zeros(200), np.zeros(200)], axis=1)
    assert flow.vorticity(ahead).max() > 0.5
    assert flow.vorticity(ahead)[0] < 0.05
    scalars = small().scalars
    assert scalars.min() >= 0.0
    assert scalars.max() <= 1.0
    assert small().transfer.sigma(0.1) == 0.0


def test_the_curve_visits_every_cell_once_and_neighbours_after_each_other():
    cell = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), -1).reshape(-1, 3) << 13
    order = np.argsort(_hilbert(cell))
    steps = np.abs(np.diff(cell[order] >> 13, axis=0)).sum(axis=1)
    assert steps.tolist() == [1] * 511


@pytest.mark.parametrize(("name", "elements", "parts"), [("lander-small", 798e6, 72), ("lander-huge", 6.38e9, 552)])
def test_cards_state_the_published_sizes(name, elements, parts):
    card = load_workload(name).card
    assert card.published.elements == elements
    assert card.published.domains == parts == card.scene.arguments["parts"]
    assert 36.0 < card.published.geometry_bytes / elements < 111.0
    assert card.integrator.name == "element_marching"
