"""The isosurface scenes: as many domains as published, of the right kind of grid, and closed across their borders."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from simrender.catalog import cards
from simrender.errors import SceneError
from simrender.rays.embree import Geometry
from simrender.rays.scene import Environment
from simrender.rays.workload import load_workload
from workloads.dns import channel_surface
from workloads.enzo import log_density, web
from workloads.fields import balanced_planes, bricks, crossed, even_planes, holding, level_leaving_empty, surface_scene
from workloads.rm import interface, uneven_planes
from workloads.wavelets import wavelet, wavelets

ROOT = Path(__file__).parents[2]


@cache
def scene(name):
    return {
        "rm": lambda: interface(points=64),
        "rm later": lambda: interface(points=48, mixing=1.6, sun=True),
        "enzo": lambda: web(points=48),
        "dns1": lambda: channel_surface(points=160, half=True),
        "dns2": lambda: channel_surface(points=140),
    }[name]()


SCENES = ["rm", "rm later", "enzo", "dns1", "dns2"]


def boxes(of):
    low = np.array([thing.meshes[0].vertices.min(axis=0) for thing in of.objects])
    high = np.array([thing.meshes[0].vertices.max(axis=0) for thing in of.objects])
    return low, high


def places(of):
    """Return the grid cell of each domain, as its name says, int (domains, 3) in the order x, y, z."""
    return np.array([[int(word) for word in thing.name.split()[1:]] for thing in of.objects])


@pytest.mark.parametrize(("name", "domains"), [("rm", 52), ("enzo", 16), ("dns1", 720), ("dns2", 1427)])
def test_there_are_as_many_domains_as_published(name, domains):
    assert len(scene(name).objects) == domains
    assert (scene(name).instances_of == 1).all()
    assert all(len(thing.meshes) == 1 for thing in scene(name).objects)
    assert all(thing.triangles > 0 for thing in scene(name).objects)


@pytest.mark.parametrize("points", [40, 64, 81])
@pytest.mark.parametrize("mixing", [1.0, 1.6])
def test_there_are_52_domains_at_every_size_and_time(points, mixing):
    assert len(interface(points=points, mixing=mixing, seed=2).objects) == 52


@pytest.mark.parametrize("name", SCENES)
def test_domains_stand_in_the_order_of_the_grid(name):
    x, y, z = places(scene(name)).T
    number = x + (x.max() + 1) * (y + (y.max() + 1) * z)
    assert (np.diff(number) > 0).all()
    if name.startswith("dns"):
        assert (x.max() + 1, y.max() + 1, z.max() + 1) == (20, 12, 3 if name == "dns1" else 6)


@pytest.mark.parametrize("name", SCENES)
def test_domains_lie_side_by_side(name):
    low, high = boxes(scene(name))
    cell = places(scene(name))
    for axis in range(3):
        layers = range(cell[:, axis].max() + 1)
        ends = [(low[cell[:, axis] == k, axis].min(), high[cell[:, axis] == k, axis].max()) for k in layers]
        assert all(a[1] <= b[0] for a, b in pairwise(ends))


def test_grids_are_uniform_or_not_as_published():
    def widths(name, axis):
        (low, high), cell = boxes(scene(name)), places(scene(name))
        cuts = [low[cell[:, axis] == k, axis].min() for k in range(cell[:, axis].max() + 1)]
        return np.diff([*cuts, high[:, axis].max()])

    for axis, width in enumerate((512.0, 640.0, 256.0)):
        assert widths("dns2", axis)[1:-1] == pytest.approx(width, rel=0.35)  # a grid point at most from equal
    assert max(np.ptp(widths("rm", axis)) / widths("rm", axis).mean() for axis in range(3)) > 0.3
    assert max(np.ptp(widths("enzo", axis)) / widths("enzo", axis).mean() for axis in range(3)) > 0.05
    counts = np.array([thing.triangles for thing in scene("enzo").objects])
    assert counts.max() > 1.2 * counts.min()


@pytest.mark.parametrize("name", SCENES)
def test_the_surface_is_closed_across_domains(name):
    meshes = scene(name).meshes
    every = np.concatenate([mesh.vertices for mesh in meshes])
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)])
    bits = every.view(np.uint32).astype(np.uint64)
    key = (bits[:, 0] * np.uint64(0x9E3779B97F4A7C15)) ^ (bits[:, 1] * np.uint64(0xC2B2AE3D27D4EB4F)) ^ bits[:, 2]
    _, one = np.unique(key, return_inverse=True)
    corners = one[faces]
    edges = np.sort(np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]), axis=1)
    _, where, times = np.unique(edges[:, 0] << 32 | edges[:, 1], return_index=True, return_counts=True)
    assert (times % 2 == 1).any()
    start, end = faces.T.ravel()[where], np.roll(faces, -1, axis=1).T.ravel()[where]
    # An edge of one triangle lies in one of the six sides of the volume; none is left open inside.
    odd = times % 2 == 1
    low, high = every.min(axis=0), every.max(axis=0)
    a, b = every[start[odd]], every[end[odd]]
    sides = np.stack([(a == c) & (b == c) for c in (low, high)])
    assert sides.any(axis=(0, 2)).all()
    assert (times <= 4).all()
    assert (times == 2).mean() > 0.9


@pytest.mark.parametrize(
    ("generate", "sizes"),
    [
        (interface, (40, 80)),
        (web, (32, 64)),
        (channel_surface, (140, 200)),
        (lambda points: wavelets(points=points), (11, 41)),
    ],
)
def test_triangles_grow_like_a_rough_surface(generate, sizes):
    few, many = (generate(points=points).unique_triangles for points in sizes)
    dimension = np.log(many / few) / np.log(sizes[1] / sizes[0])
    assert 1.7 < dimension < 3.0


def test_surfaces_have_about_the_published_number_of_layers():
    # Triangles over columns of voxels: 108 M, 1.8 G and 0.9 G of the papers over theirs.
    assert interface(points=112).unique_triangles / 112**2 == pytest.approx(108e6 / 2048**2, rel=0.4)
    assert scene("dns2").unique_triangles / (140 * 105) == pytest.approx(1.8e9 / (10240 * 7680), rel=0.4)
    assert scene("dns1").unique_triangles / (160 * 120) == pytest.approx(0.9e9 / (10240 * 7680), rel=0.4)


@pytest.mark.parametrize("name", SCENES)
def test_scenes_are_lit_and_coloured(name):
    made = scene(name)
    assert all(mesh.smooth and mesh.colors is not None for mesh in made.meshes)
    assert all(mesh.colors.min() >= 0.0 and mesh.colors.max() <= 1.0 for mesh in made.meshes)
    assert (len(made.points), len(made.hemispheres)) == ((1, 0) if name == "rm later" else (0, 1))


def test_the_cosmic_web_is_clustered():
    density = 10.0 ** log_density(1, 48).astype(np.float64)
    assert density.mean() == pytest.approx(1.0, abs=0.35)
    ordered = np.sort(density.ravel())[::-1]
    assert ordered[: ordered.size // 10].sum() > 0.3 * ordered.sum()
    assert np.median(density) < 0.8


def test_the_wavelet_is_the_one_of_the_visualization_toolkit():
    values = wavelet(21)
    assert (values.min(), values.max()) == pytest.approx((37.3531, 276.829), abs=1e-3)
    made = wavelets()
    mesh = made.objects[0].meshes[0]
    assert (len(mesh.faces), len(mesh.vertices)) == (5480, 2840)  # as in SpRay's file
    assert mesh.vertices.min(axis=0) == pytest.approx([-10.0, -10.0, -10.0])
    assert mesh.vertices.max(axis=0) == pytest.approx([10.0, 9.324713, 10.0], abs=1e-4)
    assert len(made.objects) == 64
    assert made.instanced_triangles == 350_720
    assert all(thing.meshes[0] is mesh for thing in made.objects)


def test_boxes_of_wavelets_touch():
    made = wavelets(points=13, across=3)
    low, high = made.objects[0].meshes[0].vertices.min(axis=0), made.objects[0].meshes[0].vertices.max(axis=0)
    shift = made.instance_transform[:, :, 3]
    assert shift[0] == pytest.approx([0.0, 0.0, 0.0])
    for neighbour, axis in ((1, 0), (3, 1), (9, 2)):
        assert shift[neighbour, axis] + low[axis] == pytest.approx(high[axis], abs=1e-5)
    assert shift[26] == pytest.approx(2.0 * (high - low))


def test_spray_sees_as_much_of_the_wavelets():
    workload = load_workload("wavelets")
    camera, (width, height) = workload.card.camera, workload.card.published.resolution
    position, forward, right, up = camera.frame(1.0)
    x, y = np.meshgrid(np.arange(width) / width, np.arange(height) / height)
    direction = forward + (2.0 * x[..., None] - 1.0) * right + (2.0 * y[..., None] - 1.0) * up
    direction = (direction / np.linalg.norm(direction, axis=-1, keepdims=True)).reshape(-1, 3).astype(np.float32)
    origin = np.tile(position.astype(np.float32), (len(direction), 1))
    triangles = workload.scene.triangles
    hits = Geometry(triangles.vertices, triangles.faces).nearest(
        origin, direction, np.full(len(origin), np.inf, np.float32)
    )
    assert int((hits.primitive >= 0).sum()) == pytest.approx(71_464, abs=10)  # what the program itself counted


def test_the_same_seed_gives_the_same_scene_in_every_process():
    script = (
        "from workloads.rm import interface; from workloads.enzo import web; from workloads.wavelets import wavelets; "
        "print(interface(points=32).key, web(points=24).key, wavelets(points=9).key)"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-c", script]
    found = subprocess.run(
        command, env=environment, cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    assert found == [interface(points=32).key, web(points=24).key, wavelets(points=9).key]
    assert interface(points=32, seed=3).key != found[0]
    assert web(points=24, seed=3).key != found[1]


def test_planes_cut_evenly_or_by_weight():
    x, y, z = even_planes((11, 5, 3), (3, 4, 1))
    assert x.tolist() == [0, 3, 7, 10]
    assert y.tolist() == [0, 1, 2, 3, 4]
    assert z.tolist() == [0, 2]
    weight = np.zeros((2, 4, 10), bool)
    weight[0, 1, [0, 1, 2, 3, 8, 9]] = True
    planes = balanced_planes(weight, (3, 2, 2))
    assert planes[0].tolist() == [0, 2, 4, 10]
    assert planes[1].tolist() == [0, 2, 4]
    assert planes[2].tolist() == [0, 1, 2]


@pytest.mark.parametrize("marked", [0, 9])
def test_planes_ascend_even_if_all_weight_is_in_one_cell(marked):
    weight = np.zeros((10, 10, 10), bool)
    weight[marked, marked, marked] = True
    for cuts in balanced_planes(weight, (4, 4, 4)):
        assert cuts[0] == 0
        assert cuts[-1] == 10
        assert (np.diff(cuts) >= 1).all()


def test_bricks_fill_the_grid_once_x_fastest():
    planes = even_planes((8, 6, 5), (3, 2, 2))
    cells = bricks(planes)
    assert cells[:2].tolist() == [[0, 2, 0, 2, 0, 2], [2, 5, 0, 2, 0, 2]]
    count = np.zeros((4, 5, 7), int)
    for x0, x1, y0, y1, z0, z1 in cells:
        count[z0:z1, y0:y1, x0:x1] += 1
    assert (count == 1).all()


def test_domains_hold_the_surface_where_their_cells_cross_it():
    voxels = np.random.default_rng(1).random((9, 10, 11)).astype(np.float32)
    voxels[:5] += 1.0
    planes = even_planes((11, 10, 9), (2, 3, 4))
    crossing, held = crossed(voxels, 0.5), holding(voxels, 0.5, planes)
    for (z, y, x), (x0, x1, y0, y1, z0, z1) in zip(np.ndindex(held.shape), bricks(planes), strict=True):
        assert held[z, y, x] == crossing[z0:z1, y0:y1, x0:x1].any()
    assert not held.all()


@pytest.mark.parametrize("empty", [0, 1, 3])
def test_an_isovalue_leaves_so_many_domains_empty(empty):
    voxels = np.random.default_rng(1).random((5, 5, 33)).astype(np.float32)
    voxels += np.linspace(0.0, 0.2, 33, dtype=np.float32)
    planes = even_planes((33, 5, 5), (8, 2, 1))
    value = level_leaving_empty(voxels, planes, empty)
    assert int((~holding(voxels, value, planes)).sum()) == empty


@pytest.mark.parametrize(
    ("generate", "message"),
    [
        (lambda: channel_surface(points=20), "(20, 15, 4) points are too few for (20, 12, 6) domains"),
        (lambda: channel_surface(points=60), "no isovalue leaves exactly 13 of 1440 domains empty"),
        (lambda: interface(points=32, domains=65), "no 4 x 4 x 4 grid has 65 domains"),
        (lambda: uneven_planes(np.ones((8, 8, 8), bool), 52), "no 4 x 4 x 4 grid has 52 domains"),
        (
            lambda: surface_scene(
                np.zeros((4, 4, 4), np.float32),
                (1.0, 1.0, 1.0),
                0.5,
                even_planes((4, 4, 4), (1, 1, 1)),
                palette=[(1.0, 1.0, 1.0)],
                environment=Environment(),
            ),
            "there is no isosurface",
        ),
    ],
)
def test_what_cannot_be_cut_is_refused(generate, message):
    with pytest.raises(SceneError, match=re.escape(message)):
        generate()


@pytest.mark.parametrize(
    ("name", "triangles", "domains", "resolution", "samples"),
    [
        ("rm", 108e6, 52, (1024, 1024), 32),
        ("rm-isosurface", 316e6, None, (1920, 1080), 1),
        ("enzo", 6e6, 16, (1024, 1024), 32),
        ("dns1-side", 0.9e9, 720, (1024, 1024), 32),
        ("dns1-back", 0.9e9, 720, (1024, 1024), 32),
        ("dns2", 1.8e9, 1427, (1024, 1024), 32),
        ("wavelets", None, 64, (512, 512), 1),
    ],
)
def test_cards_state_the_published_size(name, triangles, domains, resolution, samples):
    for variant in (name, *(f"{name}:{v}" for v in cards("workload")[name].document().variants)):
        published = load_workload(variant).card.published
        assert (published.triangles, published.domains) == (triangles, domains)
        assert (published.resolution, published.samples) == (resolution, samples)


def test_cards_ask_for_the_rays_of_their_papers():
    for name in ("rm", "enzo", "dns1-side", "dns1-back", "dns2"):
        path, ambient = (load_workload(variant).card.integrator for variant in (name, f"{name}:ao"))
        assert (path.name, path.bounces, path.shadow_samples) == ("spray_path_tracing", 3, 16)
        assert (ambient.name, ambient.samples) == ("ambient_occlusion", 16)
    assert load_workload("rm-isosurface").card.integrator.name == "ray_casting"
    assert load_workload("rm-isosurface:ao").card.integrator.samples == 36
    assert len(load_workload("rm-isosurface").card.camera.path) >= 4
