"""Propagate evidence of change over segments: connected groups of Gaussians that are one physical object.

Evidence on single Gaussians and their neighbours has two kinds of errors. Thin objects, edges and lighting make a few
Gaussians of an unchanged object look changed. And if a similar object replaces an object, most of its Gaussians lie on
the new surface in nearly the new colour. So a change needs *roots*: Gaussians that changed beyond doubt. If much of a
segment changed, the change spreads to Gaussians of the segment that differ only slightly.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from gsmap.compare.components import components
from gsmap.compare.structure import normals_of, planes
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.neighbours import nearest_of, neighbours_of

_CELL_M = 0.05  # edge of the surface cells in which planes are detected
_FEWEST = 5  # smallest number of points of a hull
_VOTERS = 5  # nearest judged neighbours that vote
# Changed Gaussians nearer to each other than this, on one shell plane or off all planes, are one change.
_CHANGE_LINK_M = 0.1
# Smallest number of roots that prove a change, and smallest fraction of its Gaussians.
MIN_ROOTS, MIN_ROOT_FRACTION = 8, 0.2
# Difference at which a Gaussian without changed neighbours counts, relative to the smallest that counts.
_ISOLATED_COLOUR = 4.0
_ADJACENT_M = 0.35  # largest distance from a proven change at which such a Gaussian joins the change
_SEGMENT_LINK_M = 0.08  # Gaussians nearer to each other than this are in one segment
_MIN_CHANGED_FRACTION = 0.2  # a change spreads over a segment if at least this fraction of it changed
_WEAK_COLOUR = 0.2  # difference that counts in such a segment, relative to the smallest that counts elsewhere
_NEIGHBOUR_M = 0.15  # most neighbours on the segment within this distance must have changed
_NEAR_SHELL_M = 0.1  # Gaussians nearer to the shell than this may be a frame or skirting board
# Such Gaussians join a segment's change up to this distance outside of the hull of the change.
MAX_OUTSIDE_HULL_M = 0.05
_MIN_REMNANT_FRACTION = 0.5  # smallest changed fraction of a segment whose rest is tested
_MIN_REMNANT_SCORE = 0.7  # the rest changed as well if its mean score is at least this
_MAX_COLOUR_DISTANCE = 0.05  # largest distance in [0, 1] to changed colours of the segment that gives a score of 1
_NEW_WEIGHT = 0.5  # score per new fraction of the other capture's segment


def label_shells(captures: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """For each capture return the (N,) floor, ceiling or wall of each Gaussian, -1 for none; the numbers are common to
    all captures.

    Gaussians off surfaces get the label of the nearest Gaussian on a surface. z must be up: in frames that are not
    upright no shell is found.

    Args:
        captures: for each capture, points (N, 3) and a mask (N,) of the points on surfaces.
    """
    surface = np.concatenate([points[shows] for points, shows in captures]).astype(np.float64)
    label, counts = cell_labels(np.floor(surface / _CELL_M))
    means = group_means(surface, label, counts)
    plane = planes(means, normals_of(means), _CELL_M)
    out, first = [], 0
    for points, shows in captures:
        found = np.full(len(points), -1, dtype=np.int64)
        last = first + int(shows.sum())
        found[shows] = plane[label[first:last]]
        if len(means) and not shows.all():
            found[~shows] = plane[nearest_of(means, points[~shows])[1]]
        out.append(found)
        first = last
    return out


def label_segments(points: np.ndarray, shell: np.ndarray) -> np.ndarray:
    """Return the (N,) int64 labels, from 0, of connected segments off floors, ceilings and walls; -1 on floors,
    ceilings and walls."""
    out = np.full(len(points), -1, dtype=np.int64)
    loose = np.flatnonzero(shell < 0)
    out[loose] = components(points[loose], _SEGMENT_LINK_M)
    return out


def adjoins_shell(points: np.ndarray, shell: np.ndarray) -> np.ndarray:
    """Return an (N,) mask of points adjacent to the shell without being part of it, such as frames of doors and
    windows."""
    return (shell < 0) & ~is_clear(points, points[shell >= 0], _NEAR_SHELL_M)


@dataclass(frozen=True, eq=False)
class ChangeLabels:
    """Labels of the N Gaussians of a capture before changes are propagated over segments.

    Args:
        points: (N, 3) positions.
        shell: (N,) see `label_shells`.
        segment: (N,) see `label_segments`.
        changed: (N,) mask of Gaussians that are gone or repainted by their own evidence.
        sure: (N,) mask of Gaussians that changed beyond doubt.
        judged: (N,) mask of Gaussians that the other capture observed.
        hidden: (N,) mask of Gaussians that are occluded in the other capture.
        differs: (N,) difference of colour, relative to the smallest that counts.
        framed: (N,) mask, see `adjoins_shell`.
    """

    points: np.ndarray
    shell: np.ndarray
    segment: np.ndarray
    changed: np.ndarray
    sure: np.ndarray
    judged: np.ndarray
    hidden: np.ndarray
    differs: np.ndarray
    framed: np.ndarray


def find_rooted(labels: ChangeLabels) -> np.ndarray:
    """Return an (N,) mask of members of connected changes (on one shell plane, or off all planes) with enough roots.

    Light that a new colour reflects onto the next wall has no roots, and misaligned edges have none either. Isolated
    Gaussians that changed beyond doubt join a nearby change.
    """
    rows = np.flatnonzero(labels.changed)
    label = components(labels.points[rows], _CHANGE_LINK_M, labels.shell[rows])
    size = np.bincount(label)
    roots = np.bincount(label, labels.sure[rows])
    out = np.zeros(len(labels.changed), dtype=bool)
    out[rows] = ((roots >= MIN_ROOTS) & (roots >= MIN_ROOT_FRACTION * size))[label]
    isolated = (labels.changed & labels.sure) | (labels.differs >= _ISOLATED_COLOUR)
    beyond, found = np.flatnonzero(isolated & ~out), np.flatnonzero(out)
    while len(beyond) and len(found):
        near = nearest_of(labels.points[found], labels.points[beyond], _ADJACENT_M)[0]
        found, beyond = beyond[np.isfinite(near)], beyond[np.isinf(near)]
        out[found] = True
    return out


def spread_changes(labels: ChangeLabels) -> np.ndarray:
    """Return an (N,) mask of the changed Gaussians and of the Gaussians to which the change spreads.

    If much of a segment changed, the change spreads to connected Gaussians that differ slightly, and to Gaussians for
    which most neighbours on the segment changed. It does not spread to frames of doors and windows outside of the
    changed hull.
    """
    segment, loose = labels.segment, np.flatnonzero(labels.segment >= 0)
    count = int(segment.max(initial=-1)) + 1
    out = labels.changed.copy()
    for wall in np.unique(labels.shell[out & labels.judged & (labels.shell >= 0)]):
        on, hidden = labels.judged & (labels.shell == wall), labels.hidden & (labels.shell == wall)
        if out[on].mean() >= _MIN_CHANGED_FRACTION:
            out[_with_changed_majority(labels, on, hidden & ~out, out, _ADJACENT_M)] = True
    if not count:
        return out
    judged = np.bincount(segment[loose], labels.judged[loose], count)
    changed = np.bincount(segment[loose], labels.changed[loose], count)
    much = (changed >= _MIN_CHANGED_FRACTION * judged) & (changed >= MIN_ROOTS)
    of_these = loose[much[segment[loose]]]
    weak = of_these[labels.changed[of_these] | (labels.differs[of_these] >= _WEAK_COLOUR)]
    label = components(labels.points[weak], _CHANGE_LINK_M, segment[weak])
    spreads = np.bincount(label, labels.changed[weak]) >= _MIN_CHANGED_FRACTION * np.bincount(label)
    out[weak[spreads[label]]] = True
    mine = np.zeros(len(out), dtype=bool)
    mine[of_these] = True
    out[_with_changed_majority(labels, mine & labels.judged, mine & ~labels.judged & ~out, out, _NEIGHBOUR_M)] = True
    out[_with_changed_majority(labels, mine, mine & ~out, out, _NEIGHBOUR_M)] = True
    frames = np.flatnonzero(out & ~labels.changed & labels.framed)
    for k in np.unique(segment[frames]):
        rows = frames[segment[frames] == k]
        changed = labels.points[labels.changed & (segment == k)]
        out[rows[~in_hull(labels.points[rows], changed)]] = False
    return out


@dataclass(frozen=True, eq=False)
class SegmentedCapture:
    """A capture of a pair, after `spread_changes`.

    Args:
        points, colours: (N, 3) positions, and (N, 3) colours in [0, 1].
        segment: (N,) see `label_segments`.
        changed: (N,) mask of changed Gaussians.
        framed: (N,) mask, see `adjoins_shell`.
    """

    points: np.ndarray
    colours: np.ndarray
    segment: np.ndarray
    changed: np.ndarray
    framed: np.ndarray

    def share(self) -> np.ndarray:
        """Return the (N,) changed fraction of each Gaussian's segment; 0 without a segment."""
        out, loose = np.zeros(len(self.points)), np.flatnonzero(self.segment >= 0)
        of = self.segment[loose]
        out[loose] = (np.bincount(of, self.changed[loose]) / np.maximum(np.bincount(of), 1))[of]
        return out


