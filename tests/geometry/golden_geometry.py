"""Small cases of the geometry whose answers are kept: bits that change here change every stored result."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmap.geometry.rotations import exp_so3
from gsmap.geometry.transforms import transform_gaussians
from gsmap.geometry.umeyama import umeyama
from gsmap.geometry.voxels import merge_groups, voxel_labels
from gsmap.types import Gaussians, Sim3


def _gaussians(n: int = 120, degree: int = 3) -> Gaussians:
    rng = np.random.default_rng(11)
    return Gaussians(
        rng.uniform(-1, 1, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.normal(-3, 0.5, (n, 3)),
        rng.normal(size=n),
        rng.normal(0, 0.3, (n, (degree + 1) ** 2, 3)),
    )


def _arrays(gaussians: Gaussians) -> dict[str, np.ndarray]:
    return {name: getattr(gaussians, name) for name in ("means", "quats", "log_scales", "logit_opacities", "sh")}


def _merge_groups() -> dict[str, np.ndarray]:
    gaussians = _gaussians()
    labels = voxel_labels(gaussians.means, 0.7)
    merged, heaviest = merge_groups(gaussians, labels)
    return {**_arrays(merged), "labels": labels, "heaviest": heaviest}


def _umeyama() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(12)
    source = rng.normal(size=(40, 3))
    target = 1.7 * source @ exp_so3(np.array([0.3, -0.8, 0.5])).T + [1, 2, 3] + rng.normal(0, 0.05, (40, 3))
    weights = rng.uniform(0.1, 1, 40)
    return {
        "rigid": umeyama(target, source, weights=weights).matrix(),
        "similarity": umeyama(target, source, with_scale=True, weights=weights).matrix(),
        "mirrored": umeyama(target * [1, 1, -1], source, with_scale=True).matrix(),
    }


def _transform_gaussians() -> dict[str, np.ndarray]:
    S = Sim3(exp_so3(np.array([0.4, 1.1, -0.7])), np.array([0.5, -2.0, 4.0]), 1.3)
    return _arrays(transform_gaussians(_gaussians(40), S))


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "geometry.merge_groups": _merge_groups,
    "geometry.umeyama": _umeyama,
    "geometry.transform_gaussians": _transform_gaussians,
}
