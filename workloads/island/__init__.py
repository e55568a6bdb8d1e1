"""A stand-in for Disney's Moana island: a volcanic island in a lagoon, seen from low over the water.

The original (ray queue cycling paper, figure 1) has nearly 600 M triangles before instancing and 31 M instances. This
one has the same make-up at a size that a laptop traces in seconds: a ground and a sea object of many meshes each, palms
and jungle by instancing, a mirror-like sea, and lights of very different power and size: the sun, a lantern, and two
fires and a lamp that are area lights.
"""

from __future__ import annotations

import math

import numpy as np

from simrender.rays.scene import IDENTITY, Environment, Material, PointLight, Scene, SceneObject
from workloads.plants import assemble, blob, broadleaf, fronds, log, palm, rock, rosette, shrub, tubes
from workloads.terrain import (
    F64,
    I64,
    Kind,
    Noise,
    Placed,
    Terrain,
    generator,
    graded_axis,
    grow,
    instances,
    stand,
    tiles,
    unit,
)
from workloads.terrain import smoothstep as step

VIEWPOINT = (0.0, -62.0)
EYE = 2.4  # height of the viewpoint, which the sea is tessellated for
SEA_RADIUS = 900.0
SHORE = (-75.0, 75.0, -30.0, 60.0)
JUNGLE = (-190.0, 190.0, 0.0, 300.0)
SUN = (-4200.0, -3300.0, 3400.0)
SUN_IRRADIANCE = (3.5, 3.05, 2.4)

PALETTE = {
    "wet sand": Material((0.36, 0.28, 0.18)),
    "sand": Material((0.62, 0.52, 0.36)),
    "soil": Material((0.17, 0.14, 0.07)),
    "undergrowth": Material((0.12, 0.20, 0.04)),
    "ridge green": Material((0.16, 0.26, 0.05)),
    "basalt": Material((0.19, 0.175, 0.155)),
    "deep sea": Material((0.20, 0.45, 0.57), mirror=0.66),
    "blue lagoon": Material((0.22, 0.51, 0.60), mirror=0.56),
    "lagoon": Material((0.24, 0.57, 0.61), mirror=0.46),
    "green lagoon": Material((0.30, 0.62, 0.61), mirror=0.36),
    "shallows": Material((0.40, 0.67, 0.61), mirror=0.28),
    "foam": Material((0.82, 0.84, 0.83)),
    "palm bark": Material((0.30, 0.24, 0.17)),
    "bark": Material((0.17, 0.12, 0.08)),
    "dead frond": Material((0.27, 0.21, 0.10)),
    "palm": Material((0.19, 0.32, 0.06)),
    "palm light": Material((0.31, 0.43, 0.09)),
    "coconut": Material((0.20, 0.14, 0.06)),
    "jungle dark": Material((0.06, 0.135, 0.035)),
    "jungle": Material((0.10, 0.21, 0.045)),
    "jungle light": Material((0.18, 0.31, 0.06)),
    "banana": Material((0.20, 0.36, 0.06)),
    "olive": Material((0.20, 0.24, 0.08)),
    "beach grass": Material((0.33, 0.34, 0.13)),
    "hibiscus": Material((0.70, 0.05, 0.09)),
    "frangipani": Material((0.83, 0.78, 0.62)),
    "yolk": Material((0.78, 0.55, 0.05)),
    "driftwood": Material((0.42, 0.37, 0.30)),
    "flame": Material((0.9, 0.6, 0.3), emission=(20.0, 8.0, 2.0)),
    "lamp": Material((0.9, 0.8, 0.6), emission=(30.0, 22.0, 12.0)),
}
INDEX = {name: index for index, name in enumerate(PALETTE)}
SEA = ("foam", "shallows", "green lagoon", "lagoon", "blue lagoon", "deep sea")  # as it gets deeper
PALM = (INDEX["dead frond"], *[INDEX["palm"]] * 5, *[INDEX["palm light"]] * 5)
TREE = (INDEX["jungle dark"], INDEX["jungle"], INDEX["jungle light"])
PALE = (INDEX["jungle"], INDEX["olive"], INDEX["jungle light"])


