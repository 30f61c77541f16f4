"""Observe objects in a scene: test their points in renders from the scene's own cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.colour import srgb_to_lab
from gsmap.geometry.projection import in_image, project
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, ObservationState

MAX_VIEWS, LONGEST_SIDE_PX = 32, 128  # default number and size of the views that are rendered of a capture
# Tolerance between a point and its surface; metres, and per metre of depth.
_TOLERANCE_M, _TOLERANCE_PER_DEPTH = 0.1, 0.02
_MIN_OBSERVED = 0.5  # an object is unobserved if a smaller fraction of its points is observed
_MIN_PRESENT = 0.5  # an object is seen if this fraction of its observed points is on a surface of its colour,
_MIN_SAME_SHAPE = 0.9  # or if this fraction is on a surface of any colour (it was painted)
_PATCH_M = 0.25  # edge of the cells over which colours are averaged
_MAX_LAB = 14.0  # largest difference between mean colours of one surface, in L*a*b* units


@dataclass(frozen=True, eq=False)
class RenderedViews:
    """Renders of a scene from its own cameras, in the scene's frame and unit.

    Args:
        cameras: one camera of each render.
        depths: (H, W) float32 of each render, 0 without a surface.
        colours: (H, W, 3) float32 of each render, L*a*b*.
        segments: (H, W) int32 segment at each pixel of each render, -1 for none; empty if they are unknown.
    """

    cameras: tuple[Cameras, ...]
    depths: tuple[np.ndarray, ...]
    colours: tuple[np.ndarray, ...]
    segments: tuple[np.ndarray, ...] = ()


@dataclass(frozen=True, eq=False)
class PointObservations:
    """Observation of K points by the views of a scene.

    Args:
        through: (K,) mask of points in free space of at least one view.
        on: (K,) mask of points on the surface of at least one view.
        colours: (K, 3) mean colour of that surface, L*a*b*; NaN without a surface.
    """

    through: np.ndarray
    on: np.ndarray
    colours: np.ndarray


def render_views(
    gaussians: Gaussians,
    cameras: Cameras | None,
    max_views: int = MAX_VIEWS,
    longest_side_px: int = LONGEST_SIDE_PX,
    members: np.ndarray | None = None,
) -> RenderedViews:
    """Render a scene from its own cameras; the result has no views if cameras are missing or synthesized.

    Args:
        members: (N,) segment of each Gaussian, -1 for none; default: unknown.
    """
    if cameras is None or not len(cameras) or cameras.synthesised:
        return RenderedViews((), (), ())
    small = cameras.evenly(max_views).resized(longest_side_px)
    views = tuple(small[i] for i in range(len(small)))
    seen = [render(gaussians, view, dominant_id=members is not None) for view in views]
    return RenderedViews(
        views,
        tuple(np.where(image.alpha[0] > 0.5, image.depth[0], 0) for image in seen),
        tuple(srgb_to_lab(np.clip(np.nan_to_num(image.colour[0]), 0, 1)) for image in seen),
        () if members is None else tuple(_labels(image.dominant_id[0], members) for image in seen),
    )


def _labels(ids: np.ndarray, members: np.ndarray) -> np.ndarray:
    """Return the segment of each pixel from its dominant Gaussian."""
    out: np.ndarray = np.where(ids >= 0, members[ids], -1)
    return out


def is_in_view(cameras: Cameras | None, points: np.ndarray, max_views: int = MAX_VIEWS) -> bool:
    """Return whether any of a scene's selected cameras has one of the points (K, 3) in its frustum, even if
    occluded."""
    if cameras is None or cameras.synthesised:
        return False
    some = cameras.evenly(max_views)
    for view in (some[i] for i in range(len(some))):
        pixels, z = project(points, view.T_camera_frame[0], view.intrinsics_px[0])
        if in_image(pixels, z, view.sizes_px[0]).any():
            return True
    return False


def observe_points(views: RenderedViews, points: np.ndarray, unit_m: float) -> PointObservations:
    """Observe points (K, 3) in the views of a scene, in the scene's frame and unit; ``unit_m`` is metres per unit."""
    through, times = np.zeros(len(points), bool), np.zeros(len(points))
    colours = np.zeros((len(points), 3))
    for view, depth, colour in zip(views.cameras, views.depths, views.colours, strict=True):
        pixels, z = project(points, view.T_camera_frame[0], view.intrinsics_px[0])
        rows = np.flatnonzero(in_image(pixels, z, view.sizes_px[0], near=0.05 / unit_m))
        column, row = pixels[rows].astype(np.int64).T
        surface = depth[row, column]
        margin = _TOLERANCE_M / unit_m + _TOLERANCE_PER_DEPTH * z[rows]
        through[rows] |= (surface > 0) & (surface > z[rows] + margin)
        on = (surface > 0) & (np.abs(surface - z[rows]) <= margin)
        times[rows[on]] += 1
        colours[rows[on]] += colour[row[on], column[on]]
    with np.errstate(invalid="ignore"):
        return PointObservations(through, times > 0, colours / times[:, None])


def classify_observation(
    seen: PointObservations, points: np.ndarray, colours: np.ndarray, shift: np.ndarray
) -> tuple[ObservationState, float]:
    """Classify how a scene shows an object that was found in other scenes.

    Args:
        seen: observation of the object's points.
        points: (K, 3) points of the object, metres.
        colours: (K, 3) colours of these points in the other scene, L*a*b*.
        shift: (3,) exposure difference of the scene's colours relative to ``colours``.

    Returns:
        The state and the fraction of observed points. The state is ``unseen`` if too few points were observed, ``seen``
        if most of the observed points are on a surface of the object's colour, and otherwise ``absent``.
    """
    observed = seen.through | seen.on
    share = float(observed.mean()) if len(observed) else 0.0
    if share < _MIN_OBSERVED:
        return "unseen", share
    # Texture of books and leaves differs from pixel to pixel, so means of patches are compared.
    rows = np.flatnonzero(seen.on)
    off = seen.colours[rows] - shift - colours[rows]
    label, counts = cell_labels(np.floor(points[rows] / _PATCH_M))
    similar = np.zeros(len(points), bool)
    similar[rows] = (np.linalg.norm(group_means(off, label, counts), axis=1) < _MAX_LAB)[label]
    solid = seen.on & ~seen.through
    there = (solid & similar).sum() >= _MIN_PRESENT * observed.sum() or solid.sum() >= _MIN_SAME_SHAPE * observed.sum()
    return ("seen" if there else "absent"), share
