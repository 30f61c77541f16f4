"""Which placed scenes may touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap.retrieve.params import Params
from gsmap.retrieve.rounds import Pair

REACH_SIGMAS = 3.0  # standard deviations of their distance within which two scenes may touch


@dataclass(frozen=True, eq=False)
class Placed:
    """Where a scene lies in the map, as far as that is known.

    Args:
        component: of the pose graph; components share no frame, so only scenes of one component can be neighbours.
        centre: (3,) of the scene's content, in the component's frame.
        radius: of its content, map units.
        sigma: standard deviation of its position, map units.
    """

    component: int
    centre: np.ndarray
    radius: float
    sigma: float = 0.0


def neighbours(placed: Mapping[str, Placed], params: Params) -> list[Pair]:
    """(lower, higher) by id: each placed scene with the nearest of its component that its content may touch.

    Every scene asks a tree of those of about its own reach and of larger ones for what may touch it, so that few large
    scenes do not make all the others look far.

    Returns:
        Each pair once, nearest first, equals by id.
    """
    from scipy.spatial import cKDTree

    ids = sorted(placed)
    component = np.array([placed[scene].component for scene in ids], dtype=np.int64)
    found = [np.zeros((0, 3))]
    for one in np.unique(component):
        rows = np.flatnonzero(component == one)
        if len(rows) < 2:
            continue
        centres = np.array([placed[ids[row]].centre for row in rows], dtype=np.float64)
        sigmas = np.array([placed[ids[row]].sigma for row in rows])
        radii = np.array([placed[ids[row]].radius for row in rows])
        # hypot(a, b) <= a + b, so this reach leaves none out.
        reach = radii + REACH_SIGMAS * sigmas
        octave = np.floor(np.log2(np.maximum(reach, 1e-12))).astype(int)
        near = [np.zeros((2, 0), dtype=np.int64)]
        for size in np.unique(octave):
            pool, askers = np.flatnonzero(octave == size), np.flatnonzero(octave <= size)
            tree = cKDTree(centres[pool])
            lists = tree.query_ball_point(centres[askers], reach[askers] + reach[pool].max(), return_sorted=False)
            asker = np.repeat(askers, [len(others) for others in lists])
            other = pool[np.concatenate(lists).astype(np.int64)]
            near += [np.stack([asker, other]), np.stack([other, asker])]
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
    every = np.unique(every, axis=0)  # a pair that both of its scenes name
    ordered = every[np.lexsort((every[:, 1], every[:, 0], every[:, 2]))]
    return [(ids[a], ids[b]) for a, b in ordered[:, :2].astype(np.int64).tolist()]
