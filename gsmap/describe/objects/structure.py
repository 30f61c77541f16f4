"""Find the structure of a building (floor, ceiling and walls), separated from its contents by geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_BIN_M = 0.02  # bin of a histogram of heights, above the noise of a surface and below the unevenness of a floor
_STEP_M = 0.1  # bin of a histogram along a wall
_CEILING_M = 1.9  # a horizontal plane less than this above the floor is a table
_PATCH_M2 = 0.3  # smaller upright patches are no evidence for a wall
_REACH_M = 0.3  # a wall must reach to within this distance of the ceiling
_HIDDEN_M = 2.5  # largest gap in a wall that furniture may hide; a plane that continues behind it is the same wall
_FLAT_M = 0.02  # largest distance from the plane of neighbours on one plane
_PARALLEL = 0.96  # smallest cosine between the normals of neighbours on one plane


@dataclass(frozen=True, eq=False)
class Wall:
    """A stretch of a vertical plane, in the level frame.

    Args:
        normal: (2,) horizontal unit normal, of arbitrary sign.
        offset_m: offset of the plane along the normal.
        span_m: (low, high) extent along `along`.
    """

    normal: np.ndarray
    offset_m: float
    span_m: tuple[float, float]

    @property
    def along(self) -> np.ndarray:
        """(2,) unit vector along the wall."""
        return np.array([-self.normal[1], self.normal[0]])

    def inside(self, points: np.ndarray, margin_m: float = _STEP_M) -> np.ndarray:
        """Return an (N,) mask of points in front of or behind the stretch."""
        along = points[:, :2] @ self.along
        return np.asarray((along > self.span_m[0] - margin_m) & (along < self.span_m[1] + margin_m))


@dataclass(frozen=True, eq=False)
class Structure:
    """Floor, ceiling and walls of a building.

    Args:
        heights_m: (N,) heights of the points above the floor.
        ceiling_m: height of the ceiling, or of the highest points if there is no ceiling.
        has_ceiling: True if a ceiling was found.
        walls: stretches of planes that reach up to the ceiling.
    """

    heights_m: np.ndarray
    ceiling_m: float
    has_ceiling: bool
    walls: tuple[Wall, ...]


def components(count: int, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the (count,) connected component of each node; edges join nodes ``a`` and ``b``."""
    from scipy.sparse import coo_matrix  # imported here, as the recipe key does not need it
    from scipy.sparse.csgraph import connected_components

    joined = coo_matrix((np.ones(len(a), bool), (a, b)), shape=(count, count))
    labels: np.ndarray = connected_components(joined, directed=False)[1]
    return labels


