"""Convert between colour spaces."""

from __future__ import annotations

import numpy as np

_XYZ_RGB = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
_WHITE_D65 = np.array([0.95047, 1.0, 1.08883])


_BLOCK = 32_768  # number of colours per block, so that intermediate arrays stay in the processor's cache


def srgb_to_lab(rgb: np.ndarray) -> np.ndarray:
    """Convert sRGB (..., 3) in [0, 1], or bytes, to CIE L*a*b* (..., 3) float32 (IEC 61966-2-1, white point D65)."""
    rgb = np.asarray(rgb)
    flat = rgb.reshape(-1, 3)
    if len(flat) > _BLOCK:
        from gsmap.geometry.threads import map_ahead  # imported here, as few colours do not need it

        blocks = (flat[i : i + _BLOCK] for i in range(0, len(flat), _BLOCK))
        return np.concatenate(list(map_ahead(_lab, blocks))).reshape(rgb.shape)
    return _lab(rgb)


def _linear(rgb: np.ndarray) -> np.ndarray:
    """Undo the transfer curve of sRGB."""
    rgb = np.clip(rgb.astype(np.float64), 0.0, 1.0)
    return np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)


_LINEAR_OF_BYTES = _linear(np.arange(256) / 255.0)


def _lab(rgb: np.ndarray) -> np.ndarray:
    linear = _LINEAR_OF_BYTES[rgb] if rgb.dtype == np.uint8 else _linear(rgb)
    xyz = linear @ _XYZ_RGB.T / _WHITE_D65
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], -1).astype(
        np.float32
    )
