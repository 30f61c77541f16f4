"""From a rough pose to a sharp one: the map rendered from there, its patches found in the photo, and again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.localize import evidence, features, resection, tracking
from gsmap.localize.looks import GREY, Look, look
from gsmap.localize.placed import PlacedFeatures


@dataclass(frozen=True)
class Params:
    """How often the map is rendered, and how far patches are looked for.

    Args:
        reach_px: of each round, at the full size of the picture; all but the last are done at half of it.
        max_scenes: that are rendered, those with most matches first.
        min_found: patches; with fewer the pose stays as it was.
    """

    reach_px: tuple[int, ...] = (32, 24, 6)
    max_scenes: int = 3
    min_found: int = 8


@dataclass(frozen=True, eq=False)
class Picture:
    """A photo as localisation works on it: small enough, and grey as well.

    Args:
        rgb: (H, W, 3) float32 in [0, 1].
        grey: (H, W) float32.
        intrinsics_px: (4,) of this size.
        focal_sigma: as in `gsmap.types.localization.Photo`.
    """

    rgb: np.ndarray
    grey: np.ndarray
    intrinsics_px: np.ndarray
    focal_sigma: float

    @property
    def size_px(self) -> tuple[int, int]:
        return self.grey.shape[1], self.grey.shape[0]

    def halved(self) -> Picture:
        height, width = (n // 2 * 2 for n in self.grey.shape)
        rgb = self.rgb[:height, :width].reshape(height // 2, 2, width // 2, 2, 3).mean((1, 3))
        return Picture(rgb, rgb @ GREY, self.intrinsics_px / 2, self.focal_sigma)


@dataclass(frozen=True, eq=False)
class Settled:
    """A pose that was sharpened, and by what.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) of the picture's size.
        fit: the last adjustment; None where too little was found.
        pixels: (K, 2) where its patches were found.
        points: (K, 3) their places, metres.
        scene: (K,) int, whose patches they are, among ``looks``.
        tried: how many patches were looked for in the last round.
        looks: renders from the pose.
        moved: rad and metres from the rough pose.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    fit: resection.Refined | None
    pixels: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    tried: int
    looks: Sequence[Look]


def settle(
    picture: Picture,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    scenes: Sequence[PlacedFeatures],
    params: Params,
    lifting: features.Params,
    tracks: tracking.Params,
    poses: resection.Params,
) -> Settled:
    """Render, find again, adjust; as often as ``reach_px`` has rounds.

    Args:
        picture: of the photo.
        intrinsics_px: (4,) of the picture's size, as far as they are known.
        scenes: that may show the place, those that matter most first.
    """
    pose, lens = T_metric_camera, intrinsics_px
    scenes = scenes[: params.max_scenes]
    fit, pixels, points, scene, tried = None, np.zeros((0, 2)), np.zeros((0, 3)), np.zeros(0, int), 0
    for number, reach in enumerate(params.reach_px):
        half = number < len(params.reach_px) - 1
        seen = picture.halved() if half else picture
        factor = 0.5 if half else 1.0
        looks = look(scenes, pose, lens * factor, seen.size_px, lifting)
        found, places, whose, tried = [], [], [], 0
        for place, one in enumerate(looks):
            hits = tracking.track(one.grey, one.sound, seen.grey, int(np.ceil(reach * factor)), tracks)
            keep = hits.found
            tried += len(keep)
            found.append(hits.photo_px[keep] / factor)
            places.append(one.points(hits.render_px[keep], pose, lens * factor))
            whose.append(np.full(int(keep.sum()), place))
        if sum(map(len, found)) < params.min_found:
            break
        pixels, points, scene = np.concatenate(found), np.concatenate(places), np.concatenate(whose)
        start = pose
        if half:  # some of what was found far away is wrong
            again = resection.resect(pixels, points, lens, picture.size_px, 0.0, poses)
            if again is not None:
                start = again.T_map_camera
        free = None if picture.focal_sigma <= 0.01 else (picture.intrinsics_px[0], picture.focal_sigma)
        fit = resection.refine(pixels, points, start, lens, poses, focal=free)
        pose, lens = fit.T_map_camera, fit.intrinsics_px
    looks = look(scenes, pose, lens, picture.size_px, lifting)
    return Settled(pose, lens, fit, pixels, points, scene, tried, looks)


def inliers(settled: Settled, params: evidence.Params, size_px: tuple[int, int]) -> np.ndarray:
    """(K,) bool: patches that lie where the pose predicts them."""
    if settled.fit is None:
        return np.zeros(0, bool)
    bar = params.inlier_px * max(size_px) / 480
    out: np.ndarray = np.linalg.norm(settled.fit.residuals_px, axis=1) < bar
    return out
