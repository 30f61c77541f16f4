"""Compare normalized estimation errors squared (NEES) of edges and poses with their chi-square distribution."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.chi_square import chi2_quantile
from gsmap.geometry.similarities import Similarities, without_scale
from gsmap.types import Sim3
from gsmap.types.rows.evaluation import NeesRow

SURE_LOG_SCALE = 1e-6
"""Standard deviation that is assumed for the scale of a rigid pose, because its covariance leaves the scale open."""
_SAME_SCALE = 1e-9
_THREE_SIGMA = 0.9973002039367398  # share of a normal distribution within three standard deviations


@dataclass(frozen=True)
class Nees:
    """Normalized estimation error squared.

    Args:
        value: the NEES; it follows a chi-square distribution with ``dof`` degrees of freedom if the covariance is
            correct.
        dof: 7, or 6 if both the pose and the truth are rigid.
    """

    value: float
    dof: int


def truth_covariance(sigma_rad: float, sigma: float, centroid: np.ndarray) -> np.ndarray:
    """Return the (7, 7) covariance of a true ``S_target_source`` on the source side, from the errors of both true
    poses.

    Args:
        sigma_rad, sigma: standard deviations of each scene's rotation and translation (in the source's unit) about
            ``centroid``.
        centroid: (3,) centroid of the source, in its own frame.
    """
    variances = 2.0 * np.r_[np.full(3, sigma_rad**2), np.full(3, sigma**2), 0.0]
    carry = Similarities.stack([Sim3(np.eye(3), np.asarray(centroid, dtype=np.float64))]).adjoint()[0]
    covariance: np.ndarray = carry @ np.diag(variances) @ carry.T
    return covariance


def nees_of_edge(estimated: Sim3, information: np.ndarray, true: Sim3, of_truth: np.ndarray | None = None) -> Nees:
    """Return the NEES of ``S_target_source``, given its (7, 7) information on the source side.

    The scale of a rigid edge counts if the true scale is not 1.

    Args:
        of_truth: (7, 7) covariance of the truth itself (`truth_covariance`); None if the truth is exact.
    """
    error, dof = _error(estimated, true), 7
    if estimated.is_rigid and _is_one(true.scale):
        error, information, dof = error[:6], without_scale(information), 6
    if of_truth is not None:
        information = np.linalg.inv(np.linalg.inv(information) + of_truth[:dof, :dof])
    return Nees(float(error @ information @ error), dof)


def nees_of_pose(estimated: Sim3, covariance: np.ndarray, true: Sim3, of_truth: np.ndarray | None = None) -> Nees:
    """Return the NEES of a scene's pose relative to the anchor, ``S_anchor_scene``.

    Args:
        covariance: (7, 7) relative to the anchor (`relative_covariance`), on the scene's side.
        of_truth: see `nees_of_edge`.
    """
    covariance = np.array(covariance, dtype=np.float64)
    error = _error(estimated, true)
    knows_scale = covariance[6, 6] > SURE_LOG_SCALE**2
    dof = 6 if not knows_scale and _is_one(true.scale) and _is_one(estimated.scale) else 7
    if not knows_scale:
        covariance[6, :] = covariance[:, 6] = 0.0
        covariance[6, 6] = SURE_LOG_SCALE**2
    if of_truth is not None:
        covariance = covariance + of_truth
    covariance = covariance[:dof, :dof]
    return Nees(float(error[:dof] @ np.linalg.solve(covariance, error[:dof])), dof)


def relative_covariance(estimated: Sim3, covariance: np.ndarray, of_anchor: np.ndarray) -> np.ndarray | None:
    """Return the (7, 7) covariance of ``S_anchor_scene`` on the scene's side, from the covariances of the scene and its
    anchor.

    The optimizer fixes an anchor by a slightly soft prior, which every other scene's covariance contains.

    Returns:
        None if no such prior fixes the anchor: if pose priors fix the frame, scenes share an error of unknown size.
    """
    if not _is_anchor_prior(of_anchor):
        return None
    carry = Similarities.stack([estimated.inverse()]).adjoint()[0]
    relative: np.ndarray = covariance - carry @ of_anchor @ carry.T
    known = 7 if relative[6, 6] > 0 else 6
    return relative if np.linalg.eigvalsh(relative[:known, :known])[0] > 0 else None


def _is_anchor_prior(covariance: np.ndarray) -> bool:
    """Return whether a covariance is that of the anchor's prior: isotropic and uncorrelated."""
    variances = np.diag(covariance)
    off = covariance - np.diag(variances)
    small = np.abs(off) <= 1e-3 * np.sqrt(np.outer(variances, variances)) + 1e-15
    return bool(
        small.all() and np.ptp(variances[:3]) <= 1e-3 * variances[0] and np.ptp(variances[3:6]) <= 1e-3 * variances[3]
    )


def nees_rows(of: str, found: Sequence[Nees]) -> tuple[NeesRow, ...]:
    """Return one row for each number of degrees of freedom: measured statistics and their expected values."""
    rows = []
    for dof in sorted({one.dof for one in found}):
        values = np.array([one.value for one in found if one.dof == dof])
        rows.append(
            NeesRow(
                of=of,
                dof=dof,
                num=len(values),
                median=float(np.median(values)),
                expected_median=float(chi2_quantile(0.5, dof)),
                within_3_sigma=float((values <= chi2_quantile(_THREE_SIGMA, dof)).mean()),
                expected_within_3_sigma=_THREE_SIGMA,
            )
        )
    return tuple(rows)


def _error(estimated: Sim3, true: Sim3) -> np.ndarray:
    """Return the (7,) tangent on the source side from the estimated to the true pose."""
    error: np.ndarray = (Similarities.stack([estimated]).inverse() @ Similarities.stack([true])).log()[0]
    return error


def _is_one(scale: float) -> bool:
    return abs(scale - 1) < _SAME_SCALE
