"""Maps made by hand against truth made by hand: every figure of a report can be worked out on paper."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from raising import raises
from scipy.stats import chi2

from gsmap.errors import ConfigError
from gsmap.evaluate.calibration import nees_of_edge, nees_of_pose, nees_rows, relative_covariance, truth_covariance
from gsmap.evaluate.map_errors import EvaluatedScene, Params, evaluate_map
from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.similarities import Similarities, exp
from gsmap.types import PoseGraph, ScenePose, Sim3
from gsmap.types.rows.evaluation import EvaluationReport
from gsmap.types.rows.pairs import EdgeRow

CENTERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
SIGMAS = np.array([0.001] * 3 + [0.01] * 3 + [0.002])
INFORMATION = np.diag(SIGMAS**-2)


def at(x: float, y: float = 0.0, z: float = 0.0, scale: float = 1.0, turn: float = 0.0) -> Sim3:
    return Sim3(exp_so3([0, 0, turn]), [x, y, z], scale)


def scene(name: str, truth: Sim3 | None) -> EvaluatedScene:
    """A scene whose middle is its origin."""
    return EvaluatedScene(f"id-{name}", name, truth, np.zeros(3), CENTERS)


def edge(a: str, b: str, pose: Sim3 | None, status: str = "accepted", used: bool | str = True, **more) -> EdgeRow:
    return EdgeRow(
        target=f"id-{a}",
        target_name=a,
        source=f"id-{b}",
        source_name=b,
        status=status,
        reason="",
        S_target_source=pose,
        scale=None if pose is None else pose.scale,
        information=None if pose is None else more.pop("information", INFORMATION),
        num_inliers=9,
        num_correspondences=20,
        overlap=0.5,
        seconds={},
        used=used,
        **more,
    )


def graph(*placed: tuple[str, Sim3, int, str], covariances: dict[str, np.ndarray] | None = None) -> PoseGraph:
    known = covariances or {}
    return PoseGraph({f"id-{n}": ScenePose(f"id-{n}", S, k, status, known.get(n)) for n, S, k, status in placed})


def overlaps(scenes: list[EvaluatedScene], **known: float) -> dict[frozenset[str], float]:
    """Those of pairs named like ``ab``; 0 for all others."""
    pairs = combinations([s.name for s in scenes if s.S_scene_world is not None], 2)
    return {frozenset((f"id-{a}", f"id-{b}")): known.get(a + b, 0.0) for a, b in pairs}


# --- what failed is said --------------------------------------------------------------------------------------------


def test_isolated_scenes_have_no_ate() -> None:
    """Each aligned by itself would be right, whatever became of the map."""
    scenes = [scene(n, at(x)) for n, x in zip("abc", (0, 5, 10), strict=True)]
    edges = [edge("a", "b", at(-5), status="rejected", used=False), edge("b", "c", None, "no_match", used=False)]
    poses = graph(*((n, at(7, 7, 7), k, "isolated") for k, n in enumerate("abc")))
    report = evaluate_map(scenes, edges, poses, overlaps(scenes, ab=0.6, bc=0.3))
    assert (report.num_scenes, report.num_placed, report.num_tentative) == (3, 0, 0)
    assert report.ate_m is None
    assert report.verdict == "0 of 3 placed, no ATE: no two scenes are connected by edges"
    assert (report.edges, report.pairs, report.components, report.nees) == ((), (), (), ())
    assert [(b.num_pairs, b.recall, b.precision) for b in report.bands] == [
        (1, 0.0, None),
        (0, None, None),
        (1, 0.0, None),
        (1, 0.0, None),
    ]
    assert report.edges_median_rre_deg is None


def test_a_map_without_poses_says_so() -> None:
    scenes = [scene("a", at(0)), scene("b", at(5))]
    report = evaluate_map(scenes, [edge("a", "b", at(-5), used=False)], None, overlaps(scenes, ab=0.6))
    assert report.verdict == "0 of 2 placed, no ATE: the map has no poses yet: run gsmap optimize"
    assert report.bands[3].recall == 1.0
    assert report.edges_verdict == "no edge in use could be compared with the truth"


def test_a_scene_whose_neighbours_are_gone_is_not_placed() -> None:
    scenes = [scene("a", at(0)), scene("c", at(5))]
    poses = graph(("a", at(0), 0, "placed"), ("b", at(2), 0, "placed"), ("c", at(5), 1, "isolated"))
    report = evaluate_map(scenes, [], poses, overlaps(scenes))
    assert report.num_placed == 0
    assert report.ate_m is None


def test_only_what_counts_as_accepted_is_scored() -> None:
    """A person's word is in the row's status: what was rejected is not scored, what was confirmed is."""
    scenes = [scene(n, at(x)) for n, x in zip("abc", (0, 5, 10), strict=True)]
    edges = [
        edge("a", "b", at(90), status="rejected", review="reject"),
        edge("b", "c", at(-5), review="confirm"),
        edge("a", "c", at(90), status="rejected", used=False),
    ]
    poses = graph(("a", at(0), 0, "placed"), ("b", at(-5), 0, "placed"), ("c", at(-10), 0, "placed"))
    report = evaluate_map(scenes, edges, poses, overlaps(scenes))
    assert [row.pair for row in report.edges] == ["b:c"]
    assert "the newest poses use edges that are no longer accepted: a:b; run gsmap optimize" in report.notes


# --- edges ----------------------------------------------------------------------------------------------------------


def test_wrong_edges_in_use_are_named() -> None:
    scenes = [scene(n, at(x)) for n, x in zip("abcd", (0, 5, 10, 15), strict=True)]
    edges = [
        edge("a", "b", at(-5.04)),  # 4 cm off
        edge("b", "c", at(-5.06), used="tentative"),  # 6 cm off
        edge("c", "d", at(-5, turn=np.radians(1.1))),
        edge("a", "c", at(90), used=False),  # wrong, but nothing rests on it
    ]
    report = evaluate_map(scenes, edges, None, overlaps(scenes, ab=0.6, bc=0.25, cd=0.1, ac=0.099))
    assert [row.right for row in report.edges] == [True, False, False, False]
    assert [row.pair for row in report.false_edges] == ["b:c", "c:d"]
    assert report.edges_verdict == "2 of 3 false, beyond 1 deg or 0.05 m: b:c, c:d"
    assert [(b.num_pairs, b.num_accepted, b.num_right) for b in report.bands] == [
        (3, 1, 0),  # ad, bd, ac
        (1, 1, 0),
        (1, 1, 0),
        (1, 1, 1),
    ]
    assert [b.precision for b in report.bands] == [0, 0, 0, 1]
    assert report.edges[2].rre_deg == pytest.approx(1.1)
    wider = evaluate_map(scenes, edges, None, overlaps(scenes), Params(max_rre_deg=1.2, max_rte_m=0.07))
    assert wider.false_edges == ()
    assert (wider.max_rre_deg, wider.max_rte_m) == (1.2, 0.07)


def test_bars_are_positive() -> None:
    with raises(ConfigError, code="out_of_range", match="max_rte_m"):
        Params(max_rte_m=0)


def test_metres_are_the_truths() -> None:
    """Captures in units of 10 m and 10 cm: an edge that is 0.004 units of the target off is 4 cm off."""
    scenes = [scene("a", at(0, scale=0.1)), scene("b", at(5, scale=10.0))]
    true = scenes[0].S_scene_world @ scenes[1].S_scene_world.inverse()
    off = Sim3(true.rotation, true.translation + np.array([0.004, 0, 0]), true.scale * 1.01)
    (row,) = evaluate_map(scenes, [edge("a", "b", off)], None, overlaps(scenes, ab=0.6)).edges
    assert row.centroid_m == pytest.approx(0.04)
    assert row.rse == pytest.approx(0.01)
    assert row.right


def test_what_has_no_truth_is_not_judged_and_said() -> None:
    scenes = [scene("a", at(0)), scene("b", at(5)), scene("c", None)]
    edges = [edge("a", "b", at(-5)), edge("b", "c", at(1))]
    poses = graph(("a", at(0), 0, "placed"), ("b", at(-5), 0, "placed"))
    report = evaluate_map(scenes, edges, poses, overlaps(scenes, ab=0.6))
    assert (len(report.edges), report.edges_without_truth) == (1, 1)
    assert report.notes[0] == "scenes without a true pose are not evaluated: c"
    assert report.notes[1] == "scenes newer than the newest poses: c; run gsmap optimize"


# --- poses ----------------------------------------------------------------------------------------------------------


def two_components(scale: float = 1.0) -> tuple[list[EvaluatedScene], PoseGraph]:
    """Two pairs, each in a frame of its own; the second scene of the first one is 1 cm off."""
    scenes = [scene(n, at(x, scale=scale)) for n, x in zip("abcd", (0, 5, 0, 5), strict=True)]

    def placed(frame: Sim3, which: int, off: float) -> Sim3:
        return frame @ at(off) @ scenes[which].S_scene_world.inverse()

    first, second = at(9, 9, 9, turn=2.0, scale=scale), at(-50, 3, turn=-1.0, scale=scale)
    return scenes, graph(
        ("a", placed(first, 0, 0.0), 0, "placed"),
        ("b", placed(first, 1, 0.01), 0, "placed"),
        ("c", placed(second, 2, 0.0), 1, "tentative"),
        ("d", placed(second, 3, 0.0), 1, "tentative"),
    )


def expected_ate(off: float, scale: float) -> float:
    """Half of the cameras moved along x by ``off`` metres, after the best alignment, by brute force."""
    from scipy.optimize import least_squares

    with_scale = scale != 1
    true = np.concatenate([CENTERS, CENTERS - [5.0, 0, 0]]) / scale
    moved = true + np.repeat([[0.0, 0, 0], [off, 0, 0]], 4, axis=0)

    def residual(x: np.ndarray) -> np.ndarray:
        return (np.exp(x[6] * with_scale) * moved @ exp_so3(x[:3]).T + x[3:6] - true).ravel()

    best = least_squares(residual, np.zeros(7), xtol=1e-15, ftol=1e-15)
    return float(np.sqrt(2 * best.cost / 8))


def test_ate_is_of_each_component_in_its_own_frame() -> None:
    scenes, poses = two_components()
    report = evaluate_map(scenes, [], poses, overlaps(scenes))
    assert (report.num_placed, report.num_tentative) == (2, 2)
    first, second = report.components
    assert first.scene_names == ("a", "b")
    assert first.num_cameras == 8
    assert first.alignment == second.alignment == "rigid"
    assert first.ate_m == pytest.approx(expected_ate(0.01, scale=1.0), rel=1e-6)
    assert first.ate_m > 0.004
    assert second.ate_m == pytest.approx(0, abs=1e-9)
    assert report.ate_m == pytest.approx(first.ate_m / np.sqrt(2))
    assert report.verdict.startswith("2 of 4 placed, 2 tentative, ATE 0.00")
    assert [row.pair for row in report.pairs] == ["a:b", "c:d"]
    assert report.pairs_worst_centroid_m == pytest.approx(0.01)


def test_a_map_in_another_unit_is_aligned_with_scale_and_judged_in_metres() -> None:
    scenes, poses = two_components(scale=0.2)
    first = evaluate_map(scenes, [], poses, overlaps(scenes)).components[0]
    assert first.alignment == "similarity"
    assert first.ate_m == pytest.approx(expected_ate(0.01, scale=0.2), rel=1e-6)


def test_a_metric_map_of_the_wrong_size_is_wrong() -> None:
    """Captures in metres must stay in metres: no alignment may take the error away."""
    scenes = [scene("a", at(0)), scene("b", at(5))]
    poses = graph(("a", at(0, scale=1.02), 0, "placed"), ("b", at(-5.1, scale=1.02), 0, "placed"))
    assert evaluate_map(scenes, [], poses, overlaps(scenes)).ate_m > 0.03


def test_a_component_that_the_truth_cannot_judge_says_why() -> None:
    scenes = [scene("a", at(0)), scene("b", None)]
    poses = graph(("a", at(0), 0, "placed"), ("b", at(5), 0, "placed"))
    report = evaluate_map(scenes, [], poses, {})
    assert report.components[0].ate_reason == "1 of its 2 scenes have a true pose, but two are needed"
    assert (
        report.verdict == "2 of 2 placed, no ATE: component 0: 1 of its 2 scenes have a true pose, but two are needed"
    )
    few = [EvaluatedScene(f"id-{n}", n, at(0), np.zeros(3), CENTERS[:1]) for n in "ab"]
    report = evaluate_map(few, [], poses, overlaps(few))
    assert report.ate_m is None
    assert report.ate_reason == "component 0: 2 cameras do not determine an alignment; three are needed"


# --- covariances ----------------------------------------------------------------------------------------------------


def test_nees_of_an_edge_in_six_and_seven_dimensions() -> None:
    true = at(3, 1, turn=0.4)
    for dof, sigmas in ((6, [1, -2, 0.5, 1, 1, 2, 0]), (7, [1, -2, 0.5, 1, 1, 2, -3])):
        error = np.array(sigmas) * SIGMAS
        estimated = true @ exp(-error[None]).item(0)  # so that S_hat Exp(error) is the truth
        found = nees_of_edge(estimated, INFORMATION, true)
        assert found.dof == dof
        assert found.value == pytest.approx(sum(s * s for s in sigmas), rel=1e-6)


def test_an_edge_that_claims_a_scale_of_one_pays_for_it() -> None:
    """Rigid where the captures differ by 2 %: two thousandths over a claim of one in a million."""
    stiff = np.diag(np.r_[SIGMAS[:6], 1e-6] ** -2)
    found = nees_of_edge(at(3), stiff, at(3, scale=1.02))
    assert found.dof == 7
    assert found.value > (0.0198 / 1e-6) ** 2


def test_a_truth_that_is_not_exact_is_allowed_for() -> None:
    """Edges whose errors are those of two truths alone, each turned and moved about its scene's middle."""
    rng, middle, turn, shift = np.random.default_rng(3), np.array([40.0, -10.0, 5.0]), 0.01, 0.05
    allowed = truth_covariance(turn, shift, middle)
    values = []
    for _ in range(200):
        xi = np.sqrt(2) * rng.normal(size=(1, 7)) * np.r_[np.full(3, turn), np.full(3, shift), 0.0]
        moved = Sim3(np.eye(3), middle) @ exp(xi).item(0) @ Sim3(np.eye(3), -middle)
        values.append(nees_of_edge(at(3), np.eye(7) * 1e12, at(3) @ moved, allowed).value)
    assert np.median(values) == pytest.approx(chi2.ppf(0.5, 6), rel=0.15)


