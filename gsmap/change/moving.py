"""Things that went from one place and came to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from gsmap._native import FeatureTree
from gsmap.change.params import Params
from gsmap.change.poses import about_up, features, settled, voted
from gsmap.change.sides import Side
from gsmap.change.things import Cells, Thing, joined, parts
from gsmap.compare import Looks
from gsmap.compare.components import components
from gsmap.compare.looks import place
from gsmap.types import Sim3

_YAW_STARTS = 24  # turns about the vertical from which a moved segment is looked for
_MAX_OFFSET_M = 0.05  # of a moved segment from the surface where it stands
_MAX_RIVAL_SCORE = 0.875  # relative to the best; a better rival makes a move ambiguous, unless by symmetry
_ALIKE = 0.12  # tints that differ by less may be one thing's
_DARKER = 0.12  # and a thing may be that much lighter or darker elsewhere
_FEWEST = 30  # cells with which a thing can be told from others
_COARSE, _FINE, _JUDGED = 80, 300, 250  # cells that are laid on others, and that are asked whether they fit
_TRIED, _KEPT = 10, 3  # poses that are looked at, and that are followed to the end
_AS_GOOD = 0.92  # a pose that scores this share of the best is not told from it
_LEAST_M = 0.08  # a thing that was moved by less, and not turned, was not moved
_LEAST_LEFT = 0.14  # nor one of which so small a share was looked through, before and after together
_APART_M = 0.15  # the middle of a symmetric thing stays this near
_BESIDE_M = 0.5  # how far beyond a moved thing more of it is looked for
_TAKES_M = 0.1  # what lies so close to where a thing moved is a part of it
_ABOUT_M = 0.3  # around the place where a thing stood
_PIECES_M = 0.4  # pieces so close to each other that went the same way are one thing's
_ROUNDS = 2
_NUDGES = (-0.5, -0.25, 0.0, 0.25, 0.5)  # radians, for what was turned where it stands
_PANEL_M = 0.15, 1.0  # what is thinner and higher is a door: it opens and shuts


@dataclass(frozen=True, eq=False)
class Move:
    """Where a thing went.

    Args:
        older, newer: what the captures show of it.
        S_after_before: from where it stood to where it stands.
        score: share of it that fits, there and back, in [0, 1].
        runner_up: the score of the best pose that is another.
        symmetry: turn about the vertical that fits as well.
    """

    older: Thing
    newer: Thing
    S_after_before: Sim3
    score: float
    runner_up: float
    symmetry: Literal["none", "half", "any"]


@dataclass(eq=False)
class _Capture:
    """One capture, and what of its things has not been found elsewhere yet."""

    side: Side
    cells: Cells
    looks: Looks
    things: list[Thing]
    tree: FeatureTree

    @classmethod
    def of(cls, side: Side, cells: Cells, looks: Looks, things: Sequence[Thing]) -> _Capture:
        loose = np.flatnonzero(cells.plane < 0)
        return cls(side, cells, looks, list(things), FeatureTree(_features(side, loose)))

    def points(self, thing: Thing) -> np.ndarray:
        return self.side.points[thing.cells]


def _features(side: Side, rows: np.ndarray) -> np.ndarray:
    return features(side.points[rows], side.colours[rows])


def find_moves(
    older: Sequence[Thing],
    newer: Sequence[Thing],
    sides: tuple[Side, Side],
    cells: tuple[Cells, Cells],
    looks: tuple[Looks, Looks],
    params: Params,
) -> tuple[list[Move], list[Thing], list[Thing]]:
    """The things of the older capture that stand elsewhere in the newer one, and what is left of both lists."""
    a = _Capture.of(sides[0], cells[0], looks[0], older)
    b = _Capture.of(sides[1], cells[1], looks[1], newer)
    moves: list[Move] = []
    asked: set[bytes] = set()
    for _ in range(_ROUNDS):
        found = _moves_from(a, b, False, asked, params) + _moves_from(b, a, True, asked, params)
        news: list[Move] = []
        for move in sorted(found, key=lambda m: -m.score):
            if not any(_overlap(move, other, a, b) for other in moves + news):
                whole = _completed(move, a, b)
                if _is_panel(a.points(whole.older)) or _is_panel(b.points(whole.newer)) or _stays(whole):
                    continue
                news.append(whole)
                a.things, b.things = _without(a.things, news[-1].older), _without(b.things, news[-1].newer)
        if not news:
            break
        moves += news
    return _united(moves, a, b), a.things, b.things


def _moves_from(here: _Capture, there: _Capture, back: bool, asked: set[bytes], params: Params) -> list[Move]:
    """The moves of each thing of one capture, but those ``asked`` before; ``back`` where it is the newer."""
    found = []
    for seed in _seeds(here):
        name = bytes([back]) + seed.cells.tobytes()
        if name not in asked:
            asked.add(name)
            move = _moved(seed, here, there, back, params)
            found += [move] if move is not None else []
    return found


def _stays(move: Move) -> bool:
    """Whether too little of a thing was looked through for it to have gone from one place to another: things of one
    shape and colour that take each other's place look as if they had been turned."""
    moved = len(move.older.moved) + len(move.newer.moved)
    return moved < _LEAST_LEFT * (len(move.older.cells) + len(move.newer.cells))


