"""Render Gaussians: one function for all backends, numpy and torch."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from gsmap.errors import InputError
from gsmap.render import backends, native
from gsmap.render.index import ChunkIndex
from gsmap.render.outputs import Rendering, image_size
from gsmap.types import Cameras, Gaussians
from gsmap.types.tensors import require_torch

if TYPE_CHECKING:
    import torch

    from gsmap.render.tensors import GaussianTensors

logger = logging.getLogger(__name__)


def render(
    gaussians: Gaussians | GaussianTensors,
    cameras: Cameras,
    *,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    depth: bool = True,
    dominant_id: bool = True,
    max_weight: bool = False,
    index: ChunkIndex | None = None,
    T_camera_frame: torch.Tensor | None = None,
    backend: str = "auto",
) -> Rendering:
    """Render Gaussians from cameras that share one image size.

    `Gaussians` give numpy arrays. `GaussianTensors` give torch tensors, which are differentiable with respect to every
    input tensor and to ``T_camera_frame``. Conventions are those of gsplat (+0.3 px^2 dilation, pixel centres at +0.5,
    alpha cut at 1/255 and clamped to 0.99, near plane 0.01, a pixel stops before its transmittance falls to 1e-4). The
    result is bitwise equal for any number of threads. A Gaussian with NaN, or too large for float32, is not drawn.

    Args:
        gaussians: Gaussians to render; quaternions need not be normalized.
        cameras: cameras in the same frame, all of one size (use one call for each size).
        background: linear colour behind all Gaussians.
        depth, dominant_id, max_weight: outputs to compute besides colour and alpha. In an optimization leave out unused
            outputs: depth takes about a twentieth of the time, each of the other two a tenth.
        index: boxes of chunks of the Gaussians, used to skip chunks that no camera sees (see `ChunkIndex`).
        T_camera_frame: (C, 4, 4) tensor of view matrices that replaces the poses of the cameras, to optimize poses. The
            viewing direction is computed from the centre ``-R^T t``.
        backend: ``native`` (CPU), ``gsplat`` (CUDA; gradients are not the same bits in every run), or ``auto`` (gsplat
            if it is installed and torch finds a GPU, otherwise native). If the GPU has too little memory, cameras are
            rendered in smaller batches, and finally on the CPU with a warning.

    Raises:
        InputError: shapes or dtypes do not agree, camera sizes differ, or a view matrix has NaN.
        ConfigError: the backend is unknown or cannot render these inputs.
        MissingDependencyError: gsplat is requested but not installed.
    """
    chosen = backends.backend(backend)
    width, height = image_size(cameras)
    colour = np.asarray(background, dtype=np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InputError(f"background must be three finite numbers, got {background!r}", code="invalid_vector")
    if isinstance(gaussians, Gaussians):
        if T_camera_frame is not None:
            raise InputError(
                "T_camera_frame needs GaussianTensors; for numpy Gaussians, set the poses of the cameras",
                code="invalid_pose",
            )
        images = native.allocate(len(cameras), height, width, len(gaussians), depth, dominant_id, max_weight)
        if chosen == "gsplat":
            require_torch("renderings by gsplat")
            from gsmap.render import gsplat

            try:
                gsplat.render_numpy(gaussians, cameras, colour, images)
                return Rendering(**images)
            except gsplat.DeviceMemoryError as error:
                logger.warning(
                    "the GPU has too little memory for a view of %d Gaussians at %d x %d pixels; rendering on the "
                    "CPU: %s",
                    *(len(gaussians), width, height, error),
                )
                if max_weight:
                    images["max_weight"].fill(0)
        arrays, poses = native.arrays_of(gaussians), cameras.T_camera_frame
        with native.workspace() as view:
            for i in range(len(cameras)):
                camera = poses[i], cameras.intrinsics_px[i]
                if index is None:
                    native.forward(view, arrays, *camera, colour, images, i, None)
                else:
                    native.draw(view, arrays, *camera, colour, images, i, index)
        return Rendering(**images)

    from gsmap.render import autograd, gsplat
    from gsmap.render.tensors import GaussianTensors

    if not isinstance(gaussians, GaussianTensors):
        raise InputError(
            f"render needs Gaussians or GaussianTensors, got {type(gaussians).__name__}", code="wrong_type"
        )
    pose = _view_matrices(cameras, T_camera_frame)
    # Tensors on the GPU are rendered there, even if gsplat is missing, because its error names the reason.
    if chosen == "gsplat" or (backend == "auto" and gaussians.means.device.type == "cuda"):
        return gsplat.render_tensors(gaussians, cameras, pose, colour, depth, dominant_id, max_weight)
    return autograd.render_tensors(gaussians, cameras, pose, colour, depth, dominant_id, max_weight, index)


def _view_matrices(cameras: Cameras, T_camera_frame: torch.Tensor | None) -> torch.Tensor:
    """Return the view matrices (C, 4, 4): ``T_camera_frame`` if given, otherwise those of the cameras."""
    import torch

    if T_camera_frame is None:
        return torch.from_numpy(cameras.T_camera_frame)
    if tuple(T_camera_frame.shape) != (len(cameras), 4, 4) or not T_camera_frame.is_floating_point():
        raise InputError(
            f"T_camera_frame must be a float tensor ({len(cameras)}, 4, 4), got {tuple(T_camera_frame.shape)}",
            code="invalid_pose",
        )
    if not bool(torch.isfinite(T_camera_frame).all()):
        raise InputError("T_camera_frame holds NaN or infinity", code="not_finite")
    return T_camera_frame
