"""Train Gaussians on posed frames with gsmap's own renderer."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from gsmap.types import Gaussians
from gsmap.types.progress import Progress
from gsmap_synthetic.capture import Frames


@dataclass(frozen=True)
class Params:
    """How Gaussians are trained.

    Args:
        steps: one frame each, in shuffled rounds.
        ssim_weight: share of SSIM in the loss; the rest is L1.
        splits: how often Gaussians are split where the pictures are least settled. A start from depth needs none
            (measured: the same PSNR as starting with as many Gaussians); a start from colour alone does.
        split_share: of the Gaussians at the start, split each time.
    """

    steps: int = 600
    ssim_weight: float = 0.2
    splits: int = 0
    split_share: float = 0.1


def train(
    gaussians: Gaussians,
    frames: Frames,
    params: Params | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> Gaussians:
    """Fit Gaussians to frames.

    Step sizes follow the Gaussians' own size, so any unit of length trains alike, and fall to a tenth in the end.
    """
    from gsmap.render.fit import make_fitter
    from gsmap.render.fitter import FitOptions, LearningRates

    params = params or Params()
    unit = float(np.median(gaussians.scales.max(1)))
    first = LearningRates(
        means=0.04 * unit, quats=0.012, log_scales=0.06, logit_opacities=0.18, sh_base=0.06, sh_rest=0.003
    )
    options = FitOptions(ssim_weight=params.ssim_weight, statistics=params.splits > 0)
    fitter = make_fitter(gaussians, first, options=options)
    rng = np.random.default_rng([seed, 7])
    # No splits in the last third: what is new needs time to settle.
    moments = set(np.linspace(0, 2 / 3 * params.steps, params.splits + 1).astype(int)[1:].tolist())
    order: list[int] = []
    for step in range(params.steps):
        if step in moments:
            _split_the_worst(fitter, int(params.split_share * len(gaussians)))
        order = order or rng.permutation(len(frames)).tolist()
        i = order.pop()
        fitter.learning_rates = _scaled(first, 0.1 ** (step / params.steps))
        loss = fitter.step(frames.cameras[i], frames.images[i : i + 1])
        if progress and step % 20 == 0:
            progress(step / params.steps, f"training, step {step}/{params.steps}, loss {float(loss):.3f}")
    return _tidy(fitter.gaussians())


def _scaled(rates, factor: float):
    return type(rates)(*(factor * r for r in astuple(rates)))


def _split_the_worst(fitter, count: int) -> None:
    """Drop Gaussians that no pixel shows; split the ``count`` whose places in the pictures are least settled."""
    counted = fitter.statistics()
    need = counted.gradient_norm / np.maximum(counted.seen, 1)
    split = np.argsort(-need, kind="stable")[:count]
    gone = counted.max_weight < 0.02
    gone[split] = True
    parents = fitter.gaussians()[split]
    fitter.keep(~gone)
    fitter.append(_halves(parents))


def _halves(parents: Gaussians) -> Gaussians:
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
