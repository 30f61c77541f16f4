"""How well a refined pose is known."""

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
from gsmap.register.degeneracy import held_motions, point_information
from gsmap.register.metres import Belief
from gsmap.register.refiners import colored_icp
from gsmap.register.surface import PLANE_NEIGHBOURS, Surface
from gsmap.types import Sim3

BLOCK_M = 0.3  # residuals within a cell of this size, on surfaces that face one way, are one measurement
# Pairs farther apart than this are ignored, and from a third of it on they weigh less, as in refining.
RADIUS_M = 0.08
_MAX_BLOCKS = 200  # larger cells are taken where there would be more
# The pose is moved by this much each way (rotation and scale: over the overlap's radius) to see how much of a motion
# the residuals of this many cells pull back.
_PROBE_M = 0.01
_PROBE_POINTS = 6000
_COLOUR_SWAY = colored_icp.Params(colour_weight=3.0)  # ten times that of refining
_COLOUR_PASS = colored_icp.Schedule((0.06,), (10_000,), last_tolerance=0.01)  # one radius; a tenth of a pair's cost
_FEWEST = 20  # cells that coincide
_FEWEST_OF_A_BLOCK = 3.0
_LEAST_LOG_SCALE_SIGMA = 1e-6  # keeps the matrix regular
_LEAST_HELD = 0.1  # of a motion, whatever the probe says: farther out than it reaches something holds
# Pairs follow errors of the surfaces as they follow motions, which cancels; but then the residuals show less of the
# errors than there is, which does not. Half of it, in made worlds whose errors are known.
_CANCELS = 0.5
_WIDTH = 0.3  # of the radius: pairs this far from the planes count a quarter, as in refining
_CLIP = 3.0  # standard deviations: what moved between captures is no error of the surfaces


@dataclass(frozen=True)
class Hidden:
    """How far poses are off by what leaves no residual (a trainer's bias, a sensor that bends what it measures).

    A model, fitted on made places by ``tools/fit/covariance.py``. All are standard deviations.

    Args:
        shown: what residuals show of a pose's errors counts this many times (less than once where colours tell more).
        by_colour: rotations and translations are off by this share of what colours would move them by ...
        swell_by_colour: ... and the logarithm of the scale by this share.
        shift_m: translations are off by this, where ``field_m`` is the errors that residuals show beyond a block ...
        swell_m: ... and the logarithm of the scale, over the overlap's radius, by this, before it is measured ...
        field_m: ... of errors that residuals show, from which both ...
        field_power: ... grow with this power of them.
        shift_by_swell: a sensor that swells what it measures also bends it: translations are off by this share of the
            swelling over the overlap's radius ...
        turn_by_shift: ... and rotations, over that radius, by this many times as much as those translations.
        most_swell: no sensor's metre is off by more than about this (logarithm of a scale).
        least_m: no translation is known better than this, and no rotation over the overlap's radius.
    """

    shown: float
    by_colour: float
    swell_by_colour: float
    shift_m: float
    swell_m: float
    field_m: float
    field_power: float
    shift_by_swell: float
    turn_by_shift: float
    most_swell: float
    least_m: float


@cache
def fitted(*, coloured: bool) -> Hidden:
    """The fitted model for surfaces with colours, and the one for surfaces without."""
    stored = json.loads((files("gsmap.register") / "covariance.json").read_text())
    return Hidden(**stored["coloured" if coloured else "grey"])


