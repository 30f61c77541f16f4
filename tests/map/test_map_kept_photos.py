"""Photographs that a map keeps take part in what it exports: those near a tile, by their dates, until taken back."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

import gsmap.map
from gsmap.errors import GsmapError
from gsmap.map import Map
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PoseGraph, ScenePose, Sim3
from gsmap.types.localized_photo import LocalizedPhoto
from gsmap.types.rows.exports import ExportReport

LENS, SIZE = np.array([120.0, 120, 48, 36]), (96, 72)
POSE = np.eye(4)
POSE[2, 3] = -2.0


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Map]:
    """Two dated captures of one wall, placed; one stands in units of half a metre."""
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.with_settings({"merge.mergers.tto.steps": 10})
        poses = {}
        for i, (name, scale) in enumerate((("may", 1.0), ("june", 2.0))):
            m.ingest(wall(i, scale), cameras=cameras(scale), name=name, captured_at=f"2026-0{5 + i}-01", scale="known")
        for scene in m.scenes():
            S = Sim3(np.eye(3), np.zeros(3), 1.0 if scene.name == "may" else 0.5)
            poses[scene.id] = ScenePose(scene.id, S, 0, "placed")
        m.store.revisions.save(PoseGraph(poses))
        yield m


def wall(seed: int, scale: float) -> Gaussians:
    rng = np.random.default_rng(seed)
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-1, 1, 40), np.linspace(-0.8, 0.8, 32)))
    means = np.stack([x, y, np.zeros(len(x))], axis=1) + rng.normal(0, 0.005, (len(x), 3))
    colours = 0.5 + 0.3 * np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * (x + y))], axis=1)
    sizes = np.log(np.tile([0.03, 0.03, 0.004], (len(x), 1)) * scale)
    quats = np.tile([1.0, 0, 0, 0], (len(x), 1))
    sh = (colours + rng.normal(0, 0.03, colours.shape) - 0.5)[:, None] / 0.28209479177387814
    return Gaussians(means * scale, quats, sizes, np.full(len(x), 4.0), sh)


def cameras(scale: float) -> Cameras:
    poses = np.tile(POSE, (3, 1, 1))
    poses[:, 0, 3] = [-0.4, 0.0, 0.4]
    poses[:, :3, 3] *= scale
    return Cameras(poses, np.tile(LENS, (3, 1)), np.tile(SIZE, (3, 1)))


def keep(
    m: Map,
    number: int = 1,
    *,
    name: str = "may",
    at=(0.1, 0.0, -1.8),
    when: str | None = "2026-05-20",
    quality: int = 95,
) -> None:
    """A photograph of the wall as a capture shows it, in a darker exposure."""
    pose = np.eye(4)
    pose[:3, 3] = at
    scale = 2.0 if name == "june" else 1.0
    seen = render(wall(9, scale), Cameras((scale_of(pose, scale))[None], LENS[None], np.array([SIZE]))).colour[0]
    content = io.BytesIO()
    Image.fromarray((np.clip(0.8 * seen, 0, 1) * 255).astype(np.uint8)).save(content, "JPEG", quality=quality)
    m.store.photos.add(sighting(m, number, name, scale_of(pose, scale), when), content.getvalue())


def scale_of(pose: np.ndarray, scale: float) -> np.ndarray:
    out = pose.copy()
    out[:3, 3] *= scale
    return out


def sighting(m: Map, number: int, name: str, pose: np.ndarray, when: str | None) -> LocalizedPhoto:
    scene = next(one.id for one in m.scenes() if one.name == name)
    lens = 2 * LENS  # of the photo itself, which is twice as large as what is kept of it
    size = (2 * SIZE[0], 2 * SIZE[1])
    return LocalizedPhoto(f"{number:064x}", f"photo{number}.jpg", when, scene, pose, np.eye(6) * 1e-6, lens, size, 0.99)


def export(m: Map, out: Path, **options) -> ExportReport:
    return m.export(out, **{"format": "ply", "tile_size_m": 0, "merge": "tto"} | options)


def reproduced(report: ExportReport) -> int:
    notes = [note for tile in report.tiles for note in tile.notes if "as reference views" in note]
    return sum(int(note.split()[0]) for note in notes)


def test_a_photograph_makes_the_tile_again_and_one_that_is_taken_back_too(site: Map, tmp_path: Path) -> None:
    first = export(site, tmp_path / "out")
    assert reproduced(first) == 0
    keep(site)
    (todo,) = [row for row in site.status().todo if row.what == "dirty_tiles"]
    assert "gsmap export" in todo.verb
    second = export(site, tmp_path / "out")
    assert (second.recomputed, reproduced(second)) == (1, 1)
    assert second.tiles[0].sha256 != first.tiles[0].sha256
    assert export(site, tmp_path / "out").recomputed == 0
    keep(site, 2, name="june", at=(-0.2, 0.1, -1.7))
    assert reproduced(export(site, tmp_path / "out")) == 2
    for number in (1, 2):
        site.store.photos.remove(site.store.photos.find(f"photo{number}.jpg").number)
    last = export(site, tmp_path / "out")
    assert (last.recomputed, last.tiles[0].sha256) == (1, first.tiles[0].sha256)


def test_a_tile_is_named_by_pictures_as_they_are_kept_in_whatever_order_they_came(site: Map, tmp_path: Path) -> None:
    keep(site, 1, when=None)
    keep(site, 2, name="june", at=(-0.2, 0.1, -1.7), when=None)
    first = export(site, tmp_path / "out")
    for number in (2, 1):
        site.store.photos.remove(site.store.photos.find(f"photo{number}.jpg").number)
    keep(site, 2, name="june", at=(-0.2, 0.1, -1.7), when=None)
    keep(site, 1, when=None)
    assert export(site, tmp_path / "out").recomputed == 0
    site.store.photos.remove(site.store.photos.find("photo1.jpg").number)
    keep(site, 1, when=None, quality=30)  # the same photo and pose, another picture of it
    again = export(site, tmp_path / "out")
    assert (again.recomputed, again.tiles[0].sha256 != first.tiles[0].sha256) == (1, True)


def test_only_tiles_near_it_and_mergers_that_use_it_know_of_it(site: Map, tmp_path: Path) -> None:
    export(site, tmp_path / "tiles", tile_size_m=1.0)
    export(site, tmp_path / "union", merge="union")
    export(site, tmp_path / "far", **{"bbox": (0, -1, -1, 1, 1, 1), "tile_size_m": 1.0})
    keep(site, at=(0.1, 0.0, -40.0))
    assert export(site, tmp_path / "tiles", tile_size_m=1.0).recomputed == 0
    keep(site, 2)
    assert export(site, tmp_path / "union", merge="union").recomputed == 0
    tiles = export(site, tmp_path / "tiles", tile_size_m=1.0)
    assert tiles.recomputed == len(tiles.tiles)
    assert reproduced(tiles) >= 1
    site.with_settings({"merge.mergers.tto.photo_weight": 0.0})
    without = export(site, tmp_path / "without")
    assert reproduced(without) == 0


def test_of_an_earlier_day_later_photographs_know_nothing(site: Map, tmp_path: Path) -> None:
    before = export(site, tmp_path / "out", as_of="2026-06-10")
    keep(site, 1, when="2026-06-20")
    keep(site, 2, when=None)
    assert export(site, tmp_path / "out", as_of="2026-06-10").recomputed == 0
    later = export(site, tmp_path / "later", as_of="2026-06-20")
    assert reproduced(later) == 1
    assert before.tiles[0].sha256 != later.tiles[0].sha256


def test_a_picture_that_is_damaged_says_so_and_how_to_go_on(site: Map, tmp_path: Path) -> None:
    site.store.photos.add(sighting(site, 1, "may", POSE, None), b"\xff\xd8\xff\xe0 and no more")
    with raises(GsmapError, code="photo_damaged"):
        export(site, tmp_path / "out")
    site.store.photos.remove(1)
    assert export(site, tmp_path / "out").recomputed == 1
    vast = io.BytesIO()
    Image.new("L", (5000, 4000)).save(vast, "JPEG")
    site.store.photos.add(sighting(site, 2, "may", POSE, None), vast.getvalue())
    with raises(GsmapError, code="photo_damaged"):
        export(site, tmp_path / "out")
