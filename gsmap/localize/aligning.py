"""A camera's pose by laying a render over a photograph: all that varies in it counts, whether or not it is a corner."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap._native import laid as native_laid
from gsmap.localize import resection
from gsmap.localize.filters import blurred, means, slopes
from gsmap.localize.looks import Look


@dataclass(frozen=True)
class Params:
    """How a render is laid over a photograph.

    Args:
        blur_px: of each round, at a picture of 480 pixels: both pictures lose what is finer (standard deviation of a
            Gaussian), and what is broader by ``band`` and more, which light and exposure change.
        band: see there.
        max_points: pixels of one render, those with most contrast for their surroundings.
        around_px: how far those reach, in multiples of the blur.
        trust: pixels count by so high a power of how well their surroundings agree: what a splat shows blurred or
            wrongly counts for little.
        least_trust: that correlation, where they do not agree at all.
        max_gain: a render may have so many times the photo's contrast, or the photo the render's, and no more.
        doubt: residuals count less from about here on, in standard deviations (from their median) of all of them.
        iterations: of each round.
        max_bend: where the inverse of the depth bends by a larger share, the surface has an edge.
        reach_px: over which it may bend, to either side.
        min_alpha: where the render is fainter, nothing is known of the surface.
        min_points: with fewer the pose stays as it was.
    """

    blur_px: tuple[float, ...] = (8.0, 4.0, 2.0)
    band: float = 4.0
    max_points: int = 3000
    around_px: float = 12.0
    trust: float = 2.0
    least_trust: float = 0.03
    max_gain: float = 2.5
    doubt: float = 2.0
    iterations: int = 10
    max_bend: float = 0.03
    reach_px: int = 2
    min_alpha: float = 0.9
    min_points: int = 200


@dataclass(frozen=True, eq=False)
class Aligned:
    """A pose by direct alignment.

    Args:
        T_metric_camera: (4, 4) camera-to-component, metres.
        intrinsics_px: (4,) of the size of the picture that was given.
        pixels: (K, 2) where the points that were laid over it lie in the photo, of that size; none where there were too
            few, and the pose is the one that was given.
        residuals: (K, 3) of their colours.
        weights: (K, 3) of those.
        jacobian: (K, 3, 6 or 7) of the colours by the pose, as in `gsmap.localize.resection.Refined`.
        agreement: mean of what the points were trusted before the pose was moved; NaN of none.
    """

    T_metric_camera: np.ndarray
    intrinsics_px: np.ndarray
    pixels: np.ndarray
    residuals: np.ndarray
    weights: np.ndarray
    jacobian: np.ndarray
    agreement: float = np.nan


def agreements(
    rgb: np.ndarray, looks: Sequence[Look], blur_px: float, params: Params, known: np.ndarray | None = None
) -> np.ndarray:
    """(L,) how many pixels of each render look like a photo's where they lie: the sum of what each is trusted."""
    photo = _band(rgb, known, blur_px, params.band)
    return np.array([_pixels(photo, one, blur_px, params, known)[3].sum() for one in looks])


def align(
    rgb: np.ndarray,
    one: Look,
    T_metric_camera: np.ndarray,
    intrinsics_px: np.ndarray,
    blur_px: float,
    params: Params,
    focal: tuple[float, float] | None = None,
    known: np.ndarray | None = None,
) -> Aligned:
    """Minimise robust differences of a photo's and a render's band of detail over the pose (Gauss-Newton).

    The gradient is the mean of the photo's and the render's (efficient second-order minimisation, Malis 2004), from
    which it converges from about twice as far. One gain for all of the render makes up for contrast that it lacks.

    Args:
        rgb: (H, W, 3) float32 in [0, 1].
        one: a render of this size, from near the pose that is given; of one scene, for where two disagree by a
            centimetre the pose would lie between them.
        intrinsics_px: (4,) of this size.
        blur_px: of this round, at this size.
        focal: its expected value and ``focal_sigma``, where it is free.
        known: (H, W) bool: pixels of the photo that count; None of all.
    """
    empty = np.zeros((0, 3))
    nothing = Aligned(T_metric_camera, intrinsics_px, empty[:, :2], empty, empty, np.zeros((0, 3, 6)))
    photo = _band(rgb, known, blur_px, params.band)
    pixels, shown, slope, trust = _pixels(photo, one, blur_px, params, known)
    if len(pixels) < params.min_points:
        return nothing
    laid = _Laid(
        np.concatenate([photo, slopes(photo).reshape(*photo.shape[:2], 6)], axis=2),
        one.places(pixels),
        shown,
        slope,
        trust,
        focal,
    )
    state = laid.state(T_metric_camera, intrinsics_px)
    gain = _bounded(_gain(state.seen, shown, state.trust[:, None]), params.max_gain)
    left = np.abs(state.seen[:, :3] - gain * shown)[state.trust > 0]
    if len(left) < params.min_points:
        return nothing
    scale = params.doubt * max(1.4826 * float(np.median(left)), 1e-3)
    pose, lens, gain = _descended(laid, T_metric_camera, intrinsics_px, gain, scale, params)
    state = laid.state(pose, lens)
    # Slopes of the render alone: the photo's noise has slopes as well, which would pass for information.
    without = replace(state, seen=np.concatenate([state.seen[:, :3], gain * slope.reshape(-1, 6)], axis=1))
    differ, weights, J = _linear(without, shown, slope, gain, scale)
    return Aligned(pose, lens, state.pixels, differ, weights, J, float(trust.mean()))


