"""Compute rotations between directions, and directions that cover a sphere evenly."""

from __future__ import annotations

import numpy as np


def rotation_to_z(up: np.ndarray) -> np.ndarray:
    """Return the shortest rotation (3, 3) that rotates a unit vector (3,) to +z."""
    x, y, z = up
    if z < -1 + 1e-9:
        return np.diag([1.0, -1.0, -1.0])
    k = np.array([[0, 0, -x], [0, 0, -y], [x, y, 0]])
    rotation: np.ndarray = np.eye(3) + k + k @ k / (1 + z)
    return rotation


def rotation_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the shortest rotation (3, 3) that rotates the direction of ``a`` (3,) to the unit vector ``b`` (3,).

    It is computed from axis and angle. So it is an exact rotation even for nearly opposite directions, unlike
    `rotation_to_z`. The result is the identity if ``a`` has length 0.
    """
    from scipy.spatial.transform import Rotation

    length = np.linalg.norm(a)
    if length < 1e-9:
        return np.eye(3)
    axis = np.cross(a / length, b)
    sine, cosine = np.linalg.norm(axis), float(a @ b / length)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        # Rotate by half a turn about any perpendicular axis.
        least = int(np.argmin(np.abs(b)))
        side = np.eye(3)[least] - b[least] * b
        side /= np.linalg.norm(side)
        return 2 * np.outer(side, side) - np.eye(3)
    matrix: np.ndarray = Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
    return matrix


def median_direction(directions: np.ndarray) -> np.ndarray | None:
    """Return the direction (3,) of the median of unit vectors (N, 3); None without vectors, or if they cancel out."""
    middle = np.median(directions, axis=0) if len(directions) else np.zeros(3)
    size = float(np.linalg.norm(middle))
    return middle / size if size > 1e-3 else None


def fibonacci_sphere(count: int) -> np.ndarray:
    """Return (count, 3) unit vectors spread evenly over the sphere (golden spiral), from +z downwards."""
    k = np.arange(count) + 0.5
    z = 1 - 2 * k / count
    turn = np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)


def level_frame(up: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) that rotates ``up`` (3,) to +z; the remaining rotation about z depends on ``up``
    alone."""
    z = np.asarray(up, float) / np.linalg.norm(up)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
