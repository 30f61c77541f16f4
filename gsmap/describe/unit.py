"""What a metre is, in a scene whose scale nobody knows.

Landmarks have sizes: a blob of 8 cm, a cylinder of 1.1 m. A capture in an unknown unit is described at a guessed
unit, from how far its cameras stand from what they see. Two captures of one place need not give the same guess, but
landmarks stand a mismatch (on the test house recall falls from .83 to .70 at 20 percent, and three quarters of the
correct matches remain), and guesses differ by less than a factor of 3. So each scene is described at the guess times
1.45 to the powers -2, 0 and 1: differences of these three cover -3 to 3, hence any relative error of two guesses up
to 1.45^3.5 = 3.7 is met by one pair of layers within 1.45^0.5 = 20 percent. The true scale then comes from
registration.

Nor is a metre the right size for landmarks wherever it is known. What is seen from 7 m, as a court is, has its corners
and patterns, and its Gaussians, four times as large as what is seen from 1.7 m. So a capture whose views are not those
of a room is described at other sizes as well: at the powers of two about its guess, which are the same for every
capture, so that two of one place have one in common; and lengths of its registration hold in its *working metres*,
under which it looks like a room.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras

LEVEL_STEP = 1.45
LEVELS = (-2, 0, 1)
_ROOM = 1.0  # octaves from one that are still a room: the guess is right to a factor of about two
_MOST_OCTAVES = 5  # places seen from farther than 50 m, or nearer than 5 cm, are described as from there


@dataclass(frozen=True)
class Params:
    """What the metre is guessed from.

    Args:
        view_distance_m: typical distance from a camera to what it sees; indoors by default.
        room_height_m: where there are no cameras but up is known.
        room_width_m: where up is unknown too.
        plausible_m: metres per scene unit between which a scene's own unit may be the metre. The guess is right to a
            factor of about 2, and a large hall is still a room.
    """

    view_distance_m: float = 1.7
    room_height_m: float = 2.4
    room_width_m: float = 5.0
    plausible_m: tuple[float, float] = (0.25, 4.0)


def estimate_unit_m(
    points: np.ndarray, cameras: Cameras | None, up: np.ndarray | None, params: Params | None = None
) -> float:
    """Metres per scene unit, to a factor of about two; scales exactly inversely with the scene.

    From the median distance of the nearest surface in 16 x 12 parts of the images; without cameras from the height of
    the room, or its width where up is unknown too. 1 when there is nothing to tell it from.

    Args:
        points: (N, 3) surface points, scene frame and unit.
        cameras: scene frame; synthesised ones tell nothing.
        up: (3,) against gravity, scene frame.
    """
    params = params or Params()
    if cameras is not None and len(cameras) and not cameras.synthesised:
        distance = _view_distance(points, cameras)
        if distance > 0:
            return params.view_distance_m / distance
    if len(points) < 2:
        return 1.0
    if up is not None:
        height = float(np.ptp(np.percentile(points @ up, [2, 98])))
        return params.room_height_m / height if height > 0 else 1.0
    width = float(np.median(np.ptp(np.percentile(points, [2, 98], axis=0), axis=0)))
    return params.room_width_m / width if width > 0 else 1.0


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


def landmark_units(
    guess_m: float, scale_policy: str, params: Params | None = None, *, working_m: float = 1.0
) -> dict[str, float]:
    """Metres per scene unit that each landmark layer assumes, by the layer's name.

    ``landmarks`` and ``landmarks@K``, whose lengths are 2 to the power K times as many metres, where the unit may be
    the metre; ``landmarks:I`` at guesses.

    Args:
        guess_m: metres per scene unit, from `estimate_unit_m`.
        scale_policy: ``known``, ``unknown`` or ``auto``; see `gsmap.describe.describe`.
        working_m: from `working_unit_m`.
    """
    low, high = (params or Params()).plausible_m
    levels = {f"landmarks:{i}": guess_m * LEVEL_STEP**power for i, power in enumerate(LEVELS)}
    metric = {"landmarks": 1.0}
    if working_m != 1.0:
        octave = int(np.floor(-np.log2(working_m)))
        metric |= {f"landmarks@{k}": 2.0**-k for k in (octave, octave + 1) if k}
    if scale_policy == "known":
        return metric
    return {**metric, **levels} if scale_policy == "auto" and low < guess_m < high else levels


def working_unit_m(guess_m: float, cameras: Cameras | None) -> float:
    """Working metres per metre: 1 where views are those of a room, else what makes them so; see the module.

    Without cameras nobody knows from where a scene was seen, and the height of its content says little of that: 1.
    """
    if cameras is None or not len(cameras) or cameras.synthesised:
        return 1.0
    octaves = np.clip(np.log2(guess_m), -_MOST_OCTAVES, _MOST_OCTAVES)
    return 1.0 if abs(octaves) <= _ROOM else float(2.0**octaves)
