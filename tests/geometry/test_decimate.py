from dataclasses import replace

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap.geometry.decimate import decimate
from gsmap.geometry.voxels import covariances, merge_groups, optical_depths, projected_areas, voxel_labels
from gsmap.render import render
from gsmap.types import Cameras, Gaussians


def wall(n: int, colour_of=lambda xy: np.full((len(xy), 3), 0.5), seed: int = 0) -> Gaussians:
    """Flat Gaussians on a square metre of the plane z = 0, of equal size."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0, 1, (n, 2))
    sh = ((colour_of(xy) - 0.5) / 0.28209479177387814)[:, None]
    flat = np.log([n**-0.5, n**-0.5, 1e-4])
    return Gaussians(np.c_[xy, np.zeros(n)], np.tile([1.0, 0, 0, 0], (n, 1)), np.tile(flat, (n, 1)), np.zeros(n), sh)


def moments(g: Gaussians) -> tuple[float, np.ndarray, np.ndarray]:
    mass = optical_depths(g) * projected_areas(g.scales)
    mean = np.average(g.means, axis=0, weights=mass)
    spread = g.means - mean
    return mass.sum(), mean, np.average(covariances(g) + spread[:, :, None] * spread[:, None], axis=0, weights=mass)


@pytest.mark.parametrize("count", [1, 37, 500, 999])
def test_as_many_are_left_as_are_asked_for_and_moments_stay(count):
    g = wall(1000)
    fewer, into = decimate(g, count)
    assert len(fewer) == count
    assert sorted(set(into.tolist())) == list(range(count))
    mean, spread = moments(g)[1:]
    np.testing.assert_allclose(moments(fewer)[1], mean, atol=0.02)
    np.testing.assert_allclose(moments(fewer)[2], spread, atol=0.01)


def test_no_gaussian_is_in_two_pairs_of_a_round():
    from gsmap.geometry.decimate import _cheapest

    pairs = np.concatenate(_cheapest(wall(1000), np.ones(1000), 1000))
    assert len(pairs) > 800
    assert len(set(pairs.tolist())) == len(pairs)


def test_what_is_looked_at_more_keeps_more():
    g = wall(2000, lambda xy: np.stack([np.sin(9 * xy[:, 0]) / 4 + 0.5] * 3, axis=1))
    left = g.means[:, 0] < 0.5
    fewer, _ = decimate(g, 500, np.where(left, 9.0, 1.0))
    assert (fewer.means[:, 0] < 0.5).sum() > 1.25 * (fewer.means[:, 0] >= 0.5).sum()
    # Where nobody looked, and where all look alike, it is as without.
    plain, into = decimate(g, 500)
    assert abs((plain.means[:, 0] < 0.5).sum() - 250) < 50
    for pixels in (np.zeros(2000), np.full(2000, 3.0) * projected_areas(g.scales)):
        np.testing.assert_array_equal(decimate(g, 500, pixels)[1], into)


def test_few_enough_are_left_as_they_are():
    g = wall(50)
    same, into = decimate(g, 50)
    assert same is g
    np.testing.assert_array_equal(into, np.arange(50))
    with pytest.raises(ConfigError, match="at least one"):
        decimate(g, 0)


def mixed(into: np.ndarray, part: np.ndarray) -> float:
    """Share of the groups that hold some of both parts."""
    share = np.bincount(into, part) / np.bincount(into)
    return float(((share > 0) & (share < 1)).mean())


def test_colours_meet_late():
    """Half the wall red, half of it blue: one stands for many of its colour, hardly any for both."""
    g = wall(2000, lambda xy: np.where(xy[:, :1] < 0.5, [[0.9, 0.1, 0.1]], [[0.1, 0.1, 0.9]]))
    red = g.means[:, 0] < 0.5
    _, into = decimate(g, 100)
    assert mixed(into, red) < 0.05
    plain = replace(g, sh=np.zeros_like(g.sh))
    assert mixed(decimate(plain, 100)[1], red) > 0.08


def test_what_stands_apart_stays_apart():
    """Two parallel walls a hand's breadth from each other, which voxels of this size mix."""
    front = wall(800)
    back = replace(wall(800, seed=1), means=wall(800, seed=1).means + np.float32([0, 0, 0.1]))
    both, side = Gaussians.concatenate([front, back]), np.arange(1600) >= 800
    _, into = decimate(both, 60)
    by_voxel = voxel_labels(both.means, 0.19)
    assert by_voxel.max() + 1 <= 60
    assert mixed(into, side) < 0.2 < 0.9 < mixed(by_voxel, side)


def test_pictures_are_better_than_of_as_many_voxels():
    """A wall with a picture on it, of Gaussians of many sizes, from the front."""

    def colour(xy):
        return 0.5 + 0.4 * np.sin(np.c_[9 * xy[:, 0], 23 * xy[:, 1], 40 * xy.sum(1)])

    g = wall(5000, colour)
    sizes = np.random.default_rng(5).normal(0, 0.7, (5000, 1)).astype(np.float32)
    g = replace(g, log_scales=g.log_scales + sizes)
    by_voxel, _ = merge_groups(g, voxel_labels(g.means, 0.036))
    fewer, _ = decimate(g, len(by_voxel))
    pose = np.eye(4)
    pose[:3, 3] = 0.5, 0.5, -1
    camera = Cameras(pose[None], np.array([[80.0, 80, 40, 40]]), np.array([[80, 80]]))
    whole, ours, theirs = (render(x, camera, depth=False, dominant_id=False).colour[0] for x in (g, fewer, by_voxel))
    assert ((ours - whole) ** 2).mean() < 0.5 * ((theirs - whole) ** 2).mean()


def test_the_kernel_refuses_what_does_not_fit_together():
    from gsmap._native import pair_costs

    three, six, one = np.zeros((4, 3)), np.ones((4, 6)), np.ones(4)
    with pytest.raises(ValueError, match="one length"):
        pair_costs(three, six, one[:3], one, three, np.zeros((1, 2), np.int32), 0.1, 0.1)
    for pair in ([0, 4], [-1, 0]):
        with pytest.raises(ValueError, match="not there"):
            pair_costs(three, six, one, one, three, np.array([pair], np.int32), 0.1, 0.1)


def test_the_cost_is_the_energy_of_the_difference():
    """Of two blurred round Gaussians in one place nothing is lost; of colours the part that they do not share."""
    from gsmap._native import pair_costs

    def cost(apart: float, colour: float) -> float:
        means = np.array([[0, 0, 0], [apart, 0, 0]])
        round_ = np.tile([1.0, 0, 0, 1, 0, 1], (2, 1))
        area = np.pi
        opacity = 1e-3  # thin: transmittances add
        mass = np.full(2, -np.log1p(-opacity) * area)
        colours = np.array([[1.0, 1, 1], [colour, colour, colour]])
        return float(pair_costs(means, round_, mass, np.full(2, opacity), colours, np.int32([[0, 1]]), 0.0, 0.0)[0])

    scale = 1e-6 * np.pi * 3
    assert cost(0, 1) < 1e-3 * scale
    assert cost(0, 0.5) == pytest.approx(0, abs=1e-3 * scale)  # where they lie on each other light adds
    assert cost(0.5, 1) < cost(1, 1) < cost(2, 1)
    # Far apart: both, and the one that is drawn in the middle and shares nothing with either.
    assert cost(60, 1) > 1.5 * scale
    assert cost(2, 0) > 0.1 * scale  # light is carried to where there was none
