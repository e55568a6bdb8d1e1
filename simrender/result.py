"""What a simulation found, and what it owns up to."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from simrender.cards import UNCALIBRATED, Quantity
from simrender.errors import InvariantError
from simrender.hardware.machine import Machine
from simrender.policies.domain_frame import Event, Moment
from simrender.policies.frame import Frame
from simrender.rays.kinds import KINDS, SHADOW
from simrender.timeline import KERNELS, Timeline

if TYPE_CHECKING:
    import pandas as pd

    from simrender.rays.trace import Trace

LEFT_OUT = (
    (
        "loading the scene and building acceleration structures",
        "a frame of an animation or an interactive session has them",
    ),
    ("textures and alpha tests", "their cost is inside the calibrated trace rates, the same for every ray"),
    ("arithmetic of the shade, generate and tone-mapping kernels", "they are charged for the memory they move"),
    ("the display and the way to it", "the frame ends when its pixels are in order on GPU 0"),
)


@dataclass(frozen=True, eq=False)
class Result:
    """What a simulation found.

    Attributes
    ----------
    machine, workload, policy : str
    seed : int
    processor : str
        What renders: ``GPU``, or ``node`` on a machine without GPUs, whose nodes then count as GPUs below.
    gpus, islands, island_size, unused_gpus : int
        GPUs that were offered; islands and GPUs of each; GPUs that were left over.
    feasible : bool
        Whether the model and the queues fit. Where they do not, nothing was simulated: times and hashes are None.
    memory : dict
        ``needed_bytes`` (of the fullest GPU), ``capacity_bytes``, ``model_bytes`` and each buffer's bytes of that GPU;
        ``gpus_needed``, the smallest number of such GPUs that would do (None if none would).
    frame_time_s : float or None
    utilization : dict
        Share of the frame during which each device computes.
    busy_over_time : list of float
        Share of the processors that run kernels, in each hundredth of the frame.
    breakdown : dict
        Share of the frame that an average GPU spends on each kind of work, on copies, and waiting. Sums to 1.
    links : dict
        What each link that carried something did: ``bandwidth_bytes_per_s``, ``carried_bytes``, ``busy_s``, and of that
        bandwidth the ``mean_utilization`` over the frame and the ``peak_utilization``.
    counts : dict
        Rays, tests, bytes, kernels; ``published`` in a name means real ones, otherwise traced ones.
    sampling_error : dict
        ``relative_error`` of the frame time that comes from tracing fewer pixels than were published, and its parts.
    uncalibrated : list of dict
        The assumed and calibrated values that the result hangs on: path, value, status, source.
    scope : dict
        ``modelled`` and ``left_out``, with reasons.
    image_sha256, event_log_sha256 : str or None
    image : float32 array (height, width, 3) or None
    spans : Timeline or None
    loads : dict
        Of the same links, the ticks at which a load changed (int64 array), and the B/s from then on (float64 array).
    schedule, events : list
        Of schedulers of domains: the queues before each of the first steps, and every visit of a domain.

    """

    machine: str
    workload: str
    policy: str
    seed: int
    processor: str
    gpus: int
    islands: int
    island_size: int
    unused_gpus: int
    feasible: bool
    memory: dict[str, Any]
    frame_time_s: float | None = None
    utilization: dict[str, float] = field(default_factory=dict)
    busy_over_time: list[float] = field(default_factory=list)
    links: dict[str, dict[str, float]] = field(default_factory=dict)
    breakdown: dict[str, float] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)
    sampling_error: dict[str, Any] = field(default_factory=dict)
    uncalibrated: list[dict[str, str]] = field(default_factory=list)
    scope: dict[str, Any] = field(default_factory=dict)
    image_sha256: str | None = None
    event_log_sha256: str | None = None
    image: NDArray[np.float32] | None = None
    spans: Timeline | None = None
    loads: dict[str, tuple[NDArray[np.int64], NDArray[np.float64]]] = field(default_factory=dict)
    schedule: list[Moment] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)

    @property
    def busiest_link(self) -> str | None:
        """The link with the highest mean utilization, the first of equal ones; None if nothing was sent."""
        return max(self.links, key=lambda name: self.links[name]["mean_utilization"], default=None)

    @property
    def frames_per_s(self) -> float | None:
        """The reciprocal of the frame time."""
        return None if self.frame_time_s is None else 1.0 / self.frame_time_s

    @cached_property
    def timeline(self) -> pd.DataFrame:
        """Every span as a table: device, kind, start_s, end_s, bytes, rays."""
        return (self.spans or Timeline(0)).frame()

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the image, the timeline, the loads of links and the schedule, ready for JSON."""
        names = [n for n in self.__dataclass_fields__ if n not in {"image", "spans", "loads", "schedule", "events"}]
        facts = {name: getattr(self, name) for name in names}
        place = names.index("frame_time_s") + 1
        return dict([*list(facts.items())[:place], ("frames_per_s", self.frames_per_s), *list(facts.items())[place:]])


