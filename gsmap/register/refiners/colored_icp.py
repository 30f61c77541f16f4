"""Point-to-plane and colour together, over six or seven degrees of freedom: the refiner for unknown scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import retract
from gsmap.methods.refiner import Surface
from gsmap.register.covariance import point_to_plane_jacobian
from gsmap.types import Sim3

VERSION = 2
SCALES = True

_FEWEST = 10  # cells and pairs; fewer tell nothing of a pose


@dataclass(frozen=True)
class Params:
    """Colored ICP (after Park et al. 2017).

    Args:
        radii_m: correspondence distances, coarse to fine.
        least_sigmas: among radii that are fine enough for colour, none is taken that is smaller than this many standard
            deviations of the distances between the planes: it would cut off noise, and hold the pose where it is.
        iterations: Gauss-Newton steps at each radius.
        colour_weight: metres of distance that one standard deviation of local colour counts for, at fine radii;
            0 leaves colour out.
        colour_radius_m: at radii beyond this colour is left out: lightness extrapolated so far in a tangent plane means
            nothing.
        max_points: source cells that take part at each radius.
        overstep: factor on steps: pairs follow the pose only in part, so steps fall short, most of all along the scale.
        max_scale_change: factor by which the scale may move away from the start's before the start is given back.
    """

    radii_m: tuple[float, ...] = (0.4, 0.15, 0.06, 0.03)
    least_sigmas: float = 4.0
    iterations: int = 20
    colour_weight: float = 0.01
    colour_radius_m: float = 0.1
    max_points: tuple[int, ...] = (3000, 6000, 20_000, 20_000)
    overstep: float = 1.5
    max_scale_change: float = 1.3

    def __post_init__(self) -> None:
        if len(self.radii_m) != len(self.max_points):
            raise ConfigError(
                f"colored_icp needs as many max_points as radii_m, got {len(self.max_points)} and {len(self.radii_m)}"
            )


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Similarity (or rigid) pose that lays the source's cells on the target's planes and colours (both in metres).

    Iteratively reweighted Gauss-Newton (Geman-McClure over the radius) on the point-to-plane distance and, as in
    Park et al. 2017, on the difference of lightness to the target's, extrapolated in its tangent plane. The source's
    exposure (gain and offset) is fitted along, so a change of it costs nothing. With scale the target's cells are laid
    on the source's planes as well, half of ``max_points`` each way: one way alone prefers a source that is too small,
    whose points all come nearer to some surface.
    """
    params = params or Params()
    pose = start
    if len(source) < _FEWEST or len(target) < _FEWEST:
        return start
    before, noise = np.inf, 0.0
    for radius, count in zip(params.radii_m, params.max_points, strict=True):
        if before <= params.colour_radius_m:
            radius = min(before, max(radius, params.least_sigmas * noise))
            if radius > 0.9 * before:
                continue
        before = radius
        count = count // 2 if with_scale else count
        chosen, chosen_back = source.sample(count), target.sample(count)
        for _ in range(params.iterations):
            pairs = _Pairs.of(target, source, pose, chosen, radius)
            if len(pairs.points) < _FEWEST:
                return pose
            # About the centroid of the pairs rotation, translation and scale hardly mix, wherever the origin lies.
            centre = pairs.points.mean(0)
            centred, points = pose @ Sim3(np.eye(3), centre), pairs.points - centre
            system, gradient = pairs.equations(partial(point_to_plane_jacobian, centred, points), radius, params)
            if with_scale:
                back = _Pairs.of(source, target, pose.inverse(), chosen_back, radius)
                if len(back.points) < _FEWEST:
                    return pose
                # A step that moves the source forward moves what is laid on it back.
                other = back.equations(partial(_backward_jacobian, back.moved - centre), radius, params)
                share = len(pairs.points) / len(back.points)
                system, gradient = system + share * other[0], gradient + share * other[1]
            step = np.zeros(7)
            dim = 7 if with_scale else 6
            damping = 1e-6 * np.diag(np.diag(system)) + 1e-9 * np.eye(7)
            step[:dim] = -np.linalg.solve((system + damping)[:dim, :dim], gradient[:dim])
            step *= params.overstep
            # No single step goes farther than the correspondences reach.
            step *= min(1.0, 0.1 / max(np.abs(step[:3]).max(), 1e-12), radius / max(np.abs(step[3:6]).max(), 1e-12))
            step[6] = np.clip(step[6], -0.05, 0.05)
            pose = retract(centred, step if with_scale else step[:6]) @ Sim3(np.eye(3), -centre)
            if abs(np.log(pose.scale / start.scale)) > np.log(params.max_scale_change):
                return start
            if np.linalg.norm(pose.apply(pairs.points) - pairs.moved, axis=1).max() < 0.002 * radius:
                break
        noise = pairs.noise_m
    return pose


