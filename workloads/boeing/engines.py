"""Engines with their fans, compressors, turbines and plumbing, the pylons that hold them, and the landing gear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from simrender.rays.scene import IDENTITY, SceneObject
from workloads.boeing.shapes import INDEX, Detail
from workloads.cad import (
    Solid,
    Y,
    Z,
    about_x,
    axes,
    bar,
    boxes,
    curve,
    cushion,
    joined,
    lathe,
    moved,
    part,
    parts,
    points,
    ring,
    sheet,
    shifted,
    sweeps,
    upright,
    whole,
)
from workloads.terrain import F64, Placed, generator

PLACES = np.array([[24.9, -9.75, -3.15], [24.9, 9.75, -3.15]])  # of the inlets
AFT = axes(np.zeros((1, 3)), Y, Z, np.eye(3)[0])  # turns a profile about the x axis
FAN = 1.62  # radius


def engines(seed: int, detail: Detail) -> list[Placed]:
    """Return both engines, part by part, and their pylons."""
    both = upright(PLACES)
    placed = [(thing, both) for thing in (*_casings(detail), *_plumbing(seed, detail))]
    for thing, turns in _stages(detail):
        every = np.concatenate([about_x(place, turns) for place in PLACES])
        placed.append((thing, every))
    for name, place in zip(("port", "starboard"), PLACES, strict=True):
        x = np.linspace(1.8, 9.0, detail.across(16, 4))
        low, high = np.interp(x, [1.8, 4.0, 9.0], [1.72, 1.45, 1.75]), np.interp(x, [1.8, 5.5, 9.0], [1.9, 2.35, 2.0])
        width = 0.22 * np.sqrt(np.clip((x - 1.75) / 2.0, 0.0, 1.0)) * np.clip((9.2 - x) / 3.0, 0.0, 1.0)
        sides = np.array([[-1.0], [-1.0], [0.0], [1.0], [1.0]])
        solid = sheet(points(x, sides * width, np.stack([low, high - 0.1, high, high - 0.1, low])) + place)
        placed.append((part(f"pylon {name}", (INDEX["white paint"], solid)), IDENTITY[None]))
    return placed


def turned(profile: Sequence[Sequence[float]], sides: int, pieces: int) -> Solid:
    """Turn a smooth profile of (station, radius) about the x axis."""
    smooth = curve(profile, pieces)
    return moved(lathe(smooth[:, ::-1], sides), AFT)


def _casings(detail: Detail) -> list[SceneObject]:
    sides, pieces = detail.across(72, 10), detail.across(5, 1)
    shapes = {
        "inlet lip": ("polished lip", [[0.55, 1.66], [0.2, 1.64], [0.0, 1.74], [0.2, 1.86], [0.6, 1.93]]),
        "fan cowl": ("white paint", [[0.6, 1.935], [1.6, 2.0], [2.8, 1.99], [3.6, 1.93]]),
        "reverser cowl": ("white paint", [[3.61, 1.93], [4.4, 1.83], [5.3, 1.66], [5.32, 1.63], [4.4, 1.74]]),
        "inlet duct": ("composite", [[0.55, 1.66], [1.0, FAN + 0.02], [1.9, FAN + 0.02], [2.6, 1.66], [3.6, 1.70]]),
        "core cowl": ("titanium", [[3.3, 0.95], [4.2, 1.16], [5.6, 1.02], [6.9, 0.72], [6.9, 0.70], [5.6, 0.98]]),
        "plug": ("hot steel", [[6.0, 0.50], [6.8, 0.46], [7.6, 0.25], [8.1, 0.0]]),
        "spinner": ("composite", [[0.75, 0.0], [0.85, 0.14], [1.2, 0.40], [1.55, 0.52]]),
        "drum": ("steel", [[1.55, 0.52], [2.2, 0.62], [3.2, 0.44], [4.6, 0.36], [6.2, 0.40]]),
        "compressor case": ("steel", [[2.3, 0.98], [3.0, 0.80], [4.0, 0.62], [4.6, 0.66]]),
        "combustor case": ("hot steel", [[4.6, 0.66], [4.8, 0.78], [5.1, 0.78], [5.3, 0.66]]),
        "turbine case": ("hot steel", [[5.3, 0.66], [5.8, 0.74], [6.3, 0.82]]),
    }  # fmt: skip
    return [
        part(f"engine {name}", (INDEX[m], turned(p, sides, pieces)), smooth=True) for name, (m, p) in shapes.items()
    ]


def _blade(root: float, tip: float, chord: float, twist: tuple[float, float], rows: int) -> Solid:
    """Return a cambered blade that stands on the x axis, along z."""
    r = np.linspace(0.0, 1.0, rows)
    angle = np.radians(np.interp(r, [0.0, 1.0], twist))[:, None]
    a = np.array([-0.5, -0.2, 0.15, 0.5, 0.15, -0.2]) * chord
    b = np.array([0.0, 0.09, 0.08, 0.0, 0.03, 0.02]) * chord
    x, y = a * np.cos(angle) - b * np.sin(angle), a * np.sin(angle) + b * np.cos(angle)
    z = np.broadcast_to((root + (tip - root) * r)[:, None], x.shape)
    wide = np.stack([x, y, z], axis=2)
    return sheet(np.concatenate([wide, wide[:, :1]], axis=1))


def _stages(detail: Detail) -> list[tuple[SceneObject, F64]]:
    """Return the blade of every rotor and stator, and the angles of its copies."""
    stages = [("fan", 1.4, 0.5, FAN, 0.52, (25.0, 62.0), 22, "fan blade", 16),
              ("outlet vane", 2.75, 0.95, 1.68, 0.3, (12.0, 5.0), 54, "composite", 5)]  # fmt: skip
    for i in range(13):
        t = i / 12.0
        kind, turn = ("rotor", (40.0, 55.0)) if i % 2 == 0 else ("stator", (-35.0, -40.0))
        shape = (0.60 - 0.20 * t, 0.93 - 0.33 * t, 0.11 - 0.05 * t, turn)
        stages.append((f"compressor {kind} {i}", 2.4 + 2.1 * t, *shape, 44 + 3 * i, "titanium", 3))
    for i in range(8):
        t = i / 7.0
        shape = (0.42, 0.66 + 0.13 * t, 0.09, (-30.0, -55.0))
        stages.append((f"turbine {i}", 5.3 + 0.9 * t, *shape, 70 + 4 * i, "hot steel", 3))
    made = []
    for name, station, root, tip, chord, twist, count, material, rows in stages:
        vertices, faces = _blade(root, tip, chord, twist, detail.along(rows, 2))
        blade = part(f"engine {name}", (INDEX[material], shifted((vertices, faces), (station, 0.0, 0.0))), smooth=True)
        made.append((blade, 2.0 * np.pi * np.arange(count) / count))
    return made


def _plumbing(seed: int, detail: Detail) -> list[SceneObject]:
    """Return pipes around the core, each a part, with gearbox and pumps below."""
    rng = generator(seed, "engine plumbing")
    n = detail.count(90, 6)
    t = np.linspace(0.0, 1.0, detail.along(18, 4))
    begin, end = rng.uniform(2.5, 4.4, (n, 1)), rng.uniform(4.9, 6.0, (n, 1))
    angle = rng.uniform(0.0, 6.3, (n, 1)) + rng.uniform(-1.3, 1.3, (n, 1)) * (3.0 * t**2 - 2.0 * t**3)
    x = begin + (end - begin) * t
    shell = np.interp(x, [2.3, 3.0, 4.0, 4.6, 4.8, 5.1, 5.3, 6.3], [0.98, 0.80, 0.64, 0.68, 0.79, 0.79, 0.70, 0.84])
    r = shell + rng.uniform(0.03, 0.13, (n, 1))
    paths = np.stack([x, r * np.sin(angle), r * np.cos(angle)], axis=2)
    up = paths * np.array([0.0, 1.0, 1.0])
    size = np.broadcast_to(rng.choice([0.008, 0.012, 0.018, 0.028], (n, 1)), r.shape)
    made = parts("engine pipe", sweeps(paths, ring(1.0, 8), up, size), INDEX["steel"], smooth=True)
    for i in range(detail.count(14, 4)):
        radii = rng.uniform(0.06, 0.2, 3)
        a, at = rng.normal(np.pi, 0.5), rng.uniform(2.9, 4.4)
        box = shifted(cushion(radii.tolist(), detail.count(90, 40)), (at, 0.92 * np.sin(a), 0.92 * np.cos(a)))
        made.append(part(f"engine accessory {i}", (INDEX["bare aluminium"], box), smooth=True))
    return made


def gear(detail: Detail) -> list[Placed]:
    """Return the landing gear: struts, braces, axles, and wheels as instances."""
    sides = detail.across(32, 8)
    tyre = turned(
        [[-0.22, 0.36], [-0.24, 0.5], [-0.16, 0.64], [0.0, 0.67], [0.16, 0.64], [0.24, 0.5], [0.22, 0.36]], sides, 3
    )
    hub = turned(
        [[-0.15, 0.0], [-0.16, 0.15], [-0.1, 0.3], [-0.2, 0.36], [0.2, 0.36], [0.1, 0.3], [0.15, 0.0]], sides, 2
    )
    # The wheel's axis is x in the profile, and y on the aircraft.
    wheel = part("wheel", (INDEX["rubber"], tyre), (INDEX["bare aluminium"], hub), smooth=True)
    at = [[7.0, y, -5.35] for y in (-0.35, 0.35)]
    axles = [[[7.0, -0.4, -5.35], [7.0, 0.4, -5.35]]]
    struts = [[[7.0, 0.0, -2.4], [7.0, 0.0, -5.35]], [[5.6, 0.0, -2.5], [7.0, 0.0, -4.0]]]
    for y in (-5.5, 5.5):
        for x in (35.4, 36.85, 38.3):
            at += [[x, y - 0.55, -5.25], [x, y + 0.55, -5.25]]
            axles.append([[x, y - 0.6, -5.25], [x, y + 0.6, -5.25]])
        axles.append([[35.3, y, -5.2], [38.4, y, -5.2]])
        struts += [[[36.6, 0.8 * y, -1.6], [36.85, y, -5.2]], [[34.8, 0.5 * y, -2.6], [36.8, y, -4.1]],
                   [[36.8, 0.3 * y, -2.9], [36.8, y, -3.9]]]  # fmt: skip
    placed: list[Placed] = [(wheel, axes(np.array(at), Y, -np.eye(3)[0], Z))]
    for name, paths, size in (("axle", axles, 0.1), ("strut", struts, 0.17)):
        up = np.array([1.0, 0.0, 0.3]) if name == "strut" else Z
        series = sweeps(np.array(paths), ring(size, detail.across(16, 6)), up)
        placed += [(thing, IDENTITY[None]) for thing in parts(name, series, INDEX["steel"], smooth=True)]
    doors = boxes([[5.4, -0.75, -3.9], [5.4, 0.72, -3.9], [35.0, -4.3, -4.6], [35.0, 4.25, -4.6]],
                  [[7.4, -0.72, -2.6], [7.4, 0.75, -2.6], [38.6, -4.25, -2.4], [38.6, 4.3, -2.4]])  # fmt: skip
    placed += [(thing, IDENTITY[None]) for thing in parts("gear door", doors, INDEX["grey paint"])]
    links = np.array([[[6.6, y, -3.3], [7.0, 0.0, -3.3]] for y in (-0.72, 0.72)])
    placed.append((part("gear door links", (INDEX["steel"], whole(sweeps(links, bar(0.06, 0.06), Z)))), IDENTITY[None]))
    return placed


def lamps(detail: Detail) -> list[Placed]:
    """Return beacons and landing lights, which do not shine by day."""
    bulb = cushion((0.12, 0.12, 0.1), detail.count(120, 40), 1.0)
    beacon = joined([shifted(bulb, (30.0, 0.0, 3.12)), shifted(bulb, (31.0, 0.0, -3.9))])
    return [(part("beacons", (INDEX["red beacon"], beacon), smooth=True), IDENTITY[None])]
