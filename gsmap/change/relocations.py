"""Detect moved objects: changed segments of the older capture that match changed segments of the newer capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from gsmap._native import FeatureTree
from gsmap.change.params import Params
from gsmap.change.poses import features, refine_pose, rotation_about_up, vote_poses
from gsmap.change.segments import CellLabels, ChangedSegment, split_segment, union_of
from gsmap.change.surface_cells import SurfaceCells
from gsmap.compare import CaptureViews
from gsmap.compare.capture_views import project_points
from gsmap.compare.components import components
from gsmap.types import Sim3

_YAW_STARTS = 24  # number of initial rotations about the vertical in the search for a moved segment
_MAX_OFFSET_M = 0.05  # largest distance of a moved segment from the surface at its new place
# Relative to the best score; a better rival makes a move ambiguous, unless the object is symmetric.
_MAX_RIVAL_SCORE = 0.875
_ALIKE = 0.12  # largest difference between the tints of one object
_DARKER = 0.12  # largest difference in lightness of an object between two places
_FEWEST = 30  # smallest number of cells of an object that can be recognized
_COARSE, _FINE, _JUDGED = 80, 300, 250  # cells used for coarse and fine alignment, and for scoring
_TRIED, _KEPT = 10, 3  # number of poses that are refined coarsely, and then finely
_AS_GOOD = 0.92  # relative score of an equally good pose
_LEAST_M = 0.08  # a shorter displacement without rotation is no move
_LEAST_LEFT = 0.14  # smallest fraction of both segments in free space for a move
_APART_M = 0.15  # largest displacement of the centre of a symmetric object
_BESIDE_M = 0.5  # further cells of a moved segment are searched up to this distance
_TAKES_M = 0.1  # cells within this distance of a moved segment are part of it
_ABOUT_M = 0.3  # radius around the former place of a segment
_PIECES_M = 0.4  # pieces with the same motion within this distance of each other are one object
_ROUNDS = 2
_NUDGES = (-0.5, -0.25, 0.0, 0.25, 0.5)  # in radians, for objects that were rotated in place
_PANEL_M = 0.15, 1.0  # thinner and higher segments are doors, which open and shut


@dataclass(frozen=True, eq=False)
class Relocation:
    """The motion of an object between two captures.

    Args:
        older, newer: segments of the object in both captures.
        S_after_before: motion from the former to the new place.
        score: fraction in [0, 1] of the object's cells that fit; the smaller of both directions.
        runner_up: score of the best distinct pose.
        symmetry: rotation about the vertical that fits equally well.
    """

    older: ChangedSegment
    newer: ChangedSegment
    S_after_before: Sim3
    score: float
    runner_up: float
    symmetry: Literal["none", "half", "any"]


@dataclass(eq=False)
class _Capture:
    """A capture, with its segments that have not been matched yet."""

    side: SurfaceCells
    cells: CellLabels
    views: CaptureViews
    segments: list[ChangedSegment]
    tree: FeatureTree

    @classmethod
    def of(
        cls, side: SurfaceCells, cells: CellLabels, views: CaptureViews, segments: Sequence[ChangedSegment]
    ) -> _Capture:
        loose = np.flatnonzero(cells.plane < 0)
        return cls(side, cells, views, list(segments), FeatureTree(_features(side, loose)))

    def points(self, segment: ChangedSegment) -> np.ndarray:
        return self.side.points[segment.cells]


def _features(side: SurfaceCells, rows: np.ndarray) -> np.ndarray:
    return features(side.points[rows], side.colours[rows])


def find_relocations(
    older: Sequence[ChangedSegment],
    newer: Sequence[ChangedSegment],
    sides: tuple[SurfaceCells, SurfaceCells],
    cells: tuple[CellLabels, CellLabels],
    views: tuple[CaptureViews, CaptureViews],
    params: Params,
) -> tuple[list[Relocation], list[ChangedSegment], list[ChangedSegment]]:
    """Return the relocations between two captures, and the remaining segments of the older and the newer capture."""
    a = _Capture.of(sides[0], cells[0], views[0], older)
    b = _Capture.of(sides[1], cells[1], views[1], newer)
    moves: list[Relocation] = []
    tried_before: set[bytes] = set()
    for _ in range(_ROUNDS):
        found = _moves_from(a, b, False, tried_before, params) + _moves_from(b, a, True, tried_before, params)
        news: list[Relocation] = []
        for move in sorted(found, key=lambda m: -m.score):
            if not any(_overlap(move, other, a, b) for other in moves + news):
                whole = _completed(move, a, b)
                if _is_panel(a.points(whole.older)) or _is_panel(b.points(whole.newer)) or _is_stationary(whole):
                    continue
                news.append(whole)
                a.segments, b.segments = _without(a.segments, news[-1].older), _without(b.segments, news[-1].newer)
        if not news:
            break
        moves += news
    return _merge_pieces(moves, a), a.segments, b.segments


def _moves_from(
    here: _Capture, there: _Capture, back: bool, tried_before: set[bytes], params: Params
) -> list[Relocation]:
    """Return the relocations of segments that are not in ``tried_before``; with ``back`` their capture is the newer
    one."""
    found = []
    for seed in _seeds(here):
        name = bytes([back]) + seed.cells.tobytes()
        if name not in tried_before:
            tried_before.add(name)
            move = _moved(seed, here, there, back, params)
            found += [move] if move is not None else []
    return found


def _is_stationary(move: Relocation) -> bool:
    """Return whether too little of an object lies in free space for it to have moved.

    If objects of the same shape and colour replace each other, they appear to be rotated.
    """
    moved = len(move.older.moved) + len(move.newer.moved)
    return moved < _LEAST_LEFT * (len(move.older.cells) + len(move.newer.cells))


def _overlap(move: Relocation, other: Relocation, a: _Capture, b: _Capture) -> bool:
    """Return whether an earlier relocation moves the same object, or moves another object to the same place."""
    same = not _differ(move.S_after_before, other.S_after_before, a.points(move.older))
    for capture, mine, theirs in ((a, move.older, other.older), (b, move.newer, other.newer)):
        if len(np.intersect1d(mine.cells, theirs.cells)) > 0.3 * min(len(mine.cells), len(theirs.cells)):
            return True
        near = cKDTree(capture.points(theirs)).query(capture.points(mine), distance_upper_bound=_TAKES_M)[0]
        if not same and np.isfinite(near).mean() > 0.5:
            return True
    return False


def _merge_pieces(moves: list[Relocation], a: _Capture) -> list[Relocation]:
    """Merge the relocations of neighbouring pieces that have the same motion."""
    kept: list[Relocation] = []
    for move in sorted(moves, key=lambda m: -len(m.older.cells) - len(m.newer.cells)):
        points = a.points(move.older)
        for k, other in enumerate(kept):
            apart = cKDTree(a.points(other.older)).query(points)[0].min()
            if apart < _PIECES_M and not _differ(move.S_after_before, other.S_after_before, points):
                older, newer = union_of(other.older, move.older), union_of(other.newer, move.newer)
                kept[k] = replace(other, older=older, newer=newer)
                break
        else:
            kept.append(move)
    return kept


def _completed(move: Relocation, a: _Capture, b: _Capture) -> Relocation:
    """Extend a relocation by adjacent cells that fit its motion, whether they changed or not."""
    S = move.S_after_before
    older = _with_more(move.older, a, b, S)
    newer = _with_more(move.newer, b, a, S.inverse())
    return replace(move, older=older, newer=newer)


def _with_more(segment: ChangedSegment, here: _Capture, there: _Capture, pose: Sim3) -> ChangedSegment:
    side, cells = here.side, here.cells
    points = here.points(segment)
    low, high = points.min(0) - _BESIDE_M, points.max(0) + _BESIDE_M
    rows = np.flatnonzero(
        np.isin(cells.segment, np.unique(cells.segment[segment.cells]))
        & ((side.points > low) & (side.points < high)).all(1)
    )
    _, similar = _fits(rows, pose.apply(side.points[rows]), side, there.side)
    rows = rows[similar]
    if not len(rows):
        return segment
    # Cells far from all fitting cells belong to another object.
    fits = np.isfinite(cKDTree(side.points[rows]).query(points, distance_upper_bound=_TAKES_M)[0])
    segment, _ = split_segment(segment, segment.cells[fits])
    # Keep only cells connected to the segment.
    every = np.union1d(rows, segment.cells)
    labels = components(side.points[every], _TAKES_M)
    mine = np.unique(labels[np.isin(every, segment.cells)])
    every = every[np.isin(labels, mine)]
    near = cKDTree(side.points[every])
    moved, painted = segment.moved, segment.painted
    for other in here.segments:
        inside = other.cells[np.isfinite(near.query(side.points[other.cells], distance_upper_bound=0.06)[0])]
        every = np.union1d(every, inside)
        moved = np.union1d(moved, np.intersect1d(other.moved, inside))
        painted = np.union1d(painted, np.intersect1d(other.painted, inside))
    return replace(segment, cells=every, moved=moved, painted=painted)


def _without(segments: list[ChangedSegment], gone: ChangedSegment) -> list[ChangedSegment]:
    """Remove the cells of one segment from all segments."""
    left = []
    for segment in segments:
        _, rest = split_segment(segment, gone.cells)
        if len(rest.cells) == len(segment.cells) or len(rest.changed) >= _FEWEST:
            left.append(rest)
    return left


def _seeds(capture: _Capture) -> list[ChangedSegment]:
    """Return the segments that may have moved, which are partly in free space; for some also their part in free space
    alone."""
    seeds = []
    for segment in capture.segments:
        if len(segment.moved) < 8 or len(segment.cells) < _FEWEST or _is_panel(capture.points(segment)):
            continue
        seeds.append(segment)
        core = ChangedSegment(segment.moved, segment.moved, segment.moved[:0])
        if 2 * _FEWEST <= len(segment.moved) < 0.8 * len(segment.cells):
            seeds.append(core)
    return seeds


def _is_panel(points: np.ndarray) -> bool:
    """Return whether a segment is high and thin, like a door."""
    xy = points[:, :2] - points[:, :2].mean(0)
    thin = xy @ np.linalg.eigh(xy.T @ xy)[1][:, 0]
    return bool(np.ptp(np.quantile(thin, (0.05, 0.95))) < _PANEL_M[0] and np.ptp(points[:, 2]) > _PANEL_M[1])


def _moved(seed: ChangedSegment, here: _Capture, there: _Capture, back: bool, params: Params) -> Relocation | None:
    if not there.segments:
        return None
    points = here.points(seed)
    onto = _targets(there, points)
    whole = _features(here.side, seed.cells)
    coarse, fine = (whole[:: max(1, len(whole) // count)] for count in (_COARSE, _FINE))
    tried = vote_poses(
        points,
        here.side.colours[seed.cells],
        there.side.points[onto],
        there.side.colours[onto],
        _YAW_STARTS,
    )
    starts = [pose for _, pose in tried[:_TRIED]]
    # For small displacements most votes are for the unchanged pose, so nearby poses are tried as well.
    middle = points.mean(0)
    starts += [Sim3(rotation_about_up(yaw), middle - rotation_about_up(yaw) @ middle) for yaw in _NUDGES]
    hopes = []
    for pose in starts:
        laid = refine_pose(coarse, there.tree, pose, (0.2, 0.15, 0.12, 0.1))
        hopes.append((_near(coarse, there.tree, laid), laid))
    kept: list[Sim3] = []
    for _, pose in sorted(hopes, key=lambda h: -h[0]):
        if len(kept) < _KEPT and all(_differ(pose, other, points) for other in kept):
            kept.append(pose)
    best: tuple[float, Sim3, ChangedSegment, ChangedSegment] | None = None
    scores = []
    for start in kept:
        pose = refine_pose(fine, there.tree, start, (0.12, 0.1, 0.1, 0.08, 0.08, 0.06, 0.06, 0.05, 0.05))
        if np.linalg.norm(pose.apply(points) - points, axis=1).mean() < _LEAST_M:
            continue
        theirs = _covered(there, points, pose)
        if theirs is None:
            continue
        mine = union_of(seed, _covered(here, there.points(theirs), pose.inverse(), whole=2.0) or seed)
        score = _score(mine, theirs, here, there, pose)
        scores.append((score, pose))
        if best is None or score > best[0]:
            best = score, pose, mine, theirs
    if best is None:
        return None
    score, pose, mine, theirs = best
    polished = refine_pose(fine, there.tree, pose, (0.06,) * 10)
    again = _score(mine, theirs, here, there, polished)
    if again > score:
        score, pose = again, polished
    runner_up = max((s for s, p in scores if _differ(p, pose, points)), default=0.0)
    if (
        score < params.min_moved_fraction + 0.1 * runner_up / max(score, 1e-6)
        or min(len(mine.moved), len(theirs.moved)) < 12
    ):
        return None
    symmetry = _symmetry(mine, theirs, here, there, pose, score)
    if symmetry == "none" and runner_up > _MAX_RIVAL_SCORE * score:
        return None
    if back:
        return Relocation(theirs, mine, pose.inverse(), score, runner_up, symmetry)
    return Relocation(mine, theirs, pose, score, runner_up, symmetry)


def _targets(there: _Capture, points: np.ndarray) -> np.ndarray:
    """Return the candidate cells for a segment: changed cells, and cells around its former place."""
    changed = np.concatenate([t.cells for t in there.segments])
    side = there.side
    low, high = points.min(0) - _ABOUT_M, points.max(0) + _ABOUT_M
    beside = np.flatnonzero((there.cells.plane < 0) & ((side.points > low) & (side.points < high)).all(1))
    out: np.ndarray = np.union1d(changed, beside)
    return out


def _near(moving: np.ndarray, tree: FeatureTree, pose: Sim3) -> float:
    """Return the mean closeness, in [0, 1], of transformed cells to cells of similar colour."""
    moved = np.concatenate([pose.apply(moving[:, :3]), moving[:, 3:]], axis=1)
    return float((1 - np.minimum(tree.distances(moved, 0.1), 0.1) / 0.1).mean())


def _differ(a: Sim3, b: Sim3, points: np.ndarray) -> bool:
    """Return whether two poses move points to different places."""
    few = points[:: max(1, len(points) // 50)]
    return bool(np.linalg.norm(a.apply(few) - b.apply(few), axis=1).mean() > 0.15)


def _covered(capture: _Capture, points: np.ndarray, pose: Sim3, whole: float = 0.5) -> ChangedSegment | None:
    """Return the union of a capture's segments at transformed points; a segment is taken completely if the points cover
    at least the fraction ``whole`` of it."""
    tree = cKDTree(pose.apply(points))
    taken = []
    for segment in capture.segments:
        near = np.isfinite(tree.query(capture.points(segment), distance_upper_bound=_TAKES_M)[0])
        if near.mean() >= whole:
            taken.append(segment)
        elif near.sum() >= _FEWEST:
            taken.append(split_segment(segment, segment.cells[near])[0])
    return reduce(union_of, taken) if taken else None


def _score(mine: ChangedSegment, theirs: ChangedSegment, here: _Capture, there: _Capture, pose: Sim3) -> float:
    """Return the fraction of observable cells that fit; the smaller of both directions."""
    out = _agreement(mine, here, there, pose)
    return min(out, _agreement(theirs, there, here, pose.inverse())) if out > 0 else 0.0


def _agreement(segment: ChangedSegment, here: _Capture, there: _Capture, pose: Sim3) -> float:
    rows = segment.cells[:: max(1, len(segment.cells) // _JUDGED)]
    moved = pose.apply(here.side.points[rows])
    on, similar = _fits(rows, moved, here.side, there.side)
    through = ~on
    through[~on] = _in_free_space(moved[~on], there.views)
    seen = int((on | through).sum())
    if seen < min(0.7 * _FEWEST, 0.3 * len(rows)):
        return 0.0
    return float(similar.sum() / seen)


def _fits(
    rows: np.ndarray, moved: np.ndarray, side: SurfaceCells, other: SurfaceCells
) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask of the moved cells (N, 3) that lie on the other capture's surface, and a mask of those that also
    have its colour."""
    distance, near = other.tree.query(moved, k=4, distance_upper_bound=1.5 * _MAX_OFFSET_M)
    on = np.isfinite(distance[:, 0])
    theirs = other.tints[np.minimum(near, len(other) - 1)]
    apart = theirs - side.tints[rows][:, None]
    if on.sum() >= _FEWEST:  # lighting may differ at the new place
        apart[..., 0] -= np.clip(np.median(apart[on, 0, 0]), -_DARKER, _DARKER)
    unlike = np.where(np.isfinite(distance), np.linalg.norm(apart, axis=2), np.inf).min(1)
    return on, on & (unlike < _ALIKE)


