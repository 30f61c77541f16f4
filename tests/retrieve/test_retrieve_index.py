"""The index: segments hold what was put in, become one as they grow, and say the same in any order."""

from dataclasses import replace

import numpy as np
import pytest
from retrieve_worlds import UP, layer, turned, walk

from gsmap._native import near_codes
from gsmap.errors import CorruptError
from gsmap.retrieve import Params, look_up, lookup, new_segment, select_nodes
from gsmap.retrieve import codes as coding
from gsmap.types import SceneGraph
from gsmap.types.retrieval import IndexArrays
from gsmap.types.segments import InMemory, merged, places_of, to_merge, write_places


def _voters(graphs):
    return [select_nodes(graph, f"{i:032x}", 400) for i, graph in enumerate(graphs)]


def test_nodes_per_scene_keeps_the_strongest_of_each_layer():
    (graph,) = walk(1)
    nodes = graph.layers["landmarks"]
    order = np.random.default_rng(4).permutation(len(nodes))
    layers = {"landmarks": replace(nodes, weights=1.0 + order), "objects": replace(nodes, descriptor_id="other")}
    kept = select_nodes(replace(graph, layers=layers), "", Params(nodes_per_scene=5).nodes_per_scene).index_nodes
    strongest = coding.encode(nodes.embeddings[order >= len(nodes) - 5])
    found = {tuple(code) for code in kept.codes.tolist()}
    assert len(kept) == 2 * 5
    assert {tuple(code) for code in strongest.tolist()} <= found


def test_distances_of_codes_are_those_of_the_vectors():
    rng = np.random.default_rng(0)
    for dim in (24, 48, 112):
        vectors = rng.normal(size=(200, dim)) * np.r_[np.ones(20), np.full(dim - 20, 0.05)]
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        if dim == 112:  # within the axes that are kept: what lies outside of them is lost by intent
            with np.load(coding.AXES) as axes:
                vectors = axes["112.mean"] + 0.5 * vectors[:, :48] @ axes["112.axes"].T
        codes = coding.encode(vectors).astype(float)
        told = np.linalg.norm(codes[:, None] - codes[None], axis=2) / coding.SCALE
        true = np.linalg.norm(vectors[:, None] - vectors[None], axis=2)
        assert np.quantile(np.abs(told - true), 0.9) < 0.05  # a component beyond 127 / 200 is cut off


def test_vectors_of_any_dimension_have_codes_that_tell_them_apart():
    rng = np.random.default_rng(1)
    vectors = rng.normal(size=(300, 1024))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    again = vectors + rng.normal(size=vectors.shape) * 0.006
    a, b = coding.encode(vectors).astype(float), coding.encode(again).astype(float)
    nearest = np.linalg.norm(a[:, None] - b[None], axis=2).argmin(1)
    assert (nearest == np.arange(300)).mean() > 0.97


def test_sums_of_codes_are_exact_in_any_order():
    rng = np.random.default_rng(2)
    a, b = (rng.integers(-127, 128, (50, coding.NUM_DIMS)).astype(np.float32) for _ in range(2))
    order = rng.permutation(coding.NUM_DIMS)
    assert (a @ b.T == a[:, order] @ b[:, order].T).all()
    assert (a @ b.T == a.astype(np.int64) @ b.astype(np.int64).T).all()


def test_a_node_is_looked_for_where_its_list_is_and_where_it_nearly_is():
    rng = np.random.default_rng(3)
    codes = rng.integers(-60, 60, (500, coding.NUM_DIMS)).astype(np.int8)
    keys = coding.keys_of(coding.space("d", second=False), np.zeros(500), codes)
    near = np.clip(codes + rng.integers(-4, 5, codes.shape), -127, 127).astype(np.int8)
    probes = coding.probes(coding.keys_of(coding.space("d", second=False), np.zeros(500), near), near, 2)
    assert probes.shape == (500, 4)
    assert (probes == keys[:, None]).any(1).mean() > 0.97
    assert len(np.unique(keys)) > 20
    assert coding.space("d", second=False) != coding.space("d", second=True)


def test_merging_keeps_every_node_and_leaves_out_what_does_not_count():
    graphs = walk(9)
    voters = _voters(graphs)
    whole = new_segment(voters)
    parts = [new_segment(voters[:2]), new_segment(voters[2:3]), new_segment(voters[3:])]
    one = merged(parts)
    assert [m.scene for m in one.members] == [m.scene for m in whole.members]
    assert np.array_equal(one.arrays.keys, whole.arrays.keys)
    assert np.array_equal(one.arrays.starts, whole.arrays.starts)
    assert np.array_equal(one.arrays.nodes, whole.arrays.nodes)
    without = merged([replace(whole, members=[None, *whole.members[1:]])])
    again = new_segment(voters[1:])
    assert np.array_equal(without.arrays.nodes, again.arrays.nodes)
    assert places_of(without.arrays.nodes, 8).max() == 7


