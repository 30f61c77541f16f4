"""Draw a pair of scenes for review: both captures from the same cameras, and their differences.

The cameras are those whose pictures decide: a bare wall looks the same under any pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.geometry.cells import cell_labels
from gsmap.render import Rendering, render
from gsmap.types import Cameras, PosedScene

_TOLERANCE_M, _TOLERANCE = 0.10, 0.02  # tolerance of depth differences: metres plus a fraction of the depth
_GAP_PX = 4
_CAPTION_PX = 22
_TRIED_PX = 96  # longer side of the renders by which cameras are chosen
_CELL_M = 0.3  # edge of the cells of surface that a camera shows
_MAX_GRADIENT = 0.15  # contrast between adjacent pixels beyond which an edge is no clearer
_MARK = np.array([1.0, 0.25, 0.25])


def choose_cameras(
    target: PosedScene, source: PosedScene, candidates: Sequence[Cameras], count: int, unit_m: float = 1.0
) -> list[Cameras]:
    """Choose the cameras whose pictures fix the relative pose, best first.

    A picture fixes a pose by edges and texture that both captures show, in every direction across the picture. Each
    further camera is chosen for those that the earlier ones do not show.

    Args:
        target, source: Both captures, in one frame.
        candidates: Single cameras in that frame.
        count: Number of cameras to choose; fewer if there are fewer candidates.
        unit_m: Metres per unit of that frame.
    """
    seen = [_shared_edges(target, source, camera.resized(_TRIED_PX), unit_m) for camera in candidates]
    places = np.concatenate([np.zeros((0, 3)), *(points for points, _ in seen)])
    labels, counts = cell_labels(np.floor(places / _CELL_M))
    of = np.split(labels, np.cumsum([len(points) for points, _ in seen])[:-1])
    shown = np.zeros(len(counts), bool)
    left, chosen = list(range(len(candidates))), list[int]()
    while left and len(chosen) < count:
        gains = [_least_gradient(seen[i][1][~shown[of[i]]]) for i in left]
        best = left.pop(int(np.argmax(gains)))
        chosen.append(best)
        shown[of[best]] = True
    return [candidates[i] for i in chosen]


def _shared_edges(
    target: PosedScene, source: PosedScene, camera: Cameras, unit_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (K, 3) in metres of pixels in which both captures show a surface, and the image gradients
    (K, 2) that both have there: of brightness, as a fraction of the range.
    """
    views = [render(scene.gaussians, camera, dominant_id=False) for scene in (target, source)]
    both = (views[0].alpha[0] > 0.5) & (views[1].alpha[0] > 0.5)
    gradients = [_gradients(view) for view in views]
    smaller = np.sign(gradients[0]) * np.minimum(np.abs(gradients[0]), np.abs(gradients[1]))
    shared = np.where(gradients[0] * gradients[1] > 0, np.clip(smaller, -_MAX_GRADIENT, _MAX_GRADIENT), 0.0)
    row, column = np.nonzero(both)
    fx, fy, cx, cy = camera.intrinsics_px[0]
    z = views[0].depth[0][row, column].astype(np.float64)
    rays = np.column_stack([(column + 0.5 - cx) / fx * z, (row + 0.5 - cy) / fy * z, z])
    pose = camera.T_frame_camera[0]
    return (rays @ pose[:3, :3].T + pose[:3, 3]) * unit_m, shared[row, column]


def _gradients(view: Rendering) -> np.ndarray:
    """Return the (H, W, 2) gradients of brightness along columns and rows."""
    grey = np.clip(np.nan_to_num(view.colour[0]), 0, 1).mean(-1)
    return np.stack([np.gradient(grey, axis=1), np.gradient(grey, axis=0)], axis=-1)


def _least_gradient(gradients: np.ndarray) -> float:
    """Return how far gradients (K, 2) fix a shift of the picture in its least certain direction: the smaller eigenvalue
    of their structure tensor.
    """
    return float(np.linalg.eigvalsh(gradients.T @ gradients)[0]) if len(gradients) else 0.0


def draw_pair(
    target: PosedScene,
    source: PosedScene,
    cameras: Sequence[Cameras],
    unit_m: float = 1.0,
    side_px: int = 320,
    names: tuple[str, str] | None = None,
) -> np.ndarray:
    """Draw one row per camera: the target, the source, and the target with differences marked; (H, W, 3) uint8 in all.

    Args:
        target, source: Both captures, in one frame.
        cameras: Single cameras in that frame; without cameras the picture is blank.
        unit_m: Metres per unit of that frame.
        side_px: Longer side of each of the three pictures.
        names: Names of target and source, for captions above the columns; default: no captions.
    """
    rows = [_row(target, source, camera.resized(side_px), unit_m) for camera in cameras]
    if not rows:
        return np.full((_GAP_PX, _GAP_PX, 3), 255, np.uint8)
    width = max(row.shape[1] for row in rows)
    if names is not None:
        columns = (*names, f"red: surfaces over {100 * _TOLERANCE_M:.0f} cm apart")
        rows.insert(0, _captions(columns, width))
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


def _captions(texts: Sequence[str], width: int) -> np.ndarray:
    """Draw texts above equal columns of a picture, each cut to its column."""
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.new("RGB", (width, _CAPTION_PX), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(14)
    step = (width + _GAP_PX) / len(texts)
    for i, text in enumerate(texts):
        shown = text
        while len(shown) > 1 and draw.textlength(shown, font=font) > step - 2 * _GAP_PX:
            text = text[:-1]
            shown = f"{text}..."
        draw.text((i * step + _GAP_PX, 3), shown, fill=(40, 42, 48), font=font)
    return np.asarray(picture)


def _row(target: PosedScene, source: PosedScene, camera: Cameras, unit_m: float) -> np.ndarray:
    looks = looks_at(target, source, camera, unit_m)
    gap = np.full((looks[0].shape[0], _GAP_PX, 3), 255, np.uint8)
    return np.concatenate([looks[0], gap, looks[1], gap, looks[2]], axis=1)
