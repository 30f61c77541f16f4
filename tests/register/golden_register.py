"""Golden cases of this room: what each method answers on a small input; see tests/contracts.

A change of these bits asks for a higher ``VERSION`` of the method they belong to.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from register_worlds import SplatWorld, splat_world, two_pose_world

from gsmap.errors import MissingDependencyError
from gsmap.geometry.rotations import exp_so3
from gsmap.methods import family
from gsmap.register import Params, register_pair
from gsmap.register.metric_scene import MetricScene
from gsmap.register.proposers import graph, kiss_matcher
from gsmap.register.surface import Surface
from gsmap.register.view_cache import ViewCache
from gsmap.types import Proposal, Registration, Sim3


@lru_cache(maxsize=4)
def _world(seed: int = 0, place: tuple[int, int] = (7, 7), cut_m: tuple[float, float] = (3.8, 2.2)) -> SplatWorld:
    return splat_world(seed, place=place, points=6000, nodes=120, policy="known", cut_m=cut_m)


def _register() -> dict[str, np.ndarray]:
    params = Params(fallback="never")
    right, wrong = _world(), _world(1, place=(20, 40))
    wrong.source.graph.layers["landmarks"] = right.source.graph.layers["landmarks"]
    accepted = register_pair(right.target, right.source, params)
    refused = register_pair(right.target, wrong.source, params)
    assert accepted.status == "accepted"
    assert refused.status != "accepted"
    return {**_arrays("accepted", accepted), **_arrays("refused", refused)}


def _arrays(name: str, found: Registration) -> dict[str, np.ndarray]:
    figures = [*found.evidence.values(), found.overlap, found.num_inliers, found.num_correspondences, found.exact]
    out = {f"{name}_figures": np.array(figures, dtype=np.float64)}
    if found.S_target_source is not None:
        out[f"{name}_pose"] = found.S_target_source.matrix()
    if found.information is not None:
        out[f"{name}_information"] = found.information
    return out


def _graph() -> dict[str, np.ndarray]:
    world, _ = two_pose_world(first=30, second=24)
    return _proposals(graph.propose_by_kind(*world.graphs(), "landmarks"))


def _kiss_matcher() -> dict[str, np.ndarray]:
    """The same to the last bit in every run, whatever used threads before it; but only on one core."""
    if not hasattr(os, "sched_setaffinity"):
        raise MissingDependencyError("this system cannot keep kiss_matcher on one core: its pose varies between runs")
    world = splat_world(8, points=20_000, policy="known", cut_m=(6.0, 0.0), with_cameras=False)
    scenes = (MetricScene(view, 1.0) for view in (world.target, world.source))
    return _proposals(kiss_matcher.propose(*scenes))


def _proposals(found: list[Proposal]) -> dict[str, np.ndarray]:
    figures = [(p.num_inliers, p.num_correspondences, p.log_nfa, p.runner_up) for p in found]
    poses = [p.S_target_source.matrix() for p in found]
    return {"poses": np.array(poses), "figures": np.array(figures, dtype=np.float64)}


def _refined(name: str) -> Callable[[], dict[str, np.ndarray]]:
    def run() -> dict[str, np.ndarray]:
        refiner = family("refiner").get(name)
        world, out = _world(), {}
        # Renders of so few points only match those of the same points; what else there is refines another sampling.
        same = name == "photometric"
        target, source = (
            Surface.of(view.gaussians, 1.0, view.cameras, ViewCache(view.gaussians, view.cameras))
            for view in (world.target, world.target if same else world.source)
        )
        middle = source.points.mean(0)
        turn = exp_so3([0.0, 0.004, 0.007])
        start = Sim3(turn, middle - turn @ middle + [0.01, 0.0, 0.02])
        start = start if same else world.S_target_source @ start
        out["rigid"] = refiner.refine(target, source, start).matrix()
        if refiner.SCALES:
            out["scaled"] = refiner.refine(target, source, start, with_scale=True).matrix()
        return out

    return run


CASES: dict[str, Callable[[], dict[str, np.ndarray]]] = {
    "register": _register,
    "proposer.graph": _graph,
    "proposer.kiss_matcher": _kiss_matcher,
    **{f"refiner.{name}": _refined(name) for name in ("colored_icp", "gicp", "icp", "none", "photometric")},
}