def island(*, seed: int = 1, detail: float = 1.0) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    seed : int
    detail : float
        Factor on the triangles of every object and, as in the ray queue cycling paper's section 5.2, on the number of
        instances: instanced triangles grow with its square.

    Returns
    -------
    Scene
        About 0.7 M instanced triangles at ``detail=1``. z is up, units are metres; meant to be seen from
        (0, -62, 2.4), towards positive y.

    """
    fine = float(np.sqrt(detail))
    terrain = _volcano(seed, max(16, round(115 * fine)))
    lantern, lights = _lights(seed, terrain)
    placed = [
        (terrain.ground(_cover(seed, terrain)), IDENTITY[None]),
        (_sea(seed, terrain, fine), IDENTITY[None]),
        *lights,
        *grow(seed, detail, terrain, _kinds(seed)),
    ]
    things, instance_object, instance_transform = instances(placed)
    squared = sum(c * c for c in SUN)
    sun = PointLight(SUN, (SUN_IRRADIANCE[0] * squared, SUN_IRRADIANCE[1] * squared, SUN_IRRADIANCE[2] * squared))
    sky = Environment(zenith=(0.12, 0.31, 0.78), horizon=(0.66, 0.81, 0.94), ground=(0.05, 0.14, 0.20))
    return Scene(things, instance_object, instance_transform, tuple(PALETTE.values()), (sun, lantern), sky)


def _volcano(seed: int, cells: int) -> Terrain:
    """Return an island with a bay at the origin, a ridge of eroded peaks behind it, and the bed of the sea."""
    axis_x = graded_axis(-280.0, 280.0, 0.0, 90.0, cells)
    axis_y = graded_axis(-110.0, 330.0, 10.0, 90.0, cells)
    x, y = np.meshgrid(axis_x, axis_y)
    noise = Noise(seed, "island")
    coast = np.hypot((x - 10.0) / 1.35, y - 135.0) + 16.0 * noise(x, y, 70.0, 3)
    inland = 142.0 - coast - 10.0 * np.exp(-((x / 38.0) ** 2) - ((y - 0.0) / 25.0) ** 2)
    z = np.where(inland < 0.0, 0.075 * inland, 0.056 * inland)
    z += 4.0 * step(18.0, 40.0, inland)
    ribs = 1.0 - 2.0 * np.abs(noise(x, y, 62.0, 4, 0.5))  # ridged noise: sharp crests between worn valleys
    z += (30.0 + 40.0 * ribs) * step(35.0, 150.0, inland) * step(320.0, 60.0, np.abs(x - 30.0))
    peak = np.hypot(x - 55.0, y - 165.0)
    z += 36.0 * np.exp(-((peak / 60.0) ** 2)) + 22.0 * np.exp(-((np.hypot(x + 85.0, y - 150.0) / 40.0) ** 2))
    z += 0.14 * noise(x, y, 9.0, 3) * step(-20.0, 5.0, inland)
    return Terrain(axis_x, axis_y, np.maximum(z, -9.0).astype(np.float32).astype(np.float64))


def _cover(seed: int, terrain: Terrain) -> I64:
    """Return the material of each triangle of the ground; noise frays the borders between materials."""
    x, y, z, slope = terrain.facets()
    patch = Noise(seed, "cover")(x, y, 18.0, 4, 0.65) + generator(seed, "fray").uniform(-0.15, 0.15, x.shape)
    material = np.where(patch + 0.01 * z > 0.35, INDEX["ridge green"], INDEX["undergrowth"])
    material[slope + 0.5 * patch > 1.7] = INDEX["basalt"]
    material[z + 1.5 * patch < 2.6] = INDEX["soil"]
    material[z + 0.9 * patch < 1.9] = INDEX["sand"]
    material[z + 0.2 * patch < 0.28] = INDEX["wet sand"]
    return material


def _sea(seed: int, terrain: Terrain, fine: float) -> SceneObject:
    """Return the sea, tessellated in rings and spokes around the viewpoint so that cells look about equally large.

    Production renderers dice displaced surfaces by their size on screen for the same reason. Waves shorter than two
    cells are left out, and the sea calms down towards the shore.
    """
    rings, spokes = max(12, round(130 * fine)), max(16, round(130 * fine))
    # Even steps in the root of the angle below the horizon: between even on screen and even on the water.
    below = np.linspace(math.sqrt(EYE / 5.0), math.sqrt(EYE / SEA_RADIUS), rings) ** 2
    radius = np.concatenate([[1.0], EYE / below])
    # Three quarters of the spokes cover the view of 100 degrees around positive y; the seam lies behind the viewer.
    angle = np.pi * np.interp(np.linspace(0.0, 1.0, spokes + 1), [0.0, 0.125, 0.875, 1.0], [-0.5, 0.22, 0.78, 1.5])
    r, a = np.meshgrid(radius, angle, indexing="ij")
    x, y = VIEWPOINT[0] + r * np.cos(a), VIEWPOINT[1] + r * np.sin(a)
    rng = generator(seed, "waves")
    cell = np.maximum(np.concatenate([[1.0], np.diff(radius)]), 2.3 / spokes * radius)[:, None]
    swell = np.zeros(x.shape)
    for length in 0.3 * 1.17 ** np.arange(24):
        heading, phase = rng.normal(-1.2, 0.7), rng.uniform(0.0, 6.3)
        along = (x * np.cos(heading) + y * np.sin(heading)) * (2.0 * np.pi / length)
        slope = 0.07 / (1.0 + length / 2.0)
        swell += slope * length / (2.0 * np.pi) * step(2.0, 4.0, length / cell) * np.sin(along + phase)
    z = swell * step(0.1, 2.5, -terrain.height(x, y))
    points = np.stack([x, y, z], axis=2)
    points[:, -1] = points[:, 0]
    corner, far = points[:-1, :-1], points[1:, 1:]
    middle = np.stack([corner + far + points[1:, :-1], corner + far + points[:-1, 1:]], axis=2) / 3.0
    depth = -terrain.height(middle[..., 0], middle[..., 1])
    noise = Noise(seed, "lagoon")(middle[..., 0], middle[..., 1], 20.0, 4, 0.6)
    depth += np.clip(0.5 * depth, 0.0, 0.9) * (noise + generator(seed, "spray").uniform(-0.3, 0.3, depth.shape))
    bands = np.array([INDEX[name] for name in SEA])
    return SceneObject("sea", tiles(points, bands[np.digitize(depth, [0.12, 0.7, 1.4, 2.2, 3.2])], (4, 8)))


def _lights(seed: int, terrain: Terrain) -> tuple[PointLight, list[Placed]]:
    """Return a lantern without extent, and the fires and the lamp on the beach, which are area lights."""
    rng = generator(seed, "lights")
    x = np.array([-13.0, 21.0, 4.0])
    row = np.linspace(-40.0, 60.0, 201)
    inland = terrain.height(x[:, None], row[None]) > np.array([[0.7], [0.8], [1.3]])
    y = row[inland.argmax(axis=1)]
    fires = stand(rng, terrain, x[:2], y[:2], scale=(1.3, 1.5))
    lamp = stand(rng, terrain, x[2:], y[2:], scale=(1.0, 1.0))
    fx, fy, fz = fires[0, :, 3].tolist()
    lantern = PointLight((fx - 4.0, fy + 3.0, fz + 2.4), (30.0, 19.0, 9.0))
    return lantern, [(_campfire(seed), fires), (_lamp_post(seed), lamp)]


def _campfire(seed: int) -> SceneObject:
    """Build a cone of flames over crossed logs."""
    rng = generator(seed, "campfire")
    n = 9
    angle = 2.0 * np.pi * np.arange(n) / n
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(n)], axis=1)
    forward = unit(np.array([0.0, 0.0, 1.0]) - 0.25 * ring + 0.1 * rng.normal(size=(n, 3)))
    flames = fronds(0.16 * ring, forward, ring, rng.uniform(0.55, 1.05, n), np.full(n, 0.13), sweep=-0.6)
    ends = np.stack([0.6 * ring[::2], -0.1 * ring[::2] + np.array([0.0, 0.0, 0.35])], axis=1)
    logs = tubes(ends, np.full((len(ends), 2), 0.07), 5)
    return assemble("campfire", [(INDEX["flame"], flames), (INDEX["bark"], logs)])


def _lamp_post(seed: int) -> SceneObject:
    """Build a glowing globe on a post."""
    vertices, faces = blob(generator(seed, "lamp"), (0.2, 0.2, 0.22), 48, 0.0)
    post = tubes(np.array([[[0.0, 0.0, -0.2], [0.0, 0.0, 2.2]]]), np.array([[0.06, 0.05]]), 6)
    return assemble("lamp", [(INDEX["lamp"], (vertices + np.array([0.0, 0.0, 2.4]), faces)), (INDEX["bark"], post)])


def _kinds(seed: int) -> list[Kind]:
    """Return what grows where."""
    thicket = Noise(seed, "thicket")

    def beach(x: F64, y: F64, z: F64, slope: F64) -> F64:
        clump = 0.15 + step(0.0, 0.3, thicket(x, y, 16.0, 2))
        return step(0.7, 1.2, z) * step(3.4, 1.8, z) * clump * step(90.0, 60.0, y)

    def coast(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(1.4, 2.0, z) * step(14.0, 5.0, z) * step(110.0, 60.0, y)

    def fringe(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(1.3, 1.9, z) * step(5.5, 2.5, z) * step(80.0, 50.0, y)

    def strand(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(0.15, 0.4, z) * step(1.8, 1.0, z) * step(0.0, 0.4, thicket(x, y, 12.0, 2))

    def surf(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(-1.4, -0.5, z) * step(1.0, 0.3, z) * step(0.05, 0.4, thicket(x + 50.0, y, 25.0, 2))

    def jungle(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(3.5, 6.5, z) * step(2.2, 1.4, slope) * step(230.0, 140.0, y)

    def ridge(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(12.0, 30.0, z) * step(3.6, 2.4, slope) * step(240.0, 150.0, y)

    coco = {"bark": INDEX["palm bark"], "leaves": PALM, "fruit": INDEX["coconut"]}
    tree, pale = {"bark": INDEX["bark"], "leaves": TREE}, {"bark": INDEX["bark"], "leaves": PALE}
    banana = {"leaves": (INDEX["banana"],), "blades": 9, "slim": 0.13, "pitch": 1.8, "droop": 0.5}
    fern = {"leaves": (INDEX["jungle light"], INDEX["jungle"]), "size": 1.1}
    tuft = {"blades": 24, "slim": 0.025, "pitch": 2.2, "droop": 0.3, "clump": 0.4, "leaves": (INDEX["beach grass"],)}
    stone = {"stone": INDEX["basalt"]}
    return [
        Kind("coco palm 1", palm, 3200, 8, beach, SHORE, {"height": 10.5, "lean": 0.22, **coco}),
        Kind("coco palm 2", palm, 2000, 16, beach, SHORE, {"height": 9.0, "lean": 0.3, **coco}),
        Kind("coco palm 3", palm, 900, 30, beach, SHORE, {"height": 11.5, "lean": 0.1, **coco}),
        Kind("young palm", palm, 700, 40, coast, SHORE, {"height": 4.5, "lean": 0.06, **coco}),
        Kind("far palm 1", palm, 280, 80, coast, JUNGLE, {"height": 10.0, "lean": 0.15, **coco}),
        Kind("far palm 2", palm, 240, 90, jungle, JUNGLE, {"height": 12.0, "lean": 0.08, **coco}),
        Kind("banyan", broadleaf, 6000, 4, coast, SHORE, {"height": 11.0, "spread": 0.5, "bare": 0.2, **tree}),
        Kind("breadfruit", broadleaf, 1500, 20, coast, SHORE, {"height": 8.5, **tree}),
        Kind("sea almond", broadleaf, 900, 30, coast, SHORE, {"height": 7.0, "spread": 0.45, **pale}),
        *(
            Kind(
                f"jungle tree {i}",
                broadleaf,
                170 + 40 * i,
                240,
                jungle,
                JUNGLE,
                {"height": 7.5 + i, "bare": 0.15, **tree},
            )
            for i in range(4)
        ),
        *(
            Kind(f"pale tree {i}", broadleaf, 160, 170, jungle, JUNGLE, {"height": 9.0 + i, "bare": 0.2, **pale})
            for i in range(2)
        ),
        *(
            Kind(f"ridge bush {i}", shrub, 70 + 20 * i, 390, ridge, JUNGLE, {"size": 4.0 + i, "leaves": TREE})
            for i in range(2)
        ),
        *(
            Kind(f"naupaka {i}", shrub, 180 + 60 * i, 110, fringe, SHORE, {"size": 1.8 + 0.4 * i, "leaves": PALE})
            for i in range(2)
        ),
        Kind("hibiscus", shrub, 330, 45, fringe, SHORE, {"size": 1.9, "leaves": TREE, "blossom": INDEX["hibiscus"]}),
        Kind(
            "frangipani", shrub, 360, 30, fringe, SHORE, {"size": 2.3, "leaves": TREE, "blossom": INDEX["frangipani"]}
        ),
        *(
            Kind(f"banana {i}", rosette, 130 + 60 * i, 60, coast, SHORE, {"size": 2.6 + 0.5 * i, **banana})
            for i in range(2)
        ),
        *(Kind(f"fern {i}", rosette, 120 + 40 * i, 100, fringe, SHORE, fern) for i in range(2)),
        *(Kind(f"beach grass {i}", rosette, 48, 330, strand, SHORE, {"size": 0.7 + 0.2 * i, **tuft}) for i in range(2)),
        *(Kind(f"rock {i}", rock, 90 + 120 * i, 26, surf, SHORE, {"size": 1.2 + 0.8 * i, **stone}) for i in range(3)),
        Kind("cliff block", rock, 420, 14, surf, (-120.0, 120.0, -40.0, 90.0), {"size": 3.4, "flat": 0.75, **stone}),
        Kind("driftwood", log, 90, 14, strand, SHORE, {"size": 2.6, "bark": INDEX["driftwood"]}),
    ]
