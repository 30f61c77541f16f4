"""Whether an aligned pair shows one place or two that look alike."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gsmap.register import pose_selection
from gsmap.register.evidence import PoseEvidence
from gsmap.register.look_alike import PRIOR, WEIGHTS, look_alike_probability
from gsmap.register.params import Params
from gsmap.register.pose_selection import EvaluatedPose, select_pose
from gsmap.types import Sim3
from gsmap.types.registration import Proposal

NAN = float("nan")
SAME = PoseEvidence(
    overlap=0.6,
    free_space_violation=0.01,
    num_seen=5000,
    num_judged=5000,
    num_coinciding=5000,
    colour_correlation=0.7,
    colour_t=10.0,
    disagreement=0.02,
    seen_m2=30.0,
)
TWIN = replace(SAME, free_space_violation=0.1, colour_correlation=0.3)


@pytest.mark.guards("answers")
@pytest.mark.parametrize("known", WEIGHTS)
def test_likeness_speaks_for_one_place_and_free_space_for_two(known: tuple[bool, bool]) -> None:
    def probability(similarity: float, free: float) -> float:
        evidence = replace(SAME, free_space_violation=free if known[1] else NAN)
        return look_alike_probability(evidence, similarity if known[0] else NAN)

    middle = probability(0.9, 0.05)
    assert probability(1.0, 0.05) < middle if known[0] else probability(1.0, 0.05) == middle
    assert probability(0.9, 0.06) > middle if known[1] else probability(0.9, 0.06) == middle


@pytest.mark.guards("answers")
def test_the_log_odds_are_the_prior_and_the_weighted_pieces() -> None:
    constant, *weights = WEIGHTS[True, True]
    odds = PRIOR / (1 - PRIOR) * np.exp(constant + np.dot(weights, (0.8, np.log(0.1 + 0.003))))
    assert look_alike_probability(TWIN, 0.8) == pytest.approx(odds / (1 + odds), rel=1e-9)
    assert np.isnan(look_alike_probability(replace(TWIN, free_space_violation=NAN), NAN))


@pytest.mark.guards("answers")
def test_a_pair_of_twin_flats_is_refused_with_its_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_selection, "own_working_m", lambda view: 1.0)
    proposal = Proposal("graph:landmarks", Sim3.identity(), False, 80, 100, log_nfa=-100.0, runner_up=0.0)
    scene = SimpleNamespace(id="a", centre=np.zeros(3), graph=SimpleNamespace(unit_m=1.0))

    def register(evidence: PoseEvidence, similarity: float):
        pose = EvaluatedPose(proposal, evidence, np.eye(7), "", similarity=similarity)
        return select_pose(scene, SimpleNamespace(**vars(scene) | {"id": "b"}), [pose], Params(), seconds={})

    accepted, refused = register(SAME, 1.2), register(TWIN, 0.7)
    assert (accepted.status, accepted.reason_code) == ("accepted", "")
    assert (refused.status, refused.reason_code) == ("rejected", "look_alike")
    assert refused.S_target_source is not None
    assert refused.information is not None  # of the edge that a person may confirm
    assert refused.evidence["probability"] < 0.5 < refused.evidence["look_alike"]
    assert refused.evidence["similarity"] == 0.7
    unknown = register(replace(TWIN, free_space_violation=NAN), NAN)
    assert unknown.status == "accepted"
    assert np.isnan(unknown.evidence["look_alike"])


@pytest.mark.guards("answers")
def test_a_weak_rival_does_not_make_twin_flats_ambiguous(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_selection, "own_working_m", lambda view: 1.0)
    proposal = Proposal("graph:landmarks", Sim3.identity(), False, 80, 100, log_nfa=-100.0, runner_up=0.0)
    moved = Sim3(np.eye(3), np.array([5.0, 0, 0]))
    elsewhere = replace(proposal, S_target_source=moved, log_nfa=-3.0)
    weak = replace(SAME, colour_correlation=0.16, colour_t=1.0, overlap=0.02, num_coinciding=310, num_seen=400)
    scene = SimpleNamespace(id="a", centre=np.zeros(3), graph=SimpleNamespace(unit_m=1.0))
    poses = [
        EvaluatedPose(proposal, TWIN, np.eye(7), "", similarity=0.7),
        EvaluatedPose(elsewhere, weak, np.eye(7), "not probable enough"),
    ]
    found = select_pose(scene, SimpleNamespace(**vars(scene) | {"id": "b"}), poses, Params(), seconds={})
    assert (found.status, found.reason_code) == ("rejected", "look_alike")
    assert found.S_target_source is not None


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("alike", "status"), [(0.01, "accepted"), (0.05, "rejected"), (0.2, "rejected")])
def test_no_pair_is_accepted_below_the_least_probability(
    monkeypatch: pytest.MonkeyPatch, alike: float, status: str
) -> None:
    monkeypatch.setattr(pose_selection, "own_working_m", lambda view: 1.0)
    monkeypatch.setattr(pose_selection, "probability", lambda *_: 0.93)
    monkeypatch.setattr(pose_selection, "look_alike_probability", lambda *_: alike)
    proposal = Proposal("graph:landmarks", Sim3.identity(), False, 80, 100, log_nfa=-100.0, runner_up=0.0)
    scene = SimpleNamespace(id="a", centre=np.zeros(3), graph=SimpleNamespace(unit_m=1.0))
    pose = EvaluatedPose(proposal, SAME, np.eye(7), "", similarity=1.0)
    found = select_pose(scene, SimpleNamespace(**vars(scene) | {"id": "b"}), [pose], Params(), seconds={})
    assert found.evidence["probability"] == pytest.approx(0.93 * (1 - alike))
    assert found.status == status
