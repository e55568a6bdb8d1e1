"""Frames along a camera's path under a scheduler that keeps its caches warm from one frame to the next."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import simpy
from numpy.typing import NDArray

from simrender.clock import to_seconds
from simrender.domain_simulation import check_retired, check_scene, image_hash
from simrender.errors import InvariantError, UnitError, UsageError
from simrender.hardware.cache import NODE_BLOCK_BYTES, TRIANGLE_BLOCK_BYTES
from simrender.hardware.display import Display
from simrender.hardware.machine import Machine, MachineCard, check_processors, load_machine
from simrender.policies.distributed_cache import Cluster, DistributedCache, FrameCounts, RenderNode
from simrender.policies.tiles import TiledFrame, tile_frame
from simrender.rays.blocks import NODE_BLOCK, TRIANGLE_BLOCK, Blocks, References, block_hierarchy, references
from simrender.rays.trace import Progress, Trace
from simrender.rays.workload import Workload, load_workload
from simrender.result import links, owned_up, rays_error
from simrender.timeline import Timeline
from simrender.units import BYTES, parse

_NODE_BYTES, _TRIANGLE_BYTES = NODE_BLOCK_BYTES / NODE_BLOCK, TRIANGLE_BLOCK_BYTES / TRIANGLE_BLOCK


@dataclass(frozen=True)
class FrameReport:
    """One frame.

    Attributes
    ----------
    frame_time_s : float
        From the frame before being complete to this one being so.
    frames_per_s : float
    published_rays : float
    references, residents, hits, misses : int
        Of packets to blocks, by outcome: a node has residents for good, and fetches what it misses.
    miss_rate : float
        Misses as a share of the references to blocks that a node does not have for good.
    touched_share : float
        Share of all blocks that some ray of the frame refers to.
    fetched_bytes : float
    tiles, requests, messages : int
        Tiles handed out, questions to the master, messages to the display.
    imbalance : float
        Trace and fetch time of the busiest node over the mean.
    trace_share, fetch_share : float
        Of the threads' time while the frame lasted; the rest they wait. Where a frame begins before the one before is
        complete, they may come to more than 1.
    image_sha256 : str

    """

    frame_time_s: float
    frames_per_s: float
    published_rays: float
    references: int
    residents: int
    hits: int
    misses: int
    miss_rate: float
    touched_share: float
    fetched_bytes: float
    tiles: int
    requests: int
    messages: int
    imbalance: float
    trace_share: float
    fetch_share: float
    image_sha256: str


@dataclass(frozen=True, eq=False)
class PathResult:
    """What the frames along a camera's path took.

    Attributes
    ----------
    machine, workload, policy : str
    parameters : dict
        Of the policy.
    seed, nodes, threads : int
        Nodes in all, one of which has the master and the display process; render threads of each other one.
    feasible : bool
        Whether what a node keeps of the data fits; where it does not, there are no frames.
    memory : dict
        ``data_bytes`` (published, with the hierarchy), ``needed_bytes`` of a node and ``capacity_bytes``.
    blocks : dict
        Blocks of nodes and of triangles, how many traced ones of either make a block, and the lines of the caches.
    frames_per_s : float or None
        Frames over the sum of their times.
    miss_rate : float or None
    cold : FrameReport or None
        The first frame that was rendered to warm up, where caches begin empty.
    frames : list of FrameReport
    links, sampling_error, uncalibrated, scope
        As of a `simrender.result.Result`.
    event_log_sha256 : str or None
    images : list of float32 arrays (height, width, 3)
    spans : Timeline or None
        A row a thread.

    """

    machine: str
    workload: str
    policy: str
    parameters: dict[str, Any]
    seed: int
    nodes: int
    threads: int
    feasible: bool
    memory: dict[str, float]
    blocks: dict[str, int]
    frames_per_s: float | None = None
    miss_rate: float | None = None
    cold: FrameReport | None = None
    frames: list[FrameReport] = field(default_factory=list)
    links: dict[str, dict[str, float]] = field(default_factory=dict)
    sampling_error: dict[str, Any] = field(default_factory=dict)
    uncalibrated: list[dict[str, str]] = field(default_factory=list)
    scope: dict[str, Any] = field(default_factory=dict)
    event_log_sha256: str | None = None
    images: list[NDArray[np.float32]] = field(default_factory=list)
    spans: Timeline | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the images and the timeline, ready for JSON."""
        facts = {name: getattr(self, name) for name in self.__dataclass_fields__ if name not in {"images", "spans"}}
        cold = None if self.cold is None else dataclasses.asdict(self.cold)
        return facts | {"cold": cold, "frames": [dataclasses.asdict(frame) for frame in self.frames]}