def _backward_jacobian(points: np.ndarray, along: np.ndarray) -> np.ndarray:
    return point_to_plane_jacobian(Sim3.identity(), points, -along)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """R cells of one surface that a pose brings near another, and the cells there that they fall on.

    Args:
        onto: the surface they are laid on.
        rows: (R,) cells of it.
        points, lightness: (R, 3), (R,) the cells that move, in their own frame.
        moved: (R, 3) the same in the frame of ``onto``.
    """

    onto: Surface
    rows: np.ndarray
    points: np.ndarray
    lightness: np.ndarray
    moved: np.ndarray

    @classmethod
    def of(cls, onto: Surface, moving: Surface, pose: Sim3, chosen: np.ndarray, radius_m: float) -> _Pairs:
        points = moving.coarse[0][chosen]
        moved = pose.apply(points)
        distance, rows = onto.nearest(moved, radius_m)
        hit = np.flatnonzero(np.isfinite(distance))
        return cls(onto, rows[hit], points[hit], moving.lightness[chosen[hit]], moved[hit])

    @property
    def noise_m(self) -> float:
        """Robust standard deviation of the distances to the planes."""
        offset = self.moved - self.onto.coarse[0][self.rows]
        return 1.4826 * float(np.median(np.abs((self.onto.normals[self.rows] * offset).sum(1))))

    def equations(
        self, jacobian: Callable[[np.ndarray], np.ndarray], radius_m: float, params: Params
    ) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations (7, 7), (7,); ``jacobian`` of the moved points along given directions (R, 3)."""
        offset = self.moved - self.onto.coarse[0][self.rows]
        normals = self.onto.normals[self.rows]
        plane = (normals * offset).sum(1)
        weights = 1.0 / (1.0 + (plane / (0.3 * radius_m)) ** 2) ** 2
        slope = jacobian(normals)
        system = (slope * weights[:, None]).T @ slope
        gradient = (slope * weights[:, None]).T @ plane
        if params.colour_weight > 0 and radius_m <= params.colour_radius_m:
            gradients = self.onto.lightness_gradients(self.rows)
            expected = self.onto.lightness[self.rows] + (gradients * offset).sum(1)
            gain, bias = _exposure(expected, self.lightness)
            colour = expected - gain * self.lightness - bias
            spread = 1.4826 * np.median(np.abs(colour)) + 1e-6
            factor = params.colour_weight / spread
            tint = weights / (1.0 + (colour / (2 * spread)) ** 2) ** 2
            slope = jacobian(gradients) * factor
            system += (slope * tint[:, None]).T @ slope
            gradient += (slope * tint[:, None]).T @ (colour * factor)
        return system, gradient


def _exposure(target: np.ndarray, source: np.ndarray) -> tuple[float, float]:
    """Gain and offset that map the source's lightness to the target's, by medians."""
    spread_t = np.median(np.abs(target - np.median(target)))
    spread_s = np.median(np.abs(source - np.median(source)))
    gain = float(np.clip(spread_t / max(spread_s, 1e-6), 0.5, 2.0))
    return gain, float(np.median(target) - gain * np.median(source))
