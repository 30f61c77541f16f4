"""The surface of a scene, as proposers and refiners get it."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from gsmap.types import Cameras, Gaussians


class Surface(Protocol):
    """The surface of a scene in metres: coordinates in the scene frame, multiplied by `unit_m`.

    Each value is computed on first use and kept; arrays must not be written to.
    """

    @property
    def points(self) -> np.ndarray:
        """Centres (N, 3) float64 of the scene's surface Gaussians, metres."""

    @property
    def colours(self) -> np.ndarray:
        """View-independent colours (N, 3) float32 of the points, RGB in [0, 1]."""

    @property
    def resolution_m(self) -> float:
        """Edge length of the cells over which `coarse` averages, metres."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of the scene that this surface was made with."""

    @property
    def gaussians(self) -> Gaussians | None:
        """Return the whole scene in its own unit; None if only points are known."""

    @property
    def cameras(self) -> Cameras | None:
        """Return the scene's cameras in the scene's own unit; None if the scene has no cameras."""

    def __len__(self) -> int:
        """Number of points."""

    @property
    def coarse(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean point (M, 3), float64 metres, and colour (M, 3), float32, of each cell, in spatial order."""

    def scaled(self, factor: float) -> Surface:
        """Return the surface, without Gaussians, with all coordinates multiplied by ``factor``."""

    def sample(self, count: int) -> np.ndarray:
        """Return the indices of at most ``count`` cells, evenly spaced."""

    @property
    def normals(self) -> np.ndarray:
        """Return unit normals (M, 3) float64 at the cell means, with arbitrary signs."""

    @property
    def lightness(self) -> np.ndarray:
        """Lightness (M,) float64 of the cells, 0 to 1."""

    @property
    def lightness_gradients(self) -> np.ndarray:
        """Gradients (M, 3) float64 of the lightness, per metre, within the tangent planes of the cells."""

    @property
    def tree(self) -> Any:
        """The search tree of the cell means: a ``gsmap._native.PointTree``."""

    @property
    def cloud(self) -> tuple[Any, Any]:
        """Return the cell means with covariances and normals, and their search tree, as small_gicp types."""

    @property
    def oriented_normals(self) -> np.ndarray | None:
        """Normals (M, 3) float64 towards the scene's own cameras; zeros where none saw the cell; None without any."""

    def nearest(
        self, points: np.ndarray, radius_m: float, normals: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (P,) and index (P,) of the cell mean nearest to each point (P, 3); inf and 0 beyond the
        radius.

        Cells whose normals oppose those of the points (``normals`` (P, 3), in this frame) are ignored.
        """
