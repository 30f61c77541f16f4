"""Detect captures that are stretched along an axis, so that no similarity aligns them with the others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.chi_square import chi2_log_survival
from gsmap.geometry.rotations import retract
from gsmap.register import error_field
from gsmap.register.covariance import (
    PairBlocks,
    PoseUncertainty,
    oriented_normals,
    point_to_plane_jacobian,
    robust_weights,
)
from gsmap.register.surface import Surface
from gsmap.types import Sim3

_RADII_M = (0.4, 0.25, 0.15, 0.1, 0.08, 0.08)  # of nearest cells: ends of stretched captures are off by decimetres
_BORDER = 1.5  # cells between a point and its nearest cell, along the surface, at most
_MIN_PAIRS = 100
_MAX_POINTS = 4000
_REACH = 2.5  # points farther than this many radii of the overlap from its centroid are left out
_PRIOR = 0.05  # standard deviation of the strain, where surfaces do not constrain it
_NOISE_M = 0.01  # of a cell, for the weight of that prior
_MIN_SPREAD = 0.0085  # between the most and the least stretched direction, so that one percent is named
_MAX_LOG10_P = -8.0
# Rooms have 0.04 and more, slabs of 1.6 m and fronts, which leave a direction free, at most 0.002.
_MIN_OBSERVABILITY = 0.01

# Symmetric matrices without trace: the changes of shape that leave the volume, which the scale describes.
_MODES = np.zeros((5, 3, 3))
for _k, (_i, _j) in enumerate(((0, 1), (0, 2), (1, 2))):
    _MODES[_k, _i, _j] = _MODES[_k, _j, _i] = 1.0
_MODES[3], _MODES[4] = np.diag([1.0, -1.0, 0.0]), np.diag([1.0, 1.0, -2.0]) / np.sqrt(3.0)


@dataclass(frozen=True, eq=False)
class Strain:
    """The change of shape of a source that aligns it with the target, besides a similarity.

    Args:
        matrix: (3, 3) symmetric, without trace: a point p about the overlap's centroid moves by ``matrix @ p``, in the
            source's axes.
        log10_p: logarithm of the probability of a strain this large or larger without one, by the residuals.
        observability: curvature of the squared residuals along the strain, without what a similarity explains, over
            that of displacements by the radius; near 0 where no surface is across the stretched direction.
        rms_m: root mean square of the displacements in the overlap.
        centroid: (3,) centroid of the overlap in the source's frame.
        radius_m: radius of the overlap.
    """

    matrix: np.ndarray
    log10_p: float
    observability: float
    rms_m: float
    centroid: np.ndarray
    radius_m: float

    @property
    def spread(self) -> float:
        """Difference between the strains of the most and the least stretched direction."""
        values = np.linalg.eigvalsh(self.matrix)
        return float(values[-1] - values[0])

    @property
    def is_stretched(self) -> bool:
        """Return True if the strain is observed, significant and large."""
        is_observed = self.observability > _MIN_OBSERVABILITY
        return is_observed and self.log10_p < _MAX_LOG10_P and self.spread > _MIN_SPREAD

    def covariance(self, scale: float) -> np.ndarray:
        """Return the (7, 7) covariance to add to that of a pose: [rot_rad, trans_m, log_scale] on the source side.

        Parts of the overlap alone would turn and move the pose by as much as the strain displaces them.
        """
        about = np.diag(np.r_[np.full(3, self.rms_m / self.radius_m), np.full(3, self.rms_m), 0.0]) ** 2
        return PoseUncertainty.about(about, self.centroid, scale).covariance

    def note(self) -> str:
        """Return a message that names the axis whose length differs most from the others."""
        values, axes = np.linalg.eigh(self.matrix)
        odd = 0 if values[1] - values[0] > values[2] - values[1] else 2
        rest = values[[k for k in range(3) if k != odd]].mean()
        axis = axes[:, odd] * np.sign(axes[np.abs(axes[:, odd]).argmax(), odd])
        along = ", ".join(f"{round(value, 1) + 0.0:.1f}" for value in axis)
        return (
            "one capture is stretched: to fit the target, the source would have to change by "
            f"{values[odd] - rest:+.1%} along its direction ({along}), relative to the other directions; no rigid pose "
            "aligns all of it"
        )


def fit_strain(target: Surface, source: Surface, pose: Sim3) -> Strain | None:
    """Fit a similarity and a strain to the surfaces, from a refined pose (metres), by point-to-plane ICP.

    The covariance of the strain is that of `gsmap.register.covariance`: residuals are averaged over blocks, whose
    errors are correlated.

    Returns:
        None where the overlap is too small.
    """
    blocks = PairBlocks.of(target, source, pose)
    if blocks is None:
        return None
    centroid, radius_m = blocks.centroid, blocks.radius_m / pose.scale
    points, _ = source.coarse
    rows = np.flatnonzero(np.linalg.norm(points - centroid, axis=1) < _REACH * radius_m)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MAX_POINTS)).astype(np.int64)]
    local = points[rows] - centroid
    centre = Sim3(np.eye(3), centroid)
    strain = np.zeros(5)
    border_m = _BORDER * max(target.resolution_m, source.resolution_m)
    for radius in _RADII_M:
        warped = local + local @ np.einsum("k,kij->ij", strain, _MODES)
        normals = oriented_normals(source, pose)
        moved = (pose @ centre).apply(warped)
        distance, row = target.nearest(moved, radius, None if normals is None else normals[rows])
        apart, plane = moved - target.coarse[0][row], target.normals[row]
        residual = (plane * apart).sum(1)
        # Beyond the border of the target's surfaces the nearest cell lies aside, and would pull the source inwards.
        hit = np.isfinite(distance) & (np.linalg.norm(apart - residual[:, None] * plane, axis=1) < border_m)
        if hit.sum() < _MIN_PAIRS:
            return None
        weights = robust_weights(residual[hit], max(radius / 3.0, 0.02))
        J = np.concatenate(
            [point_to_plane_jacobian(pose @ centre, warped[hit], plane[hit]), _strains(pose, local[hit], plane[hit])],
            axis=1,
        )
        prior = np.r_[np.zeros(7), np.full(5, (_NOISE_M / _PRIOR) ** 2)]
        H = (J * weights[:, None]).T @ J + np.diag(prior)
        step = -np.linalg.lstsq(H, (J * weights[:, None]).T @ residual[hit] + prior * np.r_[np.zeros(7), strain])[0]
        pose = retract(pose @ centre, step[:7]) @ centre.inverse()
        strain = strain + step[7:]
    matrix = np.einsum("k,kij->ij", strain, _MODES)
    blocks = PairBlocks.of(target, source, pose, points + (points - centroid) @ matrix)
    if blocks is None:
        return None
    J = _jacobian(blocks, pose)
    if (covariance := _covariance(blocks, J)) is None:
        return None
    statistic = float(strain @ np.linalg.pinv(covariance, hermitian=True) @ strain)
    inside = local[np.linalg.norm(local, axis=1) < radius_m]
    rms_m = float(np.sqrt(((inside @ matrix) ** 2).sum(1).mean())) if len(inside) else 0.0
    log10_p = float(chi2_log_survival(statistic, 5)) / np.log(10.0)
    return Strain(matrix, log10_p, _observability(blocks, J, strain), rms_m, centroid, radius_m)


def _strains(pose: Sim3, local: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the (N, 5) derivative of point-to-plane residuals with respect to the strain.

    Args:
        local: (N, 3) points of the source about the centroid.
        normals: (N, 3) in the target's frame.
    """
    slopes: np.ndarray = np.einsum("ni,kij,nj->nk", pose.scale * normals @ pose.rotation, _MODES, local)
    return slopes


