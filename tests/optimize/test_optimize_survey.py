"""Components tied to the world, beside truth."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_worlds import poses_at
from scipy.stats import chi2

from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities
from gsmap.optimize import joint_covariance, optimize
from gsmap.optimize.survey_terms import SurveyTerms, Unknowns
from gsmap.types import Edge, PoseGraph, Prior, Sim3
from gsmap.types.world import ControlPoint, Georeference, ImagePoint, PositionFix, ScaleBar, Survey
from gsmap_synthetic.surveyed import Site, SiteParams, surveyed_site

sys.path.insert(0, str(Path(__file__).parents[1] / "world"))
from made_sites import survey_of

SMALL = SiteParams(rows=4, columns=4, num_check=6)


def solved(site: Site, survey: Survey) -> tuple[PoseGraph, Georeference]:
    answer = optimize(site.names, site.edges, survey=survey)
    (tie,) = answer.world
    return answer, tie


def errors(site: Site, answer: PoseGraph, tie: Georeference) -> np.ndarray:
    """(marks, 3) of where the map has all marks, in the world frame."""
    assert tie.S_world_map is not None
    truth = dict(zip(site.names, site.truth, strict=True))
    out = []
    for mark in site.marks:
        local = truth[mark.scene].inverse().apply(mark.true_m)
        out.append(tie.S_world_map.apply(answer.poses[mark.scene].S_map_scene.apply(local)) - mark.true_m)
    return np.array(out)


def test_control_points_tie_a_map() -> None:
    site = surveyed_site(3, SMALL)
    answer, tie = solved(site, survey_of(site))
    assert tie.problem == ""
    assert tie.metres_per_unit == pytest.approx(0.5, rel=1e-3)
    assert np.sqrt((errors(site, answer, tie) ** 2).sum(1).mean()) < 0.02
    assert optimize(site.names, site.edges).world == ()


def test_what_is_surveyed_bends_a_map_that_drifts() -> None:
    """The same map, tied by positions that are believed and by the same that are hardly believed."""
    site = surveyed_site(3, replace(SMALL, rows=2, columns=12, cross_every=99, edge_rotation_rad=3e-3))
    frame, found = survey_of(site).frame, []
    for sigma in (0.005, 0.5):
        fixes = tuple(
            PositionFix("origin", name, np.zeros(3), "local", S.translation, (sigma, sigma))
            for name, S in list(zip(site.names, site.truth, strict=True))[::3]
        )
        answer, tie = solved(site, Survey(frame, fixes=fixes))
        assert tie.S_world_map is not None
        at = [tie.S_world_map.apply(answer.poses[name].S_map_scene.translation) for name in site.names]
        found.append(np.sqrt(((np.array(at) - [S.translation for S in site.truth]) ** 2).sum(1).mean()))
    assert found[0] < 0.03
    assert found[1] > 3 * found[0]


def test_the_map_frame_stays_put() -> None:
    site = surveyed_site(1, SMALL)
    before = optimize(site.names, site.edges)
    after = optimize(site.names, site.edges, previous=before, survey=survey_of(site))
    anchor = site.names[0]
    moved = after.poses[anchor].S_map_scene.inverse() @ before.poses[anchor].S_map_scene
    assert np.abs(moved.matrix() - np.eye(4)).max() < 1e-6


@pytest.mark.parametrize("off", [(0.3, -0.2, 0.1), (0.0, 0.0, 5.0), (10_000.0, 0.0, 0.0), (0.08, 0.0, 0.0)])
def test_a_blundered_point_is_named(off: tuple[float, float, float]) -> None:
    site = surveyed_site(2, SMALL)
    answer, tie = solved(site, survey_of(site.with_blunder("G2", off)))
    uses = {row.name: row for row in tie.residuals if row.kind == "point"}
    assert uses["G2"].use == "outlier"
    assert uses["G2"].reason
    assert [name for name, row in uses.items() if row.use == "outlier"] == ["G2"]
    assert np.sqrt((errors(site, answer, tie) ** 2).sum(1).mean()) < 0.03
    # It says how far off it is.
    assert np.linalg.norm(np.abs(uses["G2"].error_m) - np.abs(_in_enu(site, off))) < 0.1


def test_points_that_are_less_precise_than_stated_are_seldom_taken_for_blunders() -> None:
    """Errors of ten times what is stated: either nothing is tied, or the tie is within its own errors."""
    wrong, tied = [], 0
    for seed in range(16):
        site = surveyed_site(seed, replace(SMALL, rows=2, columns=2, num_control=5, num_check=0))
        survey = survey_of(site)
        rng = np.random.default_rng(seed)
        points = []
        for point in survey.points:
            off = 10 * rng.normal(size=3) * np.array(point.sigma_m)[[0, 0, 1]]
            points.append(replace(point, position=point.position + off))
        answer, tie = solved(site, replace(survey, points=tuple(points)))
        if tie.S_world_map is not None and tie.covariance is not None:
            sigma = np.sqrt(np.trace(tie.covariance[3:6, 3:6])) * tie.S_world_map.scale
            at = tie.S_world_map.apply(answer.poses[site.names[0]].S_map_scene.translation)
            wrong.append(np.linalg.norm(at - site.truth[0].translation) > 5 * sigma)
            tied += 1
            given = replace(survey, points=tuple(points))
            joint = joint_covariance(answer, site.edges, (), given, [site.names[0]], 0)
            assert joint is not None
            assert np.sqrt(np.diag(joint[:7, :7])) == pytest.approx(np.sqrt(np.diag(tie.covariance)), rel=0.05)
    assert tied >= 3
    assert sum(wrong) <= 1


def _in_enu(site: Site, off: tuple[float, float, float]) -> np.ndarray:
    from gsmap.geodesy.frame import to_frame

    mark = next(mark for mark in site.marks if mark.name == "G2")
    a, b = to_frame(site.frame, np.stack([mark.surveyed, mark.surveyed + off]))
    return b - a


def test_a_wrongly_picked_photo_is_named_and_its_point_kept() -> None:
    site = surveyed_site(4, SMALL)
    survey = survey_of(site)
    images = list(survey.images)
    k = next(k for k, image in enumerate(images) if image.point == "G1")
    images[k] = replace(images[k], pixel=images[k].pixel + np.array([60.0, -20.0]))
    _, tie = solved(site, replace(survey, images=tuple(images)))
    out = [(row.kind, row.name) for row in tie.residuals if row.use == "outlier"]
    assert out == [("image", f"G1 in {images[k].image}")]


@pytest.mark.parametrize(
    ("keep", "said"),
    [
        ([], "position, rotation and scale are not determined"),
        (["G0"], "rotation and scale are not determined: only control point G0"),
        (["G0", "G1"], "rotation about the line through control point G0 and control point G1 is not determined"),
        (["G0", "G1", "G4"], "rotation about the line through .* is not determined .*add a control point"),
    ],
)
def test_too_few_points_are_refused_by_name(keep: list[str], said: str) -> None:
    """G0, G4 and G1 are the two ends and the middle of a diagonal; made collinear in height, too."""
    site = surveyed_site(5, SMALL)
    if "G4" in keep:
        truth = {mark.name: mark for mark in site.marks}
        on_line = (truth["G0"].true_m + truth["G1"].true_m) / 2
        survey = survey_of(site)
        scene = truth["G4"].scene
        S = dict(zip(site.names, site.truth, strict=True))
        fixes = tuple(
            PositionFix(n, S_scene, S[S_scene].inverse().apply(p), "local", p, (0.01, 0.01))
            for n, S_scene, p in (
                ("A", truth["G0"].scene, truth["G0"].true_m),
                ("B", truth["G1"].scene, truth["G1"].true_m),
                ("C", scene, on_line),
            )
        )
        survey = replace(survey, points=(), images=(), fixes=fixes)
    else:
        survey = survey_of(site)
        survey = replace(survey, points=tuple(p for p in survey.points if p.name in keep or p.check))
    _, tie = solved(site, survey)
    assert tie.S_world_map is None
    assert tie.covariance is None
    import re

    assert re.search(said, tie.problem), tie.problem


def test_three_points_tie_a_map_and_say_that_nothing_checks_them() -> None:
    site = surveyed_site(5, SMALL)
    survey = survey_of(site)
    survey = replace(survey, points=tuple(p for p in survey.points if p.name in ("G0", "G1", "G2")))
    _, tie = solved(site, survey)
    assert tie.S_world_map is not None
    assert any("blunder" in note for note in tie.notes)


def test_a_scale_bar_alone_gives_the_metre_and_nothing_else() -> None:
    site = surveyed_site(6, replace(SMALL, rows=1, columns=2, num_control=2, num_check=0))
    ends = np.array([[0.5, -3.0, 0.25], [-2.0, 1.0, 4.0]])  # each in its scene's frame
    length = float(np.linalg.norm(site.truth[0].apply(ends[0]) - site.truth[1].apply(ends[1])))
    bar = ScaleBar("bar", (site.names[0], site.names[1]), ends, (1e-3, 1e-3), length, 0.002)
    _, tie = solved(site, Survey(bars=(bar,)))
    assert tie.S_world_map is None
    assert tie.metres_per_unit == pytest.approx(0.5, rel=1e-3)
    assert 0 < tie.scale_sigma < 1e-3
    assert "not determined" in tie.problem


def test_scale_bars_that_contradict_each_other_are_less_sure_than_they_claim() -> None:
    site = surveyed_site(6, SMALL)
    a, b = site.names[0], site.names[3]
    length = float(np.linalg.norm(site.truth[0].translation - site.truth[3].translation))

    def sigma(*off: float) -> float:
        bars = tuple(
            ScaleBar(f"bar{k}", (a, b), np.zeros((2, 3)), (1e-6, 1e-6), length * (1 + by), 1e-3 * length)
            for k, by in enumerate(off)
        )
        _, tie = solved(site, Survey(bars=bars))
        assert tie.metres_per_unit == pytest.approx(0.5 * (1 + np.median(off)), rel=1e-3)
        assert [row.error_m[0] / length for row in tie.residuals] == pytest.approx(np.median(off) - off, abs=1e-3)
        assert [row.sigma_m[0] / length for row in tie.residuals] == pytest.approx([1e-3] * len(off), rel=1e-3)
        return tie.scale_sigma

    assert sigma(0.0, 0.0) == pytest.approx(1e-3 / 2**0.5, rel=0.05)
    apart = np.log1p([-0.02, 0.02])  # forty times their sigmas apart
    assert sigma(-0.02, 0.02) == pytest.approx(apart.std(ddof=1) / 2**0.5, rel=0.05)
    # Of three, the one that the others outvote does not count.
    assert sigma(0.0, 0.04, 0.0) == pytest.approx(1e-3 / 2**0.5, rel=0.05)


def test_a_check_point_is_compared_within_the_sigma_of_the_map() -> None:
    """Known to a micrometre, it still lies where the map, known to millimetres, puts it."""
    site = surveyed_site(10, SMALL)
    survey = survey_of(site)
    truth = {mark.name: mark.true_m for mark in site.marks}
    exact = tuple(
        replace(point, position=truth[point.name], sigma_m=(1e-6, 1e-6)) if point.check else point
        for point in survey.points
    )
    _, tie = solved(site, replace(survey, points=exact))
    rows = [row for row in tie.residuals if row.kind == "point" and row.use == "check" and row.error_m]
    assert len(rows) > 3
    limit = chi2.ppf(0.9999, 3)
    assert all(row.statistic is not None and row.statistic < limit for row in rows)


def test_positions_of_cameras_tie_a_map_with_an_honest_sigma() -> None:
    """What all of a capture's fixes are off by together is not averaged away."""
    rng = np.random.default_rng(0)
    site = surveyed_site(7, SMALL)
    fixes = []
    for name, S, cameras in zip(site.names, site.truth, site.cameras, strict=True):
        own = rng.normal(size=3) * 3.0
        for photo, centre in zip(cameras.names, cameras.centers, strict=True):
            at = S.apply(centre) + own + rng.normal(size=3) * 0.5
            fixes.append(PositionFix(photo, name, centre, "local", at, (0.5, 0.5), (3.0, 3.0)))
    frame = survey_of(site).frame
    answer, tie = solved(site, Survey(frame, fixes=tuple(fixes)))
    assert tie.S_world_map is not None
    sigma = np.sqrt(np.diag(tie.covariance))
    shift = sigma[3:6] * tie.metres_per_unit
    assert not any(row.use == "outlier" for row in tie.residuals)
    assert tie.notes == ()
    assert (shift > 0.5).all(), "sixteen captures of 3 m each"
    assert (shift < 3).all()
    assert np.abs(errors(site, answer, tie).mean(0)).max() < 3


