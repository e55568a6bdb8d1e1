"""A stand-in for the PBRT landscape scene: forest and meadow plants spread over hills by instancing.

The original (islands paper, section 5.3; ray queue cycling paper, figure 3) has 23 K plants on a base mesh, 24 M unique
and 3.1 G instanced triangles, under an environment map. This one has the same make-up at a size that a laptop traces in
seconds: one ground object of many meshes, a few kinds of thousands of triangles, many of a few dozen, and instances
that outweigh the unique triangles tenfold.
"""

from __future__ import annotations

import numpy as np

from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from workloads.plants import broadleaf, conifer, flower, log, rock, rosette, shrub
from workloads.terrain import F64, I64, Kind, Noise, Suitability, Terrain, generator, graded_axis, grow, instances
from workloads.terrain import smoothstep as step

WATER_LEVEL = -14.0
FAR = (-260.0, 260.0, 25.0, 430.0)
MIDDLE = (-110.0, 110.0, 12.0, 150.0)
NEAR = (-34.0, 34.0, 1.5, 46.0)
SUN = (-5200.0, -1500.0, 4300.0)
SUN_IRRADIANCE = (3.5, 3.1, 2.5)

PALETTE = {
    "lush meadow": Material((0.15, 0.26, 0.05)),
    "meadow": Material((0.20, 0.28, 0.06)),
    "pasture": Material((0.25, 0.295, 0.075)),
    "hay": Material((0.31, 0.305, 0.10)),
    "forest floor": Material((0.15, 0.215, 0.05)),
    "earth": Material((0.21, 0.16, 0.10)),
    "cliff": Material((0.30, 0.29, 0.27)),
    "lake": Material((0.72, 0.82, 0.88), mirror=1.0),
    "oak bark": Material((0.13, 0.095, 0.065)),
    "birch bark": Material((0.62, 0.60, 0.55)),
    "spruce bark": Material((0.15, 0.10, 0.075)),
    "oak dark": Material((0.075, 0.145, 0.03)),
    "oak": Material((0.125, 0.225, 0.045)),
    "oak light": Material((0.20, 0.31, 0.065)),
    "birch": Material((0.21, 0.32, 0.07)),
    "birch light": Material((0.31, 0.39, 0.10)),
    "spruce": Material((0.055, 0.12, 0.065)),
    "spruce light": Material((0.10, 0.19, 0.085)),
    "maple": Material((0.33, 0.12, 0.03)),
    "maple light": Material((0.48, 0.23, 0.04)),
    "fern": Material((0.10, 0.22, 0.035)),
    "grass": Material((0.16, 0.28, 0.045)),
    "dry grass": Material((0.34, 0.32, 0.11)),
    "reed": Material((0.24, 0.27, 0.09)),
    "poppy": Material((0.68, 0.07, 0.03)),
    "daisy": Material((0.80, 0.79, 0.72)),
    "lavender": Material((0.30, 0.20, 0.58)),
    "yolk": Material((0.75, 0.52, 0.04)),
    "stone": Material((0.34, 0.33, 0.31)),
    "dark stone": Material((0.22, 0.22, 0.21)),
}
INDEX = {name: index for index, name in enumerate(PALETTE)}
OAK = (INDEX["oak dark"], INDEX["oak"], INDEX["oak light"])
BIRCH = (INDEX["oak"], INDEX["birch"], INDEX["birch light"])
SPRUCE = (INDEX["spruce"], INDEX["spruce light"])
MAPLE = (INDEX["oak"], INDEX["maple"], INDEX["maple light"])
STONE = (INDEX["dark stone"], INDEX["stone"], INDEX["stone"])
GRASS = ((INDEX["grass"], INDEX["dry grass"]), (INDEX["grass"], INDEX["fern"]), (INDEX["dry grass"],))
TUFT = {"size": 0.6, "blades": 24, "slim": 0.03, "pitch": 2.2, "droop": 0.3, "clump": 0.5}
REED = {"size": 1.7, "blades": 30, "slim": 0.015, "pitch": 6.0, "droop": 0.1, "clump": 0.6}
BLOOM = {"size": 0.62, "green": INDEX["grass"], "heart": INDEX["yolk"]}


