"""Small scenes for the store's tests."""

import numpy as np

from gsmap.methods import RecipeKey
from gsmap.types import Cameras, Gaussians


def key(stage: str, *inputs: str, **settings: object) -> RecipeKey:
    return RecipeKey(stage, "test", {stage: 1}, settings, "native", inputs)


def make_gaussians(n: int = 500, seed: int = 0, degree: int = 1) -> Gaussians:
    rng = np.random.default_rng(seed)
    return Gaussians(
        rng.uniform(-5, 5, size=(n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(size=(n, 3)) - 4,
        rng.normal(size=n),
        rng.normal(size=(n, (degree + 1) ** 2, 3)),
    )


def make_cameras(n: int = 3) -> Cameras:
    pose = np.tile(np.eye(4), (n, 1, 1))
    pose[:, 0, 3] = np.arange(n)
    return Cameras(pose, np.tile([100.0, 100, 32, 24], (n, 1)), np.tile([64, 48], (n, 1)), tuple("äbcdefgh"[:n]))
