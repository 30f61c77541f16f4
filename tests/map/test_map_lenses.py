"""Picks and photos of every lens mean in a map what they would mean without distortion."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.formats import gcp_list
from gsmap.geodesy.frame import from_frame
from gsmap.geometry.camera_models import camera_model, photo_pixels, pinhole_views, rays_of
from gsmap.geometry.sh import SH_C0
from gsmap.map.world.georeference import Request
from gsmap.types import Cameras, Gaussians
from gsmap_synthetic.surveyed import Site, SiteParams, surveyed_site

sys.path.insert(0, str(Path(__file__).parents[1] / "world"))
from made_sites import made_map


def seen_by(cameras: Cameras, lens: str) -> Cameras:
    """The same photos, taken by another lens."""
    parts = []
    for k, name in enumerate(cameras.names):
        width, height = cameras.sizes_px[k].tolist()
        params = (*cameras.intrinsics_px[k].tolist(), -0.12, 0.02, 1e-3, -1e-3)
        if lens == "EQUIRECTANGULAR":
            width, height = 8 * height // 3, 4 * height // 3
            params = (float(width), float(height))
        parts.append(pinhole_views(camera_model(lens, width, height, params), cameras.T_frame_camera[k], name))
    return Cameras.concatenate(parts)


def pixel_of(cameras: Cameras, photo: str, ray: np.ndarray) -> np.ndarray:
    """The pixel of a photo that shows a ray of its pinhole camera."""
    for row in cameras.photo_rows[photo]:
        local = cameras.lenses[row].R_photo_camera.T @ ray
        pixel = cameras.intrinsics_px[row, :2] * local[:2] / local[2] + cameras.intrinsics_px[row, 2:]
        if local[2] > 0 and (pixel >= 0).all() and (pixel <= cameras.sizes_px[row]).all():
            return photo_pixels(cameras[row], pixel[None])[0]
    raise AssertionError(photo)


def tie(path: Path, site: Site, lines: list[gcp_list.GcpLine], pick: str) -> tuple[float, float]:
    """Tie a map of the site; return the largest error of a scene's position and the distance to a picked point."""
    gcp_list.write(path / "gcp.txt", site.frame.crs, lines)
    with made_map(path / "site.gsmap", site) as m:
        report = m.georeference(Request(gcp=path / "gcp.txt"))
        assert report.components[0].problem == ""
        truth = from_frame(site.frame, np.array([S.translation for S in site.truth]))
        found = {row.scene_name: row.world for row in m.pose_rows()}
        off = max(np.linalg.norm(found[name] - at) for name, at in zip(site.names, truth, strict=True))
        scene = site.names[0]
        assert m.store.scenes.cameras(scene).photo_rows == site.cameras[0].photo_rows
        return float(off), m.measure(f"{scene}:{pick}", f"{scene}:0,0,0").distance_m


def test_picks_in_photos_of_any_lens_are_those_in_undistorted_ones(tmp_path: Path) -> None:
    site = surveyed_site(0, SiteParams(rows=3, columns=3, num_check=2))
    photo = site.cameras[0].names[0]
    (tmp_path / "pinhole").mkdir()
    off, distance = tie(tmp_path / "pinhole", site, site.gcp_lines(), f"{photo}@300,900")
    scene_of = {name: k for k, cameras in enumerate(site.cameras) for name in cameras.names}
    for lens in ("OPENCV", "EQUIRECTANGULAR"):
        bent = replace(site, cameras=tuple(seen_by(cameras, lens) for cameras in site.cameras))

        def moved(name: str, pixel: tuple[float, float], bent: Site = bent) -> tuple[float, float]:
            k = scene_of[name]
            fx, fy, cx, cy = site.cameras[k].intrinsics_px[site.cameras[k].names.index(name)]
            ray = np.array([(pixel[0] - cx) / fx, (pixel[1] - cy) / fy, 1.0])
            return tuple(pixel_of(bent.cameras[k], name, ray).tolist())

        lines = [replace(line, pixel=moved(line.image, line.pixel)) for line in site.gcp_lines()]
        column, line = moved(photo, (300, 900))
        assert np.hypot(column - 300, line - 900) > 1
        (tmp_path / lens).mkdir()
        found = tie(tmp_path / lens, bent, lines, f"{photo}@{column},{line}")
        assert found == (pytest.approx(off, abs=0.003), pytest.approx(distance, abs=0.003))


@pytest.mark.parametrize("lens", ["OPENCV", "EQUIRECTANGULAR"])
def test_a_distorted_photo_is_evaluated_by_its_rays(lens: str, tmp_path: Path) -> None:
    """The photo is that of a wall of a smooth pattern; its undistorted content is what the wall's splats render."""
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-6, 6, (60_000, 2)), np.full(60_000, 2.0)]
    n = len(points)
    sh = ((np.c_[np.sin(points[:, :2]), np.cos(points[:, 0])]) * 0.4)[:, None]
    sigmas = np.log(np.tile([0.05, 0.05, 0.001], (n, 1)))
    wall = Gaussians(points, np.tile([1.0, 0, 0, 0], (n, 1)), sigmas, np.full(n, 3.0), sh)
    pinhole = Cameras(np.eye(4)[None], np.array([[200.0, 200, 160, 120]]), np.array([[320, 240]]), ("a.jpg",))
    cameras = seen_by(pinhole, lens)
    model = cameras.lenses[0].model
    width, height = model.size_px
    rays = rays_of(model, np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2))
    with np.errstate(all="ignore"):
        x, y = (rays[:, :2] / rays[:, 2:] * 2).T
    colour = 0.5 + SH_C0 * 0.4 * np.stack([np.sin(x), np.sin(y), np.cos(x)], 1)
    seen = (rays[:, 2] > 0) & (np.abs(x) < 6) & (np.abs(y) < 6)
    photo = (np.where(seen[:, None], colour, 0).reshape(height, width, 3) * 255).round().astype(np.uint8)
    Image.fromarray(photo).save(tmp_path / "a.png")
    rows = find_images(cameras, tmp_path)
    assert sorted(rows) == list(range(len(cameras)))
    scores = compare_renders(wall, cameras, {0: rows[0]})
    straight = compare_renders(wall, pinhole, {0: photo}) if lens == "OPENCV" else None
    assert scores.psnr_db[0] > 35
    assert straight is None or straight.psnr_db[0] < 30
