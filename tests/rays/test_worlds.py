"""Worlds: what domains find alone adds up to what the whole scene has, on any number of threads, in any units."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays import domains as cuts
from simrender.rays import embree, worlds
from simrender.rays.compositing import composite
from simrender.rays.crossings import Crossings
from simrender.rays.data import cut
from simrender.rays.domains import Domains
from simrender.rays.elements import Elements
from simrender.rays.files import SceneFile
from simrender.rays.integrators import (
    AmbientOcclusion,
    ElementMarching,
    Integrator,
    PathTracing,
    SprayPathTracing,
    VolumeMarching,
    VolumePathTracing,
)
from simrender.rays.kinds import CAMERA, KINDS, SCATTER, SHADOW
from simrender.rays.partition import Published
from simrender.rays.scene import IDENTITY, Environment, Material, Mesh, PointLight, Scene, SceneObject
from simrender.rays.trace import Trace
from simrender.rays.volume import TransferFunction, Volume
from simrender.rays.workload_card import DomainsCard, PublishedCard
from tests.rays.test_element_marching_numerics import cube
from tests.scenes import garden, placed, sphere
from workloads.terrain import generator

HAZE = TransferFunction([0.3, 0.6, 1.0], [[0.1, 0.2, 0.9], [0.9, 0.9, 0.9], [1.0, 0.2, 0.0]], [0.0, 0.06, 0.25])
GREY = Environment((0.4, 0.4, 0.5), (0.7, 0.7, 0.8), (0.2, 0.2, 0.2))
LAMP = PointLight((60.0, -40.0, 90.0), (9000.0, 9000.0, 8000.0))
NONE = np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32)


def fog(nx: int = 30, ny: int = 41, nz: int = 25, isovalues: tuple[float, ...] = ()) -> Volume:
    """A lumpy field, in lengths that are no round numbers; faces of bricks lie where rays start and end too."""
    z, y, x = (np.arange(n) for n in (nz, ny, nx))
    z, y, x = np.meshgrid(z, y, x, indexing="ij")
    lumps = 0.5 + 0.3 * np.sin(0.4 * x) * np.cos(0.3 * y + 1.0) * np.sin(0.5 * z + 0.5)
    voxels = lumps + 0.2 * generator(5, "fog").random(lumps.shape)
    return Volume(voxels, (0.7, 0.5, 0.9), (-10.0, -10.0, -11.0), HAZE, isovalues)


def alone(**what: Any) -> Scene:
    return Scene((), *NONE, environment=GREY, **what)


def foggy(isovalues: tuple[float, ...] = ()) -> Scene:
    """Balls in fog: instances of one object at three sizes, some half inside the volume."""
    offsets = np.array([[0.0, 0.0, 0.0], [-6.0, 5.0, 4.0], [9.0, 8.0, -9.0], [3.0, -9.0, 10.0]])
    balls = placed(offsets, np.array([2.0, 1.5, 4.0, 1.0]))
    ball = SceneObject("ball", (sphere(0, 8),))
    material = Material((0.2, 0.8, 0.3))
    return Scene((ball,), np.zeros(4, np.int32), balls, (material,), (LAMP,), GREY, volume=fog(isovalues=isovalues))


def warped(parts: int = 5) -> Elements:
    return cube("mixed", 4, parts, jitter=0.3, transfer=TransferFunction(HAZE.values, HAZE.colors, [0.0, 0.3, 0.7]))


def bricked(count: int) -> DomainsCard:
    return DomainsCard(method="kd_bricks", count=count)


SCENES: dict[str, tuple[Any, Integrator, DomainsCard]] = {
    "paths": (garden, PathTracing(3, 2, 0.4), DomainsCard(method="sah", count=7)),
    "paths in a grid": (garden, PathTracing(2, 2, 0.4), DomainsCard(method="grid", shape=(3, 2, 2))),
    "occlusion": (garden, AmbientOcclusion(5, 1.5, 2), DomainsCard(method="objects", count=5)),
    "spray": (garden, SprayPathTracing(2, 2), DomainsCard()),
    "marching": (lambda: alone(volume=fog()), VolumeMarching(0.7, opacity_limit=1.0), bricked(9)),
    "marching, unlit": (lambda: alone(volume=fog()), VolumeMarching(2.3, False, 1.0), bricked(30)),
    "tracking": (lambda: alone(volume=fog(), points=(LAMP,)), VolumePathTracing(5, 0.4), bricked(11)),
    "tracking isosurfaces": (lambda: alone(volume=fog(isovalues=(0.55, 0.8))), VolumePathTracing(4), bricked(6)),
    "tracking among balls": (lambda: foggy((0.8,)), VolumePathTracing(5, 0.3), bricked(8)),
    "elements": (lambda: alone(elements=warped()), ElementMarching(), DomainsCard()),
    "elements in small steps": (lambda: alone(elements=warped(1)), ElementMarching(0.02), DomainsCard()),
}  # fmt: skip
"""Of each kind of world, with what it is cut into."""
SURFACES = [name for name in SCENES if name.split()[0] in {"paths", "occlusion", "spray"}]
TRACKING = [name for name in SCENES if name.startswith("tracking")]
MARCHING = [name for name in SCENES if name.startswith("marching")]
ELEMENTS = [name for name in SCENES if name.startswith("elements")]


def camera(scene: Scene, narrow: float = 0.25) -> np.ndarray:
    """All of the scene in view, from aside and above."""
    low, high = (corner.astype(float) for corner in scene.bounds)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    forward = np.array([-0.6, 0.64, -0.48])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([centre - 1.6 * size * forward, forward, narrow * right, narrow * np.cross(right, forward)])


def made(name: str, tmp_path: Any, samples: int = 2, size: tuple[int, int] = (30, 24), **more: Any) -> Trace:
    build, integrator, _ = SCENES[name]
    scene = build()
    trace = Trace(scene, camera(scene), size, samples, integrator, more.pop("seed", 3), tmp_path, **more)
    trace.complete()
    return trace


def pieces(trace: Trace, card: DomainsCard) -> Domains:
    scene = trace.scene
    sizes = Published(float(scene.unique_triangles), 1.0, float(scene.instanced_triangles), 1e6, 0.0)
    return cut(scene, card, PublishedCard(resolution=(100, 100), samples=1), sizes, SceneFile(scene), trace.factor)


def everywhere(trace: Trace, generation: int, domains: Domains) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Every ray of a generation in every domain, entered or not: rows, their domains, and what comes of them."""
    rays = trace.geometry(generation)
    n = len(rays["kind"])
    ray = np.repeat(np.arange(n), domains.count)
    domain = np.tile(np.arange(domains.count, dtype=np.int16), n)
    return ray, domain, trace.world.cross(rays, ray, domains, domain, trace.seed)


