"""Cards of workloads: what each integrator and partition takes, published and traced sizes, and cameras that move."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from simrender import simulation
from simrender.cards import Document
from simrender.errors import CardError, SceneError, UsageError
from simrender.rays.integrators import INTEGRATORS
from simrender.rays.workload import Workload, load_workload
from simrender.rays.workload_card import CameraCard, DomainsCard, IntegratorCard, KeyCard, WorkloadCard
from simrender.simulation import simulate
from tests.scenes import garden_workload

TEXT = """\
title: A garden
published: {resolution: 64x32, samples: 8}
traced: {resolution: 32x16}
scene: {generator: "tests.scenes:garden"}
camera: {position: [5.5, -5.0, 3.0], look_at: [0, 0, 0.4]}
"""


def card(text: str = "", base: str = TEXT) -> WorkloadCard:
    return Document(base + text, "some.yaml").validate(WorkloadCard)


def mistakes(text: str, base: str = TEXT) -> list[str]:
    with pytest.raises(CardError) as caught:
        card(text, base)
    return [re.sub(r"^some\.yaml:\d+:\d+: ", "", line) for line in str(caught.value).splitlines()]


# Integrators

VALUES: dict[str, Any] = {
    "samples": 4, "distance": 2.5, "bounces": 2, "shadow_samples": 3, "specular": 0.5, "shininess": 20, "step": 0.5,
    "shading": "false", "opacity_limit": 0.9, "shadow_probability": 0.25, "roulette": 0.2,
    "random_numbers": "spray_program",
}  # fmt: skip
OWN = {
    name: ["random_numbers" if f.name == "program_image" else f.name for f in dataclasses.fields(made)]
    for name, made in INTEGRATORS.items()
    if name != "path_tracing"
}


def test_every_parameter_of_an_integrator_is_known_here() -> None:
    assert set(VALUES) == set(IntegratorCard.model_fields) - {"name"} == set().union(*OWN.values())


@pytest.mark.parametrize(("name", "parameter"), [*itertools.product(OWN, VALUES)])
def test_an_integrator_takes_its_own_parameters_and_no_others(name: str, parameter: str) -> None:
    text = f"integrator: {{name: {name}, {parameter}: {VALUES[parameter]}}}\n"
    if parameter in OWN[name]:
        made = card(text).integrator.value()
        assert type(made) is INTEGRATORS[name]
        if parameter == "random_numbers":  # the workload fills in the size of the image
            assert made == INTEGRATORS[name]()
            return
        wanted = False if parameter == "shading" else VALUES[parameter]
        assert made == dataclasses.replace(INTEGRATORS[name](), **{parameter: wanted})
    else:
        (message,) = mistakes(text)
        takes = ", ".join(OWN[name]) or "no parameters"
        assert message.startswith(f"integrator: {name} takes {takes}, not {parameter}")


def test_a_parameter_of_another_integrator_names_what_is_near() -> None:
    assert mistakes("integrator: {name: ambient_occlusion, shadow_samples: 2}\n") == [
        "integrator: ambient_occlusion takes samples, distance, bounces, random_numbers, not shadow_samples; "
        "did you mean 'samples'?"
    ]
    assert mistakes("integrator: {name: spray_path_tracing, samples: 2}\n") == [
        "integrator: spray_path_tracing takes shadow_samples, bounces, specular, shininess, random_numbers, not "
        "samples; did you mean 'shadow_samples'?"
    ]
    assert mistakes("integrator: {name: ambient_oclusion}\n") == [
        f"integrator.name: expected {', '.join(map(repr, list(INTEGRATORS)[:-1]))} or {list(INTEGRATORS)[-1]!r}, "
        "got 'ambient_oclusion'; did you mean 'ambient_occlusion'?"
    ]


@pytest.mark.parametrize("parameter", VALUES)
def test_path_tracing_takes_its_parameters_elsewhere(parameter: str) -> None:
    assert mistakes(f"integrator: {{{parameter}: {VALUES[parameter]}}}\n") == [
        f"integrator: path_tracing takes no {parameter} here; its parameters are in the section bounces"
    ]


@pytest.mark.parametrize("name", OWN)
def test_bounces_belong_to_path_tracing(name: str) -> None:
    text = f"integrator: {{name: {name}}}\nbounces: {{diffuse: 2}}\n"
    assert mistakes(text) == [f"the section bounces is for path_tracing, and the integrator is {name}"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{name: ambient_occlusion, samples: 0}", "integrator.samples: should be greater than or equal to 1, got 0"),
        ("{name: ambient_occlusion, samples: 2.5}", "integrator.samples: expected a whole number, got 2.5"),
        ("{name: ambient_occlusion, distance: 0}", "integrator.distance: should be greater than 0, got 0"),
        ("{name: ambient_occlusion, bounces: 201}", "integrator.bounces: should be less than or equal to 200, got 201"),
        ("{name: volume_marching, opacity_limit: 1.5}", "integrator.opacity_limit: should be less than or equal to 1, got 1.5"),  # noqa: E501
        ("{name: volume_marching, step: -1}", "integrator.step: should be greater than 0, got -1"),
        ("{name: volume_path_tracing, shadow_probability: 1}", "integrator.shadow_probability: should be less than 1, got 1"),  # noqa: E501
    ],
)  # fmt: skip
def test_a_value_out_of_range(text: str, message: str) -> None:
    assert mistakes(f"integrator: {text}\n") == [message]


@pytest.mark.parametrize("number", [".nan", ".inf", "-.inf"])
@pytest.mark.parametrize(
    "parameter", ["ambient_occlusion, distance", "volume_marching, step", "element_marching, step"]
)
def test_a_length_is_finite(parameter: str, number: str) -> None:
    (message,) = mistakes(f"integrator: {{name: {parameter}: {number}}}\n")
    assert message.startswith(f"integrator.{parameter.split()[1]}: should be ")


def test_defaults_are_path_tracing_with_its_bounces() -> None:
    made = load("bounces: {diffuse: 1, mirror: 2, roulette: 0.5}\n").integrator
    assert made == INTEGRATORS["path_tracing"](1, 2, 0.5)  # type: ignore[call-arg]
    assert load("").integrator == INTEGRATORS["path_tracing"]()


def load(text: str, base: str = TEXT) -> Workload:
    document = Document(base + text, "some.yaml")
    return Workload("some", document.validate(WorkloadCard), document, Path())


# Domains

NEEDS = {"auto": "count", "given": "", "kd_bricks": "count", "sah": "count", "grid": "shape", "balanced": "shape",
         "objects": "count"}  # fmt: skip


@pytest.mark.parametrize(("method", "given"), [*itertools.product(NEEDS, ["", "count", "shape", "count shape"])])
def test_each_way_to_cut_takes_a_count_or_a_shape_or_neither(method: str, given: str) -> None:
    fields = {"count": ", count: 4", "shape": ", shape: [2, 3, 1]"}
    text = f"domains: {{method: {method}{''.join(fields[g] for g in given.split())}}}\n"
    if given == NEEDS[method]:
        made = card(text).domains
        assert made is not None
        assert (made.method, made.count, made.shape) == (
            method, 4 if "count" in given else None, (2, 3, 1) if "shape" in given else None
        )  # fmt: skip
        return
    (message,) = mistakes(text)
    wrong = next(n for n in ("count", "shape") if (n in given) != (n == NEEDS[method]))
    assert message == f"domains: {method} {'needs' if wrong == NEEDS[method] else 'takes no'} {wrong}"


def test_domains_that_cannot_be_made() -> None:
    assert mistakes("domains: {method: sahh, count: 2}\n") == [
        "domains.method: expected 'auto', 'given', 'kd_bricks', 'sah', 'grid', 'balanced' or 'objects', got 'sahh'; "
        "did you mean 'sah'?"
    ]
    for count, problem in ((0, "greater than or equal to 1"), (32768, "less than or equal to 32767")):
        assert mistakes(f"domains: {{method: sah, count: {count}}}\n") == [
            f"domains.count: should be {problem}, got {count}"
        ]
    assert mistakes("domains: {method: grid, shape: [2, 2]}\n")[0].startswith("domains.shape")
    assert mistakes("domains: {method: grid, shape: [2, 2, 0]}\n")[0].startswith("domains.shape.2: ")
    assert mistakes("domains: {count: 3}\n") == ["domains: given takes no count"]


def test_surfaces_cut_in_every_way_hold_every_triangle_once() -> None:
    workload = garden_workload(traced="16x8")
    total = workload.scene.instanced_triangles
    for how in (
        DomainsCard(), DomainsCard(method="sah", count=6), DomainsCard(method="grid", shape=(3, 2, 1)),
        DomainsCard(method="balanced", shape=(2, 2, 2)), DomainsCard(method="objects", count=3),
        DomainsCard(method="auto", count=5),
    ):  # fmt: skip
        found = workload.domains(how)
        assert found.domain_of_triangle is not None
        assert len(found.domain_of_triangle) == total
        assert 0 <= found.domain_of_triangle.min() <= found.domain_of_triangle.max() < found.count
        assert found.primitives.sum() == pytest.approx(workload.published.instanced_triangles, rel=1e-12)
        assert workload.domains(how) is found
    with pytest.raises(SceneError) as caught:
        workload.domains(DomainsCard(method="kd_bricks", count=4))
    assert str(caught.value) == (
        "domains.method kd_bricks: the scene has no volume; use sah, grid, balanced or objects"
    )


# Published and traced sizes

SIZE = "expected WIDTHxHEIGHT in pixels such as '2560x1080'"


@pytest.mark.parametrize(
    ("traced", "message"),
    [
        ("{resolution: 128x32}", "traced.resolution 128x32 is larger than published.resolution 64x32"),
        ("{resolution: 32x16, samples: 3}", "traced.samples 3 does not divide published.samples 8"),
        ("{resolution: 32x16, samples: 16}", "traced.samples 16 does not divide published.samples 8"),
        ("{resolution: 32x16, samples: 0}", "traced.samples: should be greater than or equal to 1, got 0"),
        ("{resolution: 0x16}", f"traced.resolution: {SIZE}, got '0x16'"),
        ("{resolution: 32 x 16}", f"traced.resolution: {SIZE}, got '32 x 16'"),
        (
            "{resolution: 32x16, sampels: 2}",
            "traced.sampels: unknown field; did you mean 'samples'? (known: resolution, samples)",
        ),
    ],
)  # fmt: skip
def test_a_traced_size_that_cannot_stand_for_the_published_one(traced: str, message: str) -> None:
    assert mistakes("", TEXT.replace("{resolution: 32x16}", traced)) == [message]


@pytest.mark.parametrize(
    ("samples", "repeats"), [("", 1), (", samples: 8", 1), (", samples: 2", 4), (", samples: 1", 8)]
)
def test_traced_rays_stand_for_all_published_ones(samples: str, repeats: int) -> None:
    workload = load("", TEXT.replace("32x16}", f"32x16{samples}}}"))
    assert (workload.repeats, workload.weight, workload.samples) == (repeats, 4.0, 8 // repeats)
    assert 32 * 16 * workload.samples * workload.weight * workload.repeats == 64 * 32 * 8


def run(samples: int, policy: str = "ray_queue_cycling", **more: Any) -> Any:
    given = [f"traced.samples={samples}"]
    workload = load_workload(str(more.pop("card")), given)
    return simulate("dgx2", workload, policy, gpus=4, **more)


@pytest.fixture
def garden_card(tmp_path: Path) -> Path:
    path = tmp_path / "garden.yaml"
    # Every sample has paths of the same greatest depth, and so as many wavefronts.
    path.write_text(TEXT.replace("32x16", "64x32") + "bounces: {diffuse: 2, mirror: 1, roulette: 0}\n")
    return path


@pytest.mark.parametrize(
    ("policy", "islands"), [("ray_queue_cycling", 1), ("ray_queue_cycling", 2), ("image_parallel", 4)]
)
def test_fewer_traced_samples_are_repeated_and_cost_the_same_frame(
    policy: str, islands: int, garden_card: Path
) -> None:
    whole, some = (run(samples, policy, islands=islands, card=garden_card) for samples in (8, 2))
    assert some.counts["traced_paths"] * 4 == whole.counts["traced_paths"] == 64 * 32 * 8
    assert some.counts["published_paths"] == whole.counts["published_paths"]
    assert some.counts["kernels"] == whole.counts["kernels"]
    assert some.frame_time_s == pytest.approx(whole.frame_time_s, rel=0.01)
    assert some.counts["published_rays"] == pytest.approx(whole.counts["published_rays"], rel=0.02)
    assert some.counts["ray_weight"] == 4.0
    assert whole.counts["ray_weight"] == 1.0


def test_each_repeated_ray_is_retired_once_a_repeat(garden_card: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check, seen = simulation.check_retired, []

    def record(trace: Any, retired: Any, repeats: int) -> None:
        seen.append((retired, repeats))
        check(trace, retired, repeats)

    monkeypatch.setattr(simulation, "check_retired", record)
    result = run(2, islands=2, card=garden_card)
    ((retired, repeats),) = seen
    assert repeats == 4
    assert (np.bincount(retired) == 4).all()
    assert len(retired) == 4 * result.counts["traced_rays"]


def test_the_image_of_repeated_samples_is_theirs(garden_card: Path) -> None:
    result = run(2, islands=2, card=garden_card)
    trace = load_workload(str(garden_card), ["traced.samples=2"]).trace()
    assert np.array_equal(result.image, trace.reference)


# Cameras

KEYS = [([4, 0, 1], [0, 0, 0]), ([0, 5, 2], [0, 1, 0]), ([-3, 0, 1], [0, 0, 1]), ([-3, -1, 0.5], [1, 0, 0])]


def moving(keys: list[tuple[list[float], list[float]]] = KEYS) -> CameraCard:
    path = tuple(KeyCard(position=tuple(p), look_at=tuple(t)) for p, t in keys)  # type: ignore[arg-type]
    return CameraCard(position=(9.0, 9.0, 9.0), look_at=(0.0, 0.0, 0.0), path=path)


def places(camera: CameraCard, when: list[float] | np.ndarray) -> np.ndarray:
    at = [camera.at(float(w)) for w in when]
    return np.array([(*c.position, *c.look_at) for c in at])


@pytest.mark.parametrize("count", [2, 3, 4])
def test_a_camera_passes_through_its_keys_in_equal_times(count: int) -> None:
    found = places(moving(KEYS[:count]), np.linspace(0.0, 1.0, count))
    assert found == pytest.approx(np.array([[*p, *t] for p, t in KEYS[:count]]), abs=1e-12)


def test_a_camera_moves_on_without_a_jump_or_a_kink() -> None:
    when = np.linspace(0.0, 1.0, 3001)
    found = places(moving(), when)
    steps = np.diff(found, axis=0)
    lengths = np.linalg.norm(steps[:, :3], axis=1)
    assert lengths.max() < 4.0 * lengths.mean()
    ways = steps[:, :3] / lengths[:, None]
    assert (ways[1:] * ways[:-1]).sum(axis=1).min() > 0.999  # also where it passes a key


def test_two_keys_are_a_straight_way() -> None:
    found = places(moving(KEYS[:2]), [0.25, 0.5])
    ends = np.array([[*p, *t] for p, t in KEYS[:2]], float)
    assert found[1] == pytest.approx(ends.mean(axis=0), abs=1e-12)
    assert found[0] == pytest.approx(0.75 * ends[0] + 0.25 * ends[1], abs=1e-12)


def test_a_way_that_is_turned_moved_and_scaled_is_still_the_same_way() -> None:
    turn = np.linalg.qr(np.random.Generator(np.random.Philox(1)).normal(size=(3, 3)))[0]
    keys = [((3.0 * turn @ p + 7.0).tolist(), (3.0 * turn @ t + 7.0).tolist()) for p, t in KEYS]
    when = np.linspace(0.0, 1.0, 23)
    found, expected = places(moving(keys), when), places(moving(), when)
    for part in (slice(0, 3), slice(3, 6)):
        assert found[:, part] == pytest.approx(3.0 * expected[:, part] @ turn.T + 7.0, abs=1e-9)


def test_backwards_is_the_same_way() -> None:
    when = np.linspace(0.0, 1.0, 31)
    assert places(moving(KEYS[::-1]), when) == pytest.approx(places(moving(), 1.0 - when), abs=1e-9)


def test_before_the_beginning_and_after_the_end_a_camera_waits() -> None:
    assert np.array_equal(places(moving(), [-1.0, 2.0]), places(moving(), [0.0, 1.0]))


def test_keys_may_coincide() -> None:
    camera = moving([KEYS[0], KEYS[0], KEYS[1], KEYS[1], KEYS[1]])
    found = places(camera, np.linspace(0.0, 1.0, 401))
    assert np.isfinite(found).all()
    assert np.array_equal(found[:101], np.tile(found[0], (101, 1)))
    assert found[-1] == pytest.approx([*KEYS[1][0], *KEYS[1][1]])


def test_a_camera_without_a_path_stands_still() -> None:
    still = CameraCard(position=(1.0, 2.0, 3.0), look_at=(0.0, 0.0, 0.0), vertical_fov_degrees=50.0)
    assert all(still.at(when) == still for when in (0.0, 0.3, 1.0))
    one = moving(KEYS[:1])
    assert {one.at(when).position for when in (0.0, 0.5, 1.0)} == {(4.0, 0.0, 1.0)}


def test_the_way_keeps_what_is_not_on_it() -> None:
    camera = moving().model_copy(update={"vertical_fov_degrees": 63.0, "up": (0.0, 1.0, 0.0), "sampling": "corner"})
    at = camera.at(0.4)
    assert (at.vertical_fov_degrees, at.up, at.sampling) == (63.0, (0.0, 1.0, 0.0), "corner")
    frame = at.frame(2.0)
    assert np.abs(np.linalg.norm(frame[1]) - 1.0) < 1e-12
    assert np.linalg.norm(frame[2]) == pytest.approx(2.0 * math.tan(math.radians(31.5)))
    assert np.abs(frame[1:] @ frame[1:].T - np.diag((frame[1:] ** 2).sum(axis=1))).max() < 1e-12


def test_the_keys_of_a_path_are_checked() -> None:
    def of(path: str) -> Callable[[], list[str]]:
        return lambda: mistakes("", TEXT.replace("look_at: [0, 0, 0.4]}", f"look_at: [0, 0, 0.4], path: {path}}}"))

    assert of("[{position: [1, 1, 1], look_att: [0, 0, 0]}]")() == [
        "camera.path.0.look_at: this field is missing",
        "camera.path.0.look_att: unknown field; did you mean 'look_at'? (known: position, look_at)",
    ]
    nowhere = "camera: the camera looks nowhere: look_at equals position, or lies straight along up"
    assert of("[{position: [1, 1, 1], look_at: [1, 1, 1]}]")() == [nowhere]
    assert of("[{position: [1, 1, 1], look_at: [0, 0, 0]}, {position: [1, 1, 1], look_at: [1, 1, 5]}]")() == [nowhere]
    assert of("[{position: [1, 1], look_at: [0, 0, 0]}]")()[0].startswith("camera.path.0.position")


def test_a_camera_at_no_place() -> None:
    (message,) = mistakes("", TEXT.replace("[5.5, -5.0, 3.0]", "[.inf, 0, 0]"))
    assert message.startswith("camera.position.0: should be a finite number")


def test_a_way_through_the_point_that_is_looked_at() -> None:
    text = TEXT.replace("look_at: [0, 0, 0.4]}", "look_at: [0, 0, 0.4], path: "
        "[{position: [4, 0, 1], look_at: [0, 0, 1]}, {position: [-4, 0, 1], look_at: [0, 0, 1]}]}")  # fmt: skip
    with pytest.raises((UsageError, CardError, SceneError)):
        load("", text).frame(1, 3).trace()


def test_frames_of_an_animation(tmp_path: Path) -> None:
    path = "[{position: [5, -5, 3], look_at: [0, 0, 0]}, {position: [5, 5, 3], look_at: [0, 0, 0]}]"
    workload = load("", TEXT.replace("look_at: [0, 0, 0.4]}", f"look_at: [0, 0, 0.4], path: {path}}}"))
    workload.cache = tmp_path
    frames = [workload.frame(k, 3) for k in range(3)]
    positions = np.array([f.card.camera.position for f in frames])
    assert positions == pytest.approx(np.array([[5.0, -5.0, 3.0], [5.0, 0.0, 3.0], [5.0, 5.0, 3.0]]))
    assert all(f.card.camera.path == () for f in frames)
    # Without a frame the camera is at the beginning; hierarchies and domains are made once for all.
    assert frames[0].trace().key == workload.trace().key
    assert len({f.trace().key for f in frames}) == 3
    assert len({id(f.trace().world) for f in frames}) == 1
    assert frames[2].domains() is workload.domains()
    assert workload.frame(0, 1).trace().key == workload.trace().key
    images = []
    for f in frames:
        f.trace().complete()
        images.append(f.trace().image())
    assert not np.array_equal(images[0], images[1])


@pytest.mark.parametrize(("number", "of", "last"), [(3, 3, 2), (-1, 3, 2), (0, 0, -1), (7, 2, 1)])
def test_a_frame_that_is_not_there(number: int, of: int, last: int) -> None:
    with pytest.raises(UsageError) as caught:
        load("").frame(number, of)
    assert str(caught.value) == f"frame {number} of {of}: expected 0 to {last}"
