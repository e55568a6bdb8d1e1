"""The ray tree: the rays of a trace, and those that wrong guesses spawn.

A scheduler that speculates takes each ray through many domains at once. It shades a hit before it knows whether another
domain has a nearer one, and so spawns rays that no renderer would follow (Park, Fussell and Navratil, "SpRay", 2018,
section 4). A ray is known by the row that spawned it, the (ray, domain) pair of the hit: schedulers share all rays that
they have in common, and the true ones among them are the trace's own. The random numbers of wrong rays are keyed as
those of true ones, by pixel, sample and depth.

Ray ids below ``trace.rays`` are those of the trace. Rows are (ray, domain) pairs as in the crossing table, generation
after generation; rays that are spawned, and their rows, are appended.

============ ======== ============================================================================
column       dtype    meaning
============ ======== ============================================================================
a ray's
first, last  i8       its rows, front to back
depth        u1       surface hits before it; a shadow ray is one deeper than the ray that was shaded
shadow       bool
sample       i4       pixel + pixels * sample: the path that it belongs to
spawner      i8       row of the hit that spawned it; -1 for a camera ray
a row's
ray          i8
domain       i2
entry        f4       distance at which the ray enters the domain; a lower bound of its hit
hit          f4       nearest hit in the domain; NaN unknown, infinite for none
child_count  i4       rays that its hit spawns; -1 unknown
child_shadow i4       shadow rays among them
child_first  i8       first of them; -1 unless they have been made
============ ======== ============================================================================

**Order of hits.** A true ray's nearest hit is the one that the trace found. Another domain may have a hit at the same
distance, or nearer by a rounding where the ray meets an edge; such a hit is put right behind the true one. So distances
alone decide between hits, and they decide for the trace's.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from simrender.errors import InvariantError
from simrender.rays import embree
from simrender.rays.crossings import Crossings, enter_domains
from simrender.rays.kinds import SHADOW
from simrender.rays.trace import GEOMETRY, Ids
from simrender.rays.worlds import SurfaceWorld, childless

Columns = dict[str, Any]

_GEOMETRY = tuple(name for name in GEOMETRY if name != "parent")
_RAY = ("first", "last", "depth", "shadow", "sample", "spawner")
_ROW = ("ray", "domain", "entry", "hit")
_CHILDREN = ("child_count", "child_shadow", "child_first")


def ray_tree(crossings: Crossings) -> RayTree:
    """Return the ray tree of crossings, the same one for all that ask."""
    if crossings.tree is None:
        crossings.tree = RayTree(crossings)
    tree: RayTree = crossings.tree
    return tree


class RayTree:
    """The rays of a trace and those that wrong hits spawn.

    Parameters
    ----------
    crossings : Crossings
        Of a trace of surfaces, which is completed, with domains of triangles.

    Attributes
    ----------
    rays, rows : Table
        See the columns above.
    shaded_rows : int
        Rows that were really shaded in this process.

    Raises
    ------
    InvariantError
        If the domains have no triangles, or a ray's nearest hit lies in a domain that it does not enter.

    """

    def __init__(self, crossings: Crossings) -> None:
        if crossings.domains.domain_of_triangle is None or not isinstance(crossings.trace.world, SurfaceWorld):
            raise InvariantError("rays are guessed on surfaces, and these domains have no triangles")
        self.trace, self.domains, self._crossings = crossings.trace, crossings.domains, crossings
        self.world = crossings.trace.world
        self.trace.complete()
        self.shaded_rows = 0
        self._tables = [crossings.table(g) for g in range(self.trace.generations)]
        self._base = np.cumsum([0] + [len(table["domain"]) for table in self._tables])
        self.rays = self._true_rays()
        self.rows = self._true_rows()
        self._join()
        none = childless(np.zeros((0, 3), np.float32))
        self._spawned = Table({name: none[name] for name in _GEOMETRY})
        self._name, self._changed = f"speculative-{self.domains.key}", False
        self._shaded: list[Ids] = []
        self._load()

    # -- what schedulers ask --------------------------------------------------------------------------------------

    def hits(self, rows: Ids) -> NDArray[np.float32]:
        """Return the hits of some rows, float32 (n,), and compute those that are unknown."""
        found: NDArray[np.float32] = self.rows["hit"][rows]
        unknown = rows[np.isnan(found)]
        if len(unknown):
            self._ask(np.unique(unknown))
            found = self.rows["hit"][rows]
        return found

    def children(self, rows: Ids) -> tuple[Ids, NDArray[np.int32]]:
        """Return the rays that the hits of some rows spawn, row after row, and how many each row has.

        Parameters
        ----------
        rows : int64 array (n,)
            Of camera or bounced rays that hit something there; no row twice.

        """
        unknown = rows[(self.rows["child_first"][rows] < 0) & (self.rows["child_count"][rows] != 0)]
        if len(unknown):
            self._append(self._shade(unknown), unknown)
        count = self.rows["child_count"][rows]
        return _ranges(self.rows["child_first"][rows], count), count

    def spawned(self, rows: Ids) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return how many rays the hits of some rows spawn, and how many of these are shadow rays.

        That is all there is to know of wrong rays which nobody takes further; ``rows`` are as for `children`.
        """
        unknown = rows[self.rows["child_count"][rows] < 0]
        if len(unknown):
            self._shade(unknown)
        return self.rows["child_count"][rows], self.rows["child_shadow"][rows]

    def rows_of(self, rays: Ids) -> Ids:
        """Return the rows of some rays, ray after ray."""
        first = self.rays["first"][rays]
        return _ranges(first, self.rays["last"][rays] - first)

    def save(self) -> None:
        """Store what wrong hits spawned since the tree was loaded."""
        if self._changed:
            own, rows = slice(self.trace.rays, None), slice(self._base[-1], None)
            columns = {name: self.rays[name][own] for name in _RAY} | {name: self.rows[name][rows] for name in _ROW}
            shaded = np.unique(np.concatenate(self._shaded))
            columns |= {"shaded": shaded} | {name: self.rows[name][shaded] for name in _CHILDREN}
            columns |= {f"geometry_{name}": self._spawned[name] for name in _GEOMETRY}
            self.trace.store.save(self._name, columns)
            self._changed = False

    # -- how it comes about ---------------------------------------------------------------------------------------

    def _true_rays(self) -> Table:
        trace = self.trace
        first, last = (
            np.concatenate([table["first"][ends] + base for table, base in zip(self._tables, self._base, strict=False)])
            for ends in (slice(-1), slice(1, None))
        )
        parent = np.repeat(np.arange(trace.rays), trace.column("children"))
        generation = np.diff(trace.first)
        sample = np.arange(trace.rays, dtype=np.int32)
        for begin, end in zip(trace.first[1:-1], trace.first[2:], strict=True):
            sample[begin:end] = sample[parent[begin - trace.first[1] : end - trace.first[1]]]
        spawner = np.full(trace.rays, -1, np.int64)
        spawner[trace.first[1] :] = parent  # a ray for now; `_join` knows the row
        return Table({
            "first": first,
            "last": last,
            "depth": np.repeat(np.arange(trace.generations, dtype=np.uint8), generation),
            "shadow": trace.column("kind") == SHADOW,
            "sample": sample,
            "spawner": spawner,
        })  # fmt: skip

    def _true_rows(self) -> Table:
        rays = self.rays
        joined = {name: np.concatenate([table[name] for table in self._tables]) for name in ("domain", "entry", "hit")}
        count = len(joined["domain"])
        return Table({
            "ray": np.repeat(np.arange(rays.count), rays["last"] - rays["first"]),
            **joined,
            **_childless(count),
        })  # fmt: skip

    def _join(self) -> None:
        """Enter what the trace knows: nearest hits, their order, and what they spawn."""
        trace, rays, rows = self.trace, self.rays, self.rows
        owner, primitive, t = self.domains.domain_of_triangle, trace.column("primitive"), trace.column("t")
        assert owner is not None  # noqa: S101 - checked when the tree was made
        nearest = np.where(primitive >= 0, owner[primitive], -1)
        true = np.flatnonzero(rows["domain"] == nearest[rows["ray"]])
        ray = rows["ray"][true]
        true_row = np.full(trace.rays, -1, np.int64)
        true_row[ray] = true
        lost = np.flatnonzero((nearest >= 0) & (true_row < 0))
        if len(lost):
            raise InvariantError(f"ray {lost[0]} hits something in domain {nearest[lost[0]]}, which it never enters")
        known = np.flatnonzero(rows["hit"] < np.inf)
        rows["hit"][known] = self._behind(known, rows["hit"][known])
        rows["hit"][true] = t[ray]
        rows["entry"][true] = np.minimum(rows["entry"][true], t[ray])
        rows["child_first"][true] = trace.column("first_child")[ray]
        rows["child_count"][true] = trace.column("children")[ray]
        spawner = rays["spawner"][trace.first[1] :]
        shadow = rays["shadow"][trace.first[1] :]
        rows["child_shadow"][true] = np.bincount(spawner[shadow], minlength=trace.rays)[ray]
        spawner[:] = true_row[spawner]

    def _behind(self, rows: Ids, hit: NDArray[np.float32]) -> NDArray[np.float32]:
        """Put hits of true rays that are not the nearest behind it."""
        ray = self.rows["ray"][rows]
        t = self.trace.column("t")[ray]
        return np.where(np.isfinite(t), np.maximum(hit, np.nextafter(t, np.float32(np.inf))), hit)

    def _ask(self, rows: Ids) -> None:
        """Compute the hits of some rows, ascending: of true rays where all schedulers find them."""
        part = np.searchsorted(rows, self._base)
        for generation, base in enumerate(self._base[:-1]):
            mine = rows[part[generation] : part[generation + 1]]
            if len(mine):
                self.rows["hit"][mine] = self._behind(mine, self._crossings.hits(generation, mine - base))
        mine = rows[part[-1] :]
        if len(mine):
            ray = self.rows["ray"][mine] - self.trace.rays
            rays = {name: self._spawned[name] for name in _GEOMETRY}
            found = self.world.cross(rays, ray, self.domains, self.rows["domain"][mine], self.trace.seed)
            self.rows["hit"][mine] = found["hit"]
            self._changed = True

    def _shade(self, rows: Ids) -> Columns:
        """Shade the wrong hits of some rows, count what they spawn, and return it."""
        rays = self._geometry(self.rows["ray"][rows])
        hits = self.world.domain_hits(rays, np.arange(len(rows)), self.domains, self.rows["domain"][rows])

        def work(part: slice) -> Columns:
            some = {name: column[part] for name, column in rays.items()}
            found = embree.Hits(hits.t[part], hits.primitive[part], hits.u[part], hits.v[part])
            made = self.world.shade(some, found, self.trace.seed)
            made["parent"] = made["parent"] + np.int64(part.start)
            return {name: made[name].copy() for name in ("children", *GEOMETRY)}

        parts = [work(slice(0, 0)), *embree.in_chunks(work, len(rows))]  # the first one loads the kernels
        made = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        self.rows["child_count"][rows] = made["children"]
        self.rows["child_shadow"][rows] = np.bincount(made["parent"][made["kind"] == SHADOW], minlength=len(rows))
        self._shaded.append(rows)
        self.shaded_rows += len(rows)
        self._changed = True
        return made

    def _append(self, made: Columns, rows: Ids) -> None:
        """Append the rays that the hits of some rows spawned."""
        count, spawner = made["children"].astype(np.int64), rows[made["parent"]]
        self.rows["child_first"][rows] = self.rays.count + np.cumsum(count) - count
        first, domain, entry = enter_domains(self.domains, made["origin"], made["direction"], made["reach"])
        parent, before = self.rows["ray"][spawner], self.rays.count
        self.rays.append({
            "first": first[:-1] + self.rows.count,
            "last": first[1:] + self.rows.count,
            "depth": self.rays["depth"][parent] + np.uint8(1),
            "shadow": made["kind"] == SHADOW,
            "sample": self.rays["sample"][parent],
            "spawner": spawner,
        })  # fmt: skip
        self.rows.append({
            "ray": np.repeat(np.arange(before, self.rays.count), np.diff(first)),
            "domain": domain,
            "entry": entry,
            "hit": np.full(len(domain), np.nan, np.float32),
            **_childless(len(domain)),
        })  # fmt: skip
        self._spawned.append({name: made[name] for name in _GEOMETRY})

    def _geometry(self, rays: Ids) -> Columns:
        """Gather the geometry of rays, true and wrong ones."""
        out = {name: np.empty((len(rays), *c.shape[1:]), c.dtype) for name, c in self._spawned.columns.items()}
        part = np.searchsorted(self.trace.first, rays, side="right") - 1
        for generation in range(self.trace.generations + 1):
            rows = np.flatnonzero(part == generation)
            if len(rows):
                own = generation == self.trace.generations
                source: Any = self._spawned if own else self.trace.geometry(generation)
                local = rays[rows] - self.trace.first[generation]
                for name, column in out.items():
                    column[rows] = source[name][local]
        return out

    def _load(self) -> None:
        names = (*_RAY, *_ROW, "shaded", *_CHILDREN, *(f"geometry_{name}" for name in _GEOMETRY))
        found = self.trace.store.load(self._name, names)
        if found is None:
            return
        self.rays.append({name: found[name] for name in _RAY})
        self.rows.append({name: found[name] for name in _ROW} | _childless(len(found["domain"])))
        self._shaded.append(found["shaded"])
        for name in _CHILDREN:
            self.rows[name][found["shaded"]] = found[name]
        self._spawned.append({name: found[f"geometry_{name}"] for name in _GEOMETRY})


