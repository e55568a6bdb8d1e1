"""Files of structured volumes: the voxels lie where the file says, and what cannot be read is explained."""

from __future__ import annotations

import gzip
import importlib.util
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simrender.errors import CardError, SceneError, SceneWarning
from simrender.rays import memory
from simrender.rays.grids import default_transfer, read_volume
from simrender.rays.memory import check_memory

NX, NY, NZ = 4, 3, 2
INDEX = np.arange(NX * NY * NZ).reshape(NZ, NY, NX)
"""Voxel (x, y, z) is x + 4 y + 12 z: every one tells where it came from."""


@pytest.fixture(scope="session")
def examples() -> Path:
    spec = importlib.util.find_spec("pyvista")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "examples"


@pytest.fixture
def refused(tmp_path: Path) -> Callable[..., str]:
    """Write a file and its companions, read it, and return the error without the folder's name."""

    def read(name: str, content: bytes, **beside: str) -> str:
        (tmp_path / name).write_bytes(content)
        for other, text in beside.items():
            (tmp_path / other.replace("__", ".")).write_text(text)
        with pytest.raises((SceneError, CardError)) as caught:
            read_volume(tmp_path / name)
        return str(caught.value).replace(f"{tmp_path}/", "")

    return read


def nrrd(*fields: str, data: bytes = b"", **changes: str | None) -> bytes:
    own: dict[str, Any] = {"type": "uint8", "dimension": "3", "sizes": "4 3 2", "encoding": "raw"} | changes
    lines = ["NRRD0004", "# a comment", *(f"{k}: {v}" for k, v in own.items() if v is not None), *fields, "key:=value"]
    return ("\n".join(lines) + "\n\n").encode() + data


def write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("kind", ["uint8", "int16", ">u2", "float16", "<f4", ">f8", "int64", "bool"])
@pytest.mark.parametrize("order", ["C", "F"])
def test_npy(tmp_path: Path, kind: str, order: Any) -> None:
    np.save(tmp_path / "a.npy", np.array(INDEX, kind, order=order))
    volume = read_volume(tmp_path / "a.npy", isovalues=(3.0,))
    assert volume.voxels.dtype == np.float32
    assert volume.dims == (NX, NY, NZ)
    assert np.array_equal(volume.voxels, INDEX.astype(kind).astype(np.float32))
    assert (volume.spacing, volume.origin, volume.isovalues) == ((1, 1, 1), (0, 0, 0), (3.0,))


