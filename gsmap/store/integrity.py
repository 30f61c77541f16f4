"""Verify every byte of a map (`check`), and reclaim arrays that no row names (`prune`)."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from shlex import quote

from sqlalchemy import Connection, delete, not_, select, text, update

from gsmap.durable import is_file, is_folder, remove_file
from gsmap.errors import ConfigError, DiskFullError, GsmapError, StoreError
from gsmap.store import sqlite, staging
from gsmap.store.array_groups import manifest
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.branches import OtherCatalogs, remove_leftovers, unknown_entries
from gsmap.store.catalog import Catalog, now
from gsmap.store.change_rows import KIND as CHANGES
from gsmap.store.change_rows import newest_of_all
from gsmap.store.error_translation import PRUNE_MAY, translate_errors
from gsmap.store.graphs import KIND as GRAPHS
from gsmap.store.layout import CHUNK_ROWS, repair_of
from gsmap.store.models import FOLDER, model_path, open_model
from gsmap.store.objects import forget_sets
from gsmap.store.photos import claimed_groups
from gsmap.store.revisions import forget_dropped, scenes_in_kept_revisions
from gsmap.store.scenes import KIND as SCENES
from gsmap.store.schema import (
    CHUNK_BOXES,
    comparisons,
    files,
    groups,
    models,
    photo_sightings,
    results,
    revisions,
    scenes,
)
from gsmap.types.progress import Progress
from gsmap.types.rows.maps import CheckReport, PruneReport

_WORTH_BYTES = 64 << 10
_WORTH_SHARE = 0.05  # of the file: smaller free space is kept for new rows
_log = logging.getLogger("gsmap.store")
_RECLAIM_LATER = "files that could not be reclaimed remain until the next gsmap prune"


def check(
    catalog: Catalog,
    arrays: Arrays,
    progress: Progress | None = None,
    *,
    read: set[tuple[str, tuple[StoredFile, ...]]] | None = None,
    location: str | None = None,
) -> CheckReport:
    """Read every byte of the map and compare it with its digests.

    Args:
        read: groups with manifests already verified, which are not read again; verified groups are added.
        location: string that opens the map for writing, for advice; None for a read-only map.
    """
    read = set() if read is None else read
    home = arrays.root.parent
    with catalog.read() as connection:
        named = {row.id: row.kind for row in connection.execute(select(groups).order_by(groups.c.id))}
        manifests = {group: manifest(connection, group) for group in named}
        unread = {group: kind for group, kind in named.items() if (group, manifests[group]) not in read}
        problems = _row_problems(connection, arrays)
        spare = {group for _, group in _find_garbage(connection, None).groups}
        if catalog.is_sqlite:
            problems += sqlite.integrity_problems(connection)
    problems += [f"{arrays.url}/{name} is not a file of the map: remove it" for name in arrays.unknown_entries()]
    problems += [
        f"{home / name} is not a valid branch: restore what it lacks, or move it out of the map"
        for name in unknown_entries(home)
    ]
    problems += _model_entry_problems(home)
    if catalog.is_sqlite:
        problems += catalog.page_problems()
    unverified = tuple(catalog.unverified())
    for i, (group, kind) in enumerate(unread.items()):
        if progress:
            progress(i / len(unread), f"{kind}/{group[:12]}")
        if group in spare and not arrays.exists(kind, group):
            continue  # an interrupted prune on a full disk deleted it
        found = arrays.problems(kind, group, manifests[group])
        if not found:
            read.add((group, manifests[group]))
        if found:  # re-read the manifest: it may have been pruned or repaired meanwhile
            with catalog.read() as connection:
                if manifest(connection, group) == manifests[group]:
                    helps = _advice(connection, kind, group, location)
                    problems += [problem + helps for problem in found]
    try:
        named_by_any = named.items() | {(group, kind) for kind, group in OtherCatalogs(home, catalog.folder).groups()}
        orphans = tuple(f"{kind}/{name}" for kind, name in arrays.groups() if (name, kind) not in named_by_any)
    except StoreError:  # an unreadable branch may need any of them; reported as a problem of that branch
        orphans = ()
    if unknown_entries(home):
        orphans = ()
    num_bytes = sum(f.size_bytes for group in unread for f in manifests[group])
    if progress:
        progress(1.0, "checked")
    return CheckReport(
        ok=not problems,
        problems=tuple(problems),
        orphans=orphans,
        num_groups=len(unread),
        num_bytes=num_bytes,
        unverified=unverified,
    )


def prune(catalog: Catalog, arrays: Arrays, *, keep_revisions: int | None = None, dry_run: bool = False) -> PruneReport:
    """Reclaim arrays and graphs of removed scenes that no kept revision uses, and leftovers of crashes.

    What another branch or tag of the map names stays.

    Args:
        keep_revisions: number of newest revisions to keep; of older ones only the entry in the list stays. Default:
            all. The newest poses always stay.
        dry_run: only compute the result; also for a read-only map.

    Raises:
        ConfigError: a negative number of revisions.
        DiskFullError: deleting unnamed groups did not free the space that row changes need.
    """
    if keep_revisions is not None and keep_revisions < 0:
        raise ConfigError(
            f"the number of revisions to keep must not be negative, got {keep_revisions}", code="out_of_range"
        )
    try:
        return _prune(catalog, arrays, keep_revisions, dry_run)
    except DiskFullError as error:  # the advice to prune makes no sense here
        raise DiskFullError(str(error).replace(PRUNE_MAY, "")) from error


def _prune(catalog: Catalog, arrays: Arrays, keep_revisions: int | None, dry_run: bool) -> PruneReport:
    others = verify_catalogs(catalog, arrays)  # before any change
    with contextlib.nullcontext() if dry_run else catalog.lock():
        with catalog.read() as connection:
            garbage = _find_garbage(connection, keep_revisions)
            spare = _find_garbage(connection, None).groups
        # Delete unnamed groups first: on a full disk that frees the space that row changes need.
        orphans = _reclaim(catalog, arrays, others, dry_run=dry_run, besides=garbage.groups if dry_run else ())
        num_bytes = orphans.num_bytes
        if not dry_run:
            try:
                _drop_rows(catalog, garbage)
            except DiskFullError:  # delete groups that are garbage whatever is kept; `check` does not report them
                with translate_errors(catalog.folder, _RECLAIM_LATER), arrays.lock():
                    for group in set(spare) - others.groups():
                        num_bytes += arrays.size_bytes(*group)
                        arrays.drop(*group)
                _drop_rows(catalog, garbage)
            # The rows are deleted: a crash from here on leaves orphans for the next prune of any branch.
            num_bytes += _reclaim(catalog, arrays, others).num_bytes
            num_bytes += _give_back(catalog)
    return PruneReport(
        scene_names=tuple(name for name, _ in garbage.scenes),
        revisions=tuple(garbage.revisions),
        num_graphs=garbage.num_graphs,
        num_orphans=len(set(orphans.groups) - set(garbage.groups)),
        num_models=orphans.num_models,
        num_bytes=num_bytes,
        dry_run=dry_run,
    )


def _give_back(catalog: Catalog) -> int:
    """Shrink the catalog file if enough of it is unused; a database server does this by itself.

    Returns:
        By how many bytes the file shrank.
    """
    if not catalog.is_sqlite:
        return 0
    file = catalog.folder / sqlite.FILE
    try:
        with translate_errors(catalog.folder):
            before = file.stat().st_size
            if sqlite.num_free_bytes(catalog.engine) > max(_WORTH_BYTES, _WORTH_SHARE * before):
                sqlite.vacuum(catalog.engine, file)
            return max(0, before - file.stat().st_size)
    except StoreError as error:  # a full disk, or a reader: the free space inside the file is reused
        _log.warning("%s could not be shrunk, and keeps the space of dropped rows: %s", sqlite.FILE, error)
        return 0


@dataclass(frozen=True)
class ReclaimResult:
    """The reclaimed groups (kind, id), the number of reclaimed model copies, and the bytes of both."""

    groups: tuple[tuple[str, str], ...]
    num_models: int
    num_bytes: int


def verify_catalogs(catalog: Catalog, arrays: Arrays) -> OtherCatalogs:
    """Verify every page of this catalog and of all other catalogs for the same arrays; return the other catalogs.

    Raises:
        CorruptError: a catalog is damaged, and may need arrays that it does not seem to name.
        StoreError: a catalog cannot be read, or an entry of the branches folder is not a branch.
    """
    others = OtherCatalogs(arrays.root.parent, catalog.folder)
    catalog.verify(whole=True)
    others.verify()
    others.groups()
    return others


def reclaim(catalog: Catalog, arrays: Arrays) -> ReclaimResult:
    """Delete arrays and models that no row of the map or its branches names, and leftovers of crashes.

    Raises:
        CorruptError, StoreError: as `verify_catalogs`; nothing was deleted.
    """
    return _reclaim(catalog, arrays, verify_catalogs(catalog, arrays))


def _reclaim(
    catalog: Catalog,
    arrays: Arrays,
    others: OtherCatalogs,
    *,
    dry_run: bool = False,
    besides: Collection[tuple[str, str]] = (),
) -> ReclaimResult:
    """Reclaim like `reclaim`; the catalogs must be verified already.

    Args:
        dry_run: only compute the result.
        besides: groups to delete although rows name them.
    """
    home = arrays.root.parent
    with translate_errors(catalog.folder, _RECLAIM_LATER), contextlib.nullcontext() if dry_run else arrays.lock():
        forgotten = _forgotten_models(catalog, others, home)
        # Read under the lock of the arrays: no process can name a group from here on.
        with catalog.read() as connection:
            known = {(g.kind, g.id) for g in connection.execute(select(groups))}
        named = known - set(besides) | others.groups()
        bodies = [group for group in arrays.groups() if group not in named]
        num_bytes = sum(arrays.size_bytes(*group) for group in bodies)
        abandoned = staging.abandoned_files(catalog.folder)
        num_bytes += sum(path.stat().st_size for path in forgotten) + sum(abandoned.values())
        if not dry_run:
            for group in bodies:
                arrays.drop(*group)
            arrays.delete_models(_current_models(catalog, others))
            for path in forgotten:
                remove_file(home, FOLDER, path.name)
            for name in abandoned:
                remove_file(catalog.folder, name)
            remove_leftovers(home)
        num_bytes += arrays.drop_leftovers(dry_run=dry_run)
    return ReclaimResult(tuple(bodies), len(forgotten), num_bytes)


@dataclass(frozen=True)
class _Garbage:
    """Rows and groups that may be deleted.

    Args:
        revisions: numbers of the revisions that are not kept.
        scenes: names and numbers of removed scenes with arrays that no kept revision uses.
        num_graphs: number of their graphs.
        lost: ids of all removed scenes that no kept revision uses.
        groups: kinds and names of the groups without a referrer afterwards.
    """

    revisions: list[int]
    scenes: list[tuple[str, int]]
    num_graphs: int
    lost: set[str]
    groups: list[tuple[str, str]]


def _find_garbage(connection: Connection, keep_revisions: int | None) -> _Garbage:
    dropped = _revisions_to_drop(connection, keep_revisions)
    named = scenes_in_kept_revisions(after=max(dropped, default=0))
    gone = scenes.c.removed_at.is_not(None) & scenes.c.id.not_in(named)
    dead = connection.execute(select(scenes).where(gone, scenes.c.group_id.is_not(None)))
    claimed = set(connection.execute(select(scenes.c.group_id).where(not_(gone))).scalars())
    # The newest comparison of a pair is current while both of its scenes have arrays.
    lost = set(connection.execute(select(scenes.c.id).where(gone)).scalars())
    claimed |= {row.group_id for row in newest_of_all(connection) if not {row.older, row.newer} & lost}
    derived = connection.execute(select(results.c.kind, results.c.scene, results.c.group_id)).all()
    claimed |= {row.group_id for row in derived if row.scene not in lost}
    num_graphs = sum(row.kind == GRAPHS and row.scene in lost for row in derived)
    claimed |= claimed_groups(connection, lost)
    known = {(g.kind, g.id) for g in connection.execute(select(groups))}
    return _Garbage(
        dropped,
        [(row.name, row.number) for row in dead],
        num_graphs,
        lost,
        sorted(group for group in known if group[1] not in claimed),
    )


def _drop_rows(catalog: Catalog, garbage: _Garbage) -> None:
    ids = [group for _, group in garbage.groups]
    with catalog.write() as connection:
        connection.execute(update(revisions).where(revisions.c.number.in_(garbage.revisions)).values(dropped_at=now()))
        forget_dropped(connection)
        connection.execute(delete(results).where(results.c.scene.in_(garbage.lost)))
        forget_sets(connection, garbage.lost)
        for table in (scenes, comparisons, photo_sightings):
            connection.execute(update(table).where(table.c.group_id.in_(ids)).values(group_id=None))
        for _, number in garbage.scenes:
            boxes = text(f"DELETE FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
            connection.execute(boxes, {"s": number})
        connection.execute(delete(files).where(files.c.group_id.in_(ids)))
        connection.execute(delete(groups).where(groups.c.id.in_(ids)))


def _advice(connection: Connection, kind: str, group: str, location: str | None) -> str:
    """Return how to repair a damaged group; empty if the message states this already."""
    if kind == CHANGES:
        return _comparison_advice(connection, group, location)
    if kind == GRAPHS:
        return _graph_advice(connection, group, location)
    return "" if kind == SCENES else f" ({repair_of(kind)})"


def _graph_advice(connection: Connection, group: str, location: str | None) -> str:
    of_scene = results.join(scenes, scenes.c.id == results.c.scene)
    found = connection.execute(select(scenes).select_from(of_scene).where(results.c.group_id == group)).first()
    if found is None:
        return f" (an unused graph: remove it with gsmap prune {quote(location)})" if location else ""
    if location is None:
        return f" (the graph of scene {found.name}: restore the file from a backup)"
    again = f"gsmap describe {quote(location)} {quote(found.name)}"
    if found.removed_at is not None:
        again = f"gsmap restore-scene {quote(location)} {found.id[:12]}, then {again}"
    return f" (the graph of scene {found.name}: compute it again with {again})"


def _comparison_advice(connection: Connection, group: str, location: str | None) -> str:
    rows = [row for row in newest_of_all(connection) if row.group_id == group]
    name_of = {scene.id: scene.name for scene in connection.execute(select(scenes))}
    for row in rows:
        pair = f"{name_of[row.older]}:{name_of[row.newer]}"
        again = "restore the file from a backup"
        if location is not None:
            again = f"compute them again with gsmap changes {quote(location)} {quote(pair)}"
        return f" (the changes of {pair}: {again})"
    return f" (changes of an earlier comparison: remove them with gsmap prune {quote(location)})" if location else ""


def _row_problems(connection: Connection, arrays: Arrays) -> list[str]:
    home, out = arrays.root.parent, []
    for row in connection.execute(select(scenes).where(scenes.c.removed_at.is_(None))):
        if row.group_id is None:
            out.append(f"scene {row.name} has no arrays")
        query = text(f"SELECT count(*) FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
        boxes = connection.execute(query, {"s": row.number}).scalar_one()
        if boxes != -(-row.num_gaussians // CHUNK_ROWS):
            out.append(f"scene {row.name} has {boxes} chunk boxes; expected one for every {CHUNK_ROWS} Gaussians")
    for row in connection.execute(select(models).where(models.c.removed_at.is_(None))):
        try:
            path = model_path(home, row)
            if row.copied:
                arrays.fetch_model(row.path)
            opened = open_model(home, row)
        except FileNotFoundError as error:
            out.append(f"model {row.name} is missing: {error.filename}")
            continue
        except (OSError, GsmapError) as error:
            out.append(f"model {row.name} cannot be read: {error}")
            continue
        with open(opened, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != row.sha256:
                out.append(f"model {row.name} differs from the file that was added: {path}")
    return out


def _revisions_to_drop(connection: Connection, keep: int | None) -> list[int]:
    """Return the numbers of the oldest kept revisions that exceed the limit."""
    query = select(revisions.c.number).where(revisions.c.dropped_at.is_(None)).order_by(revisions.c.number)
    numbers = list(connection.execute(query).scalars())
    return [] if keep is None else numbers[: max(0, len(numbers) - max(keep, 0))]


def _current_models(catalog: Catalog, others: OtherCatalogs) -> set[str]:
    """Return the paths of the models that any catalog names."""
    with catalog.read() as connection:
        current = set(connection.execute(select(models.c.path).where(models.c.removed_at.is_(None))).scalars())
    return current | others.models()


def _forgotten_models(catalog: Catalog, others: OtherCatalogs, home: Path) -> list[Path]:
    """Return model copies that no row of any catalog names; other entries are not gsmap's."""
    current = _current_models(catalog, others)
    return [path for path in _model_entries(home) if is_file(path) and f"{FOLDER}/{path.name}" not in current]


def _model_entry_problems(home: Path) -> list[str]:
    place = home / FOLDER
    if os.path.lexists(place) and not is_folder(place):
        return [f"{place} is not a folder (it may be a link): put a folder in its place"]
    return [f"{path} is not a file of the map: remove it" for path in _model_entries(home) if not is_file(path)]


def _model_entries(home: Path) -> list[Path]:
    place = home / FOLDER
    return sorted(place.iterdir()) if is_folder(place) else []
