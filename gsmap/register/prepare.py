"""Prepare a scene for registration: surface cells with normals and sides, and renders of its views.

All of it depends on one scene alone and takes most of the time of a first registration, so the map stores it
(`gsmap.types.PreparedScene`) and pairs read a few megabytes instead of the scene.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gsmap._native import PointTree
from gsmap.register import visible_side
from gsmap.register.surface import PLANE_NEIGHBOURS, Surface, surface_rows
from gsmap.register.view_cache import PreparedViews, ViewCache
from gsmap.types import Cameras, Gaussians, SceneGraph
from gsmap.types.prepared_scene import PreparedScene

MAX_OWN_VIEWS = 64  # of a scene's own cameras, evenly along the capture
_NO_CAMERAS = Cameras(np.zeros((0, 4, 4)), np.zeros((0, 4)), np.zeros((0, 2), np.int64))


def working_m_of(graph: SceneGraph, scale_policy: str) -> float:
    """Return the working metres per scene unit in which a scene is prepared."""
    return graph.working_m if scale_policy == "known" or "landmarks" in graph.layers else graph.unit_m


def prepare(scene: str, gaussians: Gaussians, cameras: Cameras | None, unit_m: float) -> PreparedScene:
    """Compute the surface cells of a scene in its own working metres, and render its views.

    Args:
        scene: id of the scene.
        gaussians, cameras: in the scene's frame and unit; without cameras there are no views.
        unit_m: from `working_m_of`.
    """
    is_surface = np.zeros(len(gaussians), bool)
    is_surface[surface_rows(gaussians, unit_m)] = True
    points, colours = Surface.from_splats(gaussians.degree_0(is_surface), unit_m).coarse
    views = ViewCache(gaussians, cameras.evenly(MAX_OWN_VIEWS)) if cameras and len(gaussians) else None
    images = [] if views is None else [views.image(row) for row in range(len(views.cameras))]
    found = PreparedScene(
        scene,
        unit_m,
        np.median(gaussians.means, axis=0).astype(np.float64) if len(gaussians) else np.zeros(3),
        is_surface,
        points.astype(np.float32),
        colours.astype(np.float16),
        np.zeros((len(points), 3), np.float32),
        np.zeros(len(points), np.int8),
        np.zeros((0, 3), np.float32) if views is None else views.sample,
        _NO_CAMERAS if views is None else views.cameras,
        0 if views is None else views.num_own,
        np.concatenate([np.zeros((0, 3), np.uint8), *(_quantized(image.colour) for image in images)]),
        np.concatenate([np.zeros(0, np.float16), *(_halves(image.depth * unit_m) for image in images)]),
    )
    if not len(points):
        return found
    tree = PointTree(found.points.astype(np.float64))
    found = replace(found, normals=tree.normals(PLANE_NEIGHBOURS).astype(np.float32))
    if not found.num_own:
        return found
    cells, normals = found.points.astype(np.float64), found.normals.astype(np.float64)
    sides = visible_side.find_sides(cells, normals, tree, PreparedViews(found), unit_m)
    return replace(found, sides=sides.astype(np.int8))


def _quantized(colour: np.ndarray) -> np.ndarray:
    """Return the (P, 3) uint8 colours of a view."""
    return (np.clip(colour, 0, 1) * 255 + 0.5).astype(np.uint8).reshape(-1, 3)


def _halves(depth_m: np.ndarray) -> np.ndarray:
    """Return the (P,) depths of a view as half floats; what is too far for these is inf, like what is no surface."""
    with np.errstate(over="ignore"):
        return depth_m.astype(np.float16).reshape(-1)
