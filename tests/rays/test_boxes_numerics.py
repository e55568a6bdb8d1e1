"""Rays against boxes: against a plain search, walk against hierarchy, and nothing lost that Embree hits."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.boxes import SLACK, Entered, enter_boxes, walk_grid


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=seed))


def ray(origin, direction, reach=np.inf):
    return np.array([origin], np.float32), np.array([direction], np.float32), np.array([reach], np.float32)


def rows(found: Entered, i: int = 0) -> dict[int, float]:
    mine = slice(found.first[i], found.first[i + 1])
    return dict(zip(found.domain[mine].tolist(), found.entry[mine].tolist(), strict=True))


def cells(planes):
    """The boxes of a grid's cells, x fastest."""
    x, y, z = (np.asarray(p, np.float32) for p in planes)
    k, j, i = (a.ravel() for a in np.meshgrid(*(np.arange(len(p) - 1) for p in (z, y, x)), indexing="ij"))
    return np.stack([x[i], y[j], z[k]], 1), np.stack([x[i + 1], y[j + 1], z[k + 1]], 1)


def random_boxes(rng, count):
    low = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    return low, low + rng.uniform(0.05, 1, (count, 3)).astype(np.float32)


def random_rays(rng, n):
    origin = rng.uniform(-2, 2, (n, 3)).astype(np.float32)
    direction = (rng.uniform(-1, 1.5, (n, 3)) - origin).astype(np.float32)
    direction[rng.random((n, 3)) < 0.2] = 0.0
    direction[rng.random((n, 3)) < 0.1] *= np.float32(-1e-6)
    direction[(direction == 0).all(axis=1)] = (0.0, -0.0, 1.0)
    reach = np.where(rng.random(n) < 0.5, np.inf, rng.uniform(0, 3, n)).astype(np.float32)
    return origin, direction, reach


def hard_rays(planes, rng):
    """Rays in faces, along edges, through corners, parallel to axes, diagonal; from outside, inside and on planes."""
    axes = [np.asarray(p, np.float32) for p in planes]
    corner = np.stack([rng.choice(p, 600) for p in axes], 1)
    anywhere = np.stack([rng.uniform(p[0] - 1, p[-1] + 1, 600) for p in axes], 1).astype(np.float32)
    on = np.where(rng.random((600, 3)) < 0.6, corner, anywhere)
    steps = rng.choice(np.array([-1.0, -0.0, 0.0, 1.0], np.float32), (600, 3))
    steps[(steps == 0).all(axis=1)] = (1.0, 0.0, -0.0)
    along = np.concatenate([steps, (corner - anywhere), (corner[::-1] - corner) + np.float32(1e-30)])
    start = np.concatenate([on, anywhere, corner])
    start[:200] -= 4 * steps[:200]
    reach = np.where(rng.random(len(start)) < 0.7, np.inf, 1.0).astype(np.float32)
    return start, along.astype(np.float32), reach


def same(a: Entered, b: Entered) -> bool:
    return all(np.array_equal(getattr(a, c), getattr(b, c)) for c in ("first", "domain", "entry"))


def plain_search(origin, direction, reach, low, high, slack):
    """Entry of each ray into each box grown by a slack, in float64; NaN where it does not enter."""
    o, d = origin.astype(np.float64)[:, None], direction.astype(np.float64)[:, None]
    grow = slack * np.maximum(np.abs(low - o), np.abs(high - o)).max(axis=2, keepdims=True)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - grow - o) / d, (high + grow - o) / d
    inside = (low - grow <= o) & (o <= high + grow)
    a, b = np.minimum(a, b), np.maximum(a, b)
    a = np.where(d == 0, np.where(inside, -np.inf, np.inf), a)
    b = np.where(d == 0, np.where(inside, np.inf, -np.inf), b)
    near, far = np.maximum(a.max(axis=2), 0.0), np.minimum(b.min(axis=2), reach.astype(np.float64)[:, None])
    return np.where(near <= far, near, np.nan)


