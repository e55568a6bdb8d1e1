"""Scenes: triangle meshes with instances, a volume, or both.

As in PBRT and in the ray queue cycling paper (section 4.1), a scene is a list of instances of *objects*; an object is
one or more triangle *meshes*, and a mesh has one *material*. A triangle's global id counts through the instances in
order, then through the meshes of the instance's object, then through the mesh's faces. It does not depend on how the
scene is partitioned, which is what makes equally near hits resolve alike everywhere.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simrender.errors import SceneError

if TYPE_CHECKING:
    from simrender.rays.elements import Elements
    from simrender.rays.volume import Volume

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

IDENTITY = np.eye(4, dtype=np.float32)[:3]

GAMMA = 2.2
"""Colors in image and mesh files are meant for a display; scenes hold reflectances, their power of this."""


@dataclass(frozen=True)
class Material:
    """How a surface scatters light: Lambertian with some probability, else mirror-like; and what it emits.

    Attributes
    ----------
    albedo : (r, g, b)
        Reflectance of both lobes, 0 to 1.
    mirror : float
        Probability that a ray is reflected mirror-like and not diffusely, 0 to 1.
    emission : (r, g, b)
        Radiance emitted on both sides; any value above zero makes the meshes of this material area lights.
    texture : int
        Index into the scene's textures, by whose colors the albedo is multiplied; -1 for none.

    """

    albedo: tuple[float, float, float] = (0.7, 0.7, 0.7)
    mirror: float = 0.0
    emission: tuple[float, float, float] = (0.0, 0.0, 0.0)
    texture: int = -1


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on surfaces, repeated without end and read bilinearly, without levels of detail.

    Attributes
    ----------
    texels : uint8 array (height, width, 3)
        Colors for a display, the top row first: reflectances are their power of `GAMMA`.

    Raises
    ------
    SceneError
        If the array is not such an image.

    """

    texels: U8

    def __post_init__(self) -> None:
        texels = np.ascontiguousarray(self.texels)
        if texels.dtype != np.uint8 or texels.ndim != 3 or texels.shape[2] != 3 or texels.size == 0:
            raise SceneError(f"a texture is uint8 of shape (height, width, 3), got {texels.dtype} of {texels.shape}")
        object.__setattr__(self, "texels", texels)


def texture(reflectance: NDArray[np.floating[Any]]) -> Texture:
    """Return the texture whose colors are reflectances from 0 to 1, shape (height, width, 3)."""
    return Texture(np.rint(255.0 * np.clip(reflectance, 0.0, 1.0) ** (1.0 / GAMMA)).astype(np.uint8))


@dataclass(frozen=True)
class PointLight:
    """A light without extent.

    Attributes
    ----------
    position : (x, y, z)
    intensity : (r, g, b)
        Radiant intensity in power per steradian: the irradiance at distance d is intensity / d^2.
    falloff : bool
        False for a light that is equally bright at every distance, as SpRay's are.

    """

    position: tuple[float, float, float]
    intensity: tuple[float, float, float]
    falloff: bool = True


