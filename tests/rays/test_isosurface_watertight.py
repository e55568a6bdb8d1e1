"""Isosurfaces have no cracks: not inside a brick, and not between bricks."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays.grids import default_transfer
from simrender.rays.isosurface import Surface, isosurface, isosurfaces
from simrender.rays.volume import Volume

ORIGIN, SPACING = (-3.7, 12.1, 0.3), (0.1, 0.37, 1.3)


def noise(seed: int, shape: tuple[int, int, int], levels: int | None = None) -> np.ndarray:
    random = np.random.Generator(np.random.Philox(seed))
    return (random.random(shape) if levels is None else random.integers(0, levels, shape)).astype(np.float32)


def ball(n: int, radius: float) -> np.ndarray:
    z, y, x = np.mgrid[:n, :n, :n] - (n - 1) / 2
    return (radius - np.sqrt(x * x + y * y + z * z)).astype(np.float32)


def uneven_bricks(shape: tuple[int, ...], size: tuple[int, int, int] = (7, 4, 5)) -> list[tuple[int, ...]]:
    spans = [[(i, min(i + s, n - 1)) for i in range(0, n - 1, s)] for n, s in zip(shape[::-1], size, strict=True)]
    return [(*x, *y, *z) for z, y, x in product(spans[2], spans[1], spans[0])]


def merged(surfaces: list[Surface] | tuple[Surface, ...]) -> tuple[np.ndarray, np.ndarray]:
    """All surfaces as one, with vertices joined only if they are the same to the bit."""
    shift = np.cumsum([0, *(len(s.vertices) for s in surfaces)])
    vertices = np.concatenate([s.vertices for s in surfaces])
    faces = np.concatenate([s.faces + k for s, k in zip(surfaces, shift[:-1], strict=True)])
    _, first, number = np.unique(vertices.view(np.dtype((np.void, 12))).ravel(), return_index=True, return_inverse=True)
    return vertices[first], number[faces]


def edge_counts(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each edge (n, 2), the number of its triangles, and those that run it upward less those that run it downward."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    key = edges.min(axis=1) * count + edges.max(axis=1)
    unique, which, times = np.unique(key, return_inverse=True, return_counts=True)
    turn = np.bincount(which, np.where(edges[:, 0] < edges[:, 1], 1, -1))
    return np.stack([unique // count, unique % count], axis=1), times, turn


def open_edges_off_boundary(vertices: np.ndarray, faces: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Edges that are not run equally often both ways, other than those in a face of the volume's own box."""
    edges, _, turn = edge_counts(faces, len(vertices))
    loose = vertices[edges[turn != 0]]
    sides = np.stack([np.array(ORIGIN), ORIGIN + np.array(SPACING) * (np.array(shape[::-1]) - 1)])
    on = (loose[:, :, None, :] == sides.astype(np.float32)).all(axis=1)
    return loose[~on.any(axis=(1, 2))]


def cut(voxels: np.ndarray, value: float) -> list[Surface]:
    return [isosurface(voxels, ORIGIN, SPACING, value, b) for b in uneven_bricks(voxels.shape)]


VOLUMES = {
    "noise": (noise(1, (23, 19, 26)), 0.5),
    "noise of few values, surface between": (noise(2, (23, 19, 26), 4), 1.5),
    "noise of few values, surface at voxels": (noise(3, (23, 19, 26), 4), 2.0),
    "noise of two values, surface at one": (noise(4, (23, 19, 26), 2), 0.0),
    "value nearest to a voxel's": (noise(5, (23, 19, 26)), float(np.nextafter(noise(5, (23, 19, 26))[3, 4, 5], 2))),
    "value that float32 does not hold": (noise(6, (23, 19, 26), 3), 1.0 + 1e-12),
    "ball": (ball(25, 9.3), 0.0),
    "ball with the surface through voxels": (ball(25, 9.0), 0.0),
    "ball with a plateau": (np.maximum(ball(25, 9.3), -2.0), -2.0),
    "ball with a flat top": (np.minimum(ball(25, 9.3), 2.0), 2.0 - 1e-9),
}


@pytest.mark.parametrize("name", VOLUMES)
def test_no_cracks_between_bricks(name: str) -> None:
    voxels, value = VOLUMES[name]
    vertices, faces = merged(cut(voxels, value))
    assert len(faces) > 500
    assert len(open_edges_off_boundary(vertices, faces, voxels.shape)) == 0


@pytest.mark.parametrize("name", VOLUMES)
def test_the_bricks_hold_the_surface_of_the_whole(name: str) -> None:
    voxels, value = VOLUMES[name]
    vertices, faces = merged(cut(voxels, value))
    whole = isosurface(voxels, ORIGIN, SPACING, value)
    whole_vertices, whole_faces = merged([whole])
    assert np.array_equal(vertices, whole_vertices)
    assert len(whole_vertices) == len(whole.vertices)  # joined already
    assert np.array_equal(np.unique(faces, axis=0), np.unique(whole_faces, axis=0))
    assert len(faces) == len(whole_faces)


@pytest.mark.parametrize("name", ["noise", "noise of few values, surface between", "ball", "ball with a flat top"])
def test_away_from_the_voxels_every_edge_has_exactly_two_triangles(name: str) -> None:
    voxels, value = VOLUMES[name]
    vertices, faces = merged(cut(np.pad(voxels, 1, constant_values=-9.0), value))  # the margin closes the surface
    _, times, turn = edge_counts(faces, len(vertices))
    assert (times == 2).all()
    assert (turn == 0).all()


