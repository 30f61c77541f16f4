"""What a small map rounds, and how little of it is lost: each array beside what it was made of."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.sh import SH_C0, rgb_of_sh0
from gsmap.geometry.transforms import sh_basis
from gsmap.localize import compression, packed_features, packed_gaussians, reduction
from gsmap.types import Cameras, Gaussians


def _some(count: int, sh_degree: int = 0, seed: int = 0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-3, 5, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal([-4, -3.5, -6], 0.4, (count, 3)).astype(np.float32),
        rng.normal(size=count).astype(np.float32) * 2,
        rng.normal(size=(count, (sh_degree + 1) ** 2, 3)).astype(np.float32) * 0.5,
    )


def _log_covariances(gaussians: Gaussians) -> np.ndarray:
    turned = quats_to_matrices(gaussians.quats.astype(np.float64))
    return np.einsum("nij,nj,nkj->nik", turned, gaussians.log_scales.astype(np.float64), turned)


def _beside(gaussians: Gaussians, back: Gaussians) -> np.ndarray:
    """(N,) which of the Gaussians each of those that came back is: the order has changed."""
    from scipy.spatial import cKDTree

    away, rows = cKDTree(gaussians.means).query(back.means)
    assert len(np.unique(rows)) == len(gaussians) == len(back)
    assert away.max() < 0.1
    return rows


def _bytes(arrays: dict[str, np.ndarray]) -> int:
    return sum(array.nbytes for array in arrays.values())


# --- streams ----------------------------------------------------------------------------------------------------------


def test_bytes_come_back_and_others_are_told() -> None:
    values = np.random.default_rng(1).integers(0, 7, (3, 500)).astype(np.uint8)
    stream = compression.compress(values)
    assert len(stream) < values.nbytes / 2
    assert np.array_equal(compression.decompress(stream, (3, 500), np.uint8), values)
    for wrong in (stream[: len(stream) // 2], stream.astype(np.int64), np.full(40, 255, np.uint8)):
        with pytest.raises(ValueError, match="LZMA stream"):
            compression.decompress(wrong, (3, 500), np.uint8)
    for shape in ((3, 499), (3, 501)):
        with pytest.raises(ValueError, match="differ in size"):
            compression.decompress(stream, shape, np.uint8)


def test_bytes_are_not_expanded_beyond_what_is_asked_for() -> None:
    bomb = compression.compress(np.zeros(1 << 24, np.uint8))
    assert len(bomb) < 1 << 15
    with pytest.raises(ValueError, match="differ in size"):
        compression.decompress(bomb, (10,), np.uint8)


def test_places_are_steps_along_a_curve_within_each_run() -> None:
    points = np.random.default_rng(2).uniform(-40, 60, (300, 3))
    low, step = points.min(0), 0.01
    starts = np.array([0, 0, 120, 300, 300])  # runs without places as well
    codes = compression.encode_points(points, low, step)
    for a, b in ((0, 120), (120, 300)):
        codes[a:b].sort()
    again = compression.codes_from_steps(compression.code_steps(codes, starts), starts)
    assert np.array_equal(again, codes)
    places = compression.decode_points(compression.encode_points(points, low, step), low, step)
    assert np.abs(places - points).max() <= step / 2 * 1.0001


def test_a_step_that_the_curve_cannot_count_is_made_larger() -> None:
    points = np.array([[0.0, 0, 0], [4e6, 1, 2]])
    step = compression.finest_step(points, 1e-3)
    assert step > 1e-3
    places = compression.decode_points(compression.encode_points(points, points[0], step), points[0], step)
    assert np.abs(places - points).max() <= step


# --- Gaussians --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coarse", [0.5, 1.5])
def test_gaussians_are_rounded_by_no_more_than_half_of_their_steps(coarse) -> None:
    gaussians = _some(3000)
    back = packed_gaussians.unpack(packed_gaussians.pack(gaussians, coarse), 3000)
    rows = _beside(gaussians, back)
    assert np.abs(back.means - gaussians.means[rows]).max() < coarse * packed_gaussians.place_step(gaussians) * 0.501
    off = np.abs(_log_covariances(back) - _log_covariances(gaussians)[rows])
    assert off.max() < 0.5 * coarse * (0.08 + 2 * 0.15) * 1.01, "the last of the diagonal is what the others leave"
    assert np.abs(back.sh[:, 0] - gaussians.sh[rows, 0]).max() < 0.5 * coarse * (0.05 + 0.1) * 1.01
    opacity = 1 / (1 + np.exp(-np.stack([back.logit_opacities, gaussians.logit_opacities[rows]])))
    assert np.abs(opacity[0] - opacity[1]).max() <= 0.5 / 15 * 1.01


def test_a_round_gaussian_says_nothing_of_how_it_is_turned() -> None:
    gaussians = _some(3000)
    still = replace(gaussians, log_scales=np.full((3000, 3), -4.0, np.float32))
    assert _bytes(packed_gaussians.pack(still)) < _bytes(packed_gaussians.pack(gaussians)) - 3 * 3000


def test_gaussians_of_a_capture_take_six_bytes_and_a_bit(world) -> None:
    gaussians = world.capture.gaussians
    assert _bytes(packed_gaussians.pack(gaussians)) < 6.5 * len(gaussians)


def test_no_gaussians_and_one_are_packed_as_well() -> None:
    for count in (0, 1):
        assert len(packed_gaussians.unpack(packed_gaussians.pack(_some(count)), 10)) == count


@pytest.mark.parametrize(
    "damage",
    [
        {"gaussians.grid": np.r_[4000.0, 0, 0, 0, 1]},
        {"gaussians.grid": np.r_[-1.0, 0, 0, 0, 1]},
        {"gaussians.grid": np.full(5, np.nan)},
        {"gaussians.ranges": np.zeros((2, 8))},
        {"gaussians.shapes": np.zeros(7, np.uint8)},
    ],
)
def test_damaged_gaussians_are_told(damage) -> None:
    with pytest.raises(ValueError):
        packed_gaussians.unpack(packed_gaussians.pack(_some(50)) | damage, 3000)


def test_more_gaussians_than_there_may_be_are_not_unpacked() -> None:
    arrays = packed_gaussians.pack(_some(50))
    assert len(packed_gaussians.unpack(arrays, 50)) == 50
    with pytest.raises(ValueError, match="50 Gaussians"):
        packed_gaussians.unpack(arrays, 49)


# --- features ---------------------------------------------------------------------------------------------------------


def test_features_come_back_near_to_what_they_were(world) -> None:
    features, step, first = world.placed.features, 0.004, 50
    arrays = packed_features.pack(features, step, first)
    assert _bytes(arrays) < 40 * features.num_features
    back = packed_features.unpack("scene", arrays, features.num_features)
    assert np.array_equal(back.starts, features.starts)
    assert np.array_equal(back.cameras.T_frame_camera, features.cameras.T_frame_camera)
    for a, b in zip(features.starts[:-1], features.starts[1:], strict=True):
        for begin, end in ((a, min(a + first, b)), (min(a + first, b), b)):  # the first of a view stay the first
            if begin == end:
                continue
            away = np.linalg.norm(back.points[begin:end, None] - features.points[None, begin:end], axis=2)
            alike = back.descriptors[begin:end].astype(float) @ features.descriptors[begin:end].T.astype(float) / 254**2
            fits = np.where(away <= step, alike, -1)  # several features may lie at one place
            assert fits.max(1).min() > 0.8
            rows = fits.argmax(1)
            assert (back.angles[begin:end] == features.angles[begin + rows]).mean() > 0.98
            assert np.median(fits.max(1)) > 0.97
    assert np.abs(np.linalg.norm(back.descriptors.astype(float), axis=1) - 254).max() < 8


def test_descriptors_with_both_signs_are_packed(world) -> None:
    """Those of networks have them, and what they differ by from their mean does not fit a byte."""
    features = world.placed.features
    rng = np.random.default_rng(5)
    values = rng.normal(size=(features.num_features, 32))
    values[:, 0] = np.where(rng.random(len(values)) < 0.8, 110, -110)
    values[:, 1:] *= np.sqrt(254**2 - 110**2) / np.linalg.norm(values[:, 1:], axis=1, keepdims=True)
    order = np.arange(features.num_features)
    one = replace(features, points=np.stack([order, 0 * order, 0 * order], axis=1).astype(np.float32))
    signed = replace(one, descriptors=np.clip(np.round(values), -127, 127).astype(np.int8))
    back = packed_features.unpack("scene", packed_features.pack(signed, 0.5, 0), features.num_features)
    assert np.array_equal(back.points[:, 0], order)
    a, b = back.descriptors.astype(float), signed.descriptors.astype(float)
    cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
    assert cosine.min() > 0.95


def test_a_scene_without_features_is_packed_as_well(world) -> None:
    none = reduction.limit_features(world.placed.features, 0)
    few = reduction.limit_features(none, 0)
    empty = replace(
        few,
        starts=np.zeros(len(few.starts), np.int64),
        points=few.points[:0],
        descriptors=few.descriptors[:0],
        angles=few.angles[:0],
    )
    back = packed_features.unpack("scene", packed_features.pack(empty, 0.01, 10), 10)
    assert back.num_features == 0
    assert back.num_views == empty.num_views


@pytest.mark.parametrize(
    "name", ["features.counts", "features.axes", "features.angles", "views.poses", "features.grid"]
)
def test_damaged_features_are_told(world, name) -> None:
    features = world.placed.features
    arrays = packed_features.pack(features, 0.004, 50)
    with pytest.raises(ValueError):
        packed_features.unpack("scene", arrays | {name: arrays[name][:-1]}, features.num_features)
    with pytest.raises(ValueError):
        packed_features.unpack("scene", arrays, features.num_features - 1)


def test_as_many_features_of_every_view_as_there_may_be(world) -> None:
    features = world.placed.features
    counts = np.diff(features.starts)
    for total in (len(counts) * 10, features.num_features // 2, features.num_features - 1, features.num_features):
        fewer = reduction.limit_features(features, total)
        kept = np.diff(fewer.starts)
        assert total - len(counts) < fewer.num_features <= total
        assert np.array_equal(kept, np.minimum(counts, kept.max()))
        assert np.array_equal(fewer.points[fewer.starts[1]], features.points[features.starts[1]])


# --- what shows -------------------------------------------------------------------------------------------------------


def test_a_gaussian_gets_the_colour_that_it_shows_and_a_hidden_one_no_weight() -> None:
    gaussians = _some(3, sh_degree=2, seed=4)
    means = np.array([[0.0, 0, 2], [0.3, 0.1, 2], [0, 0, 40]], np.float32)  # the last one behind the first
    placed = replace(
        gaussians,
        means=means,
        log_scales=np.full((3, 3), -3.0, np.float32) + np.array([[0.0], [0], [-2]], np.float32),
        logit_opacities=np.full(3, 12.0, np.float32),
    )
    cameras = Cameras(np.eye(4)[None], np.array([[200.0, 200, 120, 90]]), np.array([[240, 180]]))
    scene = SimpleNamespace(gaussians=placed)
    weights, coloured = reduction.measure_visibility(scene, cameras)  # type: ignore[arg-type]
    assert weights[:2].min() > 0.5
    assert weights[2] < 0.02
    assert coloured.sh_degree == 0
    for row in (0, 1):
        along = means[row].astype(float) / np.linalg.norm(means[row])
        wanted = 0.5 + sh_basis(along[None], 2)[0] @ placed.sh[row].astype(float)
        assert np.allclose(rgb_of_sh0(coloured.sh[row, 0]), wanted, atol=1e-4)
        assert np.abs(wanted - 0.5 - SH_C0 * placed.sh[row, 0]).max() > 0.05, "that of degree 0 is another"
