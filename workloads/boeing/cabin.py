"""The inside of the airliner: floor, lining, bins, seats, galleys, lights, and containers in the hold."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from simrender.rays.scene import IDENTITY
from workloads.boeing.shapes import CABIN, FLOOR, INDEX, Detail, hull
from workloads.boeing.structure import HEAD, SILL, bays, glazed, is_open, opening
from workloads.cad import (
    X,
    Y,
    Z,
    bar,
    boxes,
    curve,
    cushion,
    joined,
    part,
    parts,
    points,
    ring,
    sheet,
    shifted,
    slab,
    sweeps,
    upright,
)
from workloads.cad import whole as one
from workloads.terrain import Placed

DOORS = (19.0, 33.5, 46.0)  # no seats near these
ABREAST = np.array([-2.58, -2.06, -1.54, -0.52, 0.0, 0.52, 1.54, 2.06, 2.58])
ROW = 0.813  # 32 inches


def cabin(detail: Detail, cutaway: bool) -> list[Placed]:
    """Return everything inside."""
    return [*_lining(detail, cutaway), *_seats(detail), *_monuments(detail), *_hold(detail)]


def _lining(detail: Detail, cutaway: bool) -> list[Placed]:
    """Return floor panels, seat tracks, side walls with window reveals, bins, ceiling and the lights along it."""
    made = []
    joints, gap = bays(detail), opening(detail, cutaway)
    inside = [(a, b) for a, b in pairwise(joints) if a >= CABIN[0] and b <= CABIN[1]]
    bin_outline = [[1.45, 0.98], [1.62, 0.70], [2.25, 0.66], [2.62, 0.80], [2.36, 1.42], [1.75, 1.50]]
    middle_outline = [[-0.66, 0.98], [-0.5, 0.76], [0.5, 0.76], [0.66, 0.98], [0.5, 1.42], [-0.5, 1.42]]
    pieces = detail.along(4, 1)
    outboard, centre = (curve([*o, o[0]], pieces)[:-1] for o in (bin_outline, middle_outline))
    arc = np.linspace(-1.0, 1.0, detail.across(16, 4) + 1)
    lamps = []
    for bay, (low, high) in enumerate(inside):
        x = np.array([low + 0.01, high - 0.01])
        bare = bool(is_open(0.5 * (low + high), SILL, gap))
        edges = np.linspace(-2.82, 2.82, 7)
        panels = boxes(points(x[0], edges[:-1] + 0.005, FLOOR - 0.025), points(x[1], edges[1:] - 0.005, FLOOR))
        made += parts(f"floor panel bay {bay}", panels, INDEX["carpet"])
        run = points(x, 0.0, [[0.0]])
        for name, outline, sign in (("port", outboard, -1.0), ("starboard", outboard, 1.0), ("middle", centre, 1.0)):
            if name == "port" and bare:
                continue
            # The path heads aft, so that sideways is to port.
            solid = sweeps(run, outline * np.array([-sign, 1.0]), Z)
            made += parts(f"bin {name} bay {bay}", solid, INDEX["lining"])
        tracks = points(x, np.array([-2.4, -1.85, -0.3, 0.3, 1.85, 2.4])[:, None], FLOOR + 0.006)
        made += parts(f"seat track bay {bay}", sweeps(tracks, bar(0.03, 0.012), Z), INDEX["steel"])
        for name, sign in (("port", 1.0), ("starboard", -1.0)):
            if name == "port" and bare:
                continue
            lines = np.array([62.0, HEAD, SILL, 92.0, 104.0])
            along, angle, holes = glazed(detail, (low, high), lines, detail.across(1))
            wall = [hull(along[:, None], sign * angle[None], depth) for depth in (0.19, 0.165)]
            made.append(part(f"side wall {name} bay {bay}", (INDEX["lining"], slab(wall[0], wall[1], holes))))
        ceiling = points(x[:, None], 1.5 * arc, 1.62 - 0.2 * arc**4)
        made.append(part(f"ceiling bay {bay}", (INDEX["lining"], sheet(ceiling)), smooth=True))
        sides = np.array([[-1.12], [1.12]])
        ends = np.array([low + 0.2, -0.06, 1.5]) + sides * Y, np.array([high - 0.2, 0.06, 1.52]) + sides * Y
        lamps.append(one(boxes(*ends)))
    pairs = [lamps[i : i + 2] for i in range(0, len(lamps), 2)]
    made += [part(f"cabin lights {i}", (INDEX["cabin light"], joined(pair))) for i, pair in enumerate(pairs)]
    return [(thing, IDENTITY[None]) for thing in made]


def _seats(detail: Detail) -> list[Placed]:
    """Return the passenger seats, all instances of one, and the crew's."""
    soft = [((-0.02, 0.0, 0.42), (0.25, 0.235, 0.075), 0.0, 160), ((0.24, 0.0, 0.80), (0.06, 0.225, 0.36), 0.22, 180),
            ((0.33, 0.0, 1.14), (0.05, 0.15, 0.09), 0.22, 60)]  # fmt: skip
    cloth = []
    for position, radii, lean, triangles in soft:
        vertices, faces = cushion(radii, detail.count(triangles, 48))
        cloth.append(shifted((vertices + lean * vertices[:, 2:] * X, faces), position))
    arms = one(boxes([[-0.16, -0.265, 0.58], [-0.16, 0.235, 0.58]], [[0.2, -0.235, 0.63], [0.2, 0.265, 0.63]]))
    legs = np.array([[[0.18 * f, s, 0.0], [0.1 * f, s, 0.36]] for f in (-1.0, 1.0) for s in (-0.15, 0.15)])
    frame = joined([arms, one(sweeps(legs, ring(0.018, 5), Y))])
    screen = one(boxes([[0.36, -0.12, 0.78]], [[0.375, 0.12, 0.95]]))
    seat = part("seat", (INDEX["seat blue"], joined(cloth)), (INDEX["seat grey"], frame), (INDEX["composite"], screen))
    rows = np.arange(CABIN[0] + 1.6, CABIN[1] - 1.4, ROW)
    rows = rows[np.abs(rows[:, None] - np.array(DOORS)).min(axis=1) > 1.3]
    x, y = (grid.ravel() for grid in np.meshgrid(rows, ABREAST, indexing="ij"))
    where = np.stack([x, y, np.full_like(x, FLOOR)], axis=1)
    crew = np.array([[4.3, -0.55, FLOOR - 0.15], [4.3, 0.55, FLOOR - 0.15]])
    return [(seat, upright(np.concatenate([where, crew])))]


