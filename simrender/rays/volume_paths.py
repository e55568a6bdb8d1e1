"""Path tracing through volumes: what a collision, an isosurface or a triangle does to a path.

This is the renderer of section 6 of the islands paper: Woodcock tracking finds where a path interacts, an isotropic
phase function says where it goes, and a path never splits. Where there is a light, a collision in the medium turns the
path into a shadow ray to it with some probability; isosurfaces and triangles scatter diffusely. A path that leaves
brings the sky's radiance along.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.rays.integrators import VolumePathTracing
from simrender.rays.kinds import SCATTER, SHADOW
from simrender.rays.marching import gradients
from simrender.rays.sampling import cosine_direction, offset_origin, path_key, uniform
from simrender.rays.scene import Scene
from simrender.rays.shading import sky_color, sky_row
from simrender.rays.tracking import isotropic_direction

if TYPE_CHECKING:
    from simrender.rays.embree import Hits
    from simrender.rays.shading import Surfaces
    from simrender.rays.tracking import Tracked

Columns = dict[str, Any]
F32 = NDArray[np.float32]

# Dimensions of the random numbers at a collision.
_ROULETTE, _TURN, _LIGHT, _DIRECTION = 0, 1, 2, 3

_NONE, _COLLISION, _ISOSURFACE, _TRIANGLE = 0, 1, 2, 3

_OFF_ISOSURFACE = 1e-3
"""Voxels by which a path starts off an isosurface, whose place is known to fewer digits than a triangle's."""


def tracking_keys(rays: Columns, seed: int) -> NDArray[np.uint64]:
    """Return the key of each ray's free flight, uint64 (n,): of its path, its depth, and whether it looks for light."""
    keys = np.zeros(len(rays["kind"]), np.uint64)
    _tracking_keys(np.uint64(seed), rays["pixel"], rays["sample"], rays["kind"], rays["diffuse"], keys)
    return keys


@njit(cache=True, nogil=True, error_model="numpy")
def _tracking_keys(seed, pixel, sample, kind, depth, keys):  # type: ignore[no-untyped-def]
    for i in range(len(kind)):
        # Depths 0, 1, 2 ... are those of the shading kernels; a shadow ray has its parent's depth.
        keys[i] = path_key(seed, pixel[i], sample[i], (1 << 20) + 2 * np.int64(depth[i]) + (kind[i] == SHADOW))


