"""Exact solve with GTSAM: Levenberg-Marquardt and marginal covariances of one component, without outlier edges."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from gsmap.geometry.similarities import Similarities
from gsmap.optimize.gauge import free_gauge_directions
from gsmap.optimize.measurements import Measurements
from gsmap.optimize.priors import PriorTerms

GAUGE_SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3 + [1e-4])
"""(7,) standard deviations of the gauge prior of an anchor: radians, the anchor's own unit, log scale."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of `solve`.

    Args:
        poses: poses of all scenes; scenes that the solve did not reach keep the given poses.
        covariances: (N, 7, 7) marginals on the scene side, zero for scenes that the solve did not reach and in the log
            scale of a rigid graph; None if not requested or not computable.
        problem: reason why the covariances could not be computed.
    """

    poses: Similarities
    covariances: np.ndarray | None
    problem: str = ""


def solve(edges: Measurements, poses: Similarities, anchor: int, priors: PriorTerms, marginal_scenes: int) -> Solution:
    """Optimize the poses of the scenes that ``edges`` reach, from good initial poses, with one gauge prior on
    ``anchor``.

    The cost is that of GTSAM: half the sum of ``xi^T information xi`` with ``xi = Log(S_target_source^-1 S_target^-1
    S_source)``, as in its `BetweenFactor`, plus the terms of the priors.

    Args:
        marginal_scenes: covariances are computed for at most this many scenes; 0 for none.
    """
    dim = edges.dim
    scenes = np.unique(np.r_[edges.targets, edges.sources, anchor])
    factors = _factors(edges, dim)
    start = poses[np.array([anchor])]
    root = anchor_directions(edges, poses, scenes, anchor, priors)
    if len(root):
        factors.push_back(_gauge_factor(anchor, start, root, dim))
    for k in range(len(priors)):
        factors.push_back(_prior_factor(priors[np.array([k])], dim))
    values = gtsam.Values()
    for scene in scenes.tolist():
        values.insert(scene, to_gtsam(poses, scene, dim))
    params = gtsam.LevenbergMarquardtParams.CeresDefaults()
    params.setOrderingType("METIS")
    params.setRelativeErrorTol(1e-8)
    values = gtsam.LevenbergMarquardtOptimizer(factors, values, params).optimize()
    out = poses.replaced(scenes, from_gtsam(values, scenes, dim))
    if len(scenes) > marginal_scenes:
        return Solution(out, None)
    try:
        return Solution(out, _marginals(factors, values, scenes, len(poses), dim))
    except RuntimeError as error:
        # The system is so badly conditioned (scales or levers over many powers of ten) that covariances are
        # meaningless.
        return Solution(out, None, str(error).strip().splitlines()[0] if str(error).strip() else "singular")


def anchor_directions(
    edges: Measurements, poses: Similarities, scenes: np.ndarray, anchor: int, priors: PriorTerms
) -> np.ndarray:
    """Compute the whitened steps (K, D) in which the gauge prior fixes the anchor: the directions that no prior
    determines."""
    held = free_gauge_directions(poses, scenes, anchor, priors, edges.dim)
    full = len(held) == edges.dim
    out: np.ndarray = held / (GAUGE_SIGMAS[: edges.dim] if full else np.full(edges.dim, GAUGE_SIGMAS[0]))
    return out


def _factors(edges: Measurements, dim: int) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    between: Any = gtsam.BetweenFactorPose3 if dim == 6 else gtsam.BetweenFactorSimilarity3
    noise: dict[bytes, gtsam.noiseModel.Base] = {}
    targets, sources = edges.targets.tolist(), edges.sources.tolist()
    for k in range(len(edges)):
        key = edges.information[k].tobytes()
        if key not in noise:
            noise[key] = gtsam.noiseModel.Gaussian.Information(edges.information[k])
        graph.push_back(between(targets[k], sources[k], to_gtsam(edges.measured, k, dim), noise[key]))
    return graph


def to_gtsam(poses: Similarities, row: int, dim: int) -> gtsam.Pose3 | gtsam.Similarity3:
    rotation = gtsam.Rot3(poses.rotations[row])
    if dim == 6:
        return gtsam.Pose3(rotation, poses.translations[row])
    scale = float(np.exp(poses.log_scales[row]))
    # gtsam's Similarity3 acts as s (R p + t).
    return gtsam.Similarity3(rotation, poses.translations[row] / scale, scale)


def from_gtsam(values: gtsam.Values, scenes: np.ndarray, dim: int) -> Similarities:
    read: Any = values.atPose3 if dim == 6 else values.atSimilarity3
    found = [read(k) for k in scenes.tolist()]
    rotations = np.array([p.rotation().matrix() for p in found])
    translations = np.array([p.translation() for p in found])
    scales = np.ones(len(found))
    if dim == 7:
        scales = np.array([p.scale() for p in found])
        translations = translations * scales[:, None]
    return Similarities(rotations, translations, np.log(scales)).orthonormalised()


def _pose_of(values: gtsam.Values, key: int, dim: int) -> Similarities:
    return from_gtsam(values, np.array([key]), dim)


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
        r, J = alone.linearize(_pose_of(values, scene, dim))
        if jacobians is not None:
            jacobians[0] = J[0, :, :dim]
        return r[0]

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(10), [scene], error)


def _marginals(
    factors: gtsam.NonlinearFactorGraph, values: gtsam.Values, scenes: np.ndarray, count: int, dim: int
) -> np.ndarray:
    out = np.zeros((count, 7, 7))
    found = gtsam.Marginals(factors, values)
    for scene in scenes.tolist():
        out[scene, :dim, :dim] = found.marginalCovariance(scene)
    return out
