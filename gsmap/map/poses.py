"""Export poses: TUM and g2o for scenes, COLMAP and nerfstudio for cameras, JSON for both."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import groupby
from pathlib import Path

import numpy as np

from gsmap.durable import is_stream, write_text_output
from gsmap.errors import ConfigError, InputError, NotFoundError
from gsmap.formats import colmap, g2o, nerfstudio, tum
from gsmap.geometry.transforms import transform_cameras
from gsmap.map import reports
from gsmap.map.date_filter import NO_DATE, parse_moment
from gsmap.map.metric_scales import map_metres
from gsmap.map.snapshot_read import snapshot_read
from gsmap.store import Store
from gsmap.texts import few
from gsmap.types import Cameras, Edge, Scene, ScenePose, Sim3
from gsmap.types.metric_scale import MetricScale
from gsmap.types.rows.base import SCHEMA

FORMATS = ("tum", "g2o", "colmap", "nerfstudio", "json")

_log = logging.getLogger("gsmap.map")


@snapshot_read
def write_poses(store: Store, out: Path, format: str, crs: str | None = None) -> list[Path]:
    """Write the newest poses of all placed scenes; return the written files or folders.

    - ``tum``: a line per scene after a comment with its name, ``T_map_scene`` (a scale is left out: the format has
      none), at the time of capture in Unix seconds where all scenes have a date, else at 0, 1, 2, ... in the order of
      names; scenes of one date are spread over the time to the next, at most a second apart.
    - ``g2o``: a vertex per scene and an edge per edge in use, with its information; rigid components only.
    - ``colmap``, ``nerfstudio``: every photo of every scene in the map frame and unit, with its lens, named
      ``scene/photo``. Scenes without photos, whose cameras were synthesized, are left out, which is logged.
    - ``json``: what ``gsmap poses MAP --json`` prints.

    ``tum`` and ``g2o`` are in metres where the metre of the component is known to better than a factor, else in the
    map's unit. Times and units that are not what a reader takes them for are logged, and noted in the file.

    Components share no frame: where there are several, each gets a file of its own, ``NAME_component_K``.

    Raises:
        ConfigError: another format.
        NotFoundError: no scene has a pose yet, or photos are to be written and no scene has any.
        InputError: a pose that the format cannot say, or several components for one pipe.
    """
    if format not in FORMATS:
        raise ConfigError(
            f"the format of poses must be one of {', '.join(FORMATS)}, got {format!r}", code="invalid_choice"
        )
    graph = store.revisions.get()
    scenes = {scene.id: scene for scene in store.scenes.list()}
    placed = [pose for scene, pose in (graph.poses if graph else {}).items() if scene in scenes]
    if graph is None or not placed:
        raise NotFoundError("no scene has a place in the map yet: run gsmap update first", code="no_poses")
    if crs is not None and format != "json":
        raise ConfigError(
            f"{format} holds poses in the map's frame; world coordinates go into json: leave out --format",
            code="unsupported_output",
        )
    if format == "json":
        rows = [row.to_json() for row in reports.pose_rows(store, crs)]
        text = json.dumps({"schema": SCHEMA, "poses": rows}, indent=1)
        write_text_output(out, text, store.id)
        return [out]
    if format in ("colmap", "nerfstudio"):
        bare = [scenes[pose.scene].name for pose in placed if scenes[pose.scene].cameras_synthesised]
        placed = [pose for pose in placed if not scenes[pose.scene].cameras_synthesised]
        if not placed:
            raise NotFoundError("no scene of the map has photos with cameras to write", code="no_cameras")
        if bare:
            _log.warning("%s: left out %s, captured without cameras of photos", out, few(sorted(bare)))
    components = sorted({pose.component for pose in placed})
    if len(components) > 1 and is_stream(out):
        raise InputError(
            f"{out} takes one file, and each of {len(components)} components gets its own: name a file",
            code="missing_option",
        )
    metres = map_metres(store, graph)
    placed.sort(key=lambda pose: scenes[pose.scene].name)
    written = []
    for component in components:
        members = [pose for pose in placed if pose.component == component]
        metre = metres.get(component, MetricScale())
        path = out if len(components) == 1 else out.with_name(f"{out.stem}_component_{component}{out.suffix}")
        if format == "tum":
            _write_tum(path, members, scenes, metre)
        elif format == "g2o":
            used = {pair for pair, outcome in graph.outcomes.items() if outcome.use != "unused"}
            _write_g2o(path, members, _edges(store, members, used), scenes, metre)
        elif format == "colmap":
            colmap.write(path, _cameras(store, members, scenes))
        else:
            nerfstudio.write(path, _cameras(store, members, scenes))
        if format in ("colmap", "nerfstudio") and (metre.is_rough or metre.metres_per_unit != 1.0):
            _log.warning("%s: cameras are in the unit of the map, as exports are: %s", path, metre.text())
        written.append(path)
    return written


def _write_tum(path: Path, members: Sequence[ScenePose], scenes: Mapping[str, Scene], metre: MetricScale) -> None:
    undated = [scenes[pose.scene].name for pose in members if scenes[pose.scene].captured_at is None]
    times, remarks = None, []
    if undated:
        have = "has no date" if len(undated) == 1 else "have no date"
        remarks.append(f"times are placeholders, 0, 1, 2, ... in the order of names: {few(undated)} {have} ({NO_DATE})")
    else:
        dates = [parse_moment(scenes[pose.scene].captured_at or "").timestamp() for pose in members]
        order = np.argsort(dates, kind="stable")
        members, dates = [members[i] for i in order], [dates[i] for i in order]
        times = _distinct(dates)
        moved = [scenes[pose.scene].name for pose, a, b in zip(members, dates, times, strict=True) if a != b]
        if moved:
            remarks.append(f"made-up parts of a time: {few(moved)} of the same date as another scene, written after it")
    for remark in remarks:
        _log.warning("%s: %s", path, remark)
    factor, unit = _unit(path, metre)
    tum.write_trajectory(
        path,
        [_moved(pose.S_map_scene, factor) for pose in members],
        times,
        [scenes[pose.scene].name for pose in members],
        [unit, *remarks],
    )


def _distinct(times_s: Sequence[float]) -> list[float]:
    """Return sorted times in which equal times are spread towards the next time, at most a second apart."""
    groups = [(time_s, len(list(same))) for time_s, same in groupby(times_s)]
    out: list[float] = []
    for i, (time_s, count) in enumerate(groups):
        step = min(1.0, (groups[i + 1][0] - time_s) / count) if i + 1 < len(groups) else 1.0
        out += [time_s + k * step for k in range(count)]
    return out


def _write_g2o(
    path: Path, members: Sequence[ScenePose], edges: Sequence[Edge], scenes: Mapping[str, Scene], metre: MetricScale
) -> None:
    factor, unit = _unit(path, metre)
    in_factor = np.array([1.0] * 3 + [1 / factor] * 3 + [1.0])  # of the tangent, [rot_rad, trans, log_scale]
    moved = [
        replace(
            edge,
            S_target_source=_moved(edge.S_target_source, factor),
            information=edge.information * np.outer(in_factor, in_factor),
        )
        for edge in edges
    ]
    poses = {pose.scene: _moved(pose.S_map_scene, factor) for pose in members}
    g2o.write_graph(path, poses, moved, names={scene: scenes[scene].name for scene in poses}, remarks=[unit])


def _unit(path: Path, metre: MetricScale) -> tuple[float, str]:
    """Return the factor from component units to output units, and a note on the unit."""
    if not metre.is_rough:
        return metre.metres_per_unit, f"lengths in metres ({metre.text()} of the map)"
    remark = f"lengths in the unit of the map: {metre.text()}"
    _log.warning("%s: %s (set it with gsmap edit MAP SCENE --metres-per-unit X)", path, remark)
    return 1.0, remark


def _moved(S: Sim3, factor: float) -> Sim3:
    """Multiply the lengths of both frames of a pose by a factor."""
    return Sim3(S.rotation, S.translation * factor, S.scale)


def _edges(store: Store, members: Sequence[ScenePose], used: set[tuple[str, str]]) -> list[Edge]:
    inside = {pose.scene for pose in members}
    edges = []
    for stored in store.registrations.current():
        r = stored.registration
        if {r.target, r.source} <= inside and (r.target, r.source) in used:
            if r.S_target_source is None or r.information is None:
                raise InputError(
                    f"edge {r.target}:{r.source} is in use but has no pose: run gsmap optimize", code="no_pose_of_pair"
                )
            edges.append(Edge(r.target, r.source, r.S_target_source, r.information))
    return edges


def _cameras(store: Store, members: Sequence[ScenePose], scenes: Mapping[str, Scene]) -> Cameras:
    """Return the cameras of all scenes in the map frame, with names unique across scenes."""
    parts = []
    for pose in members:
        cameras, name = store.scenes.cameras(pose.scene), scenes[pose.scene].name
        parts.append(
            replace(
                transform_cameras(cameras, pose.S_map_scene),
                names=tuple(f"{name}/{camera}" for camera in cameras.names),
                lenses=tuple(lens and replace(lens, photo=f"{name}/{lens.photo}") for lens in cameras.lenses),
            )
        )
    return Cameras.concatenate(parts)
