"""What belongs together changes together: evidence of single Gaussians, weighed over the things that they make up.

Evidence of one Gaussian and its neighbours errs both ways. Thin things, edges and light make a few Gaussians look
changed on what is as it was; and of a thing that another of its kind stands in place of, most Gaussians lie on the new
surface in nearly its colour. Both are told by more than a neighbourhood: a change has its roots in what is beyond
doubt, and of a thing much of which changed, what differs a little did so too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from gsmap.compare.components import components
from gsmap.compare.structure import normals_of, planes
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.neighbours import nearest_of, neighbours_of

_CELL_M = 0.05  # of the surface in which planes are looked for
_FEWEST = 5  # points that have a hull
_ASKED = 5  # of the nearest that were judged
_CHANGE_LINK_M = 0.1  # changed Gaussians this near on one shell plane, or off all planes, are one change
MIN_ROOTS, MIN_ROOT_FRACTION = 8, 0.2  # Gaussians beyond doubt, and their fraction, that prove a change
_ISOLATED_COLOUR = 4.0  # times the least difference of colour, that counts beside a change without neighbours
_ADJACENT_M = 0.35  # largest distance from a proven change at which such a Gaussian joins it
_SEGMENT_LINK_M = 0.08  # Gaussians this near are of one segment
_MIN_CHANGED_FRACTION = 0.2  # of a segment, from which on the change spreads over it
_WEAK_COLOUR = 0.2  # times the least difference of colour, that counts there
_NEIGHBOUR_M = 0.15  # within which most neighbours on the segment must have changed
_NEAR_SHELL_M = 0.1  # what is this near to the shell may be a frame or skirting board of it
MAX_OUTSIDE_HULL_M = 0.05  # such a part joins a segment's change only this far outside of the hull of that
_MIN_REMNANT_FRACTION = 0.5  # of a segment that must have changed for the rest to be tested
_MIN_REMNANT_SCORE = 0.7  # mean score from which on the rest changed, too
_MAX_COLOUR_DISTANCE = 0.05  # in [0, 1], to the colours that changed on the segment, for a score of 1
_NEW_WEIGHT = 0.5  # score for the fraction that is new of the other capture's segment


def shells(captures: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Of captures, each (N, 3) points and (N,) bool which are part of a surface: (N,) the floor, ceiling or wall that
    each Gaussian is part of, -1 for none; the same numbers in all. What is no surface goes with the nearest that is.
    z is up: in a frame that is not upright there are none, and all is one thing or another."""
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


def things(points: np.ndarray, shell: np.ndarray) -> np.ndarray:
    """(N,) int64 what hangs together off floors, ceilings and walls, from 0; -1 for what is on these."""
    out = np.full(len(points), -1, dtype=np.int64)
    loose = np.flatnonzero(shell < 0)
    out[loose] = components(points[loose], _SEGMENT_LINK_M)
    return out


def by_shell(points: np.ndarray, shell: np.ndarray) -> np.ndarray:
    """(N,) bool, what lies by a floor, ceiling or wall without being part of it, as frames of doors and windows do."""
    return (shell < 0) & ~clear(points, points[shell >= 0], _NEAR_SHELL_M)


@dataclass(frozen=True, eq=False)
class Doubts:
    """What is known of each of N Gaussians of a capture before things are weighed.

    Args:
        points: (N, 3).
        shell: (N,) see `shells`.
        thing: (N,) see `things`.
        changed: (N,) bool, taken for gone or repainted.
        sure: (N,) bool, those of them that are beyond doubt.
        judged: (N,) bool, seen by the other capture.
        hidden: (N,) bool, behind what the other capture shows.
        differs: (N,) of the colour, as a multiple of what counts.
        framed: (N,) bool, see `by_shell`.
    """

    points: np.ndarray
    shell: np.ndarray
    thing: np.ndarray
    changed: np.ndarray
    sure: np.ndarray
    judged: np.ndarray
    hidden: np.ndarray
    differs: np.ndarray
    framed: np.ndarray


