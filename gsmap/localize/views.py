"""Select the views of a scene with which photos are matched: its own cameras, and synthetic views off their path."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.projection import in_image, project
from gsmap.settings.ranges import require_range
from gsmap.types import Cameras, Gaussians

_TURN_FRACTION = 0.6  # a shift by this share of the median content distance changes a view as much as a radian
_MAX_POINTS = 4000  # opaque Gaussians that represent the scene
_MIN_GAIN = 0.01  # if the mean gain in resolution is smaller, no more synthetic views are added
_OCCLUSION = 1.15  # largest ratio of a visible point's depth to the depth of the nearest point in its pixel


@dataclass(frozen=True)
class Params:
    """Settings of the views of a scene.

    Args:
        image_size_px: Longer side in pixels, at least 64, of the renders and of the photos that are matched with them;
            larger is more accurate and slower.
        max_own_views: Largest number of the scene's own cameras, at least 0, from which views are rendered; larger
            localizes more photos and takes more space.
        max_synthetic_views: Largest number of synthetic views, at least 0, that are rendered from free space off the
            cameras' path; larger localizes more photos from unusual positions and takes more space.
        max_features: Largest number of features, at least 1, that are stored per view; larger localizes more photos and
            takes more space.
    """

    image_size_px: int = 480
    max_own_views: int = 24
    max_synthetic_views: int = 8
    max_features: int = 600

    def __post_init__(self) -> None:
        require_range(self, "[64, inf]", "image_size_px")
        require_range(self, "[0, inf]", "max_own_views", "max_synthetic_views")
        require_range(self, "[1, inf]", "max_features")


def select_views(gaussians: Gaussians, cameras: Cameras, params: Params | None = None) -> Cameras:
    """Select the cameras from which a scene is rendered: first its own cameras, then synthetic ones.

    Of the scene's own cameras, those farthest from each other in position and direction are selected, so that the
    images of a standstill do not use up the number. Synthetic cameras are placed in free space and see surfaces that
    the own cameras do not see from the front or from nearby.

    Returns:
        At most ``max_own_views + max_synthetic_views`` cameras, resized to the size of the renders.
    """
    params = params or Params()
    points = _sample_points(gaussians)
    synthetic = cameras if cameras.synthesised else synthesise_cameras(gaussians)
    if cameras.synthesised:
        chosen = cameras[_farthest_points(cameras, points, params.max_own_views + params.max_synthetic_views)]
    else:
        chosen = cameras[_farthest_points(cameras, points, params.max_own_views)]
        more = synthetic[_complement(points, chosen, synthetic, params.max_synthetic_views)]
        chosen = Cameras(
            np.concatenate([chosen.T_frame_camera, more.T_frame_camera]),
            np.concatenate([chosen.intrinsics_px, more.intrinsics_px]),
            np.concatenate([chosen.sizes_px, more.sizes_px]),
        )
    return chosen.resized(params.image_size_px)


def _sample_points(gaussians: Gaussians) -> np.ndarray:
    """Return the (P, 3) means of opaque Gaussians, at most `_MAX_POINTS`."""
    solid = np.flatnonzero(gaussians.logit_opacities > 0.0)
    rows = np.linspace(0, len(solid) - 1, min(len(solid), _MAX_POINTS)).astype(int)
    return gaussians.means[solid[rows]].astype(np.float32)


def _farthest_points(cameras: Cameras, points: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of the cameras that are farthest from each other in position and direction, in their original
    order."""
    if len(cameras) <= count or not len(points):
        return np.arange(len(cameras))[:count]
    from_middle = np.linalg.norm(points - np.median(cameras.centers, axis=0), axis=1)
    lever = _TURN_FRACTION * float(np.median(from_middle))
    features = np.concatenate([cameras.centers, lever * cameras.T_frame_camera[:, :3, 2]], axis=1)
    chosen = [0]
    apart = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return np.sort(chosen)


def _complement(points: np.ndarray, own: Cameras, synthetic: Cameras, count: int) -> list[int]:
    """Return the rows of the synthetic cameras that add most resolution to the views of the own cameras."""
    best = np.zeros(len(points))
    for camera in range(len(own)):
        best = np.maximum(best, _resolution(points, own, camera))
    details = [_resolution(points, synthetic, camera) for camera in range(len(synthetic))]
    chosen: list[int] = []
    while len(chosen) < count:
        # A gain in resolution counts up to a factor of two, because splats have no finer detail.
        gains = [np.log2(np.maximum(d, 1e-9) / np.maximum(best, d / 2 + 1e-9)).clip(0, 1).sum() for d in details]
        pick = int(np.argmax(gains)) if gains else -1
        if pick < 0 or gains[pick] < _MIN_GAIN * len(points):
            break
        chosen.append(pick)
        best = np.maximum(best, details[pick])
    return chosen


def _resolution(points: np.ndarray, cameras: Cameras, row: int) -> np.ndarray:
    """Return the (P,) resolution at which a camera sees each point, relative to the image size; 0 for hidden points."""
    coarse = cameras[[row]].resized(24)
    width, height = (int(v) for v in coarse.sizes_px[0])
    pixels, depth = project(points, coarse.T_camera_frame[0], coarse.intrinsics_px[0])
    seen = np.flatnonzero(in_image(pixels, depth, coarse.sizes_px[0]))
    column, line = pixels[seen].astype(np.int64).T
    nearest = np.full(width * height, np.inf, np.float32)
    np.minimum.at(nearest, line * width + column, depth[seen])
    front = seen[depth[seen] <= _OCCLUSION * nearest[line * width + column]]
    out = np.zeros(len(points))
    out[front] = cameras.intrinsics_px[row, 0] / cameras.sizes_px[row].max() / depth[front]
    return out
