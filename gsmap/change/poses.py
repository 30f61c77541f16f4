"""Poses about the vertical that lay cells of one capture on cells of another: found by votes, settled by ICP."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsmap._native import FeatureTree, vote_shifts
from gsmap.types import Sim3

_TINT_M = 0.25  # metres that a difference of hue of 1 counts for, where neighbours are looked for
_LIGHT = 0.5  # and of lightness so much of it: elsewhere a thing stands in another light


def tints(colours: np.ndarray) -> np.ndarray:
    """(N, 3) lightness and two of hue, in which the distance says how unlike two colours (N, 3) in [0, 1] are."""
    light, green = colours.mean(1), colours[:, 1]
    return np.stack([_LIGHT * light, 0.8 * (colours[:, 0] - green), 0.8 * (colours[:, 2] - green)], axis=1)


def features(points: np.ndarray, colours: np.ndarray) -> np.ndarray:
    """(N, 6) place and tint, both in metres."""
    return np.concatenate([points, tints(colours) * _TINT_M], axis=1)


_VOTERS, _VOTED = 150, 900  # cells that vote, and that are voted for
_LEVEL_M, _TINT = 0.06, 0.1  # a pair of cells votes if their heights and colours differ by less
_SINK_M = 0.04
_FEWEST_PAIRS = 10
_BIN_M = 0.1
_PEAKS = 2  # of each yaw
_LOW_M = 0.25  # what stands higher may stand at another height afterwards


def about_up(yaw: float) -> np.ndarray:
    """(3, 3) rotation about z."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def voted(
    points: np.ndarray, colours: np.ndarray, onto: np.ndarray, onto_colours: np.ndarray, yaws: int
) -> list[tuple[float, Sim3]]:
    """Poses that lay many cells on cells of their colour and height, with their votes; most first.

    Every pair of like cells votes, at every yaw, for the shift between them (a generalised Hough transform, Ballard
    1981); a cell that is like many has less to say.

    Args:
        points, colours: (N, 3) of the thing.
        onto, onto_colours: (M, 3) of all that it may have become.
        yaws: how many are tried, evenly.
    """
    mine, theirs = _few(len(points), _VOTERS), _few(len(onto), _VOTED)
    a, b = points[mine], onto[theirs]
    alike = ((tints(colours[mine])[:, None] - tints(onto_colours[theirs])[None]) ** 2).sum(2) < _TINT**2
    rise = b[None, :, 2] - a[:, None, 2]
    levels = [0.0]
    if len(a) and np.quantile(a[:, 2], 0.03) > _LOW_M and alike.any():
        counts, edges = np.histogram(rise[alike], bins=np.arange(-2, 2.05, 0.05))
        best = float(edges[counts.argmax()] + 0.025)
        levels += [best] if abs(best) > _LEVEL_M else []
    found: list[tuple[float, Sim3]] = []
    for level in levels:
        i, j = np.nonzero(alike & (np.abs(rise - level) < _LEVEL_M))
        if not len(i):
            continue
        weight = 1 / np.sqrt(np.bincount(i, minlength=len(a)))[i]
        turns = np.arange(yaws) * (2 * np.pi / yaws)
        plan = (np.ascontiguousarray(p[:, :2], np.float64) for p in (a, b))
        which, peaks = vote_shifts(*plan, i=i, j=j, weight=weight, yaws=turns, bin=_BIN_M, peaks=_PEAKS)
        for k, (votes, x, y) in zip(which, peaks, strict=True):
            found.append((float(votes), Sim3(about_up(float(turns[k])), np.array([x, y, level]))))
    return sorted(found, key=lambda f: -f[0])


def _few(count: int, most: int) -> np.ndarray:
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


def settled(moving: np.ndarray, target: FeatureTree, start: Sim3, radii_m: Sequence[float]) -> Sim3:
    """Point-to-point ICP over yaw and shift; neighbours are near in place and colour. What stands on a floor does not
    sink or rise; only its height was measured differently.

    Args:
        moving: (N, 6) `features`.
        target: of the other's.
        start: about the vertical.
        radii_m: one step at each.
    """
    rotation, translation = start.rotation, start.translation
    return Sim3(*target.settled(moving, rotation, translation, np.asarray(radii_m, np.float64), _SINK_M, _FEWEST_PAIRS))
