"""Scene files of SpRay: what they place where, and how their mistakes are told."""

from __future__ import annotations

import shutil
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from simrender.errors import SceneError, SceneWarning
from simrender.rays import spray
from simrender.rays.meshes import read_mesh, read_scene
from simrender.rays.scene import Material, PointLight
from simrender.rays.spray import SprayScene, read_spray
from tests.conftest import ply_text

DATA = Path(__file__).parent.parent / "data"

WHOLE = "domain\nfile wavelet.ply\nbound -10 -10 -10 10 9.324713 10\nface 5480\nvertex 2840\n"
SQUARE = ply_text([[0, 0, 0], [1, 0, 0], [1, 2, 0], [0, 2, 0]], [[0, 1, 2], [0, 2, 3]])


@pytest.fixture
def scene(tmp_path: Path) -> Callable[[str], SprayScene]:
    """Write a scene file beside a square of 4 vertices and 2 triangles, and read it."""

    def read(text: str) -> SprayScene:
        (tmp_path / "square.ply").write_text(SQUARE)
        (tmp_path / "some.spray").write_text(text)
        return read_spray(tmp_path / "some.spray")

    return read


@pytest.fixture
def mistakes(scene: Callable[[str], SprayScene], tmp_path: Path) -> Callable[[str], list[str]]:
    """Read a scene file that must fail; return the mistakes without the file's name."""

    def read(text: str) -> list[str]:
        with pytest.raises(SceneError) as caught:
            scene(text)
        lines = str(caught.value).splitlines()
        start = f"{tmp_path / 'some.spray'}:"
        assert all(line.startswith(start) for line in lines)
        return [line.removeprefix(start) for line in lines]

    return read


