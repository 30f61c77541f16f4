"""What a mask hides of a photograph counts nowhere: neither for its pose nor for whether that is believed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from raising import raises

import gsmap.map
from gsmap.cli.app import run
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.localize import (
    Params,
    direct_alignment,
    evidence,
    localization,
    localize_photo,
    mismatch,
    read_photo,
    refinement,
)
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.extractors import sift
from gsmap.types.localization import Photo

SIFT = sift.make({}, sift.Params())
PARAMS = Params()


def _hidden(photo: Photo, seed: int) -> Photo:
    """Two people full of detail before a photo, and their mask."""
    height, width = photo.rgb.shape[:2]
    known = np.ones((height, width), bool)
    known[height // 4 :, width // 8 : 3 * width // 8] = False
    known[height // 4 :, 5 * width // 8 : 7 * width // 8] = False
    noise = np.random.default_rng(seed).integers(0, 255, (height // 4 + 1, width // 4 + 1, 3), np.uint8)
    crowd = np.kron(noise, np.ones((4, 4, 1), np.uint8))[:height, :width]
    return replace(photo, rgb=np.where(known[..., None], photo.rgb, crowd), known=known)


@pytest.fixture(scope="module")
def crowds(world) -> list[Photo]:
    return [_hidden(world.photos[1], seed) for seed in (0, 1)]


def _found(world, photo: Photo):
    return localize_photo(photo, world.index, {"scene": world.placed}, SIFT, PARAMS)


def test_what_is_hidden_does_not_matter(world, crowds) -> None:
    one, other, plain = (_found(world, photo) for photo in (*crowds, world.photos[1]))
    unsaid = _found(world, replace(crowds[0], known=None))
    assert not unsaid.is_placed
    assert one.is_placed, one.reason
    assert other.is_placed, other.reason
    assert np.linalg.norm(one.T_map_camera[:3, 3] - world.poses[1][:3, 3]) < 0.05
    assert np.abs(one.T_map_camera - other.T_map_camera).max() < 2e-3
    assert np.abs(one.T_map_camera - plain.T_map_camera).max() < 0.02
    for name in ("explained", "explained_coarsely", "laid", "found_again", "seen"):
        assert one.evidence[name] == pytest.approx(plain.evidence[name], abs=0.15), name
    for name in ("contradicted", "contradicted_coarsely", "unlike_part", "unlike"):
        assert one.evidence[name] < plain.evidence[name] + 0.05, name


def test_no_step_looks_at_what_is_hidden(world, crowds) -> None:
    picture, _ = localization.scale_photo(crowds[0], 480)
    looks = render_scenes([world.placed], world.poses[1], picture.intrinsics_px, picture.size_px)
    here = picture.mask
    found = localization.extract_features(picture, SIFT, 0.0)
    column, row = found.pixels.astype(int).T
    assert here[row, column].all()
    assert len(found.angles_rad) == len(found.sizes_px) == len(found) > 50
    patches = refinement._track_patches(picture, 1.0, looks, 6)
    column, row = patches.pixels.astype(int).T
    assert here[row, column].all()
    unmasked = refinement._track_patches(replace(picture, mask=None), 1.0, looks, 6)
    assert patches.num_tracked < unmasked.num_tracked
    half = picture.halved()
    small = render_scenes([world.placed], world.poses[1], half.intrinsics_px, half.size_px)
    laid = direct_alignment.align(half.rgb, small[0], world.poses[1], half.intrinsics_px, 2.0, None, half.mask)
    column, row = np.clip(laid.pixels, 0, np.array(half.size_px) - 1).astype(int).T
    assert half.mask[row, column].mean() > 0.98  # points move with the pose, and some come to lie behind its edge
    cells = mismatch.mismatch_map(picture.rgb, looks, here).probability
    assert np.isnan(cells[15:, 9:21]).all()
    assert np.isfinite(cells).mean() > 0.2
    other, _ = localization.scale_photo(crowds[1], 480)
    apart = np.abs(cells - mismatch.mismatch_map(other.rgb, looks, here).probability)
    assert np.nanmax(apart) < 1e-3  # the light as well is that of the place
    for compared, patch in (
        (evidence.compare(picture.rgb, looks, mask=here), (slice(14, None), slice(8, 21))),
        (evidence.compare_coarsely(picture.rgb, looks, mask=here), (slice(6, None), slice(4, 9))),
    ):
        assert np.isnan(compared.correlation[patch]).all()
        assert compared.num_compared > 20
        assert compared.seen > 0.9


def test_a_mask_is_halved_and_made_smaller_to_what_is_wholly_seen() -> None:
    rgb = np.zeros((720, 960, 3), np.uint8)
    known = np.ones((720, 960), bool)
    known[101, 201] = False
    picture, _ = localization.scale_photo(Photo(rgb, np.array([700.0, 700, 480, 360]), known=known), 480)
    assert picture.mask.shape == picture.grey.shape == (360, 480)
    assert np.argwhere(~picture.mask).tolist() == [[50, 100]]
    assert np.argwhere(~picture.halved().mask).tolist() == [[25, 50]]


def test_a_pose_that_is_settled_by_half_a_photo_is_that_of_all_of_it(world) -> None:
    photo = world.photos[0]
    known = np.zeros(photo.rgb.shape[:2], bool)
    known[:, : known.shape[1] * 2 // 3] = True
    picture, _ = localization.scale_photo(replace(photo, known=known), 480)
    settled = refinement.refine_pose(picture, world.poses[0], picture.intrinsics_px, [world.placed])
    assert np.linalg.norm(settled.T_metric_camera[:3, 3] - world.poses[0][:3, 3]) < 0.05
    assert (settled.pixels[:, 0] < 320).all()


# --- files -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path, crowds):
    (tmp_path / "masks").mkdir()
    Image.fromarray(crowds[0].rgb).save(tmp_path / "photo.png")
    Image.fromarray(crowds[0].known).save(tmp_path / "masks" / "photo.png.png")
    return tmp_path


def test_masks_are_read_by_the_photos_name(folder, crowds) -> None:
    assert np.array_equal(read_photo(folder / "photo.png", masks=folder / "masks").known, crowds[0].known)
    (folder / "masks" / "photo.png.png").rename(folder / "masks" / "photo.png")
    assert np.array_equal(read_photo(folder / "photo.png", masks=folder / "masks").known, crowds[0].known)
    assert read_photo(folder / "photo.png").known is None


@pytest.mark.parametrize(
    ("what", "error", "code"),
    [
        ("none", NotFoundError, "mask_missing"),
        ("folder", NotFoundError, "folder_not_found"),
        ("size", InputError, "size_mismatch"),
        ("black", InputError, "black_mask"),
        ("text", InputError, "picture_unreadable"),
    ],
)
def test_a_mask_that_is_none_is_told(folder, what: str, error: type[Exception], code: str) -> None:
    path, masks = folder / "masks" / "photo.png.png", folder / "masks"
    if what == "none":
        path.unlink()
    elif what == "folder":
        masks = folder / "nowhere"
    elif what == "text":
        path.write_text("not a picture")
    else:
        size = (10, 10) if what == "size" else (480, 360)
        Image.new("L", size, 0 if what == "black" else 255).save(path)
    with raises(error, code=code):
        read_photo(folder / "photo.png", masks=masks)


def test_the_command_line_takes_masks(folder, world, crowds, capsys) -> None:
    lens = ",".join(f"{value:.3f}" for value in crowds[0].intrinsics_px)
    site = folder / "m.gsmap"
    with gsmap.map.create(site) as m:
        m.ingest(world.capture.gaussians, cameras=world.capture.cameras, name="room")
        m.optimize()
    asked = ["localize", str(site), str(folder / "photo.png"), "--intrinsics", lens]
    for more, status in (((), "refused"), (("--masks", str(folder / "masks")), "placed")):
        with pytest.raises(SystemExit) as ended:
            run(["-q", *asked, *more, "--json"])
        assert not ended.value.code
        assert [row["status"] for row in json.loads(capsys.readouterr().out)["results"]] == [status]
    with gsmap.map.open(site) as m:
        with raises(ConfigError, code="option_not_applicable", match="frames of a video"):
            m.localize(video=folder / "clip.mp4", masks=folder / "masks")
        with raises(ConfigError, code="option_not_applicable", match="depth image"):
            m.localize(folder / "photo.png", depth=folder / "photo.png", masks=folder / "masks", intrinsics=lens)
