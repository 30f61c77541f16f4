"""How much of a map's disk is used by what, from the manifests alone: no file is looked at but the catalog."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sqlalchemy import func, select

from gsmap.store.schema import files, groups, models, scenes

if TYPE_CHECKING:
    from gsmap.store.store import Store

CATALOG, MODELS = "catalog", "models"


@dataclass(frozen=True)
class Size:
    """What is kept of one kind.

    Args:
        kind: of groups of arrays (``scenes``, ``graphs``, ``changes``, ``indexes``), ``models`` or ``catalog``.
        count: how many.
        num_bytes: of their files, as they were written.
    """

    kind: str
    count: int
    num_bytes: int


def sizes(store: Store) -> list[Size]:
    """By kind, most bytes first. What was removed counts until it is pruned; a catalog on a server does not."""
    bytes_of = func.coalesce(func.sum(files.c.size_bytes), 0)
    query = select(groups.c.kind, func.count(groups.c.id.distinct()), bytes_of)
    query = query.outerjoin(files, files.c.group_id == groups.c.id).group_by(groups.c.kind)
    copied = models.c.removed_at.is_(None) & (models.c.copied == 1)
    with store.catalog.read() as connection:
        found = [Size(kind, count, int(num_bytes)) for kind, count, num_bytes in connection.execute(query)]
        kept = connection.execute(select(models.c.sha256, models.c.size_bytes).where(copied).distinct()).all()
    if kept:
        found.append(Size(MODELS, len(kept), sum(row.size_bytes for row in kept)))
    catalog = store.folder / "map.sqlite"
    if store.catalog.is_sqlite and catalog.is_file():
        found.append(Size(CATALOG, 1, catalog.stat().st_size))
    return sorted(found, key=lambda one: (-one.num_bytes, one.kind))


def scene_sizes(store: Store) -> dict[str, int]:
    """Bytes of the arrays of every living scene, as they were written, by id."""
    query = select(scenes.c.id, func.sum(files.c.size_bytes)).join(files, files.c.group_id == scenes.c.group_id)
    with store.catalog.read() as connection:
        rows = connection.execute(query.where(scenes.c.removed_at.is_(None)).group_by(scenes.c.id))
        return {scene: int(num_bytes) for scene, num_bytes in rows}
