"""Dates from the command line: given, found, corrected, taken back, and what they do to tiles."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]


@pytest.fixture
def left(captures: Path, tmp_path: Path) -> Path:
    """One capture in a folder of its own."""
    folder = tmp_path / "captures"
    folder.mkdir()
    for name in ("left.ply", "left.cameras.json"):
        shutil.copy2(captures / name, folder / name)
    return folder


def date(cli: Run, site: Path, scene: str = "left") -> str | None:
    rows = cli("list", site, "scenes", "--json").json["scenes"]
    return next(row["captured_at"] for row in rows if row["name"] == scene)


def test_a_capture_that_is_in_the_map_takes_a_date(site: Path, left: Path, cli: Run) -> None:
    again = cli("ingest", site, left, "--json").json["ingested"][0]
    assert (again["new"], again["dated"], again["captured_at"]) == (False, False, None)
    (left / "left.meta.json").write_text(json.dumps({"captured_at": "2026-05-30T09:00:00+02:00"}))
    found = cli("ingest", site, left)
    assert "now dated 2026-05-30T09:00:00+02:00" in " ".join(found.stdout.split())
    assert "by left.meta.json" in found.stderr
    assert "specified by left.meta.json" in " ".join(cli("show", site, "left").stdout.split())
    told = cli("ingest", site, left, "--captured-at", "2026-06-01", "--json")
    (row,) = told.json["ingested"]
    assert (row["new"], row["dated"], row["captured_at"]) == (False, True, "2026-06-01T00:00:00+00:00")
    assert "UTC was assumed" in told.stderr
    assert "specified by a person" in " ".join(cli("show", site, "left").stdout.split())
    kept = cli("ingest", site, left)
    assert "nothing changed" in " ".join(kept.stdout.split())
    assert "its date stays 2026-06-01T00:00:00+00:00" in kept.stderr
    assert date(cli, site) == "2026-06-01T00:00:00+00:00"
    assert "2026-06-01" in cli("list", site, "scenes").stdout


def test_update_takes_a_date_for_its_captures(site: Path, left: Path, cli: Run) -> None:
    done = cli("update", site, left, "--captured-at", "2026-06-01T10:00+02:00")
    assert done.code == 0, done.stderr
    assert "already in the map, now dated 2026-06-01T10:00:00+02:00" in done.stderr
    assert date(cli, site) == "2026-06-01T10:00:00+02:00"
    assert date(cli, site, "right") is None
    for wrong in ((left, "--captured-at", "soon"), ("--captured-at", "2026-06-01")):
        refused = cli("update", site, *wrong)
        assert refused.code == 2
        (line,) = refused.stderr.splitlines()
        assert "captured-at" in line
    assert cli("update", site.with_name("new.gsmap"), left, "--captured-at", "soon").code == 2
    assert not site.with_name("new.gsmap").exists()


def test_a_wrong_sidecar_changes_nothing(site: Path, left: Path, cli: Run) -> None:
    (left / "left.json").write_text('{"captured_at": "31.5.2026"}')
    refused = cli("ingest", site, left / "left.ply")
    assert refused.code == 1
    (line,) = (line for line in refused.stderr.splitlines() if line.startswith("gsmap:"))
    assert "left.json: captured_at must be ISO 8601" in line
    assert "Traceback" not in refused.stderr
    assert date(cli, site) is None


def test_a_date_can_be_taken_back(site: Path, left: Path, cli: Run) -> None:
    assert cli("edit", site, "left", "--captured-at", "2026-06-01", "--author", "ann").code == 0
    assert cli("edit", site, "left", "--captured-at", "none", "--json").json["captured_at"] is None
    (left / "left.json").write_text('{"captured_at": "2026-05-31T10:00:00Z"}')
    again = cli("ingest", site, left)
    assert "its date stays unknown" in again.stderr
    assert date(cli, site) is None
    history = cli("show", site, "left", "--json").json["history"]
    said = [(row["value"][:10], row["author"]) for row in history if row["fact"] == "captured_at"]
    assert said == [("2026-06-01", "ann"), ("", "")]


def test_a_date_that_is_found_makes_tiles_again_where_dates_decide(
    site: Path, left: Path, cli: Run, tmp_path: Path
) -> None:
    optimised = ("export", site, tmp_path / "tto", "--tile-size", 0, "--component", 0, "--steps", 0)
    voxels = ("export", site, tmp_path / "voxel", "--tile-size", 0, "--component", 0, "--merge", "voxel")
    first = cli(*optimised)
    assert first.code == 0, first.stderr
    assert "2 of 2 overlapping captures have no date, so their order is unknown" in first.stderr
    assert "no date" not in cli(*voxels).stderr
    assert "0 files written, 1 unchanged" in cli(*optimised).stderr
    shutil.move(left / "left.ply", left / "left_2026-05-31.ply")
    shutil.move(left / "left.cameras.json", left / "left_2026-05-31.cameras.json")
    assert cli("ingest", site, left, "--json").json["ingested"][0]["dated"]
    again = cli(*optimised)
    assert "1 file written, 0 unchanged" in again.stderr
    assert "1 of 2 overlapping captures have no date" in again.stderr
    assert "1 of 2 overlapping captures have no date" in (tmp_path / "tto" / "tiles.json").read_text()
    assert "0 files written, 1 unchanged" in cli(*voxels).stderr
    cli("edit", site, "right", "--captured-at", "2026-05-30")
    assert "no date" not in cli(*optimised).stderr
