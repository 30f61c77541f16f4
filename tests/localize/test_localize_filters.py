"""Moving windows beside scipy's, and one step of laying a render over a photograph beside plain sums in float64."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from gsmap.geometry import filters
from gsmap.geometry.rotations import exp_so3
from gsmap.localize import direct_alignment, resection


@pytest.mark.parametrize("shape", [(37, 53), (9, 70, 3), (1, 5), (40, 2, 2)])
def test_windows_are_as_scipy_has_them(shape, instruction_set):
    image = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    plane = (1, 1, 0)[: len(shape)]
    for mode in ("reflect", "nearest"):
        reflect = mode == "reflect"
        want = ndimage.gaussian_filter(image.astype(float), np.array(plane) * 2.5, mode=mode, truncate=3.0)
        assert np.allclose(filters.blur(image, 2.5, 3.0, reflect=reflect), want, atol=2e-6)
        size = [7 if along else 1 for along in plane]
        want = ndimage.uniform_filter(image.astype(float), size, mode=mode)
        assert np.allclose(filters.box_means(image, 7, reflect=reflect), want, atol=2e-6)
    for side in (6, 7):
        size = [side if along else 1 for along in plane]
        assert np.array_equal(filters.maximum(image, side), ndimage.maximum_filter(image, size))
    assert np.array_equal(filters.minimum(image, 7), ndimage.minimum_filter(image, [7 if p else 1 for p in plane]))


def test_windows_around_some_pixels_are_those_of_all():
    image = np.random.default_rng(1).random((37, 53, 2)).astype(np.float32)
    some = filters.box_means(image, 7, first=3, step=8)
    assert some.shape == (5, 7, 2)
    assert np.array_equal(some, filters.box_means(image, 7)[3::8, 3::8])


def test_slopes_are_central_differences():
    image = np.random.default_rng(1).random((7, 9, 3)).astype(np.float32)
    assert np.allclose(filters.gradients(image), np.stack(np.gradient(image, axis=(0, 1)), axis=2), atol=1e-6)


@pytest.mark.parametrize("focal", [None, (180.0, 0.2)])
def test_a_step_is_the_sum_over_its_points(focal):
    rng = np.random.default_rng(2)
    planes = ndimage.gaussian_filter(rng.normal(size=(60, 80, 9)), (2, 2, 0)).astype(np.float32)
    lens, pose = np.array([90.0, 95.0, 40.0, 30.0]), np.eye(4)
    pose[:3, :3], pose[:3, 3] = exp_so3(rng.normal(size=3)), rng.normal(size=3)
    local = rng.uniform([-1.5, -1.2, -1.0], [1.5, 1.2, 4.0], (400, 3))  # some behind the camera, some outside
    points = local @ pose[:3, :3].T + pose[:3, 3]
    shown, slope = rng.normal(size=(400, 3)).astype(np.float32), rng.normal(size=(400, 2, 3)).astype(np.float32)
    laid = direct_alignment._PhotometricProblem(planes, points, 0.2 * shown, 0.2 * slope, rng.uniform(size=400), focal)
    state, gain, scale = laid.project(pose, lens), 1.3, 0.3
    assert 50 < (state.weight > 0).sum() < 350
    differ, weights, J = direct_alignment._linearize(state, laid.colours, laid.slope, gain, scale)
    told = laid.normal_equations(pose, lens, gain, scale)
    information, right = np.einsum("kcd,kc,kce->de", J, weights, J), -np.einsum("kcd,kc,kc->d", J, weights, differ)
    loss = (state.weight[:, None] * np.log1p((differ / scale) ** 2)).sum()
    if focal is not None:
        far = np.log(focal[0] / lens[0])
        information[6, 6] += scale**2 / focal[1] ** 2
        right[6] += scale**2 * far / focal[1] ** 2
        loss += (far / focal[1]) ** 2
    assert np.allclose(told.information, information, rtol=1e-4, atol=1e-4 * np.abs(information).max())
    assert np.allclose(told.right, right, rtol=1e-4, atol=1e-4 * np.abs(right).max())
    assert told.cost == pytest.approx(loss / state.weight.sum(), rel=1e-5)
    assert told.gain == pytest.approx(direct_alignment._estimate_gain(state.sampled, laid.colours, weights), rel=1e-4)


def test_a_step_leads_to_the_pose_that_costs_less():
    rng = np.random.default_rng(3)
    photo = ndimage.gaussian_filter(rng.normal(size=(60, 80, 3)), (4, 4, 0)).astype(np.float32)
    planes = np.concatenate([photo, *np.gradient(photo, axis=(0, 1))], axis=2)
    lens, pose = np.array([90.0, 90.0, 40.0, 30.0]), np.eye(4)
    pixels = rng.uniform(10, 50, (300, 2))
    z = rng.uniform(1, 3, 300)
    points = np.stack([(pixels[:, 0] - 40) / 90 * z, (pixels[:, 1] - 30) / 90 * z, z], axis=1)
    there = direct_alignment._sample(planes, pixels)
    laid = direct_alignment._PhotometricProblem(
        planes, points, there[:, :3], there[:, 3:].reshape(-1, 2, 3), np.ones(300), None
    )
    off = resection.retract_pose(pose, np.array([0.004, -0.006, 0.003, 0.01, 0.008, -0.01]))
    found, _, _ = direct_alignment._minimize(laid, off, lens, 1.0, 0.1)
    assert np.abs(found - pose).max() < 1e-4
    assert laid.normal_equations(found, lens, 1.0, 0.1).cost < 0.01 * laid.normal_equations(off, lens, 1.0, 0.1).cost
