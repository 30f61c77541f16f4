"""Measure in renders how much of the outline of each segment is the segment's own, and not a cut through a surface."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from gsmap.objects.visibility import RenderedViews

# Tolerances between surfaces at an outline; metres, and per metre of depth.
_STEP_M, _STEP_PER_DEPTH = 0.04, 0.01  # a larger step in depth separates two surfaces
_OFF_PLANE_M, _OFF_PLANE_PER_DEPTH = 0.02, 0.01  # points nearer to each other's plane are on one plane,
_PARALLEL = 0.9  # if the cosine between their normals is at least this
_GRAZING = 0.26  # a plane seen at a smaller cosine may be the blend of two surfaces, one behind the other
_SAME_LAB = 10.0  # a plane whose colour differs by less (L*a*b*) across an outline continues

_SIDES = ((0, 1), (0, -1), (1, 0), (-1, 0))


class Outline(NamedTuple):
    """Pixels along the outline of a segment, by what lies beside them, summed over the views of a scene.

    Args:
        free: number of pixels behind which another surface lies.
        touching: beside which another surface begins: at a crease, at a small step or in another colour.
        continuing: beside which the surface continues in its plane and colour outside of the segment.
        behind_building: in front of which the building lies.
        behind_segments: in front of which another segment lies.
        largest_px: number of the segment's pixels in the view that shows most of it.
    """

    free: int
    touching: int
    continuing: int
    behind_building: int
    behind_segments: int
    largest_px: int


def measure_outlines(views: RenderedViews, count: int, unit_m: float) -> list[Outline]:
    """Measure the outlines of the ``count`` segments of a scene in its views; ``unit_m`` is metres per unit."""
    kinds, largest = np.zeros((5, count), np.int64), np.zeros(count, np.int64)
    for camera, depth, lab, labels in zip(views.cameras, views.depths, views.colours, views.segments, strict=True):
        np.maximum(largest, np.bincount(labels[labels >= 0], minlength=count), out=largest)
        points = _points(depth * unit_m, camera.intrinsics_px[0])
        normals = _normals(points)
        for down, right in _SIDES:
            inner, outer = _pairs(labels, depth, down, right)
            step, near = points[outer] - points[inner], points[inner][:, 2]
            off = np.maximum(*(np.abs((step * normals[at]).sum(1)) for at in (inner, outer)))
            on_plane = np.abs((normals[inner] * normals[outer]).sum(1)) > _PARALLEL
            on_plane &= off < _OFF_PLANE_M + _OFF_PLANE_PER_DEPTH * near
            same = on_plane & (np.linalg.norm(lab[inner] - lab[outer], axis=1) < _SAME_LAB)
            rays = points[inner] / np.maximum(np.linalg.norm(points[inner], axis=1, keepdims=True), 1e-12)
            on_plane &= same | (np.abs((normals[inner] * rays).sum(1)) > _GRAZING)
            gap, tolerance = np.where(on_plane, 0.0, step[:, 2]), _STEP_M + _STEP_PER_DEPTH * near
            cases = [gap > tolerance, same, (gap < -tolerance) & (labels[outer] < 0), gap < -tolerance]
            kind = np.select(cases, [0, 2, 3, 4], 1)
            kinds += np.bincount(kind * count + labels[inner], minlength=5 * count).reshape(5, count)
    return [Outline(*row) for row in np.vstack([kinds, largest]).T.tolist()]


def _pairs(
    labels: np.ndarray, depth: np.ndarray, down: int, right: int
) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
    """Return pixels of segments and pixels of other surfaces across an outline, in one direction.

    Depth and colour are mixed at an outline, so both pixels are one farther from it than its own two.
    """
    height, width = labels.shape
    row, column = np.nonzero(labels >= 0)
    steps = [(row + k * down, column + k * right) for k in (-1, 0, 1, 2)]
    rows, columns = np.stack([at[0] for at in steps]), np.stack([at[1] for at in steps])
    inside = ((rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)).all(0)
    rows, columns = rows[:, inside], columns[:, inside]
    found = labels[rows, columns]
    ends = (found[0] == found[1]) & (found[2] != found[1]) & (found[3] != found[1]) & (depth[rows, columns] > 0).all(0)
    return (rows[0, ends], columns[0, ends]), (rows[3, ends], columns[3, ends])


def _points(depth: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Return the (H, W, 3) points of a depth image in the camera's frame."""
    fx, fy, cx, cy = intrinsics
    row, column = np.mgrid[: depth.shape[0], : depth.shape[1]] + 0.5
    return np.stack([(column - cx) / fx * depth, (row - cy) / fy * depth, depth], axis=-1)


def _normals(points: np.ndarray) -> np.ndarray:
    """Return the (H, W, 3) unit normals of points of an image; zero at its border."""
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 1:-1] = points[:, 2:] - points[:, :-2]
    down[1:-1] = points[2:] - points[:-2]
    normals = np.cross(across, down)
    out: np.ndarray = normals / np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return out
