"""Rays cast against quads, held against linear equations solved for every ray and triangle."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap._native import QuadRays
from gsmap.render import num_threads, set_num_threads


def first_hits(corners: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distance and triangle of the first hit of each ray, from all intersections of rays with planes."""
    triangles = corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)
    edges = np.stack([triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]], axis=2)
    lines = np.broadcast_to(-directions[:, None, :, None], (len(origins), len(triangles), 3, 1))
    equations = np.concatenate([lines, np.broadcast_to(edges, (*lines.shape[:2], 3, 2))], axis=3)
    solved = np.linalg.solve(equations, (origins[:, None] - triangles[None, :, 0])[..., None])[..., 0]
    t, u, v = np.moveaxis(solved, 2, 0)
    t = np.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t >= 0), t, np.inf)
    return t.min(1), np.where(np.isfinite(t.min(1)), t.argmin(1), -1)


@pytest.fixture(scope="module")
def world() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    corner = rng.uniform(-3, 3, (60, 3))
    u, v = rng.normal(size=(2, 60, 3))
    corners = np.stack([corner, corner + u, corner + u + v, corner + v], axis=1)
    return corners, rng.uniform(-4, 4, (400, 3)), rng.normal(size=(400, 3))


def test_first_hits(world) -> None:
    corners, origins, directions = world
    t, triangle = first_hits(corners, origins, directions)
    found_t, found, u, v = QuadRays(corners).cast(origins, directions)
    assert 100 < (triangle >= 0).sum() < 400
    np.testing.assert_array_equal(found, triangle)
    np.testing.assert_allclose(found_t, t)
    hit = triangle >= 0
    a, b, c = np.moveaxis(corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3)[triangle[hit]], 1, 0)
    points = a + u[hit, None] * (b - a) + v[hit, None] * (c - a)
    np.testing.assert_allclose(points, (origins + found_t[:, None] * directions)[hit], atol=1e-9)


def test_occluded_rays(world) -> None:
    corners, origins, directions = world
    t, _ = first_hits(corners, origins, directions)
    for far in (0.3, 1.0, 5.0):
        np.testing.assert_array_equal(QuadRays(corners).occluded(origins, directions, far) == 1, t < far)


def test_rays_along_axes_and_nothing() -> None:
    floor = np.array([[[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]], float)
    down, along = np.array([[0, 0, -1.0]]), np.array([[1.0, 0, 0]])
    assert QuadRays(floor).cast(np.array([[0.5, 1.5, 3]]), down)[0][0] == 3
    assert QuadRays(floor).cast(np.array([[-1, 1, 0.0]]), along)[1][0] == -1, "within the plane of the quad"
    assert QuadRays(np.zeros((0, 4, 3))).cast(np.array([[0, 0, 1.0]]), down)[1].tolist() == [-1]
    with pytest.raises(ValueError, match="finite"):
        QuadRays(floor * np.nan)


def test_threads_change_nothing(world) -> None:
    corners, origins, directions = world
    before = num_threads()
    try:
        set_num_threads(1)
        alone = QuadRays(corners).cast(np.tile(origins, (9, 1)), np.tile(directions, (9, 1)))
        set_num_threads(4)
        together = QuadRays(corners).cast(np.tile(origins, (9, 1)), np.tile(directions, (9, 1)))
    finally:
        set_num_threads(before)
    for a, b in zip(alone, together, strict=True):
        np.testing.assert_array_equal(a, b)
