"""Textures: which color a surface takes from which image, and how they come out of mesh files."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from PIL import Image

from simrender import load_workload
from simrender.errors import SceneError, SceneWarning
from simrender.rays.integrators import RayCasting
from simrender.rays.meshes import read_scene
from simrender.rays.scene import GAMMA, IDENTITY, Environment, Material, Mesh, Scene, SceneObject, Texture, texture
from simrender.rays.store import NoStore
from simrender.rays.trace import Trace

CORNERS = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
SQUARE = np.int32([[0, 1, 2], [0, 2, 3]])
BLACK = Environment(zenith=(0.0, 0.0, 0.0), horizon=(0.0, 0.0, 0.0), ground=(0.0, 0.0, 0.0))
TEXELS = np.uint8([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]])
"""Red and green above blue and white."""


def square(image, uv=CORNERS[:, :2], albedo=(1.0, 1.0, 1.0)):
    """A unit square with an image on it."""
    mesh = Mesh(CORNERS, SQUARE, uv=uv)
    materials = (Material(albedo, texture=0),)
    return Scene(
        (SceneObject("square", (mesh,)),), np.zeros(1, np.int32), IDENTITY[None], materials, (), BLACK, (),
        textures=(Texture(image),),
    )  # fmt: skip


def seen(scene, across, *, half=0.5):
    """What a camera above the square's middle sees, lit from where it is."""
    camera = np.array([[0.5, 0.5, 100.0], [0.0, 0.0, -1.0], [half / 100, 0.0, 0.0], [0.0, half / 100, 0.0]])
    trace = Trace(scene, camera, (across, across), 1, RayCasting(), jitter=False)
    trace.store = NoStore()
    trace.complete()
    return trace.image()


def test_the_middle_of_a_texel_has_its_color_and_the_first_row_is_on_top():
    image = seen(square(TEXELS), 4)  # rays go through the lower left corners of pixels: here, the middles of texels
    assert image[2, 1] == pytest.approx([0.0, 0.0, 1.0], abs=2e-3)
    assert image[0, 1] == pytest.approx([1.0, 0.0, 0.0], abs=2e-3)
    assert image[0, 3] == pytest.approx([0.0, 1.0, 0.0], abs=2e-3)
    assert image[2, 3] == pytest.approx([1.0, 1.0, 1.0], abs=2e-3)


def test_between_texels_their_reflectances_are_mixed():
    image = seen(square(TEXELS), 4)
    assert image[2, 2] == pytest.approx([0.5, 0.5, 1.0], abs=2e-3)  # between blue and white
    assert image[1, 2] == pytest.approx([0.5, 0.5, 0.5], abs=2e-3)  # in the middle of all four
    grey = square(np.full((1, 1, 3), 128, np.uint8))
    assert seen(grey, 3) == pytest.approx((128 / 255) ** GAMMA, abs=2e-3)


def test_an_image_is_repeated_and_multiplied_by_the_albedo():
    twice = seen(square(TEXELS, uv=2.0 * CORNERS[:, :2] - 1.0, albedo=(0.5, 1.0, 0.25)), 8)
    once = seen(square(TEXELS), 4)
    assert twice[:4, :4] == pytest.approx(once * np.float32([0.5, 1.0, 0.25]), abs=2e-3)
    assert twice[4:, 4:] == pytest.approx(twice[:4, :4], abs=1e-4)


def test_reflectances_come_back_within_half_a_step_of_a_byte():
    tone = np.linspace(0.0, 1.0, 97).reshape(-1, 1, 1) * np.ones(3)
    back = (texture(tone).texels / 255.0) ** GAMMA
    assert np.abs(back - tone).max() < 0.5 * GAMMA / 255.0 + 1e-12


def painted(material):
    """The square as trimesh has it."""
    import trimesh

    visual = trimesh.visual.TextureVisuals(uv=CORNERS[:, :2], material=material)
    return trimesh.Trimesh(CORNERS, SQUARE, visual=visual, process=False)


@pytest.mark.parametrize("ending", ["glb", "obj"])
def test_a_mesh_file_keeps_its_image(ending, tmp_path):
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    image = Image.fromarray(TEXELS)
    if ending == "glb":
        material = PBRMaterial(baseColorTexture=image, baseColorFactor=[255, 51, 255, 255])
    else:
        material = SimpleMaterial(image=image, diffuse=[10, 20, 30, 255])
    path = tmp_path / f"square.{ending}"
    painted(material).export(path)
    scene = read_scene(path)
    assert [image.texels.tolist() for image in scene.textures] == [TEXELS.tolist()]
    assert {scene.materials[mesh.material].texture for mesh in scene.meshes} == {0}
    green = 0.2 if ending == "glb" else 1.0  # the image of an OBJ file takes the place of its color
    assert scene.materials[0].albedo == pytest.approx((1.0, green, 1.0))
    lit = seen(Scene(scene.objects, scene.instance_object, scene.instance_transform, scene.materials, (), BLACK,
                     textures=scene.textures), 4)  # fmt: skip
    assert lit[0, 3] == pytest.approx([0.0, green, 0.0], abs=2e-3)
    assert lit[2, 1] == pytest.approx([0.0, 0.0, 1.0], abs=2e-3)
    assert load_workload(str(path), cache=tmp_path).published.texture_bytes == TEXELS.nbytes


