from dataclasses import replace

import numpy as np
import pytest
from raising import raises

from gsmap.errors import ConfigError, InputError
from gsmap.geometry.boxes import inside
from gsmap.merge import PosedScene, default_params, merge, methods
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.types import Cameras, Gaussians, Sim3


def cloud(seed, n=3000, low=(-1, -1, -1), high=(1, 1, 1)):
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(low, high, size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-4, 0.3, size=(n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, size=(n, 4, 3)),
    )


def rows(gaussians):
    """Rows in an order of their own, to compare sets."""
    flat = np.concatenate([gaussians.means, gaussians.log_scales, gaussians.logit_opacities[:, None]], axis=1)
    return flat[np.lexsort(flat.T)]


TILES = [np.array([[x, y, -2], [x + 1.005, y + 1.005, 2]]) for x in (-1.005, 0.0) for y in (-1.005, 0.0)]


def test_union_keeps_everything_with_its_origin():
    parts = [PosedScene(cloud(0), scene_id="b"), PosedScene(cloud(1, n=500), scene_id="a")]
    result = merge(parts, "union")
    assert result.num_input == len(result.gaussians) == 3500
    np.testing.assert_array_equal(result.gaussians.means[result.origin == 1], parts[1].gaussians.means)


def test_distance_keeps_exactly_what_is_nearer_to_its_own_centroid():
    a, b = cloud(0), cloud(1, low=(0, -1, -1), high=(3, 1, 1))
    result = merge([PosedScene(a, scene_id="a"), PosedScene(b, scene_id="b")], "distance")
    centre_a, centre_b = a.means.mean(0), b.means.mean(0)
    nearer_a = lambda p: np.linalg.norm(p - centre_a, axis=1) < np.linalg.norm(p - centre_b, axis=1)  # noqa: E731
    np.testing.assert_array_equal(result.gaussians.means[result.origin == 0], a.means[nearer_a(a.means)])
    np.testing.assert_array_equal(result.gaussians.means[result.origin == 1], b.means[~nearer_a(b.means)])


def test_distance_alone_keeps_everything_and_a_tile_uses_the_whole_captures_centroid():
    a, b = cloud(0), cloud(1, low=(0, -1, -1), high=(3, 1, 1))
    assert len(merge([PosedScene(a)], "distance").gaussians) == len(a)
    whole = merge([PosedScene(a, scene_id="a"), PosedScene(b, scene_id="b")], "distance")
    parts = [
        PosedScene(g, scene_id=s, centroid=lambda g=g: g.means.mean(0, dtype=float)) for g, s in ((a, "a"), (b, "b"))
    ]
    boxes = [np.array([[-9, -9, -9], [0.4, 9, 9]]), np.array([[0.4, -9, -9], [9, 9, 9]])]
    tiles = [merge(parts, "distance", bounds=box).gaussians for box in boxes]
    np.testing.assert_array_equal(rows(Gaussians.concatenate(tiles)), rows(whole.gaussians))


@pytest.mark.parametrize("method", ["union", "voxel"])
def test_tiles_made_apart_are_the_whole(method):
    parts = [PosedScene(cloud(s, n=20_000), scene_id=str(s)) for s in range(2)]
    params = default_params(method)
    if method == "voxel":
        params = type(params)(voxel_m=0.07)
    whole = merge(parts, method, params)
    tiles = [merge(parts, method, params, bounds=box) for box in TILES]
    assert sum(t.num_input for t in tiles) == 40_000
    np.testing.assert_allclose(
        rows(Gaussians.concatenate([t.gaussians for t in tiles])), rows(whole.gaussians), atol=1e-6
    )


@pytest.mark.parametrize("method", ["union", "distance", "voxel"])
def test_order_of_parts_does_not_matter(method):
    a, b = PosedScene(cloud(0), scene_id="a"), PosedScene(cloud(1), scene_id="b")
    one, other = merge([a, b], method), merge([b, a], method)
    np.testing.assert_array_equal(one.gaussians.means, other.gaussians.means)
    np.testing.assert_array_equal(one.origin, 1 - other.origin)


def test_voxel_merges_a_capture_with_its_copy_into_one():
    g = cloud(0)
    result = merge(
        [PosedScene(g, scene_id="a"), PosedScene(g, scene_id="b")],
        "voxel",
        type(default_params("voxel"))(voxel_m=1e-4),
    )
    assert len(result.gaussians) == len(g)
    joint = 1 - (1 - g.opacities.astype(float)) ** 2
    np.testing.assert_allclose(np.sort(result.gaussians.opacities), np.sort(joint), rtol=1e-3)


