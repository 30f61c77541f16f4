"""Photographs of one place help each other; a clip is its sharpest frames."""

from __future__ import annotations

import weakref
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from raising import raises
from test_localize_verdict import BAD, GOOD

from gsmap.errors import InputError, NotFoundError
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import Params, localize_together, probability, read_clip, verdict
from gsmap.localize import clips as reading
from gsmap.localize import joint_localization as together_module
from gsmap.localize.extractors import sift
from gsmap.localize.photos import Lens
from gsmap.localize.resection import retract_pose
from gsmap_synthetic import film

SIFT = sift.make({}, sift.Params())


def test_whoever_is_placed_helps_the_others(world) -> None:
    """A photo whose own matches with the map are forbidden is placed by its neighbour."""
    pose = world.poses[1].copy()
    pose[:3, :3] = pose[:3, :3] @ exp_so3(np.array([0.0, 0.05, 0.0]))
    frames = film(world.place, pose[None], size_px=(480, 360), focal=world.focal)
    beside = replace(world.photos[1], rgb=frames.images[0], name="beside")
    placed = localize_together([world.photos[1], beside], world.index, {"scene": world.placed}, SIFT, Params())
    for one, truth in zip(placed, (world.poses[1], pose), strict=True):
        assert one.is_placed, one.reason
        assert np.linalg.norm(one.T_map_camera[:3, 3] - truth[:3, 3]) < 0.06
    assert min(one.probability for one in placed) > 0.95


def test_another_photos_features_alone_are_not_enough(world, monkeypatch) -> None:
    """Where the map leads away from the pose that a neighbour lends, what was found before stays."""
    scenes = {"scene": world.placed}
    shots = [
        together_module._evaluate_photo(photo, world.index, scenes, SIFT, Params()) for photo in [world.photos[1]] * 2
    ]
    shots[1].poses = []  # so that only its neighbour may place it
    ties: dict[tuple[int, int], bool] = {}
    judge = together_module.evaluate_pose

    def away(*given):
        one = judge(*given)
        pose = one.refined.T_metric_camera.copy()
        pose[:3, 3] += 1.0
        return replace(one, refined=replace(one.refined, T_metric_camera=pose))

    monkeypatch.setattr(together_module, "evaluate_pose", away)
    together_module._propose_to_neighbours(0, shots, [1], scenes, 0.1, ties)
    assert not shots[1].poses
    assert not ties
    monkeypatch.setattr(together_module, "evaluate_pose", judge)
    together_module._propose_to_neighbours(0, shots, [1], scenes, 0.1, ties)
    assert shots[1].probability > 0.9
    assert ties == {(0, 1): True}


def test_a_lent_pose_is_adjusted_before_it_is_settled(world, monkeypatch) -> None:
    """What agreed on a sample's pose tells a better one."""
    scenes = {"scene": world.placed}
    shots = [
        together_module._evaluate_photo(photo, world.index, scenes, SIFT, Params()) for photo in [world.photos[1]] * 2
    ]
    shots[1].poses, starts = [], []
    judge, resect = together_module.evaluate_pose, together_module.resection.resect

    def rough(*given, **more):
        found = resect(*given, **more)
        return replace(found, T_map_camera=retract_pose(found.T_map_camera, np.array([0.01, 0, 0, 0.05, 0, 0])))

    monkeypatch.setattr(together_module.resection, "resect", rough)
    monkeypatch.setattr(together_module, "evaluate_pose", lambda *given: (starts.append(given[1]), judge(*given))[1])
    together_module._propose_to_neighbours(0, shots, [1], scenes, 0.1, {})
    far = [np.linalg.norm(one.T_metric_camera[:3, 3] - world.poses[1][:3, 3]) for one in starts]
    assert len(far) == 1
    assert far[0] < 0.03


@pytest.fixture(scope="module")
def beside_each_other(world):
    """Four photographs a step apart, and their poses."""
    poses = np.tile(world.poses[1], (4, 1, 1))
    for k in range(4):
        poses[k, :3, :3] = poses[k, :3, :3] @ exp_so3(np.array([0.0, 0.03 * (k - 1.5), 0.0]))
        poses[k, :3, 3] += poses[k, :3, 0] * 0.15 * (k - 1.5)
    frames = film(world.place, poses, size_px=(480, 360), focal=world.focal)
    photos = [replace(world.photos[1], rgb=image, name=f"step {k}") for k, image in enumerate(frames.images)]
    return photos, poses


