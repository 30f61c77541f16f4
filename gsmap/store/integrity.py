"""`check` reads every byte; `prune` reclaims what nothing names."""

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
from gsmap.store.arrays import Arrays, StoredFile
from gsmap.store.branches import Others, bury_leftovers, strangers
from gsmap.store.catalog import Catalog, now
from gsmap.store.change_rows import KIND as CHANGES
from gsmap.store.change_rows import newest_of_all
from gsmap.store.explained import PRUNE_MAY, explained
from gsmap.store.groups import manifest
from gsmap.store.indexes import KIND as INDEXES
from gsmap.store.layout import CHUNK_ROWS
from gsmap.store.models import FOLDER, model_path, open_model
from gsmap.store.objects import forget_sets
from gsmap.store.photos import KIND as PHOTOS
from gsmap.store.photos import claimed_groups
from gsmap.store.revisions import forget_dropped, named_by_kept
from gsmap.store.schema import (
    CHUNK_BOXES,
    comparisons,
    files,
    graphs,
    groups,
    index_segments,
    models,
    photo_sightings,
    revisions,
    scenes,
    view_features,
)
from gsmap.store.view_features import KIND as VIEWS
from gsmap.types.progress import Progress

_WORTH_BYTES = 64 << 10
_WORTH_SHARE = 0.05  # of the file: less stays for rows to come
_log = logging.getLogger("gsmap.store")
_AGAIN = "what was to be reclaimed and is still there goes with the next prune"


@dataclass(frozen=True)
class Check:
    """What `check` found.

    Args:
        problems: one line each; empty for a sound map.
        orphans: folders that no row names (a crash left them; `prune` removes them); no harm.
        num_groups, num_bytes: what was read.
        unverified: what cannot be compared with what was written, and why.
    """

    problems: tuple[str, ...]
    orphans: tuple[str, ...]
    num_groups: int
    num_bytes: int
    unverified: tuple[str, ...] = ()

    @property
    def ok(self) -> bool:
        return not self.problems


@dataclass(frozen=True)
class Pruned:
    """What `prune` reclaimed (or would).

    Args:
        scenes: names of removed scenes whose arrays were dropped.
        revisions: numbers that can no longer be exported in full.
        num_graphs, num_orphans, num_models: graphs, folders without a row, and copies of models that were forgotten.
        num_bytes: on disk, of all of these, of replaced graphs, and of what dead writers left; and by how much the
            catalog's file shrank, which no dry run knows.
        dry_run: nothing was changed.
    """

    scenes: tuple[str, ...] = ()
    revisions: tuple[int, ...] = ()
    num_graphs: int = 0
    num_orphans: int = 0
    num_models: int = 0
    num_bytes: int = 0
    dry_run: bool = False


def check(
    catalog: Catalog,
    arrays: Arrays,
    progress: Progress | None = None,
    *,
    read: set[tuple[str, tuple[StoredFile, ...]]] | None = None,
    location: str | None = None,
) -> Check:
    """Read every byte of the map and compare it with what was written; see `Check`.

    Args:
        read: groups that are known to be as this manifest says, and need not be read again; those that are, are added.
        location: what opens the map for writing, to name in advice; None for one that cannot be written.
    """
    read = set() if read is None else read
    home = arrays.root.parent
    with catalog.read() as connection:
        named = {row.id: row.kind for row in connection.execute(select(groups).order_by(groups.c.id))}
        manifests = {group: manifest(connection, group) for group in named}
        unread = {group: kind for group, kind in named.items() if (group, manifests[group]) not in read}
        problems = _row_problems(connection, arrays)
        spare = {group for _, group in _waste(connection, None).doomed}
        if catalog.is_sqlite:
            problems += sqlite.integrity_problems(connection)
    problems += [f"{arrays.url}/{name} does not belong there: remove it" for name in arrays.strangers()]
    problems += [
        f"{home / name} is no branch: put back what it lacks, or move it out of the map" for name in strangers(home)
    ]
    problems += _odd_models(home)
    if catalog.is_sqlite:
        problems += catalog.page_problems()
    unverified = tuple(catalog.unverified())
    for i, (group, kind) in enumerate(unread.items()):
        if progress:
            progress(i / len(unread), f"{kind}/{group[:12]}")
        if group in spare and not arrays.exists(kind, group):
            continue  # a prune on a full disk was interrupted: nothing claims it
        found = arrays.problems(kind, group, manifests[group])
        if not found:
            read.add((group, manifests[group]))
        if found:  # unless it was pruned or mended meanwhile
            with catalog.read() as connection:
                if manifest(connection, group) == manifests[group]:
                    helps = _advice(connection, kind, group, location)
                    problems += [problem + helps for problem in found]
    try:
        named_by_any = named.items() | {(group, kind) for kind, group in Others(home, catalog.folder).groups()}
        orphans = tuple(f"{kind}/{name}" for kind, name in arrays.groups() if (name, kind) not in named_by_any)
    except StoreError:  # a branch that cannot be read may need any of them; who checks the map is told of it
        orphans = ()
    if strangers(home):
        orphans = ()
    num_bytes = sum(f.size_bytes for group in unread for f in manifests[group])
    if progress:
        progress(1.0, "checked")
    return Check(tuple(problems), orphans, len(unread), num_bytes, unverified)


