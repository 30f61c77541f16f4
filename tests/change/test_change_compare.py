"""Changes of a made room, against the truth: what came, went, moved, was painted; and what is no change at all."""

import numpy as np
import pytest
from change_room import box, capture, moved_by, plain, shell, stripes
from raising import raises

from gsmap import change
from gsmap.errors import ConfigError
from gsmap.types import PosedScene
from gsmap.view.change_picture import draw_change

STAYS = box(2.2, 2.5, 0.6, 0.5, 0.7, 5)


def segments(report):
    return [c for c in report.changes if c.kind != "lighting"]


def share_near(points, middle, half):
    return (np.abs(points - middle) <= np.asarray(half) + 0.1).all(1).mean()


def test_the_same_room_again_and_at_another_exposure_has_not_changed():
    room = [*shell(), *STAYS, *box(0.9, 1.2, 0.5, 0.4, 0.6, 6)]
    older = capture(room, 1)
    assert change.compare(older, capture(room, 2)).changes == ()
    darker = change.compare(older, capture(room, 2, gain=0.75))
    assert [c.kind for c in darker.changes] == ["lighting"]
    assert darker.gains == pytest.approx([0.75] * 3, abs=0.05)
    assert len(darker.changes[0].before) == 0 == len(darker.changes[0].voxels)


@pytest.mark.parametrize("appears", [False, True])
@pytest.mark.guards("answers")
def test_a_box_that_went_or_came(appears):
    room = [*shell(), *STAYS]
    scenes = [capture([*room, *box(0.9, 1.2, 0.5, 0.4, 0.6, 6)], 1), capture(room, 2)]
    report = change.compare(*(reversed(scenes) if appears else scenes))
    (found,) = segments(report)
    assert found.kind == ("appeared" if appears else "disappeared")
    assert share_near(found.voxels, (0.9, 1.2, 0.3), (0.25, 0.2, 0.3)) > 0.95
    assert np.abs(found.box - [[0.65, 1.0, 0.0], [1.15, 1.4, 0.6]]).max() < 0.12
    rows, none = (found.after, found.before) if appears else (found.before, found.after)
    means = scenes[0].gaussians.means
    inside = (np.abs(means - [0.9, 1.2, 0.33]) < [0.27, 0.22, 0.3]).all(1)
    # The Gaussians of the box, nearly all and nearly nothing else.
    assert np.isin(np.flatnonzero(inside), rows).mean() > 0.85
    assert inside[rows].mean() > 0.9
    assert len(none) < 0.2 * len(rows)
    assert found.confidence > 0.9
    assert 0.5 < report.seen_share <= 1


@pytest.mark.parametrize(("yaw", "to"), [(0.0, (1.25, 1.2)), (1.2, (2.0, 1.0))])
@pytest.mark.guards("answers")
def test_a_box_that_moved_is_one_change_with_its_pose(yaw, to):
    room = [*shell(), *STAYS]
    report = change.compare(
        capture([*room, *box(0.9, 1.2, 0.6, 0.4, 0.5, 6)], 1),
        capture([*room, *box(*to, 0.6, 0.4, 0.5, 6, yaw=yaw)], 2),
    )
    (found,) = segments(report)
    assert found.kind == "moved"
    assert found.symmetry == "none"
    truth = moved_by(yaw, (0.9, 1.2), to)
    corners = np.array([[0.6, 1.0, 0], [1.2, 1.4, 0.5], [0.6, 1.4, 0.5]])
    assert np.linalg.norm(found.S_after_before.apply(corners) - truth.apply(corners), axis=1).max() < 0.05
    assert found.S_after_before.is_rigid
    assert found.S_after_before.rotation[2, 2] == pytest.approx(1)
    assert len(found.before) > 100 < len(found.after)


def test_a_box_of_one_colour_says_that_half_a_turn_is_not_known():
    room = [*shell(), *STAYS]
    grey = plain(0.7, 0.3, 0.2)
    report = change.compare(
        capture([*room, *box(0.9, 1.2, 0.7, 0.35, 0.5, 6, paint=grey)], 1),
        capture([*room, *box(1.9, 0.9, 0.7, 0.35, 0.5, 6, yaw=0.8, paint=grey)], 2),
    )
    (found,) = segments(report)
    assert (found.kind, found.symmetry) == ("moved", "half")


def test_another_box_elsewhere_is_not_the_one_that_went():
    room = [*shell(), *STAYS]
    report = change.compare(
        capture([*room, *box(0.9, 1.2, 0.6, 0.4, 0.5, 6)], 1),
        capture([*room, *box(2.0, 1.0, 0.6, 0.4, 0.5, 9)], 2),
    )
    assert sorted(c.kind for c in segments(report)) == ["appeared", "disappeared"]


