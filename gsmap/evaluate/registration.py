"""Compute the errors of estimated similarities: RRE, RTE, RSE, ATE, and the error at the centroid."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.rotations import angle_between
from gsmap.geometry.umeyama import umeyama
from gsmap.types import Gaussians, Sim3


@dataclass(frozen=True)
class PoseError:
    """Errors of one estimated ``S_target_source``.

    Args:
        rre_deg: relative rotation error, the angle of ``R^T R_hat``.
        rte: relative translation error as GaussReg defines it, ``|t/s - t_hat/s_hat| / |t/s|``; it depends on the
            distance between the origins of both frames.
        rse: relative scale error ``|s - s_hat| / s``.
        centroid_m: distance between the source's centroid under the estimated and under the true pose, in the target's
            unit; it does not depend on the origins of the frames.
    """

    rre_deg: float
    rte: float
    rse: float
    centroid_m: float


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


@dataclass(frozen=True)
class RegistrationSummary:
    """Statistics of many pairs.

    Args:
        num_pairs: pairs with a true pose.
        num_estimated: pairs with an estimated pose.
        mean_rre_deg, mean_rte, mean_rse: plain means over all estimated pairs, including failures (as in GaussReg).
        median_rre_deg, median_centroid_m, worst_rre_deg, worst_centroid_m: medians and maxima over the estimated pairs.
        recall: share of all pairs within each threshold; pairs without an estimate count as missed.
    """

    num_pairs: int
    num_estimated: int
    mean_rre_deg: float
    mean_rte: float
    mean_rse: float
    median_rre_deg: float
    median_centroid_m: float
    worst_rre_deg: float
    worst_centroid_m: float
    recall: dict[str, float]


def summarise(errors: Sequence[PoseError | None]) -> RegistrationSummary:
    """Compute means, medians and recall of many pairs; None represents a pair without an estimate.

    Recall is computed at RRE 5 and 10 degrees, RTE 0.1 and 0.2, and RSE 0.1 and 0.2 (as in GaussReg), and for angle and
    distance together: ``coarse`` (5 degrees, 0.3 m) and ``fine`` (1 degree, 5 cm).
    """
    found = [e for e in errors if e is not None]
    columns = np.array([[e.rre_deg, e.rte, e.rse, e.centroid_m] for e in found]).reshape(-1, 4)
    rre, rte, rse, metres = columns.T

    def share(ok: np.ndarray) -> float:
        return float(ok.sum()) / len(errors) if len(errors) else np.nan

    def over(function: Callable[[np.ndarray], Any], values: np.ndarray) -> float:
        return float(function(values)) if len(values) else np.nan

    return RegistrationSummary(
        num_pairs=len(errors),
        num_estimated=len(found),
        mean_rre_deg=over(np.mean, rre),
        mean_rte=over(np.mean, rte),
        mean_rse=over(np.mean, rse),
        median_rre_deg=over(np.median, rre),
        median_centroid_m=over(np.median, metres),
        worst_rre_deg=over(np.max, rre),
        worst_centroid_m=over(np.max, metres),
        recall={
            "rre_5_deg": share(rre < 5),
            "rre_10_deg": share(rre < 10),
            "rte_0.1": share(rte < 0.1),
            "rte_0.2": share(rte < 0.2),
            "rse_0.1": share(rse < 0.1),
            "rse_0.2": share(rse < 0.2),
            "coarse": share((rre < 5) & (metres < 0.3)),
            "fine": share((rre < 1) & (metres < 0.05)),
        },
    )


def absolute_trajectory_error(
    estimated: np.ndarray, true: np.ndarray, *, align: str = "rigid", segments: Sequence[np.ndarray] | None = None
) -> float:
    """Return the absolute trajectory error (ATE): the root mean square distance between aligned estimated and true
    positions.

    This is the ATE of Sturm et al. 2012; Graph-GSReg reports an ATE without a definition.

    Args:
        estimated, true: (N, 3) positions in their own frames.
        align: ``rigid``, ``similarity`` or ``none``.
        segments: index arrays of positions that are aligned together, because components have different frames; by
            default all.
    """
    estimated, true = np.asarray(estimated, float), np.asarray(true, float)
    if estimated.shape != true.shape or estimated.ndim != 2 or estimated.shape[1] != 3 or not len(true):
        raise InputError(
            f"the ATE needs two trajectories (N, 3) with N >= 1, got {estimated.shape} and {true.shape}",
            code="shape_mismatch",
        )
    squares = np.empty(len(true))
    for rows in segments if segments is not None else [np.arange(len(true))]:
        moved = estimated[rows]
        if align != "none":
            moved = _align(true[rows], moved, with_scale=align == "similarity")
        squares[rows] = ((moved - true[rows]) ** 2).sum(1)
    return float(np.sqrt(squares.mean()))


def _align(true: np.ndarray, estimated: np.ndarray, with_scale: bool) -> np.ndarray:
    if len(true) < 3:  # Fewer than three points determine no rotation, so only centroids are aligned.
        return estimated - estimated.mean(0) + true.mean(0)
    return umeyama(true, estimated, with_scale=with_scale).apply(estimated)
