"""Clusters of points, beside a walk over all pairs."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from gsmap._native import clusters
from gsmap.compare.components import components


@pytest.mark.parametrize("kinds", [1, 3])
@pytest.mark.parametrize("reach_m", [0.03, 0.06, 0.12, 5.0])
def test_what_is_within_reach_is_of_one_cluster(reach_m, kinds):
    rng = np.random.default_rng(3)
    points = rng.uniform(-0.5, 0.5, (700, 3)).astype(np.float32)
    kind = rng.integers(-1, kinds - 1, len(points))
    apart = points[:, None].astype(np.float64) - points[None]
    near = ((apart**2).sum(2) <= reach_m**2) & (kind[:, None] == kind[None])
    expected = connected_components(near, directed=False)[1]
    np.testing.assert_array_equal(components(points, reach_m, kind), expected)
    if kinds == 1:
        np.testing.assert_array_equal(components(points, reach_m), expected)


def test_a_chain_is_one_cluster_and_two_exactly_in_reach_are():
    line = np.stack([np.arange(200) * 0.25, np.zeros(200), np.zeros(200)], axis=1)
    assert (components(line, 0.25) == 0).all()
    np.testing.assert_array_equal(components(line, 0.2499), np.arange(200))
    assert components(line[:0], 0.1).shape == (0,)


def test_places_out_of_all_reach_are_refused():
    for wrong in (np.nan, np.inf, 1e30):
        with pytest.raises(ValueError, match="finite"):
            clusters(np.array([[0.0, 0, wrong]]), 0.1, None)
    with pytest.raises(ValueError, match="kind"):
        clusters(np.zeros((2, 3)), 0.1, np.zeros(1, np.int64))
    with pytest.raises(ValueError, match="positive"):
        clusters(np.zeros((2, 3)), 0.0, None)
