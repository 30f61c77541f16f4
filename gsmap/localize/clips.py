"""Clips: their sharpest frames, some a second, as photographs of one place."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.localize.photos import Lens, taken_with
from gsmap.types.localization import Photo


@dataclass(frozen=True)
class Params:
    """Which frames of a clip are looked at.

    Args:
        every_s: one of each stretch of so many seconds, the sharpest.
        max_frames: at most; stretches are longer where a clip is.
        longest_side_px: larger frames are reduced as they are read.
    """

    every_s: float = 0.5
    max_frames: int = 40
    longest_side_px: int = 1280


def read_clip(
    path: str | os.PathLike[str], lens: Lens | None = None, params: Params | None = None
) -> list[tuple[float, Photo]]:
    """Frames of a clip with their times in seconds, upright as it says it is to be shown.

    Raises:
        MissingDependencyError: PyAV is not installed.
        NotFoundError: no such file.
        InputError: not a clip that FFmpeg reads, or one without frames.
    """
    try:
        import av
    except ImportError as error:
        raise MissingDependencyError("reading clips needs PyAV: pip install 'gsmap[video]'") from error

    path, lens, params = Path(path), lens or Lens(), params or Params()
    if not path.is_file():
        raise NotFoundError(f"no clip at {path}")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path} holds no pictures: give a clip")
            length = float(container.duration or 0) / 1e6
            every = max(params.every_s, length / params.max_frames)
            chosen = list(_sharpest(container, every, params))
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise InputError(f"{path} is not a clip that can be read ({error})") from error
    if not chosen:
        raise InputError(f"{path} has no frame that can be read")
    return [(at, taken_with(rgb, lens, None, f"{path.name}#{at:.2f}")) for at, rgb in chosen[: params.max_frames]]


def _sharpest(container, every_s: float, params: Params) -> Iterator[tuple[float, np.ndarray]]:  # type: ignore[no-untyped-def]
    """The frame of each stretch with most fine detail, as (seconds, (H, W, 3) uint8)."""
    stretch, best = -1, (-1.0, 0.0, np.zeros((0, 0, 3), np.uint8))
    for number, frame in enumerate(container.decode(video=0)):
        at = float(frame.time) if frame.time is not None else number / 30.0
        if int(at / every_s) != stretch and best[0] >= 0:
            yield best[1], best[2]
            best = (-1.0, 0.0, best[2])
        stretch = int(at / every_s)
        factor = min(1.0, params.longest_side_px / max(frame.width, frame.height))
        size = (max(2, round(frame.width * factor)), max(2, round(frame.height * factor)))
        rgb = frame.to_ndarray(format="rgb24", width=size[0], height=size[1])
        rgb = np.ascontiguousarray(np.rot90(rgb, round(getattr(frame, "rotation", 0) / 90) % 4))
        grey = rgb[::2, ::2].astype(np.float32).mean(2)
        detail = float(np.abs(np.diff(grey, 2, axis=0)).mean() + np.abs(np.diff(grey, 2, axis=1)).mean())
        if detail > best[0]:
            best = (detail, at, rgb)
    if best[0] >= 0:
        yield best[1], best[2]
