"""Read a depth picture with its colours, one view of an RGB-D camera, as a scan."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.pictures import open_picture
from gsmap.types.cameras import Cameras
from gsmap.types.scan import Scan

_DEPTHS = ("I;16", "I;16B", "I;16L", "I", "F")
MIN_DEPTH_M, MAX_DEPTH_M = 0.1, 10.0  # depth sensors measure noise outside of this range
EDGE_FRACTION = 0.04  # of the depth: larger steps between pixels are edges, where sensors put points in mid-air
_MAX_PIXELS = 1 << 25  # 30 times those of depth cameras; each takes some forty bytes on the way to points


def read_depth(
    path: str | os.PathLike[str],
    intrinsics_px: Sequence[float],
    *,
    colour: str | os.PathLike[str] | None = None,
    units_per_m: float = 1000.0,
) -> Scan:
    """Read a depth image as points in the camera frame (OpenCV axes), metres.

    Args:
        path: a picture of one channel, 16 bit or float: depth along the optical axis, 0 where nothing was measured.
        intrinsics_px: ``fx fy cx cy`` of the depth picture, pixel centres at +0.5.
        colour: a picture of the same view, of any size; it is taken to be aligned with the depth.
        units_per_m: values of the depth picture that make a metre: 1000 where it is in millimetres.

    Raises:
        NotFoundError: no such picture.
        InputError: not a depth picture, of another shape than the colours, intrinsics that make no sense, or no pixel
            that shows anything.
    """
    path = Path(path)
    picture, mode = _picture(path)
    if mode not in _DEPTHS:
        raise InputError(
            f"{path} is a picture of mode {mode}, but a depth picture needs one channel of 16 bits or floats",
            code="not_a_depth_picture",
        )
    if not (np.isfinite(units_per_m) and units_per_m > 0):
        raise InputError(
            f"the depth scale (units per metre) must be positive, got {units_per_m}", code="invalid_depth_scale"
        )
    fx, fy, cx, cy = _checked(intrinsics_px)
    depth = picture.astype(np.float64) / units_per_m
    height, width = depth.shape
    good = np.isfinite(depth) & (depth > MIN_DEPTH_M) & (depth < MAX_DEPTH_M)
    steep = _steep(np.where(good, depth, np.nan), EDGE_FRACTION)
    rows, columns = np.nonzero(good & ~steep)
    if not len(rows):
        raise InputError(
            f"{path}: no pixel shows a surface between {MIN_DEPTH_M:g} and {MAX_DEPTH_M:g} m when "
            f"{units_per_m:g} units are a metre: is the depth scale right?",
            code="invalid_depth_scale",
        )
    z = depth[rows, columns]
    points = np.stack([(columns + 0.5 - cx) / fx * z, (rows + 0.5 - cy) / fy * z, z], axis=1)
    colours = None if colour is None else _colours(Path(colour), (height, width))[rows, columns]
    camera = Cameras(np.eye(4)[None], np.array([[fx, fy, cx, cy]]), np.array([[width, height]]), ("depth",))
    return Scan(points, colours, "depth", camera=camera)


def _checked(intrinsics_px: Sequence[float]) -> np.ndarray:
    values = np.asarray(intrinsics_px, dtype=np.float64)
    if values.shape != (4,) or not np.isfinite(values).all() or not (values[:2] > 0).all():
        raise InputError(
            f"intrinsics must be fx, fy, cx, cy in pixels, with positive focal lengths, got {list(intrinsics_px)}",
            code="invalid_intrinsics",
        )
    return values


def _steep(depth: np.ndarray, edge: float) -> np.ndarray:
    """Return a mask (H, W) that is True where the depth jumps to a neighbouring pixel; unmeasured depths are NaN."""
    out = np.zeros(depth.shape, bool)
    for axis in (0, 1):
        step = np.abs(np.diff(depth, axis=axis)) > edge * np.minimum(*_pairs(depth, axis))
        first, second = _sides(axis)
        out[first] |= step
        out[second] |= step
    return out


def _sides(axis: int) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    first, second = [slice(None)] * 2, [slice(None)] * 2
    first[axis], second[axis] = slice(None, -1), slice(1, None)
    return tuple(first), tuple(second)


def _pairs(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    first, second = _sides(axis)
    return values[first], values[second]


def _colours(path: Path, shape: tuple[int, int]) -> np.ndarray:
    """Read the colours (H, W, 3) float32 in [0, 1], in the size of the depth picture."""
    height, width = shape
    colours, _ = _picture(path, "RGB")
    tall, wide = colours.shape[:2]
    if abs(tall * width - wide * height) > max(tall * width, wide * height) * 0.02:
        raise InputError(
            f"{path} has {wide} x {tall} pixels, but the depth picture {width} x {height}: pass two pictures of one "
            "view",
            code="size_mismatch",
        )
    if (tall, wide) != shape:
        rows = np.minimum(((np.arange(height) + 0.5) * tall / height).astype(int), tall - 1)
        columns = np.minimum(((np.arange(width) + 0.5) * wide / width).astype(int), wide - 1)
        colours = colours[rows[:, None], columns]
    out: np.ndarray = colours.astype(np.float32) / 255
    return out


def _picture(path: Path, mode: str | None = None) -> tuple[np.ndarray, str]:
    """Return the pixels of a picture, and its mode."""
    with open_picture(path, max_pixels=_MAX_PIXELS) as image:
        return np.asarray(image if mode is None else image.convert(mode)), image.mode
