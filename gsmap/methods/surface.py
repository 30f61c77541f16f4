"""The surface of a scene for proposers and refiners."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from gsmap.types import Cameras, Gaussians


class Surface(Protocol):
    """The surface of a scene in metres: the scene's axes and origin, lengths times `unit_m`.

    Everything is computed once, when it is first asked for, and kept; arrays are not to be written to.
    """

    @property
    def points(self) -> np.ndarray:
        """(N, 3) float64 centres of the scene's surface Gaussians, metres."""

    @property
    def colours(self) -> np.ndarray:
        """(N, 3) float32 their view-independent colours, RGB in [0, 1]."""

    @property
    def resolution_m(self) -> float:
        """Side of the cells over which `coarse` averages."""

    @property
    def unit_m(self) -> float:
        """Metres per unit of the scene, under which this surface was made."""

    @property
    def gaussians(self) -> Gaussians | None:
        """Return the whole scene in its own unit; None if only points are known."""

    @property
    def cameras(self) -> Cameras | None:
        """Return the scene's cameras in its own unit; None if it has none."""

    def __len__(self) -> int:
        """Number of points."""

    @property
    def coarse(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the means of points (M, 3), float64 metres, and of colours, float32, over cells in spatial order."""

    def scaled(self, factor: float) -> Surface:
        """Return the surface without Gaussians in a unit ``factor`` times smaller."""

    def sample(self, count: int) -> np.ndarray:
        """Return rows of at most ``count`` cells, evenly strided."""

    @property
    def normals(self) -> np.ndarray:
        """Return (M, 3) float64 unit normals at the cell means; signs are arbitrary."""

    @property
    def lightness(self) -> np.ndarray:
        """(M,) float64 lightness of the cells, 0 to 1."""

    @property
    def lightness_gradients(self) -> np.ndarray:
        """(M, 3) float64 change of lightness per metre within the tangent planes of the cells."""

    @property
    def tree(self) -> Any:
        """The search tree of the cell means: a ``gsmap._native.PointTree``."""

    @property
    def cloud(self) -> tuple[Any, Any]:
        """Return the cell means with covariances and normals, and their search tree, as small_gicp types."""

    @property
    def oriented_normals(self) -> np.ndarray | None:
        """(M, 3) float64 the normals turned to the side that the scene's own cameras saw, zeros where that is not
        known; None where it nowhere is."""

    def nearest(
        self, points: np.ndarray, radius_m: float, normals: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance (P,) to and row (P,) of the nearest cell mean of each point (P, 3); inf and 0 beyond the
        radius.

        Cells that face the other way than the points (``normals`` (P, 3), in this frame) are passed over.
        """
