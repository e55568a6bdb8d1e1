"""How light is followed through a scene: what `Trace` is asked to compute.

An integrator's fields decide which rays there are, so they are part of a trace's key. The words are pbrt's; what each
one does is written where its kernel is.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from simrender.rays.scene import Scene


@dataclass(frozen=True)
class RayCasting:
    """Camera rays alone, lit from the viewer: what is seen, and nothing spawned."""


@dataclass(frozen=True)
class PathTracing:
    """Path tracing of surfaces as ray queue cycling does it; see `shading`.

    Attributes
    ----------
    diffuse, mirror : int
        The most diffuse and mirror-like bounces of a path.
    roulette : float
        A path whose throughput (its largest channel) falls below this survives with the quotient as probability.

    """

    diffuse: int = 3
    mirror: int = 4
    roulette: float = 0.3


@dataclass(frozen=True)
class AmbientOcclusion:
    """Shadow rays in cosine-distributed directions, to see how open each hit is; see `lighting`.

    Attributes
    ----------
    samples : int
        Shadow rays a hit.
    distance : float
        How far a shadow ray looks; infinite for the whole scene, as SpRay does.
    bounces : int
        Surface hits of a path, at most.
    program_image : (width, height, samples), optional
        Draw the random numbers that the authors' program draws for an image of that size.

    """

    samples: int = 16
    distance: float = math.inf
    bounces: int = 1
    program_image: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class SprayPathTracing:
    """Blinn-Phong direct light from every light at every hit, and a diffuse ray a hit; see `lighting`.

    Attributes
    ----------
    shadow_samples : int
        Shadow rays a hit to each area light and each diffuse light; a point light takes one.
    bounces : int
        Surface hits of a path, at most: one less than that are secondary.
    specular, shininess : float
        Of the Blinn-Phong model; diffuse reflectance is the surface's own. The paper does not give them; the example of
        the authors' program uses 0.4 and 10.
    program_image : (width, height, samples), optional
        Draw the random numbers that the authors' program draws for an image of that size.

    """

    shadow_samples: int = 16
    bounces: int = 3
    specular: float = 0.4
    shininess: float = 10.0
    program_image: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class VolumeMarching:
    """Absorption and emission in equal steps along camera rays; see `marching`.

    Attributes
    ----------
    step : float
        Distance between samples, in voxels (their shortest edge).
    shading : bool
        Shade each sample by the field's gradient.
    opacity_limit : float
        A ray ends where it is that opaque.

    """

    step: float = 1.0
    shading: bool = True
    opacity_limit: float = 0.99


@dataclass(frozen=True)
class VolumePathTracing:
    """Woodcock tracking with isotropic scattering, isosurfaces and meshes in the same paths; see `volume_paths`.

    Attributes
    ----------
    bounces : int
        Collisions of a path, at most.
    shadow_probability : float
        With which a collision becomes a shadow ray to a light, where there is one, and not a scattered ray.
    roulette : float
        A path whose throughput (its largest channel) falls below this survives with the quotient as probability.

    """

    bounces: int = 8
    shadow_probability: float = 0.5
    roulette: float = 0.1


@dataclass(frozen=True)
class ElementMarching:
    """Absorption and emission through an unstructured mesh, element by element; see `element_marching`.

    Attributes
    ----------
    step : float
        Longest distance between samples in world units; every element takes at least one.

    """

    step: float = math.inf


Integrator = (
    RayCasting
    | PathTracing
    | AmbientOcclusion
    | SprayPathTracing
    | VolumeMarching
    | VolumePathTracing
    | ElementMarching
)


def in_units(integrator: Integrator, factor: float) -> Integrator:
    """Return an integrator for a scene in other units of length: every length times a factor."""
    if isinstance(integrator, AmbientOcclusion):
        return replace(integrator, distance=integrator.distance * factor)
    if isinstance(integrator, ElementMarching):
        return replace(integrator, step=integrator.step * factor)
    return integrator


def most_children(integrator: Integrator, scene: Scene) -> int:
    """Return how many rays a ray may spawn in a scene, at most."""
    if isinstance(integrator, AmbientOcclusion):
        return integrator.samples + (integrator.bounces > 1)
    if isinstance(integrator, SprayPathTracing):
        emitters = sum(any(scene.materials[mesh.material].emission) for mesh in scene.meshes)
        wide = emitters + len(scene.hemispheres)
        return integrator.shadow_samples * wide + len(scene.points) + (integrator.bounces > 1)
    return {PathTracing: 2, VolumePathTracing: 1}.get(type(integrator), 0)


INTEGRATORS: dict[str, type[Integrator]] = {
    "ray_casting": RayCasting,
    "path_tracing": PathTracing,
    "ambient_occlusion": AmbientOcclusion,
    "spray_path_tracing": SprayPathTracing,
    "volume_marching": VolumeMarching,
    "volume_path_tracing": VolumePathTracing,
    "element_marching": ElementMarching,
}
