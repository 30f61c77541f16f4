"""Pack each feature of a scene's views into two dozen bytes, which keeps about as many matches.

Descriptors are rotated to their principal axes and rounded to multiples of one step (transform coding); the rotation is
stored with them. Positions are steps along a Morton curve.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from gsmap.localize import compression
from gsmap.localize.features import UNIT
from gsmap.types import Cameras
from gsmap.types.localization import SceneFeatures

NAMES = (
    *("features.counts", "features.grid", "features.places", "features.mean", "features.axes"),
    *("features.descriptors", "features.angles", "views.poses", "views.intrinsics", "views.sizes"),
)

_STEP = 0.08  # rounding step of a unit vector along each axis
_MIN_NONZERO = 0.02  # an axis with a smaller share of nonzero components is dropped
_AXIS = 127.0  # length of an axis


def pack(features: SceneFeatures, step: float, first: int) -> dict[str, np.ndarray]:
    """Pack a scene's features into arrays.

    Args:
        step: step to which positions are rounded, in the scene's unit.
        first: number of indexed features of a view; they remain the first features, in any order.
    """
    starts = features.starts
    split = np.minimum(starts[:-1] + first, starts[1:])
    runs = np.r_[np.stack([starts[:-1], split], axis=1).reshape(-1), starts[-1]]
    low = features.points.min(0).astype(np.float64) if features.num_features else np.zeros(3)
    step = compression.finest_step(features.points, step)
    codes = compression.encode_points(features.points, low, step)
    sorted_runs = [a + np.argsort(codes[a:b], kind="stable") for a, b in pairwise(runs.tolist())]
    order = np.concatenate([np.zeros(0, np.int64), *sorted_runs])  # a scene may have no views
    mean, axes = _principal(features.descriptors)
    along = (features.descriptors[order].astype(np.float64) - mean) @ (axes / (_AXIS * UNIT))
    rounded = np.clip(np.round(along / _STEP), -127, 127).astype(np.int8)
    keep = (rounded != 0).sum(0) > _MIN_NONZERO * len(rounded)
    return {
        "features.counts": np.stack([split - starts[:-1], starts[1:] - split]),
        "features.grid": np.r_[low, step],
        "features.places": compression.compress(compression.code_steps(codes[order], runs[:-1])),
        "features.mean": mean,
        "features.axes": axes[:, keep],
        "features.descriptors": compression.compress(rounded[:, keep].T),
        "features.angles": features.angles[order].astype(np.uint8),
        "views.poses": features.cameras.T_frame_camera.reshape(-1, 16).astype(np.float64),
        "views.intrinsics": features.cameras.intrinsics_px.astype(np.float64),
        "views.sizes": features.cameras.sizes_px.astype(np.int64),
    }


def unpack(scene: str, arrays: Mapping[str, np.ndarray], most: int) -> SceneFeatures:
    """Unpack features that `pack` packed.

    Args:
        most: largest possible number of features; arrays with more features are damaged.

    Raises:
        ValueError, KeyError, InputError: the arrays do not come from `pack`.
    """
    counts, grid, poses = (arrays[name] for name in ("features.counts", "features.grid", "views.poses"))
    mean, axes = arrays["features.mean"], arrays["features.axes"]
    views, total = len(poses), int(counts.sum())
    if counts.shape != (2, views) or counts.dtype != np.int64 or counts.min(initial=0) < 0 or not 0 <= total <= most:
        raise ValueError("the feature counts do not fit the views")
    if grid.shape != (4,) or not np.isfinite(grid).all() or arrays["features.angles"].shape != (total,):
        raise ValueError("the feature arrays differ in length")
    if mean.dtype != np.int8 or axes.dtype != np.int8 or axes.ndim != 2 or not len(mean) == len(axes) >= axes.shape[1]:
        raise ValueError("invalid axes")
    ends = np.cumsum(counts.T.reshape(-1))
    codes = compression.codes_from_steps(
        compression.decompress(arrays["features.places"], (8, total), np.uint8), np.r_[0, ends]
    )
    along = compression.decompress(arrays["features.descriptors"], (axes.shape[1], total), np.int8).T
    values = mean + along * np.float32(_STEP * UNIT) @ (axes.T / np.float32(_AXIS))
    values *= UNIT / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)  # to unit vectors again
    return SceneFeatures(
        scene,
        Cameras(poses.reshape(-1, 4, 4), arrays["views.intrinsics"], arrays["views.sizes"]),
        np.r_[0, ends[1::2]].astype(np.int64),
        compression.decode_points(codes, grid[:3], grid[3]).astype(np.float32),
        np.clip(np.round(values), -127, 127).astype(np.int8),
        arrays["features.angles"].astype(np.uint8),
    )


def _principal(descriptors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the (D,) int8 mean of descriptors (N, D), and their (D, D) int8 principal axes, longest first."""
    width = descriptors.shape[1]
    if not len(descriptors):
        return np.zeros(width, np.int8), np.zeros((width, 0), np.int8)
    mean = np.round(descriptors.mean(0)).astype(np.int8)
    values = descriptors.astype(np.float64) - mean
    _, axes = np.linalg.eigh(values.T @ values)
    return mean, np.round(axes[:, ::-1] * _AXIS).astype(np.int8)
