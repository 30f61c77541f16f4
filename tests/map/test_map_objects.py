"""Objects of a map: three captures of one made room, each in a frame of its own."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import networkx as nx
import numpy as np
import pytest

sys.path.append(str(Path(__file__).resolve().parents[1] / "describe"))
from made_room import Room, looking_about
from raising import raises
from sqlalchemy import delete

import gsmap.map
from gsmap import formats
from gsmap.errors import ConfigError, DiskFullError, InputError, NotFoundError, ReadOnlyError, StoreError
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import Map
from gsmap.map.changes.compare import standing_comparisons
from gsmap.map.objects.associate import ComponentObjects
from gsmap.map.objects.map_objects import _numbered, compute_objects, load_objects
from gsmap.map.objects.static_filter import find_dynamic_content, is_dynamic
from gsmap.map.page.source import MapPageSource
from gsmap.map.small_map.export import SmallLocalizer
from gsmap.methods import RecipeKey
from gsmap.store import Store, schema
from gsmap.store.graphs import Graphs
from gsmap.store.objects import ObjectSet
from gsmap.store.scenes import Scenes
from gsmap.types import Change, ChangeReport, MapObject, ObjectObservation, PoseGraph, ScenePose, Segments, Sim3

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
        m.with_settings({"describe.landmarks": False, "describe.objects": False})
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
    everything = site.history(box=[-1, -1, -1, 5, 5, 3])
    assert len(everything.objects) == len(site.objects().objects) == 3
    assert site.history(box=np.array([[-1, -1, -1], [5, 5, 3]])) == everything
    nothing = site.history("2,1.5,1.5")
    assert nothing.objects == ()
    assert "no object was ever found" in nothing.notes[-1]
    for place, box in ((None, None), ("abcd1234", [0] * 6), ("1,2", None), (None, [1, 0, 0, 0, 1, 1])):
        with pytest.raises(ConfigError):
            site.history(place, box=box)
    for nobody in ("o99", "00000000", "here"):
        with pytest.raises(NotFoundError):
            site.history(nobody)


def test_the_graph_is_written_and_is_what_networkx_gets(site: Map, tmp_path: Path) -> None:
    report = site.objects()
    graph = site.graph()
    (room,) = report.rooms
    assert room.area_m2 == pytest.approx(12, rel=0.1), "of 4 x 3 m"
    assert {row.room for row in report.objects} == {room.id} == {"r1"}
    assert set(room.objects) == {row.id for row in report.objects}
    np.testing.assert_allclose(room.position, [2, 1.5, 0], atol=0.2)
    low, high = room.outline.min((0, 1)), room.outline.max((0, 1))
    np.testing.assert_allclose([low, high], [[0, 0, 0], [4, 3, 0]], atol=0.2)
    shown = MapPageSource(site.store, site.settings).graph()
    assert [row["room"] for row in shown["objects"]] == [room.id] * len(report.objects)
    (drawn,) = shown["rooms"]
    assert drawn["outline"] == room.outline.tolist()
    assert (drawn["area_m2"], drawn["doors"]) == (room.area_m2, [])
    assert set(graph.nodes) == {row.id for row in report.objects} | {room.id}
    assert graph.number_of_edges() == len(report.relations) + len(room.objects)
    site.write_graph(tmp_path / "o.graphml", "graphml")
    assert set(nx.read_graphml(tmp_path / "o.graphml").nodes) == set(graph.nodes)
    site.write_graph(tmp_path / "o.json", "json")
    assert json.loads((tmp_path / "o.json").read_text())["objects"] == report.to_json()["objects"]
    with pytest.raises(ConfigError):
        site.write_graph(tmp_path / "o.x", "dot")


def test_a_change_is_in_the_room_of_its_box_and_is_found_on_the_plan(site: Map) -> None:
    known = compute_objects(site.store, site.settings, lambda *_: None)
    inside, across, outside = [[1, 1, 0.2], [2, 2, 1]], [[3.2, 1, 0.2], [4.6, 2, 1]], [[5, 5, 0], [6, 6, 1]]
    assert known.room_of_box(0, np.array(inside, float)) == "r1"
    assert known.room_of_box(0, np.array(across, float)) == "r1", "some of it"
    assert known.room_of_box(0, np.array(outside, float)) is None
    assert known.room_of_box(7, np.array(inside, float)) is None
    plan = MapPageSource(site.store, site.settings).plan(0)
    corners = np.array([[0, 0, 0, 1], [4, 0, 0, 1], [4, 3, 0, 1], [4, 3, 2, 1.0]])
    places = corners @ np.array(plan["P_plan_map"]).T
    assert ((places > 0) & (places < 1)).all()
    steps = np.diff(places * plan["size_m"], axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), [4, 3, 0], atol=0.05)  # height is not seen from above
    assert steps[0, 0] * steps[1, 1] - steps[0, 1] * steps[1, 0] < 0, "y goes down the page, so a left turn is mirrored"


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


def save_moved(m: Map, version: str) -> int:
    """A change that says that the table of may is the stool of june; its number."""
    may, june = m.store.scenes.get("may"), m.store.scenes.get("june")

    def members(scene: str, name: str, place: list[float]) -> np.ndarray:
        graph = m.store.graphs.load(scene)
        assert graph is not None
        assert graph.segments is not None
        there = FRAMES[name].inverse().apply(graph.segments.positions)
        nearest = int(np.argmin(np.linalg.norm(there - place, axis=1)))
        return np.flatnonzero(graph.segments.members == nearest).astype(np.int32)

    change = Change(
        "moved",
        np.array([[0.0, 0, 0], [1, 1, 1]]),
        np.zeros((1, 3), np.float32),
        members(may.id, "may", TABLE),
        members(june.id, "june", STOOL),
        Sim3.identity(),
        confidence=0.9,
    )
    found = m.store.changes.save(
        ChangeReport((change,), 1.0, np.ones(3)),
        RecipeKey("change", version, {}).of(may.id, june.id),
        older=may.id,
        newer=june.id,
        S_newer_older=FRAMES["june"] @ FRAMES["may"].inverse(),
        S_frame_newer=Sim3.identity(),
    )
    return found.changes[0].number


def test_a_change_of_kind_moved_makes_two_places_one_object(site: Map) -> None:
    (table,), (stool,) = site.history(at(TABLE)).objects, site.history(at(STOOL)).objects
    assert table.id != stool.id
    number = save_moved(site, "test")
    (one,) = site.history(at(TABLE)).objects
    assert one.id == site.history(at(STOOL)).objects[0].id
    assert one.seen == 2
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


@pytest.mark.guards("answers")
def test_another_order_of_captures_gives_the_objects_of_that_order(site: Map, tmp_path: Path) -> None:
    with gsmap.map.open(site.clone(tmp_path / "order.gsmap").path) as m:
        m.objects()
        m.edit("july", captured_at="2020-01-01")
        updated = m.objects().objects
        with m.store.catalog.write() as connection:
            connection.execute(delete(schema.results).where(schema.results.c.kind == "objects"))
        whole = {row.id: row for row in m.objects().objects}
        assert {row.id for row in updated} == set(whole)
        for row in updated:
            np.testing.assert_allclose(row.position, whole[row.id].position, atol=1e-9)
            assert row.seen == whole[row.id].seen


def test_objects_of_a_component_that_comes_apart_have_numbers_of_their_own(site: Map, tmp_path: Path) -> None:
    with gsmap.map.open(site.clone(tmp_path / "clone.gsmap").path) as m:
        before = {row.id for row in m.objects().objects}
        (cupboard,) = m.history(at(CUPBOARD)).objects
        m.edit_object(cupboard.id, name="grandmother's cupboard")
        placed = m.store.revisions.get()
        assert placed is not None
        june = m.store.scenes.get("june").id
        m.store.revisions.save(
            PoseGraph({s: replace(pose, component=int(s == june)) for s, pose in placed.poses.items()})
        )
        report = m.objects()
        numbers = [row.id for row in report.objects]
        assert len(set(numbers)) == len(numbers)
        assert {row.component for row in report.objects} == {0, 1}
        (named,) = (row for row in report.objects if row.name)
        assert (named.id, named.component) == (cupboard.id, 0), "where more captures show it"
        (other,) = (row for row in report.objects if row.split_from == cupboard.id)
        assert (other.component, other.id in before) == (1, False)
        assert m.history(other.id).objects[0].seen == 1
        assert [hit.object for hit in m.find("cupboard").hits] == [cupboard.id]
        m.store.revisions.save(placed)
        again = m.objects().objects
        assert {row.id for row in again} == before
        assert all(row.split_from is None for row in again)


def counted(patched: pytest.MonkeyPatch) -> list[str]:
    """What captures are opened from here on."""
    opened: list[str] = []
    gaussians = Scenes.gaussians

    def reading(self: Scenes, ref: str, *rest: object) -> object:
        opened.append(ref)
        return gaussians(self, ref, *rest)

    patched.setattr(Scenes, "gaussians", reading)
    return opened


def test_objects_are_answered_from_the_catalog(site: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    before = site.objects()
    opened = counted(monkeypatch)
    monkeypatch.setattr(Graphs, "load", lambda *_: pytest.fail("a graph was read"))
    assert site.objects() == before
    assert opened == []
    assert {row.id for row in before.objects} == {f"o{number}" for number in range(1, 4)}
    with gsmap.map.Map(Store.open(site.store.home, "r")) as reading:
        assert reading.objects() == before


def test_a_capture_that_comes_asks_only_what_was_not_asked(site: Map) -> None:
    """The objects of two captures are kept; then the third gets its place.

    June brings a stool, which may has to be asked for; the cameras of july cannot see what it does not show.
    """
    placed = site.store.revisions.get()
    assert placed is not None
    ids = {name: site.store.scenes.get(name).id for name in FRAMES}
    before = {row.id: row.position for row in site.objects().objects}
    for last, asked in (("july", []), ("june", [ids["may"], ids["june"]])):
        site.store.revisions.save(PoseGraph({s: pose for s, pose in placed.poses.items() if s != ids[last]}))
        two = site.objects()
        with pytest.MonkeyPatch.context() as patched:
            opened = counted(patched)
            site.store.revisions.save(placed)
            whole = site.objects()
        assert opened == asked, last
        assert {row.id for row in two.objects} <= {row.id for row in whole.objects} == set(before)
    forget(site)
    scratch = site.objects()
    assert [(r.id, r.seen, r.looks, r.there) for r in scratch.objects] == [
        (r.id, r.seen, r.looks, r.there) for r in whole.objects
    ]


def forget(m: Map) -> None:
    """What was computed, not the numbers."""
    with m.store.catalog.write() as connection:
        connection.execute(delete(schema.results).where(schema.results.c.kind == "objects"))


def test_a_number_stays_when_captures_are_described_otherwise(site: Map) -> None:
    before = {row.id: row.position for row in site.objects().objects}
    forget(site)
    may = site.store.scenes.get("may").id
    graph = site.store.graphs.load(may)
    assert graph is not None
    assert graph.segments is not None
    order = np.arange(len(graph.segments))[::-1]
    other = reordered(graph.segments, order)
    site.store.graphs.save(replace(graph, segments=other), RecipeKey("describe", "other", {"it": 1}).of(may))
    try:
        after = {row.id: row.position for row in site.objects().objects}
    finally:
        site.store.graphs.forget([RecipeKey("describe", "other", {"it": 1}).of(may)])
    assert after.keys() == before.keys()
    for name, position in before.items():
        np.testing.assert_allclose(after[name], position, atol=0.1)


def reordered(things: Segments, order: np.ndarray) -> Segments:
    """The same with other numbers, each a few centimetres larger."""
    place = np.append(np.argsort(order), -1)
    starts = np.concatenate([[0], np.cumsum(things.sample_counts)])
    rows = np.concatenate([np.arange(starts[i], starts[i + 1]) for i in order])
    return Segments(
        place[things.members],
        things.positions[order],
        things.extents[order] + np.array([[-0.03], [0.03]]),
        things.colours[order],
        things.samples[rows],
        things.sample_colours[rows],
        things.sample_counts[order],
        things.unit_m,
    )


def test_people_name_things_and_find_them_by_name(site: Map) -> None:
    (cupboard,), (table,) = site.history(at(CUPBOARD)).objects, site.history(at(TABLE)).objects
    row = site.edit_object(cupboard.id, name="grandmother's cupboard", label="cupboard", note="oak", author="ann")
    assert (row.id, row.name, row.label, row.note) == (cupboard.id, "grandmother's cupboard", "cupboard", "oak")
    assert [one.id for one in site.history("Grandmother's Cupboard").objects] == [cupboard.id]
    for words in ("grandmother's cupboard", "Cupboard", "grandmother's"):
        found = site.find(words)
        assert found.by == "name"
        assert [hit.object for hit in found.hits] == [cupboard.id], words
        assert found.hits[0].name == "grandmother's cupboard"
    with raises(ConfigError, code="object_not_found"):
        site.find("piano")
    assert site.graph().nodes[cupboard.id]["label"] == "cupboard"
    with raises(InputError, code="name_taken"):
        site.edit_object(table.id, name="GRANDMOTHER'S cupboard")
    for bad in ("o3", "1.5,2,3", "abcdef01", " "):
        with pytest.raises(InputError):
            site.edit_object(table.id, name=bad)
    with pytest.raises(NotFoundError):
        site.edit_object("o99", name="x")
    site.edit_object(cupboard.id, name="wardrobe")
    assert [(one.fact, one.value, one.author) for one in site.history(cupboard.id).words] == [
        ("name", "grandmother's cupboard", "ann"),
        ("label", "cupboard", "ann"),
        ("note", "oak", "ann"),
        ("name", "wardrobe", ""),
    ]
    site.edit_object("wardrobe", name="none", label="none")
    assert site.history(cupboard.id).objects[0].name is None
    assert site.history(cupboard.id).objects[0].note == "oak"


def test_the_page_shows_a_label_that_was_written_while_objects_were_read(
    site: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    page, number = MapPageSource(site.store, site.settings), int(site.objects().objects[0].id[1:])
    before, read = page.state(), compute_objects

    def write_after_reading(*args: object) -> object:
        found = read(*args)
        monkeypatch.setattr("gsmap.map.page.source.compute_objects", read)
        site.store.objects.edit(number, label="meanwhile")
        return found

    monkeypatch.setattr("gsmap.map.page.source.compute_objects", write_after_reading)
    try:
        page.graph()
        assert {row["id"]: row["label"] for row in page.graph()["objects"]}[f"o{number}"] == "meanwhile"
        assert page.state() != before
    finally:
        site.store.objects.edit(number, label="")


def test_two_that_a_person_says_are_one_are_told_as_one_until_that_is_taken_back(site: Map) -> None:
    (table,), (stool,) = site.history(at(TABLE)).objects, site.history(at(STOOL)).objects
    (cupboard,) = site.history(at(CUPBOARD)).objects
    with raises(InputError, code="objects_differ"):
        site.edit_object(stool.id, same_as=cupboard.id)
    with raises(InputError, code="already_same"):
        site.edit_object(stool.id, same_as=stool.id)
    row = site.edit_object(stool.id, same_as=table.id)
    assert row.id == table.id
    np.testing.assert_allclose(row.position, stool.position)
    assert row.seen == 2
    report = site.history(stool.id)
    assert [one.id for one in report.objects] == [table.id]
    assert [one.state for one in report.sightings][:2] == ["seen", "seen"]
    assert len(site.objects().objects) == 2
    assert [one.id for one in site.history(at(STOOL)).objects] == [table.id]
    row = site.edit_object(stool.id, same_as="none")
    assert row.id == stool.id
    assert {one.id for one in site.objects().objects} >= {stool.id, table.id}


def test_a_name_of_what_is_found_no_more_is_told_of(site: Map) -> None:
    (stool,) = site.history(at(STOOL)).objects
    site.edit_object(stool.id, name="milking stool")
    june = site.store.scenes.get("june").id
    graph = site.store.graphs.load(june)
    assert graph is not None
    assert graph.segments is not None
    key = RecipeKey("describe", "blind", {"it": 1}).of(june)
    site.store.graphs.save(replace(graph, segments=None), key)
    try:
        report = site.objects()
    finally:
        site.store.graphs.forget([key])
    assert any(stool.id in note and "milking stool" in note for note in report.notes)
    assert [one.id for one in site.history("milking stool").objects] == [stool.id]
    site.edit_object(stool.id, name="none")


# --- what persists ---------------------------------------------------------------------------------------------------


def num_near(means: np.ndarray, low: list[float], high: list[float]) -> int:
    return int(((means > np.array(low) - 0.05) & (means < np.array(high) + 0.05)).all(1).sum())


PLACES = {
    "cupboard": ([0.1, 0.5, 0.1], [0.5, 1.5, 1.8]),
    "table": ([2.0, 0.1, 0.2], [3.2, 0.7, 0.75]),
    "stool": ([2.3, 2.1, 0.2], [2.7, 2.5, 0.45]),
}


def exported(m: Map, out: Path, **options: object) -> dict[str, int]:
    """How many Gaussians an export has in each of the places."""
    m.export(out, format="ply", merge="union", tile_size_m=0, **options)
    means = formats.read(out / "component_0" / "map.ply").means
    return {name: num_near(means, *box) for name, box in PLACES.items()}


def test_static_leaves_out_what_came_and_went_and_keeps_the_rest(site: Map, tmp_path: Path) -> None:
    whole, static = exported(site, tmp_path / "all"), exported(site, tmp_path / "static", static=True)
    assert static["cupboard"] > 0.9 * whole["cupboard"] > 0
    assert whole["table"] > 200
    assert static["table"] < 0.02 * whole["table"]
    assert static["stool"] < 0.02 * whole["stool"]
    report = site.export(tmp_path / "static", format="ply", merge="union", tile_size_m=0, static=True)
    assert report.reused == 1, "nothing changed since"
    assert any("2 of 3 objects are left out" in note for note in report.notes)
    assert site.export(tmp_path / "static", format="ply", merge="union", tile_size_m=0).recomputed == 1, (
        "another content"
    )


def test_a_static_export_is_out_of_date_where_the_objects_are(site: Map, tmp_path: Path) -> None:
    def dirty() -> list[int]:
        return [row.count for row in site.status().todo if row.what == "dirty_tiles" and str(tmp_path) in row.verb]

    exported(site, tmp_path, static=True)
    assert dirty() == []
    placed = site.store.revisions.get()
    assert placed is not None
    may = placed.poses[site.store.scenes.get("may").id]
    moved = replace(may, S_map_scene=Sim3(np.eye(3), np.array([0.5, 0, 0])) @ may.S_map_scene)
    site.store.revisions.save(PoseGraph({**placed.poses, may.scene: moved}))
    try:
        assert dirty() == [1]
    finally:
        site.store.revisions.save(placed)


@pytest.mark.parametrize(
    ("states", "shift", "passed"),
    [
        ("seen", 0.0, False),
        ("seen unseen unseen", 0.0, False),
        ("seen unseen seen", 0.0, False),
        ("seen absent", 0.0, True),
        ("absent unseen seen", 0.0, True),
        ("seen seen", 0.2, False),
        ("seen seen", 3.0, True),
    ],
)
def test_what_persists_is_told_by_the_looks_that_there_were(states: str, shift: float, passed: bool) -> None:
    """What nobody looked at again is kept, and so is what another capture shows a part of."""
    box = np.array([[0.0, 0, 0], [1, 0.5, 0.8]])
    sightings = tuple(
        ObjectObservation(str(i), state, i, box + np.array([shift * i, 0, 0]))
        if state == "seen"
        else ObjectObservation(str(i), state)
        for i, state in enumerate(states.split())
    )
    assert is_dynamic(MapObject("o1", 0, box, box.mean(0), np.zeros(3, np.float32), sightings)) is passed


def test_a_small_map_is_without_what_came_and_went(site: Map, tmp_path: Path) -> None:
    site.export_small(tmp_path / "small", 4_000_000, static=True)
    small = SmallLocalizer(tmp_path / "small", site.settings)
    frame = {s: FRAMES[one.name].inverse() for s, one in small.small.items()}
    for scene, held in small.placed.items():
        for points in (held.gaussians.means, held.features.points):
            at = frame[scene].apply(points)
            assert num_near(at, *PLACES["table"]) <= 2
            assert num_near(at, *PLACES["stool"]) <= 2


def test_comparisons_that_hold_no_longer_leave_nothing_out(site: Map, tmp_path: Path) -> None:
    with gsmap.map.open(site.clone(tmp_path / "clone.gsmap").path) as m:
        known = load_objects(m.store, m.settings)

        def left_out() -> bool:
            standing = standing_comparisons(m.store, m.settings)
            return any(one.changes for one in find_dynamic_content(m.store, known, standing).values())

        assert left_out()
        for scene in m.scenes()[1:]:  # without dates no two visits are compared
            m.edit(scene.name, captured_at="none")
        assert not left_out()


def test_a_thinned_capture_still_tells_what_stood_there(site: Map, tmp_path: Path) -> None:
    """May is kept compact: its table, and that it had no stool, are known still."""
    with gsmap.map.open(site.clone(tmp_path / "clone.gsmap").path) as m:
        m.with_settings({"thin.min_seen_again": 0.2, "thin.min_fidelity_db": 0.0})
        before = m.history(at(TABLE)), m.history(at(STOOL))
        report = m.thin(keep_days=1, now="2026-07-01T00:00:00+00:00")
        assert [row.scene_name for row in report.scenes if row.thinned] == ["may"]
        after = m.history(at(TABLE)), m.history(at(STOOL))
        for one, other in zip(before, after, strict=True):
            assert [row.id for row in other.objects] == [row.id for row in one.objects]
            assert [row.state for row in other.sightings] == [row.state for row in one.sightings]
        assert any("may is thinned" in note for note in after[0].notes)
        assert m.find(at=CUPBOARD).described == 2, "graphs of whole captures answer"


def test_a_thing_that_moved_is_one_object_and_out_of_small_maps_after_thinning(site: Map, tmp_path: Path) -> None:
    """The table of may is the stool of june: rows of the change count may as it was ingested."""
    with gsmap.map.open(site.clone(tmp_path / "clone.gsmap").path) as m:
        m.with_settings({"thin.min_seen_again": 0.2, "thin.min_fidelity_db": 0.0})
        number = save_moved(m, "again")
        if m.store.changes.get(number).status == "rejected":
            m.store.changes.review(number, "withdraw")
        before = m.history(at(TABLE)), m.history(at(STOOL))
        assert before[0].objects[0].id == before[1].objects[0].id
        (thinned,) = (row for row in m.thin(keep_days=1, now="2026-07-01T00:00:00+00:00").scenes if row.thinned)
        after = m.history(at(TABLE)), m.history(at(STOOL))
        for one, other in zip(before, after, strict=True):
            assert [replace(row, colour=None) for row in other.objects] == [
                replace(row, colour=None) for row in one.objects
            ]
            assert [row.state for row in other.sightings] == [row.state for row in one.sightings]
        m.export_small(tmp_path / "small", 4_000_000)
        held = SmallLocalizer(tmp_path / "small", m.settings).placed[thinned.scene]
        means = FRAMES["may"].inverse().apply(held.gaussians.means)
        assert num_near(means, *PLACES["table"]) <= 2
        assert num_near(means, *PLACES["cupboard"]) > 100


def test_a_thinning_that_ends_in_its_middle_changes_nothing(
    site: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with gsmap.map.open(site.clone(tmp_path / "clone.gsmap").path) as m:
        m.with_settings({"thin.min_seen_again": 0.2, "thin.min_fidelity_db": 0.0})
        before = m.objects().objects
        with monkeypatch.context() as patched:
            patched.setattr(Graphs, "save", lambda *_: (_ for _ in ()).throw(OSError("the disk failed")))
            with raises(StoreError, code="system_refused"):
                m.thin(keep_days=1, now="2026-07-01T00:00:00+00:00")
        assert all(scene.thinning is None for scene in m.scenes())
        assert m.objects().objects == before
        assert [row.thinned for row in m.thin(keep_days=1, now="2026-07-01T00:00:00+00:00").scenes] == [True]
        assert [(row.id, row.seen, row.looks) for row in m.objects().objects] == [
            (row.id, row.seen, row.looks) for row in before
        ]


def test_captures_without_things_are_named(site: Map) -> None:
    may = site.store.scenes.get("may").id
    site.store.graphs.forget([g.key for g in site.store.graphs.list() if g.scene == may])
    report, history = site.objects(), site.history(at(CUPBOARD))
    assert "may" in report.notes[0]
    assert (site.objects(), site.history(at(CUPBOARD))) == (report, history), "kept, it is the same"
    assert len(report.objects) == 2


@pytest.mark.parametrize("error", [DiskFullError("full"), ReadOnlyError("read-only")])
def test_objects_are_reported_where_they_cannot_be_stored(error: Exception) -> None:
    """So a full disk is no reason for `edit` to fail after what was said is stored."""
    box = np.array([[0.0, 0, 0], [1, 1, 1]])
    things = [MapObject(f"{k:08x}", 0, box, box.mean(0), np.zeros(3, np.float32), ()) for k in range(2)]
    key = RecipeKey("objects", "test", {}, {}, "")
    part = ComponentObjects(0, ObjectSet("", "", 1.0, {}, {}, tuple(things)), ({}, {}), key)
    store = Mock()
    store.objects.save.side_effect = error
    store.objects.match_numbers.return_value = [7, None]
    assert [one.id for one in _numbered(store, [part])] == ["o7", "00000001"]
    store.objects.save.assert_called_once()
