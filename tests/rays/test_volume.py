"""Volumes: what their macro cells know, what their transfer function gives back, and what is wrong with bad ones."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays.volume import MACRO, TransferFunction, Volume, check_bricks, find_row
from workloads.terrain import generator

GREY = TransferFunction([0.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [0.0, 0.5])
SPIKY = TransferFunction(
    [0.1, 0.5, 0.52, 0.54, 0.9],
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 1, 1]],
    [0.1, 0.0, 0.99, 0.0, 0.4],
    3.0,
)


def noise(nx, ny, nz, seed=1):
    return generator(seed, "voxels").random((nz, ny, nx), dtype=np.float32)


def kd_bricks(volume, count, rng):
    """Cut a volume at random faces of macro cells, again and again, into int32 rows (x0, x1, y0, y1, z0, z1)."""
    bricks = [[0, volume.cells[0], 0, volume.cells[1], 0, volume.cells[2]]]
    while len(bricks) < count:
        choices = [
            (b, axis, plane)
            for b, brick in enumerate(bricks)
            for axis in range(3)
            for plane in range((brick[2 * axis] // MACRO + 1) * MACRO, brick[2 * axis + 1], MACRO)
        ]
        b, axis, plane = choices[rng.integers(len(choices))]
        lower, upper = list(bricks[b]), list(bricks[b])
        lower[2 * axis + 1] = upper[2 * axis] = plane
        bricks[b : b + 1] = [lower, upper]
    return np.array(bricks, np.int32)


def hard_rays(volume, rng, count=400):
    """Rays in general position, then along axes, on faces, through edges and vertices, from inside and outside."""
    low, high = volume.bounds
    spacing = np.array(volume.spacing)
    lattice = low + spacing * np.stack([rng.integers(0, n + 1, (4, count)) for n in volume.cells], axis=-1)
    macro = low + spacing * MACRO * np.stack([rng.integers(0, n // MACRO + 1, count) for n in volume.cells], axis=-1)
    macro = np.minimum(macro, high)
    inside = low + rng.random((count, 3)) * (high - low)
    outside = low + (rng.random((count, 3)) * 4.0 - 1.5) * (high - low)
    axes = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1.0, 1.0], (count, 1))
    axes[::3] *= -1.0  # leaves zeros of both signs
    diagonal = rng.choice([-1.0, 0.0, 1.0], (count, 3)) * spacing
    diagonal[~diagonal.any(axis=1)] = spacing
    origins = [outside, inside, macro - 64.0 * axes, macro, lattice[0], lattice[1] - 32.0 * diagonal, lattice[2], macro]
    towards = [
        inside - outside,
        outside - inside,
        axes,
        axes,
        axes,
        diagonal,
        lattice[3] - lattice[2] + 1e-30,
        diagonal,
    ]
    direction = np.concatenate(towards)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-300)
    return bundle(np.concatenate(origins), direction)


def bundle(origin, direction, reach=np.inf):
    origin, direction = np.broadcast_arrays(np.asarray(origin, np.float32), np.asarray(direction, np.float32))
    return {
        "origin": np.ascontiguousarray(origin),
        "direction": np.ascontiguousarray(direction),
        "reach": np.full(len(origin), reach, np.float32),
    }


def whole(volume, rays):
    """One brick over everything: the rows (row_ray, row_cells)."""
    nx, ny, nz = volume.cells
    n = len(rays["reach"])
    return np.arange(n), np.tile(np.array([[0, nx, 0, ny, 0, nz]], np.int32), (n, 1))


def in_bricks(rays, bricks):
    """Every ray in every brick: the rows (row_ray, row_cells), ray by ray."""
    n = len(rays["reach"])
    return np.repeat(np.arange(n), len(bricks)), np.tile(bricks, (n, 1))


@pytest.mark.parametrize("dims", [(41, 30, 20), (17, 9, 8), (2, 2, 2), (10, 9, 25)])
def test_macro_cells_hold_the_range_of_the_voxels_their_cells_touch(dims):
    volume = Volume(noise(*dims), (1, 1, 1), (0, 0, 0), SPIKY)
    macro = volume.macro
    assert macro.low.shape == tuple(-(-(n - 1) // MACRO) for n in dims[::-1])
    for k in np.ndindex(*macro.low.shape):
        block = volume.voxels[tuple(slice(MACRO * i, MACRO * i + MACRO + 1) for i in k)]
        assert (macro.low[k], macro.high[k]) == (block.min(), block.max())
    assert volume.value_range == (volume.voxels.min(), volume.voxels.max())


def test_the_majorant_is_the_largest_extinction_of_the_range_and_no_more():
    voxels = noise(33, 33, 33) * 0.3 + np.linspace(0.0, 0.7, 33, dtype=np.float32)
    macro = Volume(voxels, (1, 1, 1), (0, 0, 0), SPIKY).macro
    low, high = macro.low.ravel().astype(float), macro.high.ravel().astype(float)
    dense = SPIKY.sigma(low + np.linspace(0.0, 1.0, 20001)[:, None] * (high - low)).max(axis=0)
    assert (macro.majorant.ravel() >= dense * (1 - 1e-12)).all()
    assert macro.majorant.ravel() == pytest.approx(dense, rel=1e-2)
    spike = (low < 0.52) & (high > 0.52)
    assert spike.any()
    assert (macro.majorant.ravel()[spike] == SPIKY.extinction[2]).all()


def test_a_macro_cell_whose_range_no_control_point_makes_visible_is_empty():
    clear = TransferFunction([0.0, 0.5, 1.0], np.ones((3, 3)), [0.0, 0.0, 0.9])
    voxels = np.zeros((9, 9, 17), np.float32)
    voxels[:, :, 0], voxels[4, 4, 16] = 0.5, 0.6
    assert Volume(voxels, (1, 1, 1), (0, 0, 0), clear).macro.majorant.tolist() == [
        [[0.0, clear.sigma(np.float32(0.6))]]
    ]


def test_a_slab_one_unit_thick_has_the_opacity_that_was_given():
    assert -np.expm1(-SPIKY.extinction * SPIKY.unit) == pytest.approx(SPIKY.opacities)
    assert SPIKY.extinction[1] == 0.0


def test_beyond_its_control_points_a_transfer_function_stays_at_its_ends():
    assert SPIKY.sigma([-9.0, 9.0]) == pytest.approx(SPIKY.extinction[[0, -1]])
    assert SPIKY.color([-9.0, 0.7, 9.0]) == pytest.approx(np.array([[1, 0, 0], [1, 1, 4 / 9], [1, 1, 1]]))


def test_the_kernels_table_gives_what_the_function_gives_from_any_row():
    table = SPIKY.table
    for value in [*np.linspace(0.1, 1.2, 50), *SPIKY.values]:
        rows = {find_row(table, value, start) for start in range(len(table))}
        assert len(rows) == 1
        row = table[rows.pop()]
        assert row[1] + (value - row[0]) * row[2] == pytest.approx(SPIKY.sigma(value), abs=1e-14)
        assert row[3::2] + (value - row[0]) * row[4::2] == pytest.approx(SPIKY.color(value), abs=1e-14)


def test_bounds_reach_from_the_first_to_the_last_grid_point():
    volume = Volume(np.zeros((4, 3, 2)), (1.0, 2.0, 0.5), (-1.0, 0.0, 7.0), GREY)
    assert (volume.dims, volume.cells) == ((2, 3, 4), (1, 2, 3))
    assert [b.tolist() for b in volume.bounds] == [[-1.0, 0.0, 7.0], [0.0, 4.0, 8.5]]


def test_scaling_keeps_the_opacity_of_the_whole():
    volume = Volume(noise(9, 9, 9), (1.0, 2.0, 0.5), (-1.0, 0.0, 7.0), SPIKY, (0.5,))
    large = volume.scaled(1e6)
    assert large.bounds[1] == pytest.approx(volume.bounds[1] * 1e6)
    assert large.macro.majorant * 1e6 == pytest.approx(volume.macro.majorant)
    assert large.isovalues == (0.5,)


def test_isosurfaces_take_the_transfer_functions_colour_unless_told():
    assert Volume(noise(2, 2, 2), (1, 1, 1), (0, 0, 0), GREY, (0.25, 0.5)).iso_colors == ((0.25,) * 3, (0.5,) * 3)
    assert Volume(noise(2, 2, 2), (1, 1, 1), (0, 0, 0), GREY, (0.5,), ((1, 0, 0),)).iso_colors == ((1, 0, 0),)


def test_the_key_is_that_of_the_content():
    def key(voxels=None, spacing=(1, 1, 1), transfer=GREY, isovalues=()):
        return Volume(noise(5, 4, 3) if voxels is None else voxels, spacing, (0, 0, 0), transfer, isovalues).key

    changed = TransferFunction(GREY.values, GREY.colors, GREY.opacities, 2.0)
    others = [key(noise(5, 4, 3, 2)), key(noise(3, 4, 5)), key(spacing=(1, 1, 2))]
    others += [key(transfer=changed), key(isovalues=(0.5,))]
    assert key() == key()
    assert len({key(), *others}) == 6


def test_numerics_voxels_that_are_not_finite_are_counted_and_found():
    voxels = np.zeros((4, 5, 6), np.float32)
    voxels[2, 3, 4] = np.nan
    with pytest.raises(
        SceneError, match=r"^1 of 120 voxels is not finite; the first is nan at \(x, y, z\) = \(4, 3, 2\)"
    ):
        Volume(voxels, (1, 1, 1), (0, 0, 0), GREY)
    voxels[3] = -np.inf
    with pytest.raises(SceneError, match=r"31 of 120 voxels are not finite; .*: replace such values"):
        Volume(voxels, (1, 1, 1), (0, 0, 0), GREY)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"voxels": np.zeros((3, 3))}, r"shape \(nz, ny, nx\) with at least 2 points an axis, got \(3, 3\)"),
        ({"voxels": np.zeros((3, 1, 3))}, r"at least 2 points an axis, got \(3, 1, 3\)"),
        ({"spacing": (1.0, 0.0, 1.0)}, r"spacing of a volume is three lengths above 0, got \(1.0, 0.0, 1.0\)"),
        ({"spacing": (1.0, 1.0)}, "spacing of a volume is three lengths"),
        ({"origin": (0.0, np.nan, 0.0)}, "origin of a volume is three finite coordinates"),
        ({"isovalues": (np.inf,)}, "an isovalue is not finite"),
        ({"isovalues": (1.0, 2.0), "iso_colors": ((1, 1, 1),)}, "2 isovalues need as many colours or none, got 1"),
    ],
)
def test_a_volume_that_makes_no_sense_says_why(changed, message):
    good = {"voxels": np.zeros((2, 2, 2)), "spacing": (1, 1, 1), "origin": (0, 0, 0), "transfer": GREY}
    with pytest.raises(SceneError, match=message):
        Volume(**(good | changed))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"values": []}, r"values \(k,\), colors \(k, 3\) and opacities \(k,\), k >= 1, got \(0,\)"),
        ({"colors": [[0, 0, 0]]}, r"got \(2,\), \(1, 3\) and \(2,\)"),
        ({"values": [1.0, 1.0]}, r"must ascend, got \[1.0, 1.0\]"),
        ({"opacities": [0.0, 1.0]}, "opacity 1.0 at value 1.0 of a transfer function is not 0 <= opacity < 1"),
        ({"colors": [[0, 0, 0], [0, 2, 0]]}, r"color \[0.0, 2.0, 0.0\] at value 1.0 of a .* is not 0 <= color <= 1"),
        ({"unit": 0.0}, "unit of a transfer function's opacities is a length above 0, got 0.0"),
    ],
)
def test_a_transfer_function_that_makes_no_sense_says_why(changed, message):
    good = {"values": [0.0, 1.0], "colors": np.zeros((2, 3)), "opacities": [0.0, 0.5]}
    with pytest.raises(SceneError, match=message):
        TransferFunction(**(good | changed))


@pytest.mark.parametrize(
    "brick", [[0, 8, 0, 20, 0, 24], [0, 4, 0, 20, 0, 16], [-8, 8, 0, 20, 0, 16], [8, 8, 0, 20, 0, 16]]
)
def test_a_brick_that_is_not_made_of_whole_macro_cells_is_refused(brick):
    volume = Volume(noise(31, 21, 17), (1, 1, 1), (0, 0, 0), GREY)
    good = np.array([[0, 30, 0, 20, 0, 16], [8, 30, 16, 20, 8, 16]], np.int32)
    check_bricks(volume, good)
    with pytest.raises(
        SceneError, match=r"^the brick \[.*\] does not fit a volume of 30 x 20 x 16 cells: its faces must"
    ):
        check_bricks(volume, np.vstack([good, np.array([brick], np.int32)]))
