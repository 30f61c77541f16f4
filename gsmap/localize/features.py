"""Extract local features from rendered views of a scene and lift them to its surfaces."""

from __future__ import annotations

import numpy as np

from gsmap.geometry.filters import maximum, minimum
from gsmap.localize import views
from gsmap.methods.extractor import Extractor
from gsmap.render import ChunkIndex, Rendering, render
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import Keypoints, SceneFeatures

VERSION = 3
"""Version, raised whenever the features of a scene, its views (`gsmap.localize.views`) or `INDEXED_FEATURES` change."""

UNIT = 254.0
"""Length of quantized descriptors; unit vectors of 64 or more dimensions hardly have a component above a half."""

INDEXED_FEATURES = 150
"""Number of features of a view that are indexed: the largest, because small features repeat. Without sizes, the
first."""

_MIN_ALPHA = 0.9
_MAX_DEPTH_STEP = 0.05  # with a larger relative depth difference around it a pixel lies at an edge ...
_EDGE_REACH_PX = 3  # ... measured within this many pixels
_MIN_COVERAGE = 0.2  # of a view; with less the camera looks out of the scene, or is inside an object


def scene_features(
    scene: str, gaussians: Gaussians, cameras: Cameras, extractor: Extractor, params: views.Params | None = None
) -> SceneFeatures:
    """Render views of a scene and extract their features.

    Args:
        scene: id of the scene.
        gaussians, cameras: Gaussians and cameras in the scene's frame and unit.
    """
    params = params or views.Params()
    chosen = views.select_views(gaussians, cameras, params)
    index = ChunkIndex.build(gaussians)
    points, descriptors, angles, kept = [], [], [], []
    for row in range(len(chosen)):
        camera = chosen[row]
        rendered = render(gaussians, camera, dominant_id=False, index=index, backend="native")
        if (rendered.alpha[0] > _MIN_ALPHA).mean() < _MIN_COVERAGE:
            continue
        found = extractor.extract(to_uint8(rendered))
        rows, positions = lift(found, rendered, camera)
        first = _order_by_size(found, rows[: params.max_features])
        rows = rows[first]
        kept.append(row)
        points.append(positions[first].astype(np.float32))
        descriptors.append(quantize(found.descriptors[rows]))
        angles.append(quantize_angles(found)[rows])
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


def _order_by_size(found: Keypoints, rows: np.ndarray) -> np.ndarray:
    """Return the (n,) order of features by decreasing size; the given order without sizes."""
    if found.sizes_px is None:
        return np.arange(len(rows))
    return np.argsort(-found.sizes_px[rows], kind="stable")


def to_uint8(rendered: Rendering, row: int = 0) -> np.ndarray:
    """Return the image of one row of a render, (H, W, 3) uint8."""
    return (np.clip(np.nan_to_num(rendered.colour[row]), 0, 1) * 255 + 0.5).astype(np.uint8)


def lift(found: Keypoints, rendered: Rendering, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Lift features to 3D points on the rendered surface.

    Args:
        rendered: the render from which the features were extracted, with depth.
        camera: camera of the render.

    Returns:
        (n,) rows of the features on smooth surfaces, and (n, 3) their positions in the camera's frame of reference.
    """
    at = smooth_depth(rendered)
    column, row = found.pixels.astype(np.int64).T
    height, width = at.shape
    rows = np.flatnonzero((column >= 0) & (column < width) & (row >= 0) & (row < height))
    depth = at[row[rows], column[rows]]
    rows, depth = rows[depth > 0], depth[depth > 0]
    return rows, unproject(found.pixels[rows], depth, camera)


def smooth_depth(rendered: Rendering) -> np.ndarray:
    """Return the (H, W) depth where the surface is opaque and away from depth edges; 0 elsewhere."""
    depth, size = rendered.depth[0], 2 * _EDGE_REACH_PX + 1
    solid = rendered.alpha[0] > _MIN_ALPHA
    near = minimum(np.where(solid, depth, 0), size)
    far = maximum(depth, size)
    return np.where(solid & (far - near <= _MAX_DEPTH_STEP * depth), depth, np.float32(0))


def unproject(pixels: np.ndarray, depth: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return the (N, 3) positions of pixels (N, 2) with depths (N,) along the axis, in the frame of the camera's
    pose."""
    fx, fy, cx, cy = camera.intrinsics_px[0]
    local = np.stack([(pixels[:, 0] - cx) / fx * depth, (pixels[:, 1] - cy) / fy * depth, depth], axis=1)
    out: np.ndarray = local @ camera.T_frame_camera[0, :3, :3].T + camera.centers[0]
    return out


def quantize(descriptors: np.ndarray) -> np.ndarray:
    """Quantize unit vectors to (N, D) int8; dot products equal the original dot products times 254 squared, to a
    percent."""
    out: np.ndarray = np.clip(np.round(descriptors * UNIT), -127, 127).astype(np.int8)
    return out


def quantize_angles(found: Keypoints) -> np.ndarray:
    """Return the (N,) uint8 angles of features, where 256 is a full turn; zeros without angles."""
    if found.angles_rad is None:
        return np.zeros(len(found), np.uint8)
    out: np.ndarray = np.round(found.angles_rad * (128 / np.pi)).astype(np.int64).astype(np.uint8)
    return out
