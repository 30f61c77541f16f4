"""Origins of positions that float32 cannot hold."""

import numpy as np
import pytest

from gsmap.geometry.origins import centred, float32_step, is_float32, neighbour_distance, origin_of
from gsmap.types import Gaussians

PLACES = {
    "LV95": (2683000.37, 1247900.61, 408.2),
    "UTM": (500123.4, 5412345.6, 320.0),
    "ECEF": (4271234.5, 672345.6, 4672345.7),
}


def cloud(n: int, extent: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-extent / 2, extent / 2, (n, 3))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("extent", [0.5, 30.0, 1000.0, 20_000.0])
def test_map_coordinates_are_held_to_a_millimetre(place: str, extent: float) -> None:
    truth = cloud(5000, extent) + PLACES[place]
    means, origin = centred(truth)
    assert origin.any()
    assert means.dtype == np.float32
    assert np.abs(means + origin - truth).max() < 1e-3


@pytest.mark.parametrize(("at", "extent"), [(0.0, 5.0), (300.0, 5.0), (8000.0, 0.1), (5e5, 6e4), (0.0, 1e7)])
def test_positions_that_float32_holds_stay_as_they_are(at: float, extent: float) -> None:
    assert not origin_of(cloud(1000, extent) + np.array([at, 0, -at / 2])).any()


@pytest.mark.parametrize("place", PLACES)
def test_float32_loses_nothing_by_an_origin(place: str) -> None:
    single = (cloud(5000, 300.0) + PLACES[place]).astype(np.float32)
    means, origin = centred(single)
    np.testing.assert_array_equal((means + origin).astype(np.float32), single)
    assert is_float32(means + origin)
    assert not is_float32(means + origin + 1e-3)


def test_what_lies_far_out_and_what_is_no_number_move_no_origin() -> None:
    truth = cloud(5000, 30.0) + PLACES["LV95"]
    usual = origin_of(truth)
    truth[::50] = [[np.nan, np.inf, 0]]
    truth[1::50] += 1e7
    np.testing.assert_array_equal(origin_of(truth), usual)
    assert not origin_of(np.full((3, 3), np.nan)).any()
    assert not origin_of(np.zeros((0, 3))).any()


def test_the_step_of_float32() -> None:
    assert float32_step(np.array([[2.6e6, 5.0, 1.0]])) == 0.25
    assert float32_step(np.array([[-4.6e6, 5.0, 1.0]])) == 0.5


class InParts:
    """Gaussians a few at a time."""

    sh_degree = 0

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians, self.num_gaussians = gaussians, len(gaussians)

    def columns(self, name: str):
        column = getattr(self.gaussians, name)
        return (column[i : i + 7] for i in range(0, len(column), 7))


def of_means(means: np.ndarray) -> Gaussians:
    n = len(means)
    return Gaussians(means, np.ones((n, 4)), np.zeros((n, 3)), np.zeros(n), np.zeros((n, 1, 3)))


def test_the_distance_between_neighbours() -> None:
    g = of_means(cloud(500, 10.0))
    apart = np.linalg.norm(g.means[:, None].astype(float) - g.means, axis=2)
    np.fill_diagonal(apart, np.inf)
    wanted = np.median(apart.min(1))
    assert neighbour_distance(g) == pytest.approx(wanted, rel=1e-5)
    assert neighbour_distance(InParts(g)) == pytest.approx(wanted, rel=1e-5)
    assert neighbour_distance(of_means(np.zeros((1, 3)))) == np.inf
    assert neighbour_distance(of_means(np.zeros((4, 3)))) == 0
