"""The museum's hall: a closed shell, a coffered vault on colonnades, and the area lights in it."""

from __future__ import annotations

import numpy as np

from simrender.rays.scene import IDENTITY, Material, SceneObject, Texture, texture
from workloads.cad import (
    Y,
    Z,
    bar,
    boxes,
    clean,
    joined,
    lathe,
    mesh,
    panes,
    part,
    parts,
    points,
    sheet,
    sweeps,
    upright,
    whole,
)
from workloads.terrain import F64, I64, Noise, Placed, grid_faces, smoothstep

NAVE, AISLE, LENGTH = 6.5, 12.5, 54.0  # half widths, and how long the hall is
SPRING = 8.2  # height from which the vault springs; the aisles are as high
BAY = 6.0
BAYS = round(LENGTH / BAY)
ARCADE = NAVE + 0.5  # where the columns stand
COLUMN = 6.9  # their height
TILE = 0.75
REPEAT = 0.8  # of the damask on the walls

ACROSS = round(2.0 * AISLE / TILE)  # tiles

PALETTE = {
    "plaster": Material((0.80, 0.77, 0.70)),
    "masonry": Material((0.40, 0.34, 0.28)),
    "vault": Material((0.83, 0.80, 0.73)),
    "wall": Material((0.42, 0.1, 0.088), texture=1),
    "dado": Material((0.55, 0.51, 0.44)),
    "light marble": Material((0.72, 0.69, 0.63), mirror=0.16),
    "red marble": Material((0.40, 0.17, 0.12), mirror=0.16),
    "light floor": Material((0.80, 0.77, 0.70), mirror=0.16, texture=0),
    "dark floor": Material((0.18, 0.19, 0.19), mirror=0.2, texture=0),
    "red floor": Material((0.45, 0.19, 0.135), mirror=0.16, texture=0),
    "stone": Material((0.68, 0.63, 0.54)),
    "white marble": Material((0.82, 0.80, 0.77)),
    "bronze": Material((0.30, 0.20, 0.10), mirror=0.25),
    "dark stone": Material((0.24, 0.24, 0.25), mirror=0.06),
    "gilt": Material((0.70, 0.50, 0.19), mirror=0.3),
    "glaze": Material((0.5, 0.3, 0.2), mirror=0.08),
    "bone": Material((0.64, 0.54, 0.40)),
    "iron": Material((0.10, 0.10, 0.11), mirror=0.15),
    "walnut": Material((0.21, 0.115, 0.06), mirror=0.05),
    "brass": Material((0.74, 0.56, 0.26), mirror=0.55),
    "felt": Material((0.09, 0.16, 0.12)),
    "leather": Material((0.17, 0.055, 0.04)),
    "rope": Material((0.42, 0.03, 0.05)),
    "shell": Material((0.60, 0.47, 0.33), mirror=0.1),
    "amethyst": Material((0.42, 0.24, 0.55), mirror=0.3),
    "quartz": Material((0.80, 0.80, 0.83), mirror=0.35),
    "malachite": Material((0.06, 0.36, 0.22), mirror=0.2),
    "skylight": Material((0.8, 0.8, 0.8), emission=(7.6, 7.9, 8.4)),
    "lunette": Material((0.8, 0.8, 0.8), emission=(4.4, 4.2, 3.9)),
    "aisle lamp": Material((0.8, 0.8, 0.8), emission=(4.6, 4.0, 3.1)),
}
INDEX = {name: index for index, name in enumerate(PALETTE)}
FLOOR = {INDEX[name] for name in ("light floor", "dark floor", "red floor")}

COLUMNS = BAY * (np.arange(BAYS) + 0.5)
RIB = [[-0.26, -0.02], [-0.26, 0.10], [-0.16, 0.12], [-0.14, 0.28], [0.14, 0.28], [0.16, 0.12], [0.26, 0.10],
       [0.26, -0.02]]  # fmt: skip
ENTABLATURE = [[0.0, -1.3], [0.55, -1.3], [0.6, -1.1], [0.6, -0.75], [0.66, -0.7], [0.66, -0.38], [0.8, -0.3],
               [0.95, -0.12], [1.0, 0.0], [1.0, 0.1], [0.0, 0.1]]  # fmt: skip
