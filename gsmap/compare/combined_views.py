"""Combine views of several captures as if they were of one capture; the views are selected by coverage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsmap.compare.capture_views import MAX_TOLERANCE_M, MAX_VIEWS, NEAREST_M, CaptureViews, project_points
from gsmap.compare.comparison import AGREE, OTHER_BEHIND, UNSURE, Comparison
from gsmap.types import Gaussians, PosedScene

_SAMPLE = 1500  # number of points of a capture by which views of the other captures are selected
_ENOUGH = 8  # number of views of a point beyond which further views add little
_VIEWS = 2  # factor on the number of views of one capture, because several captures show more


def combine_views(
    parts: Sequence[tuple[CaptureViews, np.ndarray]], of: PosedScene, max_views: int = MAX_VIEWS
) -> CaptureViews:
    """Combine the views of several captures into those of one capture, and select the views that show the place of
    ``of``.

    Args:
        parts: captures from the newest to the oldest, each with a mask (N,) of the Gaussians that are still valid. The
            result contains these Gaussians, one capture after another.
        of: the capture with which the result will be compared.
        max_views: largest number of views of one capture; the result has at most twice as many.
    """
    chosen = _select_views([capture for capture, _ in parts], of, max_views)
    views, sure, placed, first = [], [], [], 0
    for (capture, stays), picked in zip(parts, chosen, strict=True):
        row = np.where(stays, np.cumsum(stays) - 1 + first, -1).astype(np.int32)
        first += int(stays.sum())
        for v in picked:
            view, at = capture.views[v], capture.placed[v]
            dominant = np.where(view.dominant_id >= 0, row[view.dominant_id], -1)
            kept = stays[at.index]
            views.append(replace(view, dominant_id=dominant))
            sure.append(capture.sure[v])
            placed.append(
                replace(at, index=row[at.index[kept]], row=at.row[kept], column=at.column[kept], z=at.z[kept])
            )
    gaussians = Gaussians.concatenate([capture.gaussians[stays] for capture, stays in parts])
    surface, times_seen, well_observed, directions, sharpness = (
        np.concatenate([getattr(capture, name)[stays] for capture, stays in parts])
        for name in ("surface", "times_seen", "well_observed", "directions", "sharpness")
    )
    scene = PosedScene(gaussians, scene_id="+".join(capture.scene.scene_id for capture, _ in parts))
    return CaptureViews(
        scene, tuple(views), surface, times_seen, well_observed, directions, sharpness, tuple(sure), tuple(placed)
    )


def mask_outdated(capture: CaptureViews, comparison: Comparison, stays: np.ndarray) -> CaptureViews:
    """Mask the views of the older capture of a comparison where the newer capture disagrees.

    Colours of the views are balanced to the newer capture, so that earlier captures are compared with a single
    exposure.

    Args:
        stays: (N,) mask of the older capture's Gaussians that are still valid.
    """
    sure, views = [], []
    for own, picture in zip(capture.sure, comparison.older_views, strict=True):
        shown = picture.own.dominant_id
        stands = (shown >= 0) & stays[shown]
        undisputed = (picture.outcome == AGREE) | (picture.outcome == UNSURE) | (picture.outcome == OTHER_BEHIND)
        so = stands & undisputed
        sure.append(own & so)
        view = picture.own
        colour = comparison.balance.applied(view.colour)
        views.append(replace(view, colour=colour, solid=view.solid & so, opaque=view.opaque & so))
    return replace(capture, views=tuple(views), sure=tuple(sure), own_points=capture.placed)


def _select_views(captures: Sequence[CaptureViews], of: PosedScene, max_views: int) -> list[list[int]]:
    """Select views of each capture greedily by coverage, at most twice ``max_views`` in total."""
    chosen: list[list[int]] = [[] for _ in captures]
    points = of.gaussians.means[:: max(1, len(of.gaussians) // _SAMPLE)]
    names = [(c, v) for c, capture in enumerate(captures) for v in range(len(capture.views))]
    if not names or not len(points):
        return chosen
    sees = np.zeros((len(names), len(points)), dtype=np.float32)
    for i, (c, v) in enumerate(names):
        view = captures[c].views[v]
        at = project_points(points, view, NEAREST_M)
        # Points behind a surface are occluded.
        seen = at.z < view.far[at.row, at.column] + MAX_TOLERANCE_M
        # Of views with equal coverage, the newest is taken.
        sees[i, at.index[seen]] = 1 + 0.2 * (len(captures) - c) / len(captures)
    wanting = np.full(len(points), _ENOUGH, dtype=np.float32)
    for _ in range(min(_VIEWS * max_views, len(names))):
        gain = sees @ np.minimum(wanting, 1)
        best = int(np.argmax(gain))
        if gain[best] <= 0:
            break
        c, v = names[best]
        chosen[c].append(v)
        wanting = np.maximum(wanting - (sees[best] > 0), 0)
        sees[best] = 0
    return [sorted(picked) for picked in chosen]