def test_bad_input_is_refused_in_words():
    part = PosedScene(cloud(0))
    with raises(InputError, code="nothing_to_merge"):
        merge([], "union")
    with raises(ConfigError, code="unknown_method", match="'concat'.*choose one of"):
        merge([part], "concat")
    with raises(ConfigError, code="invalid_budget"):
        merge([part], "union", budget_s=0)
    with raises(ConfigError, code="invalid_method"):
        merge([part], "union", default_params("voxel"))
    with raises(InputError, code="invalid_box"):
        merge([part], "union", bounds=np.zeros((2, 3)))
    assert {"union", "distance", "voxel"} <= set(methods())


def test_a_tile_without_anything_in_it_is_empty():
    result = merge([PosedScene(cloud(0))], "voxel", bounds=np.array([[50, 50, 50], [51, 51, 51]]))
    assert len(result.gaussians) == len(result.origin) == result.num_input == 0


def lazy(gaussians, scene_id, asked=None, cameras=None):
    """A scene that reads no more than it is asked for, and notes what that was."""

    def load(box):
        if asked is not None:
            asked.append(box)
        return gaussians if box is None else gaussians[inside(gaussians.means, box)]

    return LazyScene(scene_id, Sim3(np.eye(3), [1.0, 0, 0]), load, cameras)


def test_distance_read_piece_by_piece_knows_the_centroid_of_the_whole_capture():
    a, b = cloud(0), cloud(1, low=(0, -1, -1), high=(3, 1, 1))
    whole = merge_tile([lazy(a, "a"), lazy(b, "b")], "distance")
    boxes = [np.array([[-9, -9, -9], [1.4, 9, 9]]), np.array([[1.4, -9, -9], [2.3, 9, 9]])]
    boxes.append(np.array([[2.3, -9, -9], [9, 9, 9]]))
    tiles = [merge_tile([lazy(a, "a"), lazy(b, "b")], "distance", bounds=box).gaussians for box in boxes]
    assert 0 < len(whole.gaussians) < 6000
    np.testing.assert_array_equal(rows(Gaussians.concatenate(tiles)), rows(whole.gaussians))


def test_a_tile_reads_no_more_than_its_merger_says():
    far = Cameras(np.eye(4)[None], np.array([[50.0, 50, 32, 24]]), np.array([[64, 48]]))
    far.T_frame_camera[0, :3, 3] = 50.0
    box = np.array([[1.0, 0, 0], [1.5, 1, 1]])
    asked = {method: [] for method in ("union", "voxel", "tto")}
    for method, boxes in asked.items():
        merge_tile([lazy(cloud(0), "a", boxes, far)], method, bounds=box)
    np.testing.assert_allclose(asked["union"][0], box - [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(asked["voxel"][0], box - [1, 0, 0] + [[-0.01], [0.01]], atol=1e-3)
    # Cameras however far away, and what stands between them and the tile; the whole capture for nobody here.
    assert asked["tto"][0][1].min() >= 50
    assert [len(boxes) for boxes in asked.values()] == [1, 1, 1]


def test_captures_without_a_date_are_told_where_dates_decide():
    def notes(dates, method="tto", params=None, shift=0.0):
        """Of captures that lie in one place, or each ``shift`` to the side of the one before."""
        parts = [cloud(i, n=300) for i in range(len(dates))]
        scenes = [
            LazyScene(str(i), Sim3(np.eye(3), [shift * i, 0, 0]), lambda box, part=part: part, None, date)
            for i, (part, date) in enumerate(zip(parts, dates, strict=True))
        ]
        return [note for note in merge_tile(scenes, method, params).notes if "no date" in note]

    dates = ["2026-01-01T00:00:00+00:00", "2026-01-02T00:00:00+00:00", None]
    (note,) = notes(dates)
    assert note.startswith("1 of 3 overlapping captures have no date, so their order is unknown")
    assert notes(dates[:2]) == notes([None]) == []
    assert notes(dates, shift=5.0) == []  # they do not meet
    assert notes(dates, "voxel") == notes(dates, params=replace(default_params("tto"), prefer="both")) == []