RAIL = [[0.0, -0.09], [0.04, -0.09], [0.06, -0.02], [0.1, 0.03], [0.0, 0.06]]
BASE = [[0.62, 0.15], [0.66, 0.2], [0.62, 0.27], [0.52, 0.29], [0.52, 0.32], [0.57, 0.37], [0.52, 0.43], [0.47, 0.45]]
BELL = [[0.39, 5.9], [0.43, 5.93], [0.39, 5.97], [0.41, 6.0], [0.50, 6.24], [0.44, 6.27], [0.54, 6.5], [0.47, 6.53],
        [0.66, 6.74]]  # fmt: skip
ACANTHUS = [0.0, 0.0, 0.0, 0.5, 1.0, 0.3, 1.0, 0.3, 0.6]  # how far the leaves stand out along the bell
PILASTER = [[0.0, 0.55, 0.45], [0.45, 0.48, 0.38], [0.6, 0.42, 0.3], [7.3, 0.5, 0.4], [7.5, 0.42, 0.3],
            [7.7, 0.56, 0.5], [SPRING, 0.0, 0.0]]  # fmt: skip
"""From which height it is how wide (half of it) and how deep."""


def hall(detail: float) -> list[Placed]:
    """Return the building."""
    # Rays start a little off their surface. Of a million, one starts so in a corner that it slips behind the next wall;
    # as in any building, there is an outer one.
    around = whole(boxes([[-AISLE - 1.0, -1.0, -1.0]], [[AISLE + 1.0, LENGTH + 1.0, SPRING + NAVE + 1.0]]))
    inside = [_shell(), part("masonry", (INDEX["masonry"], around))]
    return [*((thing, IDENTITY[None]) for thing in inside), *_vault(detail), *_arcades(detail), *_lights()]


def _outline() -> tuple[F64, list[str]]:
    """Return the cross-section of the hall (n, 2), around from the left end of the floor, and what each side is."""
    floor = np.linspace(-AISLE, AISLE, ACROSS + 1)
    wall = np.concatenate([np.linspace(0.0, 1.15, 3), np.linspace(1.15, SPRING, 6)[1:]])
    arc = np.pi * np.arange(33) / 32
    ceiling = np.array([[AISLE, SPRING], [0.5 * (AISLE + NAVE), SPRING], [NAVE, SPRING]])
    runs = [
        ("floor", np.stack([floor, np.zeros_like(floor)], axis=1)),
        ("wall", np.stack([np.full_like(wall, AISLE), wall], axis=1)),
        ("ceiling", ceiling),
        ("vault", np.stack([NAVE * np.cos(arc), SPRING + NAVE * np.sin(arc)], axis=1)),
        ("ceiling", ceiling[::-1] * [-1.0, 1.0]),
        ("wall", np.stack([np.full_like(wall, -AISLE), wall[::-1]], axis=1)),
    ]
    return np.concatenate([run[:-1] for _, run in runs]), [name for name, run in runs for _ in run[:-1]]


def _shell() -> SceneObject:
    """Return the inside of the building as one closed surface, a mesh for each material."""
    outline, kind = _outline()
    y = np.linspace(0.0, LENGTH, round(LENGTH / TILE) + 1)
    n, rows = len(outline), len(y)
    sides = points(outline[:, :1], y[None], outline[:, 1:]).reshape(-1, 3)
    middle = 3.6  # every point of the outline is seen from here, so that the ends are fans
    vertices = np.concatenate([sides, [[0.0, 0.0, middle], [0.0, LENGTH, middle]]])
    faces = grid_faces(n, rows - 1) % (n * rows)  # the outline is closed
    first = np.arange(n) * rows
    after = np.roll(first, -1)
    near = np.stack([first, after, np.full(n, n * rows)], axis=1)
    far = np.stack([after + rows - 1, first + rows - 1, np.full(n, n * rows + 1)], axis=1)
    material = np.concatenate([_cladding(outline, kind, y), np.full(2 * n, INDEX["plaster"])])
    faces = np.concatenate([faces, near, far])
    kinds = np.flatnonzero(np.bincount(material))
    pieces = [(int(m), clean((vertices, faces[material == m]))) for m in kinds]
    return SceneObject("hall", tuple(mesh(piece, m, uv=_unfolded(piece[0], m)) for m, piece in pieces))


