"""Estimate the covariance of a refined pose."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np

from gsmap.geometry.cells import cell_labels
from gsmap.geometry.rotations import retract, skew
from gsmap.geometry.similarities import Similarities
from gsmap.methods.refiner import Correspondences
from gsmap.register import error_field
from gsmap.register.degeneracy import constrained_motions, point_information
from gsmap.register.refiners import colored_icp
from gsmap.register.surface import PLANE_NEIGHBOURS, Surface
from gsmap.register.unit_scale import ScaleDecision
from gsmap.types import Sim3

BLOCK_M = 0.3  # residuals within a cell of this size, on surfaces of one orientation, count as one measurement
# Pairs farther apart than this are ignored; beyond a third of it their weight falls, as in refinement.
RADIUS_M = 0.08
_MAX_BLOCKS = 200  # cells are enlarged until there are at most this many
# The pose is displaced by this distance in both directions of each motion (rotation and scale: at the overlap's
# radius); the residuals of this many cells then give the curvature.
_PROBE_M = 0.01
_PROBE_POINTS = 6000
_COLOUR_PARAMS = colored_icp.Params(colour_weight=3.0)  # ten times that of refinement
_COLOUR_PASS = colored_icp.Schedule((0.06,), (10_000,), last_tolerance=0.01)  # one radius, for a tenth of a pair's cost
_MIN_CELLS = 20  # cells that coincide
_MIN_BLOCK_COUNT = 3.0
_MIN_LOG_SCALE_SIGMA = 1e-6  # keeps the matrix regular
_MIN_CONSTRAINED = 0.1  # smallest share of a motion's Gauss-Newton curvature, as surfaces constrain it beyond the probe
# Correspondences follow surface errors as they follow motions. Both effects cancel, except that residuals then
# understate the errors. In synthetic places with known errors half of the effect cancels.
_CANCELLED_SHARE = 0.5
_WIDTH = 0.3  # of the radius: pairs at this distance from the planes have a quarter of the full weight
_CLIP = 3.0  # standard deviations: larger residuals are changes of the place, not errors


@dataclass(frozen=True)
class UnobservedErrors:
    """Standard deviations of pose errors that leave no residual (bias of a trainer, distorted depths of a sensor).

    A model fitted to synthetic places by ``tools/fit/covariance.py``, stored in ``covariance.json``; a new fit needs a
    new `gsmap.register.recipe.VERSION`. The *colour motion* is the motion by which colours alone would move a pose. The
    *field* is the displacement field of spatially correlated surface errors (`error_field`).

    Args:
        residual_factor: factor on the standard deviation estimated from the residuals.
        colour_share: error of rotations and translations per unit of colour motion.
        colour_scale_share: error of the log scale per unit of colour motion.
        shift_m: error of translations where the field has the size ``field_m``.
        scale_error_m: error of the log scale times the overlap's radius where the field has the size ``field_m``.
        field_m: reference size of the field.
        field_power: exponent with which both errors grow with the size of the field.
        shift_per_scale: error of translations per scale error times the overlap's radius: a sensor with scaled depths
            also distorts them.
        rotation_per_shift: error of rotations times the overlap's radius, per error of translations.
        max_scale_sigma: upper limit of the error of the log scale; hardly any sensor exceeds it.
        min_shift_m: lower limit of the error of translations, and of rotations times the overlap's radius.
    """

    residual_factor: float
    colour_share: float
    colour_scale_share: float
    shift_m: float
    scale_error_m: float
    field_m: float
    field_power: float
    shift_per_scale: float
    rotation_per_shift: float
    max_scale_sigma: float
    min_shift_m: float


@cache
def load_model(*, coloured: bool) -> UnobservedErrors:
    """Load the fitted model: one for surfaces with colours, one for surfaces without."""
    stored = json.loads((files("gsmap.register") / "covariance.json").read_text())
    return UnobservedErrors(**stored["coloured" if coloured else "grey"])


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """The uncertainty of a pose.

    Args:
        covariance: (7, 7) over [rot_rad, trans_m, log_scale] applied on the source side.
        sigmas: standard deviations (rad, metres, log scale) of rotation and translation, each in its least certain
            direction at the overlap's centroid, and of the scale.
    """

    covariance: np.ndarray
    sigmas: tuple[float, float, float]

    @classmethod
    def about(cls, covariance: np.ndarray, centroid: np.ndarray, scale: float) -> PoseUncertainty:
        """Return the uncertainty from a covariance (7, 7) about the overlap's centroid (3,), moved to the source's
        origin."""
        sigmas = (
            float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
            float(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])) * scale,
            float(np.sqrt(covariance[6, 6])),
        )
        back = np.linalg.inv(_shift(centroid))
        covariance = back @ covariance @ back.T
        return cls(0.5 * (covariance + covariance.T), sigmas)


@dataclass(frozen=True, eq=False)
class Conditioning:
    """Sensitivity of a refined pose to surface errors and to its scale.

    Args:
        scaled: (7, 7) covariance of the pose with a refined scale, about the overlap's centroid, from the residuals.
        rigid: (6, 6) the same covariance, of the pose with the true scale.
        scale_coupling: (7,) derivative of the refined pose with respect to the logarithm of its scale.
        centroid: (3,) centroid of the overlap in the source's frame, in metres.
        field_m: standard deviation of the surface errors that are correlated beyond a block.
        radius_m: radius of the overlap.
        colour_motion: (7,) motion about the centroid by which colours would move the pose; None without colours.
        unobserved: the model of errors that leave no residual.
        free_covariance: (7, 7) and (6, 6) covariances that are added to ``scaled`` and ``rigid`` along degenerate
            directions, which only colours and correspondences constrain, if anything.
    """

    scaled: np.ndarray
    rigid: np.ndarray
    scale_coupling: np.ndarray
    centroid: np.ndarray
    field_m: float
    radius_m: float
    colour_motion: np.ndarray | None
    unobserved: UnobservedErrors
    free_covariance: tuple[np.ndarray, np.ndarray]

    @property
    def log_scale_sigma(self) -> float:
        """Standard deviation of the logarithm of the refined scale."""
        return float(np.sqrt(self.covariance_with_scale(1.0)[6, 6]))

    def covariance_with_scale(self, scale: float) -> np.ndarray:
        """Return the (7, 7) covariance of the pose with a refined scale, about the overlap's centroid."""
        swell = unobserved_log_scale(self.field_m, self.radius_m, self.colour_motion, self.unobserved)
        unobserved = np.r_[self._unobserved(swell, scale, self.colour_motion), swell]
        return self.unobserved.residual_factor**2 * self.scaled + self.free_covariance[0] + np.diag(unobserved**2)

    def covariance_of_rigid(
        self, scale: float, swell: float, log_scale_sigma: float, colour_motion: np.ndarray | None
    ) -> np.ndarray:
        """Return the (7, 7) covariance of a pose with a given scale, about the overlap's centroid.

        Args:
            swell: logarithm of the measured scale divided by the given scale; a large value indicates unobserved
                errors.
            log_scale_sigma: standard deviation of the given scale's logarithm.
            colour_motion: motion by which colours would move this pose; None without colours.
        """
        out = np.zeros((7, 7))
        unobserved = self._unobserved(abs(swell), scale, colour_motion)
        out[:6, :6] = self.unobserved.residual_factor**2 * self.rigid + self.free_covariance[1] + np.diag(unobserved**2)
        out += np.outer(self.scale_coupling, self.scale_coupling) * max(log_scale_sigma, _MIN_LOG_SCALE_SIGMA) ** 2
        return out

    def uncertainty(
        self, pose: Sim3, decision: ScaleDecision | None = None, colour_motion: np.ndarray | None = None
    ) -> PoseUncertainty:
        """Return the uncertainty of a pose in metres. If the scale decision is rigid, it is that of the rigid pose,
        which colours would move by ``colour_motion``; otherwise it is that of the pose with the refined scale."""
        if decision is None or not decision.rigid:
            covariance = self.covariance_with_scale(pose.scale)
        else:
            covariance = self.covariance_of_rigid(
                pose.scale, decision.log_scale, decision.log_scale_sigma, colour_motion
            )
        return PoseUncertainty.about(covariance, self.centroid, pose.scale)

    def rescaled(self, pose: Sim3, scale: float) -> Sim3:
        """Change the scale of a pose, and move the pose as refinement under the new scale would."""
        step = np.log(scale / pose.scale) * self.scale_coupling
        centre = Sim3(np.eye(3), self.centroid)
        return retract(pose @ centre, step) @ centre.inverse()

    def _unobserved(self, swell: float, scale: float, colour_motion: np.ndarray | None) -> np.ndarray:
        """Return the (6,) standard deviations of rotation and translation (in the source's unit) due to unobserved
        errors."""
        turn, shift = unobserved_motion(self.field_m, self.radius_m, swell, self.unobserved)
        out = np.r_[np.full(3, turn), np.full(3, shift / scale)]
        if colour_motion is None:
            return out
        moved_by_colour = np.sqrt([(colour_motion[:3] ** 2).mean(), (colour_motion[3:6] ** 2).mean()])
        return np.hypot(out, self.unobserved.colour_share * np.repeat(moved_by_colour, 3))


