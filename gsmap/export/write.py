"""Writing an export: only dirty tiles, each appearing whole or not at all, the manifest last."""

from __future__ import annotations

import hashlib
import os
import secrets
import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from contextvars import ContextVar
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
from gsmap.export.recipe import TileRecipe, dirty_reason
from gsmap.formats import tiles3d
from gsmap.methods.executor import SetAside
from gsmap.types import MergeResult, Tile
from gsmap.types.metre import Metre
from gsmap.types.progress import Progress, silent

_STAGING = ".partial"
_MARK = "this-export"
_SHARED = "shared"
Content = Callable[[Progress], MergeResult]
Run = Callable[[Callable[..., Any], Iterable[tuple[Any, ...]]], Iterator[tuple[int, Any]]]
_At = tuple[int, str]  # component and name of a tile

_within: ContextVar[Progress] = ContextVar("progress of a tile that is made in this process", default=silent)


@dataclass(frozen=True, eq=False)
class ExportResult:
    """The tiles now in the folder, and what this export did.

    Args:
        tiles: all of them, in the plan's order.
        recomputed: how many of them this export made.
        reused: how many it found made.
        removed: how many that are no longer in the plan it took away.
        notes: what a person should know about the tiles that it made.
        set_aside: the tiles that could not be made since they end the process that makes them, and why.
    """

    tiles: list[Tile]
    recomputed: int
    reused: int
    removed: int
    notes: tuple[str, ...] = ()
    set_aside: tuple[tuple[PlannedTile, str], ...] = ()


@dataclass(frozen=True)
class StagedTile:
    """The file of a tile that was made, not yet in its place.

    Args:
        name: of the file, in the folder that was given for it; empty where the tile holds nothing.
        sha256, num_bytes: of the file.
        num_gaussians, truncated, notes: as in `gsmap.types.Tile`.
        content: the file itself, where it was made on a machine that does not have the folder; None else.
    """

    name: str
    sha256: str
    num_bytes: int
    num_gaussians: int
    truncated: bool
    notes: tuple[str, ...]
    content: bytes | None = None


def run_here(job: Callable[..., Any], arguments: Iterable[tuple[Any, ...]]) -> Iterator[tuple[int, Any]]:
    """Do jobs in this process, one after the other."""
    for index, args in enumerate(arguments):
        yield index, job(*args)


