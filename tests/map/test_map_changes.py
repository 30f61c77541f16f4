"""Changes of a map: which captures are compared, when again, and what is told. What finds changes is stood in for."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

import gsmap.change
import gsmap.map
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.export import PlannedTile
from gsmap.geometry.boxes import moved_box
from gsmap.geometry.rotations import exp_so3
from gsmap.map import Map
from gsmap.map.changes.visits import Params, Visit, has_moved, pairs_of_visits
from gsmap.map.rejected_changes import places_near, rejected_places
from gsmap.map.stages.export import Request, plan
from gsmap.types import Cameras, Change, ChangeReport, Gaussians, PosedScene, PoseGraph, ScenePose, Sim3
from gsmap.types.metric_scale import MetricScale

DATES = {"may": "2026-05-31T15:00:00Z", "june": "2026-06-30", "july": "2026-07-31"}
CHAIR = np.array([[0.0, 0, 0], [0.5, 0.5, 1]])


@dataclass
class Seen:
    """What was compared, as ids, and where the place lies in the map."""

    pairs: list[tuple[str, str]] = field(default_factory=list)
    S_map_place: Sim3 = field(default_factory=Sim3.identity)
    beside: np.ndarray | None = None  # something else that went


@pytest.fixture
def seen(monkeypatch: pytest.MonkeyPatch) -> Seen:
    """Stands in for what finds changes: a chair moved by a metre, and less surely the wall was painted."""
    found = Seen()

    def compare(older: PosedScene, newer: PosedScene, params: object = None, progress: object = None) -> ChangeReport:
        assert older.cameras is not None
        assert older.captured_at < newer.captured_at
        found.pairs.append((older.scene_id, newer.scene_id))
        moved = Sim3(np.eye(3), np.array([1.0, 0, 0]))
        rows = np.arange(3, dtype=np.int32)
        box = moved_box(CHAIR, found.S_map_place)
        chair = Change("moved", box, CHAIR.astype(np.float32), rows, rows[:2], moved, "half", 0.9, {"through": 7.0})
        wall = Change("recoloured", CHAIR + 3, CHAIR.astype(np.float32) + 3, rows, rows, confidence=0.35)
        if found.beside is not None:
            went = Change("disappeared", found.beside, found.beside.astype(np.float32), rows, rows[:0], confidence=0.9)
            return ChangeReport((chair, went), 0.75, np.ones(3), ())
        return ChangeReport((chair, wall), 0.75, np.array([1.0, 1.1, 0.9]), ("it was dark",))

    monkeypatch.setattr(gsmap.change, "compare", compare)
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    return found


@pytest.fixture
def site(tmp_path: Path, seen: Seen) -> Iterator[Map]:
    """Three dated captures of one place, placed."""
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        for i, (name, date) in enumerate(DATES.items()):
            m.ingest(_cloud(i), cameras=_cameras(), name=name, captured_at=date, scale="known")
        place(m)
        yield m


def _cloud(seed: int, n: int = 60) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats, sizes = np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -3.0)
    return Gaussians(rng.uniform(-1, 1, (n, 3)), quats, sizes, np.zeros(n), rng.normal(size=(n, 1, 3)))


def _cameras() -> Cameras:
    pose = np.eye(4)
    pose[2, 3] = -4.0
    return Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))


def place(m: Map, every: Sim3 | None = None, **poses: Sim3) -> None:
    """A new revision: scenes by name at their poses, the others at the origin, all of it moved."""
    every = every or Sim3.identity()
    placed = {s.id: every @ poses.get(s.name, Sim3.identity()) for s in m.scenes()}
    m.store.revisions.save(PoseGraph({s: ScenePose(s, pose, 0, "placed") for s, pose in placed.items()}))


def at(x: float, turn_deg: float = 0.0) -> Sim3:
    return Sim3(exp_so3(np.array([0, 0, np.radians(turn_deg)])), np.array([x, 0, 0]))


def names(m: Map, seen: Seen) -> list[tuple[str, str]]:
    name_of = {scene.id: scene.name for scene in m.scenes()}
    done = [(name_of[a], name_of[b]) for a, b in seen.pairs]
    seen.pairs.clear()
    return done


def test_each_capture_is_compared_with_the_one_before_it_and_only_once(site: Map, seen: Seen) -> None:
    report = site.changes()
    assert names(site, seen) == [("may", "june"), ("june", "july")]
    assert [(pair.older_name, pair.newer_name) for pair in report.pairs] == [("june", "july"), ("may", "june")]
    assert [(row.id, row.kind, row.newer_name) for row in report.changes] == [
        ("c3", "moved", "july"),
        ("c4", "recoloured", "july"),
        ("c1", "moved", "june"),
        ("c2", "recoloured", "june"),
    ]
    (chair, *_) = report.changes
    assert (chair.before, chair.after, chair.symmetry, chair.status, chair.picture) == (3, 2, "half", "open", None)
    assert (chair.evidence, chair.confidence, chair.older_at[:10]) == ({"through": 7.0}, 0.9, "2026-06-30")
    assert (report.pairs[0].seen_share, report.pairs[0].notes, report.notes) == (0.75, ("it was dark",), ())
    assert site.changes().to_json() == report.to_json()
    assert seen.pairs == []
    # A new capture costs its own pair.
    site.ingest(_cloud(9), cameras=_cameras(), name="august", captured_at="2026-08-31", scale="known")
    place(site)
    site.changes()
    assert names(site, seen) == [("july", "august")]


def test_a_pair_that_is_named_is_compared_whatever_lies_between(site: Map, seen: Seen) -> None:
    report = site.changes("july:may")
    assert names(site, seen) == [("may", "july")]
    assert [pair.pair for pair in report.pairs] == ["may:july"]
    assert len(site.changes().pairs) == 2


def test_damaged_arrays_of_a_pair_that_is_named_are_made_again(site: Map, seen: Seen) -> None:
    site.changes()
    for path in site.store.home.glob("arrays/changes/*/arrays.zip"):
        path.write_bytes(b"")
    names(site, seen)
    site.changes()
    assert seen.pairs == []
    site.changes("may:june")
    site.changes("june:july")
    assert len(names(site, seen)) == 2
    assert site.check().ok


def test_only_of_the_dates_asked_for(site: Map, seen: Seen) -> None:
    def pairs(**options: object) -> list[str]:
        return [pair.pair for pair in site.changes(**options).pairs]

    assert pairs(since="2026-07-01") == ["june:july"]
    assert names(site, seen) == [("june", "july")]
    assert pairs(between=("2026-05-01", "2026-06-30")) == ["may:june"]
    assert pairs(as_of="2026-06-30") == ["may:june"]
    assert pairs(since="2026-08-01") == []
    assert pairs(since="2026-05-01", as_of="2026-06-29") == []
    for wrong in ({"since": "soon"}, {"since": "2026-01-01", "between": ("2026-01-01", "2026-02-01")}):
        with pytest.raises(ConfigError):
            pairs(**wrong)
    with raises(ConfigError, code="date_out_of_range"):
        pairs(between=("2026-07-01", "2026-06-01"))
    assert {row.kind for row in site.changes(min_confidence=0.5).changes} == {"moved"}


def test_nobody_guesses_which_capture_is_newer(site: Map, seen: Seen) -> None:
    site.edit("june", captured_at="none")
    report = site.changes()
    assert names(site, seen) == [("may", "july")]
    tells = "set it with gsmap edit MAP SCENE --captured-at DATE"
    assert report.notes == (f"june has no date: which one is newer is not known ({tells})",)
    with raises(InputError, code="order_unknown", match="june has no date"):
        site.changes("may:june")
    site.edit("june", captured_at=DATES["july"])
    with raises(InputError, code="order_unknown", match="same date"):
        site.changes("july:june")


def test_dates_that_are_corrected_turn_a_pair_round(site: Map, seen: Seen) -> None:
    site.changes("may:june")
    site.confirm("c1")
    site.edit("may", captured_at="2026-07-01")
    report = site.changes("may:june")
    assert names(site, seen) == [("may", "june"), ("june", "may")]
    assert [row.id for row in report.changes] == ["c3", "c4"]
    assert {row.status for row in report.changes} == {"open"}


def test_places_come_from_the_newest_poses(site: Map, seen: Seen) -> None:
    site.changes()
    names(site, seen)
    turn = Sim3(exp_so3(np.array([0, 0, np.pi / 2])), np.array([10.0, 0, 0]))
    place(site, turn)  # all of the map: nothing moved against another
    report = site.changes()
    assert seen.pairs == []
    box = report.changes[0].box_m
    np.testing.assert_allclose(box, [[9.5, 0, 0], [10, 0.5, 1]], atol=1e-9)
    np.testing.assert_allclose(report.changes[0].S_after_before.translation, [0, 1, 0], atol=1e-9)
    arrays = site.read_change(report.changes[0].id)
    np.testing.assert_allclose(arrays.voxels, turn.apply(CHAIR), atol=1e-6)
    np.testing.assert_array_equal(arrays.after, [0, 1])
    place(site, turn, july=at(0.01))
    site.changes()
    assert seen.pairs == []
    place(site, turn, july=at(0.03))
    seen.S_map_place = turn
    site.confirm("c3", "I moved it")
    again = site.changes()
    assert names(site, seen) == [("june", "july")]
    (chair,) = [row for row in again.changes if row.id == "c3"]  # the same change, with the word on it
    assert (chair.status, chair.kind) == ("confirmed", "moved")
    assert "c3 was confirmed before this comparison, and stays confirmed" in again.pairs[0].notes
    np.testing.assert_allclose(chair.box_m, box, atol=1e-9)


def test_other_settings_compare_again(site: Map, seen: Seen) -> None:
    site.changes()
    names(site, seen)
    site.with_settings({"change.min_confidence": 0.4})
    site.changes()
    assert len(names(site, seen)) == 2


def test_words_on_changes(site: Map, seen: Seen) -> None:
    site.changes()
    assert {row.what: row.count for row in site.status().todo}["changes"] == 2  # those that are sure
    site.with_settings({"change.min_confidence": 0.3})
    assert {row.what: row.count for row in site.status().todo}["changes"] == 4
    assert site.confirm("c1", "seen it").status == "confirmed"
    assert site.reject("c2").status == "rejected"
    assert {row.what: row.count for row in site.status().todo}["changes"] == 2
    detail = site.show_change("c1")
    assert [(event.what, event.reason) for event in detail.history] == [("confirm", "seen it")]
    assert (detail.num_voxels, detail.notes) == (2, ("it was dark",))
    assert site.confirm("c1", withdraw=True).status == "open"
    for wrong in ("c9", "chair"):
        with pytest.raises(NotFoundError):
            site.show_change(wrong)
    with raises(NotFoundError, code="change_not_found"):
        site.confirm("c9")


def places(m: Map, **options: object) -> dict[str, list[np.ndarray]]:
    """Where an export overrules nothing: boxes in the map's frame, in metres, by the name of the older scene."""
    planned = plan(m.store, Request(tile_size_m=0.0, **options), m.settings)
    assert set(planned.recipe.unchanged) == set(planned.unchanged)
    out: dict[str, list[np.ndarray]] = {}
    for near in planned.unchanged.values():
        for scene, found in near.items():
            boxes = [moved_box(place.box, place.S_frame_map.inverse()) for place in found]
            out[m.store.scenes.get(scene).name] = boxes
    return out


