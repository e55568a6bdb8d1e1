"""The command line: what a person gets for bad input, and what the files and the exit codes of good input are."""

import io
import itertools
import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from simrender.report.files import write

TRUNCATED = 100
"""Lines of the bumpy square's PLY file that are left when it is cut."""


@pytest.fixture
def bad(run_cli, tmp_path):
    """Run a bad command line; return its one message, after checking that it is one, on stderr alone."""
    traces = tmp_path / "traces"

    def run(*arguments):
        command = arguments if arguments[:1] not in {("run",), ("trace",)} else (*arguments, "--cache", traces)
        ran = run_cli(*command)
        assert ran.code == 2, ran
        assert ran.out == ""
        assert ran.err.startswith("simrender: ")
        assert ran.err.endswith("\n")
        assert "Traceback" not in ran.err
        assert "note:" not in ran.err
        assert not traces.exists(), "rays were traced before the mistake was found"
        return ran.err.removeprefix("simrender: ").removesuffix("\n")

    return run


# Names


def test_unknown_names_say_what_is_near(bad, tiny_card):
    machines = "desktop-rtx8000, dgx2, hgx-a100, rtx-server-a40"
    assert bad("run", "dgx3", tiny_card) == f"unknown machine 'dgx3'; did you mean 'dgx2'? (known: {machines})"
    assert bad("run", "dgx2", "xyzzy").startswith("unknown workload 'xyzzy' (known: ")
    message = bad("run", "dgx2", tiny_card, "--policy", "ray_que_cycling")
    assert message.startswith("unknown policy 'ray_que_cycling'; did you mean 'ray_queue_cycling'? (known: ")
    assert bad("show", "dgx").startswith("unknown machine, workload or policy 'dgx'; did you mean 'dgx2'? (known: ")
    assert bad("show", "no.yaml").startswith("unknown machine, workload or policy 'no.yaml' (known: ")


def test_unknown_words_of_the_command_line(bad, tiny_card):
    assert bad("rnu") == 'Unknown command "rnu". Did you mean "run"? Available commands: list, show, trace, run.'
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
    assert message.endswith("ends in .yaml or .yml; a mesh ends in .ply, .obj, .glb, .gltf or .stl")
    tiny_card.write_text(tiny_card.read_text().replace("bumpy.ply", "scene.abc"))
    assert bad("run", "dgx2", tiny_card) == (
        f"{tmp_path / 'scene.abc'}: unknown mesh format '.abc' (known: .ply, .obj, .glb, .gltf, .stl)"
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
            "(it has: bandwidth, duplex, latency, kernel_share, distant)",
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
    assert message.endswith("dgx2/card.yaml has no machine.pcie; did you mean machine.nvlink.bandwidth?")


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
        ("--seed", 10**30, f"--seed {10**30}: expected a whole number of up to 18 digits"),
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
    def exhausted(*_):
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


# Results


def results(ran):
    """The JSON on stdout: nothing else may be there."""
    assert ran.code in {0, 3}, ran
    return json.loads(ran.out)


def test_json_to_stdout_is_json_and_nothing_else(run_cli, tiny_card):
    ran = run_cli("run", "dgx2", tiny_card, "--json", "-", "--gpus", 2)
    result = results(ran)
    assert ran.code == 0
    assert (result["machine"], result["workload"], result["gpus"]) == ("dgx2", "tiny", 2)
    assert result["frames_per_s"] == pytest.approx(1 / result["frame_time_s"])
    assert result["feasible"] is True
    assert result["seed"] == 1
    assert len(result["image_sha256"]) == len(result["event_log_sha256"]) == 64
    assert re.fullmatch(r"simulated in [0-9.]+ s\n", ran.err)


def test_json_has_no_constants_that_json_lacks(run_cli, tiny_card):
    def refuse(constant):
        raise AssertionError(constant)

    json.loads(run_cli("run", "dgx2", tiny_card, "--json=-").out, parse_constant=refuse)


def test_json_to_a_file_is_the_same_json(run_cli, tiny_card, tmp_path):
    target = tmp_path / "x.json"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--json", target)
    assert f"wrote {target}\n" in ran.err
    assert "frames/s" in ran.out
    assert json.loads(target.read_text()) == results(run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--json", "-"))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bumpy.ply", "tiny.yaml", "x.json"]


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path):
    target = tmp_path / "x.json"
    target.write_text("old")

    def fail(file):
        file.write(b"half of the ne")
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space left"):
        write(target, fail)
    assert target.read_text() == "old"
    write(target, lambda file: file.write(b"new"))
    assert target.read_text() == "new"
    assert [p.name for p in tmp_path.iterdir()] == ["x.json"]