@pytest.mark.parametrize("map_shows_it", [True, False])
def test_a_photo_is_found_by_two_that_the_map_places(world, beside_each_other, monkeypatch, map_shows_it) -> None:
    """The map finds nothing of the last one; whether it shows anything of it where the others lead does not matter."""
    photos, poses = beside_each_other
    find, judge = together_module.evaluate_candidates, together_module.evaluate_pose
    monkeypatch.setattr(
        together_module,
        "evaluate_candidates",
        lambda picture, *rest: find(picture, *rest) if len(asked.append(0) or asked) < 4 else ([], "forbidden"),
    )
    monkeypatch.setattr(together_module, "_propose_to_neighbours", lambda *given: None)

    def hidden(*given):
        one = judge(*given)
        return replace(one, refined=replace(one.refined, covariance=None, renders=[]), covariance=None)

    if not map_shows_it:
        monkeypatch.setattr(together_module, "evaluate_pose", hidden)
    asked: list[int] = []
    *others, last = localize_together(photos, world.index, {"scene": world.placed}, SIFT, Params())
    assert all(one.is_placed for one in others)
    assert last.is_placed, last.reason
    assert last.scenes == ("scene",)
    assert last.num_gaussians > 0
    assert last.probability > 0.95
    apart = np.linalg.inv(last.T_map_camera) @ poses[3]
    assert np.linalg.norm(apart[:3, 3]) < 0.03
    assert np.linalg.norm(apart[:3, :3] - np.eye(3)) < 0.02
    assert np.sqrt(np.diag(last.covariance)[3:]).max() < 0.1


def test_photos_of_one_place_are_adjusted_at_once(world, beside_each_other) -> None:
    photos, poses = beside_each_other
    together = localize_together(photos, world.index, {"scene": world.placed}, SIFT, Params())
    off = [np.linalg.norm(one.T_map_camera[:3, 3] - truth[:3, 3]) for one, truth in zip(together, poses, strict=True)]
    between = [np.linalg.inv(a.T_map_camera) @ b.T_map_camera for a, b in pairwise(together)]
    true = [np.linalg.inv(a) @ b for a, b in pairwise(poses)]
    steps = [np.linalg.norm(a[:3, 3] - b[:3, 3]) for a, b in zip(between, true, strict=True)]
    assert max(off) < 0.02
    assert max(steps) < 0.004, "they lie to each other as they were taken"


def test_photos_of_other_places_stay_refused_together(world, elsewhere) -> None:
    placed = localize_together(elsewhere.photos, world.index, {"scene": world.placed}, SIFT, Params())
    assert not any(one.is_placed for one in placed)


def clip(path, images: np.ndarray, codec: str = "mpeg4", form: str | None = None) -> None:
    av = pytest.importorskip("av")
    with av.open(str(path), "w", format=form) as container:
        stream = container.add_stream(codec, rate=10)
        stream.width, stream.height, stream.pix_fmt = images.shape[2], images.shape[1], "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def test_a_clip_gives_the_sharpest_frame_of_each_stretch(tmp_path) -> None:
    rng = np.random.default_rng(0)
    images = np.full((20, 128, 192, 3), 128, np.uint8)
    for sharp in (3, 12):
        images[sharp] = rng.integers(0, 255, (128, 192, 3))
    clip(tmp_path / "a.mp4", images)
    frames = read_clip(tmp_path / "a.mp4", params=reading.Params(interval_s=1.0))
    assert [round(10 * at) for at, _ in frames] == [3, 12]
    assert frames[0][1].size_px == (192, 128)
    small = read_clip(tmp_path / "a.mp4", params=reading.Params(interval_s=1.0, max_side_px=96))
    assert small[0][1].size_px == (96, 64)


