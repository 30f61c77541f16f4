"""Branches and tags, merges, splits and purges."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class BranchRow(Row):
    """A branch or tag of a map.

    Args:
        name: unique among the branches and tags of the map.
        kind: ``branch``, or ``tag`` if it cannot change.
        map: path that opens it, such as ``site.gsmap@what-if``.
        parent: path of the map or branch that it was made from.
        created_at: time of creation.
        revision: number of its newest revision; null before the first.
        num_scenes: number of living scenes.
        num_bytes: size of its catalog on disk; arrays are shared with the map.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "name": "name",
        "parent": "made of",
        "created_at": "made",
        "num_scenes": "scenes",
        "revision": "revision",
        "num_bytes": "bytes",
    }

    name: str
    kind: str
    map: str
    parent: str
    created_at: str
    revision: int | None
    num_scenes: int
    num_bytes: int


@dataclass(frozen=True, eq=False, kw_only=True)
class CopyReport(Row):
    """Items copied from one map to another.

    Args:
        map: folder of the target map.
        from_map: the source map, which stays unchanged.
        num_graphs: number of scene graphs.
        num_registrations: number of registrations of pairs.
        revision: revision with the newest poses; null if none was needed.
        num_bytes: size of new arrays, linked or copied.
        notes: remarks: settings that differ, scenes that stay removed or apart.
    """

    map: str
    from_map: str
    num_graphs: int
    num_registrations: int
    revision: int | None
    num_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class MergeReport(CopyReport):
    """The numbers of items copied from another map; all are 0 if nothing was new.

    Args:
        num_scenes: scenes that are new or alive again.
        num_removed: scenes that are removed now, or came as removed scenes of older revisions.
        num_known: scenes that both maps had.
        num_reviews: reviews of pairs.
        num_facts: names, dates, notes and tags.
        num_priors: priors.
        num_observations: observations of the world.
        num_photos: stored photos.
        num_models: models.
        num_comparisons: compared pairs.
        num_change_reviews: reviews of changes.
        num_objects: objects that are new here.
        num_object_facts: annotations of objects.
        num_revisions: revisions, as history.
        renamed: new name of each scene whose name was taken, by the old one.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_scenes": "scenes",
        "num_known": "known",
        "num_graphs": "graphs",
        "num_registrations": "registrations",
        "num_reviews": "reviews",
        "num_facts": "facts",
        "num_revisions": "revisions",
        "num_bytes": "bytes",
    }

    num_scenes: int
    num_removed: int
    num_known: int
    num_reviews: int
    num_facts: int
    num_priors: int
    num_observations: int
    num_photos: int
    num_models: int
    num_comparisons: int
    num_change_reviews: int
    num_objects: int
    num_object_facts: int
    num_revisions: int
    renamed: Mapping[str, str]


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitReport(CopyReport):
    """A map made from a part of another.

    Args:
        scene_names: names of its scenes.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "map": "map",
        "scene_names": "scenes",
        "num_graphs": "graphs",
        "num_registrations": "registrations",
        "num_bytes": "bytes",
    }

    scene_names: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class PurgeReport(Row):
    """The receipt of a purge: what was deleted, and where copies may remain.

    Args:
        scene_id: id of the scene, all that is kept of it.
        maps: map and branches that it was deleted from.
        num_rows: number of deleted rows, by kind.
        num_groups: number of deleted array groups.
        num_bytes: bytes freed on disk.
        num_tiles: number of deleted tile files, coarser levels included; `gsmap export` makes these places again.
        exports: folders of the deleted tiles.
        unreachable: export folders that could not be cleaned, with the reason.
        catalog_copies: deleted copies of the catalog left by migrations.
        branches: branches and tags that still have it, whose arrays are kept; `--branches` purges them.
        backups: snapshots that may hold it.
        linked_files: number of its files with other names on the same disk, such as in a clone or a merged map.
        mentions: texts elsewhere in the map with its name or id.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_id": "scene",
        "num_groups": "groups",
        "num_bytes": "bytes",
        "num_tiles": "tiles",
        "branches": "still in",
        "backups": "perhaps in",
    }

    scene_id: str
    maps: tuple[str, ...]
    num_rows: Mapping[str, int]
    num_groups: int
    num_bytes: int
    num_tiles: int
    exports: tuple[str, ...]
    unreachable: tuple[str, ...]
    catalog_copies: tuple[str, ...]
    branches: tuple[str, ...]
    backups: tuple[str, ...]
    linked_files: int
    mentions: tuple[str, ...]
