"""Which placed scenes may touch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from gsmap.retrieve.params import Params
from gsmap.retrieve.rounds import Pair, directed


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

    found: dict[Pair, float] = {}
    components: dict[int, list[str]] = {}
    for scene in sorted(placed):
        components.setdefault(placed[scene].component, []).append(scene)
    for scenes in components.values():
        if len(scenes) < 2:
            continue
        centres = np.array([placed[scene].centre for scene in scenes], dtype=np.float64)
        sigmas = np.array([placed[scene].sigma for scene in scenes])
        radii = np.array([placed[scene].radius for scene in scenes])
        # hypot(a, b) <= a + b, so this reach leaves none out.
        reach = radii + params.reach_sigmas * sigmas
        near: dict[int, dict[int, float]] = {}
        octave = np.floor(np.log2(np.maximum(reach, 1e-12))).astype(int)
        for size in np.unique(octave):
            pool, askers = np.flatnonzero(octave == size), np.flatnonzero(octave <= size)
            tree = cKDTree(centres[pool])
            found_rows = tree.query_ball_point(centres[askers], reach[askers] + reach[pool].max())
            for asker, rows in zip(askers, found_rows, strict=True):
                others = pool[rows]
                distance = np.linalg.norm(centres[others] - centres[asker], axis=1)
                gap = distance - radii[others] - radii[asker]
                gap -= params.reach_sigmas * np.hypot(sigmas[others], sigmas[asker])
                for beside, far in zip(others[gap <= 0].tolist(), distance[gap <= 0].tolist(), strict=True):
                    if beside != asker:
                        near.setdefault(int(asker), {})[beside] = far
                        near.setdefault(beside, {})[int(asker)] = far
        for row, distances in near.items():
            for other in sorted(distances, key=lambda k: (distances[k], k))[: params.num_spatial]:
                found[directed(scenes[row], scenes[other])] = distances[other]
    return sorted(found, key=lambda pair: (found[pair], pair))
