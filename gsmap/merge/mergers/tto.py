"""Merge by test-time optimization: the merged map is fitted to renders of each scene from that scene's own cameras.

The method is the merging of Graph-GSReg (voxelize the union, then minimize the difference to renders of the original
scenes) with measured improvements. Each cell starts from the scene that shows most of it. Invisible Gaussians are
removed, and the most similar Gaussians are merged until few enough are left. The newest scene is preferred where the
place changed, and exposures can be balanced. With `owner_cells` off, `prefer` of ``both``, an `ssim_weight`,
`huber_delta` and `min_weight` of 0 and a `kept_fraction` of 1 it is the published method: an L1 fit of all voxels of
the union.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsmap.geometry.boxes import inside
from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge import references
from gsmap.merge.changes import LOOKING_M, MIN_CAMERAS, Prefer, ResolvedScenes, resolve_changes
from gsmap.merge.exposure import balance_exposure
from gsmap.merge.overlap import clamp_inside, concatenate_scenes
from gsmap.merge.references import WEIGHT_UNIT, References, render_references, view_schedule
from gsmap.merge.selection import near_other_scene, select_owners
from gsmap.render.fit import make_fitter, with_enough_memory
from gsmap.render.fitter import FitOptions, LearningRates
from gsmap.settings.ranges import require_range
from gsmap.types import Gaussians, MergeResult, PosedScene
from gsmap.types.progress import Progress

VERSION = 11
"""Version, raised whenever the result for the same scenes changes, also through modules of `gsmap.merge` that it
calls."""
STEPS: str | None = "steps"
RENDERS = True

_BESIDE_M = 0.025  # Gaussians of other scenes within this distance of new Gaussians are removed
# Initial steps of Adam, for positions relative to the median size of the Gaussians: the longest that pay off in few
# passes.
_FIRST = LearningRates(means=0.07, quats=8e-3, log_scales=4e-2, logit_opacities=0.25, sh_base=4e-2, sh_rest=5e-3)
_LAST = 0.1  # last step relative to the first; the decay is exponential
_OWNER_CELL_M = 0.5  # edge of the owner cells
_COVER_M = 0.1  # a Gaussian of the owner within this distance replaces one of another scene
_SEED = 0  # random seed of the order of views
_MIN_PASS_STEPS = 20  # smallest number of steps of a pass over all views, for a tile that few pixels show
_SURE_FRACTION = 0.5  # share of the steps that are always taken, because long initial steps may raise the loss
_MIN_GAIN = 0.002  # if a pass decreases the loss by a smaller fraction, the fit stops


@dataclass(frozen=True)
class Params:
    """Settings of test-time optimization.

    Args:
        min_weight: Blending weight in [0, 1] that a Gaussian must reach in at least one view of its scene to be kept,
            unless it has the largest weight at some pixel; larger removes more Gaussians.
        kept_fraction: Largest number of Gaussians in a tile before its optimization, as a fraction in [0, 1] of the
            Gaussians of its scenes in the tile; smaller merges more pairs of similar Gaussians, and 1 merges none.
        voxel_m: Edge length in metres, positive, of the voxels in which Gaussians are merged first; larger leaves fewer
            Gaussians.
        owner_cells: Assign each cell of half a metre to the scene that shows most of the cell, so that Gaussians of two
            scenes do not overlay each other on one surface.
        ssim_weight: Weight in [0, 1] of 1 - SSIM in the loss, whose remaining weight goes to the Huber loss; larger
            favours structure over colour.
        huber_delta: Colour difference, at least 0 (colours lie in [0, 1]), below which the loss is quadratic; larger
            weakens the effect of small differences, and 0 is the L1 loss.
        momentum: First-moment decay rate of Adam in [0, 1); larger smooths the steps more, which delays a fit of few
            steps.
        max_passes: Largest number of passes over all views, at least 0, if ``steps`` is not set; the fit ends earlier
            once it no longer improves. Larger improves the fit and takes more time.
        steps: Exact number of optimization steps, at least 0; larger takes more time. If none is set, ``max_passes``
            limits the steps.
        halo_m: Width in metres, at least 0, of the surroundings that are rendered with a tile; Gaussians in the inner
            half are optimized with the tile, those in the outer half stay fixed. Larger hides seams better and takes
            more time.
        longest_side_px: Longest side in pixels, at least 1, of the reference views; larger keeps finer detail and takes
            more time and memory.
        max_views: Largest number of reference views of a tile, at least 1, chosen to see the tile best together, newer
            views first; larger takes more memory (3 MB per view of 960 pixels) and time.
        photo_weight: Number of times, at least 0, that each reference photo is used per use of a rendered view; larger
            follows photos more closely, and 0 ignores photos.
        balance_exposure: Adjust all scenes to one exposure first, which looks even but no longer reproduces the colours
            of each scene.
        prefer: Scene that is shown where scenes of different dates disagree: the ``newest``, the ``best`` observed one,
            or ``both``.
    """

    min_weight: float = 0.05
    kept_fraction: float = 0.8
    voxel_m: float = 0.01
    owner_cells: bool = True
    ssim_weight: float = 0.2
    huber_delta: float = 0.05
    momentum: float = 0.5
    max_passes: float = 4.0
    steps: int | None = None
    halo_m: float = 1.0
    longest_side_px: int = 960
    max_views: int = references.MAX_VIEWS
    photo_weight: float = references.PHOTO_WEIGHT
    balance_exposure: bool = False
    prefer: Prefer = "newest"

    def __post_init__(self) -> None:
        if self.steps is not None:
            require_range(self, "[0, inf]", "steps")
        require_range(self, "(0, inf]", "voxel_m", "longest_side_px", "max_views")
        require_range(self, "[0, inf]", "max_passes", "halo_m", "photo_weight")
        require_range(self, "[0, 1]", "kept_fraction", "ssim_weight", "min_weight", "huber_delta")
        require_range(self, "[0, 1)", "momentum")


def reach_m(params: Params) -> float:
    return params.halo_m


def reading_m(params: Params, dated: bool) -> float:
    compares = params.balance_exposure or (dated and uses_dates(params))
    return params.halo_m + (LOOKING_M if compares else 0.0)


def looking_m(params: Params) -> float:
    return params.halo_m + LOOKING_M


def min_cameras(params: Params) -> int:
    return MIN_CAMERAS


def photos_m(params: Params) -> float | None:
    return looking_m(params) if params.photo_weight > 0 else None


def uses_dates(params: Params) -> bool:
    return params.prefer != "both"


def merge(
    scenes: Sequence[PosedScene],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Progress,
) -> MergeResult:
    """Remove outdated Gaussians, balance exposures, render reference views, select Gaussians, and fit these to the
    views."""
    deadline = None if budget_s is None else time.monotonic() + budget_s
    notes: list[str] = []
    settled = resolve_changes(scenes, params.prefer, one_exposure=bounds is None)
    scenes = settled.scenes
    notes += settled.notes()
    if params.balance_exposure:
        scenes, log_gains = balance_exposure(scenes)
        if log_gains.any():
            notes.append(f"exposures differed by up to {np.ptp(log_gains, axis=0).max() / np.log(2):.2f} stops")
    wanted = render_references(
        scenes,
        bounds,
        params.halo_m,
        params.longest_side_px,
        settled,
        lambda fraction, text: progress(0.2 * fraction, text),
        max_views=params.max_views,
        photo_weight=params.photo_weight,
    )
    # A single scene has no overlaps and already reproduces its own views.
    alone = sum(bool(inside(scene.gaussians.means, bounds, params.halo_m).any()) for scene in scenes) < 2
    start, origin, new = _start(
        scenes, wanted, settled, replace(params, kept_fraction=1.0) if alone else params, bounds
    )
    if len(wanted) == 0 or not inside(start.means, bounds).any():
        notes.append("no camera observes the tile, so it is not optimized")
        return MergeResult(start, origin, notes=tuple(notes))
    if alone and not wanted.num_photos:
        mine = inside(start.means, bounds)
        return MergeResult(start[mine], origin[mine], notes=tuple(notes))
    # The inner half of the halo is fitted and then dropped. If it were frozen, Gaussians at the border would compensate
    # for errors of neighbours that the next tile refines. New Gaussians stay unchanged, because no other scene shows
    # their place.
    frozen = ~inside(start.means, bounds, params.halo_m / 2) | new
    if wanted.num_photos:
        many = wanted.num_photos > 1
        notes.append(f"{wanted.num_photos} photo{'s were' if many else ' was'} used as reference views")
    fitted, steps, truncated = with_enough_memory(
        lambda backend: _fit(start, frozen, wanted, params, deadline, progress, backend)
    )
    # A Gaussian must stay in its initial tile; if it crossed the border it would be lost or duplicated.
    mine = inside(start.means, bounds)
    fitted = replace(fitted[mine], means=clamp_inside(fitted.means[mine], bounds))
    return MergeResult(fitted, origin[mine], steps=steps, truncated=truncated, notes=tuple(notes))


def _start(
    scenes: Sequence[PosedScene],
    wanted: References,
    settled: ResolvedScenes,
    params: Params,
    bounds: np.ndarray | None,
) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    """Voxelize the scenes within the halo, select one scene per cell, and reduce the tile to its allowed number of
    Gaussians.

    New Gaussians, where the place changed, are not altered.

    Returns:
        The initial Gaussians, the (N,) scene of each Gaussian, and an (N,) mask of new Gaussians.
    """
    near_of = [inside(scene.gaussians.means, bounds, params.halo_m) for scene in scenes]
    near = np.concatenate(near_of)
    gaussians, origin = concatenate_scenes(
        [replace(scene, gaussians=scene.gaussians[n]) for scene, n in zip(scenes, near_of, strict=True)]
    )
    num_inside = int(inside(gaussians.means, bounds).sum())
    new = np.concatenate(settled.changed)[near]
    labels = voxel_labels(gaussians.means, params.voxel_m)
    # A new Gaussian shares its voxel with no other Gaussian.
    labels[new] = labels.max(initial=-1) + 1 + np.arange(int(new.sum()))
    labels = np.unique(labels, return_inverse=True)[1]
    merged, heaviest = merge_groups(gaussians, labels)
    del gaussians
    visible = np.bincount(labels, np.concatenate(wanted.visible_pixels)[near], minlength=len(merged))
    origin, new = origin[heaviest], new[heaviest]
    stays = np.ones(len(merged), dtype=bool)
    if params.owner_cells:
        # Gaussians that are occluded in newer scenes do not count in the selection of an owner.
        behind = np.concatenate(settled.behind)[near][heaviest]
        votes = np.where(behind, np.minimum(visible, WEIGHT_UNIT), visible)
        for scene in np.unique(origin):
            mine = origin == scene
            votes[mine] *= wanted.sharpness.at(int(scene), merged.means[mine])
        stays &= select_owners(merged, origin, votes, _OWNER_CELL_M, _COVER_M)
    stays &= visible >= WEIGHT_UNIT * params.min_weight
    stays |= new
    stays[near_other_scene(merged.means, origin, new, _BESIDE_M)] = False
    mine = inside(merged.means, bounds)
    count = max(int(params.kept_fraction * num_inside) - int((new & mine).sum()), 1)
    many = stays & mine & ~new
    if params.kept_fraction == 1 or many.sum() <= count:
        return merged[stays], origin[stays], new[stays]
    from gsmap.geometry.decimate import decimate  # imports scipy, which the recipe key does not need

    fewer, into = decimate(merged[many], count, visible[many])
    # A Gaussian that was merged from two scenes belongs to the scene in which it is more visible.
    order = np.argsort(visible[many], kind="stable")
    of = np.empty(len(fewer), dtype=origin.dtype)
    of[into[order]] = origin[many][order]
    stays &= ~many
    parts = Gaussians.concatenate([merged[stays], fewer]), np.concatenate([origin[stays], of])
    return *parts, np.concatenate([new[stays], np.zeros(len(fewer), dtype=bool)])


def _fit(
    start: Gaussians,
    frozen: np.ndarray,
    wanted: References,
    params: Params,
    deadline: float | None,
    progress: Progress,
    backend: str,
) -> tuple[Gaussians, int, bool]:
    """Fit the initial Gaussians to the reference views; return them, the number of steps, and whether time ran out."""
    one_pass = max(_MIN_PASS_STEPS, round(wanted.view_weights.sum()))
    steps = params.steps if params.steps is not None else round(params.max_passes * one_pass)
    options = FitOptions(ssim_weight=params.ssim_weight, huber_delta=params.huber_delta, betas=(params.momentum, 0.999))
    fitter = make_fitter(start, frozen=frozen, options=options, backend=backend)
    cameras = [wanted.cameras[v] for v in range(len(wanted))]
    pictures = [fitter.load(image[None]) for image in wanted.images]
    weights = [fitter.load(weight[None]) for weight in wanted.weights]
    size_m = float(np.exp(np.median(start.log_scales.max(1))))
    losses: list[Any] = []  # lazy values of the fitter, converted when used
    for step, view in enumerate(view_schedule(wanted.view_weights, steps, _SEED)):
        if deadline is not None and time.monotonic() > deadline:
            return fitter.gaussians(), step, True
        fitter.learning_rates = _rates(step / steps, size_m)
        losses.append(fitter.step(cameras[view], pictures[view], weights[view]))
        if step % 20 == 0:
            progress(0.2 + 0.8 * step / steps, f"optimizing, loss {_mean(losses[-20:]):.4f}")
        if params.steps is None and step > _SURE_FRACTION * steps and _has_converged(losses, one_pass):
            break
    return fitter.gaussians(), len(losses), False


def _rates(progress: float, size_m: float) -> LearningRates:
    """Return the learning rates at a fraction of the optimization, for Gaussians of a median size."""
    first = vars(_FIRST) | {"means": _FIRST.means * size_m}
    return LearningRates(**{name: rate * _LAST**progress for name, rate in first.items()})


def _mean(losses: list[Any]) -> float:
    return float(np.mean([float(loss) for loss in losses]))


def _has_converged(losses: list[Any], one_pass: int) -> bool:
    """Return whether the last pass over all views hardly improved on the previous pass."""
    if len(losses) % one_pass or len(losses) < 2 * one_pass:
        return False
    before, now = _mean(losses[-2 * one_pass : -one_pass]), _mean(losses[-one_pass:])
    return now > (1 - _MIN_GAIN) * before
