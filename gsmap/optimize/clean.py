"""Levenberg-Marquardt and marginal covariances of one clean component, by gtsam."""

from __future__ import annotations

import gtsam
import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.priors import PriorTerms

GAUGE_SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3 + [1e-4])
# gtsam's marginals cost 8 ms a scene at 10,000 scenes (1 ms at 1,000): beyond this they are not computed.
MAX_MARGINALS = 3000
# A direction of the gauge that the priors know no better than this (radians, component sizes) is held by the anchor.
LOOSE = 10.0


def open_gauge(poses: Similarities, scenes: np.ndarray, anchor: int, priors: PriorTerms, dim: int) -> np.ndarray:
    """(K, dim) directions, as steps of the anchor's scene, in which the whole component moves unseen by its priors.

    All of them (K = dim) without priors; none if the priors fix rotation, position and, in a graph of similarities,
    scale.
    """
    if not len(priors):
        return np.eye(dim)
    start = poses[np.array([anchor])]
    size = max(1e-9, float(np.ptp(poses.translations[scenes], axis=0).max())) * float(np.exp(-start.log_scales[0]))
    unit = np.array([1.0] * 3 + [size] * 3 + [1.0])[:dim]
    _, J = priors.linearised(poses)
    carry = (poses[priors.scenes].inverse() @ poses[np.full(len(priors), anchor)]).adjoint()
    moved = (J[:, :, :] @ carry)[:, :, :dim] * unit
    values, vectors = np.linalg.eigh(np.einsum("pij,pik->jk", moved, moved))
    return vectors[:, values < LOOSE**-2].T / unit


def solve(
    edges: Measurements, poses: Similarities, anchor: int, priors: PriorTerms, *, marginals: bool
) -> tuple[Similarities, np.ndarray | None]:
    """Optimise the scenes that ``edges`` reach, from a good guess, with one gauge prior on ``anchor``.

    The cost is gtsam's: half the sum of ``xi^T information xi`` with ``xi = Log(S_target_source^-1 S_target^-1
    S_source)``, as of its `BetweenFactor`, plus the priors' terms.

    Returns:
        All poses (those of other scenes as given), and (N, 7, 7) marginal covariances on the scene side, zero
        elsewhere and in the log scale of a rigid graph; None if not asked for, or above `MAX_MARGINALS` scenes.
    """
    dim = edges.dim
    scenes = np.unique(np.r_[edges.targets, edges.sources, anchor])
    factors = _factors(edges, dim)
    start = poses[np.array([anchor])]
    held = open_gauge(poses, scenes, anchor, priors, dim)
    if len(held):
        root = held / (GAUGE_SIGMAS[:dim] if len(held) == dim else np.full(dim, GAUGE_SIGMAS[0]))
        factors.push_back(_gauge_factor(anchor, start, root, dim))
    for k in range(len(priors)):
        factors.push_back(_prior_factor(priors[np.array([k])], dim))
    values = gtsam.Values()
    for scene in scenes.tolist():
        values.insert(scene, _to_gtsam(poses, scene, dim))
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setOrderingType("METIS")
    params.setRelativeErrorTol(1e-8)
    values = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
    out = poses.replaced(scenes, _from_gtsam(values, scenes, dim))
    return out, (
        _marginals(factors, values, scenes, len(poses), dim) if marginals and len(scenes) <= MAX_MARGINALS else None
    )


def _factors(edges: Measurements, dim: int) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    between = gtsam.BetweenFactorPose3 if dim == 6 else gtsam.BetweenFactorSimilarity3
    noise: dict[bytes, gtsam.noiseModel.Base] = {}
    targets, sources = edges.targets.tolist(), edges.sources.tolist()
    for k in range(len(edges)):
        key = edges.information[k].tobytes()
        if key not in noise:
            noise[key] = gtsam.noiseModel.Gaussian.Information(edges.information[k])
        graph.push_back(between(targets[k], sources[k], _to_gtsam(edges.measured, k, dim), noise[key]))
    return graph


def _to_gtsam(poses: Similarities, row: int, dim: int) -> gtsam.Pose3 | gtsam.Similarity3:
    rotation = gtsam.Rot3(poses.rotations[row])
    if dim == 6:
        return gtsam.Pose3(rotation, poses.translations[row])
    scale = float(np.exp(poses.log_scales[row]))
    # gtsam's Similarity3 acts as s (R p + t).
    return gtsam.Similarity3(rotation, poses.translations[row] / scale, scale)


def _from_gtsam(values: gtsam.Values, scenes: np.ndarray, dim: int) -> Similarities:
    if dim == 6:
        found = [values.atPose3(k) for k in scenes.tolist()]
        scales = np.ones(len(found))
        translations = np.array([p.translation() for p in found])
    else:
        found = [values.atSimilarity3(k) for k in scenes.tolist()]
        scales = np.array([p.scale() for p in found])
        translations = np.array([p.translation() for p in found]) * scales[:, None]
    rotations = np.array([p.rotation().matrix() for p in found])
    return Similarities(rotations, translations, np.log(scales)).orthonormalised()


def _pose_of(values: gtsam.Values, key: int, dim: int) -> Similarities:
    return _from_gtsam(values, np.array([key]), dim)


def _gauge_factor(anchor: int, start: Similarities, root: np.ndarray, dim: int) -> gtsam.CustomFactor:
    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        if jacobians is not None:
            jacobians[0] = root
        return root @ (start.inverse() @ _pose_of(values, anchor, dim)).log()[0, :dim]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(len(root)), [anchor], error)


def _prior_factor(prior: PriorTerms, dim: int) -> gtsam.CustomFactor:
    scene = int(prior.scenes[0])
    alone = PriorTerms(np.zeros(1, dtype=np.int64), prior.expected, prior.root_weights, prior.ups)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        r, J = alone.linearised(_pose_of(values, scene, dim))
        if jacobians is not None:
            jacobians[0] = J[0, :, :dim]
        return r[0]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(10), [scene], error)


def _marginals(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, scenes: np.ndarray, count: int, dim: int
) -> np.ndarray:
    out = np.zeros((count, 7, 7))
    try:
        found = gtsam.Marginals(factors, values)
    except (
        RuntimeError
    ):  # so badly conditioned (scales or levers of many powers of ten) that no covariance means anything
        return out
    for scene in scenes.tolist():
        out[scene, :dim, :dim] = found.marginalCovariance(scene)
    return out


def objective(edges: Measurements, poses: Similarities) -> float:
    """gtsam's ``graph.error`` of the edges alone: half the sum of their chi-squares."""
    values = gtsam.Values()
    for scene in np.unique(np.r_[edges.targets, edges.sources]).tolist():
        values.insert(scene, _to_gtsam(poses, scene, edges.dim))
    return float(_factors(edges, edges.dim).error(values))
