"""Write an export incrementally and crash-safely: dirty tiles only, each tile atomically, and the manifest last."""

from __future__ import annotations

import hashlib
import os
import secrets
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from gsmap.export.recipe import TileRecipe, dirty_reason, upright
from gsmap.formats import tiles3d
from gsmap.methods.executor import QuarantinedJob
from gsmap.types import MergeResult, Tile
from gsmap.types.metric_scale import MetricScale
from gsmap.types.progress import Progress, job_progress, jobs_progress, silent

_STAGING = ".partial"
_MARK = "this-export"
_SHARED = "shared"
_MERGED = 0.97  # of a tile's time, when its merger is done and its file is written
Content = Callable[[Progress], MergeResult]
Run = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
_At = tuple[int, str]  # component and name of a tile


@dataclass(frozen=True, eq=False)
class ExportResult:
    """Result of an export.

    Args:
        tiles: all tiles in the folder, in the plan's order.
        recomputed: number of files made.
        reused: number of files that were up to date.
        removed: number of files removed, as their tiles are no longer planned or have become empty.
        notes: notes on the tiles made.
        set_aside: quarantined tiles, whose jobs ended their process, and the reasons.
    """

    tiles: list[Tile]
    recomputed: int
    reused: int
    removed: int
    notes: tuple[str, ...] = ()
    set_aside: tuple[tuple[PlannedTile, str], ...] = ()


@dataclass(frozen=True)
class StagedTile:
    """The staged file of a tile.

    Args:
        name: name of the file in the staging folder; empty for a tile without Gaussians.
        sha256, num_bytes: digest and size of the file.
        num_gaussians, truncated, notes: as in `gsmap.types.Tile`.
        content: bytes of the file if it was made on a machine without access to the folder; None by default.
    """

    name: str
    sha256: str
    num_bytes: int
    num_gaussians: int
    truncated: bool
    notes: tuple[str, ...]
    content: bytes | None = None


