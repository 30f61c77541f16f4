import json
from itertools import pairwise

import numpy as np
import pytest
from formats_cases import random_gaussians
from raising import raises

from gsmap import formats
from gsmap.errors import ConfigError, InputError
from gsmap.formats import sog, streamed_sog
from gsmap.formats.tiles3d import box_of


def leaves(node: dict) -> list[dict]:
    return [leaf for child in node.get("children", ()) for leaf in leaves(child)] or [node]


def written(folder, count: int = 3000, degree: int = 1, **options) -> dict:
    formats.write(folder / "lod-meta.json", random_gaussians(count, degree), **options)
    return json.loads((folder / "lod-meta.json").read_text())


def by_place(g):
    return g[np.lexsort(g.means.T)]


@pytest.mark.parametrize("degree", [0, 2])
def test_the_finest_level_comes_back(tmp_path, degree):
    g = random_gaussians(3000, degree)
    formats.write(tmp_path / "new" / "scene" / "lod-meta.json", g, max_per_leaf=400)
    back = formats.read(tmp_path / "new" / "scene" / "lod-meta.json")
    assert len(back) == 3000
    assert back.sh_degree == degree
    nearest = np.linalg.norm(by_place(back).means - by_place(g).means, axis=1)
    assert np.median(nearest) < 1e-3


def test_it_says_what_the_format_wants(tmp_path):
    meta = written(tmp_path, max_per_leaf=400)
    assert meta["version"] == 1
    assert meta["lodLevels"] == len(meta["counts"]) > 1
    assert meta["count"] == sum(meta["counts"])
    assert meta["counts"][0] == 3000
    assert meta["counts"][0] > max(meta["counts"][1:])
    for level, count in enumerate(meta["counts"]):
        told = [leaf["lods"][str(level)] for leaf in leaves(meta["tree"]) if str(level) in leaf["lods"]]
        assert sum(one["count"] for one in told) == count
    for name in meta["filenames"]:
        assert json.loads((tmp_path / name).read_text())["version"] == 2


def test_every_gaussian_of_every_level_is_in_one_leaf_and_in_its_box(tmp_path):
    meta = written(tmp_path, max_per_leaf=400)
    seen = {name: np.zeros(json.loads((tmp_path / name).read_text())["count"], int) for name in meta["filenames"]}
    for leaf in leaves(meta["tree"]):
        low, high = np.array(leaf["bound"]["min"]), np.array(leaf["bound"]["max"])
        for one in leaf["lods"].values():
            name = meta["filenames"][one["file"]]
            run = slice(one["offset"], one["offset"] + one["count"])
            seen[name][run] += 1
            box = box_of(sog.read(tmp_path / name)[run])
            assert (box[0] >= low - 0.05).all()
            assert (box[1] <= high + 0.05).all()
    assert all((count == 1).all() for count in seen.values())


def test_coarser_levels_have_larger_errors_and_none_is_finer_than_the_next(tmp_path):
    meta = written(tmp_path, max_per_leaf=200)
    for leaf in leaves(meta["tree"]):
        errors = [leaf["lods"][level]["error_m"] for level in sorted(leaf["lods"], key=int)]
        assert errors[0] == 0
        assert all(fine < coarse for fine, coarse in pairwise(errors))


def test_a_file_is_of_one_level(tmp_path):
    """Leaves lie at different depths here; splat-transform counts each file at one level."""
    meta = written(tmp_path, max_per_leaf=500)
    levels = {}
    for leaf in leaves(meta["tree"]):
        for level, one in leaf["lods"].items():
            assert levels.setdefault(one["file"], level) == level


def test_a_scene_of_one_leaf(tmp_path):
    meta = written(tmp_path, count=50)
    assert meta["lodLevels"] == 1
    assert len(formats.read(tmp_path / "lod-meta.json")) == 50


