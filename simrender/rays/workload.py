"""Workloads: a scene, a camera and an image; at the size that was published and at the size that is traced.

A workload card states both sizes. Each traced ray stands for ``weight`` published ones: bytes and compute scale with
it, batches and latencies do not.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, field_validator, model_validator
from pydantic_core import PydanticCustomError

from simrender.cards import Card, Count, Document, Quantity, Size
from simrender.catalog import find_card, load_function
from simrender.errors import CardError, SceneError, UsageError
from simrender.rays.meshes import FORMATS, read_scene
from simrender.rays.partition import Footprint, Method, Partition, Published, partition, pieces
from simrender.rays.scene import Scene
from simrender.rays.trace import Progress, Trace

if TYPE_CHECKING:
    from simrender.rays.crossings import Crossings
    from simrender.rays.shading import Bounces

Vector = Annotated[tuple[float, float, float], Field(description="x, y, z")]


def _size(text: Any) -> Any:
    if isinstance(text, (list, tuple)):
        return text
    width, cross, height = str(text).partition("x")
    if not (cross and width.isdigit() and height.isdigit() and int(width) > 0 and int(height) > 0):
        message = {"message": f"expected WIDTHxHEIGHT in pixels such as '2560x1080', got {text!r}"}
        raise PydanticCustomError("quantity", "{message}", message)
    return int(width), int(height)


Resolution = Annotated[tuple[int, int], BeforeValidator(_size)]


class PublishedCard(Card):
    """The size of the real thing; the scene's own size where a field is left out.

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


class TracedCard(Card):
    """The size that is really traced."""

    resolution: Resolution


class SceneCard(Card):
    """Where the scene comes from: a mesh file beside the card, or a generator and its arguments."""

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


class CameraCard(Card):
    """A pinhole camera."""

    position: Vector
    look_at: Vector
    up: Vector = (0.0, 0.0, 1.0)
    vertical_fov_degrees: Annotated[float, Field(gt=0, lt=180)] = 40.0

    @model_validator(mode="after")
    def _has_a_direction(self) -> CameraCard:
        forward = np.subtract(self.look_at, self.position)
        if not np.linalg.norm(np.cross(forward, self.up)) > 0.0:
            raise ValueError("the camera looks nowhere: look_at equals position, or lies straight along up")
        return self

    def frame(self, aspect: float) -> NDArray[np.float64]:
        """Return position, forward, right and up as `shading.camera_rays` takes them, for width / height."""
        position, up = np.array(self.position), np.array(self.up)
        forward = np.array(self.look_at) - position
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, up)
        right /= np.linalg.norm(right)
        half = math.tan(math.radians(self.vertical_fov_degrees) / 2.0)
        return np.stack([position, forward, right * half * aspect, np.cross(right, forward) * half])


class BouncesCard(Card):
    """When a path ends; see `shading.Bounces`."""

    diffuse: Annotated[int, Field(ge=0, le=200)] = 3
    mirror: Annotated[int, Field(ge=0, le=200)] = 4
    roulette: Annotated[float, Field(ge=0, le=1)] = 0.3


class WorkloadCard(Card):
    """A workload. ``policy`` holds the name and the parameters of the scheduler that renders it by default."""

    title: str
    published: PublishedCard
    traced: TracedCard
    scene: SceneCard
    camera: CameraCard
    bounces: BouncesCard = BouncesCard()
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
        return self


