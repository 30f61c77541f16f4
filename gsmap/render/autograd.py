"""Rendering on the CPU as a differentiable torch operation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from gsmap.errors import ConfigError
from gsmap.render import native
from gsmap.render.index import ChunkIndex
from gsmap.render.outputs import Rendering, image_size
from gsmap.render.tensors import GaussianTensors
from gsmap.types import Cameras


def render_tensors(
    gaussians: GaussianTensors,
    cameras: Cameras,
    T_camera_frame: torch.Tensor,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
    index: ChunkIndex | None,
) -> Rendering:
    """Run `gsmap.render.render` for tensors on the CPU."""
    if gaussians.means.device.type == "cuda":
        raise ConfigError(
            "the native backend renders CPU tensors: move them to the CPU or use backend='auto'",
            code="unsupported_backend",
        )
    width, height = image_size(cameras)
    options = (cameras.intrinsics_px, width, height, background, depth, dominant_id, max_weight, index)
    return Rendering(*_Render.apply(*gaussians.tensors(), T_camera_frame, options))


class _Render(torch.autograd.Function):
    """Torch function that keeps one native view per camera for the backward pass: about 64 bytes per visible Gaussian
    and view."""

    @staticmethod
    def forward(ctx: Any, *args: Any) -> tuple[torch.Tensor | None, ...]:
        tensors, pose, options = args[:5], args[5], args[6]
        intrinsics, width, height, background, depth, dominant_id, max_weight, index = options
        ctx.set_materialize_grads(False)
        arrays = tuple(t.detach().contiguous().numpy() for t in tensors)
        pose64 = pose.detach().to(torch.float64).cpu().numpy()
        images = native.allocate(len(pose), height, width, len(arrays[0]), depth, dominant_id, max_weight)
        keep = any(ctx.needs_input_grad)
        views = [native.View() for _ in range(len(pose) if keep else min(1, len(pose)))]
        for i in range(len(pose)):
            view = views[i if keep else 0]
            native.forward(view, arrays, pose64[i], intrinsics[i], background, images, i, index)
        out = tuple(
            None if images[name] is None else torch.from_numpy(images[name])
            for name in ("colour", "alpha", "depth", "dominant_id", "max_weight")
        )
        if keep:
            ctx.views, ctx.background = views, background
            ctx.save_for_backward(*tensors, pose, out[0], out[1], *(out[2:3] if depth else ()))
        ctx.mark_non_differentiable(*(t for t in out[3:] if t is not None))
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        g_colour, g_alpha, g_depth = (None if g is None else g.contiguous().numpy() for g in gradients[:3])
        *tensors, pose, colour, alpha = ctx.saved_tensors[:8]
        depth = ctx.saved_tensors[8].numpy() if len(ctx.saved_tensors) > 8 else None
        arrays = tuple(t.detach().contiguous().numpy() for t in tensors)
        # If only the pose is optimized, gradients of the Gaussians are not even allocated.
        out = [np.zeros_like(a) for a in arrays] if any(ctx.needs_input_grad[:5]) else None
        g_pose = np.zeros((len(pose), 4, 4)) if ctx.needs_input_grad[5] else None
        if not (g_colour is None and g_alpha is None and g_depth is None):
            for i, view in enumerate(ctx.views):
                view.backward(
                    *arrays,
                    background=ctx.background,
                    colour=colour[i].numpy(),
                    depth=None if depth is None else depth[i],
                    alpha=alpha[i].numpy(),
                    g_colour=None if g_colour is None else g_colour[i],
                    g_depth=None if g_depth is None else g_depth[i],
                    g_alpha=None if g_alpha is None else g_alpha[i],
                    gradients=out,
                    g_pose=None if g_pose is None else g_pose[i, :3],
                )
        pose_gradient = None if g_pose is None else torch.from_numpy(g_pose).to(pose)
        inputs = (None,) * 5 if out is None else tuple(torch.from_numpy(g) for g in out)
        return (*inputs, pose_gradient, None)
