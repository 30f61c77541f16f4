"""Clips: their sharpest frames, some a second, as photographs of one place."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.localize.photos import Lens, taken_with
from gsmap.types.localization import Photo

_MAX_FRAME_PX = 35_651_584  # of H.264, H.265 and AV1 at level 6.2, their largest: 8192 x 4352


@dataclass(frozen=True)
class Params:
    """Which frames of a clip are looked at.

    Args:
        every_s: one of each stretch of so many seconds, the sharpest.
        max_frames: at most; stretches are longer where a clip is, and double where its header does not say how long.
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
        InputError: not a clip that FFmpeg reads, frames of more than 36 million pixels, or none.
    """
    try:
        import av
    except ImportError as error:
        raise MissingDependencyError("reading clips needs PyAV: pip install 'gsmap[video]'") from error

    path, lens, params = Path(path), lens or Lens(), params or Params()
    if not path.is_file():
        raise NotFoundError(f"no clip at {path}", code="file_not_found")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path} holds no pictures: give a clip", code="clip_unreadable")
            _require_size(path, container.streams.video[0])
            chosen = _sharpest(container, params)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise InputError(f"{path} is not a clip that can be read ({error})", code="clip_unreadable") from error
    if not chosen:
        raise InputError(f"{path} has no frame that can be read", code="clip_unreadable")
    return [(at, taken_with(rgb, lens, None, f"{path.name}#{at:.2f}")) for at, rgb in chosen]


def _require_size(path: Path, stream) -> None:  # type: ignore[no-untyped-def]
    """Refuse frames larger than codecs provide for, and keep a stream from growing to such in its middle."""
    codec = stream.codec_context
    if codec.width * codec.height > _MAX_FRAME_PX:
        raise InputError(
            f"{path} has frames of {codec.width} x {codec.height} pixels, more than {_MAX_FRAME_PX:,}: reduce the clip",
            code="picture_too_large",
        )
    codec.options = {"max_pixels": str(_MAX_FRAME_PX)}


def _sharpest(container, params: Params) -> list[tuple[float, np.ndarray]]:  # type: ignore[no-untyped-def]
    """The frame of each stretch with most fine detail, as (seconds, (H, W, 3) uint8), at most ``max_frames``.

    How long stretches must be is known when the clip ends, for headers lie and streams have none: they double, and the
    sharper of two neighbours stays, whenever there are more frames than may be kept.
    """
    start = None
    every_s = max(params.every_s, float(container.duration or 0) / 1e6 / params.max_frames)
    best: dict[int, tuple[float, float, np.ndarray]] = {}  # by stretch: detail, seconds, pixels
    for number, frame in enumerate(container.decode(video=0)):
        at = float(frame.time) if frame.time is not None else number / 30.0
        start = at if start is None else start
        factor = min(1.0, params.longest_side_px / max(frame.width, frame.height))
        size = (max(2, round(frame.width * factor)), max(2, round(frame.height * factor)))
        rgb = frame.to_ndarray(format="rgb24", width=size[0], height=size[1])
        rgb = np.ascontiguousarray(np.rot90(rgb, round(getattr(frame, "rotation", 0) / 90) % 4))
        grey = rgb[::2, ::2].astype(np.float32).mean(2)
        detail = float(np.abs(np.diff(grey, 2, axis=0)).mean() + np.abs(np.diff(grey, 2, axis=1)).mean())
        stretch = int((at - start) // every_s)
        if stretch not in best or detail > best[stretch][0]:
            best[stretch] = detail, at, rgb
        while len(best) > params.max_frames:
            every_s *= 2
            longer: dict[int, tuple[float, float, np.ndarray]] = {}
            for stretch, one in best.items():
                if stretch // 2 not in longer or one[0] > longer[stretch // 2][0]:
                    longer[stretch // 2] = one
            best = longer
    return [best[stretch][1:] for stretch in sorted(best)]
