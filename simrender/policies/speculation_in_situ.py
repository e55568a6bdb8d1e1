"""Speculation in situ: rays go to the owners of all domains on their way at once.

Park, Fussell and Navratil, "SpRay: speculative ray scheduling for large data visualization" (2018), section 4.2 and
listings 5 to 7.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simrender.policies.blocking import Blocking
from simrender.policies.domain_frame import DomainFrame, Steps
from simrender.policies.domain_rank import DomainRank
from simrender.policies.history import bounces, check_lit, rows_in, shadow_rays
from simrender.rays.speculative import RayTree

Ids = NDArray[np.int64]
Mask = NDArray[np.bool_]

RADIANCE, SHADOW = 0, 1
"""Kinds of ray, and message tags."""

DEFAULT_RAY_BYTES = 64.0

POINTER_BYTES = 8.0
"""An entry of a ray batch queue."""

INTERSECTION_BYTES = 96.0
"""The intersection of a radiance ray in the intersection cache."""


@dataclass(frozen=True, eq=False)
class Queued:
    """Rays of one kind in the queues of the domains that they go to, on all ranks.

    Attributes
    ----------
    rays : int64 array (n,)
        True ones, for all guesses before are resolved.
    source : int64 array (n,)
        The rank that has each ray.
    first : int64 array (n + 1,)
        Ray i goes through the rows ``first[i]:first[i + 1]``.
    rows : int64 array
        Rows of the ray tree, in the order in which their owners come to their domains.
    cached : bool array (rows,)
        Whether the intersection is known from the birth of the ray, and waits in the cache queue.

    """

    rays: Ids
    source: Ids
    first: Ids
    rows: Ids
    cached: Mask


@dataclass(frozen=True, eq=False)
class Batch:
    """The rays of one bounce.

    Attributes
    ----------
    radiance, shadow : Queued
        The shadow rays are in the retire queue as well: they bring light unless something is in their way.
    source, domain, kind, rays : int64 array (blocks,)
        How many rays of each kind each rank has for each domain, by source: what is sent as one message.

    """

    radiance: Queued
    shadow: Queued
    source: Ids
    domain: Ids
    kind: Ids
    rays: Ids


@dataclass(frozen=True, eq=False)
class Processed:
    """What the ranks made of a batch.

    Attributes
    ----------
    radiance, shadow : int64 array (domains,)
        Queries in each domain.
    right : int64 array
        The rows of hits that are the nearest in the buffers of all ranks.
    occluded : bool array
        Which of the batch's shadow rays have something in their way.

    """

    radiance: Ids
    shadow: Ids
    right: Ids
    occluded: Mask


class InSitu:
    """All ranks of a frame; what they do between two collectives is worked out at once, for nothing else matters to it.

    Parameters
    ----------
    frame : DomainFrame
    tree : RayTree
    blocking : Blocking
    ray_bytes : float or None
    header_bytes : float
    cached_first : bool
        Whether a rank takes all cached hits before any other ray, and not domain by domain.
    grouped : bool
        Whether a rank's messages to another one travel together; see `DomainRank.post`.

    Attributes
    ----------
    tbuf_bytes, obuf_bytes : float
        Of the buffers that every rank holds for all samples of a tile, as published.

    """

    def __init__(
        self,
        frame: DomainFrame,
        tree: RayTree,
        blocking: Blocking,
        ray_bytes: float | None,
        header_bytes: float,
        cached_first: bool,
        grouped: bool,
    ) -> None:
        assert frame.owner is not None  # noqa: S101 - domains stay with ranks
        self.frame, self.tree, self.owner, self.cached_first = frame, tree, frame.owner, cached_first
        self.blocking = blocking
        self.max_depth = bounces(frame.trace.integrator)
        self.ray_bytes, self.header_bytes = ray_bytes or DEFAULT_RAY_BYTES, header_bytes
        self.grouped = grouped
        self.tbuf_bytes = self.obuf_bytes = 0.0

    def spray(self, me: DomainRank, tile: int) -> Steps:
        """Render a tile as one of the ranks (listing 5)."""
        ray_depth = 0
        batch = me.alike(lambda: self.camera_rays(tile))
        while True:
            work = yield from me.allreduce(self.work_counter(me.index, batch))
            if not work.any():
                break
            if me.index == 0:
                waiting = np.bincount(batch.domain, batch.rays, self.frame.domains.count).astype(np.int64)
                me.explain(waiting, tuple(np.flatnonzero(waiting).tolist()), together=True)
            me.count_step()
            yield from self.send_and_receive(me, batch)
            done = me.alike(lambda: self.process(batch))  # noqa: B023 - called at once
            tests = done.radiance + done.shadow
            for domain in me.owned[tests[me.owned] > 0].tolist():
                radiance, shadow = int(done.radiance[domain]), int(done.shadow[domain])
                me.begin_visit()
                yield from me.load(domain)
                yield from me.query(domain, radiance if ray_depth == 0 else 0, radiance, shadow)
                me.end_visit(domain)
            if ray_depth < self.max_depth:
                yield from self.combine(me, "tbuf_bytes")
            if ray_depth > 0:
                yield from self.combine(me, "obuf_bytes")
            batch = me.alike(lambda: self.resolve_visibility(batch, done))  # noqa: B023
            me.next_step()
            ray_depth += 1
        if me.index == 0:
            self.frame.counters.rounds += ray_depth

    def camera_rays(self, tile: int) -> Batch:
        """Queue all camera rays of a tile, for which there are buffers now (listing 5, line 4)."""
        trace, rank_of_pixel = self.frame.trace, self.blocking.rank
        mine = (rank_of_pixel >= 0) & (self.blocking.tile == tile)
        samples = float(mine.sum()) * trace.samples * self.frame.weight
        self.tbuf_bytes = 4.0 * samples
        self.obuf_bytes = 4.0 * float(np.ceil(samples * shadow_rays(self.tree) / 32.0))
        pixel = trace.column("pixel")[: trace.first[1]]
        rank, rays = rank_of_pixel[pixel], np.flatnonzero(mine[pixel])
        nowhere, none = np.full(len(rays), -1, np.int64), np.zeros(0, np.int64)
        return self.blocks(
            self.domain_queuing(rays, rank[rays], nowhere, np.full(len(rays), np.inf, np.float32)),
            self.domain_queuing(none, none, none, np.zeros(0, np.float32)),
        )

    def domain_queuing(self, rays: Ids, source: Ids, birth: Ids, hit: NDArray[np.float32]) -> Queued:
        """Queue rays for all domains that begin before the hit in the domain of their birth.

        Parameters
        ----------
        rays, source : int64 array (n,)
        birth : int64 array (n,)
            The row of each ray in the domain of its birth, through which it has been already; -1 for none.
        hit : float32 array (n,)
            What it hit there, which waits in the cache queue; infinite for none.

        """
        tree = self.tree
        first = np.zeros(len(rays) + 1, np.int64)
        arguments = (
            rays, birth, hit, self.cached_first,
            tree.rays["first"], tree.rays["last"], tree.rows["domain"], tree.rows["entry"], first,
        )  # fmt: skip
        _scatter(*arguments, np.zeros(0, np.int64))
        np.cumsum(first, out=first)
        rows = np.empty(first[-1], np.int64)
        if len(rows):
            _scatter(*arguments, rows)
        return Queued(rays, source, first, rows, rows == np.repeat(birth, np.diff(first)))

    def blocks(self, radiance: Queued, shadow: Queued) -> Batch:
        """Count what each rank has for each domain."""
        count, keys = self.frame.domains.count, []
        for kind, queued in ((RADIANCE, radiance), (SHADOW, shadow)):
            source = np.repeat(queued.source, np.diff(queued.first))[~queued.cached]
            keys.append((source * count + self.tree.rows["domain"][queued.rows[~queued.cached]]) * 2 + kind)
        rays = np.bincount(np.concatenate(keys), minlength=2 * count * self.frame.ranks)
        key = np.flatnonzero(rays)
        self.frame.counters.radiance_queued += len(keys[RADIANCE])
        self.frame.counters.shadow_queued += len(keys[SHADOW])
        return Batch(radiance, shadow, key // (2 * count), key // 2 % count, key % 2, rays[key])

    def work_counter(self, rank: int, batch: Batch) -> Ids:
        """Return what a rank has to do for each rank: blocks of rays, and one where rays wait in its own queues."""
        work = np.bincount(self.owner[batch.domain[batch.source == rank]], minlength=self.frame.ranks)
        work[rank] += bool((batch.radiance.source == rank).any() or (batch.shadow.source == rank).any())
        return work

    def send_and_receive(self, me: DomainRank, batch: Batch) -> Steps:
        """Send each block to the owner of its domain, and receive those for this rank (listing 5, line 8)."""
        target = self.owner[batch.domain]
        mine = (batch.source == me.index) & (target != me.index)
        leaving = me.post(target[mine], batch.rays[mine], self.ray_bytes, self.header_bytes, self.grouped)
        arriving = (batch.source != me.index) & (target == me.index)
        yield from me.collect(int(arriving.sum()), int(batch.rays[arriving].sum()))
        for event in leaving:  # noqa: UP028 - SimPy's events are no generators
            yield event

    def process(self, batch: Batch) -> Processed:
        """Query the domains for all rays, shade the hits that are nearest on a rank so far (listing 6)."""
        tree, domains, counters = self.tree, self.frame.domains.count, self.frame.counters
        queued, shadow = batch.radiance, batch.shadow
        domain = tree.rows["domain"]
        hit = tree.hits(queued.rows)
        success, right = np.zeros(len(hit), np.bool_), np.zeros(len(hit), np.bool_)
        nearest = np.full(self.frame.ranks, np.inf, np.float32)
        _update_tbuf(queued.first, self.owner[domain[queued.rows]], hit, nearest, success, right)
        counters.rejected_hits += int((hit < np.inf).sum() - success.sum())
        shaded, nearest_of_all = queued.rows[success], queued.rows[right]
        # Of what wrong hits spawn only its number matters: it is tested at once, where it is born, and then forgotten.
        spawned, spawned_shadows = tree.spawned(shaded)
        counters.wrong_rays += int(spawned.sum() - tree.spawned(nearest_of_all)[0].sum())
        born = domain[shaded]

        hit = tree.hits(shadow.rows)
        tested, occluded = np.zeros(len(hit), np.bool_), np.zeros(len(shadow.rays), np.bool_)
        stopped = np.full(self.frame.ranks, -1)
        _test_shadows(shadow.first, self.owner[domain[shadow.rows]], hit, stopped, tested, occluded)
        self.retire(queued.rays)

        def count(rows: Ids, spawned: NDArray[np.int32]) -> Ids:
            queries = np.bincount(domain[rows], minlength=domains) + np.bincount(born, spawned, domains)
            return queries.astype(np.int64)

        self.count_memory(batch, self.owner[born], spawned, spawned_shadows)
        return Processed(
            count(queued.rows[~queued.cached], spawned - spawned_shadows),
            count(shadow.rows[tested], spawned_shadows),
            nearest_of_all,
            occluded,
        )

    def resolve_visibility(self, batch: Batch, done: Processed) -> Batch:
        """Keep the rays that the nearest hits of all ranks spawned, and queue them (listing 7).

        The retire queue is emptied first (listing 5, line 16).
        """
        lit = batch.shadow.rays[~done.occluded]
        check_lit(self.tree, lit)
        self.retire(batch.shadow.rays)
        tree, owner = self.tree, self.owner
        rays, count = tree.children(done.right)
        domain = np.repeat(tree.rows["domain"][done.right], count)
        birth = rows_in(rays, domain, tree.rays["first"], tree.rays["last"], tree.rows["domain"])
        hit = np.full(len(rays), np.inf, np.float32)
        hit[birth >= 0] = tree.hits(birth[birth >= 0])
        shadow = tree.rays["shadow"][rays]
        occluded = shadow & (hit < np.inf)
        self.retire(rays[occluded])
        source = owner[domain]
        free = shadow & ~occluded
        return self.blocks(
            self.domain_queuing(rays[~shadow], source[~shadow], birth[~shadow], hit[~shadow]),
            self.domain_queuing(rays[free], source[free], birth[free], hit[free]),
        )

    def combine(self, me: DomainRank, buffer: str) -> Steps:
        """Take the minimum, or the bitwise or, of a buffer over all ranks (listing 5, lines 13 and 15)."""
        nbytes = float(getattr(self, buffer))
        if me.index == 0 and me.ranks > 1:
            counters = self.frame.counters
            setattr(counters, buffer, getattr(counters, buffer) + nbytes)
        yield from me.combine(nbytes)

    def retire(self, rays: Ids) -> None:
        """Add what rays contribute to the image."""
        if len(rays):
            self.frame.retired.append(rays)

    def count_memory(
        self, batch: Batch, spawner: Ids, spawned: NDArray[np.int32], spawned_shadows: NDArray[np.int32]
    ) -> None:
        """Note what each rank holds: its rays, those it got, those it spawned, and the buffers."""
        frame, ranks, held = self.frame, self.frame.ranks, np.zeros(self.frame.ranks)
        for queued in (batch.radiance, batch.shadow):
            source = np.repeat(queued.source, np.diff(queued.first))
            target = self.owner[self.tree.rows["domain"][queued.rows]]
            held += np.bincount(queued.source, minlength=ranks) * self.ray_bytes
            held += np.bincount(source, minlength=ranks) * POINTER_BYTES
            held += np.bincount(target[target != source], minlength=ranks) * self.ray_bytes
        held += np.bincount(spawner, spawned, ranks) * self.ray_bytes
        held += np.bincount(spawner, spawned - spawned_shadows, ranks) * INTERSECTION_BYTES
        held = held * frame.weight + 2.0 * self.tbuf_bytes + self.obuf_bytes
        frame.peak_bytes[:] = np.maximum(frame.peak_bytes, held).tolist()


@njit(cache=True, nogil=True, error_model="numpy")
def _scatter(rays, birth, hit, cached_first, first, last, domain, entry, begin, out):  # type: ignore[no-untyped-def]
    """Count the rows that each ray goes through into ``begin[1:]``, or fill them in, by domain."""
    fill = len(out) > 0
    for i in range(len(rays)):
        at = begin[i] if fill else 0
        end = at
        for row in range(first[rays[i]], last[rays[i]]):
            mine = row == birth[i]
            if (mine and hit[i] == np.inf) or (not mine and entry[row] >= hit[i]):
                continue
            if fill:
                k = end
                while k > at and not (cached_first and out[k - 1] == birth[i]):
                    if not (cached_first and mine) and domain[out[k - 1]] < domain[row]:
                        break
                    out[k] = out[k - 1]
                    k -= 1
                out[k] = row
            end += 1
        if not fill:
            begin[i + 1] = end


@njit(cache=True, nogil=True, error_model="numpy")
def _update_tbuf(first, owner, hit, nearest, success, right):  # type: ignore[no-untyped-def]
    """Enter hits into the buffer of the rank that found them, and say which are nearer than what was there.

    ``right`` are those that are nearest of all ranks; ``nearest``, all infinite, has a place for each rank.
    """
    for i in range(len(first) - 1):
        best = np.inf
        for k in range(first[i], first[i + 1]):
            if hit[k] < nearest[owner[k]]:
                nearest[owner[k]] = hit[k]
                success[k] = True
                best = min(best, hit[k])
        for k in range(first[i], first[i + 1]):
            right[k] = success[k] and hit[k] == best
            nearest[owner[k]] = np.inf


@njit(cache=True, nogil=True, error_model="numpy")
def _test_shadows(first, owner, hit, stopped, tested, occluded):  # type: ignore[no-untyped-def]
    """Say which rows are tested: a rank does not test a shadow ray that it found to be occluded."""
    for i in range(len(first) - 1):
        for k in range(first[i], first[i + 1]):
            if stopped[owner[k]] != i:
                tested[k] = True
                if hit[k] < np.inf:
                    stopped[owner[k]] = i
                    occluded[i] = True