def _overlap(move: Move, other: Move, a: _Capture, b: _Capture) -> bool:
    """Whether a move is of a thing of which another move, of another kind, has been found."""
    same = not _differ(move.S_after_before, other.S_after_before, a.points(move.older))
    for capture, mine, theirs in ((a, move.older, other.older), (b, move.newer, other.newer)):
        if len(np.intersect1d(mine.cells, theirs.cells)) > 0.3 * min(len(mine.cells), len(theirs.cells)):
            return True
        near = cKDTree(capture.points(theirs)).query(capture.points(mine), distance_upper_bound=_TAKES_M)[0]
        if not same and np.isfinite(near).mean() > 0.5:
            return True
    return False


def _united(moves: list[Move], a: _Capture, b: _Capture) -> list[Move]:
    """Moves, of which those of neighbouring pieces that went the same way are one."""
    kept: list[Move] = []
    for move in sorted(moves, key=lambda m: -len(m.older.cells) - len(m.newer.cells)):
        points = a.points(move.older)
        for k, other in enumerate(kept):
            apart = cKDTree(a.points(other.older)).query(points)[0].min()
            if apart < _PIECES_M and not _differ(move.S_after_before, other.S_after_before, points):
                older, newer = joined(other.older, move.older), joined(other.newer, move.newer)
                kept[k] = replace(other, older=older, newer=newer)
                break
        else:
            kept.append(move)
    return kept


def _completed(move: Move, a: _Capture, b: _Capture) -> Move:
    """The move with all that went along: cells beside it that fit by it, whether or not they seemed to have changed."""
    S = move.S_after_before
    older = _with_more(move.older, a, b, S)
    newer = _with_more(move.newer, b, a, S.inverse())
    return replace(move, older=older, newer=newer)


def _with_more(thing: Thing, here: _Capture, there: _Capture, pose: Sim3) -> Thing:
    side, cells = here.side, here.cells
    points = here.points(thing)
    low, high = points.min(0) - _BESIDE_M, points.max(0) + _BESIDE_M
    rows = np.flatnonzero(
        np.isin(cells.thing, np.unique(cells.thing[thing.cells])) & ((side.points > low) & (side.points < high)).all(1)
    )
    _, alike = _fits(rows, pose.apply(side.points[rows]), side, there.side)
    rows = rows[alike]
    if not len(rows):
        return thing
    # What does not fit, and lies by nothing that does, belongs to something else.
    fits = np.isfinite(cKDTree(side.points[rows]).query(points, distance_upper_bound=_TAKES_M)[0])
    thing, _ = parts(thing, thing.cells[fits])
    # Only what hangs together with the rest of it.
    every = np.union1d(rows, thing.cells)
    labels = components(side.points[every], _TAKES_M)
    mine = np.unique(labels[np.isin(every, thing.cells)])
    every = every[np.isin(labels, mine)]
    near = cKDTree(side.points[every])
    moved, painted = thing.moved, thing.painted
    for other in here.things:
        inside = other.cells[np.isfinite(near.query(side.points[other.cells], distance_upper_bound=0.06)[0])]
        every = np.union1d(every, inside)
        moved = np.union1d(moved, np.intersect1d(other.moved, inside))
        painted = np.union1d(painted, np.intersect1d(other.painted, inside))
    return replace(thing, cells=every, moved=moved, painted=painted)


