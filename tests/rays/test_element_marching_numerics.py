from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from simrender.errors import SceneError, SceneWarning
from simrender.rays import embree
from simrender.rays.element_marching import Fragments, march_parts
from simrender.rays.elements import FACES, Elements, boundary
from simrender.rays.volume import TransferFunction

WHITE = TransferFunction(np.array([0.0]), np.ones((1, 3)), np.array([0.5]))
"""Half opaque a unit of length, whatever the scalar."""

WAYS = ("hexahedra", "wedges", "pyramids", "tetrahedra", "mixed")


def mesh(points, cells, part=None, transfer=WHITE, scalars=None) -> Elements:
    kind = np.array([len(c) for c in cells])
    points = np.asarray(points, np.float64)
    return Elements(
        points,
        points @ [0.2, 0.3, 0.4] + 0.05 if scalars is None else np.asarray(scalars),
        np.concatenate([[0], np.cumsum(kind)]),
        np.concatenate([np.asarray(c) for c in cells]),
        kind,
        np.zeros(len(cells), np.int32) if part is None else np.asarray(part),
        transfer,
    )


def lattice(n: int) -> tuple[np.ndarray, np.ndarray]:
    """The points of a unit cube of n cells a side, and the hexahedra."""
    points = np.stack(np.meshgrid(*[np.arange(n + 1)] * 3, indexing="ij"), -1).reshape(-1, 3) / n
    ids = np.arange((n + 1) ** 3).reshape([n + 1] * 3)
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
    return points, np.stack([ids[a : a + n, b : b + n, c : c + n].ravel() for a, b, c in corners], axis=1)


def cube(way: str, n: int = 3, parts: int = 1, jitter: float = 0.0, seed: int = 1, **more) -> Elements:
    """A unit cube cut into elements; inner points are moved at random, which warps the faces."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    points, hexes = lattice(n)
    inner = ((points > 0) & (points < 1)).all(axis=1)
    points = points + inner[:, None] * rng.uniform(-jitter, jitter, points.shape) / n
    points = list(points)
    cells: list = []
    for number, h in enumerate(hexes):
        made = WAYS[number % 4] if way == "mixed" else way
        if made == "hexahedra":
            cells.append(h)
        elif made == "wedges":
            cells += [h[[0, 1, 2, 4, 5, 6]], h[[0, 2, 3, 4, 6, 7]]]
        else:
            middle = len(points)
            points.append(np.mean([points[i] for i in h], axis=0))
            for face in FACES[8]:
                quad = h[list(face)]
                q = np.roll(quad, -int(quad.argmin()))
                if made == "pyramids":
                    cells.append([*q[::-1], middle])
                else:
                    cells += [[q[0], q[2], q[1], middle], [q[0], q[3], q[2], middle]]
    return mesh(points, cells, rng.integers(0, parts, len(cells)), **more)


def rays(origin, target, reach=np.inf) -> dict[str, np.ndarray]:
    origin, target = np.broadcast_arrays(np.asarray(origin, np.float64), np.asarray(target, np.float64))
    direction = target - origin
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    return {
        "origin": np.atleast_2d(origin).astype(np.float32),
        "direction": np.atleast_2d(direction).astype(np.float32),
        "reach": np.full(len(np.atleast_2d(origin)), reach, np.float32),
    }


def march(elements: Elements, batch: dict[str, np.ndarray], **more) -> tuple[Fragments, np.ndarray]:
    """March every ray through every part; return the ray of each row too."""
    n = len(batch["reach"])
    row_ray, row_part = np.repeat(np.arange(n), elements.parts), np.tile(np.arange(elements.parts, dtype=np.int32), n)
    return march_parts(elements, batch, row_ray, row_part, **more), row_ray


def chords(elements: Elements, batch: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The length of each ray inside all parts: from where fragments begin and end, and from their opacity."""
    found, row_ray = march(elements, batch)
    n = len(batch["reach"])
    ray = row_ray[found.row]
    spans = np.bincount(ray, found.exit.astype(np.float64) - found.entry, n)
    return spans, np.bincount(ray, -np.log2(1.0 - found.rgba[:, 3].astype(np.float64)), n)


