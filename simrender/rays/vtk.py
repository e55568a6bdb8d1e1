"""VTK files through pyvista, without VTK's own words on the terminal."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

from simrender.errors import SceneError


def read_vtk(path: Path) -> Any:
    """Return what pyvista reads from a file.

    Raises
    ------
    SceneError
        If pyvista is not installed, or the file is damaged or of another kind.

    """
    try:
        import pyvista
        from vtkmodules.vtkCommonCore import vtkLogger
    except ImportError:
        raise SceneError("VTK files are read through pyvista: pip install 'simrender-cluster[vtk]'") from None
    before = vtkLogger.GetCurrentVerbosityCutoff()
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_OFF)
    try:
        with pyvista.VtkErrorCatcher() as caught, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = pyvista.read(path)
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise SceneError(f"cannot read this VTK file, which is damaged or of another kind: {reason}") from None
    finally:
        vtkLogger.SetStderrVerbosity(before)
    if caught.events:
        reason = " ".join(str(caught.events[0].alert).split())
        raise SceneError(f"cannot read this VTK file, which is damaged or cut short: {reason}")
    return found