def _jacobian(blocks: PairBlocks, pose: Sim3) -> np.ndarray:
    """Return the (B, 12) derivative of the residuals of blocks with respect to the similarity and the strain."""
    local = pose.inverse().apply(blocks.positions) - blocks.centroid
    return np.concatenate([blocks.jacobian, _strains(pose, local, blocks.directions)], axis=1)


def _covariance(blocks: PairBlocks, J: np.ndarray) -> np.ndarray | None:
    """Return the (5, 5) covariance of a strain by the Jacobian (B, 12); None where there are too few blocks."""
    pull = (J * blocks.weights[:, None]).T
    influence = np.linalg.pinv(pull @ J, hermitian=True) @ pull
    errors = error_field.estimate_errors(replace(blocks, jacobian=J), influence)
    return None if errors is None else errors.covariance[7:, 7:]


def _observability(blocks: PairBlocks, J: np.ndarray, strain: np.ndarray) -> float:
    H = (J * blocks.weights[:, None]).T @ J
    left = H[7:, 7:] - H[7:, :7] @ np.linalg.pinv(H[:7, :7], hermitian=True) @ H[:7, 7:]
    whole = float(strain @ strain) * blocks.weights.sum() * blocks.radius_m**2
    return float(strain @ left @ strain) / whole if whole else 0.0