def test_an_export_overrules_nothing_where_every_change_was_rejected(site: Map, seen: Seen, tmp_path: Path) -> None:
    def made_again() -> int:
        return site.export(tmp_path / "out", format="ply", tile_size_m=0, steps=0).recomputed

    found = site.changes().changes
    chairs = [row for row in found if row.kind == "moved"]
    assert (made_again(), made_again(), len(chairs)) == (1, 0, 2)
    site.reject(chairs[0].id)
    assert places(site) == {}  # the chair moved between the other two visits
    assert made_again() == 0
    site.reject(chairs[1].id)
    assert set(places(site)) == {"may", "june"}
    np.testing.assert_allclose(places(site)["may"], [CHAIR], atol=1e-6)
    assert any(row.what == "dirty_tiles" for row in site.status().todo)
    assert (made_again(), made_again()) == (1, 0)
    place(site, at(0.0006))  # less than makes a tile again
    assert made_again() == 0
    place(site, Sim3(exp_so3(np.array([0, 0, np.pi / 2])), np.array([5.0, 0, 0]), 2.0))  # half metres, turned
    np.testing.assert_allclose(places(site)["may"], [[[2, 0, 0], [2.5, 0.5, 1]]], atol=1e-5)
    site.reject(chairs[0].id, withdraw=True)
    assert places(site) == {}


