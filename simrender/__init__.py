"""simrender: a discrete-event performance simulator of cluster and multi-GPU rendering, driven by really traced rays.

``simulate("dgx2", "island")`` answers how fast a scene would render on a machine, and what holds it back.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from simrender.hardware.machine import load_machine
    from simrender.rays.workload import load_workload
    from simrender.result import Result
    from simrender.simulation import simulate

__all__ = ["Result", "load_machine", "load_workload", "simulate"]

_HOMES = {
    "Result": "simrender.result",
    "load_machine": "simrender.hardware.machine",
    "load_workload": "simrender.rays.workload",
    "simulate": "simrender.simulation",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used: ``import simrender`` alone must cost nothing."""
    if name not in _HOMES:
        raise AttributeError(f"module 'simrender' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(_HOMES[name]), name)
