import numpy as np
import pytest
from PIL import Image
from raising import raises

from gsmap.errors import InputError, NotFoundError
from gsmap.evaluate.renders import compare_renders, find_images, read_image
from gsmap.geometry.camera_models import camera_model, pinhole_views
from gsmap.render import render
from gsmap.types import Cameras, Gaussians


def scene():
    rng = np.random.default_rng(0)
    n = 400
    gaussians = Gaussians(
        rng.uniform([-1, -1, 2], [1, 1, 3], (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-2.5, 0.3, (n, 3)),
        rng.normal(1, 1, n),
        rng.normal(0, 1, (n, 1, 3)),
    )
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.2
    cameras = Cameras(T, np.tile([40.0, 40, 32, 24], (2, 1)), np.tile([64, 48], (2, 1)), ("a/left.png", "right"))
    return gaussians, cameras


def test_a_scene_matches_its_own_renders_and_a_known_error_is_measured():
    gaussians, cameras = scene()
    colour = np.clip(render(gaussians, cameras).colour, 0, 1)
    same = compare_renders(gaussians, cameras, {0: colour[0], 1: colour[1]})
    assert same.means()["ssim"] == pytest.approx(1.0)
    off = compare_renders(gaussians, cameras, {1: np.clip(colour[1], 0.2, 0.8)}, lpips=lambda a, b: 0.25)
    error = np.mean((colour[1] - np.clip(colour[1], 0.2, 0.8)) ** 2)
    assert off.means()["psnr_db"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
    assert off.means()["lpips"] == 0.25
    assert off.names == ("right",)


def test_pixels_that_a_photo_does_not_show_are_left_out():
    """A fisheye shows half of each side face; the render is black but for Gaussians behind, the photo is grey."""
    fisheye = camera_model("OPENCV_FISHEYE", 100, 100, (31.83, 31.83, 50, 50, 0, 0, 0, 0))
    cameras = pinhole_views(fisheye, np.eye(4), "f.jpg")
    behind = Gaussians([[0, 0, -50]], [[1, 0, 0, 0]], np.full((1, 3), -5), [0], np.zeros((1, 1, 3)))
    photo = np.full((100, 100, 3), 0.1, np.float32)
    found = compare_renders(behind, cameras, dict.fromkeys(range(len(cameras)), photo))
    assert len(cameras) > 1
    np.testing.assert_allclose(found.psnr_db, 20, atol=1e-4)
    np.testing.assert_allclose(found.ssim, 1e-4 / (0.01 + 1e-4), rtol=1e-3)  # the luminance term of a constant error


def test_pictures_are_found_by_camera_name_and_may_be_smaller(tmp_path):
    gaussians, cameras = scene()
    half = Cameras(cameras.T_frame_camera, cameras.intrinsics_px / 2, cameras.sizes_px // 2)
    (tmp_path / "a").mkdir()
    pixels = np.round(np.clip(render(gaussians, half).colour[0], 0, 1) * 255).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "a" / "left.png")
    found = find_images(cameras, tmp_path)
    assert list(found) == [0]
    assert read_image(found[0]).shape == (24, 32, 3)
    assert compare_renders(gaussians, cameras, found).psnr_db[0] > 50


def test_what_does_not_fit_is_refused(tmp_path):
    gaussians, cameras = scene()
    with raises(NotFoundError, code="folder_not_found"):
        find_images(cameras, tmp_path / "none")
    Image.new("RGB", (8, 8)).save(tmp_path / "other.png")
    with raises(NotFoundError, code="image_not_found"):
        find_images(cameras, tmp_path)
    for suffix in ("png", "jpg"):
        Image.new("RGB", (8, 8)).save(tmp_path / f"right.{suffix}")
    with raises(InputError, code="ambiguous_image"):
        find_images(cameras, tmp_path)
    with raises(InputError, code="size_mismatch"):
        compare_renders(gaussians, cameras, {0: np.zeros((48, 48, 3))})
    (tmp_path / "bad.png").write_bytes(b"no image")
    with raises(InputError, code="picture_unreadable"):
        read_image(tmp_path / "bad.png")
