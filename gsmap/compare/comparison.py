"""Compare two captures by renders of both from the cameras of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from gsmap._native import add_colours, count_looks
from gsmap.compare.capture_views import (
    MAX_TOLERANCE_M,
    MIN_TOLERANCE_M,
    NEAREST_M,
    CaptureViews,
    ProjectedPoints,
    View,
    make_view,
    observed_from,
    project_points,
)
from gsmap.compare.colours import Balance, balance, colours_differ
from gsmap.compare.evidence import REPAINTED, ChangeEvidence, EvidenceCounts
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.render import ChunkIndex, render
from gsmap.types import Gaussians

UNSURE, AGREE, COLOUR, OTHER_IN_FRONT, OTHER_BEHIND = 0, 1, 2, 3, 4
"""Outcomes of a pixel of one capture's own view. ``UNSURE``: one capture shows no surface, an edge, or a poorly
observed surface. ``AGREE``: one surface in one colour. ``COLOUR``: one surface in two colours. ``OTHER_IN_FRONT``: the
other capture has a surface in free space of this capture. ``OTHER_BEHIND``: this capture has a surface in front of the
other capture's surface. That is no evidence of change, because the other cameras may never have observed the place from
here."""


_TOLERANCE_SIGMAS = 3.5  # tolerance in robust standard deviations of agreeing depths
_TOLERANCE_PER_DEPTH = 0.01  # further tolerance in metres per metre of depth


@dataclass(frozen=True, eq=False)
class ComparedView:
    """A view of one capture and the render of the other capture from the same camera.

    Args:
        own: the capture's own view.
        other: the surfaces of the other capture from the same camera.
        outcome: (H, W) uint8, one of the five outcomes.
        one: (H, W) mask of pixels where both captures show the same surface, well observed or not.
        covered: (H, W) mask of pixels where the other capture has a surface in front, perhaps at an edge.
        chroma, lightness: (H, W, 2) and (H, W) float32 differences of colour, newer minus older.
    """

    own: View
    other: View
    outcome: np.ndarray
    one: np.ndarray
    covered: np.ndarray
    chroma: np.ndarray
    lightness: np.ndarray


@dataclass(frozen=True, eq=False)
class Observations:
    """Two captures as the cameras of both show them.

    Args:
        older_views, newer_views: each capture's own views, with renders of the other capture.
        balance: map from colours of the older capture to colours of the newer capture.
        tolerance_m: (base, slope); two depths differ if their difference exceeds ``base + slope * depth``.
    """

    older_views: tuple[ComparedView, ...]
    newer_views: tuple[ComparedView, ...]
    balance: Balance
    tolerance_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Comparison(Observations):
    """Result of comparing two captures.

    Args:
        older, newer: evidence on the Gaussians of each capture, from the views of the other capture.
    """

    older: ChangeEvidence
    newer: ChangeEvidence


def observe(older: CaptureViews, newer: CaptureViews) -> Observations:
    """Render the surfaces of each of two captures, in one metric frame, from the cameras of the other capture.

    Floaters are left out, because they would hide surfaces from positions where the capture has no cameras.
    """
    surfaces = {id(one): _surface(one) for one in (older, newer)}
    crossed = [
        [
            (own.views[i], own.sure[i], _seen_by(own.views[i], *surfaces[id(other)], other))
            for i in range(len(own.views))
        ]
        for own, other in ((older, newer), (newer, older))
    ]
    tolerance = _tolerance([pair for pairs in crossed for pair in pairs])
    line = _line(crossed, tolerance)
    pictured = [
        tuple(_outcomes(own, sure, other, line, sign, tolerance) for own, sure, other in pairs)
        for pairs, sign in zip(crossed, (-1, 1), strict=True)
    ]
    return Observations(pictured[0], pictured[1], line, tolerance)


def count_looks_at(
    points: np.ndarray, by: CaptureViews, pictures: Sequence[ComparedView], tolerance_m: tuple[float, float]
) -> EvidenceCounts:
    """Count how points (N, 3) of one capture lie relative to the surfaces in the views of another capture.

    Args:
        by: the other capture; ``pictures`` are its views.
        tolerance_m: see `Observations`.
    """
    counts = EvidenceCounts(len(points))
    for picture, sure in zip(pictures, by.sure, strict=True):
        _count(counts, project_points(points, picture.own, NEAREST_M), picture, sure, tolerance_m)
    return counts


def compare(older: CaptureViews, newer: CaptureViews) -> Comparison:
    """Compare two captures in one metric frame, and classify every Gaussian of both."""
    from gsmap.compare.segments import (  # imports scipy, which the recipe key does not need
        SegmentedCapture,
        find_remnants,
        label_shells,
    )

    seen = observe(older, newer)
    both, pictures, tolerance = (older, newer), (seen.older_views, seen.newer_views), seen.tolerance_m
    tallies = [
        count_looks_at(of.gaussians.means, by, shown, tolerance)
        for of, by, shown in zip(both, both[::-1], pictures[::-1], strict=True)
    ]
    for tally, of, shown in zip(tallies, both, pictures, strict=True):
        for picture, own in zip(shown, of.placed, strict=True):
            _count_colour(tally, own, picture, tolerance)
    walls = label_shells([(one.gaussians.means, one.surface) for one in both])
    evidence = [
        tally.evidence(
            one.gaussians.means,
            one.surface,
            shell,
            other.gaussians.means[other.surface],
            len(other.views),
            seen.balance,
        )
        for tally, one, other, shell in zip(tallies, both, both[::-1], walls, strict=True)
    ]
    older_end, newer_end = (
        SegmentedCapture(
            one.gaussians.means,
            np.clip(rgb_of_sh0(one.gaussians.sh[:, 0]), 0, 1),
            found.segment,
            found.state >= REPAINTED,
            found.framed,
        )
        for one, found in zip(both, evidence, strict=True)
    )
    for found, rest in zip(evidence, find_remnants((older_end, newer_end)), strict=True):
        found.state[rest] = REPAINTED
    return Comparison(*pictures, seen.balance, tolerance, evidence[0], evidence[1])


def _surface(capture: CaptureViews) -> tuple[Gaussians, ChunkIndex, np.ndarray]:
    rows = np.flatnonzero(capture.surface)
    surface = capture.gaussians if len(rows) == len(capture.surface) else capture.gaussians[rows]
    return surface, ChunkIndex.build(surface), rows


def _seen_by(view: View, surface: Gaussians, index: ChunkIndex, rows: np.ndarray, capture: CaptureViews) -> View:
    """Render the surface of a capture into a view of another; only what the capture observed well is solid.

    That is a surface which several of its own views observe, from about this direction: the two faces of a thin wall
    lie within the tolerance of one surface, and the unobserved face would be compared by the colours of the other.

    Args:
        surface, index, rows: the Gaussians on surfaces, boxes of their chunks, and their rows in the capture.
    """
    seen = render(surface, view.camera, index=index)
    dominant = seen.dominant_id[0]
    whole = np.where(dominant >= 0, rows[np.maximum(dominant, 0)] if len(rows) else -1, -1).astype(np.int32)
    made = make_view(seen.colour[0], seen.alpha[0], seen.depth[0], whole, view.camera)
    shown = np.unique(dominant[dominant >= 0])
    observed = np.zeros(len(surface) + 1, dtype=bool)  # the last for no Gaussian, -1
    observed[shown] = observed_from(surface.means[shown], capture.directions[rows[shown]], view)
    observed[shown] &= capture.well_observed[rows[shown]]
    return replace(made, solid=made.solid & observed[dominant])


def _tolerance(pairs: list[tuple[View, np.ndarray, View]]) -> tuple[float, float]:
    """Return the depth tolerance, base and slope, from the scatter of surfaces that agree."""
    found = []
    for own, sure, other in pairs:
        both = (sure & other.solid)[::2, ::2]
        off = np.abs(other.depth - own.depth)[::2, ::2][both]
        limit = MAX_TOLERANCE_M + _TOLERANCE_PER_DEPTH * own.depth[::2, ::2][both]
        found.append(off[off < limit])
    off = np.concatenate(found) if found else np.zeros(0)
    spread = 1.4826 * float(np.median(off)) if len(off) else MAX_TOLERANCE_M
    base = float(np.clip(_TOLERANCE_SIGMAS * spread, MIN_TOLERANCE_M, MAX_TOLERANCE_M))
    return base, _TOLERANCE_PER_DEPTH


def _line(crossed: list[list[tuple[View, np.ndarray, View]]], tolerance: tuple[float, float]) -> Balance:
    """Fit the colour balance from the older to the newer capture, from all pixels that show one surface."""
    older, newer = [], []
    for pairs, own_is_newer in zip(crossed, (False, True), strict=True):
        for own, sure, other in pairs:
            one = (sure & other.solid & _one_surface(own, other, tolerance))[::2, ::2]
            mine, theirs = own.colour[::2, ::2][one], other.colour[::2, ::2][one]
            older.append(theirs if own_is_newer else mine)
            newer.append(mine if own_is_newer else theirs)
    return balance(np.concatenate(older), np.concatenate(newer)) if older else balance(*np.zeros((2, 0, 3)))


def _one_surface(own: View, other: View, tolerance: tuple[float, float]) -> np.ndarray:
    base, share = tolerance
    out: np.ndarray = np.abs(own.depth - other.depth) <= base + share * own.depth
    return out


def _outcomes(
    own: View,
    sure: np.ndarray,
    other: View,
    line: Balance,
    sign: int,
    tolerance: tuple[float, float],
) -> ComparedView:
    """Classify the pixels of a view; ``line`` converts the older capture's colours to the newer capture's."""
    base, share = tolerance
    gap = base + share * own.depth
    one = own.solid & other.solid & _one_surface(own, other, tolerance)
    both = sure & other.solid
    covered = own.opaque & other.opaque & (other.depth < own.depth - gap)
    older, newer = (other, own) if sign > 0 else (own, other)
    chroma, lightness = line.differences(older.colour, newer.colour, one)
    outcome = np.full(own.depth.shape, UNSURE, dtype=np.uint8)
    outcome[one & sure] = AGREE
    outcome[one & sure & colours_differ(line, chroma, lightness)] = COLOUR
    # Compare with the extremes of both neighbourhoods, because an edge that is shifted by a pixel is no evidence.
    outcome[both & (other.far < own.near - gap)] = OTHER_IN_FRONT
    outcome[both & (other.near > own.far + gap)] = OTHER_BEHIND
    return ComparedView(own, other, outcome, one, covered, chroma, lightness)


def _count(
    tally: EvidenceCounts, at: ProjectedPoints, picture: ComparedView, sure: np.ndarray, tolerance: tuple[float, float]
) -> None:
    """Count how the Gaussians of one capture lie relative to the surface in a view of the other capture, and add that
    surface's colours."""
    view, (base, share) = picture.own, tolerance
    count_looks(
        at.index,
        at.row,
        at.column,
        at.z,
        near=view.near,
        far=view.far,
        depth=view.depth,
        solid=view.solid,
        opaque=view.opaque,
        sure=sure,
        covered=picture.covered,
        one=picture.one,
        chroma=picture.chroma,
        lightness=picture.lightness,
        focal=float(view.camera.intrinsics_px[0, 0]),
        base=base,
        share=share,
        through=tally.through,
        on_surface=tally.on_surface,
        hidden=tally.hidden,
        grazed=tally.grazed,
        behind=tally.covered,
        well=tally.sure,
        sharpness=tally.sharpness,
        colour_seen=tally.colour_seen,
        chroma_sum=tally.chroma,
        lightness_sum=tally.lightness,
    )


def _count_colour(
    tally: EvidenceCounts, at: ProjectedPoints, picture: ComparedView, tolerance: tuple[float, float]
) -> None:
    """Add the colour differences in a capture's own view to the capture's Gaussians."""
    base, share = tolerance
    add_colours(
        at.index,
        at.row,
        at.column,
        at.z,
        depth=picture.own.depth,
        one=picture.one,
        chroma=picture.chroma,
        lightness=picture.lightness,
        base=base,
        share=share,
        colour_seen=tally.colour_seen,
        chroma_sum=tally.chroma,
        lightness_sum=tally.lightness,
    )