@dataclass(eq=False)
class Workload:
    """A workload with what was made of it so far: its scene, traces and partitions are made once and kept.

    Attributes
    ----------
    name : str
    card : WorkloadCard
    document : Document
        The card as it was written, for messages.
    folder : Path
        Where the card lies.
    cache : Path or None
        Folder of the trace cache; None takes the default one.

    """

    name: str
    card: WorkloadCard
    document: Document
    folder: Path
    cache: Path | None = None
    given: Scene | None = None
    _traces: dict[int, Trace] = field(default_factory=dict)
    _crossings: dict[tuple[int, str], Crossings] = field(default_factory=dict)
    _partitions: dict[Any, Partition] = field(default_factory=dict)

    @cached_property
    def scene(self) -> Scene:
        """The scene, read or generated when first asked for.

        Raises
        ------
        SceneError, CardError

        """
        if self.given is not None:
            return self.given
        scene = self.card.scene
        if scene.file is not None:
            return read_scene(self.folder / scene.file)
        where = f"{self.document.position(('scene', 'generator'))}: scene.generator"
        generator = load_function(scene.generator or "", where)
        try:
            inspect.signature(generator).bind(**scene.arguments)
        except TypeError as error:
            raise CardError([f"{where}: {scene.generator} does not take these arguments: {error}"]) from None
        try:
            made = generator(**scene.arguments)
        except Exception as error:
            raise SceneError(f"{where}: {scene.generator} failed: {type(error).__name__}: {error}") from error
        if not isinstance(made, Scene):
            raise SceneError(f"{where}: {scene.generator} returned a {type(made).__name__}, not a Scene")
        return made

    @cached_property
    def published(self) -> Published:
        """The published size of the scene."""
        card, scene = self.card.published, self.scene
        own_bytes = sum(m.vertices.nbytes + m.faces.nbytes for m in scene.meshes)
        return Published(
            triangles=card.growth * (card.triangles or scene.unique_triangles),
            instances=card.growth * (card.instances or len(scene.instance_object)),
            instanced_triangles=card.growth**2 * (card.instanced_triangles or scene.instanced_triangles),
            geometry_bytes=card.growth * (own_bytes if card.geometry_bytes is None else card.geometry_bytes),
            texture_bytes=card.growth * (card.texture_bytes or 0.0),
        )

    @property
    def weight(self) -> float:
        """Published rays for which a traced ray stands."""
        (width, height), (w, h) = self.card.published.resolution, self.card.traced.resolution
        return width * height / (w * h)

    @property
    def bounces(self) -> Bounces:
        """When paths end."""
        from simrender.rays.shading import Bounces

        card = self.card.bounces
        return Bounces(card.diffuse, card.mirror, card.roulette)

    def trace(self, seed: int = 1, progress: Progress | None = None) -> Trace:
        """Return the ray table for a seed; nothing is traced before it is asked for."""
        check_seed(seed)
        if seed not in self._traces:
            (width, height), size = self.card.published.resolution, self.card.traced.resolution
            camera = self.card.camera.frame(width / height)
            samples = self.card.published.samples
            self._traces[seed] = Trace(self.scene, camera, size, samples, self.bounces, seed, self.cache)
        self._traces[seed].progress = progress
        return self._traces[seed]

    def crossings(self, seed: int, of: Partition) -> Crossings:
        """Return the crossing table of a trace and a partition."""
        key = (seed, of.key)
        if key not in self._crossings:
            from simrender.rays.crossings import Crossings

            self._crossings[key] = Crossings(self.trace(seed), of)
        return self._crossings[key]

    def partition(self, domains: int, footprint: Footprint, method: Method, split_share: float) -> Partition:
        """Return the scene dealt to so many domains, with weights for a machine's footprint."""
        facts = (domains, footprint, method, split_share)
        if facts not in self._partitions:
            key = (footprint, split_share)
            if key not in self._pieces:
                self._pieces[key] = pieces(self.scene, self.published, footprint, split_share)
            self._partitions[facts] = partition(self._pieces[key], domains, method)
        return self._partitions[facts]

    @cached_property
    def _pieces(self) -> dict[Any, Any]:
        return {}


def load_workload(name: str, overrides: Sequence[str] = (), cache: Path | None = None) -> Workload:
    """Return a workload by name, by the path of its card, or by the path of a mesh file.

    Parameters
    ----------
    name : str
        ``island``, ``my/card.yaml`` or ``my/mesh.ply``. A mesh file is framed by a camera that sees all of it, and
        rendered at 1920x1080 with 8 paths a pixel.
    overrides : list of str
        ``PATH=VALUE`` without the leading ``workload.``.
    cache : Path, optional
        Folder of the trace cache.

    Raises
    ------
    UnknownNameError, CardError, SceneError

    """
    path = Path(name)
    given = None
    if path.suffix.lower() in FORMATS:
        given = read_scene(path)
        document = _mesh_card(path, given)
    else:
        found = find_card("workload", name)
        path, document, name = found.path, found.document(), found.name
    for override in overrides:
        document.override(WorkloadCard, override, "workload")
    card = document.validate(WorkloadCard)
    if card.scene.file != path.name:
        given = None  # another scene was set
    return Workload(path.stem if given else name, card, document, path.parent, cache, given)


def check_seed(seed: int) -> None:
    """Refuse a seed that is not a 64-bit number.

    Raises
    ------
    UsageError

    """
    if not 0 <= seed < 2**64:
        raise UsageError(f"--seed {seed}: expected a number from 0 to 2^64 - 1")


def _mesh_card(path: Path, scene: Scene) -> Document:
    """Return a card for a mesh file: the whole mesh in view, from above and aside."""
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    centre, up = 0.5 * (low + high), np.array(scene.environment.up)
    towards = np.array([0.9, 0.55, 1.0]) if up[1] else np.array([0.9, -1.0, 0.55])
    towards /= np.linalg.norm(towards)
    fov, aspect = 35.0, 16 / 9
    right = np.cross(up, towards) / np.linalg.norm(np.cross(up, towards))
    # As near as every vertex stays in the image, and a little further.
    x, y, z = np.stack([right, np.cross(towards, right), towards]) @ (scene.triangles.vertices - centre).T
    half = math.tan(math.radians(fov) / 2.0)
    distance = 1.08 * float((z + np.maximum(np.abs(x) / aspect, np.abs(y)) / half).max())
    position = centre + towards * max(distance, 1e-30)
    text = f"""\
title: {path.name!r}
published: {{resolution: 1920x1080, samples: 8}}
traced: {{resolution: 320x180}}
scene: {{file: {path.name!r}}}
camera:
  position: {position.tolist()}
  look_at: {centre.tolist()}
  up: {up.tolist()}
  vertical_fov_degrees: {fov}
"""
    return Document(text, str(path))
