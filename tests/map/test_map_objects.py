"""Objects of a map: three captures of one made room, each in a frame of its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import networkx as nx
import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "describe"))
from made_room import Room, looking_about

import gsmap.map
from gsmap.errors import ConfigError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import Map
from gsmap.types import Change, ChangeReport, PoseGraph, ScenePose, Sim3

FRAMES = {
    "may": Sim3(exp_so3(np.array([0, 0, 0.4])), np.array([3.0, 1, 0.2])),
    "june": Sim3(exp_so3(np.array([0, 0, -1.0])), np.array([-2.0, 5, 1])),
    "july": Sim3(exp_so3(np.array([0, 0, 2.0])), np.array([0.0, 2, 0])),
}
DATES = {"may": "2026-05-31", "june": "2026-06-30", "july": "2026-07-30"}
CUPBOARD, TABLE, STOOL = [0.25, 1.0, 0.9], [2.6, 0.35, 0.4], [2.5, 2.3, 0.2]


def capture(seed: int, table: bool, stool: bool = False, turned: bool = False):
    room = Room(seed)
    room.box([0.03, 0.5, 0.0], [0.5, 1.5, 1.8], (0.5, 0.3, 0.2), 0)
    if table:
        room.box([2.0, 0.03, 0.0], [3.2, 0.7, 0.75], (0.3, 0.4, 0.6), 1)
    if stool:
        room.box([2.3, 2.1, 0.0], [2.7, 2.5, 0.45], (0.8, 0.7, 0.1), 2)
    cameras = looking_about()
    # The last one looks at the cupboard's side of the room alone.
    return room.made()[0], cameras[np.arange(5, 8)] if turned else cameras


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Map]:
    path = tmp_path_factory.mktemp("objects") / "site.gsmap"
    captures = {
        "may": capture(1, table=True),
        "june": capture(2, table=False, stool=True),
        "july": capture(3, table=False, turned=True),
    }
    with pytest.MonkeyPatch.context() as patched, gsmap.map.create(path) as m:
        patched.setenv("GSMAP_WORKERS", "1")
        for name, (gaussians, cameras) in captures.items():
            S = FRAMES[name]
            m.ingest(
                transform_gaussians(gaussians, S),
                cameras=transform_cameras(cameras, S),
                name=name,
                captured_at=DATES[name],
                scale="known",
            )
        m.with_settings({"describe.landmarks": False, "describe.objects": False, "describe.gravity.max_normals": 500})
        m.describe()
        poses = {s.id: ScenePose(s.id, FRAMES[s.name].inverse(), 0, "placed") for s in m.scenes()}
        m.store.revisions.save(PoseGraph(poses))
        yield m


def at(place: list[float]) -> str:
    return ",".join(map(str, place))


def states(m: Map, place: list[float]) -> list[str]:
    report = m.history(at(place))
    assert len(report.objects) == 1
    assert [row.scene_name for row in report.sightings] == ["may", "june", "july"]
    return [row.state for row in report.sightings]


def test_a_thing_is_seen_then_gone_and_unseen_is_said(site: Map) -> None:
    assert states(site, CUPBOARD) == ["seen", "seen", "seen"]
    assert states(site, TABLE) == ["seen", "absent", "unseen"]
    assert states(site, STOOL)[:2] == ["absent", "seen"]
    (table,) = site.history(at(TABLE)).objects
    assert (table.seen, table.looks, table.there) == (1, 2, False)
    assert table.first_seen == table.last_seen == "2026-05-31T00:00:00+00:00"
    assert table.half_life_days == pytest.approx(np.log(2) * 15 / 1.5)
    np.testing.assert_allclose(table.size, [1.2, 0.67, 0.75], atol=0.1)
    np.testing.assert_allclose(table.position[:2], [2.6, 0.37], atol=0.15)


def test_places_are_told_by_object_by_point_and_by_box(site: Map) -> None:
    (table,) = site.history(at(TABLE)).objects
    assert [row.id for row in site.history(table.id).objects] == [table.id]
    assert [row.id for row in site.history(table.id[:5]).objects] == [table.id]
    everything = site.history(box=[-1, -1, -1, 5, 5, 3])
    assert len(everything.objects) == len(site.objects().objects) == 3
    nothing = site.history("2,1.5,1.5")
    assert nothing.objects == ()
    assert "no thing" in nothing.notes[-1]
    for place, box in ((None, None), ("abcd1234", [0] * 6), ("here", None), ("1,2", None), (None, [1, 0, 0, 0, 1, 1])):
        with pytest.raises(ConfigError):
            site.history(place, box=box)
    with pytest.raises(NotFoundError):
        site.history("00000000")


def test_the_graph_is_written_and_is_what_networkx_gets(site: Map, tmp_path: Path) -> None:
    report = site.objects()
    graph = site.graph()
    assert set(graph.nodes) == {row.id for row in report.objects}
    assert graph.number_of_edges() == len(report.relations)
    site.write_graph(tmp_path / "o.graphml", "graphml")
    assert set(nx.read_graphml(tmp_path / "o.graphml").nodes) == set(graph.nodes)
    site.write_graph(tmp_path / "o.json", "json")
    assert json.loads((tmp_path / "o.json").read_text())["objects"] == report.to_json()["objects"]
    with pytest.raises(ConfigError):
        site.write_graph(tmp_path / "o.x", "dot")


def test_ids_stay_when_a_capture_comes_or_a_pose_moves(site: Map) -> None:
    before = {row.id for row in site.objects().objects if row.there}
    placed = site.store.revisions.get()
    assert placed is not None
    turn = Sim3(exp_so3(np.array([0, 0, 0.7])), np.array([9.0, 0, 0]))
    moved = {s: ScenePose(s, turn @ pose.S_map_scene, 0, "placed") for s, pose in placed.poses.items()}
    site.store.revisions.save(PoseGraph(moved))
    assert {row.id for row in site.objects().objects if row.there} == before
    july = site.store.scenes.get("july").id
    site.store.revisions.save(PoseGraph({s: pose for s, pose in placed.poses.items() if s != july}))
    assert {row.id for row in site.objects().objects if row.there} >= before - {""}
    site.store.revisions.save(placed)


def test_a_change_of_kind_moved_makes_two_places_one_object(site: Map) -> None:
    may, june = site.store.scenes.get("may"), site.store.scenes.get("june")
    graphs = {s.name: site.store.graphs.load(s.id) for s in (may, june)}
    (table,), (stool,) = site.history(at(TABLE)).objects, site.history(at(STOOL)).objects
    thing = {row.id: row for row in (table, stool)}
    assert len(thing) == 2

    def members(name: str, position: np.ndarray) -> np.ndarray:
        found = graphs[name].things
        there = FRAMES[name].inverse().apply(found.positions)
        nearest = int(np.argmin(np.linalg.norm(there - position, axis=1)))
        return np.flatnonzero(found.members == nearest).astype(np.int32)

    cells = np.zeros((1, 3), np.float32)
    change = Change(
        "moved",
        np.array([[0.0, 0, 0], [1, 1, 1]]),
        cells,
        members("may", table.position),
        members("june", stool.position),
        Sim3.identity(),
        confidence=0.9,
    )
    from gsmap.change import recipe_key

    site.store.changes.save(
        ChangeReport((change,), 1.0, np.ones(3)),
        recipe_key().of(may.id, june.id),
        older=may.id,
        newer=june.id,
        S_newer_older=Sim3.identity(),
        S_frame_newer=Sim3.identity(),
    )
    (one,) = site.history(at(TABLE)).objects
    assert one.id == site.history(at(STOOL)).objects[0].id
    assert one.seen == 2
    number = site.store.changes.current()[0].changes[0].number
    site.store.changes.review(number, "reject")
    assert site.history(at(TABLE)).objects[0].seen == 1


def test_objects_are_the_same_whatever_the_unit_of_the_map(site: Map) -> None:
    one, graph = site.objects(), site.pose_graph()
    assert graph is not None
    smaller = Sim3(np.eye(3), np.zeros(3), 0.1)
    poses = {s: replace(pose, S_map_scene=smaller @ pose.S_map_scene) for s, pose in graph.poses.items()}
    site.store.revisions.save(PoseGraph(poses))
    try:
        two, seen = site.objects(), states(site, [v / 10 for v in CUPBOARD])
        (box, box_m), *_ = [(row.box, row.box_m) for row in site.history(at([v / 10 for v in CUPBOARD])).sightings]
    finally:
        site.store.revisions.save(graph)
    assert [(a.seen, a.looks, a.there) for a in two.objects] == [(a.seen, a.looks, a.there) for a in one.objects]
    assert len(two.relations) == len(one.relations)
    for a, b in zip(one.objects, two.objects, strict=True):
        np.testing.assert_allclose(10 * b.position, a.position, atol=1e-5)
    assert seen == states(site, CUPBOARD)
    np.testing.assert_allclose(box_m, 10 * box)


def test_captures_without_things_are_named(site: Map) -> None:
    may = site.store.scenes.get("may").id
    site.store.graphs.forget([g.key for g in site.store.graphs.list() if g.scene == may])
    report = site.objects()
    assert "may" in report.notes[0]
    assert len(report.objects) == 2
