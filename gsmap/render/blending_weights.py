"""Compute blending weights of images rendered by gsplat: the dominant Gaussian of each pixel, and the largest weight of
each Gaussian.

gsplat returns neither. Its tile lists name the Gaussians that are blended into a pixel, from near to far. Blending
these once more gives both; a Triton kernel does it if Triton is installed, otherwise torch.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsmap.render.backends import has_triton

TILE_PX = 16
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.999  # the limit of gsplat, from version 1.5 on
MIN_TRANSMITTANCE = 1e-4


@dataclass(frozen=True, eq=False)
class TileLists:
    """Lists of Gaussians by tile, from which gsplat blended C images.

    Args:
        means2d, conics, opacities: (C, N, 2), (C, N, 3) and (C, N); or packed, with one row for each visible Gaussian
            of each image.
        gaussian: (M,) Gaussian of each packed row; None if rows are not packed.
        starts: (C, tiles down, tiles across) int32 start of the list of each tile.
        listed: rows, tile by tile, from near to far; if rows are not packed they are counted through all images.
    """

    means2d: torch.Tensor
    conics: torch.Tensor
    opacities: torch.Tensor
    gaussian: torch.Tensor | None
    starts: torch.Tensor
    listed: torch.Tensor


@torch.no_grad()
def blending_weights(
    lists: TileLists, height: int, width: int, num_gaussians: int, max_weight: bool
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Blend the projected Gaussians of gsplat once more to get their blending weights.

    Args:
        num_gaussians: N, the number of rasterized Gaussians.
        max_weight: also compute the largest weights.

    Returns:
        The (C, H, W) int32 Gaussian with the largest weight in each pixel, -1 where nothing was drawn; and the (N,)
        float32 largest weight of each Gaussian in any pixel of any view, or None.
    """
    views = len(lists.starts)
    means2d = lists.means2d.detach().reshape(-1, 2)
    if not len(lists.listed):
        ids = torch.full((views, height, width), -1, dtype=torch.int32, device=means2d.device)
        return ids, means2d.new_zeros(num_gaussians) if max_weight else None
    conics = lists.conics.detach().reshape(-1, 3)
    opacities = lists.opacities.detach().reshape(-1)
    starts = lists.starts.reshape(-1)
    ends = torch.cat([starts[1:], starts.new_tensor([len(lists.listed)])])
    blend = _by_triton if means2d.is_cuda and has_triton() else _by_torch
    shown, largest = blend(
        means2d, conics, opacities, lists.listed, starts, ends, (views, height, width), TILE_PX, max_weight
    )
    if lists.gaussian is None:
        ids = torch.where(shown >= 0, shown % num_gaussians, -1).to(torch.int32)
        return ids, None if largest is None else largest.reshape(views, num_gaussians).amax(0)
    owner = lists.gaussian.long()
    ids = torch.where(shown >= 0, owner[shown.clamp_min(0)], -1).to(torch.int32)
    if largest is None:
        return ids, None
    return ids, largest.new_zeros(num_gaussians).scatter_reduce(0, owner, largest, "amax")


def _by_torch(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    opacities: torch.Tensor,
    listed: torch.Tensor,
    starts: torch.Tensor,
    ends: torch.Tensor,
    shape: tuple[int, int, int],
    size: int,
    max_weight: bool,
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Blend all tiles in parallel, the k-th Gaussian of each tile at once; return the (C, H, W) int64 dominant row, and
    the (M,) largest weights."""
    views, height, width = shape
    where = means2d.device
    down, across = -(-height // size), -(-width // size)
    tile = torch.arange(views * down * across, device=where)
    inner = torch.arange(size, device=where)
    rows = (tile // across % down)[:, None] * size + inner  # (T, size)
    columns = (tile % across)[:, None] * size + inner
    x = (columns + 0.5)[:, None, :].expand(-1, size, -1).flatten(1)  # (T, size^2)
    y = (rows + 0.5)[:, :, None].expand(-1, -1, size).flatten(1)
    alive = ((columns < width)[:, None, :] & (rows < height)[:, :, None]).flatten(1)
    clear, best = torch.ones_like(x), torch.zeros_like(x)
    shown = torch.full(x.shape, -1, dtype=torch.int64, device=where)
    largest = torch.zeros(len(means2d), device=where) if max_weight else None
    count = ends - starts
    for k in range(int(count.max()) if len(count) else 0):
        at = torch.nonzero(count > k)[:, 0]
        row = listed[starts[at] + k].long()
        dx, dy = x[at] - means2d[row, :1], y[at] - means2d[row, 1:]
        a, b, c = conics[row].unsqueeze(2).unbind(1)
        power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
        alpha = (opacities[row, None] * torch.exp(-power)).clamp_max(MAX_ALPHA)
        hit = alive[at] & (power >= 0) & (alpha >= MIN_ALPHA)
        behind = clear[at] * (1 - alpha)
        drawn = hit & (behind > MIN_TRANSMITTANCE)
        alive[at] &= ~hit | drawn
        weight = torch.where(drawn, alpha * clear[at], 0)
        clear[at] = torch.where(drawn, behind, clear[at])
        if largest is not None:
            largest.scatter_reduce_(0, row, weight.amax(1), "amax")
        better = weight > best[at]
        shown[at] = torch.where(better, row[:, None], shown[at])
        best[at] = torch.where(better, weight, best[at])
    image = shown.reshape(views, down, across, size, size).permute(0, 1, 3, 2, 4)
    return image.reshape(views, down * size, across * size)[:, :height, :width], largest


def _by_triton(
    means2d: torch.Tensor,
    conics: torch.Tensor,
    opacities: torch.Tensor,
    listed: torch.Tensor,
    starts: torch.Tensor,
    ends: torch.Tensor,
    shape: tuple[int, int, int],
    size: int,
    max_weight: bool,
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """Compute `_by_torch` with one warp per tile."""
    from gsmap.render.triton_kernels import blend_tile

    _, height, width = shape
    shown = torch.empty(shape, dtype=torch.int32, device=means2d.device)
    largest = torch.zeros(len(means2d), device=means2d.device)
    if len(starts):
        blend_tile[(len(starts),)](
            means2d.contiguous(),
            conics.contiguous(),
            opacities.contiguous(),
            listed,
            starts,
            ends,
            shown,
            largest,
            height,
            width,
            -(-height // size),
            -(-width // size),
            SIZE=size,
            MAX_WEIGHT=max_weight,
            MIN_ALPHA=MIN_ALPHA,
            MAX_ALPHA=MAX_ALPHA,
            MIN_TRANSMITTANCE=MIN_TRANSMITTANCE,
            num_warps=1,
        )
    return shown.long(), largest if max_weight else None