@pytest.mark.parametrize("turn_deg", [0, 30, 45])
def test_rejections_hold_however_the_map_lies(site: Map, seen: Seen, turn_deg: float) -> None:
    seen.beside = CHAIR + np.array([0.55, 0, 0])  # 5 cm beside the chair, and not rejected
    for row in site.changes().changes:
        if row.kind == "moved":
            site.reject(row.id)
    place(site, at(0.0, turn_deg))
    assert {name: len(boxes) for name, boxes in places(site).items()} == {"may": 1, "june": 1}
    place(site, june=at(0.03))  # farther than comparisons hold
    assert {name: len(boxes) for name, boxes in places(site).items()} == {"may": 1, "june": 1}
    site.edit("may", captured_at="2026-07-15")  # now the newer of the two
    assert set(places(site)) == {"june"}
    assert places(site, as_of="2026-06-30") == {}


def test_only_tiles_near_a_rejected_place_are_made_again(site: Map, seen: Seen) -> None:
    for row in site.changes().changes:
        site.reject(row.id)
    placed = site.store.revisions.get()
    assert placed is not None
    living = {scene.id: scene for scene in site.scenes()}
    found = rejected_places(site.store.changes.current(), living, placed.poses, {0: MetricScale()})
    poses = {scene: Sim3.identity() for scene in living}
    tiles = [PlannedTile(0, f"{x}", CHAIR + np.array([x, 0, 0]), poses, "") for x in (0.0, 8.0, 20.0)]
    assert [sum(map(len, places_near(found, tile, 10.0).values())) for tile in tiles] == [4, 4, 0]


