from dataclasses import replace

import numpy as np
import pytest
from raising import raises
from scipy.spatial import cKDTree
from synthetic_walls import cameras_facing, two_scenes, wall

from gsmap.errors import ConfigError
from gsmap.evaluate.images import ssim
from gsmap.geometry.boxes import inside
from gsmap.geometry.voxels import voxel_labels
from gsmap.merge import PosedScene, default_params, merge
from gsmap.merge.exposure import apply_gain
from gsmap.merge.mergers import tto
from gsmap.merge.selection import select_owners
from gsmap.render import render
from gsmap.render.native_fit import NativeFitter
from gsmap.types import Gaussians

Params = type(default_params("tto"))


def likeness(merged, parts):
    """PSNR over all pixels of each part's own pictures, in dB."""
    errors = [render(merged, p.cameras).colour - render(p.gaussians, p.cameras).colour for p in parts]
    return float(-10 * np.log10(np.mean(np.square(errors))))


def test_it_beats_the_closed_forms_with_fewer_gaussians():
    parts = two_scenes()
    others = [merge(parts, method) for method in ("union", "voxel", "distance")]
    tto = merge(parts, "tto", Params(kept_fraction=0.7, steps=250))
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


def halves():
    """Two captures that show one wall, each a half of it."""
    whole, cameras = wall(0, -1, 1), cameras_facing(np.linspace(-0.6, 0.6, 5))
    left = whole.means[:, 0] < 0
    return [PosedScene(whole[left], cameras, "a"), PosedScene(whole[~left], cameras, "b")]


def test_one_capture_alone_is_neither_thinned_nor_fitted():
    one = PosedScene(wall(0, -1, 1), cameras_facing(np.linspace(-0.6, 0.6, 5)), "a")
    result = merge([one], "tto", Params(kept_fraction=0.3, voxel_m=1e-3))
    assert result.steps == 0
    assert likeness(result.gaussians, [one]) > 40
    far = PosedScene(wall(0, 50, 52), cameras_facing(np.linspace(50.4, 51.6, 5)), "b")
    here = np.array([[-2.0, -2, -2], [2, 2, 2]])
    tile = merge([one, far], "tto", Params(kept_fraction=0.3, voxel_m=1e-3), bounds=here)
    assert tile.steps == 0
    assert likeness(tile.gaussians, [one]) > 40


def test_it_stops_when_it_no_longer_gains():
    result = merge(halves(), "tto", Params(kept_fraction=1.0, max_passes=100))
    assert 10 <= result.steps < 2000
    assert not result.truncated


def test_a_budget_is_a_ceiling_and_says_so():
    result = merge(two_scenes(), "tto", Params(steps=100_000), budget_s=0.5)
    assert result.truncated
    assert result.steps < 100_000
    assert len(result.gaussians)


def test_without_cameras_it_still_merges():
    parts = [PosedScene(p.gaussians, None, p.scene_id) for p in two_scenes()]
    result = merge(parts, "tto")
    assert result.steps == 0
    assert "no camera" in result.notes[0]
    assert len(result.gaussians) > 500


def test_tiles_fit_together_in_any_order():
    parts = two_scenes()
    params = Params(steps=80, kept_fraction=0.9)
    boxes = [np.array([[x, -2, -2], [x + 1.0, 2, 2]]) for x in (-2.0, -1, 0, 1)]
    tiles = [merge(parts, "tto", params, bounds=box) for box in boxes]
    for tile, box in zip(tiles, boxes, strict=True):
        assert ((tile.gaussians.means >= box[0]) & (tile.gaussians.means < box[1])).all()
    # Every Gaussian belongs to one tile, whichever way it was pushed at the border.
    apart = [
        merge(parts, "tto", Params(steps=s, kept_fraction=1.0, min_weight=0.0), bounds=b)
        for b in boxes
        for s in (0, 40)
    ]
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
    brighter = PosedScene(apply_gain(b.gaussians, np.full(3, 1.4)), b.cameras, "b")
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
    np.testing.assert_array_equal(select_owners(gaussians, origin, shown, 1.0, 0.05), origin == 1)
    # The other capture fills in where the owner has nothing near, if it was seen to show something there.
    shown[[14, 15]] = 0
    sparse = np.delete(np.arange(2 * n), [14, 15])
    stays = select_owners(gaussians[sparse], origin[sparse], shown[sparse], 1.0, 0.05)
    np.testing.assert_array_equal(np.flatnonzero(stays[:n]), [4, 5])


