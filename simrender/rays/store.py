"""A folder of arrays named by the content they were computed from.

Each file is a NumPy archive without pickles, written to the side and moved into place, and checked by its CRC when it
is read. A file that cannot be read is removed and computed again, with one warning.
"""

from __future__ import annotations

import hashlib
import os
import warnings
import zipfile
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from simrender.files import write

FORMAT_VERSION = 3
"""Part of every key: raise it when the meaning of a stored column changes."""


_TRANSPORT = (
    "scene", "shading", "lighting", "sampling", "volume", "marching", "tracking", "volume_paths", "elements",
    "element_marching", "compositing", "worlds", "crossings", "speculative",
    "boxes", "trace", "embree",
)  # fmt: skip
"""The modules that decide what is stored."""


@cache
def code_version() -> str:
    """Return a hash of the code that decides what is stored: light transport, random numbers, and Embree's binding."""
    digest = hashlib.blake2b(metadata.version("embreex").encode(), digest_size=8)
    for name in _TRANSPORT:
        digest.update((Path(__file__).parent / f"{name}.py").read_bytes())
    return f"{FORMAT_VERSION}-{digest.hexdigest()}"


class CacheWarning(UserWarning):
    """The trace cache is damaged or cannot be written; the run goes on without it."""


def default_folder() -> Path:
    """Return ``$SIMRENDER_CACHE``, or ``simrender`` in the user's cache folder."""
    if folder := os.environ.get("SIMRENDER_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "simrender"


class Store:
    """Arrays on disk under one key.

    Parameters
    ----------
    key : str
        Hash of everything the arrays depend on.
    folder : Path, optional
        The cache; by default `default_folder`.

    """

    def __init__(self, key: str, folder: Path | None = None) -> None:
        self.folder = (folder or default_folder()) / f"v{FORMAT_VERSION}" / key
        self._warned = False

    def load(self, name: str, columns: tuple[str, ...], rows: int | None = None) -> dict[str, Any] | None:
        """Return the arrays stored under a name, or None if there are none or they are damaged.

        Parameters
        ----------
        name : str
        columns : tuple of str
            What must be there.
        rows : int, optional
            How long each column must be.

        """
        path = self.folder / f"{name}.npz"
        try:
            # Opened here and not by np.load, which leaves a damaged file open.
            with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
                found = {column: archive[column] for column in columns}
            if rows is not None and any(len(column) != rows for column in found.values()):
                raise ValueError
            return found
        except (FileNotFoundError, NotADirectoryError):
            return None
        except (
            OSError,
            ValueError,
            EOFError,
            KeyError,
            RuntimeError,
            zipfile.BadZipFile,
            zipfile.LargeZipFile,
        ) as error:
            # NumPy's own words about a file that is no archive advise to load it unsafely.
            reason = "not the arrays that belong there" if isinstance(error, (ValueError, KeyError)) else str(error)
            reason = reason or "cut short"
            self._warn(f"the cache file {path} is damaged ({reason}); it is discarded and computed again")
            path.unlink(missing_ok=True)
            return None

    def save(self, name: str, columns: dict[str, Any]) -> None:
        """Store arrays under a name; a folder that cannot be written costs a warning, not the run."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            write(self.folder / f"{name}.npz", lambda file: np.savez(file, allow_pickle=False, **columns))
        except OSError as error:
            self._warn(f"cannot write the trace cache in {self.folder}: {error.strerror or error}; set SIMRENDER_CACHE")

    def _warn(self, message: str) -> None:
        if not self._warned:
            warnings.warn(message, CacheWarning, stacklevel=3)
        self._warned = True


class NoStore(Store):
    """A store that keeps nothing: for traces that are to stay in memory."""

    def __init__(self) -> None:
        super().__init__("nowhere")

    def load(self, name: str, columns: tuple[str, ...], rows: int | None = None) -> None:  # noqa: ARG002
        """Find nothing."""
        return

    def save(self, name: str, columns: dict[str, Any]) -> None:
        """Keep nothing."""