def run_here(job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
    """Run jobs in this process, in sequence."""
    for index, args in enumerate(arguments):
        yield index, job(*args)


def export_tiles(
    plan: Sequence[PlannedTile],
    make: Callable[[PlannedTile, str], Content],
    out: str | os.PathLike[str],
    *,
    map_id: str,
    recipe: TileRecipe,
    metres: Mapping[int, MetricScale] | None = None,
    world: Mapping[int, dict[str, Any]] | None = None,
    offsets: Mapping[str, list[float]] | None = None,
    params: Params | None = None,
    run: Run = run_here,
    made: Callable[[Tile], None] | None = None,
    progress: Progress | None = None,
) -> ExportResult:
    """Update a folder to exactly the planned tiles; make only missing and dirty tiles.

    The manifest exists before the first tile. Every tile is written under a temporary name, fsynced and renamed; the
    manifest follows, and obsolete files are deleted last. If interrupted, the folder holds complete tiles only, and the
    same call resumes.

    Args:
        plan: from `plan_tiles`.
        make: makes the content function of a tile, given the tile and an unused path for files that tiles share; the
            function takes a progress callback, and must be picklable if ``run`` requires it.
        out: folder, made if missing, with one folder per component inside.
        map_id: id of the map that the folder belongs to.
        recipe: recipe of the tiles; tiles with another one are made again.
        metres: metric scale of each component, for the manifest.
        world: georeference of components, for the manifest.
        offsets: coordinate offsets of scenes' files, for the manifest.
        params: see `gsmap.export.Params`.
        run: runs jobs, here or elsewhere (`gsmap.engine.run_jobs`).
        made: called with each new tile once its file is in place, in the calling thread.
        progress: called with the fraction of tiles done and the current step.

    Raises:
        ConfigError: the folder belongs to another map or holds other files.
        CorruptError: a symbolic link is in place of a folder of tiles.
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
    made_again = {(t.component, t.name) for t in todo}
    reused = sum(bool(old[at].path) for at in planned.keys() - made_again)
    metadata = dict(metres or {}), dict(world or {}), dict(offsets or {})
    has_new_metadata = (manifest.metres, manifest.world, manifest.offsets) != metadata
    manifest.metres, manifest.world, manifest.offsets = metadata
    report = _ProgressReport(progress or silent, [tile.num_input for tile in todo])
    order = {(tile.component, tile.name): number for number, tile in enumerate(todo)}
    news: dict[_At, Tile] = {}
    aside: list[tuple[PlannedTile, str]] = []
    staging = out / _STAGING / secrets.token_hex(16)  # workers of an earlier export may still write to theirs
    try:
        if not (todo or gone or has_new_metadata or manifest.doomed) and out.exists():
            return ExportResult([old[at] for at in sorted(planned)], 0, reused, 0)
        make_folder(out)
        if not (out / FILE_NAME).exists():
            manifest.save(out)  # claims the folder for the map
        remove_tree(out, _STAGING)  # it may be foreign, and hold links
        (out / _STAGING).mkdir()
        staging.mkdir()
        (staging / _MARK).touch()
        with closing(_make_tiles(todo, make, run, recipe, staging, report)) as finished:
            for planned_tile, staged in finished:
                if isinstance(staged, QuarantinedJob):
                    aside.append((planned_tile, staged.reason))
                    continue
                at, tile, num_bytes = _install(planned_tile, staged, out, staging, recipe)
                if made is not None:
                    made(tile)  # before the manifest, as a tile in it is not reported again
                if at in old and old[at].path not in ("", tile.path):
                    manifest.doomed.add(old[at].path)
                manifest.tiles[at], manifest.num_bytes[tile.path] = tile, num_bytes
                news[at] = tile
                report.tile_done(order[at])
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
                f"cannot write the export to {out}: {error.strerror or error}; finished tiles are kept: "
                "run the same export again to continue"
            ) from error
        raise
    finally:
        for left in leftovers(out):
            with suppress(OSError, CorruptError):
                remove_tree(out, *left)
    tiles = [manifest.tiles[at] for at in sorted(planned) if at in manifest.tiles]
    made_count = sum(bool(tile.path) for tile in news.values())
    num_removed = sum(bool(tile.path) for tile in gone)
    num_removed += sum(bool(old[at].path) and not tile.path for at, tile in news.items() if at in old)
    notes = manifest.notes + _collect_notes(news)
    return ExportResult(tiles, made_count, reused, num_removed, notes, tuple(aside))


def _must_make(
    planned: PlannedTile, tile: Tile | None, manifest: Manifest, out: Path, recipe: TileRecipe, params: Params
) -> bool:
    if dirty_reason(planned, tile, recipe, params.max_shift_m):
        return True
    return tile is None or not manifest.has_file(out, tile)


def _make_tiles(
    todo: Sequence[PlannedTile],
    make: Callable[[PlannedTile, str], Content],
    run: Run,
    recipe: TileRecipe,
    staging: Path,
    report: _ProgressReport,
) -> Generator[tuple[PlannedTile, StagedTile | QuarantinedJob], None, None]:
    """Yield each tile with its staged file or its reason for quarantine; closing the generator cancels running jobs."""
    folder = str(staging.absolute())
    shared = os.path.join(folder, _SHARED)
    arguments = ((make(planned, shared), recipe, folder, _staged_name(planned, recipe)) for planned in todo)
    results = run(make_file, arguments)
    here, elsewhere = job_progress.set(report.within_next_tile), jobs_progress.set(report.within_tile)
    try:
        for index, staged in results:
            yield todo[index], staged
    finally:
        job_progress.reset(here)
        jobs_progress.reset(elsewhere)
        if isinstance(results, Generator):
            results.close()


def make_file(content: Content, recipe: TileRecipe, folder: str, name: str) -> StagedTile:
    """Make a tile and write its file to a folder; return the bytes if this machine cannot access the folder. A job."""
    found = content(job_progress.get())
    empty = StagedTile("", "", 0, len(found.gaussians), found.truncated, tuple(found.notes))
    if not len(found.gaussians):
        return empty
    if Path(folder, _MARK).exists():
        digest, num_bytes = _write_with_digest(Path(folder, name), found, recipe)
        return replace(empty, name=name, sha256=digest, num_bytes=num_bytes)
    with tempfile.TemporaryDirectory(prefix="gsmap-tile-") as elsewhere:
        path = Path(elsewhere, name)
        digest, num_bytes = _write_with_digest(path, found, recipe)
        return replace(empty, name=name, sha256=digest, num_bytes=num_bytes, content=path.read_bytes())


def _write_with_digest(path: Path, content: MergeResult, recipe: TileRecipe) -> tuple[str, int]:
    """Write the file of a tile; return its digest and size."""
    try:
        _write(path, content, recipe)
    except GsmapError as error:
        # A full disk is an error of the folder, not of the content.
        raise error.__cause__ if isinstance(error.__cause__, OSError) else error from None
    return _synced_digest(path)


def _staged_name(planned: PlannedTile, recipe: TileRecipe) -> str:
    return f"component_{planned.component}_{planned.name}.{recipe.suffix}"


def _install(
    planned: PlannedTile, staged: StagedTile, out: Path, staging: Path, recipe: TileRecipe
) -> tuple[_At, Tile, int]:
    """Move the staged file of a tile to its final path; return the tile's key, description and size."""
    path = ""
    if staged.name:
        path = f"component_{planned.component}/{planned.name}.{recipe.suffix}"
        file = staging / _staged_name(planned, recipe)
        if staged.content is not None:
            file.write_bytes(staged.content)
            _synced_digest(file)
        refuse_links(out, *path.split("/")[:-1])
        make_folder((out / path).parent)
        os.replace(file, out / path)
        sync_folder((out / path).parent)
    tile = Tile(
        key=recipe.key(planned),
        component=planned.component,
        bounds=planned.bounds,
        poses=dict(planned.poses),
        num_gaussians=staged.num_gaussians,
        recipe=recipe.merge.to_json(),
        truncated=staged.truncated,
        path=path,
        sha256=staged.sha256,
        notes=staged.notes,
        up=recipe.up or "z",
    )
    return (planned.component, planned.name), tile, staged.num_bytes


def _write(path: Path, content: MergeResult, recipe: TileRecipe) -> None:
    gaussians = upright(content.gaussians) if recipe.up == "y" else content.gaussians
    if recipe.is_tileset:
        tiles3d.write_content(path, gaussians, compressed=not recipe.uncompressed)
    elif recipe.provenance:
        formats.write(path, gaussians, extra={"scene": content.origin.astype(np.float32)})
    else:
        formats.write(path, gaussians)


def _synced_digest(path: Path) -> tuple[str, int]:
    with open(path, "rb+") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        os.fsync(file.fileno())
        return digest, file.tell()


def _remove_doomed(out: Path, manifest: Manifest) -> None:
    """Delete the files of obsolete tiles, and each component's folder that becomes empty."""
    kept = {tile.path for tile in manifest.tiles.values()}
    doomed = sorted(manifest.doomed - kept)
    for path in doomed:
        remove_file(out, *path.split("/"))
        remove_empty_folder(out, path.split("/")[0])
    for folder in {path.split("/")[0] for path in doomed}:
        if is_folder(out / folder):
            sync_folder(out / folder)  # so that a power failure does not restore them
    if manifest.doomed:
        manifest.doomed = set()
        manifest.save(out)


def leftovers(out: Path) -> list[tuple[str, ...]]:
    """Return the paths within an export folder that an interrupted export may have left incomplete."""
    found = [
        *out.glob(f".{FILE_NAME}.*"),
        *out.glob("component_*/.tileset.json.*"),
        *out.glob("component_*/.lod-meta.json.*"),
    ]
    return [(_STAGING,), *(path.relative_to(out).parts for path in found)]


def _collect_notes(news: dict[_At, Tile]) -> tuple[str, ...]:
    """Return the unique notes of new tiles, each with the name of its tile or with the number of its tiles."""
    about: dict[str, list[str]] = {}
    for (component, name), tile in sorted(news.items()):
        for note in tile.notes:
            about.setdefault(note, []).append(f"component_{component}/{name}")
    return tuple(f"{at[0] if len(at) == 1 else f'{len(at)} tiles'}: {note}" for note, at in about.items())


class _ProgressReport:
    """Progress report over the tiles that are made, each by its number of Gaussians, as most cells of a grid are empty.

    Args:
        sizes: expected number of Gaussians of each tile, in the order in which they are begun.
    """

    def __init__(self, progress: Progress, sizes: Sequence[float]) -> None:
        self._progress = progress
        self._sizes = np.maximum(np.asarray(sizes, dtype=np.float64), 1.0)
        self._fractions = np.zeros(len(sizes))
        self._num_done = 0

    def within_next_tile(self, fraction: float, text: str) -> None:
        """Report a tile that is made in this process, one after the other."""
        self.within_tile(self._num_done, fraction, text)

    def within_tile(self, number: int, fraction: float, text: str) -> None:
        """Report the tile of a number, at most until it is written."""
        if number < len(self._sizes):
            self._fractions[number] = max(self._fractions[number], min(max(fraction, 0.0), 1.0) * _MERGED)
            self._report(f": {text}")

    def tile_done(self, number: int) -> None:
        self._num_done += 1
        self._fractions[number] = 1.0
        self._report("")

    def _report(self, text: str) -> None:
        count = len(self._sizes)
        at = f"tile {min(self._num_done + 1, count)} of {'at most ' * (count > 1)}{count}"
        self._progress(float(self._fractions @ self._sizes / self._sizes.sum()), f"{at}{text}")
