"""Squares one above the other: a ray that hits one would hit all that come behind it."""

from __future__ import annotations

import numpy as np

from simrender.rays.crossings import Crossings
from simrender.rays.domains import from_triangles
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.trace import Trace

LIGHT = PointLight((0.3, 0.2, 50.0), (1.0, 1.0, 1.0), falloff=False)
CAMERA = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, -1.0], [0.4, 0.1, 0.0], [-0.1, 0.4, 0.0]])
MATERIAL = Material((0.8, 0.8, 0.8))


def layers(integrator, heights, cut, copies=1, size=(8, 6)):
    """Crossings of squares, one above the other, each as often as there are copies; a camera looks down on them."""
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    objects = tuple(
        SceneObject(f"square {k} {c}", (Mesh(square * (1 + k) + [0, 0, z], np.array([[0, 1, 2], [0, 2, 3]]), 0),))
        for c in range(copies)
        for k, z in enumerate(heights)
    )
    n = len(objects)
    scene = Scene(objects, np.arange(n), np.tile(IDENTITY, (n, 1, 1)), (MATERIAL,), (LIGHT,), Environment())
    trace = Trace(scene, CAMERA, size, 1, integrator)
    trace.complete()
    return Crossings(trace, cut(trace.scene))


def by_object(scene):
    """A domain an object."""
    owner = np.repeat(np.arange(len(scene.objects)), 2).astype(np.int32)
    return from_triangles(scene.triangles, owner, len(scene.objects), 1e6, 1e3)