def prune(catalog: Catalog, arrays: Arrays, *, keep_revisions: int | None = None, dry_run: bool = False) -> Pruned:
    """Reclaim the arrays of removed scenes that no kept revision names, their graphs, and what crashes left.

    What another branch or tag of the map names stays, whichever of them is pruned.

    Args:
        keep_revisions: keep only this many of the newest; of older ones only their line in the list is left. None:
            all. The newest poses stay in any case.
        dry_run: only say what would go (also of a map that was opened for reading).

    Raises:
        ConfigError: a negative number of revisions.
        DiskFullError: even what could be reclaimed first did not make the room that rows need.
    """
    if keep_revisions is not None and keep_revisions < 0:
        raise ConfigError(
            f"the number of revisions to keep must not be negative, got {keep_revisions}", code="out_of_range"
        )
    try:
        return _prune(catalog, arrays, keep_revisions, dry_run)
    except DiskFullError as error:  # no advice to do what is being done
        raise DiskFullError(str(error).replace(PRUNE_MAY, "")) from error


def _prune(catalog: Catalog, arrays: Arrays, keep_revisions: int | None, dry_run: bool) -> Pruned:
    others = verified(catalog, arrays)  # before anything is changed
    with contextlib.nullcontext() if dry_run else catalog.lock():
        with catalog.read() as connection:
            waste = _waste(connection, keep_revisions)
            spare = _waste(connection, None).doomed
        # What no row names goes first: on a full disk that makes the room that rows need.
        orphans = _reclaim(catalog, arrays, others, dry_run=dry_run, besides=waste.doomed if dry_run else ())
        num_bytes = orphans.num_bytes
        if not dry_run:
            try:
                _drop_rows(catalog, waste)
            except DiskFullError:  # then what nothing claims whatever is kept, which `check` does not miss
                with explained(catalog.folder, _AGAIN), arrays.lock():
                    for group in set(spare) - others.groups():
                        num_bytes += arrays.size_bytes(*group)
                        arrays.drop(*group)
                _drop_rows(catalog, waste)
            # The rows are gone for good: a crash from here on leaves orphans for the next prune of any branch.
            num_bytes += _reclaim(catalog, arrays, others).num_bytes
            num_bytes += _give_back(catalog)
    return Pruned(
        scenes=tuple(name for name, _ in waste.scenes),
        revisions=tuple(waste.revisions),
        num_graphs=len(waste.graphs),
        num_orphans=len(set(orphans.groups) - set(waste.doomed)),
        num_models=orphans.num_models,
        num_bytes=num_bytes,
        dry_run=dry_run,
    )


def _give_back(catalog: Catalog) -> int:
    """Give the room of rows that are gone back to the disk, where it is worth it. (A server does so by itself.)

    Returns:
        By how many bytes the catalog's file is smaller.
    """
    if not catalog.is_sqlite:
        return 0
    file = catalog.folder / sqlite.FILE
    try:
        with explained(catalog.folder):
            before = file.stat().st_size
            if sqlite.num_free_bytes(catalog.engine) > max(_WORTH_BYTES, _WORTH_SHARE * before):
                sqlite.vacuum(catalog.engine, file)
            return max(0, before - file.stat().st_size)
    except StoreError as error:  # a full disk, or a reader: what is gone is gone, and its room is used again
        _log.warning("%s keeps the room of what was dropped: %s", sqlite.FILE, error)
        return 0


@dataclass(frozen=True)
class Reclaimed:
    """What no row of any catalog named: (kind, id) of groups, copies of models, and the bytes of all of it."""

    groups: tuple[tuple[str, str], ...]
    num_models: int
    num_bytes: int


