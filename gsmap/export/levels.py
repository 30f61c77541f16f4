"""Make levels of detail of a tileset: merge Gaussians, fit them to the finer level, and measure the error.

A level is merged pair by pair (`gsmap.geometry.decimate`), fitted to renders of the finer level from the scenes'
cameras, at a resolution that matches the size of its Gaussians, and compared with renders of held-out views; a fit that
does not improve these is discarded. The resolution at which a level is similar enough determines its geometric error,
and so the distance from which it is shown.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from gsmap.formats import tiles3d
from gsmap.geometry.projection import in_image, project
from gsmap.render import ChunkIndex, render
from gsmap.render.fit import make_fitter, with_enough_memory
from gsmap.render.fitter import FitOptions, LearningRates
from gsmap.settings.ranges import require_range
from gsmap.types import Cameras, Gaussians

VERSION = 6
"""Raised whenever the same tiles and cameras give other levels; all levels are then made again."""

_SCREEN_PX = 16.0  # default screen-space error of viewers of 3D Tiles, above which they refine
_DEVIATION_PX = 3.0  # size of a level's Gaussians (largest deviation, median) in the views that it is fitted to
_MIN_PSNR_DB = 30.0  # of a level that is similar enough to be shown
_TRIED = 240  # cameras near a level, of which those with the best view are selected
_SAMPLE = 1000  # Gaussians by which the view of a camera is rated
_SEEN = 0.15  # fraction of them in the view of a selected camera
_FIRST = LearningRates(means=0.035, quats=2e-3, log_scales=1e-2, logit_opacities=5e-2, sh_base=5e-3, sh_rest=5e-3)
_LAST = 0.1  # last step relative to the first, reached exponentially


@dataclass(frozen=True)
class Params:
    """Settings of levels of detail.

    Args:
        views: Largest number of scene cameras, at least 0, from which a level is fitted and measured; larger is slower
            and more reliable. With 0, Gaussians are merged without a fit, and the error of a level is the distance by
            which they move.
        steps: Number of optimization steps of one level, at least 0; larger improves levels and takes more time.
    """

    views: int = 48
    steps: int = 200

    def __post_init__(self) -> None:
        require_range(self, "[0, inf]", "views", "steps")


@dataclass(frozen=True, eq=False)
class Level:
    """A level of detail that replaces finer Gaussians.

    Args:
        gaussians: its Gaussians.
        error_m: geometric error, in the frame's unit; the level is shown where it is less than 16 pixels.
        psnr_db: PSNR of the worst and of the median held-out view, at the smallest distance where it is shown; None
            without cameras that observe it.
    """

    gaussians: Gaussians
    error_m: float
    psnr_db: tuple[float, float] | None = None


def make_level(
    finer: Gaussians,
    max_count: int,
    cameras: Cameras | None,
    params: Params = Params(),
    *,
    deviation_px: float = _DEVIATION_PX,
) -> Level:
    """Make a level of at most ``max_count`` Gaussians.

    Args:
        finer: Gaussians that it replaces.
        max_count: largest number of Gaussians.
        cameras: of the scenes, in the frame of the Gaussians; None for none.
        params: see `Params`.
        deviation_px: size of its Gaussians (largest deviation, median) in the views that it is fitted to.
    """
    start, apart = tiles3d.coarser(finer, max_count)
    views = None if cameras is None or not params.views else _select_views(finer, cameras, params.views)
    if views is None or len(start) == len(finer):
        return Level(start, apart)
    kept = np.arange(len(views)) % 4 == 3
    depths = _depths(start, views)  # same depths as the finer level, at a fraction of the cost
    footprint = float(np.exp(np.median(start.log_scales.max(1)))) / deviation_px
    index = ChunkIndex.build(finer)

    def measured_views(rows: np.ndarray, footprint: float) -> list[_MeasuredView]:
        return [
            _MeasuredView(camera, _render(finer, camera, index))
            for camera in _resized_views(views[rows], depths[rows], footprint)
        ]

    targets = measured_views(~kept, footprint)
    fitted = with_enough_memory(lambda backend: _fit(start, targets, params, backend))

    @cache
    def judges(footprint: float) -> list[_MeasuredView]:
        return measured_views(kept, footprint)

    level = max(fitted, start, key=lambda one: np.median(_psnr_db(one, judges(footprint))))
    shown, decibels = _measure(level, judges, footprint)
    return Level(level, _SCREEN_PX * shown, (float(decibels.min()), float(np.median(decibels))))


@dataclass(frozen=True, eq=False)
class _MeasuredView:
    """A camera and the target image (H, W, 3) that it should see."""

    camera: Cameras
    picture: np.ndarray


def _select_views(gaussians: Gaussians, cameras: Cameras, count: int) -> Cameras | None:
    """Select the cameras that see most Gaussians; None if fewer than four cameras see enough."""
    low, high = np.quantile(gaussians.means, (0.02, 0.98), axis=0)
    eyes = cameras.T_frame_camera[:, :3, 3]
    away = np.linalg.norm(np.maximum(0, np.maximum(low - eyes, eyes - high)), axis=1)
    near = np.flatnonzero(away <= np.linalg.norm(high - low))
    near = near[:: -(-len(near) // _TRIED) or 1]
    points = gaussians.means[:: -(-len(gaussians) // _SAMPLE)].astype(np.float64)
    share = np.zeros(len(near))
    for k, c in enumerate(near.tolist()):
        pixels, depth = project(points, cameras.T_camera_frame[c], cameras.intrinsics_px[c])
        share[k] = in_image(pixels, depth, cameras.sizes_px[c]).mean()
    best = near[np.sort(np.argsort(-share, kind="stable")[:count])]
    best = best[share[np.searchsorted(near, best)] >= _SEEN]
    return cameras[best] if len(best) >= 4 else None


def _depths(gaussians: Gaussians, views: Cameras) -> np.ndarray:
    """Return the median depth (V,) of each view, from small renders."""
    out = np.full(len(views), np.nan)
    for v in range(len(views)):
        seen = render(gaussians, views[v].resized(64), dominant_id=False)
        there = seen.alpha[0] > 0.5
        if there.any():
            out[v] = np.median(seen.depth[0][there])
    return np.where(np.isfinite(out), out, np.nanmedian(out) if np.isfinite(out).any() else 1.0)


def _resized_views(views: Cameras, depths: np.ndarray, footprint: float) -> list[Cameras]:
    """Resize each view so that a pixel at its median depth is ``footprint`` wide, but never enlarge a view."""
    focal = views.intrinsics_px[:, 0]
    longest = views.sizes_px.max(1) * depths / (footprint * focal)
    return [views[v].resized(int(np.clip(longest[v], 24, views.sizes_px[v].max()))) for v in range(len(views))]


def _render(gaussians: Gaussians, camera: Cameras, index: ChunkIndex | None = None) -> np.ndarray:
    seen = render(gaussians, camera, depth=False, dominant_id=False, index=index)
    picture: np.ndarray = np.clip(seen.colour[0], 0, 1)
    return picture


def _psnr_db(level: Gaussians, views: list[_MeasuredView]) -> np.ndarray:
    """Return the PSNR (V,) of a level in each view."""
    errors = [np.mean((_render(level, view.camera) - view.picture) ** 2) for view in views]
    return -10 * np.log10(np.maximum(errors, 1e-10))


def _fit(start: Gaussians, targets: list[_MeasuredView], params: Params, backend: str) -> Gaussians:
    """Fit Gaussians, from initial values, to renders of the finer level."""
    size = float(np.exp(np.median(start.log_scales.max(1))))
    fitter = make_fitter(start, options=FitOptions(ssim_weight=0.2), backend=backend)
    pictures = [fitter.load(target.picture[None]) for target in targets]
    rng = np.random.default_rng(0)
    turns = -(-params.steps // len(targets))
    order = np.concatenate([rng.permutation(len(targets)) for _ in range(turns)] or [np.zeros(0, int)])[: params.steps]
    for step, v in enumerate(order.tolist()):
        share = _LAST ** (step / params.steps)
        rates = {name: rate * share for name, rate in vars(_FIRST).items()}
        fitter.learning_rates = LearningRates(**rates | {"means": rates["means"] * size})
        fitter.step(targets[v].camera, pictures[v])
    return fitter.gaussians()


def _measure(
    level: Gaussians, judges: Callable[[float], list[_MeasuredView]], footprint: float
) -> tuple[float, np.ndarray]:
    """Return the smallest pixel footprint at which the median view is similar enough, and the PSNR (V,) at it.

    Searched from half to four times the given footprint; the last if none is similar enough.
    """
    for size in (footprint * 2.0 ** np.arange(-1, 3)).tolist():
        decibels = _psnr_db(level, judges(size))
        if np.median(decibels) >= _MIN_PSNR_DB:
            break
    return size, decibels