@pytest.mark.parametrize(
    ("kind", "endian", "stored"),
    [
        ("unsigned char", None, "u1"), ("signed char", None, "i1"), ("short", "big", ">i2"),
        ("uint16_t", "little", "<u2"), ("int", "little", "<i4"), ("unsigned int", "big", ">u4"),
        ("long long int", "big", ">i8"), ("float", "little", "<f4"), ("double", "big", ">f8"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("encoding", ["raw", "gzip", "ascii"])
def test_nrrd_types_and_encodings(tmp_path: Path, kind: str, endian: str | None, stored: str, encoding: str) -> None:
    data = INDEX.astype(stored).tobytes()
    data = {"raw": data, "gzip": gzip.compress(data), "ascii": " ".join(map(str, INDEX.ravel())).encode()}[encoding]
    path = write(tmp_path / "a.nrrd", nrrd(type=kind, endian=endian, encoding=encoding, data=data))
    assert np.array_equal(read_volume(path).voxels, INDEX)


def test_nrrd_spacings_and_origin(tmp_path: Path) -> None:
    data = INDEX.astype("u1").tobytes()
    volume = read_volume(write(tmp_path / "a.nrrd", nrrd("spacings: 0.5 nan 2", "axis mins: 1 2 3", data=data)))
    assert (volume.spacing, volume.origin) == ((0.5, 1, 2), (1, 2, 3))


def test_nrrd_directions_turn_and_mirror_the_array(tmp_path: Path) -> None:
    directions = "space directions: (0,0,2) (-0.5,0,0) (0,3,0)"  # the file's axes run along z, -x and y
    content = nrrd(directions, "space origin: (10,20,30)", data=INDEX.astype("u1").tobytes())
    volume = read_volume(write(tmp_path / "a.nrrd", content))
    assert volume.dims == (NY, NZ, NX)
    assert volume.spacing == (0.5, 3, 2)
    assert volume.origin == (9, 20, 30)
    for i, j, k in np.ndindex(NX, NY, NZ):
        place = np.array([10 - 0.5 * j, 20 + 3 * k, 30 + 2 * i])
        x, y, z = np.rint((place - volume.origin) / volume.spacing).astype(int)
        assert volume.voxels[z, y, x] == INDEX[k, j, i]


@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_nrrd_detached_with_lines_and_bytes_to_skip(tmp_path: Path, encoding: str) -> None:
    data = b"xyz" + INDEX.astype(">i2").tobytes()
    data = b"one\ntwo\n" + (gzip.compress(data) if encoding == "gzip" else data)
    (tmp_path / "voxels.bin").write_bytes(data)
    fields = ("datafile: voxels.bin", "line skip: 2", "byteskip: 3")
    header = nrrd(*fields, type="short", endian="big", encoding=encoding)
    for content in (header, header.rstrip(b"\n")):  # no empty line at the end: the header is the whole file
        assert np.array_equal(read_volume(write(tmp_path / "a.nhdr", content)).voxels, INDEX)


def test_nrrd_voxels_at_the_end_of_a_file(tmp_path: Path) -> None:
    (tmp_path / "voxels.bin").write_bytes(b"a header of any length" + INDEX.astype("u1").tobytes())
    path = write(tmp_path / "a.nhdr", nrrd("data file: voxels.bin", "byte skip: -1"))
    assert np.array_equal(read_volume(path).voxels, INDEX)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"type": "block"}, "a.nrrd:3: type: voxels of type 'block' cannot be shown (known: int8, uint8, "),
        ({"type": "flaot"}, "voxels of type 'flaot' cannot be shown; did you mean 'float'?"),
        ({"type": None}, "a.nrrd: the header has no field 'type'"),
        ({"type": "short"}, "a.nrrd: expected little or big for voxels of int16, got 'nothing'"),
        ({"sizes": "4 3 0"}, "a.nrrd:5: sizes: expected numbers above 0, got '4 3 0'"),
        ({"sizes": "4 3 x"}, "a.nrrd:5: sizes: expected whole numbers, got '4 3 x'"),
        ({"dimension": "4", "sizes": "3 4 3 2"}, "a volume has 3 dimensions of one number each, got sizes '3 4 3 2'"),
        ({"encoding": "bzip2"}, "a.nrrd:6: encoding: unknown encoding 'bzip2' (known: raw, gzip, ascii)"),
        ({"sizes": "4 3 9"}, "a.nrrd: the voxels are cut short: 24 bytes, expected 108"),
        ({"encoding": "gzip"}, "a.nrrd: the compressed voxels are damaged or cut short: "),
        ({"encoding": "ascii"}, "a.nrrd: a voxel is not a number: "),
        ({"spacings": "1 1"}, "a.nrrd:7: spacings: expected 3 numbers, got '1 1'"),
        ({"spacings": "1 0 1"}, "a.nrrd: the steps of the grid are finite and not 0"),
        ({"space directions": "(1,0,0) (0,1,0)"}, "space directions: expected 3 of '(x,y,z)', got '(1,0,0) (0,1,0)'"),
        ({"space directions": "(1,1,0) (0,1,0) (0,0,1)"},
         "a.nrrd: the grid is not aligned with the world's axes: its directions are (1, 1, 0) (0, 1, 0) (0, 0, 1)"),
        ({"byte skip": "-2"}, "a.nrrd:7: byte skip: expected one number, 0 or more, got '-2'"),
        ({"line skip": ""}, "a.nrrd:7: line skip: expected one number, 0 or more, got ''"),
        ({"data file": "b.raw"}, "a.nrrd:7: data file: there is no file 'b.raw' in "),
        ({"data file": "b%02d.raw 0 9 1"}, "data file: voxels in several files are not read"),
    ],
)  # fmt: skip
def test_nrrd_mistakes(refused, changes: dict[str, str | None], expected: str) -> None:
    assert expected in refused("a.nrrd", nrrd(data=INDEX.astype("u1").tobytes(), **changes))


