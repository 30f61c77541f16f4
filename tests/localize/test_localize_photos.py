"""A photograph is found where it was taken, with an honest covariance, or refused; never somewhere else."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from gsmap.errors import ConfigError
from gsmap.geometry.rotations import angle_between
from gsmap.localize import Params, covariance, localization, localize_photo
from gsmap.localize.candidates import PoseCandidate
from gsmap.localize.extractors import sift
from gsmap.types.localization import LocalizationResult, Photo

SIFT = sift.make({}, sift.Params())


def found(world, photo: Photo, metres: float = 1.0) -> LocalizationResult:
    return localize_photo(photo, world.index, {"scene": world.placed}, SIFT, Params(), {0: metres})


def off(placement: LocalizationResult, truth: np.ndarray) -> tuple[float, float]:
    pose = placement.T_map_camera
    assert pose is not None, placement.reason
    angle = np.degrees(angle_between(pose[:3, :3], truth[:3, :3]))
    return angle, float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))


@pytest.mark.parametrize("number", range(3))
def test_a_photo_is_placed_where_it_was_taken(world, number: int) -> None:
    one = found(world, world.photos[number])
    assert one.is_placed, one.reason
    angle, far = off(one, world.poses[number])
    assert angle < 1.0
    assert far < 0.05
    assert one.scenes == ("scene",)
    assert one.num_gaussians > 1000
    sigma = np.sqrt(np.diag(one.covariance))
    assert 0.0005 < sigma[3:].max() < 0.1


def test_photos_of_another_place_are_refused(world, elsewhere) -> None:
    for photo in elsewhere.photos:
        one = found(world, photo)
        assert not one.is_placed
        assert one.T_map_camera is None


@pytest.mark.guards("answers")
def test_poses_are_in_the_unit_of_the_map(world) -> None:
    """A frame whose unit is half a metre has twice the numbers, and four times the variances."""
    metric, other = found(world, world.photos[0]), found(world, world.photos[0], metres=0.5)
    assert np.allclose(other.T_map_camera[:3, 3], 2 * metric.T_map_camera[:3, 3])
    assert np.allclose(other.covariance[3:, 3:], 4 * metric.covariance[3:, 3:])
    assert np.allclose(other.covariance[:3, :3], metric.covariance[:3, :3])


def test_an_unknown_focal_length_is_solved_for(world) -> None:
    photo = world.photos[1]
    blind = Photo(photo.rgb, photo.intrinsics_px * [1.15, 1.15, 1, 1], np.inf, "blind")
    one = found(world, blind)
    assert one.is_placed, one.reason
    assert abs(one.intrinsics_px[0] / photo.intrinsics_px[0] - 1) < 0.05
    assert off(one, world.poses[1])[1] < 0.2


def test_a_large_photo_answers_in_its_own_pixels(world) -> None:
    photo = world.photos[0]
    large = Photo(photo.rgb.repeat(2, 0).repeat(2, 1), photo.intrinsics_px * 2, 0.0, "large")
    one = found(world, large)
    assert one.is_placed, one.reason
    assert np.allclose(one.intrinsics_px, photo.intrinsics_px * 2)


@pytest.mark.parametrize(
    ("width", "height", "size"), [(240, 180, (480, 360)), (100, 150, (200, 300)), (960, 600, (480, 300))]
)
def test_small_photos_are_enlarged_twice_at_most(width: int, height: int, size: tuple[int, int]) -> None:
    """Rays through the corners stay as they were; so do masks."""
    rng = np.random.default_rng(0)
    known = np.ones((height, width), bool)
    known[: height // 2] = False
    photo = Photo(
        rng.integers(0, 256, (height, width, 3)).astype(np.uint8), np.array([300.0, 310, 50, 70]), known=known
    )
    picture, scale = localization.scale_photo(photo, 480)
    assert picture.size_px == size
    assert np.allclose(picture.intrinsics_px / photo.intrinsics_px, scale)
    assert np.allclose(scale[:2] * [width, height], size)
    assert picture.mask is not None
    assert not picture.mask[: size[1] // 2].any()
    assert picture.mask[size[1] // 2 + 1 :].all()
    assert picture.rgb.mean() == pytest.approx(photo.rgb.mean() / 255, abs=0.01)


def test_a_small_photo_is_placed_as_exactly_as_what_it_shows(world, monkeypatch) -> None:
    """Half of the width and height: the answer is in its own pixels, and enlarging it makes it more exact."""
    photo = world.photos[1]
    small = np.asarray(Image.fromarray(photo.rgb).resize([side // 2 for side in photo.size_px], Image.Resampling.BOX))
    errors = []
    for enlargement in (localization.MAX_ENLARGEMENT, 1.0):
        monkeypatch.setattr(localization, "MAX_ENLARGEMENT", enlargement)
        given = Photo(small, photo.intrinsics_px / 2)
        found = localize_photo(given, world.index, {"scene": world.placed}, SIFT, Params())
        assert np.allclose(found.intrinsics_px, given.intrinsics_px)
        errors.append(np.linalg.norm(found.T_map_camera[:3, 3] - world.poses[1][:3, 3]))
    assert errors[0] < min(0.02, errors[1])


@pytest.mark.parametrize("name", ["max_views", "max_candidates"])
def test_counts_are_at_least_one(name: str) -> None:
    with pytest.raises(ConfigError):
        Params(**{name: 0})


def test_an_empty_picture_says_so(world) -> None:
    blank = Photo(np.full((120, 160, 3), 128, np.uint8), np.array([128.0, 128, 80, 60]), 0.0, "blank")
    assert "too little" in found(world, blank).reason


def test_the_same_photo_gives_the_same_bits(world) -> None:
    one, two = (found(world, world.photos[1]) for _ in range(2))
    assert np.array_equal(one.T_map_camera, two.T_map_camera)
    assert np.array_equal(one.covariance, two.covariance)
    assert one.probability == two.probability


def test_what_residuals_tell_counts_by_how_well_the_render_agrees(world, monkeypatch) -> None:
    picture, _ = localization.scale_photo(world.photos[1], 480)
    start = PoseCandidate(0, world.poses[1], picture.intrinsics_px, 40, ("scene",))
    one = localization.evaluate_pose(picture, start, {"scene": world.placed}, 0.1)
    doubt = np.exp(2 * covariance.AGREEMENT_SLOPE * (0.5 - one.refined.agreement))
    monkeypatch.setattr(covariance, "AGREEMENT_SLOPE", 0.0)
    other = localization.evaluate_pose(picture, start, {"scene": world.placed}, 0.1)
    assert np.array_equal(one.refined.T_metric_camera, other.refined.T_metric_camera)
    assert one.refined.agreement > 0.5
    hidden = covariance.add_model_error(np.zeros((6, 6)))
    np.testing.assert_allclose(one.covariance - hidden, doubt * (other.covariance - hidden), rtol=1e-6, atol=1e-12)
