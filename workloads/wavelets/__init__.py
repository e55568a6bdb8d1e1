"""SpRay's kind of example scene: 64 domains that all hold the same isosurface of an analytic wavelet.

The wavelet is the test function that VTK and ParaView offer as a source (vtkRTAnalyticSource): a Gaussian bell with a
sine along each axis. Its surface is cut off at the borders of a box; boxes stand side by side, 4 along each axis.
"""

from __future__ import annotations

import numpy as np

from simrender.rays.isosurface import isosurface
from simrender.rays.scene import F32, IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject

HALF_SIDE = 10.0
DEVIATION = 0.5
PEAK, FREQUENCIES, MAGNITUDES = 255.0, (60.0, 30.0, 40.0), (10.0, 18.0, 5.0)
ISOVALUE = 157.0909
"""Halfway between the least and the largest value on the source's own 21 x 21 x 21 points."""


def wavelets(*, points: int = 21, across: int = 4, diffuse: bool = False) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    points : int
        Grid points along each axis of a domain.
    across : int
        Domains along each axis.
    diffuse : bool
        Light from everywhere above a surface, and not from a point.

    Returns
    -------
    Scene
        The wavelet's box has the side 20 and its centre at the origin; domains are as far apart as the surface is
        large, so that their boxes touch. y is up. Each is an object with one instance, and all have the same mesh. The
        light shines alike at every distance, as SpRay's do.

    """
    spacing = 2.0 * HALF_SIDE / (points - 1)
    surface = isosurface(wavelet(points), (-HALF_SIDE,) * 3, (spacing,) * 3, ISOVALUE)
    blue_to_red = np.clip((surface.vertices[:, 1:2] / HALF_SIDE + 1.0) / 2.0, 0.0, 1.0)
    colors = (1.0 - blue_to_red) * [0.23, 0.30, 0.75] + blue_to_red * [0.71, 0.12, 0.15] + 0.2
    mesh = Mesh(surface.vertices, surface.faces, colors=colors.astype(np.float32), smooth=True)
    count = across**3
    index = np.arange(count)
    transform = np.tile(IDENTITY, (count, 1, 1))
    size = surface.vertices.max(axis=0) - surface.vertices.min(axis=0)
    transform[:, :, 3] = size * np.stack([index % across, index // across % across, index // across**2], 1)
    return Scene(
        tuple(SceneObject(f"domain {i}", (mesh,)) for i in range(count)),
        index.astype(np.int32),
        transform,
        (Material((1.0, 1.0, 1.0)),),
        () if diffuse else (PointLight((0.0, 500.0, 1000.0), (1.0, 1.0, 1.0), falloff=False),),
        Environment(up=(0.0, 1.0, 0.0)),
        hemispheres=((1.0, 1.0, 1.0),) if diffuse else (),
    )


def wavelet(points: int) -> F32:
    """Return the wavelet on a cube of ``points`` points a side around its centre, float32 (n, n, n)."""
    axis = np.linspace(0.5, -0.5, points)  # the source counts from the far corner
    x, y, z = axis, axis[:, None], axis[:, None, None]
    bell = PEAK * np.exp(-(x * x + y * y + z * z) / (2.0 * DEVIATION**2))
    waves = [
        m * wave(f * p)
        for m, wave, f, p in zip(MAGNITUDES, (np.sin, np.sin, np.cos), FREQUENCIES, (x, y, z), strict=True)
    ]
    return np.asarray(bell + waves[0] + waves[1] + waves[2], np.float32)