def sampling_error(frame: Frame) -> dict[str, Any]:
    """Estimate the error of tracing fewer pixels than were published, as a share of the frame time.

    Two effects are added in quadrature. A frame's time is nearly proportional to its rays; the traced pixels are a
    systematic sample of the image, so the variance of the mean number of rays a pixel is estimated from the differences
    of neighbours (Wolter, "Introduction to variance estimation", chapter 8), with the finite population correction. And
    ranks wait for the fullest queue: with few pixels a rank, queues differ by chance, by the square root of the weight
    more than they really would, so that the frame comes out too slow.
    """
    trace, published, owner = frame.trace, frame.published, frame.owner
    facts = rays_error(trace, published)
    of_rays, share = facts["rays_relative_standard_error"], min(1.0, trace.pixels / (published[0] * published[1]))
    if frame.wave_mean > 0.0:
        excess = frame.wave_excess / frame.wave_mean
    else:  # the ranks met only at the end
        rays = np.bincount(trace.column("pixel"), minlength=trace.pixels)
        by_rank = np.bincount(owner, rays, minlength=frame.layout.ranks)
        excess = float(by_rank.max() / by_rank.mean() - 1.0)
    of_waiting = excess * (1.0 - float(np.sqrt(share)))
    return facts | {"relative_error": float(np.hypot(of_rays, of_waiting)), "waiting_relative_bias": of_waiting}


def rays_error(trace: Trace, published: tuple[int, int]) -> dict[str, Any]:
    """Estimate the error of the number of rays, as a share of it, that comes from tracing fewer pixels."""
    rays = np.bincount(trace.column("pixel"), minlength=trace.pixels).astype(np.float64)
    rays = rays.reshape(trace.size[1], trace.size[0])
    differences = [np.diff(rays, axis=axis) for axis in (0, 1)]
    count = sum(d.size for d in differences)
    variance = sum(float((d * d).sum()) for d in differences) / (2.0 * count) if count else 0.0
    share = min(1.0, trace.pixels / (published[0] * published[1]))
    of_rays = float(np.sqrt(variance * (1.0 - share) / trace.pixels) / rays.mean())
    return {
        "relative_error": of_rays,
        "rays_relative_standard_error": of_rays,
        "waiting_relative_bias": 0.0,
        "traced_pixels": trace.pixels,
        "published_pixels": published[0] * published[1],
    }


def share_of_kinds(timeline: Timeline, frame_time_s: float) -> dict[str, float]:
    """Return shares of the frame for an average rank whose phases follow one another: they add up."""
    shares = {k: sum(s) / len(s) / frame_time_s for k, s in timeline.seconds_by_kind().items()}
    merged = {
        "load": shares["load"],
        "trace": shares["trace"],
        "copy": shares["copy"] + shares["merge"],
        "sync": shares["sync"],
    }
    return {**merged, "wait": max(0.0, 1.0 - sum(merged.values()))}


def breakdown(timeline: Timeline, frame_time_s: float) -> dict[str, float]:
    """Return shares of the frame for an average GPU. A GPU never computes and copies at once, so they add up."""
    shares = {k: sum(s) / len(s) / frame_time_s for k, s in timeline.seconds_by_kind().items()}
    merged = {
        "trace": shares["trace"],
        "shade": shares["shade"] + shares["generate"] + shares["tonemap"] + shares["assemble"],
        "copy": shares["copy"] + shares["merge"],
    }
    wait = 1.0 - sum(merged.values())
    if wait < -1e-9:
        raise InvariantError(f"the GPUs worked for {1.0 - wait:.3f} of the frame")
    return {**merged, "wait": max(0.0, wait)}