def test_segments_stay_few_and_are_seldom_written_again():
    sizes, written = [], 0
    for _ in range(2000):
        gone = to_merge(sizes, 1)
        new = 1 + sum(sizes[k] for k in gone)
        sizes = [size for k, size in enumerate(sizes) if k not in gone] + [new]
        written += new
        assert len(sizes) <= 4
    assert sum(sizes) == 2000
    assert written < 2000 * 40


def test_any_order_and_any_segments_say_the_same(monkeypatch):
    rng = np.random.default_rng(4)
    graphs = walk(40)
    graphs += [replace(graph, scene_id=f"x{graph.scene_id}") for graph in graphs[:6]]  # as alike as can be: ties
    voters = _voters(graphs)
    monkeypatch.setattr(lookup, "MAX_VERIFIED", 3)  # where ties are cut, too
    params = Params(top_k=5)
    first = look_up(voters, [new_segment(voters)], params)
    for count in (1, 2, 7):
        order = rng.permutation(len(voters))
        segments = [new_segment([voters[k] for k in part]) for part in np.array_split(order, count)]
        assert look_up(voters, segments, params) == first
    assert look_up(voters[:3], [new_segment(voters)], params) == first[:3]


def test_a_place_turned_and_moved_ranks_before_one_with_the_same_things_elsewhere():
    rng = np.random.default_rng(5)
    features, kinds = rng.normal(size=(80, 24)), rng.integers(0, 3, 80)
    places = rng.uniform(0, 1, (80, 3)) * [6, 5, 2.5]

    def scene(name, positions):
        seen = features + rng.normal(size=features.shape) * 0.1
        nodes = layer(rng, 80, embeddings=seen, type_ids=kinds, positions=positions)
        return SceneGraph(name, {"landmarks": nodes}, UP)

    asking = scene("m", places)
    moved = scene("z", turned(places + rng.normal(size=places.shape) * 0.02, rng))
    elsewhere = [scene(f"a{k}", rng.permutation(places)) for k in range(6)]
    voters = _voters([asking, moved, *elsewhere])
    (found,) = look_up(voters[:1], [new_segment(voters)], Params())
    assert found[0].scene == "z"
    assert found[0].score > 3 * found[1].score
    # What all say alike, votes do not tell apart.
    assert max(c.votes for c in found) < 1.5 * min(c.votes for c in found)


def test_what_is_everywhere_says_little():
    """Two rooms share their furniture; forty share the walls, which are most of what is seen."""
    rng = np.random.default_rng(6)
    walls, things = rng.normal(size=(60, 24)), rng.normal(size=(25, 20, 24))
    at_wall, at_thing = rng.uniform(0, 1, (60, 3)) * [6, 5, 2.5], rng.uniform(0, 1, (25, 20, 3)) * [6, 5, 1]
    graphs = []
    for k in range(50):
        room = k // 2
        e = np.concatenate([walls, things[room]]) + rng.normal(size=(80, 24)) * 0.1
        p = turned(np.concatenate([at_wall, at_thing[room]]) + rng.normal(size=(80, 3)) * 0.01, rng)
        nodes = layer(rng, 80, embeddings=e, type_ids=np.zeros(80), positions=p)
        graphs.append(SceneGraph(f"s{k:02}", {"landmarks": nodes}, UP))
    voters = _voters(graphs)
    found = look_up(voters, [new_segment(voters)], Params())
    firsts = [said[0].scene for said in found]
    assert sum(first == f"s{k ^ 1:02}" for k, first in enumerate(firsts)) >= 48


