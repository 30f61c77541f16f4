"""Where a photograph may have been taken: views that look alike, matches with them, poses that these agree on.

Most matches are wrong, and among a thousand a dozen agree on some pose by chance. But each match alone says about how
the camera was turned (`gsmap.localize.turned`); so poses are looked for among matches that say the same of it, and
those that say otherwise do not count for a pose. Then four that agree are worth a look.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.geometry.rotations import angle_between, matrices_to_quats, multiply_quats
from gsmap.localize import matching, resection, turned
from gsmap.localize.placed import PlacedFeatures

_SEEDS = 1000  # matches, at most, whose turn others are asked for
_SAME_TURN = 1 / 3  # of what matches may differ by: nearer turns than this lead to the same set


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
        turns: (K, 4) how the camera was turned in the frame of the component, as each alone says.
        scenes: ids.
    """

    feature: np.ndarray
    points: np.ndarray
    scene: np.ndarray
    view: np.ndarray
    turns: np.ndarray
    scenes: tuple[str, ...]


def matches_by_component(
    photo: matching.Described,
    turns: np.ndarray,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, PlacedFeatures],
    params: matching.Params,
) -> dict[int, Matches]:
    """What the features of a photo match in some views (of scenes, by number), by component of the map.

    Matches with all views of a component are one set, so that captures which each show a part of the place add up.

    Args:
        turns: (N, 4) of the photo's features in its camera (`gsmap.localize.turned`).
    """
    chosen: dict[int, list[tuple[str, int]]] = {}
    for scene, view in views:
        chosen.setdefault(scenes[scene].component, []).append((scene, view))
    return {component: _matches(photo, turns, mine, scenes, params) for component, mine in chosen.items()}


def _matches(
    photo: matching.Described,
    turns: np.ndarray,
    views: Sequence[tuple[str, int]],
    scenes: Mapping[str, PlacedFeatures],
    params: matching.Params,
) -> Matches:
    names = tuple(dict.fromkeys(scene for scene, _ in views))
    in_component = {scene: matrices_to_quats(scenes[scene].S_metric_scene.rotation) for scene in names}
    feature, points, whose, view_of, turned_by = [], [], [], [], []
    for number, (scene, view) in enumerate(views):
        held = scenes[scene].features
        part = slice(int(held.starts[view]), int(held.starts[view + 1]))
        mine, theirs = matching.matched(photo, matching.Described(held.descriptors[part], held.angles[part]), params)
        feature.append(mine)
        points.append(scenes[scene].S_metric_scene.apply(held.points[part][theirs]))
        whose.append(np.full(len(mine), names.index(scene)))
        view_of.append(np.full(len(mine), number))
        there = turned.in_scene(held, part.start + theirs, np.full(len(theirs), view))
        turned_by.append(multiply_quats(in_component[scene], turned.of_camera(there, turns[mine])))
    return Matches(
        np.concatenate(feature),
        np.concatenate(points),
        np.concatenate(whose),
        np.concatenate(view_of),
        np.concatenate(turned_by),
        names,
    )


def candidates(
    pixels: np.ndarray,
    found: Mapping[int, Matches],
    intrinsics_px: np.ndarray,
    size_px: tuple[int, int],
    focal_sigma: float,
    params: resection.Params,
    *,
    angles_known: bool = True,
) -> list[Candidate]:
    """Poses that matches agree on, most inliers first, none twice.

    Args:
        pixels: (N, 2) of all features of the photo.
        angles_known: whether the extractor says how features are turned; else matches say how the camera was turned but
            for a roll that they share.
    """
    fewest = resection.fewest(focal_sigma, params)
    bars = replace(params, min_inliers=fewest)
    out: list[Candidate] = []
    for component, matches in found.items():
        at = pixels[matches.feature]
        for rows in _turned_alike(matches, params):
            if len(np.unique(matches.feature[rows])) < fewest:
                continue
            pose = resection.resect(at[rows], matches.points[rows], intrinsics_px, size_px, focal_sigma, bars)
            if pose is None:
                continue
            agreeing = resection.agreeing(at, matches.points, pose.T_map_camera, pose.intrinsics_px, size_px, params)
            turn = matrices_to_quats(pose.T_map_camera[None, :3, :3])
            if not angles_known:
                turn = turned.rolled(turn, matches.turns[agreeing])
            agreeing &= turned.alike(matches.turns, turn, params.max_turn_deg)[:, 0]
            count = len(np.unique(matches.feature[agreeing]))
            if count >= fewest:
                scenes = _by_support(matches, agreeing)
                agree = at[agreeing], matches.points[agreeing]
                out.append(Candidate(component, pose.T_map_camera, pose.intrinsics_px, count, scenes, *agree))
    out.sort(key=lambda one: (-one.num_inliers, one.component))
    return _different(out, params)


def _turned_alike(matches: Matches, params: resection.Params) -> list[np.ndarray]:
    """Sets (n,) of matches that say about the same of how the camera was turned: of all, those of most features of the
    photo, then of those that say otherwise, and so on; and of each view alone that of most.
    """
    if not len(matches.feature):
        return []
    seeds = np.unique(np.linspace(0, len(matches.feature) - 1, _SEEDS).astype(int))
    alike = turned.alike(matches.turns[seeds], matches.turns, params.max_turn_deg)
    count = _distinct(alike, matches.feature)
    out = []
    for _ in range(params.turns):
        best = int(np.argmax(count))
        if count[best] < params.min_agreeing:
            break
        out.append(np.flatnonzero(alike[best]))
        near = turned.alike(matches.turns[seeds], matches.turns[seeds[best]][None], _SAME_TURN * params.max_turn_deg)
        count[near[:, 0]] = 0
    for view in np.unique(matches.view):
        mine = np.flatnonzero(matches.view == view)
        alike = turned.alike(matches.turns[mine], matches.turns[mine], params.max_turn_deg)
        out.append(mine[alike[int(np.argmax(alike.sum(1)))]])
    return out


def _distinct(chosen: np.ndarray, feature: np.ndarray) -> np.ndarray:
    """(S,) how many different features there are among those that are chosen (S, K)."""
    order = np.argsort(feature, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(feature[order]) > 0])
    out: np.ndarray = np.logical_or.reduceat(chosen[:, order], first, axis=1).sum(1)
    return out


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
