"""What is not done twice or in vain: renders that hardly moved, places that were found, places that look otherwise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap import _native
from gsmap.geometry.projection import project
from gsmap.localize import candidate_renders, localization, refinement
from gsmap.localize.candidates import PoseCandidate
from gsmap.localize.map_scene import MapScene
from gsmap.localize.resection import relative_xi, retract_pose

ALIASED_PRIOR = 0.1


@pytest.fixture(scope="module")
def judged(world):
    """A photograph's picture, its true pose (metres), and what is found from nearly there."""
    picture, _ = localization.scale_photo(world.photos[1], 480)
    start = retract_pose(world.poses[1], np.array([0.01, -0.01, 0.0, 0.03, 0.0, -0.02]))
    candidate = PoseCandidate(0, start, picture.intrinsics_px, 40, ("scene",))
    return picture, localization.evaluate_pose(picture, candidate, {"scene": world.placed}, ALIASED_PRIOR)


def test_a_render_is_made_again_once_it_has_moved(world, judged):
    picture, found = judged
    pose, lens, size = found.refined.T_metric_camera, picture.intrinsics_px, picture.size_px
    (one,) = candidate_renders.render_scenes([world.placed], pose, lens, size)
    assert one.motion_px(pose, lens) < 0.01
    turned = retract_pose(pose, np.array([0.0, 2 / lens[0], 0, 0, 0, 0]))  # two pixels to the side
    assert one.motion_px(turned, lens) == pytest.approx(2, rel=0.5)
    (same,) = candidate_renders.render_scenes([world.placed], turned, lens, size, [one], 4.0)
    (other,) = candidate_renders.render_scenes([world.placed], turned, lens, size, [one], 1.0)
    assert same is one
    assert other is not one
    assert np.array_equal(other.T_metric_camera, turned)


def test_a_look_knows_where_its_pixels_lie(world, judged):
    picture, found = judged
    (one,) = candidate_renders.render_scenes(
        [world.placed], found.refined.T_metric_camera, picture.intrinsics_px, picture.size_px
    )
    row, column = np.nonzero(one.smooth[::40, ::40])
    pixels = np.stack([column, row], axis=1) * 40 + 0.5
    at, depth = project(one.points(pixels), np.linalg.inv(one.T_metric_camera), one.intrinsics_px)
    assert len(pixels) > 20
    assert np.allclose(at, pixels, atol=1e-6)
    assert np.allclose(depth, one.depth_m[row * 40, column * 40], rtol=1e-5)


def test_where_the_map_shows_something_else_nothing_is_looked_into_further(world, judged, monkeypatch):
    picture, found = judged
    assert found.probability > 0.9
    away = world.poses[1].copy()
    away[:3, :3] = away[:3, :3] @ np.diag([-1.0, 1.0, -1.0])  # it looks the other way
    sizes = []
    render = refinement.render_scenes
    monkeypatch.setattr(refinement, "render_scenes", lambda *a, **k: (sizes.append(a[3]), render(*a, **k))[1])
    wrong = PoseCandidate(0, away, picture.intrinsics_px, 8, ("scene",))
    one = localization.evaluate_pose(picture, wrong, {"scene": world.placed}, ALIASED_PRIOR)
    assert one.covariance is None
    assert one.probability < 0.05
    assert picture.size_px not in sizes  # never rendered in full


def test_matches_of_a_place_that_was_found_are_not_looked_into_again(judged):
    picture, found = judged
    settled = found.refined
    pixels, _ = project(settled.points, np.linalg.inv(settled.T_metric_camera), settled.intrinsics_px)
    rough = PoseCandidate(
        0, retract_pose(settled.T_metric_camera, np.full(6, 0.5)), picture.intrinsics_px, 20, ("scene",)
    )
    same = replace(rough, pixels=pixels, points=settled.points)
    other = replace(rough, pixels=pixels, points=settled.points + np.array([3.0, 0, 0]))
    near = replace(other, T_metric_camera=retract_pose(settled.T_metric_camera, np.full(6, 0.05)))
    assert localization._agrees_with(same, found, picture)
    assert not localization._agrees_with(other, found, picture)
    assert localization._agrees_with(near, found, picture)  # it would be refined to the same pose
    assert not localization._agrees_with(replace(same, component=1), found, picture)
    assert not localization._agrees_with(same, replace(found, probability=0.4), picture)


