"""Orient the normals of a surface towards the side that the capture's own cameras saw.

A wall is two surfaces some centimetres apart. A capture of one room shows the wall's front, a capture of the next room
its back. Nearest neighbours would pair both surfaces, and the refined pose would be off by the wall's thickness with
inconspicuous residuals. So cells whose oriented normals are opposite are not paired.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.register.view_cache import ViewCache

NUM_CAMERAS = 16  # of the capture's own cameras, chosen to see most sides
_REACH_M = 0.08  # cells farther than this from a camera's depth are not seen by it (Tukey's biweight)
_MIN_CLEAR = 0.5  # the side is known if at least this share of the total weight agrees
_FILL_ROUNDS = 2  # rounds in which cells without a side take the side of their coplanar neighbours
_NUM_NEIGHBOURS = 10
_MIN_COPLANAR_COSINE = 0.8  # of the normals of coplanar neighbours
_MAX_COPLANAR_M = 0.03  # distance of a coplanar neighbour from the cell's plane


def find_sides(points: np.ndarray, normals: np.ndarray, tree: Any, views: ViewCache, unit_m: float) -> np.ndarray:
    """Find the side of each cell that the capture's own cameras saw.

    Args:
        points: (M, 3) cell means, metres in the scene's axes.
        normals: (M, 3) unit normals at the cell means, of arbitrary sign.
        tree: the `PointTree` of the points.
        views: renders of the scene through its cameras, in its own unit of ``unit_m`` metres.

    Returns:
        (M,) 1 where they saw the side to which the normal points, -1 where they saw the other side; 0 where the side is
        unknown, because no camera saw the cell, or cameras saw it from both sides (objects thinner than a cell).
    """
    front, back = _weights_of_sides(points, normals, views, unit_m)
    return _fill_unknown(_sides(front, back), points, normals, tree)


def _weights_of_sides(
    points: np.ndarray, normals: np.ndarray, views: ViewCache, unit_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the (M,) weights with which cameras saw each cell's front (where its normal points) and back."""
    front, back = np.zeros((2, len(points)))
    own = points / unit_m
    for row in views.select_views_of_sides(own, normals, NUM_CAMERAS):
        camera = views.cameras[[row]]
        depth = views.image(row).depth * unit_m
        pixels, z = project(own, camera.T_camera_frame[0], camera.intrinsics_px[0])
        at = np.flatnonzero(in_image(pixels, z, camera.sizes_px[0]))
        column, line = np.floor(pixels[at]).astype(np.int64).T
        off = (z[at] * unit_m - depth[line, column]) / _REACH_M
        near = np.abs(off) < 1
        at, weight = at[near], (1 - off[near] ** 2) ** 2
        towards = camera.T_frame_camera[0, :3, 3] * unit_m - points[at]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        slant = (normals[at] * towards).sum(1)  # views at a grazing angle hardly determine the side
        front[at] += weight * np.maximum(slant, 0.0)
        back[at] += weight * np.maximum(-slant, 0.0)
    return front, back


def _sides(front: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return the (M,) side of each cell: 1, -1, or 0 where the weights of both sides are too similar."""
    decided: np.ndarray = np.sign(front - back) * (np.abs(front - back) > _MIN_CLEAR * (front + back))
    return decided


def _fill_unknown(side: np.ndarray, points: np.ndarray, normals: np.ndarray, tree: Any) -> np.ndarray:
    """Return the (M,) sides; cells of unknown side take the side of their coplanar neighbours, in a few rounds."""
    unknown = np.flatnonzero(side == 0)
    if not len(unknown) or len(unknown) == len(side):
        return side
    _, near = tree.neighbours(_NUM_NEIGHBOURS, points[unknown])
    there = near < len(points)
    near = np.where(there, near, 0)
    along = (normals[near] * normals[unknown][:, None]).sum(2)
    rise = ((points[near] - points[unknown][:, None]) * normals[unknown][:, None]).sum(2)
    coplanar = there & (np.abs(along) > _MIN_COPLANAR_COSINE) & (np.abs(rise) < _MAX_COPLANAR_M)
    same = coplanar * np.sign(along)
    for _ in range(_FILL_ROUNDS):
        votes = side[near] * same
        known = side[unknown]
        filled = _sides((votes > 0).sum(1), (votes < 0).sum(1))
        side = side.copy()
        side[unknown] = np.where(known == 0, filled, known)
    return side
