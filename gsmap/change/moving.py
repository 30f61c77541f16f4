"""Things that went from one place and came to another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.params import Params
from gsmap.change.sides import Side
from gsmap.change.things import Cells, Thing
from gsmap.compare import Looks
from gsmap.compare.looks import place
from gsmap.types import Sim3

_TINT_M = 0.2  # metres that a difference of colour of 1 counts for, where neighbours are looked for
_ALIKE = 0.2  # colours that differ by less may be one thing's in another light
_FEWEST = 30  # cells with which a thing can be told from others
_COARSE, _FINE = 120, 500  # cells that are laid on others
_KEPT = 4  # starts that are followed to the end
_AS_GOOD = 0.92  # a pose that scores this share of the best is not told from it
_ABOUT_M = 0.4  # how far around a thing its unchanged parts are looked for
_RISE_M = 0.3  # a thing that stands less higher or lower stands on the same floor
_LEAST_M = 0.08  # a thing that was moved by less, and not turned, was not moved
_APART_M = 0.15  # the middle of a symmetric thing stays this near


@dataclass(frozen=True, eq=False)
class Move:
    """Where a thing went.

    Args:
        older, newer: places in the lists of things.
        S_after_before: from where it stood to where it stands.
        score: share of it that fits, there and back, in [0, 1].
        runner_up: the score of the best pose that is another.
        symmetry: turn about the vertical that fits as well.
    """

    older: int
    newer: int
    S_after_before: Sim3
    score: float
    runner_up: float
    symmetry: Literal["none", "half", "any"]


@dataclass(frozen=True, eq=False)
class _Body:
    """Cells of a thing with colours, and what there is around it: (K, 3) each."""

    points: np.ndarray
    colours: np.ndarray
    side: Side
    cells: Cells
    looks: Looks

    @property
    def features(self) -> np.ndarray:
        return np.concatenate([self.points, self.colours * _TINT_M], axis=1)

    @cached_property
    def tree(self) -> Any:
        """Of the features of the thing and of what stands about it, the shell of the room left out."""
        low, high = self.points.min(0) - _ABOUT_M, self.points.max(0) + _ABOUT_M
        points = self.side.points
        rows = np.flatnonzero((self.cells.plane < 0) & ((points > low) & (points < high)).all(1))
        return cKDTree(np.concatenate([points[rows], self.side.colours[rows] * _TINT_M], axis=1))


def find_moves(
    older: Sequence[Thing],
    newer: Sequence[Thing],
    sides: tuple[Side, Side],
    cells: tuple[Cells, Cells],
    looks: tuple[Looks, Looks],
    params: Params,
) -> list[Move]:
    """The things of the older capture that stand elsewhere in the newer one, surest first, none taken twice."""
    bodies = [
        [_Body(side.points[t.cells], side.colours[t.cells], side, known, look) for t in things]
        for things, side, known, look in zip((older, newer), sides, cells, looks, strict=True)
    ]
    found = []
    for i, a in enumerate(bodies[0]):
        for j, b in enumerate(bodies[1]):
            if _could_be(a, b):
                move = _moved(i, j, a, b, params)
                if move is not None:
                    found.append(move)
    chosen: list[Move] = []
    for move in sorted(found, key=lambda m: -m.score):
        if all(move.older != other.older and move.newer != other.newer for other in chosen):
            chosen.append(move)
    return chosen


def _could_be(a: _Body, b: _Body) -> bool:
    """Whether two things are of one size and colour, as far as one can see."""
    if min(len(a.points), len(b.points)) < _FEWEST:
        return False
    tall = [float(np.ptp(np.quantile(body.points[:, 2], (0.02, 0.98)))) for body in (a, b)]
    wide = [_width(body.points[:, :2]) for body in (a, b)]
    if abs(tall[0] - tall[1]) > 0.15 + 0.4 * max(tall) or abs(wide[0] - wide[1]) > 0.2 + 0.4 * max(wide):
        return False
    return _common_colours(a.colours, b.colours) > 0.35


def _width(xy: np.ndarray) -> float:
    """The longest extent, from above."""
    _, axes = np.linalg.eigh(np.cov(xy.T) + 1e-9 * np.eye(2))
    along = (xy - xy.mean(0)) @ axes[:, 1]
    return float(np.ptp(np.quantile(along, (0.02, 0.98))))


def _common_colours(a: np.ndarray, b: np.ndarray) -> float:
    """Share of colours, in eight blurred bins a channel, that two things have in common."""
    counts = []
    for colours in (a, b):
        bins = np.clip((colours * 6).astype(np.int64), 0, 5)
        flat = np.bincount((bins[:, 0] * 6 + bins[:, 1]) * 6 + bins[:, 2], minlength=216).reshape(6, 6, 6).astype(float)
        for axis in range(3):
            padded = np.pad(flat, [(1, 1) if k == axis else (0, 0) for k in range(3)])
            flat = flat + 0.5 * (np.delete(padded, [0, 1], axis) + np.delete(padded, [-1, -2], axis))
        counts.append(flat / flat.sum())
    return float(np.minimum(*counts).sum())


def _moved(i: int, j: int, a: _Body, b: _Body, params: Params) -> Move | None:
    """The pose that lays one thing on the other, if it does."""
    starts = [_start(a, b, yaw) for yaw in np.arange(params.yaw_starts) * (2 * np.pi / params.yaw_starts)]
    if np.linalg.norm(a.points.mean(0) - b.points.mean(0)) < 1.0:
        starts.append(Sim3.identity())
    target, coarse = cKDTree(b.features), a.features[:: max(1, len(a.points) // _COARSE)]
    tried = [_laid(coarse, target, start, (0.4, 0.3, 0.2, 0.15)) for start in starts]
    order = np.argsort([-_fit(coarse, target, pose) for pose in tried], kind="stable")
    kept: list[Sim3] = []
    for k in order:
        if len(kept) < _KEPT and all(_differ(tried[k], other, a) for other in kept):
            kept.append(tried[k])
    fine = a.features[:: max(1, len(a.points) // _FINE)]
    poses = [_laid(fine, b.tree, pose, (0.15, 0.12, 0.1, 0.1, 0.08, 0.08, 0.06, 0.06, 0.05, 0.05)) for pose in kept]
    scores = [_score(a, b, pose, params) for pose in poses]
    best = int(np.argmax(scores))
    pose, score = poses[best], scores[best]
    if score < params.min_moved or np.linalg.norm(pose.apply(a.points) - a.points, axis=1).mean() < _LEAST_M:
        return None
    others = [s for s, p in zip(scores, poses, strict=True) if _differ(p, pose, a)]
    symmetry = _symmetry(a, b, pose, score, params)
    return Move(i, j, pose, score, max(others, default=0.0), symmetry)


def _start(a: _Body, b: _Body, yaw: float) -> Sim3:
    """Turned by a yaw, the middle of one on the middle of the other, bottom on bottom."""
    rotation = _about_up(yaw)
    turned = a.points @ rotation.T
    shift = np.zeros(3)
    for axis in range(2):
        low, high = ((np.quantile(p[:, axis], q) for p in (turned, b.points)) for q in (0.03, 0.97))
        shift[axis] = 0.5 * sum(-(x[0] - x[1]) for x in (list(low), list(high)))
    rise = np.quantile(b.points[:, 2], 0.03) - np.quantile(turned[:, 2], 0.03)
    # Most things stay on the floor, of which less may be seen in one of the captures.
    shift[2] = rise if abs(rise) > _RISE_M else 0.0
    return Sim3(rotation, shift)


def _about_up(yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _laid(features: np.ndarray, target: Any, start: Sim3, radii_m: Sequence[float]) -> Sim3:
    """ICP over yaw and translation; neighbours are near in place and colour."""
    pose = start
    for radius in radii_m:
        moved = pose.apply(features[:, :3])
        distance, row = target.query(np.concatenate([moved, features[:, 3:]], axis=1), distance_upper_bound=2 * radius)
        hit = np.isfinite(distance)
        if hit.sum() < 10:
            return pose
        source, onto = features[hit, :3], target.data[row[hit], :3]
        weight = 1 / (1 + (distance[hit] / (0.5 * radius)) ** 2) ** 2
        mean_s, mean_t = (np.average(p, axis=0, weights=weight) for p in (source, onto))
        s, t = source - mean_s, onto - mean_t
        yaw = np.arctan2(
            (weight * (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])).sum(), (weight * (s[:, :2] * t[:, :2]).sum(1)).sum()
        )
        rotation = _about_up(float(yaw))
        pose = Sim3(rotation, mean_t - rotation @ mean_s)
    return pose


def _fit(features: np.ndarray, target: Any, pose: Sim3) -> float:
    moved = np.concatenate([pose.apply(features[:, :3]), features[:, 3:]], axis=1)
    distance, _ = target.query(moved, distance_upper_bound=0.15)
    return float((1 - np.minimum(distance, 0.15) / 0.15).mean())


def _differ(a: Sim3, b: Sim3, body: _Body) -> bool:
    """Whether two poses put a thing elsewhere, or another way round."""
    return bool(np.linalg.norm(a.apply(body.points) - b.apply(body.points), axis=1).mean() > 0.15)


def _score(a: _Body, b: _Body, pose: Sim3, params: Params) -> float:
    """Share of the cells that fit where the other capture could see them: the worse way of the two."""
    there = _agreement(a, b, pose, params)
    back = _agreement(b, a, pose.inverse(), params)
    return min(there, back)


def _agreement(a: _Body, b: _Body, pose: Sim3, params: Params) -> float:
    moved = pose.apply(a.points)
    distance, row = b.side.tree.query(moved, k=4, distance_upper_bound=1.5 * params.moved_within_m)
    on = np.isfinite(distance[:, 0])
    colours = b.side.colours[np.minimum(row, len(b.side) - 1)]
    apart = np.where(np.isfinite(distance), np.linalg.norm(colours - a.colours[:, None], axis=2), np.inf).min(1)
    through = ~on & _looked_through(moved, b.looks)
    seen = on | through
    if seen.sum() < _FEWEST * 0.7:
        return 0.0
    return float((on & (apart < _ALIKE)).sum() / seen.sum())


def _looked_through(points: np.ndarray, looks: Looks) -> np.ndarray:
    """(N,) bool, where a capture's own pictures show what lies behind."""
    count = np.zeros(len(points), dtype=np.int64)
    for view, sure in zip(looks.views, looks.sure, strict=True):
        at = place(points, view, 0.2)
        behind = sure[at.row, at.column] & (at.z < view.near[at.row, at.column] - 0.06)
        count[at.index[behind]] += 1
    return count >= 2


def _symmetry(a: _Body, b: _Body, pose: Sim3, score: float, params: Params) -> Literal["none", "half", "any"]:
    """Whether the thing, turned about its own middle, fits as well."""
    target, fine = b.tree, a.features[:: max(1, len(a.points) // _FINE)]
    middle = 0.5 * (np.quantile(a.points, 0.02, axis=0) + np.quantile(a.points, 0.98, axis=0))
    fits = []
    for turn in (np.pi, np.pi / 3, -np.pi / 2):
        rotation = _about_up(turn)
        turned = pose @ Sim3(rotation, middle - rotation @ middle)
        laid = _laid(fine, target, turned, (0.12, 0.1, 0.08, 0.06))
        stays = np.linalg.norm(laid.apply(middle) - pose.apply(middle)) < _APART_M
        yaw = np.arctan2(*(laid.rotation @ turned.rotation.T)[[1, 0], 0])
        fits.append(bool(stays and abs(yaw) < 0.3 and _score(a, b, laid, params) >= _AS_GOOD * score))
    if all(fits):
        return "any"
    return "half" if fits[0] else "none"