def _without(things: list[Thing], gone: Thing) -> list[Thing]:
    """Things without the cells of one."""
    left = []
    for thing in things:
        _, rest = parts(thing, gone.cells)
        if len(rest.cells) == len(thing.cells) or len(rest.changed) >= _FEWEST:
            left.append(rest)
    return left


def _seeds(capture: _Capture) -> list[Thing]:
    """Things that may have moved: those that one could look through in part; and of some only that part."""
    seeds = []
    for thing in capture.things:
        if len(thing.moved) < 8 or len(thing.cells) < _FEWEST or _is_panel(capture.points(thing)):
            continue
        seeds.append(thing)
        core = Thing(thing.moved, thing.moved, thing.moved[:0])
        if 2 * _FEWEST <= len(thing.moved) < 0.8 * len(thing.cells):
            seeds.append(core)
    return seeds


def _is_panel(points: np.ndarray) -> bool:
    """Whether a thing is high and thin, as a door."""
    xy = points[:, :2] - points[:, :2].mean(0)
    thin = xy @ np.linalg.eigh(xy.T @ xy)[1][:, 0]
    return bool(np.ptp(np.quantile(thin, (0.05, 0.95))) < _PANEL_M[0] and np.ptp(points[:, 2]) > _PANEL_M[1])


