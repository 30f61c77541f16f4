"""The map's contents as plain rows: what ``gsmap list`` and ``gsmap show`` print, and scripts parse."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmap.store import Store
from gsmap.store.registrations import StoredRegistration
from gsmap.types import PoseGraph, Scene, SceneGraph, Sim3


def scene_rows(store: Store) -> list[dict[str, Any]]:
    """``gsmap list MAP scenes``: one row per living scene."""
    placed = store.revisions.get()
    nodes = {graph.scene: graph.num_nodes for graph in store.graphs.list()}
    return [_scene_row(scene, placed, nodes.get(scene.id)) for scene in store.scenes.list()]


def _scene_row(scene: Scene, placed: PoseGraph | None, num_nodes: int | None) -> dict[str, Any]:
    pose = placed.poses.get(scene.id) if placed else None
    return {
        "name": scene.name,
        "id": scene.id,
        "num_gaussians": scene.num_gaussians,
        "num_nodes": num_nodes,
        "component": pose.component if pose else None,
        "S_map_scene": _matrix(pose.S_map_scene) if pose else None,
        "captured_at": scene.captured_at,
        "status": pose.status if pose else ("ingested" if num_nodes is None else "described"),
    }


def edge_rows(store: Store) -> list[dict[str, Any]]:
    """``gsmap list MAP edges``: the current edge of every pair that was tried."""
    placed = store.revisions.get()
    return [_edge_row(stored, placed) for stored in store.registrations.current()]


def _edge_row(stored: StoredRegistration, placed: PoseGraph | None) -> dict[str, Any]:
    edge = stored.registration
    pair = (edge.target, edge.source)
    reason = edge.reason or (placed.reasons.get(pair, "") if placed else "")
    by_person = {"confirm": "confirmed by a person", "reject": "rejected by a person"}.get(stored.verdict or "")
    return {
        "target": edge.target,
        "source": edge.source,
        "status": {"confirm": "accepted", "reject": "rejected"}.get(stored.verdict or "", edge.status),
        "reason": by_person or reason,
        "S_target_source": _matrix(edge.S_target_source),
        "scale": edge.scale,
        "information": None if edge.information is None else edge.information.tolist(),
        "num_inliers": edge.num_inliers,
        "num_correspondences": edge.num_correspondences,
        "overlap": edge.overlap,
        "seconds": {step: edge.seconds.get(step, 0.0) for step in ("match", "refine", "verdict")},
        "used": placed.used.get(pair, False) if placed else False,
    }


def revision_rows(store: Store) -> list[dict[str, Any]]:
    """``gsmap list MAP revisions``: every answer of the optimiser, oldest first."""
    rows = []
    for revision in store.revisions.list():
        graph = store.revisions.get(revision.number)
        used = list(graph.used.values()) if graph else []
        rows.append(
            {
                "number": revision.number,
                "created_at": revision.created_at,
                "scenes": revision.num_scenes,
                "components": revision.num_components,
                "edges_used": sum(u is True for u in used),
                "edges_tentative": sum(u == "tentative" for u in used),
                "edges_refused": sum(u is False for u in used),
                "undecided": [list(pair) for pair in graph.undecided] if graph else [],
                "parameters": graph.parameters if graph else {},
            }
        )
    return rows


def tile_rows(store: Store) -> list[dict[str, Any]]:
    """``gsmap list MAP tiles``: every tile of every folder exported to."""
    names = {s.id: s.name for s in [*store.scenes.list(removed=True), *store.scenes.list()]}
    return [
        {
            "out": target,
            "path": tile.path,
            "component": tile.component,
            "bounds": tile.bounds.tolist(),
            "num_gaussians": tile.num_gaussians,
            "scenes": [names[scene] for scene in tile.poses],
            "merge": tile.method.split()[0],
            "method": tile.method,
            "truncated": tile.truncated,
            "sha256": tile.sha256,
        }
        for target in store.exports.targets()
        for tile in store.exports.tiles(target)
    ]


def model_rows(store: Store) -> list[dict[str, Any]]:
    """``gsmap models list MAP``."""
    return [
        {
            "kind": model.kind,
            "name": model.name,
            "sha256": model.sha256,
            "preset": model.options.get("preset"),
            "path": str(model.path),
        }
        for model in store.models.list()
    ]


def scene_facts(store: Store, scene: Scene, graph: SceneGraph | None) -> dict[str, Any]:
    """``gsmap show MAP SCENE``: the scene's row, what it was read from, its edges and its nodes."""
    placed = store.revisions.get()
    facts = _scene_row(scene, placed, graph.num_nodes if graph else None)
    facts |= {
        "source": scene.source,
        "ingested_at": scene.ingested_at,
        "sh_degree": scene.sh_degree,
        "num_cameras": scene.num_cameras,
        "cameras_synthesised": scene.cameras_synthesised,
        "scale_policy": scene.scale_policy,
        "bounds": scene.bounds.tolist(),
        "notes": [*store.scenes.notes(scene.id), *(graph.notes if graph else ())],
    }
    pose = placed.poses.get(scene.id) if placed else None
    if pose is not None and pose.covariance is not None:
        sigmas = np.sqrt(np.diag(pose.covariance))
        facts["rotation_sigma_deg"] = float(np.degrees(sigmas[:3].max()))
        facts["translation_sigma_m"] = float(sigmas[3:6].max() * pose.S_map_scene.scale)
        facts["covariance"] = pose.covariance.tolist()
    for prior in store.priors.list():
        if prior.scene == scene.id:
            facts["prior"] = {"pose": prior.S_map_scene.matrix().tolist(), "sigmas": prior.sigmas.tolist()}
            dropped = scene.id in (placed.parameters.get("contradicted_priors", ()) if placed else ())
            facts["prior"]["verdict"] = "outweighed by the edges" if dropped else "used"
    if graph is not None:
        facts["up"] = None if graph.up is None else graph.up.tolist()
        facts["unit_m"] = graph.unit_m
    names = {s.id: s.name for s in store.scenes.list()}
    facts["edges"] = [
        {"with": names[other], **{k: row[k] for k in ("status", "used", "overlap", "num_inliers", "reason")}}
        for row in edge_rows(store)
        if (other := {row["target"]: row["source"], row["source"]: row["target"]}.get(scene.id))
    ]
    facts["nodes"] = _node_rows(graph) if graph else []
    return facts


