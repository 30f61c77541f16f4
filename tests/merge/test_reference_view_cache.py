"""What views show is rendered once for all tiles, and no tile depends on which others were made."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from synthetic_walls import cameras_facing, two_scenes, wall

from gsmap.geometry.boxes import inside
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import MergeResult, default_params, reference_view_cache, with_steps
from gsmap.merge.reference_view_cache import ReferenceView, ReferenceViewCache, SceneReferenceViews, keys_of
from gsmap.merge.references import render_references
from gsmap.merge.tile import LazyScene, _read, _Reading, merge_tile
from gsmap.render import render
from gsmap.types import Gaussians, PosedScene, Sim3

S = Sim3(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5.0, 1, -2]), 2.0)
"""Takes the map to a scene's own frame."""


def lazy_scenes(store: ReferenceViewCache, dates: tuple[str | None, str | None] = (None, None)) -> list[LazyScene]:
    """The two halves of a wall, each in a frame of its own with another unit."""

    def load(gaussians: Gaussians, box: np.ndarray | None) -> Gaussians:
        return gaussians if box is None else gaussians[inside(gaussians.means, box, 0.05)]

    found = []
    for scene, date in zip(two_scenes(), dates, strict=True):
        assert scene.cameras is not None
        own = transform_gaussians(scene.gaussians, S)
        cameras = transform_cameras(scene.cameras, S)
        found.append(LazyScene(scene.scene_id, S.inverse(), partial(load, own), cameras, date, store))
    return found


TILES = [np.array([[low, -2.0, -2], [low + 0.75, 2, 2]]) for low in (-1.5, -0.75, 0.0, 0.75)]


def made(tile: np.ndarray, store: ReferenceViewCache) -> MergeResult:
    params = with_steps("tto", default_params("tto"), 3)
    return merge_tile(lazy_scenes(store), "tto", params, bounds=tile)


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many Gaussians each sight was rendered from."""
    counts: list[int] = []

    def noted(gaussians: Gaussians, *args: object, **how: object) -> object:
        counts.append(len(gaussians))
        return render(gaussians, *args, **how)  # type: ignore[arg-type]

    monkeypatch.setattr(reference_view_cache, "render", noted)
    return counts


def test_each_view_is_rendered_once_for_all_tiles(tmp_path: Path, rendered: list[int]) -> None:
    for tile in TILES:
        made(tile, ReferenceViewCache(str(tmp_path / "shared")))
    assert len(rendered) == 14
    assert len(list((tmp_path / "shared").iterdir())) == 14


def test_a_tile_is_the_same_whatever_else_is_made(tmp_path: Path, rendered: list[int]) -> None:
    alone = [made(tile, ReferenceViewCache()) for tile in TILES]
    store = ReferenceViewCache(str(tmp_path / "shared"))
    others = [made(tile, store) for tile in reversed(TILES)][::-1]
    small = ReferenceViewCache(str(tmp_path / "small"), max_bytes=20_000)
    forgetful = [made(tile, small) for tile in TILES]
    for result in (others, forgetful):
        for one, other in zip(alone, result, strict=True):
            for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
                np.testing.assert_array_equal(getattr(one.gaussians, name), getattr(other.gaussians, name))
    assert sum(path.stat().st_size for path in (tmp_path / "small").iterdir()) <= 2 * 20_000


def test_sights_tell_what_the_whole_capture_shows() -> None:
    """The references of a tile are those that are rendered from all of a capture."""
    reading = _Reading(1.0, 1.0, 11.0, 12)
    tile = np.array([[0.0, -2, -2], [0.75, 2, 2]])
    whole = [
        PosedScene(
            transform_gaussians(scene.load(None), scene.S_map_scene),
            transform_cameras(scene.cameras, scene.S_map_scene),
            scene.scene_id,
        )
        for scene in lazy_scenes(ReferenceViewCache())
        if scene.cameras is not None
    ]
    pieces = [_read(scene, tile, reading) for scene in lazy_scenes(ReferenceViewCache())]
    assert all(piece.reference_views is not None for piece in pieces)
    expected = render_references(whole, tile, 1.0, 64, None, lambda *_: None)
    found = render_references(pieces, tile, 1.0, 64, None, lambda *_: None)
    assert len(found) == len(expected) > 3
    np.testing.assert_array_equal(found.scene, expected.scene)
    np.testing.assert_allclose(found.view_weights, expected.view_weights, atol=0.01)
    for one, other in zip(found.images, expected.images, strict=True):
        assert one.shape == other.shape
        assert np.abs(one.astype(int) - other).mean() < 0.5
    for scene, piece, one, other in zip(whole, pieces, found.visible_pixels, expected.visible_pixels, strict=True):
        order = {tuple(row): i for i, row in enumerate(np.round(scene.gaussians.means, 4).tolist())}
        rows = [order[tuple(row)] for row in np.round(piece.gaussians.means, 4).tolist()]
        dominant = other[rows] >= 1
        np.testing.assert_allclose(one[dominant], other[rows][dominant], atol=3)


def test_a_capture_whose_cameras_stand_far_off_is_rendered_for_the_tile() -> None:
    """From a drone: what lies around its cameras is not what they show."""
    scene = LazyScene("a", Sim3.identity(), lambda box: wall(0, -1, 1), cameras_facing([0.0], distance=60.0))
    piece = _read(scene, TILES[1], _Reading(1.0, 1.0, 11.0, 12))
    assert piece.reference_views is None
    assert piece.cameras is not None
    assert len(piece.cameras) == 1


def test_captures_of_several_dates_are_read_far_enough_to_be_compared() -> None:
    asked: list[np.ndarray | None] = []

    def load(box: np.ndarray | None) -> Gaussians:
        asked.append(box)
        return wall(0, -1.5, 1.5)

    for dates in ((None, None), ("2024-01-01", "2025-01-01")):
        scenes = [
            LazyScene(name, Sim3.identity(), load, cameras_facing([0.0]), date)
            for name, date in zip("ab", dates, strict=True)
        ]
        merge_tile(scenes, "union", default_params("union"), bounds=TILES[1])
        params = with_steps("tto", default_params("tto"), 0)
        merge_tile(scenes, "tto", params, bounds=TILES[1])
    edges = [float(np.ptp(box[:, 0])) for box in asked if box is not None]
    assert min(edges) < 0.8  # the union's
    assert max(edges) > 22


def test_a_file_that_is_not_whole_is_made_again(tmp_path: Path) -> None:
    store = ReferenceViewCache(str(tmp_path / "shared"))
    gaussians = wall(0, -1, 1)
    views = SceneReferenceViews("a", lambda box: gaussians, cameras_facing([0.0]), 10.0, 64, store)
    first = views.of(0)
    (path,) = (tmp_path / "shared").iterdir()
    path.write_bytes(path.read_bytes()[:300])
    again = views.of(0)
    np.testing.assert_array_equal(again.depth, first.depth)
    assert isinstance(ReferenceView.read(path), ReferenceView)


def test_keys_tell_gaussians_apart() -> None:
    means = np.random.default_rng(0).uniform(-1, 1, (100_000, 3)).astype(np.float32)
    assert len(np.unique(keys_of(means))) == len(np.unique(means, axis=0))
    np.testing.assert_array_equal(keys_of(means[::-1]), keys_of(means)[::-1])
    assert keys_of(means[:1, ::-1]) != keys_of(means[:1])
