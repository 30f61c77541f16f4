"""Candidate pairs: true partners are found among many scenes, few others are."""

from dataclasses import replace

import numpy as np
from retrieve_worlds import layer, walk
from retrieved_pairs import candidate_pairs

from gsmap.retrieve import Params, ScenePosition, neighbours
from gsmap.retrieve.neighbours import REACH_SIGMAS
from gsmap.types import NodeLayer, SceneGraph


def test_small_maps_are_tried_exhaustively():
    pairs = candidate_pairs(walk(5))
    assert len(pairs) == 10
    assert set(pairs[:4]) == {(f"s{i:03}", f"s{i + 1:03}") for i in range(4)}


def test_true_partners_are_found_among_many_scenes():
    pairs = candidate_pairs(walk(80), params=Params(top_k=5))
    wanted = {(f"s{i:03}", f"s{i + 1:03}") for i in range(79)}
    assert len(wanted & set(pairs)) >= 75
    assert len(pairs) < 80 * 5
    assert len(set(pairs)) == len(pairs)
    assert all(a < b for a, b in pairs)


def test_any_order_of_scenes_gives_the_same_pairs():
    rng, params = np.random.default_rng(0), Params(top_k=2, num_neighbours=1)
    graphs = walk(30)
    graphs += [replace(graph, scene_id=f"x{graph.scene_id}") for graph in graphs[:6]]  # as alike as can be: ties
    placed = {graph.scene_id: ScenePosition(0, np.zeros(3), 1.0) for graph in graphs[:9]}
    first = candidate_pairs(graphs, positions=placed, params=params)
    for _ in range(5):
        other = [graphs[k] for k in rng.permutation(len(graphs))]
        assert candidate_pairs(other, positions=placed, params=params) == first
    assert all(a < b for a, b in first)


def test_only_pairs_of_new_scenes_are_asked_for():
    graphs = walk(30)
    pairs = candidate_pairs(graphs, new={"s007"})
    assert {("s006", "s007"), ("s007", "s008")} <= set(pairs)
    assert all("s007" in pair for pair in pairs)


def test_placed_neighbours_join_the_votes():
    rng = np.random.default_rng(1)
    graphs = [SceneGraph(f"s{i:02}", {"landmarks": layer(rng, 30)}) for i in range(40)]
    placed = {f"s{i:02}": ScenePosition(0, np.array([3.0 * i, 0, 0]), 2.0) for i in range(39)}
    placed["s39"] = ScenePosition(1, np.array([0.5, 0, 0]), 2.0)
    pairs = set(candidate_pairs(graphs, positions=placed, params=Params(top_k=0)))
    assert pairs == {(f"s{i:02}", f"s{i + 1:02}") for i in range(38)}
    uncertain = {s: ScenePosition(p.component, p.centre, p.radius, sigma=1.0) for s, p in placed.items()}
    assert len(candidate_pairs(graphs, positions=uncertain, params=Params(top_k=0))) > 38


def test_layers_of_different_descriptors_never_vote_and_empty_graphs_are_fine():
    rng = np.random.default_rng(2)
    a, b = layer(rng, 30), layer(rng, 30, descriptor="another")
    assert candidate_pairs([SceneGraph("a", {"landmarks": a}), SceneGraph("b", {"landmarks": b})]) == []
    assert candidate_pairs([SceneGraph("a"), SceneGraph("b")]) == []
    assert candidate_pairs([]) == []


def test_an_asked_scene_may_lack_a_type_of_node():
    # With a pose to find for one scene alone, types that only the others have have no voters.
    graphs = walk(12)
    rng = np.random.default_rng(3)
    features = graphs[4].layers["landmarks"].embeddings
    alone = SceneGraph("alone", {"landmarks": layer(rng, 60, embeddings=features, type_ids=np.ones(60, int))})
    pairs = candidate_pairs([*graphs, alone], new={"alone"})
    assert pairs[0] == ("alone", "s004")
    assert all(a == "alone" for a, _ in pairs)
    strange = SceneGraph("strange", {"landmarks": layer(rng, 20, type_ids=np.full(20, 7), dim=24)})
    assert candidate_pairs([*graphs, strange], new={"strange"}) == []


def test_scenes_of_different_components_are_no_neighbours():
    rng = np.random.default_rng(4)
    graphs = [SceneGraph(f"s{i}", {"landmarks": layer(rng, 5)}) for i in range(4)]
    placed = {f"s{i}": ScenePosition(component=i // 2, centre=np.zeros(3), radius=1.0) for i in range(4)}
    pairs = candidate_pairs(graphs, positions=placed, params=Params(top_k=0))
    assert pairs == [("s0", "s1"), ("s2", "s3")]


def test_gravity_free_landmarks_vote_only_where_a_scene_does_not_know_up():
    rng = np.random.default_rng(5)
    plain = layer(rng, 40)
    levelled = layer(rng, 40, descriptor="levelled")
    up = np.array([0.0, 0.0, 1.0])
    knows = SceneGraph("a", {"landmarks": levelled, "landmarks_gravity_free": plain}, up)
    other = SceneGraph("b", {"landmarks": plain})
    assert candidate_pairs([knows, other]) == [("a", "b")]
    other_levelled = layer(rng, 40, descriptor="levelled of another kind")
    knows_too = SceneGraph("b", {"landmarks": other_levelled, "landmarks_gravity_free": plain}, up)
    assert candidate_pairs([knows, knows_too]) == []


def test_neighbours_of_many_sizes_are_those_that_touch():
    """Against comparing all with all."""
    rng = np.random.default_rng(7)
    params = Params(num_neighbours=1000)
    placed = {
        f"s{i:03}": ScenePosition(
            int(rng.integers(2)), rng.uniform(0, 25, 3), float(np.exp(rng.normal())), rng.uniform(0, 0.3)
        )
        for i in range(200)
    }
    expected = set()
    for a, p in placed.items():
        for b, q in placed.items():
            gap = np.linalg.norm(p.centre - q.centre) - p.radius - q.radius
            if a < b and p.component == q.component and gap <= REACH_SIGMAS * np.hypot(p.sigma, q.sigma):
                expected.add((a, b))
    found = neighbours(placed, params)
    assert set(found) == expected
    assert len(found) == len(expected) > 50
    nearest = neighbours(placed, Params(num_neighbours=2))
    assert set(nearest) < expected


def test_a_scene_whose_layers_at_the_metre_are_empty_is_found_by_those_at_guessed_units():
    """Large coarse captures have no landmark as small as the metre asks for, and many at a guess."""
    graphs = [
        replace(graph, layers={"landmarks": NodeLayer.empty("test", 24), "landmarks:0": graph.layers["landmarks"]})
        if graph.scene_id in ("s003", "s004")
        else graph
        for graph in walk(30)
    ]
    pairs = candidate_pairs(graphs, params=Params(top_k=3))
    assert {("s002", "s003"), ("s003", "s004"), ("s004", "s005")} <= set(pairs)
    assert {("s006", "s007"), ("s020", "s021")} <= set(pairs)


def test_guesses_do_not_vote_where_landmarks_have_nodes_in_metres():
    rng = np.random.default_rng(8)
    guessed, own = layer(rng, 40), layer(rng, 40, descriptor="own")
    for name in ("landmarks", "landmarks@2"):
        knows = {"landmarks": NodeLayer.empty("own", 16), "landmarks:0": guessed, name: own}
        guesses = SceneGraph("b", {"landmarks:0": guessed})
        assert candidate_pairs([SceneGraph("a", knows), guesses]) == []
