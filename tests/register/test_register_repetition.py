"""Where else two surfaces are about as similar as under a pose, and how similar they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gsmap.geometry.rotations import angle_between
from gsmap.register.repetition import MARGIN, Repetition, fisher_z
from gsmap.register.surface import Surface
from gsmap.types import Sim3

PERIOD_M, WIDE_M, HIGH_M = 3.0, 2.4, 2.4
TILT = Rotation.from_rotvec([0.4, -0.3, 1.1]).as_matrix()
UP = TILT @ [0.0, 0.0, 1.0]  # in the target's frame


def corridor(start_m: float, end_m: float, unique: float, seed: int = 0) -> Surface:
    """A floor and two walls with a pattern that comes again after a period, and a share of patches of their own."""
    rng, points, colours = np.random.default_rng(seed), [], []
    for k, (y, along) in enumerate(((-WIDE_M / 2, 1), (-WIDE_M / 2, 2), (WIDE_M / 2, 2))):
        across = WIDE_M if along == 1 else HIGH_M
        x, other = rng.uniform([[start_m], [0]], [[end_m], [across]], (2, int(800 * (end_m - start_m) * across)))
        face = np.tile([0.0, y, 0.0], (len(x), 1))
        face[:, 0], face[:, along] = x, face[:, along] + other
        look, again = np.random.default_rng([5, k]), np.floor(np.column_stack([x % PERIOD_M, other]) / 0.25).astype(int)
        shade = look.uniform(0.2, 0.8, (12, 16, 3))[again[:, 0], again[:, 1]]
        patch = tuple(np.floor(np.column_stack([x, other]) / 0.4).astype(int).T)
        own, is_own = look.uniform(0.1, 0.9, (128, 16, 3))[patch], look.random((128, 16))[patch] < unique
        points.append(face)
        colours.append(np.where(is_own[:, None], own, shade) + rng.normal(0, 0.05, face.shape))
    return Surface(np.concatenate(points), np.concatenate(colours).astype(np.float32), 0.05)


MOVED = Sim3(Rotation.from_rotvec([0.2, 0.7, -0.4]).as_matrix(), np.array([3.0, -7.0, 2.0]))
ALONG = Sim3(np.eye(3), TILT @ [PERIOD_M, 0, 0])  # by a period, in the target's frame


def pair(unique: float, away: Sim3 | None = None) -> tuple[Repetition, Sim3]:
    """Two captures of a corridor that share 9 m, the second in a frame of its own, under the true pose moved by
    ``away``; and the true pose."""
    tilt = Sim3(TILT, np.zeros(3))
    target, source = corridor(0, 18, unique), corridor(9, 27, unique, seed=1)
    true = tilt @ MOVED.inverse()
    target = Surface(tilt.apply(target.points), target.colours, 0.05)
    source = Surface(MOVED.apply(source.points), source.colours, 0.05)
    return Repetition(target, source, true if away is None else away @ true, UP), true


@pytest.mark.guards("answers")
def test_poses_whole_periods_off_are_found_in_a_place_that_repeats() -> None:
    repetition, true = pair(0.0)
    found = []
    for S, similarity in repetition.elsewhere():
        shift = TILT.T @ (S.apply(MOVED.translation) - true.apply(MOVED.translation))
        if np.degrees(angle_between(S.rotation, true.rotation)) < 1 and np.linalg.norm(shift[1:]) < 0.2:
            assert similarity > repetition.similarity(true) - MARGIN
            found.append(shift[0] / PERIOD_M)
    np.testing.assert_allclose(found, np.round(found), atol=0.07)  # a cell
    assert {-3, -2, -1, 1} <= set(np.round(found))


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("up", "least"), [(UP, {-2, -1, 1}), (None, {-4, -2, 2})])  # None: half cells off at odd ones
def test_poses_whole_storeys_off_are_found_in_a_shaft_that_repeats(up: np.ndarray | None, least: set[int]) -> None:
    target, source = corridor(0, 18, 0.0), corridor(9, 27, 0.0, seed=1)
    upright = Rotation.from_rotvec([0.0, -np.pi / 2, 0.0]).as_matrix()  # the corridor, set on its end
    tilt = Sim3(TILT @ upright, np.zeros(3))
    target = Surface(tilt.apply(target.points), target.colours, 0.05)
    repetition = Repetition(target, source, tilt, up)
    rises = []
    for S, similarity in repetition.elsewhere():
        shift = TILT.T @ (S.translation - tilt.translation)
        if np.degrees(angle_between(S.rotation, tilt.rotation)) < 1 and np.linalg.norm(shift[:2]) < 0.2:
            assert similarity > repetition.similarity(tilt) - MARGIN - 0.2
            rises.append(shift[2] / PERIOD_M)
    np.testing.assert_allclose(rises, np.round(rises), atol=0.1)
    assert least <= set(np.round(rises))


@pytest.mark.guards("answers")
def test_unique_patches_tell_every_other_pose() -> None:
    repetition, true = pair(0.5)
    assert repetition.elsewhere() == []
    assert repetition.similarity(true) - repetition.similarity(ALONG @ true) > 2 * MARGIN


@pytest.mark.guards("answers")
def test_from_a_wrong_period_the_right_pose_is_the_most_similar_one() -> None:
    repetition, true = pair(0.5, ALONG)
    best, _ = repetition.elsewhere()[0]
    np.testing.assert_allclose(best.apply(MOVED.translation), true.apply(MOVED.translation), atol=0.15)
    np.testing.assert_allclose(best.rotation, true.rotation, atol=1e-6)


@pytest.mark.guards("answers")
def test_a_room_that_looks_alike_after_half_a_turn_is_found_turned() -> None:
    rng = np.random.default_rng(3)
    half = rng.uniform([-4, -3, 0], [4, 3, 2.4], (30_000, 3))
    half[:, 1] = -3  # a wall, and the one across
    shade = rng.uniform(0, 1, (20, 6, 3))[((half[:, 0] + 4) // 0.4).astype(int), (half[:, 2] // 0.4).astype(int)]
    points, colours = np.concatenate([half, half * [-1, -1, 1]]), np.concatenate([shade, shade]).astype(np.float32)
    room = Surface(points, colours, 0.05)
    found = Repetition(room, room, Sim3.identity(), np.array([0.0, 0, 1])).elsewhere()
    assert found
    for S, _ in found:
        np.testing.assert_allclose(S.rotation, np.diag([-1.0, -1, 1]), atol=1e-12)
        np.testing.assert_allclose(S.translation, 0, atol=0.1 + 1e-9)  # half a cell


OPPONENT = np.array([[0.299, 0.587, 0.114], [1.0, -1.0, 0.0], [0.5, 0.5, -1.0]]).T


def contrasts(surface: Surface, offset: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """The contrast of each cell, cell by cell."""
    weights = {k: np.exp(-0.5 * (k / 0.7) ** 2) for k in range(-3, 4)}
    centres, colours = surface.coarse
    sums: dict[tuple[int, ...], np.ndarray] = {}  # colours, and how many
    for key, colour in zip(np.floor(centres / [0.2, 0.2, 0.4] + offset).astype(int), colours @ OPPONENT, strict=True):
        sums[tuple(key)] = sums.get(tuple(key), np.zeros(4)) + np.append(colour, 1)
    means = {}
    for x, y, z in sums:
        near = [weights[i] * weights[j] * sums.get((x + i, y + j, z), np.zeros(4)) for i in weights for j in weights]
        means[x, y, z] = np.sum(near, 0)[:3] / np.sum(near, 0)[3]
    around = [(i, j) for i in range(-2, 3) for j in range(-2, 3)]
    return {
        (x, y, z): mean - np.mean([means[x + i, y + j, z] for i, j in around if (x + i, y + j, z) in means], 0)
        for (x, y, z), mean in means.items()
    }


def test_similarity_is_that_of_cells_counted_one_by_one() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([0, 0, 0], [5, 5, 0.39], (1_500, 3))
    a, b = rng.uniform(0, 1, (2, 1_500, 3)).astype(np.float32)
    target, source = Surface(points, a, 0.05), Surface(points, 0.5 * a + 0.5 * b, 0.05)
    found = Repetition(target, source, Sim3.identity(), np.array([0.0, 0, 1])).similarity(Sim3.identity())
    correlations = []
    for offset in ([0, 0, 0], [0.5, 0, 0], [0, 0.5, 0], [0.5, 0.5, 0]):
        grids = [contrasts(surface, np.array(offset)) for surface in (target, source)]
        common = sorted(grids[0].keys() & grids[1].keys())
        u, v = (np.array([grid[key] for key in common]).ravel() for grid in grids)
        correlations.append(u @ v / np.sqrt((u @ u) * (v @ v)))
    assert found == pytest.approx(np.arctanh(np.mean(correlations)), rel=1e-3)


def room(seed: int, noise: float) -> Surface:
    """A floor and two walls with a random pattern that two captures show with noise of their own."""
    rng, look, size = np.random.default_rng(seed), np.random.default_rng(7), np.array([16, 10, 2.5])
    points, colours = [], []
    for axis in range(3):
        face = rng.uniform(0, 1, (20_000, 3)) * size
        face[:, axis] = 0
        patch = tuple((np.delete(face, axis, 1) / 0.4).astype(int).T)
        shared, own = look.uniform(0.2, 0.8, (40, 25, 3))[patch], rng.uniform(0.2, 0.8, (40, 25, 3))[patch]
        points.append(face)
        colours.append((1 - noise) * shared + noise * own)
    return Surface(np.concatenate(points), np.concatenate(colours).astype(np.float32), 0.05)


@pytest.mark.guards("answers")
def test_noise_is_no_repetition() -> None:
    level = np.array([0.0, 0, 1])
    for noise in (0.5, 0.6):
        repetition = Repetition(room(1, noise), room(2, noise), Sim3.identity(), level)
        assert 0.2 < repetition.similarity(Sim3.identity()) < 0.7
        found = repetition.elsewhere()
        assert not any(similarity > MARGIN for _, similarity in found)
        assert all(similarity > MARGIN / 4 for _, similarity in found)  # not where they have nothing in common


def test_where_colours_are_even_nothing_is_similar() -> None:
    captures, size = [], np.array([16, 10, 2.5])
    look = np.random.default_rng(3).uniform(0.1, 0.9, (40, 25, 7, 3))
    for seed in (1, 2):
        points = np.random.default_rng(seed).uniform(0, 1, (120_000, 3)) * size
        for axis in range(3):
            points[axis::3, 2 - axis] = 0
        colours = look[tuple((points / 0.4).astype(int).T)]
        colours[(points[:, :2] > 4).any(1)] = 0.6
        captures.append(Surface(points, colours.astype(np.float32), 0.05))
    assert Repetition(*captures, Sim3.identity(), np.array([0.0, 0, 1])).elsewhere() == []


def test_points_far_outside_change_nothing() -> None:
    plain, stray = [room(1, 0.3), room(2, 0.3)], []
    far = np.array([1e5, 0, 0]) + np.random.default_rng(0).normal(0, 0.05, (12, 3))
    for surface in plain:
        points, colours = np.concatenate([surface.points, far]), np.concatenate([surface.colours, surface.colours[:12]])
        stray.append(Surface(points, colours, 0.05))
    identity, level = Sim3.identity(), np.array([0.0, 0, 1])
    expected, found = (Repetition(*pair, identity, level) for pair in (plain, stray))
    assert found.similarity(identity) == expected.similarity(identity)
    assert found.elsewhere() == expected.elsewhere()


def test_too_little_in_common_is_not_known() -> None:
    small = Surface(np.random.default_rng(0).uniform(0, 1, (500, 3)), np.full((500, 3), 0.5, np.float32), 0.05)
    repetition = Repetition(small, small, Sim3.identity(), np.array([0.0, 0, 1]))
    assert repetition.elsewhere() == []
    assert np.isnan(repetition.similarity(Sim3.identity()))
    assert np.isnan(repetition.similarity(Sim3(np.eye(3), np.array([50.0, 0, 0]))))
    nothing = Surface(np.zeros((0, 3)), np.zeros((0, 3), np.float32), 0.05)
    for target, source in ((nothing, small), (small, nothing)):
        empty = Repetition(target, source, Sim3.identity(), np.array([0.0, 0, 1]))
        assert empty.elsewhere() == []
        assert np.isnan(empty.similarity(Sim3.identity()))
    assert fisher_z(0.5) == pytest.approx(np.arctanh(0.5))
    assert fisher_z(1.0) == fisher_z(0.99) == pytest.approx(np.arctanh(0.98))
