"""Register one pair of scenes: propose poses, refine and verify each, and select one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gsmap.reason_codes import reason
from gsmap.register import covariance, refinement, verdict
from gsmap.register.duplicate import find_duplicate
from gsmap.register.evidence import PoseEvidence, measure
from gsmap.register.metric_scene import MetricPair, own_working_m
from gsmap.register.params import Params
from gsmap.register.pose_selection import EvaluatedPose, contradiction_of, is_same_pose, odds_of, select_pose
from gsmap.register.proposal_rounds import ProposalRounds
from gsmap.register.repetition import Repetition
from gsmap.register.scale_selection import refine_and_select_scale
from gsmap.register.scene_view import SceneView
from gsmap.register.timing import Stopwatch
from gsmap.types import Registration, Sim3
from gsmap.types.progress import Progress, silent
from gsmap.types.registration import Proposal, Support

# Share of the proposed pose's inliers that must be inliers of the refined pose, too; with fewer the proposed pose is
# evaluated instead.
_MIN_EXPLAINED = 0.5
_MIN_ODDS = 0.5  # of the most probable pose, from which poses elsewhere are compared with it


def register_pair(
    target: SceneView, source: SceneView, params: Params | None = None, progress: Progress | None = None
) -> Registration:
    """Estimate the pose of ``source`` in ``target``, or the reason why there is none.

    The scene graphs propose poses (`gsmap.register.proposers.graph`: correspondences, compatibility graph, maximum
    clique, pose); each pose is refined on the surfaces and verified by renders of both scenes. Where a graph has few
    nodes, surfaces propose poses as well. The first accepted pose is selected, unless a rival pose is acceptable, too.

    Returns:
        `Registration`: ``accepted`` with pose and information; ``rejected`` with the best pose and the evidence against
        it; ``no_match`` with the reason. Never raises for scenes that do not match.
    """
    params, report, watch = params or Params(), progress or silent, Stopwatch()
    proposing, evaluated, tried = ProposalRounds(target, source, params, watch), list[EvaluatedPose](), list[Proposal]()
    report(0.0, "matching")
    for proposals in proposing.rounds():  # candidates -> correspondences -> compatibility graph -> clique -> pose
        before = len(evaluated)
        for proposal in proposals:
            if len(evaluated) - before >= params.max_poses:
                break
            if not _is_worth_evaluating(proposal, evaluated, target, source):
                continue
            done = min(len(evaluated) / params.max_poses, 1.0)
            report(0.2 + 0.7 * done, f"verifying a pose proposed by {proposal.proposer}")
            tried.append(proposal)
            evaluated.append(_evaluate(proposal, target, source, params, watch))  # refine -> evidence -> decide
            if not evaluated[-1].flaw and verdict.is_significant(evaluated[-1].proposal, params.verdict):
                break
        if any(not j.flaw for j in evaluated):
            break
    evaluated += _rivals(evaluated, tried, target, source, params, watch)
    evaluated, elsewhere = _compare_elsewhere(evaluated, target, source, params, watch)
    report(1.0, "done")
    found = select_pose(
        target, source, evaluated, params, seconds=watch.seconds, notes=proposing.notes, elsewhere=elsewhere
    )
    same = find_duplicate(target, source, found)
    return replace(found, notes=(*found.notes, same)) if same else found


def check_pose(target: SceneView, source: SceneView, proposal: Proposal, params: Params | None = None) -> Registration:
    """Refine and verify a given pose, without proposing any.

    Returns:
        `Registration`: ``accepted`` with the refined pose, or ``rejected`` or ``no_match`` as by `register_pair`.
    """
    params, watch = params or Params(), Stopwatch()
    evaluated = _evaluate(proposal, target, source, params, watch)
    return select_pose(target, source, [evaluated], params, seconds=watch.seconds)


def evaluate_pose(
    target: SceneView, source: SceneView, proposal: Proposal, params: Params | None = None
) -> EvaluatedPose:
    """Refine a pose and measure all its evidence without a prescreen; the verdict's model is fitted to such results."""
    return _evaluate(proposal, target, source, params or Params(), Stopwatch(), prescreen=False)