def test_what_is_hopeless_is_not_asked_what_it_shows_otherwise(world, judged, monkeypatch):
    picture, found = judged
    asked = localization.evaluate_pose(picture, found.candidate, {"scene": world.placed}, ALIASED_PRIOR)
    monkeypatch.setattr(localization, "MIN_COMPARED_PROBABILITY", 1.0)
    spared = localization.evaluate_pose(picture, found.candidate, {"scene": world.placed}, ALIASED_PRIOR)
    assert np.isfinite(asked.evidence["unlike_part"])
    assert np.isnan(spared.evidence["unlike_part"])
    assert np.array_equal(asked.refined.T_metric_camera, spared.refined.T_metric_camera)


@pytest.mark.parametrize(("first", "second", "kept"), [(0.6, 0.7, "first"), (0.3, 0.4, "second"), (0.3, 0.2, "first")])
def test_a_refinement_that_agrees_little_is_repeated(judged, monkeypatch, first, second, kept):
    picture, found = judged
    told = iter([replace(found.refined, agreement=one) for one in (first, second)])
    starts = []

    def settled(picture, pose, *rest):
        starts.append(pose)
        return next(told)

    monkeypatch.setattr(refinement, "_refine_once", settled)
    rough = retract_pose(found.refined.T_metric_camera, np.full(6, 0.1))
    answer = refinement.refine_pose(picture, rough, picture.intrinsics_px, ())
    assert answer.agreement == {"first": first, "second": second}[kept]
    repeated = first < refinement.REPEAT_BELOW_AGREEMENT
    assert len(starts) == 1 + repeated
    assert np.array_equal(starts[-1], found.refined.T_metric_camera if repeated else rough)


def test_a_repeat_uses_renders_that_hardly_moved(world, judged, monkeypatch):
    picture, found = judged
    counts = []
    run = MapScene.render
    monkeypatch.setattr(MapScene, "render", lambda *args, **options: (counts.append(1), run(*args, **options))[1])
    start = picture, found.refined.T_metric_camera, picture.intrinsics_px, [world.placed]
    anew = refinement._refine_once(*start)
    num_anew = len(counts)
    reused = refinement._refine_once(*start, anew.renders)
    assert len(counts) - num_anew < num_anew
    xi = relative_xi(anew.T_metric_camera, reused.T_metric_camera)
    assert np.sqrt(xi @ np.linalg.solve(anew.covariance, xi) / 6) < 0.3


def test_how_well_a_render_agrees_that_is_laid_over_is_evidence(world, judged):
    """Of the last time, before it moved: high where the pose is right, low where it is not."""
    picture, found = judged
    assert found.evidence["laid"] == found.refined.agreement > 0.4
    start = retract_pose(found.refined.T_metric_camera, np.array([0.0, np.radians(25), 0, 0, 0, 0]))
    wrong = PoseCandidate(0, start, picture.intrinsics_px, 8, ("scene",))
    other = localization.evaluate_pose(picture, wrong, {"scene": world.placed}, ALIASED_PRIOR)
    assert other.evidence["laid"] < 0.2


@pytest.mark.usefixtures("instruction_set")
def test_signatures_that_differ_in_few_signs_are_found_in_order():
    rng = np.random.default_rng(0)
    theirs = rng.integers(0, 2**63, 300, dtype=np.uint64)
    mine = theirs[rng.integers(0, 300, 40)] ^ rng.integers(0, 2**9, 40, dtype=np.uint64)
    begin = rng.integers(0, 50, 40)
    end = begin + rng.integers(100, 250, 40)
    told = np.array(_native.near_signatures(mine, begin, end, theirs, 6))
    want = [
        (k, i, differ)
        for k in range(40)
        for i in range(begin[k], end[k])
        if (differ := int(np.bitwise_count(mine[k] ^ theirs[i]))) <= 6
    ]
    assert len(want) > 5
    assert told.T.tolist() == [list(one) for one in want]
