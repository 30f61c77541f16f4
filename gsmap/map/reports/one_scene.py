"""Report one scene in full."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from gsmap.map.reports.one_pair import scenes_by_one_pair
from gsmap.map.reports.pairs import edges_of_scene
from gsmap.map.reports.scenes import any_tentative, row_of_scene
from gsmap.map.snapshot_read import snapshot_read
from gsmap.methods import RecipeKey
from gsmap.store import Store
from gsmap.types import Scene, SceneGraph, ScenePose
from gsmap.types.metric_scale import MetricScale
from gsmap.types.plain import canonical
from gsmap.types.rows.scenes import FactRow, GraphRow, LayerRow, NodeRow, PriorRow, SceneEdgeRow, SceneReport


@snapshot_read
def scene_report(
    store: Store,
    scene: Scene,
    graph: SceneGraph | None,
    graph_note: str = "",
    metres: Mapping[int, MetricScale] | None = None,
) -> SceneReport:
    """Report a scene with its pose, graph, edges and annotations.

    Args:
        graph: its scene graph; None if there is none.
        graph_note: remark on the choice of the graph.
        metres: metric scale of every component of the newest poses; left out if None.
    """
    placed = store.revisions.poses(scene.id)
    pose = placed.get(scene.id)
    known = pose is not None and pose.covariance is not None
    facts = store.scenes.facts(scene.id)
    metre = (metres or {}).get(pose.component, MetricScale()) if pose else None
    noted = next((fact.value for fact in reversed(facts) if fact.kind == "note"), "")
    return SceneReport(
        **vars(
            row_of_scene(
                scene,
                placed,
                graph.num_nodes if graph else None,
                noted,
                metres,
                one_pair=any_tentative(placed) and scene.id in scenes_by_one_pair(store),
            )
        ),
        origin=scene.source,
        cameras_synthesised=scene.cameras_synthesised,
        antialiased=scene.antialiased,
        notes=(*store.scenes.notes(scene.id), *(graph.notes if graph else ()), *([graph_note] if graph_note else ())),
        rotation_sigma_deg=_rotation_sigma_deg(pose) if pose and known else None,
        translation_sigma_m=_translation_sigma(pose) * metre.metres_per_unit if pose and metre and known else None,
        covariance=pose.covariance if pose else None,
        prior=prior_row(store, scene),
        up=graph.up if graph else None,
        unit_m=graph.unit_m if graph else None,
        metre_sigma=metre.sigma if metre and metre.is_known else None,
        metre_known_by=metre.known_by if metre else "",
        metre_note=metre.note if metre else "",
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
    """Return the pose prior of a scene and its outcome in the newest poses."""
    prior, newest = store.priors.of(scene.id), store.revisions.newest()
    if prior is None:
        return None
    outcome = "not solved yet"
    if newest is not None and canonical(store.priors.of(scene.id, newest.created_at)) == canonical(prior):
        outcome = "outweighed by the edges" if scene.id in newest.provenance.contradicted_priors else "used"
    return PriorRow(**vars(prior) | {"scene": scene.id}, scene_name=scene.name, outcome=outcome)


def _edges_of(store: Store, scene: Scene) -> tuple[SceneEdgeRow, ...]:
    out = []
    for row in edges_of_scene(store, scene):
        at_target = row.source == scene.id
        out.append(
            SceneEdgeRow(
                scene=row.target if at_target else row.source,
                scene_name=row.target_name if at_target else row.source_name,
                status=row.status,
                used=row.used,
                use=row.use,
                overlap=row.overlap,
                num_inliers=row.num_inliers,
                reason=row.reason,
                reason_code=row.reason_code,
            )
        )
    return tuple(out)


def _layer_rows(graph: SceneGraph) -> tuple[LayerRow, ...]:
    return tuple(
        LayerRow(layer=name, num_nodes=len(layer), descriptor_id=layer.descriptor_id, unit_m=layer.unit_m)
        for name, layer in graph.layers.items()
    )


def _node_rows(graph: SceneGraph) -> tuple[NodeRow, ...]:
    """Return the nodes: objects first, then landmarks of the scene's own unit."""
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


def graph_row(store: Store, scene: Scene, key: RecipeKey) -> GraphRow:
    """Return the row of a stored graph."""
    graph = store.graphs.find(key)
    assert graph is not None
    layers = []
    for name, count in graph.layers.items():
        about = graph.about_layers[name]
        row = LayerRow(
            layer=name,
            num_nodes=count,
            descriptor_id=about.get("descriptor_id", ""),
            unit_m=about.get("unit_m", 1.0),
        )
        layers.append(row)
    return GraphRow(
        scene=scene.id,
        scene_name=scene.name,
        num_nodes=graph.num_nodes,
        layers=tuple(layers),
        up=None if graph.up is None else np.array(graph.up),
        unit_m=graph.unit_m,
        key=key.digest,
        notes=graph.notes,
    )
