"""Estimate the covariance of a pose from its residuals, where surface errors are spatially correlated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_FREE = 3  # smallest excess of residuals over parameters; with fewer the variance is undefined


LENGTHS_M = (0.5, 1.0, 2.0, 4.0, 8.0)  # correlation lengths: errors correlate by exp(-distance / length)
# Candidate shares of a block's variance that are correlated beyond the block.
SHARES = (0.0, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.95)
SMALL_BLOCK = 4.0  # a block of this many points has twice the variance of a block of very many points


@dataclass(frozen=True, eq=False)
class Blocks:
    """Means of residuals over B blocks of surface.

    Args:
        jacobian: (B, D) derivative of the residuals with respect to the parameters.
        residual: (B,) metres.
        positions: (B, 3) metres.
        directions: (B, 3) unit vectors along which the residuals are taken.
        counts: (B,) number of residuals in each mean.
    """

    jacobian: np.ndarray
    residual: np.ndarray
    positions: np.ndarray
    directions: np.ndarray
    counts: np.ndarray


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of estimated parameters.

    Args:
        covariance: (E, E) covariance of the estimates.
        field_m: standard deviation of the errors that are correlated beyond a block.
    """

    covariance: np.ndarray
    field_m: float


def estimate_errors(blocks: Blocks, influence: np.ndarray) -> Errors | None:
    """Estimate the covariance of estimates that depend linearly on the errors of blocks of surface.

    The errors are a displacement field (isotropic, stationary, with an exponential covariance) along the blocks'
    directions, plus independent noise of each block. The fit of D parameters removes a part of the errors, so the field
    is fitted by its restricted likelihood (Patterson and Thompson 1971), which accounts for the part that the fit
    removed: a field of long wavelength leaves small residuals. Fields that few residuals cannot distinguish are
    averaged, weighted by likelihood (Harville 1974: flat priors).

    Args:
        influence: (E, B) derivative of each estimate with respect to the error of each block.

    Returns:
        None where there are hardly more blocks than parameters.
    """
    count, dim = blocks.jacobian.shape
    free = count - dim
    if free < _FREE:
        return None
    noise = np.sqrt(1.0 + SMALL_BLOCK / blocks.counts)  # in these units all blocks have equal noise
    # Orthonormal basis of the space of residuals that no parameter explains.
    rest = np.linalg.qr(blocks.jacobian / noise[:, None], mode="complete")[0][:, dim:]
    left = rest.T @ (blocks.residual / noise)
    distance = np.linalg.norm(blocks.positions[:, None] - blocks.positions[None], axis=2)
    coupling = (blocks.directions @ blocks.directions.T) / np.outer(noise, noise)
    spread = influence * noise
    own, logs, outcomes, fields = spread @ spread.T, [], [], []
    for length in LENGTHS_M:
        field = coupling * np.exp(-distance / length)
        values, vectors = np.linalg.eigh(rest.T @ field @ rest)
        squares, shared = (vectors.T @ left) ** 2, spread @ field @ spread.T
        for share in SHARES:
            spectrum = share * np.maximum(values, 0.0) + 1.0 - share
            chi2 = max(float((squares / spectrum).sum()), 1e-30)
            logs.append(-0.5 * (np.log(spectrum).sum() + free * np.log(chi2)))
            variance = chi2 / (free - 2)
            fields.append(share * variance)
            outcomes.append(variance * (share * shared + (1.0 - share) * own))
    weights = np.exp(np.array(logs) - max(logs))
    weights /= weights.sum()
    return Errors(np.einsum("k,kij->ij", weights, np.array(outcomes)), float(np.sqrt(weights @ np.array(fields))))
