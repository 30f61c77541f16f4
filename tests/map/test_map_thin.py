"""Thinning through the door: which captures may go compact, and what a dry run changes."""

import sys
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap.errors import ConfigError, StoreError
from gsmap.map import Map
from gsmap.map.thinning.thin import THINGS
from gsmap.methods import RecipeKey
from gsmap.types import PoseGraph, SceneGraph, ScenePose, Sim3

sys.path.append(str(Path(__file__).resolve().parents[1] / "merge"))

from synthetic_walls import cameras_facing, wall

NOW = "2030-01-01T00:00:00+00:00"


def walls(path: Path, starts: list[float], unit: float = 1.0) -> Map:
    """A map of walls a year apart, each beginning somewhat further on than the one before; in a unit of metres."""
    m = gsmap.map.create(path)
    for i, start in enumerate(starts):
        cameras = cameras_facing(np.linspace(start + 0.4, start + 2.6, 9), width=160, height=120)
        m.ingest(wall(i, start, start + 3), cameras=cameras, name=f"w{i}", captured_at=f"{2020 + i}-06-01")
    S_map_scene = Sim3(np.eye(3), np.zeros(3), 1 / unit)
    poses = {scene.id: ScenePose(scene.id, S_map_scene, 0, "placed") for scene in m.scenes()}
    m.store.revisions.save(PoseGraph(poses, {}), RecipeKey("optimize", "test", {}, {}, ""))
    return m


def test_old_captures_that_newer_ones_saw_are_thinned_and_a_dry_run_changes_nothing(tmp_path):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0, 0.0]) as m:
        dry = m.thin(keep_days=3000, dry_run=True, now=NOW)
        assert [row.scene_name for row in dry.scenes] == ["w0", "w1"][: len(dry.scenes)]
        assert all(scene.thinning is None for scene in m.scenes())
        report = m.thin(keep_days=2800, now=NOW)
        assert {row.scene_name: row.thinned for row in report.scenes} == {"w0": True, "w1": True}
        assert report.num_bytes_freed > 0
        assert [scene.thinning is None for scene in m.scenes()] == [False, False, True]
        for scene in m.scenes():
            m.store.graphs.save(SceneGraph(scene.id, {}, None, 1.0), THINGS.of(scene.id))
        assert ["gsmap update" in str(m.show_scene(scene.id).notes) for scene in m.scenes()] == [False, False, True]
        assert m.check().ok
        assert not m.thin(keep_days=2800, now=NOW).scenes


def test_no_capture_stands_for_another_that_goes_itself(tmp_path):
    """Each wall is nearly what the next one saw, but the last saw little of the first."""
    starts = [0.0, 0.18, 0.36, 0.54, 0.72, 0.9]
    with walls(tmp_path / "m.gsmap", starts) as m:
        m.with_settings({"thin.min_seen_again": 0.85})
        m.thin(keep_days=0, now=NOW)
        whole = [float(s.name[1:]) for s in m.scenes() if s.thinning is None]
        assert 5 in whole
        for scene in m.scenes():
            nearest = min(abs(starts[int(k)] - starts[int(scene.name[1:])]) for k in whole if k >= int(scene.name[1:]))
            assert nearest <= 0.6, f"nothing stands for {scene.name}"
        assert len(whole) > 1


@pytest.mark.parametrize("doubtful", [0, 2])
def test_a_pose_that_is_not_confirmed_thins_nothing(tmp_path, doubtful):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0, 0.0]) as m:
        graph = m.store.revisions.get()
        poses = dict(graph.poses)
        scene = m.scenes()[doubtful].id
        poses[scene] = replace(poses[scene], status="tentative")
        m.store.revisions.save(replace(graph, poses=poses))
        report = m.thin(keep_days=0, now=NOW)
        codes = {row.scene_name: row.reason_code for row in report.scenes}
        assert codes[f"w{doubtful}"] == "pose_unconfirmed"
        assert [row.scene_name for row in report.scenes if row.thinned] == ["w1" if doubtful == 0 else "w0"]


def test_no_capture_stands_for_one_of_another_component(tmp_path):
    """Their frames have nothing to do with each other, though their coordinates are the same."""
    with walls(tmp_path / "m.gsmap", [0.0, 0.0]) as m:
        (before,) = m.thin(keep_days=3200, dry_run=True, now=NOW).scenes
        assert before.seen_again > 0.9
        poses = {s.id: ScenePose(s.id, Sim3.identity(), k, "placed") for k, s in enumerate(m.scenes())}
        m.store.revisions.save(PoseGraph(poses, {}), RecipeKey("optimize", "apart", {}, {}, ""))
        (after,) = m.thin(keep_days=3200, now=NOW).scenes
        assert (after.seen_again, after.thinned) == (0.0, False)
        assert all(scene.thinning is None for scene in m.scenes())


