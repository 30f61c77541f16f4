"""Photographs that a map keeps, as pictures that the merged map must look like."""

from dataclasses import replace

import numpy as np
import pytest
from synthetic_walls import cameras_facing, texture, two_scenes, wall

from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import PosedScene, default_params, merge, photos, photos_m, references
from gsmap.merge.exposure import apply_gain, balance_exposure
from gsmap.merge.photos import make_photo_reference
from gsmap.merge.references import render_references
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.render import render
from gsmap.types import Gaussians, ReferencePhoto, Sim3

WIDTH, GRAIN = 64, 0.05
TRUTH = wall(9, -1.8, 1.8, spacing=0.02)  # finer than what was trained


def quiet(fraction, text):
    pass


def picture_at(x, gain=1.0, somebody=False):
    """A photograph of the true wall, in an exposure of its own, perhaps with somebody before it."""
    seen = render(TRUTH, cameras_facing([x])).colour[0] * gain
    if somebody:
        seen[10:40, 24:38] = [0.9, 0.05, 0.05]
    return np.round(np.clip(seen, 0, 1) * 255).astype(np.uint8)


def photo_at(x, **options):
    return ReferencePhoto(cameras_facing([x]), lambda: picture_at(x, **options), 0.001, 0.003)


def ask(photo, scene=None):
    return make_photo_reference(photo, scene or two_scenes(grain=0.0)[0], WIDTH)


def error(gaussians: Gaussians, xs) -> float:
    """Mean square beside true pictures, of their middles."""
    middle = np.s_[8:-8, 16:-16]
    shown = [render(gaussians, cameras_facing([x])).colour[0][middle] - picture_at(x)[middle] / 255 for x in xs]
    return float(np.mean(np.square(shown)))


def test_a_photograph_is_brought_to_the_exposure_of_its_capture():
    found = ask(photo_at(-0.5, gain=np.array([0.6, 0.7, 0.8])))
    assert found is not None
    assert found.counts[5:-5, 5:-5].mean() > 0.9
    off = found.image / 255.0 - picture_at(-0.5) / 255.0
    assert np.abs(np.median(off[found.counts], axis=0)).max() < 0.02


def test_what_stands_before_the_place_does_not_count():
    found = ask(photo_at(-0.5, somebody=True))
    assert found is not None
    assert not found.counts[10:40, 24:38].any()
    assert found.counts[4:-4, 4:20].mean() > 0.9


def test_a_picture_of_something_else_or_from_who_knows_where_is_left_out(monkeypatch):
    other = ReferencePhoto(cameras_facing([-0.5]), lambda: picture_at(1.1)[:, ::-1].copy())
    assert ask(other) is None
    assert ask(replace(photo_at(-0.5), sigma_m=0.1)) is None  # 480 / 64 * 60 px * .1 / 1.2
    assert ask(replace(photo_at(-0.5), sigma_rad=0.02)) is None
    monkeypatch.setattr(photos, "_MAX_SIGMA_PX", 100.0)
    assert ask(replace(photo_at(-0.5), sigma_m=0.1)) is not None


def test_before_a_plain_wall_a_picture_of_another_place_is_told_by_following_nothing():
    plain = wall(0, -1.5, 0.5, colour=lambda x, y: 0.5 + 0.3 * (texture(x, y) - 0.5))
    scene = PosedScene(plain, cameras_facing([-0.5]), "a")
    shows = np.round(np.clip(render(plain, cameras_facing([-0.5])).colour[0], 0, 1) * 255).astype(np.uint8)
    assert ask(ReferencePhoto(cameras_facing([-0.5]), lambda: shows), scene) is not None
    assert ask(ReferencePhoto(cameras_facing([-0.5]), lambda: shows[..., ::-1].copy()), scene) is None


def test_a_larger_picture_is_reduced_and_a_smaller_one_taken_as_it_is():
    large = replace(photo_at(-0.5), camera=cameras_facing([-0.5]).resized(256))
    found = ask(replace(large, read=lambda: np.repeat(np.repeat(picture_at(-0.5), 4, 0), 4, 1)))
    assert found.image.shape == (48, 64, 3)
    small = make_photo_reference(photo_at(-0.5), two_scenes(grain=0.0)[0], 960)
    assert small.image.shape == (48, 64, 3)


def test_what_a_tile_does_not_hold_does_not_count_there():
    a, b = two_scenes(grain=GRAIN)
    scenes = [replace(a, photos=(photo_at(-0.5), photo_at(3.0))), b]
    whole = render_references(scenes, None, 0.0, 64, None, quiet)
    assert whole.num_photos == 1
    assert (whole.scene[-1], whole.view_weights[-1]) == (0, 4.0)
    tile = np.array([[-0.6, -2, -2], [0.0, 2, 2]])
    part = render_references(scenes, tile, 0.0, 64, None, quiet)
    assert part.num_photos == 1
    assert 0 < (part.weights[-1] > 0).sum() < 0.7 * (whole.weights[-1] > 0).sum()
    elsewhere = render_references(scenes, np.array([[0.7, -2, -2], [2, 2, 2]]), 0.0, 64, None, quiet)
    assert elsewhere.num_photos == 0


