"""Ingest stage: add captures in files or memory as scenes; unreadable captures are quarantined."""

from __future__ import annotations

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gsmap.errors import ConfigError, GsmapError, InputError, NotGaussiansError, StoreError
from gsmap.ingest import (
    Capture,
    SearchResult,
    SkippedPath,
    check_scale,
    exported_scenes,
    given_date,
    read_capture,
    search_captures,
    take_capture,
)
from gsmap.map.shared_jobs import note_interruption
from gsmap.store import Store
from gsmap.store.quarantine import CAPTURE
from gsmap.texts import escaped
from gsmap.types import Cameras, Gaussians, Scene
from gsmap.types.progress import StageProgress

Source = str | os.PathLike[str] | Gaussians

_log = logging.getLogger("gsmap.map")


@dataclass(frozen=True)
class CaptureReader:
    """A capture that was found but not read yet.

    Args:
        name: capture name.
        read: reads and checks it.
        path: capture file; None for a capture in memory.
    """

    name: str
    read: Callable[[], Capture]
    path: Path | None = None


@dataclass(frozen=True)
class IngestResult:
    """The result of ingesting one capture.

    Args:
        scene: the scene in the map.
        new: true if it was added.
        dated: true if the map had it already and its date changed.
        notes: remarks for the user.
    """

    scene: Scene
    new: bool
    dated: bool
    notes: tuple[str, ...]


def ingest(
    store: Store,
    sources: Sequence[Source],
    *,
    cameras: str | os.PathLike[str] | Cameras | None,
    name: str | None,
    captured_at: str | None,
    scale: str,
    clean: bool,
    bbox: Sequence[float] | None,
    progress: StageProgress,
) -> list[IngestResult]:
    """Ingest every capture that is found in ``sources``; see `gsmap.map.Map.ingest`."""
    dates = {scene.id: scene.captured_at for scene in store.scenes.list()}
    found, search = readers(
        sources, cameras=cameras, name=name, captured_at=captured_at, scale=scale, clean=clean, bbox=bbox
    )
    skipped, bad, good = list(search.skipped), list(search.unreadable), list[Path]()
    is_only_one = len(found) == 1 and not bad and _is_named(found[0], sources)
    results: list[IngestResult] = []
    with note_interruption(lambda: f"{len(results)} of {len(found)} captures are in the map"):
        for i, one in enumerate(found):
            progress("ingest", i / len(found), one.name)
            try:
                if one.path is not None and not exported_scenes(one.path).isdisjoint(dates):
                    raise InputError(
                        f"{one.path} is an export of scenes of this map: it would confirm their poses by themselves",
                        code="own_export",
                    )
                results.append(_add(store, one.read(), dates))
            except StoreError:  # of the map, and so of every capture
                raise
            except GsmapError as error:
                if is_only_one or one.path is None:
                    raise
                (skipped if error.code in ("not_gaussians", "own_export") else bad).append(
                    SkippedPath(one.path, str(error))
                )
            else:
                good += [] if one.path is None else [one.path]
    if len(skipped) > len(search.skipped) and not results and not bad:
        raise NotGaussiansError(skipped[-1].reason)
    for left_out in skipped:
        _log.warning("skipped: %s", left_out.reason)
    _set_aside(store, bad, [*good, *(Path(source) for source in sources if not isinstance(source, Gaussians))])
    progress("ingest", 1.0, f"{len(results)} captures")
    return results


def _is_named(one: CaptureReader, sources: Sequence[Source]) -> bool:
    """Return true if the user named a capture's file itself, not a folder that contains the file."""
    return one.path in [Path(source) for source in sources if not isinstance(source, Gaussians)]


def _set_aside(store: Store, bad: Sequence[SkippedPath], done: Sequence[Path]) -> None:
    """Record unreadable captures for `gsmap status`, and drop records of repaired or deleted captures.

    Args:
        done: files and folders that were searched; their other captures are in the map.
    """
    for one in bad:
        _log.warning("a capture is quarantined: %s", one.reason)
        store.quarantine.add(_what(one.path), escaped(str(one.path.absolute())), escaped(one.reason))
    still, mended = {_what(one.path) for one in bad}, {_what(path) for path in done}
    places = {place for path in done for place in (path.absolute(), path.resolve())}
    forgotten = []
    for aside in store.quarantine.list():
        if not aside.what.startswith(f"{CAPTURE} ") or aside.what in still:
            continue
        path = Path(aside.about)
        is_deleted = (
            not os.path.lexists(path) and path.parent.is_dir()
        )  # of a disk that is not mounted nothing is known
        if is_deleted or aside.what in mended or not places.isdisjoint((path, *path.parents)):
            forgotten.append(aside.what)
    if forgotten:
        store.quarantine.forget(forgotten)


