"""Writing an export: only dirty tiles, each appearing whole or not at all, the manifest last."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

import numpy as np

from gsmap import formats
from gsmap.durable import (
    is_folder,
    make_folder,
    refuse_links,
    remove_empty_folder,
    remove_file,
    remove_tree,
    sync_folder,
)
from gsmap.errors import CorruptError, GsmapError, of_system
from gsmap.export.manifest import FILE_NAME, Manifest
from gsmap.export.plan import Params, PlannedTile
from gsmap.export.recipe import TileRecipe, dirty_reason
from gsmap.formats import tiles3d
from gsmap.types import MergeResult, Tile
from gsmap.types.metre import Metre
from gsmap.types.progress import Progress, silent

_STAGING = ".partial"
Make = Callable[[PlannedTile, Progress], MergeResult]
_At = tuple[int, str]  # component and name of a tile


@dataclass(frozen=True, eq=False)
class ExportResult:
    """The tiles now in the folder, and what this export did.

    Args:
        tiles: all of them, in the plan's order.
        recomputed: how many of them this export made.
        reused: how many it found made.
        removed: how many that are no longer in the plan it took away.
        notes: what a person should know about the tiles that it made.
    """

    tiles: list[Tile]
    recomputed: int
    reused: int
    removed: int
    notes: tuple[str, ...] = ()


def export_tiles(
    plan: Sequence[PlannedTile],
    make: Make,
    out: str | os.PathLike[str],
    *,
    map_id: str,
    recipe: TileRecipe,
    metres: Mapping[int, Metre] | None = None,
    params: Params | None = None,
    made: Callable[[Tile], None] | None = None,
    progress: Progress | None = None,
) -> ExportResult:
    """Bring a folder to hold exactly the planned tiles, making only those that an earlier export did not.

    The manifest is there before the first tile. Every tile is written under a temporary name, fsynced and renamed; the
    manifest follows, and what it no longer names is deleted last. Interrupted anywhere, the folder holds whole tiles
    only, and the same call goes on from there.

    Args:
        plan: from `plan_tiles`.
        make: makes one tile's content; called from ``params.workers`` threads.
        out: folder; made if missing; one folder per component inside.
        map_id: a folder keeps to one map.
        recipe: how tiles are made and written; where it differs from a tile's, that tile is made again.
        metres: how long a metre is in each component's frame, to be told in the manifest.
        params: from which movement on a tile is made again, and how many are made at once.
        made: told each new tile once its file is in place; called from the calling thread.
        progress: told the fraction of tiles done and what is being done; called from several threads, one at a time.

    Raises:
        ConfigError: the folder belongs to another map or holds other files.
        CorruptError: a link lies in it where a folder of tiles belongs: it would lead elsewhere.
        DiskFullError, ReadOnlyError, DiskError, StoreError: the folder cannot be written.
    """
    params = params or Params()
    out = Path(out)
    for component in {tile.component for tile in plan}:
        refuse_links(out, f"component_{component}")
    manifest = Manifest.load(out, map_id)
    old = manifest.tiles
    todo = [t for t in plan if _must_make(t, old.get((t.component, t.name)), manifest, out, recipe, params)]
    planned = {(t.component, t.name): t for t in plan}
    gone = [tile for at, tile in old.items() if at not in planned]
    reused = len(plan) - len(todo)
    retold, manifest.metres = manifest.metres != dict(metres or {}), dict(metres or {})
    report = _Report(progress or silent, len(plan), reused)
    news: dict[_At, Tile] = {}
    try:
        if not (todo or gone or retold or manifest.doomed) and out.exists():
            return ExportResult([old[at] for at in sorted(planned)], 0, reused, 0)
        make_folder(out)
        if not (out / FILE_NAME).exists():
            manifest.save(out)  # whose folder it is, before anything lies in it
        remove_tree(out, _STAGING)  # it may not be ours, and hold links
        (out / _STAGING).mkdir()
        work = _finished(todo, lambda t: _make(t, make, out, recipe, report), params.workers, report.give_up)
        with closing(work) as finished:
            for at, tile, num_bytes in finished:
                if made is not None:
                    made(tile)  # first: a tile that the manifest names is not made, and so not told, again
                if at in old and old[at].path not in ("", tile.path):
                    manifest.doomed.add(old[at].path)
                manifest.tiles[at], manifest.num_bytes[tile.path] = tile, num_bytes
                news[at] = tile
                report.tile_done()
                manifest.save_sometimes(out)
        manifest.tiles = {at: tile for at, tile in manifest.tiles.items() if at in planned}
        manifest.doomed |= {tile.path for tile in gone if tile.path}
        manifest.save(out)
        _remove_doomed(out, manifest)
    except BaseException as error:
        with suppress(OSError):
            manifest.save(out)
        if isinstance(error, OSError):
            raise of_system(error)(
                f"cannot write the export to {out}: {error.strerror or error}; finished tiles are kept, "
                "run the same export again to go on"
            ) from error
        raise
    finally:
        for left in leftovers(out):
            with suppress(OSError, CorruptError):
                remove_tree(out, *left)
    tiles = [manifest.tiles[at] for at in sorted(planned)]
    return ExportResult(tiles, len(todo), reused, len(gone), manifest.notes + _told(news))


def _must_make(
    planned: PlannedTile, tile: Tile | None, manifest: Manifest, out: Path, recipe: TileRecipe, params: Params
) -> bool:
    if dirty_reason(planned, tile, recipe, params.moved_m):
        return True
    return tile is None or not manifest.has_file(out, tile)


def _make(planned: PlannedTile, make: Make, out: Path, recipe: TileRecipe, report: _Report) -> tuple[_At, Tile, int]:
    """Make one tile, put its file in place, and describe it."""
    content = make(planned, report.within_tile)
    path, digest, num_bytes = "", "", 0
    if len(content.gaussians):
        path = f"component_{planned.component}/{planned.name}.{recipe.suffix}"
        staged = out / _STAGING / path.replace("/", "_")
        try:
            _write(staged, content, recipe)
        except GsmapError as error:
            # A full disk is a matter of the folder, not of what was written.
            raise error.__cause__ if isinstance(error.__cause__, OSError) else error from None
        digest, num_bytes = _synced_digest(staged)
        refuse_links(out, *path.split("/")[:-1])
        make_folder((out / path).parent)
        os.replace(staged, out / path)
        sync_folder((out / path).parent)
    tile = Tile(
        key=recipe.key(planned),
        component=planned.component,
        bounds=planned.bounds,
        poses=dict(planned.poses),
        num_gaussians=len(content.gaussians),
        recipe=recipe.merge.to_json(),
        truncated=content.truncated,
        path=path,
        sha256=digest,
        notes=tuple(content.notes),
    )
    return (planned.component, planned.name), tile, num_bytes


def _write(path: Path, content: MergeResult, recipe: TileRecipe) -> None:
    if recipe.is_tileset:
        tiles3d.write_content(path, content.gaussians)
    elif recipe.provenance:
        formats.write(path, content.gaussians, extra={"scene": content.origin.astype(np.float32)})
    else:
        formats.write(path, content.gaussians)


def _synced_digest(path: Path) -> tuple[str, int]:
    with open(path, "rb+") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
        return digest, file.tell()


def _remove_doomed(out: Path, manifest: Manifest) -> None:
    """Delete the files of tiles that are no longer named, and their component's folder with the last one."""
    kept = {tile.path for tile in manifest.tiles.values()}
    doomed = sorted(manifest.doomed - kept)
    for path in doomed:
        remove_file(out, *path.split("/"))
        remove_empty_folder(out, path.split("/")[0])
    for folder in {path.split("/")[0] for path in doomed}:
        if is_folder(out / folder):
            sync_folder(out / folder)  # or they are back when the power was gone, and named by nothing
    if manifest.doomed:
        manifest.doomed = set()
        manifest.save(out)