@pytest.mark.guards("data")
@pytest.mark.parametrize("change", ["removed", "thinned", "dated", "unplaced"])
def test_nothing_is_thinned_for_a_capture_that_changes_meanwhile(tmp_path, change):
    """The newest stands for the others; it changes after w0 is thinned."""

    def disturb(stage, fraction, text):
        if text != "w1" or fraction < 0.5:
            return
        with gsmap.map.open(tmp_path / "m.gsmap") as other:
            if change == "removed":
                other.remove("w2")
            elif change == "thinned":
                other.store.scenes.thin("w2", np.ones(other["w2"].num_gaussians, bool))
            elif change == "dated":
                other.edit("w2", captured_at="2019-06-01")
            else:
                other.store.revisions.save(PoseGraph({}, {}), RecipeKey("optimize", "none", {}, {}, ""))

    with walls(tmp_path / "m.gsmap", [0.0, 0.0, 0.0]) as m:
        m._progress = disturb
        with raises(StoreError, code="changed_meanwhile"):
            m.thin(keep_days=0, now=NOW)
        others = {scene.name: scene.thinning is not None for scene in m.scenes() if scene.name != "w2"}
        assert others == {"w0": True, "w1": False}


@pytest.mark.parametrize("unit", [0.1, 10.0])
def test_what_supersedes_a_capture_is_the_same_in_another_unit(tmp_path, unit):
    with walls(tmp_path / "one.gsmap", [0.0, 1.0]) as one, walls(tmp_path / "two.gsmap", [0.0, 1.0], unit) as two:
        two.edit("w0", metres_per_unit=1.0)
        (a,), (b,) = (m.thin(keep_days=3200, dry_run=True, now=NOW).scenes for m in (one, two))
        assert 0.3 < a.seen_again < 0.9
        assert b.seen_again == pytest.approx(a.seen_again, abs=0.005)


def test_a_budget_thins_no_more_than_it_takes(tmp_path):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0, 0.0]) as m:
        size = sum(m.store.scenes.num_bytes(scene.id) for scene in m.scenes())
        report = m.thin(budget_bytes=size - 1, now=NOW)
        assert [row.scene_name for row in report.scenes if row.thinned] == ["w0"]
        assert report.fits
        assert not m.thin(budget_bytes=1, now=NOW).fits


def test_what_makes_no_sense_is_refused(tmp_path):
    with walls(tmp_path / "m.gsmap", [0.0]) as m:
        for wrong in ({}, {"keep_days": -1}, {"keep_days": 1, "now": "yesterday"}, {"keep_days": 1e12}):
            with pytest.raises(ConfigError):
                m.thin(**wrong)


# --- clocks ----------------------------------------------------------------------------------------------------------


def set_clock(patch: pytest.MonkeyPatch, when: datetime) -> None:
    class Clock(datetime):
        @classmethod
        def now(cls, tz=None):
            return when

    patch.setattr("gsmap.map.thinning.thin.datetime", Clock)


def test_a_clock_that_is_ahead_makes_no_capture_older(tmp_path, monkeypatch):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0, 0.0]) as m:
        days = (datetime.now(UTC) - datetime(2021, 6, 1, tzinfo=UTC)).days
        asked = {"keep_days": days - 30, "dry_run": True}
        right = [row.scene_name for row in m.thin(**asked).scenes]
        set_clock(monkeypatch, datetime.now(UTC) + timedelta(days=3650))
        assert [row.scene_name for row in m.thin(**asked).scenes] == right == ["w0", "w1"]
        assert [row.scene_name for row in m.thin(**{**asked, "keep_days": days + 30}).scenes] == ["w0"]


def test_a_clock_that_contradicts_the_map_thins_nothing_until_the_day_is_said(tmp_path, monkeypatch):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0]) as m:
        today = datetime.now(UTC)
        set_clock(monkeypatch, today - timedelta(days=3650))
        for asked in ({"keep_days": 1.0}, {"budget_bytes": 1}):
            with raises(ConfigError, code="clock_contradicts_map"):
                m.thin(**asked)
        assert all(scene.thinning is None for scene in m.scenes())
        assert m.thin(keep_days=1.0, now=today.isoformat()).scenes[0].thinned


def test_a_capture_dated_in_the_future_supersedes_nothing_until_the_day_is_said(tmp_path):
    with walls(tmp_path / "m.gsmap", [0.0, 0.0]) as m:
        m.store.scenes.edit("w1", captured_at="2190-06-01T00:00:00+00:00")
        with raises(ConfigError, match="w1 is dated", code="clock_contradicts_map"):
            m.thin(keep_days=1.0)
        assert all(scene.thinning is None for scene in m.scenes())
