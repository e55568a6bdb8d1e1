"""``simulate(machine, workload, policy, ...) -> Result``: the schedulers drive a trace over a machine."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.cards import UNCALIBRATED, Document, Quantity
from simrender.catalog import find_policy
from simrender.clock import to_seconds
from simrender.errors import InvariantError, UsageError
from simrender.hardware.machine import Machine, MachineCard, check_gpus, load_machine
from simrender.policies.islands import Fit, fit
from simrender.policies.rank import Frame, Policy, Rank
from simrender.rays.kinds import KINDS, SHADOW
from simrender.rays.partition import Footprint, Method, Partition
from simrender.rays.trace import Progress, Trace
from simrender.rays.workload import Workload, load_workload
from simrender.timeline import KERNELS, Timeline

if TYPE_CHECKING:
    import pandas as pd

Islands = int | Literal["auto"]

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
    breakdown : dict
        Share of the frame that an average GPU spends on each kind of work, on copies, and waiting. Sums to 1.
    counts : dict
        Rays, tests, bytes, kernels; ``published`` in a name means real ones, otherwise traced ones.
    sampling_error : dict
        ``relative_standard_error`` of the rays of a frame (and so of its time), and how it was estimated.
    uncalibrated : list of dict
        The assumed and calibrated values that the result hangs on: path, value, status, source.
    scope : dict
        ``modelled`` and ``left_out``, with reasons.
    image_sha256, event_log_sha256 : str or None

    """

    machine: str
    workload: str
    policy: str
    seed: int
    gpus: int
    islands: int
    island_size: int
    unused_gpus: int
    feasible: bool
    memory: dict[str, Any]
    frame_time_s: float | None = None
    utilization: dict[str, float] = field(default_factory=dict)
    breakdown: dict[str, float] = field(default_factory=dict)
    counts: dict[str, float] = field(default_factory=dict)
    sampling_error: dict[str, Any] = field(default_factory=dict)
    uncalibrated: list[dict[str, str]] = field(default_factory=list)
    scope: dict[str, Any] = field(default_factory=dict)
    image_sha256: str | None = None
    event_log_sha256: str | None = None
    image: NDArray[np.float32] | None = None
    spans: Timeline | None = None

    @property
    def frames_per_s(self) -> float | None:
        """The reciprocal of the frame time."""
        return None if self.frame_time_s is None else 1.0 / self.frame_time_s

    @cached_property
    def timeline(self) -> pd.DataFrame:
        """Every span as a table: device, kind, start_s, end_s, bytes, rays."""
        return (self.spans or Timeline(0)).frame()

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the image and the timeline, ready for JSON."""
        names = [n for n in self.__dataclass_fields__ if n not in {"image", "spans"}]
        facts = {name: getattr(self, name) for name in names}
        place = names.index("frame_time_s") + 1
        return dict([*list(facts.items())[:place], ("frames_per_s", self.frames_per_s), *list(facts.items())[place:]])


def simulate(
    machine: str | MachineCard,
    workload: str | Workload,
    policy: str | Policy | None = None,
    *,
    islands: Islands = "auto",
    gpus: int | None = None,
    seed: int = 1,
    overrides: Mapping[str, Sequence[str]] | None = None,
    cache: Path | None = None,
    progress: Progress | None = None,
) -> Result:
    """Render one frame of a workload on a machine under a scheduler, in simulated time.

    Parameters
    ----------
    machine : str or MachineCard
        Name or path of a card.
    workload : str or Workload
        Name or path of a card, or path of a mesh file. A `Workload` that is passed again keeps what was traced.
    policy : str or Policy, optional
        By default the workload card's own.
    islands : int or "auto"
        How many; ``auto`` takes as many as the fewest GPUs that hold the model allow.
    gpus : int, optional
        How many of the machine's GPUs to use; all by default.
    seed : int
        Of all random numbers of the traced rays.
    overrides : mapping, optional
        For ``"machine"``, ``"workload"`` and ``"policy"``, assignments such as ``nvlink.bandwidth=300 GB/s``.
    cache : Path, optional
        Folder of the trace cache; by default ``$SIMRENDER_CACHE`` or ``~/.cache/simrender``.
    progress : callable, optional
        Called with (generation, rays traced, rays in it) while rays are really traced.

    Returns
    -------
    Result

    Raises
    ------
    SimrenderError
        With a message for the user, whatever is wrong with the input.
    InvariantError
        If a policy lost or repeated a ray, or made another image than the reference renderer.

    """
    given = overrides or {}
    card = load_machine(machine, given.get("machine", ())) if isinstance(machine, str) else machine
    count = check_gpus(card, gpus)
    if islands != "auto" and not 1 <= islands <= count:
        raise UsageError(f"--islands {islands}: {count} GPUs make 1 to {count} islands, or auto")
    if seed < 0:
        raise UsageError(f"--seed {seed}: a seed is not negative")
    if isinstance(workload, str):
        workload = load_workload(workload, given.get("workload", ()), cache)
    name, scheduler = _policy(policy, workload, given.get("policy", ()))
    if scheduler.replicated and islands not in {"auto", count}:
        raise UsageError(
            f"--islands {islands}: {name} holds the whole model on every GPU, so every GPU is an island; "
            f"use a data-parallel policy such as ray_queue_cycling"
        )

    chosen, partition, memory = _place(card, workload, scheduler, count, islands)
    layout = chosen.layout
    facts: dict[str, Any] = {
        "machine": machine if isinstance(machine, str) else card.title,
        "workload": workload.name,
        "policy": name,
        "seed": seed,
        "gpus": count,
        "islands": layout.islands,
        "island_size": layout.size,
        "unused_gpus": count - layout.ranks,
        "feasible": chosen.feasible,
        "memory": memory,
    }
    if not chosen.feasible:
        return Result(**facts, uncalibrated=_owned_up(list(workload.card.quantities("workload."))))

    env = simpy.Environment()
    devices = Machine(env, card, layout.ranks)
    trace = workload.trace(seed, progress)
    frame = Frame(
        env, devices, layout, trace, partition, scheduler, Timeline(layout.ranks),
        visited=_visited(workload, partition, scheduler, seed, lambda: frame.owner),
        weight=workload.weight, published=workload.card.published.resolution,
    )  # fmt: skip
    buffers = _buffers(scheduler, workload, layout.ranks)
    ranks = []
    for index in range(layout.ranks):
        gpu = devices.processor(index)
        gpu.allocate("the model", float(partition.weight_bytes[layout.domain(index)]))
        for what, nbytes in buffers[index].items():
            gpu.allocate(what, nbytes)
        ranks.append(env.process(scheduler.rank(Rank(frame, index))))
    env.run(env.all_of(ranks))
    frame_time_s = to_seconds(int(env.now))

    trace.complete()
    retired = np.concatenate(frame.retired)
    _check_retired(trace, retired)
    image = trace.image(np.sort(retired))
    image_sha256 = _hash(image)
    if image_sha256 != _hash(reference_image(trace)):
        raise InvariantError(f"{name} rendered another image than the reference renderer")
    if layout.size > 1:
        workload.crossings(seed, partition).save()

    used = [*devices.quantities(), *workload.card.quantities("workload.")]
    return Result(
        **facts,
        frame_time_s=frame_time_s,
        utilization={p.name: to_seconds(p.busy_ticks) / frame_time_s for p in devices.processors},
        breakdown=_breakdown(frame.timeline, frame_time_s),
        counts=_counts(frame, devices),
        sampling_error=sampling_error(trace, workload.card.published.resolution),
        uncalibrated=_owned_up(used),
        scope=_scope(devices, layout.size),
        image_sha256=image_sha256,
        event_log_sha256=frame.timeline.sha256(),
        image=image,
        spans=frame.timeline,
    )


def reference_image(trace: Trace) -> NDArray[np.float32]:
    """Return what a renderer with one domain makes: it follows the rays of each sample from the camera to their ends.

    This is the truth that every policy must reproduce bit for bit.
    """
    followed = []
    for sample in range(trace.samples):
        rays = trace.camera_rays(sample, np.arange(trace.pixels))
        while len(rays):
            followed.append(rays)
            rays = trace.children(rays)
    return trace.image(np.sort(np.concatenate(followed)))


def sampling_error(trace: Trace, published: tuple[int, int]) -> dict[str, Any]:
    """Estimate the error of tracing fewer pixels than were published.

    The traced pixels are a systematic sample of the image, so the variance of the mean number of rays a pixel is
    estimated from the differences of neighbours (Wolter, "Introduction to variance estimation", chapter 8), with the
    finite population correction. A frame's time is nearly proportional to its rays.
    """
    width, height = trace.size
    rays = np.bincount(trace.column("pixel"), minlength=trace.pixels).reshape(height, width).astype(np.float64)
    differences = [np.diff(rays, axis=axis) for axis in (0, 1)]
    count = sum(d.size for d in differences)
    variance = sum(float((d * d).sum()) for d in differences) / (2.0 * count) if count else 0.0
    share = min(1.0, trace.pixels / (published[0] * published[1]))
    error = float(np.sqrt(variance * (1.0 - share) / trace.pixels) / rays.mean())
    return {
        "relative_standard_error": error,
        "traced_pixels": trace.pixels,
        "published_pixels": published[0] * published[1],
        "method": "differences between neighbouring traced pixels, in rays a pixel",
    }


def _policy(policy: str | Policy | None, workload: Workload, overrides: Sequence[str]) -> tuple[str, Policy]:
    """Return the scheduler and its name: the card's own parameters hold where its own policy is asked for."""
    if policy is not None and not isinstance(policy, str):
        if overrides:
            raise UsageError("overrides of a policy need its name, not an instance")
        return type(policy).__name__, policy
    own = dict(workload.card.policy)
    own_name = own.pop("name", None)
    if not isinstance(own_name, str):
        raise UsageError(f"{workload.source}: policy.name: this field is missing")
    name = policy or own_name
    model = find_policy(name)
    document = Document("{}", f"{workload.source}: policy" if name == own_name else name)
    if name == own_name:
        document.data.update(own)
    for override in overrides:
        document.override(model, override, "policy")
    scheduler: Policy = document.validate(model)
    return name, scheduler


