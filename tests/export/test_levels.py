import json
from dataclasses import replace

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.export import levels
from gsmap.export.levels import Params, make_level
from gsmap.geometry.decimate import decimate
from gsmap.geometry.rotations import exp_so3
from gsmap.render import render
from gsmap.types import Cameras, Gaussians

QUICK = Params(views=16, steps=60)


def picture_wall(n: int = 6000) -> Gaussians:
    """Two by two metres of the plane z = 0, with a picture on it, of Gaussians of many sizes."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(-1, 1, (n, 2))
    colour = 0.5 + 0.4 * np.sin(np.c_[5 * xy[:, 0], 9 * xy[:, 1], 7 * xy.sum(1)])
    size = np.log(2 * n**-0.5) + rng.normal(0, 0.5, n)
    log_scales = np.c_[size, size, np.full(n, -8.0)]
    sh = ((colour - 0.5) / 0.28209479177387814)[:, None]
    z = rng.normal(0, 0.01, n)  # on one plane the order in which they are drawn would be chance
    return Gaussians(np.c_[xy, z], np.tile([1.0, 0, 0, 0], (n, 1)), log_scales, np.full(n, 1.0), sh)


def before_it(count: int, seed: int) -> Cameras:
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, 3] = np.c_[rng.uniform(-0.4, 0.4, (count, 2)), rng.uniform(-2.2, -1.6, count)]
    poses[:, :3, :3] = [exp_so3(w) for w in rng.normal(0, 0.08, (count, 3))]
    return Cameras(poses, np.tile([200.0, 200, 120, 90], (count, 1)), np.tile([240, 180], (count, 1)))


def psnr(a: Gaussians, b: Gaussians, cameras: Cameras) -> float:
    one, other = (np.clip(render(g, cameras, depth=False, dominant_id=False).colour, 0, 1) for g in (a, b))
    return float(-10 * np.log10(((one - other) ** 2).mean()))


def test_a_level_is_fitted_to_what_the_captures_see():
    """Better than merged only, from cameras that it was not fitted to."""
    g = picture_wall()
    level = make_level(g, 1500, before_it(24, seed=1), QUICK)
    merged, _ = decimate(g, 1500)
    assert len(level.gaussians) == 1500
    seen = before_it(6, seed=2).resized(120)
    assert psnr(level.gaussians, g, seen) > psnr(merged, g, seen) + 1


def test_a_fit_that_gains_nothing_is_left_out():
    """On one plane the order in which Gaussians are drawn is chance, and fitting to it makes other views worse."""
    g = picture_wall()
    g.means[:, 2] = 0
    cameras = before_it(24, seed=1)
    level = make_level(g, 3000, cameras, QUICK)
    np.testing.assert_array_equal(level.gaussians.means, decimate(g, 3000)[0].means)


def test_its_error_is_where_it_is_like_enough(monkeypatch):
    """At sixteen pixels of its error every second view has what was asked for; a coarser level has a larger error."""
    g, cameras = picture_wall(), before_it(24, seed=1)
    fine, coarse = (make_level(g, count, cameras, QUICK) for count in (3000, 300))
    assert 0 < fine.error_m < coarse.error_m
    worst, median = fine.psnr_db
    assert worst <= median
    assert median >= levels._MIN_PSNR_DB
    at = before_it(5, seed=3)
    depth = np.abs(at.T_frame_camera[:, 2, 3]).mean()
    pixels = 240 * depth / (fine.error_m / 16 * 200)
    assert psnr(fine.gaussians, g, at.resized(int(pixels))) > levels._MIN_PSNR_DB - 2
    monkeypatch.setattr(levels, "_MIN_PSNR_DB", 45.0)
    assert make_level(g, 3000, cameras, QUICK).error_m > fine.error_m


@pytest.mark.parametrize("cameras", [None, before_it(3, seed=1), "behind"])
def test_without_cameras_that_see_it_the_error_is_a_distance(cameras):
    g = picture_wall(2000)
    if cameras == "behind":
        cameras = before_it(12, seed=1)
        cameras.T_frame_camera[:, 2, 3] -= 100
    level = make_level(g, 500, cameras, QUICK)
    merged, into = decimate(g, 500)
    np.testing.assert_array_equal(level.gaussians.means, merged.means)
    assert level.psnr_db is None
    apart = np.linalg.norm(g.means - merged.means[into], axis=1)
    assert np.mean(apart <= level.error_m) == pytest.approx(0.95, abs=0.01)
    assert make_level(g, 500, before_it(12, seed=1), replace(QUICK, views=0)).psnr_db is None


def test_the_same_comes_out_again():
    g, cameras = picture_wall(2000), before_it(12, seed=1)
    one, other = (make_level(g, 400, cameras, QUICK) for _ in range(2))
    np.testing.assert_array_equal(one.gaussians.means, other.gaussians.means)
    assert (one.error_m, one.psnr_db) == (other.error_m, other.psnr_db)


@pytest.mark.parametrize("wrong", [{"views": -1}, {"steps": -1}])
def test_settings_are_checked(wrong):
    with raises(ConfigError, code="out_of_range", match=next(iter(wrong))):
        Params(**wrong)


@pytest.mark.parametrize(("upper_m", "files"), [(3.0, 1), (5.0, 1), (5.1, 3)])
def test_a_level_that_is_no_better_than_the_next_is_left_out(tmp_path, monkeypatch, upper_m, files):
    """Four tiles in a row: two levels with an error of 5 m, and one above them."""
    from gsmap.export.tileset import write_tilesets
    from gsmap.formats import tiles3d
    from gsmap.types import Sim3, Tile

    g = picture_wall(400)
    (tmp_path / "component_0").mkdir()
    (tmp_path / "tiles.json").write_text("{}")
    tiles = []
    for i in range(4):
        path = f"component_0/tile_{i:+04d}_+000_+000.glb"
        tiles3d.write_content(tmp_path / path, g[i::4])
        bounds = np.array([[i, 0, 0], [i + 1, 1, 1]], float)
        tiles.append(Tile(f"k{i}", 0, bounds, {"0" * 32: Sim3.identity()}, 100, {}, False, path, f"digest {i}", ()))
    made = []

    def make(finer, count, cameras, params):
        made.append(count)
        return levels.Level(finer[:count], 5.0 if len(finer) == 200 else upper_m)

    monkeypatch.setattr("gsmap.export.pyramid.make_level", make)
    (file,) = write_tilesets(tmp_path, tiles)
    root = json.loads(file.read_text())["root"]
    assert len(list((tmp_path / "component_0" / "levels").iterdir())) == files
    leaves = [child["content"]["uri"] for child in root["children"] if "children" not in child]
    assert leaves == ([] if files == 3 else [f"tile_{i:+04d}_+000_+000.glb" for i in range(4)])
    assert root["geometricError"] == pytest.approx(upper_m if files == 1 else 7.5)
    write_tilesets(tmp_path, tiles)
    again = json.loads(file.read_text())["root"]
    assert again["geometricError"] == root["geometricError"]
    assert [c["content"] for c in again["children"]] == [c["content"] for c in root["children"]]
    assert len(made) == 3 + (0 if files == 3 else 2)  # what was left out is made again to be left out again


def test_a_tileset_says_how_its_levels_look_and_keeps_them(tmp_path, monkeypatch):
    from gsmap.export.tileset import write_tilesets
    from gsmap.formats import tiles3d
    from gsmap.types import Sim3, Tile

    g = picture_wall(4000)
    (tmp_path / "component_0").mkdir()
    (tmp_path / "tiles.json").write_text("{}")
    tiles = []
    for i, side in enumerate((-1.0, 0.0)):
        mine = g[(g.means[:, 0] >= side) & (g.means[:, 0] < side + 1)]
        path = f"component_0/tile_{i:+04d}_+000_+000.glb"
        tiles3d.write_content(tmp_path / path, mine)
        bounds = np.array([[side, -1, -0.5], [side + 1, 1, 0.5]])
        poses = {"0" * 32: Sim3.identity()}
        tiles.append(Tile(f"k{i}", 0, bounds, poses, len(mine), {}, False, path, f"digest {i}", ()))
    made = []
    monkeypatch.setattr("gsmap.export.pyramid.make_level", lambda *a: made.append(a) or levels.make_level(*a))
    (file,) = write_tilesets(tmp_path, tiles, cameras=lambda component: before_it(16, seed=1), levels=QUICK)
    first = json.loads(file.read_text())
    assert len(made) == 1
    assert first["root"]["extras"]["psnr_worst_db"] <= first["root"]["extras"]["psnr_db"]
    assert first["root"]["geometricError"] > 0
    write_tilesets(tmp_path, tiles, cameras=lambda component: before_it(16, seed=1), levels=QUICK)
    again = json.loads(file.read_text())
    assert again["root"]["extras"] == first["root"]["extras"]
    assert again["root"]["geometricError"] == first["root"]["geometricError"]
    assert len(made) == 1
    write_tilesets(tmp_path, tiles, cameras=lambda component: None, levels=replace(QUICK, steps=61))
    assert len(made) == 2
    assert "extras" not in json.loads(file.read_text())["root"]
    # Levels that a GPU fitted are others, and do not stand for those of the CPU.
    monkeypatch.setattr("gsmap.export.pyramid.backend", lambda: "gsplat")
    write_tilesets(tmp_path, tiles, cameras=lambda component: None, levels=replace(QUICK, steps=61))
    assert len(made) == 3


def test_a_tile_that_did_not_change_is_not_read_again_to_tell_its_box(tmp_path, monkeypatch):
    from gsmap.export.tileset import Tiles3D, write_tilesets
    from gsmap.formats import tiles3d
    from gsmap.types import Sim3, Tile

    g = picture_wall(400)
    (tmp_path / "component_0").mkdir()
    (tmp_path / "tiles.json").write_text("{}")
    tiles = []
    for i in range(8):
        path = f"component_0/tile_{i:+04d}_+000_+000.glb"
        tiles3d.write_content(tmp_path / path, g[i::8])
        bounds = np.array([[i, 0, 0], [i + 1, 1, 1]], float)
        tiles.append(Tile(f"k{i}", 0, bounds, {"0" * 32: Sim3.identity()}, 50, {}, False, path, f"digest {i}", ()))
    read = []
    whole = Tiles3D.read
    monkeypatch.setattr(Tiles3D, "read", lambda self, path: read.append(path.name) or whole(self, path))

    def boxes() -> dict[str, np.ndarray]:
        """Of the tiles, by name, in a tree written over them."""
        (file,) = write_tilesets(tmp_path, tiles, levels=replace(QUICK, views=0))
        todo, found = [json.loads(file.read_text())["root"]], {}
        while todo:
            node = todo.pop()
            todo += node.get("children", [])
            found[node["content"]["uri"]] = np.array(node["boundingVolume"]["box"])
        return {name: box for name, box in found.items() if "/" not in name}

    first = boxes()
    assert set(first) == {f"tile_{i:+04d}_+000_+000.glb" for i in range(8)} <= set(read)
    assert len(read) == len(set(read))
    moved = replace(g[7::8], means=g[7::8].means + np.float32(2))
    tiles3d.write_content(tmp_path / tiles[7].path, moved)
    tiles[7] = replace(tiles[7], sha256="another")
    read.clear()
    second = boxes()
    # It, its neighbour, and the levels above: of three.
    assert {name for name in read if name.startswith("tile_")} == {tiles[6].path[12:], tiles[7].path[12:]}
    np.testing.assert_allclose(second[tiles[7].path[12:]][:3], first[tiles[7].path[12:]][:3] + 2, atol=1e-3)
    for i in range(7):
        np.testing.assert_allclose(second[tiles[i].path[12:]], first[tiles[i].path[12:]], atol=1e-9)
