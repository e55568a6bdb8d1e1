"""Simulations in which rays are scheduled by domain: the data travels to the rays, or the rays to the data."""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.clock import to_seconds
from simrender.errors import InvariantError, UsageError
from simrender.hardware.machine import Machine, MachineCard
from simrender.policies.domain_frame import DomainFrame, DomainPolicy, Event, domain_cache, stripes
from simrender.policies.domain_rank import DomainRank
from simrender.policies.islands import Fit, fit
from simrender.rays.domains import Domains, morton_ranks
from simrender.rays.trace import Trace
from simrender.rays.workload import Workload
from simrender.result import Result, links, owned_up, rays_error, share_of_kinds
from simrender.timeline import Timeline

RAY_BYTES = 96.0
"""What a ray that waits in a queue takes, where the policy does not say: as much as in the authors' program."""


def place(card: MachineCard, domains: Domains, policy: DomainPolicy, ranks: int, islands: int | None) -> Fit:
    """Choose the islands, and say what each rank must hold of the data."""
    sizes = loaded_bytes(card, domains)
    capacity = float(card.processor.memory - card.processor.reserved_memory)

    def need(count: int, size: int) -> NDArray[np.float64]:
        if policy.in_situ:
            given = policy.owners is not None and size == ranks // count
            owner = owners(policy, domains, size) if given else morton_ranks(domains.low, domains.high, size)
            held = np.bincount(owner, sizes, minlength=size)
            copies = min(getattr(policy, "copies", 1), size)
            return np.tile(np.sum([np.roll(held, k) for k in range(copies)], axis=0), count)
        cache = domain_cache(policy.cache, sizes.tolist())
        # A slot of a cache that counts domains is as large as the largest one.
        slot = float(sizes.max()) if cache.unit == "domains" else 1.0
        return np.full(count * size, cache.capacity * slot)

    return fit(ranks, islands, need, capacity, replicated=not policy.in_situ)


def owners(policy: DomainPolicy, domains: Domains, ranks: int) -> NDArray[np.int64]:
    """Return the rank that holds each domain in situ.

    Raises
    ------
    UsageError
        If the policy gives another number of owners than there are domains, or one that is no rank.

    """
    if policy.owners is None:
        return morton_ranks(domains.low, domains.high, ranks).astype(np.int64)
    given = np.array(policy.owners, np.int64)
    if len(given) != domains.count:
        raise UsageError(f"policy.owners has {len(given)} entries, and there are {domains.count} domains")
    if given.min() < 0 or given.max() >= ranks:
        raise UsageError(f"policy.owners gives domains to ranks {given.min()} to {given.max()}, and there are {ranks}")
    return given


def loaded_bytes(card: MachineCard, domains: Domains) -> NDArray[np.float64]:
    """Return what each domain takes in memory, acceleration structure included."""
    return domains.bytes + domains.primitives * float(card.processor.bvh_triangle_bytes)


