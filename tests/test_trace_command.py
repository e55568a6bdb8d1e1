"""``simrender trace``: the counts of a real renderer, every option, and what a person gets for bad input."""

from __future__ import annotations

import functools
import importlib.util
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simrender.rays.workload import load_workload
from tests.conftest import Ran, ply_text

DATA = Path(__file__).parent / "data"
WAVELETS = DATA / "wavelets64.spray"
Run = Callable[..., Ran]
Found = Callable[..., dict[str, Any]]
Told = Callable[..., str]
Writes = Callable[..., Path]
METHODS = ("given", "kd_bricks", "sah", "grid", "balanced", "objects")


@pytest.fixture
def trace(run_cli: Run) -> Found:
    """Trace something that is all right; return the JSON, after checking that stdout holds nothing else."""

    def run(*arguments: object) -> dict[str, Any]:
        ran = run_cli("trace", *arguments, "--json", "-")
        assert ran.code == 0, ran
        assert "Traceback" not in ran.err
        return json.loads(ran.out)

    return run


@pytest.fixture
def bad(bad: Told) -> Told:
    """Trace something with a mistake, as any bad command line."""
    return functools.partial(bad, "trace")


def example(name: str) -> Path:
    """A file that the pyvista wheel ships."""
    spec = importlib.util.find_spec("pyvista")
    assert spec is not None
    assert spec.submodule_search_locations
    return Path(spec.submodule_search_locations[0]) / "examples" / name


@pytest.fixture
def npy(tmp_path: Path) -> Path:
    """A ball of fog in 25 x 21 x 17 voxels."""
    z, y, x = np.mgrid[0:17, 0:21, 0:25]
    np.save(tmp_path / "fog.npy", np.exp(-((x - 12) ** 2 + (y - 10) ** 2 + (z - 8) ** 2) / 60.0).astype(np.float32))
    return tmp_path / "fog.npy"


SMALL = ("--resolution", "32x18")
MARCH, TRACK = "workload.integrator.name=volume_marching", "workload.integrator.name=volume_path_tracing"


# The real program

RADIANCE = {"rel": 0.002}


def test_the_wavelets_are_traced_as_the_real_program_traces_them(trace: Found) -> None:
    """SpRay itself (github.com/TACC/SpRay at 9638074): 512x512, one sample, one bounce, one point light.

    It counts 262,144 camera rays of which 71,464 hit, 362,460 pairs of a camera ray and a domain, and 70,512 shadow
    rays of which 23,464 are occluded.
    """
    found = trace(WAVELETS, "--resolution", "512x512")
    assert found["camera_hits"] == pytest.approx(71_464, abs=5)
    assert found["camera_crossings"] == pytest.approx(362_460, abs=5)
    assert found["rays_by_kind"]["camera"] == 262_144
    assert found["rays_by_kind"]["shadow"] == pytest.approx(70_512, **RADIANCE)
    assert found["occluded_shadow_rays"] == pytest.approx(23_464, **RADIANCE)
    assert found["rays_by_kind"] == {
        "camera": 262_144, "diffuse": 0, "mirror": 0, "shadow": found["rays_by_kind"]["shadow"], "scatter": 0,
    }  # fmt: skip
    assert found["rays"] == sum(found["rays_by_kind"].values())
    assert found["generations"] == 2
    assert len(found["domains"]) == 64
    assert sum(d["camera_crossings"] for d in found["domains"]) == found["camera_crossings"]
    assert sum(d["nearest_hits"] for d in found["domains"]) == sum(found["hits_by_kind"].values())
    assert {d["published_primitives"] for d in found["domains"]} == {5480.0}


def test_the_wavelets_look_as_the_real_program_paints_them() -> None:
    rays = load_workload(str(WAVELETS)).trace()
    rays.complete()
    assert rays.image().mean() == pytest.approx(0.0801538, rel=0.005)  # the mean of the real program's image


def test_half_the_resolution_is_a_quarter_of_the_counts(trace: Found) -> None:
    found = trace(WAVELETS, "--resolution", "256x256")
    assert found["camera_hits"] == pytest.approx(71_464 / 4, rel=0.01)
    assert found["camera_crossings"] == pytest.approx(362_460 / 4, rel=0.01)
    assert found["ray_weight"] == 1.0  # a bare file publishes no other size


# What is traced


