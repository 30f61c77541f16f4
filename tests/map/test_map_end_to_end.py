"""The whole job on three small captures that gsmap makes itself, against the truth they were made with."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap
import gsmap.map
from gsmap import formats
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.export.manifest import FILE_NAME
from gsmap.types import Prior, Sim3
from gsmap.types.rows.scenes import GraphRow
from gsmap_synthetic import make_captures, write_captures
from tools.make.tiny_encoder import image_encoder


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures")
    made = make_captures(0, 3, shut_doors=False, steps=0, num_frames=24, num_gaussians=25_000, size_px=(160, 120))
    write_captures(folder, made)
    return folder


@pytest.fixture(scope="module")
def site(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("maps") / "site.gsmap"
    with gsmap.map.open_or_create(path) as m:
        m.update(captures)
    return path


@pytest.fixture
def copy(site: Path, tmp_path: Path) -> Path:
    """A map to change: a map is a folder, and copying it is a backup."""
    return Path(shutil.copytree(site, tmp_path / "copy.gsmap"))


def cli(*arguments: object) -> str:
    done = subprocess.run(
        [sys.executable, "-P", "-m", "gsmap", *map(str, arguments)], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_scene_is_placed_where_it_was_made(site: Path, captures: Path) -> None:
    with gsmap.open(site) as m:
        report = m.evaluate(captures / "truth")
        rows = m.scene_rows()
    assert len(report.pairs) == 3
    assert report.pairs_worst_rre_deg < 0.2
    assert report.pairs_worst_centroid_m < 0.01
    assert {row.status for row in rows} == {"placed"}
    assert {row.component for row in rows} == {0}


def test_the_map_stands_upright(site: Path) -> None:
    with gsmap.open(site) as m:
        for pose in m.pose_graph().poses.values():
            up = m.store.graphs.load(pose.scene).up
            assert (pose.S_map_scene.rotation @ up)[2] > np.cos(np.radians(5))


def test_json_keeps_the_contract(site: Path) -> None:
    """The keys that scripts outside rely on; docs/reference/json.md lists all."""
    scenes = json.loads(cli("list", site, "scenes", "--json"))["scenes"]
    wanted = ["name", "id", "num_gaussians", "num_nodes", "component", "S_map_scene", "captured_at", "status"]
    assert set(wanted) <= set(scenes[0])
    assert np.shape(scenes[0]["S_map_scene"]) == (4, 4)
    edges = json.loads(cli("list", site, "edges", "--json"))["edges"]
    assert set(edges[0]) >= {
        "target",
        "source",
        "status",
        "reason",
        "S_target_source",
        "scale",
        "information",
        "num_inliers",
        "num_correspondences",
        "overlap",
        "seconds",
        "used",
    }
    assert set(edges[0]["seconds"]) == {"match", "refine", "verdict"}
    assert np.shape(edges[0]["information"]) == (7, 7)
    assert {e["target"] for e in edges} <= {s["id"] for s in scenes}
    assert {e["target_name"] for e in edges} <= {s["name"] for s in scenes}


def test_nothing_is_computed_twice(copy: Path, captures: Path) -> None:
    with gsmap.open(copy) as m:
        before = [row.number for row in m.revision_rows()]
        assert [row.new for row in m.update(captures).ingested] == [False] * 3
        assert [row.number for row in m.revision_rows()] == before
        assert m.register("auto") == []


def test_two_workers_find_what_one_finds(
    site: Path, captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSMAP_WORKERS", "1" if os.cpu_count() != 1 else "2")
    with gsmap.map.create(tmp_path / "again.gsmap") as again, gsmap.open(site) as m:
        again.update(captures)
        for mine, theirs in zip(again.scene_rows(), m.scene_rows(), strict=True):
            np.testing.assert_allclose(mine.S_map_scene.matrix(), theirs.S_map_scene.matrix(), atol=1e-9)


def test_removing_a_scene_keeps_history(copy: Path) -> None:
    with gsmap.open(copy) as m:
        gone = m.remove("capture_b")
        m.update()
        assert gone.id not in m.pose_graph().poses
        assert gone.id in m.pose_graph(1).poses
        assert [row.change for row in m.diff(1, 2) if row.scene_name == "capture_b"] == ["removed"]
        with raises(NotFoundError, code="scene_not_found"):
            m.show_scene("capture_b")


def test_prune_frees_what_no_kept_revision_names(copy: Path) -> None:
    with gsmap.open(copy) as m:
        m.remove("capture_b")
        m.update()
        assert m.prune().scene_names == ()
        would = m.prune(keep_revisions=1, dry_run=True)
        freed = m.prune(keep_revisions=1)
        assert would.dry_run
        assert (would.scene_names, would.num_bytes) == (freed.scene_names, freed.num_bytes)
        assert freed.scene_names == ("capture_b",)
        assert freed.num_bytes > 100_000
        assert m.check().problems == ()


def test_a_person_s_word_counts(copy: Path) -> None:
    with gsmap.open(copy) as m:
        for pair in ("capture_a:capture_b", "capture_b:capture_c"):
            m.reject(pair, note="the doors look alike")
        m.update()
        rows = {row.name: row for row in m.scene_rows()}
        assert rows["capture_a"].component == rows["capture_c"].component != rows["capture_b"].component
        m.confirm("capture_a:capture_b")
        m.update()
        assert len({row.component for row in m.scene_rows()}) == 1
        said = [row.what for row in m.show_pair("capture_a:capture_b").history]
        assert said == ["accepted", "reject", "confirm"]


def test_shows_scenes_and_pairs(site: Path, tmp_path: Path) -> None:
    shown = json.loads(cli("show", site, "capture_a", "--json"))
    assert shown["num_nodes"] > 20
    assert len(shown["nodes"]) > 10
    assert len(shown["edges"]) == 2
    assert shown["translation_sigma_m"] < 0.1
    pair = json.loads(cli("show", site, "capture_a:capture_b", "--json"))
    assert pair["evidence"]
    assert "capture_a" in cli("show", site, "capture_a")


def test_exports_only_what_changed(copy: Path, tmp_path: Path) -> None:
    out = tmp_path / "tiles"
    with gsmap.open(copy) as m:
        first = m.export(out, format="ply", tile_size_m=4, merge="voxel")
        listed = json.loads((out / FILE_NAME).read_text())["tiles"]  # those that turn out empty as well
        assert first.recomputed == len(first.tiles) > 3
        assert len(listed) > len(first.tiles)
        assert len(first.tiles) == sum(tile["num_gaussians"] > 0 for tile in listed)
        again = m.export(out, format="ply", tile_size_m=4, merge="voxel")
        assert (again.recomputed, again.reused) == (0, first.recomputed)
        assert [t.sha256 for t in again.tiles] == [t.sha256 for t in first.tiles]
        whole = m.export(tmp_path / "whole", format="ply", tile_size_m=0, merge="voxel")
        assert sum(t.num_gaussians for t in first.tiles) == sum(t.num_gaussians for t in whole.tiles)
        assert {row.out for row in m.tile_rows()} == {str(out), str(tmp_path / "whole")}
        m.remove("capture_b")
        m.update()
        third = m.export(out, format="ply", tile_size_m=4, merge="voxel")
        assert third.recomputed > 0
        assert third.removed + third.recomputed > 0
        assert {row.path for row in m.tile_rows() if row.out == str(out)} == {t.path for t in third.tiles if t.path}


def test_an_older_revision_can_be_exported(copy: Path, tmp_path: Path) -> None:
    with gsmap.open(copy) as m:
        m.remove("capture_b")
        m.update()
        old = m.export(tmp_path / "old", format="ply", tile_size_m=0, merge="union", revision=1)
        new = m.export(tmp_path / "new", format="ply", tile_size_m=0, merge="union")
    assert old.tiles[0].num_gaussians > new.tiles[0].num_gaussians


def test_provenance_names_the_capture(site: Path, tmp_path: Path) -> None:
    with gsmap.open(site) as m:
        result = m.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union", provenance=True)
        counts = sorted(s.num_gaussians for s in m.scenes())
    header = (tmp_path / "out" / result.tiles[0].path).read_bytes()[:4096]
    assert b"property float scene" in header
    assert result.tiles[0].num_gaussians == sum(counts)


def test_3dtiles_tree_holds_every_gaussian_at_its_finest(site: Path, tmp_path: Path) -> None:
    with gsmap.open(site) as m:
        tiles = m.export(tmp_path / "t", tile_size_m=4, merge="voxel", format="3dtiles")
        plain = m.export(tmp_path / "p", format="ply", tile_size_m=0, merge="voxel")
    tileset = tmp_path / "t" / "component_0" / "tileset.json"
    finest = formats.read(tileset)
    whole = formats.read(tmp_path / "p" / plain.tiles[0].path)
    assert len(finest) == len(whole) == sum(t.num_gaussians for t in tiles.tiles)
    np.testing.assert_allclose(np.sort(finest.means, axis=0), np.sort(whole.means, axis=0), atol=1e-4)
    root = json.loads(tileset.read_text())["root"]
    assert root["geometricError"] > root["children"][0]["geometricError"] >= 0


def test_a_streamed_sog_holds_every_gaussian_at_its_finest_and_is_kept(site: Path, tmp_path: Path) -> None:
    with gsmap.open(site) as m:
        tiles = m.export(tmp_path / "t", tile_size_m=4, merge="voxel", format="streamed-sog")
        file = tmp_path / "t" / "component_0" / "lod-meta.json"
        before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in file.parent.rglob("*") if p.is_file()}
        again = m.export(tmp_path / "t", tile_size_m=4, merge="voxel", format="streamed-sog")
        assert again.recomputed == 0
        assert {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in file.parent.rglob("*") if p.is_file()} == before
        file.unlink()  # all that an export killed at its end lacks
        m.export(tmp_path / "t", tile_size_m=4, merge="voxel", format="streamed-sog")
        assert file.read_bytes() == before[file][0]
        plain = m.export(tmp_path / "p", format="ply", tile_size_m=0, merge="voxel")
    finest = formats.read(file)
    whole = formats.read(tmp_path / "p" / plain.tiles[0].path)
    assert len(finest) == len(whole) == sum(t.num_gaussians for t in tiles.tiles)
    np.testing.assert_allclose(np.sort(finest.means, axis=0), np.sort(whole.means, axis=0), atol=1e-3)
    meta = json.loads(file.read_text())
    assert meta["lodLevels"] > 1
    assert meta["counts"][0] > 3 * meta["counts"][-1] > 0
    told = [meta["tree"]]
    for node in told:
        told += node.get("children", [])
        for level, run in node.get("lods", {}).items():
            assert (run["error_m"] > 0) == (level != "0")
            assert (level == "0") != ("psnr_db" in run)


@pytest.mark.parametrize(
    ("options", "error", "code", "match"),
    [
        ({"bbox": [0, 0, 0, 0, 1, 1]}, InputError, "invalid_box", "box"),
        ({"bbox": [900, 900, 900, 901, 901, 901]}, InputError, "box_outside_map", "outside the map"),
        ({"budget_s": 0.0}, ConfigError, "invalid_budget", "budget"),
        ({"merge": "glue"}, ConfigError, "unknown_method", "'glue'"),
        ({"format": "dwg"}, ConfigError, "unsupported_output", "'dwg'"),
        ({"tile_size_m": -1}, ConfigError, "out_of_range", "tile size"),
        ({"revision": 99}, NotFoundError, "revision_not_found", "99"),
        ({"component": 7}, NotFoundError, "component_not_found", "7"),
        ({"merge": "union", "steps": 5}, ConfigError, "option_not_applicable", "'union' .*steps="),
        ({"format": "spz", "provenance": True}, ConfigError, "unsupported_output", "provenance"),
        ({"format": "3dtiles", "tile_size_m": 0}, ConfigError, "unsupported_output", "3dtiles .*tile_size_m="),
        ({"format": "streamed-sog", "tile_size_m": 0}, ConfigError, "unsupported_output", "or use sog"),
    ],
)
def test_bad_exports_are_refused_and_leave_nothing(
    site: Path, tmp_path: Path, options: dict, error: type[Exception], code: str, match: str
) -> None:
    with gsmap.open(site) as m, raises(error, code=code, match=match):
        m.export(tmp_path / "out", **options)
    assert not list((tmp_path / "out").rglob("*.*")) if (tmp_path / "out").exists() else True


def test_another_map_s_folder_is_refused(site: Path, captures: Path, tmp_path: Path) -> None:
    with gsmap.open(site) as m:
        m.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union")
    manifest = (tmp_path / "out" / FILE_NAME).read_text()
    with gsmap.map.create(tmp_path / "other.gsmap") as other:
        other.ingest(captures / "capture_a.ply")
        other.describe()
        other.optimize()
        with raises(ConfigError, code="foreign_export"):
            other.export(tmp_path / "out", format="ply", tile_size_m=0, merge="union")
    assert (tmp_path / "out" / FILE_NAME).read_text() == manifest


def test_whole_map_checks_out(site: Path) -> None:
    with gsmap.open(site) as m:
        assert m.check().problems == ()


def test_bad_pairs_are_refused(site: Path) -> None:
    with gsmap.open(site) as m:
        for pair in ("capture_a", "capture_a:nothing", "capture_a:capture_a"):
            with pytest.raises((NotFoundError, InputError, ConfigError)):
                m.register(pair)
        with raises(NotFoundError, code="no_truth"):
            m.evaluate(site.parent)


def test_models_are_checked_kept_and_used(copy: Path, tmp_path: Path) -> None:
    model = tmp_path / "encoder.onnx"
    model.write_bytes(image_encoder())
    with gsmap.open(copy) as m:
        before = _objects(m.describe("capture_a")[0])
        m.add_model("clip", model, preset="unit")
        model.unlink()  # the map has its own copy
        assert _objects(m.describe("capture_a")[0]) != before
        assert [row.kind for row in m.model_rows()] == ["clip"]
        m.draw_graph("capture_a", tmp_path / "graph.png")
        with raises(InputError, code="not_a_model"):
            m.add_model("clip", copy / "map.sqlite")
    assert (tmp_path / "graph.png").stat().st_size > 10_000


def _objects(row: GraphRow) -> str:
    return next(layer.descriptor_id for layer in row.layers if layer.layer == "objects")


def test_an_anchor_and_a_survey_hold_the_map(copy: Path) -> None:
    with gsmap.open(copy) as m:
        names = [row.name for row in m.scene_rows()]
        before = {p.scene: p.S_map_scene for p in m.pose_graph().poses.values()}
        ids = {s.name: s.id for s in m.scenes()}
        with raises(InputError, code="invalid_prior"):
            m.set_prior(Prior(names[1], Sim3.identity(), np.full(7, np.inf), np.zeros(3)))
        with raises(InputError, code="invalid_pose"):
            m.set_prior(Prior(names[1], np.eye(4), np.full(7, np.inf)))
        assert m.store.priors.list() == []
    cli("prior", copy, names[1], "--anchor")
    cli("update", copy)
    with gsmap.open(copy) as m:
        after = {p.scene: p.S_map_scene for p in m.pose_graph().poses.values()}
    assert np.allclose(after[ids[names[1]]].matrix(), np.eye(4), atol=1e-3)
    relative = [poses[ids[names[0]]].inverse() @ poses[ids[names[1]]] for poses in (before, after)]
    assert np.allclose(relative[0].matrix(), relative[1].matrix(), atol=5e-3)
    # Another position of the same certainty is another input.
    cli("prior", copy, names[1], "--position", 5, 6, 7, "--sigma", 0.01)
    cli("update", copy)
    cli("prior", copy, names[1], "--position", 8, 6, 7, "--sigma", 0.01)
    cli("update", copy)
    with gsmap.open(copy) as m:
        assert np.allclose(m.pose_graph().poses[ids[names[1]]].S_map_scene.translation, [8, 6, 7], atol=0.02)
    shown = json.loads(cli("show", copy, names[1], "--json"))
    assert shown["prior"]["S_map_scene"][0][3] == 8
    assert shown["prior"]["outcome"] == "used"
    cli("prior", copy, names[1], "--remove")
    with gsmap.open(copy) as m:
        assert m.store.priors.list() == []
