"""Test-time optimisation: the merged map learns to look like each capture from that capture's own cameras.

Graph-GSReg's merging (voxelise the union, then minimise the difference to renders of the originals; no photographs
needed) with what measurably helps: in every cell the capture that shows most of it is the one that starts there, what
shows least goes first, newer captures win where the place changed, and exposures can be balanced.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.merge.changes import drop_what_is_gone, what_came_later
from gsmap.merge.exposure import balance_exposure
from gsmap.merge.parts import MergeResult, Part, inside, pulled_inside, united
from gsmap.merge.references import WEIGHT_UNIT, References, order_of_views, render_references
from gsmap.merge.selection import most_shown, one_owner_per_cell
from gsmap.render.fit import Fitter, LearningRates
from gsmap.types import Gaussians

# Adam's first steps, for Gaussians that are nearly right; for positions as a share of the Gaussians' median size.
_RATES = {"means": 0.035, "quats": 2e-3, "log_scales": 1e-2, "logit_opacities": 5e-2, "sh_base": 5e-3, "sh_rest": 5e-3}
_LAST_RATE = 0.1  # of the first, reached exponentially
_SSIM_WEIGHT = 0.2
_COVER_M = 0.1  # an owner's Gaussian this near stands for another capture's
_MIN_PASS = 20  # steps, for a tile that few pixels show
_SURE_SHARE = 0.5  # of the steps that are taken whatever they gain: the first, long ones may lose
_GAIN_PER_PASS = 0.002  # stop when a pass over all views lowers the loss by less than this share


@dataclass(frozen=True)
class Params:
    """Args:
    min_weight: drop what nowhere makes up this share of a pixel of its capture's own views, and dominates none.
    keep: at most this share of the Gaussians that went in, by what shows most; of each tile.
    voxel_m: side of the voxels in which Gaussians are first merged.
    cell_m: side of the cells that are given to one capture each.
    passes: how often each view is used, where steps are not given; fewer when it no longer gains.
    steps: how many optimisation steps, exactly.
    halo_m: how far around a tile its surroundings are rendered along, the outer half of it frozen.
    reach_m: how far around a tile cameras are looked for.
    longest_side_px: size of the pictures that are compared.
    balance_exposure: bring captures to one exposure first: even to the eye, but no longer what each capture looks like.
    newer_wins: drop what later captures looked through.
    seed: of the order of views.
    """

    min_weight: float = 0.05
    keep: float = 0.8
    voxel_m: float = 0.01
    cell_m: float = 0.5
    passes: float = 6.0
    steps: int | None = None
    halo_m: float = 1.0
    reach_m: float = 10.0
    longest_side_px: int = 960
    balance_exposure: bool = False
    newer_wins: bool = True
    seed: int = 0


def reach_m(params: Params) -> float:
    return params.halo_m


def reading_m(params: Params) -> float:
    return params.halo_m + params.reach_m


def merge(
    parts: list[Part],
    params: Params,
    bounds: np.ndarray | None,
    budget_s: float | None,
    progress: Callable[[float, str], None],
) -> MergeResult:
    """Drop what is gone, balance exposures, render references, choose what to keep, and fit it to the references."""
    deadline = None if budget_s is None else time.monotonic() + budget_s
    notes: list[str] = []
    later = None
    if params.newer_wins:
        parts, lost = drop_what_is_gone(parts)
        later = what_came_later(parts)
        notes += [
            f"{n} Gaussians of {p.scene_id} are gone by later captures" for p, n in zip(parts, lost, strict=True) if n
        ]
    if params.balance_exposure:
        parts, log_gains = balance_exposure(parts)
        if log_gains.any():
            notes.append(f"exposures differed by up to {np.ptp(log_gains, axis=0).max() / np.log(2):.2f} stops")
    references = render_references(
        parts, bounds, params.halo_m, params.longest_side_px, later, lambda f, text: progress(0.2 * f, text)
    )
    start, origin = _start(parts, references, params, bounds)
    if len(references) == 0 or not inside(start.means, bounds).any():
        notes.append("nothing to optimise: no camera sees it")
        return MergeResult(start, origin, notes=tuple(notes))
    # The near half of the halo is fitted along, then dropped: were it frozen, what is at the border would make up for
    # neighbours that are going to be refined too.
    frozen = ~inside(start.means, bounds, params.halo_m / 2)
    fitted, steps, truncated = _fit(start, frozen, references, params, deadline, progress)
    # A Gaussian stays with the tile it started in: one that crossed the border would be lost to both or kept by both.
    mine = inside(start.means, bounds)
    fitted = replace(fitted[mine], means=pulled_inside(fitted.means[mine], bounds))
    return MergeResult(fitted, origin[mine], steps=steps, truncated=truncated, notes=tuple(notes))


def _start(
    parts: list[Part], references: References, params: Params, bounds: np.ndarray | None
) -> tuple[Gaussians, np.ndarray]:
    """The voxelised originals within the halo, one capture per cell, and within the bounds only what shows most."""
    gaussians, origin = united(parts)
    near = inside(gaussians.means, bounds, params.halo_m)
    labels = voxel_labels(gaussians.means[near], params.voxel_m)
    merged, heaviest = merge_groups(gaussians[near], labels)
    shown = np.bincount(labels, np.concatenate(references.shown)[near], minlength=len(merged))
    origin = origin[near][heaviest]
    stays = one_owner_per_cell(merged, origin, shown, params.cell_m, _COVER_M)
    stays &= shown >= WEIGHT_UNIT * params.min_weight
    mine = inside(merged.means, bounds)
    stays &= ~mine | most_shown(shown, stays & mine, int(params.keep * inside(gaussians.means, bounds).sum()))
    return merged[stays], origin[stays]


def _fit(
    start: Gaussians,
    frozen: np.ndarray,
    references: References,
    params: Params,
    deadline: float | None,
    progress: Callable[[float, str], None],
) -> tuple[Gaussians, int, bool]:
    """The start fitted to the references; steps taken; whether time ran out."""
    one_pass = max(_MIN_PASS, round(references.turns.sum()))
    steps = params.steps if params.steps is not None else round(params.passes * one_pass)
    fitter = Fitter(start, frozen=frozen, ssim_weight=_SSIM_WEIGHT)
    cameras = [references.cameras[v] for v in range(len(references))]
    rates = _RATES | {"means": _RATES["means"] * float(np.exp(np.median(start.log_scales.max(1))))}
    losses: list[float] = []
    for step, view in enumerate(order_of_views(references.turns, steps, params.seed)):
        if deadline is not None and time.monotonic() > deadline:
            return fitter.gaussians(), step, True
        fitter.learning_rates = LearningRates(**{k: r * _LAST_RATE ** (step / steps) for k, r in rates.items()})
        losses.append(fitter.step(cameras[view], references.images[view][None], references.weights[view][None]))
        if step % 20 == 0:
            progress(0.2 + 0.8 * step / steps, f"optimising, loss {np.mean(losses[-20:]):.4f}")
        if params.steps is None and step > _SURE_SHARE * steps and _gains_nothing(losses, one_pass):
            break
    return fitter.gaussians(), len(losses), False


def _gains_nothing(losses: list[float], one_pass: int) -> bool:
    """Whether the last pass over all views was hardly better than the one before."""
    if len(losses) % one_pass or len(losses) < 2 * one_pass:
        return False
    before, now = np.mean(losses[-2 * one_pass : -one_pass]), np.mean(losses[-one_pass:])
    return bool(now > (1 - _GAIN_PER_PASS) * before)
