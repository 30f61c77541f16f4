"""Validate captures; error messages name the first invalid row."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.geometry.projection import in_image, project
from gsmap.stream import clamp_infinities, count_clamped
from gsmap.types import Cameras, Gaussians, GaussianSource
from gsmap.types.gaussians import FIELDS
from gsmap.types.source import gathered

# A Gaussian this many times wider than the scene is not a background; it is a broken file.
MAX_SCALE_OVER_EXTENT = 1e4
# Skies and backgrounds lie within this many times the extent of 99 % of the Gaussians; strays lie beyond.
MAX_EXTENT_RATIO = 1e3
# No camera takes larger pictures, and a JPEG holds none; views are rendered at the size of a camera's picture.
MAX_SIDE_PX = 65_535
_SAMPLE = 20_000


def validate(
    gaussians: GaussianSource, cameras: Cameras | None = None, *, where: str = "the capture"
) -> tuple[str, ...]:
    """Raise an error for an invalid capture; return notes on unusual values of a valid capture.

    Args:
        where: what to call it in messages (its file).

    Raises:
        InputError: no Gaussians; NaN, an infinity that is no value (see `gsmap.stream.clamp_infinities`), an absurd
            scale or a zero quaternion, with its row; cameras of which none sees a Gaussian, or with pictures larger
            than any.
    """
    notes = validate_gaussians(gaussians, where)
    return notes if cameras is None else (*notes, *validate_cameras(cameras, gaussians, where))


def validate_gaussians(gaussians: GaussianSource, where: str) -> tuple[str, ...]:
    """Validate the Gaussians of a capture, reading them once; return notes."""
    n = gaussians.num_gaussians
    if not n:
        raise InputError(f"{where} has no Gaussians", code="no_gaussians")
    bad = {f"NaN or infinity in {name}": _BadRows() for name in FIELDS} | {"a rotation quaternion of zero": _BadRows()}
    widest = np.empty(n, np.float32)
    sampled = []
    start, step = 0, _step(n)
    opacities, scales = 0, 0
    corners = []
    for chunk in map(clamp_infinities, gaussians.chunks()):
        infinite = count_clamped(chunk)
        opacities, scales = opacities + infinite[0], scales + infinite[1]
        for name in FIELDS:
            rows = getattr(chunk, name).reshape(len(chunk), -1)
            # One sum finds any NaN or infinity in a pass; only a bad file pays for the second.
            with np.errstate(over="ignore", invalid="ignore"):
                suspicious = not np.isfinite(rows.sum(dtype=np.float64))
            if suspicious:
                bad[f"NaN or infinity in {name}"].note(start, ~np.isfinite(rows).all(1))
        bad["a rotation quaternion of zero"].note(start, (chunk.quats == 0).all(1))
        widest[start : start + len(chunk)] = chunk.log_scales.max(1)
        sampled.append(chunk.means[-start % step :: step])
        corners += [chunk.means.min(0), chunk.means.max(0)]
        start += len(chunk)
    for what, found in bad.items():
        found.refuse(where, what)
    absurd = _BadRows()
    absurd.note(0, _is_oversized(widest, np.concatenate(sampled)))
    absurd.refuse(where, f"a scale of more than {MAX_SCALE_OVER_EXTENT:g} extents of the capture")
    notes = []
    if opacities or scales:
        notes.append(
            f"{opacities} opacities are 0 or 1 and {scales} scales are 0, whose logits or logarithms are infinite: "
            "they were replaced by finite numbers that look the same"
        )
    middle = np.ptp(np.percentile(np.concatenate(sampled), [0.5, 99.5], axis=0).astype(np.float64), axis=0).max()
    whole = np.ptp(np.array(corners, np.float64), axis=0).max()
    if whole > MAX_EXTENT_RATIO * middle > 0:
        notes.append(
            f"a few Gaussians lie far away: the capture is {whole:.3g} units wide, 99 % of it {middle:.3g}; "
            "--clean removes them"
        )
    return tuple(notes)


def invalid_rows(gaussians: Gaussians) -> np.ndarray:
    """Return an (N,) mask of Gaussians that `validate` refuses for NaN, an infinity, or a rotation of zero."""
    bad: np.ndarray = (gaussians.quats == 0).all(1)
    for name in FIELDS:
        bad |= ~np.isfinite(getattr(gaussians, name).reshape(len(gaussians), -1)).all(1)
    return bad


def oversized_rows(gaussians: Gaussians) -> np.ndarray:
    """Return an (N,) mask of Gaussians that `validate` refuses for their scale; all other values are valid."""
    return _is_oversized(gaussians.log_scales.max(1), gaussians.means[:: _step(len(gaussians))])


def _is_oversized(log_scales: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Return an (N,) mask of largest log-scales (N,) that are absurd for the extent of a sample of means (M, 3)."""
    low, high = np.percentile(means, [5, 95], axis=0).astype(np.float64)
    extent = max(float(np.linalg.norm(high - low)), float(np.exp(min(float(np.median(log_scales)), 80.0))))
    result: np.ndarray = log_scales.astype(np.float64) > np.log(MAX_SCALE_OVER_EXTENT * extent)
    return result


