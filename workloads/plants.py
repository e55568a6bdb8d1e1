"""Plants and rocks as triangle meshes, from a few hundred lines and a seed.

Every kind is made of three shapes: *fronds* (a rib with leaflets on both sides, which is also a leaf, a petal, a blade
of grass or a branch of a fir), *tubes* (stems) and *blobs* (rocks and fruit). Each builder takes the number of
triangles to aim at, so that one species serves as a hero of thousands of triangles and as a speck on a far hill:
production scenes are as skewed. Objects stand on the origin, z up, in metres; where triangles are few, leaves get
larger, so that a crown stays as dense.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from simrender.rays.scene import Mesh, SceneObject
from workloads.terrain import F64, I64, generator, grid_faces, unit

Part = tuple[F64, I64]  # vertices (n, 3) and faces (m, 3)

UP = np.array([0.0, 0.0, 1.0])
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def fronds(
    root: F64,
    forward: F64,
    up: F64,
    length: F64,
    width: F64,
    *,
    leaflets: int = 1,
    droop: F64 | float = 0.0,
    fold: float = 0.2,
    sweep: float = 0.3,
    peak: float = 0.5,
) -> Part:
    """Return ribs with triangular leaflets on both sides: 2 ``leaflets`` triangles each; one makes a plain leaf.

    Parameters
    ----------
    root, forward, up : float64 arrays (n, 3)
        Where the rib starts, where it heads, and what its upper side faces; ``up`` may be one vector for all.
    length, width : float64 arrays (n,)
        Of the rib, and of the longest leaflet.
    leaflets : int
        On each side.
    droop : float64 array (n,) or float
        How far the tip sinks below a straight rib, in lengths.
    fold, sweep : float
        How far leaflets bend away from the upper side, and lean towards the tip, in widths.
    peak : float
        Where on the rib, from 0 to 1, leaflets are longest.

    """
    t = np.arange(leaflets + 1) / leaflets
    middle = (t[1:] + t[:-1]) / 2
    shape = np.interp(middle, [0.0, peak, 1.0], [0.35, 1.0, 0.15]) if leaflets > 1 else np.ones(1)
    side = unit(np.cross(forward, up))
    above = np.cross(side, forward)
    sag = np.broadcast_to(droop, length.shape) * length

    def rib(at: F64) -> F64:
        points = root[:, None] + (length[:, None] * at)[:, :, None] * forward[:, None]
        points[:, :, 2] -= sag[:, None] * at * at
        return points

    reach = (width[:, None] * shape)[:, :, None]
    centre = rib(middle) + reach * (sweep * forward - fold * above)[:, None]
    tip = reach * side[:, None]
    vertices = np.concatenate([rib(t), centre + tip, centre - tip], axis=1)
    a, m = np.arange(leaflets), leaflets
    one = np.concatenate([np.stack([a, m + 1 + a, a + 1], 1), np.stack([a, a + 1, 2 * m + 1 + a], 1)])
    faces = one[None] + (3 * m + 1) * np.arange(len(root))[:, None, None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def dyed(part: Part, tone: I64, materials: Sequence[int]) -> list[tuple[int, Part]]:
    """Divide the fronds of a part among materials: frond i gets ``materials[tone[i]]``."""
    vertices, one = part[0].reshape(len(tone), -1, 3), part[1][: len(part[1]) // len(tone)]
    parts = []
    for index, material in enumerate(materials):
        chosen = vertices[tone == index]
        faces = one[None] + vertices.shape[1] * np.arange(len(chosen))[:, None, None]
        parts.append((material, (chosen.reshape(-1, 3), faces.reshape(-1, 3))))
    return parts


def tubes(paths: F64, radii: F64, sides: int) -> Part:
    """Return tubes without caps along paths (n, k, 3) with radii (n, k): 2 (k - 1) ``sides`` triangles each."""
    n, k = radii.shape
    along = unit(paths[:, -1] - paths[:, 0])
    helper = np.where(np.abs(along[:, 2:]) > 0.8, np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    a = unit(np.cross(along, helper))
    b = np.cross(along, a)
    angle = 2.0 * np.pi * np.arange(sides + 1) / sides
    ring = np.cos(angle)[:, None] * a[:, None] + np.sin(angle)[:, None] * b[:, None]
    ring[:, -1] = ring[:, 0]
    vertices = paths[:, :, None] + radii[:, :, None, None] * ring[:, None]
    faces = grid_faces(k - 1, sides)[None] + k * (sides + 1) * np.arange(n)[:, None, None]
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def blob(rng: np.random.Generator, radii: Sequence[float], triangles: int, rough: float) -> Part:
    """Return a lumpy ellipsoid of about that many triangles, around the origin."""
    rings = max(3, round(float(np.sqrt(triangles / 4.0))) + 1)
    segments = max(4, round(triangles / (2 * (rings - 1))))
    theta = np.pi * np.arange(1, rings) / rings
    phi = 2.0 * np.pi * (np.arange(segments) + 0.5 * (np.arange(1, rings) % 2)[:, None]) / segments
    height = np.broadcast_to(np.cos(theta)[:, None], phi.shape)
    ring = np.sin(theta)[:, None] * np.stack([np.cos(phi), np.sin(phi)])
    directions = np.concatenate([np.stack([*ring, height], axis=2).reshape(-1, 3), [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]])
    lumps = np.zeros(len(directions))
    for wave in range(5):
        toward = unit(rng.normal(size=3)) * 1.7 * 1.5**wave
        phase = (directions * toward).sum(axis=1) + rng.uniform(0.0, 6.3)
        lumps += (np.abs(np.sin(phase)) - 0.6) / 1.35**wave  # absolute values crease the surface as rock does
    vertices = directions * (1.0 + rough * lumps)[:, None] * np.asarray(radii)
    band = grid_faces(rings - 2, segments)
    band = band // (segments + 1) * segments + band % (segments + 1) % segments  # the last column is the first again
    first = np.arange(segments)
    after, last = (first + 1) % segments, (rings - 2) * segments
    north = np.stack([first, after, np.full(segments, len(vertices) - 2)], 1)
    south = np.stack([last + after, last + first, np.full(segments, len(vertices) - 1)], 1)
    return vertices, np.concatenate([band[:, ::-1], north, south])


def assemble(name: str, parts: Iterable[tuple[int, Part]]) -> SceneObject:
    """Return the object of these (material, part) pairs: one mesh for each material."""
    of: dict[int, list[Part]] = {}
    for material, part in parts:
        if len(part[1]):
            of.setdefault(material, []).append(part)
    meshes = []
    for material, pieces in of.items():
        shift = np.cumsum([0] + [len(vertices) for vertices, _ in pieces])
        vertices = np.concatenate([v for v, _ in pieces]).astype(np.float32)
        faces = np.concatenate([f + s for (_, f), s in zip(pieces, shift[:-1], strict=True)])
        meshes.append(Mesh(vertices, faces.astype(np.int32), material))
    return SceneObject(name, tuple(meshes))


def _foliage(
    rng: np.random.Generator, centre: F64, radii: F64, leaves: int, tones: Sequence[int]
) -> list[tuple[int, Part]]:
    """Return leaves on the upper shells of ellipsoidal clumps (n, 3), dark tones first: below, inside and by chance."""
    clump = rng.choice(len(centre), leaves, p=radii.prod(axis=1) ** (2 / 3) / (radii.prod(axis=1) ** (2 / 3)).sum())
    outward = unit(rng.normal(size=(leaves, 3)) + 0.25 * UP)
    depth = rng.uniform(0.74, 1.04, leaves)
    root = centre[clump] + radii[clump] * outward * depth[:, None]
    normal = unit(outward + 0.32 * rng.normal(size=(leaves, 3)))
    forward = unit(np.cross(normal, rng.normal(size=(leaves, 3))) - 0.35 * UP)
    area = float((radii[:, 0] * radii[:, 1] + 2.0 * radii[:, 0] * radii[:, 2]).sum()) * 4.2
    slim, cover = 0.36, 0.38 + 0.9 * np.exp(-leaves / 500.0)  # many leaves also cover by lying behind each other
    length = np.sqrt(cover * area / (leaves * 2.0 * slim)) * rng.uniform(0.75, 1.25, leaves)
    low, high = centre[:, 2].min() - radii[:, 2].max(), centre[:, 2].max() + radii[:, 2].max()
    light = (root[:, 2] - low) / (high - low) * 0.7 + (depth - 0.74) * 0.9 + rng.uniform(-0.18, 0.18, leaves)
    tone = np.clip(light * len(tones), 0, len(tones) - 1).astype(np.int64)
    start = root - 0.5 * length[:, None] * forward
    return dyed(fronds(start, forward, normal, length, slim * length, sweep=0.0), tone, tones)


def broadleaf(
    seed: int,
    name: str,
    *,
    triangles: int,
    height: float,
    bark: int,
    leaves: Sequence[int],
    spread: float = 0.34,
    bare: float = 0.28,
) -> SceneObject:
    """Build a tree of branches with clumps of leaves at their ends.

    Parameters
    ----------
    seed : int
    name : str
    triangles : int
        Number of triangles to aim at.
    height : float
    bark : int
        Material of the wood.
    leaves : sequence of int
        Materials of the leaves, darkest first.
    spread : float
        Radius of the crown in heights.
    bare : float
        Height of the trunk below the crown, in heights.

    """
    rng = generator(seed, name)
    limbs, sides = int(np.clip(triangles / 60, 4, 26)), int(np.clip(triangles / 300, 3, 7))
    crown = np.array([spread, spread, 0.5 * (1.0 - bare)]) * height
    middle = np.array([0.0, 0.0, height - crown[2]])
    # Fibonacci directions spread the clumps evenly; the lowest are left out, where a crown is hollow.
    z = 1.0 - 1.55 * (np.arange(limbs) + 0.5) / limbs
    around = GOLDEN_ANGLE * np.arange(limbs) + rng.uniform(0.0, 6.3)
    ring = np.sqrt(1.0 - z * z)
    direction = np.stack([ring * np.cos(around), ring * np.sin(around), z], axis=1) + 0.18 * rng.normal(size=(limbs, 3))
    centre = middle + 0.62 * crown * direction
    size = 1.05 * limbs ** (-1.0 / 3.0) * rng.uniform(0.75, 1.2, limbs)
    radii = crown * np.minimum(size, 0.6)[:, None] * np.array([1.0, 1.0, 0.85])

    rise = np.array([-0.03, 0.06, 0.35, 0.72, 1.0])
    top = np.array([0.0, 0.0, height * (bare + 0.55 * (1.0 - bare))])
    trunk = rise[:, None] * top + 0.02 * height * rise[:, None] * rng.normal(size=(5, 3)) * np.array([1.0, 1.0, 0.0])
    thick = 0.028 * height * np.array([1.7, 1.15, 0.85, 0.6, 0.25])
    parts = [(bark, tubes(trunk[None], thick[None], sides))]
    if triangles > 150:
        at = rng.uniform(0.55, 0.95, limbs)
        start = np.stack([np.interp(at, rise, trunk[:, axis]) for axis in range(3)], axis=1)
        taper = 0.011 * height * np.array([1.0, 0.7, 0.25])
        paths = np.stack([start, (start + centre) / 2 - 0.03 * height * UP, centre], axis=1)
        parts.append((bark, tubes(paths, np.broadcast_to(taper, (limbs, 3)), max(3, sides - 2))))
    left = max(triangles - sum(len(part[1]) for _, part in parts), 12)
    return assemble(name, parts + _foliage(rng, centre, radii, left // 2, leaves))


def conifer(
    seed: int, name: str, *, triangles: int, height: float, bark: int, leaves: Sequence[int], spread: float = 0.22
) -> SceneObject:
    """Build a spruce: whorls of drooping branches, shorter towards the top; parameters as in `broadleaf`."""
    rng = generator(seed, name)
    trunk = np.array([[0.0, 0.0, -0.03], [0.0, 0.0, 0.5], [0.0, 0.0, 0.99]]) * height
    sides = int(np.clip(triangles / 300, 3, 6))
    parts = [(bark, tubes(trunk[None], 0.016 * height * np.array([[1.4, 0.7, 0.1]]), sides))]
    leaflets = max(1, round((triangles / 110.0) ** 0.6))
    count = max((triangles - 4 * sides) // (2 * leaflets), 8)
    rise = 1.0 - (np.arange(count) + 0.5) / count
    at = np.minimum(1.0 - 0.92 * rise**1.08 + rng.uniform(-0.012, 0.012, count), 1.0)
    angle = GOLDEN_ANGLE * np.arange(count) + rng.uniform(-0.2, 0.2, count)
    pitch = -0.28 + 0.75 * at**2 + rng.uniform(-0.08, 0.08, count)
    forward = unit(np.stack([np.cos(angle), np.sin(angle), pitch], axis=1))
    length = height * (spread * (1.0 - at) ** 0.85 * rng.uniform(0.8, 1.15, count) + 0.03)
    root = np.stack([np.zeros(count), np.zeros(count), at * height], axis=1)
    width = length * np.interp(leaflets, [1, 3, 6], [0.5, 0.42, 0.34])
    tone = np.clip((at * 0.6 + rng.uniform(0.0, 0.6, count)) * len(leaves), 0, len(leaves) - 1).astype(np.int64)
    needles = fronds(root, forward, UP, length, width, leaflets=leaflets, droop=0.14, fold=0.3, peak=0.35)
    return assemble(name, parts + dyed(needles, tone, leaves))


def palm(
    seed: int,
    name: str,
    *,
    triangles: int,
    height: float,
    bark: int,
    leaves: Sequence[int],
    lean: float = 0.15,
    fruit: int | None = None,
) -> SceneObject:
    """Build a coconut palm; parameters as in `broadleaf`.

    ``lean`` is how far the top bends to the side, in heights; ``fruit`` is the material of the nuts.
    """
    rng = generator(seed, name)
    sides = int(np.clip(triangles / 160, 4, 8))
    t = np.linspace(0.0, 1.0, int(np.clip(triangles / 120, 4, 9)))
    path = np.stack([lean * t**2, 0.04 * np.sin(4.0 * t), 1.02 * t - 0.02], axis=1) * height
    thick = height * 0.017 * (0.75 + 0.9 * np.exp(-9.0 * t)) * (1.0 + 0.06 * (-1.0) ** np.arange(len(t)))
    parts = [(bark, tubes(path[None], thick[None], sides))]
    crown = path[-1]
    if fruit is not None and triangles > 150:
        for angle in 2.1 * np.arange(4):
            vertices, faces = blob(rng, (0.15, 0.15, 0.18), 24, 0.02)
            parts.append((fruit, (vertices + crown + 0.26 * np.array([np.cos(angle), np.sin(angle), -0.9]), faces)))
    count = int(np.clip(triangles / 45, 9, 28))
    leaflets = max(1, (triangles - sum(len(part[1]) for _, part in parts)) // (2 * count))
    age = (np.arange(count) + 0.5) / count  # the youngest fronds stand upright, the oldest hang
    angle = GOLDEN_ANGLE * np.arange(count) + rng.uniform(-0.2, 0.2, count)
    pitch = np.interp(age, [0.0, 0.3, 1.0], [1.9, 0.65, -0.3]) + rng.uniform(-0.1, 0.1, count)
    forward = unit(np.stack([np.cos(angle), np.sin(angle), pitch], axis=1))
    length = (1.5 + 0.24 * height) * rng.uniform(0.88, 1.1, count)
    width = length * (0.22 if leaflets > 5 else 0.14)
    droop = 0.3 + 0.35 * age
    tone = ((1.0 - age) * len(leaves)).astype(np.int64)
    root = np.tile(crown, (count, 1))
    blades = fronds(root, forward, UP, length, width, leaflets=leaflets, droop=droop, fold=0.35, sweep=0.35, peak=0.4)
    return assemble(name, parts + dyed(blades, tone, leaves))


def shrub(
    seed: int, name: str, *, triangles: int, size: float, leaves: Sequence[int], blossom: int | None = None
) -> SceneObject:
    """Build a bush of leafy clumps ``size`` metres across, with a sixth of its leaves as blossoms if asked for."""
    rng = generator(seed, name)
    clumps = int(np.clip(triangles / 60, 2, 6))
    centre = rng.normal(size=(clumps, 3)) * np.array([0.2, 0.2, 0.06]) * size + np.array([0.0, 0.0, 0.25 * size])
    radii = size * rng.uniform(0.24, 0.36, (clumps, 1)) * np.array([1.0, 1.0, 0.8])
    blooms = triangles // 12 if blossom is not None else 0
    parts = _foliage(rng, centre, radii, max(triangles // 2 - blooms, 6), leaves)
    if blossom is not None:
        k = rng.integers(0, clumps, blooms)
        outward = unit(rng.normal(size=(blooms, 3)) + 0.6 * UP)
        forward = unit(np.cross(outward, rng.normal(size=(blooms, 3))))
        length = 0.09 * size * np.ones(blooms)
        petals = fronds(centre[k] + 1.06 * radii[k] * outward, forward, outward, length, 0.5 * length, fold=-0.2)
        parts.append((blossom, petals))
    return assemble(name, parts)


def rosette(
    seed: int,
    name: str,
    *,
    triangles: int,
    size: float,
    leaves: Sequence[int],
    blades: int = 9,
    slim: float = 0.22,
    pitch: float = 0.9,
    droop: float = 0.45,
    clump: float = 0.0,
) -> SceneObject:
    """Build leaves that spring from the ground: a fern, a tuft of grass, reeds or a banana plant.

    Parameters
    ----------
    seed, name, triangles, leaves
        As in `broadleaf`; the materials are taken in turn.
    size : float
        Length of the longest leaf.
    blades : int
        Number of leaves; each gets an equal share of the triangles as its leaflets.
    slim : float
        Half width of a leaf over its length.
    pitch : float
        Steepness of the leaves at their roots; 1 is 45 degrees.
    droop : float
        How far tips hang, in lengths.
    clump : float
        Radius of the patch that the leaves spring from.

    """
    rng = generator(seed, name)
    leaflets = max(1, triangles // (2 * blades))
    blades = min(blades, max(3, triangles // 2))
    angle = GOLDEN_ANGLE * np.arange(blades) + rng.uniform(-0.4, 0.4, blades)
    steep = pitch * rng.uniform(0.6, 1.5, blades)
    forward = unit(np.stack([np.cos(angle), np.sin(angle), steep], axis=1))
    radius = clump * np.sqrt(rng.random(blades))
    where = rng.uniform(0.0, 6.3, blades)
    root = np.stack([radius * np.cos(where), radius * np.sin(where), np.full(blades, -0.02 * size)], axis=1)
    length = size * rng.uniform(0.65, 1.0, blades)
    shape = fronds(
        root, forward, UP, length, slim * length, leaflets=leaflets, droop=droop, fold=0.15, sweep=0.2, peak=0.35
    )
    return assemble(name, dyed(shape, np.arange(blades) % len(leaves), leaves))


def flower(
    seed: int, name: str, *, triangles: int, size: float, green: int, petal: int, heart: int, patch: float = 0.35
) -> SceneObject:
    """Build a patch of flowers ``size`` metres tall: a stem, a leaf, five petals and a heart each, 18 triangles."""
    rng = generator(seed, name)
    count = max(1, triangles // 18)
    where, radius = rng.uniform(0.0, 6.3, count), patch * np.sqrt(rng.random(count))
    foot = np.stack([radius * np.cos(where), radius * np.sin(where), np.full(count, -0.03)], axis=1)
    forward = unit(0.18 * rng.normal(size=(count, 3)) + UP)
    tall = size * rng.uniform(0.7, 1.1, count)
    side = unit(np.cross(forward, rng.normal(size=(count, 3))))
    stems = fronds(foot, forward, side, tall, np.full(count, 0.012), sweep=0.0)
    blades = fronds(foot, unit(side + forward), forward, 0.6 * tall, 0.07 * tall, droop=0.3)
    head = foot + forward * tall[:, None]
    other = np.cross(forward, side)
    turn = 2.0 * np.pi * np.arange(5) / 5
    out = np.cos(turn)[:, None] * side[:, None] + np.sin(turn)[:, None] * other[:, None]
    out = unit(out + 0.35 * forward[:, None]).reshape(-1, 3)
    long, wide = np.full(5 * count, 0.16 * size), np.full(count, 0.1 * size)
    petals = fronds(np.repeat(head, 5, axis=0), out, np.repeat(forward, 5, axis=0), long, 0.45 * long, fold=-0.1)
    hearts = [
        (heart, fronds(head + 0.03 * forward - 0.05 * size * axis, axis, forward, wide, 0.5 * wide))
        for axis in (side, other)
    ]
    return assemble(name, [(green, stems), (green, blades), (petal, petals), *hearts])


def rock(seed: int, name: str, *, triangles: int, size: float, stone: int, flat: float = 0.7) -> SceneObject:
    """Build a boulder about ``size`` metres across and ``flat`` times as high, a third of it in the ground."""
    rng = generator(seed, name)
    radii = 0.5 * size * np.array([1.0, rng.uniform(0.65, 0.95), flat])
    vertices, faces = blob(rng, tuple(radii.tolist()), triangles, 0.27)
    return assemble(name, [(stone, (vertices + np.array([0.0, 0.0, 0.3 * flat * size]), faces))])


def log(seed: int, name: str, *, triangles: int, size: float, bark: int) -> SceneObject:
    """Build a fallen trunk ``size`` metres long with a few broken branches."""
    rng = generator(seed, name)
    sides = int(np.clip(triangles / 10, 4, 14))
    x = np.linspace(-0.5, 0.5, 5) * size
    path = np.stack([x, 0.03 * size * np.sin(3.0 * x / size), np.full(5, 0.05 * size)], axis=1)
    thick = 0.06 * size * np.array([0.02, 1.0, 0.92, 0.8, 0.02])
    path[0, 0], path[4, 0] = path[1, 0] - 0.02 * size, path[3, 0] + 0.02 * size
    start = path[rng.integers(1, 4, 3)]
    end = start + 0.16 * size * unit(rng.normal(size=(3, 3)) * np.array([0.6, 1.0, 0.2]) + np.array([0.5, 0.0, 0.35]))
    stubs = tubes(np.stack([start, end], axis=1), np.broadcast_to(0.02 * size * np.array([1.0, 0.4]), (3, 2)), 3)
    return assemble(name, [(bark, tubes(path[None], thick[None], sides)), (bark, stubs)])
