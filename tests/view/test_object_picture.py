"""Pictures of objects: the view that they are drawn from, and what is emphasized."""

import numpy as np

from gsmap.geometry.sh import SH_C0
from gsmap.types import Cameras, Gaussians, PosedScene
from gsmap.view.object_picture import SegmentedViews

RED, BLUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def sheet(z: float, half: float, colour) -> Gaussians:
    """Gaussians of a square sheet at a depth."""
    x, y = (axis.ravel() for axis in np.mgrid[-half:half:0.1, -half:half:0.1] + 0.05)
    sh = np.tile((np.array(colour) - 0.5) / SH_C0, (len(x), 1, 1))
    log_scales = np.log(np.tile([0.08, 0.08, 0.005], (len(x), 1)))
    return Gaussians(np.c_[x, y, np.full_like(x, z)], np.tile([1.0, 0, 0, 0], (len(x), 1)), log_scales, x * 0 + 8, sh)


def cameras(*places) -> Cameras:
    """Cameras at points, of which those beyond z = 2 look back."""
    poses = np.stack([np.diag([1.0, 1, 1, 1]) if z < 2 else np.diag([-1.0, 1, -1, 1]) for _, _, z in places])
    poses[:, :3, 3] = places
    n = len(places)
    return Cameras(poses, np.tile([160.0, 160, 80, 60], (n, 1)), np.tile([160, 120], (n, 1)))


def views(*places) -> SegmentedViews:
    """A red square at z = 2 in front of a blue wall, 5 cm behind it, seen from some points."""
    parts = [sheet(2.0, 0.4, RED), sheet(2.05, 2.0, BLUE)]
    members = np.repeat([0, -1], [len(part) for part in parts])
    return SegmentedViews(PosedScene(Gaussians.concatenate(parts), cameras(*places), "s"), members)


def draw(scene: SegmentedViews, segment: int = 0) -> np.ndarray | None:
    found = scene.best_views()
    view = found[segment] if segment < len(found) else None
    return None if view is None else scene.draw(segment, view, 160)


def share(picture, channel) -> float:
    """Return the fraction of pixels in which a colour clearly prevails."""
    other = np.delete(picture, channel, axis=2).max(2)
    return float((picture[..., channel] > other + 150.0).mean())


def test_a_view_from_behind_a_thin_wall_or_with_the_object_at_its_border_is_not_taken():
    for worse in ((0.0, 0, 4), (-0.9, 0, 0.5)):
        found = draw(views(worse, (0.0, 0, 0.5), worse))
        assert found.shape == (120, 160, 3)
        assert np.allclose(found, draw(views((0.0, 0, 0.5))), atol=2)
        assert 0.1 < share(found, 0) < 0.6
        column = np.nonzero(found[60, :, 0] > 220)[0]
        assert abs(column.mean() - 80) < 8, "the object is in the middle"


def test_surroundings_are_faded_and_small_objects_have_context():
    found = draw(views((0.0, 0, -6.0)))
    assert share(found, 2) < 0.02, "the wall is faded"
    assert share(found, 0) < 0.15


def test_a_view_onto_the_face_is_preferred_and_nothing_is_drawn_grey():
    c, s = np.cos(np.radians(70)), np.sin(np.radians(70))
    oblique, front = np.eye(4), np.eye(4)
    oblique[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    oblique[:3, 3] = np.array([0, 0, 2.0]) - oblique[:3, 2]
    both = Cameras(np.stack([oblique, front]), np.tile([160.0, 160, 80, 60], (2, 1)), np.tile([160, 120], (2, 1)))
    alone = SegmentedViews(PosedScene(sheet(2.0, 0.4, RED), both, "s"), np.zeros(64, int))
    assert alone.best_views()[0].camera == 1
    assert (draw(alone)[:, [0, -1]] > 100).all()


def test_what_no_view_shows_has_no_picture():
    assert draw(views((0.0, 0, 4.0))) is None
    assert draw(views((0.0, 0, 0.5)), 7) is None
    nothing = SegmentedViews(PosedScene(sheet(2.0, 0.4, RED), cameras((0.0, 0, 0.5))[:0], "s"), np.zeros(64, int))
    assert draw(nothing) is None
