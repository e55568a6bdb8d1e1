"""What every part of the airliner is made with: its materials, the shape of its hull, and the level of detail."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from simrender.rays.scene import Material
from workloads.terrain import F64

RADIUS = 3.1
LENGTH = 73.9
NOSE, TAIL = 9.0, 47.0  # the hull is a cylinder between these stations
FLOOR = -0.72
CABIN = (7.6, 51.0)  # between these stations it has its full width
PITCH = 0.5334  # between frames: 21 inches

PALETTE = {
    "white paint": Material((0.80, 0.81, 0.82), mirror=0.05),
    "blue paint": Material((0.035, 0.10, 0.30), mirror=0.07),
    "grey paint": Material((0.50, 0.53, 0.56), mirror=0.05),
    "wing grey": Material((0.60, 0.62, 0.63), mirror=0.06),
    "bare aluminium": Material((0.74, 0.75, 0.76), mirror=0.35),
    "polished lip": Material((0.88, 0.88, 0.89), mirror=0.8),
    "primer": Material((0.46, 0.55, 0.20)),
    "dark primer": Material((0.30, 0.40, 0.17)),
    "titanium": Material((0.52, 0.49, 0.46), mirror=0.3),
    "steel": Material((0.55, 0.56, 0.58), mirror=0.4),
    "hot steel": Material((0.42, 0.34, 0.28), mirror=0.25),
    "fan blade": Material((0.20, 0.21, 0.23), mirror=0.25),
    "window": Material((0.10, 0.12, 0.14), mirror=0.5),
    "lining": Material((0.80, 0.78, 0.74)),
    "seat blue": Material((0.09, 0.16, 0.36)),
    "seat grey": Material((0.32, 0.33, 0.35)),
    "carpet": Material((0.16, 0.18, 0.24)),
    "composite": Material((0.23, 0.24, 0.25)),
    "duct": Material((0.72, 0.70, 0.62)),
    "orange wire": Material((0.78, 0.34, 0.06)),
    "white wire": Material((0.72, 0.71, 0.66)),
    "hydraulic": Material((0.42, 0.20, 0.36)),
    "fuel pipe": Material((0.66, 0.16, 0.10)),
    "rubber": Material((0.035, 0.035, 0.038)),
    "container": Material((0.62, 0.64, 0.66), mirror=0.15),
    "red beacon": Material((0.60, 0.03, 0.03)),
    "cabin light": Material((0.9, 0.88, 0.8), emission=(16.0, 15.0, 13.0)),
}
INDEX = {name: index for index, name in enumerate(PALETTE)}


@dataclass(frozen=True)
class Detail:
    """How many parts there are, and how finely each is tessellated, relative to the default."""

    factor: float

    def count(self, usual: float, least: int = 1) -> int:
        """Return how many of a small part there are."""
        return max(least, round(usual * self.factor))

    def along(self, usual: float, least: int = 1) -> int:
        """Return the pieces along a part that is tessellated in one direction."""
        return max(least, round(usual * self.factor))

    def across(self, usual: float, least: int = 1) -> int:
        """Return the pieces along one side of a part that is tessellated in two directions."""
        return max(least, round(usual * float(np.sqrt(self.factor))))


def radius(x: F64) -> F64:
    """Return the radius of the hull at a station: an ogive, a cylinder and a tapering tail."""
    ahead = np.clip((NOSE - x) / NOSE, 0.0, 1.0)
    behind = np.clip((x - TAIL) / (LENGTH - TAIL), 0.0, 1.0)
    nose = np.sqrt(np.maximum(1.0 - ahead**2.1, 0.0)) ** 1.15
    return np.asarray(RADIUS * nose * (1.0 - 0.93 * behind**1.7), np.float64)


def centre(x: F64) -> F64:
    """Return the height of the hull's axis: the nose droops, and the tail sweeps up."""
    ahead = np.clip((NOSE - x) / NOSE, 0.0, 1.0)
    return np.asarray(-0.85 * ahead**2 + 0.72 * (RADIUS - radius(x)) * (x > TAIL), np.float64)


def hull(x: F64, angle: F64, inset: float = 0.0) -> F64:
    """Return points of the hull (..., 3), or ``inset`` metres inside it.

    Parameters
    ----------
    x : float64 array
        Station in metres from the nose.
    angle : float64 array
        Degrees from the crown, positive to port, which is negative y.
    inset : float

    """
    x, angle = np.broadcast_arrays(x, np.radians(angle))
    r = np.maximum(radius(x) - inset, 0.004)
    return np.stack([x, -r * np.sin(angle), centre(x) + r * np.cos(angle)], axis=-1)


def outward(angle: F64) -> F64:
    """Return the direction away from the hull's axis at angles (n,), float64 (n, 3)."""
    a = np.radians(angle)
    return np.stack([np.zeros_like(a), -np.sin(a), np.cos(a)], axis=-1)


def stations(detail: Detail) -> F64:
    """Return where the frames stand; there are more of them only at a detail below that of the aircraft itself."""
    return np.linspace(1.6, 72.6, max(12, min(133, round(133 * detail.factor**0.5))) + 1)
