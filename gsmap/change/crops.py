"""Pictures of changes, before and after, each from the camera that saw the place best."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.render import render
from gsmap.types import Cameras, PlacedScene
from gsmap.types.change import Change, ChangeReport

_NEAR_M = 0.3
_TRIED = 3  # cameras of which the one that sees most unhidden is taken
_MARGIN = 0.6  # of the box's size, that a crop shows around it
_LEAST_PX = 120
_LINE = {"before": (230, 60, 40), "after": (40, 170, 70)}
_EDGES = ((0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 6), (3, 7), (4, 5), (4, 6), (5, 7), (6, 7))


def crops(
    report: ChangeReport,
    older: PlacedScene,
    newer: PlacedScene,
    *,
    longest_side_px: int = 640,
    changes: Sequence[int] | None = None,
) -> list[tuple[np.ndarray | None, np.ndarray | None]]:
    """Of each change a picture of each capture, cut out around it, with its box drawn.

    Both are of the same place, but for a thing that moved: there each capture shows it where it stood.

    Args:
        report: what was found between the two captures, in their frame.
        longest_side_px: size of the pictures that crops are cut from.
        changes: places in ``report.changes`` of those to draw; all for None.

    Returns:
        Pairs (before, after) of (H, W, 3) uint8 pictures; None where a capture has no camera that looks there. A change
        of the light of the whole place has none.
    """
    rows = range(len(report.changes)) if changes is None else changes
    out: list[tuple[np.ndarray | None, np.ndarray | None]] = []
    for row in rows:
        change = report.changes[row]
        if change.kind == "lighting":
            out.append((None, None))
            continue
        pair = [
            _crop(scene, _box(change, older, newer, when), when, longest_side_px)
            for scene, when in ((older, "before"), (newer, "after"))
        ]
        out.append((pair[0], pair[1]))
    return out


def _box(change: Change, older: PlacedScene, newer: PlacedScene, when: str) -> np.ndarray:
    """(2, 3) corners of what changed; of a thing that moved only where it was at that time."""
    if change.kind != "moved":
        return change.box
    scene, rows = (older, change.before) if when == "before" else (newer, change.after)
    means = scene.gaussians.means[rows].astype(np.float64)
    return np.quantile(means, (0.01, 0.99), axis=0) if len(means) else change.box


def _crop(scene: PlacedScene, box: np.ndarray, when: str, longest_side_px: int) -> np.ndarray | None:
    if scene.cameras is None or not len(scene.cameras) or not len(scene.gaussians):
        return None
    cameras = scene.cameras.resized(longest_side_px)
    points = _grid(box)
    best = sorted(((_view_of(cameras, c, points), -c) for c in range(len(cameras))), reverse=True)[:_TRIED]
    shots = []
    for size, row in best:
        if size <= 0:
            continue
        camera = cameras[-row]
        seen = render(scene.gaussians, camera, dominant_id=False)
        pixels, z = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
        inside = in_image(pixels, z, camera.sizes_px[0], near=_NEAR_M)
        column, line = pixels[inside].astype(np.int64).T
        bare = (z[inside] < seen.depth[0][line, column] + 0.15).mean() if inside.any() else 0.0
        shots.append((size * (0.1 + bare), row, camera, seen.colour[0]))
    if not shots:
        return None
    _, _, camera, colour = max(shots, key=lambda s: s[:2])
    picture = np.round(255 * np.clip(colour, 0, 1)).astype(np.uint8)
    _draw(picture, box, camera, _LINE[when])
    return _cut(picture, points, camera)


def _grid(box: np.ndarray) -> np.ndarray:
    """(125, 3) points all over a box."""
    steps = np.stack(np.meshgrid(*[np.linspace(0, 1, 5)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    out: np.ndarray = box[0] + steps * (box[1] - box[0])
    return out


def _view_of(cameras: Cameras, row: int, points: np.ndarray) -> float:
    """How well a camera shows points: the share that it has in frame, and a little for how large they are."""
    pixels, z = project(points, cameras.T_camera_frame[row], cameras.intrinsics_px[row])
    inside = in_image(pixels, z, cameras.sizes_px[row], near=_NEAR_M)
    if not inside.any():
        return 0.0
    shown = np.ptp(pixels[inside], axis=0) / cameras.sizes_px[row]
    return float(inside.mean() * (0.3 + min(np.sqrt(shown.prod()), 0.5)))


def _draw(picture: np.ndarray, box: np.ndarray, camera: Cameras, colour: tuple[int, int, int]) -> None:
    """The twelve edges of a box, those parts that lie before the camera."""
    corners = np.array([[box[i >> 2 & 1, 0], box[i >> 1 & 1, 1], box[i & 1, 2]] for i in range(8)])
    height, width = picture.shape[:2]
    for a, b in _EDGES:
        line = corners[a] + np.linspace(0, 1, 400)[:, None] * (corners[b] - corners[a])
        pixels, z = project(line, camera.T_camera_frame[0], camera.intrinsics_px[0])
        inside = in_image(pixels, z, np.array([width, height]), near=0.05)
        column, row = pixels[inside].astype(np.int64).T
        picture[row, column] = colour
        picture[np.minimum(row + 1, height - 1), column] = colour


def _cut(picture: np.ndarray, points: np.ndarray, camera: Cameras) -> np.ndarray:
    """The part of a picture around points, with some of what is about them."""
    height, width = picture.shape[:2]
    pixels, z = project(points, camera.T_camera_frame[0], camera.intrinsics_px[0])
    inside = in_image(pixels, z, np.array([width, height]), near=_NEAR_M)
    low, high = pixels[inside].min(0), pixels[inside].max(0)
    grow = np.maximum(_MARGIN * (high - low), (_LEAST_PX - (high - low)) / 2)
    left, top = np.maximum(low - grow, 0).astype(int)
    right, bottom = np.minimum(high + grow + 1, (width, height)).astype(int)
    out: np.ndarray = picture[top:bottom, left:right].copy()
    return out
