"""Captures in map coordinates: in at the files' doors, registered, solved, merged and out again, to a millimetre."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap import formats
from gsmap.errors import InputError
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.types import Cameras, Gaussians, Prior, Sim3
from gsmap_synthetic import DemoCapture, make_captures, write_captures

LV95 = np.array([2683000.37, 1247900.61, 408.2])
EAST = np.array([5000.0, 0, 0])


def surveyed(capture: DemoCapture, at: np.ndarray) -> tuple[Gaussians, np.ndarray, Cameras]:
    """A capture in world coordinates about ``at``, and its positions there in double precision."""
    S_world_scene = Sim3.from_matrix(np.linalg.inv(capture.T_scene_world))
    moved = Sim3(S_world_scene.rotation, S_world_scene.translation + at)
    cameras = transform_cameras(capture.cameras, moved)
    return transform_gaussians(capture.gaussians, S_world_scene), moved.apply(capture.gaussians.means), cameras


def write(folder: Path, made: list[DemoCapture], kind: str = "<f8") -> dict[str, np.ndarray]:
    """Captures as another program writes them; their positions by name."""
    truth = {}
    for capture in made:
        g, positions, cameras = surveyed(capture, LV95)
        truth[capture.name] = positions
        columns = dict(zip("xyz", positions.T, strict=True)) | {"opacity": g.logit_opacities}
        columns |= {f"f_dc_{i}": g.sh[:, 0, i] for i in range(3)} | {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
        columns |= {f"rot_{i}": g.quats[:, i] for i in range(4)}
        rows = np.zeros(len(g), [(name, kind if name in "xyz" else "<f4") for name in columns])
        for name, values in columns.items():
            rows[name] = values
        kinds = [f"property {'double' if rows.dtype[n].itemsize == 8 else 'float'} {n}" for n in columns]
        head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(g)}", *kinds, "end_header", ""]
        (folder / capture.name).mkdir(parents=True)
        (folder / capture.name / "point_cloud.ply").write_bytes("\n".join(head).encode() + rows.tobytes())
        views = [
            {
                "id": i,
                "img_name": name,
                "width": int(size[0]),
                "height": int(size[1]),
                "fx": float(lens[0]),
                "fy": float(lens[1]),
                "position": pose[:3, 3].tolist(),
                "rotation": pose[:3, :3].tolist(),
            }
            for i, (name, size, lens, pose) in enumerate(
                zip(cameras.names, cameras.sizes_px, cameras.intrinsics_px, cameras.T_frame_camera, strict=True)
            )
        ]
        (folder / capture.name / "cameras.json").write_text(json.dumps(views))
    return truth


@pytest.fixture(scope="module")
def made() -> list[DemoCapture]:
    """One room walked through twice."""
    return make_captures(0, 2, steps=0, num_frames=8, num_gaussians=8_000, size_px=(80, 60), routes=[[0], [0]])


@pytest.fixture(scope="module")
def site(made: list[DemoCapture], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, np.ndarray]]:
    folder = tmp_path_factory.mktemp("lv95")
    truth = write(folder / "captures", made)
    with pytest.MonkeyPatch.context() as patch, gsmap.map.open_or_create(folder / "site.gsmap") as m:
        patch.setenv("GSMAP_WORKERS", "1")
        m.update(folder / "captures")
    return folder, truth


def test_they_register_and_their_files_coordinates_are_given_back(site: tuple[Path, dict[str, np.ndarray]]) -> None:
    folder, truth = site
    with gsmap.open(folder / "site.gsmap") as m:
        a, b = m.pose_rows()
        assert a.component == b.component
        assert (np.abs(a.offset - LV95) < 100).all()
        points = truth["capture_a"]
        apart = a.S_map_scene.apply(points - a.offset) - b.S_map_scene.apply(points - b.offset)
        assert np.linalg.norm(apart, axis=1).max() < 0.01  # as of the same captures near zero
        for row in m.scene_rows():
            stored = m.store.scenes.gaussians(row.id).means + row.offset
            lows, highs = (np.sort(points, axis=0) for points in (truth[row.name], stored))
            assert np.abs(lows - highs).max() < 1e-5
            assert m.show_scene(row.name).offset.tolist() == row.offset.tolist()
            cameras = m.store.scenes.cameras(row.id)
            assert formats.read_cameras(folder / "captures" / row.name / "cameras.json").centers == pytest.approx(
                cameras.centers + row.offset, abs=1e-6
            )


@pytest.mark.parametrize(("form", "tile"), [("ply", 0.0), ("glb", 0.0), ("spz", 0.0), ("3dtiles", 6.0)])
def test_an_export_is_about_the_map_and_says_what_was_taken_off(
    site: tuple[Path, dict[str, np.ndarray]], form: str, tile: float, tmp_path: Path
) -> None:
    folder, truth = site
    with gsmap.open(folder / "site.gsmap") as m:
        m.export(tmp_path / "out", format=form, tile_size_m=tile, merge="union", up="z")
        poses = {row.scene: row for row in m.pose_rows()}
    told = json.loads((tmp_path / "out" / "tiles.json").read_text())
    assert {scene: row.offset.tolist() for scene, row in poses.items()} == told["offsets"]
    wanted = np.concatenate([row.S_map_scene.apply(truth[row.scene_name] - row.offset) for row in poses.values()])
    if form == "3dtiles":
        found = formats.read(tmp_path / "out" / "component_0" / "tileset.json").positions
    else:
        parts = [formats.read(tmp_path / "out" / tile["path"]).positions for tile in told["tiles"]]
        found = np.concatenate(parts)
    assert len(found) == len(wanted)
    assert np.abs(np.sort(found, axis=0) - np.sort(wanted, axis=0)).max() < 1e-3


def test_they_come_in_once(site: tuple[Path, dict[str, np.ndarray]], made: list[DemoCapture], tmp_path: Path) -> None:
    folder, _ = site
    copy = Path(shutil.copytree(folder / "site.gsmap", tmp_path / "copy.gsmap"))
    g, positions, cameras = surveyed(made[0], LV95 + EAST)
    with gsmap.open(copy) as m:
        again = m.ingest(folder / "captures")
        assert [row.new for row in again] == [False, False]
        origin = np.round(LV95 / 100) * 100
        same = Gaussians(
            (positions - origin - EAST).astype(np.float32),
            g.quats,
            g.log_scales,
            g.logit_opacities,
            g.sh,
            origin + EAST,
        )
        (other,) = m.ingest(same, cameras=cameras, name="five kilometres east")
        assert other.new
        assert m.check().ok
    with gsmap.open(copy) as m:
        rows = {row.name: row.offset for row in m.scene_rows()}
    np.testing.assert_array_equal(rows["five kilometres east"] - rows["capture_a"], EAST)


def test_a_capture_about_another_origin_supersedes_a_scene(
    site: tuple[Path, dict[str, np.ndarray]], made: list[DemoCapture], tmp_path: Path
) -> None:
    folder, _ = site
    copy = Path(shutil.copytree(folder / "site.gsmap", tmp_path / "copy.gsmap"))
    g = formats.read(folder / "captures" / "capture_a" / "point_cloud.ply")
    cameras = formats.read_cameras(folder / "captures" / "capture_a" / "cameras.json")
    with gsmap.open(copy) as m:
        old = m.show_scene("capture_a")
        m.ingest(g[1:].about(g.origin + 100), cameras=cameras, supersedes="capture_a")
        new = m.show_scene("capture_a")
        assert new.id != old.id
        assert new.offset.tolist() == old.offset.tolist()
        means = m.store.scenes.gaussians(new.id).means
        assert np.abs(np.sort(means, axis=0) - np.sort(g.means[1:], axis=0)).max() < 1e-4


def test_a_scan_in_map_coordinates_is_found(site: tuple[Path, dict[str, np.ndarray]]) -> None:
    folder, truth = site
    with gsmap.open(folder / "site.gsmap") as m:
        row = m.localize_scan(folder / "captures" / "capture_b" / "point_cloud.ply")
        at = next(row for row in m.pose_rows() if row.scene_name == "capture_b")
    points = truth["capture_b"][::100]
    found, wanted = row.S_map_scan.apply(points - row.origin), at.S_map_scene.apply(points - at.offset)
    assert np.linalg.norm(found - wanted, axis=1).max() < 0.02


def test_what_came_in_before_gsmap_knew_of_origins_is_not_taken_twice(made: list[DemoCapture], tmp_path: Path) -> None:
    g, positions, cameras = surveyed(made[0], np.array([300_000.0, 0, 0]))
    far = Gaussians(positions, g.quats, g.log_scales, g.logit_opacities, g.sh)
    with gsmap.map.create(tmp_path / "old.gsmap") as m:
        old, _ = m.store.scenes.add(far, cameras, name="old")
        (row,) = m.ingest(far, cameras=cameras, name="again")
        assert (row.new, row.scene) == (False, old.id)
        m.remove("old")
        (row,) = m.ingest(far, cameras=cameras, name="again")
        assert row.new
        assert m.scene_rows()[0].offset[0] == pytest.approx(300_000, abs=100)


def test_a_capture_that_single_precision_destroyed_is_refused(made: list[DemoCapture], tmp_path: Path) -> None:
    write(tmp_path / "in", made[:1], "<f4")
    with gsmap.map.create(tmp_path / "m.gsmap") as m:
        (named,) = (tmp_path / "in").rglob("point_cloud.ply")  # of a folder it is set aside, and the rest is taken
        with raises(InputError, code="precision_loss"):
            m.ingest(named)
        g, positions, cameras = surveyed(made[0], LV95)
        rounded = Gaussians(positions, g.quats, g.log_scales, g.logit_opacities, g.sh)
        with raises(InputError, code="precision_loss"):
            m.ingest(rounded, cameras=cameras, name="in memory")
        assert not m.scene_rows()


def test_a_map_that_a_prior_puts_at_map_coordinates_is_not_exported_rounded(
    made: list[DemoCapture], tmp_path: Path
) -> None:
    write_captures(tmp_path / "in", made[:1])
    with gsmap.map.create(tmp_path / "m.gsmap") as m:
        m.ingest(tmp_path / "in" / f"{made[0].name}.ply")
        (row,) = m.scene_rows()
        m.set_prior(Prior(row.id, Sim3(np.eye(3), LV95), np.array([np.inf] * 3 + [0.01] * 3 + [np.inf])))
        m.optimize()
        with raises(InputError, code="precision_loss") as refused:
            m.export(tmp_path / "out", format="ply", tile_size_m=0)
        assert "2683000" in str(refused.value)
