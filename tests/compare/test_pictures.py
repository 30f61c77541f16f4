"""Kernels over small pictures, beside plain numpy."""

import numpy as np
import pytest

from gsmap._native import add_colours, beyond_ranges, count_observations, depth_ranges, place_points, tones_apart
from gsmap.geometry.projection import in_image, project
from gsmap.geometry.rotations import exp_so3

SIZES = [(1, 1), (1, 5), (7, 1), (8, 9), (37, 20)]


def over_3x3(values, pick):
    padded = np.pad(values, 1, mode="edge")
    height, width = values.shape
    return pick([padded[y : y + height, x : x + width] for y in range(3) for x in range(3)], axis=0)


def drawn(size, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(0, 1, (*size, 3)).astype(np.float32), rng.random(size) > 0.3


@pytest.mark.parametrize("size", SIZES)
def test_the_nearest_and_the_farthest_around_a_pixel(size):
    picture, opaque = drawn(size)
    near, far = depth_ranges(depth=picture[..., 0].copy(), opaque=opaque)
    np.testing.assert_array_equal(near, over_3x3(np.where(opaque, picture[..., 0], np.inf), np.min))
    np.testing.assert_array_equal(far, over_3x3(np.where(opaque, picture[..., 0], -np.inf), np.max))


@pytest.mark.parametrize("size", SIZES)
def test_what_no_pixel_nearby_explains(size):
    (a, both), (b, _) = drawn(size), drawn(size, 1)
    slope, offset = np.float32([0.9, 1.0, 1.1]), np.float32([0.1, 0.0, -0.2])
    apart, brightest = tones_apart(a=a, b=b, both=both, slope=slope, offset=offset)
    a = a * slope + offset
    np.testing.assert_array_equal(brightest, np.maximum(a, b).max(-1))
    for k, tone in enumerate((lambda v: v[..., 0] - v[..., 1], lambda v: v[..., 2] - v[..., 1], lambda v: v.mean(-1))):
        low_a, low_b = (over_3x3(np.where(both, tone(v), 1e3), np.min) for v in (a, b))
        high_a, high_b = (over_3x3(np.where(both, tone(v), -1e3), np.max) for v in (a, b))
        expected = np.where(both, np.maximum(low_b - high_a, 0) + np.minimum(high_b - low_a, 0), 0)
        np.testing.assert_allclose(apart[..., k], expected, atol=1e-5)


@pytest.mark.parametrize("size", SIZES)
def test_how_far_a_colour_lies_beyond_those_around(size):
    a, b = drawn(size)[0], drawn(size, 1)[0]
    low, high = (np.stack([over_3x3(a[..., k], pick) for k in range(3)], axis=-1) for pick in (np.min, np.max))
    np.testing.assert_array_equal(beyond_ranges(a, b), b - np.clip(b, low, high))


def test_points_are_placed_where_they_are_projected():
    points = np.random.default_rng(0).uniform(-2, 2, (500, 3)).astype(np.float32)
    pose, lens = np.eye(4), np.array([50.0, 55.0, 30.0, 20.0])
    pose[:3, 3] = 0.1, -0.2, 0.5
    index, row, column, z = place_points(points, pose=pose, lens=lens, width=60, height=40, nearest=0.2)
    pixels, depth = project(points, pose, lens)
    expected = np.flatnonzero(in_image(pixels, depth, np.array([60, 40]), near=0.2))
    np.testing.assert_array_equal(index, expected)
    np.testing.assert_array_equal(np.stack([column, row], axis=1), pixels[expected].astype(int))
    np.testing.assert_allclose(z, depth[expected], rtol=1e-6)
    assert len(expected) > 20


def test_observations_of_points_on_a_surface_are_counted():
    rng = np.random.default_rng(1)
    points = rng.uniform(-2, 2, (500, 3)).astype(np.float32)
    pose, lens = np.eye(4), np.array([50.0, 55.0, 30.0, 20.0])
    pose[:3, :3], pose[:3, 3] = exp_so3(np.array([[0.1, -0.2, 0.3]]))[0], (0.1, -0.2, 0.5)
    near = rng.uniform(0.5, 2, (40, 60)).astype(np.float32)
    far = near + rng.uniform(0, 2, near.shape).astype(np.float32)
    spans, axes = np.array([[10, 200], [300, 450]]), np.concatenate([np.eye(3), -np.eye(3)])
    seen, bits, sharpness = np.ones(500, np.int32), np.full(500, 1 << 9, np.uint32), np.zeros(500, np.float32)
    options = {"nearest": 0.2, "margin": 0.03, "axes": axes, "min_cosine": 0.5}
    counts = {"times_seen": seen, "directions": bits, "sharpness": sharpness}
    count_observations(points, spans, pose, lens, near, far, **options, **counts)

    pixels, depth = project(points, pose, lens)
    asked = np.zeros(500, bool)
    asked[10:200] = asked[300:450] = True
    rows = np.flatnonzero(asked & in_image(pixels, depth, np.array([60, 40]), near=0.2))
    column, row = pixels[rows].astype(int).T
    on = rows[(depth[rows] > near[row, column] - 0.03) & (depth[rows] < far[row, column] + 0.03)]
    assert 10 < len(on) < len(rows)
    expected = np.ones(500, int)
    expected[on] += 1
    np.testing.assert_array_equal(seen, expected)
    np.testing.assert_allclose(sharpness[on], (50 / depth[on]) ** 2, rtol=1e-5)
    rays = np.linalg.inv(pose)[:3, 3] - points
    is_near = rays @ axes.T > 0.5 * np.linalg.norm(rays, axis=1, keepdims=True)
    is_near[expected == 1] = False
    np.testing.assert_array_equal(bits, (1 << 9) + is_near @ (1 << np.arange(6)))


def test_a_point_outside_of_the_picture_is_refused():
    one, plane = np.zeros(1, np.int32), np.zeros((4, 5), np.float32)
    pictures = {"depth": plane, "one": plane > 0, "chroma": np.zeros((4, 5, 2), np.float32), "lightness": plane}
    sums = {"chroma_sum": np.zeros((3, 2), np.float32), "lightness_sum": np.zeros(3, np.float32)}
    more = {"base": 0.1, "share": 0.0, "colour_seen": np.zeros(3, np.int32)} | pictures | sums
    add_colours(one, one, one, np.zeros(1, np.float32), **more)
    for wrong in ((one + 3, one, one), (one, one + 4, one), (one, one, one + 5), (one - 1, one, one)):
        with pytest.raises(ValueError, match="outside"):
            add_colours(*wrong, np.zeros(1, np.float32), **more)
    with pytest.raises(ValueError, match="one size"):
        add_colours(one, one, one, np.zeros(1, np.float32), **more | {"one": np.zeros((4, 4), bool)})
