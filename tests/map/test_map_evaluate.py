"""A stored map against the truth: what is loaded and scored, and exported tiles against photographs."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from raising import raises

import gsmap
import gsmap.map
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.evaluate.images import psnr
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.methods import RecipeKey
from gsmap.render import render
from gsmap.types import Cameras, EdgeOutcome, Gaussians, PoseGraph, Registration, ScenePose, Sim3

INFORMATION = np.diag([1e4] * 6 + [1e12])
WALLS = {"a": (-1.5, 0.5), "b": (-0.5, 1.5), "far": (20.0, 22.0)}
S_SCENE_WORLD = {
    "a": Sim3(exp_so3([0.1, -0.4, 2.0]), [3.0, 1, -2]),
    "b": Sim3(exp_so3([1.0, 0.3, -0.2]), [-7.0, 0, 4]),
    "far": Sim3(exp_so3([-0.3, 0.8, 0.5]), [1.0, 9, 9]),
}
S_MAP_WORLD = Sim3(exp_so3([0.2, 0, 1.0]), [5.0, 5, 0])


def wall(seed: int, low: float, high: float) -> Gaussians:
    """A flat wall with a grain of its own."""
    rng = np.random.default_rng(seed)
    x, y = (v.ravel() for v in np.meshgrid(np.arange(low, high, 0.05), np.arange(-0.6, 0.6, 0.05)))
    n, sh = len(x), np.zeros((len(x), 1, 3))
    sh[:, 0] = 1.5 * np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * x + 2 * y)], axis=1) + rng.normal(
        0, 0.5, (n, 3)
    )
    means = np.stack([x, y, rng.normal(0, 0.002, n)], axis=1)
    return Gaussians(means, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(0.04)), np.full(n, 3.0), sh)


def facing(low: float, high: float, name: str) -> Cameras:
    xs = np.linspace(low + 0.5, high - 0.5, 4)
    T = np.tile(np.eye(4), (len(xs), 1, 1))
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = xs, [0, 0.1, -0.1, 0], -1.0
    size = np.tile([64, 48], (len(xs), 1))
    names = tuple(f"{name}_{k}" for k in range(len(xs)))
    return Cameras(T, np.tile([60.0, 60, 32, 24], (len(xs), 1)), size, names)


def key(*inputs: str) -> RecipeKey:
    return RecipeKey("register", "test", {"register": 1}, {}, "native", inputs)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of two walls that overlap and one far off in the same frame, its truth, an export and pictures of that."""
    root = tmp_path_factory.mktemp("evaluate")
    (root / "truth").mkdir()
    with gsmap.map.create(root / "site.gsmap") as m:
        ids = {}
        for seed, (name, (low, high)) in enumerate(WALLS.items()):
            S = S_SCENE_WORLD[name]
            gaussians = transform_gaussians(wall(seed, low, high), S)
            scene, _ = m.store.scenes.add(gaussians, transform_cameras(facing(low, high, name), S), name=name)
            ids[name] = scene.id
            (root / "truth" / f"{name}.json").write_text(json.dumps({"T_scene_world": S.matrix().tolist()}))
        for a, b in (("a", "b"), ("b", "far")):
            true = S_SCENE_WORLD[a] @ S_SCENE_WORLD[b].inverse()
            m.store.registrations.save(
                Registration(ids[a], ids[b], "accepted", S_target_source=true, information=INFORMATION), key(a, b)
            )
        m.store.revisions.save(
            PoseGraph(
                {ids[n]: ScenePose(ids[n], S_MAP_WORLD @ S.inverse(), 0, "placed") for n, S in S_SCENE_WORLD.items()},
                {(ids["a"], ids["b"]): EdgeOutcome("used"), (ids["b"], ids["far"]): EdgeOutcome("used")},
            )
        )
        m.export(root / "tiles", format="ply", tile_size_m=2.0, merge="voxel")
        content = Gaussians.concatenate([gsmap.read(p) for p in sorted((root / "tiles").rglob("*.ply"))])
        for name in WALLS:
            gaussians, cameras = m.read(name, frame="map")
            (root / "images" / name).mkdir(parents=True)
            for k, picture in enumerate(render(content, cameras).colour):
                pixels = np.round(np.clip(picture, 0, 1) * 255).astype(np.uint8)
                Image.fromarray(pixels).save(root / "images" / name / f"{cameras.names[k]}.png")
    return root


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "made"))