def _place(
    card: MachineCard, workload: Workload, policy: Policy, gpus: int, islands: Islands
) -> tuple[Fit, Partition, dict[str, Any]]:
    """Choose the islands, and say what each GPU must hold."""
    footprint = Footprint(float(card.gpu.bvh_triangle_bytes), float(card.gpu.bvh_instance_bytes))
    method: Method = getattr(policy, "partition", "heaviest_first")
    split_share = getattr(policy, "split_share", 1.0)

    def parts(size: int) -> Partition:
        return workload.partition(size, footprint, method, split_share)

    def need(count: int, size: int) -> NDArray[np.float64]:
        model = parts(size).weight_bytes[np.arange(count * size) % size]
        needed: NDArray[np.float64] = model + np.array(
            [sum(b.values()) for b in _buffers(policy, workload, count * size)]
        )
        return needed

    capacity = float(card.gpu.memory - card.gpu.reserved_memory)
    chosen = fit(gpus, None if islands == "auto" else islands, need, capacity, replicated=policy.replicated)
    partition = parts(chosen.layout.size)
    fullest = int(chosen.needed_bytes.argmax())
    memory = {
        "needed_bytes": float(chosen.needed_bytes[fullest]),
        "capacity_bytes": capacity,
        "model_bytes": float(partition.weight_bytes[chosen.layout.domain(fullest)]),
        **{
            f"{what.replace(' ', '_')}_bytes": nbytes
            for what, nbytes in _buffers(policy, workload, chosen.layout.ranks)[fullest].items()
        },
        "gpus_needed": chosen.gpus_needed,
    }
    return chosen, partition, memory


