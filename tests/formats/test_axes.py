import itertools

import numpy as np
import pytest
from formats_cases import colours_along, covariances, directions, random_gaussians

from gsmap.formats.axes import axes_matrix, change_axes

ALL_CONVENTIONS = [x + y + z for x in "LR" for y, z in (*itertools.product("UD", "FB"), *itertools.product("FB", "UD"))]


def test_known_matrices():
    # A ply's y points down and its z forward: SPZ negates both, glTF negates x and y.
    np.testing.assert_array_equal(axes_matrix("RUB", "RDF"), np.diag([1, -1, -1]))
    np.testing.assert_array_equal(axes_matrix("LUF", "RDF"), np.diag([-1, -1, 1]))
    # One unit forward in right-down-front is the second coordinate of right-front-up.
    np.testing.assert_array_equal(axes_matrix("RFU", "RDF") @ [0, 0, 1], [0, 1, 0])


@pytest.mark.parametrize("convention", ALL_CONVENTIONS)
def test_shape_and_colour_follow_the_axes(convention):
    """Against the definition: points, covariances and view directions all go through the same matrix."""
    g = random_gaussians(40)
    turned = change_axes(g, convention, "RDF")
    M = axes_matrix(convention, "RDF")
    np.testing.assert_allclose(turned.means, g.means @ M.T, atol=1e-6)
    np.testing.assert_allclose(covariances(turned), M @ covariances(g) @ M.T, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(colours_along(turned, directions() @ M.T), colours_along(g, directions()), atol=1e-5)


def test_there_and_back_is_exact_where_the_order_of_axes_stays():
    g = random_gaussians(40)
    for a, b in itertools.permutations(["RDF", "RUB", "LUF", "LDF"], 2):
        back = change_axes(change_axes(g, a, b), b, a)
        for name in ("means", "log_scales", "sh"):
            np.testing.assert_array_equal(getattr(back, name), getattr(g, name))
        np.testing.assert_array_equal(np.abs((back.quats * g.quats).sum(1)), (g.quats**2).sum(1))