def test_decoration_that_repeats_says_less_than_how_the_same_things_stand():
    """Scenes of two rooms each, in a row: all have the same walls, and the same things, elsewhere in each."""
    rng = np.random.default_rng(7)
    walls, things = rng.normal(size=(2, 24, 24)), rng.normal(size=(20, 24))
    at_wall = rng.uniform(0, 1, (2, 24, 3)) * [5, 5, 2.5]
    at_thing = rng.uniform(0, 1, (61, 20, 3)) * [5, 5, 1]
    graphs = []
    for k in range(60):
        e, p = [], []
        for room in (k, k + 1):
            east = [5.0 * (room - k), 0, 0]
            e += [walls[room % 2], things]
            p += [at_wall[room % 2] + east, at_thing[room] + east]
        seen, places = np.concatenate(e), np.concatenate(p)
        seen = seen + rng.normal(size=seen.shape) * 0.1
        places = turned(places + rng.normal(size=places.shape) * 0.02, rng)
        nodes = layer(rng, len(seen), embeddings=seen, type_ids=np.zeros(len(seen)), positions=places)
        graphs.append(SceneGraph(f"s{k:02}", {"landmarks": nodes}, UP))
    voters = _voters(graphs)
    found = look_up(voters, [new_segment(voters)], Params())
    firsts = [{one.scene for one in said[:5]} for said in found]
    beside = [f"s{k + step:02}" in firsts[k] for k in range(60) for step in (-1, 1) if 0 <= k + step < 60]
    assert np.mean(beside) > 0.8  # by what nodes say alone, none


def test_rooms_decorated_alike_are_told_apart_by_the_little_that_else_agrees():
    """Each shows 60 % of what is there; many agree in as much of the walls as the two that share a room."""
    rng = np.random.default_rng(9)
    num, decorations = 150, 5
    walls, things = rng.normal(size=(decorations, 40, 24)), rng.normal(size=(12, 24))
    at_wall = rng.uniform(0, 1, (decorations, 40, 3)) * [5, 5, 2.5]
    at_thing = rng.uniform(0, 1, (num + 1, 12, 3)) * [5, 5, 1]
    graphs = []
    for k in range(num):
        e, p = [], []
        for room in (k, k + 1):
            east = [5.0 * (room - k), 0, 0]
            e += [walls[room % decorations], things]
            p += [at_wall[room % decorations] + east, at_thing[room] + east]
        seen, places = np.concatenate(e), np.concatenate(p)
        again = rng.uniform(size=len(seen)) < 0.6
        seen = (seen + rng.normal(size=seen.shape) * 0.1)[again]
        places = turned((places + rng.normal(size=places.shape) * 0.02)[again], rng)
        nodes = layer(rng, len(seen), embeddings=seen, type_ids=np.zeros(len(seen)), positions=places)
        graphs.append(SceneGraph(f"s{k:03}", {"landmarks": nodes}, UP))
    voters = _voters(graphs)
    found = look_up(voters, [new_segment(voters)], Params())
    firsts = [{one.scene for one in said[:5]} for said in found]
    beside = [f"s{k + step:03}" in firsts[k] for k in range(num) for step in (-1, 1) if 0 <= k + step < num]
    assert np.mean(beside) > 0.75  # by how much agrees alone .61, by its rarity in pairs .07


def test_a_place_visited_more_often_than_scenes_are_compared_with_is_found():
    """Sixty visits of one room, which lie where each other lie, among sixty with its walls and its things elsewhere."""
    rng = np.random.default_rng(12)
    walls, things = rng.normal(size=(40, 24)), rng.normal(size=(20, 24))
    at_wall = rng.uniform(0, 1, (40, 3)) * [5, 5, 2.5]
    mine = rng.uniform(0, 1, (20, 3)) * [5, 5, 1]
    graphs = []
    for k in range(120):
        at_thing = mine if k < 60 else rng.uniform(0, 1, (20, 3)) * [5, 5, 1]
        again = rng.uniform(size=60) < 0.6
        seen = (np.concatenate([walls, things]) + rng.normal(size=(60, 24)) * 0.1)[again]
        places = turned((np.concatenate([at_wall, at_thing]) + rng.normal(size=(60, 3)) * 0.02)[again], rng)
        nodes = layer(rng, len(seen), embeddings=seen, type_ids=np.zeros(len(seen)), positions=places)
        graphs.append(SceneGraph(f"s{k:03}", {"landmarks": nodes}, UP))
    params = Params()
    assert lookup.PEERS < 59
    voters = _voters(graphs)
    found = look_up(voters[:8], [new_segment(voters)], params)
    visits = {f"s{k:03}" for k in range(60)}
    assert np.mean([one.scene in visits for said in found for one in said[: params.top_k]]) > 0.9


