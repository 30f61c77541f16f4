"""Compute pose changes between two answers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsmap.geometry.rotations import angle_between
from gsmap.types import PoseChange, PoseGraph, Sim3


def diff(
    before: PoseGraph, after: PoseGraph, centroids: Mapping[str, np.ndarray] | None = None
) -> dict[str, PoseChange]:
    """Compare two answers: return the change of each scene's pose by scene id, in the order of ``after``, then removed
    scenes.

    Args:
        centroids: (3,) centre of each scene's content in the scene's frame; the origin by default. Displacements are
            measured there, because a rotation about a far origin displaces the content a lot.
    """
    centroids = centroids or {}
    out = {}
    for scene in [*after.poses, *(s for s in before.poses if s not in after.poses)]:
        old, new = before.poses.get(scene), after.poses.get(scene)
        rotation: float | None = None
        translation: float | None = None
        ratio: float | None = None
        kind = "added" if old is None else "removed"
        if old is not None and new is not None:
            rotation, translation, ratio = motion(old.S_map_scene, new.S_map_scene, centroids.get(scene))
            same = rotation == 0 and translation == 0 and ratio == 1 and old.component == new.component
            kind = "same" if same else "moved"
        out[scene] = PoseChange(
            scene,
            kind,
            rotation,
            translation,
            ratio,
            (old.component if old else None, new.component if new else None),
            (old.status if old else None, new.status if new else None),
        )
    return out


def motion(old: Sim3, new: Sim3, centroid: np.ndarray | None = None) -> tuple[float, float, float]:
    """Compute the rotation in degrees, the displacement of the centroid in map units, and the scale ratio between two
    poses."""
    middle = np.zeros(3) if centroid is None else np.asarray(centroid, dtype=np.float64)
    turned = np.degrees(angle_between(old.rotation, new.rotation))
    return float(turned), float(np.linalg.norm(new.apply(middle) - old.apply(middle))), new.scale / old.scale


def moved(old: Sim3, new: Sim3, threshold_m: float, corners: np.ndarray) -> bool:
    """Return whether any of the points (N, 3), such as the corners of a scene's box, moves farther than the
    threshold."""
    corners = np.asarray(corners, dtype=np.float64).reshape(-1, 3)
    return bool(np.linalg.norm(new.apply(corners) - old.apply(corners), axis=1).max(initial=0) > threshold_m)
