"""Mesh files (PLY, OBJ, GLB, STL) to scenes, through trimesh."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from simrender.errors import SceneError, SceneWarning, did_you_mean
from simrender.rays.scene import GAMMA, IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject, Texture

FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl")
"""Endings of the files that are read."""

_PARTS = 64
"""A scanned mesh has no objects to deal to GPUs, so it is cut into this many meshes, in the order of its faces."""

_DAMAGED = "cannot read this mesh, which is damaged or cut short"

_IMAGES = (".png", ".jpg", ".jpeg", ".tga", ".bmp", ".tif", ".tiff", ".webp")

_Y_UP = (".obj", ".glb", ".gltf")


def read_scene(path: Path) -> Scene:
    """Read a mesh file as a scene under a plain sky and one lamp.

    Parameters
    ----------
    path : Path
        A file of one of the `FORMATS`. A file with a scene graph keeps its instances; single meshes are cut into parts
        that a partition can deal out. Materials keep their color and the image that it is multiplied by.

    Warns
    -----
    SceneWarning
        If an image that the file names is not there: the surface is then in its color alone.

    Raises
    ------
    SceneError
        If the file or an image is unreadable, or it holds a mesh that cannot be rendered; the message names the file.

    """
    loaded = _loaded(path)
    _check_images(path)
    import trimesh

    try:
        with np.errstate(over="ignore"):
            return _from_graph(loaded) if isinstance(loaded, trimesh.Scene) else _from_mesh(loaded, path)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


def read_mesh(path: Path) -> Mesh:
    """Read a mesh file that holds one mesh, with the vertex colors that it may have.

    Parameters
    ----------
    path : Path
        A file of one of the `FORMATS`.

    Raises
    ------
    SceneError
        As `read_scene`, and if the file holds a scene of several meshes.

    """
    loaded = _loaded(path)
    try:
        with np.errstate(over="ignore"):
            return _one_mesh(loaded)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


def _loaded(path: Path) -> Any:
    """Return what trimesh makes of a file."""
    if path.suffix.lower() not in FORMATS:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r} (known: {', '.join(FORMATS)})")
    if not path.is_file():
        raise SceneError(f"{path}: {'this is a folder, expected a file' if path.is_dir() else 'there is no such file'}")
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: the file is empty")
    import trimesh

    fault = _ply_fault(path) if path.suffix.lower() == ".ply" else ""
    if fault:
        raise SceneError(f"{path}: {_DAMAGED}: {fault}")
    try:
        with np.errstate(over="ignore"):  # a vertex too far for float32 is refused as infinite
            return trimesh.load(path, process=False)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{path}: {_DAMAGED}: {reason}") from None


def _one_mesh(loaded: Any) -> Mesh:
    _check_length(getattr(loaded, "metadata", {}).get("_ply_raw", {}))
    if getattr(loaded, "geometry", None):
        raise SceneError(f"it holds a scene of {len(loaded.geometry)} meshes, expected one mesh")
    faces = getattr(loaded, "faces", None)
    if faces is None or len(faces) == 0:
        raise SceneError("the mesh is empty: it has no triangles")
    return Mesh(np.asarray(loaded.vertices), np.asarray(faces), colors=_colors(loaded))


def _colors(geometry: Any) -> Any:
    """Return the colors of a geometry's vertices, 0 to 1, as they are in its file; None if it has none."""
    if geometry.visual.kind != "vertex":
        return None
    return np.asarray(geometry.visual.vertex_colors)[:, :3].astype(np.float32) / np.float32(255.0)


def _from_mesh(loaded: Any, path: Path) -> Scene:
    mesh = _one_mesh(loaded)
    if mesh.colors is not None:
        mesh = replace(mesh, colors=mesh.colors ** np.float32(GAMMA))
    textures: dict[int, Texture] = {}
    material, uv = _material(loaded, textures)
    thing = SceneObject(path.stem, _cut(replace(mesh, uv=uv), _PARTS))
    y_up = path.suffix.lower() in _Y_UP
    return _lit((thing,), np.zeros(1, np.int32), IDENTITY[None], (material,), textures, y_up)


def _check_images(path: Path) -> None:
    """Warn of images that a file names and that are not there, and refuse damaged ones: trimesh does without either."""
    from PIL import Image

    for where, name in _named_images(path):
        file = path.parent / name
        if not file.is_file():
            near = did_you_mean(name, [beside.name for beside in path.parent.iterdir() if beside.suffix in _IMAGES])
            message = f"{where}: there is no image {name!r} in {path.parent}, and the surface has its color alone{near}"
            warnings.warn(message, SceneWarning, stacklevel=4)
            continue
        try:
            with Image.open(file) as image:
                image.load()
        except (OSError, SyntaxError, ValueError) as error:
            reason = " ".join(str(error).split())
            raise SceneError(
                f"{where}: cannot read the image {file}, which is damaged or cut short: {reason}"
            ) from None


