"""The localization of a scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.rows.localize import LocalizedRow
from gsmap.types.rows.scenes import SceneRef
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanSupport(SceneRef):
    """The registration of a scan with one scene.

    Args:
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

    status: str
    reason: str
    reason_code: str = ""
    probability: float
    overlap: float
    component: int
    S_map_scan: Sim3 | None


@dataclass(frozen=True, eq=False, kw_only=True)
class ScanRow(LocalizedRow):
    """The pose of a scan in the map, or the reason for refusing it.

    Args:
        kind: ``points``, ``mesh``, ``depth`` or ``splat``.
        origin: offset subtracted from the file's coordinates; zeros unless they are large.
        sigma_deg: largest standard deviation of the rotation.
        sigma_m: largest standard deviation of the position of the scan's centre, metres of the scan.
        coloured: true if the scan has colours; without them localization is less certain.
        num_points: number of points used.
        supports: registrations with all compared scenes.
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

    kind: str
    origin: np.ndarray
    sigma_deg: float | None
    sigma_m: float | None
    coloured: bool
    num_points: int
    supports: tuple[ScanSupport, ...]
    notes: tuple[str, ...] = ()
