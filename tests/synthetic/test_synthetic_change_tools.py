"""tools/make/change.py and its scores: what is written is read back, truth scores full marks, and errors cost them."""

import json
import sys

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap.geometry.transforms import transform_gaussians
from gsmap.ingest import read_captures
from gsmap.types import Gaussians, Sim3
from tools.bench import change as bench_change
from tools.bench import change_scores as scores
from tools.make import change as make_change

TINY = ["--steps", "0", "--frames", "16", "--gaussians", "6000", "--size", "96", "--texel", "0.05"]


TRAINED_ON = []


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out, fit = tmp_path_factory.mktemp("change"), make_change.fit_frames
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(make_change, "fit_frames", lambda f, **o: (TRAINED_ON.append(f.cameras.names), fit(f, **o))[1])
        patch.setattr(sys, "argv", ["make_change.py", str(out), "--seed", "3", "--exposure", *TINY])
        assert make_change.main() == 0
    return out


@pytest.fixture(scope="module")
def truth(folder):
    return scores.Truth(folder)


@pytest.fixture(scope="module")
def voxels(truth):
    return scores.changed_voxels(truth, "t0", "t1")


@pytest.fixture(scope="module")
def claims(voxels):
    return [
        scores.Claim(c["kind"], v, np.array(c["S_after_before"]) if "S_after_before" in c else None, c["symmetry"])
        for c, v in voxels
        if len(v)
    ]


def test_captures_are_read_as_any_others_and_are_a_year_apart(folder, truth):
    captures = read_captures([folder])
    assert [c.name for c in captures] == truth.times == ["t0", "t1"]
    assert [c.captured_at[:4] for c in captures] == ["2022", "2023"]
    assert all(len(c.cameras) == 16 for c in captures)
    for time, names in zip(truth.times, TRAINED_ON, strict=True):
        assert truth.held_out(time).tolist() == [i % 6 == 3 for i in range(16)]
        assert set(names) == set(np.array(truth.cameras(time).names)[~truth.held_out(time)])
    poses = [truth.T_place_scene(t).rotation for t in truth.times]
    assert np.abs(poses[0] - poses[1]).max() > 0.1


def test_photographs_and_depths_fit_the_gaussians(truth):
    for time in truth.times:
        shown = scores.pictures(truth.gaussians(time), truth.cameras(time))
        photographs, everywhere = truth.photographs(time), np.zeros(shown.shape[:3], int)
        own, others = (scores.psnr_by_kind(shown, p, everywhere)["all"] for p in (photographs, photographs[::-1]))
        assert own > others + 3
        means = truth.gaussians(time).means
        assert (scores.owners(truth, time, means) >= 0).mean() > 0.9
        assert scores.observed(truth, time, means).mean() > 0.95


def test_all_pairs_of_times_have_their_changes(folder, truth):
    written = json.loads((folder / "truth" / "changes.json").read_text())
    assert list(written["pairs"]) == ["t0:t1"]
    assert [c["kind"] for c in written["pairs"]["t0:t1"]] == [c["kind"] for c in truth.changes("t0", "t1")]
    assert len(truth.changes("t0", "t1")) == 9
    assert truth.changes("t0", "t0") == []


def test_voxels_of_changes_lie_on_their_things_and_were_seen_by_both(truth, voxels):
    assert sum(len(v) >= 5 for _, v in voxels) >= 6
    for change, v in voxels:
        boxes = [np.array(b) for k in ("box_before_m", "box_after_m") if (b := change[k]) is not None]
        inside = [((v > low - 0.06) & (v < high + 0.06)).all(1) for low, high in boxes]
        assert np.any(inside, axis=0).all()


def test_what_lies_behind_walls_is_not_observed(truth):
    y, z = np.meshgrid(np.linspace(0.5, 5, 12), np.linspace(0.3, 2.2, 6))
    outside = np.stack([np.full(y.size, -0.5), y.ravel(), z.ravel()], axis=1)
    assert not scores.observed(truth, "t0", outside).any()
    assert not scores.looked_through(truth, "t0", outside).any()
    centres = truth.cameras("t0").centers
    ahead = centres + 0.3 * truth.cameras("t0").T_frame_camera[:, :3, 2]
    assert scores.observed(truth, "t0", ahead).mean() > 0.9
    assert scores.looked_through(truth, "t0", ahead).mean() > 0.8


def test_the_truth_scores_full_marks(truth, claims):
    got = scores.score_changes(truth, "t0", "t1", claims)
    assert got["found"] == got["objects"] == got["kind_right"] >= 6
    assert (got["right"], got["false"]) == (got["claims"], 0)
    assert got["iou"] == 1.0
    assert got["moved_right"] == got["moved_true"]
    assert got["moved_symmetric_said"] == got["moved_symmetric"]
    assert got["moved_wrong"] == 0