@pytest.mark.parametrize("knows_up", [True, False])
def test_scenes_are_laid_onto_each_other_however_they_are_turned_and_whatever_their_unit(knows_up):
    rng = np.random.default_rng(10)
    features, kinds = rng.normal(size=(80, 24)), rng.integers(0, 3, 80)
    places = rng.uniform(0, 1, (80, 3)) * [6, 5, 2.5]

    def scene(name, positions, layer_name="landmarks:0"):
        seen = features + rng.normal(size=features.shape) * 0.1
        spin = np.eye(3) if knows_up else np.linalg.qr(rng.normal(size=(3, 3)))[0]
        spin *= np.sign(np.linalg.det(spin))
        nodes = layer(rng, 80, embeddings=seen, type_ids=kinds, positions=turned(positions, rng) @ spin.T)
        return SceneGraph(name, {layer_name: nodes}, UP if knows_up else None)

    asking = scene("m", places)
    moved = scene("z", 1.2 * (places + rng.normal(size=places.shape) * 0.02))
    elsewhere = [scene(f"a{k:02}", rng.permutation(places)) for k in range(20)]
    mirrored = scene("b", places * [1, 1, -1] if knows_up else -places)
    voters = _voters([asking, moved, mirrored, *elsewhere])
    (found,) = look_up(voters[:1], [new_segment(voters)], Params())
    assert found[0].scene == "z"
    assert found[0].score > 2 * found[1].score


def test_hostile_lists_and_nodes_are_refused():
    voters = _voters(walk(3))
    good = new_segment(voters).arrays
    members = [one.member for one in voters]
    backwards = good.starts.copy()
    backwards[1] = backwards[-1] + 5
    strange = good.nodes.copy()
    strange[:, -4:] = np.array([77], "<i4").view(np.uint8)
    for arrays in (
        IndexArrays(good.keys[::-1], good.starts, good.nodes),
        IndexArrays(good.keys, backwards, good.nodes),
        IndexArrays(good.keys, good.starts[:-1], good.nodes),
        IndexArrays(good.keys, good.starts, good.nodes[:-3]),
        IndexArrays(good.keys, good.starts, strange),
    ):
        with pytest.raises(CorruptError):
            look_up(voters, [InMemory(members, arrays)], Params())


@pytest.mark.usefixtures("instruction_set")
def test_the_nearest_that_count_are_found_in_any_parts_with_all_that_are_as_near():
    rng = np.random.default_rng(8)
    votes, most = 5, 60_000
    mine = rng.integers(-60, 61, (30, coding.NUM_DIMS)).astype(np.int8)
    rows = np.zeros((900, coding.NUM_DIMS + 10), np.uint8)
    theirs = np.clip(np.repeat(mine, 30, 0) + rng.integers(-30, 31, (900, 1)), -127, 127).astype(np.int8)
    rows[:, : coding.NUM_DIMS] = theirs.view(np.uint8)
    of = rng.integers(0, 40, 900)
    write_places(rows, of)
    place_of = np.where(np.arange(40) % 4 == 0, -1, np.arange(40)).astype(np.int32)
    squared = ((mine[:, None].astype(int) - theirs) ** 2).sum(2)
    ends = np.array([0, 250, 251, 700, 900])
    asking = np.repeat(np.arange(30), 4)
    begin, end = np.tile(ends[:-1], 30), np.tile(ends[1:], 30)
    nearest = np.full((30, votes), most, np.int32)
    who, which, told, places = near_codes(mine, asking, begin, end, rows, place_of, nearest)
    assert (told == squared[who, which]).all()
    assert (places == place_of[of[which]]).all()
    ties = 0
    for k in range(30):
        counts = squared[k][place_of[of] >= 0]
        bar = min(np.sort(counts)[votes - 1], most)
        assert nearest[k, 0] == bar
        want = np.flatnonzero((squared[k] <= bar) & (place_of[of] >= 0))
        assert sorted(which[(who == k) & (told <= bar)]) == want.tolist()
        ties += len(want) > votes
    assert ties > 3


def test_a_row_of_no_scene_is_refused():
    voters = _voters(walk(3))
    good = new_segment(voters)
    strange = good.arrays.nodes.copy()
    strange[:, -4:] = np.array([len(voters)], "<i4").view(np.uint8)  # the first that is not there
    none = np.arange(len(voters), dtype=np.int32)
    nearest = np.full((1, 4), 2**22, np.int32)
    at = np.array([0]), np.array([0]), np.array([len(strange)])
    with pytest.raises(ValueError, match="a scene that is not there"):
        near_codes(voters[0].query_nodes.codes[:1], *at, strange, none, nearest)
    with pytest.raises(ValueError, match="outside of the rows"):
        near_codes(voters[0].query_nodes.codes[:1], *at[:2], at[2] + 1, good.arrays.nodes, none, nearest)


def test_scenes_without_a_node_are_no_trouble():
    voters = _voters([SceneGraph(f"s{k}") for k in range(3)])
    assert look_up(voters, [new_segment(voters)], Params()) == [[], [], []]
    assert new_segment([]).arrays.starts.tolist() == [0]
