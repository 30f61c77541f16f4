"""A room of the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_SLACK_M = 0.3  # a point in a room's floor or ceiling is in the room


@dataclass(frozen=True, eq=False)
class Room:
    """A room, in a level frame in metres (z up).

    Args:
        low: (2,) lower corner of its cells.
        cells: (X, Y) bool mask of its cells.
        cell_m: cell size.
        floor_m, ceiling_m: heights; a ceiling that was not observed is guessed.
        doors: indices of the rooms that are connected by doors.
    """

    low: np.ndarray
    cells: np.ndarray
    cell_m: float
    floor_m: float
    ceiling_m: float
    doors: tuple[int, ...] = ()

    @property
    def area_m2(self) -> float:
        return float(self.cells.sum()) * self.cell_m**2

    @property
    def box(self) -> np.ndarray:
        """Bounding box (2, 3) of the room."""
        high = self.low + np.array(self.cells.shape) * self.cell_m
        return np.array([[*self.low, self.floor_m], [*high, self.ceiling_m]])

    @property
    def middle(self) -> np.ndarray:
        """Centre (3,) of the room's floor."""
        at = np.argwhere(self.cells).mean(0) + 0.5
        return np.array([*(self.low + at * self.cell_m), self.floor_m])

    @property
    def outline(self) -> np.ndarray:
        """End points (K, 2, 3) of the line segments around the room's floor, unordered."""
        cells = np.pad(self.cells, 1).astype(np.int8)
        pieces = []
        for axis in (0, 1):
            # Which way one steps over each border between two cells: out of the room, into it, or neither.
            step = np.diff(cells if axis == 0 else cells.T, axis=0)[:, 1:-1]
            line, end = np.nonzero(np.diff(step, axis=1, prepend=0, append=0))
            one = line[1:] == line[:-1]
            line, first, last = line[:-1][one], end[:-1][one], end[1:][one]
            both = np.stack([line, first, line, last], axis=1)[step[line, first] != 0].reshape(-1, 2, 2)
            pieces.append(both if axis == 0 else both[..., ::-1])
        at = self.low + np.concatenate(pieces) * self.cell_m
        return np.concatenate([at, np.full((*at.shape[:2], 1), self.floor_m)], axis=2)

    def holds(self, point: np.ndarray) -> bool:
        """Return true if a point (3,) lies in the room, in its floor or in its ceiling."""
        if not self.floor_m - _SLACK_M <= point[2] <= self.ceiling_m + _SLACK_M:
            return False
        cell = np.floor((point[:2] - self.low) / self.cell_m).astype(int)
        return bool((cell >= 0).all() and (cell < self.cells.shape).all() and self.cells[tuple(cell)])
