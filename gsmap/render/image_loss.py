"""The image loss and its gradient in torch, equal to those of the native kernel (`gsmap/native/fit.cpp`)."""

from __future__ import annotations

import functools
from typing import Any

import torch
import torch.nn.functional as F

from gsmap.render.backends import has_triton

# Wang et al. 2004: a Gaussian with sigma 1.5 and 11 taps; values outside the image are zero.
_REACH = 5
_HALF = (0.00102838, 0.00759876, 0.03600077, 0.10936069, 0.21300554)
_WINDOW = (*_HALF, 0.26601173, *_HALF[::-1])
_C1, _C2 = 0.01**2, 0.03**2


@torch.no_grad()
def image_loss(
    images: torch.Tensor,
    targets: torch.Tensor,
    masks: torch.Tensor | None,
    ssim_weight: float,
    huber_delta: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute ``(1 - s) * Huber + s * (1 - SSIM)`` of images, each a mean over its pixels weighted by a mask.

    Args:
        images: (V, H, W, 3) float32 images.
        targets: (V, H, W, 3) float32 in [0, 1], or uint8.
        masks: (V, H, W) weights, float32 in [0, 1] or uint8, or None; a view whose weights are all 0 has no loss.
        huber_delta: differences below this count by their square; 0 gives the L1 loss.

    Returns:
        The (V,) losses, and the gradient (V, H, W, 3) of their mean with respect to the images.
    """
    if images.is_cuda and has_triton():
        return _by_triton(images.contiguous(), targets, masks, ssim_weight, huber_delta)
    return _by_torch(images, _scaled(targets), None if masks is None else _scaled(masks), ssim_weight, huber_delta)


class KnownLoss(torch.autograd.Function):
    """A scalar of value 0 whose gradient with respect to an image is known.

    Given to `torch.autograd.grad` itself, a gradient lets torch import sympy, which takes seconds.
    """

    @staticmethod
    def forward(ctx: Any, image: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(gradient)
        return image.new_zeros(())

    @staticmethod
    def backward(ctx: Any, *_: torch.Tensor) -> tuple[torch.Tensor, None]:
        return ctx.saved_tensors[0], None


def _scaled(values: torch.Tensor) -> torch.Tensor:
    return values / 255.0 if values.dtype == torch.uint8 else values.float()


def _by_torch(
    images: torch.Tensor,
    targets: torch.Tensor,
    masks: torch.Tensor | None,
    ssim_weight: float,
    huber_delta: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    weights = images.new_ones(images.shape[:3]) if masks is None else masks
    total = weights.sum((1, 2))
    per_value = torch.where(total > 0, 1 / (3 * total), 0)[:, None, None, None]
    weights = weights[..., None]
    difference = images - targets
    size = difference.abs()
    if huber_delta > 0:
        near = size < huber_delta
        loss = torch.where(near, difference.square() / (2 * huber_delta), size - huber_delta / 2)
        slope = torch.where(near, difference / huber_delta, difference.sign())
    else:
        loss, slope = size, difference.sign()
    scale = (1 - ssim_weight) * per_value
    losses = (scale * weights * loss).sum((1, 2, 3))
    gradient = scale * weights * slope
    if ssim_weight > 0:
        similarity, slope = _structural_similarity(images, targets, weights)
        losses = losses + ssim_weight * ((total > 0).float() - (per_value * similarity).sum((1, 2, 3)))
        gradient = gradient - ssim_weight * per_value * slope
    return losses, gradient / len(images)


_BLOCK = 1024


def _by_triton(
    images: torch.Tensor,
    targets: torch.Tensor,
    masks: torch.Tensor | None,
    ssim_weight: float,
    huber_delta: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute `_by_torch` in four kernel launches per view."""
    from gsmap.render.triton_kernels import loss_gradient, slope_columns, ssim_columns, ssim_rows

    views, height, width, _ = images.shape
    if masks is not None and masks.dtype != torch.uint8:
        masks = masks.float()
    window = _window_on(images.device)
    grid = (height, -(-3 * width // _BLOCK))
    with_ssim = ssim_weight > 0
    maps = torch.empty((8 if with_ssim else 0, height, width, 3), device=images.device)
    sums = torch.zeros((views, 3), device=images.device)
    losses, gradient = torch.empty(views, device=images.device), torch.empty_like(images)
    kind = {"BYTES": targets.dtype == torch.uint8, "BLOCK": _BLOCK}
    masked = {"MASKED": masks is not None, "MASK_BYTES": masks is not None and masks.dtype == torch.uint8}
    for v in range(views):
        image, target, mask = images[v], targets[v], sums if masks is None else masks[v]
        if with_ssim:
            ssim_columns[grid](image, target, maps, window, height, 3 * width, **kind)
        ssim_rows[grid](
            *(image, target, mask, maps, maps[5:], sums[v], window, height, 3 * width, huber_delta),
            SSIM=with_ssim,
            **kind,
            **masked,
        )
        if with_ssim:
            slope_columns[grid](maps[5:], maps, window, height, 3 * width, BLOCK=_BLOCK)
        loss_gradient[grid](
            *(image, target, mask, maps, sums[v], window, gradient[v], losses[v:], height, 3 * width),
            *(ssim_weight, huber_delta, 1.0 / views),
            SSIM=with_ssim,
            **kind,
            **masked,
        )
    return losses, gradient


@functools.cache
def _window_on(device: torch.device) -> torch.Tensor:
    return torch.tensor(_WINDOW, device=device)


def _structural_similarity(
    images: torch.Tensor, targets: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Compute SSIM (V, H, W, 3) times weights (V, H, W, 1), and the gradient of its sum with respect to the images."""
    a, b = images.permute(0, 3, 1, 2), targets.permute(0, 3, 1, 2)
    mean_a, mean_b, aa, bb, ab = _blurred(torch.cat([a, b, a * a, b * b, a * b], 1)).split(3, 1)
    w = weights.permute(0, 3, 1, 2)
    light = 2 * mean_a * mean_b + _C1
    structure = 2 * (ab - mean_a * mean_b) + _C2
    light_norm = mean_a.square() + mean_b.square() + _C1
    structure_norm = (aa - mean_a.square()) + (bb - mean_b.square()) + _C2
    inverse = 1 / (light_norm * structure_norm)
    value = light * structure * inverse
    by_ab = 2 * light * inverse
    by_aa = -value / structure_norm
    by_a = 2 * mean_b * structure * inverse - 2 * mean_a * value / light_norm - by_ab * mean_b - 2 * by_aa * mean_a
    by_a, by_aa, by_ab = _blurred(torch.cat([w * by_a, w * by_aa, w * by_ab], 1)).split(3, 1)
    gradient = by_a + 2 * a * by_aa + b * by_ab
    return (w * value).permute(0, 2, 3, 1), gradient.permute(0, 2, 3, 1)


def _blurred(maps: torch.Tensor) -> torch.Tensor:
    """Blur maps (V, C, H, W) by the window, in full float32 precision, because a variance is the difference of two
    nearly equal numbers."""
    channels = maps.shape[1]
    window = torch.tensor(_WINDOW, dtype=maps.dtype, device=maps.device)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        down = F.conv2d(maps, window.view(1, 1, -1, 1).expand(channels, 1, -1, 1), padding=(_REACH, 0), groups=channels)
        return F.conv2d(down, window.view(1, 1, 1, -1).expand(channels, 1, 1, -1), padding=(0, _REACH), groups=channels)
