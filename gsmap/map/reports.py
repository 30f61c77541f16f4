"""What the map answers, as typed rows (`gsmap.types.rows`), read from the store."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from gsmap.errors import ConfigError, CorruptError
from gsmap.map.dates import is_after, is_until, last_of, parsed
from gsmap.map.one_state import of_one_state
from gsmap.methods import RecipeKey
from gsmap.settings import leaves
from gsmap.store import Store
from gsmap.store.integrity import Check, Pruned
from gsmap.store.registrations import StoredRegistration
from gsmap.store.revisions import Revision
from gsmap.types import PoseGraph, Registration, Scene, SceneGraph, ScenePose, Tile
from gsmap.types.rows import (
    CheckReport,
    EdgeRow,
    ExportReport,
    FactRow,
    GraphRow,
    IngestRow,
    LayerRow,
    ModelRow,
    NodeRow,
    PairEventRow,
    PairRef,
    PairReport,
    PoseChangeRow,
    PoseRow,
    PriorRow,
    PruneReport,
    RevisionRow,
    SceneEdgeRow,
    SceneRef,
    SceneReport,
    SceneRow,
    SettingRow,
    TileRow,
    UpdateReport,
)

if TYPE_CHECKING:
    from gsmap.export import ExportResult
    from gsmap.map.settings import Settings

SCENE_STATUSES = ("ingested", "described", "placed", "tentative", "isolated")
EDGE_STATUSES = ("accepted", "rejected", "no_match")

# --- scenes ----------------------------------------------------------------------------------------------------------


@of_one_state
def scene_rows(
    store: Store,
    *,
    component: int | None = None,
    status: str | None = None,
    after: str | None = None,
    tag: str | None = None,
    as_of: str | None = None,
) -> list[SceneRow]:
    """The living scenes, oldest first.

    Args:
        component: only those of this one.
        status: only those of this one, see `SceneRow`.
        after: ISO 8601; only those captured (or else ingested) after it.
        tag: only those that have it.
        as_of: ISO 8601; only those dated at or before it, those without a date left out.

    Raises:
        ConfigError: no such status, or a date that is none.
    """
    _one_of(status, SCENE_STATUSES)
    since = None if after is None else parsed(after)
    until = None if as_of is None else last_of(as_of)
    placed = store.revisions.get()
    nodes = {graph.scene: graph.num_nodes for graph in store.graphs.list()}
    said = store.scenes.latest_notes()
    rows = [_scene_row(scene, placed, nodes.get(scene.id), said.get(scene.id, "")) for scene in store.scenes.list()]
    return [
        row
        for row in rows
        if (component is None or row.component == component)
        and (status is None or row.status == status)
        and (since is None or is_after(row.captured_at or row.ingested_at, since))
        and (tag is None or tag in row.tags)
        and (until is None or is_until(row.captured_at, until))
    ]


@of_one_state
def scene_row(store: Store, scene: Scene) -> SceneRow:
    """The row of one scene."""
    nodes = {graph.scene: graph.num_nodes for graph in store.graphs.list()}
    return _scene_row(scene, store.revisions.get(), nodes.get(scene.id), store.scenes.latest_notes().get(scene.id, ""))


def _scene_row(scene: Scene, placed: PoseGraph | None, num_nodes: int | None, note: str) -> SceneRow:
    pose = placed.poses.get(scene.id) if placed else None
    return SceneRow(
        name=scene.name,
        id=scene.id,
        num_gaussians=scene.num_gaussians,
        num_nodes=num_nodes,
        component=pose.component if pose else None,
        S_map_scene=pose.S_map_scene if pose else None,
        captured_at=scene.captured_at,
        status=pose.status if pose else ("ingested" if num_nodes is None else "described"),
        ingested_at=scene.ingested_at,
        scale_policy=scene.scale_policy,
        tags=scene.tags,
        note=note,
    )


@of_one_state
def scene_report(store: Store, scene: Scene, graph: SceneGraph | None, graph_note: str = "") -> SceneReport:
    """Everything known of one scene.

    Args:
        graph: its graph; None where there is none.
        graph_note: what is to be known of which graph that is.
    """
    placed = store.revisions.get()
    pose = placed.poses.get(scene.id) if placed else None
    known = pose is not None and pose.covariance is not None
    facts = store.scenes.facts(scene.id)
    noted = next((fact.value for fact in reversed(facts) if fact.kind == "note"), "")
    return SceneReport(
        **vars(_scene_row(scene, placed, graph.num_nodes if graph else None, noted)),
        origin=scene.source,
        sh_degree=scene.sh_degree,
        num_cameras=scene.num_cameras,
        cameras_synthesised=scene.cameras_synthesised,
        antialiased=scene.antialiased,
        bounds=scene.bounds,
        notes=(*store.scenes.notes(scene.id), *(graph.notes if graph else ()), *([graph_note] if graph_note else ())),
        rotation_sigma_deg=_rotation_sigma_deg(pose) if pose and known else None,
        translation_sigma_m=_translation_sigma(pose) if pose and known else None,
        covariance=pose.covariance if pose else None,
        prior=prior_row(store, scene),
        up=graph.up if graph else None,
        unit_m=graph.unit_m if graph else None,
        layers=_layer_rows(graph) if graph else (),
        edges=_edges_of(store, scene),
        nodes=_node_rows(graph) if graph else (),
        history=tuple(
            FactRow(at=fact.created_at, fact=fact.kind, value=fact.value, author=fact.author) for fact in facts
        ),
    )


def _rotation_sigma_deg(pose: ScenePose) -> float:
    assert pose.covariance is not None
    return float(np.degrees(np.sqrt(np.diag(pose.covariance)[:3].max())))


def _translation_sigma(pose: ScenePose) -> float:
    assert pose.covariance is not None
    return float(np.sqrt(np.diag(pose.covariance)[3:6].max()) * pose.S_map_scene.scale)


def prior_row(store: Store, scene: Scene) -> PriorRow | None:
    """What is known of a scene's pose from outside, and what the newest poses made of it."""
    placed = store.revisions.get()
    for prior in store.priors.list():
        if prior.scene == scene.id:
            outweighed = placed is not None and scene.id in placed.provenance.contradicted_priors
            return PriorRow(
                scene=scene.id,
                scene_name=scene.name,
                S_map_scene=prior.S_map_scene,
                sigmas=prior.sigmas,
                up=prior.up,
                up_sigma_rad=prior.up_sigma_rad,
                outcome="not solved yet" if placed is None else "outweighed by the edges" if outweighed else "used",
            )
    return None


