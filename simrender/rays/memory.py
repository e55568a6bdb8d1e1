"""How much memory there is, asked before something large is made."""

from __future__ import annotations

import os
import re
from pathlib import Path

from simrender.errors import SceneError
from simrender.units import format_bytes


def check_memory(need_bytes: float, what: str, hint: str = "") -> None:
    """Refuse to make something that does not fit into the memory that is available now.

    Parameters
    ----------
    need_bytes : float
    what : str
        Begins the message: ``"a volume of 4096x4096x4096 voxels"``.
    hint : str, optional
        Ends it: what would need less.

    Raises
    ------
    SceneError
        If there is less memory than that.

    """
    have = available_bytes()
    if need_bytes > have:
        raise SceneError(
            f"{what} needs {format_bytes(need_bytes)} of memory, and {format_bytes(have)} are available here{hint}"
        )


def available_bytes() -> float:
    """Return the memory that can be had without swapping, as far as this system tells."""
    have = float("inf")
    if "SC_PHYS_PAGES" in getattr(os, "sysconf_names", {}):
        have = float(os.sysconf("SC_PHYS_PAGES")) * os.sysconf("SC_PAGE_SIZE")
    # Pages that only cache files count as available: the kernel's own estimate knows of them, sysconf does not.
    for file, pattern, unit in (
        ("/proc/meminfo", r"MemAvailable:\s+(\d+) kB", 1024.0),
        ("/sys/fs/cgroup/memory.max", r"(\d+)", 1.0),
    ):
        try:
            found = re.search(pattern, Path(file).read_text(encoding="ascii"))
        except OSError:
            continue
        if found:
            have = min(have, float(found[1]) * unit)
    return have
