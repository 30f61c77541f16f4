"""Render a capture from its own cameras, and measure how well they observed each surface and Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap._native import count_observations, place_points
from gsmap.compare.neighbourhoods import depth_extremes, erode
from gsmap.geometry.voxels import voxel_labels
from gsmap.render import ChunkIndex, render
from gsmap.types import Cameras, Gaussians, PosedScene

LONGEST_SIDE_PX, MAX_VIEWS = 240, 48  # default size and number of the views of a capture
MIN_ALPHA = 0.9  # smallest alpha of a pixel that shows a surface
MIN_WEIGHT = 0.1  # a surface Gaussian has at least this blending weight in some own view
NEAREST_M = 0.2  # a view does not judge nearer Gaussians
MIN_TOLERANCE_M, MAX_TOLERANCE_M = 0.03, 0.1  # limits of the tolerance of depths of one surface
MIN_VIEWS = 2  # number of views that must agree on a conclusion
DIRECTIONS = np.array([d for d in np.ndindex(3, 3, 3) if d != (1, 1, 1)], dtype=np.float64) - 1
DIRECTIONS /= np.linalg.norm(DIRECTIONS, axis=1, keepdims=True)
"""(26, 3) unit vectors to the faces, edges and corners of a cube, of which one is within 28 degrees of any."""
_MIN_COSINE = 0.574  # a view observes the directions within 55 degrees of its own
CELL_M = 0.12  # Gaussians nearer to each other than this vote together


@dataclass(frozen=True, eq=False)
class View:
    """A downscaled render of a capture.

    Args:
        camera: one camera, in the frame of the comparison.
        colour: (H, W, 3) float32, in [0, 1].
        depth: (H, W) float32 camera-space z, metres.
        near, far: (H, W) float32 lowest and highest depth over 3 x 3 pixels. At an edge the depth of a pixel mixes
            foreground and background, so it is no evidence between ``near`` and ``far``.
        opaque: (H, W) mask of pixels that show a surface.
        solid: (H, W) mask of opaque pixels with eight opaque neighbours.
        dominant_id: (H, W) int32 Gaussian with the largest blending weight, -1 for none.
    """

    camera: Cameras
    colour: np.ndarray
    depth: np.ndarray
    near: np.ndarray
    far: np.ndarray
    opaque: np.ndarray
    solid: np.ndarray
    dominant_id: np.ndarray


@dataclass(frozen=True, eq=False)
class ProjectedPoints:
    """Points projected into a view: their rows ``index``, pixels and depths ``z``."""

    index: np.ndarray
    row: np.ndarray
    column: np.ndarray
    z: np.ndarray


@dataclass(frozen=True, eq=False)
class CaptureViews:
    """A capture, rendered once from a bounded number of its own cameras.

    Args:
        scene: the capture.
        views: V renders of the capture.
        surface: (N,) mask of Gaussians that are visible in the views; the rest are floaters or unobserved. Without
            views it is True for all.
        times_seen: (N,) int32 number of views in which a Gaussian lies on the visible surface.
        well_observed: (N,) mask of Gaussians whose cell has a Gaussian that `MIN_VIEWS` of the views observe. Without
            views it is True for all.
        directions: (N,) uint32 directions from which the views observe a Gaussian, one bit for each of `DIRECTIONS`.
            Without views all bits are set.
        sharpness: (N,) float32 sum over these views of (pixels per metre)^2; it is larger for more and nearer views.
        sure: per view, an (H, W) mask of solid pixels whose surface enough views of the capture observed.
        own_points: see ``placed``; None if they are projected on first use.
    """

    scene: PosedScene
    views: tuple[View, ...]
    surface: np.ndarray
    times_seen: np.ndarray
    well_observed: np.ndarray
    directions: np.ndarray
    sharpness: np.ndarray
    sure: tuple[np.ndarray, ...]
    own_points: tuple[ProjectedPoints, ...] | None = None

    @property
    def gaussians(self) -> Gaussians:
        return self.scene.gaussians

    @cached_property
    def placed(self) -> tuple[ProjectedPoints, ...]:
        """Per view, the projections of the capture's own Gaussians."""
        if self.own_points is not None:
            return self.own_points
        index = ChunkIndex.build(self.gaussians)
        return tuple(_project_visible(self.gaussians.means, view, index) for view in self.views)


def render_views(
    scene: PosedScene, *, longest_side_px: int = LONGEST_SIDE_PX, max_views: int = MAX_VIEWS
) -> CaptureViews:
    """Render a capture from its own cameras; without cameras it has no views and is no evidence on other captures."""
    count = len(scene.gaussians)
    index = ChunkIndex.build(scene.gaussians)
    views, largest = _render(scene.gaussians, select_cameras(scene, longest_side_px, max_views), index)
    times_seen, sharpness = np.zeros(count, dtype=np.int32), np.zeros(count, dtype=np.float32)
    directions = np.full(count, 0 if views else 2 ** len(DIRECTIONS) - 1, dtype=np.uint32)  # all, if nothing is known
    for view in views:
        count_observations(
            np.ascontiguousarray(scene.gaussians.means, np.float32),
            spans=_visible_ranges(view, index),
            pose=np.ascontiguousarray(view.camera.T_camera_frame[0], np.float64),
            lens=np.ascontiguousarray(view.camera.intrinsics_px[0], np.float64),
            near=view.near,
            far=view.far,
            nearest=NEAREST_M,
            margin=MIN_TOLERANCE_M,
            axes=DIRECTIONS,
            min_cosine=_MIN_COSINE,
            times_seen=times_seen,
            directions=directions,
            sharpness=sharpness,
        )
    well = max_per_cell(scene.gaussians.means, times_seen, CELL_M) >= MIN_VIEWS
    well |= not views
    sure = tuple(v.solid & well[v.dominant_id] & (v.dominant_id >= 0) for v in views) if count else ()
    surface = largest >= MIN_WEIGHT if views else np.ones(count, dtype=bool)
    return CaptureViews(scene, tuple(views), surface, times_seen, well, directions, sharpness, sure)


