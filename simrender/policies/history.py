"""The history buffer: which of the rays that wrong guesses spawn may still be right.

Park, Fussell and Navratil, "SpRay: speculative ray scheduling for large data visualization" (2018), section 4.1.3.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.rays.integrators import AmbientOcclusion, Integrator, PathTracing, SprayPathTracing
from simrender.rays.speculative import RayTree

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]


class HistoryBuffer:
    """The nearest hits so far along each path, and how they compare with the history of a ray (4.1.3).

    Parameters
    ----------
    tree : RayTree
    buffer : float32 array (samples, H)
        Shared with ranks that have other samples.

    """

    def __init__(self, tree: RayTree, buffer: NDArray[np.float32]) -> None:
        self.tree, self.buffer = tree, buffer
        self.ray_depth, self.depth = 0, buffer.shape[1]

    def reset(self, ray_depth: int, samples: Ids) -> None:
        """Forget everything about some samples: the buffer now begins at a depth."""
        self.ray_depth = ray_depth
        self.buffer[samples] = np.inf

    def visibility(self, rays: Ids) -> Mask:
        """Return which rays come from the hits that are nearest so far."""
        right = np.empty(len(rays), np.bool_)
        _visible(*self._columns, rays, right)
        return right

    def farther_than(self, rows: Ids) -> Mask:
        """Return which rows begin no farther than the nearest hit of their ray so far, if that is right itself."""
        tree = self.tree
        rays = tree.rows["ray"][rows]
        level = tree.rays["depth"][rays].astype(np.int64) - self.ray_depth
        near: Mask = tree.rows["entry"][rows] <= self.buffer[tree.rays["sample"][rays], level]
        near &= self.visibility(rays)
        return near

    def update(self, rows: Ids) -> Mask:
        """Enter the hits of rows, one after the other; return which were nearer than what was known."""
        success = np.empty(len(rows), np.bool_)
        _update(*self._columns, rows, success)
        return success

    def spills(self, rays: Ids) -> Mask:
        """Return which rays are too deep for the buffer."""
        deep: Mask = self.tree.rays["depth"][rays] >= self.ray_depth + self.depth
        return deep

    def camera_rays(self, rows: Ids) -> int:
        """Return how many rows are those of camera rays."""
        return int((self.tree.rays["depth"][self.tree.rows["ray"][rows]] == 0).sum())

    @property
    def _columns(self) -> tuple[int, Any, Any, Any, Any, Any, Any]:
        rays, rows = self.tree.rays, self.tree.rows
        return self.ray_depth, rays["depth"], rays["sample"], rays["spawner"], rows["ray"], rows["hit"], self.buffer


class Flags:
    """What shadow rays went through: a flag a ray of the tree, true or wrong.

    Attributes
    ----------
    occluded, committed, waits : bool array (rays,)

    """

    def __init__(self, tree: RayTree) -> None:
        self._tree = tree
        self.occluded, self.committed, self.waits = (np.zeros(tree.rays.count, np.bool_) for _ in range(3))

    def grow(self) -> None:
        """Make room for the rays that the tree has by now."""
        count = len(self.occluded)
        if self._tree.rays.count > count:
            more = np.zeros(max(self._tree.rays.count - count, count // 2), np.bool_)
            self.occluded, self.committed, self.waits = (
                np.concatenate([flags, more]) for flags in (self.occluded, self.committed, self.waits)
            )


def check_lit(tree: RayTree, rays: Ids) -> None:
    """Check that shadow rays whose light is added to the image are true ones, with nothing in their way.

    Raises
    ------
    InvariantError

    """
    wrong = rays[rays >= tree.trace.rays]
    if len(wrong):
        raise InvariantError(f"the light of shadow ray {wrong[0]} was added, and a wrong hit spawned it")
    occluded = rays[np.isfinite(tree.trace.column("t")[rays])]
    if len(occluded):
        raise InvariantError(f"the light of shadow ray {occluded[0]} was added, and something is in its way")


def bounces(integrator: Integrator) -> int:
    """Return how many hits a path can have."""
    if isinstance(integrator, AmbientOcclusion | SprayPathTracing):
        return integrator.bounces
    return integrator.diffuse + integrator.mirror + 1 if isinstance(integrator, PathTracing) else 1


def shadow_rays(tree: RayTree) -> int:
    """Return how many shadow rays a hit can spawn."""
    light, surfaces = tree.trace.integrator, tree.world.surfaces
    if isinstance(light, AmbientOcclusion):
        return light.samples
    wide, points = len(surfaces.light_first) - 1 + len(surfaces.hemispheres), len(surfaces.points)
    if isinstance(light, SprayPathTracing):
        return light.shadow_samples * wide + points
    return min(wide + points, 1) if isinstance(light, PathTracing) else 0


@njit(cache=True, nogil=True, error_model="numpy")
def _visible(base, depth, sample, spawner, ray_of, hit, buffer, rays, right):  # type: ignore[no-untyped-def]
    for i in range(len(rays)):
        ray = rays[i]
        level = np.int64(depth[ray]) - base
        right[i] = True
        while level > 0:
            level -= 1
            row = spawner[ray]
            if hit[row] != buffer[sample[ray], level]:
                right[i] = False
                break
            ray = ray_of[row]


@njit(cache=True, nogil=True, error_model="numpy")
def _update(base, depth, sample, spawner, ray_of, hit, buffer, rows, success):  # type: ignore[no-untyped-def]
    for i in range(len(rows)):
        ray = ray_of[rows[i]]
        path = sample[ray]
        last = np.int64(depth[ray]) - base
        # The oldest hit at which the ray's history and the buffer differ decides.
        row, level, differs, nearer = rows[i], last, last, hit[rows[i]] < buffer[path, last]
        while level > 0:
            level -= 1
            row = spawner[ray_of[row]]
            if hit[row] != buffer[path, level]:
                differs, nearer = level, hit[row] < buffer[path, level]
        success[i] = nearer
        if nearer:
            row = rows[i]
            for level in range(last, differs - 1, -1):
                buffer[path, level] = hit[row]
                if level > 0:
                    row = spawner[ray_of[row]]
            for level in range(last + 1, buffer.shape[1]):
                buffer[path, level] = np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def rows_in(rays, domain, first, last, domain_of):  # type: ignore[no-untyped-def]
    """Return each ray's row in a domain of its own, int64 (n,); -1 where it does not enter that."""
    found = np.full(len(rays), -1, np.int64)
    for i in range(len(rays)):
        for row in range(first[rays[i]], last[rays[i]]):
            if domain_of[row] == domain[i]:
                found[i] = row
    return found