def test_nothing_claimed_and_light_claimed_find_nothing(truth, claims):
    for nothing in ([], [scores.Claim("lighting", claims[0].voxels_m)]):
        got = scores.score_changes(truth, "t0", "t1", nothing)
        assert (got["found"], got["claims"], got["iou"]) == (0, 0, 0.0)


def test_a_claim_where_nothing_changed_is_false(truth, claims):
    elsewhere = scores.Claim("appeared", np.array([[0.0, 0, 9], [0.1, 0, 9]]))
    got = scores.score_changes(truth, "t0", "t1", [*claims, elsewhere])
    assert (got["false"], got["found"]) == (1, got["objects"])
    assert got["precision"] < 1


def test_a_wrong_kind_is_found_but_not_named_rightly(truth, claims):
    got = scores.score_changes(truth, "t0", "t1", [scores.Claim("appeared", c.voxels_m) for c in claims])
    assert got["found"] == got["objects"]
    assert got["kind_right"] == sum(row["kind"] == "appeared" for row in got["rows"]) < got["objects"]


def test_a_third_of_a_thing_must_be_covered(truth, voxels):
    change, v = max(voxels, key=lambda one: len(one[1]))
    along = np.argsort(v @ [1.0, 0.3, 0.1])
    few, many = (scores.Claim(change["kind"], v[along[: int(share * len(v))]]) for share in (0.1, 0.5))
    found = [
        next(r["found"] for r in scores.score_changes(truth, "t0", "t1", [c])["rows"] if r["voxels"] == len(v))
        for c in (few, many)
    ]
    assert found == [False, True]


@pytest.mark.parametrize(("shift_m", "turn_deg", "right"), [(0.05, 5, True), (0.2, 0, False), (0.0, 15, False)])
def test_a_move_is_right_within_10_cm_and_10_degrees(truth, voxels, shift_m, turn_deg, right):
    change = {**next(c for c, _ in voxels if c["kind"] == "moved"), "symmetry": "none"}
    S, middle = np.array(change["S_after_before"]), np.array(change["middle_m"])
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    turn = np.eye(4)
    turn[:2, :2] = [[c, -s], [s, c]]
    arrived = S @ np.append(middle, 1)
    turn[:3, 3] = arrived[:3] - turn[:3, :3] @ arrived[:3] + [shift_m, 0, 0]
    metres, degrees = scores.move_error(change, turn @ S)
    assert (metres, degrees) == (pytest.approx(shift_m, abs=1e-9), pytest.approx(turn_deg, abs=1e-5))
    assert (metres <= 0.1 and degrees <= 10) is right


def test_symmetric_things_may_be_turned(voxels):
    change = next(c for c, _ in voxels if c["kind"] == "moved")
    S, middle = np.array(change["S_after_before"]), np.append(change["middle_m"], 1.0)
    for turn_deg, allowed in ((180, {"half", "any"}), (70, {"any"})):
        c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
        turn = np.eye(4)
        turn[:2, :2] = [[c, -s], [s, c]]
        turn[:3, 3] = (S @ middle - turn @ S @ middle)[:3]
        for symmetry in ("none", "half", "any"):
            metres, degrees = scores.move_error({**change, "symmetry": symmetry}, turn @ S)
            assert metres < 1e-9
            assert (degrees < 1e-4) is (symmetry in allowed)


def test_claims_of_another_frame_are_brought_to_the_place(truth, claims):
    S_place_scene = truth.T_place_scene("t1")
    back, S = S_place_scene.inverse(), S_place_scene.matrix()
    rows = [
        {
            "kind": c.kind,
            "voxels_m": back.apply(c.voxels_m),
            "S_after_before": None if c.S_after_before is None else np.linalg.inv(S) @ c.S_after_before @ S,
        }
        for c in claims
    ]
    for read, claim in zip(scores.read_claims(rows, S_place_scene), claims, strict=True):
        np.testing.assert_allclose(read.voxels_m, claim.voxels_m, atol=1e-9)
        if claim.S_after_before is not None:
            np.testing.assert_allclose(read.S_after_before, claim.S_after_before, atol=1e-9)


def test_masks_tell_the_newest_from_the_union_of_all(truth):
    newest, both = truth.gaussians("t1"), Gaussians.concatenate([truth.gaussians("t0"), truth.gaussians("t1")])
    alone = scores.score_merge(truth, "t1", ["t0"], newest)
    union = scores.score_merge(truth, "t1", ["t0"], both)
    assert alone["old_mix_new"] == (0.0, 0.0, 1.0)
    assert union["old_mix_new"][2] < 0.8
    assert union["psnr"]["vacated"] < alone["psnr"]["vacated"] - 0.5
    moved = Sim3(np.eye(3), np.array([1.0, 2, 3]), 1.0)
    again = scores.score_merge(truth, "t1", ["t0"], transform_gaussians(newest, moved), moved.inverse())
    assert again["psnr"]["all"] == pytest.approx(alone["psnr"]["all"], abs=0.05)


