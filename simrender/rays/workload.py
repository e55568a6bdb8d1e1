"""Workloads: a scene, a camera and an image; at the size that was published and at the size that is traced."""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from simrender.cards import Document
from simrender.catalog import find_card, load_function
from simrender.errors import CardError, SceneError, UsageError
from simrender.rays.files import FORMATS, SceneFile, read_file
from simrender.rays.integrators import AmbientOcclusion, Integrator, PathTracing, SprayPathTracing
from simrender.rays.partition import Footprint, Method, Partition, Published, partition, pieces
from simrender.rays.scene import F32, Scene
from simrender.rays.trace import Progress, Trace
from simrender.rays.workload_card import DomainsCard, WorkloadCard

if TYPE_CHECKING:
    from simrender.rays.crossings import Crossings
    from simrender.rays.domains import Domains
    from simrender.rays.visits import Visits


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
    given : Scene or None
        The scene, where it is read already.
    boxes : two float32 arrays (d, 3) or None
        Lowest and highest corners of its domains, where its file announces them.

    """

    name: str
    card: WorkloadCard
    document: Document
    folder: Path
    cache: Path | None = None
    given: Scene | None = None
    boxes: tuple[F32, F32] | None = None
    _traces: dict[int, Trace] = field(default_factory=dict)
    _crossings: dict[tuple[int, str], Crossings] = field(default_factory=dict)
    _partitions: dict[Any, Partition] = field(default_factory=dict)
    _domains: dict[str, Domains] = field(default_factory=dict)
    _visits: dict[tuple[str, str], Visits] = field(default_factory=dict)
    _like: Trace | None = None

    @property
    def scene(self) -> Scene:
        """The scene, read or generated when first asked for.

        Raises
        ------
        SceneError, CardError

        """
        return self.content.scene

    @cached_property
    def content(self) -> SceneFile:
        """The scene, and the boxes of its domains where a file announces them."""
        if self.given is not None:
            return SceneFile(self.given, *(self.boxes or ()))
        scene = self.card.scene
        if scene.file is not None:
            return read_file(self.folder / scene.file)
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
        return SceneFile(made)

    @cached_property
    def published(self) -> Published:
        """The published size of the scene."""
        card, scene = self.card.published, self.scene
        own_bytes = sum(m.vertices.nbytes + m.faces.nbytes for m in scene.meshes)
        if scene.volume is not None:
            own_bytes += scene.volume.voxels.nbytes
        if (elements := scene.elements) is not None:
            own_bytes += sum(a.nbytes for a in (elements.points, elements.scalars, elements.corners, elements.kind))
        own_texels = sum(image.texels.nbytes for image in scene.textures)
        unique = card.triangles or scene.unique_triangles
        instanced = unique * scene.instanced_triangles / max(1, scene.unique_triangles)
        return Published(
            triangles=card.growth * unique,
            instances=card.growth * (card.instances or len(scene.instance_object)),
            instanced_triangles=card.growth**2 * (card.instanced_triangles or instanced),
            geometry_bytes=card.growth * (own_bytes if card.geometry_bytes is None else card.geometry_bytes),
            texture_bytes=card.growth * (own_texels if card.texture_bytes is None else card.texture_bytes),
        )

    @property
    def samples(self) -> int:
        """Traced samples a pixel."""
        return self.card.traced.samples or self.card.published.samples

    @property
    def repeats(self) -> int:
        """Published samples a pixel for which a traced one stands."""
        return self.card.published.samples // self.samples

    @property
    def weight(self) -> float:
        """Published rays of one sample a pixel for which a traced ray stands; see `repeats` for the others."""
        (width, height), (w, h) = self.card.published.resolution, self.card.traced.resolution
        return width * height / (w * h)

    def frame(self, number: int, of: int) -> Workload:
        """Return the workload of one frame of an animation: the camera at that point of its way.

        Parameters
        ----------
        number : int
            From 0 to ``of`` - 1; the first frame is at the beginning of the camera's path, the last at its end.
        of : int

        Raises
        ------
        UsageError
            If there is no such frame.

        """
        if not 0 <= number < of:
            raise UsageError(f"frame {number} of {of}: expected 0 to {of - 1}")
        camera = self.card.camera.at(number / (of - 1) if of > 1 else 0.0)
        rounding = 1e-9 * (np.linalg.norm(camera.position) + np.linalg.norm(camera.look_at))
        if not np.linalg.norm(np.cross(np.subtract(camera.look_at, camera.position), camera.up)) > rounding:
            raise UsageError(f"frame {number} of {of}: the camera's path leads through what it looks at, or along up")
        card = self.card.model_copy(update={"camera": camera.model_copy(update={"path": ()})})
        boxes = None if self.content.low is None or self.content.high is None else (self.content.low, self.content.high)
        return replace(
            self, card=card, given=self.scene, boxes=boxes, _traces={}, _crossings={}, _like=self._like or self.trace()
        )

    @property
    def integrator(self) -> Integrator:
        """How light is followed."""
        if self.card.integrator.name == "path_tracing":
            return PathTracing(**self.card.bounces.model_dump())
        integrator = self.card.integrator.value()
        if self.card.integrator.random_numbers == "own" or not isinstance(
            integrator, AmbientOcclusion | SprayPathTracing
        ):
            return integrator
        return replace(integrator, program_image=(*self.card.traced.resolution, self.samples))

    def trace(self, seed: int = 1, progress: Progress | None = None) -> Trace:
        """Return the ray table for a seed; nothing is traced before it is asked for."""
        check_seed(seed)
        if seed not in self._traces:
            (width, height), size = self.card.published.resolution, self.card.traced.resolution
            camera, jitter = self.card.camera, self.card.camera.sampling == "jittered"
            self._traces[seed] = Trace(
                self.scene, camera.at(0.0).frame(width / height), size, self.samples, self.integrator, seed, self.cache,
                jitter=jitter, like=self._like or next(iter(self._traces.values()), None),
            )  # fmt: skip
        self._traces[seed].progress = progress
        return self._traces[seed]

    def crossings(self, seed: int, of: Partition) -> Crossings:
        """Return the crossing table of a trace and a partition."""
        key = (seed, of.key)
        if key not in self._crossings:
            from simrender.rays.crossings import Crossings
            from simrender.rays.domains import from_objects

            trace = self.trace(seed)
            self._crossings[key] = Crossings(trace, from_objects(trace.scene, of))
        return self._crossings[key]

    def domains(self, card: DomainsCard | None = None) -> Domains:
        """Return the domains in which the data comes, or into which another card cuts it; in the traced scene's units.

        A workload whose card says nothing of domains is cut into eight, but for an unstructured mesh.

        Raises
        ------
        SceneError
            If the scene cannot be cut in this way.

        """
        from simrender.rays.data import cut

        card = card or self.card.domains or self._usual_domains
        key = repr(card)
        if key not in self._domains:
            trace = self.trace()
            self._domains[key] = cut(trace.scene, card, self.card.published, self.published, self.content, trace.factor)
        return self._domains[key]

    @property
    def _usual_domains(self) -> DomainsCard:
        if self.scene.elements is not None:
            return DomainsCard()
        count = 8
        if self.scene.volume is not None:
            from simrender.rays.volume import MACRO

            count = min(count, math.prod(-(-cells // MACRO) for cells in self.scene.volume.cells))
        return DomainsCard(method="auto", count=count)

    def domain_crossings(self, seed: int, domains: Domains) -> Crossings:
        """Return the crossing table of a trace and domains."""
        key = (seed, domains.key)
        if key not in self._crossings:
            from simrender.rays.crossings import Crossings

            self._crossings[key] = Crossings(self.trace(seed), domains)
        return self._crossings[key]

    def forget(self, seed: int) -> None:
        """Let go of what is in memory of a trace; it stays on disk."""
        self._traces.pop(seed, None)
        for key in [key for key in self._crossings if key[0] == seed]:
            del self._crossings[key]

    def visits(self, crossings: Crossings) -> Visits:
        """Return the domains that each ray of a complete trace visits without speculation."""
        from simrender.rays.visits import visits

        key = (crossings.trace.key, crossings.domains.key)
        if key not in self._visits:
            self._visits[key] = visits(crossings)
        return self._visits[key]

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
    """Return a workload by name, by the path of its card, or by the path of a file that holds a scene.

    Parameters
    ----------
    name : str
        ``island``, ``my/card.yaml``, ``my/mesh.ply`` or another file of the `FORMATS`. A mesh or volume is framed by a
        camera that sees all of it, and rendered at 1920x1080; a mesh with 8 paths a pixel.
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
        given = read_file(path)
        document = _file_card(path, given)
    else:
        found = find_card("workload", name)
        path, document, name = found.path, found.document(), found.name
    for override in overrides:
        document.override(WorkloadCard, override, "workload")
    card = document.validate(WorkloadCard)
    if card.scene.file != path.name:
        given = None  # another scene was set
    if given is None:
        return Workload(name, card, document, path.parent, cache)
    boxes = None if given.low is None or given.high is None else (given.low, given.high)
    return Workload(path.stem, card, document, path.parent, cache, given.scene, boxes)


