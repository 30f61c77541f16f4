"""Optimize: poses of all scenes from the edges in use, kept as a revision under what they were solved from."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from gsmap import optimize as solver
from gsmap.map.dates import parsed
from gsmap.map.one_state import of_one_state
from gsmap.map.settings import Settings
from gsmap.map.sharing import POLL_S
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.store import Store
from gsmap.store.scenes import BriefScene
from gsmap.types import Edge, PoseGraph, Prior
from gsmap.types.plain import canonical
from gsmap.types.progress import StageProgress
from gsmap.types.world import Survey
from gsmap.world.survey import in_frame


@dataclass(frozen=True, eq=False)
class PoseBasis:
    """What names the poses of a map: all that decides them, without the figures of any edge.

    Args:
        scenes: ids, in the order they came.
        same_visits: (target, source) of the edges between captures that are known to be of about one time.
        priors: outside knowledge.
        ups: (3,) direction against gravity in the scene's frame, by scene id, where it is known.
        observed: what was observed of the world, as it was told.
        key: the recipe with all of these, and the edges that may be used, as its inputs.
    """

    scenes: list[str]
    same_visits: set[tuple[str, str]]
    priors: list[Prior]
    ups: dict[str, np.ndarray]
    observed: Survey
    key: RecipeKey


@of_one_state
def pose_basis(store: Store, settings: Settings) -> PoseBasis:
    """Read what names the poses; a few statements, and microseconds a scene."""
    living, priors = store.scenes.brief(), store.priors.list()
    captured = {scene.id: None if scene.captured_at is None else parsed(scene.captured_at) for scene in living}
    hours = settings.optimize.aliasing.same_visit_h
    named, same_visits = [], set()
    # By id, not in the order in which workers happened to finish: the same key whenever they were made.
    for one in store.registrations.standing(usable=True):
        same = _is_same_visit(captured[one.target], captured[one.source], hours)
        named.append(f"{one.key or one.number} {one.review}" + " same visit" * same)
        if same:
            same_visits.add((one.target, one.source))
    ups = _ups(store, living, settings)
    told = [(prior.scene, prior.S_map_scene.matrix(), prior.sigmas, prior.up, prior.up_sigma_rad) for prior in priors]
    recipe = solver.recipe_key(settings.optimize)
    observed = store.world.survey()
    seen = [canonical(observed)] if observed else []  # as it was told: the same key wherever PROJ is another
    key = recipe.of(*(scene.id for scene in living), *named, canonical(told), canonical(ups), *seen)
    return PoseBasis([scene.id for scene in living], same_visits, priors, ups, observed, key)


@dataclass(frozen=True, eq=False)
class PoseInputs(PoseBasis):
    """What decides the poses of a map.

    Args:
        edges: those that may be used, by (target, source).
        survey: what was observed of the world, in its frame.
    """

    edges: list[Edge]
    survey: Survey


@of_one_state
def pose_inputs(store: Store, settings: Settings) -> PoseInputs:
    """Read what decides the poses."""
    basis = pose_basis(store, settings)
    edges = [
        Edge(
            target=stored.registration.target,
            source=stored.registration.source,
            S_target_source=stored.registration.S_target_source,
            information=stored.registration.information,
            confirmed=stored.review == "confirm",
            disagreement=stored.registration.evidence.get("disagreement", float("nan")),
            same_visit=(stored.registration.target, stored.registration.source) in basis.same_visits,
        )
        for stored in store.registrations.usable()
        if stored.registration.S_target_source is not None and stored.registration.information is not None
    ]
    return PoseInputs(**vars(basis), edges=edges, survey=in_frame(basis.observed))


def _is_same_visit(a: datetime | None, b: datetime | None, hours: float) -> bool:
    """Whether two captures are known to be of about one time."""
    return a is not None and b is not None and abs(a - b).total_seconds() < 3600 * hours


def _ups(store: Store, living: Sequence[BriefScene], settings: Settings) -> dict[str, np.ndarray]:
    """What each scene's present graph says is up; where it has none yet, its newest one, or what that said."""
    said = store.graphs.says()
    times = Counter(graph.scene for graph in said)
    several = [scene for scene in living if times[scene.id] > 1]
    present = {key.digest for key in graph_keys(store, several, settings).values()} if several else set[str]()
    # Graphs come oldest first; the present one of a scene goes last.
    chosen = {graph.scene: graph.up for graph in sorted(said, key=lambda graph: graph.key in present)}
    of_thinned = {scene.id: scene.thinning.up for scene in living if scene.thinning is not None}
    return {scene: np.array(up) for scene, up in (of_thinned | chosen).items() if up is not None}


def optimize(store: Store, settings: Settings, progress: StageProgress) -> int:
    """Solve for all poses and keep the answer as a new revision; returns its number."""
    return _optimize(store, pose_inputs(store, settings), settings, progress)


def _optimize(store: Store, given: PoseInputs, settings: Settings, progress: StageProgress) -> int:
    progress("optimize", 0.0, "poses")
    previous: PoseGraph | None = store.revisions.get()
    fixed = {prior.scene for prior in given.priors}
    answer = solver.optimize(given.scenes, given.edges, given.priors, previous, settings.optimize, survey=given.survey)
    answer = solver.gravity_align(answer, given.ups, fixed=fixed, params=settings.optimize.gravity)
    number = store.revisions.save(solver.kept_still(answer, previous, given.edges, settings.optimize), given.key)
    progress("optimize", 1.0, f"revision {number}")
    return number


def solve(store: Store, settings: Settings, progress: StageProgress) -> bool:
    """Optimize unless the newest revision is what that would make; returns whether there is a new one.

    One process does it at a time: others wait, and then need not.
    """
    told = False
    while not _is_of(store, pose_basis(store, settings)):
        if store.leases.try_hold("poses", "optimize"):
            try:
                given = pose_inputs(store, settings)
                if not _is_of(store, given):
                    _optimize(store, given, settings, progress)
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
    return _is_of(store, pose_basis(store, settings))


def _is_of(store: Store, basis: PoseBasis) -> bool:
    """Whether the newest revision is what was solved from this."""
    newest = store.revisions.newest()
    return newest is not None and newest.key == basis.key.digest
