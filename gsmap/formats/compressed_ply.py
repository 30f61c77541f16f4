"""Read and write PlayCanvas' ``.compressed.ply``: chunks of 256 Gaussians, as integers between the bounds of the chunk.

16 bytes a Gaussian and 3 a coefficient of SH beyond degree 0. Positions and scales have 11, 10 and 11 bits, a
quaternion 2 + 3 x 10 (smallest three, of wxyz), colours and opacity 8 bits each, SH 8 bits over [-4, 4].
"""

from __future__ import annotations

import os

import numpy as np

from gsmap.errors import InputError
from gsmap.formats import ply
from gsmap.formats.quantise import (
    from_smallest_three,
    logits_of_bytes,
    opacity_bytes,
    require_writable,
    smallest_three,
)
from gsmap.geometry.morton import morton_order
from gsmap.geometry.sh import rgb_of_sh0, sh0_of_rgb
from gsmap.types import Gaussians

VERSION = 1

_CHUNK = 256
_BOUNDS = [f"{end}_{of}{axis}" for of in ("", "scale_") for end in ("min", "max") for axis in "xyz"]
_COLOUR_BOUNDS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_SQRT2 = 2**0.5
_MAX_LOG_SCALE = 20.0


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a ``.compressed.ply`` of SH degree 0 to 3, also an older file without bounds of the colours.

    Raises:
        InputError: Another kind of PLY, truncated, or with inconsistent counts.
    """
    header = ply.read_header(path)
    if not ply.is_compressed(header):
        return ply.read(path)
    rows = ply.read_element(path, header, "vertex")
    chunks = ply.read_element(path, header, "chunk")
    _require(path, rows, _PACKED, "uint32")
    _require(path, chunks, _BOUNDS, "float32")
    n = len(rows)
    if len(chunks) != -(-n // _CHUNK):
        raise InputError(
            f"{path}: {n} Gaussians need {-(-n // _CHUNK)} chunks, but the file has {len(chunks)}",
            code="count_mismatch",
        )
    low, high, scale_low, scale_high = (
        np.stack([chunks[name] for name in _BOUNDS[at : at + 3]], 1) for at in (0, 3, 6, 9)
    )
    colour = _unpack_bytes(rows["packed_color"])
    rgb = colour[:, :3] / np.float32(255)
    if "min_r" in _columns(chunks):
        _require(path, chunks, _COLOUR_BOUNDS, "float32")
        rgb_low, rgb_high = (np.stack([chunks[f"{end}_{c}"] for c in "rgb"], 1) for end in ("min", "max"))
        rgb = _between(rgb, rgb_low, rgb_high)
    sh = np.empty((n, 1, 3), np.float32)
    sh[:, 0] = sh0_of_rgb(rgb)
    if "sh" in header.elements:
        sh = np.concatenate([sh, _read_sh(path, header, n)], axis=1)
    return Gaussians(
        _between(_unpack_11_10_11(rows["packed_position"]), low, high),
        _unpack_quats(rows["packed_rotation"]),
        _between(_unpack_11_10_11(rows["packed_scale"]), scale_low, scale_high),
        logits_of_bytes(colour[:, 3]),
        sh,
    )


def write(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a ``.compressed.ply``, sorted along a Morton curve, which keeps the bounds of chunks tight."""
    require_writable(path, gaussians)
    g = gaussians[morton_order(gaussians.means)]
    n, k = len(g), g.sh.shape[1]
    log_scales = np.clip(g.log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE)
    position, low, high = _within_chunks(g.means)
    scale, scale_low, scale_high = _within_chunks(log_scales)
    rgb, rgb_low, rgb_high = _within_chunks(rgb_of_sh0(g.sh[:, 0]))
    colour = np.concatenate([np.round(rgb * 255).astype(np.uint8), opacity_bytes(g.logit_opacities)[:, None]], axis=1)
    packed = np.empty((n, 4), "<u4")
    packed[:, 0] = _pack_11_10_11(position)
    packed[:, 1] = _pack_quats(g.quats)
    packed[:, 2] = _pack_11_10_11(scale)
    packed[:, 3] = colour[:, ::-1].copy().view("<u4")[:, 0]  # red is the highest byte

    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(low)}"]
    lines += [f"property float {name}" for name in _BOUNDS + _COLOUR_BOUNDS]
    lines += [f"element vertex {n}", *(f"property uint {name}" for name in _PACKED)]
    if k > 1:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * (k - 1)))]
    with open(path, "wb") as file:
        file.write("\n".join([*lines, "end_header", ""]).encode())
        bounds = np.concatenate([low, high, scale_low, scale_high, rgb_low, rgb_high], axis=1)
        file.write(bounds.astype("<f4").data)
        file.write(packed.data)
        if k > 1:
            level = np.clip(np.floor(g.sh[:, 1:] * 32 + 128), 0, 255).astype(np.uint8)
            file.write(np.ascontiguousarray(level.transpose(0, 2, 1)).data)


