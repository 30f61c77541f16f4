"""Optimize stage: solve the poses of all scenes and store them as a revision."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields
from datetime import datetime
from functools import cached_property

import numpy as np

from gsmap import optimize as solver
from gsmap.geodesy.survey import in_frame
from gsmap.map.date_filter import parse_moment
from gsmap.map.reports.common import up_directions
from gsmap.map.settings import Settings
from gsmap.map.shared_jobs import POLL_S
from gsmap.map.snapshot_read import snapshot_read
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.register.duplicate import SAME_CAPTURE
from gsmap.store import Store
from gsmap.store.scenes import SceneSummary
from gsmap.types import Edge, PoseGraph, Prior
from gsmap.types.plain import canonical, of_plain
from gsmap.types.progress import StageProgress
from gsmap.types.world import Survey


@dataclass(frozen=True, eq=False)
class PoseBasis:
    """Everything that determines the poses of a map, by id, without the measurements of the edges.

    Args:
        scenes: scene ids in order of arrival.
        named: identifier of each usable edge, by (target, source), sorted.
        same_visits: the edges between scenes of about the same time.
        priors: pose priors.
        ups: (3,) up direction in the scene's frame, by scene id, if known.
        observed: observations of the world as specified.
        recipe: recipe of the solver.
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
        """Recipe key that has all of the basis as inputs."""
        return self.key_of(self.scenes)

    def key_of(self, scenes: Collection[str]) -> RecipeKey:
        """Return the key for a subset of the scenes."""
        some = set(scenes)
        named = [name for (a, b), name in self.named.items() if a in some and b in some]
        told = [(p.scene, p.S_map_scene.matrix(), p.sigmas, p.up, p.up_sigma_rad) for p in self.priors]
        ups = of_plain({scene: up.tolist() for scene, up in self.ups.items() if scene in some})
        # As specified by the user, so that the key does not depend on the version of PROJ.
        seen = [canonical(self.observed)] if self.observed else []
        mine = [scene for scene in self.scenes if scene in some]
        return self.recipe.of(*mine, *named, canonical(told), ups, *seen)


@snapshot_read
def pose_basis(store: Store, settings: Settings, observed: Survey | None = None) -> PoseBasis:
    """Read the basis of the poses, in microseconds per scene.

    Args:
        observed: replaces the stored observations of the world.
    """
    living, priors = store.scenes.summaries(), store.priors.list()
    captured = {scene.id: None if scene.captured_at is None else parse_moment(scene.captured_at) for scene in living}
    hours = settings.optimize.same_visit_h
    named, same_visits = {}, set()
    # By id, not in the order in which workers happened to finish: the same key whenever they were made.
    for one in store.registrations.summaries(usable=True):
        same = _is_same_visit(captured[one.target], captured[one.source], hours)
        named[one.target, one.source] = f"{one.key or one.number} {one.review}" + " same visit" * same
        if same:
            same_visits.add((one.target, one.source))
    ups, recipe = _ups(store, living, settings), solver.recipe_key(settings.optimize)
    observed = store.world.survey() if observed is None else observed
    return PoseBasis([scene.id for scene in living], named, same_visits, priors, ups, observed, recipe)


@dataclass(frozen=True, eq=False)
class PoseInputs(PoseBasis):
    """The inputs of a solve.

    Args:
        edges: usable edges, by (target, source).
        survey: observations in the world frame.
    """

    edges: list[Edge]
    survey: Survey


@snapshot_read
def pose_inputs(store: Store, settings: Settings) -> PoseInputs:
    """Read the inputs of a solve."""
    return _with_edges(store, pose_basis(store, settings))


def _with_edges(store: Store, basis: PoseBasis) -> PoseInputs:
    own = {field.name: getattr(basis, field.name) for field in fields(basis)}
    return PoseInputs(**own, edges=_edges(store, basis), survey=in_frame(basis.observed))


