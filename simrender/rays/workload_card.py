"""The cards of workloads: what was published, what is traced, and how.

A workload card states both sizes. Each traced ray stands for ``weight`` published ones: bytes and compute scale with
it, batches and latencies do not.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from simrender.cards import Card, Count, Quantity, Size
from simrender.errors import did_you_mean
from simrender.rays.integrators import INTEGRATORS, Integrator

Vector = Annotated[tuple[float, float, float], Field(description="x, y, z")]


def _size(text: Any) -> Any:
    if isinstance(text, (list, tuple)):
        return text
    width, cross, height = str(text).partition("x")
    if not (cross and width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        message = {"message": f"expected WIDTHxHEIGHT in pixels such as '2560x1080', got {text!r}"}
        raise PydanticCustomError("quantity", "{message}", message)
    return int(width), int(height)


Whole = Annotated[int, Field(ge=1)]
Resolution = Annotated[tuple[Whole, Whole], BeforeValidator(_size)]


class PublishedCard(Card):
    """The size of the real thing; the scene's own size where a field is left out.

    ``voxels`` are a volume's along x, y and z, ``elements`` and ``vertices`` those of an unstructured mesh, ``domains``
    the pieces in which the data comes.

    ``growth`` makes the scene larger by any factor, as section 5.2 of the ray queue cycling paper does: so many times
    the triangles in each mesh, so many times the instances, and so the square of it in instanced triangles.
    """

    resolution: Resolution
    samples: Annotated[int, Field(ge=1, le=65535)]
    triangles: Count | None = None
    instances: Count | None = None
    instanced_triangles: Count | None = None
    geometry_bytes: Size | None = None
    texture_bytes: Size | None = None
    growth: Count = Quantity(1.0)
    voxels: tuple[Whole, Whole, Whole] | None = None
    elements: Count | None = None
    vertices: Count | None = None
    domains: Count | None = None


class TracedCard(Card):
    """The size that is really traced: a smaller image of the same camera, and as many or fewer samples a pixel."""

    resolution: Resolution
    samples: Annotated[int, Field(ge=1, le=65535)] | None = None


class SceneCard(Card):
    """Where the scene comes from: a file beside the card, or a generator and its arguments."""

    file: str | None = None
    generator: str | None = None
    arguments: dict[str, float | int | str] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _one_source(self) -> SceneCard:
        if (self.file is None) == (self.generator is None):
            raise ValueError("a scene has exactly one of the fields file and generator")
        if self.file is not None and self.arguments:
            raise ValueError("arguments are for a generator, and this scene comes from a file")
        return self


class KeyCard(Card):
    """A point on the way of a camera."""

    position: Vector
    look_at: Vector


class CameraCard(Card):
    """A pinhole camera, and its way through the frames of an animation.

    ``sampling`` says where rays go through their pixels: ``jittered``, through random points, or ``corner``, all
    through the lower left corner, as SpRay does with one sample a pixel. ``path_frames`` says how many frames there are
    from the beginning of ``path`` to its end where a viewer shows one after the other.
    """

    position: Vector
    look_at: Vector
    up: Vector = (0.0, 0.0, 1.0)
    vertical_fov_degrees: Annotated[float, Field(gt=0, lt=180)] = 40.0
    sampling: Literal["jittered", "corner"] = "jittered"
    path: tuple[KeyCard, ...] = ()
    path_frames: Annotated[int, Field(ge=2)] | None = None

    @model_validator(mode="after")
    def _has_a_direction(self) -> CameraCard:
        for eye, target in ((self.position, self.look_at), *((key.position, key.look_at) for key in self.path)):
            forward = np.subtract(target, eye)
            if not np.linalg.norm(np.cross(forward, self.up)) > 0.0:
                raise ValueError("the camera looks nowhere: look_at equals position, or lies straight along up")
        return self

    def at(self, when: float) -> CameraCard:
        """Return the camera at a point of its way, 0 its beginning and 1 its end.

        Position and look_at run through the points of ``path`` on a centripetal Catmull-Rom spline, in equal times
        from each to the next; without a path the camera stands still.
        """
        if len(self.path) < 2:
            return self.model_copy(update=dict(self.path[0]) if self.path else {})
        last = len(self.path) - 1
        place = min(max(when, 0.0), 1.0) * last
        k = min(int(place), last - 1)
        moved = {}
        for name in ("position", "look_at"):
            keys = np.array([getattr(key, name) for key in self.path])
            # Beyond the ends the way goes on straight.
            points = np.stack([
                keys[k - 1] if k > 0 else 2.0 * keys[0] - keys[1], keys[k], keys[k + 1],
                keys[k + 2] if k + 2 <= last else 2.0 * keys[last] - keys[last - 1],
            ])  # fmt: skip
            moved[name] = tuple(float(x) for x in _catmull_rom(points, place - k))
        return self.model_copy(update=moved)

    def frame(self, aspect: float) -> NDArray[np.float64]:
        """Return position, forward, right and up as `shading.camera_rays` takes them, for width / height."""
        position, up = np.array(self.position), np.array(self.up)
        forward = np.array(self.look_at) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        half = math.tan(math.radians(self.vertical_fov_degrees) / 2.0)
        return np.stack([position, forward, right * half * aspect, np.cross(right, forward) * half])


def _catmull_rom(points: NDArray[np.float64], u: float) -> NDArray[np.float64]:
    """Return the point at u in 0..1 between the middle two of four points (4, 3), on a centripetal spline."""
    t0, t1, t2, t3 = np.concatenate([[0.0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1)))])
    t = t1 + u * (t2 - t1)

    def between(p: NDArray[np.float64], q: NDArray[np.float64], s: float, e: float) -> NDArray[np.float64]:
        return p if e == s else ((e - t) * p + (t - s) * q) / (e - s)

    # Barry and Goldman's pyramid of linear interpolations.
    p0, p1, p2, p3 = points
    a1, a2, a3 = between(p0, p1, t0, t1), between(p1, p2, t1, t2), between(p2, p3, t2, t3)
    return between(between(a1, a2, t0, t2), between(a2, a3, t1, t3), t1, t2)


class BouncesCard(Card):
    """When a path ends; see `integrators.PathTracing`."""

    diffuse: Annotated[int, Field(ge=0, le=200)] = 3
    mirror: Annotated[int, Field(ge=0, le=200)] = 4
    roulette: Annotated[float, Field(ge=0, le=1)] = 0.3


class IntegratorCard(Card):
    """How light is followed; each integrator takes its own parameters, see `integrators`.

    ``path_tracing`` is ray queue cycling's and takes its parameters from the section ``bounces``.
    """

    name: Literal[
        "ray_casting",
        "path_tracing",
        "ambient_occlusion",
        "spray_path_tracing",
        "volume_marching",
        "volume_path_tracing",
        "element_marching",
    ] = "path_tracing"
    samples: Annotated[int, Field(ge=1, le=1024)] | None = None
    distance: Annotated[float, Field(gt=0)] | None = None
    bounces: Annotated[int, Field(ge=1, le=200)] | None = None
    shadow_samples: Annotated[int, Field(ge=1, le=1024)] | None = None
    specular: Annotated[float, Field(ge=0)] | None = None
    shininess: Annotated[float, Field(ge=0)] | None = None
    step: Annotated[float, Field(gt=0)] | None = None
    shading: bool | None = None
    opacity_limit: Annotated[float, Field(gt=0, le=1)] | None = None
    shadow_probability: Annotated[float, Field(ge=0, lt=1)] | None = None
    roulette: Annotated[float, Field(ge=0, le=1)] | None = None
    random_numbers: Literal["own", "spray_program"] = "own"

    @model_validator(mode="before")
    @classmethod
    def _by_name_alone(cls, value: Any) -> Any:
        return {"name": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _takes_its_parameters(self) -> IntegratorCard:
        known = [f.name for f in dataclasses.fields(INTEGRATORS[self.name])] if self.name != "path_tracing" else []
        if "program_image" in known:
            known[-1] = "random_numbers"
        for name in sorted(self.model_fields_set - {"name", *known}):
            if self.name == "path_tracing":
                raise ValueError(f"path_tracing takes no {name} here; its parameters are in the section bounces")
            raise ValueError(
                f"{self.name} takes {', '.join(known) or 'no parameters'}, not {name}{did_you_mean(name, known)}"
            )
        return self

    def value(self) -> Integrator:
        """Return the integrator."""
        own = {"name", "random_numbers"}
        return INTEGRATORS[self.name](**{k: v for k, v in self.model_dump(exclude_unset=True).items() if k not in own})


class DomainsCard(Card):
    """The pieces in which the data comes, or is cut: what schedulers that move rays or data send them to.

    ========== =====================================================================================================
    method     domains
    ========== =====================================================================================================
    auto       bricks of a volume, else whole objects
    given      one for each object of the scene, or part of an unstructured mesh
    kd_bricks  bricks of a volume, by splitting its longest side in the middle (islands paper, section 4.1)
    sah        parts of the instances by the surface area heuristic (islands paper, section 5.3)
    grid       cells of a uniform rectilinear grid of ``shape``
    balanced   cells of a rectilinear grid of ``shape`` with about equally much between the planes of each axis
    objects    whole objects, heaviest first (ray queue cycling paper, section 4.1)
    ========== =====================================================================================================
    """

    method: Literal["auto", "given", "kd_bricks", "sah", "grid", "balanced", "objects"] = "given"
    count: Annotated[int, Field(ge=1, le=32767)] | None = None
    shape: tuple[Whole, Whole, Whole] | None = None

    @model_validator(mode="after")
    def _says_how_many(self) -> DomainsCard:
        wanted = {"given": None, "grid": "shape", "balanced": "shape"}.get(self.method, "count")
        for name in ("count", "shape"):
            if (getattr(self, name) is not None) != (name == wanted):
                raise ValueError(f"{self.method} {'needs' if name == wanted else 'takes no'} {name}")
        return self


class WorkloadCard(Card):
    """A workload. ``policy`` holds the name and the parameters of the scheduler that renders it by default."""

    title: str
    published: PublishedCard
    traced: TracedCard
    scene: SceneCard
    camera: CameraCard
    bounces: BouncesCard = BouncesCard()
    integrator: IntegratorCard = IntegratorCard()
    domains: DomainsCard | None = None
    policy: dict[str, Any] = Field(default_factory=lambda: {"name": "ray_queue_cycling"})

    @field_validator("policy")
    @classmethod
    def _has_a_name(cls, policy: dict[str, Any]) -> dict[str, Any]:
        if not isinstance(policy.get("name"), str):
            raise ValueError("a policy has a name, for instance {name: ray_queue_cycling}")
        return policy

    @model_validator(mode="after")
    def _traced_stands_for_published(self) -> WorkloadCard:
        (width, height), (w, h) = self.published.resolution, self.traced.resolution
        if w * h > width * height:
            raise ValueError(f"traced.resolution {w}x{h} is larger than published.resolution {width}x{height}")
        traced, published = self.traced.samples, self.published.samples
        if traced is not None and published % traced:
            raise ValueError(f"traced.samples {traced} does not divide published.samples {published}")
        return self

    @model_validator(mode="after")
    def _bounces_of_path_tracing(self) -> WorkloadCard:
        if "bounces" in self.model_fields_set and self.integrator.name != "path_tracing":
            raise ValueError(f"the section bounces is for path_tracing, and the integrator is {self.integrator.name}")
        return self
