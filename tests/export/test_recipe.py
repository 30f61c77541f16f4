"""What makes a tile dirty, and nothing else."""

import json
import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.export import TileRecipe, dirty_reason, export_tiles, plan_tiles
from gsmap.merge import Params, default_params, merge, methods, reach_m, recipe_key, uses_dates, with_steps
from gsmap.merge.mergers import tto, voxel
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.methods import family
from gsmap.settings import changed, leaves
from gsmap.types import Cameras, Gaussians, MergeResult, PosedScene, Sim3

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])
FAR = "a"  # touches none of the tiles that the last scene lies in


def cloud(seed, n=600):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-4, 0.3, size=(n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, size=(n, 1, 3)),
    )


class Row:
    """Scenes a to d in a row, four metres apart, exported to a folder: as the map does it, without a map."""

    def __init__(self, out):
        self.out = out
        self.scenes = {name: cloud(i) for i, name in enumerate("abcd")}
        self.poses = {name: Sim3(np.eye(3), [4.0 * i, 0.5, 0.5]) for i, name in enumerate("abcd")}
        self.dates = {name: f"2026-01-0{i + 1}T00:00:00+00:00" for i, name in enumerate("abcd")}
        self.made = []

    def export(self, merging=None, **options):
        merging = merging or Params("voxel")
        method, params = merging.method, merging.chosen()
        recipe = TileRecipe(recipe_key(method, params), **options)
        if uses_dates(method, params):
            recipe = recipe.with_dates(self.dates)
        plan = plan_tiles(self.poses, dict.fromkeys(self.poses, BOX), tile_size_m=4, reach_m=reach_m(method, params))
        self.made = []

        def make(planned, progress):
            self.made.append(planned.name)
            lazy = [
                LazyScene(s, pose, lambda box, s=s: self.scenes[s], captured_at=self.dates[s])
                for s, pose in planned.poses.items()
            ]
            return merge_tile(lazy, method, params, bounds=planned.bounds)

        return export_tiles(plan, lambda planned, folder: partial(make, planned), self.out, map_id="row", recipe=recipe)

    def entries(self):
        return json.loads((self.out / "tiles.json").read_text())["tiles"]


@pytest.fixture
def row(tmp_path):
    return Row(tmp_path / "out")


def of_scene(result, scene):
    return {path.split("/")[-1].split(".")[0] for path in (t.path for t in result.tiles if scene in t.poses)} - {""}


def test_another_date_makes_the_tiles_of_its_scene_dirty_where_the_merger_uses_dates(row):
    first = row.export(Params("tto"))
    row.dates["d"] = "2025-01-01T00:00:00+00:00"
    again = row.export(Params("tto"))
    assert again.recomputed == sum("d" in t.poses for t in first.tiles) > 0
    assert again.reused == sum("d" not in t.poses for t in first.tiles) > 0
    undated = Params("tto").mergers.with_params("tto", tto.Params(prefer="both"))
    row.export(Params("tto", undated))
    row.dates["d"] = None
    assert row.export(Params("tto", undated)).recomputed == 0


def test_dates_are_nothing_to_a_merger_that_does_not_use_them(row):
    row.export()
    row.dates["d"] = "2025-01-01T00:00:00+00:00"
    assert row.export().recomputed == 0


def test_another_version_of_the_merger_makes_all_of_its_tiles_again(row, monkeypatch):
    first, was = row.export(), voxel.VERSION
    monkeypatch.setattr(tto, "VERSION", 99)
    assert row.export().recomputed == 0
    monkeypatch.setattr(voxel, "VERSION", 99)
    planned = plan_tiles(row.poses, dict.fromkeys(row.poses, BOX), tile_size_m=4, reach_m=0.01)[0]
    assert f"merger.voxel {was}, now 99" in dirty_reason(planned, first.tiles[0], TileRecipe(recipe_key("voxel")))
    assert row.export().recomputed == len(first.tiles)
    monkeypatch.setattr("gsmap.merge.VERSION", 99)
    assert row.export().recomputed == len(first.tiles)
    monkeypatch.setattr("gsmap.export.recipe.VERSION", 99)
    assert row.export().recomputed == len(first.tiles)
    assert row.export().recomputed == 0


