"""Object partitions: which rank of an island holds which part of the scene.

Section 4.1 of the ray queue cycling paper. Objects are dealt to ranks whole, round-robin or heaviest first by an
estimate of the memory they will take; objects that are too big are first split into objects of fewer meshes. Sizes are
those of the *published* scene: a stand-in's meshes stand for it in proportion to their triangles and instances.
"""

from __future__ import annotations

import hashlib
import heapq
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from simrender.rays.scene import Scene

Method = Literal["heaviest_first", "round_robin"]


@dataclass(frozen=True)
class Published:
    """The size of the real scene, for which the traced one stands.

    Attributes
    ----------
    triangles, instances, instanced_triangles : float
    geometry_bytes, texture_bytes : float
        Vertices and indices; textures.

    """

    triangles: float
    instances: float
    instanced_triangles: float
    geometry_bytes: float
    texture_bytes: float


@dataclass(frozen=True)
class Footprint:
    """What acceleration structures take on a device: the two constants of the paper's weight estimate, in bytes."""

    triangle_bytes: float
    instance_bytes: float


@dataclass(frozen=True, eq=False)
class Pieces:
    """What a partition can assign: objects, or parts of objects that were too big, each a run of meshes.

    Attributes
    ----------
    first_mesh : int64 array (n + 1,)
        Piece i holds the meshes ``first_mesh[i]:first_mesh[i + 1]``.
    triangles, instanced_triangles, weight_bytes : float64 array (n,)
        At published size.

    """

    first_mesh: NDArray[np.int64]
    triangles: NDArray[np.float64]
    instanced_triangles: NDArray[np.float64]
    weight_bytes: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Partition:
    """The assignment of a scene's meshes to domains.

    Attributes
    ----------
    domains : int
    domain_of_mesh : int32 array (meshes,)
    weight_bytes : float64 array (domains,)
        Estimated device memory of each domain.
    primitives : float64 array (domains,)
        Instanced triangles a ray searches there.

    """

    domains: int
    domain_of_mesh: NDArray[np.int32]
    weight_bytes: NDArray[np.float64]
    primitives: NDArray[np.float64]

    @cached_property
    def key(self) -> str:
        """Content hash of the assignment."""
        return hashlib.blake2b(self.domain_of_mesh.tobytes(), digest_size=8).hexdigest() + f"-{self.domains}"


def pieces(scene: Scene, published: Published, footprint: Footprint, split_share: float) -> Pieces:
    """Return the objects of a scene with their weights, the big ones split.

    The weight estimate is the paper's: vertices, indices and textures, plus a constant for each triangle and a constant
    for each instance, for the acceleration structures.

    Parameters
    ----------
    scene : Scene
    published : Published
    footprint : Footprint
        The constants of the machine.
    split_share : float
        An object with more than this share of all (uninstanced) triangles is split between meshes into as many objects
        as it takes to get below, or into single meshes.

    """
    instance_scale = published.instances / len(scene.instance_object)
    triangle_scale = published.triangles / scene.unique_triangles
    instanced_scale = published.instanced_triangles / scene.instanced_triangles
    bytes_a_triangle = (published.geometry_bytes + published.texture_bytes) / published.triangles
    bytes_a_triangle += footprint.triangle_bytes
    limit = split_share * scene.unique_triangles

    first, triangles, instanced, weights = [0], [], [], []
    mesh = 0
    for thing, instances in zip(scene.objects, scene.instances_of, strict=True):
        sizes = np.array([len(m.faces) for m in thing.meshes])
        for run in _runs(sizes, limit):
            mesh += len(run)
            size = float(run.sum())
            first.append(mesh)
            triangles.append(size * triangle_scale)
            instanced.append(size * float(instances) * instanced_scale)
            weights.append(
                triangles[-1] * bytes_a_triangle + float(instances) * instance_scale * footprint.instance_bytes
            )
    return Pieces(np.array(first), np.array(triangles), np.array(instanced), np.array(weights))


def _runs(sizes: NDArray[np.int64], limit: float) -> list[NDArray[np.int64]]:
    """Cut meshes of the given sizes into consecutive runs of at most ``limit`` triangles, or single meshes."""
    if sizes.sum() <= limit or len(sizes) == 1:
        return [sizes]
    runs, start, total = [], 0, 0
    for i, size in enumerate(sizes):
        if i > start and total + size > limit:
            runs.append(sizes[start:i])
            start, total = i, 0
        total += size
    return [*runs, sizes[start:]]


def partition(of: Pieces, domains: int, method: Method = "heaviest_first") -> Partition:
    """Deal the pieces of a scene to domains.

    Heaviest first is greedy: in order of weight, each piece goes to the domain that is least loaded so far (ties to
    the lower domain, and among pieces of equal weight to the earlier one).

    Parameters
    ----------
    of : Pieces
    domains : int
    method : "heaviest_first" or "round_robin"

    """
    count = len(of.weight_bytes)
    owner = np.zeros(count, np.int32)
    if method == "round_robin":
        owner[:] = np.arange(count) % domains
    else:
        loads = [(0.0, domain) for domain in range(domains)]
        for piece in np.argsort(-of.weight_bytes, kind="stable"):
            load, domain = loads[0]
            owner[piece] = domain
            heapq.heapreplace(loads, (load + float(of.weight_bytes[piece]), domain))
    return Partition(
        domains,
        np.repeat(owner, np.diff(of.first_mesh)).astype(np.int32),
        np.bincount(owner, of.weight_bytes, minlength=domains).astype(np.float64),
        np.bincount(owner, of.instanced_triangles, minlength=domains).astype(np.float64),
    )