def verified(catalog: Catalog, arrays: Arrays) -> Others:
    """The other catalogs over the same arrays, every page of them and of this one compared with what was written.

    Raises:
        CorruptError: one of them is damaged, and may need arrays that it does not seem to name.
        StoreError: one cannot be read, or something among the branches is none.
    """
    others = Others(arrays.root.parent, catalog.folder)
    catalog.verify(whole=True)
    others.verify()
    others.groups()
    return others


def reclaim(catalog: Catalog, arrays: Arrays) -> Reclaimed:
    """Delete the arrays and models that no row of the map or of any of its branches names, and what crashes left.

    Raises:
        CorruptError, StoreError: as `verified`; nothing was deleted.
    """
    return _reclaim(catalog, arrays, verified(catalog, arrays))


def _reclaim(
    catalog: Catalog,
    arrays: Arrays,
    others: Others,
    *,
    dry_run: bool = False,
    besides: Collection[tuple[str, str]] = (),
) -> Reclaimed:
    """See `reclaim`.

    Args:
        dry_run: only say what would go.
        besides: groups that rows name and that go all the same.
    """
    home = arrays.root.parent
    with explained(catalog.folder, _AGAIN), contextlib.nullcontext() if dry_run else arrays.lock():
        forgotten = _forgotten_models(catalog, others, home)
        # Asked under the lock of the arrays: nobody comes to name any of them from here on.
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
            arrays.drop_models(_standing_models(catalog, others))
            for path in forgotten:
                remove_file(home, FOLDER, path.name)
            for name in abandoned:
                remove_file(catalog.folder, name)
            bury_leftovers(home)
        num_bytes += arrays.drop_leftovers(dry_run=dry_run)
    return Reclaimed(tuple(bodies), len(forgotten), num_bytes)


@dataclass(frozen=True)
class _Waste:
    """What may go.

    Args:
        revisions: numbers of those that are not kept.
        scenes: names and numbers of removed scenes that no kept revision names.
        graphs: keys of their graphs.
        lost: ids of all scenes that are removed and that no kept revision names.
        doomed: kinds and names of the groups that nothing claims then.
    """

    revisions: list[int]
    scenes: list[tuple[str, int]]
    graphs: list[str]
    lost: set[str]
    doomed: list[tuple[str, str]]


def _waste(connection: Connection, keep_revisions: int | None) -> _Waste:
    dropped = _revisions_to_drop(connection, keep_revisions)
    named = named_by_kept(after=max(dropped, default=0))
    gone = scenes.c.removed_at.is_not(None) & scenes.c.id.not_in(named)
    of_scene = graphs.join(scenes, scenes.c.id == graphs.c.scene)
    dead = connection.execute(select(scenes).where(gone, scenes.c.group_id.is_not(None)))
    keys = connection.execute(select(graphs.c.key).select_from(of_scene).where(gone)).scalars()
    claimed = set(connection.execute(select(scenes.c.group_id).where(not_(gone))).scalars())
    claimed |= set(connection.execute(select(graphs.c.group_id).select_from(of_scene).where(not_(gone))).scalars())
    # Of a pair the newest comparison counts, as long as both of its scenes can be read.
    lost = set(connection.execute(select(scenes.c.id).where(gone)).scalars())
    claimed |= {row.group_id for row in newest_of_all(connection) if not {row.older, row.newer} & lost}
    claimed |= set(connection.execute(select(index_segments.c.group_id)).scalars())
    views = select(view_features.c.group_id).where(view_features.c.scene.not_in(lost))
    claimed |= set(connection.execute(views).scalars())
    claimed |= claimed_groups(connection, lost)
    known = {(g.kind, g.id) for g in connection.execute(select(groups))}
    return _Waste(
        dropped,
        [(row.name, row.number) for row in dead],
        list(keys),
        lost,
        sorted(group for group in known if group[1] not in claimed),
    )