def test_of_too_many_the_most_alike_become_one(watched):
    """Three quarters of what there is look like all of it: pairs are merged and nothing is cut away."""
    both = halves()
    cameras, count = both[0].cameras, sum(len(one.gaussians) for one in both)
    whole = merge(both, "tto", Params(steps=0, kept_fraction=1.0, voxel_m=1e-3)).gaussians
    fewer = merge(both, "tto", Params(steps=0, kept_fraction=0.5, voxel_m=1e-3)).gaussians
    assert 0.45 * count < len(fewer) <= 0.5 * count
    wanted, shown = (render(g, cameras).colour for g in (whole, fewer))
    alpha = render(fewer, cameras).alpha[:, 12:36, 16:48]
    assert alpha.min() > 0.8
    assert np.abs(wanted - shown)[:, 12:36, 16:48].mean() < 0.03


class WatchedFitter(NativeFitter):
    """A fitter that remembers what it was given and what its steps cost."""

    def __init__(self, start, **settings):
        super().__init__(start, **settings)
        self.start, self.asked, self.losses = start, [], []
        WatchedFitter.last = self

    def step(self, cameras, images, masks=None):
        self.asked.append((cameras, images, masks))
        self.losses.append(super().step(cameras, images, masks))
        return self.losses[-1]


@pytest.fixture
def watched(monkeypatch):
    monkeypatch.setattr(tto, "make_fitter", lambda start, *, backend, **settings: WatchedFitter(start, **settings))
    return WatchedFitter


def test_the_halo_is_fitted_along_and_only_its_outer_half_is_frozen(watched):
    box, halo_m = np.array([[-0.4, -2, -2], [0.4, 2, 2]]), 0.6
    result = merge(two_scenes(), "tto", Params(steps=30, halo_m=halo_m), bounds=box)
    fitter = watched.last
    beyond = np.maximum(box[0, 0] - fitter.start.means[:, 0], fitter.start.means[:, 0] - box[1, 0])
    # Surroundings on both sides take part, as far as the halo reaches and no farther.
    assert 0.9 * halo_m < beyond.max() < halo_m + 0.02
    assert (beyond > 0).sum() > 0.5 * (beyond <= 0).sum()
    inner, outer = (beyond > 0) & (beyond < halo_m / 2), beyond >= halo_m / 2
    np.testing.assert_array_equal(fitter.frozen, outer)
    changed = (fitter.sh != fitter.start.sh).any((1, 2))
    assert changed[inner].mean() > 0.8
    assert not changed[outer].any()
    assert inside(result.gaussians.means, box).all()


def test_a_cell_of_two_captures_holds_one_of_them():
    scenes, cell_m, cover_m = two_scenes(), 0.5, 0.1
    params = Params(steps=0, kept_fraction=1.0, min_weight=0.0)

    def nearest_of_the_other_m(result):
        """How near the two captures come to one another within a cell."""
        cell = voxel_labels(result.gaussians.means, cell_m)
        # Cells far apart, so that only neighbours in one cell count.
        apart = np.concatenate([result.gaussians.means, 100.0 * cell[:, None]], axis=1)
        a, b = (apart[result.origin == i] for i in (0, 1))
        return cKDTree(a).query(b)[0].min()

    owned, shared = merge(scenes, "tto", params), merge(scenes, "tto", replace(params, owner_cells=False))
    assert nearest_of_the_other_m(owned) >= cover_m
    assert nearest_of_the_other_m(shared) < 0.02
    assert len(owned.gaussians) < 0.85 * len(shared.gaussians)