def simulate_frames(
    machine: str | MachineCard,
    workload: str | Workload,
    policy: DistributedCache,
    frames: int = 1,
    *,
    nodes: int | None = None,
    seed: int = 1,
    progress: Progress | None = None,
) -> PathResult:
    """Render frames along the workload's camera path on a cluster, one after the other, with warm caches.

    Parameters
    ----------
    machine : str or MachineCard
        A machine that renders on its processors and has at least two nodes.
    workload : str or Workload
    policy : DistributedCache
    frames : int
        That count. They follow the policy's ``uncounted`` first ones of the ``path_frames`` of the workload's card;
        where it does not say how many there are, they lead from the beginning of the path to its end.
    nodes : int, optional
        How many to use, all by default; the last one has the master and the display process, and renders nothing.
    seed : int
    progress : callable, optional
        As for `simrender.simulation.simulate`.

    Raises
    ------
    UsageError
        If the machine, the workload or a parameter does not go with this way to render.
    InvariantError
        If a packet was lost or rendered twice, or the image is not that of the reference renderer.

    """
    card = load_machine(machine) if isinstance(machine, str) else machine
    if isinstance(workload, str):
        workload = load_workload(workload)
    count = check_processors(card, nodes, None)
    _check(card, workload, policy, frames, count)
    ranks = count - 1
    views, which = _views(workload, policy.uncounted, frames)
    traces = [view.trace(seed, progress) for view in views]
    sizes = _block_sizes(workload, traces[0], policy)
    hierarchy = _Hierarchy(traces[0], sizes)
    refers = [references(trace, hierarchy, *sizes) for trace in traces]
    growth = float(workload.published.instanced_triangles) / refers[0].triangles
    data = growth * (refers[0].nodes * _NODE_BYTES + refers[0].triangles * _TRIANGLE_BYTES)
    share = _share(policy.cache, data)

    env = simpy.Environment()
    devices = Machine(env, card, count, record=True)
    ray_seconds = _ray_seconds(devices, float(workload.published.instanced_triangles))
    published = workload.card.published.resolution
    tiled = [
        tile_frame(trace, refer, published, policy.tile, ray_seconds, workload.repeats, policy.blocks == "scaled")
        for trace, refer in zip(traces, refers, strict=True)
    ]
    lines = (0, 0) if policy.replicated else _lines(share, tiled[0].blocks, ranks, policy)
    capacity = float(card.processor.memory - card.processor.reserved_memory)
    display = card.display is not None if policy.display is None else policy.display
    facts: dict[str, Any] = {
        "machine": machine if isinstance(machine, str) else card.title,
        "workload": workload.name,
        "policy": "distributed_cache",
        "parameters": dataclasses.asdict(policy),
        "seed": seed,
        "nodes": count,
        "threads": policy.render_threads(card),
        "memory": {"data_bytes": data, "needed_bytes": share * data, "capacity_bytes": capacity},
        "blocks": {
            "node_blocks": tiled[0].blocks[0],
            "triangle_blocks": tiled[0].blocks[1],
            "nodes_a_block": sizes[0],
            "triangles_a_block": sizes[1],
            "node_lines": lines[0],
            "triangle_lines": lines[1],
        },
    }
    if share * data > capacity:
        cause = {"modelled": ["what each node keeps of the data"], "left_out": []}
        return PathResult(**facts, feasible=False, scope=cause)

    sink = Display(env, card.display, published[0] * published[1]) if display and card.display else None
    cluster = Cluster(env, devices, policy, [tiled[k] for k in which], lines, sink)
    last = [] if sink is None else [sink.complete(len(which) - 1)]
    rendering = [RenderNode(cluster, rank) for rank in range(ranks)]
    if policy.settled and not policy.replicated:
        first = tiled[0]
        uses = [s.last_uses(first.first, blocks) for s, blocks in zip(first.streams, first.blocks, strict=True)]
        for node in rendering:
            node.settle(first, uses, np.random.default_rng((seed, node.rank)))
    env.run(env.all_of([*(env.process(policy.node(node)) for node in rendering), *last]))

    images, hashes = _images([traces[k] for k in which], [tiled[k] for k in which], cluster.counts)
    weight = workload.weight * workload.repeats
    ends = [0, *(counts.complete_at for counts in cluster.counts)]
    reports = [
        _report(cluster, traces[k], refers[k], ends[i], cluster.counts[i], hashes[i], weight)
        for i, k in enumerate(which)
    ]
    measured = reports[policy.uncounted :]
    asked = sum(report.hits + report.misses for report in measured)
    used = [*devices.quantities(), *workload.card.quantities("workload.")]
    if sink is not None and card.display is not None:
        used += card.display.quantities("machine.display.")
    return PathResult(
        **facts,
        feasible=True,
        frames_per_s=frames / sum(report.frame_time_s for report in measured),
        miss_rate=sum(report.misses for report in measured) / max(asked, 1),
        cold=reports[0] if policy.uncounted and not policy.settled else None,
        frames=measured,
        links=links(devices),
        sampling_error=rays_error(traces[0], published),
        uncalibrated=owned_up(used),
        scope=_scope(policy, sink),
        event_log_sha256=cluster.timeline.sha256(),
        images=images[policy.uncounted :],
        spans=cluster.timeline,
    )


