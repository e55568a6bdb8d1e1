"""The shade (bounce) step of a path tracer: what a hit contributes, and which rays it spawns.

This is section 4.7 of the ray queue cycling paper: diffuse and mirror-like surfaces under an environment, area lights
and point lights. A diffuse bounce sends one shadow ray to one light, chosen by importance; a path ends at a bounce
limit or by Russian roulette on its throughput. A ray has at most two children, a bounce and a shadow ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.rays.integrators import PathTracing
from simrender.rays.kinds import DIFFUSE, MIRROR, SHADOW
from simrender.rays.sampling import cosine_direction, offset_origin, path_key, uniform
from simrender.rays.scene import GAMMA, Environment, Scene, Texture

if TYPE_CHECKING:
    from simrender.rays.embree import Hits

F32 = NDArray[np.float32]

# Dimensions of the random numbers at a surface; lights use two (which, by reservoir) plus three (where) each.
_LOBE, _ROULETTE, _DIRECTION, _LIGHTS = 0, 1, 2, 4
_JITTER = 0

_FACING = 0.7
"""Share of a surface's brightness under a headlight that depends on the angle at which it is seen."""

_REFLECTANCE = (np.arange(256) / 255.0) ** GAMMA


class Looks(NamedTuple):
    """What kernels need to know of a scene's surfaces.

    Attributes
    ----------
    vertices : float32 array (v, 3)
    faces : int32 array (t, 3)
    normals : float32 array (v, 3) or (0, 3)
    colors : float32 array (v, 3) or (0, 3)
        Negative where the vertex has none.
    uv : float32 array (v, 2) or (0, 2)
    material : int32 array (t,)
        Row of each triangle in ``materials``.
    materials : float64 array (m, 8)
        Albedo, mirror, emission, texture.
    texels : uint8 array (n, 3)
        Of all textures, one after the other.
    textures : int64 array (k, 3)
        First row, width and height of each.

    """

    vertices: F32
    faces: NDArray[np.int32]
    normals: F32
    colors: F32
    uv: F32
    material: NDArray[np.int32]
    materials: NDArray[np.float64]
    texels: NDArray[np.uint8]
    textures: NDArray[np.int64]


