"""GaussReg's rule: each part keeps the Gaussians that lie nearer to its own centroid than to any other part's."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmap.merge.parts import MergeResult, Part, united


@dataclass(frozen=True)
class Params:
    """Nothing to choose."""


def reach_m(params: Params) -> float:
    return 0.0


def merge(
    parts: list[Part],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Callable[[float, str], None],
) -> MergeResult:
    """For two parts one bisecting plane: keep i of A iff ``|mu_i - c_A| < |mu_i - c_B|``, and j of B the other way.

    A centroid is the unweighted mean of all means of the whole capture (GaussReg, fusion code); ties keep nothing.
    """
    gaussians, origin = united(parts)
    filled = [i for i, part in enumerate(parts) if part.centroid is not None or len(part.gaussians)]
    centroids = np.stack([_centroid(parts[i]) for i in filled]) if filled else np.zeros((0, 3))
    squared = np.full((len(gaussians), len(parts)), np.inf)
    for column, centroid in zip(filled, centroids, strict=True):
        squared[:, column] = ((gaussians.means - centroid) ** 2).sum(1)
    own = np.take_along_axis(squared, origin[:, None].astype(np.int64), axis=1)[:, 0]
    squared[np.arange(len(gaussians)), origin] = np.inf
    keep = own < squared.min(1, initial=np.inf)
    return MergeResult(gaussians[keep], origin[keep])


def _centroid(part: Part) -> np.ndarray:
    return part.gaussians.means.mean(0, dtype=np.float64) if part.centroid is None else np.asarray(part.centroid)
