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
class SmallSceneRow(Row):
    """What a small map keeps of a scene.

    Args:
        scene: id.
        scene_name: name.
        num_views: views of it that photographs are found by.
        num_features: features of these that are kept.
        features_of: of so many.
        num_gaussians: Gaussians that are kept.
        gaussians_of: of so many.
        num_bytes: of its file.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "num_views": "views",
        "num_features": "features",
        "features_of": "of",
        "num_gaussians": "Gaussians",
        "gaussians_of": "of",
        "num_bytes": "bytes",
    }

    scene: str
    scene_name: str
    num_views: int
    num_features: int
    features_of: int
    num_gaussians: int
    gaussians_of: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SmallMapReport(Row):
    """A small map, for localisation alone.

    Args:
        out: its folder.
        scenes: what it keeps of each.
        num_bytes: of all its files.
        budget_bytes: that were allowed.
    """

    columns: ClassVar[Mapping[str, str]] = {"scenes": "scenes", "num_bytes": "bytes"}

    out: str
    scenes: tuple[SmallSceneRow, ...]
    num_bytes: int
    budget_bytes: int


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