def _buffers(policy: Policy, workload: Workload, ranks: int) -> list[dict[str, float]]:
    """Return what each rank allocates beside the model; rank 0 also assembles the finished frame."""
    width, height = workload.card.published.resolution
    lines = np.bincount(np.arange(height) % ranks, minlength=ranks)
    buffers = [policy.buffer_bytes(float(n) * width) for n in lines]
    buffers[0] = {**buffers[0], "assembled frame": 2.0 * 4.0 * width * height}
    return buffers


def _visited(
    workload: Workload, partition: Partition, policy: Policy, seed: int, owner: Callable[[], NDArray[np.int64]]
) -> Callable[[int], NDArray[np.int16]]:
    """Return the function that tells a frame how far around the ring each ray of a generation is really traced."""

    def visited(generation: int) -> NDArray[np.int16]:
        start = (owner() + policy.first_domain) % partition.domains
        return workload.crossings(seed, partition).domains_visited(generation, start)

    return visited


def _check_retired(trace: Trace, retired: NDArray[np.int64]) -> None:
    times = np.bincount(retired, minlength=trace.rays)
    if len(times) > trace.rays or not (times == 1).all():
        lost, repeated = int((times == 0).sum()), int((times > 1).sum())
        raise InvariantError(f"of {trace.rays} rays {lost} were never retired and {repeated} more than once")


