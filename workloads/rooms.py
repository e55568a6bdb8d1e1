"""What stands and hangs in rooms: statues, busts, vases, skeletons, paintings in frames, cases and benches.

Each builder takes the number of triangles to aim at; objects stand on the origin, z up, in metres. Statues are found by
marching from all sides towards an upright axis until a distance function of blended limbs says that stone is met, which
suits draped figures and gives a grid of any fineness.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from simrender.rays.scene import SceneObject, Texture, texture
from workloads.cad import (
    Solid,
    X,
    Y,
    Z,
    bar,
    boxes,
    clean,
    curve,
    cushion,
    joined,
    lathe,
    mesh,
    part,
    ring,
    sheet,
    shifted,
    sweeps,
    whole,
)
from workloads.plants import GOLDEN_ANGLE
from workloads.terrain import F64, Noise, generator, grid_faces, smoothstep, unit

Point = tuple[float, float, float]
Limb = tuple[Point, Point, float, float]  # two ends, and the radii there
Field = Callable[[F64, F64, F64], F64]  # the distance to the stone from points x, y, z

HEAD: list[Limb] = [  # skull, jaw, nose, brow and lips
    ((0.0, 0.025, 0.03), (0.0, 0.0, 0.03), 0.088, 0.082),
    ((0.0, -0.03, -0.04), (0.0, -0.05, -0.08), 0.055, 0.034),
    ((0.0, -0.082, 0.03), (0.0, -0.108, -0.018), 0.010, 0.015),
    ((-0.045, -0.078, 0.032), (0.045, -0.078, 0.032), 0.011, 0.011),
    ((-0.02, -0.083, -0.052), (0.02, -0.083, -0.052), 0.007, 0.007),
]
HAIR: list[Limb] = [((0.0, 0.035, 0.045), (0.0, 0.02, 0.055), 0.096, 0.092)]


def figure(seed: int, name: str, *, triangles: int, stone: int, draped: bool = True) -> SceneObject:
    """Carve a standing figure 1.9 m tall, its weight on one leg, looking towards negative y."""
    rng = generator(seed, name)
    lean, turn, raised = rng.uniform(0.02, 0.06), rng.uniform(-0.5, 0.5), rng.uniform(0.0, 1.0)
    hip, chest = 0.03 + lean, -0.01
    hand = (0.30, -0.26 - 0.1 * raised, 1.02 + 0.4 * raised)
    limbs: list[Limb] = [
        ((hip + 0.09, 0.0, 0.06), (hip + 0.09, -0.01, 0.52), 0.045, 0.062),
        ((hip + 0.09, -0.01, 0.52), (hip + 0.08, 0.0, 0.94), 0.068, 0.095),
        ((-0.16, -0.10, 0.05), (-0.13, -0.14, 0.50), 0.042, 0.060),
        ((-0.13, -0.14, 0.50), (hip - 0.11, 0.0, 0.92), 0.066, 0.095),
        ((hip + 0.09, 0.0, 0.03), (hip + 0.12, -0.16, 0.03), 0.045, 0.035),
        ((-0.16, -0.10, 0.03), (-0.20, -0.27, 0.03), 0.042, 0.033),
        ((hip - 0.05, 0.0, 0.97), (hip + 0.05, 0.0, 0.98), 0.125, 0.125),
        ((hip, 0.0, 1.0), (chest, -0.01, 1.22), 0.115, 0.125),
        ((chest - 0.08, -0.02, 1.34), (chest + 0.08, -0.02, 1.33), 0.12, 0.12),
        ((chest - 0.17, 0.0, 1.47), (chest + 0.17, 0.0, 1.45), 0.062, 0.062),
        ((chest, 0.0, 1.46), (chest, 0.0, 1.58), 0.058, 0.052),
        ((chest - 0.19, 0.0, 1.46), (chest - 0.27, 0.05, 1.18), 0.055, 0.044),
        ((chest - 0.27, 0.05, 1.18), (chest - 0.24, -0.04, 0.95), 0.042, 0.032),
        ((chest + 0.19, 0.0, 1.44), (0.29, -0.02, 1.18), 0.055, 0.044),
        ((0.29, -0.02, 1.18), hand, 0.042, 0.032),
    ]

    def field(x: F64, y: F64, z: F64) -> F64:
        distance = _limbs(x, y, z, limbs, 0.05)
        distance = _blend(distance, _head(x - chest, y + 0.015, z - 1.70, turn), 0.03)
        if draped:
            angle = np.arctan2(y, x)
            folds = 0.016 * np.sin(9.0 * angle + 2.5 * np.sin(2.0 * z)) * smoothstep(1.05, 0.3, z)
            robe = _limbs(x, y, z, [((hip, 0.0, 1.12), (hip, -0.03, 0.1), 0.15, 0.27)], 0.05) + folds
            distance = _blend(distance, np.where(z < 1.15, robe, distance), 0.04)
            sash = np.abs(z - 1.12 - 0.55 * x) - 0.03
            distance = distance - 0.012 * smoothstep(0.03, -0.01, sash)
        return distance

    solid = _carved(field, (0.0, 1.86), 0.62, triangles)
    base = whole(boxes([[-0.36, -0.36, -0.08]], [[0.36, 0.36, 0.012]]))
    return SceneObject(name, (mesh(solid, stone, smooth=True), mesh(base, stone)))


def bust(seed: int, name: str, *, triangles: int, stone: int) -> SceneObject:
    """Carve a head with shoulders, 0.75 m tall, on a round foot."""
    rng = generator(seed, name)
    turn, size = rng.uniform(-0.7, 0.7), rng.uniform(1.0, 1.15)
    limbs: list[Limb] = [
        ((0.0, 0.0, 0.30), (0.0, 0.0, 0.45), 0.062, 0.058),
        ((-0.16, 0.02, 0.25), (0.16, 0.02, 0.25), 0.075, 0.075),
        ((-0.06, 0.0, 0.14), (0.06, 0.0, 0.14), 0.11, 0.11),
        ((0.0, 0.0, 0.02), (0.0, 0.0, 0.12), 0.05, 0.07),
    ]

    def field(x: F64, y: F64, z: F64) -> F64:
        head = size * _head(x / size, (y + 0.02) / size, (z - 0.57) / size, turn)
        return _blend(_limbs(x, y, z, limbs, 0.06), head, 0.03)

    solid = _carved(field, (0.0, 0.75), 0.36, triangles)
    foot = lathe([[0.0, -0.06], [0.13, -0.06], [0.13, -0.02], [0.07, 0.0], [0.06, 0.05]], 32)
    return SceneObject(name, (mesh(solid, stone, smooth=True), mesh(foot, stone)))


def _head(x: F64, y: F64, z: F64, turn: float) -> F64:
    """Return the distance to a head at the origin, 0.25 m tall, which looks along negative y turned about z."""
    c, s = np.cos(turn), np.sin(turn)
    x, y = c * x + s * y, c * y - s * x
    shape = _limbs(x, y, z, HEAD, 0.02)
    curls = 0.007 * np.sin(90.0 * x) * np.sin(90.0 * z) * np.sin(70.0 * y)
    hair = _limbs(x, y, z, HAIR, 0.01) + curls
    bare = smoothstep(-0.045, -0.06, y + 0.3 * np.minimum(z - 0.05, 0.0))
    return np.asarray(np.where(bare > 0.5, shape, np.minimum(shape, hair)), np.float64)


def _limbs(x: F64, y: F64, z: F64, limbs: Sequence[Limb], blend: float) -> F64:
    """Return the distance to limbs that taper between their ends and flow into one another."""
    distance = np.full(x.shape, 9.0)
    for (ax, ay, az), (bx, by, bz), thick, thin in limbs:
        dx, dy, dz = bx - ax, by - ay, bz - az
        px, py, pz = x - ax, y - ay, z - az
        at = np.clip((px * dx + py * dy + pz * dz) / (dx * dx + dy * dy + dz * dz), 0.0, 1.0)
        px, py, pz = px - at * dx, py - at * dy, pz - at * dz
        distance = _blend(distance, np.sqrt(px * px + py * py + pz * pz) - (thick + (thin - thick) * at), blend)
    return distance


def _blend(a: F64, b: F64, width: float) -> F64:
    """Return the smooth minimum of two distances (Quilez's polynomial)."""
    overlap = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.asarray(np.minimum(a, b) - 0.25 * width * overlap * overlap, np.float64)


def _carved(field: Field, span: tuple[float, float], reach: float, triangles: int) -> Solid:
    """Return the surface that is met from all sides on the way to the z axis."""
    rows = max(6, round(float(np.sqrt(0.95 * triangles))))
    sides = max(8, round(triangles / (2.0 * rows)))
    angle = 2.0 * np.pi * np.arange(sides) / sides
    radius = np.full((rows + 1, sides), reach)
    z = np.broadcast_to(np.linspace(span[0], span[1], rows + 1)[:, None], radius.shape)
    c, s = np.cos(angle), np.sin(angle)
    for _ in range(24):  # distances are blended, hence a little less than the true ones: steps fall short of the stone
        radius = np.maximum(radius - 0.85 * np.maximum(field(radius * c, radius * s, z), 0.0), 0.0)
    radius[[0, -1]] = 0.0
    faces = grid_faces(rows, sides)
    faces = faces // (sides + 1) * sides + faces % (sides + 1) % sides
    return clean((np.stack([radius * c, radius * s, z], axis=2).reshape(-1, 3), faces))


def vase(seed: int, name: str, *, triangles: int, height: float, glaze: int) -> SceneObject:
    """Turn a vase and paint it: bands and a meander of colors, black and red as in Attica."""
    rng = generator(seed, name)
    belly, neck = rng.uniform(0.24, 0.36), rng.uniform(0.09, 0.14)
    profile = [[0.0, 0.0], [0.13, 0.0], [0.11, 0.05], [belly, 0.42], [belly * 0.93, 0.6], [neck, 0.80], [neck, 0.9],
               [neck + 0.06, 0.99], [neck + 0.05, 1.0], [neck - 0.01, 0.88]]  # fmt: skip
    shape = curve(profile, max(2, round(triangles**0.5 / 12)))
    sides = max(8, round(triangles / (2.0 * len(shape))))
    vertices, faces = lathe(height * shape, sides)
    angle, at = np.arctan2(vertices[:, 1], vertices[:, 0]), vertices[:, 2] / height
    stripes = (np.sin(at * rng.uniform(40.0, 70.0)) > 0.2) ^ (np.sin(rng.integers(8, 20) * angle) > 0.0)
    painted = np.where((np.abs(at - 0.5) < 0.16) | (at > 0.92), stripes, at < 0.2)
    colors = np.where(painted[:, None], np.array([0.04, 0.035, 0.03]), np.array([0.50, 0.20, 0.085]))
    return SceneObject(name, (mesh((vertices, faces), glaze, smooth=True, colors=colors),))


def painting(
    seed: int, name: str, *, triangles: int, texels: float, width: float, height: float, canvas: int, gilt: int
) -> tuple[SceneObject, Texture]:
    """Paint a landscape, a portrait or fields of color, and frame it; it hangs in the plane y = 0, seen from -y.

    The picture is a texture of so many texels a metre for the material ``canvas``.
    """
    rng = generator(seed, name)
    across, down = max(8, round(texels * width)), max(8, round(texels * height))
    u, v = np.meshgrid((np.arange(across) + 0.5) / across, 1.0 - (np.arange(down) + 0.5) / down)
    subject = (_landscape, _portrait, _fields)[int(rng.integers(0, 3))]
    colors = subject(rng, Noise(seed, name), u * width / height, v)
    strokes = 0.05 * Noise(seed, f"{name} strokes")(6.0 * u, 30.0 * v, 0.5, 3)
    picture = texture(np.clip(colors * (1.0 + 2.0 * strokes[..., None]), 0.01, 0.9))
    columns = max(4, round(float(np.sqrt(0.5 * triangles * width / height))))
    rows = max(4, round(0.5 * triangles / columns))
    u, v = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    grid = np.stack([width * (u - 0.5), np.full_like(u, -0.02), height * (v - 0.5)], axis=2)
    cloth = mesh(sheet(grid), canvas, uv=np.stack([u, v], axis=2).reshape(-1, 2))
    # Mitred: each point of the moulding goes around the picture at its own distance from the edge.
    moulding = np.array([[-0.01, -0.03], [0.015, -0.045], [0.03, -0.04], [0.05, -0.075], [0.09, -0.085], [0.11, -0.06],
                         [0.125, -0.065], [0.14, 0.0]])  # fmt: skip
    corner = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    out = corner[:, None] * (0.5 * np.array([width, height]) + moulding[None, :, :1])
    frame = np.stack([out[..., 0], np.broadcast_to(moulding[:, 1], out.shape[:2]), out[..., 1]], axis=2)
    return SceneObject(name, (cloth, mesh(sheet(frame), gilt))), picture


def _landscape(rng: np.random.Generator, noise: Noise, u: F64, v: F64) -> F64:
    dusk = rng.uniform(0.0, 1.0)
    high, low = np.array([0.16, 0.28, 0.5]), np.array([0.75, 0.55 + 0.15 * dusk, 0.35 + 0.3 * dusk])
    picture = low + (high - low) * smoothstep(0.35, 1.0, v)[..., None]
    picture = (
        picture + (0.35 * smoothstep(0.0, 0.6, noise(2.0 * u, 5.0 * v, 1.0, 4)) * smoothstep(0.4, 0.7, v))[..., None]
    )
    for layer in range(4):
        crest = 0.52 - 0.12 * layer + 0.14 * noise(u + 3.0 * layer, np.full_like(u, 7.0 * layer), 0.7 - 0.1 * layer, 4)
        tone = np.array([[0.24, 0.30, 0.36], [0.16, 0.24, 0.20], [0.13, 0.17, 0.07], [0.09, 0.08, 0.04]])[layer]
        grain = 1.0 + 0.6 * noise(8.0 * u, 8.0 * v, 1.0, 3)
        picture = np.where((v < crest)[..., None], tone * grain[..., None], picture)
    return np.asarray(picture, np.float64)


def _portrait(rng: np.random.Generator, noise: Noise, u: F64, v: F64) -> F64:
    middle = 0.5 * float(u.max()) + rng.uniform(-0.05, 0.05)
    ground = np.array([0.11, 0.085, 0.06]) * (1.0 + 0.8 * noise(u, v, 0.5, 4))[..., None]
    x, y = u - middle, v - 0.62
    coat = np.array([[0.25, 0.04, 0.04], [0.05, 0.06, 0.14], [0.08, 0.12, 0.07]])[int(rng.integers(0, 3))]
    body = (x / 0.42) ** 2 + ((v + 0.05) / 0.5) ** 2 < 1.0
    picture = np.where(body[..., None], coat * (1.2 + noise(5.0 * u, 2.0 * v, 0.6, 3))[..., None], ground)
    collar = (np.abs(x) < 0.09 * (1.2 - v)) & (v < 0.47) & (v > 0.2)
    picture = np.where(collar[..., None], np.array([0.75, 0.72, 0.66]), picture)
    hair = (x / 0.15) ** 2 + ((y - 0.03) / 0.21) ** 2 < 1.0
    picture = np.where(hair[..., None], np.array([0.10, 0.06, 0.03]), picture)
    face = (x / 0.115) ** 2 + ((y + 0.015) / 0.165) ** 2 < 1.0
    light = 0.75 + 2.2 * (x + 0.06) + 0.3 * y
    picture = np.where(face[..., None], np.array([0.62, 0.42, 0.30]) * np.clip(light, 0.45, 1.2)[..., None], picture)
    eyes = ((np.abs(x) - 0.045) / 0.02) ** 2 + ((y - 0.02) / 0.01) ** 2 < 1.0
    mouth = (np.abs(x) < 0.035) & (np.abs(y + 0.09) < 0.008)
    return np.asarray(np.where((eyes | mouth)[..., None], np.array([0.12, 0.05, 0.04]), picture), np.float64)


def _fields(rng: np.random.Generator, noise: Noise, u: F64, v: F64) -> F64:
    cuts = np.sort(rng.uniform(0.1, 0.9, 4))
    tones = rng.uniform(0.03, 0.75, (5, 5, 3)) ** 1.3
    wobble = 0.03 * noise(u, v, 0.4, 3)
    row = np.searchsorted(cuts, v + wobble)
    column = np.searchsorted(np.sort(rng.uniform(0.1, 1.4, 4)), u + wobble)
    return np.asarray(tones[row, column], np.float64)


def skeleton(name: str, *, triangles: int, bone: int, iron: int) -> list[SceneObject]:
    """Mount a sauropod 17 m long, its neck towards negative y: vertebrae, ribs, limbs, skull and the irons under it."""
    spine = curve([[0.0, -8.6, 3.9], [0.1, -6.8, 4.1], [0.0, -4.6, 3.4], [0.0, -2.6, 2.85], [0.0, 0.0, 2.95],
                   [0.0, 2.2, 2.7], [-0.1, 4.6, 2.0], [0.3, 7.0, 1.35], [0.9, 9.2, 1.15]], 24)  # fmt: skip
    step = np.concatenate([[0.0], np.cumsum(np.sqrt((np.diff(spine, axis=0) ** 2).sum(axis=1)))])
    count = 78
    at = np.interp(np.linspace(0.0, step[-1], count), step, np.arange(len(spine), dtype=np.float64))
    place = np.stack([np.interp(at, np.arange(len(spine)), column) for column in spine.T], axis=1)
    along = unit(np.gradient(place, axis=0))
    size = np.interp(place[:, 1], [-8.6, -3.0, 0.0, 2.0, 5.0, 9.2], [0.10, 0.19, 0.25, 0.25, 0.15, 0.03])
    share = max(40, triangles // (3 * count))
    vertebra = joined([cushion((0.9, 0.85, 0.75), share // 2, 0.8), shifted(cushion((0.35, 0.12, 1.0), share // 4, 0.8),
                       (0.2, 0.0, 1.2)), cushion((0.25, 1.7, 0.18), share // 4, 0.8)])  # fmt: skip
    up = unit(Z - (along * Z).sum(axis=1, keepdims=True) * along)
    frame = np.stack([along, np.cross(up, along), up], axis=2) * size[:, None, None]
    bones = np.einsum("nij,vj->nvi", frame, vertebra[0]) + place[:, None]
    made = [part(f"{name} vertebrae", (bone, whole((bones, vertebra[1]))), smooth=True)]
    body = np.flatnonzero((place[:, 1] > -2.8) & (place[:, 1] < 1.6))
    t = np.linspace(0.0, 1.0, max(5, round(triangles / (6 * 12 * len(body)))))
    bulge = np.interp(place[body, 1], [-2.8, -1.0, 1.6], [0.75, 1.0, 0.7])[:, None]
    ribs = []
    for side in (-1.0, 1.0):
        x = side * bulge * 0.95 * np.sin(2.5 * t) ** 0.8
        z = place[body, 2:] + 0.1 - bulge * 1.75 * (0.5 - 0.5 * np.cos(2.5 * t))
        path = np.stack([place[body, :1] + x, place[body, 1:2] + 0.25 * t, z], axis=2)
        ribs.append(whole(sweeps(path, ring(1.0, 6), Y, 0.055 * (1.15 - 0.6 * t))))
    made.append(part(f"{name} ribs", (bone, joined(ribs)), smooth=True))
    legs = []
    for y, high, out in ((-2.4, 2.3, 0.72), (1.3, 2.6, 0.62)):
        for side in (-1.0, 1.0):
            swing = 0.35 * side * (1.0 if y < 0 else -1.0)
            hip, knee = (side * 0.5, y, high), (side * (out + 0.1), y - 0.15 + swing, 0.55 * high)
            ankle = (side * out, y + swing + 0.1, 0.28)
            legs += [_bone(hip, knee, 0.17, triangles // 60), _bone(knee, ankle, 0.125, triangles // 60)]
            legs += [
                _bone(ankle, (side * (out + s), y + swing - 0.3, 0.06), 0.075, triangles // 200) for s in (-0.1, 0, 0.1)
            ]
    for side in (-1.0, 1.0):
        blade = cushion((0.05, 0.5, 0.42), triangles // 60, 0.9)
        legs += [shifted(blade, (side * 0.5, 1.35, 2.75)), shifted(blade, (side * 0.62, -2.3, 2.5))]
    made.append(part(f"{name} limbs", (bone, joined(legs)), smooth=True))
    head = place[0] + np.array([0.0, -0.25, 0.0])
    skull = [shifted(cushion((0.13, 0.32, 0.12), triangles // 30, 0.85), head + np.array([0.0, -0.1, 0.05]))]
    skull.append(shifted(cushion((0.10, 0.28, 0.04), triangles // 40, 0.85), head + np.array([0.0, -0.12, -0.14])))
    x = np.linspace(-0.08, 0.08, 14)
    tip = np.stack([x, np.full_like(x, -0.42) + 3.0 * x * x, np.full_like(x, -0.03)], axis=1) + head
    teeth = np.stack([tip, tip - 0.06 * Z], axis=1)
    skull.append(whole(sweeps(teeth, ring(0.008, 5), Y, np.array([1.0, 0.4]))))
    made.append(part(f"{name} skull", (bone, joined(skull)), smooth=True))
    posts = place[np.searchsorted(place[:, 1], np.array([-7.0, -4.4, -2.2, 1.4, 4.5, 7.0]))]
    foot = np.stack([posts * np.array([1.0, 1.0, 0.0]), posts], axis=1)
    rods = whole(sweeps(foot, ring(0.025, 8), X))
    made.append(part(f"{name} irons", (iron, rods)))
    return made


def _bone(start: Sequence[float], end: Sequence[float], thick: float, triangles: int) -> Solid:
    """Return a long bone, thicker at its ends."""
    pieces = max(6, round(float(np.sqrt(triangles / 2.0))))
    a, b = np.asarray(start, np.float64), np.asarray(end, np.float64)
    t = np.linspace(0.0, 1.0, pieces + 1)
    scale = thick * (0.62 + 0.5 * (2.0 * t - 1.0) ** 4) * np.sqrt(np.maximum(1.0 - (2.0 * t - 1.0) ** 16, 0.0))
    path = (a + t[:, None] * (b - a))[None]
    return clean(whole(sweeps(path, ring(1.0, pieces), np.array([0.3, 1.0, 0.1]), scale[None])))


def ammonite(name: str, *, triangles: int, shell: int) -> SceneObject:
    """Coil a fossil 0.3 m across that lies on its side."""
    pieces = max(24, round(triangles / 20.0))
    t = np.linspace(0.0, 1.0, pieces)
    r = 0.15 * np.exp(1.9 * (t - 1.0))
    a = 7.0 * np.pi * t
    path = np.stack([r * np.cos(a), r * np.sin(a), np.full_like(t, 0.03)], axis=1)[None]
    scale = 0.30 * r * (1.0 + 0.07 * np.sin(24.0 * a))
    return part(name, (shell, whole(sweeps(path, ring(1.0, 10), Z, scale[None]))), smooth=True)


def crystals(seed: int, name: str, *, triangles: int, mineral: int) -> SceneObject:
    """Grow a druse of six-sided crystals."""
    rng = generator(seed, name)
    count = max(4, triangles // 18)
    crystal, faces = lathe([[0.0, 0.0], [0.03, 0.0], [0.03, 0.0], [0.026, 0.16], [0.026, 0.16], [0.0, 0.21]], 6)
    lean = unit(rng.normal(size=(count, 3)) * 0.55 + Z)
    side = unit(np.cross(lean, rng.normal(size=(count, 3))))
    frame = np.stack([side, np.cross(lean, side), lean], axis=2) * rng.uniform(0.35, 1.1, (count, 1, 1))
    where, away = GOLDEN_ANGLE * np.arange(count), 0.13 * np.sqrt((np.arange(count) + 0.5) / count)
    foot = np.stack([away * np.cos(where), away * np.sin(where), np.zeros(count)], axis=1)
    grown = np.einsum("nij,vj->nvi", frame, crystal) + foot[:, None]
    return part(name, (mineral, whole((grown, faces))))


def case(name: str, *, wood: int, brass: int, lining: int) -> SceneObject:
    """Build a table case 2 m long; its panes are left out, because no material here transmits light."""
    low = [[-1.0, -0.4, 0.62], [-1.0, -0.4, 0.8], [-1.0, 0.36, 0.8], [-1.0, -0.36, 0.8], [0.96, -0.36, 0.8]]
    high = [[1.0, 0.4, 0.8], [1.0, -0.36, 0.86], [1.0, 0.4, 0.86], [-0.96, 0.36, 0.86], [1.0, 0.36, 0.86]]
    body = whole(boxes(low, high))
    legs = np.array([[[x, y, 0.0], [0.97 * x, 0.97 * y, 0.62]] for x in (-0.92, 0.92) for y in (-0.33, 0.33)])
    corner = np.array([[-0.98, -0.38], [0.98, -0.38], [0.98, 0.38], [-0.98, 0.38]])
    posts = np.stack([np.column_stack([corner, np.full(4, 0.86)]), np.column_stack([corner, np.full(4, 1.22)])], axis=1)
    after = np.roll(corner, -1, axis=0)
    rails = np.stack([np.column_stack([corner, np.full(4, 1.22)]), np.column_stack([after, np.full(4, 1.22)])], axis=1)
    frame = joined([whole(sweeps(posts, bar(0.02, 0.02), X)), whole(sweeps(rails, bar(0.02, 0.02), Z))])
    felt = whole(boxes([[-0.955, -0.355, 0.8]], [[0.955, 0.355, 0.812]]))
    timber = joined([body, whole(sweeps(legs, bar(0.07, 0.07), Y))])
    return part(name, (wood, timber), (brass, frame), (lining, felt))


def bench(name: str, *, wood: int, leather: int, triangles: int) -> SceneObject:
    """Build an upholstered bench 1.8 m long."""
    seat = shifted(cushion((0.3, 0.9, 0.07), triangles, 0.3), (0.0, 0.0, 0.42))
    legs = np.array([[[x, y, 0.0], [x, y, 0.38]] for x in (-0.22, 0.22) for y in (-0.75, 0.75)])
    frame = joined(
        [whole(sweeps(legs, bar(0.06, 0.06), Y)), whole(boxes([[-0.27, -0.85, 0.33]], [[0.27, 0.85, 0.38]]))]
    )
    return SceneObject(name, (mesh(seat, leather, smooth=True), mesh(frame, wood)))


def barrier(name: str, *, brass: int, rope: int, length: float, triangles: int) -> SceneObject:
    """Build a post, with a rope that hangs from it to where the next one stands, along y."""
    sides = max(8, round(float(np.sqrt(triangles))))
    post = lathe([[0.16, 0.0], [0.16, 0.02], [0.03, 0.05], [0.022, 0.1], [0.022, 0.92], [0.04, 0.93], [0.045, 0.97],
                  [0.03, 1.0], [0.0, 1.01]], sides)  # fmt: skip
    t = np.linspace(0.0, 1.0, sides)
    path = np.stack([0.0 * t, length * t, 0.9 - 0.9 * t * (1.0 - t)], axis=1)[None]
    return part(name, (brass, post), (rope, whole(sweeps(path, ring(0.02, 8), Z))), smooth=True)


def pedestal(name: str, *, height: float, width: float, stone: int) -> SceneObject:
    """Build a square pedestal with a plinth and a cornice."""
    h = 0.5 * width
    steps = [(1.2, 0.0, 0.10), (1.1, 0.10, 0.16), (0.92, 0.16, height - 0.14), (1.05, height - 0.14, height - 0.08),
             (1.15, height - 0.08, height)]  # fmt: skip
    low = [[-s * h, -s * h, a] for s, a, _ in steps]
    high = [[s * h, s * h, b] for s, _, b in steps]
    return part(name, (stone, whole(boxes(low, high))))
