from __future__ import annotations

import itertools
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from simrender.errors import SceneError, SceneWarning
from simrender.rays.elements import FACES, TRIANGLES, TURN, Elements, boundary, ramp, read_elements
from simrender.rays.volume import TransferFunction

CLEAR = TransferFunction(np.array([0.0, 1.0]), np.ones((2, 3)), np.array([0.0, 0.5]))

CELLS = {
    4: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    5: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]],
    6: [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [0, 1, 1]],
    8: [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
}
"""One element of each kind, right way round."""


def mesh(points, cells, part=None, scalars=None, transfer=CLEAR) -> Elements:
    """A mesh from lists of corners."""
    kind = np.array([len(c) for c in cells])
    points = np.asarray(points, np.float64)
    return Elements(
        points,
        points[:, 2] if scalars is None else np.asarray(scalars),
        np.concatenate([[0], np.cumsum(kind)]),
        np.concatenate([np.asarray(c) for c in cells]),
        kind,
        np.zeros(len(cells), np.int32) if part is None else np.asarray(part),
        transfer,
    )


def single(kind: int) -> Elements:
    return mesh(CELLS[kind], [range(kind)])


def pair(part) -> Elements:
    """Two cubes side by side along x."""
    points = [[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1, 2)]
    left = np.array([0, 1, 4, 3, 6, 7, 10, 9])
    return mesh(points, [left, left + 1], part)


def signed_volume(elements: Elements) -> float:
    p = elements.points[boundary(elements).faces].astype(np.float64)
    return float(np.einsum("ni,ni->", p[:, 0], np.cross(p[:, 1], p[:, 2])) / 6.0)


def assert_closed(faces: np.ndarray) -> None:
    """Every directed edge is met by its reverse."""
    edges = Counter((int(f[j]), int(f[(j + 1) % 3])) for f in faces for j in range(3))
    assert all(edges[b, a] == n for (a, b), n in edges.items())


# -- tables -----------------------------------------------------------------------------------------------------------


def test_every_choice_of_diagonals_gives_a_closed_surface_whose_triangles_know_their_neighbours():
    assert TRIANGLES.shape == TURN.shape == (1 + 2 + 8 + 64, 12, 3)
    for triangles, turn in zip(TRIANGLES, TURN, strict=True):
        count = int((triangles[:, 0] >= 0).sum())
        corners = len(set(triangles[:count].ravel()))
        assert count == 2 * corners - 4
        assert_closed(triangles[:count])
        for t, j in itertools.product(range(count), range(3)):
            there = triangles[turn[t, j]].tolist()
            a, b = triangles[t, j], triangles[t, (j + 1) % 3]
            assert there[(there.index(b) + 1) % 3] == a


def test_faces_are_those_of_vtk():
    pyvista = pytest.importorskip("pyvista")
    cells = {"Tetrahedron": 4, "Pyramid": 5, "Wedge": 6, "Hexahedron": 8}
    for name, kind in cells.items():
        cell = getattr(pyvista.examples.cells, name)().get_cell(0)
        assert [tuple(face.point_ids) for face in cell.faces] == list(FACES[kind])


@pytest.mark.parametrize(("kind", "volume"), [(4, 1 / 6), (5, 1 / 3), (6, 1 / 2), (8, 1.0)])
def test_one_element(kind, volume):
    elements = single(kind)
    assert len(boundary(elements).faces) == 2 * kind - 4
    assert_closed(boundary(elements).faces)
    assert signed_volume(elements) == pytest.approx(volume)


# -- repair -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", CELLS)
def test_an_element_inside_out_is_turned_and_reported(kind):
    mirrored = np.array(CELLS[kind]) * [1, 1, -1]
    with pytest.warns(SceneWarning, match=r"^1 element is inside out, .*; the first is element 0, a \w+$"):
        elements = mesh(mirrored, [range(kind)])
    assert sorted(elements.corners) == list(range(kind))
    assert signed_volume(elements) > 0.0


