"""Speculation: guess that every ray meets every domain on its way, and find out later which guesses were right.

Park, Fussell and Navratil, "SpRay: speculative ray scheduling for large data visualization" (2018), section 4. Out of
core a ray waits for all domains that it enters at once, and a hit spawns rays before it is known to be the nearest one;
a history buffer of distances tells right from wrong. In situ rays go to the owners of all these domains at once, and
the ranks combine their buffers of distances and occlusions after every bounce.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field

from simrender.policies.blocking import Blocking, equal_tiles, program_tiles
from simrender.policies.domain_frame import Steps
from simrender.policies.domain_rank import DomainRank
from simrender.policies.history import Flags, HistoryBuffer, bounces, check_lit, rows_in
from simrender.policies.queues import DomainQueues
from simrender.policies.speculation_in_situ import InSitu
from simrender.policies.std_sort import descending
from simrender.rays.speculative import RayTree, ray_tree

Ids = NDArray[np.int64]

WEIGHTS = 16
"""Domains on a ray's way that count towards the traversal score: M."""

ENTRY_BYTES = 16.0
"""An entry of a ray batch queue: the ray, how far away the domain is, and its place on the ray's way."""

NONE = np.zeros(0, np.int64)


@dataclass(frozen=True)
class Speculation:
    """Queue every ray for all domains that it enters; shade hits before they are known to be the nearest.

    Parameters
    ----------
    data : "out_of_core" or "in_situ"
        Every rank renders its stripe of the image and loads domains into its cache (4.1). Or each domain stays with its
        owner, blocks in Morton order, and rays go to all owners at once (4.2).
    cache : str
        Domains in a rank's cache: a number, a share such as 25%, a size such as 8 GB, or all. Least recently used ones
        make room.
    history_depth : int, optional
        Hits of a path that may be guesses, H; as many as a path can have, by default, as in the paper. In situ it is 1.
    tiles : int or "auto"
        Parts that the image is rendered in, one after the other: what rays, queues and buffers take is divided among
        them. Each rank takes a share of each. ``auto``: the smallest power of two with which they fit into memory.
    ray_bytes : float, optional
        Size of a ray: 64 B in situ and 64 B + 4 B H out of core, as in the authors' program, by default.
    header_bytes : float
        Of a message with rays.
    threads : int, optional
        Cores of a rank that trace; all by default. The paper's in situ renderers use one.
    messages : "grouped" or "single"
        In situ, whether messages from one rank to another that the MPI library treats alike travel as one of their
        number's share, or each on its own. Frames of 16 to 128 ranks differed by up to 1.7 %; with 1,427 domains on 128
        ranks it takes a fifth of the time to simulate.
    owners : tuple of int, optional
        The rank of each domain in situ; blocks in Morton order by default.
    like_program : bool
        Follow the authors' program where it departs from the paper's listings: domains with equal scores come as the
        C++ library sorts them; in situ a rank takes all hits that it cached before any other ray; the image is cut into
        vertical stripes out of core, and into tiles of 1,048,576 samples a rank, unless ``tiles`` says how many. What
        the program does wrong is not followed.

    """

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")

    data: Literal["out_of_core", "in_situ"] = "out_of_core"
    cache: str | int = "all"
    history_depth: Annotated[int, Field(ge=1)] | None = None
    tiles: Annotated[int, Field(ge=1)] | Literal["auto"] = 1
    ray_bytes: Annotated[float, Field(gt=0)] | None = None
    header_bytes: Annotated[float, Field(ge=0)] = 16.0
    threads: Annotated[int, Field(ge=1)] | None = None
    messages: Literal["grouped", "single"] = "grouped"
    owners: tuple[int, ...] | None = None
    like_program: bool = False

    @property
    def in_situ(self) -> bool:
        """Whether domains stay with their owners."""
        return self.data == "in_situ"

    def rank(self, me: DomainRank) -> Steps:
        """Render one frame."""
        tree = ray_tree(me.frame.crossings)
        blocking = me.alike(lambda: self.blocking(me))
        if self.in_situ:
            shared = me.alike(
                lambda: InSitu(
                    me.frame, tree, blocking, self.ray_bytes, self.header_bytes, self.like_program,
                    self.messages == "grouped",
                )
            )  # fmt: skip
            for tile in range(blocking.tiles):
                yield from shared.spray(me, tile)
        else:
            mine = OutOfCore(self, me, tree, blocking)
            for tile in range(blocking.tiles):
                yield from mine.spray(tile)
        yield from me.merge_frame()
        tree.save()

    def blocking(self, me: DomainRank) -> Blocking:
        """Cut the image into tiles, and these into the parts of the ranks."""
        frame = me.frame
        if self.like_program and self.tiles == 1 and (frame.rank_of_pixel >= 0).all():
            samples = frame.trace.samples * frame.weight
            found = program_tiles(frame.trace.size, samples, frame.ranks, in_situ=self.in_situ)
            frame.rank_of_pixel = found.rank
            return found
        return equal_tiles(frame.rank_of_pixel, 1 if self.tiles == "auto" else self.tiles)


