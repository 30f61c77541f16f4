"""Compute blending weights of images rendered by gsplat: the dominant Gaussian of each pixel, and the largest weight of
each Gaussian.

gsplat returns neither. Its tile lists name the Gaussians that are blended into a pixel, from near to far. Blending
these once more gives both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsmap.render.cuda_kernels import launch

TILE_PX = 16


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
    shown = torch.empty((views, height, width), dtype=torch.int32, device=means2d.device)
    largest = torch.zeros(len(means2d), device=means2d.device)
    down, across = lists.starts.shape[1:]
    launch(
        *("blending_weights.cu", "blend_weights", len(starts), TILE_PX**2, means2d.contiguous(), conics.contiguous()),
        *(opacities.contiguous(), lists.listed, starts, ends, shown, largest, height, width, down, across),
        int(max_weight),
    )
    if lists.gaussian is None:
        ids = torch.where(shown >= 0, shown % num_gaussians, -1).to(torch.int32)
        return ids, largest.reshape(views, num_gaussians).amax(0) if max_weight else None
    owner = lists.gaussian.long()
    ids = torch.where(shown >= 0, owner[shown.clamp_min(0).long()], -1).to(torch.int32)
    if not max_weight:
        return ids, None
    return ids, largest.new_zeros(num_gaussians).scatter_reduce(0, owner, largest, "amax")
