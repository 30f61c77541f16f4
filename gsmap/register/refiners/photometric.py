"""Refine the last millimetres of a pose by photometric alignment of renders of both scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import retract
from gsmap.geometry.transforms import transform_cameras
from gsmap.methods.refiner import Surface
from gsmap.register.view_cache import select_views
from gsmap.types import Cameras, Gaussians, Sim3

VERSION = 1
SCALES = True

_NUM_VIEWS = 6  # cameras of the target that see most of the source
_IMAGE_SIZE_PX = 128  # longer side of the renders
MAX_ITERATIONS = 3  # Gauss-Newton steps
# Steps of the numerical derivative by rotation, translation and log scale; each moves a pixel at room distance by about
# the same amount.
_STEP_RAD = 0.003
_STEP_M = 0.006
_STEP_LOG = 0.003
_DEPTH_TOLERANCE = 0.1  # share of the depth; pixels that differ by more show different surfaces and are ignored
_MIN_ALPHA = 0.7  # fainter pixels of either render are ignored
_MIN_PIXELS = 500  # with fewer pixels left the start is returned


@dataclass(frozen=True)
class Params:
    """Settings of the alignment of renders: none."""


def refine(
    target: Surface, source: Surface, start: Sim3, params: Params | None = None, *, with_scale: bool = False
) -> Sim3:
    """Align renders of the source with renders of the target, both by the target's cameras (pose in metres).

    Gauss-Newton on robust colour differences; the derivative is computed by rendering the source from displaced poses
    (the view moves, not the Gaussians). The source's exposure (gain and offset of each channel) is fitted, too. A step
    that does not lower the cost is not taken. The start must be within a few pixels of the solution. Without both
    scenes' Gaussians and the target's cameras the start is returned.
    """
    if target.gaussians is None or source.gaussians is None or not target.cameras:
        return start
    # Renders show the scenes in their own units.
    unit_t, unit_s = target.unit_m, source.unit_m
    start_in_units = Sim3(start.rotation, start.translation / unit_t, start.scale * (unit_s / unit_t))
    aligned = _align(
        target.gaussians.load(),
        source.gaussians.load(),
        target.cameras,
        start_in_units,
        unit_m=unit_t,
        with_scale=with_scale,
    )
    if aligned is start_in_units:
        return start
    return Sim3(
        aligned.rotation, aligned.translation * unit_t, aligned.scale * (unit_t / unit_s) if with_scale else start.scale
    )


def _align(
    target: Gaussians,
    source: Gaussians,
    cameras: Cameras,
    start: Sim3,
    *,
    unit_m: float,
    with_scale: bool,
) -> Sim3:
    """Align renders under a pose between the scenes' own units; ``unit_m`` metres per unit of the target."""
    from gsmap.render import render

    cameras = _select_cameras(cameras.resized(_IMAGE_SIZE_PX), source, start, _NUM_VIEWS)
    if not len(cameras):
        return start
    rendered = render(target, cameras, backend="native")
    dim = 7 if with_scale else 6
    probes = np.r_[np.full(3, _STEP_RAD), np.full(3, _STEP_M / unit_m / start.scale), _STEP_LOG][:dim]
    centre = np.median(source.means, axis=0).astype(np.float64)

    def residual(pose: Sim3, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the colour residuals (P, 3) of the pixels in the mask, and the mask, which is computed if None."""
        moved = render(source, transform_cameras(cameras, pose.inverse()), backend="native")
        if mask is None:
            depth = moved.depth * pose.scale
            mask = (rendered.alpha > _MIN_ALPHA) & (moved.alpha > _MIN_ALPHA)
            mask &= np.abs(depth - rendered.depth) < _DEPTH_TOLERANCE * rendered.depth
        return moved.colour[mask].astype(np.float64), mask

    def cost(colours: np.ndarray, reference: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        difference = _match_exposure(colours, reference) - reference
        spread = 1.4826 * np.median(np.abs(difference)) + 1e-6
        weights = 1.0 / (1.0 + (difference / (2 * spread)) ** 2) ** 2
        return difference, weights, spread

    pose = start
    for _ in range(MAX_ITERATIONS):
        colours, mask = residual(pose, None)
        if mask.sum() < _MIN_PIXELS:
            return start
        reference = rendered.colour[mask].astype(np.float64)
        difference, weights, spread = cost(colours, reference)
        gains = _gains(colours, reference)
        # About the source's centre, where rotation and translation hardly mix.
        centred = pose @ Sim3(np.eye(3), centre)
        back = Sim3(np.eye(3), -centre)
        jacobian = np.empty((dim, *difference.shape))
        for k in range(dim):
            probe = np.zeros(dim)
            probe[k] = probes[k]
            jacobian[k] = (residual(retract(centred, probe) @ back, mask)[0] - colours) * gains / probes[k]
        flat, w = jacobian.reshape(dim, -1), weights.ravel()
        # In units of the probes the system is well scaled.
        flat = flat * probes[:, None]
        system = (flat * w) @ flat.T
        step = -np.linalg.solve(
            system + 1e-3 * np.diag(np.diag(system)) + 1e-12 * np.eye(dim), flat @ (w * difference.ravel())
        )
        step = np.clip(step, -3, 3) * probes
        candidate = retract(centred, step) @ back
        after = _match_exposure(residual(candidate, mask)[0], reference) - reference
        if _robust(after, spread) >= _robust(difference, spread):
            break
        pose = candidate
        if np.abs(step / probes).max() < 0.05:
            break
    return pose


def _robust(difference: np.ndarray, spread: float) -> float:
    squares = (difference / (2 * spread)) ** 2
    return float((squares / (1.0 + squares)).sum())


def _gains(colours: np.ndarray, reference: np.ndarray) -> np.ndarray:
    spread_w = np.median(np.abs(reference - np.median(reference, axis=0)), axis=0)
    spread_c = np.median(np.abs(colours - np.median(colours, axis=0)), axis=0)
    return np.clip(spread_w / np.maximum(spread_c, 1e-6), 0.5, 2.0)


def _match_exposure(colours: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Match the exposure of colours to the reference: apply the gain and offset per channel that match the medians."""
    gains = _gains(colours, reference)
    return (colours - np.median(colours, axis=0)) * gains + np.median(reference, axis=0)


def _select_cameras(cameras: Cameras, source: Gaussians, pose: Sim3, count: int) -> Cameras:
    """Select the cameras that together see most of the source's surface."""
    opaque = np.flatnonzero(source.opacities > 0.5)
    sample = opaque[:: max(1, len(opaque) // 2000)]
    return cameras[select_views(cameras, pose.apply(source.means[sample]), count)]
