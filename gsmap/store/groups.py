"""Groups of arrays and the rows that name them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from sqlalchemy import Connection, delete, insert, select

from gsmap.errors import CorruptError, NotFoundError
from gsmap.store.arrays import Arrays, Staged, StoredFile
from gsmap.store.branches import Others
from gsmap.store.catalog import Catalog, now
from gsmap.store.schema import files, graphs, groups, view_features


def has_group(connection: Connection, group_id: str) -> bool:
    return connection.execute(select(groups.c.id).where(groups.c.id == group_id)).first() is not None


def publish(catalog: Catalog, connection: Connection, arrays: Arrays, staged: Staged, kind: str, group_id: str) -> None:
    """Move a staged group into place and name it, inside a write transaction; it replaces a damaged one.

    Where a branch of the map has the group already and it is whole, it stays as that branch knows it.
    """
    catalog.hold(arrays.lock())
    known = Others(arrays.root.parent, catalog.folder).manifests(group_id)
    whole = next((manifest for manifest in known if not arrays.problems(kind, group_id, manifest)), None)
    if whole is None:
        arrays.publish(staged, kind, group_id)
    name(connection, kind, group_id, staged.files if whole is None else whole)


def name(connection: Connection, kind: str, group_id: str, manifest: Sequence[StoredFile]) -> None:
    """Write down that a group counts, and the files it must have."""
    if not has_group(connection, group_id):
        connection.execute(insert(groups), {"id": group_id, "kind": kind, "created_at": now()})
    connection.execute(delete(files).where(files.c.group_id == group_id))
    rows = [{"group_id": group_id, "path": f.path, "size_bytes": f.size_bytes, "sha256": f.sha256} for f in manifest]
    connection.execute(insert(files), rows)


def unname(connection: Connection, group_id: str) -> None:
    """Let a group count no longer; whoever claimed it is changed in the same transaction."""
    connection.execute(delete(files).where(files.c.group_id == group_id))
    connection.execute(delete(groups).where(groups.c.id == group_id))


def drop_graphs(connection: Connection, scene: str) -> None:
    """Forget the graphs of a scene whose Gaussians become others, and the features of its views."""
    for table in (graphs, view_features):
        made = table.c.scene == scene
        old = list(connection.execute(select(table.c.group_id).where(made)).scalars())
        connection.execute(delete(table).where(made))
        for group in old:
            unname(connection, group)


@contextlib.contextmanager
def unless_pruned(catalog: Catalog, group_id: str, gone: str) -> Iterator[None]:
    """Tell a group that others reclaimed while it was read from a damaged one.

    Args:
        gone: what it was of, and what became of that.

    Raises:
        NotFoundError: it could not be read, and no row names it any more.
    """
    try:
        yield
    except CorruptError:
        with catalog.read() as connection:
            if has_group(connection, group_id):
                raise
        raise NotFoundError(
            f"{gone}, and its arrays were pruned while they were read: try again", code="changed_meanwhile"
        ) from None


def num_bytes(connection: Connection, group_id: str) -> int:
    """Of a group's files, as they were written."""
    return sum(file.size_bytes for file in manifest(connection, group_id))


def manifest(connection: Connection, group_id: str) -> tuple[StoredFile, ...]:
    """The files a group must have, with their digests."""
    rows = connection.execute(select(files).where(files.c.group_id == group_id).order_by(files.c.path))
    return tuple(StoredFile(r.path, r.size_bytes, r.sha256) for r in rows)
