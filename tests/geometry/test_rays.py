"""Where a ray meets a surface of Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.geometry.rays import surface_along
from gsmap.types import Gaussians
from gsmap_synthetic.surveyed import ground


@pytest.mark.parametrize("slant_deg", [0, 30, 60, 75])
def test_a_ray_meets_the_ground_where_it_is(slant_deg: float) -> None:
    """At any slant: a rendered depth, which averages centres, is off by decimetres at 60 degrees."""
    slant = np.radians(slant_deg)
    direction = np.array([np.sin(slant), 0.0, -np.cos(slant)])
    origin = np.array([0.03, 0.04, 0.0]) - 4 * direction
    found = surface_along(ground(1.0), origin, direction)
    assert found is not None
    assert found[0] == pytest.approx(4.0, abs=0.02)
    assert found[1] < 0.05


def test_lengths_are_of_the_direction() -> None:
    direction = np.array([0.0, 0.0, -2.0])
    found = surface_along(ground(1.0), np.array([0.0, 0, 5]), direction)
    assert found is not None
    assert found[0] == pytest.approx(2.5, abs=0.01)


def test_a_thick_surface_says_so() -> None:
    """Two sheets, of which the nearer lets half of the light through."""
    n = 50
    z = np.linspace(0, 1, n)
    fog = Gaussians(
        np.stack([np.zeros(n), np.zeros(n), z], axis=1), np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), np.log(0.5)),
        np.full(n, -3.0), np.zeros((n, 1, 3)),
    )  # fmt: skip
    found = surface_along(fog, np.array([0.0, 0, 3]), np.array([0.0, 0, -1]))
    assert found is not None
    assert found[1] > 0.1


def test_nothing_is_nothing() -> None:
    flat = ground(1.0)
    assert surface_along(flat, np.array([0.0, 0, 5]), np.array([0.0, 0, 1])) is None
    assert surface_along(flat, np.array([50.0, 0, 5]), np.array([0.0, 0, -1])) is None
