from dataclasses import replace

import numpy as np
import pytest
from made_worlds import city, information, near_pairs, poses_at, true_edges

from gsmap.geometry.similarities import Similarities
from gsmap.optimize import Params, diff, optimize
from gsmap.types import Edge, Sim3

QUICK = Params(marginals=False)


@pytest.mark.parametrize(("share", "limit"), [(0.0, 1.02), (0.3, 1.1), (0.5, 1.5)])
def test_wrong_edges_do_not_bend_the_map(share, limit):
    world = city(200, share, seed=3)
    answer = optimize(world.ids, world.edges, params=QUICK)
    clean = [e for e, bad in zip(world.edges, world.wrong, strict=True) if not bad]
    oracle = optimize(world.ids, clean, params=QUICK)
    assert world.ate(answer) < limit * world.ate(oracle)
    assert not [key for key in world.wrong_keys if answer.outcomes[key].use == "used"]
    kept = [answer.use(e.target, e.source) == "used" for e in clean]
    assert np.mean(kept) > (0.95 if share < 0.5 else 0.85)


def test_same_input_gives_the_same_bytes():
    world = city(80, 0.3)
    a, b = (optimize(world.ids, world.edges) for _ in range(2))
    for scene in world.ids:
        assert a.poses[scene].S_map_scene.matrix().tobytes() == b.poses[scene].S_map_scene.matrix().tobytes()
        assert np.array_equal(a.poses[scene].covariance, b.poses[scene].covariance)
    assert a.outcomes == b.outcomes


def test_two_scenes_join_on_one_edge_and_a_chain_grows_from_nothing():
    truth = poses_at(np.arange(6)[:, None] * [4.0, 0, 0])
    ids = list("abcdef")
    edges = true_edges(truth, [[k, k + 1] for k in range(5)], np.random.default_rng(0), ids)
    two = optimize(ids[:2], edges[:1])
    assert {p.component for p in two.poses.values()} == {0}
    assert two.use("a", "b") == "tentative"
    chain = optimize(ids, edges)
    assert {p.component for p in chain.poses.values()} == {0}
    assert all(p.status == "tentative" for p in chain.poses.values())
    found = chain.poses["a"].S_map_scene.inverse() @ chain.poses["f"].S_map_scene
    assert np.linalg.norm(found.translation - truth[np.array([0])].item(0).inverse().apply(truth.translations[5])) < 1


def two_islands():
    rng = np.random.default_rng(1)
    positions = rng.uniform(0, 6, (10, 3)) + np.repeat([[0, 0, 0], [8, 0, 0]], 5, axis=0)
    ids = [f"s{k}" for k in range(10)]
    truth = poses_at(positions)
    inside = [[a, b] for a in range(10) for b in range(a + 1, 10) if a // 5 == b // 5]
    bridge = [[0, 5], [1, 6], [2, 7]]
    return ids, true_edges(truth, inside, rng, ids), true_edges(truth, bridge, rng, ids)


def test_two_islands_stay_two_until_a_bridge_of_three_edges_joins_them():
    ids, inside, bridge = two_islands()
    apart = optimize(ids, inside)
    assert [apart.poses[s].component for s in ids] == [0] * 5 + [1] * 5
    for weak in (bridge[:1], bridge[:2]):
        still = optimize(ids, inside + weak, previous=apart, params=Params(max_growth=0))
        assert [still.poses[s].component for s in ids] == [0] * 5 + [1] * 5
        assert set(still.undecided) == {(e.target, e.source) for e in weak}
        assert "needs 3 agreeing edges" in still.outcomes[(weak[0].target, weak[0].source)].reason
    joined = optimize(ids, inside + bridge, previous=apart)
    assert {p.component for p in joined.poses.values()} == {0}
    assert all(outcome.use != "unused" for outcome in joined.outcomes.values())
    moves = diff(apart, joined)
    assert moves["s0"].translation < 1e-9  # the surviving gauge
    assert moves["s7"].translation > 1
    assert moves["s7"].components == (1, 0)
    assert [apart.poses[s].component for s in ids] == [0] * 5 + [1] * 5


def test_a_persons_word_joins_two_islands():
    ids, inside, bridge = two_islands()
    word = Edge(bridge[0].target, bridge[0].source, bridge[0].S_target_source, information(), confirmed=True)
    joined = optimize(ids, [*inside, word])
    assert {p.component for p in joined.poses.values()} == {0}
    assert joined.use(word.target, word.source) == "used"


def test_the_larger_component_keeps_its_frame():
    world = city(60, 0.1, seed=2)
    first = optimize(world.ids, world.edges[:250], params=QUICK)
    turned = {s: Sim3(np.diag([1.0, -1, -1]), np.array([100.0, 0, 0])) @ p.S_map_scene for s, p in first.poses.items()}
    before = replace(first, poses={s: replace(first.poses[s], S_map_scene=turned[s]) for s in turned})
    again = optimize(world.ids, world.edges, previous=before, params=QUICK)
    moves = [c.translation for s, c in diff(before, again).items() if before.poses[s].status == "placed"]
    assert np.median(moves) < 0.2


def test_marginals_are_honest():
    """Errors relative to the anchor, in units of the marginal covariance, average to their degrees of freedom."""
    rng = np.random.default_rng(5)
    positions = rng.uniform(0, 15, (30, 3)) * [1, 1, 0.2]
    truth = poses_at(positions)
    ids = [str(k) for k in range(30)]
    pairs = near_pairs(positions, 100, rng)
    scores = []
    for seed in range(8):
        answer = optimize(ids, true_edges(truth, pairs, np.random.default_rng(seed), ids))
        for k in range(1, 30):
            pose = answer.poses[ids[k]]
            if pose.component or pose.status != "placed":
                continue
            want = truth[np.array([0])].inverse() @ truth[np.array([k])]
            error = (want.inverse() @ Similarities.stack([pose.S_map_scene])).log()[0, :6]
            scores.append(error @ np.linalg.solve(pose.covariance[:6, :6], error) / 6)
    assert 0.6 < np.mean(scores) < 1.6