def _texels(textures: Sequence[Texture]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Return all texels in one array, and where each texture lies in it."""
    sizes = np.array([image.texels.shape[:2] for image in textures], np.int64).reshape(-1, 2)
    first = np.cumsum(sizes.prod(axis=1)) - sizes.prod(axis=1)
    texels = np.concatenate([np.zeros((0, 3), np.uint8), *(image.texels.reshape(-1, 3) for image in textures)])
    return texels, np.column_stack([first, sizes[:, ::-1]])


class Surfaces:
    """A scene's materials and lights as flat arrays, for the kernel.

    Parameters
    ----------
    scene : Scene

    """

    def __init__(self, scene: Scene) -> None:
        triangles = scene.triangles
        rows = [(*m.albedo, m.mirror, *m.emission, m.texture) for m in scene.materials]
        self.looks = Looks(
            triangles.vertices, triangles.faces, scene.vertex_normals(), scene.vertex_colors(), scene.vertex_uv(),
            scene.mesh_material[triangles.mesh], np.array(rows, dtype=np.float64).reshape(-1, 8),
            *_texels(scene.textures),
        )  # fmt: skip
        self.sky = sky_row(scene.environment)
        points = [(*p.position, *p.intensity, float(p.falloff)) for p in scene.points]
        self.points = np.array(points, np.float64).reshape(-1, 7)
        self.hemispheres = np.array(scene.hemispheres, np.float64).reshape(-1, 3)
        emits = np.any(self.looks.materials[:, 4:7] > 0, axis=1)
        self.light_first, self.light_rows = self._area_lights(np.flatnonzero(emits[scene.mesh_material]), scene)

    def _area_lights(self, meshes: NDArray[np.int64], scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the first triangle of each area light, and a row a triangle.

        An area light is the set of all triangles of one emissive mesh, in all its instances; a point on it is chosen by
        area. A row holds a corner, two edges, the unit normal, the emission, and the running area within the light.
        """
        first, rows = [0], [np.zeros((0, 16))]
        for mesh in meshes:
            corners = self.looks.vertices[self.looks.faces[scene.triangles.mesh == mesh]].astype(np.float64)
            a, e, f = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            normal = np.cross(e, f)
            size = np.linalg.norm(normal, axis=1)
            emission = np.tile(self.looks.materials[scene.mesh_material[mesh], 4:7], (len(a), 1))
            solid = size > 0
            table = np.column_stack(
                [a, e, f, normal / np.where(solid, size, 1.0)[:, None], emission, np.cumsum(0.5 * size)]
            )
            if solid.any():
                rows.append(table[solid])
                first.append(first[-1] + int(solid.sum()))
        return np.array(first), np.concatenate(rows)


_NO_LOOKS = Looks(
    *(np.zeros(shape, kind) for shape, kind in (
        ((0, 3), np.float32), ((0, 3), np.int32), ((0, 3), np.float32), ((0, 3), np.float32), ((0, 2), np.float32),
        ((0,), np.int32), ((0, 8), np.float64), ((0, 3), np.uint8), ((0, 3), np.int64),
    ))
)  # fmt: skip


def sky_row(sky: Environment) -> NDArray[np.float64]:
    """Return an environment as kernels take it, float64 (12,)."""
    return np.array([*sky.zenith, *sky.horizon, *sky.ground, *sky.up], dtype=np.float64)


def camera_rays(
    camera: NDArray[np.float64], size: tuple[int, int], seed: int, sample: int, *, jitter: bool = True
) -> tuple[Any, Any]:
    """Return origins and unit directions of one ray a pixel, float32 (height * width, 3), row by row from the top.

    Parameters
    ----------
    camera : float64 array (4, 3)
        Position, and the image plane at distance 1: forward, right (half its width long), up (half its height long).
    size : (width, height)
    seed, sample : int
        Each sample of a pixel goes through another random point of it.
    jitter : bool
        False sends every ray through its pixel's lower left corner, as SpRay does with one sample a pixel.

    """
    width, height = size
    origins = np.zeros((width * height, 3), np.float32)
    directions = np.zeros((width * height, 3), np.float32)
    _camera_rays(camera, width, height, np.uint64(seed), sample, jitter, origins, directions)
    return origins, directions


@njit(cache=True, nogil=True, error_model="numpy")
def _camera_rays(camera, width, height, seed, sample, jitter, origins, directions):  # type: ignore[no-untyped-def]
    for pixel in range(width * height):
        key = path_key(seed, pixel, sample, 0)
        right, down = (uniform(key, _JITTER), uniform(key, _JITTER + 1)) if jitter else (0.0, 1.0)
        x = 2.0 * (pixel % width + right) / width - 1.0
        y = 1.0 - 2.0 * (pixel // width + down) / height
        length = 0.0
        for axis in range(3):
            component = camera[1, axis] + x * camera[2, axis] + y * camera[3, axis]
            directions[pixel, axis] = component
            length += component * component
        for axis in range(3):
            origins[pixel, axis] = camera[0, axis]
            directions[pixel, axis] /= math.sqrt(length)


def shade(rays: dict[str, Any], hits: Any, surfaces: Surfaces, path: PathTracing, seed: int) -> dict[str, Any]:
    """Shade a chunk of rays.

    Parameters
    ----------
    rays : dict of arrays
        The columns of the ray table: origin, direction, reach, throughput, pixel, sample, kind, diffuse, mirror.
    hits : Hits
        Their nearest hits in the whole scene.

    Returns
    -------
    dict of arrays
        For each ray ``radiance`` (float32 (n, 3), what it adds to its pixel) and ``children`` (uint16 (n,), how many it
        spawns); for its children, in the order of their parents, the columns of the ray table.

    """
    n = len(rays["kind"])
    out: dict[str, Any] = {
        "origin": np.zeros((2 * n, 3), np.float32),
        "direction": np.zeros((2 * n, 3), np.float32),
        "throughput": np.zeros((2 * n, 3), np.float32),
        "reach": np.zeros(2 * n, np.float32),
        "parent": np.zeros(2 * n, np.int32),
        "kind": np.zeros(2 * n, np.uint8),
    }
    radiance, children = np.zeros((n, 3), np.float32), np.zeros(n, np.uint16)
    spawned = _shade(
        rays["direction"], rays["throughput"], rays["pixel"], rays["sample"], rays["kind"], rays["diffuse"],
        rays["mirror"], hits.primitive, hits.u, hits.v,
        surfaces.looks, surfaces.sky, surfaces.points, surfaces.light_first, surfaces.light_rows,
        path.diffuse, path.mirror, path.roulette, np.uint64(seed),
        radiance, children, out["origin"], out["origin"].view(np.int32), out["direction"], out["throughput"],
        out["reach"], out["parent"], out["kind"],
    )  # fmt: skip
    columns = {name: column[:spawned] for name, column in out.items()}
    parent = columns["parent"]
    for name in ("pixel", "sample", "diffuse", "mirror"):
        columns[name] = rays[name][parent]
    columns["diffuse"] = columns["diffuse"] + (columns["kind"] == DIFFUSE).astype(np.uint8)
    columns["mirror"] = columns["mirror"] + (columns["kind"] == MIRROR).astype(np.uint8)
    return {"radiance": radiance, "children": children, **columns}


@njit(cache=True, nogil=True, error_model="numpy")
def sky_color(sky, dx, dy, dz, channel):  # type: ignore[no-untyped-def]
    """Return one channel of what a ray in a direction sees of the sky."""
    height = dx * sky[9] + dy * sky[10] + dz * sky[11]
    if height >= 0.0:
        blend = math.sqrt(height)
        return sky[3 + channel] * (1.0 - blend) + sky[channel] * blend
    blend = math.sqrt(-height)
    return sky[3 + channel] * (1.0 - blend) + sky[6 + channel] * blend


@njit(cache=True, nogil=True, error_model="numpy")
def texture_color(looks, texture, x, y):  # type: ignore[no-untyped-def]
    """Return the reflectance of a texture at a point, between the middles of four texels."""
    first, width, height = looks.textures[texture, 0], looks.textures[texture, 1], looks.textures[texture, 2]
    x, y = x * width - 0.5, (1.0 - y) * height - 0.5
    left, top = math.floor(x), math.floor(y)
    x, y = x - left, y - top
    red = green = blue = 0.0
    for down in range(2):
        row = first + (np.int64(top) + down) % height * width
        for right in range(2):
            texel = row + (np.int64(left) + right) % width
            weight = (x if right else 1.0 - x) * (y if down else 1.0 - y)
            red += weight * _REFLECTANCE[looks.texels[texel, 0]]
            green += weight * _REFLECTANCE[looks.texels[texel, 1]]
            blue += weight * _REFLECTANCE[looks.texels[texel, 2]]
    return red, green, blue


@njit(cache=True, nogil=True, error_model="numpy")
def surface_point(primitive, u, v, dx, dy, dz, looks):  # type: ignore[no-untyped-def]
    """Return a hit's point, the face's unit normal, the shading normal (both towards the viewer) and the albedo.

    The point comes from the triangle's corners: exact to an ulp however far the ray came (Waechter and Binder). The
    face normal of a degenerate triangle is zero.
    """
    vertices, faces, normals, colors = looks.vertices, looks.faces, looks.normals, looks.colors
    a, b, c = faces[primitive, 0], faces[primitive, 1], faces[primitive, 2]
    # Numba's float() leaves a float32 what it is.
    ax, ay, az = np.float64(vertices[a, 0]), np.float64(vertices[a, 1]), np.float64(vertices[a, 2])
    ex, ey, ez = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
    fx, fy, fz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
    px, py, pz = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
    gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
    length = math.sqrt(gx * gx + gy * gy + gz * gz)
    m = looks.material[primitive]
    ar, ag, ab = looks.materials[m, 0], looks.materials[m, 1], looks.materials[m, 2]
    if length == 0.0:
        return px, py, pz, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, ar, ag, ab
    length = -length if gx * dx + gy * dy + gz * dz > 0.0 else length
    gx, gy, gz = gx / length, gy / length, gz / length
    nx, ny, nz = gx, gy, gz
    w = 1.0 - u - v
    if len(normals) > 0:
        sx = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
        sy = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
        sz = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
        length = math.sqrt(sx * sx + sy * sy + sz * sz)
        if length > 0.0:
            length = -length if sx * dx + sy * dy + sz * dz > 0.0 else length
            nx, ny, nz = sx / length, sy / length, sz / length
    if len(colors) > 0 and colors[a, 0] >= 0.0:
        ar = w * colors[a, 0] + u * colors[b, 0] + v * colors[c, 0]
        ag = w * colors[a, 1] + u * colors[b, 1] + v * colors[c, 1]
        ab = w * colors[a, 2] + u * colors[b, 2] + v * colors[c, 2]
    texture = np.int64(looks.materials[m, 7])
    if texture >= 0:
        x = w * looks.uv[a, 0] + u * looks.uv[b, 0] + v * looks.uv[c, 0]
        y = w * looks.uv[a, 1] + u * looks.uv[b, 1] + v * looks.uv[c, 1]
        tr, tg, tb = texture_color(looks, texture, x, y)
        ar, ag, ab = ar * tr, ag * tg, ab * tb
    return px, py, pz, gx, gy, gz, nx, ny, nz, ar, ag, ab


def headlight(directions: F32, sky: Environment, hits: Hits | None, surfaces: Surfaces | None) -> F32:
    """Return what rays see, float32 (n, 3): triangles lit from the viewer, else the sky."""
    seen = np.zeros((len(directions), 3), np.float32)
    if hits is None or surfaces is None:
        nothing, flat = np.full(len(directions), -1, np.int32), np.zeros(len(directions), np.float32)
        _headlight(directions, sky_row(sky), nothing, flat, flat, _NO_LOOKS, seen)
    else:
        _headlight(directions, sky_row(sky), hits.primitive, hits.u, hits.v, surfaces.looks, seen)
    return seen


@njit(cache=True, nogil=True, error_model="numpy")
def _headlight(direction, sky, primitive, u, v, looks, seen):  # type: ignore[no-untyped-def]
    for i in range(len(direction)):
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        if primitive[i] < 0:
            for c in range(3):
                seen[i, c] = sky_color(sky, dx, dy, dz, c)
            continue
        point = surface_point(primitive[i], np.float64(u[i]), np.float64(v[i]), dx, dy, dz, looks)
        facing = abs(dx * point[6] + dy * point[7] + dz * point[8])
        for c in range(3):
            seen[i, c] = point[9 + c] * (1.0 - _FACING + _FACING * facing)


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(  # type: ignore[no-untyped-def]
    direction, throughput, pixel, sample, kind, diffuse_bounces, mirror_bounces, primitive, u, v,
    looks, sky, points, light_first, light_rows,
    most_diffuse, most_mirror, roulette, seed,
    radiance, children, out_origin, out_bits, out_direction, out_throughput, out_reach, out_parent, out_kind,
):  # fmt: skip
    n_out = 0
    n_area, n_point = len(light_first) - 1, len(points)
    for i in range(len(kind)):
        missed = primitive[i] < 0
        if kind[i] == SHADOW:
            if missed:
                for c in range(3):
                    radiance[i, c] = throughput[i, c]
            continue
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        if missed:
            for c in range(3):
                radiance[i, c] = throughput[i, c] * sky_color(sky, dx, dy, dz, c)
            continue

        px, py, pz, gx, gy, gz, nx, ny, nz, ar, ag, ab = surface_point(
            primitive[i], np.float64(u[i]), np.float64(v[i]), dx, dy, dz, looks
        )
        if gx == 0.0 and gy == 0.0 and gz == 0.0:
            continue  # a degenerate triangle has no side to scatter to

        m = looks.material[primitive[i]]
        if kind[i] != DIFFUSE:  # light that reached a diffuse bounce directly was counted by its shadow ray
            for c in range(3):
                radiance[i, c] = throughput[i, c] * looks.materials[m, 4 + c]

        key = path_key(seed, pixel[i], sample[i], 1 + diffuse_bounces[i] + mirror_bounces[i])
        is_mirror = uniform(key, _LOBE) < looks.materials[m, 3]
        if (is_mirror and mirror_bounces[i] >= most_mirror) or (not is_mirror and diffuse_bounces[i] >= most_diffuse):
            continue
        tr, tg, tb = throughput[i, 0] * ar, throughput[i, 1] * ag, throughput[i, 2] * ab
        strongest = max(tr, tg, tb)
        if strongest <= 0.0:
            continue

        survival = min(1.0, strongest / roulette) if roulette > 0.0 else 1.0
        if uniform(key, _ROULETTE) < survival:
            if is_mirror:
                twice = 2.0 * (dx * nx + dy * ny + dz * nz)
                ox, oy, oz = dx - twice * nx, dy - twice * ny, dz - twice * nz
            else:
                ox, oy, oz = cosine_direction(nx, ny, nz, uniform(key, _DIRECTION), uniform(key, _DIRECTION + 1))
            out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = px, py, pz
            # The ray starts on the side of the face to which it goes: a smooth normal may point elsewhere.
            side = 1.0 if ox * gx + oy * gy + oz * gz >= 0.0 else -1.0
            offset_origin(out_origin, out_bits, n_out, side * gx, side * gy, side * gz)
            out_direction[n_out, 0], out_direction[n_out, 1], out_direction[n_out, 2] = ox, oy, oz
            out_throughput[n_out, 0] = tr / survival
            out_throughput[n_out, 1] = tg / survival
            out_throughput[n_out, 2] = tb / survival
            out_reach[n_out] = np.inf
            out_parent[n_out], out_kind[n_out] = i, MIRROR if is_mirror else DIFFUSE
            children[i] += 1
            n_out += 1
        if is_mirror:
            continue

        # One candidate a light, kept with a probability proportional to the light it would carry (reservoir sampling).
        total, kept, kx, ky, kz, kr, kg, kb = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        kept_area = False
        mx, my, mz = 0.0, 0.0, 0.0
        for light in range(n_area + n_point):
            dimension = _LIGHTS + 4 * light
            low = 0
            if light < n_area:
                low, high = light_first[light], light_first[light + 1] - 1
                area = light_rows[high, 15]
                target = uniform(key, dimension) * area
                while low < high:
                    middle = (low + high) // 2
                    if light_rows[middle, 15] <= target:
                        low = middle + 1
                    else:
                        high = middle
                s1, s2 = math.sqrt(uniform(key, dimension + 1)), uniform(key, dimension + 2)
                w1, w2 = s1 * (1.0 - s2), s1 * s2
                lx = light_rows[low, 0] + w1 * light_rows[low, 3] + w2 * light_rows[low, 6]
                ly = light_rows[low, 1] + w1 * light_rows[low, 4] + w2 * light_rows[low, 7]
                lz = light_rows[low, 2] + w1 * light_rows[low, 5] + w2 * light_rows[low, 8]
            else:
                lx, ly, lz = points[light - n_area, 0], points[light - n_area, 1], points[light - n_area, 2]
            wx, wy, wz = lx - px, ly - py, lz - pz
            squared = wx * wx + wy * wy + wz * wz
            if squared <= 0.0:
                continue
            away = math.sqrt(squared)
            cosine = (wx * nx + wy * ny + wz * nz) / away
            if cosine <= 0.0:
                continue
            if light < n_area:
                sx, sy, sz = light_rows[low, 9], light_rows[low, 10], light_rows[low, 11]
                facing = (wx * sx + wy * sy + wz * sz) / away
                geometry = cosine * abs(facing) * area / (squared * math.pi)
                cr, cg, cb = (
                    tr * light_rows[low, 12] * geometry,
                    tg * light_rows[low, 13] * geometry,
                    tb * light_rows[low, 14] * geometry,
                )
                # The light's own surface must not shadow it: aim at a point moved off it, towards the ray.
                flip = -1.0 if facing > 0.0 else 1.0
                sx, sy, sz = flip * sx, flip * sy, flip * sz
            else:
                geometry = cosine / math.pi if points[light - n_area, 6] == 0.0 else cosine / (squared * math.pi)
                cr, cg, cb = (
                    tr * points[light - n_area, 3] * geometry,
                    tg * points[light - n_area, 4] * geometry,
                    tb * points[light - n_area, 5] * geometry,
                )
                sx, sy, sz = 0.0, 0.0, 0.0
            weight = 0.2126 * cr + 0.7152 * cg + 0.0722 * cb
            total += weight
            if weight > 0.0 and uniform(key, dimension + 3) * total < weight:
                kept, kx, ky, kz, kr, kg, kb = weight, lx, ly, lz, cr, cg, cb
                kept_area, mx, my, mz = light < n_area, sx, sy, sz
        if kept <= 0.0:
            continue
        # The origin's row serves as scratch for the target, so that it is offset in float32 like any origin.
        if kept_area:
            out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = kx, ky, kz
            offset_origin(out_origin, out_bits, n_out, mx, my, mz)
            kx, ky, kz = out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2]
        side = 1.0 if (kx - px) * gx + (ky - py) * gy + (kz - pz) * gz >= 0.0 else -1.0
        out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = px, py, pz
        offset_origin(out_origin, out_bits, n_out, side * gx, side * gy, side * gz)
        wx, wy, wz = kx - out_origin[n_out, 0], ky - out_origin[n_out, 1], kz - out_origin[n_out, 2]
        away = math.sqrt(wx * wx + wy * wy + wz * wz)
        out_direction[n_out, 0], out_direction[n_out, 1], out_direction[n_out, 2] = wx / away, wy / away, wz / away
        out_throughput[n_out, 0] = kr * total / kept
        out_throughput[n_out, 1] = kg * total / kept
        out_throughput[n_out, 2] = kb * total / kept
        out_reach[n_out] = away
        out_parent[n_out], out_kind[n_out] = i, SHADOW
        children[i] += 1
        n_out += 1
    return n_out
