"""Find the places where a person rejected the changes since a capture, so that an export overrules nothing there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

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
    visits. Its margin ends where the map claims a change. Changes of the lighting concern no place. A rejection holds
    although the poses moved since the comparison.

    Args:
        comparisons: the current comparison of each pair.
        scenes, placed: the exported scenes and their poses, by scene id.
        metres: metric scale of each component.
    """
    rejected: list[tuple[str, int, UnchangedPlace]] = []
    claimed: dict[int, list[UnchangedPlace]] = {}
    for one in comparisons:
        both = [scenes[scene] for scene in (one.older, one.newer) if scene in placed]
        dated = {scene.id: parse_moment(scene.captured_at) for scene in both if scene.captured_at is not None}
        components = {placed[scene].component for scene in dated}
        if len(dated) < 2 or len(components) > 1:
            continue
        (component,) = components
        S_map_newer = in_metres(placed[one.newer].S_map_scene, metres[component].metres_per_unit)
        S_frame_map = one.S_frame_newer @ S_map_newer.inverse()
        for change in one.changes:
            place = UnchangedPlace(S_frame_map, change.box)
            if change.kind != "lighting" and change.status == "rejected":
                rejected.append((min(dated, key=dated.__getitem__), component, place))
            elif change.kind != "lighting":
                claimed.setdefault(component, []).append(place)
    around = {component: np.array([_box_in_map(place) for place in found]) for component, found in claimed.items()}
    out: dict[str, list[UnchangedPlace]] = {}
    for scene, component, place in rejected:
        margin_m = place.margin_m
        if component in around:
            near = np.flatnonzero(_gaps(_box_in_map(place), around[component]) < margin_m)
            margin_m = min((_gap(place, claimed[component][i]) for i in near), default=margin_m)
            # In whole centimetres, since poses and rounding move gaps by less, and the margin is part of a tile's key.
            margin_m = np.floor(100 * margin_m + 1e-3) / 100
        if margin_m >= 0:
            out.setdefault(scene, []).append(replace(place, margin_m=float(margin_m)))
    return out


def places_near(
    places: Mapping[str, Sequence[UnchangedPlace]], tile: PlannedTile, within_m: float
) -> dict[str, list[UnchangedPlace]]:
    """Return the places within a distance of a tile, by scene id."""
    bounds = tile.bounds * tile.metres_per_unit

    def is_near(place: UnchangedPlace) -> bool:
        return not tile.is_cut or bool(_gaps(bounds, _box_in_map(place)) < within_m)

    near = {scene: [place for place in places.get(scene, ()) if is_near(place)] for scene in tile.poses}
    return {scene: found for scene, found in near.items() if found}


def _box_in_map(place: UnchangedPlace) -> np.ndarray:
    """Return the box (2, 3) around a place in the map frame."""
    return moved_box(place.box, place.S_frame_map.inverse())


def _gap(a: UnchangedPlace, b: UnchangedPlace) -> float:
    """Return the gap between two places, the second one as the box around it in the frame of the first."""
    return float(_gaps(a.box, moved_box(b.box, a.S_frame_map @ b.S_frame_map.inverse())))


def _gaps(box: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the largest gap along an axis between a box (2, 3) and each of others (..., 2, 3); negative if they share
    a volume."""
    out: np.ndarray = np.maximum(others[..., 0, :] - box[1], box[0] - others[..., 1, :]).max(-1)
    return out
