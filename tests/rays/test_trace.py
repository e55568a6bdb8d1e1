"""The ray table: light transport that conserves energy, laziness, and the cache."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.rays.integrators import PathTracing
from simrender.rays.kinds import CAMERA, DIFFUSE, MIRROR, SHADOW
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.store import CacheWarning
from simrender.rays.trace import Trace
from tests.scenes import garden, garden_workload, grid, placed, sphere

WHITE_SKY = Environment((1, 1, 1), (1, 1, 1), (1, 1, 1))
TOWARDS_Y = np.array([[0, -4, 0], [0, 1, 0], [0.35, 0, 0], [0, 0, 0.35]], float)


def one(mesh: Mesh, material: Material, **lights) -> Scene:
    return Scene((SceneObject("one", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None], (material,), **lights)


def plane(size: float = 50.0) -> Mesh:
    """A floor at z = 0, facing up."""
    vertices = np.array([[-size, -size, 0], [size, -size, 0], [-size, size, 0], [size, size, 0]], np.float32)
    return Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2]]))


def traced(scene: Scene, camera=TOWARDS_Y, size=(24, 24), samples=4, bounces=None, seed=1, cache=None) -> Trace:
    trace = Trace(scene, camera, size, samples, bounces or PathTracing(16, 16, 0.3), seed, cache)
    trace.complete()
    return trace


@pytest.mark.parametrize("mirror", [0.0, 0.5, 1.0])
def test_white_furnace_a_convex_white_body_vanishes_before_a_white_sky(mirror, tmp_path):
    image = traced(one(sphere(), Material((1, 1, 1), mirror), environment=WHITE_SKY), cache=tmp_path).image()
    assert np.abs(image - 1.0).max() < 1e-6  # one bounce, throughput 1: exact for every path


def test_furnace_with_absorption_and_roulette_keeps_the_mean(tmp_path):
    # Inside a closed sphere of albedo a that emits e, the radiance is e / (1 - a) everywhere.
    material = Material((0.5, 0.5, 0.5), 0.3, (1.0, 1.0, 1.0))
    inside = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 1]], float)
    trace = traced(one(sphere(rings=8), material), inside, (32, 32), 64, PathTracing(60, 60, 0.5), cache=tmp_path)
    image = trace.image().astype(float)
    error = image.std() / np.sqrt(image.size / 3)
    assert image.mean() == pytest.approx(2.0, abs=4 * error)
    assert error < 0.02


def test_a_point_light_over_a_floor_matches_the_closed_form(tmp_path):
    # Radiance of a Lambertian floor under a point light: albedo / pi * intensity * cos / d^2.
    height, albedo, intensity = 2.0, 0.6, 30.0
    light = PointLight((0.0, 0.0, height), (intensity,) * 3)
    scene = one(
        plane(), Material((albedo,) * 3), points=(light,), environment=Environment((0, 0, 0), (0, 0, 0), (0, 0, 0))
    )
    down = np.array([[0, 0, 3.0], [0, 0, -1], [0.01, 0, 0], [0, 0.01, 0]], float)
    # The lamp is nearer than the camera and has no body, so the camera sees the floor below it.
    image = traced(scene, down, (8, 8), 2, PathTracing(1, 0, 0.0), cache=tmp_path).image()
    assert image.mean() == pytest.approx(albedo / np.pi * intensity / height**2, rel=1e-3)


def test_an_area_light_lights_the_floor_like_its_form_factor(tmp_path):
    # A small square emitter of radiance L and area A straight above: irradiance is about L * A / h^2.
    side, height, radiance = 0.2, 3.0, 50.0
    lamp = Mesh(np.array([[-1, -1, 0], [1, -1, 0], [-1, 1, 0], [1, 1, 0]], np.float32) * side / 2, grid(2, 2), 1)
    objects = (SceneObject("floor", (plane(),)), SceneObject("lamp", (lamp,)))
    materials = (Material((0.5,) * 3), Material((0, 0, 0), emission=(radiance,) * 3))
    dark = Environment((0, 0, 0), (0, 0, 0), (0, 0, 0))
    transforms = placed(np.array([[0, 0, 0], [0, 0, height]]), np.ones(2))
    scene = Scene(objects, np.array([0, 1]), transforms, materials, (), dark)
    down = np.array([[0, 0, 2.0], [0, 0, -1], [0.01, 0, 0], [0, 0.01, 0]], float)
    image = traced(scene, down, (16, 16), 8, PathTracing(1, 0, 0.0), cache=tmp_path).image()
    assert image.mean() == pytest.approx(0.5 / np.pi * radiance * side**2 / height**2, rel=5e-3)


def test_a_lamp_seen_by_the_camera_is_counted_once(tmp_path):
    material = Material((0, 0, 0), emission=(3.0, 2.0, 1.0))
    image = traced(one(sphere(), material), cache=tmp_path).image()
    assert image[12, 12].tolist() == pytest.approx([3.0, 2.0, 1.0])


def test_bounce_limits_and_children(tmp_path):
    trace = traced(
        garden(),
        np.array([[5.5, -5, 3], [-0.7, 0.65, -0.3], [0.5, 0, 0], [0, 0.2, 0.4]]),
        bounces=PathTracing(2, 1, 0.4),
        cache=tmp_path,
    )
    kinds, children = trace.column("kind"), trace.column("children")
    assert children[kinds == SHADOW].max() == 0
    assert children.max() == 2
    deepest = {k: max(trace.geometry(g)[k].max() for g in range(trace.generations)) for k in ("diffuse", "mirror")}
    assert deepest == {"diffuse": 2, "mirror": 1}
    assert (np.bincount(kinds, minlength=4) > 0).all()
    assert {CAMERA, DIFFUSE, MIRROR, SHADOW} == set(np.unique(kinds).tolist())


def test_each_ray_but_the_cameras_is_the_child_of_one_parent(tmp_path):
    trace = traced(garden(), np.array([[5.5, -5, 3], [-0.7, 0.65, -0.3], [0.5, 0, 0], [0, 0.2, 0.4]]), cache=tmp_path)
    everyone = np.arange(trace.rays)
    children = np.sort(trace.children(everyone))
    assert children.tolist() == list(range(trace.first[1], trace.rays))
    for g in range(1, trace.generations):
        parent = trace.geometry(g)["parent"] + trace.first[g - 1]
        pixel = trace.column("pixel")
        assert (pixel[parent] == pixel[trace.first[g] : trace.first[g + 1]]).all()


def test_nothing_is_traced_before_it_is_asked_for(tmp_path):
    trace = garden_workload(cache=tmp_path).trace()
    assert trace.generations == 0
    trace.kinds(trace.camera_rays(0, np.arange(5)))
    assert trace.generations == 1
    assert trace.traced_rays == 96 * 64 * 2


def test_a_second_trace_comes_from_the_cache_and_is_the_same(tmp_path):
    first = garden_workload(cache=tmp_path).trace()
    first.complete()
    second = garden_workload(cache=tmp_path).trace()
    second.complete()
    assert second.traced_rays == 0
    assert (first.image() == second.image()).all()
    other = garden_workload(cache=tmp_path).trace(seed=2)
    other.complete()
    assert other.traced_rays > 0


@pytest.mark.parametrize("damage", ["truncate", "flip", "empty", "text"])
@pytest.mark.parametrize("name", ["000-hits", "001-hits", "001-rays"])
def test_damaged_cache_files_are_discarded_and_made_again(tmp_path, damage, name):
    first = garden_workload(cache=tmp_path).trace()
    first.complete()
    expected = first.geometry(1)["origin"].copy()
    path = first.store.folder / f"{name}.npz"
    content = bytearray(path.read_bytes())
    middle = len(content) // 2
    content = {
        "truncate": content[:middle],
        "flip": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "empty": bytearray(),
        "text": bytearray(b"not an archive"),
    }[damage]
    path.write_bytes(bytes(content))
    second = garden_workload(cache=tmp_path).trace()

    def use_everything():
        second.complete()
        return [second.geometry(generation) for generation in range(second.generations)]

    with pytest.warns(CacheWarning, match=f"{name}.npz is damaged") as caught:
        geometry = use_everything()
    assert len(caught) == 1
    assert (geometry[1]["origin"] == expected).all()
    assert (geometry[0]["pixel"] == first.geometry(0)["pixel"]).all()
    assert (first.image() == second.image()).all()


def test_a_cut_off_run_goes_on_where_it_stopped(tmp_path):
    first = garden_workload(cache=tmp_path).trace()
    first.complete()
    for path in first.store.folder.glob("00[2-9]-*.npz"):
        if path.name != "002-rays.npz":
            path.unlink()
    second = garden_workload(cache=tmp_path).trace()
    second.complete()
    assert second.traced_rays == first.rays - first.first[2]
    assert (first.image() == second.image()).all()


def test_a_cache_that_cannot_be_written_costs_a_warning_only(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    trace = garden_workload(cache=blocked / "cache").trace()
    with pytest.warns(CacheWarning, match="cannot write the trace cache") as caught:
        trace.complete()
    assert len(caught) == 1
    assert trace.rays > 0


@pytest.mark.parametrize("power", [-30, -20, 20, 30])
def test_a_scene_a_million_times_smaller_or_larger_gives_the_same_image(power, tmp_path):
    # Traced in handy units: what comes out is what a scene of ordinary size gives, but for roundings of its own.
    plain, other = garden_workload(cache=tmp_path), garden_workload(cache=tmp_path, scene=garden().scaled(2.0**power))
    camera = plain.card.camera.frame(1.5)
    images = []
    for workload, factor in ((plain, 1.0), (other, 2.0**power)):
        placed_camera = camera * np.array([[factor], [1], [1], [1]])
        trace = Trace(workload.scene, placed_camera, (48, 32), 1, workload.integrator, 1, tmp_path)
        trace.complete()
        images.append(trace.image())
    # The plain garden is traced at its own size, the others at a power of two of it, where only the fixed step of
    # secondary origins near a coordinate plane differs: a few paths in a thousand take another turn.
    assert np.median(np.abs(images[0] - images[1])) == 0.0
    assert images[0].mean() == pytest.approx(images[1].mean(), rel=0.02)
