"""Single edges that contradict the way round: the less likely one is let go, whichever came first, or none is used."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from made_worlds import PLACING, poses_at, true_edges

from gsmap.optimize import Params, log_odds_wrong, optimize
from gsmap.optimize.contradictions import find_contradicting_edges
from gsmap.optimize.measurements import measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.state import State
from gsmap.types import Sim3

QUICK = Params(marginals=False)
NEAR = {"colour_correlation": 0.93, "disagreement": 0.001, "free_space_violation": 0.001}  # a right pose, overlap .75
AFAR = {"colour_correlation": 0.85, "disagreement": 0.03, "free_space_violation": 0.002}  # a right one, overlap .4
ALONG = {"colour_correlation": 0.48, "disagreement": 0.012, "free_space_violation": 0.012}  # a front laid along itself
STEP_M, OFF_M = 10.0, 33.0
NAMES = list(permutations("abde"))[::5]  # of ids, by which equals are ordered


def told(edge, evidence, overlap):
    return replace(edge, disagreement=evidence["disagreement"], log_odds_wrong=log_odds_wrong(evidence, overlap))


def front(names=("a", "b", "d", "e"), **looks):
    """Captures along a front that lacks one between b and d: the right edges, and a wrong one from the first to the
    last, which lays them over each other."""
    rng = np.random.default_rng(5)
    truth = poses_at(np.c_[STEP_M * np.array([0.0, 1.0, 3.0, 4.0]), np.zeros((4, 2))])
    truth.rotations[:] = np.eye(3)
    right = true_edges(truth, np.array([(0, 1), (1, 2), (2, 3)]), rng, list(names))
    seen = [(NEAR, 0.75), (looks.get("afar", AFAR), 0.4), (NEAR, 0.75)]
    right = [told(edge, *what) for edge, what in zip(right, seen, strict=True)]
    (wrong,) = true_edges(truth, np.array([(0, 3)]), rng, list(names))
    moved = wrong.S_target_source.translation - [OFF_M, 0, 0]
    wrong = replace(wrong, S_target_source=Sim3(wrong.S_target_source.rotation, moved))
    return sorted(names), right, told(wrong, looks.get("along", ALONG), looks.get("overlap", 0.9))


def uses(answer, edges):
    return [answer.use(e.target, e.source) for e in edges]


def test_a_front_laid_along_itself_is_the_less_likely_though_less_of_it_disagrees():
    assert ALONG["disagreement"] < AFAR["disagreement"]
    assert log_odds_wrong(ALONG, 0.9) - log_odds_wrong(AFAR, 0.4) > np.log(9)
    assert log_odds_wrong(ALONG, 0.9) > log_odds_wrong(ALONG, 0.4)  # of much overlap more is asked
    for name, worse in (("colour_correlation", 0.3), ("disagreement", 0.05), ("free_space_violation", 0.05)):
        assert log_odds_wrong({**ALONG, name: worse}, 0.9) > log_odds_wrong(ALONG, 0.9)
    chance, significant, sure = (log_odds_wrong({**ALONG, "log_nfa": n}, 0.9) for n in (-2.0, -8.0, -90.0))
    assert chance - significant == pytest.approx(6 * np.log(10))
    assert significant == sure == log_odds_wrong(ALONG, 0.9)
    assert np.isnan(log_odds_wrong({"colour_correlation": 0.8}, 0.5))  # a scene without cameras
    assert np.isnan(log_odds_wrong({}, 0.0))  # a person's own measurement


@pytest.mark.parametrize("names", NAMES)
def test_the_wrong_edge_is_let_go_whichever_scenes_come_first(names):
    ids, right, wrong = front(names)
    answer = optimize(ids, [*right, wrong], params=QUICK)
    assert uses(answer, right) == ["tentative"] * 3
    assert uses(answer, [wrong]) == ["unused"]
    assert len({pose.component for pose in answer.poses.values()}) == 1


@pytest.mark.parametrize("names", NAMES)
def test_where_the_evidence_does_not_separate_them_none_is_used(names):
    ids, right, wrong = front(names, along=AFAR, overlap=0.4)
    answer = optimize(ids, [*right, wrong], params=QUICK)
    assert uses(answer, right) == ["tentative", "unused", "tentative"]
    assert uses(answer, [wrong]) == ["unused"]
    for edge in (right[1], wrong):
        outcome = answer.outcomes[edge.target, edge.source]
        assert outcome.undecided
        assert "evidence is about as good" in outcome.reason
    a, b, d, e = (answer.poses[name].component for name in names)
    assert a == b != d == e


def test_a_wrong_edge_of_better_evidence_than_all_is_believed_over_one():
    """It is a likelihood, no oracle: and what it replaces is let go, not the edges that nothing speaks against."""
    ids, right, wrong = front(afar=ALONG, along=NEAR)
    answer = optimize(ids, [*right, wrong], params=QUICK)
    assert uses(answer, [*right, wrong]) == ["tentative", "unused", "tentative", "tentative"]


def test_edges_on_a_cycle_that_agrees_are_no_suspects():
    """The way round is borne out; the edge that contradicts it is noise, however good it looks."""
    rng = np.random.default_rng(2)
    ids = [f"s{k}" for k in range(4)]
    truth = poses_at(rng.uniform(0, 9, (4, 3)))
    pairs = np.array([(0, 1), (1, 2), (2, 3), (0, 3), (0, 2)])
    known = [told(edge, AFAR, 0.4) for edge in true_edges(truth, pairs, rng, ids)]
    (odd,) = true_edges(truth, np.array([(1, 3)]), rng, ids)
    off = Sim3(odd.S_target_source.rotation, odd.S_target_source.translation + np.array([OFF_M, 0, 0]))
    odd = told(replace(odd, S_target_source=off), NEAR, 0.75)
    answer = optimize(ids, [*known, odd], params=QUICK)
    assert uses(answer, known) == ["used"] * 5
    assert uses(answer, [odd]) == ["unused"]


def test_a_confirmed_edge_is_no_suspect():
    ids, right, wrong = front(along=NEAR)
    word = replace(right[1], confirmed=True)
    answer = optimize(ids, [right[0], word, right[2], wrong], params=QUICK)
    assert answer.use(word.target, word.source) == "used"
    assert "unused" in uses(answer, [right[0], right[2], wrong])


def test_of_edges_that_nobody_registered_the_map_stands():
    ids, right, wrong = front()
    unknown = [replace(e, disagreement=float("nan"), log_odds_wrong=float("nan")) for e in (*right, wrong)]
    answer = optimize(ids, unknown, params=QUICK)
    assert sorted(uses(answer, unknown)) == ["tentative"] * 3 + ["unused"]


@pytest.mark.parametrize(("off_m", "expected"), [(2.0, []), (10.0, [3])])
def test_a_misfit_of_some_sigma_is_no_contradiction(off_m, expected):
    """Covariances are too small now and then: an edge that misses by six sigma of its loop suspects none."""
    ids, right, wrong = front()
    near = Sim3(wrong.S_target_source.rotation, [4 * STEP_M + off_m, 0, 0])
    exact = [
        replace(e, S_target_source=Sim3(np.eye(3), [along, 0, 0])) for e, along in zip(right, (10, 20, 10), strict=True)
    ]
    m = measurements(ids, [*exact, replace(wrong, S_target_source=near)])
    poses = poses_at(np.c_[[0.0, 10, 30, 40], np.zeros((4, 2))])
    poses.rotations[:] = np.eye(3)
    state = State.fresh(m, poses, np.array([True, True, True, False]), PriorTerms.stack((), ()))
    assert find_contradicting_edges(m, state, QUICK).tolist() == expected


@pytest.mark.parametrize("separable", [True, False])
def test_two_edges_that_tie_a_scene_to_a_firm_component_are_weighed_too(separable):
    rng = np.random.default_rng(4)
    ids = ["a", "b", "c", "d"]
    truth = poses_at(np.c_[STEP_M * np.array([0.0, 0.5, 1.0, 2.5]), np.zeros((4, 2))])
    truth.rotations[:] = np.eye(3)
    *firm, right, wrong = true_edges(truth, np.array([(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)]), rng, ids)
    firm, right = [told(edge, NEAR, 0.75) for edge in firm], told(right, AFAR, 0.4)
    moved = Sim3(wrong.S_target_source.rotation, wrong.S_target_source.translation - np.array([OFF_M, 0, 0]))
    wrong = told(replace(wrong, S_target_source=moved), *((ALONG, 0.9) if separable else (AFAR, 0.41)))
    answer = optimize(ids, [*firm, right, wrong], params=QUICK)
    assert uses(answer, firm) == ["used"] * 3
    assert uses(answer, [right, wrong]) == ["tentative" if separable else "unused", "unused"]
    if not separable:
        assert {(e.target, e.source) for e in (right, wrong)} <= set(answer.undecided)


@pytest.mark.parametrize("names", NAMES)
def test_what_ties_a_scene_first_is_the_likeliest(names):
    """Two wrong edges to the last capture: taken in before the chain they leave its edges contradicted."""
    rng, ids = np.random.default_rng(8), list(names)
    truth = poses_at(np.c_[STEP_M * np.array([0.0, 2.0, 3.0, 4.0]), np.zeros((4, 2))])
    truth.rotations[:] = np.eye(3)
    right = true_edges(truth, np.array([(0, 1), (1, 2), (2, 3)]), rng, ids)
    wrong = []
    for edge, back_m in zip(true_edges(truth, np.array([(0, 3), (1, 3)]), rng, ids), (36.0, 17.0), strict=True):
        moved = edge.S_target_source.translation - [back_m, 0, 0]
        wrong.append(replace(edge, S_target_source=Sim3(edge.S_target_source.rotation, moved)))
    odds = (-20.3, -21.0, -20.7, -17.0, -16.2)
    given = [
        replace(edge, log_odds_wrong=value, disagreement=0.01)
        for edge, value in zip((*right, *wrong), odds, strict=True)
    ]
    answer = optimize(sorted(ids), given, params=QUICK)
    assert uses(answer, given) == ["tentative"] * 3 + ["unused"] * 2


def test_a_new_scene_that_one_edge_ties_and_another_contradicts_is_for_the_whole_map_to_place():
    ids, right, wrong = front()
    params = replace(PLACING, max_growth=1.0, marginals=False)
    before = optimize(ids[:3], right[:2], params=params)
    after = optimize(ids, [*right, wrong], (), before, params)
    assert after.provenance.method == "batch"
    assert uses(after, [*right, wrong]) == ["tentative"] * 3 + ["unused"]
    assert optimize(ids, right, (), before, params).provenance.method == "incremental"
