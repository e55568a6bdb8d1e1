"""Triangles and a volume in one scene: each hides the other where it is nearer, and light is lost on the way."""

from __future__ import annotations

import numpy as np
import pytest

from simrender.rays.crossings import Crossings
from simrender.rays.data import cut
from simrender.rays.files import SceneFile
from simrender.rays.integrators import PathTracing, VolumeMarching, VolumePathTracing
from simrender.rays.partition import Published
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, Scene, SceneObject
from simrender.rays.trace import Trace
from simrender.rays.volume import TransferFunction, Volume
from simrender.rays.workload_card import DomainsCard, PublishedCard

BLACK = Environment((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
DOWN = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, -1.0], [0.4, 0.0, 0.0], [0.0, 0.4, 0.0]])
DEPTH = 2.0


def slab(opacity: float, color: float = 0.0) -> Volume:
    """A homogeneous medium between z = 0 and z = 2."""
    transfer = TransferFunction(np.array([0.0]), np.full((1, 3), color), np.array([opacity]))
    return Volume(np.zeros((17, 9, 9), np.float32), (1.0, 1.0, DEPTH / 16), (-4.0, -4.0, 0.0), transfer)


def plate(z: float, emission: float) -> Scene:
    """A large square that shines."""
    corners = np.array([[-9, -9, z], [9, -9, z], [9, 9, z], [-9, 9, z]], np.float32)
    mesh = Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    material = Material((0.0, 0.0, 0.0), emission=(emission, emission, emission))
    return Scene((SceneObject("plate", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None], (material,), (), BLACK)


def with_volume(scene: Scene, volume: Volume) -> Scene:
    return Scene(scene.objects, scene.instance_object, scene.instance_transform, scene.materials, (), BLACK, (), volume)


def traced(scene: Scene, integrator, tmp_path, size=(16, 16), samples=64) -> Trace:
    trace = Trace(scene, DOWN, size, samples, integrator, 1, tmp_path)
    trace.complete()
    return trace


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9])
def test_a_plate_behind_a_slab_shines_through_by_its_transmittance(opacity, tmp_path):
    scene = with_volume(plate(-1.0, 3.0), slab(opacity))
    image = traced(scene, VolumePathTracing(), tmp_path).image()
    # The ray's way through the slab is a little longer off the axis.
    x = np.linspace(-0.4, 0.4, 33)
    secant = np.sqrt(1.0 + x[:, None] ** 2 + x[None, :] ** 2).mean()
    expected = (1.0 - opacity) ** (DEPTH * secant)
    error = np.sqrt(expected * (1.0 - expected) / (16 * 16 * 64))
    assert abs(image.mean() / 3.0 - expected) < 4.0 * error + 1e-4


def test_a_plate_in_front_hides_the_slab(tmp_path):
    scene = with_volume(plate(3.0, 2.0), slab(0.9))
    trace = traced(scene, VolumePathTracing(), tmp_path, samples=4)
    assert (trace.image() == 2.0).all()
    assert (trace.column("work") == 0).all()
    assert (trace.column("primitive") >= 0).all()


def test_half_the_slab_in_front_of_a_plate_takes_half_the_samples(tmp_path):
    samples = {}
    for z in (-1.0, 1.0):
        trace = traced(
            with_volume(plate(z, 1.0), slab(0.2, 0.5)), VolumeMarching(opacity_limit=1.0), tmp_path, samples=1
        )
        samples[z] = int(trace.column("work").sum())
    assert samples[1.0] == pytest.approx(samples[-1.0] / 2, rel=0.08)


def test_marching_blends_the_medium_over_what_is_behind(tmp_path):
    opacity, color = 0.5, 0.8
    trace = traced(
        with_volume(plate(-1.0, 0.0), slab(opacity, color)), VolumeMarching(shading=False), tmp_path, (2, 2), 1
    )
    seen = trace.image()
    through = 1.0 - seen / color  # the plate is black
    assert (through > (1.0 - opacity) ** (DEPTH * 1.15)).all()
    assert (through < (1.0 - opacity) ** (DEPTH * 0.98)).all()


def test_a_medium_that_scatters_all_light_and_a_white_plate_make_a_white_furnace(tmp_path):
    white = Environment((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
    base = plate(0.7, 0.0)
    scene = Scene(
        base.objects, base.instance_object, base.instance_transform, (Material((1.0, 1.0, 1.0)),), (), white, (),
        slab(0.6, 1.0),
    )  # fmt: skip
    image = traced(scene, VolumePathTracing(bounces=200, roulette=0.0), tmp_path, (16, 16), 8).image()
    assert np.allclose(image, 1.0, atol=1e-5)


def test_surfaces_alone_are_followed_as_if_there_were_no_volume(tmp_path):
    both = with_volume(plate(-1.0, 3.0), slab(0.5))
    assert (traced(both, PathTracing(), tmp_path, samples=2).image() == 3.0).all()


@pytest.mark.parametrize("integrator", [VolumeMarching(opacity_limit=1.0), VolumePathTracing()])
def test_domains_make_of_a_mixed_scene_what_the_whole_makes(integrator, tmp_path):
    scene = with_volume(plate(1.0, 1.0), slab(0.2, 0.5))
    trace = traced(scene, integrator, tmp_path, samples=1)
    card, how = PublishedCard(resolution=(16, 16), samples=1), DomainsCard(method="kd_bricks", count=2)
    published = Published(2.0, 1.0, 2.0, 100.0, 0.0)
    crossings = Crossings(trace, cut(scene, how, card, published, SceneFile(scene), 1.0))
    table = crossings.table(0)
    hits = crossings.hits(0, np.arange(len(table["domain"])))
    ray = np.repeat(np.arange(256), np.diff(table["first"]))
    if isinstance(integrator, VolumeMarching):
        assert np.bincount(ray, table["work"], minlength=256).tolist() == trace.column("work")[:256].tolist()
        assert (trace.column("primitive")[:256] == -1).all()  # the medium is in front
    else:
        nearest = np.full(256, np.inf, np.float32)
        np.minimum.at(nearest, ray, hits)
        assert (nearest == trace.column("t")[:256]).all()
