"""Files of structured volumes: NumPy, NRRD, raw voxels with a sidecar, and VTK.

Every format ends as the same `Volume`: float32 voxels (nz, ny, nx), x fastest, on an evenly spaced grid along the axes
of the world. How large the voxels will be is known from a file's header or its name, and checked against the memory
there is, before any of them is read.

- ``.npy``: an array of shape (nz, ny, nx).
- ``.nrrd``, ``.nhdr``: the format of Teem (<https://teem.sourceforge.net/nrrd/format.html>).
- ``.raw``: with a sidecar ``NAME.yaml`` or ``NAME.json`` as `Sidecar` describes, or named as the Open SciVis Datasets
  are (<https://klacansky.com/open-scivis-datasets/>): ``chameleon_1024x1024x1080_uint16.raw``.
- ``.vtk``, ``.vti``, ``.vtr``: image data and rectilinear grids, through pyvista.
"""

from __future__ import annotations

import gzip
import math
import re
import warnings
import zlib
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from simrender.documents import Document
from simrender.errors import SceneError, SceneWarning, did_you_mean
from simrender.rays.memory import check_memory
from simrender.rays.scene import F32
from simrender.rays.volume import TransferFunction, Triple, Volume
from simrender.rays.vtk import read_vtk

F64 = NDArray[np.float64]

FORMATS = (".npy", ".nrrd", ".nhdr", ".raw", ".vtk", ".vti", ".vtr")
"""Endings of the files that are read."""

DTYPES = (
    "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float16", "float32", "float64",
)  # fmt: skip
"""Types of voxels that are read."""

_C_NAMES = {
    "signed char": "int8", "uchar": "uint8", "unsigned char": "uint8",
    "short": "int16", "short int": "int16", "signed short": "int16", "signed short int": "int16",
    "ushort": "uint16", "unsigned short": "uint16", "unsigned short int": "uint16",
    "int": "int32", "signed int": "int32", "uint": "uint32", "unsigned int": "uint32",
    "longlong": "int64", "long long": "int64", "long long int": "int64", "signed long long": "int64",
    "signed long long int": "int64", "ulonglong": "uint64", "unsigned long long": "uint64",
    "unsigned long long int": "uint64", "float": "float32", "double": "float64",
}  # fmt: skip

_SCIVIS = re.compile(rf"_(\d+)x(\d+)x(\d+)_({'|'.join(DTYPES)})$", re.IGNORECASE)

_EVEN = 1e-4
"""Coordinates are evenly spaced if no step differs from the mean step by more than this share of it."""

_SAMPLE = 1 << 22
"""The default transfer function looks at about so many voxels."""


_Number = Annotated[int, Field(gt=0)]
_Length = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class Sidecar(BaseModel):
    """What the file beside a ``.raw`` file says about it.

    Attributes
    ----------
    dims : (nx, ny, nz)
        Number of voxels along each axis.
    dtype : str
        One of `DTYPES`.
    endian : "little" or "big"
    spacing, origin : (x, y, z)
        Distance between voxels, and place of the first one.
    order : str
        The axes in the order of the file, the fastest first.
    skip_bytes : int
        Length of what stands before the voxels.

    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    dims: tuple[_Number, _Number, _Number]
    dtype: Literal[
        "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float16", "float32", "float64"
    ]
    endian: Literal["little", "big"] = "little"
    spacing: tuple[_Length, _Length, _Length] = (1.0, 1.0, 1.0)
    origin: Triple = (0.0, 0.0, 0.0)
    order: Literal["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"] = "xyz"
    skip_bytes: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels as a file has them: array (slowest, ..., fastest) and the step of each of its axes, fastest first."""

    voxels: NDArray[Any]
    steps: F64
    origin: F64


