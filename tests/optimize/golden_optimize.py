"""Small answers of the optimiser, kept so that a change of bits is noticed; see `tests/contracts`."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from made_worlds import PLACING, city, twin_wings

from gsmap.optimize import Params, gravity_align, optimize
from gsmap.optimize.cycles import count_cycle_support
from gsmap.optimize.measurements import measurements
from gsmap.optimize.perceptual_aliasing import resolve_aliased_loops
from gsmap.types import PoseGraph


def _arrays(answer: PoseGraph) -> dict[str, np.ndarray]:
    poses = list(answer.poses.values())
    outcomes = list(answer.outcomes.values())
    unknown = np.zeros((7, 7))
    return {
        "poses": np.array([p.S_map_scene.matrix() for p in poses]),
        "components": np.array([p.component for p in poses]),
        "placed": np.array([p.status == "placed" for p in poses]),
        "covariances": np.array([unknown if p.covariance is None else p.covariance for p in poses]),
        "used": np.array([("unused", "tentative", "used").index(o.use) for o in outcomes]),
        "undecided": np.array([o.undecided for o in outcomes]),
    }


def _batch() -> dict[str, np.ndarray]:
    world = city(40, 0.25, seed=7)
    return _arrays(optimize(world.ids, world.edges))


def _incremental() -> dict[str, np.ndarray]:
    world = city(30, 0.0, seed=1)
    old = [e for e in world.edges if world.ids[29] not in (e.target, e.source)]
    answer = optimize(world.ids, world.edges, previous=optimize(world.ids[:29], old, params=PLACING), params=PLACING)
    assert answer.provenance.method == "incremental"
    return _arrays(answer)


def _gravity() -> dict[str, np.ndarray]:
    world = city(12, 0.0, seed=3)
    answer = optimize(world.ids, world.edges, params=Params(marginals=False))
    ups = {scene: world.truth.rotations[k][2] for k, scene in enumerate(world.ids) if k % 3}
    return _arrays(gravity_align(answer, ups))


def _aliasing() -> dict[str, np.ndarray]:
    """The second wing lies on the first, held there by look-alikes; the true edges into it are left to contradict."""
    world = twin_wings(80, 0.06, seed=1)
    wing, first, second = 16, 48, 64
    m = measurements(world.ids, world.edges)
    low, high = np.minimum(m.targets, m.sources), np.maximum(m.targets, m.sources)
    accepted = ~((low < first) & (high >= second))
    poses = world.truth.replaced(np.arange(second, 80), world.truth[np.arange(first, first + wing)])
    params = Params()
    cycles = count_cycle_support(m, params.gate_probability)
    found = resolve_aliased_loops(m, accepted, np.zeros(len(m), dtype=bool), poses, cycles, params)
    return {"wrong": found.wrong, "right": found.right, "undecided": found.undecided}


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "optimize": _batch,
    "optimize.incremental": _incremental,
    "gravity_align": _gravity,
    "perceptual_aliasing": _aliasing,
}
