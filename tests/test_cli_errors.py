"""The command line: what a person gets for bad input."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

TRUNCATED = 100
"""Lines of the bumpy square's PLY file that are left when it is cut."""


# Names


def test_unknown_names_say_what_is_near(bad, tiny_card):
    machines = "desktop-rtx8000, dgx2, frontera-rtx, hgx-a100, laptop, manta-cluster, rtx-server-a40, stampede2-skx"
    assert bad("run", "dgx3", tiny_card) == f"unknown machine 'dgx3'; did you mean 'dgx2'? (known: {machines})"
    assert bad("run", "dgx2", "xyzzy").startswith("unknown workload 'xyzzy' (known: ")
    message = bad("run", "dgx2", tiny_card, "--policy", "ray_que_cycling")
    assert message.startswith("unknown policy 'ray_que_cycling'; did you mean 'ray_queue_cycling'? (known: ")
    assert bad("show", "dgx").startswith("unknown machine, workload or policy 'dgx'; did you mean 'dgx2'? (known: ")
    assert bad("show", "no.yaml").startswith("unknown machine, workload or policy 'no.yaml' (known: ")


def test_unknown_words_of_the_command_line(bad, tiny_card):
    assert (
        bad("rnu")
        == 'Unknown command "rnu". Did you mean "run"? Available commands: list, show, trace, run, compare, network.'
    )
    assert bad("list", "machine").endswith('Did you mean "machines"?')
    assert bad("run", "dgx2", tiny_card, "--polcy", "x") == "Unknown option: --polcy. Did you mean --policy?"
    assert bad("run", "dgx2").endswith("parameter WORKLOAD requires an argument.")
    assert bad("run", "dgx2", tiny_card, "extra") == "unexpected argument 'extra'"
    assert bad("run", "dgx2", tiny_card, "--set", "machine.gpus=2", "machine.gpu.memory=3 GiB") == (
        "unexpected argument 'machine.gpu.memory=3 GiB'; each --set takes one PATH=VALUE"
    )


# Cards


def test_a_card_that_is_no_yaml(bad, tiny_card):
    tiny_card.write_text("title: [\n")
    assert bad("run", "dgx2", tiny_card).startswith(f"{tiny_card}:2:1: not valid YAML: ")
    assert bad("trace", tiny_card).startswith(f"{tiny_card}:2:1: not valid YAML: ")
    assert bad("show", tiny_card).startswith(f"{tiny_card}:2:1: not valid YAML: ")


def test_a_machine_that_is_no_card(bad, tiny_card, tmp_path):
    path = tmp_path / "node.yaml"
    path.write_text("")
    assert bad("run", path, tiny_card) == f"{path}:1:1: a card is a mapping of fields, got nothing"


def test_every_mistake_of_a_card_in_one_message(bad, tiny_card):
    tiny_card.write_text(
        tiny_card.read_text()
        .replace("resolution: 64x36, samples: 2", "resolution: 64, samples: 0")
        .replace("file", "fil")
    )
    assert bad("run", "dgx2", tiny_card).splitlines() == [
        f"{tiny_card}:2:25: published.resolution: expected WIDTHxHEIGHT in pixels such as '2560x1080', got 64",
        f"{tiny_card}:2:38: published.samples: should be greater than or equal to 1, got 0",
        f"{tiny_card}:4:9: scene.fil: unknown field; did you mean 'file'? (known: file, generator, arguments)",
    ]


def test_a_camera_that_looks_nowhere(bad, tiny_card):
    tiny_card.write_text(tiny_card.read_text().replace("look_at: [0, 0, 0]", "look_at: [2, -2, 1.5]"))
    assert bad("run", "dgx2", tiny_card) == (
        f"{tiny_card}:5:9: camera: the camera looks nowhere: look_at equals position, or lies straight along up"
    )


def test_a_scene_without_a_source_or_with_two(bad, tiny_card):
    text = tiny_card.read_text()
    for scene in ("{}", "{file: bumpy.ply, generator: 'a:b'}"):
        tiny_card.write_text(text.replace("{file: bumpy.ply}", scene))
        message = f"{tiny_card}:4:8: scene: a scene has exactly one of the fields file and generator"
        assert bad("run", "dgx2", tiny_card) == message


