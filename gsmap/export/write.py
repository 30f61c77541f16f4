"""Writing an export: only dirty tiles, each appearing whole or not at all, the manifest last."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Protocol

import numpy as np

from gsmap import formats
from gsmap.errors import ConfigError, GsmapError, StoreError
from gsmap.export.manifest import Manifest, sync_folder
from gsmap.export.plan import DEFAULT_MOVED_M, PlannedTile, dirty_reason
from gsmap.types import Gaussians, Tile

_STAGING = ".partial"


class Made(Protocol):
    """What making a tile returns; `gsmap.merge.MergeResult` is one."""

    gaussians: Gaussians
    origin: np.ndarray
    truncated: bool


@dataclass(frozen=True, eq=False)
class ExportResult:
    """The tiles now in the folder, and how many of them were made, kept and removed by this export."""

    tiles: list[Tile]
    recomputed: int
    reused: int
    removed: int


def export_tiles(
    plan: Sequence[PlannedTile],
    make: Callable[[PlannedTile, Callable[[float, str], None]], Made],
    out: str | os.PathLike[str],
    *,
    map_id: str,
    method: str,
    format: str = "ply",
    write: Callable[[Path, Made], None] | None = None,
    moved_m: float = DEFAULT_MOVED_M,
    workers: int = 1,
    made: Callable[[Tile, Made], None] | None = None,
    progress: Callable[[float, str], None] | None = None,
) -> ExportResult:
    """Bring a folder to hold exactly the planned tiles, making only those that an earlier export did not.

    Every tile is written under a temporary name, fsynced and renamed; the manifest follows. Interrupted anywhere, the
    folder holds whole tiles only, and the same call goes on from there.

    Args:
        plan: from `plan_tiles`.
        make: makes one tile's content; called from ``workers`` threads.
        out: folder; made if missing; one folder per component inside.
        map_id: a folder keeps to one map.
        method: text of merger and parameters; another text makes every tile dirty.
        format: suffix of the tiles' files without the dot.
        write: writes one tile's file; `gsmap.formats.write` if None.
        moved_m: a tile is dirty when a scene moved farther than this within it.
        made: told each new tile and its content once its file is in place (for provenance).
        progress: told the fraction of tiles done and what is being done.

    Raises:
        ConfigError: the folder belongs to another map or holds other files; an unknown format; no worker.
        StoreError: the folder cannot be written (read-only, full).
    """
    if workers < 1:
        raise ConfigError(f"an export needs at least one worker, got {workers}")
    if write is None:
        if f".{format}" not in formats.known("write"):
            raise ConfigError(f"cannot write {format!r}: choose one of {', '.join(formats.known('write'))}")
        write = _write_gaussians
    out = Path(out)
    manifest = Manifest.load(out, map_id)
    signature = f"{method} {format}"
    old = manifest.tiles
    todo = [t for t in plan if _must_make(t, old.get((t.component, t.name)), manifest, out, signature, moved_m)]
    planned = {(t.component, t.name): t for t in plan}
    gone = [tile for at, tile in old.items() if at not in planned]
    reused = len(plan) - len(todo)
    if not todo and not gone and out.exists():
        return ExportResult([old[at] for at in sorted(planned)], 0, reused, 0)

    report = _Report(progress, len(plan), reused)
    try:
        (out / _STAGING).mkdir(parents=True, exist_ok=True)
        with closing(
            _finished(todo, lambda t: _make(t, make, write, out, signature, format, made, report), workers)
        ) as news:
            for at, tile, num_bytes in news:
                _remove(out, old.get(at), unless=tile.path)
                manifest.tiles[at], manifest.num_bytes[tile.path] = tile, num_bytes
                report.tile_done()
                manifest.save_sometimes(out)
        manifest.tiles = {at: tile for at, tile in manifest.tiles.items() if at in planned}
        manifest.save(out)
        for tile in gone:
            _remove(out, tile)
    except BaseException as error:
        with suppress(OSError):
            manifest.save(out)
        if isinstance(error, OSError):
            raise StoreError(
                f"cannot write the export to {out}: {error.strerror or error}; finished tiles are kept, "
                "run the same export again to go on"
            ) from error
        raise
    finally:
        shutil.rmtree(out / _STAGING, ignore_errors=True)
    return ExportResult([manifest.tiles[at] for at in sorted(planned)], len(todo), reused, len(gone))


def _must_make(
    planned: PlannedTile, tile: Tile | None, manifest: Manifest, out: Path, signature: str, moved_m: float
) -> bool:
    return bool(dirty_reason(planned, tile, signature, moved_m)) or not manifest.has_file(out, tile)


def _make(
    planned: PlannedTile,
    make: Callable[[PlannedTile, Callable[[float, str], None]], Made],
    write: Callable[[Path, Made], None],
    out: Path,
    signature: str,
    format: str,
    made: Callable[[Tile, Made], None] | None,
    report: _Report,
) -> tuple[tuple[int, str], Tile, int]:
    """Make one tile, put its file in place, and describe it."""
    content = make(planned, report.within_tile)
    path, digest, num_bytes = "", "", 0
    if len(content.gaussians):
        path = f"component_{planned.component}/{planned.name}.{format}"
        staged = out / _STAGING / f"component_{planned.component}_{planned.name}.{format}"
        try:
            write(staged, content)
        except GsmapError as error:
            # A full disk is a matter of the folder, not of what was written.
            raise error.__cause__ if isinstance(error.__cause__, OSError) else error from None
        digest, num_bytes = _synced_digest(staged)
        (out / path).parent.mkdir(exist_ok=True)
        os.replace(staged, out / path)
        sync_folder((out / path).parent)
    tile = Tile(
        key=planned.key(signature),
        component=planned.component,
        bounds=planned.bounds,
        poses=dict(planned.poses),
        num_gaussians=len(content.gaussians),
        method=signature,
        truncated=content.truncated,
        path=path,
        sha256=digest,
    )
    if made is not None:
        made(tile, content)
    return (planned.component, planned.name), tile, num_bytes


def _write_gaussians(path: Path, content: Made) -> None:
    formats.write(path, content.gaussians)


def _synced_digest(path: Path) -> tuple[str, int]:
    with open(path, "rb+") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
        return digest, file.tell()


def _remove(out: Path, tile: Tile | None, unless: str = "") -> None:
    """Delete a tile's file, and its component's folder with the last one."""
    if tile is None or not tile.path or tile.path == unless:
        return
    (out / tile.path).unlink(missing_ok=True)
    with suppress(OSError):
        (out / tile.path).parent.rmdir()


def _finished(todo: Sequence[PlannedTile], make: Callable, workers: int) -> Iterator:
    """Results of ``make`` as they come; the first error ends it, and what has not begun is never begun."""
    if workers == 1 or len(todo) < 2:
        yield from map(make, todo)
        return
    pool = ThreadPoolExecutor(workers, thread_name_prefix="gsmap-tile")
    try:
        for future in as_completed([pool.submit(make, planned) for planned in todo]):
            yield future.result()
    finally:
        pool.shutdown(cancel_futures=True)


class _Report:
    """Progress over all tiles, from any thread."""

    def __init__(self, progress: Callable[[float, str], None] | None, total: int, done: int) -> None:
        self._progress, self._total, self._done = progress, total, done
        self._lock = Lock()

    def within_tile(self, fraction: float, text: str) -> None:
        if self._progress is not None:
            with self._lock:
                at = min(self._done + min(max(fraction, 0.0), 1.0), self._total)
                self._progress(at / self._total, f"tile {min(self._done + 1, self._total)} of {self._total}: {text}")

    def tile_done(self) -> None:
        if self._progress is not None:
            with self._lock:
                self._done += 1
                self._progress(self._done / self._total, f"tile {self._done} of {self._total}")
