"""Structured volumes: voxels, the transfer function that makes them visible, and macro cells over them.

Voxels are samples at grid *points*, as in VTK's image data; a *cell* lies between eight of them and its field is their
trilinear interpolant. Cells are indexed 0 .. n - 2 along an axis of n points. A *macro cell* is a block of up to
`MACRO` cells a side with the range of values in it and the largest extinction these can have, its *majorant*: what
lets a ray stride through empty space (Guenther, Kuhn and Theisel, "MCFTLE: Monte Carlo rendering of finite-time
Lyapunov exponent fields", Computer Graphics Forum 35(3), 2016; islands paper, section 6). A *brick* is a box of whole
macro cells, an int32 row (x0, x1, y0, y1, z0, z1) of the cells x0 <= i < x1 and so on.

Numba keeps a compiled kernel until the kernel's own file changes: whoever edits the jitted functions here must touch
``marching.py``, ``tracking.py`` and ``element_marching.py`` too.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from simrender.errors import SceneError

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Color = tuple[float, float, float]
Triple = tuple[float, float, float]

MACRO = 8
"""Cells along each axis of a macro cell; the last one along an axis may have fewer."""


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """Colour and extinction of each scalar value, piecewise linear between control points.

    Below the first control point and above the last one the end's entries hold. It is extinction, not opacity, that
    is interpolated: then a slab of any thickness between two control points has a closed form.

    Attributes
    ----------
    values : float64 array (k,)
        Control points, strictly ascending, k >= 1.
    colors : float64 array (k, 3)
        Emitted colour at each control point, 0 to 1.
    opacities : float64 array (k,)
        Opacity of a slab one ``unit`` thick, 0 <= opacity < 1.
    unit : float
        The length, in world units, that the opacities refer to.

    Raises
    ------
    SceneError
        If shapes disagree, or a value lies outside its range.

    """

    values: F64
    colors: F64
    opacities: F64
    unit: float = 1.0

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float64)
        colors = np.ascontiguousarray(self.colors, dtype=np.float64)
        opacities = np.ascontiguousarray(self.opacities, dtype=np.float64)
        k = len(values) if values.ndim == 1 else 0
        if k == 0 or colors.shape != (k, 3) or opacities.shape != (k,):
            shapes = f"{values.shape}, {colors.shape} and {opacities.shape}"
            raise SceneError(
                f"a transfer function has values (k,), colors (k, 3) and opacities (k,), k >= 1, got {shapes}"
            )
        if not np.isfinite(values).all() or (np.diff(values) <= 0.0).any():
            raise SceneError(f"the values of a transfer function must ascend, got {values.tolist()}")
        for name, entries, bad, wanted in (
            ("color", colors, ~((colors >= 0.0) & (colors <= 1.0)).all(axis=1), "0 <= color <= 1"),
            ("opacity", opacities, ~((opacities >= 0.0) & (opacities < 1.0)), "0 <= opacity < 1"),
        ):
            if bad.any():
                at = int(bad.argmax())
                raise SceneError(
                    f"{name} {entries[at].tolist()} at value {values[at]} of a transfer function is not {wanted}"
                )
        if not (np.isfinite(self.unit) and self.unit > 0.0):
            raise SceneError(f"the unit of a transfer function's opacities is a length above 0, got {self.unit}")
        for field, entries in (("values", values), ("colors", colors), ("opacities", opacities)):
            object.__setattr__(self, field, entries)

    @cached_property
    def extinction(self) -> F64:
        """Extinction per world length at each control point, float64 (k,)."""
        sigma: F64 = -np.log1p(-self.opacities) / self.unit
        return sigma

    def sigma(self, value: ArrayLike) -> F64:
        """Return the extinction per world length at some values."""
        return np.interp(np.asarray(value, np.float64), self.values, self.extinction)

    def color(self, value: ArrayLike) -> F64:
        """Return the colour at some values, float64 (..., 3)."""
        at = np.asarray(value, np.float64)
        return np.stack([np.interp(at, self.values, self.colors[:, c]) for c in range(3)], axis=-1)

    @cached_property
    def table(self) -> F64:
        """The function as kernels take it, float64 (k, 9).

        A row holds a control point's value, then extinction, red, green and blue, each followed by its slope up to
        the next control point; the last row's slopes are 0.
        """
        entries = np.column_stack([self.extinction, self.colors])
        slopes = np.zeros_like(entries)
        slopes[:-1] = np.diff(entries, axis=0) / np.diff(self.values)[:, None]
        table = np.empty((len(self.values), 9))
        table[:, 0], table[:, 1::2], table[:, 2::2] = self.values, entries, slopes
        return table


@dataclass(frozen=True, eq=False)
class MacroCells:
    """What is known of each macro cell, all arrays of shape (mz, my, mx).

    Attributes
    ----------
    low, high : float32 array
        Range of the voxels that the macro cell's cells touch, and so of the field inside it.
    majorant : float64 array
        Largest extinction of any value in that range, per world length.

    """

    low: F32
    high: F32
    majorant: F64


@dataclass(frozen=True, eq=False)
class Volume:
    """A scalar field on a regular grid, seen through a transfer function and as isosurfaces.

    Attributes
    ----------
    voxels : float32 array (nz, ny, nx)
        Values at the grid points, x fastest.
    spacing, origin : (x, y, z)
        Distance between grid points, and where the first one lies.
    transfer : TransferFunction
    isovalues : tuple of float
        Values whose isosurfaces are there to be hit, besides the medium.
    iso_colors : tuple of (r, g, b)
        Colour of each isosurface; by default what the transfer function gives its value.

    Raises
    ------
    SceneError
        If the grid has fewer than two points along an axis, a voxel is not finite, or the spacing is not positive.

    """

    voxels: F32
    spacing: Triple
    origin: Triple
    transfer: TransferFunction
    isovalues: tuple[float, ...] = ()
    iso_colors: tuple[Color, ...] = ()

    def __post_init__(self) -> None:
        voxels = np.ascontiguousarray(self.voxels, dtype=np.float32)
        if voxels.ndim != 3 or min(voxels.shape) < 2:
            raise SceneError(
                f"voxels are an array of shape (nz, ny, nx) with at least 2 points an axis, got {voxels.shape}"
            )
        # The extremes of an array are finite only if all of it is: NaN wins over every number.
        if not (np.isfinite(voxels.min()) and np.isfinite(voxels.max())):
            bad = np.flatnonzero(~np.isfinite(voxels))
            z, y, x = (int(i) for i in np.unravel_index(bad[0], voxels.shape))
            count = f"{len(bad)} of {voxels.size} voxels are" if len(bad) > 1 else f"1 of {voxels.size} voxels is"
            raise SceneError(
                f"{count} not finite; the first is {voxels[z, y, x]} at (x, y, z) = ({x}, {y}, {z}): "
                "replace such values, for instance by the smallest one"
            )
        spacing, origin = (tuple(float(x) for x in t) for t in (self.spacing, self.origin))
        if len(spacing) != 3 or not all(np.isfinite(s) and s > 0.0 for s in spacing):
            raise SceneError(f"the spacing of a volume is three lengths above 0, got {self.spacing}")
        if len(origin) != 3 or not np.isfinite(origin).all():
            raise SceneError(f"the origin of a volume is three finite coordinates, got {self.origin}")
        isovalues = tuple(float(v) for v in self.isovalues)
        if not np.isfinite(isovalues).all():
            raise SceneError(f"an isovalue is not finite: {isovalues}")
        if self.iso_colors and len(self.iso_colors) != len(isovalues):
            raise SceneError(f"{len(isovalues)} isovalues need as many colours or none, got {len(self.iso_colors)}")
        colors = self.iso_colors or tuple(map(tuple, self.transfer.color(np.array(isovalues)).tolist()))
        entries = {"voxels": voxels, "spacing": spacing, "origin": origin, "isovalues": isovalues, "iso_colors": colors}
        for field, entry in entries.items():
            object.__setattr__(self, field, entry)

    @property
    def dims(self) -> tuple[int, int, int]:
        """Grid points along x, y and z."""
        nz, ny, nx = self.voxels.shape
        return nx, ny, nz

    @property
    def cells(self) -> tuple[int, int, int]:
        """Cells along x, y and z."""
        nx, ny, nz = self.dims
        return nx - 1, ny - 1, nz - 1

    @property
    def bounds(self) -> tuple[F64, F64]:
        """Lowest and highest corner, float64 (3,) each."""
        low = np.array(self.origin)
        return low, low + np.array(self.cells) * np.array(self.spacing)

    @cached_property
    def value_range(self) -> tuple[float, float]:
        """Smallest and largest voxel."""
        return float(self.macro.low.min()), float(self.macro.high.max())

    @cached_property
    def macro(self) -> MacroCells:
        """The macro cells, computed when first asked for."""
        mx, my, mz = (-(-n // MACRO) for n in self.cells)
        low, high = np.empty((mz, my, mx), np.float32), np.empty((mz, my, mx), np.float32)
        _ranges(self.voxels, low, high)
        transfer = self.transfer
        majorant = np.maximum(transfer.sigma(low), transfer.sigma(high))
        for value, sigma in zip(transfer.values, transfer.extinction, strict=True):
            inside = (low < value) & (value < high)
            majorant[inside] = np.maximum(majorant[inside], sigma)
        return MacroCells(low, high, majorant)

    def scaled(self, factor: float) -> Volume:
        """Return the volume in other units of length: every length times a factor, every slab as opaque as it was."""
        x, y, z = (s * factor for s in self.spacing)
        ox, oy, oz = (o * factor for o in self.origin)
        transfer = replace(self.transfer, unit=self.transfer.unit * factor)
        return replace(self, spacing=(x, y, z), origin=(ox, oy, oz), transfer=transfer)

    @cached_property
    def key(self) -> str:
        """Content hash: two volumes with the same key give the same samples."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(f"volume {self.voxels.shape}".encode())
        digest.update(self.voxels.data)
        digest.update(repr((self.spacing, self.origin, self.isovalues, self.iso_colors)).encode())
        digest.update(repr(self.transfer.unit).encode())
        for entries in (self.transfer.values, self.transfer.colors, self.transfer.opacities):
            digest.update(entries.tobytes())
        return digest.hexdigest()


