"""Draw a pair of scenes for review: both captures from the same cameras, and their differences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.render import render
from gsmap.types import Cameras, PosedScene

_TOLERANCE_M, _TOLERANCE = 0.10, 0.02  # tolerance of depth differences: metres plus a fraction of the depth
_GAP_PX = 4
_MARK = np.array([1.0, 0.25, 0.25])


def draw_pair(
    target: PosedScene, source: PosedScene, cameras: Sequence[Cameras], unit_m: float = 1.0, side_px: int = 320
) -> np.ndarray:
    """Draw one row per camera: the target, the source, and the target with differences marked; (H, W, 3) uint8 in all.

    Args:
        target, source: Both captures, in one frame.
        cameras: Single cameras in that frame; without cameras the picture is blank.
        unit_m: Metres per unit of that frame.
        side_px: Longer side of each of the three pictures.
    """
    rows = [_row(target, source, camera.resized(side_px), unit_m) for camera in cameras]
    if not rows:
        return np.full((_GAP_PX, _GAP_PX, 3), 255, np.uint8)
    width = max(row.shape[1] for row in rows)
    gap = np.full((_GAP_PX, width, 3), 255, np.uint8)
    wide = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    return np.concatenate([part for row in wide for part in (row, gap)][:-1])


def looks_at(
    target: PosedScene, source: PosedScene, camera: Cameras, unit_m: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw target, source, and the target with differences marked, from one camera: (H, W, 3) uint8 each.

    Args:
        target, source, unit_m: As in `draw_pair`.
        camera: The camera, in the same frame.
    """
    one, other = (render(scene.gaussians, camera) for scene in (target, source))
    looks = [np.clip(np.nan_to_num(seen.colour[0]), 0, 1) for seen in (one, other)]
    depth, other_depth = one.depth[0] * unit_m, other.depth[0] * unit_m
    both = (one.alpha[0] > 0.5) & (other.alpha[0] > 0.5)
    apart = both & (np.abs(depth - other_depth) > _TOLERANCE_M + _TOLERANCE * np.minimum(depth, other_depth))
    grey = np.repeat(looks[0].mean(-1, keepdims=True), 3, axis=-1)
    marked = np.where(apart[..., None], 0.4 * grey + 0.6 * _MARK, grey)
    seen, other_seen, difference = ((look * 255 + 0.5).astype(np.uint8) for look in (*looks, marked))
    return seen, other_seen, difference


def _row(target: PosedScene, source: PosedScene, camera: Cameras, unit_m: float) -> np.ndarray:
    looks = looks_at(target, source, camera, unit_m)
    gap = np.full((looks[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([looks[0], gap, looks[1], gap, looks[2]], axis=1)
