"""Where photographs and scans were taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from gsmap.types.rows.base import Row
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoChangeRow(Row):
    """A part of a placed photo that shows something else than the map does there.

    Args:
        kind: as far as one photo can tell: ``appeared`` (something stands there that the map has not), ``disappeared``
            (what the map has there is gone), ``recoloured`` or ``replaced``.
        box_px: ``x0 y0 x1 y1`` around it, in pixels of the upright photo.
        share: of the picture.
        strength: its mean difference in units of what light and noise explain there; above 1.
        position: the middle of what the map has there; frame and unit of the photo's component.
        object: id of the nearest thing of the map there (`gsmap graph`); null where none was told apart.
        scene: id of the capture that the photo was compared with there.
        scene_name: its name.
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
    scene: str
    scene_name: str


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizeRow(Row):
    """One photograph, frame of a clip, or scan.

    Args:
        file: as it was given; of a frame of a clip, ``FILE#SECONDS``.
        status: ``placed`` or ``refused``.
        reason: why it is refused; empty where it is placed.
        T_map_camera: (4, 4) camera-to-map of a photo (OpenCV axes), in the frame and unit of its component; else null.
        S_map_scan: takes a scan, less ``origin``, to the map, in the same frame and unit; null for photos, and where
            it is refused.
        origin: what is taken from a scan's coordinates first: zeros unless they are large; null for photos.
        covariance: (6, 6) over [rot_rad (3), trans (3)], of a scan (7, 7) with the logarithm of its scale, on the
            camera's or scan's side: ``T = T_hat Exp(xi)``, translation in the map's unit (a scan's: in its own).
        component: in whose frame that is; null where nothing was found.
        scenes: names of the scenes that support it, those that support most first.
        intrinsics_px: (4,) ``fx fy cx cy`` of the photo, given or solved for; null for a scan.
        probability: that the pose is right, of all evidence together; 0 where there was none to judge.
        evidence: numbers behind it, by name.
        num_gaussians: of the supporting scenes, that the photo shows.
        seconds: it took, of the wall clock.
        changes: where a placed photo shows something else than the map, the clearest first; null where not asked.
        compared: share of the picture that could be compared for it; null where it was not asked.
        picture: file with these parts drawn; null where none was asked for.
        added: whether the map keeps the photo from now on; false where it did already; null where it was not asked.
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

    file: str
    status: str
    reason: str
    T_map_camera: np.ndarray | None = None
    S_map_scan: Sim3 | None = None
    origin: np.ndarray | None = None
    covariance: np.ndarray | None = None
    component: int | None = None
    scenes: tuple[str, ...] = ()
    intrinsics_px: np.ndarray | None = None
    probability: float = 0.0
    evidence: Mapping[str, float] = field(default_factory=dict)
    num_gaussians: int = 0
    seconds: float = 0.0
    changes: tuple[PhotoChangeRow, ...] | None = None
    compared: float | None = None
    picture: str | None = None
    added: bool | None = None

    @property
    def position(self) -> str:
        """Where the camera stood, or the scan's origin lies, map unit."""
        at = self.T_map_camera[:3, 3] if self.T_map_camera is not None else None
        if self.S_map_scan is not None:
            at = self.S_map_scan.translation
        return "-" if at is None else " ".join(f"{value:.3f}" for value in at)

    @property
    def sigma(self) -> str:
        """Standard deviations of the worst direction: degrees, and map units."""
        if self.covariance is None:
            return "-"
        turn, shift = (np.sqrt(np.linalg.eigvalsh(self.covariance[p, p])[-1]) for p in (slice(3), slice(3, 6)))
        return f"{np.degrees(turn):.2f} deg {shift:.3f}"


@dataclass(frozen=True, eq=False, kw_only=True)
class PhotoRow(Row):
    """A photograph that the map keeps, where it stands by the newest poses.

    Args:
        id: ``p`` and a number.
        file: its name.
        digest: SHA-256 of the file; of a frame of a clip, of its pixels.
        captured_at: when it was taken, ISO 8601; null where nothing says it.
        component: whose frame its pose is in; null where the scene that supports it has no pose now.
        T_map_camera: (4, 4) camera-to-map (OpenCV axes), frame and unit of the component; null as above.
        covariance: (6, 6) over [rot_rad (3), trans (3)] on the camera's side, in the map's unit, of its place in the
            scene; null as above.
        intrinsics_px: (4,) ``fx fy cx cy`` of the photo itself.
        size_px: its width and height.
        probability: that its pose is right, when it was added.
        scene: id of the capture that it was placed by, and moves with.
        scene_name: its name.
        num_seen: objects that it shows.
        num_absent: objects that it shows to be gone.
        added_at: when it was added.
    """

    columns: ClassVar[Mapping[str, str]] = {
        "id": "photo",
        "file": "file",
        "captured_at": "captured",
        "component": "component",
        "position": "at (map units)",
        "scene_name": "scene",
        "num_seen": "shows",
        "num_absent": "shows to be gone",
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
    scene: str
    scene_name: str
    num_seen: int
    num_absent: int
    added_at: str

    @property
    def position(self) -> str:
        """Where the camera stood, map unit."""
        if self.T_map_camera is None:
            return "-"
        return " ".join(f"{value:.3f}" for value in self.T_map_camera[:3, 3])


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalizeReport(Row):
    """Where photographs, clips and scans were taken.

    Args:
        results: one for each file, in the order in which they were given.
        notes: what a person should know of the map.
    """

    columns: ClassVar[Mapping[str, str]] = {"results": "results"}

    results: tuple[LocalizeRow, ...]
    notes: tuple[str, ...] = ()
