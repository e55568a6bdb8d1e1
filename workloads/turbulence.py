"""Synthesized turbulence: random fields with a given spectrum, and how they fold what they carry.

A field is a sum of Fourier modes whose random amplitudes hash the seed and the mode's whole-numbered wave vector: a
finer grid shows the same eddies and adds smaller ones. Kinetic energy follows von Karman's spectrum, whose inertial
range is Kolmogorov's k^-5/3 (Pope, "Turbulent flows", 2000, section 6.5). A sum of modes is Gaussian and knows neither
sheets nor plumes; `carried` gives these back, since carrying a scalar along the flow is what folds it.

Everything is computed in float64 and stored in float32, which rounds away most last bits in which one processor's FFT
differs from another's; on one kind of processor results are the same to the bit.

Numba keeps a compiled kernel until its own file changes: whoever edits ``sampling.py`` must touch this file too.
"""

from __future__ import annotations

import math
import zlib

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.rays.embree import on_all_cores
from simrender.rays.sampling import path_key, uniform
from simrender.rays.scene import F32
from workloads.terrain import F64

Dims = tuple[int, int, int]
"""Points along x, y and z; arrays are (nz, ny, nx)."""

C128 = NDArray[np.complex128]

KOLMOGOROV = 5.0 / 3.0

SLAB = 8
"""Planes that a thread works on at a time."""