def test_a_generator_that_cannot_be_loaded_or_makes_no_scene(bad, tiny_card):
    text, where = tiny_card.read_text(), f"{tiny_card}:4:20: scene.generator"
    for scene, message in (
        ("'nosuch:f'", "cannot load 'nosuch:f' (written as package.module:function): No module named 'nosuch'"),
        ("'os:getcwd'", "os:getcwd returned a str, not a Scene"),
        (
            "'os:getcwd', arguments: {size: 3}",
            "os:getcwd does not take these arguments: got an unexpected keyword argument 'size'",
        ),
    ):
        tiny_card.write_text(text.replace("file: bumpy.ply", f"generator: {scene}"))
        assert bad("run", "dgx2", tiny_card) == f"{where}: {message}"


# Meshes


def test_a_mesh_that_is_not_there(bad, tmp_path, tiny_card):
    assert bad("run", "dgx2", tmp_path / "nowhere.ply") == f"{tmp_path / 'nowhere.ply'}: there is no such file"
    tiny_card.write_text(tiny_card.read_text().replace("bumpy.ply", "nowhere.ply"))
    assert bad("run", "dgx2", tiny_card) == f"{tmp_path / 'nowhere.ply'}: there is no such file"


def test_a_mesh_of_an_unknown_ending(bad, tmp_path, tiny_card):
    (tmp_path / "scene.abc").write_text("x")
    message = bad("run", "dgx2", tmp_path / "scene.abc")
    assert "ends in .yaml or .yml; a scene ends in .ply, .obj, .glb, .gltf, .stl, .spray, .npy" in message
    tiny_card.write_text(tiny_card.read_text().replace("bumpy.ply", "scene.abc"))
    assert bad("run", "dgx2", tiny_card) == (
        f"{tmp_path / 'scene.abc'}: unknown scene format '.abc' (known: .ply, .obj, .glb, .gltf, .stl, .spray, "
        ".npy, .nrrd, .nhdr, .raw, .vti, .vtr, .vtu, .vtk)"
    )


def test_a_folder_instead_of_a_mesh_or_card(bad, tmp_path):
    (tmp_path / "folder.ply").mkdir()
    assert bad("run", "dgx2", tmp_path / "folder.ply").endswith("folder.ply: this is a folder, expected a file")
    assert bad("run", "dgx2", tmp_path).endswith(
        f": this is a folder, expected the card of a workload, such as {tmp_path / 'card.yaml'}"
    )


def test_an_empty_mesh(bad, mesh_file, tmp_path):
    path = mesh_file("empty.ply", faces=[])
    assert bad("run", "dgx2", path) == f"{path}: the mesh is empty: it has no triangles"
    path.write_text("")
    assert bad("run", "dgx2", path) == f"{path}: the file is empty"


def test_a_mesh_with_vertices_that_are_no_numbers(bad, mesh_file):
    vertices = np.random.Generator(np.random.Philox(1)).random((169, 3))
    vertices[3] = [np.nan, 0.0, 0.0]
    vertices[7, 2] = np.inf
    path = mesh_file("nan.ply", vertices)
    message = "2 of 169 vertices are not finite; the first is vertex 3: [nan, 0.0, 0.0]"
    assert bad("run", "dgx2", path) == f"{path}: {message}"


