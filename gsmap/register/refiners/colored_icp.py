"""Refine a pose by colored ICP: point-to-plane and colour residuals, with six or seven degrees of freedom."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.rotations import retract
from gsmap.geometry.umeyama import umeyama
from gsmap.methods.refiner import Correspondences, Surface
from gsmap.register.degeneracy import constrained_motions, point_information
from gsmap.register.surface import PLANE_NEIGHBOURS
from gsmap.settings.ranges import require_range
from gsmap.types import Sim3

VERSION = 5
SCALES = True
USES_CORRESPONDENCES = True

_WIDTH = 0.3  # of the radius: distances to planes of this size have a quarter of the full weight
_MAX_RADIUS_SHARE = 0.9  # of the last radius: a pass at a larger radius than this changes nothing
_MIN_PAIRS = 10  # of pairs and of cells; fewer do not constrain a pose
_GREY = 1e-3  # largest range of lightness of a surface without colours, below one 8-bit step
_MIN_NOISE = 0.03  # of the radius: if distances to the planes are smaller, their weight does not grow further
_MIN_SIGMAS = 4.0  # of the distances to the planes: a smaller radius would cut off noise and freeze the pose
_MAX_ITERATIONS = 20  # Gauss-Newton steps at each radius
_COLOUR_RADIUS_M = 0.1  # at larger radii lightness extrapolated in a tangent plane is meaningless
_OVERSTEP = 1.5  # factor on steps: pairs follow the pose only in part, so steps fall short, most along the scale
_MAX_SCALE_CHANGE = 1.3  # from the start's scale; beyond it the start is returned


@dataclass(frozen=True)
class Params:
    """Colored ICP (after Park et al. 2017).

    Args:
        colour_weight: Weight of a colour residual relative to a distance residual, each in standard deviations, at
            least 0; a larger value aligns textures more strongly and 0 ignores colour.
    """

    # A weight of 1 would mean that errors of colours are as independent of each other as errors of points, but a
    # texture is blurred or lit differently as a whole.
    colour_weight: float = 0.3

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "colour_weight")


@dataclass(frozen=True)
class Schedule:
    """The radii of one alignment, coarse to fine.

    Args:
        radii_m: correspondence distances.
        max_points: largest number of cells at each radius, both surfaces together.
        tolerance: the iterations at a radius end when a step moves the pairs by less than this share of the radius.
        last_tolerance: the same for the last radius, where steps shrink slowly, as pairs change from pose to pose.
    """

    radii_m: tuple[float, ...]
    max_points: tuple[int, ...]
    tolerance: float = 0.01
    last_tolerance: float = 0.002


FULL = Schedule((0.4, 0.15, 0.06, 0.03), (3000, 6000, 10_000, 40_000))
SCHEDULES = {
    "coarse": Schedule((0.4, 0.15), (3000, 6000), tolerance=0.02, last_tolerance=0.01),
    "fine": Schedule((0.06, 0.03), (10_000, 40_000)),
}
"""The part of `FULL` that each pass of a registration runs."""


def refine(
    target: Surface,
    source: Surface,
    start: Sim3,
    params: Params | None = None,
    *,
    with_scale: bool = False,
    correspondences: Correspondences | None = None,
    schedule: Schedule = FULL,
) -> Sim3:
    """Align the source's cells with the target's planes and colours (both in metres) by a similarity or rigid pose.

    Iteratively reweighted Gauss-Newton (Geman-McClure over the radius) on point-to-plane distances and, as in Park et
    al. 2017, on the difference between the source's lightness and the target's, extrapolated in its tangent plane. Each
    residual is in units of its own spread. The source's exposure (gain and offset) is fitted as well. Half of the
    points are cells of the target that are aligned with the source's planes. That averages the errors of both surfaces'
    planes; one direction alone prefers a source that is too small, whose points all lie nearer to some surface. Cells
    seen from opposite sides are not paired.

    Planes do not move the pose along degenerate directions (`gsmap.register.degeneracy`): along a façade, pairs at the
    ends of the overlap would pull it by metres. In these directions colours and the correspondences constrain the pose.
    """
    params = params or Params()
    pose = start
    if len(source) < _MIN_PAIRS or len(target) < _MIN_PAIRS:
        return start
    centre = source.coarse[0].mean(0)
    last, noise, dim = np.inf, 0.0, 7 if with_scale else 6
    constraints = None if correspondences is None else PointConstraints(correspondences)
    tolerances = (*[schedule.tolerance] * (len(schedule.radii_m) - 1), schedule.last_tolerance)
    for radius, count, tolerance in zip(schedule.radii_m, schedule.max_points, tolerances, strict=True):
        if last <= _COLOUR_RADIUS_M:
            radius = min(last, max(radius, _MIN_SIGMAS * noise))
            if radius > _MAX_RADIUS_SHARE * last:
                continue
        last = radius
        pairs, degenerate = _Pairs(target, source, count, pose, radius, params), False
        for iteration in range(_MAX_ITERATIONS):
            # About the centroid of the pairs rotation, translation and scale hardly mix.
            found = pairs.equations(pose, centre)
            if found.count < _MIN_PAIRS:
                return pose
            if iteration == 0:
                planes = pairs.equations(pose, centre, coloured=False) if pairs.coloured else found
                degenerate = pairs.constrained(planes, centre, dim)[0] is not None
            if degenerate:
                found = pairs.without_degenerate_pull(found, pose, centre, dim, constraints)
            system, gradient = found.system, found.gradient
            step = np.zeros(7)
            damping = 1e-6 * np.diag(np.diag(system)) + 1e-9 * np.eye(7)
            step[:dim] = -np.linalg.solve((system + damping)[:dim, :dim], gradient[:dim])
            step *= _OVERSTEP
            # No step is longer than the correspondence distance.
            step *= min(1.0, 0.1 / max(np.abs(step[:3]).max(), 1e-12), radius / max(np.abs(step[3:6]).max(), 1e-12))
            step[6] = np.clip(step[6], -0.05, 0.05)
            centred = pose @ Sim3(np.eye(3), centre)
            pose = retract(centred, step if with_scale else step[:6]) @ Sim3(np.eye(3), -centre)
            if abs(np.log(pose.scale / start.scale)) > np.log(_MAX_SCALE_CHANGE):
                return start
            centre = centre + found.middle
            moved = np.r_[step[:3] * found.extent_m, step[3:6], step[6] * found.extent_m]
            if pose.scale * np.linalg.norm(moved) < tolerance * radius:
                break
        noise = found.noise_m
    return pose


def colour_information(
    target: Surface, source: Surface, pose: Sim3, centre: np.ndarray, schedule: Schedule
) -> np.ndarray | None:
    """Return the (7, 7) information that colours add per pair at the last radius, about ``centre`` and in units of the
    variance of the point-to-plane distances; None if the overlap is too small."""
    pairs = _Pairs(target, source, schedule.max_points[-1], pose, schedule.radii_m[-1], Params())
    both, planes = (pairs.equations(pose, centre, coloured=c) for c in (True, False))
    return None if both.count < _MIN_PAIRS else (both.system - planes.system) / (2 * both.pairs)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of pairs.

    Args:
        system, gradient: (7, 7) matrix and (7,) right-hand side.
        count: number of pairs, the smaller of both directions.
        noise_m: robust standard deviation of the point-to-plane distances.
        middle: (3,) mean of the points less the centre.
        extent_m: root mean square distance of the points from the centre.
        pairs: number of pairs that move source cells.
    """

    system: np.ndarray
    gradient: np.ndarray
    count: int
    noise_m: float
    middle: np.ndarray
    extent_m: float
    pairs: int = 0


