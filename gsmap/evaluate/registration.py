"""Compute the errors of estimated similarities: RRE, RTE, RSE, ATE, and the error at the centroid."""

from __future__ import annotations

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.rotations import angle_between
from gsmap.geometry.umeyama import umeyama
from gsmap.types import Gaussians, Sim3
from gsmap.types.rows.evaluation import PoseError


def scene_centroid(gaussians: Gaussians, min_opacity: float = 0.3) -> np.ndarray:
    """Return the (3,) median of the centres of opaque Gaussians, at which translation errors are measured."""
    opaque = gaussians.means[gaussians.opacities > min_opacity]
    if not len(opaque):
        raise InputError(
            "the scene has no opaque Gaussians and so no centroid: measure errors at another point",
            code="no_opaque_gaussians",
        )
    return np.median(opaque.astype(np.float64), axis=0)


def pose_error(estimated: Sim3, true: Sim3, source_centroid: np.ndarray) -> PoseError:
    """Return the errors of an estimated ``S_target_source``; ``source_centroid`` (3,) is in the source's frame."""
    t_true, t_estimated = true.translation / true.scale, estimated.translation / estimated.scale
    length = float(np.linalg.norm(t_true))
    off = float(np.linalg.norm(t_true - t_estimated))
    return PoseError(
        rre_deg=float(np.degrees(angle_between(true.rotation, estimated.rotation))),
        rte=off / length if length > 0 else (0.0 if off == 0 else np.inf),
        rse=abs(true.scale - estimated.scale) / true.scale,
        centroid_m=float(np.linalg.norm(estimated.apply(source_centroid) - true.apply(source_centroid))),
    )


def absolute_trajectory_error(estimated: np.ndarray, true: np.ndarray, *, align: str = "rigid") -> float:
    """Return the absolute trajectory error (ATE): the root mean square distance between aligned estimated and true
    positions.

    This is the ATE of Sturm et al. 2012; Graph-GSReg reports an ATE without a definition.

    Args:
        estimated, true: (N, 3) positions in their own frames.
        align: ``rigid``, ``similarity`` or ``none``.
    """
    estimated, true = np.asarray(estimated, float), np.asarray(true, float)
    if estimated.shape != true.shape or estimated.ndim != 2 or estimated.shape[1] != 3 or not len(true):
        raise InputError(
            f"the ATE needs two trajectories (N, 3) with N >= 1, got {estimated.shape} and {true.shape}",
            code="shape_mismatch",
        )
    moved = estimated if align == "none" else _align(true, estimated, with_scale=align == "similarity")
    return float(np.sqrt(((moved - true) ** 2).sum(1).mean()))


def _align(true: np.ndarray, estimated: np.ndarray, with_scale: bool) -> np.ndarray:
    if len(true) < 3:  # Fewer than three points determine no rotation, so only centroids are aligned.
        return estimated - estimated.mean(0) + true.mean(0)
    return umeyama(true, estimated, with_scale=with_scale).apply(estimated)
