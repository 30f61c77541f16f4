"""Estimation of the metric unit of a scene without known scale, and the units of its landmark layers.

Landmarks have sizes: a blob of 8 cm, a cylinder of 1.1 m. A capture in an unknown unit is described at an estimated
unit, from the distance of its cameras to the surface. Two captures of one place may give different estimates, but
landmarks tolerate a mismatch (on the test house recall falls from 0.83 to 0.70 at 20 percent, and three quarters of the
correct matches remain), and estimates differ by less than a factor of 3. So each scene is described at the estimate
times 1.45 to the powers -2, 0 and 1: differences of these three cover -3 to 3, hence for any relative error of two
estimates up to 1.45^3.5 = 3.7 one pair of layers agrees within 1.45^0.5 = 20 percent. The true scale then comes from
registration.

Landmarks in metres are not suitable for every scene, even if the metre is known. A court seen from 7 m has corners,
patterns and Gaussians four times as large as a room seen from 1.7 m. So a capture whose views are not those of a room
is described at other sizes as well: at the powers of two about its estimate, which are the same for every capture, so
that two captures of one place share one; and lengths of its registration are in its *working metres*, under which it
looks like a room.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.metric_scale import PLAUSIBLE_M
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras

LEVEL_STEP = 1.45
LEVELS = (-2, 0, 1)
VIEW_DISTANCE_M = 1.7
"""Default of the typical distance from a camera to what it sees: indoors."""

_ROOM_HEIGHT_M = 2.4  # assumed where there are no cameras but up is known
_ROOM_WIDTH_M = 5.0  # assumed where up is unknown too
_ROOM = 1.0  # octaves from 1 that are still a room: the estimate is right to a factor of about two
_MAX_OCTAVES = 5  # places seen from farther than 50 m, or nearer than 5 cm, are described as from there


def estimate_unit_m(
    points: np.ndarray, cameras: Cameras | None, up: np.ndarray | None, view_distance_m: float = VIEW_DISTANCE_M
) -> float:
    """Estimate metres per scene unit, to a factor of about two; scales exactly inversely with the scene.

    From the median distance of the nearest surface in 16 x 12 parts of the images; without cameras from the height of
    the room, or its width where up is unknown too; 1 without any evidence.

    Args:
        points: (N, 3) surface points, scene frame and unit.
        cameras: scene frame; synthesised ones are ignored.
        up: (3,) against gravity, scene frame.
    """
    if cameras is not None and len(cameras) and not cameras.synthesised:
        distance = _view_distance(points, cameras)
        if distance > 0:
            return view_distance_m / distance
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
    some = cameras.evenly(max_cameras)
    for i in range(len(some)):
        at, z = project(points, some.T_camera_frame[i], some.intrinsics_px[i])
        at /= some.sizes_px[i]
        seen = in_image(at, z, np.ones(2), 1e-9 * np.abs(z).max(initial=1))
        part = (at[seen, 0] * 16).astype(int) * 12 + (at[seen, 1] * 12).astype(int)
        depth = np.full(16 * 12, np.inf)
        np.minimum.at(depth, part, z[seen])
        nearest.append(depth[np.isfinite(depth)])
    all_parts = np.concatenate(nearest) if nearest else np.zeros(0)
    return float(np.median(all_parts)) if len(all_parts) else 0.0


def landmark_units(guess_m: float, scale_policy: str, *, working_m: float = 1.0) -> dict[str, float]:
    """Return the metres per scene unit that each landmark layer assumes, by the layer's name.

    ``landmarks`` and ``landmarks@K``, whose lengths are 2 to the power K times as many metres, where the unit may be
    the metre; ``landmarks:I`` at estimates.

    Args:
        guess_m: metres per scene unit, from `estimate_unit_m`.
        scale_policy: ``known``, ``unknown`` or ``auto``; see `gsmap.describe.describe`.
        working_m: from `working_unit_m`.
    """
    low, high = PLAUSIBLE_M
    levels = {f"landmarks:{i}": guess_m * LEVEL_STEP**power for i, power in enumerate(LEVELS)}
    metric = {"landmarks": 1.0}
    if working_m != 1.0:
        octave = int(np.floor(-np.log2(working_m)))
        metric |= {f"landmarks@{k}": 2.0**-k for k in (octave, octave + 1) if k}
    if scale_policy == "known":
        return metric
    return {**metric, **levels} if scale_policy == "auto" and low < guess_m < high else levels


def working_unit_m(guess_m: float, cameras: Cameras | None) -> float:
    """Return working metres per metre: 1 where views are those of a room, otherwise the power of two that makes them
    so.

    Without cameras the viewing distance is unknown, and the height of the content is no measure of it: 1.
    """
    if cameras is None or not len(cameras) or cameras.synthesised:
        return 1.0
    octaves = np.clip(np.log2(guess_m), -_MAX_OCTAVES, _MAX_OCTAVES)
    return 1.0 if abs(octaves) <= _ROOM else float(2.0**octaves)
