"""Purge a scene: delete its rows, its arrays, and every byte of the catalog about it.

A purge has three steps, so that one interrupted by a crash can be finished later: `begin` deletes the rows in one
transaction and records what is left to do; the caller deletes tiles in the export folders; `finish` reclaims arrays,
older copies of the catalog and deleted rows in its file, and completes the receipt.
"""

from __future__ import annotations

import contextlib
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Row, Table, delete, exists, func, insert, select, text, update

from gsmap.durable import files_below, is_file, is_folder, remove_file, sync_folder
from gsmap.errors import BusyError
from gsmap.store import integrity, objects, sqlite
from gsmap.store.branches import MapLocation
from gsmap.store.catalog import Catalog, now
from gsmap.store.error_translation import translate_errors
from gsmap.store.result_rows import delete_results_of
from gsmap.store.revisions import holds_in_revision
from gsmap.store.schema import (
    CHUNK_BOXES,
    change_reviews,
    changes,
    comparisons,
    edges,
    exports,
    files,
    groups,
    leases,
    lookups,
    metadata,
    object_facts,
    observations,
    photo_sightings,
    poses,
    priors,
    purges,
    registrations,
    results,
    reviews,
    revisions,
    scene_facts,
    scenes,
    set_aside,
    tiles,
)
from gsmap.store.store import Store

_PURGED = "a scene that was purged"
# Texts that gsmap generated: the name of the scene is replaced. Texts that people wrote about other scenes are kept
# and only listed in the receipt.
_GENERATED_TEXTS: tuple[tuple[Table, tuple[str, ...]], ...] = (
    (scenes, ("notes",)),
    (registrations, ("reason", "notes")),
    (revisions, ("notes", "provenance", "world")),
    (edges, ("reason",)),
    (comparisons, ("notes",)),
    (tiles, ("notes",)),
)
_USER_TEXTS: tuple[tuple[Table, str, str], ...] = (
    (scene_facts, "value", "scene"),
    (reviews, "note", "pair"),
    (change_reviews, "note", "change"),
    (object_facts, "value", "object"),
    (revisions, "note", "number"),
)


@dataclass(frozen=True)
class Purge:
    """A purge of a scene and its progress.

    Args:
        number: of its row.
        scene: id.
        receipt: counts of what was deleted; what is left to do (``pending``: folders to search, numbers of files to
            delete in those already searched, arrays and catalog copies to delete); and other places where the scene may
            exist.
        created_at: when its rows were deleted.
    """

    number: int
    scene: str
    receipt: dict[str, Any]
    created_at: str

    @property
    def is_done(self) -> bool:
        return "pending" not in self.receipt


def begin(store: Store, scene: str) -> Purge:
    """Delete all rows about a scene in one transaction; `finish` does the rest.

    Args:
        scene: id of a living or removed scene in the catalog.
    """
    # Groups of other catalogs stay until the scene is purged there.
    shared = {group for _, group in integrity.verify_catalogs(store.catalog, store.arrays).groups()}
    of_map = _backups_of_map(store)
    with store.catalog.write() as connection:
        row = connection.execute(select(scenes).where(scenes.c.id == scene)).one()
        names = _names(connection, row)
        linked = _linked_files(store, connection, scene)
        targets = sorted(connection.execute(select(exports.c.target).distinct()).scalars())
        elsewhere = _backups(connection, row, of_map)
        counts, bodies = _delete_rows(connection, row)
        _scrub(connection, scene, names)
        mentions = _mentions(connection, scene, names)
        receipt: dict[str, Any] = {
            "rows": dict(counts),
            "pending": {
                "targets": targets,
                "tiles": {},
                "groups": {group: size for group, size in bodies.items() if group not in shared},
                "copies": _copies(store),
            },
            "backups": elsewhere,
            "linked_files": linked,
            "mentions": mentions,
        }
        when = now()
        created = {"scene": scene, "receipt": receipt, "created_at": when}
        number = connection.execute(insert(purges).returning(purges.c.number), created).scalar_one()
    return Purge(number, scene, receipt, when)


def list_purges(store: Store) -> list[Purge]:
    """Return all purges, oldest first."""
    with store.catalog.read() as connection:
        rows = connection.execute(select(purges).order_by(purges.c.number)).all()
    return [Purge(row.number, row.scene, dict(row.receipt), row.created_at) for row in rows]


