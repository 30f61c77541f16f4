"""Localize a scan: register it with scenes of the map, without storing anything."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from gsmap import describe, register
from gsmap.describe.unit import estimate_unit_m
from gsmap.errors import ConfigError, NotFoundError
from gsmap.formats import scans
from gsmap.geometry.camera_synthesis import synthesise_cameras
from gsmap.geometry.uncertainty import largest_sigma, point_jacobian
from gsmap.ingest import read_captures
from gsmap.localize.scan import AGREE_SIGMAS, as_gaussians
from gsmap.localize.scan_consensus import ConsensusPose, PoseTolerance, ScanPose, combine_poses
from gsmap.map import models
from gsmap.map.jobs import load_view
from gsmap.map.localization.localize import parse_near
from gsmap.map.metric_scales import metres_of_scenes
from gsmap.map.scene_lookup import look_up_graph
from gsmap.map.settings import Settings
from gsmap.map.stages.describe import graph_keys, without_graph
from gsmap.map.stages.register import placed_scenes
from gsmap.methods import RecipeKey
from gsmap.reason_codes import reason, reason_code
from gsmap.register import SceneView
from gsmap.register.by_shape import register_by_shape
from gsmap.register.pose_selection import SAME_DISTANCE_M, SAME_LOG_SCALE, SAME_ROTATION_DEG
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians, PoseGraph, Registration, Scene
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize_scan import ScanRow, ScanSupport
from gsmap.types.scan import Scan
from gsmap.types.scene import SCALE_POLICIES

_ID = "scan"
_OF_NO_UNIT = (".obj", ".stl")  # formats whose files are in whatever unit their program likes


@dataclass(frozen=True)
class Request:
    """The scan to localize.

    Args:
        file: a point cloud, mesh, splat or depth image.
        intrinsics_px: ``fx fy cx cy`` of a depth image.
        colour: colour image of the same view as a depth image.
        units_per_m: depth value of one metre.
        scale: ``known`` (the scan is in metres), ``unknown`` or ``auto``; None for the default of the file type.
        near: restrict to scenes near a scene (name) or a ball ``X,Y,Z,R`` in the frame of component 0.
    """

    file: Path
    intrinsics_px: Sequence[float] | None = None
    colour: str | os.PathLike[str] | None = None
    units_per_m: float = 1000.0
    scale: str | None = None
    near: str | None = None

    def __post_init__(self) -> None:
        if self.scale is not None and self.scale not in SCALE_POLICIES:
            raise ConfigError(
                f"scale must be one of {', '.join(SCALE_POLICIES)}, got {self.scale!r}", code="invalid_choice"
            )
        if self.colour is not None and self.intrinsics_px is None:
            raise ConfigError("--colour needs the intrinsics of a depth image: fx,fy,cx,cy", code="missing_option")


@dataclass(frozen=True, eq=False)
class _ScanQuery:
    """A scan as Gaussians and cameras in one frame."""

    gaussians: Gaussians
    cameras: Cameras
    kind: str
    policy: str
    coloured: bool
    origin: np.ndarray
    notes: tuple[str, ...]


def localize_scan(store: Store, request: Request, settings: Settings, progress: StageProgress) -> ScanRow:
    """Localize a scan in the map by registering it with scenes, without writing anything.

    It is described by the recipe of the map's graphs, the index tells the likeliest scenes, and it is registered with
    each of these as any pair is. All are asked, however many show it: one that shows it elsewhere says that the map
    holds places that look alike.

    Raises:
        NotFoundError: no such file, or no scene of the map is described and placed.
        InputError: see `gsmap.formats.scans` and `gsmap.ingest`.
    """
    began = time.process_time()

    def told(fraction: float, text: str) -> None:
        progress("localize", fraction, text)

    told(0.0, f"reading {request.file.name}")
    sought = _read(request, settings)
    poses = store.revisions.get()
    scenes = {scene.id: scene for scene in store.scenes.list()}
    known = _asked(store, scenes, poses, settings)
    if request.near is not None:
        wanted = _near(store, request.near)
        known = {scene: key for scene, key in known.items() if scene in wanted}
    told(0.1, "describing the scan")
    params = replace(settings.describe, objects=False, things=False)
    graph = describe.describe(
        _ID, sought.gaussians, sought.cameras, params, models.specs(store), scale_policy=sought.policy
    )
    source = SceneView(_ID, sought.gaussians, sought.cameras, graph, sought.policy)
    told(0.3, "asking the index")
    candidates = [one.scene for one in look_up_graph(store, known, graph, settings.retrieve)[: settings.retrieve.top_k]]
    notes: list[str] = []
    if not sought.coloured:
        # The index depends on colours, and shapes repeat: compare all scenes.
        rest = sorted(set(known) - set(candidates))
        candidates = [*candidates, *rest][: settings.scan.max_scenes_by_shape]
        if len(candidates) < len(known):
            notes.append(
                f"{len(candidates)} of {len(known)} scenes were compared: without colours retrieval cannot rank "
                "them; restrict the search with --near"
            )
    assert poses is not None
    found: list[Registration] = []
    supports: list[ScanPose] = []
    for number, scene in enumerate(candidates):
        told(0.3 + 0.7 * number / len(candidates), f"comparing with {scenes[scene].name}")
        target = load_view(store, scene, known[scene].digest)
        if sought.coloured:
            found.append(register.register_pair(target, source, settings.register))
        else:
            found.append(register_by_shape(target, source, settings.register))
        if found[-1].status == "accepted":
            supports.append(ScanPose.from_registration(poses.poses[scene], found[-1]))
    told(1.0, "done")
    joined = None
    if supports:
        names = {scene.id: scene.name for scene in scenes.values()}
        metres = metres_of_scenes(store, poses)[supports[0].scene]
        one = PoseTolerance(SAME_ROTATION_DEG, SAME_DISTANCE_M / metres, SAME_LOG_SCALE, AGREE_SIGMAS)
        joined = combine_poses(supports, source.centre, one, names)
    seconds = time.process_time() - began
    remarks = (*graph.notes, *notes) if sought.coloured else tuple(notes)
    return _row(request, sought, remarks, found, supports, joined, poses, scenes, source.centre, seconds)


def _read(request: Request, settings: Settings) -> _ScanQuery:
    """Read the scan from any supported file."""
    if request.intrinsics_px is not None:
        scan = scans.read_depth(
            request.file,
            request.intrinsics_px,
            colour=request.colour,
            units_per_m=request.units_per_m,
        )
        return _of_scan(scan, request.scale or "known", settings)
    if scans.holds_splat(request.file):
        captures = read_captures(request.file, scale_policy=request.scale or "auto")
        if len(captures) != 1:
            raise ConfigError(
                f"{request.file} contains {len(captures)} captures: name one of them", code="many_captures"
            )
        capture = captures[0]
        notes = capture.notes
        gaussians, cameras = capture.gaussians, capture.cameras
        return _ScanQuery(gaussians, cameras, "splat", capture.scale_policy, True, gaussians.origin, notes)
    policy = "auto" if request.file.suffix.lower() in _OF_NO_UNIT else "known"
    return _of_scan(scans.read(request.file, settings.scan.reading), request.scale or policy, settings)


def _of_scan(scan: Scan, policy: str, settings: Settings) -> _ScanQuery:
    few = scan.points[:: max(1, len(scan) // 20_000)]
    unit_m = 1.0 if policy == "known" else estimate_unit_m(few, None, None, settings.describe.view_distance_m)
    gaussians = as_gaussians(scan, settings.scan.cell_m / unit_m)
    cameras = synthesise_cameras(gaussians) if scan.camera is None else scan.camera
    notes = list(scan.notes)
    if scan.colours is None:
        notes.append("the scan has no colours: localization by shape alone is less certain")
    return _ScanQuery(gaussians, cameras, scan.kind, policy, scan.colours is not None, scan.origin, tuple(notes))


def _asked(store: Store, scenes: dict[str, Scene], poses: PoseGraph | None, settings: Settings) -> dict[str, RecipeKey]:
    """Return the graph key of every placed scene described by the current recipe."""
    placed = [scene for scene in scenes.values() if poses is not None and scene.id in poses.poses]
    keys = graph_keys(store, placed, settings)
    lacking = set(without_graph(store, keys))
    known = {scene: key for scene, key in keys.items() if scene not in lacking}
    if not known:
        raise NotFoundError(
            f"no scene of {store.home} is described and has a place: run gsmap update {store.home} first",
            code="no_placed_scene",
        )
    return known


def _near(store: Store, near: str) -> set[str]:
    """Return the ids of scenes near a scene, or near a ball ``X,Y,Z,R`` in the frame of component 0.

    Raises:
        NotFoundError: no such scene, or none is there.
        ConfigError: four numbers that make no ball.
    """
    placed, said = placed_scenes(store), parse_near(store, near)
    if said.point is not None:
        at, radius, component = np.array(said.point), said.radius, 0
    else:
        assert said.scene is not None
        if said.scene not in placed:
            raise NotFoundError(
                f"scene {near} has no place in the map yet: run gsmap update first", code="scene_unplaced"
            )
        one = placed[said.scene]
        at, radius, component = one.centre, one.radius, one.component
    found = {
        scene
        for scene, one in placed.items()
        if one.component == component and np.linalg.norm(one.centre - at) < radius + one.radius
    }
    if not found:
        raise NotFoundError(f"no scene of the map lies near {near}", code="nothing_near")
    return found


def _row(
    request: Request,
    sought: _ScanQuery,
    remarks: Sequence[str],
    found: Sequence[Registration],
    supports: Sequence[ScanPose],
    joined: ConsensusPose | None,
    poses: PoseGraph,
    scenes: dict[str, Scene],
    middle: np.ndarray,
    seconds: float,
) -> ScanRow:
    notes = [*sought.notes, *remarks]
    if any(support.tentative for support in supports):
        notes.append("a supporting scene is tentative: no cycle of edges confirms its pose")
    S = None if joined is None else joined.S_map_scan
    probabilities = [one.evidence.get("probability", np.nan) for one in found]
    best = float(np.nanmax(probabilities)) if np.isfinite(probabilities).any() else 0.0
    camera = None
    if S is not None and sought.kind == "depth":
        camera = np.eye(4)
        camera[:3, :3], camera[:3, 3] = S.rotation, S.translation
    sigma_deg, sigma = (None, None) if S is None or joined is None else _sigmas(joined.covariance, middle)
    why = "" if S is not None else _why_not(found, joined, scenes)
    return ScanRow(
        file=str(request.file),
        kind=sought.kind,
        status="refused" if S is None else "placed",
        reason=why,
        reason_code=reason_code(why),
        S_map_scan=S,
        T_map_camera=camera,
        origin=sought.origin,
        covariance=None if joined is None else joined.covariance,
        sigma_deg=sigma_deg,
        sigma_m=sigma,
        component=None if S is None else supports[0].component,
        scenes=() if S is None else tuple(scenes[s.scene].name for s in supports),
        probability=best if joined is None else joined.probability,
        coloured=sought.coloured,
        num_points=len(sought.gaussians),
        supports=tuple(
            ScanSupport(
                scene=one.target,
                scene_name=scenes[one.target].name,
                status=one.status,
                reason=one.reason,
                reason_code=one.reason_code,
                probability=one.evidence.get("probability", float("nan")),
                overlap=one.overlap,
                component=poses.poses[one.target].component,
                S_map_scan=None
                if one.S_target_source is None
                else poses.poses[one.target].S_map_scene @ one.S_target_source,
            )
            for one in found
        ),
        seconds=seconds,
        notes=tuple(notes),
    )


def _why_not(found: Sequence[Registration], joined: ConsensusPose | None, scenes: dict[str, Scene]) -> str:
    if joined is not None:
        return joined.reason
    if not found:
        return reason("no_match", "no scene of the map has anything in common with it")
    best = max(found, key=lambda one: (one.evidence.get("probability", 0.0) or 0.0, one.overlap))
    nearest = f"nearest {scenes[best.target].name}: {best.reason}"
    return reason("no_scene_matches", f"{len(found)} scenes were compared and none shows it; {nearest}")


def _sigmas(covariance: np.ndarray | None, middle: np.ndarray) -> tuple[float | None, float | None]:
    """Return the largest rotation sigma in degrees, and the largest position sigma at the scan's centre."""
    if covariance is None:
        return None, None
    moved = point_jacobian(middle)
    return float(np.degrees(largest_sigma(covariance[:3, :3]))), largest_sigma(moved @ covariance @ moved.T)
