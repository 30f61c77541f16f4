"""Local features of the views of each scene (`SceneFeatures`), which are stored under their recipe and inputs.

Candidate views of a photo come from the index of views (`gsmap.store.indexes`). All of it can be recomputed.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from sqlalchemy import delete, insert, select

from gsmap.errors import MALFORMED, CorruptError, InputError
from gsmap.methods import RecipeKey
from gsmap.store import recipes
from gsmap.store.array_groups import manifest, publish, unless_pruned, unname
from gsmap.store.arrays import Arrays, digest
from gsmap.store.catalog import Catalog, now
from gsmap.store.error_translation import NOT_KEPT, translate_errors
from gsmap.store.scene_refs import resolve
from gsmap.store.schema import view_features
from gsmap.types import Cameras
from gsmap.types.localization import SceneFeatures

KIND = "views"

_ARRAYS = {
    "starts": np.dtype(np.int64),
    "points": np.dtype(np.float32),
    "descriptors": np.dtype(np.int8),
    "angles": np.dtype(np.uint8),
    "poses": np.dtype(np.float64),
    "intrinsics": np.dtype(np.float64),
    "sizes": np.dtype(np.int64),
}


class ViewFeatures:
    """The view features of a map, one set per scene."""

    def __init__(self, catalog: Catalog, arrays: Arrays) -> None:
        self._catalog = catalog
        self._arrays = arrays

    def save(self, found: SceneFeatures, key: RecipeKey) -> None:
        """Store the features of a scene in place of all earlier features of that scene.

        Args:
            key: its recipe; the scene must be among its inputs.
        """
        if found.scene not in key.inputs:
            raise InputError(
                f"the recipe key of features must have their scene {found.scene} among its inputs",
                code="key_input_mismatch",
            )
        arrays: dict[str, np.ndarray] = {
            "starts": found.starts.astype(np.int64),
            "points": found.points.astype(np.float32),
            "descriptors": found.descriptors,
            "angles": found.angles,
            "poses": found.cameras.T_frame_camera.reshape(-1, 16),
            "intrinsics": found.cameras.intrinsics_px,
            "sizes": found.cameras.sizes_px,
        }
        group_id = digest(*arrays.values(), text=key.digest)
        row = {
            "key": key.digest,
            "scene": found.scene,
            "num_views": found.num_views,
            "num_features": found.num_features,
            "summaries": b"",
            "group_id": group_id,
        }
        staging = self._arrays.stage(arrays, KIND, group_id)
        with translate_errors(self._catalog.folder, NOT_KEPT), staging as staged, self._catalog.write() as connection:
            resolve(connection, found.scene)
            known = manifest(connection, group_id)
            if not known or self._arrays.problems(KIND, group_id, known):
                publish(self._catalog, connection, self._arrays, staged, KIND, group_id)
            mine = view_features.c.scene == found.scene
            older = set(connection.execute(select(view_features.c.group_id).where(mine)).scalars()) - {group_id}
            connection.execute(delete(view_features).where(mine))
            for gone in older:
                unname(connection, gone)
            made = {"recipe": recipes.save_recipe(connection, key), "created_at": now()}
            connection.execute(insert(view_features), row | made)

    def stored_keys(self, keys: Iterable[RecipeKey | str]) -> set[str]:
        """Return, as digests, the keys that have features."""
        with self._catalog.read() as connection:
            return recipes.stored_keys(connection, view_features.c.key, keys)

    def load(self, scene: str, key: RecipeKey | str) -> SceneFeatures | None:
        """Load the features of a scene with this key; None without such features.

        Raises:
            CorruptError: bytes on disk are missing, differ, or are not valid features.
            NotFoundError: another process replaced them meanwhile.
        """
        wanted = view_features.c.key == recipes.digest_of(key)
        with self._catalog.read() as connection:
            row = connection.execute(select(view_features).where(wanted, view_features.c.scene == scene)).first()
            if row is None:
                return None
            files = manifest(connection, row.group_id)
        V, N = row.num_views, row.num_features
        shapes = {
            "starts": (V + 1,),
            "points": (N, 3),
            "descriptors": (N, None),
            "angles": (N,),
            "poses": (V, 16),
            "intrinsics": (V, 4),
            "sizes": (V, 2),
        }
        with unless_pruned(self._catalog, row.group_id, f"the features of scene {scene[:12]} were computed again"):
            arrays = self._arrays.read(KIND, row.group_id, files, shapes=shapes)
        try:
            return _features(scene, arrays, N)
        except (InputError, *MALFORMED) as error:
            raise CorruptError(
                f"the features of scene {scene[:12]} are invalid ({error}): run gsmap check", code="arrays_corrupt"
            ) from error


def _features(scene: str, arrays: dict[str, np.ndarray], num_features: int) -> SceneFeatures:
    for name, dtype in _ARRAYS.items():
        if arrays[name].dtype != dtype:
            raise InputError(f"{name} are {arrays[name].dtype}", code="invalid_record")
    starts = arrays["starts"]
    if starts[0] != 0 or starts[-1] != num_features or (np.diff(starts) < 0).any():
        raise InputError("its views do not partition its features", code="invalid_record")
    if not np.isfinite(arrays["points"]).all():
        raise InputError("a point holds NaN or infinity", code="not_finite")
    cameras = Cameras(arrays["poses"].reshape(-1, 4, 4), arrays["intrinsics"], arrays["sizes"])
    return SceneFeatures(scene, cameras, starts, arrays["points"], arrays["descriptors"], arrays["angles"])
