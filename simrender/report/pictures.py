"""Pictures of a trace: false colour by domain or rank, heat maps of work and of the error of sampling."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simrender.rays.integrators import ElementMarching, VolumeMarching
from simrender.report.tracing import unit_of_work

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from simrender.rays.crossings import Crossings
    from simrender.rays.domains import Domains
    from simrender.rays.estimate import Estimate
    from simrender.rays.trace import Trace

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


def hues(count: int) -> F64:
    """Return a colour for each of some domains, linear RGB, float64 (count, 3): neighbouring numbers differ a lot."""
    golden = 0.618033988749895  # steps by the golden ratio never come close to each other for long
    hue = (0.08 + golden * np.arange(count)) % 1.0
    value = 0.95 - 0.3 * ((np.arange(count) * 7) % 4) / 3.0
    ramp = np.abs((hue[:, None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0
    rgb: F64 = (value[:, None] * (1.0 - 0.75 * (1.0 - np.clip(ramp, 0.0, 1.0)))) ** 2.2
    return rgb


def domain_picture(trace: Trace, crossings: Crossings, group: NDArray[np.integer[Any]] | None = None) -> F32:
    """Paint what each camera ray sees in the colour of the domain that it sees it in, as the papers do.

    Parameters
    ----------
    trace : Trace
    crossings : Crossings
    group : int array (domains,), optional
        Paint by these, ranks for instance, in place of the domains.

    Returns
    -------
    float32 array (height, width, 3)

    """
    domains = crossings.domains
    number = np.arange(domains.count) if group is None else np.asarray(group)
    paint = hues(int(number.max()) + 1)[number]
    if isinstance(trace.integrator, VolumeMarching | ElementMarching):
        seen = _fragments(trace, domains, paint, crossings)
    else:
        seen = _surfaces(trace, crossings, paint)
    pixel = trace.geometry(0)["pixel"]
    sums = [np.bincount(pixel, seen[:, c], minlength=trace.pixels) for c in range(3)]
    image = np.stack(sums, axis=1) / trace.samples
    return image.reshape(trace.size[1], trace.size[0], 3).astype(np.float32)


_NOTHING = 0.92
"""Brightness of the background."""

_THIN = 0.4
"""Power of the opacity that a thin medium is shown with."""


def _surfaces(trace: Trace, crossings: Crossings, paint: F64) -> F64:
    """Return what each camera ray sees: the domain of its nearest hit, lit from the viewer where there is a normal."""
    count, domains = trace.first[1], crossings.domains
    t, primitive = trace.column("t")[:count], trace.column("primitive")[:count]
    owner = np.full(count, -1, np.int64)
    if domains.domain_of_triangle is not None:
        on = np.flatnonzero(primitive >= 0)
        owner[on] = domains.domain_of_triangle[primitive[on]]
    inside = np.flatnonzero(np.isfinite(t) & (owner < 0))
    if len(inside):  # in the medium, or on an isosurface: the last domain entered before the event
        table = crossings.table(0)
        ray = np.repeat(np.arange(count), np.diff(table["first"]))
        before = table["entry"] <= t[ray] * np.float32(1.0 + 1e-6)
        last = np.full(count, -1, np.int64)
        np.maximum.at(last, ray[before], np.flatnonzero(before))
        inside = inside[last[inside] >= 0]
        owner[inside] = table["domain"][last[inside]]
    seen = np.full((count, 3), _NOTHING)
    shown = np.flatnonzero(owner >= 0)
    light = np.ones(len(shown))
    on = np.flatnonzero(primitive[shown] >= 0)
    if len(on):
        corners = trace.scene.triangles.vertices[trace.scene.triangles.faces[primitive[shown[on]]]].astype(np.float64)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normal, axis=1)
        facing = np.abs((normal * trace.geometry(0)["direction"][shown[on]]).sum(axis=1))
        light[on] = 0.25 + 0.75 * facing / np.where(length > 0.0, length, 1.0)
    seen[shown] = paint[owner[shown]] * light[:, None]
    return seen


def _fragments(trace: Trace, domains: Domains, paint: F64, crossings: Crossings) -> F64:
    """Return what each camera ray sees: the fragments of all domains, tinted."""
    from simrender.rays.compositing import composite

    table, rays, world = crossings.table(0), trace.geometry(0), trace.world
    count = trace.first[1]
    ray = np.repeat(np.arange(count), np.diff(table["first"]))
    if isinstance(trace.integrator, ElementMarching):
        in_front = world.backdrop.in_front(rays)  # type: ignore[attr-defined]
        found = world.fragments(in_front, ray, table["domain"])  # type: ignore[attr-defined]
        rgba, entry, owner, domain = found.rgba, found.entry, ray[found.row], table["domain"][found.row]
    else:
        made = world.cross(rays, ray, domains, table["domain"], trace.seed)
        rgba, entry, owner, domain = made["rgba"], table["entry"], ray, table["domain"]
    # The fragment keeps its opacity and its brightness, and takes its domain's hue.
    brightness = rgba[:, :3].max(axis=1, keepdims=True)
    tinted = np.concatenate([paint[domain] * (0.35 * rgba[:, 3:] + 0.65 * brightness), rgba[:, 3:]], axis=1)
    image = composite(tinted.astype(np.float32), entry, owner, domain, count).astype(np.float64)
    behind = np.full((count, 3), _NOTHING)
    hits = world.backdrop.hits(rays)  # type: ignore[attr-defined]
    if hits is not None and domains.domain_of_triangle is not None:
        on = np.flatnonzero(hits.primitive >= 0)
        behind[on] = paint[domains.domain_of_triangle[hits.primitive[on]]]
    # A thin medium would leave no more than a breath of colour.
    opacity = image[:, 3:]
    shown = opacity**_THIN
    tint = image[:, :3] / np.where(opacity > 0.0, opacity, 1.0)
    return np.asarray(tint * shown + (1.0 - shown) * behind, np.float64)


def work_of_pixels(trace: Trace, crossings: Crossings) -> tuple[F64, str]:
    """Return the work of each pixel, float64 (height, width), and what it is counted in.

    Through volumes that is samples, look-ups or elements. On surfaces it is queries: for each ray, camera ray or
    descendant, the domains that it enters before it hits something.
    """
    if trace.world.outcome:
        volume = np.bincount(trace.column("pixel"), trace.column("work"), minlength=trace.pixels).astype(np.float64)
        return volume.reshape(trace.size[1], trace.size[0]), unit_of_work(trace)
    work: F64 = np.zeros(trace.pixels)
    for generation in range(trace.generations):
        rays = slice(trace.first[generation], trace.first[generation + 1])
        table, t, pixel = crossings.table(generation), trace.column("t")[rays], trace.column("pixel")[rays]
        ray = np.repeat(np.arange(len(t)), np.diff(table["first"]))
        before = table["entry"] <= t[ray]
        work += np.bincount(pixel, np.bincount(ray[before], minlength=len(t)), minlength=trace.pixels)
    return work.reshape(trace.size[1], trace.size[0]), "queries of a ray in a domain"


def plot_heat(values: F64, title: str, label: str) -> Figure:
    """Draw a value a pixel as a heat map with its scale."""
    from matplotlib.figure import Figure

    height, width = values.shape
    figure = Figure(figsize=(8.0, min(max(2.2, 6.6 * height / width + 1.0), 16.0)), layout="constrained")
    axes = figure.add_subplot()
    drawn = axes.imshow(values, cmap="inferno", interpolation="nearest", vmin=0.0)
    axes.set_title(title, loc="left", fontsize=11)
    axes.set_xticks([])
    axes.set_yticks([])
    figure.colorbar(drawn, ax=axes, label=label, shrink=0.9)
    return figure


def plot_work(name: str, trace: Trace, crossings: Crossings) -> Figure:
    """Draw how much work each traced pixel is."""
    work, unit = work_of_pixels(trace, crossings)
    return plot_heat(
        work, f"{name}: work of each pixel, {work.mean():,.1f} on average, {work.max():,.0f} at most", unit
    )


def plot_error(name: str, image: Estimate) -> Figure:
    """Draw the standard error of each pixel's radiance as replicas show it."""
    error = image.standard_error.mean(axis=2)
    mean = float(image.mean.mean())
    share = float(np.sqrt((error**2).mean())) / mean if mean > 0.0 else 0.0
    title = f"{name}: standard error of each pixel, {image.replicas} replicas; root mean square {share:.1%} of the mean"
    return plot_heat(error, title, "standard error of the mean radiance")