def test_the_resolution_of_a_card_changes_the_weight(trace: Found, tiny_card: Path) -> None:
    whole, part = trace(tiny_card), trace(tiny_card, *SMALL)
    assert (whole["resolution"], whole["ray_weight"]) == ([64, 36], 1.0)
    assert (part["resolution"], part["ray_weight"]) == ([32, 18], 4.0)
    assert part["rays_by_kind"]["camera"] == 32 * 18 * 2
    assert part["camera_hits"] * 4 == pytest.approx(whole["camera_hits"], rel=0.05)
    samples = trace(tiny_card, *SMALL, "--set", "workload.traced.samples=1")
    assert (samples["samples"], samples["ray_weight"]) == (1, 8.0)


def test_a_bare_mesh_is_traced_and_published_at_the_resolution(trace: Found, mesh_file: Writes) -> None:
    found = trace(mesh_file("square.ply"), *SMALL)
    assert (found["resolution"], found["ray_weight"], found["samples"]) == ([32, 18], 1.0, 8)
    assert len(found["domains"]) == 8
    assert sum(d["published_primitives"] for d in found["domains"]) == pytest.approx(288.0)
    assert trace(mesh_file("square.ply"), "--set", "workload.traced.resolution=32x18")["ray_weight"] == 3600.0


def test_a_mesh_with_instances(trace: Found, tmp_path: Path) -> None:
    import trimesh

    scene = trimesh.Scene()
    box = trimesh.creation.icosphere(subdivisions=1)
    for k in range(5):
        place = np.eye(4)
        place[:3, 3] = 3.0 * k, 0.5 * k * k, 0.0
        scene.add_geometry(box, transform=place, geom_name="ball", node_name=f"ball{k}")
    (tmp_path / "balls.glb").write_bytes(scene.export(file_type="glb"))
    found = trace(tmp_path / "balls.glb", *SMALL, "--partition", "sah", "--domains", 5)
    assert [d["published_primitives"] for d in found["domains"]] == [80.0] * 5  # an instance each
    assert all(d["nearest_hits"] > 0 for d in found["domains"])
    assert found["camera_hits"] > 100


def test_the_seed_changes_the_rays_and_nothing_else(trace: Found, tiny_card: Path) -> None:
    one, other = trace(tiny_card), trace(tiny_card, "--seed", 2)
    assert one == trace(tiny_card, "--seed", 1)
    assert one["camera_hits"] != other["camera_hits"]
    assert one["camera_hits"] == pytest.approx(other["camera_hits"], rel=0.05)
    assert (one["domains"][0]["published_bytes"], other["seed"]) == (other["domains"][0]["published_bytes"], 2)


VOLUMES = ["fog.npy", "fog.nrrd", "uniform.vtk"]


@pytest.fixture
def volume(request: pytest.FixtureRequest, npy: Path) -> Path:
    if request.param == "fog.npy":
        return npy
    if request.param == "fog.nrrd":
        voxels = np.load(npy)
        header = (
            "NRRD0004\ntype: float\ndimension: 3\nsizes: 25 21 17\nendian: little\nencoding: raw\nspacings: 1 1 1\n\n"
        )
        npy.with_suffix(".nrrd").write_bytes(header.encode() + voxels.astype("<f4").tobytes())
        return npy.with_suffix(".nrrd")
    return example(request.param)


@pytest.mark.parametrize("volume", VOLUMES, indirect=True)
@pytest.mark.parametrize("integrator", [MARCH, TRACK])
def test_bare_volumes_are_marched_or_tracked(trace: Found, volume: Path, integrator: str) -> None:
    found = trace(volume, *SMALL, "--set", integrator)
    assert found["camera_hits"] > 30
    assert found["work"] > found["camera_hits"]
    assert found["work_unit"] == ("samples" if integrator == MARCH else "look-ups")
    assert (found["rays_by_kind"]["scatter"] > 0) == (integrator == TRACK)
    assert len(found["domains"]) == 8
    assert all("nearest_hits" not in d for d in found["domains"])


def test_the_same_voxels_in_other_files_are_the_same_rays(trace: Found, npy: Path) -> None:
    header = "NRRD0005\ntype: float\ndimension: 3\nsizes: 25 21 17\nendian: little\nencoding: raw\n\n"
    npy.with_suffix(".nrrd").write_bytes(header.encode() + np.load(npy).astype("<f4").tobytes())
    one, other = trace(npy, *SMALL), trace(npy.with_suffix(".nrrd"), *SMALL)
    assert one == other