def observed_from(points: np.ndarray, directions: np.ndarray, view: View) -> np.ndarray:
    """Return an (N,) mask, True for points that were observed from about the direction of a view.

    The two faces of a thin wall lie within the tolerance of one surface, so that the face which a capture never
    observed would be compared by the colours of the other face.

    Args:
        points: (N, 3) means of Gaussians.
        directions: (N,) bits of `CaptureViews.directions`.
    """
    nearest = (_rays(points, view) @ DIRECTIONS.T).argmax(1)
    out: np.ndarray = (directions >> nearest.astype(np.uint32)) & 1 > 0
    return out


def _rays(points: np.ndarray, view: View) -> np.ndarray:
    """Return the (N, 3) unit vectors from points to the camera of a view."""
    T_camera_frame = view.camera.T_camera_frame[0]
    rays = -T_camera_frame[:3, :3].T @ T_camera_frame[:3, 3] - points
    out: np.ndarray = rays / np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    return out


def max_per_cell(points: np.ndarray, counts: np.ndarray, cell_m: float) -> np.ndarray:
    """Return the (N,) largest count in each point's cell."""
    if not len(points):
        return counts
    cell = voxel_labels(points, cell_m)
    best = np.zeros(int(cell.max()) + 1, dtype=counts.dtype)
    np.maximum.at(best, cell, counts)
    out: np.ndarray = best[cell]
    return out


def select_cameras(scene: PosedScene, longest_side_px: int, max_views: int) -> Cameras:
    """Select at most ``max_views`` cameras of a capture, evenly along its path; none if the cameras were
    synthesized."""
    if scene.cameras is None or scene.cameras.synthesised or not len(scene.cameras) or not len(scene.gaussians):
        return Cameras.concatenate([])
    return scene.cameras.evenly(max_views).resized(longest_side_px)


def project_points(points: np.ndarray, view: View, nearest_m: float) -> ProjectedPoints:
    """Project points (N, 3) into a view; drop points outside of it or nearer than ``nearest_m``."""
    camera = view.camera
    width, height = (int(v) for v in camera.sizes_px[0])
    return ProjectedPoints(
        *place_points(
            points=np.ascontiguousarray(points, np.float32),
            pose=np.ascontiguousarray(camera.T_camera_frame[0], np.float64),
            lens=np.ascontiguousarray(camera.intrinsics_px[0], np.float64),
            width=width,
            height=height,
            nearest=nearest_m,
        )
    )


def _visible_ranges(view: View, index: ChunkIndex) -> np.ndarray:
    camera = view.camera
    return index.visible_ranges(camera.T_camera_frame[0], camera.intrinsics_px[0], *camera.sizes_px[0].tolist())


def _project_visible(points: np.ndarray, view: View, index: ChunkIndex) -> ProjectedPoints:
    """Return `project_points` of the means of Gaussians, of which only visible chunks are projected."""
    ranges = _visible_ranges(view, index)
    rows = np.concatenate([np.zeros(0, np.int64), *(np.arange(start, stop) for start, stop in ranges)])
    visible = np.concatenate([points[:0], *(points[start:stop] for start, stop in ranges)])
    at = project_points(visible, view, NEAREST_M)
    return replace(at, index=rows[at.index].astype(at.index.dtype))


def _render(gaussians: Gaussians, cameras: Cameras, index: ChunkIndex) -> tuple[list[View], np.ndarray]:
    """Render Gaussians from cameras; return the views, and the (N,) largest weight of each Gaussian in any view."""
    largest = np.zeros(len(gaussians), dtype=np.float32)
    views: dict[int, View] = {}
    for size in np.unique(cameras.sizes_px, axis=0):  # one call for a size, which allocates the weights once
        rows = np.flatnonzero((cameras.sizes_px == size).all(1))
        seen = render(gaussians, cameras[rows], max_weight=True, index=index)
        np.maximum(largest, seen.max_weight, out=largest)
        for k, i in enumerate(rows.tolist()):
            views[i] = make_view(seen.colour[k], seen.alpha[k], seen.depth[k], seen.dominant_id[k], cameras[i])
    return [views[i] for i in range(len(cameras))], largest


def make_view(
    colour: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray,
    dominant_id: np.ndarray,
    camera: Cameras,
) -> View:
    """Convert a render to a view, with depth ranges and opacity masks."""
    opaque = alpha > MIN_ALPHA
    near, far = depth_extremes(depth, opaque)
    solid = opaque & erode(opaque)
    return View(camera, np.clip(colour, 0, 1), depth, near, far, opaque, solid, dominant_id)
