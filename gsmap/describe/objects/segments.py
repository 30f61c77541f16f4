"""Segment a surface into objects such as furniture, lamps and pictures; the remaining surface is the building.

Floor, ceiling and walls are removed (`structure`). An object on a wall is separated from the wall by depth or colour,
and from objects in front of the wall by the neighbours of its rim. The remaining surface is split into connected
components.
"""

from __future__ import annotations

import numpy as np

from gsmap._native import local_planes as native_planes
from gsmap.describe.objects.structure import Structure, components, find_structure
from gsmap.geometry.boxes import are_finite, box_around
from gsmap.geometry.cells import cell_labels, group_means
from gsmap.geometry.colour import srgb_to_lab
from gsmap.geometry.directions import level_frame
from gsmap.geometry.neighbours import nearest_neighbours, nearest_of
from gsmap.geometry.rotations import quats_to_matrices
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.types import Gaussians, Segments
from gsmap.types.views import PointCloud

VERSION = 2

_NEIGHBOURS = 12
_SAMPLE_M = 0.08  # edge of the cells of a segment's samples, finer than the cells in which captures are compared
_MAX_EXTENT_M = 10_000.0  # a scene larger than this, or of a wrong unit, has no furniture to segment
_BAND_M = 0.25  # the colour of a wall is estimated for squares of this size,
_AROUND_M = 1.5  # from the wall up to this far to either side at the same height: pictures are narrower
_LAYER_M = 0.02  # points whose distances from a wall differ by more are on different surfaces
_SOLE_M = 0.14  # only trims and door frames reach lower than this; hanging objects do not
_LINKED = 8  # of these, the neighbours that may be in the same segment


_MAX_POINTS = 150_000  # the surface is thinned to about this many points
_LINK = 2.2  # neighbours may be in one segment up to this many times their spacing apart,
_LINK_MIN_M = 0.04  # always up to this distance,
_LINK_MAX_M = 0.12  # and never farther than this
_FLOOR_M = 0.03  # points lower than this are the floor
_CEILING_M = 0.15  # points nearer to the ceiling than this are the ceiling
_WALL_M = 0.03  # points nearer to a wall's plane than this are the wall, unless their colour differs
_HANG_M = 0.12  # an object farther in front of a wall than this does not hang on it
_WALL_LAB = 17.0  # a colour that differs more (L*a*b*) from the wall's colour at this height is not the wall's
_CORE = 0.65  # a core point of a patch has this share of its neighbours on the wall in the patch
_STANDS_FREE = 0.2  # largest share of a hanging patch's rim that leads to objects in front of the wall
_MIN_POINTS = 20  # segments with fewer surface points are dropped
_MIN_AREA_M2 = 0.03  # smaller hanging segments are dropped
_PLANE_M = 0.025  # neighbours at this distance from a Gaussian's plane count 0.6 for its normal
_ASSIGN_M = 0.06  # Gaussians off the surface join the segment of the nearest surface within this distance


def find_segments(gaussians: Gaussians, cloud: PointCloud, up: np.ndarray | None, unit_m: float) -> Segments:
    """Segment a capture into physical objects, the largest first; empty if the vertical is unknown.

    The result is deterministic for Gaussians in the same order. It takes half a CPU second for 50,000 Gaussians.

    Args:
        gaussians: Gaussians in any frame and unit.
        cloud: surface of the Gaussians (`gsmap.describe.cloud.surface_cloud`).
        up: (3,) direction against gravity in the same frame.
        unit_m: metres per unit of the frame.
    """
    members = _members(gaussians, cloud, up, unit_m)
    count = int(members.max(initial=-1)) + 1
    rows = np.flatnonzero(members >= 0)
    of = members[rows]
    means = gaussians.means[rows].astype(np.float64)
    colours = srgb_to_lab(np.clip(rgb_of_sh0(gaussians.sh[rows, 0]), 0.0, 1.0))
    sizes = np.bincount(of, minlength=count)
    starts = np.cumsum(sizes) - sizes
    order = np.argsort(of.astype(np.uint16) if count < 2**16 else of, kind="stable")  # short keys are sorted by digits
    ordered, parts = means[order], np.split(colours[order], starts[1:]) if count else []
    # One sample per cell suffices for the shape of a segment.
    cells = np.floor(means * unit_m / _SAMPLE_M)
    labels, counts = cell_labels(np.column_stack([of, cell_labels(cells)[0]]))
    of_cell = np.empty(len(counts), np.int64)
    of_cell[labels] = of
    return Segments(
        members,
        group_means(means, of, sizes),
        np.stack([bound.reduceat(ordered, starts) if count else ordered for bound in (np.minimum, np.maximum)], axis=1),
        np.array([np.median(part, axis=0) for part in parts]).reshape(-1, 3),
        group_means(means, labels, counts),
        group_means(colours.astype(np.float64), labels, counts),
        np.bincount(of_cell, minlength=count),
        unit_m,
    )


