"""Whether rays depend on how large a scene is, and on how far from the world's origin it lies.

`sizes_and_offsets` moves one scene through twelve orders of magnitude and counts the secondary rays that hit the
triangle they start on, or go on to another one than they should, with their origins moved off the surface as Waechter
and Binder do it ("A fast and robust method for avoiding self-intersection", Ray Tracing Gems, 2019) and by a fixed
distance, as is often done. `far_cameras` moves the camera instead, and `escapes` looks for holes in closed surfaces.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.accuracy.furnace import ball
from simrender.accuracy.partitions import bundle, generator, nearest
from simrender.errors import SceneWarning
from simrender.rays import embree
from simrender.rays.integrators import PathTracing
from simrender.rays.sampling import offset_origin
from simrender.rays.scene import IDENTITY, Mesh, Scene, SceneObject
from simrender.rays.trace import Trace

F64 = NDArray[np.float64]
Ids = NDArray[np.int64]

ANYWHERE = np.array([0.60, 0.64, 0.48])
"""The unit vector along which scenes and cameras are moved: no axis, no diagonal."""


@dataclass(frozen=True)
class Placed:
    """What becomes of a scene's rays where it is placed, and how secondary rays start there.

    Attributes
    ----------
    size : float
        Of the scene, the diagonal of its box.
    offset : float
        Distance of its centre from the world's origin, in sizes.
    scheme : str
        How the origins of secondary rays are moved off their surface; see `SCHEMES`.
    wrong_first : float
        Share of camera rays that meet another triangle than in exact arithmetic, or none.
    self_hits : float
        Share of secondary rays that hit the triangle they start on.
    wrong_next : float
        Share of secondary rays that meet another triangle than in exact arithmetic, or none; self-hits included.

    """

    size: float
    offset: float
    scheme: str
    wrong_first: float
    self_hits: float
    wrong_next: float


SCHEMES = ("as traced", "Waechter-Binder", "1e-4", "1e-4 of the size")
"""As `Trace` does it; by a step of float32 units alone; by a fixed distance; by a share of the scene's size."""


def sizes_and_offsets(sizes: Sequence[float], offsets: Sequence[float], rays: int = 2000) -> list[Placed]:
    """Return what becomes of rays in a furnished room of some sizes, at some distances from the world's origin.

    Parameters
    ----------
    sizes : floats
        Diagonal of the room.
    offsets : floats
        Of the room's centre from the world's origin, in sizes.
    rays : int
        Camera rays, and as many secondary rays, for each of the `SCHEMES`.

    Notes
    -----
    The truth is a search over all triangles in float64, for the room at the origin with coordinates of 53 bits.
    Furniture is between 1/60 and 1/300 of the room in size, and it stands 1/1000 of it off the floor: where a secondary
    ray starts farther off than that, it misses such gaps.

    """
    room = _Room(rays)
    return [row for size in sizes for offset in offsets for row in room.placed(size, offset)]


def far_cameras(distances: Sequence[float], rays: int = 2000) -> list[tuple[float, float]]:
    """Return, for cameras at some distances, the share of their rays that meet another triangle than they should.

    Distances are in sizes of the scene, which is the furniture of `sizes_and_offsets` without the room.
    """
    room = _Room(rays)
    faces = np.ascontiguousarray(room.faces[12:])
    a, b, c = (room.vertices[faces[:, k]] for k in range(3))
    geometry = embree.Geometry(room.vertices.astype(np.float32), faces)
    of = generator(3).integers(0, len(faces), rays)
    target = a[of] + room.uv[0] * (b - a)[of] + room.uv[1] * (c - a)[of]
    rows = []
    for distance in distances:
        eye = np.tile(distance * ANYWHERE, (rays, 1))
        truth = _exact(a, b - a, c - a, eye, target - eye, np.full(rays, -1))
        _, found = nearest(geometry, bundle(eye, target - eye))
        rows.append((float(distance), float((found != truth).mean())))
    return rows