@dataclass(frozen=True, eq=False)
class Known:
    """How well a pose is known.

    Args:
        covariance: (7, 7) over [rot_rad, trans_m, log_scale] applied on the source side.
        sigmas: standard deviations (rad, metres, log scale) of the least known rotation, translation and scale at the
            overlap's centroid.
    """

    covariance: np.ndarray
    sigmas: tuple[float, float, float]

    @classmethod
    def about(cls, covariance: np.ndarray, centroid: np.ndarray, scale: float) -> Known:
        """Of a (7, 7) covariance about the overlap's centroid (3,), of a pose of some scale."""
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
    """How a pose that was refined with its scale hangs on the errors of the surfaces, and on its scale.

    Args:
        scaled: (7, 7) covariance about the overlap's centroid of the pose whose scale was refined along, as far as
            residuals show errors.
        rigid: (6, 6) the same of the pose that has the right scale.
        tied: (7,) what a change of the scale by 1 (its logarithm) moves of a pose that is refined to it.
        centroid: (3,) of the overlap, in the source's frame, metres.
        field_m: standard deviation of the surfaces' errors that are alike beyond a block.
        radius_m: of the overlap.
        sway: (7,) motion about the centroid by which colours would move the pose; None where there are none.
        hidden: the model of errors that leave no residual.
        loose: (7, 7) and (6, 6) what is added to ``scaled`` and to ``rigid`` where planes leave a motion free: the
            errors of colours and correspondences, which hold it then, or of nothing.
    """

    scaled: np.ndarray
    rigid: np.ndarray
    tied: np.ndarray
    centroid: np.ndarray
    field_m: float
    radius_m: float
    sway: np.ndarray | None
    hidden: Hidden
    loose: tuple[np.ndarray, np.ndarray]

    @property
    def log_scale_sigma(self) -> float:
        """Standard deviation of the scale that was refined along."""
        return float(np.sqrt(self.of_scaled(1.0)[6, 6]))

    def of_scaled(self, scale: float) -> np.ndarray:
        """(7, 7) covariance about the overlap's centroid of the pose with the scale that was refined along."""
        swell = hidden_log_scale(self.field_m, self.radius_m, self.sway, self.hidden)
        hidden = np.r_[self._hidden(swell, scale, self.sway), swell]
        return self.hidden.shown**2 * self.scaled + self.loose[0] + np.diag(hidden**2)

    def of_rigid(self, scale: float, swell: float, log_scale_sigma: float, sway: np.ndarray | None) -> np.ndarray:
        """(7, 7) the same of a pose whose scale is known otherwise.

        Args:
            swell: logarithm of the scale that the surfaces were measured to have over the true one: so much do their
                errors hide, or more.
            log_scale_sigma: how well the scale is known.
            sway: by which colours would move this pose; None where there are none.
        """
        out = np.zeros((7, 7))
        hidden = self._hidden(abs(swell), scale, sway)
        out[:6, :6] = self.hidden.shown**2 * self.rigid + self.loose[1] + np.diag(hidden**2)
        out += np.outer(self.tied, self.tied) * max(log_scale_sigma, _LEAST_LOG_SCALE_SIGMA) ** 2
        return out

    def known(self, pose: Sim3, belief: Belief | None = None, sway: np.ndarray | None = None) -> Known:
        """How well a pose (metres) is known: the scaled one, or one whose scale is believed to be something else and
        that colours would move by ``sway``."""
        if belief is None or not belief.rigid:
            covariance = self.of_scaled(pose.scale)
        else:
            covariance = self.of_rigid(pose.scale, belief.log_scale, belief.log_scale_sigma, sway)
        return Known.about(covariance, self.centroid, pose.scale)

    def rescaled(self, pose: Sim3, scale: float) -> Sim3:
        """The pose with another scale, and moved as that moves it."""
        step = np.log(scale / pose.scale) * self.tied
        centre = Sim3(np.eye(3), self.centroid)
        return retract(pose @ centre, step) @ centre.inverse()

    def _hidden(self, swell: float, scale: float, sway: np.ndarray | None) -> np.ndarray:
        """(6,) of rotation and translation (the source's), by how much scale the surfaces' errors hide, and by what
        colours say."""
        turn, shift = hidden_motion(self.field_m, self.radius_m, swell, self.hidden)
        out = np.r_[np.full(3, turn), np.full(3, shift / scale)]
        if sway is None:
            return out
        told = np.sqrt([(sway[:3] ** 2).mean(), (sway[3:6] ** 2).mean()])
        return np.hypot(out, self.hidden.by_colour * np.repeat(told, 3))


