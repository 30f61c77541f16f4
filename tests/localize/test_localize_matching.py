"""Features that are each other's nearest, by kernels of every instruction set and beside all products in float64."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsmap import _native
from gsmap.localize import matching
from gsmap.localize.features import quantize


def by_all_products(mine: np.ndarray, theirs: np.ndarray) -> tuple[np.ndarray, ...]:
    products = mine.astype(np.float64) @ theirs.astype(np.float64).T
    best = products.argmax(axis=1)
    rows = np.flatnonzero(products.argmax(axis=0)[best] == np.arange(len(mine)))
    others = products.copy()
    others[np.arange(len(mine)), best] = -1e9
    return rows, best[rows], products[rows, best[rows]], others.max(axis=1)[rows]


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("width", [1, 3, 64, 128, 1024])
@pytest.mark.parametrize(("least", "most"), [(-127, 127), (-128, -128), (0, 1)])
def test_the_nearest_both_ways_are_those_of_all_products(width: int, least: int, most: int) -> None:
    """Of any number of rows and columns, whole vectors or not; of what is as near the first, as numpy has it."""
    rng = np.random.default_rng(width)
    for rows, columns in ((1, 1), (1, 40), (9, 15), (16, 16), (17, 33), (70, 50)):
        mine, theirs = (rng.integers(least, most + 1, (n, width)).astype(np.int8) for n in (rows, columns))
        for told, true in zip(_native.mutual_nearest(mine, theirs), by_all_products(mine, theirs), strict=True):
            assert np.array_equal(told, true)


@given(seed=st.integers(0, 2**31), rows=st.integers(0, 40), columns=st.integers(0, 40))
def test_whose_nearest_is_whose_does_not_hang_on_who_asks(seed: int, rows: int, columns: int) -> None:
    rng = np.random.default_rng(seed)
    mine, theirs = (rng.integers(-127, 128, (n, 32)).astype(np.int8) for n in (rows, columns))
    one, other, top, _ = _native.mutual_nearest(mine, theirs)
    back, forth, same, _ = _native.mutual_nearest(theirs, mine)
    order = np.argsort(forth)
    assert np.array_equal(one, forth[order])
    assert np.array_equal(other, back[order])
    assert np.array_equal(top, same[order])


@pytest.mark.parametrize("shapes", [((3, 8), (3, 9)), ((3, 0), (3, 0)), ((3, 1025), (3, 1025))])
def test_what_cannot_be_compared_is_an_error(shapes: tuple[tuple[int, int], ...]) -> None:
    mine, theirs = (np.zeros(shape, np.int8) for shape in shapes)
    with pytest.raises(ValueError, match="one width"):
        _native.mutual_nearest(mine, theirs)


def test_what_does_not_stand_out_or_is_far_is_no_match() -> None:
    """Of ten features one has a twin in the view, one is turned by 60 degrees, and one by 30 only."""
    axes = np.linalg.qr(np.random.default_rng(0).normal(size=(128, 128)))[0]  # no part of them above a half
    near = axes[:10]
    view = near.copy()
    view[1] = 0.5 * near[1] + np.sqrt(0.75) * axes[20]
    view[2] = np.sqrt(0.75) * near[2] + 0.5 * axes[21]
    view = np.concatenate([view, near[:1]])
    angles = np.zeros(11, np.uint8)
    photo = matching.FeatureSet(quantize(near), angles[:10])
    rows, columns = matching.match_features(photo, matching.FeatureSet(quantize(view), angles))
    assert rows.tolist() == columns.tolist() == [2, 3, 4, 5, 6, 7, 8, 9]
