"""Which views a photograph is matched with: planted features are found among many, by how they turn the camera."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from gsmap.errors import CorruptError
from gsmap.geometry.rotations import exp_so3, matrices_to_quats, multiply_quats
from gsmap.localize import joint_localization, retrieval, vocabulary
from gsmap.localize.feature_frames import feature_frames
from gsmap.localize.features import quantize
from gsmap.types import Cameras
from gsmap.types.localization import Keypoints, SceneFeatures
from gsmap.types.segments import InMemory, merged

LENS = np.array([300.0, 300.0, 240.0, 180.0])
VIEWS, OF_VIEW = 3, 40


def _unit(vectors: np.ndarray) -> np.ndarray:
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def _descriptors(rng: np.random.Generator, count: int) -> np.ndarray:
    """Descriptors about as alike as SIFT's: none is below 0."""
    return _unit(np.abs(rng.normal(size=(count, 128))) ** 2)


def _angles(rng: np.random.Generator, count: int) -> np.ndarray:
    return rng.uniform(0, 2 * np.pi, count)


def _scene(rng: np.random.Generator, name: str) -> tuple[SceneFeatures, np.ndarray]:
    """Views from about the middle in all directions, and where (pixels) their features lie."""
    poses, points, all_pixels = [], [], []
    for _ in range(VIEWS):
        pose = np.eye(4)
        pose[:3, :3] = exp_so3(rng.normal(size=3) * 2)
        pose[:3, 3] = rng.normal(size=3) * 0.3
        pixels = rng.uniform([10, 10], [470, 350], (OF_VIEW, 2))
        depth = rng.uniform(2, 4, (OF_VIEW, 1))
        local = np.concatenate([(pixels - LENS[2:]) / LENS[:2] * depth, depth], axis=1)
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
        poses.append(pose)
        all_pixels.append(pixels)
    count = VIEWS * OF_VIEW
    return SceneFeatures(
        name,
        Cameras(np.stack(poses), np.tile(LENS, (VIEWS, 1)), np.tile([480, 360], (VIEWS, 1))),
        np.arange(VIEWS + 1) * OF_VIEW,
        np.concatenate(points).astype(np.float32),
        quantize(_descriptors(rng, count)),
        np.round(_angles(rng, count) * 128 / np.pi).astype(np.int64).astype(np.uint8),
    ), np.concatenate(all_pixels)


def _photo(
    rng: np.random.Generator, scene: SceneFeatures, pixels: np.ndarray, rows: np.ndarray, *, turned: bool = False
) -> Keypoints:
    """A picture from where a view was, the camera rolled by 50 degrees: some of its features, noisy, and 100 others.

    Args:
        turned: every feature by another angle than the camera was.
    """
    roll = np.radians(50)
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    at = (pixels[rows] - LENS[2:]) @ turn.T + LENS[2:]
    angles = scene.angles[rows] * (np.pi / 128) + (rng.uniform(0.8, 5.5, len(rows)) if turned else roll)
    near = _unit(scene.descriptors[rows] / 254 + 0.02 * rng.normal(size=(len(rows), 128)))
    return Keypoints(
        np.concatenate([at, rng.uniform([10, 10], [470, 350], (100, 2))]).astype(np.float32),
        np.concatenate([near, _descriptors(rng, 100)]),
        np.concatenate([angles, _angles(rng, 100)]).astype(np.float32),
    )


@pytest.fixture(scope="module")
def scenes() -> list[tuple[SceneFeatures, np.ndarray]]:
    rng = np.random.default_rng(0)
    return [_scene(rng, f"{number:032x}") for number in range(120)]


@pytest.fixture(scope="module")
def segment(scenes) -> InMemory:
    return retrieval.new_segment([(found, "f" * 32) for found, _ in scenes])


def test_the_view_that_shows_the_same_comes_first(scenes, segment) -> None:
    """Six features of a hundred are enough among 360 views."""
    rng = np.random.default_rng(1)
    index = retrieval.view_index([segment])
    for number in (3, 50, 119):
        found, pixels = scenes[number]
        photo = _photo(rng, found, pixels, OF_VIEW + rng.permutation(OF_VIEW)[:6])
        views = retrieval.retrieve_views(index, photo, LENS, 24)
        assert views[0] == (found.scene, 1)
        assert len(views) <= 24


def test_matches_count_as_far_as_they_turn_the_camera_alike(scenes, segment) -> None:
    """Nine that contradict each other say less than six that agree."""
    rng = np.random.default_rng(2)
    (right, there), (wrong, elsewhere) = scenes[10], scenes[20]
    good = _photo(rng, right, there, np.arange(6))
    bad = _photo(rng, wrong, elsewhere, np.arange(9), turned=True)
    both = Keypoints(
        np.concatenate([good.pixels, bad.pixels]),
        np.concatenate([good.descriptors, bad.descriptors]),
        np.concatenate([good.angles_rad, bad.angles_rad]),
    )
    index = retrieval.view_index([segment])
    (first, _), *_ = retrieval.retrieve_views(index, both, LENS, 1)
    assert first == right.scene