def test_only_the_elements_inside_out_are_turned():
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1]])
    cells = [[0, 1, 2, 3], [0, 1, 2, 4], [1, 3, 2, 5], [0, 2, 1, 4]]
    with pytest.warns(SceneWarning, match=r"2 of 4 elements are inside out.*element 1, a tetrahedron"):
        elements = mesh(points, cells)
    assert elements.corners.reshape(-1, 4)[[0, 3]].tolist() == [cells[0], cells[3]]


def test_elements_without_volume_are_kept_and_reported():
    points = [*CELLS[4], [0.5, 0.5, 0.0]]
    with pytest.warns(SceneWarning, match=r"1 element is without volume: .*element 1, a tetrahedron"):
        elements = mesh(points, [[0, 1, 2, 3], [0, 1, 2, 4]])
    assert elements.count == 2


def test_thin_elements_far_from_the_origin_are_neither_flat_nor_inside_out():
    thin = np.array(CELLS[6]) * [1.0, 1.0, 1e-5] + [4096.0, 0.0, 0.0]
    assert mesh(thin, [range(6)]).count == 1  # a warning would be an error here


# -- how elements meet ------------------------------------------------------------------------------------------------


def test_neighbours_of_one_part_share_no_boundary_and_those_of_two_parts_have_the_same_triangles():
    one, two = boundary(pair([0, 0])), boundary(pair([0, 1]))
    assert len(one.faces) == 20
    assert len(two.faces) == 24
    left = {frozenset(f.tolist()) for f in two.faces[two.part == 0]}
    right = {frozenset(f.tolist()) for f in two.faces[two.part == 1]}
    assert len(left & right) == 2
    for part in (0, 1):
        assert_closed(two.faces[two.part == part])


def test_neighbours_are_mutual():
    elements = pair([0, 0])
    across = elements.across
    rows = np.flatnonzero(across >= 0)
    assert len(rows) == 4
    start = 2 * elements.first[:-1] - 4 * np.arange(2)
    back = across[start[across[rows] >> 4] + (across[rows] & 15)]
    assert (start[back >> 4] + (back & 15)).tolist() == rows.tolist()


def test_a_quadrilateral_meets_the_two_triangles_of_a_neighbour():
    points = [*CELLS[8], [2, 0.5, 0.5]]
    # The face of corners 1, 2, 6, 5 is parted from 1 to 6.
    elements = mesh(points, [range(8), [1, 2, 6, 8], [1, 6, 5, 8]])
    assert len(boundary(elements).faces) == 12 - 2 + 4
    assert_closed(boundary(elements).faces)
    assert signed_volume(elements) == pytest.approx(1.0 + 1.0 / 3.0)


def test_of_three_elements_at_one_triangle_the_first_two_meet():
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [0, 0, -2]]
    elements = mesh(points, [[0, 1, 2, 3], [0, 2, 1, 4], [0, 2, 1, 5]])
    assert (elements.across.reshape(3, 4) >= 0).sum(axis=1).tolist() == [1, 1, 0]


def test_collapsed_elements_leave_no_boundary_behind():
    # A hexahedron with one side pinched is a wedge.
    points = np.array(CELLS[8])
    elements = mesh(points, [[0, 1, 2, 2, 4, 5, 6, 6]])
    faces = boundary(elements).faces
    assert len(faces) == 8
    assert_closed(faces)


def test_the_order_of_elements_does_not_change_the_boundary():
    rng = np.random.Generator(np.random.Philox(key=1))
    grid = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    ids = np.arange(64).reshape(4, 4, 4)
    corner = [ids[a : a + 3, b : b + 3, c : c + 3].ravel() for a, b, c in np.array(CELLS[8], int)]
    cells = np.stack(corner, axis=1)
    part = rng.integers(0, 3, len(cells))
    order = rng.permutation(len(cells))
    a, b = boundary(mesh(grid, cells, part)), boundary(mesh(grid, cells[order], part[order]))
    found = [sorted((int(p), *sorted(f.tolist())) for f, p in zip(s.faces, s.part, strict=True)) for s in (a, b)]
    assert found[0] == found[1]


