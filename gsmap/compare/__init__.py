"""Per-Gaussian and per-pixel comparison of two captures of one place, rendered from the cameras of both."""

from __future__ import annotations

from gsmap.compare.capture_views import MAX_VIEWS, CaptureViews, View, render_views
from gsmap.compare.colours import Balance
from gsmap.compare.combined_views import combine_views, mask_outdated
from gsmap.compare.comparison import (
    AGREE,
    COLOUR,
    OTHER_BEHIND,
    OTHER_IN_FRONT,
    UNSURE,
    ComparedView,
    Comparison,
    Observations,
    compare,
    count_looks_at,
    observe,
)
from gsmap.compare.evidence import GONE, HIDDEN, REPAINTED, SAME, UNSEEN, ChangeEvidence
from gsmap.compare.neighbourhoods import dilate, local_ranges

VERSION = 5
"""Version, raised whenever the comparison of the same two captures gives another result."""

__all__ = [
    "AGREE",
    "COLOUR",
    "GONE",
    "HIDDEN",
    "MAX_VIEWS",
    "OTHER_IN_FRONT",
    "OTHER_BEHIND",
    "REPAINTED",
    "SAME",
    "UNSEEN",
    "UNSURE",
    "VERSION",
    "Balance",
    "Comparison",
    "ChangeEvidence",
    "CaptureViews",
    "ComparedView",
    "Observations",
    "View",
    "compare",
    "count_looks_at",
    "observe",
    "dilate",
    "combine_views",
    "render_views",
    "mask_outdated",
    "local_ranges",
]
