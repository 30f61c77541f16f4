"""`check` reads every byte; `prune` reclaims what nothing names."""

from __future__ import annotations

import contextlib
import hashlib
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, delete, not_, select, text, update

from gsmap.errors import ConfigError, DiskFullError
from gsmap.store import sqlite
from gsmap.store.arrays import CHUNK_ROWS, Arrays
from gsmap.store.catalog import Catalog, now
from gsmap.store.explained import explained
from gsmap.store.groups import manifest
from gsmap.store.models import FOLDER
from gsmap.store.schema import CHUNK_BOXES, files, graphs, groups, models, poses, revisions, scenes
from gsmap.types.progress import Progress

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
        num_bytes: on disk, of all of these, of replaced graphs, and of what dead writers left.
        dry_run: nothing was changed.
    """

    scenes: tuple[str, ...] = ()
    revisions: tuple[int, ...] = ()
    num_graphs: int = 0
    num_orphans: int = 0
    num_models: int = 0
    num_bytes: int = 0
    dry_run: bool = False


def check(catalog: Catalog, arrays: Arrays, progress: Progress | None = None) -> Check:
    """Read every byte of the map and compare it with what was written; see `Check`."""
    with catalog.read() as connection:
        named = {row.id: row.kind for row in connection.execute(select(groups).order_by(groups.c.id))}
        manifests = {group: manifest(connection, group) for group in named}
        spare = {group for _, group in _waste(connection, arrays, None).doomed}
        problems = _row_problems(connection, catalog.folder)
        if catalog.is_sqlite:
            problems += sqlite.integrity_problems(connection)
    if catalog.is_sqlite:
        problems += catalog.page_problems()
    unverified = tuple(catalog.unverified())
    for i, (group, kind) in enumerate(named.items()):
        if progress:
            progress(i / len(named), f"{kind}/{group[:12]}")
        if group in spare and not (arrays.root / kind / group).exists():
            continue  # a prune on a full disk was interrupted: nothing claims it
        found = arrays.problems(kind, group, manifests[group])
        if found:  # unless it was pruned or mended meanwhile
            with catalog.read() as connection:
                problems += found if manifest(connection, group) == manifests[group] else []
    orphans = tuple(f"{kind}/{name}" for kind, name in arrays.groups() if named.get(name) != kind)
    num_bytes = sum(f.size_bytes for files in manifests.values() for f in files)
    if progress:
        progress(1.0, "checked")
    return Check(tuple(problems), orphans, len(named), num_bytes, unverified)


def prune(catalog: Catalog, arrays: Arrays, *, keep_revisions: int | None = None, dry_run: bool = False) -> Pruned:
    """Reclaim the arrays of removed scenes that no kept revision names, their graphs, and what crashes left.

    Args:
        keep_revisions: keep only this many of the newest; older ones stay listed but lose their claim. None: all.
        dry_run: only say what would go (also of a map that was opened for reading).

    Raises:
        ConfigError: a negative number of revisions.
    """
    if keep_revisions is not None and keep_revisions < 0:
        raise ConfigError(f"the number of revisions to keep must not be negative, got {keep_revisions}")
    with contextlib.nullcontext() if dry_run else catalog.lock():
        with catalog.read() as connection:
            waste = _waste(connection, arrays, keep_revisions)
            spare = _waste(connection, arrays, None).doomed
        forgotten = _forgotten_models(catalog)
        num_bytes = sum(arrays.size_bytes(*group) for group in [*waste.doomed, *waste.orphans])
        num_bytes += sum(path.stat().st_size for path in forgotten)
        with explained(catalog.folder, _AGAIN):
            if not dry_run:  # what no row names goes first: on a full disk that makes the room that rows need
                for group in waste.orphans:
                    arrays.drop(*group)
                for path in forgotten:
                    path.unlink()
            num_bytes += arrays.drop_leftovers(dry_run=dry_run)
        if not dry_run:
            try:
                _drop_rows(catalog, waste)
            except DiskFullError:  # then what nothing claims whatever is kept, which `check` does not miss
                with explained(catalog.folder, _AGAIN):
                    for group in spare:
                        arrays.drop(*group)
                _drop_rows(catalog, waste)
            # The rows are gone for good: a crash from here on leaves orphans for the next prune.
            with explained(catalog.folder, _AGAIN):
                for group in waste.doomed:
                    arrays.drop(*group)
    return Pruned(
        scenes=tuple(name for name, _ in waste.scenes),
        revisions=tuple(waste.revisions),
        num_graphs=len(waste.graphs),
        num_orphans=len(waste.orphans),
        num_models=len(forgotten),
        num_bytes=num_bytes,
        dry_run=dry_run,
    )


@dataclass(frozen=True)
class _Waste:
    """What may go.

    Args:
        revisions: numbers of those that are not kept.
        scenes: names and numbers of removed scenes that no kept revision names.
        graphs: keys of their graphs.
        doomed: kinds and names of the groups that nothing claims then.
        orphans: of those that no row names.
    """

    revisions: list[int]
    scenes: list[tuple[str, int]]
    graphs: list[str]
    doomed: list[tuple[str, str]]
    orphans: list[tuple[str, str]]


def _waste(connection: Connection, arrays: Arrays, keep_revisions: int | None) -> _Waste:
    kept, dropped = _revisions_to_keep(connection, keep_revisions)
    named = select(poses.c.scene).where(poses.c.revision.in_(kept))
    gone = scenes.c.removed_at.is_not(None) & scenes.c.id.not_in(named)
    of_scene = graphs.join(scenes, scenes.c.id == graphs.c.scene)
    dead = connection.execute(select(scenes).where(gone, scenes.c.group_id.is_not(None)))
    keys = connection.execute(select(graphs.c.key).select_from(of_scene).where(gone)).scalars()
    claimed = set(connection.execute(select(scenes.c.group_id).where(not_(gone))).scalars())
    claimed |= set(connection.execute(select(graphs.c.group_id).select_from(of_scene).where(not_(gone))).scalars())
    known = {(g.kind, g.id) for g in connection.execute(select(groups))}
    return _Waste(
        dropped,
        [(row.name, row.number) for row in dead],
        list(keys),
        sorted(group for group in known if group[1] not in claimed),
        [group for group in arrays.groups() if group not in known],
    )


def _drop_rows(catalog: Catalog, waste: _Waste) -> None:
    ids = [group for _, group in waste.doomed]
    with catalog.write() as connection:
        connection.execute(update(revisions).where(revisions.c.number.in_(waste.revisions)).values(dropped_at=now()))
        connection.execute(delete(graphs).where(graphs.c.key.in_(waste.graphs)))
        connection.execute(update(scenes).where(scenes.c.group_id.in_(ids)).values(group_id=None))
        for _, number in waste.scenes:
            boxes = text(f"DELETE FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
            connection.execute(boxes, {"s": number})
        connection.execute(delete(files).where(files.c.group_id.in_(ids)))
        connection.execute(delete(groups).where(groups.c.id.in_(ids)))


def _row_problems(connection: Connection, folder: Path) -> list[str]:
    out = []
    for row in connection.execute(select(scenes).where(scenes.c.removed_at.is_(None))):
        if row.group_id is None:
            out.append(f"scene {row.name} has no arrays")
        query = text(f"SELECT count(*) FROM {CHUNK_BOXES} WHERE s0 = :s AND s1 = :s")
        boxes = connection.execute(query, {"s": row.number}).scalar_one()
        if boxes != -(-row.num_gaussians // CHUNK_ROWS):
            out.append(f"scene {row.name} has {boxes} chunk boxes, not one for every {CHUNK_ROWS} Gaussians")
    for row in connection.execute(select(models).where(models.c.removed_at.is_(None))):
        path = folder / row.path if row.copied else Path(row.path)
        if not path.is_file():
            out.append(f"model {row.name} is missing: {path}")
            continue
        with open(path, "rb") as file:
            if hashlib.file_digest(file, "sha256").hexdigest() != row.sha256:
                out.append(f"model {row.name} differs from what was added: {path}")
    return out


def _revisions_to_keep(connection: Connection, keep: int | None) -> tuple[list[int], list[int]]:
    """Numbers to keep, and numbers to drop now."""
    query = select(revisions.c.number).where(revisions.c.dropped_at.is_(None)).order_by(revisions.c.number)
    numbers = list(connection.execute(query).scalars())
    cut = 0 if keep is None else max(0, len(numbers) - max(keep, 0))
    return numbers[cut:], numbers[:cut]


def _forgotten_models(catalog: Catalog) -> list[Path]:
    """Copies of models that no row names any more."""
    with catalog.read() as connection:
        standing = set(connection.execute(select(models.c.path).where(models.c.removed_at.is_(None))).scalars())
    copies = [path for path in sorted((catalog.folder / FOLDER).glob("*")) if path.is_symlink() or not path.is_dir()]
    return [path for path in copies if f"{FOLDER}/{path.name}" not in standing]
