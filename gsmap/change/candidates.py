"""Detect changes from the labelled surface cells of two captures."""

from __future__ import annotations

from functools import reduce

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from gsmap.change.kinds import DetectedChange, are_separate, classify_colour_change, classify_in_place
from gsmap.change.params import Params
from gsmap.change.relocations import find_relocations
from gsmap.change.segments import (
    CellLabels,
    ChangedSegment,
    absorb_fragments,
    find_colour_changes,
    find_segments,
    is_recoloured,
    segment_in_front,
    split_segment,
    union_of,
    with_background,
)
from gsmap.change.surface_cells import SurfaceCells
from gsmap.compare import CaptureViews

_IN_PLACE_M = 0.1  # largest distance between cells of two captures at the same place
_IN_PLACE = 0.3  # smallest fraction of the smaller segment that is at the place of the larger one
# A segment is two adjacent objects if a fraction in this range is at the place of another segment.
_SPLIT = (0.15, 0.85)
_FEWEST_OF_PART = 60


def find_changes(
    both: tuple[SurfaceCells, SurfaceCells],
    cells: tuple[CellLabels, CellLabels],
    unlike: float,
    views: tuple[CaptureViews, CaptureViews],
    params: Params,
) -> list[DetectedChange]:
    """Detect all changes between two captures, without their confidence.

    Args:
        unlike: spread of the lighting difference; see `gsmap.change.segments.lighting_spread`.
    """
    tints = [p for p in find_colour_changes(both, cells, params) if is_recoloured(p, unlike)]
    clear = [np.zeros(len(side), dtype=bool) for side in both]
    for paint in tints:
        if not paint.is_shell:
            for mask, rows in zip(clear, paint.cells, strict=True):
                mask[rows] = True
    older, newer = (find_segments(both[k], cells[k], clear[k], params) for k in (0, 1))
    found = []
    for paint in tints:
        if not paint.is_shell:
            continue
        everything, which = older + newer, [0] * len(older) + [1] * len(newer)
        k = segment_in_front(everything, both, paint, which)
        if k is None:
            found.append(DetectedChange(classify_colour_change(paint, both), (None, None), paint))
        elif k < len(older):
            older[k] = with_background(older[k], paint.cells[0])
        else:
            newer[k - len(older)] = with_background(newer[k - len(older)], paint.cells[1])
    older, newer = absorb_fragments(older, both[0]), absorb_fragments(newer, both[1])
    moves, older, newer = find_relocations(older, newer, both, cells, views, params)
    for move in moves:
        evidence = {"fit": move.score, "next_fit": move.runner_up}
        found.append(
            DetectedChange("moved", (move.older, move.newer), None, move.S_after_before, move.symmetry, evidence)
        )
    older, newer = _split(older, newer, both, 0), _split(newer, older, both, 1)
    return found + _in_place(older, newer, both)


def _split(
    segments: list[ChangedSegment], others: list[ChangedSegment], both: tuple[SurfaceCells, SurfaceCells], which: int
) -> list[ChangedSegment]:
    """Split each segment of which only a part is replaced by a segment of the other capture."""
    out = []
    for segment in segments:
        points = both[which].points[segment.cells]
        for other in others:
            at = both[1 - which].points[other.cells]
            low, high = np.quantile(at, 0.02, axis=0) - 0.08, np.quantile(at, 0.98, axis=0) + 0.08
            inside = ((points > low) & (points < high)).all(1)
            if _SPLIT[0] < inside.mean() < _SPLIT[1]:
                here, rest = split_segment(segment, segment.cells[inside])
                gone = len(rest.moved) / max(len(rest.changed), 1)
                if len(rest.cells) >= _FEWEST_OF_PART and gone > 0.5 > len(here.moved) / max(len(here.changed), 1):
                    out += [here, rest]
                    break
        else:
            out.append(segment)
    return out


def _in_place(
    older: list[ChangedSegment], newer: list[ChangedSegment], both: tuple[SurfaceCells, SurfaceCells]
) -> list[DetectedChange]:
    """Classify the remaining segments as disappeared, appeared, replaced or recoloured."""
    same = np.zeros((len(older), len(newer)), dtype=bool)
    for i, segment in enumerate(older):
        tree = cKDTree(both[0].points[segment.cells])
        for j, other in enumerate(newer):
            near = np.isfinite(tree.query(both[1].points[other.cells], distance_upper_bound=_IN_PLACE_M)[0]).sum()
            same[i, j] = near >= _IN_PLACE * min(len(segment.cells), len(other.cells))
    graph = np.zeros((len(older) + len(newer),) * 2, dtype=bool)
    graph[: len(older), len(older) :] = same
    labels = connected_components(graph, directed=False)[1]
    found = []
    for k in range(int(labels.max(initial=-1)) + 1):
        mine = [older[i] for i in np.flatnonzero(labels[: len(older)] == k)]
        theirs = [newer[j] for j in np.flatnonzero(labels[len(older) :] == k)]
        a, b = (reduce(union_of, segments) if segments else None for segments in (mine, theirs))
        if a is not None and b is not None and are_separate(a, b, both):
            found += [DetectedChange("disappeared", (a, None)), DetectedChange("appeared", (None, b))]
        else:
            found.append(DetectedChange(classify_in_place(a, b, both), (a, b)))
    return found
