"""Hierarchies in blocks: that they are hierarchies, how they lie in memory, and what rays refer to on their way."""

import numpy as np
import pytest

from simrender.errors import SceneError
from simrender.rays import blocks as module
from simrender.rays.blocks import (
    NODE_BLOCK,
    PACKET_RAYS,
    TRIANGLE_BLOCK,
    block_hierarchy,
    packet_of_pixel,
    packet_rays,
    references,
    walk,
)
from simrender.rays.embree import Geometry
from simrender.rays.kinds import CAMERA, SHADOW
from tests.scenes import garden, garden_workload


def soup(count=20_000, seed=5, size=0.02):
    rng = np.random.Generator(np.random.Philox(key=seed))
    centre = rng.uniform(-1.0, 1.0, (count, 1, 3))
    corners = (centre + rng.normal(0.0, size, (count, 3, 3))).astype(np.float32)
    return corners.reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def random_rays(count, seed=7):
    rng = np.random.Generator(np.random.Philox(key=seed))
    origin = rng.uniform(-2.0, 2.0, (count, 3)).astype(np.float32)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return origin, direction.astype(np.float32), np.full(count, np.inf, np.float32)


def packets(count, size=PACKET_RAYS):
    return np.append(np.arange(0, count, size), count)


def go(made, rays, size=PACKET_RAYS, shadow=False):
    return walk(made, packets(len(rays[0]), size), *rays, np.full(len(rays[0]), shadow))


@pytest.fixture(scope="module")
def mesh():
    return soup()


@pytest.fixture(scope="module")
def made(mesh):
    return block_hierarchy(*mesh)


# The hierarchy


def test_boxes_contain_what_is_below_them(made):
    inner = np.flatnonzero(made.count < 0)
    for child in (made.link[inner], made.link[inner] + 1):
        assert (made.bounds[inner, :3] <= made.bounds[child, :3]).all()
        assert (made.bounds[inner, 3:] >= made.bounds[child, 3:]).all()
    leaves = np.flatnonzero(made.count > 0)
    owner = np.repeat(leaves, made.count[leaves])
    rows = np.concatenate([np.arange(a, a + n) for a, n in zip(made.link[leaves], made.count[leaves], strict=True)])
    corners = made.triangles[rows].reshape(-1, 3, 3)
    assert (made.bounds[owner, :3] < corners.min(axis=1)).all()
    assert (made.bounds[owner, 3:] > corners.max(axis=1)).all()


def test_every_triangle_and_every_node_is_there_once(made, mesh):
    leaves = np.flatnonzero(made.count > 0)
    covered = np.zeros(len(made.triangles), int)
    for first, count in zip(made.link[leaves], made.count[leaves], strict=True):
        covered[first : first + count] += 1
    assert (covered == 1).all()
    assert np.array_equal(np.sort(made.ids), np.arange(len(mesh[1])))
    assert np.array_equal(made.triangles.reshape(-1, 3, 3), mesh[0][mesh[1][made.ids]])
    children = made.link[made.count < 0]
    assert len(np.unique(children)) == len(children)
    assert len(made.link) == 2 + 2 * len(children)  # the root has the place of a pair


def test_triangles_lie_in_the_order_of_a_traversal(made):
    stack, met = [0], []
    while stack:
        node = stack.pop()
        if made.count[node] < 0:
            stack += [made.link[node] + 1, made.link[node]]
        else:
            met.append(made.link[node])
    assert met == sorted(met)


# Blocks


def test_the_upper_blocks_are_never_small(mesh):
    made = block_hierarchy(*mesh, 16, 10)
    sizes = np.bincount(made.block)
    assert len(made.upper) == made.node_blocks == len(sizes)
    assert made.upper[0]
    assert (sizes[made.upper] == NODE_BLOCK).all()
    assert sizes[~made.upper].max() == 16
    parents = np.flatnonzero(made.count < 0)
    below = made.upper[made.block[made.link[parents]]]
    assert made.upper[made.block[parents]][below].all()  # what is above an upper one is one


