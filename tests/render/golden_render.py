"""A small render whose images are kept."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmap.render import FitOptions, LearningRates, make_fitter, render
from gsmap.types import Cameras, Gaussians


def _scene() -> tuple[Gaussians, Cameras]:
    rng = np.random.default_rng(21)
    n = 150
    gaussians = Gaussians(
        rng.uniform(-1, 1, (n, 3)) + np.array([0, 0, 4]),
        rng.normal(size=(n, 4)),
        rng.normal(-2.2, 0.4, (n, 3)),
        rng.normal(1, 1, n),
        rng.normal(0, 0.4, (n, 9, 3)),
    )
    pose = np.tile(np.eye(4), (2, 1, 1))
    pose[1, :3, 3] = [0.4, -0.2, 0.3]
    return gaussians, Cameras(pose, np.tile([40.0, 42, 24, 18], (2, 1)), np.tile([48, 36], (2, 1)))


def _render() -> dict[str, np.ndarray]:
    gaussians, cameras = _scene()
    image = render(gaussians, cameras, background=(0.1, 0.2, 0.3), max_weight=True, backend="native")
    names = ("colour", "alpha", "depth", "dominant_id", "max_weight")
    return {name: getattr(image, name) for name in names}


def _fit() -> dict[str, np.ndarray]:
    gaussians, cameras = _scene()
    target = render(gaussians, cameras, backend="native").colour[:, ::-1].copy()
    fitter = make_fitter(gaussians, LearningRates(), options=FitOptions(ssim_weight=0.2), backend="native")
    losses = np.array([fitter.step(cameras, target) for _ in range(3)])
    fitted = fitter.gaussians()
    return {"losses": losses, "means": fitted.means, "sh": fitted.sh, "logit_opacities": fitted.logit_opacities}


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {"render": _render, "render.fit": _fit}
