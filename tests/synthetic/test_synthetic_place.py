"""A synthetic place: the same from the same seed, another from another, and geometrically what its plan says."""

import numpy as np
import pytest

from gsmap.errors import ConfigError
from gsmap_synthetic import film, make_place, walk
from gsmap_synthetic.place import CEILING_M


def test_same_seed_same_place_other_seed_another(place):
    again, other = make_place(3, texel_m=0.04), make_place(4, texel_m=0.2)
    np.testing.assert_array_equal(place.skin.corners, again.skin.corners)
    np.testing.assert_array_equal(place.skin.texels[0], again.skin.texels[0])
    assert len(other.skin.corners) != len(place.skin.corners)
    assert not np.allclose(place.rooms[0].rect_m, other.rooms[0].rect_m)


def test_cast_meets_floor_and_ceiling_at_the_distance_of_the_plan(place):
    # Over a doorway's threshold there is nothing but the floor below and the lining 2.05 m up.
    door = place.doors[0].xy
    origin = np.array([[*door, 1.5], [*door, 1.5]])
    distance, *_ = place.skin.cast(origin, np.array([[0, 0, -1.0], [0, 0, 1.0]]))
    np.testing.assert_allclose(distance, [1.5, 0.55], atol=1e-5)
    assert place.skin.corners[..., 2].max() == pytest.approx(CEILING_M)


def test_depth_and_texture_coordinates_agree_with_the_hit_point(place):
    poses = walk(place, (0, 1), 12)
    frames = film(place, poses, size_px=(64, 48))
    y, x = 30, 41
    for i in range(0, 12, 3):
        fx, fy, cx, cy = frames.cameras.intrinsics_px[i]
        ray = np.array([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, 1.0])
        point = poses[i] @ np.append(ray * frames.depths_m[i, y, x], 1.0)
        _, quad, s, t = place.skin.cast(poses[i][None, :3, 3], (poses[i][:3, :3] @ ray)[None])
        p00, p10, p11, p01 = place.skin.corners[quad[0]]
        s, t = float(s[0]), float(t[0])
        at = (1 - s) * (1 - t) * p00 + s * (1 - t) * p10 + s * t * p11 + (1 - s) * t * p01
        np.testing.assert_allclose(at, point[:3], atol=2e-2 if not np.allclose(p10 - p00, p11 - p01) else 1e-4)


def test_a_shut_door_stops_the_eye_and_an_open_one_does_not(place):
    door = place.doors[0]
    across = np.array([[0.0, 1.0, 0.0] if door.along_x else [1.0, 0.0, 0.0]])
    eye = np.array([[*door.xy, 1.4]]) - 0.5 * across
    through, *_ = place.skin.cast(eye, across)
    stopped, *_ = place.skin.with_shut([0]).cast(eye, across)
    other, *_ = place.skin.with_shut([1]).cast(eye, across)
    assert stopped[0] == pytest.approx(0.48, abs=1e-4)  # The leaf is 4 cm thick.
    assert through[0] == other[0] > 0.6


def test_a_wall_seen_head_on_has_constant_depth(place):
    room = place.rooms[0]
    up = np.array([0, 0, 1.0])
    forward = up  # Straight up at the ceiling, from just below it and away from the lamp.
    right = np.array([1.0, 0, 0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = [room.rect_m[0] + 0.35, room.rect_m[1] + 0.2, CEILING_M - 0.05]
    depth = film(place, pose[None], size_px=(32, 24)).depths_m[0]
    np.testing.assert_allclose(depth, 0.05, atol=1e-5)


def test_every_room_can_be_walked_without_touching_anything(place):
    for route in [(0, 1), (1, 2), (0, 2)]:
        depth = film(place, walk(place, route, 40), size_px=(64, 48)).depths_m
        assert (depth > 0).all(), "a ray left the flat"
        assert np.median(depth) > 1.0
        assert depth.min() > 0.1


def test_twin_wings_look_alike_but_the_corridor_does_not():
    place = make_place(5, twin=True, texel_m=0.2)
    assert len(place.rooms) == 7
    assert {(d.a, d.b) for d in place.doors} >= {(0, 6), (3, 6)}
    poses = walk(place, (0, 1), 10)
    shifted = poses.copy()
    shifted[:, :2, 3] += place.rooms[3].rect_m[:2] - place.rooms[0].rect_m[:2]
    first, second = film(place, poses, size_px=(64, 48)), film(place, shifted, size_px=(64, 48))
    same = np.abs(first.depths_m - second.depths_m) < 1e-3
    assert same.mean() > 0.97  # All but what is seen through the door to the corridor.
    assert np.abs(first.images.astype(int) - second.images)[same].mean() < 4
    corridor = walk(place, (0, 6, 3), 20)
    assert len(corridor) == 20


def test_refuses_what_makes_no_sense(place):
    with pytest.raises(ConfigError, match="at least 3 rooms"):
        make_place(0, rooms=2)
    with pytest.raises(ConfigError, match="no doorway"):
        walk(place, (0, 0), 40)
    with pytest.raises(ConfigError, match="needs at least"):
        walk(place, (0, 1), 5)