def _drop_rows(catalog: Catalog, waste: _Waste) -> None:
    ids = [group for _, group in waste.doomed]
    with catalog.write() as connection:
        connection.execute(update(revisions).where(revisions.c.number.in_(waste.revisions)).values(dropped_at=now()))
        forget_dropped(connection)
        connection.execute(delete(graphs).where(graphs.c.key.in_(waste.graphs)))
        forget_sets(connection, waste.lost)
        connection.execute(delete(view_features).where(view_features.c.group_id.in_(ids)))
        for table in (scenes, comparisons, photo_sightings):
            connection.execute(update(table).where(table.c.group_id.in_(ids)).values(group_id=None))
        for _, number in waste.scenes:
            boxes = text(f"DELETE FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
            connection.execute(boxes, {"s": number})
        connection.execute(delete(files).where(files.c.group_id.in_(ids)))
        connection.execute(delete(groups).where(groups.c.id.in_(ids)))


def _advice(connection: Connection, kind: str, group: str, location: str | None) -> str:
    """What a damaged group is of, and what makes it whole; empty where the message says so already."""
    if kind == CHANGES:
        return _comparison_advice(connection, group, location)
    if kind == INDEXES:
        return " (the index of retrieval: it is made anew when the next new scene asks it)"
    if kind == VIEWS:
        return " (features of a scene's views: they are made anew when the next photograph is localised)"
    if kind == PHOTOS:
        return " (the small picture of a photo that is kept: remove the photo and add it again)"
    if kind != "graphs":
        return ""
    of_scene = graphs.join(scenes, scenes.c.id == graphs.c.scene)
    found = connection.execute(select(scenes).select_from(of_scene).where(graphs.c.group_id == group)).first()
    if found is None:
        return f" (a graph that nothing needs: gsmap prune {quote(location)})" if location else ""
    if location is None:
        return f" (the graph of scene {found.name}: restore the file from a backup)"
    again = f"gsmap describe {quote(location)} {quote(found.name)}"
    if found.removed_at is not None:
        again = f"gsmap restore-scene {quote(location)} {found.id[:12]}, then {again}"
    return f" (the graph of scene {found.name}: {again} makes it again)"


def _comparison_advice(connection: Connection, group: str, location: str | None) -> str:
    rows = [row for row in newest_of_all(connection) if row.group_id == group]
    name_of = {scene.id: scene.name for scene in connection.execute(select(scenes))}
    for row in rows:
        pair = f"{name_of[row.older]}:{name_of[row.newer]}"
        again = "restore the file from a backup"
        if location is not None:
            again = f"gsmap changes {quote(location)} {quote(pair)} finds them again"
        return f" (the changes of {pair}: {again})"
    return f" (changes of an earlier comparison: gsmap prune {quote(location)})" if location else ""


def _row_problems(connection: Connection, arrays: Arrays) -> list[str]:
    home, out = arrays.root.parent, []
    for row in connection.execute(select(scenes).where(scenes.c.removed_at.is_(None))):
        if row.group_id is None:
            out.append(f"scene {row.name} has no arrays")
        query = text(f"SELECT count(*) FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
        boxes = connection.execute(query, {"s": row.number}).scalar_one()
        if boxes != -(-row.num_gaussians // CHUNK_ROWS):
            out.append(f"scene {row.name} has {boxes} chunk boxes, not one for every {CHUNK_ROWS} Gaussians")
    for row in connection.execute(select(models).where(models.c.removed_at.is_(None))):
        try:
            path = model_path(home, row)
            if row.copied:
                arrays.bring_model(row.path)
            opened = open_model(home, row)
        except FileNotFoundError as error:
            out.append(f"model {row.name} is missing: {error.filename}")
            continue
        except (OSError, GsmapError) as error:
            out.append(f"model {row.name} cannot be read: {error}")
            continue
        with open(opened, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != row.sha256:
                out.append(f"model {row.name} differs from what was added: {path}")
    return out


def _revisions_to_drop(connection: Connection, keep: int | None) -> list[int]:
    """Numbers to drop now: the oldest of those that are kept."""
    query = select(revisions.c.number).where(revisions.c.dropped_at.is_(None)).order_by(revisions.c.number)
    numbers = list(connection.execute(query).scalars())
    return [] if keep is None else numbers[: max(0, len(numbers) - max(keep, 0))]


def _standing_models(catalog: Catalog, others: Others) -> set[str]:
    """Paths of the models that any catalog names."""
    with catalog.read() as connection:
        standing = set(connection.execute(select(models.c.path).where(models.c.removed_at.is_(None))).scalars())
    return standing | others.models()


def _forgotten_models(catalog: Catalog, others: Others, home: Path) -> list[Path]:
    """Copies of models that no row of any catalog names any more. What is no plain file is no copy of ours."""
    standing = _standing_models(catalog, others)
    return [path for path in _in_models(home) if is_file(path) and f"{FOLDER}/{path.name}" not in standing]


def _odd_models(home: Path) -> list[str]:
    place = home / FOLDER
    if os.path.lexists(place) and not is_folder(place):
        return [f"{place} is no folder (a link, perhaps): put a folder in its place"]
    return [f"{path} does not belong there: remove it" for path in _in_models(home) if not is_file(path)]


def _in_models(home: Path) -> list[Path]:
    place = home / FOLDER
    return sorted(place.iterdir()) if is_folder(place) else []
