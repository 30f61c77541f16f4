"""Photos of every lens are seen through pinholes as pycolmap projects them."""

import numpy as np
import pycolmap
import pytest

from gsmap.geometry.camera_models import (
    FACES,
    camera_model,
    photo_pixels,
    pinhole_views,
    rays_of,
    undistort,
    view_of_pixel,
)
from gsmap.geometry.projection import project

SIZE = (800, 600)
MIDDLE = [700, 700, 400, 300]
MODELS = {
    "SIMPLE_PINHOLE": [700, 400, 300],
    "PINHOLE": MIDDLE,
    "SIMPLE_RADIAL": [700, 400, 300, -0.12],
    "SIMPLE_RADIAL_FISHEYE": [500, 400, 300, 0.02],
    "RADIAL": [700, 400, 300, -0.1, 0.03],
    "RADIAL_FISHEYE": [500, 400, 300, 0.02, 0.003],
    "OPENCV": [*MIDDLE, -0.1, 0.02, 1e-3, -2e-3],
    "OPENCV_FISHEYE": [*MIDDLE, 0.02, 0.01, -0.003, 0.001],
    "FULL_OPENCV": [*MIDDLE, -0.1, 0.05, 1e-3, -2e-3, 0.02, 0.01, 0.02, 0.01],
    "FOV": [*MIDDLE, 0.6],
    "THIN_PRISM_FISHEYE": [*MIDDLE, 0.02, 0.01, 1e-3, -1e-3, 0.002, 0.001, 1e-3, 2e-3],
    "RAD_TAN_THIN_PRISM_FISHEYE": [*MIDDLE, 0.02, 0.01, -0.002, 0.001, 0, 0, 1e-3, -1e-3, 1e-3, 0, 2e-3, 0],
    "SIMPLE_DIVISION": [700, 400, 300, -0.1],
    "DIVISION": [*MIDDLE, -0.1],
    "SIMPLE_FISHEYE": [500, 400, 300],
    "FISHEYE": [500, 500, 400, 300],
    "EUCM": [600, 600, 400, 300, 0.55, 1.1],
    "EQUIRECTANGULAR": [800, 400],
}
WIDE_FISHEYE = ("OPENCV_FISHEYE", [240, 240, 400, 300, 0.01, 0, 0, 0])


def size_of(name: str) -> tuple[int, int]:
    return (800, 400) if name == "EQUIRECTANGULAR" else SIZE


def test_no_model_of_colmap_is_missing():
    assert set(MODELS) == set(pycolmap.CameraModelId.__members__) - {"INVALID"}


@pytest.mark.parametrize(("name", "params"), [*MODELS.items(), WIDE_FISHEYE])
def test_pinhole_views_show_what_the_photo_shows(name, params):
    rng = np.random.default_rng(0)
    size = size_of(name)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = 1, 2, 3
    views = pinhole_views(camera_model(name, *size, tuple(params)), pose, "photo")
    points = rng.normal(size=(3000, 3)) * 5 + pose[:3, 3]
    truth = pycolmap.Camera(model=name, width=size[0], height=size[1], params=params)
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    compared = 0
    for row in range(len(views)):
        pixels, depth = project(points, views.T_camera_frame[row], views.intrinsics_px[row])
        shown = (depth > 0) & ((pixels >= 0) & (pixels < views.sizes_px[row])).all(1)
        found = photo_pixels(views[row], pixels[shown])
        want = truth.img_from_cam(local[shown])
        known = np.isfinite(found).all(1)
        assert known.mean() > 0.2
        off = found[known] - want[known]
        off[:, 0] -= size[0] * np.round(off[:, 0] / size[0]) * (name == "EQUIRECTANGULAR")  # the seam
        assert np.abs(off).max() <= 0.01
        compared += known.sum()
    assert compared > 100
    assert (len(views) > 1) == (name == "EQUIRECTANGULAR" or [name, params] == list(WIDE_FISHEYE))


@pytest.mark.parametrize(("name", "params"), [*MODELS.items(), WIDE_FISHEYE])
def test_a_picked_pixel_leads_to_the_ray_of_pycolmap(name, params):
    rng = np.random.default_rng(1)
    size = np.array(size_of(name))
    views = pinhole_views(camera_model(name, *size, tuple(params)), np.eye(4), "photo")
    truth = pycolmap.Camera(model=name, width=size[0], height=size[1], params=params)
    for pixel in rng.uniform(0.15, 0.85, (60, 2)) * size:
        row, at = view_of_pixel(views, pixel)
        fx, fy, cx, cy = views.intrinsics_px[row]
        ray = views.T_frame_camera[row, :3, :3] @ [(at[0] - cx) / fx, (at[1] - cy) / fy, 1.0]
        back = truth.img_from_cam(ray[None])[0]
        np.testing.assert_allclose(back, pixel, atol=0.01)


def test_a_panorama_has_six_faces_and_a_fisheye_those_that_it_shows():
    panorama = pinhole_views(camera_model("EQUIRECTANGULAR", 800, 400, (800.0, 400.0)), np.eye(4), "p.jpg")
    assert panorama.names == tuple(f"p.jpg#{face}" for face in FACES)
    assert panorama.photo_rows == {"p.jpg": [0, 1, 2, 3, 4, 5]}
    axes = panorama.T_frame_camera[:, :3, 2]
    np.testing.assert_allclose(axes, [[0, 0, 1], [1, 0, 0], [0, 0, -1], [-1, 0, 0], [0, -1, 0], [0, 1, 0]], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(panorama.T_frame_camera[:, :3, :3]), 1)
    name, params = WIDE_FISHEYE
    fisheye = pinhole_views(camera_model(name, *SIZE, tuple(params)), np.eye(4), "f.jpg")
    assert "f.jpg#front" in fisheye.names
    assert "f.jpg#back" not in fisheye.names


def test_rays_beyond_what_a_model_holds_are_unknown():
    strong = camera_model("SIMPLE_RADIAL", *SIZE, (300.0, 400.0, 300.0, -0.4))
    assert np.isnan(rays_of(strong, np.array([[0.0, 0.0]]))).all()
    assert view_of_pixel(pinhole_views(strong, np.eye(4), "p"), np.array([0.0, 0.0])) is None


@pytest.mark.parametrize("name", ["OPENCV", "EQUIRECTANGULAR"])
def test_an_undistorted_photo_has_the_colours_of_the_rays(name):
    """The photo's colour is a smooth function of the ray, so that the truth of every pixel is known."""
    size = size_of(name)
    model = camera_model(name, *size, tuple(float(value) for value in MODELS[name]))
    grid = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), -1).reshape(-1, 2)
    photo = ((1 + np.nan_to_num(rays_of(model, grid))) / 2).reshape(size[1], size[0], 3).astype(np.float32)
    views = pinhole_views(model, np.eye(4), "photo")
    for row in range(len(views)):
        image, known = undistort(photo, views[row])
        height, width = known.shape
        fx, fy, cx, cy = views.intrinsics_px[row]
        x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ views.T_frame_camera[row, :3, :3].T
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        assert known.mean() > 0.9
        assert np.abs(image - (1 + rays) / 2)[known].max() < 0.01