def test_the_covariance_is_honest() -> None:
    """NEES of the world pose of scenes, over made sites."""
    nees = []
    for seed in range(12):
        site = surveyed_site(100 + seed, replace(SMALL, num_check=0, edge_rotation_rad=1e-3, edge_translation_m=5e-3))
        survey = survey_of(site)
        answer, tie = solved(site, survey)
        assert tie.S_world_map is not None
        for k in (5, 10):
            scene = site.names[k]
            joint = joint_covariance(answer, site.edges, (), survey, [scene], 0)
            pose = answer.poses[scene].S_map_scene
            back = Similarities.stack([pose]).inverse().adjoint()[0]
            both = np.concatenate([back, np.eye(7)], axis=1)
            covariance = both @ joint @ both.T
            found = tie.S_world_map @ pose
            step = Similarities.stack([found.inverse() @ site.truth[k]]).log()[0]
            nees.append(step @ np.linalg.solve(covariance, step))
    # The scale of all scenes is one unknown: 7 dof each.
    assert 0.6 < np.mean(nees) / 7 < 1.5
    assert np.mean(np.array(nees) < chi2.ppf(0.95, 7)) > 0.8


def test_common_errors_of_fixes_are_an_offset_a_drift_and_the_sea_level() -> None:
    """Errors of three photos of a flight and of one of another, by hand; photo 10 is taken after photo 2."""
    at, ids = np.zeros(3), ("a", "b")

    def fix(scene: str, name: str, sea_m: float = 0.0) -> PositionFix:
        return PositionFix(name, scene, at, "local", at, (1.0, 1.0), (2.0, 4.0), sea_m)

    terms = SurveyTerms.of(Survey(fixes=(fix("a", "10"), fix("a", "2", 40.0), fix("b", "1"), fix("a", "1"))), ids, 7)
    x = terms.start(Similarities.stack([Sim3.identity()] * 2), Sim3.identity())

    def off(row: int) -> list[list[float]]:
        offsets = np.zeros((5, 3))
        offsets[row] = 1.0  # of its standard deviation
        return terms.observations(replace(x, offsets=offsets))[2].residuals.tolist()

    none, whole, half = [0.0] * 3, [2.0, 2.0, 4.0], [0.5, 0.5, 1.0]
    assert off(0) == [whole, whole, none, whole]
    assert off(1) == [none, none, whole, none]
    assert off(2) == [half, none, none, [-v for v in half]]  # a drift of half the offset over the flight
    assert off(3) == [none] * 4, "one photo shows no drift"
    assert off(4) == [none, [0.0, 0.0, 40.0], none, none]


