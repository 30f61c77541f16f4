"""The answer is a function of what was measured: not of the order of scenes, edges, priors, nor of how a map grew."""

from itertools import combinations

import numpy as np
import pytest
from made_worlds import city, information

from gsmap.geometry.rotations import angle_between
from gsmap.optimize import Params, optimize
from gsmap.types import Edge, Prior, Sim3

MM = 1e-3
QUICK = Params(marginals=False)


def worst_apart(one, other):
    """Largest difference of a relative pose within a component: map units, radians."""
    away, turned = [0.0], [0.0]
    for a, b in combinations(one.poses, 2):
        if one.poses[a].component != one.poses[b].component:
            continue
        S, T = (graph.poses[a].S_map_scene.inverse() @ graph.poses[b].S_map_scene for graph in (one, other))
        away.append(float(np.linalg.norm(S.translation - T.translation)))
        turned.append(float(angle_between(S.rotation, T.rotation)))
    return max(away), max(turned)


def islands(answer):
    found = {}
    for pose in answer.poses.values():
        found.setdefault(pose.component, set()).add(pose.scene)
    return sorted(map(sorted, found.values()))


def uses(answer):
    return {key: (outcome.use, outcome.undecided) for key, outcome in answer.outcomes.items()}


def shuffled(rng, *lists):
    return [[values[k] for k in rng.permutation(len(values))] for values in lists]


@pytest.mark.parametrize("wrong_share", [0.0, 0.6])
def test_any_order_gives_the_same_answer(wrong_share):
    """With six edges in ten wrong, much is decided by what is tried first."""
    world, rng = city(40, wrong_share, seed=0), np.random.default_rng(0)
    priors = [Prior(world.ids[k], world.truth.item(k), np.full(7, 0.05)) for k in (3, 17, 25, 31)]
    for given in ([], priors):
        first = optimize(world.ids, world.edges, given)
        for _ in range(3):
            ids, edges, some = shuffled(rng, world.ids, world.edges, given)
            other = optimize(ids, edges, some)
            assert list(other.poses) == ids
            assert uses(other) == uses(first)
            assert islands(other) == islands(first)
            assert {s: p.status for s, p in other.poses.items()} == {s: p.status for s, p in first.poses.items()}
            away, turned = worst_apart(first, other)
            assert away < 0.01 * MM
            assert turned < 1e-7


def test_the_frame_is_the_oldest_scene_s():
    world = city(40, 0.0, seed=3)
    for oldest in (0, 7, 39):
        ids = [world.ids[oldest], *(s for s in world.ids if s != world.ids[oldest])]
        pose = optimize(ids, world.edges).poses[ids[0]]
        np.testing.assert_allclose(pose.S_map_scene.matrix(), np.eye(4), atol=1e-9)
        assert pose.component == 0


def test_islands_of_one_size_are_numbered_by_their_oldest_scene():
    edges = [Edge(a, b, Sim3.identity(), information()) for a, b in (("a", "b"), ("c", "d"))]
    for ids in ("abcd", "dabc", "cbda"):
        answer = optimize(list(ids), edges)
        assert answer.poses[ids[0]].component == 0
        assert {p.component for p in answer.poses.values()} == {0, 1}


@pytest.mark.parametrize("seed", [3, 4])
def test_a_map_that_grew_is_the_map_solved_at_once(seed):
    """Each step starts from the answer before; with wrong edges some steps see islands that later ones join."""
    world = city(40, 0.2, seed=seed)
    at_once = optimize(world.ids, world.edges, params=QUICK)
    (order,) = shuffled(np.random.default_rng(seed), world.ids)
    answer = None
    for count in range(1, len(order) + 1):
        here = set(order[:count])
        edges = [e for e in world.edges if {e.target, e.source} <= here]
        answer = optimize(order[:count], edges, previous=answer, params=QUICK)
    assert uses(answer) == uses(at_once)
    assert islands(answer) == islands(at_once)
    assert worst_apart(at_once, answer)[0] < 0.01 * MM
