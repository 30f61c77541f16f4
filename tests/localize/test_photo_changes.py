"""What a placed photograph tells of changes: none of an unchanged place, whatever the light; and what changed."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.localize import compare_photo, render_capture_views
from gsmap.types.localization import Photo
from gsmap_synthetic import film
from gsmap_synthetic.capture import unused_doors
from gsmap_synthetic.change import sight
from gsmap_synthetic.edits import Remove, edit_place

VIEW = 0  # of the world's poses
WHERE = (300, 200)  # in its picture, where the map is known


@pytest.fixture(scope="module")
def eyes(world):
    return {"scene": render_capture_views(world.placed, world.capture.cameras)}


def told(
    world,
    eyes,
    place,
    *,
    view=VIEW,
    off_m=0.0,
    covariance=None,
    change=lambda rgb: rgb,
    min_change_fraction=0.003,
    **light,
):
    shut = unused_doors(world.place, (0,))  # as they were when it was captured
    frames = film(place, world.poses[view][None], size_px=(480, 360), shut=shut, focal=world.focal, **light)
    photo = Photo(change(frames.images[0]), frames.cameras.intrinsics_px[0])
    pose = world.poses[view].copy()
    pose[:3, 3] += off_m * pose[:3, 0]
    known = np.diag([0.002**2] * 3 + [0.01**2] * 3) if covariance is None else covariance
    return compare_photo(photo, pose, known, photo.intrinsics_px, [world.placed], eyes, 480, min_change_fraction)


@pytest.mark.parametrize("light", [{}, {"gain": 0.6}, {"gain": np.array([1.25, 1.1, 0.95]), "gamma": 1.15}])
def test_an_unchanged_place_differs_nowhere_in_any_exposure(world, eyes, light) -> None:
    found = told(world, eyes, world.place, **light)
    assert found.regions == ()
    assert found.compared_fraction > 0.25


@pytest.mark.slow
def test_nor_by_night(world, eyes) -> None:
    assert told(world, eyes, edit_place(world.place, light="night")).regions == ()


def test_nor_from_a_pose_that_is_off_by_what_its_covariance_says(world, eyes) -> None:
    loose = np.diag([0.004**2] * 3 + [0.03**2] * 3)
    assert told(world, eyes, world.place, off_m=0.03, covariance=loose).regions == ()


def somebody(rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A photo with a box of stripes standing in it, and where."""
    v, u = np.mgrid[0 : rgb.shape[0], 0 : rgb.shape[1]]
    where = (np.abs(u - WHERE[0]) < 45) & (np.abs(v - WHERE[1]) < 60)
    stripes = np.array([[230, 40, 40], [40, 220, 60]], np.uint8)[(v // 12) % 2]
    return np.where(where[..., None], stripes, rgb), where


def test_what_stands_in_front_is_found_where_it_stands(world, eyes) -> None:
    where = None

    def stand(rgb: np.ndarray) -> np.ndarray:
        nonlocal where
        rgb, where = somebody(rgb)
        return rgb

    found = told(world, eyes, world.place, change=stand)
    assert len(found.regions) >= 1
    best = found.regions[0]
    # A region reaches half a patch beyond what differs.
    assert where[best.mask].mean() > 0.5
    assert best.mask[where & found.compared].mean() > 0.6
    assert best.kind in ("appeared", "replaced")
    x0, y0, x1, y1 = best.box_px
    row, column = np.nonzero(best.mask)
    assert (x0, y0, x1, y1) == (column.min(), row.min(), column.max() + 1, row.max() + 1)
    assert best.share == pytest.approx(best.mask.mean())
    assert not found.agrees[best.mask].any()


def test_another_colour_is_told_as_one(world, eyes) -> None:
    v, u = np.mgrid[0:360, 0:480]
    where = (np.abs(u - WHERE[0]) < 60) & (np.abs(v - WHERE[1]) < 60)

    def paint(rgb: np.ndarray) -> np.ndarray:
        return np.where(where[..., None], (rgb * [0.5, 1.0, 0.6]).astype(np.uint8), rgb)

    found = told(world, eyes, world.place, change=paint)
    assert found.regions
    assert not told(world, eyes, world.place, change=paint, min_change_fraction=0.5).regions
    assert where[found.regions[0].mask].mean() > 0.5


@pytest.mark.slow
def test_a_thing_that_was_taken_away_is_found_where_it_stood(world, eyes) -> None:
    frames = film(world.place, world.poses, size_px=(480, 360), focal=world.focal)
    shown = sight(world.place, frames.cameras, unused_doors(world.place, (0,)))[0]
    kinds = {thing.id: thing.kind for thing in world.place.objects}
    size, view, thing = max(
        (int((ids == k).sum()), view, int(k))
        for view, ids in enumerate(shown)
        for k in np.unique(ids)
        if kinds.get(int(k)) == "furniture"
    )
    assert size > 2000
    found = told(world, eyes, edit_place(world.place, [Remove(thing)]), view=view)
    assert any((shown[view] == thing)[one.mask].mean() > 0.5 for one in found.regions)


def test_what_no_camera_of_a_capture_looked_at_is_not_judged(world) -> None:
    blind = {"scene": render_capture_views(world.placed, None)}
    found = told(world, blind, world.place, change=lambda rgb: somebody(rgb)[0])
    assert found.regions == ()
    assert found.compared_fraction == 0.0
