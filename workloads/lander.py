"""A stand-in for the Fun3D Mars lander: a blunt body braking on its engines, in unstructured, pre-partitioned meshes.

The originals (islands paper, section 7.2) are simulations of supersonic retropropulsion with 0.8 and 6.4 G elements
that Fun3D partitioned into 72 and 552 non-convex meshes. This one has the same make-up at a size that a laptop traces
in seconds. The vehicle, a heat shield of 70 degrees half angle and a back shell, is a hole in the mesh. Layers of thin
wedges lie on its wall, tetrahedra fill where plumes, shock and wake are, hexahedra the calm rest, and pyramids mediate,
so that two elements never meet in a triangle of one and a quadrilateral of the other. Elements grow away from the wall.

Parts follow a Hilbert curve through the elements, as solvers partition them that have no graph partitioner at hand;
the space is warped first, so parts interlock raggedly. They have equally many elements and share their points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simrender.rays.elements import FACES, Elements
from simrender.rays.scene import Environment, Scene
from simrender.rays.volume import TransferFunction
from workloads.terrain import F64, I64, generator, smoothstep, unit

RADIUS = 8.0
"""Of the heat shield, in metres; the flow comes from negative x."""

NOZZLES = 4
_WALL, _CORE, _BLOCK = 0, 1, 2  # kinds of cells: two wedges, pieces around a centre, one hexahedron

Shape = NDArray[np.int8]


def lander(*, seed: int = 1, parts: int = 72, elements: int = 400_000) -> Scene:
    """Generate the scene.

    Parameters
    ----------
    seed : int
    parts : int
        Number of parts the mesh comes in.
    elements : int
        About how many elements there are, from some 2,000 on.

    Returns
    -------
    Scene
        An unstructured volume and nothing else, in metres. The scalar, 0 to 1, stands for vorticity.

    """
    none = np.zeros(0, np.int32), np.zeros((0, 3, 4), np.float32)
    sky = Environment((0.02, 0.02, 0.03), (0.05, 0.05, 0.06), (0.02, 0.02, 0.03))
    return Scene((), *none, environment=sky, elements=lander_elements(seed=seed, parts=parts, elements=elements))


def lander_elements(*, seed: int = 1, parts: int = 72, elements: int = 400_000) -> Elements:
    """Generate the mesh of `lander`."""
    flow = _Flow(seed)
    n = 3
    for _ in range(4):  # the number of elements grows with the cube of n, roughly
        n = max(3, round(n * (elements / _count(_Shell(flow, n, 2 * n))) ** (1.0 / 3.0)))
    layers = 2 * n
    for _ in range(2):
        layers = max(5, round(layers * elements / _count(_Shell(flow, n, layers))))
    shell = _Shell(flow, n, layers)
    corners, kind, points = shell.elements()
    part, order = _partition(seed, points, corners, kind, parts)
    kind, part = kind[order], part[order]
    first = np.concatenate([[0], np.cumsum(kind)])
    packed = corners[order][np.arange(8) < kind[:, None]]
    # Positions are rounded first: the scalar is that of the point where it lies.
    rounded = points.astype(np.float32)
    scalars = flow.vorticity(rounded.astype(np.float64)).astype(np.float32)
    return Elements(rounded, scalars, first, packed.astype(np.int32), kind, part, _transfer())


def _transfer() -> TransferFunction:
    values = np.array([0.0, 0.14, 0.22, 0.40, 0.60, 0.80, 1.0])
    colors = np.array(
        [
            [0.02, 0.05, 0.20],
            [0.05, 0.15, 0.45],
            [0.10, 0.40, 0.75],
            [0.55, 0.80, 0.90],
            [0.98, 0.85, 0.55],
            [0.95, 0.45, 0.10],
            [0.75, 0.08, 0.05],
        ]
    )
    opacities = np.array([0.0, 0.0, 0.02, 0.06, 0.22, 0.50, 0.80])
    return TransferFunction(values, colors, opacities, unit=0.25 * RADIUS)


# -- the flow ---------------------------------------------------------------------------------------------------------


class _Flow:
    """The vehicle and the air around it."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        rng = generator(seed, "lander flow")
        size = np.repeat(RADIUS * 1.6 * 0.5 ** np.arange(5), 7)
        self._waves = unit(rng.normal(size=(len(size), 3))) * (2.0 * np.pi / size)[:, None]
        self._phases = rng.uniform(0.0, 2.0 * np.pi, len(size))
        self._weights = (size / size[0]) ** 0.6
        angle = (np.arange(NOZZLES) + 0.5) * 2.0 * np.pi / NOZZLES
        self._across = np.stack([np.zeros(NOZZLES), np.cos(angle), np.sin(angle)], axis=1)
        self._strength = rng.uniform(0.85, 1.0, NOZZLES)

    def noise(self, p: F64) -> F64:
        """Return turbulence at points (n, 3): plane waves over five octaves, most of it within -1 to 1."""
        total = np.zeros(len(p))
        for wave, phase, weight in zip(self._waves, self._phases, self._weights, strict=True):
            total += weight * np.sin(p @ wave + phase)
        return np.asarray(total / np.sqrt((self._weights**2).sum()), np.float64)

    def vorticity(self, p: F64) -> F64:
        """Return the scalar at points (n, 3), 0 to 1."""
        x, rho = p[:, 0] / RADIUS, np.hypot(p[:, 1], p[:, 2]) / RADIUS
        turbulence = self.noise(p)
        slow = self.noise(0.35 * p)
        # A bow shock ahead of the plumes, thin and wavy; what it encloses is churned.
        front = -3.7 + 0.30 * rho**2 + 0.16 * slow
        shock = 0.62 * np.exp(-(((x - front) / 0.15) ** 2)) * smoothstep(4.0, 1.0, rho)
        inside = smoothstep(0.0, 0.5, x - front) * smoothstep(2.6, 1.2, rho - 0.12 * x)
        mixing = inside * smoothstep(1.6, 0.0, x) * (0.24 + 0.20 * turbulence)
        behind = smoothstep(0.4, 1.2, x) * smoothstep(6.5, 3.0, x)
        wake = behind * smoothstep(1.25, 0.5, rho - 0.05 * x) * (0.36 + 0.30 * turbulence)
        value = np.maximum(np.maximum(shock, mixing), wake)
        for across, strength in zip(self._across, self._strength, strict=True):
            start = 0.5 * across - np.array([0.18, 0.0, 0.0])
            axis = unit(0.16 * across - np.array([1.0, 0.0, 0.0]))
            away = p / RADIUS - start
            s = away @ axis
            off = np.sqrt(np.maximum((away * away).sum(axis=1) - s * s, 0.0))
            width = 0.09 + 0.11 * np.maximum(s, 0.0) * smoothstep(4.5, 0.5, s)
            alive = smoothstep(-0.12, 0.0, s) * smoothstep(1.0, 0.55, s / (3.0 + 0.3 * slow))
            diamonds = 0.80 + 0.20 * np.cos(2.0 * np.pi * s / 0.55) * smoothstep(2.4, 0.6, s)
            core = np.exp(-((off / width) ** 2)) * diamonds
            sheath = np.exp(-(((off - 1.25 * width) / (0.4 * width)) ** 2)) * (0.55 + 0.3 * turbulence)
            value = np.maximum(value, strength * alive * np.maximum(core, sheath))
        return np.clip(value, 0.0, 1.0)

    def wall(self, direction: F64) -> F64:
        """Return how far the vehicle's wall is from the origin in directions (n, 3)."""
        rho = np.hypot(direction[:, 1], direction[:, 2])
        inverse = np.zeros(len(direction))
        # Heat shield, back shell and back plate: lines in the plane of x and rho, and their distances from the origin.
        for nx, nr, x, r in ((-1.0, 0.364, -0.33, 0.0), (0.65, 0.72, 0.03, 1.0), (1.0, 0.0, 0.75, 0.0)):
            # A high power rounds the shoulders.
            inverse += np.maximum((nx * direction[:, 0] + nr * rho) / (nx * x + nr * r), 0.0) ** 6
        return RADIUS * inverse ** (-1.0 / 6.0)

    def edge(self, direction: F64) -> F64:
        """Return how far the mesh goes in directions (n, 3)."""
        return RADIUS * (7.0 + 1.5 * direction[:, 0])


