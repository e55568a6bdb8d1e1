"""A stand-in for the Museum scene: a long vaulted hall with a skeleton, statues, show cases and paintings.

The original (ray queue cycling paper, figure 3 and acknowledgments) is an interior with scanned statues, paintings and
a natural history model, put together in Blender. This one has the same make-up at a size that a laptop traces in
seconds: a closed shell, in which no ray gets away and paths end only by absorption, dense statues, many instances, a
polished floor, area lights in the vault and at the far ends, and textures: each painting has its own, and so have the
marble of the floor and the walls' damask. They are computed, as everything here is.
"""

from __future__ import annotations

import numpy as np

from simrender.rays.scene import Environment, Material, Scene, Texture
from workloads.cad import Z, boxes, cushion, part, points, shifted, upright, whole
from workloads.museum.hall import AISLE, ARCADE, BAY, BAYS, COLUMNS, INDEX, PALETTE, cladding, hall
from workloads.rooms import ammonite, barrier, bench, bust, case, crystals, figure, painting, pedestal, skeleton, vase
from workloads.terrain import F64, Placed, generator, instances

TEXELS = 128.0
"""Of a painting, a metre."""

SIDES = np.array([[-1.0], [1.0]])


def museum(*, seed: int = 1, detail: float = 1.0) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    seed : int
    detail : float
        Factor on the triangles of every exhibit and of every column, and on the texels of every painting; the hall and
        the number of things in it stay.

    Returns
    -------
    Scene
        About 1.4 M instanced triangles at ``detail=1``. z is up, units are metres; the hall is 54 m long, along
        positive y, and meant to be seen from (3.1, 3.6, 2.3).

    """
    pictures, canvases = _pictures(seed, detail)
    placed = [*hall(detail), *_sculpture(seed, detail), *pictures, *_middle(seed, detail)]
    things, instance_object, instance_transform = instances(placed)
    night = Environment(zenith=(0.0, 0.0, 0.0), horizon=(0.0, 0.0, 0.0), ground=(0.0, 0.0, 0.0))
    textures = (*cladding(seed), *canvases)
    first = len(textures) - len(canvases)
    materials = [*PALETTE.values(), *(Material((1.0, 1.0, 1.0), texture=first + k) for k in range(len(canvases)))]
    return Scene(things, instance_object, instance_transform, tuple(materials), (), night, textures=textures)


def _sculpture(seed: int, detail: float) -> list[Placed]:
    """Return statues between the columns and busts before the pilasters, on pedestals."""
    rng = generator(seed, "sculpture")
    bays = BAY * np.arange(1, BAYS)
    stands = points(SIDES * ARCADE, bays, 0.0).reshape(-1, 3)
    facing = np.repeat([0.5 * np.pi, -0.5 * np.pi], len(bays)) + rng.uniform(-0.25, 0.25, len(stands))
    block = pedestal("statue pedestal", height=1.25, width=0.95, stone=INDEX["dark stone"])
    placed: list[Placed] = [(block, upright(stands))]
    for i, stone in enumerate(("white marble", "white marble", "bronze", "white marble")):
        size = round(26000 * detail)
        thing = figure(seed, f"statue {i}", triangles=size, stone=INDEX[stone], draped=i != 2)
        placed.append((thing, upright(stands[i::4] + 1.33 * Z, facing[i::4], 1.05)))
    spots = points(SIDES * (AISLE - 1.1), COLUMNS, 0.0).reshape(-1, 3)
    facing = np.repeat([0.5 * np.pi, -0.5 * np.pi], len(COLUMNS))
    block = pedestal("bust pedestal", height=1.3, width=0.5, stone=INDEX["light marble"])
    placed.append((block, upright(spots)))
    for i, stone in enumerate(("white marble", "bronze", "white marble")):
        thing = bust(seed, f"bust {i}", triangles=round(12000 * detail), stone=INDEX[stone])
        placed.append((thing, upright(spots[i::3] + 1.36 * Z, facing[i::3] + 0.2 * (i - 1))))
    return placed


def _pictures(seed: int, detail: float) -> tuple[list[Placed], list[Texture]]:
    """Return paintings on the walls of the aisles: a large one, or two small ones above each other, in every bay.

    The material of the k-th canvas comes k places after the last of the palette, and its texture is the k-th.
    """
    rng = generator(seed, "hanging")
    placed: list[Placed] = []
    textures: list[Texture] = []
    for name, side in (("left", -1.0), ("right", 1.0)):
        for bay in range(1, BAYS):
            large = (bay + (side > 0)) % 2 == 0
            low = (rng.uniform(1.3, 2.1), rng.uniform(1.6, 1.9), 2.75)
            high = (rng.uniform(1.3, 2.2), rng.uniform(1.2, 1.6), 5.1)
            sizes = [(rng.uniform(3.0, 3.9), rng.uniform(2.2, 2.8), 3.6)] if large else [low, high]
            for k, (width, height, z) in enumerate(sizes):
                thing, picture = painting(
                    seed,
                    f"painting {name} {bay} {k}",
                    triangles=round((9000 if large else 5000) * detail),
                    texels=TEXELS * detail**0.5,
                    width=width,
                    height=height,
                    canvas=len(PALETTE) + len(textures),
                    gilt=INDEX["gilt"],
                )
                textures.append(picture)
                placed.append((thing, upright([[side * (AISLE - 0.01), BAY * bay, z]], -side * 0.5 * np.pi)))
    return placed, textures


def _middle(seed: int, detail: float) -> list[Placed]:
    """Return what stands in the nave: the skeleton behind its ropes, vases, show cases with fossils, benches."""
    stage = whole(boxes([[-2.2, -9.6, 0.0], [-2.05, -9.45, 0.28]], [[2.2, 10.2, 0.28], [2.05, 10.05, 0.36]]))
    middle = np.array([[0.0, 22.0, 0.0]])
    placed: list[Placed] = [(part("stage", (INDEX["walnut"], stage)), upright(middle))]
    bones = skeleton("sauropod", triangles=round(120000 * detail), bone=INDEX["bone"], iron=INDEX["iron"])
    placed += [(thing, upright(middle + 0.36 * Z)) for thing in bones]
    step = 1.98
    post = barrier("barrier", brass=INDEX["brass"], rope=INDEX["rope"], length=step, triangles=round(900 * detail))
    placed.append((post, upright(points(SIDES * 2.75, 12.2 + step * np.arange(10), 0.0))))
    tables = points(SIDES * 4.1, np.arange(6.0, 48.0, 6.0), 0.0).reshape(-1, 3)
    table = case("case", wood=INDEX["walnut"], brass=INDEX["brass"], lining=INDEX["felt"])
    placed.append((table, upright(tables, 0.5 * np.pi)))
    placed += _exhibits(seed, detail, tables)
    corners = points([-2.0, 2.0, -2.0, 2.0], [8.6, 8.6, 45.0, 45.0], 0.0)
    block = pedestal("vase pedestal", height=0.9, width=0.8, stone=INDEX["red marble"])
    placed.append((block, upright(corners)))
    for i in range(2):
        jar = vase(seed, f"vase {i}", triangles=round(16000 * detail), height=1.25, glaze=INDEX["glaze"])
        placed.append((jar, upright(corners[i::2] + 0.9 * Z)))
    seat = bench("bench", wood=INDEX["walnut"], leather=INDEX["leather"], triangles=round(2000 * detail))
    placed.append((seat, upright(points(SIDES * 9.4, np.arange(6.0, 48.0, 6.0), 0.0))))
    return placed


def _exhibits(seed: int, detail: float, tables: F64) -> list[Placed]:
    """Return what lies in the show cases at places (n, 3): fossils, minerals, cups and eggs, all instances."""
    egg = shifted(cushion((0.1, 0.08, 0.07), max(40, round(600 * detail)), 1.0), (0.0, 0.0, 0.07))
    things = [
        ammonite("ammonite", triangles=round(2400 * detail), shell=INDEX["shell"]),
        crystals(seed, "amethyst", triangles=round(900 * detail), mineral=INDEX["amethyst"]),
        crystals(seed, "quartz", triangles=round(900 * detail), mineral=INDEX["quartz"]),
        crystals(seed, "malachite", triangles=round(900 * detail), mineral=INDEX["malachite"]),
        vase(seed, "cup", triangles=round(1600 * detail), height=0.3, glaze=INDEX["glaze"]),
        part("egg", (INDEX["shell"], egg), smooth=True),
    ]
    rng = generator(seed, "exhibits")
    slots = points(np.array([[-0.17], [0.17]]), np.array([-0.72, -0.36, 0.0, 0.36, 0.72]), 0.812).reshape(-1, 3)
    spots = (tables[:, None] + slots).reshape(-1, 3)
    chosen = rng.integers(0, len(things), len(spots))
    angle, size = rng.uniform(0.0, 2.0 * np.pi, len(spots)), rng.uniform(0.7, 1.0, len(spots))
    return [(thing, upright(spots[here], angle[here], size[here])) for i, thing in enumerate(things)
            if (here := chosen == i).any()]  # fmt: skip
