"""Correspondences, their consistency graph and the closed-form pose, on nodes made for the purpose."""

import numpy as np
import pytest
from register_worlds import layer, node_world

from gsmap.geometry.rotations import angle_between, exp_so3
from gsmap.register import consistency
from gsmap.register.clique import maximum_clique
from gsmap.register.consistency import consistency_graph, unpack
from gsmap.register.correspondences import Correspondences, match_nodes
from gsmap.register.pose import fit_pose
from gsmap.types import NodeLayer, Sim3


def _pairs(target, source, heights=None):
    n = np.arange(len(target), dtype=np.int32)
    return Correspondences(target, source, n, n, np.ones(len(target), np.float32), *(heights or (None, None)))


def test_correspondences_stay_within_type_and_find_the_true_partners():
    world = node_world(seed=0, shared=120, extra=60)
    found = match_nodes(world.target, world.source)
    assert (world.target.types[found.target_ids] == world.source.types[found.source_ids]).all()
    right = world.partner[found.target_ids] == found.source_ids
    assert right.sum() > 0.9 * 120
    assert (np.diff(found.similarity) <= 0).all()


def test_correspondences_are_the_brute_force_top_k():
    rng = np.random.default_rng(1)
    a, b = layer(rng, 40, types=2), layer(rng, 50, types=2)
    found = match_nodes(a, b, min_similarity=-1, top_k=2)
    similarity = np.where(a.types[:, None] == b.types, a.embeddings @ b.embeddings.T, -np.inf)
    rows = similarity >= np.sort(similarity, 1)[:, [-2]]
    columns = similarity >= np.sort(similarity, 0)[[-2]]
    expected = np.argwhere(rows | columns)
    got = np.stack([found.target_ids, found.source_ids], 1)
    assert sorted(map(tuple, got)) == sorted(map(tuple, expected))


def test_correspondences_of_nothing_and_the_cap():
    rng = np.random.default_rng(2)
    empty = NodeLayer.empty("m", 8)
    assert len(match_nodes(layer(rng, 5, dim=8), empty)) == 0
    a, b = layer(rng, 50), layer(rng, 50)
    every = match_nodes(a, b, min_similarity=-1, top_k=5)
    assert len(every) > 100
    for cap in (20, len(every) - 5):
        most = match_nodes(a, b, min_similarity=-1, top_k=5, max_correspondences=cap)
        assert most.target_ids.tolist() == every.target_ids[:cap].tolist()
        assert most.source_ids.tolist() == every.source_ids[:cap].tolist()


@pytest.mark.parametrize("test", ["absolute", "ratio"])
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_consistency_graph_equals_its_definition(test, scale):
    rng = np.random.default_rng(3)
    n = 130
    q, p = rng.normal(size=(n, 3)) * 3, rng.normal(size=(n, 3)) * 3 / scale
    p[:70] = q[:70] / scale + rng.normal(size=(70, 3)) * 0.05
    matches = Correspondences(
        q,
        p,
        rng.integers(0, 90, n).astype(np.int32),
        rng.integers(0, 90, n).astype(np.int32),
        np.ones(n, np.float32),
        q[:, 2],
        p[:, 2],
    )
    params = consistency.Params(test=test)
    got = unpack(consistency_graph(matches, params, scale=scale))
    dq = np.linalg.norm(q[:, None] - q, axis=-1)
    dp = scale * np.linalg.norm(p[:, None] - p, axis=-1)
    allowed = 0.1 * np.maximum(dq, dp) if test == "ratio" else 6 * consistency.SIGMA_M + 0.01 * np.minimum(dq, dp)
    height = np.abs((q[:, 2][:, None] - q[:, 2]) - scale * (p[:, 2][:, None] - p[:, 2]))
    expected = (np.abs(dq - dp) < allowed) & (np.minimum(dq, dp) >= consistency.MIN_DISTANCE_M)
    expected &= height < 6 * consistency.SIGMA_M + params.height_slope * np.maximum(dq, dp)
    for ids in (matches.target_ids, matches.source_ids):
        expected &= ids[:, None] != ids
    np.fill_diagonal(expected, False)
    assert (got == expected).mean() > 0.9999  # float32 may differ exactly on a threshold
    assert np.array_equal(got, got.T)
    assert expected.sum() > 500


