"""Read scenes for the floor plans of their components, and draw the pictures under the plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap.geometry.boxes import box_corners
from gsmap.geometry.uncertainty import middle_covariance_m2
from gsmap.report import Plan, PlanEdge, PlanScene, density_picture, make_plan, top_picture
from gsmap.store import Store
from gsmap.types import Gaussians, ScenePose
from gsmap.types.scene import SceneFacts

MAX_GAUSSIANS = 2_000_000  # read for the pictures under floor plans; larger components are drawn by landmarks
MAX_SCENES = 400  # with arrays read for plans; boxes of the others are drawn
_TRACK_CAMERAS = 120  # drawn of one scene, evenly along its capture
_SAMPLE = 4000  # points of a scene that its outline is drawn around
_SOLID = 0.3  # opacity from which a Gaussian is something


@dataclass
class SceneArrays:
    """Points, cameras and centre of one scene in its frame, for plans and uncertainties."""

    points: np.ndarray
    track: np.ndarray
    eyes: np.ndarray
    middle: np.ndarray
    kind: str = "boxes"
    gaussians: Gaussians | None = None


def read_scene(store: Store, scene: SceneFacts, *, whole: bool, most: int = _SAMPLE) -> SceneArrays:
    """Read a scene: its Gaussians, or the landmarks of its graph.

    Args:
        most: number of points to sample; fewer leave out surfaces that have few of the Gaussians.

    Raises:
        CorruptError, NotFoundError: its arrays cannot be read.
    """
    cameras = store.scenes.cameras(scene.id)
    eyes = np.zeros((0, 3)) if cameras.synthesised else cameras.centers
    track = eyes if not len(eyes) else cameras.evenly(_TRACK_CAMERAS).centers
    gaussians, kind = None, "boxes"
    points = box_corners(scene.bounds)
    if whole:
        gaussians, kind = store.scenes.unread(scene.id).degree_0(), "rendered"
        solid = np.flatnonzero((gaussians.opacities > _SOLID) & np.isfinite(gaussians.means).all(1))
        if len(solid):
            points = gaussians.means[solid[:: -(-len(solid) // most)]].astype(np.float64)
    elif (graph := store.graphs.load(scene.id)) is not None:
        layer = graph.layers.get("landmarks") or graph.layers.get("landmarks:1") or graph.layers.get("objects")
        if layer is not None and len(layer):
            points, kind = layer.positions[:: -(-len(layer) // most)], "landmarks"
    middle = np.median(eyes if len(eyes) else points, axis=0)
    return SceneArrays(points, track, eyes, middle, kind, gaussians)


def box_of(scene: SceneFacts) -> SceneArrays:
    """Return the corners of a scene's bounding box, without reading arrays."""
    none = np.zeros((0, 3))
    return SceneArrays(box_corners(scene.bounds), none, none, scene.bounds.mean(0))


def plan_of_component(
    names: Sequence[str],
    poses: Sequence[ScenePose],
    arrays: Sequence[SceneArrays],
    edges: Sequence[PlanEdge],
    up: np.ndarray | None,
    metres_per_unit: float,
    longest_px: int,
) -> tuple[Plan | None, str]:
    """Return the floor plan of the scenes of a component with the picture under it, and a note on the picture."""
    shown = [
        PlanScene(
            name,
            pose.status,
            pose.S_map_scene.apply(read.points),
            pose.S_map_scene.apply(read.track),
            pose.S_map_scene.apply(read.middle[None])[0],
            middle_covariance_m2(pose, read.middle, metres_per_unit),
        )
        for name, pose, read in zip(names, poses, arrays, strict=True)
    ]
    plan = make_plan(shown, edges, up, metres_per_unit)
    if plan is None:
        return None, "the content of its scenes cannot be located"
    return _with_picture(plan, poses, arrays, longest_px)


def _with_picture(
    plan: Plan, poses: Sequence[ScenePose], arrays: Sequence[SceneArrays], longest_px: int
) -> tuple[Plan, str]:
    parts = [
        (read.gaussians, pose.S_map_scene)
        for read, pose in zip(arrays, poses, strict=True)
        if read.gaussians is not None
    ]
    if parts:
        eyes = np.concatenate([pose.S_map_scene.apply(r.eyes) for r, pose in zip(arrays, poses, strict=True)])
        picture, kind = top_picture(parts, plan, eyes, longest_px), "rendered"
        note = "The picture shows the Gaussians from straight above, without ceilings."
    else:
        marks = [
            pose.S_map_scene.apply(read.points)
            for read, pose in zip(arrays, poses, strict=True)
            if read.kind == "landmarks"
        ]
        if not marks:
            return plan, "Outlines are boxes around the Gaussians of the scenes."
        picture, kind = density_picture(np.concatenate(marks), plan, longest_px), "landmarks"
        note = "The picture shows the landmarks of the scene graphs."
    return (replace(plan, picture=picture, picture_kind=kind), note) if picture else (plan, "")
