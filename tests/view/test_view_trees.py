"""Trees and sketches of scenes: what they hold, how honest their errors are, and the cache that keeps them."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from scipy.spatial import cKDTree
from view_room import A, blob

from gsmap.errors import InputError
from gsmap.formats import tiles3d
from gsmap.geometry.boxes import robust_box
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.voxels import optical_depths, projected_areas
from gsmap.types import Gaussians, Scene
from gsmap.view import ViewScene
from gsmap.view.levels import extent_of
from gsmap.view.tree_cache import TreeCache
from gsmap.view.trees import Sketch, TreeParams, shown, sketch, write_tree

SMALL = TreeParams(leaf_gaussians=500, coarsening=8, root_gaussians=64)


def light(g: Gaussians) -> float:
    """What all of them stop together."""
    return float((optical_depths(g) * projected_areas(g.scales)).sum())


def nodes(tile: dict, depth: int = 0):
    yield tile, depth
    for child in tile.get("children", ()):
        yield from nodes(child, depth + 1)


def test_leaves_are_the_scene_and_levels_stop_as_much_light(tmp_path):
    g = blob(1, 6000, sh_degree=1)
    root = write_tree(tmp_path / "tree", g, SMALL)
    back = tiles3d.read(tmp_path / "tree" / "tileset.json")
    kept = shown(g)
    assert len(back) == len(kept)
    assert cKDTree(back.means).query(kept.means)[0].max() < 1e-4
    assert back.sh.shape == kept.sh.shape

    tileset = json.loads((tmp_path / "tree" / "tileset.json").read_bytes())
    found = list(nodes(tileset["root"]))
    leaves = [tile for tile, _ in found if "children" not in tile]
    assert len(leaves) > 8
    assert {tile["geometricError"] for tile in leaves} == {0.0}
    for tile, _ in found:
        content = tiles3d.read_content(tmp_path / "tree" / tile["content"]["uri"])
        assert len(content) <= SMALL.leaf_gaussians
        for child in tile.get("children", ()):
            assert child["geometricError"] < tile["geometricError"]
    coarse = tiles3d.read_content(tmp_path / "tree" / root.uri)
    assert len(coarse) <= SMALL.root_gaussians
    assert 0.7 < light(coarse) / light(kept) < 1.3


def test_the_error_of_a_level_is_how_far_its_gaussians_lie_from_the_originals(tmp_path):
    g = blob(2, 4000)
    write_tree(tmp_path / "tree", g, SMALL)
    tileset = json.loads((tmp_path / "tree" / "tileset.json").read_bytes())
    kept = shown(g)
    for tile, _ in nodes(tileset["root"]):
        if "children" not in tile:
            continue
        level = tiles3d.read_content(tmp_path / "tree" / tile["content"]["uri"])
        leaves = [t for t, _ in nodes(tile) if "children" not in t]
        under = np.concatenate([tiles3d.read_content(tmp_path / "tree" / t["content"]["uri"]).means for t in leaves])
        apart = cKDTree(level.means).query(under)[0]
        # The nearest one is no farther than the one that stands for it.
        assert np.quantile(apart, 0.9) <= tile["geometricError"] + 1e-3
        assert tile["geometricError"] <= 2.5 * np.linalg.norm(np.ptp(kept.means, axis=0))


def test_a_few_strays_widen_the_box_of_a_tile_and_not_its_core(tmp_path):
    g = blob(3, 5000)
    g.means[0] = [500, 500, 500]
    g.means[1] = [-300, 0, 0]
    from gsmap.geometry.morton import morton_order

    g = g[morton_order(g.means)]
    root = write_tree(tmp_path / "tree", g, SMALL)
    assert np.abs([root.extras[f"core_{axis}{end}"] for axis in "xyz" for end in (0, 1)]).max() < 3
    assert root.box[0, 0] < -300
    assert (root.box[1] > 500).all()
    assert np.abs(sketch(g, 256).box).max() < 3
    points = np.r_[np.random.default_rng(0).uniform(0, 1, (1000, 3)), [[50, 50, 50]]]
    box = robust_box(points)
    assert box.min() >= 0
    assert box.max() <= 1
    weights = np.r_[np.ones(1000), 5000]
    assert robust_box(points, weights)[1].tolist() == [50, 50, 50]


def test_a_room_is_measured_whatever_its_frame_is_turned(tmp_path):
    """One of 6 x 3 x 2.5 m in a map whose up is no axis, with a few strays far above it."""
    rng = np.random.default_rng(0)
    flat = rng.uniform(0, (6, 3), (2000, 2))
    room = np.concatenate([np.c_[flat, np.repeat([0, 2.5], 1000)], [[3, 1, 40.0]] * 20])
    turn = exp_so3(np.array([0.5, -0.7, 0.2])) @ exp_so3(np.array([0, 0, 0.6]))
    up = turn @ [0, 0, 1.0]
    g = replace(blob(0, len(room)), means=(room @ turn.T).astype(np.float32))
    scene = Scene("0" * 32, "room", len(g), 0, 0, np.stack([g.means.min(0), g.means.max(0)]))
    extent = extent_of([(ViewScene(scene, "k", None, up), Sketch(g, scene.bounds))], up)
    np.testing.assert_allclose(extent.size, (6, 3, 2.5), rtol=0.05)  # 2 % are left out on every side
    for corners in (extent.frame, *extent.corners):
        own = corners @ turn  # back where the room is upright, along its walls
        np.testing.assert_allclose(own[:4, 2], 0, atol=0.01)
        np.testing.assert_allclose(own[4:, 2], 2.5, atol=0.01)
        np.testing.assert_allclose(np.ptp(own, axis=0), (6, 3, 2.5), rtol=0.05)
    assert extent.has_ceiling
    own = extent.outline @ turn
    np.testing.assert_allclose(own[:, 2], 0, atol=0.01)
    assert (np.ptp(own, axis=0)[:2] > (5.5, 2.7)).all()
    bent = replace(blob(2, 4000), means=(np.c_[rng.uniform(0, (6, 3), (4000, 2)), np.zeros(4000)]).astype(np.float32))
    bent = bent[(bent.means[:, 0] < 3) | (bent.means[:, 1] < 1)]  # a quarter is missing, and the outline cuts across
    found = extent_of([(ViewScene(scene, "k", None), Sketch(bent, scene.bounds))], [0, 0, 1.0]).outline
    assert (found[:, 0] + found[:, 1]).max() < 7.2, "less than the corner of the box at 9"
    floor = ViewScene(replace(scene, bounds=scene.bounds), "k", None, up), Sketch(g[:1000], scene.bounds)
    wall = blob(1, 300)
    wall = replace(wall, means=(np.c_[np.zeros(300), rng.uniform(0, (3, 2.5), (300, 2))] @ turn.T).astype(np.float32))
    yard = ViewScene(scene, "k", None, up), Sketch(Gaussians.concatenate([g[:1000], wall]), scene.bounds)
    assert not extent_of([yard], up).has_ceiling, "walls about a yard are no ceiling"
    assert not extent_of([floor], up).has_ceiling


def test_what_cannot_be_seen_is_left_out_and_nothing_at_all_is_said(tmp_path):
    g = blob(4, 300)
    g.logit_opacities[:100] = -20
    g.means[100] = np.nan
    assert len(shown(g)) <= 199
    none = blob(4, 300)
    none.logit_opacities[:] = -20
    for make in (lambda: write_tree(tmp_path / "none", none, SMALL), lambda: sketch(none, 100)):
        with raises(InputError, code="no_opaque_gaussians"):
            make()


def test_points_that_coincide_and_single_ones_make_a_tree(tmp_path):
    g = blob(5, 3000)
    g.means[:] = 1.0
    write_tree(tmp_path / "same", g, SMALL)
    assert len(tiles3d.read(tmp_path / "same" / "tileset.json")) == len(shown(g))
    one = blob(6, 4)
    one.logit_opacities[:] = 3
    write_tree(tmp_path / "one", one, SMALL)
    assert len(tiles3d.read(tmp_path / "one" / "tileset.json")) == 4


def test_a_sketch_is_few_gaussians_that_stop_as_much_light():
    g = blob(7, 60_000)
    g.log_scales[:] -= 2  # or they hide one another: what is nearly opaque cannot stop more
    made = sketch(g, 512)
    assert 100 < len(made.gaussians) <= 512
    assert made.gaussians.sh.shape[1] == 1
    assert 0.6 < light(made.gaussians) / light(shown(g)) < 1.5


# --- the cache -------------------------------------------------------------------------------------------------------


def kept_tree(cache: TreeCache, key: str, seed: int = 1):
    return cache.make_tree(key, lambda folder: write_tree(folder, blob(seed, 3000), SMALL))


def test_an_entry_appears_whole_and_a_damaged_one_counts_as_missing(tmp_path):
    cache = TreeCache(tmp_path / "cache", 1 << 30)
    assert cache.tree("a") is None
    with pytest.raises(InputError):
        cache.make_tree("a", lambda folder: (folder.mkdir(), _fail()))
    assert cache.tree("a") is None
    assert list((tmp_path / "cache").iterdir()) == []
    folder = kept_tree(cache, "a")
    assert cache.tree("a") == folder
    assert oct((tmp_path / "cache").stat().st_mode)[-3:] == "700"
    uri = json.loads((folder / "tileset.json").read_bytes())["root"]["content"]["uri"]
    assert cache.tile("a", uri) == (folder / uri).read_bytes()
    for name in ("../secret", "tiles/../../x.glb", "tileset.json", "tiles/none-0123456789abcdef.glb"):
        assert cache.tile("a", name) is None
    # One byte of a tile: it is not served, and the tree is made again.
    data = bytearray((folder / uri).read_bytes())
    data[-1] ^= 1
    (folder / uri).write_bytes(data)
    assert cache.tile("a", uri) is None
    assert cache.tree("a") is None

    for damage in ("tileset.json", "files.json", uri):
        folder = kept_tree(cache, "a")
        (folder / damage).write_bytes(b"{}")
        assert cache.tree("a") is None
        folder = kept_tree(cache, "a")
        (folder / damage).unlink()
        assert cache.tree("a") is None


def _fail():
    raise InputError("no")


def test_two_who_make_the_same_tree_end_with_one(tmp_path):
    cache, other = TreeCache(tmp_path / "cache", 1 << 30), TreeCache(tmp_path / "cache", 1 << 30)

    def slower(folder):
        kept_tree(other, "a")
        write_tree(folder, blob(1, 3000), SMALL)

    assert cache.tree("a") is None
    cache.make_tree("a", slower)
    assert cache.tree("a") is not None
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["a.tree"]


def test_a_sketch_comes_back_and_a_damaged_one_does_not(tmp_path):
    cache = TreeCache(tmp_path / "cache", 1 << 30)
    made = sketch(blob(7, 3000), 200)
    cache.keep_sketch("a", 200, made)
    back = cache.sketch("a", 200)
    np.testing.assert_array_equal(back.gaussians.means, made.gaussians.means)
    np.testing.assert_allclose(back.box, made.box, rtol=1e-6)
    assert cache.sketch("a", 100) is None
    path = tmp_path / "cache" / "a.200.sketch"
    whole = path.read_bytes()
    for damaged in (
        b"",
        whole[:100],
        whole[:-3],
        b"x" * len(whole),
        whole[:-4] + np.float32(np.nan).tobytes(),
    ):
        path.write_bytes(damaged)
        assert cache.sketch("a", 200) is None


def test_what_was_used_longest_ago_goes_first_and_what_died_in_the_making(tmp_path):
    cache = TreeCache(tmp_path / "cache", 1 << 30)
    size = sum(path.stat().st_size for path in kept_tree(cache, "a").rglob("*.glb"))
    for i, key in enumerate("bc"):
        kept_tree(cache, key, seed=2 + i)
    for i, key in enumerate("abc"):
        os.utime(tmp_path / "cache" / f"{key}.tree", (i + 1, i + 1))
    cache.tree("a")  # used just now
    dead = tmp_path / "cache" / ".dead"
    dead.mkdir()
    os.utime(dead, (1, 1))
    young = tmp_path / "cache" / ".young"
    young.mkdir()
    small = TreeCache(tmp_path / "cache", int(3.3 * size))
    kept_tree(small, "d", seed=5)
    names = {path.name for path in (tmp_path / "cache").iterdir()}
    assert names == {"a.tree", "c.tree", "d.tree", ".young"}


def test_a_scene_is_forgotten_with_all_that_is_kept_of_it(tmp_path):
    cache = TreeCache(tmp_path / "cache", 1 << 30)
    kept_tree(cache, f"{A}-v1")
    kept_tree(cache, f"{A}-t01234567-v1")
    cache.keep_sketch(f"{A}-v1", 100, sketch(blob(1), 100))
    kept_tree(cache, "b")
    assert cache.num_files(A) > 3
    cache.forget(A)
    assert cache.num_files(A) == 0
    assert [path.name for path in (tmp_path / "cache").iterdir()] == ["b.tree"]
    TreeCache(tmp_path / "none", 1).forget(A)
    assert TreeCache(tmp_path / "none", 1).num_files(A) == 0


def test_a_tree_of_a_scene_costs_a_few_seconds_a_million(tmp_path):
    g = blob(1, 60_000, sh_degree=1)
    start = time.process_time()
    write_tree(tmp_path / "tree", g)
    assert (time.process_time() - start) / len(g) * 1e6 < 15  # 3 on this machine when idle
