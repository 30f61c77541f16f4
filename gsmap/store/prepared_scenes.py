"""Prepared scenes (`PreparedScene`), which are stored under their recipe and inputs and can be recomputed."""

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
from gsmap.types.prepared_scene import PreparedScene

KIND = "prepared"


class PreparedScenes(DerivedArrays[PreparedScene]):
    """The prepared scenes of a map."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        super().__init__(catalog, arrays, KIND, "the surface cells and views of scene")

    def _pack(self, found: PreparedScene) -> PackedResult:
        arrays: dict[str, np.ndarray] = {
            "centre": found.centre[None],
            "surface": np.packbits(found.is_surface),
            "points": found.points,
            "colours": found.colours,
            "normals": found.normals,
            "sides": found.sides,
            "sample": found.sample,
            "poses": found.cameras.T_frame_camera.reshape(-1, 16),
            "intrinsics": found.cameras.intrinsics_px,
            "sizes": found.cameras.sizes_px,
            "image_colours": found.image_colours,
            "image_depths": found.image_depths,
        }
        about: dict[str, Any] = {
            "unit_m": float(found.unit_m),
            "num_gaussians": len(found.is_surface),
            "num_items": len(found.points),
            "num_views": len(found.cameras),
            "num_own": found.num_own,
        }
        types = _layout(about)
        typed = {name: arrays[name].astype(types[name][0], copy=False) for name in arrays}
        return PackedResult(found.scene, len(found.points), about, typed)

    def load(self, scene: str, key: RecipeKey | str) -> PreparedScene | None:
        """Load the prepared scene with this key; None without such a scene.

        Raises:
            CorruptError: bytes on disk are missing, differ, or are no prepared scene.
            NotFoundError: another process replaced them meanwhile.
        """
        return self.get(scene, key, _layout, _prepared)


def _layout(about: Mapping[str, int]) -> ArrayTypes:
    M, V = about["num_items"], about["num_views"]
    return {
        "centre": (np.float64, (1, 3)),
        "surface": (np.uint8, (-(-about["num_gaussians"] // 8),)),
        "points": (np.float32, (M, 3)),
        "colours": (np.float16, (M, 3)),
        "normals": (np.float32, (M, 3)),
        "sides": (np.int8, (M,)),
        "sample": (np.float32, (None, 3)),
        "poses": (np.float64, (V, 16)),
        "intrinsics": (np.float64, (V, 4)),
        "sizes": (np.int64, (V, 2)),
        "image_colours": (np.uint8, (None, 3)),
        "image_depths": (np.float16, (None,)),
    }


def _prepared(row: Row[Any], arrays: dict[str, np.ndarray]) -> PreparedScene:
    for name in ("centre", "points", "colours", "normals", "sample"):
        if not np.isfinite(arrays[name]).all():
            raise InputError(f"{name} hold NaN or infinity", code="not_finite")
    return PreparedScene(
        scene=row.scene,
        unit_m=float(row.about["unit_m"]),
        centre=arrays["centre"][0],
        is_surface=np.unpackbits(arrays["surface"], count=int(row.about["num_gaussians"])).astype(bool),
        points=arrays["points"],
        colours=arrays["colours"],
        normals=arrays["normals"],
        sides=arrays["sides"],
        sample=arrays["sample"],
        cameras=Cameras(arrays["poses"].reshape(-1, 4, 4), arrays["intrinsics"], arrays["sizes"]),
        num_own=int(row.about["num_own"]),
        image_colours=arrays["image_colours"],
        image_depths=arrays["image_depths"],
    )