def test_paint_is_no_move_and_its_cells_are_the_wall_or_the_box():
    segment = (0.9, 1.2, 0.5, 0.4, 0.6)
    room = [*shell(), *STAYS, *box(*segment, 6)]
    older = capture(room, 1)
    (wall,) = segments(change.compare(older, capture([*shell(plain(0.2, 0.3, 0.7)), *STAYS, *box(*segment, 6)], 2)))
    assert wall.kind == "recoloured"
    assert (wall.voxels[:, 1] > 2.8).mean() > 0.95
    painted = [*shell(), *STAYS, *box(*segment, 6, paint=plain(0.9, 0.8, 0.1))]
    (repainted,) = segments(change.compare(older, capture(painted, 2)))
    assert repainted.kind == "recoloured"
    assert share_near(repainted.voxels, (0.9, 1.2, 0.3), (0.25, 0.2, 0.3)) > 0.95


@pytest.mark.guards("answers")
def test_what_one_capture_did_not_see_has_not_changed():
    # The newer capture looks away from the box that is gone.
    room = [*shell(), *STAYS]
    newer = capture(room, 2, toward=(2.9, 2.9, 0.9), angles=(0.1, 0.5))
    away = change.compare(capture([*room, *box(0.5, 0.5, 0.4, 0.4, 0.5, 6)], 1), newer)
    assert segments(away) == []
    assert away.seen_share < 0.9
    blind = change.compare(capture(room, 1), PosedScene(capture(room, 2).gaussians, None, "b"))
    assert blind.changes == ()
    assert "no cameras" in blind.notes[0]


@pytest.mark.guards("answers")
def test_the_faces_of_a_thin_wall_are_not_compared_with_each_other():
    """Each capture observes one face, 3 cm from the other; a face that both observe and that was painted is found."""
    floor = shell()[0]
    front = ([0.8, 1.50, 0], [1.2, 0, 0], [0, 0, 1.6], plain(0.7, 0.3, 0.2))
    back = ([2.0, 1.53, 0], [-1.2, 0, 0], [0, 0, 1.6], plain(0.2, 0.4, 0.7))
    before = capture([floor, front], 1, angles=(-2.3, -0.8))
    assert segments(change.compare(before, capture([floor, back], 2, angles=(0.8, 2.3)))) == []
    repainted = capture([floor, (*front[:3], plain(0.2, 0.4, 0.7))], 2, angles=(-2.3, -0.8))
    (found,) = segments(change.compare(before, repainted))
    assert found.kind == "recoloured"


@pytest.mark.guards("answers")
@pytest.mark.parametrize(("block", "found"), [((0.5, 0.5, 0.5), 0), ((0.8, 0.3, 0.2), 1)])
def test_a_surface_that_looks_like_the_one_behind_it_is_no_change(block, found):
    """A grey block before grey walls is what a blurred or seldom seen corner of an unchanged place looks like."""
    grey = plain(0.5, 0.5, 0.5)
    room = [*((*rectangle[:3], grey) for rectangle in shell()), *STAYS]
    older = capture([*room, *box(0.5, 0.5, 0.3, 0.3, 0.3, 6, paint=plain(*block))], 1)
    assert len(segments(change.compare(older, capture(room, 2)))) == found


@pytest.mark.parametrize("count", [0, 1])
def test_a_capture_that_shows_nothing_or_a_wall_alone_says_nothing(count):
    whole = capture(shell(), 1)
    none = PosedScene(whole.gaussians[:count], whole.cameras, "b")
    assert segments(change.compare(whole, none)) == []
    assert segments(change.compare(none, whole)) == []


def test_the_key_names_the_settings_and_the_code():
    key = change.recipe_key()
    assert key.stage == "change"
    assert key.version["change"] == change.VERSION
    assert "compare" in key.version
    others = {"longest_side_px": 99, "max_views": 9, "voxel_m": 0.2, "min_area_m2": 0.5, "min_moved_fraction": 0.9}
    for name, value in {**others, "min_confidence": 0.9}.items():
        assert key.recipe != change.recipe_key(change.Params(**{name: value})).recipe
    with raises(ConfigError, code="out_of_range", match="voxel_m"):
        change.Params(voxel_m=0.0)


def test_the_picture_of_a_change_shows_the_place_before_and_after():
    room = [*shell(stripes(4)), *STAYS]
    red = plain(0.9, 0.1, 0.1)
    older, newer = capture([*room, *box(0.9, 1.2, 0.5, 0.4, 0.6, 6, paint=red)], 1), capture(room, 2)
    (found,) = change.compare(older, newer).changes
    before, after = draw_change(older, newer, found.box, found.voxels, side_px=128)
    assert before.shape == after.shape == (96, 128, 3)
    reddish = []
    for picture in (before, after):
        lines = (picture == (255, 64, 64)).all(-1)
        reddish.append((picture[..., 0] > 180) & (picture[..., 1] < 70) & (picture[..., 2] < 70) & ~lines)
    # The red box is seen before, with its surroundings on all sides; after, there are only the lines of its frame.
    assert 0.02 < reddish[0].mean() < 0.2
    assert reddish[1].mean() < 0.005
    rows, columns = np.nonzero(reddish[0])
    assert rows.min() > 5
    assert rows.max() < 90
    assert columns.min() > 5
    assert columns.max() < 122
