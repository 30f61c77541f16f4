"""Which rows share a cell, against a dictionary; and means, against numpy's."""

import numpy as np
import pytest

from gsmap._native import ranks
from gsmap.geometry.cells import cell_labels, cell_means, group_means


def test_labels_count_cells_in_the_order_x_then_y_then_z():
    cells = np.array([[1, 0, 0], [0, 5, 9], [0, 5, -9], [1, 0, 0], [0, -7, 100], [-3, 0, 0]])
    labels, counts = cell_labels(cells)
    order = sorted({tuple(cell) for cell in cells.tolist()})
    assert [order[label] for label in labels] == [tuple(cell) for cell in cells.tolist()]
    assert counts.tolist() == [1, 1, 1, 1, 2]


def test_many_cells_are_told_apart():
    cells = np.random.default_rng(0).integers(-50, 50, (5000, 3))
    labels, counts = cell_labels(cells)
    of = {tuple(cell): label for cell, label in zip(cells.tolist(), labels.tolist(), strict=True)}
    assert len(of) == len(set(labels.tolist())) == len(counts)
    assert [of[tuple(cell)] for cell in cells.tolist()] == labels.tolist()
    np.testing.assert_array_equal(counts, np.bincount(labels))


def test_cells_of_strays_far_out_are_told_apart():
    """So far that one number a cell, in 64 bits, gives several cells the same: x wraps round."""
    far = 2**32 - 1
    cells = np.array([[0, 0, 0], [far, far, far], [1, 0, 0], [0, 1, 0], [0, 0, 0], [1, 0, 1], [0, 2, 0]])
    labels, counts = cell_labels(cells)
    order = sorted({tuple(cell) for cell in cells.tolist()})
    assert [order[label] for label in labels] == [tuple(cell) for cell in cells.tolist()]
    assert counts.tolist() == [2, 1, 1, 1, 1, 1]


def test_means_are_those_of_each_group():
    rng = np.random.default_rng(1)
    values, labels = rng.normal(size=(200, 4)), rng.permutation(np.arange(200) % 13)
    means = group_means(values, labels, np.bincount(labels))
    for k in range(13):
        np.testing.assert_allclose(means[k], values[labels == k].mean(0))


def test_nothing_has_no_cells():
    labels, counts = cell_labels(np.zeros((0, 3), int))
    assert len(labels) == len(counts) == 0
    assert group_means(np.zeros((0, 4)), labels, counts).shape == (0, 4)


@pytest.mark.parametrize("most", [1, 2047, 2048, 2**40, 2**62], ids=str)
def test_ranks_are_numpys_however_large_keys_are(most):
    keys = np.random.default_rng(most).integers(0, most, 4000, endpoint=True)
    keys[1000:2000] = keys[:1000]
    labels, counts = ranks(keys)
    _, expected, times = np.unique(keys, return_inverse=True, return_counts=True)
    np.testing.assert_array_equal(labels, expected)
    np.testing.assert_array_equal(counts, times)
    assert [len(a) for a in ranks(keys[:0])] == [0, 0]


def test_ranks_of_negative_keys_are_refused():
    with pytest.raises(ValueError, match="negative"):
        ranks(np.array([0, -1]))


@pytest.mark.parametrize("far", [1.0, 1e9], ids=["near", "strays_far_out"])
def test_cell_means_are_those_of_each_cell(far):
    rng = np.random.default_rng(2)
    points, values, weights = rng.normal(size=(400, 3)), rng.normal(size=(400, 3)), rng.uniform(0.1, 1, 400)
    points[0] *= far
    origin = np.array([0.3, -0.2, 0.7])
    labels, counts = cell_labels(np.floor((points - origin) / 0.5))
    assert len(counts) < 300
    plain = cell_means(points, values, 0.5, origin=origin)
    np.testing.assert_allclose(plain[0], group_means(points, labels, counts))
    np.testing.assert_allclose(plain[1], group_means(values, labels, counts))
    np.testing.assert_array_equal(plain[2], counts)
    weighted = cell_means(points, values, 0.5, weights, origin)
    total = np.bincount(labels, weights)
    np.testing.assert_allclose(weighted[2], total)
    np.testing.assert_allclose(
        weighted[1] * total[:, None], group_means(values * weights[:, None], labels, np.ones(len(counts)))
    )


def test_cell_means_of_nothing_are_nothing():
    assert [len(part) for part in cell_means(np.zeros((0, 3)), np.zeros((0, 3)), 0.1)] == [0, 0, 0]
