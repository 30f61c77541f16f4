"""Comparing a map with ground truth, in the field's metrics."""

from __future__ import annotations

import json
import os
from itertools import combinations
from pathlib import Path

import numpy as np

from gsmap.errors import InputError, NotFoundError
from gsmap.evaluate.images import Lpips
from gsmap.evaluate.registration import PoseError, absolute_trajectory_error, pose_error, scene_centroid, summarise
from gsmap.evaluate.renders import compare_renders, find_images
from gsmap.geometry.transforms import transform_cameras, transform_gaussians
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians, PoseGraph, Scene, Sim3
from gsmap.types.progress import Progress
from gsmap.types.rows import EvaluationReport, ImageErrorRow, PoseErrorRow


def poses(store: Store, truth: str | os.PathLike[str]) -> EvaluationReport:
    """Errors of every accepted edge and of the optimised poses, pair by pair and over the whole map.

    Args:
        truth: folder of ``NAME.json``, each with ``T_scene_world`` (4x4, a similarity): where the scene's frame lies.

    Raises:
        NotFoundError, InputError: no truth for any scene, or a file that holds none.
    """
    scenes = {s.id: s for s in store.scenes.list()}
    S_scene_world = {s.id: found for s in scenes.values() if (found := _read_truth(Path(truth), s.name)) is not None}
    if not S_scene_world:
        raise NotFoundError(f"no truth for any scene in {truth}: it needs NAME.json with T_scene_world for each scene")
    centroids = {scene: scene_centroid(store.scenes.gaussians(scene)) for scene in S_scene_world}

    def error(target: str, source: str, estimated: Sim3) -> PoseError:
        true = S_scene_world[target] @ S_scene_world[source].inverse()
        return pose_error(estimated, true, centroids[source])

    edges = []
    for stored in store.registrations.current():
        edge = stored.registration
        if edge.status == "accepted" and {edge.target, edge.source} <= set(S_scene_world):
            assert edge.S_target_source is not None
            edges.append((edge.target, edge.source, error(edge.target, edge.source, edge.S_target_source)))
    placed = store.revisions.get()
    pairs = []
    if placed is not None:
        for a, b in combinations([s for s in scenes if s in S_scene_world and s in placed.poses], 2):
            pose_a, pose_b = placed.poses[a], placed.poses[b]
            if pose_a.component == pose_b.component:
                estimated = pose_a.S_map_scene.inverse() @ pose_b.S_map_scene
                pairs.append((a, b, error(a, b, estimated)))
    of_edges, of_pairs = (summarise([e for *_, e in found]) if found else None for found in (edges, pairs))
    return EvaluationReport(
        edges=_rows(edges, scenes),
        pairs=_rows(pairs, scenes),
        ate_m=None if placed is None else _ate(store, placed, S_scene_world),
        edges_median_rre_deg=of_edges.median_rre_deg if of_edges else None,
        edges_median_centroid_m=of_edges.median_centroid_m if of_edges else None,
        edges_worst_rre_deg=of_edges.worst_rre_deg if of_edges else None,
        edges_worst_centroid_m=of_edges.worst_centroid_m if of_edges else None,
        pairs_median_rre_deg=of_pairs.median_rre_deg if of_pairs else None,
        pairs_median_centroid_m=of_pairs.median_centroid_m if of_pairs else None,
        pairs_worst_rre_deg=of_pairs.worst_rre_deg if of_pairs else None,
        pairs_worst_centroid_m=of_pairs.worst_centroid_m if of_pairs else None,
    )


def _rows(found: list[tuple[str, str, PoseError]], scenes: dict[str, Scene]) -> tuple[PoseErrorRow, ...]:
    return tuple(
        PoseErrorRow(
            target=a,
            target_name=scenes[a].name,
            source=b,
            source_name=scenes[b].name,
            rre_deg=e.rre_deg,
            centroid_m=e.centroid_m,
            rte=e.rte,
            rse=e.rse,
        )
        for a, b, e in found
    )


