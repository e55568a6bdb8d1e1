"""The scene of figure 2 of SpRay: four domains with a shape each, three camera rays, and the shadow rays of two.

Domains lie in a square, A and B below C and D; everything happens in the plane z = 1/2::

    2 +------+------+      r0 passes A, B and D and hits nothing
      |  C   |   D  |      r1 passes A and C and hits the circle in D; its shadow ray s1 passes C and ends at the
    1 +------+------+         pentagon in A
      |  A   |   B  |      r2 passes A and hits the triangle in C; its shadow ray s2 passes A and reaches the light
    0 +------+------+

The camera and the light are below A.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from simrender.rays.crossings import Crossings
from simrender.rays.domains import from_triangles
from simrender.rays.integrators import SprayPathTracing
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.trace import Trace

A, B, C, D = range(4)

CAMERA = np.array([0.0, -0.5, 0.5])
LIGHT = np.array([-0.5, -0.5, 0.5])
TRIANGLE, CIRCLE = np.array([0.475, 1.4, 0.5]), np.array([1.2, 1.6, 0.5])

LEFT, RIGHT = np.array([0.2444, 0.9776, 0.0]), np.array([1.0, 1.2, 0.0])
"""Directions of r2 and r0; that of r1 is half way between them."""


def polygon(centre: np.ndarray, facing: np.ndarray, corners: int, radius: float) -> SceneObject:
    """A flat polygon that faces a direction of the plane."""
    along = np.array([-facing[1], facing[0], 0.0]) / np.linalg.norm(facing)
    angle = 2.0 * np.pi * np.arange(corners)[:, None] / corners + 0.1
    rim = centre + radius * (np.cos(angle) * along + np.sin(angle) * np.array([0.0, 0.0, 1.0]))
    fan = np.array([(0, k, k + 1) for k in range(1, corners - 1)])
    return SceneObject(f"polygon of {corners}", (Mesh(rim, fan, 0),))


def figure2(cache: Path | None = None) -> Crossings:
    """The crossings of the scene's rays: r0, r1 and r2 are rays 0, 1 and 2, s1 and s2 rays 3 and 4."""
    half_way = CIRCLE - 0.64 * (CIRCLE - LIGHT)
    shapes = (
        polygon(half_way, LIGHT - CIRCLE, 5, 0.08),
        polygon(np.array([1.6, 0.3, 0.5]), np.array([1.0, 0.0, 0.0]), 4, 0.1),
        polygon(TRIANGLE, CAMERA - TRIANGLE, 3, 0.1),
        polygon(CIRCLE, CAMERA - CIRCLE, 24, 0.15),
    )
    light = PointLight(tuple(LIGHT.tolist()), (1.0, 1.0, 1.0), falloff=False)
    scene = Scene(
        shapes, np.arange(4), np.tile(IDENTITY, (4, 1, 1)), (Material((0.8, 0.8, 0.8)),), (light,), Environment()
    )
    # Pixels 0, 1, 2 look at the left edge, a third and two thirds of the image.
    step = (LEFT - RIGHT) / 2.0
    camera = np.array([CAMERA, RIGHT + 1.5 * step, 1.5 * step, [0.0, 0.0, 0.0]])
    trace = Trace(scene, camera, (3, 1), 1, SprayPathTracing(shadow_samples=1, bounces=1), cache=cache, jitter=False)
    trace.complete()
    assert trace.factor == 1.0
    owner = np.repeat(np.arange(4), [thing.triangles for thing in shapes]).astype(np.int32)
    cells = from_triangles(scene.triangles, owner, 4, 4e6, 4e3)
    low = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    assert (cells.low >= low).all()
    assert (cells.high <= low + 1).all()
    return Crossings(trace, replace(cells, low=low, high=low + np.float32(1.0)))
