"""``simulate(machine, workload, policy, ...) -> Result``: the schedulers drive a trace over a machine."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.cards import Document
from simrender.catalog import find_policy, policies
from simrender.clock import to_seconds
from simrender.domain_simulation import check_retired, check_scene, image_hash, place, render
from simrender.errors import InvariantError, UsageError, did_you_mean
from simrender.hardware.machine import Machine, MachineCard, check_processors, load_machine
from simrender.policies.domain_frame import DomainPolicy
from simrender.policies.frame import Frame, Policy
from simrender.policies.islands import Fit, Layout, fit
from simrender.policies.rank import PIXEL_BYTES, Rank
from simrender.policies.speculation import Speculation
from simrender.rays.integrators import PathTracing, RayCasting
from simrender.rays.partition import Footprint, Partition
from simrender.rays.trace import Progress
from simrender.rays.workload import Workload, check_seed, load_workload
from simrender.result import Result, breakdown, counts, links, owned_up, sampling_error, scope
from simrender.timeline import Timeline

Islands = int | Literal["auto"]

PATH_POLICY = "distributed_cache"
"""The policy that renders frames one after the other, with caches that stay warm."""


def simulate(
    machine: str | MachineCard,
    workload: str | Workload,
    policy: str | Policy | DomainPolicy | None = None,
    *,
    islands: Islands = "auto",
    nodes: int | None = None,
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
    nodes : int, optional
        How many of the machine's nodes to use; all by default.
    gpus : int, optional
        How many GPUs of those to use; all by default.
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
    given = _overrides(overrides or {}, machine, workload)
    card = load_machine(machine, given.get("machine", ())) if isinstance(machine, str) else machine
    count = check_processors(card, nodes, gpus)
    if islands != "auto" and not 1 <= islands <= count:
        raise UsageError(f"--islands {islands}: {count} {card.processor_noun}s make 1 to {count} islands, or auto")
    check_seed(seed)
    if isinstance(workload, str):
        workload = load_workload(workload, given.get("workload", ()), cache)
    name, scheduler = make_policy(policy, workload, given.get("policy", ()))
    if name == PATH_POLICY:
        raise UsageError(f"{name} renders frames along the camera's path: simrender.camera_path.simulate_frames")
    if isinstance(scheduler, DomainPolicy):
        return _simulate_domains(machine, card, workload, name, scheduler, count, islands, seed, progress)
    if not isinstance(workload.integrator, PathTracing | RayCasting):
        other = workload.card.integrator.name
        hint = "; --set workload.integrator=path_tracing" if len(workload.scene.instance_object) else ""
        raise UsageError(
            f"{name} moves the rays of path_tracing, and the integrator of {workload.name} is {other}{hint}"
        )
    noun = card.processor_noun
    if scheduler.replicated and islands not in {"auto", count}:
        raise UsageError(
            f"--islands {islands}: {name} holds the whole model on every {noun}, so every {noun} is an island; "
            f"use a data-parallel policy such as ray_queue_cycling"
        )

    chosen, partition, memory = _place(card, workload, scheduler, count, islands)
    layout = chosen.layout
    facts: dict[str, Any] = {
        "machine": machine if isinstance(machine, str) else card.title,
        "workload": workload.name,
        "policy": name,
        "seed": seed,
        "processor": card.processor_noun,
        "gpus": count,
        "islands": layout.islands,
        "island_size": layout.size,
        "unused_gpus": count - layout.ranks,
        "feasible": chosen.feasible,
        "memory": memory,
    }
    if not chosen.feasible:
        section = f"machine.{card.processor_section}."
        deciding = [*card.processor.memory_quantities(section), *workload.card.quantities("workload.published.")]
        cause = {"modelled": ["what each GPU must hold"], "left_out": [{"what": "the frame", "why": "it does not fit"}]}
        return Result(**facts, uncalibrated=owned_up(deciding), scope=cause)

    if scheduler.kernels_read:
        _check_reach(card, layout, name)
    env = simpy.Environment()
    devices = Machine(env, card, layout.ranks, kernels_read=scheduler.kernels_read, record=True)
    names = [devices.processor(index).name for index in range(layout.ranks)]
    trace = workload.trace(seed, progress)
    frame = Frame(
        env, devices, layout, trace, partition, scheduler, Timeline(layout.ranks, names),
        visited=lambda generation, start: workload.crossings(seed, partition).domains_visited(generation, start),
        weight=workload.weight, published=workload.card.published.resolution, repeats=workload.repeats,
    )  # fmt: skip
    cases, which = _buffers(scheduler, workload, layout)
    ranks = []
    for index in range(layout.ranks):
        gpu = devices.processor(index)
        gpu.allocate("the model", float(partition.weight_bytes[layout.domain(index)]))
        for what, nbytes in cases[which[index]].items():
            gpu.allocate(what, nbytes)
        ranks.append(env.process(scheduler.rank(Rank(frame, index))))
    env.run(env.all_of(ranks))
    frame_time_s = to_seconds(int(env.now))

    trace.complete()
    retired = np.concatenate(frame.retired)
    check_retired(trace, retired, frame.repeats)
    _check_devices(frame, int(env.now))
    image = trace.image(np.unique(retired))
    image_sha256 = image_hash(image)
    if image_sha256 != image_hash(trace.reference):
        raise InvariantError(f"{name} rendered another image than the reference renderer")
    if layout.size > 1:
        workload.crossings(seed, partition).save()

    carried = links(devices)
    loads = devices.network.loads_by_link if devices.has_network else {}
    used = [*devices.quantities(), *workload.card.quantities("workload.")]
    return Result(
        **facts,
        frame_time_s=frame_time_s,
        utilization={p.name: to_seconds(p.busy_ticks) / frame_time_s for p in devices.processors},
        busy_over_time=frame.timeline.busy_share(int(env.now)).tolist(),
        links=carried,
        breakdown=breakdown(frame.timeline, frame_time_s),
        counts=counts(frame, devices),
        sampling_error=sampling_error(frame),
        uncalibrated=owned_up(used),
        scope=scope(devices, layout.size),
        image_sha256=image_sha256,
        event_log_sha256=frame.timeline.sha256(),
        image=image,
        spans=frame.timeline,
        loads={str(name): load for name, load in loads.items() if str(name) in carried},
    )


def _simulate_domains(
    machine: str | MachineCard,
    card: MachineCard,
    workload: Workload,
    name: str,
    policy: DomainPolicy,
    count: int,
    islands: Islands,
    seed: int,
    progress: Progress | None,
) -> Result:
    """Render one frame under a scheduler of domains."""
    check_scene(workload, name)
    noun = card.processor_noun
    if not policy.in_situ and islands not in {"auto", count}:
        raise UsageError(
            f"--islands {islands}: under {name} every {noun} loads what it needs, so every {noun} is an island; "
            "islands share data that stays in place, as with policy.data=in_situ"
        )
    workload.trace(seed, progress).complete()
    domains = workload.domains()
    try:
        chosen = place(card, domains, policy, count, None if islands == "auto" else islands)
    except ValueError as error:
        raise UsageError(f"policy.cache={policy.cache}: {error}") from None
    facts: dict[str, Any] = {
        "machine": machine if isinstance(machine, str) else card.title,
        "workload": workload.name,
        "policy": name,
        "seed": seed,
        "processor": noun,
        "gpus": count,
        "islands": chosen.layout.islands,
        "island_size": chosen.layout.size,
        "unused_gpus": count - chosen.layout.ranks,
        "feasible": chosen.feasible,
        "memory": {
            "needed_bytes": float(chosen.needed_bytes.max()),
            "capacity_bytes": chosen.capacity_bytes,
            "model_bytes": float(chosen.needed_bytes.max()),
            "gpus_needed": chosen.gpus_needed,
        },
    }
    if not chosen.feasible:
        section = f"machine.{card.processor_section}."
        deciding = [*card.processor.memory_quantities(section), *workload.card.quantities("workload.published.")]
        cause = {
            "modelled": [f"what each {noun} must hold"],
            "left_out": [{"what": "the frame", "why": "it does not fit"}],
        }
        return Result(**facts, uncalibrated=owned_up(deciding), scope=cause)
    return _in_tiles(policy, lambda scheduler: render(card, workload, scheduler, chosen, domains, seed, facts))


_MOST_TILES = 1024
"""Into which an image is cut at most so that its rays fit."""


def _in_tiles(policy: DomainPolicy, render_with: Callable[[DomainPolicy], Result]) -> Result:
    """Render, with the image in as few tiles (a power of two) as let its rays fit where the policy leaves that open."""
    if not isinstance(policy, Speculation) or policy.tiles != "auto":
        return render_with(policy)
    tiles = 1
    while True:
        result = render_with(dataclasses.replace(policy, tiles=tiles))
        if result.feasible or tiles >= _MOST_TILES:
            return dataclasses.replace(result, memory=result.memory | {"tiles": tiles})
        tiles *= 2


def _overrides(
    overrides: Mapping[str, Sequence[str]], machine: str | MachineCard, workload: str | Workload
) -> Mapping[str, Sequence[str]]:
    """Refuse overrides that nobody would read."""
    known = ("machine", "workload", "policy")
    for section, assignments in overrides.items():
        if section not in known:
            raise UsageError(f"overrides of {section!r}: there are {', '.join(known)}{did_you_mean(section, known)}")
        loaded = {"machine": not isinstance(machine, str), "workload": not isinstance(workload, str)}
        if assignments and loaded.get(section):
            raise UsageError(f"overrides of the {section} need its name, not one that is loaded already")
    return overrides


def make_policy(
    policy: str | Policy | DomainPolicy | None, workload: Workload, overrides: Sequence[str]
) -> tuple[str, Policy | DomainPolicy]:
    """Return the scheduler and its name: the card's own parameters hold where its own policy is asked for.

    Raises
    ------
    UnknownNameError, CardError, UsageError

    """
    if policy is not None and not isinstance(policy, str):
        if overrides:
            raise UsageError("overrides of the policy need its name, not one that is made already")
        home = f"{type(policy).__module__}:{type(policy).__qualname__}"
        return next((name for name, entry in policies().items() if entry.value == home), home), policy
    own_name = workload.card.policy["name"]
    name = policy or own_name
    model = find_policy(name)
    document = workload.document.section("policy", workload.card.policy) if name == own_name else Document("{}", name)
    document.data.pop("name", None)
    for override in overrides:
        document.override(model, override, "policy")
    scheduler: Policy | DomainPolicy = document.validate(model)
    return name, scheduler


def _place(
    card: MachineCard, workload: Workload, policy: Policy, gpus: int, islands: Islands
) -> tuple[Fit, Partition, dict[str, Any]]:
    """Choose the islands, and say what each GPU must hold."""
    footprint = Footprint(float(card.processor.bvh_triangle_bytes), float(card.processor.bvh_instance_bytes))

    def parts(size: int) -> Partition:
        return workload.partition(size, footprint, policy.partition, policy.split_share)

    def need(count: int, size: int) -> NDArray[np.float64]:
        model = parts(size).weight_bytes[np.arange(count * size) % size]
        distinct, which = _buffers(policy, workload, Layout(count, size))
        needed: NDArray[np.float64] = model + np.array([sum(b.values()) for b in distinct])[which]
        return needed

    capacity = float(card.processor.memory - card.processor.reserved_memory)
    chosen = fit(gpus, None if islands == "auto" else islands, need, capacity, replicated=policy.replicated)
    partition = parts(chosen.layout.size)
    fullest = int(chosen.needed_bytes.argmax())
    distinct, which = _buffers(policy, workload, chosen.layout)
    memory = {
        "needed_bytes": float(chosen.needed_bytes[fullest]),
        "capacity_bytes": capacity,
        "model_bytes": float(partition.weight_bytes[chosen.layout.domain(fullest)]),
        **{f"{what.replace(' ', '_')}_bytes": nbytes for what, nbytes in distinct[which[fullest]].items()},
        "gpus_needed": chosen.gpus_needed,
    }
    return chosen, partition, memory


def _check_reach(card: MachineCard, layout: Layout, policy: str) -> None:
    """Refuse kernels that would read the memory of another node's GPUs."""
    first = np.arange(layout.islands) * layout.size
    if (first // card.node_processors != (first + layout.size - 1) // card.node_processors).any():
        raise UsageError(
            f"{policy} lets kernels read their neighbours' memory, which they cannot do from node to node, and islands "
            f"of {layout.size} {card.processor_noun}s lie on several nodes; use policy.copy=explicit"
        )


def _buffers(policy: Policy, workload: Workload, layout: Layout) -> tuple[list[dict[str, float]], NDArray[np.int64]]:
    """Return what ranks allocate beside the model: the distinct cases, and which of them each rank is.

    Ranks differ by a scan line at most, and rank 0 also assembles the finished frame.
    """
    width, height = workload.card.published.resolution
    lines = np.bincount(layout.rank_of_line(np.arange(height)), minlength=layout.ranks)
    counts, which = np.unique(lines, return_inverse=True)
    cases = [policy.buffer_bytes(float(n) * width) for n in (*counts, lines[0])]
    cases[-1]["assembled frame"] = 2.0 * PIXEL_BYTES * width * height
    which[0] = len(counts)
    return cases, which


def _check_devices(frame: Frame, end: int) -> None:
    """Check that no GPU did two things at once or ran past the end, and that the links carried what was sent."""
    log = frame.timeline
    device, begins, ends = (np.array(column) for column in (log.device, log.start, log.end))
    order = np.lexsort((ends, begins, device))
    device, begins, ends = device[order], begins[order], ends[order]
    together = (begins[1:] < ends[:-1]) & (device[1:] == device[:-1])
    if together.any() or (begins > ends).any() or ends.max() > end:
        raise InvariantError("a GPU did two things at once, or went on after the end of the frame")
    if frame.machine.has_network:
        network = frame.machine.network
        carried, expected = sum(network.carried_bytes.values()), network.sent_link_bytes
        if abs(carried - expected) > 1e-12 * expected:
            raise InvariantError(f"the links should have carried {expected} B and carried {carried} B")