def test_priors_hold_the_map_frame_and_the_survey_holds_the_world() -> None:
    site = surveyed_site(12, replace(SMALL, rows=2, num_control=5, num_check=0))
    scene, pose = site.names[2], Sim3(exp_so3([0.3, -0.2, 1.0]), np.array([5.0, -3.0, 2.0]), 0.7)
    priors = [Prior(scene, pose, np.full(7, 1e-3))]
    answer = optimize(site.names, site.edges, priors=priors, survey=survey_of(site))
    assert np.abs(answer.poses[scene].S_map_scene.matrix() - pose.matrix()).max() < 1e-6
    assert np.linalg.norm(errors(site, answer, answer.world[0]), axis=1).max() < 0.05
    joint = joint_covariance(answer, site.edges, priors, survey_of(site), site.names[5:7], 0)
    for k, name in enumerate(site.names[5:7], 1):
        here = slice(7 * k, 7 * k + 7)
        np.testing.assert_allclose(answer.poses[name].covariance, joint[here, here], rtol=1e-3, atol=1e-9)


def test_the_covariance_between_two_scenes_of_a_chain_is_that_of_their_edge() -> None:
    truth, information = poses_at(np.diag([3.0, 2.0, 1.0])), np.diag([4e4, 2e4, 1e4, 4e2, 2e2, 1e2, 1e10])
    edges = [Edge(*"ab", (truth[0:1].inverse() @ truth[1:2]).item(0), information)]
    edges += [Edge(*"bc", (truth[1:2].inverse() @ truth[2:3]).item(0), information / 9)]
    answer = optimize("abc", edges)
    joint = joint_covariance(answer, edges, (), None, ["b", "c"], 0)
    assert not joint[:7].any()
    S_c_b = answer.poses["c"].S_map_scene.inverse() @ answer.poses["b"].S_map_scene
    both = np.concatenate([-Similarities.stack([S_c_b]).adjoint()[0], np.eye(7)], axis=1)
    found = (both @ joint[7:, 7:] @ both.T)[:6, :6]
    np.testing.assert_allclose(found, np.linalg.inv(information / 9)[:6, :6], atol=1e-6)
    np.testing.assert_allclose(joint[7:14, 7:14], answer.poses["b"].covariance, atol=1e-9)


