"""What a metre is, in a scene whose scale nobody knows.

Landmarks have sizes: a blob of 8 cm, a cylinder of 1.1 m. A capture in an unknown unit is described at a guessed
unit, from how far its cameras stand from what they see. Two captures of one place need not give the same guess, but
landmarks stand a mismatch (on the test house recall falls from .83 to .70 at 20 percent, and three quarters of the
correct matches remain), and guesses differ by less than a factor of 3. So each scene is described at the guess times
1.45 to the powers -2, 0 and 1: differences of these three cover -3 to 3, hence any relative error of two guesses up
to 1.45^3.5 = 3.7 is met by one pair of layers within 1.45^0.5 = 20 percent. The true scale then comes from
registration.
"""

from __future__ import annotations

import numpy as np

from gsmap.types import Cameras

LEVEL_STEP = 1.45
LEVELS = (-2, 0, 1)
_VIEW_DISTANCE_M = 1.7  # typical distance from a camera to what it sees, indoors
_ROOM_HEIGHT_M = 2.4
_ROOM_WIDTH_M = 5.0


def estimate_unit_m(points: np.ndarray, cameras: Cameras | None, up: np.ndarray | None) -> float:
    """Metres per scene unit, to a factor of about two; scales exactly inversely with the scene.

    From the median distance of the nearest surface in 16 x 12 parts of the images; without cameras from the height of
    the room, or its width where up is unknown too. 1 when there is nothing to tell it from.
    """
    if cameras is not None and len(cameras) and not cameras.synthesised:
        distance = _view_distance(points, cameras)
        if distance > 0:
            return _VIEW_DISTANCE_M / distance
    if len(points) < 2:
        return 1.0
    if up is not None:
        height = float(np.ptp(np.percentile(points @ up, [2, 98])))
        return _ROOM_HEIGHT_M / height if height > 0 else 1.0
    width = float(np.median(np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)))
    return _ROOM_WIDTH_M / width if width > 0 else 1.0


def _view_distance(points: np.ndarray, cameras: Cameras, max_cameras: int = 32, max_points: int = 30000) -> float:
    points = points[:: max(1, len(points) // max_points)]
    nearest = []
    for i in np.unique(np.linspace(0, len(cameras) - 1, min(max_cameras, len(cameras))).round().astype(int)):
        T, (fx, fy, cx, cy), (width, height) = cameras.T_camera_frame[i], cameras.intrinsics_px[i], cameras.sizes_px[i]
        local = points @ T[:3, :3].T + T[:3, 3]
        local = local[local[:, 2] > 1e-9 * np.abs(local).max(initial=1)]
        u, v = (fx * local[:, 0] / local[:, 2] + cx) / width, (fy * local[:, 1] / local[:, 2] + cy) / height
        seen = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        part = (u[seen] * 16).astype(int) * 12 + (v[seen] * 12).astype(int)
        depth = np.full(16 * 12, np.inf)
        np.minimum.at(depth, part, local[seen, 2])
        nearest.append(depth[np.isfinite(depth)])
    all_parts = np.concatenate(nearest) if nearest else np.zeros(0)
    return float(np.median(all_parts)) if len(all_parts) else 0.0