def check_seed(seed: int) -> None:
    """Refuse a seed that is not a 64-bit number.

    Raises
    ------
    UsageError

    """
    if not 0 <= seed < 2**64:
        raise UsageError(f"--seed {seed}: expected a number from 0 to 2^64 - 1")


SPRAY_VIEW = (1.5043045, 1.43577790780127, 1.312005625)
"""The viewpoint of the wavelets example of SpRay's authors, from the centre of its box in halves of its sides."""


def _file_card(path: Path, content: SceneFile) -> Document:
    """Return a card for a file that holds a scene: all of it in view, from above and aside."""
    scene = content.scene
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    if content.low is not None and content.high is not None:
        low, high = content.low.min(axis=0).astype(np.float64), content.high.max(axis=0).astype(np.float64)
    centre, up = 0.5 * (low + high), np.array(scene.environment.up)
    if path.suffix.lower() == ".spray":
        # Its scene files have no camera; the program's own defaults otherwise.
        return _card(
            path, centre + np.array(SPRAY_VIEW) * 0.5 * (high - low), centre, np.array([0.0, 1.0, 0.0]), 90.0,
            "{resolution: 512x512, samples: 1}", "{resolution: 512x512}",
            "domains: {method: given}\nintegrator: {name: spray_path_tracing, bounces: 1, shadow_samples: 1}\n",
            "corner",
        )  # fmt: skip
    towards = np.array([0.9, 0.55, 1.0]) if up[1] else np.array([0.9, -1.0, 0.55])
    towards /= np.linalg.norm(towards)
    fov, aspect = 35.0, 16 / 9
    right = np.cross(up, towards) / np.linalg.norm(np.cross(up, towards))
    integrator, samples = "", 8
    if scene.volume is None and scene.elements is None:
        points = scene.triangles.vertices
    else:
        points = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
        name = "element_marching" if scene.elements is not None else "volume_marching"
        integrator, samples = f"integrator: {{name: {name}}}\n", 1
    # As near as every vertex stays in the image, and a little further.
    x, y, z = np.stack([right, np.cross(towards, right), towards]) @ (points - centre).T
    half = math.tan(math.radians(fov) / 2.0)
    distance = 1.08 * float((z + np.maximum(np.abs(x) / aspect, np.abs(y)) / half).max())
    position = centre + towards * max(distance, 1e-30)
    published = f"{{resolution: 1920x1080, samples: {samples}}}"
    return _card(path, position, centre, up, fov, published, "{resolution: 320x180}", integrator, "jittered")


def _card(
    path: Path, position: Any, look_at: Any, up: Any, fov: float, published: str, traced: str, rest: str, sampling: str
) -> Document:
    name = json.dumps(path.name, ensure_ascii=False)  # JSON's strings are YAML's
    text = f"""\
title: {name}
published: {published}
traced: {traced}
scene: {{file: {name}}}
camera:
  position: {position.tolist()}
  look_at: {look_at.tolist()}
  up: {up.tolist()}
  vertical_fov_degrees: {fov}
  sampling: {sampling}
{rest}"""
    return Document(text, str(path))