def test_the_example_scene_of_spray() -> None:
    found = read_spray(DATA / "wavelets64.spray")
    assert len(found.low) == 64
    assert found.faces.tolist() == [5480] * 64
    assert found.vertices.tolist() == [2840] * 64
    assert found.scene.instanced_triangles == 350_720
    assert found.scene.points == (PointLight((0.0, 500.0, 1000.0), (1.0, 1.0, 1.0), falloff=False),)
    assert found.scene.hemispheres == ()
    d = np.arange(64)
    shift = np.stack([20 * (d % 4), 19.324713 * (d // 4 % 4), 20 * (d // 16)], axis=1)
    assert found.low == pytest.approx(np.array([-10, -10, -10]) + shift, abs=1e-5)
    assert found.high == pytest.approx(np.array([10, 9.324713, 10]) + shift, abs=1e-5)
    # Neighbours share a face to the bit in x and z, so no ray can pass between them.
    assert np.array_equal(found.high[0, [0, 2]], [found.low[1, 0], found.low[16, 2]])


def test_domains_share_the_mesh_that_is_read_once(monkeypatch: pytest.MonkeyPatch) -> None:
    read = []
    monkeypatch.setattr(spray, "read_mesh", lambda path: (read.append(path), read_mesh(path))[1])
    found = read_spray(DATA / "wavelets64.spray")
    assert len(read) == 1
    first = found.scene.objects[0].meshes[0]
    assert all(thing.meshes[0] is first for thing in found.scene.objects)
    assert [thing.name for thing in found.scene.objects][17] == "domain 17"


def test_vertex_colors_are_kept_as_the_file_has_them_and_shading_is_smooth() -> None:
    mesh = read_spray(DATA / "wavelets4.spray").scene.objects[0].meshes[0]
    assert mesh.smooth
    assert mesh.colors[0] == pytest.approx(np.array([144, 178, 254]) / 255)


def test_transforms_lights_and_materials() -> None:
    found = read_spray(DATA / "wavelets4.spray")
    assert found.scene.points == (PointLight((0.0, 500.0, 1000.0), (0.5, 0.5, 0.25), falloff=False),)
    assert found.scene.hemispheres == ((0.1, 0.2, 0.3),)
    used = [found.scene.materials[thing.meshes[0].material] for thing in found.scene.objects]
    white = Material((1.0, 1.0, 1.0))
    assert used == [white, Material((0.9, 0.8, 0.7), mirror=1.0), white, Material((0.5, 0.5, 0.5))]
    assert found.scene.environment.zenith == found.scene.environment.ground == (0.0, 0.0, 0.0)
    # The last line moves the mesh first: scaled to (5, 9.3, 2.5), then turned, then lifted.
    point = found.scene.instance_transform[2] @ np.array([10, 1, -10, 1])
    assert point == pytest.approx([-2.5, 31, -5], abs=1e-5)
    assert found.low[2] == pytest.approx([-2.5, 20, -5], abs=1e-5)
    assert found.high[2] == pytest.approx([2.5, 39.324713, 5], abs=1e-5)
    # Where no box is announced it is the mesh's.
    assert found.low[3] == pytest.approx([30, -10, -10])
    assert found.high[3] == pytest.approx([50, 9.3247128, 10], abs=1e-6)


def test_every_triangle_lies_in_its_domains_box() -> None:
    found = read_spray(DATA / "wavelets4.spray")
    world = found.scene.triangles
    owner = np.repeat(np.arange(4), found.faces)
    corners = world.vertices[world.faces]
    assert (corners >= found.low[owner][:, None] - 1e-5).all()
    assert (corners <= found.high[owner][:, None] + 1e-5).all()


@pytest.mark.parametrize(("axis", "expected"), [("x", [1, -3, 2]), ("y", [3, 2, -1]), ("z", [-2, 1, 3])])
def test_rotations_are_right_handed(scene, axis: str, expected: list[float]) -> None:
    found = scene(f"domain\nfile square.ply\nrotate {axis} 90\n")
    assert found.scene.instance_transform[0] @ np.array([1, 2, 3, 1]) == pytest.approx(expected, abs=1e-6)


def test_a_rotated_box_holds_all_its_corners(scene) -> None:
    found = scene("domain\nfile square.ply\nbound 0 0 0 1 2 0\nrotate z 45\n")
    half = np.sqrt(0.5)
    assert found.low[0] == pytest.approx([-2 * half, 0, 0], abs=1e-6)
    assert found.high[0] == pytest.approx([half, 3 * half, 0], abs=1e-6)


def test_the_later_keywords_say_the_same(scene) -> None:
    old = scene("light diffuse 1 1 1\ndomain\nfile square.ply\nmtl diffuse 1 1 1\nbound 0 0 0 1 2 0\ntranslate 5 0 0\n")
    new = scene(
        "light diffuse-hemisphere 1 1 1\nDomainBegin\nDomainFace 2\nDomainVertex 4\nModelBegin\nfile square.ply\n"
        "material matte\nModelBounds 0 0 0 1 2 0\nModelFace 2\nModelVertex 4\ntranslate 5 0 0\nModelEnd\nDomainEnd\n"
    )
    assert new.scene.key == old.scene.key
    assert np.array_equal([new.low, new.high], [old.low, old.high])


def test_several_models_of_a_domain_are_placed_each_by_its_own_lines(scene) -> None:
    found = scene(
        "DomainBegin\nDomainBounds -1 0 0 6 3 1\nDomainFace 4\nModelBegin\nfile square.ply\nModelEnd\n"
        "ModelBegin\nfile square.ply\nmaterial mirror 1 1 1\ntranslate 5 0 1\nModelEnd\nDomainEnd\n"
    )
    assert found.faces.tolist() == [4]
    assert found.scene.triangles.vertices.max(axis=0).tolist() == [6, 2, 1]
    assert (found.low.tolist(), found.high.tolist()) == ([[-1, 0, 0]], [[6, 3, 1]])
    assert [found.scene.materials[m.material].mirror for m in found.scene.objects[0].meshes] == [0.0, 1.0]


def test_a_box_that_does_not_hold_its_mesh_is_widened_with_a_warning(scene) -> None:
    with pytest.warns(SceneWarning, match=r"some\.spray:3: the box is too small for square\.ply by 0\.5; it is wid"):
        found = scene("domain\nfile square.ply\nbound 0 0 0 1 1.5 0\n")
    assert found.high[0].tolist() == [1, 2, 0]
    with pytest.warns(SceneWarning, match="too small for the meshes of domain 0 by 4"):
        found = scene("DomainBegin\nDomainBounds 0 0 0 2 2 0\nModelBegin\nfile square.ply\ntranslate 5 0 0\n"
                      "ModelEnd\nDomainEnd\n")  # fmt: skip
    assert found.high[0].tolist() == [6, 2, 0]


def test_few_digits_are_no_reason_to_warn() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_spray(DATA / "wavelets64.spray")


def test_comments_blank_lines_tabs_and_carriage_returns_are_passed_over(scene) -> None:
    found = scene("# a\r\n\r\n\t domain # b\r\n  file\tsquare.ply\t# c\r\n#file other.ply\r\n")
    assert found.faces.tolist() == [2]


def test_file_names_may_have_spaces(tmp_path: Path) -> None:
    (tmp_path / "my square.ply").write_text(SQUARE)
    (tmp_path / "a.spray").write_text("domain\nfile my square.ply\n")
    assert read_spray(tmp_path / "a.spray").faces.tolist() == [2]


def test_all_mistakes_are_told_at_once_in_the_order_of_the_lines(mistakes) -> None:
    found = mistakes(
        "light pont 0 0 0 1 1 1\n"
        "light point 0 0 0 1 1\n"
        "light diffuse 1 1 white\n"
        "file square.ply\n"
        "domain\n"
        "file sqare.ply\n"
        "mtl glass 1 1.5\n"
        "bound 0 0 0 1 -2 0\n"
        "face two\n"
        "Vertex 4\n"
        "rotate w 90\n"
        "translate 1 2\n"
        "scale 1 0 1\n"
        "domain\n"
        "file square.ply\n"
        "file square.ply\n"
        "face 3\n"
        "vertex 5\n"
        "translate 0 nan 0\n"
        "sphere 0 0 0 1\n"
    )
    assert [int(line.split(":")[0]) for line in found] == [1, 2, 3, 4, 6, 7, 8, 9, 10, 11, 12, 13, 16, 17, 18, 19, 20]
    expected = [
        "unknown light 'pont'; did you mean 'point'? (known: point, diffuse, diffuse-hemisphere, diffuse-sphere)",
        "'light point' wants 6 numbers (a position x y z and a radiance r g b), got 5: '0 0 0 1 1'",
        "'light diffuse' wants numbers (a radiance r g b), got 'white' in '1 1 white'",
        "'file' belongs after a line 'domain'; there is none before it",
        "; did you mean 'square.ply'?",
        "material 'glass' cannot be rendered: light is not refracted here (known: diffuse, matte, mirror)",
        "'bound': the smallest y is above the largest, got '0 0 0 1 -2 0'",
        "'face' wants one whole number, got 'two'",
        "unknown keyword 'Vertex'; did you mean 'vertex'?",
        "'rotate' wants an axis x, y or z and an angle in degrees, got 'w 90'",
        "'translate' wants 3 numbers (x y z), got 2: '1 2'",
        "'scale' by 0 flattens the mesh, got '1 0 1'",
        "a second 'file' for this mesh, after line 15: it has one",
        "the file announces 3 faces, but square.ply has 2",
        "the file announces 5 vertices, but square.ply has 4",
        "'translate' wants finite numbers (x y z), got 'nan' in '0 nan 0'",
        "'sphere': only triangle meshes are rendered; write the sphere as a PLY file",
    ]
    for line, words in zip(found, expected, strict=True):
        assert words in line


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "1: the file has no domain: expected lines 'domain' and 'file NAME.ply'"),
        ("domain\n", "1: domain 0 has a mesh without a line 'file NAME.ply'"),
        ("DomainBegin\nDomainEnd\n", "1: domain 0 has no model: expected 'ModelBegin' and 'file NAME.ply'"),
        ("DomainBegin\nModelBegin\nfile square.ply\nModelEnd\n", "1: 'DomainBegin' has no 'DomainEnd'"),
        ("ModelEnd\ndomain\nfile square.ply\n", "1: 'ModelEnd' without a 'DomainBegin' before it"),
        ("domain x\nfile square.ply\n", "1: 'domain' stands alone on its line, got 'x' after it"),
        ("domain\nfile square.ply\nmtl lambert 1 1 1\n",
         "3: unknown material 'lambert' (known: diffuse, matte, mirror)"),
        ("domain\nfile square.ply\nmtl diffuse 1 1 2\n",
         "3: 'mtl diffuse': a reflectance lies between 0 and 1, got '1 1 2'"),
        ("domain\nfile square.obj\n", "2: 'square.obj' is no PLY file: the meshes of a scene file end in .ply"),
        ("light diffuse -1 0 0\ndomain\nfile square.ply\n",
         "1: 'light diffuse': a radiance is not negative, got -1 0 0"),
        ("DomainBegin\nDomainFace 5\nModelBegin\nfile square.ply\nModelEnd\nDomainEnd\n",
         "2: the file announces 5 faces, but all meshes of this domain has 2"),
        ("DomainBegin\nModelBegin\nfile square.ply\nDomainEnd\n",
         "4: 'DomainEnd' before the 'ModelEnd' of line 2's model"),
        ("domain\nfile square.ply\nDomainFace 2\n",
         "3: 'DomainFace' belongs between 'DomainBegin' and 'DomainEnd', outside of models"),
    ],
)  # fmt: skip
def test_one_mistake(mistakes, text: str, expected: str) -> None:
    assert mistakes(text) == [expected]


