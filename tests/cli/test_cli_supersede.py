"""A capture that was trained again takes the place of the one in the map: what is carried, checked, refused."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_rooms import save_changes, write_capture

import gsmap.map
from gsmap.types import Sim3

Run = Callable[..., Any]
LEFT = (7, 0.0, 4.2)


@pytest.fixture(autouse=True)
def nothing_is_searched(monkeypatch: pytest.MonkeyPatch) -> None:
    def search(*_: object) -> None:
        raise AssertionError("a pose was searched for")

    monkeypatch.setenv("GSMAP_WORKERS", "1")
    monkeypatch.setattr("gsmap.register.register_pair", search)


def again(folder: Path, S: Sim3 | None = None) -> Path:
    write_capture(folder, "retrained", S or Sim3.identity(), *LEFT, seed=42)
    return folder / "retrained.ply"


def scenes(cli: Run, site: Path) -> dict[str, Any]:
    return {row["name"]: row for row in cli("list", site, "scenes", "--json").json["scenes"]}


def rows(site: Path) -> dict[str, list[Any]]:
    connection = sqlite3.connect(site / "map.sqlite")
    names = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
    found = {name: connection.execute(f"SELECT * FROM {name}").fetchall() for name in names if name != "leases"}
    connection.close()
    return found


def test_it_takes_the_place_with_all_that_is_known(site: Path, cli: Run, tmp_path: Path) -> None:
    save_changes(site)
    cli("edit", site, "left", "--note", "wet floor", "--tag", "hall")
    cli("prior", site, "left", "--anchor")
    cli("confirm", site, "left:right", "--note", "seen")
    cli("confirm", site, "c1", "--note", "I moved it")
    before = scenes(cli, site)
    done = cli("ingest", site, again(tmp_path), "--supersedes", "left", "--json")
    assert done.code == 0, done.stderr
    (row,) = done.json["ingested"]
    assert (row["scene_name"], row["new"], row["captured_at"][:10]) == ("left", True, "2026-05-30")
    assert "1 of 1 edges hold: gsmap optimize" in done.stderr
    after = scenes(cli, site)
    assert after.keys() == before.keys()
    left = after["left"]
    assert left["id"] == row["scene"] != before["left"]["id"]
    assert (left["tags"], left["note"], left["status"]) == (["hall"], "wet floor", before["left"]["status"])
    assert left["S_map_scene"] == before["left"]["S_map_scene"]
    assert (left["scale_policy"], left["component"]) == ("known", before["left"]["component"])
    shown = cli("show", site, "left", "--json").json
    assert shown["prior"] is not None
    edges = {edge["scene_name"]: edge["status"] for edge in shown["edges"]}
    assert edges == {"right": "accepted", "odd:one": "no_match"}
    assert "wet floor" in {fact["value"] for fact in shown["history"]}
    edge = cli("show", site, "left:right", "--json").json
    assert (edge["review"], edge["proposer"][:6]) == ("confirm", "graph:")
    assert [event["reason"] for event in edge["history"] if event["what"] == "confirm"] == ["seen"]
    # Nothing is left to be searched; the poses are solved with the new edges.
    assert not {"unregistered", "undescribed", "stale_edges"} & {
        todo["what"] for todo in cli("status", site, "--json").json["todo"]
    }
    updated = cli("update", site)
    assert updated.code == 0, updated.stderr
    pose = np.array(scenes(cli, site)["left"]["S_map_scene"]) @ np.linalg.inv(before["left"]["S_map_scene"])
    assert np.abs(pose - np.eye(4)).max() < 0.02
    # The change keeps its number, and the word on it; its pair is to be compared again.
    detail = cli("show", site, "c1", "--json").json
    assert (detail["status"], detail["older"]) == ("confirmed", left["id"])
    with gsmap.map.open(site) as m:
        assert m.check().ok
        assert not m.store.changes.current()[0].whole
        assert m.prune().num_bytes > 0
        assert m.check().ok


def test_another_frame_is_refused_and_changes_nothing(site: Path, cli: Run, tmp_path: Path) -> None:
    before = rows(site)
    shifted = Sim3(np.eye(3), np.array([0.2, 0, 0]))
    for S, says in (
        (shifted, "off where scene left lies"),
        (Sim3(np.eye(3), np.array([2.0, 0, 0])), "scene left lies"),
    ):
        refused = cli("ingest", site, again(tmp_path, S), "--supersedes", "left")
        assert (refused.code, refused.stdout) == (1, "")
        assert says in refused.stderr
        assert "ingest it without --supersedes" in refused.stderr
    assert rows(site) == before


def test_one_new_capture_at_a_time(site: Path, captures: Path, cli: Run, tmp_path: Path) -> None:
    several = cli("ingest", site, captures, "--supersedes", "left")
    assert several.code == 2
    assert "--supersedes needs one capture, but 3 captures were found" in several.stderr
    same = cli("ingest", site, captures / "left.ply", "--supersedes", "left", "--scale", "known")
    assert same.code == 1
    assert "is in the map already" in same.stderr
    assert cli("ingest", site, again(tmp_path), "--supersedes", "nobody").code == 1
    assert len(scenes(cli, site)) == 3


def test_the_same_file_undoes_it_and_what_was_withdrawn_stays_so(site: Path, cli: Run, tmp_path: Path) -> None:
    cli("prior", site, "left", "--anchor")
    cli("reject", site, "left:right")
    first = scenes(cli, site)["left"]["id"]
    write_capture(tmp_path, "left", Sim3.identity(), *LEFT, seed=0)
    with gsmap.map.open(site) as m:
        (row,) = m.ingest(again(tmp_path), supersedes="left")
        assert len(row.notes) == 1, "a rejected pair is no edge that could hold"
        m.confirm("left:right", withdraw=True)
        m.remove_prior("left")
        m.ingest(tmp_path / "left.ply", supersedes="left")
        assert m["left"].id == first
        assert {edge.review for edge in m.edge_rows()} == {None}
        assert m.store.priors.list() == []
        facts = m.store.scenes.facts(first)
        assert len({(one.kind, one.value, one.created_at) for one in facts}) == len(facts)