def _named_images(path: Path) -> Iterator[tuple[str, str]]:
    """Yield where an OBJ or glTF file names an image of its own folder, and its name."""
    if path.suffix.lower() == ".gltf":
        for number, image in enumerate(json.loads(path.read_bytes()).get("images", [])):
            name = image.get("uri", "data:")
            if not name.startswith("data:"):
                yield f"{path}: image {number}", name
    elif path.suffix.lower() == ".obj":
        for library in _named(path, "mtllib"):
            file = path.parent / library[1]
            for line, name in _named(file, "map_kd") if file.is_file() else ():
                yield f"{file}:{line}", name


def _named(file: Path, key: str) -> list[tuple[int, str]]:
    """Return the lines of a text file that begin with a key word, and what follows it."""
    text = file.read_bytes()
    found = re.finditer(rb"^[ \t]*" + key.encode() + rb"[ \t]+([^\r\n]*\S)", text, re.MULTILINE | re.IGNORECASE)
    return [(text.count(b"\n", 0, line.start()) + 1, line[1].decode("utf-8", "replace")) for line in found]


def _check_length(elements: Any) -> None:
    """Refuse a PLY file that holds less than its header announces: trimesh reads the rest of a text file in silence."""
    for what, element in elements.items():
        data, announced = element.get("data"), element.get("length", 0)
        columns = data.values() if isinstance(data, dict) else [] if data is None else [data]
        found = min((len(column) for column in columns), default=0)
        if found < announced:
            raise SceneError(f"the file is cut short: it announces {announced} of element {what} and has {found}")


_PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
_HEADER_LIMIT = 1 << 20


def _ply_fault(path: Path) -> str:
    """Return what is wrong with the rows of a PLY file, and in which line or byte; nothing if they look whole.

    A text file without its last rows passes: `_check_length` says how many of which element it lacks.
    """
    with path.open("rb") as file:
        head = file.read(_HEADER_LIMIT)
    if head.split(None, 1)[:1] != [b"ply"]:
        return "it does not begin with the line 'ply'"
    end = re.search(rb"^end_header[ \t]*(\r\n|\n|\r)", head, re.MULTILINE)
    if end is None:
        return f"its header, {len(head)} bytes long, does not end with a line 'end_header'"
    lines = head[: end.start()].decode("ascii", "replace").splitlines()
    form, elements = "", []
    for words in (line.split() for line in lines):
        if words[:1] == ["format"] and len(words) > 1:
            form = words[1]
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdecimal():
            elements.append((words[1], int(words[2]), list[tuple[str, ...]]()))
        elif words[:1] == ["property"] and elements and len(words) == (5 if words[1:2] == ["list"] else 3):
            elements[-1][2].append(tuple(words[1:-1]))
    if form == "ascii":
        return _text_fault(path, len(lines) + 1, elements)
    known = all(kind in _PLY_BYTES for _, _, row in elements for p in row for kind in (p[1:] if p[0] == "list" else p))
    order = {"binary_little_endian": "little", "binary_big_endian": "big"}.get(form)
    return _binary_fault(path, end.end(), elements, order) if known and order else ""


def _text_fault(path: Path, header: int, elements: Any) -> str:
    """Find the first row of a text file that has fewer numbers than its element."""
    with path.open(encoding="ascii", errors="replace") as file:
        rows = ((at, line.split()) for at, line in enumerate(file, start=1) if at > header and not line.isspace())
        for name, count, properties in elements:
            for row in range(count):
                at, words = next(rows, (0, []))
                if not words:
                    return ""
                need = 0
                for kind in properties:
                    many = words[need] if kind[0] == "list" and need < len(words) else "0"
                    need += 1 + (int(many) if many.isdecimal() else 0)
                if len(words) < need:
                    return f"line {at} has {len(words)} of the {need} numbers of {name} {row} of {count}"
    return ""


def _binary_fault(path: Path, start: int, elements: Any, order: Any) -> str:
    """Find the row in which a binary file ends too early, if it does."""
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(start)
        for name, count, properties in elements:
            first, row = file.tell(), 0
            for row in range(count):
                for kind in properties:
                    many = 1
                    if kind[0] == "list":
                        many = int.from_bytes(file.read(_PLY_BYTES[kind[1]]), order)
                    file.seek(many * _PLY_BYTES[kind[-1]], 1)
                if file.tell() > size:
                    return f"it ends at byte {size}, in {name} {row} of {count}"
                # Rows are nearly always of one length; only where that cannot be so is each one looked at.
                if row == 0 and first + count * (file.tell() - first) <= size:
                    file.seek(first + count * (file.tell() - first))
                    break
            if row > 0:
                return f"not all of its {name}s have the same number of corners: write them as triangles"
        end = file.tell()
    return "" if end == size else f"it has {size} bytes, but rows like the first of each element take {end}"


