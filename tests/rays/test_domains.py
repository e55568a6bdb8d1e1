"""Spatial partitions: bricks, SAH parts and grids by hand and by invariant; SpRay's own z-order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simrender.errors import SceneError, SceneWarning
from simrender.rays.domains import (
    Domains,
    balanced_grid,
    block_ranks,
    cell_of,
    from_bricks,
    from_instances,
    from_objects,
    from_primitives,
    from_triangles,
    ghost_bytes,
    instance_boxes,
    kd_bricks,
    morton_ranks,
    rectilinear,
    round_robin,
    sah_parts,
    triangle_boxes,
    uniform_grid,
)
from simrender.rays.partition import Footprint, Published
from simrender.rays.scene import Scene, SceneObject, Triangles
from simrender.rays.volume import TransferFunction, Volume
from tests.scenes import MATERIALS, floor, garden, garden_workload, placed, sphere


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(key=seed))


def soup(corners) -> Triangles:
    """Triangles that share no vertex, from corners (t, 3, 3)."""
    corners = np.asarray(corners, np.float32)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return Triangles(corners.reshape(-1, 3), faces, np.zeros(len(corners), np.int32))


def random_soup(seed: int, count: int, flat: bool = False) -> Triangles:
    rng = generator(seed)
    corners = rng.uniform(-10, 10, (count, 1, 3)) + rng.uniform(-0.5, 0.5, (count, 3, 3))
    corners[:, :, 2] *= 0.0 if flat else 1.0
    return soup(corners)


def check(domains: Domains, triangles: Triangles, total_bytes: float, total_primitives: float) -> None:
    """Every triangle lies in exactly one domain and in its box, and nothing is lost or made up."""
    owner = domains.domain_of_triangle
    assert owner.shape == (len(triangles.faces),)
    assert owner.min() >= 0
    assert owner.max() < domains.count
    low, high = triangle_boxes(triangles)
    assert (domains.low[owner] <= low).all()
    assert (domains.high[owner] >= high).all()
    assert domains.bytes.sum() == pytest.approx(total_bytes)
    assert domains.primitives.sum() == pytest.approx(total_primitives)
    counts = np.bincount(owner, minlength=domains.count)
    assert domains.primitives == pytest.approx(counts * (total_primitives / counts.sum()))
    assert np.isinf(domains.low[counts == 0]).all()
    assert (domains.low[counts == 0] > domains.high[counts == 0]).all()


# Bricks of a volume


def test_a_kd_tree_splits_the_longest_axis_in_the_middle():
    assert kd_bricks((129, 65, 65), 4).tolist() == [
        [0, 32, 0, 64, 0, 64],
        [32, 64, 0, 64, 0, 64],
        [64, 96, 0, 64, 0, 64],
        [96, 128, 0, 64, 0, 64],
    ]
    corners = kd_bricks((65, 65, 65), 8)[:, ::2] // 32  # of equal axes the lower one first: z varies fastest
    assert corners.tolist() == [[a, b, c] for a in (0, 1) for b in (0, 1) for c in (0, 1)]


def test_a_count_that_is_no_power_of_two_splits_in_proportion():
    # Two of three bricks left of the plane: 64 * 2/3 = 42.7, and 40 is the nearest multiple of 8.
    assert kd_bricks((65, 65, 65), 3).tolist() == [
        [0, 40, 0, 32, 0, 64],
        [0, 40, 32, 64, 0, 64],
        [40, 64, 0, 64, 0, 64],
    ]


def test_one_brick_is_the_volume_and_the_last_macro_cell_may_be_smaller():
    assert kd_bricks((20, 5, 2), 1).tolist() == [[0, 19, 0, 4, 0, 1]]
    assert kd_bricks((20, 5, 2), 3)[:, :2].tolist() == [[0, 8], [8, 16], [16, 19]]


@given(st.tuples(*[st.integers(2, 44)] * 3), st.integers(1, 300), st.sampled_from([4, 8]))
@settings(max_examples=80, deadline=None)
def test_every_cell_lies_in_exactly_one_brick(dims, count, macro):
    most = int(np.prod([-(-(n - 1) // macro) for n in dims]))
    bricks = kd_bricks(dims, min(count, most), macro)
    assert bricks.shape == (min(count, most), 6)
    assert bricks.dtype == np.int32
    owners = np.zeros([n - 1 for n in dims], int)
    for x0, x1, y0, y1, z0, z1 in bricks:
        assert x0 < x1
        assert y0 < y1
        assert z0 < z1
        owners[x0:x1, y0:y1, z0:z1] += 1
    assert (owners == 1).all()
    assert (bricks[:, ::2] % macro == 0).all()
    ends = bricks[:, 1::2]
    assert ((ends % macro == 0) | (ends == np.array(dims) - 1)).all()


@given(st.integers(1, 64))
@settings(max_examples=64, deadline=None)
def test_bricks_hold_about_the_same(count):
    bricks = kd_bricks((1025, 769, 513), count)
    size = np.diff(bricks.reshape(-1, 3, 2).astype(float), axis=2).prod(axis=(1, 2))
    assert size.max() < 1.35 * size.min()
    if count & (count - 1) == 0:
        assert size.max() == pytest.approx(size.min(), rel=0.01)


def test_more_bricks_than_macro_cells_are_refused_with_the_most_that_go():
    message = (
        r"^a volume of 33 x 17 x 9 voxels cannot be cut into 9 bricks: their faces lie on multiples of 8 cells, "
        r"which allows 1 to 8; ask for fewer bricks or trace a larger volume$"
    )
    with pytest.raises(SceneError, match=message):
        kd_bricks((33, 17, 9), 9)
    with pytest.raises(SceneError, match="cannot be cut into 0 bricks"):
        kd_bricks((33, 17, 9), 0)
    assert len(kd_bricks((33, 17, 9), 8)) == 8


def test_ghost_layers_lie_where_the_volume_goes_on():
    dims = (25, 9, 9)
    assert ghost_bytes(kd_bricks(dims, 1), dims).tolist() == [25 * 9 * 9 * 4]
    # Voxels 0..8 and a layer on the right; 8..16 and two layers; 16..24 and one on the left.
    assert ghost_bytes(kd_bricks(dims, 3), dims).tolist() == [10 * 81 * 4, 11 * 81 * 4, 10 * 81 * 4]
    assert ghost_bytes(kd_bricks(dims, 3), dims, bytes_per_voxel=1).tolist() == [10 * 81, 11 * 81, 10 * 81]


def test_bricks_weigh_what_they_weigh_in_the_published_volume():
    traced, published = (65, 33, 33), (10240, 7680, 1536)
    whole = ghost_bytes(kd_bricks(traced, 1), traced, published)
    assert whole == pytest.approx([10240 * 7680 * 1536 * 4.0])
    cut = ghost_bytes(kd_bricks(traced, 2), traced, published)
    assert cut == pytest.approx([(10239 / 2 + 2) * 7680 * 1536 * 4] * 2)


def test_brick_boxes_hold_their_cells_and_their_cells_add_up():
    ramp = TransferFunction([0.0, 1.0], [[0, 0, 0], [1, 1, 1]], [0.0, 0.5])
    volume = Volume(np.zeros((17, 33, 49), np.float32), (0.1, 0.2, 0.3), (1e6, -7.1, 0.3), ramp)
    cells = kd_bricks(volume.dims, 6)
    domains = from_bricks(volume, cells, (480, 320, 160), 1.0)
    spacing, origin = np.array(volume.spacing, float), np.array(volume.origin, float)
    assert (domains.low <= origin + cells[:, ::2] * spacing).all()
    assert (domains.high >= origin + cells[:, 1::2] * spacing).all()
    assert domains.low == pytest.approx(origin + cells[:, ::2] * spacing, rel=2e-7)
    assert domains.primitives.sum() == pytest.approx(479 * 319 * 159)
    assert domains.bytes == pytest.approx(ghost_bytes(cells, volume.dims, (480, 320, 160), 1.0))
    assert domains.cells is cells
    assert domains.count == 6


# Parts of a surface


def test_sah_separates_two_clusters():
    rng = generator(1)
    left, right = rng.uniform(0, 1, (30, 3)), rng.uniform((9, 0, 0), (10, 1, 1), (50, 3))
    centre = np.concatenate([left, right])[np.argsort(rng.random(80))].astype(np.float32)
    part = sah_parts(centre - np.float32(0.1), centre + np.float32(0.1), 2)
    assert (part == (centre[:, 0] > 5)).all()


def test_sah_takes_the_cheapest_of_all_planes():
    rng = generator(2)
    centre = rng.normal(size=(60, 3)) * (3, 2, 1)
    half = rng.uniform(0, 0.8, (60, 3))
    low, high = (centre - half).astype(np.float32), (centre + half).astype(np.float32)
    weight = rng.uniform(1, 5, 60)

    def cost(chosen):
        x, y, z = (high[chosen].max(axis=0) - low[chosen].min(axis=0)).astype(float)
        return (x * y + y * z + z * x) * weight[chosen].sum()

    bins, middle = 16, 0.5 * (low.astype(float) + high)
    best = np.inf
    for axis in range(3):
        at = middle[:, axis]
        place = np.minimum(((at - at.min()) * (bins / np.ptp(at))).astype(int), bins - 1)
        for plane in range(bins - 1):
            if (place <= plane).any() and (place > plane).any():
                best = min(best, cost(place <= plane) + cost(place > plane))
    part = sah_parts(low, high, 2, weight, bins)
    assert cost(part == 0) + cost(part == 1) == pytest.approx(best)


def test_the_costliest_part_is_split_next():
    # Three pairs on a line: the wide one costs most once the far one is split off.
    x = np.array([0, 1, 4, 8, 100, 100.5], np.float32)
    low = np.stack([x, 0 * x, 0 * x], 1)
    part = sah_parts(low, low + np.float32(0.1), 3)
    assert part[4] == part[5] == 1
    assert part[0] == part[1] == 0
    assert part[3] == 2
    assert sah_parts(low, low + np.float32(0.1), 6).tolist() != part.tolist()
    assert len(np.unique(sah_parts(low, low + np.float32(0.1), 6))) == 6


def test_heavy_instances_cost_more_and_are_parted_first():
    x = np.arange(8, dtype=np.float32)
    low = np.stack([x, 0 * x, 0 * x], 1)
    even = sah_parts(low, low + np.float32(1), 2)
    assert even.tolist() == [0] * 4 + [1] * 4
    uneven = sah_parts(low, low + np.float32(1), 2, weight=np.where(x == 0, 100.0, 1.0))
    assert uneven.tolist() == [0] + [1] * 7


def test_a_split_that_would_leave_an_empty_part_is_not_made():
    low = np.zeros((5, 3), np.float32)
    low[4] = 1
    with pytest.warns(SceneWarning, match=r"makes 2 parts of 5 primitives and not 4: one more split would leave an"):
        part = sah_parts(low, low + np.float32(1), 4)
    assert part.tolist() == [0, 0, 0, 0, 1]


def test_a_single_triangle_makes_one_part_and_the_other_domains_stay_empty():
    one = random_soup(1, 1)
    with pytest.warns(SceneWarning, match="makes 1 parts of 1 primitives and not 3"):
        part = sah_parts(*triangle_boxes(one), 3)
    check(from_triangles(one, part, 3, 90.0, 7.0), one, 90.0, 7.0)


@given(st.integers(0, 2**32), st.integers(20, 400), st.integers(1, 20), st.booleans())
@settings(max_examples=40, deadline=None)
def test_sah_parts_hold_every_triangle_once(seed, count, parts, flat):
    triangles = random_soup(seed, count, flat)
    part = sah_parts(*triangle_boxes(triangles), parts)
    assert sorted(set(part.tolist())) == list(range(parts))
    check(from_triangles(triangles, part, parts, 1e9, 1e6), triangles, 1e9, 1e6)


def test_sah_parts_depend_on_neither_order_nor_run():
    low, high = triangle_boxes(random_soup(5, 3000))
    shuffle = np.argsort(generator(6).random(3000))
    part = sah_parts(low, high, 13)
    assert (sah_parts(low, high, 13) == part).all()
    assert (sah_parts(low[shuffle], high[shuffle], 13) == part[shuffle]).all()


def test_points_on_a_line_are_parted_evenly():
    # Boxes without area all cost nothing; then the split that is even in weight is taken.
    low = np.zeros((64, 3), np.float32)
    low[:, 1] = np.arange(64)
    assert np.bincount(sah_parts(low, low, 2)).tolist() == [32, 32]


def test_instances_stay_whole_and_their_objects_are_held_wherever_they_are_needed():
    ball, plate = SceneObject("ball", (sphere(rings=5),)), floor()
    offsets = np.array([[0, 0, 0], [-50, 0, 0], [50, 0, 0], [60, 0, 0]])
    scene = Scene((plate, ball), np.array([0, 1, 1, 1]), placed(offsets, np.ones(4)), MATERIALS)
    low, high = instance_boxes(scene)
    assert low[1] == pytest.approx([-51, -1, -1], abs=0.2)
    sizes = np.array([thing.triangles for thing in scene.objects])
    part = np.array([0, 0, 1, 1], np.int32)
    published = Published(scene.unique_triangles * 10.0, 4 * 5.0, scene.instanced_triangles * 50.0, 3e6, 1e6)
    domains = from_instances(scene, part, 3, published, Footprint(50.0, 400.0))
    each = 4e6 / published.triangles + 50
    held = np.array([sizes[0] + sizes[1], sizes[1], 0]) * 10
    assert domains.bytes == pytest.approx(held * each + np.array([2, 2, 0]) * 5 * 400)
    assert domains.primitives == pytest.approx(np.array([sizes.sum(), 2 * sizes[1], 0]) * 50)
    assert (domains.domain_of_triangle == np.repeat(part, sizes[scene.instance_object])).all()
    assert domains.low[0] == pytest.approx(low[:2].min(axis=0))
    assert domains.low[2].tolist() == [np.inf] * 3
    whole = sah_parts(low, high, 2, sizes[scene.instance_object].astype(float))
    assert whole.shape == (4,)
    assert whole[2] == whole[3]


def test_an_object_partition_has_boxes_like_any_other(tmp_path):
    workload = garden_workload(cache=tmp_path)
    partition = workload.partition(4, Footprint(50.0, 400.0), "heaviest_first", 0.1)
    scene = garden()
    domains = from_objects(scene, partition)
    check(domains, scene.triangles, partition.weight_bytes.sum(), scene.instanced_triangles)
    assert domains.bytes is partition.weight_bytes
    assert (domains.domain_of_triangle == partition.domain_of_mesh[scene.triangles.mesh]).all()


def test_any_primitives_can_be_described():
    low = np.array([[0, 0, 0], [1, 0, 0], [5, 5, 5]], np.float32)
    domains = from_primitives(low, low + np.float32(1), np.array([0, 0, 2], np.int32), 3, 300.0, 30.0)
    assert domains.low.tolist() == [[0, 0, 0], [np.inf] * 3, [5, 5, 5]]
    assert domains.high.tolist() == [[2, 1, 1], [-np.inf] * 3, [6, 6, 6]]
    assert domains.bytes == pytest.approx([200, 0, 100])
    assert domains.primitives == pytest.approx([20, 0, 10])


# Rectilinear grids


def test_a_uniform_grid_numbers_its_cells_along_x_first():
    planes = uniform_grid((0, 0, 0), (4, 2, 3), (4, 2, 3))
    assert [p.tolist() for p in planes] == [[0, 1, 2, 3, 4], [0, 1, 2], [0, 1, 2, 3]]
    assert cell_of(planes, [[0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [0.5, 1.5, 0.5], [0.5, 0.5, 1.5]]).tolist() == [
        0,
        1,
        4,
        8,
    ]
    assert cell_of(planes, [[1, 1, 1], [4, 2, 3], [-9, -9, -9], [9, 9, 9]]).tolist() == [13, 23, 0, 23]


def test_a_balanced_grid_cuts_at_equal_shares_of_the_weight():
    x = np.array([0, 1, 2, 3, 10, 20, 30, 100.0])
    positions = np.stack([x, x[::-1], 0 * x], 1)
    planes = balanced_grid(positions, (4, 2, 1))
    assert planes[0].tolist() == [0, 1.5, 6.5, 25, 100]
    assert planes[1].tolist() == [0, 6.5, 100]
    assert planes[2].tolist() == [0, 0]
    heavy = balanced_grid(positions, (2, 1, 1), weight=np.where(x == 0, 100.0, 1.0), bounds=((-1, 0, -2), (200, 99, 5)))
    assert [p.tolist() for p in heavy] == [[-1, 0.5, 200], [0, 99], [-2, 5]]


@given(st.integers(0, 2**32), st.tuples(*[st.integers(1, 6)] * 3))
@settings(max_examples=40, deadline=None)
def test_slabs_of_a_balanced_grid_hold_the_same(seed, shape):
    positions = generator(seed).normal(size=(720, 3)) ** 3
    planes = balanced_grid(positions, shape)
    index = np.unravel_index(cell_of(planes, positions), shape[::-1])[::-1]
    for axis, n in enumerate(shape):
        counts = np.bincount(index[axis], minlength=n)
        assert counts.max() - counts.min() <= 1


def test_triangles_that_stay_inside_their_cells_keep_the_grid():
    planes = uniform_grid((0, 0, 0), (2, 2, 2), (2, 2, 2))
    corner = np.array(np.unravel_index(np.arange(8), (2, 2, 2))[::-1]).T
    inside = np.array([[0, 0, 0], [1, 0.5, 0], [0, 0.5, 1]]) + corner[:, None]
    domains = rectilinear(soup(inside), planes, 80.0, 8.0)
    assert domains.planes is planes
    assert domains.domain_of_triangle.tolist() == list(range(8))
    assert domains.low.tolist() == corner.tolist()
    assert domains.high.tolist() == (corner + 1).tolist()
    assert domains.bytes.tolist() == [10.0] * 8
    check(domains, soup(inside), 80.0, 8.0)


def test_triangles_that_reach_out_or_cells_that_are_empty_take_the_triangles_boxes():
    planes = uniform_grid((0, 0, 0), (2, 2, 2), (2, 1, 1))
    reaching = soup([[[0.8, 0, 0], [1.1, 1, 1], [0.8, 2, 0]], [[1.5, 1, 1], [1.6, 1, 1], [1.5, 1.2, 1]]])
    domains = rectilinear(reaching, planes, 2.0, 2.0)
    assert domains.planes is None
    assert domains.domain_of_triangle.tolist() == [0, 1]
    assert domains.high[0, 0] == np.float32(1.1)
    check(domains, reaching, 2.0, 2.0)
    lonely = soup([[[1.5, 1, 1], [1.6, 1, 1], [1.5, 1.2, 1]]])
    domains = rectilinear(lonely, planes, 2.0, 2.0)
    assert domains.planes is None
    check(domains, lonely, 2.0, 2.0)


@given(st.integers(0, 2**32), st.integers(1, 300), st.tuples(*[st.integers(1, 5)] * 3), st.booleans())
@settings(max_examples=40, deadline=None)
def test_grid_cells_hold_every_triangle_once(seed, count, shape, flat):
    triangles = random_soup(seed, count, flat)
    low, high = triangle_boxes(triangles)
    for planes in (uniform_grid(low.min(axis=0), high.max(axis=0), shape), balanced_grid(0.5 * (low + high), shape)):
        check(rectilinear(triangles, planes, 5e9, 1e7), triangles, 5e9, 1e7)


# Ranks

SPRAY_Z_ORDER = {
    2: "0011001100110011" * 4,
    4: "0022002211331133" * 4,
    8: "0044004422662266" * 2 + "1155115533773377" * 2,
    16: "0189018945cd45cd" * 2 + "23ab23ab67ef67ef" * 2,
}
"""Rank of each of the 64 domains of SpRay's example scene, recorded from the program with its matrix repaired."""