def read_volume(
    path: Path,
    *,
    transfer: TransferFunction | None = None,
    isovalues: tuple[float, ...] = (),
    array: str | None = None,
) -> Volume:
    """Read a file of a structured volume.

    Parameters
    ----------
    path : Path
        A file of one of the `FORMATS`.
    transfer : TransferFunction, optional
        Default: `default_transfer`.
    isovalues : tuple of float
        Values whose isosurfaces are shown.
    array : str, optional
        Which array of a VTK file; by default the first that has one number for each point, else for each cell.

    Raises
    ------
    SceneError
        If the file is missing, damaged, of another size than it says, too large for the memory, or holds something
        else than a scalar volume; the message names the file.
    CardError
        If there are mistakes in a sidecar.

    Warns
    -----
    SceneWarning
        If the grid was spaced unevenly and has been resampled.

    """
    if path.suffix.lower() not in FORMATS:
        raise SceneError(f"{path}: unknown volume format {path.suffix!r} (known: {', '.join(FORMATS)})")
    if not path.is_file():
        raise SceneError(f"{path}: {'this is a folder, expected a file' if path.is_dir() else 'there is no such file'}")
    if path.stat().st_size == 0:
        raise SceneError(f"{path}: the file is empty")
    read = {".npy": _read_npy, ".nrrd": _read_nrrd, ".nhdr": _read_nrrd, ".raw": _read_raw}
    try:
        if array is not None and path.suffix.lower() in read:
            raise SceneError(f"only VTK files have named arrays; there is no array {array!r} to choose")
        reader = read.get(path.suffix.lower())
        voxels, spacing, origin = _aligned(reader(path) if reader else _read_vtk(path, array))
        function = transfer or default_transfer(voxels, spacing)
        return Volume(voxels, spacing, origin, function, isovalues)
    except OSError as error:
        raise SceneError(f"{path}: cannot read this file: {error.strerror or error}") from None
    except SceneError as error:
        raise SceneError(str(error) if str(error).startswith(str(path)) else f"{path}: {error}") from None


