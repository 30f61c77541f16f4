"""Registering one pair of scenes: the recipe."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from gsmap.register import covariance, refinement, verdict
from gsmap.register.conclusion import Judged, conclude, is_same_pose
from gsmap.register.duplicate import same_capture
from gsmap.register.evidence import PoseEvidence, measure
from gsmap.register.metric import MetricPair, own_working_m
from gsmap.register.params import Params
from gsmap.register.proposing import Proposing
from gsmap.register.scaling import scaled_or_rigid
from gsmap.register.scene_view import SceneView
from gsmap.register.stopwatch import Stopwatch
from gsmap.types import Registration, Sim3
from gsmap.types.progress import Progress, silent
from gsmap.types.registration import Proposal

# Share of the correspondences that agree with a proposed pose that must agree with the refined one; with fewer the
# proposed pose is judged in its place.
_MIN_EXPLAINED = 0.5


def register_pair(
    target: SceneView, source: SceneView, params: Params | None = None, progress: Progress | None = None
) -> Registration:
    """Where ``source`` lies in ``target``, if that can be told.

    The graphs propose poses (`gsmap.register.proposers.graph`: correspondences, compatibility graph, maximum clique,
    pose); each is refined on the surfaces and judged by the evidence of both scenes. Where no graph convinces, the
    surfaces propose as well. The first pose that is accepted wins, unless its rival is accepted too: then nothing is.

    Returns:
        `Registration`: ``accepted`` with pose and information; ``rejected`` with the best pose and what speaks against
        it; ``no_match`` with the reason. Never raises for scenes that do not match.
    """
    params, report, watch = params or Params(), progress or silent, Stopwatch()
    proposing, judged, tried = Proposing(target, source, params, watch), list[Judged](), list[Proposal]()
    report(0.0, "matching")
    for proposals in proposing.rounds():  # candidates -> correspondences -> compatibility graph -> clique -> pose
        before = len(judged)
        for proposal in proposals:
            if len(judged) - before >= params.max_poses:
                break
            if not _is_worth_judging(proposal, judged, target, source):
                continue
            done = min(len(judged) / params.max_poses, 1.0)
            report(0.2 + 0.7 * done, f"judging a pose by {proposal.proposer}")
            tried.append(proposal)
            judged.append(_judge(proposal, target, source, params, watch))  # refine -> evidence -> decide
            if not judged[-1].flaw and verdict.is_significant(judged[-1].proposal, params.verdict):
                break
        if any(not j.flaw for j in judged):
            break
    judged += _rivals(judged, tried, target, source, params, watch)
    report(1.0, "done")
    found = conclude(target, source, judged, params, seconds=watch.seconds, notes=proposing.notes)
    same = same_capture(target, source, found)
    return replace(found, notes=(*found.notes, same)) if same else found


def check_pose(target: SceneView, source: SceneView, proposal: Proposal, params: Params | None = None) -> Registration:
    """Refine and judge a pose that is known from elsewhere, and look for no other.

    Returns:
        `Registration`: ``accepted`` with the refined pose, or what speaks against it, as `register_pair` answers.
    """
    params, watch = params or Params(), Stopwatch()
    judged = _judge(proposal, target, source, params, watch)
    return conclude(target, source, [judged], params, seconds=watch.seconds)


def measured(target: SceneView, source: SceneView, proposal: Proposal, params: Params | None = None) -> Judged:
    """A pose refined and all its evidence gathered, however hopeless it looks: what the verdict is fitted on."""
    return _judge(proposal, target, source, params or Params(), Stopwatch(), prescreen=False)


def _is_worth_judging(proposal: Proposal, judged: list[Judged], target: SceneView, source: SceneView) -> bool:
    """Neither explained by the background model, nor judged before."""
    if proposal.log_nfa > verdict.PRESCREEN_LOG_NFA:
        return False
    S, centre, unit_m = proposal.S_target_source, source.centre, own_working_m(target)
    return not any(is_same_pose(S, j.proposal.S_target_source, centre, unit_m) for j in judged)


def _rivals(
    judged: Sequence[Judged],
    tried: Sequence[Proposal],
    target: SceneView,
    source: SceneView,
    params: Params,
    watch: Stopwatch,
) -> list[Judged]:
    """Rivals of the accepted pose that its own nodes propose, judged until one is believed; none where it is sure."""
    best = next((j for j in judged if not j.flaw), None)
    if best is None or best.proposal.support is None or verdict.is_significant(best.proposal, params.verdict):
        return []
    support, S, found = best.proposal.support, best.proposal.S_target_source, list[Judged]()
    known = [p.S_target_source for p in (*tried, *(j.proposal for j in judged)) if not p.flaw]
    for _ in range(params.max_poses):
        rival = support.rival(S, best.proposal.log_nfa, known)
        if rival is None:
            break
        found.append(_judge(rival, target, source, params, watch))
        if verdict.is_believable(found[-1].proposal, found[-1].evidence, params.verdict):
            break
        known += [rival.S_target_source, found[-1].proposal.S_target_source]
    return found


def _judge(
    proposal: Proposal,
    target: SceneView,
    source: SceneView,
    params: Params,
    watch: Stopwatch,
    *,
    prescreen: bool = True,
) -> Judged:
    """Refine a proposal, gather the evidence for and against it, and decide."""
    if proposal.flaw:
        return Judged(proposal, PoseEvidence(), covariance=None, flaw=proposal.flaw)
    pair = MetricPair.of(target, source, proposal, params)
    with watch.step("refine"):
        surfaces = pair.target.surface(), pair.source.surface()
        pose = refinement.coarse(pair, pair.to_metres(proposal.S_target_source), params, with_scale=proposal.with_scale)
    with watch.step("verdict"):
        views = pair.target.views(), pair.source.views()
        seen = measure(
            *surfaces, pose, views, num_cameras=verdict.PRESCREEN_CAMERAS, max_points=verdict.PRESCREEN_POINTS
        )
        # A clique that is significant by itself is worth a full look, whatever three cameras say of a rough pose.
        sure = verdict.is_significant(proposal, params.verdict)
        flaw = "" if sure or not prescreen else verdict.fails_prescreen(seen)
    known, belief = None, None
    if not flaw:
        with watch.step("refine"):
            pose, known, belief = scaled_or_rigid(pair, pose, params, with_scale=proposal.with_scale)
        with watch.step("verdict"):
            seen = measure(*surfaces, pose, views, num_cameras=params.num_cameras)
        with watch.step("polish"):
            polished = refinement.polished(pair, pose, params, with_scale=belief is None or not belief.rigid)
            if polished is not pose:
                better = measure(*surfaces, polished, views, num_cameras=params.num_cameras)
                if better.colour_correlation > seen.colour_correlation:
                    pose, seen = polished, better
    S = pair.to_scene_units(pose)
    if belief is not None and belief.rigid:
        S = Sim3(S.rotation, S.translation)
    refined = replace(proposal, S_target_source=S, with_scale=belief is None or not belief.rigid)
    support = None if flaw else proposal.support
    before, (after, log_nfa) = (0, (0, proposal.log_nfa))
    if support is not None:
        before, (after, log_nfa) = support.count(proposal.S_target_source)[0], support.count(S)
    if after >= _MIN_EXPLAINED * before:
        refined = replace(refined, log_nfa=log_nfa)
    else:
        # The surfaces pulled the pose away from what proposed it: what that was is judged, as it was proposed.
        pose, belief = pair.to_metres(proposal.S_target_source), None
        ties = pair.tied(proposal)
        assert ties is not None
        known = covariance.known_by_correspondences(ties, pose)
        with watch.step("verdict"):
            seen = measure(*surfaces, pose, views, num_cameras=params.num_cameras)
        refined = proposal
    if not flaw and refined is proposal and not verdict.is_rare(proposal, params.verdict):
        flaw = "surfaces pull the pose away from its correspondences, which chance explains"
    proposal = refined
    flaw = flaw or verdict.judge(proposal, seen, None if known is None else known.sigmas, params.verdict)
    in_units = None if known is None else covariance.in_scene_units(known.covariance, pair.source.unit_m)
    return Judged(proposal, seen, in_units, flaw, belief)