def counts(frame: Frame, machine: Machine) -> dict[str, float]:
    """Return how much of everything there was."""
    trace, weight = frame.trace, frame.weight * frame.repeats
    kinds = np.bincount(trace.column("kind"), minlength=len(KINDS))
    occluded = int(np.isfinite(trace.column("t")[trace.column("kind") == SHADOW]).sum())
    log = frame.timeline
    kind = np.array(log.kind)
    return {
        "traced_paths": int(kinds[0]),
        "traced_rays": trace.rays,
        **{f"traced_{name}_rays": int(n) for name, n in zip(KINDS, kinds, strict=True)},
        "traced_occluded_shadow_rays": occluded,
        "published_paths": int(kinds[0]) * weight,
        "published_rays": trace.rays * weight,
        "ray_weight": weight,
        "generations": trace.generations,
        "traced_ray_domain_tests": frame.tests,
        "traced_skipped_ray_domain_tests": frame.skipped_tests,
        "kernels": int((kind < len(KERNELS)).sum()),
        "trace_kernels": int((kind == KERNELS.index("trace")).sum()),
        "copies": int((kind >= len(KERNELS)).sum()),
        "published_copied_bytes": float(
            sum(b for b, k in zip(log.nbytes, log.kind, strict=True) if k >= len(KERNELS) or KERNELS[k] == "trace")
        ),
        "network_bytes": machine.network.sent_bytes if machine.has_network else 0.0,
        "spans": len(log),
    }


def links(machine: Machine) -> dict[str, dict[str, float]]:
    """Return what the links that carried something did."""
    if not machine.has_network:
        return {}
    return {
        str(name): {"bandwidth_bytes_per_s": float(machine.topology.links[name].bandwidth), **dataclasses.asdict(use)}
        for name, use in machine.network.use.items()
        if use.carried_bytes > 0.0
    }


def owned_up(quantities: list[tuple[str, Quantity]]) -> list[dict[str, str]]:
    """Return the assumed and calibrated ones among the given quantities."""
    return [
        {"path": path, "value": q.text, "status": q.status, "source": q.source}
        for path, q in quantities
        if q.status in UNCALIBRATED
    ]


def scope(machine: Machine, island_size: int) -> dict[str, Any]:
    """Return what was modelled, and what was left out, with the reasons."""
    card, count = machine.card, len(machine.processors)
    if card.gpus:
        modelled = [f"{count} GPUs, one stream each: kernel launch, saturation, memory"]
        hosts = "thread" if machine.nodes == 1 else "thread of each node"
        modelled.append(f"the host {hosts} that issues kernels and copies one after the other")
    else:
        modelled = [f"{count} nodes, all cores of each as one processor: saturation, memory"]
    left_out = [{"what": what, "why": why} for what, why in LEFT_OUT]
    fabrics = [name for name in ("nvlink", "pcie") if card.gpus > 1 and getattr(card, name)]
    if machine.has_network:
        users = "ray queues and finished pixels" if island_size > 1 else "finished pixels"
        if machine.nodes > 1 and card.network:
            fabrics.append(card.network.technology)
        what = "GPUs" if card.gpus else "nodes"
        modelled.append(f"{' and '.join(fabrics)} between the {what}, shared max-min fairly by the copies of {users}")
        if machine.nodes > 1:
            modelled.append("the hosts' allgather of queue counters")
            why = "a rank goes on when its messages have arrived; the queue counters pay for the rest"
            left_out.append({"what": "barriers between nodes", "why": why})
            if card.gpus and card.network and not card.network.gpu_direct:
                modelled.append("staging through the memory of both hosts, which costs two more links")
    else:
        unused = " and ".join(fabrics) or "the way between processors"
        left_out.append({"what": unused, "why": "one GPU sends nothing" if card.gpus else "one node sends nothing"})
    if card.variability:
        modelled.append(f"nodes that differ in speed by {card.variability.spread.text}")
    if card.disturbances:
        modelled.append(f"{len(card.disturbances)} disturbances of links")
    return {"modelled": modelled, "left_out": left_out}
