"""Publish and delete array groups together with the catalog rows that name them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

from sqlalchemy import Connection, delete, insert, select

from gsmap.errors import CorruptError, NotFoundError
from gsmap.store.arrays import Arrays, StagedGroup, StoredFile
from gsmap.store.branches import OtherCatalogs
from gsmap.store.catalog import Catalog, now
from gsmap.store.catalog_rows import located_files
from gsmap.store.schema import files, groups, results


def has_group(connection: Connection, group_id: str) -> bool:
    return connection.execute(select(groups.c.id).where(groups.c.id == group_id)).first() is not None


def publish(
    catalog: Catalog, connection: Connection, arrays: Arrays, staged: StagedGroup, kind: str, group_id: str
) -> None:
    """Move a staged group to its final path and insert its rows, inside a write transaction; replace a damaged group.

    Where another branch has the group and its files are sound, they are kept with that branch's manifest.
    """
    catalog.hold_until_commit(arrays.lock())
    known = OtherCatalogs(arrays.root.parent, catalog.folder).manifests(group_id)
    whole = next((manifest for manifest in known if not arrays.problems(kind, group_id, manifest)), None)
    if whole is None:
        arrays.publish(staged, kind, group_id)
    name(connection, kind, group_id, staged.files if whole is None else whole)


def name(connection: Connection, kind: str, group_id: str, manifest: Sequence[StoredFile]) -> None:
    """Insert the rows that name a group and its files."""
    if not has_group(connection, group_id):
        connection.execute(insert(groups), {"id": group_id, "kind": kind, "created_at": now()})
    connection.execute(delete(files).where(files.c.group_id == group_id))
    rows = [{"group_id": group_id, "path": f.path, "size_bytes": f.size_bytes, "sha256": f.sha256} for f in manifest]
    connection.execute(insert(files), rows)


def unname(connection: Connection, group_id: str) -> None:
    """Delete the rows that name a group; rows that refer to the group must change in the same transaction."""
    connection.execute(delete(files).where(files.c.group_id == group_id))
    connection.execute(delete(groups).where(groups.c.id == group_id))


def forget_derived(connection: Connection, scene: str) -> None:
    """Delete the results of one scene, as its stored Gaussians change."""
    of_scene = results.c.scene == scene
    old = connection.execute(select(results.c.group_id).where(of_scene, results.c.group_id.is_not(None)))
    groups = set(old.scalars())
    connection.execute(delete(results).where(of_scene))
    for group in groups:
        unname(connection, group)


@contextlib.contextmanager
def unless_pruned(catalog: Catalog, group_id: str, gone: str) -> Iterator[None]:
    """Raise `NotFoundError` instead of `CorruptError` if the group was pruned while it was read.

    Args:
        gone: description of what happened to the group, for the message.

    Raises:
        NotFoundError: the group could not be read, and no row names it any more.
    """
    try:
        yield
    except CorruptError:
        with catalog.read(newest=True) as connection:
            if has_group(connection, group_id):
                raise
        raise NotFoundError(
            f"{gone}, and its arrays were pruned during the read: try again", code="changed_meanwhile"
        ) from None


def num_bytes(connection: Connection, group_id: str) -> int:
    """Return the size of a group's files in bytes, as they were written."""
    return sum(file.size_bytes for file in manifest(connection, group_id))


def manifest(connection: Connection, group_id: str) -> tuple[StoredFile, ...]:
    """Return the files of a group with their digests."""
    if (known := located_files(connection, group_id)) is not None:
        return known
    rows = connection.execute(select(files).where(files.c.group_id == group_id).order_by(files.c.path))
    return tuple(StoredFile(r.path, r.size_bytes, r.sha256) for r in rows)