def test_a_match_says_how_the_camera_was_turned(scenes) -> None:
    """The frame of a feature in the scene, times that in the photo turned back, is the camera's own."""
    found, pixels = scenes[0]
    rng = np.random.default_rng(3)
    photo = _photo(rng, found, pixels, np.arange(OF_VIEW))
    in_photo = feature_frames(photo.pixels[:OF_VIEW], photo.angles_rad[:OF_VIEW], LENS)
    in_scene = multiply_quats(
        matrices_to_quats(found.cameras.T_frame_camera[0, :3, :3]),
        feature_frames(pixels[:OF_VIEW], found.angles[:OF_VIEW] * (np.pi / 128), LENS),
    )
    turn = np.eye(3)
    roll = np.radians(-50)
    turn[:2, :2] = [[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]]
    truth = matrices_to_quats(found.cameras.T_frame_camera[0, :3, :3] @ turn)
    said = multiply_quats(in_scene, in_photo * [1, -1, -1, -1])
    assert np.degrees(2 * np.arccos(np.minimum(np.abs(said @ truth), 1))).max() < 2.5  # angles are kept to 1.4


def test_what_is_everywhere_says_nothing(scenes) -> None:
    """The same features in every scene do not hide the few that one scene alone has."""
    rng = np.random.default_rng(4)
    common = quantize(_descriptors(rng, 20))
    shared = []
    for found, _ in scenes:
        descriptors = found.descriptors.copy()
        descriptors[OF_VIEW - 20 : OF_VIEW] = common
        shared.append(SceneFeatures(found.scene, found.cameras, found.starts, found.points, descriptors, found.angles))
    index = retrieval.view_index([retrieval.new_segment([(found, "f" * 32) for found in shared])])
    of_all, alone = np.arange(OF_VIEW - 20, OF_VIEW), OF_VIEW + np.arange(6)
    wallpaper = _photo(rng, shared[5], scenes[5][1], of_all)
    planted = _photo(rng, shared[70], scenes[70][1], alone)
    both = Keypoints(
        np.concatenate([wallpaper.pixels, planted.pixels]),
        np.concatenate([wallpaper.descriptors, planted.descriptors]),
        np.concatenate([wallpaper.angles_rad, planted.angles_rad]),
    )
    assert retrieval.retrieve_views(index, both, LENS, 1) == [(shared[70].scene, 1)]


def test_only_the_scenes_that_are_wanted_are_named(scenes, segment) -> None:
    rng = np.random.default_rng(5)
    found, pixels = scenes[30]
    photo = _photo(rng, found, pixels, np.arange(12))
    index = retrieval.view_index([segment])
    others = {scene for scene in index.wanted if scene != found.scene}
    named = {scene for scene, _ in retrieval.retrieve_views(index.only(others), photo, LENS, 24)}
    assert named
    assert named <= others
    assert len(index.only({found.scene, "nobody"})) == 1
    assert retrieval.retrieve_views(index.only(()), photo, LENS, 24) == []


def test_the_same_is_said_in_however_many_segments_scenes_lie(scenes, segment) -> None:
    rng = np.random.default_rng(6)
    features = [(found, "f" * 32) for found, _ in scenes]
    parts = [retrieval.new_segment(features[a:b]) for a, b in ((80, 120), (0, 79), (79, 80))]
    photo = _photo(rng, *scenes[44], np.arange(15))
    asked = (photo, LENS, 24)
    whole = retrieval.retrieve_views(retrieval.view_index([segment]), *asked)
    assert retrieval.retrieve_views(retrieval.view_index(parts), *asked) == whole
    assert retrieval.retrieve_views(retrieval.view_index([merged(parts)]), *asked) == whole


def test_an_index_of_a_stranger_is_refused(scenes, segment) -> None:
    rng = np.random.default_rng(7)
    photo = _photo(rng, *scenes[0], np.arange(15))
    fewer = InMemory(segment.members[:3], segment.arrays)
    with raises(CorruptError, code="index_damaged"):
        retrieval.retrieve_views(retrieval.view_index([fewer]), photo, LENS, 24)


def test_nothing_to_look_for_finds_nothing(segment) -> None:
    nothing = Keypoints(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32))
    assert retrieval.retrieve_views(retrieval.view_index([segment]), nothing, LENS, 24) == []
    empty = SceneFeatures(
        "0" * 32,
        Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2), int)),
        np.zeros(1, np.int64),
        np.zeros((0, 3), np.float32),
        np.zeros((0, 0), np.int8),
        np.zeros(0, np.uint8),
    )
    assert len(retrieval.new_segment([(empty, "f" * 32)]).arrays.nodes) == 0


@pytest.mark.parametrize("width", [32, 64, 256])
def test_words_that_nobody_fitted_know_a_feature_again(width) -> None:
    rng = np.random.default_rng(8)
    held = vocabulary.load_vocabulary(width)
    one = _unit(rng.normal(size=(200, width)))
    two = _unit(one + 0.1 * _unit(rng.normal(size=(200, width))))
    other = _unit(rng.normal(size=(200, width)))
    a, b, c = (held.reduce(x) for x in (one, two, other))
    word = held.nearest(a)[:, 0]
    assert (held.nearest(b, 4) == word[:, None]).any(1).mean() > 0.8
    same = np.bitwise_count(held.signatures(a, word) ^ held.signatures(b, word))
    chance = np.bitwise_count(held.signatures(a, word) ^ held.signatures(c, word))
    assert same.mean() < 10 < 24 < chance.mean()


def test_photographs_of_one_place_have_words_in_common(world) -> None:
    one, two = (world_features(photo) for photo in world.photos[:2])
    some = Keypoints(one.pixels[::2], one.descriptors[::2])
    a, b, c = (joint_localization.word_histogram(found) for found in (one, some, two))
    assert a @ b > 0.6 > 0.5 > a @ c
    assert joint_localization.word_histogram(Keypoints(one.pixels[:0], one.descriptors[:0])).shape == a.shape


def world_features(photo) -> Keypoints:
    from gsmap.localize.extractors import sift

    return sift.make({}, sift.Params()).extract(photo.rgb)
