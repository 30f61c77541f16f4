"""Associate segments anew where scenes changed, and keep the objects of all other places."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from gsmap.objects.component_scenes import ComponentScenes, Match, MatchedSegments, SegmentRef, boxes_meet
from gsmap.objects.fuse import CELL_M, PlacedSegments, fuse

Group = tuple[SegmentRef, ...]
"""The segments of one object, oldest scene first."""


def regroup(
    scenes: ComponentScenes,
    earlier: Sequence[Mapping[str, int]],
    broken: Collection[int],
    changed: Collection[str],
    touched: Sequence[np.ndarray],
    metres: float,
    min_overlap: float,
    match: Match,
) -> tuple[list[Group], list[int], MatchedSegments]:
    """Group the segments near changed scenes into objects.

    The segments of a scene depend on scenes that share cells with it, so those that meet a changed scene are associated
    anew, in the company of all scenes that meet these. An earlier object that shares a segment with a new group is
    grouped anew as a whole, wherever its segments are.

    Args:
        earlier: segments of each earlier object by scene, without those of changed scenes.
        broken: indices of the earlier objects that lost segments with changed scenes.
        changed: scenes that are new, moved or described anew.
        touched: boxes (2, 3) around the former segments of scenes that are gone or changed, map frame and unit.
        metres: metres per unit of the map.
        min_overlap: see `gsmap.objects.make.Params`.
        match: see `gsmap.objects.make.update_objects`.

    Returns:
        The new groups, the indices of the earlier objects that stay, and what comparisons say near these groups.
    """
    margin = CELL_M / metres
    near = set(changed) | _meeting(scenes, [*touched, *_boxes_of(scenes, changed)], margin)
    region = near | _meeting(scenes, _boxes_of(scenes, near), margin)
    region |= {scene for i, members in enumerate(earlier) if i in broken or near & members.keys() for scene in members}
    owner = {segment: i for i, members in enumerate(earlier) for segment in members.items()}
    if not region:
        return [], [i for i in range(len(earlier)) if i not in broken], MatchedSegments()
    while True:
        told = match(region)
        groups = _fuse(scenes, region, told, metres, min_overlap)
        taken, dropped, missing = _spread(groups, near, earlier, broken, owner)
        if not missing:
            break
        region |= missing
    same = {frozenset(earlier[i].items()): i for i in dropped.difference(broken)}
    kept, new = set(range(len(earlier))).difference(dropped), []
    for group in (groups[i] for i in sorted(taken)):
        if (old := same.get(frozenset(group))) is None:
            new.append(group)
        else:
            kept.add(old)
    return new, sorted(kept), told


def _spread(
    groups: Sequence[Group],
    near: Collection[str],
    earlier: Sequence[Mapping[str, int]],
    broken: Collection[int],
    owner: Mapping[SegmentRef, int],
) -> tuple[set[int], set[int], set[str]]:
    """Find the groups that are new because they touch the given scenes or share an earlier object with one that is.

    Returns:
        Indices of these groups, of the earlier objects that they replace, and scenes whose segments must be grouped,
        too.
    """
    place = {segment: i for i, group in enumerate(groups) for segment in group}
    taken = {i for segment, i in place.items() if segment[0] in near}
    taken |= {place[segment] for i in broken for segment in earlier[i].items()}
    left, dropped, missing = list(taken), set(broken), set[str]()
    while left:
        for segment in groups[left.pop()]:
            old = owner.get(segment)
            if old is None or old in dropped:
                continue
            dropped.add(old)
            for other in earlier[old].items():
                if other not in place:
                    missing.add(other[0])
                elif place[other] not in taken:
                    taken.add(place[other])
                    left.append(place[other])
    return taken, dropped, missing


def _fuse(
    scenes: ComponentScenes, region: Collection[str], told: MatchedSegments, metres: float, min_overlap: float
) -> list[Group]:
    """Group the segments of some scenes; see `gsmap.objects.fuse`."""
    order = [scene for scene in scenes.order if scene in region]
    at = {scene: i for i, scene in enumerate(order)}
    placed = []
    for one in map(scenes.load, order):
        own = one.segments
        of = np.repeat(np.arange(len(own)), own.sample_counts)
        placed.append(PlacedSegments(one.points * metres, of, own.sample_colours, len(own)))
    moved = [((at[p[0]], p[1]), (at[q[0]], q[1])) for p, q in told.moved if p[0] in at and q[0] in at]
    parted = [((at[p[0]], p[1]), at[other]) for p, other in told.parted if p[0] in at and other in at]
    return [tuple((order[c], t) for c, t in group) for group in fuse(placed, moved, parted, min_overlap)]


def _boxes_of(scenes: ComponentScenes, some: Collection[str]) -> list[np.ndarray]:
    return [scenes.boxes[scene] for scene in some if scene in scenes.boxes]


def _meeting(scenes: ComponentScenes, boxes: Sequence[np.ndarray], margin: float) -> set[str]:
    """Return the scenes whose segments meet any of some boxes (2, 3)."""
    ids = list(scenes.boxes)
    if not ids or not boxes:
        return set()
    meets = boxes_meet(np.array([scenes.boxes[scene] for scene in ids]), np.array(boxes), margin)
    return {ids[row] for row in np.flatnonzero(meets.any(1))}
