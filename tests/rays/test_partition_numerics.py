"""However a scene is cut, its rays hit the same things: rays in general position to the bit, others but for ties."""

from __future__ import annotations

import numpy as np
import pytest

from simrender import load_workload
from simrender.accuracy.partitions import (
    CUTS,
    Welded,
    aimed_rays,
    bundle,
    compare,
    nearest,
    partitions,
    path_rays,
    random_rays,
)
from simrender.accuracy.stability import escapes
from simrender.errors import SceneError
from simrender.rays import embree
from simrender.rays.crossings import Crossings
from simrender.rays.domains import Domains, from_triangles
from simrender.rays.integrators import PathTracing
from simrender.rays.scene import IDENTITY, Mesh, Scene, SceneObject
from simrender.rays.worlds import SurfaceWorld
from tests.scenes import check_nearest, garden_workload, sphere

SMALL = {
    "island": "detail=0.1",
    "island-xl": "detail=0.05",
    "landscape": "detail=0.1",
    "rm": "points=40",
    "rm-isosurface": "points=60",
    "enzo": "points=40",
    "boeing": "detail=0.03",
    "museum": "detail=0.03",
    "wavelets": "across=2",
}
RANDOM = 40_000
LOOSE, AIMED = ("paths", "random"), ("vertices", "edges", "axis-parallel", "diagonal", "faces")
COPLANAR = {"museum", "boeing"}  # feet stand in the plane of the floor: of two triangles at one place either is seen


@pytest.fixture(scope="module")
def table(trace_cache):
    return [
        row
        for name, argument in SMALL.items()
        for row in partitions(
            load_workload(name, [f"scene.arguments.{argument}"], trace_cache),
            CUTS[:2] if name in COPLANAR else CUTS,  # the large ones
            RANDOM,
        )
    ]


def total(rows, column):
    return sum(row[column] for row in rows)


def test_numerics_a_million_rays_in_general_position_hit_the_same_whatever_the_partition(table):
    rows = [row for row in table if row["aim"] in LOOSE]
    assert total(rows, "rays") >= 1_000_000
    assert {row["scene"] for row in rows} == set(SMALL)
    assert {row["cut"] for row in rows} == {"given", *(cut.method for cut in CUTS)}
    assert (total(rows, "leaks"), total(rows, "strays"), total(rows, "differences")) == (0, 0, 0)
    assert total([row for row in rows if row["scene"] not in COPLANAR], "ties") == 0
    assert total(rows, "hits") > 0.5 * total(rows, "rays")


def test_watertight_no_ray_at_a_vertex_an_edge_or_a_face_leaks_between_domains(table, record_property):
    for aim in AIMED:
        rows = [row for row in table if row["aim"] == aim]
        assert total(rows, "rays") > 100_000
        assert (total(rows, "leaks"), total(rows, "strays")) == (0, 0)
        record_property(f"ties at {aim}", total(rows, "ties"))


def test_watertight_rays_through_a_surface_at_its_vertices_hit_it(table):
    rows = [row for row in table if row["aim"] in AIMED[2:]]
    # One of a hundred thousand may slip past a vertex, and does so however the scene is cut.
    assert total(rows, "rays") - total(rows, "hits") <= 1e-5 * total(rows, "rays")


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_watertight_a_ray_within_the_plane_in_which_a_domain_begins_or_ends_is_not_lost(axis, side):
    """Triangles one behind the other end in the plane of the ray: Embree alone sees them on one side only."""
    corners = np.float32([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [side, 0.0, 0.0]])
    behind = np.float32([0.0, 1.0, 0.0]) * np.arange(32, dtype=np.float32)[:, None, None]
    geometry = embree.Geometry(np.roll((corners + behind).reshape(-1, 3), axis, axis=1), np.arange(96).reshape(-1, 3))
    for sign in (1.0, -1.0):
        start, along = np.roll([0.0, 15.5 - 18.5 * sign, 0.25], axis), np.roll([0.0, sign, 0.0], axis)
        t, primitive = nearest(geometry, bundle(start[None], along[None]))
        assert (t.tolist(), primitive.tolist()) == ([3.0], [0 if sign > 0 else 31])


@pytest.fixture(scope="module")
def inside():
    """A fine closed sphere in eight domains, and a function that compares rays from points inside towards targets."""
    scene = one(closed_sphere(40))
    middle = scene.triangles.vertices[scene.triangles.faces].mean(axis=1)
    octant = ((middle > 0) @ [1, 2, 4]).astype(np.int32)
    domains = from_triangles(scene.triangles, octant, 8, 0.0, 0.0)
    world = SurfaceWorld(scene, PathTracing())

    def look(targets):
        start = np.resize(np.float32([[0.0, 0.0, 0.0], [0.25, -0.5, 0.125], [0.25, -0.5, 0.0]]), targets.shape)
        return compare(world, domains, bundle(start, targets - start))

    return scene.triangles.vertices[scene.triangles.faces], look


