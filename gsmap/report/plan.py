"""Compute the floor plan of a component: its vertical projection in metres, aligned with its walls."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

_STEP_M, _STEP_SPACINGS = 0.25, 4  # largest gap in a surface: in metres or, of few points, in their mean distance
_MIDDLE = (0.02, 0.98)  # quantiles of the points whose mean distance is taken
_YAWS_DEG = np.arange(0.0, 90.0, 1.0)
_MARGIN = 0.05  # margin as a fraction of the longer side
_LEAST_M = 1e-3
_CELLS = 90  # grid cells of outlines along the longer side
_REACH = 3  # corners on either side over which an outline is smoothed
_MOST_STEPS = 1 << 29  # from the middle; farther floaters are taken nearer
_FEW = 50  # number of points below which an outline is their convex hull
# Smallest part, as a fraction of the largest part, and smallest hole, as a fraction of the footprint.
_LEAST_PART, _LEAST_HOLE = 0.1, 0.03


@dataclass(frozen=True, eq=False)
class PlanScene:
    """A scene on a plan, in the frame and unit of its component.

    Args:
        name: Name of the scene.
        status: ``placed``, ``tentative`` or ``isolated``.
        points: (K, 3) sampled means of its Gaussians, its landmarks, or the corners of its bounding box.
        track: (T, 3) camera centres in the order of the capture; empty if the capture has no cameras.
        middle: (3,) position of the label and of the ends of edges.
        covariance_m2: (3, 3) covariance of ``middle`` in square metres; None if unknown.
    """

    name: str
    status: str
    points: np.ndarray
    track: np.ndarray
    middle: np.ndarray
    covariance_m2: np.ndarray | None = None


@dataclass(frozen=True)
class PlanEdge:
    """An edge on a plan: indices of its scenes, its use (`EdgeEntry.use`) and its tooltip."""

    a: int
    b: int
    use: str
    tip: str = ""


@dataclass(frozen=True, eq=False)
class Plan:
    """Floor plan of a component, in metres, x to the right, y up the page.

    Args:
        names, statuses: Names and statuses of the N scenes.
        footprints: Outlines of the footprint of each scene, closed polygons (K, 2), by the even-odd rule.
        tracks: Camera centres (T, 2) of each scene.
        middles: (N, 2) positions of the labels.
        covariances: Covariance (2, 2) of each position in square metres; None if unknown.
        edges: Edges between the scenes.
        bounds: (2, 2) lowest and highest corner of the drawing.
        R_plan_map: (3, 3) rotation from the map frame to the plan; its third row is the up direction.
        metres_per_unit: Metres per unit of the map frame.
        picture: WebP of the component from above that fills ``bounds``; None if there is none.
        picture_kind: ``rendered`` (Gaussians) or ``landmarks`` (their density); empty without a picture.
    """

    names: tuple[str, ...]
    statuses: tuple[str, ...]
    footprints: tuple[tuple[np.ndarray, ...], ...]
    tracks: tuple[np.ndarray, ...]
    middles: np.ndarray
    covariances: tuple[np.ndarray | None, ...]
    edges: tuple[PlanEdge, ...]
    bounds: np.ndarray
    R_plan_map: np.ndarray
    metres_per_unit: float = 1.0
    picture: bytes | None = field(default=None, repr=False)
    picture_kind: str = ""

    def place(self, points: np.ndarray) -> np.ndarray:
        """Transform map points (N, 3) to plan coordinates in metres: right, up the page, height."""
        found: np.ndarray = np.asarray(points, np.float64).reshape(-1, 3) @ self.R_plan_map.T * self.metres_per_unit
        return found


def make_plan(
    shown: Sequence[PlanScene], edges: Sequence[PlanEdge], up: np.ndarray | None, metres_per_unit: float = 1.0
) -> Plan | None:
    """Compute the floor plan of the scenes of one component; None without finite points.

    Args:
        shown: The scenes.
        edges: Edges between them, by index.
        up: (3,) direction opposite to gravity in the component frame; default: its third axis.
        metres_per_unit: Metres per unit of the component frame.
    """
    level = _level(np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, np.float64))
    every = [np.concatenate([one.points, one.track, one.middle[None]]) for one in shown]
    flat = [_surface(points @ level.T, _STEP_M / metres_per_unit) for points in every]
    if not flat or not all(np.isfinite(points).all() for points in flat):
        return None
    R = _turned(level, np.concatenate([points[:, :2] for points in flat]))

    def place(points: np.ndarray) -> np.ndarray:
        found: np.ndarray = (points @ R.T)[:, :2] * metres_per_unit
        return found

    shapes = [_surface(place(one.points), _STEP_M) for one in shown]
    cell = max(float(np.ptp(np.concatenate(shapes), axis=0).max()) / _CELLS, _LEAST_M)
    footprints = tuple(_outlines(points, cell) for points in shapes)
    tracks, middles = tuple(place(one.track) for one in shown), place(np.array([one.middle for one in shown]))
    drawn = np.concatenate([*(ring for one in footprints for ring in one), *tracks, middles])
    low, high = drawn.min(0), drawn.max(0)
    margin = max(_MARGIN * float((high - low).max()), _LEAST_M)
    covariances = [None if one.covariance_m2 is None else R @ one.covariance_m2 @ R.T for one in shown]
    return Plan(
        names=tuple(one.name for one in shown),
        statuses=tuple(one.status for one in shown),
        footprints=footprints,
        tracks=tracks,
        middles=middles,
        covariances=tuple(None if one is None else one[:2, :2] for one in covariances),
        edges=tuple(edges),
        bounds=np.stack([low - margin, high + margin]),
        R_plan_map=R,
        metres_per_unit=metres_per_unit,
    )


def _level(up: np.ndarray) -> np.ndarray:
    """Return a rotation whose third row is the up direction."""
    up = up / max(float(np.linalg.norm(up)), 1e-12)
    x = np.cross([0, 1.0, 0] if abs(up[1]) < 0.9 else [1.0, 0, 0], up)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def _turned(level: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Rotate about the up direction to the smallest bounding box, with its longer side along x."""
    if len(points) < 2:
        return level
    turns = [_turn(np.radians(angle)) for angle in _YAWS_DEG]
    spans = np.array([np.ptp(points @ turn[:2, :2].T, axis=0) for turn in turns])
    best = int(np.argmin(spans.prod(1)))
    turn = turns[best]
    if spans[best, 1] > spans[best, 0]:
        turn = _turn(np.pi / 2) @ turn
    found: np.ndarray = turn @ level
    return found


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _surface(points: np.ndarray, step: float) -> np.ndarray:
    """Drop floaters: points (N, 2 or 3) outside the large connected parts of the ground that points lie on.

    A share of the points would not do: much of the ground may have few of them.

    Args:
        step: largest gap in a surface.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(points) < _FEW or not np.isfinite(points).all():
        return points
    low, high = np.quantile(points[:, :2], _MIDDLE, axis=0)
    step = max(step, _STEP_SPACINGS * float(np.sqrt((high - low).prod() / len(points))))
    at = np.clip((points[:, :2] - low) / step, -_MOST_STEPS, _MOST_STEPS).astype(np.int64)
    cells, of = np.unique(at @ [4 * _MOST_STEPS, 1], return_inverse=True)
    pairs = []
    for ahead in (1, 4 * _MOST_STEPS - 1, 4 * _MOST_STEPS, 4 * _MOST_STEPS + 1):
        other = np.minimum(np.searchsorted(cells, cells + ahead), len(cells) - 1)
        pairs.append(np.stack([np.arange(len(cells)), other])[:, cells[other] == cells + ahead])
    one, two = np.concatenate(pairs, axis=1)
    links = coo_matrix((np.ones(len(one), bool), (one, two)), shape=(len(cells),) * 2)
    part = connected_components(links, directed=False)[1]
    areas = np.bincount(part)
    found: np.ndarray = points[(areas >= _LEAST_PART * areas.max())[part][of]]
    return found


def _outlines(points: np.ndarray, cell: float) -> tuple[np.ndarray, ...]:
    """Compute closed outlines (K, 2) of points, closing small gaps and removing small parts and holes."""
    from scipy import ndimage
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < _FEW:
        try:
            return (points[ConvexHull(points).vertices],) if len(points) > 2 else ()
        except QhullError:  # all on one line
            return ()
    low = points.min(0) - 4 * cell
    at = ((points - low) / cell).astype(int)
    mask = np.zeros(at.max(0) + 5, bool)
    mask[at[:, 0], at[:, 1]] = True
    mask = ndimage.binary_closing(mask, iterations=3)
    mask = ndimage.binary_opening(mask, iterations=1)
    parts, num = ndimage.label(mask)
    areas = np.bincount(parts.ravel(), minlength=num + 1)
    for part in range(1, num + 1):
        if areas[part] < _LEAST_PART * areas[1:].max():
            mask[parts == part] = False
    mask = _without_holes(mask)
    return tuple(_smooth(ring) * cell + low for ring in rings(mask))


def _without_holes(mask: np.ndarray) -> np.ndarray:
    from scipy import ndimage

    holes, num = ndimage.label(~mask)
    areas = np.bincount(holes.ravel(), minlength=num + 1)
    small = [k for k in range(1, num + 1) if areas[k] < _LEAST_HOLE * mask.sum()]
    found: np.ndarray = mask | np.isin(holes, small)
    return found


def rings(mask: np.ndarray) -> list[np.ndarray]:
    """Return the boundary of the true cells of a grid as closed polygons (K, 2), with the true cells on the left."""
    padded = np.pad(mask, 1)
    steps: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (dx, dy), (ax, ay), (bx, by) in (
        ((-1, 0), (0, 1), (0, 0)),  # nothing to the left of a cell: down its left side
        ((1, 0), (1, 0), (1, 1)),
        ((0, -1), (0, 0), (1, 0)),
        ((0, 1), (1, 1), (0, 1)),
    ):
        other = np.roll(padded, (-dx, -dy), axis=(0, 1))
        for x, y in np.argwhere(padded & ~other) - 1:
            steps.setdefault((int(x) + ax, int(y) + ay), []).append((int(x) + bx, int(y) + by))
    found = []
    while steps:
        start = next(iter(steps))
        ring, here = [start], start
        while True:
            ways = steps[here]
            there = ways.pop()
            if not ways:
                del steps[here]
            if there == start:
                break
            ring.append(there)
            here = there
        found.append(np.array(ring, np.float64))
    return found


def _smooth(ring: np.ndarray) -> np.ndarray:
    """Smooth the steps of an outline by a moving mean over corners, keeping every other corner."""
    reach = min(_REACH, (len(ring) - 1) // 4)
    mean: np.ndarray = np.mean([np.roll(ring, k, axis=0) for k in range(-reach, reach + 1)], axis=0)
    found = mean[::2] if len(mean) > 8 else mean
    return found
