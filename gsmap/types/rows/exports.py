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
        out: export folder.
        path: path of the tile's file, relative to ``out``.
        component: connected component of the tile.
        bounds: (2, 3) lowest and highest corner, map frame.
        num_gaussians: number of Gaussians it holds.
        scenes: input scenes.
        merge: name of the merger.
        recipe: recipe of the merge: ``stage``, ``method``, ``version`` of every part, ``settings``, ``backend``.
        truncated: true if a time budget cut its optimization short.
        sha256: digest of the file.
        notes: remarks on how it was made.
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
class SmallSceneRow(SceneRef):
    """The content of a scene in a small map.

    Args:
        num_views: number of views for retrieval.
        num_features: number of stored features.
        features_of: number of features before reduction.
        num_gaussians: number of stored Gaussians.
        gaussians_of: number of Gaussians before reduction.
        num_bytes: size of its file.
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

    num_views: int
    num_features: int
    features_of: int
    num_gaussians: int
    gaussians_of: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class SmallMapReport(Row):
    """A written small map, which serves localization only.

    Args:
        out: folder of the small map.
        scenes: content of each scene.
        num_bytes: size of all its files.
        budget_bytes: maximum size that was allowed.
    """

    columns: ClassVar[Mapping[str, str]] = {"scenes": "scenes", "num_bytes": "bytes"}

    out: str
    scenes: tuple[SmallSceneRow, ...]
    num_bytes: int
    budget_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class ExportReport(Row):
    """The result of an export.

    Args:
        out: export folder.
        tiles: tiles in the folder.
        recomputed: number of files that were made.
        reused: number of unchanged files.
        removed: number of deleted files.
        notes: remarks on the input; each tile has remarks on itself.
        up: vertical axis of the files: ``z``, that of the map, or ``y``, as viewers of the format expect it.
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
    up: str = "z"
