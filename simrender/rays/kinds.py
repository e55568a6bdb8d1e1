"""Kinds of ray, by what spawned them; all but camera rays are incoherent."""

from __future__ import annotations

from typing import Final

CAMERA: Final = 0
DIFFUSE: Final = 1
MIRROR: Final = 2
SHADOW: Final = 3
SCATTER: Final = 4

KINDS: Final = ("camera", "diffuse", "mirror", "shadow", "scatter")