def find_structure(
    points: np.ndarray, normals: np.ndarray, planarity: np.ndarray, areas: np.ndarray, neighbours: np.ndarray
) -> Structure:
    """Find floor, ceiling and walls of a place.

    The floor is the lowest large horizontal plane, the ceiling the highest. The floor is fitted, because the vertical
    is off by a fraction of a degree. A wall is an upright patch, grown over neighbours on one plane, that reaches up to
    the ceiling; it extends as far as points on its plane continue.

    Args:
        points: (N, 3) points in metres, z up.
        normals: (N, 3) normals of the surface, sign arbitrary.
        planarity: (N,) flatness of the neighbourhood in [0, 1].
        areas: (N,) area of surface that each point represents, in square metres.
        neighbours: (N, K) rows of the nearest points, each point itself first.
    """
    heights, ceiling, has_ceiling = _heights(points, np.abs(normals[:, 2]) > 0.95, areas)
    upright = (np.abs(normals[:, 2]) < 0.2) & (planarity > 0.3) & (heights > _FLAT_M) & (heights < ceiling + _REACH_M)
    rows, row_of = np.flatnonzero(upright), np.cumsum(upright) - 1
    at, facing = np.ascontiguousarray(points.T), np.ascontiguousarray(normals.T)  # sums along rows of three are slow
    links = []
    for b in np.ascontiguousarray(neighbours[rows, 1:].T):
        both = np.flatnonzero(upright[b])
        a, b = rows[both], b[both]
        step, one, other = at.take(a, 1) - at.take(b, 1), facing.take(a, 1), facing.take(b, 1)
        flat = (np.abs(_dot(one, other)) > _PARALLEL) & (np.abs(_dot(step, one)) < _FLAT_M)
        flat &= np.abs(_dot(step, other)) < _FLAT_M
        links.append(np.stack([both[flat], row_of[b[flat]]]))
    patch = components(len(rows), *np.concatenate(links, axis=1))
    size = np.bincount(patch, areas[rows])
    counts = np.bincount(patch)
    by_patch, ends = rows[np.argsort(patch, kind="stable")], np.cumsum(counts)
    plan, sideways = np.ascontiguousarray(points[:, :2]), np.ascontiguousarray(normals[:, :2])
    walls: list[Wall] = []
    for label in np.argsort(-size, kind="stable"):
        if size[label] < _PATCH_M2:
            break
        rows = by_patch[ends[label] - counts[label] : ends[label]]
        if np.quantile(heights[rows], 0.98) < ceiling - _REACH_M:
            continue
        if not any(_is_of(wall, points[rows]) for wall in walls):
            wall = _wall(plan, sideways, areas, rows)
            if wall is not None:
                walls.append(wall)
    return Structure(heights, ceiling, has_ceiling, tuple(walls))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the (N,) dot products of the columns of two (3, N) arrays."""
    out: np.ndarray = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


def _heights(points: np.ndarray, flat: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, float, bool]:
    """Compute heights above the fitted floor (N,), the height of the ceiling, and whether there is a ceiling."""
    z = points[:, 2]
    low = float(z.min())
    if not flat.any():
        return z - np.quantile(z, 0.01), float(np.ptp(np.quantile(z, [0.01, 0.99]))), False
    lying = np.convolve(np.bincount(((z[flat] - low) / _BIN_M).astype(int), areas[flat]), np.ones(3), "same")
    large = np.flatnonzero(lying > 0.25 * lying.max())
    first, last = large[0], large[-1]
    floor = low + _BIN_M * (first + int(np.argmax(lying[first : first + 6])) + 0.5)
    ceiling = low + _BIN_M * (last - int(np.argmax(lying[max(last - 5, 0) : last + 1][::-1])) + 0.5) - floor
    heights = z - floor
    plan = np.column_stack([points[:, :2], np.ones(len(points))])
    for within in (0.08, 0.03, 0.03):
        on = flat & (np.abs(heights) < within)
        if np.count_nonzero(on) < 10:
            break
        heights = heights - plan @ np.linalg.lstsq(plan[on], heights[on], rcond=None)[0]
    if ceiling < _CEILING_M:
        return heights, float(np.quantile(heights, 0.99)), False
    return heights, float(ceiling), True


def _is_of(wall: Wall, points: np.ndarray) -> bool:
    off = np.abs(points[:, :2] @ wall.normal - wall.offset_m) < 2 * _FLAT_M
    return bool((off & wall.inside(points)).mean() > 0.8)


def _wall(plan: np.ndarray, sideways: np.ndarray, areas: np.ndarray, rows: np.ndarray) -> Wall | None:
    """Fit a plane to all points of a patch, and its extent; return None if the patch is a pillar.

    Args:
        plan, sideways: (N, 2) horizontal coordinates of all points and of their normals.
        areas: (N,) areas.
        rows: the patch.
    """
    patch = plan[rows]
    middle = patch.mean(0)
    normal = np.linalg.eigh((patch - middle).T @ (patch - middle))[1][:, 0]
    offset, span = middle @ normal, np.zeros(2)
    for _ in range(3):
        along = np.array([-normal[1], normal[0]])
        span = np.quantile(patch @ along, [0.02, 0.98])
        near = np.flatnonzero(np.abs(plan @ normal - offset) < 1.5 * _FLAT_M)
        at = plan[near] @ along
        on = near[(np.abs(sideways[near] @ normal) > 0.9) & (at > span[0] - 0.2) & (at < span[1] + 0.2)]
        if len(on) < 10:
            break
        weight = areas[on]
        middle = np.average(plan[on], axis=0, weights=weight)
        centred = plan[on] - middle
        fitted = np.linalg.eigh((centred * weight[:, None]).T @ centred)[1][:, 0]
        normal = fitted * (np.sign(fitted @ normal) or 1.0)
        offset = middle @ normal
    if np.ptp(span) < 0.5:
        return None
    along = np.array([-normal[1], normal[0]])
    off = plan @ normal - offset
    on = np.flatnonzero(np.abs(off) < 2 * _FLAT_M)
    on = on[np.abs(sideways[on] @ normal) > 0.8]
    # The mode of the distances is the wall without the objects on it.
    bins, edges = np.histogram(off[on], bins=40, range=(-2 * _FLAT_M, 2 * _FLAT_M), weights=areas[on])
    peak = int(np.argmax(np.convolve(bins, np.ones(5), "same")))
    offset += 0.5 * (edges[peak] + edges[peak + 1])
    steps = np.floor(plan[on] @ along / _STEP_M).astype(int)
    low = steps.min()
    there = np.flatnonzero(np.bincount(steps - low, areas[on]) > 0.02) + low
    first, last = np.floor(span / _STEP_M).astype(int)
    for step in there[there > last]:
        if step - last > _HIDDEN_M / _STEP_M:
            break
        last = step
    for step in there[there < first][::-1]:
        if first - step > _HIDDEN_M / _STEP_M:
            break
        first = step
    return Wall(normal, float(offset), (first * _STEP_M, (last + 1) * _STEP_M))
