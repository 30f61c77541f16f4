"""Draw pictures of a change for review: both captures from the same camera, with the surroundings of the change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw

from gsmap.geometry.boxes import box_corners
from gsmap.geometry.projection import in_image, project
from gsmap.render import render
from gsmap.types import Cameras, PosedScene

_TRIED = 12  # maximum number of cameras that are rendered to choose one
_TRIED_PX = 96
_NEAR = 0.15  # maximum distance in metres from a rendered surface to a changed point
_BOX_SHARE = 0.4  # largest side of the box as a fraction of the picture's, so that its surroundings are recognized
_MIN_WIDTH = 0.6  # smallest width of a picture, as a fraction of the camera image's
_MAX_SLOPE = 1.2  # half of the widest picture divided by the focal length: about 100 degrees
_ASPECT = 4 / 3
_GAP_PX = 4
_POINTS = 500  # maximum number of points in a box by which a camera is chosen
_FRAME = (255, 64, 64)


@dataclass(frozen=True, eq=False)
class _View:
    """A camera that shows a box and its surroundings, with a score that is higher the better it shows the box."""

    camera: Cameras
    score: float


def draw_change(
    older: PosedScene, newer: PosedScene, box: np.ndarray, points: np.ndarray, side_px: int = 320
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the place before and after a change from the same camera, with the change's box: (H, W, 3) uint8 each.

    Args:
        older, newer: Both captures in one metric frame.
        box: (2, 3) bounding box of the change.
        points: (K, 3) changed points; the camera that shows most of them and of their surroundings is chosen.
        side_px: Longer side of each of the two pictures, in pixels.
    """
    camera = _sized(_best(older, newer, box, points), side_px)
    return _picture(older, camera, box), _picture(newer, camera, box)


def beside(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return two pictures (H, W, 3) beside each other."""
    gap = np.full((before.shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([before, gap, after], axis=1)


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
                draw.line([*map(tuple, pixels[[a, b]].tolist())], fill=_FRAME, width=max(1, picture.width // 250))
    return np.asarray(picture)


def _best(older: PosedScene, newer: PosedScene, box: np.ndarray, points: np.ndarray) -> Cameras:
    """Return the camera, at the pose of one of either capture, that shows most of the change and its surroundings."""
    cameras = [
        scene.cameras[i] for scene in (older, newer) if scene.cameras is not None for i in range(len(scene.cameras))
    ]
    views = sorted((view for one in cameras if (view := _view(one, box, points)) is not None), key=lambda v: -v.score)
    if not views:
        return _from_outside(box)
    scores = [view.score + _rendered_score((older, newer), view.camera, points) for view in views[:_TRIED]]
    return views[int(np.argmax(scores))].camera


def _view(camera: Cameras, box: np.ndarray, points: np.ndarray) -> _View | None:
    """Crop or widen a camera around a box; None if its image shows none of the points."""
    pixels, depth = _project(points, camera)
    shown = in_image(pixels, depth, camera.sizes_px[0])
    if not shown.any():
        return None
    size = camera.sizes_px[0].astype(np.float64)
    at, deep = _project(box_corners(box), camera)
    at = np.clip(at[deep > 0], -size, 2 * size) if (deep > 0).any() else pixels[shown]
    low, high = at.min(0), at.max(0)
    fx, fy, cx, cy = camera.intrinsics_px[0]
    extent = float(((high - low) * (1, _ASPECT)).max())
    width = min(max(extent / _BOX_SHARE, _MIN_WIDTH * size[0]), 2 * _MAX_SLOPE * fx)
    window = np.array([width, width / _ASPECT])
    # Inside the camera's image where it fits, as only that was observed.
    spare = np.maximum(size - window, 0)
    corner = np.where(spare > 0, np.clip((low + high - window) / 2, 0, spare), (size - window) / 2)
    inside = np.minimum(corner + window, size) - np.maximum(corner, 0)
    intrinsics = np.array([[fx, fy, cx - corner[0], cy - corner[1]]])
    made = Cameras(camera.T_frame_camera, intrinsics, np.ceil(window)[None].astype(np.int64), camera.names)
    observed = float(inside.prod() / window.prod())
    off_centre = float((np.abs((low + high) / 2 - corner - window / 2) / window).max())  # 0.5 at the border
    return _View(made, float(shown.mean()) + observed + min(extent / width, _BOX_SHARE) - off_centre)


def _rendered_score(scenes: Sequence[PosedScene], camera: Cameras, points: np.ndarray) -> float:
    """Return the fraction of points on the surface that a camera sees, plus the opaque fraction of its image."""
    small = _sized(camera, _TRIED_PX)
    pixels, deep = _project(points, small)
    shown = in_image(pixels, deep, small.sizes_px[0])
    rows = pixels[shown].astype(int)
    seen, opaque = 0.0, 1.0
    for scene in scenes:
        found = render(scene.gaussians, small)
        near = np.abs(found.depth[0][rows[:, 1], rows[:, 0]] - deep[shown]) < _NEAR
        seen = max(seen, float(near.sum()) / len(points))
        opaque = min(opaque, float((found.alpha[0] > 0.5).mean()))
    return seen + opaque


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
