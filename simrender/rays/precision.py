"""Where float32 has too few digits left for a scene: rays start, meet triangles and leave them in it.

Size alone costs nothing, because `Trace` takes very small and very large scenes in other units of length. Distance
does: a scene far from the world's origin, or from the camera, has the digits of that distance. The limits come from
`simrender.accuracy.stability`, measured in a room whose furniture is 1/60 to 1/300 of its size:

=============== ===================================== ==============================
distance, sizes secondary rays that go astray         camera rays that go astray
=============== ===================================== ==============================
10              0.06 %                                0.1 %
30              0.25 %                                0.2 %
100             1.1 %                                 0.5 %
300             17 %                                  1.8 %
1,000           30 %                                  5 %
10,000          73 %                                  36 %
=============== ===================================== ==============================

Secondary rays go astray because the step off their surface, some hundred float32 units in the last place, is then long
against what lies around (Waechter and Binder, "A fast and robust method for avoiding self-intersection", Ray Tracing
Gems, 2019). They never hit the triangle they start on. A volume has no such step, and what moves there are points, by
one unit in the last place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from simrender.rays.scene import Scene

FARTHEST = 100.0
"""Distance of a surface, in sizes of its scene, beyond which more than one ray in a hundred goes astray."""

FARTHEST_VOLUME = 1000.0
"""The same of a volume: points are off by a tenth of a voxel where there are a thousand along an axis."""

SMALLEST = 1e-30
"""Size of a scene below which coordinates lose digits, because float32 has no smaller exponents."""


def out_of_range(scene: Scene, eye: ArrayLike | None = None) -> str | None:
    """Return what is wrong with a scene's place in the world, or None if its rays have the digits they need.

    Parameters
    ----------
    scene : Scene
    eye : (x, y, z), optional
        Where the camera stands.

    """
    low, high = (corner.astype(np.float64) for corner in scene.bounds)
    size, centre = float(np.linalg.norm(high - low)), 0.5 * (low + high)
    if size == 0.0:
        return None  # a point, which rays do not meet
    surfaces = len(scene.instance_object) > 0
    farthest = FARTHEST if surfaces else FARTHEST_VOLUME
    if size < SMALLEST:
        return (
            f"the scene is only {size:.3g} in size, where float32 coordinates lose digits; "
            f"choose a unit of length in which it is larger than {SMALLEST:g}"
        )
    away = float(np.linalg.norm(centre)) / size
    if away > farthest:
        what = "secondary rays go astray" if surfaces else "positions are coarse"
        return (
            f"the scene lies {away:,.0f} times its size from the world's origin, where float32 has few digits left and "
            f"{what}; move it within {farthest:,.0f} times its size of {size:.3g}"
        )
    if eye is not None:
        away = float(np.linalg.norm(np.asarray(eye, np.float64) - centre)) / size
        if away > farthest:
            return (
                f"the camera stands {away:,.0f} times the scene's size away from it, where float32 directions are too "
                f"coarse for it; move it within {farthest:,.0f} times the size of {size:.3g}"
            )
    return None
