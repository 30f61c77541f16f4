"""Bounding boxes of chunks of Gaussians, so that a camera processes only the chunks that it sees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError
from gsmap.types import Gaussians

MAX_SIGMAS = 3.3290429  # sqrt(2 ln 255): no Gaussian is drawn farther from its centre
_NEAR, _DILATION = 0.01, 0.3  # near plane, and variance (px^2) that is added to every footprint
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])  # of a box


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
        return join_ranges(self.starts, self._visible_chunks(pose, intrinsics_px, width, height))

    def _visible_chunks(self, pose: np.ndarray, intrinsics_px: np.ndarray, width: int, height: int) -> np.ndarray:
        """Return the rows (V,) of the chunks that a camera may see."""
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
        return np.flatnonzero(visible)

    def candidates(
        self, pose: np.ndarray, intrinsics_px: np.ndarray, width: int, height: int, block_px: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the chunks that a camera may see, nearest first.

        Each has a range (V, 2) of Gaussians, the least depth (V,) of their centres, and a box (V, 4) of the blocks of
        pixels that they may touch, ``x0 y0 x1 y1`` (half open).

        Args:
            pose, intrinsics_px: see `visible_ranges`.
            block_px: edge length of a block.
        """
        chunks = self._visible_chunks(pose, intrinsics_px, width, height)
        low, high, radius = self.low[chunks], self.high[chunks], self.radius[chunks]
        rotation, half = pose[:3, :3], (high - low) / 2
        center = rotation @ ((low + high).T / 2) + pose[:3, 3:]
        nearest_z = center[2] - half @ np.abs(rotation[2])
        corners = center + np.einsum("ka,va,ia->kiv", _CORNERS, half, rotation)  # (8, 3, V)
        box = np.zeros((4, len(chunks)))
        box[2:] = np.array([[width], [height]])
        with np.errstate(all="ignore"):
            for axis, size in ((0, width), (1, height)):
                focal, principal = intrinsics_px[axis], intrinsics_px[axis + 2]
                clamp = max(principal / focal, (size - principal) / focal) + 0.15 * size / focal
                reach = MAX_SIGMAS * np.sqrt((1 + clamp**2) * (focal * radius / nearest_z) ** 2 + _DILATION) + 2
                at = focal * corners[:, axis] / corners[:, 2] + principal
                box[axis], box[axis + 2] = at.min(0) - reach, at.max(0) + reach
        is_bounded = (nearest_z > _NEAR) & np.isfinite(box).all(0)
        box[:2, ~is_bounded], box[2:, ~is_bounded] = 0, np.array([[width], [height]])
        blocks = np.empty((len(chunks), 4), np.int64)
        for axis, size in ((0, width), (1, height)):
            count = -(-size // block_px)
            blocks[:, axis] = np.clip(np.floor(box[axis] / block_px), 0, count)
            blocks[:, axis + 2] = np.clip(np.floor(box[axis + 2] / block_px) + 1, 0, count)
        rounding = 1e-6 * np.abs(nearest_z) + 1e-9 * (np.abs(center[2]) + half.sum(1) + np.abs(pose[:3, 3]).sum())
        depths = np.maximum(nearest_z - rounding, 0).astype(np.float32)
        order = np.argsort(depths, kind="stable")
        rows = chunks[order]
        return np.stack([self.starts[rows], self.starts[rows + 1]], axis=1), depths[order], blocks[order]


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