def _members(gaussians: Gaussians, cloud: PointCloud, up: np.ndarray | None, unit_m: float) -> np.ndarray:
    """Return the segment (N,) int32 of each Gaussian, -1 for none."""
    out = np.full(len(gaussians), -1, np.int32)
    if up is None or len(cloud) < 4 * _NEIGHBOURS:
        return out
    level = level_frame(up)
    rows = _thinned(cloud)
    points = cloud.points[rows] @ level.T * unit_m
    low, high = box_around(points)
    if (high - low).max() > _MAX_EXTENT_M:
        return out
    areas = cloud.areas[rows] * unit_m**2 * (len(cloud) / len(rows))
    distances, neighbours = nearest_neighbours(points, _NEIGHBOURS + 1)
    normals, planarity = _normals(gaussians, cloud.index[rows], points, neighbours, level)
    structure = find_structure(points, normals, planarity, areas, neighbours)
    lab = cloud.lab[rows].astype(np.float64)
    surface = _Surface(points, lab, areas, distances, neighbours, structure)
    segments = _numbered(surface.labels())
    out[cloud.index[rows]] = segments
    # Remaining Gaussians, opaque or not, join the segment (or the building) whose surface is nearest.
    others = are_finite(gaussians.means)
    others[cloud.index[rows]] = False
    rest = np.flatnonzero(others)
    at = gaussians.means.take(rest, axis=0).astype(np.float64) @ level.T * unit_m
    distance, nearest = nearest_of(points, at, _ASSIGN_M)
    near = np.isfinite(distance)
    out[rest[near]] = segments[nearest[near]]
    return out


def _thinned(cloud: PointCloud) -> np.ndarray:
    """Select rows of the cloud, one per grid cell, so that about `_MAX_POINTS` are left; all rows of a small cloud."""
    if len(cloud) <= _MAX_POINTS:
        return np.arange(len(cloud))
    cell = float(np.sqrt(cloud.areas.sum() / _MAX_POINTS))
    labels, counts = cell_labels(np.floor((cloud.points - box_around(cloud.points)[0]) / cell))
    first = np.empty(len(counts), np.int64)
    first[labels[::-1]] = np.arange(len(cloud))[::-1]
    return np.sort(first)


