"""Detect degenerate directions: motions of a pose that surfaces leave free and only noise of normals constrains.

A plane leaves motions along it free. Measured normals are off by some degrees, though, so the normal equations of
point-to-plane distances are never quite singular. Along a street's front or a corridor, the gradient of a few pairs at
the overlap's ends is then divided by next to nothing. So the information on every motion is compared with that
which the noise alone would produce (Zhang, Kaess and Singh 2016 compare it with a fixed threshold).
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import skew

MIN_SIGNAL = 8.0
"""Smallest information on a constrained motion, in multiples of that which the noise of normals produces: bare
fronts and corridors reach 5; noisy rooms 16 and more, and a front with a box every ten metres 50."""


def point_information(levers: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Return the (7, 7) information of point-to-point pairs on [rotation, translation, log scale] about a centre, for
    points of unit variance (1 square metre).

    Args:
        levers: (N, 3) points less the centre.
        weights: (N,) of the pairs; all 1 by default.
    """
    weights = np.ones(len(levers)) if weights is None else weights
    squares, total = (levers * weights[:, None]).T @ levers, weights @ levers
    out = np.zeros((7, 7))
    out[:3, :3] = np.trace(squares) * np.eye(3) - squares
    out[:3, 3:6], out[3:6, :3] = skew(total), -skew(total)
    out[3:6, 3:6] = weights.sum() * np.eye(3)
    out[3:6, 6] = out[6, 3:6] = total
    out[6, 6] = np.trace(squares)
    return out


def constrained_motions(
    system: np.ndarray, points: np.ndarray, noise_m: float, resolution_m: float, neighbours: int
) -> np.ndarray | None:
    """Return the (D, D) projection ``P`` of point-to-plane equations on the motions that surfaces constrain; None
    where they constrain all.

    ``P system P^T`` and ``P gradient`` neither constrain nor move a pose along a degenerate direction. The normal of a
    plane through n cells of side a, whose heights have the error ``noise_m / sqrt(2)``, has the error
    ``noise_m sqrt(2 pi) / (n a)`` about each axis (least squares over a disc), whose square constrains the sliding.

    Args:
        system: (D, D) normal matrix of the plane distances over the first D motions (6: the scale is fixed).
        points: (7, 7) `point_information` of the same pairs, under the same weights.
        noise_m: standard deviation of the plane distances, errors of both surfaces together.
        resolution_m: side of a cell.
        neighbours: cells that a plane is fitted to.
    """
    from scipy.linalg import eigh

    dim = len(system)
    points = points[:dim, :dim] + 1e-9 * np.diag(np.diag(points)[:dim])  # points on a line turn about it
    # Distances beyond half a cell are those of a pose that is still off, not of noise.
    noise = 2 * np.pi * (min(noise_m, resolution_m / 2) / (neighbours * resolution_m)) ** 2
    information, motions = eigh(system, points)
    free = motions[:, information < MIN_SIGNAL * noise]
    if not free.shape[1]:
        return None
    held: np.ndarray = np.eye(dim) - points @ free @ free.T
    return held