@pytest.mark.parametrize("count", [1, 4, 5, 33, 300])
def test_every_box_that_a_plain_search_enters_is_found_and_none_that_is_farther_than_the_slack(count):
    rng = generator(count)
    low, high = random_boxes(rng, count)
    origin, direction, reach = random_rays(rng, 8000)
    found = enter_boxes(origin, direction, reach, low, high)
    entered = np.full((len(reach), count), np.nan)
    entered[np.repeat(np.arange(len(reach)), np.diff(found.first)), found.domain] = found.entry
    exact = plain_search(origin, direction, reach, low, high, 0.0)
    generous = plain_search(origin, direction, reach, low, high, SLACK * (1 + 1e-9))
    assert np.isfinite(exact).sum() > 50
    assert np.isfinite(entered[np.isfinite(exact)]).all()
    assert np.isfinite(generous[np.isfinite(entered)]).all()
    both = np.isfinite(exact)
    assert (entered[both] <= np.nextafter(exact[both].astype(np.float32), np.float32(np.inf))).all()
    assert (entered[both] >= generous[both] * (1 - 1e-6)).all()


def test_rows_are_front_to_back_and_ties_in_order_of_the_domain():
    rng = generator(1)
    low, high = random_boxes(rng, 500)
    low[::7], high[::7] = -3.0, 3.0  # holds every origin
    found = enter_boxes(*random_rays(rng, 3000), low, high)
    key = found.entry.astype(np.float64), found.domain
    ray_of_row = np.repeat(np.arange(3000), np.diff(found.first))
    assert (np.lexsort((key[1], key[0], ray_of_row)) == np.arange(len(found.domain))).all()
    assert found.first[0] == 0
    assert found.first[-1] == len(found.domain) == len(found.entry)
    assert (found.first.dtype, found.domain.dtype, found.entry.dtype) == (np.int64, np.int16, np.float32)
    assert np.diff(found.first).max() > 72


@pytest.mark.parametrize(
    "planes",
    [
        ([0, 1], [0, 1], [0, 1]),
        ([0, 1, 2, 3, 4], [0, 1, 2, 3], [0, 1, 2]),
        ([-2, -1, -0.1, 0.0, 0.3, 5], [0, 1e-3, 1], [-1e3, 0, 1e3]),
        ([0, 1, 1, 1, 2], [3, 3, 4], [0, 0]),  # flat cells, a flat grid
        ([0, 1e-9, 1e6], [0, 1, 2], [0, 0.5, 1]),
        ([1e6, 1e6 + 1, 1e6 + 2], [1e6, 1e6 + 1], [-1e6, -1e6 + 1]),
        ([0, 1e-6, 2e-6, 3e-6], [0, 1e-6, 2e-6], [0, 1e-6]),
    ],
)
def test_the_walk_enters_what_the_hierarchy_enters(planes):
    planes = tuple(np.array(p, np.float64) for p in planes)
    rng = generator(7)
    size = np.float32(max(p[-1] - p[0] for p in planes))
    middle = np.array([0.5 * (p[0] + p[-1]) for p in planes], np.float32)
    origin, direction, reach = random_rays(rng, 2000)
    boxes = cells(planes)
    for rays in ((origin * size + middle, direction, reach * size), hard_rays(planes, rng)):
        assert same(walk_grid(*rays, planes), enter_boxes(*rays, *boxes))


@given(st.integers(0, 2**32), st.tuples(*[st.integers(1, 7)] * 3), st.sampled_from([0.0, 1e3, -1e6]))
@settings(max_examples=60, deadline=None)
def test_the_walk_enters_what_the_hierarchy_enters_in_any_grid(seed, shape, shift):
    rng = generator(seed)
    # Rounded, so that planes coincide now and then and rays that step by whole numbers run in them.
    planes = tuple(np.sort(np.round(rng.uniform(0, 8, n + 1), int(rng.integers(0, 3)))) + shift for n in shape)
    rays = hard_rays(planes, rng)
    found = walk_grid(*rays, planes)
    assert same(found, enter_boxes(*rays, *cells(planes)))
    assert len(found.domain) > 0


def test_a_ray_in_a_face_or_an_edge_visits_all_cells_that_touch_it():
    planes = ([0, 1, 2], [0, 1, 2], [0, 1, 2])
    found = rows(walk_grid(*ray((-1, 1, 0.5), (1, 0, 0)), planes))
    assert found == pytest.approx({0: 1, 1: 2, 2: 1, 3: 2}, rel=1e-5)
    assert max(found.values()) < 2  # generous, so never beyond the face
    assert len(rows(walk_grid(*ray((-1, 1, 1), (1, -0.0, 0)), planes))) == 8
    assert sorted(rows(walk_grid(*ray((0.5, 0.5, 2), (1, 0, 0)), planes))) == [4, 5]  # in the grid's own face
    assert rows(walk_grid(*ray((0.5, 0.5, 2.01), (1, 0, 0)), planes)) == {}