def _views(workload: Workload, warm_up: int, frames: int) -> tuple[list[Workload], list[int]]:
    """Return what the camera sees, and which of it each frame shows: those to warm up, then those that count."""
    camera = workload.card.camera
    if len(camera.path) < 2:
        numbers = [0] * (warm_up + frames)
    elif camera.path_frames is None:
        numbers = [0] * warm_up + list(range(frames))
    else:
        numbers = list(range(warm_up + frames))
    of = max(numbers[-1] + 1, camera.path_frames or 0)
    return [workload.frame(number, of) for number in range(numbers[-1] + 1)], numbers


class _Hierarchy:
    """The hierarchy of a scene, built when it is first asked for."""

    def __init__(self, trace: Trace, sizes: tuple[int, int]) -> None:
        self._trace, self._sizes = trace, sizes
        self._blocks: Blocks | None = None

    def __call__(self) -> Blocks:
        if self._blocks is None:
            written = self._trace.scene.triangles
            self._blocks = block_hierarchy(written.vertices, written.faces, *self._sizes)
        return self._blocks


def _check(card: MachineCard, workload: Workload, policy: DistributedCache, frames: int, nodes: int) -> None:
    name = "distributed_cache"
    check_scene(workload, name)
    if card.gpus:
        raise UsageError(f"{name} renders on the cores of nodes, and {card.title} renders on GPUs; try manta-cluster")
    if nodes < 2:
        raise UsageError(f"{name} needs a node for its master and its display beside those that render; use 2 or more")
    if frames < 1:
        raise UsageError(f"--frames {frames}: expected 1 or more")
    cores = getattr(card.processor, "cores", 1)
    if policy.render_threads(card) > cores:
        raise UsageError(f"policy.threads={policy.threads}: a node of {card.title} has {cores} cores")
    if policy.display and card.display is None:
        raise UsageError(f"policy.display=true: {card.title} has no section display; use policy.display=false")
    if card.display is not None and card.display.nodes > 1 and policy.display is not False:
        raise UsageError(f"{name} sends its pixels to one display node, and there are {card.display.nodes}")


def _block_sizes(workload: Workload, trace: Trace, policy: DistributedCache) -> tuple[int, int]:
    """Return the nodes and triangles of a block of the traced mesh.

    A packet of traced pixels is as much wider than a published one as the weight has it. Among blocks that are as much
    larger than published ones it has as many neighbours: so the traced mesh is cut into as many blocks as the published
    one has, over the weight.
    """
    if policy.blocks == "full":
        return NODE_BLOCK, TRIANGLE_BLOCK
    growth = float(workload.published.instanced_triangles) / trace.scene.instanced_triangles
    scale = workload.weight / growth
    return max(2, 2 * round(NODE_BLOCK / 2 * scale)), max(1, round(TRIANGLE_BLOCK * scale))


def _share(cache: str, data: float) -> float:
    """Return which share of the data a node keeps."""
    text = str(cache).strip()
    try:
        if text == "all":
            return 1.0
        share = float(text[:-1]) / 100.0 if text.endswith("%") else parse(text, BYTES) / data
    except (UnitError, ValueError):
        share = 0.0
    if not 0.0 < share <= 1.0:
        raise UsageError(
            f"policy.cache={cache}: expected a share of the data such as 12.5%, a size up to the {data / 1e9:.3g} GB "
            "of the data, or all"
        )
    return share