class OutOfCore:
    """One rank that loads domains: listings 2 to 4.

    Rays wait as rows of the ray tree, (ray, domain) pairs.

    Attributes
    ----------
    rq, sq_in, sq_out : DomainQueues
        Radiance rays; shadow rays from before this round, and those spawned in it.
    commit_sq, retire_sq : list of int64 arrays
        Shadow rays that met nothing so far, of this round and of the one before.
    spill_rq : list of int64 arrays
        Radiance rays deeper than the history buffer.

    """

    def __init__(self, policy: Speculation, me: DomainRank, tree: RayTree, blocking: Blocking) -> None:
        frame = me.frame
        self.policy, self.me, self.tree, self.counters = policy, me, tree, frame.counters
        depth = policy.history_depth or bounces(frame.trace.integrator)
        samples = frame.trace.pixels * frame.trace.samples
        buffer = me.alike(lambda: np.full((samples, depth), np.inf, np.float32))
        self.hbuf = HistoryBuffer(tree, buffer)
        self.camera_rays = me.camera_rays()
        self.tile = blocking.tile
        self.flags = me.alike(lambda: Flags(tree))
        self.rq, self.sq_in, self.sq_out = (DomainQueues(frame.domains.count) for _ in range(3))
        self.statistics = np.zeros(frame.domains.count, np.int64)
        self.commit_sq: list[Ids] = []
        self.retire_sq: list[Ids] = []
        self.spill_rq: list[Ids] = []
        self.born: list[Ids] = []
        self.alive = 0
        self.ray_bytes = policy.ray_bytes or 64.0 + 4.0 * depth
        self.rounds = 0

    def spray(self, tile: int) -> Steps:
        """Render the rank's part of a tile (listing 2)."""
        me, ray_depth = self.me, 0
        samples = self.samples(tile)
        self.buffer_bytes = 4.0 * self.hbuf.depth * len(samples)
        rays = self.camera_rays
        self.domain_queuing(rays[self.tile[me.frame.trace.column("pixel")[rays]] == tile])
        while True:
            spilled, self.spill_rq = joined(self.spill_rq), []
            self.domain_queuing(spilled[self.hbuf.visibility(spilled)])
            self.hbuf.reset(ray_depth, samples)
            while self.rq.any() or self.sq_in.any() or self.retire_sq:
                for domain in self.schedule():
                    if not any(queues.counts[domain] for queues in (self.rq, self.sq_in, self.sq_out)):
                        continue
                    waiting = self.rq.counts + self.sq_in.counts + self.sq_out.counts
                    rq = self.filter(self.rq, domain)
                    sq_in = self.filter(self.sq_in, domain)
                    sq_out = self.filter(self.sq_out, domain)
                    self.statistics[domain] = 0
                    if len(rq) or len(sq_in) or len(sq_out):
                        me.explain(waiting, (domain,))
                        me.begin_visit()
                        yield from me.load(domain)
                        tests = len(sq_in) + len(sq_out) + self.process_rq(domain, rq)
                        self.process_sq(sq_in, self.retire_sq)
                        self.process_sq(sq_out, self.commit_sq)
                        yield from me.query(domain, self.hbuf.camera_rays(rq), len(rq), tests)
                        me.end_visit(domain)
                        me.next_step()
                self.retire()
                self.retire_sq, self.commit_sq = self.commit_sq, []
                self.sq_in, self.sq_out = self.sq_out, self.sq_in
                self.rounds += 1
            self.settle()
            ray_depth += self.hbuf.depth
            if not self.spill_rq:
                break
        self.counters.rounds = max(self.counters.rounds, self.rounds)

    def samples(self, tile: int) -> Ids:
        """Return the samples of this rank's part of a tile."""
        frame = self.me.frame
        pixels = np.flatnonzero((frame.rank_of_pixel == self.me.index) & (self.tile == tile))
        samples: Ids = (pixels + frame.trace.pixels * np.arange(frame.trace.samples)[:, None]).ravel()
        return samples

    def domain_queuing(self, rays: Ids) -> None:
        """Queue radiance rays for all domains that they enter, and count them (listing 2, lines 3 and 8)."""
        rows = self.tree.rows_of(rays)
        self.counters.radiance_queued += len(rows)
        self.born.append(rays)
        self.put(self.rq, rows, len(rays))

    def put(self, queues: DomainQueues, rows: Ids, rays: int) -> None:
        """Queue rows of new rays; the nearer a domain is to where a ray begins, the more it counts (4.1.2)."""
        tree = self.tree
        domain = tree.rows["domain"][rows]
        queues.put(rows, domain)
        place = rows - tree.rays["first"][tree.rows["ray"][rows]]
        weight = np.maximum(WEIGHTS - place, 0)
        self.statistics += np.bincount(domain, weight, minlength=len(self.statistics)).astype(np.int64)
        self.alive += rays
        entries = int(self.rq.counts.sum() + self.sq_in.counts.sum() + self.sq_out.counts.sum())
        peak, frame = self.me.frame.peak_bytes, self.me.frame
        needs = (self.alive * self.ray_bytes + entries * ENTRY_BYTES + self.buffer_bytes) * frame.weight
        peak[self.me.index] = max(peak[self.me.index], needs)

    def schedule(self) -> list[int]:
        """Return all domains, those of the highest traversal score first (4.1.2; listing 2, line 12)."""
        if self.policy.like_program:
            return descending(self.statistics)
        order: list[int] = np.argsort(-self.statistics, kind="stable").tolist()
        return order

    def filter(self, queues: DomainQueues, domain: int) -> Ids:
        """Take the rows that wait for a domain and keep those that may still be right (listing 3)."""
        rows = queues.take(domain)
        if len(rows) == 0:
            return rows
        if queues is self.rq:
            kept: Ids = rows[self.hbuf.farther_than(rows)]
            self.counters.radiance_filtered += len(rows) - len(kept)
            return kept
        rays = self.tree.rows["ray"][rows]
        kept = rows[self.hbuf.visibility(rays) & ~self.flags.occluded[rays]]
        self.counters.shadow_filtered += len(rows) - len(kept)
        return kept

    def process_rq(self, domain: int, rows: Ids) -> int:
        """Intersect radiance rays and shade those with a new nearest hit (listing 4, lines 1 to 7).

        Returns
        -------
        int
            Shadow rays that were tested at their birth.

        """
        tree = self.tree
        hit = rows[self.tree.hits(rows) < np.inf]
        success = self.hbuf.update(hit)
        self.counters.rejected_hits += len(hit) - int(success.sum())
        rays, _ = tree.children(hit[success])
        self.flags.grow()
        self.counters.wrong_rays += int((rays >= tree.trace.rays).sum())
        shadow = tree.rays["shadow"][rays]
        self.process_secondary(domain, rays[~shadow], rays[shadow])
        return int(shadow.sum())

    def process_secondary(self, domain: int, rs: Ids, ss: Ids) -> None:
        """Queue the rays that hits in a domain spawned (listing 4, lines 8 to 16)."""
        tree = self.tree
        deep = self.hbuf.spills(rs)
        if deep.any():
            self.spill_rq.append(rs[deep])
            self.counters.spilled_rays += int(deep.sum())
        self.domain_queuing(rs[~deep])
        if len(ss) == 0:
            return
        here = np.full(len(ss), domain, np.int16)
        birth = rows_in(ss, here, tree.rays["first"], tree.rays["last"], tree.rows["domain"])
        enters = birth >= 0
        self.flags.occluded[ss[enters]] = tree.hits(birth[enters]) < np.inf
        self.born.append(ss)
        free = ss[~self.flags.occluded[ss]]
        rows = tree.rows_of(free)
        rows = rows[tree.rows["domain"][rows] != domain]
        self.counters.shadow_queued += len(rows)
        self.put(self.sq_out, rows, len(ss))
        self.flags.waits[tree.rows["ray"][rows]] = True
        self.commit(free[~self.flags.waits[free]], self.commit_sq)

    def process_sq(self, rows: Ids, commit_sq: list[Ids]) -> None:
        """Test shadow rays; commit those that meet nothing, if they are not yet (listing 4, lines 17 to 22)."""
        if len(rows) == 0:
            return
        rays, hit = self.tree.rows["ray"][rows], self.tree.hits(rows) < np.inf
        self.flags.occluded[rays[hit]] = True
        free = rays[~hit]
        self.commit(free[~self.flags.committed[free]], commit_sq)

    def commit(self, rays: Ids, commit_sq: list[Ids]) -> None:
        """Commit shadow rays."""
        if len(rays):
            self.flags.committed[rays] = True
            commit_sq.append(rays)

    def retire(self) -> None:
        """Add the light of shadow rays that were committed a round ago, if they are right (listing 2, line 23)."""
        rays = joined(self.retire_sq)
        rays = rays[~self.flags.occluded[rays]]
        rays = rays[self.hbuf.visibility(rays)]
        check_lit(self.tree, rays)
        self.me.retire(rays)

    def settle(self) -> None:
        """Count as done the radiance rays that turned out right, and the shadow rays of theirs that bring no light."""
        rays = joined(self.born)
        rays = rays[~self.tree.rays["shadow"][rays] | self.flags.occluded[rays]]
        self.me.retire(rays[self.hbuf.visibility(rays)])
        self.born, self.alive = [], 0


def joined(parts: list[Ids]) -> Ids:
    """Return the rays of some batches."""
    return np.concatenate(parts) if parts else NONE
