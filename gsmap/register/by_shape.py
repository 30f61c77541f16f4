"""Register a pair of scenes by surfaces and free space alone, because one scene has no colours.

The logistic model of `gsmap.register.probability` relies mostly on colour. Here a separate model replaces it: the
number of matched features, the overlap, the share of differing surface and the area seen in both scenes add log-odds
along monotone curves. ``tools/fit/shape.py`` fits them on synthetic flats, where rooms are boxes with furniture along
the walls and a pose that is rotated by 180 degrees looks plausible. The curves are stored beside this file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.reason_codes import reason
from gsmap.register import verdict
from gsmap.register.evidence import PoseEvidence
from gsmap.register.metric_scene import MetricScene, own_working_m, working_unit_m
from gsmap.register.pair import evaluate_pose
from gsmap.register.params import Params
from gsmap.register.pose_selection import EvaluatedPose, is_same_pose
from gsmap.register.proposers import kiss_matcher
from gsmap.register.scene_view import SceneView
from gsmap.register.timing import Stopwatch
from gsmap.types import Gaussians, Registration
from gsmap.types.registration import Proposal

_FILE = "by_shape.json"
_NAMES = ("inliers", "overlap", "disagreement", "seen")


# Cells at which features of the surfaces are matched: fine ones keep details, coarse ones survive noise.
VOXELS_M = (0.1, 0.15, 0.25)
PRIOR = 0.2  # share of proposed poses that are correct, before any evidence
_RIVAL_PROBABILITY = 0.3  # if a second pose is at least this probable, the result is ambiguous


def register_by_shape(target: SceneView, source: SceneView, params: Params | None = None) -> Registration:
    """Estimate the pose of ``source`` in ``target``, both in metres, by their shapes.

    Returns:
        As `register_pair`; ``evidence["probability"]`` is that of the shape model.
    """
    params, watch = params or Params(), Stopwatch()
    if not all(view.scale_policy == "known" or "landmarks" in view.graph.layers for view in (target, source)):
        why = reason("unit_unknown", "registration by shape needs scenes in metres, but the unit of one is unknown")
        return Registration(target.id, source.id, "no_match", why)
    try:
        evaluated = evaluate_by_shape(target, source, params, watch)
    except MissingDependencyError as error:
        why = reason("package_missing", f"registration by shape needs an optional package: {error}")
        return Registration(target.id, source.id, "no_match", why)
    if not evaluated:
        why = reason("no_pose_proposed", "no pose found under which features of both surfaces agree")
        return Registration(target.id, source.id, "no_match", why, seconds=watch.seconds)
    scored = sorted(((probability(j.proposal, j.evidence, PRIOR), j) for j in evaluated), key=lambda s: -s[0])
    best, why = scored[0][1], _reason(scored, source, params.verdict)
    seen = best.evidence
    return Registration(
        target.id,
        source.id,
        "rejected" if why else "accepted",
        why,
        best.proposal.S_target_source,
        best.information,
        num_inliers=best.proposal.num_inliers,
        overlap=seen.overlap,
        proposer=best.proposal.proposer,
        seconds=watch.seconds,
        evidence={
            "probability": scored[0][0],
            "free_space_violation": seen.free_space_violation,
            "disagreement": seen.disagreement,
            "num_seen": float(seen.num_seen),
            "num_coinciding": float(seen.num_coinciding),
            "seen_m2": seen.seen_m2,
        },
    )


def evaluate_by_shape(
    target: SceneView, source: SceneView, params: Params, watch: Stopwatch | None = None
) -> list[EvaluatedPose]:
    """Propose, refine and evaluate poses, each once. The shape model was fitted to such poses."""
    watch, grey = watch or Stopwatch(), (_grey(target), _grey(source))
    unit_m = working_unit_m(*grey, with_scale=False)
    scenes = [MetricScene(view, unit_m) for view in grey]
    found: list[EvaluatedPose] = []
    for voxel_m in VOXELS_M:
        with watch.step("match"):
            matcher = kiss_matcher.Params(voxel_m=voxel_m)
            proposals = kiss_matcher.propose(scenes[0], scenes[1], matcher)
        for proposal in proposals:
            with watch.step("verdict"):
                evaluated = evaluate_pose(*grey, proposal, params)
            old = next((j for j in found if _same(j, evaluated, target, source)), None)
            if old is None:
                found.append(evaluated)
            elif old.proposal.num_inliers < evaluated.proposal.num_inliers:
                found[found.index(old)] = evaluated
    return found


def _same(a: EvaluatedPose, b: EvaluatedPose, target: SceneView, source: SceneView) -> bool:
    poses = a.proposal.S_target_source, b.proposal.S_target_source
    return is_same_pose(*poses, source.centre, own_working_m(target))


def _grey(view: SceneView) -> SceneView:
    """Return the scene without its colours."""
    g = view.gaussians.load()
    grey = Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, np.zeros((len(g), 1, 3)))
    return replace(view, gaussians=grey, known=None)


def _reason(scored: Sequence[tuple[float, EvaluatedPose]], source: SceneView, params: verdict.Params) -> str:
    """Return the reason why the most probable pose is not accepted; empty if it is."""
    probable, best = scored[0]
    seen = best.evidence
    if probable < params.min_probability:
        return reason(
            "not_probable",
            f"not probable enough by shape alone: {probable:.1%}, needs {params.min_probability:.0%}: overlap "
            f"{seen.overlap:.0%}, {best.proposal.num_inliers} features agree, {seen.disagreement:.0%} of the "
            "surface seen in both scenes differs",
        )
    if len(scored) > 1 and scored[1][0] >= _RIVAL_PROBABILITY:
        return reason(
            "ambiguous", f"ambiguous: the shapes fit in two ways, the second one is {scored[1][0]:.1%} probable"
        )
    if best.covariance is None:
        return reason("too_little_overlap", "too little surface coincides to estimate the uncertainty")
    degrees = float(np.degrees(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1])))
    x, y, z = source.centre
    lever = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
    metres = float(np.sqrt(np.linalg.eigvalsh(lever @ best.covariance[:6, :6] @ lever.T)[-1]))
    if degrees > params.max_rotation_sigma_deg or metres > params.max_translation_sigma_m:
        return reason(
            "pose_uncertain", f"the overlap determines the pose only to {degrees:.1f} deg, {100 * metres:.0f} cm"
        )
    return ""


def shape_features(proposal: Proposal, evidence: PoseEvidence) -> np.ndarray:
    """Return the (4,) pieces of evidence against a pose, each at least 0."""
    bad = 1.0 if np.isnan(evidence.disagreement) else evidence.disagreement
    return np.array(
        [
            max(0.0, 2.5 - np.log10(max(proposal.num_inliers, 1))),
            -np.log10(np.clip(evidence.overlap, 0.01, 1.0)),
            np.log10(bad + 1e-3) + 3.0,
            max(0.0, 2.0 - np.log10(evidence.seen_m2 + 0.1)),
        ]
    )


def probability(proposal: Proposal, evidence: PoseEvidence, prior: float) -> float:
    """Return the probability in (0, 1) that a pose is correct, by its shape alone."""
    model = _shipped()
    odds = model.base + np.log(prior / (1 - prior))
    for name, value in zip(_NAMES, shape_features(proposal, evidence), strict=True):
        odds += np.interp(value, *model.curves[name])
    return float(np.clip(1 / (1 + np.exp(-odds)), model.least, 1 - model.least))


@dataclass(frozen=True)
class _Model:
    """Fitted curves (knots and log-odds) by the name of the evidence; see `gsmap.register.probability`."""

    curves: dict[str, tuple[tuple[float, ...], tuple[float, ...]]]
    base: float
    least: float


@lru_cache(maxsize=1)
def _shipped() -> _Model:
    stored = json.loads((files("gsmap.register") / _FILE).read_text())
    curves = {name: (tuple(curve["knots"]), tuple(curve["worth"])) for name, curve in stored["curves"].items()}
    return _Model(curves, float(stored["base"]), float(stored["least"]))
