"""Ingest: captures in files or in memory become scenes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from gsmap.errors import ConfigError
from gsmap.ingest import Capture, find_captures, given_date, read_capture, take_capture
from gsmap.map.sharing import noting
from gsmap.store import Store
from gsmap.types import Cameras, Gaussians, Scene
from gsmap.types.progress import StageProgress

Source = str | os.PathLike[str] | Gaussians


@dataclass(frozen=True)
class Ingested:
    """What became of one capture.

    Args:
        scene: as it is in the map now.
        new: whether it was added.
        dated: whether the map had it already, and it has another date now.
        notes: what a person should know.
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
    progress: StageProgress,
) -> list[Ingested]:
    """Every capture found; see `gsmap.map.Map.ingest`."""
    dates = {scene.id: scene.captured_at for scene in store.scenes.list()}
    found = readers(sources, cameras=cameras, name=name, captured_at=captured_at, scale=scale)
    results: list[Ingested] = []
    with noting(lambda: f"{len(results)} of {len(found)} captures are in the map"):
        for i, (called, read) in enumerate(found):
            progress("ingest", i / len(found), called)
            results.append(_add(store, read(), dates))
    progress("ingest", 1.0, f"{len(results)} captures")
    return results


def readers(
    sources: Sequence[Source],
    *,
    cameras: str | os.PathLike[str] | Cameras | None,
    name: str | None,
    captured_at: str | None,
    scale: str,
) -> list[tuple[str, Callable[[], Capture]]]:
    """What reads and checks each capture found, and what it is called; see `gsmap.map.Map.ingest`."""
    given_date(captured_at)  # refuses what is none before anything is searched
    memory = [source for source in sources if isinstance(source, Gaussians)]
    if memory and len(sources) > 1:
        raise ConfigError("Gaussians in memory are ingested one capture at a time")
    if memory:
        if cameras is not None and not isinstance(cameras, Cameras):
            raise ConfigError("Gaussians in memory go with gsmap.Cameras, or with none")
        called = name or "capture"
        take = partial(take_capture, memory[0], cameras, name=called, captured_at=captured_at, scale_policy=scale)
        return [(called, take)]
    if isinstance(cameras, Cameras):
        raise ConfigError("cameras in memory go with Gaussians in memory; for a file name a file of cameras")
    found = find_captures([Path(source) for source in sources if not isinstance(source, Gaussians)])
    if len(found) > 1 and (cameras is not None or name is not None):
        raise ConfigError(f"cameras and name are for one capture, {len(found)} were found: ingest them one by one")
    options: dict[str, Any] = {"cameras": cameras, "name": name, "captured_at": captured_at, "scale_policy": scale}
    return [(files.name, partial(read_capture, files, **options)) for files in found]


def _add(store: Store, capture: Capture, dates: dict[str, str | None]) -> Ingested:
    """Store a capture; ``dates`` of the scenes in the map are brought up to date."""
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
        notes = (*notes, f"its date stays {scene.captured_at or 'unknown'}, as was said before; --captured-at sets it")
    return Ingested(scene, new, dated and not new, notes)
