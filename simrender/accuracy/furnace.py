"""Energy: scenes whose image is known, because light is neither made nor lost in them.

In a *white furnace* everything reflects all light and all light is alike: nothing can be told from its background, and
every pixel is 1. In a grey one, a closed enclosure that emits E and reflects a share rho, radiance is E / (1 - rho)
everywhere. Beside these stand direct light with a closed form, and the conventions of SpRay.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simrender.accuracy.partitions import generator
from simrender.rays.integrators import (
    AmbientOcclusion,
    Integrator,
    PathTracing,
    SprayPathTracing,
    VolumeMarching,
    VolumePathTracing,
)
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.store import NoStore
from simrender.rays.trace import Trace
from simrender.rays.volume import TransferFunction, Volume

F64 = NDArray[np.float64]

WHITE = Environment((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))
DARK = Environment((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))

FOREVER = 250
"""Bounces after which a path ends that should have left long ago: as many as the ray table can count."""


@dataclass(frozen=True)
class Furnace:
    """An image beside what it must be.

    Attributes
    ----------
    what : str
    expected, mean : float
        Mean of the image.
    standard_error : float
        Of the mean, from the spread of the pixels' errors; 0 where each of them is exact.
    largest : float
        Largest error of a pixel.

    """

    what: str
    expected: float
    mean: float
    standard_error: float
    largest: float


def image(
    scene: Scene, camera: F64, integrator: Integrator, size: int = 32, samples: int = 4, *, jitter: bool = True
) -> NDArray[np.float32]:
    """Return a square image of a scene, float32 (size, size, 3); nothing is kept on disk."""
    trace = Trace(scene, camera, (size, size), samples, integrator, jitter=jitter)
    trace.store = NoStore()
    trace.complete()
    return trace.image()


def furnaces(size: int = 32, samples: int = 4) -> list[Furnace]:
    """Render every furnace and every closed form in a small image."""
    rows = []
    for what, render in FURNACES.items():
        seen, expected = render(size, samples)
        error = seen.astype(np.float64) - expected
        # Channels are alike, so a pixel counts once.
        spread = float(error.mean(axis=2).std() / size)
        rows.append(
            Furnace(what, float(np.mean(expected)), float(seen.mean()), spread, float(np.abs(error).max(initial=0.0)))
        )
    return rows


# -- scenes -----------------------------------------------------------------------------------------------------------


def camera(position: tuple[float, float, float], forward: tuple[float, float, float], half: float) -> F64:
    """Return a square camera whose image plane, at distance 1, is ``half`` wide to each side."""
    ahead = np.array(forward) / np.linalg.norm(forward)
    right = np.cross(ahead, (0.0, 0.0, 1.0) if abs(ahead[2]) < 0.9 else (0.0, 1.0, 0.0))
    right /= np.linalg.norm(right)
    return np.stack([np.array(position), ahead, half * right, half * np.cross(right, ahead)])


def ball(rings: int = 12, *, smooth: bool = False) -> Mesh:
    """Return a closed unit sphere about the origin."""
    turns = 2 * rings
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2.0 * np.pi * np.arange(turns) / turns
    t, p = (axis.ravel() for axis in np.meshgrid(theta, phi, indexing="ij"))
    vertices = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=1)
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(rings - 2), np.arange(turns), indexing="ij"))
    a, b, c, d = (turns * (i + di) + (j + dj) % turns for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)))
    north, south, last = len(vertices), len(vertices) + 1, turns * (rings - 2)
    k = np.arange(turns)
    caps = [
        np.stack([np.full(turns, north), k, (k + 1) % turns], 1),
        np.stack([np.full(turns, south), last + (k + 1) % turns, last + k], 1),
    ]
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1), *caps])
    points = np.concatenate([vertices, [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    return Mesh(points.astype(np.float32), faces.astype(np.int32), smooth=smooth)


def plane(half: float = 100.0, height: float = 0.0, material: int = 0) -> Mesh:
    """Return a square facing up."""
    corners = np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]]) * half
    vertices = np.column_stack([corners, np.full(4, height)]).astype(np.float32)
    return Mesh(vertices, np.array([[0, 1, 2], [1, 3, 2]], np.int32), material)


def of(*meshes: Mesh, materials: tuple[Material, ...] = (Material((1.0, 1.0, 1.0)),), **lights: object) -> Scene:
    """Return a scene of one object; white under a white sky, if nothing else is said."""
    thing = SceneObject("thing", meshes)
    given = {"environment": WHITE} | lights
    return Scene((thing,), np.zeros(1, np.int32), IDENTITY[None], materials, **given)  # type: ignore[arg-type]


def spheres(material: Material, *, smooth: bool = False) -> Scene:
    """Return nine spheres that light bounces to and fro between, under a white sky."""
    at = np.stack(np.meshgrid([-1.1, 0.0, 1.1], [-1.1, 0.0, 1.1], [0.0]), axis=-1).reshape(-1, 3)
    transform = np.tile(IDENTITY, (9, 1, 1))
    transform[:, :, :3] *= 0.54
    transform[:, :, 3] = at
    thing = SceneObject("ball", (ball(smooth=smooth),))
    return Scene((thing,), np.zeros(9, np.int32), transform, (material,), environment=WHITE)


def cloud(albedo: float, opacity: float = 0.6, isovalues: tuple[float, ...] = ()) -> Volume:
    """Return a cube of noise, two units a side, a few mean free paths across."""
    voxels = generator(4).random((20, 20, 20), dtype=np.float32)
    transfer = TransferFunction(np.array([0.0, 1.0]), np.full((2, 3), albedo), np.array([0.0, opacity]), 0.25)
    return Volume(voxels, (2.0 / 19.0,) * 3, (-1.0,) * 3, transfer, isovalues, ((albedo,) * 3,) * len(isovalues))


# -- furnaces ---------------------------------------------------------------------------------------------------------

Rendered = tuple[NDArray[np.float32], float | F64]
ASIDE = camera((0.0, -5.0, 2.0), (0.0, 5.0, -2.0), 0.4)
INSIDE = camera((0.1, -0.2, 0.05), (0.3, 1.0, 0.2), 1.0)


def _white(size: int, samples: int, material: Material, *, smooth: bool = False) -> Rendered:
    return image(spheres(material, smooth=smooth), ASIDE, PathTracing(FOREVER, FOREVER, 0.0), size, samples), 1.0


def _grey(size: int, samples: int) -> Rendered:
    rho, emitted = 0.5, 1.0
    enclosure = of(ball(8), materials=(Material((rho,) * 3, 0.3, (emitted,) * 3),), environment=DARK)
    return image(enclosure, INSIDE, PathTracing(60, 60, 0.5), size, 8 * samples), emitted / (1.0 - rho)


def _point_light(size: int, samples: int) -> Rendered:
    albedo, intensity, height = 0.6, 30.0, 2.0
    light = PointLight((0.0, 0.0, height), (intensity,) * 3)
    scene = of(plane(), materials=(Material((albedo,) * 3),), points=(light,), environment=DARK)
    seen = image(scene, camera((0, 0, 3.0), (0, 0, -1), 0.7), PathTracing(1, 0, 0.0), size, samples, jitter=False)
    x, y = _grid(size, 3.0 * 0.7)
    squared = x * x + y * y + height**2
    return seen, (albedo / math.pi * intensity * height / squared**1.5)[..., None]


def _area_light(size: int, samples: int) -> Rendered:
    albedo, radiance, half, height = 0.5, 4.0, 1.5, 2.0
    lamp = plane(half, height, 1)
    materials = Material((albedo,) * 3), Material((0.0,) * 3, emission=(radiance,) * 3)
    scene = of(plane(), lamp, materials=materials, environment=DARK)
    seen = image(scene, camera((0, 0, 1.0), (0, 0, -1), 0.01), PathTracing(1, 0, 0.0), size, 8 * samples)
    # Form factor of a point straight below the middle: four times that of a corner (Howell's catalogue, B-3).
    a = half / height
    form = 4.0 / (2.0 * math.pi) * 2.0 * a / math.sqrt(1.0 + a * a) * math.atan(a / math.sqrt(1.0 + a * a))
    return seen, albedo * radiance * form


def _occlusion(size: int, samples: int) -> Rendered:
    seen = image(of(plane()), camera((0, 0, 1.0), (0, 0, -1), 1.0), AmbientOcclusion(16), size, samples)
    return seen, 1.0


def _spray(size: int, samples: int) -> Rendered:
    albedo, light, eye = 0.5, np.array([3.0, 1.0, 4.0]), np.array([0.0, 0.0, 3.0])
    model = SprayPathTracing(bounces=1)
    lamp = PointLight((3.0, 1.0, 4.0), (0.8,) * 3, falloff=False)
    scene = of(plane(), materials=(Material((albedo,) * 3),), points=(lamp,))
    seen = image(scene, camera((0, 0, 3.0), (0, 0, -1), 0.7), model, size, samples, jitter=False)
    x, y = _grid(size, 3.0 * 0.7)
    point = np.stack([x, y, np.zeros_like(x)], axis=-1)
    to_light, to_eye = light - point, eye - point
    to_light /= np.linalg.norm(to_light, axis=-1, keepdims=True)
    to_eye /= np.linalg.norm(to_eye, axis=-1, keepdims=True)
    half = to_light + to_eye
    gloss = (half[..., 2] / np.linalg.norm(half, axis=-1)) ** model.shininess
    return seen, (0.8 * (albedo * to_light[..., 2] + model.specular * gloss))[..., None]


def _spray_sky(size: int, samples: int) -> Rendered:
    # Light from everywhere above of radiance 1, without gloss: pi times the albedo, for the model has no 1 / pi.
    scene = of(plane(), materials=(Material((0.25,) * 3),), hemispheres=((1.0, 1.0, 1.0),))
    model = SprayPathTracing(bounces=1, specular=0.0)
    return image(scene, camera((0, 0, 1.0), (0, 0, -1), 1.0), model, size, samples), 0.25 * math.pi


def _medium(size: int, samples: int, isovalues: tuple[float, ...] = (), *meshes: Mesh) -> Rendered:
    thing = (SceneObject("thing", meshes),) if meshes else ()
    where = np.zeros(len(thing), np.int32), np.tile(0.6 * IDENTITY, (len(thing), 1, 1))
    scene = Scene(
        thing, *where, (Material((1.0, 1.0, 1.0)),), environment=WHITE, volume=cloud(1.0, isovalues=isovalues)
    )
    return image(scene, ASIDE, VolumePathTracing(FOREVER, roulette=0.0), size, samples), 1.0


def _single_scattering(size: int, samples: int) -> Rendered:
    # A cube seen along the way its light comes: the light is dimmed on the way in as on the way out.
    albedo, intensity, opacity, side = 0.8, 40.0, 0.5, 2.0
    transfer = TransferFunction(np.zeros(1), np.full((1, 3), albedo), np.array([opacity]))
    fog = Volume(np.zeros((9, 9, 9), np.float32), (side / 8.0,) * 3, (-1.0,) * 3, transfer)
    sun = PointLight((-1e5, 0.0, 0.0), (intensity,) * 3, falloff=False)
    scene = Scene(
        (), np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32), points=(sun,), environment=DARK, volume=fog
    )
    model = VolumePathTracing(bounces=1, shadow_probability=0.7, roulette=0.0)
    seen = image(scene, camera((-5.0, 0.1, 0.2), (1.0, 0.0, 0.0), 1e-3), model, size, 4 * samples)
    sigma = float(transfer.extinction[0])
    return seen, albedo * intensity / (4.0 * math.pi) * -math.expm1(-2.0 * sigma * side) / 2.0


def _marched(size: int, samples: int) -> Rendered:
    scene = Scene((), np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32), environment=WHITE, volume=cloud(1.0))
    return image(scene, ASIDE, VolumeMarching(shading=False), size, samples), 1.0


def _grid(size: int, half: float) -> tuple[F64, F64]:
    """Return where the lower left corners of the pixels lie on the floor below a camera that looks down, y up."""
    right = half * (2.0 * np.arange(size) / size - 1.0)
    up = half * (1.0 - 2.0 * (np.arange(size) + 1.0) / size)
    frame = camera((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), 1.0)
    x, y = np.meshgrid(right, up)
    return x * frame[2, 0] + y * frame[3, 0], x * frame[2, 1] + y * frame[3, 1]


FURNACES: dict[str, Callable[[int, int], Rendered]] = {
    "white spheres under a white sky": lambda n, s: _white(n, s, Material((1.0, 1.0, 1.0))),
    "the same, half of them mirrors": lambda n, s: _white(n, s, Material((1.0, 1.0, 1.0), mirror=0.5)),
    "the same, smooth": lambda n, s: _white(n, s, Material((1.0, 1.0, 1.0)), smooth=True),
    "grey enclosure, E / (1 - rho)": _grey,
    "floor under a point light": _point_light,
    "floor under a square lamp": _area_light,
    "ambient occlusion of a floor": _occlusion,
    "SpRay: floor under a point light": _spray,
    "SpRay: floor under a diffuse light": _spray_sky,
    "white cloud under a white sky": _medium,
    "the same with an isosurface": lambda n, s: _medium(n, s, (0.7,)),
    "the same with a sphere in it": lambda n, s: _medium(n, s, (), ball()),
    "fog in the sun, scattered once": _single_scattering,
    "white cloud, marched": _marched,
}
"""What is rendered: functions of image size and samples that return an image and what it must be."""
