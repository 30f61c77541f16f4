"""Edges and priors as they are stacked for the solver: what a rigid map is, and derivatives at small angles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_worlds import information
from raising import raises
from scipy.spatial.transform import Rotation

from gsmap.errors import InputError
from gsmap.optimize.measurements import measurements
from gsmap.optimize.priors import _inverse_right_jacobian
from gsmap.types import Edge, Sim3

RIGID = Edge("a", "b", Sim3.identity(), information())
SCALED = Edge("b", "c", Sim3(np.eye(3), np.zeros(3), 1.1), information())
IDS = ["a", "b", "c"]


@pytest.mark.guards("answers")
@pytest.mark.parametrize(
    ("edges", "rigid", "dim"),
    [
        ([RIGID], None, 6),
        ([RIGID, SCALED], None, 7),
        ([SCALED], None, 7),
        ([RIGID], False, 7),
        ([RIGID, SCALED], True, 6),
    ],
)
def test_scale_is_free_only_where_an_edge_has_one_or_it_is_asked_for(edges, rigid, dim) -> None:
    assert measurements(IDS, edges, rigid=rigid).dim == dim


@pytest.mark.guards("answers")
def test_edges_keep_their_order_ends_and_information() -> None:
    skewed = information()
    skewed[0, 1] += 1e-9 * skewed[0, 0]
    m = measurements(IDS, [SCALED, replace(RIGID, target="c", source="a", information=skewed)], rigid=False)
    assert m.keys == [("b", "c"), ("c", "a")]
    np.testing.assert_allclose(m.measured.item(0).scale, 1.1)
    np.testing.assert_array_equal(m.information[1], (skewed + skewed.T) / 2)


@pytest.mark.guards("answers")
@pytest.mark.parametrize("row", [0, 3, 6])
def test_information_without_certainty_in_a_direction_is_refused(row: int) -> None:
    for value in (0.0, -1.0):
        bad = information()
        bad[row, :] = bad[:, row] = 0.0
        bad[row, row] = value
        with raises(InputError, code="invalid_information", match="'?b:c"):
            measurements(IDS, [RIGID, replace(SCALED, information=bad)])


@pytest.mark.guards("answers")
@pytest.mark.parametrize("angle", [0.0, 1e-6, 9e-5, 1.1e-4, 1e-2, 1.0, 3.0])
def test_derivative_of_the_logarithm_of_a_rotation(angle: float) -> None:
    omega = angle * np.array([2.0, -1, 2]) / 3
    step = 1e-6
    numeric = np.empty((3, 3))
    for k in range(3):
        ends = []
        for sign in (1, -1):
            moved = Rotation.from_rotvec(omega) * Rotation.from_rotvec(sign * step * np.eye(3)[k])
            ends.append(moved.as_rotvec())
        numeric[:, k] = (ends[0] - ends[1]) / (2 * step)
    np.testing.assert_allclose(_inverse_right_jacobian(omega[None])[0], numeric, atol=1e-8)


@pytest.mark.guards("answers")
def test_the_derivative_has_no_step_where_its_series_begins() -> None:
    axis = np.array([1.0, 0, 0])
    below, above = (_inverse_right_jacobian(angle * axis[None])[0] for angle in (0.9999999e-4, 1.0000001e-4))
    np.testing.assert_allclose(below, above, atol=1e-11)