def outcome(trace: Trace, generation: int, name: str) -> np.ndarray:
    return trace.column(name)[trace.first[generation] : trace.first[generation + 1]]


# What domains find, and what the whole scene has


@pytest.mark.parametrize("name", [*SURFACES, *TRACKING])
def test_the_nearest_hit_of_all_domains_is_the_whole_scenes_to_the_bit(name: str, tmp_path: Any) -> None:
    trace = made(name, tmp_path)
    domains = pieces(trace, SCENES[name][2])
    assert domains.count > 1
    assert trace.generations > 2
    for generation in range(min(4, trace.generations)):
        ray, _, found = everywhere(trace, generation, domains)
        nearest = np.full(len(outcome(trace, generation, "t")), np.inf, np.float32)
        np.minimum.at(nearest, ray, found["hit"])
        assert np.array_equal(nearest, outcome(trace, generation, "t"))
        assert np.isfinite(nearest).any() or generation > 1


@pytest.mark.parametrize("name", [*SURFACES, *TRACKING, *ELEMENTS])
def test_rows_of_the_crossing_table_lose_no_hit(name: str, tmp_path: Any) -> None:
    """The same for the domains that a ray enters, in the order in which it enters them."""
    trace = made(name, tmp_path)
    crossings = Crossings(trace, pieces(trace, SCENES[name][2]))
    for generation in range(min(3, trace.generations)):
        table = crossings.table(generation)
        hit = crossings.hits(generation, np.arange(len(table["domain"])))
        ray = np.repeat(np.arange(len(table["first"]) - 1), np.diff(table["first"]))
        nearest = np.full(len(table["first"]) - 1, np.inf, np.float32)
        np.minimum.at(nearest, ray, hit)
        assert np.array_equal(nearest, outcome(trace, generation, "t"))
        together = ray[1:] == ray[:-1]
        assert (np.diff(table["entry"])[together] >= 0.0).all()
        # By a rounding, for a hit on a box's face may lie before its entry.
        assert (hit >= table["entry"] * np.float32(1.0 - 1e-5) - np.float32(1e-5)).all()


