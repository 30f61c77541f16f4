"""Stretched and bent captures, beside the stretch or bend that they were given."""

from __future__ import annotations

import numpy as np
import pytest
from furnished_room import furnished_room
from scipy.spatial.transform import Rotation

from gsmap.geometry.umeyama import umeyama
from gsmap.register.deformation import fit_deformation
from gsmap.register.surface import Surface
from gsmap.types import Sim3

POSE = Sim3(Rotation.from_euler("xyz", [10, -30, 120], degrees=True).as_matrix(), np.array([4.0, -2.0, 1.0]))


def room(seed: int, noise_m: float) -> np.ndarray:
    return furnished_room(seed, noise_m=noise_m, per_m2=900)


def surface(points: np.ndarray) -> Surface:
    return Surface(points, np.full(points.shape, 0.5, np.float32), 0.05)


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("stretch", "axis"), [(0.01, 0), (-0.02, 1), (0.03, 2), (0.04, 0)])
def test_a_stretched_source_is_named_with_its_axis(stretch: float, axis: int) -> None:
    change = np.eye(3)
    change[axis, axis] += stretch
    source = POSE.inverse().apply(room(1, 0.004))
    found = fit_deformation(surface(room(0, 0.004)), surface(source @ change), POSE)
    assert found is not None
    assert found.is_stretched
    assert not found.is_bent
    # The source is to shrink by as much as it was stretched; the mean change is a scale, not a strain.
    wanted = np.linalg.inv(change) - np.eye(3)
    wanted -= np.trace(wanted) / 3 * np.eye(3)
    np.testing.assert_allclose(found.warp.strain, wanted, atol=1.5e-3)
    assert found.spread == pytest.approx(abs(wanted[axis, axis]) * 1.5, abs=2e-3)
    assert f"({', '.join(f'{value:.1f}' for value in np.eye(3)[axis])})" in found.note()
    noted = float(found.note().split(" by ")[1].split("%")[0])
    assert noted == pytest.approx(150 * wanted[axis, axis], abs=0.25)
    cells = surface(source @ change).coarse[0]
    assert found.warp.radius == pytest.approx(np.sqrt(cells.var(axis=0).sum()), rel=0.1)
    # A turn of a radius away is as large as the displacements.
    sigmas = np.sqrt(np.diag(found.covariance(1.0)))
    assert sigmas[:3] == pytest.approx(np.full(3, found.rms_m / found.warp.radius))
    assert (sigmas[3:6] >= found.rms_m * 0.999).all()


@pytest.mark.guards("answers")
@pytest.mark.parametrize("seed", range(4))
def test_rigid_and_scaled_sources_are_not_stretched(seed: int) -> None:
    source = POSE.inverse().apply(room(10 + seed, 0.006))
    for scale in (1.0, 1.02):
        pose = Sim3(POSE.rotation, POSE.translation, 1 / scale)
        found = fit_deformation(surface(room(seed, 0.006)), surface(source * scale), pose)
        assert found is not None
        assert not found.is_stretched
        assert not found.is_bent
        assert found.spread < 0.003


@pytest.mark.guards("answers")
@pytest.mark.parametrize("seed", range(3))
def test_a_direction_that_no_surface_crosses_says_nothing(seed: int) -> None:
    """The overlap of two halves of a room is a slab without walls at its ends."""
    target, source = room(seed, 0.005), room(20 + seed, 0.005)
    target, source = target[target[:, 0] < 0.8], source[source[:, 0] > -0.8]
    found = fit_deformation(surface(target), surface(POSE.inverse().apply(source)), POSE)
    assert found is None or not found.is_stretched


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("percent", "along", "towards"), [(1, 0, 2), (-2, 0, 1), (4, 1, 0), (1, 1, 2)])
def test_a_bent_source_is_named_and_the_warp_undoes_the_bend(percent: float, along: int, towards: int) -> None:
    """The middle of the room sags by some percent of its length, x' = x + a y^2."""
    length = (6.0, 5.0)[along]
    flat = room(1, 0.004)
    bent = flat.copy()
    bent[:, towards] += percent / 100 * length * (flat[:, along] / (length / 2)) ** 2
    source = POSE.inverse()
    found = fit_deformation(surface(room(0, 0.004)), surface(source.apply(bent)), POSE)
    assert found is not None
    assert found.is_bent
    assert not found.is_stretched
    restored = found.pose.apply(found.warp.apply(source.apply(bent)))
    assert np.sqrt(((restored - flat) ** 2).sum(1).mean()) < 0.004
    # Named in the axes of the source, along which the room lies.
    axis = np.array([float(value) for value in found.note().split("(")[1].split(")")[0].split(", ")])
    assert abs(axis @ source.rotation[:, along]) > 0.9
    noted = float(found.note().split(" by ")[1].split("%")[0])
    assert noted == pytest.approx(abs(percent), rel=0.35)
    inside = np.linalg.norm(POSE.inverse().apply(bent) - found.warp.centre, axis=1) < found.warp.radius
    left = umeyama(flat[inside], bent[inside], with_scale=True).apply(bent[inside]) - flat[inside]
    assert found.rms_m == pytest.approx(np.sqrt((left**2).sum(1).mean()), rel=0.15)


@pytest.mark.guards("answers")
def test_a_dent_is_not_a_bend() -> None:
    """A wall that bulges in one place is a change of the place: the rest of it predicts no such bulge."""
    source = room(1, 0.004)
    near = np.exp(-((source - [3.0, 0.5, 0.0]) ** 2).sum(1) / (2 * 0.6**2))
    source[:, 0] += 0.06 * near
    found = fit_deformation(surface(room(0, 0.004)), surface(POSE.inverse().apply(source)), POSE)
    assert found is not None
    assert not found.is_bent


def test_too_small_an_overlap_says_nothing() -> None:
    points = room(0, 0.004)
    assert fit_deformation(surface(points), surface(points + 50.0), Sim3.identity()) is None
