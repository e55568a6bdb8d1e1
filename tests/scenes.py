"""Small scenes for tests: a few hundred triangles with everything a path tracer can meet."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from simrender.cards import Document
from simrender.rays.crossings import Crossings
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.workload import Workload
from simrender.rays.workload_card import WorkloadCard

WHITE, MIRROR, LAMP = 0, 1, 2
MATERIALS = (Material((0.75, 0.75, 0.75)), Material((0.9, 0.9, 0.9), mirror=0.8), Material(emission=(8.0, 7.0, 5.0)))


def sphere(material: int = WHITE, rings: int = 12) -> Mesh:
    """A unit sphere about the origin."""
    theta, phi = np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    vertices = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    return Mesh(vertices, grid(*t.shape), material)


def grid(rows: int, columns: int) -> np.ndarray:
    """The triangles between the points of a grid."""
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]))
    return np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)])


def floor(size: float = 4.0, cells: int = 16, material: int = WHITE) -> SceneObject:
    """A bumpy floor in four meshes, so that it can be split."""
    x = np.linspace(-size, size, cells + 1)
    meshes = []
    for half in np.array_split(np.arange(cells + 1), 4):
        columns = np.append(half, half[-1] + 1) if half[-1] < cells else half
        u, v = np.meshgrid(x, x[columns], indexing="ij")
        z = 0.15 * np.sin(3 * u) * np.cos(2 * v)
        meshes.append(Mesh(np.stack([u, v, z], -1).reshape(-1, 3), grid(*u.shape), material))
    return SceneObject("floor", tuple(meshes))


def placed(offsets: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Transforms that scale and then move."""
    transforms = np.tile(IDENTITY, (len(offsets), 1, 1))
    transforms[:, :, :3] *= np.asarray(scales, dtype=np.float32)[:, None, None]
    transforms[:, :, 3] = offsets
    return transforms


def garden(seed: int = 3, balls: int = 40) -> Scene:
    """A floor with instanced balls of five kinds, some mirror-like, under a lamp, a point light and a sky."""
    rng = np.random.Generator(np.random.Philox(key=seed))
    kinds = [SceneObject(f"ball{k}", (sphere(MIRROR if k == 1 else WHITE, 4 + 3 * k),)) for k in range(5)]
    lamp = SceneObject("lamp", (sphere(LAMP, 5),))
    objects = (floor(), *kinds, lamp)
    owner = np.concatenate([[0], rng.integers(1, 6, balls), [6]])
    offsets = np.concatenate([[[0, 0, 0]], rng.uniform((-3, -3, 0.3), (3, 3, 1.2), (balls, 3)), [[0.5, -1.0, 3.0]]])
    scales = np.concatenate([[1.0], rng.uniform(0.15, 0.45, balls), [0.3]])
    sun = PointLight((20.0, -10.0, 30.0), (2500.0, 2400.0, 2200.0))
    return Scene(objects, owner, placed(offsets, scales), MATERIALS, (sun,), Environment())


CARD = """
title: A garden
published: {{resolution: {published}, samples: {samples}}}
traced: {{resolution: {traced}}}
scene: {{generator: "tests.scenes:garden"}}
camera: {{position: [5.5, -5.0, 3.0], look_at: [0, 0, 0.4], vertical_fov_degrees: 38}}
bounces: {{diffuse: 4, mirror: 4, roulette: 0.4}}
"""


def garden_workload(
    published: str = "96x64",
    traced: str = "96x64",
    samples: int = 2,
    cache: Path | None = None,
    scene: Scene | None = None,
) -> Workload:
    """The garden as a workload; the default is traced at its published size."""
    document = Document(CARD.format(published=published, traced=traced, samples=samples), "garden.yaml")
    return Workload("garden", document.validate(WorkloadCard), document, Path(), cache, scene or garden())


def check_nearest(crossings: Crossings) -> None:
    """Of the domains that a ray crosses, the one with the nearest hit has the hit of the trace."""
    trace = crossings.trace
    for generation in range(trace.generations):
        table = crossings.table(generation)
        hit = crossings.hits(generation, np.arange(len(table["hit"])))
        assert not np.isnan(hit).any()
        assert not np.isnan(table["entry"]).any()
        t = trace.column("t")[trace.first[generation] : trace.first[generation + 1]]
        least = np.full(len(t), np.inf, np.float32)
        np.minimum.at(least, np.repeat(np.arange(len(t)), np.diff(table["first"])), hit)
        assert (least == t).all()
