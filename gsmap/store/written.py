"""The time at which a map was last written, against which a clock can be checked."""

from __future__ import annotations

from sqlalchemy import func, select

from gsmap.store.catalog import Catalog
from gsmap.store.schema import comparisons, exports, registrations, reviews, revisions, scene_facts, scenes

_WRITTEN = (
    *(scenes.c.ingested_at, scenes.c.removed_at, scene_facts.c.created_at, registrations.c.created_at),
    *(reviews.c.created_at, revisions.c.created_at, comparisons.c.created_at, exports.c.created_at),
)


def time_written(catalog: Catalog) -> str | None:
    """Return the time of the map's newest row, ISO 8601; None for an empty map."""
    with catalog.read() as connection:
        newest = [connection.execute(select(func.max(column))).scalar() for column in _WRITTEN]
    return max((str(when) for when in newest if when), default=None)
