"""The one function that renders, and its answer."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gsmap.errors import ConfigError, InputError
from gsmap.render import native
from gsmap.render.index import ChunkIndex
from gsmap.types import Cameras, Gaussians

if TYPE_CHECKING:
    import torch

    from gsmap.render.autograd import GaussianTensors

num_threads = native.num_threads
set_num_threads = native.set_num_threads


@dataclass(frozen=True, eq=False)
class Rendered:
    """What C cameras see; numpy arrays or torch tensors, as the Gaussians were.

    Args:
        colour: (C, H, W, 3) float32, not clamped above.
        alpha: (C, H, W) float32 in [0, 1].
        depth: (C, H, W) float32 expected camera-space z, ``sum w z / sum w``, 0 where alpha is 0; or None.
        dominant_id: (C, H, W) int32 Gaussian with the largest blending weight, -1 where nothing was drawn; or None.
        max_weight: (N,) float32 largest blending weight of each Gaussian over all pixels of all views; or None.
    """

    colour: Any
    alpha: Any
    depth: Any = None
    dominant_id: Any = None
    max_weight: Any = None


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
) -> Rendered:
    """Render Gaussians through cameras that share one image size.

    `Gaussians` in, numpy out. `GaussianTensors` in, torch out, differentiable with respect to every tensor in it and to
    ``T_camera_frame``. Conventions are gsplat's (+0.3 px^2 dilation, pixel centres at +0.5, alpha cut at 1/255 and
    clamped to 0.99, near plane 0.01, a pixel stops before its transmittance falls to 1e-4); the result is the same
    bits for any number of threads. A Gaussian with NaN, or too large for float32, is not drawn.

    Args:
        gaussians: what to render; quaternions need not be normalised.
        cameras: from the same frame; all of one size (group cameras of several sizes into several calls).
        background: linear colour behind everything.
        depth, dominant_id, max_weight: which outputs besides colour and alpha to make. Leave out what is not needed
            in an optimisation: depth costs about a twentieth, the other two a tenth each.
        index: boxes of chunks of the Gaussians, to skip what no camera sees (see `ChunkIndex`).
        T_camera_frame: (C, 4, 4) tensor of view matrices that replaces the cameras' poses, where the pose is to be
            optimised. The viewing direction is taken from the centre ``-R^T t``.
        backend: ``native`` (CPU), ``gsplat`` (CUDA; not the same bits in every run), or ``auto``: gsplat where it is
            installed and torch sees a GPU, else native.

    Raises:
        InputError: shapes or dtypes that do not fit, cameras of several sizes, a view matrix with NaN.
        ConfigError: an unknown backend, or one that cannot take these inputs.
        MissingDependencyError: gsplat is asked for and not installed.
    """
    if backend not in ("auto", "native", "gsplat"):
        raise ConfigError(f"backend must be auto, native or gsplat, got {backend!r}")
    width, height = image_size(cameras)
    colour = np.asarray(background, dtype=np.float32)
    if colour.shape != (3,) or not np.isfinite(colour).all():
        raise InputError(f"background must be three finite numbers, got {background!r}")
    if isinstance(gaussians, Gaussians):
        if T_camera_frame is not None:
            raise InputError("T_camera_frame goes with GaussianTensors; for numpy, put the pose into the cameras")
        if backend == "gsplat" or (backend == "auto" and gsplat_available()):
            from gsmap.render import gsplat

            return gsplat.render_numpy(gaussians, cameras, colour, depth, dominant_id, max_weight)
        images = native.allocate(len(cameras), height, width, len(gaussians), depth, dominant_id, max_weight)
        view = native.View()
        arrays = native.arrays_of(gaussians)
        for i in range(len(cameras)):
            native.forward(view, arrays, cameras.T_camera_frame[i], cameras.intrinsics_px[i], colour, images, i, index)
        return Rendered(**images)

    from gsmap.render import autograd

    return autograd.render_tensors(
        gaussians, cameras, T_camera_frame, colour, depth, dominant_id, max_weight, index, backend
    )


def gsplat_available() -> bool:
    """Whether the CUDA backend can be used here."""
    if importlib.util.find_spec("gsplat") is None:
        return False  # without importing torch, which numpy callers may do without
    from gsmap.render import gsplat

    return gsplat.available()


def image_size(cameras: Cameras) -> tuple[int, int]:
    """``(width, height)`` that all cameras share.

    Raises:
        InputError: not `Cameras`, several sizes, or larger than the rasteriser's 65,535 tiles of 32 pixels a side.
    """
    if not isinstance(cameras, Cameras):
        raise InputError(f"render needs gsmap.types.Cameras, got {type(cameras).__name__}")
    if len(cameras) == 0:
        return 1, 1
    width, height = (int(v) for v in cameras.sizes_px[0])
    if (cameras.sizes_px != (width, height)).any():
        sizes = sorted({f"{w}x{h}" for w, h in cameras.sizes_px.tolist()})
        raise InputError(f"cameras of one render call must share one image size, got {', '.join(sizes[:5])}")
    if width * height > 2**28:
        raise InputError(f"an image of {width}x{height} pixels is too large to render: resize the cameras")
    return width, height