@pytest.mark.parametrize("name", MARCHING)
def test_samples_of_all_bricks_add_up_and_their_fragments_are_the_image(name: str, tmp_path: Any) -> None:
    trace = made(name, tmp_path, samples=1)
    ray, domain, found = everywhere(trace, 0, pieces(trace, SCENES[name][2]))
    n = trace.pixels
    samples = np.bincount(ray, found["work"], minlength=n)
    assert np.array_equal(samples, trace.column("work"))
    assert samples.sum() > 5 * n
    seen = found["rgba"][:, 3] > 0.0
    entry = np.full(len(ray), np.inf)
    assert np.isfinite(found["exit"][seen]).all()
    entry[seen] = found["exit"][seen]  # bricks that do not overlap leave a ray in the order in which it enters them
    image = composite(found["rgba"][seen], entry[seen], ray[seen], domain[seen], n)
    direction = trace.geometry(0)["direction"]
    behind = trace.world.backdrop.colors({"direction": direction}, None)  # type: ignore[attr-defined]
    whole = image[:, :3] + (1.0 - image[:, 3:]) * behind
    assert np.abs(whole - trace.column("radiance")).max() < 2e-5


@pytest.mark.parametrize("name", MARCHING)
def test_rows_of_the_crossing_table_hold_all_samples(name: str, tmp_path: Any) -> None:
    trace = made(name, tmp_path)
    crossings = Crossings(trace, pieces(trace, SCENES[name][2]))
    table = crossings.table(0)
    crossings.hits(0, np.arange(len(table["domain"])))
    ray = np.repeat(np.arange(trace.rays), np.diff(table["first"]))
    assert np.array_equal(np.bincount(ray, table["work"], minlength=trace.rays), trace.column("work"))


def test_an_opaque_ray_ends_and_takes_no_more_samples(tmp_path: Any) -> None:
    dense = TransferFunction([0.0], [[1.0, 0.5, 0.0]], [0.9])
    scene = alone(volume=replace(fog(), transfer=dense))
    looks = [
        Trace(scene, camera(scene), (16, 12), 1, VolumeMarching(1.0, opacity_limit=limit), 1, tmp_path)
        for limit in (0.5, 0.99, 1.0)
    ]
    for trace in looks:
        trace.complete()
    work = [trace.column("work") for trace in looks]
    assert (work[0] <= work[1]).all()
    assert (work[1] <= work[2]).all()
    assert work[1].sum() < 0.3 * work[2].sum()
    assert np.abs(looks[1].image() - looks[2].image()).max() <= 0.01
    # A row ends where the ray grew opaque, and says so by a hit at its exit.
    found = everywhere(looks[1], 0, pieces(looks[1], DomainsCard(method="kd_bricks", count=4)))[2]
    ended = np.isfinite(found["hit"])
    assert ended.any()
    assert np.array_equal(found["hit"][ended], found["exit"][ended])
    assert (found["rgba"][ended, 3] >= 0.99).all()
    assert (found["rgba"][~ended, 3] < 0.99).all()


@pytest.mark.parametrize("name", ELEMENTS)
def test_elements_and_samples_of_all_parts_add_up(name: str, tmp_path: Any) -> None:
    trace = made(name, tmp_path)
    domains = pieces(trace, DomainsCard())
    ray, _, found = everywhere(trace, 0, domains)
    for column in ("work", "samples"):
        assert np.array_equal(np.bincount(ray, found[column], minlength=trace.rays), trace.column(column))
    assert trace.column("work").sum() > trace.rays / 2
    assert (trace.column("samples") >= trace.column("work")).all()
    nearest = np.full(trace.rays, np.inf, np.float32)
    np.minimum.at(nearest, ray, found["hit"])
    assert np.array_equal(nearest, trace.column("t"))


