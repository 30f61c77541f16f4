"""Find pairs of scenes whose content, by their poses, may touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap.retrieve.pair_schedule import Pair
from gsmap.retrieve.params import Params

REACH_SIGMAS = 3.0  # two scenes may touch if their gap is within this many standard deviations of their distance


@dataclass(frozen=True, eq=False)
class ScenePosition:
    """Position and extent of a scene in its component.

    Args:
        component: number of the component; components have different frames, so only scenes of one component can be
            neighbours.
        centre: (3,) centre of the scene's content, in the component's frame.
        radius: radius of the scene's content, in map units.
        sigma: standard deviation of the scene's position, in map units.
    """

    component: int
    centre: np.ndarray
    radius: float
    sigma: float = 0.0


def neighbours(positions: Mapping[str, ScenePosition], params: Params) -> list[Pair]:
    """Pair each scene with the nearest scenes of its component whose content may touch its own.

    Each scene searches among scenes of about its own extent and among larger scenes, so that a few large scenes do not
    widen the search of all scenes.

    Returns:
        Pairs (lower id, higher id), each once, nearest first; equally near pairs are sorted by id.
    """
    from scipy.spatial import cKDTree

    ids = sorted(positions)
    component = np.array([positions[scene].component for scene in ids], dtype=np.int64)
    found = [np.zeros((0, 3))]
    for one in np.unique(component):
        rows = np.flatnonzero(component == one)
        if len(rows) < 2:
            continue
        centres = np.array([positions[ids[row]].centre for row in rows], dtype=np.float64)
        sigmas = np.array([positions[ids[row]].sigma for row in rows])
        radii = np.array([positions[ids[row]].radius for row in rows])
        # hypot(a, b) <= a + b, so this reach misses no pair.
        reach = radii + REACH_SIGMAS * sigmas
        octave = np.floor(np.log2(np.maximum(reach, 1e-12))).astype(int)
        near = [np.zeros((2, 0), dtype=np.int64)]
        for size in np.unique(octave):
            pool, searching = np.flatnonzero(octave == size), np.flatnonzero(octave <= size)
            tree = cKDTree(centres[pool])
            lists = tree.query_ball_point(centres[searching], reach[searching] + reach[pool].max(), return_sorted=False)
            row = np.repeat(searching, [len(others) for others in lists])
            other = pool[np.concatenate(lists).astype(np.int64)]
            near += [np.stack([row, other]), np.stack([other, row])]
        row, other = np.divmod(np.unique(np.concatenate([a * len(rows) + b for a, b in near])), len(rows))
        distance = np.linalg.norm(centres[other] - centres[row], axis=1)
        gap = distance - radii[other] - radii[row] - REACH_SIGMAS * np.hypot(sigmas[other], sigmas[row])
        row, other, distance = (part[(gap <= 0) & (row != other)] for part in (row, other, distance))
        order = np.lexsort((other, distance, row))
        row, other, distance = row[order], other[order], distance[order]
        nearest = np.arange(len(row)) - np.searchsorted(row, row) < params.num_neighbours
        ends = np.sort(np.stack([rows[row], rows[other]]), axis=0)[:, nearest]
        found.append(np.column_stack([*ends, distance[nearest]]))
    every = np.concatenate(found)
    every = np.unique(every, axis=0)  # removes pairs that were found from both scenes
    ordered = every[np.lexsort((every[:, 1], every[:, 0], every[:, 2]))]
    return [(ids[a], ids[b]) for a, b in ordered[:, :2].astype(np.int64).tolist()]
