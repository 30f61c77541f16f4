"""Parts of localisation beside arithmetic: adjustment, tracks, matches, views, pictures in files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from raising import raises
from scipy.ndimage import gaussian_filter, shift

from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import Lens, covariance, matching, read_photo, resection, tracking, views
from gsmap.localize.extractors import sift
from gsmap.localize.features import lift, quantize, scene_features, to_uint8
from gsmap.localize.resection import retract_pose
from gsmap.render import render
from gsmap.types.localization import Keypoints

SIFT = sift.make({}, sift.Params())
LENS = np.array([400.0, 390.0, 240.0, 180.0])


def points_seen(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pose, points before it, and where it sees them."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    local = np.stack([rng.uniform(-1, 1, count), rng.uniform(-0.8, 0.8, count), rng.uniform(2, 5, count)], 1)
    points = local @ pose[:3, :3].T + pose[:3, 3]
    return pose, points, project(points, np.linalg.inv(pose), LENS)[0]


def test_a_pose_is_found_among_wrong_matches() -> None:
    pose, points, pixels = points_seen(80)
    rng = np.random.default_rng(1)
    pixels[:40] = rng.uniform(0, 480, (40, 2))
    found = resection.resect(pixels, points, LENS, (480, 360), 0.0)
    assert found is not None
    assert found.inliers[40:].all()
    refined = resection.refine(pixels, points, found.T_map_camera, LENS)
    assert np.allclose(refined.T_map_camera, pose, atol=1e-3)


def test_the_focal_length_is_found_with_the_pose() -> None:
    pose, points, pixels = points_seen(60)
    start = retract_pose(pose, np.full(6, 0.01))
    lens = np.array([430.0, 430.0, 240.0, 180.0]) * [1, 390 / 400, 1, 1]
    refined = resection.refine(pixels, points, start, lens, focal=(430.0, np.inf))
    assert refined.intrinsics_px[0] == pytest.approx(400, abs=0.01)
    assert np.allclose(refined.T_map_camera, pose, atol=1e-5)


def test_the_jacobian_is_that_of_differences(monkeypatch) -> None:
    pose, points, pixels = points_seen(5)
    monkeypatch.setattr(resection, "ITERATIONS", 0)
    at = resection.refine(pixels, points, pose, LENS, focal=(400.0, np.inf))
    for k in range(7):
        step = np.zeros(6)
        lens = LENS.copy()
        if k < 6:
            step[k] = 1e-6
        else:
            lens[:2] *= np.exp(1e-6)
        after = resection.refine(pixels, points, retract_pose(pose, step), lens)
        numeric = (at.residuals_px - after.residuals_px) / 1e-6
        assert np.allclose(numeric, at.jacobian[:, :, k], rtol=1e-3, atol=1e-2)


def test_a_render_that_agrees_less_is_less_sure() -> None:
    """The median error of poses on made places falls fourfold from an agreement of .35 to one of .75."""
    sure, unsure = (float(covariance.agreement_scale(agreement)) for agreement in (0.75, 0.35))
    assert sure < 1 < unsure
    assert 1.5 < unsure / sure < 6
    assert covariance.agreement_scale(0.1, 0.0) == 1


def test_the_covariance_is_that_of_repeated_noise(monkeypatch) -> None:
    """Independent noise of a pixel: what the residuals tell is what repetitions show, within a factor."""
    pose, points, clean = points_seen(300)
    rng = np.random.default_rng(2)
    monkeypatch.setattr(covariance, "PATCH_SCALE", 1.0)
    monkeypatch.setattr(covariance, "MODEL_SIGMA_M", 0.0)
    monkeypatch.setattr(covariance, "MODEL_SIGMA_RAD", 0.0)
    monkeypatch.setattr(resection, "ROBUST_SCALE_PX", 10.0)
    errors, told = [], []
    for _ in range(60):
        pixels = clean + rng.normal(size=clean.shape)
        fit = resection.refine(pixels, points, pose, LENS)
        errors.append(np.linalg.inv(pose)[:3] @ fit.T_map_camera[:, 3])
        residual = covariance.patch_covariance(fit, pixels, (480, 360), 0.0)
        told.append(np.diag(covariance.add_model_error(residual))[3:])
    ratio = np.mean(told, axis=0) / np.mean(np.square(errors), axis=0)
    assert (ratio > 0.7).all()
    assert (ratio < 4.0).all()


def test_patches_are_found_again_to_a_tenth_of_a_pixel() -> None:
    rng = np.random.default_rng(0)
    picture = gaussian_filter(rng.random((120, 160)), 2.0).astype(np.float32)
    picture = (picture - picture.min()) / (picture.max() - picture.min())
    there = shift(picture, (3.3, -2.6), order=3, mode="nearest").astype(np.float32)
    found = tracking.track(picture, np.ones(picture.shape, bool), 0.5 * there + 0.2, 6)
    assert found.found.sum() > 20
    moved_by = (found.photo_px - found.render_px)[found.found]
    assert np.abs(np.median(moved_by, axis=0) - [-2.6, 3.3]).max() < 0.1


def test_what_is_farther_than_the_reach_is_not_found() -> None:
    rng = np.random.default_rng(0)
    picture = gaussian_filter(rng.random((120, 160)), 2.0).astype(np.float32) * 5 - 2
    there = np.roll(picture, 15, axis=1)
    found = tracking.track(picture, np.ones(picture.shape, bool), there, 5)
    assert found.found.mean() < 0.1


def test_matches_agree_both_ways_and_in_how_the_camera_was_held() -> None:
    rng = np.random.default_rng(0)
    vectors = rng.normal(size=(50, 64)).astype(np.float32)
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    angles = rng.integers(0, 256, 50).astype(np.uint8)
    order = rng.permutation(50)
    turned = (angles[order] + np.uint8(40)).astype(np.uint8)
    turned[:5] += np.uint8(100)
    photo = matching.FeatureSet(quantize(vectors), angles)
    rows, columns = matching.match_features(photo, matching.FeatureSet(quantize(vectors[order]), turned))
    assert (order[columns] == rows).all()
    assert sorted(columns) == list(range(5, 50))


def test_views_are_few_and_some_stand_off_the_path(world) -> None:
    params = views.Params(max_own_views=10, max_synthetic_views=4)
    chosen = views.select_views(world.capture.gaussians, world.capture.cameras, params)
    own = {tuple(c) for c in np.round(world.capture.cameras.centers, 6)}
    stand = [tuple(c) in own for c in np.round(chosen.centers, 6)]
    assert sum(stand) == 10
    assert 1 <= len(stand) - sum(stand) <= 4
    assert chosen.sizes_px.max() <= params.image_size_px


def test_features_lie_on_the_surface(world) -> None:
    """Every stored point lies near a Gaussian's centre."""
    from scipy.spatial import cKDTree

    solid = world.capture.gaussians.means[world.capture.gaussians.opacities > 0.5]
    distance, _ = cKDTree(solid).query(world.placed.features.points)
    assert np.quantile(distance, 0.95) < 0.1


