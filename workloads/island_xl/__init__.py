"""A stand-in for the Moana island as Blender exports it: every mesh tessellated once more, with curved surfaces.

The original (ray queue cycling paper, figure 1 and section 5) is "conceptually the same model" as the island, but
tessellated by Blender's subdivision surfaces. Here Phong tessellation (Boubekeur and Alexa, "Phong tessellation",
SIGGRAPH Asia 2008) subdivides the meshes, so that unique triangles grow fourfold with every level and instances stay.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simrender.rays.scene import F32, Mesh, Scene, SceneObject
from workloads.island import island
from workloads.terrain import F64, I64, unit

ROUNDNESS = 0.75  # the share of the curved position, as in the paper


def island_xl(*, seed: int = 1, detail: float = 0.8, levels: int = 1) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    seed : int
    detail : float
        That of the island before it is subdivided; its instanced triangles grow with the square.
    levels : int
        How often every triangle is divided into four.

    Returns
    -------
    Scene
        About 2 M instanced triangles by default; to be seen like the island.

    """
    scene = island(seed=seed, detail=detail)
    things = tuple(
        SceneObject(thing.name, tuple(subdivided(mesh, levels) for mesh in thing.meshes)) for thing in scene.objects
    )
    return replace(scene, objects=things)


def subdivided(mesh: Mesh, levels: int) -> Mesh:
    """Return a mesh with every triangle divided into four, as often as asked for.

    New points on edges between two triangles are pulled towards the planes that the normals of the edge's ends span;
    those on borders stay in the middle of their edges, so that meshes that meet along a border still do.
    """
    for _ in range(levels):
        faces = mesh.faces.astype(np.int64)
        count = len(mesh.vertices)
        halves = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]], axis=2)  # edge k lies opposite corner k
        keys, edge, uses = np.unique(halves[..., 0] * count + halves[..., 1], return_inverse=True, return_counts=True)
        ends = np.stack([keys // count, keys % count], axis=1)
        position = mesh.vertices.astype(np.float64)
        middle = 0.5 * (position[ends[:, 0]] + position[ends[:, 1]])
        normals = _normals(position, faces)
        curved = sum(middle - _dot(middle - position[end], normals[end]) * normals[end] for end in ends.T)
        middle = np.where((uses == 2)[:, None], middle + ROUNDNESS * (0.5 * curved - middle), middle)
        a, b, c = faces.T
        p, q, r = (edge.reshape(-1, 3) + count).T
        fours = np.stack([a, r, q, r, b, p, q, p, c, p, q, r], axis=1).reshape(-1, 3)
        colors, uv = mesh.colors, mesh.uv
        mesh = replace(
            mesh,
            vertices=np.concatenate([mesh.vertices, middle.astype(np.float32)]),
            faces=fours.astype(np.int32),
            colors=None if colors is None else _between(colors, ends),
            uv=None if uv is None else _between(uv, ends),
        )
    return mesh


def _normals(position: F64, faces: I64) -> F64:
    """Return unit vertex normals (v, 3), means of those of the faces by area."""
    a, b, c = position[faces[:, 0]], position[faces[:, 1]], position[faces[:, 2]]
    across = np.cross(b - a, c - a)
    sums = [np.bincount(faces.ravel(), np.repeat(column, 3), minlength=len(position)) for column in across.T]
    return unit(np.stack(sums, axis=1))


def _dot(a: F64, b: F64) -> F64:
    return np.asarray((a * b).sum(axis=1, keepdims=True), np.float64)


def _between(values: F32, ends: I64) -> F32:
    return np.concatenate([values, 0.5 * (values[ends[:, 0]] + values[ends[:, 1]])])
