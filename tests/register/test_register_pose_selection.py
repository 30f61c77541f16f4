"""Which of several evaluated poses is the result, and what status it has."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.register import pair, pose_selection
from gsmap.register.evidence import PoseEvidence
from gsmap.register.params import Params
from gsmap.register.pose_selection import EvaluatedPose, is_same_pose, select_pose
from gsmap.register.timing import Stopwatch
from gsmap.register.unit_scale import ScaleDecision
from gsmap.types import Sim3
from gsmap.types.registration import Proposal

SURE = PoseEvidence(
    overlap=0.6,
    free_space_violation=0.0,
    num_seen=5000,
    num_judged=5000,
    num_coinciding=5000,
    colour_correlation=0.9,
    colour_t=40.0,
    disagreement=0.0,
    seen_m2=30.0,
)
COVARIANCE = np.diag([1e-6, 2e-6, 3e-6, 4e-6, 5e-6, 6e-6, 7e-6])
SCENE = SimpleNamespace(id="a", centre=np.array([1.0, 0, 0]), graph=SimpleNamespace(unit_m=1.0, layers={}))


@pytest.fixture(autouse=True)
def metres(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pose_selection, "own_working_m", lambda view: view.graph.unit_m)
    monkeypatch.setattr(pose_selection, "num_nodes", lambda target, source: 7)


def shifted(metres: float) -> Sim3:
    return Sim3(np.eye(3), np.array([metres, 0, 0]), 1.0)


def evaluated(S: Sim3, flaw: str = "", log_nfa: float = -60.0, evidence: PoseEvidence = SURE) -> EvaluatedPose:
    proposal = Proposal("graph:landmarks", S, False, 80, 100, log_nfa=log_nfa, runner_up=0.0)
    return EvaluatedPose(proposal, evidence, COVARIANCE, flaw)


def select(*poses: EvaluatedPose):
    return select_pose(SCENE, SimpleNamespace(**vars(SCENE) | {"id": "b"}), poses, Params(), seconds={})


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("other", "same"),
    [
        (Sim3.identity(), True),
        (shifted(0.29), True),
        (shifted(0.31), False),
        (shifted(-0.31), False),
        (Sim3(np.eye(3), np.array([-0.019, 0, 0]), 1.019), True),
        (Sim3(np.eye(3), np.array([-0.021, 0, 0]), 1.021), False),
        (Sim3(np.eye(3), np.array([0.021, 0, 0]), 1 / 1.021), False),
        (Sim3(Rotation.from_rotvec(np.radians([2.9, 0, 0])).as_matrix(), np.zeros(3), 1.0), True),
        (Sim3(Rotation.from_rotvec(np.radians([3.1, 0, 0])).as_matrix(), np.zeros(3), 1.0), False),
    ],
)
def test_poses_are_the_same_only_where_turn_shift_and_scale_are(other: Sim3, same: bool) -> None:
    assert is_same_pose(Sim3.identity(), other, SCENE.centre, 1.0) is same
    assert is_same_pose(other, Sim3.identity(), SCENE.centre, 1.0) is same


@pytest.mark.guards("answers")
def test_the_shift_is_that_of_the_centre_in_metres() -> None:
    assert is_same_pose(Sim3.identity(), shifted(0.5), np.zeros(3), 0.5)
    assert not is_same_pose(Sim3.identity(), shifted(0.2), np.zeros(3), 2.0)
    turned = Sim3(Rotation.from_rotvec(np.radians([0, 0, 2.0])).as_matrix(), np.zeros(3), 1.0)
    assert is_same_pose(Sim3.identity(), turned, np.array([5.0, 0, 0]), 1.0)
    assert not is_same_pose(Sim3.identity(), turned, np.array([50.0, 0, 0]), 1.0)


@pytest.mark.guards("answers")
def test_without_a_pose_there_is_no_match() -> None:
    found = select()
    assert (found.status, found.reason_code) == ("no_match", "no_pose_proposed")
    assert found.S_target_source is None
    assert found.information is None


@pytest.mark.guards("answers")
def test_an_accepted_pose_has_its_information() -> None:
    found = select(evaluated(shifted(1.0)))
    assert (found.status, found.reason) == ("accepted", "")
    np.testing.assert_array_equal(found.S_target_source.matrix(), shifted(1.0).matrix())
    np.testing.assert_allclose(found.information @ COVARIANCE, np.eye(7), atol=1e-9)
    np.testing.assert_array_equal(found.information, found.information.T)


@pytest.mark.guards("answers")
def test_an_accepted_pose_counts_before_a_rejected_one() -> None:
    weak = replace(SURE, num_coinciding=20, colour_correlation=0.0)
    rejected = evaluated(shifted(9.0), flaw="too little surface coincides", log_nfa=-200.0, evidence=weak)
    found = select(rejected, evaluated(shifted(1.0)))
    assert found.status == "accepted"
    assert found.S_target_source.translation[0] == 1.0


@pytest.mark.guards("answers")
def test_two_accepted_poses_apart_are_ambiguous_and_have_no_pose() -> None:
    found = select(evaluated(shifted(1.0)), evaluated(shifted(5.0)))
    assert (found.status, found.reason_code) == ("no_match", "ambiguous")
    assert found.S_target_source is None
    assert found.information is None
    assert found.evidence["probability"] < 0.9


@pytest.mark.guards("answers")
def test_two_accepted_poses_that_are_one_are_accepted() -> None:
    assert select(evaluated(shifted(1.0)), evaluated(shifted(1.1))).status == "accepted"


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("log_nfa", "status"), [(-60.0, "rejected"), (-1.0, "no_match")])
def test_a_rejected_pose_is_shown_only_where_chance_does_not_explain_it(log_nfa: float, status: str) -> None:
    found = select(evaluated(shifted(1.0), flaw="free-space violation 40%, allowed 18%", log_nfa=log_nfa))
    assert found.status == status
    assert (found.S_target_source is not None) == (found.information is not None) == (status == "rejected")
    assert found.reason_code == {"rejected": "free_space_violation", "no_match": "not_significant"}[status]


@pytest.mark.guards("answers")
@pytest.mark.parametrize("chances", [(0.8,), (0.8, 0.5), (0.97, 0.9, 0.3)])
def test_the_probability_is_that_one_of_the_poses_alone_is_correct(
    monkeypatch: pytest.MonkeyPatch, chances: tuple[float, ...]
) -> None:
    """Counted out over which of the independent poses are correct, given that at most one is."""
    by_nfa = {-60.0 - k: chance for k, chance in enumerate(chances)}
    monkeypatch.setattr(pose_selection, "probability", lambda proposal, *_: by_nfa[proposal.log_nfa])
    poses = [evaluated(shifted(5.0 * k), log_nfa=nfa) for k, nfa in enumerate(by_nfa)]
    p = np.array(chances)
    alone = p * np.prod(1 - p) / (1 - p)
    wanted = alone[0] / (alone.sum() + np.prod(1 - p))
    found = select(*poses).evidence
    assert found["probability"] == pytest.approx(wanted * (1 - found["look_alike"]), rel=1e-12)


@pytest.mark.guards("answers")
def test_of_rejected_poses_the_one_with_most_evidence_is_shown() -> None:
    flaw = "free-space violation 40%, allowed 18%"
    by_evidence = [
        evaluated(shifted(x), flaw=flaw, evidence=replace(SURE, num_coinciding=n, colour_correlation=c))
        for x, n, c in ((1.0, 4000, 0.3), (2.0, 2000, 0.7), (3.0, 1000, 0.9))
    ]
    assert select(*by_evidence).S_target_source.translation[0] == 2.0
    by_nfa = [evaluated(shifted(x), flaw=flaw, log_nfa=nfa) for x, nfa in ((1.0, -20.0), (2.0, -90.0), (3.0, -40.0))]
    assert select(*by_nfa).S_target_source.translation[0] == 2.0


@pytest.mark.guards("answers")
def test_the_scale_is_stored_as_decided_or_as_the_covariance_has_it() -> None:
    pose = evaluated(Sim3(np.eye(3), np.zeros(3), 1.25))
    found = select(pose).evidence
    assert (found["log_scale"], found["log_scale_sigma"]) == (pytest.approx(np.log(1.25)), pytest.approx(np.sqrt(7e-6)))
    decided = ScaleDecision(rigid=False, log_scale=0.2, measured_sigma=0.003, log_scale_sigma=0.004)
    found = select(replace(pose, decision=decided)).evidence
    assert (found["log_scale"], found["log_scale_sigma"]) == (0.2, 0.003)
    assert np.isnan(select(replace(pose, covariance=None, flaw="free-space violation 40%")).evidence["log_scale"])


@pytest.mark.guards("answers")
def test_a_pose_is_told_from_its_repetitions_by_similarity_alone() -> None:
    def similar(metres: float, similarity: float, flaw: str = "") -> EvaluatedPose:
        return replace(evaluated(shifted(metres), flaw), similarity=similarity)

    # The most similar pose is the result, whichever was proposed first, if it is told from all others.
    told = select(similar(3, 0.45), similar(0, 0.9))
    assert told.status == "accepted"
    assert told.S_target_source is not None
    assert told.S_target_source.translation[0] == 0
    for rivals in ([similar(3, 0.7)], [similar(3, 0.7, "improbable")], [replace(similar(3, 0.6), similarity=np.nan)]):
        assert select(*rivals, similar(0, 0.9)).reason_code == "ambiguous"
    # Colours of renders count by their significance.
    for t, status in ((400.0, "accepted"), (2.0, "no_match")):
        pale = replace(SURE, colour_correlation=0.8, colour_t=t)
        rival = replace(evaluated(shifted(3), evidence=pale), similarity=0.8)
        bright = replace(evaluated(shifted(0), evidence=replace(SURE, colour_t=t)), similarity=0.9)
        assert select(rival, bright).status == status
    # Poses that were not evaluated count, too.
    source = SimpleNamespace(**vars(SCENE) | {"id": "b"})
    for elsewhere, status in (([0.59], "accepted"), ([0.61], "no_match"), ([1.5], "no_match")):
        assert select_pose(SCENE, source, [similar(0, 0.9)], Params(), seconds={}, elsewhere=elsewhere).status == status
    weak = [replace(evaluated(shifted(0)), similarity=0.4)]
    for elsewhere, status in (([0.2], "accepted"), ([0.35], "no_match")):
        assert select_pose(SCENE, source, weak, Params(), seconds={}, elsewhere=elsewhere).status == status
    # Where the renders were not compared, only cells count.
    none = replace(SURE, colour_correlation=0.0, colour_t=0.0)
    rival = replace(evaluated(shifted(3), "colours disagree", evidence=none), similarity=0.8)
    assert select(rival, replace(similar(0, 0.9), evidence=replace(SURE, colour_t=400.0))).status == "no_match"


@pytest.mark.guards("answers")
def test_a_pose_that_repeats_another_states_its_own_inliers(monkeypatch: pytest.MonkeyPatch) -> None:
    first = replace(evaluated(shifted(0)), similarity=0.4)
    support = SimpleNamespace(count=lambda S: (int(S.translation[0]), -9.0))
    first = replace(first, proposal=replace(first.proposal, support=support))
    bare = SimpleNamespace(surface=lambda: None)
    in_metres = SimpleNamespace(target=bare, source=bare, to_metres=lambda S: S, to_scene_units=lambda S: S)
    monkeypatch.setattr(pair, "MetricPair", SimpleNamespace(of=lambda *a: in_metres))
    monkeypatch.setattr(pair, "own_working_m", lambda view: 1.0)
    similarities = {0.0: 0.4, 3.0: 1.4}
    repetition = SimpleNamespace(
        elsewhere=lambda: [(shifted(3), 1.4)], similarity=lambda S: similarities[S.translation[0]]
    )
    monkeypatch.setattr(pair, "Repetition", lambda *a: repetition)
    target = SimpleNamespace(graph=SimpleNamespace(up=np.array([0, 0, 1.0])))
    for flaw, inliers, log_nfa in (("", 3, -9.0), ("improbable", 80, -60.0)):
        monkeypatch.setattr(pair, "_evaluate", lambda p, *a, flaw=flaw: EvaluatedPose(p, SURE, COVARIANCE, flaw))
        poses, _ = pair._compare_elsewhere([replace(first, flaw=flaw)], target, SCENE, Params(), Stopwatch())
        found = select(*poses)
        assert found.status == ("rejected" if flaw else "accepted")
        assert (found.num_inliers, found.evidence["log_nfa"]) == (inliers, log_nfa)
        assert np.isnan(found.evidence["runner_up"]) == (not flaw)
    uncounted = replace(first, proposal=replace(first.proposal, support=None))
    monkeypatch.setattr(pair, "_evaluate", lambda p, *a: EvaluatedPose(p, SURE, COVARIANCE, ""))
    found = select(*pair._compare_elsewhere([uncounted], target, SCENE, Params(), Stopwatch())[0])
    assert found.num_inliers == 0
    assert np.isnan(found.evidence["log_nfa"])
