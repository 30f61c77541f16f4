"""Groups of observations with common errors, beside truth; `tools/bench/survey_groups.py` runs them on many sites."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.errors import CorruptError
from gsmap.optimize import optimize
from gsmap.optimize.survey_common_points import CommonPoints
from gsmap.optimize.survey_shifts import CommonShift, likely_causes
from gsmap.store.world_ties import world_tie_to_json, world_ties_of_json
from gsmap.types import Sim3
from gsmap.types.world import CAUSES, Contradiction, Georeference, Survey, WorldFrame
from gsmap_synthetic.surveyed import SiteParams, surveyed_site
from tools.bench import survey_groups as bench

HILL = WorldFrame("EPSG:25832", 48.137, 11.575, 520.0)


def made(seed: int, wide_m: float = 60.0, side: int = 2, height_m: float = 520.0) -> bench.Made:
    params = SiteParams(
        rows=side, columns=side, spacing_m=wide_m / (side - 1), cross_every=1, num_control=4, num_check=0
    )
    frame = replace(HILL, height_m=height_m)
    return bench.Made(surveyed_site(seed, params, frame), np.random.default_rng(seed))


def higher(at: np.ndarray) -> np.ndarray:
    return at + np.array([0, 0, 45.0])


def solved(m: bench.Made, *surveys: Survey) -> tuple[Georeference, float]:
    tie, off, _ = bench.solved(m.site, bench.both(*surveys))
    return tie, off


def uses(tie: Georeference, kind: str) -> set[str]:
    return {row.use for row in tie.residuals if row.kind == kind}


@pytest.mark.parametrize("wide_m", [8.0, 80.0])
@pytest.mark.parametrize("drop_m", [0.0, 517.0])
def test_photos_do_not_outvote_control_points(wide_m: float, drop_m: float) -> None:
    m = made(0, wide_m)
    alone, off_alone = solved(m, m.points())
    m = made(0, wide_m)
    tie, off = solved(m, m.points(), m.photos(bench.PHONE, lambda at: at - np.array([0, 0, drop_m]), noise=0.0))
    assert alone.S_world_map is not None
    assert tie.S_world_map is not None
    assert off < 0.03
    assert off == pytest.approx(off_alone, abs=0.01)
    assert uses(tie, "point") == {"used"}
    assert uses(tie, "fix") == ({"outlier"} if drop_m else {"used"})
    if drop_m:
        (one,) = tie.contradictions
        assert (one.group, one.against, one.cause, one.kept) == ("photos", "points", "above_takeoff", "against")
        assert one.offset_m == pytest.approx((0, 0, -drop_m), abs=0.1)
        assert one.count == 32
        assert set(one.scenes) == set(m.site.names)
        assert {row.reason for row in tie.residuals if row.kind == "fix"} == {one.text}
    else:
        assert tie.contradictions == ()


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("points + phones at altitude 0", 27),
        ("points + RTK of another height system", 21),
        ("points + RTK in feet", 22),
        ("RTK + points in feet", 23),
        ("points + RTK of another flight", 24),
        ("points + RTK of another datum", 25),
        ("points + bars in feet", 26),
        ("scenes + phones above take-off", 28),
        ("RTK + one capture of another height system", 29),
        ("half of RTK + half of another height system", 30),
        ("half of scenes + half elsewhere", 31),
    ],
)
def test_contradictions_are_named_and_no_tie_is_wrong_or_lost(name: str, seed: int) -> None:
    tally = bench.Tally()
    bench.run(name, bench.MIXTURES[name], seed, tally)
    assert (tally.count, tally.hidden) == (1, 0)
    assert (tally.wrong, tally.lost, tally.named) == (0, 0, 1)


@pytest.mark.parametrize("name", ["points + RTK", "phones + points", "points + bars", "three points + phones"])
def test_observations_that_agree_add_up(name: str) -> None:
    tally = bench.Tally()
    bench.run(name, bench.MIXTURES[name], 3, tally)
    assert (tally.tied, tally.wrong, tally.lost, tally.unsaid) == (1, 0, 0, 0)


def test_two_equal_groups_are_not_tied() -> None:
    m = made(5, side=2)
    tie, _ = solved(m, m.photos(bench.RTK, captures=[0, 1]), m.photos(bench.RTK, higher, captures=[2, 3]))
    assert tie.S_world_map is None
    assert tie.problem_code == "contradiction"
    (one,) = tie.contradictions
    assert (one.group, one.against, one.cause, one.kept) == ("photos", "photos", "split", "none")
    assert "height_system" in one.other_causes
    assert abs(one.offset_m[2]) == pytest.approx(45, abs=0.5)


def test_equally_precise_sources_are_not_tied_and_a_third_decides() -> None:
    m = made(6, side=2)
    points, scenes = m.points(), m.scenes(0.01, (0, 0, 45))
    tie, _ = solved(m, points, scenes)
    assert tie.S_world_map is None
    assert tie.problem_code == "contradiction"
    decided, off = solved(m, points, scenes, m.photos(bench.RTK))
    assert decided.S_world_map is not None
    assert off < 0.05
    assert [(one.group, one.kept) for one in decided.contradictions] == [("scenes", "against")]


@pytest.mark.parametrize("wide_m", [60.0, 300.0])
def test_two_points_show_photos_that_have_the_mark_of_take_off(wide_m: float) -> None:
    """On the wide site photos alone tie the map, on the small one they do not."""
    m = made(11, wide_m)
    tie, _ = solved(m, m.photos(bench.PHONE, m.takeoff), m.points(keep=2))
    assert tie.S_world_map is None
    assert tie.problem_code == "contradiction"
    (one,) = tie.contradictions
    assert (one.group, one.against, one.cause) == ("photos", "points", "above_takeoff")
    assert one.offset_m[2] == pytest.approx(-520, abs=40)


def test_points_with_the_mark_of_feet_do_not_untie_photos() -> None:
    m = made(11, 300.0)
    tie, off = solved(m, m.photos(bench.PHONE), m.points(m.feet, keep=2))
    assert off < 150
    (one,) = tie.contradictions
    assert (one.group, one.against, one.cause, one.kept) == ("points", "photos", "feet", "against")


def test_photos_without_altitude_do_not_tie_a_map() -> None:
    m = made(7)
    tie, _ = solved(m, m.photos(bench.PHONE, m.zero))
    assert tie.S_world_map is None
    assert tie.problem_code == "contradiction"
    assert [one.cause for one in tie.contradictions] == ["altitude_zero"]


def test_missing_observations_have_their_own_code() -> None:
    m = made(8)
    tie, _ = solved(m, m.points(keep=2))
    assert (tie.problem_code, tie.contradictions) == ("undetermined", ())


def test_a_capture_counts_once_however_many_photos_it_has() -> None:
    """Two captures, one of which is 45 m too high, with one and with eight photos each."""
    m = made(9)
    low, high = m.photos(bench.RTK, captures=[0, 1, 2]), m.photos(bench.RTK, higher, captures=[3])
    few = replace(low, fixes=low.fixes[::8])
    tie, off = solved(m, few, high)
    assert tie.S_world_map is None or off < 0.2


def places(own_m: list[float], in_world: np.ndarray) -> CommonPoints:
    n = len(own_m)
    own = np.repeat(np.array(own_m)[:, None], 3, axis=1)
    rows = np.arange(n)
    kinds = np.array(["points"] * n)
    return CommonPoints(
        tuple(f"P{k}" for k in range(n)), in_world, in_world, own, np.zeros((n, 3)), np.zeros(n), kinds, rows, rows,
        rows,
    )  # fmt: skip


def test_a_capture_with_a_larger_common_error_than_stated_is_left_out() -> None:
    """60 cm, stated as 4 cm: too little to be gross, enough to bend the map by more than its sigma."""
    m = made(7, side=3)
    last = m.site.names[8]
    right, wrong = (
        m.photos(bench.RTK, captures=range(8)),
        m.photos(bench.RTK, lambda at: at + np.array([0, 0, 0.6]), [8]),
    )
    tie, off = solved(m, right, wrong)
    assert off < 0.05
    assert {row.use for row in tie.residuals if row.scene == last} == {"outlier"}
    assert {row.use for row in tie.residuals if row.scene != last} == {"used"}
    (one,) = tie.contradictions
    assert (one.group, one.against, one.kept, one.count, one.scenes) == ("photos", "photos", "against", 8, (last,))
    assert one.offset_m == pytest.approx((0, 0, 0.6), abs=0.15)


def test_poor_places_take_no_information_away() -> None:
    good = np.array([[0, 0, 0], [10, 0, 0], [0, 10, 0], [10, 10, 0.0]])
    rng = np.random.default_rng(0)
    poor = rng.uniform(0, 10, (40, 3))
    alone, S = places([0.01] * 4, good), Sim3.identity()
    together = places([0.01] * 4 + [50.0] * 40, np.concatenate([good, poor]))
    assert alone.missing(S) is None
    assert together.missing(S) is None
    (turns, scale), (more_turns, more_scale) = alone._sigmas(S), together._sigmas(S)
    assert (more_turns <= turns * (1 + 1e-6)).all()
    assert more_scale <= scale * (1 + 1e-6)
    # Independent truth: the squared distances of the corners to an axis through their middle add up to 100 m2.
    assert turns[-1] == pytest.approx(0.01 / 10, rel=1e-6)
    line = np.stack([np.linspace(0, 10, 5), np.zeros(5), np.zeros(5)], axis=1)
    assert "is not determined" in str(places([0.01] * 5, line).missing(S))


def test_an_error_that_all_points_share_hides_no_blunder() -> None:
    at = np.random.default_rng(1).uniform(-5, 5, (8, 3))
    blunder = places([0.01] * 8, at).moved(np.array([3]), np.array([0.0, 0.0, 2.0]))
    wide, sea = np.full((8, 3), 5.0), np.full(8, 40.0)
    one = np.zeros(8, dtype=np.int64)
    _, near = replace(blunder, common_m=wide, sea_m=sea, units=one).robust_fit()
    assert np.flatnonzero(~near).tolist() == [3]
    _, near = replace(blunder, common_m=wide, sea_m=sea).robust_fit()
    assert near.all(), "each has an error of 5 m of its own"
    _, near = replace(blunder, sea_m=np.where(np.arange(8) == 3, 40.0, 0.0)).robust_fit()
    assert near.all(), "the others are not measured from the sea"


@pytest.mark.parametrize(
    ("kind", "altitude_m", "shift_m", "ground_m", "causes"),
    [
        ("scenes", 520, (30, 0, 0), None, ("horizontal_shift",)),
        ("scenes", 520, (0.3, 0, 45), None, ("height_system",)),  # three standard deviations aside are none
        ("scenes", 520, (3, 0, 45), None, ("height_system", "horizontal_shift")),
        ("scenes", 520, (60, 0, 45), None, ("horizontal_shift", "height_system")),
        ("scenes", 520, (0, 0, 300), None, ("vertical_shift",)),
        ("scenes", 0, (0, 0, -520), None, ("altitude_zero",)),
        ("scenes", 520 / 0.3048, (0, 0, 520 / 0.3048 - 520), None, ("feet",)),
        ("photos", 60, (0, 0, -400), 405, ("above_takeoff",)),
        ("photos", 60, (0, 0, -400), None, ("above_takeoff",)),
        ("photos", 60, (0, 0, -120), 300, ("above_takeoff",)),  # more than heights above sea and ellipsoid differ
        ("photos", 60, (0, 0, -100), 300, ("height_system",)),
        ("photos", 400, (0, 0, -120), 300, ("vertical_shift",)),  # nobody flies 400 m above take-off
        ("photos", 400, (0, 0, -350), 300, ("vertical_shift",)),
        ("scenes", 60, (0, 0, -400), 405, ("vertical_shift",)),
    ],
)
def test_causes_of_shifts(
    kind: str, altitude_m: float, shift_m: tuple[float, ...], ground_m: float | None, causes: tuple[str, ...]
) -> None:
    at = np.array([[0, 0, -1.0], [10, 0, 0], [0, 10, 1]]) * (altitude_m != 0) + [0, 0, altitude_m - HILL.height_m]
    some = replace(places([0.1] * 3, at), kinds=np.array([kind] * 3))
    shift = CommonShift(np.array(shift_m, dtype=float), 0.01 * np.eye(3), -99.0, np.ones(3, dtype=bool))
    ground = None if ground_m is None else np.array([ground_m, ground_m + 5.0])
    assert likely_causes(some, shift, HILL, ground) == causes
    assert likely_causes(some, replace(shift, shaped=False), HILL, ground) == ("shape",)


def test_an_unsure_sea_level_is_no_other_height_system() -> None:
    """200 m are more than heights above sea and above the ellipsoid differ, however unsure the sea level is."""
    at = np.array([[0, 0, -1.0], [10, 0, 0], [0, 10, 1]])
    some = replace(places([0.1] * 3, at), kinds=np.array(["scenes"] * 3), sea_m=np.full(3, 40.0))
    covariance = np.diag([0.01, 0.01, 0.01 + 40.0**2])
    shift = CommonShift(np.array([0, 0, 200.0]), covariance, -99.0, np.ones(3, dtype=bool))
    assert likely_causes(some, shift, HILL, None) == ("vertical_shift",)


def test_contradictions_are_kept_with_the_tie() -> None:
    one = Contradiction(
        "photos",
        "points",
        "feet",
        ("height_system",),
        "against",
        (0.0, 1.0, 2.0),
        (1.0, 1.0, 2.0),
        None,
        3,
        ("a",),
        "t",
    )
    bars = Contradiction("bars", "points", "feet", (), "against", ratio=3.28, count=2)
    tie = Georeference(0, problem="x", problem_code="contradiction", contradictions=(one, bars))
    value = world_tie_to_json(tie)
    (again,) = world_ties_of_json([value])
    assert again.contradictions == (one, bars)
    assert again.problem_code == "contradiction"
    old = {k: v for k, v in value.items() if k not in ("problem_code", "contradictions")}
    assert world_ties_of_json([old])[0].problem_code == "undetermined"
    assert set(CAUSES) >= {one.cause}
    with pytest.raises(CorruptError):
        world_ties_of_json([value | {"contradictions": [{**value["contradictions"][0], "cause": "nobody"}]}])


def test_a_map_of_equal_captures_gives_the_same_answer_in_any_order() -> None:
    m = made(10)
    survey = bench.both(m.points(), m.photos(bench.RTK))
    turned = replace(survey, fixes=survey.fixes[::-1], points=survey.points[::-1], images=survey.images[::-1])
    one, other = (optimize(m.site.names, m.site.edges, survey=s).world[0].S_world_map for s in (survey, turned))
    assert one is not None
    assert other is not None
    assert np.abs(one.matrix() - other.matrix()).max() < 1e-6
