"""Checks for all readers of point clouds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from gsmap.errors import InputError
from gsmap.types.scan import Scan


def scan_of(points: np.ndarray, colours: np.ndarray | None, what: Path, total: int, **about: Any) -> Scan:
    """Return a `Scan` of the finite points, with notes on points that were left out.

    Raises:
        InputError: none is finite.
    """
    finite = np.isfinite(points).all(1)
    notes = []
    if not finite.all():
        points, colours = points[finite], None if colours is None else colours[finite]
        notes.append(f"{int((~finite).sum()):,} points with NaN or infinite coordinates were left out")
    if not len(points):
        raise InputError(
            f"{what} has no point with finite coordinates, so there is nothing to localize", code="empty_scan"
        )
    if total > len(finite):
        notes.append(f"{len(finite):,} of its {total:,} points are used, evenly spread over the file")
    scan = Scan(points, colours, **about)
    return replace(scan, notes=(*scan.notes, *notes))