def _unfolded(vertices: F64, material: int) -> F64 | None:
    """Return where the points of a floor or wall lie in its texture."""
    x, y, z = vertices.T
    if material == INDEX["wall"]:
        return np.stack([y, z], axis=1) / REPEAT
    if material in FLOOR:
        return np.stack([(x + AISLE) / (8.0 * AISLE / ACROSS), y / (4.0 * TILE)], axis=1)
    return None


def cladding(seed: int) -> list[Texture]:
    """Return the textures of the hall: veined marble, a slab as wide as four tiles, and a repeat of damask."""
    u, v = np.meshgrid((np.arange(384) + 0.5) / 384, (np.arange(384) + 0.5) / 384)
    noise = Noise(seed, "marble")
    bent = 6.0 * u + 3.0 * v + 1.6 * noise(u, v, 0.5, 6)
    veins = np.exp(-12.0 * np.abs(np.sin(2.0 * bent))) + 0.5 * np.exp(-20.0 * np.abs(np.sin(5.0 * bent + u)))
    marble = 0.92 + 0.08 * noise(u + 3.0, v, 0.3, 5) - 0.45 * veins
    u, v = np.meshgrid((np.arange(128) + 0.5) / 128, (np.arange(128) + 0.5) / 128)
    turn = 2.0 * np.pi
    a, b = np.cos(turn * u), np.cos(turn * v)
    ogee = a + b + 0.6 * np.cos(turn * (u + v)) * np.cos(turn * (u - v)) - 0.5 * a * np.cos(3.0 * turn * v)
    damask = 0.76 + 0.2 * smoothstep(-0.1, 0.1, ogee) - 0.12 * smoothstep(1.1, 1.3, np.abs(ogee))
    grain = 0.03 * np.cos(32.0 * turn * v)
    return [texture(np.repeat(tone[..., None], 3, axis=2)) for tone in (marble, damask + grain)]


def _cladding(outline: F64, kind: list[str], y: F64) -> I64:
    """Return the material of each triangle of the hall's sides: the floor is laid in a pattern of three marbles."""
    x, z = (0.5 * (outline + np.roll(outline, -1, axis=0))).T
    i, j = np.meshgrid(np.arange(len(outline)), np.arange(len(y) - 1), indexing="ij")
    kinds = np.array(kind)
    plain = {"ceiling": "plaster", "vault": "vault", "wall": "wall", "floor": "light floor"}
    material = np.array([INDEX[plain[name]] for name in kind])
    material[(kinds == "wall") & (z < 1.15)] = INDEX["dado"]
    floor = np.where((i + j) % 2 == 0, INDEX["light floor"], INDEX["dark floor"])
    border = (np.abs(np.abs(x) - 5.2) < 0.5 * TILE) | (np.abs(np.abs(x) - 11.6) < 0.5 * TILE)
    floor = np.where(border[:, None] | (j % 24 == 11), INDEX["red floor"], floor)
    return np.repeat(np.where((kinds == "floor")[:, None], floor, material[:, None]).ravel(), 2)


def _around(angle: F64) -> tuple[F64, F64]:
    """Return points of the vault at angles from its right foot, in the plane y = 0, and the directions inwards."""
    out = points(np.cos(angle), 0.0, np.sin(angle))
    return NAVE * out + SPRING * Z, -out


