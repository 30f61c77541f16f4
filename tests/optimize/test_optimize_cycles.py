"""The vote of triangles: what the noise of each edge does to the product round a cycle."""

import numpy as np
import pytest
from made_worlds import poses_at
from scipy.optimize import brentq
from scipy.stats import chi2

from gsmap.geometry import similarities
from gsmap.geometry.similarities import Similarities
from gsmap.optimize.cycles import count_cycle_support, cycle_chi2, list_triangles
from gsmap.optimize.measurements import measurements
from gsmap.types import Edge

IDS = list("abc")


def triangle(seed, pairs):
    """Three edges with covariances of all directions, long beside their noise, so that levers count."""
    rng = np.random.default_rng(seed)
    truth = poses_at(rng.normal(0, 8, (3, 3)), seed)
    edges = []
    for a, b in pairs:
        root = rng.normal(0, 1, (7, 7)) * ([0.02] * 3 + [0.05] * 3 + [1e-6])
        covariance = root @ root.T + np.diag([1e-6] * 6 + [1e-10])
        noise = 1e-4 * rng.normal(0, 1, (1, 7)) * [1, 1, 1, 1, 1, 1, 0]
        measured = truth[[a]].inverse() @ truth[[b]] @ similarities.exp(noise)
        edges.append(Edge(IDS[a], IDS[b], measured.item(0), np.linalg.inv(covariance)))
    return measurements(IDS, edges, rigid=True)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("pairs", [[(0, 1), (1, 2), (0, 2)], [(1, 0), (1, 2), (2, 0)], [(0, 1), (2, 1), (2, 0)]])
def test_covariances_are_carried_round_a_triangle(seed, pairs):
    """The chi-square is that of the numerical derivatives of the whole cycle by the noise of each edge."""
    m = triangle(seed, pairs)
    cycles, signs = list_triangles(m.targets, m.sources, m.num_scenes)
    assert len(cycles) == 1

    def closure(edge, xi):
        total = Similarities.identity(1)
        for row, sign in zip(cycles[0], signs[0], strict=True):
            step = m.measured[np.array([row])]
            if row == edge:
                step = step @ similarities.exp(np.r_[xi, 0.0][None])
            total = total @ (step if sign > 0 else step.inverse())
        return total.log()[0, :6]

    covariance = np.zeros((6, 6))
    for edge in range(3):
        J = np.stack([(closure(edge, h) - closure(edge, -h)) / 2e-5 for h in 1e-5 * np.eye(6)], axis=1)
        covariance += J @ m.covariance[edge] @ J.T
    r = closure(-1, np.zeros(6))
    assert cycle_chi2(m, cycles, signs)[0] == pytest.approx(r @ np.linalg.solve(covariance, r), rel=1e-2)


def test_a_triangle_that_does_not_close_supports_nothing():
    m = triangle(0, [(0, 1), (1, 2), (0, 2)])
    assert count_cycle_support(m, 0.999).agree.tolist() == [1, 1, 1]
    off = m.measured.replaced(np.array([2]), poses_at(np.array([[20.0, 0, 0]]), 9))
    broken = measurements(IDS, [Edge(*m.keys[k], off.item(k), full(m.information[k])) for k in range(3)], rigid=True)
    assert count_cycle_support(broken, 0.999).agree.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("times", "agree"), [(0.95, 1), (1.05, 0)])
def test_a_triangle_agrees_up_to_the_quantile_of_its_noise(times, agree):
    m = triangle(0, [(0, 1), (1, 2), (0, 2)])
    cycles, signs = list_triangles(m.targets, m.sources, m.num_scenes)
    third = np.array([2])

    def moved(by):
        step = m.measured[third] @ similarities.exp(np.array([[0, 0, 0, by, 0, 0, 0.0]]))
        off = m.measured.replaced(third, step)
        return measurements(IDS, [Edge(*m.keys[k], off.item(k), full(m.information[k])) for k in range(3)], rigid=True)

    wanted = times * chi2.ppf(0.999, 6)
    by = brentq(lambda by: cycle_chi2(moved(by), cycles, signs)[0] - wanted, 0, 100)
    assert count_cycle_support(moved(by), 0.999).agree.tolist() == [agree] * 3


def full(information):
    out = np.diag([0.0] * 6 + [1e10])
    out[:6, :6] = information
    return out