def test_blocks_are_full_and_pairs_whole(made):
    assert made.block[0] == 0
    assert set(np.diff(made.block).tolist()) <= {0, 1}
    sizes = np.bincount(made.block)
    assert (sizes[:-1] == NODE_BLOCK).all()
    assert 0 < sizes[-1] <= NODE_BLOCK
    assert made.triangle_blocks == -(-20_000 // TRIANGLE_BLOCK)
    children = made.link[made.count < 0]
    assert (children % 2 == 0).all()
    assert (made.block[children] == made.block[children + 1]).all()


def test_the_first_block_is_the_top_of_the_tree_breadth_first(made):
    depth = np.zeros(len(made.link), int)
    for node in range(NODE_BLOCK):
        if node != 1 and made.count[node] < 0:
            depth[[made.link[node], made.link[node] + 1]] = depth[node] + 1
    inside = depth[2:NODE_BLOCK]
    assert (np.diff(inside) >= 0).all()
    assert inside.max() >= 7  # log2 of 254


def test_a_way_from_the_root_stays_in_a_block_for_several_steps(made):
    parent = np.full(len(made.link), -1)
    inner = np.flatnonzero(made.count < 0)
    parent[made.link[inner]] = parent[made.link[inner] + 1] = inner
    node, steps, changes = np.flatnonzero(made.count > 0), 0, 0
    leaves = len(node)
    while len(node):
        node = node[parent[node] >= 0]
        steps += len(node)
        changes += int((made.block[node] != made.block[parent[node]]).sum())
        node = parent[node]
    assert steps / leaves > np.log2(leaves)
    assert changes / leaves < steps / leaves / 6  # at best 8 steps a block


def test_smaller_blocks_begin_below_the_second_level(mesh):
    made = block_hierarchy(*mesh, node_block=8, triangle_block=5)
    sizes = np.bincount(made.block)
    assert sizes[0] == NODE_BLOCK
    assert (sizes[sizes > 8] <= NODE_BLOCK).all()
    assert (sizes > 8).sum() <= 1 + NODE_BLOCK
    assert np.median(sizes) == 8
    assert made.triangle_blocks == 4000


def test_a_single_triangle_and_coinciding_ones():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    one = block_hierarchy(corners, np.array([[0, 1, 2]], np.int32))
    assert (one.node_blocks, one.triangle_blocks) == (1, 1)
    rays = (np.array([[0.2, 0.2, 1.0]], np.float32), np.array([[0, 0, -1.0]], np.float32), np.array([9], np.float32))
    assert go(one, rays).t[0] == pytest.approx(1.0)
    many = block_hierarchy(corners, np.zeros((1000, 3), np.int32) + np.arange(3, dtype=np.int32))
    assert many.count.max() <= 8
    found = go(many, rays)
    assert found.t[0] == pytest.approx(1.0)
    assert found.primitive[0] == 0  # the lowest of equally near ones


@pytest.mark.parametrize(("nodes", "triangles"), [(0, 1), (3, 1), (2, 0)])
def test_impossible_blocks_are_refused(mesh, nodes, triangles):
    with pytest.raises(SceneError, match=f"an even number of nodes .* got {nodes} and {triangles}"):
        block_hierarchy(*mesh, node_block=nodes, triangle_block=triangles)
    with pytest.raises(SceneError, match="no triangles"):
        block_hierarchy(mesh[0], mesh[1][:0])


# Rays


def test_hits_are_those_of_embree(made, mesh):
    rays = random_rays(100_000)
    found, truth = go(made, rays), Geometry(*mesh).nearest(*rays)
    hit = np.isfinite(truth.t)
    assert hit.mean() > 0.1
    assert (np.isfinite(found.t) != hit).sum() <= 2
    both = hit & np.isfinite(found.t)
    assert np.abs(found.t[both] / truth.t[both] - 1.0).max() < 1e-4
    assert (found.primitive[both] != truth.primitive[both]).sum() <= 5


def test_rays_along_axes_and_in_faces_of_boxes():
    x, y = np.meshgrid(np.arange(33), np.arange(33), indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3).astype(np.float32)
    i = np.arange(33 * 33).reshape(33, 33)
    quads = [i[:-1, :-1], i[1:, :-1], i[:-1, 1:], i[1:, 1:]]
    a, b, c, d = (q.ravel() for q in quads)
    made = block_hierarchy(
        vertices, np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)]).astype(np.int32)
    )
    inner = vertices[:500] + np.array([0.5, 0.5, 0.0], np.float32)
    origin = np.concatenate([vertices, inner[inner[:, 1] < 32]]) + np.array([0, 0, 2], np.float32)
    down = np.tile(np.array([[0, 0, -1]], np.float32), (len(origin), 1))
    assert (go(made, (origin, down, np.full(len(origin), np.inf, np.float32))).t == 2.0).all()
    negative_zero = down * np.array([-0.0, 0.0, 1.0], np.float32)
    assert (go(made, (origin, negative_zero, np.full(len(origin), np.inf, np.float32))).t == 2.0).all()
    assert not np.isfinite(go(made, (origin, down, np.full(len(origin), 1.9, np.float32))).t).any()


def test_shadow_rays_stop_at_any_hit(made):
    rays = random_rays(20_000)
    nearest, any_hit = go(made, rays), go(made, rays, shadow=True)
    assert np.array_equal(np.isfinite(nearest.t), np.isfinite(any_hit.t))
    assert (any_hit.t >= nearest.t).all()
    assert len(any_hit.block) < len(nearest.block)