def validate_cameras(cameras: Cameras, gaussians: GaussianSource, where: str) -> tuple[str, ...]:
    """Validate the cameras of a capture with valid Gaussians; return notes."""
    if not len(cameras):
        raise InputError(
            f"{where} has an empty list of cameras: omit it, and gsmap synthesizes cameras", code="no_cameras"
        )
    large = cameras.sizes_px.max(1) > MAX_SIDE_PX
    if large.any():
        i = int(np.argmax(large))
        width, height = cameras.sizes_px[i]
        raise InputError(
            f"{where}: camera {cameras.names[i]!r} has {width} x {height} pixels, more than {MAX_SIDE_PX} on a side: "
            "correct the size of this camera",
            code="invalid_camera",
        )
    n = gaussians.num_gaussians
    seen = sees(cameras, gathered(gaussians, "means", np.arange(0, n, _step(n))))
    if not seen.any() and not any(sees(cameras, means).any() for means in gaussians.columns("means")):
        raise InputError(
            f"{where}: none of its {len(cameras)} cameras sees a Gaussian: pass the cameras of this capture",
            code="cameras_see_nothing",
        )
    blind = int((~seen).sum())
    return (f"{blind} of {len(cameras)} cameras see no Gaussian",) if blind else ()


def sees(cameras: Cameras, points: np.ndarray) -> np.ndarray:
    """Return a mask (C,) that is True for cameras with a point (N, 3) in the image, ignoring occlusion."""
    out = np.zeros(len(cameras), bool)
    for i, (view, intrinsics, size) in enumerate(
        zip(cameras.T_camera_frame, cameras.intrinsics_px, cameras.sizes_px, strict=True)
    ):
        out[i] = bool(in_image(*project(points, view, intrinsics), size).any())
    return out


def _step(n: int) -> int:
    """Return the stride between the Gaussians of checks that would take too long on all."""
    return max(1, n // _SAMPLE)


@dataclass
class _BadRows:
    """The first invalid row that a check found, and their number."""

    first: int = 0
    count: int = 0

    def note(self, start: int, bad: np.ndarray) -> None:
        """Record invalid rows: ``bad`` is a mask of rows that begin at row ``start``."""
        if bad.any():
            self.first = self.first if self.count else start + int(np.argmax(bad))
            self.count += int(bad.sum())

    def refuse(self, where: str, what: str) -> None:
        if self.count:
            more = f" ({self.count} such rows)" if self.count > 1 else ""
            raise InputError(
                f"{where} holds {what} in row {self.first}{more}: clean it (gsmap clean) or export it again",
                code="invalid_gaussians",
            )