def test_a_bare_mesh_of_elements_comes_in_its_parts(trace: Found) -> None:
    found = trace(example("hexbeam.vtk"), *SMALL)
    assert found["work_unit"] == "elements"
    assert found["work"] >= found["camera_hits"] > 30
    assert [d["published_primitives"] for d in found["domains"]] == [40.0]
    assert trace(example("hexbeam.vtk"), *SMALL, "--partition", "given") == found


def test_frames_move_the_camera_along_its_path(trace: Found, tiny_card: Path) -> None:
    still = [trace(tiny_card, "--frame", f"{k}/3") for k in range(3)]
    assert still == [trace(tiny_card)] * 3
    path = "[{position: [2, -2, 1.5], look_at: [0, 0, 0]}, {position: [2, 2, 3], look_at: [0.1, 0, 0]}]"
    tiny_card.write_text(tiny_card.read_text().replace("look_at: [0, 0, 0]}", f"look_at: [0, 0, 0], path: {path}}}"))
    frames = [trace(tiny_card, "--frame", f"{k}/3") for k in range(3)]
    assert len({f["camera_hits"] for f in frames}) == 3
    assert trace(tiny_card, "--frame", "0/8") == frames[0] == trace(tiny_card)
    assert trace(tiny_card, "--frame", "7/8") == frames[2]


# Domains


@pytest.mark.parametrize(
    ("options", "count"),
    [
        ([], 8),
        (["--domains", 5], 5),
        (["--domains", "3x2x1"], 6),
        (["--domains", "4x1x2", "--partition", "balanced"], 8),
        (["--domains", "4x1x2", "--partition", "grid"], 8),
        (["--domains", 7, "--partition", "sah"], 7),
        (["--domains", 4, "--partition", "objects"], 4),
        (["--partition", "given"], 1),
        (["--domains", 1], 1),
    ],
)
def test_a_mesh_is_cut_as_asked(trace: Found, tiny_card: Path, options: list[object], count: int) -> None:
    found, whole = trace(tiny_card, *options), trace(tiny_card)
    assert [d["domain"] for d in found["domains"]] == list(range(count))
    assert sum(d["published_primitives"] for d in found["domains"]) == pytest.approx(288.0)
    assert sum(d["nearest_hits"] for d in found["domains"]) == sum(found["hits_by_kind"].values())
    # How the scene is cut changes no ray.
    for name in ("rays_by_kind", "hits_by_kind", "rays", "generations"):
        assert found[name] == whole[name]


@pytest.mark.parametrize(
    ("options", "count"), [([], 8), (["--domains", 3], 3), (["--partition", "kd_bricks", "--domains", 18], 18)]
)
def test_a_volume_is_cut_into_bricks(trace: Found, npy: Path, options: list[object], count: int) -> None:
    found = trace(npy, *SMALL, *options)
    assert len(found["domains"]) == count
    assert sum(d["published_primitives"] for d in found["domains"]) == pytest.approx(24 * 20 * 16)
    assert found["work"] == trace(npy, *SMALL)["work"]


def test_a_card_says_how_it_is_cut_unless_the_command_line_does(trace: Found, tiny_card: Path) -> None:
    tiny_card.write_text(tiny_card.read_text() + "domains: {method: sah, count: 6}\n")
    sah = trace(tiny_card)
    assert len(sah["domains"]) == 6
    assert len(trace(tiny_card, "--domains", 3)["domains"]) == 3
    assert trace(tiny_card, "--domains", 6) == sah  # a count alone keeps the card's way
    assert trace(tiny_card, "--domains", 6, "--partition", "objects")["domains"] != sah["domains"]
    assert len(trace(tiny_card, "--domains", "2x2x1")["domains"]) == 4
    assert trace(tiny_card, "--set", "workload.domains.count=4", "--domains", 6) == sah


def test_too_many_parts_are_a_note(run_cli: Run, mesh_file: Writes) -> None:
    ran = run_cli("trace", mesh_file("square.ply"), *SMALL, "--partition", "sah", "--domains", 1000)
    assert ran.code == 0
    assert "note: the surface area heuristic makes " in ran.err
    assert "and not 1000: one more split would leave an empty part" in ran.err
    assert "23 to " in ran.out  # the others are summed up in one row


# What is written


