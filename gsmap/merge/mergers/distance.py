"""Merge by distance, as in GaussReg: each scene keeps the Gaussians that are nearer to its own centroid than to any
other."""

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
    """Settings of merging by distance: none."""


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
    """Keep the Gaussians that are nearest to the centroid of their own scene.

    For two scenes A and B the border is the bisecting plane: a Gaussian i of A is kept iff
    ``|mu_i - c_A| < |mu_i - c_B|``, a Gaussian of B in the opposite case.

    A centroid is the unweighted mean of all means of the whole capture (GaussReg, fusion code). In a tie neither is
    kept.
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