class Table:
    """Columns of one length to which rows are appended; there is room for more, so that few appends copy.

    Attributes
    ----------
    columns : dict of arrays
        With their spare room.
    count : int
        Rows in use.

    """

    def __init__(self, columns: Columns) -> None:
        self.columns = dict(columns)
        self.count = len(next(iter(columns.values())))

    def __getitem__(self, name: str) -> Any:
        """Return a column, as far as it is in use: a view, which an append leaves behind."""
        return self.columns[name][: self.count]

    def append(self, rows: Columns) -> None:
        """Append rows."""
        end = self.count + len(next(iter(rows.values())))
        for name, column in self.columns.items():
            if end > len(column):
                self.columns[name] = np.empty((max(end, len(column) * 3 // 2), *column.shape[1:]), column.dtype)
                self.columns[name][: self.count] = column[: self.count]
            self.columns[name][self.count : end] = rows[name]
        self.count = end


def _childless(rows: int) -> Columns:
    """Return the columns of rows of which it is unknown what they spawn."""
    return {
        "child_count": np.full(rows, -1, np.int32),
        "child_shadow": np.full(rows, -1, np.int32),
        "child_first": np.full(rows, -1, np.int64),
    }


def _ranges(first: Ids, count: NDArray[Any]) -> Ids:
    """Return ``first[i]`` to ``first[i] + count[i] - 1`` for each i, one after the other."""
    total = np.cumsum(count, dtype=np.int64)
    ranges: Ids = np.arange(total[-1] if len(total) else 0) + np.repeat(first - (total - count), count)
    return ranges
