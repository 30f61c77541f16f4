"""Estimate upright poses of moved objects: Hough voting followed by coloured ICP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap._native import FeatureTree, vote_shifts
from gsmap.types import Sim3

_TINT_M = 0.25  # metres per unit of hue difference, in the search for neighbours
_LIGHT = 0.5  # weight of lightness relative to hue, as lighting differs from place to place


def tints(colours: np.ndarray) -> np.ndarray:
    """Return the (N, 3) lightness and two hue coordinates of colours (N, 3) in [0, 1], for Euclidean comparison."""
    lightness, green = colours.mean(1), colours[:, 1]
    return np.stack([_LIGHT * lightness, 0.8 * (colours[:, 0] - green), 0.8 * (colours[:, 2] - green)], axis=1)


def features(points: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """Return the (N, 6) positions and tints of points, both in metres."""
    return np.concatenate([points, tints(colours) * _TINT_M], axis=1)


_VOTERS, _VOTED = 150, 900  # number of cells of the object, and of the other capture, that vote
_LEVEL_M, _TINT = 0.06, 0.1  # largest differences in height and in tint between the cells of a voting pair
_SINK_M = 0.04
_FEWEST_PAIRS = 10
_BIN_M = 0.1
_PEAKS = 2  # number of peaks that are kept for each yaw
_LOW_M = 0.25  # an object higher above the ground than this may be at another height afterwards


def rotation_about_up(yaw: float) -> np.ndarray:
    """Return the (3, 3) rotation about z by a yaw in radians."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def vote_poses(
    points: np.ndarray, colours: np.ndarray, onto: np.ndarray, onto_colours: np.ndarray, yaws: int
) -> list[tuple[float, Sim3]]:
    """Return the poses that align many cells with cells of similar colour and height, each with its votes, most votes
    first.

    Every pair of similar cells votes, at every yaw, for the translation between both cells (a generalized Hough
    transform, Ballard 1981); a cell that is similar to many cells has less weight.

    Args:
        points, colours: (N, 3) positions and colours of the object's cells.
        onto, onto_colours: (M, 3) positions and colours of all candidate cells of the other capture.
        yaws: number of yaws, evenly spaced.
    """
    mine, theirs = _few(len(points), _VOTERS), _few(len(onto), _VOTED)
    a, b = points[mine], onto[theirs]
    similar = ((tints(colours[mine])[:, None] - tints(onto_colours[theirs])[None]) ** 2).sum(2) < _TINT**2
    rise = b[None, :, 2] - a[:, None, 2]
    levels = [0.0]
    if len(a) and np.quantile(a[:, 2], 0.03) > _LOW_M and similar.any():
        counts, edges = np.histogram(rise[similar], bins=np.arange(-2, 2.05, 0.05))
        best = float(edges[counts.argmax()] + 0.025)
        levels += [best] if abs(best) > _LEVEL_M else []
    found: list[tuple[float, Sim3]] = []
    for level in levels:
        i, j = np.nonzero(similar & (np.abs(rise - level) < _LEVEL_M))
        if not len(i):
            continue
        weight = 1 / np.sqrt(np.bincount(i, minlength=len(a)))[i]
        turns = np.arange(yaws) * (2 * np.pi / yaws)
        plan = (np.ascontiguousarray(p[:, :2], np.float64) for p in (a, b))
        which, peaks = vote_shifts(*plan, i=i, j=j, weight=weight, yaws=turns, bin=_BIN_M, peaks=_PEAKS)
        for k, (votes, x, y) in zip(which, peaks, strict=True):
            found.append((float(votes), Sim3(rotation_about_up(float(turns[k])), np.array([x, y, level]))))
    return sorted(found, key=lambda f: -f[0])


def _few(count: int, most: int) -> np.ndarray:
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


def refine_pose(moving: np.ndarray, target: FeatureTree, start: Sim3, radii_m: Sequence[float]) -> Sim3:
    """Refine a pose by point-to-point ICP over yaw and translation; correspondences are near in position and colour.

    Objects on a floor do not sink or rise: vertical corrections are limited.

    Args:
        moving: (N, 6) `features` of the object.
        target: search tree of the other capture's features.
        start: initial upright pose.
        radii_m: search radius of each step.
    """
    rotation, translation = start.rotation, start.translation
    return Sim3(*target.settled(moving, rotation, translation, np.asarray(radii_m, np.float64), _SINK_M, _FEWEST_PAIRS))
