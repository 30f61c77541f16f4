"""Whether a capture shows a thing, shows that it is gone, or did not look: in a made room, by its own renders."""

import numpy as np
import pytest
from made_room import Room, looking_about

from gsmap.geometry.colour import srgb_to_lab
from gsmap.objects import RenderedViews, classify_observation, observe_points, render_views
from gsmap.types import Cameras

GREEN = (0.2, 0.6, 0.3)


def chair() -> tuple[np.ndarray, np.ndarray]:
    """Points and colours of the green chair, by the far wall."""
    room = Room(5)
    start = len(room.points)
    room.box([3.2, 1.2, 0.0], [3.7, 1.8, 0.9], GREEN, 0)
    points = np.concatenate(room.points[start:])
    return points, np.tile(srgb_to_lab(np.array(GREEN)), (len(points), 1)).astype(float)


def eyes(colour=None, cameras: Cameras | None = None, low=(3.2, 1.2, 0.0), high=(3.7, 1.8, 0.9)) -> RenderedViews:
    room = Room(1)
    if colour is not None:
        room.box(list(low), list(high), colour, 0)
    return render_views(room.made()[0], looking_about() if cameras is None else cameras)


def verdict(seen: RenderedViews):
    points, colours = chair()
    return classify_observation(observe_points(seen, points, 1.0), points, colours, np.zeros(3))


@pytest.fixture(scope="module")
def empty() -> RenderedViews:
    return eyes()


def test_what_stands_there_is_seen():
    state, looked = verdict(eyes(GREEN))
    assert state == "seen"
    assert looked > 0.5


def test_what_was_looked_through_is_absent(empty):
    assert verdict(empty)[0] == "absent"


def test_what_nobody_looked_at_is_unseen_and_not_absent():
    behind = looking_about(3, turn_deg=60.0)
    poses = behind.T_frame_camera.copy()
    poses[:, :3, 0] *= -1
    poses[:, :3, 2] *= -1
    state, looked = verdict(eyes(cameras=Cameras(poses, behind.intrinsics_px, behind.sizes_px)))
    assert state == "unseen"
    assert looked < 0.5
    assert verdict(RenderedViews((), (), ()))[0] == "unseen"


def test_a_thing_behind_another_is_unseen():
    screen = eyes((0.5, 0.5, 0.5), low=(2.6, 0.1, 0.0), high=(2.7, 2.9, 2.4))
    assert verdict(screen)[0] == "unseen"


def test_another_thing_in_its_place_is_not_it_but_the_same_one_painted_is():
    assert verdict(eyes((0.8, 0.2, 0.2), high=(3.7, 1.8, 0.8)))[0] == "absent"
    assert verdict(eyes((0.8, 0.2, 0.2)))[0] == "seen"


def test_made_up_cameras_have_seen_nothing():
    gaussians, _ = Room(1).made()
    cameras = looking_about()
    made_up = Cameras(cameras.T_frame_camera, cameras.intrinsics_px, cameras.sizes_px, synthesised=True)
    assert render_views(gaussians, made_up).cameras == ()
    assert render_views(gaussians, None).cameras == ()


def test_units_of_the_capture_do_not_matter(empty):
    points, colours = chair()
    metric = observe_points(empty, points, 1.0)
    centimetres = RenderedViews(
        tuple(
            Cameras(
                np.concatenate(
                    [
                        np.concatenate([c.T_frame_camera[:, :3, :3], 100 * c.T_frame_camera[:, :3, 3:]], 2),
                        c.T_frame_camera[:, 3:],
                    ],
                    1,
                ),
                c.intrinsics_px,
                c.sizes_px,
            )
            for c in empty.cameras
        ),
        tuple(100 * depth for depth in empty.depths),
        empty.colours,
    )
    same = observe_points(centimetres, 100 * points, 0.01)
    assert (same.through != metric.through).mean() < 0.01
    assert classify_observation(same, points, colours, np.zeros(3))[0] == "absent"
