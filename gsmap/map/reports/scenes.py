"""The scenes of a map, and where they lie."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from gsmap.map.dates import is_after, is_until, last_of, parsed
from gsmap.map.one_state import of_one_state
from gsmap.map.reports.common import one_of
from gsmap.store import Store
from gsmap.types import Scene, ScenePose
from gsmap.types.metre import Metre
from gsmap.types.rows import IngestRow, PoseRow, SceneRow

SCENE_STATUSES = ("ingested", "described", "placed", "tentative", "isolated")


@of_one_state
def scene_rows(
    store: Store,
    *,
    component: int | None = None,
    status: str | None = None,
    after: str | None = None,
    tag: str | None = None,
    as_of: str | None = None,
    metres: Mapping[int, Metre] | None = None,
) -> list[SceneRow]:
    """The living scenes, oldest first.

    Args:
        component: only those of this one.
        status: only those of this one, see `SceneRow`.
        after: ISO 8601; only those captured (or else ingested) after it.
        tag: only those that have it.
        as_of: ISO 8601; only those dated at or before it, those without a date left out.
        metres: of every component of the newest poses; not told where None.

    Raises:
        ConfigError: no such status, or a date that is none.
    """
    one_of(status, SCENE_STATUSES)
    since = None if after is None else parsed(after)
    until = None if as_of is None else last_of(as_of)
    placed, nodes = store.revisions.poses(), store.graphs.node_counts()
    said = store.scenes.latest_notes()
    rows = [
        row_of_scene(scene, placed, nodes.get(scene.id), said.get(scene.id, ""), metres)
        for scene in store.scenes.list()
    ]
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
def scene_row(store: Store, scene: Scene, metres: Mapping[int, Metre]) -> SceneRow:
    """The row of one scene."""
    placed, nodes = store.revisions.poses(scene.id), store.graphs.node_counts()
    return row_of_scene(scene, placed, nodes.get(scene.id), store.scenes.latest_notes().get(scene.id, ""), metres)


def row_of_scene(
    scene: Scene,
    placed: Mapping[str, ScenePose],
    num_nodes: int | None,
    note: str,
    metres: Mapping[int, Metre] | None = None,
) -> SceneRow:
    pose = placed.get(scene.id)
    metre = metres.get(pose.component) if metres and pose else None
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
        metres_per_unit=metre.metres_per_unit if metre and metre.is_known else None,
    )


@of_one_state
def pose_rows(store: Store) -> list[PoseRow]:
    """Where every placed living scene lies, oldest scene first."""
    poses = store.revisions.poses()
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
