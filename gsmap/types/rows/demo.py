"""Report of the demo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row
from gsmap.types.rows.evaluation import EvaluationReport
from gsmap.types.rows.exports import TileRow
from gsmap.types.rows.pairs import EdgeRow
from gsmap.types.rows.scenes import SceneRow


@dataclass(frozen=True, eq=False, kw_only=True)
class DemoReport(Row):
    """The result of the demo.

    Args:
        map: folder of the map.
        picture: image of the map.
        scenes: the captures.
        edges: the edges.
        tiles: the merged tiles.
        truth: errors against the ground truth.
    """

    columns: ClassVar[Mapping[str, str]] = {"map": "map", "picture": "picture"}

    map: str
    picture: str
    scenes: tuple[SceneRow, ...]
    edges: tuple[EdgeRow, ...]
    tiles: tuple[TileRow, ...]
    truth: EvaluationReport