def _ate(store: Store, placed: PoseGraph, S_scene_world: dict[str, Sim3]) -> float | None:
    """Root mean square error of the camera centres, aligned once per component; None with fewer than 3 cameras."""
    estimated, true, components = [], [], []
    for scene, S in S_scene_world.items():
        if scene in placed.poses:
            centers = store.scenes.cameras(scene).centers
            estimated.append(placed.poses[scene].S_map_scene.apply(centers))
            true.append(S.inverse().apply(centers))
            components.append(np.full(len(centers), placed.poses[scene].component))
    component = np.concatenate(components)
    segments = [np.flatnonzero(component == i) for i in np.unique(component)]
    if min(len(s) for s in segments) < 3:
        return None
    return absolute_trajectory_error(np.concatenate(estimated), np.concatenate(true), segments=segments)


def _read_truth(folder: Path, name: str) -> Sim3 | None:
    if not folder.is_dir():
        raise NotFoundError(f"no folder of truth at {folder}")
    path = folder / f"{name}.json"
    if not path.exists():
        return None
    try:
        return Sim3.from_matrix(np.array(json.loads(path.read_text())["T_scene_world"], dtype=float))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path} holds no T_scene_world, a 4x4 similarity: {error}") from error


def images(
    store: Store, folder: str | os.PathLike[str], progress: Progress, *, lpips: str | os.PathLike[str] | None = None
) -> tuple[ImageErrorRow, ...]:
    """How well each scene alone, and the union of its component, reproduce the scene's own photographs.

    The difference between the two is what merging by concatenation costs; `tools/bench_merge.py` has the whole table.

    Args:
        folder: of photographs named like the cameras (suffixes may differ), in a folder per scene where the scenes'
            cameras share names.
        lpips: an LPIPS network (`gsmap.evaluate.images.Lpips`) to compare with, too.

    Raises:
        NotFoundError: no photograph is named like a camera.
    """
    network = None if lpips is None else Lpips(Path(lpips))
    placed = store.revisions.get()
    poses = placed.poses if placed else {}
    scenes = store.scenes.list()
    rows = []
    for i, scene in enumerate(scenes):
        progress(i / len(scenes), scene.name)
        cameras = store.scenes.cameras(scene.id)
        pictures = _pictures(scene, cameras, folder)
        if not pictures:
            continue
        alone = compare_renders(store.scenes.gaussians(scene.id), cameras, pictures, lpips=network).means()
        merged: dict[str, float] = {}
        if scene.id in poses:
            here = poses[scene.id]
            members = [p for p in poses.values() if p.component == here.component]
            union = Gaussians.concatenate(
                [transform_gaussians(store.scenes.gaussians(p.scene), p.S_map_scene) for p in members]
            )
            moved = transform_cameras(cameras, here.S_map_scene)
            merged = compare_renders(union, moved, pictures, lpips=network).means()
        rows.append(
            ImageErrorRow(
                scene=scene.id,
                scene_name=scene.name,
                num_images=len(pictures),
                alone_psnr_db=alone["psnr_db"],
                alone_ssim=alone["ssim"],
                alone_lpips=alone.get("lpips"),
                union_psnr_db=merged.get("psnr_db"),
                union_ssim=merged.get("ssim"),
                union_lpips=merged.get("lpips"),
            )
        )
    if not rows:
        raise NotFoundError(f"no image in {folder} is named like a camera of a scene")
    progress(1.0, "")
    return tuple(rows)


def _pictures(scene: Scene, cameras: Cameras, folder: str | os.PathLike[str]) -> dict[int, Path]:
    """Photographs by camera index, from the scene's own folder where there is one; none where none is named so."""
    own = Path(folder) / scene.name
    try:
        return find_images(cameras, own if own.is_dir() else folder)
    except NotFoundError:
        if not Path(folder).is_dir():
            raise
        return {}