def test_a_right_map_is_found_right(made: Path) -> None:
    with gsmap.open(made / "site.gsmap") as m:
        report = m.evaluate(made / "truth")
    assert report.verdict.startswith("3 of 3 placed, ATE ")
    assert report.ate_m < 1e-6
    assert report.edges_verdict == "0 of 2 false, beyond 1 deg or 0.05 m"
    shared = report.edges[0].true_overlap
    assert shared == pytest.approx(0.54, abs=0.02)  # a metre of two, and 8 cm beyond
    assert [(b.num_pairs, b.num_right) for b in report.bands] == [(2, 1), (0, 0), (0, 0), (1, 1)]
    assert report.nees[0].median == pytest.approx(0, abs=1e-6)


def test_edges_that_a_person_rejected_are_not_scored(copy: Path) -> None:
    with gsmap.open(copy / "site.gsmap") as m:
        m.reject("a:b")
        report = m.evaluate(copy / "truth")
    assert [row.pair for row in report.edges] == ["b:far"]
    assert report.bands[3].recall == 0
    assert any("a:b" in note and "no longer accepted" in note for note in report.notes)


def test_a_map_that_failed_says_so(copy: Path) -> None:
    with gsmap.open(copy / "site.gsmap") as m:
        m.reject("a:b")
        m.reject("b:far")
        ids = [scene.id for scene in m.scenes()]
        m.store.revisions.save(PoseGraph({s: ScenePose(s, Sim3.identity(), k, "isolated") for k, s in enumerate(ids)}))
        report = m.evaluate(copy / "truth")
    assert report.verdict == "0 of 3 placed, no ATE: no two scenes are connected by edges"
    assert report.edges == ()


def test_tiles_are_scored_as_they_were_written(made: Path) -> None:
    """The photographs are pictures of the export, so the tiles show them whole, and nothing else does."""
    with gsmap.open(made / "site.gsmap") as m:
        report = m.evaluate(made / "truth", made / "images", tiles=made / "tiles")
    assert [row.scene_name for row in report.images] == ["a", "b", "far"]
    for row in report.images:
        assert row.num_images == 4
        assert row.tiles_psnr_db > 50  # what 8 bits leave
        assert row.tiles_ssim > 0.999
        assert row.tiles_lpips is None
        assert row.tiles_cover == pytest.approx(1.0, abs=0.01)
    for row in report.images[:2]:  # far away, the tiles are the scene
        assert row.alone_psnr_db < row.tiles_psnr_db - 5
        assert row.union_psnr_db < row.tiles_psnr_db - 5


def test_figures_of_a_scene_alone_are_those_of_its_renders(made: Path) -> None:
    with gsmap.open(made / "site.gsmap") as m:
        row = m.evaluate(made / "truth", made / "images").images[0]
        gaussians, cameras = m.read("a")
    assert row.tiles_psnr_db is row.tiles_cover is None
    each = []
    for k, picture in enumerate(render(gaussians, cameras).colour):
        photograph = np.asarray(Image.open(made / "images" / "a" / f"{cameras.names[k]}.png")) / 255
        each.append(psnr(picture, photograph))
    assert row.alone_psnr_db == pytest.approx(np.mean(each), abs=1e-3)