def residuals(terms: SurveyTerms, x: Unknowns, at: Unknowns) -> list[np.ndarray]:
    return [one.residuals for one in (*terms.observations(x), *terms.others(x, at))]


def test_derivatives() -> None:
    """Every term's derivative beside differences."""
    rng = np.random.default_rng(3)
    site = surveyed_site(8, replace(SMALL, rows=2, columns=2, num_control=4, num_check=0))
    survey = survey_of(site)
    images = tuple(
        replace(i, depth=4.0, depth_sigma=0.1, camera_covariance=np.eye(6) * 1e-4 if k % 2 else None)
        for k, i in enumerate(survey.images)
    )
    a, b = site.names[:2]
    fixes = (PositionFix("f", a, rng.normal(size=3), "local", rng.normal(size=3), (1.0, 2.0), (3.0, 4.0), 40.0),)
    bars = (ScaleBar("b", (a, b), rng.normal(size=(2, 3)), (1e-4, 1e-4), 3.0, 0.1),)
    for dim in (6, 7):
        terms = SurveyTerms.of(replace(survey, images=images, fixes=fixes, bars=bars), site.names, dim)
        scenes = Similarities.stack([Sim3(S.rotation, S.translation, 0.5) for S in site.truth])
        x = terms.start(scenes, Sim3.identity())
        x = x.moved(rng.normal(size=terms.columns.size) * 1e-2, dim)
        kinds = (*terms.observations(x), *terms.others(x, x))
        for c, step in enumerate(1e-6 * np.eye(terms.columns.size)):
            ahead, behind = residuals(terms, x.moved(step, dim), x), residuals(terms, x.moved(-step, dim), x)
            for kind, more, less in zip(kinds, ahead, behind, strict=True):
                J = kind.rows(terms.columns.size)
                off = np.abs((more - less) / 2e-6 - J[:, :, c]).max(initial=0)
                assert off < 1e-3 * max(1.0, np.abs(J).max(initial=0)), (kind.kind, c)