def test_a_setting_of_the_merger_counts_and_one_of_another_does_not(row):
    first = row.export()
    other = changed(Params("voxel"), {"mergers.tto.kept_fraction": 0.5, "mergers.tto.momentum": 0.01})
    assert row.export(other).recomputed == 0
    mine = changed(other, {"mergers.voxel.voxel_m": 0.02})
    assert row.export(mine).recomputed == len(first.tiles)
    assert row.export(mine).recomputed == 0
    assert row.entries()[0]["recipe"]["settings"] == {"voxel_m": 0.02, "prefer": "both"}


def test_every_setting_of_a_merger_is_in_its_recipe():
    before = recipe_key("tto")
    for leaf in leaves(tto.Params()):
        value = leaf.value
        if isinstance(value, str):
            new = "best"
        else:
            new = (
                not value
                if isinstance(value, bool)
                else 3
                if value is None
                else value * 2
                if value < 0.5
                else value / 2
            )
        new = type(value)(new) if isinstance(value, int) and not isinstance(value, bool) else new
        new = 1 if value == 0 and new == 0 else new
        after = recipe_key("tto", changed(tto.Params(), {leaf.name: new}))
        assert after.digest != before.digest, leaf.name
        assert recipe_key("voxel").digest == recipe_key("voxel", default_params("voxel")).digest
    assert before.backend in ("native", "gsplat")
    assert {recipe_key(method).backend for method in ("union", "voxel", "distance")} == {""}


def test_another_scale_of_a_scene_makes_its_tiles_again_and_no_others(row):
    first = row.export()
    row.poses["d"] = Sim3(np.eye(3), row.poses["d"].translation, 1.02)
    again = row.export()
    assert of_scene(again, "d") <= set(row.made)
    assert of_scene(first, FAR) & set(row.made) == set()


def test_format_packed_provenance_and_budget_are_part_of_what_a_tile_is(row):
    count = len(row.export().tiles)
    tileset = {"format": "3dtiles"}
    plain = tileset | {"uncompressed": True}
    for options in ({"provenance": True}, {"budget_s": 60.0}, {"format": "glb"}, plain, tileset):
        assert row.export(**options).recomputed == count
        assert row.export(**options).recomputed == 0
    with raises(ConfigError, code="unsupported_output", match="provenance"):
        TileRecipe(recipe_key("voxel"), "spz", provenance=True)
    with raises(ConfigError, code="unsupported_output", match="uncompressed"):
        TileRecipe(recipe_key("voxel"), "spz", uncompressed=True)


def test_notes_recipe_and_key_are_in_the_manifest_and_in_the_answer(row):
    result = row.export(Params("tto"))
    entry = row.entries()[0]
    assert entry["notes"] == ["no camera observes the tile, so it is not optimized"] == list(result.tiles[0].notes)
    assert entry["key"] == result.tiles[0].key
    assert entry["recipe"] == recipe_key("tto").to_json() == result.tiles[0].recipe
    assert result.notes == (f"{len(result.tiles)} tiles: no camera observes the tile, so it is not optimized",)
    again = row.export(Params("tto"))
    assert again.notes == ()
    assert again.tiles[0].notes == result.tiles[0].notes


def test_a_note_about_one_tile_names_it(row):
    plan = plan_tiles(row.poses, dict.fromkeys(row.poses, BOX), tile_size_m=4)

    def make(planned, folder):
        notes = ("the roof is missing",) if planned is plan[2] else ()
        return lambda progress: MergeResult(row.scenes["a"], np.zeros(len(row.scenes["a"]), np.int32), notes=notes)

    result = export_tiles(plan, make, row.out, map_id="row", recipe=TileRecipe(recipe_key("union")))
    assert result.notes == (f"component_0/{plan[2].name}: the roof is missing",)


def test_a_folder_of_an_older_gsmap_is_made_again_and_says_so(row):
    first = row.export()
    path = row.out / "tiles.json"
    content = json.loads(path.read_text())
    assert content["version"] == 2
    for entry in content["tiles"]:
        del entry["recipe"], entry["notes"]
        entry["method"] = "voxel [{}]"
    path.write_text(json.dumps(content | {"version": 1}))
    result = row.export()
    assert result.recomputed == len(first.tiles)
    assert "made again" in result.notes[0]
    assert [t.sha256 for t in result.tiles] == [t.sha256 for t in first.tiles]
    assert row.export().notes == ()
    path.write_text(json.dumps(content | {"version": 3}))
    with raises(ConfigError, code="export_version"):
        row.export()