def test_parts_change_no_picture_of_elements(tmp_path: Any) -> None:
    one, five = warped(1), warped(5)
    images = []
    for elements in (one, five):
        scene = alone(elements=elements)
        trace = Trace(scene, camera(scene), (24, 18), 2, ElementMarching(), 1, tmp_path)
        trace.complete()
        images.append(trace.image())
    assert np.abs(images[0] - images[1]).max() < 1e-5
    assert images[0].std() > 0.02


@pytest.mark.parametrize("name", TRACKING)
def test_bricks_change_no_collision_and_no_random_number(name: str, tmp_path: Any) -> None:
    """Woodcock tracking: what a ray meets does not depend on how the volume is cut."""
    trace = made(name, tmp_path)
    for count in (1, 2, 5, 17):
        ray, _, found = everywhere(trace, 1, pieces(trace, DomainsCard(method="kd_bricks", count=count)))
        nearest = np.full(len(outcome(trace, 1, "t")), np.inf, np.float32)
        np.minimum.at(nearest, ray, found["hit"])
        assert np.array_equal(nearest, outcome(trace, 1, "t"))


# Threads, chunks and blocks


@pytest.fixture
def cores(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Set the number of threads, the rays a thread takes at once, and the rays of a block."""
    pools: list[ThreadPoolExecutor] = []

    def use(threads: int, chunk: int, block: int) -> None:
        pools.append(ThreadPoolExecutor(threads))
        monkeypatch.setattr(embree, "_pool", lambda: pools[-1])
        monkeypatch.setattr(embree, "CHUNK", chunk)
        monkeypatch.setattr(worlds, "_BLOCK", block)

    yield use
    for pool in pools:
        pool.shutdown()


@pytest.mark.parametrize("name", SCENES)
def test_threads_and_block_sizes_change_nothing(name: str, tmp_path: Any, cores: Any) -> None:
    found = []
    for k, sizes in enumerate([(1, 1 << 14, 1 << 18), (3, 97, 1 << 18), (2, 64, 211), (1, 1000, 13)]):
        cores(*sizes)
        trace = made(name, tmp_path / str(k), samples=1, size=(20, 15))
        rows = everywhere(trace, trace.generations - 1, pieces(trace, SCENES[name][2]))[2]
        tables = [trace.geometry(g) for g in range(1, trace.generations)]
        found.append((trace, rows, tables))
    first, rows, tables = found[0]
    assert first.traced_rays == first.rays
    for trace, others, more in found[1:]:
        assert trace.key == first.key
        assert trace.first == first.first
        for column in (*trace.world.outcome, "t", "primitive", "radiance", "children", "kind", "pixel"):
            assert np.array_equal(trace.column(column), first.column(column)), column
        for mine, theirs in zip(more, tables, strict=True):
            for column in mine:
                assert np.array_equal(mine[column], theirs[column]), column
        for column in rows:
            assert np.array_equal(others[column], rows[column], equal_nan=True), column


@pytest.mark.parametrize("name", list(SCENES))
def test_nothing_is_followed_through_no_time(name: str, tmp_path: Any) -> None:
    """No rays are an answer too, of the same columns and types; a progress report ends with all rays."""
    reports: list[tuple[int, int, int]] = []
    trace = made(name, tmp_path, progress=lambda *r: reports.append(r))
    some, none = trace.geometry(0), {name: column[:0] for name, column in trace.geometry(0).items()}
    one, empty = trace.world.follow(some, 3), trace.world.follow(none, 3)
    assert set(one) == set(empty)
    for column in one:
        assert one[column].dtype == empty[column].dtype, column
        assert one[column].shape[1:] == empty[column].shape[1:], column
        assert len(empty[column]) == 0
    rows = trace.world.cross(some, np.zeros(0, np.int64), pieces(trace, SCENES[name][2]), np.zeros(0, np.int16), 3)
    assert {len(column) for column in rows.values()} == {0}
    for generation in range(trace.generations):
        last = [r for r in reports if r[0] == generation][-1]
        count = trace.first[generation + 1] - trace.first[generation]
        assert last == (generation, count, count)


@pytest.mark.parametrize("name", SCENES)
def test_what_a_world_says_of_its_rays_makes_sense(name: str, tmp_path: Any) -> None:
    trace = made(name, tmp_path)
    kinds = {KINDS[k] for k in np.unique(trace.column("kind"))}
    camera_only = name in MARCHING or name in ELEMENTS
    assert (kinds == {"camera"}) == camera_only
    assert ("scatter" in kinds) == (name in TRACKING)
    assert np.isfinite(trace.column("radiance")).all()
    assert (trace.column("radiance") >= 0.0).all()
    assert np.array_equal(trace.reference, trace.image())
    for generation in range(trace.generations):
        rays, t = trace.geometry(generation), outcome(trace, generation, "t")
        assert np.abs(np.linalg.norm(rays["direction"].astype(float), axis=1) - 1.0).max() < 1e-5
        assert (t >= 0.0).all()
        assert (t[np.isfinite(t)] <= rays["reach"][np.isfinite(t)]).all()
        if generation:
            parent = rays["parent"]
            assert (np.diff(parent) >= 0).all()
            assert np.array_equal(rays["pixel"], trace.geometry(generation - 1)["pixel"][parent])
            assert np.array_equal(np.bincount(parent, minlength=len(outcome(trace, generation - 1, "t"))),
                                  outcome(trace, generation - 1, "children"))  # fmt: skip
            assert (outcome(trace, generation - 1, "kind")[parent] != SHADOW).all()
            assert (rays["kind"] != CAMERA).all()


# Hard cases


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 1e6])
@pytest.mark.parametrize("name", ["paths", "marching", "tracking among balls"])
def test_units_of_length_change_no_ray(name: str, factor: float, tmp_path: Any) -> None:
    build, integrator, card = SCENES[name]
    factor = 2.0 ** round(math.log2(factor))  # so that no digit of a coordinate changes
    traces = []
    for scene in (build(), build().scaled(factor)):
        trace = Trace(scene, camera(scene), (16, 12), 1, integrator, 1, tmp_path)
        trace.complete()
        traces.append(trace)
    assert traces[1].factor != 1.0
    assert traces[1].rays == pytest.approx(traces[0].rays, rel=0.01)
    assert traces[1].image().mean() == pytest.approx(traces[0].image().mean(), rel=0.01)
    assert pieces(traces[1], card).count == pieces(traces[0], card).count


@pytest.mark.parametrize(
    ("build", "integrator", "lengths"),
    [
        (garden, AmbientOcclusion(16, 0.5, 1), "distance"),
        (lambda: alone(elements=warped()), ElementMarching(0.05), "step"),
    ],
)
def test_lengths_of_an_integrator_are_in_the_scenes_units(
    build: Any, integrator: Any, lengths: str, tmp_path: Any
) -> None:
    factor = 2.0**-5
    small = replace(integrator, **{lengths: getattr(integrator, lengths) * factor})
    counts = []
    for scene, light in ((build(), integrator), (build().scaled(factor), small)):
        trace = Trace(scene, camera(scene), (16, 12), 1, light, 1, tmp_path)
        trace.complete()
        shadow = trace.column("kind") == SHADOW
        counts.append(
            [np.isfinite(trace.column("t")[shadow]).sum(), *(trace.column(c).sum() for c in trace.world.outcome)]
        )
    assert counts[1] == pytest.approx(counts[0], rel=0.02)


def test_rays_that_start_inside_behind_and_along_the_faces_of_bricks(tmp_path: Any) -> None:
    """Hand-made rays on the faces, edges and corners of bricks belong to exactly one brick at each point."""
    scene = alone(volume=replace(fog(33, 33, 33), spacing=(1.0, 1.0, 1.0), origin=(0.0, 0.0, 0.0)))
    march, track = (worlds.world(scene, i) for i in (VolumeMarching(0.5, opacity_limit=1.0), VolumePathTracing()))
    corners = np.array(
        [[8, 16, 24], [16, 16, 16], [0, 0, 0], [32, 8, 16], [8.0, 4.5, 16.0], [40, 16, 16], [16, 16, -5]]
    )
    ways = np.array([[1, 0, 0], [0, -1, 0], [0, 0, 1], [1, 1, 0], [-1, 1, 1], [-1, 0, 0], [0, 0, 1]], float)
    origin, direction = np.repeat(corners, len(ways), axis=0), np.tile(ways, (len(corners), 1))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    n = len(origin)
    rays = {
        "origin": origin.astype(np.float32), "direction": direction.astype(np.float32),
        "reach": np.where(np.arange(n) % 3 == 0, 9.5, np.inf).astype(np.float32),
        "throughput": np.ones((n, 3), np.float32), "pixel": np.arange(n, dtype=np.int32),
        "sample": np.zeros(n, np.uint16), "kind": np.full(n, SCATTER, np.uint8), "diffuse": np.ones(n, np.uint8),
        "mirror": np.zeros(n, np.uint8), "parent": np.zeros(n, np.int32),
    }  # fmt: skip
    cells = cuts.kd_bricks(scene.volume.dims, 64)
    domains = cuts.from_bricks(scene.volume, cells)
    ray, domain = np.repeat(np.arange(n), 64), np.tile(np.arange(64, dtype=np.int16), n)
    whole, split = march.follow(rays, 1), march.cross(rays, ray, domains, domain, 1)
    assert np.array_equal(np.bincount(ray, split["work"], minlength=n), whole["work"])
    assert whole["work"].max() > 60
    for seed in range(5):
        whole, split = track.follow(rays, seed), track.cross(rays, ray, domains, domain, seed)
        nearest = np.full(n, np.inf, np.float32)
        np.minimum.at(nearest, ray, split["hit"])
        assert np.array_equal(nearest, whole["t"])


def test_a_ball_hides_the_fog_behind_it(tmp_path: Any) -> None:
    scene = foggy()
    looks = []
    for what in (scene, alone(volume=scene.volume)):
        looks.append(Trace(what, camera(scene), (30, 24), 1, VolumeMarching(opacity_limit=1.0), 1, tmp_path))
        looks[-1].complete()
    trace, clear = looks
    on = trace.world.backdrop.hits(trace.geometry(0)).primitive >= 0
    assert 10 < on.sum() < len(on) - 10
    assert (trace.column("work") <= clear.column("work")).all()
    assert trace.column("work")[on].sum() < clear.column("work")[on].sum()
    assert np.array_equal(trace.column("work")[~on], clear.column("work")[~on])
    assert np.array_equal(trace.column("radiance")[~on], clear.column("radiance")[~on])


def test_a_ball_before_elements_is_seen(tmp_path: Any) -> None:
    ball = SceneObject("ball", (Mesh(sphere(0, 8).vertices * 0.6 + 0.5, sphere(0, 8).faces, 0),))
    green = Material((0.0, 1.0, 0.0))
    scene = Scene((ball,), np.zeros(1, np.int32), IDENTITY[None], (green,), (), GREY, elements=warped())
    trace = Trace(scene, camera(scene), (16, 12), 1, ElementMarching(), 1, tmp_path)
    trace.complete()
    assert (trace.column("primitive") >= 0).any()


NO_TRIANGLES = "the scene has no triangles; its volume needs volume_marching or volume_path_tracing"


@pytest.mark.parametrize(
    ("scene", "integrator", "message"),
    [
        (alone(volume=fog(3, 3, 3)), PathTracing(), NO_TRIANGLES),
        (alone(volume=fog(3, 3, 3)), AmbientOcclusion(), NO_TRIANGLES),
        (garden(), VolumeMarching(), "the scene has no volume to march through"),
        (garden(), VolumePathTracing(), "the scene has no volume to track paths through"),
        (garden(), ElementMarching(), "the scene has no elements to march through"),
        (alone(volume=fog(3, 3, 3)), ElementMarching(), "the scene has no elements to march through"),
        (alone(elements=cube("mixed", 1)), VolumeMarching(), "the scene has no volume to march through"),
    ],
)  # fmt: skip
def test_a_scene_without_what_the_integrator_follows(scene: Scene, integrator: Integrator, message: str) -> None:
    with pytest.raises(SceneError) as caught:
        worlds.world(scene, integrator)
    assert str(caught.value) == message


def test_domains_that_do_not_fit_the_world_are_refused(tmp_path: Any) -> None:
    trace = made("marching", tmp_path)
    surfaces = made("paths", tmp_path)
    rows = np.zeros(1, np.int64), np.zeros(1, np.int16)
    with pytest.raises(SceneError, match="do not say which cells of a volume lie in them"):
        trace.world.cross(trace.geometry(0), rows[0], pieces(surfaces, DomainsCard()), rows[1], 1)
    bricks = pieces(trace, bricked(2))
    with pytest.raises(SceneError, match="do not say which triangles lie in them"):
        surfaces.world.cross(surfaces.geometry(0), rows[0], bricks, rows[1], 1)
