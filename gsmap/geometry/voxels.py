"""Group points by voxel, and merge groups of Gaussians while keeping their moments."""

from __future__ import annotations

import numpy as np

from gsmap._native import group_moments, principal_axes
from gsmap._native import reached_box as native_box
from gsmap.errors import ConfigError, InputError
from gsmap.geometry.boxes import box_around
from gsmap.geometry.cells import cell_labels
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.types import Gaussians

_MAX_OPACITY = 0.9999  # an optical depth of 9.2: finite, and opaque in any renderer
_THOMSEN = 1.6075  # exponent of Thomsen's ellipsoid surface formula, error below 1.1 %


def voxel_labels(points: np.ndarray, voxel_size: float) -> np.ndarray:
    """Return the (N,) int64 voxel of each point (N, 3), in a grid aligned with the frame's origin.

    Labels count from 0 in the order of the cells (x, then y, then z), whatever the order of the points.

    Raises:
        ConfigError: the voxel size is not positive.
        InputError: outliers are so far out that voxels cannot be numbered.
    """
    if not voxel_size > 0:
        raise ConfigError(f"voxel size must be positive, got {voxel_size}", code="out_of_range")
    points = np.asarray(points, dtype=np.float64)
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    cells = np.floor(points / voxel_size)
    low, high = box_around(cells)
    cells -= low
    extent = high - low + 1
    if not np.isfinite(extent).all() or np.prod(extent) >= 2**63:
        raise InputError(
            f"points span {extent.max():.3g} voxels of {voxel_size}: remove outliers or use larger voxels",
            code="extent_too_large",
        )
    return cell_labels(cells)[0]


def covariances(gaussians: Gaussians) -> np.ndarray:
    """Return the (N, 3, 3) float64 covariance matrices, in squared units of the frame."""
    axes = quats_to_matrices(gaussians.quats) * np.exp(gaussians.log_scales.astype(np.float64))[:, None, :]
    out: np.ndarray = axes @ axes.transpose(0, 2, 1)
    return out


def axis_deviations(gaussians: Gaussians) -> np.ndarray:
    """Return the (N, 3) float64 standard deviations along the frame's axes (square roots of the diagonals of
    `covariances`)."""
    w, x, y, z = np.ascontiguousarray(gaussians.quats.T, dtype=np.float64)
    squared = w * w + x * x + y * y + z * z
    with np.errstate(divide="ignore"):
        twice = np.where(squared > 0, 2.0 / squared, 0.0)  # a zero quaternion means the identity, as everywhere
    a, b, c = np.exp(2 * np.ascontiguousarray(gaussians.log_scales.T, dtype=np.float64))
    xx, yy, zz, xy, xz, yz = x * x * twice, y * y * twice, z * z * twice, x * y * twice, x * z * twice, y * z * twice
    wx, wy, wz = w * x * twice, w * y * twice, w * z * twice
    variances = (
        (1 - yy - zz) ** 2 * a + (xy - wz) ** 2 * b + (xz + wy) ** 2 * c,
        (xy + wz) ** 2 * a + (1 - xx - zz) ** 2 * b + (yz - wx) ** 2 * c,
        (xz - wy) ** 2 * a + (yz + wx) ** 2 * b + (1 - xx - yy) ** 2 * c,
    )
    out: np.ndarray = np.sqrt(np.stack(variances, axis=1))
    return out


def reached_box(gaussians: Gaussians, sigmas: float) -> np.ndarray:
    """Return the (2, 3) float64 box around Gaussians, each extended by ``sigmas`` times its `axis_deviations`."""
    out: np.ndarray = native_box(gaussians.means, gaussians.quats, gaussians.log_scales, sigmas)
    return out


def projected_areas(scales: np.ndarray) -> np.ndarray:
    """Return the (N,) mean projected areas of ellipsoids with semi-axes (N, 3): a quarter of the surface (Cauchy;
    Thomsen)."""
    a, b, c = np.asarray(scales, dtype=np.float64).T
    mean_power = ((a * b) ** _THOMSEN + (a * c) ** _THOMSEN + (b * c) ** _THOMSEN) / 3
    areas: np.ndarray = np.pi * mean_power ** (1 / _THOMSEN)
    return areas


def optical_depths(gaussians: Gaussians) -> np.ndarray:
    """Return the (N,) float64 optical depths ``-ln(1 - opacity)``, which add up along a ray."""
    return -np.log1p(-np.minimum(gaussians.opacities.astype(np.float64), _MAX_OPACITY))


def merge_groups(gaussians: Gaussians, labels: np.ndarray) -> tuple[Gaussians, np.ndarray]:
    """Merge the Gaussians of each label, keeping moments and transmittance; also return the (M,) rows of the heaviest
    members.

    The mass of a member is its optical depth times its mean projected area, that is, the light that it stops. The
    merged Gaussian has the mass-weighted mean, the full covariance of the mixture (the members' covariances and the
    spread of their means), the mass-weighted SH, and the optical depth at which its area stops the same light. A
    Gaussian that is alone in its group does not change.

    Args:
        labels: (N,) integers in [0, M), each used at least once; the result is in the order of the labels.
    """
    labels = np.ascontiguousarray(labels, dtype=np.int64)
    if len(labels) != len(gaussians):
        raise InputError(f"{len(labels)} labels for {len(gaussians)} Gaussians", code="shape_mismatch")
    if len(labels) == 0:
        return gaussians, np.zeros(0, dtype=np.int64)
    sh = gaussians.sh.reshape(len(gaussians), -1)
    counts, heaviest, total, means, covariance, averaged = group_moments(
        gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, sh, labels
    )
    merged = gaussians[heaviest]
    crowded = np.flatnonzero(counts > 1)
    if len(crowded) == 0:
        return merged, heaviest
    quats, variances = principal_axes(covariance[crowded])
    scales = np.sqrt(np.maximum(variances, 1e-20))
    opacity = -np.expm1(-total[crowded] / projected_areas(scales))
    opacity = np.clip(opacity, 1e-6, _MAX_OPACITY)
    merged.means[crowded] = means[crowded]
    merged.quats[crowded] = quats
    merged.log_scales[crowded] = np.log(scales)
    merged.logit_opacities[crowded] = np.log(opacity) - np.log1p(-opacity)
    merged.sh[crowded] = averaged[crowded].reshape(len(crowded), -1, 3)
    return merged, heaviest