def _is_worth_evaluating(
    proposal: Proposal, evaluated: list[EvaluatedPose], target: SceneView, source: SceneView
) -> bool:
    """Return whether chance does not explain a proposal and no similar pose was evaluated before."""
    if proposal.log_nfa > verdict.PRESCREEN_LOG_NFA:
        return False
    S, centre, unit_m = proposal.S_target_source, source.centre, own_working_m(target)
    return not any(is_same_pose(S, j.proposal.S_target_source, centre, unit_m) for j in evaluated)


def _rivals(
    evaluated: Sequence[EvaluatedPose],
    tried: Sequence[Proposal],
    target: SceneView,
    source: SceneView,
    params: Params,
    watch: Stopwatch,
) -> list[EvaluatedPose]:
    """Evaluate rivals of the accepted pose until one is acceptable; return none if the accepted pose is significant."""
    best = next((j for j in evaluated if not j.flaw), None)
    if best is None or best.proposal.support is None or verdict.is_significant(best.proposal, params.verdict):
        return []
    support, S, found = best.proposal.support, best.proposal.S_target_source, list[EvaluatedPose]()
    known = [p.S_target_source for p in (*tried, *(j.proposal for j in evaluated)) if not p.flaw]
    for _ in range(params.max_poses):
        rival = support.rival(S, best.proposal.log_nfa, known)
        if rival is None:
            break
        found.append(_evaluate(rival, target, source, params, watch))
        if verdict.is_acceptable(found[-1].proposal, found[-1].evidence, params.verdict):
            break
        known += [rival.S_target_source, found[-1].proposal.S_target_source]
    return found


def _compare_elsewhere(
    evaluated: list[EvaluatedPose], target: SceneView, source: SceneView, params: Params, watch: Stopwatch
) -> tuple[list[EvaluatedPose], list[float]]:
    """Compare the most probable pose with all poses elsewhere under which both surfaces are about as similar.

    Returns:
        All evaluated poses, the most similar poses elsewhere among them, with their similarities; and the similarities
        of the other poses elsewhere, which are too many to evaluate.
    """
    best = max((j for j in evaluated if not contradiction_of(j, params)), key=odds_of, default=None)
    if best is None or odds_of(best) < _MIN_ODDS:
        return evaluated, []
    up = target.graph.up
    if up is None and source.graph.up is not None:
        up = best.proposal.S_target_source.rotation @ source.graph.up
    pair, centre, unit_m = MetricPair.of(target, source, best.proposal, params), source.centre, own_working_m(target)
    with watch.step("verdict"):
        pose = pair.to_metres(best.proposal.S_target_source)
        repetition = Repetition(pair.target.surface(), pair.source.surface(), pose, up)
        elsewhere = repetition.elsewhere()
    left, known = list[tuple[Sim3, float]](), [j.proposal.S_target_source for j in evaluated]
    for S, similarity in ((pair.to_scene_units(S), similarity) for S, similarity in elsewhere):
        if not any(is_same_pose(S, other, centre, unit_m) for other in known):
            left.append((S, similarity))
            known.append(S)
    # In a place that repeats, correspondences favour no period: each counts as much as the most probable pose.
    proposals = [replace(best.proposal, S_target_source=S, support=None) for S, _ in left[: params.max_poses]]
    repeated = [_evaluate(proposal, target, source, params, watch) for proposal in proposals]
    evaluated = [*evaluated, *(replace(j, own=_supported(j.proposal, best.proposal.support)) for j in repeated)]
    with watch.step("verdict"):
        poses = [pair.to_metres(j.proposal.S_target_source) for j in evaluated]
        compared = [replace(j, similarity=repetition.similarity(S)) for j, S in zip(evaluated, poses, strict=True)]
    return compared, [similarity for _, similarity in left[params.max_poses :]]


