"""What goes into a merge and what comes out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from gsmap.types.cameras import Cameras
from gsmap.types.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class KeptPhoto:
    """A photograph that a map keeps, in the frame of the map (`PlacedScene`) or of its scene, and in the unit of that.

    Args:
        camera: one; the picture that is kept may be smaller than it says.
        read: reads that picture, (H, W, 3) uint8.
        sigma_rad, sigma_m: how well its rotation and its place are known (standard deviation of the least known).
        around: the Gaussians of its capture around its camera, same frame; None where those of the scene it is given
            with are all there are.
    """

    camera: Cameras
    read: Callable[[], np.ndarray]
    sigma_rad: float = 0.0
    sigma_m: float = 0.0
    around: Callable[[], Gaussians] | None = None


@dataclass(frozen=True, eq=False)
class PlacedScene:
    """One capture, or the piece of it that lies near a tile, in the map frame.

    Args:
        gaussians: its Gaussians, map frame.
        cameras: its cameras, map frame; None or none where nothing is known of what it saw.
        scene_id: which scene it is; scenes are merged in the order of their ids, whatever order they come in.
        captured_at: ISO 8601 time with zone, or None.
        centroid: reads the whole capture and returns (3,) the mean of its means, map frame (None where it is empty);
            given where `gaussians` is only a piece of it. See `whole_centroid`.
        reference_views: renders of its views (`gsmap.merge.reference_view_cache.PlacedReferenceViews`), given the
            longest side of an image in pixels; None where they are to be rendered from `gaussians`.
        photos: photographs that show the place as this capture does, each as far as it does.
    """

    gaussians: Gaussians
    cameras: Cameras | None = None
    scene_id: str = ""
    captured_at: str | None = None
    centroid: Callable[[], np.ndarray | None] | None = None
    reference_views: Callable[[int], Any] | None = None
    photos: tuple[KeptPhoto, ...] = ()

    def whole_centroid(self) -> np.ndarray | None:
        """(3,) float64 unweighted mean of the means of the whole capture, map frame; None where it holds nothing.

        Read when it is asked for: mergers that do not ask do not pay for it.
        """
        if self.centroid is not None:
            return self.centroid()
        return self.gaussians.means.mean(0, dtype=np.float64) if len(self.gaussians) else None


@dataclass(frozen=True, eq=False)
class MergeResult:
    """The merged Gaussians and where they came from.

    Args:
        gaussians: in the map frame, only those whose mean lies in the bounds asked for.
        origin: (N,) int32 index, in the order the scenes were given, of the scene each Gaussian came from (of the
            heaviest one, where several became one).
        num_input: Gaussians of all scenes within the bounds before merging.
        steps: optimisation steps taken, 0 for the closed-form methods.
        truncated: a time budget cut the optimisation short.
        notes: what a person should know.
    """

    gaussians: Gaussians
    origin: np.ndarray
    num_input: int = 0
    steps: int = 0
    truncated: bool = False
    notes: tuple[str, ...] = ()
