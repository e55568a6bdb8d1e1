"""Scene files of SpRay, the program of the paper "SpRay: speculative ray scheduling for large data visualization".

A file is read line by line; ``#`` starts a comment. It names lights, and domains that each place a PLY mesh:

    light point 0 500 1000 1 1 1     position, radiance (the same at every distance)
    light diffuse 1 1 1              radiance from the hemisphere around a surface's normal
    domain                           begins domain 0, 1, ...
    file wavelet.ply                 beside the scene file
    mtl diffuse 1 1 1                or mirror
    bound -10 -10 -10 10 9.3 10      box of the mesh in its own space
    face 5480                        how many triangles and vertices the mesh has
    vertex 2840
    translate 20 0 0                 or scale x y z, or rotate x|y|z degrees; the last line applies to the mesh first

Later versions of the program write ``DomainBegin``, ``ModelBegin``, ``ModelEnd`` and ``DomainEnd`` around one or more
meshes, ``material`` for ``mtl``, and say of what a box or a number is: ``ModelBounds`` (in the mesh's own space),
``DomainBounds`` (in the world), ``ModelFace``, ``DomainFace``, ``ModelVertex``, ``DomainVertex``. Both are read.
"""

from __future__ import annotations

import difflib
import math
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError, SceneWarning, did_you_mean
from simrender.rays.meshes import read_mesh
from simrender.rays.scene import F32, Environment, Material, Mesh, PointLight, Scene, SceneObject

F64 = NDArray[np.float64]
Color = tuple[float, float, float]

KEYWORDS = (
    "light", "domain", "file", "mtl", "bound", "face", "vertex", "scale", "rotate", "translate",
    "DomainBegin", "DomainEnd", "ModelBegin", "ModelEnd", "material",
    "DomainBounds", "DomainFace", "DomainVertex", "ModelBounds", "ModelFace", "ModelVertex",
)  # fmt: skip
"""What a line may begin with."""

_LIGHTS = ("point", "diffuse", "diffuse-hemisphere", "diffuse-sphere")
_MATERIALS = ("diffuse", "matte", "mirror")

# The other names of the lines about one mesh, and what each announces.
_OF_MODEL = {"ModelBounds": "bound", "ModelFace": "face", "ModelVertex": "vertex", "material": "mtl"}
_OF_DOMAIN = {"DomainBounds": "bound", "DomainFace": "face", "DomainVertex": "vertex"}

_BLACK = (0.0, 0.0, 0.0)

_SLACK = 1e-6
"""Boxes are written with few digits: a mesh may stick out by this much of the box's size without a warning."""


@dataclass(frozen=True, eq=False)
class SprayScene:
    """A scene file of SpRay: a scene whose objects are its domains, and their boxes.

    Attributes
    ----------
    scene : Scene
        Object i, with one instance, is domain i. Its meshes have the PLY file's vertex colors and are shaded smoothly.
        A ray that hits nothing sees black.
    low, high : float32 array (d, 3)
        World box of each domain: around the eight corners of the announced box, or of the mesh where none is announced.
    faces, vertices : int64 array (d,)
        Number of triangles and of vertices of each domain.

    """

    scene: Scene
    low: F32
    high: F32
    faces: NDArray[np.int64]
    vertices: NDArray[np.int64]


@dataclass
class _Model:
    """A mesh of a domain as the file announces it; ``lines`` are where."""

    line: int
    file: Path | None = None
    material: Material = field(default_factory=lambda: Material((1.0, 1.0, 1.0)))
    bound: F64 | None = None
    face: int | None = None
    vertex: int | None = None
    transform: F64 = field(default_factory=lambda: np.eye(4))
    lines: dict[str, int] = field(default_factory=dict)


@dataclass
class _Domain:
    """A domain as the file announces it."""

    line: int
    models: list[_Model] = field(default_factory=list)
    bound: F64 | None = None
    face: int | None = None
    vertex: int | None = None
    lines: dict[str, int] = field(default_factory=dict)