def condition(
    target: Surface,
    source: Surface,
    pose: Sim3,
    correspondences: Correspondences | None = None,
    hidden: Hidden | None = None,
) -> Conditioning | None:
    """How well a refined pose (metres) is known with its scale and without; None where too little overlaps to tell.

    An ICP Hessian is overconfident 10 to 900 times on splats, for neighbouring points share their error. So the
    point-to-plane residuals are averaged over blocks, `error_field` learns from them how far errors are alike, and the
    covariance is that of the pose under such errors: ``A K A^T``, where A is the pose's change by each block's error
    (implicit function theorem: the pull of the block over what a motion is pulled back by, `_pulled_back`). What leaves
    no residual is added by a model (`hidden_motion`, `hidden_log_scale`).

    Along motions that planes leave free (`degeneracy`) the pose is known as well as colours and the ``correspondences``
    hold it, as in refining; where these do not either, the overlap may lie anywhere along itself.
    """
    blocks = _Blocks.of(target, source, pose)
    if blocks is None:
        return None
    hessian = _pulled_back(target, source, pose, blocks)
    pull = (blocks.jacobian * blocks.weights[:, None]).T
    loose = np.zeros((7, 7)), np.zeros((6, 6))
    held = held_motions(blocks.hessian, blocks.points, blocks.noise_m, _resolution_m(target, source), PLANE_NEIGHBOURS)
    if held is not None:
        others, errors_of_others = _other_information(target, source, pose, blocks, correspondences)
        hessian, pull = held @ hessian @ held.T + others, held @ pull
        inverse, rigid = np.linalg.inv(hessian), np.linalg.inv(hessian[:6, :6])
        loose = inverse @ errors_of_others @ inverse, rigid @ errors_of_others[:6, :6] @ rigid
    influence = np.concatenate([np.linalg.solve(hessian, pull), np.linalg.solve(hessian[:6, :6], pull[:6])])
    seen = error_field.Blocks(blocks.jacobian, blocks.residual, blocks.positions, blocks.directions, blocks.counts)
    errors = error_field.judge_errors(seen, influence)
    if errors is None:
        return None
    sway = swayed(target, source, pose, blocks.centroid, with_scale=True)
    return Conditioning(
        scaled=errors.covariance[:7, :7],
        rigid=errors.covariance[7:, 7:],
        tied=np.r_[-np.linalg.solve(hessian[:6, :6], hessian[:6, 6]), 1.0],
        centroid=blocks.centroid,
        field_m=errors.field_m,
        radius_m=blocks.radius_m,
        sway=sway,
        hidden=hidden or fitted(coloured=sway is not None),
        loose=loose,
    )


def known_by_correspondences(correspondences: Correspondences, pose: Sim3, block_m: float = BLOCK_M) -> Known:
    """How well a pose (metres) is known that was fitted to correspondences alone, and not refined."""
    target, source = correspondences
    centroid = source.mean(0)
    information = pose.scale**2 * point_information(source - centroid)
    variance = ((pose.apply(source) - target) ** 2).mean() * _repeats(target, block_m)
    return Known.about(np.linalg.pinv(information, hermitian=True) * variance, centroid, pose.scale)


def _resolution_m(target: Surface, source: Surface) -> float:
    return max(target.resolution_m, source.resolution_m)


def _repeats(points: np.ndarray, block_m: float) -> float:
    """How many of some points err together: those within a block."""
    return len(points) / len(np.unique(np.floor(points / block_m), axis=0))


def _other_information(
    target: Surface,
    source: Surface,
    pose: Sim3,
    blocks: _Blocks,
    correspondences: Correspondences | None,
) -> tuple[np.ndarray, np.ndarray]:
    """(7, 7) what holds a pose beside planes, about the overlap's centroid in the weights of `_Blocks`, and the
    covariance (7, 7) of its pull: of colours, of correspondences, and that the overlap lies within its own radius."""
    variance = max(blocks.noise_m, 1e-6) ** 2
    anywhere = blocks.points / blocks.points[3, 3] * variance / blocks.radius_m**2
    held, errors = anywhere.copy(), variance * anywhere
    if all(np.ptp(surface.lightness) > 0 for surface in (target, source)):
        weight = colored_icp.Params().colour_weight
        told = colored_icp.colour_information(target, source, pose, blocks.centroid, _COLOUR_PASS)
        if told is not None:
            # In these units a cell's colour is off by its weight; those of a block are, all together.
            together = max(1.0, weight**2 * float(blocks.counts.mean()))
            told = told * blocks.points[3, 3]
            held, errors = held + told, errors + told * variance * together
    if correspondences is not None:
        ties = colored_icp.Ties(correspondences)
        told, _ = ties.equations(pose, blocks.centroid, blocks.noise_m)
        held, errors = held + told, errors + told * variance * _repeats(correspondences[0], BLOCK_M)
    return held, errors