def test_watertight_no_ray_gets_out_of_a_closed_surface_through_an_edge(inside):
    corners, look = inside
    others = np.roll(corners, 1, axis=1)
    for share in (0.5, 0.25, 1e-3):
        found = look(((1.0 - share) * corners + share * others).reshape(-1, 3))
        assert found.hits == found.rays == 3 * len(corners)
        assert (found.leaks, found.strays) == (0, 0)


def test_watertight_rays_straight_at_a_vertex_slip_through_everywhere_or_nowhere(inside):
    corners, look = inside
    found = look(corners.reshape(-1, 3))
    assert (found.leaks, found.strays) == (0, 0)


def test_watertight_only_rays_straight_at_a_vertex_get_out_of_a_closed_surface_and_few_of_them():
    for row in escapes([6, 12, 40, 80]):
        assert row.rays == 3 * row.triangles
        assert (row.at_edges, row.anywhere) == (0, 0)
        assert row.at_vertices <= 0.01 * row.rays
        assert row.at_vertices == 0 or row.triangles > 1000


@pytest.mark.parametrize("cut", [0, 1, 2, 3])
def test_numerics_the_crossing_table_knows_the_nearest_hit(cut, tmp_path):
    workload = garden_workload("48x32", "48x32", 1, tmp_path)
    trace, domains = workload.trace(), workload.domains(CUTS[cut])
    trace.complete()
    check_nearest(Crossings(trace, domains))


def test_numerics_equally_near_hits_go_to_the_lower_triangle_wherever_it_lies():
    mesh = closed_sphere(8)
    scene = Scene((SceneObject("twice", (mesh, mesh)),), np.zeros(1, np.int32), IDENTITY[None])
    half = len(mesh.faces)
    world = SurfaceWorld(scene, PathTracing())
    rays = random_rays(scene, 2000)
    for first in (0, 1):
        domains = from_triangles(scene.triangles, np.repeat(np.int32([first, 1 - first]), half), 2, 0.0, 0.0)
        primitive = nearest(world.geometry, rays)[1]
        found = compare(world, domains, rays)
        assert (found.leaks, found.differences) == (0, 0)
        # Over domains it is the first of both copies; the one hierarchy takes either.
        assert found.ties == (primitive >= half).sum()


def test_aimed_rays_pass_through_what_they_are_aimed_at():
    workload = garden_workload()
    domains = workload.domains(CUTS[1])
    aims = aimed_rays(workload.scene, domains, 500)
    assert set(aims) == set(AIMED)
    vertices = workload.scene.triangles.vertices.astype(np.float64)
    for aim in ("axis-parallel", "diagonal"):
        rays = {name: column.astype(np.float64) for name, column in aims[aim].items()}
        assert 50 < len(rays["reach"]) <= 500
        middle = rays["origin"] + 0.5 * rays["reach"][:, None] * rays["direction"]
        gap = np.abs(middle[:, None] - vertices).max(axis=2).min(axis=1)
        assert gap.max() < 1e-5
    assert (np.sort(np.abs(aims["axis-parallel"]["direction"]), axis=1) == [0.0, 0.0, 1.0]).all()
    assert (aims["faces"]["direction"] == 0.0).any(axis=1).all()


def test_rays_go_through_a_surface_only_where_its_faces_look_the_same_way():
    """Of a square pyramid whose sides look outwards and whose base, turned over, looks inwards: through its tip."""
    corners = np.float32([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [1, 1, 1]])
    sides = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]]
    for base, vertices in (([[0, 3, 2], [0, 2, 1]], 5), ([[0, 2, 3], [0, 1, 2]], 1)):
        assert len(Welded(one(Mesh(corners, np.int32(sides + base)))).inner) == vertices


def test_the_rays_of_a_frame_are_those_of_the_camera_and_all_that_they_spawn(tmp_path):
    trace = garden_workload("48x32", "48x32", 1, tmp_path).trace()
    rays = path_rays(trace)
    assert len(rays["reach"]) == trace.rays > 2 * trace.pixels
    assert np.isfinite(rays["reach"]).sum() == (trace.column("kind") == 3).sum()


def test_domains_of_something_else_are_refused():
    bricks = Domains(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32), np.ones(1), np.ones(1))
    scene = one(closed_sphere(4))
    with pytest.raises(SceneError, match="do not say which triangles"):
        aimed_rays(scene, bricks, 1)
    with pytest.raises(SceneError, match="do not say which triangles"):
        compare(SurfaceWorld(scene, PathTracing()), bricks, random_rays(scene, 1))


def closed_sphere(rings):
    """A sphere whose seam and poles are welded."""
    mesh = sphere(rings=rings)
    vertices, same = np.unique(np.round(mesh.vertices, 6) + 0.0, axis=0, return_inverse=True)
    faces = same.reshape(-1)[mesh.faces]
    solid = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return Mesh(vertices, faces[solid])


def one(mesh):
    return Scene((SceneObject("one", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None])
