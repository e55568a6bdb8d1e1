"""Wings, fin and tailplane: skins, slats and flaps over spars, ribs, stringers, fasteners and fuel pipes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from simrender.rays.scene import IDENTITY
from workloads.boeing.shapes import INDEX, Detail
from workloads.cad import X, axes, cushion, finer, lathe, part, parts, ring, sheet, shifted, slab, sweeps
from workloads.terrain import F64, Placed, generator

FRONT, REAR = 0.13, 0.64  # the spars, in chords


@dataclass(frozen=True)
class Plan:
    """The outline of a wing at its stations, from root to tip.

    Attributes
    ----------
    name : str
    leading : tuple of (x, y, z)
        The leading edge.
    chord, thickness : tuple of float
        In metres; thickness in chords.
    normal : (x, y, z)
        What the upper side faces.
    ribs, panels, slats : int
        At the default detail; panels and slats are always as many.

    """

    name: str
    leading: tuple[tuple[float, float, float], ...]
    chord: tuple[float, ...]
    thickness: tuple[float, ...]
    normal: tuple[float, float, float]
    ribs: int
    panels: int
    slats: int
    paint: str

    def point(self, span: F64, at: F64, side: F64 | float, inset: float = 0.0) -> F64:
        """Return points of the surface (..., 3).

        Parameters
        ----------
        span, at : float64 arrays
            From root to tip and from leading to trailing edge, 0 to 1.
        side : float64 array or float
            1 on the upper side, -1 on the lower, 0 in the middle.
        inset : float
            Depth below the surface in metres.

        """
        span, at, side = np.broadcast_arrays(span, at, side)
        knots = np.linspace(0.0, 1.0, len(self.chord))
        chord = np.interp(span, knots, self.chord)
        lead = np.stack([np.interp(span, knots, column) for column in np.array(self.leading).T], axis=-1)
        # The thickness of the NACA four-digit series, and a little camber.
        thick = 0.2969 * np.sqrt(at) - 0.1260 * at - 0.3516 * at**2 + 0.2843 * at**3 - 0.1036 * at**4
        half = 5.0 * np.interp(span, knots, self.thickness) * thick * chord
        half = np.maximum(half - inset, 0.0)
        rise = 0.06 * at * (1.0 - at) * chord
        return np.asarray(lead + (at * chord)[..., None] * X + (side * half + rise)[..., None] * np.array(self.normal))


def _wing(sign: float) -> Plan:
    leading = ((25.0, 2.2, -1.75), (31.2, 10.2, -0.95), (38.1, 20.3, 0.15), (45.0, 30.4, 1.7))
    side = tuple((x, sign * y, z) for x, y, z in leading)
    name = "starboard wing" if sign > 0 else "port wing"
    return Plan(name, side, (14.6, 9.0, 5.4, 2.0), (0.13, 0.115, 0.10, 0.09), (0.0, 0.0, 1.0), 40, 14, 7, "wing grey")


def _tailplane(sign: float) -> Plan:
    leading = ((64.2, 0.5, 1.35), (70.6, 10.8, 2.25))
    side = tuple((x, sign * y, z) for x, y, z in leading)
    name = "starboard tailplane" if sign > 0 else "port tailplane"
    return Plan(name, side, (6.9, 2.4), (0.10, 0.09), (0.0, 0.0, 1.0), 18, 5, 3, "wing grey")


FIN = Plan("fin", ((59.6, 0.0, 2.55), (69.2, 0.0, 12.6)), (9.2, 3.4), (0.11, 0.09), (0.0, 1.0, 0.0), 20, 5, 3,
           "blue paint")  # fmt: skip
PLANS = (_wing(1.0), _wing(-1.0), _tailplane(1.0), _tailplane(-1.0), FIN)


def wings(seed: int, detail: Detail) -> list[Placed]:
    """Return both wings, both tailplanes and the fin."""
    placed = []
    for plan in PLANS:
        placed += _covers(plan, detail) + _inner(seed, plan, detail)
    for sign in (1.0, -1.0):
        for i, span in enumerate((0.22, 0.47, 0.62, 0.76)):
            x, y, z = PLANS[0 if sign > 0 else 1].point(np.array(span), np.array(0.86), -1.0)
            size = 1.0 - 0.5 * span
            pod = cushion((2.3 * size, 0.26 * size, 0.38 * size), detail.count(900, 60), 0.9)
            solid = shifted(pod, (x, y, z - 0.15))
            placed.append((part(f"flap track fairing {i} {sign:+.0f}", (INDEX["wing grey"], solid), smooth=True),
                           IDENTITY[None]))  # fmt: skip
    return placed


def _covers(plan: Plan, detail: Detail) -> list[Placed]:
    """Return skin panels of the box, slats at its front, and flaps, ailerons or rudders behind it."""
    made = []
    cuts = np.linspace(0.0, 1.0, plan.panels + 1)
    bands = np.linspace(FRONT, REAR, 4)
    fine = detail.across(8, 2)
    for i, (low, high) in enumerate(pairwise(cuts)):
        span = np.linspace(low, high, fine + 1)[:, None]
        for j, (first, last) in enumerate(pairwise(bands)):
            at = np.linspace(first, last, fine + 1)[None]
            for name, side in (("upper", 1.0), ("lower", -1.0)):
                solid = slab(plan.point(span, at, side), plan.point(span, at, side, 0.008))
                made.append(part(f"{plan.name} {name} skin {i} {j}", (INDEX[plan.paint], solid), smooth=True))
    edges = np.linspace(0.0, 0.995, plan.slats + 1)
    around = np.linspace(-1.0, 1.0, 2 * detail.across(10, 3) + 1)
    for i, (low, high) in enumerate(pairwise(edges)):
        span = np.linspace(low + 0.0004, high - 0.0004, fine + 1)[:, None]
        nose = plan.point(span, FRONT * around[None] ** 2, np.sign(around)[None])
        lip = "bare aluminium" if plan.name != "fin" else plan.paint
        made.append(part(f"{plan.name} slat {i}", (INDEX[lip], sheet(nose)), smooth=True))
        tail = plan.point(span, 1.0 - (1.0 - REAR - 0.005) * np.abs(around)[None], np.sign(around)[None])
        made.append(part(f"{plan.name} flap {i}", (INDEX[plan.paint], sheet(tail)), smooth=True))
    tip = plan.point(np.array([[1.0]]), np.linspace(0.0, 1.0, 2 * fine + 1)[None], np.array([-1.0, 0.0, 1.0])[:, None])
    made.append(part(f"{plan.name} tip", (INDEX[plan.paint], sheet(tip))))
    return [(thing, IDENTITY[None]) for thing in made]


def _inner(seed: int, plan: Plan, detail: Detail) -> list[Placed]:
    """Return what the skins hide: ribs with lightening holes, spars, stringers, pipes and fasteners."""
    made = []
    ribs = max(4, min(plan.ribs, round(plan.ribs * detail.factor**0.5)))
    spans = np.linspace(0.015, 0.985, ribs)
    at = finer(np.linspace(FRONT, REAR, 9), detail.across(1))
    height = finer([-0.93, -0.45, 0.45, 0.93], detail.across(2))
    holes = (np.abs(0.5 * (height[:-1] + height[1:])) < 0.45)[:, None] & (
        (np.arange(len(at) - 1) // detail.across(1)) % 2 == 1
    )
    for i, span in enumerate(spans):
        front = plan.point(np.array(span), at[None], height[:, None], 0.03)
        back = plan.point(np.array(span + 0.0006), at[None], height[:, None], 0.03)
        made.append(part(f"{plan.name} rib {i}", (INDEX["primer"], slab(front, back, holes))))
    cuts = np.linspace(0.0, 1.0, plan.panels + 1)
    for i, (low, high) in enumerate(pairwise(cuts)):
        span = np.linspace(low, high, detail.along(7, 2))
        for name, spar in (("front", FRONT + 0.004), ("rear", REAR - 0.004)):
            web = plan.point(span[:, None], np.array(spar), np.linspace(-0.95, 0.95, detail.across(5, 2))[None], 0.01)
            made.append(part(f"{plan.name} {name} spar {i}", (INDEX["dark primer"], sheet(web))))
        lanes = np.linspace(FRONT + 0.04, REAR - 0.04, 11)[:, None]
        for name, side in (("upper", 1.0), ("lower", -1.0)):
            paths = plan.point(span[None], lanes, side, 0.012)
            up = side * np.array(plan.normal)
            tee = [[-0.03, 0.0], [0.03, 0.0], [0.004, -0.006], [0.004, -0.06], [-0.004, -0.06], [-0.004, -0.006]]
            made += parts(f"{plan.name} {name} stringer {i}", sweeps(paths, tee, up), INDEX["dark primer"])
        lanes = np.linspace(FRONT + 0.06, REAR - 0.06, detail.count(5, 1))[:, None]
        paths = plan.point(span[None], lanes, -0.3)
        series = sweeps(paths, ring(0.03, 8), np.array(plan.normal))
        made += parts(f"{plan.name} pipe {i}", series, INDEX["fuel pipe"])
    rng = generator(seed, plan.name)
    n = detail.count(ribs * 45)
    where, chord = rng.choice(spans, n) + 0.001, rng.uniform(FRONT, REAR, n)
    sides = rng.choice([-1.0, 1.0], n)
    out = sides[:, None] * np.array(plan.normal)
    head = [[0.011, 0.0], [0.009, 0.008], [0.0, 0.010]]
    bolt = part(f"{plan.name} bolt", (INDEX["steel"], lathe(head, detail.along(6, 4))))
    turned = axes(plan.point(where, chord, sides, 0.012), X, np.cross(-out, X), -out)
    return [*((thing, IDENTITY[None]) for thing in made), (bolt, turned)]