def _vault(detail: float) -> list[Placed]:
    """Return the ribs that make coffers of the vault, with a rosette in each, and the entablature it stands on."""
    arc, inward = _around(np.linspace(0.0, np.pi, max(12, round(40 * detail**0.5)) + 1))
    stations = np.arange(0.0, LENGTH + 0.1, 1.5)
    arch = part("rib", (INDEX["vault"], whole(sweeps(arc[None], RIB, inward))))
    courses = np.pi * np.array([0.035, 0.15, 0.27, 0.39, 0.61, 0.73, 0.85, 0.965])
    foot, up = _around(courses)
    ends = np.array([0.0, LENGTH])[:, None] * Y
    made = parts("purlin", sweeps(foot[:, None] + ends, RIB, up[:, None]), INDEX["vault"])
    for name, sign in (("left", -1.0), ("right", 1.0)):
        line = points(sign * ARCADE, [0.0, LENGTH], SPRING)[None]
        made += parts(f"entablature {name}", sweeps(line, np.array(ENTABLATURE) * [-sign, 1.0], Z), INDEX["stone"])
    turn = 2.0 * np.pi * np.arange(4 * max(8, round(12 * detail**0.5)))
    petals = 1.0 + 0.16 * np.cos(8.0 * turn / len(turn))
    shape = [[0.36, 0.0], [0.34, 0.06], [0.2, 0.04], [0.14, 0.1], [0.0, 0.13]]
    rosette = part("rosette", (INDEX["gilt"], lathe(shape, len(turn), np.broadcast_to(petals, (5, len(turn))))))
    between = 0.5 * (courses[[0, 1, 2, 4, 5, 6]] + courses[[1, 2, 3, 5, 6, 7]])
    angle, y = (grid.ravel() for grid in np.meshgrid(between, stations[:-1] + 0.75))
    place, normal = _around(angle)
    where = np.stack([np.cross(Y, normal), np.broadcast_to(Y, normal.shape), normal, place + y[:, None] * Y], axis=2)
    return [
        (arch, upright(stations[:, None] * Y)),
        (rosette, where.astype(np.float32)),
        *((thing, IDENTITY[None]) for thing in made),
    ]


def _arcades(detail: float) -> list[Placed]:
    """Return the columns on both sides of the nave, and pilasters, rails, beams and portals along the walls."""
    sign = np.array([[-1.0], [1.0]])
    pilaster = np.array(PILASTER)
    low = np.stack([np.full(6, -0.05), -pilaster[:-1, 1], pilaster[:-1, 0]], axis=1)
    high = np.stack([pilaster[:-1, 2], pilaster[:-1, 1], pilaster[1:, 0]], axis=1)
    placed: list[Placed] = [
        (_column(detail), upright(points(sign * ARCADE, COLUMNS, 0.0))),
        (part("pilaster", (INDEX["stone"], whole(boxes(low, high)))),
         upright(points(sign * AISLE, COLUMNS, 0.0), np.repeat([0.0, np.pi], BAYS))),
    ]  # fmt: skip
    made = []
    for name, side in (("left", -1.0), ("right", 1.0)):
        lines = points(side * AISLE, [0.0, LENGTH], [[1.15], [7.1]])
        made += parts(f"rail {name}", sweeps(lines, np.array(RAIL) * [-side, 1.0], Z), INDEX["walnut"])
        beams = points(side * np.array([NAVE + 0.9, AISLE]), COLUMNS[:, None], SPRING - 0.2)
        made += parts(f"beam {name}", sweeps(beams, bar(0.7, 0.42), Z), INDEX["plaster"])
    jambs = boxes([[-2.6, 0.0, 0.0], [1.9, 0.0, 0.0], [-3.0, 0.0, 5.0], [-3.3, 0.0, 5.9]],
                  [[-1.9, 0.5, 5.0], [2.6, 0.5, 5.0], [3.0, 0.6, 5.9], [3.3, 0.8, 6.2]])  # fmt: skip
    leaves = boxes([[-1.9, -0.05, 0.0], [0.02, -0.05, 0.0]], [[-0.02, 0.12, 5.0], [1.9, 0.12, 5.0]])
    for name, at, out in (("near", 0.0, 1.0), ("far", LENGTH, -1.0)):
        solids = [(m, whole((series[0] * [1.0, out, 1.0] + at * Y, series[1]))) for m, series in
                  ((INDEX["stone"], jambs), (INDEX["bronze"], leaves))]  # fmt: skip
        made.append(part(f"portal {name}", *solids))
    return [*placed, *((thing, IDENTITY[None]) for thing in made)]


