"""Synthesize cameras in the free space of a scene without cameras."""

from __future__ import annotations

import numpy as np

from gsmap.types import Cameras, GaussianSource
from gsmap.types.source import gathered

_POINTS = 20_000
_PLACES = 256
_GRID = 32
_CLEARANCE = 0.03  # smallest distance of a position from all points, in diagonals of the scene
_PANORAMA = (16, 32)  # bins of latitude and longitude
_ENCLOSED = 0.6  # indoors at least this share of directions hits a surface; in a room without a ceiling more do
_TIE = 0.02  # positions indoors may see this share of the points less, as bare walls look the same from both sides
_MIN_GAIN = 0.002  # smallest share of the points that a further position adds
_SIDE_PX = 512


def synthesise_cameras(gaussians: GaussianSource, *, num_positions: int = 16, seed: int = 0) -> Cameras:
    """Synthesize cameras in free space that together see a scene's surfaces.

    Up to ``num_positions`` positions are chosen one by one; each sees most points that no earlier position saw. From
    each, views of 90 degrees look along those axes where there are points. Positions are indoors (most directions hit a
    surface) if indoor positions together see as much as outdoor positions, which holds for rooms but not for hollow
    objects. The result is deterministic.

    Returns:
        Cameras in the scene's frame with ``synthesised=True``.
    """
    rng = np.random.default_rng(seed)
    points = _solid_points(gaussians, rng)
    places = _free_places(points, rng)
    columns = np.ascontiguousarray(points.T)
    panoramas = [_panorama(columns, place) for place in places]
    share = np.array([hit for hit, _ in panoramas])
    seen = [visible for _, visible in panoramas]
    indoors = _best(seen, np.flatnonzero(share >= _ENCLOSED), len(points), num_positions)
    outside = _best(seen, np.flatnonzero(share < _ENCLOSED), len(points), num_positions)
    if _coverage(seen, indoors) >= _coverage(seen, outside) - _TIE * len(points):
        chosen = indoors
    else:
        chosen = _best(seen, np.arange(len(places)), len(points), num_positions)
    poses = np.array([pose for i in chosen for pose in _look_around(places[i], points[seen[i]])])
    n = len(poses)
    intrinsics = np.full((n, 4), _SIDE_PX / 2)  # 90 degrees
    names = tuple(f"synthesised_{i:03d}" for i in range(n))
    return Cameras(poses, intrinsics, np.full((n, 2), _SIDE_PX), names, synthesised=True)


def _solid_points(gaussians: GaussianSource, rng: np.random.Generator) -> np.ndarray:
    """Return the (N, 3) centres of a sample of the opaque Gaussians that are not huge; of all Gaussians if none is
    opaque."""
    widest = np.concatenate([log_scales.max(1) for log_scales in gaussians.columns("log_scales")])
    opaque = np.concatenate([logits > -0.85 for logits in gaussians.columns("logit_opacities")])
    solid = np.flatnonzero(opaque & (widest <= np.percentile(widest, 98)))
    if not len(solid):
        solid = np.arange(len(widest))
    if len(solid) > _POINTS:
        solid = np.sort(rng.choice(solid, _POINTS, replace=False))
    return gathered(gaussians, "means", solid).astype(np.float64)


def _free_places(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return (M, 3) free positions in the box of the points, spread by farthest-point sampling."""
    from scipy.spatial import cKDTree

    low, high = np.percentile(points, [1, 99], axis=0)
    diagonal = float(np.linalg.norm(high - low)) or 1.0
    cells = np.stack(np.meshgrid(*[np.arange(_GRID)] * 3, indexing="ij"), -1).reshape(-1, 3)
    cells = low + (cells + rng.uniform(size=cells.shape)) / _GRID * (high - low)
    clearance, _ = cKDTree(points).query(cells, distance_upper_bound=0.2 * diagonal)
    free = cells[clearance >= _CLEARANCE * diagonal]
    if len(free) < 8:
        free = cells[np.argsort(-clearance, kind="stable")[:64]]
    chosen = [0]
    columns = np.ascontiguousarray(free.T)
    distance = _lengths(columns - free[0][:, None])
    while len(chosen) < min(_PLACES, len(free)):
        chosen.append(int(np.argmax(distance)))
        np.minimum(distance, _lengths(columns - free[chosen[-1]][:, None]), out=distance)
    out: np.ndarray = free[chosen]
    return out


def _lengths(offsets: np.ndarray) -> np.ndarray:
    """Return the (N,) lengths of vectors (3, N): by columns, because sums along rows of three are far slower."""
    x, y, z = offsets
    out: np.ndarray = np.sqrt(x * x + y * y + z * z)
    return out


def _panorama(points: np.ndarray, position: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the share of directions (by solid angle) that hit points (3, N), and the indices of the visible points."""
    rows, columns = _PANORAMA
    offset = points - position[:, None]
    distance = _lengths(offset)
    # Equal steps of the sine of the latitude cover equal solid angles.
    sine = (offset[2] / np.maximum(distance, 1e-12) + 1) / 2
    angle = np.arctan2(offset[1], offset[0]) / (2 * np.pi) + 0.5
    row = np.minimum((sine * rows).astype(int), rows - 1)
    column = np.minimum((angle * columns).astype(int), columns - 1)
    nearest = np.full(rows * columns, np.inf)
    bins = row * columns + column
    np.minimum.at(nearest, bins, distance)
    visible = np.flatnonzero(distance <= 1.1 * nearest[bins])
    return float(np.isfinite(nearest).mean()), visible


def _best(seen: list[np.ndarray], allowed: np.ndarray, num_points: int, count: int) -> list[int]:
    """Select up to ``count`` allowed positions greedily by the number of points that each adds."""
    unseen = np.ones(num_points, bool)
    out: list[int] = []
    while len(out) < min(count, len(allowed)):
        gain = [int(unseen[seen[i]].sum()) for i in allowed]
        if out and max(gain) < _MIN_GAIN * num_points:
            break
        out.append(int(allowed[int(np.argmax(gain))]))
        unseen[seen[out[-1]]] = False
    return out


def _coverage(seen: list[np.ndarray], places: list[int]) -> int:
    """Return the number of points that some positions see together."""
    return len(np.unique(np.concatenate([seen[i] for i in places]))) if places else -1


def _look_around(place: np.ndarray, visible: np.ndarray) -> list[np.ndarray]:
    """Return poses at a position that look along those of the six axes in which at least 2 % of the visible points
    lie."""
    offset = visible - place
    reach = np.abs(offset).max(1)
    poses = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            if (sign * offset[:, axis] >= reach).sum() >= max(1.0, 0.02 * len(visible)):
                poses.append(_look(place, sign * np.eye(3)[axis]))
    return poses


def _look(place: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Return the (4, 4) camera-to-frame pose (OpenCV axes) that looks along a unit axis; the image's down is another
    axis."""
    down = np.array([0.0, 1, 0]) if forward[1] == 0 else np.array([0.0, 0, 1])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], 1)
    pose[:3, 3] = place
    return pose
