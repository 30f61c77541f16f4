"""Exports by default: one file of a component, merged once whatever the formats, and a tileset of the whole map."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import gsmap.map
from gsmap import formats
from gsmap.map import Map, merged_tiles
from gsmap.map.evaluation.evaluate import _Export
from gsmap.types import Cameras, Gaussians, PoseGraph, ScenePose, Sim3


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Map]:
    """Two captures of one place, and one of another."""
    monkeypatch.setenv("GSMAP_CACHE", str(tmp_path / "cache"))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.with_settings({"merge.mergers.tto.steps": 2})
        for seed, name in enumerate(("hall", "door", "barn")):
            m.ingest(_cloud(seed), cameras=_cameras(), name=name, scale="known")
        poses = {scene.id: ScenePose(scene.id, Sim3.identity(), int(scene.name == "barn"), "placed") for scene in m}
        m.store.revisions.save(PoseGraph(poses))
        yield m


def _cloud(seed: int, n: int = 300) -> Gaussians:
    rng = np.random.default_rng(seed)
    quats, sizes = np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -2.5)
    return Gaussians(rng.uniform(-1, 1, (n, 3)), quats, sizes, np.ones(n), rng.normal(size=(n, 1, 3)))


def _cameras() -> Cameras:
    pose = np.eye(4)
    pose[2, 3] = -4.0
    return Cameras(pose[None], np.array([[40.0, 40, 16, 12]]), np.array([[32, 24]]), ("a",))


@pytest.fixture
def merged(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of Gaussians of the tiles that are fitted, as they are."""
    import gsmap.merge.mergers.tto as tto

    fitted: list[int] = []
    fit = tto._fit
    monkeypatch.setattr(tto, "_fit", lambda start, *rest: fitted.append(len(start)) or fit(start, *rest))
    monkeypatch.setenv("GSMAP_WORKERS", "1")
    return fitted


def test_a_further_format_merges_nothing_again(site: Map, tmp_path: Path, merged: list[int]) -> None:
    first = site.export(tmp_path / "a", component=0)
    assert [tile.path for tile in first.tiles] == ["component_0/map.spz"]
    assert (first.recomputed, first.reused, first.up, len(merged)) == (1, 0, "y", 1)
    for number, (format, up) in enumerate([("ply", "z"), ("ply", "y"), ("3dtiles", None), ("sog", None)]):
        site.export(tmp_path / f"b{number}", component=0, format=format, up=up)
    assert len(merged) == 1
    z, y = (formats.read(tmp_path / f"b{number}" / "component_0" / "map.ply") for number in (0, 1))
    np.testing.assert_array_equal(y.means, z.means[:, [0, 2, 1]] * [1, -1, 1])
    # With or without the cache, the same file.
    for path in merged_tiles.folder().iterdir():
        path.write_bytes(b"damaged")
    site.export(tmp_path / "c", component=0, format="ply")
    assert len(merged) == 2
    assert (tmp_path / "c/component_0/map.ply").read_bytes() == (tmp_path / "b0/component_0/map.ply").read_bytes()
    site.export(tmp_path / "d", component=0, steps=3)
    site.export(tmp_path / "e", component=0, tile_size_m=5.0)
    assert len(merged) > 3


def test_another_pose_is_merged_anew(site: Map, tmp_path: Path, merged: list[int]) -> None:
    site.export(tmp_path / "a", component=0)
    poses = dict(site.pose_graph().poses)
    moved = poses[site["door"].id]
    poses[moved.scene] = ScenePose(moved.scene, Sim3(np.eye(3), [1e-4, 0, 0]), 0, "placed")
    site.store.revisions.save(PoseGraph(poses))
    assert site.export(tmp_path / "a", component=0).reused == 1  # within the tolerance of a folder
    assert len(merged) == 1
    site.export(tmp_path / "b", component=0)
    assert len(merged) == 2


def test_a_purge_forgets_merged_tiles_of_its_scene_alone(site: Map, tmp_path: Path, merged: list[int]) -> None:
    site.export(tmp_path / "a")
    assert [merged_tiles.files_of(site[name].id) == [] for name in ("hall", "door", "barn")] == [False, False, True]
    (merged_tiles.folder() / "x.npz").write_bytes(b"damaged")
    report = site.purge("door")
    assert str(merged_tiles.folder()) in report.exports
    assert list(merged_tiles.folder().iterdir()) == []


def test_evaluation_reads_files_in_the_map_s_axes(site: Map, tmp_path: Path) -> None:
    site.export(tmp_path / "y", merge="union", format="ply", up="y")
    site.export(tmp_path / "z", merge="union", format="ply", up="z")
    for name in ("hall", "barn"):
        y, z = (_Export(site.store, tmp_path / up).content(site[name].id) for up in "yz")
        np.testing.assert_array_equal(y[0].means, z[0].means)


def test_provenance_alone_is_a_ply(site: Map, tmp_path: Path) -> None:
    report = site.export(tmp_path / "out", merge="union", provenance=True)
    assert [Path(tile.path).suffix for tile in report.tiles] == [".ply", ".ply"]


def test_one_tileset_shows_all_components_side_by_side(site: Map, tmp_path: Path) -> None:
    out = tmp_path / "out"
    report = site.export(out, merge="union", format="3dtiles")
    assert any("side by side" in note for note in report.notes)
    linked = json.loads((out / "tileset.json").read_text())
    children = linked["root"]["children"]
    assert [child["content"]["uri"] for child in children] == [
        "component_0/tileset.json",
        "component_1/tileset.json",
    ]
    assert all((out / child["content"]["uri"]).is_file() for child in children)
    assert linked["extensions"]["3DTILES_content_gltf"]["extensionsRequired"]
    spans = []
    for child in children:
        center, half = child["boundingVolume"]["box"][:3], child["boundingVolume"]["box"][3]
        shift = child.get("transform", np.eye(4).T.ravel())[12]
        spans.append((center[0] + shift - half, center[0] + shift + half))
    assert spans[0][1] < spans[1][0]
    around = linked["root"]["boundingVolume"]["box"]
    assert around[0] - around[3] == pytest.approx(spans[0][0])
    assert around[0] + around[3] == pytest.approx(spans[1][1])
    before = (out / "tileset.json").stat().st_mtime_ns
    assert site.export(out, merge="union", format="3dtiles").recomputed == 0
    assert (out / "tileset.json").stat().st_mtime_ns == before
    site.export(out, merge="union", format="spz")  # the trees of the former format go
    assert sorted(path.name for path in out.rglob("*") if path.is_file()) == ["map.spz", "map.spz", "tiles.json"]