# -- the mesh ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Shell:
    """Hexahedral cells between wall and edge: layers over the quadrilaterals of a cube's surface with n a side.

    What a cell is made of depends on where it lies: two wedges on the wall, one block in calm air, else pieces around a
    centre.
    """

    flow: _Flow
    n: int
    layers: int

    def surface(self) -> tuple[F64, I64]:
        """Return directions (s, 3) of the surface's points, and the quadrilaterals (q, 4), counter-clockwise."""
        n = self.n
        u, v = (a.ravel() for a in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
        square = np.stack([np.stack([u + a, v + b], axis=-1) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1)
        faces = []
        for axis in range(3):
            for end in (0, n):
                corner = np.full((*square.shape[:2], 3), end)
                corner[..., (axis + 1) % 3], corner[..., (axis + 2) % 3] = square[..., 0], square[..., 1]
                faces.append(corner if end else corner[:, ::-1])
        lattice = np.concatenate(faces).reshape(-1, 3)
        code = (lattice[:, 0] * (n + 1) + lattice[:, 1]) * (n + 1) + lattice[:, 2]
        _, at, quads = np.unique(code, return_index=True, return_inverse=True)
        return np.tan((lattice[at] / n - 0.5) * (0.5 * np.pi)), quads.reshape(-1, 4).astype(np.int64)

    def levels(self) -> F64:
        """Return where the levels between layers lie, 0 at the wall to 1 at the edge."""
        k = np.linspace(0.0, 1.0, self.layers + 1)
        return np.asarray(np.expm1(3.0 * k) / np.expm1(3.0), np.float64)

    def points(self, direction: F64, jitter: F64, lift: F64) -> F64:
        """Return positions of the points of all levels, (levels * s, 3), level by level.

        Parameters
        ----------
        direction : float64 array (s, 3)
        jitter, lift : float64 arrays (levels, s, 3) and (levels, s)
            How far each point is moved aside and outwards, -1 to 1.

        """
        level = self.levels()
        gap = np.diff(level)
        room = np.minimum(np.append(gap, 0.0), np.append(0.0, gap))  # none at the wall and at the edge
        # Over the shoulder's bend thin layers have no room to move.
        free = smoothstep(0.0, 0.2, level)
        at = level[:, None] + (0.15 * free * room)[:, None] * lift
        toward = unit(direction) + (0.18 / self.n * free * (room > 0.0))[:, None, None] * jitter
        toward = self._forward(unit(toward.reshape(-1, 3)))
        at, wall = at.ravel()[:, None], self.flow.wall(toward)[:, None]
        return np.asarray((wall + at * (self.flow.edge(toward)[:, None] - wall)) * toward, np.float64)

    @staticmethod
    def _forward(direction: F64) -> F64:
        """Draw directions towards the heat shield, where the plumes are."""
        theta = np.arccos(np.clip(-direction[:, 0], -1.0, 1.0))
        drawn = np.pi * (theta / np.pi) ** 1.35
        aside = unit(direction * np.array([0.0, 1.0, 1.0])) * np.sin(drawn)[:, None]
        return np.asarray(aside - np.cos(drawn)[:, None] * np.array([1.0, 0.0, 0.0]), np.float64)

    def cells(self) -> tuple[Shape, I64]:
        """Return what the cells (layers, q) are made of, and the quadrilaterals (q, 4) next to each, edge by edge."""
        direction, quads = self.surface()
        middle = unit(direction[quads].mean(axis=1))
        toward = self._forward(middle)
        level = self.levels()
        height = 0.5 * (level[1:] + level[:-1])
        wall, edge = self.flow.wall(toward), self.flow.edge(toward)
        at = wall + height[:, None] * (edge - wall)
        p = (at[:, :, None] * toward).reshape(-1, 3)
        busy = (self.flow.vorticity(p) > 0.16).reshape(at.shape)
        thick = np.maximum(1, np.rint((0.18 + 0.05 * self.flow.noise(0.5 * wall[:, None] * toward)) * self.layers))
        layer = np.arange(self.layers)[:, None]
        made = np.where(busy | (layer <= thick), _CORE, _BLOCK)
        made[layer < thick] = _WALL
        edges = np.sort(np.stack([quads, np.roll(quads, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        order = np.lexsort((edges[:, 1], edges[:, 0]))  # every edge has two quadrilaterals
        beside = np.empty(len(order), np.int64)
        beside[order[0::2]], beside[order[1::2]] = order[1::2] // 4, order[0::2] // 4
        return made.astype(np.int8), beside.reshape(-1, 4)

    def shared(self, made: Shape, beside: I64) -> NDArray[np.bool_]:
        """Return which faces (layers, q, 6) are one quadrilateral for both cells: four sides, bottom, top."""
        whole = np.empty((*made.shape, 6), bool)
        for side in range(4):
            whole[:, :, side] = (made != _CORE) | (made[:, beside[:, side]] != _CORE)
        block = made == _BLOCK
        whole[:, :, 4] = block | np.concatenate([block[:1] & False, block[:-1]])
        whole[:, :, 5] = block | np.concatenate([block[1:], block[:1] & False])
        return whole

    def elements(self) -> tuple[I64, NDArray[np.uint8], F64]:
        """Return corners (e, 8), kinds (e,) and points (p, 3)."""
        direction, quads = self.surface()
        made, beside = self.cells()
        whole = self.shared(made, beside).reshape(-1, 6)
        s, made = len(direction), made.ravel()
        rng = generator(self.flow.seed, "lander mesh")
        around = rng.uniform(-1.0, 1.0, (self.layers + 1, s, 4))
        points = self.points(direction, around[..., :3], around[..., 3])
        base = (np.arange(self.layers)[:, None, None] * s + quads).reshape(-1, 4)
        hexes = np.concatenate([base, base + s], axis=1)
        wall, core, block = (hexes[made == m] for m in (_WALL, _CORE, _BLOCK))
        centre = len(points) + np.arange(len(core))
        points = np.concatenate([points, points[core].mean(axis=1)])
        groups = [(8, block)]
        lowest = _lowest_first(wall[:, :4])
        for a, b in ((1, 2), (2, 3)):
            under = lowest[:, [0, a, b]]
            groups.append((6, np.concatenate([under, under + s], axis=1)))
        # VTK's faces of a hexahedron that lie on the edges 0, 1, 2, 3 of its bottom, then bottom and top.
        for side, face in enumerate((2, 1, 3, 0, 4, 5)):
            quad = core[:, FACES[8][face]]
            flat = whole[made == _CORE, side]
            groups.append((5, np.column_stack([quad[flat][:, ::-1], centre[flat]])))
            parted = _lowest_first(quad[~flat])
            groups += [(4, np.column_stack([parted[:, [0, b, a]], centre[~flat]])) for a, b in ((1, 2), (2, 3))]
        kind = np.repeat(np.array([k for k, _ in groups], np.uint8), [len(g) for _, g in groups])
        corners = np.zeros((len(kind), 8), np.int64)
        row = 0
        for k, group in groups:
            corners[row : row + len(group), :k] = group
            row += len(group)
        return corners, kind, points


def _count(shell: _Shell) -> int:
    """Return how many elements a mesh has, without making it."""
    made, beside = shell.cells()
    parted = ~shell.shared(made, beside)[made == _CORE]
    blocks, walls = np.count_nonzero(made == _BLOCK), np.count_nonzero(made == _WALL)
    return int(blocks + 2 * walls + parted.size + np.count_nonzero(parted))


def _lowest_first(quad: I64) -> I64:
    """Turn quadrilaterals (n, 4) such that the point of the lowest id comes first: the diagonal starts there."""
    turned = (quad.argmin(axis=1)[:, None] + np.arange(4)) % 4
    return np.asarray(np.take_along_axis(quad, turned, axis=1), np.int64)


# -- the parts --------------------------------------------------------------------------------------------------------


def _partition(
    seed: int, points: F64, corners: I64, kind: NDArray[np.uint8], parts: int
) -> tuple[NDArray[np.int32], I64]:
    """Return the part of each element, and the elements in the order of the curve."""
    middle = np.zeros((len(kind), 3))
    for j in range(8):
        there = j < kind
        middle[there] += points[corners[there, j]]
    middle /= kind[:, None]
    rng = generator(seed, "lander parts")
    warped = middle.copy()
    for size in (2.0, 1.0, 0.5):
        waves = rng.normal(size=(3, 3)) / (size * RADIUS)
        warped += 0.5 * size * RADIUS * np.sin(middle @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 3))
    low, high = warped.min(axis=0), warped.max(axis=0)
    cell = np.minimum((warped - low) / (high - low).max() * 2**_BITS, 2**_BITS - 1).astype(np.int64)
    order = np.argsort(_hilbert(cell), kind="stable")
    part = np.empty(len(kind), np.int32)
    part[order] = np.arange(len(kind), dtype=np.int64) * parts // len(kind)
    return part, order


_BITS = 16


def _hilbert(cell: I64) -> I64:
    """Return the place of cells (n, 3) along a Hilbert curve (Skilling, "Programming the Hilbert curve", 2004)."""
    x = [cell[:, axis].copy() for axis in range(3)]
    bit = 1 << (_BITS - 1)
    while bit > 1:
        low = bit - 1
        for axis in range(3):
            flip = (x[axis] & bit) > 0
            swapped = np.where(flip, 0, (x[0] ^ x[axis]) & low)
            x[0] = np.where(flip, x[0] ^ low, x[0] ^ swapped)
            x[axis] = x[axis] ^ swapped if axis else x[0]
        bit >>= 1
    x[1] ^= x[0]
    x[2] ^= x[1]
    turn = np.zeros_like(x[0])
    bit = 1 << (_BITS - 1)
    while bit > 1:
        turn = np.where((x[2] & bit) > 0, turn ^ (bit - 1), turn)
        bit >>= 1
    place = np.zeros_like(x[0])
    for shift in range(_BITS - 1, -1, -1):
        for axis in range(3):
            place = place << 1 | (x[axis] ^ turn) >> shift & 1
    return place
