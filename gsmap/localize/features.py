"""What the views of a scene show: rendered, features found in them, and each lifted to the surface that it lies on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.localize import views
from gsmap.localize.filters import highest, lowest
from gsmap.methods.extractor import Extractor
from gsmap.render import Rendering, render
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import Keypoints, SceneFeatures

VERSION = 3

UNIT = 254.0
"""Length of quantised descriptors: unit vectors of 64 and more dimensions hardly have a part above a half."""


@dataclass(frozen=True)
class Params:
    """Which features of a render are kept.

    Args:
        max_features: of a view; those that the extractor gives first.
        indexed: of these, the largest that photographs are looked for by: small ones repeat themselves. Of an extractor
            that says no sizes, the first.
        min_alpha: where the render is fainter, nothing is known of the surface.
        max_step: a feature whose surroundings differ in depth by more than this share lies on an edge, and its place
            is not known.
        around_px: how far those surroundings reach.
    """

    max_features: int = 600
    indexed: int = 150
    min_alpha: float = 0.9
    max_step: float = 0.05
    around_px: int = 3


def scene_features(
    scene: str,
    gaussians: Gaussians,
    cameras: Cameras,
    extractor: Extractor,
    view_params: views.Params | None = None,
    params: Params | None = None,
) -> SceneFeatures:
    """Render a scene and keep what photographs can be found by.

    Args:
        scene: its id.
        gaussians, cameras: scene frame and unit.
    """
    params = params or Params()
    chosen = views.choose_views(gaussians, cameras, view_params)
    points, descriptors, angles, kept = [], [], [], []
    for row in range(len(chosen)):
        camera = chosen[row]
        shown = render(gaussians, camera, dominant_id=False, backend="native")
        if (shown.alpha[0] > params.min_alpha).mean() < 0.2:  # it looks out of the scene, or stands inside something
            continue
        found = extractor.extract(picture(shown))
        rows, places = lifted(found, shown, camera, params)
        first = _largest_first(found, rows[: params.max_features])
        rows = rows[first]
        kept.append(row)
        points.append(places[first].astype(np.float32))
        descriptors.append(quantised(found.descriptors[rows]))
        angles.append(turns(found)[rows])
    count = np.array([len(p) for p in points], dtype=np.int64)
    width = descriptors[0].shape[1] if descriptors else 0
    return SceneFeatures(
        scene,
        chosen[np.array(kept, dtype=np.int64)],
        np.r_[0, np.cumsum(count)].astype(np.int64),
        np.concatenate([np.zeros((0, 3), np.float32), *points]),
        np.concatenate([np.zeros((0, width), np.int8), *descriptors]),
        np.concatenate([np.zeros(0, np.uint8), *angles]),
    )


def _largest_first(found: Keypoints, rows: np.ndarray) -> np.ndarray:
    """(n,) order of some features by size; as they are where sizes are not known."""
    if found.sizes_px is None:
        return np.arange(len(rows))
    return np.argsort(-found.sizes_px[rows], kind="stable")


def picture(shown: Rendering, row: int = 0) -> np.ndarray:
    """(H, W, 3) uint8 of a render."""
    return (np.clip(np.nan_to_num(shown.colour[row]), 0, 1) * 255 + 0.5).astype(np.uint8)


def lifted(
    found: Keypoints, shown: Rendering, camera: Cameras, params: Params | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Which features lie on a surface whose place is known, and where.

    Args:
        shown: the render that they were found in, with depth.
        camera: that it was rendered through.

    Returns:
        (n,) their rows, and (n, 3) places in the camera's frame of reference.
    """
    params = params or Params()
    at = sound_depth(shown, params)
    column, row = found.pixels.astype(np.int64).T
    height, width = at.shape
    rows = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    depth = at[row[rows], column[rows]]
    rows, depth = rows[depth > 0], depth[depth > 0]
    return rows, unprojected(found.pixels[rows], depth, camera)


def sound_depth(shown: Rendering, params: Params | None = None) -> np.ndarray:
    """(H, W) depth where the surface is opaque and smooth, else 0."""
    params = params or Params()
    depth, size = shown.depth[0], 2 * params.around_px + 1
    solid = shown.alpha[0] > params.min_alpha
    near = lowest(np.where(solid, depth, 0), size)
    far = highest(depth, size)
    return np.where(solid & (far - near <= params.max_step * depth), depth, np.float32(0))


def unprojected(pixels: np.ndarray, depth: np.ndarray, camera: Cameras) -> np.ndarray:
    """(N, 3) places of pixels (N, 2) at depths (N,) along the axis, in the frame that one camera is posed in."""
    fx, fy, cx, cy = camera.intrinsics_px[0]
    local = np.stack([(pixels[:, 0] - cx) / fx * depth, (pixels[:, 1] - cy) / fy * depth, depth], axis=1)
    out: np.ndarray = local @ camera.T_frame_camera[0, :3, :3].T + camera.centers[0]
    return out


def quantised(descriptors: np.ndarray) -> np.ndarray:
    """(N, D) int8 of unit vectors, whose dot products are those of the vectors times 254 squared, to a percent."""
    out: np.ndarray = np.clip(np.round(descriptors * UNIT), -127, 127).astype(np.int8)
    return out


def turns(found: Keypoints) -> np.ndarray:
    """(N,) uint8 of the angles of features, 256 to a full turn; zeros where there are none."""
    if found.angles_rad is None:
        return np.zeros(len(found), np.uint8)
    out: np.ndarray = np.round(found.angles_rad * (128 / np.pi)).astype(np.int64).astype(np.uint8)
    return out