def test_the_root_block_comes_first_and_no_block_twice_in_a_row(made):
    found = go(made, random_rays(20_000))
    assert (found.block[found.first[:-1]] == 0).all()
    for sort in (found.block < made.node_blocks, found.block >= made.node_blocks):
        owner = np.repeat(np.arange(len(found.first) - 1), np.diff(found.first))[sort]
        repeats = (np.diff(found.block[sort]) == 0) & (np.diff(owner) == 0)
        assert not repeats.any()


def test_a_packet_refers_to_all_blocks_that_its_rays_need(made):
    rays = random_rays(4096)
    together, alone = go(made, rays), go(made, rays, size=1)
    place = np.argsort(made.ids) // made.triangle_block + made.node_blocks
    for p in range(len(together.first) - 1):
        of_packet = set(together.block[together.first[p] : together.first[p + 1]].tolist())
        hits = alone.primitive[p * 64 : (p + 1) * 64]
        assert set(place[hits[hits >= 0]].tolist()) <= of_packet
        # A ray that hits nothing needs the same blocks, whatever the order in which the packet takes them.
        for ray in np.flatnonzero(hits < 0) + p * 64:
            assert set(alone.block[alone.first[ray] : alone.first[ray + 1]].tolist()) <= of_packet
    assert np.array_equal(together.t, alone.t)
    assert len(together.block) < len(alone.block)


def test_coherent_packets_share_their_references(made):
    n = 64
    towards = np.stack(np.meshgrid(np.linspace(-0.3, 0.3, 8 * n), np.linspace(-0.3, 0.3, 8), [-1.0]), -1).reshape(-1, 3)
    direction = (towards / np.linalg.norm(towards, axis=1, keepdims=True)).astype(np.float32)
    rays = np.tile(np.array([[0, 0, 3]], np.float32), (len(direction), 1)), direction
    rays = (*rays, np.full(len(direction), np.inf, np.float32))
    assert len(go(made, rays).block) < 0.4 * len(go(made, rays, size=1).block)


# A frame


def test_packets_of_an_image():
    (columns, rows), packet = packet_of_pixel((20, 9))
    assert (columns, rows) == (3, 2)
    assert np.array_equal(np.bincount(packet), [64, 64, 32, 8, 8, 4])
    assert packet.reshape(9, 20)[8, 19] == 5


def test_references_of_a_trace(tmp_path, monkeypatch):
    workload = garden_workload(cache=tmp_path)
    trace = workload.trace(1)
    written = garden().triangles
    made = block_hierarchy(written.vertices, written.faces)
    found = references(trace, lambda: made)
    assert found.packets == (12, 8)
    assert (found.nodes, found.triangles) == (len(made.link), len(written.faces))
    assert len(found.node_first) == len(found.triangle_first) == 97
    assert found.node.max() < found.node_blocks == made.node_blocks
    assert found.triangle.max() < found.triangle_blocks == made.triangle_blocks
    assert (found.node[found.node_first[:-1]] == 0).all()

    def never():
        raise AssertionError

    again = references(garden_workload(cache=tmp_path).trace(1), never)
    for name in ("node", "triangle", "node_first", "triangle_first"):
        assert np.array_equal(getattr(again, name), getattr(found, name))
    monkeypatch.setattr(module, "_CHUNK", 7)
    other = references(garden_workload(cache=tmp_path / "new").trace(1), lambda: made)
    assert np.array_equal(other.node, found.node)
    assert np.array_equal(other.triangle, found.triangle)


def test_damaged_references_are_made_again(tmp_path):
    workload = garden_workload(cache=tmp_path)
    written = garden().triangles
    made = block_hierarchy(written.vertices, written.faces)
    trace = workload.trace(1)
    found = references(trace, lambda: made)
    name = next(path.stem for path in trace.store.folder.glob("blocks-*.npz"))
    columns = ("sizes", "node_first", "node", "triangle_first", "triangle", "upper")
    stored = trace.store.load(name, columns)
    trace.store.save(name, stored | {"node": stored["node"][:-3]})
    assert np.array_equal(references(trace, lambda: made).node, found.node)


def test_every_ray_of_a_frame_is_in_one_packet(tmp_path):
    trace = garden_workload(cache=tmp_path).trace(1)
    trace.complete()
    first, rays, camera = packet_rays(trace)
    assert np.array_equal(np.sort(rays), np.arange(trace.rays))
    assert camera.sum() == (trace.column("kind") == CAMERA).sum()
    assert (trace.column("kind") == SHADOW).any()
    _, packet = packet_of_pixel(trace.size)
    owner = np.repeat(np.arange(len(first) - 1), np.diff(first))
    assert np.array_equal(packet[trace.column("pixel")[rays]], owner)


def test_runs_are_cut_into_packets():
    key = np.repeat([3, 4, 9], [64, 65, 130])
    assert module._cut(key).tolist() == [0, 64, 128, 129, 193, 257, 259]
