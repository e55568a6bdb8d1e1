"""Files that hold a scene: meshes, SpRay's scene files, structured and unstructured volumes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays import meshes
from simrender.rays.scene import Environment, Scene

VOLUMES = (".npy", ".nrrd", ".nhdr", ".raw", ".vti", ".vtr")
ELEMENTS = (".vtu",)
FORMATS = (*meshes.FORMATS, ".spray", *VOLUMES, *ELEMENTS, ".vtk")
"""Endings of the files that are read."""

WHITE = Environment((1.0, 1.0, 1.0), (1.0, 1.0, 1.0), (1.0, 1.0, 1.0))


@dataclass(frozen=True, eq=False)
class SceneFile:
    """A scene, and what a file says of its domains.

    Attributes
    ----------
    scene : Scene
    low, high : float32 array (d, 3), optional
        Box of each domain, where the file announces them.

    """

    scene: Scene
    low: NDArray[np.float32] | None = None
    high: NDArray[np.float32] | None = None


def read_file(path: Path) -> SceneFile:
    """Read a file of one of the `FORMATS`.

    Raises
    ------
    SceneError
        If it is missing, unreadable or of another format; the message names the file.

    """
    ending = path.suffix.lower()
    if ending == ".spray":
        from simrender.rays.spray import read_spray

        spray = read_spray(path)
        return SceneFile(spray.scene, spray.low, spray.high)
    if ending in meshes.FORMATS:
        return SceneFile(meshes.read_scene(path))
    if ending in VOLUMES or (ending == ".vtk" and not _holds_elements(path)):
        from simrender.rays.grids import read_volume

        return SceneFile(_alone(volume=read_volume(path)))
    if ending in ELEMENTS or ending == ".vtk":
        from simrender.rays.elements import read_elements

        return SceneFile(_alone(elements=read_elements(path)))
    raise SceneError(f"{path}: unknown scene format {path.suffix!r} (known: {', '.join(FORMATS)})")


def _alone(**volume: object) -> Scene:
    """Return a scene that holds a volume and nothing else, before a white background."""
    none = np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32)
    return Scene((), *none, environment=WHITE, **volume)  # type: ignore[arg-type]


def _holds_elements(path: Path) -> bool:
    """Tell an unstructured legacy VTK file by its header."""
    try:
        with path.open("rb") as file:
            return b"UNSTRUCTURED_GRID" in file.read(4096).upper()
    except OSError:
        return False
