"""Which parts of a photograph show something else than the map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from gsmap.localize import Params, unlike
from gsmap.localize.localizing import prepared
from gsmap.localize.looks import look


@pytest.fixture(scope="module")
def seen(world):
    """A photo of the place (H, W, 3), and what the map shows there."""
    picture, _ = prepared(world.photos[0], Params())
    return picture.rgb, look([world.placed], world.poses[0], picture.intrinsics_px, picture.size_px, Params().features)


@pytest.fixture(scope="module")
def other(elsewhere) -> np.ndarray:
    return prepared(elsewhere.photos[1], Params())[0].rgb


def pasted(rgb: np.ndarray, other: np.ndarray, *places: tuple[int, int]) -> np.ndarray:
    """With a part of another picture, of 120 pixels, at each of some places (row, column)."""
    out = rgb.copy()
    for row, column in places:
        out[row : row + 120, column : column + 120] = other[row : row + 120, column : column + 120]
    return out


def test_a_photo_of_the_place_shows_little_else(seen) -> None:
    rgb, looks = seen
    found = unlike.unlike(rgb, looks)
    assert found.share() < 0.12
    assert found.elsewhere(0.5) < 0.04


def test_a_photo_of_another_place_does(seen, other) -> None:
    assert unlike.unlike(other, seen[1]).share() > 0.4


@pytest.mark.parametrize(("gain", "gamma"), [(0.6, 1.0), (1.15, 0.85)])
def test_light_is_nothing_else(seen, gain: float, gamma: float) -> None:
    rgb, looks = seen
    lit = np.clip(gain * rgb**gamma * np.array([1.05, 1.0, 0.93], np.float32), 0, 1)
    assert unlike.unlike(lit, looks).share() < unlike.unlike(rgb, looks).share() + 0.04


def test_as_much_as_came_is_something_else(seen, other) -> None:
    rgb, looks = seen
    before = unlike.unlike(rgb, looks).share()
    part = 120 * 120 / rgb[..., 0].size
    one = unlike.unlike(pasted(rgb, other, (40, 60)), looks).share()
    two = unlike.unlike(pasted(rgb, other, (40, 60), (180, 320)), looks).share()
    assert one - before == pytest.approx(part, abs=0.04)
    assert two - before == pytest.approx(2 * part, abs=0.08)


def test_one_connected_part_may_be_one_thing() -> None:
    """The largest part does not count among what lies elsewhere; what is not known is no part of the whole."""
    probability = np.zeros((10, 12))
    probability[1:4, 1:5] = 0.9
    probability[:, 10:] = np.nan
    assert unlike.Unlike(probability).elsewhere(0.5) == 0
    assert unlike.Unlike(probability).share() == pytest.approx(0.9 * 12 / 100)
    probability[6:8, 2:4] = 0.6
    assert unlike.Unlike(probability).elsewhere(0.5) == pytest.approx(4 / 100)
    assert unlike.Unlike(probability).elsewhere(0.8) == 0


def test_the_scene_that_shows_it_is_believed(seen, other) -> None:
    """Where one capture shows what the photo shows, nothing differs, whatever another one shows."""
    rgb, looks = seen
    (one,) = looks
    blank = replace(one, rgb=np.ascontiguousarray(other), scene="other")
    assert unlike.unlike(rgb, [blank]).share() > 0.4
    assert unlike.unlike(rgb, [blank, one]).share() <= unlike.unlike(rgb, [one]).share()


def test_nothing_known_is_nothing_said() -> None:
    found = unlike.unlike(np.zeros((48, 64, 3), np.float32), [])
    assert np.isnan(found.share())
    assert np.isnan(found.elsewhere(0.5))
