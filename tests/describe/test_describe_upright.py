"""Upright: right to 5 degrees, or not told, however the cameras are held."""

from functools import cache

import numpy as np
import pytest
from describe_places import room
from made_room import furnished
from scipy.spatial.transform import Rotation

from gsmap.describe.camera_orientations import CameraOrientations
from gsmap.describe.cloud import surface_cloud
from gsmap.describe.gravity import _confirmed, estimate_up
from gsmap.types import Cameras

FRAME = Rotation.random(random_state=3).as_matrix()
PITCHES = (0, 30, 45, 60, 75, 90)


@cache
def surface(name: str) -> np.ndarray:
    """Points of a furnished room without a ceiling, where walls and floor are alike, or of a whole one."""
    points = surface_cloud(furnished()[0] if name == "open" else room(n=10000)[0]).points
    points = points[points[:, 2] < 1.4] if name == "open" else points
    return points[:: len(points) // (1500 if name == "open" else 5000)] @ FRAME.T


def held(pitch_deg: float, turn_deg: float, roll_deg: float = 0, *, way_m=(1.0, 0.8, 0.05), jitter_deg=2.0) -> Cameras:
    """40 cameras that look down by a pitch, spread over a turn, on a walk of some width along x, y and z."""
    rng, poses = np.random.default_rng(0), np.tile(np.eye(4), (40, 1, 1))
    for i, pose in enumerate(poses):
        yaw, pitch = np.radians(turn_deg * (i / 40 - 0.5)), np.radians(pitch_deg)
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
        right = np.array([np.sin(yaw), -np.cos(yaw), 0])
        level = np.stack([right, np.cross(forward, right), forward], 1)
        shaken = Rotation.from_rotvec(np.radians(jitter_deg) * rng.normal(size=3)).as_matrix()
        pose[:3, :3] = FRAME @ level @ Rotation.from_euler("z", roll_deg, degrees=True).as_matrix() @ shaken
        pose[:3, 3] = FRAME @ (np.array([2.0, 1.5, 1.5]) + rng.uniform(-1, 1, 3) * way_m)
    return Cameras(poses, np.tile([200.0, 200, 160, 120], (40, 1)), np.tile([320, 240], (40, 1)))


def off_deg(up: np.ndarray | None) -> float:
    """How far a vertical is off; 0 where none is told."""
    return 0.0 if up is None else float(np.degrees(np.arccos(np.clip(up @ FRAME[:, 2], -1, 1))))


@pytest.mark.parametrize("roll", [0, 15, 90, -90])
@pytest.mark.parametrize("pitch", PITCHES)
def test_a_strip_on_one_heading_is_told_right_or_not_at_all(pitch, roll):
    for way_m in ((1.0, 0.8, 0.05), (1.0, 0.02, 0.02)):
        assert off_deg(estimate_up(surface("open"), held(pitch, 15, roll, way_m=way_m))) < 5


@pytest.mark.parametrize("pitch", PITCHES)
def test_cameras_that_turn_tell_the_vertical_at_any_pitch(pitch):
    for turn in (90, 360):
        up = estimate_up(surface("open"), held(pitch, turn))
        assert up is not None
        assert off_deg(up) < 1


@pytest.mark.parametrize("turn", [90, 360])
def test_cameras_on_their_side_tell_it_where_the_room_or_the_view_knows_the_sign(turn):
    for roll in (90, -90):
        told = [estimate_up(surface("whole"), held(pitch, turn, roll)) for pitch in (15, 45, 75)]
        assert all(up is not None and off_deg(up) < 1 for up in told)
        assert estimate_up(surface("open"), held(20, turn, roll)) is None


def test_a_level_walk_on_one_heading_keeps_its_vertical():
    for pitch in (10, 30, 45):
        up = estimate_up(surface("open"), held(pitch, 0))
        assert up is not None
        assert off_deg(up) < 1


def test_a_shaken_camera_that_stands_still_says_nothing_where_the_room_does_not():
    still = held(45, 0, way_m=(0.05, 0.05, 0.05))
    assert estimate_up(surface("open"), still) is None
    assert off_deg(estimate_up(surface("whole"), still)) < 1
    assert estimate_up(surface("whole"), still) is not None


def test_upside_down_or_looking_up_is_not_believed():
    assert estimate_up(surface("open"), held(-45, 360)) is None
    assert estimate_up(surface("open"), held(45, 360, 180)) is None


def test_what_bears_no_witness_on_one_heading():
    def told(cameras, room=None):
        return _confirmed(CameraOrientations.of(cameras), surface("open"), [*FRAME.T], room)

    x, y, z = FRAME.T
    assert told(held(30, 0)) @ z > 0.99  # a level walk does
    assert told(held(10, 0, way_m=(0.02, 1.0, 1.0))) is None  # along a facade, looking at it
    assert told(held(30, 0, way_m=(0.2, 0.2, 0.01))) is None  # an arm's sway
    still = held(0, 0, way_m=(0.02, 0.02, 0.02))
    assert told(still, room=z) @ z > 0.99
    assert told(still, room=x) is None  # they would look straight up
    assert told(held(30, 0), room=y) is None  # the walk says otherwise