def record_files(store: Store, purge: Purge, target: str, num_files: int) -> Purge:
    """Record the number of files to delete in a folder before deleting them, as a crash may leave none to count."""
    pending = purge.receipt["pending"]
    known = pending.get("tiles", {})
    noted = {**known, target: max(num_files, known.get(target, 0))}
    return _save(store, purge, {**purge.receipt, "pending": {**pending, "tiles": noted}})


def finish(store: Store, purge: Purge, unreachable: Sequence[str]) -> Purge:
    """Erase arrays, older copies of the catalog, and deleted rows in the catalog file; complete the receipt.

    Args:
        unreachable: export folders that could not be searched, with the reason, for the receipt.

    Raises:
        BusyError: a process reads a state from before the purge, so that the file cannot be rewritten yet.
    """
    pending = purge.receipt["pending"]
    integrity.reclaim(store.catalog, store.arrays)
    there = _copies(store)  # a receipt may be from an untrusted map: files named in it are reported but not deleted
    copies = sorted({*pending.get("copies", ()), *there})
    for name in there:
        remove_file(store.folder, name)
    for folder in (store.folder, *(store.arrays.root / kind for kind in store.arrays.kinds()), store.arrays.staging):
        if is_folder(folder):
            sync_folder(folder)  # so that deletions survive a power cut
    left = {group for _, group in store.arrays.groups()}  # still named by a branch
    num_bytes = [size for group, size in pending.get("groups", {}).items() if group not in left]
    receipt = {key: value for key, value in purge.receipt.items() if key != "pending"} | {
        "num_groups": len(num_bytes),
        "num_bytes": sum(num_bytes),
        "catalog_copies": copies,
        "branches": [place.location for place in catalogs_with_scene(store, purge.scene)],
        "tile_files": sum(pending.get("tiles", {}).values()),
        "cleaned": sorted(pending.get("tiles", {})),
        "unreachable": list(unreachable),
    }
    erase_deleted_rows(store.catalog)
    return _save(store, purge, receipt)


def _save(store: Store, purge: Purge, receipt: dict[str, Any]) -> Purge:
    with store.catalog.write() as connection:
        connection.execute(update(purges).where(purges.c.number == purge.number).values(receipt=receipt))
    return replace(purge, receipt=receipt)


def update_receipts(store: Store) -> None:
    """Update, in all receipts, the list of other catalogs that still have the scene."""
    for one in list_purges(store):
        if not one.is_done or not one.receipt["branches"]:
            continue
        still = [place.location for place in catalogs_with_scene(store, one.scene)]
        if still != one.receipt["branches"]:
            _save(store, one, {**one.receipt, "branches": still})


def catalogs_with_scene(store: Store, scene: str) -> list[MapLocation]:
    """Return the other catalogs of the map (the map itself, branches, tags) that have a scene."""
    found = []
    for place in store.others():
        with Store.open(place.location, "r") as other, other.catalog.read() as connection:
            if connection.execute(select(scenes.c.id).where(scenes.c.id == scene)).first() is not None:
                found.append(place)
    return found


def erase_deleted_rows(catalog: Catalog) -> None:
    """Rewrite the catalog so that its files contain no bytes of deleted rows.

    Raises:
        BusyError: a reader holds an older state.
    """
    with catalog.lock(), translate_errors(catalog.folder):
        if not catalog.is_sqlite:
            with catalog.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
                connection.execute(text("SET lock_timeout = '60s'"))  # VACUUM FULL waits for all readers
                connection.execute(text("VACUUM FULL"))
            return
        if not sqlite.vacuum(catalog.engine, catalog.folder / sqlite.FILE, erase=True):
            raise BusyError(
                f"{catalog.folder}: another process reads the state before the purge; the rows are deleted, but not "
                "yet erased from the file: run the same command again when that process has finished",
                code="purge_pending",
            )


# --- rows ------------------------------------------------------------------------------------------------------------