def condition(
    target: Surface,
    source: Surface,
    pose: Sim3,
    correspondences: Correspondences | None = None,
    unobserved: UnobservedErrors | None = None,
) -> Conditioning | None:
    """Compute the sensitivity of a refined pose (metres) to surface errors; None where the overlap is too small.

    An ICP Hessian is overconfident 10 to 900 times on splats, because the errors of neighbouring points are correlated.
    So the point-to-plane residuals are averaged over blocks, `error_field` estimates their spatial correlation, and the
    covariance is ``A K A^T`` for errors of covariance K, where A is the derivative of the pose with respect to each
    block's error (implicit function theorem). A fitted model adds the errors that leave no residual
    (`UnobservedErrors`).

    Along degenerate directions (`degeneracy`) colours and the ``correspondences`` constrain the pose, as in refinement;
    where nothing constrains it, its error is as large as the overlap.
    """
    blocks = PairBlocks.of(target, source, pose)
    if blocks is None:
        return None
    hessian = _measured_hessian(target, source, pose, blocks)
    pull = (blocks.jacobian * blocks.weights[:, None]).T
    free_covariance = np.zeros((7, 7)), np.zeros((6, 6))
    constrained = constrained_motions(
        blocks.hessian, blocks.points, blocks.noise_m, _resolution_m(target, source), PLANE_NEIGHBOURS
    )
    if constrained is not None:
        others, errors_of_others = _other_information(target, source, pose, blocks, correspondences)
        hessian, pull = constrained @ hessian @ constrained.T + others, constrained @ pull
        inverse, rigid = np.linalg.inv(hessian), np.linalg.inv(hessian[:6, :6])
        free_covariance = inverse @ errors_of_others @ inverse, rigid @ errors_of_others[:6, :6] @ rigid
    influence = np.concatenate([np.linalg.solve(hessian, pull), np.linalg.solve(hessian[:6, :6], pull[:6])])
    errors = error_field.estimate_errors(blocks, influence)
    if errors is None:
        return None
    colour_motion = find_colour_motion(target, source, pose, blocks.centroid, with_scale=True)
    return Conditioning(
        scaled=errors.covariance[:7, :7],
        rigid=errors.covariance[7:, 7:],
        scale_coupling=np.r_[-np.linalg.solve(hessian[:6, :6], hessian[:6, 6]), 1.0],
        centroid=blocks.centroid,
        field_m=errors.field_m,
        radius_m=blocks.radius_m,
        colour_motion=colour_motion,
        unobserved=unobserved or load_model(coloured=colour_motion is not None),
        free_covariance=free_covariance,
    )


