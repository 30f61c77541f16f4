"""What localisation needs of a scene, in few bytes: features at four bits a number, and Gaussians merged.

Features of a view are kept in the order in which its extractor gave them, as many of every view: views are far apart,
so what is kept covers what the scene shows. Gaussians that hardly show in the scene's own pictures go, and so does what
depends on the direction; the others are merged (`gsmap.export.levels`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import CorruptError, InputError
from gsmap.localize.placed import PlacedFeatures
from gsmap.render import render
from gsmap.types import Cameras, Gaussians
from gsmap.types.localization import SceneFeatures

_LEVELS = 15.0
_MOST = 127.0
_UNIT = 254.0  # length of a descriptor, see `gsmap.localize.features.quantised`
_STEPS = 65535.0


@dataclass(frozen=True)
class Params:
    """How a small map is made.

    Args:
        features_share: of a scene's bytes; the rest are Gaussians.
        min_features: of a view. With fewer, hardly a photograph is found.
        min_gaussians: share of those that show in the scene's own pictures. With fewer, renders are full of holes.
        pictures: of its own in which Gaussians are weighed, evenly along its path.
        longest_side_px: size of these.
        min_weight: a Gaussian that nowhere makes up this share of a pixel goes in any case.
        refine_steps: of fitting what was merged to renders of what it stands for, ...
        refine_views: ... from so many of the scene's cameras.
    """

    features_share: float = 0.35
    min_features: int = 40
    min_gaussians: float = 0.15
    pictures: int = 32
    longest_side_px: int = 240
    min_weight: float = 0.01
    refine_steps: int = 150
    refine_views: int = 32


def weights(scene: PlacedFeatures, cameras: Cameras | None, params: Params) -> np.ndarray:
    """(N,) float32 how much each Gaussian shows: the largest share of a pixel that it makes up, in any picture.

    Args:
        cameras: of the scene, its frame and unit; with none, the views that photographs are found by.
    """
    own = cameras if cameras is not None and len(cameras) else scene.features.cameras
    small = own.evenly(params.pictures).resized(params.longest_side_px)
    largest = np.zeros(len(scene.gaussians), np.float32)
    for row in range(len(small)):
        seen = render(scene.gaussians, small[row], depth=False, dominant_id=False, max_weight=True, backend="native")
        np.maximum(largest, seen.max_weight, out=largest)
    return largest


def fewer(features: SceneFeatures, most: int) -> SceneFeatures:
    """At most so many features of every view, those that came first."""
    rows = [np.arange(a, min(b, a + most)) for a, b in zip(features.starts[:-1], features.starts[1:], strict=True)]
    keep = np.concatenate([np.zeros(0, np.int64), *rows])
    return replace(
        features,
        starts=np.r_[0, np.cumsum([len(part) for part in rows])].astype(np.int64),
        points=features.points[keep],
        descriptors=features.descriptors[keep],
        angles=features.angles[keep],
    )


def without(features: SceneFeatures, means: np.ndarray, left_out: np.ndarray) -> SceneFeatures:
    """Features but those on Gaussians that are left out: whose nearest one (of means (N, 3)) is among these (N,)."""
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(means).query(features.points)
    keep = ~left_out[nearest]
    before = np.r_[0, np.cumsum(keep)]
    return replace(
        features,
        starts=before[features.starts].astype(np.int64),
        points=features.points[keep],
        descriptors=features.descriptors[keep],
        angles=features.angles[keep],
    )


def without_direction(gaussians: Gaussians) -> Gaussians:
    """Gaussians of one colour each."""
    return replace(gaussians, sh=gaussians.sh[:, :1])


def pack_features(features: SceneFeatures) -> dict[str, np.ndarray]:
    """Arrays of a scene's features, a good half as large: places at 16 bits in their box, descriptors at 4."""
    points = features.points.astype(np.float64)
    low = points.min(0) if len(points) else np.zeros(3)
    size = np.maximum(points.max(0) - low, 1e-12) if len(points) else np.ones(3)
    values = features.descriptors.astype(np.float64)
    least, greatest = (float(np.quantile(values, q)) for q in (0.001, 0.999)) if values.size else (0.0, 1.0)
    step = max((greatest - least) / _LEVELS, 1.0)
    if features.descriptors.shape[1] % 2:
        raise InputError(f"descriptors of {features.descriptors.shape[1]} numbers cannot be packed in pairs")
    nibbles = np.clip(np.round((values - least) / step), 0, _LEVELS).astype(np.uint8)
    return {
        "starts": features.starts.astype(np.int64),
        "box": np.stack([low, size]),
        "points": np.round((points - low) / size * _STEPS).astype(np.uint16),
        "range": np.array([least, step]),
        "descriptors": (nibbles[:, 0::2] << 4) | nibbles[:, 1::2],
        "angles": features.angles.astype(np.uint8),
        "poses": features.cameras.T_frame_camera.reshape(-1, 16).astype(np.float64),
        "intrinsics": features.cameras.intrinsics_px.astype(np.float64),
        "sizes": features.cameras.sizes_px.astype(np.int64),
    }


def unpack_features(scene: str, arrays: Mapping[str, np.ndarray]) -> SceneFeatures:
    """The features again.

    Raises:
        CorruptError: these are no arrays of `pack_features`.
    """
    try:
        starts, packed = arrays["starts"], arrays["descriptors"]
        count, views = len(arrays["points"]), len(arrays["poses"])
        shapes = {"box": (2, 3), "range": (2,), "points": (count, 3), "angles": (count,), "starts": (views + 1,)}
        if any(arrays[name].shape != shape for name, shape in shapes.items()) or len(packed) != count:
            raise ValueError("arrays that do not fit each other")
        if starts.dtype != np.int64 or starts[0] != 0 or starts[-1] != count or (np.diff(starts) < 0).any():
            raise ValueError("views that do not divide their features")
        if packed.dtype != np.uint8 or arrays["points"].dtype != np.uint16:
            raise ValueError("arrays of other types")
        (low, size), (least, step) = arrays["box"], arrays["range"]
        if not (np.isfinite(arrays["box"]).all() and np.isfinite(arrays["range"]).all()):
            raise ValueError("numbers that are not finite")
        nibbles = np.empty((count, 2 * packed.shape[1]), np.float64)
        nibbles[:, 0::2], nibbles[:, 1::2] = packed >> 4, packed & 15
        values = least + nibbles * step
        norms = np.linalg.norm(values, axis=1, keepdims=True)
        values *= _UNIT / np.maximum(norms, 1e-9)  # what was rounded is a unit vector again
        return SceneFeatures(
            scene,
            Cameras(arrays["poses"].reshape(-1, 4, 4), arrays["intrinsics"], arrays["sizes"]),
            starts,
            (low + arrays["points"] / _STEPS * size).astype(np.float32),
            np.clip(np.round(values), -_MOST, _MOST).astype(np.int8),
            arrays["angles"].astype(np.uint8),
        )
    except (KeyError, ValueError, IndexError, TypeError, AttributeError) as error:
        raise CorruptError(
            f"the features of scene {scene[:12]} make no sense ({error}): export the small map again"
        ) from error