def test_a_component_that_is_turned_upright_lies_where_it_lay() -> None:
    from gsmap.optimize import gravity_align

    site = surveyed_site(9, SMALL)
    answer, tie = solved(site, survey_of(site))
    assert tie.S_world_map is not None
    up = {name: np.array([0.0, 0.5, 1.0]) for name in site.names}
    turned = gravity_align(answer, up)
    assert turned.world[0].S_world_map is not None
    for name in site.names[:3]:
        before = tie.S_world_map @ answer.poses[name].S_map_scene
        after = turned.world[0].S_world_map @ turned.poses[name].S_map_scene
        assert np.abs(before.matrix() - after.matrix()).max() < 1e-9
    assert np.abs(turned.poses[site.names[0]].S_map_scene.matrix() - np.eye(4)).max() > 0.1


def test_the_covariance_of_the_tie_is_honest() -> None:
    """``S_world_map`` with the anchor's scene taken as exact, over made sites."""
    nees, snooped = [], []
    for seed in range(15):
        site = surveyed_site(300 + seed, replace(SMALL, num_check=0))
        _, tie = solved(site, survey_of(site))
        assert tie.S_world_map is not None
        # The anchor's own frame is the map's.
        step = Similarities.stack([tie.S_world_map.inverse() @ site.truth[0]]).log()[0]
        nees.append(step @ np.linalg.solve(tie.covariance, step))
        snooped += [row.statistic / row.dof for row in tie.residuals if row.kind == "point"]
    assert 0.5 < np.mean(nees) / 7 < 1.7
    assert 0.7 < np.mean(snooped) < 1.4, "each observation against all others"


