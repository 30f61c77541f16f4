"""Find the places where a person rejected the changes since a capture, so that an export overrules nothing there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from gsmap.geometry.boxes import moved_box
from gsmap.geometry.metric_scale import in_metres
from gsmap.store.change_rows import Comparison
from gsmap.types import ScenePose
from gsmap.types.metric_scale import MetricScale


def rejected_places(
    standing: Sequence[Comparison], placed: Mapping[str, ScenePose], metres: Mapping[int, MetricScale]
) -> dict[str, np.ndarray]:
    """Return boxes (K, 2, 3) in the map frame, in metres, by the id of the older scene.

    A place counts only if the map claims no other change that overlaps it: the place may have changed between other
    visits. Changes of the lighting concern no place.

    Args:
        standing: the comparisons that hold (`gsmap.map.stages.change.standing_comparisons`).
        placed: poses of the exported scenes, by scene id.
        metres: metric scale of each component.
    """
    rejected: list[tuple[str, int, np.ndarray]] = []
    claimed: list[tuple[int, np.ndarray]] = []
    for one in standing:
        if one.older not in placed or one.newer not in placed:
            continue
        pose = placed[one.newer]
        S = in_metres(pose.S_map_scene, metres[pose.component].metres_per_unit) @ one.S_frame_newer.inverse()
        for change in one.changes:
            box = moved_box(change.box, S)
            if change.kind != "lighting" and change.status == "rejected":
                rejected.append((one.older, pose.component, box))
            elif change.kind != "lighting":
                claimed.append((pose.component, box))
    out: dict[str, list[np.ndarray]] = {}
    for scene, component, box in rejected:
        if not any(component == other and _overlap(box, theirs) for other, theirs in claimed):
            out.setdefault(scene, []).append(box)
    return {scene: np.array(boxes) for scene, boxes in out.items()}


def _overlap(a: np.ndarray, b: np.ndarray) -> bool:
    return bool((a[0] <= b[1]).all() and (b[0] <= a[1]).all())
