"""Cleaning removes what was planted, and keeps the surfaces."""

import numpy as np
import pytest
from raising import raises

import gsmap.map
from gsmap import formats
from gsmap.errors import ConfigError, InputError
from gsmap.geometry.sh import sh0_of_rgb
from gsmap.ingest.clean import clean
from gsmap.types import Gaussians
from gsmap_synthetic.perturb import strewn

SIZE = np.array([5.0, 4.0, 2.5])


def gaussians_at(points: np.ndarray, sigmas: np.ndarray, colours: np.ndarray, opacity: float = 0.9) -> Gaussians:
    n = len(points)
    logits = np.full(n, np.log(opacity / (1 - opacity)))
    return Gaussians(points, np.tile([1.0, 0, 0, 0], (n, 1)), np.log(sigmas), logits, sh0_of_rgb(colours)[:, None])


def box_surface(low: np.ndarray, high: np.ndarray, colour: np.ndarray, rng: np.random.Generator) -> Gaussians:
    """The six faces of a box as flat, overlapping Gaussians 6 cm apart."""
    parts = []
    for axis in range(3):
        u, v = (k for k in range(3) if k != axis)
        grid = np.stack(np.meshgrid(*(np.arange(low[k] + 0.02, high[k], 0.06) for k in (u, v))), -1).reshape(-1, 2)
        for side in (low, high):
            points = np.empty((len(grid), 3))
            points[:, [u, v]], points[:, axis] = grid + rng.normal(0, 0.008, grid.shape), side[axis]
            sigmas = np.full((len(grid), 3), 0.045)
            sigmas[:, axis] = 0.006
            parts.append(gaussians_at(points, sigmas, np.clip(colour + rng.normal(0, 0.05, (len(grid), 3)), 0, 1)))
    return Gaussians.concatenate(parts)


@pytest.fixture(scope="module")
def room() -> Gaussians:
    """A room with a table on thin legs."""
    rng = np.random.default_rng(0)
    boxes = [(np.zeros(3), SIZE, 0.7), (np.array([2, 1, 0.7]), np.array([3.2, 1.8, 0.75]), 0.3)]
    boxes += [(np.array([x, y, 0]), np.array([x + 0.05, y + 0.05, 0.7]), 0.3) for x in (2, 3.1) for y in (1, 1.7)]
    return Gaussians.concatenate([box_surface(low, high, np.full(3, grey), rng) for low, high, grey in boxes])


def off_surfaces(room: Gaussians, points: np.ndarray) -> np.ndarray:
    from scipy.spatial import cKDTree

    return cKDTree(room.means).query(points)[0] > 0.05


