"""Rough poses: found among few right matches by how each says that the camera was turned, and by nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.geometry.projection import project
from gsmap.geometry.rotations import angle_between, exp_so3, matrices_to_quats, multiply_quats
from gsmap.localize import MapScene, feature_frames, matching
from gsmap.localize.candidates import PointMatches, match_views, propose_poses
from gsmap.localize.features import quantize
from gsmap.localize.matching import FeatureSet
from gsmap.types import Cameras, Sim3
from gsmap.types.localization import Keypoints, SceneFeatures

LENS, SIZE = np.array([400.0, 400, 240, 180]), (480, 360)


def camera(rng: np.random.Generator) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    return pose


def exp_roll(deg: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = exp_so3(np.array([0, 0, np.radians(deg)]))
    return pose


def seen(rng: np.random.Generator, pose: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels and the points that they show."""
    pixels = rng.uniform([10, 10], [470, 350], (count, 2))
    depth = rng.uniform(2, 5, (count, 1))
    local = np.concatenate([(pixels - LENS[2:]) / LENS[:2] * depth, depth], axis=1)
    return pixels, local @ pose[:3, :3].T + pose[:3, 3]


def turns(rng: np.random.Generator, pose: np.ndarray, count: int, sigma_deg: float) -> np.ndarray:
    """How the camera was turned, as so many matches say."""
    off = np.stack([exp_so3(rng.normal(size=3) * np.radians(sigma_deg)) for _ in range(count)])
    return matrices_to_quats(pose[:3, :3] @ off)


def made(rng: np.random.Generator, pose: np.ndarray, right: int, wrong: int) -> tuple[np.ndarray, PointMatches]:
    """Right matches, turned to 8 degrees, among wrong ones that say anything."""
    pixels, points = seen(rng, pose, right + wrong)
    said = turns(rng, pose, right + wrong, 8)
    points[right:] = rng.normal(size=(wrong, 3)) * 3
    said[right:] = [turns(rng, camera(rng), 1, 0)[0] for _ in range(wrong)] or np.zeros((0, 4))
    order = rng.permutation(right + wrong)
    zeros = np.zeros(right + wrong, int)
    view = rng.integers(0, 20, right + wrong)
    return pixels, PointMatches(order, points[order], zeros, view[order], said[order], ("scene",))


@pytest.mark.parametrize("seed", range(5))
def test_seven_right_matches_among_a_hundred_are_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    pose = camera(rng)
    pixels, matches = made(rng, pose, 7, 100)
    best, *others = propose_poses(pixels, {3: matches}, LENS, SIZE, 0.0)
    assert np.abs(best.T_metric_camera - pose).max() < 0.05
    assert best.component == 3
    assert 7 <= best.num_inliers <= 10
    assert all(one.num_inliers < best.num_inliers for one in others)


def test_matches_that_say_another_turn_do_not_count() -> None:
    """Twelve agree on a pose to the pixel, but say that the camera looked the other way."""
    rng = np.random.default_rng(0)
    pose = camera(rng)
    pixels, matches = made(rng, pose, 12, 0)
    back = multiply_quats(matches.orientations, np.array([0.0, 0, 1, 0]))
    assert len(propose_poses(pixels, {0: matches}, LENS, SIZE, 0.0)) == 1
    assert propose_poses(pixels, {0: replace(matches, orientations=back)}, LENS, SIZE, 0.0) == []
    half = matches.orientations.copy()
    half[:6] = back[:6]
    (one,) = propose_poses(pixels, {0: replace(matches, orientations=half)}, LENS, SIZE, 0.0)
    assert one.num_inliers == 6


@pytest.mark.parametrize(("right", "focal_sigma", "found"), [(3, 0.0, 0), (4, 0.0, 1), (5, 1.0, 0), (7, 1.0, 1)])
def test_how_many_must_agree_hangs_on_whether_the_lens_is_known(right: int, focal_sigma: float, found: int) -> None:
    rng = np.random.default_rng(2)
    pixels, matches = made(rng, camera(rng), right, 0)
    assert len(propose_poses(pixels, {0: matches}, LENS, SIZE, focal_sigma)) == found


