"""Optimize: poses of all scenes from the edges in use, kept as a revision under what they were solved from."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from gsmap import optimize as solver
from gsmap.map.dates import parsed
from gsmap.map.settings import Settings
from gsmap.map.sharing import POLL_S
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.store import Store
from gsmap.types import Edge, PoseGraph, Prior, Scene
from gsmap.types.plain import canonical
from gsmap.types.progress import StageProgress


@dataclass(frozen=True, eq=False)
class PoseInputs:
    """What decides the poses of a map.

    Args:
        scenes: ids, in the order they came.
        edges: those that may be used.
        priors: outside knowledge.
        ups: (3,) direction against gravity in the scene's frame, by scene id, where it is known.
        key: the recipe with all of these as its inputs.
    """

    scenes: list[str]
    edges: list[Edge]
    priors: list[Prior]
    ups: dict[str, np.ndarray]
    key: RecipeKey


def pose_inputs(store: Store, settings: Settings) -> PoseInputs:
    """Read what decides the poses."""
    living, priors = store.scenes.list(), store.priors.list()
    scenes = [scene.id for scene in living]
    edges, named = [], []
    captured = {scene.id: scene.captured_at for scene in living}
    # By id, not in the order in which workers happened to finish: the same key whenever they were made.
    current = store.registrations.current()
    for stored in sorted(current, key=lambda r: (r.registration.target, r.registration.source)):
        registration = stored.registration
        usable = stored.review == "confirm" or (registration.status == "accepted" and stored.review != "reject")
        if not usable or registration.S_target_source is None or registration.information is None:
            continue
        edges.append(
            Edge(
                target=registration.target,
                source=registration.source,
                S_target_source=registration.S_target_source,
                information=registration.information,
                confirmed=stored.review == "confirm",
                disagreement=registration.evidence.get("disagreement", float("nan")),
                same_visit=_is_same_visit(
                    captured[registration.target],
                    captured[registration.source],
                    settings.optimize.aliasing.same_visit_h,
                ),
            )
        )
        named.append(f"{stored.key or stored.number} {stored.review}" + " same visit" * edges[-1].same_visit)
    ups = _ups(store, living, {key.digest for key in graph_keys(store, living, settings).values()})
    told = [(prior.scene, prior.S_map_scene.matrix(), prior.sigmas, prior.up, prior.up_sigma_rad) for prior in priors]
    key = solver.recipe_key(settings.optimize).of(*scenes, *named, canonical(told), canonical(ups))
    return PoseInputs(scenes, edges, priors, ups, key)


def _is_same_visit(a: str | None, b: str | None, hours: float) -> bool:
    """Whether two captures are known to be of about one time."""
    if a is None or b is None:
        return False
    return abs(parsed(a) - parsed(b)).total_seconds() < 3600 * hours


def _ups(store: Store, living: Sequence[Scene], present: Collection[str]) -> dict[str, np.ndarray]:
    """What each scene's present graph (by key) says is up; where it has none yet, its newest one, or what that said."""
    # Graphs come oldest first; the present one of a scene goes last.
    chosen = {graph.scene: graph.up for graph in sorted(store.graphs.list(), key=lambda graph: graph.key in present)}
    of_thinned = {scene.id: scene.thinning.up for scene in living if scene.thinning is not None}
    return {scene: np.array(up) for scene, up in (of_thinned | chosen).items() if up is not None}


def optimize(store: Store, settings: Settings, progress: StageProgress) -> int:
    """Solve for all poses and keep the answer as a new revision; returns its number."""
    given = pose_inputs(store, settings)
    progress("optimize", 0.0, "poses")
    previous: PoseGraph | None = store.revisions.get()
    answer = solver.optimize(given.scenes, given.edges, given.priors, previous, settings.optimize)
    answer = solver.gravity_align(
        answer, given.ups, fixed={prior.scene for prior in given.priors}, params=settings.optimize.gravity
    )
    number = store.revisions.save(answer, given.key)
    progress("optimize", 1.0, f"revision {number}")
    return number


def solve(store: Store, settings: Settings, progress: StageProgress) -> bool:
    """Optimize unless the newest revision is what that would make; returns whether there is a new one.

    One process does it at a time: others wait, and then need not.
    """
    told = False
    while not is_solved(store, settings):
        if store.leases.try_hold("poses", "optimize"):
            try:
                if not is_solved(store, settings):
                    optimize(store, settings, progress)
            finally:
                store.leases.release(["poses"])
            return True
        holder = next((lease for lease in store.leases.list() if lease.what == "poses"), None)
        if holder is not None and not told:
            progress("optimize", 0.0, f"waiting for {holder.who}")
            told = True
        time.sleep(POLL_S)
    return told


def is_solved(store: Store, settings: Settings) -> bool:
    """Whether the newest revision is what this recipe makes of what the map knows now."""
    newest = store.revisions.current()
    return newest is not None and store.revisions.find(pose_inputs(store, settings).key) == newest
