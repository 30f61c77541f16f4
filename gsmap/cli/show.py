"""gsmap show: show the details of a scene, a pair, a change or an object."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsmap.cli.console import AsJson, MapPath, Output, opened, print_facts, print_rows, print_table, say
from gsmap.cli.history import print_history
from gsmap.texts import shown

if TYPE_CHECKING:
    from gsmap.map import Map
    from gsmap.types import Sim3
    from gsmap.types.metric_scale import MetricScale
    from gsmap.types.rows.changes import ChangeDetail
    from gsmap.types.rows.objects import HistoryReport
    from gsmap.types.rows.pairs import PairReport
    from gsmap.types.rows.scenes import SceneReport

PANEL = "Map", 9
OUTPUTS = {
    "show SCENE": Output("scenes.SceneReport"),
    "show A:B": Output("pairs.PairReport"),
    "show CHANGE": Output("changes.ChangeDetail"),
    "show OBJECT": Output("objects.HistoryReport"),
}
_SHOWN = 8  # maximum number of edges, notes and events, so that everything fits a screen


def command(
    map: MapPath,
    thing: Annotated[
        str,
        typer.Argument(
            metavar="SCENE|A:B|CHANGE|OBJECT",
            help="A scene, a pair of scenes, a change such as c12, or an object such as o12; scene names take "
            "precedence.",
        ),
    ],
    nodes: Annotated[bool, typer.Option("--nodes", help="Also list the nodes of the scene graph.")] = False,
    picture: Annotated[
        str | None,
        typer.Option(
            "--picture",
            metavar="FILE.png",
            help="Also draw the scene graph, both captures of the pair from the same cameras, the change, or the "
            "object.",
        ),
    ] = None,
    json: AsJson = False,
) -> None:
    """Show all details of one scene, one pair of scenes, one change or one object.

    Example: `gsmap show site.gsmap monday --picture monday.png`
    """
    from gsmap.types.rows.changes import ChangeDetail
    from gsmap.types.rows.objects import HistoryReport
    from gsmap.types.rows.pairs import PairReport
    from gsmap.types.rows.scenes import SceneReport

    with opened(map) as m:
        report = _report(m, thing)
        if picture:
            draw = {
                SceneReport: m.draw_graph,
                PairReport: m.draw_pair,
                ChangeDetail: m.draw_change,
                HistoryReport: m.draw_object,
            }
            draw[type(report)](thing, picture)
            say(f"wrote {picture}")
    if json:
        kinds = {
            SceneReport: "show SCENE",
            PairReport: "show A:B",
            ChangeDetail: "show CHANGE",
            HistoryReport: "show OBJECT",
        }
        print_rows(kinds[type(report)], report, json)
    elif isinstance(report, SceneReport):
        _print_scene(report, nodes)
    elif isinstance(report, ChangeDetail):
        _print_change(report)
    elif isinstance(report, HistoryReport):
        print_history(report)
    else:
        _print_pair(report)


def _report(m: Map, thing: str) -> SceneReport | PairReport | ChangeDetail | HistoryReport:
    from gsmap.errors import NotFoundError
    from gsmap.store import changes, objects

    # A scene name may contain a colon, or look like a change; the id of a scene may begin like a change.
    if changes.number_of(thing) is not None and all(scene.name != thing for scene in m.scenes()):
        return m.show_change(thing)
    try:
        return m.show_scene(thing)
    except NotFoundError:
        if ":" in thing:
            return m.show_pair(thing)
        if objects.number_of(thing) is not None:
            return m.history(thing)
        raise


def _print_scene(scene: SceneReport, nodes: bool) -> None:
    size, prior, sigmas = scene.bounds[1] - scene.bounds[0], scene.prior, None
    metre = _metre(scene)
    if scene.rotation_sigma_deg is not None:
        sigmas = f"{shown(scene.rotation_sigma_deg)} deg, {shown(scene.translation_sigma_m)} m"
    facts = {
        "id": scene.id,
        "status": scene.status,
        "component": scene.component,
        "pose in the map (map units)": _pose(scene.S_map_scene),
        "its sigmas": sigmas,
        "pose prior": prior and f"{_pose(prior.S_map_scene)}; {prior.outcome}",
        "captured": _captured(scene),
        "ingested": scene.ingested_at,
        "read from": scene.origin,
        "tags": scene.tags,
        "note": scene.note,
        "Gaussians": f"{scene.num_gaussians}, SH degree {scene.sh_degree}" + ", antialiased" * scene.antialiased,
        "cameras": f"{scene.num_cameras}" + ", synthesised" * scene.cameras_synthesised,
        "size": f"{shown(size)} units",
        "scale": scene.scale_policy + ("" if scene.unit_m is None else f", about {shown(scene.unit_m)} m per unit"),
        "map": None if metre is None else metre.text(),
        "note on the metric scale": scene.metre_note or None,
        "up": scene.up,
        "nodes": None if scene.num_nodes is None else _layers(scene),
        **{f"note {i}": note for i, note in enumerate(scene.notes[:_SHOWN], 1)},
    }
    print_facts(scene.name, facts)
    if scene.edges:
        print_table("edges", scene.edges[0].columns, scene.edges[:_SHOWN])
    if len(scene.edges) > _SHOWN:
        print(f"... and {len(scene.edges) - _SHOWN} more edges: gsmap list MAP edges")
    if nodes and scene.nodes:
        print_table("nodes", scene.nodes[0].columns, scene.nodes)


def _print_pair(pair: PairReport) -> None:
    facts = {
        "target": f"{pair.target_name} ({pair.target})",
        "source": f"{pair.source_name} ({pair.source})",
        "status": pair.status,
        "reason": pair.reason,
        "use": pair.use,
        "undecided": "yes: another group of edges contradicts it" if pair.undecided else None,
        "review": pair.review,
        "source in target (target units)": _pose(pair.S_target_source),
        "overlap": pair.overlap,
        "inliers": f"{pair.num_inliers} of {pair.num_correspondences} correspondences",
        "proposer": pair.proposer,
        "clique": None if pair.exact else "not proved to be the largest clique",
        "residual chi2": pair.residual_chi2,
        "seconds": pair.seconds,
        "evidence": pair.evidence,
        **{f"note {i}": note for i, note in enumerate(pair.notes[:_SHOWN], 1)},
    }
    print_facts(pair.pair, facts)
    if pair.history:
        print_table("history", pair.history[0].columns, pair.history[-_SHOWN:])


def _print_change(change: ChangeDetail) -> None:
    facts = {
        "kind": change.kind,
        "from": f"{change.older_name}, {change.older_at}",
        "to": f"{change.newer_name}, {change.newer_at}",
        "status": change.status,
        "confidence": change.confidence,
        "centre (m)": change.at_m,
        "size (m)": change.size_m,
        "component": change.component,
        "moved": _pose(change.S_after_before),
        "symmetry": change.symmetry if change.S_after_before is not None else None,
        "Gaussians": f"{change.before} before, {change.after} after",
        "voxels": change.num_voxels,
        "evidence": change.evidence,
        "found": change.compared_at,
        **{f"note {i}": note for i, note in enumerate(change.notes[:_SHOWN], 1)},
    }
    print_facts(change.id, facts)
    if change.history:
        print_table("history", change.history[0].columns, change.history[-_SHOWN:])


def _pose(pose: Sim3 | None) -> str | None:
    """Format a pose: position of the origin, angle and axis of the rotation, and the scale if it differs from 1."""
    if pose is None:
        return None
    import numpy as np

    from gsmap.geometry.rotations import rotation_vector

    turned = rotation_vector(pose.rotation)
    angle = float(np.linalg.norm(turned))
    axis = f" about {shown(np.round(turned / angle, 3))}" if angle > 2e-9 else ""
    scale = "" if pose.is_rigid else f", scale {pose.scale:.5g}"
    return f"at {shown(np.round(pose.translation, 4))}, turned {np.degrees(angle):.2f} deg{axis}{scale}"


def _captured(scene: SceneReport) -> str | None:
    """Format the capture date of a scene, with its source."""
    if scene.captured_at is None:
        return None
    authors = [fact.author for fact in scene.history if fact.fact == "captured_at"]
    return f"{scene.captured_at}, specified by {(authors and authors[-1]) or 'a person'}"


def _metre(scene: SceneReport) -> MetricScale | None:
    """Return the metric scale of the component frame of a scene."""
    from gsmap.types.metric_scale import MetricScale, as_known_by

    if not scene.metre_known_by:
        return None
    return MetricScale(
        scene.metres_per_unit or 1.0, scene.metre_sigma or float("inf"), as_known_by(scene.metre_known_by)
    )


def _layers(scene: SceneReport) -> str:
    return ", ".join(f"{layer.num_nodes} {layer.layer}" for layer in scene.layers)
