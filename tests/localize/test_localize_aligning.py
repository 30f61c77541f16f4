"""Laying a render over a photograph: poses found from far, through blur and exposure, on surfaces that slant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from gsmap.geometry.rotations import angle_between, exp_so3
from gsmap.geometry.similarities import rotation_vectors
from gsmap.localize import covariance, direct_alignment, evidence, refinement, resection
from gsmap.localize.candidate_renders import GREY, SceneRender

SIZE = (240, 180)
LENS = np.array([200.0, 200.0, 120.0, 90.0])


def _texture(points: np.ndarray) -> np.ndarray:
    """Smooth colours (..., 3) of places on a surface, the same from everywhere."""
    rng = np.random.default_rng(3)
    out = np.full((*points.shape[:-1], 3), 0.5)
    for frequency in (1.5, 3.0, 6.0, 11.0):
        for channel in range(3):
            along = rng.normal(size=(2, 3))
            along *= frequency / np.linalg.norm(along, axis=1, keepdims=True)
            phase = rng.uniform(0, 6, 2)
            waves = np.sin(points @ along[0] + phase[0]) * np.sin(points @ along[1] + phase[1])
            out[..., channel] += 0.12 * waves
    return out


def _seen(pose: np.ndarray, lens: np.ndarray = LENS) -> tuple[np.ndarray, np.ndarray]:
    """Picture (H, W, 3) and depth (H, W) of a floor at y = 1 and a wall at z = 4, by intersecting rays with both."""
    width, height = SIZE
    column, row = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([(column - lens[2]) / lens[0], (row - lens[3]) / lens[1], np.ones_like(column)], axis=-1)
    rays = rays @ pose[:3, :3].T
    centre = pose[:3, 3]
    to_wall = (4.0 - centre[2]) / rays[..., 2]
    with np.errstate(divide="ignore"):
        to_floor = np.where(rays[..., 1] > 1e-6, (1.0 - centre[1]) / rays[..., 1], np.inf)
    depth = np.minimum(to_wall, to_floor)
    return _texture(centre + depth[..., None] * rays).astype(np.float32), depth.astype(np.float32)


def _look(pose: np.ndarray, blur: float = 0.0, lens: np.ndarray = LENS) -> SceneRender:
    rgb, depth = _seen(pose, lens)
    rgb = gaussian_filter(rgb, (blur, blur, 0)) if blur else rgb
    return SceneRender("a", rgb, rgb @ GREY, np.ones_like(depth), depth, depth > 0, pose, lens)


def _pose(turn_deg: list[float], at: list[float]) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3] = exp_so3(np.radians(turn_deg))
    out[:3, 3] = at
    return out


def _laid(photo: np.ndarray, start: np.ndarray, focal: tuple[float, float] | None = None, blur: float = 0.0):
    pose, lens, laid = start, LENS, None
    for width in direct_alignment.BLUR_PX:
        laid = direct_alignment.align(photo, _look(pose, blur, lens), pose, lens, width / 2, focal)
        pose, lens = laid.T_metric_camera, laid.intrinsics_px
    assert laid is not None
    return laid


TRUE = _pose([-14.0, 4.0, 1.0], [0.05, -0.2, 0.3])
START = _pose([-12.0, 2.0, -0.5], [-0.03, -0.15, 0.38])  # 3.2 degrees and 12 cm off


@pytest.mark.parametrize(("blur", "gain", "bar_m"), [(0.0, 1.0, 0.004), (3.0, 1.0, 0.016), (1.0, 0.6, 0.006)])
def test_a_pose_is_found_from_far_though_the_render_is_blurred_and_the_light_another(blur, gain, bar_m):
    photo = gain * _seen(TRUE)[0] + 0.2
    laid = _laid(photo, START, blur=blur)
    assert np.linalg.norm(laid.T_metric_camera[:3, 3] - TRUE[:3, 3]) < bar_m
    assert np.degrees(angle_between(laid.T_metric_camera[:3, :3], TRUE[:3, :3])) < 0.2


def test_a_third_of_the_picture_that_shows_something_else_does_not_move_it():
    photo = _seen(TRUE)[0]
    photo[:, 80:160] = np.random.default_rng(0).uniform(size=(18, 8, 3)).repeat(10, 0).repeat(10, 1)
    laid = _laid(photo, START)
    assert np.linalg.norm(laid.T_metric_camera[:3, 3] - TRUE[:3, 3]) < 0.02


def test_a_free_focal_length_is_found_with_the_pose():
    lens = LENS * [1.06, 1.06, 1, 1]
    laid = _laid(_seen(TRUE, lens)[0], _pose([-13.5, 4.5, 1.0], [0.04, -0.18, 0.3]), focal=(200.0, 0.3))
    assert laid.intrinsics_px[0] == pytest.approx(lens[0], rel=0.01)
    assert np.linalg.norm(laid.T_metric_camera[:3, 3] - TRUE[:3, 3]) < 0.03


def test_the_information_says_what_moves_a_pose_that_is_one_sigma_off():
    rng = np.random.default_rng(1)
    truth, found = [], None
    for _ in range(12):
        noise = gaussian_filter(rng.normal(size=(*SIZE[::-1], 3)), (2, 2, 0)).astype(np.float32)
        found = _laid(_seen(TRUE)[0] + 0.02 * noise / noise.std(), TRUE)
        truth.append(found.T_metric_camera[:3, 3] - TRUE[:3, 3])
    told = covariance.alignment_covariance(found, SIZE, 0.0) / covariance.ALIGNMENT_SCALE**2
    spread = np.sqrt(np.mean(np.square(truth), axis=0).sum())
    assert 0.3 < spread / np.sqrt(np.trace(told[3:6, 3:6])) < 2.0


def test_a_slanted_floor_is_smooth_and_a_step_is_an_edge():
    look = _look(TRUE)
    smooth = direct_alignment._smooth_surface(look)
    assert smooth[5:-5, 5:-5].mean() > 0.97  # all but the line where floor and wall meet
    stepped = look.depth_m.copy()
    stepped[:, :100] *= 0.7  # nearer
    smooth = direct_alignment._smooth_surface(replace(look, depth_m=stepped))
    assert not smooth[20:60, 98:102].any()
    assert smooth[20:60, 10:90].all()


def test_where_little_is_known_the_pose_stays_as_it_was():
    look = _look(START)
    bare = replace(look, alpha=np.zeros_like(look.alpha))
    laid = direct_alignment.align(_seen(TRUE)[0], bare, START, LENS, 4.0)
    assert not len(laid.pixels)
    assert np.array_equal(laid.T_metric_camera, START)
    known, unknown = direct_alignment.measure_agreements(_seen(TRUE)[0], [look, bare], 4.0)
    assert known > unknown


@pytest.mark.parametrize(("mine", "theirs", "share"), [(1.0, 1.0, 0.5), (1.0, 9.0, 0.1), (9.0, 1.0, 0.9)])
def test_two_poses_become_one_by_what_is_known_of_each(mine, theirs, share, monkeypatch):
    other = resection.retract_pose(TRUE, np.array([0.01, -0.02, 0.005, 0.03, 0.01, -0.02]))
    none = np.zeros((0, 2))
    fit = resection.LeastSquaresPose(other, LENS, none, none[:, 0], np.zeros((0, 2, 6)))
    sigmas = np.diag([0.01**2] * 3 + [0.02**2] * 3)
    monkeypatch.setattr(covariance, "DIFFERENCE_WEIGHT", 0.0)
    pose, lens, told = refinement._fuse(TRUE, LENS, mine * sigmas, fit, theirs * sigmas)
    between = TRUE[:3, 3] + share * (other[:3, 3] - TRUE[:3, 3])
    assert np.allclose(pose[:3, 3], between, atol=1e-9)
    whole = angle_between(TRUE[:3, :3], other[:3, :3])
    assert angle_between(TRUE[:3, :3], pose[:3, :3]) == pytest.approx(share * whole, rel=1e-6)
    assert np.array_equal(lens, LENS)
    # Both saw the same pictures: two that are alike know no more together than each of them alone.
    assert np.allclose(told, 2 * mine * theirs / (mine + theirs) * sigmas)
    # By how much they differ neither knows; half of it, if half of what they differ by is not known.
    xi = np.r_[rotation_vectors(TRUE[:3, :3].T @ other[:3, :3])[0], TRUE[:3, :3].T @ (other[:3, 3] - TRUE[:3, 3])]
    monkeypatch.setattr(covariance, "DIFFERENCE_WEIGHT", 0.5)
    *_, doubted = refinement._fuse(TRUE, LENS, mine * sigmas, fit, theirs * sigmas)
    assert np.allclose(doubted - told, 0.5 * np.outer(xi, xi))


def test_a_blurred_render_explains_the_coarse_picture_and_little_else():
    rng = np.random.default_rng(4)
    fine, coarse = (gaussian_filter(rng.normal(size=(360, 480, 3)), (s, s, 0)).astype(np.float32) for s in (1, 12))
    photo = (0.5 + 0.1 * fine / fine.std() + 0.1 * coarse / coarse.std()).clip(0, 1)
    shown = gaussian_filter(photo, (5, 5, 0))
    flat = np.full(shown.shape[:2], 2.0, np.float32)
    look = SceneRender("a", shown, shown @ GREY, np.ones_like(flat), flat, flat > 0, np.eye(4), LENS)
    assert evidence.compare_coarsely(photo, [look]).explained() > 0.95
    assert evidence.compare(photo, [look]).explained(0.8) < 0.5
    other = np.ascontiguousarray(shown[::-1, ::-1])
    elsewhere = replace(look, rgb=other, grey=other @ GREY)
    assert evidence.compare_coarsely(photo, [elsewhere]).explained() < 0.4
