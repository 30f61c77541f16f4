"""Purge stage: delete a scene permanently from the map, from export folders and, on request, from branches."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from gsmap.durable import (
    files_below,
    is_folder,
    refuse_links,
    remove_empty_folder,
    remove_file,
    remove_staged,
    remove_tree,
    sync_folder,
)
from gsmap.errors import BusyError, DiskError, DiskFullError, GsmapError, NotFoundError, of_system
from gsmap.export.lock import folder_lock
from gsmap.export.manifest import FILE_NAME, Manifest
from gsmap.export.pyramid import LEVELS_FOLDER, is_stale, remove_tree_files
from gsmap.export.streamed_sog import StreamedSog
from gsmap.export.tileset import Tiles3D
from gsmap.export.write import leftovers
from gsmap.map import merged_tiles
from gsmap.map.outputs import Output, SceneCache
from gsmap.store import Store, purging
from gsmap.store.purging import Purge

_COMPONENT = re.compile(r"component_\d+")
_TREES = (Tiles3D(), StreamedSog())


def purge(
    store: Store,
    ref: str,
    outputs: Sequence[Output] = (),
    caches: Sequence[SceneCache] = (),
    *,
    branches: bool = False,
) -> list[tuple[str, Purge]]:
    """Purge a scene; interrupted purges are finished first.

    Args:
        ref: name, id, or the beginning of an id, of a living or a removed scene; of one that was purged its id.
        outputs: kinds of outputs besides tiles. caches: caches besides that of merged tiles.
        branches: in the other branches and tags of the map, too.

    Returns:
        The location of each catalog that it was taken out of, the map that is open first, and the receipt. Those of
        interrupted purges that this one finished, where no scene is called so any more.

    Raises:
        NotFoundError: no scene is called so, and none of that id was purged.
        StoreError: a branch cannot be read, somebody reads an older state, or a folder of tiles or pictures failed; the
            same call again goes on.
    """
    finish = partial(_finish, outputs=outputs, caches=caches)
    with ExitStack() as stack:
        catalogs = [store]
        if branches:
            catalogs += [stack.enter_context(Store.open_writable(place.location)) for place in store.others()]
        done = [(one, finish(one, p)) for one in catalogs for p in purging.list_purges(one) if not p.is_done]
        scene = _scene(catalogs, ref)
        if scene is None:
            done = done or [(one, p) for one in catalogs for p in purging.list_purges(one) if p.scene == ref]
            if not done:
                raise NotFoundError(
                    f"no scene is called {ref!r}, and no id starts with it: gsmap list MAP scenes",
                    code="scene_not_found",
                )
        else:
            holding = [one for one in catalogs if _holds(one, scene)]
            begun = [(one, purging.begin(one, scene)) for one in holding]
            done = [(one, finish(one, one_purge)) for one, one_purge in begun]
        for one in catalogs:
            purging.update_receipts(one)
        return [(one.location, p) for one, made in done for p in purging.list_purges(one) if p.number == made.number]


def _scene(catalogs: Sequence[Store], ref: str) -> str | None:
    for one in catalogs:
        try:
            return one.scenes.find_any(ref).id
        except NotFoundError:
            continue
    return None


def _holds(store: Store, scene: str) -> bool:
    try:
        return store.scenes.find_any(scene).id == scene
    except NotFoundError:
        return False


def _finish(store: Store, begun: Purge, outputs: Sequence[Output], caches: Sequence[SceneCache]) -> Purge:
    unreachable = []
    for cache in caches:
        if num_files := cache.num_files(begun.scene):
            begun = purging.record_files(store, begun, str(cache.root), num_files)
            cache.forget(begun.scene)
    if cached := merged_tiles.files_of(begun.scene):
        begun = purging.record_files(store, begun, str(merged_tiles.folder()), len(cached))
        for path in cached:
            path.unlink(missing_ok=True)
    for target in begun.receipt["pending"]["targets"]:
        try:
            out = Path(target)
            begun, left = _clean_staged(store, out, begun)
            unreachable += left
            if os.path.lexists(out / FILE_NAME):
                with folder_lock(out):
                    begun = _clean(store, out, begun)
            elif (kind := next((one for one in outputs if one.is_at(out, store.id)), None)) is not None:
                if num_files := kind.num_files(out, store.id, begun.scene):
                    begun = purging.record_files(store, begun, str(out), num_files)
                    kind.forget(out, store.id, begun.scene)
            elif not (is_folder(out.parent) and str(out) in begun.receipt["pending"].get("tiles", {})):
                # Else a purge that was interrupted has cleaned it.
                unreachable.append(f"{out}: it is not there, or nothing in it was written by gsmap")
        except (OSError, GsmapError) as error:
            if (passing := _passing(error)) is not None:
                raise passing(f"{target} could not be cleaned yet ({error}): run the same command again") from error
            unreachable.append(f"{target}: {error}")
    return purging.finish(store, begun, unreachable)


def _clean_staged(store: Store, out: Path, begun: Purge) -> tuple[Purge, list[str]]:
    """Delete what killed exports left beside and in a target; return what is not certainly theirs, too."""
    found = [remove_staged(out.parent, store.id, out.name), remove_staged(out, store.id)]
    if num_files := sum(count for count, _ in found):
        begun = purging.record_files(store, begun, f"{out} (interrupted exports)", num_files)
    left = [f"{path}: another process is writing it" for _, busy in found for path in busy]
    return begun, left


def _passing(error: OSError | GsmapError) -> type[GsmapError] | None:
    """Return the error class of a temporary failure to clean a folder; None if the folder cannot be reached at all."""
    kind = of_system(error) if isinstance(error, OSError) else type(error)
    return kind if kind in (DiskFullError, DiskError, BusyError) else None


def _clean(store: Store, out: Path, begun: Purge) -> Purge:
    """Delete a scene's files from one export folder of this map; record their number.

    Tiles made with it; what no tile is any more, but an export had still to delete; and the coarser levels of trees
    and those of components that had either, or whose levels may be of earlier tiles. The manifest names no tile of
    these from the beginning, and what is to go until the end, so that an interrupted purge finds all of it again.
    """
    manifest = Manifest.load(out, store.id)
    made_with_it = {at: tile for at, tile in manifest.tiles.items() if begun.scene in tile.poses}
    kept = {at: tile for at, tile in manifest.tiles.items() if at not in made_with_it}
    paths = {tile.path for tile in made_with_it.values() if tile.path}
    paths |= manifest.doomed - {tile.path for tile in kept.values()} - {""}
    touched = {path.split("/")[0] for path in paths}
    stale = []
    for folder in _component_folders(out):
        tiles = [tile for tile in kept.values() if tile.path.startswith(f"{folder}/")]
        if folder in touched or not tiles or all(is_stale(out, tiles, tree) for tree in _TREES):
            stale.append(folder)
    num_files = len(paths) + sum(_num_levels(out, folder) for folder in stale)
    if num_files or made_with_it:
        begun = purging.record_files(store, begun, str(out), num_files)
    for leftover in leftovers(out):
        remove_tree(out, *leftover)  # what an interrupted export left may be such a tile
    if made_with_it:
        manifest.tiles, manifest.doomed = kept, paths
        manifest.save(out)
    for folder in stale:
        remove_tree_files(out, folder, [tree.file_name for tree in _TREES])  # the next export makes them again
    if stale:
        remove_file(out, Tiles3D.file_name)
    for path in paths:
        remove_file(out, *path.split("/"))
    for folder in _component_folders(out):
        remove_empty_folder(out, folder)
    for place in (*(out / folder for folder in _component_folders(out)), out):
        if place == out or is_folder(place):
            sync_folder(place)  # or they are back when the power was gone
    if manifest.doomed:
        manifest.doomed = set()
        manifest.save(out)
    return begun


def _component_folders(out: Path) -> list[str]:
    return sorted(path.name for path in out.glob("component_*") if _COMPONENT.fullmatch(path.name))


def _num_levels(out: Path, folder: str) -> int:
    """Return the number of files of coarser levels of a component."""
    refuse_links(out, folder, LEVELS_FOLDER)
    return len(files_below(out / folder / LEVELS_FOLDER))
