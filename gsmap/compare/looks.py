"""A capture through its own cameras: what it is sure of, and how well it saw each of its Gaussians."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap._native import place_points
from gsmap.compare.neighbourhoods import extremes, shrunk
from gsmap.geometry.voxels import voxel_labels
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, PlacedScene

LONGEST_SIDE_PX, MAX_VIEWS = 240, 48  # default size and number of the views of a capture
MIN_ALPHA = 0.9  # of a pixel that shows a surface
MIN_WEIGHT = 0.1  # blending weight in some own view, for a Gaussian to be part of a surface
NEAREST_M = 0.2  # nearer Gaussians are not judged by a view
MIN_TOLERANCE_M, MAX_TOLERANCE_M = 0.03, 0.1  # of depths of one surface; the captures' agreement decides in between
MIN_VIEWS = 2  # that must agree before anything is concluded
CELL_M = 0.12  # Gaussians this near vote together


@dataclass(frozen=True, eq=False)
class View:
    """One small picture of a capture.

    Args:
        camera: one camera, the frame of the comparison.
        colour: (H, W, 3) float32, in [0, 1].
        depth: (H, W) float32 camera-space z, metres.
        near, far: (H, W) float32 lowest and highest depth over 3 x 3 pixels: at an edge a depth is a mixture of what
            lies before and behind it, and proves nothing between the two.
        opaque: (H, W) bool, shows a surface.
        solid: (H, W) bool, so it does, and so do the eight neighbours.
        dominant_id: (H, W) int32 Gaussian of the capture that shows most, -1 for none.
    """

    camera: Cameras
    colour: np.ndarray
    depth: np.ndarray
    near: np.ndarray
    far: np.ndarray
    opaque: np.ndarray
    solid: np.ndarray
    dominant_id: np.ndarray

    def pixels_a_metre(self, z: np.ndarray) -> np.ndarray:
        """How finely the picture shows what lies at depths z."""
        out: np.ndarray = (self.camera.intrinsics_px[0, 0] / z).astype(np.float32)
        return out


@dataclass(frozen=True, eq=False)
class Placed:
    """Which points fall in a picture (``index``), on which pixels, at which depth ``z``."""

    index: np.ndarray
    row: np.ndarray
    column: np.ndarray
    z: np.ndarray


@dataclass(frozen=True, eq=False)
class Looks:
    """One capture, rendered once from a bounded number of its own cameras.

    Args:
        scene: the capture.
        views: V pictures of it.
        surface: (N,) bool, which Gaussians show in these pictures; the others are haze, or were never seen;
            all of a capture without pictures.
        times_seen: (N,) int32 pictures in which a Gaussian lies on the surface that is shown.
        sharpness: (N,) float32 sum over these of (pixels a metre)^2: more looks and nearer ones see better.
        sure: per view (H, W) bool, solid, and a surface that enough of the capture's views saw.
        placed: per view, where its own Gaussians fall in it.
    """

    scene: PlacedScene
    views: tuple[View, ...]
    surface: np.ndarray
    times_seen: np.ndarray
    sharpness: np.ndarray
    sure: tuple[np.ndarray, ...]
    placed: tuple[Placed, ...]

    @property
    def gaussians(self) -> Gaussians:
        return self.scene.gaussians


def look(scene: PlacedScene, *, longest_side_px: int = LONGEST_SIDE_PX, max_views: int = MAX_VIEWS) -> Looks:
    """Render a capture from its own cameras; one without cameras has no views and says nothing of others."""
    count = len(scene.gaussians)
    largest = np.zeros(count, dtype=np.float32)
    views = []
    for camera in own_cameras(scene, longest_side_px, max_views):
        view, weight = _view(scene.gaussians, camera)
        views.append(view)
        np.maximum(largest, weight, out=largest)
    times_seen, sharpness = np.zeros(count, dtype=np.int32), np.zeros(count, dtype=np.float32)
    placed = tuple(place(scene.gaussians.means, view, NEAREST_M) for view in views)
    for view, at in zip(views, placed, strict=True):
        margin = MIN_TOLERANCE_M
        on = (at.z > view.near[at.row, at.column] - margin) & (at.z < view.far[at.row, at.column] + margin)
        times_seen[at.index[on]] += 1
        sharpness[at.index[on]] += view.pixels_a_metre(at.z[on]) ** 2
    well = best_of_cell(scene.gaussians.means, times_seen, CELL_M) >= MIN_VIEWS
    sure = tuple(v.solid & well[v.dominant_id] & (v.dominant_id >= 0) for v in views) if count else ()
    surface = largest >= MIN_WEIGHT if views else np.ones(count, dtype=bool)
    return Looks(scene, tuple(views), surface, times_seen, sharpness, sure, placed)


def best_of_cell(points: np.ndarray, counts: np.ndarray, cell_m: float) -> np.ndarray:
    """(N,) the largest count in each point's cell: a place was seen as often as what shows it best."""
    if not len(points):
        return counts
    cell = voxel_labels(points, cell_m)
    best = np.zeros(int(cell.max()) + 1, dtype=counts.dtype)
    np.maximum.at(best, cell, counts)
    out: np.ndarray = best[cell]
    return out


def own_cameras(scene: PlacedScene, longest_side_px: int, max_views: int) -> list[Cameras]:
    """At most ``max_views`` cameras of a capture, evenly along its path, small; none where nobody knows what it saw."""
    if scene.cameras is None or scene.cameras.synthesised or not len(scene.cameras) or not len(scene.gaussians):
        return []
    small = scene.cameras.evenly(max_views).resized(longest_side_px)
    return [small[i] for i in range(len(small))]


def place(points: np.ndarray, view: View, nearest_m: float) -> Placed:
    """Points (N, 3) in a view, those alone that lie in the picture and beyond ``nearest_m``."""
    camera = view.camera
    width, height = (int(v) for v in camera.sizes_px[0])
    return Placed(
        *place_points(
            points=np.ascontiguousarray(points, np.float32),
            pose=np.ascontiguousarray(camera.T_camera_frame[0], np.float64),
            lens=np.ascontiguousarray(camera.intrinsics_px[0], np.float64),
            width=width,
            height=height,
            nearest=nearest_m,
        )
    )


def _view(gaussians: Gaussians, camera: Cameras) -> tuple[View, np.ndarray]:
    seen = render(gaussians, camera, max_weight=True)
    return view_of(seen.colour[0], seen.alpha[0], seen.depth[0], seen.dominant_id[0], camera), seen.max_weight


def view_of(
    colour: np.ndarray,
    alpha: np.ndarray,
    depth: np.ndarray,
    dominant_id: np.ndarray,
    camera: Cameras,
) -> View:
    """A picture with what its neighbourhoods say."""
    opaque = alpha > MIN_ALPHA
    near, far = extremes(depth, opaque)
    solid = opaque & shrunk(opaque)
    return View(camera, np.clip(colour, 0, 1), depth, near, far, opaque, solid, dominant_id)
