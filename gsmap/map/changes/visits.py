"""Select the pairs of visits that are compared for changes: each visit with the latest visits before it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from gsmap.geometry.boxes import box_corners, moved_box
from gsmap.settings.ranges import require_range
from gsmap.types import Sim3

_SAMPLES = 12  # points along each axis of a visit's box by which its coverage is estimated
_COVERED = 0.99  # fraction of these points of a covered box
MAX_SHIFT_M = 0.02  # a pair that moved farther against each other, anywhere in what both show, is compared again
_MAX_TURN_DEG = 0.2  # and one that turned further


@dataclass(frozen=True)
class Params:
    """Settings of the choice of earlier visits that a scene is compared with.

    Args:
        min_new_fraction: Smallest fraction in (0, 1] of a scene's bounding box that an earlier visit must cover, beyond
            the part covered by visits chosen already, to be compared with the scene; visits are tried from the latest
            to the earliest. Larger compares fewer pairs.
        max_earlier_visits: Largest number of earlier visits that a scene is compared with, at least 0; larger compares
            more pairs.
    """

    min_new_fraction: float = 0.1
    max_earlier_visits: int = 8

    def __post_init__(self) -> None:
        require_range(self, "(0, 1]", "min_new_fraction")
        require_range(self, "[0, inf]", "max_earlier_visits")


@dataclass(frozen=True, eq=False)
class Visit:
    """A dated scene with a pose in the map.

    Args:
        scene: its id.
        when: time of the capture.
        component: component that it is placed in.
        S_map_scene: its pose, scaled to metres.
        bounds: (2, 3) box of its Gaussians, scene frame.
        metres_per_unit: of the component's frame.
    """

    scene: str
    when: datetime
    component: int
    S_map_scene: Sim3
    bounds: np.ndarray
    metres_per_unit: float = 1.0

    def box(self) -> np.ndarray:
        """Return the axis-aligned box (2, 3) around the visit's box, in the map frame."""
        return moved_box(self.bounds, self.S_map_scene)


def pairs_of_visits(visits: Sequence[Visit], params: Params) -> list[tuple[str, str]]:
    """Return pairs (older, newer) of scene ids: every visit with its latest earlier visits that together cover it.

    Not all pairs, as changes over several visits follow from those between consecutive ones. Only boxes are used, and
    no array is read; scenes of one moment are one visit, and not compared.
    """
    found: list[tuple[str, str]] = []
    ordered = sorted(visits, key=lambda visit: (visit.when, visit.scene))
    boxes = {visit.scene: visit.box() for visit in ordered}
    for i, newer in enumerate(ordered):
        left = np.ones(_SAMPLES**3, dtype=bool)
        points, count = _samples(newer), 0
        for older in reversed(ordered[:i]):
            if count == params.max_earlier_visits or left.mean() <= 1 - _COVERED:
                break
            if older.when == newer.when or older.component != newer.component:
                continue
            if not _touch(boxes[older.scene], boxes[newer.scene]):
                continue
            seen = left & _inside(points, older)
            if seen.mean() >= params.min_new_fraction:
                found.append((older.scene, newer.scene))
                left, count = left & ~seen, count + 1
    return found


def has_moved(older: Visit, newer: Visit, S_newer_older: Sim3) -> bool:
    """Return true if the relative pose of two visits differs from ``S_newer_older`` by more than the tolerance."""
    now = newer.S_map_scene.inverse() @ older.S_map_scene
    turn = now.rotation @ S_newer_older.rotation.T
    sine = np.linalg.norm([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
    if np.degrees(np.arctan2(sine, (np.trace(turn) - 1) / 2)) > _MAX_TURN_DEG:
        return True
    a, b = older.box(), newer.box()
    shared = np.array([np.maximum(a[0], b[0]), np.minimum(a[1], b[1])])
    if not (shared[1] >= shared[0]).all():
        shared = b
    in_newer = newer.S_map_scene.inverse().apply(box_corners(shared))
    off = S_newer_older.apply(now.inverse().apply(in_newer)) - in_newer
    return bool(np.linalg.norm(off, axis=1).max() * newer.S_map_scene.scale > MAX_SHIFT_M)


def _samples(visit: Visit) -> np.ndarray:
    """Return points (N, 3) on a grid in a visit's box, in the map frame."""
    low, high = np.asarray(visit.bounds, dtype=np.float64)
    steps = (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    grid = np.array(np.meshgrid(steps, steps, steps, indexing="ij")).reshape(3, -1).T
    return visit.S_map_scene.apply(low + grid * (high - low))


def _inside(points: np.ndarray, visit: Visit) -> np.ndarray:
    low, high = visit.bounds
    local = visit.S_map_scene.inverse().apply(points)
    return np.asarray(((local >= low) & (local <= high)).all(1))


def _touch(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())
