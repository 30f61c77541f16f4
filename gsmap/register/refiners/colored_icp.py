"""Point-to-plane and colour together, over six or seven degrees of freedom: the refiner for unknown scale."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import retract
from gsmap.geometry.umeyama import umeyama
from gsmap.methods.refiner import Correspondences, Surface
from gsmap.register.degeneracy import held_motions, point_information
from gsmap.register.surface import PLANE_NEIGHBOURS
from gsmap.types import Sim3

VERSION = 5
SCALES = True
USES_CORRESPONDENCES = True

_WIDTH = 0.3  # of the radius: distances to planes of this count a quarter
_HARDLY_FINER = 0.9  # of the last radius: another pass would tell nothing new
_FEWEST = 10  # cells and pairs; fewer tell nothing of a pose
_GREY = 1e-3  # range of lightness, less than a step of 8 bits: rounding errors are no colours
_LEAST_NOISE = 0.03  # of the radius: planes that fit better than this leave other terms their weight, as colours'


_MIN_SIGMAS = 4.0  # of the distances between the planes: a smaller radius would cut off noise and hold the pose
_MAX_ITERATIONS = 20  # Gauss-Newton steps at each radius
_COLOUR_RADIUS_M = 0.1  # at larger radii lightness extrapolated in a tangent plane means nothing
_OVERSTEP = 1.5  # factor on steps: pairs follow the pose only in part, so steps fall short, most along the scale
_MAX_SCALE_CHANGE = 1.3  # from the start's scale; beyond it the start is returned


@dataclass(frozen=True)
class Params:
    """Colored ICP (after Park et al. 2017).

    Args:
        colour_weight: Weight of a colour residual relative to a distance residual, each in standard deviations, at
            least 0; a larger value aligns textures more strongly and 0 ignores colour.
    """

    # 1 were errors of colours as independent of each other as those of points, but a texture is blurred or lit
    # otherwise as a whole.
    colour_weight: float = 0.3

    def __post_init__(self) -> None:
        if not self.colour_weight >= 0:
            raise ConfigError(f"colour_weight must not be negative, got {self.colour_weight}", code="out_of_range")


@dataclass(frozen=True)
class Schedule:
    """The radii of one alignment, coarse to fine.

    Args:
        radii_m: correspondence distances.
        max_points: cells of both surfaces together at each radius.
        tolerance: a radius ends when a step moves the pairs by less than this share of it ...
        last_tolerance: ... and the last radius by less than this: pairs change from pose to pose, and steps shrink
            slowly.
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
    """Similarity (or rigid) pose that lays the source's cells on the target's planes and colours (both in metres).

    Iteratively reweighted Gauss-Newton (Geman-McClure over the radius) on the point-to-plane distance and, as in
    Park et al. 2017, on the difference of lightness to the target's, extrapolated in its tangent plane; each in units
    of its own spread, so that what is measured better counts more. The source's exposure (gain and offset) is fitted
    along, so a change of it costs nothing. The target's cells are laid on the source's planes as well, half of
    ``max_points`` each way: that averages the errors of both surfaces' planes, and one way alone prefers a source that
    is too small, whose points all come nearer to some surface. A cell is not laid on one whose other side was seen.

    Planes move the pose along no motion that they leave free (`gsmap.register.degeneracy`): along a street's front,
    pairs at the ends of the overlap would pull it by metres. Colours decide there and, at every radius, the
    correspondences.
    """
    params = params or Params()
    pose = start
    if len(source) < _FEWEST or len(target) < _FEWEST:
        return start
    centre = source.coarse[0].mean(0)
    last, noise, dim = np.inf, 0.0, 7 if with_scale else 6
    ties = None if correspondences is None else Ties(correspondences)
    tolerances = (*[schedule.tolerance] * (len(schedule.radii_m) - 1), schedule.last_tolerance)
    for radius, count, tolerance in zip(schedule.radii_m, schedule.max_points, tolerances, strict=True):
        if last <= _COLOUR_RADIUS_M:
            radius = min(last, max(radius, _MIN_SIGMAS * noise))
            if radius > _HARDLY_FINER * last:
                continue
        last = radius
        pairs, degenerate = _Pairs(target, source, count, pose, radius, params), False
        for iteration in range(_MAX_ITERATIONS):
            # About the centroid of the pairs rotation, translation and scale hardly mix, wherever the origin lies.
            found = pairs.equations(pose, centre)
            if found.count < _FEWEST:
                return pose
            if iteration == 0:
                planes = pairs.equations(pose, centre, coloured=False) if pairs.coloured else found
                degenerate = pairs.held(planes, centre, dim)[0] is not None
            if degenerate:
                found = pairs.without_degenerate_pull(found, pose, centre, dim, ties)
            system, gradient = found.system, found.gradient
            step = np.zeros(7)
            damping = 1e-6 * np.diag(np.diag(system)) + 1e-9 * np.eye(7)
            step[:dim] = -np.linalg.solve((system + damping)[:dim, :dim], gradient[:dim])
            step *= _OVERSTEP
            # No single step goes farther than the correspondences reach.
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
    """(7, 7) information about ``centre`` that colours add to a pair's plane distance at the last radius, in units of
    that distance's variance; None where too little overlaps."""
    pairs = _Pairs(target, source, schedule.max_points[-1], pose, schedule.radii_m[-1], Params())
    both, planes = (pairs.equations(pose, centre, coloured=c) for c in (True, False))
    return None if both.count < _FEWEST else (both.system - planes.system) / (2 * both.pairs)


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations (7, 7), (7,) of some pairs, how many these are, how far from the planes (robust standard
    deviation), their mean less the centre, (3,), and their root mean square distance from it; ``pairs``: how many of
    the source there are, where ``count`` is the smaller of both ways."""

    system: np.ndarray
    gradient: np.ndarray
    count: int
    noise_m: float
    middle: np.ndarray
    extent_m: float
    pairs: int = 0


class _Pairs:
    """Pairs of two surfaces' cells within one radius, each surface laid on the other."""

    def __init__(
        self, target: Surface, source: Surface, count: int, start: Sim3, radius_m: float, params: Params
    ) -> None:
        self._there = _Laid(target, source, count // 2, start)
        self._back = _Laid(source, target, count // 2, start.inverse(), backward=True)
        self._radius_m, self._params = radius_m, params
        grey = any(np.ptp(surface.lightness) < _GREY for surface in (target, source))
        self.coloured = params.colour_weight > 0 and radius_m <= _COLOUR_RADIUS_M and not grey
        self._resolution_m = max(target.resolution_m, source.resolution_m)

    def equations(self, pose: Sim3, centre: np.ndarray, *, coloured: bool = True) -> _Equations:
        """Both ways together: either counts as much, however many cells found a partner.

        Args:
            coloured: with colours, at radii at which they count.
        """
        coloured = coloured and self.coloured
        there = self._there.equations(pose, centre, self._radius_m, self._params, coloured=coloured)
        back = self._back.equations(pose.inverse(), centre, self._radius_m, self._params, coloured=coloured)
        share = there.count / max(back.count, 1)
        system, gradient = there.system + share * back.system, there.gradient + share * back.gradient
        return replace(there, system=system, gradient=gradient, count=min(there.count, back.count), pairs=there.count)

    def held(self, planes: _Equations, centre: np.ndarray, dim: int) -> tuple[np.ndarray | None, np.ndarray]:
        """(D, D) projection of the planes' equations on the motions that they hold, None where they hold all, and
        (D, D) the information of points held in all directions."""
        levers = self._there.paired_points() - centre
        points = point_information(levers) * (2 * planes.pairs / max(len(levers), 1))
        system = planes.system[:dim, :dim]
        held = held_motions(system, points, planes.noise_m, self._resolution_m, PLANE_NEIGHBOURS)
        return held, points[:dim, :dim]

    def without_degenerate_pull(
        self, found: _Equations, pose: Sim3, centre: np.ndarray, dim: int, ties: Ties | None
    ) -> _Equations:
        """Equations whose planes neither hold nor move a motion that they leave free, with the correspondences'."""
        planes = self.equations(pose, centre, coloured=False)
        held, points = self.held(planes, centre, dim)
        if held is None:
            return found
        system, gradient = found.system - planes.system, found.gradient - planes.gradient
        # What nothing holds stays where it is.
        system[:dim, :dim] += held @ planes.system[:dim, :dim] @ held.T + 1e-6 * points
        gradient[:dim] += held @ planes.gradient[:dim]
        if ties is not None:
            noise_m = max(planes.noise_m, _LEAST_NOISE * self._radius_m)
            system, gradient = (
                a + b for a, b in zip((system, gradient), ties.equations(pose, centre, noise_m), strict=True)
            )
        return replace(found, system=system, gradient=gradient)


class Ties:
    """Points of both surfaces that are the same, each known as well as all of them fit one similarity."""

    def __init__(self, correspondences: Correspondences) -> None:
        self._target, self._source = correspondences
        fit = umeyama(self._target, self._source, with_scale=True)
        self._variance = float(((fit.apply(self._source) - self._target) ** 2).mean())

    def equations(self, pose: Sim3, centre: np.ndarray, noise_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations (7, 7), (7,) about ``centre``, in units of the variance of the distances to the planes."""
        levers = self._source - centre
        apart = (pose.apply(self._source) - self._target) @ pose.rotation
        weight = noise_m**2 / max(self._variance, noise_m**2, 1e-12)
        pulls = np.concatenate([np.cross(levers, apart), apart, (levers * apart).sum(1, keepdims=True)], axis=1)
        return weight * pose.scale**2 * point_information(levers), weight * pose.scale * pulls.sum(0)


class _Laid:
    """Cells of one surface laid on another by a pose, each on the nearest within one radius; what is known is kept."""

    def __init__(self, onto: Surface, moving: Surface, count: int, start: Sim3, *, backward: bool = False) -> None:
        self._onto, self._moving, self._backward = onto, moving, backward
        self._rows = moving.sample(count)
        self._partners = np.full((len(self._rows), 5), -1.0)
        # Turned once: from pose to pose faces turn by less than anything that is told by them.
        known = onto.faces is not None and moving.faces is not None
        self._faces = (onto.faces, moving.faces @ start.rotation.T) if known else (None, None)

    def equations(
        self, pose: Sim3, centre: np.ndarray, radius_m: float, params: Params, *, coloured: bool
    ) -> _Equations:
        """Under a pose that takes what moves into the frame of the other, for a step about ``centre`` (source frame).

        A step that moves the source forward moves what is laid on it (``backward``) back.
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
        """(N, 3) points that found a partner."""
        points: np.ndarray = self._moving.coarse[0][self._rows[self._partners[:, 4] >= 0]]
        return points
