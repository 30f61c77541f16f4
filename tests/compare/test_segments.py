"""Evidence of single Gaussians, weighed over the things that they make up."""

import numpy as np

from gsmap.compare import GONE, SAME
from gsmap.compare.colours import IDENTITY
from gsmap.compare.evidence import CLEAR_M, EvidenceCounts
from gsmap.compare.segments import (
    MAX_OUTSIDE_HULL_M,
    MIN_ROOT_FRACTION,
    MIN_ROOTS,
    ChangeLabels,
    SegmentedCapture,
    adjoins_shell,
    find_remnants,
    find_rooted,
    label_segments,
    label_shells,
    spread_changes,
)

UP = np.array([0.0, 0.0, 1.0])


def sheet(low, high, z=0.0, spacing=0.04):
    """Points of a horizontal sheet between two corners (x, y)."""
    x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, z)], axis=1)


def doubts(points, **masks):
    """Nothing changed and all of it seen, but for what is said otherwise."""
    given = {name: np.zeros(len(points), dtype=bool) for name in ("changed", "sure", "hidden", "framed")}
    given |= {"judged": np.ones(len(points), dtype=bool), "differs": np.zeros(len(points))}
    given |= {"shell": np.full(len(points), -1)}
    given |= masks
    return ChangeLabels(points, **given, segment=label_segments(points, given["shell"]))


def test_a_change_without_roots_is_none():
    light, paint = sheet((0, 0), (0.4, 0.4)), sheet((3, 0), (3.4, 0.4))
    points = np.concatenate([light, paint])
    painted = np.arange(len(points)) >= len(light)
    sure = painted.copy()
    sure[:3] = True  # a few are sure of light, too: too few
    found = find_rooted(doubts(points, changed=np.ones(len(points), bool), sure=sure))
    np.testing.assert_array_equal(found, painted)
    # Many that are sure, yet a small share of what changed.
    many = sheet((0, 0), (1.0, 1.0))
    sure = np.arange(len(many)) < 0.5 * MIN_ROOT_FRACTION * len(many)
    assert sure.sum() > MIN_ROOTS
    assert not find_rooted(doubts(many, changed=np.ones(len(many), bool), sure=sure)).any()


def test_light_on_the_next_wall_is_no_part_of_the_paint():
    points = sheet((0, 0), (0.8, 0.4))
    here = points[:, 0] < 0.4
    both = doubts(points, changed=np.ones(len(points), bool), sure=here, shell=np.where(here, 1, 2))
    np.testing.assert_array_equal(find_rooted(both), here)


def test_what_is_beyond_doubt_alone_belongs_to_the_change_near_by():
    change, loose = sheet((0, 0), (0.4, 0.4)), np.array([[0.6, 0.2, 0], [0.8, 0.2, 0], [3.0, 0.2, 0]])
    points = np.concatenate([change, loose])
    changed = np.ones(len(points), bool)
    for known in (
        {"changed": changed, "sure": changed},
        {"changed": changed & (points[:, 0] < 0.5), "sure": changed, "differs": np.full(len(points), 9.0)},
    ):
        # The second is near the first alone, and the last near none.
        np.testing.assert_array_equal(find_rooted(doubts(points, **known))[-3:], [True, True, False])


def test_of_a_thing_much_of_which_changed_what_differs_a_little_did_too():
    points = sheet((0, 0), (1.0, 0.4))
    changed = points[:, 0] < 0.3
    differs = np.where(points[:, 0] < 0.7, 0.5, 0.0)
    np.testing.assert_array_equal(spread_changes(doubts(points, changed=changed, differs=differs)), points[:, 0] < 0.7)
    # Where next to nothing of it changed, nothing else has; nor has a wall.
    few = points[:, 0] < 0.03
    np.testing.assert_array_equal(spread_changes(doubts(points, changed=few, differs=differs)), few)
    wall = doubts(points, changed=changed, differs=differs, shell=np.zeros(len(points), int))
    np.testing.assert_array_equal(spread_changes(wall), changed)


def test_what_most_about_it_changed_on_its_thing_is_not_left_behind():
    points = sheet((0, 0), (1.2, 1.2))
    speck = np.linalg.norm(points[:, :2] - 0.6, axis=1) < 0.03
    assert 1 <= speck.sum() <= 2
    assert spread_changes(doubts(points, changed=~speck)).all()
    # What is beside it is no part of it: an edge stays where it is.
    went = points[:, 0] < 0.6
    np.testing.assert_array_equal(spread_changes(doubts(points, changed=went)), went)


RED, WHITE = (0.7, 0.1, 0.1), (0.9, 0.9, 0.9)


def side(points, changed, colour=RED, framed=None):
    framed = np.zeros(len(points), bool) if framed is None else framed
    return SegmentedCapture(points, np.broadcast_to(colour, points.shape), np.zeros(len(points), int), changed, framed)


def test_a_sofa_that_was_pushed_along_takes_with_it_where_it_still_shows_itself():
    points = sheet((0, 0), (1.2, 0.4))
    went = points[:, 0] < 0.8
    now = side(points + 0.01 * UP, np.zeros(len(points), bool))
    np.testing.assert_array_equal(find_remnants((side(points, went), now))[0], ~went)
    # Of a thing less than half of which changed, the rest stays.
    assert not find_remnants((side(points, points[:, 0] < 0.5), now))[0].any()
    # A white fridge that stood against it stays ...
    colours = np.where(went[:, None], RED, WHITE)
    assert not find_remnants((side(points, went, colours), now))[0].any()
    # ... and where its colours are in doubt, what stands there now decides.
    halves = went | (np.arange(len(points)) % 2 == 0)
    colours = np.where(halves[:, None], RED, WHITE)
    assert not find_remnants((side(points, went, colours), now))[0].any()
    new = side(points + 0.01 * UP, np.ones(len(points), bool))
    np.testing.assert_array_equal(find_remnants((side(points, went, colours), new))[0], ~went)
    # Walls are no things, and of nothing nothing is left.
    wall = SegmentedCapture(
        points, np.broadcast_to(RED, points.shape), np.full(len(points), -1), went, np.zeros_like(went)
    )
    assert not find_remnants((wall, new))[0].any()
    assert not find_remnants((side(points, went), side(points[:0], went[:0])))[0].any()


