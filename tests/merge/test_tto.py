import numpy as np
from synthetic_walls import cameras_facing, two_scenes, wall

from gsmap.merge import PlacedScene, default_params, merge
from gsmap.merge.exposure import apply_gain
from gsmap.merge.selection import most_visible, one_owner_per_cell
from gsmap.render import render
from gsmap.types import Gaussians

Params = type(default_params("tto"))


def likeness(merged, parts):
    """PSNR over all pixels of each part's own pictures, in dB."""
    errors = [render(merged, p.cameras).colour - render(p.gaussians, p.cameras).colour for p in parts]
    return float(-10 * np.log10(np.mean(np.square(errors))))


def test_it_beats_the_closed_forms_with_fewer_gaussians():
    parts = two_scenes()
    others = [merge(parts, method) for method in ("union", "voxel", "distance")]
    tto = merge(parts, "tto", Params(keep=0.7, steps=250))
    assert likeness(tto.gaussians, parts) > max(likeness(r.gaussians, parts) for r in others) + 0.2
    assert len(tto.gaussians) <= 0.7 * len(others[0].gaussians)
    assert tto.steps == 250
    assert not tto.truncated
    assert set(tto.origin.tolist()) == {0, 1}


def test_steps_help_and_are_repeatable():
    parts = two_scenes()
    few, many = (merge(parts, "tto", Params(steps=s)) for s in (0, 60))
    assert likeness(many.gaussians, parts) > likeness(few.gaussians, parts)
    again = merge(parts[::-1], "tto", Params(steps=60))
    np.testing.assert_array_equal(again.gaussians.sh, many.gaussians.sh)
    np.testing.assert_array_equal(again.origin, 1 - many.origin)


def test_it_stops_when_it_no_longer_gains():
    g = wall(0, -1, 1)
    result = merge(
        [PlacedScene(g, cameras_facing(np.linspace(-0.6, 0.6, 5)), "a")], "tto", Params(keep=1.0, passes=100)
    )
    assert 10 <= result.steps < 2000
    assert not result.truncated


def test_a_budget_is_a_ceiling_and_says_so():
    result = merge(two_scenes(), "tto", Params(steps=100_000), budget_s=0.5)
    assert result.truncated
    assert result.steps < 100_000
    assert len(result.gaussians)


def test_without_cameras_it_still_merges():
    parts = [PlacedScene(p.gaussians, None, p.scene_id) for p in two_scenes()]
    result = merge(parts, "tto")
    assert result.steps == 0
    assert "no camera" in result.notes[0]
    assert len(result.gaussians) > 500


def test_tiles_fit_together_in_any_order():
    parts = two_scenes()
    params = Params(steps=80, keep=0.9)
    boxes = [np.array([[x, -2, -2], [x + 1.0, 2, 2]]) for x in (-2.0, -1, 0, 1)]
    tiles = [merge(parts, "tto", params, bounds=box) for box in boxes]
    for tile, box in zip(tiles, boxes, strict=True):
        assert ((tile.gaussians.means >= box[0]) & (tile.gaussians.means < box[1])).all()
    # Every Gaussian belongs to one tile, whichever way it was pushed at the border.
    apart = [merge(parts, "tto", Params(steps=s, keep=1.0, min_weight=0.0), bounds=b) for b in boxes for s in (0, 40)]
    assert sum(len(t.gaussians) for t in apart[0::2]) == sum(len(t.gaussians) for t in apart[1::2])
    whole = merge(parts, "tto", params)
    together = Gaussians.concatenate([t.gaussians for t in tiles])
    assert likeness(together, parts) > likeness(whole.gaussians, parts) - 0.2
    assert likeness(together, parts) > likeness(merge(parts, "union").gaussians, parts)
    # A line along a seam would show as a column with a larger error than it has in one piece.
    for part in parts:
        own = render(part.gaussians, part.cameras).colour
        in_tiles, in_one = (
            np.abs(render(g, part.cameras).colour - own).mean((1, 3)) for g in (together, whole.gaussians)
        )
        assert (in_tiles - in_one).max() < 0.05


def test_differing_exposure_is_removed_when_asked_and_noted():
    a, b = two_scenes()
    brighter = PlacedScene(apply_gain(b.gaussians, np.full(3, 1.4)), b.cameras, "b")
    result = merge([a, brighter], "tto", Params(steps=5, balance_exposure=True))
    assert any("stops" in note for note in result.notes)


def test_a_cell_belongs_to_whoever_shows_most_of_it():
    n = 10
    means = np.zeros((2 * n, 3), np.float32)
    means[:, 0] = np.tile(np.linspace(0.05, 0.95, n), 2)
    means[n:, 1] = 0.01
    gaussians = Gaussians(means, np.ones((2 * n, 4)), np.full((2 * n, 3), -4), np.zeros(2 * n), np.zeros((2 * n, 1, 3)))
    origin = np.repeat([0, 1], n)
    shown = np.concatenate([np.full(n, 5.0), np.full(n, 9.0)])
    np.testing.assert_array_equal(one_owner_per_cell(gaussians, origin, shown, 1.0, 0.05), origin == 1)
    # The other capture fills in where the owner has nothing near, if it was seen to show something there.
    shown[[14, 15]] = 0
    sparse = np.delete(np.arange(2 * n), [14, 15])
    stays = one_owner_per_cell(gaussians[sparse], origin[sparse], shown[sparse], 1.0, 0.05)
    np.testing.assert_array_equal(np.flatnonzero(stays[:n]), [4, 5])


def test_what_shows_least_goes_first():
    shown = np.array([3.0, 0.0, 5.0, 1.0, 4.0])
    among = np.array([True, True, False, True, True])
    np.testing.assert_array_equal(most_visible(shown, among, 2), [True, False, False, False, True])
    np.testing.assert_array_equal(most_visible(shown, among, 9), among)
