"""Pictures by which a person judges a pair: which cameras they are drawn from, and what they say."""

import numpy as np

from gsmap.geometry.sh import SH_C0
from gsmap.types import Cameras, Gaussians, PosedScene
from gsmap.view.pair_picture import choose_cameras, draw_pair


def wall(z: float, colours: np.ndarray) -> Gaussians:
    """A wall of 30 x 30 Gaussians at a depth, with their grey values (30, 30)."""
    y, x = np.mgrid[:30, :30] / 10 - 1.45
    n = x.size
    grey = (colours.ravel()[:, None, None] - 0.5) / SH_C0
    return Gaussians(
        np.column_stack([x.ravel(), y.ravel(), np.full(n, z)]),
        np.tile([1.0, 0, 0, 0], (n, 1)),
        np.log(np.tile([0.06, 0.06, 0.005], (n, 1))),
        np.full(n, 6.0),
        np.repeat(grey, 3, axis=2),
    )


def camera(turned: bool) -> Cameras:
    pose = np.diag([-1.0, 1, -1, 1]) if turned else np.eye(4)
    return Cameras(pose[None], np.array([[60.0, 60, 40, 30]]), np.array([[80, 60]]))


RNG = np.random.default_rng(0)
BLANK, STRIPES = np.full((30, 30), 0.7), np.tile(np.repeat([0.2, 0.8, 0.2, 0.8, 0.2], 6), (30, 1))
PATTERN = np.kron(RNG.uniform(0.1, 0.9, (10, 10)), np.ones((3, 3)))


def scene(front: np.ndarray, back: np.ndarray) -> PosedScene:
    return PosedScene(Gaussians.concatenate([wall(2.0, front), wall(-2.0, back)]), None, "s")


def chosen(one: PosedScene, other: PosedScene) -> list[bool]:
    """Whether each chosen camera looks back, best first."""
    both = [camera(False), camera(True)]
    return [found is both[1] for found in choose_cameras(one, other, both, 2)]


def test_what_has_texture_comes_before_a_bare_wall():
    assert chosen(scene(BLANK, PATTERN), scene(BLANK, PATTERN)) == [True, False]
    assert chosen(scene(PATTERN, BLANK), scene(PATTERN, BLANK)) == [False, True]


def test_texture_counts_where_both_show_it_and_in_every_direction():
    assert chosen(scene(PATTERN, PATTERN), scene(BLANK, PATTERN)) == [True, False], "one saw a bare wall in front"
    assert chosen(scene(STRIPES, PATTERN), scene(STRIPES, PATTERN)) == [True, False], "stripes slide along themselves"


def test_no_more_cameras_than_there_are_and_captions_above_the_columns():
    one = scene(BLANK, PATTERN)
    assert choose_cameras(one, one, [], 4) == []
    assert len(choose_cameras(one, one, [camera(True)], 4)) == 1
    plain = draw_pair(one, one, [camera(True)], side_px=80)
    told = draw_pair(one, one, [camera(True)], side_px=80, names=("a scene of a long name", "b"))
    assert told.shape[1] == plain.shape[1]
    np.testing.assert_array_equal(told[-plain.shape[0] :], plain)
    assert told[: -plain.shape[0]].min() < 100, "letters"
