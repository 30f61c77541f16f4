"""The native kernels of landmarks against what they compute, written plainly."""

from dataclasses import replace

import numpy as np
import pytest
from describe_places import room
from scipy.ndimage import gaussian_filter, maximum_filter

from gsmap import _native
from gsmap._native import landmark_surroundings
from gsmap.describe import Params, describe
from gsmap.describe.cloud import downsample, surface_cloud
from gsmap.describe.landmarks import detect
from gsmap.describe.landmarks.context import CELL_M, HEIGHTS_M, RADII_M, SHELLS_M, cylinder_context, shell_context
from gsmap.describe.landmarks.detect import find_blobs


@pytest.fixture(scope="module")
def cloud():
    return surface_cloud(room(n=12_000)[0])


def plain_extrema(points, lab, areas, threshold, channel):
    """Positive extrema of one channel on one dense grid, in cells: see `find_blobs`."""
    low = np.floor(points.min(0)) - 3
    shape = tuple((np.floor(points.max(0)) - low + 4).astype(int))
    fields = np.zeros((2, *shape))
    base = np.floor(points - low - 0.5).astype(int)
    t = points - low - 0.5 - base
    for corner in np.ndindex(2, 2, 2):
        share = np.where(corner, t, 1 - t).prod(1) * areas
        for field, value in zip(fields, (np.ones(len(points)), lab[:, channel] - 50 * (channel == 0)), strict=True):
            np.add.at(field, tuple((base + corner).T), share * value)
    wide = 1.6 * np.sqrt(1.8**2 - 1)
    near = [gaussian_filter(f, 1.6, truncate=3.0, mode="constant") for f in fields]
    far = [gaussian_filter(f, wide, truncate=3.0, mode="constant") for f in near]
    surface = near[0] * np.sqrt(2 * np.pi) * 1.6 > 0.3
    response = np.where(surface, near[1] / np.maximum(near[0], 1e-9) - far[1] / np.maximum(far[0], 1e-9), 0)
    peaks = (response > threshold) & (response == maximum_filter(response, 5, mode="constant"))
    return np.argwhere(peaks) + low + 0.5, response[peaks] / threshold


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("channel", [0, 1, 2])
def test_extrema_are_those_of_the_plain_computation(cloud, channel):
    size = 0.1
    # Clear of the edges of the grid's blocks.
    points, lab, areas = cloud.points / size + 30, cloud.lab.astype(float), cloud.areas / size**2
    thresholds = np.array([2.6, 2.0, 2.0, 0.6])
    found = [(at, ratio) for c, negative, at, ratio in detect._extrema(points, lab, areas, thresholds)
             if c == channel and not negative]  # fmt: skip
    (at, ratio), (expected, strong) = found[0], plain_extrema(points, lab, areas, thresholds[channel], channel)
    assert len(expected) > 15
    distance = np.linalg.norm(at[:, None] - expected[None], axis=2)
    # Positions are refined within the window; of two equal peaks within one, rounding may leave either.
    assert distance.min(0).max() < 4.0
    assert distance.min(1).max() < 2.5
    assert abs(len(at) - len(expected)) <= 0.2 * len(expected)
    np.testing.assert_allclose(ratio, strong[distance.argmin(1)], rtol=1e-3)


def test_every_instruction_set_finds_the_same_extrema(cloud, instruction_set):
    args = cloud.points, cloud.lab.astype(float), cloud.areas, np.array([2.6, 2.0, 2.0, 0.6]), 0.1
    found = list(detect._extrema(*args))
    _native.use_instruction_set("baseline")
    plain = list(detect._extrema(*args))
    assert sum(len(at) for _, _, at, _ in plain) > 100
    for (*kind, at, ratio), (*expected, where, strong) in zip(found, plain, strict=True):
        assert kind == expected, instruction_set
        np.testing.assert_array_equal(at, where)
        np.testing.assert_array_equal(ratio, strong)


def test_extrema_of_points_in_any_unit_are_those_of_points_in_cells(cloud):
    size, thresholds = 0.1, np.array([2.6, 2.0, 2.0, 0.6])
    lab = cloud.lab.astype(float)
    given = list(detect._extrema(cloud.points, lab, cloud.areas, thresholds, size))
    scaled = list(detect._extrema(cloud.points / size, lab, cloud.areas / size**2, thresholds))
    assert sum(len(at) for _, _, at, _ in given) > 100
    for (*kind, at, ratio), (*expected, where, strong) in zip(given, scaled, strict=True):
        assert kind == expected
        np.testing.assert_array_equal(at, where)
        np.testing.assert_array_equal(ratio, strong)