@dataclass(frozen=True)
class Escaped:
    """Rays from inside a closed sphere that get out.

    Attributes
    ----------
    triangles : int
        Of the sphere.
    rays : int
        Aimed at all vertices, as many at the middles of edges, and as many anywhere.
    at_vertices, at_edges, anywhere : int
        How many of each get out.

    """

    triangles: int
    rays: int
    at_vertices: int
    at_edges: int
    anywhere: int


def escapes(rings: Sequence[int], eye: Sequence[float] = (0.25, -0.5, 0.125)) -> list[Escaped]:
    """Return how watertight spheres of some numbers of rings are for a point inside.

    Two triangles that share an edge agree on which side of it a ray passes. But around a vertex each edge is rounded
    for itself, and all together may say that the ray passes outside of all triangles: where edges are short against
    their distance, rays that are aimed at a vertex to the last digit can slip through.
    """
    rows = []
    for count in rings:
        mesh = ball(count)
        geometry = embree.Geometry(mesh.vertices, mesh.faces)
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        middles = 0.5 * (corners + np.roll(corners, 1, axis=1))
        loose = generator(count).standard_normal(corners.shape) + np.asarray(eye)
        out = []
        for targets in (corners, middles, loose):
            _, found = nearest(geometry, bundle(np.asarray(eye), targets.reshape(-1, 3) - np.asarray(eye)))
            out.append(int((found < 0).sum()))
        rows.append(Escaped(len(mesh.faces), 3 * len(mesh.faces), *out))
    return rows


class _Room:
    """A closed room with spheres standing in it, rays through it, and what these meet in exact arithmetic."""

    def __init__(self, rays: int) -> None:
        rng = generator(7)
        vertices, self.faces = _furnished(rng)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        self.vertices: F64 = (vertices - 0.5 * (low + high)) / np.linalg.norm(high - low)
        inside = self.vertices.max(axis=0) * 0.9
        self.eye: F64 = (2.0 * rng.random((rays, 3)) - 1.0) * inside
        self.view = bundle(np.zeros((rays, 3)), (2.0 * rng.random((rays, 3)) - 1.0) * inside - self.eye)["direction"]
        a, e, f = self._edges(self.vertices)
        self.first = _exact(a, e, f, self.eye, self.view.astype(np.float64), np.full(rays, -1))
        # Secondary rays start at points spread evenly over the triangles, small ones too, on the side of the normal.
        self.start = rng.integers(0, len(self.faces), rays)
        u, v = rng.random((2, rays, 1))
        self.uv = np.where(u + v > 1.0, 1.0 - u, u), np.where(u + v > 1.0, 1.0 - v, v)
        self.normal: F64 = np.cross(e, f)[self.start]
        self.normal /= np.linalg.norm(self.normal, axis=1, keepdims=True)
        around = rng.standard_normal((rays, 3))
        around = self.normal + around / np.linalg.norm(around, axis=1, keepdims=True)
        self.bounce = bundle(np.zeros((rays, 3)), around)["direction"]
        point = self._points(a, e, f)
        self.next = _exact(a, e, f, point, self.bounce.astype(np.float64), self.start)

    def placed(self, size: float, offset: float) -> list[Placed]:
        """Return what becomes of the rays where the room is placed."""
        # Placed in float64 and rounded once, as whoever writes a mesh file does.
        vertices = size * (self.vertices + offset * ANYWHERE)
        thing = SceneObject("room", (Mesh(vertices.astype(np.float32), self.faces),))
        scene = Scene((thing,), np.zeros(1, np.int32), IDENTITY[None])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", SceneWarning)  # what they warn of is what is measured here
            trace = Trace(scene, np.eye(4, 3), (1, 1), 1, PathTracing())
        rows = []
        for scheme in SCHEMES:
            factor = trace.factor if scheme == SCHEMES[0] else 1.0
            triangles = (trace.scene if scheme == SCHEMES[0] else scene).triangles
            geometry = embree.Geometry(triangles.vertices, triangles.faces)
            eye = (size * factor * (self.eye + offset * ANYWHERE)).astype(np.float32)
            _, first = nearest(geometry, bundle(eye, self.view))
            corners = self._edges(triangles.vertices.astype(np.float64))
            origin = self._points(*corners).astype(np.float32)
            if scheme in SCHEMES[:2]:
                _offset(origin, origin.view(np.int32), self.normal)
            else:
                origin += ((1e-4 if scheme == SCHEMES[2] else 1e-4 * size) * self.normal).astype(np.float32)
            _, found = nearest(geometry, bundle(origin, self.bounce))
            rows.append(
                Placed(
                    size,
                    offset,
                    scheme,
                    float((first != self.first).mean()),
                    float((found == self.start).mean()),
                    float((found != self.next).mean()),
                )
            )
        return rows

    def _edges(self, vertices: F64) -> tuple[F64, F64, F64]:
        a, b, c = (vertices[self.faces[:, k]] for k in range(3))
        return a, b - a, c - a

    def _points(self, a: F64, e: F64, f: F64) -> F64:
        points: F64 = a[self.start] + self.uv[0] * e[self.start] + self.uv[1] * f[self.start]
        return points