def test_bounds_of_parts():
    elements = pair([2, 0])
    low, high = elements.part_bounds
    assert elements.parts == 3
    assert elements.elements_of.tolist() == [1, 0, 1]
    assert low[[0, 2]].tolist() == [[1, 0, 0], [0, 0, 0]]
    assert high[[0, 2]].tolist() == [[2, 1, 1], [1, 1, 1]]
    assert (low[1] > high[1]).all()
    assert [b.tolist() for b in elements.bounds] == [[0, 0, 0], [2, 1, 1]]


def test_key_and_units():
    elements = pair([0, 1])
    assert elements.key == pair([0, 1]).key
    assert elements.key != pair([0, 0]).key
    larger = elements.scaled(4.0)
    assert larger.points.tolist() == (4.0 * elements.points).tolist()
    assert larger.transfer.unit == 4.0
    assert larger.key != elements.key


# -- errors -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.full((8, 3), np.nan)}, "8 of 8 points are not finite; the first is 0"),
        (
            {"scalars": np.array([0, 1, 2, np.inf, 4, 5, 6, np.nan])},
            "2 of 8 scalars are not finite; the first is 3: inf",
        ),
        ({"points": np.zeros((8, 2))}, r"points are an array \(p, 3\)"),
        ({"scalars": np.zeros(7)}, r"scalars \(p,\), got \(8, 3\) and \(7,\)"),
        (
            {"corners": np.array([0, 1, 2, 3, 4, 5, 6, 8])},
            "1 corner of an element is outside the 8 points; the first is 8 of element 0, a hexahedron",
        ),
        (
            {"corners": np.array([0, 1, 2, 3, 4, 5, 6, -1])},
            "1 corner of an element is outside the 8 points; the first is -1",
        ),
        ({"kind": np.array([7])}, "element 0 has 7 corners .known: 4 tetrahedron, 5 pyramid, 6 wedge, 8 hexahedron"),
        ({"kind": np.array([], int)}, "the mesh is empty"),
        ({"part": np.array([-1])}, "numbered from 0 on, got part -1 of element 0"),
        ({"part": np.array([0, 1])}, r"1 elements have part \(1,\)"),
        ({"first": np.array([0, 6])}, "check `first`"),
    ],
)
def test_what_cannot_be_a_mesh_is_refused(change, message):
    columns = {
        "points": np.array(CELLS[8], float), "scalars": np.zeros(8), "first": np.array([0, 8]),
        "corners": np.arange(8), "kind": np.array([8]), "part": np.array([0]), "transfer": CLEAR,
    }  # fmt: skip
    with pytest.raises(SceneError, match=message):
        Elements(**{**columns, **change})


# -- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def hexbeam(ply: Path) -> Path:
    return ply.parent / "hexbeam.vtk"


def save(path: Path, cells: dict[int, list], points, **arrays) -> Path:
    pyvista = pytest.importorskip("pyvista")
    types, packed = [], []
    for kind, rows in cells.items():
        for row in rows:
            types.append(kind)
            packed += [len(row), *row]
    grid = pyvista.UnstructuredGrid(np.array(packed), np.array(types, np.uint8), np.asarray(points, np.float32))
    for name, values in arrays.items():
        (grid.cell_data if len(values) == len(types) else grid.point_data)[name] = np.asarray(values)
    grid.save(path)
    return path


def test_hexbeam(hexbeam):
    elements = read_elements(hexbeam)
    assert elements.kind.tolist() == [8] * 40
    assert elements.part.tolist() == [0] * 40
    assert elements.scalars.min() == 1.0  # sample_point_scalars
    assert len(boundary(elements).faces) == 2 * (2 * 4 + 4 * 20)
    assert signed_volume(elements) == pytest.approx(5.0)
    assert elements.transfer.values[[0, -1]].tolist() == [elements.scalars.min(), elements.scalars.max()]


