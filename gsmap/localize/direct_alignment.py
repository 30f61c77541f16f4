"""Estimate a camera pose by direct alignment of a render with a photo (photometric, Gauss-Newton)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap._native import laid as native_normal_equations
from gsmap.geometry.filters import blur, box_means, gradients
from gsmap.localize import resection
from gsmap.localize.candidate_renders import SceneRender

BLUR_PX = (8.0, 4.0, 2.0)
"""Standard deviation of the blur in each round, in pixels of a photo of 480 pixels."""

MAX_POINTS = 3000
"""Number of pixels of a render that are aligned: those with most contrast relative to their neighbourhood."""

_BAND = 4.0  # content broader than this many blurs is removed, because light and exposure change it
_WINDOW_BLURS = 12.0  # width of a neighbourhood, per blur
_WEIGHT_POWER = 2.0  # a pixel's weight is the correlation of its neighbourhood to this power
_MIN_CORRELATION = 0.03  # lower correlations are raised to this value
_MAX_GAIN = 2.5  # largest ratio of the contrasts of photo and render, or its inverse
_ROBUST_SIGMAS = 2.0  # scale of Cauchy's loss, in standard deviations of the residuals
_ITERATIONS = 10
_MAX_BEND = 0.03  # with a larger relative curvature of the inverse depth a pixel is at an edge ...
_BEND_REACH_PX = 2  # ... measured over this many pixels to either side
_MIN_ALPHA = 0.9
_MIN_POINTS = 200


@dataclass(frozen=True, eq=False)
class DirectAlignment:
    """A pose estimated by direct alignment.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) intrinsics at the aligned size.
        pixels: (K, 2) aligned points in the photo; empty if there were too few, and then the pose is the initial pose.
        residuals: (K, 3) residuals of the colours of the points.
        weights: (K, 3) weights of the residuals.
        jacobian: (K, 3, 6 or 7) derivatives of the colours with respect to the pose, as in
            `gsmap.localize.resection.LeastSquaresPose`.
        agreement: mean weight of the points at the initial pose; NaN without points.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    pixels: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray
    agreement: float = np.nan


def measure_agreements(
    rgb: np.ndarray, renders: Sequence[SceneRender], blur_px: float, mask: np.ndarray | None = None
) -> np.ndarray:
    """Return the (L,) agreement of each render with a photo: the sum of the weights of its pixels."""
    photo = _band_pass(rgb, mask, blur_px)
    return np.array([_select_pixels(photo, one, blur_px, mask)[3].sum() for one in renders])


def align(
    rgb: np.ndarray,
    one: SceneRender,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    blur_px: float,
    focal: tuple[float, float] | None = None,
    mask: np.ndarray | None = None,
) -> DirectAlignment:
    """Minimize robust differences between the band-passed photo and the band-passed render over the pose.

    The gradient is the mean of the photo's and the render's gradients (efficient second-order minimization, Malis
    2004), which about doubles the basin of convergence. One gain for the whole render compensates for lost contrast.

    Args:
        rgb: (H, W, 3) float32 in [0, 1].
        one: a render of this size, of one scene, from near the initial pose. With two scenes that disagree by a
            centimetre, the pose would lie between both.
        T_metric_camera: initial pose.
        intrinsics_px: (4,) intrinsics at this size.
        blur_px: standard deviation of the blur of this round, at this size.
        focal: expected focal length and ``focal_sigma``; None if the focal length is not estimated.
        mask: (H, W) mask of valid pixels of the photo; None if all are valid.
    """
    empty = np.zeros((0, 3))
    unaligned = DirectAlignment(T_metric_camera, intrinsics_px, empty[:, :2], empty, empty, np.zeros((0, 3, 6)))
    photo = _band_pass(rgb, mask, blur_px)
    pixels, colours, slope, weight = _select_pixels(photo, one, blur_px, mask)
    if len(pixels) < _MIN_POINTS:
        return unaligned
    problem = _PhotometricProblem(
        np.concatenate([photo, gradients(photo).reshape(*photo.shape[:2], 6)], axis=2),
        one.corrected_points(pixels),
        colours,
        slope,
        weight,
        focal,
    )
    state = problem.project(T_metric_camera, intrinsics_px)
    gain = _clip_gain(_estimate_gain(state.sampled, colours, state.weight[:, None]))
    left = np.abs(state.sampled[:, :3] - gain * colours)[state.weight > 0]
    if len(left) < _MIN_POINTS:
        return unaligned
    scale = _ROBUST_SIGMAS * max(1.4826 * float(np.median(left)), 1e-3)
    pose, lens, gain = _minimize(problem, T_metric_camera, intrinsics_px, gain, scale)
    state = problem.project(pose, lens)
    # Use gradients of the render alone: gradients of the photo's noise would count as information.
    without = replace(state, sampled=np.concatenate([state.sampled[:, :3], gain * slope.reshape(-1, 6)], axis=1))
    residuals, weights, J = _linearize(without, colours, slope, gain, scale)
    return DirectAlignment(pose, lens, state.pixels, residuals, weights, J, float(weight.mean()))


