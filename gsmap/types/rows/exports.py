"""Exports and their tiles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import SceneRef


@dataclass(frozen=True, eq=False, kw_only=True)
class TileRow(Row):
    """One tile of an export.

    Args:
        out: the folder exported to.
        path: of the tile's file, relative to ``out``.
        component: the connected component that it belongs to.
        bounds: (2, 3) lowest and highest corner, map frame.
        num_gaussians: how many Gaussians it holds.
        scenes: the scenes it was made from.
        merge: the merger.
        recipe: how it was merged: ``stage``, ``method``, ``version`` of every piece that took part, ``settings``,
            ``backend``.
        truncated: whether a time budget cut its optimisation short.
        sha256: of the file.
        notes: what a person should know of how it was made.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "out": "folder",
        "path": "file",
        "component": "component",
        "merge": "merge",
        "num_gaussians": "Gaussians",
        "truncated": "truncated",
    }

    out: str
    path: str
    component: int
    bounds: np.ndarray
    num_gaussians: int
    scenes: tuple[SceneRef, ...]
    merge: str
    recipe: Mapping[str, Any]
    truncated: bool
    sha256: str
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport(Row):
    """What an export did.

    Args:
        out: the folder exported to.
        tiles: the tiles that are in the folder now.
        recomputed: how many of them were made.
        reused: how many were unchanged.
        removed: how many files were taken away.
        notes: what a person should know of what took part; what of how a tile was made is in the tile's.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "out": "folder",
        "recomputed": "made",
        "reused": "unchanged",
        "removed": "removed",
    }

    out: str
    tiles: tuple[TileRow, ...]
    recomputed: int
    reused: int
    removed: int
    notes: tuple[str, ...] = ()