def _monuments(detail: Detail) -> list[Placed]:
    """Return galleys and lavatories at the doors, with their doors and trolleys, and the flight deck."""
    made = []
    for i, x in enumerate((*DOORS, 50.2)):
        for j, y in enumerate((-1.0, 0.45)):
            block = one(boxes([[x - 0.55, y, FLOOR]], [[x + 0.45, y + 0.55, 1.35]]))
            made.append(part(f"galley {i} {j}", (INDEX["lining"], block)))
            low = [[x + 0.46, y + 0.02 + 0.27 * k, FLOOR + 0.05] for k in range(2)]
            high = [[x + 0.47, y + 0.25 + 0.27 * k, FLOOR + 1.02] for k in range(2)]
            made += parts(f"trolley {i} {j}", boxes(low, high), INDEX["bare aluminium"])
    panel = one(boxes([[3.0, -1.2, -0.75]], [[3.35, 1.2, -0.1]]))
    made.append(part("instrument panel", (INDEX["composite"], panel)))
    n = detail.count(60, 8)
    across = np.linspace(-1.15, 1.15, n)
    left = np.stack([np.full(n, 3.352), across - 0.4 / n, np.full(n, -0.6)], axis=1)
    right = np.stack([np.full(n, 3.36), across + 0.4 / n, -0.6 + 0.4 * (np.arange(n) % 3 + 1) / 3.0], axis=1)
    made += parts("instrument", boxes(left, right), INDEX["window"])
    return [(thing, IDENTITY[None]) for thing in made]


def _hold(detail: Detail) -> list[Placed]:
    """Return the floor of the hold and the containers on it, with their bevel to the curve of the hull."""
    made = []
    for name, low, high in (("forward", 10.0, 23.0), ("aft", 37.0, 51.0)):
        floor = one(boxes([[low, -1.5, -2.5]], [[high, 1.5, -2.46]]))
        made.append(part(f"hold floor {name}", (INDEX["bare aluminium"], floor)))
    outline = np.array([[0.06, 0.0], [1.05, 0.0], [1.5, 0.42], [1.5, 1.5], [0.06, 1.5]])
    middle = outline.mean(axis=0)
    rims = np.stack([outline * 0.0 + middle, outline, outline, outline * 0.0 + middle])
    x = np.array([-0.74, -0.74, 0.74, 0.74])
    points = np.stack(
        [np.broadcast_to(x[:, None], (4, 6)), *np.moveaxis(np.concatenate([rims, rims[:, :1]], 1), 2, 0)], 2
    )
    shell = sheet(points)
    ribs = np.linspace(-0.7, 0.7, detail.count(7, 2))
    bars = one(boxes(np.stack([ribs - 0.015, 0.0 * ribs + 0.05, 0.0 * ribs + 1.5], 1),
                     np.stack([ribs + 0.015, 0.0 * ribs + 1.5, 0.0 * ribs + 1.52], 1)))  # fmt: skip
    placed: list[Placed] = [(thing, IDENTITY[None]) for thing in made]
    box = part("container", (INDEX["container"], joined([shell, bars])))
    at = np.concatenate([np.arange(10.8, 22.5, 1.55), np.arange(37.8, 50.5, 1.55)])
    stand = [upright(np.stack([at, 0.0 * at, 0.0 * at - 2.45], 1), angle) for angle in (0.0, np.pi)]
    placed.append((box, np.concatenate(stand)))
    return placed
