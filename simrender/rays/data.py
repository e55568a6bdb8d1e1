"""From a workload's card to its domains: the pieces in which its data comes, or into which it is cut."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from simrender.errors import SceneError
from simrender.rays import domains as cuts
from simrender.rays.domains import Domains
from simrender.rays.files import SceneFile
from simrender.rays.partition import Footprint, Published, partition, pieces
from simrender.rays.scene import Scene
from simrender.rays.volume import MACRO
from simrender.rays.workload_card import DomainsCard, PublishedCard

NO_FOOTPRINT = Footprint(0.0, 0.0)
"""What acceleration structures take is the business of the machine that holds them."""


def cut(
    scene: Scene, how: DomainsCard, card: PublishedCard, published: Published, file: SceneFile, factor: float
) -> Domains:
    """Return the domains of a scene.

    Parameters
    ----------
    scene : Scene
        As traced: ``factor`` times the one in the file.
    how : DomainsCard
    card, published : PublishedCard and Published
        Sizes of the real thing, over which bytes and primitives are shared out.
    file : SceneFile
        What the file says of domains.
    factor : float

    Raises
    ------
    SceneError
        If the scene cannot be cut in this way.

    """
    if scene.elements is not None:
        return _parts(scene, how, card, published)
    method = how.method
    if method == "auto":
        method = "kd_bricks" if scene.volume is not None else "objects"
    if method == "kd_bricks":
        return _bricks(scene, how.count or 1, card)
    if scene.volume is not None:
        raise SceneError(f"domains.method {method}: a volume is cut by kd_bricks, with a count")
    triangles, nbytes = scene.triangles, published.geometry_bytes + published.texture_bytes
    total = published.instanced_triangles
    if method == "given":
        counts = [thing.triangles for thing in scene.objects]
        owner = np.repeat(scene.instance_object, np.array(counts)[scene.instance_object]).astype(np.int32)
        found = cuts.from_triangles(triangles, owner, len(scene.objects), nbytes, total)
        if file.low is None or file.high is None:
            return found
        size = np.float32(factor)
        return Domains(file.low * size, file.high * size, found.bytes, found.primitives, owner)
    if method == "objects":
        return cuts.from_objects(scene, partition(pieces(scene, published, NO_FOOTPRINT, 1.0 / 64.0), how.count or 1))
    if method == "sah":
        count = how.count or 1
        if len(scene.instance_object) > count:
            sizes = np.array([float(thing.triangles) for thing in scene.objects])[scene.instance_object]
            owner = cuts.sah_parts(*cuts.instance_boxes(scene), count, sizes)
            return cuts.from_instances(scene, owner, int(owner.max()) + 1, published, NO_FOOTPRINT)
        owner = cuts.sah_parts(*cuts.triangle_boxes(triangles), count)
        return cuts.from_triangles(triangles, owner, int(owner.max()) + 1, nbytes, total)
    shape = how.shape or (1, 1, 1)
    low, high = scene.bounds
    if method == "grid":
        planes = cuts.uniform_grid(low, high, shape)
    else:
        corners = triangles.vertices[triangles.faces]
        planes = cuts.balanced_grid(corners.mean(axis=1), shape, bounds=(low, high))
    return cuts.rectilinear(triangles, planes, nbytes, total)


def _parts(scene: Scene, how: DomainsCard, card: PublishedCard, published: Published) -> Domains:
    if how.method not in {"auto", "given"}:
        raise SceneError(f"domains.method {how.method}: an unstructured mesh comes in its own parts; use given")
    elements = scene.elements
    assert elements is not None  # noqa: S101 - the caller looked
    if how.count not in {None, elements.parts}:
        raise SceneError(
            f"the unstructured mesh comes in {elements.parts} parts of its own, not in {how.count} domains"
        )
    low, high = elements.part_bounds
    sizes = np.bincount(elements.part, minlength=len(low)).astype(np.float64)
    share = sizes / sizes.sum()
    count = float(card.elements or sizes.sum()) * card.growth
    return Domains(low, high, share * published.geometry_bytes, share * count)


def _bricks(scene: Scene, count: int, card: PublishedCard) -> Domains:
    volume = scene.volume
    if volume is None:
        raise SceneError("domains.method kd_bricks: the scene has no volume; use sah, grid, balanced or objects")
    cells = cuts.kd_bricks(volume.dims, count)
    each = 4.0
    if card.geometry_bytes is not None:
        each = float(card.geometry_bytes) / float(np.prod(np.array(card.voxels or volume.dims, np.float64)))
    found = cuts.from_bricks(volume, cells, card.voxels, each * card.growth)
    found = replace(found, primitives=found.primitives * card.growth)
    if len(scene.instance_object) == 0:
        return found
    # Triangles in the volume go with the brick that holds their centre; the brick's box grows to hold them.
    low, high = cuts.triangle_boxes(scene.triangles)
    centre = 0.5 * (low.astype(np.float64) + high)
    grid = (centre - np.array(volume.origin)) / np.array(volume.spacing)
    cell = np.clip(np.floor(grid).astype(np.int64), 0, np.array(volume.cells) - 1)
    macro = np.zeros(tuple(-(-n // MACRO) for n in volume.cells), np.int32)
    for d, (x0, x1, y0, y1, z0, z1) in enumerate(cells.tolist()):
        macro[x0 // MACRO : -(-x1 // MACRO), y0 // MACRO : -(-y1 // MACRO), z0 // MACRO : -(-z1 // MACRO)] = d
    owner = macro[tuple((cell // MACRO).T)]
    around = cuts.from_triangles(scene.triangles, owner, len(cells), 0.0, 0.0)
    return Domains(
        np.minimum(found.low, around.low), np.maximum(found.high, around.high), found.bytes, found.primitives, owner,
        cells,
    )  # fmt: skip