def uncertainty_of_correspondences(
    correspondences: Correspondences, pose: Sim3, block_m: float = BLOCK_M
) -> PoseUncertainty:
    """Return the uncertainty of a pose (metres) that was fitted to correspondences, from the residuals of these."""
    target, source = correspondences
    centroid = source.mean(0)
    information = pose.scale**2 * point_information(source - centroid)
    variance = ((pose.apply(source) - target) ** 2).mean() * _repeats(target, block_m)
    return PoseUncertainty.about(np.linalg.pinv(information, hermitian=True) * variance, centroid, pose.scale)


def _resolution_m(target: Surface, source: Surface) -> float:
    return max(target.resolution_m, source.resolution_m)


def _repeats(points: np.ndarray, block_m: float) -> float:
    """Return the mean number of points per block; the points of one block share one error."""
    return len(points) / len(np.unique(np.floor(points / block_m), axis=0))


def _other_information(
    target: Surface,
    source: Surface,
    pose: Sim3,
    blocks: PairBlocks,
    correspondences: Correspondences | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the information of everything but planes, and the covariance of its gradients: both (7, 7), about the
    overlap's centroid, in the weights of `PairBlocks`. It comes from colours, correspondences and a prior as wide as
    the overlap."""
    variance = max(blocks.noise_m, 1e-6) ** 2
    anywhere = blocks.points / blocks.points[3, 3] * variance / blocks.radius_m**2
    constrained, errors = anywhere.copy(), variance * anywhere
    if all(np.ptp(surface.lightness) > 0 for surface in (target, source)):
        weight = colored_icp.Params().colour_weight
        information = colored_icp.colour_information(target, source, pose, blocks.centroid, _COLOUR_PASS)
        if information is not None:
            # In these units the error of a cell's colour is its weight, and the cells of a block share it.
            together = max(1.0, weight**2 * float(blocks.counts.mean()))
            information = information * blocks.points[3, 3]
            constrained, errors = constrained + information, errors + information * variance * together
    if correspondences is not None:
        points = colored_icp.PointConstraints(correspondences)
        information, _ = points.equations(pose, blocks.centroid, blocks.noise_m)
        constrained, errors = (
            constrained + information,
            errors + information * variance * _repeats(correspondences[0], BLOCK_M),
        )
    return constrained, errors


def find_colour_motion(
    target: Surface,
    source: Surface,
    pose: Sim3,
    centroid: np.ndarray,
    *,
    with_scale: bool,
) -> np.ndarray | None:
    """Return the (7,) motion about the overlap's centroid by which colours would move a refined pose; None without
    colours.

    Distorted depths, or misaligned colours and depths, displace textures and planes differently. So the pose from
    colours and the pose from planes differ by about the error of either, which the residuals of planes do not reveal.
    """
    if not all(np.ptp(surface.lightness) > 0 for surface in (target, source)):
        return None
    other = colored_icp.refine(target, source, pose, _COLOUR_PARAMS, with_scale=with_scale, schedule=_COLOUR_PASS)
    centre = Sim3(np.eye(3), centroid)
    there, here = (Similarities.stack([p @ centre]) for p in (other, pose))
    motion: np.ndarray = (here.inverse() @ there).log()[0]
    return motion


def unobserved_log_scale(
    field_m: float, radius_m: float, colour_motion: np.ndarray | None, unobserved: UnobservedErrors
) -> float:
    """Return the standard deviation of the log scale due to errors that leave no residual."""
    moved_by_colour = 0.0 if colour_motion is None else unobserved.colour_scale_share * colour_motion[6] * radius_m
    swell = np.hypot(
        unobserved.scale_error_m * (field_m / unobserved.field_m) ** unobserved.field_power, moved_by_colour
    )
    return float(swell / np.hypot(radius_m, swell / unobserved.max_scale_sigma))


def unobserved_motion(
    field_m: float, radius_m: float, swell: float, unobserved: UnobservedErrors
) -> tuple[float, float]:
    """Return the standard deviations (rad, metres) of a pose about the overlap's centroid due to errors that leave no
    residual.

    A known scale makes such errors observable: if a sensor's depths are a percent too large, its surfaces are a percent
    too large as well, and rotated and shifted in proportion.

    Args:
        swell: logarithm of the scale due to such errors: the measured value, or its standard deviation.
    """
    own = unobserved.shift_m * (field_m / unobserved.field_m) ** unobserved.field_power
    shift = float(np.sqrt(own**2 + (unobserved.shift_per_scale * swell * radius_m) ** 2 + unobserved.min_shift_m**2))
    return unobserved.rotation_per_shift * shift / radius_m, shift


def _measured_hessian(target: Surface, source: Surface, pose: Sim3, blocks: PairBlocks) -> np.ndarray:
    """Return the (7, 7) Hessian of the squared residuals about the overlap's centroid, where each probe finds new
    pairs.

    The Gauss-Newton Hessian keeps the pairs fixed. In truth pairs follow a motion along a wall; with fixed pairs the
    noise of the wall's normals seems to constrain that motion. At the far end of a street that Hessian gave millimetres
    for a pose that was a decimetre off. So the pose is displaced in both directions of each motion, and the gradients
    give the curvature along each common eigenvector.
    """
    chosen = source.sample(_PROBE_POINTS)
    points, centre = source.coarse[0][chosen], Sim3(np.eye(3), blocks.centroid)
    oriented = oriented_normals(source, pose)
    oriented = None if oriented is None else oriented[chosen]
    spread = np.r_[np.full(3, 1 / blocks.radius_m), np.ones(3), 1 / blocks.radius_m]
    observed = np.empty((7, 7))
    for k, step in enumerate(_PROBE_M * np.diag(spread)):
        ahead, behind = (_pull(target, points, oriented, retract(pose @ centre, x), centre) for x in (step, -step))
        observed[k] = (ahead - behind) / (2 * step[k]) * len(source.coarse[0]) / len(chosen)
    hessian = blocks.hessian + 1e-9 * np.trace(blocks.hessian) / 7 * np.eye(7)
    root = np.linalg.cholesky(hessian)
    whitened = np.linalg.solve(root, np.linalg.solve(root, observed).T)
    constrained, motions = np.linalg.eigh(0.5 * (whitened + whitened.T))
    constrained = np.clip(constrained, _MIN_CONSTRAINED, None)
    constrained /= constrained.mean() ** _CANCELLED_SHARE
    rotated = root @ motions
    measured: np.ndarray = (rotated * constrained) @ rotated.T
    return measured


def oriented_normals(source: Surface, pose: Sim3) -> np.ndarray | None:
    """Return the (M, 3) oriented normals of the source's cells in the target's frame; zeros where the orientation is
    unknown."""
    return None if source.oriented_normals is None else source.oriented_normals @ pose.rotation.T


def _pull(target: Surface, points: np.ndarray, oriented: np.ndarray | None, centred: Sim3, centre: Sim3) -> np.ndarray:
    """Return the (7,) gradient of the weighted squared point-to-plane distances with respect to a motion about a
    centre."""
    pose = centred @ centre.inverse()
    moved = pose.apply(points)
    distance, row = target.nearest(moved, RADIUS_M, oriented)
    hit = np.flatnonzero(np.isfinite(distance))
    normals = target.normals[row[hit]]
    residual = (normals * (moved[hit] - target.coarse[0][row[hit]])).sum(1)
    slope = point_to_plane_jacobian(centred, points[hit] - centre.translation, normals)
    pull: np.ndarray = (robust_weights(residual) * residual) @ slope
    return pull


def robust_weights(residual: np.ndarray, scale_m: float = _WIDTH * RADIUS_M) -> np.ndarray:
    """Return the Geman-McClure weights of residuals; a residual of ``scale_m`` has a quarter of the full weight."""
    weights: np.ndarray = 1.0 / (1.0 + (residual / scale_m) ** 2) ** 2
    return weights


def in_scene_units(covariance: np.ndarray, source_unit_m: float) -> np.ndarray:
    """Convert the translations of a covariance from metres to the source's own unit."""
    scale = np.r_[np.ones(3), np.full(3, 1.0 / source_unit_m), 1.0]
    return covariance * scale[:, None] * scale


def point_to_plane_jacobian(pose: Sim3, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return the (N, 7) derivative of ``n . (S Exp(xi) p)`` with respect to xi at xi = 0.

    Args:
        points: (N, 3) in the source's frame.
        normals: (N, 3) in the target's frame.
    """
    local = pose.scale * normals @ pose.rotation
    return np.concatenate([np.cross(points, local), local, (local * points).sum(1, keepdims=True)], axis=1)


@dataclass(frozen=True, eq=False)
class PairBlocks(error_field.Blocks):
    """Weighted means of the pairs under a pose, over B blocks.

    Derivatives are about ``centroid``: rotation and translation then hardly mix, and the matrices are well scaled.

    Args:
        hessian: (7, 7) Gauss-Newton Hessian of the point-to-plane distances of all pairs.
        points: (7, 7) the same Hessian, of point-to-point distances.
        noise_m: robust standard deviation of the point-to-plane distances.
        radius_m: radius of the overlap.
    """

    weights: np.ndarray
    hessian: np.ndarray
    points: np.ndarray
    noise_m: float
    centroid: np.ndarray
    radius_m: float

    @classmethod
    def of(cls, target: Surface, source: Surface, pose: Sim3, points: np.ndarray | None = None) -> PairBlocks | None:
        """Pair the cells of two surfaces; None where the overlap is too small.

        Args:
            points: (M, 3) positions of the source's cells; default: as they are.
        """
        points = source.coarse[0] if points is None else points
        moved = pose.apply(points)
        distance, row = target.nearest(moved, RADIUS_M, oriented_normals(source, pose))
        hit = np.flatnonzero(np.isfinite(distance))
        if len(hit) < _MIN_CELLS:
            return None
        points, moved, normals = points[hit], moved[hit], target.normals[row[hit]]
        # The signs of normals are arbitrary: within a block they are flipped to agree.
        axis = np.abs(normals).argmax(1)
        normals = normals * np.sign(normals[np.arange(len(normals)), axis])[:, None]
        residual = (normals * (moved - target.coarse[0][row[hit]])).sum(1)
        weights = robust_weights(residual)
        centroid = points.mean(0)
        jacobian = point_to_plane_jacobian(pose, points, normals) @ np.linalg.inv(_shift(centroid))
        size, labels = BLOCK_M, _labels(moved, axis, BLOCK_M)
        while (num := int(labels.max()) + 1) > _MAX_BLOCKS:
            size *= max(1.05, float(np.sqrt(num / _MAX_BLOCKS)))  # blocks lie on surfaces
            labels = _labels(moved, axis, size)
        total = np.bincount(labels, weights)
        counts = total**2 / np.bincount(labels, weights**2)

        def means(values: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(labels, weights * v) for v in values.T], axis=1) / total[:, None]

        kept = counts >= _MIN_BLOCK_COUNT
        if not kept.any():
            return None
        directions = means(normals)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        mean = means(residual[:, None])[:, 0]
        bar = _CLIP * 1.4826 * np.median(np.abs(mean[kept]))
        return cls(
            jacobian=means(jacobian)[kept],
            residual=np.clip(mean, -bar, bar)[kept],
            positions=means(moved)[kept],
            directions=directions[kept],
            counts=counts[kept],
            weights=total[kept],
            hessian=(jacobian * weights[:, None]).T @ jacobian,
            points=pose.scale**2 * point_information(points - centroid, weights),
            noise_m=1.4826 * float(np.median(np.abs(residual))),
            centroid=centroid,
            radius_m=max(float(np.sqrt(((moved - moved.mean(0)) ** 2).sum(1).mean())), 1e-6),
        )


def _labels(points: np.ndarray, axis: np.ndarray, size_m: float) -> np.ndarray:
    cells = np.floor(points / size_m).astype(np.int64)
    cells[:, 2] = 3 * cells[:, 2] + axis
    return cell_labels(cells)[0]


def _shift(centroid: np.ndarray) -> np.ndarray:
    """Return the (7, 7) matrix that turns a tangent at the source's origin into the tangent of the same motion about
    ``centroid``.

    ``Exp(xi) p = p + w x p + v + l p``; about c: ``v_c = v + w x c + l c``.
    """
    out = np.eye(7)
    out[3:6, :3] = -skew(centroid)
    out[3:6, 6] = centroid
    return out