def swayed(
    target: Surface,
    source: Surface,
    pose: Sim3,
    centroid: np.ndarray,
    *,
    with_scale: bool,
) -> np.ndarray | None:
    """(7,) motion about the overlap's centroid by which colours would move a refined pose; None where there are none.

    A sensor that bends what it measures, or whose colours and depths do not belong together, moves textures otherwise
    than planes. So the pose that colours prefer lies about as far from that of the planes as both lie from the truth,
    where the planes' own residuals show nothing.
    """
    if not all(np.ptp(surface.lightness) > 0 for surface in (target, source)):
        return None
    other = colored_icp.refine(target, source, pose, _COLOUR_SWAY, with_scale=with_scale, schedule=_COLOUR_PASS)
    centre = Sim3(np.eye(3), centroid)
    there, here = (Similarities.stack([p @ centre]) for p in (other, pose))
    motion: np.ndarray = (here.inverse() @ there).log()[0]
    return motion


def hidden_log_scale(field_m: float, radius_m: float, sway: np.ndarray | None, hidden: Hidden) -> float:
    """Standard deviation of the scale's logarithm by what leaves no residual."""
    told = 0.0 if sway is None else hidden.swell_by_colour * sway[6] * radius_m
    swell = np.hypot(hidden.swell_m * (field_m / hidden.field_m) ** hidden.field_power, told)
    return float(swell / np.hypot(radius_m, swell / hidden.most_swell))


def hidden_motion(field_m: float, radius_m: float, swell: float, hidden: Hidden) -> tuple[float, float]:
    """Standard deviations (rad, metres) about the overlap's centroid by what leaves no residual, colours apart.

    Errors that leave none still show where the scale is known: a sensor whose depths are a percent off swells its
    surfaces by as much, and its bend turns and shifts them in proportion.

    Args:
        swell: logarithm of the scale that such errors make, measured, or its standard deviation.
    """
    own = hidden.shift_m * (field_m / hidden.field_m) ** hidden.field_power
    shift = float(np.sqrt(own**2 + (hidden.shift_by_swell * swell * radius_m) ** 2 + hidden.least_m**2))
    return hidden.turn_by_shift * shift / radius_m, shift


def _pulled_back(target: Surface, source: Surface, pose: Sim3, blocks: _Blocks) -> np.ndarray:
    """(7, 7) Hessian about the overlap's centroid of the residuals' squares, the pairs found anew as the pose moves.

    The usual one takes the pairs as given. They follow a motion along a wall, though, and the noise of its normals then
    seems to hold it where nothing does: of a street's far end that Hessian knew a pose to millimetres that was a
    decimetre off. So the pose is moved each way, and of each motion (an eigenvector of both Hessians together) as much
    is taken to be held as pulls back.
    """
    chosen = source.sample(_PROBE_POINTS)
    points, centre = source.coarse[0][chosen], Sim3(np.eye(3), blocks.centroid)
    faces = _faces(source, pose)
    faces = None if faces is None else faces[chosen]
    spread = np.r_[np.full(3, 1 / blocks.radius_m), np.ones(3), 1 / blocks.radius_m]
    pulled = np.empty((7, 7))
    for k, step in enumerate(_PROBE_M * np.diag(spread)):
        ahead, behind = (_pull(target, points, faces, retract(pose @ centre, x), centre) for x in (step, -step))
        pulled[k] = (ahead - behind) / (2 * step[k]) * len(source.coarse[0]) / len(chosen)
    hessian = blocks.hessian + 1e-9 * np.trace(blocks.hessian) / 7 * np.eye(7)
    root = np.linalg.cholesky(hessian)
    whitened = np.linalg.solve(root, np.linalg.solve(root, pulled).T)
    held, motions = np.linalg.eigh(0.5 * (whitened + whitened.T))
    held = np.clip(held, _LEAST_HELD, None)
    held /= held.mean() ** _CANCELS
    rotated = root @ motions
    measured: np.ndarray = (rotated * held) @ rotated.T
    return measured


