"""Draw pictures of a change for review: both captures from the same camera, side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from gsmap.geometry.boxes import box_corners
from gsmap.geometry.projection import in_image, project
from gsmap.render import render
from gsmap.types import Cameras, PosedScene

_TRIED = 6  # maximum number of cameras that are rendered to choose one
_TRIED_PX = 120
_NEAR = 0.15  # maximum distance in metres from a rendered surface to a changed point
_MARGIN = 1.0  # margin around the box, as a fraction of its size
_LEAST_SHARE = 0.15  # smallest crop as a fraction of the image, so that small changes have context
_GAP_PX = 4
_POINTS = 500  # maximum number of points in a box by which a camera is chosen
_FRAME = (255, 64, 64)


@dataclass(frozen=True, eq=False)
class _Crop:
    """The camera of a cropped image, with a score that is higher the better it shows the box."""

    camera: Cameras
    score: float


def draw_change(
    older: PosedScene, newer: PosedScene, box: np.ndarray, points: np.ndarray, side_px: int = 320
) -> np.ndarray:
    """Draw the place before a change on the left and after it on the right, with the change's box: (H, W, 3) uint8.

    Args:
        older, newer: Both captures in one metric frame.
        box: (2, 3) bounding box of the change.
        points: (K, 3) changed points; the camera that shows most of them is chosen.
        side_px: Longer side of each of the two pictures, in pixels.
    """
    camera = _sized(_best(older, newer, box, points), side_px)
    halves = [_picture(scene, camera, box) for scene in (older, newer)]
    gap = np.full((halves[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([halves[0], gap, halves[1]], axis=1)


def draw_place(scene: PosedScene, box: np.ndarray, side_px: int = 320) -> np.ndarray:
    """Render a place in a scene from the camera that sees most of its box, with the box outlined: (H, W, 3) uint8.

    Args:
        scene: Scene in a metric frame.
        box: (2, 3) box in that frame.
        side_px: Longer side in pixels.
    """
    points = scene.gaussians.means[((scene.gaussians.means >= box[0]) & (scene.gaussians.means <= box[1])).all(1)]
    points = points[:: max(1, len(points) // _POINTS)] if len(points) else box
    return _picture(scene, _sized(_best(scene, scene, box, points), side_px), box)


def _picture(scene: PosedScene, camera: Cameras, box: np.ndarray) -> np.ndarray:
    colour = render(scene.gaussians, camera).colour[0]
    picture = Image.fromarray((np.clip(np.nan_to_num(colour), 0, 1) * 255 + 0.5).astype(np.uint8))
    corners = box_corners(box)
    pixels, depth = _project(corners, camera)
    draw = ImageDraw.Draw(picture)
    for a in range(8):
        for b in range(a + 1, 8):
            if (corners[a] != corners[b]).sum() == 1 and min(depth[a], depth[b]) > 0:  # an edge of the box
                draw.line([*map(tuple, pixels[[a, b]].tolist())], fill=_FRAME)
    return np.asarray(picture)


def _best(older: PosedScene, newer: PosedScene, box: np.ndarray, points: np.ndarray) -> Cameras:
    """Return the camera of either capture that sees most of the change, cropped to the change."""
    cameras = [
        scene.cameras[i] for scene in (older, newer) if scene.cameras is not None for i in range(len(scene.cameras))
    ]
    crops = sorted((crop for one in cameras if (crop := _crop(one, box, points)) is not None), key=lambda c: -c.score)
    if not crops:
        return _from_outside(box)
    seen = [max(_num_seen(scene, crop.camera, points) for scene in (older, newer)) for crop in crops[:_TRIED]]
    return crops[int(np.argmax(seen))].camera


def _crop(camera: Cameras, box: np.ndarray, points: np.ndarray) -> _Crop | None:
    """Crop a camera to the image region around a box; None if the region shows none of the points."""
    pixels, depth = _project(points, camera)
    shown = in_image(pixels, depth, camera.sizes_px[0])
    if not shown.any():
        return None
    size = camera.sizes_px[0].astype(np.float64)
    at, deep = _project(box_corners(box), camera)
    at = at[deep > 0] if (deep > 0).any() else pixels[shown]
    low, high = np.clip(at.min(0), 0, size), np.clip(at.max(0), 0, size)
    half = np.maximum((high - low).max() * (0.5 + _MARGIN / 2), _LEAST_SHARE * size.max())
    middle = (low + high) / 2
    low, high = np.floor(np.clip(middle - half, 0, size)), np.ceil(np.clip(middle + half, 0, size))
    width, height = (np.maximum(high - low, 2)).astype(int)
    fx, fy, cx, cy = camera.intrinsics_px[0]
    intrinsics = np.array([[fx, fy, cx - low[0], cy - low[1]]])
    cut = Cameras(camera.T_frame_camera, intrinsics, np.array([[width, height]]), camera.names)
    # Prefer cameras that show all points, and close ones.
    return _Crop(cut, float(shown.mean()) + min(1.0, float(half * 2 / size.max())))


def _num_seen(scene: PosedScene, camera: Cameras, points: np.ndarray) -> int:
    """Count the points that a camera sees, which lie on the surface in its image."""
    small = _sized(camera, _TRIED_PX)
    depth = render(scene.gaussians, small).depth[0]
    pixels, deep = _project(points, small)
    shown = in_image(pixels, deep, small.sizes_px[0])
    rows = pixels[shown].astype(int)
    return int((np.abs(depth[rows[:, 1], rows[:, 0]] - deep[shown]) < _NEAR).sum())


def _project(points: np.ndarray, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    return project(np.asarray(points, np.float64), camera.T_camera_frame[0], camera.intrinsics_px[0])


def _sized(camera: Cameras, longest_side_px: int) -> Cameras:
    """Return the camera scaled to another image size."""
    sizes = np.maximum(1, np.round(camera.sizes_px * (longest_side_px / camera.sizes_px.max()))).astype(np.int64)
    ratio = sizes / camera.sizes_px
    intrinsics = camera.intrinsics_px * np.concatenate([ratio, ratio], axis=1)
    return Cameras(camera.T_frame_camera, intrinsics, sizes, camera.names)


def _from_outside(box: np.ndarray) -> Cameras:
    """Return a camera that looks at a box from the side and above, for boxes that no capture camera saw."""
    middle, size = box.mean(0), float(np.linalg.norm(box[1] - box[0])) + 0.5
    ahead = np.array([1.0, 1.0, -0.7]) / np.linalg.norm([1.0, 1.0, -0.7])
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], 1)
    pose[:3, 3] = middle - 1.5 * size * ahead
    return Cameras(pose[None], np.array([[300.0, 300, 160, 120]]), np.array([[320, 240]]), ("outside",))
