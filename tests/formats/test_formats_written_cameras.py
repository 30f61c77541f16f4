"""Cameras written for other programs: COLMAP's own reader and ours find every one where it was."""

import json

import numpy as np
import pytest
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.errors import InputError, NotFoundError
from gsmap.formats import colmap, nerfstudio, read_cameras
from gsmap.geometry.camera_models import camera_model, pinhole_views, rays_of
from gsmap.types import Cameras


def some() -> Cameras:
    """Seven cameras of two lenses, far from the origin, one of which looks back (w of its quaternion near 0)."""
    n, rng = 7, np.random.default_rng(5)
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, :3, :3] = Rotation.random(n, random_state=6).as_matrix()
    pose[0, :3, :3] = np.diag([-1.0, 1, -1])
    pose[:, :3, 3] = rng.normal(0, 300, size=(n, 3))
    intrinsics = np.array([[501.25, 499.75, 1 / 3, 238.1]] * 3 + [[350.0, 360, 200.5, 150.5]] * 4)
    sizes = np.array([[640, 480]] * 3 + [[400, 300]] * 4)
    return Cameras(pose, intrinsics, sizes, tuple(f"b/{k}.jpg" if k % 2 else f"a {k}.jpg" for k in range(n)))


PINHOLE = (400.0, 410.0, 310.0, 250.0)
LENSES = {
    "PINHOLE": PINHOLE,
    "SIMPLE_RADIAL": (400.0, 310.0, 250.0, -0.1),
    "OPENCV": (*PINHOLE, -0.1, 0.02, 0.001, -0.002),
    "FULL_OPENCV": (*PINHOLE, -0.1, 0.02, 0.001, -0.002, 0.003, 0.0, 0.0, 0.0),
    "OPENCV_FISHEYE": (180.0, 180.0, 320.0, 240.0, 0.02, 0.0, 0.0, 0.0),  # seen by several faces
    "EQUIRECTANGULAR": (640.0, 320.0),
}


def of_lens(name: str, photo: str) -> Cameras:
    size = (640, 320) if name == "EQUIRECTANGULAR" else (640, 480)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.3, -2, 1]).as_matrix(), (1, 2, 3)
    return pinhole_views(camera_model(name, *size, LENSES[name]), pose, photo)


def by_name(cameras: Cameras) -> Cameras:
    return cameras[np.argsort(np.array(cameras.names))]