def _edges_of(store: Store, scene: Scene) -> tuple[SceneEdgeRow, ...]:
    out = []
    for row in edge_rows(store):
        if scene.id in (row.target, row.source):
            at_target = row.source == scene.id
            out.append(
                SceneEdgeRow(
                    scene=row.target if at_target else row.source,
                    scene_name=row.target_name if at_target else row.source_name,
                    status=row.status,
                    used=row.used,
                    overlap=row.overlap,
                    num_inliers=row.num_inliers,
                    reason=row.reason,
                )
            )
    return tuple(out)


def _layer_rows(graph: SceneGraph) -> tuple[LayerRow, ...]:
    return tuple(
        LayerRow(layer=name, num_nodes=len(layer), descriptor_id=layer.descriptor_id, unit_m=layer.unit_m)
        for name, layer in graph.layers.items()
    )


def _node_rows(graph: SceneGraph) -> tuple[NodeRow, ...]:
    """Objects first: they are the ones people browse; then the landmarks of the scene's own unit."""
    shown = [name for name in ("objects", "landmarks") if name in graph.layers] or list(graph.layers)[:1]
    return tuple(
        NodeRow(
            layer=name,
            index=i,
            position=layer.positions[i],
            size=layer.extents[i, 1] - layer.extents[i, 0],
            type=int(layer.types[i]),
            weight=float(layer.weights[i]),
            num_views=int(layer.num_views[i]),
        )
        for name in shown
        for layer in [graph.layers[name]]
        for i in range(len(layer))
    )


def ingest_row(scene: Scene, *, new: bool, dated: bool, notes: Sequence[str]) -> IngestRow:
    """What became of one capture that was given."""
    return IngestRow(
        scene=scene.id,
        scene_name=scene.name,
        new=new,
        num_gaussians=scene.num_gaussians,
        notes=tuple(notes),
        captured_at=scene.captured_at,
        dated=dated,
    )


