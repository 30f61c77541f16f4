"""Train Gaussians on posed frames with gsmap's own renderer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from gsmap.demo.capture import Frames
from gsmap.types import Gaussians


@dataclass(frozen=True)
class Params:
    """How Gaussians are trained.

    Args:
        steps: one frame each, in shuffled rounds.
        ssim_weight: share of SSIM in the loss; the rest is L1.
        rounds: how often Gaussians that show nothing move to where the picture is worst.
        moved: the largest share of Gaussians that moves in one round.
    """

    steps: int = 600
    ssim_weight: float = 0.0
    rounds: int = 4
    moved: float = 0.05


def train(
    gaussians: Gaussians,
    frames: Frames,
    params: Params | None = None,
    *,
    seed: int = 0,
    progress: Callable[[float, str], None] | None = None,
) -> Gaussians:
    """Fit Gaussians to frames; their number stays about the same.

    Step sizes follow the Gaussians' own size, so any unit of length trains alike, and fall to a tenth in the end.
    """
    from gsmap.render.fit import Fitter, LearningRates

    params = params or Params()
    unit = float(np.median(gaussians.scales.max(1)))
    first = LearningRates(
        means=0.02 * unit, quats=6e-3, log_scales=0.03, logit_opacities=0.09, sh_base=0.03, sh_rest=0.0015
    )
    fitter = Fitter(gaussians, first, ssim_weight=params.ssim_weight, statistics=params.rounds > 0)
    rng = np.random.default_rng([seed, 7])
    # Nothing moves in the last third: what is new needs time to settle.
    moves = set(np.linspace(0, 0.67 * params.steps, params.rounds + 1).astype(int)[1:].tolist())
    order: list[int] = []
    for step in range(params.steps):
        if step in moves:
            _move_useless(fitter, params.moved, rng)
        order = order or rng.permutation(len(frames)).tolist()
        i = order.pop()
        fitter.learning_rates = _scaled(first, 0.1 ** (step / params.steps))
        loss = fitter.step(frames.cameras[i], frames.images[i : i + 1])
        if progress and step % 20 == 0:
            progress(step / params.steps, f"training, step {step}/{params.steps}, loss {loss:.3f}")
    return _tidy(fitter.gaussians())


def _scaled(rates, factor: float):
    from dataclasses import astuple

    return type(rates)(*(factor * r for r in astuple(rates)))


def _move_useless(fitter, share: float, rng: np.random.Generator) -> None:
    """Drop Gaussians that no pixel shows, and split as many of those whose place in the picture is least settled."""
    visible = fitter.max_weight
    count = min(int(share * len(fitter)), int((visible < 0.02).sum()))
    if count:
        useless = np.argsort(visible, kind="stable")[:count]
        need = fitter.gradient_norm / np.maximum(fitter.seen, 1)
        need[useless] = -1
        split = np.argsort(-need, kind="stable")[:count]
        parents = fitter.gaussians()[split]
        gone = np.zeros(len(fitter), bool)
        gone[useless] = gone[split] = True
        fitter.keep(~gone)
        fitter.append(_split(parents, rng))
    fitter.reset_statistics()


def _split(parents: Gaussians, rng: np.random.Generator) -> Gaussians:
    """Two smaller Gaussians in the place of each, apart along its longest axis."""
    from gsmap.geometry.rotations import quats_to_matrices

    rotation = quats_to_matrices(parents.quats)
    axis = parents.scales.argmax(1)
    rows = np.arange(len(parents))
    way = rotation[rows, :, axis] * (parents.scales[rows, axis] * 0.6)[:, None]
    log_scales = parents.log_scales.copy()
    log_scales[rows, axis] -= np.log(1.8)
    halves = [
        Gaussians(parents.means + sign * way, parents.quats, log_scales, parents.logit_opacities, parents.sh)
        for sign in (1, -1)
    ]
    return Gaussians.concatenate(halves)


def _tidy(gaussians: Gaussians) -> Gaussians:
    """Without what is too transparent to be drawn, quaternions of unit length."""
    kept = gaussians[gaussians.opacities > 1 / 255]
    quats = kept.quats / np.maximum(np.linalg.norm(kept.quats, axis=1, keepdims=True), 1e-12)
    return Gaussians(kept.means, quats, kept.log_scales, kept.logit_opacities, kept.sh)