def test_all_kinds_parts_and_voxels_are_read_and_surfaces_skipped(tmp_path):
    points = np.concatenate([np.add(CELLS[k], (3.0 * i, 0, 0)) for i, k in enumerate((4, 5, 6, 8))])
    voxel = np.array(CELLS[8])[[0, 1, 3, 2, 4, 5, 7, 6]] + [12.0, 0, 0]
    points = np.concatenate([points, voxel])
    cells = {5: [[0, 1, 2]], 10: [range(4)], 14: [range(4, 9)], 13: [range(9, 15)], 12: [range(15, 23)]}
    cells[11] = [range(23, 31)]
    path = save(tmp_path / "all.vtu", cells, points, part=[9, 7, 7, 5, 5, 4], pressure=np.arange(31.0))
    elements = read_elements(path)
    assert elements.kind.tolist() == [4, 5, 6, 8, 8]
    assert elements.part.tolist() == [2, 2, 1, 1, 0]
    assert elements.scalars.tolist() == list(range(31))
    assert signed_volume(elements) == pytest.approx(1 / 6 + 1 / 3 + 1 / 2 + 2.0)


def test_cell_data_are_averaged_to_points(tmp_path):
    points = [*CELLS[4], [1, 1, 1]]
    path = save(tmp_path / "two.vtk", {10: [[0, 1, 2, 3], [1, 2, 3, 4]]}, points, pressure=[1.0, 3.0])
    assert read_elements(path).scalars.tolist() == [1.0, 2.0, 2.0, 2.0, 3.0]


def test_without_any_array_the_height_takes_its_place(tmp_path):
    path = save(tmp_path / "bare.vtu", {10: [range(4)]}, np.add(CELLS[4], (0, 0, 5)))
    with pytest.warns(SceneWarning, match=r"bare.vtu: no array with one number a point or cell; the height"):
        elements = read_elements(path)
    assert elements.scalars.tolist() == [0, 0, 0, 1]


def test_what_cannot_be_read_is_refused(tmp_path, hexbeam, monkeypatch):
    refused = {
        tmp_path / "a.stl": "unknown format '.stl' of unstructured meshes .known: .vtu, .vtk",
        tmp_path / "none.vtu": "there is no such file",
        save(tmp_path / "thin.vtu", {5: [[0, 1, 2]]}, CELLS[4]): "none of the 1 cells is three-dimensional",
        save(tmp_path / "odd.vtu", {10: [range(4)], 24: [[0, 1, 2, 3] * 2 + [0, 1]]}, CELLS[4]): (
            "1 of 2 cells are of a kind that is not traced, the first a quadratic tetra"
        ),
        save(tmp_path / "nan.vtu", {10: [range(4)]}, CELLS[4], p=[0, np.nan, 1, 2], part=[0]): (
            "nan.vtu: 1 of 4 scalars are not finite; the first is 1"
        ),
    }
    (tmp_path / "folder.vtu").mkdir()
    refused[tmp_path / "folder.vtu"] = "this is a folder"
    (tmp_path / "cut.vtu").write_text("<VTKFile type='UnstructuredGrid'><Unstruc")
    refused[tmp_path / "cut.vtu"] = "cut.vtu: cannot read this VTK file"
    for path, message in refused.items():
        with pytest.raises(SceneError, match=message):
            read_elements(path)
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(SceneError, match=r"through pyvista: pip install 'simrender-cluster\[vtk\]'"):
        read_elements(hexbeam)


def test_a_constant_field_has_a_transfer_function_too():
    assert ramp(2.0, 2.0, 1.0).values.tolist() == [2.0]
    assert ramp(0.0, 2.0, 1.0).opacities[0] == 0.0