def test_the_frame_of_a_door_stays_when_the_shelf_before_it_goes():
    points = sheet((0, 0), (1.2, 0.4))
    shelf = points[:, 0] < 0.8
    frame = points[:, 0] > points[shelf, 0].max() + MAX_OUTSIDE_HULL_M
    none = side(points + 0.01 * UP, np.zeros(len(points), bool))
    # Of its colour, and as dimly lit since; yet it lies by a wall, and beyond all that changed.
    for framed, stays in ((frame, frame), (~frame, np.zeros(len(points), bool))):
        left = find_remnants((side(points, shelf, framed=framed), none))[0]
        np.testing.assert_array_equal(left, ~shelf & ~stays)
        known = doubts(points, changed=shelf, differs=np.full(len(points), 0.5), framed=framed)
        np.testing.assert_array_equal(spread_changes(known), ~stays)
    # What lies by a wall between where a thing stood and where it stands now is the thing's.
    now = side(points + np.array([0.4, 0, 0.01]), np.ones(len(points), bool))
    np.testing.assert_array_equal(find_remnants((side(points, shelf, framed=frame), now))[0], ~shelf)


def test_what_lies_by_the_floor_without_being_part_of_it():
    floor, feet, seat = (
        sheet((0, 0), (1, 1)),
        sheet((0.2, 0.2), (0.3, 0.3), z=0.08),
        sheet((0.2, 0.2), (0.8, 0.8), z=0.4),
    )
    points = np.concatenate([floor, feet, seat])
    shell = np.where(points[:, 2] == 0, 0, -1)
    np.testing.assert_array_equal(adjoins_shell(points, shell), points[:, 2] == 0.08)


def test_what_can_be_looked_through_is_not_gone_where_the_other_shows_a_surface():
    points = sheet((0, 0), (0.6, 0.6))
    for others, state in ((points + 0.8 * CLEAR_M * UP, SAME), (points + 3 * CLEAR_M * UP, GONE)):
        tally = EvidenceCounts(len(points))
        tally.through[:], tally.sure[:] = 3, 1
        shows, shell = np.ones(len(points), bool), np.full(len(points), -1)
        found = tally.evidence(points, shows, shell, others, 9, IDENTITY)
        assert (found.state == state).all()


def test_what_nobody_could_judge_goes_with_those_around_it():
    points = sheet((0, 0), (0.8, 0.4))
    hidden = (points[:, 0] > 0.3) & (points[:, 0] < 0.5)
    for shell in (-1, 3):
        for side in (points[:, 0] <= 0.3, points[:, 0] >= 0.5):
            known = doubts(
                points, changed=side, judged=~hidden, hidden=hidden, shell=np.full(len(points), shell, dtype=int)
            )
            found = spread_changes(known)
            middle = np.abs(points[:, 0] - 0.4)
            near = np.where(side[0], points[:, 0] < 0.4, points[:, 0] > 0.4) & hidden & (middle > 0.05)
            far = np.where(side[0], points[:, 0] > 0.4, points[:, 0] < 0.4) & hidden & (middle > 0.05)
            assert found[near].all()
            assert not found[far].any()
    # Of a wall that was not even looked at nothing is known.
    unseen = doubts(points, changed=points[:, 0] <= 0.3, judged=~hidden, shell=np.zeros(len(points), int))
    assert not spread_changes(unseen)[hidden].any()


def test_the_floor_is_shell_and_what_stands_on_it_is_not():
    floor, table = sheet((0, 0), (4, 4)), sheet((1, 1), (2, 2), z=0.7)
    haze = np.array([[3.0, 3.0, 0.2]])
    older, newer = np.concatenate([floor, table, haze]), floor + 0.01
    shows = np.arange(len(older)) < len(floor) + len(table)
    a, b = label_shells([(older, shows), (newer, np.ones(len(newer), bool))])
    assert a[0] >= 0
    assert (a[: len(floor)] == a[0]).all()
    assert (a[len(floor) : -1] == -1).all()
    assert a[-1] == a[0]
    assert (b == a[0]).all()
    none = label_shells([(older[:0], shows[:0]), (newer[:0], shows[:0])])
    assert [len(one) for one in none] == [0, 0]


def test_a_wall_is_seen_from_both_sides():
    floor, ceiling = sheet((0, 0), (4, 4), spacing=0.05), sheet((0, 0), (4, 4), z=2.5, spacing=0.05)
    face = sheet((0, 0), (4, 2.5), spacing=0.05)[:, [2, 0, 1]]  # at x = 0, all the way up
    low = face[face[:, 2] < 2.2]
    for through, wall in ((0.1, True), (0.4, False)):
        other = low + np.array([through, 0, 0])
        points = np.concatenate([floor[floor[:, 0] > 0.6], ceiling, face, other])
        found = label_shells([(points, np.ones(len(points), bool))])[0][-len(other) :]
        assert ((found >= 0).mean() > 0.9) == wall
