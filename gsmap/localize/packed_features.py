"""Features of a scene's views in two dozen bytes each, so that photographs match as many of them as of the whole ones.

Descriptors are turned to their principal axes, where few numbers tell most, and rounded to one step along all: what is
left out is as large along every axis (transform coding). How they were turned is kept with them. Places are steps along
a curve through space.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np

from gsmap.localize import streams
from gsmap.localize.features import UNIT
from gsmap.types import Cameras
from gsmap.types.localization import SceneFeatures

NAMES = (
    *("features.counts", "features.grid", "features.places", "features.mean", "features.axes"),
    *("features.descriptors", "features.angles", "views.poses", "views.intrinsics", "views.sizes"),
)

_STEP = 0.08  # of a unit vector, along each axis
_TELLS = 0.02  # an axis along which fewer features than this share differ from their mean is left out
_AXIS = 127.0  # length of an axis


def pack(features: SceneFeatures, step: float, first: int) -> dict[str, np.ndarray]:
    """Arrays of a scene's features.

    Args:
        step: that places are rounded to, in the scene's unit.
        first: of a view, that photographs are looked for by; they stay the first, in any order.
    """
    starts = features.starts
    split = np.minimum(starts[:-1] + first, starts[1:])
    runs = np.r_[np.stack([starts[:-1], split], axis=1).reshape(-1), starts[-1]]
    low = features.points.min(0).astype(np.float64) if features.num_features else np.zeros(3)
    step = streams.finest_step(features.points, step)
    codes = streams.codes_of(features.points, low, step)
    order = np.concatenate([a + np.argsort(codes[a:b], kind="stable") for a, b in pairwise(runs.tolist())])
    mean, axes = _principal(features.descriptors)
    along = (features.descriptors[order].astype(np.float64) - mean) @ (axes / (_AXIS * UNIT))
    rounded = np.clip(np.round(along / _STEP), -127, 127).astype(np.int8)
    tell = (rounded != 0).sum(0) > _TELLS * len(rounded)
    return {
        "features.counts": np.stack([split - starts[:-1], starts[1:] - split]),
        "features.grid": np.r_[low, step],
        "features.places": streams.squeezed(streams.steps_between(codes[order], runs[:-1])),
        "features.mean": mean,
        "features.axes": axes[:, tell],
        "features.descriptors": streams.squeezed(rounded[:, tell].T),
        "features.angles": features.angles[order].astype(np.uint8),
        "views.poses": features.cameras.T_frame_camera.reshape(-1, 16).astype(np.float64),
        "views.intrinsics": features.cameras.intrinsics_px.astype(np.float64),
        "views.sizes": features.cameras.sizes_px.astype(np.int64),
    }


def unpack(scene: str, arrays: Mapping[str, np.ndarray], most: int) -> SceneFeatures:
    """The features again.

    Args:
        most: that there may be: bytes that claim to be more are damaged.

    Raises:
        ValueError, KeyError, InputError: these are no arrays of `pack`.
    """
    counts, grid, poses = (arrays[name] for name in ("features.counts", "features.grid", "views.poses"))
    mean, axes = arrays["features.mean"], arrays["features.axes"]
    views, total = len(poses), int(counts.sum())
    if counts.shape != (2, views) or counts.dtype != np.int64 or counts.min(initial=0) < 0 or not 0 <= total <= most:
        raise ValueError("views that do not divide their features")
    if grid.shape != (4,) or not np.isfinite(grid).all() or arrays["features.angles"].shape != (total,):
        raise ValueError("arrays that do not fit each other")
    if mean.dtype != np.int8 or axes.dtype != np.int8 or axes.ndim != 2 or not len(mean) == len(axes) >= axes.shape[1]:
        raise ValueError("axes that are none")
    ends = np.cumsum(counts.T.reshape(-1))
    codes = streams.codes_between(streams.expanded(arrays["features.places"], (8, total), np.uint8), np.r_[0, ends])
    along = streams.expanded(arrays["features.descriptors"], (axes.shape[1], total), np.int8).T
    values = mean + along * np.float32(_STEP * UNIT) @ (axes.T / np.float32(_AXIS))
    values *= UNIT / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-9)  # a unit vector again
    return SceneFeatures(
        scene,
        Cameras(poses.reshape(-1, 4, 4), arrays["views.intrinsics"], arrays["views.sizes"]),
        np.r_[0, ends[1::2]].astype(np.int64),
        streams.places_of(codes, grid[:3], grid[3]).astype(np.float32),
        np.clip(np.round(values), -127, 127).astype(np.int8),
        arrays["features.angles"].astype(np.uint8),
    )


def _principal(descriptors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(D,) int8 mean of descriptors (N, D), and (D, D) int8 their principal axes, the longest first."""
    width = descriptors.shape[1]
    if not len(descriptors):
        return np.zeros(width, np.int8), np.zeros((width, 0), np.int8)
    mean = np.round(descriptors.mean(0)).astype(np.int8)
    values = descriptors.astype(np.float64) - mean
    _, axes = np.linalg.eigh(values.T @ values)
    return mean, np.round(axes[:, ::-1] * _AXIS).astype(np.int8)