def test_a_damaged_mesh_is_named_with_the_line_that_names_it(tmp_path: Path) -> None:
    shutil.copy(DATA / "wavelets64.spray", tmp_path)
    (tmp_path / "wavelet.ply").write_bytes((DATA / "wavelet.ply").read_bytes()[:100_000])
    with pytest.raises(SceneError) as caught:
        read_spray(tmp_path / "wavelets64.spray")
    assert str(caught.value) == (
        f"{tmp_path / 'wavelets64.spray'}:6: {tmp_path / 'wavelet.ply'}: cannot read this mesh, which is damaged or "
        "cut short: it ends at byte 100000, in face 4391 of 5480"
    )


def test_what_is_no_scene_file(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.spray: there is no such file"):
        read_spray(tmp_path / "none.spray")
    with pytest.raises(SceneError, match="this is a folder"):
        read_spray(tmp_path)
    (tmp_path / "mesh.spray").write_bytes((DATA / "wavelet.ply").read_bytes())
    with pytest.raises(SceneError, match=r"mesh\.spray: byte \d+ is not text: this is no scene file of SpRay"):
        read_spray(tmp_path / "mesh.spray")


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda b: b[:20_000], "it ends at byte 20000, in vertex 1312 of 2840"),
        (lambda b: b[:-1], "it ends at byte 114154, in face 5479 of 5480"),
        (lambda b: b[:100], "its header, 100 bytes long, does not end with a line 'end_header'"),
        (lambda b: b"x" + b, "it does not begin with the line 'ply'"),
    ],
)
def test_where_a_binary_mesh_was_cut(tmp_path: Path, change: Callable[[bytes], bytes], expected: str) -> None:
    path = tmp_path / "cut.ply"
    path.write_bytes(change((DATA / "wavelet.ply").read_bytes()))
    with pytest.raises(SceneError) as caught:
        read_mesh(path)
    assert str(caught.value) == f"{path}: cannot read this mesh, which is damaged or cut short: {expected}"


