"""A stand-in for the Richtmyer-Meshkov instability: two gases mix after a shock has passed their interface.

The original is one time step of a simulation with 2048 x 2048 x 1920 cells of one byte. This one is synthesized: a
level set with the shape that the interface has in its early stages (round bubbles of the light gas between narrow
spikes of the heavy one, large and small) is carried by a random velocity with Kolmogorov's spectrum, strongest in the
middle of the mixing layer. That folds the interface over itself until it is a surface of many layers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError
from simrender.rays.scene import F32, Environment, PointLight, Scene
from workloads.fields import Planes, balanced_planes, crossed, surface_scene
from workloads.terrain import F64, I64
from workloads.turbulence import Dims, carried, gaussian, velocity

PUBLISHED: Dims = (2048, 2048, 1920)
ACROSS = 4
"""Columns of domains along x and y, and layers of them along z."""

MIDDLE, HALF_DEPTH = 0.5, 0.13
"""Of the mixing layer, in heights of the box."""


def interface(*, seed: int = 1, points: int = 160, mixing: float = 1.0, domains: int = 52, sun: bool = False) -> Scene:
    """Generate the surface between the two gases, cut into domains by a non-uniform rectilinear grid.

    Parameters
    ----------
    seed : int
    points : int
        Grid points along x and y; 1920 / 2048 times as many along z.
    mixing : float
        How far the flow has carried the gases: a later time step has a larger surface.
    domains : int
        How many of the 4 x 4 x 4 cells of the grid hold any surface. The planes across x and y, and the middle one
        across z, share out the surface about equally; the outer two lie where they leave the right number empty.
    sun : bool
        Light it by a sun that casts hard shadows, and not from everywhere.

    Returns
    -------
    Scene
        One unit of length is a published cell. The light gas is above; seen from there, its bubbles bulge away.

    Raises
    ------
    SceneError
        If no planes leave that number of domains.

    """
    dims = (points, points, max(2, round(points * PUBLISHED[2] / PUBLISHED[0])))
    spacing = (PUBLISHED[0] / dims[0], PUBLISHED[1] / dims[1], PUBLISHED[2] / dims[2])
    level = height_above(seed, dims, mixing)
    planes = uneven_planes(crossed(level, 0.0), domains)
    light = PointLight((-3000.0, -5200.0, 8000.0), (0.95, 0.92, 0.85), falloff=False) if sun else None
    sky = Environment(zenith=(0.6, 0.7, 0.9), horizon=(0.9, 0.93, 0.97), ground=(0.55, 0.5, 0.45))
    palette = [(0.32, 0.1, 0.05), (0.55, 0.2, 0.08), (0.85, 0.52, 0.2), (0.95, 0.85, 0.6), (0.98, 0.95, 0.88)]
    return surface_scene(level, spacing, 0.0, planes, palette=palette, environment=sky, sun=light)


def height_above(seed: int, dims: Dims, mixing: float) -> F32:
    """Return the level set: the height above the interface where the gas came from, in heights of the box."""
    nx, _, nz = dims
    z = np.linspace(0.0, 1.0, nz)
    shape = 0.035 * _waves(seed, "shock", dims, 0.35)
    for k, (size, high) in enumerate(((0.30, 0.065), (0.14, 0.04), (0.07, 0.02))):
        # The length of a pair of waves vanishes at points only: round bubbles between ridges.
        a, b = _waves(seed, f"bubbles {k}", dims, size), _waves(seed, f"spikes {k}", dims, size)
        shape += high * (np.sqrt(a * a + b * b) - 1.25)
    still = (z[:, None, None] - MIDDLE - shape).astype(np.float32)
    flow = velocity(seed, "flow", dims, largest=0.22, smallest=4.5)
    calm: F64 = np.exp(-0.5 * ((z - MIDDLE) / HALF_DEPTH) ** 2)
    return carried(still, flow, reach=0.065 * mixing * nx, steps=5, calm=calm)


def uneven_planes(crossing: NDArray[np.bool_], domains: int) -> Planes:
    """Return the planes of a 4 x 4 x 4 grid of which so many cells hold any of the marked cells.

    Parameters
    ----------
    crossing : bool array (nz, ny, nx) of cells
    domains : int

    Raises
    ------
    SceneError
        If there are none.

    """
    x, y, z = balanced_planes(crossing, (ACROSS, ACROSS, ACROSS))
    for nudge in range(int(np.diff(x).min())):  # where surfaces of several columns end alike, others may not
        across = np.concatenate([x[:1], x[1:-1] - nudge, x[-1:]])
        columns = np.add.reduceat(np.add.reduceat(crossing.astype(np.int64), y[:-1], 1), across[:-1], 2)
        layers = _layers(columns.reshape(len(columns), -1), int(z[2]), domains)
        if layers is not None:
            return across, y, layers
    raise SceneError(f"no 4 x 4 x 4 grid has {domains} domains with any surface; take another seed or more points")


def _layers(columns: I64, half: int, domains: int) -> I64 | None:
    """Return planes across z between which so many pieces of columns hold anything, if there are any.

    Parameters
    ----------
    columns : int64 array (nz, columns)
        Marked cells of each column at each height.
    half : int
        The plane that has half of the marked cells below it; the middle plane stays within an eighth of the height.
    domains : int

    """
    below = np.zeros((len(columns) + 1, columns.shape[1]), np.int64)
    np.cumsum(columns, axis=0, out=below[1:])
    best: tuple[int, list[int]] | None = None
    for away in range(len(columns) // 8):
        for middle in {half + away: 0, half - away: 0}:
            # How many pieces of the two lower, and of the two upper layers hold any, for each plane between them.
            under = ((below[: middle + 1] > 0).sum(axis=1) + (below[middle] > below[: middle + 1]).sum(axis=1))[1:-1]
            above = ((below[-1] > below[middle:]).sum(axis=1) + (below[middle:] > below[middle]).sum(axis=1))[1:-1]
            fits = np.argwhere(under[:, None] + above == domains)
            lean = np.abs(under[fits[:, 0]] - above[fits[:, 1]])
            if len(fits) and (best is None or lean.min() < best[0]):
                low, high = fits[lean.argmin()]
                best = int(lean.min()), [0, int(low) + 1, middle, middle + 1 + int(high), len(columns)]
        if best is not None and best[0] <= 2:
            break
    return None if best is None else np.array(best[1])


def _waves(seed: int, name: str, dims: Dims, size: float) -> F64:
    """Return smooth random waves over the plane, mostly of one length, given in sides of the box."""
    nx, ny, _ = dims
    waves = gaussian(seed, name, (nx, ny, 8), slope=7.0, largest=size * nx / 8.0, smallest=4.0)
    return np.asarray(waves[0], np.float64)
