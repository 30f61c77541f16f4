"""Relations, permanence and the graph of objects, by hand."""

import networkx as nx
import numpy as np
import pytest

from gsmap.objects import estimate_persistence, graphml, object_graph, relations
from gsmap.types import MapObject, ObjectObservation

DATES = {
    "a": "2024-01-01T00:00:00+00:00",
    "b": "2024-01-11T00:00:00+00:00",
    "c": "2024-01-31T00:00:00+00:00",
    "d": None,
}


def thing(name, low, high, states="seen", component=0) -> MapObject:
    """An object with a sighting for each of the states, in captures a, b, c, d."""
    box = np.array([low, high], float)
    words = states.split()
    sightings = tuple(
        ObjectObservation(scene, state, 0, box if state == "seen" else None)
        for scene, state in zip("abcd", words, strict=False)
    )
    return MapObject(name, component, box, box.mean(0), np.zeros(3, np.float32), sightings)


TABLE = thing("table", [0, 0, 0], [1, 1, 0.7])


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        ([0.2, 0.2, 0.7], [0.4, 0.4, 1.0], [("x", "on", "table")]),
        ([0.2, 0.2, 0.9], [0.4, 0.4, 1.2], []),
        ([0.9, 0.9, 0.7], [1.9, 1.9, 1.0], []),
        ([1.2, 0, 0], [1.7, 1, 0.5], [("table", "next to", "x")]),
        ([1.5, 0, 0], [2.5, 1, 0.5], []),
        ([0.2, 0.2, 0.1], [0.5, 0.5, 0.4], [("x", "in", "table")]),
    ],
)
def test_relations_by_boxes(low, high, expected):
    found = relations([TABLE, thing("x", low, high)])
    assert [(r.source, r.kind, r.target) for r in found] == expected


def test_only_things_that_are_there_together_are_related():
    vase = [0.2, 0.2, 0.7], [0.4, 0.4, 1.0]
    assert relations([TABLE, thing("vase", *vase, states="seen absent")]) == []
    assert relations([TABLE, thing("vase", *vase, component=1)]) == []
    gone = thing("table", [0, 0, 0], [1, 1, 0.7], "seen absent")
    assert len(relations([gone, thing("vase", *vase, states="seen absent unseen")])) == 1


def test_relations_are_of_metres():
    """A map in centimetres."""
    far = thing("x", [120, 0, 0], [170, 100, 50])
    assert len(relations([thing("table", [0, 0, 0], [100, 100, 70]), far], metres=0.01)) == 1


@pytest.mark.parametrize(
    ("states", "seen", "looks", "half_life"),
    [
        ("seen seen seen", 3, 3, np.log(2) * 30 / 0.5),
        ("seen absent absent", 1, 3, np.log(2) * 5 / 1.5),
        ("seen unseen absent", 1, 2, np.log(2) * 15 / 1.5),
        ("absent seen seen", 2, 3, np.log(2) * 20 / 0.5),
        ("seen unseen unseen", 1, 1, None),
        ("seen unseen unseen seen", 2, 2, None),
    ],
)
def test_permanence(states, seen, looks, half_life):
    stays = estimate_persistence(thing("x", [0, 0, 0], [1, 1, 1], states), DATES)
    assert (stays.seen, stays.looks) == (seen, looks)
    assert stays.half_life_days == (None if half_life is None else pytest.approx(half_life))


def test_there_is_what_the_newest_look_says():
    at = [0, 0, 0], [1, 1, 1]
    assert thing("x", *at, states="absent seen unseen").there
    assert not thing("x", *at, states="seen absent unseen").there


def test_the_graph_reads_back_as_graphml(tmp_path):
    vase = thing("vase", [0.2, 0.2, 0.7], [0.4, 0.4, 1.0], "seen unseen")
    graph = object_graph([TABLE, vase], DATES)
    (tmp_path / "o.graphml").write_text(graphml(graph))
    back = nx.read_graphml(tmp_path / "o.graphml")
    assert set(back.nodes) == {"table", "vase"}
    assert [data["kind"] for _, _, data in back.edges(data=True)] == ["on"]
    assert back.nodes["vase"]["size_z"] == pytest.approx(0.3)
    assert back.nodes["vase"]["there"] is True


def test_objects_far_from_each_other_are_not_compared_and_the_others_are():
    rng = np.random.default_rng(3)
    low = rng.uniform(0, 40, (300, 3)) * [1, 0.2, 0.02]
    things = [thing(f"t{k}", at, at + rng.uniform(0.2, 1.5, 3)) for k, at in enumerate(low)]
    every = [(r.source, r.kind, r.target) for r in relations(things)]
    alone = [
        (r.source, r.kind, r.target)
        for i in range(len(things))
        for j in range(i + 1, len(things))
        for r in relations([things[i], things[j]])
    ]
    assert len(every) > 100
    assert sorted(every) == sorted(alone)
