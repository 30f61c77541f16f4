"""Operate on whole maps and report rows: branches and tags, merge, split, restored scenes, purge receipts."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsmap.durable import sync_folder, write_text_whole
from gsmap.errors import ConfigError, NotFoundError, StoreError
from gsmap.geometry.boxes import box_corners
from gsmap.settings import FILE_NAME
from gsmap.store import Store, merging, staging
from gsmap.store.error_translation import translate_errors
from gsmap.store.purging import Purge
from gsmap.types import Scene
from gsmap.types.rows.map_operations import MergeReport, PurgeReport, SplitReport


def merge(store: Store, source: str | os.PathLike[str]) -> MergeReport:
    """Merge all data of another map into this map; see `gsmap.store.merging.merge`."""
    with Store.open(source, "r") as other:
        return replace(merging.merge(store, other), from_map=os.fspath(source))


def split(store: Store, out: str | os.PathLike[str], chosen: Sequence[str]) -> SplitReport:
    """Make a map of some scenes (ids); see `gsmap.store.merging.split`. After an error, no partial map remains."""
    folder = Path(out).absolute()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise StoreError(f"{out} exists: choose another name", code="already_exists")
    with translate_errors(folder, "no map was made"), staging.beside(folder) as staged:
        with Store.create(staged) as part:
            merged = merging.split(store, part, chosen)
            names = tuple(scene.name for scene in part.scenes.list())
        if (store.folder / FILE_NAME).is_file():
            write_text_whole(staged / FILE_NAME, (store.folder / FILE_NAME).read_text(encoding="utf-8"))
        os.rename(staged, folder)
        sync_folder(folder.parent)
    return SplitReport(
        map=os.fspath(out),
        from_map=store.location,
        scene_names=names,
        num_graphs=merged.num_graphs,
        num_registrations=merged.num_registrations,
        revision=merged.revision,
        num_bytes=merged.num_bytes,
        notes=merged.notes,
    )


def chosen(store: Store, island: int | None, box: Sequence[float] | None, scenes: Sequence[str] | None) -> list[str]:
    """Return the ids of scenes, which are chosen by component, by box or by name.

    Raises:
        ConfigError: none of these is asked for, or scenes and another one.
        NotFoundError: there are none.
    """
    if (scenes is None) == (island is None and box is None) or (scenes is not None and not scenes):
        raise ConfigError("choose scenes by component, by box, or by name", code="nothing_requested")
    if scenes is not None:
        return list(dict.fromkeys(store.scenes.get(ref).id for ref in scenes))
    graph, living = store.revisions.get(), {scene.id: scene for scene in store.scenes.list()}
    placed = [pose for pose in (graph.poses.values() if graph else ()) if pose.scene in living]
    inside = [pose for pose in placed if pose.component == (0 if island is None else island)]
    if box is not None:
        low, high = np.reshape(np.asarray(box, dtype=np.float64), (2, 3))
        corners = {pose.scene: pose.S_map_scene.apply(box_corners(living[pose.scene].bounds)) for pose in inside}
        touching = {s for s, at in corners.items() if (at.min(0) <= high).all() and (at.max(0) >= low).all()}
        inside = [pose for pose in inside if pose.scene in touching]
    if not inside:
        known = sorted({pose.component for pose in placed})
        raise NotFoundError(
            f"no placed scene of {store.location} lies there: the components of the map are {known}",
            code="no_placed_scene",
        )
    return [pose.scene for pose in inside]


def restore_scene(store: Store, ref: str, source: str | os.PathLike[str] | None) -> Scene:
    """Restore a removed scene, or copy a scene from another map."""
    if source is None:
        return store.scenes.restore(ref)
    with Store.open(source, "r") as other:
        scene = other.scenes.find_any(ref).id
        merging.import_scene(store, other, scene)
    return store.scenes.get(scene)


def purge_report(purged: Sequence[tuple[str, Purge]]) -> PurgeReport:
    """Return the receipt of a purge over all catalogs that had the scene."""

    def every(key: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(text for _, one in purged for text in one.receipt[key]))

    def total(key: str) -> int:
        return sum(one.receipt[key] for _, one in purged)

    rows: Counter[str] = Counter()
    for _, one in purged:
        rows.update(one.receipt["rows"])
    maps = tuple(dict.fromkeys(location for location, _ in purged))
    return PurgeReport(
        scene_id=purged[0][1].scene,
        maps=maps,
        num_rows=dict(rows),
        num_groups=total("num_groups"),
        num_bytes=total("num_bytes"),
        num_tiles=total("tile_files"),
        exports=every("cleaned"),
        unreachable=every("unreachable"),
        catalog_copies=every("catalog_copies"),
        branches=tuple(name for name in every("branches") if name not in maps),
        backups=every("backups"),
        linked_files=max(one.receipt["linked_files"] for _, one in purged),
        mentions=every("mentions"),
    )
