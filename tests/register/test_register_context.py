"""Contexts of objects: what stands around them, told in words of the two layers that are compared."""

from dataclasses import replace

import networkx as nx
import numpy as np
from register_worlds import layer

from gsmap.geometry.rotations import exp_so3
from gsmap.register import context
from gsmap.register.context import Params, add_context, context_histograms, neighbourhood, word_shares
from gsmap.register.correspondences import match_nodes
from gsmap.register.proposers.graph import propose_by_kind
from gsmap.types import NodeLayer, SceneGraph, Sim3


def cone(rng, kinds: np.ndarray, spread: float = 0.2, noise: float = 0.02, dim: int = 64) -> np.ndarray:
    """(M, dim) unit features as image encoders give them: every kind of thing within a narrow cone, all but alike."""
    axes = np.random.default_rng(99)
    common = axes.normal(size=dim)
    own = axes.normal(size=(kinds.max() + 1, dim))
    features = common + spread * own[kinds] + noise * rng.normal(size=(len(kinds), dim))
    return features / np.linalg.norm(features, axis=1, keepdims=True)


def flat(seed: int = 0, count: int = 160, kinds: int = 5, noise_m: float = 0.02) -> tuple[NodeLayer, NodeLayer, Sim3]:
    """Two captures of a flat: many objects of few kinds, which every room holds in other shares; rows are partners."""
    rng = np.random.default_rng(seed)
    positions = rng.uniform(0, 1, (count, 3)) * [24.0, 6, 2.5]
    room = (positions[:, 0] // 4).astype(int)
    shares = rng.dirichlet(np.full(kinds, 0.4), 6)
    of = np.array([rng.choice(kinds, p=shares[r]) for r in room])
    S = Sim3(exp_so3(np.array([0.0, 0, 1.1])), np.array([3.0, -4, 1]))
    made = [
        layer(rng, count, positions=move(positions + rng.normal(size=(count, 3)) * noise_m), embeddings=e, types=1)
        for move, e in ((lambda x: x, cone(rng, of)), (S.inverse().apply, cone(rng, of)))
    ]
    return made[0], made[1], S


def test_neighbourhood_is_networkx_within_hops():
    positions = np.random.default_rng(1).uniform(0, 6, (40, 3))
    graph = nx.Graph((i, j) for i, j in np.argwhere(np.linalg.norm(positions[:, None] - positions[None], axis=2) < 1.5))
    reach = neighbourhood(positions, 1.5, 3)
    for i in range(40):
        near = set(nx.single_source_shortest_path_length(graph, i, 3)) - {i}
        assert set(np.flatnonzero(reach[i])) == near


def test_context_counts_neighbours_not_oneself():
    shares = np.eye(8)[:4]
    positions = np.array([[0, 0, 0], [1, 0, 0], [2, 0, 0], [50, 0, 0.0]])
    context = context_histograms(shares, neighbourhood(positions, 1.2, 3))
    np.testing.assert_allclose(context[0] ** 2, np.eye(8)[[1, 2]].mean(0), atol=1e-9)
    np.testing.assert_array_equal(context[3], 0)
    one_hop = context_histograms(shares, neighbourhood(positions, 1.2, 1))
    np.testing.assert_allclose(one_hop[0] ** 2, np.eye(8)[1], atol=1e-9)


def test_words_tell_kinds_of_things_apart_in_a_cone_where_all_are_alike():
    rng = np.random.default_rng(0)
    kinds = rng.integers(0, 6, 120)
    features = cone(rng, kinds, spread=0.1, noise=0.01)
    assert (features @ features.T).min() > 0.97  # cosines alone tell next to nothing
    shares = word_shares(features, 6, 20.0)
    np.testing.assert_allclose(shares.sum(1), 1, atol=1e-9)
    words = shares.argmax(1)
    assert len({(k, w) for k, w in zip(kinds, words, strict=True)}) == 6
    assert shares.max(1).min() > 0.9


def test_words_are_the_centres_of_what_is_nearest_to_them():
    rng = np.random.default_rng(3)
    features = rng.normal(size=(200, 12))
    centred = features - features.mean(0)
    centred /= np.linalg.norm(centred, axis=1, keepdims=True)
    first = word_shares(features, 5, 1.0)
    # Of a softmax of cosines the logarithms are the cosines, but for a constant a row: enough to know each one's word.
    labels = first.argmax(1)
    centres = np.stack([centred[labels == w].sum(0) for w in range(5)])
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)
    agree = (centred @ centres.T).argmax(1) == labels
    assert agree.mean() > 0.9  # few still move between words after the steps it takes