class Sized:
    """The built-in features, with sizes of our own or with none."""

    def __init__(self, sizes: np.ndarray | None) -> None:
        self.sizes = sizes

    def extract(self, rgb: np.ndarray) -> Keypoints:
        found = SIFT.extract(rgb)
        sizes = None if self.sizes is None else self.sizes[: len(found)]
        return replace(found, sizes_px=sizes)


def test_the_largest_features_of_a_view_come_first(world) -> None:
    """Photographs are looked for by the first ones; where an extractor says no sizes its order stays."""
    few = views.Params(max_own_views=1, max_synthetic_views=0)
    given = (world.capture.gaussians, world.capture.cameras)
    sizes = np.random.default_rng(0).permutation(2000).astype(np.float32)
    as_found = scene_features("scene", *given, Sized(None), few)
    by_size = scene_features("scene", *given, Sized(sizes), few)
    shown = render(given[0], as_found.cameras[[0]], dominant_id=False, backend="native")
    found = SIFT.extract(to_uint8(shown))
    rows, places = lift(found, shown, as_found.cameras[[0]])
    order = np.argsort(-sizes[rows])
    assert len(rows) > 50
    assert np.array_equal(as_found.points, places.astype(np.float32))
    assert np.array_equal(by_size.points, places[order].astype(np.float32))
    assert np.array_equal(by_size.descriptors, as_found.descriptors[order])
    assert np.array_equal(by_size.angles, as_found.angles[order])
    assert scene_features("scene", *given, Sized(None), replace(few, max_features=20)).num_features == 20


def exif_file(path, focal_mm: int, orientation: int = 1, size: tuple[int, int] = (400, 300)) -> None:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = focal_mm
    Image.new("RGB", size, (90, 90, 90)).save(path, exif=exif.tobytes())


def test_focal_lengths_come_from_whoever_tells(tmp_path) -> None:
    exif_file(tmp_path / "a.jpg", 26)
    told = read_photo(tmp_path / "a.jpg")
    assert told.intrinsics_px[0] == pytest.approx(26 / 43.267 * 500)
    assert 0 < told.focal_sigma < 0.2
    assert np.isinf(read_photo(tmp_path / "a.jpg", Lens(use_exif=False)).focal_sigma)
    assert read_photo(tmp_path / "a.jpg", Lens(focal_px=333.0)).intrinsics_px.tolist() == [333, 333, 200, 150]
    assert read_photo(tmp_path / "a.jpg", Lens((300, 301, 199, 151))).focal_sigma == 0


def test_pictures_stand_upright(tmp_path) -> None:
    exif_file(tmp_path / "a.jpg", 26, orientation=6)
    assert read_photo(tmp_path / "a.jpg").size_px == (300, 400)


def test_what_cannot_be_is_refused(tmp_path) -> None:
    with raises(NotFoundError, code="file_not_found"):
        read_photo(tmp_path / "none.jpg")
    (tmp_path / "text.jpg").write_text("no picture")
    with raises(InputError, code="picture_unreadable"):
        read_photo(tmp_path / "text.jpg")
    exif_file(tmp_path / "a.jpg", 26)
    with raises(InputError, code="invalid_intrinsics"):
        read_photo(tmp_path / "a.jpg", Lens((300, 300, 900, 100)))
    with pytest.raises(ConfigError):
        Lens(focal_px=-1.0)