def export_tiles(
    plan: Sequence[PlannedTile],
    make: Callable[[PlannedTile, str], Content],
    out: str | os.PathLike[str],
    *,
    map_id: str,
    recipe: TileRecipe,
    metres: Mapping[int, Metre] | None = None,
    world: Mapping[int, dict[str, Any]] | None = None,
    offsets: Mapping[str, list[float]] | None = None,
    params: Params | None = None,
    run: Run = run_here,
    made: Callable[[Tile], None] | None = None,
    progress: Progress | None = None,
) -> ExportResult:
    """Bring a folder to hold exactly the planned tiles, making only those that an earlier export did not.

    The manifest is there before the first tile. Every tile is written under a temporary name, fsynced and renamed; the
    manifest follows, and what it no longer names is deleted last. Interrupted anywhere, the folder holds whole tiles
    only, and the same call goes on from there.

    Args:
        plan: from `plan_tiles`.
        make: of a tile, and a path below which nothing lies yet and files may be kept until all tiles are made, what
            makes its content, given where to report progress; can be pickled if ``run`` needs that.
        out: folder; made if missing; one folder per component inside.
        map_id: a folder keeps to one map.
        recipe: how tiles are made and written; where it differs from a tile's, that tile is made again.
        metres: how long a metre is in each component's frame, to be told in the manifest.
        world: where components lie in the world, to be told there, too.
        offsets: what was taken off the coordinates of scenes' files, to be told there, too.
        params: from which movement on a tile is made again.
        run: makes tiles, here or elsewhere (`gsmap.engine.run_jobs`).
        made: told each new tile once its file is in place; called from the calling thread.
        progress: told the fraction of tiles done and what is being done.

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
    told = dict(metres or {}), dict(world or {}), dict(offsets or {})
    retold = (manifest.metres, manifest.world, manifest.offsets) != told
    manifest.metres, manifest.world, manifest.offsets = told
    report = _Report(progress or silent, len(plan), reused)
    news: dict[_At, Tile] = {}
    aside: list[tuple[PlannedTile, str]] = []
    staging = out / _STAGING / secrets.token_hex(16)  # what another export's workers may still write lies elsewhere
    try:
        if not (todo or gone or retold or manifest.doomed) and out.exists():
            return ExportResult([old[at] for at in sorted(planned)], 0, reused, 0)
        make_folder(out)
        if not (out / FILE_NAME).exists():
            manifest.save(out)  # whose folder it is, before anything lies in it
        remove_tree(out, _STAGING)  # it may not be ours, and hold links
        (out / _STAGING).mkdir()
        staging.mkdir()
        (staging / _MARK).touch()
        with closing(_made(todo, make, run, recipe, staging, report)) as finished:
            for planned_tile, staged in finished:
                if isinstance(staged, SetAside):
                    aside.append((planned_tile, staged.reason))
                    continue
                at, tile, num_bytes = _placed(planned_tile, staged, out, staging, recipe)
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
    tiles = [manifest.tiles[at] for at in sorted(planned) if at in manifest.tiles]
    return ExportResult(tiles, len(news), reused, len(gone), manifest.notes + _told(news), tuple(aside))


def _must_make(
    planned: PlannedTile, tile: Tile | None, manifest: Manifest, out: Path, recipe: TileRecipe, params: Params
) -> bool:
    if dirty_reason(planned, tile, recipe, params.max_shift_m):
        return True
    return tile is None or not manifest.has_file(out, tile)


def _made(
    todo: Sequence[PlannedTile],
    make: Callable[[PlannedTile, str], Content],
    run: Run,
    recipe: TileRecipe,
    staging: Path,
    report: _Report,
) -> Generator[tuple[PlannedTile, StagedTile | SetAside], None, None]:
    """Each tile with its staged file, or why there is none; to be closed, which gives up those that are being made."""
    folder = str(staging.absolute())
    shared = os.path.join(folder, _SHARED)
    arguments = ((make(planned, shared), recipe, folder, _staged_name(planned, recipe)) for planned in todo)
    results = run(make_file, arguments)
    token = _within.set(report.within_tile)
    try:
        for index, staged in results:
            yield todo[index], staged
    finally:
        _within.reset(token)
        if isinstance(results, Generator):
            results.close()


def make_file(content: Content, recipe: TileRecipe, folder: str, name: str) -> StagedTile:
    """Make one tile, and its file in a folder; or, on a machine that does not have the folder, its bytes: a job."""
    found = content(_within.get())
    empty = StagedTile("", "", 0, len(found.gaussians), found.truncated, tuple(found.notes))
    if not len(found.gaussians):
        return empty
    if Path(folder, _MARK).exists():
        digest, num_bytes = _written(Path(folder, name), found, recipe)
        return replace(empty, name=name, sha256=digest, num_bytes=num_bytes)
    with tempfile.TemporaryDirectory(prefix="gsmap-tile-") as elsewhere:
        path = Path(elsewhere, name)
        digest, num_bytes = _written(path, found, recipe)
        return replace(empty, name=name, sha256=digest, num_bytes=num_bytes, content=path.read_bytes())


def _written(path: Path, content: MergeResult, recipe: TileRecipe) -> tuple[str, int]:
    """Digest and size of the file that is at the path now."""
    try:
        _write(path, content, recipe)
    except GsmapError as error:
        # A full disk is a matter of the folder, not of what was written.
        raise error.__cause__ if isinstance(error.__cause__, OSError) else error from None
    return _synced_digest(path)


def _staged_name(planned: PlannedTile, recipe: TileRecipe) -> str:
    return f"component_{planned.component}_{planned.name}.{recipe.suffix}"


def _placed(
    planned: PlannedTile, staged: StagedTile, out: Path, staging: Path, recipe: TileRecipe
) -> tuple[_At, Tile, int]:
    """Put the file of a tile in its place, and describe it."""
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
    )
    return (planned.component, planned.name), tile, staged.num_bytes


def _write(path: Path, content: MergeResult, recipe: TileRecipe) -> None:
    if recipe.is_tileset:
        tiles3d.write_content(path, content.gaussians, compressed=not recipe.uncompressed)
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
    found = [
        *out.glob(f".{FILE_NAME}.*"),
        *out.glob("component_*/.tileset.json.*"),
        *out.glob("component_*/.lod-meta.json.*"),
    ]
    return [(_STAGING,), *(path.relative_to(out).parts for path in found)]


def _told(news: dict[_At, Tile]) -> tuple[str, ...]:
    """The notes of new tiles, each once, with the tile it is about or how many tiles it is about."""
    about: dict[str, list[str]] = {}
    for (component, name), tile in sorted(news.items()):
        for note in tile.notes:
            about.setdefault(note, []).append(f"component_{component}/{name}")
    return tuple(f"{at[0] if len(at) == 1 else f'{len(at)} tiles'}: {note}" for note, at in about.items())


class _Report:
    """Progress over all tiles."""

    def __init__(self, progress: Progress, total: int, done: int) -> None:
        self._progress, self._total, self._done = progress, total, done

    def within_tile(self, fraction: float, text: str) -> None:
        at = min(self._done + min(max(fraction, 0.0), 1.0), self._total)
        self._progress(at / self._total, f"tile {min(self._done + 1, self._total)} of {self._total}: {text}")

    def tile_done(self) -> None:
        self._done += 1
        self._progress(self._done / self._total, f"tile {self._done} of {self._total}")
