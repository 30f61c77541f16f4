import errno
import hashlib
import json
import pickle
from functools import partial

import numpy as np
import pytest
from raising import raises

from gsmap import formats
from gsmap.errors import ConfigError, InputError, StoreError
from gsmap.export import Params, TileRecipe, export_tiles, plan_tiles
from gsmap.merge import recipe_key
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.methods.executor import QuarantinedJob
from gsmap.types import Gaussians, Sim3

BOX = np.array([[-1.0, -1, -1], [1, 1, 1]])


def cloud(seed, n=2000):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-1, 1, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-4, 0.3, size=(n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, size=(n, 1, 3)),
    )


class Street:
    """Scenes a to e in a row, two metres apart; exports of them."""

    def __init__(self, out):
        self.out = out
        self.scenes = {name: cloud(i) for i, name in enumerate("abcde")}
        self.poses = {name: Sim3(np.eye(3), [2.0 * i, 0, 0]) for i, name in enumerate("abcde")}
        self.made = []
        self.fail_at = None

    def export(self, scenes="abcd", map_id="street", method="voxel", format="ply", **options):
        plan = plan_tiles(
            {s: self.poses[s] for s in scenes}, dict.fromkeys(scenes, BOX), tile_size_m=options.pop("tile_size_m", 4.0)
        )
        self.made = []

        def make(planned, folder):
            return partial(content, planned)

        def content(planned, progress):
            if len(self.made) == self.fail_at:
                raise KeyboardInterrupt
            self.made.append(planned.name)
            sources = [LazyScene(s, pose, lambda box, s=s: self.scenes[s]) for s, pose in planned.poses.items()]
            return merge_tile(sources, method, bounds=planned.bounds, progress=progress)

        recipe = TileRecipe(recipe_key(method), format, up=options.pop("up", "z"))
        return export_tiles(plan, make, self.out, map_id=map_id, recipe=recipe, **options)

    def files(self):
        return sorted(str(p.relative_to(self.out)) for p in self.out.rglob("*") if p.is_file())


@pytest.fixture
def street(tmp_path):
    return Street(tmp_path / "out")


def test_the_files_together_are_the_map(street):
    result = street.export(method="union")
    read = [formats.read(street.out / t.path) for t in result.tiles if t.path]
    assert sum(len(g) for g in read) == 8000 == sum(t.num_gaussians for t in result.tiles)
    assert street.files() == sorted(["tiles.json", *(t.path for t in result.tiles if t.path)])
    content = json.loads((street.out / "tiles.json").read_text())
    assert content["map_id"] == "street"
    assert len(content["tiles"]) == len(result.tiles)


def test_nothing_changed_means_nothing_done(street):
    first = street.export()
    before = {p: p.stat().st_mtime_ns for p in street.out.rglob("*")}
    again = street.export()
    assert street.made == []
    assert (again.recomputed, again.reused) == (0, first.recomputed)
    assert before == {p: p.stat().st_mtime_ns for p in street.out.rglob("*")}
    assert [t.sha256 for t in again.tiles] == [t.sha256 for t in first.tiles]


def test_a_new_capture_makes_only_the_tiles_it_touches(street):
    street.export()
    result = street.export("abcde")
    assert 0 < result.recomputed < len(result.tiles)
    assert all(t.bounds[1, 0] > 7 for t in result.tiles if "e" in t.poses)
    assert {t.path.split("/")[-1][:-4] for t in result.tiles if "e" in t.poses and t.path} <= set(street.made)
    assert all("e" in t.poses for t in result.tiles if t.path and t.path.split("/")[-1][:-4] in street.made)
    assert result.reused == len(result.tiles) - result.recomputed


def test_a_removed_capture_takes_its_tiles_along(street):
    street.export("abcde")
    result = street.export("ab")
    assert result.removed > 0
    assert street.files() == sorted(["tiles.json", *(t.path for t in result.tiles if t.path)])


def test_a_moved_scene_dirties_its_tiles_and_a_lost_file_is_made_again(street):
    first = street.export()
    street.poses["a"] = Sim3(np.eye(3), [0.05, 0, 0])
    moved = street.export()
    assert 0 < moved.recomputed < len(first.tiles)
    (street.out / moved.tiles[0].path).unlink()
    assert street.export().recomputed == 1


def test_an_interrupted_export_holds_whole_tiles_and_goes_on(street):
    street.fail_at = 3
    with pytest.raises(KeyboardInterrupt):
        street.export()
    whole = Street(street.out.parent / "whole").export()
    sha256 = {t.path: t.sha256 for t in whole.tiles}
    for file in street.files():
        if file != "tiles.json":
            formats.read(street.out / file)
            assert file in sha256
    street.fail_at = None
    rest = street.export()
    assert rest.reused == 3
    assert {t.path: t.sha256 for t in rest.tiles} == sha256


def test_a_full_disk_leaves_no_half_tile(street, monkeypatch):
    written = []
    real = formats.write

    def full(path, gaussians):
        if len(written) == 2:
            path.write_bytes(b"half a tile")
            raise InputError("cannot write") from OSError(errno.ENOSPC, "No space left on device")
        written.append(path)
        real(path, gaussians)

    monkeypatch.setattr(formats, "write", full)
    with raises(StoreError, code="disk_full"):
        street.export()
    monkeypatch.undo()
    assert len(street.files()) == 3
    assert not any("partial" in file for file in street.files())
    assert street.export().reused == 2


