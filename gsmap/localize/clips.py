"""Read video clips: return the sharpest frame of every interval as a photo."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, MissingDependencyError, NotFoundError
from gsmap.geometry.camera_models import require_pycolmap
from gsmap.localize.photos import Lens, make_photo
from gsmap.settings.ranges import require_range
from gsmap.types.localization import Photo

_MAX_FRAME_PX = 35_651_584  # 8192 x 4352, the largest frame that H.264, H.265 and AV1 allow (level 6.2)


@dataclass(frozen=True)
class Params:
    """Settings of choosing frames of a video clip.

    Args:
        interval_s: Length in seconds, positive, of the intervals into which a clip is divided; the sharpest frame of
            each interval is localized. Larger is faster.
        max_frames: Largest number of frames of a clip, at least 1, that are localized; larger localizes more frames of
            long clips and takes longer.
        max_side_px: Longer side in pixels, at least 64, to which larger frames of a clip are downscaled; larger keeps
            more detail.
    """

    interval_s: float = 0.5
    max_frames: int = 40
    max_side_px: int = 1280

    def __post_init__(self) -> None:
        require_range(self, "(0, inf]", "interval_s")
        require_range(self, "[1, inf]", "max_frames")
        require_range(self, "[64, inf]", "max_side_px")


def read_clip(
    path: str | os.PathLike[str], lens: Lens | None = None, params: Params | None = None
) -> list[tuple[float, Photo]]:
    """Read frames of a clip, rotated as the clip specifies, with their times in seconds.

    Args:
        lens: in pixels of the upright frames of the clip, before they are downscaled.

    Raises:
        MissingDependencyError: PyAV is not installed.
        NotFoundError: no such file.
        InputError: FFmpeg cannot read the clip, its frames have more than 36 million pixels, or it has no frames.
    """
    try:
        import av
    except ImportError as error:
        raise MissingDependencyError("reading clips needs PyAV", extra="video") from error

    path, lens, params = Path(path), lens or Lens(), params or Params()
    if not path.is_file():
        raise NotFoundError(f"there is no video clip {path}", code="file_not_found")
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(f"{path} has no video: give a video clip", code="clip_unreadable")
            _require_size(path, container.streams.video[0])
            chosen = _sharpest(container, params)
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise InputError(f"{path} is not a readable video clip ({error})", code="clip_unreadable") from error
    if not chosen:
        raise InputError(f"{path} has no readable frame", code="clip_unreadable")
    return [
        (at, make_photo(rgb, None, _scaled(lens, size_px, rgb.shape[1::-1]), f"{path.name}#{at:.2f}"))
        for at, rgb, size_px in chosen
    ]


def _scaled(lens: Lens, size_px: tuple[int, int], new_size_px: tuple[int, int]) -> Lens:
    """Return the lens of a frame that was resampled to a new width and height."""
    if size_px == new_size_px:
        return lens
    x, y = new_size_px[0] / size_px[0], new_size_px[1] / size_px[1]
    if lens.intrinsics_px is not None:
        fx, fy, cx, cy = lens.intrinsics_px
        lens = replace(lens, intrinsics_px=(fx * x, fy * y, cx * x, cy * y))
    if lens.focal_px is not None:
        lens = replace(lens, focal_px=lens.focal_px * max(new_size_px) / max(size_px))
    if lens.model is not None and lens.model[1]:
        name, params = lens.model
        camera = require_pycolmap().Camera(model=name, width=size_px[0], height=size_px[1], params=list(params))
        camera.rescale(*new_size_px)
        lens = replace(lens, model=(name, tuple(camera.params.tolist())))
    return lens


def _require_size(path: Path, stream) -> None:  # type: ignore[no-untyped-def]
    """Reject frames that are larger than any codec level allows, also frames later in the stream."""
    codec = stream.codec_context
    if codec.width * codec.height > _MAX_FRAME_PX:
        raise InputError(
            f"{path} has frames of {codec.width} x {codec.height} pixels, more than {_MAX_FRAME_PX:,}: scale the clip "
            "down",
            code="picture_too_large",
        )
    codec.options = {"max_pixels": str(_MAX_FRAME_PX)}


def _sharpest(  # type: ignore[no-untyped-def]
    container, params: Params
) -> list[tuple[float, np.ndarray, tuple[int, int]]]:
    """Return the frame with most fine detail of each interval, at most ``max_frames``, as (seconds, (H, W, 3) uint8,
    upright width and height before downscaling).

    The duration in the header may be wrong or missing. Whenever there are too many frames, the interval is doubled, and
    the sharper frame of each two neighbours is kept.
    """
    start = None
    interval_s = max(params.interval_s, float(container.duration or 0) / 1e6 / params.max_frames)
    best: dict[int, tuple[float, float, np.ndarray, tuple[int, int]]] = {}  # by interval: detail, seconds, pixels, size
    for number, frame in enumerate(container.decode(video=0)):
        at = float(frame.time) if frame.time is not None else number / 30.0
        start = at if start is None else start
        factor = min(1.0, params.max_side_px / max(frame.width, frame.height))
        size = (max(2, round(frame.width * factor)), max(2, round(frame.height * factor)))
        rgb = frame.to_ndarray(format="rgb24", width=size[0], height=size[1])
        quarters = round(getattr(frame, "rotation", 0) / 90) % 4
        rgb = np.ascontiguousarray(np.rot90(rgb, quarters))
        upright_px = (frame.height, frame.width) if quarters % 2 else (frame.width, frame.height)
        grey = rgb[::2, ::2].astype(np.float32).mean(2)
        detail = float(np.abs(np.diff(grey, 2, axis=0)).mean() + np.abs(np.diff(grey, 2, axis=1)).mean())
        interval = int((at - start) // interval_s)
        if interval not in best or detail > best[interval][0]:
            best[interval] = detail, at, rgb, upright_px
        while len(best) > params.max_frames:
            interval_s *= 2
            longer: dict[int, tuple[float, float, np.ndarray, tuple[int, int]]] = {}
            for interval, one in best.items():
                if interval // 2 not in longer or one[0] > longer[interval // 2][0]:
                    longer[interval // 2] = one
            best = longer
    return [best[interval][1:] for interval in sorted(best)]
