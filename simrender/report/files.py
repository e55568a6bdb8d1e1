"""Writing results to files, after the folder is known to be there."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from simrender.errors import UsageError
from simrender.files import write

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from simrender.result import Result


def check_target(option: str, path: Path, endings: tuple[str, ...]) -> None:
    """Refuse a file that could not be written, before any work is done for it.

    Raises
    ------
    UsageError
        If its ending is unknown, its folder is not there, or it is a folder itself.

    """
    if path.suffix.lower() not in endings:
        raise UsageError(f"{option} {path}: expected a file that ends in {' or '.join(endings)}")
    if path.is_dir():
        raise UsageError(f"{option} {path}: this is a folder, expected a file")
    if not path.parent.is_dir():
        raise UsageError(f"{option} {path}: there is no folder {path.parent}")
    if not os.access(path.parent, os.W_OK):
        raise UsageError(f"{option} {path}: the folder {path.parent} cannot be written")


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON."""
    write(path, lambda file: _put(file, json.dumps(value, indent=1) + "\n"))


def write_image(path: Path, image: NDArray[np.float32]) -> None:
    """Write linear radiance as an 8-bit sRGB picture.

    Parameters
    ----------
    path : Path
    image : float32 array (height, width, 3)

    """
    from PIL import Image

    linear = np.clip(image.astype(np.float64), 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    picture = Image.fromarray((curved * 255.0 + 0.5).astype(np.uint8))
    write(path, lambda file: picture.save(file, format="PNG"))


def write_timeline(path: Path, result: Result) -> None:
    """Write the timeline: ``.json`` as a Chrome trace for Perfetto, ``.png`` as a plot."""
    if path.suffix.lower() == ".json":
        from simrender.report.chrome import chrome_trace

        write(path, lambda file: _put(file, json.dumps(chrome_trace(result), separators=(",", ":"))))
    else:
        from simrender.report.plots import plot_timeline

        write_figure(path, plot_timeline(result))


def write_figure(path: Path, figure: Figure) -> None:
    """Write a matplotlib figure, in the format that the file's ending says; the same figure gives the same file."""
    import matplotlib as mpl

    kind = path.suffix.lower().removeprefix(".")
    metadata = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}.get(kind)
    with mpl.rc_context({"svg.hashsalt": "simrender"}):
        write(path, lambda file: figure.savefig(file, format=kind, dpi=150, metadata=metadata))


def _put(file: BinaryIO, text: str) -> None:
    file.write(text.encode())
