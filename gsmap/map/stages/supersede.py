"""Supersede: a capture that was trained again takes the place of the one that is in the map."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from gsmap import describe as describing
from gsmap import register as registering
from gsmap.engine import run_jobs
from gsmap.errors import GsmapError, InputError
from gsmap.ingest import Capture
from gsmap.map import models
from gsmap.map.jobs import check_scenes
from gsmap.map.settings import Settings
from gsmap.map.sharing import SharedJobs
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.register import SceneView, recipe_key
from gsmap.render import backend
from gsmap.store import Store, scene_id
from gsmap.store.registrations import StoredRegistration
from gsmap.store.superseding import inherit
from gsmap.types import Registration, Scene, SceneGraph, Sim3
from gsmap.types.progress import StageProgress
from gsmap.types.registration import Proposal

_SAME_FRAME_M = 0.05  # two trainings from one set of frames lie in each other within millimetres


@dataclass(frozen=True)
class Superseded:
    """What became of a capture in the place of another.

    Args:
        scene: the new one.
        notes: what a person should know.
    """

    scene: Scene
    notes: tuple[str, ...]


def supersede(
    store: Store, capture: Capture, ref: str, settings: Settings, progress: StageProgress, *, named: bool
) -> Superseded:
    """Put a capture in the place of a scene; see `gsmap.map.Map.ingest`.

    Args:
        ref: the scene that goes.
        named: the capture's name was given; else it takes that of the scene.

    Raises:
        InputError: it lies in another frame than the scene, or is in the map already; nothing is changed.
    """
    old = store.scenes.get(ref)
    if capture.scale_policy == "auto":
        capture = replace(capture, scale_policy=old.scale_policy)
    new_id = scene_id(capture.gaussians, capture.cameras)
    if any(new_id == scene.id for scene in store.scenes.list()):
        raise InputError(f"the capture to supersede {old.name} is in the map already: there is nothing to put in place")
    progress("ingest", 0.0, f"comparing with {old.name}")
    graph = _describe(store, new_id, capture, settings)
    old_view = _view(store, old, settings)
    new_view = SceneView(new_id, capture.gaussians, capture.cameras, graph, capture.scale_policy)
    _check_frame(old, old_view, new_view, settings)
    known = [stored for stored in store.registrations.current() if old.id in _ends(stored)]
    # A date that was read beside the capture does not overrule what people said of the same frames.
    said = capture.captured_at is not None and (not capture.dated_by or old.captured_at is None)
    dated_by = [fact.author for fact in store.scenes.facts(old.id) if fact.kind == "captured_at"]
    with store.transaction():
        store.scenes.remove(old.id)
        scene, _ = store.scenes.add(
            capture.gaussians,
            capture.cameras,
            name=capture.name if named else old.name,
            scale_policy=capture.scale_policy,
            captured_at=capture.captured_at if said else old.captured_at,
            source=capture.source,
            antialiased=capture.antialiased,
            notes=capture.notes,
            dated_by=capture.dated_by if said else (dated_by or [""])[-1],
        )
        inherit(store, old.id, scene.id)
        key = graph_keys(store, [scene], settings)[scene.id]
        store.graphs.save(graph, key)
    progress("ingest", 1.0, f"{scene.name} in the place of {old.id[:12]}")
    notes = _carry_edges(store, old, scene, known, settings, progress)
    return Superseded(scene, (f"it took the place of scene {old.id[:12]} ({old.name})", *notes))


def _ends(stored: StoredRegistration) -> tuple[str, str]:
    return stored.registration.target, stored.registration.source


def _describe(store: Store, new_id: str, capture: Capture, settings: Settings) -> SceneGraph:
    """The graph of a capture that is not in the map yet."""
    rendered_by = backend(settings.describe.object.render_backend)
    params = replace(settings.describe, object=replace(settings.describe.object, render_backend=rendered_by))
    return describing.describe(
        new_id, capture.gaussians, capture.cameras, params, models.specs(store), scale_policy=capture.scale_policy
    )


def _view(store: Store, scene: Scene, settings: Settings) -> SceneView:
    """A scene of the map as registration sees it; its graph is made where it lacks one, and not kept."""
    gaussians, cameras = store.scenes.gaussians(scene.id), store.scenes.cameras(scene.id)
    graph = store.graphs.load(scene.id, graph_keys(store, [scene], settings)[scene.id])
    if graph is None:
        capture = Capture(gaussians, cameras, scene.name, scale_policy=scene.scale_policy)
        graph = _describe(store, scene.id, capture, settings)
    return SceneView(scene.id, gaussians, cameras, graph, scene.scale_policy)


def _check_frame(old: Scene, old_view: SceneView, new_view: SceneView, settings: Settings) -> None:
    """Refuse a capture whose surfaces do not lie on those of the scene that it is to supersede."""
    as_they_lie = Proposal("superseding", Sim3.identity(), with_scale=False, num_inliers=0)
    found = registering.check_pose(old_view, new_view, as_they_lie, settings.register)
    advice = "ingest it without --supersedes, and registration finds where it lies"
    if found.status != "accepted" or found.S_target_source is None:
        raise InputError(f"the capture does not lie where scene {old.name} lies ({found.reason}): {advice}")
    low, high = old.bounds
    corners = np.array(np.meshgrid(*np.array([low, high]).T)).reshape(3, -1).T
    off = np.linalg.norm(found.S_target_source.apply(corners) - corners, axis=1).max() * old_view.graph.unit_m
    if off > _SAME_FRAME_M:
        raise InputError(f"the capture lies {off:.2f} m off where scene {old.name} lies: {advice}")


def _carry_edges(
    store: Store,
    old: Scene,
    new: Scene,
    known: list[StoredRegistration],
    settings: Settings,
    progress: StageProgress,
) -> list[str]:
    """Give the new scene the edges of the old one: poses are checked, and nothing is searched.

    Returns:
        What a person should know.
    """
    living = {scene.id: scene for scene in store.scenes.list()}
    known = [stored for stored in known if set(_ends(stored)) - {old.id} <= set(living)]
    graphs = graph_keys(store, list(living.values()), settings)
    recipe = recipe_key(settings.register)
    keys: dict[str, RecipeKey] = {}
    jobs: dict[str, tuple[object, ...]] = {}
    for stored in known:
        edge = stored.registration
        if stored.manual:
            target, source = (new.id if scene == old.id else scene for scene in _ends(stored))
            store.registrations.save(replace(edge, target=target, source=source))
            continue
        (other,) = set(_ends(stored)) - {old.id}
        if store.graphs.find(graphs[other]) is None:
            continue  # the other scene has no graph under these settings: it is registered by the next update
        target, source = sorted((new.id, other))
        key = recipe.of(graphs[target].digest, graphs[source].digest)
        S = edge.S_target_source
        if S is None:
            note = f"known of scene {old.id[:12]}, which it superseded"
            alike = replace(edge, target=target, source=source, notes=(*edge.notes, note))
            store.registrations.save(alike, key)
            continue
        S = S if (edge.target == old.id) == (target == new.id) else S.inverse()
        keys[key.digest] = key
        ends = (target, graphs[target].digest), (source, graphs[source].digest)
        jobs[key.digest] = (store.location, *ends, _proposal(edge, S), settings.register)
    held = _check_edges(store, keys, jobs, settings, progress)
    notes = [f"{held} of {len(jobs)} edges hold as they were; the others say why"] if jobs else []
    return [*notes, *_carry_words(store, old, new, known, living)]


def _proposal(edge: Registration, S_target_source: Sim3) -> Proposal:
    """An edge of the superseded scene as a proposal for the new one."""
    return Proposal(
        edge.proposer,
        S_target_source,
        with_scale=not S_target_source.is_rigid,
        num_inliers=edge.num_inliers,
        num_correspondences=edge.num_correspondences,
        exact=edge.exact,
        log_nfa=edge.evidence.get("log_nfa", float("nan")),
        runner_up=edge.evidence.get("runner_up", float("nan")),
    )


def _check_edges(
    store: Store,
    keys: dict[str, RecipeKey],
    jobs: dict[str, tuple[object, ...]],
    settings: Settings,
    progress: StageProgress,
) -> int:
    """Check the poses of the edges, shared with whoever is at work; returns how many are accepted."""
    shared = SharedJobs(store, "register", "edge", jobs, store.registrations.kept, progress)
    results = shared.results(lambda arguments: run_jobs(check_scenes, arguments, settings.engine))
    with closing(results):
        for key, edge in results:
            store.registrations.save(edge, keys[key])
            shared.saved(key, f"{edge.target[:12]}-{edge.source[:12]}: {edge.status}")
    found = [store.registrations.find(key) for key in keys]
    return sum(stored is not None and stored.registration.status == "accepted" for stored in found)


def _carry_words(
    store: Store, old: Scene, new: Scene, known: list[StoredRegistration], living: dict[str, Scene]
) -> list[str]:
    """What people said of the old scene's pairs stands for those of the new one; what cannot is told."""
    notes = []
    for stored in known:
        if stored.review is None:
            continue
        (other,) = set(_ends(stored)) - {old.id}
        word = [review for review in store.registrations.reviews(old.id, other) if review.review == stored.review][-1]
        try:
            store.registrations.review(new.id, other, stored.review, word.note)
        except GsmapError as error:
            notes.append(f"the word on the pair with {living[other].name} ({stored.review}) was not carried: {error}")
    return notes
