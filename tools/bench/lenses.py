"""Localize photos of other lenses in a map of the house: distorted frames and panoramas of a capture that it lacks.

    python -m tools.bench.lenses HOUSE

HOUSE is the folder of house captures with ``frames`` and ``truth``. The map consists of c1 and c3. Queries are the
frames of c0 as they are; the same frames distorted (OPENCV, k1 -0.15) and localized with the true model and as
pinholes; and ten panoramas rendered from c0's Gaussians.
"""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import gsmap.map
from gsmap import formats
from gsmap.geometry.camera_models import camera_model, pinhole_views, rays_of
from gsmap.map import Map
from gsmap.render import render
from gsmap.types import Cameras, Gaussians
from gsmap.types.cameras import CameraModel
from tools.harness import argument_parser, print_table, timed

DISTORTION = (-0.15, 0.03, 0.001, -0.001)
PANORAMA = (1536, 768)
QUERY, MAP = "c0", ("c1", "c3")


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("house", type=Path)
    house = parser.parse_args().house
    cameras = formats.read_cameras(house / f"{QUERY}.cameras.json")
    pinhole = ",".join(map(repr, cameras.intrinsics_px[0].tolist()))
    bent = f"OPENCV,{pinhole},{','.join(map(repr, DISTORTION))}"
    frames = sorted((house / "frames").glob(f"{QUERY}_*.jpg"))
    with tempfile.TemporaryDirectory() as folder, gsmap.map.create(Path(folder) / "house.gsmap") as m:
        distorted = [distort(path, cameras, Path(folder)) for path in frames]
        gaussians = formats.read(house / f"{QUERY}.ply")
        rows = np.linspace(0, len(cameras) - 1, 10).astype(int)
        panoramas = [panorama(gaussians, cameras[row], Path(folder) / f"pano_{row:03}.jpg") for row in rows]
        m.ingest(*(house / f"{name}.ply" for name in MAP), scale="known")
        m.update()
        truth = true_poses(house, m, cameras)
        print_table(
            ["queries", "n", "placed", "median, cm", "median, deg", "worst, cm", "CPU s"],
            [
                line(m, "undistorted frames", frames, pinhole, truth),
                line(m, "distorted, true model", distorted, bent, truth),
                line(m, "distorted, as pinholes", distorted, pinhole, truth),
                line(m, "panoramas", panoramas, "EQUIRECTANGULAR", truth),
            ],
        )


def rays(model: CameraModel) -> np.ndarray:
    """(H * W, 3) rays of all pixels."""
    width, height = model.size_px
    return rays_of(model, np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2))


def sampled(image: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Bilinear samples (N, C) of an image; its border goes on outside."""
    from scipy.ndimage import map_coordinates

    at = (pixels - 0.5).T[::-1]
    return np.stack([map_coordinates(channel, at, order=1, mode="nearest") for channel in np.moveaxis(image, -1, 0)], 1)


def distort(path: Path, cameras: Cameras, folder: Path) -> Path:
    """The frame as a lens with distortion would show it."""
    width, height = cameras.sizes_px[0].tolist()
    model = camera_model("OPENCV", width, height, (*cameras.intrinsics_px[0].tolist(), *DISTORTION))
    seen = rays(model)
    pixels = seen[:, :2] / seen[:, 2:] * cameras.intrinsics_px[0, :2] + cameras.intrinsics_px[0, 2:]
    shown = sampled(np.asarray(Image.open(path), np.float32), np.nan_to_num(pixels))
    Image.fromarray(shown.reshape(height, width, 3).round().astype(np.uint8)).save(folder / path.name, quality=95)
    return folder / path.name


def panorama(gaussians: Gaussians, camera: Cameras, path: Path) -> Path:
    """An equirectangular render around a camera."""
    width, height = PANORAMA
    model = camera_model("EQUIRECTANGULAR", width, height, (float(width), float(height)))
    seen, out = rays(model), np.zeros((width * height, 3), np.float32)
    views = pinhole_views(model, camera.T_frame_camera[0], "panorama")
    for row, lens in enumerate(views.lenses):
        assert lens is not None
        local = seen @ lens.R_photo_camera
        inside = np.abs(local[:, :2]).max(1) <= local[:, 2] * (1 + 1e-9)
        image = render(gaussians, views[row], depth=False, dominant_id=False).colour[0]
        focal, _, centre, _ = views.intrinsics_px[row]
        out[inside] = sampled(np.clip(image, 0, 1), local[inside, :2] / local[inside, 2:] * focal + centre)
    Image.fromarray((out.reshape(height, width, 3) * 255).round().astype(np.uint8)).save(path, quality=95)
    return path


def true_poses(house: Path, m: Map, cameras: Cameras) -> np.ndarray:
    """(C, 4, 4) poses of the query's cameras in the map frame."""

    def from_world(name: str) -> np.ndarray:
        return np.array(json.loads((house / "truth" / f"{name}.json").read_text())["T_scene_world"])

    S_map_query = m.poses()[MAP[0]].S_map_scene.matrix() @ from_world(MAP[0]) @ np.linalg.inv(from_world(QUERY))
    return S_map_query @ cameras.T_frame_camera


def line(m: Map, name: str, files: list[Path], intrinsics: str, truth: np.ndarray) -> list[object]:
    report, cpu = timed(m.localize, *files, intrinsics=intrinsics)
    off = []
    for row, path in zip(report.results, files, strict=True):
        if row.T_map_camera is not None:
            error = np.linalg.inv(truth[int(path.stem.rpartition("_")[2])]) @ row.T_map_camera
            angle = np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
            off.append((100 * np.linalg.norm(error[:3, 3]), angle))
    cm, deg = np.array(off).reshape(-1, 2).T
    shown = [f"{np.median(cm):.2f}", f"{np.median(deg):.2f}", f"{cm.max():.1f}"] if off else [None] * 3
    return [name, len(files), len(off), *shown, f"{cpu:.0f}"]


if __name__ == "__main__":
    main()