def check_bricks(volume: Volume, bricks: I32) -> None:
    """Raise a `SceneError` unless each brick, int32 (n, 6), consists of whole macro cells of the volume."""
    low, high, cells = bricks[:, ::2], bricks[:, 1::2], np.array(volume.cells)
    good = (low >= 0) & (low < high) & (low % MACRO == 0) & ((high == cells) | (high < cells) & (high % MACRO == 0))
    if not good.all():
        brick = bricks[np.flatnonzero(~good.all(axis=1))[0]].tolist()
        raise SceneError(
            f"the brick {brick} does not fit a volume of {' x '.join(map(str, volume.cells))} cells: "
            f"its faces must lie on multiples of {MACRO} cells or at the volume's end"
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _ranges(voxels, low, high):  # type: ignore[no-untyped-def]
    """Fill the smallest and largest voxel that the cells of each macro cell touch."""
    nz, ny, nx = voxels.shape
    mz, my, mx = low.shape
    smallest, largest = np.empty(nx, np.float32), np.empty(nx, np.float32)
    for kz in range(mz):
        for ky in range(my):
            z0, y0 = kz * MACRO, ky * MACRO
            smallest[:] = voxels[z0, y0]
            largest[:] = voxels[z0, y0]
            # Whole lines first: that is one sweep a vector unit can make, and only its result is cut into macro cells.
            for z in range(z0, min(z0 + MACRO, nz - 1) + 1):
                for y in range(y0, min(y0 + MACRO, ny - 1) + 1):
                    for x in range(nx):
                        v = voxels[z, y, x]
                        smallest[x] = v if v < smallest[x] else smallest[x]
                        largest[x] = v if v > largest[x] else largest[x]
            for kx in range(mx):
                x0 = kx * MACRO
                lo, hi = smallest[x0], largest[x0]
                for x in range(x0 + 1, min(x0 + MACRO, nx - 1) + 1):
                    lo, hi = min(lo, smallest[x]), max(hi, largest[x])
                low[kz, ky, kx], high[kz, ky, kx] = lo, hi


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def find_row(table, value, row):  # type: ignore[no-untyped-def]
    """Return the row of a transfer function's table that holds for a value, searched from another row onwards.

    A ray's next value mostly lies between the same two control points, so starting from the last row is cheap; the
    answer does not depend on it.
    """
    while row + 1 < len(table) and value >= table[row + 1, 0]:
        row += 1
    while row > 0 and value < table[row, 0]:
        row -= 1
    return row


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def interpolate(flat, base, row, plane, fx, fy, fz):  # type: ignore[no-untyped-def]
    """Interpolate trilinearly between the eight voxels from ``base`` on; ``row`` and ``plane`` are strides."""
    one = np.uint64(1)
    b01, b10, b11 = base + row, base + plane, base + plane + row
    v00 = flat[base] + fx * (flat[base + one] - flat[base])
    v01 = flat[b01] + fx * (flat[b01 + one] - flat[b01])
    v10 = flat[b10] + fx * (flat[b10 + one] - flat[b10])
    v11 = flat[b11] + fx * (flat[b11 + one] - flat[b11])
    v0 = v00 + fy * (v01 - v00)
    v1 = v10 + fy * (v11 - v10)
    return v0 + fz * (v1 - v0)
