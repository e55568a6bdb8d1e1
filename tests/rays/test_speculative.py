"""The ray tree: true rays are the trace's, wrong ones what another scene would spawn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from simrender.errors import InvariantError
from simrender.rays.crossings import Crossings
from simrender.rays.integrators import AmbientOcclusion, PathTracing, SprayPathTracing
from simrender.rays.scene import IDENTITY, Environment, Scene
from simrender.rays.speculative import RayTree, Table, ray_tree
from simrender.rays.trace import Trace
from tests.policies.driver import wavelets
from tests.policies.layers import CAMERA, LIGHT, MATERIAL, by_object, layers

SMALL = ("traced={resolution: 96x96}", "published={resolution: 96x96, samples: 1}")
INTEGRATORS = [SprayPathTracing(2, 3), AmbientOcclusion(3, bounces=2), PathTracing()]


def true_rows(tree):
    """The row of each true ray's nearest hit, of those that hit something."""
    hit = tree.hits(np.arange(tree.rows.count))
    t = tree.trace.column("t")[tree.rows["ray"]]
    return np.flatnonzero((hit == t) & np.isfinite(t))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_true_hits_spawn_the_rays_of_the_trace(integrator):
    tree = RayTree(layers(integrator, [0.0, -1.0, -2.0], by_object))
    trace = tree.trace
    assert tree.rays.count == trace.rays
    rows = true_rows(tree)
    assert len(rows) == np.isfinite(trace.column("t")).sum()
    radiance = rows[~tree.rays["shadow"][tree.rows["ray"][rows]]]
    spawned, count = tree.children(radiance)
    assert sorted(spawned) == list(range(trace.first[1], trace.rays))
    assert count.tolist() == trace.column("children")[tree.rows["ray"][radiance]].tolist()
    assert (tree.rays["spawner"][spawned] == np.repeat(radiance, count)).all()
    assert tree.rays.count == trace.rays
    assert tree.shaded_rows == 0


def test_depth_and_sample_follow_the_path():
    tree = ray_tree(wavelets("integrator={name: spray_path_tracing, bounces: 3, shadow_samples: 1}", *SMALL))
    trace, rays = tree.trace, tree.rays
    for generation in range(trace.generations):
        of_it = slice(trace.first[generation], trace.first[generation + 1])
        geometry = trace.geometry(generation)
        assert (rays["depth"][of_it] == generation).all()
        assert (rays["sample"][of_it] == geometry["pixel"] + trace.pixels * geometry["sample"].astype(int)).all()
        if generation:
            spawner = tree.rows["ray"][rays["spawner"][of_it]]
            assert (spawner == geometry["parent"] + trace.first[generation - 1]).all()


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("square", [1, 2])
def test_a_wrong_hit_spawns_what_a_scene_of_that_domain_alone_would(integrator, square):
    tree = RayTree(layers(integrator, [0.0, -1.0, -2.0], by_object))
    trace, rows = tree.trace, tree.rows
    camera = np.flatnonzero((rows["ray"] < trace.first[1]) & (rows["domain"] == square))
    met = camera[tree.hits(camera) < np.inf]
    spawned, count = tree.children(met)
    assert (spawned >= trace.rays).sum() > 0

    thing = trace.scene.objects[square]
    alone = Trace(
        Scene((thing,), np.zeros(1, int), IDENTITY[None], (MATERIAL,), (LIGHT,), Environment()),
        CAMERA, trace.size, 1, integrator,
    )  # fmt: skip
    alone.complete()
    ids = rows["ray"][met]
    assert count.tolist() == alone.column("children")[ids].tolist()
    expected = alone.geometry(1)
    order = np.concatenate([np.flatnonzero(expected["parent"] == ray) for ray in ids])
    wrong = spawned >= trace.rays
    for name in ("origin", "direction", "reach", "throughput", "pixel", "sample", "kind", "diffuse", "mirror"):
        made = tree._geometry(spawned)[name]
        assert made[wrong].tobytes() == expected[name][order][wrong].tobytes()
    assert (tree.rays["depth"][spawned] == 1).all()
    assert (tree.rays["sample"][spawned] == tree.rays["sample"][np.repeat(ids, count)]).all()


def test_a_wrong_ray_crosses_the_domains_as_a_true_one_does():
    tree = RayTree(layers(SprayPathTracing(2, 4), [0.0, -1.0, -2.0], by_object))
    world, domains = tree.world, tree.domains
    rays = np.arange(tree.trace.first[1])
    for _ in range(3):  # deeper and deeper
        rows = tree.rows_of(rays[~tree.rays["shadow"][rays]])
        rays, _ = tree.children(rows[tree.hits(rows) < np.inf])
    wrong = rays[rays >= tree.trace.rays]
    assert len(wrong) >= 20
    rows = tree.rows_of(wrong)
    owners = np.repeat(np.arange(len(wrong)), tree.rays["last"][wrong] - tree.rays["first"][wrong])
    assert (tree.rows["ray"][rows] == wrong[owners]).all()
    geometry = tree._geometry(wrong)
    expected = world.cross(geometry, owners, domains, tree.rows["domain"][rows], 1)["hit"]
    assert tree.hits(rows).tobytes() == expected.tobytes()
    assert (tree.rows["entry"][rows] <= expected + 1e-4).all()
    assert (np.diff(tree.rows["entry"][rows])[np.diff(owners) == 0] >= 0).all()


