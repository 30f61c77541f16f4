"""Rooms of made plans: boxes of walls with doors, as flat Gaussians."""

import numpy as np
import pytest

from gsmap.geometry.rotations import matrices_to_quats
from gsmap.objects import find_rooms
from gsmap.types import Gaussians
from gsmap.types.room import Room

HEIGHT, DOOR = 2.5, 2.05


def panel(corner, across, up, step=0.08) -> tuple[np.ndarray, np.ndarray]:
    """Points all over a rectangle, and their frames (normal last)."""
    corner, across, up = (np.array(v, float) for v in (corner, across, up))
    a, b = (max(int(np.linalg.norm(v) / step), 1) for v in (across, up))
    u, v = np.meshgrid((np.arange(a) + 0.5) / a, (np.arange(b) + 0.5) / b)
    points = corner + u.reshape(-1, 1) * across + v.reshape(-1, 1) * up
    x, y = across / np.linalg.norm(across), up / np.linalg.norm(up)
    return points, np.tile(np.stack([x, y, np.cross(x, y)], 1), (len(points), 1, 1))


def gaussians(*panels) -> Gaussians:
    points, frames = (np.concatenate(part) for part in zip(*panels, strict=True))
    n = len(points)
    scales = np.tile([0.05, 0.05, 0.004], (n, 1))
    return Gaussians(points, matrices_to_quats(frames), np.log(scales), np.full(n, 3.0), np.zeros((n, 1, 3)))


def wall_x(y, x0, x1, z0=0.0, z1=HEIGHT):
    return panel([x0, y, z0], [x1 - x0, 0, 0], [0, 0, z1 - z0])


def wall_y(x, y0, y1, z0=0.0, z1=HEIGHT):
    return panel([x, y0, z0], [0, y1 - y0, 0], [0, 0, z1 - z0])


def flat(lintel=True, door=(1.5, 2.4), leaf=False, wardrobe=True) -> Gaussians:
    """Two rooms of 4 x 4 m and 2.5 x 4 m side by side, both sides of the wall between seen."""
    parts = [panel([0, 0, z], [6.6, 0, 0], [0, 4, 0]) for z in (0.0, HEIGHT)]
    parts += [wall_x(y, 0, 6.6) for y in (0.0, 4.0)] + [wall_y(x, 0, 4) for x in (0.0, 6.6)]
    for x in (4.0, 4.1):
        parts += [wall_y(x, 0, door[0]), wall_y(x, door[1], 4)]
        if lintel:
            parts.append(wall_y(x, *door, DOOR, HEIGHT))
    if leaf:
        parts.append(wall_y(4.05, *door, 0, DOOR))
    if wardrobe:
        parts += [wall_x(2.0, 0.5, 3.0, 0, 1.9), wall_x(1.4, 0.5, 3.0, 0, 1.9)]
    parts += [wall_x(2.0, 5.2, 5.5, 2.1, 2.5), wall_y(5.35, 1.85, 2.15, 2.1, 2.5)]  # a lamp, 1.1 m from either wall
    return gaussians(*parts)


EYES = np.array([[1.0, 1, 1.5], [5, 1, 1.6]])


def test_walls_and_lintels_part_rooms_and_furniture_does_not():
    large, small = find_rooms([flat()], EYES)
    assert large.area_m2 == pytest.approx(16, rel=0.08)
    assert small.area_m2 == pytest.approx(10, rel=0.08)
    np.testing.assert_allclose(large.box, [[0, 0, 0], [4, 4, HEIGHT]], atol=0.16)
    assert large.holds(np.array([1.0, 3, 1]))
    assert not large.holds(np.array([6.0, 2, 1]))
    assert not large.holds(np.array([1.0, 3, 4]))


def test_a_passage_parts_rooms_where_nobody_saw_its_lintel():
    assert len(find_rooms([flat(lintel=False)], EYES)) == 2
    (one,) = find_rooms([flat(lintel=False, door=(0.6, 3.4))], EYES)
    assert one.area_m2 == pytest.approx(26, rel=0.08), "an opening of 2.8 m is no door"


@pytest.mark.parametrize("lintel", [True, False])
def test_one_can_walk_through_open_doors_alone(lintel):
    opened, shut = flat(lintel), flat(lintel, leaf=True)
    assert [room.doors for room in find_rooms([opened], EYES)] == [(1,), (0,)]
    if lintel:  # else the leaf is no wall up to the ceiling
        assert [room.doors for room in find_rooms([shut], EYES)] == [(), ()]
    assert [room.doors for room in find_rooms([shut, opened], EYES)] == [(1,), (0,)]


def test_storeys_are_told_by_where_cameras_stood():
    upper = flat(wardrobe=False)
    upper = Gaussians(
        upper.means + np.array([0, 0, 3.0]), upper.quats, upper.log_scales, upper.logit_opacities, upper.sh
    )
    rooms = find_rooms([flat(), upper], np.concatenate([EYES, EYES + np.array([0, 0, 3.0])]))
    assert sorted(round(room.floor_m) for room in rooms) == [0, 0, 3, 3]
    for room in rooms:
        assert all(rooms[other].floor_m == room.floor_m for other in room.doors)


def test_captures_that_show_little_have_no_rooms():
    assert find_rooms([], np.zeros((0, 3))) == []
    assert find_rooms([gaussians(panel([0, 0, 0], [0.5, 0, 0], [0, 0.5, 0]))], EYES) == []


def test_rooms_are_told_without_cameras():
    assert len(find_rooms([flat()], np.zeros((0, 3)))) == 2


def test_the_outline_of_a_floor_parts_what_is_inside_from_what_is_not():
    rng = np.random.default_rng(5)
    cells = rng.random((9, 7)) < 0.6  # pieces that touch at corners, and holes
    room = Room(np.array([1.0, -2.0]), cells, 0.5, 0.1, 2.5)
    outline = room.outline
    assert outline.shape[1:] == (2, 3)
    assert (outline[..., 2] == 0.1).all()
    across = outline[:, 0, 1] == outline[:, 1, 1]  # pieces along x
    for x, column in enumerate(cells):
        for y, inside in enumerate(column):
            at = room.low + (np.array([x, y]) + 0.5) * 0.5
            below = outline[across & (outline[:, 0, 1] < at[1])]
            crossed = (below[..., 0].min(1) < at[0]) & (at[0] < below[..., 0].max(1))
            assert crossed.sum() % 2 == inside
    padded = np.pad(cells, 1).astype(int)
    borders = np.abs(np.diff(padded, axis=0)).sum() + np.abs(np.diff(padded, axis=1)).sum()
    assert np.linalg.norm(outline[:, 1] - outline[:, 0], axis=1).sum() == pytest.approx(0.5 * borders)


def test_a_straight_wall_is_one_piece_of_the_outline():
    cells = np.ones((6, 4), bool)
    cells[3:, 2:] = False
    assert len(Room(np.zeros(2), cells, 0.1, 0.0, 2.5).outline) == 6
