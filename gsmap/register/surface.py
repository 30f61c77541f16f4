"""Extract the surface points of a scene, which registration aligns and compares."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np

from gsmap.geometry.cells import cell_means
from gsmap.geometry.floaters import find_floaters
from gsmap.geometry.sh import rgb_of_sh0
from gsmap.geometry.warps import Warp
from gsmap.register import visible_side
from gsmap.register.view_cache import ViewCache
from gsmap.render import ChunkIndex
from gsmap.types import Cameras, Gaussians
from gsmap.types.prepared_scene import PreparedScene

PLANE_NEIGHBOURS = 20  # cells to which each cell's plane is fitted, the cell itself included, as in small_gicp
_GRADIENT_NEIGHBOURS = 10


# A surface Gaussian has at least this opacity. In a fainter capture the threshold falls until MIN_OPAQUE_SHARE of the
# Gaussians count as opaque, but not below FAINTEST_OPACITY.
MIN_OPACITY = 0.5
MIN_OPAQUE_SHARE = 0.4
FAINTEST_OPACITY = 0.1
# Its largest standard deviation is at most this, or the quantile of the opaque Gaussians, whichever is larger; floaters
# and sky are larger.
MAX_SCALE_M = 0.08
MAX_SCALE_QUANTILE = 0.7
MIN_FLOATER_COLOUR = 0.3  # a point whose colour (RGB in [0, 1]) differs by this from the surface around it is a floater
RESOLUTION_M = 0.05  # points are averaged over cells of this size before they are aligned


class Surface:
    """Centres of a scene's surface Gaussians, in metres. Every array is computed on first use.

    Args:
        points: (N, 3) float64 in the scene's frame, scaled to metres; None to compute them from ``raw``.
        colours: (N, 3) float32 view-independent colours, RGB in [0, 1]; None as well.
        resolution_m: cell size of the aligned cloud.
        raw: the N Gaussians in the scene's unit, with their mean colour alone; None where only points are known.
        unit_m: metres per unit of the scene.
        gaussians, cameras: the whole scene in its own unit; None where only points are known.
        views: views of the scene through its cameras, which orient its normals; None without cameras.
        prepared: the cells of this surface, if they were computed before.
    """

    def __init__(
        self,
        points: np.ndarray | None,
        colours: np.ndarray | None,
        resolution_m: float,
        *,
        raw: Gaussians | None = None,
        unit_m: float = 1.0,
        gaussians: Gaussians | None = None,
        cameras: Cameras | None = None,
        views: ViewCache | None = None,
        prepared: PreparedScene | None = None,
    ) -> None:
        if points is not None and colours is not None:
            self.points, self.colours = points, colours
        self.resolution_m, self.unit_m, self._raw = resolution_m, unit_m, raw
        self.gaussians, self.cameras, self.views, self.prepared = gaussians, cameras, views, prepared

    def __len__(self) -> int:
        return len(self.points) if self._raw is None else len(self._raw)

    @classmethod
    def of(
        cls,
        gaussians: Gaussians,
        unit_m: float = 1.0,
        cameras: Cameras | None = None,
        views: ViewCache | None = None,
    ) -> Surface:
        """Extract the surface of a scene; ``unit_m`` is metres per unit of the scene."""
        splats = gaussians.degree_0()[surface_rows(gaussians, unit_m)]
        return cls.from_splats(splats, unit_m, gaussians, cameras, views)

    @classmethod
    def from_splats(
        cls,
        splats: Gaussians,
        unit_m: float = 1.0,
        gaussians: Gaussians | None = None,
        cameras: Cameras | None = None,
        views: ViewCache | None = None,
        prepared: PreparedScene | None = None,
    ) -> Surface:
        """Return the surface of Gaussians in the scene's unit, with their mean colour alone."""
        return cls(
            None,
            None,
            RESOLUTION_M,
            raw=splats,
            unit_m=unit_m,
            gaussians=gaussians,
            cameras=cameras,
            views=views,
            prepared=prepared,
        )

    @cached_property
    def points(self) -> np.ndarray:
        """(N, 3) float64 centres in the scene's frame, scaled to metres."""
        assert self._raw is not None
        return self._raw.means.astype(np.float64) * self.unit_m

    @cached_property
    def colours(self) -> np.ndarray:
        """(N, 3) float32 view-independent colours, RGB in [0, 1]."""
        assert self._raw is not None
        colours: np.ndarray = np.clip(rgb_of_sh0(self._raw.sh[:, 0]), 0.0, 1.0)
        return colours

    @cached_property
    def splats(self) -> Gaussians | None:
        """The N Gaussians in metres, with their mean colour alone; None where only points are known."""
        raw = self._raw
        if raw is None or self.unit_m == 1.0:
            return raw
        log_scales = raw.log_scales + np.float32(np.log(self.unit_m))
        means = raw.means.astype(np.float64) * self.unit_m
        return Gaussians(means, raw.quats, log_scales, raw.logit_opacities, raw.sh)

    def scaled(self, factor: float) -> Surface:
        """Multiply all coordinates by ``factor``: convert the surface to a unit that is ``factor`` times smaller."""
        return self if factor == 1.0 else Surface(self.points * factor, self.colours, self.resolution_m)

    def warped(self, warp: Warp) -> Surface:
        """Return the surface with its cells moved by a warp in metres, and their normals turned by it."""
        points, colours = self.coarse
        turns = np.linalg.inv(warp.jacobians(points)).transpose(0, 2, 1)
        out = Surface(warp.apply(points), colours, self.resolution_m)
        out.coarse = out.points, out.colours

        def turned(normals: np.ndarray) -> np.ndarray:
            normals = np.einsum("nij,nj->ni", turns, normals)
            unit: np.ndarray = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
            return unit

        out.normals = turned(self.normals)
        out.oriented_normals = None if self.oriented_normals is None else turned(self.oriented_normals)
        return out

    @cached_property
    def coarse(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the cell means (M, 3) of points and of colours at the resolution of the aligned cloud, in a fixed
        order."""
        if self.prepared is not None:
            return self.prepared.points.astype(np.float64), self.prepared.colours.astype(np.float32)
        points, colours, _ = cell_means(self.points, self.colours, self.resolution_m)
        return points, colours.astype(np.float32)

    def sample(self, count: int) -> np.ndarray:
        """Return the rows of at most ``count`` cell means, evenly strided (cells come in spatial order)."""
        total = len(self.coarse[0])
        return np.arange(total) if total <= count else np.linspace(0, total - 1, count).astype(np.int64)

    @cached_property
    def cloud(self) -> tuple[Any, Any]:
        """The small_gicp point cloud of the cell means with covariances and normals, and its search tree."""
        import small_gicp

        cloud = small_gicp.PointCloud(self.coarse[0])
        tree = small_gicp.KdTree(cloud, num_threads=1)
        small_gicp.estimate_normals_covariances(cloud, tree, num_neighbors=20, num_threads=1)
        return cloud, tree

    @cached_property
    def tree(self) -> Any:
        """Search tree of the cell means."""
        from gsmap import _native

        return _native.PointTree(np.ascontiguousarray(self.coarse[0]))

    @cached_property
    def normals(self) -> np.ndarray:
        """(M, 3) unit normals at the cell means, of arbitrary sign."""
        if self.prepared is not None:
            return self.prepared.normals.astype(np.float64)
        normals: np.ndarray = self.tree.normals(PLANE_NEIGHBOURS)
        return normals

    @cached_property
    def lightness(self) -> np.ndarray:
        """(M,) float64 lightness of the cell means, 0 to 1."""
        return self.coarse[1].astype(np.float64) @ np.array([0.299, 0.587, 0.114])

    @cached_property
    def lightness_gradients(self) -> np.ndarray:
        """(M, 3) change of lightness per metre within the tangent planes of the cell means, by least squares."""
        gradients: np.ndarray = self.tree.tangent_gradients(
            self.normals, self.lightness, _GRADIENT_NEIGHBOURS, self.resolution_m
        )
        return gradients

    @cached_property
    def oriented_normals(self) -> np.ndarray | None:
        """(M, 3) normals towards the side that the scene's cameras saw: zeros if unknown, None if all are."""
        if self.views is None or not self.views.num_own or not len(self.coarse[0]):
            return None
        if self.prepared is not None:
            sides = self.prepared.sides
        else:
            sides = visible_side.find_sides(self.coarse[0], self.normals, self.tree, self.views, self.unit_m)
        return self.normals * sides[:, None] if sides.any() else None

    @cached_property
    def index(self) -> ChunkIndex:
        """Boxes of chunks of the splats, by which renders skip those out of view."""
        assert self.splats is not None
        return ChunkIndex.build(self.splats)

    def nearest(
        self, points: np.ndarray, radius_m: float, normals: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the distance to and the row of the cell mean nearest to each point; inf and 0 beyond the radius.

        Args:
            normals: (P, 3) oriented normals of the points, in this surface's frame; cells that face the opposite side
                are skipped.
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if normals is None or self.oriented_normals is None:
            distance, rows = self.tree.nearest(points, radius_m)
        else:
            distance, rows = self.tree.nearest(points, radius_m, self.oriented_normals, np.ascontiguousarray(normals))
        return distance, rows


def surface_rows(gaussians: Gaussians, unit_m: float) -> np.ndarray:
    """Return the rows of the surface Gaussians of a scene; ``unit_m`` is metres per unit of the scene."""
    largest = gaussians.log_scales.max(1, initial=-np.inf) + np.log(unit_m)
    opacities = gaussians.opacities
    bar = MIN_OPACITY
    if len(opacities):
        bar = np.clip(np.quantile(opacities, 1 - MIN_OPAQUE_SHARE), FAINTEST_OPACITY, bar)
    opaque = opacities >= bar
    limit = np.log(MAX_SCALE_M)
    if opaque.any():
        limit = max(limit, float(np.quantile(largest[opaque], MAX_SCALE_QUANTILE)))
    keep = np.flatnonzero(opaque & (largest <= limit))
    colours = np.clip(rgb_of_sh0(gaussians.sh[keep, 0]), 0.0, 1.0)
    stray, _ = find_floaters(gaussians.means[keep], colours, MIN_FLOATER_COLOUR)
    return keep[~stray]
