"""Renders of the source laid over renders of the target: the last millimetres, where pictures say more than points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import retract
from gsmap.types import Cameras, Gaussians, Sim3


@dataclass(frozen=True)
class Params:
    """Args:
    num_views: cameras of the target that see most of the source.
    image_size_px: longer side of the renders.
    iterations: Gauss-Newton steps.
    step_rad, step_m, step_log: probes of the derivative; about a pixel at room distance.
    depth_tolerance: pixels whose two depths differ by more than this share show different surfaces and do not count.
    """

    num_views: int = 6
    image_size_px: int = 128
    iterations: int = 3
    step_rad: float = 0.003
    step_m: float = 0.006
    step_log: float = 0.003
    depth_tolerance: float = 0.1


def refine(
    target: Gaussians,
    source: Gaussians,
    cameras: Cameras,
    start: Sim3,
    params: Params | None = None,
    *,
    unit_m: float = 1.0,
    with_scale: bool = False,
) -> Sim3:
    """``S_target_source`` whose renders of the source match those of the target best, seen by the target's cameras.

    Gauss-Newton on robust colour differences; the derivative is taken by rendering the source from probed poses (a
    view moves, not 10^5 Gaussians). The source's exposure per channel (gain, offset) is fitted along. A step that does
    not lower the cost is not taken.

    Args:
        start: in the scenes' own units, within a few pixels of the answer.
        cameras: the target's.
        unit_m: metres per unit of the target.
    """
    from gsmap.render import render

    params = params or Params()
    cameras = _most_seeing(cameras.resized(params.image_size_px), source, start, params.num_views)
    if not len(cameras):
        return start
    seen = render(target, cameras)
    dim = 7 if with_scale else 6
    probes = np.r_[np.full(3, params.step_rad), np.full(3, params.step_m / unit_m / start.scale), params.step_log][:dim]
    centre = np.median(source.means, axis=0).astype(np.float64)

    def residual(pose: Sim3, mask: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Colour differences of the pixels in the mask (P, 3), and the mask."""
        shot = render(source, _moved(cameras, pose.inverse()))
        if mask is None:
            depth = shot.depth * pose.scale
            mask = (seen.alpha > 0.7) & (shot.alpha > 0.7)
            mask &= np.abs(depth - seen.depth) < params.depth_tolerance * seen.depth
        return shot.colour[mask].astype(np.float64), mask

    def cost(colours: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        difference = _exposed(colours, wanted) - wanted
        spread = 1.4826 * np.median(np.abs(difference)) + 1e-6
        weights = 1.0 / (1.0 + (difference / (2 * spread)) ** 2) ** 2
        return difference, weights, spread

    pose = start
    for _ in range(params.iterations):
        colours, mask = residual(pose, None)
        if mask.sum() < 500:
            return start
        wanted = seen.colour[mask].astype(np.float64)
        difference, weights, spread = cost(colours, wanted)
        gains = _gains(colours, wanted)
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
        tried = retract(centred, step) @ back
        after = _exposed(residual(tried, mask)[0], wanted) - wanted
        if _robust(after, spread) >= _robust(difference, spread):
            break
        pose = tried
        if np.abs(step / probes).max() < 0.05:
            break
    return pose


def _robust(difference: np.ndarray, spread: float) -> float:
    squares = (difference / (2 * spread)) ** 2
    return float((squares / (1.0 + squares)).sum())


def _gains(colours: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    spread_w = np.median(np.abs(wanted - np.median(wanted, axis=0)), axis=0)
    spread_c = np.median(np.abs(colours - np.median(colours, axis=0)), axis=0)
    return np.clip(spread_w / np.maximum(spread_c, 1e-6), 0.5, 2.0)


def _exposed(colours: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Colours under the gain and offset per channel that bring their medians to the wanted ones'."""
    gains = _gains(colours, wanted)
    return (colours - np.median(colours, axis=0)) * gains + np.median(wanted, axis=0)


def _most_seeing(cameras: Cameras, source: Gaussians, pose: Sim3, count: int) -> Cameras:
    """The cameras with most of the source's surface in view, each part counted once."""
    from gsmap.register.sight import choose_cameras

    opaque = np.flatnonzero(source.opacities > 0.5)
    sample = opaque[:: max(1, len(opaque) // 2000)]
    return cameras[choose_cameras(cameras, pose.apply(source.means[sample]), count)]


def _moved(cameras: Cameras, S_a_b: Sim3) -> Cameras:
    """Cameras of frame b in frame a."""
    from gsmap.geometry.transforms import transform_cameras

    return transform_cameras(cameras, S_a_b)
