"""Estimate the metric unit of a scene without known scale, and choose the units of its landmark layers.

Landmarks have fixed sizes: a blob of 8 cm, a cylinder of 1.1 m. A capture in an unknown unit is described at an
estimated unit, which follows from the distance of its cameras to the surface. Estimates from two captures of one place
may differ by a factor of up to 3. Landmarks tolerate a small mismatch: at 20 percent the recall on the test house falls
from 0.83 to 0.70, and three quarters of the correct matches remain. So each scene is described at the estimate times
1.45 to the powers -2, 0 and 1. The differences of these powers cover -3 to 3; so for a ratio of two estimates of up to
1.45^3.5 = 3.7, one pair of layers agrees within 1.45^0.5, or 20 percent. Registration then gives the true scale.

Landmarks of a fixed size in metres do not suit every scene, even if the metre is known. A court seen from 7 m has
corners, patterns and Gaussians four times as large as a room seen from 1.7 m. So a capture with other viewing distances
than a room is described at other sizes as well: at the two powers of two around its estimate. Powers of two are the
same for every capture, so two captures of one place have one in common. The lengths used in its registration are in its
*working metres*, in which it looks like a room.
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.metric_scale import PLAUSIBLE_M
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras

LEVEL_STEP = 1.45
LEVELS = (-2, 0, 1)
VIEW_DISTANCE_M = 1.7
"""Default of the typical distance in metres from a camera to the surface that it sees; valid indoors."""

_ROOM_HEIGHT_M = 2.4  # assumed without cameras, if the vertical is known
_ROOM_WIDTH_M = 5.0  # assumed without cameras, if the vertical is unknown as well
_ROOM = 1.0  # an estimate within this many octaves of 1 is a room, as it is accurate to a factor of about two
_MAX_OCTAVES = 5  # larger and smaller places are described as if seen from 50 m and from 5 cm


def estimate_unit_m(
    points: np.ndarray, cameras: Cameras | None, up: np.ndarray | None, view_distance_m: float = VIEW_DISTANCE_M
) -> float:
    """Estimate metres per scene unit, to a factor of about two; the estimate is exactly inverse to the scene's size.

    The estimate follows from the median distance of the nearest surface in 16 x 12 parts of the images. Without cameras
    it follows from the height of the room or, if the vertical is unknown as well, from its width; without any evidence
    it is 1.

    Args:
        points: (N, 3) surface points in the scene's frame and unit.
        cameras: cameras in the scene's frame; synthesized ones are ignored.
        up: (3,) direction against gravity in the scene's frame.
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
    """Return the metres per scene unit that each landmark layer assumes, by the name of the layer.

    If the unit may be the metre there are layers ``landmarks`` and ``landmarks@K``, in which lengths are larger by 2 to
    the power K; layers ``landmarks:I`` are at estimated units.

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
    """Return working metres per metre: 1 if the viewing distances are like those in a room, otherwise the factor that
    makes them so.

    Without cameras the viewing distance is unknown, and the height of the content is no measure of it; then the result
    is 1.
    """
    if cameras is None or not len(cameras) or cameras.synthesised:
        return 1.0
    octaves = np.clip(np.log2(guess_m), -_MAX_OCTAVES, _MAX_OCTAVES)
    return 1.0 if abs(octaves) <= _ROOM else float(2.0**octaves)