def test_a_scene_costs_its_neighbours_only(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with gsmap.open(made / "site.gsmap") as m:
        names, read = {scene.id: scene.name for scene in m.scenes()}, []
        load = m.store.scenes.gaussians
        monkeypatch.setattr(m.store.scenes, "gaussians", lambda ref: read.append(names[ref]) or load(ref))
        opened: list[str] = []
        whole = gsmap.formats.read
        monkeypatch.setattr("gsmap.formats.read", lambda path: opened.append(Path(path).name) or whole(path))
        from gsmap.map.evaluation import evaluate

        evaluate.images(m.store, made / "images", lambda f, text: None, tiles=made / "tiles")
    assert sorted(read) == ["a"] * 3 + ["b"] * 3 + ["far"] * 2  # alone, and in each union that it is near
    assert len(opened) <= 2 * len(set(opened))
    assert set(opened) == {path.name for path in (made / "tiles").rglob("*.ply")}


def test_tiles_are_compared_with_the_poses_that_made_them(copy: Path) -> None:
    """The map has moved since: photographs are looked at from where the tiles have their scene."""
    with gsmap.open(copy / "site.gsmap") as m:
        moved = Sim3(exp_so3([0, 0, 0.5]), [1.0, 2, 3])
        poses = {s: ScenePose(s, moved @ p.S_map_scene, 0, "placed") for s, p in m.pose_graph().poses.items()}
        m.store.revisions.save(PoseGraph(poses))
        row = m.evaluate(copy / "truth", copy / "images", tiles=copy / "tiles").images[0]
    assert row.tiles_psnr_db > 50


@pytest.mark.parametrize("format", ["glb", "3dtiles"])
def test_tiles_of_other_axes_are_turned_back(copy: Path, format: str) -> None:
    with gsmap.open(copy / "site.gsmap") as m:
        m.export(copy / "again", tile_size_m=2.0, merge="voxel", format=format)
        known = m.evaluate(copy / "truth", copy / "images", tiles=copy / "again").images[0]
        shutil.copytree(copy / "again", copy / "elsewhere")  # a folder that the catalog does not know
        unknown = m.evaluate(copy / "truth", copy / "images", tiles=copy / "elsewhere").images[0]
    assert known.tiles_psnr_db > 40
    assert unknown.tiles_psnr_db == known.tiles_psnr_db


def test_an_export_of_a_part_says_that_it_is_one(copy: Path) -> None:
    with gsmap.open(copy / "site.gsmap") as m:
        box = np.concatenate([S_MAP_WORLD.apply(np.zeros(3)) - 0.3, S_MAP_WORLD.apply(np.zeros(3)) + 0.3])
        m.export(copy / "part", format="ply", tile_size_m=0, merge="union", bbox=box)
        rows = {row.scene_name: row for row in m.evaluate(copy / "truth", copy / "images", tiles=copy / "part").images}
    assert 0.01 < rows["a"].tiles_cover < 0.5
    assert rows["far"].tiles_psnr_db is None
    assert rows["far"].tiles_cover is None


def test_what_is_no_export_of_this_map_is_refused(copy: Path) -> None:
    with gsmap.open(copy / "site.gsmap") as m:
        with raises(ConfigError, code="missing_option"):
            m.evaluate(copy / "truth", tiles=copy / "tiles")
        with raises(NotFoundError, code="not_an_export"):
            m.evaluate(copy / "truth", copy / "images", tiles=copy / "truth")
        tile = next((copy / "tiles").rglob("*.ply"))
        tile.write_bytes(tile.read_bytes()[:-1])
        with raises(InputError, code="export_damaged", match=re.escape(tile.name)):
            m.evaluate(copy / "truth", copy / "images", tiles=copy / "tiles")
    with gsmap.map.create(copy / "other.gsmap") as other:
        other.store.scenes.add(wall(7, 0, 1), facing(0, 1, "a"), name="a")
        with raises(ConfigError, code="foreign_export"):
            other.evaluate(copy / "truth", copy / "images", tiles=copy / "tiles")
