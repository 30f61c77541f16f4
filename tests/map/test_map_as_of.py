"""The place on a day in the past, and whom to believe where captures disagree."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap.errors import ConfigError, NotFoundError
from gsmap.map import Map
from gsmap.types import Cameras, Gaussians, PoseGraph, ScenePose, Sim3
from gsmap.types.rows.exports import ExportReport

DATES = {"may": "2026-05-31T15:00:00Z", "june": "2026-06-30", "july": "2026-07-31", "some": None}


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Map]:
    """Three dated captures of one place and one without a date, placed."""
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.with_settings({"merge.mergers.tto.steps": 0})
        for i, (name, date) in enumerate(DATES.items()):
            m.ingest(_cloud(i), cameras=_cameras(), name=name, captured_at=date, scale="known")
        m.store.revisions.save(
            PoseGraph({scene.id: ScenePose(scene.id, Sim3.identity(), 0, "placed") for scene in m.scenes()})
        )
        yield m


def _cloud(seed: int, n: int = 60) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats, sizes = np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -3.0)
    return Gaussians(rng.uniform(-1, 1, (n, 3)), quats, sizes, np.zeros(n), rng.normal(size=(n, 1, 3)))


def _cameras() -> Cameras:
    pose = np.eye(4)
    pose[2, 3] = -4.0
    return Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))


def took_part(report: ExportReport) -> set[str]:
    return {scene.scene_name for tile in report.tiles for scene in tile.scenes}


def test_only_what_was_captured_by_then_takes_part(site: Map, tmp_path: Path) -> None:
    def export(as_of: str) -> ExportReport:
        return site.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union", as_of=as_of)

    first = export("2026-06-29")
    assert (took_part(first), first.tiles[0].num_gaussians) == ({"may"}, 60)
    (note,) = first.notes
    assert note.startswith("some has no date, so whether there by 2026-06-29 is not known: left out")
    assert took_part(export("2026-06-30")) == {"may", "june"}
    assert export("2026-07-01").recomputed == 0  # the same captures: the same tile
    # A day is all of it; a moment is that moment.
    assert took_part(export("2026-05-31")) == {"may"}
    with raises(NotFoundError, code="no_placed_scene"):
        export("2026-05-31T14:59:59")
    with raises(ConfigError, code="invalid_date"):
        export("then")
    everything = site.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union")
    assert (took_part(everything), everything.notes) == (set(DATES), ())


def test_a_corrected_date_makes_tiles_of_the_past_again(site: Map, tmp_path: Path) -> None:
    options = {"format": "ply", "tile_size_m": 0, "merge": "tto", "as_of": "2026-06-30"}
    site.export(tmp_path / "out", **options)
    assert site.export(tmp_path / "out", **options).recomputed == 0
    site.edit("may", captured_at="2026-06-30T12:00")  # now the newer of the two
    (todo,) = [row for row in site.status().todo if row.what == "dirty_tiles"]
    assert "--merge tto --as-of 2026-06-30" in todo.verb
    assert site.export(tmp_path / "out", **options).recomputed == 1
    site.edit("may", captured_at="2026-07-30")
    assert took_part(site.export(tmp_path / "out", **options)) == {"june"}
    site.edit("some", captured_at="2026-06-01")
    last = site.export(tmp_path / "out", **options)
    assert (took_part(last), last.notes) == ({"june", "some"}, ())


def test_whom_to_believe_is_part_of_how_a_tile_is_made(site: Map, tmp_path: Path) -> None:
    def export(**options: str) -> int:
        return site.export(tmp_path / "out", format="ply", tile_size_m=0, **options).recomputed

    assert export() == 1
    assert export(prefer="newest") == 0
    assert export(prefer="both") == 1
    (todo,) = {row.verb for row in site.status().todo if row.what == "dirty_tiles"} or {""}
    assert todo == ""
    site.edit("may", captured_at="2026-08-01")
    assert export(prefer="both") == 0  # nobody wins, whatever the dates
    assert export() == 1
    with raises(ConfigError, code="option_not_applicable", match="prefer="):
        export(merge="distance", prefer="newest")
    with raises(ConfigError, code="invalid_choice", match="prefer= must be one of newest, best, both, got 'oldest'"):
        export(prefer="oldest")


def test_remarks_on_how_a_tile_was_made_are_kept_and_told(site: Map, tmp_path: Path) -> None:
    report = site.export(tmp_path / "out", format="ply", tile_size_m=0)
    (tile,) = report.tiles
    assert any("1 of 4 overlapping captures have no date" in note for note in tile.notes)
    (kept,) = json.loads((tmp_path / "out" / "tiles.json").read_text())["tiles"]
    assert tuple(kept["notes"]) == tile.notes == site.tile_rows()[0].notes


def test_lists_of_the_past(site: Map) -> None:
    assert [row.name for row in site.scene_rows(as_of="2026-06-30")] == ["may", "june"]
    assert site.scene_rows(as_of="2026-01-01") == []
    assert site.edge_rows(as_of="2026-07-31") == []
    with pytest.raises(ConfigError):
        site.scene_rows(as_of="soon")
