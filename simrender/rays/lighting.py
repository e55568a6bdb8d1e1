"""Ambient occlusion and path tracing as SpRay does them: many shadow rays a hit, one diffuse ray a hit.

Park, Fussell and Navratil, "SpRay: Speculative ray scheduling for large data visualization", 2018, sections 3 to 5. A
camera or diffuse ray that hits something sends shadow rays; each of these brings its light along and adds it to the
pixel unless something is in the way. Then at most one diffuse ray goes on. Nothing is seen where nothing is hit.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

from simrender.errors import SceneError
from simrender.rays.integrators import AmbientOcclusion, SprayPathTracing
from simrender.rays.kinds import DIFFUSE, SHADOW
from simrender.rays.sampling import cosine_direction, offset_origin, path_key, uniform
from simrender.rays.shading import Surfaces, light_triangle, scattering

# Dimensions of the random numbers at a surface: two for the diffuse ray, then four a shadow ray.
_DIRECTION, _SHADOWS = 0, 2

_MOST = int(np.iinfo(np.uint16).max)


def shade(
    rays: dict[str, Any], hits: Any, surfaces: Surfaces, light: AmbientOcclusion | SprayPathTracing, seed: int
) -> dict[str, Any]:
    """Shade a chunk of rays; what goes in and comes out is that of `shading.shade`.

    Radiance comes from shadow rays that hit nothing, and from surfaces that emit where the camera sees them.
    """
    n = len(rays["kind"])
    if isinstance(light, AmbientOcclusion):
        ambient, each, distance, shine = light.samples, 0, light.distance, (0.0, 1.0)
    else:
        ambient, each, distance, shine = 0, light.shadow_samples, math.inf, (light.specular, light.shininess)
    wide = len(surfaces.light_first) - 1 + len(surfaces.hemispheres)
    most = ambient + each * wide + len(surfaces.points) + 1
    if most > _MOST:
        raise SceneError(f"{most:,} rays a hit are more than the {_MOST:,} that are counted; use fewer shadow samples")
    out: dict[str, Any] = {
        "origin": np.empty((most * n, 3), np.float32),
        "direction": np.empty((most * n, 3), np.float32),
        "throughput": np.empty((most * n, 3), np.float32),
        "reach": np.empty(most * n, np.float32),
        "parent": np.empty(most * n, np.int32),
        "kind": np.empty(most * n, np.uint8),
    }
    radiance, children = np.zeros((n, 3), np.float32), np.zeros(n, np.uint16)
    at = surfaces.at(rays["direction"], scattering(rays, hits), hits.u, hits.v)
    spawned = _light(
        rays["direction"], rays["throughput"], rays["pixel"], rays["sample"], rays["kind"],
        rays["diffuse"], hits.primitive, at,
        surfaces.points, surfaces.hemispheres, surfaces.light_first, surfaces.light_rows,
        ambient, each, distance, *shine, light.bounces, np.uint64(seed), *(light.program_image or (0, 0, 0)),
        radiance, children, out["origin"], out["origin"].view(np.int32), out["direction"], out["throughput"],
        out["reach"], out["parent"], out["kind"],
    )  # fmt: skip
    columns = {name: column[:spawned].copy() for name, column in out.items()}
    parent = columns["parent"]
    for name in ("pixel", "sample", "diffuse", "mirror"):
        columns[name] = rays[name][parent]
    columns["diffuse"] = columns["diffuse"] + (columns["kind"] == DIFFUSE).astype(np.uint8)
    return {"radiance": radiance, "children": children, **columns}


@njit(cache=True, nogil=True, error_model="numpy")
def _program_direction(number, pair, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Return the cosine-distributed direction about a normal that SpRay's program draws.

    Its random numbers are a linear congruential sequence that begins with the Murmur3 hash of a number; ``pair`` pairs
    of them were drawn before. A pair is mapped to the disk concentrically (Shirley and Chiu, "A low distortion map
    between disk and square", 1997).
    """
    mask = np.int64(0xFFFFFFFF)
    k = (np.int64(number) & mask) * 0xCC9E2D51 & mask
    k = (k << 15 | k >> 17) & mask
    k = k * 0x1B873593 & mask
    s = ((k << 13 | k >> 19) & mask) * 5 + 0xE6546B64 & mask
    s ^= s >> 16
    s = s * 0x85EBCA6B & mask
    s ^= s >> 13
    s = s * 0xC2B2AE35 & mask
    s ^= s >> 16
    for _ in range(2 * pair + 1):
        s = s * 1664525 + 1013904223 & mask
    a = 2.0 * np.float64(np.float32(s >> 1) * np.float32(2.0**-31)) - 1.0
    s = s * 1664525 + 1013904223 & mask
    b = 2.0 * np.float64(np.float32(s >> 1) * np.float32(2.0**-31)) - 1.0
    if a == 0.0 and b == 0.0:
        r, theta = 0.0, 0.0
    elif a >= -b:
        if a > b:
            r, theta = a, (b / a if b > 0.0 else 8.0 + b / a)
        else:
            r, theta = b, 2.0 - a / b
    elif a <= b:
        r, theta = -a, 4.0 - b / -a
    else:
        r, theta = -b, 6.0 + a / -b
    x, y = r * math.cos(0.25 * math.pi * theta), r * math.sin(0.25 * math.pi * theta)
    z = math.sqrt(max(0.0, 1.0 - x * x - y * y))
    if nz * nz + ny * ny > nz * nz + nx * nx:
        ux, uy, uz = 0.0, nz, -ny
    else:
        ux, uy, uz = -nz, 0.0, nx
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    ux, uy, uz = ux / length, uy / length, uz / length
    vx, vy, vz = ny * uz - nz * uy, nz * ux - nx * uz, nx * uy - ny * ux
    return ux * x + vx * y + nx * z, uy * x + vy * y + ny * z, uz * x + vz * y + nz * z


