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
