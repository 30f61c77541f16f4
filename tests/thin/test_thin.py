"""What supersedes a capture, and what of it shows: against walls whose answers are known."""

from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from synthetic_walls import cameras_facing, wall

from gsmap.errors import ConfigError
from gsmap.geometry.transforms import transform_cameras
from gsmap.render import render
from gsmap.thin import Params, find_visible, measure_fidelity_db, observed_fraction, render_views
from gsmap.types import Gaussians, PosedScene, Sim3


@pytest.fixture
def older():
    return PosedScene(wall(1, -2, 2), cameras_facing(np.linspace(-1.5, 1.5, 9)), "old")


@pytest.mark.parametrize(("middles", "low", "high"), [((-1.5, 1.5), 0.75, 1.0), ((-1.5, -1.0), 0.1, 0.6)])
def test_how_much_newer_captures_saw(older, middles, low, high):
    newer = PosedScene(wall(2, -2, 2), cameras_facing(np.linspace(*middles, 9)), "new")
    assert low <= observed_fraction(older, [render_views(newer)]) <= high


def test_captures_add_up_and_none_saw_nothing(older):
    halves = [
        PosedScene(wall(2, -2, 2), cameras_facing(np.linspace(low, high, 9)), f"new{low}")
        for low, high in ((-1.5, -0.5), (0.5, 1.5))
    ]
    alone = [observed_fraction(older, [render_views(half)]) for half in halves]
    assert observed_fraction(older, [render_views(half) for half in halves]) > max(alone) + 0.1
    assert observed_fraction(older, []) == 0.0


def test_what_is_behind_a_wall_was_not_looked_at():
    along = np.linspace(-1.5, 1.5, 9)
    beyond = transform_cameras(cameras_facing(along), Sim3(np.eye(3), np.array([0, 0, 0.6])))
    older = PosedScene(wall(3, -2, 2, z=0.6), beyond, "the next room")
    newer = PosedScene(wall(2, -2, 2), cameras_facing(along), "before the wall")
    assert observed_fraction(older, [render_views(newer)]) == 0.0


def test_what_lies_a_little_behind_a_surface_that_was_seen_is_of_it(older):
    means = older.gaussians.means.copy()
    means[np.floor(means[:, 0] / 0.08) % 4 == 0, 2] += 0.05  # narrow grooves, that a newer training smoothed
    rough = PosedScene(replace(older.gaussians, means=means), older.cameras, "rough")
    newer = PosedScene(wall(2, -2, 2), older.cameras, "new")
    assert observed_fraction(rough, [render_views(newer)]) > 0.9


def test_what_no_picture_shows_goes_and_the_pictures_stay(older):
    behind = wall(3, -2, 2, z=0.4)
    both = PosedScene(Gaussians.concatenate([older.gaussians, behind]), older.cameras, "both")
    stays = find_visible(both, Params())
    n = len(older.gaussians)
    assert stays[:n].mean() > 0.5
    assert stays[n:].mean() < 0.2
    kept = both.gaussians[stays]
    camera = both.cameras[4].resized(480)
    before, after = (np.clip(render(g, camera).colour, 0, 1) for g in (both.gaussians, kept))
    error = ((before - after) ** 2).mean()
    assert measure_fidelity_db(both, kept, Params(max_views=100, longest_side_px=480)) == pytest.approx(
        -10 * np.log10(error), abs=6
    )
    assert measure_fidelity_db(both, both.gaussians, Params()) == float("inf")
    assert measure_fidelity_db(both, both.gaussians[: n // 2], Params()) < 30


def test_without_cameras_all_stays_and_nothing_is_known():
    bare = PosedScene(wall(1, -1, 1), None, "bare")
    assert find_visible(bare, Params()).all()
    assert np.isnan(measure_fidelity_db(bare, bare.gaussians, Params()))


def test_with_made_up_cameras_all_stays(older):
    behind = Gaussians.concatenate([older.gaussians, wall(3, -2, 2, z=0.4)])
    made_up = replace(older.cameras, synthesised=True)
    assert find_visible(PosedScene(behind, made_up, "both"), Params()).all()


def test_settings_that_cannot_be():
    with raises(ConfigError, code="out_of_range", match="min_seen_again"):
        Params(min_seen_again=2)
