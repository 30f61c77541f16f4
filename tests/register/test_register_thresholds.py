"""Each threshold of the verdict, just below and just above it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.reason_codes import reason_code
from gsmap.register import verdict
from gsmap.register.evidence import PoseEvidence
from gsmap.types import Sim3
from gsmap.types.registration import Proposal

SURE = Proposal("graph:landmarks", Sim3.identity(), False, 80, 100, log_nfa=-60.0, runner_up=0.0)
GOOD = PoseEvidence(
    overlap=0.4, num_coinciding=3000, free_space_violation=0.01, num_seen=2000, colour_correlation=0.7, colour_t=8.0
)
SIGMAS = (0.003, 0.011, 1e-6)


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"num_coinciding": 50}, ""),
        ({"num_coinciding": 49}, "too_little_overlap"),
        ({"num_coinciding": 51}, ""),
        ({"colour_correlation": 0.04, "colour_t": 1.4}, "colours_disagree"),
        ({"colour_correlation": 0.04, "colour_t": 1.6}, ""),
        ({"colour_correlation": 0.06, "colour_t": 1.4}, ""),
        ({"free_space_violation": 0.29, "num_judged": 100_000}, ""),
        ({"free_space_violation": 0.31, "num_judged": 100_000}, "free_space_violation"),
    ],
)
def test_prescreen(change: dict[str, float], code: str) -> None:
    assert reason_code(verdict.fails_prescreen(replace(GOOD, **change))) == code


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("sigmas", "code"),
    [
        ((np.radians(1.49), 0.049, 0.0249), ""),
        ((np.radians(1.51), 0.01, 1e-6), "pose_uncertain"),
        ((0.003, 0.051, 1e-6), "pose_uncertain"),
        ((0.003, 0.011, 0.026), "pose_uncertain"),
    ],
)
def test_each_uncertainty_alone_refuses_a_pose(sigmas: tuple[float, float, float], code: str) -> None:
    assert reason_code(verdict.decide(SURE, GOOD, sigmas)) == code


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"num_coinciding": 300}, ""),
        ({"num_coinciding": 299}, "too_little_overlap"),
        ({"colour_correlation": 0.15}, ""),
        ({"colour_correlation": 0.149}, "colours_disagree"),
        ({"free_space_violation": 0.18, "num_judged": 1_000_000}, ""),
        ({"free_space_violation": 0.185, "num_judged": 1_000_000}, "free_space_violation"),
        ({"num_coinciding": 299, "colour_correlation": 0.0}, "too_little_overlap"),
    ],
)
def test_what_contradicts_a_pose_whatever_supports_it(change: dict[str, float], code: str) -> None:
    assert reason_code(verdict.contradiction(SURE, replace(GOOD, **change), verdict.Params())) == code


@pytest.mark.guards("answers")
def test_a_flawed_proposal_is_refused_for_its_flaw() -> None:
    flawed = replace(SURE, flaw="correspondences are mirrored")
    assert verdict.decide(flawed, GOOD, SIGMAS) == "correspondences are mirrored"
    assert verdict.decide(flawed, replace(GOOD, num_coinciding=1), SIGMAS) == "correspondences are mirrored"
