"""Floaters are told from the surface, and the surface from floaters."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from gsmap.geometry.floaters import find_floaters


def test_floaters_alone_and_of_a_foreign_colour_stray_and_the_edge_of_a_stripe_does_not():
    rng = np.random.default_rng(0)
    wall = np.c_[rng.uniform(0, 2, (4000, 2)), np.zeros(4000)]
    stripes = np.where(wall[:, :1] % 0.5 < 0.25, 0.2, 0.8) * np.ones(3)
    touching, alone = np.c_[rng.uniform(0.2, 1.8, (40, 2)), np.full(40, 0.01)], rng.uniform(3, 9, (40, 3))
    points = np.concatenate([wall, touching, alone])
    colours = np.concatenate([stripes, np.tile([1.0, 0, 1], (40, 1)), np.tile([0.2, 0.2, 0.2], (40, 1))])
    stray, spacing = find_floaters(points, colours, 0.3)
    assert stray[4000:].all()
    assert stray[:4000].mean() < 0.01
    assert np.median(spacing[:4000]) < 0.1
    turned, _ = find_floaters(points[:, [2, 0, 1]] * 40 + 7, colours, 0.3)
    assert np.array_equal(turned, stray)


def test_a_handful_of_points_does_not_stray():
    stray, spacing = find_floaters(np.eye(3), np.eye(3), 0.1)
    assert not stray.any()
    assert not spacing.any()


def test_floaters_are_those_of_the_plain_computation():
    rng = np.random.default_rng(1)
    points = (rng.normal(size=(800, 3)) ** 3).astype(np.float32)
    colours = rng.uniform(size=(800, 3)).astype(np.float32)
    distances, neighbours = cKDTree(points).query(points, k=9)
    points, colours = points.astype(float), colours.astype(float)
    unlike = np.sort(np.linalg.norm(colours[neighbours[:, 1:]] - colours[:, None], axis=2), axis=1)
    foreign = unlike[:, 1] >= 0.4
    alone = distances[:, 8] > 4 * np.median(distances[:, 8])
    assert min(foreign.sum(), (~foreign).sum(), alone.sum()) > 5
    stray, spacing = find_floaters(points, colours, 0.4)
    np.testing.assert_array_equal(stray, foreign | alone)
    np.testing.assert_allclose(spacing, distances[:, 8])


@pytest.mark.usefixtures("instruction_set")
def test_neighbours_that_are_equally_near_do_not_displace_nearer_ones():
    rng = np.random.default_rng(2)
    for size in (20, 90, 400):
        for spread in (0.3, 1.0, 3.0):
            points = np.round(rng.normal(0, spread, (size, 3))).astype(np.float32)  # as files of few bits have them
            far = np.sort(np.linalg.norm(points[:, None].astype(float) - points, axis=2), axis=1)[:, 8]
            np.testing.assert_allclose(find_floaters(points, points, 0.1)[1], far)