def test_the_same_is_written_again_and_an_older_one_stays_whole(tmp_path):
    written(tmp_path, max_per_leaf=400)
    first = {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    written(tmp_path, max_per_leaf=400)
    assert {p.relative_to(tmp_path): p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == first


def test_an_environment_is_left_out_and_that_is_said(tmp_path):
    meta = written(tmp_path, count=50)
    meta["environment"] = meta["filenames"][0]
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    assert len(formats.read(tmp_path / "lod-meta.json")) == 50
    assert "environment" in formats.info(tmp_path / "lod-meta.json").notes[0]


def test_a_leaf_without_its_finest_level_gives_the_next(tmp_path):
    meta = written(tmp_path, max_per_leaf=400)
    expected = 0
    for leaf in leaves(meta["tree"]):
        del leaf["lods"]["0"]
        expected += leaf["lods"][min(leaf["lods"], key=int)]["count"] if leaf["lods"] else 0
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    assert len(formats.read(tmp_path / "lod-meta.json")) == expected > 0


@pytest.mark.parametrize(
    ("damage", "code", "match"),
    [
        (lambda m: m.update(version=2), "unsupported_version", "it has version 2"),
        (lambda m: m.pop("tree"), "unsupported_version", r"it has version 1 and \[.*'lodLevels', 'version'\]"),
        (lambda m: m.update(tree=3), "wrong_file_type", "TypeError"),
        (lambda m: m.update(filenames=["../../etc/passwd"] * 99), "content_outside_folder", "'../../etc/passwd'"),
        (lambda m: m.update(filenames=["none/meta.json"] * 99), "content_missing", "'none/meta.json'"),
        (lambda m: m.update(filenames=[]), "rows_outside_file", "file 0 of 0"),
        (lambda m: leaves(m["tree"])[0]["lods"]["0"].update(offset=-1), "rows_outside_file", "from -1"),
        (
            lambda m: leaves(m["tree"])[0]["lods"]["0"].update(count=10**9),
            "rows_outside_file",
            "Gaussians 0 to 1000000000",
        ),
        (
            lambda m: leaves(m["tree"])[0]["lods"].update({"0": leaves(m["tree"])[1]["lods"]["0"]}),
            "rows_outside_file",
            "another leaf's",
        ),
        (lambda m: leaves(m["tree"])[0].update(lods={"0": 5}), "wrong_file_type", "TypeError"),
        (lambda m: [leaf.update(lods={}) for leaf in leaves(m["tree"])], "no_gaussians", "no Gaussians"),
    ],
)
def test_damage_is_named(tmp_path, damage, code, match):
    meta = written(tmp_path, count=600, degree=0, max_per_leaf=200)
    damage(meta)
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    with raises(InputError, code=code, match=match):
        formats.read(tmp_path / "lod-meta.json")


def test_a_tree_without_end_is_refused(tmp_path):
    meta = written(tmp_path, count=50)
    for _ in range(100):
        meta["tree"] = {"bound": meta["tree"]["bound"], "children": [meta["tree"]]}
    (tmp_path / "lod-meta.json").write_text(json.dumps(meta))
    with raises(InputError, code="nested_too_deeply"):
        formats.read(tmp_path / "lod-meta.json")


def test_what_makes_no_sense_is_refused(tmp_path):
    with raises(ConfigError, code="out_of_range", match="max_per_leaf"):
        formats.write(tmp_path / "lod-meta.json", random_gaussians(3), max_per_leaf=0)
    with raises(InputError, code="no_gaussians"):
        formats.write(tmp_path / "lod-meta.json", formats.Gaussians.empty())


def test_parts_are_those_that_are_nearest_to_each_box():
    g = random_gaussians(500, 0)
    cells = np.array([[[-5, -5, -5], [0, 5, 5]], [[0, -5, -5], [2, 5, 5]]], float)
    ordered, parts = streamed_sog.parted(g, cells)
    assert parts == ((g.means[:, 0] <= 0).sum(), (g.means[:, 0] > 0).sum())
    assert (ordered.means[: parts[0], 0] <= 0).all()