def test_blocks_find_what_one_grid_finds(cloud, monkeypatch):
    args = cloud.points, cloud.lab, cloud.areas
    whole = find_blobs(*args)
    monkeypatch.setattr(detect, "_BLOCK_CELLS", 40)
    parts = find_blobs(*args)
    assert len(whole) > 100
    distance = np.linalg.norm(whole.positions[:, None] - parts.positions[None], axis=2).min(1)
    assert (distance < 0.01).mean() > 0.95


def test_surroundings_are_the_means_of_what_lies_in_each_ring(cloud):
    rng = np.random.default_rng(0)
    positions = cloud.points[rng.integers(len(cloud), size=7)] + rng.normal(size=(7, 3)) * 0.05
    thin, colour = downsample(cloud.points, cloud.lab, CELL_M)
    values = (colour - [55.0, 3.0, 8.0]) / [20.0, 10.0, 14.0]
    cylinders = cylinder_context(positions, cloud.points, cloud.lab)
    shells = shell_context(positions, cloud.points, cloud.lab)
    levels = len(HEIGHTS_M) - 1
    for row, position in enumerate(positions):
        step = thin - position
        ring, level = (
            np.searchsorted(RADII_M, np.hypot(*step[:, :2].T)),
            np.searchsorted(HEIGHTS_M, step[:, 2]) - 1,
        )
        shell = np.searchsorted(SHELLS_M, np.linalg.norm(step, axis=1))
        for i in range(len(RADII_M)):
            for j in range(levels):
                inside = (ring == i) & (level == j)
                expected = values[inside].mean(0) if inside.any() else np.zeros(3)
                np.testing.assert_allclose(cylinders[row, i * levels + j, :3], expected, atol=1e-9)
                assert (cylinders[row, i * levels + j, 3] > 0) == inside.any()
        for i in range(len(SHELLS_M)):
            inside = shell == i
            expected = values[inside].mean(0) if inside.any() else np.zeros(3)
            np.testing.assert_allclose(shells[row, i, :3], expected, atol=1e-9)


def test_strays_a_hundred_thousand_kilometres_out_change_no_landmark_of_the_room():
    gaussians, cameras = room(n=6000)
    graphs = []
    for far in (50.0, 1e8):
        means = gaussians.means.copy()
        means[:40] = np.repeat(far * np.array([[1.0, -0.7, 0.9], [0.6, -1.0, 0.8]]), 20, axis=0)
        graphs.append(describe("x", replace(gaussians, means=means), cameras, Params(objects=False, things=False)))
    for near, far in zip(*(g.layers["landmarks"].positions for g in graphs), strict=True):
        np.testing.assert_allclose(near, far, atol=5e-3)


def test_nothing_around_is_no_error():
    graph = describe("none", room(n=100)[0][:0], None, Params(objects=False))
    assert graph.num_nodes == 0


def test_what_lies_on_the_edge_of_a_ring_is_of_the_inner_one():
    radii, heights = np.array([0.2, 0.45, 0.75, 1.1]), np.array([-0.65, -0.12, 0.12, 0.65])
    rng = np.random.default_rng(3)
    # To the last digit before, on and behind the edges, where a root and a square round apart.
    far = np.concatenate([np.nextafter(radii, 0), radii, np.nextafter(radii, 2)])
    turn = rng.uniform(0, 2 * np.pi, (200, len(far)))
    steps = np.stack([far * np.cos(turn), far * np.sin(turn), rng.choice(heights, turn.shape)], axis=-1).reshape(-1, 3)
    values = rng.normal(size=steps.shape)
    sums, counts = landmark_surroundings(
        positions=np.zeros((1, 3)), points=steps, values=values, radii=radii, heights=heights
    )
    x, y, z = steps.T
    ring, level = np.searchsorted(radii, np.sqrt(x * x + y * y)), np.searchsorted(heights, z) - 1
    inside = (ring < len(radii)) & (level >= 0)
    bins = (ring * (len(heights) - 1) + level)[inside]
    np.testing.assert_array_equal(counts[0], np.bincount(bins, minlength=counts.shape[1]))
    np.testing.assert_allclose(sums[0, :, 1], np.bincount(bins, values[inside, 1], counts.shape[1]), atol=1e-12)
