"""The shade (bounce) step of a path tracer: what a hit contributes, and which rays it spawns.

This is section 4.7 of the ray queue cycling paper: diffuse and mirror-like surfaces under an environment, area lights
and point lights. A diffuse bounce sends one shadow ray to one light, chosen by importance; a path ends at a bounce
limit or by Russian roulette on its throughput. A ray has at most two children, a bounce and a shadow ray.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

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
        self.vertices, self.faces = triangles.vertices, triangles.faces
        self.normals, self.colors, self.uv = scene.vertex_normals(), scene.vertex_colors(), scene.vertex_uv()
        self.material = scene.mesh_material[triangles.mesh]
        rows = [(*m.albedo, m.mirror, *m.emission, m.texture) for m in scene.materials]
        self.materials = np.array(rows, dtype=np.float64).reshape(-1, 8)
        self.texels, self.textures = _texels(scene.textures)
        self.sky = sky_row(scene.environment)
        points = [(*p.position, *p.intensity, float(p.falloff)) for p in scene.points]
        self.points = np.array(points, np.float64).reshape(-1, 7)
        self.hemispheres = np.array(scene.hemispheres, np.float64).reshape(-1, 3)
        emits = np.any(self.materials[:, 4:7] > 0, axis=1)
        self.light_first, self.light_rows = self._area_lights(np.flatnonzero(emits[scene.mesh_material]), scene)

    def _area_lights(self, meshes: NDArray[np.int64], scene: Scene) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the first triangle of each area light, and a row a triangle.

        An area light is the set of all triangles of one emissive mesh, in all its instances; a point on it is chosen by
        area. A row holds a corner, two edges, the unit normal, the emission, the running area within the light, and
        for the share of the area that begins as far down the light as this row, the first row that may lie there.
        """
        first, rows = [0], [np.zeros((0, 17))]
        for mesh in meshes:
            corners = self.vertices[self.faces[scene.triangles.mesh == mesh]].astype(np.float64)
            a, e, f = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
            normal = np.cross(e, f)
            size = np.linalg.norm(normal, axis=1)
            emission = np.tile(self.materials[scene.mesh_material[mesh], 4:7], (len(a), 1))
            solid = size > 0
            running, count = np.cumsum(0.5 * size)[solid], int(solid.sum())
            if count:
                shares = np.arange(count) / count * running[-1] * (1.0 - 1e-15)  # no rounding may begin behind its row
                guide = first[-1] + np.searchsorted(running, shares, side="right")
                unit = normal[solid] / size[solid, None]
                rows.append(np.column_stack([a[solid], e[solid], f[solid], unit, emission[solid], running, guide]))
                first.append(first[-1] + count)
        return np.array(first), np.concatenate(rows)

    def at(self, direction: F32, primitive: NDArray[np.int32], u: F32, v: F32) -> NDArray[np.float64]:
        """Return what there is where rays hit, float64 (n, 16); the rows of rays without a primitive mean nothing.

        The columns are the point (3), the unit normals of the face and of the shading (3 and 3, both towards the
        viewer), the albedo (3), the mirror probability and the emission (3). The point comes from the triangle's
        corners: exact to an ulp however far the ray came (Waechter and Binder). The face normal of a degenerate
        triangle is zero.
        """
        found = np.empty((len(primitive), 16))
        _at(
            direction, primitive, u, v, self.vertices, self.faces, self.normals, self.colors, self.uv, self.material,
            self.materials, self.texels, self.textures, found,
        )  # fmt: skip
        return found