def test_in_which_line_a_text_mesh_lacks_a_number(tmp_path: Path) -> None:
    path = tmp_path / "cut.ply"
    path.write_text(SQUARE.replace("1.0 2.0 0.0\n", "1.0 2.0\n"))
    with pytest.raises(SceneError, match=r"line 12 has 2 of the 3 numbers of vertex 2 of 4$"):
        read_mesh(path)
    path.write_text(SQUARE.replace("3 0 2 3", "3 0 2"))
    with pytest.raises(SceneError, match=r"line 15 has 3 of the 4 numbers of face 1 of 2$"):
        read_mesh(path)


def test_binary_polygons_of_several_sizes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mixed.ply"
    head = "ply\nformat binary_big_endian 1.0\nelement vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 2\nproperty list uchar int vertex_indices\nend_header\n"
    vertices = head.encode() + struct.pack(">15f", *[0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0, 2, 2, 0])
    four, three = struct.pack(">B4i", 4, 0, 1, 2, 3), struct.pack(">B3i", 3, 1, 4, 2)
    path.write_bytes(vertices + four + four)
    assert len(read_mesh(path).faces) == 4
    path.write_bytes(vertices + four + three)
    with pytest.raises(SceneError, match="not all of its faces have the same number of corners: write them as triang"):
        read_mesh(path)
    path.write_bytes(vertices + four + three[:-2])
    with pytest.raises(SceneError, match=f"ends at byte {len(vertices) + 28}, in face 1 of 2"):
        read_mesh(path)
    path.write_bytes(vertices + three + four)
    with pytest.raises(SceneError, match=f"it has {len(vertices) + 30} bytes, but rows like the first of each element"):
        read_mesh(path)


def test_a_mesh_that_is_cut_into_parts_keeps_its_colors() -> None:
    mesh = read_mesh(DATA / "wavelet.ply")
    parts = read_scene(DATA / "wavelet.ply").objects[0].meshes
    colors = np.concatenate([part.colors[part.faces] for part in parts])
    assert len(parts) > 1
    assert colors == pytest.approx(mesh.colors[mesh.faces] ** 2.2, rel=1e-5)  # from display values to reflectance


@pytest.mark.parametrize("name", ["ant", "nut", "airplane", "sphere"])
def test_real_meshes_are_found_whole(ply: Path, name: str) -> None:
    assert len(read_mesh(ply.with_name(f"{name}.ply")).faces) > 100