def test_fewer_features_than_words_and_all_alike_are_no_trouble():
    assert word_shares(np.ones((3, 4)), 48, 20.0).shape == (3, 3)
    np.testing.assert_allclose(word_shares(np.ones((3, 4)), 2, 20.0), 0.5)
    assert word_shares(np.ones((1, 4)), 48, 20.0).tolist() == [[1.0]]


def test_embeddings_hold_the_feature_and_the_context_of_the_neighbours_within_hops():
    a, b, _ = flat(count=60)
    for hops, weight in ((1, 0.5), (3, 1.5)):
        shares = word_shares(np.concatenate([a.features, b.features]), context.NUM_WORDS, context.SHARPNESS)
        both = add_context(a, b, Params(hops), weight=weight, max_distance_m=1.0)
        for joined, plain, own in zip(both, (a, b), (shares[:60], shares[60:]), strict=True):
            apart = np.linalg.norm(plain.positions[:, None] - plain.positions[None], axis=2)
            graph = nx.Graph((i, j) for i, j in np.argwhere((apart < 1.0) & (apart > 0)))
            for i in range(60):
                near = set(nx.single_source_shortest_path_length(graph, i, hops)) - {i} if i in graph else set()
                counted = own[sorted(near)].sum(0)
                words = np.sqrt(counted / max(counted.sum(), 1e-12))
                parts = np.concatenate([plain.features[i], weight * words])
                np.testing.assert_allclose(joined.embeddings[i], parts / np.linalg.norm(parts), atol=1e-5)


def test_lengths_are_metres_of_the_layers_own_unit():
    a, b, _ = flat(count=60)
    small = replace(b, positions=b.positions / 10, extents=b.extents / 10, unit_m=10.0)
    np.testing.assert_array_equal(add_context(a, small)[1].embeddings, add_context(a, b)[1].embeddings)


def test_what_is_compared_does_not_depend_on_which_layer_comes_first():
    a, b, _ = flat()
    one, other = add_context(a, b), add_context(b, a)
    alike = one[0].embeddings @ one[1].embeddings.T
    np.testing.assert_allclose(other[1].embeddings @ other[0].embeddings.T, alike, atol=1e-4)


def test_contexts_of_objects_far_apart_differ():
    a, b, _ = flat()
    joined, _ = add_context(a, b)
    words = joined.embeddings[:, a.features.shape[1] :]
    words = words / np.maximum(np.linalg.norm(words, axis=1, keepdims=True), 1e-9)
    far = np.triu(np.linalg.norm(a.positions[:, None] - a.positions[None], axis=2) > 6, 1)
    assert np.median((words @ words.T)[far]) < 0.8
    assert np.median((a.features @ a.features.T)[far]) > 0.9


def right_share(a: NodeLayer, b: NodeLayer) -> float:
    matches = match_nodes(a, b)
    return float((matches.target_ids == matches.source_ids).mean())


def test_things_of_one_kind_are_told_apart_by_what_stands_around_them():
    a, b, _ = flat()
    without, with_ = right_share(a, b), right_share(*add_context(a, b))
    assert without < 0.15
    assert with_ > 3 * without
    assert right_share(*add_context(a, b, weight=0.0)) == without


def test_a_pose_by_objects_of_few_kinds_needs_their_context(monkeypatch):
    a, b, _ = flat()
    graphs = [SceneGraph(name, {"objects": nodes}) for name, nodes in (("a", a), ("b", b))]
    (best, *_) = propose_by_kind(*graphs, "objects")
    monkeypatch.setattr(context, "add_context", lambda a, b, params: (a, b))
    (blind, *_) = propose_by_kind(*graphs, "objects")
    assert np.linalg.norm(best.S_target_source.apply(b.positions) - a.positions, axis=1).max() < 0.15
    assert best.num_inliers > 2 * blind.num_inliers