def test_other_nrrd_mistakes(refused) -> None:
    assert "begin with the line 'NRRD0005'" in refused("a.nrrd", b"PNG")
    assert "line 2 of the header is no 'field: value': 'oops'" in refused("a.nrrd", b"NRRD0004\noops\n")
    assert "no field 'data file'" in refused("a.nhdr", nrrd())
    text = " ".join(map(str, range(20))).encode()
    assert "the voxels are cut short: 20 numbers, expected 24" in refused("a.nrrd", nrrd(encoding="ascii", data=text))
    cut = gzip.compress(bytes(24))[:-10]
    assert "damaged or cut short" in refused("a.nrrd", nrrd(encoding="gzip", data=cut))
    short = gzip.compress(bytes(20))
    assert "the voxels are cut short: 20 bytes, expected 24" in refused("a.nrrd", nrrd(encoding="gzip", data=short))


@pytest.mark.parametrize("ending", ["yaml", "json"])
def test_raw_with_a_sidecar(tmp_path: Path, ending: str) -> None:
    about = {"dims": [4, 3, 2], "dtype": "uint16", "endian": "big", "spacing": [1, 2, 0.5], "origin": [0, 0, -1]}
    (tmp_path / f"a.{ending}").write_text(json.dumps(about | {"skip_bytes": 5}))
    volume = read_volume(write(tmp_path / "a.raw", b"magic" + INDEX.astype(">u2").tobytes()))
    assert np.array_equal(volume.voxels, INDEX)
    assert (volume.spacing, volume.origin) == ((1, 2, 0.5), (0, 0, -1))


@pytest.mark.parametrize("order", ["xyz", "xzy", "yxz", "yzx", "zxy", "zyx"])
def test_raw_in_any_order_of_its_axes(tmp_path: Path, order: str) -> None:
    slowest_first = ["zyx".index(letter) for letter in reversed(order)]
    (tmp_path / "a.yaml").write_text(f"dims: [4, 3, 2]\ndtype: uint8\norder: {order}\nspacing: [1, 2, 3]\n")
    volume = read_volume(write(tmp_path / "a.raw", INDEX.transpose(slowest_first).astype("u1").tobytes()))
    assert np.array_equal(volume.voxels, INDEX)
    assert volume.spacing == (1, 2, 3)


def test_raw_named_as_the_open_scivis_datasets(tmp_path: Path) -> None:
    path = write(tmp_path / "small_thing_4x3x2_int16.raw", INDEX.astype("<i2").tobytes())
    assert np.array_equal(read_volume(path).voxels, INDEX)


def test_raw_of_the_wrong_size(refused) -> None:
    assert refused("a_4x3x2_uint8.raw", bytes(36)) == (
        "a_4x3x2_uint8.raw: the file has 36 bytes, expected 24 for 4x3x2 voxels of uint8; what would fit: dims 6x3x2, "
        "or dims 4x3x3, or a header of 12 bytes (skip_bytes)"
    )
    assert refused("a_4x3x2_uint8.raw", bytes(48)).endswith(
        "dims 8x3x2, or dims 4x6x2, or dims 4x3x4, or dtype int16, or dtype uint16, or dtype float16, or a header of "
        "24 bytes (skip_bytes)"
    )
    assert refused("a_4x3x2_uint8.raw", bytes(23)).endswith("expected 24 for 4x3x2 voxels of uint8")


def test_raw_without_a_word_about_it(refused) -> None:
    assert refused("a.raw", bytes(24)) == (
        "a.raw: nothing says what is in it: expected beside it a file a.yaml with 'dims: [nx, ny, nz]' and "
        "'dtype: uint8', or a name such as a_256x256x128_uint8.raw"
    )


def test_mistakes_in_a_sidecar_are_told_with_their_place(refused) -> None:
    message = refused(
        "a.raw", bytes(24), a__yaml="dims: [4, 3, 0]\ndtype: complex64\nspacing: [1, 1, 0]\nendain: big\n"
    )
    lines = message.splitlines()
    assert [line.split(":")[:2] for line in lines] == [["a.yaml", str(n)] for n in (1, 2, 3, 4)]
    assert "dims" in lines[0]
    assert "'uint8'" in lines[1]
    assert "did you mean 'endian'?" in lines[3]


