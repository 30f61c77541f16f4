"""Detect captures that are stretched or bent, so that no similarity aligns them with the others, and fit the change of
shape that does."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.chi_square import chi2_log_survival
from gsmap.geometry.directions import fibonacci_sphere
from gsmap.geometry.rotations import retract
from gsmap.geometry.umeyama import umeyama
from gsmap.geometry.warps import REACH, Warp
from gsmap.register import error_field
from gsmap.register.covariance import (
    PairBlocks,
    PoseUncertainty,
    oriented_normals,
    point_to_plane_jacobian,
    robust_weights,
)
from gsmap.register.metric_scene import MetricPair
from gsmap.register.params import Params
from gsmap.register.scene_view import SceneView
from gsmap.register.surface import Surface
from gsmap.types import Sim3
from gsmap.types.registration import DEFORMATION_NOTES, Proposal

_RADII_M = (0.4, 0.25, 0.15, 0.1, 0.08, 0.08)  # of nearest cells: ends of stretched captures are off by decimetres
_BORDER = 1.5  # cells between a point and its nearest cell, along the surface, at most
_MIN_PAIRS = 100
_MIN_RADIUS_M = 1.5  # of the overlap: where less is seen, errors of surfaces look like a strain or a bend
_MAX_POINTS = 4000
_PRIOR = 0.05  # standard deviation of strain and bend, where surfaces do not constrain them
_NOISE_M = 0.01  # of a cell, for the weight of that prior on the strain
_BEND_NOISE_M = 0.045  # the same, on the bend: cells of a block share their error
_MIN_SPREAD = 0.0085  # between the most and the least stretched direction, so that one percent is named
_MAX_LOG10_P = -8.0
# Rooms have 0.04 and more, slabs of 1.6 m and fronts, which leave a direction free, at most 0.002.
_MIN_OBSERVABILITY = 0.01
_CELL = 0.5  # of the overlap's radius: edge of the cells of space that a fit leaves out
_FOLDS = 5
_MIN_PREDICTED = 0.9  # of the variance of residuals in cells that the fit of the bend left out
_MIN_SUPPORT = 1.03  # robust weight of pairs with a bend, over that with a strain; without a bend at most 1.01
_MIN_BEND = 0.002  # of the overlap's radius: root mean square displacement of surfaces that only a bend explains
# A bend is fitted to all points where a fit to a few, at the larger radii, has this share of that displacement.
_SCREEN, _SCREEN_STEP, _SCREEN_RADII_M = 0.7, 4, (0.4, 0.25, 0.15)

# Symmetric matrices without trace: the changes of shape that leave the volume, which the scale describes.
_MODES = np.zeros((5, 3, 3))
for _k, (_i, _j) in enumerate(((0, 1), (0, 2), (1, 2))):
    _MODES[_k, _i, _j] = _MODES[_k, _j, _i] = 1.0
_MODES[3], _MODES[4] = np.diag([1.0, -1.0, 0.0]), np.diag([1.0, 1.0, -2.0]) / np.sqrt(3.0)
# Symmetric matrices: the squares and products of coordinates by which a component bends.
_SQUARES = np.concatenate([_MODES[:3] / 2, np.eye(3)[:, :, None] * np.eye(3)[:, None]])
_NUM_RIGID, _NUM_STRAIN = 7, 12  # parameters of a similarity; with a strain


@dataclass(frozen=True, eq=False)
class Deformation:
    """The change of shape of a source that aligns it with the target, besides a similarity.

    Args:
        warp: the change of shape, in the source's frame; the strain is without trace.
        pose: pose of the warped source.
        log10_p: logarithm of the probability of a strain this large or larger without one, by the residuals.
        observability: curvature of the squared residuals along the strain, without what a similarity explains, over
            that of displacements by the radius; near 0 where no surface is across the stretched direction.
        rms_m: root mean square of the displacements in the overlap, without what a similarity explains.
        predicted: share of the variance of residuals that a bend explains in parts of the overlap that its fit left
            out; 0 if no bend was fitted.
        support: robust weight of the pairs of cells (the likelihood of a robust kernel) under strain and bend, over
            that under the strain alone.
        bend_m: root mean square displacement of surfaces by the bend, without what similarity and strain explain.
        length_m: length of the overlap along the direction in which it bends most.
        finest: pose and warp that align most of the surfaces: with a bend even if too little of it is seen to name it;
            None for ``pose`` and ``warp``.
    """

    warp: Warp
    pose: Sim3
    log10_p: float
    observability: float
    rms_m: float
    predicted: float = 0.0
    support: float = 1.0
    bend_m: float = 0.0
    length_m: float = 0.0
    finest: tuple[Sim3, Warp] | None = None

    @property
    def spread(self) -> float:
        """Difference between the strains of the most and the least stretched direction."""
        values = np.linalg.eigvalsh(self.warp.strain)
        return float(values[-1] - values[0])

    @property
    def is_stretched(self) -> bool:
        """Return True if there is no bend and the strain is observed, significant and large."""
        is_observed = self.observability > _MIN_OBSERVABILITY
        return not self.is_bent and is_observed and self.log10_p < _MAX_LOG10_P and self.spread > _MIN_SPREAD

    @property
    def is_bent(self) -> bool:
        """Return True if the bend is large, aligns more of the surfaces, and predicts those that its fit left out."""
        is_likely = self.predicted > _MIN_PREDICTED and self.support > _MIN_SUPPORT
        return is_likely and self.bend_m > _MIN_BEND * self.warp.radius

    def covariance(self, scale: float) -> np.ndarray:
        """Return the (7, 7) covariance to add to that of a pose: [rot_rad, trans_m, log_scale] on the source side.

        Parts of the overlap alone would turn and move the pose by as much as the warp displaces them.
        """
        about = np.diag(np.r_[np.full(3, self.rms_m / self.warp.radius), np.full(3, self.rms_m), 0.0]) ** 2
        return PoseUncertainty.about(about, self.warp.centre, scale).covariance

    def note(self) -> str:
        """Return a message that names the axis along which the source bends most, or whose length differs most."""
        if self.is_bent:
            axis = _most_bent(self.warp)
            sag = float(np.linalg.norm(self.warp.bend @ axis @ axis)) * self.length_m / (4 * self.warp.radius)
            return (
                f"{DEFORMATION_NOTES[0]}to fit the target, the source would have to bend along its direction "
                f"({_text(axis)}) by {sag:.1%} of the length of the overlap; no rigid pose aligns all of it"
            )
        values, axes = np.linalg.eigh(self.warp.strain)
        odd = 0 if values[1] - values[0] > values[2] - values[1] else 2
        rest = values[[k for k in range(3) if k != odd]].mean()
        return (
            f"{DEFORMATION_NOTES[1]}to fit the target, the source would have to change by "
            f"{values[odd] - rest:+.1%} along its direction ({_text(axes[:, odd])}), relative to the other directions; "
            "no rigid pose aligns all of it"
        )


def warp_onto(
    target: SceneView, source: SceneView, S_target_source: Sim3, *, with_scale: bool, target_warp: Warp | None = None
) -> tuple[Sim3, Warp | None] | None:
    """Fit the pose and, if it is stretched or bent, the warp of a source that align it with a target.

    Args:
        S_target_source: pose of the source so far.
        with_scale: the scale of the pose was measured.
        target_warp: warp of the target, in its frame and unit; None if it keeps its shape.

    Returns:
        The pose and the warp, which comes before the pose, in the scenes' own units; None where the overlap is too
        small.
    """
    pair = MetricPair.of(target, source, Proposal("", S_target_source, with_scale, 0), Params())
    surface = pair.target.surface()
    if target_warp is not None:
        surface = surface.warped(target_warp.scaled(pair.target.unit_m))
    found = fit_deformation(surface, pair.source.surface(), pair.to_metres(S_target_source))
    if found is None:
        return None
    if not (found.is_bent or found.is_stretched):
        return pair.to_scene_units(found.pose), None
    pose, warp = found.finest or (found.pose, found.warp)
    return pair.to_scene_units(pose), warp.scaled(1.0 / pair.source.unit_m)


def fit_deformation(target: Surface, source: Surface, pose: Sim3) -> Deformation | None:
    """Fit a similarity and a strain to the surfaces, from a refined pose (metres), and a bend where residuals are left
    that look like one.

    The covariance of the strain is that of `gsmap.register.covariance`: residuals are averaged over blocks, whose
    errors are correlated. A bend has more parameters, which such errors would explain in part: it is tested on cells of
    space that its fit leaves out.

    Returns:
        None where the overlap is too small.
    """
    overlap = PairBlocks.of(target, source, pose)
    if overlap is None or overlap.radius_m < _MIN_RADIUS_M:
        return None
    still = Warp(overlap.centroid, overlap.radius_m / pose.scale, np.zeros((3, 3)), np.zeros((3, 3, 3)))
    points = source.coarse[0]
    rows = np.flatnonzero(np.linalg.norm(points - still.centre, axis=1) < REACH * still.radius)
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _MAX_POINTS)).astype(np.int64)]
    inside = points[rows][np.linalg.norm(points[rows] - still.centre, axis=1) < still.radius]
    fitted = _align(target, source, rows, pose, still, _RADII_M, with_bend=False)
    if fitted is None:
        return None
    aligned, warp, _ = fitted
    blocks = PairBlocks.of(target, source, aligned, warp.apply(points))
    if blocks is None:
        return None
    J = _jacobian(blocks, aligned, still)[:, :_NUM_STRAIN]
    if (covariance := _covariance(blocks, J)) is None:
        return None
    strain = _parameters(warp)[:5]
    log10_p = float(chi2_log_survival(float(strain @ np.linalg.pinv(covariance, hermitian=True) @ strain), 5))
    found = Deformation(
        warp, aligned, log10_p / np.log(10.0), _observability(blocks, J, strain), rms_m=_rms(warp, inside)
    )
    coarse = _align(target, source, rows[::_SCREEN_STEP], pose, still, _SCREEN_RADII_M, with_bend=True)
    if coarse is None or coarse[2] < _SCREEN * _MIN_BEND * still.radius:
        return found
    fitted = _align(target, source, rows, pose, still, _RADII_M, with_bend=True)
    if fitted is None:
        return found
    aligned, warp, bend_m = fitted
    without, blocks = blocks, PairBlocks.of(target, source, aligned, warp.apply(points))
    if blocks is None:
        return found
    bent = replace(
        found,
        warp=warp,
        pose=aligned,
        rms_m=_rms(warp, inside),
        predicted=_predicted(blocks, _jacobian(blocks, aligned, still), warp),
        support=float(blocks.weights.sum() / without.weights.sum()),
        bend_m=bend_m,
        length_m=float(np.ptp(inside @ _most_bent(warp))),
    )
    if bent.is_bent:
        return bent
    return replace(found, finest=(bent.pose, bent.warp)) if bent.support > 1.0 else found


def _align(
    target: Surface,
    source: Surface,
    rows: np.ndarray,
    pose: Sim3,
    still: Warp,
    radii_m: tuple[float, ...],
    *,
    with_bend: bool,
) -> tuple[Sim3, Warp, float] | None:
    """Fit pose and warp to some of the source's cells by point-to-plane ICP; None where too few have a partner.

    Returns:
        The pose, the warp, and the root mean square displacement of surfaces by the bend, without what a similarity and
        a strain explain.
    """
    points, centre = source.coarse[0][rows], Sim3(np.eye(3), still.centre)
    parameters = np.zeros(23 if with_bend else 5)
    prior = np.r_[np.zeros(7), np.full(5, (_NOISE_M / _PRIOR) ** 2), np.full(18, (_BEND_NOISE_M / _PRIOR) ** 2)]
    prior = prior[: _NUM_RIGID + len(parameters)]
    border_m = _BORDER * max(target.resolution_m, source.resolution_m)
    warp = still
    for radius in radii_m:
        warped = warp.apply(points)
        normals = oriented_normals(source, pose)
        moved = pose.apply(warped)
        distance, row = target.nearest(moved, radius, None if normals is None else normals[rows])
        apart, plane = moved - target.coarse[0][row], target.normals[row]
        residual = (plane * apart).sum(1)
        # Beyond the border of the target's surfaces the nearest cell lies aside, and would pull the source inwards.
        hit = np.isfinite(distance) & (np.linalg.norm(apart - residual[:, None] * plane, axis=1) < border_m)
        if hit.sum() < _MIN_PAIRS:
            return None
        weights = robust_weights(residual[hit], max(radius / 3.0, 0.02))
        slopes = _slopes(points[hit], pose.scale * plane[hit] @ pose.rotation, still)[:, : len(parameters)]
        J = np.concatenate([point_to_plane_jacobian(pose @ centre, warped[hit] - still.centre, plane[hit]), slopes], 1)
        pull = (J * weights[:, None]).T
        before = np.r_[np.zeros(7), parameters]
        step = -np.linalg.lstsq(pull @ J + np.diag(prior), pull @ residual[hit] + prior * before)[0]
        pose = retract(pose @ centre, step[:7]) @ centre.inverse()
        parameters = parameters + step[7:]
        warp = _warp(still, parameters)
    if not with_bend:
        return pose, warp, 0.0
    bent, rest = J[:, _NUM_STRAIN:] @ parameters[5:], J[:, :_NUM_STRAIN]
    bent = bent - rest @ np.linalg.lstsq(pull[:_NUM_STRAIN] @ rest, pull[:_NUM_STRAIN] @ bent)[0]
    return pose, warp, float(np.sqrt(np.average(bent**2, weights=weights)))


def _parameters(warp: Warp) -> np.ndarray:
    """Return the (23,) coefficients of a warp over the modes of strain and bend."""
    strain = np.einsum("kij,ij->k", _MODES, warp.strain) / (_MODES**2).sum((1, 2))
    bend = np.einsum("kij,aij->ak", _SQUARES, warp.bend) / (_SQUARES**2).sum((1, 2))
    return np.r_[strain, bend.ravel()]


def _warp(still: Warp, parameters: np.ndarray) -> Warp:
    """Return the warp of coefficients over the modes of strain and, if there are more than 5, of bend."""
    strain = np.tensordot(parameters[:5], _MODES, 1)
    bend = np.tensordot(parameters[5:].reshape(3, -1), _SQUARES, 1) if len(parameters) > 5 else np.zeros((3, 3, 3))
    return replace(still, strain=strain, bend=bend)


def _slopes(points: np.ndarray, normals: np.ndarray, still: Warp) -> np.ndarray:
    """Return the (N, 23) derivative of point-to-plane residuals with respect to the coefficients of a warp.

    Args:
        points: (N, 3) in the source's frame.
        normals: (N, 3) in the axes of the source, times the scale of the pose.
    """
    local = points - still.centre
    strain = np.einsum("ni,kij,nj->nk", normals, _MODES, local)
    squares = np.einsum("ni,kij,nj->nk", local, _SQUARES, local) / still.radius
    return np.concatenate([strain, (normals[:, :, None] * squares[:, None]).reshape(len(points), -1)], axis=1)


def _jacobian(blocks: PairBlocks, pose: Sim3, still: Warp) -> np.ndarray:
    """Return the (B, 30) derivative of the residuals of blocks with respect to the similarity and the warp."""
    slopes = pose.scale * blocks.directions @ pose.rotation
    return np.concatenate([blocks.jacobian, _slopes(pose.inverse().apply(blocks.positions), slopes, still)], axis=1)


def _covariance(blocks: PairBlocks, J: np.ndarray) -> np.ndarray | None:
    """Return the (5, 5) covariance of a strain by the Jacobian (B, 12); None where there are too few blocks."""
    pull = (J * blocks.weights[:, None]).T
    influence = np.linalg.pinv(pull @ J, hermitian=True) @ pull
    errors = error_field.estimate_errors(replace(blocks, jacobian=J), influence)
    return None if errors is None else errors.covariance[7:, 7:]


def _observability(blocks: PairBlocks, J: np.ndarray, strain: np.ndarray) -> float:
    H = (J * blocks.weights[:, None]).T @ J
    left = H[7:, 7:] - H[7:, :7] @ np.linalg.pinv(H[:7, :7], hermitian=True) @ H[:7, 7:]
    whole = float(strain @ strain) * blocks.weights.sum() * blocks.radius_m**2
    return float(strain @ left @ strain) / whole if whole else 0.0


def _solve(J: np.ndarray, residual: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the (D,) parameters that explain residuals of blocks, the warp's near zero where nothing constrains it."""
    variance = float(np.average(residual**2, weights=weights))
    prior = np.r_[np.full(7, 1e-9 * weights.sum()), np.full(J.shape[1] - 7, variance / _PRIOR**2)]
    pull = (J * weights[:, None]).T
    parameters: np.ndarray = np.linalg.solve(pull @ J + np.diag(prior), pull @ residual)
    return parameters