def default_transfer(voxels: F32, spacing: Triple = (1.0, 1.0, 1.0)) -> TransferFunction:
    """Return a transfer function from cool to warm that lets the rarer high values be seen.

    Nothing up to the median is seen; from there opacity rises to the value that one voxel in a thousand exceeds. The
    colors are the ends and the middle of the diverging map of Moreland, "Diverging color maps for scientific
    visualization", ISVC 2009.

    Parameters
    ----------
    voxels : float32 array (nz, ny, nx)
    spacing : (x, y, z)
        Opacities are those of a slab as thick as a sixteenth of the volume's longest side.

    """
    sides = [s * max(n - 1, 1) for s, n in zip(spacing, reversed(voxels.shape), strict=True)]
    unit = max(sides) / 16.0
    flat = voxels.reshape(-1)
    sample = flat[:: -(-flat.size // _SAMPLE)]
    low, high = (float(q) for q in np.quantile(sample, [0.5, 0.999], method="inverted_cdf"))
    if not low < high:  # more than half of the voxels have one value
        low, high = float(flat.min()), float(flat.max())
    cool, white, warm = (0.230, 0.299, 0.754), (0.865, 0.865, 0.865), (0.706, 0.016, 0.150)
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        # A constant volume is a faint fog. One that is not finite is refused by `Volume`, which says where.
        return TransferFunction(
            np.array([low if math.isfinite(low) else 0.0]), np.array([white]), np.array([0.1]), unit
        )
    values = np.array([low, 0.5 * low + 0.5 * high, high])
    return TransferFunction(values, np.array([cool, white, warm]), np.array([0.0, 0.35, 0.9]), unit)


def _check_volume_memory(dims: Any, dtype: np.dtype[Any]) -> None:
    """Check for float32 voxels and the file's own beside them."""
    size = "x".join(str(n) for n in dims)
    check_memory(math.prod(int(n) for n in dims) * (4.0 + dtype.itemsize), f"a volume of {size} voxels of {dtype.name}")


def _aligned(grid: _Grid) -> tuple[F32, Triple, Triple]:
    """Turn and mirror the array so that its axes are z, y, x and ascend; return voxels, spacing and origin."""
    steps = grid.steps
    if not np.isfinite(steps).all() or (steps == 0.0).all(axis=1).any():
        raise SceneError(f"the steps of the grid are finite and not 0, got {steps.tolist()}")
    if min(grid.voxels.shape) < 2:
        raise SceneError(f"a volume has at least 2 voxels along each axis, got {grid.voxels.shape[::-1]}")
    along = np.abs(steps).argmax(axis=1)
    size = np.abs(steps).max(axis=1)
    rest = np.abs(steps).sum(axis=1) - size
    if sorted(along) != [0, 1, 2] or (rest > 1e-6 * size).any():
        rows = " ".join(f"({', '.join(f'{x:g}' for x in row)})" for row in steps.tolist())
        raise SceneError(f"the grid is not aligned with the world's axes: its directions are {rows}; resample it")
    voxels, origin = grid.voxels, grid.origin.astype(np.float64).copy()
    spacing = np.ones(3)
    for axis in range(3):
        step = float(steps[axis, along[axis]])
        spacing[along[axis]] = abs(step)
        if step < 0.0:
            n = voxels.shape[2 - axis]
            voxels = np.flip(voxels, 2 - axis)
            origin[along[axis]] += step * (n - 1)
    turned = np.transpose(voxels, [2 - int(np.flatnonzero(along == world)[0]) for world in (2, 1, 0)])
    with np.errstate(over="ignore"):  # what is too large for float32 is refused as infinite
        result = np.ascontiguousarray(turned, dtype=np.float32)
    return result, _triple(spacing), _triple(origin)


def _triple(values: Any) -> Triple:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _read_npy(path: Path) -> _Grid:
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # NumPy's own reader of the header has many ways to fail
        reason = " ".join(str(error).split())
        if "pickle" in reason or "Python objects" in reason:
            reason = "it holds Python objects, expected numbers"
        raise SceneError(f"cannot read this array, which is damaged or cut short: {reason}") from None
    if array.dtype.name not in (*DTYPES, "bool"):
        raise SceneError(_unknown_dtype(str(array.dtype)))
    if array.ndim != 3:
        raise SceneError(f"a volume is an array of shape (nz, ny, nx), got {array.ndim} dimensions: {array.shape}")
    _check_volume_memory(array.shape[::-1], array.dtype)
    return _Grid(array, np.eye(3), np.zeros(3))


def _read_raw(path: Path) -> _Grid:
    beside = [path.with_suffix(ending) for ending in (".yaml", ".yml", ".json")]
    sidecars = [p for p in beside if p.is_file()]
    named = _SCIVIS.search(path.stem)
    if sidecars:
        about = Document(sidecars[0].read_text(encoding="utf-8", errors="replace"), str(sidecars[0])).validate(Sidecar)
    elif named:
        about = Sidecar.model_validate({"dims": tuple(int(n) for n in named.groups()[:3]), "dtype": named[4].lower()})
    else:
        raise SceneError(
            f"nothing says what is in it: expected beside it a file {beside[0].name} with 'dims: [nx, ny, nz]' and "
            f"'dtype: uint8', or a name such as {path.stem}_256x256x128_uint8.raw"
        )
    dtype = np.dtype(about.dtype).newbyteorder("<" if about.endian == "little" else ">")
    axes = ["xyz".index(letter) for letter in about.order]
    sizes = [about.dims[axis] for axis in axes]
    size = path.stat().st_size
    if size != about.skip_bytes + math.prod(sizes) * dtype.itemsize:
        raise SceneError(_wrong_size(size, about.dims, dtype, about.skip_bytes))
    _check_volume_memory(sizes, dtype)
    voxels = np.memmap(path, dtype, "r", about.skip_bytes, tuple(reversed(sizes)))
    return _Grid(voxels, np.diag(about.spacing)[axes], np.array(about.origin))


def _wrong_size(found: int, dims: tuple[int, ...], dtype: np.dtype[Any], skip: int) -> str:
    """Say how many bytes were expected, and what would fit the bytes there are."""
    expected = skip + math.prod(dims) * dtype.itemsize
    of = f"{'x'.join(map(str, dims))} voxels of {dtype.name}{f' after {skip} bytes' if skip else ''}"
    fits = []
    data = found - skip
    for axis in range(3):
        slab = math.prod(dims) // dims[axis] * dtype.itemsize
        if data > 0 and data % slab == 0:
            fits.append("dims " + "x".join(str(data // slab if a == axis else n) for a, n in enumerate(dims)))
    each = data / math.prod(dims)
    fits += [f"dtype {name}" for name in DTYPES if np.dtype(name).itemsize == each and name != dtype.name]
    if found > expected:
        fits.append(f"a header of {found - expected + skip} bytes (skip_bytes)")
    hint = f"; what would fit: {', or '.join(fits)}" if fits else ""
    return f"the file has {found} bytes, expected {expected} for {of}{hint}"


def _unknown_dtype(name: str) -> str:
    near = did_you_mean(name, [*DTYPES, *_C_NAMES])
    return f"voxels of type {name!r} cannot be shown{near} (known: {', '.join(DTYPES)})"


def _read_nrrd(path: Path) -> _Grid:
    with path.open("rb") as file:
        fields, lines, start = _nrrd_header(file)

    def mistake(name: str, what: str) -> SceneError:
        return SceneError(f"{path}:{lines[name]}: {name}: {what}" if name in lines else f"{path}: {what}")

    def numbers(name: str, kind: Any) -> list[Any]:
        try:
            return [kind(word) for word in fields[name].split()]
        except ValueError:
            wanted = "whole numbers" if kind is int else "numbers"
            raise mistake(name, f"expected {wanted}, got {fields[name]!r}") from None

    for name in ("type", "dimension", "sizes", "encoding"):
        if name not in fields:
            raise SceneError(f"the header has no field {name!r}")
    kind = " ".join(fields["type"].lower().split())
    kind = _C_NAMES.get(kind, kind.removesuffix("_t"))
    if kind not in DTYPES:
        raise mistake("type", _unknown_dtype(fields["type"]))
    sizes = numbers("sizes", int)
    if numbers("dimension", int) != [3] or len(sizes) != 3:
        raise mistake("dimension", f"a volume has 3 dimensions of one number each, got sizes {fields['sizes']!r}")
    if min(sizes) < 1:
        raise mistake("sizes", f"expected numbers above 0, got {fields['sizes']!r}")
    encoding = fields["encoding"].lower()
    known = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "ascii": "ascii", "text": "ascii", "txt": "ascii"}
    if encoding not in known:
        raise mistake("encoding", f"unknown encoding {encoding!r} (known: raw, gzip, ascii)")
    encoding = known[encoding]
    dtype = np.dtype(kind)
    if encoding != "ascii" and dtype.itemsize > 1:
        if fields.get("endian", "").lower() not in {"little", "big"}:
            raise mistake(
                "endian", f"expected little or big for voxels of {kind}, got {fields.get('endian', 'nothing')!r}"
            )
        dtype = dtype.newbyteorder("<" if fields["endian"].lower() == "little" else ">")
    data = path
    if "data file" in fields:
        data, start = path.parent / fields["data file"], 0
        if fields["data file"].startswith("LIST") or "%" in fields["data file"]:
            raise mistake("data file", "voxels in several files are not read; expected the name of one file")
        if not data.is_file():
            raise mistake("data file", f"there is no file {fields['data file']!r} in {path.parent}")
    elif path.suffix.lower() == ".nhdr":
        raise SceneError("the header has no field 'data file', and a file ending in .nhdr has no voxels of its own")
    skips = [numbers(name, int) if name in fields else [0] for name in ("line skip", "byte skip")]
    for name, skip in zip(("line skip", "byte skip"), skips, strict=True):
        if len(skip) != 1 or skip[0] < (-1 if name == "byte skip" and encoding == "raw" else 0):
            raise mistake(name, f"expected one number, 0 or more, got {fields[name]!r}")
    (skip_lines,), (skip_bytes,) = skips
    _check_volume_memory(sizes, dtype)
    voxels = _nrrd_voxels(data, start, skip_lines, skip_bytes, encoding, dtype, math.prod(sizes))
    steps, origin = _nrrd_space(fields, mistake, numbers)
    return _Grid(voxels.reshape(sizes[::-1]), steps, origin)


def _nrrd_header(file: Any) -> tuple[dict[str, str], dict[str, int], int]:
    """Return the fields, the line of each, and where the header ends."""
    if not re.match(rb"NRRD000\d\s*$", file.readline(64)):
        raise SceneError("it does not begin with the line 'NRRD0005' or the like: this is no NRRD file")
    fields: dict[str, str] = {}
    lines: dict[str, int] = {}
    short = {"datafile": "data file", "lineskip": "line skip", "byteskip": "byte skip", "axismins": "axis mins"}
    for number, raw in enumerate(iter(lambda: file.readline(1 << 16), b""), start=2):
        line = raw.decode("utf-8", "replace").strip()
        if not line:
            break
        name, found, value = line.partition(":")
        if line.startswith("#") or value.startswith("="):
            continue  # a comment, or a pair of a writer's own
        if not found:
            raise SceneError(f"line {number} of the header is no 'field: value': {line[:40]!r}")
        name = short.get(name.strip().lower(), name.strip().lower())
        fields[name], lines[name] = value.strip(), number
    return fields, lines, file.tell()


def _nrrd_space(fields: dict[str, str], mistake: Any, numbers: Any) -> tuple[F64, F64]:
    """Return the step of each axis of the array, float64 (3, 3), and where the first voxel lies."""

    def vectors(name: str, count: int) -> F64:
        found = re.findall(r"\(([^()]*)\)", fields[name])
        try:
            rows = np.array([[float(x) for x in row.split(",")] for row in found])
        except ValueError:
            rows = np.zeros(0)
        if rows.shape != (count, 3) or not np.isfinite(rows).all():
            raise mistake(name, f"expected {count} of '(x,y,z)', got {fields[name]!r}")
        return rows

    origin = np.zeros(3)
    if "space directions" in fields:
        steps = vectors("space directions", 3)
    elif "spacings" in fields:
        spacings = numbers("spacings", float)
        if len(spacings) != 3:
            raise mistake("spacings", f"expected 3 numbers, got {fields['spacings']!r}")
        steps = np.diag([1.0 if math.isnan(s) else s for s in spacings])
    else:
        steps = np.eye(3)
    if "space origin" in fields:
        origin = vectors("space origin", 1)[0]
    elif "axis mins" in fields:
        origin = np.nan_to_num(np.array((numbers("axis mins", float) + [0.0] * 3)[:3]))
    return steps, origin


def _nrrd_voxels(
    data: Path, start: int, skip_lines: int, skip_bytes: int, encoding: str, dtype: np.dtype[Any], count: int
) -> NDArray[Any]:
    """Return the voxels, one-dimensional; bytes are skipped after lines and, as Teem does, after decompression."""
    need = count * dtype.itemsize
    with data.open("rb") as file:
        file.seek(start)
        for _ in range(skip_lines):
            file.readline()
        start = file.tell()
        if encoding == "raw":
            size = data.stat().st_size
            start = size - need if skip_bytes == -1 else start + skip_bytes
            if start < 0 or start + need > size:
                raise SceneError(f"{data}: the voxels are cut short: {size - start} bytes, expected {need}")
            return np.memmap(data, dtype, "r", start, (count,))
        if encoding == "ascii":
            file.seek(start + skip_bytes)
            text = file.read().decode("ascii", "replace")
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("error", DeprecationWarning)  # how NumPy says that a word is no number
                    found = np.fromstring(text, np.float64, sep=" ")
            except (DeprecationWarning, ValueError):
                bad = next((word for word in text.split() if not _is_number(word)), "")
                raise SceneError(f"{data}: a voxel is not a number: {bad[:40]!r}") from None
            if len(found) < count:
                raise SceneError(f"{data}: the voxels are cut short: {len(found)} numbers, expected {count}")
            return found[:count]
        try:
            with gzip.GzipFile(fileobj=file) as unpacked:
                unpacked.read(skip_bytes)
                content = unpacked.read(need)
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise SceneError(f"{data}: the compressed voxels are damaged or cut short: {error}") from None
    if len(content) < need:
        raise SceneError(f"{data}: the voxels are cut short: {len(content)} bytes, expected {need}")
    return np.frombuffer(content, dtype)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_vtk(path: Path, array: str | None) -> _Grid:
    with path.open("rb") as file:
        head = file.read(4096)
    announced = re.search(rb"DIMENSIONS\s+(\d+)\s+(\d+)\s+(\d+)", head)
    extent = re.search(rb'WholeExtent="([-\d\s]+)"', head)
    dims: list[int] = [int(n) for n in announced.groups()] if announced else []
    if extent and len(extent[1].split()) == 6:
        ends = [int(n) for n in extent[1].split()]
        dims = [b - a + 1 for a, b in pairwise(ends)][::2]
    if dims:
        _check_volume_memory(dims, np.dtype(np.float64))
    found = read_vtk(path)
    import pyvista

    if not isinstance(found, pyvista.ImageData | pyvista.RectilinearGrid):
        kinds = "image data (structured points) or a rectilinear grid"
        raise SceneError(f"it holds {type(found).__name__}, expected {kinds}")
    values, at_points = _vtk_array(found, array)
    steps, origin = np.eye(3), np.zeros(3)
    if isinstance(found, pyvista.ImageData):
        turned = np.asarray(getattr(found, "direction_matrix", steps), np.float64).T
        steps = turned * np.asarray(found.spacing)[:, None]
        origin = np.asarray(found.origin, np.float64) + (0.0 if at_points else 0.5) * steps.sum(axis=0)
        shape = [n - (not at_points) for n in found.dimensions]
        return _Grid(_shaped(values, shape), steps, origin)
    axes = [np.asarray(a, np.float64) for a in (found.x, found.y, found.z)]
    if min(a.ndim for a in axes) == 0:
        raise SceneError("the file is damaged or cut short: the grid has no coordinates")
    if not at_points:
        axes = [0.5 * (a[1:] + a[:-1]) for a in axes]
    voxels, spacing, uneven = _evenly_spaced(_shaped(values, [len(a) for a in axes]), axes)
    if uneven:
        message = f"{path}: the grid is spaced unevenly along {', '.join(uneven)}; resampled evenly, as many points"
        warnings.warn(message, SceneWarning, stacklevel=3)
    return _Grid(voxels, np.diag(spacing), np.array([a[0] for a in axes]))


def _shaped(values: NDArray[Any], dims: Any) -> NDArray[Any]:
    """Return the values as (nz, ny, nx)."""
    nx, ny, nz = (int(n) for n in dims)
    if min(nx, ny, nz) < 1 or values.size != nx * ny * nz:
        raise SceneError(f"the file is damaged or cut short: {values.size} values for a grid of {nx}x{ny}x{nz}")
    return values.reshape(nz, ny, nx)


def _vtk_array(found: Any, array: str | None) -> tuple[NDArray[Any], bool]:
    """Return an array of scalars, and whether it belongs to the points (else to the cells)."""
    both = ((found.point_data, True), (found.cell_data, False))
    candidates = [
        (name, data[name], at_points) for data, at_points in both for name in list(data.keys()) if isinstance(name, str)
    ]
    names = [name for name, _, _ in candidates]
    if array is not None and array not in names:
        raise SceneError(f"no array {array!r}{did_you_mean(array, names)} (known: {', '.join(names) or 'none'})")
    refused = []
    for name, data, at_points in candidates:
        if array is not None and name != array:
            continue
        values = np.asarray(data)
        if values.ndim == 1 and values.dtype.name in DTYPES:
            return values, at_points
        refused.append(f"{name!r} has {values.shape[-1]} numbers each" if values.ndim > 1
                       else f"{name!r} is of type {values.dtype}")  # fmt: skip
    why = ": " + ", ".join(refused) if refused else ", it may be damaged or cut short"
    raise SceneError(f"the file has no array of one number for each point or cell{why}")


def _evenly_spaced(voxels: NDArray[Any], axes: list[F64]) -> tuple[NDArray[Any], F64, list[str]]:
    """Interpolate linearly to even steps where the steps are not even; return also the steps and which were not."""
    spacing, uneven = np.ones(3), []
    for axis, at in enumerate(axes):
        n = len(at)
        if n < 2:
            continue
        if (np.diff(at) <= 0.0).any():
            raise SceneError(f"the coordinates along {'xyz'[axis]} do not ascend")
        spacing[axis] = (at[-1] - at[0]) / (n - 1)
        if np.abs(np.diff(at) - spacing[axis]).max() <= _EVEN * spacing[axis]:
            continue
        uneven.append("xyz"[axis])
        wanted = at[0] + spacing[axis] * np.arange(n)
        below = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, n - 2)
        weight = np.clip((wanted - at[below]) / (at[below + 1] - at[below]), 0.0, 1.0)
        shape = [1, 1, 1]
        shape[2 - axis] = n
        share = weight.astype(np.float32).reshape(shape)
        low, high = (np.take(voxels, i, 2 - axis).astype(np.float32) for i in (below, below + 1))
        voxels = low * (1.0 - share) + high * share
    return voxels, spacing, uneven
