"""Planes through neighbours, against numpy's eigenvectors."""

import numpy as np
import pytest

from gsmap._native import local_planes
from gsmap.geometry.neighbours import nearest_neighbours

WIDTH = 0.05


@pytest.fixture(scope="module")
def sheets():
    """Points of two noisy sheets that lie closer to each other than their neighbourhoods are wide."""
    rng = np.random.default_rng(3)
    points = rng.uniform(0, 1, (2000, 3)) * [1, 1, 0.01] + [100, 0, 0]
    points[::2, 2] += 0.06
    return points, nearest_neighbours(points, 14)[1]


def test_planes_are_the_principal_axes_of_weighted_neighbours(sheets):
    points, near = sheets
    rough = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    rough[:1000] = 0
    step = points[near] - points[:, None]
    weight = np.where(rough.any(1)[:, None], np.exp(-0.5 * (step[..., 2] / WIDTH) ** 2) + 1e-6, 1.0)
    centred = step - ((weight[..., None] * step).sum(1) / weight.sum(1)[:, None])[:, None]
    values, vectors = np.linalg.eigh((weight[..., None] * centred).transpose(0, 2, 1) @ centred)
    normals, flat = local_planes(points, near, rough, WIDTH)
    np.testing.assert_allclose(flat, (values[:, 1] - values[:, 0]) / values[:, 2], atol=1e-9)
    np.testing.assert_allclose(np.abs((normals * vectors[:, :, 0]).sum(1)), 1, atol=1e-6)
    np.testing.assert_array_equal(local_planes(points, near)[0][:1000], normals[:1000])


def test_neighbours_that_are_no_points_are_refused(sheets):
    points, near = sheets
    for bad in (near - 1, near + 1, near[1:]):
        with pytest.raises(ValueError):
            local_planes(points, bad)