def _delete_rows(connection: Connection, row: Row[Any]) -> tuple[Counter[str], dict[str, int]]:
    """Delete the rows of a scene; return counts by noun, and the sizes of array groups that no row names any more."""
    scene = row.id
    counts: Counter[str] = Counter()

    def drop(noun: str, table: Table, condition: Any) -> None:
        counts[noun] += int(connection.execute(delete(table).where(condition)).rowcount)

    pairs = (registrations.c.target == scene) | (registrations.c.source == scene)
    placed = exists().where(poses.c.scene == scene, holds_in_revision(poses))
    affected = connection.execute(select(revisions.c.number).where(placed)).scalars().all()
    drop("reviews", reviews, reviews.c.pair.contains(scene))
    drop("registrations", registrations, pairs)
    with_it = (comparisons.c.older == scene) | (comparisons.c.newer == scene)
    of_changes = changes.c.comparison.in_(select(comparisons.c.number).where(with_it))
    drop("change_reviews", change_reviews, change_reviews.c.change.in_(select(changes.c.number).where(of_changes)))
    drop("changes", changes, of_changes)
    drop("comparisons", comparisons, with_it)
    drop("edges", edges, (edges.c.target == scene) | (edges.c.source == scene))
    drop("poses", poses, poses.c.scene == scene)
    drop("priors", priors, priors.c.scene == scene)
    drop("observations", observations, (observations.c.scene == scene) | (observations.c.other == scene))
    drop("facts", scene_facts, scene_facts.c.scene == scene)
    drop("leases", leases, leases.c.what.contains(scene))
    drop("set_aside", set_aside, set_aside.c.about.contains(scene))
    made_with_it = [
        tile.number for tile in connection.execute(select(tiles.c.number, tiles.c.poses)) if scene in tile.poses
    ]
    drop("tiles", tiles, tiles.c.number.in_(made_with_it))
    _forget_lookups(connection, scene)
    counts.update(delete_results_of(connection, scene))
    drop("photos", photo_sightings, photo_sightings.c.scene == scene)
    counts.update(objects.forget_scene(connection, scene))
    connection.execute(text(f"DELETE FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s"), {"s": row.number})
    drop("scenes", scenes, scenes.c.id == scene)
    claimed = set()
    for table in metadata.tables.values():
        if table is not files and "group_id" in table.c:
            claimed |= set(connection.execute(select(table.c.group_id)).scalars())
    unclaimed = [group for group in connection.execute(select(groups.c.id)).scalars() if group not in claimed]
    sizes = select(files.c.group_id, func.sum(files.c.size_bytes)).where(files.c.group_id.in_(unclaimed))
    bodies = {group: int(size) for group, size in connection.execute(sizes.group_by(files.c.group_id))}
    connection.execute(delete(files).where(files.c.group_id.in_(unclaimed)))
    connection.execute(delete(groups).where(groups.c.id.in_(unclaimed)))
    for number in sorted(affected):
        mine = revisions.c.number == number
        notes = connection.execute(select(revisions.c.notes).where(mine)).scalar_one()
        remark = f"the pose of {_PURGED} is no longer part of this revision"
        connection.execute(update(revisions).where(mine).values(notes=[*notes, remark]))
    counts["revisions"] = len(affected)
    for line in connection.execute(select(revisions.c.number, revisions.c.world)).all():
        left = [tie | {"residuals": [row for row in tie["residuals"] if row["scene"] != scene]} for tie in line.world]
        if left != line.world:
            connection.execute(update(revisions).where(revisions.c.number == line.number).values(world=left))
    return counts, bodies


def _forget_lookups(connection: Connection, scene: str) -> None:
    """Delete the lookups of the scene, and the scene among the candidates of others."""
    connection.execute(delete(lookups).where(lookups.c.scene == scene))
    for one in connection.execute(select(lookups.c.scene, lookups.c.candidates)).all():
        others = [candidate for candidate in one.candidates if candidate[0] != scene]
        if len(others) < len(one.candidates):
            mine = lookups.c.scene == one.scene
            connection.execute(update(lookups).where(mine).values(candidates=others))


def _names(connection: Connection, row: Row[Any]) -> set[str]:
    """Return all names that the scene ever had."""
    query = select(scene_facts.c.value).where(scene_facts.c.scene == row.id, scene_facts.c.kind == "name")
    return {row.name, *connection.execute(query).scalars()}


def _pattern(scene: str, names: Iterable[str]) -> re.Pattern[str]:
    """Match the scene's id, its short form, and its names as whole words."""
    words = "|".join(re.escape(name) for name in sorted(names, key=len, reverse=True))
    return re.compile(rf"{scene}|\b{scene[:12]}\b|(?<!\w)(?:{words})(?!\w)")


def _scrub(connection: Connection, scene: str, names: set[str]) -> None:
    """Remove the scene from texts that gsmap generated about other scenes and objects."""
    pattern = _pattern(scene, names)
    for table, columns in _GENERATED_TEXTS:
        for line in connection.execute(select(table)).mappings().all():
            changed = {column: _replace_scene(line[column], pattern) for column in columns}
            changed = {column: value for column, value in changed.items() if value != line[column]}
            if changed:
                keys = [column == line[column.name] for column in table.primary_key.columns]
                connection.execute(update(table).where(*keys).values(**changed))
    for row in connection.execute(select(results.c.number, results.c.about)).all():
        notes = _replace_scene(row.about.get("notes"), pattern)
        if notes != row.about.get("notes"):
            about = {**row.about, "notes": notes}
            connection.execute(update(results).where(results.c.number == row.number).values(about=about))


