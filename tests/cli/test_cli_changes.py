"""Changes and days of the past from the command line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from cli_rooms import save_changes

Run = Callable[..., Any]


def test_changes_are_told_with_what_is_not_known(site: Path, cli: Run) -> None:
    save_changes(site)
    shown = cli("changes", site)
    assert shown.code == 0, shown.stderr
    assert "left:right" in shown.stdout
    assert "odd:one has no date: which one is newer is not known" in shown.stderr
    assert "left:right: it was dark" in shown.stderr
    assert "1 change in 1 pair" in shown.stderr
    data = cli("changes", site, "left:right", "--json").json
    (change,) = data["changes"]
    assert (change["id"], change["kind"], change["status"], change["confidence"]) == ("c1", "moved", "open", 0.875)
    assert np.shape(change["box_m"]) == (2, 3)
    assert np.shape(change["S_after_before"]) == (4, 4)
    assert (change["older_name"], change["newer_name"]) == ("left", "right")
    assert data["pairs"][0]["seen_share"] == 0.75
    assert cli("changes", site, "--min-confidence", 0.9, "--json").json["changes"] == []
    assert cli("changes", site, "--since", "2026-05-31T00:00:01", "--json").json["pairs"] == []
    for wrong in (("--since", "soon"), ("--min-confidence", 2), ("--since", "2026-01-01", "--as-of", "2025-01-01")):
        assert cli("changes", site, *wrong).code == 2
    lost = cli("changes", site, "left:odd:one")
    assert lost.code == 1
    assert "odd:one has no date" in lost.stderr


def test_people_look_at_changes(site: Path, cli: Run) -> None:
    save_changes(site)
    assert "changes" in {row["what"] for row in cli("status", site, "--json").json["todo"]}
    assert cli("confirm", site, "c1", "--note", "I moved it", "--json").json["status"] == "confirmed"
    assert "changes" not in {row["what"] for row in cli("status", site, "--json").json["todo"]}
    shown = " ".join(cli("show", site, "c1").stdout.split())
    for text in ("moved", "confirm", "I moved it", "it was dark"):
        assert text in shown
    assert cli("reject", site, "c1", "--withdraw", "--json").json["status"] == "open"
    for verb in ("confirm", "reject", "show"):
        lost = cli(verb, site, "c7")
        assert (lost.code, lost.stdout) == (1, "")
        assert "no change c7" in lost.stderr
    # A scene of such a name comes first.
    cli("edit", site, "left", "--name", "c1")
    assert cli("show", site, "c1", "--json").json["name"] == "c1"


def test_the_place_on_a_day(site: Path, cli: Run, tmp_path: Path) -> None:
    cli("edit", site, "left", "--captured-at", "2026-05-30")
    cli("edit", site, "right", "--captured-at", "2026-05-31")
    listed = cli("list", site, "scenes", "--as-of", "2026-05-30", "--json")
    assert [row["name"] for row in listed.json["scenes"]] == ["left"]
    assert "odd:one has no date, so whether there by 2026-05-30 is not known: left out" in listed.stderr
    assert len(cli("list", site, "edges", "--as-of", "2026-05-31", "--json").json["edges"]) == 1
    assert cli("list", site, "tiles", "--as-of", "2026-05-31").code == 2
    out = ("export", site, tmp_path / "out", "--tile-size", 0, "--merge", "voxel")
    then = cli(*out, "--as-of", "2026-05-30", "--json")
    assert {scene["scene_name"] for tile in then.json["tiles"] for scene in tile["scenes"]} == {"left"}
    assert then.json["notes"]
    assert "odd:one has no date" in then.stderr
    assert cli(*out, "--as-of", "2020-01-01").code == 1
    assert cli(*out[:-1], "distance", "--prefer", "newest").code == 2
    assert cli(*out[:-2], "--prefer", "oldest").code == 2