def test_an_exact_truth_judges_information_as_it_is() -> None:
    """An edge that knows nothing of one direction says so: its error there costs nothing."""
    scenes = [scene("a", at(0)), scene("b", at(5))]
    nothing_along_x = INFORMATION.copy()
    nothing_along_x[3, 3] = 0.0
    edges = [replace(edge("a", "b", at(-9, y=0.02)), information=nothing_along_x)]
    assert evaluate_map(scenes, edges, None, overlaps(scenes)).nees[0].median == pytest.approx(4.0)


def test_a_report_says_how_exact_its_truth_is_taken_to_be() -> None:
    scenes = [scene("a", at(0)), scene("b", at(5))]
    edges = [replace(edge("a", "b", at(-5.1)), information=INFORMATION)]
    exact = evaluate_map(scenes, edges, None, overlaps(scenes))
    loose = evaluate_map(scenes, edges, None, overlaps(scenes), Params(truth_sigma_deg=0.5, truth_sigma_m=0.1))
    assert (loose.truth_sigma_deg, loose.truth_sigma_m) == (0.5, 0.1)
    assert loose.nees[0].median < 0.1 * exact.nees[0].median
    with raises(ConfigError, code="out_of_range", match="truth_sigma_m"):
        Params(truth_sigma_m=-1)