def graph_row(store: Store, scene: Scene, key: RecipeKey) -> GraphRow:
    """The graph of a scene under a key, which was made."""
    graph = store.graphs.load(scene.id, key)
    assert graph is not None
    return GraphRow(
        scene=scene.id,
        scene_name=scene.name,
        num_nodes=graph.num_nodes,
        layers=_layer_rows(graph),
        up=graph.up,
        unit_m=graph.unit_m,
        key=key.digest,
        notes=graph.notes,
    )


@of_one_state
def pose_rows(store: Store) -> list[PoseRow]:
    """Where every placed living scene lies, oldest scene first."""
    placed = store.revisions.get()
    poses = placed.poses if placed else {}
    return [
        PoseRow(
            scene=scene.id,
            scene_name=scene.name,
            component=poses[scene.id].component,
            status=poses[scene.id].status,
            S_map_scene=poses[scene.id].S_map_scene,
            covariance=poses[scene.id].covariance,
        )
        for scene in store.scenes.list()
        if scene.id in poses
    ]


# --- pairs -----------------------------------------------------------------------------------------------------------


@of_one_state
def edge_rows(
    store: Store,
    *,
    component: int | None = None,
    status: str | None = None,
    after: str | None = None,
    tag: str | None = None,
    as_of: str | None = None,
) -> list[EdgeRow]:
    """The current edge of every pair that was tried.

    Args:
        component, tag: only those both of whose scenes are in it, or have it.
        status: only those of this one.
        after: ISO 8601; only those registered after it.
        as_of: ISO 8601; only those both of whose scenes are dated at or before it.

    Raises:
        ConfigError: no such status, or a date that is none.
    """
    _one_of(status, EDGE_STATUSES)
    since = None if after is None else parsed(after)
    inside = None
    if component is not None or tag is not None or as_of is not None:
        inside = {row.id for row in scene_rows(store, component=component, tag=tag, as_of=as_of)}
    return [
        row
        for row in _edge_rows(store, store.registrations.current())
        if (inside is None or {row.target, row.source} <= inside)
        and (status is None or row.status == status)
        and (since is None or is_after(row.registered_at, since))
    ]


@of_one_state
def rows_of_edges(store: Store, made: Iterable[Registration]) -> list[EdgeRow]:
    """The current edges of the pairs of these registrations, in their order."""
    rows = {frozenset((row.target, row.source)): row for row in _edge_rows(store, store.registrations.current())}
    return [rows[frozenset((edge.target, edge.source))] for edge in made]


@of_one_state
def edge_row(store: Store, a: Scene, b: Scene) -> EdgeRow:
    """The current edge of a pair; one that has none (a lone measurement was withdrawn) is ``never registered``."""
    current = store.registrations.get(a.id, b.id)
    return EdgeRow(**_never_registered(a, b)) if current is None else _edge_rows(store, [current])[0]


def _edge_rows(store: Store, edges: Iterable[StoredRegistration]) -> list[EdgeRow]:
    placed, name_of = store.revisions.get(), names(store)
    return [_edge_row(stored, placed, name_of) for stored in edges]


def _edge_row(stored: StoredRegistration, placed: PoseGraph | None, name_of: Mapping[str, str]) -> EdgeRow:
    edge = stored.registration
    outcome = placed.outcomes.get((edge.target, edge.source)) if placed else None
    status, reason = edge.status, edge.reason or (outcome.reason if outcome else "")
    if stored.review == "confirm":
        status, reason = "accepted", "confirmed by a person"
    elif stored.review == "reject":
        status, reason = "rejected", "rejected by a person"
    return EdgeRow(
        target=edge.target,
        target_name=name_of[edge.target],
        source=edge.source,
        source_name=name_of[edge.source],
        status=status,
        reason=reason,
        S_target_source=edge.S_target_source,
        scale=edge.scale,
        information=edge.information,
        num_inliers=edge.num_inliers,
        num_correspondences=edge.num_correspondences,
        overlap=edge.overlap,
        seconds={step: edge.seconds.get(step, 0.0) for step in ("match", "refine", "verdict")},
        used=_USED[outcome.use] if outcome else False,
        undecided=outcome is not None and outcome.undecided,
        review=stored.review,
        proposer=edge.proposer,
        registered_at=stored.created_at,
    )


_USED: dict[str, bool | str] = {"used": True, "tentative": "tentative", "unused": False}


