"""Scenes as they come: triangles without area, twice, coplanar, thin as needles; empty domains; odd cameras."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from simrender.accuracy.furnace import camera, of, plane
from simrender.accuracy.partitions import compare, path_rays, random_rays
from simrender.errors import SceneWarning
from simrender.rays.crossings import Crossings
from simrender.rays.domains import balanced_grid, from_triangles, rectilinear, sah_parts, triangle_boxes, uniform_grid
from simrender.rays.integrators import AmbientOcclusion, PathTracing, SprayPathTracing
from simrender.rays.scene import Environment, Material, Mesh, PointLight
from simrender.rays.trace import Trace
from simrender.rays.worlds import SurfaceWorld
from tests.conftest import bumpy_grid
from tests.scenes import check_nearest
from workloads.terrain import generator

GREY = Material((0.6, 0.5, 0.4), mirror=0.2)
LAMP = Material(emission=(3.0, 2.0, 1.0))
VIEW = camera((2.0, -2.0, 1.5), (-2.0, 2.0, -1.5), 0.5)


def bumpy(more=(), material=0):
    """The bumpy square with further faces behind its own."""
    vertices, faces = bumpy_grid()
    row = np.array([[-0.5, 0.0, 0.25], [0.0, 0.0, 0.25], [0.5, 0.0, 0.25]])
    return Mesh(
        np.concatenate([vertices, row]), np.concatenate([faces, np.reshape(more, (-1, 3))]).astype(int), material
    )


def scene_of(*meshes, **lights):
    sun = PointLight((3.0, 2.0, 5.0), (30.0, 30.0, 30.0))
    return of(*meshes, materials=(GREY, LAMP), points=(sun,), **({"environment": Environment()} | lights))


def traced(scene, view=VIEW, path=None, size=24):
    trace = Trace(scene, view, (size, size), 2, path or PathTracing(3, 3, 0.3))
    trace.complete()
    return trace


def cuts(scene, count=4):
    """Partitions of a scene: at random with an empty domain, by area, and by grids."""
    triangles = scene.triangles
    low, high = scene.bounds
    owner = generator(3, "owner").integers(0, count, len(triangles.faces)).astype(np.int32)
    found = [from_triangles(triangles, np.where(owner == 1, 0, owner).astype(np.int32), count + 1, 1.0, 1.0)]
    middles = triangles.vertices[triangles.faces].mean(axis=1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SceneWarning)  # of fewer parts than asked for
        parts = sah_parts(*triangle_boxes(triangles), count)
    found.append(from_triangles(triangles, parts, count, 1.0, 1.0))
    grids = uniform_grid(low, high, (2, 2, 1)), balanced_grid(middles, (2, 1, 2), bounds=(low, high))
    return [*found, *(rectilinear(triangles, planes, 1.0, 1.0) for planes in grids)]


def check(trace, tied=False):
    """Hits do not depend on the partition, the crossing table agrees, and nothing anywhere is not a number."""
    scene = trace.scene
    world = SurfaceWorld(scene, PathTracing())
    rays = [path_rays(trace), random_rays(scene, 4000)]
    for domains in cuts(scene):
        for bunch in rays:
            found = compare(world, domains, bunch)
            assert (found.leaks, found.differences) == (0, 0)
            assert tied or found.ties == 0
        check_nearest(Crossings(trace, domains))
    for generation in range(trace.generations):
        for name, column in trace.geometry(generation).items():
            assert not np.isnan(column).any(), name
    for name in ("t", "radiance"):
        assert not np.isnan(trace.column(name)).any()
    image = trace.image()
    assert np.isfinite(image).all()
    assert (image >= 0.0).all()
    assert (image == trace.reference).all()


FLAT = {
    "a corner twice": [[0, 0, 5], [7, 20, 20], [30, 31, 30]],
    "a point": [[4, 4, 4], [80, 80, 80]],
    "three in a row": [[169, 170, 171], [171, 169, 170]],
}


@pytest.mark.parametrize("path", [PathTracing(3, 3, 0.3), AmbientOcclusion(4), SprayPathTracing(2, 2)])
@pytest.mark.parametrize("kind", FLAT)
def test_numerics_triangles_without_area_change_no_pixel(kind, path):
    plain, more = traced(scene_of(bumpy()), path=path), traced(scene_of(bumpy(FLAT[kind])), path=path)
    assert (plain.image() == more.image()).all()
    assert plain.rays == more.rays
    check(more)


def test_numerics_a_lamp_of_triangles_without_area_shines_nowhere():
    lamp = Mesh(np.array([[0, 0, 2], [1, 0, 2], [2, 0, 2]], np.float32), np.array([[0, 1, 2], [1, 1, 2]]), 1)
    trace = traced(scene_of(bumpy(), lamp))
    # A candidate light draws numbers of its own, so only the mean of the image stays.
    assert trace.image().mean() == pytest.approx(traced(scene_of(bumpy())).image().mean(), rel=0.03)
    check(trace)


def test_numerics_triangles_that_are_there_twice_change_no_pixel():
    faces = bumpy_grid()[1]
    plain, twice = traced(scene_of(bumpy())), traced(scene_of(bumpy(faces)))
    turned = traced(scene_of(bumpy(faces[:, ::-1])))
    assert (plain.image() == twice.image()).all()
    # Turned round, a copy has other barycentric coordinates, and its hits lie elsewhere in the last digit.
    assert np.abs(plain.image() - turned.image()).max() < 1e-4
    check(twice, tied=True)
    check(turned, tied=True)


def test_numerics_two_coplanar_floors_of_one_material_look_like_one():
    view = camera((0.0, -3.0, 2.0), (0.0, 3.0, -2.0), 0.4)
    one, two = scene_of(plane(4.0)), scene_of(plane(4.0), plane(2.0))
    first, second = traced(one, view), traced(two, view)
    # Which of the two is hit makes a difference in the last digit of where secondary rays start.
    same = np.abs(first.image() - second.image()) < 1e-4
    assert same.all(axis=2).mean() > 0.99
    check(second, tied=True)


@pytest.mark.parametrize("thin", [1e-3, 1e-6])
def test_numerics_needles_cover_their_square_without_a_gap(thin):
    """A square cut into strips, each as thin as a share of its length, of which most have none to spare."""
    n = 200
    x = np.concatenate([thin * np.arange(n), np.linspace(thin * n, 1.0, 3)])
    vertices = np.concatenate([np.column_stack([x, np.full(len(x), y), np.zeros(len(x))]) for y in (0.0, 1.0)])
    a = np.arange(len(x) - 1)
    faces = np.concatenate(
        [np.column_stack([a, a + 1, a + len(x)]), np.column_stack([a + 1, a + len(x) + 1, a + len(x)])]
    )
    trace = traced(scene_of(Mesh(vertices, faces)), camera((0.5, 0.5, 2.0), (0.0, 0.0, -1.0), 0.2))
    assert np.isfinite(trace.column("t")[: 2 * trace.pixels]).all()
    assert trace.column("t")[: 2 * trace.pixels] == pytest.approx(2.0 / -trace.geometry(0)["direction"][:, 2], rel=1e-5)
    check(trace)
    narrow = camera((0.5 * thin * n, 0.5, 2.0), (0.0, 0.0, -1.0), 0.2 * thin * n)
    close = traced(scene_of(Mesh(vertices, faces)), narrow)
    assert np.isfinite(close.column("t")[: 2 * close.pixels]).all()
    check(close, tied=True)


def test_numerics_a_mesh_of_one_triangle():
    triangle = Mesh(np.array([[-1, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32), np.array([[0, 1, 2]]))
    trace = traced(scene_of(triangle), camera((0.0, -3.0, 0.5), (0.0, 1.0, 0.0), 0.4))
    assert 0.1 < np.isfinite(trace.column("t")[: trace.pixels]).mean() < 0.9
    check(trace)


def test_numerics_a_scene_of_triangles_without_area_only_shows_the_sky():
    point = Mesh(np.array([[0, 0, 0], [1, 1, 1], [2, 2, 2]], np.float32), np.array([[0, 1, 2], [0, 0, 0]]))
    trace = traced(scene_of(point))
    assert np.isinf(trace.column("t")).all()
    assert (
        trace.image() == traced(scene_of(bumpy()), camera((0, 0, 50.0), VIEW[1] * [1, 1, -1], 0.5)).image()
    ).mean() < 1
    check(trace)


SQUARE_LOW, SQUARE_HIGH = (corner.astype(float) for corner in scene_of(bumpy()).bounds)
CAMERAS = {
    "inside a domain": (np.array([0.4, 0.3, 0.0]), (-1.0, -0.7, 0.1)),
    "on the face between domains": (np.array([0.0, 0.6, 0.5]), (0.0, -1.0, -0.5)),
    "on the outer face": (np.array([SQUARE_LOW[0], 0.2, 0.1]), (1.0, 0.0, 0.0)),
    "in a corner": (SQUARE_HIGH, (-1.0, -1.0, -0.3)),
    "on a vertex": (bumpy_grid()[0][84], (0.3, 0.2, 1.0)),
    "outside, looking away": (np.array([5.0, 5.0, 5.0]), (1.0, 1.0, 0.2)),
    "outside, along an axis": (np.array([-7.0, 0.0, 0.0]), (1.0, 0.0, 0.0)),
}


@pytest.mark.parametrize("where", CAMERAS)
def test_numerics_a_camera_anywhere_sees_the_same_whatever_the_partition(where):
    position, forward = CAMERAS[where]
    trace = traced(scene_of(bumpy()), camera(tuple(position), forward, 0.6))
    seen = np.isfinite(trace.column("t")[: trace.pixels]).mean()
    assert (seen > 0.0) == (where != "outside, looking away")
    check(trace, tied=where == "on a vertex")  # where each triangle around is hit at the distance 0


def test_numerics_an_empty_domain_is_entered_by_no_ray():
    trace = traced(scene_of(bumpy()))
    domains = cuts(trace.scene)[0]
    empty = {d for d in range(domains.count) if not (domains.domain_of_triangle == d).any()}
    assert empty == {1, 4}
    world = SurfaceWorld(trace.scene, PathTracing())
    rows = np.arange(100)
    for d in empty:
        assert world.domain_geometry(domains, d) is None
        hit = world.cross(trace.geometry(0), rows, domains, np.full(100, d, np.int16), 1)["hit"]
        assert np.isinf(hit).all()
    crossings = Crossings(trace, domains)
    for generation in range(trace.generations):
        assert not np.isin(crossings.table(generation)["domain"], list(empty)).any()
