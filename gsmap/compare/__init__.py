"""Two captures seen from the same cameras: where they agree, where they disagree, and what neither can say."""

from __future__ import annotations

from gsmap.compare.colours import Balance
from gsmap.compare.comparing import (
    AGREE,
    COLOUR,
    OTHER_BEFORE,
    OTHER_BEHIND,
    UNSURE,
    Comparison,
    Pictured,
    compare,
)
from gsmap.compare.evidence import GONE, HIDDEN, REPAINTED, SAME, UNSEEN, Evidence
from gsmap.compare.joining import joined, outdated
from gsmap.compare.looks import MAX_VIEWS, Looks, View, look
from gsmap.compare.neighbourhoods import grown, ranges

VERSION = 4
"""Raised whenever two captures come out otherwise for the same input."""

__all__ = [
    "AGREE",
    "COLOUR",
    "GONE",
    "HIDDEN",
    "MAX_VIEWS",
    "OTHER_BEFORE",
    "OTHER_BEHIND",
    "REPAINTED",
    "SAME",
    "UNSEEN",
    "UNSURE",
    "VERSION",
    "Balance",
    "Comparison",
    "Evidence",
    "Looks",
    "Pictured",
    "View",
    "compare",
    "grown",
    "joined",
    "look",
    "outdated",
    "ranges",
]
