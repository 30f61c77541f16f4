"""Point-to-plane and colour together, over six or seven degrees of freedom: the refiner for unknown scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import retract
from gsmap.methods.refiner import Surface
from gsmap.types import Sim3

VERSION = 4
SCALES = True

_WIDTH = 0.3  # of the radius: distances to planes of this count a quarter
_HARDLY_FINER = 0.9  # of the last radius: another pass would tell nothing new
_FEWEST = 10  # cells and pairs; fewer tell nothing of a pose


@dataclass(frozen=True)
class Params:
    """Colored ICP (after Park et al. 2017).

    Args:
        radii_m: correspondence distances, coarse to fine.
        least_sigmas: among radii that are fine enough for colour, none is taken that is smaller than this many standard
            deviations of the distances between the planes: it would cut off noise, and hold the pose where it is.
        iterations: Gauss-Newton steps at each radius.
        colour_weight: how many standard deviations of the distances to the planes one of local colour counts for, at
            fine radii: 1 were errors of colours as independent of each other as those of points, but a texture is
            blurred or lit otherwise as a whole; 0 leaves colour out.
        colour_radius_m: at radii beyond this colour is left out: lightness extrapolated so far in a tangent plane means
            nothing.
        max_points: cells of both surfaces together that take part at each radius.
        tolerance: a radius is done with when a step moves the pairs by less than this share of it ...
        last_tolerance: ... and the last one by less than this: from pose to pose pairs change, and steps shrink slowly.
        overstep: factor on steps: pairs follow the pose only in part, so steps fall short, most of all along the scale.
        max_scale_change: factor by which the scale may move away from the start's before the start is given back.
    """

    radii_m: tuple[float, ...] = (0.4, 0.15, 0.06, 0.03)
    least_sigmas: float = 4.0
    iterations: int = 20
    colour_weight: float = 0.3
    colour_radius_m: float = 0.1
    max_points: tuple[int, ...] = (3000, 6000, 10_000, 40_000)
    tolerance: float = 0.01
    last_tolerance: float = 0.002
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
    Park et al. 2017, on the difference of lightness to the target's, extrapolated in its tangent plane; each in units
    of its own spread, so that what is measured better counts more. The source's exposure (gain and offset) is fitted
    along, so a change of it costs nothing. The target's cells are laid on the source's planes as well, half of
    ``max_points`` each way: that averages the errors of both surfaces' planes, and one way alone prefers a source that
    is too small, whose points all come nearer to some surface. A cell is not laid on one whose other side was seen.
    """
    params = params or Params()
    pose = start
    if len(source) < _FEWEST or len(target) < _FEWEST:
        return start
    centre = source.coarse[0].mean(0)
    last, noise = np.inf, 0.0
    tolerances = (*[params.tolerance] * (len(params.radii_m) - 1), params.last_tolerance)
    for radius, count, tolerance in zip(params.radii_m, params.max_points, tolerances, strict=True):
        if last <= params.colour_radius_m:
            radius = min(last, max(radius, params.least_sigmas * noise))
            if radius > _HARDLY_FINER * last:
                continue
        last = radius
        there = _Laid(target, source, count // 2, pose)
        back = _Laid(source, target, count // 2, pose.inverse(), backward=True)
        for _ in range(params.iterations):
            # About the centroid of the pairs rotation, translation and scale hardly mix, wherever the origin lies.
            found = there.equations(pose, centre, radius, params)
            other = back.equations(pose.inverse(), centre, radius, params)
            if min(found.count, other.count) < _FEWEST:
                return pose
            share = found.count / other.count  # either way counts as much, however many cells found a partner
            system, gradient = found.system + share * other.system, found.gradient + share * other.gradient
            step = np.zeros(7)
            dim = 7 if with_scale else 6
            damping = 1e-6 * np.diag(np.diag(system)) + 1e-9 * np.eye(7)
            step[:dim] = -np.linalg.solve((system + damping)[:dim, :dim], gradient[:dim])
            step *= params.overstep
            # No single step goes farther than the correspondences reach.
            step *= min(1.0, 0.1 / max(np.abs(step[:3]).max(), 1e-12), radius / max(np.abs(step[3:6]).max(), 1e-12))
            step[6] = np.clip(step[6], -0.05, 0.05)
            centred = pose @ Sim3(np.eye(3), centre)
            pose = retract(centred, step if with_scale else step[:6]) @ Sim3(np.eye(3), -centre)
            if abs(np.log(pose.scale / start.scale)) > np.log(params.max_scale_change):
                return start
            centre = centre + found.middle
            moved = np.r_[step[:3] * found.extent_m, step[3:6], step[6] * found.extent_m]
            if pose.scale * np.linalg.norm(moved) < tolerance * radius:
                break
        noise = found.noise_m
    return pose


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations (7, 7), (7,) of some pairs, how many these are, how far from the planes (robust standard
    deviation), their mean less the centre, (3,), and their root mean square distance from it."""

    system: np.ndarray
    gradient: np.ndarray
    count: int
    noise_m: float
    middle: np.ndarray
    extent_m: float


class _Laid:
    """Cells of one surface laid on another by a pose, each on the nearest within one radius; what is known is kept."""

    def __init__(self, onto: Surface, moving: Surface, count: int, start: Sim3, *, backward: bool = False) -> None:
        self._onto, self._moving, self._backward = onto, moving, backward
        self._rows = moving.sample(count)
        self._partners = np.full((len(self._rows), 5), -1.0)
        # Turned once: from pose to pose faces turn by less than anything that is told by them.
        known = onto.faces is not None and moving.faces is not None
        self._faces = (onto.faces, moving.faces @ start.rotation.T) if known else (None, None)

    def equations(self, pose: Sim3, centre: np.ndarray, radius_m: float, params: Params) -> _Equations:
        """Under a pose that takes what moves into the frame of the other, for a step about ``centre`` (source frame).

        A step that moves the source forward moves what is laid on it (``backward``) back.
        """
        from gsmap import _native

        coloured = params.colour_weight > 0 and radius_m <= params.colour_radius_m
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
