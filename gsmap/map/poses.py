"""Poses for other programs: TUM and g2o for the scenes, COLMAP and nerfstudio for the cameras, JSON for both ids."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

import numpy as np

from gsmap.durable import is_stream, write_text_output
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats import colmap, g2o, nerfstudio, tum
from gsmap.geometry.transforms import transform_cameras
from gsmap.map import reports
from gsmap.map.one_state import of_one_state
from gsmap.store import Store
from gsmap.types import Cameras, Edge, Scene, ScenePose
from gsmap.types.rows import SCHEMA

FORMATS = ("tum", "g2o", "colmap", "nerfstudio", "json")


@of_one_state
def write_poses(store: Store, out: Path, format: str, crs: str | None = None) -> list[Path]:
    """Write the newest poses of all placed scenes; returns the files or folders written.

    - ``tum``: a line per scene, ``T_map_scene`` (a scale is left out: the format has none), at the time of capture in
      Unix seconds where all scenes have a date, else at 0, 1, 2, ...
    - ``g2o``: a vertex per scene and an edge per edge in use, with its information; rigid components only.
    - ``colmap``, ``nerfstudio``: every camera of every scene in the map frame, named ``scene/camera``.
    - ``json``: what ``gsmap poses MAP --json`` prints.

    Components share no frame: where there are several, each gets a file of its own, ``NAME_component_K``.

    Raises:
        ConfigError: another format.
        NotFoundError: no scene has a pose yet.
        InputError: a pose that the format cannot say, or several components for one pipe.
    """
    if format not in FORMATS:
        raise ConfigError(f"poses are written as {', '.join(FORMATS)}, got {format!r}")
    graph = store.revisions.get()
    scenes = {scene.id: scene for scene in store.scenes.list()}
    placed = [pose for scene, pose in (graph.poses if graph else {}).items() if scene in scenes]
    if graph is None or not placed:
        raise NotFoundError("no scene has a place in the map yet: run gsmap update first")
    if crs is not None and format != "json":
        raise ConfigError(
            f"{format} holds poses in the map's frame; world coordinates go into json: leave out --format"
        )
    if format == "json":
        rows = [row.to_json() for row in reports.pose_rows(store, crs)]
        text = json.dumps({"schema": SCHEMA, "poses": rows}, indent=1)
        write_text_output(out, text)
        return [out]
    components = sorted({pose.component for pose in placed})
    if len(components) > 1 and is_stream(out):
        raise InputError(f"{out} takes one file, and each of {len(components)} components gets its own: name a file")
    written = []
    for component in components:
        members = [pose for pose in placed if pose.component == component]
        path = out if len(components) == 1 else out.with_name(f"{out.stem}_component_{component}{out.suffix}")
        if format == "tum":
            _write_tum(path, members, scenes)
        elif format == "g2o":
            used = {pair for pair, outcome in graph.outcomes.items() if outcome.use != "unused"}
            g2o.write_graph(path, {pose.scene: pose.S_map_scene for pose in members}, _edges(store, members, used))
        elif format == "colmap":
            colmap.write(path, _cameras(store, members, scenes))
        else:
            nerfstudio.write(path, _cameras(store, members, scenes))
        written.append(path)
    return written


def _write_tum(path: Path, members: Sequence[ScenePose], scenes: dict[str, Scene]) -> None:
    dates = [scenes[pose.scene].captured_at for pose in members]
    times = None
    if all(date is not None for date in dates):
        times = [datetime.fromisoformat(date).timestamp() for date in dates if date is not None]
        order = np.argsort(times, kind="stable")
        members, times = [members[i] for i in order], [times[i] for i in order]
    tum.write_trajectory(path, [pose.S_map_scene for pose in members], times)


def _edges(store: Store, members: Sequence[ScenePose], used: set[tuple[str, str]]) -> list[Edge]:
    inside = {pose.scene for pose in members}
    edges = []
    for stored in store.registrations.current():
        r = stored.registration
        if {r.target, r.source} <= inside and (r.target, r.source) in used:
            if r.S_target_source is None or r.information is None:
                raise InputError(f"edge {r.target}:{r.source} is in use but has no pose: run gsmap optimize")
            edges.append(Edge(r.target, r.source, r.S_target_source, r.information))
    return edges


def _cameras(store: Store, members: Sequence[ScenePose], scenes: dict[str, Scene]) -> Cameras:
    """The cameras of all members, map frame, under names that tell the scenes apart."""
    moved = [(pose, transform_cameras(store.scenes.cameras(pose.scene), pose.S_map_scene)) for pose in members]
    return Cameras(
        np.concatenate([cameras.T_frame_camera for _, cameras in moved]),
        np.concatenate([cameras.intrinsics_px for _, cameras in moved]),
        np.concatenate([cameras.sizes_px for _, cameras in moved]),
        tuple(f"{scenes[pose.scene].name}/{name}" for pose, cameras in moved for name in cameras.names),
    )