def test_a_full_disk_is_one_message(run_cli, tiny_card, tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device", str(tmp_path / "x.json"))

    monkeypatch.setattr("simrender.report.files.write_json", full)
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 1, "--json", tmp_path / "x.json")
    assert ran.code == 2
    assert ran.err == f"simrender: {tmp_path / 'x.json'}: No space left on device\n"


TIGHT = "machine.gpu.memory=1075 MB"
"""1 GiB is reserved, which leaves 1.26 MB: too little for one GPU, enough for each of two."""


def test_a_run_that_does_not_fit_exits_with_3_and_says_what_would_do(run_cli, tiny_card, tmp_path):
    image = tmp_path / "x.png"
    command = ("run", "dgx2", tiny_card, "--gpus", 1, "--set", TIGHT)
    ran = run_cli(*command, "--json", "-", "--image", image)
    assert ran.code == 3
    result = results(ran)
    assert result["feasible"] is False
    assert result["frame_time_s"] is None
    assert result["frames_per_s"] is None
    assert result["event_log_sha256"] is None
    assert result["memory"]["gpus_needed"] == 2
    assert result["memory"]["needed_bytes"] > result["memory"]["capacity_bytes"] == pytest.approx(1_258_176.0)
    assert not image.exists()
    ran = run_cli(*command)
    assert ran.code == 3
    assert "tiny does not fit on dgx2 under ray_queue_cycling" in ran.out
    assert re.search(r"the fullest GPU would need 1\.3\d MB and has 1\.26 MB\.", ran.out)
    assert "2 such GPUs would do." in ran.out


def test_the_gpus_that_are_needed_are_enough(run_cli, tiny_card):
    result = results(run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 1, "--set", TIGHT, "--json", "-"))
    assert result["feasible"] is True