def _descended(
    laid: _Laid, pose: np.ndarray, lens: np.ndarray, gain: float, scale: float, params: Params
) -> tuple[np.ndarray, np.ndarray, float]:
    """Pose, lens and gain from which no step is better."""
    damping = 1e-4
    for _ in range(params.iterations):
        now = laid.step(pose, lens, gain, scale)
        while damping <= 10.0:
            diagonal = damping * np.diag(np.diag(now.information)) + 1e-9 * np.eye(len(now.slope))
            step = np.linalg.solve(now.information + diagonal, now.slope)
            further = lens.copy()
            if len(step) == 7:
                further[:2] *= np.exp(np.clip(step[6], -0.1, 0.1))
            tried = resection.moved(pose, step[:6])
            then = laid.step(tried, further, gain, scale)
            if then.cost < now.cost:
                break
            damping = max(10 * damping, 1e-3)
        else:
            break
        pose, lens, damping = tried, further, max(damping / 10, 1e-6)
        gain = _bounded(then.gain, params.max_gain)
        if np.abs(step[:3]).max() < 2e-5 and np.abs(step[3:6]).max() < 5e-5:
            break
    return pose, lens, gain


@dataclass(frozen=True, eq=False)
class _Step:
    """What a pose is worth, and where a better one lies.

    Args:
        cost: the mean of Cauchy's loss over the points that lie in the photo.
        gain: by which the render's band would be the photo's there.
        information: (dim, dim) of the normal equations.
        slope: (dim,) their right side.
    """

    cost: float
    gain: float
    information: np.ndarray
    slope: np.ndarray


@dataclass(frozen=True, eq=False)
class _Laid:
    """Points of a render, and the photo that they are laid over.

    Args:
        planes: (H, W, 9) float32 the photo's band: colours, their slopes along rows, and along columns.
        points: (K, 3) where they lie in the map, metres.
        shown: (K, 3) float32 colours of the render's band.
        slope: (K, 2, 3) float32 of these, along rows and along columns.
        trust: (K,) float64.
        focal: of `align`.
    """

    planes: np.ndarray
    points: np.ndarray
    shown: np.ndarray
    slope: np.ndarray
    trust: np.ndarray
    focal: tuple[float, float] | None

    def step(self, pose: np.ndarray, lens: np.ndarray, gain: float, scale: float) -> _Step:
        """From one pose; a focal length that is far from the expected one costs as well."""
        told = (self.planes, self.points, self.shown, self.slope, self.trust)
        cost, within, both, own, A, b = native_laid(*told, pose, lens, gain, scale, 6 if self.focal is None else 7)
        if self.focal is not None and np.isfinite(self.focal[1]):
            far = np.log(self.focal[0] / lens[0])
            A[6, 6] += scale**2 / self.focal[1] ** 2
            b[6] += scale**2 * far / self.focal[1] ** 2
            cost += (far / self.focal[1]) ** 2
        return _Step(cost / max(within, 1e-9), both / max(own, 1e-9), A, b)

    def state(self, pose: np.ndarray, lens: np.ndarray) -> _State:
        """The same of every point, for what is asked of them once."""
        dim = 6 if self.focal is None else 7
        minus, jacobian = resection.linearised(np.zeros((len(self.points), 2)), self.points, pose, lens, dim)
        pixels, size = -minus, np.array(self.planes.shape[1::-1])
        inside = (jacobian != 0).any((1, 2)) & (pixels > 1).all(1) & (pixels < size - 1).all(1)
        return _State(pixels, _sampled(self.planes, pixels), self.trust * inside, jacobian)


@dataclass(frozen=True, eq=False)
class _State:
    """Points from one pose.

    Args:
        pixels: (K, 2) where the points come to lie.
        seen: (K, 9) what the photo shows there: the band's colours, their slopes along rows, and along columns.
        trust: (K,) 0 where they lie outside.
        jacobian: (K, 2, dim) of the pixels.
    """

    pixels: np.ndarray
    seen: np.ndarray
    trust: np.ndarray
    jacobian: np.ndarray