def test_the_merged_map_is_nearer_to_what_no_capture_showed_so_sharply():
    a, b = two_scenes(grain=GRAIN)
    params = replace(default_params("tto"), halo_m=0.5)
    xs = (-0.8, -0.3, 0.3, 0.8)
    with_photos = [
        replace(a, photos=tuple(photo_at(x) for x in xs[:2])),
        replace(b, photos=tuple(map(photo_at, xs[2:]))),
    ]
    plain, fitted = (merge(scenes, "tto", params) for scenes in ([a, b], with_photos))
    assert fitted.notes == ("4 photos were used as reference views",)
    between = (-0.55, 0.0, 0.55)  # where no photo was taken
    assert error(fitted.gaussians, between) < 0.6 * error(plain.gaussians, between)
    without = replace(params, photo_weight=0.0)
    assert np.array_equal(merge(with_photos, "tto", without).gaussians.means, plain.gaussians.means)
    assert photos_m("tto", params) == 10.5
    assert photos_m("tto", without) is None
    assert photos_m("union") is None


def test_one_capture_alone_is_fitted_where_there_are_photographs():
    (a, _) = two_scenes(grain=GRAIN)
    alone = merge([a], "tto")
    assert alone.steps == 0
    helped = merge([replace(a, photos=(photo_at(-0.8), photo_at(-0.2)))], "tto")
    assert helped.steps > 0
    assert error(helped.gaussians, (-0.5,)) < 0.8 * error(alone.gaussians, (-0.5,))


def test_photographs_of_balanced_captures_are_brought_to_the_balanced_colours():
    a, b = two_scenes(grain=0.0)
    brighter = apply_gain(b.gaussians, np.array([1.25, 1.1, 0.9]))
    photo = replace(photo_at(0.5), around=lambda: brighter)
    scenes, log_gains = balance_exposure([a, PosedScene(brighter, b.cameras, "b", photos=(photo,))])
    found = make_photo_reference(scenes[1].photos[0], scenes[1], WIDTH)
    colours = found.image[found.counts].mean(0) / 255
    balanced = render(scenes[1].gaussians, cameras_facing([0.5])).colour[0][found.counts].mean(0)
    assert log_gains.any()
    assert colours == pytest.approx(balanced, abs=0.02)


def moved(photo, S):
    """A photograph in the frame of a scene that lies so; how well it is known is said in that frame's unit."""
    return replace(photo, camera=transform_cameras(photo.camera, S.inverse()))


def lazy(scene, S, asked, *photos):
    own = transform_gaussians(scene.gaussians, S.inverse())

    def load(box):
        asked.append(box)
        return own

    return LazyScene(scene.scene_id, S, load, transform_cameras(scene.cameras, S.inverse()), photos=photos)


def test_a_tile_reads_what_is_around_a_photograph_in_its_scenes_own_frame():
    a, b = two_scenes(grain=GRAIN)
    S = Sim3.from_matrix(np.array([[0, -2.0, 0, 3], [2.0, 0, 0, -1], [0, 0, 2.0, 0.5], [0, 0, 0, 1]]))
    asked = []
    bounds = np.array([[-1.0, -2, -2], [1.0, 2, 2]])
    params = replace(default_params("tto"), steps=60)
    placed = merge([replace(a, photos=(photo_at(-0.5),)), b], "tto", params, bounds=bounds)
    photo = moved(photo_at(-0.5), S)
    read = merge_tile([lazy(a, S, asked, photo), lazy(b, S, [])], "tto", params, bounds=bounds)
    assert "1 photo was used as reference views" in read.notes
    assert error(read.gaussians, [-0.5]) == pytest.approx(error(placed.gaussians, [-0.5]), rel=0.1)
    bare = merge([a, b], "tto", params, bounds=bounds)
    assert error(placed.gaussians, [-0.5]) < 0.9 * error(bare.gaussians, [-0.5])
    (centre,) = photo.camera.centers
    assert any(box is not None and (box[0] < centre).all() and (centre < box[1]).all() for box in asked)


def test_how_well_a_photograph_is_known_in_the_unit_of_its_scene():
    """Three pixels are 8 mm of the map here: 5 are known well enough, and 2 cm are not."""
    a, b = two_scenes(grain=GRAIN)
    params = replace(default_params("tto"), steps=0)
    for scale, sigma, taken in ((0.1, 0.05, True), (10.0, 0.002, False)):
        S = Sim3(np.eye(3), np.zeros(3), scale)
        photo = moved(replace(photo_at(-0.5), sigma_m=sigma), S)
        notes = merge_tile([lazy(a, S, [], photo), lazy(b, S, [])], "tto", params).notes
        assert ("1 photo was used as reference views" in notes) == taken


def test_of_too_many_photographs_those_that_show_most_are_reproduced(monkeypatch):
    a, b = two_scenes(grain=GRAIN)
    scenes = [replace(a, photos=(photo_at(-1.4), photo_at(-0.9))), replace(b, photos=(photo_at(0.6),))]
    monkeypatch.setattr(references, "_MAX_PHOTOS", 2)
    found = render_references(scenes, None, 0.0, 64, None, quiet)
    assert found.num_photos == 2
    assert sorted(found.cameras.centers[-2:, 0].tolist()) == [-0.9, 0.6]


def test_what_is_around_photographs_that_stand_together_is_read_once():
    a, b = two_scenes(grain=GRAIN)
    with_photos, without, S = [], [], Sim3.identity()
    kept = [moved(photo_at(x), S) for x in (-0.9, -0.8, -0.7)]
    params = replace(default_params("tto"), steps=0)
    bounds = np.array([[-1.5, -2, -2], [0.5, 2, 2]])
    merge_tile([lazy(a, S, without), lazy(b, S, [])], "tto", params, bounds=bounds)
    notes = merge_tile([lazy(a, S, with_photos, *kept), lazy(b, S, [])], "tto", params, bounds=bounds).notes
    assert "3 photos were used as reference views" in notes
    assert len(with_photos) - len(without) == 1
