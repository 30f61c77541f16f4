"""The CUDA backend: nerfstudio's gsplat, an optional dependency (``pip install gsmap[cuda]``)."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsmap.errors import MissingDependencyError
from gsmap.render.outputs import Rendered, image_size
from gsmap.render.tensors import GaussianTensors
from gsmap.types import Cameras, Gaussians


def render_numpy(
    gaussians: Gaussians, cameras: Cameras, background: np.ndarray, depth: bool, dominant_id: bool, max_weight: bool
) -> Rendered:
    """`gsmap.render.render` for numpy Gaussians, by way of the GPU."""
    with torch.no_grad():
        tensors = GaussianTensors.of(gaussians, device="cuda")
        pose = torch.from_numpy(cameras.T_camera_frame)
        out = render_tensors(tensors, cameras, pose, background, depth, dominant_id, max_weight)
    names = ("colour", "alpha", "depth", "dominant_id", "max_weight")
    return Rendered(*(None if getattr(out, n) is None else getattr(out, n).cpu().numpy() for n in names))


def render_tensors(
    gaussians: GaussianTensors,
    cameras: Cameras,
    T_camera_frame: torch.Tensor,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
) -> Rendered:
    """`gsmap.render.render` for tensors; those on the CPU go to the GPU and the answer comes back."""
    try:
        from gsplat import rasterization
    except ImportError as error:
        raise MissingDependencyError("rendering on CUDA needs gsplat: pip install 'gsmap[cuda]'") from error
    width, height = image_size(cameras)
    home = gaussians.means.device
    device = home if home.type == "cuda" else torch.device("cuda")
    means, quats, log_scales, logits, sh = (t.to(device) for t in gaussians.tensors())
    views, n = len(T_camera_frame), len(means)
    if views == 0 or n == 0:
        return _nothing(views, height, width, n, background, depth, dominant_id, max_weight, home)
    # gsplat has no word for a Gaussian that cannot be drawn; the native backend leaves it out.
    sound = torch.isfinite(torch.cat([means, quats, sh.flatten(1)], 1)).all(1)
    sound &= ~(torch.isnan(log_scales) | (log_scales >= 80)).any(1) & ~torch.isnan(logits)
    rows = torch.nonzero(sound)[:, 0]
    if len(rows) < n:
        means, quats, log_scales, logits, sh = (t[rows] for t in (means, quats, log_scales, logits, sh))
    identity = torch.tensor([1.0, 0, 0, 0], device=device)
    quats = torch.where(quats.square().sum(1, keepdim=True) > 1e-30, quats, identity)
    image, alpha, meta = rasterization(
        means,
        quats,
        log_scales.exp(),
        torch.sigmoid(logits),
        sh,
        T_camera_frame.to(device=device, dtype=torch.float32),
        torch.tensor(cameras.K, device=device, dtype=torch.float32),
        width,
        height,
        near_plane=0.01,
        eps2d=0.3,
        sh_degree={1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]],
        packed=False,
        render_mode="RGB+ED" if depth else "RGB",
    )
    behind = torch.tensor(background, device=device)
    colour = image[..., :3] + (1 - alpha) * behind
    ids: torch.Tensor | None = None
    weights: torch.Tensor | None = None
    if dominant_id or max_weight:
        found = _weights(meta, views, height, width, rows, n)
        ids, weights = found[0].to(home) if dominant_id else None, found[1].to(home) if max_weight else None
    return Rendered(
        colour.to(home),
        alpha[..., 0].to(home),
        image[..., 3].to(home) if depth else None,
        ids,
        weights,
    )


@torch.no_grad()
def _weights(
    meta: dict[str, Any], views: int, height: int, width: int, rows: torch.Tensor, n: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Dominant Gaussian (C, H, W) int32 of every pixel and largest weight (N,) of every Gaussian.

    gsplat lists the Gaussians of each pixel, near to far; their weights are computed again from what it projected.
    """
    from gsplat.cuda._wrapper import rasterize_to_indices_in_range

    means2d, conics, opacities = meta["means2d"], meta["conics"], meta["opacities"]
    clear = torch.ones(views, height, width, device=means2d.device)
    gaussian, pixel, image = rasterize_to_indices_in_range(
        0,
        1 << 30,
        clear,
        means2d,
        conics,
        opacities.expand(views, -1),
        width,
        height,
        meta["tile_size"],
        meta["isect_offsets"],
        meta["flatten_ids"],
    )
    ids = torch.full((views * height * width,), -1, dtype=torch.int32, device=means2d.device)
    weights = torch.zeros(n, device=means2d.device)
    if len(gaussian) == 0:
        return ids.reshape(views, height, width), weights
    cell = image * (height * width) + pixel
    order = torch.argsort(cell, stable=True)  # stable: near to far within a pixel
    gaussian, pixel, image, cell = gaussian[order], pixel[order], image[order], cell[order]
    centre = torch.stack([pixel % width, pixel // width], 1) + 0.5
    d = centre - means2d[image, gaussian]
    a, b, c = conics[image, gaussian].unbind(1)
    power = 0.5 * (a * d[:, 0] ** 2 + c * d[:, 1] ** 2) + b * d[:, 0] * d[:, 1]
    alpha = (opacities.expand(views, -1)[image, gaussian] * torch.exp(-power)).clamp_max(0.99).double()
    # Transmittance before each: a running sum of logarithms, less its value where the pixel begins.
    log_t = torch.log1p(-alpha)
    before = torch.cumsum(log_t, 0) - log_t
    first = torch.cat([cell.new_ones(1, dtype=torch.bool), cell[1:] != cell[:-1]])
    start = torch.cummax(torch.where(first, torch.arange(len(cell), device=cell.device), 0), 0).values
    weight = (alpha * torch.exp(before - before[start])).float()
    weights.scatter_reduce_(0, rows[gaussian], weight, "amax")
    best = torch.zeros(len(ids), device=ids.device).scatter_reduce_(0, cell, weight, "amax")
    # Reversed, so that the nearest of equals is written last.
    winner = torch.nonzero(weight == best[cell])[:, 0].flip(0)
    ids[cell[winner]] = rows[gaussian[winner]].to(torch.int32)
    return ids.reshape(views, height, width), weights


def _nothing(
    views: int,
    height: int,
    width: int,
    n: int,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
    device: torch.device,
) -> Rendered:
    shape = (views, height, width)
    return Rendered(
        torch.tensor(background, device=device).expand(*shape, 3).clone(),
        torch.zeros(shape, device=device),
        torch.zeros(shape, device=device) if depth else None,
        torch.full(shape, -1, dtype=torch.int32, device=device) if dominant_id else None,
        torch.zeros(n, device=device) if max_weight else None,
    )