def _faces(source: Surface, pose: Sim3) -> np.ndarray | None:
    """(M, 3) which way the source's cells face in the target's frame, zeros where that is not known."""
    return None if source.faces is None else source.faces @ pose.rotation.T


def _pull(target: Surface, points: np.ndarray, faces: np.ndarray | None, centred: Sim3, centre: Sim3) -> np.ndarray:
    """(7,) gradient of the weighted squares of the distances to the planes, by a motion about a centre."""
    pose = centred @ centre.inverse()
    moved = pose.apply(points)
    distance, row = target.nearest(moved, RADIUS_M, faces)
    hit = np.flatnonzero(np.isfinite(distance))
    normals = target.normals[row[hit]]
    residual = (normals * (moved[hit] - target.coarse[0][row[hit]])).sum(1)
    slope = point_to_plane_jacobian(centred, points[hit] - centre.translation, normals)
    pull: np.ndarray = (_weights(residual) * residual) @ slope
    return pull


def _weights(residual: np.ndarray) -> np.ndarray:
    """Geman-McClure."""
    weights: np.ndarray = 1.0 / (1.0 + (residual / (_WIDTH * RADIUS_M)) ** 2) ** 2
    return weights


def in_scene_units(covariance: np.ndarray, source_unit_m: float) -> np.ndarray:
    """The covariance with translations in the source's own unit instead of metres."""
    scale = np.r_[np.ones(3), np.full(3, 1.0 / source_unit_m), 1.0]
    return covariance * scale[:, None] * scale


def point_to_plane_jacobian(pose: Sim3, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N, 7) derivative of ``n . (S Exp(xi) p)`` at xi = 0; points in the source's frame, normals in the target's."""
    local = pose.scale * normals @ pose.rotation
    return np.concatenate([np.cross(points, local), local, (local * points).sum(1, keepdims=True)], axis=1)


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Weighted means over B blocks of the pairs that a pose makes, their (7, 7) Hessian, that of pairs whose points are
    held in all directions (``points``), and the pairs' distance from the planes (robust standard deviation).

    ``radius_m`` is that of the overlap. Derivatives are about ``centroid``: rotation and translation then hardly mix,
    and the matrices are well scaled.
    """

    jacobian: np.ndarray
    residual: np.ndarray
    positions: np.ndarray
    directions: np.ndarray
    counts: np.ndarray
    weights: np.ndarray
    hessian: np.ndarray
    points: np.ndarray
    noise_m: float
    centroid: np.ndarray
    radius_m: float

    @classmethod
    def of(cls, target: Surface, source: Surface, pose: Sim3) -> _Blocks | None:
        points, _ = source.coarse
        moved = pose.apply(points)
        distance, row = target.nearest(moved, RADIUS_M, _faces(source, pose))
        hit = np.flatnonzero(np.isfinite(distance))
        if len(hit) < _FEWEST:
            return None
        points, moved, normals = points[hit], moved[hit], target.normals[row[hit]]
        # Signs of normals mean nothing: those of a block are turned to face one way.
        axis = np.abs(normals).argmax(1)
        normals = normals * np.sign(normals[np.arange(len(normals)), axis])[:, None]
        residual = (normals * (moved - target.coarse[0][row[hit]])).sum(1)
        weights = _weights(residual)
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

        kept = counts >= _FEWEST_OF_A_BLOCK
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
    """(7, 7) map of a tangent at the source's origin to the same motion about ``centroid``.

    ``Exp(xi) p = p + w x p + v + l p``; about c: ``v_c = v + w x c + l c``.
    """
    out = np.eye(7)
    out[3:6, :3] = -skew(centroid)
    out[3:6, 6] = centroid
    return out
