import numpy as np
import pytest
from raising import raises

from gsmap.errors import InputError
from gsmap.geometry.metric_scale import SceneUnit, _majority, estimate_metric_scale, in_metres, scale_gaussians
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_gaussians
from gsmap.types import Gaussians, ScenePose, Sim3
from gsmap.types.metric_scale import MetricScale


def pose(scale=1.0, sigma=None):
    covariance = None if sigma is None else np.diag([1e-6] * 6 + [sigma**2])
    return ScenePose("a", Sim3(np.eye(3), [1.0, 2, 3], scale), 0, "placed", covariance)


KNOWN, UNKNOWN = SceneUnit(in_metres=True), SceneUnit()


def test_a_capture_in_metres_measures_the_unit_of_the_map_through_its_scale():
    # 1 m of the capture is 4 units of the map.
    found = estimate_metric_scale([(UNKNOWN, pose()), (KNOWN, pose(4.0, 0.001))])
    assert (found.metres_per_unit, found.known_by) == (0.25, "measured")
    assert found.sigma == pytest.approx(0.02, rel=0.02)


def test_what_a_person_gives_of_a_capture_is_of_its_own_unit():
    told = SceneUnit(specified=0.3048)
    assert estimate_metric_scale([(told, pose())]).metres_per_unit == 0.3048  # to the last digit
    assert estimate_metric_scale([(UNKNOWN, pose()), (told, pose(2.0))]).metres_per_unit == pytest.approx(
        0.1524, rel=0.005
    )
    # A person who measured knows better than a capture that is said to be in metres.
    found = estimate_metric_scale(
        [(KNOWN, pose()), (KNOWN, pose()), (SceneUnit(specified=1.05, in_metres=True), pose())]
    )
    assert (found.metres_per_unit, found.known_by) == (1.05, "told")


def test_each_is_weighed_by_how_well_its_scale_is_known():
    good, bad = (KNOWN, pose(2.0, 0.001)), (KNOWN, pose(2.2, 0.5))
    assert estimate_metric_scale([good, bad]).metres_per_unit == pytest.approx(0.5, rel=0.005)


def test_many_captures_of_one_device_are_no_better_than_one():
    assert estimate_metric_scale([(KNOWN, pose(3.0, 0.002))] * 100).sigma >= 0.02


def test_captures_that_disagree_on_the_metre_are_told_of_and_the_sigma_says_so():
    found = estimate_metric_scale([(KNOWN, pose(1.0)), (KNOWN, pose(1.3))])
    assert "differ" in found.note
    assert found.sigma > 0.1


def test_one_is_the_metre_where_nothing_speaks_against_it_so_that_tiles_stay():
    assert estimate_metric_scale([(KNOWN, pose()), (KNOWN, pose(1.008, 0.002))]).metres_per_unit == 1.0
    off = [(UNKNOWN, pose()), (KNOWN, pose(1.06, 0.002)), (KNOWN, pose(1.06, 0.002))]
    assert estimate_metric_scale(off).metres_per_unit == pytest.approx(1 / 1.06, rel=0.002)


def test_a_plausible_own_unit_is_assumed_and_said_to_be():
    own = SceneUnit(may_be_metres=True, guess_m=1.4)
    found = estimate_metric_scale([(own, pose()), (own, pose())])
    assert (found.metres_per_unit, found.known_by, found.sigma, found.note) == (1.0, "assumed", 0.03, "")
    # Captures in metres are laid over one that is not: its unit is not theirs.
    other = SceneUnit(guess_m=0.07)
    assert estimate_metric_scale(
        [(other, pose()), (own, pose(20.0)), (own, pose(20.0))]
    ).metres_per_unit == pytest.approx(0.05)


def test_the_doubt_of_an_assumed_metre_covers_what_its_content_says():
    found = estimate_metric_scale([(SceneUnit(may_be_metres=True, guess_m=0.3), pose())])
    assert found.metres_per_unit == 1.0
    assert found.sigma == pytest.approx(abs(np.log(0.3)))
    assert "0.3" in found.note


def test_of_two_own_units_that_differ_none_is_assumed():
    found = estimate_metric_scale(
        [(SceneUnit(may_be_metres=True, guess_m=g), pose(s)) for g, s in ((1.2, 1.0), (0.6, 0.5))]
    )
    assert found.known_by == "guessed"


