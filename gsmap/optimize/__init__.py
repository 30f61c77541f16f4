"""Edges in, one pose per scene out: robust, incremental, honest about islands.

`optimize` is the entry; `diff` and `moved` compare two answers. Heavy libraries (gtsam, networkx) load on first use.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from gsmap.optimize.changes import diff, motion, moved
from gsmap.types import Edge, PoseChange, PoseGraph, Prior

if TYPE_CHECKING:
    from gsmap.optimize.batch import OptimizeParams

__all__ = ["OptimizeParams", "PoseChange", "diff", "motion", "moved", "optimize"]


def optimize(
    scene_ids: Sequence[str],
    edges: Sequence[Edge],
    priors: Sequence[Prior] = (),
    previous: PoseGraph | None = None,
    params: OptimizeParams | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> PoseGraph:
    """Poses of all scenes from pairwise edges, some of which are wrong. Pure and deterministic.

    Recipe: every edge is voted on by the triangles through it; poses are spread along the best supported edges; a
    chordal relaxation and reweighted Gauss-Newton refine them; edges that contradict the result are let go and those
    that agree with it taken in; islands join where the evidence suffices; a clean Levenberg-Marquardt solve per
    component, with one gauge prior each, gives poses and marginal covariances.

    Args:
        scene_ids: all scenes of the map, oldest first (the oldest scene of a component holds its frame).
        edges: the measurements to consider; leave out what a person rejected.
        priors: outside knowledge. A component whose priors leave a freedom open is held there by its anchor scene.
        previous: the last answer. Its largest component's frame survives, so that maps do not jump. If only few
            scenes are new, they are placed in it (``provenance.method == "incremental"``); see `OptimizeParams`.
        params: see `OptimizeParams`.
        progress: called with a fraction and a short text.

    Raises:
        InputError: an edge or prior is unusable, or confirmed edges contradict each other; the message names it.
    """
    from dataclasses import replace

    from gsmap.optimize.batch import OptimizeParams, solve_batch
    from gsmap.optimize.incremental import fingerprint, place_new

    params = params or OptimizeParams()
    if previous is not None and params.growth > 0:
        placed = place_new(scene_ids, edges, priors, previous, params)
        if placed is not None:
            return placed
    answer = solve_batch(scene_ids, edges, priors, previous, params, progress)
    measured = f"{fingerprint(edges, priors):016x}"
    return replace(answer, provenance=replace(answer.provenance, measured=measured))


def __getattr__(name: str) -> Any:
    if name == "OptimizeParams":
        from gsmap.optimize.batch import OptimizeParams

        return OptimizeParams
    raise AttributeError(f"module 'gsmap.optimize' has no attribute {name!r}")