def read_spray(path: Path) -> SprayScene:
    """Read a scene file of SpRay and the PLY files it names, each once.

    Parameters
    ----------
    path : Path
        The ``.spray`` file; the names in it are relative to its folder.

    Raises
    ------
    SceneError
        If the file is missing or has mistakes: all of them, one a line, as ``file:line: what``.

    Warns
    -----
    SceneWarning
        If a mesh sticks out of its announced box; the domain's box is widened, so that no surface is lost.

    """
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not text: this is no scene file of SpRay") from None
    except OSError as error:
        what = "this is a folder, expected a file" if path.is_dir() else f"cannot read this file: {error.strerror}"
        raise SceneError(f"{path}: {what if path.exists() else 'there is no such file'}") from None
    reader = _Reader(path)
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split(maxsplit=1)
        if words:
            reader.read(number, words[0], words[1].strip() if len(words) > 1 else "")
    reader.end()
    meshes = reader.meshes()
    reader.check_counts(meshes)
    if reader.mistakes:
        raise SceneError("\n".join(message for _, message in sorted(reader.mistakes, key=lambda m: m[0])))
    return _built(path, reader, meshes)


class _Reader:
    """What the lines so far have said, and every mistake in them."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.mistakes: list[tuple[int, str]] = []
        self.points: list[PointLight] = []
        self.hemispheres: list[Color] = []
        self.domains: list[_Domain] = []
        self.model: _Model | None = None
        self.opened = False  # between DomainBegin and DomainEnd

    def mistake(self, line: int, what: str) -> None:
        self.mistakes.append((line, f"{self.path}:{line}: {what}"))

    def read(self, line: int, word: str, rest: str) -> None:
        """Take in one line: its first word, and the rest without comment."""
        if word == "light":
            self.light(line, rest.split())
        elif word in {"domain", "DomainBegin", "DomainEnd", "ModelBegin", "ModelEnd"}:
            if rest:
                self.mistake(line, f"{word!r} stands alone on its line, got {rest!r} after it")
            self.bracket(line, word)
        elif word in _OF_DOMAIN:
            if not self.opened or self.model is not None:
                self.mistake(line, f"{word!r} belongs between 'DomainBegin' and 'DomainEnd', outside of models")
            else:
                self.announce(line, self.domains[-1], word, _OF_DOMAIN[word], rest)
        elif word in KEYWORDS:
            if self.model is None:
                where = "'ModelBegin' and 'ModelEnd'" if self.opened else "a line 'domain'; there is none before it"
                self.mistake(line, f"{word!r} belongs {'between' if self.opened else 'after'} {where}")
            else:
                self.of_model(line, self.model, word, rest)
        elif word == "sphere":
            self.mistake(line, "'sphere': only triangle meshes are rendered; write the sphere as a PLY file")
        else:
            known = f"known: {', '.join(KEYWORDS)}"
            self.mistake(line, f"unknown keyword {word!r}{did_you_mean(word, KEYWORDS)} ({known})")

    def bracket(self, line: int, word: str) -> None:
        """Begin or end a domain or a model."""
        if word == "domain":
            if self.opened:
                begun = self.domains[-1].line
                self.mistake(
                    line, f"'domain' before the 'DomainEnd' of line {begun}'s domain: use one way or the other"
                )
                self.opened = False
            self.model = _Model(line)
            self.domains.append(_Domain(line, [self.model]))
        elif word == "DomainBegin":
            if self.opened:
                self.mistake(line, f"'DomainBegin' before the 'DomainEnd' of line {self.domains[-1].line}'s domain")
            self.opened, self.model = True, None
            self.domains.append(_Domain(line))
        elif not self.opened:
            self.mistake(line, f"{word!r} without a 'DomainBegin' before it")
        elif word == "ModelBegin":
            if self.model is not None:
                self.mistake(line, f"'ModelBegin' before the 'ModelEnd' of line {self.model.line}'s model")
            self.model = _Model(line)
            self.domains[-1].models.append(self.model)
        elif word == "ModelEnd":
            if self.model is None:
                self.mistake(line, "'ModelEnd' without a 'ModelBegin' before it")
            self.model = None
        else:
            if self.model is not None:
                self.mistake(line, f"'DomainEnd' before the 'ModelEnd' of line {self.model.line}'s model")
            self.opened, self.model = False, None

    def light(self, line: int, words: list[str]) -> None:
        kind = words[0] if words else ""
        if kind not in _LIGHTS:
            self.mistake(line, f"unknown light {kind!r}{did_you_mean(kind, _LIGHTS)} (known: {', '.join(_LIGHTS)})")
            return
        what = "a position x y z and a radiance r g b" if kind == "point" else "a radiance r g b"
        values = self.numbers(line, f"light {kind}", words[1:], 6 if kind == "point" else 3, what)
        if values is None:
            return
        if min(values[-3:]) < 0.0:
            self.mistake(line, f"'light {kind}': a radiance is not negative, got {' '.join(words[-3:])}")
        elif kind == "point":
            self.points.append(PointLight(_triple(values[:3]), _triple(values[3:]), falloff=False))
        else:
            self.hemispheres.append(_triple(values))

    def of_model(self, line: int, model: _Model, word: str, rest: str) -> None:
        """Take in a line about a mesh."""
        name = _OF_MODEL.get(word, word)
        if name in {"scale", "rotate", "translate"}:
            self.transform(line, model, word, rest.split())
        elif name in model.lines:
            self.mistake(line, f"a second {word!r} for this mesh, after line {model.lines[name]}: it has one")
        elif name == "file":
            model.lines[name] = line
            model.file = self.file(line, rest)
        elif name == "mtl":
            model.lines[name] = line
            model.material = self.material(line, word, rest.split()) or model.material
        else:
            self.announce(line, model, word, name, rest)

    def announce(self, line: int, of: _Model | _Domain, word: str, name: str, rest: str) -> None:
        """Take in a box or a number of faces or vertices."""
        if name in of.lines:
            self.mistake(line, f"a second {word!r}, after line {of.lines[name]}")
            return
        of.lines[name] = line
        if name == "bound":
            values = self.numbers(line, word, rest.split(), 6, "minx miny minz maxx maxy maxz")
            if values is None:
                return
            box = np.array(values).reshape(2, 3)
            if (box[0] > box[1]).any():
                axis = "xyz"[int(np.argmax(box[0] > box[1]))]
                self.mistake(line, f"{word!r}: the smallest {axis} is above the largest, got {rest!r}")
            else:
                of.bound = box
        elif not rest.isdecimal():
            self.mistake(line, f"{word!r} wants one whole number, got {rest!r}")
        else:
            setattr(of, name, int(rest))

    def transform(self, line: int, model: _Model, word: str, words: list[str]) -> None:
        """Multiply the matrix from the right, so that the line that comes last moves the mesh first."""
        matrix = np.eye(4)
        if word == "rotate":
            if words[:1] not in (["x"], ["y"], ["z"]):
                self.mistake(line, f"'rotate' wants an axis x, y or z and an angle in degrees, got {' '.join(words)!r}")
                return
            values = self.numbers(line, f"rotate {words[0]}", words[1:], 1, "an angle in degrees")
            if values is None:
                return
            i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[words[0]]
            angle = math.radians(values[0])
            matrix[i, i] = matrix[j, j] = math.cos(angle)
            matrix[j, i] = math.sin(angle)
            matrix[i, j] = -matrix[j, i]
        else:
            values = self.numbers(line, word, words, 3, "x y z")
            if values is None:
                return
            if word == "scale":
                if 0.0 in values:
                    self.mistake(line, f"'scale' by 0 flattens the mesh, got {' '.join(words)!r}")
                matrix[[0, 1, 2], [0, 1, 2]] = values
            else:
                matrix[:3, 3] = values
        model.transform = model.transform @ matrix

    def material(self, line: int, word: str, words: list[str]) -> Material | None:
        kind = words[0] if words else ""
        if kind not in _MATERIALS:
            known = f"(known: {', '.join(_MATERIALS)})"
            if kind in {"glass", "transmission", "dielectric", "metal"}:
                hint = "; 'mirror r g b' is the nearest" if kind == "metal" else ": light is not refracted here"
                self.mistake(line, f"material {kind!r} cannot be rendered{hint} {known}")
            else:
                self.mistake(line, f"unknown material {kind!r}{did_you_mean(kind, _MATERIALS)} {known}")
            return None
        if kind == "matte" and len(words) == 1:
            return Material((1.0, 1.0, 1.0))
        values = self.numbers(line, f"{word} {kind}", words[1:], 3, "a reflectance r g b")
        if values is None:
            return None
        if not all(0.0 <= v <= 1.0 for v in values):
            self.mistake(line, f"'{word} {kind}': a reflectance lies between 0 and 1, got {' '.join(words[1:])!r}")
            return None
        return Material(_triple(values), mirror=1.0 if kind == "mirror" else 0.0)

    def file(self, line: int, name: str) -> Path | None:
        if not name:
            self.mistake(line, "'file' wants the name of a PLY file")
            return None
        file = self.path.parent / name
        if file.suffix.lower() != ".ply":
            self.mistake(line, f"{name!r} is no PLY file: the meshes of a scene file end in .ply")
        elif not file.is_file():
            beside = sorted(p.name for p in file.parent.glob("*.ply")) if file.parent.is_dir() else []
            near = difflib.get_close_matches(file.name, beside, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            self.mistake(line, f"there is no file {name!r} in {file.parent}{hint}")
        else:
            return file
        return None

    def numbers(self, line: int, word: str, words: list[str], count: int, what: str) -> list[float] | None:
        """Return so many finite numbers, or note what is wrong."""
        got = " ".join(words)
        if len(words) != count:
            number = f"{count} number" if count == 1 else f"{count} numbers"
            self.mistake(line, f"{word!r} wants {number} ({what}), got {len(words)}: {got!r}")
            return None
        values = []
        for text in words:
            try:
                value = float(text)
            except ValueError:
                self.mistake(line, f"{word!r} wants numbers ({what}), got {text!r} in {got!r}")
                return None
            if not abs(value) <= np.finfo(np.float32).max:
                self.mistake(line, f"{word!r} wants finite numbers ({what}), got {text!r} in {got!r}")
                return None
            values.append(value)
        return values

    def end(self) -> None:
        """Note what the file as a whole lacks."""
        if self.opened:
            self.mistake(self.domains[-1].line, "'DomainBegin' has no 'DomainEnd'")
        if not self.domains:
            self.mistake(1, "the file has no domain: expected lines 'domain' and 'file NAME.ply'")
        for index, domain in enumerate(self.domains):
            if not domain.models:
                self.mistake(domain.line, f"domain {index} has no model: expected 'ModelBegin' and 'file NAME.ply'")
            for model in domain.models:
                if "file" not in model.lines:
                    self.mistake(model.line, f"domain {index} has a mesh without a line 'file NAME.ply'")

    def meshes(self) -> dict[Path, Mesh]:
        """Read each PLY file once; a bad one is noted where it is first named."""
        found: dict[Path, Mesh] = {}
        seen: dict[Path, None] = {}
        for model in (m for domain in self.domains for m in domain.models):
            if model.file is None or model.file in seen:
                continue
            seen[model.file] = None
            try:
                found[model.file] = replace(read_mesh(model.file), smooth=True)
            except SceneError as error:
                self.mistake(model.lines["file"], str(error))
        return found

    def check_counts(self, meshes: dict[Path, Mesh]) -> None:
        """Compare the announced numbers of faces and vertices with the meshes'."""
        for domain in self.domains:
            known = [meshes[m.file] for m in domain.models if m.file in meshes]
            owners: list[tuple[_Model | _Domain, list[Mesh], str]] = [
                (m, [meshes[m.file]], m.file.name) for m in domain.models if m.file in meshes
            ]
            if len(known) == len(domain.models):
                owners.append((domain, known, "all meshes of this domain"))
            for owner, held, name in owners:
                for what, announced, has in (
                    ("faces", owner.face, sum(len(m.faces) for m in held)),
                    ("vertices", owner.vertex, sum(len(m.vertices) for m in held)),
                ):
                    if announced is not None and announced != has:
                        line = owner.lines["face" if what == "faces" else "vertex"]
                        self.mistake(line, f"the file announces {announced} {what}, but {name} has {has}")