def sampled_poses(scale_sigma: float, count: int) -> EvaluationReport:
    """Stars of scenes around an anchor that a soft prior holds, drawn from the covariances that they are given."""
    rng = np.random.default_rng(0)
    gauge = np.diag(np.array([1e-4] * 3 + [1e-3] * 3 + [1e-4 if scale_sigma else 0.0]) ** 2)
    own = np.diag(np.r_[[0.002] * 3, [0.01] * 3, scale_sigma] ** 2)
    anchor = at(4, turn=0.3)
    scenes, placed, covariances = [], [("a", anchor, 0, "placed")], {"a": gauge}
    scenes.append(scene("a", at(0)))
    for k in range(count):
        name, truth = f"s{k}", Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 10)
        scenes.append(scene(name, truth))
        relative = truth.inverse() @ exp(rng.normal(size=(1, 7)) * -np.sqrt(np.diag(own))).item(0)
        carry = Similarities.stack([relative.inverse()]).adjoint()[0]
        placed.append((name, anchor @ relative, 0, "placed"))
        covariances[name] = own + carry @ gauge @ carry.T
    return evaluate_map(scenes, [], graph(*placed, covariances=covariances), overlaps(scenes))


@pytest.mark.parametrize(("scale_sigma", "dof"), [(0.0, 6), (0.003, 7)])
def test_honest_covariances_of_poses_are_found_honest(scale_sigma: float, dof: int) -> None:
    (row,) = sampled_poses(scale_sigma, count=60).nees
    assert (row.of, row.dof, row.num) == ("poses", dof, 60)
    assert row.expected_median == pytest.approx(chi2.ppf(0.5, dof))
    assert row.median == pytest.approx(row.expected_median, rel=0.2)
    assert row.within_3_sigma > 0.98