def test_an_older_folder_is_made_again_even_where_it_was_left_half_way(row, monkeypatch):
    first = row.export()
    path = row.out / "tiles.json"
    content = json.loads(path.read_text())
    for entry in content["tiles"]:
        del entry["recipe"], entry["notes"]
        entry["method"] = ""
    path.write_text(json.dumps(content | {"version": 1}))
    real, made = merge_tile, []

    def stopped(*arguments, **options):
        if len(made) == 2:
            raise KeyboardInterrupt
        made.append(1)
        return real(*arguments, **options)

    monkeypatch.setitem(globals(), "merge_tile", stopped)
    with pytest.raises(KeyboardInterrupt):
        row.export()
    monkeypatch.undo()
    assert row.export().recomputed == len(first.tiles) - 2


@pytest.fixture
def added(tmp_path, monkeypatch):
    """The merger of `added_merger`, as if its package were installed."""
    about = tmp_path / "site" / "added-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: added\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("[gsmap.mergers]\nmost_opaque = added_merger\n")
    monkeypatch.syspath_prepend(about.parent)
    return "most_opaque"


def test_a_merger_of_another_package_merges_exports_and_has_settings(added, row):
    assert added in methods()
    scenes = [PosedScene(cloud(0), scene_id="a"), PosedScene(cloud(0), scene_id="b")]
    assert len(merge(scenes, added, default_params(added)).gaussians) < len(scenes[0].gaussians)
    merging = changed(Params(added), {f"mergers.{added}.cell_m": 0.05})
    first = row.export(merging)
    assert first.tiles[0].recipe["version"] == {"merge": 1, "merger.most_opaque": 1}
    assert first.tiles[0].recipe["settings"] == {"cell_m": 0.05, "rounds": 0}
    assert "centroids at [[0.0, 0.5, 0.5]" in first.tiles[0].notes[0]
    assert row.export(merging).recomputed == 0
    assert row.export(changed(merging, {f"mergers.{added}.rounds": 1})).recomputed == len(first.tiles)
    assert with_steps(added, None, 2).rounds == 2


def test_steps_are_the_setting_that_the_contract_names():
    assert with_steps("tto", tto.Params(kept_fraction=0.5), 7) == tto.Params(kept_fraction=0.5, steps=7)
    with raises(ConfigError, code="option_not_applicable"):
        with_steps("voxel", None, 7)
    with raises(ConfigError, code="out_of_range", match="steps .*-1"):
        with_steps("tto", None, -1)


@pytest.mark.parametrize("method", ["tto", "voxel", "union", "distance"])
def test_a_scene_without_anything_in_it_merges(method):
    nobody = PosedScene(Gaussians.empty(), Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2))), "z")
    result = merge([PosedScene(cloud(0), scene_id="a"), nobody], method)
    assert len(result.gaussians) > 400
    lazy = [
        LazyScene("a", Sim3.identity(), lambda box: cloud(0)),
        LazyScene("z", Sim3.identity(), lambda box: Gaussians.empty()),
    ]
    assert len(merge_tile(lazy, method, bounds=BOX).gaussians) > 400


def test_recipes_are_computed_without_torch():
    script = (
        "import sys\nfrom gsmap.merge import Params, recipe_key\nfrom gsmap.merge.mergers import tto\n"
        "[recipe_key(m, Params().mergers[m]) for m in Params().mergers]\n"
        "heavy = {'torch', 'gtsam', 'open3d', 'onnxruntime', 'scipy', 'sqlalchemy'}\n"
        "assert not heavy & {m.split('.')[0] for m in sys.modules}"
    )
    subprocess.run([sys.executable, "-c", script], check=True)


def test_the_family_keeps_the_contract():
    for name in family("merger").names():
        merger = family("merger").get(name)
        params = merger.Params()
        assert 0 <= merger.reach_m(params) <= merger.reading_m(params, False) <= merger.reading_m(params, True)
        assert merger.STEPS is None or hasattr(params, merger.STEPS)
        assert isinstance(merger.RENDERS, bool)
        assert isinstance(merger.uses_dates(params), bool)
        assert replace(params) == params
