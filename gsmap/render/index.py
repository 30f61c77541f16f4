"""Bounding boxes of chunks of Gaussians, so that a camera processes only the chunks that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.types import Gaussians

MAX_SIGMAS = 3.3290429  # sqrt(2 ln 255): no Gaussian is drawn farther from its centre


@dataclass(frozen=True, eq=False)
class ChunkIndex:
    """Bounding boxes of consecutive runs of Gaussians; they are tight if the Gaussians are in Morton order.

    Args:
        starts: (M + 1,) int64 first Gaussian of each chunk, followed by the number of Gaussians.
        low, high: (M, 3) float64 box around the centres of the chunk's Gaussians.
        radius: (M,) float64 largest scale in the chunk (one standard deviation).
    """

    starts: np.ndarray
    low: np.ndarray
    high: np.ndarray
    radius: np.ndarray

    @classmethod
    def build(cls, gaussians: Gaussians, chunk: int = 1024) -> ChunkIndex:
        """Compute the boxes of runs of ``chunk`` Gaussians in stored order.

        Sort scattered Gaussians first (`gsmap.geometry.morton`); scenes from the store are sorted already.
        """
        n = len(gaussians)
        starts = np.append(np.arange(0, n, chunk, dtype=np.int64), n)
        if n == 0:
            return cls(starts, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
        first = starts[:-1]
        with np.errstate(over="ignore"):
            x, y, z = gaussians.log_scales.T  # column by column, because `max` along rows is far slower
            radius = np.exp(np.fmax.reduceat(np.maximum(np.maximum(x, y), z).astype(np.float64), first))
        return cls(
            starts,
            np.fmin.reduceat(gaussians.means, first, axis=0).astype(np.float64),
            np.fmax.reduceat(gaussians.means, first, axis=0).astype(np.float64),
            radius,
        )

    def __post_init__(self) -> None:
        m = len(self.starts) - 1
        if self.low.shape != (m, 3) or self.high.shape != (m, 3) or self.radius.shape != (m,):
            raise InputError(
                f"ChunkIndex of {m} chunks needs low (M, 3), high (M, 3) and radius (M,), got {self.low.shape}, "
                f"{self.high.shape}, {self.radius.shape}",
                code="shape_mismatch",
            )

    @property
    def num_gaussians(self) -> int:
        return int(self.starts[-1])

    def visible_ranges(self, pose: np.ndarray, intrinsics_px: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return ranges (R, 2) int64 of Gaussians that a camera may see; every Gaussian that the camera draws is in a
        range.

        Args:
            pose: (3, 4) or (4, 4) transform from frame to camera.
            intrinsics_px: ``fx fy cx cy``.
        """
        rotation, translation = pose[:3, :3], pose[:3, 3]
        center = rotation @ ((self.low + self.high).T / 2) + translation[:, None]
        half = (self.high - self.low) / 2
        fx, fy, cx, cy = intrinsics_px
        # Each side of the frustum is a half-space n . x >= 0 in camera space; a box is outside if even its nearest
        # corner, extended by the reach of a Gaussian there, is outside. A Gaussian reaches MAX_SIGMAS standard
        # deviations, but its footprint is that of the projection linearized at its centre, which exceeds the true
        # outline near the image's border. There, dilation and the skewed Jacobian together stay below the factor used
        # here. Linearized at u = x/z, a sphere of radius r spans (r/z) sqrt(1 + u^2) on the plane z = 1. Outside the
        # plane of the border u_b that is a distance (u - u_b) z <= r sqrt(1 + u_c^2) with u_c the clamp of the
        # Jacobian.
        visible = np.ones(len(half), bool)
        reach = MAX_SIGMAS * self.radius
        nearest_z = center[2] + half @ np.abs(rotation[2])
        visible &= nearest_z > 0.01
        margin = 3.0  # in pixels: sqrt(0.3) of dilation times MAX_SIGMAS, and rounding
        for axis, focal, principal, size in ((0, fx, cx, width), (1, fy, cy, height)):
            clamp = max(principal / focal, (size - principal) / focal) + 0.15 * size / focal
            grow = reach * np.sqrt(1 + clamp**2)
            for sign, border in ((1.0, -(principal + margin) / focal), (-1.0, (size - principal + margin) / focal)):
                normal = np.zeros(3)
                normal[axis], normal[2] = sign, -sign * border
                distance = normal @ center + half @ np.abs(normal @ rotation) + grow
                visible &= distance > 0
        return join_ranges(self.starts, np.flatnonzero(visible))


def join_ranges(starts: np.ndarray, chunks: np.ndarray) -> np.ndarray:
    """Return the ranges (R, 2) int64 of rows of chunks (M,), which ascend; neighbouring chunks share a range.

    Args:
        starts: (C + 1,) first row of each chunk, followed by the number of rows.
    """
    if len(chunks) == 0:
        return np.zeros((0, 2), np.int64)
    breaks = np.flatnonzero(np.diff(chunks) > 1)
    first = chunks[np.append(0, breaks + 1)]
    last = chunks[np.append(breaks, len(chunks) - 1)]
    return np.ascontiguousarray(np.stack([starts[first], starts[last + 1]], axis=1))
