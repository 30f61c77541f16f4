"""A scan is found where it lies, whatever kind of file it is, or refused; and the map is as it was."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from raising import raises
from scanned_flat import Flat, Scanned, save_depth, scanned

import gsmap
from gsmap import formats
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.geometry.rotations import angle_between
from gsmap.map.localization.localize_scan import _near
from gsmap.types.rows.localize_scan import ScanRow


def ply(path: Path, points: np.ndarray, colours: np.ndarray | None) -> Path:
    names = [(axis, "<f8") for axis in "xyz"]
    names += [(c, "u1") for c in ("red", "green", "blue")] if colours is not None else []
    rows = np.empty(len(points), names)
    for k, axis in enumerate("xyz"):
        rows[axis] = points[:, k]
    for k, name in enumerate(("red", "green", "blue")):
        if colours is not None:
            rows[name] = colours[:, k]
    kinds = {"<f8": "double", "u1": "uchar"}
    head = [f"property {kinds[kind]} {name}" for name, kind in names]
    text = "\n".join(["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}", *head, "end_header\n"])
    path.write_bytes(text.encode() + rows.tobytes())
    return path


def error(row: ScanRow, flat: Flat, T_scan_world: np.ndarray, middle: np.ndarray) -> tuple[float, float]:
    """Degrees, and metres at the scan's middle (file coordinates)."""
    assert row.S_map_scan is not None
    T_world_scan = np.linalg.inv(T_scan_world)
    truth = flat.S_map_world @ T_world_scan
    there = truth[:3, :3] @ middle + truth[:3, 3]
    return (
        float(np.degrees(angle_between(row.S_map_scan.rotation, truth[:3, :3]))),
        float(np.linalg.norm(row.S_map_scan.apply(middle - row.origin) - there)),
    )


def digest(path: Path) -> dict[str, str]:
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and not file.name.endswith(("-shm", "-wal"))]
    return {str(file.relative_to(path)): hashlib.sha256(file.read_bytes()).hexdigest() for file in files}


def test_a_cloud_is_found_and_nothing_is_written(opened: gsmap.map.Map, flat: Flat, room: Scanned, tmp_path: Path):
    before = digest(flat.path)
    row = opened.localize_scan(ply(tmp_path / "room.ply", room.points, room.colours))
    assert digest(flat.path) == before
    assert row.status == "placed", row.reason
    degrees, metres = error(row, flat, room.T_scan_world, room.points.mean(0))
    assert degrees < 1.0
    assert metres < 0.05
    assert row.coloured
    assert row.kind == "points"
    assert row.probability > 0.9
    assert row.covariance is not None
    assert row.sigma_deg is not None
    assert row.sigma_m is not None
    assert 0 < row.sigma_deg < 1.5
    assert 0 < row.sigma_m < 0.05
    assert np.linalg.eigvalsh(row.covariance).min() > 0
    assert set(row.scenes) <= {scene.name for scene in opened.scenes()}
    assert row.T_map_camera is None


@pytest.mark.slow
def test_large_coordinates_lose_nothing(opened: gsmap.map.Map, flat: Flat, room: Scanned, tmp_path: Path):
    pytest.importorskip("laspy")
    import laspy

    far = np.array([500_000.0, 5_400_000.0, 300.0])
    header = laspy.LasHeader(point_format=7, version="1.4")
    header.scales, header.offsets = np.full(3, 1e-3), far
    las = laspy.LasData(header)
    las.x, las.y, las.z = (room.points + far).T
    las.red, las.green, las.blue = room.colours.astype(np.uint16).T * 257
    las.write(tmp_path / "room.laz")
    row = opened.localize_scan(tmp_path / "room.laz")
    assert row.status == "placed", row.reason
    assert np.abs(row.origin - far).max() < 20
    moved = room.T_scan_world.copy()
    moved[:3, 3] += far
    degrees, metres = error(row, flat, moved, room.points.mean(0) + far)
    assert degrees < 1.0
    assert metres < 0.05


def test_a_depth_picture_tells_where_its_camera_is(
    opened: gsmap.map.Map, flat: Flat, room: Scanned, tmp_path: Path
) -> None:
    placed = 0
    for i in (1, 3, 5):
        depth, colour = save_depth(tmp_path, room.frames, i)
        intrinsics = room.frames.cameras.intrinsics_px[i]
        row = opened.localize_scan(depth, intrinsics=intrinsics, colour=colour)
        if row.status == "refused":
            assert row.reason
            continue
        truth = flat.S_map_world @ room.frames.cameras.T_frame_camera[i]
        assert row.T_map_camera is not None
        assert np.degrees(angle_between(row.T_map_camera[:3, :3], truth[:3, :3])) < 1.5
        assert np.linalg.norm(row.T_map_camera[:3, 3] - truth[:3, 3]) < 0.08
        placed += 1
    assert placed