@pytest.mark.parametrize("name", ["avx2", "avx512"])
def test_every_instruction_set_gives_the_same_graph_and_votes(name):
    from gsmap import _native

    matches = node_world(seed=10, wrong=700).matches
    answers = {}
    try:
        for each in ("baseline", name):
            if _native.use_instruction_set(each) != each:
                pytest.skip(f"this machine has no {each}")
            ids = matches.target_ids, matches.source_ids
            votes = _native.ratio_histogram(matches.target, matches.source, *ids, None, None, 1.0, 0.1, 0.6, 120)
            answers[each] = consistency_graph(matches), votes
    finally:
        _native.use_instruction_set("best")
    for one, other in zip(*answers.values(), strict=True):
        assert one.sum() > 0
        assert np.array_equal(one, other)


def test_clique_and_pose_recover_a_planted_transform():
    world = node_world(seed=4, shared=60, extra=100, noise_m=0.02, wrong=400)
    rows = consistency_graph(world.matches)
    clique = maximum_clique(rows)
    inliers = world.matches[clique.members]
    assert (world.partner[inliers.target_ids] == inliers.source_ids).mean() > 0.95
    fit = fit_pose(inliers.target, inliers.source)
    assert fit.flaw == ""
    assert np.degrees(angle_between(fit.S_target_source.rotation, world.S_target_source.rotation)) < 0.5
    assert fit.rms_m < 0.06


def test_a_mirrored_set_passes_the_distances_but_not_the_pose():
    rng = np.random.default_rng(5)
    q = rng.normal(size=(15, 3)) * [2.0, 2.0, 0.5]
    p = q * [1.0, 1.0, -1.0] + rng.normal(size=q.shape) * 0.01
    assert unpack(consistency_graph(_pairs(q, p), min_distance_m=0)).sum() == 15 * 14
    assert "mirrored" in fit_pose(q, p).flaw


def test_height_test_rejects_a_set_that_stands_on_its_head():
    rng = np.random.default_rng(6)
    q = rng.normal(size=(15, 3)) * 2
    upside_down = Sim3(exp_so3([np.pi, 0, 0]), np.ones(3))
    p = upside_down.apply(q)
    free = unpack(consistency_graph(_pairs(q, p), min_distance_m=0))
    held = unpack(consistency_graph(_pairs(q, p, (q[:, 2], p[:, 2])), min_distance_m=0))
    assert free.sum() == 15 * 14
    assert held.sum() < 0.2 * 15 * 14


@pytest.mark.parametrize(
    ("points", "word"),
    [
        (np.linspace(0, 8, 12)[:, None] * [1.0, 0.2, 0.1], "line"),
        (np.ones((4, 3)), "line"),
        (np.zeros((2, 3)), "fewer than 3"),
    ],
)
def test_degenerate_sets_are_refused(points, word):
    rng = np.random.default_rng(7)
    assert word in fit_pose(points + rng.normal(size=points.shape) * 1e-4, points).flaw


def test_a_plane_is_enough():
    rng = np.random.default_rng(8)
    q = np.c_[rng.uniform(0, 4, (20, 2)), np.zeros(20)]
    move = Sim3(exp_so3([0.5, -1, 2]), [1, 2, 3])
    assert fit_pose(move.apply(q), q).flaw == ""


def test_rotation_sigma_is_honest():
    rng = np.random.default_rng(9)
    q, sigma = rng.normal(size=(12, 3)) * [3.0, 0.4, 0.4], 0.03
    angles, predicted = [], 0.0
    for _ in range(300):
        fit = fit_pose(q + rng.normal(size=q.shape) * sigma, q + rng.normal(size=q.shape) * sigma, sigma_m=sigma)
        angles.append(angle_between(fit.S_target_source.rotation, np.eye(3)))
        predicted = fit.rotation_sigma_rad
    assert 0.7 < np.sqrt(np.mean(np.square(angles))) / predicted < 1.5