def rooted(doubts: Doubts) -> np.ndarray:
    """(N,) bool, what belongs to a change, on one wall or on none, that has roots: enough of it is beyond doubt.

    Light that a new colour throws on the next wall has none, nor has what is off at an edge. A change ends a few
    Gaussians beyond what was taken for its wall, loose ones stand about it, and where they are large they have no
    neighbours to ask: what is beyond doubt alone needs to be near.
    """
    rows = np.flatnonzero(doubts.changed)
    label = components(doubts.points[rows], _CHANGE_LINK_M, doubts.shell[rows])
    size = np.bincount(label)
    roots = np.bincount(label, doubts.sure[rows])
    out = np.zeros(len(doubts.changed), dtype=bool)
    out[rows] = ((roots >= MIN_ROOTS) & (roots >= MIN_ROOT_FRACTION * size))[label]
    alone = (doubts.changed & doubts.sure) | (doubts.differs >= _ISOLATED_COLOUR)
    beyond, found = np.flatnonzero(alone & ~out), np.flatnonzero(out)
    while len(beyond) and len(found):
        near = nearest_of(doubts.points[found], doubts.points[beyond], _ADJACENT_M)[0]
        found, beyond = beyond[np.isfinite(near)], beyond[np.isinf(near)]
        out[found] = True
    return out


def kin(doubts: Doubts) -> np.ndarray:
    """(N,) bool, the changed and what changed with them: of things much of which changed, what differs a little and is
    tied to what changed, and what most of those about it on the thing did. A door's frame hangs together with what
    stands before it, and does not go along."""
    thing, loose = doubts.thing, np.flatnonzero(doubts.thing >= 0)
    count = int(thing.max(initial=-1)) + 1
    out = doubts.changed.copy()
    for wall in np.unique(doubts.shell[out & doubts.judged & (doubts.shell >= 0)]):
        on, hidden = doubts.judged & (doubts.shell == wall), doubts.hidden & (doubts.shell == wall)
        if out[on].mean() >= _MIN_CHANGED_FRACTION:
            out[_with_most(doubts, on, hidden & ~out, out, _ADJACENT_M)] = True
    if not count:
        return out
    judged = np.bincount(thing[loose], doubts.judged[loose], count)
    changed = np.bincount(thing[loose], doubts.changed[loose], count)
    much = (changed >= _MIN_CHANGED_FRACTION * judged) & (changed >= MIN_ROOTS)
    of_these = loose[much[thing[loose]]]
    weak = of_these[doubts.changed[of_these] | (doubts.differs[of_these] >= _WEAK_COLOUR)]
    label = components(doubts.points[weak], _CHANGE_LINK_M, thing[weak])
    tied = np.bincount(label, doubts.changed[weak]) >= _MIN_CHANGED_FRACTION * np.bincount(label)
    out[weak[tied[label]]] = True
    mine = np.zeros(len(out), dtype=bool)
    mine[of_these] = True
    out[_with_most(doubts, mine & doubts.judged, mine & ~doubts.judged & ~out, out, _NEIGHBOUR_M)] = True
    out[_with_most(doubts, mine, mine & ~out, out, _NEIGHBOUR_M)] = True
    asked = np.flatnonzero(out & ~doubts.changed & doubts.framed)
    for k in np.unique(thing[asked]):
        rows = asked[thing[asked] == k]
        changed = doubts.points[doubts.changed & (thing == k)]
        out[rows[~between(doubts.points[rows], changed, MAX_OUTSIDE_HULL_M)]] = False
    return out


@dataclass(frozen=True, eq=False)
class Side:
    """One of two captures, after `kin`.

    Args:
        points, colours: (N, 3), colours in [0, 1].
        thing: (N,) see `things`.
        changed: (N,) bool.
        framed: (N,) bool, see `by_shell`.
    """

    points: np.ndarray
    colours: np.ndarray
    thing: np.ndarray
    changed: np.ndarray
    framed: np.ndarray

    def share(self) -> np.ndarray:
        """(N,) of the thing of each Gaussian the share that changed; 0 for what is part of none."""
        out, loose = np.zeros(len(self.points)), np.flatnonzero(self.thing >= 0)
        of = self.thing[loose]
        out[loose] = (np.bincount(of, self.changed[loose]) / np.maximum(np.bincount(of), 1))[of]
        return out