def test_json_to_a_file_is_the_json_on_stdout(run_cli: Run, trace: Found, tiny_card: Path, tmp_path: Path) -> None:
    options = (*SMALL, "--domains", 3, "--replicas", 2)
    ran = run_cli("trace", tiny_card, *options, "--json", tmp_path / "a.json", "--image", tmp_path / "a.png")
    assert ran.err.splitlines()[:2] == [f"wrote {tmp_path / 'a.json'}", f"wrote {tmp_path / 'a.png'} (32x18)"]
    assert ran.err.splitlines()[2].startswith("done in ")
    assert "tiny: 32x18, 2 paths a pixel" in ran.out
    assert json.loads((tmp_path / "a.json").read_text()) == trace(tiny_card, *options)


def test_json_has_no_constants_that_json_lacks(run_cli: Run, tiny_card: Path) -> None:
    def refuse(constant: str) -> None:
        raise AssertionError(constant)

    ran = run_cli("trace", tiny_card, "--resolution", "1x1", "--replicas", 2, "--json", "-")
    assert json.loads(ran.out, parse_constant=refuse)["resolution"] == [1, 1]


def test_a_second_trace_comes_from_the_cache(run_cli: Run, tiny_card: Path, npy: Path, tmp_path: Path) -> None:
    for scene, last in ((tiny_card, "every ray came from the cache; "), (npy, "every ray came from the cache\n")):
        command = ("trace", scene, *SMALL, "--cache", tmp_path / "cache")
        first, second = run_cli(*command), run_cli(*command)
        assert "Mray/s" in first.out
        assert "from the cache" not in first.out
        assert last in second.out
        assert first.out.splitlines()[:6] == second.out.splitlines()[:6]


def test_the_tables_name_what_there_is(run_cli: Run, npy: Path, tiny_card: Path) -> None:
    surface = run_cli("trace", tiny_card).out
    assert "1 object, 1 instance, 288 triangles, 288 with instances" in surface
    assert "nearest hits" in surface
    assert "% occluded" in surface
    assert "scatter" not in surface
    fog = run_cli("trace", npy, *SMALL, "--set", TRACK).out
    assert "25 x 21 x 17 voxels" in fog
    assert "look-ups" in fog
    assert "scatter" in fog
    assert "nearest hits" not in fog
    elements = run_cli("trace", example("hexbeam.vtk"), *SMALL).out
    assert "40 elements in 1 part;" in elements


# Mistakes on the command line


@pytest.mark.parametrize(
    "size", ["64", "64x", "x36", "0x36", "64x0", "64X36", "64x36x2", "6.4x36", "64 x 36", " ", "1e3x2", "٦x٤"]
)
def test_a_wrong_resolution(bad: Told, tiny_card: Path, mesh_file: Writes, size: str) -> None:
    message = f"--resolution {size}: expected WIDTHxHEIGHT in pixels such as 2560x1080"
    assert bad(tiny_card, f"--resolution={size}") == message
    assert bad(mesh_file("square.ply"), f"--resolution={size}") == message