def test_the_timeline_is_a_chrome_trace_without_overlaps(run_cli, tiny_card, tmp_path):
    target = tmp_path / "t.json"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--timeline", target)
    assert ran.code == 0
    trace = json.loads(target.read_text())
    events = [event for event in trace["traceEvents"] if event["ph"] == "X"]
    names = {event["args"]["name"] for event in trace["traceEvents"] if event["name"] == "process_name"}
    assert names == {"gpu0", "gpu1", "gpu2", "gpu3"}
    assert {event["cat"] for event in events} == {"kernel", "copy"}
    assert {event["ph"] for event in trace["traceEvents"]} == {"X", "M"}
    tracks = {}
    for event in events:
        assert event["dur"] >= 0
        tracks.setdefault((event["pid"], event["tid"]), []).append((event["ts"], event["ts"] + event["dur"]))
    assert set(tracks) == set(itertools.product(range(4), (1, 2)))
    for spans in tracks.values():
        assert all(end <= begin + 1e-6 for (_, end), (begin, _) in itertools.pairwise(sorted(spans)))  # a picosecond
    end = max(end for spans in tracks.values() for _, end in spans)
    frame = results(run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--json", "-"))
    assert end == pytest.approx(frame["frame_time_s"] * 1e6, rel=1e-9)
    assert len(events) == frame["counts"]["spans"]


def test_the_timeline_and_the_image_are_pictures(run_cli, tiny_card, tmp_path):
    timeline, image = tmp_path / "t.png", tmp_path / "i.png"
    ran = run_cli("run", "dgx2", tiny_card, "--gpus", 4, "--islands", 2, "--timeline", timeline, "--image", image)
    assert ran.code == 0
    assert ran.err.splitlines()[:2] == [f"wrote {image} (64x36)", f"wrote {timeline}"]
    with Image.open(timeline) as picture:
        assert picture.format == "PNG"
        assert 800 <= picture.width <= 4000
        assert 200 <= picture.height <= 4000
        assert len(picture.convert("RGB").getcolors(1 << 24)) > 20
    with Image.open(image) as picture:
        assert (picture.format, picture.size, picture.mode) == ("PNG", (64, 36), "RGB")
        assert len(picture.getcolors(1 << 24)) > 100


def test_a_real_mesh_file_is_a_workload(run_cli, ply, tmp_path):
    small = ("--set", "workload.traced.resolution=32x18", "--set", "workload.published.samples=1")
    result = results(run_cli("run", "rtx-server-a40", ply, *small, "--json", "-"))
    assert result["workload"] == "airplane"
    assert result["counts"]["traced_camera_rays"] == 32 * 18
    assert result["counts"]["ray_weight"] == 3600.0


# The trace cache


def traced(run_cli, tiny_card, folder, *more):
    return run_cli("run", "dgx2", tiny_card, "--gpus", 2, "--islands", 1, "--cache", folder, "--json", "-", *more)


@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied", "replaced"])
def test_a_damaged_cache_file_is_discarded_and_computed_again(run_cli, tiny_card, tmp_path, damage):
    folder = tmp_path / "traces"
    whole = traced(run_cli, tiny_card, folder)
    path = next(folder.rglob("001-hits.npz"))
    content = path.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0xFF
    path.write_bytes(
        {"cut": content[: len(content) // 2], "flipped": flipped, "emptied": b"", "replaced": b"?"}[damage]
    )
    again = traced(run_cli, tiny_card, folder)
    assert again.code == 0
    assert again.out == whole.out
    notes = [line for line in again.err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert notes[0].startswith(f"note: the cache file {path} is damaged")
    assert "it is discarded and computed again" in notes[0]
    healed = traced(run_cli, tiny_card, folder)
    assert healed.out == whole.out
    assert "note:" not in healed.err


def test_a_wholly_damaged_cache_costs_one_note(run_cli, tiny_card, tmp_path):
    folder = tmp_path / "traces"
    whole = traced(run_cli, tiny_card, folder)
    files = [path for path in folder.rglob("*") if path.is_file()]
    assert files
    for path in files:
        path.write_bytes(b"not an archive")
    again = traced(run_cli, tiny_card, folder)
    assert again.out == whole.out
    assert again.err.count("note: ") == 1


def test_a_cache_of_another_run_changes_nothing(run_cli, tiny_card, tmp_path):
    folder = tmp_path / "traces"
    one, other = traced(run_cli, tiny_card, folder), traced(run_cli, tiny_card, folder, "--seed", 2)
    assert one.out != other.out
    assert traced(run_cli, tiny_card, folder).out == one.out


def test_a_cache_that_cannot_be_written_costs_a_note(run_cli, tiny_card, tmp_path):
    whole = traced(run_cli, tiny_card, tmp_path / "traces")
    (tmp_path / "file").write_text("")
    ran = traced(run_cli, tiny_card, tmp_path / "file")
    assert (ran.code, ran.out) == (0, whole.out)
    notes = [line for line in ran.err.splitlines() if line.startswith("note: ")]
    assert len(notes) == 1
    assert notes[0].startswith(f"note: cannot write the trace cache in {tmp_path / 'file'}")


def test_the_users_own_cache_is_not_touched_by_tests(trace_cache):
    assert os.environ["SIMRENDER_CACHE"] == str(trace_cache)


# list, show, trace


def test_list(run_cli):
    ran = run_cli("list")
    assert (ran.code, ran.err) == (0, "")
    assert [line for line in ran.out.splitlines() if line in {"machines", "workloads", "policies"}] == [
        "machines", "workloads", "policies",
    ]  # fmt: skip
    assert re.search(r"^dgx2 +NVIDIA DGX-2 \(16 V100 32 GB, NVSwitch\)", ran.out, re.M)
    assert re.search(r"^ray_queue_cycling +Ray queue cycling, ", ran.out, re.M)
    assert "machines" not in run_cli("list", "policies").out


def test_show_a_machine_with_the_source_of_every_value(run_cli):
    ran = run_cli("show", "dgx2")
    assert (ran.code, ran.err) == (0, "")
    assert ran.out.startswith("NVIDIA DGX-2 (16 V100 32 GB, NVSwitch)\n")
    assert re.search(r"^gpus +16$", ran.out, re.M)
    assert re.search(r"^gpu\.ray_tracing_cores +false$", ran.out, re.M)
    assert re.search(r"^gpu\.rate_primitives +1e9  assumed$", ran.out, re.M)
    assert re.search(r"^gpu\.memory_bandwidth +802 GB/s \(778 GB/s to 895 GB/s\)  measured$", ran.out, re.M)
    assert "RQC table 1: 16 x 32 GB" in ran.out


def test_show_a_card_by_its_path(run_cli, tiny_card):
    ran = run_cli("show", tiny_card)
    assert ran.code == 0
    assert ran.out.startswith("A bumpy square\n")
    assert re.search(r"^published\.resolution +64x36$", ran.out, re.M)


@pytest.mark.parametrize("text", ["{}", "title: A [/b] c\ngpu: {value: 1, range: 5, source: 3, status: 2}\n"])
def test_show_an_odd_card(run_cli, tiny_card, text):
    tiny_card.write_text(text)
    assert run_cli("show", tiny_card).code == 0


def test_show_a_policy_with_its_parameters(run_cli):
    ran = run_cli("show", "ray_queue_cycling")
    assert ran.code == 0
    assert ran.out.startswith("ray_queue_cycling\n")
    assert 'copy : "explicit" or "implicit"' in ran.out


def test_trace(run_cli, tiny_card, tmp_path):
    image = tmp_path / "x.png"
    first = run_cli("trace", tiny_card, "--cache", tmp_path / "traces", "--image", image)
    assert first.code == 0
    assert first.out.startswith("tiny: 64x36, 2 paths a pixel")
    assert re.search(r"^camera +4,608 ", first.out, re.M)
    assert "by embreex alone" in first.out
    assert f"wrote {image} (64x36)\n" in first.err
    second = run_cli("trace", tiny_card, "--cache", tmp_path / "traces")
    assert "came from the cache" in second.out
    rays = re.compile(r"^all +([\d,]+) ", re.M)
    assert rays.search(first.out)[1] == rays.search(second.out)[1]


def test_the_picture_of_a_trace_is_that_of_any_run(run_cli, tiny_card, tmp_path):
    pictures = [tmp_path / f"{i}.png" for i in range(3)]
    run_cli("trace", tiny_card, "--image", pictures[0])
    run_cli("run", "dgx2", tiny_card, "--gpus", 3, "--islands", 1, "--image", pictures[1])
    run_cli("run", "hgx-a100", tiny_card, "--policy", "image_parallel", "--image", pictures[2])
    assert len({io.BytesIO(p.read_bytes()).getvalue() for p in pictures}) == 1


def test_version_and_help(run_cli):
    assert re.fullmatch(r"\d+\.\d+\.\d+\n", run_cli("--version").out)
    for command in ((), ("--help",), ("run", "--help")):
        ran = run_cli(*command)
        assert (ran.code, ran.err) == (0, "")
        assert "Usage: simrender" in ran.out


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
