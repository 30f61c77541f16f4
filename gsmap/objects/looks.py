"""Whether a capture looked at a place, and whether something stood there: by its own cameras, in its own renders."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.colour import srgb_to_lab
from gsmap.geometry.projection import in_image, project
from gsmap.render import render
from gsmap.types import Cameras, Gaussians, SightingState

MAX_VIEWS, LONGEST_SIDE_PX = 32, 128  # default number of a capture's views that are rendered, and their size
_TOLERANCE_M, _TOLERANCE_PER_DEPTH = 0.1, 0.02  # between a point and the surface that it is on; metres, and per metre
_MIN_OBSERVED = 0.5  # fraction of an object's points below which it is unobserved
_MIN_PRESENT = 0.5  # fraction of the observed points on a surface of its colour, for it to be seen
_MIN_SAME_SHAPE = 0.9  # or on a surface of any colour: an object that was painted
_PATCH_M = 0.25  # edge of the cells over which colours are averaged
_MAX_LAB = 14.0  # difference of mean colours, L*a*b* units, of one surface


@dataclass(frozen=True, eq=False)
class Eyes:
    """What a capture's cameras see, frame and unit of the capture.

    Args:
        cameras: one each.
        depths: (H, W) float32 each, 0 where nothing was drawn.
        colours: (H, W, 3) float32 each, L*a*b*.
    """

    cameras: tuple[Cameras, ...]
    depths: tuple[np.ndarray, ...]
    colours: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Glance:
    """What a capture saw at some points.

    Args:
        through: (K,) bool, some view's surface lies clearly behind the point.
        on: (K,) bool, some view's surface lies on it.
        colours: (K, 3) mean colour of that surface, L*a*b*; NaN where there is none.
    """

    through: np.ndarray
    on: np.ndarray
    colours: np.ndarray


def open_eyes(
    gaussians: Gaussians,
    cameras: Cameras | None,
    max_views: int = MAX_VIEWS,
    longest_side_px: int = LONGEST_SIDE_PX,
) -> Eyes:
    """Render a capture through its own cameras; without cameras it has seen nothing."""
    if cameras is None or not len(cameras) or cameras.synthesised:
        return Eyes((), (), ())
    small = cameras.evenly(max_views).resized(longest_side_px)
    views = tuple(small[i] for i in range(len(small)))
    seen = [render(gaussians, view, dominant_id=False) for view in views]
    return Eyes(
        views,
        tuple(np.where(image.alpha[0] > 0.5, image.depth[0], 0) for image in seen),
        tuple(srgb_to_lab(np.clip(np.nan_to_num(image.colour[0]), 0, 1)) for image in seen),
    )


def in_view(cameras: Cameras | None, points: np.ndarray, max_views: int = MAX_VIEWS) -> bool:
    """Whether any camera that a capture looks with has one of the points (K, 3) in its picture, whatever stands before
    it; its frame and unit."""
    if cameras is None or cameras.synthesised:
        return False
    some = cameras.evenly(max_views)
    for view in (some[i] for i in range(len(some))):
        pixels, z = project(points, view.T_camera_frame[0], view.intrinsics_px[0])
        if in_image(pixels, z, view.sizes_px[0]).any():
            return True
    return False


def glance(eyes: Eyes, points: np.ndarray, unit_m: float) -> Glance:
    """What a capture saw at points (K, 3), its frame and unit; ``unit_m`` is metres per unit."""
    through, times = np.zeros(len(points), bool), np.zeros(len(points))
    colours = np.zeros((len(points), 3))
    for view, depth, colour in zip(eyes.cameras, eyes.depths, eyes.colours, strict=True):
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
        return Glance(through, times > 0, colours / times[:, None])


def judge(seen: Glance, points: np.ndarray, colours: np.ndarray, shift: np.ndarray) -> tuple[SightingState, float]:
    """Whether a thing that other captures show is there.

    Args:
        seen: what the capture saw at its points.
        points: (K, 3) of it, metres.
        colours: (K, 3) its own there, L*a*b*.
        shift: (3,) by which the capture's colours differ from those, for another exposure.

    Returns:
        The state: ``unseen`` where too little of its place was looked at; ``seen`` where most of what was looked at
        is a surface of its colour and was not looked through; else ``absent``. And the share that was looked at.
    """
    looked = seen.through | seen.on
    share = float(looked.mean()) if len(looked) else 0.0
    if share < _MIN_OBSERVED:
        return "unseen", share
    # Books and leaves differ from pixel to pixel: what is compared is the mean of a patch.
    rows = np.flatnonzero(seen.on)
    off = seen.colours[rows] - shift - colours[rows]
    label, counts = cell_labels(np.floor(points[rows] / _PATCH_M))
    alike = np.zeros(len(points), bool)
    alike[rows] = (np.linalg.norm(group_means(off, label, counts), axis=1) < _MAX_LAB)[label]
    solid = seen.on & ~seen.through
    there = (solid & alike).sum() >= _MIN_PRESENT * looked.sum() or solid.sum() >= _MIN_SAME_SHAPE * looked.sum()
    return ("seen" if there else "absent"), share
