"""Gaussians for the format tests, and how far two sets may differ."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st

from gsmap.geometry import rotations, transforms
from gsmap.types import Gaussians


def random_gaussians(n: int = 100, degree: int = 3, seed: int = 0, extent: float = 5.0) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-extent, extent, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(-7, -1, (n, 3)),
        rng.normal(0, 3, n),
        rng.normal(0, 0.2, (n, (degree + 1) ** 2, 3)),
    )


gaussians = st.builds(
    random_gaussians,
    n=st.sampled_from([1, 2, 255, 256, 257, 700]),
    degree=st.integers(0, 3),
    seed=st.integers(0, 1000),
    extent=st.sampled_from([1e-3, 0.1, 3.0, 100.0, 5000.0]),
)


def angles_rad(a: Gaussians, b: Gaussians) -> np.ndarray:
    """(N,) angle between the rotations of two sets, exact for small ones."""
    unit = [g.quats.astype(np.float64) / np.linalg.norm(g.quats, axis=1, keepdims=True) for g in (a, b)]
    chord = np.minimum(np.linalg.norm(unit[0] - unit[1], axis=1), np.linalg.norm(unit[0] + unit[1], axis=1))
    return 4 * np.arcsin(np.minimum(1, chord / 2))


def covariances(g: Gaussians) -> np.ndarray:
    axes = rotations.quats_to_matrices(g.quats) * np.exp(g.log_scales.astype(np.float64))[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def colours_along(g: Gaussians, directions: np.ndarray) -> np.ndarray:
    """(N, D, 3) colours seen along unit directions (D, 3), before the clamp."""
    return np.einsum("dk,nkc->ndc", transforms.sh_basis(directions, g.sh_degree), g.sh.astype(np.float64)) + 0.5


def directions(count: int = 20) -> np.ndarray:
    d = np.random.default_rng(1).normal(size=(count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)
