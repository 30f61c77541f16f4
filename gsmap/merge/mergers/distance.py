"""Merging by distance, as in GaussReg: each scene keeps the Gaussians nearest to its own centroid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.merge.overlap import concatenate_scenes
from gsmap.types import MergeResult, PosedScene
from gsmap.types.progress import Progress

VERSION = 1
STEPS: str | None = None
RENDERS = False


@dataclass(frozen=True)
class Params:
    """Settings of distance-based selection: none."""


def reach_m(params: Params) -> float:
    return 0.0


def reading_m(params: Params, dated: bool) -> float:
    return 0.0


def looking_m(params: Params) -> float:
    return 0.0


def min_cameras(params: Params) -> int:
    return 0


def uses_dates(params: Params) -> bool:
    return False


def merge(
    scenes: Sequence[PosedScene],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Progress,
) -> MergeResult:
    """Keep the Gaussians nearest to their own scene's centroid.

    For two scenes this is a bisecting plane: keep i of A iff ``|mu_i - c_A| < |mu_i - c_B|``, and j of B the other way.

    A centroid is the unweighted mean of all means of the whole capture (GaussReg, fusion code); ties keep nothing.
    """
    gaussians, origin = concatenate_scenes(scenes)
    squared = np.full((len(gaussians), len(scenes)), np.inf)
    for column, scene in enumerate(scenes):
        centroid = scene.whole_centroid()
        if centroid is not None:
            squared[:, column] = ((gaussians.means - centroid) ** 2).sum(1)
    own = np.take_along_axis(squared, origin[:, None].astype(np.int64), axis=1)[:, 0]
    squared[np.arange(len(gaussians)), origin] = np.inf
    keep = own < squared.min(1, initial=np.inf)
    return MergeResult(gaussians[keep], origin[keep])
