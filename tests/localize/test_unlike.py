"""Which parts of a photograph show something else than the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.localize import evidence, mismatch
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.localization import scale_photo


@pytest.fixture(scope="module")
def seen(world):
    """A photo of the place (H, W, 3), and what the map shows there."""
    picture, _ = scale_photo(world.photos[0], 480)
    return picture.rgb, render_scenes([world.placed], world.poses[0], picture.intrinsics_px, picture.size_px)


@pytest.fixture(scope="module")
def other(elsewhere) -> np.ndarray:
    return scale_photo(elsewhere.photos[1], 480)[0].rgb


def pasted(rgb: np.ndarray, other: np.ndarray, *places: tuple[int, int]) -> np.ndarray:
    """With a part of another picture, of 120 pixels, at each of some places (row, column)."""
    out = rgb.copy()
    for row, column in places:
        out[row : row + 120, column : column + 120] = other[row : row + 120, column : column + 120]
    return out


def share(rgb: np.ndarray, looks) -> float:
    """Of what can be compared, that is expected to be something else."""
    return float(np.nanmean(mismatch.mismatch_map(rgb, looks).probability))


def test_a_photo_of_the_place_shows_little_else(seen) -> None:
    rgb, looks = seen
    assert share(rgb, looks) < 0.12
    assert mismatch.mismatch_map(rgb, looks).share_outside(0.8) < 0.04


def test_a_photo_of_another_place_does(seen, other) -> None:
    assert share(other, seen[1]) > 0.4


@pytest.mark.parametrize(("gain", "gamma"), [(0.6, 1.0), (1.15, 0.85)])
def test_light_is_nothing_else(seen, gain: float, gamma: float) -> None:
    rgb, looks = seen
    lit = np.clip(gain * rgb**gamma * np.array([1.05, 1.0, 0.93], np.float32), 0, 1)
    assert share(lit, looks) < share(rgb, looks) + 0.04


def test_colours_that_are_clipped_tell_nothing(seen) -> None:
    rgb, looks = seen
    white = rgb.copy()
    white[120:240, 200:320] = 1.0
    probability = mismatch.mismatch_map(white, looks).probability
    step = mismatch.STEP_PX
    assert np.isnan(probability[144 // step : 216 // step, 224 // step : 296 // step]).all()
    assert share(white, looks) < share(rgb, looks) + 0.04


def test_as_much_as_came_is_something_else(seen, other) -> None:
    rgb, looks = seen
    before = share(rgb, looks)
    part = 120 * 120 / rgb[..., 0].size
    assert share(pasted(rgb, other, (40, 60)), looks) - before == pytest.approx(part, abs=0.04)
    assert share(pasted(rgb, other, (40, 60), (180, 320)), looks) - before == pytest.approx(2 * part, abs=0.08)


def test_one_connected_part_may_be_one_thing() -> None:
    """The largest part does not count among the rest; what is not known is no part of the whole."""
    probability = np.zeros((10, 12))
    probability[1:4, 1:5] = 0.9
    probability[:, 10:] = np.nan
    one = mismatch.MismatchMap.from_probability(probability)
    assert one.part_share() == pytest.approx(12 / 100)
    assert one.mean_outside() == one.share_outside(0.5) == 0
    probability[6:8, 2:4] = 0.6
    two = mismatch.MismatchMap.from_probability(probability)
    assert np.array_equal(two.part, one.part)
    assert two.share_outside(0.5) == pytest.approx(4 / 100)
    assert two.share_outside(0.8) == 0
    around = 3 * 4 + 2 * 3 + 2 * 4  # the part and the cells beside it
    assert two.mean_outside() == pytest.approx(0.6 * 4 / (100 - around))


def test_what_the_part_covers_is_not_compared(seen, other) -> None:
    """Somebody before a wall takes nothing from how well the rest agrees."""
    rgb, looks = seen
    hidden = pasted(rgb, other, (120, 200))
    found = mismatch.mismatch_map(hidden, looks)
    row, column = np.nonzero(found.part)
    assert abs(np.median(row) - 180 / mismatch.STEP_PX) < 4
    assert abs(np.median(column) - 260 / mismatch.STEP_PX) < 4
    for compare in (evidence.compare, evidence.compare_coarsely):
        free, whole, less = (compare(x, looks, y) for x, y in ((rgb, None), (hidden, None), (hidden, found)))
        assert less.num_compared < whole.num_compared
        assert less.explained() > whole.explained() + 0.02
        assert less.explained() == pytest.approx(free.explained(), abs=0.08)


def test_the_scene_that_shows_it_is_believed(seen, other) -> None:
    """Where one capture shows what the photo shows, nothing differs, whatever another one shows."""
    rgb, looks = seen
    (one,) = looks
    blank = replace(one, rgb=np.ascontiguousarray(other), scene="other")
    assert share(rgb, [blank]) > 0.4
    assert share(rgb, [blank, one]) <= share(rgb, [one])


def test_nothing_known_is_nothing_said() -> None:
    found = mismatch.mismatch_map(np.zeros((48, 64, 3), np.float32), [])
    assert np.isnan(found.part_share())
    assert np.isnan(found.mean_outside())
    assert np.isnan(found.share_outside(0.5))