def spray_boxes():
    d = np.arange(64)
    translate = np.stack([20.0 * (d % 4), 19.324713 * (d // 4 % 4), 20.0 * (d // 16)], 1)
    return (translate - 10).astype(np.float32), (translate + np.array([10, 9.324713, 10])).astype(np.float32)


@pytest.mark.parametrize("ranks", [1, 2, 4, 8, 16])
def test_the_z_order_is_that_of_the_spray_program(ranks):
    expected = [int(c, 16) for c in SPRAY_Z_ORDER.get(ranks, "0" * 64)]
    assert morton_ranks(*spray_boxes(), ranks).tolist() == expected


def test_what_is_left_over_goes_on_from_rank_0():
    x = np.arange(10, dtype=np.float32)[::-1]  # along the curve in reverse
    low = np.stack([x, 0 * x, 0 * x], 1)
    ranks = morton_ranks(low, low + np.float32(1), 4)
    assert ranks[::-1].tolist() == [0, 0, 1, 1, 2, 2, 3, 3, 0, 0]
    assert morton_ranks(low, low + np.float32(1), 7)[::-1].tolist() == [0, 1, 2, 3, 4, 5, 6, 0, 1, 2]


def test_more_ranks_than_domains_get_one_each():
    x = np.arange(3, dtype=np.float32)
    low = np.stack([x, 0 * x, 0 * x], 1)
    assert morton_ranks(low, low, 8).tolist() == [0, 1, 2]


def test_empty_domains_come_last_and_flat_scenes_are_no_trouble():
    low = np.array([[np.inf] * 3, [5, 1, 0], [0, 1, 0], [np.inf] * 3], np.float32)
    high = np.array([[-np.inf] * 3, [6, 1, 0], [1, 1, 0], [-np.inf] * 3], np.float32)
    assert morton_ranks(low, high, 4).tolist() == [2, 1, 0, 3]
    assert morton_ranks(low[::3], high[::3], 2).tolist() == [0, 1]


@given(st.integers(0, 2**32), st.integers(1, 200), st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_ranks_are_filled_evenly_and_blocks_are_as_the_program_cuts_them(seed, domains, ranks):
    low = generator(seed).uniform(-5, 5, (domains, 3)).astype(np.float32)
    owner = morton_ranks(low, low + np.float32(1), ranks)
    shuffle = np.argsort(generator(seed + 1).random(domains))
    assert (morton_ranks(low[shuffle], low[shuffle] + np.float32(1), ranks) == owner[shuffle]).all()
    share = max(domains // ranks, 1)
    counts = np.bincount(owner, minlength=ranks)
    assert counts.max() <= 2 * share
    assert (counts[: min(ranks, domains)] >= share).all()
    for even in (block_ranks(domains, ranks), round_robin(domains, ranks)):
        counts = np.bincount(even, minlength=ranks)
        assert counts.max() - counts.min() <= 1
        assert (np.diff(counts) <= 0).all()


def test_blocks_and_turns():
    assert block_ranks(7, 3).tolist() == [0, 0, 0, 1, 1, 2, 2]
    assert block_ranks(2, 4).tolist() == [0, 1]
    assert round_robin(7, 3).tolist() == [0, 1, 2, 0, 1, 2, 0]
    assert round_robin(552, 88)[[0, 88, 176]].tolist() == [0, 0, 0]


# Keys


def test_keys_tell_partitions_apart_and_forget_weights():
    triangles = random_soup(3, 50)
    owner = sah_parts(*triangle_boxes(triangles), 4)
    one = from_triangles(triangles, owner, 4, 1.0, 1.0)
    assert one.key == from_triangles(triangles, owner.astype(np.int64), 4, 2.0, 9.0).key
    assert one.key.endswith("-4")
    other = owner.copy()
    other[0] = (owner[0] + 1) % 4
    keys = {
        one.key,
        from_triangles(triangles, other, 4, 1.0, 1.0).key,
        from_triangles(triangles, owner, 5, 1.0, 1.0).key,
    }
    assert len(keys) == 3