def _predicted(blocks: PairBlocks, J: np.ndarray, warp: Warp) -> float:
    """Return the share of the variance of residuals that a bend explains in cells of space that its fit left out."""
    residual = blocks.residual - J[:, _NUM_RIGID:] @ _parameters(warp)
    cells = np.floor((blocks.positions - blocks.positions.mean(0)) / (_CELL * blocks.radius_m)).astype(np.int64)
    folds, squares = (cells @ [1, 2, 3]) % _FOLDS, np.zeros(2)
    for fold in range(_FOLDS):
        out, kept = folds == fold, folds != fold
        for k, count in enumerate((_NUM_STRAIN, J.shape[1])):
            parameters = _solve(J[kept, :count], residual[kept], blocks.weights[kept])
            squares[k] += blocks.weights[out] @ (residual[out] - J[out, :count] @ parameters) ** 2
    return float(1 - squares[1] / max(squares[0], 1e-30))


def _most_bent(warp: Warp) -> np.ndarray:
    """Return the direction along which a warp bends most."""
    axes = fibonacci_sphere(400)
    axis: np.ndarray = axes[np.linalg.norm(np.einsum("aij,ni,nj->na", warp.bend, axes, axes), axis=1).argmax()]
    return axis


def _rms(warp: Warp, points: np.ndarray) -> float:
    """Return the root mean square displacement of points by a warp, without what a similarity explains."""
    if len(points) < 3:
        return 0.0
    moved = warp.apply(points)
    apart = moved - umeyama(moved, points, with_scale=True).apply(points)
    return float(np.sqrt((apart**2).sum(1).mean()))


def _text(axis: np.ndarray) -> str:
    """Return the components of an axis, the largest of which is positive."""
    axis = axis * np.sign(axis[np.abs(axis).argmax()])
    return ", ".join(f"{round(value, 1) + 0.0:.1f}" for value in axis)
