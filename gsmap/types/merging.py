"""Input and output of a merge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.types.cameras import Cameras
from gsmap.types.gaussians import Gaussians
from gsmap.types.sim3 import Sim3


@dataclass(frozen=True, eq=False)
class UnchangedPlace:
    """A place where nothing changed.

    Args:
        S_frame_map: transforms the map frame, in metres, to the frame of the box.
        box: (2, 3) lowest and highest corner, in metres.
        margin_m: distance around the box in which Gaussians belong to the place, too.
    """

    S_frame_map: Sim3
    box: np.ndarray
    margin_m: float = 0.1


@dataclass(frozen=True, eq=False)
class ReferencePhoto:
    """A localized photo used as a reference view, posed in the map frame (in a `PosedScene`) or in its scene's frame.

    Args:
        camera: its camera; the stored image may be smaller.
        read: reads the stored image, (H, W, 3) uint8.
        sigma_rad, sigma_m: largest standard deviation of its rotation and of its position.
        around: Gaussians around its camera, same frame; None if the scene's Gaussians are complete there.
    """

    camera: Cameras
    read: Callable[[], np.ndarray]
    sigma_rad: float = 0.0
    sigma_m: float = 0.0
    around: Callable[[], Gaussians] | None = None


@dataclass(frozen=True, eq=False)
class PosedScene:
    """A capture in the map frame, or only the part of the capture near a tile.

    Args:
        gaussians: Gaussians, map frame.
        cameras: cameras, map frame; None or empty if unknown.
        scene_id: scene id; scenes are merged in the order of their ids.
        captured_at: ISO 8601 time with zone, or None.
        centroid: reads the whole capture and returns (3,) the mean of its means, map frame (None if it is empty); set
            if `gaussians` is only a part of it. See `whole_centroid`.
        reference_views: renders of its views (`gsmap.merge.reference_view_cache.PlacedReferenceViews`), given the
            longest side of an image in pixels; None where they are to be rendered from `gaussians`.
        photos: localized photos that show the place as this capture does.
        unchanged: places where a person rejected the changes since this capture: newer captures make nothing outdated
            there.
    """

    gaussians: Gaussians
    cameras: Cameras | None = None
    scene_id: str = ""
    captured_at: str | None = None
    centroid: Callable[[], np.ndarray | None] | None = None
    reference_views: Callable[[int], Any] | None = None
    photos: tuple[ReferencePhoto, ...] = ()
    unchanged: tuple[UnchangedPlace, ...] = ()

    def whole_centroid(self) -> np.ndarray | None:
        """Return the unweighted mean (3,) float64 of all Gaussian means of the capture, map frame; None without
        Gaussians.

        The mean is read on this call, so that mergers without a use for it do not pay for it.
        """
        if self.centroid is not None:
            return self.centroid()
        return self.gaussians.means.mean(0, dtype=np.float64) if len(self.gaussians) else None


@dataclass(frozen=True, eq=False)
class MergeResult:
    """Merged Gaussians, with the scene that each Gaussian comes from.

    Args:
        gaussians: Gaussians in the map frame whose mean lies in the requested bounds.
        origin: (N,) int32 index of the scene of each Gaussian, in the order of the input (of the heaviest one if
            several were merged).
        num_input: Gaussians of all scenes within the bounds before merging.
        steps: optimization steps; 0 for closed-form methods.
        truncated: true if a time budget cut the optimization short.
        notes: remarks.
    """

    gaussians: Gaussians
    origin: np.ndarray
    num_input: int = 0
    steps: int = 0
    truncated: bool = False
    notes: tuple[str, ...] = ()
