"""What is said of a pose: the bars, the covariance that scenes' poses add, and depth that is known."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import exp_so3, retract
from gsmap.localize import MapScene, verdict
from gsmap.localize.covariance import add_scene_covariance
from gsmap.localize.features import smooth_depth
from gsmap.localize.photos import Lens
from gsmap.localize.probability import load_model
from gsmap.reason_codes import reason_code
from gsmap.render import Rendering
from gsmap.types import Sim3

GOOD = {
    "matches": 2.0,
    "inliers": 2.2,
    "found_again": 0.4,
    "laid": 0.8,
    "spread": 0.7,
    "explained": 0.9,
    "explained_coarsely": 0.95,
    "contradicted": 0.02,
    "contradicted_coarsely": 0.01,
    "unlike_part": 0.0,
    "unlike": 0.01,
    "unlike_likely": 0.0,
    "unlike_surely": 0.0,
    "compared": 3.2,
    "colour": 0.97,
    "seen": 1.0,
    "blocked": 0.0,
    "sigma_m": -2.3,
}
BAD = GOOD | {"matches": 0.9, "inliers": 0.9, "found_again": 0.03, "laid": 0.15, "spread": 0.1, "explained": 0.15}
BAD |= {"explained_coarsely": 0.2, "contradicted": 0.6, "contradicted_coarsely": 0.5, "colour": 0.0, "sigma_m": -1.0}
BAD |= {"unlike_part": 0.3, "unlike": 0.25, "unlike_likely": 0.15, "unlike_surely": 0.08}
SURE = (0.003, 0.005)


def probability(evidence: dict[str, float], aliased_prior: float = verdict.Params().aliased_prior) -> float:
    return load_model().probability(evidence, aliased_prior)


@pytest.mark.guards("answers")
def test_good_evidence_is_probable_and_bad_is_not() -> None:
    assert probability(GOOD) > 0.97
    assert probability(BAD) < 0.05
    assert 0 < probability(GOOD | {"colour": float("nan"), "matches": float("nan")}) < 1


@pytest.mark.guards("answers")
@pytest.mark.parametrize("unknown", [float("nan"), float("inf")])
@pytest.mark.parametrize("which", [0, 1])
def test_a_pose_of_unknown_uncertainty_is_refused(which: int, unknown: float) -> None:
    sigmas = (unknown, SURE[1]) if which == 0 else (SURE[0], unknown)
    assert verdict.rejection_reason(GOOD, 0.999, SURE, 0.0, verdict.Params()) == ""
    refused = verdict.rejection_reason(GOOD, 0.999, sigmas, 0.0, verdict.Params())
    assert reason_code(refused) == "not_confirmed"


@pytest.mark.parametrize("value", [1e-308, 1e308, 0.0, -1.0, float("nan"), float("inf")])
def test_intrinsics_that_no_camera_has_are_refused(value: float) -> None:
    for lens in ({"focal_px": value}, {"intrinsics_px": (500.0, value, 320.0, 240.0)}):
        with raises(ConfigError, code="invalid_intrinsics"):
            Lens(**lens)
    assert Lens(focal_px=500.0).focal_px == 500.0


@pytest.mark.guards("answers")
def test_a_room_that_looks_alike_is_as_improbable_as_it_is_rare() -> None:
    """Furniture that stands elsewhere tells against a place, the more the more rooms look alike; somebody in the
    picture, by far less."""
    alike = GOOD | {"unlike_part": 0.2, "unlike": 0.15, "unlike_likely": 0.12, "unlike_surely": 0.1, "explained": 0.7}
    alike |= {"contradicted": 0.15, "colour": 0.6, "laid": 0.5}
    somebody = GOOD | {"unlike_part": 0.1}
    never, seldom, often = (probability(alike, share) for share in (0.0, 0.02, 0.35))
    assert never > 0.95
    assert often < seldom < never
    assert often < 0.5
    assert probability(somebody) > 0.95


@pytest.mark.parametrize("aliased_prior", [-0.1, 0.7])
def test_the_priors_sum_to_less_than_one(aliased_prior: float) -> None:
    with raises(ConfigError, code="out_of_range", match="aliased_prior"):
        verdict.Params(aliased_prior=aliased_prior)


def test_all_that_is_not_asked_yet_may_be_as_good_as_can_be() -> None:
    """So a pose is hopeless only where no answer to the rest could save it."""
    settling = {name: GOOD[name] for name in ("matches", "inliers", "found_again", "laid", "spread", "sigma_m")}
    aliased_prior = verdict.Params().aliased_prior
    best = load_model().probability(settling, aliased_prior, optimistic=True)
    assert best >= probability(GOOD)
    poor = {name: BAD[name] for name in settling}
    assert load_model().probability(poor, aliased_prior, optimistic=True) >= probability(BAD)


@pytest.mark.parametrize("odds", ["other", "aliased"])
@pytest.mark.parametrize("name", GOOD)
def test_every_piece_counts_in_one_direction(name: str, odds: str) -> None:
    worth = np.diff(getattr(load_model(), odds).curves[name].worth)
    falls = name in ("contradicted", "contradicted_coarsely", "blocked", "sigma_m") or name.startswith("unlike")
    assert (worth <= 1e-9).all() if falls else (worth >= -1e-9).all()


@pytest.mark.guards("answers")
def test_what_is_not_probable_is_refused_with_its_weakest_evidence() -> None:
    params = verdict.Params()
    assert verdict.rejection_reason(GOOD, 0.99, SURE, 0.0, params) == ""
    refused = verdict.rejection_reason(GOOD | {"explained": 0.2}, 0.5, SURE, 0.0, params)
    assert "not probable enough: 50.0%" in refused
    assert "explains 20%" in refused


@pytest.mark.guards("answers")
def test_a_twin_is_told_as_ambiguous() -> None:
    assert "ambiguous" in verdict.rejection_reason(GOOD, 0.99, SURE, 0.6, verdict.Params())


def test_a_pose_that_is_hardly_known_is_not_said() -> None:
    assert "only to" in verdict.rejection_reason(GOOD, 0.99, (0.2, 0.01), 0.0, verdict.Params())
    assert "only to" in verdict.rejection_reason(GOOD, 0.99, (0.01, 2.0), 0.0, verdict.Params())
    assert "0 found" in verdict.rejection_reason(GOOD | {"inliers": 0.0}, 0.99, SURE, 0.0, verdict.Params())
    few = GOOD | {"inliers": np.log10(4)}
    assert "3 found" in verdict.rejection_reason(few, 0.99, SURE, 0.0, verdict.Params(), min_inliers=6)


def test_thresholds_are_settings() -> None:
    assert not verdict.rejection_reason(GOOD, 0.99, SURE, 0.6, verdict.Params(max_rival_probability=0.7))
    assert not verdict.rejection_reason(GOOD, 0.99, (0.2, 0.01), 0.0, verdict.Params(max_rotation_sigma_deg=20.0))
    assert not verdict.rejection_reason(GOOD, 0.99, (0.01, 2.0), 0.0, verdict.Params(max_translation_sigma_m=3.0))
    assert verdict.rejection_reason(GOOD, 0.99, SURE, 0.0, verdict.Params(min_probability=0.995))


@pytest.mark.guards("answers")
def test_what_scenes_err_is_carried_to_the_camera() -> None:
    """The covariance of a camera fixed to a scene is that of random poses of the scene."""
    rng = np.random.default_rng(0)
    S = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), 0.7)
    A = rng.normal(size=(7, 7)) * 0.002
    scene = MapScene("s", S, 0, A @ A.T, None, None)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = exp_so3(rng.normal(size=3)), rng.normal(size=3) * 3
    told = add_scene_covariance(np.zeros((6, 6)), T, [(scene, 1.0)])
    errors = []
    for _ in range(4000):
        moved = retract(S, A @ rng.normal(size=7)) @ S.inverse()
        at, turned = moved.apply(T[:3, 3]), moved.rotation @ T[:3, :3]
        chord = T[:3, :3].T @ turned
        turn = np.array([chord[2, 1] - chord[1, 2], chord[0, 2] - chord[2, 0], chord[1, 0] - chord[0, 1]]) / 2
        errors.append(np.r_[turn, T[:3, :3].T @ (at - T[:3, 3])])
    assert np.allclose(np.cov(np.array(errors).T), told, atol=0.12 * np.abs(told).max())
    assert np.array_equal(add_scene_covariance(told, T, [(replace_covariance(scene), 1.0)]), told)


def replace_covariance(scene: MapScene) -> MapScene:
    return MapScene(scene.scene, scene.S_metric_scene, 0, None, scene.read_gaussians, scene.read_features)


def test_depth_at_an_edge_is_not_sound() -> None:
    depth = np.full((1, 20, 20), 2.0, np.float32)
    depth[:, :, 10:] = 3.0
    alpha = np.ones_like(depth)
    alpha[:, 15:] = 0.5
    sound = smooth_depth(Rendering(np.zeros((1, 20, 20, 3), np.float32), alpha, depth)) > 0
    assert sound[5, 2]
    assert sound[5, 17]
    assert not sound[5, 8:12].any()
    assert not sound[17].any()
