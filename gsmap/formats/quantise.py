"""Quantization for all compressed formats: opacities as bytes, quaternions as three numbers, limits on input."""

from __future__ import annotations

import os

import numpy as np

from gsmap._native import from_smallest_three as unit_quats
from gsmap._native import smallest_three as three_and_largest
from gsmap.errors import InputError
from gsmap.types import Gaussians

# Real splats compress 2 to 10 times; what claims far more than that is a bomb.
_FREE_BYTES = 8 << 20
_MAX_RATIO = 32


def check_size(path: str | os.PathLike[str], expanded: int, compressed: int) -> None:
    """Raise an error if ``compressed`` bytes would expand to more than 8 MiB and to more than 32 times their number.

    Raises:
        InputError: A decompression bomb, or an inconsistent header.
    """
    if expanded > max(_FREE_BYTES, _MAX_RATIO * compressed):
        raise InputError(
            f"{path}: its header promises {expanded / 2**20:,.0f} MiB out of {compressed / 2**20:.1f} MiB compressed; "
            "no real splat compresses that well, so the file is damaged or hostile",
            code="decompression_bomb",
        )


def require_writable(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Raise an error for Gaussians that a compressed format cannot store: none, NaN, infinite positions or colours.

    Infinite logits and scales of minus infinity are fine: they have an opacity and a size.
    """
    if len(gaussians) == 0:
        raise InputError(f"{path}: there are no Gaussians to write", code="no_gaussians")
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh"):
        values = getattr(gaussians, name)
        with np.errstate(all="ignore"):
            total = values.sum()  # of what is finite it may still overflow, and of nothing else does it not
        if not np.isfinite(total):
            bad = ~np.isfinite(values) if name in ("means", "quats", "sh") else np.isnan(values)
            if bad.any():
                row = int(bad.reshape(len(values), -1).any(1).argmax())
                raise InputError(
                    f"{path}: {name} of Gaussian {row} is not finite: remove it before writing", code="not_finite"
                )


def opacity_bytes(logits: np.ndarray) -> np.ndarray:
    """Convert logits to opacities as uint8, 0 to 255."""
    with np.errstate(over="ignore"):
        return np.round(255.0 / (1.0 + np.exp(-logits))).astype(np.uint8)


def logits_of_bytes(values: np.ndarray) -> np.ndarray:
    """Convert opacities stored as uint8 to logits float32; 0 and 255 become the middle of their bins of half width."""
    opacity = np.clip(np.arange(256), 0.25, 254.75) / 255.0
    return np.log(opacity / (1.0 - opacity)).astype(np.float32)[values]


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normalize quaternions (N, 4); return the index (N,) of the largest component and the other three (N, 3) in order.

    The sign makes the largest component positive; a zero quaternion counts as the identity, with component 0 only.
    """
    largest, three = three_and_largest(np.ascontiguousarray(quats, np.float32))
    return largest, three


def from_smallest_three(largest: np.ndarray, three: np.ndarray) -> np.ndarray:
    """Return unit quaternions (N, 4) float32 from the index of the largest component and the other three components."""
    out: np.ndarray = unit_quats(largest.astype(np.uint8), np.ascontiguousarray(three))
    return out