def test_a_resolution_larger_than_published(bad: Told, tiny_card: Path, tmp_path: Path) -> None:
    assert bad(tiny_card, "--resolution", "65x36") == (
        f"{tiny_card}:1:1: traced.resolution 65x36 is larger than published.resolution 64x36"
    )
    for name in (WAVELETS.name, "wavelet.ply"):
        shutil.copy(DATA / name, tmp_path / name)
    assert bad(tmp_path / WAVELETS.name, "--set", "workload.traced.resolution=600x600").endswith(
        ":1:1: traced.resolution 600x600 is larger than published.resolution 512x512"
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--show", "work"], "--show work says what --image shows; give --image FILE.png too"),
        (["--show", "domains", "--ranks", 2], "--show domains says what --image shows; give --image FILE.png too"),
        (["--ranks", 3], "--ranks 3 goes with --show domains"),
        (["--ranks", 3, "--image", "a.png"], "--ranks 3 goes with --show domains"),
        (["--ranks", 3, "--image", "a.png", "--show", "work"], "--ranks 3 goes with --show domains"),
        (["--ranks", "3.0", "--image", "a.png", "--show", "domains"], "--ranks 3.0: expected a whole number"),
        (["--show", "domain", "--image", "a.png"], 'Invalid value "domain" for --show. Choose from: "domains", "work", "error". Did you mean "domains"?'),  # noqa: E501
        (["--replicas", 1], "--replicas 1: expected 2 to 1000"),
        (["--replicas", 0], "--replicas 0: expected 2 to 1000"),
        (["--replicas", 1001], "--replicas 1001: expected 2 to 1000"),
        (["--replicas", "2.5"], "--replicas 2.5: expected a whole number"),
        (["--seed=-1"], "--seed -1: expected a number from 0 to 2^64 - 1"),
        (["--seed", "1e3"], "--seed 1e3: expected a whole number"),
        (["--frame", "3"], "--frame 3: expected NUMBER/COUNT such as 0/8, the first of eight"),
        (["--frame", "0/0"], "--frame 0/0: expected NUMBER/COUNT such as 0/8, the first of eight"),
        (["--frame", "a/8"], "--frame a/8: expected NUMBER/COUNT such as 0/8, the first of eight"),
        (["--frame", "8/8"], "frame 8 of 8: expected 0 to 7"),
        (["--image", "a.jpg"], "--image a.jpg: expected a file that ends in .png"),
        (["--json", "a.txt"], "--json a.txt: expected a file that ends in .json"),
        (["--json", "nowhere/a.json"], "--json nowhere/a.json: there is no folder nowhere"),
        (["--image", "nowhere/a.png"], "--image nowhere/a.png: there is no folder nowhere"),
        (["--json"], 'Command "trace" parameter --json requires an argument.'),
        (["--gpus", 2], "Unknown option: --gpus. Did you mean --ranks?"),
        (["more"], "unexpected argument 'more'"),
        (["--set", "traced.samples=1"], "--set traced.samples=1: a path starts with workload., got 'traced.samples'"),
        (["--set", "machine.gpus=1"], "--set machine.gpus=1: a path starts with workload., got 'machine.gpus'"),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together(bad: Told, tiny_card: Path, options: list[object], message: str) -> None:
    found = bad(tiny_card, *options)
    if message.startswith("Unknown option"):
        assert found.startswith("Unknown option: --gpus.")
    else:
        assert found == message


@pytest.mark.parametrize("ranks", [0, -1])
def test_fewer_than_one_rank(bad: Told, tiny_card: Path, tmp_path: Path, ranks: int) -> None:
    message = bad(tiny_card, "--show", "domains", "--image", tmp_path / "a.png", f"--ranks={ranks}")
    assert message.startswith(f"--ranks {ranks}: expected ")


@pytest.mark.parametrize("domains", ["0", "-3", "4x4", "4x4x0", "2x2x2x2", "4.5", "many", "x", "100000"])
def test_a_wrong_number_of_domains(bad: Told, tiny_card: Path, domains: str) -> None:
    assert bad(tiny_card, f"--domains={domains}") == (
        f"--domains {domains}: expected how many, or the shape of a grid such as 12x10x6"
    )


def test_more_domains_than_can_be_told_apart(bad: Told, tiny_card: Path) -> None:
    assert bad(tiny_card, "--domains", "32768").startswith("--domains 32768: ")
    assert "32767" in bad(tiny_card, "--domains", "32768")


NEEDS = {"given": "", "grid": "shape", "balanced": "shape", "kd_bricks": "count", "sah": "count", "objects": "count"}


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(("domains", "given"), [(None, ""), ("4", "count"), ("2x2x1", "shape")])
def test_partitions_without_what_they_need(
    bad: Told, tiny_card: Path, method: str, domains: str | None, given: str
) -> None:
    if given == NEEDS[method]:
        return
    wrong = next(n for n in ("count", "shape") if (n == given) != (n == NEEDS[method]))
    verb = "needs" if wrong == NEEDS[method] else "takes no"
    options = ["--partition", method] + (["--domains", domains] if domains else [])
    assert bad(tiny_card, *options) == (
        f"{' '.join(options)}: {method} {verb} {wrong} (count and shape are given by --domains)"
    )


def test_a_partition_that_nobody_knows(bad: Told, tiny_card: Path) -> None:
    assert bad(tiny_card, "--partition", "shah", "--domains", 3).startswith(
        'Invalid value "shah" for --partition. Choose from: "given", "kd_bricks", "sah", "grid", "balanced", "objects".'
    )


@pytest.mark.parametrize("method", [m for m in METHODS if m != "kd_bricks"])
def test_a_volume_is_cut_by_kd_bricks_alone(run_cli: Run, npy: Path, method: str) -> None:
    domains = {"": [], "count": ["--domains", 4], "shape": ["--domains", "2x2x1"]}[NEEDS[method]]
    ran = run_cli("trace", npy, *SMALL, "--partition", method, *domains)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == f"simrender: domains.method {method}: a volume is cut by kd_bricks, with a count\n"
    assert run_cli("trace", npy, *SMALL, "--domains", "2x2x1").err == (
        "simrender: domains.method grid: a volume is cut by kd_bricks, with a count\n"
    )


@pytest.mark.parametrize("method", [m for m in METHODS if m != "given"])
def test_elements_come_in_their_own_parts(run_cli: Run, method: str) -> None:
    domains = {"count": ["--domains", 4], "shape": ["--domains", "2x2x1"]}[NEEDS[method]]
    ran = run_cli("trace", example("hexbeam.vtk"), *SMALL, "--partition", method, *domains)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (f"simrender: domains.method {method}: an unstructured mesh comes in its own parts; use given\n")


def test_a_number_of_domains_that_elements_do_not_have(run_cli: Run) -> None:
    ran = run_cli("trace", example("hexbeam.vtk"), *SMALL, "--domains", 4)
    assert ran.code == 2 or "note: " in ran.err


def test_a_mesh_has_no_bricks(run_cli: Run, tiny_card: Path) -> None:
    ran = run_cli("trace", tiny_card, *SMALL, "--partition", "kd_bricks", "--domains", 2)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (
        "simrender: domains.method kd_bricks: the scene has no volume; use sah, grid, balanced or objects\n"
    )


def test_a_scene_that_cannot_be_cut_is_not_traced_first(bad: Told, tiny_card: Path) -> None:
    assert bad(tiny_card, "--partition", "kd_bricks", "--domains", 2)


def test_more_bricks_than_a_volume_has(run_cli: Run, npy: Path) -> None:
    ran = run_cli("trace", npy, *SMALL, "--domains", 19)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (
        "simrender: a volume of 25 x 21 x 17 voxels cannot be cut into 19 bricks: their faces lie on multiples of 8 cells, which "  # noqa: E501
        "allows 1 to 18; ask for fewer bricks or trace a larger volume\n"
    )


# Mistakes on the card


@pytest.mark.parametrize(
    ("assignments", "message"),
    [
        (["traced.samples=3"], "{card}:1:1: traced.samples 3 does not divide published.samples 2"),
        (["traced.samples=4"], "{card}:1:1: traced.samples 4 does not divide published.samples 2"),
        (["integrator.name=ambient_occlusion", "integrator.step=1"], "{card}:1:1: integrator: ambient_occlusion takes samples, distance, bounces, random_numbers, not step; did you mean 'distance'?"),  # noqa: E501
        (["integrator.step=1"], "{card}:1:1: integrator: path_tracing takes no step here; its parameters are in the section bounces"),  # noqa: E501
        (["integrator.name=ambient_occlusion", "bounces.diffuse=1"], "{card}:1:1: the section bounces is for path_tracing, and the integrator is ambient_occlusion"),  # noqa: E501
        (["integrator.name=volume_marching"], "the scene has no volume to march through"),
        (["integrator.name=volume_path_tracing"], "the scene has no volume to track paths through"),
        (["integrator.name=element_marching"], "the scene has no elements to march through"),
    ],
)  # fmt: skip
def test_cards_that_contradict_themselves(bad: Told, tiny_card: Path, assignments: list[str], message: str) -> None:
    options = [option for a in assignments for option in ("--set", f"workload.{a}")]
    assert bad(tiny_card, *options) == message.format(card=tiny_card)


def test_words_that_nobody_knows(bad: Told, tiny_card: Path) -> None:
    message = bad(tiny_card, "--set", "workload.integrator.name=ambient")
    assert message.startswith("--set workload.integrator.name: expected ")
    assert message.endswith(", got 'ambient'; did you mean 'ambient_occlusion'?")
    message = bad(tiny_card, "--set", "workload.integrator.sampels=3")
    assert message.startswith("--set workload.integrator.sampels: workload.integrator has no field 'sampels'; did you mean 'samples'?")  # fmt: skip  # noqa: E501


def test_integrators_of_surfaces_need_surfaces(bad: Told, npy: Path) -> None:
    for name in ("path_tracing", "ambient_occlusion", "spray_path_tracing"):
        assert bad(npy, "--set", f"workload.integrator.name={name}") == (
            "the scene has no triangles; its volume needs volume_marching or volume_path_tracing"
        )


@pytest.mark.parametrize("policy", ["ray_queue_cycling", "image_parallel"])
def test_a_run_of_a_volume_says_why_not(run_cli: Run, npy: Path, policy: str) -> None:
    ran = run_cli("run", "dgx2", npy, "--policy", policy)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err == (
        f"simrender: {policy} moves the rays of path_tracing, and the integrator of fog is volume_marching\n"
    )


def test_the_way_out_that_a_refused_run_names_is_one(run_cli: Run) -> None:
    ran = run_cli("run", "dgx2", WAVELETS)
    assert (ran.code, ran.out) == (2, "")
    hint = ran.err.strip().rpartition("; ")[2].split()
    assert hint[0] == "--set"
    small = ("--set", "workload.traced.resolution=32x32", "--gpus", 2)
    assert run_cli("run", "dgx2", WAVELETS, *hint, *small).code == 0


# Files


@pytest.mark.parametrize("name", ["scene.abc", "scene.ply.gz", "scene.pvtu"])
def test_a_file_of_an_unknown_ending(bad: Told, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("x")
    message = bad(tmp_path / name)
    assert message.startswith(str(tmp_path / name))
    assert "a scene ends in .ply, .obj, .glb, .gltf, .stl, .spray, .npy, .nrrd" in message


@pytest.mark.parametrize("name", ["no.ply", "no.npy", "no.nrrd", "no.vtk", "no.vtu", "no.spray"])
def test_a_file_that_is_not_there(bad: Told, tmp_path: Path, name: str) -> None:
    assert bad(tmp_path / name, *SMALL) == f"{tmp_path / name}: there is no such file"


@pytest.mark.parametrize(
    "ending",
    ["ply", "npy", "nrrd", "vtk", "spray", "raw", "vtu", "vti"],
)
@pytest.mark.parametrize("content", [b"", b"\x00\xff\x10garbage", b"hello\nworld\n"])
def test_a_file_of_something_else(bad: Told, tmp_path: Path, ending: str, content: bytes) -> None:
    path = tmp_path / f"file.{ending}"
    path.write_bytes(content)
    assert str(path) in bad(path)


@pytest.mark.parametrize("voxels", [np.zeros((4, 4)), np.full((3, 3, 3), np.nan), np.zeros((1, 5, 5)), np.zeros((3, 3, 3), complex)])  # fmt: skip  # noqa: E501
def test_arrays_that_are_no_volume(bad: Told, tmp_path: Path, voxels: np.ndarray) -> None:
    np.save(tmp_path / "a.npy", voxels)
    assert bad(tmp_path / "a.npy").startswith(str(tmp_path / "a.npy"))


def test_names_that_mean_something_in_yaml(trace: Found, mesh_file: Writes) -> None:
    for name in ("a: {b} #c.ply", "- x.ply", "null.ply", "ä ö.ply", "it's.ply", '"q".ply', "100.ply"):
        assert trace(mesh_file(name), "--resolution", "4x4")["workload"] == name.removesuffix(".ply")


@pytest.mark.parametrize("name", ['it\'s "x".ply', "a\\b.ply"])
def test_names_that_python_and_yaml_quote_differently(trace: Found, mesh_file: Writes, name: str) -> None:
    assert trace(mesh_file(name), "--resolution", "4x4")["resolution"] == [4, 4]


def test_a_published_resolution_that_was_set_is_kept(trace: Found, mesh_file: Writes) -> None:
    found = trace(mesh_file("a.ply"), *SMALL, "--set", "workload.published.resolution=640x360")
    assert found["ray_weight"] == 400.0


def test_elements_weigh_something(trace: Found) -> None:
    assert trace(example("hexbeam.vtk"), *SMALL)["domains"][0]["published_bytes"] > 0.0


def test_a_single_triangle_seen_edge_on_or_far_away(trace: Found, tmp_path: Path) -> None:
    for k, (scale, shift) in enumerate([(1e-6, 0.0), (1e6, 0.0), (1.0, 1e5), (1e-20, 0.0)]):
        path = tmp_path / f"t{k}.ply"
        path.write_text(ply_text(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.5]]) * scale + shift, [[0, 1, 2]]))
        found = trace(path, "--resolution", "16x16", "--domains", 1)
        assert found["camera_hits"] > 20
        assert found["domains"][0]["nearest_hits"] == sum(found["hits_by_kind"].values())
