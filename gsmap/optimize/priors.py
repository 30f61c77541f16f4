"""Pose priors of single scenes as least-squares terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gsmap.geometry.rotations import skew
from gsmap.geometry.similarities import Similarities, rotation_vectors
from gsmap.types import Prior

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class PriorTerms:
    """P priors as residuals of 10 rows: [rotation (3), translation (3), log scale, up (3)].

    Args:
        scenes: (P,) row of each prior's scene.
        expected: P expected poses.
        root_weights: (P, 10) square roots of the weights, 0 where a component is unknown.
        ups: (P, 3) unit up direction in the scene's frame, or 0.
    """

    scenes: np.ndarray
    expected: Similarities
    root_weights: np.ndarray
    ups: np.ndarray

    @classmethod
    def stack(cls, scene_ids: Sequence[str], priors: Sequence[Prior]) -> PriorTerms:
        row = {scene: k for k, scene in enumerate(scene_ids)}
        weights = np.zeros((len(priors), 10))
        ups = np.zeros((len(priors), 3))
        for k, prior in enumerate(priors):
            weights[k, :7] = 1 / np.asarray(prior.sigmas, dtype=np.float64)
            if prior.up is not None:
                ups[k] = np.asarray(prior.up, dtype=np.float64) / np.linalg.norm(prior.up)
                weights[k, 7:] = 1 / prior.up_sigma_rad
        scenes = np.array([row[p.scene] for p in priors], dtype=np.int64)
        return cls(scenes, Similarities.stack([p.S_map_scene for p in priors]), weights, ups)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, rows: np.ndarray | slice) -> PriorTerms:
        return PriorTerms(self.scenes[rows], self.expected[rows], self.root_weights[rows], self.ups[rows])

    def linearize(self, poses: Similarities) -> tuple[np.ndarray, np.ndarray]:
        """Compute the whitened residuals (P, 10) and their derivatives (P, 10, 7) with respect to a step on the scene
        side."""
        pose = poses[self.scenes]
        back = self.expected.rotations.transpose(0, 2, 1)
        shrink = np.exp(-self.expected.log_scales)
        omega = rotation_vectors(back @ pose.rotations)
        up = np.einsum("pij,pj->pi", pose.rotations, self.ups)
        residual = np.concatenate(
            [
                omega,
                np.einsum("pij,pj->pi", back, pose.translations - self.expected.translations) * shrink[:, None],
                (pose.log_scales - self.expected.log_scales)[:, None],
                np.cross(up, UP),
            ],
            axis=1,
        )
        J = np.zeros((len(self), 10, 7))
        J[:, :3, :3] = _inverse_right_jacobian(omega)
        J[:, 3:6, 3:6] = back @ pose.rotations * (shrink * np.exp(pose.log_scales))[:, None, None]
        J[:, 6, 6] = 1.0
        J[:, 7:, :3] = skew(UP) @ pose.rotations @ skew(self.ups)
        return residual * self.root_weights, J * self.root_weights[:, :, None]


def _inverse_right_jacobian(omega: np.ndarray) -> np.ndarray:
    """Compute the derivative (N, 3, 3) of ``Log(R Exp(x))`` at x = 0, where ``omega = Log(R)``."""
    theta = np.linalg.norm(omega, axis=1)
    small = theta < 1e-4
    safe = np.where(small, 1.0, theta)
    # At exactly pi the logarithm is not differentiable; the limit from below is finite.
    factor = np.where(small, 1 / 12, 1 / safe**2 - 1 / (2 * safe * np.tan(safe / 2)))
    k = skew(omega)
    return np.eye(3) + k / 2 + factor[:, None, None] * (k @ k)