@pytest.mark.parametrize(
    ("array", "expected"),
    [
        (np.zeros((4, 4)), "a volume is an array of shape (nz, ny, nx), got 2 dimensions: (4, 4)"),
        (np.zeros((4, 4, 1)), "a volume has at least 2 voxels along each axis, got (1, 4, 4)"),
        (np.zeros((0, 4, 4)), "a volume has at least 2 voxels along each axis, got (4, 4, 0)"),
        (np.zeros((2, 2, 2), complex), "voxels of type 'complex128' cannot be shown (known: int8, "),
        (np.array([{}] * 8).reshape(2, 2, 2), "it holds Python objects, expected numbers"),
        (np.full((2, 2, 2), 1e39), "8 of 8 voxels are not finite; the first is inf at (x, y, z) = (0, 0, 0)"),
    ],
)
def test_arrays_that_are_no_volume(tmp_path: Path, array: np.ndarray, expected: str) -> None:
    path = tmp_path / "a.npy"
    np.save(path, array, allow_pickle=True)
    with pytest.raises(SceneError, match=re.escape(expected)) as caught:
        read_volume(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_one_voxel_that_is_not_a_number_is_found(tmp_path: Path) -> None:
    array = INDEX.astype(float)
    array[1, 2, 3] = np.nan
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(SceneError, match=r"a\.npy: 1 of 24 voxels is not finite; the first is nan at .* = \(3, 2, 1\)"):
        read_volume(tmp_path / "a.npy")


def test_a_damaged_npy(tmp_path: Path, refused) -> None:
    np.save(tmp_path / "a.npy", INDEX)
    content = (tmp_path / "a.npy").read_bytes()
    assert "damaged or cut short" in refused("a.npy", content[:-20])
    assert "damaged or cut short" in refused("a.npy", b"\x93NUMPY")


def test_what_is_no_file(tmp_path: Path, refused) -> None:
    with pytest.raises(SceneError, match=r"unknown volume format '.dcm' \(known: .npy, .nrrd, "):
        read_volume(tmp_path / "a.dcm")
    with pytest.raises(SceneError, match="there is no such file"):
        read_volume(tmp_path / "a.npy")
    (tmp_path / "b.npy").mkdir()
    with pytest.raises(SceneError, match="this is a folder"):
        read_volume(tmp_path / "b.npy")
    assert refused("a.npy", b"") == "a.npy: the file is empty"
    np.save(tmp_path / "c.npy", INDEX)
    with pytest.raises(SceneError, match="only VTK files have named arrays; there is no array 'p'"):
        read_volume(tmp_path / "c.npy", array="p")


def test_a_volume_too_large_for_the_memory_is_refused_before_it_is_read(tmp_path: Path, refused) -> None:
    path = tmp_path / "huge_65536x65536x65536_uint8.raw"
    with path.open("wb") as file:
        file.truncate(1 << 40)  # sparse: 65536 x 65536 x 256 bytes
    with pytest.raises(SceneError, match=r"dims 65536x65536x256$|dims 256x65536x65536"):
        read_volume(path)
    path.unlink()
    message = refused("a.nrrd", nrrd(sizes="65536 65536 65536"))
    assert re.fullmatch(
        r"a\.nrrd: a volume of 65536x65536x65536 voxels of uint8 needs 1\.41 PB of memory, and [\d.]+ [GTM]B are "
        r"available here",
        message,
    )
    vtk = b"# vtk DataFile Version 3.0\nx\nASCII\nDATASET STRUCTURED_POINTS\nDIMENSIONS 65536 65536 65536\n"
    assert "a volume of 65536x65536x65536 voxels of float64 needs 3.38 PB of memory" in refused("a.vtk", vtk)


def test_check_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    assert 1e8 < memory.available_bytes() < 1e15
    monkeypatch.setattr(memory, "available_bytes", lambda: 16e9)
    check_memory(16e9, "this")
    with pytest.raises(
        SceneError, match=r"^a mesh of 5 triangles needs 17 GB of memory, and 16 GB are available here$"
    ):
        check_memory(17e9, "a mesh of 5 triangles")


def test_vtk_image_data(examples: Path) -> None:
    volume = read_volume(examples / "uniform.vtk")
    assert volume.dims == (10, 10, 10)
    assert (volume.spacing, volume.origin) == ((1, 1, 1), (0, 0, 0))
    cells = read_volume(examples / "uniform.vtk", array="Spatial Cell Data")
    assert cells.dims == (9, 9, 9)
    assert cells.origin == (0.5, 0.5, 0.5)
    z, y, x = np.mgrid[:9, :9, :9]
    assert np.array_equal(cells.voxels, x * y * z)
    with pytest.raises(SceneError, match="no array 'Spatial'; did you mean 'Spatial Cell Data'"):
        read_volume(examples / "uniform.vtk", array="Spatial")


def test_an_uneven_vtk_grid_is_resampled_with_a_warning(examples: Path) -> None:
    with pytest.warns(SceneWarning, match=r"rectilinear\.vtk: the grid is spaced unevenly along x, y, z; resampled"):
        volume = read_volume(examples / "rectilinear.vtk")
    assert volume.dims == (26, 27, 23)
    assert np.ptp(volume.voxels) < 1.0


def rectilinear(x: list[float], values: Callable[[float, int, int], float]) -> bytes:
    table = " ".join(str(values(a, j, k)) for k in range(2) for j in range(2) for a in x)
    return (
        f"# vtk DataFile Version 3.0\nx\nASCII\nDATASET RECTILINEAR_GRID\nDIMENSIONS {len(x)} 2 2\n"
        f"X_COORDINATES {len(x)} double\n{' '.join(map(str, x))}\nY_COORDINATES 2 double\n0 1\n"
        f"Z_COORDINATES 2 double\n0 3\nPOINT_DATA {4 * len(x)}\nSCALARS s double 1\nLOOKUP_TABLE default\n{table}\n"
    ).encode()


def test_resampling_keeps_what_is_linear_and_the_ends(tmp_path: Path) -> None:
    content = rectilinear([0, 1, 4, 5, 10], lambda x, j, k: 2 * x + 100 * j - 7 * k)
    with pytest.warns(SceneWarning, match="along x; resampled"):
        volume = read_volume(write(tmp_path / "a.vtk", content))
    assert (volume.spacing, volume.origin) == ((2.5, 1, 3), (0, 0, 0))
    z, y, x = np.mgrid[:2, :2, :5]
    assert volume.voxels == pytest.approx(5.0 * x + 100 * y - 7 * z, rel=1e-6)


def test_an_even_rectilinear_grid_is_taken_as_it_is(tmp_path: Path) -> None:
    volume = read_volume(write(tmp_path / "a.vtk", rectilinear([1, 1.5, 2], lambda x, j, k: x + j + k)))
    assert (volume.spacing, volume.origin) == ((0.5, 1, 3), (1, 0, 0))
    assert volume.voxels[1, 1].tolist() == [3, 3.5, 4]


def test_vtk_files_that_hold_something_else(examples: Path, tmp_path: Path, refused) -> None:
    with pytest.raises(SceneError, match=r"hexbeam\.vtk: it holds UnstructuredGrid, expected image data"):
        read_volume(examples / "hexbeam.vtk")
    assert "a.vtk: the coordinates along x do not ascend" in refused("a.vtk", rectilinear([0, 2, 1], lambda *_: 1.0))
    whole = rectilinear([0, 1, 2], lambda x, *_: x)
    assert re.match("a.vtk: .*damaged", refused("a.vtk", whole[: whole.index(b"POINT_DATA")]))
    assert re.match("a.vti: .*damaged", refused("a.vti", b"<VTKFile type='ImageData'"))
    vectors = whole.replace(b"SCALARS s double 1\nLOOKUP_TABLE default", b"VECTORS v double") + b" 0 1 2" * 8
    assert "no array of one number for each point or cell: 'v' has 3 numbers each" in refused("a.vtk", vectors)


def test_the_default_transfer_function() -> None:
    voxels = np.linspace(0, 1, 1001, dtype=np.float32).repeat(8).reshape(1001, 2, 4)
    transfer = default_transfer(voxels, (1.0, 1.0, 0.016))
    assert transfer.values == pytest.approx([0.5, 0.7495, 0.999], abs=1e-3)
    assert transfer.opacities.tolist() == [0.0, 0.35, 0.9]
    assert transfer.unit == pytest.approx(1.0)
    assert transfer.colors[0, 2] > transfer.colors[0, 0]  # cool
    assert transfer.colors[-1, 0] > transfer.colors[-1, 2]  # warm


def test_the_default_transfer_function_of_few_values() -> None:
    rare = np.zeros((10, 10, 10), np.float32)
    rare[5, 5, 5] = 3
    assert default_transfer(rare).values.tolist() == [0, 1.5, 3]
    constant = default_transfer(np.full((3, 3, 3), 7, np.float32))
    assert constant.values.tolist() == [7]
    assert 0 < constant.opacities[0] < 0.5
    step = np.float32(1e-38)
    assert len(default_transfer(np.array([0, step], np.float32).repeat(4).reshape(2, 2, 2)).values) == 3
