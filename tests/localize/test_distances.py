"""Photographs of places whose content is farther away than in a room are judged as photographs of rooms are."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gsmap.localize import localization, mismatch
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.candidates import PoseCandidate, is_duplicate
from gsmap.localize.distances import ROOM_M, relative_distance
from gsmap.localize.resection import retract_pose
from gsmap.types import Sim3

ALIASED_PRIOR = 0.1
TIMES = 12.0  # the place made so much larger


def candidate_at(pose: np.ndarray, distance_m: float, lens: np.ndarray, scenes: tuple[str, ...]) -> PoseCandidate:
    """A candidate whose matches lie at a distance before the camera."""
    points = pose[:3, 3] + distance_m * pose[:3, 2] + np.zeros((20, 3))
    return PoseCandidate(0, pose, lens, 20, scenes, np.zeros((20, 2)), points)


@pytest.fixture(scope="module")
def enlarged(world):
    """The capture of the place, in a map in which everything is larger."""
    return replace(world.placed, S_metric_scene=Sim3(np.eye(3), np.zeros(3), TIMES) @ world.placed.S_metric_scene)


def test_lengths_are_scaled_beyond_the_distances_of_a_room() -> None:
    assert relative_distance(np.array([0.0, 0.5 * ROOM_M, ROOM_M])) == 1
    assert relative_distance(np.array([0.0, 3 * ROOM_M, 4 * ROOM_M, 50 * ROOM_M])) == 4
    assert relative_distance(np.zeros(3)) == 1


def test_a_photo_of_a_place_that_is_larger_is_placed_as_surely(world, enlarged) -> None:
    picture, _ = localization.scale_photo(world.photos[1], 480)
    pose = world.poses[1].copy()
    pose[:3, 3] *= TIMES
    start = retract_pose(pose, np.r_[0.01, -0.01, 0.0, TIMES * np.array([0.03, 0.0, -0.02])])
    candidate = candidate_at(start, 2.5 * TIMES, picture.intrinsics_px, ("scene",))
    found = localization.evaluate_pose(picture, candidate, {"scene": enlarged}, ALIASED_PRIOR)
    assert np.linalg.norm(found.refined.T_metric_camera[:3, 3] - pose[:3, 3]) < 0.03 * TIMES
    assert found.probability > 0.95


def test_renders_of_content_farther_away_show_the_same(world) -> None:
    picture, _ = localization.scale_photo(world.photos[0], 480)
    (here,) = render_scenes([world.placed], world.poses[0], picture.intrinsics_px, picture.size_px)
    near, far, farther = (
        mismatch.mismatch_map(picture.rgb, [replace(here, depth_m=times * here.depth_m)]).mean_outside()
        for times in (1, 8, 16)
    )
    assert far == pytest.approx(farther, abs=1e-4)
    assert far < near + 0.02


@pytest.mark.parametrize(("distance_m", "same"), [(2.0, False), (20.0, True)])
def test_poses_a_metre_apart_are_one_place_where_content_is_far_away(distance_m: float, same: bool) -> None:
    one = candidate_at(np.eye(4), distance_m, np.array([400.0, 400, 240, 180]), ("scene",))
    moved = np.eye(4)
    moved[0, 3] = 1.0
    other = candidate_at(moved, distance_m, one.intrinsics_px, one.scenes)
    assert is_duplicate(one, other) == same


@pytest.mark.parametrize(("times", "rival"), [(1.0, True), (TIMES, False)])
def test_a_pose_a_metre_apart_is_no_rival_where_content_is_far_away(world, enlarged, times: float, rival: bool) -> None:
    picture, _ = localization.scale_photo(world.photos[1], 480)
    pose = world.poses[1].copy()
    pose[:3, 3] *= times
    scene = world.placed if times == 1 else enlarged
    found = localization.evaluate_pose(
        picture, candidate_at(pose, 2.5 * times, picture.intrinsics_px, ("scene",)), {"scene": scene}, ALIASED_PRIOR
    )
    beside = found.refined.T_metric_camera.copy()
    beside[0, 3] += 1.0
    other = replace(found, refined=replace(found.refined, T_metric_camera=beside), probability=0.4)
    assert localization.rival_probability([found, other]) == (0.4 if rival else 0.0)


def test_a_rival_from_which_content_is_near_counts_whichever_pose_is_first() -> None:
    def pose(x: float, scale: float) -> Any:
        T = np.eye(4)
        T[0, 3] = x
        refined = SimpleNamespace(T_metric_camera=T, scale=scale)
        return SimpleNamespace(refined=refined, candidate=SimpleNamespace(component=0), probability=0.9)

    for poses in ([pose(0, 10.0), pose(4, 1.0)], [pose(4, 1.0), pose(0, 10.0)]):
        assert localization.rival_probability(poses) == 0.9