def test_status_counts_the_open_changes_that_are_listed(site: Map, seen: Seen) -> None:
    site.changes()
    site.edit("june", captured_at="none")
    listed = [row for row in site.changes().changes if row.confidence >= site.settings.change.min_confidence]
    assert {row.what: row.count for row in site.status().todo}["changes"] == len(listed) == 1


def test_a_map_that_cannot_be_written_tells_what_it_knows(
    site: Map, seen: Seen, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.changes("may:june")
    site.close()
    names_before = list(seen.pairs)
    with Map(gsmap.map.map.Store.open(site.store.home, "r")) as m:
        report = m.changes()
        assert [pair.pair for pair in report.pairs] == ["may:june"]
        assert report.notes == ("1 pair not compared yet: run gsmap changes with write access to the map",)
    assert seen.pairs == names_before


def test_pictures_of_changes_go_with_a_scene_that_is_purged(site: Map, seen: Seen, tmp_path: Path) -> None:
    out = tmp_path / "pictures"
    report = site.changes(pictures=out)
    assert {Path(row.picture).name for row in report.changes} == {"c1.png", "c2.png", "c3.png", "c4.png"}
    assert all(Image.open(row.picture).size[0] > 300 for row in report.changes)
    assert site.changes(pictures=out).changes[0].picture == report.changes[0].picture
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("")
    with raises(ConfigError, code="folder_not_empty"):
        site.changes(pictures=tmp_path / "mine")
    with gsmap.map.create(tmp_path / "other.gsmap") as other:
        other.ingest(_cloud(0), cameras=_cameras(), name="a", captured_at="2026-01-01")
        place(other)
        with raises(ConfigError, code="foreign_export"):
            other.changes(pictures=out)
    gone = next(scene.id for scene in site.scenes() if scene.name == "may")
    receipt = site.purge("may")
    assert (receipt.num_tiles, receipt.exports, receipt.unreachable) == (2, (str(out),), ())
    assert sorted(path.name for path in out.iterdir()) == ["c3.png", "c4.png", "changes.json"]
    assert gone not in (out / "changes.json").read_text()


def test_without_poses_there_is_nothing_to_compare(tmp_path: Path, seen: Seen) -> None:
    with gsmap.map.create(tmp_path / "m.gsmap") as m:
        m.ingest(_cloud(0), cameras=_cameras(), name="a", captured_at="2026-01-01", scale="unknown")
        with raises(NotFoundError, code="no_poses"):
            m.changes()
        place(m)
        assert m.changes().pairs == ()
        m.ingest(_cloud(1), cameras=_cameras(), name="b", captured_at="2026-02-01", scale="unknown")
        assert m.changes().notes == ("b has no place in the map yet: run gsmap update",)
        with raises(NotFoundError, code="scene_unplaced"):
            m.changes("a:b")
        place(m)
        tells = "set it with gsmap edit MAP SCENE --metres-per-unit X"
        assert m.changes().notes == (f"component 0: its metric scale is unknown: {tells}",)


# -- which captures are compared


def visit(name: str, day: int, x: tuple[float, float] = (0, 4), component: int = 0, pose: Sim3 | None = None) -> Visit:
    bounds = np.array([[x[0], 0, 0], [x[1], 4, 2]])
    when = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(days=day)
    return Visit(name, when, component, pose or Sim3.identity(), bounds)


def test_a_capture_meets_the_visits_that_together_cover_it() -> None:
    hall, north, south = visit("hall", 0, (0, 8)), visit("north", 1, (0, 4)), visit("south", 2, (4, 8))
    found = pairs_of_visits([visit("all", 3, (0, 8)), south, hall, north], Params())
    assert set(found) == {("hall", "north"), ("hall", "south"), ("south", "all"), ("north", "all")}
    assert len(found) == 4  # the hall of day 0 was seen again since
    # What hardly reaches in, lies elsewhere, in another frame, or is of the same moment.
    others = [
        visit("near", 0, (3.7, 8)),
        visit("far", 0, (20, 24)),
        visit("other", 0, component=1),
        visit("same", 1),
    ]
    assert pairs_of_visits([*others, visit("new", 1)], Params()) == []
    met = pairs_of_visits([*others, visit("new", 1)], Params(min_new_fraction=0.01))
    assert met == [("near", "new"), ("near", "same")]
    assert pairs_of_visits([north, south, hall, visit("all", 3, (0, 8))], Params(max_earlier_visits=1))[-1] == (
        "south",
        "all",
    )
    with pytest.raises(ConfigError):
        Params(min_new_fraction=0)


def test_a_capture_lies_where_its_pose_says() -> None:
    turned = Sim3(exp_so3(np.array([0, 0, np.pi / 2])), np.array([4.0, 0, 0]), 1.0)
    old = visit("old", 0, (0, 4), pose=turned)  # over the same four metres again
    assert pairs_of_visits([old, visit("new", 1)], Params()) == [("old", "new")]
    assert pairs_of_visits([visit("old", 0, pose=at(40.0)), visit("new", 1)], Params()) == []


def test_how_far_a_pair_may_move_before_it_is_compared_again() -> None:
    a, b = visit("a", 0), visit("b", 1)
    for then, moved in (
        (Sim3.identity(), False),
        (at(0.019), False),
        (at(0.021), True),
        (at(0.0, 0.19), False),
        (at(0.0, 0.25), True),
    ):
        assert has_moved(a, b, then) is moved
    # Metres of the map, whatever the scenes' units are.
    big = Sim3(np.eye(3), np.zeros(3), 10.0)
    c, d = (visit(name, 0, (0, 0.4), pose=big) for name in "cd")
    assert has_moved(c, d, at(0.003))
    assert not has_moved(c, d, at(0.0019))