def _from_graph(graph: Any) -> Scene:
    if not graph.geometry:
        raise SceneError("nothing could be read: it is empty, cut short, or in another format than its ending says")
    objects: list[SceneObject] = []
    materials: list[Material] = []
    textures: dict[int, Texture] = {}
    index: dict[str, int] = {}
    total = max(1, sum(len(getattr(geometry, "faces", ())) for geometry in graph.geometry.values()))
    for name, geometry in graph.geometry.items():
        if getattr(geometry, "faces", None) is None or len(geometry.faces) == 0:
            continue  # points and lines reflect nothing
        index[name] = len(objects)
        material, uv = _material(geometry, textures)
        # Unlike those of other files, the colors of glTF are reflectances.
        colors = _colors(geometry)
        mesh = Mesh(np.asarray(geometry.vertices), np.asarray(geometry.faces), len(materials), colors, uv=uv)
        objects.append(SceneObject(str(name), _cut(mesh, -(-len(mesh.faces) * _PARTS // total))))
        materials.append(material)
    owner, transforms = [], []
    for node in graph.graph.nodes_geometry:
        transform, name = graph.graph[node]
        if name in index:
            owner.append(index[name])
            transforms.append(np.asarray(transform, dtype=np.float32)[:3])
    if not owner:
        raise SceneError("the scene is empty: it has no triangles")
    return _lit(tuple(objects), np.array(owner, np.int32), np.array(transforms), tuple(materials), textures, True)


def _cut(mesh: Mesh, parts: int) -> tuple[Mesh, ...]:
    """Cut a mesh into so many parts of about equally many consecutive faces."""
    pieces = np.array_split(mesh.faces, parts)
    return tuple(_part(mesh, piece) for piece in pieces if len(piece))


def _part(mesh: Mesh, faces: Any) -> Mesh:
    used, renumbered = np.unique(faces, return_inverse=True)
    colors, uv = (None if column is None else column[used] for column in (mesh.colors, mesh.uv))
    corners = renumbered.reshape(-1, 3).astype(np.int32)
    return replace(mesh, vertices=mesh.vertices[used], faces=corners, colors=colors, uv=uv)


def _material(geometry: Any, textures: dict[int, Texture]) -> tuple[Material, Any]:
    """Return a geometry's material and its texture coordinates, None for none.

    Its image is added to the textures, of which there is one for each image, by its identity. The base color of glTF
    is a reflectance, by which its image is multiplied; OBJ's is meant for a display, and an image takes its place.
    """
    material, uv = getattr(geometry.visual, "material", None), getattr(geometry.visual, "uv", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    color = getattr(material, "main_color", None)
    if image is None or uv is None:
        if color is None:
            return Material((0.72, 0.68, 0.62)), None
        red, green, blue = (float(c) / 255.0 for c in color[:3])
        return Material((red**GAMMA, green**GAMMA, blue**GAMMA)), None
    try:
        if id(image) not in textures:
            textures[id(image)] = Texture(np.asarray(image.convert("RGB")))
    except (OSError, SyntaxError, ValueError) as error:  # read only now
        raise SceneError(f"an image in it is damaged or cut short: {error}") from None
    factor = getattr(material, "baseColorFactor", None)
    red, green, blue = (1.0, 1.0, 1.0) if factor is None else (float(c) / 255.0 for c in factor[:3])
    return Material((red, green, blue), texture=list(textures).index(id(image))), np.asarray(uv)


def _lit(objects: Any, owner: Any, transforms: Any, materials: Any, textures: dict[int, Texture], y_up: bool) -> Scene:
    """Add a sky, and a lamp above and beside the scene that gives its centre an irradiance of about 2."""
    scene = Scene(objects, owner, transforms, materials, textures=tuple(textures.values()))
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    if (low == high).all():
        raise SceneError(f"the mesh has no extent: all its vertices lie at {low.tolist()}")
    centre, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-30)
    up = (0.0, 1.0, 0.0) if y_up else (0.0, 0.0, 1.0)
    aside = np.array([-1.0, 2.0, 1.0]) if y_up else np.array([-1.0, -1.0, 2.0])
    position = centre + 4.0 * radius * aside / np.linalg.norm(aside)
    power = 2.0 * (4.0 * radius) ** 2
    lamp = PointLight((float(position[0]), float(position[1]), float(position[2])), (power, 0.95 * power, 0.85 * power))
    return replace(scene, points=(lamp,), environment=Environment(up=up))