OBJ = "mtllib square.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3\n"


def test_an_image_that_is_not_there_is_warned_of_and_the_color_stays(tmp_path):
    path = tmp_path / "square.obj"
    path.write_text(OBJ)
    (tmp_path / "square.mtl").write_text("newmtl m\nKd 1 0 0\nmap_Kd bricks.png\n")
    (tmp_path / "brick.png").write_bytes(b"")
    message = f"{tmp_path / 'square.mtl'}:3: there is no image 'bricks.png' in {tmp_path}, and the surface has its "
    with pytest.warns(SceneWarning, match=re.escape(message + "color alone; did you mean 'brick.png'?")):
        scene = read_scene(path)
    assert (scene.textures, scene.materials[0].albedo) == ((), (1.0, 0.0, 0.0))


def test_an_image_of_several_surfaces_is_one_texture(tmp_path):
    import trimesh
    from trimesh.visual.material import PBRMaterial

    material, scene = PBRMaterial(baseColorTexture=Image.fromarray(TEXELS)), trimesh.Scene()
    for name in ("one", "two"):
        scene.add_geometry(painted(material), geom_name=name)
    (tmp_path / "two.glb").write_bytes(scene.export(file_type="glb"))
    found = read_scene(tmp_path / "two.glb")
    assert (len(found.objects), len(found.textures)) == (2, 1)
    assert [material.texture for material in found.materials] == [0, 0]


def test_the_vertices_of_a_glb_file_keep_their_colors(tmp_path):
    import trimesh

    made = trimesh.Trimesh(CORNERS, SQUARE, vertex_colors=[[255, 51, 0, 255]] * 4, process=False)
    (tmp_path / "square.glb").write_bytes(trimesh.Scene(made).export(file_type="glb"))
    (thing,) = read_scene(tmp_path / "square.glb").objects
    for mesh in thing.meshes:
        assert mesh.colors == pytest.approx(np.tile([1.0, 0.2, 0.0], (len(mesh.vertices), 1)))


def test_an_image_that_gltf_names_is_looked_for_too(tmp_path):
    import trimesh
    from trimesh.visual.material import PBRMaterial

    made = painted(PBRMaterial(baseColorTexture=Image.fromarray(TEXELS)))
    for name, data in trimesh.Scene(made).export(file_type="gltf").items():
        (tmp_path / name).write_bytes(data)
    path = tmp_path / "model.gltf"
    card = json.loads(path.read_bytes())
    path.write_text(json.dumps(card | {"images": [{"uri": "bricks.png"}]}))
    with pytest.warns(SceneWarning, match="model.gltf: image 0: there is no image 'bricks.png'"):
        assert read_scene(path).textures == ()
    Image.fromarray(TEXELS).save(tmp_path / "bricks.png")
    assert [image.texels.tolist() for image in read_scene(path).textures] == [TEXELS.tolist()]


def test_a_damaged_image_is_refused(tmp_path):
    path, image = tmp_path / "square.obj", tmp_path / "bricks.png"
    path.write_text(OBJ)
    (tmp_path / "square.mtl").write_text("newmtl m\nmap_Kd bricks.png\n")
    for damage in (b"", b"no image at all"):
        image.write_bytes(damage)
        with pytest.raises(
            SceneError, match=re.escape(f"square.mtl:2: cannot read the image {image}, which is damaged")
        ):
            read_scene(path)


def test_what_is_no_texture_is_refused():
    with pytest.raises(SceneError, match=r"uint8 of shape \(height, width, 3\), got float64 of \(2, 2, 3\)"):
        Texture(np.ones((2, 2, 3)))
    with pytest.raises(SceneError, match=r"got uint8 of \(4, 4\)"):
        Texture(np.ones((4, 4), np.uint8))
    with pytest.raises(SceneError, match=r"4 vertices need texture coordinates \(n, 2\), got \(3, 2\)"):
        Mesh(CORNERS, SQUARE, uv=np.zeros((3, 2)))
    with pytest.raises(SceneError, match="texture coordinates are not finite"):
        Mesh(CORNERS, SQUARE, uv=np.full((4, 2), np.nan))
    with pytest.raises(SceneError, match="object 'square' has a texture, but no texture coordinates"):
        square(TEXELS, uv=None)
    with pytest.raises(SceneError, match="a material uses texture 3 of 0"):
        Scene((SceneObject("x", (Mesh(CORNERS, SQUARE),)),), np.zeros(1, np.int32), IDENTITY[None],
              (Material(), Material(texture=3)))  # fmt: skip