def _node_rows(graph: SceneGraph) -> list[dict[str, Any]]:
    """Objects first: they are the ones people browse; then the landmarks of the scene's own unit."""
    shown = [name for name in ("objects", "landmarks") if name in graph.layers] or list(graph.layers)[:1]
    return [
        {
            "layer": name,
            "index": i,
            "position": layer.positions[i].tolist(),
            "size": (layer.extents[i, 1] - layer.extents[i, 0]).tolist(),
            "type": int(layer.types[i]),
            "weight": float(layer.weights[i]),
            "num_views": int(layer.num_views[i]),
        }
        for name in shown
        for layer in [graph.layers[name]]
        for i in range(len(layer))
    ]


def pair_facts(store: Store, a: Scene, b: Scene) -> dict[str, Any]:
    """``gsmap show MAP A:B``: the pair's current edge, the evidence it rests on, and everything said of it before."""
    current = store.registrations.get(a.id, b.id)
    if current is None:
        return {"pair": f"{a.name}:{b.name}", "status": "never registered"}
    placed = store.revisions.get()
    edge = current.registration
    names = {a.id: a.name, b.id: b.name}
    facts = _edge_row(current, placed)
    facts |= {"target": names[edge.target], "source": names[edge.source]}
    facts |= {"method": edge.proposer, "exact": edge.exact, "evidence": edge.evidence}
    facts["residual_chi2"] = placed.residuals.get((edge.target, edge.source)) if placed else None
    facts["history"] = [
        {"when": old.created_at, "what": old.registration.status, "reason": old.registration.reason}
        for old in store.registrations.history(a.id, b.id)
    ] + [
        {"when": word.created_at, "what": word.verdict, "reason": word.note}
        for word in store.registrations.verdicts(a.id, b.id)
    ]
    return facts


def _matrix(pose: Sim3 | None) -> list[list[float]] | None:
    return None if pose is None else pose.matrix().tolist()
