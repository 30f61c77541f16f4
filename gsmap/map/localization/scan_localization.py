"""Localize the scans among the inputs of `gsmap localize`, and report them as rows of photos."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gsmap.errors import ConfigError
from gsmap.formats import scans
from gsmap.localize import Lens
from gsmap.map.localization.localize_scan import Request, localize_scan
from gsmap.store import Store
from gsmap.types.plain import fields_of
from gsmap.types.progress import StageProgress
from gsmap.types.rows.localize import LocalizedRow, LocalizeRow
from gsmap.types.rows.localize_scan import ScanRow

if TYPE_CHECKING:
    from gsmap.map.settings import Settings


def scan_rows(
    store: Store,
    settings: Settings,
    files: Sequence[str | os.PathLike[str]],
    depth: str | os.PathLike[str] | None,
    depth_scale: float,
    lens: Lens,
    near: str | None,
    progress: StageProgress,
) -> tuple[dict[int, LocalizeRow], tuple[str, ...]]:
    """Localize the files that are scans; return their rows by position, and notes that name the file.

    Args:
        depth: a depth image of the view of the single photo, which makes a scan of it.
        depth_scale: depth value of one metre.

    Raises:
        ConfigError: a depth picture with several files, with a scan, or without intrinsics.
    """
    requests = {number: Request(Path(path), near=near) for number, path in enumerate(files) if scans.is_scan(path)}
    if depth is not None:
        if len(files) != 1 or requests:
            raise ConfigError("--depth takes exactly one photo", code="conflicting_options")
        if lens.intrinsics_px is None:
            raise ConfigError("a depth image needs --intrinsics fx,fy,cx,cy", code="missing_option")
        requests[0] = Request(Path(depth), lens.intrinsics_px, files[0], depth_scale, near=near)
    found = {number: localize_scan(store, request, settings, progress) for number, request in requests.items()}
    rows = {number: _row(os.fspath(files[number]), row) for number, row in found.items()}
    return rows, tuple(f"{files[number]}: {note}" for number, row in found.items() for note in row.notes)


def _row(file: str, row: ScanRow) -> LocalizeRow:
    """Convert a row of a scan to a row of a photo; `Map.localize_scan` returns all fields."""
    evidence = {"num_points": float(row.num_points), "coloured": float(row.coloured)}
    if row.sigma_deg is not None and row.sigma_m is not None:
        evidence |= {"sigma_deg": row.sigma_deg, "sigma_m": row.sigma_m}
    return LocalizeRow(**fields_of(row, LocalizedRow) | {"file": file, "evidence": evidence})