def _normals(
    gaussians: Gaussians, index: np.ndarray, points: np.ndarray, neighbours: np.ndarray, level: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the normals (N, 3), in the level frame, and the planarity (N,) of a surface.

    The principal axes of a neighbourhood would mix both sides of a thin wall, so neighbours are weighted by their
    distance to the plane of the flat Gaussian itself.
    """
    scales = gaussians.scales[index]
    shortest = np.argmin(scales, axis=1)
    own = quats_to_matrices(gaussians.quats[index])[np.arange(len(index)), :, shortest] @ level.T
    ordered = np.sort(scales, axis=1)
    is_flat = ordered[:, 0] < 0.5 * ordered[:, 1]
    rough = np.where(is_flat[:, None], own, native_planes(points, neighbours)[0])
    normals, planarity = native_planes(points, neighbours, rough, _PLANE_M)
    return normals, planarity


class _Surface:
    """A surface with its building structure, ready to be segmented; points are in metres, z up."""

    def __init__(
        self,
        points: np.ndarray,
        lab: np.ndarray,
        areas: np.ndarray,
        distances: np.ndarray,
        neighbours: np.ndarray,
        structure: Structure,
    ) -> None:
        self.points, self.lab, self.areas, self.structure = points, lab, areas, structure
        self.count = len(points)
        self.distances, self.neighbours = distances, neighbours
        self.spacing = distances[:, 8] / 1.6  # the eighth neighbour of points that lie evenly on a plane

    def labels(self) -> np.ndarray:
        """Return the (N,) segment of each point, -1 for the building."""
        heights, building = self.structure.heights_m, self.structure
        shell = heights < _FLOOR_M
        if building.has_ceiling:
            shell |= heights > building.ceiling_m - _CEILING_M
        wall, off = self._nearest_walls(~shell)
        by_wall = ~shell & (wall >= 0)
        distinct = by_wall & ((np.abs(off) > _WALL_M) | self._foreign_colour(wall, off, by_wall))
        hanging, patches = self._hanging(~shell & ~by_wall, distinct, wall)
        # Points near a wall that are in no hanging patch belong to the wall, or to the back of an object in front of
        # it.
        free = ~shell & (~by_wall | (distinct & (patches < 0) & (np.abs(off) > _WALL_M)))
        rows = np.flatnonzero(free)
        beside, near = self._linked(rows, _LINKED)
        labels = np.where(free, self._components(rows, beside, near & free[beside]), -1)
        labels = self._with_floating(labels)
        return np.where(hanging >= 0, hanging + self.count, labels)

    def _linked(self, rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the (R, count) nearest neighbours of some points, and a mask of those near enough for one segment."""
        beside = self.neighbours[rows, 1 : count + 1]
        reach = _LINK * np.minimum(self.spacing[rows, None], self.spacing[beside])
        return beside, self.distances[rows, 1 : count + 1] < np.clip(reach, _LINK_MIN_M, _LINK_MAX_M)

    def _components(self, rows: np.ndarray, beside: np.ndarray, joined: np.ndarray) -> np.ndarray:
        """Return the (N,) connected component of each point, where some neighbours (R, K) of the rows are joined."""
        return components(self.count, rows[np.nonzero(joined)[0]], beside[joined])

    def _nearest_walls(self, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the (N,) wall near each point, -1 for none, and the signed distance of the point from it."""
        wall, off = np.full(self.count, -1), np.full(self.count, np.inf)
        for i, plane in enumerate(self.structure.walls):
            distance = self.points[:, :2] @ plane.normal - plane.offset_m
            nearer = inside & (np.abs(distance) < np.minimum(np.abs(off), _HANG_M))
            nearer &= plane.inside(self.points)
            wall[nearer], off[nearer] = i, distance[nearer]
        return wall, off

    def _foreign_colour(self, wall: np.ndarray, off: np.ndarray, by_wall: np.ndarray) -> np.ndarray:
        """Return an (N,) mask of points of walls whose colour differs from most of the wall at the same height."""
        foreign = np.zeros(self.count, bool)
        rows = np.flatnonzero(by_wall & (np.abs(off) < _WALL_M))
        # The colour of a single Gaussian is noisy: average over neighbours at the same distance from the wall.
        mean, number = np.zeros((len(rows), 3)), np.zeros(len(rows))
        for beside in self.neighbours[rows].T:
            level = np.abs(off[beside] - off[rows]) < _LAYER_M
            mean += level[:, None] * self.lab[beside]
            number += level
        mean = (mean / number[:, None]).T
        along = np.empty(len(rows))
        for i, plane in enumerate(self.structure.walls):
            on = np.flatnonzero(wall[rows] == i)
            along[on] = self.points[rows[on], :2] @ plane.along
        band = np.floor(self.structure.heights_m[rows] / _BAND_M)
        order = np.lexsort((along, band, wall[rows]))
        mean, along, band, place = mean[:, order], along[order], band[order], np.floor(along[order] / _BAND_M)
        bands = _runs(wall[rows[order]], band)
        expected = np.empty_like(mean)
        for start, end in bands:
            for first, last in _runs(place[start:end]) + start:
                gap = along[start:end] - (place[first] + 0.5) * _BAND_M
                low, high = start + np.searchsorted(gap, -_AROUND_M, "right"), start + np.searchsorted(gap, _AROUND_M)
                half, odd = divmod(high - low, 2)
                middle = np.partition(mean[:, low:high], (half - 1 + odd, half), axis=1)[:, [half - 1 + odd, half]]
                expected[:, first:last] = middle.sum(1, keepdims=True) / 2
        foreign[rows[order]] = np.sqrt(((mean - expected) ** 2).sum(0)) > _WALL_LAB
        return foreign

    def _hanging(self, free: np.ndarray, distinct: np.ndarray, wall: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return two (N,) labels of patches on walls, -1 for none: of the patches that hang and are kept, and of all
        that hang."""
        # Trims are thin, so find patches by their core points, then add the rim back to each core.
        rows = np.flatnonzero(wall >= 0)
        beside, near = self._linked(rows, _NEIGHBOURS)
        same = near & (wall[beside] == wall[rows, None])
        others = np.count_nonzero(same & distinct[beside], axis=1)
        core = np.zeros(self.count, bool)
        core[rows] = distinct[rows] & (others > _CORE * np.count_nonzero(same, axis=1))
        patch = np.where(core, self._components(rows, beside, same & core[rows, None] & core[beside]), -1)
        rim = same & (patch[rows, None] >= 0) & (distinct & ~core)[beside]
        patch[beside[rim][::-1]] = patch[rows[np.nonzero(rim)[0]][::-1]]
        # Look at the neighbours of the rims: those of a picture are on the wall, those of a bookshelf's back on the
        # bookshelf.
        rows = np.flatnonzero(patch >= 0)
        beside = self.neighbours[rows, 1:]
        rim = (patch[beside] != patch[rows, None]) & (self.distances[rows, 1:] < 1.25 * _LINK_MAX_M)
        leaving = np.bincount(patch[rows], np.count_nonzero(rim, axis=1), self.count)
        to_free = np.bincount(patch[rows], np.count_nonzero(rim & free[beside], axis=1), self.count)
        mine = patch >= 0
        size = np.bincount(patch[mine], self.areas[mine], minlength=self.count)
        number = np.bincount(patch[mine], minlength=self.count)
        lowest = np.full(self.count, np.inf)
        np.minimum.at(lowest, patch[mine], self.structure.heights_m[mine])
        hangs = (to_free < _STANDS_FREE * np.maximum(leaving, 1)) & (number >= 8)
        patch = np.where(mine & hangs[patch], patch, -1)
        keep = (size > _MIN_AREA_M2) & (lowest > _SOLE_M)
        return np.where((patch >= 0) & keep[patch], patch, -1), patch

    def _with_floating(self, labels: np.ndarray) -> np.ndarray:
        """Assign unsupported segments to the segment below them, such as a shade to its lamp."""
        heights = self.structure.heights_m
        rows = np.flatnonzero(labels >= 0)
        if not len(rows):
            return labels
        used, compact = np.unique(labels[rows], return_inverse=True)
        ordered = rows[np.argsort(compact, kind="stable")]
        starts = np.searchsorted(labels[ordered], used)
        low, high = (bound.reduceat(heights[ordered], starts) for bound in (np.minimum, np.maximum))
        plan = self.points[ordered, :2]
        boxes = np.stack([bound.reduceat(plan, starts) for bound in (np.minimum, np.maximum)], axis=1)
        middle = boxes.mean(1)
        carrier = np.arange(len(used))
        top = self.structure.ceiling_m
        for i in np.argsort(low, kind="stable"):
            if low[i] < 0.15 or high[i] > top - 2 * _CEILING_M - 0.05:
                continue
            below = (low < low[i] - 0.05) & (high > low[i] - 1.4) & (np.arange(len(used)) != i)
            for axis in range(2):
                below &= (boxes[:, 0, axis] - 0.03 < middle[i, axis]) & (boxes[:, 1, axis] + 0.03 > middle[i, axis])
            # The segment lies on the segment below, or within it.
            below &= (high < low[i] + 0.3) | (high >= high[i] - 0.05)
            if below.any():
                candidates = np.flatnonzero(below)
                best = candidates[np.argmin(np.abs(np.minimum(high[candidates], high[i]) - low[i]))]
                carrier[i] = carrier[best]
        out = labels.copy()
        out[rows] = used[carrier[compact]]
        return out


def _runs(*keys: np.ndarray) -> np.ndarray:
    """Return the (R, 2) starts and ends of the runs of rows with equal keys (N,)."""
    changes = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    bounds = np.concatenate([[0], np.flatnonzero(changes) + 1, [len(keys[0])]])
    return np.stack([bounds[:-1], bounds[1:]], axis=1)[: len(keys[0])]


def _numbered(labels: np.ndarray) -> np.ndarray:
    """Number labels by size from 0, the largest first; labels with too few points become -1."""
    used, compact, counts = np.unique(labels, return_inverse=True, return_counts=True)
    counts = np.where((used < 0) | (counts < _MIN_POINTS), 0, counts)
    rank = np.empty(len(used), np.int32)
    rank[np.argsort(-counts, kind="stable")] = np.arange(len(used))
    return np.where(counts[compact] > 0, rank[compact], -1).astype(np.int32)