def test_counting_what_wrong_hits_spawn_makes_no_rays():
    tree = RayTree(layers(AmbientOcclusion(3, bounces=2), [0.0, -1.0], by_object))
    rows = np.flatnonzero((tree.rows["ray"] < tree.trace.first[1]) & (tree.hits(np.arange(tree.rows.count)) < np.inf))
    count, shadow = tree.spawned(rows)
    assert tree.rays.count == tree.trace.rays
    spawned, made = tree.children(rows)
    assert made.tolist() == count.tolist()
    assert tree.rays["shadow"][spawned].sum() == shadow.sum() > 0
    assert tree.rays.count > tree.trace.rays


@pytest.mark.parametrize("copies", [2, 3])
def test_of_equal_hits_the_traces_is_the_nearest(copies):
    tree = RayTree(layers(SprayPathTracing(1, 2), [0.0, -1.0], by_object, copies))
    hits, rows = tree.hits(np.arange(tree.rows.count)), tree.rows
    owner, primitive = tree.domains.domain_of_triangle, tree.trace.column("primitive")
    for ray in np.flatnonzero(primitive >= 0).tolist():
        mine = tree.rows_of(np.array([ray]))
        nearest = mine[hits[mine] == hits[mine].min()]
        assert rows["domain"][nearest].tolist() == [owner[primitive[ray]]]
        assert hits[nearest[0]] == tree.trace.column("t")[ray]
        # The copies of what it hit come right behind.
        assert (hits[mine] == np.nextafter(hits[nearest[0]], np.float32(np.inf))).sum() == copies - 1


def test_a_second_replay_traces_and_shades_nothing(tmp_path):
    crossings = wavelets("integrator={name: spray_path_tracing, bounces: 3, shadow_samples: 1}", *SMALL)
    trace = crossings.trace

    def replay():
        again = Trace(trace.scene, trace.camera, trace.size, 1, trace.integrator, cache=tmp_path, jitter=False)
        crossings_again = Crossings(again, crossings.domains)
        tree = ray_tree(crossings_again)
        rays, seen = np.arange(again.first[1]), []
        for _ in range(3):
            rows = tree.rows_of(rays[~tree.rays["shadow"][rays]])
            rows = rows[tree.hits(rows) < np.inf]
            rays, count = tree.children(rows)
            seen += [tree.rows["hit"][rows], count, tree.rays["sample"][rays], tree.hits(tree.rows_of(rays))]
        tree.save()
        crossings_again.save()
        return tree, crossings_again, seen

    tree, asked, seen = replay()
    assert tree.shaded_rows > 0
    assert asked.asked_rows > 0
    tree, asked, again = replay()
    assert (tree.shaded_rows, asked.asked_rows, tree.trace.traced_rays) == (0, 0, 0)
    assert all(a.tobytes() == b.tobytes() for a, b in zip(seen, again, strict=True))


def test_all_who_ask_share_a_tree():
    crossings = layers(SprayPathTracing(1, 2), [0.0, -1.0], by_object)
    assert ray_tree(crossings) is ray_tree(crossings)


def test_domains_without_triangles_are_refused():
    crossings = layers(SprayPathTracing(1, 2), [0.0, -1.0], by_object)
    bare = Crossings(crossings.trace, replace(crossings.domains, domain_of_triangle=None))
    with pytest.raises(InvariantError, match="these domains have no triangles"):
        RayTree(bare)


def test_a_hit_in_a_domain_that_its_ray_does_not_enter_is_an_error():
    crossings = layers(SprayPathTracing(1, 2), [0.0, -1.0], by_object)
    tree = RayTree(crossings)
    tree.rows["domain"][:] = 9
    with pytest.raises(InvariantError, match=r"ray \d+ hits something in domain 1, which it never enters"):
        tree._join()


def test_a_table_keeps_its_rows_as_it_grows():
    table = Table({"a": np.arange(2), "b": np.zeros((2, 3), np.float32)})
    for k in range(2, 40):
        table.append({"a": np.array([k]), "b": np.full((1, 3), k, np.float32)})
    assert table["a"].tolist() == list(range(40))
    assert table["b"][:, 1].tolist() == [0, 0, *range(2, 40)]
    assert table.count == 40
