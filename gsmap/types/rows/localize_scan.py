"""The localization of a scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanSupport(Row):
    """The registration of a scan with one scene.

    Args:
        scene: id.
        scene_name: name.
        status: ``accepted`` (it shows the scan), ``rejected`` or ``no_match``.
        reason: reason of a rejection, or empty.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
        probability: probability that the match is right; null without evidence.
        overlap: fraction of the smaller surface that coincides.
        component: component of the scene.
        S_map_scan: pose of the scan by this scene; null without a match.
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
    reason_code: str = ""
    probability: float
    overlap: float
    component: int
    S_map_scan: Sim3 | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanRow(Row):
    """The pose of a scan in the map, or the reason for refusing it.

    Args:
        file: file as given.
        kind: ``points``, ``mesh``, ``depth`` or ``splat``.
        status: ``placed`` or ``refused``.
        reason: reason for the refusal; empty if it is placed.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
        S_map_scan: scan coordinates, less ``origin``, to the component's frame; null if refused.
        T_map_camera: camera pose of a depth image (OpenCV axes), translation in map units; else null.
        origin: offset subtracted from the file's coordinates; zeros unless they are large.
        covariance: 7x7 of ``S_map_scan`` over [rot_rad, trans, log_scale] on the scan's side; null where refused.
        sigma_deg: largest standard deviation of the rotation.
        sigma_m: largest standard deviation of the position of the scan's centre, metres of the scan.
        component: component of the map; null if refused.
        scenes: names of the supporting scenes.
        probability: probability that the pose is right; if refused, that of the best candidate.
        coloured: true if the scan has colours; without them localization is less certain.
        num_points: number of points used.
        supports: registrations with all compared scenes.
        seconds: CPU time in seconds.
        notes: remarks.
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
    reason_code: str = ""
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
