from dataclasses import replace

import pytest
from made_worlds import twin_wings

from gsmap.optimize import Params, optimize

QUICK = Params(marginals=False)


# Known gap: here look-alikes still fold the map, or take single scenes to the wrong wing. Not strict: on some
# processors another rounding of the solver decides two of them rightly.
_FOLDS = pytest.mark.xfail(
    reason="a scene goes to the wrong wing, or the hall is torn as well and no link stands out", strict=False
)


# True edges lead round from one wing to the other; with seed 0 only two of them cross the middle of the hall, which is
# too few to join its halves but enough to part them.
@pytest.mark.parametrize(
    ("door_m", "seed"),
    [
        (None, 0),
        (None, 1),
        (8.0, 0),
        (8.0, 2),
        (4.0, 1),
        (4.0, 2),
        pytest.param(None, 12, marks=_FOLDS),
        pytest.param(None, 6, marks=_FOLDS),
        pytest.param(8.0, 12, marks=_FOLDS),
    ],
)
def test_a_duplicated_wing_folds_nothing(door_m, seed):
    check_unfolded(twin_wings(300, 0.03, seed, door_m))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("door_m", "seed"),
    [(None, 0), (None, 6), (8.0, 2), (8.0, 3), (4.0, 1), pytest.param(8.0, 4, marks=_FOLDS)],
)
def test_a_large_duplicated_wing_folds_nothing(door_m, seed):
    check_unfolded(twin_wings(1000, 0.03, seed, door_m))


def test_two_edges_that_speak_against_a_fold_open_it():
    """Too few to join a wing to the hall, but enough that it may not lie on the other one."""
    world = twin_wings(1000, 0.03, 0, 4.0)
    answer = optimize(world.ids, world.edges, params=QUICK)
    assert world.worst_island_m(answer) < 0.5
    assert answer.poses["s00700"].component != answer.poses["s00900"].component


def check_unfolded(world):
    answer = optimize(world.ids, world.edges, params=QUICK)
    assert world.worst_island_m(answer) < 0.5
    assert not [key for key in world.wrong_keys if answer.outcomes[key].use == "used"]
    listed = set(answer.undecided) & world.wrong_keys
    assert len(listed) >= 5
    assert all(answer.outcomes[key].reason for key in listed)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_persons_word_opens_a_fold_that_nothing_else_shows(seed):
    """The second wing is reached by look-alike edges only, until someone vouches for one way in."""
    world = twin_wings(150, 0.06, seed)
    into = [(e.target < "s00090" or e.source < "s00090") and max(e.target, e.source) >= "s00120" for e in world.edges]
    edges = [e for e, way in zip(world.edges, into, strict=True) if not way]
    folded = optimize(world.ids, edges, params=QUICK)
    assert world.worst_island_m(folded) > 5
    word = next(e for e, way in zip(world.edges, into, strict=True) if way)
    sure = optimize(world.ids, [*edges, replace(word, confirmed=True)], params=QUICK)
    assert sure.use(word.target, word.source) == "used"
    assert sure.poses[word.source].component == sure.poses[word.target].component
    assert not [key for key in world.wrong_keys if sure.outcomes[key].use == "used"]
    assert world.worst_island_m(sure) < 0.5