def find_remnants(sides: tuple[SegmentedCapture, SegmentedCapture]) -> list[np.ndarray]:
    """For each of two captures return an (N,) mask of unchanged remnants that belong to a mostly changed segment.

    For example, a sofa that was shifted by half its length shows its own colour where its old and new places overlap.
    Touching objects form one segment, so a remnant may also be an adjacent object that stayed. Colours, and the other
    capture's surface at the place, decide.
    """
    shares = [side.share() for side in sides]
    found = []
    for one, other, share, new in zip(sides, sides[::-1], shares, shares[::-1], strict=True):
        out = np.zeros(len(one.points), dtype=bool)
        found.append(out)
        segment = one.segment
        left = np.flatnonzero((segment >= 0) & ~one.changed & (share >= _MIN_REMNANT_FRACTION))
        if not len(left) or not len(other.points):
            continue
        nearest = nearest_of(other.points, one.points[left])[1]
        stays = np.zeros(len(left), dtype=bool)
        for k in np.unique(segment[left[one.framed[left]]]):
            # The remnant of a shifted object lies between the changed parts in both captures.
            beside = np.unique(other.segment[nearest[segment[left] == k]])
            theirs = other.points[other.changed & np.isin(other.segment, beside[beside >= 0])]
            changed = np.concatenate([one.points[one.changed & (segment == k)], theirs])
            rows = np.flatnonzero((segment[left] == k) & one.framed[left])
            stays[rows] = ~in_hull(one.points[left[rows]], changed)
        score = _NEW_WEIGHT * new[nearest]
        for k in np.unique(segment[left]):
            changed, rows = one.colours[one.changed & (segment == k)], np.flatnonzero(segment[left] == k)
            if len(changed) >= max(_VOTERS, MIN_ROOTS):
                score[rows] += cKDTree(changed).query(one.colours[left[rows]], _VOTERS)[0][:, -1] < _MAX_COLOUR_DISTANCE
        label = components(one.points[left], _SEGMENT_LINK_M, segment[left])
        goes = (np.bincount(label, score) >= _MIN_REMNANT_SCORE * np.bincount(label))[label]
        out[left[goes & ~stays]] = True
    return found