def test_planted_floaters_go_and_the_surface_stays(room):
    rng = np.random.default_rng(1)
    n = len(room)
    small = strewn(room, rng, 0.02, size_m=0.03, opacity=0.8)[n:]
    haze = strewn(room, rng, 0.01, size_m=0.2, opacity=0.1)[n:]
    out = rng.normal(size=(n // 20, 3))
    sky = gaussians_at(
        SIZE / 2 + 60 * out / np.linalg.norm(out, axis=1, keepdims=True),
        np.full(out.shape, 2.0),
        np.full(out.shape, 0.8),
    )
    whole = Gaussians.concatenate([room, small, haze, sky])
    free = np.r_[np.zeros(n, bool), off_surfaces(room, whole.means[n:])]
    cleaned = clean(whole)
    kept = np.isin(whole.means.view("V12").ravel(), cleaned.gaussians.means.view("V12").ravel())
    assert (~kept[free]).mean() >= 0.95
    assert (~kept[:n]).mean() <= 0.001
    assert cleaned.removed["background"] == len(sky)
    assert sum(cleaned.removed.values()) == (~kept).sum()
    assert "of the background" in cleaned.note


def test_a_clean_capture_stays_as_it_is(room):
    cleaned = clean(room)
    assert (any(cleaned.removed.values()), cleaned.is_judged) == (False, True)
    for factor in (0.01, 1000.0):  # in another unit
        scaled = Gaussians(
            room.means * factor, room.quats, room.log_scales + np.log(factor), room.logit_opacities, room.sh
        )
        assert not any(clean(scaled).removed.values())


def test_a_cluster_in_free_air_goes_and_a_dense_shell_too(room):
    rng = np.random.default_rng(2)
    cluster = gaussians_at(rng.normal([1, 3, 1.5], 0.05, (40, 3)), np.full((40, 3), 0.03), np.full((40, 3), 0.5))
    out = rng.normal(size=(20_000, 3))
    shell = gaussians_at(
        SIZE / 2 + 14 * out / np.linalg.norm(out, axis=1, keepdims=True),
        np.full(out.shape, 0.2),
        np.full(out.shape, 0.8),
    )
    cleaned = clean(Gaussians.concatenate([room, cluster, shell]))
    assert (cleaned.removed["floaters"], cleaned.removed["background"]) == (40, 20_000)


def test_invalid_rows_scales_and_the_box_are_counted_apart(room):
    bad = room[np.arange(6)]
    means, quats, scales = bad.means.copy(), bad.quats.copy(), bad.log_scales.copy()
    means[0, 1], quats[1], scales[2, 0], scales[3:5, 1] = np.nan, 0, np.inf, 40
    bad = Gaussians(means, quats, scales, bad.logit_opacities, bad.sh)
    cleaned = clean(Gaussians.concatenate([room, bad]), [-1, -1, -1, 6, 5, 1.2])
    above = int((room.means[:, 2] >= 1.2).sum())
    assert [cleaned.removed[kind] for kind in ("invalid", "oversized", "outside")] == [3, 2, above]
    assert cleaned.gaussians.means[:, 2].max() < 1.2


def test_what_cannot_be_judged_is_left_and_said():
    rng = np.random.default_rng(0)
    apart = gaussians_at(rng.uniform(0, 9, (2000, 3)), np.full((2000, 3), 0.01), rng.uniform(size=(2000, 3)))
    cleaned = clean(apart)
    assert (any(cleaned.removed.values()), cleaned.is_judged) == (False, False)
    assert "not looked for" in cleaned.note
    with raises(ConfigError, code="invalid_box"):
        clean(apart, [0, 0, 0, 1, 0, 1])
    with raises(InputError, code="no_gaussians"):
        clean(apart, [20, 20, 20, 21, 21, 21])


def with_one_floater(room: Gaussians) -> Gaussians:
    stray = gaussians_at(np.array([[1.0, 3, 1.5]]), np.full((1, 3), 0.02), np.full((1, 3), 0.5))
    return Gaussians.concatenate([room, stray])


def test_ingest_refuses_what_it_cleans_on_request(room, tmp_path):
    bad = Gaussians(np.full((1, 3), np.nan), room.quats[:1], room.log_scales[:1], room.logit_opacities[:1], room.sh[:1])
    formats.write(tmp_path / "room.ply", Gaussians.concatenate([with_one_floater(room), bad]))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        with raises(InputError, code="invalid_gaussians", match="gsmap clean"):
            m.ingest(tmp_path / "room.ply")
        (row,) = m.ingest(tmp_path / "room.ply", clean=True)
        assert m["room"].num_gaussians == len(room)
        assert any("1 with invalid values, 1 floaters" in note for note in row.notes)


def test_ingest_keeps_a_region(room, tmp_path):
    formats.write(tmp_path / "room.ply", room)
    half = [-1.0, -1, -1, 2.5, 9, 9]
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        with raises(ConfigError, code="option_not_applicable", match="clean"):
            m.ingest(tmp_path / "room.ply", bbox=half)
        with raises(ConfigError, code="option_not_applicable"):
            m.update(clean=True)
        m.ingest(tmp_path / "room.ply", clean=True, bbox=half)
        assert m["room"].num_gaussians == (room.means[:, 0] <= 2.5).sum()


@pytest.mark.slow
def test_superseding_by_the_same_file_undoes_cleaning(room, tmp_path):
    formats.write(tmp_path / "room.ply", with_one_floater(room))
    with gsmap.map.create(tmp_path / "site.gsmap") as m:
        m.ingest(tmp_path / "room.ply", clean=True)
        m.ingest(tmp_path / "room.ply", supersedes="room")
        assert m["room"].num_gaussians == len(room) + 1
        m.ingest(tmp_path / "room.ply", supersedes="room", clean=True)
        assert m["room"].num_gaussians == len(room)