def _in_free_space(points: np.ndarray, views: CaptureViews) -> np.ndarray:
    """Return an (N,) mask of points in free space of a capture's own views."""
    count = np.zeros(len(points), dtype=np.int64)
    for view, sure in zip(views.views[::2], views.sure[::2], strict=True):
        at = project_points(points, view, 0.2)
        behind = sure[at.row, at.column] & (at.z < view.near[at.row, at.column] - 0.06)
        count[at.index[behind]] += 1
    return count >= 1


def _symmetry(
    mine: ChangedSegment, theirs: ChangedSegment, here: _Capture, there: _Capture, pose: Sim3, score: float
) -> Literal["none", "half", "any"]:
    """Return the rotational symmetry about the vertical under which the object fits equally well."""
    points = here.points(mine)
    fine = _features(here.side, mine.cells)[:: max(1, len(points) // _FINE)]
    middle = 0.5 * (np.quantile(points, 0.02, axis=0) + np.quantile(points, 0.98, axis=0))
    fits = []
    for turn in (np.pi, np.pi / 3, -np.pi / 2):
        rotation = rotation_about_up(turn)
        turned = pose @ Sim3(rotation, middle - rotation @ middle)
        laid = refine_pose(fine, there.tree, turned, (0.12, 0.1, 0.08, 0.06))
        stays = np.linalg.norm(laid.apply(middle) - pose.apply(middle)) < _APART_M
        yaw = np.arctan2(*(laid.rotation @ turned.rotation.T)[[1, 0], 0])
        good = stays and abs(yaw) < 0.3
        fits.append(bool(good and _score(mine, theirs, here, there, laid) >= _AS_GOOD * score))
        if not fits[0]:
            return "none"
    return "any" if all(fits) else "half"
