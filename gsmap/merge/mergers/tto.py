"""Test-time optimisation: the merged map learns to look like each capture from that capture's own cameras.

Graph-GSReg's merging (voxelise the union, then minimise the difference to renders of the originals; no photographs
needed) with what measurably helps: in every cell the capture that shows most of it is the one that starts there, what
is nowhere seen goes, what is most alike becomes one where there is too much, the newest capture wins where the place
changed, and exposures can be balanced. With `owner_cells` off, both preferred, an `ssim_weight`, `huber_delta` and
`min_weight` of 0 and a `keep` of 1 it is the published method: an L1 fit of all voxels of the union.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from gsmap.errors import ConfigError
from gsmap.geometry.boxes import inside
from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge import exposure, references
from gsmap.merge.changes import Prefer, Settled, settle
from gsmap.merge.exposure import balance_exposure
from gsmap.merge.placed import pulled_inside, united
from gsmap.merge.references import WEIGHT_UNIT, References, render_references, view_schedule
from gsmap.merge.selection import beside, one_owner_per_cell
from gsmap.render.fit import make_fitter, with_enough_memory
from gsmap.render.fitter import FitOptions, LearningRates
from gsmap.types import Gaussians, MergeResult, PlacedScene
from gsmap.types.progress import Progress

VERSION = 8
STEPS: str | None = "steps"
RENDERS = True

_BESIDE_M = 0.025  # of what changed, within which no other capture's Gaussians are laid over it


@dataclass(frozen=True)
class Rates:
    """Adam's first steps, for Gaussians that are nearly right: as long as pays in few passes (`tools/bench_fit.py`).

    Args:
        means: of positions, as a share of the Gaussians' median size.
        quats: of rotations.
        log_scales: of sizes.
        logit_opacities: of opacities.
        sh_base: of colours.
        sh_rest: of what colours depend on the direction.
        last: the last step as a share of the first, reached exponentially.
        momentum: share of the gradients before that a step keeps. What pays in training is too much here: a Gaussian is
            moved a hundred times, each by another view than the last.
    """

    means: float = 0.07
    quats: float = 8e-3
    log_scales: float = 4e-2
    logit_opacities: float = 0.25
    sh_base: float = 4e-2
    sh_rest: float = 5e-3
    last: float = 0.1
    momentum: float = 0.5

    def at(self, progress: float, size_m: float) -> LearningRates:
        """The steps at a share of the optimisation, for Gaussians of a size."""
        first = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in ("last", "momentum")}
        first |= {"means": self.means * size_m}
        return LearningRates(**{name: rate * self.last**progress for name, rate in first.items()})


@dataclass(frozen=True)
class Stopping:
    """When to stop, where the number of steps is not given.

    Args:
        min_pass_steps: steps that count as a pass over all views, for a tile that few pixels show.
        sure_share: share of the steps that are taken whatever they gain: the first, long ones may lose.
        min_gain: stop when a pass over all views lowers the loss by less than this share.
    """

    min_pass_steps: int = 20
    sure_share: float = 0.5
    min_gain: float = 0.002


@dataclass(frozen=True)
class Params:
    """Test-time optimisation.

    Args:
        min_weight: drop what nowhere makes up this share of a pixel of its capture's own views, and dominates none.
        keep: at most this share of the Gaussians that went in, of each tile that several captures show; of more, the
            pairs that are most alike become one; 1 keeps all.
        voxel_m: side of the voxels in which Gaussians are first merged.
        owner_cells: give every cell of a grid to the capture that shows most of it, so that two captures of one
            surface do not lie over one another.
        cell_m: side of these cells.
        cover_m: an owner's Gaussian this near stands for another capture's.
        ssim_weight: share of 1 - SSIM in the loss; the rest is Huber's.
        huber_delta: differences of colours below this, of [0, 1], count by their square, so that steps shorten as the
            fit gets near; 0 is L1.
        passes: how often each view is used, where steps are not given; fewer when it no longer gains.
        steps: how many optimisation steps, exactly.
        halo_m: how far around a tile its surroundings are rendered along, the outer half of it frozen.
        reach_m: how far around a tile cameras are looked for.
        min_cameras: a tile that no camera stands in or near is refined from this many, the nearest of each capture,
            wherever they stand.
        longest_side_px: size of the pictures that are compared.
        balance_exposure: bring captures to one exposure first: even to the eye, but no longer what each capture looks
            like.
        prefer: who is shown where captures of other dates disagree: the ``newest``, who saw it ``best``, or ``both``.
        seed: of the order of views.
        rates: the optimiser's steps.
        stopping: when to stop, where the number of steps is not given.
        references: which views are reproduced.
        exposure: how exposures are compared, where they are balanced.
    """

    min_weight: float = 0.05
    keep: float = 0.8
    voxel_m: float = 0.01
    owner_cells: bool = True
    cell_m: float = 0.5
    cover_m: float = 0.1
    ssim_weight: float = 0.2
    huber_delta: float = 0.05
    passes: float = 4.0
    steps: int | None = None
    halo_m: float = 1.0
    reach_m: float = 10.0
    min_cameras: int = 12
    longest_side_px: int = 960
    balance_exposure: bool = False
    prefer: Prefer = "newest"
    seed: int = 0
    rates: Rates = field(default_factory=Rates)
    stopping: Stopping = field(default_factory=Stopping)
    references: references.Params = field(default_factory=references.Params)
    exposure: exposure.Params = field(default_factory=exposure.Params)

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 0:
            raise ConfigError(f"steps must not be negative, got {self.steps}")
        for name in ("voxel_m", "cell_m", "longest_side_px"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} must be positive, got {getattr(self, name)}")
        for name in ("cover_m", "passes", "halo_m", "reach_m", "min_cameras", "min_weight", "huber_delta"):
            if not getattr(self, name) >= 0:
                raise ConfigError(f"{name} must not be negative, got {getattr(self, name)}")
        for name in ("keep", "ssim_weight"):
            if not 0 <= getattr(self, name) <= 1:
                raise ConfigError(f"{name} must be a share in [0, 1], got {getattr(self, name)}")
        if not 0 <= self.rates.momentum < 1:
            raise ConfigError(f"rates.momentum must be in [0, 1), got {self.rates.momentum}")


def reach_m(params: Params) -> float:
    return params.halo_m


def reading_m(params: Params, dated: bool) -> float:
    compares = params.balance_exposure or (dated and uses_dates(params))
    return params.halo_m + (params.reach_m if compares else 0.0)


def looking_m(params: Params) -> float:
    return params.halo_m + params.reach_m


def min_cameras(params: Params) -> int:
    return params.min_cameras


def photos_m(params: Params) -> float | None:
    return looking_m(params) if params.references.photos.share > 0 else None


def uses_dates(params: Params) -> bool:
    return params.prefer != "both"


def merge(
    scenes: Sequence[PlacedScene],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Progress,
) -> MergeResult:
    """Drop what is gone, balance exposures, render references, choose what to keep, and fit it to the references."""
    deadline = None if budget_s is None else time.monotonic() + budget_s
    notes: list[str] = []
    settled = settle(scenes, params.prefer, one_exposure=bounds is None)
    scenes = settled.scenes
    notes += settled.notes()
    if params.balance_exposure:
        scenes, log_gains = balance_exposure(scenes, params.exposure)
        if log_gains.any():
            notes.append(f"exposures differed by up to {np.ptp(log_gains, axis=0).max() / np.log(2):.2f} stops")
    wanted = render_references(
        scenes,
        bounds,
        params.halo_m,
        params.longest_side_px,
        settled,
        lambda fraction, text: progress(0.2 * fraction, text),
        params.references,
    )
    # One capture alone shows nothing twice and is what its pictures show: thinned or fitted to them it could but lose.
    alone = sum(bool(inside(scene.gaussians.means, bounds, params.halo_m).any()) for scene in scenes) < 2
    start, origin, new = _start(scenes, wanted, settled, replace(params, keep=1.0) if alone else params, bounds)
    if len(wanted) == 0 or not inside(start.means, bounds).any():
        notes.append("nothing to optimise: no camera sees it")
        return MergeResult(start, origin, notes=tuple(notes))
    if alone and not wanted.num_photos:
        mine = inside(start.means, bounds)
        return MergeResult(start[mine], origin[mine], notes=tuple(notes))
    # The near half of the halo is fitted along, then dropped: were it frozen, what is at the border would make up for
    # neighbours that are going to be refined too.
    # What is new was fitted to photographs, and has no other capture to agree with.
    frozen = ~inside(start.means, bounds, params.halo_m / 2) | new
    if wanted.num_photos:
        many = wanted.num_photos > 1
        notes.append(f"{wanted.num_photos} photograph{'s were' if many else ' was'} reproduced as well")
    fitted, steps, truncated = with_enough_memory(
        lambda backend: _fit(start, frozen, wanted, params, deadline, progress, backend)
    )
    # A Gaussian stays with the tile it started in: one that crossed the border would be lost to both or kept by both.
    mine = inside(start.means, bounds)
    fitted = replace(fitted[mine], means=pulled_inside(fitted.means[mine], bounds))
    return MergeResult(fitted, origin[mine], steps=steps, truncated=truncated, notes=tuple(notes))


def _start(
    scenes: Sequence[PlacedScene],
    wanted: References,
    settled: Settled,
    params: Params,
    bounds: np.ndarray | None,
) -> tuple[Gaussians, np.ndarray, np.ndarray]:
    """The voxelised originals within the halo, one capture per cell, and within the bounds only what shows most.

    What stands where the place changed is taken as it is. Also the scene of each Gaussian, and whether it is new.
    """
    gaussians, origin = united(scenes)
    near = inside(gaussians.means, bounds, params.halo_m)
    new = np.concatenate(settled.changed)[near]
    labels = voxel_labels(gaussians.means[near], params.voxel_m)
    # A Gaussian of what changed shares its voxel with none.
    labels[new] = labels.max(initial=-1) + 1 + np.arange(int(new.sum()))
    labels = np.unique(labels, return_inverse=True)[1]
    merged, heaviest = merge_groups(gaussians[near], labels)
    visible = np.bincount(labels, np.concatenate(wanted.visible_pixels)[near], minlength=len(merged))
    origin, new = origin[near][heaviest], new[heaviest]
    stays = np.ones(len(merged), dtype=bool)
    if params.owner_cells:
        # What lies behind the newest wins it no cell.
        behind = np.concatenate(settled.behind)[near][heaviest]
        votes = np.where(behind, np.minimum(visible, WEIGHT_UNIT), visible)
        stays &= one_owner_per_cell(merged, origin, votes, params.cell_m, params.cover_m)
    stays &= visible >= WEIGHT_UNIT * params.min_weight
    stays |= new
    stays[beside(merged.means, origin, new, _BESIDE_M)] = False
    mine = inside(merged.means, bounds)
    count = max(int(params.keep * inside(gaussians.means, bounds).sum()) - int((new & mine).sum()), 1)
    many = stays & mine & ~new
    if params.keep == 1 or many.sum() <= count:
        return merged[stays], origin[stays], new[stays]
    from gsmap.geometry.decimate import decimate  # with scipy, which naming a recipe does without

    fewer, into = decimate(merged[many], count, visible[many])
    # One that is made of two captures' counts for the one of which more is seen.
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
    """The start fitted to the references; steps taken; whether time ran out."""
    stopping = params.stopping
    one_pass = max(stopping.min_pass_steps, round(wanted.view_weights.sum()))
    steps = params.steps if params.steps is not None else round(params.passes * one_pass)
    options = FitOptions(
        ssim_weight=params.ssim_weight, huber_delta=params.huber_delta, betas=(params.rates.momentum, 0.999)
    )
    fitter = make_fitter(start, frozen=frozen, options=options, backend=backend)
    cameras = [wanted.cameras[v] for v in range(len(wanted))]
    pictures = [fitter.load(image[None]) for image in wanted.images]
    weights = [fitter.load(weight[None]) for weight in wanted.weights]
    size_m = float(np.exp(np.median(start.log_scales.max(1))))
    losses: list[Any] = []  # as the fitter returns them: numbers, once somebody asks
    for step, view in enumerate(view_schedule(wanted.view_weights, steps, params.seed)):
        if deadline is not None and time.monotonic() > deadline:
            return fitter.gaussians(), step, True
        fitter.learning_rates = params.rates.at(step / steps, size_m)
        losses.append(fitter.step(cameras[view], pictures[view], weights[view]))
        if step % 20 == 0:
            progress(0.2 + 0.8 * step / steps, f"optimising, loss {_mean(losses[-20:]):.4f}")
        if params.steps is None and step > stopping.sure_share * steps and _gains_nothing(losses, one_pass, stopping):
            break
    return fitter.gaussians(), len(losses), False


def _mean(losses: list[Any]) -> float:
    return float(np.mean([float(loss) for loss in losses]))


def _gains_nothing(losses: list[Any], one_pass: int, stopping: Stopping) -> bool:
    """Whether the last pass over all views was hardly better than the one before."""
    if len(losses) % one_pass or len(losses) < 2 * one_pass:
        return False
    before, now = _mean(losses[-2 * one_pass : -one_pass]), _mean(losses[-one_pass:])
    return now > (1 - stopping.min_gain) * before