def test_poses_whose_frame_priors_hold_are_not_judged() -> None:
    scenes = [scene("a", at(0)), scene("b", at(5))]
    rng = np.random.default_rng(0)
    root = rng.normal(size=(7, 7)) * 0.01
    covariances = {"a": root @ root.T + np.eye(7) * 1e-6, "b": np.eye(7)}
    poses = graph(("a", at(0), 0, "placed"), ("b", at(-5), 0, "placed"), covariances=covariances)
    report = evaluate_map(scenes, [], poses, overlaps(scenes))
    assert report.nees == ()
    assert "priors fix its frame" in report.notes[-1]
    assert relative_covariance(at(1), covariances["b"], covariances["a"]) is None


def test_nees_of_a_rigid_pose_that_is_of_another_scale_counts() -> None:
    covariance = np.diag(np.r_[SIGMAS[:6], 0.0] ** 2)
    assert nees_of_pose(at(1), covariance, at(1, scale=1.01)).dof == 7
    assert nees_of_pose(at(1), covariance, at(1, scale=1.01)).value > 1e7
    assert nees_of_pose(at(1.01), covariance, at(1)).value == pytest.approx(1.0)


def test_nees_rows_keep_degrees_of_freedom_apart() -> None:
    found = [nees_of_edge(at(3 + k / 100), INFORMATION, at(3, scale=s)) for k in range(3) for s in (1.0, 1.0001)]
    six, seven = nees_rows("edges", found)
    assert (six.dof, six.num, seven.dof, seven.num) == (6, 3, 7, 3)
    assert six.median == pytest.approx(1.0)
    assert six.within_3_sigma == 1.0
    far = nees_of_edge(at(3.1), INFORMATION, at(3))
    assert nees_rows("edges", [*found, far])[0].within_3_sigma == 0.75
