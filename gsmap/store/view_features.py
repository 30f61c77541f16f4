"""Local features of the views of each scene (`SceneFeatures`), which are stored under their recipe and inputs.

Candidate views of a photo come from the index of views (`gsmap.store.indexes`). All of it can be recomputed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from sqlalchemy import Row

from gsmap.errors import InputError
from gsmap.methods import RecipeKey
from gsmap.store.array_groups import PackedResult
from gsmap.store.arrays import Arrays
from gsmap.store.catalog import Catalog
from gsmap.store.results import ArrayTypes, DerivedArrays
from gsmap.types import Cameras
from gsmap.types.localization import SceneFeatures

KIND = "views"


class ViewFeatures(DerivedArrays[SceneFeatures]):
    """The view features of a map, one set per scene."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        super().__init__(catalog, arrays, KIND, "the features of scene")

    def _pack(self, found: SceneFeatures) -> PackedResult:
        arrays: dict[str, np.ndarray] = {
            "starts": found.starts.astype(np.int64),
            "points": found.points.astype(np.float32),
            "descriptors": found.descriptors,
            "angles": found.angles,
            "poses": found.cameras.T_frame_camera.reshape(-1, 16),
            "intrinsics": found.cameras.intrinsics_px,
            "sizes": found.cameras.sizes_px,
        }
        about = {"num_views": found.num_views, "num_items": found.num_features}
        return PackedResult(found.scene, found.num_features, about, arrays)

    def load(self, scene: str, key: RecipeKey | str) -> SceneFeatures | None:
        """Load the features of a scene with this key; None without such features.

        Raises:
            CorruptError: bytes on disk are missing, differ, or are not valid features.
            NotFoundError: another process replaced them meanwhile.
        """
        return self.get(scene, key, _layout, _features)


def _layout(about: Mapping[str, int]) -> ArrayTypes:
    V, N = about["num_views"], about["num_items"]
    return {
        "starts": (np.int64, (V + 1,)),
        "points": (np.float32, (N, 3)),
        "descriptors": (np.int8, (N, None)),
        "angles": (np.uint8, (N,)),
        "poses": (np.float64, (V, 16)),
        "intrinsics": (np.float64, (V, 4)),
        "sizes": (np.int64, (V, 2)),
    }


def _features(row: Row[Any], arrays: dict[str, np.ndarray]) -> SceneFeatures:
    starts = arrays["starts"]
    if starts[0] != 0 or starts[-1] != len(arrays["points"]) or (np.diff(starts) < 0).any():
        raise InputError("its views do not partition its features", code="invalid_record")
    if not np.isfinite(arrays["points"]).all():
        raise InputError("a point holds NaN or infinity", code="not_finite")
    cameras = Cameras(arrays["poses"].reshape(-1, 4, 4), arrays["intrinsics"], arrays["sizes"])
    return SceneFeatures(row.scene, cameras, starts, arrays["points"], arrays["descriptors"], arrays["angles"])
