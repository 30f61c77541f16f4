"""Which side of its surface a capture has seen.

A wall is two surfaces some centimetres apart. A capture that walked through one room has its front, one from the next
room its back; nearest points would lay the one on the other, and a pose so refined is off by the wall's thickness with
residuals that look like any others. So each cell of a surface faces the side from which the capture's own cameras saw
it, and a cell is not laid on one that faces the other way.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.geometry.projection import in_image, project
from gsmap.register.view_cache import ViewCache


@dataclass(frozen=True)
class Params:
    """How cells learn which side of them was seen.

    Args:
        num_cameras: of the capture's own cameras so many are asked, chosen to see most sides; 0 asks none, and no side
            is known.
        reach_m: a cell so far from the depth that a camera sees there is not what it sees; nearer, it counts by
            Tukey's biweight.
        clear: a side is known where at least this share of what cameras say is not contradicted by the rest.
        fill_rounds: cells that no camera sees take the side of the neighbours that lie level with them, so many times.
        min_alpha: where a camera's render is fainter, it shows nothing.
        num_neighbours: neighbours asked ...
        level: ... whose normal is this near to the cell's own (cosine) ...
        level_m: ... and which lie no farther from the cell's plane than this.
    """

    num_cameras: int = 16
    reach_m: float = 0.08
    clear: float = 0.5
    fill_rounds: int = 2
    min_alpha: float = 0.5
    num_neighbours: int = 10
    level: float = 0.8
    level_m: float = 0.03


def faces(
    points: np.ndarray, normals: np.ndarray, tree: Any, views: ViewCache, unit_m: float, params: Params | None = None
) -> np.ndarray:
    """The normals turned to where the capture's own cameras saw the cells from.

    Args:
        points: (M, 3) cell means, metres in the scene's axes.
        normals: (M, 3) unit normals there, of either sign.
        tree: the `PointTree` of the points.
        views: the scene through its cameras, in its own unit of ``unit_m`` metres.

    Returns:
        (M, 3) unit vectors, zeros where no side is known: seen by no camera, or from both sides, as what is thinner
        than a cell may be.
    """
    params = params or Params()
    front, back = _seen(points, normals, views, unit_m, params)
    side = _decided(front, back, params.clear)
    for _ in range(params.fill_rounds):
        side = _filled(side, points, normals, tree, params)
    found: np.ndarray = normals * side[:, None]
    return found


def _seen(
    points: np.ndarray, normals: np.ndarray, views: ViewCache, unit_m: float, params: Params
) -> tuple[np.ndarray, np.ndarray]:
    """(M,) how much the cameras saw of each cell's front (where its normal points) and of its back."""
    front, back = np.zeros((2, len(points)))
    own = points / unit_m
    for row in views.views_of_sides(own, normals, params.num_cameras):
        camera = views.cameras[[row]]
        shown = views.render(row)
        depth = np.where(shown.alpha[0] > params.min_alpha, shown.depth[0], np.inf) * unit_m
        pixels, z = project(own, camera.T_camera_frame[0], camera.intrinsics_px[0])
        at = np.flatnonzero(in_image(pixels, z, camera.sizes_px[0]))
        column, line = np.floor(pixels[at]).astype(np.int64).T
        off = (z[at] * unit_m - depth[line, column]) / params.reach_m
        near = np.abs(off) < 1
        at, weight = at[near], (1 - off[near] ** 2) ** 2
        towards = camera.T_frame_camera[0, :3, 3] * unit_m - points[at]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12)
        slant = (normals[at] * towards).sum(1)  # what is seen at a grazing angle hardly tells its side
        front[at] += weight * np.maximum(slant, 0.0)
        back[at] += weight * np.maximum(-slant, 0.0)
    return front, back


def _decided(front: np.ndarray, back: np.ndarray, clear: float) -> np.ndarray:
    """(M,) 1, -1, or 0 where nothing or too little speaks for one side."""
    decided: np.ndarray = np.sign(front - back) * (np.abs(front - back) > clear * (front + back))
    return decided


def _filled(side: np.ndarray, points: np.ndarray, normals: np.ndarray, tree: Any, params: Params) -> np.ndarray:
    """(M,) sides, those not known taken from level neighbours."""
    unknown = np.flatnonzero(side == 0)
    if not len(unknown) or len(unknown) == len(side):
        return side
    _, rows = tree.neighbours(params.num_neighbours)
    near = rows[unknown]
    there = near < len(points)
    near = np.where(there, near, 0)
    along = (normals[near] * normals[unknown][:, None]).sum(2)
    rise = ((points[near] - points[unknown][:, None]) * normals[unknown][:, None]).sum(2)
    level = there & (np.abs(along) > params.level) & (np.abs(rise) < params.level_m)
    said = np.where(level, side[near] * np.sign(along), 0.0)
    out = side.copy()
    out[unknown] = _decided((said > 0).sum(1), (said < 0).sum(1), params.clear)
    return out
