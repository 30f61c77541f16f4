"""Optimize: poses of all scenes from the edges in use, kept as a revision under what they were solved from."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from functools import cached_property

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
from gsmap.types.plain import canonical, of_plain
from gsmap.types.progress import StageProgress
from gsmap.types.world import Survey
from gsmap.world.survey import in_frame


@dataclass(frozen=True, eq=False)
class PoseBasis:
    """What names the poses of a map: all that decides them, without the figures of any edge.

    Args:
        scenes: ids, in the order they came.
        named: what names each edge that may be used, by (target, source), in their order.
        same_visits: those of them between captures that are known to be of about one time.
        priors: outside knowledge.
        ups: (3,) direction against gravity in the scene's frame, by scene id, where it is known.
        observed: what was observed of the world, as it was told.
        recipe: how they are solved.
    """

    scenes: list[str]
    named: dict[tuple[str, str], str]
    same_visits: set[tuple[str, str]]
    priors: list[Prior]
    ups: dict[str, np.ndarray]
    observed: Survey
    recipe: RecipeKey

    @cached_property
    def key(self) -> RecipeKey:
        """The recipe with all of these as its inputs."""
        return self.key_of(self.scenes)

    def key_of(self, scenes: Collection[str]) -> RecipeKey:
        """The same of some of the scenes, as if the map had no others."""
        some = set(scenes)
        named = [name for (a, b), name in self.named.items() if a in some and b in some]
        told = [(p.scene, p.S_map_scene.matrix(), p.sigmas, p.up, p.up_sigma_rad) for p in self.priors]
        ups = of_plain({scene: up.tolist() for scene, up in self.ups.items() if scene in some})
        # As it was told: the same key wherever PROJ is another.
        seen = [canonical(self.observed)] if self.observed else []
        mine = [scene for scene in self.scenes if scene in some]
        return self.recipe.of(*mine, *named, canonical(told), ups, *seen)


@of_one_state
def pose_basis(store: Store, settings: Settings, observed: Survey | None = None) -> PoseBasis:
    """Read what names the poses; a few statements, and microseconds a scene.

    Args:
        observed: in place of what the map knows to be observed of the world.
    """
    living, priors = store.scenes.brief(), store.priors.list()
    captured = {scene.id: None if scene.captured_at is None else parsed(scene.captured_at) for scene in living}
    hours = settings.optimize.same_visit_h
    named, same_visits = {}, set()
    # By id, not in the order in which workers happened to finish: the same key whenever they were made.
    for one in store.registrations.standing(usable=True):
        same = _is_same_visit(captured[one.target], captured[one.source], hours)
        named[one.target, one.source] = f"{one.key or one.number} {one.review}" + " same visit" * same
        if same:
            same_visits.add((one.target, one.source))
    ups, recipe = _ups(store, living, settings), solver.recipe_key(settings.optimize)
    observed = store.world.survey() if observed is None else observed
    return PoseBasis([scene.id for scene in living], named, same_visits, priors, ups, observed, recipe)


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
    return _with_edges(store, pose_basis(store, settings))


def _with_edges(store: Store, basis: PoseBasis) -> PoseInputs:
    own = {field.name: getattr(basis, field.name) for field in fields(basis)}
    return PoseInputs(**own, edges=_edges(store, basis), survey=in_frame(basis.observed))


def _edges(store: Store, basis: PoseBasis, among: Collection[str] | None = None) -> list[Edge]:
    """The edges that may be used, or those of them among some scenes."""
    return [
        Edge(
            target=stored.registration.target,
            source=stored.registration.source,
            S_target_source=stored.registration.S_target_source,
            information=stored.registration.information,
            confirmed=stored.review == "confirm",
            disagreement=stored.registration.evidence.get("disagreement", float("nan")),
            same_visit=(stored.registration.target, stored.registration.source) in basis.same_visits,
            log_odds_wrong=solver.log_odds_wrong(stored.registration.evidence, stored.registration.overlap),
        )
        for stored in store.registrations.usable(among)
        if stored.registration.S_target_source is not None and stored.registration.information is not None
    ]


@dataclass(frozen=True, eq=False)
class _Growth:
    """What placing new scenes in the newest answer asks, where nothing else has come or gone since that.

    Args:
        basis: what names the poses then.
        revision, previous: the newest answer.
        inside, rim: scenes that it looks at, and the outermost of them (`gsmap.optimize.surroundings`).
        edges: those among both that may be used.
    """

    basis: PoseBasis
    revision: int
    previous: PoseGraph
    inside: set[str]
    rim: set[str]
    edges: list[Edge]


@of_one_state
def _inputs(store: Store, settings: Settings) -> PoseInputs | _Growth:
    """Read what decides the poses: of a map that only has grown, what lies around the new scenes."""
    basis, newest = pose_basis(store, settings), store.revisions.newest()
    if newest is not None and (previous := store.revisions.get(newest.number)) is not None:
        near, rim = solver.surroundings(basis.scenes, list(basis.named), previous, settings.optimize)
        if near and basis.key_of(previous.poses).digest == newest.key:
            return _Growth(basis, newest.number, previous, near - rim, rim, _edges(store, basis, near))
    return _with_edges(store, basis)


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
    number = store.revisions.save(_answer(given, store.revisions.get(), settings), given.key)
    progress("optimize", 1.0, f"revision {number}")
    return number


def _answer(given: PoseInputs, previous: PoseGraph | None, settings: Settings) -> PoseGraph:
    params = settings.optimize
    answer = solver.optimize(given.scenes, given.edges, given.priors, previous, params, survey=given.survey)
    return solver.keep_unchanged_poses(_upright(answer, given, params), previous, given.edges, params)


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses that were solved and not kept.

    Args:
        answer: the poses. key: what they were solved from. after: the revision that was the newest then.
    """

    answer: PoseGraph
    key: RecipeKey
    after: int | None