@of_one_state
def pair_report(store: Store, a: Scene, b: Scene) -> PairReport:
    """Everything known of one pair: its current edge, the evidence it rests on, and all that was said before."""
    current = store.registrations.get(a.id, b.id)
    events = [
        PairEventRow(at=old.created_at, what=old.registration.status, reason=old.registration.reason)
        for old in store.registrations.history(a.id, b.id)
    ]
    events += [
        PairEventRow(at=word.created_at, what=word.review, reason=word.note)
        for word in store.registrations.reviews(a.id, b.id)
    ]
    history = tuple(sorted(events, key=lambda event: event.at))
    if current is None:
        return PairReport(**_never_registered(a, b), evidence={}, history=history)
    placed, edge = store.revisions.get(), current.registration
    outcome = placed.outcomes.get((edge.target, edge.source)) if placed else None
    return PairReport(
        **vars(_edge_row(current, placed, names(store))),
        exact=edge.exact,
        evidence=edge.evidence,
        residual_chi2=outcome.residual_chi2 if outcome else None,
        notes=edge.notes,
        history=history,
    )


def _never_registered(a: Scene, b: Scene) -> dict[str, Any]:
    """The fields of `EdgeRow` of a pair without an edge."""
    return {
        "target": a.id,
        "target_name": a.name,
        "source": b.id,
        "source_name": b.name,
        "status": "never registered",
        "reason": "",
        "S_target_source": None,
        "scale": None,
        "information": None,
        "num_inliers": 0,
        "num_correspondences": 0,
        "overlap": 0.0,
        "seconds": {},
        "used": False,
    }


# --- revisions -------------------------------------------------------------------------------------------------------


@of_one_state
def revision_rows(store: Store) -> list[RevisionRow]:
    """Every answer of the optimiser, oldest first."""
    name_of = names(store)
    return [
        _revision_row(revision, store.revisions.get(revision.number), name_of) for revision in store.revisions.list()
    ]


def made_after(rows: Iterable[RevisionRow], after: str | None) -> list[RevisionRow]:
    """Those made after a date (ISO 8601); all where it is None.

    Raises:
        ConfigError: a date that is none.
    """
    since = None if after is None else parsed(after)
    return [row for row in rows if since is None or is_after(row.created_at, since)]


@of_one_state
def revision_row(store: Store, number: int) -> RevisionRow:
    """One answer of the optimiser."""
    found = next(revision for revision in store.revisions.list() if revision.number == number)
    return _revision_row(found, store.revisions.get(number), names(store))


def _revision_row(revision: Revision, graph: PoseGraph | None, name_of: Mapping[str, str]) -> RevisionRow:
    assert graph is not None
    uses = [outcome.use for outcome in graph.outcomes.values()]
    return RevisionRow(
        number=revision.number,
        created_at=revision.created_at,
        scenes=revision.num_scenes,
        components=revision.num_components,
        edges_used=uses.count("used"),
        edges_tentative=uses.count("tentative"),
        edges_refused=uses.count("unused"),
        undecided=tuple(
            PairRef(target=a, target_name=name_of[a], source=b, source_name=name_of[b]) for a, b in graph.undecided
        ),
        solver=graph.provenance.method,
        contradicted_priors=_refs(graph.provenance.contradicted_priors, name_of),
        settings=graph.settings,
        notes=graph.notes,
        note=revision.note,
        key=revision.key,
        dropped_at=revision.dropped_at,
    )


@of_one_state
def pose_change_rows(store: Store, before: int, after: int) -> list[PoseChangeRow]:
    """How each scene differs between two revisions, measured at its middle.

    Raises:
        NotFoundError: no such revision.
    """
    from gsmap.optimize import diff

    old, new = store.revisions.get(before), store.revisions.get(after)
    assert old is not None
    assert new is not None
    known = scenes_by_id(store)
    changes = diff(old, new, {scene.id: scene.bounds.mean(0) for scene in known.values()})
    return [
        PoseChangeRow(
            scene=change.scene,
            scene_name=known[change.scene].name,
            change=change.kind,
            rotation_deg=change.rotation_deg,
            translation_m=change.translation,
            scale_ratio=change.scale_ratio,
            component_before=change.components[0],
            component_after=change.components[1],
            status_before=change.statuses[0],
            status_after=change.statuses[1],
        )
        for change in changes.values()
    ]


