"""An index of the map's scenes, in segments that the store keeps: brought up to date, and made anew where damaged."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from gsmap.errors import GsmapError
from gsmap.store import Store
from gsmap.store.indexes import StoredSegment
from gsmap.types.retrieval import Member
from gsmap.types.segments import InMemory, merged, to_merge

AT_ONCE = 64
"""Scenes whose rows are made at a time: some megabytes."""

PATIENCE = 8
"""Times that others may change an index while it is read, or that a damaged one is made anew."""


@dataclass(frozen=True)
class SceneIndex:
    """An index over scenes.

    Args:
        store: of the map.
        recipe: of its rows (`RecipeKey.recipe`).
        beside: recipes of the map's other indexes.
        keys: by scene, the digest of what its rows are made from; these scenes count, and no others.
        make: a segment of some scenes.
    """

    store: Store
    recipe: str
    beside: Collection[str]
    keys: Mapping[str, str]
    make: Callable[[Sequence[str]], InMemory]

    def segments(self) -> list[StoredSegment]:
        """What is kept; of its scenes those count whose rows are of what the scene has now, each once."""
        seen = set[str]()
        found = []
        for segment in self.store.indexes.segments(self.recipe):
            members: list[Member | None] = []
            for member in segment.members:
                counts = None
                if member is not None and member.scene not in seen and self.keys.get(member.scene) == member.graph:
                    counts = member
                    seen.add(member.scene)
                members.append(counts)
            found.append(replace(segment, members=members))
        return found

    def missing(self, segments: Sequence[StoredSegment]) -> list[str]:
        """Scenes that are in none."""
        present = {member.scene for segment in segments for member in segment.members if member is not None}
        return sorted(set(self.keys) - present)

    def brought_up_to_date(self, progress: Callable[[str], None]) -> list[StoredSegment]:
        """`segments`, once the scenes are in the index that were not in it."""
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
            self.store.indexes.put(
                self.recipe, members, whole.arrays, [segment.id for segment in old], beside=self.beside
            )

    def forget_damaged(self) -> bool:
        """Drop segments that cannot be read: their scenes are put in anew. Whether there were any."""
        damaged = [segment.id for segment in self.segments() if _is_damaged(segment)]
        self.store.indexes.forget(damaged)
        return bool(damaged)


def _is_damaged(segment: StoredSegment) -> bool:
    try:
        merged([segment])
    except GsmapError:
        return True
    return False
