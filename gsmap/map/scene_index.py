"""An index over scenes in stored segments, with updates and repair."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from gsmap.errors import GsmapError
from gsmap.store import Store
from gsmap.store.indexes import StoredSegment
from gsmap.types.retrieval import IndexedScene
from gsmap.types.segments import InMemory, merged, to_merge

AT_ONCE = 64
"""Number of scenes whose rows are computed at a time, which take some megabytes."""

PATIENCE = 8
"""Number of attempts to read an index, in case other processes change it or it is damaged and rebuilt."""


@dataclass(frozen=True)
class SceneIndex:
    """An index over the scenes of a map.

    Args:
        store: the store of the map.
        recipe: the recipe of its rows (`RecipeKey.recipe`).
        beside: recipes of the other indexes of the map.
        keys: digest of the input of each indexed scene, by scene id.
        make: builds a segment of some scenes.
    """

    store: Store
    recipe: str
    beside: Collection[str]
    keys: Mapping[str, str]
    make: Callable[[Sequence[str]], InMemory]

    def segments(self) -> list[StoredSegment]:
        """Return the stored segments, with outdated and repeated scenes masked."""
        seen = set[str]()
        found = []
        for segment in self.store.indexes.segments(self.recipe):
            members: list[IndexedScene | None] = []
            for member in segment.members:
                counts = None
                if member is not None and member.scene not in seen and self.keys.get(member.scene) == member.graph:
                    counts = member
                    seen.add(member.scene)
                members.append(counts)
            found.append(replace(segment, members=members))
        return found

    def missing(self, segments: Sequence[StoredSegment]) -> list[str]:
        """Return the scenes that are in no segment."""
        present = {member.scene for segment in segments for member in segment.members if member is not None}
        return sorted(set(self.keys) - present)

    def update(self, progress: Callable[[str], None]) -> list[StoredSegment]:
        """Add the missing scenes and return all segments."""
        while True:
            segments = self.segments()
            missing = self.missing(segments)
            if not missing:
                return segments
            if len(missing) > AT_ONCE:
                progress(f"{len(missing)} scenes into the index")
            new = self.make(missing[:AT_ONCE])
            sizes = [sum(member is not None for member in segment.members) for segment in segments]
            old = [segments[k] for k in to_merge(sizes, len(new.members))]
            whole = merged([*old, new])
            members = [member for member in whole.members if member is not None]
            self.store.indexes.save_segment(
                self.recipe, members, whole.arrays, [segment.id for segment in old], beside=self.beside
            )

    def forget_damaged(self) -> bool:
        """Drop unreadable segments, so that `update` builds them again; return true if any was dropped."""
        damaged = [segment.id for segment in self.segments() if _is_damaged(segment)]
        self.store.indexes.forget(damaged)
        return bool(damaged)


def _is_damaged(segment: StoredSegment) -> bool:
    try:
        merged([segment])
    except GsmapError:
        return True
    return False