def test_localize_takes_scans_and_depth_pictures(opened: gsmap.map.Map, room: Scanned, tmp_path: Path) -> None:
    path = ply(tmp_path / "room.ply", room.points, room.colours)
    report = opened.localize(path)
    (row,) = report.results
    alone = opened.localize_scan(path)
    assert row.status == "placed"
    assert row.S_map_scan is not None
    assert alone.S_map_scan is not None
    np.testing.assert_array_equal(row.S_map_scan.matrix(), alone.S_map_scan.matrix())
    np.testing.assert_array_equal(row.covariance, alone.covariance)
    assert row.origin is not None
    assert not row.origin.any()
    assert row.evidence["coloured"] == 1
    assert any("room.ply" in note for note in report.notes) == bool(alone.notes)
    depth, colour = save_depth(tmp_path, room.frames, 1)
    for options in ({}, {"focal": 100}):
        with raises(ConfigError, code="missing_option", match="intrinsics"):
            opened.localize(colour, depth=depth, **options)
    with raises(ConfigError, code="conflicting_options"):
        opened.localize(colour, colour, depth=depth, intrinsics=room.frames.cameras.intrinsics_px[1])
    (row,) = opened.localize(colour, depth=depth, intrinsics=room.frames.cameras.intrinsics_px[1]).results
    assert row.file == str(colour)
    assert (row.T_map_camera is None) == (row.status == "refused")


@pytest.mark.slow
def test_a_splat_is_found_without_being_ingested(
    opened: gsmap.map.Map, flat: Flat, room: Scanned, tmp_path: Path
) -> None:
    scene = opened.scenes()[0]
    gaussians, _ = opened.read(scene.id)
    formats.write(tmp_path / "other.ply", gaussians)
    row = opened.localize_scan(tmp_path / "other.ply")
    assert row.kind == "splat"
    assert row.status == "placed", row.reason
    poses = opened.pose_graph()
    assert poses is not None
    assert row.S_map_scan is not None
    truth = poses.poses[scene.id].S_map_scene
    assert np.degrees(angle_between(row.S_map_scan.rotation, truth.rotation)) < 0.5
    assert len(opened.scenes()) == 2


def test_a_scan_of_another_place_is_refused(opened: gsmap.map.Map, tmp_path: Path) -> None:
    other = scanned(77)
    row = opened.localize_scan(ply(tmp_path / "other.ply", other.points, other.colours))
    assert row.status == "refused"
    assert "none shows it" in row.reason
    assert row.S_map_scan is None
    assert row.covariance is None
    assert row.probability < 0.9
    assert len(row.supports) == 2


def test_without_colours_it_is_told_so_and_never_wrong(
    opened: gsmap.map.Map, flat: Flat, room: Scanned, tmp_path: Path
) -> None:
    row = opened.localize_scan(ply(tmp_path / "grey.ply", room.points, None))
    assert not row.coloured
    assert any("no colours" in note for note in row.notes)
    if row.status == "placed":
        degrees, metres = error(row, flat, room.T_scan_world, room.points.mean(0))
        assert degrees < 1.0
        assert metres < 0.05


def test_near_says_where_to_look(opened: gsmap.map.Map, room: Scanned, tmp_path: Path) -> None:
    path = ply(tmp_path / "room.ply", room.points, room.colours)
    name = opened.scenes()[0].name
    for near in ("1,2", "1,2,3,-1", "a,b,c,d"):
        with pytest.raises((ConfigError, NotFoundError)):
            opened.localize_scan(path, near=near)
    with raises(NotFoundError, code="nothing_near"):
        opened.localize_scan(path, near="5000,0,0,1")
    found = _near(opened.store, name)
    assert opened.scenes()[0].id in found
    assert _near(opened.store, "0,0,0,1000") == {scene.id for scene in opened.scenes()}


def test_what_cannot_be_looked_for(opened: gsmap.map.Map, room: Scanned, tmp_path: Path) -> None:
    with raises(NotFoundError, code="file_not_found"):
        opened.localize_scan(tmp_path / "none.ply")
    path = ply(tmp_path / "room.ply", room.points, room.colours)
    with raises(ConfigError, code="invalid_choice", match="scale .*'large'"):
        opened.localize_scan(path, scale="large")
    with raises(ConfigError, code="missing_option", match="intrinsics"):
        opened.localize_scan(path, colour=path)
    (tmp_path / "a.ply").write_bytes(b"ply\n")
    with raises(InputError, code="ply_header"):
        opened.localize_scan(tmp_path / "a.ply")


def test_a_map_without_poses_cannot_be_asked(room: Scanned, tmp_path: Path) -> None:
    path = ply(tmp_path / "room.ply", room.points, room.colours)
    with gsmap.map.create(tmp_path / "empty.gsmap") as m, raises(NotFoundError, code="no_placed_scene"):
        m.localize_scan(path)