def test_ssim_is_part_of_what_is_fitted():
    scenes = two_scenes()

    def structure(result):
        return np.mean(
            [
                ssim(mine, wanted)
                for scene in scenes
                for mine, wanted in zip(
                    render(result.gaussians, scene.cameras).colour,
                    render(scene.gaussians, scene.cameras).colour,
                    strict=True,
                )
            ]
        )

    with_ssim, without = (merge(scenes, "tto", Params(steps=80, **more)) for more in ({}, {"ssim_weight": 0.0}))
    assert structure(with_ssim) > structure(without) + 1e-4


def test_few_passes_come_nearer_by_huber_s_loss_and_less_momentum(watched, monkeypatch):
    """The colours that a fit of few steps misses its references by; what a map loses is square errors."""

    def missed(params):
        merge(two_scenes(), "tto", params)
        fitter = watched.last
        errors = [
            (render(fitter.gaussians(), cameras).colour - images / np.float32(255)) ** 2 * masks[..., None]
            for cameras, images, masks in {id(asked[1].base): asked for asked in fitter.asked}.values()
        ]
        return np.mean([error.mean() for error in errors])

    monkeypatch.setattr(tto, "_SURE_FRACTION", 1.0)
    params = Params(max_passes=3.0)
    as_in_training = replace(params, momentum=0.9)
    assert missed(params) < 0.97 * missed(as_in_training)
    assert missed(params) < 0.97 * missed(replace(params, huber_delta=0.0))


def test_a_momentum_that_never_forgets_is_refused():
    with raises(ConfigError, code="out_of_range", match="momentum"):
        Params(momentum=1.0)


PLAIN = Params(
    owner_cells=False, ssim_weight=0.0, huber_delta=0.0, min_weight=0.0, kept_fraction=1.0, prefer="both", voxel_m=0.01
)


@pytest.mark.parametrize("bounds", [None, np.array([[-0.3, -2, -2], [0.6, 2, 2]])])
def test_the_published_method_fits_every_voxel_of_the_union_by_l1(watched, bounds):
    scenes = two_scenes()
    voxels = merge(scenes, "voxel", type(default_params("voxel"))(voxel_m=0.01), bounds=bounds)
    start = merge(scenes, "tto", replace(PLAIN, steps=0), bounds=bounds)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        np.testing.assert_array_equal(getattr(start.gaussians, name), getattr(voxels.gaussians, name))
    np.testing.assert_array_equal(start.origin, voxels.origin)
    fitted = merge(scenes, "tto", replace(PLAIN, steps=20), bounds=bounds)
    assert len(fitted.gaussians) == len(voxels.gaussians)
    cameras, images, masks = watched.last.asked[0]
    error = np.abs(render(watched.last.start, cameras).colour - images / np.float32(255)) * (masks[..., None] / 255)
    assert watched.last.losses[0] == pytest.approx(error.sum() / (3 * (masks / 255).sum()), rel=1e-4)


def test_where_both_are_preferred_dates_decide_nothing():
    a, b = two_scenes()
    dated = [replace(a, captured_at="2026-01-01"), replace(b, captured_at="2026-02-01")]
    params = Params(steps=5, prefer="both")
    assert not tto.uses_dates(params)
    assert tto.uses_dates(Params())
    np.testing.assert_array_equal(merge([a, b], "tto", params).gaussians.sh, merge(dated, "tto", params).gaussians.sh)


@pytest.mark.parametrize(
    "wrong",
    [
        {"kept_fraction": 1.2},
        {"steps": -1},
        {"voxel_m": 0.0},
        {"halo_m": -1.0},
        {"ssim_weight": 2.0},
        {"huber_delta": -0.1},
        {"photo_weight": -1.0},
        {"max_views": 0},
    ],
)
def test_settings_that_make_no_sense_are_refused_by_name(wrong):
    with raises(ConfigError, code="out_of_range", match=next(iter(wrong))):
        Params(**wrong)
