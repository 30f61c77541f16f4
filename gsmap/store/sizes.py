"""Compute the disk use of a map by kind from manifests; the catalog is the only file that is inspected."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sqlalchemy import func, select

from gsmap.store.result_rows import GRAPHS
from gsmap.store.schema import files, groups, models, scenes

if TYPE_CHECKING:
    from gsmap.store.store import Store

CATALOG, MODELS = "catalog", "models"


def sizes(store: Store) -> dict[str, tuple[int, int]]:
    """Return the number and the bytes of stored array groups by kind, of ``models`` and of the ``catalog``, largest
    first; includes removed data until a prune, but no catalog on a server.
    """
    bytes_of = func.coalesce(func.sum(files.c.size_bytes), 0)
    query = select(groups.c.kind, func.count(groups.c.id.distinct()), bytes_of)
    query = query.outerjoin(files, files.c.group_id == groups.c.id).group_by(groups.c.kind)
    copied = models.c.removed_at.is_(None) & (models.c.copied == 1)
    with store.catalog.read() as connection:
        found = {kind: (count, int(num_bytes)) for kind, count, num_bytes in connection.execute(query)}
        kept = connection.execute(select(models.c.sha256, models.c.size_bytes).where(copied).distinct()).all()
    if kept:
        found[MODELS] = len(kept), sum(row.size_bytes for row in kept)
    catalog = store.folder / "map.sqlite"
    if store.catalog.is_sqlite and catalog.is_file():
        found[CATALOG] = 1, catalog.stat().st_size
    return dict(sorted(found.items(), key=lambda one: (-one[1][1], one[0])))


def graph_sizes(store: Store) -> dict[str, int]:
    """Return the size in bytes of the arrays of all graphs of every scene, as written, by scene id."""
    own = GRAPHS.select(GRAPHS.c.scene, GRAPHS.c.group_id).distinct().subquery()
    query = select(own.c.scene, func.sum(files.c.size_bytes)).join(files, files.c.group_id == own.c.group_id)
    with store.catalog.read() as connection:
        return {scene: int(num_bytes) for scene, num_bytes in connection.execute(query.group_by(own.c.scene))}


def scene_sizes(store: Store) -> dict[str, int]:
    """Return the size in bytes of the arrays of every living scene, as written, by id."""
    query = select(scenes.c.id, func.sum(files.c.size_bytes)).join(files, files.c.group_id == scenes.c.group_id)
    with store.catalog.read() as connection:
        rows = connection.execute(query.where(scenes.c.removed_at.is_(None)).group_by(scenes.c.id))
        return {scene: int(num_bytes) for scene, num_bytes in rows}
