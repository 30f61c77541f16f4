"""Pack each Gaussian, with one colour, into four to six bytes, for renders with which photos are aligned.

Values are rounded to steps that renders do not show: means to a share of the Gaussians' size, shapes as logarithms of
their covariances (Log-Euclidean metrics, Arsigny et al. 2006), so that the rotation of a round Gaussian costs nothing.
Gaussians are sorted along a Morton curve, on which colours change little.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.localize import compression
from gsmap.types import Gaussians

NAMES = ("gaussians.grid", "gaussians.ranges", "gaussians.places", "gaussians.shapes", "gaussians.colours")

_PLACE_STEP = 0.2  # of the median size of a Gaussian
_SHAPE_STEPS = (0.08, 0.15)  # of the log standard deviation: for a Gaussian's size, and for its shape
_COLOUR_STEPS = (0.05, 0.1)  # of the first SH coefficient (0.014 and 0.028 of a colour in [0, 1]): green, and the rest
_OPACITY_LEVELS = 15.0
_BYTE = 255.0


def pack(gaussians: Gaussians, coarse: float = 1.0) -> dict[str, np.ndarray]:
    """Pack finite Gaussians into arrays, sorted along a curve; view-dependent colour is dropped.

    Args:
        coarse: factor on the rounding steps; 1 for steps that renders hardly show.
    """
    low = gaussians.means.min(0).astype(np.float64) if len(gaussians) else np.zeros(3)
    step = compression.finest_step(gaussians.means, coarse * place_step(gaussians))
    codes = compression.encode_points(gaussians.means, low, step)
    order = np.argsort(codes, kind="stable")
    shapes, shape_range = _quantize(_log_covariances(gaussians)[order], coarse, *_SHAPE_STEPS)
    greens = _green_first(gaussians.sh[order, 0].astype(np.float64))
    colours, colour_range = _quantize(greens, coarse, *_COLOUR_STEPS)
    opacity = 1 / (1 + np.exp(-gaussians.logit_opacities[order].astype(np.float64)))
    opacities = np.round(opacity * _OPACITY_LEVELS).astype(np.uint8)
    changes = np.diff(colours, axis=0, prepend=np.uint8(0))  # modulo 256
    return {
        "gaussians.grid": np.r_[len(order), low, step],
        "gaussians.ranges": np.concatenate([shape_range, colour_range], axis=1),
        "gaussians.places": compression.compress(compression.code_steps(codes[order], np.zeros(1, np.int64))),
        "gaussians.shapes": compression.compress(shapes.T),
        "gaussians.colours": compression.compress(np.concatenate([changes.T, opacities[None]])),
    }


def unpack(arrays: Mapping[str, np.ndarray], most: int) -> Gaussians:
    """Unpack Gaussians that `pack` packed.

    Args:
        most: largest possible number of Gaussians; arrays with more Gaussians are damaged.

    Raises:
        ValueError, KeyError: the arrays do not come from `pack`.
    """
    grid, ranges = arrays["gaussians.grid"], arrays["gaussians.ranges"]
    if grid.shape != (5,) or ranges.shape != (2, 9) or not (np.isfinite(grid).all() and np.isfinite(ranges).all()):
        raise ValueError("invalid ranges")
    count = int(grid[0])
    if not 0 <= count <= most:
        raise ValueError(f"{count} Gaussians")
    steps = compression.decompress(arrays["gaussians.places"], (8, count), np.uint8)
    codes = compression.codes_from_steps(steps, np.zeros(1, np.int64))
    shapes = compression.decompress(arrays["gaussians.shapes"], (6, count), np.uint8).T
    rest = compression.decompress(arrays["gaussians.colours"], (4, count), np.uint8).T
    colours = np.cumsum(rest[:, :3], axis=0, dtype=np.uint8)
    low, step = ranges
    quats, log_scales = _from_log_covariances(low[:6] + shapes * step[:6])
    opacity = np.clip(rest[:, 3], 0.25, _OPACITY_LEVELS - 0.25) / _OPACITY_LEVELS
    return Gaussians(
        compression.decode_points(codes, grid[1:4], grid[4]).astype(np.float32),
        quats,
        log_scales,
        np.log(opacity / (1 - opacity)).astype(np.float32),
        _from_green(low[6:] + colours * step[6:]).astype(np.float32)[:, None],
    )


def place_step(gaussians: Gaussians) -> float:
    """Return the step to which positions of Gaussians and features are rounded."""
    return _PLACE_STEP * float(np.exp(np.median(gaussians.log_scales))) if len(gaussians) else 1.0


def _quantize(values: np.ndarray, coarse: float, first: float, others: float) -> tuple[np.ndarray, np.ndarray]:
    """Quantize values to (N, D) uint8; return them with the (2, D) offsets and steps.

    Args:
        coarse: factor on the steps.
        first, others: step of the first column, and step of the remaining columns.
    """
    low = values.min(0) if len(values) else np.zeros(values.shape[1])
    spread = values.max(0) - low if len(values) else np.zeros(values.shape[1])
    steps = np.maximum(coarse * np.r_[first, np.full(values.shape[1] - 1, others)], spread / _BYTE)
    return np.round((values - low) / steps).astype(np.uint8), np.stack([low, steps])


def _log_covariances(gaussians: Gaussians) -> np.ndarray:
    """Return (N, 6) halved log covariances: the mean of the diagonal, two differences from that mean, and the
    off-diagonal elements.

    For a round Gaussian all elements but the first are zero.
    """
    turned = quats_to_matrices(gaussians.quats.astype(np.float64))
    logs = np.einsum("nij,nj,nkj->nik", turned, gaussians.log_scales.astype(np.float64), turned)
    mean = np.trace(logs, axis1=1, axis2=2) / 3
    return np.stack(
        [mean, logs[:, 0, 0] - mean, logs[:, 1, 1] - mean, logs[:, 0, 1], logs[:, 0, 2], logs[:, 1, 2]], axis=1
    )


def _from_log_covariances(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the quaternions (N, 4) and log scales (N, 3), float32, of halved log covariances."""
    mean, first, second, xy, xz, yz = values.T
    logs = np.empty((len(values), 3, 3))
    logs[:, 0, 0], logs[:, 1, 1], logs[:, 2, 2] = mean + first, mean + second, mean - first - second
    logs[:, 0, 1] = logs[:, 1, 0] = xy
    logs[:, 0, 2] = logs[:, 2, 0] = xz
    logs[:, 1, 2] = logs[:, 2, 1] = yz
    log_scales, turned = np.linalg.eigh(logs)
    turned[np.linalg.det(turned) < 0, :, 0] *= -1
    return matrices_to_quats(turned).astype(np.float32), log_scales.astype(np.float32)


def _green_first(rgb: np.ndarray) -> np.ndarray:
    """Return green, and the differences of red and of blue from green."""
    return np.stack([rgb[:, 1], rgb[:, 0] - rgb[:, 1], rgb[:, 2] - rgb[:, 1]], axis=1)


def _from_green(values: np.ndarray) -> np.ndarray:
    green, red, blue = values.T
    return np.stack([green + red, green, green + blue], axis=1)
