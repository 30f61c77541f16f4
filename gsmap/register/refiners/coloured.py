"""Point-to-plane and colour together, over six or seven degrees of freedom: the refiner for unknown scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import retract
from gsmap.register.covariance import point_to_plane_jacobian
from gsmap.register.surface import Surface
from gsmap.types import Sim3

_COLOUR_RADIUS_M = 0.1  # farther away, lightness extrapolated in a tangent plane means nothing


@dataclass(frozen=True)
class Params:
    """Args (metres):
    radii_m: correspondence distances, coarse to fine.
    iterations: Gauss-Newton steps at each.
    colour_weight: metres of distance that one standard deviation of local colour counts for, at fine radii;
        0 leaves colour out.
    max_points: source cells that take part at each radius.
    """

    radii_m: tuple[float, ...] = (0.4, 0.15, 0.06)
    iterations: int = 10
    colour_weight: float = 0.01
    max_points: tuple[int, ...] = (3000, 6000, 20_000)


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Similarity (or rigid) pose that lays the source's cells on the target's planes and colours (both in metres).

    Iteratively reweighted Gauss-Newton (Geman-McClure over the radius) on the point-to-plane distance and, as in
    Park et al. 2017, on the difference of lightness to the target's, extrapolated in its tangent plane. The source's
    exposure (gain and offset) is fitted along, so a change of it costs nothing.
    """
    params = params or Params()
    pose = start
    anchors = target.coarse[0]
    if len(source) < 10 or len(target) < 10:
        return start
    for radius, count in zip(params.radii_m, params.max_points, strict=True):
        chosen = source.sample(count)
        points, light = source.coarse[0][chosen], source.lightness[chosen]
        for _ in range(params.iterations):
            moved = pose.apply(points)
            distance, row = target.nearest(moved, radius)
            hit = np.flatnonzero(np.isfinite(distance))
            if len(hit) < 10:
                return pose
            row, offset = row[hit], moved[hit] - anchors[row[hit]]
            normals = target.normals[row]
            plane = (normals * offset).sum(1)
            weights = 1.0 / (1.0 + (plane / (0.3 * radius)) ** 2) ** 2
            # About the centroid of the pairs rotation, translation and scale hardly mix, wherever the origin lies.
            centre = points[hit].mean(0)
            centred = pose @ Sim3(np.eye(3), centre)
            jacobian = point_to_plane_jacobian(centred, points[hit] - centre, normals)
            system = (jacobian * weights[:, None]).T @ jacobian
            gradient = (jacobian * weights[:, None]).T @ plane
            if params.colour_weight > 0 and radius <= _COLOUR_RADIUS_M:
                gradients = target.lightness_gradients(row)
                expected = target.lightness[row] + (gradients * offset).sum(1)
                gain, bias = _exposure(expected, light[hit])
                colour = expected - gain * light[hit] - bias
                spread = 1.4826 * np.median(np.abs(colour)) + 1e-6
                factor = params.colour_weight / spread
                tint = weights / (1.0 + (colour / (2 * spread)) ** 2) ** 2
                jacobian = point_to_plane_jacobian(centred, points[hit] - centre, gradients) * factor
                system += (jacobian * tint[:, None]).T @ jacobian
                gradient += (jacobian * tint[:, None]).T @ (colour * factor)
            step = np.zeros(7)
            dim = 7 if with_scale else 6
            damping = 1e-6 * np.diag(np.diag(system)) + 1e-9 * np.eye(7)
            step[:dim] = -np.linalg.solve((system + damping)[:dim, :dim], gradient[:dim])
            # No single step goes farther than the correspondences reach.
            step *= min(1.0, 0.1 / max(np.abs(step[:3]).max(), 1e-12), radius / max(np.abs(step[3:6]).max(), 1e-12))
            step[6] = np.clip(step[6], -0.05, 0.05)
            pose = retract(centred, step if with_scale else step[:6]) @ Sim3(np.eye(3), -centre)
            if abs(np.log(pose.scale / start.scale)) > np.log(1.3):
                return start
            if np.linalg.norm(pose.apply(points[hit]) - moved[hit], axis=1).max() < 0.002 * radius:
                break
    return pose


def _exposure(target: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """Gain and offset that map the source's lightness to the target's, by medians."""
    spread_t = np.median(np.abs(target - np.median(target)))
    spread_s = np.median(np.abs(source - np.median(source)))
    gain = float(np.clip(spread_t / max(spread_s, 1e-6), 0.5, 2.0))
    return gain, float(np.median(target) - gain * np.median(source))