def _linear(
    state: _State, shown: np.ndarray, slope: np.ndarray, gain: float, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences of colours (K, 3), their weights (K, 3) and derivatives (K, 3, dim)."""
    differ = state.seen[:, :3] - gain * shown
    weights = state.trust[:, None] / (1 + (differ / scale) ** 2)
    down, right = (state.seen[:, 3:6] + gain * slope[:, 0]) / 2, (state.seen[:, 6:9] + gain * slope[:, 1]) / 2
    jacobian = right[..., None] * state.jacobian[:, None, 0] + down[..., None] * state.jacobian[:, None, 1]
    return differ, weights, jacobian


def _pixels(
    photo: np.ndarray, one: Look, blur: float, params: Params, known: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Those of a render that are laid over a photo: where (K, 2), colours (K, 3), slopes (K, 2, 3), trust (K,)."""
    band = _band(one.rgb, one.alpha > params.min_alpha, blur, params.band)
    slope = slopes(band)
    contrast = np.sqrt(np.einsum("hwdc,hwdc->hw", slope, slope))
    width = 2 * round(params.around_px * blur / 2) + 1
    relative = contrast / (means(contrast, width) + 1e-4)
    relative[~_smooth(one, params)] = 0
    if known is not None:
        relative[~known] = 0
    count = min(params.max_points, int((relative > 0).sum()))
    rows = np.sort(np.argpartition(-relative.ravel(), max(count - 1, 0))[:count])
    row, column = np.divmod(rows, relative.shape[1])
    shown = band
    if known is not None:  # what stands before the place agrees with nothing, and says nothing
        photo, shown = (image * known[..., None] for image in (photo, band))
    products = [np.einsum("hwc,hwc->hw", a, b) for a, b in ((photo, shown), (photo, photo), (shown, shown))]
    both, mine, theirs = means(np.stack(products, axis=2), width)[row, column].T
    agree = both / np.sqrt(np.maximum(mine * theirs, 1e-12))
    trust = np.clip(agree.astype(np.float64), params.least_trust, 1.0) ** params.trust
    return np.stack([column + 0.5, row + 0.5], axis=1), band[row, column], slope[row, column], trust


def _smooth(one: Look, params: Params) -> np.ndarray:
    """(H, W) bool: opaque, and no edge near: of a plane, however slanted, the inverse of the depth is linear."""
    reach, (height, width) = params.reach_px, one.alpha.shape
    solid = (one.alpha > params.min_alpha) & (one.depth_m > 0)
    inverse = np.where(solid, 1 / np.maximum(one.depth_m, 1e-3), 0)
    around = np.pad(inverse, reach)  # outside nothing is known
    out = solid.copy()
    for down, right in ((0, reach), (reach, 0), (reach, reach), (reach, -reach)):
        one_side, other = (around[reach + s * down :, reach + s * right :][:height, :width] for s in (1, -1))
        out &= (one_side > 0) & (other > 0) & (np.abs(one_side + other - 2 * inverse) <= params.max_bend * inverse)
    return out


def _band(rgb: np.ndarray, known: np.ndarray | None, blur: float, band: float) -> np.ndarray:
    """(H, W, 3) less what is finer than ``blur`` and what is ``band`` times broader, of the known pixels alone."""
    fine, broad = (_blurred(rgb, known, sigma) for sigma in (blur, band * blur))
    return fine - broad


def _blurred(rgb: np.ndarray, known: np.ndarray | None, sigma: float) -> np.ndarray:
    if known is None:
        return blurred(rgb, sigma, 3.0, reflect=False)
    share = known.astype(np.float32)[..., None]
    both = blurred(np.concatenate([rgb * share, share], axis=2), sigma, 3.0, reflect=False)
    out: np.ndarray = both[..., :3] / np.maximum(both[..., 3:], 1e-3)
    return out


def _sampled(planes: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(K, C) between pixels, bilinearly; at the edge where they lie outside."""
    height, width = planes.shape[:2]
    x = np.clip(pixels[:, 0] - 0.5, 0, width - 1.001)
    y = np.clip(pixels[:, 1] - 0.5, 0, height - 1.001)
    column, row = x.astype(np.int64), y.astype(np.int64)
    a, b = (x - column)[:, None].astype(np.float32), (y - row)[:, None].astype(np.float32)
    upper = planes[row, column] * (1 - a) + planes[row, column + 1] * a
    lower = planes[row + 1, column] * (1 - a) + planes[row + 1, column + 1] * a
    out: np.ndarray = upper * (1 - b) + lower * b
    return out


def _gain(seen: np.ndarray, shown: np.ndarray, weights: np.ndarray) -> float:
    """By what the render's band is multiplied to be the photo's."""
    return float((weights * seen[:, :3] * shown).sum() / max(float((weights * shown**2).sum()), 1e-9))


def _bounded(gain: float, most: float) -> float:
    return float(np.clip(gain, 1 / most, most))
