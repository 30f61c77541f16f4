"""What a render of overlapping Gaussians shows, and where that lies: against sums of single Gaussians in float64."""

from __future__ import annotations

import numpy as np
import pytest

from gsmap.geometry.projection import project
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import MapScene, displacement
from gsmap.localize.candidate_renders import render_scenes
from gsmap.localize.localization import scale_photo
from gsmap.localize.refinement import refine_pose
from gsmap.types import Gaussians, Sim3

LENS, SIZE = np.array([240.0, 240, 120, 90]), (240, 180)
PLAIN = {"FRACTION": 1.0, "MAX_PX": 50.0, "WINDOW_PX": 1.0, "GRID_SIDE": 240}  # each pixel alone, no limit


def _displacement(scene, lens=LENS, size=SIZE, **constants) -> np.ndarray:
    """The displacement map with other constants, those of `PLAIN` by default."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (PLAIN | constants).items():
            patch.setattr(displacement, name, value)
        return displacement.displacement_map(scene.render(scene.camera(np.eye(4), lens, size), with_centres=True))


def _plane(slant_rad: float, S: Sim3) -> MapScene:
    """A plane of overlapping balls before the camera, nearer at its top the more it slants, in a frame of its own."""
    u, v = np.random.default_rng(0).uniform(-3, 3, (2, 14_000))
    turn = exp_so3(np.array([slant_rad, 0, 0]))
    at = np.stack([u, v, np.zeros_like(u)], axis=1) @ turn.T + np.array([0, 0, 3.0])
    means = S.inverse().apply(at).astype(np.float32)
    n = len(means)
    quats = np.tile(np.float32([1, 0, 0, 0]), (n, 1))
    size = np.full((n, 3), np.log(0.05 / S.scale), np.float32)
    opacity = np.full(n, 1.5, np.float32)
    gaussians = Gaussians(means, quats, size, opacity, np.zeros((n, 1, 3), np.float32))
    return MapScene("plane", S, 0, None, lambda: gaussians, lambda: None)


@pytest.fixture(scope="module")
def frame() -> Sim3:
    return Sim3(exp_so3(np.array([0.3, -1.0, 0.5])), np.array([4.0, -2.0, 1.0]), 2.5)


def _mean_of_middles(scene: MapScene, pixel: np.ndarray) -> np.ndarray:
    """(2,) mean of where the middles of the Gaussians lie that a pixel shows, one after the other, front to back."""
    at = scene.S_metric_scene.apply(scene.gaussians.means.astype(np.float64))
    middles, z = project(at, np.eye(4), LENS)
    sigma = float(np.exp(scene.gaussians.log_scales[0, 0])) * scene.S_metric_scene.scale
    total, weight, through = np.zeros(2), 0.0, 1.0
    for k in np.argsort(z):
        x, y, depth = at[k]
        J = np.array([[LENS[0] / depth, 0, -LENS[0] * x / depth**2], [0, LENS[1] / depth, -LENS[1] * y / depth**2]])
        cov = sigma**2 * J @ J.T + 0.3 * np.eye(2)
        away = pixel - middles[k]
        alpha = min(0.99, float(np.exp(-0.5 * away @ np.linalg.solve(cov, away)) / (1 + np.exp(-1.5))))
        if alpha < 1 / 255:
            continue
        if through * (1 - alpha) <= 1e-4:
            break
        total, weight, through = total + through * alpha * middles[k], weight + through * alpha, through * (1 - alpha)
    return total / weight


@pytest.mark.parametrize("slant_rad", [0.02, 0.9, -0.7])
def test_it_is_how_far_the_middles_are_of_what_a_pixel_shows(frame, slant_rad):
    scene = _plane(slant_rad, frame)
    found = _displacement(scene)
    for column, row in ((120, 90), (60, 40), (200, 130), (150, 20)):
        pixel = np.array([column, row]) + 0.5
        assert found[row, column] == pytest.approx(_mean_of_middles(scene, pixel) - pixel, abs=0.02)


def test_what_is_shown_belongs_on_the_nearer_side(frame):
    """Nearer is lower on a floor: what is shown there lies further down; of a wall head on, nowhere else."""
    wall, floor = (_displacement(_plane(slant, frame)) for slant in (0.0, -0.9))
    assert np.abs(wall[60:120, 80:160].mean((0, 1))).max() < 0.3
    assert floor[60:120, 80:160, 1].mean() > 3
    assert abs(floor[60:120, 80:160, 0].mean()) < 0.3


def test_it_is_a_share_is_cut_off_and_is_kept_on_a_grid(frame):
    scene = _plane(0.9, frame)
    whole = _displacement(scene, WINDOW_PX=61.0)
    half = _displacement(scene, WINDOW_PX=61.0, FRACTION=0.5)
    small = _displacement(scene, WINDOW_PX=61.0, GRID_SIDE=60)
    least = _displacement(scene, MAX_PX=0.4)
    assert np.allclose(half, whole / 2, atol=1e-6)
    assert np.abs(least).max() == pytest.approx(0.4 * SIZE[0] / 480, rel=1e-5)
    assert small.shape == (45, 60, 2)
    assert np.array_equal(small, whole[2::4, 2::4])


def test_a_portrait_is_asked_as_a_landscape_is(frame) -> None:
    """What is told for 480 pixels is so of the longer side."""
    scene, small = _plane(0.9, frame), {"MAX_PX": displacement.MAX_PX, "GRID_SIDE": 120}
    wide = _displacement(scene, **small)
    tall = _displacement(scene, LENS[[1, 0, 3, 2]], SIZE[::-1], **small)
    assert wide.shape == (90, 120, 2)
    assert tall.shape == (120, 90, 2)
    assert np.abs(tall).max() == np.abs(wide).max() == pytest.approx(2.0 * SIZE[0] / 480)


def test_a_look_says_where_what_it_shows_lies(frame):
    scene = _plane(0.9, frame)
    plain, displaced = (
        render_scenes([scene], np.eye(4), LENS, SIZE, with_displacement=asked)[0] for asked in (False, True)
    )
    pixels = np.array([[60.5, 40.5], [120.5, 90.5], [200.5, 150.5]])
    assert np.array_equal(plain.corrected_points(pixels), plain.points(pixels))
    assert np.array_equal(displaced.points(pixels), plain.points(pixels))
    way = displaced.displaced_px(pixels)
    assert np.abs(way).max() > 0.05
    at, _ = project(displaced.corrected_points(pixels), np.eye(4), LENS)
    assert np.allclose(at, pixels + way, atol=1e-6)
    assert plain.displacement is None


def test_poses_lie_further_back_by_it(world, monkeypatch):
    """Five times the fitted fraction, since a pose of one photo is only repeatable to a thousandth of its depth."""
    shares = []
    for row in range(len(world.photos)):
        photo, _ = scale_photo(world.photos[row], 480)
        found = []
        for fraction in (0.0, 0.8):
            monkeypatch.setattr(displacement, "FRACTION", fraction)
            found.append(refine_pose(photo, world.poses[row], photo.intrinsics_px, [world.placed]))
        without, displaced = found
        back = (np.linalg.inv(without.T_metric_camera) @ displaced.T_metric_camera)[2, 3]
        shares.append(back / np.median(without.renders[0].depth_m[without.renders[0].alpha > 0.9]))
    assert -0.02 < np.mean(shares) < -0.002