def _hash(image: NDArray[np.float32]) -> str:
    return hashlib.sha256(repr(image.shape).encode() + np.ascontiguousarray(image, dtype="<f4").tobytes()).hexdigest()


def _breakdown(timeline: Timeline, frame_time_s: float) -> dict[str, float]:
    """Return shares of the frame for an average GPU. A GPU never computes and copies at once, so they add up."""
    shares = {k: sum(s) / len(s) / frame_time_s for k, s in timeline.seconds_by_kind().items()}
    merged = {
        "trace": shares["trace"],
        "shade": shares["shade"] + shares["generate"] + shares["tonemap"] + shares["assemble"],
        "copy": shares["copy"] + shares["merge"],
    }
    return {**merged, "wait": max(0.0, 1.0 - sum(merged.values()))}


def _counts(frame: Frame, machine: Machine) -> dict[str, float]:
    trace, weight = frame.trace, frame.weight
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
        "bounces": trace.generations,
        "ray_domain_tests": frame.tests,
        "skipped_ray_domain_tests": frame.skipped_tests,
        "kernels": int((kind < len(KERNELS)).sum()),
        "trace_kernels": int((kind == KERNELS.index("trace")).sum()),
        "copies": int((kind >= len(KERNELS)).sum()),
        "published_copied_bytes": float(
            sum(b for b, k in zip(log.nbytes, log.kind, strict=True) if k >= len(KERNELS) or KERNELS[k] == "trace")
        ),
        "network_bytes": machine.network.sent_bytes if machine.has_network else 0.0,
        "spans": len(log),
    }


def _owned_up(quantities: list[tuple[str, Quantity]]) -> list[dict[str, str]]:
    return [
        {"path": path, "value": q.text, "status": q.status, "source": q.source}
        for path, q in quantities
        if q.status in UNCALIBRATED
    ]


def _scope(machine: Machine, island_size: int) -> dict[str, Any]:
    modelled = [f"{len(machine.processors)} GPUs, one stream each: kernel launch, saturation, memory"]
    modelled.append("the host thread that issues kernels and copies one after the other")
    left_out = [{"what": what, "why": why} for what, why in LEFT_OUT]
    if machine.has_network:
        users = "ray queues and finished pixels" if island_size > 1 else "finished pixels"
        modelled.append(f"{machine.card.fabric_name} between the GPUs, shared max-min fairly by the copies of {users}")
    else:
        left_out.append({"what": machine.card.fabric_name, "why": "one GPU sends nothing"})
    return {"modelled": modelled, "left_out": left_out}