def test_a_guess_says_how_little_it_is_and_does_not_follow_every_capture():
    scenes = [(SceneUnit(guess_m=0.26 * f), pose()) for f in (0.9, 1.0, 1.1)]
    found = estimate_metric_scale(scenes)
    assert found.known_by == "guessed"
    assert found.sigma == pytest.approx(np.log(2))
    assert abs(np.log(found.metres_per_unit / 0.26)) < 0.18
    assert "factor of 2" in found.note
    assert estimate_metric_scale([*scenes, (SceneUnit(guess_m=0.3), pose())]).metres_per_unit == found.metres_per_unit


@pytest.mark.parametrize(
    ("unit", "sigma", "known_by"),
    [
        (SceneUnit(specified=1.0), 0.01, "surveyed"),
        (SceneUnit(specified=1.0), 0.1, "told"),
        (KNOWN, 0.1, "measured"),
        (SceneUnit(may_be_metres=True), 0.1, "assumed"),
        (SceneUnit(guess_m=0.3), 0.1, "surveyed"),
        (SceneUnit(guess_m=0.3), 1.0, "guessed"),
        (UNKNOWN, 0.1, "surveyed"),
    ],
)
def test_a_survey_is_taken_where_nothing_better_is_known(unit, sigma, known_by):
    assert estimate_metric_scale([(unit, pose())], (2.0, sigma)).known_by == known_by


def test_where_nothing_tells_one_is_taken_and_said_to_be():
    found = estimate_metric_scale([(UNKNOWN, pose())])
    assert (found.metres_per_unit, found.known_by, found.is_known) == (1.0, "unknown", False)
    assert np.isinf(found.sigma)


def test_people_can_read_it():
    assert MetricScale(0.25, 0.01, "told").text() == "0.25 m per unit, told, to within 1 %"
    assert MetricScale(0.25, float(np.log(2)), "guessed").text() == "0.25 m per unit, guessed, to within a factor of 2"
    for wrong in (0.0, -1.0, float("nan")):
        with raises(InputError, code="invalid_metre"):
            MetricScale(wrong, 0.01, "told")


def test_a_scene_in_metres_is_the_scene_in_the_map_times_metres_per_unit():
    rng = np.random.default_rng(0)
    S = Sim3(exp_so3([0.3, -0.2, 1.0]), [1.0, 2, 3], 0.7)
    points = rng.normal(size=(5, 3))
    np.testing.assert_allclose(in_metres(S, 0.3).apply(points), 0.3 * S.apply(points), rtol=1e-12)
    assert in_metres(S, 1.0) is S
    n = 20
    g = Gaussians(
        rng.normal(size=(n, 3)), rng.normal(size=(n, 4)), rng.normal(size=(n, 3)), np.zeros(n), np.ones((n, 1, 3))
    )
    there = transform_gaussians(g, in_metres(S, 0.3))
    back, direct = scale_gaussians(there, 1 / 0.3), transform_gaussians(g, S)
    np.testing.assert_allclose(back.means, direct.means, atol=2e-6)
    np.testing.assert_allclose(back.log_scales, direct.log_scales, atol=2e-6)
    assert scale_gaussians(g, 1.0) is g


@pytest.mark.parametrize("seed", range(6))
def test_whose_units_agree_is_told_pair_by_pair(seed):
    rng = np.random.default_rng(seed)
    sigmas = rng.choice([None, 0.01, 0.1, 0.4], 15)
    poses = [pose(float(np.exp(rng.normal(0, 0.4))), sigma) for sigma in sigmas]
    variances = [0.0 if sigma is None else sigma**2 for sigma in sigmas]
    logs = np.log([one.S_map_scene.scale for one in poses])
    near = np.abs(logs[:, None] - logs) <= 5 * np.sqrt(2 * 0.03**2 + np.add.outer(variances, variances))
    most = near[near.sum(1).argmax()]
    expected = [one for one, agrees in zip(poses, most, strict=True) if agrees] if 2 * most.sum() > 15 else []
    assert _majority(poses) == expected


def test_units_may_agree_since_both_are_vague():
    vague = [pose(float(np.exp(log)), 0.1) for log in (3.0, 2.4, 2.4, 3.6, 3.6)]
    assert _majority([*[pose()] * 3, *vague]) == vague  # .6 is within five sigmas of two vague ones, not of one


def test_whose_units_agree_takes_no_room_for_every_pair():
    import tracemalloc

    poses = [pose(1.0 + 1e-6 * k, 0.01 + 1e-6 * k) for k in range(5000)]
    tracemalloc.start()
    assert len(_majority(poses)) == 5000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6  # a number for every pair would be 200 MB
