"""Write the page of a map as files. An export replaces only files of the page, and a purge finds these files."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from gsmap.durable import (
    files_below,
    is_file,
    is_folder,
    is_stream,
    make_folder,
    open_file,
    refuse_links,
    remove_empty_folder,
    remove_file,
    remove_staged,
    staged_folder,
    sync_folder,
    write_output,
    write_owned,
)
from gsmap.errors import MALFORMED, ConfigError, CorruptError, NotFoundError
from gsmap.map.outputs import Output, note_target
from gsmap.map.page.source import MapPageSource, cache_folder
from gsmap.map.settings import Settings
from gsmap.report import owner_mark, owner_of
from gsmap.store import Store
from gsmap.types.progress import StageProgress
from gsmap.types.rows.maps import ViewReport
from gsmap.version import __version__
from gsmap.view import site
from gsmap.view.built import built_page
from gsmap.view.levels import Levels
from gsmap.view.tree_cache import TreeCache

_log = logging.getLogger("gsmap.map")
SITE = "gsmap-site.json"
_VERSION = 2
_MAX_BYTES = 1 << 28
_ENTRIES = ("map.json", "index.html")  # what a browser asks for first
_MIN_MB, _MAX_MB = 0.001, 100_000
_SUFFIXES = (".html", ".htm")


def write_site(
    store: Store, settings: Settings, folder: Path, tiles: Path | None, progress: StageProgress
) -> ViewReport:
    """Write the page as a folder; see `gsmap.Map.write_site`."""
    _check_folder(store, folder)
    page, page_source = built_page(), MapPageSource(store, settings, tiles=tiles)
    make_folder(folder.parent)
    refused = note_target(store, folder, {"site": True})  # first: a purge must find what a killed export leaves
    with _levels(page_source, settings) as levels, staged_folder(folder.absolute(), store.id) as staged:
        written = site.write_site(staged, page_source, levels, settings.view, page, partial(progress, "page"))
        made = _in_order(files_below(staged))
        marker = _mark(store.id, made)
        (staged / SITE).write_bytes(marker)
        notes = written.notes
        if refused is not None:
            notes = (*notes, f"{refused}: a purge of a scene will not find this page")
        _check_folder(store, folder)  # again: it may have been filled meanwhile
        _put(staged, folder, store.id, made)
    progress("page", 1.0, "")
    num_bytes = written.num_bytes + len(marker)
    return ViewReport(path=str(folder), num_bytes=num_bytes, num_scenes=written.num_scenes, notes=notes)


def write_page(store: Store, settings: Settings, path: Path, megabytes: float, progress: StageProgress) -> ViewReport:
    """Write the page as one file; see `gsmap.Map.write_page`."""
    if not _MIN_MB <= megabytes <= _MAX_MB:
        raise ConfigError(
            f"the page's levels of detail need between {_MIN_MB} and {_MAX_MB:,} megabytes, got {megabytes}",
            code="out_of_range",
        )
    if path.suffix.lower() not in _SUFFIXES:
        raise ConfigError(
            f"the name of a page in one file must end with .html, not be {path.name or path}", code="wrong_suffix"
        )
    if not path.parent.is_dir():
        raise NotFoundError(f"cannot write {path}: {path.parent} does not exist", code="folder_not_found")
    if path.exists() and not is_stream(path) and owner_of(path) != store.id:
        raise ConfigError(
            f"{path} exists and is not a page of this map: choose another name, or delete it", code="foreign_export"
        )
    page, page_source = built_page(), MapPageSource(store, settings)
    made: list[site.SiteContents] = []
    told = partial(progress, "page")
    with _levels(page_source, settings) as levels:
        write = partial(
            site.write_page,
            page_source=page_source,
            levels=levels,
            params=settings.view,
            page=page,
            max_bytes=int(megabytes * 1e6),
            progress=told,
            mark=owner_mark(store.id),
        )
        refused = None if is_stream(path) else note_target(store, path, {"page": True})
        write_output(path, lambda staged: made.append(write(staged)), store.id)
    notes = made[0].notes
    if refused is not None:
        notes = (*notes, f"{refused}: a purge of a scene will not find this page")
    progress("page", 1.0, "")
    return ViewReport(path=str(path), num_bytes=made[0].num_bytes, num_scenes=made[0].num_scenes, notes=notes)


def site_owner(folder: Path) -> str | None:
    """Return the id of the map whose page is in a folder; None without a page."""
    said = _marker(folder)
    return None if said is None else said[0]


def remove_site(folder: Path) -> None:
    """Delete the files of a page, no other files, and folders that become empty.

    Raises:
        CorruptError: a folder on the way to one is a link.
        OSError: the system refused.
    """
    _remove(folder, site_files(folder))
    remove_file(folder, SITE)  # last: an interrupted call finds the rest again
    sync_folder(folder)
    remove_empty_folder(folder.parent, folder.name)


def site_files(folder: Path) -> list[str]:
    """List the files of a page except `SITE`, relative to its folder; empty if the folder has no page."""
    said = _marker(folder)
    return [] if said is None else said[1]


def _num_files(folder: Path, map_id: str, scene: str) -> int:
    return len(site_files(folder)) + 1 if site_owner(folder) == map_id else 0


SITES = Output(
    is_at=lambda folder, map_id: os.path.lexists(folder / SITE),
    num_files=_num_files,
    forget=lambda folder, map_id, scene: remove_site(folder),  # it shows all scenes; gsmap view --export makes it anew
)


def _marker(folder: Path) -> tuple[str, list[str]] | None:
    """Return the map id and the files of the page in a folder; None without a page."""
    try:
        with open(open_file(folder / SITE), "rb") as file:
            said = json.loads(file.read(_MAX_BYTES))
        map_id, version = str(said["map_id"]), said["version"]
        files = said["files"]
        if version != _VERSION or not isinstance(files, list) or not all(isinstance(path, str) for path in files):
            return None
        return map_id, files
    except (OSError, CorruptError, *MALFORMED):
        return None


def _mark(map_id: str, files: Sequence[str]) -> bytes:
    """Return the content of the file `SITE`.

    Args:
        files: all other files that gsmap wrote; no other file is ever touched.
    """
    return json.dumps({"version": _VERSION, "map_id": map_id, "gsmap": __version__, "files": files}).encode()


def _check_folder(store: Store, folder: Path) -> None:
    """Raise an error for a folder with any files except a page of this map."""
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise ConfigError(f"{folder} is not a folder: name an empty or a new folder", code="not_a_folder")
    remove_staged(folder, store.id)
    if folder.is_dir() and any(folder.iterdir()) and site_owner(folder) != store.id:
        raise ConfigError(
            f"{folder} holds other files than a page of this map: give an empty or a new folder",
            code="folder_not_empty",
        )


def _in_order(files: Iterable[str]) -> list[str]:
    """Sort files for replacement: a file comes after the files that it refers to, `_ENTRIES` last."""
    return sorted(files, key=lambda path: (_ENTRIES.index(path) if path in _ENTRIES else -1, path))


def _put(staged: Path, folder: Path, map_id: str, made: Sequence[str]) -> None:
    """Move a page to its folder, as a whole to a new folder or file by file over an existing page.

    Whenever that ends, the folder's list has every file of the earlier page and of this one that is there.

    Args:
        made: its files in ``staged``.

    Raises:
        ConfigError: something else lies where a file has to go; nothing was changed.
        CorruptError: a folder on the way to one is a link.
    """
    if not folder.exists() or not any(folder.iterdir()):
        if folder.exists():
            folder.rmdir()
        os.rename(staged, folder)
        sync_folder(folder.parent)
        return
    before = site_files(folder)
    for path in made:
        _check_free(folder, path, path in before)
    _write_marker(folder, map_id, [*dict.fromkeys([*before, *made])])
    for path in made:
        place = folder / path
        make_folder(place.parent)
        os.replace(staged / path, place)
    for below in {(folder / path).parent for path in made}:
        sync_folder(below)
    _remove(folder, sorted(set(before) - set(made)))
    _write_marker(folder, map_id, made)


def _write_marker(folder: Path, map_id: str, files: Sequence[str]) -> None:
    write_owned(folder / SITE, map_id, lambda place: place.write_bytes(_mark(map_id, files)))


def _check_free(folder: Path, path: str, is_ours: bool) -> None:
    """Raise an error if a file to replace does not belong to the page."""
    *above, _ = path.split("/")
    refuse_links(folder, *above)
    for depth in range(1, len(above) + 1):
        at = folder.joinpath(*above[:depth])
        if os.path.lexists(at) and not is_folder(at):
            raise ConfigError(
                f"{at} does not belong to the page, which needs a folder there: move it away", code="folder_not_empty"
            )
    place = folder / path
    if os.path.lexists(place) and not (is_ours and is_file(place)):
        raise ConfigError(
            f"{place} does not belong to the page, which needs a file there: move it away", code="folder_not_empty"
        )


def _remove(folder: Path, files: Sequence[str]) -> None:
    """Delete files of a page, and folders below ``folder`` that become empty."""
    for path in files:
        remove_file(folder, *path.split("/"))
    above = {tuple(path.split("/")[:depth]) for path in files for depth in range(1, path.count("/") + 1)}
    for names in sorted(above, key=len, reverse=True):
        remove_empty_folder(folder, *names)


@contextmanager
def _levels(page_source: MapPageSource, settings: Settings) -> Iterator[Levels]:
    cache = TreeCache(cache_folder(), int(settings.view.cache_gib * 2**30))
    levels = Levels(page_source, cache, settings.view.workers)
    try:
        yield levels
    finally:
        levels.close()
