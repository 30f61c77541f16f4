"""How probable a pose is: what the fitted model must have in common with any that could be right."""

from dataclasses import replace

import numpy as np
import pytest

from gsmap.register.evidence import PoseEvidence
from gsmap.register.probability import Model, evidence_of, probability, shortfalls, worth
from gsmap.types import Proposal, Sim3

PROPOSAL = Proposal("graph:landmarks", Sim3.identity(), False, 30, log_nfa=-20.0, runner_up=0.2)
EVIDENCE = PoseEvidence(0.4, 3000, 0.03, 2000, 0.5, 8.0, disagreement=0.04, seen_m2=30.0)
BETTER = {
    "overlap": (0.05, 0.15, 0.3, 0.6),
    "num_coinciding": (100, 400, 1500, 4000),
    "free_space_violation": (0.4, 0.2, 0.1, 0.01),
    "disagreement": (0.4, 0.2, 0.1, 0.01),
    "colour_correlation": (0.0, 0.2, 0.4, 0.7),
    "colour_t": (1.0, 3.0, 6.0, 12.0),
}


def test_there_is_a_curve_for_every_piece_of_evidence_and_no_other():
    assert set(Model.load().curves) == set(evidence_of(PROPOSAL, EVIDENCE))


@pytest.mark.parametrize(("name", "values"), BETTER.items())
def test_better_evidence_never_makes_a_pose_less_probable(name, values):
    found = [probability(PROPOSAL, replace(EVIDENCE, **{name: value}), 0.002) for value in values]
    assert found == sorted(found)
    assert found[-1] > found[0]


def test_fewer_false_alarms_and_a_smaller_rival_make_it_more_probable():
    for name, values in (("log_nfa", (5.0, -1.0, -5.0, -40.0)), ("runner_up", (1.2, 0.9, 0.7, 0.0))):
        found = [probability(replace(PROPOSAL, **{name: value}), EVIDENCE, 0.002) for value in values]
        assert found == sorted(found)
        assert found[-1] > found[0]


def test_the_prior_is_what_is_known_before():
    pale = replace(EVIDENCE, colour_correlation=0.1)
    odds = [p / (1 - p) for p in (probability(PROPOSAL, pale, prior) for prior in (0.1, 0.5))]
    assert odds[1] == pytest.approx(9 * odds[0])


def test_evidence_that_could_not_be_had_has_a_worth_of_its_own():
    unseen = replace(EVIDENCE, free_space_violation=np.nan, disagreement=np.nan, num_seen=0)
    curves, found = Model.load().curves, worth(PROPOSAL, unseen)
    for name in ("free_space_violation", "disagreement", "colour_correlation", "colour_t"):
        assert found[name] == curves[name].missing
    assert 0 < probability(PROPOSAL, unseen) < 1


def test_no_pose_is_beyond_what_was_ever_counted():
    best = replace(EVIDENCE, overlap=1, num_coinciding=10_000, colour_correlation=1, free_space_violation=0)
    assert probability(replace(PROPOSAL, log_nfa=-300.0, runner_up=0.0), best, 0.999) == 1 - Model.load().least


def test_what_lacks_most_is_named_first():
    assert shortfalls(PROPOSAL, replace(EVIDENCE, colour_correlation=0.0))[0] == "colour_correlation"


def test_pieces_of_evidence_are_measured_in_decades():
    proposal = replace(PROPOSAL, log_nfa=-500.0, runner_up=0.3)
    evidence = PoseEvidence(0.09, 990, 0.099, 2000, 0.5, 100.0, disagreement=0.999, seen_m2=30.0)
    assert evidence_of(proposal, evidence) == pytest.approx(
        {
            "log_nfa": -300.0,
            "runner_up": 0.3,
            "free_space_violation": -1.0,
            "disagreement": 0.0,
            "overlap": -1.0,
            "num_coinciding": 3.0,
            "colour_correlation": 0.5,
            "colour_t": 2.0,
        }
    )
    weak = evidence_of(replace(proposal, log_nfa=50.0), replace(evidence, colour_t=0.2, num_seen=1))
    assert (weak["log_nfa"], weak["colour_t"], weak["colour_correlation"]) == (30.0, 0.0, 0.5)
    assert np.isnan(evidence_of(replace(proposal, log_nfa=np.nan), evidence)["log_nfa"])
