"""Supersede stage: replace a scene by a retrained capture of the same frames."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap import describe as describing
from gsmap import register as registering
from gsmap.errors import InputError
from gsmap.geometry.boxes import box_corners
from gsmap.geometry.transforms import transform_cameras
from gsmap.ingest import Capture
from gsmap.map import models
from gsmap.map.jobs import load_view
from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys
from gsmap.methods import RecipeKey
from gsmap.register import SceneView, recipe_key
from gsmap.register.metric_scene import target_unit_m
from gsmap.register.recipe import prepared_key
from gsmap.render import backend
from gsmap.store import Store, scene_id
from gsmap.store.registrations import StoredRegistration
from gsmap.store.scene_replacement import inherit
from gsmap.types import Registration, Scene, SceneGraph, Sim3
from gsmap.types.progress import StageProgress
from gsmap.types.registration import Proposal

_SAME_FRAME_M = 0.05  # two trainings from one set of frames lie in each other within millimetres


@dataclass(frozen=True)
class SupersedeResult:
    """The result of replacing a scene.

    Args:
        scene: the new scene.
        notes: remarks for the user.
    """

    scene: Scene
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _CarriedEdge:
    """An edge of the replaced scene, rewritten for the new scene.

    Args:
        edge: the registration to store under the key; None as key for a measured edge.
        review, note: its review and note.
    """

    edge: Registration
    key: RecipeKey | None
    review: str | None
    note: str


def supersede(
    store: Store, capture: Capture, ref: str, settings: Settings, progress: StageProgress, *, named: bool
) -> SupersedeResult:
    """Replace a scene by a capture, completely or not at all; see `gsmap.map.Map.ingest`.

    Args:
        ref: the scene to replace.
        named: true if the capture's name was specified; else it takes the scene's name.

    Raises:
        InputError: it lies in another frame than the scene, or is in the map already; nothing is changed.
    """
    old = store.scenes.get(ref)
    if capture.scale_policy == "auto":
        capture = replace(capture, scale_policy=old.scale_policy)
    capture = _about(capture, old)
    coming = replace(old, id=scene_id(capture.gaussians, capture.cameras), scale_policy=capture.scale_policy)
    if any(coming.id == scene.id for scene in store.scenes.list()):
        raise InputError(
            f"the capture to supersede {old.name} is in the map already, so it cannot replace a scene",
            code="already_in_map",
        )
    progress("ingest", 0.0, f"comparing with {old.name}")
    graph = _describe(store, coming.id, capture, settings)
    view = SceneView(coming.id, capture.gaussians, capture.cameras, graph, capture.scale_policy)
    _check_frame(old, _view(store, old, settings), view, settings)
    carried = list(_carried(store, old, coming, view, settings, progress))
    edges = _usable_neighbours(store, old)
    # A date that was read beside the capture does not overrule what was said of the same frames.
    dated = capture.captured_at is not None and (not capture.dated_by or old.captured_at is None)
    dated_by = ["", *(fact.author for fact in store.scenes.facts(old.id) if fact.kind == "captured_at")][-1]
    with store.transaction():
        store.scenes.remove(old.id)
        scene, _ = store.scenes.add(
            capture.gaussians,
            capture.cameras,
            name=capture.name if named else old.name,
            scale_policy=capture.scale_policy,
            captured_at=capture.captured_at if dated else old.captured_at,
            source=capture.source,
            antialiased=capture.antialiased,
            notes=capture.notes,
            dated_by=capture.dated_by if dated else dated_by,
        )
        inherit(store, old.id, scene.id)
        key = graph_keys(store, [scene], settings)[scene.id]
        store.graphs.save(graph, key)
        store.prepared_scenes.save(view.prepared, prepared_key().of(scene.id, key.digest))
        for one in carried:
            store.registrations.save(one.edge, one.key)
            ends = one.edge.target, one.edge.source
            if one.review is not None:
                store.registrations.review(*ends, one.review, one.note)
            elif (before := store.registrations.get(*ends)) is not None and before.review is not None:
                store.registrations.review(*ends, "withdraw")  # of content that returns: withdrawn since
    progress("ingest", 1.0, f"{scene.name} in the place of {old.id[:12]}")
    notes = [f"it replaced scene {old.id[:12]} ({old.name})"]
    if edges:
        held = len(edges & _usable_neighbours(store, scene))
        notes.append(f"{held} of {len(edges)} edges hold: gsmap optimize {store.location} uses them")
    return SupersedeResult(scene, tuple(notes))


def _about(capture: Capture, old: Scene) -> Capture:
    """Return the capture relative to the origin of the scene to replace, if both have an origin."""
    shift = capture.gaussians.origin - old.origin
    if not (capture.gaussians.origin.any() and old.origin.any() and shift.any()):
        return capture
    cameras = transform_cameras(capture.cameras, Sim3(np.eye(3), shift))
    return replace(capture, content=capture.gaussians.about(old.origin), cameras=cameras)


def _describe(store: Store, new_id: str, capture: Capture, settings: Settings) -> SceneGraph:
    """Compute the graph of a capture that is not in the map yet."""
    rendered_by = backend(settings.describe.object.render_backend)
    params = replace(settings.describe, object=replace(settings.describe.object, render_backend=rendered_by))
    return describing.describe(
        new_id, capture.gaussians, capture.cameras, params, models.specs(store), scale_policy=capture.scale_policy
    )


def _view(store: Store, scene: Scene, settings: Settings) -> SceneView:
    """Return a scene for registration; compute a missing graph without storing it."""
    key = graph_keys(store, [scene], settings)[scene.id]
    if store.graphs.find(key) is not None:
        return load_view(store, scene.id, key.digest)
    gaussians, cameras = store.scenes.gaussians(scene.id), store.scenes.cameras(scene.id)
    capture = Capture(gaussians, cameras, scene.name, scale_policy=scene.scale_policy)
    graph = _describe(store, scene.id, capture, settings)
    return SceneView(scene.id, gaussians, cameras, graph, scene.scale_policy)


def _check_frame(old: Scene, old_view: SceneView, new_view: SceneView, settings: Settings) -> None:
    """Raise an error for a capture that is not aligned with the scene to replace."""
    as_they_lie = Proposal("superseding", Sim3.identity(), with_scale=False, num_inliers=0)
    found = registering.check_pose(old_view, new_view, as_they_lie, settings.register)
    advice = "ingest it without --supersedes, so that registration finds its pose"
    if found.status != "accepted" or found.S_target_source is None:
        raise InputError(
            f"the capture does not lie where scene {old.name} lies ({found.reason}): {advice}",
            code="supersede_no_match",
        )
    corners = box_corners(old.bounds)
    unit_m = target_unit_m(old_view, with_scale=False)
    off = np.linalg.norm(found.S_target_source.apply(corners) - corners, axis=1).max() * unit_m
    if off > _SAME_FRAME_M:
        raise InputError(
            f"the capture lies {off:.2f} m off where scene {old.name} lies: {advice}", code="supersede_too_far"
        )


def _carried(
    store: Store, old: Scene, coming: Scene, view: SceneView, settings: Settings, progress: StageProgress
) -> Iterator[_CarriedEdge]:
    """Yield the edges of the replaced scene for the new scene; poses are verified, not searched."""
    living = {scene.id: scene for scene in store.scenes.list()}
    known = [stored for stored in store.registrations.current() if old.id in _ends(stored)]
    recipe = recipe_key(settings.register)
    for i, stored in enumerate(known):
        (other,) = (living[scene] for scene in _ends(stored) if scene != old.id)
        said = [word for word in store.registrations.reviews(old.id, other.id) if word.review == stored.review]
        word = (stored.review, said[-1].note if said else "")
        keys = graph_keys(store, [coming, other], settings)
        progress("ingest", (i + 1) / (len(known) + 2), f"checking the edge to {other.name}")
        edge, S = stored.registration, stored.registration.S_target_source
        ends = [coming.id if scene == old.id else scene for scene in _ends(stored)]
        alike = replace(edge, target=ends[0], source=ends[1])
        if stored.manual:
            yield _CarriedEdge(alike, None, *word)
            continue
        if S is None:
            alike = replace(alike, notes=(*edge.notes, f"known of scene {old.id[:12]}, which it superseded"))
            yield _CarriedEdge(alike, recipe.of(*(keys[end].digest for end in ends)), *word)
            continue
        target, source = sorted(ends)
        views = {coming.id: view, other.id: _view(store, other, settings)}
        known_pose = _proposal(edge, S if target == ends[0] else S.inverse())
        found = registering.check_pose(views[target], views[source], known_pose, settings.register)
        if stored.review == "confirm" and found.S_target_source is None:  # a person vouches for the pose as it was
            found = replace(alike, notes=(*edge.notes, f"confirmed of scene {old.id[:12]}; of this: {found.reason}"))
        key = recipe.of(keys[found.target].digest, keys[found.source].digest)
        yield _CarriedEdge(found, key, *word)


def _usable_neighbours(store: Store, scene: Scene) -> set[str]:
    """Return the scenes (ids) that usable edges connect with a scene."""
    edges = store.registrations.current_of_scene(scene.id)
    return {end for edge in edges if edge.is_usable for end in _ends(edge)} - {scene.id}


def _ends(stored: StoredRegistration) -> Sequence[str]:
    return stored.registration.target, stored.registration.source


def _proposal(edge: Registration, S_target_source: Sim3) -> Proposal:
    """Return an edge as a proposal with the statistics of its correspondences."""
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