def _built(path: Path, reader: _Reader, meshes: dict[Path, Mesh]) -> SprayScene:
    """Make the scene of a file without mistakes."""
    materials: dict[Material, int] = {}
    shared: dict[tuple[Path, int], Mesh] = {}
    objects, transforms, lows, highs = [], [], [], []
    for index, domain in enumerate(reader.domains):
        placed = []
        corners = []
        for model in domain.models:
            assert model.file is not None  # noqa: S101  a file without mistakes
            material = materials.setdefault(model.material, len(materials))
            if (model.file, material) not in shared:
                shared[model.file, material] = replace(meshes[model.file], material=material)
            mesh = shared[model.file, material]
            corners.append(_box(path, model, mesh))
            placed.append(mesh)
        # One mesh is placed by its instance and shared with other domains; several are written out in world space.
        matrix = domain.models[0].transform
        if len(placed) > 1:
            placed = [_moved(mesh, m.transform) for mesh, m in zip(placed, domain.models, strict=True)]
            matrix = np.eye(4)
        objects.append(SceneObject(f"domain {index}", tuple(placed)))
        transforms.append(matrix[:3].astype(np.float32))
        world = np.concatenate(corners).astype(np.float32)
        box = np.stack([world.min(axis=0), world.max(axis=0)]).astype(np.float64)
        if domain.bound is not None:
            box = _widened(path, domain.lines["bound"], f"the meshes of domain {index}", domain.bound, box)
        lows.append(box[0].astype(np.float32))
        highs.append(box[1].astype(np.float32))
    scene = Scene(
        tuple(objects),
        np.arange(len(objects), dtype=np.int32),
        np.stack(transforms),
        tuple(materials),
        tuple(reader.points),
        Environment(_BLACK, _BLACK, _BLACK),
        tuple(reader.hemispheres),
    )
    held = [[meshes[m.file] for m in d.models if m.file] for d in reader.domains]
    faces = np.array([sum(len(m.faces) for m in each) for each in held], dtype=np.int64)
    vertices = np.array([sum(len(m.vertices) for m in each) for each in held], dtype=np.int64)
    return SprayScene(scene, np.stack(lows), np.stack(highs), faces, vertices)


