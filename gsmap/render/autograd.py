"""Rendering as a torch operation."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch

from gsmap.errors import ConfigError, InputError
from gsmap.render import native
from gsmap.render.index import ChunkIndex
from gsmap.types import Cameras, Gaussians


@dataclass(frozen=True, eq=False)
class GaussianTensors:
    """N Gaussians as float32 tensors, shaped as in `gsmap.types.Gaussians`; any of them may require a gradient."""

    means: torch.Tensor
    quats: torch.Tensor
    log_scales: torch.Tensor
    logit_opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            if not isinstance(value, torch.Tensor) or value.dtype != torch.float32:
                kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
                raise InputError(f"GaussianTensors.{f.name} must be a float32 tensor, got {kind}")
            if value.device != self.means.device:
                raise InputError(f"GaussianTensors.{f.name} is on {value.device}, means are on {self.means.device}")
        n = self.means.shape[0] if self.means.ndim else 0
        expected = {"means": (n, 3), "quats": (n, 4), "log_scales": (n, 3), "logit_opacities": (n,)}
        for name, shape in expected.items():
            if tuple(getattr(self, name).shape) != shape:
                raise InputError(
                    f"GaussianTensors.{name} must have shape {shape}, got {tuple(getattr(self, name).shape)}"
                )
        sh = tuple(self.sh.shape)
        if len(sh) != 3 or sh[0] != n or sh[1] not in (1, 4, 9, 16) or sh[2] != 3:
            raise InputError(f"GaussianTensors.sh must have shape ({n}, K, 3) with K = 1, 4, 9 or 16, got {sh}")

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def of(cls, gaussians: Gaussians, device: str = "cpu", requires_grad: bool = False) -> GaussianTensors:
        """Copies of numpy Gaussians."""
        tensors = (torch.tensor(a, device=device, requires_grad=requires_grad) for a in native.arrays_of(gaussians))
        return cls(*tensors)

    def numpy(self) -> Gaussians:
        """The same as numpy Gaussians (a copy)."""
        return Gaussians(*(t.detach().cpu().numpy().copy() for t in self.tensors()))

    def tensors(self) -> tuple[torch.Tensor, ...]:
        return self.means, self.quats, self.log_scales, self.logit_opacities, self.sh


def render_tensors(
    gaussians: GaussianTensors,
    cameras: Cameras,
    T_camera_frame: torch.Tensor | None,
    background: np.ndarray,
    depth: bool,
    dominant_id: bool,
    max_weight: bool,
    index: ChunkIndex | None,
    backend: str,
) -> Any:
    """`gsmap.render.render` for tensors."""
    from gsmap.render.rendering import Rendered, gsplat_available, image_size

    if not isinstance(gaussians, GaussianTensors):
        raise InputError(f"render needs Gaussians or GaussianTensors, got {type(gaussians).__name__}")
    if T_camera_frame is None:
        pose = torch.from_numpy(cameras.T_camera_frame)
    else:
        pose = T_camera_frame
        if tuple(pose.shape) != (len(cameras), 4, 4) or not pose.is_floating_point():
            raise InputError(f"T_camera_frame must be a float tensor ({len(cameras)}, 4, 4), got {tuple(pose.shape)}")
        if not bool(torch.isfinite(pose).all()):
            raise InputError("T_camera_frame holds NaN or infinity")
    on_cuda = gaussians.means.device.type == "cuda"
    if backend != "native" and (backend == "gsplat" or on_cuda or gsplat_available()):
        from gsmap.render import gsplat

        return gsplat.render_tensors(gaussians, cameras, pose, background, depth, dominant_id, max_weight)
    if on_cuda:
        raise ConfigError("the native backend renders CPU tensors: move them to the CPU or use backend='auto'")
    width, height = image_size(cameras)
    options = (cameras.intrinsics_px, width, height, background, depth, dominant_id, max_weight, index)
    colour, alpha, depth_, dominant, weight = _Render.apply(*gaussians.tensors(), pose, options)
    return Rendered(colour, alpha, depth_, dominant, weight)


class _Render(torch.autograd.Function):
    """Keeps one native view per camera for the backward pass: about 64 bytes per visible Gaussian and view."""

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
        # Where only the pose is to be optimised, the Gaussians' gradients are not even allocated.
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