def _read_sh(path: str | os.PathLike[str], header: ply.Header, n: int) -> np.ndarray:
    rows = ply.read_element(path, header, "sh")
    names = [f"f_rest_{i}" for i in range(len(_columns(rows)))]
    if len(names) not in (9, 24, 45):
        raise InputError(
            f"{path} has {len(names)} f_rest properties; SH degrees 1 to 3 have 9, 24 or 45",
            code="unsupported_sh_degree",
        )
    _require(path, rows, names, "uint8")
    if len(rows) != n or list(_columns(rows)) != names:
        raise InputError(
            f"{path}: its SH rows ({len(rows)}) do not fit its {n} Gaussians, or are out of order",
            code="count_mismatch",
        )
    # Bytes stand for the middle of their bin, but the two ends for the ends of the range.
    value = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
    value[[0, 255]] = -4, 4
    level = rows.view(np.uint8).reshape(n, 3, -1).transpose(0, 2, 1)
    return value.astype(np.float32)[level]


def _columns(rows: np.ndarray) -> tuple[str, ...]:
    return rows.dtype.names or ()


def _require(path: str | os.PathLike[str], rows: np.ndarray, names: list[str], kind: str) -> None:
    wrong = [n for n in names if n not in _columns(rows) or rows.dtype[n] != np.dtype(kind)]
    if wrong:
        raise InputError(
            f"{path} is not a .compressed.ply: {', '.join(wrong)} missing or not {kind}", code="wrong_file_type"
        )


def _between(t: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the values (N, 3) at fractions ``t`` (N, 3) between the bounds (C, 3) of their chunks."""
    chunk = np.arange(len(t)) // _CHUNK
    return low[chunk] * (1 - t) + high[chunk] * t


def _within_chunks(values: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return values (N, 3) as fractions between the bounds of their chunks, and the lower and upper bounds (C, 3)."""
    starts = np.arange(0, len(values), _CHUNK)
    low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    chunk = np.arange(len(values)) // _CHUNK
    span = np.where(high > low, high - low, 1)
    return (values - low[chunk]) / span[chunk], low, high


def _pack_11_10_11(t: np.ndarray) -> np.ndarray:
    x, y, z = np.round(t * [2047, 1023, 2047]).astype(np.uint32).T
    return x << 21 | y << 11 | z


def _unpack_11_10_11(packed: np.ndarray) -> np.ndarray:
    out = np.stack([packed >> 21, packed >> 11 & 1023, packed & 2047], axis=1).astype(np.float32)
    return out / np.array([2047, 1023, 2047], np.float32)


def _unpack_bytes(packed: np.ndarray) -> np.ndarray:
    return np.stack([packed >> 24, packed >> 16 & 255, packed >> 8 & 255, packed & 255], axis=1).astype(np.uint8)


def _pack_quats(quats: np.ndarray) -> np.ndarray:
    largest, three = smallest_three(quats)
    a, b, c = np.round((three / _SQRT2 + 0.5) * 1023).astype(np.uint32).T
    return largest.astype(np.uint32) << 30 | a << 20 | b << 10 | c


def _unpack_quats(packed: np.ndarray) -> np.ndarray:
    three = np.stack([packed >> 20 & 1023, packed >> 10 & 1023, packed & 1023], axis=1).astype(np.float32)
    return from_smallest_three(packed >> 30, (three / 1023 - 0.5) * _SQRT2)