def solve_observed(store: Store, settings: Settings, observed: Survey) -> Solution | None:
    """Solve for all poses as if other observations of the world were known; None where the newest revision is that.

    Nothing is kept: `solve` keeps it.
    """
    basis = pose_basis(store, settings, observed)
    if _is_of(store, basis):
        return None
    newest = store.revisions.newest()
    previous = None if newest is None else store.revisions.get(newest.number)
    answer = _answer(_with_edges(store, basis), previous, settings)
    return Solution(answer, basis.key, None if newest is None else newest.number)


def _upright(answer: PoseGraph, basis: PoseBasis, params: solver.Params) -> PoseGraph:
    return solver.gravity_align(answer, basis.ups, {prior.scene for prior in basis.priors}, params)


def _grow(store: Store, given: _Growth, settings: Settings, progress: StageProgress) -> bool:
    """Place the new scenes as `_optimize` would, whether that can be done by what lies around them."""
    basis, params = given.basis, settings.optimize
    answer = solver.grow(basis.scenes, given.edges, given.previous, params)
    if answer is None:
        return False
    answer = solver.keep_unchanged_poses(_upright(answer, basis, params), given.previous, given.edges, params)
    if any(pose is not given.previous.poses.get(s) for s, pose in answer.poses.items() if s not in given.inside):
        return False  # more gave way, or all were turned upright: that asks more edges
    number = store.revisions.save(answer, basis.key, after=(given.revision, given.previous))
    progress("optimize", 1.0, f"revision {number}")
    return True


def solve(store: Store, settings: Settings, progress: StageProgress, solution: Solution | None = None) -> bool:
    """Optimize unless the newest revision is what that would make; returns whether there is a new one.

    One process does it at a time: others wait, and then need not.

    Args:
        solution: kept in place of solving once more, where nothing has come or gone since it was solved.
    """
    told = False
    while not _is_of(store, pose_basis(store, settings)):
        if store.leases.try_hold("poses", "optimize"):
            try:
                if solution is not None and _is_present(store, solution, settings):
                    number = store.revisions.save(solution.answer, solution.key)
                    progress("optimize", 1.0, f"revision {number}")
                    return True
                given = _inputs(store, settings)
                if not _is_of(store, given.basis if isinstance(given, _Growth) else given):
                    if isinstance(given, _Growth) and not _grow(store, given, settings, progress):
                        given = pose_inputs(store, settings)
                    if isinstance(given, PoseInputs):
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


@of_one_state
def _is_present(store: Store, solution: Solution, settings: Settings) -> bool:
    """Whether a solution is what solving now would give."""
    newest = store.revisions.newest()
    same = (None if newest is None else newest.number) == solution.after
    return same and pose_basis(store, settings).key.digest == solution.key.digest


def is_solved(store: Store, settings: Settings) -> bool:
    """Whether the newest revision is what this recipe makes of what the map knows now."""
    return _is_of(store, pose_basis(store, settings))


def _is_of(store: Store, basis: PoseBasis) -> bool:
    """Whether the newest revision is what was solved from this."""
    newest = store.revisions.newest()
    return newest is not None and newest.key == basis.key.digest
