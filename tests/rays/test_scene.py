"""Scenes: what is refused, and how instances are written out."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays.scene import IDENTITY, Material, Mesh, Scene, SceneObject
from tests.scenes import MATERIALS, floor, garden, placed, sphere

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def test_an_empty_mesh_is_refused():
    with pytest.raises(SceneError, match="the mesh is empty: it has no triangles"):
        Mesh(TRIANGLE, np.zeros((0, 3), np.int32))


def test_vertices_that_are_not_finite_are_counted_and_the_first_is_named():
    vertices = TRIANGLE.copy()
    vertices[1:] = np.nan
    with pytest.raises(SceneError, match=r"2 of 3 vertices are not finite; the first is vertex 1: \[nan, nan, nan\]"):
        Mesh(vertices, np.array([[0, 1, 2]]))


@pytest.mark.parametrize("face", [[0, 1, 3], [-1, 1, 2]])
def test_faces_that_point_outside_are_named(face):
    with pytest.raises(SceneError, match=r"1 face points outside the 3 vertices; the first is face 0"):
        Mesh(TRIANGLE, np.array([face]))


def test_a_scene_without_instances_is_refused():
    thing = SceneObject("t", (Mesh(TRIANGLE, np.array([[0, 1, 2]])),))
    with pytest.raises(SceneError, match="the scene is empty"):
        Scene((thing,), np.zeros(0, np.int32), np.zeros((0, 3, 4)))


def test_an_unknown_material_is_named():
    thing = SceneObject("t", (Mesh(TRIANGLE, np.array([[0, 1, 2]]), 7),))
    with pytest.raises(SceneError, match="object 't' uses material 7 of 1"):
        Scene((thing,), np.zeros(1, np.int32), IDENTITY[None])


def test_triangles_are_numbered_by_instance_then_mesh_then_face():
    two = SceneObject(
        "two", (Mesh(TRIANGLE, np.array([[0, 1, 2]])), Mesh(TRIANGLE + 5, np.array([[0, 1, 2], [2, 1, 0]])))
    )
    one = SceneObject("one", (Mesh(TRIANGLE * 2, np.array([[0, 1, 2]])),))
    owner = np.array([1, 0, 1])
    scene = Scene((two, one), owner, placed(np.array([[0, 0, 1], [0, 0, 2], [0, 0, 3]]), np.ones(3)), (Material(),))
    flat = scene.triangles
    assert flat.mesh.tolist() == [2, 0, 1, 1, 2]
    corners = flat.vertices[flat.faces]
    assert corners[:, 0, 2].tolist() == [
        1,
        2,
        7,
        7,
        3,
    ]  # z of each triangle's first corner: its instance, then its mesh
    assert scene.unique_triangles == 4
    assert scene.instanced_triangles == 5


def test_the_key_follows_the_content():
    assert garden().key == garden().key
    assert garden(seed=4).key != garden().key
    scene = garden()
    moved = Scene(scene.objects, scene.instance_object, scene.instance_transform + np.float32(1e-6), MATERIALS)
    assert moved.key != scene.key


def test_the_garden_has_what_the_tests_need():
    scene = garden()
    assert len(floor().meshes) == 4
    assert len(sphere().faces) == scene.objects[3].triangles or scene.unique_triangles > 1000
    assert {m.emission != (0, 0, 0) for m in scene.materials} == {True, False}
