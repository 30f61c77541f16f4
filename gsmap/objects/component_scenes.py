"""The scenes of one component: boxes of all scenes, and segments that are loaded where they are needed."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from gsmap.geometry.boxes import box_around
from gsmap.types import Segments, Sim3

SegmentRef = tuple[str, int]
"""A segment: id of its scene, and its index in the scene's graph."""


@dataclass(frozen=True, eq=False)
class SegmentedScene:
    """A scene with a pose and segments.

    Args:
        scene: id of the scene.
        S_map_scene: pose of the scene.
        segments: segments of its scene graph.
        counts: (M,) number of Gaussians of each segment; default: by the members of the segments.
    """

    scene: str
    S_map_scene: Sim3
    segments: Segments
    counts: np.ndarray | None = None

    @cached_property
    def num_members(self) -> np.ndarray:
        """(M,) number of Gaussians of each segment."""
        members = self.segments.members
        return np.bincount(members[members >= 0], minlength=len(self.segments)) if self.counts is None else self.counts

    def without_members(self) -> SegmentedScene:
        """Return the scene without the members of its segments, which take most of its memory."""
        light = replace(self.segments, members=np.zeros(0, np.int32))
        return replace(self, segments=light, counts=self.num_members)

    @cached_property
    def points(self) -> np.ndarray:
        """(K, 3) samples of all segments, map frame and unit."""
        return self.S_map_scene.apply(self.segments.samples)

    @cached_property
    def box(self) -> np.ndarray | None:
        """Box (2, 3) around all segments, map frame and unit; None without segments."""
        return box_around(self.points) if len(self.segments.samples) else None

    def rows(self, segment: int) -> slice:
        """Return the rows of the samples of a segment."""
        end = int(self.segments.sample_counts[: segment + 1].sum())
        return slice(end - int(self.segments.sample_counts[segment]), end)


@dataclass(frozen=True, eq=False)
class MatchedSegments:
    """Identities of segments by comparisons of their scenes.

    Args:
        moved: pairs of segments of one moved object.
        parted: pairs of a segment and a scene that does not show the segment in place.
    """

    moved: Sequence[tuple[SegmentRef, SegmentRef]] = ()
    parted: Sequence[tuple[SegmentRef, str]] = ()


Match = Callable[[Collection[str]], MatchedSegments]
"""Function that returns what all comparisons with any of some scenes say."""


def no_match(scenes: Collection[str]) -> MatchedSegments:
    """Return the matches of scenes that were not compared."""
    return MatchedSegments()


@dataclass(frozen=True, eq=False)
class ComponentScenes:
    """The scenes of one component that have segments.

    Args:
        order: scene ids, oldest first.
        load: function that returns a scene; it may be called several times for one scene.
        boxes: box (2, 3) around the segments of each scene, map frame and unit; none for a scene with no segment.
        views: box (2, 3) around everything that the cameras of a scene can observe, map frame and unit; none for a
            scene that is not searched for objects.
    """

    order: Sequence[str]
    load: Callable[[str], SegmentedScene]
    boxes: Mapping[str, np.ndarray]
    views: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, scenes: Sequence[SegmentedScene]) -> ComponentScenes:
        """Return scenes in memory, oldest first, each of which may see all places."""
        by_id = {one.scene: one for one in scenes}
        boxes = {one.scene: one.box for one in scenes if one.box is not None}
        everywhere = np.array([[-np.inf] * 3, [np.inf] * 3])
        return cls(list(by_id), by_id.__getitem__, boxes, dict.fromkeys(by_id, everywhere))

    def without(self, others: Collection[str]) -> ComponentScenes:
        """Return the scenes that are not among some others."""
        if not others:
            return self
        order = [scene for scene in self.order if scene not in others]
        boxes, views = ({s: one[s] for s in order if s in one} for one in (self.boxes, self.views))
        return ComponentScenes(order, self.load, boxes, views)

    @cached_property
    def rank(self) -> dict[str, int]:
        """Place of each scene in the order of time."""
        return {scene: i for i, scene in enumerate(self.order)}

    def samples(self, segment: SegmentRef) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples (K, 3) of a segment, map frame and unit, and their colours (K, 3), CIE L*a*b*."""
        scene = self.load(segment[0])
        rows = scene.rows(segment[1])
        return scene.points[rows], scene.segments.sample_colours[rows]

    def nearest_in_time(self, members: Mapping[str, int], scene: str) -> SegmentRef:
        """Return the segment among those of an object whose scene is nearest in time to a scene; itself if alone."""
        at = self.rank[scene]
        others = [one for one in members if one != scene] or [scene]
        best = min(others, key=lambda one: (abs(self.rank[one] - at), self.rank[one]))
        return best, members[best]


def boxes_meet(a: np.ndarray, b: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Return which of the boxes (N, 2, 3) meet which of the boxes (M, 2, 3), as an (N, M) mask."""
    out = np.ones((len(a), len(b)), bool)
    for axis in range(3):
        out &= a[:, None, 0, axis] <= b[None, :, 1, axis] + margin
        out &= a[:, None, 1, axis] >= b[None, :, 0, axis] - margin
    return out