@dataclass(frozen=True)
class Environment:
    """Light from outside the scene, a vertical gradient: what a ray sees that hits nothing.

    Attributes
    ----------
    zenith, horizon, ground : (r, g, b)
        Radiance straight up, at the horizon, and straight down.
    up : (x, y, z)
        Unit vector towards the zenith.

    """

    zenith: tuple[float, float, float] = (0.35, 0.55, 0.95)
    horizon: tuple[float, float, float] = (0.95, 0.95, 0.95)
    ground: tuple[float, float, float] = (0.3, 0.28, 0.25)
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh with one material.

    Attributes
    ----------
    vertices : float32 array (n, 3)
    faces : int32 array (m, 3)
        Indices into ``vertices``.
    material : int
        Index into the scene's materials.
    colors : float32 array (n, 3), optional
        Of the vertices, 0 to 1; they take the place of the material's albedo.
    smooth : bool
        Shade with normals mixed from those of the vertices, and not with the faces' own; see `Scene.vertex_normals`.
    uv : float32 array (n, 2), optional
        Where the vertices lie in the material's texture, which is 1 wide and 1 high, from its lower left corner.

    Raises
    ------
    SceneError
        If the mesh is empty, has a vertex that is not finite, or a face that points outside the vertices, or other
        columns than vertices.

    """

    vertices: F32
    faces: I32
    material: int = 0
    colors: F32 | None = None
    smooth: bool = False
    uv: F32 | None = None

    def __post_init__(self) -> None:
        vertices = np.ascontiguousarray(self.vertices, dtype=np.float32)
        indices = np.asarray(self.faces)
        if vertices.ndim != 2 or vertices.shape[1:] != (3,) or indices.ndim != 2 or indices.shape[1:] != (3,):
            raise SceneError(f"vertices and faces are arrays of shape (n, 3), got {vertices.shape} and {indices.shape}")
        if len(vertices) == 0 or len(indices) == 0:
            raise SceneError("the mesh is empty: it has no triangles")
        bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
        if len(bad):
            where = f"the first is vertex {bad[0]}: {vertices[bad[0]].tolist()}"
            raise SceneError(f"{len(bad)} of {len(vertices)} vertices are not finite; {where}")
        outside = np.flatnonzero(((indices < 0) | (indices >= len(vertices))).any(axis=1))
        if len(outside):
            where = f"the first is face {outside[0]}: {indices[outside[0]].tolist()}"
            faces = f"{len(outside)} face points" if len(outside) == 1 else f"{len(outside)} faces point"
            raise SceneError(f"{faces} outside the {len(vertices)} vertices; {where}")
        if self.colors is not None:
            colors = np.ascontiguousarray(self.colors, dtype=np.float32)
            if colors.shape != vertices.shape:
                raise SceneError(f"{len(vertices)} vertices need colors of the same shape, got {colors.shape}")
            object.__setattr__(self, "colors", colors)
        if self.uv is not None:
            uv = np.ascontiguousarray(self.uv, dtype=np.float32)
            if uv.shape != (len(vertices), 2):
                raise SceneError(f"{len(vertices)} vertices need texture coordinates (n, 2), got {uv.shape}")
            if not np.isfinite(uv).all():
                raise SceneError("texture coordinates are not finite")
            object.__setattr__(self, "uv", uv)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", np.ascontiguousarray(indices, dtype=np.int32))


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One or more meshes that are placed together; the unit that a partition assigns."""

    name: str
    meshes: tuple[Mesh, ...]

    @cached_property
    def triangles(self) -> int:
        """Number of triangles of all meshes, before instancing."""
        return sum(len(m.faces) for m in self.meshes)


@dataclass(frozen=True, eq=False)
class Triangles:
    """A scene with every instance written out in world space, because embreex offers no instancing.

    Attributes
    ----------
    vertices : float32 array (v, 3)
    faces : int32 array (t, 3)
        Row i is the triangle of global id i.
    mesh : int32 array (t,)
        The triangle's mesh, numbered through the objects in order.

    """

    vertices: F32
    faces: I32
    mesh: I32


