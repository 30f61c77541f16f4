"""Select the pose of a registration among the evaluated poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmap.geometry.rotations import angle_between
from gsmap.reason_codes import reason, reason_code
from gsmap.register import verdict
from gsmap.register.evidence import PoseEvidence
from gsmap.register.look_alike import look_alike_probability
from gsmap.register.metric_scene import own_working_m
from gsmap.register.params import Params
from gsmap.register.probability import probability
from gsmap.register.proposal_rounds import num_nodes
from gsmap.register.repetition import MARGIN, fisher_z
from gsmap.register.scene_view import SceneView
from gsmap.register.unit_scale import ScaleDecision
from gsmap.texts import counted
from gsmap.types import Registration, Sim3
from gsmap.types.registration import Proposal

if TYPE_CHECKING:
    from gsmap.register.deformation import Deformation

# Two poses count as the same if all their differences are below these limits: refinement would merge them.
SAME_ROTATION_DEG = 3.0
SAME_DISTANCE_M = 0.3  # moved by the centre of the source's content
SAME_LOG_SCALE = 0.02
_RENDERS_SIGMA = 0.1  # at this standard deviation the colours of renders count half as much as those of cells


@dataclass(frozen=True, eq=False)
class EvaluatedPose:
    """A proposal after refinement, with its evidence.

    Args:
        proposal: the proposal, with the refined pose.
        evidence: the evidence under the refined pose.
        covariance: (7, 7) covariance of the pose, translations in the source's unit; None if not computed.
        flaw: reason why the pose is not accepted; empty if it is.
        decision: decision on the scale; None if it was not measured, or if the unit of a scene is unknown.
        deformation: change of shape that would align the source; None if a similarity aligns it.
        similarity: similarity of both surfaces under the pose (`gsmap.register.repetition`); NaN if it is not known.
        own: the proposal with its own inliers, if the pose repeats another: ``proposal`` then counts as much as that of
            the other pose. None for other poses.
    """

    proposal: Proposal
    evidence: PoseEvidence
    covariance: np.ndarray | None
    flaw: str
    decision: ScaleDecision | None = None
    deformation: Deformation | None = None
    similarity: float = float("nan")
    own: Proposal | None = None

    @property
    def information(self) -> np.ndarray | None:
        """Return the inverse of the covariance; None if the covariance is unknown or has no bound."""
        if self.covariance is None or not np.isfinite(self.covariance).all():
            return None
        information = np.linalg.inv(self.covariance)
        return 0.5 * (information + information.T)


def select_pose(
    target: SceneView,
    source: SceneView,
    evaluated: Sequence[EvaluatedPose],
    params: Params,
    *,
    seconds: dict[str, float],
    notes: Sequence[str] = (),
    elsewhere: Sequence[float] = (),
) -> Registration:
    """Return the accepted pose, or the best pose with the evidence against it, or the reason why no pose was found.

    Args:
        elsewhere: similarities under poses that were not evaluated (`EvaluatedPose.similarity`).
    """
    common: dict[str, Any] = {"target": target.id, "source": source.id, "seconds": seconds}
    if not evaluated:
        fewest = num_nodes(target, source)
        why = reason(
            "no_pose_proposed",
            f"chance explains every proposed pose (the smaller scene graph has {fewest} nodes)",
        )
        return Registration(status="no_match", reason=why, notes=tuple(notes), **common)
    accepted = [j for j in evaluated if not j.flaw]
    best = _most_similar(accepted) if accepted else min((j for j in evaluated if j.own is None), key=_sort_key)
    stated = best.own or best.proposal
    status, why = ("accepted", "") if accepted else ("rejected", best.flaw)
    # A pose that is too uncertain to become an edge still counts as a rival.
    others = [j for j in evaluated if not _same(best, j, target, source) and _may_be_correct(j, best, params)]
    as_similar = [j for j in others if np.isfinite(j.similarity - best.similarity)]
    least = max(best.similarity - MARGIN, MARGIN)
    num_as_similar = len(as_similar) + sum(not similarity < least for similarity in elsewhere)
    others = [j for j in others if j not in as_similar]
    alike = look_alike_probability(best.evidence, best.similarity)
    among = _probability_among(best, others, num_as_similar)
    probable = among * (1.0 - float(np.nan_to_num(alike)))
    bar = params.verdict.min_probability
    rivals = as_similar or [j for j in others if verdict.is_acceptable(j.proposal, j.evidence, params.verdict)]
    if among < bar:
        rivals = rivals or sorted(others, key=lambda j: -odds_of(j))
    if accepted and (rivals or num_as_similar):
        status = "no_match"
        if rivals:
            told = f"{_describe_distance(best, rivals[0], target, source)}, and the first"
        else:
            told = f"the surfaces are as similar under {counted(num_as_similar, 'other pose')}, and this one"
        why = reason("ambiguous", f"ambiguous: {told} is correct with a probability of {probable:.0%}")
    elif accepted and (alike > 1.0 - bar or probable < bar <= among):
        status = "rejected"
        why = reason("look_alike", f"two places that look alike ({alike:.0%}), or one place that was refurnished")
    elif not accepted and not verdict.has_low_nfa(best.proposal, params.verdict):
        status, why = "no_match", verdict.not_significant(best.proposal, params.verdict, best.flaw)
    if accepted and status != "no_match":
        if best.decision is not None and best.decision.note:
            notes = (*notes, best.decision.note)
        if best.deformation is not None:
            notes = (*notes, best.deformation.note())
    return Registration(
        status=status,
        reason=why,
        S_target_source=best.proposal.S_target_source if status != "no_match" else None,
        information=best.information if status != "no_match" else None,  # a person may confirm a rejected pair
        num_inliers=stated.num_inliers,
        num_correspondences=stated.num_correspondences,
        overlap=best.evidence.overlap,
        proposer=best.proposal.proposer,
        exact=best.proposal.exact,
        evidence=_evidence_figures(best, probable, alike),
        notes=tuple(notes),
        **common,
    )


def is_same_pose(a: Sim3, b: Sim3, centre: np.ndarray, unit_m: float) -> bool:
    """Return whether two poses would be refined to the same pose.

    Args:
        centre: (3,) centre of the source's content, in the source's frame.
        unit_m: working metres per unit of the target.
    """
    return bool(
        abs(np.log(a.scale / b.scale)) < SAME_LOG_SCALE
        and np.degrees(angle_between(a.rotation, b.rotation)) < SAME_ROTATION_DEG
        and np.linalg.norm(a.apply(centre) - b.apply(centre)) * unit_m < SAME_DISTANCE_M
    )


def _same(a: EvaluatedPose, b: EvaluatedPose, target: SceneView, source: SceneView) -> bool:
    poses = a.proposal.S_target_source, b.proposal.S_target_source
    return is_same_pose(*poses, source.centre, own_working_m(target))


def _describe_distance(a: EvaluatedPose, b: EvaluatedPose, target: SceneView, source: SceneView) -> str:
    S, Q = a.proposal.S_target_source, b.proposal.S_target_source
    centre = source.centre
    degrees = np.degrees(angle_between(S.rotation, Q.rotation))
    metres = np.linalg.norm(S.apply(centre) - Q.apply(centre)) * target.graph.unit_m
    return f"two poses lie {degrees:.0f} deg and {metres:.1f} m apart"


def contradiction_of(evaluated: EvaluatedPose, params: Params) -> str:
    """Return the evidence that alone rules out a pose; empty if there is none."""
    return verdict.contradiction(evaluated.proposal, evaluated.evidence, params.verdict)


def _may_be_correct(evaluated: EvaluatedPose, best: EvaluatedPose, params: Params) -> bool:
    """Return whether a pose may be correct in place of the best pose. Where the surfaces are about as similar under it,
    renders whose colours agree little do not rule it out."""
    lead = _lead(best, evaluated)
    if lead > MARGIN:
        return False
    against = contradiction_of(evaluated, params)
    return not against or bool(np.isfinite(lead) and reason_code(against) == "colours_disagree")


def _lead(a: EvaluatedPose, b: EvaluatedPose) -> float:
    """Return by how much the surfaces are more similar under pose a than under b; NaN if that is not known.

    Colours of renders count by their significance: in a small room few patches are compared.
    """
    (one, sigma), (other, sigma_other) = (_similarity_of_renders(j.evidence) for j in (a, b))
    weight = 1.0 / (1.0 + (sigma**2 + sigma_other**2) / _RENDERS_SIGMA**2)
    return a.similarity - b.similarity + weight * (one - other)


def _similarity_of_renders(evidence: PoseEvidence) -> tuple[float, float]:
    """Return `fisher_z` of the colour correlation of renders, and its standard deviation."""
    r, t = evidence.colour_correlation, evidence.colour_t
    if not t:  # nothing was compared
        return 0.0, float("inf")
    return fisher_z(r), abs(r) / max(abs(t), 1e-3) / max(1.0 - r**2, 1e-3)


def _most_similar(accepted: Sequence[EvaluatedPose]) -> EvaluatedPose:
    """Return the accepted pose under which the surfaces are most similar; the first one if that is not known."""
    return max(accepted, key=lambda j: np.nan_to_num(j.similarity, nan=-np.inf))


def odds_of(evaluated: EvaluatedPose) -> float:
    """Return the odds that a pose is correct, by its own evidence."""
    p = probability(evaluated.proposal, evaluated.evidence, verdict.PRIOR)
    return p / (1.0 - p)


def _probability_among(best: EvaluatedPose, others: Sequence[EvaluatedPose], num_equal: int) -> float:
    """Return the probability that a pose is correct, if at most one of all poses is: itself, some others, and a number
    of poses that are as probable as it is."""
    odds = odds_of(best)
    return odds / (1.0 + (1 + num_equal) * odds + sum(odds_of(j) for j in others))


def _evidence_figures(evaluated: EvaluatedPose, probable: float, alike: float) -> dict[str, float]:
    """Return the evidence as stored with the registration; see `gsmap.types.Registration`."""
    p, e, stated = evaluated.proposal, evaluated.evidence, evaluated.own or evaluated.proposal
    log_scale = log_scale_sigma = float("nan")
    if evaluated.decision is not None:
        log_scale, log_scale_sigma = evaluated.decision.log_scale, evaluated.decision.measured_sigma
    elif evaluated.covariance is not None:
        log_scale, log_scale_sigma = float(np.log(p.S_target_source.scale)), float(np.sqrt(evaluated.covariance[6, 6]))
    return {
        "log_nfa": stated.log_nfa,
        "runner_up": stated.runner_up,
        "free_space_violation": e.free_space_violation,
        "num_seen": float(e.num_seen),
        "num_judged": float(e.num_judged),
        "num_coinciding": float(e.num_coinciding),
        "colour_correlation": e.colour_correlation,
        "colour_t": e.colour_t,
        "probability": probable if e.num_coinciding else float("nan"),
        "similarity": evaluated.similarity,
        "look_alike": alike,
        "disagreement": e.disagreement,
        "seen_m2": e.seen_m2,
        "log_scale": log_scale,
        "log_scale_sigma": log_scale_sigma,
    }


def _sort_key(evaluated: EvaluatedPose) -> tuple[float, float]:
    """Return the sort key of rejected poses: the most evidence first."""
    return (-evaluated.evidence.colour_correlation * evaluated.evidence.num_coinciding, evaluated.proposal.log_nfa)