class _Pairs:
    """Pairs of cells of two surfaces within one radius, in both directions."""

    def __init__(
        self, target: Surface, source: Surface, count: int, start: Sim3, radius_m: float, params: Params
    ) -> None:
        self._forward = _OneWayPairs(target, source, count // 2, start)
        self._reverse = _OneWayPairs(source, target, count // 2, start.inverse(), backward=True)
        self._radius_m, self._params = radius_m, params
        grey = any(np.ptp(surface.lightness) < _GREY for surface in (target, source))
        self.coloured = params.colour_weight > 0 and radius_m <= _COLOUR_RADIUS_M and not grey
        self._resolution_m = max(target.resolution_m, source.resolution_m)

    def equations(self, pose: Sim3, centre: np.ndarray, *, coloured: bool = True) -> _Equations:
        """Return the normal equations of both directions together; both have the same weight, whatever their numbers of
        pairs.

        Args:
            coloured: use colours as well, at radii small enough for them.
        """
        coloured = coloured and self.coloured
        forward = self._forward.equations(pose, centre, self._radius_m, self._params, coloured=coloured)
        reverse = self._reverse.equations(pose.inverse(), centre, self._radius_m, self._params, coloured=coloured)
        share = forward.count / max(reverse.count, 1)
        system, gradient = (
            forward.system + share * reverse.system,
            forward.gradient + share * reverse.gradient,
        )
        return replace(
            forward,
            system=system,
            gradient=gradient,
            count=min(forward.count, reverse.count),
            pairs=forward.count,
        )

    def constrained(self, planes: _Equations, centre: np.ndarray, dim: int) -> tuple[np.ndarray | None, np.ndarray]:
        """Return the (D, D) projection of the planes' equations on the motions that they constrain (None if these are
        all) and the (D, D) information of point-to-point pairs."""
        levers = self._forward.paired_points() - centre
        points = point_information(levers) * (2 * planes.pairs / max(len(levers), 1))
        system = planes.system[:dim, :dim]
        constrained = constrained_motions(system, points, planes.noise_m, self._resolution_m, PLANE_NEIGHBOURS)
        return constrained, points[:dim, :dim]

    def without_degenerate_pull(
        self, found: _Equations, pose: Sim3, centre: np.ndarray, dim: int, constraints: PointConstraints | None
    ) -> _Equations:
        """Return equations in which planes have no effect along degenerate directions and correspondences constrain
        these."""
        planes = self.equations(pose, centre, coloured=False)
        constrained, points = self.constrained(planes, centre, dim)
        if constrained is None:
            return found
        system, gradient = found.system - planes.system, found.gradient - planes.gradient
        # Motions without any constraint are damped to zero.
        system[:dim, :dim] += constrained @ planes.system[:dim, :dim] @ constrained.T + 1e-6 * points
        gradient[:dim] += constrained @ planes.gradient[:dim]
        if constraints is not None:
            noise_m = max(planes.noise_m, _MIN_NOISE * self._radius_m)
            system, gradient = (
                a + b for a, b in zip((system, gradient), constraints.equations(pose, centre, noise_m), strict=True)
            )
        return replace(found, system=system, gradient=gradient)


class PointConstraints:
    """Corresponding points of both surfaces as constraints; their variance is estimated by fitting one similarity to
    them."""

    def __init__(self, correspondences: Correspondences) -> None:
        self._target, self._source = correspondences
        fit = umeyama(self._target, self._source, with_scale=True)
        self._variance = float(((fit.apply(self._source) - self._target) ** 2).mean())

    def equations(self, pose: Sim3, centre: np.ndarray, noise_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return normal equations (7, 7), (7,) about ``centre`` in units of the variance ``noise_m**2``."""
        levers = self._source - centre
        apart = (pose.apply(self._source) - self._target) @ pose.rotation
        weight = noise_m**2 / max(self._variance, noise_m**2, 1e-12)
        pulls = np.concatenate([np.cross(levers, apart), apart, (levers * apart).sum(1, keepdims=True)], axis=1)
        return weight * pose.scale**2 * point_information(levers), weight * pose.scale * pulls.sum(0)


class _OneWayPairs:
    """Pairs of one surface's cells with the nearest cells of another surface within a radius, with cached partners."""

    def __init__(self, onto: Surface, moving: Surface, count: int, start: Sim3, *, backward: bool = False) -> None:
        self._onto, self._moving, self._backward = onto, moving, backward
        self._rows = moving.sample(count)
        self._partners = np.full((len(self._rows), 5), -1.0)
        # Rotated once: normals rotate little from pose to pose, and only their side matters.
        known = onto.oriented_normals is not None and moving.oriented_normals is not None
        self._faces = (onto.oriented_normals, moving.oriented_normals @ start.rotation.T) if known else (None, None)

    def equations(
        self, pose: Sim3, centre: np.ndarray, radius_m: float, params: Params, *, coloured: bool
    ) -> _Equations:
        """Return normal equations for a step about ``centre`` (source frame) under a pose of the moving surface.

        With ``backward`` the target is the moving surface, and a step of the source moves it back.
        """
        from gsmap import _native

        onto, moving = self._onto, self._moving
        found = _native.icp_equations(
            tree=onto.tree,
            normals=onto.normals,
            lightness=onto.lightness,
            gradients=onto.lightness_gradients if coloured else None,
            points=moving.coarse[0],
            own_lightness=moving.lightness,
            rows=self._rows,
            partners=self._partners,
            pose=np.ascontiguousarray(pose.matrix()[:3]),
            centre=centre,
            backward=self._backward,
            radius_m=radius_m,
            width_m=_WIDTH * radius_m,
            colour_weight=params.colour_weight,
            faces=self._faces[0],
            own_faces=self._faces[1],
        )
        return _Equations(*found)

    def paired_points(self) -> np.ndarray:
        """Return the (N, 3) points that have a partner."""
        points: np.ndarray = self._moving.coarse[0][self._rows[self._partners[:, 4] >= 0]]
        return points
