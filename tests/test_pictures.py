"""Pictures of a trace: whose colour a pixel has, sums that agree with the counters, and no chance in any of them."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from simrender.rays.crossings import Crossings
from simrender.rays.domains import Domains, morton_ranks
from simrender.rays.estimate import estimate, seeds
from simrender.rays.integrators import AmbientOcclusion, PathTracing, VolumeMarching
from simrender.rays.trace import Trace
from simrender.rays.workload_card import DomainsCard
from simrender.report.files import write_figure
from simrender.report.pictures import domain_picture, hues, plot_error, plot_heat, plot_work, work_of_pixels
from simrender.report.tracing import trace_dict
from tests.conftest import Ran
from tests.rays.test_worlds import MARCHING, SCENES, SURFACES, TRACKING, alone, camera, everywhere, fog, pieces
from tests.scenes import garden, garden_workload
from tests.test_trace_command import example

BACKGROUND = np.float32(0.92)


def taken(name: str, cache: Path, samples: int = 1, size: tuple[int, int] = (32, 20)) -> tuple[Trace, Crossings]:
    build, integrator, card = SCENES[name]
    scene = build()
    trace = Trace(scene, camera(scene), size, samples, integrator, 3, cache, jitter=False)
    trace.complete()
    return trace, Crossings(trace, pieces(trace, card))


def queries(trace: Trace, crossings: Crossings) -> int:
    """Count, ray by ray and row by row, the domains that rays enter before they hit something."""
    count = 0
    for generation in range(trace.generations):
        table = crossings.table(generation)
        for ray, t in enumerate(trace.column("t")[trace.first[generation] : trace.first[generation + 1]]):
            count += int((table["entry"][table["first"][ray] : table["first"][ray + 1]] <= t).sum())
    return count


# Domains in false colour


@pytest.mark.parametrize("name", SCENES)
def test_a_picture_has_the_traced_size_and_is_the_same_each_time(name: str, tmp_path: Path) -> None:
    trace, crossings = taken(name, tmp_path / "a")
    image = domain_picture(trace, crossings)
    assert (image.shape, image.dtype) == ((20, 32, 3), np.float32)
    assert np.isfinite(image).all()
    assert (image >= 0.0).all()
    assert (image <= 1.0).all()
    again = domain_picture(*taken(name, tmp_path / "a"))  # from the cache
    other = domain_picture(*taken(name, tmp_path / "b"))
    assert np.array_equal(again, image)
    assert np.array_equal(other, image)
    assert np.array_equal(domain_picture(trace, crossings), image)


@pytest.mark.parametrize("name", SCENES)
def test_rays_that_meet_nothing_see_the_background_and_no_others_do(name: str, tmp_path: Path) -> None:
    trace, crossings = taken(name, tmp_path)
    image = domain_picture(trace, crossings).reshape(-1, 3)
    missed = ~np.isfinite(trace.column("t")[: trace.pixels])
    assert 0 < missed.sum() < trace.pixels
    assert (image[missed] == BACKGROUND).all()
    assert (np.abs(image[~missed] - BACKGROUND) > 1e-6).any(axis=1).all()


@pytest.mark.parametrize("name", SURFACES)
def test_a_pixel_has_the_hue_of_the_domain_of_its_nearest_triangle(name: str, tmp_path: Path) -> None:
    trace, crossings = taken(name, tmp_path)
    image = domain_picture(trace, crossings).reshape(-1, 3).astype(float)
    primitive = trace.column("primitive")[: trace.pixels]
    on = np.flatnonzero(primitive >= 0)
    owner = crossings.domains.domain_of_triangle
    assert owner is not None
    paint = hues(crossings.domains.count)[owner[primitive[on]]]
    light = image[on].max(axis=1) / paint.max(axis=1)
    assert image[on] == pytest.approx(paint * light[:, None], abs=1e-6)
    assert light.min() >= 0.25 - 1e-6
    assert light.max() <= 1.0 + 1e-6
    assert len(np.unique(owner[primitive[on]])) > 1


@pytest.mark.parametrize("name", TRACKING)
def test_a_path_is_painted_by_the_brick_it_collides_in(name: str, tmp_path: Path) -> None:
    trace, crossings = taken(name, tmp_path)
    image = domain_picture(trace, crossings).reshape(-1, 3).astype(float)
    ray, domain, found = everywhere(trace, 0, crossings.domains)
    t = trace.column("t")[: trace.pixels]
    mine = np.isfinite(found["hit"]) & (found["hit"] == t[ray]) & (trace.column("primitive")[: trace.pixels][ray] < 0)
    paint = hues(crossings.domains.count)
    right = np.abs(image[ray[mine]] - paint[domain[mine]]).max(axis=1) < 1e-6
    # A collision on a face by a rounding may be painted as the neighbour's.
    assert mine.sum() > 20
    assert right.mean() > 0.98


def test_domains_differ_by_colour() -> None:
    paint = hues(64)
    assert paint.shape == (64, 3)
    assert ((paint >= 0.0) & (paint <= 1.0)).all()
    near = np.abs(paint[:, None] - paint[None]).sum(axis=2)[~np.eye(64, dtype=bool)]
    assert near.min() > 0.005
    assert np.abs(np.diff(paint, axis=0)).sum(axis=1).min() > 0.3  # neighbours are far apart
    assert np.array_equal(hues(200)[:64], paint)


def colours(image: np.ndarray, paint: np.ndarray) -> set[int]:
    """The entries of a palette that lit pixels have the hue of."""
    lit = image.reshape(-1, 3)[(image.reshape(-1, 3) != BACKGROUND).any(axis=1)].astype(float)
    lit /= np.linalg.norm(lit, axis=1, keepdims=True)
    return set(np.argmax(lit @ (paint / np.linalg.norm(paint, axis=1, keepdims=True)).T, axis=1).tolist())


@pytest.mark.parametrize("ranks", [1, 2, 3, 50])
def test_there_are_no_more_colours_than_ranks(ranks: int, tmp_path: Path) -> None:
    trace, crossings = taken("paths", tmp_path)
    domains = crossings.domains
    group = morton_ranks(domains.low, domains.high, ranks)
    image = domain_picture(trace, crossings, group)
    assert domain_picture(trace, crossings).shape == image.shape
    assert len(colours(image, hues(max(ranks, 7)))) <= min(ranks, domains.count)
    # Painted by rank is painted by domain with the ranks' numbers.
    assert np.array_equal(domain_picture(trace, crossings, np.arange(domains.count)), domain_picture(trace, crossings))


def test_samples_of_a_pixel_are_blended(tmp_path: Path) -> None:
    trace, crossings = taken("paths", tmp_path)
    workload = garden_workload("32x20", "32x20", samples=4, cache=tmp_path)
    rays = workload.trace()
    rays.complete()
    image = domain_picture(rays, workload.domain_crossings(1, workload.domains(DomainsCard(method="sah", count=5))))
    missed = ~np.isfinite(rays.column("t")[: rays.first[1]]).reshape(4, -1)
    assert (image.reshape(-1, 3)[missed.all(axis=0)] == BACKGROUND).all()
    mixed = missed.any(axis=0) & ~missed.all(axis=0)
    assert mixed.any()
    assert (image.reshape(-1, 3)[mixed] != BACKGROUND).any(axis=1).all()
    assert domain_picture(trace, crossings).shape == image.shape


def test_bricks_of_one_volume_in_one_domain_are_one_hue(tmp_path: Path) -> None:
    scene = alone(volume=fog())
    trace = Trace(scene, camera(scene), (24, 18), 1, VolumeMarching(), 1, tmp_path)
    trace.complete()
    one = domain_picture(trace, Crossings(trace, pieces(trace, DomainsCard(method="kd_bricks", count=1))))
    eight = Crossings(trace, pieces(trace, DomainsCard(method="kd_bricks", count=8)))
    assert np.abs(domain_picture(trace, eight, np.zeros(8, int)) - one).max() < 0.05  # a fragment's brightest channel
    assert np.abs(domain_picture(trace, eight) - one).max() > 0.1


def test_an_empty_picture(tmp_path: Path) -> None:
    scene = garden()
    away = camera(scene)
    away[1] = -away[1]
    trace = Trace(scene, away, (9, 7), 2, PathTracing(), 1, tmp_path)
    trace.complete()
    crossings = Crossings(trace, pieces(trace, DomainsCard(method="sah", count=4)))
    assert (domain_picture(trace, crossings) == BACKGROUND).all()
    work, unit = work_of_pixels(trace, crossings)
    assert (work.sum(), unit) == (0.0, "queries of a ray in a domain")
    assert drawn(plot_work("nothing", trace, crossings)).size[0] > 400


# Work


@pytest.mark.parametrize("name", SCENES)
def test_the_work_of_all_pixels_is_what_the_counters_say(name: str, tmp_path: Path) -> None:
    trace, crossings = taken(name, tmp_path, samples=2)
    work, unit = work_of_pixels(trace, crossings)
    assert work.shape == (20, 32)
    workload = garden_workload()
    counted = trace_dict(workload, trace, crossings)
    if name in SURFACES:
        assert unit == "queries of a ray in a domain"
        assert work.sum() == queries(trace, crossings)
        assert "work" not in counted
    else:
        assert unit == ("samples" if name in MARCHING else "look-ups" if name in TRACKING else "elements")
        assert work.sum() == counted["work"] == trace.column("work").sum()
        assert counted["work_unit"] == unit
    pixel = int(work.argmax())
    own = trace.column("pixel") == pixel
    assert own.sum() >= 2
    if name not in SURFACES:
        assert work.ravel()[pixel] == trace.column("work")[own].sum()


def test_one_domain_is_one_query_a_ray_that_enters_it(tmp_path: Path) -> None:
    trace, _ = taken("paths", tmp_path)
    crossings = Crossings(trace, pieces(trace, DomainsCard(method="sah", count=1)))
    work, _ = work_of_pixels(trace, crossings)
    assert work.sum() == sum(len(crossings.table(g)["domain"]) for g in range(trace.generations))
    finer, _ = work_of_pixels(trace, Crossings(trace, pieces(trace, DomainsCard(method="sah", count=12))))
    assert finer.sum() > work.sum()


# Figures


def drawn(figure: Any) -> Image.Image:
    file = io.BytesIO()
    figure.savefig(file, format="png")
    return Image.open(file)


@pytest.mark.parametrize("size", [(32, 20), (1, 1), (300, 2), (2, 300)])
def test_heat_maps_of_any_shape_are_drawn(size: tuple[int, int]) -> None:
    values = np.arange(float(size[0] * size[1])).reshape(size[1], size[0])
    figure = plot_heat(values, "a title", "a unit")
    axes, bar = figure.axes
    assert axes.get_title(loc="left") == "a title"
    assert bar.get_ylabel() == "a unit"
    (image,) = axes.get_images()
    assert np.array_equal(np.asarray(image.get_array()), values)
    assert image.get_clim() == (0.0, values.max()) or values.max() == 0.0
    picture = drawn(figure)
    assert picture.width >= 700
    assert 200 <= picture.height <= 2000


def test_the_figure_of_work_says_how_much(tmp_path: Path) -> None:
    trace, crossings = taken("marching", tmp_path)
    figure = plot_work("fog", trace, crossings)
    work = trace.column("work")
    assert figure.axes[0].get_title(loc="left") == (
        f"fog: work of each pixel, {work.mean():,.1f} on average, {work.max():,.0f} at most"
    )
    assert figure.axes[1].get_ylabel() == "samples"


def test_the_figure_of_the_error_is_the_spread_of_replicas(tmp_path: Path) -> None:
    workload = garden_workload("32x20", "32x20", cache=tmp_path)
    images = []
    for seed in seeds(1, 5):
        workload.trace(seed).complete()
        images.append(workload.trace(seed).image())
    found = estimate(images)
    figure = plot_error("garden", found)
    values = np.asarray(figure.axes[0].get_images()[0].get_array())
    assert values.shape == (20, 32)
    assert values == pytest.approx(np.std(images, axis=0, ddof=1).mean(axis=2) / 5**0.5, rel=1e-5, abs=1e-9)
    share = np.sqrt((values**2).mean()) / np.mean(images)
    assert figure.axes[0].get_title(loc="left") == (
        f"garden: standard error of each pixel, 5 replicas; root mean square {share:.1%} of the mean"
    )
    assert 0.01 < share < 2.0
    still = plot_error("garden", estimate([images[0]] * 3))
    assert "root mean square 0.0% of the mean" in still.axes[0].get_title(loc="left")
    assert "0.0% of the mean" in plot_error("black", estimate([0.0 * images[0]] * 2)).axes[0].get_title(loc="left")


def test_a_figure_is_the_same_file_each_time(tmp_path: Path) -> None:
    trace, crossings = taken("occlusion", tmp_path)
    assert isinstance(trace.integrator, AmbientOcclusion)
    files = [tmp_path / "a.png", tmp_path / "b.png"]
    for file in files:
        write_figure(file, plot_work("garden", trace, crossings))
    assert files[0].read_bytes() == files[1].read_bytes()


def test_boxes_alone_say_where_a_collision_lies(tmp_path: Path) -> None:
    trace, crossings = taken("tracking", tmp_path)
    given = crossings.domains
    boxes = Domains(given.low, given.high, given.bytes, given.primitives)
    assert np.array_equal(domain_picture(trace, Crossings(trace, boxes)), domain_picture(trace, crossings))


# What the command line writes


@pytest.mark.parametrize("size", [(64, 36), (32, 18), (5, 7)])
@pytest.mark.parametrize("show", [[], ["--show", "domains"], ["--show", "domains", "--ranks", 3]])
def test_an_image_has_the_traced_size(
    run_cli: Callable[..., Ran], tiny_card: Path, tmp_path: Path, size: tuple[int, int], show: list[object]
) -> None:
    width, height = size
    ran = run_cli("trace", tiny_card, "--resolution", f"{width}x{height}", "--image", tmp_path / "a.png", *show)
    assert ran.code == 0
    assert f"wrote {tmp_path / 'a.png'} ({width}x{height})\n" in ran.err
    with Image.open(tmp_path / "a.png") as picture:
        assert (picture.format, picture.size, picture.mode) == ("PNG", size, "RGB")
    first = (tmp_path / "a.png").read_bytes()
    run_cli("trace", tiny_card, "--resolution", f"{width}x{height}", "--image", tmp_path / "a.png", *show)
    assert (tmp_path / "a.png").read_bytes() == first


def test_ranks_paint_with_fewer_colours_than_domains(
    run_cli: Callable[..., Ran], tiny_card: Path, tmp_path: Path
) -> None:
    """Which of red, green and blue is brighter than which tells the hues of a few ranks apart."""
    orders = []
    for ranks in ([], ["--ranks", 1], ["--ranks", 2], ["--ranks", 99]):
        run_cli("trace", tiny_card, "--domains", "4x2x1", "--show", "domains", "--image", tmp_path / "a.png",
                "--set", "workload.traced.samples=1", *ranks)  # fmt: skip
        with Image.open(tmp_path / "a.png") as picture:
            pixels = np.asarray(picture).reshape(-1, 3).astype(int)
        orders.append(len({tuple(c) for c in np.argsort(pixels[np.ptp(pixels, axis=1) > 30], axis=1).tolist()}))
    assert orders[1:3] == [1, 2]
    assert orders[0] > 2
    assert orders[3] > 2  # a rank for each domain


@pytest.mark.parametrize("show", ["work", "error"])
@pytest.mark.parametrize("what", ["mesh", "fog", "elements"])
def test_figures(run_cli: Callable[..., Ran], tiny_card: Path, tmp_path: Path, show: str, what: str) -> None:
    scene = {"mesh": tiny_card, "fog": example("uniform.vtk"), "elements": example("hexbeam.vtk")}[what]
    ran = run_cli(
        "trace",
        scene,
        "--resolution",
        "32x18",
        "--show",
        show,
        "--image",
        tmp_path / "f.png",
        "--set",
        "workload.traced.samples=1",
    )
    assert ran.code == 0, ran
    assert ("from 4 independent replicas" in ran.out) == (show == "error")
    with Image.open(tmp_path / "f.png") as picture:
        assert picture.width == 1200
        assert 300 < picture.height < 2500


def test_the_note_of_a_figure_names_its_own_size(run_cli: Callable[..., Ran], tiny_card: Path, tmp_path: Path) -> None:
    ran = run_cli("trace", tiny_card, "--show", "work", "--image", tmp_path / "f.png")
    assert "(64x36)" not in ran.err


def test_the_error_of_as_many_replicas_as_asked(run_cli: Callable[..., Ran], tiny_card: Path, tmp_path: Path) -> None:
    ran = run_cli(
        "trace", tiny_card, "--resolution", "32x18", "--replicas", 2, "--show", "error", "--image", tmp_path / "f.png"
    )
    assert "from 2 independent replicas" in ran.out
