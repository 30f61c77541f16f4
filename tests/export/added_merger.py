"""A merger as another package would write it: of two Gaussians in one place the more opaque one stays."""

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.voxels import voxel_labels
from gsmap.types import Gaussians, MergeResult

VERSION, STEPS, RENDERS = 1, "rounds", False


@dataclass(frozen=True)
class Params:
    """The most opaque Gaussian of each cell.

    Args:
        cell_m: side of a cell.
        rounds: how often cells grow to twice their size.
    """

    cell_m: float = 0.1
    rounds: int = 0


def reach_m(params):
    return params.cell_m * 2**params.rounds


def reading_m(params, dated):
    return reach_m(params)


def looking_m(params):
    return 0.0


def min_cameras(params):
    return 0


def uses_dates(params):
    return False


def merge(scenes, params, bounds, budget_s, progress):
    gaussians = Gaussians.concatenate([scene.gaussians for scene in scenes])
    origin = np.repeat(np.arange(len(scenes)), [len(scene.gaussians) for scene in scenes])
    order = np.argsort(-gaussians.logit_opacities, kind="stable")
    _, first = np.unique(voxel_labels(gaussians.means[order], reach_m(params)), return_index=True)
    centroids = np.round([scene.whole_centroid() for scene in scenes], 1)
    return MergeResult(gaussians[order[first]], origin[order[first]], notes=(f"centroids at {centroids.tolist()}",))
