"""The page of a map as files: written whole or not at all, over its own and nothing else, and known to a purge."""

from __future__ import annotations

import json
import logging
import math
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from gsmap.durable import is_stream, make_folder, open_file, remove_tree, sync_folder, write_output
from gsmap.errors import MALFORMED, ConfigError, CorruptError, NotFoundError
from gsmap.map.pictures import note_target
from gsmap.map.settings import Settings
from gsmap.map.viewing import MapDoors, cache_folder
from gsmap.report import owner_of
from gsmap.store import Store
from gsmap.types.progress import StageProgress
from gsmap.types.rows import ViewReport
from gsmap.version import __version__
from gsmap.view import site
from gsmap.view.built import built_page
from gsmap.view.levels import Levels
from gsmap.view.tree_cache import TreeCache

_log = logging.getLogger("gsmap.map")
SITE = "gsmap-site.json"
_VERSION = 1
_MAX_BYTES = 1 << 16
_SUFFIXES = (".html", ".htm")


def write_site(
    store: Store, settings: Settings, folder: Path, tiles: Path | None, progress: StageProgress
) -> ViewReport:
    """See `gsmap.Map.write_site`."""
    _check_folder(store, folder)
    page, doors = built_page(), MapDoors(store, settings, tiles=tiles)
    make_folder(folder.parent)
    staged = folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}"
    with _levels(doors, settings) as levels:
        try:
            staged.mkdir()
            (staged / SITE).write_text(json.dumps({"version": _VERSION, "map_id": store.id, "gsmap": __version__}))
            told = partial(progress, "page")
            written = site.write_site(staged, doors, levels, settings.view, page, told)
            notes = written.notes
            if (refused := note_target(store, folder, {"site": True})) is not None:
                notes = (*notes, f"{refused}: a purge of a scene will not find this page")
            _check_folder(store, folder)  # again: it may have been filled meanwhile
            _swap(staged, folder)
        finally:
            remove_tree(staged.parent, staged.name)
    progress("page", 1.0, "")
    return ViewReport(path=str(folder), num_bytes=written.num_bytes, num_scenes=written.num_scenes, notes=notes)


def write_page(store: Store, settings: Settings, path: Path, megabytes: float, progress: StageProgress) -> ViewReport:
    """See `gsmap.Map.write_page`."""
    if not (math.isfinite(megabytes) and megabytes > 0):
        raise ConfigError(f"the page's levels of detail need a positive number of megabytes, got {megabytes}")
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(f"a page in one file ends with .html, not {path.name or path}")
    if not path.parent.is_dir():
        raise NotFoundError(f"cannot write {path}: {path.parent} does not exist")
    if path.exists() and not is_stream(path) and owner_of(path) != store.id:
        raise ConfigError(f"{path} is there and is no page of this map: choose another name, or delete it")
    page, doors = built_page(), MapDoors(store, settings)
    made: list[site.SiteContents] = []
    told = partial(progress, "page")
    with _levels(doors, settings) as levels:
        mark = f'<meta name="gsmap-map" content="{store.id}">'  # by which a purge knows it (`gsmap.report.owner_of`)
        write = partial(
            site.write_page,
            doors=doors,
            levels=levels,
            params=settings.view,
            page=page,
            max_bytes=int(megabytes * 1e6),
            progress=told,
            mark=mark,
        )
        refused = None if is_stream(path) else note_target(store, path, {"page": True})
        write_output(path, lambda staged: made.append(write(staged)))
    notes = made[0].notes
    if refused is not None:
        notes = (*notes, f"{refused}: a purge of a scene will not find this page")
    progress("page", 1.0, "")
    return ViewReport(path=str(path), num_bytes=made[0].num_bytes, num_scenes=made[0].num_scenes, notes=notes)


def site_owner(folder: Path) -> str | None:
    """The id of the map whose page a folder holds; None where it holds none."""
    try:
        with open(open_file(folder / SITE), "rb") as file:
            said = json.loads(file.read(_MAX_BYTES))
        return str(said["map_id"]) if said["version"] == _VERSION else None
    except (OSError, CorruptError, *MALFORMED):
        return None


def _check_folder(store: Store, folder: Path) -> None:
    """Whether a page may be written to a folder: nothing is replaced that is not this map's page."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ConfigError(f"{folder} is no folder: give an empty or a new one")
    if folder.is_dir() and any(folder.iterdir()) and site_owner(folder) != store.id:
        raise ConfigError(f"{folder} holds other things than a page of this map: give an empty or a new folder")


def _swap(staged: Path, folder: Path) -> None:
    """Put a folder in the place of another; one of both is there at any time but for a moment."""
    grave = folder.parent / f".{folder.name}.{uuid.uuid4().hex[:8]}"
    is_there = folder.exists()
    if is_there:
        os.rename(folder, grave)
    try:
        os.rename(staged, folder)
    except OSError:
        if is_there:
            os.rename(grave, folder)
        raise
    sync_folder(folder.parent)
    if is_there:
        remove_tree(grave.parent, grave.name)


@contextmanager
def _levels(doors: MapDoors, settings: Settings) -> Iterator[Levels]:
    cache = TreeCache(cache_folder(), int(settings.view.cache_gib * 2**30))
    levels = Levels(doors, cache, settings.view)
    try:
        yield levels
    finally:
        levels.close()