def landscape(*, seed: int = 1, detail: float = 1.0) -> Scene:
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
        (0, 0, 4.2), towards positive y.

    """
    cells = max(16, round(140 * float(np.sqrt(detail))))
    terrain = _hills(seed, cells)
    placed = [
        (terrain.ground(_cover(seed, terrain)), IDENTITY[None]),
        (_lake(), IDENTITY[None]),
        *grow(seed, detail, terrain, _kinds(seed)),
    ]
    things, instance_object, instance_transform = instances(placed)
    squared = sum(c * c for c in SUN)
    sun = PointLight(SUN, (SUN_IRRADIANCE[0] * squared, SUN_IRRADIANCE[1] * squared, SUN_IRRADIANCE[2] * squared))
    sky = Environment(zenith=(0.16, 0.34, 0.80), horizon=(0.64, 0.78, 0.95), ground=(0.16, 0.17, 0.12))
    return Scene(things, instance_object, instance_transform, tuple(PALETTE.values()), (sun,), sky)


def _hills(seed: int, cells: int) -> Terrain:
    """Return a slope that falls from the viewpoint at the origin into a winding valley, and wooded hills beyond it."""
    axis_x = graded_axis(-270.0, 270.0, 0.0, 40.0, cells)
    axis_y = graded_axis(-30.0, 440.0, 8.0, 45.0, cells)
    x, y = np.meshgrid(axis_x, axis_y)
    noise = Noise(seed, "hills")
    across = y + 16.0 * np.sin(x / 65.0) + 0.1 * x + 10.0 * noise(x, y, 80.0, 2)
    z = -15.5 * step(6.0, 104.0, across) + 50.0 * step(140.0, 420.0, across)
    z += 14.0 * step(70.0, 250.0, np.abs(x)) * step(60.0, 190.0, y)
    z += (0.8 + 10.0 * step(130.0, 320.0, across)) * noise(x, y, 105.0, 3, 0.45)
    z += 0.3 * noise(x, y, 11.0, 3)
    return Terrain(axis_x, axis_y, z.astype(np.float32).astype(np.float64))


def _cover(seed: int, terrain: Terrain) -> I64:
    """Return the material of each triangle of the ground; noise frays the borders between materials."""
    x, y, z, slope = terrain.facets()
    patch = Noise(seed, "cover")(x, y, 24.0, 4, 0.65)
    fray = generator(seed, "fray").uniform(-0.2, 0.2, x.shape)
    tone = np.clip(2.0 + 4.0 * (patch + fray) - 0.6 * step(60.0, 200.0, y), 0.0, 3.0)
    material = INDEX["lush meadow"] + tone.astype(np.int64)  # the four meadows follow each other, dry ones last
    material[(y + 80.0 * (patch + fray) > 190.0) | (slope + 0.3 * patch > 0.62)] = INDEX["forest floor"]
    material[slope + 0.3 * (patch + fray) > 0.8] = INDEX["cliff"]
    material[z + 0.5 * (patch + fray) < WATER_LEVEL + 0.35] = INDEX["earth"]
    return material


def _lake() -> SceneObject:
    """Return the water of the valley floor: it shows wherever the ground is lower."""
    corners = np.array([[x, y, WATER_LEVEL] for y in (40.0, 240.0) for x in (-265.0, 265.0)], np.float32)
    return SceneObject("lake", (Mesh(corners, np.array([[0, 1, 3], [0, 3, 2]], np.int32), INDEX["lake"]),))


def _kinds(seed: int) -> list[Kind]:
    """Return what grows where."""
    woods, moist = Noise(seed, "woods"), Noise(seed, "moisture")

    def dry(z: F64) -> F64:
        return step(WATER_LEVEL + 0.4, WATER_LEVEL + 1.2, z)

    def aside(x: F64, y: F64) -> F64:
        return step(0.2, 0.42, np.abs(x + 2.0) / (y + 6.0))  # leaves the view from the origin to the lake open

    def copse(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return dry(z) * aside(x, y) * (0.03 + step(0.0, 0.25, woods(x, y, 45.0, 3)))

    def leafy(x: F64, y: F64, z: F64, slope: F64) -> F64:
        far = step(120.0, 190.0, y + 40.0 * woods(x, y, 60.0, 2))
        return dry(z) * (far + 0.05) * (0.04 + step(-0.25, 0.25, woods(x, y, 95.0, 3))) * step(1.1, 0.8, slope)

    def spruces(x: F64, y: F64, z: F64, slope: F64) -> F64:
        far = step(125.0, 200.0, y + 40.0 * woods(x, y, 60.0, 2)) * step(-4.0, 28.0, z)
        return dry(z) * (far + 0.01) * (0.04 + step(0.2, -0.25, woods(x, y, 95.0, 3))) * step(1.3, 0.9, slope)

    def meadow(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return dry(z) / (4.0 + np.hypot(x, y)) ** 1.5 * (0.6 + step(-0.2, 0.3, moist(x, y, 7.0, 2)))

    def drifts(shift: float) -> Suitability:
        def suits(x: F64, y: F64, z: F64, slope: F64) -> F64:
            return dry(z) / (4.0 + np.hypot(x, y)) * step(0.1, 0.4, moist(x + shift, y - shift, 9.0, 2))

        return suits

    def shore(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return step(WATER_LEVEL - 0.5, WATER_LEVEL - 0.1, z) * step(WATER_LEVEL + 0.9, WATER_LEVEL + 0.3, z)

    def anywhere(x: F64, y: F64, z: F64, slope: F64) -> F64:
        return dry(z) * (0.1 + step(0.15, 0.6, slope)) / (10.0 + np.hypot(x, y))

    oak, birch = {"bark": INDEX["oak bark"], "leaves": OAK}, {"bark": INDEX["birch bark"], "leaves": BIRCH}
    maple, spruce = {"bark": INDEX["oak bark"], "leaves": MAPLE}, {"bark": INDEX["spruce bark"], "leaves": SPRUCE}
    slim = {"spread": 0.2, "bare": 0.3}
    left, right = (-18.0, -8.0, 17.0, 27.0), (11.0, 24.0, 24.0, 44.0)
    rows: list[Kind] = [
        Kind("old oak", broadleaf, 7000, 2, copse, left, {"height": 11.5, **oak}),
        Kind("oak", broadleaf, 3000, 5, copse, MIDDLE, {"height": 11.0, **oak}),
        Kind("maple", broadleaf, 2400, 5, copse, right, {"height": 8.5, **maple}),
        Kind("tall spruce", conifer, 2600, 5, copse, right, {"height": 15.0, **spruce}),
        Kind("birch 1", broadleaf, 1000, 18, copse, MIDDLE, {"height": 10.0, **birch, **slim}),
        Kind("birch 2", broadleaf, 700, 20, copse, MIDDLE, {"height": 8.5, **birch, **slim}),
        Kind("young oak", broadleaf, 600, 36, copse, MIDDLE, {"height": 7.5, **oak}),
        Kind("spruce 1", conifer, 700, 32, copse, MIDDLE, {"height": 13.0, **spruce}),
        Kind("spruce 2", conifer, 420, 50, spruces, FAR, {"height": 14.0, **spruce}),
        *(
            Kind(f"far oak {i}", broadleaf, 170 + 30 * i, 240, leafy, FAR, {"height": 9.0 + i, "bare": 0.18, **oak})
            for i in range(3)
        ),
        *(Kind(f"far birch {i}", broadleaf, 190, 120, leafy, FAR, {"height": 9.0, **birch, **slim}) for i in range(2)),
        Kind("far maple", broadleaf, 220, 45, leafy, FAR, {"height": 8.5, **maple}),
        *(Kind(f"far spruce {i}", conifer, 104, 420, spruces, FAR, {"height": 11.0 + i, **spruce}) for i in range(3)),
        *(Kind(f"bush {i}", shrub, 220, 50, copse, MIDDLE, {"size": 1.7 + 0.4 * i, "leaves": OAK}) for i in range(2)),
        Kind("rose bush", shrub, 360, 14, meadow, NEAR, {"size": 1.3, "leaves": OAK, "blossom": INDEX["poppy"]}),
        *(
            Kind(f"fern {i}", rosette, 110, 120, meadow, NEAR, {"size": 0.7, "leaves": (INDEX["fern"],)})
            for i in range(2)
        ),
        *(Kind(f"grass {i}", rosette, 48, 880, meadow, NEAR, {"leaves": GRASS[i], **TUFT}) for i in range(3)),
        Kind("poppies", flower, 54, 220, drifts(0.0), NEAR, {"petal": INDEX["poppy"], **BLOOM}),
        Kind("daisies", flower, 90, 180, drifts(40.0), NEAR, {"petal": INDEX["daisy"], **BLOOM}),
        Kind("lavender", flower, 90, 180, drifts(90.0), NEAR, {"petal": INDEX["lavender"], **BLOOM}),
        Kind("reeds", rosette, 60, 260, shore, (-120.0, 120.0, 60.0, 190.0), {"leaves": (INDEX["reed"],), **REED}),
        *(
            Kind(f"stone {i}", rock, 70 + 110 * i, 40, anywhere, MIDDLE, {"size": 0.7 + 0.4 * i, "stone": STONE[i]})
            for i in range(3)
        ),
        Kind("log", log, 90, 6, meadow, NEAR, {"size": 3.0, "bark": INDEX["oak bark"]}),
    ]
    return rows
