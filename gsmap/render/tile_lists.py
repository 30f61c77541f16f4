"""List the Gaussians of every tile of one view in tensors of fixed size, which gsplat's own lists are not.

The order is gsplat's: tile by tile, from near to far, equal depths by index.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsmap.render.blending_weights import TILE_PX


@dataclass(frozen=True, eq=False)
class TouchedTiles:
    """Tiles that N Gaussians touch, from the nearest Gaussian to the farthest.

    Args:
        gaussian: (N,) int64 index of each Gaussian.
        left, wide, top, high: (N,) int32 first column, number of columns, first row and number of rows of tiles.
        upto: (N,) int64 number of tiles of this and all nearer Gaussians.
    """

    gaussian: torch.Tensor
    left: torch.Tensor
    wide: torch.Tensor
    top: torch.Tensor
    high: torch.Tensor
    upto: torch.Tensor


@torch.no_grad()
def touched_tiles(
    means2d: torch.Tensor, radii: torch.Tensor, depths: torch.Tensor, down: int, across: int
) -> TouchedTiles:
    """Find the tiles that projected Gaussians touch, of ``down`` rows of ``across`` tiles.

    Args:
        means2d: (N, 2) pixels.
        radii: (N, 2) int32 pixels, 0 if a Gaussian is not visible.
        depths: (N,).
    """
    nearest = torch.sort(depths, stable=True).indices
    center, radius = means2d[nearest], radii[nearest]
    shown = (radius > 0).all(1)
    left, wide = _span(center[:, 0], radius[:, 0], across)
    top, high = _span(center[:, 1], radius[:, 1], down)
    return TouchedTiles(nearest, left, wide, top, high, torch.where(shown, wide * high, 0).cumsum(0))


def _span(center: torch.Tensor, radius: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    first = torch.floor((center - radius) / TILE_PX).clamp(0, count).int()
    return first, torch.ceil((center + radius) / TILE_PX).clamp(0, count).int() - first


@torch.no_grad()
def tile_lists(touched: TouchedTiles, capacity: int, down: int, across: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Sort at most ``capacity`` touched tiles into lists.

    Returns:
        The (capacity,) int32 listed Gaussians, and the (down + 1, across) int32 start of the list of each tile. What
        exceeds the real lists belongs to the first tile of the last row, which lies below the image.
    """
    where = touched.upto.device
    slot = torch.arange(capacity, device=where)
    row = torch.searchsorted(touched.upto, slot, right=True).clamp_max(len(touched.upto) - 1)
    wide = touched.wide[row].clamp_min(1)
    inner = (slot - touched.upto[row]).int() + wide * touched.high[row]
    tile = (touched.top[row] + inner // wide) * across + touched.left[row] + inner % wide
    below = down * across
    tile = torch.where(slot < touched.upto[-1], tile, below)
    tile, by_tile = torch.sort(tile.to(torch.int16 if below + across < 1 << 15 else torch.int32), stable=True)
    starts = torch.searchsorted(tile, torch.arange(below + across, device=where, dtype=tile.dtype), out_int32=True)
    return touched.gaussian[row[by_tile]].int(), starts.view(down + 1, across)