@njit(cache=True, nogil=True, error_model="numpy")
def _light(  # type: ignore[no-untyped-def]
    direction, throughput, pixel, sample, kind, depth, primitive, at, points, hemispheres, light_first, light_rows,
    ambient, each, distance, specular, shininess, bounces, seed, width, height, samples,
    radiance, children, out_origin, out_bits, out_direction, out_throughput, out_reach, out_parent, out_kind,
):  # fmt: skip
    n_out = 0
    n_area, n_hemi, n_point = len(light_first) - 1, len(hemispheres), len(points)
    n_wide = n_area + n_hemi
    shadows = ambient + each * n_wide + (0 if ambient > 0 else n_point)
    for i in range(len(kind)):
        missed = primitive[i] < 0
        if kind[i] == SHADOW:
            if missed:
                for c in range(3):
                    radiance[i, c] = throughput[i, c]
            continue
        if missed:
            continue
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        px, py, pz, gx, gy, gz = at[i, 0], at[i, 1], at[i, 2], at[i, 3], at[i, 4], at[i, 5]
        sx, sy, sz, ar, ag, ab = at[i, 6], at[i, 7], at[i, 8], at[i, 9], at[i, 10], at[i, 11]
        if gx == 0.0 and gy == 0.0 and gz == 0.0:
            continue  # a degenerate triangle has no side to scatter to
        if depth[i] == 0:
            for c in range(3):
                radiance[i, c] = throughput[i, c] * at[i, 13 + c]
        tr, tg, tb = np.float64(throughput[i, 0]), np.float64(throughput[i, 1]), np.float64(throughput[i, 2])
        key = path_key(seed, pixel[i], sample[i], 1 + depth[i])
        number = 0
        if width > 0:  # the program counts its pixels from the lowest line up
            number = (height - 1 - pixel[i] // width) * width + pixel[i] % width
        first = n_out

        for ray in range(shadows):
            dimension = _SHADOWS + 4 * ray
            reach = np.inf
            mx, my, mz = 0.0, 0.0, 0.0  # normal of an area light, on the surface's side
            lit = False
            if ray < ambient:
                if width > 0:
                    wx, wy, wz = _program_direction(number * (ray + 1), 0, sx, sy, sz)
                else:
                    wx, wy, wz = cosine_direction(sx, sy, sz, uniform(key, dimension), uniform(key, dimension + 1))
                lr, lg, lb = ar / ambient, ag / ambient, ab / ambient
                reach = distance
            else:
                index = (ray - ambient) // each if ray - ambient < each * n_wide else -1
                if 0 <= index < n_area:
                    area = light_rows[light_first[index + 1] - 1, 15]
                    low = light_triangle(light_first, light_rows, index, uniform(key, dimension))
                    s1, s2 = math.sqrt(uniform(key, dimension + 1)), uniform(key, dimension + 2)
                    w1, w2 = s1 * (1.0 - s2), s1 * s2
                    qx = light_rows[low, 0] + w1 * light_rows[low, 3] + w2 * light_rows[low, 6]
                    qy = light_rows[low, 1] + w1 * light_rows[low, 4] + w2 * light_rows[low, 7]
                    qz = light_rows[low, 2] + w1 * light_rows[low, 5] + w2 * light_rows[low, 8]
                    wx, wy, wz = qx - px, qy - py, qz - pz
                    squared = wx * wx + wy * wy + wz * wz
                    if squared <= 0.0:
                        continue
                    away = math.sqrt(squared)
                    wx, wy, wz = wx / away, wy / away, wz / away
                    mx, my, mz = light_rows[low, 9], light_rows[low, 10], light_rows[low, 11]
                    facing = wx * mx + wy * my + wz * mz
                    if facing > 0.0:
                        mx, my, mz = -mx, -my, -mz
                    geometry = abs(facing) * area / (squared * math.pi * each)
                    er, eg, eb = light_rows[low, 12], light_rows[low, 13], light_rows[low, 14]
                    lit = True
                elif index >= n_area:
                    if width > 0:
                        own = (number * samples + sample[i]) * (depth[i] + 1)
                        wx, wy, wz = _program_direction(own, ray - ambient, sx, sy, sz)
                    else:
                        wx, wy, wz = cosine_direction(sx, sy, sz, uniform(key, dimension), uniform(key, dimension + 1))
                    cosine = wx * sx + wy * sy + wz * sz
                    if cosine <= 0.0:
                        continue
                    # The model's diffuse term has no 1 / pi, and the cosine is in it: what remains is pi / cosine.
                    geometry = math.pi / (cosine * each)
                    er, eg, eb = (
                        hemispheres[index - n_area, 0],
                        hemispheres[index - n_area, 1],
                        hemispheres[index - n_area, 2],
                    )
                else:
                    point = ray - ambient - each * n_wide
                    wx, wy, wz = points[point, 0] - px, points[point, 1] - py, points[point, 2] - pz
                    squared = wx * wx + wy * wy + wz * wz
                    if squared <= 0.0:
                        continue
                    away = math.sqrt(squared)
                    wx, wy, wz = wx / away, wy / away, wz / away
                    geometry = 1.0
                    if points[point, 6] > 0.0:
                        geometry = 1.0 / (squared * math.pi)
                        reach = away
                    er, eg, eb = points[point, 3], points[point, 4], points[point, 5]
                cosine = max(0.0, wx * sx + wy * sy + wz * sz)
                hx, hy, hz = wx - dx, wy - dy, wz - dz
                length = math.sqrt(hx * hx + hy * hy + hz * hz)
                gloss = 0.0
                if length > 0.0:
                    gloss = specular * max(0.0, (hx * sx + hy * sy + hz * sz) / length) ** shininess
                lr = er * geometry * (ar * cosine + gloss)
                lg = eg * geometry * (ag * cosine + gloss)
                lb = eb * geometry * (ab * cosine + gloss)
            lr, lg, lb = lr * tr, lg * tg, lb * tb
            if max(lr, lg, lb) <= 0.0:
                continue
            # The ray starts on the side of the face to which it goes: a smooth normal may point elsewhere.
            side = 1.0 if wx * gx + wy * gy + wz * gz >= 0.0 else -1.0
            if lit:
                # The light's own surface must not shadow it: aim at a point moved off it, from a moved origin.
                out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = qx, qy, qz
                offset_origin(out_origin, out_bits, n_out, mx, my, mz)
                qx, qy, qz = (
                    np.float64(out_origin[n_out, 0]),
                    np.float64(out_origin[n_out, 1]),
                    np.float64(out_origin[n_out, 2]),
                )
            out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = px, py, pz
            offset_origin(out_origin, out_bits, n_out, side * gx, side * gy, side * gz)
            if lit:
                wx, wy, wz = qx - out_origin[n_out, 0], qy - out_origin[n_out, 1], qz - out_origin[n_out, 2]
                reach = math.sqrt(wx * wx + wy * wy + wz * wz)
                wx, wy, wz = wx / reach, wy / reach, wz / reach
            out_direction[n_out, 0], out_direction[n_out, 1], out_direction[n_out, 2] = wx, wy, wz
            out_throughput[n_out, 0], out_throughput[n_out, 1], out_throughput[n_out, 2] = lr, lg, lb
            out_reach[n_out] = reach
            out_parent[n_out], out_kind[n_out] = i, SHADOW
            n_out += 1

        if depth[i] + 1 < bounces and max(tr * ar, tg * ag, tb * ab) > 0.0:
            if width > 0:
                wx, wy, wz = _program_direction((number * samples + sample[i]) * (depth[i] + 1), 0, sx, sy, sz)
            else:
                wx, wy, wz = cosine_direction(sx, sy, sz, uniform(key, _DIRECTION), uniform(key, _DIRECTION + 1))
            side = 1.0 if wx * gx + wy * gy + wz * gz >= 0.0 else -1.0
            out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = px, py, pz
            offset_origin(out_origin, out_bits, n_out, side * gx, side * gy, side * gz)
            out_direction[n_out, 0], out_direction[n_out, 1], out_direction[n_out, 2] = wx, wy, wz
            out_throughput[n_out, 0] = tr * ar
            out_throughput[n_out, 1] = tg * ag
            out_throughput[n_out, 2] = tb * ab
            out_reach[n_out] = np.inf
            out_parent[n_out], out_kind[n_out] = i, DIFFUSE
            n_out += 1
        children[i] = n_out - first
    return n_out