def test_a_check_point_changes_nothing() -> None:
    site = surveyed_site(10, SMALL)
    _, tie = solved(site, survey_of(site))
    _, other = solved(site, survey_of(site.with_blunder("C0", (5.0, 0.0, 0.0))))
    assert tie.S_world_map is not None
    assert other.S_world_map is not None
    assert np.abs(tie.S_world_map.matrix() - other.S_world_map.matrix()).max() < 1e-9
    row = next(row for row in other.residuals if row.name == "C0")
    assert row.use == "check"
    assert np.linalg.norm(row.error_m) == pytest.approx(5, abs=0.1)


def test_a_single_capture_is_tied() -> None:
    """As most maps begin: no edge, and marks in the photos of one capture."""
    site = surveyed_site(11, replace(SMALL, rows=1, columns=2, num_control=2, num_check=0))
    cameras, S = site.cameras[0], site.truth[0]
    rng, points, images = np.random.default_rng(0), [], []
    for k, local in enumerate([(-4, -3, 0), (4, -3, 0.5), (3, 4, 0), (-4, 3, 1), (0, 0, 0.2)]):
        at = np.array(local, dtype=float) / 2
        points.append(ControlPoint(f"P{k}", "local", S.apply(at) + rng.normal(size=3) * 0.003, (0.003, 0.003)))
        for c in (0, 3, 6):
            pixel, _ = project(at[None], cameras.T_camera_frame[c], cameras.intrinsics_px[c])
            picked = pixel[0] + rng.normal(size=2) * 0.5
            pose, intrinsics = cameras.T_frame_camera[c], cameras.intrinsics_px[c]
            images.append(ImagePoint(f"P{k}", cameras.names[c], site.names[0], picked, 0.5, pose, intrinsics))
    survey = Survey(site.frame, tuple(points), tuple(images))
    answer = optimize(site.names[:1], (), survey=survey)
    (tie,) = answer.world
    assert tie.S_world_map is not None
    off = (tie.S_world_map @ answer.poses[site.names[0]].S_map_scene).apply(np.zeros((1, 3)))[0] - S.translation
    assert np.linalg.norm(off) < 0.01
    step = Similarities.stack([tie.S_world_map.inverse() @ S]).log()[0]
    assert step @ np.linalg.solve(tie.covariance, step) < chi2.ppf(0.999, 7)
    assert answer.poses[site.names[0]].covariance is None, "it is its own frame"
    joint = joint_covariance(answer, (), (), survey, [site.names[0]], 0)
    assert joint is not None
    assert np.isfinite(joint).all()