def _supported(proposal: Proposal, support: Support | None) -> Proposal:
    """Return a proposal with the number of inliers and of false alarms that it has by given correspondences."""
    num_inliers, log_nfa = (0, float("nan")) if support is None else support.count(proposal.S_target_source)
    return replace(proposal, num_inliers=num_inliers, log_nfa=log_nfa, runner_up=float("nan"))


def _evaluate(
    proposal: Proposal,
    target: SceneView,
    source: SceneView,
    params: Params,
    watch: Stopwatch,
    *,
    prescreen: bool = True,
) -> EvaluatedPose:
    """Refine a proposal, measure the evidence for and against it, and decide."""
    if proposal.flaw:
        return EvaluatedPose(proposal, PoseEvidence(), covariance=None, flaw=proposal.flaw)
    pair = MetricPair.of(target, source, proposal, params)
    with watch.step("refine"):
        surfaces = pair.target.surface(), pair.source.surface()
        pose = refinement.refine_coarse(
            pair, pair.to_metres(proposal.S_target_source), params, with_scale=proposal.with_scale
        )
    with watch.step("verdict"):
        views = pair.target.views(), pair.source.views()
        seen = measure(
            *surfaces, pose, views, num_cameras=verdict.PRESCREEN_CAMERAS, max_points=verdict.PRESCREEN_POINTS
        )
        # A clique that is significant by itself is always verified in full, even if three cameras contradict the rough
        # pose.
        sure = verdict.is_significant(proposal, params.verdict)
        flaw = "" if sure or not prescreen else verdict.fails_prescreen(seen)
    uncertainty, decision = None, None
    if not flaw:
        with watch.step("refine"):
            pose, uncertainty, decision = refine_and_select_scale(pair, pose, params, with_scale=proposal.with_scale)
        with watch.step("verdict"):
            seen = measure(*surfaces, pose, views, num_cameras=params.num_cameras)
        with watch.step("polish"):
            polished = refinement.polish(pair, pose, params, with_scale=decision is None or not decision.rigid)
            if polished is not pose:
                better = measure(*surfaces, polished, views, num_cameras=params.num_cameras)
                if better.colour_correlation > seen.colour_correlation:
                    pose, seen = polished, better
    S = pair.to_scene_units(pose)
    if decision is not None and decision.rigid:
        S = Sim3(S.rotation, S.translation)
    refined = replace(proposal, S_target_source=S, with_scale=decision is None or not decision.rigid)
    support = None if flaw else proposal.support
    before, (after, log_nfa) = (0, (0, proposal.log_nfa))
    if support is not None:
        before, (after, log_nfa) = support.count(proposal.S_target_source)[0], support.count(S)
    if after >= _MIN_EXPLAINED * before:
        refined = replace(refined, log_nfa=log_nfa)
    else:
        # The surfaces pulled the pose away from its correspondences, so the proposed pose is evaluated instead.
        pose, decision = pair.to_metres(proposal.S_target_source), None
        matches = pair.correspondences_of(proposal)
        assert matches is not None
        uncertainty = covariance.uncertainty_of_correspondences(matches, pose)
        with watch.step("verdict"):
            seen = measure(*surfaces, pose, views, num_cameras=params.num_cameras)
        refined = proposal
    if not flaw and refined is proposal and not verdict.has_low_nfa(proposal, params.verdict):
        flaw = reason(
            "correspondences_lost",
            "refinement moved the pose away from its correspondences, and chance explains the proposed pose",
        )
    proposal = refined
    flaw = flaw or verdict.decide(proposal, seen, None if uncertainty is None else uncertainty.sigmas, params.verdict)
    in_units = None if uncertainty is None else covariance.in_scene_units(uncertainty.covariance, pair.source.unit_m)
    deformation = None
    if in_units is not None and not flaw:
        from gsmap.register.deformation import fit_deformation  # imported here, as the recipe key does not need it

        with watch.step("refine"):
            found = fit_deformation(*surfaces, pose)
        if found is not None and (found.is_stretched or found.is_bent):
            deformation = found
            in_units = in_units + covariance.in_scene_units(deformation.covariance(pose.scale), pair.source.unit_m)
    return EvaluatedPose(proposal, seen, in_units, flaw, decision, deformation)
