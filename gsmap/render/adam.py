"""Adam (Kingma & Ba 2015) on the GPU, where each Gaussian counts its own updates."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from gsmap.render.backends import has_triton
from gsmap.render.fitter import LearningRates

_ROWS = 64


def corrections(betas: tuple[float, float], device: torch.device) -> torch.Tensor:
    """Return the bias corrections by number of updates, (T, 2): for the mean and for the root of the mean square; from
    the last row on they are 1."""
    count = max(2, math.ceil(math.log(1e-8) / math.log(max(*betas, 0.5))))
    t = torch.arange(count, dtype=torch.float64).clamp_min(1)
    beta1, beta2 = betas
    return torch.stack([1 / (1 - beta1**t), 1 / (1 - beta2**t).sqrt()], 1).float().to(device)


def rates_on(rates: LearningRates, device: torch.device) -> torch.Tensor:
    """Return learning rates as (6,) float32, in the order of their fields."""
    return torch.tensor([*vars(rates).values()], dtype=torch.float32, device=device)


def touched(gradients: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return an (N,) mask of Gaussians whose gradient is not zero; of colours only the mean colour is tested."""
    means, quats, scales, opacities, sh = gradients
    found = (means != 0).any(1) | (quats != 0).any(1) | (scales != 0).any(1) | (opacities != 0)
    return found | (sh[:, 0] != 0).any(1)


@torch.no_grad()
def step(
    values: list[torch.Tensor],
    gradients: list[torch.Tensor],
    moments: list[list[torch.Tensor]],
    scales: torch.Tensor,
    opacities: torch.Tensor,
    frozen: torch.Tensor,
    updates: torch.Tensor,
    table: torch.Tensor,
    rates: torch.Tensor,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Step every Gaussian that has a gradient and is not frozen, in place.

    Args:
        values: means, quats, log_scales, logit_opacities and sh.
        gradients: gradients with respect to means, quats, ``scales``, ``opacities`` and sh.
        moments: two lists of moments, each in the order of the values.
        updates: (N,) int32 number of updates of each Gaussian, which is increased.
        table: `corrections` of the betas.
        rates: `rates_on` the device of the values.
    """
    by = _by_triton if values[0].is_cuda and has_triton() else _by_torch
    by(values, gradients, moments, scales, opacities, frozen, updates, table, rates, betas, epsilon)


def _by_torch(
    values: list[torch.Tensor],
    gradients: list[torch.Tensor],
    moments: list[list[torch.Tensor]],
    scales: torch.Tensor,
    opacities: torch.Tensor,
    frozen: torch.Tensor,
    updates: torch.Tensor,
    table: torch.Tensor,
    rates: torch.Tensor,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    rows = torch.nonzero(touched(gradients) & ~frozen)[:, 0]
    updates[rows] += 1
    first, second = table[updates[rows].long().clamp_max(len(table) - 1)].unbind(1)
    sh_rate = rates[5].repeat(values[4].shape[1], 1)
    sh_rate[0] = rates[4]
    steps = (*rates[:4], sh_rate)
    chain = (None, None, scales, opacities * (1 - opacities), None)  # chain rule to logarithms and logits
    for value, gradient, m, v, rate, inner in zip(values, gradients, *moments, steps, chain, strict=True):
        g = gradient[rows] if inner is None else gradient[rows] * inner[rows]
        mean, square = torch.lerp(g, m[rows], betas[0]), torch.lerp(g.square(), v[rows], betas[1])
        m[rows], v[rows] = mean, square
        shape = (-1, *[1] * (value.ndim - 1))
        value[rows] -= rate * first.view(shape) * mean / (square.sqrt() * second.view(shape) + epsilon)


def _by_triton(
    values: list[torch.Tensor],
    gradients: list[torch.Tensor],
    moments: list[list[torch.Tensor]],
    scales: torch.Tensor,
    opacities: torch.Tensor,
    frozen: torch.Tensor,
    updates: torch.Tensor,
    table: torch.Tensor,
    rates: torch.Tensor,
    betas: tuple[float, float],
    epsilon: float,
) -> None:
    """Compute `_by_torch` in one kernel launch."""
    from gsmap.render.triton_kernels import adam_rows

    n, columns = len(values[0]), 3 * values[4].shape[1]
    counted = torch.empty_like(updates)
    adam_rows[(-(-n // _ROWS),)](
        *values,
        *(gradient.contiguous() for gradient in gradients),
        *moments[0],
        *moments[1],
        *(scales, opacities, frozen.view(torch.uint8), updates, counted, table, len(table) - 1, n, rates),
        *(*betas, epsilon),
        SH=columns,
        SH_PADDED=1 << (columns - 1).bit_length(),
        ROWS=_ROWS,
    )
    updates.copy_(counted)
