"""Similarity transforms of 3D space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.errors import InputError


@dataclass(frozen=True, eq=False)
class Sim3:
    """A similarity ``x_a = scale * R @ x_b + t``; a variable ``S_a_b`` maps points from frame b to frame a.

    Args:
        rotation: (3, 3) float64, orthonormal with determinant +1.
        translation: (3,) float64, in the unit of frame a.
        scale: positive factor; exactly 1 for a rigid transform.

    Raises:
        InputError: not finite, not a rotation within 1e-6, or a scale that is not positive.
    """

    rotation: np.ndarray
    translation: np.ndarray
    scale: float = 1.0

    def __post_init__(self) -> None:
        rotation = np.array(self.rotation, dtype=np.float64)
        translation = np.array(self.translation, dtype=np.float64).reshape(-1)
        scale = float(self.scale)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise InputError(
                f"Sim3 needs a (3, 3) rotation and a (3,) translation, got {rotation.shape} and {translation.shape}",
                code="invalid_pose",
            )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and np.isfinite(scale)):
            raise InputError("Sim3 holds NaN or infinity: check where the transform was computed", code="not_finite")
        if scale <= 0:
            raise InputError(f"Sim3 scale must be positive, got {scale}", code="invalid_pose")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise InputError(
                "Sim3 rotation is not orthonormal with determinant +1: pass scale apart from rotation",
                code="invalid_pose",
            )
        rotation.flags.writeable = False
        translation.flags.writeable = False
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)
        object.__setattr__(self, "scale", scale)

    @classmethod
    def identity(cls) -> Sim3:
        return cls(np.eye(3), np.zeros(3), 1.0)

    @classmethod
    def many(cls, rotations: np.ndarray, translations: np.ndarray, scales: np.ndarray) -> list[Sim3]:
        """Build N similarities from (N, 3, 3), (N, 3) and (N,); raise `InputError` if one of them is invalid."""
        rotations, translations = np.array(rotations, dtype=np.float64), np.array(translations, dtype=np.float64)
        scales = np.asarray(scales, dtype=np.float64)
        finite = np.isfinite(rotations).all() and np.isfinite(translations).all() and np.isfinite(scales).all()
        if not finite or not (scales > 0).all():
            raise InputError("a pose holds NaN, infinity, or a scale that is not positive", code="not_finite")
        off = np.abs(np.einsum("nij,nkj->nik", rotations, rotations) - np.eye(3)).max(initial=0)
        if off > 1e-6 or (np.linalg.det(rotations) < 0).any():
            raise InputError("a pose's rotation is not orthonormal with determinant +1", code="invalid_pose")
        rotations.flags.writeable = False
        translations.flags.writeable = False
        out = []
        for rotation, translation, scale in zip(rotations, translations, scales.tolist(), strict=True):
            made = object.__new__(cls)
            object.__setattr__(made, "rotation", rotation)
            object.__setattr__(made, "translation", translation)
            object.__setattr__(made, "scale", scale)
            out.append(made)
        return out

    @classmethod
    def from_matrix(cls, matrix: np.ndarray) -> Sim3:
        """Build from a (4, 4) matrix ``[sR t; 0 1]``; a rotation within 1e-3 of SO(3) is projected to SO(3)."""
        matrix = np.asarray(matrix, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise InputError(
                f"a similarity needs a finite (4, 4) matrix, got shape {matrix.shape}", code="invalid_pose"
            )
        if np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise InputError(f"last row of a similarity must be 0 0 0 1, got {matrix[3].tolist()}", code="invalid_pose")
        u, singular, vt = np.linalg.svd(matrix[:3, :3])
        scale = float(singular.mean())
        if scale <= 0 or np.abs(singular / scale - 1).max() > 1e-3 or np.linalg.det(u @ vt) < 0:
            raise InputError(
                "matrix is not a similarity: its 3x3 part is not a positive multiple of a rotation", code="invalid_pose"
            )
        if abs(scale - 1) < 1e-9:
            scale = 1.0
        return cls(u @ vt, matrix[:3, 3], scale)

    def matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix ``[sR t; 0 1]``."""
        out = np.eye(4)
        out[:3, :3] = self.scale * self.rotation
        out[:3, 3] = self.translation
        return out

    def inverse(self) -> Sim3:
        """Return the inverse similarity: ``S_b_a`` for an ``S_a_b``."""
        return Sim3(self.rotation.T, -(self.rotation.T @ self.translation) / self.scale, 1.0 / self.scale)

    def __matmul__(self, other: Sim3) -> Sim3:
        """Compose two similarities: ``S_a_c = S_a_b @ S_b_c``."""
        rotation = self.rotation @ other.rotation
        # Long chains drift off SO(3); one polar projection keeps every product orthonormal to 1e-15.
        u, _, vt = np.linalg.svd(rotation)
        return Sim3(u @ vt, self.apply(other.translation), self.scale * other.scale)

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Map points (..., 3) from frame b to frame a, in float64."""
        moved: np.ndarray = self.scale * (np.asarray(points, dtype=np.float64) @ self.rotation.T) + self.translation
        return moved

    @property
    def is_rigid(self) -> bool:
        return self.scale == 1.0

    def __repr__(self) -> str:
        return f"Sim3(t={np.round(self.translation, 4).tolist()}, scale={self.scale:.6g})"


def check_sim3(value: object, name: str) -> None:
    """Raise `InputError` naming an argument that is not a `Sim3`."""
    if not isinstance(value, Sim3):
        raise InputError(
            f"{name} must be a gsmap.types.Sim3, got {type(value).__name__}; for a (4, 4) matrix M, pass "
            "Sim3.from_matrix(M)",
            code="invalid_pose",
        )