def test_intrinsics_of_a_clip_are_in_its_own_pixels(tmp_path) -> None:
    clip(tmp_path / "a.mp4", np.full((3, 128, 192, 3), 128, np.uint8))
    fisheye = ("OPENCV_FISHEYE", (180.0, 160, 100, 60, 0.02, 0, 0, 0))
    for lens, want in (
        (Lens((180.0, 160.0, 100.0, 60.0)), [90, 80, 50, 30]),
        (Lens(focal_px=180.0), [90, 90, 48, 32]),
        (Lens(model=fisheye), [90, 80, 50, 30]),
    ):
        ((_, photo),) = read_clip(tmp_path / "a.mp4", lens, reading.Params(max_side_px=96))
        np.testing.assert_allclose(photo.intrinsics_px, want)


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "mpeg4"), ("a.m4v", "mpeg4"), ("a.h264", "libx264")])
def test_a_clip_is_thinned_as_it_is_read(tmp_path, monkeypatch, name: str, codec: str) -> None:
    """With a length in its header or without: few frames from all of it, and hardly more than these in memory."""
    av = pytest.importorskip("av")
    images = np.zeros((600, 96, 128, 3), np.uint8)
    images += (np.arange(600) // 3).astype(np.uint8)[:, None, None, None]
    form = {"a.m4v": "m4v", "a.h264": "h264"}.get(name)
    clip(tmp_path / name, images, codec, form)
    with av.open(str(tmp_path / name)) as container:
        assert (container.duration is not None) == (form is None)
    made: list[weakref.ref] = []
    peak = 0

    def counted(*arrays, **options):
        nonlocal peak
        made.append(weakref.ref(out := np.array(*arrays, **options)))
        peak = max(peak, sum(one() is not None for one in made))
        return out

    monkeypatch.setattr(reading.np, "ascontiguousarray", counted)
    frames = read_clip(tmp_path / name, params=reading.Params(interval_s=0.1, max_frames=10))
    assert peak <= 13
    assert 5 <= len(frames) <= 10
    numbers = np.array([3 * photo.rgb.mean() for _, photo in frames])  # each frame is as bright as its number says
    assert numbers[0] < 130
    assert numbers[-1] > 470
    assert 0 < np.diff(numbers).min() <= np.diff(numbers).max() < 270


def test_the_sharpest_of_a_long_stretch_stays(tmp_path) -> None:
    """Wherever it lies, and whatever stretches were joined on the way."""
    rng = np.random.default_rng(1)
    images = np.full((320, 64, 96, 3), 128, np.uint8)
    images[[37, 250]] = rng.integers(0, 255, (2, 64, 96, 3))
    clip(tmp_path / "a.m4v", images, "mpeg4", "m4v")
    frames = read_clip(tmp_path / "a.m4v", params=reading.Params(interval_s=0.1, max_frames=4))
    number = [round(10 * at) for at, _ in frames]
    assert {37, 250} <= set(number)


def test_vast_frames_are_refused_by_the_header(tmp_path, monkeypatch) -> None:
    clip(tmp_path / "a.mp4", np.zeros((2, 64, 96, 3), np.uint8))
    monkeypatch.setattr(reading, "_MAX_FRAME_PX", 64 * 96 - 1)
    with pytest.raises(InputError):
        read_clip(tmp_path / "a.mp4")


def test_what_is_no_clip_is_refused(tmp_path) -> None:
    pytest.importorskip("av")
    with pytest.raises(NotFoundError):
        read_clip(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("no clip")
    with raises(InputError, code="clip_unreadable"):
        read_clip(tmp_path / "text.mp4")


def shots_of(*told: dict[str, float]) -> list[SimpleNamespace]:
    """Photos of which nothing is known but their evidence."""
    aliased_prior = verdict.Params().aliased_prior
    found = [probability.load_model().probability(one, aliased_prior) for one in told]
    return [
        SimpleNamespace(best=SimpleNamespace(evidence=one), probability=p, unsupported=False)
        for one, p in zip(told, found, strict=True)
    ]


@pytest.mark.guards("answers")
def test_frames_of_a_room_that_looks_alike_do_not_make_each_other_sure() -> None:
    """Each may be of the room or of one that looks like it, and all are of the same one: furniture that stands
    elsewhere in some of them tells against all."""
    ties = {(0, 1): True, (1, 2): True}
    half = GOOD | {"unlike_part": 0.2, "unlike": 0.06, "unlike_likely": 0.03, "unlike_surely": 0.015, "explained": 0.7}
    half |= {"contradicted": 0.12, "explained_coarsely": 0.85, "colour": 0.7, "laid": 0.55}
    elsewhere = half | {"unlike_likely": 0.12, "unlike_surely": 0.08, "unlike": 0.2, "colour": 0.4, "explained": 0.5}
    alone = shots_of(half, elsewhere, elsewhere)
    together = together_module.combine_probabilities(alone, ties, 0.1)
    assert 0.3 < alone[0].probability < 0.95
    assert together[0] < alone[0].probability
    assert max(together) < 0.95
    good = shots_of(half, GOOD, GOOD)
    assert together_module.combine_probabilities(good, ties, 0.1)[0] > 0.95 > good[0].probability
    assert together_module.combine_probabilities(good, {}, 0.1)[0] > good[0].probability, "tied or not"
    assert together_module.combine_probabilities(alone, {}, 0.1)[0] < alone[0].probability


def test_a_photo_alone_is_as_probable_together() -> None:
    half = GOOD | {"unlike_part": 0.2, "unlike": 0.06, "colour": 0.7, "laid": 0.3, "matches": 0.9}
    (one,) = shots_of(half)
    assert together_module.combine_probabilities([one], {}, 0.1)[0] == pytest.approx(one.probability, abs=1e-6)


def test_a_photo_of_another_place_says_nothing_of_rooms() -> None:
    """It is there by chance, whatever it would show of a room."""
    half = GOOD | {"unlike_part": 0.2, "unlike": 0.06, "unlike_likely": 0.03, "unlike_surely": 0.015, "explained": 0.7}
    few, more = (together_module.combine_probabilities(shots_of(half, GOOD, *[BAD] * n), {}, 0.1) for n in (0, 8))
    assert few[0] == pytest.approx(more[0], abs=0.01)
    assert max(more[2:]) < 0.05
    nothing = SimpleNamespace(best=None, probability=0.0, unsupported=False)
    assert together_module.combine_probabilities([*shots_of(half, GOOD), nothing], {}, 0.1)[2] == 0.0


def test_what_chance_explains_it_does_not_for_two() -> None:
    """A photo that few features place is sure once another one, tied to it, shows the place as well."""
    few = GOOD | {"matches": 0.9, "inliers": 0.9, "found_again": 0.03, "spread": 0.06, "laid": 0.3, "compared": 2.3}
    few |= {"explained": 0.55, "explained_coarsely": 0.6, "seen": 0.4, "sigma_m": -1.3}
    shots = shots_of(few, GOOD)
    together = together_module.combine_probabilities(shots, {(0, 1): True}, 0.1)
    assert shots[0].probability < 0.95 < together[0]


def test_a_photo_that_others_lead_elsewhere_is_not_said(world, beside_each_other, monkeypatch) -> None:
    photos, _ = beside_each_other
    adjust = together_module.bundle_adjustment.adjust_photos
    monkeypatch.setattr(together_module.bundle_adjustment, "adjust_photos", lambda *given: (adjust(*given)[0], [2]))
    placed = localize_together(photos, world.index, {"scene": world.placed}, SIFT, Params())
    assert [one.is_placed for one in placed] == [True, True, False, True]
    assert "place it elsewhere" in placed[2].reason
    assert placed[2].T_map_camera is None


def test_a_rival_is_one_only_where_those_tied_to_it_may_be_elsewhere_as_well() -> None:
    """Neighbours that are sure of this place, and have no rival, leave a photo no other one; a map that shows the same
    twice gives all of them rivals."""
    ties = {(0, 1): True, (1, 2): True}
    tie = together_module.LINK_PROBABILITY
    told = together_module.rival_factors([0.5, 0.9, 0.8, 0.9], ties)
    assert told[0] == pytest.approx((1 - tie * 0.9) * (1 - tie**2 * 0.8))
    assert told[1] == pytest.approx((1 - tie * 0.8) * (1 - tie * 0.5))
    assert told[3] == 1.0, "tied to nobody"
    twins = together_module.rival_factors([0.02, 0.0, -0.01], ties)
    assert min(twins) > 0.97
    assert together_module.rival_factors([0.9, 0.9], {(0, 1): False}) == [1.0, 1.0]


@pytest.mark.parametrize(
    ("rivals", "placed"), [([0.9] * 4, [False] * 4), ([0.0, 0.0, 0.9, 0.0], [True] * 4)], ids=["all", "one"]
)
def test_a_map_that_shows_the_same_twice_tells_no_photo_where_it_is(
    world, beside_each_other, monkeypatch, rivals, placed
) -> None:
    """Where all have rivals nobody is placed; a single one that has a rival is, for the others cannot be there."""
    photos, _ = beside_each_other
    looked, rival_by_candidate = together_module.evaluate_photos, {}

    def noted(*given):
        shots, near, ties = looked(*given)
        rival_by_candidate.update(
            {id(shot.poses[0].candidate): rival for shot, rival in zip(shots, rivals, strict=True)}
        )
        return shots, near, ties

    monkeypatch.setattr(together_module, "evaluate_photos", noted)
    monkeypatch.setattr(
        together_module, "rival_probability", lambda judged: rival_by_candidate.get(id(judged[0].candidate), 0.0)
    )
    said = localize_together(photos, world.index, {"scene": world.placed}, SIFT, Params())
    assert [one.is_placed for one in said] == placed, [one.reason for one in said]
