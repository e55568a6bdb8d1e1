"""Mesh files (PLY, OBJ, GLB, STL) to scenes, through trimesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from simrender.errors import SceneError
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject

FORMATS = (".ply", ".obj", ".glb", ".gltf", ".stl")
"""Endings of the files that are read."""

_PARTS = 64
"""A scanned mesh has no objects to deal to GPUs, so it is cut into this many meshes, in the order of its faces."""

_Y_UP = (".obj", ".glb", ".gltf")


def read_scene(path: Path) -> Scene:
    """Read a mesh file as a scene under a plain sky and one lamp.

    Parameters
    ----------
    path : Path
        A file of one of the `FORMATS`. A file with a scene graph keeps its instances; single meshes are cut into parts
        that a partition can deal out.

    Raises
    ------
    SceneError
        If the file is missing, unreadable, or holds a mesh that cannot be rendered; the message names the file.

    """
    if path.suffix.lower() not in FORMATS:
        raise SceneError(f"{path}: unknown mesh format {path.suffix!r} (known: {', '.join(FORMATS)})")
    if not path.is_file():
        raise SceneError(f"{path}: {'this is a folder, expected a file' if path.is_dir() else 'there is no such file'}")
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: the file is empty")
    import trimesh

    try:
        with np.errstate(over="ignore"):  # a vertex too far for float32 is refused as infinite
            loaded: Any = trimesh.load(path, process=False)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"{path}: cannot read this mesh, which is damaged or cut short: {reason}") from None
    try:
        with np.errstate(over="ignore"):
            return _from_graph(loaded) if isinstance(loaded, trimesh.Scene) else _from_mesh(loaded, path)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


def _from_mesh(loaded: Any, path: Path) -> Scene:
    _check_length(getattr(loaded, "metadata", {}).get("_ply_raw", {}))
    faces = getattr(loaded, "faces", None)
    if faces is None or len(faces) == 0:
        raise SceneError("the mesh is empty: it has no triangles")
    mesh = Mesh(np.asarray(loaded.vertices), np.asarray(faces))
    thing = SceneObject(path.stem, _cut(mesh, _PARTS))
    return _lit((thing,), np.zeros(1, np.int32), IDENTITY[None], (_material(loaded),), path.suffix.lower() in _Y_UP)


def _check_length(elements: Any) -> None:
    """Refuse a PLY file that holds less than its header announces: trimesh reads the rest of a text file in silence."""
    for what, element in elements.items():
        data, announced = element.get("data"), element.get("length", 0)
        columns = data.values() if isinstance(data, dict) else [] if data is None else [data]
        found = min((len(column) for column in columns), default=0)
        if found < announced:
            raise SceneError(f"the file is cut short: it announces {announced} of element {what} and has {found}")


def _from_graph(graph: Any) -> Scene:
    if not graph.geometry:
        raise SceneError("nothing could be read: it is empty, cut short, or in another format than its ending says")
    objects: list[SceneObject] = []
    materials: list[Material] = []
    index: dict[str, int] = {}
    total = max(1, sum(len(getattr(geometry, "faces", ())) for geometry in graph.geometry.values()))
    for name, geometry in graph.geometry.items():
        if getattr(geometry, "faces", None) is None or len(geometry.faces) == 0:
            continue  # points and lines reflect nothing
        index[name] = len(objects)
        mesh = Mesh(np.asarray(geometry.vertices), np.asarray(geometry.faces), len(materials))
        objects.append(SceneObject(str(name), _cut(mesh, -(-len(mesh.faces) * _PARTS // total))))
        materials.append(_material(geometry))
    owner, transforms = [], []
    for node in graph.graph.nodes_geometry:
        transform, name = graph.graph[node]
        if name in index:
            owner.append(index[name])
            transforms.append(np.asarray(transform, dtype=np.float32)[:3])
    if not owner:
        raise SceneError("the scene is empty: it has no triangles")
    return _lit(tuple(objects), np.array(owner, np.int32), np.array(transforms), tuple(materials), True)


def _cut(mesh: Mesh, parts: int) -> tuple[Mesh, ...]:
    """Cut a mesh into so many parts of about equally many consecutive faces."""
    pieces = np.array_split(mesh.faces, parts)
    return tuple(Mesh(*_compact(mesh, piece), mesh.material) for piece in pieces if len(piece))


def _compact(mesh: Mesh, faces: Any) -> tuple[Any, Any]:
    used, renumbered = np.unique(faces, return_inverse=True)
    return mesh.vertices[used], renumbered.reshape(-1, 3)


def _material(geometry: Any) -> Material:
    color = getattr(getattr(geometry.visual, "material", None), "main_color", None)
    if color is None:
        return Material((0.72, 0.68, 0.62))
    red, green, blue = (float(c) / 255.0 for c in color[:3])
    return Material((red**2.2, green**2.2, blue**2.2))


def _lit(objects: Any, owner: Any, transforms: Any, materials: Any, y_up: bool) -> Scene:
    """Add a sky, and a lamp above and beside the scene that gives its centre an irradiance of about 2."""
    scene = Scene(objects, owner, transforms, materials)
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    if (low == high).all():
        raise SceneError(f"the mesh has no extent: all its vertices lie at {low.tolist()}")
    centre, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 1e-30)
    up = (0.0, 1.0, 0.0) if y_up else (0.0, 0.0, 1.0)
    aside = np.array([-1.0, 2.0, 1.0]) if y_up else np.array([-1.0, -1.0, 2.0])
    position = centre + 4.0 * radius * aside / np.linalg.norm(aside)
    power = 2.0 * (4.0 * radius) ** 2
    lamp = PointLight((float(position[0]), float(position[1]), float(position[2])), (power, 0.95 * power, 0.85 * power))
    return Scene(objects, owner, transforms, materials, (lamp,), Environment(up=up))
