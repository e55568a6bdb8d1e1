"""A scheduler of domains on a machine, without the command line: what the tests of these policies run."""

from __future__ import annotations

from functools import cache

import numpy as np
import simpy
from hypothesis import strategies as st

from simrender.hardware.machine import Machine, load_machine
from simrender.policies.domain_frame import DomainFrame, DomainPolicy, domain_cache, stripes
from simrender.policies.domain_rank import DomainRank
from simrender.rays.crossings import Crossings
from simrender.rays.domains import morton_ranks
from simrender.rays.integrators import AmbientOcclusion, PathTracing, SprayPathTracing
from simrender.rays.trace import Trace
from simrender.rays.visits import Visits, visits
from simrender.rays.workload import Workload, load_workload
from simrender.rays.workload_card import DomainsCard
from simrender.timeline import Timeline
from tests.scenes import garden, garden_workload

WAVELETS = "tests/data/wavelets64.spray"
"""The example scene of SpRay's authors: 64 domains."""

visits_of = cache(visits)


@cache
def wavelets(*settings: str) -> Crossings:
    """The crossings of that scene as their program traces it: 512x512 pixels, one point light, one bounce."""
    workload = load_workload(WAVELETS, settings)
    workload.trace(1).complete()
    return workload.domain_crossings(1, workload.domains())


_CUTS = [
    DomainsCard(method="given"),
    *(DomainsCard(method="sah", count=count) for count in (2, 5, 13)),
    *(DomainsCard(method="objects", count=count) for count in (1, 4)),
    *(DomainsCard(method=method, shape=(3, 2, 2)) for method in ("grid", "balanced")),
]

_LIGHTING = [PathTracing(), AmbientOcclusion(2), SprayPathTracing(2, 3)]


@cache
def _workload(seed: int, balls: int) -> Workload:
    return garden_workload("24x16", "24x16", 1, scene=garden(seed, balls))


@cache
def _trace(seed: int, balls: int, lighting: int) -> Trace:
    usual = _workload(seed, balls).trace()
    trace = Trace(usual.scene, usual.camera, usual.size, 1, _LIGHTING[lighting])
    trace.complete()
    return trace


@cache
def _garden(seed: int, balls: int, cut: int, lighting: int) -> Crossings:
    return Crossings(_trace(seed, balls, lighting), _workload(seed, balls).domains(_CUTS[cut]))


def gardens() -> st.SearchStrategy[Crossings]:
    """Crossings of a small scene: random balls on a floor, cut in some way and lit in some way."""
    cuts, lighting = (st.sampled_from(range(len(choices))) for choices in (_CUTS, _LIGHTING))
    return st.builds(_garden, st.integers(1, 3), st.sampled_from([1, 25]), cuts, lighting)


def play(
    policy: DomainPolicy,
    crossings: Crossings,
    ranks: int = 1,
    *,
    owner: np.ndarray | None = None,
    planned: Visits | None = None,
    pixels: np.ndarray | None = None,
    card: str = "stampede2-skx",
) -> DomainFrame:
    """Render one frame on so many ranks; return their state at its end.

    Domains stay with ``owner``, by default in blocks along the z-order curve, where the policy wants them in situ.
    ``pixels`` gives the rank of each pixel, negative for none; horizontal stripes unless given.
    """
    env = simpy.Environment()
    machine = Machine(env, load_machine(card), ranks)
    domains = crossings.domains
    if policy.in_situ and owner is None:
        owner = morton_ranks(domains.low, domains.high, ranks)
    frame = DomainFrame(
        env,
        machine,
        crossings,
        planned or visits_of(crossings),
        policy,
        Timeline(ranks),
        machine.communicator(list(range(ranks))) if ranks > 1 else None,
        owner.astype(np.int64) if policy.in_situ else None,
        stripes(crossings.trace.size, ranks) if pixels is None else pixels,
        [domain_cache(policy.cache, domains.bytes.tolist()) for _ in range(ranks)],
        1.0,
        crossings.trace.size,
    )
    env.run(env.all_of([env.process(policy.rank(DomainRank(frame, index))) for index in range(ranks)]))
    return frame


def check_image(frame: DomainFrame) -> None:
    """Each ray of the reference renderer was retired once, and the image is the same to the bit."""
    retired = np.concatenate(frame.retired)
    assert (np.bincount(retired, minlength=frame.trace.rays) == 1).all()
    assert frame.trace.image(np.sort(retired)).tobytes() == frame.trace.reference.tobytes()


def schedule(frame: DomainFrame, rank: int = 0) -> list[int]:
    """The domains that a rank visited, in order."""
    return [event.domain for event in frame.events if event.rank == rank]