def remnants(sides: tuple[Side, Side]) -> list[np.ndarray]:
    """Of each of two captures (N,) bool, what is left of things most of which changed and belongs to them: a sofa that
    was pushed along by half its length still shows itself, in its own colour, where its halves meet.

    Things that touch are one thing here, so that what is left may as well be another that stood beside and stayed: that
    is told by colours, and by what the other capture shows in its place.
    """
    shares = [side.share() for side in sides]
    found = []
    for one, other, share, new in zip(sides, sides[::-1], shares, shares[::-1], strict=True):
        out = np.zeros(len(one.points), dtype=bool)
        found.append(out)
        thing = one.thing
        left = np.flatnonzero((thing >= 0) & ~one.changed & (share >= _MIN_REMNANT_FRACTION))
        if not len(left) or not len(other.points):
            continue
        nearest = nearest_of(other.points, one.points[left])[1]
        stays = np.zeros(len(left), dtype=bool)
        for k in np.unique(thing[left[one.framed[left]]]):
            # What was pushed along shows itself between what changed in both captures.
            beside = np.unique(other.thing[nearest[thing[left] == k]])
            theirs = other.points[other.changed & np.isin(other.thing, beside[beside >= 0])]
            changed = np.concatenate([one.points[one.changed & (thing == k)], theirs])
            rows = np.flatnonzero((thing[left] == k) & one.framed[left])
            stays[rows] = ~between(one.points[left[rows]], changed, MAX_OUTSIDE_HULL_M)
        score = _NEW_WEIGHT * new[nearest]
        for k in np.unique(thing[left]):
            changed, rows = one.colours[one.changed & (thing == k)], np.flatnonzero(thing[left] == k)
            if len(changed) >= max(_ASKED, MIN_ROOTS):
                score[rows] += cKDTree(changed).query(one.colours[left[rows]], _ASKED)[0][:, -1] < _MAX_COLOUR_DISTANCE
        label = components(one.points[left], _SEGMENT_LINK_M, thing[left])
        goes = (np.bincount(label, score) >= _MIN_REMNANT_SCORE * np.bincount(label))[label]
        out[left[goes & ~stays]] = True
    return found


def between(points: np.ndarray, others: np.ndarray, beyond_m: float) -> np.ndarray:
    """(N,) bool, which points (N, 3) lie in the convex hull of others (M, 3), or at most so far beyond its planes."""
    if len(others) < _FEWEST or not len(points):
        return np.zeros(len(points), dtype=bool)
    planes = ConvexHull(others.astype(np.float64), qhull_options="QJ").equations
    out: np.ndarray = (points @ planes[:, :3].T + planes[:, 3]).max(1) <= beyond_m
    return out


def clear(points: np.ndarray, others: np.ndarray, reach_m: float) -> np.ndarray:
    """(N,) bool, which points (N, 3) have none of the others (M, 3) within reach."""
    if not len(points) or not len(others):
        return np.ones(len(points), dtype=bool)
    return np.isinf(nearest_of(others, points, reach_m)[0])


def _with_most(
    doubts: Doubts, judged: np.ndarray, others: np.ndarray, changed: np.ndarray, reach_m: float
) -> np.ndarray:
    """Rows of others where most that was judged about them has changed: the inside of what was replaced, which nobody
    judged as something new hides it, the rest of a painted wall. All masks are (N,)."""
    asked, rows = np.flatnonzero(judged), np.flatnonzero(others)
    if not len(asked) or not len(rows):
        return rows[:0]
    count = min(_ASKED, len(asked))
    near = neighbours_of(doubts.points[asked], doubts.points[rows], count, reach_m)[1]
    known = np.append(np.where(changed[asked], 1, -1), 0)
    return rows[known[near].sum(1) > 0]
