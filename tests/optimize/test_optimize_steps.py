"""Single steps of the recipe, each with what it must not let through."""

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import city, information, poses_at, true_edges
from scipy.stats import chi2

from gsmap.geometry.similarities import Similarities
from gsmap.optimize import Params, optimize
from gsmap.optimize.component_joins import Join, join_decision, spanning_joins
from gsmap.optimize.measurements import measurements
from gsmap.optimize.priors import PriorTerms
from gsmap.optimize.robust import chi_squares
from gsmap.optimize.state import State, refine
from gsmap.reason_codes import reason_code
from gsmap.types import Edge, Sim3

GATE = float(chi2.ppf(0.999, 6))


def with_one_wrong(confirmed=False):
    """A well tied world in which the last edge is 3 m off, everything accepted (or confirmed), at the true poses."""
    world = city(30, 0.0, seed=2)
    last = world.edges[-1]
    off = last.S_target_source @ Sim3(np.eye(3), np.array([3.0, 0, 0]))
    edges = [*world.edges[:-1], replace(last, S_target_source=off)]
    m = measurements(world.ids, [replace(e, confirmed=confirmed) for e in edges])
    nothing = PriorTerms.stack((), ())
    return m, State.fresh(m, world.truth, np.ones(len(m), dtype=bool), nothing)


@pytest.mark.guards("answers")
def test_refining_lets_go_of_what_lies_beyond_the_gate():
    m, state = with_one_wrong()
    refine(m, state, GATE, 16.0)
    assert not state.accepted[-1]
    assert state.failures[-1] == 1
    assert state.accepted[:-1].mean() > 0.97
    assert chi_squares(m, state.poses)[state.accepted].max() <= GATE


@pytest.mark.guards("answers")
def test_refining_keeps_what_is_confirmed():
    m, state = with_one_wrong(confirmed=True)
    refine(m, state, GATE, 16.0)
    assert chi_squares(m, state.poses)[-1] > GATE
    assert state.accepted.all()
    assert not state.failures.any()


def test_an_edge_that_fits_later_is_taken_back_and_one_that_does_not_is_not():
    world = city(60, 0.2, seed=3)
    answer = optimize(world.ids, world.edges, params=Params(marginals=False))
    for outcome in answer.outcomes.values():
        if outcome.use == "used":
            assert outcome.residual_chi2 <= GATE
    far = [o for o in answer.outcomes.values() if o.residual_chi2 is not None and o.residual_chi2 > GATE]
    assert far
    assert {o.use for o in far} == {"unused"}


def edges_between(pairs, confirmed=()):
    truth = poses_at(np.arange(12)[:, None] * [3.0, 1, 0])
    ids = [f"s{k}" for k in range(12)]
    edges = true_edges(truth, pairs, np.random.default_rng(0), ids)
    return measurements(ids, [replace(e, confirmed=k in confirmed) for k, e in enumerate(edges)])


@pytest.mark.parametrize(
    ("agreeing", "rival", "sizes", "confirmed", "decision"),
    [
        (3, 0, (6, 6), (), "agreed"),
        (2, 0, (6, 6), (), "would join"),
        (2, 0, (6, 6), (0,), "agreed"),
        (2, 0, (6, 2), (), "agreed"),
        (1, 0, (6, 2), (), "single"),
        (1, 1, (6, 2), (), "none of them is used"),
        (3, 3, (6, 6), (), "none of them is used"),
        (5, 2, (6, 6), (), "none of them is used"),
        (6, 2, (6, 6), (), "agreed"),
        (5, 1, (6, 6), (), "agreed"),
    ],
)
def test_when_components_join(agreeing, rival, sizes, confirmed, decision):
    m = edges_between([[k, 6 + k] for k in range(6)], confirmed)
    join = Join(0, 1, np.arange(agreeing), rival, np.arange(6))
    assert decision in join_decision(join, m, np.array(sizes), Params())


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("agreeing", "rival", "sizes", "odds", "decision"),
    [
        (1, 0, (3, 6), 0.0, "too_few_edges"),  # from three scenes on a component is large
        (1, 0, (2, 6), 0.0, "single"),
        (2, 1, (6, 2), 0.0, "agreed"),
        (2, 2, (6, 2), 0.0, "outvoted"),
        (2, 2, (6, 2), 2.0, "outvoted"),
        (2, 2, (6, 2), 100.0, "agreed"),
        (2, 2, (6, 2), -100.0, "outvoted"),
        (2, 3, (6, 2), 100.0, "outvoted"),
        (1, 1, (6, 2), 100.0, "single"),
        (5, 3, (6, 6), 0.0, "outvoted"),
    ],
)
def test_as_many_edges_as_contradict_them_join_only_by_much_better_evidence(agreeing, rival, sizes, odds, decision):
    m = edges_between([[k, 6 + k] for k in range(6)])
    join = Join(0, 1, np.arange(agreeing), rival, np.arange(6), log_odds=odds)
    found = join_decision(join, m, np.array(sizes), Params())
    assert (found if found in ("agreed", "single") else reason_code(found)) == decision


@pytest.mark.guards("answers")
def test_the_same_pair_of_scenes_counts_once_towards_a_bridge():
    ids = [f"s{k}" for k in range(12)]
    pose = Sim3.identity()
    edges = [Edge("s0", "s6", pose, information()), Edge("s6", "s0", pose, information())]
    m = measurements(ids, [*edges, Edge("s1", "s7", pose, information())])
    decision = join_decision(Join(0, 1, np.arange(3), 0, np.arange(3)), m, np.array([6, 6]), Params())
    assert "has 2" in decision


def test_joins_form_no_cycle_and_those_of_most_edges_come_first():
    rng = np.random.default_rng(0)
    for _ in range(30):
        count = int(rng.integers(2, 9))
        pairs = [(a, b) for a in range(count) for b in range(a + 1, count) if rng.random() < 0.6]
        offers = [Join(a, b, np.arange(rng.integers(1, 5)), 0, np.arange(5)) for a, b in pairs]
        label = np.arange(count)
        want = []
        for join in sorted(offers, key=lambda j: (-len(j.edges), j.target, j.source)):
            if label[join.target] != label[join.source]:
                label[label == label[join.source]] = label[join.target]
                want.append(join)
        assert spanning_joins(offers, count) == want


def test_a_component_keeps_its_frame_when_it_is_solved_again():
    world = city(40, 0.0, seed=2)
    params = Params(max_growth=0)
    first = optimize(world.ids, world.edges, params=params)
    away = Sim3(poses_at(np.zeros((1, 3)), 5).rotations[0], np.array([100.0, 20, -5]))
    moved = {s: replace(p, S_map_scene=away @ p.S_map_scene) for s, p in first.poses.items()}
    again = optimize(world.ids, world.edges, previous=replace(first, poses=moved), params=params)
    found = Similarities.stack([p.S_map_scene for p in again.poses.values()])
    want = Similarities.stack([moved[s].S_map_scene for s in again.poses])
    assert np.abs(found.translations - want.translations).max() < 1e-3
