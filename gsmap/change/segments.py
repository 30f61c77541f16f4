"""Find changed segments and changes of colour from the surface cells of two captures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from gsmap.change.params import Params
from gsmap.change.surface_cells import CELL_M, SurfaceCells
from gsmap.compare.components import components, groups
from gsmap.compare.structure import planes
from gsmap.geometry.cells import cell_labels

_MIN_LOOKED_THROUGH = 0.5  # a neighbourhood is gone if at least this fraction of its views see it in free space
_CLUSTER_LINK_M = 0.1  # changed cells within this distance of each other belong to one segment
_MIN_PAINT = 1.9  # smallest strength of a reported change of colour, relative to the smallest that counts
_MAX_LEAK = 0.2  # largest fraction of it that continues beyond its edges; for light and shadow more continues
_SMOOTH_M = 0.08  # radius of the neighbourhood over which evidence is summed
_FEWEST_LOOKS = 3  # smallest number of views of a neighbourhood, or of pixels that compare its colour
_FAINT = 0.6  # smallest strength of a cell in a change of colour
_WHOLE = 0.33  # a segment counts as changed completely if at least this fraction of its judged cells changed
_BOX_M = 0.1  # except for cells farther outside of the box of its changed cells than this
_SAME_M = 0.15  # and for unchanged cells farther than this from changed ones
_LINK_M = 0.08  # largest distance between neighbouring cells of one segment
_RING_M = (0.04, 0.12)  # distances from a change of colour at which its surroundings begin and end
_MOST = 0.35
_MUCH, _MANY = 0.25, 100  # a shadow recolours less than this fraction of a segment and fewer than this many cells
_PLACE_M = 0.5
_DARK = 0.8  # with a larger fraction of lightness a change may be a shadow, a lamp, or a window at night
_COHERENT = 0.4  # a less coherent change may be a texture that two trainings show differently
# Largest distance from a change of colour on a wall to the object that appeared or disappeared in front of it.
_BEHIND_M = 0.2
_BEHIND = 0.5  # smallest fraction of the change within that distance
# Segments with fewer cells within this distance of a larger segment are fragments of it.
_SPLINTER, _SPLINTER_M = 60, 0.15


LIT_OTHERWISE = 0.028
"""With a larger `lighting_spread` the whole place is lit differently."""


@dataclass(frozen=True, eq=False)
class CellLabels:
    """Labels of the surface cells of one capture, smoothed over their neighbourhoods.

    Args:
        plane: (M,) plane of the building shell, -1 for none; numbered jointly in both captures.
        segment: (M,) connected segment off the shell, -1 on the shell.
        moved: (M,) mask of cells in free space of the other capture.
        painted: (M,) mask of cells on the other capture's surface, in another colour.
        judged: (M,) mask of cells that the other capture observed.
        strength: (M,) difference of colour, relative to the smallest that counts.
        offset_m: (M,) distance of the other capture's surface behind this one.
    """

    plane: np.ndarray
    segment: np.ndarray
    moved: np.ndarray
    painted: np.ndarray
    judged: np.ndarray
    strength: np.ndarray
    offset_m: np.ndarray


def classify_cells(sides: tuple[SurfaceCells, SurfaceCells]) -> tuple[CellLabels, CellLabels]:
    """Classify the surface cells of both captures as moved, repainted or unchanged."""
    points = np.concatenate([side.points for side in sides])
    normals = np.concatenate([side.normals for side in sides])
    plane = planes(points, normals, CELL_M / np.sqrt(2))
    cut = len(sides[0])
    return _judge(sides[0], plane[:cut]), _judge(sides[1], plane[cut:])


def _judge(side: SurfaceCells, plane: np.ndarray) -> CellLabels:
    through, on = side.around(side.through, _SMOOTH_M), side.around(side.on, _SMOOTH_M)
    moved = (through >= _FEWEST_LOOKS) & (through >= _MIN_LOOKED_THROUGH * (through + on)) & (side.through >= side.on)
    pixels = side.around(side.pixels, _SMOOTH_M)
    strength = side.around(side.strength * side.pixels, _SMOOTH_M) / np.maximum(pixels, 1)
    offset = side.around(side.offset_m * side.pixels, _SMOOTH_M) / np.maximum(pixels, 1)
    painted = ~moved & (pixels >= _FEWEST_LOOKS) & (strength >= _FAINT)
    plane = np.where(moved, -1, plane)  # cells in free space are not part of a wall
    segment = np.full(len(side), -1, dtype=np.int64)
    segment[plane < 0] = components(side.points[plane < 0], _LINK_M)
    judged = (side.through + side.on > 0) | (side.pixels > 0)
    return CellLabels(plane, segment, moved, painted, judged, strength, offset)


_NONE = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False)
class ChangedSegment:
    """A changed segment of one capture.

    Args:
        cells: (K,) all cells of the segment.
        moved, painted: cells in free space of the other capture, and cells that have another colour there.
        behind: cells of the shell behind the segment whose colour changed because of it.
    """

    cells: np.ndarray
    moved: np.ndarray
    painted: np.ndarray
    behind: np.ndarray = field(default_factory=lambda: _NONE)

    @property
    def changed(self) -> np.ndarray:
        return np.concatenate([self.moved, self.painted])


@dataclass(frozen=True, eq=False)
class ColourChange:
    """A change of colour on one surface, as both captures show it.

    Args:
        cells: cells of each capture.
        strength: mean strength, relative to the smallest that counts.
        leak: fraction of the change that continues around it.
        coherence: 1 if all cells changed equally, 0 if each changed differently.
        darkening: fraction of the change that is lightness, not hue.
        is_shell: the change is on a wall, floor or ceiling.
        share: fraction of its segment that the change covers, the smaller of both captures; 0 on the shell.
        area_m2: area of the surface.
    """

    cells: tuple[np.ndarray, np.ndarray]
    strength: float
    leak: float
    coherence: float
    darkening: float
    is_shell: bool
    share: float
    area_m2: float


def find_segments(side: SurfaceCells, cells: CellLabels, painted: np.ndarray, params: Params) -> list[ChangedSegment]:
    """Return the changed segments of one capture, largest first; ``painted`` (M,) is a mask of clearly recoloured
    cells."""
    fewest = max(2, round(params.min_area_m2 / CELL_M**2))
    changed = (cells.moved | painted) & (cells.segment >= 0)
    # At least one, so that -1 is a valid index if all cells are shell.
    count = max(int(cells.segment.max(initial=-1)) + 1, 1)
    total = np.bincount(cells.segment[cells.judged & (cells.segment >= 0)], minlength=count)
    share = np.bincount(cells.segment[changed], minlength=count) / np.maximum(total, 1)
    whole = (share >= _WHOLE)[cells.segment] & (cells.segment >= 0)
    # The changed part of a partly changed segment is cut out; a completely changed segment stays together, within the
    # box of its changed cells. Segments with too few cells join nearby changed cells.
    size = np.bincount(cells.segment[cells.segment >= 0], minlength=count)
    kind = np.where(whole & (size >= fewest)[cells.segment], cells.segment, -1)
    for segment in np.unique(kind[kind >= 0]):
        rows = np.flatnonzero(kind == segment)
        box = side.points[rows[changed[rows]]]
        outside = ((side.points[rows] < box.min(0) - _BOX_M) | (side.points[rows] > box.max(0) + _BOX_M)).any(1)
        apart = cKDTree(box).query(side.points[rows], distance_upper_bound=_SAME_M)[0]
        whole[rows[outside | (np.isinf(apart) & cells.judged[rows])]] = False
    found = []
    for group in groups(side.points, np.flatnonzero(changed | whole), _CLUSTER_LINK_M, fewest, kind):
        moved, tinted = group[cells.moved[group]], group[painted[group] & ~cells.moved[group]]
        if len(moved) + len(tinted) >= fewest:
            found.append(ChangedSegment(group, moved, tinted))
    return sorted(found, key=lambda t: (-len(t.cells), int(t.cells[0])))


def find_colour_changes(
    sides: tuple[SurfaceCells, SurfaceCells], cells: tuple[CellLabels, CellLabels], params: Params
) -> list[ColourChange]:
    """Cluster the recoloured cells of both captures; cells of one cluster are on the same plane, or off all planes."""
    rows = [np.flatnonzero(c.painted) for c in cells]
    points = np.concatenate([side.points[r] for side, r in zip(sides, rows, strict=True)])
    plane = np.concatenate([c.plane[r] for c, r in zip(cells, rows, strict=True)])
    fewest = max(2, round(params.min_area_m2 / CELL_M**2))
    found = []
    for group in groups(points, np.arange(len(points)), _CLUSTER_LINK_M, fewest, plane):
        parts = rows[0][group[group < len(rows[0])]], rows[1][group[group >= len(rows[0])] - len(rows[0])]
        if min(len(parts[0]), len(parts[1])) * 4 < fewest:  # both captures must show it
            continue
        strengths = np.concatenate([c.strength[p] for c, p in zip(cells, parts, strict=True)])
        at = int(plane[group[0]])
        leaks = [_leak(s, c, p, at) for s, c, p in zip(sides, cells, parts, strict=True)]
        colour = np.concatenate([side.colour[p] for side, p in zip(sides, parts, strict=True)])
        pixels = np.concatenate([side.pixels[p] for side, p in zip(sides, parts, strict=True)])
        if not pixels.any():  # no pixel compared these cells themselves
            continue
        mean, size = np.average(colour, axis=0, weights=pixels), np.average(np.abs(colour), axis=0, weights=pixels)
        hue, light = np.abs(mean[:2]).max(), abs(mean[2])
        found.append(
            ColourChange(
                parts,
                float(strengths.mean()),
                float(np.mean(leaks)),
                float(max(hue, light) / max(size.max(), 1e-6)),
                float(light / max(light + hue, 1e-6)),
                at >= 0,
                0.0 if at >= 0 else min(_share(c, p) for c, p in zip(cells, parts, strict=True)),
                len(group) / 2 * CELL_M**2,
            )
        )
    return found


def is_recoloured(paint: ColourChange, spread: float) -> bool:
    """Return whether a change of colour is paint, rather than lighting or a texture that two trainings show
    differently.

    Args:
        spread: spread of the lighting difference; see `lighting_spread`.
    """
    if not paint.is_shell and paint.share >= _MUCH and sum(map(len, paint.cells)) >= _MANY:
        less = 0.6 if paint.share >= _MOST and paint.coherence >= _COHERENT else 0.75
        return paint.strength >= less * _MIN_PAINT and paint.leak <= 2.5 * _MAX_LEAK
    least = _MIN_PAINT
    if spread > LIT_OTHERWISE:
        least *= 1.6
    if paint.darkening > _DARK and paint.is_shell:
        least *= 1.8
    if paint.coherence < _COHERENT:
        least *= 1.6
    return paint.strength >= least and paint.leak <= _MAX_LEAK


def lighting_spread(sides: tuple[SurfaceCells, SurfaceCells]) -> float:
    """Measure the difference in lighting of two captures of a place.

    The result is the robust spread, over cubes of half a metre, of the colour differences that remain after exposure
    balancing.
    """
    spreads = []
    for side in sides:
        label, counts = cell_labels(np.floor(side.points / _PLACE_M))
        pixels = np.bincount(label, side.pixels, len(counts))
        sums = np.stack([np.bincount(label, side.colour[:, k] * side.pixels, len(counts)) for k in range(3)], axis=1)
        mean = sums[pixels > 0] / pixels[pixels > 0, None]
        if len(mean):
            spreads.append(1.4826 * np.median(np.abs(mean - np.median(mean, axis=0)), axis=0).max())
    return float(max(spreads, default=0.0))


def _share(cells: CellLabels, rows: np.ndarray) -> float:
    """Return the fraction of a segment that the cells at ``rows`` cover; it is the segment to which most of these cells
    belong."""
    if not len(rows):
        return 0.0
    segment = int(np.bincount(cells.segment[rows]).argmax())
    whole = int(((cells.segment == segment) & cells.judged).sum())
    return float((cells.segment[rows] == segment).sum() / max(whole, 1))


def _leak(side: SurfaceCells, cells: CellLabels, inside: np.ndarray, plane: int) -> float:
    """Return the fraction of a change of colour that continues around it: paint ends at an edge, shadows fade."""
    if not len(inside):
        return 0.0
    around = (side.pixels > 0) & ~cells.moved & ~cells.painted & (cells.plane == plane)
    outside = np.flatnonzero(around)
    distance, _ = cKDTree(side.points[inside]).query(side.points[outside], distance_upper_bound=_RING_M[1])
    ring = outside[np.isfinite(distance) & (distance > _RING_M[0])]
    if len(ring) < 6:
        return 0.0
    return float(np.median(cells.strength[ring]) / max(np.median(cells.strength[inside]), 1e-6))


def segment_in_front(
    segments: list[ChangedSegment], sides: tuple[SurfaceCells, SurfaceCells], paint: ColourChange, which: list[int]
) -> int | None:
    """Return the index of the segment that appeared or disappeared in front of a change of colour on a wall; None
    without one.

    Args:
        which: capture of each segment, 0 for the older and 1 for the newer.
    """
    owners = [k for k, t in enumerate(segments) if len(t.moved)]
    if not owners:
        return None
    points = [sides[which[k]].points[segments[k].cells] for k in owners]
    owner = np.repeat(owners, [len(p) for p in points])
    at = np.concatenate([side.points[p] for side, p in zip(sides, paint.cells, strict=True)])
    distance, row = cKDTree(np.concatenate(points)).query(at, distance_upper_bound=_BEHIND_M)
    near = np.isfinite(distance)
    if near.mean() < _BEHIND:
        return None
    return int(np.bincount(owner[row[near]]).argmax())


def with_background(segment: ChangedSegment, cells: np.ndarray) -> ChangedSegment:
    """Return the segment with recoloured cells on the wall behind it."""
    return replace(segment, behind=np.union1d(segment.behind, cells))


def absorb_fragments(segments: list[ChangedSegment], side: SurfaceCells) -> list[ChangedSegment]:
    """Merge small segments into nearby larger segments; the result is sorted by size, largest first."""
    left = sorted(segments, key=lambda t: (-len(t.cells), int(t.cells[0])))
    kept: list[ChangedSegment] = []
    for segment in left:
        near = _nearest(segment, kept, side) if len(segment.cells) < _SPLINTER else None
        if near is None:
            kept.append(segment)
        else:
            kept[near] = union_of(kept[near], segment)
    return kept


def _nearest(segment: ChangedSegment, others: list[ChangedSegment], side: SurfaceCells) -> int | None:
    for k, other in enumerate(others):
        distance, _ = cKDTree(side.points[other.cells]).query(
            side.points[segment.cells], distance_upper_bound=_SPLINTER_M
        )
        if np.isfinite(distance).mean() >= 0.5:
            return k
    return None


def union_of(a: ChangedSegment, b: ChangedSegment) -> ChangedSegment:
    """Return the union of two segments of one capture."""
    return ChangedSegment(
        np.union1d(a.cells, b.cells),
        np.union1d(a.moved, b.moved),
        np.union1d(a.painted, b.painted),
        np.union1d(a.behind, b.behind),
    )


def split_segment(segment: ChangedSegment, rows: np.ndarray) -> tuple[ChangedSegment, ChangedSegment]:
    """Split a segment into the part with the cells ``rows`` and the rest."""
    inside = np.isin(segment.cells, rows)
    both = []
    for cells in (segment.cells[inside], segment.cells[~inside]):
        both.append(ChangedSegment(cells, np.intersect1d(segment.moved, cells), np.intersect1d(segment.painted, cells)))
    return both[0], replace(both[1], behind=segment.behind)
