"""Floor plans show walls where they stand, and orthophotos no ceilings."""

import numpy as np
import pytest

from gsmap.export.survey_files import pixel_size, polygons_of
from gsmap.map.world.survey_export import _below_ceiling, _walls
from gsmap.types import Gaussians


def room() -> Gaussians:
    """Walls of 6 x 4 m around a pillar of 1 x 1 m, with floor and ceiling, 2.5 m high."""
    rng = np.random.default_rng(0)
    parts = []
    for low, high in (((0, 0), (6, 4)), ((2, 1.5), (3, 2.5))):
        for axis in (0, 1):
            for side in (low[axis], high[axis]):
                along = rng.uniform(low[1 - axis], high[1 - axis], 6000)
                flat = np.full((6000, 2), float(side))
                flat[:, 1 - axis] = along
                parts.append(np.c_[flat, rng.uniform(0, 2.5, 6000)])
    for height in (0.0, 2.5):
        parts.append(np.c_[rng.uniform(0, 6, 4000), rng.uniform(0, 4, 4000), np.full(4000, height)])
    points = np.concatenate(parts)
    n = len(points)
    return Gaussians(
        points, np.tile([1.0, 0, 0, 0], (n, 1)), np.full((n, 3), -4.0), np.full(n, 3.0), np.zeros((n, 1, 3))
    )


EYES = np.tile([3.0, 3.0, 1.5], (5, 1))


def test_walls_are_polygons_with_the_room_as_a_hole():
    ((properties, found),) = _walls(room(), EYES)
    assert properties == {"kind": "walls", "above_floor_m": [0.6, 1.35]}
    polygons = sorted(polygons_of(found), key=lambda polygon: -np.ptp(polygon[0], axis=0).max())
    assert [len(polygon) for polygon in polygons] == [2, 2]  # the walls around the room, the pillar around its inside
    for polygon, low, high in zip(polygons, ((0, 0), (2, 1.5)), ((6, 4), (3, 2.5)), strict=True):
        np.testing.assert_allclose(polygon[0].min(0), low, atol=0.06)
        np.testing.assert_allclose(polygon[0].max(0), high, atol=0.06)
        np.testing.assert_allclose(polygon[1].min(0), low, atol=0.06)
        np.testing.assert_allclose(polygon[1].max(0), high, atol=0.06)


def test_ceilings_are_left_out_and_ground_below_a_drone_is_not():
    shown, note = _below_ceiling(room(), EYES)
    assert shown.means[:, 2].max() < 1.96
    assert "1.95 m" in note
    assert len(_below_ceiling(room(), EYES + np.array([0, 0, 30]))[0]) == len(room())
    assert len(_below_ceiling(room(), np.zeros((0, 3)))[0]) == len(room())


@pytest.mark.parametrize(("metres", "pixel"), [(30, 0.005), (80, 0.01), (800, 0.1), (9000, 2)])
def test_pixels_have_round_sizes(metres, pixel):
    assert pixel_size(np.array([metres, metres / 2]), None, 8192, 10**9) == pytest.approx(pixel)
