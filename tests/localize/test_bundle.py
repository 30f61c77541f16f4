"""Photographs adjusted at once, beside where they were taken: points and cameras are made, so that truth is exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.geometry.projection import in_image, project
from gsmap.geometry.rotations import angle_between, exp_so3
from gsmap.localize import bundle_adjustment
from gsmap.localize.resection import retract_pose

LENS, SIZE = np.array([400.0, 400.0, 240.0, 180.0]), (480, 360)
SIGMAS = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])


class Clip:
    """A camera that walks along a wall with a shelf before it; features are points, found to half a pixel.

    Args:
        told: photos that the map places, each off by its own error, a standard deviation of `SIGMAS`.
        shared: an error that is the same for all of these, in `SIGMAS`.
        focal: of the lens, beside what the photos are said to have.
    """

    def __init__(self, told, frames: int = 8, seed: int = 0, shared: float = 0.0, noise_px: float = 0.5, focal=1.0):
        rng = np.random.default_rng(seed)
        on_wall = np.stack([rng.uniform(-3, 6, 500), rng.uniform(-1.5, 1.5, 500), 4 + 0 * rng.uniform(size=500)], 1)
        before = on_wall[:250] * [1, 1, 0] + np.stack([0 * rng.uniform(size=250)] * 2 + [rng.uniform(2.5, 4, 250)], 1)
        self.points = np.concatenate([on_wall, before])
        self.truth = np.tile(np.eye(4), (frames, 1, 1))
        for k in range(frames):
            self.truth[k, :3, :3] = exp_so3(np.array([0.0, 0.08 * (k - frames / 2), 0.0]))
            self.truth[k, :3, 3] = [0.4 * k, 0.02 * rng.normal(), 0.05 * rng.normal()]
        self.noise = rng.normal(size=(frames, len(self.points), 2)) * noise_px
        off = shared * rng.normal(size=6)
        self.photos, self.ids = [], []
        for k in range(frames):
            lens = LENS * [focal, focal, 1, 1]
            pixels, depth = project(self.points, np.linalg.inv(self.truth[k]), lens)
            seen = np.flatnonzero(in_image(pixels, depth, np.array(SIZE)))
            self.ids.append(seen)
            photo = bundle_adjustment.BundlePhoto((pixels + self.noise[k])[seen], LENS, SIZE)
            if k in told:
                pose = retract_pose(self.truth[k], SIGMAS * (off + rng.normal(size=6)))
                rows = np.arange(len(seen))
                by_depth = self.points[seen] @ np.eye(3)
                by_depth = (by_depth - self.truth[k, :3, 3]) @ self.truth[k, :3, :3]
                by_depth = by_depth @ pose[:3, :3].T + pose[:3, 3]
                photo = replace(photo, T_metric_camera=pose, covariance=np.diag(SIGMAS**2), rows=rows, points=by_depth)
            self.photos.append(photo)

    def matches(self, reach: int = 7):
        out = {}
        for k, mine in enumerate(self.ids):
            for other, theirs in enumerate(self.ids):
                if 0 < abs(k - other) <= reach:
                    _, rows, columns = np.intersect1d(mine, theirs, return_indices=True)
                    out[k, other] = rows, columns
        return out

    def errors(self, poses) -> np.ndarray:
        """(K, 2) degrees and metres."""
        return np.array(
            [
                (
                    np.degrees(angle_between(pose[:3, :3], self.truth[k][:3, :3])),
                    np.linalg.norm(pose[:3, 3] - self.truth[k][:3, 3]),
                )
                for k, pose in poses.items()
            ]
        )


def _adjusted(photos, matches) -> dict[int, bundle_adjustment.AdjustedPose]:
    out, apart = bundle_adjustment.adjust_photos(photos, matches)
    assert apart == []
    return out


def _poses(out) -> dict[int, np.ndarray]:
    return {k: one.T_metric_camera for k, one in out.items()}


def test_what_photos_share_tells_more_than_the_map_says_of_each() -> None:
    clip = Clip(range(8))
    out = _adjusted(clip.photos, clip.matches())
    assert sorted(out) == list(range(8))
    before = np.median(clip.errors({k: one.T_metric_camera for k, one in enumerate(clip.photos)}), axis=0)
    after = np.median(clip.errors(_poses(out)), axis=0)
    assert (after < 0.6 * before).all()


def test_photos_are_found_by_the_others_one_after_another() -> None:
    """Only the first three are placed, and the last share no feature with them."""
    clip = Clip((0, 1, 2), frames=10)
    out = _adjusted(clip.photos, clip.matches(reach=2))
    assert sorted(out) == list(range(10))
    assert [bool(out[k].resected_from) for k in range(10)] == [False] * 3 + [True] * 7
    assert set(out[3].resected_from) <= {1, 2}
    assert set(out[9].resected_from) <= {7, 8}
    assert clip.errors(_poses(out))[:, 0].max() < 4
    assert clip.errors(_poses(out))[:, 1].max() < 0.25
    sigmas = [np.sqrt(np.linalg.eigvalsh(out[k].covariance[3:, 3:])[-1]) for k in (1, 5, 9)]
    assert sigmas[0] < sigmas[1] < sigmas[2], "what hangs on others is known less well"


def test_one_photo_finds_nobody_and_neither_do_few_points() -> None:
    clip = Clip((3,))
    assert _adjusted(clip.photos, clip.matches()) == {}
    clip = Clip((0, 1))
    few = {}
    for (k, other), (rows, columns) in clip.matches().items():
        keep = (rows < 9) | (k != 5)
        keep &= (columns < 9) | (other != 5)
        few[k, other] = rows[keep], columns[keep]
    out = _adjusted(clip.photos, few)
    assert 4 in out
    assert 5 not in out
    only = {pair: both for pair, both in clip.matches().items() if 5 not in pair or pair in ((5, 0), (0, 5))}
    assert 5 not in _adjusted(clip.photos, only), "what repeats itself fools one"


@pytest.mark.guards("answers")
def test_a_photo_that_the_map_places_wrongly_takes_no_part() -> None:
    clip = Clip(range(8))
    wrong = retract_pose(clip.truth[4], np.array([0, 0.5, 0, 0.8, 0, 0]))
    clip.photos[4] = replace(clip.photos[4], T_metric_camera=wrong)
    out, apart = bundle_adjustment.adjust_photos(clip.photos, clip.matches())
    others = {k: pose for k, pose in _poses(out).items() if k != 4}
    assert len(others) == 7
    assert clip.errors(others)[:, 1].max() < 0.06
    assert apart == [4]
    assert 4 not in out, "where it lies by the others is not said either: one of both is wrong"


def test_of_two_that_contradict_each_other_neither_is_believed() -> None:
    clip = Clip((2, 3))
    clip.photos[3] = replace(
        clip.photos[3], T_metric_camera=retract_pose(clip.truth[3], np.array([0, 0.1, 0, 0.3, 0, 0]))
    )
    out, apart = bundle_adjustment.adjust_photos(clip.photos, clip.matches())
    assert out == {}
    assert sorted(apart) == [2, 3]


def test_what_is_found_a_little_beside_hardly_counts(monkeypatch) -> None:
    """A fifth of the features of every other photo lie three pixels to the right: as near as matches that agree."""
    clip = Clip(range(8), noise_px=0.3)
    rng = np.random.default_rng(1)
    for k in range(0, 8, 2):
        beside = np.where(rng.random(len(clip.photos[k].pixels)) < 0.2, 3.0, 0.0)
        clip.photos[k] = replace(clip.photos[k], pixels=clip.photos[k].pixels + np.stack([beside, 0 * beside], axis=1))
    doubted = clip.errors(_poses(_adjusted(clip.photos, clip.matches())))
    monkeypatch.setattr(bundle_adjustment, "ROBUST_SIGMAS", 1e6)
    believed = clip.errors(_poses(_adjusted(clip.photos, clip.matches())))
    assert np.median(doubted[:, 0]) < 0.8 * np.median(believed[:, 0])


def test_wrong_matches_take_no_part() -> None:
    clip = Clip(range(8))
    rng = np.random.default_rng(1)
    spoilt = {}
    for pair, (rows, columns) in clip.matches().items():
        wrong = rng.random(len(rows)) < 0.2
        columns = columns.copy()
        columns[wrong] = rng.permutation(columns[wrong])
        spoilt[pair] = rows, columns
    out = _adjusted(clip.photos, spoilt)
    clean = _adjusted(clip.photos, clip.matches())
    assert np.median(clip.errors(_poses(out))[:, 1]) < 1.5 * np.median(clip.errors(_poses(clean))[:, 1]) + 0.005


def test_covariances_say_how_far_off_poses_are_where_the_map_errs_alike(monkeypatch) -> None:
    """Most of each error is shared by all photos of a clip: that no number of them averages away."""

    def told() -> np.ndarray:
        squared = []
        for seed in range(12):
            clip = Clip(range(6), frames=6, seed=seed, shared=1.2)
            for k, one in _adjusted(clip.photos, clip.matches()).items():
                apart = np.linalg.inv(one.T_metric_camera) @ clip.truth[k]
                xi = np.r_[apart[2, 1], apart[0, 2], apart[1, 0], apart[:3, 3]]
                squared.append(xi @ np.linalg.solve(one.covariance, xi))
        return np.quantile(squared, (0.5, 0.9)) / [5.35, 10.6]

    as_it_is = told()
    monkeypatch.setattr(bundle_adjustment, "POSE_CORRELATION", 0.0)
    each_for_itself = told()
    assert (as_it_is < 1.5).all()
    assert (each_for_itself > 1.5 * as_it_is).all()


def test_poses_that_disagree_are_known_less_well() -> None:
    clip = Clip(range(8))
    usual = _adjusted(clip.photos, clip.matches())
    rng = np.random.default_rng(3)
    for k, photo in enumerate(clip.photos):
        clip.photos[k] = replace(photo, T_metric_camera=retract_pose(clip.truth[k], 1.8 * SIGMAS * rng.normal(size=6)))
    off, _ = bundle_adjustment.adjust_photos(clip.photos, clip.matches())
    assert len(off) > 4
    for k in off:
        assert np.trace(off[k].covariance) > 4 * np.trace(usual[k].covariance)


def test_an_unknown_focal_length_is_adjusted_for_all_that_one_lens_took() -> None:
    clip = Clip(range(6), focal=1.02)
    rng = np.random.default_rng(2)
    free = [
        replace(photo, focal_sigma=np.inf, intrinsics_px=LENS * [*np.repeat(said, 2), 1, 1])
        for photo, said in zip(clip.photos, [*(1.02 + 0.02 * rng.normal(size=6)), 1.4, 1.4], strict=True)
    ]  # the last two nothing is known of
    out = _adjusted(free, clip.matches())
    focals = {round(float(one.intrinsics_px[0]), 6) for one in out.values()}
    assert len(out) == 8
    assert len(focals) == 1
    assert abs(focals.pop() / (1.02 * LENS[0]) - 1) < 0.02
    fixed = _adjusted(clip.photos, clip.matches())
    assert all((one.intrinsics_px == LENS).all() for one in fixed.values())
