"""Search results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import SceneRef


@dataclass(frozen=True, eq=False, kw_only=True)
class FindHit(SceneRef):
    """A place in the map that matches the query.

    Args:
        rank: rank, from 1.
        score: the probability that both are of one kind, for ``likeness``; a cosine for ``embedding``, the fraction of
            matching words for ``name``; see ``by`` of the report.
        object: id of the object (`gsmap graph`); null if no object was segmented there.
        name: name of the object; null if it has none.
        scene: id of the capture that matched best.
        scene_name: name of the capture that matched best.
        node: best matching node of its object layer; null if segments were compared.
        component: component of ``position``.
        position: position of the object where it was last seen, or of the node; map frame and unit.
        position_m: the position in metres.
        size_m: size of its bounding box along the map's axes, metres; null without an object.
        dates: dates of the captures that show it, oldest first, ISO 8601; null for undated ones.
        picture: image file that shows it; null if none was requested or no camera sees it.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "rank": "rank",
        "score": "score",
        "object": "object",
        "name": "name",
        "scene_name": "scene",
        "component": "component",
        "position": "position (map units)",
        "size_m": "size (m)",
        "dates": "seen",
        "picture": "picture",
    }

    rank: int
    score: float
    object: str | None
    node: int | None
    component: int
    position: np.ndarray
    position_m: np.ndarray
    size_m: np.ndarray | None
    dates: tuple[str | None, ...]
    name: str | None = None
    picture: str | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class FindReport(Row):
    """The hits of a search, best first.

    Args:
        query: the query as text.
        by: method: ``name`` (annotations), ``likeness`` (size, shape and colour of segments) or ``embedding``.
        recipe: digest of the recipe of the searched graphs; empty for ``name``.
        embedder: embedder of that recipe.
        described: number of placed captures described by the recipe.
        placed: number of all placed captures.
        hits: the hits.
        notes: remarks.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "query": "asked for",
        "by": "by",
        "embedder": "embedder",
        "described": "captures",
        "placed": "of",
        "hits": "hits",
    }

    query: str
    by: str
    recipe: str
    embedder: str
    described: int
    placed: int
    hits: tuple[FindHit, ...]
    notes: tuple[str, ...] = ()