@njit(cache=True, nogil=True, error_model="numpy")
def _offset(origin, bits, normal):  # type: ignore[no-untyped-def]
    for i in range(len(origin)):
        offset_origin(origin, bits, i, normal[i, 0], normal[i, 1], normal[i, 2])


def _furnished(rng: np.random.Generator) -> tuple[F64, NDArray[np.int32]]:
    """Return vertices and faces of a room, normals inwards, and of spheres close above its floor, normals outwards."""
    side, tall, rings = 1.0, 0.4, 7
    walls = np.array([[x, y, z] for z in (0.0, tall) for y in (0.0, side) for x in (0.0, side)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    vertices, faces = [walls], [np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])]
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings), 2 * np.pi * np.arange(8) / 8, indexing="ij")
    ball = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1).reshape(-1, 3)
    i, j = (index.ravel() for index in np.meshgrid(np.arange(rings - 1), np.arange(8), indexing="ij"))
    a, b, c, d = 8 * i + j, 8 * (i + 1) + j, 8 * i + (j + 1) % 8, 8 * (i + 1) + (j + 1) % 8
    skin = np.concatenate([np.stack([a, b, c], 1)[i > 0], np.stack([b, d, c], 1)[i < rings - 2]])
    for row in range(6):
        for column in range(6):
            radius = rng.uniform(0.005, 0.025)
            centre = np.array([(row + 0.5) / 6.0, (column + 0.5) / 6.0, radius + 1.4e-3])
            faces.append(skin + sum(len(v) for v in vertices))
            vertices.append(centre + radius * ball)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _exact(a: F64, e: F64, f: F64, origin: F64, direction: F64, skip: Ids) -> Ids:
    """Return the nearest triangle of each ray but the one to skip, -1 for none, by trying all of them in float64."""
    found = np.full(len(origin), -1)
    _try_all(a, e, f, origin, direction, skip, found)
    return found


@njit(cache=True, nogil=True, error_model="numpy")
def _try_all(a, e, f, origin, direction, skip, found):  # type: ignore[no-untyped-def]
    """Fill in the nearest triangles by the test of Moeller and Trumbore."""
    for i in range(len(origin)):
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        nearest_t = np.inf
        for k in range(len(a)):
            ex, ey, ez, fx, fy, fz = e[k, 0], e[k, 1], e[k, 2], f[k, 0], f[k, 1], f[k, 2]
            px, py, pz = dy * fz - dz * fy, dz * fx - dx * fz, dx * fy - dy * fx
            inverse = 1.0 / (ex * px + ey * py + ez * pz)
            sx, sy, sz = origin[i, 0] - a[k, 0], origin[i, 1] - a[k, 1], origin[i, 2] - a[k, 2]
            u = (sx * px + sy * py + sz * pz) * inverse
            qx, qy, qz = sy * ez - sz * ey, sz * ex - sx * ez, sx * ey - sy * ex
            v, t = (dx * qx + dy * qy + dz * qz) * inverse, (fx * qx + fy * qy + fz * qz) * inverse
            if u >= 0.0 and v >= 0.0 and u + v <= 1.0 and 0.0 < t < nearest_t and k != skip[i]:
                nearest_t, found[i] = t, k
