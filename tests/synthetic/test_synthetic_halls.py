"""Halls that repeat: one bay is the next one moved along, a room is itself turned, and captures have exact truth."""

from typing import get_args

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap.types import Sim3
from gsmap_synthetic.halls import FAR_M, REACH_M, STEP_M, Kind, hall_captures, make_hall

KINDS = get_args(Kind)


def _quads(place, name):
    return [np.flatnonzero(place.skin.owners == thing.id) for thing in place.objects if thing.name == name]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "symmetric room"])
def test_every_bay_is_the_first_one_moved_along(kind):
    hall = make_hall(kind, 4, unique=0.0, texel_m=0.3)
    first, *others = _quads(hall, "bay")
    assert len(others) > 5
    corners = hall.skin.corners
    period = (corners[others[0]] - corners[first]).mean((0, 1))
    axis = 2 if kind == "stairwell" else 0
    np.testing.assert_allclose(np.delete(period, axis), 0, atol=1e-5)
    for k, bay in enumerate(others, 1):
        np.testing.assert_allclose(
            corners[bay] - corners[first], np.broadcast_to(k * period, (len(bay), 4, 3)), atol=1e-4
        )
        assert [hall.surfaces.origins_m[q] for q in bay] == [hall.surfaces.origins_m[q] for q in first]
    assert not _quads(hall, "thing")
    assert len(_quads(make_hall(kind, 4, unique=1.0, texel_m=0.3), "thing")) > 3


def test_a_symmetric_room_is_itself_after_half_a_turn():
    room = make_hall("symmetric room", 2, unique=0.0, texel_m=0.3)
    walls = _quads(room, "wall")
    assert len(walls) == 4
    for one, across in ((walls[0], walls[2]), (walls[1], walls[3])):
        turned = room.skin.corners[one] * [-1, -1, 1]
        np.testing.assert_allclose(turned, room.skin.corners[across], atol=1e-4)
    with pytest.raises(ConfigError):
        make_hall("cellar", 0)


def test_captures_of_a_hall_lie_where_their_truth_says():
    hall = make_hall("corridor", 3, texel_m=0.3)
    captures = hall_captures(hall, "corridor", 2, num_frames=6, num_gaussians=500)
    middles = []
    for capture in captures:
        S = Sim3.from_matrix(capture.T_scene_world).inverse()
        content, at = S.apply(capture.gaussians.means), S.apply(capture.cameras.T_frame_camera[:, :3, 3])
        assert (np.abs(content[:, 1]) < 1.3).all()  # between the walls
        assert content[:, 2].min() > -0.1
        assert np.ptp(at[:, 0]) < REACH_M + 0.1
        assert np.linalg.norm(content[:, None] - at[None], axis=2).min(1).max() < 1.3 * FAR_M
        middles.append(np.median(at[:, 0]))
    assert middles[1] - middles[0] == pytest.approx(STEP_M, abs=2.5)