def test_a_diagonal_through_a_corner_visits_the_cells_all_around():
    planes = ([0, 1, 2], [0, 1, 2], [0, 1, 2])
    found = walk_grid(*ray((-1, -1, -1), (1, 1, 1)), planes)
    assert found.domain.tolist()[0] == 0
    assert sorted(found.domain.tolist()) == list(range(8))
    assert found.entry[0] == pytest.approx(1, rel=1e-5)
    assert found.entry[1:] == pytest.approx([2] * 7, rel=1e-5)


def test_starting_inside_on_a_face_or_behind():
    low, high = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    for origin in ((0.5, 0.5, 0.5), (1, 0.5, 0.5), (0, 0, 0)):
        for direction in ((1, 0, 0), (-1, 0, 0), (0.5, 0.5, -0.7)):
            assert rows(enter_boxes(*ray(origin, direction), low, high)) == {0: 0.0}
    assert rows(enter_boxes(*ray((1.1, 0.5, 0.5), (1, 0, 0)), low, high)) == {}
    assert list(rows(enter_boxes(*ray((1.1, 0.5, 0.5), (-1, 0, 0)), low, high))) == [0]


def test_reach_is_closed_and_distances_are_in_lengths_of_the_direction():
    low, high = np.ones((1, 3), np.float32), np.full((1, 3), 2, np.float32)
    assert list(rows(enter_boxes(*ray((0, 1.5, 1.5), (1, 0, 0), 1.0), low, high))) == [0]
    assert rows(enter_boxes(*ray((0, 1.5, 1.5), (1, 0, 0), 0.9999), low, high)) == {}
    assert rows(enter_boxes(*ray((0, 1.5, 1.5), (4, 0, 0), 0.25), low, high)) == {0: pytest.approx(0.25, rel=1e-5)}


def test_empty_boxes_are_never_entered_and_flat_ones_are():
    low = np.array([[np.inf] * 3, [0, 0, 1], [np.inf] * 3, [1, 1, 1]], np.float32)
    high = np.array([[-np.inf] * 3, [2, 2, 1], [-np.inf] * 3, [1, 1, 1]], np.float32)
    assert list(rows(enter_boxes(*ray((1, 1, 0), (0, 0, 1)), low, high))) == [1, 3]
    assert list(rows(enter_boxes(*ray((0.5, 1, 0), (0, 0, 1)), low, high))) == [1]
    assert rows(enter_boxes(*ray((0.5, 1, 0), (0, 0, 1)), low[::2], high[::2])) == {}


def test_no_rays_or_no_boxes_give_no_rows():
    none = np.zeros((0, 3), np.float32)
    box = np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    assert enter_boxes(none, none, np.zeros(0, np.float32), *box).first.tolist() == [0]
    assert enter_boxes(*ray((0, 0, 0), (1, 0, 0)), none, none).first.tolist() == [0, 0]


def test_the_result_does_not_depend_on_how_rays_are_batched():
    rng = generator(3)
    low, high = random_boxes(rng, 40)
    n = embree.CHUNK + 500
    origin, direction, reach = random_rays(rng, n)
    whole = enter_boxes(origin, direction, reach, low, high)
    for part in (slice(0, 700), slice(embree.CHUNK - 300, embree.CHUNK + 300)):
        found = enter_boxes(origin[part], direction[part], reach[part], low, high)
        mine = slice(whole.first[part.start], whole.first[part.stop])
        assert np.array_equal(found.domain, whole.domain[mine])
        assert np.array_equal(found.entry, whole.entry[mine])


def test_doubling_all_lengths_doubles_all_entries_and_changes_nothing_else():
    rng = generator(4)
    low, high = random_boxes(rng, 60)
    origin, direction, reach = random_rays(rng, 1000)
    one = enter_boxes(origin, direction, reach, low, high)
    for factor in (np.float32(2.0**20), np.float32(2.0**-20)):
        other = enter_boxes(origin * factor, direction, reach * factor, low * factor, high * factor)
        assert np.array_equal(one.domain, other.domain)
        assert np.array_equal(one.entry * factor, other.entry)