def leftovers(out: Path) -> list[tuple[str, ...]]:
    """Where in its folder an export that was killed had begun to write."""
    found = [*out.glob(f".{FILE_NAME}.*"), *out.glob("component_*/.tileset.json.*")]
    return [(_STAGING,), *(path.relative_to(out).parts for path in found)]


def _told(news: dict[_At, Tile]) -> tuple[str, ...]:
    """The notes of new tiles, each once, with the tile it is about or how many tiles it is about."""
    about: dict[str, list[str]] = {}
    for (component, name), tile in sorted(news.items()):
        for note in tile.notes:
            about.setdefault(note, []).append(f"component_{component}/{name}")
    return tuple(f"{at[0] if len(at) == 1 else f'{len(at)} tiles'}: {note}" for note, at in about.items())


def _finished(
    todo: Sequence[PlannedTile],
    make: Callable[[PlannedTile], tuple[_At, Tile, int]],
    workers: int,
    give_up: Callable[[], None],
) -> Generator[tuple[_At, Tile, int], None, None]:
    """Results of ``make`` as they come; the first error ends it: what has not begun never does, the rest gives up."""
    if workers == 1 or len(todo) < 2:
        yield from map(make, todo)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="gsmap-tile")
    try:
        for future in as_completed([pool.submit(make, planned) for planned in todo]):
            yield future.result()
    finally:
        give_up()
        pool.shutdown(cancel_futures=True)


class _Report:
    """Progress over all tiles, from any thread."""

    def __init__(self, progress: Progress, total: int, done: int) -> None:
        self._progress, self._total, self._done = progress, total, done
        self._lock = Lock()
        self._given_up = False

    def give_up(self) -> None:
        """End the making of tiles that are still being made: their result is not wanted any more."""
        self._given_up = True

    def within_tile(self, fraction: float, text: str) -> None:
        if self._given_up:
            raise GsmapError("this tile was given up")
        with self._lock:
            at = min(self._done + min(max(fraction, 0.0), 1.0), self._total)
            self._progress(at / self._total, f"tile {min(self._done + 1, self._total)} of {self._total}: {text}")

    def tile_done(self) -> None:
        with self._lock:
            self._done += 1
            self._progress(self._done / self._total, f"tile {self._done} of {self._total}")