@dataclass(frozen=True, eq=False)
class Scene:
    """Objects, their instances, materials and lights.

    Attributes
    ----------
    objects : tuple of SceneObject
    instance_object : int32 array (n,)
        The object of each instance.
    instance_transform : float32 array (n, 3, 4)
        Object space to world space, affine.
    materials : tuple of Material
    points : tuple of PointLight
    environment : Environment
    hemispheres : tuple of (r, g, b)
        Radiance of the diffuse lights, which shine from everywhere above a surface, as SpRay's do.
    volume : Volume, optional
        A structured volume; such a scene needs no instances.
    elements : Elements, optional
        An unstructured volume; such a scene needs no instances.
    textures : tuple of Texture
        Of the materials that have one; their meshes say where they lie in it.

    Raises
    ------
    SceneError
        If there is nothing to render, or an index or transform is out of order.

    """

    objects: tuple[SceneObject, ...]
    instance_object: I32
    instance_transform: F32
    materials: tuple[Material, ...] = (Material(),)
    points: tuple[PointLight, ...] = ()
    environment: Environment = field(default_factory=Environment)
    hemispheres: tuple[tuple[float, float, float], ...] = ()
    volume: Volume | None = None
    elements: Elements | None = None
    textures: tuple[Texture, ...] = ()

    def __post_init__(self) -> None:
        of = np.ascontiguousarray(self.instance_object, dtype=np.int32)
        transform = np.ascontiguousarray(self.instance_transform, dtype=np.float32)
        if len(of) == 0 and (self.volume is not None or self.elements is not None):
            transform = transform.reshape(0, 3, 4)
        elif len(of) == 0:
            raise SceneError("the scene is empty: it has no instances")
        if transform.shape != (len(of), 3, 4):
            raise SceneError(f"{len(of)} instances need transforms of shape ({len(of)}, 3, 4), got {transform.shape}")
        if len(of) and (of.min() < 0 or of.max() >= len(self.objects)):
            raise SceneError(f"an instance points to object {of.max()}, but there are {len(self.objects)} objects")
        if not np.isfinite(transform).all():
            raise SceneError("an instance has a transform that is not finite")
        for thing in self.objects:
            for mesh in thing.meshes:
                if not 0 <= mesh.material < len(self.materials):
                    raise SceneError(f"object {thing.name!r} uses material {mesh.material} of {len(self.materials)}")
                if self.materials[mesh.material].texture >= 0 and mesh.uv is None:
                    raise SceneError(f"object {thing.name!r} has a texture, but no texture coordinates")
        for material in self.materials:
            if material.texture >= len(self.textures):
                raise SceneError(f"a material uses texture {material.texture} of {len(self.textures)}")
        object.__setattr__(self, "instance_object", of)
        object.__setattr__(self, "instance_transform", transform)

    @cached_property
    def instances_of(self) -> NDArray[np.int64]:
        """Number of instances of each object, int64 (objects,)."""
        return np.bincount(self.instance_object, minlength=len(self.objects))

    @cached_property
    def meshes(self) -> tuple[Mesh, ...]:
        """All meshes, numbered through the objects in order."""
        return tuple(mesh for thing in self.objects for mesh in thing.meshes)

    @cached_property
    def mesh_material(self) -> I32:
        """Material of each mesh, int32 (meshes,)."""
        return np.array([mesh.material for mesh in self.meshes], dtype=np.int32)

    @cached_property
    def unique_triangles(self) -> int:
        """Number of triangles before instancing."""
        return sum(thing.triangles for thing in self.objects)

    @cached_property
    def instanced_triangles(self) -> int:
        """Number of triangles with every instance counted."""
        return int(sum(thing.triangles * int(n) for thing, n in zip(self.objects, self.instances_of, strict=True)))

    @cached_property
    def triangles(self) -> Triangles:
        """The scene written out in world space, computed when first asked for."""
        vertex_count = np.array([sum(len(m.vertices) for m in o.meshes) for o in self.objects])
        face_count = np.array([o.triangles for o in self.objects])
        first_vertex = _starts(vertex_count[self.instance_object])
        first_face = _starts(face_count[self.instance_object])
        first_mesh = _starts(np.array([len(o.meshes) for o in self.objects]))
        vertices = np.zeros((first_vertex[-1], 3), np.float32)
        faces = np.zeros((first_face[-1], 3), np.int32)
        mesh_of = np.zeros(first_face[-1], np.int32)
        for index, instances in self._placed:
            thing = self.objects[index]
            shift = _starts(np.array([len(m.vertices) for m in thing.meshes]))
            local = np.concatenate([m.vertices for m in thing.meshes])
            corners = np.concatenate([m.faces + s for m, s in zip(thing.meshes, shift[:-1], strict=True)])
            ids = np.repeat(np.arange(len(thing.meshes), dtype=np.int32), [len(m.faces) for m in thing.meshes])
            matrix = self.instance_transform[instances]
            world = np.einsum("nij,vj->nvi", matrix[:, :, :3], local) + matrix[:, None, :, 3]
            rows = first_vertex[instances][:, None] + np.arange(len(local))
            vertices[rows.ravel()] = world.reshape(-1, 3)
            rows = (first_face[instances][:, None] + np.arange(len(corners))).ravel()
            faces[rows] = (corners[None] + first_vertex[instances][:, None, None]).reshape(-1, 3)
            mesh_of[rows] = np.tile(ids + first_mesh[index], len(instances))
        return Triangles(vertices, faces, mesh_of)

    @property
    def _placed(self) -> list[tuple[int, NDArray[np.int64]]]:
        """The objects that have instances, each with these."""
        rows = [(index, np.flatnonzero(self.instance_object == index)) for index in range(len(self.objects))]
        return [(index, instances) for index, instances in rows if len(instances)]

    def vertex_normals(self) -> F32:
        """Return a normal for each vertex of `triangles`, float32 (v, 3); zero where the mesh is not smooth.

        It is the sum of the normals of the faces around the vertex, as long as twice their areas, and so it is mixed
        within a triangle: the convention of SpRay's program. The array has no rows if no mesh is smooth.
        """
        if not any(mesh.smooth for mesh in self.meshes):
            return np.zeros((0, 3), np.float32)
        parts: dict[int, F32] = {}
        for index, instances in self._placed:
            local = np.concatenate([_normals(mesh) for mesh in self.objects[index].meshes])
            inverse = np.linalg.pinv(self.instance_transform[instances, :, :3].astype(np.float64))
            # Normals turn by the inverse transpose; their size must not leave float32's range.
            world = np.einsum("nji,vj->nvi", inverse, local)
            largest = np.abs(world).max(axis=(1, 2), keepdims=True)
            world = (world / np.where(largest > 0.0, largest, 1.0)).astype(np.float32)
            parts.update(zip(instances.tolist(), world, strict=True))
        return np.concatenate([parts[i] for i in range(len(self.instance_object))])

    def vertex_colors(self) -> F32:
        """Return a color for each vertex of `triangles`, float32 (v, 3); negative where the mesh has none.

        The array has no rows if no mesh has colors.
        """
        return self._of_vertices("colors", 3, -1.0)

    def vertex_uv(self) -> F32:
        """Return the texture coordinates of each vertex of `triangles`, float32 (v, 2); 0 where the mesh has none.

        The array has no rows if no mesh has such.
        """
        return self._of_vertices("uv", 2, 0.0)

    def _of_vertices(self, name: str, width: int, missing: float) -> F32:
        """Return an optional column of the meshes for each vertex of `triangles`; no rows if no mesh has it."""
        if all(getattr(mesh, name) is None for mesh in self.meshes):
            return np.zeros((0, width), np.float32)

        def column(mesh: Mesh) -> F32:
            own: F32 | None = getattr(mesh, name)
            return np.full((len(mesh.vertices), width), missing, np.float32) if own is None else own

        of_object = [np.concatenate([column(mesh) for mesh in thing.meshes]) for thing in self.objects]
        return np.concatenate([of_object[index] for index in self.instance_object])

    @cached_property
    def bounds(self) -> tuple[F32, F32]:
        """Lowest and highest corner of a box around everything; instances are not written out for it."""
        lows, highs = [np.full(3, np.inf)], [np.full(3, -np.inf)]
        for volume in (self.volume, self.elements):
            if volume is not None:
                lows.append(volume.bounds[0])
                highs.append(volume.bounds[1])
        if len(self.instance_object):
            low = np.array([np.min([m.vertices.min(axis=0) for m in o.meshes], axis=0) for o in self.objects])
            high = np.array([np.max([m.vertices.max(axis=0) for m in o.meshes], axis=0) for o in self.objects])
            matrix, of = self.instance_transform, self.instance_object
            centre, half = 0.5 * (low + high)[of], 0.5 * (high - low)[of]
            centre = np.einsum("nij,nj->ni", matrix[:, :, :3], centre) + matrix[:, :, 3]
            half = np.einsum("nij,nj->ni", np.abs(matrix[:, :, :3]), half)
            lows.append((centre - half).min(axis=0))
            highs.append((centre + half).max(axis=0))
        return np.min(lows, axis=0).astype(np.float32), np.max(highs, axis=0).astype(np.float32)

    def scaled(self, factor: float) -> Scene:
        """Return the scene in other units of length: every length times a factor, radiance as it is."""

        def times(triple: tuple[float, float, float], by: float) -> tuple[float, float, float]:
            return triple[0] * by, triple[1] * by, triple[2] * by

        points = tuple(
            PointLight(times(p.position, factor), times(p.intensity, factor**2 if p.falloff else 1.0), p.falloff)
            for p in self.points
        )
        return replace(
            self,
            instance_transform=self.instance_transform * np.float32(factor),
            points=points,
            volume=self.volume and self.volume.scaled(factor),
            elements=self.elements and self.elements.scaled(factor),
        )

    @cached_property
    def key(self) -> str:
        """Content hash: two scenes with the same key give the same rays."""
        digest = hashlib.blake2b(digest_size=16)
        for thing in self.objects:
            digest.update(f"object {len(thing.meshes)}".encode())
            for mesh in thing.meshes:
                digest.update(f"mesh {mesh.vertices.shape} {mesh.faces.shape} {mesh.material}".encode())
                digest.update(mesh.vertices.data)
                digest.update(mesh.faces.data)
                if mesh.smooth:
                    digest.update(b"smooth")
                for column in (mesh.colors, mesh.uv):
                    if column is not None:
                        digest.update(column.data)
        digest.update(self.instance_object.data)
        digest.update(self.instance_transform.data)
        digest.update(repr((self.materials, self.points, self.environment, self.hemispheres)).encode())
        for image in self.textures:
            digest.update(f"texture {image.texels.shape}".encode())
            digest.update(image.texels.data)
        for volume in (self.volume, self.elements):
            if volume is not None:
                digest.update(volume.key.encode())
        return digest.hexdigest()


def _normals(mesh: Mesh) -> NDArray[np.float64]:
    """Return the area-weighted mean normal of each vertex, not normalized; zeros if the mesh is not smooth."""
    vertices = mesh.vertices.astype(np.float64)
    if not mesh.smooth:
        return np.zeros_like(vertices)
    a, b, c = (vertices[mesh.faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    count = len(vertices)
    return np.stack(
        [sum(np.bincount(mesh.faces[:, k], normal[:, axis], minlength=count) for k in range(3)) for axis in range(3)], 1
    )


def _starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the running sum that begins with 0 and ends with the total, int64 (n + 1,)."""
    return np.concatenate([[0], np.cumsum(counts)])
