"""Explain why a pair is, or is not, an edge of the map, and what would decide an open case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from gsmap.map.reports import pair_report
from gsmap.map.scene_lookup import KEPT, keys_of_lookups
from gsmap.map.settings import Settings
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.stages.describe import graph_keys
from gsmap.map.stages.register import placed_scenes
from gsmap.register import verdict
from gsmap.retrieve import PairSchedule, neighbours
from gsmap.store import Store
from gsmap.types import Scene
from gsmap.types.rows.pairs import ExplanationStep, PairExplanation, PairReport


@snapshot_read
def explain_pair(store: Store, settings: Settings, a: Scene, b: Scene, *, has_buttons: bool = False) -> PairExplanation:
    """List every step of a pair from stored results, without computing anything again.

    Args:
        has_buttons: name the buttons of the page in place of commands.
    """
    pair = pair_report(store, a, b)
    is_tried = pair.status != "never registered"
    rank, untried = _retrieval(store, settings, a, b)
    value = f"tried{rank}" if is_tried else f"never tried{rank}; {untried}"
    retrieval = ExplanationStep(name="retrieval", value=value, bar="among the candidates", passed=is_tried)
    steps = [retrieval, *_steps(pair, settings)]
    advice = _advice(pair, {step.name: step for step in steps}, untried, has_buttons)
    ends = {name: getattr(pair, name) for name in ("target", "target_name", "source", "source_name")}
    return PairExplanation(
        **ends, status=pair.status, reason=pair.reason, reason_code=pair.reason_code, steps=tuple(steps), advice=advice
    )


def _retrieval(store: Store, settings: Settings, a: Scene, b: Scene) -> tuple[str, str]:
    """Return the best rank of the pair in retrieval, and the reason why ``--pairs auto`` did not try the pair, by the
    rules of `gsmap.map.stages.register`.
    """
    params, names = settings.retrieve, {a.id: a.name, b.id: b.name}
    keys = keys_of_lookups(graph_keys(store, (a, b), settings), params)
    lookups = {one.scene: one for one in store.indexes.lookups(list(names))}
    listed = sorted(
        (rank, one.scene, candidate.score)
        for one in lookups.values()
        for rank, candidate in enumerate(one.candidates, 1)
        if candidate.scene in names
    )
    rank = ""
    if listed:
        first, scene, score = listed[0]
        rank = f": no. {first} of what {names[scene]} was paired with, score {score:.3g}"
    if any(scene not in lookups or lookups[scene].key != keys[scene] for scene in names):
        return rank, "the next gsmap update retrieves candidates for these scenes"
    held, enough = (
        _held(store, settings),
        f"{params.max_edges_per_scene} edges that are not doubtful (retrieve.max_edges_per_scene)",
    )
    askers = {scene for first, scene, _ in listed if first <= params.top_k}
    is_open = {
        one: lookups[one].num_left is None or sum(one in pair for pair in held) < params.max_edges_per_scene
        for one in askers
    }
    if any(is_open.values()):
        return rank, "the next gsmap update tries the pair"
    if askers:
        return rank, f"left out to save time: both scenes already had {enough}, which connected them over another scene"
    if neighbours({scene: at for scene, at in placed_scenes(store).items() if scene in names}, params):
        if PairSchedule((), (), held, params).is_redundant(a.id, b.id):
            return rank, f"left out to save time: both scenes have {enough}, which connect them over another scene"
        return rank, "the scenes touch in the map, and gsmap update tries the nearest of such pairs"
    if listed or any(len(one.candidates) >= KEPT * params.top_k for one in lookups.values()):
        return rank, f"other scenes are more promising, and the first {params.top_k} are tried (retrieve.top_k)"
    return rank, "retrieval found nothing that both scenes show"


def _held(store: Store, settings: Settings) -> list[tuple[str, str]]:
    """Return the pairs that have a usable edge without doubt."""
    bar = settings.optimize.max_look_alike
    return [
        (one.target, one.source)
        for one in store.registrations.all_summaries()
        if one.usable and (one.is_specified or not one.look_alike > bar)
    ]


def _steps(pair: PairReport, settings: Settings) -> list[ExplanationStep]:
    if pair.status == "never registered":
        return []
    steps = []
    if pair.proposer:
        steps += _evidence(pair, settings.register.verdict, settings.optimize.max_look_alike)
    steps.append(ExplanationStep(name="verdict", value=pair.status, bar="accepted", passed=pair.status == "accepted"))
    if pair.review:
        steps.append(ExplanationStep(name="review", value=pair.review))
    if pair.status == "accepted":
        passed = None if pair.unsolved else pair.use == "used"
        steps.append(ExplanationStep(name="the other edges", value=pair.use, bar="bear it out: used", passed=passed))
    return steps


def _evidence(pair: PairReport, bars: verdict.Params, max_look_alike: float) -> list[ExplanationStep]:
    """Return the evidence for the pose, each item with its threshold."""
    figures: Mapping[str, Any] = pair.evidence

    def known(figure: str) -> float | None:
        value = float(figures.get(figure, np.nan))
        return value if np.isfinite(value) else None

    def held(name: str, figure: str, bar: float, *, at_least: bool = False, note: str = "") -> ExplanationStep:
        value = known(figure)
        passed = None if value is None else bool(value >= bar if at_least else value <= bar)
        words = f"{'at least' if at_least else 'at most'} {bar:g}{note}"
        return ExplanationStep(name=name, value=value, bar=words, passed=passed)

    violation, allowed = float(figures.get("free_space_violation", np.nan)), bars.max_free_space_violation
    free_space = held("free-space violation", "free_space_violation", allowed, note=", beyond chance")
    if free_space.passed is False:
        judged = float(figures.get("num_judged", np.nan))
        free_space = replace(free_space, passed=not verdict.violates_free_space(violation, judged, allowed))
    return [
        ExplanationStep(name="correspondences", value=pair.num_correspondences),
        ExplanationStep(name="clique", value=pair.num_inliers),
        ExplanationStep(name="log10 false alarms", value=known("log_nfa")),
        ExplanationStep(name="rival clique", value=known("runner_up")),
        ExplanationStep(name="pose by", value=pair.proposer),
        ExplanationStep(name="overlap", value=pair.overlap),
        held("coinciding cells", "num_coinciding", bars.min_coinciding, at_least=True),
        held("colour correlation", "colour_correlation", bars.min_colour_correlation, at_least=True),
        ExplanationStep(name="colour significance", value=known("colour_t")),
        free_space,
        held("probability", "probability", bars.min_probability, at_least=True, note=", of all of these"),
        ExplanationStep(name="disagreement", value=known("disagreement")),
        held("look-alike", "look_alike", max_look_alike, note=" that these are two places, or the edge is doubtful"),
    ]


def _advice(pair: PairReport, steps: Mapping[str, ExplanationStep], untried: str, has_buttons: bool) -> str:
    """Return advice for the first open step; empty if there is none."""
    a, b, at = pair.target_name, pair.source_name, "MAP"
    confirm = "Confirm, below" if has_buttons else f"gsmap confirm {at} {pair.pair}"
    review = "Confirm or Reject, below" if has_buttons else f"gsmap confirm or reject {at} {pair.pair}"
    failed = {name for name, step in steps.items() if step.passed is False}
    if pair.review or pair.used is True:
        return ""
    if pair.status == "never registered":
        return f"{untried}; to try it all the same: gsmap register {at} --pairs {pair.pair}"
    in_doubt = "look-alike" in failed
    if in_doubt and pair.status == "accepted":
        return (
            "either the place changed, or two places look alike; to decide, add a capture that walks from what "
            f"{a} shows to what {b} shows, or date both captures "
            f"(gsmap edit {at} SCENE --captured-at DATE); if you know the answer: {review}"
        )
    if pair.status == "accepted":
        return (
            f"a further capture that overlaps both {a} and {b} closes a loop that confirms or "
            f"contradicts the edge; if you know the answer: {review}"
        )
    if "coinciding cells" in failed or pair.status == "no_match":
        return f"add a capture of the way from {a} to {b} that shares about a third with each"
    if "free-space violation" in failed or in_doubt:
        return f"either two places look alike, or one place changed a lot; if you know that it is one place: {confirm}"
    return f"add a capture that shows more of what {a} and {b} share, from both sides"
