"""Where a scan lies in a map."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanSupport(Row):
    """What one scene says of a scan.

    Args:
        scene: id.
        scene_name: name.
        status: ``accepted`` (it shows the scan), ``rejected`` or ``no_match``.
        reason: why not; empty where it was accepted.
        probability: that the match is right; null where nothing was measured.
        overlap: share of the smaller one's surface that coincides.
        component: of the map.
        S_map_scan: where it puts the scan; null where it says nothing.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "scene_name": "scene",
        "status": "status",
        "probability": "probability",
        "overlap": "overlap",
        "reason": "reason",
    }

    scene: str
    scene_name: str
    status: str
    reason: str
    probability: float
    overlap: float
    component: int
    S_map_scan: Sim3 | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanRow(Row):
    """Where a scan lies in the map, or why nobody can say.

    Args:
        file: as it was given.
        kind: ``points``, ``mesh``, ``depth`` or ``splat``.
        status: ``placed`` or ``refused``.
        reason: why it was refused; empty where it was placed.
        S_map_scan: takes points of the scan, less ``origin``, to the frame of the component; null where refused.
        T_map_camera: of a depth picture, the camera's pose (OpenCV axes), translation in the map's unit; else null.
        origin: what was taken from the file's coordinates; zeros unless they are large.
        covariance: 7x7 of ``S_map_scan`` over [rot_rad, trans, log_scale] on the scan's side; null where refused.
        sigma_deg: standard deviation of the rotation about its least known axis.
        sigma_m: of the place of the scan's middle in its least known direction, metres of the scan.
        component: of the map; null where refused.
        scenes: names of those that show the scan at that place.
        probability: that the place is right; where refused, of the best that was found.
        coloured: whether the scan has colours; without, less can be told.
        num_points: points that it was looked for by.
        supports: what every scene that was asked says.
        seconds: CPU seconds of it all.
        notes: what a person should know.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "file": "scan",
        "status": "status",
        "component": "component",
        "scenes": "scenes",
        "probability": "probability",
        "sigma_deg": "+- deg",
        "sigma_m": "+- m",
        "reason": "reason",
    }

    file: str
    kind: str
    status: str
    reason: str
    S_map_scan: Sim3 | None
    T_map_camera: np.ndarray | None
    origin: np.ndarray
    covariance: np.ndarray | None
    sigma_deg: float | None
    sigma_m: float | None
    component: int | None
    scenes: tuple[str, ...]
    probability: float
    coloured: bool
    num_points: int
    supports: tuple[ScanSupport, ...]
    seconds: float
    notes: tuple[str, ...] = ()