def in_hull(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return an (N,) mask of points (N, 3) inside the convex hull of others (M, 3), or at most `MAX_OUTSIDE_HULL_M`
    outside."""
    if len(others) < _FEWEST or not len(points):
        return np.zeros(len(points), dtype=bool)
    planes = ConvexHull(others.astype(np.float64), qhull_options="QJ").equations
    out: np.ndarray = (points @ planes[:, :3].T + planes[:, 3]).max(1) <= MAX_OUTSIDE_HULL_M
    return out


def is_clear(points: np.ndarray, others: np.ndarray, reach_m: float) -> np.ndarray:
    """Return an (N,) mask of points (N, 3) that have none of the others (M, 3) within reach."""
    if not len(points) or not len(others):
        return np.ones(len(points), dtype=bool)
    return np.isinf(nearest_of(others, points, reach_m)[0])


def _with_changed_majority(
    labels: ChangeLabels, judged: np.ndarray, others: np.ndarray, changed: np.ndarray, reach_m: float
) -> np.ndarray:
    """Return the rows in the mask ``others`` for which most judged neighbours changed. All masks are (N,).

    These are, for example, the occluded inside of a replaced object, or the rest of a painted wall.
    """
    voters, rows = np.flatnonzero(judged), np.flatnonzero(others)
    if not len(voters) or not len(rows):
        return rows[:0]
    count = min(_VOTERS, len(voters))
    near = neighbours_of(labels.points[voters], labels.points[rows], count, reach_m)[1]
    votes = np.append(np.where(changed[voters], 1, -1), 0)
    return rows[votes[near].sum(1) > 0]