def _box(path: Path, model: _Model, mesh: Mesh) -> F64:
    """Return the corners of a mesh's box in the world, float64 (8, 3)."""
    box = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]).astype(np.float64)
    if model.bound is not None:
        name = model.file.name if model.file else "the mesh"
        box = _widened(path, model.lines["bound"], name, model.bound, box)
    corners = np.array([[box[i >> axis & 1, axis] for axis in range(3)] for i in range(8)])
    return np.asarray(corners @ model.transform[:3, :3].T + model.transform[:3, 3])


def _widened(path: Path, line: int, what: str, announced: F64, box: F64) -> F64:
    """Return an announced box, widened with a warning if what it should hold sticks out of it."""
    slack = _SLACK * max(float(np.ptp(announced, axis=0).max()), float(np.abs(announced).max()))
    outside = max(float((announced[0] - box[0]).max()), float((box[1] - announced[1]).max()))
    if outside <= slack:
        return announced
    message = f"{path}:{line}: the box is too small for {what} by {outside:.6g}; it is widened"
    warnings.warn(message, SceneWarning, stacklevel=2)
    return np.stack([np.minimum(announced[0], box[0]), np.maximum(announced[1], box[1])])


def _moved(mesh: Mesh, matrix: F64) -> Mesh:
    """Return the mesh with its vertices in the world."""
    world = mesh.vertices.astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    return replace(mesh, vertices=world.astype(np.float32))


def _triple(values: list[float]) -> Color:
    return values[0], values[1], values[2]
