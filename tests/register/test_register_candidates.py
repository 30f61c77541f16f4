"""Candidate pairs: true partners are found among many scenes, few others are."""

import numpy as np
from register_worlds import layer

from gsmap.register.candidates import Params, Placed, candidate_pairs
from gsmap.types import SceneGraph


def _walk(num_scenes: int, seed: int = 0, noise: float = 0.15) -> list[SceneGraph]:
    """Scenes along a corridor: each shares a third of its nodes with the next."""
    rng = np.random.default_rng(seed)
    features, kinds = rng.normal(size=(num_scenes * 40 + 40, 24)), rng.integers(0, 3, num_scenes * 40 + 40)
    graphs = []
    for i in range(num_scenes):
        seen = slice(i * 40, i * 40 + 60)
        e = features[seen] + rng.normal(size=(60, 24)) * noise
        graphs.append(SceneGraph(f"s{i}", {"landmarks": layer(rng, 60, embeddings=e, type_ids=kinds[seen])}))
    return graphs


def test_small_maps_are_tried_exhaustively():
    pairs = candidate_pairs(_walk(5))
    assert len(pairs) == 10
    assert set(pairs[:4]) == {("s0", "s1"), ("s1", "s2"), ("s2", "s3"), ("s3", "s4")}


def test_true_partners_are_found_among_many_scenes():
    pairs = candidate_pairs(_walk(80), params=Params(top_k=5))
    wanted = {(f"s{i}", f"s{i + 1}") for i in range(79)}
    assert len(wanted & set(pairs)) >= 75
    assert len(pairs) < 80 * 5
    assert len(set(pairs)) == len(pairs)
    assert all(int(a[1:]) < int(b[1:]) for a, b in pairs)


def test_only_pairs_of_new_scenes_are_asked_for():
    graphs = _walk(30)
    pairs = candidate_pairs(graphs, new={"s7"})
    assert {("s6", "s7"), ("s7", "s8")} <= set(pairs)
    assert all("s7" in pair for pair in pairs)


def test_placed_neighbours_join_the_votes():
    rng = np.random.default_rng(1)
    graphs = [SceneGraph(f"s{i}", {"landmarks": layer(rng, 30)}) for i in range(40)]
    placed = {f"s{i}": Placed(0, np.array([3.0 * i, 0, 0]), 2.0) for i in range(39)}
    placed["s39"] = Placed(1, np.array([0.5, 0, 0]), 2.0)
    pairs = set(candidate_pairs(graphs, placed=placed, params=Params(top_k=0)))
    assert pairs == {(f"s{i}", f"s{i + 1}") for i in range(38)}
    uncertain = {s: Placed(p.component, p.centre, p.radius, sigma=1.0) for s, p in placed.items()}
    assert len(candidate_pairs(graphs, placed=uncertain, params=Params(top_k=0))) > 38


def test_layers_of_different_methods_never_vote_and_empty_graphs_are_fine():
    rng = np.random.default_rng(2)
    a, b = layer(rng, 30), layer(rng, 30)
    object.__setattr__(b, "method", "another")
    assert candidate_pairs([SceneGraph("a", {"landmarks": a}), SceneGraph("b", {"landmarks": b})]) == []
    assert candidate_pairs([SceneGraph("a"), SceneGraph("b")]) == []
    assert candidate_pairs([]) == []