@pytest.mark.parametrize("dims", [(4, 4, 4), (7, 3, 5)])
def test_ties_of_deeply_overlapping_boxes_are_sorted(dims):
    count = int(np.prod(dims)) * 20
    size = np.arange(count, 0, -1, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    found = enter_boxes(*ray((-2000, 0.1, 0.2), (1, 0, 0)), -size, size)
    assert found.domain.tolist() == list(range(count))  # nested: the outermost first
    assert enter_boxes(*ray((0, 0, 0), (1, 0, 0)), -size, size).domain.tolist() == list(range(count))


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-6, 0.0), (1.0, 1e6), (1e4, -3.0)])
def test_nothing_is_missed_that_embree_hits(scale, shift):
    """Rays at vertices, at edges, along edges, grazing, parallel to axes, and random, against tight boxes."""
    rng = generator(11)
    parts, each = 24, 40
    corner = rng.uniform(-1, 1, (parts, each, 1, 3)) + rng.uniform(-0.3, 0.3, (parts, each, 3, 3))
    corner[:8] = np.round(corner[:8] * 8) / 8  # many triangles in planes of the boxes
    corner[:4, :, :, 2] = corner[:4, :1, :1, 2]  # flat parts
    corner = (corner * scale + shift).astype(np.float32)
    low, high = corner.min(axis=(1, 2)), corner.max(axis=(1, 2))

    target = corner.reshape(-1, 3, 3).astype(np.float64)
    mix = rng.dirichlet((0.3, 0.3, 0.3), len(target))
    aims = [target[:, 0], 0.5 * (target[:, 0] + target[:, 1]), np.einsum("nk,nkj->nj", mix, target)]
    eye = rng.uniform(-2, 2, (3, len(target), 3)) * scale + shift
    eye[1, ::2] = target[::2, 1] + 2 * (target[::2, 1] - target[::2, 0])  # along an edge
    eye[0, ::3, :2] = target[::3, 0, :2]  # parallel to z
    eye[2, ::4] = target[::4].mean(axis=1)[:, [1, 0, 2]]
    eye[2, ::5] += 100 * scale
    origin = eye.reshape(-1, 3).astype(np.float32)
    direction = (np.concatenate(aims) - origin).astype(np.float32)
    length = np.linalg.norm(direction, axis=1)
    origin, direction = origin[length > 0], (direction / np.maximum(length, 1e-38)[:, None])[length > 0]
    reach = np.full(len(origin), np.inf, np.float32)
    reach[::2] = length[length > 0][::2]

    found = enter_boxes(origin, direction, reach, low, high)
    entry = np.full((len(reach), parts), np.nan)
    entry[np.repeat(np.arange(len(reach)), np.diff(found.first)), found.domain] = found.entry
    hits = 0
    for part in range(parts):
        geometry = embree.Geometry(corner[part].reshape(-1, 3), np.arange(3 * each, dtype=np.int32).reshape(-1, 3))
        nearest = geometry.nearest(origin, direction, reach)
        hit = np.flatnonzero(np.isfinite(nearest.t))
        assert np.isfinite(entry[hit, part]).all()
        a, b, c = np.moveaxis(corner[part][nearest.primitive[hit]].astype(np.float64), 1, 0)
        normal = np.cross(b - a, c - a)
        normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
        cosine = np.abs((normal * direction[hit]).sum(axis=1))
        hit = hit[cosine > 1e-5]  # seen edge on, Embree's distance can be anything
        assert (entry[hit, part] <= nearest.t[hit]).all()
        hits += len(hit)
    assert hits > 4000


def test_too_many_domains_and_planes_out_of_order_are_refused():
    many = np.zeros((40_000, 3), np.float32)
    with pytest.raises(SceneError, match=r"^40000 domains are too many: at most 32767 can be told apart"):
        enter_boxes(*ray((0, 0, 0), (1, 0, 0)), many, many)
    with pytest.raises(SceneError, match=r"^64000 domains are too many"):
        walk_grid(*ray((0, 0, 0), (1, 0, 0)), (np.arange(41),) * 3)
    with pytest.raises(SceneError, match=r"the grid's y planes must be two or more in ascending order, got \[0.0, 2.0"):
        walk_grid(*ray((0, 0, 0), (1, 0, 0)), ([0, 1], [0, 2, 1], [0, 1]))