def _edges(store: Store, basis: PoseBasis, among: Collection[str] | None = None) -> list[Edge]:
    """Return the usable edges, of all scenes or between some scenes."""
    return [
        Edge(
            target=stored.registration.target,
            source=stored.registration.source,
            S_target_source=stored.registration.S_target_source,
            information=stored.registration.information,
            confirmed=stored.review == "confirm",
            disagreement=stored.registration.evidence.get("disagreement", float("nan")),
            look_alike=stored.registration.evidence.get("look_alike", float("nan")),
            same_visit=(stored.registration.target, stored.registration.source) in basis.same_visits,
            log_odds_wrong=solver.log_odds_wrong(stored.registration.evidence, stored.registration.overlap),
            duplicate=any(note.startswith(SAME_CAPTURE) for note in stored.registration.notes),
        )
        for stored in store.registrations.current_usable(among)
        if stored.registration.S_target_source is not None and stored.registration.information is not None
    ]


@dataclass(frozen=True, eq=False)
class _IncrementalInputs:
    """The inputs to add new scenes to the newest revision when nothing else has changed.

    Args:
        basis: identification of the new poses.
        revision, previous: number and poses of the newest revision.
        inside, rim: scenes to solve, and the outermost scenes that stay fixed (`gsmap.optimize.surroundings`).
        edges: usable edges among these.
    """

    basis: PoseBasis
    revision: int
    previous: PoseGraph
    inside: set[str]
    rim: set[str]
    edges: list[Edge]


@snapshot_read
def _inputs(store: Store, settings: Settings) -> PoseInputs | _IncrementalInputs:
    """Read the inputs of a solve; for a map that only has grown, only the inputs around the new scenes."""
    basis, newest = pose_basis(store, settings), store.revisions.newest()
    if newest is not None and (previous := store.revisions.get(newest.number)) is not None:
        near, rim = solver.surroundings(basis.scenes, list(basis.named), previous, settings.optimize)
        if near and basis.key_of(previous.poses).digest == newest.key:
            return _IncrementalInputs(basis, newest.number, previous, near - rim, rim, _edges(store, basis, near))
    return _with_edges(store, basis)


def _is_same_visit(a: datetime | None, b: datetime | None, hours: float) -> bool:
    """Return true if two scenes are known to have been captured at about the same time."""
    return a is not None and b is not None and abs(a - b).total_seconds() < 3600 * hours


def _ups(store: Store, living: Sequence[SceneSummary], settings: Settings) -> dict[str, np.ndarray]:
    """Return the up direction of each scene by its current graph or, without one, by its newest graph."""
    said = store.graphs.list()
    times = Counter(graph.scene for graph in said)
    several = [scene for scene in living if times[scene.id] > 1]
    present = {key.digest for key in graph_keys(store, several, settings).values()} if several else set[str]()
    # Graphs come oldest first; the present one of a scene goes last.
    return up_directions(sorted(said, key=lambda graph: graph.key in present), living)


def optimize(store: Store, settings: Settings, progress: StageProgress) -> int:
    """Solve all poses and store them as a new revision; return its number."""
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
    """Solved poses that are not stored yet.

    Args:
        answer: the poses. key: key of their inputs. after: newest revision at that time.
    """

    answer: PoseGraph
    key: RecipeKey
    after: int | None


def solve_observed(store: Store, settings: Settings, observed: Survey) -> Solution | None:
    """Solve all poses with the given observations of the world; None if the newest revision used the same observations.

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


def _grow(store: Store, given: _IncrementalInputs, settings: Settings, progress: StageProgress) -> bool:
    """Place new scenes by solving around them; return false if that is not possible."""
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
    """Optimize unless the newest revision is current; return true if a new revision was stored.

    One process does it at a time: others wait, and then need not.

    Args:
        solution: stored instead of solving again if its inputs are still current.
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
                if not _is_of(store, given.basis if isinstance(given, _IncrementalInputs) else given):
                    if isinstance(given, _IncrementalInputs) and not _grow(store, given, settings, progress):
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


@snapshot_read
def _is_present(store: Store, solution: Solution, settings: Settings) -> bool:
    """Return true if the inputs of a solution are current."""
    newest = store.revisions.newest()
    same = (None if newest is None else newest.number) == solution.after
    return same and pose_basis(store, settings).key.digest == solution.key.digest


def is_solved(store: Store, settings: Settings) -> bool:
    """Return true if the newest revision is current."""
    return _is_of(store, pose_basis(store, settings))


def _is_of(store: Store, basis: PoseBasis) -> bool:
    """Return true if the newest revision was solved from this basis."""
    newest = store.revisions.newest()
    return newest is not None and newest.key == basis.key.digest
