"""Maps as values: branches and tags, merging, splitting, forgetting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from gsmap.types.rows.base import Row


@dataclass(frozen=True, eq=False, kw_only=True)
class BranchRow(Row):
    """A branch or a tag of a map.

    Args:
        name: unique among the branches and tags of the map.
        kind: ``branch``, or ``tag`` where it cannot change.
        map: what opens it, such as ``site.gsmap@what-if``.
        parent: what opens the map or branch that it was made of.
        created_at: when it was made.
        revision: number of its newest revision; null before the first.
        num_scenes: its living scenes.
        num_bytes: on disk, of its catalog; arrays are shared with the map.
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
class MergeReport(Row):
    """What came from another map; where nothing was new there, every count is 0.

    Args:
        map: the map that took it in.
        from_map: the map that it came from; that one is as it was.
        num_scenes: scenes that are new here, or live again.
        num_removed: scenes that are removed here now, or came as removed ones of older revisions.
        num_known: scenes that both maps had.
        num_graphs: scene graphs; none is made again.
        num_registrations: registrations of pairs.
        num_reviews: reviews of pairs.
        num_facts: names, dates, notes and tags.
        num_priors: priors.
        num_observations: observations of the world.
        num_photos: photographs that are kept.
        num_models: models.
        num_comparisons: pairs that were looked at for changes.
        num_change_reviews: reviews of changes.
        num_objects: objects that were not known here.
        num_object_facts: names, labels and notes of objects.
        num_revisions: revisions, as history.
        renamed: scenes whose name was taken here, the new name by the old one.
        revision: the revision that holds the newest poses of both; null where none was needed.
        num_bytes: of arrays that are new here, linked or copied.
        notes: what a person should know: settings that differ, scenes that stay away or apart.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "num_scenes": "scenes",
        "num_known": "known",
        "num_graphs": "graphs",
        "num_registrations": "registrations",
        "num_facts": "facts",
        "num_revisions": "revisions",
        "num_bytes": "bytes",
    }

    map: str
    from_map: str
    num_scenes: int
    num_removed: int
    num_known: int
    num_graphs: int
    num_registrations: int
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
    revision: int | None
    num_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class SplitReport(Row):
    """The map that was made of a part of another.

    Args:
        map: its folder.
        from_map: the map that it is part of; that one is as it was.
        scene_names: its scenes.
        num_graphs: their graphs.
        num_registrations: registrations of pairs among them.
        revision: number of the revision that holds their newest poses; null where they had none.
        num_bytes: of its arrays, linked or copied.
        notes: what a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "map": "map",
        "scene_names": "scenes",
        "num_graphs": "graphs",
        "num_registrations": "registrations",
        "num_bytes": "bytes",
    }

    map: str
    from_map: str
    scene_names: tuple[str, ...]
    num_graphs: int
    num_registrations: int
    revision: int | None
    num_bytes: int
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class PurgeReport(Row):
    """The receipt of a scene that was forgotten: what went, and where else it may live.

    Args:
        scene_id: its id; nothing else of it is kept.
        maps: the map and the branches that it was taken out of.
        num_rows: rows that went, by what they were.
        num_groups: groups of arrays that were deleted.
        num_bytes: bytes on disk of these.
        num_tiles: files of tiles made with it, of coarser levels above them, and of what an export had still to delete,
            that were deleted; `gsmap export` makes those places again without it.
        exports: the folders that these lay in.
        unreachable: folders that were exported to and could not be looked into, and why.
        catalog_copies: copies of the catalog, left by migrations, that were deleted.
        branches: branches and tags of the map that still have it: the arrays stay for these. `--branches` purges them.
        backups: snapshots, taken since it first came, that may hold it.
        linked_files: how many of its files had other names on the same disk: a map that it was merged or split into, or
            a clone, has it.
        mentions: what people wrote elsewhere in the map with its name or id in it.
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
