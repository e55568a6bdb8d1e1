"""A stand-in for an Enzo run: the density of the cosmic web, which gathers in filaments and clusters.

The original is a simulation with adaptive mesh refinement, of which SpRay's authors extracted isosurfaces from the
coarsest level. Here matter moves from a lattice along the gradient of a random potential (Zeldovich, "Gravitational
instability: an approximate theory for large density perturbations", 1970), is summed up on the grid, and gets the
finer clumps of two nested levels of refinement where it is dense.
"""

from __future__ import annotations

import numpy as np

from simrender.rays.scene import F32, Environment, Scene
from workloads.fields import balanced_planes, crossed, surface_scene
from workloads.terrain import F64, smoothstep
from workloads.turbulence import gaussian

OVERDENSITY = 0.55
"""Of the isosurface: the decimal logarithm of the density, in mean densities."""

GRID = (4, 2, 2)
SIDE = 1024.0


def web(*, seed: int = 1, points: int = 128) -> Scene:
    """Generate an isosurface of the density in 16 domains, 4 x 2 x 2 in a non-uniform rectilinear grid.

    Parameters
    ----------
    seed : int
    points : int
        Grid points along each axis.

    Returns
    -------
    Scene
        The side of the box is 1024 units of length long. The planes of the grid share out the surface equally along
        each axis by itself, so that domains have several sizes and hold uneven amounts.

    """
    voxels = log_density(seed, points)
    planes = balanced_planes(crossed(voxels, OVERDENSITY), GRID)
    sky = Environment(zenith=(0.10, 0.12, 0.2), horizon=(0.22, 0.24, 0.32), ground=(0.05, 0.05, 0.08))
    palette = [(0.30, 0.18, 0.55), (0.25, 0.42, 0.8), (0.45, 0.75, 0.85), (0.9, 0.8, 0.6), (0.95, 0.6, 0.3)]
    spacing = (SIDE / points,) * 3
    return surface_scene(voxels, spacing, OVERDENSITY, planes, palette=palette, environment=sky)


def log_density(seed: int, points: int) -> F32:
    """Return the decimal logarithm of the density in mean densities, float32 (n, n, n), periodic."""
    n, dims = points, (points, points, points)
    potential = gaussian(seed, "potential", dims, slope=4.2, largest=0.4, smallest=6.0).astype(np.float64)
    density = _deposited([0.5 * (np.roll(potential, -1, a) - np.roll(potential, 1, a)) for a in (2, 1, 0)], 0.045 * n)
    for axis in range(3):
        density = 0.25 * np.roll(density, 1, axis) + 0.5 * density + 0.25 * np.roll(density, -1, axis)
    log = np.log10(density + 0.01)
    for level, size in ((1, 0.09), (2, 0.045)):
        clumps = gaussian(seed, f"level {level}", dims, slope=1.0, largest=size, smallest=4.0)
        log += 0.16 * clumps * smoothstep(0.1 + 0.2 * level, 0.5 + 0.2 * level, log)
    return log.astype(np.float32)


def _deposited(force: list[F64], distance: float) -> F64:
    """Return the density of matter that moved from each point of the lattice, shared among the 8 points around it.

    ``distance`` is the root mean square of a component of the movement, in cells.
    """
    n = len(force[0])
    scale = distance / np.sqrt(sum((f * f).mean() for f in force) / 3.0)
    at: list[F64] = []
    for axis, f in enumerate(force):
        lattice = np.arange(n, dtype=np.float64).reshape([n if a == 2 - axis else 1 for a in range(3)])
        at.append((lattice - scale * f).ravel())
    below = [np.floor(c).astype(np.int64) for c in at]
    share = [c - b for c, b in zip(at, below, strict=True)]
    density = np.zeros(n**3)
    for corner in np.ndindex(2, 2, 2):
        index, weight = np.zeros(n**3, np.int64), np.ones(n**3)
        for axis in (2, 1, 0):
            index = n * index + (below[axis] + corner[axis]) % n
            weight *= share[axis] if corner[axis] else 1.0 - share[axis]
        density += np.bincount(index, weights=weight, minlength=n**3)
    return density.reshape(n, n, n)
