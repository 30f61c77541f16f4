"""A scan as Gaussians: flat discs that close its surfaces."""

from __future__ import annotations

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.rotations import exp_so3, quats_to_matrices
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.localize.scan import NEUTRAL, Params, as_gaussians
from gsmap.types.scan import Scan

TURN = exp_so3(np.array([0.4, 0.3, 0.2]))


def plane(count: int = 4000, colours: bool = True) -> Scan:
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(0, 1, (count, 2)), np.zeros(count)]) @ TURN.T
    return Scan(points, np.tile([0.2, 0.5, 0.8], (count, 1)) if colours else None)


def test_discs_lie_in_the_surface() -> None:
    found = as_gaussians(plane(), 0.02)
    normals = quats_to_matrices(found.quats)[:, :, 2]
    assert np.abs(normals @ TURN[:, 2]).min() > 0.99
    np.testing.assert_allclose(found.log_scales[:, 2] - found.log_scales[:, 0], np.log(0.1), atol=1e-5)
    assert np.median(found.scales[:, 0]) == pytest.approx(0.7 * 0.02, rel=0.3)
    assert found.opacities.min() > 0.99
    np.testing.assert_allclose(rgb_of_sh0(found.sh[:, 0]), np.tile([0.2, 0.5, 0.8], (len(found), 1)), atol=1e-5)


def test_cells_are_metres_and_grow_where_there_are_too_many() -> None:
    assert 1700 < len(as_gaussians(plane(20_000), 0.02)) < 3600
    coarse = as_gaussians(plane(20_000), 0.01)
    assert len(coarse) > 6000
    few = as_gaussians(plane(20_000), 0.02, max_points=300)
    assert 100 < len(few) <= 300
    again = as_gaussians(plane(20_000), 0.02, max_points=300)
    np.testing.assert_array_equal(few.means, again.means)


def test_without_colours_it_is_grey() -> None:
    found = as_gaussians(plane(colours=False), 0.02)
    np.testing.assert_allclose(rgb_of_sh0(found.sh), NEUTRAL)


def test_few_points_and_none() -> None:
    assert len(as_gaussians(Scan(np.zeros((1, 3))), 0.02)) == 1
    assert np.isfinite(as_gaussians(Scan(np.arange(9.0).reshape(3, 3)), 0.02).log_scales).all()
    with raises(InputError, code="empty_scan"):
        Scan(np.zeros((0, 3)))
    with raises(InputError, code="shape_mismatch", match="colours"):
        Scan(np.zeros((2, 3)), np.zeros((1, 3)))
    with raises(ConfigError, code="out_of_range", match="cell_m"):
        Params(cell_m=0)
