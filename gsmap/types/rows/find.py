"""What is found in a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class FindHit(Row):
    """A place that is like what was asked for.

    Args:
        rank: from 1.
        score: what it is ranked by: of likeness a probability, of embeddings a cosine, of names the share of its words
            that were asked for; see ``by`` of the report.
        object: id of the object there (`gsmap graph`); null where nothing was told apart from the building.
        name: what people call it; null where they do not.
        scene: id of the capture that shows what matched best.
        scene_name: its name.
        node: of its layer of objects, the one that matched best; null where things were compared.
        component: of the map, whose frame ``position`` is in.
        position: of the object where it was last seen, or of the node; map frame and unit.
        position_m: the same in metres.
        size_m: of the box around it, metres, along the map's axes; null where there is no object.
        dates: of the captures that show it, oldest first, ISO 8601; null for those that have none.
        picture: file that shows it; null where none was asked for, or no camera sees it.
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
    scene: str
    scene_name: str
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
    """What was found, best first.

    Args:
        query: what was asked for, in words.
        by: ``name`` (what people call objects), ``likeness`` (size, shape and colour of things) or ``embedding``.
        recipe: digest of the one recipe whose graphs answered; empty where names did.
        embedder: of that recipe.
        described: how many placed captures it has described ...
        placed: ... of so many; the others took no part.
        hits: the places.
        notes: what a person should know.
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