def render(
    card: MachineCard,
    workload: Workload,
    policy: DomainPolicy,
    chosen: Fit,
    domains: Domains,
    seed: int,
    facts: dict[str, Any],
) -> Result:
    """Render a frame and check it; ``facts`` are what the result says of the run whatever came of it."""
    trace = workload.trace(seed)
    trace.complete()
    crossings = workload.domain_crossings(seed, domains)
    layout = chosen.layout
    env = simpy.Environment()
    devices = Machine(env, card, layout.ranks, record=True)
    names = [devices.processor(index).name for index in range(layout.ranks)]
    timeline = Timeline(layout.ranks, names)
    together = layout.size if policy.in_situ else layout.ranks
    frames: list[DomainFrame] = []
    for island in range(layout.ranks // together):
        other = frames[0] if frames else None
        frames.append(_frame(env, devices, crossings, policy, timeline, workload, island, together, other))
    ranks = [env.process(policy.rank(DomainRank(f, index))) for f in frames for index in range(f.ranks)]
    env.run(env.all_of(ranks))
    frame_time_s = to_seconds(int(env.now))
    crossings.save()

    retired = np.concatenate([ids for f in frames for ids in f.retired])
    check_retired(trace, retired)
    image = trace.image(np.sort(retired))
    if image_hash(image) != image_hash(trace.reference):
        raise InvariantError(f"{facts['policy']} rendered another image than the reference renderer")
    weight = frames[0].weight
    counted = [dataclasses.asdict(f.counters) for f in frames]
    counters = {name: sum(c[name] for c in counted) for name in counted[0] if name != "rounds"}
    counters["rounds"] = max(c["rounds"] for c in counted)
    counters["critical_tests"] = _critical_tests([event for f in frames for event in f.events])
    ray_bytes = getattr(policy, "ray_bytes", None) or RAY_BYTES
    peak = max(max(f.peak_bytes) or max(f.peak_rays) * weight * ray_bytes for f in frames)
    memory = facts["memory"] | {"peak_rays_bytes": peak, "needed_bytes": facts["memory"]["needed_bytes"] + peak}
    carried = links(devices)
    loads = devices.network.loads_by_link if devices.has_network else {}
    return Result(
        **facts | {"memory": memory, "feasible": memory["needed_bytes"] <= memory["capacity_bytes"]},
        frame_time_s=frame_time_s,
        utilization={p.name: to_seconds(p.busy_ticks) / frame_time_s for p in devices.processors},
        links=carried,
        breakdown=share_of_kinds(timeline, frame_time_s),
        counts={
            "traced_paths": trace.first[1],
            "traced_rays": trace.rays,
            "published_rays": trace.rays * weight,
            "ray_weight": weight,
            "generations": trace.generations,
            "domains": domains.count,
            **counters,
        },
        busy_over_time=timeline.busy_share(int(env.now)).tolist(),
        sampling_error=rays_error(trace, workload.card.published.resolution),
        uncalibrated=owned_up([*devices.quantities(), *workload.card.quantities("workload.")]),
        scope=_scope(devices, policy),
        image_sha256=image_hash(image),
        image=image,
        event_log_sha256=timeline.sha256(),
        spans=timeline,
        loads={str(name): load for name, load in loads.items() if str(name) in carried},
        schedule=[moment for f in frames[:1] for moment in f.moments],
        events=[event for f in frames for event in f.events],
    )


def _frame(
    env: simpy.Environment,
    devices: Machine,
    crossings: Any,
    policy: DomainPolicy,
    timeline: Timeline,
    workload: Workload,
    island: int,
    size: int,
    other: DomainFrame | None,
) -> DomainFrame:
    """Return the state of one island's ranks."""
    trace, domains = crossings.trace, crossings.domains
    islands = timeline.gpus // size
    first = island * size
    line = np.arange(trace.pixels) // trace.size[0]
    mine = np.flatnonzero(line % islands == island)
    rank_of_pixel = np.full(trace.pixels, -1, np.int64)
    rank_of_pixel[mine] = stripes((trace.size[0], len(mine) // trace.size[0]), size)
    sizes = loaded_bytes(devices.card, domains).tolist()
    return DomainFrame(
        env, devices, crossings, workload.visits(crossings), policy, timeline,
        devices.communicator(list(range(first, first + size))) if size > 1 else None,
        owners(policy, domains, size) if policy.in_situ else None,
        rank_of_pixel, [domain_cache(policy.cache, sizes) for _ in range(size)],
        workload.weight * workload.repeats, workload.card.published.resolution, first, other,
    )  # fmt: skip


def check_retired(trace: Trace, retired: NDArray[np.int64], repeats: int = 1) -> None:
    """Check that each ray of the reference renderer was retired, and no other.

    Raises
    ------
    InvariantError

    """
    times = np.bincount(retired, minlength=trace.rays)
    if len(times) > trace.rays or not (times == repeats).all():
        lost, repeated = int((times < repeats).sum()), int((times > repeats).sum())
        raise InvariantError(f"of {trace.rays} rays {lost} were never retired and {repeated} more than once")


def image_hash(image: NDArray[np.float32]) -> str:
    """Return the hash of an image: equal for images that are equal to the bit."""
    pixels = np.ascontiguousarray(image, dtype="<f4").tobytes()
    return hashlib.sha256(repr(image.shape).encode() + pixels).hexdigest()


def _critical_tests(events: list[Event]) -> int:
    """Return the sum over the steps of the busiest rank's tests."""
    of_rank: dict[tuple[int, int], int] = {}
    for e in events:
        of_rank[e.step, e.rank] = of_rank.get((e.step, e.rank), 0) + e.radiance_tests + e.shadow_tests
    busiest: dict[int, int] = {}
    for (step, _), tests in of_rank.items():
        busiest[step] = max(busiest.get(step, 0), tests)
    return sum(busiest.values())


def _scope(devices: Machine, policy: DomainPolicy) -> dict[str, Any]:
    noun = devices.card.processor_noun
    modelled = [f"{len(devices.processors)} {noun}s: saturation, the logarithm of what a ray searches"]
    left_out = [
        {"what": "shading", "why": "its cost is inside the trace rates"},
        {"what": "the display and the way to it", "why": "the frame ends when its pixels are summed on rank 0"},
    ]
    if policy.in_situ:
        modelled.append("rays between the ranks, in MPI messages; counts and images in collectives")
        left_out.append({"what": "loading", "why": "every rank holds its domains before the frame begins"})
        if getattr(policy, "messages", "single") == "grouped":
            why = "frames took up to 1.7 % longer or shorter with each; policy.messages=single has them"
            left_out.append({"what": "each message to a rank by itself", "why": why})
    else:
        modelled.append("reading, parsing and building a domain at each miss of a rank's cache, which starts cold")
        left_out.append({"what": "loading ahead", "why": "the program that is modelled loads when it needs a domain"})
    return {"modelled": modelled, "left_out": left_out}


def check_scene(workload: Workload, name: str) -> None:
    """Refuse a workload whose data a scheduler of domains cannot handle.

    Raises
    ------
    UsageError

    """
    if len(workload.scene.instance_object) == 0:
        raise UsageError(f"{name} schedules rays on surfaces, and {workload.name} is a volume")
