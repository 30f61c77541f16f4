"""Which things of several captures are one object."""

import numpy as np
import pytest

from gsmap.objects import Params, PlacedSegments, fuse, recipe_key

SIZE = np.array([0.6, 0.5, 0.8])
GREY, RED = np.array([50.0, 0, 0]), np.array([50.0, 40, 20])


def test_every_setting_is_in_the_recipe():
    others = {"min_gaussians": 9, "min_overlap": 0.9, "max_views": 3, "longest_side_px": 64, "min_room_area_m2": 9.0}
    for name, value in others.items():
        assert recipe_key(Params(**{name: value})).recipe != recipe_key().recipe


def surface(low, seed=0, size=SIZE) -> np.ndarray:
    """Points all over a box but its bottom."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 1, (1500, 3))
    axis = rng.integers(0, 3, len(points))
    points[np.arange(len(points)), axis] = np.where(axis == 2, 1, rng.integers(0, 2, len(points)))
    return np.array(low) + points * size


def capture(*segments, shift=0.0, seed=0) -> PlacedSegments:
    """Of (corner, colour) things; the whole capture brighter by ``shift``."""
    points = [surface(low, seed + i) for i, (low, _) in enumerate(segments)]
    rng = np.random.default_rng(seed)
    lab = [colour + np.array([shift, 0, 0]) + rng.normal(0, 3, (1500, 3)) for _, colour in segments]
    numbers = np.repeat(np.arange(len(segments)), 1500)
    return PlacedSegments(np.concatenate(points), numbers, np.concatenate(lab), len(segments))


def test_things_at_one_place_are_one_and_others_are_not():
    a = capture(([0, 0, 0], GREY), ([3, 0, 0], RED), seed=1)
    b = capture(([3.02, 0.01, 0], RED), ([0.01, 0, 0], GREY), ([6, 0, 0], GREY), seed=5)
    assert fuse([a, b]) == [((0, 0), (1, 1)), ((0, 1), (1, 0)), ((1, 2),)]


def test_the_answer_does_not_depend_on_the_order_of_captures():
    captures = [capture(([0, 0, 0], GREY), ([3, 0, 0], RED), seed=7 * i) for i in range(4)]
    groups = fuse(captures)
    assert sorted(map(len, groups)) == [4, 4]
    backwards = fuse(captures[::-1])
    turned = sorted(tuple(sorted((3 - c, t) for c, t in group)) for group in backwards)
    assert turned == sorted(groups)


def test_another_exposure_is_no_other_thing_but_another_colour_is():
    still = [([2.0 * i, 4, 0], GREY) for i in range(4)]
    before = capture(([0, 0, 0], GREY), *still)
    brighter = capture(([0, 0, 0], GREY), *still, shift=25.0, seed=3)
    # It shows an end of the thing alone, so that its shape does not say that it is the same.
    shown = (brighter.segments > 0) | (brighter.points[:, 0] < 0.15)
    brighter = PlacedSegments(brighter.points[shown], brighter.segments[shown], brighter.lab[shown], brighter.count)
    assert ((0, 0), (1, 0)) in fuse([before, brighter])
    # A red one of half the height in its place: the shape agrees too little for it to be the same thing painted.
    points, segments = surface([0, 0, 0], 3, SIZE * [1, 1, 0.4]), np.zeros(1500, int)
    rest = capture(*still, seed=4)
    replaced = PlacedSegments(
        np.concatenate([points, rest.points]),
        np.concatenate([segments, rest.segments + 1]),
        np.concatenate([np.tile(RED, (1500, 1)), rest.lab]),
        5,
    )
    groups = fuse([before, replaced])
    assert ((0, 0),) in groups
    assert ((1, 0),) in groups
    painted = capture(([0, 0, 0], RED), *still, seed=9)
    assert ((0, 0), (1, 0)) in fuse([before, painted])


def test_a_thing_that_is_known_to_have_moved_stays_one():
    before, after = capture(([0, 0, 0], GREY)), capture(([5, 0, 0], GREY), seed=2)
    assert fuse([before, after]) == [((0, 0),), ((1, 0),)]
    assert fuse([before, after], [((0, 0), (1, 0))]) == [((0, 0), (1, 0))]


def test_what_is_known_to_be_replaced_is_another_thing():
    before, after, later = (capture(([0, 0, 0], GREY), seed=i) for i in (0, 2, 4))
    assert fuse([before, after]) == [((0, 0), (1, 0))]
    assert fuse([before, after], parted=[((0, 0), 1)]) == [((0, 0),), ((1, 0),)]
    apart = [((0, 0), 1), ((0, 0), 2)]
    assert fuse([before, after, later], parted=apart) == [((0, 0),), ((1, 0), (2, 0))]
    # It moved by a little: it is not where it was, and it is the same.
    assert fuse([before, after], [((0, 0), (1, 0))], [((0, 0), 1), ((1, 0), 0)]) == [((0, 0), (1, 0))]


def test_an_object_has_one_thing_of_each_capture():
    """Two parts of it in one capture lie where the other has the whole: the larger one is it."""
    whole = capture(([0, 0, 0], GREY))
    points = surface([0, 0, 0], 4)
    parts = PlacedSegments(points, (points[:, 0] > 0.45).astype(int), np.tile(GREY, (1500, 1)), 2)
    groups = fuse([whole, parts])
    assert all(len({c for c, _ in group}) == len(group) for group in groups)
    assert ((0, 0), (1, 0)) in groups
    two, one = capture(([0, 0, 0], GREY), ([3, 0, 0], GREY)), capture(([6, 0, 0], GREY), seed=2)
    told_twice = [((0, 0), (1, 0)), ((0, 1), (1, 0))]
    assert fuse([two, one], told_twice) == [((0, 0), (1, 0)), ((0, 1),)]


def test_captures_that_saw_nothing_and_none_at_all():
    nothing = PlacedSegments(np.zeros((0, 3)), np.zeros(0, int), np.zeros((0, 3)), 0)
    assert fuse([nothing, capture(([0, 0, 0], GREY)), nothing]) == [((1, 0),)]
    assert fuse([nothing]) == []


@pytest.mark.parametrize("count", [12])
def test_many_visits_of_one_thing_are_one_object(count):
    captures = [capture(([0, 0, 0], GREY), seed=11 * i) for i in range(count)]
    assert fuse(captures) == [tuple((i, 0) for i in range(count))]
