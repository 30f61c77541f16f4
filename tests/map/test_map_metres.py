"""A map whose unit is not the metre: what it says of it, and that every length is in metres all the same."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap import formats
from gsmap.cli.app import run
from gsmap.errors import CorruptError, InputError
from gsmap.geometry.metric_scale import scale_gaussians
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.map import Map
from gsmap.store.schema import scene_facts
from gsmap.types import Cameras, Gaussians, Sim3
from gsmap_synthetic import DemoCapture, make_captures

UNIT = 0.3  # metres
SIGMAS = np.array([0.001] * 6 + [1e-3])
QUICK = {"merge.mergers.tto.steps": 2, "merge.mergers.tto.longest_side_px": 80}


@pytest.fixture(scope="module", autouse=True)
def one_worker() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GSMAP_WORKERS", "1")
        yield


@pytest.fixture(scope="module")
def captures() -> list[DemoCapture]:
    """One room walked through twice."""
    return make_captures(0, 2, steps=0, num_frames=6, num_gaussians=5_000, size_px=(80, 60), routes=[[0], [0]])


def in_unit(capture: DemoCapture, metres: float) -> tuple[Gaussians, Cameras, Sim3]:
    """A capture whose unit is so many metres, and where it lies."""
    S = Sim3(np.eye(3), np.zeros(3), 1 / metres)
    moved = transform_cameras(capture.cameras, S)
    return transform_gaussians(capture.gaussians, S), moved, S @ Sim3.from_matrix(capture.T_scene_world)


Made = Callable[..., Map]


@pytest.fixture
def made(captures: list[DemoCapture], tmp_path: Path) -> Iterator[Made]:
    """Makes maps of both captures, each in a unit, tied by the truth."""
    opened: list[Map] = []

    def make(units: tuple[float, float], scales: tuple[str, str] = ("unknown", "unknown"), tie: bool = True) -> Map:
        m = gsmap.map.create(tmp_path / f"{len(opened)}.gsmap")
        opened.append(m)
        poses = []
        for day, (capture, unit, scale) in enumerate(zip(captures, units, scales, strict=True), 1):
            gaussians, cameras, S_scene_world = in_unit(capture, unit)
            when = f"2026-01-0{day}"
            m.ingest(gaussians, cameras=cameras, name=capture.name, scale=scale, captured_at=when)
            poses.append(S_scene_world)
        if tie:
            m.add_edge("capture_a:capture_b", poses[0] @ poses[1].inverse(), SIGMAS)
            m.optimize()
        return m

    yield make
    for m in opened:
        m.close()


def exported(m: Map, out: Path, **options: object) -> tuple[Gaussians, list[np.ndarray]]:
    """What an export holds, in metres, and the bounds of its tiles."""
    result = m.with_settings(QUICK).export(out, **{"format": "ply"} | options)  # type: ignore[arg-type]
    metres = next(iter(m.metres().values())).metres_per_unit
    parts = [formats.read(out / tile.path) for tile in result.tiles if tile.path]
    return scale_gaussians(Gaussians.concatenate(parts), metres), [tile.bounds * metres for tile in result.tiles]


@pytest.mark.parametrize("merge", ["tto", "voxel", "union", "distance"])
@pytest.mark.parametrize("tile", [0.0, 4.0])
def test_an_export_is_the_same_whatever_the_unit(made: Made, tmp_path: Path, merge: str, tile: float) -> None:
    metric = made((1.0, 1.0), ("known", "known"))
    other = made((UNIT, UNIT))
    other.edit("capture_b", metres_per_unit=UNIT)
    one, bounds = exported(metric, tmp_path / "metric", merge=merge, tile_size_m=tile)
    two, others = exported(other, tmp_path / "other", merge=merge, tile_size_m=tile)
    assert abs(len(two) / len(one) - 1) < 0.01
    if tile:  # boxes around scenes may be a touch larger; the grid is that of metres
        np.testing.assert_allclose(others, bounds, atol=1e-6)
    np.testing.assert_allclose(np.median(two.means, 0), np.median(one.means, 0), atol=0.02)
    assert np.median(two.log_scales) == pytest.approx(np.median(one.log_scales), abs=0.02)


def test_gaussians_of_a_tile_lie_in_it_in_the_unit_of_the_map(made: Made, tmp_path: Path) -> None:
    m = made((UNIT, UNIT))
    m.edit("capture_a", metres_per_unit=UNIT)
    for tile in m.export(tmp_path / "out", format="ply", merge="union", tile_size_m=1.5).tiles:
        if tile.path:
            means = formats.read(tmp_path / "out" / tile.path).means
            assert (means >= tile.bounds[0]).all()
            assert (means < tile.bounds[1]).all()


def test_a_capture_in_metres_measures_the_unit(made: Made) -> None:
    m = made((10.0, 1.0), ("unknown", "known"))
    metre = m.metres()[0]
    assert metre.metres_per_unit == pytest.approx(10.0, rel=0.005)
    assert metre.known_by == "measured"
    assert metre.sigma >= 0.01


def test_components_have_a_metre_each(made: Made) -> None:
    m = made((10.0, 1.0), tie=False)
    m.edit("capture_a", metres_per_unit=10.0)
    m.optimize()
    rows = {row.name: row for row in m.scene_rows()}
    assert rows["capture_a"].component != rows["capture_b"].component
    assert rows["capture_a"].metres_per_unit == 10.0
    assert rows["capture_b"].metres_per_unit is None


def test_it_is_told_everywhere_and_may_be_taken_back(made: Made, tmp_path: Path) -> None:
    m = made((UNIT, UNIT))
    assert m.status().metres_per_unit is None
    assert any(
        "its metric scale is unknown" in note for note in m.export(tmp_path / "out", format="ply", merge="union").notes
    )
    m.edit("capture_a", metres_per_unit=UNIT)
    status, shown = m.status(), m.show_scene("capture_b")
    assert status.metres_per_unit == pytest.approx(UNIT)
    assert [(row.component, row.metre_known_by) for row in status.metres] == [(0, "told")]
    assert (shown.metres_per_unit, shown.metre_known_by) == (pytest.approx(UNIT), "told")
    assert [fact.value for fact in m.show_scene("capture_a").history if fact.fact == "metres_per_unit"] == ["0.3"]
    result = m.export(tmp_path / "out", format="ply", merge="union")
    assert result.notes == ()
    written = json.loads((tmp_path / "out" / "tiles.json").read_text())
    (component,) = written["components"]
    assert component["metres_per_unit"] == pytest.approx(UNIT)
    assert component["metre_known_by"] == "told"
    tile = written["tiles"][0]
    np.testing.assert_allclose(tile["bounds_m"], np.array(tile["bounds"]) * UNIT)
    m.edit("capture_a", metres_per_unit=0)
    assert m.status().metres_per_unit is None


def test_the_command_line_tells_it(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    def said(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as end:
            run([arguments[0], at, *arguments[1:]])
        return int(end.value.code or 0), " ".join(capsys.readouterr().out.split())

    m = made((UNIT, UNIT))
    at = m.store.location
    assert said("edit", "capture_a", "--metres-per-unit", "0.3")[0] == 0
    assert "0.3 m per unit, told, to within 1 %" in said("status")[1]
    assert "0.3 m per unit, told, to within 1 %" in said("show", "capture_a")[1]
    assert said("edit", "capture_a", "--metres-per-unit", "none")[0] == 0
    assert "unknown" in said("status")[1]
    for wrong in ("0", "-1", "nan", "three"):
        assert said("edit", "capture_a", "--metres-per-unit", wrong)[0] in (1, 2)


def test_another_metre_makes_tiles_again_and_the_same_does_not(made: Made, tmp_path: Path) -> None:
    m = made((UNIT, UNIT))
    m.edit("capture_a", metres_per_unit=UNIT)
    out = tmp_path / "out"
    first = m.export(out, format="ply", merge="voxel", tile_size_m=0)
    assert m.export(out, format="ply", merge="voxel", tile_size_m=0).recomputed == 0
    m.edit("capture_a", metres_per_unit=2 * UNIT)
    assert [row.what for row in m.status().todo if row.what == "dirty_tiles"] == ["dirty_tiles"]
    again = m.export(out, format="ply", merge="voxel", tile_size_m=0)
    assert again.recomputed == 1
    assert again.tiles[0].num_gaussians > first.tiles[0].num_gaussians  # the same voxel is half as long in the map


def test_a_tile_of_a_map_in_metres_has_the_key_it_always_had(made: Made, tmp_path: Path) -> None:
    m = made((1.0, 1.0))
    first = m.export(tmp_path / "out", format="ply", merge="voxel", tile_size_m=0)
    assert m.metres()[0].known_by == "unknown"
    m.edit("capture_a", metres_per_unit=1.0)
    again = m.export(tmp_path / "out", format="ply", merge="voxel", tile_size_m=0)
    assert (first.recomputed, again.recomputed) == (1, 0)
    # What the folder says of the metre is of today all the same.
    assert json.loads((tmp_path / "out" / "tiles.json").read_text())["components"][0]["metre_known_by"] == "told"


def test_3d_tiles_are_in_metres(made: Made, tmp_path: Path) -> None:
    m = made((UNIT, UNIT))
    m.edit("capture_a", metres_per_unit=UNIT)
    m.export(tmp_path / "out", merge="union", format="3dtiles", tile_size_m=3.0)
    tileset = json.loads((tmp_path / "out" / "component_0" / "tileset.json").read_text())
    np.testing.assert_allclose(np.reshape(tileset["root"]["transform"], (4, 4)), np.diag([UNIT, UNIT, UNIT, 1]))
    box = np.array(tileset["root"]["boundingVolume"]["box"])
    diagonal_m = 2 * UNIT * np.linalg.norm(np.diag(box[3:].reshape(3, 3)))
    assert tileset["geometricError"] == pytest.approx(diagonal_m, rel=1e-6)  # this one no transform scales
    # And the tree is that of the grid in metres: leaves are not larger than a tile.
    assert len(tileset["root"]["children"]) > 1


def test_evaluate_judges_the_metre(made: Made, captures: list[DemoCapture], tmp_path: Path) -> None:
    m = made((UNIT, UNIT))
    m.edit("capture_a", metres_per_unit=2 * UNIT)
    for capture in captures:
        matrix = in_unit(capture, UNIT)[2].matrix().tolist()
        (tmp_path / f"{capture.name}.json").write_text(json.dumps({"T_scene_world": matrix}))
    (row,) = m.evaluate(tmp_path).components
    assert row.metres_per_unit == pytest.approx(2 * UNIT)
    assert row.true_metres_per_unit == pytest.approx(UNIT)
    assert row.metre_known_by == "told"


def test_a_length_that_gsmap_did_not_write_is_refused(made: Made) -> None:
    m = made((UNIT, UNIT))
    for wrong in (-1.0, float("nan"), float("inf")):
        with raises(InputError, code="invalid_metre"):
            m.edit("capture_a", metres_per_unit=wrong)
    m.edit("capture_a", metres_per_unit=UNIT)
    with m.store.catalog.write() as connection:
        told = scene_facts.c.kind == "metres_per_unit"
        connection.execute(scene_facts.update().where(told).values(value="wide"))
    with raises(CorruptError, code="catalog_invalid", match="'wide'"):
        m.metres()
