from dataclasses import replace

import numpy as np
from made_worlds import PLACING, ROT_RAD, city, poses_at, true_edges

from gsmap.geometry.rotations import angle_between
from gsmap.optimize import Params, optimize, surroundings


def known(world, count):
    ids = world.ids[:count]
    return ids, [e for e in world.edges if e.target in set(ids) and e.source in set(ids)]


def test_placing_scenes_one_by_one_agrees_with_solving_at_once():
    world = city(120, 0.2, seed=4)
    answer = optimize(*known(world, 110), params=PLACING)
    methods = []
    for count in range(111, 121):
        answer = optimize(*known(world, count), previous=answer, params=PLACING)
        methods.append(answer.provenance.method)
    assert methods.count("incremental") >= 8
    full = optimize(*known(world, 120), params=Params(max_growth=0))
    assert full.provenance.method == "batch"
    away = []
    for scene in world.ids:
        one, other = answer.poses[scene], full.poses[scene]
        if one.status == other.status == "placed":
            away.append(np.linalg.norm(one.S_map_scene.translation - other.S_map_scene.translation))
            assert angle_between(one.S_map_scene.rotation, other.S_map_scene.rotation) < 4 * ROT_RAD
    assert len(away) > 100
    assert np.median(away) < 0.03
    assert max(away) < 0.3
    assert not [key for key in world.wrong_keys if answer.outcomes[key].use == "used"]
    differing = [key for key in full.outcomes if full.use(*key) != answer.use(*key)]
    assert len(differing) < 0.02 * len(full.outcomes)


def test_a_placed_scene_has_an_honest_covariance():
    world = city(100, 0.0, seed=1)
    before = optimize(*known(world, 99), params=PLACING)
    after = optimize(*known(world, 100), previous=before, params=PLACING)
    assert after.provenance.method == "incremental"
    full = optimize(*known(world, 100), params=Params(max_growth=0))
    scene = world.ids[99]
    ratio = np.sqrt(np.diag(after.poses[scene].covariance)[:6] / np.diag(full.poses[scene].covariance)[:6])
    assert (ratio > 0.7).all()
    assert (ratio < 3).all()


def test_a_scene_without_a_tie_waits_alone():
    world = city(60, 0.0, seed=1)
    before = optimize(world.ids, world.edges, params=PLACING)
    after = optimize([*world.ids, "new"], world.edges, previous=before, params=PLACING)
    assert after.provenance.method == "incremental"
    assert after.poses["new"].status == "isolated"
    assert after.poses["new"].component not in {p.component for p in before.poses.values()}
    assert {s: p for s, p in after.poses.items() if s != "new"} == dict(before.poses)


def test_what_changed_underneath_is_solved_in_full():
    world = city(60, 0.0, seed=1)
    ids, edges = known(world, 59)
    before = optimize(ids, edges, params=PLACING)

    def method(edges):
        return optimize(world.ids, edges, previous=before, params=PLACING).provenance.method

    assert method(world.edges) == "incremental"
    assert method(world.edges[::-1]) == "incremental"
    assert method([replace(world.edges[0], confirmed=True), *world.edges[1:]]) == "batch"
    assert method([replace(world.edges[0], information=2 * world.edges[0].information), *world.edges[1:]]) == "batch"
    dropped = next(k for k, e in enumerate(world.edges) if world.ids[59] not in (e.target, e.source))
    assert method(world.edges[:dropped] + world.edges[dropped + 1 :]) == "batch"


def test_growth_by_a_tenth_and_joined_islands_are_solved_in_full():
    world = city(60, 0.0, seed=1)
    before = optimize(*known(world, 50), params=PLACING)
    assert optimize(*known(world, 54), previous=before, params=PLACING).provenance.method == "incremental"
    assert optimize(*known(world, 56), previous=before, params=PLACING).provenance.method == "batch"

    rng = np.random.default_rng(0)
    inside = [[a, b] for a in range(10) for b in range(a + 1, 10) if a // 5 == b // 5]
    growing = replace(PLACING, max_growth=1)
    apart = optimize(world.ids[:10], true_edges(world.truth, inside, rng, world.ids), params=growing)
    assert len({p.component for p in apart.poses.values()}) == 2
    ties = true_edges(world.truth, [[0, 10], [1, 10], [2, 10], [5, 10], [6, 10], [7, 10]], rng, world.ids)
    edges = true_edges(world.truth, inside, np.random.default_rng(0), world.ids) + ties
    joined = optimize(world.ids[:11], edges, previous=apart, params=growing)
    assert joined.provenance.method == "batch"
    assert len({p.component for p in joined.poses.values()}) == 1


def test_surroundings_are_five_edges_wide():
    """Neighbours, two rings that are solved, and two rings more; the scenes of the last are the rim."""
    ids = [f"s{k:02d}" for k in range(12)]
    chain = np.array([[k, k + 1] for k in range(11)])
    truth = poses_at(3.0 * np.c_[np.arange(12), np.zeros((12, 2))])
    edges = true_edges(truth, chain, np.random.default_rng(0), ids)
    before = optimize(ids, edges, params=PLACING)
    pairs = [(e.target, e.source) for e in edges] + [("new", "s11")]
    near, rim = surroundings([*ids, "new"], pairs, before, PLACING)
    assert near == {"new", "s11", "s10", "s09", "s08", "s07"}
    assert rim == {"s07"}
    assert surroundings([*ids[:-1], "new"], pairs, before, PLACING) == (set(), set()), "a scene has gone"
    assert surroundings([*ids, "new"], pairs, before, Params()) == (set(), set()), "few scenes are solved at once"
