"""Localized photos and scans."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from gsmap.types.localization import Localization, PhotoLocalization
from gsmap.types.rows.base import Row
from gsmap.types.rows.scenes import SceneRef
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoChangeRow(SceneRef):
    """A region of a localized photo that differs from the map.

    Args:
        kind: kind as far as one photo can tell: ``appeared`` (an object that is not in the map), ``disappeared``
            (content of the map is gone), ``recoloured`` or ``replaced``.
        box_px: bounding box ``x0 y0 x1 y1`` in pixels of the upright photo.
        share: fraction of the image.
        strength: mean difference relative to what light and noise explain; above 1.
        position: centre of the map's content there; frame and unit of the photo's component.
        object: id of the nearest object (`gsmap graph`); null if there is none.
        scene: id of the capture that the photo was compared with.
        scene_name: name of the capture that the photo was compared with.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "kind": "what",
        "box_px": "box (px)",
        "share": "of the picture",
        "strength": "strength",
        "position": "at (map units)",
        "object": "object",
        "scene_name": "compared with",
    }

    kind: str
    box_px: np.ndarray
    share: float
    strength: float
    position: np.ndarray
    object: str | None


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizedRow(Localization, Row):
    """A localized file.

    Args:
        file: file as given; ``FILE#SECONDS`` for a video frame.
        status: ``placed`` or ``refused``.
        reason_code: code of the reason, a key of `gsmap.reason_codes.REASONS`, or empty.
        S_map_scan: scan coordinates, less ``origin``, to the map, frame and unit of its component; null for photos and
            refused scans.
        origin: offset subtracted from the scan's coordinates: zeros unless they are large; null for photos.
        seconds: wall time in seconds, of a scan CPU time.
    """

    file: str
    status: str
    reason_code: str = ""
    S_map_scan: Sim3 | None = None
    origin: np.ndarray | None = None
    seconds: float = 0.0


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizeRow(PhotoLocalization, LocalizedRow):
    """The result for one photo, video frame or scan.

    Args:
        changes: regions that differ from the map, clearest first; null if not requested.
        compared: fraction of the image that was compared; null if not requested.
        picture: image file with these regions drawn; null if not requested.
        added: true if the photo was stored in the map; false if it was there already; null if not requested.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "file": "file",
        "status": "status",
        "component": "component",
        "position": "at (map units)",
        "sigma": "sigma (deg, map units)",
        "probability": "probability",
        "scenes": "scenes",
        "reason": "reason",
    }

    changes: tuple[PhotoChangeRow, ...] | None = None
    compared: float | None = None
    picture: str | None = None
    added: bool | None = None

    @property
    def position(self) -> str:
        """Camera centre or scan origin, in map units."""
        at = self.T_map_camera[:3, 3] if self.T_map_camera is not None else None
        if self.S_map_scan is not None:
            at = self.S_map_scan.translation
        return "-" if at is None else " ".join(f"{value:.3f}" for value in at)

    @property
    def sigma(self) -> str:
        """Largest standard deviations of the rotation (degrees) and of the position (map units), as text."""
        if self.covariance is None:
            return "-"
        turn, shift = (np.sqrt(np.linalg.eigvalsh(self.covariance[p, p])[-1]) for p in (slice(3), slice(3, 6)))
        return f"{np.degrees(turn):.2f} deg {shift:.3f}"


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoRow(SceneRef):
    """A photo stored in the map, with its pose in the newest revision.

    Args:
        id: ``p`` and a number.
        file: file name.
        digest: SHA-256 of the file, or of a video frame's pixels.
        captured_at: capture date, ISO 8601; null if unknown.
        component: component of its pose; null if its supporting scene has no pose.
        T_map_camera: (4, 4) camera-to-map (OpenCV axes), frame and unit of the component; null if its supporting scene
            has no pose.
        covariance: (6, 6) over [rot_rad (3), trans (3)] on the camera's side, map unit, relative to the scene; null if
            its supporting scene has no pose.
        intrinsics_px: (4,) ``fx fy cx cy`` in the photo's own size.
        size_px: width and height of the photo.
        probability: probability that its pose is right, at the time it was added.
        scene: id of the supporting capture, with which it moves.
        scene_name: name of the supporting capture.
        num_seen: number of objects that it shows.
        num_absent: number of objects that it shows to be absent.
        added_at: time when it was added.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "id": "photo",
        "file": "file",
        "captured_at": "captured",
        "component": "component",
        "position": "at (map units)",
        "scene_name": "scene",
        "num_seen": "objects seen",
        "num_absent": "objects absent",
    }

    id: str
    file: str
    digest: str
    captured_at: str | None
    component: int | None
    T_map_camera: np.ndarray | None
    covariance: np.ndarray | None
    intrinsics_px: np.ndarray
    size_px: tuple[int, int]
    probability: float
    num_seen: int
    num_absent: int
    added_at: str

    @property
    def position(self) -> str:
        """Camera centre, in map units."""
        if self.T_map_camera is None:
            return "-"
        return " ".join(f"{value:.3f}" for value in self.T_map_camera[:3, 3])


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizeReport(Row):
    """The results of localization.

    Args:
        results: one result per file, in the order of the input.
        notes: remarks on the map.
    """

    columns: ClassVar[Mapping[str, str]] = {"results": "results"}

    results: tuple[LocalizeRow, ...]
    notes: tuple[str, ...] = ()
