"""Stretched captures, beside the stretch that they were given."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.register.strain import fit_strain
from gsmap.register.surface import Surface
from gsmap.types import Sim3

POSE = Sim3(Rotation.from_euler("xyz", [10, -30, 120], degrees=True).as_matrix(), np.array([4.0, -2.0, 1.0]))


def room(seed: int, noise_m: float) -> np.ndarray:
    """Points on the walls, the floor and the furniture of a room of 6 x 5 x 2.5 m."""
    rng, parts = np.random.default_rng(seed), []
    boxes = [((0, 0, 0), (6, 5, 2.5)), ((1, 1, 0), (2, 2.5, 0.8)), ((4, 3, 0), (5.2, 3.6, 1.9))]
    for low, high in np.array(boxes, np.float64):
        for axis in range(3):
            for side in (low, high):
                area = np.prod(np.delete(high - low, axis))
                points = rng.uniform(low, high, (int(900 * area), 3))
                points[:, axis] = side[axis] + rng.normal(0, noise_m, len(points))
                parts.append(points)
    return np.concatenate(parts)


def surface(points: np.ndarray) -> Surface:
    return Surface(points, np.full(points.shape, 0.5, np.float32), 0.05)


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("stretch", "axis"), [(0.01, 0), (-0.02, 1), (0.03, 2), (0.04, 0)])
def test_a_stretched_source_is_named_with_its_axis(stretch: float, axis: int) -> None:
    change = np.eye(3)
    change[axis, axis] += stretch
    source = POSE.inverse().apply(room(1, 0.004) - [3, 2.5, 1.25])
    found = fit_strain(surface(room(0, 0.004) - [3, 2.5, 1.25]), surface(source @ change), POSE)
    assert found is not None
    assert found.is_stretched
    # The source is to shrink by as much as it was stretched; the mean change is a scale, not a strain.
    wanted = np.linalg.inv(change) - np.eye(3)
    wanted -= np.trace(wanted) / 3 * np.eye(3)
    np.testing.assert_allclose(found.matrix, wanted, atol=1.5e-3)
    assert found.spread == pytest.approx(abs(wanted[axis, axis]) * 1.5, abs=2e-3)
    assert f"({', '.join(f'{value:.1f}' for value in np.eye(3)[axis])})" in found.note()
    noted = float(found.note().split(" by ")[1].split("%")[0])
    assert noted == pytest.approx(150 * wanted[axis, axis], abs=0.25)
    cells = surface(source @ change).coarse[0]
    assert found.radius_m == pytest.approx(np.sqrt(cells.var(axis=0).sum()), rel=0.1)
    # A turn of a radius away is as large as the displacements.
    sigmas = np.sqrt(np.diag(found.covariance(1.0)))
    assert sigmas[:3] == pytest.approx(np.full(3, found.rms_m / found.radius_m))
    assert (sigmas[3:6] >= found.rms_m * 0.999).all()


@pytest.mark.guards("answers")
@pytest.mark.parametrize("seed", range(4))
def test_rigid_and_scaled_sources_are_not_stretched(seed: int) -> None:
    source = POSE.inverse().apply(room(10 + seed, 0.006) - [3, 2.5, 1.25])
    for scale in (1.0, 1.02):
        pose = Sim3(POSE.rotation, POSE.translation, 1 / scale)
        found = fit_strain(surface(room(seed, 0.006) - [3, 2.5, 1.25]), surface(source * scale), pose)
        assert found is not None
        assert not found.is_stretched
        assert found.spread < 0.003


@pytest.mark.guards("answers")
@pytest.mark.parametrize("seed", range(3))
def test_a_direction_that_no_surface_crosses_says_nothing(seed: int) -> None:
    """The overlap of two halves of a room is a slab without walls at its ends."""
    target, source = room(seed, 0.005) - [3, 2.5, 1.25], room(20 + seed, 0.005) - [3, 2.5, 1.25]
    target, source = target[target[:, 0] < 0.8], source[source[:, 0] > -0.8]
    found = fit_strain(surface(target), surface(POSE.inverse().apply(source)), POSE)
    assert found is None or not found.is_stretched


def test_too_small_an_overlap_says_nothing() -> None:
    points = room(0, 0.004)
    assert fit_strain(surface(points), surface(points + 50.0), Sim3.identity()) is None
