"""Read and write the ``.splat`` of antimatter15's viewer: 32 bytes per Gaussian, no header, no view-dependent colour.

Position and linear scale in float32, then colour and opacity, then the quaternion, in bytes.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from gsmap.errors import InputError
from gsmap.formats.quantise import logits_of_bytes, opacity_bytes, require_writable
from gsmap.geometry.sh import rgb_of_sh0, sh0_of_rgb
from gsmap.types import Gaussians

VERSION = 1

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgb", "u1", 3), ("opacity", "u1"), ("quat", "u1", 4)])
_TINY = np.finfo(np.float32).tiny


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a ``.splat``; replace scales of zero by the smallest positive scale.

    Raises:
        InputError: The file is empty, or its size is not a multiple of a row.
    """
    size = Path(path).stat().st_size
    if size == 0 or size % _ROW.itemsize:
        what = "empty" if size == 0 else f"{size} bytes long, not a multiple of {_ROW.itemsize}"
        raise InputError(f"{path} is not a complete .splat file: it is {what}", code="wrong_file_type")
    rows = np.fromfile(path, _ROW)
    quats = (rows["quat"].astype(np.float32) - 128) / 128
    quats[~quats.any(1), 0] = 1
    with np.errstate(invalid="ignore"):  # a negative scale becomes NaN, which validation names
        log_scales = np.log(np.where(rows["scale"] == 0, _TINY, rows["scale"]))
    sh = sh0_of_rgb(rows["rgb"].astype(np.float32) / 255)
    return Gaussians(rows["mean"], quats, log_scales, logits_of_bytes(rows["opacity"]), sh[:, None])


def write(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a ``.splat`` in the order of the Gaussians; drop SH beyond degree 0, and clip colours to [0, 1]."""
    require_writable(path, gaussians)
    rows = np.empty(len(gaussians), _ROW)
    rows["mean"] = gaussians.means
    rows["scale"] = gaussians.scales
    rows["rgb"] = np.round(np.clip(rgb_of_sh0(gaussians.sh[:, 0]), 0, 1) * 255)
    rows["opacity"] = opacity_bytes(gaussians.logit_opacities)
    unit = gaussians.quats / np.maximum(np.linalg.norm(gaussians.quats, axis=1, keepdims=True), 1e-30)
    rows["quat"] = np.clip(np.round(unit * 128 + 128), 0, 255)
    rows.tofile(path)
