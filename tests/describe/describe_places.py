"""A room of Gaussians that the tests of this folder share."""

import numpy as np
from scipy.spatial import cKDTree

from gsmap.geometry.sh import sh0_of_rgb
from gsmap.types import Cameras, Gaussians, Sim3


def room(seed: int = 0, n: int = 30000, patches: int = 120) -> tuple[Gaussians, Cameras]:
    """A 6 x 5 x 2.5 m room of flat Gaussians with coloured patches on all six sides and two boxes; 24 cameras."""
    rng = np.random.default_rng(seed)
    size = np.array([6.0, 5.0, 2.5])
    points = rng.uniform(0, 1, (n, 3)) * size
    side = rng.integers(0, 3, n)
    points[np.arange(n), side] = rng.integers(0, 2, n) * size[side]
    boxes = [([1.0, 1.0, 0.0], [2.2, 1.7, 0.75]), ([4.0, 3.0, 0.0], [4.8, 4.5, 0.9])]
    for low, high in boxes:
        low, high = np.array(low), np.array(high)
        p = low + rng.uniform(0, 1, (n // 10, 3)) * (high - low)
        axis = rng.integers(0, 3, len(p))
        p[np.arange(len(p)), axis] = np.where(rng.integers(0, 2, len(p)), high[axis], low[axis])
        points = np.concatenate([points, p])
    texture = np.random.default_rng(99)
    centres, colours = texture.uniform(0, 1, (patches, 3)) * size, texture.uniform(-0.4, 0.4, (patches, 3))
    on = texture.integers(0, 3, patches)
    centres[np.arange(patches), on] = texture.integers(0, 2, patches) * size[on]
    distance, index = cKDTree(centres).query(points)
    rgb = 0.5 + colours[index] * (distance < 0.12)[:, None]
    dc = sh0_of_rgb(rgb)
    m = len(points)
    gaussians = Gaussians(
        points, np.tile([1.0, 0, 0, 0], (m, 1)), np.full((m, 3), np.log(0.02)), np.full(m, 3.0), dc[:, None]
    )
    poses = np.tile(np.eye(4), (24, 1, 1))
    for i in range(24):
        yaw, pitch = 2 * np.pi * i / 24, -0.15
        forward = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        poses[i, :3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        poses[i, :3, 3] = [3.0 - 1.9 * np.cos(yaw), 2.5 - 1.9 * np.sin(yaw), 1.5]
    return gaussians, Cameras(poses, np.tile([200.0, 200, 160, 120], (24, 1)), np.tile([320, 240], (24, 1)))


def moved(gaussians: Gaussians, cameras: Cameras, S: Sim3) -> tuple[Gaussians, Cameras]:
    """The capture in another frame (colour has no view dependence here, so SH need not turn)."""
    log_scales = gaussians.log_scales + np.log(S.scale)
    poses = cameras.T_frame_camera.copy()
    poses[:, :3, :3] = S.rotation @ poses[:, :3, :3]
    poses[:, :3, 3] = S.apply(cameras.centers)
    g = Gaussians(S.apply(gaussians.means), gaussians.quats, log_scales, gaussians.logit_opacities, gaussians.sh)
    return g, Cameras(poses, cameras.intrinsics_px, cameras.sizes_px)