def _what(path: Path) -> str:
    """Return the key of a quarantined capture."""
    return f"{CAPTURE} {hashlib.sha256(os.fsencode(path.absolute())).hexdigest()[:32]}"


def check_captures(
    paths: Sequence[str | os.PathLike[str]],
    *,
    cameras: str | os.PathLike[str] | None = None,
    name: str | None = None,
    captured_at: str | None = None,
    scale: str = "auto",
    clean: bool = False,
    bbox: Sequence[float] | None = None,
) -> None:
    """Raise an error for invalid captures before a map is created.

    Raises:
        NotFoundError, InputError, ConfigError: see `gsmap.map.Map.ingest`.
    """
    found, search = readers(
        paths, cameras=cameras, name=name, captured_at=captured_at, scale=scale, clean=clean, bbox=bbox
    )
    if len(found) == 1 and not search.unreadable and _is_named(found[0], paths):
        found[0].read()


def readers(
    sources: Sequence[Source],
    *,
    cameras: str | os.PathLike[str] | Cameras | None,
    name: str | None,
    captured_at: str | None,
    scale: str,
    clean: bool,
    bbox: Sequence[float] | None,
) -> tuple[list[CaptureReader], SearchResult]:
    """Find captures; return a reader for each capture, and the search result; see `gsmap.map.Map.ingest`."""
    given_date(captured_at)  # refuses what is none before anything is searched
    check_scale(scale)
    memory = [source for source in sources if isinstance(source, Gaussians)]
    if memory and len(sources) > 1:
        raise ConfigError("pass in-memory Gaussians one capture at a time", code="in_memory_mismatch")
    if memory:
        if cameras is not None and not isinstance(cameras, Cameras):
            raise ConfigError("pass gsmap.Cameras or None with in-memory Gaussians", code="in_memory_mismatch")
        called = name or "capture"
        options: dict[str, Any] = {"captured_at": captured_at, "scale_policy": scale, "clean": clean, "bbox": bbox}
        take = partial(take_capture, memory[0], cameras, name=called, **options)
        return [CaptureReader(called, take)], SearchResult()
    if isinstance(cameras, Cameras):
        raise ConfigError(
            "pass in-memory cameras with in-memory Gaussians, or a camera file with a Gaussian file",
            code="in_memory_mismatch",
        )
    search = search_captures([Path(source) for source in sources if not isinstance(source, Gaussians)])
    found = search.captures
    if len(found) > 1 and (cameras is not None or name is not None):
        raise ConfigError(
            f"cameras and name apply to one capture, but {len(found)} captures were found: ingest them one by one",
            code="many_captures",
        )
    options = {
        "cameras": cameras,
        "name": name,
        "captured_at": captured_at,
        "scale_policy": scale,
        "clean": clean,
        "bbox": bbox,
    }
    return [CaptureReader(files.name, partial(read_capture, files, **options), files.path) for files in found], search


def _add(store: Store, capture: Capture, dates: dict[str, str | None]) -> IngestResult:
    """Store a capture and update ``dates``."""
    scene, new = store.scenes.add(
        capture.content,
        capture.cameras,
        name=capture.name,
        scale_policy=capture.scale_policy,
        captured_at=capture.captured_at,
        source=capture.source,
        antialiased=capture.antialiased,
        notes=capture.notes,
        dated_by=capture.dated_by,
    )
    dated = scene.id in dates and scene.captured_at != dates[scene.id]
    dates[scene.id] = scene.captured_at
    notes = capture.notes
    if not new and not dated and capture.captured_at not in (None, scene.captured_at):
        notes = (*notes, f"its date stays {scene.captured_at or 'unknown'}; --captured-at changes it")
    return IngestResult(scene, new, dated and not new, notes)
