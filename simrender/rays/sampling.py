"""Counter-based random numbers: a hash of (seed, pixel, sample, depth, dimension), never a stream.

A ray's random numbers depend on where it stands in the tree of rays and on nothing else, so a scheduler may trace rays
in any order, twice, or on any number of threads and always gets the same ones. The hash is the finalizer of
SplitMix64 (Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).

Numba keeps a compiled kernel until the kernel's own file changes: whoever edits this file must touch ``shading.py``
too, or the shading kernel goes on with the old functions.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX2 = np.uint64(0x94D049BB133111EB)
_S30, _S27, _S31, _S11 = np.uint64(30), np.uint64(27), np.uint64(31), np.uint64(11)
_ONE = np.uint64(1)
_TO_UNIT = 2.0**-53


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _mix(z):  # type: ignore[no-untyped-def]
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    return z ^ (z >> _S31)


@njit(cache=True, nogil=True, error_model="numpy")
def path_key(seed, pixel, sample, depth):  # type: ignore[no-untyped-def]
    """Return the key (uint64) of a path's vertex: all random numbers drawn there are `uniform` of it.

    ``depth`` 0 is the camera; the first surface is 1.
    """
    key = _mix(np.uint64(seed) + _GOLDEN)
    key = _mix(key ^ (np.uint64(pixel) * _GOLDEN + _ONE))
    key = _mix(key ^ (np.uint64(sample) * _GOLDEN + _ONE))
    return _mix(key ^ (np.uint64(depth) * _GOLDEN + _ONE))


@njit(cache=True, nogil=True, error_model="numpy")
def uniform(key, dimension):  # type: ignore[no-untyped-def]
    """Return the random number (float64 in [0, 1)) of one dimension of a key."""
    return float(_mix(key + np.uint64(dimension + 1) * _GOLDEN) >> _S11) * _TO_UNIT


@njit(cache=True, nogil=True, error_model="numpy")
def cosine_direction(nx, ny, nz, u1, u2):  # type: ignore[no-untyped-def]
    """Return a cosine-distributed direction about the unit normal (nx, ny, nz).

    The basis is that of Duff et al., "Building an orthonormal basis, revisited", JCGT 6(1), 2017.
    """
    r, phi = math.sqrt(u1), 2.0 * math.pi * u2
    x, y, z = r * math.cos(phi), r * math.sin(phi), math.sqrt(max(0.0, 1.0 - u1))
    sign = math.copysign(1.0, nz)
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return (
        x * (1.0 + sign * nx * nx * a) + y * b + z * nx,
        x * sign * b + y * (sign + ny * ny * a) + z * ny,
        -x * sign * nx - y * ny + z * nz,
    )


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def offset_origin(origin, bits, i, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Move row i of ``origin`` off its surface, towards the normal, in place.

    Waechter and Binder, "A fast and robust method for avoiding self-intersection", Ray Tracing Gems, 2019: a step of
    a fixed number of float32 units in the last place, so it scales with the distance from the world's origin, and a
    fixed small step close to that origin.

    Parameters
    ----------
    origin : float32 array (n, 3)
    bits : int32 array (n, 3)
        The same memory as integers: ``origin.view(np.int32)``.
    nx, ny, nz : float
        Unit normal, on the side to move to.

    """
    for axis, n in enumerate((nx, ny, nz)):
        p = origin[i, axis]
        if abs(p) < 1.0 / 32.0:
            origin[i, axis] = p + n * (1.0 / 65536.0)
        else:
            step = int(256.0 * n)
            bits[i, axis] += -step if p < 0.0 else step
