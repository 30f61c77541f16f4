"""Edges whose captures may show two places: what the map bears out, contradicts, or leaves open."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import poses_at, true_edges

from gsmap.optimize import Params, optimize
from gsmap.optimize.aliasing_evidence import aliasing_probability, separating_threshold
from gsmap.types import Sim3

QUICK = Params(marginals=False)
SURE, DOUBTFUL = 0.005, 0.02
ROOM_M = 4.5


class Street:
    """Captures of a street whose rooms come again after ``period``; capture k shares a room with k + 1 alone."""

    def __init__(self, count=14, period=5):
        rng = np.random.default_rng(3)
        at = np.c_[ROOM_M * np.arange(count), np.zeros((count, 2))]
        truth = poses_at(at, seed=1)
        truth.rotations[:] = truth.rotations[:1]
        self.ids = [f"s{k:02d}" for k in range(count)]
        chain = np.c_[np.arange(count - 1), np.arange(1, count)]
        self.right = [replace(e, look_alike=SURE) for e in true_edges(truth, chain, rng, self.ids)]
        self.wrong = []
        for a in range(count):
            for b in range(a + period - 1, count):
                seems = (b - a + 1) % period - 1  # rooms further on, as both captures show it
                if seems <= 1:
                    looks = truth.replaced(np.array([b]), poses_at(at[[a]] + [ROOM_M * seems, 0, 0]))
                    looks.rotations[:] = truth.rotations
                    (edge,) = true_edges(looks, np.array([(a, b)]), rng, self.ids)
                    self.wrong.append(replace(edge, look_alike=DOUBTFUL))

    def without(self, *gone):
        keep = [s for k, s in enumerate(self.ids) if k not in gone]
        right, wrong = ([e for e in edges if {e.target, e.source} <= set(keep)] for edges in (self.right, self.wrong))
        return keep, right, wrong


def uses(answer, edges):
    return {answer.use(e.target, e.source) for e in edges}


def components(answer):
    found = {}
    for scene, pose in answer.poses.items():
        found.setdefault(pose.component, []).append(scene)
    return sorted(found.values())


@pytest.mark.guards("answers")
def test_a_street_of_look_alikes_is_laid_out_as_it_is():
    street = Street()
    blind = [replace(e, look_alike=float("nan")) for e in street.right + street.wrong]
    unseeing = optimize(street.ids, blind, params=QUICK)
    assert "used" in uses(unseeing, street.wrong) or len(components(unseeing)) > 1
    answer = optimize(street.ids, street.right + street.wrong, params=QUICK)
    assert uses(answer, street.wrong) == {"unused"}
    assert uses(answer, street.right) == {"tentative"}  # single edges: no cycle confirms them
    assert components(answer) == [street.ids]
    where = np.array([answer.poses[s].S_map_scene.translation for s in street.ids])
    assert np.linalg.norm(where[-1] - where[0]) == pytest.approx(13 * ROOM_M, abs=1.0)
    reason = answer.outcomes[street.wrong[0].target, street.wrong[0].source].reason
    assert "2%" in reason
    assert "look alike" in reason


def test_doubt_by_disagreement_states_no_probability_of_two_places():
    street = Street()
    edges = [replace(e, look_alike=float("nan"), disagreement=0.05) for e in street.right]
    edges += [replace(e, look_alike=float("nan"), disagreement=0.4) for e in street.wrong]
    answer = optimize(street.ids, edges, params=QUICK)
    assert uses(answer, street.wrong) == {"unused"}
    assert not any("nan" in outcome.reason for outcome in answer.outcomes.values())


@pytest.mark.parametrize(("gone", "parts"), [((7,), 2), ((4, 10), 3), ((4, 5, 10, 11, 12, 13), 2)])
def test_look_alikes_that_contradict_each_other_tie_no_parts(gone, parts):
    """The street has gaps; its parts contradict look-alikes by themselves (one gap), or once laid over each other."""
    keep, right, wrong = Street().without(*gone)
    answer = optimize(keep, right + wrong, params=QUICK)
    assert uses(answer, wrong) == {"unused"}
    assert len(components(answer)) == parts
    part = {scene: answer.poses[scene].component for scene in keep}
    between = [e for e in wrong if part[e.target] != part[e.source]]
    assert between
    assert all((e.target, e.source) in answer.undecided for e in between)
    assert all("look alike" in answer.outcomes[e.target, e.source].reason for e in between)


@pytest.mark.guards("answers")
def test_a_place_that_changed_is_tied_tentatively():
    """Two visits of one place: nothing but doubtful edges between them, and none contradicts another."""
    rng = np.random.default_rng(0)
    truth = poses_at(rng.uniform(0, 8, (6, 3)))
    ids = [f"s{k}" for k in range(6)]
    sure = [(0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5)]
    known = [replace(e, look_alike=SURE) for e in true_edges(truth, np.array(sure), rng, ids)]
    between = np.array([(0, 3), (1, 4), (2, 5)])
    doubtful = [replace(e, look_alike=DOUBTFUL) for e in true_edges(truth, between, rng, ids)]
    answer = optimize(ids, known + doubtful, params=QUICK)
    assert uses(answer, known) == {"used"}
    assert uses(answer, doubtful) == {"tentative"}
    assert components(answer) == [ids]
    statuses = [answer.poses[s].status for s in ids]
    assert sorted([statuses[:3], statuses[3:]]) == [["placed"] * 3, ["tentative"] * 3]
    assert "changed" in answer.outcomes["s0", "s3"].reason
    # Captured within the hour nothing can have changed so much.
    now = optimize(ids, known + [replace(e, same_visit=True) for e in doubtful], params=QUICK)
    assert components(now) == [ids[:3], ids[3:]]
    assert {("s0", "s3"), ("s1", "s4"), ("s2", "s5")} <= set(now.undecided)
    assert "one visit" in now.outcomes["s0", "s3"].reason


def test_one_wrong_edge_among_equally_likely_ones_leaves_the_others_used():
    rng = np.random.default_rng(0)
    truth = poses_at(np.c_[4.0 * np.arange(12), np.zeros((12, 2))])
    ids = [f"s{k:02d}" for k in range(12)]
    near = np.array([(k, k + step) for step in (1, 2) for k in range(12 - step)])
    right = [replace(e, look_alike=SURE, log_odds_wrong=-39.4) for e in true_edges(truth, near, rng, ids)]
    (far,) = true_edges(truth, np.array([(4, 7)]), rng, ids)
    away = Sim3(far.S_target_source.rotation, far.S_target_source.translation + 2.0)
    wrong = replace(far, S_target_source=away, look_alike=SURE, log_odds_wrong=-39.4)
    answer = optimize(ids, [*right, wrong], params=QUICK)
    assert uses(answer, right) == {"used"}
    assert answer.use(wrong.target, wrong.source) == "unused"


@pytest.mark.parametrize("given", [float("nan"), SURE])
def test_what_the_others_bear_out_is_used(given):
    rng = np.random.default_rng(0)
    truth = poses_at(rng.uniform(0, 8, (4, 3)))
    ids = [f"s{k}" for k in range(4)]
    known = true_edges(truth, np.array([(0, 1), (1, 2), (0, 2), (2, 3), (0, 3)]), rng, ids)
    known = [replace(e, look_alike=given) for e in known]
    (odd,) = true_edges(truth, np.array([(1, 3)]), rng, ids)
    answer = optimize(ids, [*known, replace(odd, look_alike=DOUBTFUL)], params=QUICK)
    assert answer.use("s1", "s3") == "used"


@pytest.mark.parametrize("contradicted", [False, True])
def test_what_is_borne_out_confirms_unless_the_map_has_look_alikes(contradicted):
    """A triangle whose third edge is in doubt; elsewhere a doubtful edge fits, or contradicts the others."""
    rng = np.random.default_rng(0)
    truth = poses_at(rng.uniform(0, 8, (6, 3)))
    ids = [f"s{k}" for k in range(6)]
    known = true_edges(truth, np.array([(0, 1), (1, 2), (3, 4), (4, 5), (3, 5)]), rng, ids)
    third, other = true_edges(truth, np.array([(0, 2), (3, 5)]), rng, ids)
    known = [replace(e, look_alike=SURE) for e in known[: 4 if contradicted else 5]]
    given = [*known, replace(third, look_alike=DOUBTFUL)]
    if contradicted:
        moved = Sim3(other.S_target_source.rotation, np.array([4.0, 0, 0]) + other.S_target_source.translation)
        given.append(replace(other, S_target_source=moved, look_alike=DOUBTFUL))
    answer = optimize(ids, given, params=QUICK)
    triangle = {answer.use(*pair) for pair in (("s0", "s1"), ("s1", "s2"), ("s0", "s2"))}
    assert triangle == ({"tentative"} if contradicted else {"used"})


@pytest.mark.guards("answers")
def test_a_confirmed_edge_is_in_no_doubt():
    street = Street(4, period=2)
    word = replace(street.right[1], look_alike=0.5, confirmed=True)
    answer = optimize(street.ids, [street.right[0], word, street.right[2]], params=QUICK)
    assert answer.use(word.target, word.source) == "used"
    assert components(answer) == [street.ids]


def test_the_rule_of_succession():
    assert aliasing_probability(0, 0) == 0.5
    assert aliasing_probability(0, 1) == pytest.approx(2 / 3)
    assert aliasing_probability(8, 1) == pytest.approx(2 / 11)


def test_where_doubt_begins_is_told_by_the_map():
    """One look-alike is less probable than the setting bears: edges that are still less so contradict it."""
    street = Street()
    quiet = [replace(e, look_alike=0.009) if k == 3 else e for k, e in enumerate(street.wrong)]
    noisy = [replace(e, look_alike=0.008) if k == 5 else e for k, e in enumerate(street.right)]
    noisy, quiet = ([replace(e, disagreement=10 * e.look_alike) for e in edges] for edges in (noisy, quiet))
    answer = optimize(street.ids, noisy + quiet, params=QUICK)
    assert uses(answer, quiet) == {"unused"}
    assert components(answer) == [street.ids]
    # Bare and noisy maps in which nothing is contradicted are in no doubt below the setting.
    alone = [replace(e, look_alike=0.009) for e in street.right]
    assert uses(optimize(street.ids, alone, params=QUICK), alone) == {"tentative"}
    assert "look alike" not in optimize(street.ids, alone, params=QUICK).outcomes["s00", "s01"].reason


@pytest.mark.guards("answers")
def test_edges_that_older_versions_registered_are_ranked_by_disagreement():
    street, unknown = Street(), float("nan")
    right = [replace(e, look_alike=unknown, disagreement=0.05) for e in street.right]
    wrong = [replace(e, look_alike=unknown, disagreement=0.2) for e in street.wrong]
    answer = optimize(street.ids, right + wrong, params=QUICK)
    assert uses(answer, wrong) == {"unused"}
    assert uses(answer, right) == {"tentative"}
    assert components(answer) == [street.ids]


@pytest.mark.guards("answers")
def test_the_bar_divides_what_agrees_from_what_is_contradicted():
    rng = np.random.default_rng(0)
    low, high = (middle * np.exp(rng.normal(0, 0.2, 4000)) for middle in (0.05, 0.15))
    bar = separating_threshold(low, high)
    # Bayes: log-normal densities of equal width meet at ten to one, for a wrong edge is as bad as ten right ones.
    expected = np.exp(np.log(0.05 * 0.15) / 2 - 0.2**2 * np.log(10) / np.log(3))
    assert bar == pytest.approx(expected, rel=0.02)
    assert separating_threshold(high, low) == np.inf
