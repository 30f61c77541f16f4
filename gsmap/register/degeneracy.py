"""Detect degenerate directions: motions of a pose that surfaces leave free, so that only noise of normals constrains
them.

A plane leaves motions along it free. Measured normals are off by some degrees, though, so the normal equations of
point-to-plane distances are never quite singular. Along a façade or a corridor, the gradient of a few pairs at the ends
of the overlap is then divided by a tiny curvature. So the information on every motion is compared with the information
that noise alone would produce (Zhang, Kaess and Singh 2016 use a fixed threshold).
"""

from __future__ import annotations

import numpy as np

from gsmap.geometry.rotations import skew

MIN_SIGNAL = 8.0
"""Smallest information on a constrained motion, in multiples of the information that the noise of normals produces.
Bare façades and corridors reach 5, noisy rooms at least 16, and a façade with a box every ten metres 50."""


def point_information(levers: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """Return the (7, 7) information of point-to-point pairs on [rotation, translation, log scale] about a centre, if
    each point has a variance of 1 square metre.

    Args:
        levers: (N, 3) points less the centre.
        weights: (N,) weights of the pairs; all 1 by default.
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
    """Return the (D, D) projection ``P`` of point-to-plane equations on the motions that surfaces constrain; None if
    they constrain all motions.

    ``P system P^T`` and ``P gradient`` neither constrain nor move a pose along a degenerate direction. The normal of a
    plane through n cells of side a, whose heights have the error ``noise_m / sqrt(2)``, has the error
    ``noise_m sqrt(2 pi) / (n a)`` about each axis (least squares over a disc), whose square seems to constrain motions
    along the plane.

    Args:
        system: (D, D) normal matrix of the plane distances over the first D motions (6: the scale is fixed).
        points: (7, 7) `point_information` of the same pairs, under the same weights.
        noise_m: standard deviation of the plane distances, including the errors of both surfaces.
        resolution_m: side of a cell.
        neighbours: number of cells to which each plane is fitted.
    """
    from scipy.linalg import eigh

    dim = len(system)
    # The second term keeps the matrix regular where points lie on a line, about which they may turn.
    points = points[:dim, :dim] + 1e-9 * np.diag(np.diag(points)[:dim])
    # Distances beyond half a cell come from a pose that is still wrong, not from noise.
    noise = 2 * np.pi * (min(noise_m, resolution_m / 2) / (neighbours * resolution_m)) ** 2
    information, motions = eigh(system, points)
    free = motions[:, information < MIN_SIGNAL * noise]
    if not free.shape[1]:
        return None
    held: np.ndarray = np.eye(dim) - points @ free @ free.T
    return held
