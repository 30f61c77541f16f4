"""Call the CPU kernel with numpy arrays: allocation, argument checks, one view at a time."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from gsmap import platform
from gsmap._native import View, num_threads, use_instruction_set
from gsmap._native import set_num_threads as _set_num_threads
from gsmap.errors import InputError
from gsmap.render.index import ChunkIndex
from gsmap.types import Gaussians

__all__ = [
    "View",
    "allocate",
    "arrays_of",
    "forward",
    "num_threads",
    "set_num_threads",
    "use_instruction_set",
    "workspace",
]


def set_num_threads(count: int | None = None) -> None:
    """Set the number of render threads; None uses every core that this process may use, or OMP_NUM_THREADS if it is
    set."""
    if count is None:
        try:
            count = int(os.environ.get("OMP_NUM_THREADS", ""))
        except ValueError:
            count = platform.num_processors()
    if count < 1:
        raise InputError(f"the number of threads must be at least 1, got {count}", code="out_of_range")
    _set_num_threads(count)


def arrays_of(gaussians: Gaussians) -> tuple[np.ndarray, ...]:
    """Return the five arrays of Gaussians in the order of the kernel."""
    return gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.logit_opacities, gaussians.sh


_BLOCK_PX = 8  # as in the kernel
_kept = threading.local()
_KEPT_BYTES = 1 << 27  # largest memory of a view that is kept for reuse: enough for a room, not for a street


@contextmanager
def workspace() -> Iterator[Any]:
    """Return a view that reuses the memory of this thread: clearing new memory takes a tenth of a small image's
    time."""
    view = _kept.__dict__.pop("view", None) or View()
    yield view
    if view.workspace_bytes <= _KEPT_BYTES:
        _kept.view = view


def allocate(
    views: int, height: int, width: int, num_gaussians: int, depth: bool, dominant_id: bool, max_weight: bool
) -> dict[str, Any]:
    """Allocate the output arrays of `Rendering` by field name; None for outputs that are not requested."""
    shape = (views, height, width)
    return {
        "colour": np.empty((*shape, 3), np.float32),
        "alpha": np.empty(shape, np.float32),
        "depth": np.empty(shape, np.float32) if depth else None,
        "dominant_id": np.empty(shape, np.int32) if dominant_id else None,
        "max_weight": np.zeros(num_gaussians, np.float32) if max_weight else None,
        "centre": None,
    }


def draw(
    view: Any,
    arrays: tuple[np.ndarray, ...],
    T_camera_frame: np.ndarray,
    intrinsics_px: np.ndarray,
    background: np.ndarray,
    images: dict[str, Any],
    i: int,
    index: ChunkIndex,
) -> None:
    """Render view ``i`` into ``images`` as `forward` does, faster, without the state for a backward pass."""
    _check_index(index, arrays)
    view_arguments = _view_arguments(T_camera_frame, intrinsics_px, background, images, i)
    height, width = images["alpha"].shape[1:]
    ranges, depths, blocks = index.candidates(view_arguments["pose"], intrinsics_px, width, height, _BLOCK_PX)
    centre = None if images["centre"] is None else images["centre"][i]
    view.draw(*arrays, ranges=ranges, depths=depths, blocks=blocks, centre=centre, **view_arguments)


def _check_index(index: ChunkIndex, arrays: tuple[np.ndarray, ...]) -> None:
    if index.num_gaussians != len(arrays[0]):
        raise InputError(
            f"the index has {index.num_gaussians} Gaussians, but {len(arrays[0])} are rendered: rebuild the index",
            code="shape_mismatch",
        )


def forward(
    view: Any,
    arrays: tuple[np.ndarray, ...],
    T_camera_frame: np.ndarray,
    intrinsics_px: np.ndarray,
    background: np.ndarray,
    images: dict[str, Any],
    i: int,
    index: ChunkIndex | None,
    looked_at: np.ndarray | None = None,
) -> None:
    """Render view ``i`` into ``images``; ``view`` keeps the state of its backward pass.

    Pixels are drawn only if ``looked_at`` (H, W) is not 0 somewhere within reach of the SSIM window.
    """
    view_arguments = _view_arguments(T_camera_frame, intrinsics_px, background, images, i)
    ranges = None
    if index is not None:
        _check_index(index, arrays)
        height, width = images["alpha"].shape[1:]
        ranges = index.visible_ranges(view_arguments["pose"], intrinsics_px, width, height)
    view.forward(*arrays, ranges=ranges, looked_at=looked_at, **view_arguments)


def _view_arguments(
    T_camera_frame: np.ndarray, intrinsics_px: np.ndarray, background: np.ndarray, images: dict[str, Any], i: int
) -> dict[str, Any]:
    """Return the camera and the outputs of view ``i``, as the kernel names them."""
    height, width = images["alpha"].shape[1:]
    return {
        "pose": np.ascontiguousarray(T_camera_frame[:3], dtype=np.float64),
        "intrinsics": np.ascontiguousarray(intrinsics_px, dtype=np.float64),
        "width": width,
        "height": height,
        "background": background,
        "colour": images["colour"][i],
        "depth": None if images["depth"] is None else images["depth"][i],
        "alpha": images["alpha"][i],
        "dominant_id": None if images["dominant_id"] is None else images["dominant_id"][i],
        "max_weight": images["max_weight"],
    }


set_num_threads()