def _column(detail: float) -> SceneObject:
    """Return a fluted column with a base, and a capital of two rows of leaves."""
    flutes = 20
    sides = flutes * max(2, round(5 * detail**0.5))
    angle = 2.0 * np.pi * np.arange(sides) / sides
    t = np.linspace(0.0, 1.0, max(4, round(26 * detail**0.5)))
    shaft = np.stack([0.46 - 0.075 * t**1.7, 0.45 + 5.45 * t], axis=1)  # it swells: entasis
    groove = 0.06 * (1.0 - np.sqrt(np.abs(np.sin(0.5 * flutes * angle))))
    carved = 1.0 - groove * (np.minimum(t, 1.0 - t) > 0.01)[:, None]
    leaves = 1.0 + 0.09 * np.array(ACANTHUS)[:, None] * np.cos(8.0 * angle)
    plates = whole(boxes([[-0.7, -0.7, 0.0], [-0.68, -0.68, 6.74]], [[0.7, 0.7, 0.15], [0.68, 0.68, COLUMN]]))
    smooth = [mesh(solid, INDEX["stone"], smooth=True) for solid in
              (lathe(shaft, sides, carved), lathe(BASE, max(24, sides // 2)))]  # fmt: skip
    return SceneObject(
        "column", (*smooth, mesh(lathe(BELL, sides, leaves), INDEX["stone"]), mesh(plates, INDEX["stone"]))
    )


def _lights() -> list[Placed]:
    """Return the area lights: skylights along the crown, frosted windows at the ends and lamps in the aisles."""
    made = []
    crown = SPRING + NAVE
    bays = BAY * np.arange(BAYS)
    glass = panes(points(-2.05, bays + 0.3, crown - 0.4), points(2.05, bays + BAY - 0.3, crown - 0.4))
    made += parts("skylight", glass, INDEX["skylight"])
    bars, sills = np.arange(0.0, LENGTH, 0.75), np.array([-2.1, -0.7, 0.7, 2.1])
    muntins = [boxes(points(-2.1, bars - 0.03, crown - 0.52), points(2.1, bars + 0.03, crown - 0.43)),
               boxes(points(sills - 0.04, 0.0, crown - 0.55), points(sills + 0.04, LENGTH, crown - 0.43))]  # fmt: skip
    made.append(part("muntins", (INDEX["iron"], joined(whole(series) for series in muntins))))
    angle, spokes = np.linspace(0.06, np.pi - 0.06, 33), np.linspace(0.06, np.pi - 0.06, 10)
    for name, at, before in (("near", 0.12, 0.18), ("far", LENGTH - 0.12, LENGTH - 0.18)):
        sill = SPRING + 0.35
        r = np.array([[0.0], [5.3]])
        fan = clean(sheet(points(r * np.cos(angle), at, sill + r * np.sin(angle))))
        made.append(part(f"lunette {name}", (INDEX["lunette"], fan)))
        reach, hoop = np.array([0.6, 5.4]), np.array([[0.6], [2.9], [5.35]])
        rays = points(reach * np.cos(spokes)[:, None], before, sill + reach * np.sin(spokes)[:, None])
        hoops = points(hoop * np.cos(angle), before, sill + hoop * np.sin(angle))
        tracery = joined([whole(sweeps(rays, bar(0.12, 0.12), Y)), whole(sweeps(hoops, bar(0.16, 0.2), Y))])
        made.append(part(f"tracery {name}", (INDEX["stone"], tracery)))
    for name, x in (("left", -9.9), ("right", 9.9)):
        for third in range(3):
            y = bays[3 * third : 3 * third + 3]
            lamp = whole(panes(points(x - 0.6, y + 1.2, SPRING - 0.05), points(x + 0.6, y + 4.8, SPRING - 0.05)))
            made.append(part(f"aisle lamps {name} {third}", (INDEX["aisle lamp"], lamp)))
    return [(thing, IDENTITY[None]) for thing in made]