def _lines(share: float, blocks: tuple[int, int], ranks: int, policy: DistributedCache) -> tuple[int, int]:
    """Return the lines of both caches: what a node keeps less what it has for good."""
    lines = []
    for each in blocks:
        own = each // ranks
        lines.append(round(share * each) - own)
    if ranks == 1:
        raise UsageError(f"policy.cache={policy.cache}: a single render node has all data; use all, or more nodes")
    if min(lines) < 1:
        raise UsageError(
            f"policy.cache={policy.cache}: each of {ranks} render nodes has {100.0 / ranks:.3g}% of the data for good, "
            "which leaves no line for a cache; keep more of the data, or use more nodes"
        )
    return lines[0], lines[1]


def _ray_seconds(devices: Machine, primitives: float) -> tuple[float, float]:
    """Return what one core takes for a coherent ray and for another: what one more costs, on all cores, times these."""
    processor = devices.processor(0)
    cores, many = float(getattr(processor.card, "cores", 1)), 1e6

    def cost(coherent: float, incoherent: float) -> float:
        twice = processor.trace_seconds(2.0 * coherent, 2.0 * incoherent, primitives)
        return (twice - processor.trace_seconds(coherent, incoherent, primitives)) / many * cores

    return cost(many, 0.0), cost(0.0, many)


def _images(
    traces: list[Trace], tiled: list[TiledFrame], counts: list[FrameCounts]
) -> tuple[list[NDArray[np.float32]], list[str]]:
    """Return the frames' images and their hashes, having checked that each packet was rendered once."""
    images, hashes = [], []
    for trace, frame, count in zip(traces, tiled, counts, strict=True):
        retired = np.concatenate([frame.rays[packet] for packet in count.packets])
        check_retired(trace, retired)
        images.append(trace.image(np.sort(retired)))
        hashes.append(image_hash(images[-1]))
        if hashes[-1] != image_hash(trace.reference):
            raise InvariantError("distributed_cache rendered another image than the reference renderer")
    return images, hashes


def _report(
    cluster: Cluster, trace: Trace, refers: References, begin: int, counts: FrameCounts, image: str, weight: float
) -> FrameReport:
    seconds = to_seconds(counts.complete_at - begin)
    busy = np.array(counts.trace_ticks) + np.array(counts.fetch_ticks)
    threads_s = seconds * cluster.ranks * cluster.threads
    touched = len(np.unique(refers.node)) + len(np.unique(refers.triangle))
    return FrameReport(
        frame_time_s=seconds,
        frames_per_s=1.0 / seconds,
        published_rays=trace.rays * weight,
        references=counts.residents + counts.hits + counts.misses,
        residents=counts.residents,
        hits=counts.hits,
        misses=counts.misses,
        miss_rate=counts.misses / max(counts.hits + counts.misses, 1),
        touched_share=touched / (refers.node_blocks + refers.triangle_blocks),
        fetched_bytes=counts.fetched_bytes,
        tiles=counts.tiles,
        requests=counts.requests,
        messages=counts.messages,
        imbalance=float(busy.max() / max(busy.mean(), 1e-300)),
        trace_share=to_seconds(sum(counts.trace_ticks)) / threads_s,
        fetch_share=to_seconds(sum(counts.fetch_ticks)) / threads_s,
        image_sha256=image,
    )


def _scope(policy: DistributedCache, sink: Display | None) -> dict[str, Any]:
    gets = "each get and each lock of a cache line" if policy.fetches == "single" else "gets in groups"
    modelled = [
        "threads that render packets of 64 rays, and a master that deals tiles",
        f"blocks that real packets refer to, direct-mapped caches that stay warm, {gets}",
        "the display: adapter and copy threads" if sink else "no display: a frame begins when the last one is rendered",
    ]
    left_out = [
        {"what": "what a hit in the cache costs", "why": "it is inside the trace rates"},
        {"what": "the processors of who owns a block", "why": "an RDMA get needs none of their time"},
        {"what": "shading", "why": "its cost is inside the trace rates"},
        {
            "what": "the critical section of the MPI library that all threads of a node go through",
            "why": "nobody says how long a get is in it; were it all the time, frames that keep an eighth of boeing or "
            "of rm-isosurface would take 1.6 times as long",
        },
    ]
    if policy.fetches == "grouped":
        why = "frames of small cases took up to 15 % longer with them; policy.fetches=single has them"
        left_out.append({"what": "threads of a node that wait for each other's cache lines", "why": why})
    return {"modelled": modelled, "left_out": left_out}
