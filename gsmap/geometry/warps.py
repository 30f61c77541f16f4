"""Change the shape of a scene smoothly: stretch it along axes and bend it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.rotations import matrices_to_quats, quats_to_matrices
from gsmap.types import Cameras, Gaussians

REACH = 2.5  # radii from the centre up to which a warp is quadratic; beyond, it continues linearly


@dataclass(frozen=True, eq=False)
class Warp:
    """A smooth change of shape: a point ``p`` moves by ``strain (p - centre) + radius bend(q, q)``, where
    ``q = (p - centre) / radius``.

    Args:
        centre: (3,) point that stays.
        radius: radius of the part of the scene to which the warp was fitted, in the scene's unit.
        strain: (3, 3) symmetric: relative change of length along its axes.
        bend: (3, 3, 3) curvature of each component, symmetric in the last two axes.
    """

    centre: np.ndarray
    radius: float
    strain: np.ndarray
    bend: np.ndarray

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Return where points (N, 3) move to."""
        local, fade, _ = self._local(points)
        bent = np.einsum("aij,ni,nj->na", self.bend, local, local)
        moved: np.ndarray = points + self.radius * (local @ self.strain + fade[:, None] * bent)
        return moved

    def jacobians(self, points: np.ndarray) -> np.ndarray:
        """Return the (N, 3, 3) derivatives of `apply`."""
        local, fade, slope = self._local(points)
        bent = np.einsum("aij,nj->nai", self.bend, local)
        far = np.einsum("nai,ni->na", bent, local)[:, :, None] * (slope[:, None] * local)[:, None]
        jacobians: np.ndarray = np.eye(3) + self.strain + 2 * fade[:, None, None] * bent + far
        return jacobians

    def scaled(self, factor: float) -> Warp:
        """Return the warp of a scene whose coordinates are multiplied by ``factor``."""
        return replace(self, centre=self.centre * factor, radius=self.radius * factor)

    def largest_motion(self, bounds: np.ndarray) -> float:
        """Return an upper estimate of the distance by which a point in a box (2, 3) moves."""
        grid = np.stack(np.meshgrid(*np.linspace(bounds[0], bounds[1], 9).T, indexing="ij"), axis=-1).reshape(-1, 3)
        return 1.1 * float(np.linalg.norm(self.apply(grid) - grid, axis=1).max())

    def _local(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return ``q``, the (N,) factor of the bend, which makes it linear beyond the reach, and the factor's slope
        along ``q``."""
        local = (points - self.centre) / self.radius
        squares = (local**2).sum(1)
        ratio = REACH / np.sqrt(np.maximum(squares, REACH**2))
        return local, ratio * (2 - ratio), -2 * (1 - ratio) * ratio / np.maximum(squares, 1e-12)


def warp_gaussians(gaussians: Gaussians, warp: Warp) -> Gaussians:
    """Move Gaussians by a warp, and turn and stretch each by the warp's derivative.

    Spherical harmonics stay, since a bend of some percent turns Gaussians by a few degrees.
    """
    moved = warp.apply(gaussians.positions) - gaussians.origin
    return deform_gaussians(gaussians, moved, warp.jacobians(gaussians.positions))


def deform_gaussians(gaussians: Gaussians, means: np.ndarray, jacobians: np.ndarray) -> Gaussians:
    """Give Gaussians other means (N, 3) and deform each by a matrix: (N, 3, 3), or one (3, 3) for all."""
    axes = quats_to_matrices(gaussians.quats.astype(np.float64)) * np.exp(gaussians.log_scales)[:, None]
    rotations, scales, _ = np.linalg.svd(jacobians @ axes)
    rotations[:, :, 2] *= np.linalg.det(rotations)[:, None]
    return replace(
        gaussians,
        means=means.astype(np.float32),
        quats=matrices_to_quats(rotations).astype(np.float32),
        log_scales=np.log(np.maximum(scales, 1e-30)).astype(np.float32),
    )


def warp_cameras(cameras: Cameras, warp: Warp) -> Cameras:
    """Move cameras by a warp, and turn each by the rotation that is nearest to the warp's derivative."""
    poses = cameras.T_frame_camera.copy()
    u, _, vt = np.linalg.svd(warp.jacobians(poses[:, :3, 3]) @ poses[:, :3, :3])
    poses[:, :3, :3] = u @ vt
    poses[:, :3, 3] = warp.apply(poses[:, :3, 3])
    return replace(cameras, T_frame_camera=poses, notes=())
