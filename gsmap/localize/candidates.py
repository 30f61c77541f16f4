"""Estimate candidate poses of a photo from its matches with views of the map.

Most matches are wrong, and in a thousand matches a dozen agree on some pose by chance. A single match gives the
camera's orientation roughly (`gsmap.localize.feature_frames`). So poses are estimated from matches with a common
orientation, and only these matches count as inliers. Four of them then suffice for a candidate.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from gsmap.geometry.rotations import angle_between, matrices_to_quats, multiply_quats
from gsmap.localize import feature_frames, matching, resection
from gsmap.localize.distances import relative_distance
from gsmap.localize.map_scene import MapScene

MAX_TURN_DEG = 30.0
"""Largest angle between the orientation from an inlier match and the orientation of the pose."""

MAX_ORIENTATIONS = 10
"""Number of clusters of orientations from which poses are estimated, the largest clusters first."""

DUPLICATE_M, DUPLICATE_DEG = 0.4, 12.0
"""Two poses that are nearer to each other would be refined to the same pose; in metres at distances of a room
(`gsmap.localize.distances`)."""

_MAX_SEEDS = 1000  # number of matches around which clusters of orientations are grown
_SAME_CLUSTER = 1 / 3  # of MAX_TURN_DEG: nearer orientations lead to the same cluster


@dataclass(frozen=True, eq=False)
class PoseCandidate:
    """A candidate pose.

    Args:
        component: number of the component.
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) ``fx fy cx cy``.
        num_inliers: number of different features of the photo among the inliers.
        scenes: ids of the matched scenes, sorted by their number of inliers.
        pixels, points: (K, 2) pixels and (K, 3) points (metres) of the inlier matches.
    """

    component: int
    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    num_inliers: int
    scenes: tuple[str, ...]
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @cached_property
    def scale(self) -> float:
        """Distance of the matched points relative to the distances of a room (`gsmap.localize.distances`)."""
        return relative_distance(np.linalg.norm(self.points - self.T_metric_camera[:3, 3], axis=1))


@dataclass(frozen=True, eq=False)
class PointMatches:
    """Matches of a photo's features with points of one component.

    Args:
        feature: (K,) rows of the photo's features.
        points: (K, 3) positions in the frame of the component, in metres.
        scene: (K,) index of the scene in ``scenes``.
        view: (K,) index of the view.
        orientations: (K, 4) orientation of the camera in the frame of the component, from each match alone.
        scenes: ids of the scenes.
    """

    feature: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    view: np.ndarray
    orientations: np.ndarray
    scenes: tuple[str, ...]


def match_views(
    photo: matching.FeatureSet,
    frames: np.ndarray,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, MapScene],
) -> dict[int, PointMatches]:
    """Match a photo with views of scenes (by number), and pool the matches of each component.

    Thus matches with captures that each show a part of the place add up.

    Args:
        frames: (N, 4) frames of the photo's features in its camera (`gsmap.localize.feature_frames`).
    """
    chosen: dict[int, list[tuple[str, int]]] = {}
    for scene, view in views:
        chosen.setdefault(scenes[scene].component, []).append((scene, view))
    return {component: _match_component(photo, frames, of_one, scenes) for component, of_one in chosen.items()}


def _match_component(
    photo: matching.FeatureSet,
    frames: np.ndarray,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, MapScene],
) -> PointMatches:
    names = tuple(dict.fromkeys(scene for scene, _ in views))
    in_component = {scene: matrices_to_quats(scenes[scene].S_metric_scene.rotation) for scene in names}
    feature, points, scene_of, view_of, orientations = [], [], [], [], []
    for number, (scene, view) in enumerate(views):
        stored = scenes[scene].features
        part = slice(int(stored.starts[view]), int(stored.starts[view + 1]))
        rows, columns = matching.match_features(
            photo, matching.FeatureSet(stored.descriptors[part], stored.angles[part])
        )
        feature.append(rows)
        points.append(scenes[scene].S_metric_scene.apply(stored.points[part][columns]))
        scene_of.append(np.full(len(rows), names.index(scene)))
        view_of.append(np.full(len(rows), number))
        in_scene = feature_frames.scene_frames(stored, part.start + columns, np.full(len(columns), view))
        orientations.append(
            multiply_quats(in_component[scene], feature_frames.camera_orientations(in_scene, frames[rows]))
        )
    return PointMatches(
        np.concatenate(feature),
        np.concatenate(points),
        np.concatenate(scene_of),
        np.concatenate(view_of),
        np.concatenate(orientations),
        names,
    )


def propose_poses(
    pixels: np.ndarray,
    found: Mapping[int, PointMatches],
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    focal_sigma: float,
    *,
    has_angles: bool = True,
) -> list[PoseCandidate]:
    """Estimate candidate poses from clusters of matches, without duplicates; the pose with most inliers comes first.

    Args:
        pixels: (N, 2) positions of all features of the photo.
        has_angles: the extractor measures the angles of features; without angles all orientations from matches share an
            unknown roll.
    """
    min_inliers = resection.min_inliers(focal_sigma)
    out: list[PoseCandidate] = []
    for component, matches in found.items():
        at = pixels[matches.feature]
        for rows in _cluster_orientations(matches):
            if len(np.unique(matches.feature[rows])) < min_inliers:
                continue
            pose = resection.resect(
                at[rows], matches.points[rows], intrinsics_px, size_px, focal_sigma, min_inliers=min_inliers
            )
            if pose is None:
                continue
            inliers = resection.find_inliers(at, matches.points, pose.T_map_camera, pose.intrinsics_px, size_px)
            orientation = matrices_to_quats(pose.T_map_camera[None, :3, :3])
            if not has_angles:
                orientation = feature_frames.fit_roll(orientation, matches.orientations[inliers])
            inliers &= feature_frames.within_angle(matches.orientations, orientation, MAX_TURN_DEG)[:, 0]
            count = len(np.unique(matches.feature[inliers]))
            if count >= min_inliers:
                scenes = _scenes_by_inliers(matches, inliers)
                of_pose = at[inliers], matches.points[inliers]
                out.append(PoseCandidate(component, pose.T_map_camera, pose.intrinsics_px, count, scenes, *of_pose))
    out.sort(key=lambda one: (-one.num_inliers, one.component))
    return _without_duplicates(out)


def _cluster_orientations(matches: PointMatches) -> list[np.ndarray]:
    """Return clusters (n,) of matches with similar orientations: the largest clusters over all views, and the largest
    of each view."""
    if not len(matches.feature):
        return []
    seeds = np.unique(np.linspace(0, len(matches.feature) - 1, _MAX_SEEDS).astype(int))
    within = feature_frames.within_angle(matches.orientations[seeds], matches.orientations, MAX_TURN_DEG)
    count = _count_features(within, matches.feature)
    out = []
    for _ in range(MAX_ORIENTATIONS):
        best = int(np.argmax(count))
        if count[best] < resection.MIN_INLIERS:
            break
        out.append(np.flatnonzero(within[best]))
        near = feature_frames.within_angle(
            matches.orientations[seeds], matches.orientations[seeds[best]][None], _SAME_CLUSTER * MAX_TURN_DEG
        )
        count[near[:, 0]] = 0
    for view in np.unique(matches.view):
        rows = np.flatnonzero(matches.view == view)
        within = feature_frames.within_angle(matches.orientations[rows], matches.orientations[rows], MAX_TURN_DEG)
        out.append(rows[within[int(np.argmax(within.sum(1)))]])
    return out


def _count_features(chosen: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """Return the (S,) number of different features among the chosen matches (S, K)."""
    order = np.argsort(feature, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(feature[order]) > 0])
    out: np.ndarray = np.logical_or.reduceat(chosen[:, order], first, axis=1).sum(1)
    return out


def _without_duplicates(found: Sequence[PoseCandidate]) -> list[PoseCandidate]:
    out: list[PoseCandidate] = []
    for one in found:
        if not any(is_duplicate(one, other) for other in out):
            out.append(one)
    return out


def is_duplicate(one: PoseCandidate, other: PoseCandidate) -> bool:
    """Return whether two candidates are so near to each other that they would be refined to one pose."""
    if one.component != other.component:
        return False
    far = np.linalg.norm(one.T_metric_camera[:3, 3] - other.T_metric_camera[:3, 3])
    angle = angle_between(one.T_metric_camera[:3, :3], other.T_metric_camera[:3, :3])
    return bool(far < DUPLICATE_M * min(one.scale, other.scale) and np.degrees(angle) < DUPLICATE_DEG)


def _scenes_by_inliers(matches: PointMatches, inliers: np.ndarray) -> tuple[str, ...]:
    """Return the ids of all matched scenes, sorted by their number of inliers."""
    counts = np.bincount(matches.scene[inliers], minlength=len(matches.scenes))
    order: Sequence[int] = np.argsort(-counts, kind="stable").tolist()
    return tuple(matches.scenes[k] for k in order)