def gaussian(
    seed: int,
    name: str,
    dims: Dims,
    *,
    slope: float = KOLMOGOROV,
    largest: float = 0.5,
    smallest: float = 3.0,
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> F32:
    """Return a periodic Gaussian random field on cubic cells with mean 0 and variance 1, float32 (nz, ny, nx).

    Parameters
    ----------
    seed : int
    name : str
        Names the random stream.
    dims : (nx, ny, nz)
    slope : float
        The energy spectrum, summed over directions, falls like k^-``slope``.
    largest : float
        Size of the largest eddies, in the shortest side of the box; beyond it the spectrum falls towards k = 0.
    smallest : float
        Size under which eddies are damped, in cells: a grid is as fine as its smallest eddies need.
    stretch : (float, float, float)
        How many times longer structures are along each axis than they would be.

    """
    return _field(_modes(seed, (name,), dims, slope, largest, smallest, stretch)[0], dims)


def velocity(seed: int, name: str, dims: Dims, *, largest: float = 0.5, smallest: float = 3.0) -> F32:
    """Return a divergence-free periodic velocity with Kolmogorov's spectrum, float32 (3, nz, ny, nx).

    Each of the components x, y and z has variance 1; parameters as in `gaussian`.
    """
    names = tuple(f"{name} {axis}" for axis in "xyz")
    modes = _modes(seed, names, dims, KOLMOGOROV, largest, smallest, (1.0, 1.0, 1.0))
    return np.stack([_field(component, dims) for component in modes])


def spectrum(field: F32) -> tuple[F64, F64]:
    """Return the energy spectrum of a field on cubic cells.

    Parameters
    ----------
    field : float array (nz, ny, nx)

    Returns
    -------
    k : float64 array (m,)
        Wave numbers in radians a cell: the middles of the shells.
    energy : float64 array (m,)
        Energy density: its integral over k is the variance, but for what lies beyond the first and the last shell.

    """
    nz, ny, nx = field.shape
    power = np.abs(np.fft.rfftn(field.astype(np.float64), norm="forward")) ** 2
    power[:, :, 1 : (nx + 1) // 2] *= 2.0  # the half that is not stored
    kx, ky, kz = np.fft.rfftfreq(nx), np.fft.fftfreq(ny)[:, None], np.fft.fftfreq(nz)[:, None, None]
    k = 2.0 * math.pi * np.sqrt(kx * kx + ky * ky + kz * kz)
    width = 2.0 * math.pi / min(nx, ny, nz)
    shell = (k / width + 0.5).astype(np.int64)
    count = min(nx, ny, nz) // 2
    energy = np.bincount(shell.ravel(), weights=power.ravel())[1:count] / width
    return width * np.arange(1, count), energy


def carried(scalar: F32, flow: F32, *, reach: float, steps: int = 4, calm: F64 | None = None) -> F32:
    """Return a scalar after a flow has carried it: each point takes what lay where its path began.

    Paths are followed backward through the flow as it stands, by straight steps.

    Parameters
    ----------
    scalar : float32 array (nz, ny, nx)
        Periodic along x and y; above its last and below its first plane it goes on as it is there.
    flow : float32 array (3, nz, ny, nx)
    reach : float
        Length of a path where the speed is 1, in cells.
    steps : int
    calm : float64 array (nz,), optional
        Factor on the flow at each height, such as 0 at a wall.

    """
    carried_away = np.empty_like(scalar)
    nz, factor = len(scalar), np.ones(len(scalar)) if calm is None else calm

    def slab(first: int) -> None:
        _carry(scalar, flow, factor, reach / steps, steps, first, min(first + SLAB, nz), carried_away)

    on_all_cores(slab, range(0, nz, SLAB))
    return carried_away


def _modes(
    seed: int,
    names: tuple[str, ...],
    dims: Dims,
    slope: float,
    largest: float,
    smallest: float,
    stretch: tuple[float, float, float],
) -> C128:
    """Return the random amplitudes of fields of variance 1, complex128 (names, nz, ny, nx // 2 + 1).

    Three fields are made the components of one divergence-free field.
    """
    nx, ny, nz = dims
    modes = np.empty((len(names), nz, ny, nx // 2 + 1), np.complex128)
    keys = np.array([(seed * 2**32 + zlib.crc32(name.encode())) % 2**63 for name in names])
    outer, inner = 2.0 * math.pi / (largest * min(dims)), 2.0 * math.pi / smallest
    total = _fill(modes, nx, keys, slope, outer, inner, np.array(stretch))
    # Without what lies along the wave vector, a third of a velocity's energy.
    modes *= math.sqrt((1.5 if len(names) == 3 else 1.0) / total)
    return modes


def _field(modes: C128, dims: Dims) -> F32:
    return np.fft.irfftn(modes, s=dims[::-1], axes=(0, 1, 2), norm="forward").astype(np.float32)


@njit(cache=True, nogil=True, error_model="numpy")
def _fill(modes, nx, keys, slope, outer, inner, stretch):  # type: ignore[no-untyped-def]
    """Fill in the amplitudes before they are scaled, and return the variance they give a field."""
    count, nz, ny, half = modes.shape
    turn, power, total = 2.0 * math.pi, -0.5 * (4.0 + slope), 0.0
    k = np.zeros(3)
    for kz in range(nz):
        iz = kz if 2 * kz < nz else kz - nz
        k[2] = turn * iz / nz
        for ky in range(ny):
            iy = ky if 2 * ky < ny else ky - ny
            k[1] = turn * iy / ny
            for ix in range(half):
                k[0] = turn * ix / nx
                squared = k[0] * k[0] + k[1] * k[1] + k[2] * k[2]
                # The highest wave of an even number of points has no phase, and the mean is 0.
                if squared == 0.0 or 2 * ix == nx or 2 * iy == -ny or 2 * iz == -nz:
                    modes[:, kz, ky, ix] = 0.0
                    continue
                wide = (k[0] * stretch[0]) ** 2 + (k[1] * stretch[1]) ** 2 + (k[2] * stretch[2]) ** 2
                energy = wide * (wide + outer * outer) ** power * math.exp(-2.0 * squared / (inner * inner))
                # A real field takes the mean of a mode and its mirror image where both are stored.
                total += energy if ix == 0 else 2.0 * energy
                size = math.sqrt(energy) * (math.sqrt(12.0) if ix == 0 else math.sqrt(6.0))
                for c in range(count):
                    key = path_key(keys[c], ix, iy, iz)
                    modes[c, kz, ky, ix] = size * complex(uniform(key, 0) - 0.5, uniform(key, 1) - 0.5)
                if count == 3:
                    along = 0.0j
                    for c in range(3):
                        along += k[c] * modes[c, kz, ky, ix]
                    for c in range(3):
                        modes[c, kz, ky, ix] -= k[c] * along / squared
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _carry(scalar, flow, calm, step, steps, first, last, result):  # type: ignore[no-untyped-def]
    nz, ny, nx = scalar.shape
    vx, vy, vz = flow[0], flow[1], flow[2]
    for k in range(first, last):
        for j in range(ny):
            for i in range(nx):
                x, y, z = float(i), float(j), float(k)
                for done in range(steps + 1):
                    z = min(max(z, 0.0), nz - 1.0)
                    fx, fy = math.floor(x), math.floor(y)
                    i0, j0, k0 = int(fx), int(fy), min(int(z), nz - 2)
                    while i0 < 0:  # paths leave by a few cells, and a loop is faster than a division
                        i0 += nx
                    while i0 >= nx:
                        i0 -= nx
                    while j0 < 0:
                        j0 += ny
                    while j0 >= ny:
                        j0 -= ny
                    i1, j1, k1 = i0 + 1 if i0 + 1 < nx else 0, j0 + 1 if j0 + 1 < ny else 0, k0 + 1
                    u, v, w = x - fx, y - fy, z - k0
                    p, q, r, s = (1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v
                    if done == steps:
                        low = p * scalar[k0, j0, i0] + q * scalar[k0, j0, i1]
                        low += r * scalar[k0, j1, i0] + s * scalar[k0, j1, i1]
                        high = p * scalar[k1, j0, i0] + q * scalar[k1, j0, i1]
                        high += r * scalar[k1, j1, i0] + s * scalar[k1, j1, i1]
                        result[k, j, i] = low * (1.0 - w) + high * w
                        break
                    h = step * (calm[k0] + w * (calm[k1] - calm[k0]))
                    if h == 0.0:
                        continue
                    near, far = h * (1.0 - w), h * w
                    low = p * vx[k0, j0, i0] + q * vx[k0, j0, i1] + r * vx[k0, j1, i0] + s * vx[k0, j1, i1]
                    high = p * vx[k1, j0, i0] + q * vx[k1, j0, i1] + r * vx[k1, j1, i0] + s * vx[k1, j1, i1]
                    x -= near * low + far * high
                    low = p * vy[k0, j0, i0] + q * vy[k0, j0, i1] + r * vy[k0, j1, i0] + s * vy[k0, j1, i1]
                    high = p * vy[k1, j0, i0] + q * vy[k1, j0, i1] + r * vy[k1, j1, i0] + s * vy[k1, j1, i1]
                    y -= near * low + far * high
                    low = p * vz[k0, j0, i0] + q * vz[k0, j0, i1] + r * vz[k0, j1, i0] + s * vz[k0, j1, i1]
                    high = p * vz[k1, j0, i0] + q * vz[k1, j0, i1] + r * vz[k1, j1, i0] + s * vz[k1, j1, i1]
                    z -= near * low + far * high
