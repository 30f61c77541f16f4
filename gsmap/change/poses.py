"""Poses about the vertical that lay cells of one capture on cells of another: found by votes, settled by ICP."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

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
        for yaw in np.arange(yaws) * (2 * np.pi / yaws):
            rotation = about_up(float(yaw))
            shift = b[j, :2] - (a @ rotation.T)[i, :2]
            for votes, peak in _peaks(shift, weight):
                found.append((votes, Sim3(rotation, np.array([*peak, level]))))
    return sorted(found, key=lambda f: -f[0])


def _few(count: int, most: int) -> np.ndarray:
    return np.arange(count) if count <= most else np.linspace(0, count - 1, most).astype(np.int64)


def _peaks(shift: np.ndarray, weight: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """The most voted shifts (2,), with their votes."""
    cells = np.floor(shift / _BIN_M).astype(np.int64)
    low = cells.min(0) - 1
    wide, deep = cells.max(0) - low + 2
    index = (cells[:, 0] - low[0]) * deep + cells[:, 1] - low[1]
    votes = np.bincount(index, weight, int(wide * deep)).reshape(wide, deep)
    padded = np.pad(votes, 1)
    total = np.sum([padded[x : x + wide, y : y + deep] for x in range(3) for y in range(3)], axis=0)
    found = []
    for _ in range(_PEAKS):
        x, y = np.unravel_index(int(np.argmax(total)), total.shape)
        if total[x, y] <= 0:
            break
        near = (np.abs(cells - low - (x, y)) <= 1).all(1)
        found.append((float(total[x, y]), np.average(shift[near], axis=0, weights=weight[near])))
        total[max(0, x - 2) : x + 3, max(0, y - 2) : y + 3] = 0
    return found


def settled(moving: np.ndarray, target: Any, start: Sim3, radii_m: Sequence[float]) -> Sim3:
    """Point-to-point ICP over yaw and shift; neighbours are near in place and colour.

    Args:
        moving: (N, 6) `features`.
        target: cKDTree of the other's.
        radii_m: one step at each.
    """
    pose = start
    for radius in radii_m:
        moved = pose.apply(moving[:, :3])
        distance, row = target.query(np.concatenate([moved, moving[:, 3:]], axis=1), distance_upper_bound=2 * radius)
        hit = np.isfinite(distance)
        if hit.sum() < 10:
            return pose
        source, onto = moving[hit, :3], target.data[row[hit], :3]
        weight = 1 / (1 + (distance[hit] / (0.5 * radius)) ** 2) ** 2
        mean_s, mean_t = (np.average(p, axis=0, weights=weight) for p in (source, onto))
        s, t = source - mean_s, onto - mean_t
        yaw = np.arctan2(
            (weight * (s[:, 0] * t[:, 1] - s[:, 1] * t[:, 0])).sum(), (weight * (s[:, :2] * t[:, :2]).sum(1)).sum()
        )
        rotation = about_up(float(yaw))
        shift = mean_t - rotation @ mean_s
        # What stands on a floor does not sink or rise; only its height was measured differently.
        shift[2] = np.clip(shift[2], start.translation[2] - _SINK_M, start.translation[2] + _SINK_M)
        pose = Sim3(rotation, shift)
    return pose
