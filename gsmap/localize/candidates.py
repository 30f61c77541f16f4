"""Where a photograph may have been taken: views that look alike, matches with them, poses that these agree on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from gsmap.geometry.rotations import angle_between
from gsmap.localize import matching, resection
from gsmap.localize.placed import PlacedFeatures


@dataclass(frozen=True, eq=False)
class Candidate:
    """A place to look at.

    Args:
        component: of the map.
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,).
        num_inliers: different features of the photo that agree.
        scenes: ids, those with most of them first.
        pixels, points: (K, 2), (K, 3) the matches that agree, metres.
    """

    component: int
    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    num_inliers: int
    scenes: tuple[str, ...]
    pixels: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Matches:
    """Features of a photo, and places of the map that they may show.

    Args:
        feature: (K,) rows of the photo's.
        points: (K, 3) in the frame of the component, metres.
        scene: (K,) whose, among ``scenes``.
        view: (K,) by which of the views.
        scenes: ids.
    """

    feature: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    view: np.ndarray
    scenes: tuple[str, ...]


def matches_by_component(
    photo: matching.Described,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, PlacedFeatures],
    params: matching.Params,
) -> dict[int, Matches]:
    """What the features of a photo match in some views (of scenes, by number), by component of the map.

    Matches with all views of a component are one set, so that captures which each show a part of the place add up.
    """
    chosen: dict[int, list[tuple[str, int]]] = {}
    for scene, view in views:
        chosen.setdefault(scenes[scene].component, []).append((scene, view))
    return {component: _matches(photo, mine, scenes, params) for component, mine in chosen.items()}


def _matches(
    photo: matching.Described,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, PlacedFeatures],
    params: matching.Params,
) -> Matches:
    names = tuple(dict.fromkeys(scene for scene, _ in views))
    feature, points, whose, view_of = [], [], [], []
    for number, (scene, view) in enumerate(views):
        held = scenes[scene].features
        part = slice(int(held.starts[view]), int(held.starts[view + 1]))
        mine, theirs = matching.matched(photo, matching.Described(held.descriptors[part], held.angles[part]), params)
        feature.append(mine)
        points.append(scenes[scene].S_metric_scene.apply(held.points[part][theirs]))
        whose.append(np.full(len(mine), names.index(scene)))
        view_of.append(np.full(len(mine), number))
    return Matches(
        np.concatenate(feature), np.concatenate(points), np.concatenate(whose), np.concatenate(view_of), names
    )


def candidates(
    pixels: np.ndarray,
    found: Mapping[int, Matches],
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    focal_sigma: float,
    params: resection.Params,
) -> list[Candidate]:
    """Poses that matches agree on, most inliers first, none twice.

    A pose is looked for among all matches of a component, and among those with each view alone, where a view that
    shows the same has a far larger share of right ones.

    Args:
        pixels: (N, 2) of all features of the photo.
    """
    out: list[Candidate] = []
    for component, matches in found.items():
        at = pixels[matches.feature]
        sets = [np.arange(len(at)), *(np.flatnonzero(matches.view == view) for view in np.unique(matches.view))]
        for rows in sets:
            if len(np.unique(matches.feature[rows])) < params.min_inliers:
                continue
            pose = resection.resect(at[rows], matches.points[rows], intrinsics_px, size_px, focal_sigma, params)
            if pose is None:
                continue
            agreeing = resection.agreeing(at, matches.points, pose.T_map_camera, pose.intrinsics_px, size_px, params)
            count = len(np.unique(matches.feature[agreeing]))
            if count >= params.min_inliers:
                scenes = _by_support(matches, agreeing)
                agree = at[agreeing], matches.points[agreeing]
                out.append(Candidate(component, pose.T_map_camera, pose.intrinsics_px, count, scenes, *agree))
    out.sort(key=lambda one: (-one.num_inliers, one.component))
    return _different(out, params)


def _different(found: Sequence[Candidate], params: resection.Params) -> list[Candidate]:
    """The candidates without those that would settle where a better one does."""
    out: list[Candidate] = []
    for one in found:
        if not any(near_to(one, other, params) for other in out):
            out.append(one)
    return out


def near_to(one: Candidate, other: Candidate, params: resection.Params) -> bool:
    """Whether two poses would settle at one."""
    if one.component != other.component:
        return False
    far = np.linalg.norm(one.T_metric_camera[:3, 3] - other.T_metric_camera[:3, 3])
    angle = angle_between(one.T_metric_camera[:3, :3], other.T_metric_camera[:3, :3])
    return bool(far < params.same_m and np.degrees(angle) < params.same_deg)


def _by_support(matches: Matches, agreeing: np.ndarray) -> tuple[str, ...]:
    """Ids of the scenes, those with most inliers first; those that were looked into and have none last."""
    counts = np.bincount(matches.scene[agreeing], minlength=len(matches.scenes))
    order: Sequence[int] = np.argsort(-counts, kind="stable").tolist()
    return tuple(matches.scenes[k] for k in order)