def test_psnr_is_of_the_pixels_of_a_kind():
    kinds = np.array([[[0, 1, 2, 3]]])
    shown = np.array([0.1, 0.01, 0.1, 1.0])[None, None, :, None] * np.ones(3)
    got = scores.psnr_by_kind(shown, np.zeros((1, 1, 4, 3)), kinds)
    assert [got[k] for k in ("same", "new", "recoloured", "vacated")] == pytest.approx([20, 40, 20, 0])
    assert got["changed"] == pytest.approx(-10 * np.log10((1e-4 + 1e-2 + 1) / 3))
    assert np.isnan(scores.psnr_by_kind(shown, shown, np.zeros((1, 1, 4), int))["new"])


def test_old_mix_and_new_are_told_by_colour():
    old, new, kinds = np.zeros((1, 1, 4, 3)), np.ones((1, 1, 4, 3)), np.array([[[1, 2, 3, 0]]])
    merged = np.array([0.1, 0.5, 0.9, 0.0])[None, None, :, None] * np.ones(3)
    assert scores.old_mix_new(merged, old, new, kinds) == pytest.approx((1 / 3, 1 / 3, 1 / 3))


def test_dropping_what_went_is_right_and_dropping_all_is_not(truth):
    means = truth.gaussians("t0").means
    gone = [c["before"] for c in truth.changes("t0", "t1") if c["kind"] in ("disappeared", "moved", "replaced")]
    right = scores.score_drops(truth, "t1", "t0", np.isin(scores.owners(truth, "t0", means), gone))
    assert (right["gone"], right["false"], right["painted"]) == (1.0, 0.0, 0.0)
    assert right["n_gone"] > 50
    assert right["n_false"] > 1000
    everything = scores.score_drops(truth, "t1", "t0", np.ones(len(means), bool))
    assert everything["gone"] == everything["painted"] == everything["false"] == 1.0


def test_ghosts_stand_where_things_went_and_the_newest_has_none(truth):
    old, new = truth.gaussians("t0").means, truth.gaussians("t1").means
    assert scores.score_ghosts(truth, "t1", "t0", new)["left"] == 0
    both = scores.score_ghosts(truth, "t1", "t0", np.concatenate([old, new]))
    assert both["left"] == 1
    assert both["n"] > 20


def test_rows_that_are_still_there_are_told(truth):
    means = truth.gaussians("t0").means
    np.testing.assert_array_equal(scores.kept_rows(means[:9], means[::2]), [True, False] * 4 + [True])


def test_what_merging_drops_is_measured_under_given_poses(folder, tmp_path):
    (row,) = bench_change.drops(bench_change.Place(folder, None, tmp_path, true_poses=True))
    assert row["way"] == "drops of t0"
    assert row["gone"] > row["false"]
    assert row["n_gone"] > 50
    assert not list(tmp_path.iterdir())


def test_losses_are_the_worst_of_all_places():
    def row(place, way, changed, held_same, old):
        psnr = dict.fromkeys(("changed", "new", "recoloured", "vacated"), changed)
        held = {"same": held_same}
        return {
            "part": "merge",
            "place": place,
            "way": way,
            "psnr": psnr,
            "held": held,
            "old_mix_new": (old, 0, 1 - old),
        }

    rows = [row("a", "alone", 30, 24, 0), row("a", "dated", 20, 25, 0.3), row("a", "newest", 29.5, 24.9, 0.01)]
    rows += [row("b", "alone", 28, 24, 0), row("b", "dated", 20, 26, 0.2), row("b", "newest", 28.5, 26.1, 0.02)]
    lines = {line.split()[0]: line for line in bench_change.losses(rows)}
    assert "changed +0.50 dB below alone" in lines["newest"]
    assert "held same -0.10 dB against dated" in lines["newest"]
    assert lines["newest"].endswith("old or mix 0.020")
    assert "changed +10.00 dB below alone" in lines["dated"]


def test_the_sets_never_share_a_place_and_say_what_is_false():
    seeds = [seed for places in make_change.SETS.values() for seed in places]
    assert len(seeds) == len(set(seeds))
    false = make_change.SETS["false"].values()
    assert sum(len(visits) - 1 for visits in false) == 10
    assert {visit.edits for visits in false for visit in visits} == {"none"}
    assert all(
        {"t0", "t1"} <= {v.name for v in visits} for s in ("dev", "test") for visits in make_change.SETS[s].values()
    )


@pytest.mark.parametrize(
    ("edits", "asked"),
    [("default", {}), ("share:0.3", {"share": 0.3}), ("moved:3,small:1", {"counts": {"moved": 3, "small": 1}})],
)
def test_edits_are_asked_for_in_words(edits, asked):
    assert make_change.asked(edits) == asked
    with pytest.raises(ConfigError, match="KIND:N"):
        make_change.asked("lots")