def test_features_of_the_photo_count_once() -> None:
    """Three features that four views show are no twelve."""
    rng = np.random.default_rng(4)
    pose = camera(rng)
    pixels, points = seen(rng, pose, 3)
    said = turns(rng, pose, 12, 3)
    feature, view = np.tile(np.arange(3), 4), np.repeat(np.arange(4), 3)
    matches = PointMatches(feature, np.tile(points, (4, 1)), np.zeros(12, int), view, said, ("scene",))
    assert propose_poses(pixels, {0: matches}, LENS, SIZE, 0.0) == []


def test_no_matches_lead_nowhere() -> None:
    none = np.zeros(0, int)
    matches = PointMatches(none, np.zeros((0, 3)), none, none, np.zeros((0, 4)), ())
    assert propose_poses(np.zeros((0, 2)), {0: matches}, LENS, SIZE, 0.0) == []


def test_a_roll_that_all_share_may_be_unknown() -> None:
    """Without angles of features all say that the camera was held upright; it was rolled by 70 degrees."""
    rng = np.random.default_rng(5)
    pose = camera(rng)
    pixels, matches = made(rng, pose, 9, 60)
    upright = replace(matches, orientations=multiply_quats(matches.orientations, turns(rng, exp_roll(-70), 1, 0)))
    assert propose_poses(pixels, {0: upright}, LENS, SIZE, 0.0) == []
    best, *_ = propose_poses(pixels, {0: upright}, LENS, SIZE, 0.0, has_angles=False)
    assert np.abs(best.T_metric_camera - pose).max() < 0.05
    assert best.num_inliers >= 9


def test_a_match_says_how_the_camera_was_turned_in_the_component(monkeypatch) -> None:
    """A photo from where a view was, rolled, in a scene that lies turned and in another unit: all say the truth."""
    rng = np.random.default_rng(7)
    view, count = camera(rng), 40
    _, points = seen(rng, view, count)
    descriptors = rng.normal(size=(count, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    angles = rng.uniform(0, 2 * np.pi, count)
    held = SceneFeatures(
        "scene",
        Cameras(view[None], LENS[None], np.array([SIZE])),
        np.array([0, count]),
        points.astype(np.float32),
        quantize(descriptors),
        np.round(angles * 128 / np.pi).astype(np.int64).astype(np.uint8),
    )
    S = Sim3(exp_so3(rng.normal(size=3)), rng.normal(size=3), 0.3)
    placed = MapScene("scene", S, 5, None, lambda: None, lambda: held)
    roll = np.radians(35)
    turn = exp_so3(np.array([0, 0, roll]))
    at, _ = project(points, np.linalg.inv(view @ np.block([[turn, np.zeros((3, 1))], [np.zeros((1, 3)), 1.0]])), LENS)
    photo = Keypoints(at, descriptors, (angles - roll).astype(np.float32))
    described = FeatureSet(quantize(descriptors), np.zeros(count, np.uint8))
    monkeypatch.setattr(matching, "MAX_TURN", 255)
    frames = feature_frames.camera_frames(photo, LENS)
    (matches,) = match_views(described, frames, [("scene", 0)], {"scene": placed}).values()
    assert len(matches.feature) > 30
    truth = matrices_to_quats((S.rotation @ view[:3, :3] @ turn)[None])[0]
    off = np.degrees(2 * np.arccos(np.minimum(np.abs(matches.orientations @ truth), 1)))
    assert off.max() < 2.5  # angles are kept to 1.4
    assert np.allclose(matches.points, S.apply(points[matches.feature]), atol=1e-5)
    wrong = matrices_to_quats((S.rotation @ view[:3, :3])[None])
    assert not feature_frames.within_angle(matches.orientations, wrong, 30).any()
    assert feature_frames.within_angle(matches.orientations, wrong, 38).all()
    assert np.degrees(angle_between(turn, np.eye(3))) == pytest.approx(35)
