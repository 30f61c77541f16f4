"""Report the scenes of a map and their poses."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from gsmap.map.date_filter import end_of_date, is_after, is_until, parse_moment
from gsmap.map.georeferenced_components import world_positions
from gsmap.map.reports.common import one_of
from gsmap.map.reports.one_pair import ONE_PAIR, scenes_by_one_pair
from gsmap.map.snapshot_read import snapshot_read
from gsmap.store import Store
from gsmap.types import Scene, ScenePose, Sim3
from gsmap.types.metric_scale import MetricScale
from gsmap.types.plain import fields_of
from gsmap.types.rows.scenes import IngestRow, PoseRow, SceneRow
from gsmap.types.scene import SceneFacts

SCENE_STATUSES = ("ingested", "described", "placed", ONE_PAIR, "tentative", "isolated")


@snapshot_read
def scene_rows(
    store: Store,
    *,
    component: int | None = None,
    status: str | None = None,
    after: str | None = None,
    tag: str | None = None,
    as_of: str | None = None,
    metres: Mapping[int, MetricScale] | None = None,
    among: Collection[str] | None = None,
) -> list[SceneRow]:
    """List the living scenes, oldest first.

    Args:
        among: restrict to these ids; the other scenes are not read.
        component: restrict to this component.
        status: restrict to this status, see `SceneRow`.
        after: ISO 8601; restrict to scenes captured (if undated: ingested) later.
        tag: restrict to scenes with this tag.
        as_of: ISO 8601; restrict to scenes dated at or before it.
        metres: metric scale of every component of the newest poses; left out if None.

    Raises:
        ConfigError: no such status, or a date that is none.
    """
    status = None if status is None else spelled(status)
    one_of(status, SCENE_STATUSES)
    since = None if after is None else parse_moment(after)
    until = None if as_of is None else end_of_date(as_of)
    if among is not None and not among:
        return []
    placed, nodes = store.revisions.poses(*(among or ())), store.graphs.node_counts()
    said = store.scenes.latest_notes()
    system, found = world_positions(store, placed)
    alone = scenes_by_one_pair(store) if any_tentative(placed) else set()
    rows = [
        row_of_scene(
            scene, placed, nodes.get(scene.id), said.get(scene.id, ""), metres, found, system, scene.id in alone
        )
        for scene in store.scenes.list(among=among)
    ]
    return [
        row
        for row in rows
        if (component is None or row.component == component)
        and (status is None or status in (row.status, row.standing))
        and (since is None or is_after(row.captured_at or row.ingested_at, since))
        and (tag is None or tag in row.tags)
        and (until is None or is_until(row.captured_at, until))
    ]


@snapshot_read
def scene_row(store: Store, scene: Scene, metres: Mapping[int, MetricScale]) -> SceneRow:
    """Return the row of a scene."""
    placed, nodes = store.revisions.poses(scene.id), store.graphs.node_counts()
    note, (system, found) = store.scenes.latest_notes().get(scene.id, ""), world_positions(store, placed)
    by_one_pair = any_tentative(placed) and scene.id in scenes_by_one_pair(store)
    return row_of_scene(scene, placed, nodes.get(scene.id), note, metres, found, system, by_one_pair)


def any_tentative(placed: Mapping[str, ScenePose]) -> bool:
    return any(pose.status == "tentative" for pose in placed.values())


def spelled(word: str) -> str:
    """Return a status as tables print it; hyphens and underscores stand for spaces where that is a status."""
    spaced = word.replace("-", " ").replace("_", " ")
    return spaced if spaced == ONE_PAIR else word


def row_of_scene(
    scene: Scene,
    placed: Mapping[str, ScenePose],
    num_nodes: int | None,
    note: str,
    metres: Mapping[int, MetricScale] | None = None,
    in_world: Mapping[str, tuple[np.ndarray, np.ndarray]] | None = None,
    system: tuple[str, str] | None = None,
    one_pair: bool = False,
) -> SceneRow:
    pose = placed.get(scene.id)
    metre = metres.get(pose.component) if metres and pose else None
    at = (in_world or {}).get(scene.id)
    return SceneRow(
        **fields_of(scene, SceneFacts),
        num_nodes=num_nodes,
        component=pose.component if pose else None,
        S_map_scene=pose.S_map_scene if pose else None,
        status=pose.status if pose else ("ingested" if num_nodes is None else "described"),
        one_pair=one_pair,
        tags=scene.tags,
        note=note,
        metres_per_unit=metre.metres_per_unit if metre and metre.is_known else None,
        metric=None if at is None else at[0],
        world=None if at is None else at[1],
        crs=None if at is None or system is None else system[0],
        heights=None if at is None or system is None else system[1],
        offset=scene.origin,
    )


@snapshot_read
def pose_rows(store: Store, crs: str | None = None) -> list[PoseRow]:
    """List the pose of every placed living scene, oldest scene first.

    Args:
        crs: of the world coordinates; None for the map's own.
    """
    poses, ties = store.revisions.poses(), store.revisions.world()
    tied = {tie.component: tie.S_world_map for tie in ties if tie.S_world_map is not None}
    system, found = world_positions(store, poses, crs)
    return [
        PoseRow(
            scene=scene.id,
            scene_name=scene.name,
            component=poses[scene.id].component,
            status=poses[scene.id].status,
            S_map_scene=poses[scene.id].S_map_scene,
            S_world_scene=_in_world(tied, poses[scene.id]),
            world=found[scene.id][1] if scene.id in found else None,
            crs=system[0] if system and scene.id in found else None,
            heights=system[1] if system and scene.id in found else None,
            covariance=poses[scene.id].covariance,
            offset=scene.origin,
        )
        for scene in store.scenes.list()
        if scene.id in poses
    ]


def _in_world(tied: Mapping[int, Sim3], pose: ScenePose) -> Sim3 | None:
    return tied[pose.component] @ pose.S_map_scene if pose.component in tied else None


def ingest_row(scene: Scene, *, new: bool, dated: bool, notes: Sequence[str]) -> IngestRow:
    """Return the result of ingesting one capture."""
    return IngestRow(
        scene=scene.id,
        scene_name=scene.name,
        new=new,
        num_gaussians=scene.num_gaussians,
        notes=tuple(notes),
        captured_at=scene.captured_at,
        dated=dated,
    )