def test_tiles_made_elsewhere_are_the_same_files(street):
    """On a machine that does not have the folder: it sends the bytes."""

    def elsewhere(job, arguments):
        for index, (content, recipe, folder, name) in reversed(list(enumerate(arguments))):
            yield index, pickle.loads(pickle.dumps(job(content, recipe, folder + "-not-here", name)))

    one = street.export()
    other = Street(street.out.parent / "sent").export(run=elsewhere)
    assert [(t.path, t.sha256) for t in one.tiles] == [(t.path, t.sha256) for t in other.tiles]
    for tile in other.tiles:
        if tile.path:
            content = (street.out.parent / "sent" / tile.path).read_bytes()
            assert hashlib.sha256(content).hexdigest() == tile.sha256


def test_a_tile_that_cannot_be_made_is_left_out_and_tried_again_by_the_next_export(street):
    def all_but_one(job, arguments):
        for index, args in enumerate(arguments):
            yield index, QuarantinedJob("killed") if index == 1 else job(*args)

    whole = Street(street.out.parent / "whole").export()
    result = street.export(run=all_but_one)
    ((tile, reason),) = result.set_aside
    assert (reason, result.recomputed, len(result.tiles)) == ("killed", len(whole.tiles) - 1, len(whole.tiles) - 1)
    again = street.export()
    assert (street.made, again.recomputed, again.set_aside) == ([tile.name], 1, ())
    assert [(t.path, t.sha256) for t in again.tiles] == [(t.path, t.sha256) for t in whole.tiles]


def test_one_file_and_another_format_replace_what_was_there(street):
    street.export()
    result = street.export(tile_size_m=0)
    assert street.files() == ["component_0/map.ply", "tiles.json"]
    assert (result.recomputed, result.reused) == (1, 0)


def test_progress_ends_at_one(street):
    seen = []
    street.export(progress=lambda fraction, text: seen.append((fraction, text)))
    fractions = [f for f, _ in seen]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert "of" in seen[-1][1]


def test_folders_of_others_are_left_alone(street):
    street.export()
    with raises(ConfigError, code="foreign_export", match="another map"):
        street.export(map_id="elsewhere")
    (street.out / "tiles.json").write_text("{")
    with raises(InputError, code="foreign_export"):
        street.export()
    (street.out / "tiles.json").unlink()
    with raises(ConfigError, code="folder_not_empty"):
        street.export()
    assert len(street.files()) > 1
    file = street.out.parent / "file"
    file.write_text("mine")
    with raises(ConfigError, code="not_a_folder"):
        Street(file).export()
    assert file.read_text() == "mine"


def test_bad_options_are_refused_before_anything_is_written(street):
    with raises(ConfigError, code="unsupported_output", match="'obj'"):
        street.export(format="obj")
    with raises(ConfigError, code="out_of_range", match="max_shift_m"):
        street.export(params=Params(max_shift_m=-1))
    assert not street.out.exists()
    (street.out.parent / "file").write_text("mine")
    with raises(StoreError, code="store"):
        Street(street.out.parent / "file" / "out").export()


def test_files_for_viewers_have_the_map_s_up_where_trained_splats_have_it(street):
    """Minus y, as `gsmap.formats` reads every format: y down in .ply, y up in .spz."""
    z = street.export(method="union", up="z", tile_size_m=0)
    straight = formats.read(street.out / z.tiles[0].path)
    assert "up" not in json.loads((street.out / "tiles.json").read_text())["tiles"][0]
    y = street.export(method="union", up="y", tile_size_m=0)
    assert (y.recomputed, y.tiles[0].up) == (1, "y")
    turned = formats.read(street.out / y.tiles[0].path)
    np.testing.assert_array_equal(turned.means, straight.means[:, [0, 2, 1]] * [1, -1, 1])
    (entry,) = json.loads((street.out / "tiles.json").read_text())["tiles"]
    assert entry["up"] == "y"
    np.testing.assert_array_equal(entry["bounds"], z.tiles[0].bounds)
    assert street.export(method="union", up="y", tile_size_m=0).recomputed == 0


def test_progress_counts_gaussians_rather_than_cells(street):
    """Empty cells of a grid take no time, and a tile that is half done counts half."""
    seen = []
    street.export(method="union", progress=lambda fraction, text: seen.append(fraction))
    assert seen == sorted(seen)
    assert seen[-1] == pytest.approx(1.0)
    from gsmap.export.write import _ProgressReport

    said = []
    report = _ProgressReport(lambda fraction, text: said.append((round(fraction, 3), text)), [0, 999, 1000])
    report.tile_done(0)
    report.within_tile(2, 0.5, "optimizing")
    report.tile_done(1)
    report.within_tile(2, 0.1, "late")  # never back
    report.tile_done(2)
    assert [fraction for fraction, _ in said] == [0.001, 0.243, 0.743, 0.743, 1.0]
    assert said[1][1] == "tile 2 of at most 3: optimizing"