def _minimize(
    problem: _PhotometricProblem, pose: np.ndarray, lens: np.ndarray, gain: float, scale: float
) -> tuple[np.ndarray, np.ndarray, float]:
    """Return pose, lens and gain at the minimum, found by Levenberg-Marquardt."""
    damping = 1e-4
    for _ in range(_ITERATIONS):
        now = problem.normal_equations(pose, lens, gain, scale)
        while damping <= 10.0:
            diagonal = damping * np.diag(np.diag(now.information)) + 1e-9 * np.eye(len(now.right))
            step = np.linalg.solve(now.information + diagonal, now.right)
            next_lens = lens.copy()
            if len(step) == 7:
                next_lens[:2] *= np.exp(np.clip(step[6], -0.1, 0.1))
            next_pose = resection.retract_pose(pose, step[:6])
            after = problem.normal_equations(next_pose, next_lens, gain, scale)
            if after.cost < now.cost:
                break
            damping = max(10 * damping, 1e-3)
        else:
            break
        pose, lens, damping = next_pose, next_lens, max(damping / 10, 1e-6)
        gain = _clip_gain(after.gain)
        if np.abs(step[:3]).max() < 2e-5 and np.abs(step[3:6]).max() < 5e-5:
            break
    return pose, lens, gain


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """The problem linearized at a pose.

    Args:
        cost: mean of Cauchy's loss over the points inside the photo.
        gain: factor that would match the render's band to the photo's band.
        information: (dim, dim) left-hand side.
        right: (dim,) right-hand side.
    """

    cost: float
    gain: float
    information: np.ndarray
    right: np.ndarray


@dataclass(frozen=True, eq=False)
class _PhotometricProblem:
    """Points of a render, and the photo with which they are aligned.

    Args:
        planes: (H, W, 9) float32 band of the photo: colours, gradients along rows, gradients along columns.
        points: (K, 3) positions in the component's frame, in metres.
        colours: (K, 3) float32 colours of the render's band.
        slope: (K, 2, 3) float32 gradients of the colours along rows and along columns.
        weight: (K,) float64 weights.
        focal: as in `align`.
    """

    planes: np.ndarray
    points: np.ndarray
    colours: np.ndarray
    slope: np.ndarray
    weight: np.ndarray
    focal: tuple[float, float] | None

    def normal_equations(self, pose: np.ndarray, lens: np.ndarray, gain: float, scale: float) -> _NormalEquations:
        """Linearize the problem at a pose, including the prior of the focal length."""
        arrays = (self.planes, self.points, self.colours, self.slope, self.weight)
        dim = 6 if self.focal is None else 7
        cost, within, both, own, A, b = native_normal_equations(*arrays, pose, lens, gain, scale, dim)
        if self.focal is not None and np.isfinite(self.focal[1]):
            far = np.log(self.focal[0] / lens[0])
            A[6, 6] += scale**2 / self.focal[1] ** 2
            b[6] += scale**2 * far / self.focal[1] ** 2
            cost += (far / self.focal[1]) ** 2
        return _NormalEquations(cost / max(within, 1e-9), both / max(own, 1e-9), A, b)

    def project(self, pose: np.ndarray, lens: np.ndarray) -> _ProjectedPoints:
        """Project all points into the photo and sample the photo there."""
        dim = 6 if self.focal is None else 7
        minus, jacobian = resection.linearize(np.zeros((len(self.points), 2)), self.points, pose, lens, dim)
        pixels, size = -minus, np.array(self.planes.shape[1::-1])
        inside = (jacobian != 0).any((1, 2)) & (pixels > 1).all(1) & (pixels < size - 1).all(1)
        return _ProjectedPoints(pixels, _sample(self.planes, pixels), self.weight * inside, jacobian)


@dataclass(frozen=True, eq=False)
class _ProjectedPoints:
    """Points projected from one pose.

    Args:
        pixels: (K, 2) positions in the photo.
        sampled: (K, 9) samples of the photo's band: colours, gradients along rows, gradients along columns.
        weight: (K,) weights, 0 outside the photo.
        jacobian: (K, 2, dim) derivatives of the pixels.
    """

    pixels: np.ndarray
    sampled: np.ndarray
    weight: np.ndarray
    jacobian: np.ndarray