def _replace_scene(value: Any, pattern: re.Pattern[str]) -> Any:
    if isinstance(value, str):
        return pattern.sub(_PURGED, value)
    if isinstance(value, list):
        return [_replace_scene(item, pattern) for item in value]
    if isinstance(value, dict):  # a provenance: remove the scene from its lists
        return {
            key: [_replace_scene(item, pattern) for item in part if not pattern.fullmatch(str(item))]
            if isinstance(part, list)
            else _replace_scene(part, pattern)
            for key, part in value.items()
        }
    return value


def _mentions(connection: Connection, scene: str, names: set[str]) -> list[str]:
    """Return the annotations of other scenes and objects that mention the scene, described without its name."""
    pattern = _pattern(scene, names)
    found = []
    for table, column, of in _USER_TEXTS:
        for line in connection.execute(select(table)).mappings():
            if pattern.search(line[column]):
                found.append(f"a {line.get('kind', 'note')} of {of} {line[of]}")
    return found


# --- copies elsewhere ------------------------------------------------------------------------------------------------


def _backups_of_map(store: Store) -> list[tuple[str, str]]:
    """Return (time, name) of each snapshot, also of snapshots that only the map records since this branch was made."""
    with contextlib.ExitStack() as stack:
        catalogs = [store]
        if store.branch:
            catalogs.insert(0, stack.enter_context(Store.open(store.home, "r")))
        every = [backup for one in catalogs for backup in one.backups.list()]
    return [(one.created_at, f"{one.target} {one.snapshot}") for one in every]


def _backups(connection: Connection, scene: Row[Any], of_map: Iterable[tuple[str, str]]) -> list[str]:
    """Return the snapshots made since the scene first existed, and those recorded by its earlier purges."""
    pairs = (registrations.c.target == scene.id) | (registrations.c.source == scene.id)
    # `ingested_at` is the last ingest, and scenes from older releases have no fact of the first one.
    firsts = [
        select(func.min(scene_facts.c.created_at)).where(scene_facts.c.scene == scene.id),
        select(func.min(registrations.c.created_at)).where(pairs),
        select(func.min(revisions.c.created_at)).join(poses, holds_in_revision(poses)).where(poses.c.scene == scene.id),
    ]
    seen = [connection.execute(query).scalar() for query in firsts]
    since = min([scene.ingested_at, *(when for when in seen if when is not None)])
    earlier = connection.execute(select(purges.c.receipt).where(purges.c.scene == scene.id).order_by(purges.c.number))
    recorded = [name for receipt in earlier.scalars() for name in receipt["backups"]]
    return list(dict.fromkeys([*recorded, *(name for when, name in of_map if when >= since)]))


def _linked_files(store: Store, connection: Connection, scene: str) -> int:
    """Count the scene's files with other hard links on this disk, in another map or a clone."""
    with_it = (comparisons.c.older == scene) | (comparisons.c.newer == scene)
    of_scene = {
        "scenes": select(scenes.c.group_id).where(scenes.c.id == scene, scenes.c.group_id.is_not(None)),
        "changes": select(comparisons.c.group_id).where(with_it, comparisons.c.group_id.is_not(None)),
        "photos": select(photo_sightings.c.group_id).where(
            photo_sightings.c.scene == scene, photo_sightings.c.group_id.is_not(None)
        ),
    }
    ids = [(kind, group) for kind, query in of_scene.items() for group in connection.execute(query).scalars()]
    derived = select(results.c.kind, results.c.group_id).where(results.c.scene == scene)
    ids += [(row.kind, row.group_id) for row in connection.execute(derived) if row.group_id is not None]
    found = (files_below(store.arrays.root / kind / name) for kind, name in ids)
    return sum(entry.st_nlink > 1 for group in found for entry in group.values())


def _copies(store: Store) -> list[str]:
    """Return the catalog copies that migrations left, which contain the scene."""
    pattern = re.compile(re.escape(sqlite.FILE) + r"\.[0-9A-Za-z]+\.bak[a-z0-9.-]*")
    return sorted(p.name for p in store.folder.iterdir() if pattern.fullmatch(p.name) and is_file(p))
