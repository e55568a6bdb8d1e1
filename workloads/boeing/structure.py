"""The hull of the airliner: skins with windows, frames, stringers, clips and fasteners, and what runs along them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from simrender.rays.scene import IDENTITY
from workloads.boeing.shapes import CABIN, FLOOR, INDEX, LENGTH, RADIUS, Detail, centre, hull, outward, radius, stations
from workloads.cad import (
    X,
    Z,
    axes,
    bar,
    cushion,
    finer,
    lathe,
    part,
    parts,
    points,
    ring,
    sheet,
    shifted,
    slab,
    sweeps,
    whole,
)
from workloads.plants import GOLDEN_ANGLE
from workloads.terrain import F64, Placed, generator

Cells = NDArray[np.bool_]

SECTORS = {  # in degrees from the crown, positive to port
    "crown": (-30.0, 30.0),
    "port shoulder": (30.0, 63.0),
    "starboard shoulder": (-63.0, -30.0),
    "port side": (63.0, 95.0),
    "starboard side": (-95.0, -63.0),
    "port quarter": (95.0, 140.0),
    "starboard quarter": (-140.0, -95.0),
    "belly": (140.0, 220.0),
}
SILL, HEAD = 82.5, 75.0  # of the windows, in degrees
HALF_WINDOW = 0.15
CUT = (14.0, 24.5)  # stations between which the cutaway has no skin on its port side
HAT = [[-0.025, 0.0], [-0.012, 0.0], [-0.010, -0.035], [0.010, -0.035], [0.012, 0.0], [0.025, 0.0]]
ZED = [[-0.03, 0.0], [0.0, 0.0], [0.0, -0.10], [0.03, -0.10], [0.03, -0.104], [-0.004, -0.104], [-0.004, -0.004],
       [-0.03, -0.004]]  # fmt: skip


def bays(detail: Detail) -> F64:
    """Return the stations of the joints between skin panels: every sixth frame, or fewer where there are fewer."""
    at = stations(detail)
    every = max(1, round(len(at) / 22.0))
    return np.append(at[: -1 - every // 2 : every], at[-1])


def opening(detail: Detail, cutaway: bool) -> tuple[float, float]:
    """Return the stations between which the hull is open to port; the same one twice where it is closed."""
    joints = bays(detail)
    inside = joints[(joints > CUT[0]) & (joints < CUT[1])] if cutaway else joints[:0]
    return (float(inside[0]), float(inside[-1])) if len(inside) else (0.0, 0.0)


def is_open(x: F64 | float, angle: F64 | float, span: tuple[float, float]) -> Cells:
    """Tell where on the hull the `opening` lies, from stations and degrees from the crown."""
    low, high = SECTORS["port shoulder"][0], SECTORS["port side"][1]
    x, angle = np.asarray(x), np.asarray(angle)
    return (x > span[0]) & (x < span[1]) & (angle > low) & (angle < high)


def glazed(detail: Detail, bay: tuple[float, float], angle: F64, pieces: int) -> tuple[F64, F64, Cells]:
    """Return the grid of a panel with a window between any two frames.

    Parameters
    ----------
    detail : Detail
    bay : (float, float)
        The joints that the panel lies between.
    angle : float64 array
        Lines along the hull in degrees from the crown, the windows' sill and head among them.
    pieces : int
        Into how many pieces the distance between lines is cut.

    Returns
    -------
    stations, angles : float64 arrays
    windows : bool array (stations - 1, angles - 1)
        The cells that are windows.

    """
    frames = stations(detail)
    inner = frames[(frames >= bay[0] - 0.01) & (frames <= bay[1] + 0.01)]
    between = 0.5 * (inner[:-1] + inner[1:])
    x = finer(np.sort(np.concatenate([inner, between - HALF_WINDOW, between + HALF_WINDOW])), pieces)
    angle = finer(angle, pieces)
    mid_x, mid_angle = 0.5 * (x[:-1] + x[1:]), np.abs(0.5 * (angle[:-1] + angle[1:]))
    at_window = np.abs(mid_x[:, None] - between).min(axis=1) < HALF_WINDOW
    return x, angle, at_window[:, None] & ((mid_angle > HEAD) & (mid_angle < SILL))


def skins(detail: Detail, cutaway: bool) -> list[Placed]:
    """Return the skin panels of the hull, with the windows cut out of them."""
    made = []
    gap = opening(detail, cutaway)
    for bay, (low, high) in enumerate(pairwise(bays(detail))):
        for sector, (first, last) in SECTORS.items():
            if is_open(0.5 * (low + high), 0.5 * (first + last), gap):
                continue
            x = finer([low, high], detail.across(10, 2))
            angle = finer([first, last], detail.across(max(5.0, (last - first) / 6.0), 2))
            holes = None
            if sector.endswith("side") and low >= CABIN[0] and high <= CABIN[1]:
                lines = np.sort(np.sign(first) * np.array([63.0, 70.0, HEAD, SILL, 88.0, 95.0]))
                x, angle, holes = glazed(detail, (low, high), lines, detail.across(2))
            solid = slab(hull(x[:, None], angle[None]), hull(x[:, None], angle[None], 0.012), holes)
            made.append(part(f"skin {sector} {bay}", (_livery(sector, low), solid), smooth=True))
    return [(thing, IDENTITY[None]) for thing in made]


def windows(detail: Detail, cutaway: bool) -> list[Placed]:
    """Return the panes of the cabin windows and the windscreen."""
    frames, joints = stations(detail), bays(detail)
    between = 0.5 * (frames[:-1] + frames[1:])
    first, last = joints[joints >= CABIN[0]][0], joints[joints <= CABIN[1]][-1]
    between = between[(between > first) & (between < last)]
    cut = is_open(between, SILL, opening(detail, cutaway))
    wide = np.linspace(-1.05, 1.05, detail.across(3, 1) + 1) * HALF_WINDOW
    high = np.linspace(HEAD - 0.3, SILL + 0.3, detail.across(3, 1) + 1)
    placed = []
    for side, sign, at in (("port", 1.0, between[~cut]), ("starboard", -1.0, between)):
        solid = sheet(hull(20.0 + wide[:, None], sign * high[None], 0.015) - 20.0 * X)
        if len(at):
            placed.append((part(f"window {side}", (INDEX["window"], solid)), axes(at[:, None] * X, *np.eye(3))))
    for pane, (low, high_angle) in enumerate([(-62.0, -43.0), (-41.0, -21.0), (-19.0, -1.0)]):
        for sign in (1.0, -1.0):
            x, angle = np.linspace(2.25, 3.35, 6), sign * np.linspace(low, high_angle, 8)
            solid = sheet(hull(x[:, None], angle[None], -0.012))
            placed.append((part(f"windscreen {pane} {sign:+.0f}", (INDEX["window"], solid)), IDENTITY[None]))
    return placed


def framework(detail: Detail, cutaway: bool) -> list[Placed]:
    """Return the frames in four pieces each, the stringers between joints, clips where they cross, and bulkheads."""
    frames, joints, gap = stations(detail), bays(detail), opening(detail, cutaway)
    placed = []
    for name, first in (("crown", -45.0), ("port", 45.0), ("keel", 135.0), ("starboard", -135.0)):
        angle = np.linspace(first + 0.4, first + 89.6, detail.along(15, 3))
        paths = hull(frames[:, None], angle[None], 0.045)
        up = np.broadcast_to(outward(angle), paths.shape)
        placed += parts(f"frame {name}", sweeps(paths, ZED, up), INDEX["primer"])
    angles = _stringer_angles(detail)
    for bay, (low, high) in enumerate(pairwise(joints)):
        kept = angles[~is_open(0.5 * (low + high), angles, gap)]
        paths = hull(np.linspace(low, high, detail.along(6, 2))[None], kept[:, None], 0.013)
        series = sweeps(paths, HAT, outward(kept)[:, None])
        placed += parts(f"stringer bay {bay}", series, INDEX["dark primer"])
    made = [(thing, IDENTITY[None]) for thing in placed]
    for name, x, bulge in (("forward", 1.9, -0.3), ("aft", 62.0, 1.1)):
        r = float(radius(np.array(x))) - 0.1
        t = np.linspace(0.0, 1.0, detail.across(14, 3))
        dome = lathe(np.stack([r * t, bulge * (1.0 - t**2)], axis=1), detail.across(48, 8))
        turned = axes(np.array([[x, 0.0, float(centre(np.array(x)))]]), *np.eye(3)[[1, 2, 0]])
        made.append((part(f"pressure bulkhead {name}", (INDEX["primer"], dome), smooth=True), turned))
    return made


def small_parts(seed: int, detail: Detail, cutaway: bool) -> list[Placed]:
    """Return clips where stringers cross frames, and fasteners along both: by far the most parts, all instances."""
    frames, angles = stations(detail), _stringer_angles(detail)
    rng = generator(seed, "fasteners")
    x, angle = (grid.ravel() for grid in np.meshgrid(frames, angles))
    clip = part("clip", (INDEX["titanium"], sheet(_clip(detail.along(4, 1)))))
    each = detail.count(4)
    along = np.repeat(x, each) + rng.uniform(0.03, 0.5, len(x) * each)
    aside = np.repeat(angle, each) + rng.choice([-0.33, 0.33], len(x) * each)
    head = [[0.011, 0.0], [0.009, 0.007], [0.0, 0.009]]
    fastener = part("fastener", (INDEX["steel"], lathe(head, detail.along(6, 4))))
    placed = []
    for thing, at, toward, inset in ((clip, x, angle, 0.05), (fastener, along, aside, 0.012)):
        bare = is_open(at, toward, opening(detail, cutaway))
        out = outward(toward[~bare])
        where = axes(hull(at[~bare], toward[~bare], inset), X, np.cross(-out, X), -out)
        placed.append((thing, where))
    return placed


def systems(seed: int, detail: Detail) -> list[Placed]:
    """Return what runs the length of the hull: cable bundles of many wires, pipes, ducts and their clamps."""
    frames, joints = stations(detail), bays(detail)
    rng = generator(seed, "systems")
    made = []
    bundles = detail.across(22, 4)
    height = np.where(np.arange(bundles) % 2 == 0, 1.95, FLOOR - 0.38)
    wires = detail.across(7, 2)
    y = rng.uniform(-1.5, 1.5, bundles)
    sway = rng.uniform(0.0, 6.3, (2, bundles, 1))
    spiral = GOLDEN_ANGLE * np.arange(wires)
    pack = 0.018 * np.sqrt(np.arange(wires)) * np.stack([np.cos(spiral), np.sin(spiral)])
    clamps = []
    for bay, (low, high) in enumerate(pairwise(joints)):
        along = np.linspace(low, high, detail.along(9, 3))
        room = radius(along) / RADIUS
        at_y = y[:, None] * room + 0.05 * np.sin(0.9 * along + sway[0])
        at_z = height[:, None] * room + centre(along) + 0.03 * np.sin(1.7 * along + sway[1])
        twist = np.stack([pack[0][:, None] * np.cos(along) - pack[1][:, None] * np.sin(along),
                          pack[0][:, None] * np.sin(along) + pack[1][:, None] * np.cos(along)])  # fmt: skip
        for b in range(bundles):
            path = points(along, at_y[b] + twist[0], at_z[b] + twist[1])
            material = INDEX["orange wire" if b % 3 == 0 else "white wire"]
            made.append(part(f"cable bundle {b} bay {bay}", (material, whole(sweeps(path, ring(0.008, 4), Z)))))
            clamps.append([low, at_y[b, 0], at_z[b, 0]])
        pipes = detail.count(18, 3)
        lane = np.linspace(-2.0, 2.0, pipes)[:, None] * room
        depth = (FLOOR - 0.6 - 0.12 * np.sin(3.0 * np.arange(pipes))[:, None]) * room + centre(along)
        size = 0.012 + 0.014 * (np.arange(pipes)[:, None] % 3)
        series = sweeps(points(along, lane, depth), ring(1.0, 8), Z, size.astype(np.float64))
        made += parts(f"pipe bay {bay}", series, INDEX["hydraulic"])
        duct_y, duct_z = np.array([[-0.62], [0.62], [-2.2], [2.2]]), np.array([[2.35], [2.35], [-1.5], [-1.5]])
        duct = points(along, duct_y * room, duct_z * room + centre(along))
        series = sweeps(duct, ring(0.14, detail.along(14, 5)), Z, room)
        made += parts(f"duct bay {bay}", series, INDEX["duct"], smooth=True)
    sleeve = [[0.05, -0.02], [0.062, -0.02], [0.062, 0.02], [0.05, 0.02], [0.05, -0.02]]
    clamp = part("clamp", (INDEX["titanium"], lathe(sleeve, detail.along(10, 4))))
    beam = frames[(frames > CABIN[0]) & (frames < CABIN[1])]
    span = 0.97 * np.sqrt(np.maximum((radius(beam) - 0.15) ** 2 - (FLOOR - 0.13) ** 2, 0.01))
    aside = span[:, None] * np.linspace(-1.0, 1.0, detail.along(8, 2))
    made += parts("floor beam", sweeps(points(beam[:, None], aside, FLOOR - 0.13), bar(0.05, 0.2), Z), INDEX["primer"])
    return [*((thing, IDENTITY[None]) for thing in made), (clamp, axes(np.array(clamps), *np.eye(3)[[1, 2, 0]]))]


def outside(detail: Detail) -> list[Placed]:
    """Return the radome, the tail cone, antennas, beacons and the fairing under the wing."""
    made = []
    for name, x in (("radome", 1.6 * np.linspace(0.0, 1.0, detail.across(14, 4)) ** 2),
                    ("tail cone", np.linspace(72.6, LENGTH, detail.across(8, 2)))):  # fmt: skip
        angle = np.linspace(-180.0, 180.0, detail.across(48, 12) + 1)
        solid = sheet(hull(x[:, None], angle[None]))
        made.append(part(name, (INDEX["white paint"], solid), smooth=True))
    fairing = cushion((8.6, 3.0, 1.15), detail.count(4000, 60), 0.62)
    made.append(part("wing fairing", (INDEX["grey paint"], shifted(fairing, (32.5, 0.0, -2.75))), smooth=True))
    blade = cushion((0.3, 0.02, 0.35), detail.count(120, 40), 0.8)
    for i, station in enumerate((11.0, 20.0, 39.0, 48.0)):
        made.append(part(f"antenna {i}", (INDEX["white paint"], shifted(blade, (station, 0.0, 3.3)))))
    return [(thing, IDENTITY[None]) for thing in made]


def _livery(sector: str, x: float) -> int:
    """Return the paint of a skin panel."""
    if sector == "belly" or sector.endswith("quarter"):
        return INDEX["grey paint" if sector == "belly" or x < 60.0 else "blue paint"]
    return INDEX["blue paint" if x > 57.0 else "white paint"]


def _stringer_angles(detail: Detail) -> F64:
    """Return where stringers run, in degrees from the crown; none crosses a window."""
    count = max(8, min(44, round(44 * detail.factor**0.5)))
    angle = -180.0 + 360.0 * (np.arange(count) + 0.5) / count
    kept: F64 = angle[(np.abs(angle) < HEAD - 1.0) | (np.abs(angle) > SILL + 1.0)]
    return kept


def _clip(pieces: int) -> F64:
    """Return the sheet of an angle bracket, (2, n, 3): two flanges at right angles with a curved corner."""
    bend = np.radians(np.linspace(-90.0, 0.0, pieces + 1))
    y = np.concatenate([[-0.05], -0.008 + 0.008 * np.cos(bend + np.pi / 2), [0.0]])
    z = np.concatenate([[0.0], 0.008 + 0.008 * np.sin(bend), [0.06]])
    edge = np.stack([np.zeros_like(y), y, z], axis=1)
    return np.stack([edge - 0.03 * X, edge + 0.03 * X])