def _moved(seed: Thing, here: _Capture, there: _Capture, back: bool, params: Params) -> Move | None:
    if not there.things:
        return None
    points = here.points(seed)
    onto = _targets(there, points)
    whole = _features(here.side, seed.cells)
    coarse, fine = (whole[:: max(1, len(whole) // count)] for count in (_COARSE, _FINE))
    tried = voted(
        points,
        here.side.colours[seed.cells],
        there.side.points[onto],
        there.side.colours[onto],
        _YAW_STARTS,
    )
    starts = [pose for _, pose in tried[:_TRIED]]
    # Pushed or turned a little: most votes are then for what did not change.
    middle = points.mean(0)
    starts += [Sim3(about_up(yaw), middle - about_up(yaw) @ middle) for yaw in _NUDGES]
    hopes = []
    for pose in starts:
        laid = settled(coarse, there.tree, pose, (0.2, 0.15, 0.12, 0.1))
        hopes.append((_near(coarse, there.tree, laid), laid))
    kept: list[Sim3] = []
    for _, pose in sorted(hopes, key=lambda h: -h[0]):
        if len(kept) < _KEPT and all(_differ(pose, other, points) for other in kept):
            kept.append(pose)
    best: tuple[float, Sim3, Thing, Thing] | None = None
    scores = []
    for start in kept:
        pose = settled(fine, there.tree, start, (0.12, 0.1, 0.1, 0.08, 0.08, 0.06, 0.06, 0.05, 0.05))
        if np.linalg.norm(pose.apply(points) - points, axis=1).mean() < _LEAST_M:
            continue
        theirs = _covered(there, points, pose)
        if theirs is None:
            continue
        mine = joined(seed, _covered(here, there.points(theirs), pose.inverse(), whole=2.0) or seed)
        score = _score(mine, theirs, here, there, pose)
        scores.append((score, pose))
        if best is None or score > best[0]:
            best = score, pose, mine, theirs
    if best is None:
        return None
    score, pose, mine, theirs = best
    polished = settled(fine, there.tree, pose, (0.06,) * 10)
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
        return Move(theirs, mine, pose.inverse(), score, runner_up, symmetry)
    return Move(mine, theirs, pose, score, runner_up, symmetry)


def _targets(there: _Capture, points: np.ndarray) -> np.ndarray:
    """Cells that a thing's may have become: what changed, and what stands where it stood."""
    changed = np.concatenate([t.cells for t in there.things])
    side = there.side
    low, high = points.min(0) - _ABOUT_M, points.max(0) + _ABOUT_M
    beside = np.flatnonzero((there.cells.plane < 0) & ((side.points > low) & (side.points < high)).all(1))
    out: np.ndarray = np.union1d(changed, beside)
    return out


def _near(moving: np.ndarray, tree: FeatureTree, pose: Sim3) -> float:
    """How close cells come to cells of their colour, in [0, 1]."""
    moved = np.concatenate([pose.apply(moving[:, :3]), moving[:, 3:]], axis=1)
    return float((1 - np.minimum(tree.distances(moved, 0.1), 0.1) / 0.1).mean())


def _differ(a: Sim3, b: Sim3, points: np.ndarray) -> bool:
    """Whether two poses put points elsewhere, or another way round."""
    few = points[:: max(1, len(points) // 50)]
    return bool(np.linalg.norm(a.apply(few) - b.apply(few), axis=1).mean() > 0.15)


def _covered(capture: _Capture, points: np.ndarray, pose: Sim3, whole: float = 0.5) -> Thing | None:
    """What of a capture's things lies where points come to lie: things as a whole, of which this share does."""
    tree = cKDTree(pose.apply(points))
    taken = []
    for thing in capture.things:
        near = np.isfinite(tree.query(capture.points(thing), distance_upper_bound=_TAKES_M)[0])
        if near.mean() >= whole:
            taken.append(thing)
        elif near.sum() >= _FEWEST:
            taken.append(parts(thing, thing.cells[near])[0])
    return reduce(joined, taken) if taken else None


def _score(mine: Thing, theirs: Thing, here: _Capture, there: _Capture, pose: Sim3) -> float:
    """Share of the cells that fit where the other capture could see them: the worse way of the two."""
    out = _agreement(mine, here, there, pose)
    return min(out, _agreement(theirs, there, here, pose.inverse())) if out > 0 else 0.0


def _agreement(thing: Thing, here: _Capture, there: _Capture, pose: Sim3) -> float:
    rows = thing.cells[:: max(1, len(thing.cells) // _JUDGED)]
    moved = pose.apply(here.side.points[rows])
    on, alike = _fits(rows, moved, here.side, there.side)
    through = ~on
    through[~on] = _looked_through(moved[~on], there.looks)
    seen = int((on | through).sum())
    if seen < min(0.7 * _FEWEST, 0.3 * len(rows)):
        return 0.0
    return float(alike.sum() / seen)


def _fits(rows: np.ndarray, moved: np.ndarray, side: Side, other: Side) -> tuple[np.ndarray, np.ndarray]:
    """Which cells, where they have moved to (N, 3), lie on the other capture's surface, and which on their colour."""
    distance, near = other.tree.query(moved, k=4, distance_upper_bound=1.5 * _MAX_OFFSET_M)
    on = np.isfinite(distance[:, 0])
    theirs = other.tints[np.minimum(near, len(other) - 1)]
    apart = theirs - side.tints[rows][:, None]
    if on.sum() >= _FEWEST:  # Where it stands now it may be lighter or darker.
        apart[..., 0] -= np.clip(np.median(apart[on, 0, 0]), -_DARKER, _DARKER)
    unlike = np.where(np.isfinite(distance), np.linalg.norm(apart, axis=2), np.inf).min(1)
    return on, on & (unlike < _ALIKE)


def _looked_through(points: np.ndarray, looks: Looks) -> np.ndarray:
    """(N,) bool, where a capture's own pictures show what lies behind."""
    count = np.zeros(len(points), dtype=np.int64)
    for view, sure in zip(looks.views[::2], looks.sure[::2], strict=True):
        at = place(points, view, 0.2)
        behind = sure[at.row, at.column] & (at.z < view.near[at.row, at.column] - 0.06)
        count[at.index[behind]] += 1
    return count >= 1


def _symmetry(
    mine: Thing, theirs: Thing, here: _Capture, there: _Capture, pose: Sim3, score: float
) -> Literal["none", "half", "any"]:
    """Whether the thing, turned about its own middle, fits as well."""
    points = here.points(mine)
    fine = _features(here.side, mine.cells)[:: max(1, len(points) // _FINE)]
    middle = 0.5 * (np.quantile(points, 0.02, axis=0) + np.quantile(points, 0.98, axis=0))
    fits = []
    for turn in (np.pi, np.pi / 3, -np.pi / 2):
        rotation = about_up(turn)
        turned = pose @ Sim3(rotation, middle - rotation @ middle)
        laid = settled(fine, there.tree, turned, (0.12, 0.1, 0.08, 0.06))
        stays = np.linalg.norm(laid.apply(middle) - pose.apply(middle)) < _APART_M
        yaw = np.arctan2(*(laid.rotation @ turned.rotation.T)[[1, 0], 0])
        good = stays and abs(yaw) < 0.3
        fits.append(bool(good and _score(mine, theirs, here, there, laid) >= _AS_GOOD * score))
        if not fits[0]:
            return "none"
    return "any" if all(fits) else "half"
