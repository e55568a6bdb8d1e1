"""A stand-in for the CAD model of the Boeing 777: a whole airliner of thousands of parts, most of them hidden.

The original (Ize, Brownlee and Hansen, "Real-time ray tracer for visualizing massive models on a cluster", section 5.4)
has 259 M triangles, and "significant occlusion": whatever the view, most of the model lies behind something else. This
one has the same make-up at a size that a laptop traces in seconds: large skins outside, and inside them frames,
stringers, clips, fasteners, cable bundles, pipes, ducts, seats, containers, and engines with every blade. Almost every
part is an object of its own, as in a CAD export; fasteners, clips, clamps, seats, blades and wheels are instances.
"""

from __future__ import annotations

from simrender.rays.scene import Environment, PointLight, Scene
from workloads.boeing.cabin import cabin
from workloads.boeing.engines import engines, gear, lamps
from workloads.boeing.shapes import PALETTE, Detail
from workloads.boeing.structure import framework, outside, skins, small_parts, systems, windows
from workloads.boeing.wings import wings
from workloads.terrain import instances

SUN = (-2600.0, -3600.0, 4200.0)
SUN_IRRADIANCE = (1.55, 1.47, 1.32)


def boeing(*, seed: int = 1, detail: float = 1.0, cutaway: int = 1) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    seed : int
    detail : float
        Factor on the number of small parts (fasteners, wires, pipes) and on the triangles of every part: instanced
        triangles grow with its square.
    cutaway : int
        1 leaves out a few skin panels, linings and stringers ahead of the port wing, so that the cabin shows; 0 leaves
        the hull closed.

    Returns
    -------
    Scene
        About 1.8 M instanced triangles at ``detail=1``. x points aft from the nose, y to starboard, z up, in
        metres.

    """
    level, cut = Detail(detail), bool(cutaway)
    placed = [
        *skins(level, cut),
        *windows(level, cut),
        *outside(level),
        *framework(level, cut),
        *small_parts(seed, level, cut),
        *systems(seed, level),
        *cabin(level, cut),
        *wings(seed, level),
        *engines(seed, level),
        *gear(level),
        *lamps(level),
    ]
    things, instance_object, instance_transform = instances(placed)
    squared = sum(c * c for c in SUN)
    sun = PointLight(SUN, (SUN_IRRADIANCE[0] * squared, SUN_IRRADIANCE[1] * squared, SUN_IRRADIANCE[2] * squared))
    hall = Environment(zenith=(0.30, 0.42, 0.62), horizon=(0.60, 0.64, 0.68), ground=(0.28, 0.28, 0.29))
    return Scene(things, instance_object, instance_transform, tuple(PALETTE.values()), (sun,), hall)
