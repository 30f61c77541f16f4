"""Convert between colours and spherical harmonics of degree 0."""

from __future__ import annotations

import numpy as np

SH_C0 = 0.28209479177387814
"""Y_0^0 = 1 / (2 sqrt(pi)); a Gaussian's mean colour is ``0.5 + SH_C0 * sh[0]``."""


def rgb_of_sh0(sh0: np.ndarray) -> np.ndarray:
    """Return the (..., 3) colours of degree-0 coefficients (..., 3), in the same precision and not clipped."""
    return sh0 * SH_C0 + 0.5


def sh0_of_rgb(rgb: np.ndarray) -> np.ndarray:
    """Return the (..., 3) degree-0 coefficients of colours (..., 3), in the same precision."""
    return (rgb - 0.5) / SH_C0
