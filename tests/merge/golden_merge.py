"""A small case for every merger and for what they build on: where its bits change, a ``VERSION`` must be raised."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.merge import default_params, merge
from gsmap.merge.changes import resolve_changes
from gsmap.merge.exposure import apply_gain, balance_exposure
from gsmap.merge.tile import LazyScene, merge_tile
from gsmap.types import Cameras, Gaussians, MergeResult, PosedScene, Sim3

TILE = np.array([[-0.5, -1, -1], [0.5, 1, 1]])


def wall(seed: int, low: float, high: float, z: float = 0.0, half_height: float = 0.5) -> Gaussians:
    """Flat Gaussians on a plane that cameras look at along +z, with colours that change along it."""
    rng = np.random.default_rng(seed)
    xs, ys = np.meshgrid(np.arange(low, high, 0.06), np.arange(-half_height, half_height, 0.06))
    x, y = (v.ravel() + rng.uniform(-0.02, 0.02, v.size) for v in (xs, ys))
    n = len(x)
    sh = np.zeros((n, 4, 3))
    sh[:, 0] = np.stack([np.sin(5 * x), np.cos(4 * y), np.sin(3 * x - 2 * y)], axis=1) + rng.normal(0, 0.1, (n, 3))
    means = np.stack([x, y, z + rng.normal(0, 0.01, n)], axis=1)
    return Gaussians(
        means, np.tile([1.0, 0, 0, 0], (n, 1)), np.log(np.tile([0.05, 0.05, 0.006], (n, 1))), np.full(n, 3.0), sh
    )


def cameras(xs: np.ndarray) -> Cameras:
    T = np.tile(np.eye(4), (len(xs), 1, 1))
    T[:, 0, 3], T[:, 2, 3] = xs, -1.2
    return Cameras(T, np.tile([40.0, 40, 24, 16], (len(xs), 1)), np.tile([48, 32], (len(xs), 1)))


def scenes() -> list[PosedScene]:
    """Two captures of one wall; the later one is brighter, and a box that stood before the wall is gone."""
    before = Gaussians.concatenate([wall(0, -1.2, 0.5), wall(2, -0.2, 0.2, z=-0.4, half_height=0.12)])
    after = apply_gain(wall(1, -0.5, 1.2, z=0.01), np.array([1.15, 1.05, 0.95]))
    return [
        PosedScene(before, cameras(np.linspace(-0.9, 0.2, 5)), "a", "2026-01-01T00:00:00+00:00"),
        PosedScene(after, cameras(np.linspace(-0.2, 0.9, 5)), "b", "2026-02-01T00:00:00+00:00"),
    ]


def arrays_of(result: MergeResult, prefix: str) -> dict[str, np.ndarray]:
    g = result.gaussians
    found = {"means": g.means, "quats": g.quats, "log_scales": g.log_scales, "logit_opacities": g.logit_opacities}
    found |= {"sh": g.sh, "origin": result.origin, "counts": np.array([result.num_input, result.steps])}
    return {f"{prefix}.{name}": values for name, values in found.items()}


def merged(method: str, **settings: object) -> Callable[[], dict[str, np.ndarray]]:
    def case() -> dict[str, np.ndarray]:
        params = type(default_params(method))(**settings)
        whole, tile = (merge(scenes(), method, params, bounds=bounds) for bounds in (None, TILE))
        return arrays_of(whole, "whole") | arrays_of(tile, "tile")

    return case


def changes() -> dict[str, np.ndarray]:
    found = resolve_changes(scenes())
    pixels = found.outdated_pixels(0, cameras(np.zeros(1)))
    kept = {f"kept_{s.scene_id}": s.gaussians.means for s in found.scenes}
    return kept | {"lost": np.array(found.num_removed), "changed": found.changed[1], "overruled": pixels}


def exposure() -> dict[str, np.ndarray]:
    balanced, log_gains = balance_exposure(scenes())
    return {"log_gains": log_gains} | {f"sh_{s.scene_id}": s.gaussians.sh for s in balanced}


def tile() -> dict[str, np.ndarray]:
    """A tile read piece by piece from scenes in frames of their own."""
    S_scene_map = Sim3(np.array([[0.6, -0.8, 0], [0.8, 0.6, 0], [0, 0, 1]]), [1.0, 2, 3], 2.0)
    lazy = [
        LazyScene(
            scene.scene_id,
            S_scene_map.inverse(),
            lambda box, scene=scene: transform_gaussians(scene.gaussians, S_scene_map),
            transform_cameras(scene.cameras, S_scene_map),
        )
        for scene in scenes()
    ]
    return arrays_of(merge_tile(lazy, "union", bounds=TILE), "tile")


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "merge": tile,
    "merge.changes": changes,
    "merge.exposure": exposure,
    "merger.distance": merged("distance"),
    "merger.tto": merged("tto", steps=12, halo_m=0.4, balance_exposure=True),
    "merger.union": merged("union"),
    "merger.voxel": merged("voxel", voxel_m=0.05),
}