def scatter(
    rays: Columns,
    tracked: Tracked,
    hits: Hits | None,
    surfaces: Surfaces | None,
    scene: Scene,
    light: VolumePathTracing,
    seed: int,
) -> Columns:
    """Return what rays contribute and spawn where they interact; the columns are those of `worlds.World.follow`.

    Parameters
    ----------
    rays : dict of arrays
        Columns of the ray table.
    tracked : Tracked
        Where each ray collides, no further than its nearest triangle.
    hits, surfaces : Hits and Surfaces, or None
        The nearest triangles, and all of them.
    scene : Scene
    light : VolumePathTracing
    seed : int

    """
    volume = scene.volume
    assert volume is not None  # noqa: S101 - the caller's world has one
    n = len(rays["kind"])
    event = tracked.event.astype(np.int8)
    t = tracked.t.astype(np.float64)
    primitive = np.full(n, -1, np.int32)
    if hits is not None:
        nearer = (event == _NONE) & (hits.primitive >= 0)
        event[nearer] = _TRIANGLE
        t[nearer] = hits.t[nearer]
        primitive[nearer] = hits.primitive[nearer]

    point, normal, albedo = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 3))
    inside = np.flatnonzero((event == _COLLISION) | (event == _ISOSURFACE))
    direction = rays["direction"][inside].astype(np.float64)
    point[inside] = rays["origin"][inside] + t[inside, None] * direction
    albedo[inside] = volume.transfer.color(tracked.value[inside])
    iso = np.flatnonzero(event == _ISOSURFACE)
    if len(iso):
        which = np.abs(np.subtract.outer(tracked.value[iso], volume.isovalues)).argmin(axis=1)
        albedo[iso] = np.array(volume.iso_colors)[which]
        slope = gradients(volume, point[iso]).astype(np.float64)
        length = np.linalg.norm(slope, axis=1, keepdims=True)
        away = -rays["direction"][iso].astype(np.float64)
        slope = np.where(length > 0.0, slope / np.where(length > 0.0, length, 1.0), away)
        normal[iso] = np.where((slope * away).sum(axis=1, keepdims=True) < 0.0, -slope, slope)
        point[iso] += _OFF_ISOSURFACE * min(volume.spacing) * normal[iso]

    emitted = np.zeros((n, 3))
    if hits is not None and surfaces is not None:
        on = np.flatnonzero(event == _TRIANGLE)
        primitives = np.where(event == _TRIANGLE, hits.primitive, np.int32(-1))
        at = surfaces.at(rays["direction"], primitives, hits.u, hits.v)[on]
        point[on], normal[on], albedo[on], emitted[on] = at[:, :3], at[:, 3:6], at[:, 9:12], at[:, 13:]

    points = [(*p.position, *p.intensity, float(p.falloff)) for p in scene.points]
    out: Columns = {
        "origin": np.zeros((n, 3), np.float32),
        "direction": np.zeros((n, 3), np.float32),
        "throughput": np.zeros((n, 3), np.float32),
        "reach": np.zeros(n, np.float32),
        "parent": np.zeros(n, np.int32),
        "kind": np.zeros(n, np.uint8),
    }
    radiance, children = np.zeros((n, 3), np.float32), np.zeros(n, np.uint16)
    spawned = _scatter(
        rays["direction"], rays["throughput"], rays["pixel"], rays["sample"], rays["kind"], rays["diffuse"],
        event, point, normal, albedo, emitted, sky_row(scene.environment), np.array(points, np.float64).reshape(-1, 7),
        light.bounces, light.shadow_probability, light.roulette, np.uint64(seed), radiance, children,
        out["origin"], out["origin"].view(np.int32), out["direction"], out["throughput"], out["reach"], out["parent"],
        out["kind"],
    )  # fmt: skip
    columns = {name: column[:spawned].copy() for name, column in out.items()}
    parent = columns["parent"]
    for name in ("pixel", "sample", "diffuse", "mirror"):
        columns[name] = rays[name][parent]
    columns["diffuse"] = columns["diffuse"] + (columns["kind"] == SCATTER).astype(np.uint8)
    return {
        "t": t.astype(np.float32),
        "primitive": primitive,
        "radiance": radiance,
        "children": children,
        **columns,
    }


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(  # type: ignore[no-untyped-def]
    direction, throughput, pixel, sample, kind, depth, event, point, normal, albedo, emitted, sky, points,
    bounces, shadow_probability, roulette, seed, radiance, children,
    out_origin, out_bits, out_direction, out_throughput, out_reach, out_parent, out_kind,
):  # fmt: skip
    n_out = 0
    for i in range(len(kind)):
        if kind[i] == SHADOW:
            if event[i] == _NONE:
                for c in range(3):
                    radiance[i, c] = throughput[i, c]
            continue
        dx, dy, dz = np.float64(direction[i, 0]), np.float64(direction[i, 1]), np.float64(direction[i, 2])
        if event[i] == _NONE:
            for c in range(3):
                radiance[i, c] = throughput[i, c] * sky_color(sky, dx, dy, dz, c)
            continue
        for c in range(3):
            radiance[i, c] = throughput[i, c] * emitted[i, c]
        nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
        if depth[i] >= bounces or (event[i] != _COLLISION and nx == 0.0 and ny == 0.0 and nz == 0.0):
            continue
        tr, tg, tb = throughput[i, 0] * albedo[i, 0], throughput[i, 1] * albedo[i, 1], throughput[i, 2] * albedo[i, 2]
        strongest = max(tr, tg, tb)
        if strongest <= 0.0:
            continue
        key = path_key(seed, pixel[i], sample[i], 1 + depth[i])
        survival = min(1.0, strongest / roulette) if roulette > 0.0 else 1.0
        if uniform(key, _ROULETTE) >= survival:
            continue
        tr, tg, tb = tr / survival, tg / survival, tb / survival

        out_origin[n_out, 0], out_origin[n_out, 1], out_origin[n_out, 2] = point[i, 0], point[i, 1], point[i, 2]
        if event[i] == _TRIANGLE:
            offset_origin(out_origin, out_bits, n_out, nx, ny, nz)
        chance = shadow_probability if event[i] == _COLLISION and len(points) > 0 else 0.0
        reach = np.inf
        if uniform(key, _TURN) < chance:
            light = min(int(uniform(key, _LIGHT) * len(points)), len(points) - 1)
            wx = points[light, 0] - out_origin[n_out, 0]
            wy = points[light, 1] - out_origin[n_out, 1]
            wz = points[light, 2] - out_origin[n_out, 2]
            squared = wx * wx + wy * wy + wz * wz
            if squared <= 0.0:
                continue
            away = math.sqrt(squared)
            wx, wy, wz = wx / away, wy / away, wz / away
            weight = len(points) / (4.0 * math.pi * chance)
            if points[light, 6] > 0.0:
                weight /= squared
                reach = away
            tr, tg, tb = tr * points[light, 3] * weight, tg * points[light, 4] * weight, tb * points[light, 5] * weight
            out_kind[n_out] = SHADOW
        else:
            tr, tg, tb = tr / (1.0 - chance), tg / (1.0 - chance), tb / (1.0 - chance)
            u1, u2 = uniform(key, _DIRECTION), uniform(key, _DIRECTION + 1)
            if event[i] == _COLLISION:
                wx, wy, wz = isotropic_direction(u1, u2)
            else:
                wx, wy, wz = cosine_direction(nx, ny, nz, u1, u2)
            out_kind[n_out] = SCATTER
        out_direction[n_out, 0], out_direction[n_out, 1], out_direction[n_out, 2] = wx, wy, wz
        out_throughput[n_out, 0], out_throughput[n_out, 1], out_throughput[n_out, 2] = tr, tg, tb
        out_reach[n_out] = reach
        out_parent[n_out] = i
        children[i] = 1
        n_out += 1
    return n_out
