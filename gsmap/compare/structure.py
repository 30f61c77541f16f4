"""Detect the building shell: floors, ceilings and walls, as planes of surface cells."""

from __future__ import annotations

import numpy as np

from gsmap._native import PointTree
from gsmap.compare.components import components
from gsmap.geometry.neighbours import nearest_of

_BIN_M = 0.03
_THICK_M = 0.045  # thickness of a plane with its skirting boards, picture frames and noise
_LEVEL_M2, _WALL_M2 = 4.0, 0.5  # smallest areas; a smaller plane is a table or a cupboard
_REACH_M = 0.16  # cells of one plane are linked over gaps up to this width
_WALL_M = 1.8  # smallest height of a wall
_TO_CEILING_M = 0.2  # largest gap between a wall and the ceiling, if there is a ceiling
_THROUGH_M = 0.15  # largest thickness of a wall between rooms
_PIECE_M2 = 0.1  # smallest visible piece of a wall behind furniture
_BESIDE_M = 0.3  # cells in the plane of a wall within this distance are part of the wall
_MOST_PLANES = 24
_NORMAL_OF = 12  # number of neighbours to which a normal is fitted


def normals_of(points: np.ndarray) -> np.ndarray:
    """Estimate (M, 3) unit normals of surface cells; their signs are arbitrary."""
    if len(points) < 4:
        return np.tile([0.0, 0.0, 1.0], (len(points), 1))
    normals: np.ndarray = PointTree(np.ascontiguousarray(points, np.float64)).normals(_NORMAL_OF)
    return normals


def planes(points: np.ndarray, normals: np.ndarray, cell_m: float) -> np.ndarray:
    """Return the (M,) plane of each cell as a number from 0, level planes first; -1 for cells off all planes.

    Args:
        points, normals: (M, 3) points and normals of surface cells of size ``cell_m``, z up.
    """
    label = np.full(len(points), -1, dtype=np.int64)
    if len(points) < 50:
        return label
    found, ceiling = 0, np.inf
    level = np.flatnonzero(np.abs(normals[:, 2]) > 0.9)
    for height in _peaks(points[level, 2], _LEVEL_M2 / cell_m**2):
        on = (np.abs(points[:, 2] - height) < _THICK_M) & (np.abs(normals[:, 2]) > 0.7) & (label < 0)
        for piece in _pieces(points, np.flatnonzero(on), _LEVEL_M2 / cell_m**2):
            label[piece] = found
            found += 1
            if height > np.median(points[:, 2]):
                ceiling = max(height, ceiling if np.isfinite(ceiling) else height)
    upright = np.flatnonzero(np.abs(normals[:, 2]) < 0.3)
    for yaw in _directions(normals[upright]):
        way = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        distance, cosine = points @ way, np.abs(normals @ way)
        along = cosine[upright] > 0.94
        faces: list[float] = []
        for offset in _peaks(distance[upright[along]], _WALL_M2 / cell_m**2):
            on = (np.abs(distance - offset) < _THICK_M) & (cosine > 0.8) & (label < 0)
            # The other face of a wall need not be seen up to the ceiling, because no other object of that height is so
            # thin.
            thin = any(abs(offset - face) < _THROUGH_M for face in faces)
            rows = _wall(points, np.flatnonzero(on), np.inf if thin else ceiling, cell_m)
            if len(rows):
                faces.append(offset)
                label[rows] = found
                found += 1
            if found >= _MOST_PLANES:
                return label
    return label


def _wall(points: np.ndarray, rows: np.ndarray, ceiling: float, cell_m: float) -> np.ndarray:
    """Return the cells of an upright plane that belong to a wall: large pieces up to the ceiling, and pieces beside
    them."""
    pieces = _pieces(points, rows, _PIECE_M2 / cell_m**2)
    tall = [p for p in pieces if np.ptp(points[p, 2]) > _WALL_M or points[p, 2].max() > ceiling - _TO_CEILING_M]
    if not tall:
        return rows[:0]
    core = np.concatenate(tall)
    if len(core) < _WALL_M2 / cell_m**2 or np.ptp(points[core, 2]) < _WALL_M:
        return rows[:0]
    if np.isfinite(ceiling) and points[core, 2].max() < ceiling - _TO_CEILING_M:
        return rows[:0]
    near = nearest_of(points[core], points[rows], _BESIDE_M)[0]
    return rows[np.isfinite(near)]


def _peaks(values: np.ndarray, fewest: float) -> list[float]:
    """Return the peaks of the density of values on a line, densest first; each peak suppresses its neighbourhood."""
    if not len(values):
        return []
    low = values.min() - _BIN_M
    counts = np.bincount(((values - low) / _BIN_M).astype(np.int64), minlength=3).astype(np.float64)
    wide = np.convolve(counts, np.ones(3), "same")
    peaks: list[float] = []
    while len(peaks) < _MOST_PLANES:
        best = int(wide.argmax())
        if wide[best] < fewest:
            break
        near = values[np.abs(values - (low + (best + 0.5) * _BIN_M)) < 1.5 * _BIN_M]
        peaks.append(float(np.median(near)) if len(near) else low + (best + 0.5) * _BIN_M)
        wide[max(0, best - 2) : best + 3] = 0
    return peaks


def _directions(normals: np.ndarray) -> list[float]:
    """Return the yaws (radians, modulo half a turn) shared by many upright normals, most frequent first."""
    if not len(normals):
        return []
    yaw = np.degrees(np.arctan2(normals[:, 1], normals[:, 0])) % 180
    counts = np.bincount((yaw / 2).astype(np.int64) % 90, minlength=90).astype(np.float64)
    wide = counts + np.roll(counts, 1) + np.roll(counts, -1)
    found: list[float] = []
    for _ in range(8):
        best = int(wide.argmax())
        if wide[best] < 0.02 * len(normals):
            break
        off = (yaw - (2 * best + 1) + 90) % 180 - 90
        near = np.abs(off) < 4
        found.append(float(np.radians(2 * best + 1 + (np.median(off[near]) if near.any() else 0))))
        for k in range(-3, 4):
            wide[(best + k) % 90] = 0
    return found


def _pieces(points: np.ndarray, rows: np.ndarray, fewest: float) -> list[np.ndarray]:
    """Return the connected parts of a plane that are large enough."""
    if len(rows) < fewest:
        return []
    labels = components(points[rows], _REACH_M)
    counts = np.bincount(labels)
    return [rows[labels == k] for k in np.flatnonzero(counts >= fewest)]