def _linearize(
    state: _ProjectedPoints, colours: np.ndarray, slope: np.ndarray, gain: float, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the residuals of colours (K, 3), their weights (K, 3) and their derivatives (K, 3, dim)."""
    residuals = state.sampled[:, :3] - gain * colours
    weights = state.weight[:, None] / (1 + (residuals / scale) ** 2)
    down = (state.sampled[:, 3:6] + gain * slope[:, 0]) / 2
    right = (state.sampled[:, 6:9] + gain * slope[:, 1]) / 2
    jacobian = right[..., None] * state.jacobian[:, None, 0] + down[..., None] * state.jacobian[:, None, 1]
    return residuals, weights, jacobian


def _select_pixels(
    photo: np.ndarray, one: SceneRender, blur_px: float, mask: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Select pixels of a render to align: positions (K, 2), colours (K, 3), gradients (K, 2, 3), weights (K,)."""
    band = _band_pass(one.rgb, one.alpha > _MIN_ALPHA, blur_px)
    slope = gradients(band)
    contrast = np.sqrt(np.einsum("hwdc,hwdc->hw", slope, slope))
    width = 2 * round(_WINDOW_BLURS * blur_px / 2) + 1
    relative = contrast / (box_means(contrast, width) + 1e-4)
    relative[~_smooth_surface(one)] = 0
    if mask is not None:
        relative[~mask] = 0
    count = min(MAX_POINTS, int((relative > 0).sum()))
    rows = np.sort(np.argpartition(-relative.ravel(), max(count - 1, 0))[:count])
    row, column = np.divmod(rows, relative.shape[1])
    masked = band
    if mask is not None:  # masked pixels must not lower the correlation of their neighbours
        photo, masked = (image * mask[..., None] for image in (photo, band))
    products = [np.einsum("hwc,hwc->hw", a, b) for a, b in ((photo, masked), (photo, photo), (masked, masked))]
    both, square_photo, square_render = box_means(np.stack(products, axis=2), width)[row, column].T
    correlation = both / np.sqrt(np.maximum(square_photo * square_render, 1e-12))
    weight = np.clip(correlation.astype(np.float64), _MIN_CORRELATION, 1.0) ** _WEIGHT_POWER
    return np.stack([column + 0.5, row + 0.5], axis=1), band[row, column], slope[row, column], weight


def _smooth_surface(one: SceneRender) -> np.ndarray:
    """Return an (H, W) mask of pixels that are opaque and away from edges; the inverse depth of a plane is linear in
    the pixels."""
    reach, (height, width) = _BEND_REACH_PX, one.alpha.shape
    solid = (one.alpha > _MIN_ALPHA) & (one.depth_m > 0)
    inverse = np.where(solid, 1 / np.maximum(one.depth_m, 1e-3), 0)
    around = np.pad(inverse, reach)
    out = solid.copy()
    for down, right in ((0, reach), (reach, 0), (reach, reach), (reach, -reach)):
        one_side, other = (around[reach + s * down :, reach + s * right :][:height, :width] for s in (1, -1))
        out &= (one_side > 0) & (other > 0) & (np.abs(one_side + other - 2 * inverse) <= _MAX_BEND * inverse)
    return out


def _band_pass(rgb: np.ndarray, mask: np.ndarray | None, blur_px: float) -> np.ndarray:
    """Return (H, W, 3) without content finer than ``blur_px`` or broader than `_BAND` times ``blur_px``, computed from
    valid pixels alone."""
    fine, broad = (_blur_valid(rgb, mask, sigma) for sigma in (blur_px, _BAND * blur_px))
    return fine - broad


def _blur_valid(rgb: np.ndarray, mask: np.ndarray | None, sigma: float) -> np.ndarray:
    if mask is None:
        return blur(rgb, sigma, 3.0, reflect=False)
    share = mask.astype(np.float32)[..., None]
    both = blur(np.concatenate([rgb * share, share], axis=2), sigma, 3.0, reflect=False)
    out: np.ndarray = both[..., :3] / np.maximum(both[..., 3:], 1e-3)
    return out


def _sample(planes: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Return (K, C) bilinear samples; pixels outside the image get the value at its edge."""
    height, width = planes.shape[:2]
    x = np.clip(pixels[:, 0] - 0.5, 0, width - 1.001)
    y = np.clip(pixels[:, 1] - 0.5, 0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    a, b = (x - column)[:, None].astype(np.float32), (y - row)[:, None].astype(np.float32)
    upper = planes[row, column] * (1 - a) + planes[row, column + 1] * a
    lower = planes[row + 1, column] * (1 - a) + planes[row + 1, column + 1] * a
    out: np.ndarray = upper * (1 - b) + lower * b
    return out


def _estimate_gain(sampled: np.ndarray, colours: np.ndarray, weights: np.ndarray) -> float:
    """Return the factor that matches the contrast of the render's band to that of the photo's band."""
    return float((weights * sampled[:, :3] * colours).sum() / max(float((weights * colours**2).sum()), 1e-9))


def _clip_gain(gain: float) -> float:
    return float(np.clip(gain, 1 / _MAX_GAIN, _MAX_GAIN))