def in_cube(batch: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The length of each ray inside the unit cube, and whether it runs in the plane of a side."""
    o, d = batch["origin"].astype(np.float64), batch["direction"].astype(np.float64)
    within = ((o >= 0.0) & (o <= 1.0)) | (d != 0.0)
    d_safe = np.where(d == 0.0, 1e-300, d)
    with np.errstate(over="ignore", invalid="ignore"):
        t0, t1 = (0.0 - o) / d_safe, (1.0 - o) / d_safe
    near, far = np.where(d == 0.0, -np.inf, np.minimum(t0, t1)), np.where(d == 0.0, np.inf, np.maximum(t0, t1))
    near, far = np.maximum(near.max(axis=1), 0.0), np.minimum(far.min(axis=1), batch["reach"])
    in_plane = ((d == 0.0) & ((o == 0.0) | (o == 1.0))).any(axis=1)
    return np.where(within.all(axis=1), np.maximum(far - near, 0.0), 0.0), in_plane


def hard_rays(n: int, count: int = 400) -> dict[str, np.ndarray]:
    """Rays at random, at points, edges and faces of a lattice, along its axes and diagonals, from in- and outside."""
    rng = np.random.Generator(np.random.Philox(key=7))
    outside = 0.5 + 2.5 * (d := rng.normal(size=(count, 3))) / np.linalg.norm(d, axis=1, keepdims=True)
    point = rng.integers(0, n + 1, (count, 3)) / n
    other = rng.integers(0, n + 1, (count, 3)) / n
    axis = np.eye(3)[rng.integers(0, 3, count)]
    half = rng.integers(0, 2 * n + 1, (count, 3)) / (2 * n)
    diagonal = rng.integers(-1, 2, (count, 3)).astype(float)
    diagonal[~diagonal.any(axis=1)] = 1.0
    batches = [
        (outside, rng.uniform(0.05, 0.95, (count, 3))),
        (outside, point),
        (outside, 0.5 * (point + other)),
        (point - 2.0 * axis, point),
        (point + 3.0 * axis, point),
        (half - 2.0 * axis, half),
        (half - 4.0 * diagonal, half),
        (point, point + diagonal),
        (half, outside),
        (rng.uniform(0.01, 0.99, (count, 3)), outside),
    ]
    return rays(np.concatenate([o for o, _ in batches]), np.concatenate([t for _, t in batches]))


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize("jitter", [0.0, 0.2])
@pytest.mark.parametrize("way", WAYS)
def test_no_ray_loses_its_way_through_a_cube(way, jitter, parts):
    batch = hard_rays(3)
    chord, in_plane = in_cube(batch)
    for found in chords(cube(way, parts=parts, jitter=jitter), batch):
        np.testing.assert_allclose(found[~in_plane], chord[~in_plane], atol=1e-6)
        # In the plane of a side a ray is inside or outside all the way, as if it were moved aside a little.
        side, whole = found[in_plane], chord[in_plane]
        assert (np.minimum(abs(side), abs(side - whole)) < 1e-6).all()
        assert (side > 0.5).any()
        assert (side == 0.0).any()


@pytest.mark.parametrize("way", ["hexahedra", "mixed"])
def test_parts_add_up_to_the_whole(way):
    batch = hard_rays(3, 150)
    elements = cube(way, parts=5, jitter=0.2)
    whole = replace(elements, part=np.zeros_like(elements.part))
    for apart, together in zip(chords(elements, batch), chords(whole, batch), strict=True):
        np.testing.assert_allclose(apart, together, atol=1e-6)
    (a, row_ray), (b, _) = march(elements, batch), march(whole, batch)
    n = len(batch["reach"])
    assert np.bincount(row_ray, a.elements, n).tolist() == b.elements.tolist()
    assert np.bincount(row_ray, a.samples, n).tolist() == b.samples.tolist()


def test_a_plane_between_two_parts_belongs_to_exactly_one_of_them():
    points, hexes = lattice(2)
    elements = mesh(points, hexes, hexes[:, 0] // 9)  # parts below and above x = 1/2
    y, z = (a.ravel() for a in np.meshgrid(np.linspace(0.0, 1.0, 9)[1:-1], [-1.0, 2.0]))
    batch = rays(np.stack([np.full_like(y, 0.5), y, z], -1), np.stack([np.full_like(y, 0.5), y, 0 * z + 0.5], -1))
    found, row_ray = march(elements, batch)
    assert np.bincount(row_ray[found.row]).tolist() == [1] * len(y)
    np.testing.assert_allclose(found.exit - found.entry, 1.0, atol=1e-6)


@pytest.mark.parametrize("way", WAYS)
def test_a_linear_field_integrates_exactly(way):
    ramp = TransferFunction(np.array([0.0, 1.0]), np.zeros((2, 3)), np.array([0.0, 0.75]))
    elements = cube(way, jitter=0.2, transfer=ramp)
    batch = hard_rays(3, 100)
    chord, in_plane = in_cube(batch)
    found, row_ray = march(elements, batch)
    assert set(found.row) >= set(np.flatnonzero((chord > 1e-3) & ~in_plane))
    ray = row_ray[found.row]
    middle = batch["origin"][ray] + (0.5 * (found.entry + found.exit))[:, None] * batch["direction"][ray].astype(float)
    exact = np.log(4.0) * (middle @ [0.2, 0.3, 0.4] + 0.05) * (found.exit - found.entry)
    np.testing.assert_allclose(-np.log1p(-found.rgba[:, 3].astype(float)), exact, rtol=2e-6, atol=1e-6)


def test_colour_and_opacity_are_premultiplied_and_composited_front_to_back():
    colors = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    split = TransferFunction(np.array([0.4999, 0.5001]), colors, np.array([0.5, 0.75]))
    points = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)], float)
    left = np.array([0, 1, 4, 3, 6, 7, 10, 9])
    points = np.concatenate([points, points])  # the scalar jumps from 0 to 1 where the two parts meet
    elements = mesh(points, [left, left + 13], scalars=np.repeat([0.0, 1.0], 12), part=[0, 1], transfer=split)
    found, _ = march(elements, rays([-1, 0.4, 0.3], [0, 0.4, 0.3]))
    assert found.entry.tolist() == [1.0, 2.0]
    np.testing.assert_allclose(found.rgba, [[0.5, 0, 0, 0.5], [0, 0, 0.75, 0.75]], atol=1e-6)


def test_sampling_converges_to_the_integral_of_an_opaque_bump():
    bump = TransferFunction(np.array([0.2, 0.4, 0.6]), np.ones((3, 3)), np.array([0.0, 0.9, 0.0]))
    elements = cube("tetrahedra", n=1, transfer=bump)
    batch = rays([-1.0, 0.1, 0.2], [0.0, 0.35, 0.4])
    depth = [-np.log1p(-march(elements, batch, step=s)[0].rgba[0, 3].astype(float)) for s in (1e-1, 1e-2, 1e-3, 1e-4)]
    error = np.abs(np.array(depth) - depth[-1])
    assert error[1] < 0.1 * error[0]
    assert error[2] < 1e-5


# -- where rays begin and end -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("origin", [[0.5, 0.5, 0.5], [0.4, 0.3, 0.0], [1 / 3, 1 / 3, 1 / 3], [0.0, 0.0, 0.0]])
def test_a_camera_inside_sees_what_is_in_front_of_it_only(origin):
    elements = cube("mixed", parts=2)
    batch = rays(origin, [[0.9, 0.8, 1.3], [0.9, 0.8, 2.5], [1.0, 1.0, 1.0]])
    chord, _ = in_cube(batch)
    for found in chords(elements, batch):
        np.testing.assert_allclose(found, chord, atol=1e-6)
    found, _ = march(elements, batch)
    assert found.entry.min() == 0.0


def test_rays_end_at_their_reach_and_parts_behind_are_not_seen():
    elements = cube("mixed")
    batch = rays([[-1, 0.5, 0.4]] * 4, [0, 0.5, 0.4])
    batch["reach"][:] = [0.5, 1.25, 1.5, np.inf]
    spans, depths = chords(elements, batch)
    np.testing.assert_allclose(spans, [0.0, 0.25, 0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(depths, spans, atol=1e-6)
    away = rays([-1, 0.5, 0.4], [-2, 0.5, 0.4])
    found, _ = march(elements, away)
    assert (len(found.row), found.elements[0], found.samples[0], found.segments[0]) == (0, 0, 0, 0)


def test_a_ray_enters_a_part_as_often_as_it_comes_by():
    points, hexes = lattice(5)
    column = hexes[:, 0] // 36  # along x
    comb = (column % 2 == 0) | (hexes[:, 0] % 6 == 0)  # five teeth on a common floor
    part = np.where(comb, 0, 1)
    found, _ = march(mesh(points, hexes, part), rays([[-1, 0.5, 0.7], [-1, 0.5, 0.1]], [[0, 0.5, 0.7], [0, 0.5, 0.1]]))
    assert found.segments.tolist() == [3, 2, 1, 0]
    assert found.elements.tolist() == [3, 2, 5, 0]
    assert found.row.tolist() == [0, 0, 0, 1, 1, 2]
    np.testing.assert_allclose(found.entry, [1.0, 1.4, 1.8, 1.2, 1.6, 1.0], atol=1e-6)
    np.testing.assert_allclose(found.exit, [1.2, 1.6, 2.0, 1.4, 1.8, 2.0], atol=1e-6)


def test_more_segments_than_a_first_guess_allows():
    points, hexes = lattice(40)
    row = hexes[(hexes[:, 0] % 41 < 2) & (hexes[:, 0] // 41 % 41 < 2)]
    part = (row[:, 0] // 41**2) % 2
    found, _ = march(mesh(points, row, part), rays([-1, 0.01, 0.012], [0, 0.01, 0.012]))
    assert found.segments.tolist() == [20, 20]
    assert len(found.row) == 40
    assert (np.diff(found.entry.reshape(2, 20)) > 0.0).all()


def test_transparent_fragments_are_rejected_but_their_work_counts():
    clear = TransferFunction(np.array([0.0, 1.0, 2.0]), np.ones((3, 3)), np.array([0.0, 0.0, 0.5]))
    found, _ = march(cube("hexahedra", transfer=clear), rays([-1, 0.5, 0.4], [0, 0.5, 0.4]))
    assert len(found.row) == 0
    assert (found.elements[0], found.samples[0], found.segments[0]) == (3, 3, 1)


def test_samples_lie_no_further_apart_than_the_step():
    batch = rays([-1, 0.5, 0.4], [0, 0.5, 0.4])
    samples = [march(cube("hexahedra"), batch, step=s)[0].samples[0] for s in (np.inf, 0.34, 0.33, 0.1)]
    assert samples == [3, 3, 6, 12]


@pytest.mark.parametrize("step", [0.0, -1.0, np.nan])
def test_a_step_that_leads_nowhere_is_refused(step):
    with pytest.raises(SceneError, match="the step of a ray march is a length above"):
        march(cube("hexahedra"), rays([-1, 0.5, 0.4], [0, 0.5, 0.4]), step=step)


# -- odd meshes, odd places -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [2.0**20, 2.0**-20])
def test_other_units_of_length_give_the_same_picture_to_the_bit(factor):
    elements, batch = cube("mixed", parts=3, jitter=0.2), hard_rays(3, 100)
    larger = {**batch, "origin": batch["origin"] * np.float32(factor)}
    (a, _), (b, _) = march(elements, batch), march(elements.scaled(factor), larger)
    assert a.elements.tolist() == b.elements.tolist()
    assert a.row.tolist() == b.row.tolist()
    assert (a.entry * np.float32(factor)).tolist() == b.entry.tolist()
    np.testing.assert_allclose(a.rgba, b.rgba, atol=1e-6)


def test_a_mesh_far_from_the_origin():
    elements = cube("mixed", n=4, parts=2)  # coordinates that are exact in float32, there too
    points = elements.points * np.float32(1024.0) + np.float32(1e6 // 64 * 64)
    far = replace(elements, points=points, transfer=replace(WHITE, unit=1024.0))
    origin = points.mean(axis=0) + np.array([[-4096.0, 512.0, 128.0], [3000.0, -2000.0, 1000.0]])
    batch = rays(origin, points[[40, 41]])
    batch["origin"] = np.round(batch["origin"])
    near = {**batch, "origin": (batch["origin"] - np.float32(1e6 // 64 * 64)) / np.float32(1024.0)}
    chord, _ = in_cube(near)
    for found, unit in zip(chords(far, batch), (1024.0, 1.0), strict=True):
        np.testing.assert_allclose(found / unit, chord, atol=1e-6 * 2048.0 / unit)


def test_elements_inside_out_are_repaired_and_marched_like_the_others():
    points, hexes = lattice(3)
    wrong = hexes.copy()
    wrong[::4] = wrong[::4, [4, 5, 6, 7, 0, 1, 2, 3]]
    with pytest.warns(SceneWarning, match="7 of 27 elements are inside out"):
        elements = mesh(points, wrong)
    batch = hard_rays(3, 50)
    for found, wanted in zip(chords(elements, batch), chords(mesh(points, hexes), batch), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)


def test_flat_elements_do_not_stop_a_ray():
    square = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    # Two pyramids with a hexahedron of no thickness between them, parted along the other diagonal.
    points = [*square, *square, [0, 0, 1], [0, 0, -1]]
    with pytest.warns(SceneWarning, match="1 element is without volume"):
        elements = mesh(points, [[0, 1, 2, 3, 8], [7, 6, 5, 4, 9], [4, 5, 6, 7, 0, 1, 2, 3]])
    origin = np.array([[0.3, 0.25, 3.0], [0.25, 0.25, 3.0], [0.2, 0.3, -3.0]])
    batch = rays(origin, origin * [1, 1, 0])
    for found in chords(elements, batch):
        np.testing.assert_allclose(found, 2.0 - 2.0 * origin[:, :2].max(axis=1), atol=1e-6)
    found, _ = march(elements, batch)
    assert found.segments.tolist() == [1, 1, 1]


def test_a_squat_pyramid_is_its_two_tetrahedra():
    points = [[0, 0, 0], [1, 0, 0.3], [1, 1, 0], [0, 1, 0.3], [0.5, 0.5, 0.1]]
    pyramid, two = mesh(points, [range(5)]), mesh(points, [[0, 1, 2, 4], [0, 2, 3, 4]])
    rng = np.random.Generator(np.random.Philox(key=6))
    batch = rays(rng.uniform([-1, -1, 2], [2, 2, 3], (500, 3)), rng.uniform([0, 0, 0], [1, 1, 0.3], (500, 3)))
    one = chords(pyramid, batch)
    for found, wanted in zip(one, chords(two, batch), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (one[0] > 0.0).sum() > 300


def test_warped_hexahedra_leave_no_gap():
    rng = np.random.Generator(np.random.Philox(key=3))
    elements = cube("hexahedra", n=6, parts=7, jitter=0.25, seed=4)
    target = elements.points[rng.integers(0, len(elements.points), 4000)]
    origin = 0.5 + 3.0 * (d := rng.normal(size=target.shape)) / np.linalg.norm(d, axis=1, keepdims=True)
    batch = rays(origin, target)
    chord, _ = in_cube(batch)
    for found in chords(elements, batch):
        np.testing.assert_allclose(found, chord, atol=1.5e-6)


def test_the_first_entry_is_the_hit_that_embree_finds():
    elements = cube("mixed", n=4, parts=1, jitter=0.2)
    rng = np.random.Generator(np.random.Philox(key=9))
    kept = np.flatnonzero(rng.random(elements.count) < 0.4)  # a porous body
    first = elements.first[kept]
    ragged = mesh(
        elements.points, [elements.corners[f : f + k] for f, k in zip(first, elements.kind[kept], strict=True)]
    )
    origin = 0.5 + 3.0 * (d := rng.normal(size=(3000, 3))) / np.linalg.norm(d, axis=1, keepdims=True)
    batch = rays(origin, rng.uniform(0.0, 1.0, (3000, 3)))
    shell = boundary(ragged)
    hits = embree.Geometry(ragged.points, shell.faces).nearest(batch["origin"], batch["direction"], batch["reach"])
    found, _ = march(ragged, batch)
    rows, at = np.unique(found.row, return_index=True)
    assert rows.tolist() == np.flatnonzero(np.isfinite(hits.t)).tolist()
    np.testing.assert_allclose(found.entry[at], hits.t[rows], atol=1e-5)
    assert found.segments.max() > 2


def test_rays_that_are_none_meet_nothing():
    batch = hard_rays(3, 3)
    batch["direction"][::3] = 0.0
    batch["direction"][1::3, 1] = np.nan
    batch["origin"][2::3, 2] = np.inf
    found, _ = march(cube("mixed"), batch)
    assert found.elements.tolist() == [0] * len(batch["reach"])
    batch["origin"][2::3, 2] = 1e30
    assert march(cube("mixed"), batch)[0].elements[0] == 0


def test_rows_may_come_in_any_number_and_order():
    elements, batch = cube("mixed", parts=2, jitter=0.1), hard_rays(3, 20)
    once, row_ray = march(elements, batch)
    rng = np.random.Generator(np.random.Philox(key=2))
    rows = rng.integers(0, len(row_ray), embree.CHUNK + 100)
    many = march_parts(elements, batch, row_ray[rows], (rows % 2).astype(np.int32))
    assert many.elements.tolist() == once.elements[rows].tolist()
    start = np.searchsorted(once.row, np.arange(len(row_ray) + 1))
    counts = np.diff(start)[rows]
    pick = np.repeat(start[rows] - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())
    assert many.row.tolist() == np.repeat(np.arange(len(rows)), counts).tolist()
    assert (many.rgba == once.rgba[pick]).all()
    assert (many.entry == once.entry[pick]).all()
    none = march_parts(elements, batch, np.zeros(0, np.int64), np.zeros(0, np.int32))
    assert len(none.row) == len(none.elements) == 0


def test_a_part_without_elements_has_nothing_to_enter():
    points, hexes = lattice(1)
    found, _ = march(mesh(points, hexes, [2]), rays([-1, 0.5, 0.4], [0, 0.5, 0.4]))
    assert found.segments.tolist() == [0, 0, 1]
