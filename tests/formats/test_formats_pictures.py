"""What a format keeps, judged by the picture."""

from dataclasses import replace

import numpy as np
import pytest

from gsmap import formats
from gsmap.evaluate.images import psnr
from gsmap.formats.axes import change_axes
from gsmap.types import Cameras

pytest.importorskip("torch")


def around(center: np.ndarray, distance: float, count: int = 4, size: int = 128) -> Cameras:
    """Cameras on a ring in right-down-front axes, looking at a point from a little above."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.linspace(0, 2 * np.pi, count, endpoint=False), strict=True):
        back = np.array([np.sin(angle), -0.3, -np.cos(angle)])
        forward = -back / np.linalg.norm(back)
        right = np.cross([0.0, 1.0, 0.0], forward)
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
        pose[:3, 3] = center - distance * forward
    intrinsics = np.tile([1.2 * size, 1.2 * size, size / 2, size / 2], (count, 1))
    return Cameras(poses, intrinsics, np.tile([size, size], (count, 1)))


def picture(gaussians, cameras) -> np.ndarray:
    from gsmap.render import render

    colour = render(gaussians, cameras, depth=False, dominant_id=False).colour
    return np.clip(colour, 0, 1).reshape(-1, *colour.shape[2:])  # one below the other


def test_two_formats_of_one_object_look_the_same(shared_data):
    ply = formats.read(shared_data / "formats" / "biker.compressed.ply")
    spz = formats.read(shared_data / "formats" / "biker.spz")
    low, high = np.percentile(ply.means, [2, 98], axis=0)
    cameras = around((low + high) / 2, 2 * float((high - low).max()))
    truth = picture(ply, cameras)
    assert truth.std() > 0.05
    assert psnr(truth, picture(spz, cameras)) > 38
    assert psnr(truth, picture(change_axes(spz, "RUB", "RDF"), cameras)) < 20  # what not turning the axes would give


@pytest.mark.parametrize(
    ("name", "decibels", "options"),
    [
        ("a.glb", 90, {}),
        ("tileset.json", 45, {}),
        ("tileset.json", 90, {"compressed": False}),
        ("a.compressed.ply", 48, {}),
        ("a.spz", 44, {}),
        ("a.splat", 30, {}),
    ],
)
def test_a_real_capture_looks_the_same(shared_data, tmp_path, name, decibels, options):
    g = formats.read(shared_data / "house" / "c0.ply")
    cameras = formats.read_cameras(shared_data / "house" / "c0.cameras.json")
    some = [10, 50]
    cameras = Cameras(
        cameras.T_frame_camera[some], cameras.intrinsics_px[some] / 3, np.asarray(cameras.sizes_px)[some] // 3
    )
    formats.write(tmp_path / name, g, **options)
    assert psnr(picture(g, cameras), picture(formats.read(tmp_path / name), cameras)) > decibels


def test_a_coarse_level_looks_like_its_originals_from_afar(shared_data):
    """A sixteenth of the Gaussians: merged they keep a distant view, dropped and blown up they lose it."""
    from gsmap.formats.tiles3d import coarser

    g = formats.read(shared_data / "house" / "c0.ply")
    low, high = np.percentile(g.means, [2, 98], axis=0)
    cameras = around((low + high) / 2, 1.5 * float((high - low).max()), size=100)
    truth = picture(g, cameras)
    level, _ = coarser(g, len(g) // 16)
    dropped = g[:: len(g) // len(level)]
    dropped = replace(dropped, log_scales=dropped.log_scales + 0.5 * np.log(len(g) / len(dropped)))
    assert psnr(truth, picture(level, cameras)) > 24
    assert psnr(truth, picture(level, cameras)) > psnr(truth, picture(dropped, cameras)) + 5
