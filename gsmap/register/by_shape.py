"""Registering a pair of which one has no colours: by surfaces and free space alone.

Colour is most of what a verdict rests on, so what is left is judged by a model of its own: how many features agree, how
much of the surfaces coincides, and how much of what both saw is not the same, each worth so much by a curve that only
rises or only falls. The curves are fitted by ``tools/fit/shape.py`` on made flats, where rooms are boxes with
furniture along the walls, and a wrong turn by half looks fair; they are stored beside this file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files

import numpy as np

from gsmap.errors import MissingDependencyError
from gsmap.register import verdict
from gsmap.register.conclusion import Judged, is_same_pose
from gsmap.register.evidence import PoseEvidence
from gsmap.register.metric import MetricScene, own_working_m, working_unit_m
from gsmap.register.pair import measured
from gsmap.register.params import Params
from gsmap.register.proposers import kiss_matcher
from gsmap.register.scene_view import SceneView
from gsmap.register.stopwatch import Stopwatch
from gsmap.types import Gaussians, Registration
from gsmap.types.registration import Proposal

_FILE = "by_shape.json"
_NAMES = ("inliers", "overlap", "disagreement", "seen")


# Cells at which features of the surfaces are matched: fine ones keep details, coarse ones survive noise.
VOXELS_M = (0.1, 0.15, 0.25)
PRIOR = 0.2  # share of proposed poses that are right before anything is known of them
_RIVAL_PROBABILITY = 0.3  # another pose that is as probable as this makes the result ambiguous


def register_by_shape(target: SceneView, source: SceneView, params: Params | None = None) -> Registration:
    """Where ``source`` lies in ``target``, both in metres, as far as their shapes tell.

    Returns:
        As `register_pair`; ``evidence["probability"]`` is that of shape alone.
    """
    params, watch = params or Params(), Stopwatch()
    if not all(view.scale_policy == "known" or "landmarks" in view.graph.layers for view in (target, source)):
        return Registration(target.id, source.id, "no_match", "shapes are compared in metres, and a unit is not known")
    try:
        judged = judged_by_shape(target, source, params, watch)
    except MissingDependencyError as error:
        return Registration(target.id, source.id, "no_match", f"shapes are compared by a package: {error}")
    if not judged:
        reason = "no pose under which features of both surfaces agree"
        return Registration(target.id, source.id, "no_match", reason, seconds=watch.seconds)
    scored = sorted(((probability(j.proposal, j.evidence, PRIOR), j) for j in judged), key=lambda s: -s[0])
    best, reason = scored[0][1], _reason(scored, source, params.verdict)
    information = None
    if not reason and best.covariance is not None:
        information = np.linalg.inv(best.covariance)
    seen = best.evidence
    return Registration(
        target.id,
        source.id,
        "rejected" if reason else "accepted",
        reason,
        best.proposal.S_target_source,
        None if information is None else 0.5 * (information + information.T),
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


def judged_by_shape(
    target: SceneView, source: SceneView, params: Params, watch: Stopwatch | None = None
) -> list[Judged]:
    """Every pose that is proposed, refined and measured, each once: also what the model is fitted on."""
    watch, grey = watch or Stopwatch(), (_grey(target), _grey(source))
    unit_m = working_unit_m(*grey, with_scale=False)
    scenes = [MetricScene(view, unit_m) for view in grey]
    found: list[Judged] = []
    for voxel_m in VOXELS_M:
        with watch.step("match"):
            asked = kiss_matcher.Params(voxel_m=voxel_m)
            proposals = kiss_matcher.propose(scenes[0], scenes[1], asked)
        for proposal in proposals:
            with watch.step("verdict"):
                judged = measured(*grey, proposal, params)
            old = next((j for j in found if _same(j, judged, target, source)), None)
            if old is None:
                found.append(judged)
            elif old.proposal.num_inliers < judged.proposal.num_inliers:
                found[found.index(old)] = judged
    return found


def _same(a: Judged, b: Judged, target: SceneView, source: SceneView) -> bool:
    poses = a.proposal.S_target_source, b.proposal.S_target_source
    return is_same_pose(*poses, source.centre, own_working_m(target))


def _grey(view: SceneView) -> SceneView:
    """The scene without its colours, so that no comparison can rest on them."""
    g = view.gaussians
    return replace(
        view, gaussians=Gaussians(g.means, g.quats, g.log_scales, g.logit_opacities, np.zeros((len(g), 1, 3)))
    )


def _reason(scored: Sequence[tuple[float, Judged]], source: SceneView, params: verdict.Params) -> str:
    """Why the most probable pose is not accepted; empty where it is."""
    probable, best = scored[0]
    seen = best.evidence
    if probable < params.min_probability:
        return (
            f"not probable enough by shape alone: {probable:.1%}, needs {params.min_probability:.0%}: overlap "
            f"{seen.overlap:.0%}, {best.proposal.num_inliers} features agree, {seen.disagreement:.0%} of what both saw "
            "differs"
        )
    if len(scored) > 1 and scored[1][0] >= _RIVAL_PROBABILITY:
        return f"ambiguous: its shape fits in two ways, the other with {scored[1][0]:.1%}"
    if best.covariance is None:
        return "too little surface coincides to tell the pose"
    degrees = float(np.degrees(np.sqrt(np.linalg.eigvalsh(best.covariance[:3, :3])[-1])))
    x, y, z = source.centre
    lever = np.hstack([-np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.eye(3)])
    metres = float(np.sqrt(np.linalg.eigvalsh(lever @ best.covariance[:6, :6] @ lever.T)[-1]))
    if degrees > params.max_rotation_sigma_deg or metres > params.max_translation_sigma_m:
        return f"the overlap fixes the pose only to {degrees:.1f} deg, {100 * metres:.0f} cm"
    return ""


def doubts(proposal: Proposal, evidence: PoseEvidence) -> np.ndarray:
    """(4,) what speaks against a pose, each 0 where nothing does."""
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
    """How probable it is that a pose is right, of its shape alone, in (0, 1)."""
    model = _shipped()
    odds = model.base + np.log(prior / (1 - prior))
    for name, value in zip(_NAMES, doubts(proposal, evidence), strict=True):
        odds += np.interp(value, *model.curves[name])
    return float(np.clip(1 / (1 + np.exp(-odds)), model.least, 1 - model.least))


@dataclass(frozen=True)
class _Model:
    """The fitted curves (knots and log-odds) by the name of what they are of; see `gsmap.register.probability`."""

    curves: dict[str, tuple[tuple[float, ...], tuple[float, ...]]]
    base: float
    least: float


@lru_cache(maxsize=1)
def _shipped() -> _Model:
    stored = json.loads((files("gsmap.register") / _FILE).read_text())
    curves = {name: (tuple(curve["knots"]), tuple(curve["worth"])) for name, curve in stored["curves"].items()}
    return _Model(curves, float(stored["base"]), float(stored["least"]))