def test_any_two_neighbouring_cells_agree_on_the_contour_of_their_face() -> None:
    voxels = np.pad(noise(7, (46, 46, 46), 2), 1)
    for axis in range(3):  # all 4,096 pairs of cells occur along each axis
        v = np.moveaxis(voxels, axis, 0).astype(int)
        corners = [v[i : i + 46, j : j + 47, k : k + 47] for i in range(3) for j in range(2) for k in range(2)]
        assert len(np.unique(sum(c << bit for bit, c in enumerate(corners)))) == 4096
    surface = isosurface(voxels, ORIGIN, SPACING, 0.5)
    _, times, turn = edge_counts(surface.faces, len(surface.vertices))
    assert (times == 2).all()
    assert (turn == 0).all()


def test_no_triangle_has_two_equal_corners_and_no_vertex_is_unused() -> None:
    for voxels, value in VOLUMES.values():
        for surface in cut(voxels, value):
            a, b, c = (surface.vertices[surface.faces[:, k]] for k in range(3))
            assert not ((a == b).all(axis=1) | (b == c).all(axis=1) | (c == a).all(axis=1)).any()
            assert np.array_equal(np.unique(surface.faces), np.arange(len(surface.vertices)))


def test_a_ball_has_its_volume_and_its_normals_point_outward() -> None:
    surface = isosurface(ball(65, 25.0), (-32, -32, -32), (1, 1, 1), 0.0)
    a, b, c = (surface.vertices[surface.faces[:, k]].astype(float) for k in range(3))
    volume = (a * np.cross(b, c)).sum() / 6  # positive: the faces turn outward
    assert volume == pytest.approx(4 / 3 * np.pi * 25**3, rel=2e-3)
    assert np.linalg.norm(surface.vertices, axis=1) == pytest.approx(25.0, abs=0.02)
    assert (surface.normals * surface.vertices / 25.0).sum(axis=1) == pytest.approx(1.0, abs=1e-3)


def test_a_plane_lies_where_linear_interpolation_puts_it() -> None:
    x = np.arange(5, dtype=np.float32)
    voxels = np.broadcast_to(x, (3, 4, 5)).copy()
    surface = isosurface(voxels, (10, 20, 30), (2, 3, 4), 1.75)
    assert np.array_equal(np.unique(surface.vertices[:, 0]), [13.5])
    assert surface.vertices.min(axis=0).tolist() == [13.5, 20, 30]
    assert surface.vertices.max(axis=0).tolist() == [13.5, 29, 38]
    assert (surface.normals == [-1, 0, 0]).all()
    assert len(surface.faces) == 2 * 3 * 2


def test_normals_agree_where_bricks_meet() -> None:
    voxels, value = VOLUMES["noise"]
    parts = cut(voxels, value)
    rows = np.concatenate([np.concatenate([p.vertices, p.normals], axis=1) for p in parts])
    assert len(np.unique(rows, axis=0)) == len(np.unique(rows[:, :3], axis=0)) < len(rows)


def test_a_constant_volume_has_no_surface() -> None:
    for value in (2.9, 3.0, 3.1):
        assert isosurface(np.full((4, 4, 4), 3, np.float32), ORIGIN, SPACING, value).mesh() is None


def test_a_lone_voxel_at_the_value_leaves_nothing_behind() -> None:
    voxels = np.ones((5, 5, 5), np.float32)
    voxels[2, 2, 2] = 0.0
    assert len(isosurface(voxels, ORIGIN, SPACING, 0.0).faces) == 0  # an octahedron shrunk to a point
    assert len(isosurface(voxels, ORIGIN, SPACING, 0.5).faces) == 8


@pytest.mark.parametrize("origin", [1e6, 1e7, -3e8])
def test_far_from_the_origin_float32_joins_vertices_and_nothing_opens(origin: float) -> None:
    voxels, value = np.pad(noise(8, (12, 12, 12)), 1), 0.5
    parts = [isosurface(voxels, (origin, 0, 0), (1, 1, 1), value, b) for b in uneven_bricks(voxels.shape)]
    vertices, faces = merged(parts)
    assert (edge_counts(faces, len(vertices))[2] == 0).all()
    assert np.isfinite(vertices).all()


def test_isosurfaces_counts_vertices_between_bricks_once() -> None:
    volume = Volume(VOLUMES["noise"][0], SPACING, ORIGIN, default_transfer(VOLUMES["noise"][0]))
    bricks = uneven_bricks(volume.voxels.shape)
    found = isosurfaces(volume, 0.5, bricks)
    whole = isosurface(volume.voxels, ORIGIN, SPACING, 0.5)
    assert found.triangles.sum() == len(whole.faces)
    assert found.distinct_vertices == len(whole.vertices) < found.vertices.sum()
    assert found.triangles.tolist() == [len(s.faces) for s in found.surfaces]
    mesh = found.surfaces[0].mesh(3)
    assert mesh.material == 3
    assert mesh.smooth


def test_the_same_bricks_give_the_same_bits() -> None:
    first, second = (cut(*VOLUMES["noise"]) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert all(x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize(
    ("shape", "value", "cells", "words"),
    [
        ((1, 4, 4), 0.5, None, "at least 2 voxels"),
        ((4, 4, 4), float("nan"), None, "finite"),
        ((4, 4, 4), 0.5, (0, 4, 0, 3, 0, 3), "reaches outside"),
        ((4, 4, 4), 0.5, (2, 2, 0, 3, 0, 3), "is empty"),
    ],
)
def test_what_cannot_be_extracted_is_refused(shape: tuple[int, ...], value: float, cells: object, words: str) -> None:
    with pytest.raises(SceneError, match=words):
        isosurface(np.zeros(shape, np.float32), ORIGIN, SPACING, value, cells)