def test_a_mesh_too_large_for_single_precision(bad, mesh_file):
    path = mesh_file("far.ply", [[0, 0, 0], [1e300, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    assert bad("run", "dgx2", path) == f"{path}: 1 of 3 vertices are not finite; the first is vertex 1: [inf, 0.0, 0.0]"


def test_a_mesh_without_extent(bad, mesh_file):
    path = mesh_file("point.ply", [[1, 2, 3]] * 3, [[0, 1, 2]])
    message = "the mesh has no extent: all its vertices lie at [1.0, 2.0, 3.0]"
    assert bad("run", "dgx2", path) == f"{path}: {message}"


@pytest.mark.parametrize("index", [999, -1])
def test_a_mesh_with_faces_that_point_outside(bad, mesh_file, index):
    path = mesh_file("outside.ply", [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 1, index]])
    message = bad("run", "dgx2", path)
    assert re.fullmatch(
        rf"{re.escape(str(path))}: 1 faces? points? outside the 3 vertices; the first is face 1: \[0, 1, {index}\]",
        message,
    )


def test_a_text_mesh_that_was_cut(bad, mesh_file):
    path = mesh_file("cut.ply")
    lines = path.read_text().splitlines(keepends=True)
    header = next(i for i, line in enumerate(lines) if line == "end_header\n") + 1
    path.write_text("".join(lines[: header + TRUNCATED]))
    assert bad("run", "dgx2", path) == f"{path}: the file is cut short: it announces 169 of element vertex and has 100"
    path.write_text("".join(lines[: header + 169 + TRUNCATED]))
    assert bad("run", "dgx2", path) == f"{path}: the file is cut short: it announces 288 of element face and has 100"
    path.write_text("".join(lines[: header - 1]))
    assert bad("run", "dgx2", path).startswith(f"{path}: cannot read this mesh, which is damaged or cut short: ")


@pytest.mark.parametrize("ending", ["ply", "glb", "stl"])
def test_a_binary_mesh_that_was_cut(bad, mesh_file, tmp_path, ending):
    import trimesh

    path = tmp_path / f"cut.{ending}"
    whole = trimesh.load(mesh_file("whole.ply"), process=False).export(file_type=ending)
    path.write_bytes(whole[: len(whole) // 2])
    assert re.match(
        rf"{re.escape(str(path))}: (cannot read this mesh, which is damaged or cut short: |nothing could be read: )",
        bad("run", "dgx2", path),
    )


@pytest.mark.parametrize("ending", ["ply", "obj", "glb", "stl"])
def test_a_mesh_that_is_something_else(bad, tmp_path, ending):
    path = tmp_path / f"noise.{ending}"
    path.write_bytes(bytes(range(256)) * 4)
    assert re.match(
        rf"{re.escape(str(path))}: (cannot read this mesh, which is damaged or cut short: |nothing could be read: )",
        bad("run", "dgx2", path),
    )


# --set


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("machine.gpus", "--set machine.gpus: expected PATH=VALUE, for instance machine.nvlink.bandwidth='300 GB/s'"),
        ("node.gpus=2", "--set node.gpus=2: a path starts with machine. or workload. or policy., got 'node.gpus'"),
        (
            "machine.nvlink.bandwith=300 GB/s",
            "--set machine.nvlink.bandwith: machine.nvlink has no field 'bandwith'; did you mean 'bandwidth'? "
            "(it has: bandwidth, duplex, latency, kernel_share, pairs)",
        ),
        (
            "machine.nvlink.bandwidth=3 us",
            "--set machine.nvlink.bandwidth: expected a bandwidth such as '12.5 GB/s', got a time: '3 us'",
        ),
        (
            "machine.gpu.incoherent_rate=-1 Mray/s",
            "--set machine.gpu.incoherent_rate: must be more than 0, got '-1 Mray/s'",
        ),
        (
            "machine.gpu.incoherent_rate=nan Mray/s",
            "--set machine.gpu.incoherent_rate: expected a ray rate such as '230 Mray/s', "
            "got nan, which is not a finite number",
        ),
        (
            "workload.camera.position.3=1",
            "--set workload.camera.position.3: workload.camera.position is a list of 3, whose parts are 0 to 2",
        ),
        (
            "policy.copy=implict",
            "--set policy.copy: expected 'explicit' or 'implicit', got 'implict'; did you mean 'implicit'?",
        ),
        ("policy.slots=1", "--set policy.slots: should be greater than or equal to 2, got 1"),
        ("policy.merging=perhaps", "--set policy.merging: expected true or false, got 'perhaps'"),
    ],
)
def test_a_bad_set(bad, tiny_card, assignment, message):
    assert bad("run", "dgx2", tiny_card, "--set", assignment) == message


def test_a_set_of_another_machines_links(bad, tiny_card):
    message = bad("run", "dgx2", tiny_card, "--set", "machine.pcie.bandwidth=3 GB/s")
    assert message.startswith("--set machine.pcie.bandwidth: ")
    assert message.endswith("dgx2/card.yaml has no machine.pcie; did you mean machine.nvlink.bandwidth, "
                            "machine.storage.local.bandwidth?")  # fmt: skip


def test_a_set_of_no_parameter_of_the_policy(bad, tiny_card):
    message = bad("run", "dgx2", tiny_card, "--set", "policy.mergin=false")
    assert message.startswith("--set policy.mergin: policy has no field 'mergin'; did you mean 'merging'? (it has: ")


def test_a_trace_has_no_machine(bad, tiny_card):
    assert bad("trace", tiny_card, "--set", "machine.gpus=3") == (
        "--set machine.gpus=3: a path starts with workload., got 'machine.gpus'"
    )


# Counts


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--gpus", 0, "--gpus 0: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("--gpus", -1, "--gpus -1: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("--gpus", 17, "--gpus 17: NVIDIA DGX-2 (16 V100 32 GB, NVSwitch) has 1 to 16 GPUs to use"),
        ("--gpus", 2.5, "--gpus 2.5: expected a whole number"),
        ("--gpus", "two", "--gpus two: expected a whole number"),
        ("--islands", 0, "--islands 0: 16 GPUs make 1 to 16 islands, or auto"),
        ("--islands", -2, "--islands -2: 16 GPUs make 1 to 16 islands, or auto"),
        ("--islands", 17, "--islands 17: 16 GPUs make 1 to 16 islands, or auto"),
        ("--islands", "many", "--islands many: expected a number of islands, or auto"),
        ("--islands", 2.0, "--islands 2.0: expected a number of islands, or auto"),
        ("--seed", -1, "--seed -1: expected a number from 0 to 2^64 - 1"),
        ("--seed", 1.5, "--seed 1.5: expected a whole number"),
        ("--seed", 10**30, f"--seed {10**30}: expected a whole number of up to 20 digits"),
    ],
)
def test_a_bad_count(bad, tiny_card, option, value, message):
    assert bad("run", "dgx2", tiny_card, option, value) == message


def test_more_islands_than_gpus_that_are_used(bad, tiny_card):
    message = "--islands 3: 2 GPUs make 1 to 2 islands, or auto"
    assert bad("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 3) == message


def test_islands_of_a_policy_that_has_none(bad, tiny_card):
    message = bad("run", "dgx2", tiny_card, "--policy", "image_parallel", "--islands", 3)
    assert message.startswith("--islands 3: image_parallel holds the whole model on every GPU")


def test_the_seed_of_a_trace_is_checked_too(bad, tiny_card):
    assert bad("trace", tiny_card, "--seed", -1) == "--seed -1: expected a number from 0 to 2^64 - 1"


# Where results are to go, said before the work starts


@pytest.mark.parametrize("option", ["--json", "--image", "--timeline"])
def test_a_folder_that_is_not_there(bad, tiny_card, tmp_path, option):
    target = tmp_path / "nowhere" / ("x.png" if option == "--image" else "x.json")
    assert bad("run", "dgx2", tiny_card, option, target) == f"{option} {target}: there is no folder {target.parent}"
    assert not target.parent.exists()


@pytest.mark.parametrize(
    ("option", "name", "endings"),
    [("--json", "x.txt", ".json"), ("--image", "x.jpg", ".png"), ("--timeline", "x.gif", ".json or .png")],
)
def test_a_file_of_another_kind(bad, tiny_card, tmp_path, option, name, endings):
    target = tmp_path / name
    message = f"{option} {target}: expected a file that ends in {endings}"
    assert bad("run", "dgx2", tiny_card, option, target) == message


def test_a_folder_instead_of_a_file(bad, tiny_card, tmp_path):
    (tmp_path / "x.json").mkdir()
    message = f"--json {tmp_path / 'x.json'}: this is a folder, expected a file"
    assert bad("run", "dgx2", tiny_card, "--json", tmp_path / "x.json") == message


def test_one_file_for_two_results(bad, tiny_card, tmp_path):
    target = tmp_path / "x.png"
    message = "--json, --image and --timeline: two of them name the same file"
    assert bad("run", "dgx2", tiny_card, "--image", target, "--timeline", target) == message


def test_json_without_a_file(bad, tiny_card):
    assert bad("run", "dgx2", tiny_card, "--gpus", 1, "--json").endswith("parameter --json requires an argument.")
    assert not os.path.lexists("--gpus")


def test_a_file_name_that_the_system_refuses(bad, tiny_card, tmp_path):
    target = tmp_path / ("x" * 300 + ".json")
    assert bad("run", "dgx2", tiny_card, "--json", target).endswith(": File name too long")


def test_the_image_of_a_trace_is_checked_too(bad, tiny_card, tmp_path):
    target = tmp_path / "nowhere" / "x.png"
    message = f"--image {target}: there is no folder {target.parent}"
    assert bad("trace", tiny_card, "--image", target) == message


def test_a_workload_too_large_for_this_computer(run_cli, tiny_card, monkeypatch):
    def exhausted(*_, **__):
        raise MemoryError("Unable to allocate 74.5 GiB")

    monkeypatch.setattr("simrender.rays.shading.camera_rays", exhausted)
    ran = run_cli("run", "dgx2", tiny_card, "--seed", 77)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (
        "simrender: out of memory: Unable to allocate 74.5 GiB; a smaller workload.traced.resolution needs less\n"
    )


# The program itself


def test_the_installed_program_prints_no_traceback():
    command = [sys.executable, "-m", "simrender.cli", "run", "dgx3", "xyzzy"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (2, "")
    assert ran.stderr.startswith("simrender: unknown machine 'dgx3'; did you mean 'dgx2'?")
    assert len(ran.stderr.splitlines()) == 1


# What only the work finds out


def test_a_policy_on_a_card_is_checked_where_it_stands(bad, tiny_card):
    card = tiny_card.read_text()
    tiny_card.write_text(card + "policy: {name: ray_queue_cycling, slots: one, copie: explicit}\n")
    line = card.count("\n") + 1
    assert bad("run", "dgx2", tiny_card).splitlines() == [
        f"{tiny_card}:{line}:42: policy.slots: expected a whole number, got 'one'",
        f"{tiny_card}:{line}:47: policy.copie: unknown field; did you mean 'copy'? "
        "(known: copy, merging, slots, ray_bytes, partition, split_share)",
    ]
    tiny_card.write_text(card + "policy: {name: 3}\n")
    message = "policy: a policy has a name, for instance {name: ray_queue_cycling}"
    assert bad("run", "dgx2", tiny_card) == f"{tiny_card}:{line}:9: {message}"


def test_a_generator_that_fails_says_how(bad, tiny_card):
    scene = "generator: 'fractions:Fraction', arguments: {numerator: x}"
    tiny_card.write_text(tiny_card.read_text().replace("file: bumpy.ply", scene))
    assert "fractions:Fraction failed: ValueError: Invalid literal for Fraction: 'x'" in bad("run", "dgx2", tiny_card)


def test_machine_and_workload_in_the_wrong_order(bad):
    assert "'island' is a workload; the machine comes first, then the workload" in bad("run", "island", "dgx2")


def test_a_gpu_without_any_memory_left(bad, tiny_card):
    message = bad("run", "dgx2", tiny_card, "--set", "machine.gpu.memory=0.5 GiB")
    assert message.endswith("gpu: reserved_memory (1 GiB) leaves nothing of memory (0.5 GiB)")


def test_more_traced_pixels_than_published_ones(bad, tiny_card):
    message = bad("run", "dgx2", tiny_card, "--set", "workload.traced.resolution=640x360")
    assert message.endswith("traced.resolution 640x360 is larger than published.resolution 64x36")
