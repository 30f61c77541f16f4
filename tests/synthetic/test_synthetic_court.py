"""A court: as large as it says, the same by its seed, walked clear of everything, captured with exact truth."""

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap.types import Sim3
from gsmap_synthetic.court import FAR_M, court_captures, make_court, stroll, walks


@pytest.fixture(scope="module")
def court():
    return make_court(3, texel_m=0.3)


def test_a_court_is_as_large_as_it_says_and_the_same_by_its_seed(court):
    corners = court.skin.corners.reshape(-1, 3)
    assert np.ptp(corners[:, 0]) > 60
    assert np.ptp(corners[:, 1]) > 25
    assert corners[:, 2].max() > 6
    again = make_court(3, texel_m=0.3)
    np.testing.assert_array_equal(again.skin.corners, court.skin.corners)
    np.testing.assert_array_equal(again.skin.texels[0], court.skin.texels[0])
    assert len(make_court(4, texel_m=0.3).skin.corners) != len(court.skin.corners)
    with pytest.raises(ConfigError):
        make_court(0, length_m=20)


def test_its_columns_repeat_at_one_pitch_and_its_houses_do_not(court):
    arcade = next(o for o in court.objects if o.name == "arcade")
    corners = court.skin.corners[court.skin.owners == arcade.id]
    at = np.sort(corners[corners[..., 2].min(1) < 0.1][..., 0].min(1))  # the feet of columns
    columns = at[np.r_[True, np.diff(at) > 1.0]]
    assert len(columns) > 15
    assert np.ptp(np.diff(columns)) < 0.01
    houses = [court.skin.corners[court.skin.owners == o.id] for o in court.objects if o.name == "house"]
    assert len({(round(float(np.ptp(h[..., 0])), 2), round(float(h[..., 2].max()), 2)) for h in houses}) > 10


def test_walks_see_houses_from_afar_and_share_from_most_to_nothing(court):
    at = walks(court, 6)
    assert len(set(at)) == 6
    assert np.ptp(at) > 30
    poses = stroll(court, at[0], 12, 0)
    np.testing.assert_array_equal(poses, stroll(court, at[0], 12, 0))
    assert np.abs(poses[:, 0, 3] - at[0]).max() < 12
    forward = np.broadcast_to(poses[:, :3, 2], (12, 3))
    distance = court.skin.cast(poses[:, :3, 3], forward)[0]
    assert 3 < np.median(distance[np.isfinite(distance)]) < 25


def test_captures_of_a_court_know_where_they_are(court):
    captures = court_captures(3, 2, num_frames=8, num_gaussians=3000, size_px=(96, 72))
    for capture in captures:
        world = Sim3.from_matrix(capture.T_scene_world).inverse()
        points = world.apply(capture.gaussians.means)
        assert world.scale == pytest.approx(1.0)
        assert -1 < points[:, 2].min() < 0.1
        assert points[:, 2].max() < 12
        eyes = world.apply(capture.cameras.centers)
        nearest = np.linalg.norm(points[:, None] - eyes[None], axis=2).min(1)
        assert nearest.max() < FAR_M * 1.4
        assert np.abs(eyes[:, 2] - 1.6).max() < 0.2
