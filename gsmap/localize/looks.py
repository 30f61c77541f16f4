"""What the scenes of the map show from where a photograph may have been taken."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.projection import project
from gsmap.localize import displacing, features
from gsmap.localize.placed import PlacedFeatures
from gsmap.render import render

_EVERY = 12  # of a render's rows and columns every so many are asked whether they moved ...
_MOST = 0.9  # ... and so large a share of them counts
GREY = np.array([0.299, 0.587, 0.114], np.float32)  # Rec. 601


def smaller(image: np.ndarray, by: int) -> np.ndarray:
    """(H // by, W // by, ...) float32 means of blocks of an image (H, W, ...)."""
    height, width = (n // by for n in image.shape[:2])
    rows = image[: height * by, : width * by].reshape(height, by, -1).sum(1, dtype=np.float32)  # whole rows: quicker
    out: np.ndarray = rows.reshape(height, width, by, *image.shape[2:]).sum(2) / np.float32(by * by)
    return out


def wholly(mask: np.ndarray | None, by: int) -> np.ndarray | None:
    """(H // by, W // by) bool: blocks of a mask (H, W) all of which is true; of no mask none."""
    return None if mask is None else smaller(mask, by) == 1


def at_pixels(mask: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(K,) bool of pixels (K, 2): what a mask (H, W) says there; outside as at its edge."""
    column, row = np.clip(pixels, 0, np.array(mask.shape[1::-1]) - 1).astype(np.int64).T
    out: np.ndarray = mask[row, column]
    return out


@dataclass(frozen=True, eq=False)
class Look:
    """A render of one scene through a camera of the map.

    Args:
        scene: whose it is.
        rgb: (H, W, 3) float32 in [0, 1].
        grey: (H, W) float32.
        alpha: (H, W) float32.
        depth_m: (H, W) float32 along the axis, 0 where nothing is.
        sound: (H, W) bool: opaque, and not at an edge in depth.
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) of this size.
        displacement: (R, C, 2) of `gsmap.localize.displacing`, or None where it was not asked for.
    """

    scene: str
    rgb: np.ndarray
    grey: np.ndarray
    alpha: np.ndarray
    depth_m: np.ndarray
    sound: np.ndarray
    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    displacement: np.ndarray | None = None

    def smaller(self, by: int) -> Look:
        """The same, so many times smaller; sound is what is not wholly empty."""
        alpha = smaller(self.alpha, by)
        rgb, grey, depth = (smaller(image, by) for image in (self.rgb, self.grey, self.depth_m))
        return Look(self.scene, rgb, grey, alpha, depth, alpha > 0, self.T_metric_camera, self.intrinsics_px / by)

    def points(self, pixels: np.ndarray) -> np.ndarray:
        """(K, 3) places in the map, in metres, of pixels (K, 2) of the render."""
        column, row = pixels.astype(np.int64).T
        z = self.depth_m[row, column].astype(np.float64)
        fx, fy, cx, cy = self.intrinsics_px
        local = np.stack([(pixels[:, 0] - cx) / fx * z, (pixels[:, 1] - cy) / fy * z, z], axis=1)
        out: np.ndarray = local @ self.T_metric_camera[:3, :3].T + self.T_metric_camera[:3, 3]
        return out

    def displaced_px(self, pixels: np.ndarray) -> np.ndarray:
        """(K, 2) by how much what pixels (K, 2) show lies elsewhere; 0 where that was not asked for."""
        if self.displacement is None:
            return np.zeros((len(pixels), 2))
        rows, columns = self.displacement.shape[:2]
        height, width = self.depth_m.shape
        column = np.minimum(pixels[:, 0] / width * columns, columns - 1).astype(np.int64)
        row = np.minimum(pixels[:, 1] / height * rows, rows - 1).astype(np.int64)
        out: np.ndarray = self.displacement[row, column]
        return out

    def places(self, pixels: np.ndarray) -> np.ndarray:
        """(K, 3) places in the map, in metres, of what pixels (K, 2) show: that is elsewhere by `displaced_px`."""
        most = np.array(self.depth_m.shape[1::-1]) - 1e-3
        return self.points(np.clip(pixels + self.displaced_px(pixels), 0, most))

    def moved_px(self, T_metric_camera: np.ndarray, intrinsics_px: np.ndarray) -> float:
        """How far most of what it shows lies from there through another camera; inf where it shows nothing."""
        row, column = np.nonzero(self.alpha[::_EVERY, ::_EVERY] > 0.5)
        if not len(row):
            return np.inf
        pixels = np.stack([column, row], axis=1) * float(_EVERY) + 0.5
        at, depth = project(self.points(pixels), np.linalg.inv(T_metric_camera), intrinsics_px)
        return float(np.quantile(np.where(depth > 0, np.linalg.norm(at - pixels, axis=1), 1e9), _MOST))


def look(
    scenes: Sequence[PlacedFeatures],
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    params: features.Params,
    known: Sequence[Look] = (),
    within_px: float = 0.0,
    displaced: displacing.Params | None = None,
) -> list[Look]:
    """Every scene through one camera of the map; each alone, for two captures laid over each other blur each other.

    Args:
        known: renders of this size; what has not moved by more than ``within_px`` since is not rendered again.
        displaced: asks as well by how much what they show lies elsewhere.
    """
    still = {one.scene: one for one in known if one.moved_px(T_metric_camera, intrinsics_px) <= within_px}
    out = []
    for one in scenes:
        if one.scene in still:
            out.append(still[one.scene])
            continue
        camera = one.camera(T_metric_camera, intrinsics_px, size_px)
        shown = render(one.gaussians, camera, dominant_id=False, backend="native")
        rgb = np.clip(np.nan_to_num(shown.colour[0]), 0, 1)
        depth = shown.depth[0] * np.float32(one.S_metric_scene.scale)
        sound = features.sound_depth(shown, params) > 0
        away = None
        if displaced is not None and displaced.share > 0:
            away = displacing.displacement(one, T_metric_camera, intrinsics_px, size_px, displaced)
        alpha = shown.alpha[0]
        out.append(Look(one.scene, rgb, rgb @ GREY, alpha, depth, sound, T_metric_camera, intrinsics_px, away))
    return out