def scattering(rays: dict[str, Any], hits: Hits) -> NDArray[np.int32]:
    """Return what rays hit, -1 for those of which it only matters whether they do."""
    return np.where(rays["kind"] == SHADOW, np.int32(-1), hits.primitive)


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
        "origin": np.empty((2 * n, 3), np.float32),
        "direction": np.empty((2 * n, 3), np.float32),
        "throughput": np.empty((2 * n, 3), np.float32),
        "reach": np.empty(2 * n, np.float32),
        "parent": np.empty(2 * n, np.int32),
        "kind": np.empty(2 * n, np.uint8),
    }
    radiance, children = np.zeros((n, 3), np.float32), np.zeros(n, np.uint16)
    at = surfaces.at(rays["direction"], scattering(rays, hits), hits.u, hits.v)
    spawned = _shade(
        rays["direction"], rays["throughput"], rays["pixel"], rays["sample"], rays["kind"], rays["diffuse"],
        rays["mirror"], hits.primitive, at, surfaces.sky, surfaces.points, surfaces.light_first, surfaces.light_rows,
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


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def light_triangle(light_first, light_rows, light, u):  # type: ignore[no-untyped-def]
    """Return the row of the triangle at a share u of an area light's area."""
    first, last = light_first[light], light_first[light + 1] - 1
    target = u * light_rows[last, 15]
    row = np.int64(light_rows[min(first + np.int64(u * (last - first + 1)), last), 16])
    while row < last and light_rows[row, 15] <= target:
        row += 1
    return row


@njit(cache=True, nogil=True, error_model="numpy")
def sky_color(sky, dx, dy, dz, channel):  # type: ignore[no-untyped-def]
    """Return one channel of what a ray in a direction sees of the sky."""
    height = dx * sky[9] + dy * sky[10] + dz * sky[11]
    if height >= 0.0:
        blend = math.sqrt(height)
        return sky[3 + channel] * (1.0 - blend) + sky[channel] * blend
    blend = math.sqrt(-height)
    return sky[3 + channel] * (1.0 - blend) + sky[6 + channel] * blend


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _texture_color(texels, textures, texture, x, y):  # type: ignore[no-untyped-def]
    """Return the reflectance of a texture at a point, between the middles of four texels."""
    first, width, height = textures[texture, 0], textures[texture, 1], textures[texture, 2]
    x, y = x * width - 0.5, (1.0 - y) * height - 0.5
    left, top = math.floor(x), math.floor(y)
    x, y = x - left, y - top
    red = green = blue = 0.0
    for down in range(2):
        row = first + (np.int64(top) + down) % height * width
        for right in range(2):
            texel = row + (np.int64(left) + right) % width
            weight = (x if right else 1.0 - x) * (y if down else 1.0 - y)
            red += weight * _REFLECTANCE[texels[texel, 0]]
            green += weight * _REFLECTANCE[texels[texel, 1]]
            blue += weight * _REFLECTANCE[texels[texel, 2]]
    return red, green, blue


@njit(cache=True, nogil=True, error_model="numpy")
def _at(  # type: ignore[no-untyped-def]
    direction, primitive, us, vs, vertices, faces, normals, colors, uv, material, materials, texels, textures, found
):
    # One kernel for all hits: an array that is passed to a function at every hit would be counted each time.
    for i in range(len(primitive)):
        p = primitive[i]
        if p < 0:
            continue
        u, v = np.float64(us[i]), np.float64(vs[i])
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        a, b, c = faces[p, 0], faces[p, 1], faces[p, 2]
        # Numba's float() leaves a float32 what it is.
        ax, ay, az = np.float64(vertices[a, 0]), np.float64(vertices[a, 1]), np.float64(vertices[a, 2])
        ex, ey, ez = vertices[b, 0] - ax, vertices[b, 1] - ay, vertices[b, 2] - az
        fx, fy, fz = vertices[c, 0] - ax, vertices[c, 1] - ay, vertices[c, 2] - az
        found[i, 0], found[i, 1], found[i, 2] = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
        gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
        length = math.sqrt(gx * gx + gy * gy + gz * gz)
        if length > 0.0:
            length = -length if gx * dx + gy * dy + gz * dz > 0.0 else length
            gx, gy, gz = gx / length, gy / length, gz / length
        nx, ny, nz = gx, gy, gz
        w = 1.0 - u - v
        if len(normals) > 0 and length != 0.0:
            sx = w * normals[a, 0] + u * normals[b, 0] + v * normals[c, 0]
            sy = w * normals[a, 1] + u * normals[b, 1] + v * normals[c, 1]
            sz = w * normals[a, 2] + u * normals[b, 2] + v * normals[c, 2]
            length = math.sqrt(sx * sx + sy * sy + sz * sz)
            if length > 0.0:
                length = -length if sx * dx + sy * dy + sz * dz > 0.0 else length
                nx, ny, nz = sx / length, sy / length, sz / length
        found[i, 3], found[i, 4], found[i, 5] = gx, gy, gz
        found[i, 6], found[i, 7], found[i, 8] = nx, ny, nz
        m = material[p]
        red, green, blue = materials[m, 0], materials[m, 1], materials[m, 2]
        if len(colors) > 0 and colors[a, 0] >= 0.0:
            red = w * colors[a, 0] + u * colors[b, 0] + v * colors[c, 0]
            green = w * colors[a, 1] + u * colors[b, 1] + v * colors[c, 1]
            blue = w * colors[a, 2] + u * colors[b, 2] + v * colors[c, 2]
        texture = np.int64(materials[m, 7])
        if texture >= 0:
            x = w * uv[a, 0] + u * uv[b, 0] + v * uv[c, 0]
            y = w * uv[a, 1] + u * uv[b, 1] + v * uv[c, 1]
            r, g, b_ = _texture_color(texels, textures, texture, x, y)
            red, green, blue = red * r, green * g, blue * b_
        found[i, 9], found[i, 10], found[i, 11] = red, green, blue
        for k in range(4):
            found[i, 12 + k] = materials[m, 3 + k]


def headlight(directions: F32, sky: Environment, hits: Hits | None, surfaces: Surfaces | None) -> F32:
    """Return what rays see, float32 (n, 3): triangles lit from the viewer, else the sky."""
    seen = np.zeros((len(directions), 3), np.float32)
    if hits is None or surfaces is None:
        nothing = np.full(len(directions), -1, np.int32)
        _headlight(directions, sky_row(sky), nothing, np.zeros((0, 16)), seen)
    else:
        at = surfaces.at(directions, hits.primitive, hits.u, hits.v)
        _headlight(directions, sky_row(sky), hits.primitive, at, seen)
    return seen


@njit(cache=True, nogil=True, error_model="numpy")
def _headlight(direction, sky, primitive, at, seen):  # type: ignore[no-untyped-def]
    for i in range(len(direction)):
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        if primitive[i] < 0:
            for c in range(3):
                seen[i, c] = sky_color(sky, dx, dy, dz, c)
            continue
        facing = abs(dx * at[i, 6] + dy * at[i, 7] + dz * at[i, 8])
        for c in range(3):
            seen[i, c] = at[i, 9 + c] * (1.0 - _FACING + _FACING * facing)


@njit(cache=True, nogil=True, error_model="numpy")
def _shade(  # type: ignore[no-untyped-def]
    direction, throughput, pixel, sample, kind, diffuse_bounces, mirror_bounces, primitive, at,
    sky, points, light_first, light_rows,
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

        px, py, pz, gx, gy, gz = at[i, 0], at[i, 1], at[i, 2], at[i, 3], at[i, 4], at[i, 5]
        nx, ny, nz, ar, ag, ab = at[i, 6], at[i, 7], at[i, 8], at[i, 9], at[i, 10], at[i, 11]
        if gx == 0.0 and gy == 0.0 and gz == 0.0:
            continue  # a degenerate triangle has no side to scatter to

        if kind[i] != DIFFUSE:  # light that reached a diffuse bounce directly was counted by its shadow ray
            for c in range(3):
                radiance[i, c] = throughput[i, c] * at[i, 13 + c]

        key = path_key(seed, pixel[i], sample[i], 1 + diffuse_bounces[i] + mirror_bounces[i])
        is_mirror = uniform(key, _LOBE) < at[i, 12]
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
            low = np.int64(0)
            if light < n_area:
                area = light_rows[light_first[light + 1] - 1, 15]
                low = light_triangle(light_first, light_rows, light, uniform(key, dimension))
                s1, s2 = math.sqrt(uniform(key, dimension + 1)), uniform(key, dimension + 2)
                w1, w2 = s1 * (1.0 - s2), s1 * s2
                lx = light_rows[low, 0] + w1 * light_rows[low, 3] + w2 * light_rows[low, 6]
                ly = light_rows[low, 1] + w1 * light_rows[low, 4] + w2 * light_rows[low, 7]
                lz = light_rows[low, 2] + w1 * light_rows[low, 5] + w2 * light_rows[low, 8]
            else:
                lx, ly, lz = points[light - n_area, 0], points[light - n_area, 1], points[light - n_area, 2]
            wx, wy, wz = lx - px, ly - py, lz - pz
            along = wx * nx + wy * ny + wz * nz
            if along <= 0.0:
                continue
            squared = wx * wx + wy * wy + wz * wz
            away = math.sqrt(squared)
            cosine = along / away
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
