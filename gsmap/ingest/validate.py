"""What is refused at the door, with the row that holds it."""

from __future__ import annotations

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.projection import in_image, project
from gsmap.types import Cameras, Gaussians

# A Gaussian this many times wider than the scene is not a background; it is a broken file.
MAX_SCALE_OVER_EXTENT = 1e4
# No camera takes larger pictures, and a JPEG holds none; views are rendered at the size of a camera's picture.
MAX_SIDE_PX = 65_535
_SAMPLE = 20_000


def validate(gaussians: Gaussians, cameras: Cameras | None = None, *, where: str = "the capture") -> tuple[str, ...]:
    """Refuse what cannot be a capture; return notes on what merely looks odd.

    Args:
        where: what to call it in messages (its file).

    Raises:
        InputError: no Gaussians; NaN, infinity, an absurd scale or a zero quaternion, with its row; cameras of which
            none sees a Gaussian, or with pictures larger than any.
    """
    if not len(gaussians):
        raise InputError(f"{where} has no Gaussians")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        rows = getattr(gaussians, name).reshape(len(gaussians), -1)
        # One sum finds any NaN or infinity in a pass; only a bad file pays for the second.
        with np.errstate(over="ignore", invalid="ignore"):
            suspicious = not np.isfinite(rows.sum(dtype=np.float64))
        if suspicious:
            _refuse(where, ~np.isfinite(rows).all(1), f"NaN or infinity in {name}")
    _refuse(where, (gaussians.quats == 0).all(1), "a rotation quaternion of zero")
    low, high = np.percentile(_sampled(gaussians).means, [5, 95], axis=0).astype(np.float64)
    widest = gaussians.log_scales.max(1).astype(np.float64)
    extent = max(float(np.linalg.norm(high - low)), float(np.exp(min(np.median(widest), 80.0))))
    _refuse(where, widest > np.log(MAX_SCALE_OVER_EXTENT * extent), f"a scale over {MAX_SCALE_OVER_EXTENT:g} extents")
    if cameras is None:
        return ()
    if not len(cameras):
        raise InputError(f"{where} has an empty list of cameras: leave them out, and gsmap makes some")
    large = cameras.sizes_px.max(1) > MAX_SIDE_PX
    if large.any():
        i = int(np.argmax(large))
        width, height = cameras.sizes_px[i]
        raise InputError(
            f"{where}: camera {cameras.names[i]!r} has {width} x {height} pixels, more than {MAX_SIDE_PX} on a side: "
            "correct its size"
        )
    seen = sees(cameras, _sampled(gaussians).means)
    if not seen.any() and not sees(cameras, gaussians.means).any():
        raise InputError(f"{where}: none of its {len(cameras)} cameras sees a Gaussian: they belong to another scene")
    blind = int((~seen).sum())
    return (f"{blind} of {len(cameras)} cameras see no Gaussian",) if blind else ()


def sees(cameras: Cameras, points: np.ndarray) -> np.ndarray:
    """(C,) whether any of the points (N, 3) lies before the camera and inside its image; occlusion is ignored."""
    out = np.zeros(len(cameras), bool)
    for i, (view, intrinsics, size) in enumerate(
        zip(cameras.T_camera_frame, cameras.intrinsics_px, cameras.sizes_px, strict=True)
    ):
        out[i] = bool(in_image(*project(points, view, intrinsics), size).any())
    return out


def _sampled(gaussians: Gaussians) -> Gaussians:
    step = max(1, len(gaussians) // _SAMPLE)
    return gaussians[::step]


def _refuse(where: str, bad: np.ndarray, what: str) -> None:
    if bad.any():
        count = int(bad.sum())
        more = f" ({count} such rows)" if count > 1 else ""
        raise InputError(f"{where} holds {what} in row {int(np.argmax(bad))}{more}: clean or export it again")
