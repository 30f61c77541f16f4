"""A street front: its facade comes again after every window, its road does not, and captures of it have exact truth."""

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap.types import Sim3
from gsmap_synthetic.facade import FAR_M, front_captures, front_walk, make_front

PITCH_M = 3.0


@pytest.fixture(scope="module")
def front():
    return make_front(5, length_m=24.0, pitch_m=PITCH_M, texel_m=0.2)


def _quads(front, name):
    return [np.flatnonzero(front.skin.owners == thing.id) for thing in front.objects if thing.name == name]


def test_bays_without_curtains_are_one_bay_moved_along(front):
    bays = _quads(front, "bay")
    assert len(bays) == 8
    plain = min(map(len, bays))
    same = [k for k, bay in enumerate(bays) if len(bay) == plain]
    assert 2 <= len(same) < len(bays)  # a third of the windows have curtains
    first = bays[same[0]]
    for k in same[1:]:
        moved = front.skin.corners[bays[k]] - [(k - same[0]) * PITCH_M, 0, 0]
        np.testing.assert_allclose(moved, front.skin.corners[first], atol=1e-5)
        materials = [[front.surfaces.materials[q] for q in bay] for bay in (bays[k], first)]
        assert all(a is b for a, b in zip(*materials, strict=True))
        assert [front.surfaces.origins_m[q] for q in bays[k]] == [front.surfaces.origins_m[q] for q in first]


def test_the_road_does_not_repeat_and_a_seed_names_a_front(front):
    (road,) = _quads(front, "road")
    low = front.skin.corners[road].min(1)
    patches = low[low[:, 2] > 0.01][:, :2]
    assert len(patches) > 10
    for k in range(1, 7):  # no patch lies where another one does, some windows further on
        apart = np.linalg.norm(patches[:, None] + [k * PITCH_M, 0] - patches[None], axis=2)
        assert (apart < 0.02).sum() == 0
    again = make_front(5, length_m=24.0, pitch_m=PITCH_M, texel_m=0.2)
    np.testing.assert_array_equal(again.skin.corners, front.skin.corners)
    other = make_front(6, length_m=24.0, pitch_m=PITCH_M, texel_m=0.2)
    assert other.skin.corners.shape != front.skin.corners.shape
    with pytest.raises(ConfigError):
        make_front(0, length_m=5.0)


def test_walks_keep_before_the_front_and_look_at_it(front):
    poses = front_walk(front, 4.0, 12.0, 24, seed=1)
    assert poses.shape == (24, 4, 4)
    at, ahead = poses[:, :3, 3], poses[:, :3, 2]
    assert (at[:, 0] >= 3.9).all()
    assert (at[:, 0] <= 16.1).all()
    assert (at[:, 1] > 3).all()
    assert (ahead[:, 1] < -0.5).all()


def test_captures_have_exact_truth(front):
    (a, b) = front_captures(front, (2.0, 8.0), reach_m=8.0, num_frames=10, num_gaussians=1500, size_px=(80, 60))
    for capture, start in ((a, 2.0), (b, 8.0)):
        back = Sim3.from_matrix(capture.T_scene_world).inverse().apply(capture.gaussians.means)
        assert back[:, 2].min() > -0.3  # the road
        assert np.percentile(back[:, 1], 1) > -0.5  # the facade
        assert back[:, 0].min() > start - FAR_M
        assert back[:, 0].max() < start + 8.0 + FAR_M
    assert not np.allclose(a.T_scene_world, b.T_scene_world)
