"""A scan of a place: points with or without colours."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from gsmap.errors import InputError
from gsmap.types.cameras import Cameras

_SHIFT = 1000.0  # units from the origin beyond which float32 would lose a tenth of a millimetre
_ROUND = 100.0


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of a surface, relative to an origin in the frame of their file.

    Args:
        points: (N, 3) float64 about ``origin``, in the file's unit; at least one, all finite.
        colours: (N, 3) float32 sRGB in [0, 1]; None without colours.
        kind: ``points``, ``mesh`` (samples of its surface) or ``depth`` (pixels of one image).
        origin: (3,) float64 of the file's frame; ``points + origin`` are the file's own coordinates.
        camera: camera of the scan, in the frame of ``points``; None if there was none.
        notes: remarks.

    Raises:
        InputError: no points, or arrays that do not fit together.
    """

    points: np.ndarray
    colours: np.ndarray | None = None
    kind: str = "points"
    origin: np.ndarray = field(default_factory=lambda: np.zeros(3))
    camera: Cameras | None = None
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", np.ascontiguousarray(self.points, dtype=np.float64))
        object.__setattr__(self, "origin", np.array(self.origin, dtype=np.float64))
        if self.points.ndim != 2 or self.points.shape[1] != 3 or self.origin.shape != (3,):
            raise InputError(
                "a scan needs points of shape (N, 3) and an origin of shape (3,), got points of shape "
                f"{self.points.shape}",
                code="shape_mismatch",
            )
        if not len(self.points) or not np.isfinite(self.points).all() or not np.isfinite(self.origin).all():
            raise InputError("a scan needs at least one point, and finite points only", code="empty_scan")
        if self.colours is not None:
            object.__setattr__(self, "colours", np.ascontiguousarray(self.colours, dtype=np.float32))
            if self.colours.shape != self.points.shape:
                raise InputError(
                    f"a scan of {len(self.points)} points got colours of shape {self.colours.shape}",
                    code="shape_mismatch",
                )

    def __len__(self) -> int:
        return len(self.points)

    def about_its_middle(self) -> Scan:
        """Return the scan with its origin moved near its points, in whole hundreds, if they lie far from zero."""
        middle = np.median(self.points, axis=0)
        if self.camera is not None or np.abs(middle).max() < _SHIFT:
            return self
        shift = np.round(middle / _ROUND) * _ROUND
        return replace(self, points=self.points - shift, origin=self.origin + shift)
