"""Find the places where a person rejected the changes since a capture, so that an export overrules nothing there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsmap.export import PlannedTile
from gsmap.geometry.boxes import moved_box
from gsmap.geometry.metric_scale import in_metres
from gsmap.map.date_filter import parse_moment
from gsmap.store.change_rows import Comparison
from gsmap.types import Scene, ScenePose
from gsmap.types.merging import UnchangedPlace
from gsmap.types.metric_scale import MetricScale


def rejected_places(
    comparisons: Sequence[Comparison],
    scenes: Mapping[str, Scene],
    placed: Mapping[str, ScenePose],
    metres: Mapping[int, MetricScale],
) -> dict[str, list[UnchangedPlace]]:
    """Return the places by the id of the older scene.

    A place counts only if the map claims no other change that overlaps it: the place may have changed between other
    visits. Changes of the lighting concern no place. A rejection holds although the poses moved since the comparison.

    Args:
        comparisons: the current comparison of each pair.
        scenes, placed: the exported scenes and their poses, by scene id.
        metres: metric scale of each component.
    """
    rejected: list[tuple[str, int, UnchangedPlace]] = []
    claimed: list[tuple[int, UnchangedPlace]] = []
    for one in comparisons:
        both = [scenes[scene] for scene in (one.older, one.newer) if scene in placed]
        dated = {scene.id: parse_moment(scene.captured_at) for scene in both if scene.captured_at is not None}
        if len(dated) < 2:
            continue
        pose = placed[one.newer]
        S_map_newer = in_metres(pose.S_map_scene, metres[pose.component].metres_per_unit)
        S_frame_map = one.S_frame_newer @ S_map_newer.inverse()
        for change in one.changes:
            place = UnchangedPlace(S_frame_map, change.box)
            if change.kind != "lighting" and change.status == "rejected":
                rejected.append((min(dated, key=dated.__getitem__), pose.component, place))
            elif change.kind != "lighting":
                claimed.append((pose.component, place))
    out: dict[str, list[UnchangedPlace]] = {}
    for scene, component, place in rejected:
        if not any(component == other and _overlap(place, theirs) for other, theirs in claimed):
            out.setdefault(scene, []).append(place)
    return out


def places_near(
    places: Mapping[str, Sequence[UnchangedPlace]], tile: PlannedTile, within_m: float
) -> dict[str, list[UnchangedPlace]]:
    """Return the places within a distance of a tile, by scene id."""
    bounds = tile.bounds * tile.metres_per_unit
    around = np.array([bounds[0] - within_m, bounds[1] + within_m])

    def is_near(place: UnchangedPlace) -> bool:
        return not tile.is_cut or _meet(moved_box(place.box, place.S_frame_map.inverse()), around)

    near = {scene: [place for place in places.get(scene, ()) if is_near(place)] for scene in tile.poses}
    return {scene: found for scene, found in near.items() if found}


def _overlap(a: UnchangedPlace, b: UnchangedPlace) -> bool:
    """Return whether two places share a volume, the second one as the box around it in the frame of the first."""
    S = a.S_frame_map @ b.S_frame_map.inverse()
    is_same = np.allclose(S.matrix(), np.eye(4), atol=1e-9)
    return _meet(a.box, b.box if is_same else moved_box(b.box, S))


def _meet(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((a[0] < b[1]).all() and (b[0] < a[1]).all())