@of_one_state
def update_report(store: Store, ingested: Sequence[IngestRow]) -> UpdateReport:
    """What an update took in, and the map as it is now."""
    revisions = store.revisions.list()
    return UpdateReport(
        ingested=tuple(ingested),
        scenes=tuple(scene_rows(store)),
        edges=tuple(edge_rows(store)),
        revision=revision_row(store, revisions[-1].number) if revisions else None,
    )


# --- exports, models, settings, upkeep -------------------------------------------------------------------------------


@of_one_state
def tile_rows(store: Store) -> list[TileRow]:
    """Every tile of every folder exported to."""
    name_of = names(store)
    return [
        _tile_row(Path(target), tile, name_of)
        for target in store.exports.targets()
        for tile in store.exports.tiles(target)
    ]


@of_one_state
def export_report(store: Store, out: Path, made: ExportResult, notes: Sequence[str] = ()) -> ExportReport:
    """What an export did."""
    name_of = names(store)
    return ExportReport(
        out=str(out),
        tiles=tuple(_tile_row(out, tile, name_of) for tile in made.tiles if tile.path),
        recomputed=made.recomputed,
        reused=made.reused,
        removed=made.removed,
        notes=tuple(notes),
    )


def _tile_row(out: Path, tile: Tile, name_of: Mapping[str, str]) -> TileRow:
    return TileRow(
        out=str(out),
        path=tile.path,
        component=tile.component,
        bounds=tile.bounds,
        num_gaussians=tile.num_gaussians,
        scenes=_refs(tile.poses, name_of),
        merge=str(tile.recipe.get("method", "")).partition(" ")[0],
        recipe=tile.recipe,
        truncated=tile.truncated,
        sha256=tile.sha256,
        notes=tile.notes,
    )


def model_rows(store: Store) -> list[ModelRow]:
    """The map's ONNX models."""
    return [
        ModelRow(
            kind=model.kind,
            name=model.name,
            sha256=model.sha256,
            preset=model.options.get("preset"),
            path=str(model.path),
        )
        for model in store.models.list()
    ]


def setting_rows(settings: Settings) -> list[SettingRow]:
    """Every setting with its default, unit and meaning."""
    defaults = {leaf.name: leaf.value for leaf in leaves(type(settings)())}
    return [
        SettingRow(name=leaf.name, value=leaf.value, default=defaults.get(leaf.name), unit=leaf.unit, doc=leaf.meaning)
        for leaf in leaves(settings)
    ]


def check_report(found: Check) -> CheckReport:
    """What reading every byte found."""
    return CheckReport(
        ok=found.ok,
        problems=found.problems,
        orphans=found.orphans,
        num_groups=found.num_groups,
        num_bytes=found.num_bytes,
        unverified=found.unverified,
    )


def prune_report(pruned: Pruned, dry_run: bool) -> PruneReport:
    """What was reclaimed, or would be."""
    return PruneReport(
        dry_run=dry_run,
        scene_names=tuple(pruned.scenes),
        revisions=tuple(pruned.revisions),
        num_graphs=pruned.num_graphs,
        num_orphans=pruned.num_orphans,
        num_bytes=pruned.num_bytes,
    )


@of_one_state
def names(store: Store) -> dict[str, str]:
    """The name of every scene by its id, removed ones included."""
    return _ByScene((scene, found.name) for scene, found in scenes_by_id(store).items())


def scenes_by_id(store: Store) -> dict[str, Scene]:
    """Every scene by its id, removed ones included."""
    return _ByScene((scene.id, scene) for scene in [*store.scenes.list(removed=True), *store.scenes.list()])


class _ByScene(dict[str, Any]):
    """What is known of every scene, by its id. A row that names another one is not gsmap's."""

    def __missing__(self, scene: str) -> NoReturn:
        raise CorruptError(f"the catalog has results of scene {scene[:12]}, which it does not have: run gsmap check")


def _refs(scenes: Iterable[str], name_of: Mapping[str, str]) -> tuple[SceneRef, ...]:
    return tuple(SceneRef(scene=scene, scene_name=name_of[scene]) for scene in scenes)


def _one_of(value: str | None, known: Sequence[str]) -> None:
    if value is not None and value not in known:
        raise ConfigError(f"there is no status {value!r}: choose one of {', '.join(known)}")