def test_pycolmap_opens_what_is_written(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    cameras = some()
    colmap.write(tmp_path / "model", cameras)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert (model.num_images(), model.num_cameras(), model.num_points3D()) == (7, 2, 0)
    for i, name in enumerate(cameras.names):
        image = model.images[i + 1]
        assert image.name == name.replace(" ", "_")
        np.testing.assert_allclose(image.cam_from_world().matrix(), cameras.T_camera_frame[i, :3], atol=1e-9)
        np.testing.assert_allclose(image.projection_center(), cameras.centers[i], atol=1e-9)
        camera = model.cameras[image.camera_id]
        assert camera.model_name == "PINHOLE"
        np.testing.assert_array_equal(camera.params, cameras.intrinsics_px[i])
        assert [camera.width, camera.height] == cameras.sizes_px[i].tolist()


def test_our_reader_finds_colmaps_cameras_where_they_were(tmp_path):
    cameras = some()
    colmap.write(tmp_path, cameras)
    back, want = read_cameras(tmp_path), by_name(cameras)
    assert back.names == tuple(name.replace(" ", "_") for name in want.names)
    np.testing.assert_allclose(back.T_frame_camera, want.T_frame_camera, atol=1e-9)
    np.testing.assert_array_equal(back.intrinsics_px, want.intrinsics_px)
    np.testing.assert_array_equal(back.sizes_px, want.sizes_px)


def test_colmap_does_not_write_beside_a_binary_model(tmp_path):
    (tmp_path / "images.bin").write_bytes(b"")
    with raises(InputError, code="binary_model_in_the_way"):
        colmap.write(tmp_path, some())
    assert [path.name for path in tmp_path.iterdir()] == ["images.bin"]
    with raises(NotFoundError, code="folder_not_found"):
        colmap.write(tmp_path / "none" / "model", some())


def test_our_reader_finds_nerfstudios_cameras_where_they_were(tmp_path):
    cameras = some()
    nerfstudio.write(tmp_path / "transforms.json", cameras)
    back = read_cameras(tmp_path / "transforms.json")
    assert back.names == cameras.names
    np.testing.assert_allclose(back.T_frame_camera, cameras.T_frame_camera, atol=1e-9)
    np.testing.assert_array_equal(back.intrinsics_px, cameras.intrinsics_px)
    np.testing.assert_array_equal(back.sizes_px, cameras.sizes_px)
    with raises(NotFoundError, code="folder_not_found"):
        nerfstudio.write(tmp_path / "none" / "transforms.json", cameras)


def test_photos_are_written_with_their_lenses(tmp_path):
    """One image per photo, also of a panorama, whose first face to be seen is not the front."""
    pycolmap = pytest.importorskip("pycolmap")
    photos = [of_lens(name, f"{name}.jpg") for name in LENSES]
    photos[-1] = photos[-1][1:]
    cameras = Cameras.concatenate(photos)
    colmap.write(tmp_path / "model", cameras)
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert sorted(image.name for image in model.images.values()) == sorted(f"{name}.jpg" for name in LENSES)
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        assert image.name == f"{camera.model_name}.jpg"
        np.testing.assert_array_equal(camera.params, LENSES[camera.model_name])
        np.testing.assert_allclose(image.cam_from_world().matrix(), photos[0].T_camera_frame[0, :3], atol=1e-9)
    with raises(InputError, code="unsupported_output"):
        nerfstudio.write(tmp_path / "mixed.json", cameras)
    for name, cameras in zip(LENSES, photos, strict=True):
        folder = tmp_path / name
        folder.mkdir()
        nerfstudio.write(folder / "transforms.json", cameras)
        (frame,) = json.loads((folder / "transforms.json").read_text())["frames"]
        assert frame["file_path"] == f"{name}.jpg"
        np.testing.assert_allclose(np.array(frame["transform_matrix"])[:3, 3], (1, 2, 3))
        back = read_cameras(folder / "transforms.json")[-len(cameras) :]
        np.testing.assert_allclose(back.T_frame_camera, cameras.T_frame_camera, atol=1e-9)
        np.testing.assert_array_equal(back.intrinsics_px, cameras.intrinsics_px)
        for a, b in zip(back.lenses, cameras.lenses, strict=True):
            at = np.random.default_rng(0).uniform(100, 300, (9, 2))
            np.testing.assert_allclose(rays_of(a.model, at), rays_of(b.model, at), atol=1e-9)
    odd = pinhole_views(camera_model("FOV", 640, 480, (*PINHOLE, 0.1)), np.eye(4), "odd.jpg")
    with raises(InputError, code="unsupported_output"):
        nerfstudio.write(tmp_path / "odd.json", odd)


def test_nerfstudios_cameras_look_along_minus_z(tmp_path):
    """By the format's definition, whatever our reader makes of it: OpenGL axes, camera to world."""
    camera = Cameras(np.eye(4)[None], np.array([[100.0, 100, 50, 40]]), np.array([[100, 80]]), ("a.jpg",))
    nerfstudio.write(tmp_path / "transforms.json", camera)  # looks along +z with +y down
    frame = json.loads((tmp_path / "transforms.json").read_text())["frames"][0]
    matrix = np.array(frame["transform_matrix"])
    np.testing.assert_array_equal(matrix @ [0, 0, -1, 0], [0, 0, 1, 0])
    np.testing.assert_array_equal(matrix @ [0, 1, 0, 0], [0, -1, 0, 0])
    assert [frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")] == [100, 80, 100, 100, 50, 40]
